//! Indirect light, order 1 and up: photons of all basis lights at once, from the border of the smoke.
//!
//! *Emission.* Directions are stratified over the triangles of the light's mesh and evenly spread in each; places lie
//! evenly in the box's shadow, so that a photon of direction l carries `A_p(l) Omega / N` for radiance 1, A_p the box's
//! area seen from l: no noise of a cosine (Zhang et al. 2013, section 6.1, draws directions from the whole sphere at
//! each face, 600 times the variance at 642 basis lights). A photon counts for every basis light with `w_k(l) > 0`: one
//! set of paths serves all, with the expectation of a set for each. Weights are signed for harmonics; nothing is
//! clipped.
//!
//! *Flight.* The first collision is placed by the exact depth of the column, so photons that would cross thin smoke are
//! not lost; later ones by null collisions (Woodcock et al. 1965), cell by cell, and by the exact depth where those do
//! not end: in a cell of depth 1e5 whose density falls to nothing there would be thousands. The paper draws a new
//! number in every step while it keeps adding up the depth, which gives a free path that shrinks with the step.
//!
//! *Deposit.* Along every flight after the first collision: `Phi D ds y_lm(-w)`, D at a random point of the flight's
//! piece in each cell, over the cell's mass. That is the mean of the incident radiance's moments over the cell's
//! density (track-length estimator; Spanier and Gelbard 1969), without a kernel to be normalised at borders: constant
//! light and albedo 1 give 4 pi everywhere. The paper deposits absorbed photons only, which gives nothing at albedo 1,
//! and counts light that was not scattered twice. The phase function is applied once a cell: band l times `albedo g^l`.
//! Cost: about 10 look-ups of density a flight, and for each cell on it one addition of 3 to 6 rows of moments.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::sphere::harmonics::{BAND, evaluate};
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::tracking::flight::{Column, Ray, Space, Steps};
use smoke_runtime::tracking::phase;
use smoke_runtime::tracking::sampler::{Random, Strata, mix};
use smoke_runtime::transport::transfer::cells::Cells;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Collisions after which a path is cut; the energy that is left is told.
const LONGEST: u32 = 20_000;
/// Paths of a photon, each from a first collision of its own: to measure a column takes longer than to follow a path.
const PATHS: u32 = 3;
/// Tentative collisions of a flight in one cell that may come to nothing; then the cell's own depth decides.
const PATIENCE: u32 = 16;
/// Share of a path's first weight below which half of the paths end and the others count twice.
const FAINT: f32 = 0.1;
/// Bytes of moments of triangles that wait to be added up.
const WAITING_BYTES: usize = 256 << 20;
/// Groups of triangles that the photons of a global basis are summed in; fixed, so that the sums are the same.
const GLOBAL_GROUPS: usize = 16;

/// What photons fly through: one colour of a medium.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GreyMedium {
    /// Extinction per unit density and world length, >= 0.
    pub sigma_t: f32,
    /// 0 to 1.
    pub albedo: f32,
    /// Henyey–Greenstein mean cosine.
    pub g: f32,
}

impl GreyMedium {
    /// How much of the moment `l (l + 1) + m` of incident light is scattered on: `albedo g^l`.
    pub fn gain(&self, moment: usize) -> f32 {
        self.albedo * self.g.powi(BAND[moment] as i32)
    }
}

/// How many photons, and of what.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotonSettings {
    /// For each face of a voxel on the border of the smoke's box and each basis light; 0 gives no indirect light.
    pub per_face: u32,
    /// Of the random numbers.
    pub seed: u64,
    /// Bands of the moments, 1 to 6.
    pub bands: usize,
    /// Lowest order that is deposited: 1, as light that was not scattered is kept apart; 0 for all of it.
    pub lowest_order: u32,
}

/// What came of the photons.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Traced {
    /// Photons emitted.
    pub photons: u64,
    /// Share of their power that was left where paths were cut.
    pub truncated: f64,
}

/// Photons ready to be traced through one frame.
pub struct Photons<'a> {
    space: Space<'a>,
    cells: &'a Cells,
    basis: &'a LightBasis,
    medium: GreyMedium,
    settings: PhotonSettings,
    /// The box of cells with density: low and high corner, node space.
    corners: [DVec3; 2],
    /// Area vectors of its sides, world space: across x, y, z.
    sides: [DVec3; 3],
    /// Outward sign of each area vector on the high side.
    signs: [f64; 3],
    /// Photons of each triangle.
    counts: Vec<u32>,
}

