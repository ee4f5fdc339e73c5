//! The last flights of indirect light, without chance.
//!
//! With I the incident radiance of light that was scattered before, T the transmittance from a light and p the phase
//! function, `J = albedo int p (I + T L)` is what a place sends on and `I(x, w) = int exp(-tau) sigma_t D J(x + s w, w)
//! ds`. Photons ([`super::photons`]) give the I on the right, unbiased and noisy; on the left each cell gets the light
//! of all cells along the rays that meet there, and the noise of hundreds of them is averaged. That is the final
//! gathering of photon maps (Jensen 1996, section 5). Zhang et al. 2013 keep what the photons left.
//!
//! *Rays* ([`super::rays`]) go along fixed directions through a grid of a node a cell. What a cell has received of them
//! is scaled to the opacity of its voxels, `1 - T` by a sweep of the whole field. So a constant J sends what it would
//! through the voxels, in every direction, and white smoke stays white, however coarse the cells.
//! *First scattering* has the phase function up to the degree that the directions integrate exactly; what is scattered
//! more often has the photons' bands.
//! *Twice, by halves.* Gathered light has the error of cells in place of noise, so a second gathering takes the rest of
//! the noise and adds of that error: what is gathered last is sent on half by the photons, half by a first gathering.
//! Cost: a sweep of the field for each direction of a mesh twice as fine as that of the lights, and for each cell,
//! ordinate, light and gathering about `3 bands^2 + 30` operations.

use super::photons::GreyMedium;
use super::rays::{LANES, Lanes, Placed, Rays, advance, of_slices};
use super::visibility::sweeps;
use glam::{DAffine3, DVec3, Vec3};
use rayon::prelude::*;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::sphere::icosphere::Icosphere;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::compensated::grid::columns::{Path, SweepGrid};
use smoke_runtime::transport::compensated::grid::route::ordinates;
use smoke_runtime::transport::compensated::grid::scatter::Ordinate;
use smoke_runtime::transport::transfer::cells::Cells;
use std::ops::Range;

/// Mean cosine up to which light is gathered: beyond, the bands of what is scattered again hold too little of the phase
/// function.
const LARGEST_G: f32 = 0.75;
/// Rings of the directions, which have twice as many each; with 8 an image has the same error.
const RINGS: usize = 6;
/// How much of what is sent on to be gathered last is the photons'; the rest was gathered from them before.
const PHOTONS_SHARE: f32 = 0.5;

/// What light is gathered through: one frame and medium.
pub struct FinalGather<'a> {
    field: &'a DensityField,
    cells: &'a Cells,
    basis: &'a LightBasis,
    medium: GreyMedium,
    bands: usize,
    /// The whole field.
    voxels: SweepGrid,
    /// One node a cell, with a border: the mean density.
    grid: SweepGrid,
    ordinates: Vec<Ordinate>,
    paths: Vec<Path>,
    /// `1 - T` towards each ordinate, the mean over each cell's density: `[cell][ordinate]`.
    opacity: Vec<f32>,
    /// The cells of each slice across x, y, z.
    slices: [Vec<Vec<Placed>>; 3],
}

/// The first scattering of one light.
struct First {
    /// Mean transmittance of its directions to each cell.
    reaches: Vec<f32>,
    /// What a cell sends of it towards each ordinate: albedo, phase function and the light's solid angle.
    phase: Vec<f32>,
}

/// Lights that go together.
struct Block {
    /// Transmittance to each cell.
    reaches: Vec<Lanes>,
    /// What is sent of it towards each ordinate.
    phase: Vec<Lanes>,
    /// What a cell sends of light that was scattered before: `[cell][l (l + 1) + m]`.
    again: Vec<Lanes>,
    /// What is gathered: `[cell][l (l + 1) + m]`.
    gathered: Vec<Lanes>,
}