impl<'a> Photons<'a> {
    /// Plans the photons of each triangle of directions: more where the box's shadow is larger.
    pub fn new(
        field: &'a DensityField,
        cells: &'a Cells,
        basis: &'a LightBasis,
        medium: GreyMedium,
        settings: PhotonSettings,
    ) -> Self {
        let space = Space::new(field, medium.sigma_t);
        let (corners, faces) = active_box(field, cells);
        let edges = [0, 1, 2].map(|a| field.world_from_node.matrix3.col(a) * (corners[1][a] - corners[0][a]));
        let sides = [edges[1].cross(edges[2]), edges[2].cross(edges[0]), edges[0].cross(edges[1])];
        let signs = [0, 1, 2].map(|a| sides[a].dot(edges[a]).signum());
        let mut photons = Self { space, cells, basis, medium, settings, corners, sides, signs, counts: Vec::new() };
        photons.counts = photons.plan(faces);
        photons
    }

    fn plan(&self, faces: u64) -> Vec<u32> {
        let mesh = self.basis.mesh();
        let scatters = self.medium.albedo > 0.0 && self.medium.sigma_t > 0.0 && !self.cells.is_empty();
        // About three local functions are above zero at a direction; every harmonic is.
        let serves = if self.is_global() { self.basis.kind().len() } else { 3 };
        let total = f64::from(self.settings.per_face) * faces as f64 * self.basis.kind().len() as f64 / serves as f64;
        let share = |t: usize| {
            let corners = mesh.triangles()[t].map(|n| mesh.directions()[n as usize]);
            mesh.solid_angle(t) * self.shadow((corners[0] + corners[1] + corners[2]).normalize())
        };
        let shares: Vec<f64> = (0..mesh.triangles().len()).map(share).collect();
        let sum: f64 = shares.iter().sum();
        if !scatters || total == 0.0 || sum <= 0.0 {
            return vec![0; shares.len()];
        }
        shares.iter().map(|s| ((total * s / sum).ceil() as u32).max(1)).collect()
    }

    fn is_global(&self) -> bool {
        matches!(self.basis.kind(), BasisKind::Harmonics(_))
    }

    /// Photons in all.
    pub fn count(&self) -> u64 {
        self.counts.iter().map(|&c| u64::from(c)).sum()
    }

    /// Area of the box seen from direction `toward`, world units.
    fn shadow(&self, toward: DVec3) -> f64 {
        self.sides.iter().map(|side| side.dot(toward).abs()).sum()
    }

    /// Moments of the incident radiance of the basis lights `wanted`: `[cell][light - wanted.start][l (l + 1) + m]`.
    /// `done` is told numbers of photons as they are finished.
    pub fn trace(&self, wanted: Range<usize>, done: &(dyn Fn(u64) + Sync)) -> (Vec<f32>, Traced) {
        let n = self.settings.bands * self.settings.bands;
        let width = wanted.len() * n;
        let mut out = vec![0.0f32; self.cells.len() * width];
        let cut = AtomicU64::new(0);
        let photons = if self.is_global() {
            self.trace_global(&wanted, &mut out, &cut, done)
        } else {
            self.trace_local(&wanted, &mut out, &cut, done)
        };
        out.par_chunks_mut(width.max(1)).zip(&self.cells.mass).for_each(|(row, mass)| {
            let scale = 1.0 / mass;
            row.iter_mut().for_each(|v| *v = (f64::from(*v) * scale) as f32);
        });
        // Weights start at 1; what is cut is counted in millionths of a photon.
        let truncated = cut.load(Ordering::Relaxed) as f64 * 1e-6 / photons.max(1) as f64;
        (out, Traced { photons, truncated })
    }

    fn trace_local(&self, wanted: &Range<usize>, out: &mut [f32], cut: &AtomicU64, done: &(dyn Fn(u64) + Sync)) -> u64 {
        let mesh = self.basis.mesh();
        let n = self.settings.bands * self.settings.bands;
        let slots = if matches!(self.basis.kind(), BasisKind::Hat(_)) { 3 } else { 6 };
        let opposite = mesh.opposite_nodes();
        let nodes = |t: usize| {
            let (near, far) = (mesh.triangles()[t], opposite[t]);
            [near[0], near[1], near[2], far[0], far[1], far[2]].map(|node| node as usize)
        };
        let touches = |t: &usize| self.counts[*t] > 0 && nodes(*t)[..slots].iter().any(|k| wanted.contains(k));
        let triangles: Vec<usize> = (0..mesh.triangles().len()).filter(touches).collect();
        let row = slots * n;
        let batch = (WAITING_BYTES / (4 * row * self.cells.len()).max(1)).clamp(4, 64);
        let width = wanted.len() * n;
        for triangles in triangles.chunks(batch) {
            let parts: Vec<Vec<f32>> = triangles
                .par_iter()
                .map(|&t| {
                    let mut sums = vec![0.0f32; self.cells.len() * row];
                    let mut weights = [0.0f32; 6];
                    self.trace_triangle(t, row, &mut sums, cut, |direction, harmonics, flight| {
                        let local = self.basis.local(t, direction);
                        weights.iter_mut().zip(local.values).for_each(|(w, v)| *w = v as f32);
                        for (slot, weight) in weights[..slots].iter().enumerate() {
                            for (out, y) in flight[slot * n..][..n].iter_mut().zip(harmonics) {
                                *out = weight * y;
                            }
                        }
                    });
                    done(u64::from(self.counts[t]));
                    sums
                })
                .collect();
            out.par_chunks_mut(width.max(1)).enumerate().for_each(|(cell, out)| {
                for (part, &t) in parts.iter().zip(triangles) {
                    for (slot, k) in nodes(t)[..slots].iter().enumerate().filter(|(_, k)| wanted.contains(k)) {
                        let from = &part[cell * row + slot * n..][..n];
                        out[(k - wanted.start) * n..][..n].iter_mut().zip(from).for_each(|(o, v)| *o += v);
                    }
                }
            });
        }
        triangles.iter().map(|&t| u64::from(self.counts[t])).sum()
    }

    fn trace_global(
        &self,
        wanted: &Range<usize>,
        out: &mut [f32],
        cut: &AtomicU64,
        done: &(dyn Fn(u64) + Sync),
    ) -> u64 {
        let n = self.settings.bands * self.settings.bands;
        let width = wanted.len() * n;
        let triangles: Vec<usize> = (0..self.counts.len()).filter(|&t| self.counts[t] > 0).collect();
        let groups: Vec<&[usize]> = triangles.chunks(triangles.len().div_ceil(GLOBAL_GROUPS).max(1)).collect();
        let BasisKind::Harmonics(order) = self.basis.kind() else { return 0 };
        // Two groups at a time: each has the moments of all cells.
        for groups in groups.chunks(2) {
            let parts: Vec<Vec<f32>> = groups
                .par_iter()
                .map(|group| {
                    let mut sums = vec![0.0f32; self.cells.len() * width];
                    for &t in *group {
                        self.trace_triangle(t, width, &mut sums, cut, |direction, harmonics, flight| {
                            let values = evaluate(order, direction.as_vec3());
                            for (k, weight) in wanted.clone().zip(&values[wanted.clone()]) {
                                let out = &mut flight[(k - wanted.start) * n..][..n];
                                out.iter_mut().zip(harmonics).for_each(|(o, y)| *o = weight * y);
                            }
                        });
                        done(u64::from(self.counts[t]));
                    }
                    sums
                })
                .collect();
            for part in parts {
                out.par_chunks_mut(4096).zip(part.par_chunks(4096)).for_each(|(out, part)| {
                    out.iter_mut().zip(part).for_each(|(o, p)| *o += p);
                });
            }
        }
        triangles.iter().map(|&t| u64::from(self.counts[t])).sum()
    }