impl<'a> FinalGather<'a> {
    /// For moments of `bands` bands; none where the photons' own are better: at large `|g|`, for bases whose lights
    /// come from everywhere, and in smoke that scatters nothing.
    pub fn new(
        field: &'a DensityField,
        cells: &'a Cells,
        basis: &'a LightBasis,
        medium: GreyMedium,
        bands: usize,
    ) -> Option<Self> {
        let is_local = !matches!(basis.kind(), BasisKind::Harmonics(_));
        let scatters = medium.albedo > 0.0 && medium.sigma_t > 0.0 && !cells.is_empty();
        if !(is_local && scatters && medium.g.abs() <= LARGEST_G) {
            return None;
        }
        let side = f64::from(1u32 << cells.shift);
        let to_middle = DAffine3::from_scale(DVec3::splat(side)) * DAffine3::from_translation(DVec3::splat(0.5));
        let world_from_cell = field.world_from_node * to_middle;
        let volume = world_from_cell.matrix3.determinant().abs();
        let mut density = vec![0.0f32; cells.places.len()];
        for (&brick, mass) in cells.bricks.iter().zip(&cells.mass) {
            density[brick as usize] = (mass / volume) as f32;
        }
        let coarse = DensityField::from_box([0; 3], cells.majorants.bricks, &density, world_from_cell);
        let (voxels, grid) = (SweepGrid::new(field), SweepGrid::new(&coarse));
        let ordinates = ordinates(RINGS, bands);
        let paths = ordinates.iter().map(|o| grid.path(o.toward)).collect();
        let slices = [0, 1, 2].map(|axis| of_slices(cells, coarse.dims, axis));
        let opacity = vec![0.0; cells.len() * ordinates.len()];
        let mut gather = Self { field, cells, basis, medium, bands, voxels, grid, ordinates, paths, opacity, slices };
        gather.opacity = gather.opacities();
        Some(gather)
    }

    fn opacities(&self) -> Vec<f32> {
        let toward: Vec<Vec3> = self.ordinates.iter().map(|o| o.toward).collect();
        let mut out = vec![0.0f32; self.cells.len() * toward.len()];
        self.transmittances(&toward, |first, count, means| {
            for (out, means) in out.chunks_exact_mut(toward.len()).zip(means.chunks_exact(count)) {
                out[first..].iter_mut().zip(means).for_each(|(o, t)| *o = 1.0 - t);
            }
        });
        out
    }

    /// Calls `visit(first, count, means)` with the transmittance from `count` directions from `first` on to each cell,
    /// some at a time: `[cell][count]`.
    fn transmittances(&self, toward: &[Vec3], mut visit: impl FnMut(usize, usize, &[f32])) {
        sweeps(&self.voxels, toward, self.medium.sigma_t, |first, planes| {
            visit(first, planes.len(), &self.cells.means(self.field, planes));
        });
    }

    /// Replaces the photons' moments of the lights `wanted`, `[cell][light - wanted.start][l (l + 1) + m]`, by gathered
    /// ones; `done` is told numbers of lights as they are finished.
    pub fn gather(&self, wanted: &Range<usize>, moments: &mut [f32], done: &(dyn Fn(u64) + Sync)) {
        let n = self.bands * self.bands;
        let first = self.first_scattering(wanted);
        let blocks: Vec<Range<usize>> =
            (0..wanted.len()).step_by(LANES).map(|k| k..wanted.len().min(k + LANES)).collect();
        // Blocks of a quarter of the lights at a time take half the bytes of the moments; none reads what another one
        // writes.
        let at_once = (wanted.len() / (4 * LANES)).max(1);
        for blocks in blocks.chunks(at_once) {
            let photons = &*moments;
            let gather = |lights: &Range<usize>| {
                let gathered = self.gather_block(lights, &first, photons);
                done(lights.len() as u64);
                gathered
            };
            let gathered: Vec<Vec<Lanes>> = blocks.par_iter().map(gather).collect();
            moments.par_chunks_exact_mut(wanted.len() * n).enumerate().for_each(|(cell, row)| {
                for (lights, gathered) in blocks.iter().zip(&gathered) {
                    for (lane, k) in lights.clone().enumerate() {
                        let gathered = &gathered[cell * n..][..n];
                        row[k * n..][..n].iter_mut().zip(gathered).for_each(|(v, g)| *v = g[lane]);
                    }
                }
            });
        }
    }