    /// Adds the photons of one triangle to `sums`, rows of `row` numbers a cell. `spread(toward, harmonics, out)` is
    /// asked once a flight for the row that a flight adds: the weights of the lights for the photon's first direction,
    /// times the harmonics of the flight's.
    fn trace_triangle(
        &self,
        triangle: usize,
        row: usize,
        sums: &mut [f32],
        cut: &AtomicU64,
        mut spread: impl FnMut(DVec3, &[f32], &mut [f32]),
    ) {
        let mesh = self.basis.mesh();
        let corners = mesh.triangles()[triangle].map(|n| mesh.directions()[n as usize]);
        let count = self.counts[triangle];
        let solid_angle = mesh.solid_angle(triangle);
        let seed = mix(self.settings.seed ^ (triangle as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let n = self.settings.bands * self.settings.bands;
        let mut column = Column::default();
        let mut flight = vec![0.0f32; row];
        for index in 0..count {
            let strata = Strata { index, seed };
            let mut random = Random::new(seed ^ mix(u64::from(index) + 1));
            let (toward, jacobian) = direction_in(corners, strata.pair(0));
            let shadow = self.shadow(toward);
            let start = self.place_on_box(toward, shadow, strata.pair(1));
            // A flat triangle is drawn from: solid angle over area goes with the jacobian, whose mean is 1 by design.
            let power = (shadow * solid_angle * jacobian / f64::from(count)) as f32;
            let way = -toward.as_vec3();
            let ray = self.space.ray(start, way);
            let mut fly = |ray: &Ray, way: Vec3, weight: f32, random: &mut Random| {
                let harmonics = evaluate(self.settings.bands, -way);
                spread(toward, &harmonics[..n], &mut flight);
                self.fly(ray, power * weight, &flight, sums, random)
            };
            if self.settings.lowest_order == 0 {
                if let Some(hit) = fly(&ray, way, 1.0, &mut random) {
                    let after = [random.unit(), random.unit()];
                    self.follow(ray.at(hit), way, 1.0, after, &mut random, cut, &mut fly);
                }
                continue;
            }
            column.measure(&self.space, &ray);
            let opacity = -(-f64::from(self.medium.sigma_t) * column.total).exp_m1();
            if opacity <= 0.0 {
                continue;
            }
            let weight = opacity as f32 / PATHS as f32;
            let [u, _] = strata.pair(2);
            for path in 0..PATHS {
                let u = (f64::from(path) + f64::from(u)) / f64::from(PATHS);
                let depth = -(-u * opacity).ln_1p() / f64::from(self.medium.sigma_t);
                let place = ray.at(column.place(&self.space, &ray, depth.min(column.total)));
                self.follow(place, way, weight, strata.pair(3 + path), &mut random, cut, &mut fly);
            }
        }
    }

    /// A path of a `weight` from its first collision on, where it comes along `way`; `after` decides where it goes on,
    /// and `fly(ray, way, weight, random)` flies to the next collision.
    #[expect(clippy::too_many_arguments, reason = "a path's state, and what it is followed with")]
    #[inline(always)]
    fn follow(
        &self,
        mut place: DVec3,
        mut way: Vec3,
        whole: f32,
        after: [f32; 2],
        random: &mut Random,
        cut: &AtomicU64,
        fly: &mut impl FnMut(&Ray, Vec3, f32, &mut Random) -> Option<f64>,
    ) {
        let mut weight = whole;
        for order in 0.. {
            weight *= self.medium.albedo;
            if weight < FAINT * whole {
                if random.unit() < 0.5 {
                    break;
                }
                weight *= 2.0;
            }
            if order == LONGEST {
                cut.fetch_add((f64::from(weight) * 1e6) as u64, Ordering::Relaxed);
                break;
            }
            let u = if order == 0 { after } else { [random.unit(), random.unit()] };
            way = phase::sample(self.medium.g, way, u).0;
            let ray = self.space.ray(place, way);
            match fly(&ray, way, weight, random) {
                Some(hit) => place = ray.at(hit),
                None => break,
            }
        }
    }

    /// A flight to the next collision, or out; each cell on the way gets the row `flight` times the power, the length
    /// in the cell, and the density at a random point of it.
    #[inline(always)]
    fn fly(&self, ray: &Ray, power: f32, flight: &[f32], sums: &mut [f32], random: &mut Random) -> Option<f64> {
        let majorants = &self.cells.majorants;
        let (near, far) = majorants.span(ray.origin, ray.direction)?;
        let mut steps = Steps::new(random);
        let mut hit = None;
        majorants.walk_bricks(ray.origin, ray.direction, near, far, |from, to, brick| {
            let bound = majorants.bounds[brick][1];
            let (rate, per_bound) = (self.medium.sigma_t * bound, 1.0 / bound);
            let (mut t, mut nothing) = (from, 0);
            while let Some(next) = steps.next(t, to, rate) {
                t = next;
                steps.draw(random);
                if random.unit() < self.space.density(ray.at(t)) * per_bound {
                    hit = Some(t);
                    break;
                }
                nothing += 1;
                if nothing == PATIENCE {
                    // What comes after a tentative collision does not depend on what was before it.
                    hit = self.space.collision(ray, t, to, self.medium.sigma_t, &mut steps);
                    break;
                }
            }
            let length = hit.unwrap_or(to) - from;
            let density = self.space.density(ray.at(from + length * f64::from(random.unit())));
            let share = power * density * length as f32;
            if share > 0.0 {
                let row = &mut sums[self.cells.places[brick] as usize * flight.len()..][..flight.len()];
                row.iter_mut().zip(flight).for_each(|(sum, v)| *sum += share * v);
            }
            hit.is_some()
        });
        hit
    }

    /// A place, node space, evenly spread over the box as it is seen from `toward`.
    fn place_on_box(&self, toward: DVec3, shadow: f64, [u, v]: [f32; 2]) -> DVec3 {
        let mut rest = f64::from(u) * shadow;
        let mut axis = 0;
        let mut area = self.sides[0].dot(toward).abs();
        while axis < 2 && rest >= area {
            rest -= area;
            axis += 1;
            area = self.sides[axis].dot(toward).abs();
        }
        let (one, other) = ((axis + 1) % 3, (axis + 2) % 3);
        let [low, high] = self.corners;
        let mut place = low;
        let is_high = self.sides[axis].dot(toward) * self.signs[axis] > 0.0;
        place[axis] = if is_high { high[axis] } else { low[axis] };
        let part = if area > 0.0 { (rest / area).min(1.0) } else { 0.0 };
        place[one] = low[one] + (high[one] - low[one]) * part;
        place[other] = low[other] + (high[other] - low[other]) * f64::from(v);
        place
    }
}

/// A direction spread evenly over the flat triangle, and what its solid angle is over the mean.
fn direction_in([a, b, c]: [DVec3; 3], [u, v]: [f32; 2]) -> (DVec3, f64) {
    let root = f64::from(u).sqrt();
    let (p, q) = (1.0 - root, root * f64::from(v));
    let point = a * p + b * (1.0 - p - q) + c * q;
    // Solid angle per flat area is h / r^3, h the distance of the plane; over its mean, Omega / area.
    let normal = (b - a).cross(c - a);
    let area = 0.5 * normal.length();
    let height = normal.dot(a) / normal.length();
    let omega = 2.0 * a.dot(b.cross(c)).atan2(1.0 + a.dot(b) + b.dot(c) + c.dot(a));
    let r = point.length();
    (point / r, height / (r * r * r) * area / omega)
}

/// Corners of the box of cells with density, node space, and the faces of voxels on its border.
fn active_box(field: &DensityField, cells: &Cells) -> ([DVec3; 2], u64) {
    let [bx, by, _] = cells.majorants.bricks;
    let (mut low, mut high) = ([usize::MAX; 3], [0usize; 3]);
    for (brick, _) in cells.places.iter().enumerate().filter(|(_, p)| **p != u32::MAX) {
        let at = [brick % bx, brick / bx % by, brick / bx / by];
        for a in 0..3 {
            low[a] = low[a].min(at[a]);
            high[a] = high[a].max(at[a] + 1);
        }
    }
    if cells.is_empty() {
        return ([DVec3::ZERO; 2], 0);
    }
    let n = [0, 1, 2].map(|a| (high[a] - low[a]) as u64);
    let side = 1usize << cells.shift;
    let corner = |at: [usize; 3]| DVec3::from_array([0, 1, 2].map(|a| ((at[a] * side).min(field.dims[a] - 1)) as f64));
    ([corner(low), corner(high)], (2 * (n[0] * n[1] + n[1] * n[2] + n[2] * n[0])) << (2 * cells.shift))
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DAffine3;
    use std::f64::consts::PI;

    fn cloud(n: usize, scale: f64) -> DensityField {
        // Uneven on purpose: a dense wall, holes and a thin rest, up to the border of the box.
        let value = |v: usize| {
            let (i, j, k) = (v % n, v / n % n, v / n / n);
            let wave = ((i * 7 + j * 3) as f32 * 0.4).sin() + ((k * 5 + i) as f32 * 0.3).cos();
            if i > n / 2 { 3.0 } else { wave.max(0.0) }
        };
        let values: Vec<f32> = (0..n * n * n).map(value).collect();
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_scale(DVec3::splat(scale / n as f64)))
    }

    /// Density that falls by ten from voxel to voxel: far below its bound in most of a cell.
    fn steep(n: usize) -> DensityField {
        let values: Vec<f32> = (0..n * n * n).map(|v| 0.1f32.powi((v % n) as i32)).collect();
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::IDENTITY)
    }

    fn settings(per_face: u32, lowest_order: u32) -> PhotonSettings {
        PhotonSettings { per_face, seed: 5, bands: 1, lowest_order }
    }

    /// Fluence of constant light of radiance 1 in each cell: the sum over the basis lights of a partition of unity.
    fn fluence(moments: &[f32], lights: usize) -> Vec<f64> {
        let y_00 = 1.0 / (4.0 * PI).sqrt();
        moments.chunks(lights).map(|row| row.iter().map(|&v| f64::from(v)).sum::<f64>() / y_00).collect()
    }

    #[test]
    fn a_white_furnace_has_four_pi_in_every_cell_whatever_the_density_and_g() {
        // In the steep one some fifty tentative collisions a voxel come to nothing: the cell's own depth decides.
        for (kind, g, field, sigma_t) in [
            (BasisKind::Hat(42), 0.0, cloud(12, 1.0), 1.5),
            (BasisKind::Hat(42), 0.85, cloud(12, 4.0), 1.5),
            (BasisKind::Discrete(42), 0.5, cloud(12, 2.0), 1.5),
            (BasisKind::Hat(42), 0.5, steep(8), 50.0),
        ] {
            let cells = Cells::new(&field, 2);
            let basis = LightBasis::new(kind);
            let medium = GreyMedium { sigma_t, albedo: 1.0, g };
            // Independent sets give the noise: mean and standard error of each cell.
            let runs: Vec<Vec<f64>> = (0..12)
                .map(|seed| {
                    let settings = PhotonSettings { seed, ..settings(4, 0) };
                    let (moments, _) =
                        Photons::new(&field, &cells, &basis, medium, settings).trace(0..kind.len(), &|_| ());
                    fluence(&moments, kind.len())
                })
                .collect();
            let mut beyond = 0;
            for cell in 0..cells.len() {
                let values: Vec<f64> = runs.iter().map(|run| run[cell] / (4.0 * PI)).collect();
                let mean = values.iter().sum::<f64>() / 12.0;
                let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 11.0;
                let z = (mean - 1.0) / (variance / 12.0).sqrt();
                // Student's t with 11 degrees of freedom: 99.9 % are within 4.44.
                beyond += usize::from(z.abs() > 4.44);
                assert!((mean - 1.0).abs() < 0.05, "cell {cell}: {mean}");
            }
            assert!(beyond <= 1 + cells.len() / 200, "{kind:?} g {g}: {beyond} of {}", cells.len());
        }
    }