    fn gather_block(&self, lights: &Range<usize>, first: &[First], photons: &[f32]) -> Vec<Lanes> {
        let n = self.bands * self.bands;
        let cells = self.cells.len();
        let none = [0.0; LANES];
        let mut block = Block {
            reaches: vec![none; cells],
            phase: vec![none; self.ordinates.len()],
            again: vec![none; cells * n],
            gathered: vec![none; cells * n],
        };
        for (lane, k) in lights.clone().enumerate() {
            block.reaches.iter_mut().zip(&first[k].reaches).for_each(|(out, v)| out[lane] = *v);
            block.phase.iter_mut().zip(&first[k].phase).for_each(|(out, v)| out[lane] = *v);
        }
        let gains: Vec<f32> = (0..n).map(|lm| self.medium.gain(lm)).collect();
        // The first time what the photons left is sent on, then the mean of that and of what was gathered.
        for share in [1.0, PHOTONS_SHARE] {
            for (cell, row) in photons.chunks_exact(first.len() * n).enumerate() {
                let cell = cell * n..(cell + 1) * n;
                let (again, gathered) = (&mut block.again[cell.clone()], &mut block.gathered[cell]);
                for (lm, (again, gathered)) in again.iter_mut().zip(gathered).enumerate() {
                    for (lane, k) in lights.clone().enumerate() {
                        again[lane] = gains[lm] * (share * row[k * n + lm] + (1.0 - share) * gathered[lane]);
                    }
                    *gathered = none;
                }
            }
            (0..6).for_each(|group| self.sweep(group, &mut block));
        }
        block.gathered
    }

    /// Adds what arrives along the ordinates of one sense (axis and sign).
    fn sweep(&self, group: usize, block: &mut Block) {
        let n = self.bands * self.bands;
        let of_group: Vec<usize> = (0..self.paths.len()).filter(|&o| self.paths[o].group() == group).collect();
        let Some(&one) = of_group.first() else { return };
        let slices = self.paths[one].slices;
        let mut rays: Vec<Rays> = of_group.iter().map(|&o| Rays::new(&self.paths[o])).collect();
        let mut emitted = vec![[0.0; LANES]; slices.columns * slices.rows];
        // Slice by slice, so that its cells are read from memory once for all ordinates.
        for step in 0..slices.count {
            let cells = &self.slices[group / 2][self.paths[one].shift(step).slice];
            for (&o, rays) in of_group.iter().zip(&mut rays) {
                let Ordinate { harmonics, weight, .. } = &self.ordinates[o];
                let Block { reaches, phase, again, gathered } = &mut *block;
                let phase = phase[o];
                let emit = |cell: usize| {
                    let reaches = reaches[cell];
                    let mut sum = [0.0; LANES];
                    for lane in 0..LANES {
                        sum[lane] = phase[lane] * reaches[lane];
                    }
                    for (again, y) in again[cell * n..][..n].iter().zip(harmonics) {
                        for lane in 0..LANES {
                            sum[lane] += y * again[lane];
                        }
                    }
                    sum
                };
                let receive = |cell: usize, arrived: Lanes, opacity: f32| {
                    // Where the rays are empty they carry no radiance either.
                    let scale = weight * (self.opacity[cell * self.ordinates.len() + o] / opacity.max(1e-30));
                    let arrived = arrived.map(|v| scale * v);
                    for (gathered, y) in gathered[cell * n..][..n].iter_mut().zip(harmonics) {
                        for lane in 0..LANES {
                            gathered[lane] += y * arrived[lane];
                        }
                    }
                };
                advance(
                    rays,
                    &self.grid,
                    &self.paths[o],
                    step,
                    self.medium.sigma_t,
                    cells,
                    &mut emitted,
                    emit,
                    receive,
                );
            }
        }
    }

    /// The first scattering of each light, from the directions of a finer mesh that it shines from.
    fn first_scattering(&self, wanted: &Range<usize>) -> Vec<First> {
        let lights = self.basis.mesh();
        let fine = LightBasis::new(BasisKind::Hat(Icosphere::new(lights.level() + 1).directions().len()));
        let directions = fine.mesh().directions();
        // For each direction, the lights that have it, and how much of it.
        let of_direction: Vec<Vec<(usize, f64)>> = directions
            .iter()
            .zip(fine.areas())
            .map(|(&direction, area)| {
                let local = self.basis.local(lights.triangle(direction), direction);
                let each = local.nodes.into_iter().zip(local.values).filter(|(_, value)| *value > 0.0);
                let each = each.filter(|(node, _)| wanted.contains(&(*node as usize)));
                each.map(|(node, value)| (node as usize - wanted.start, area * value)).collect()
            })
            .collect();
        let mut sums = vec![0.0; wanted.len()];
        of_direction.iter().flatten().for_each(|&(k, solid_angle)| sums[k] += solid_angle);
        let none = || First { reaches: vec![0.0; self.cells.len()], phase: vec![0.0; self.ordinates.len()] };
        let mut first: Vec<First> = sums.iter().map(|_| none()).collect();
        let used: Vec<usize> = (0..directions.len()).filter(|&j| !of_direction[j].is_empty()).collect();
        for &j in &used {
            for &(k, solid_angle) in &of_direction[j] {
                // The sum over the finer mesh is nearly the light's solid angle; now it is that.
                let solid_angle = solid_angle * self.basis.areas()[wanted.start + k] / sums[k];
                for (out, o) in first[k].phase.iter_mut().zip(&self.ordinates) {
                    *out += (solid_angle * self.scattered(o.toward.as_dvec3().dot(directions[j]))) as f32;
                }
            }
        }
        let toward: Vec<Vec3> = used.iter().map(|&j| directions[j].as_vec3()).collect();
        self.transmittances(&toward, |start, count, means| {
            first.par_iter_mut().enumerate().for_each(|(k, first)| {
                for (column, &j) in used[start..start + count].iter().enumerate() {
                    for (_, solid_angle) in of_direction[j].iter().filter(|(light, _)| *light == k) {
                        let share = (solid_angle / sums[k]) as f32;
                        let means = means.iter().skip(column).step_by(count);
                        first.reaches.iter_mut().zip(means).for_each(|(out, t)| *out += share * t);
                    }
                }
            });
        });
        first
    }

    /// Albedo times the phase function at a cosine of look directions, up to the degree that the ordinates integrate
    /// exactly.
    fn scattered(&self, cosine: f64) -> f64 {
        let g = f64::from(self.medium.g);
        let (mut sum, mut power, mut before, mut legendre) = (0.0, 1.0, 0.0, 1.0);
        for l in 0..2 * RINGS {
            let degree = l as f64;
            sum += (2.0 * degree + 1.0) * power * legendre;
            power *= g;
            let after = ((2.0 * degree + 1.0) * cosine * legendre - degree * before) / (degree + 1.0);
            (before, legendre) = (legendre, after);
        }
        f64::from(self.medium.albedo) * sum / (4.0 * std::f64::consts::PI)
    }
}

#[cfg(test)]
mod tests {
    use super::super::photons::{PhotonSettings, Photons};
    use super::*;

    const PI4: f64 = 4.0 * std::f64::consts::PI;
    /// The first harmonic.
    const Y: f64 = 0.282_094_791_773_878_14;

    /// A dense half and a thin rest with holes, soft at its edges; sheared.
    fn cloud(n: usize, scale: f64) -> DensityField {
        let value = |v: usize| {
            let [x, y, z] = [v % n, v / n % n, v / n / n].map(|i| (i as f32 + 0.5) / n as f32);
            let edge = [x, y, z].map(|v| (std::f32::consts::PI * v).sin()).iter().product::<f32>();
            let wave = 0.5 + (7.0 * x + 3.0 * y).sin() * (5.0 * z - 2.0 * y).cos();
            edge * (wave + 3.0 / (1.0 + (20.0 * (0.5 - x)).exp())).max(0.0)
        };
        let values: Vec<f32> = (0..n * n * n).map(value).collect();
        let mut world = DAffine3::from_scale(DVec3::splat(scale / n as f64));
        world.matrix3.y_axis += 0.2 * world.matrix3.x_axis;
        DensityField::from_box([0; 3], [n; 3], &values, world)
    }