    #[test]
    fn light_that_was_not_scattered_is_what_the_orders_differ_by() {
        // One cell's worth of smoke, thin: order 0 fluence is 4 pi times a transmittance near 1, order 1 is small.
        let field = cloud(8, 0.02);
        let cells = Cells::new(&field, 1);
        let basis = LightBasis::new(BasisKind::Hat(42));
        let medium = GreyMedium { sigma_t: 1.0, albedo: 0.8, g: 0.3 };
        let total = |order| {
            let photons = Photons::new(&field, &cells, &basis, medium, settings(10, order));
            let (moments, _) = photons.trace(0..42, &|_| ());
            let each = fluence(&moments, 42);
            each.iter().zip(&cells.mass).map(|(f, m)| f * m).sum::<f64>() / cells.mass.iter().sum::<f64>() / (4.0 * PI)
        };
        let (all, scattered) = (total(0), total(1));
        assert!((all - 1.0).abs() < 0.03 && scattered > 0.0 && scattered < 0.05, "{all} {scattered}");
    }

    #[test]
    fn parts_of_the_basis_are_the_rows_of_the_whole() {
        let field = cloud(8, 1.0);
        let cells = Cells::new(&field, 1);
        for kind in [BasisKind::Discrete(42), BasisKind::Hat(42), BasisKind::Harmonics(3)] {
            let basis = LightBasis::new(kind);
            let medium = GreyMedium { sigma_t: 2.0, albedo: 0.9, g: 0.4 };
            let settings = PhotonSettings { bands: 2, ..settings(1, 1) };
            let photons = Photons::new(&field, &cells, &basis, medium, settings);
            let whole = photons.trace(0..kind.len(), &|_| ()).0;
            let width = 4 * kind.len();
            for part in [0..5, 5..kind.len()] {
                let rows = photons.trace(part.clone(), &|_| ()).0;
                for (cell, row) in rows.chunks(4 * part.len()).enumerate() {
                    assert_eq!(row, &whole[cell * width + 4 * part.start..][..row.len()], "{kind:?} cell {cell}");
                }
            }
        }
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let field = cloud(8, 1.0);
        let cells = Cells::new(&field, 1);
        for kind in [BasisKind::Hat(42), BasisKind::Harmonics(2)] {
            let basis = LightBasis::new(kind);
            let medium = GreyMedium { sigma_t: 2.0, albedo: 0.9, g: 0.0 };
            let with = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let photons = Photons::new(&field, &cells, &basis, medium, settings(1, 1));
                pool.install(|| photons.trace(0..kind.len(), &|_| ()).0)
            };
            assert!(with(1) == with(3));
        }
    }

    #[test]
    fn no_photons_no_smoke_and_no_scattering_give_zero() {
        let basis = LightBasis::new(BasisKind::Hat(42));
        let medium = GreyMedium { sigma_t: 2.0, albedo: 0.9, g: 0.0 };
        let field = cloud(6, 1.0);
        let cells = Cells::new(&field, 1);
        for (medium, per_face) in
            [(medium, 0), (GreyMedium { albedo: 0.0, ..medium }, 5), (GreyMedium { sigma_t: 0.0, ..medium }, 5)]
        {
            let photons = Photons::new(&field, &cells, &basis, medium, settings(per_face, 1));
            assert_eq!(photons.count(), 0);
            assert!(photons.trace(0..42, &|_| ()).0.iter().all(|v| *v == 0.0));
        }
        let empty = DensityField::from_box([0; 3], [4; 3], &[0.0; 64], DAffine3::IDENTITY);
        let cells = Cells::new(&empty, 1);
        assert!(Photons::new(&empty, &cells, &basis, medium, settings(5, 1)).trace(0..42, &|_| ()).0.is_empty());
    }

    #[test]
    fn a_path_that_never_ends_is_cut_and_told() {
        let field = cloud(6, 1.0);
        let cells = Cells::new(&field, 1);
        let basis = LightBasis::new(BasisKind::Hat(42));
        let medium = GreyMedium { sigma_t: 1e6, albedo: 1.0, g: 0.0 };
        // About 1 in sqrt(20,000) of 2,000 photons is still inside after so many collisions.
        let photons = Photons::new(&field, &cells, &basis, medium, settings(1, 1));
        let (moments, traced) = photons.trace(0..42, &|_| ());
        assert!(moments.iter().all(|v| v.is_finite()) && traced.truncated > 0.0 && traced.truncated < 1.0);
    }

    #[test]
    fn directions_in_a_triangle_have_the_density_that_is_told() {
        let corners = [DVec3::X, DVec3::Y, DVec3::Z];
        let n = 100_000;
        let (mut sum, mut mean) = (0.0, DVec3::ZERO);
        for index in 0..n {
            let (direction, weight) = direction_in(corners, Strata { index, seed: 3 }.pair(0));
            sum += weight;
            mean += direction * weight;
        }
        // Over an octant: weights average to 1, and the mean direction is (1/2, 1/2, 1/2), by symmetry and
        // int z dw = pi / 4 over a solid angle of pi / 2.
        assert!((sum / f64::from(n) - 1.0).abs() < 1e-3, "{}", sum / f64::from(n));
        assert!((mean / f64::from(n) - DVec3::splat(0.5)).length() < 2e-3);
    }
}