    fn photons(field: &DensityField, cells: &Cells, basis: &LightBasis, medium: GreyMedium, per_face: u32) -> Vec<f32> {
        let settings = PhotonSettings { per_face, seed: 5, bands: bands(medium), lowest_order: 1 };
        Photons::new(field, cells, basis, medium, settings).trace(0..basis.kind().len(), &|_| ()).0
    }

    fn bands(medium: GreyMedium) -> usize {
        if medium.g == 0.0 { 1 } else { 4 }
    }

    #[test]
    fn white_smoke_stays_white_in_every_cell() {
        for (scale, g, kind) in
            [(0.01, 0.0, BasisKind::Hat(42)), (1.0, 0.0, BasisKind::Discrete(42)), (1.0, 0.6, BasisKind::Hat(42))]
        {
            let field = cloud(12, scale);
            let cells = Cells::new(&field, 1);
            let basis = LightBasis::new(kind);
            let medium = GreyMedium { sigma_t: 1.5, albedo: 1.0, g };
            let gather = FinalGather::new(&field, &cells, &basis, medium, bands(medium)).unwrap();
            let (lights, n) = (kind.len(), bands(medium).pow(2));
            // What photons of all lights would say together without noise: all that does not come straight.
            let first = gather.first_scattering(&(0..lights));
            let mut moments = vec![0.0f32; cells.len() * lights * n];
            let straight = |cell: usize| -> f64 {
                first.iter().zip(basis.areas()).map(|(f, area)| area * f64::from(f.reaches[cell])).sum()
            };
            for (at, row) in moments.chunks_exact_mut(n).enumerate() {
                let (cell, k) = (at / lights, at % lights);
                row[0] = (Y * basis.areas()[k]) as f32 * (1.0 - first[k].reaches[cell]);
            }
            if g != 0.0 {
                // And in the other moments, what takes the direct light's away.
                for cell in 0..cells.len() {
                    for (k, first) in first.iter().enumerate() {
                        let direction = basis.mesh().directions()[k].as_vec3();
                        let y = smoke_runtime::sphere::harmonics::evaluate(bands(medium), direction);
                        let straight = basis.areas()[k] as f32 * first.reaches[cell];
                        let row = &mut moments[(cell * lights + k) * n..][..n];
                        row.iter_mut().zip(y).skip(1).for_each(|(v, y)| *v = -straight * y);
                    }
                }
            }
            gather.gather(&(0..lights), &mut moments, &|_| ());
            for cell in 0..cells.len() {
                let sum: f64 = (0..lights).map(|k| f64::from(moments[(cell * lights + k) * n])).sum();
                let whole = sum / Y + straight(cell);
                // Directions of lights and of rays are different meshes: that is the tolerance.
                let tolerance = if g == 0.0 { 0.01 } else { 0.02 };
                assert!(
                    (whole / PI4 - 1.0).abs() < tolerance,
                    "{kind:?} g {g} scale {scale} cell {cell}: {}",
                    whole / PI4
                );
            }
        }
    }

    #[test]
    fn what_is_gathered_is_what_more_photons_say_with_less_noise() {
        let field = cloud(12, 0.5);
        let cells = Cells::new(&field, 1);
        let basis = LightBasis::new(BasisKind::Hat(42));
        for g in [0.0, 0.5] {
            let medium = GreyMedium { sigma_t: 1.5, albedo: 0.9, g };
            let truth = photons(&field, &cells, &basis, medium, 400);
            let few = photons(&field, &cells, &basis, medium, 4);
            let mut gathered = few.clone();
            FinalGather::new(&field, &cells, &basis, medium, bands(medium)).unwrap().gather(
                &(0..42),
                &mut gathered,
                &|_| (),
            );
            let error = |found: &[f32]| {
                let square = |a: f32, b: f32| f64::from(a - b).powi(2);
                let errors: f64 = found.iter().zip(&truth).map(|(a, b)| square(*a, *b)).sum();
                (errors / truth.iter().map(|v| square(*v, 0.0)).sum::<f64>()).sqrt()
            };
            let mean = |found: &[f32]| found.iter().step_by(bands(medium).pow(2)).map(|v| f64::from(*v)).sum::<f64>();
            let ratio = mean(&gathered) / mean(&truth);
            assert!(error(&gathered) < 0.4 * error(&few), "g {g}: {} {}", error(&few), error(&gathered));
            assert!((ratio - 1.0).abs() < 0.01, "g {g}: {ratio}");
        }
    }

    #[test]
    fn parts_and_threads_give_the_same_bits() {
        let field = cloud(9, 2.0);
        let cells = Cells::new(&field, 1);
        let basis = LightBasis::new(BasisKind::Discrete(42));
        let medium = GreyMedium { sigma_t: 2.0, albedo: 0.8, g: 0.4 };
        let noisy = photons(&field, &cells, &basis, medium, 1);
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut moments = noisy.clone();
                FinalGather::new(&field, &cells, &basis, medium, 4).unwrap().gather(&(0..42), &mut moments, &|_| ());
                moments
            })
        };
        let whole = with(1);
        assert!(whole == with(3));
        let gather = FinalGather::new(&field, &cells, &basis, medium, 4).unwrap();
        for part in [0..5, 5..42] {
            let rows = noisy.chunks(42 * 16).flat_map(|row| &row[16 * part.start..16 * part.end]);
            let mut moments: Vec<f32> = rows.copied().collect();
            gather.gather(&part, &mut moments, &|_| ());
            for (row, whole) in moments.chunks(16 * part.len()).zip(whole.chunks(42 * 16)) {
                assert_eq!(row, &whole[16 * part.start..16 * part.end]);
            }
        }
    }

    #[test]
    fn any_depth_and_size_gives_numbers_and_what_cannot_be_gathered_is_left() {
        let basis = LightBasis::new(BasisKind::Hat(42));
        for (scale, sigma_t) in [(1.0, 1e6), (1.0, 1e-6), (1e6, 1e-6), (1e-6, 1e6), (1e6, 1e6)] {
            let field = cloud(8, scale);
            let cells = Cells::new(&field, 1);
            let medium = GreyMedium { sigma_t, albedo: 1.0, g: 0.0 };
            let mut moments = vec![0.01; cells.len() * 42];
            FinalGather::new(&field, &cells, &basis, medium, 1).unwrap().gather(&(0..42), &mut moments, &|_| ());
            assert!(moments.iter().all(|v| v.is_finite() && (0.0..=1.0).contains(v)), "{scale} {sigma_t}");
        }
        let one = DensityField::from_box([0; 3], [1; 3], &[2.0], DAffine3::IDENTITY);
        let empty = DensityField::from_box([0; 3], [1; 3], &[0.0], DAffine3::IDENTITY);
        let medium = GreyMedium { sigma_t: 1.0, albedo: 0.5, g: 0.0 };
        let harmonics = LightBasis::new(BasisKind::Harmonics(2));
        for (field, basis, medium, is_gathered) in [
            (&one, &basis, medium, true),
            (&one, &basis, GreyMedium { g: 0.9, ..medium }, false),
            (&one, &basis, GreyMedium { albedo: 0.0, ..medium }, false),
            (&one, &basis, GreyMedium { sigma_t: 0.0, ..medium }, false),
            (&one, &harmonics, medium, false),
            (&empty, &basis, medium, false),
        ] {
            let cells = Cells::new(field, 1);
            assert_eq!(FinalGather::new(field, &cells, basis, medium, 1).is_some(), is_gathered);
        }
    }
}
