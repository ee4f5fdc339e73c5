//! Multiple scattering on a grid: the integral transport equation, swept along discrete directions.
//!
//! With J the source radiance, in spherical harmonics at the nodes, `J = J_ss + F K J`: `K` gathers along each
//! direction w `L(x, w) = int exp(-sigma_t t) sigma_t D J(x + s w, w) ds` and projects it, `F = diag(albedo g^l)`
//! scatters it again. This is the integral-transport system that replaces the diffusion of Zhou et al. 2008, section
//! 5.4, on grid nodes in place of the Gaussians' centres: boundaries and the thin limit are exact, nothing is singular
//! at albedo 1, and a constant J gives exactly `1 - transmittance` along every ray, so the white furnace holds.
//! The matrix is never formed: one product costs one sweep, O(nodes x directions).

use super::columns::{Path, Shift, Slices, SweepGrid, add_turned, stencil, turn};
use crate::lanes::{exp_neg_and_rest, near_share};
use glam::Vec3;
use multiversion::multiversion;
use rayon::prelude::*;

/// One direction of the quadrature over the sphere.
#[derive(Clone, Debug)]
pub struct Ordinate {
    /// Unit look direction, world space.
    pub toward: Vec3,
    /// Solid angle; all of them add up to 4 pi.
    pub weight: f32,
    /// `y_lm(toward)` for the bands that scatter again.
    pub harmonics: Vec<f32>,
}

/// Gathers the radiance that a source radiance sends to every node near density, projected to spherical harmonics:
/// `K J`; zero at the others.
///
/// `source` and the result are planes `[coefficient * channels + channel]` of one value a node, x fastest; `sigma_t` is
/// extinction per unit density and world length, one for each channel.
pub fn gather(grid: &SweepGrid, ordinates: &[Ordinate], sigma_t: &[f32], source: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let turned: Vec<Vec<f32>> = source.par_iter().map(|plane| turn(plane, grid.dims)).collect();
    let paths: Vec<Path> = ordinates.iter().map(|o| grid.path(o.toward)).collect();
    let mut order: Vec<usize> = (0..ordinates.len()).collect();
    order.sort_by_key(|&o| (paths[o].slices.turned, o));
    // Tasks of one layout each, at most an eighth of all, whatever the number of threads.
    let most = ordinates.len().div_ceil(8).max(1);
    let split = order.partition_point(|&o| !paths[o].slices.turned);
    let tasks: Vec<&[usize]> = order[..split].chunks(most).chain(order[split..].chunks(most)).collect();
    let parts: Vec<(bool, Vec<Vec<f32>>)> = tasks
        .into_par_iter()
        .map(|task| {
            let is_turned = paths[task[0]].slices.turned;
            let planes = if is_turned { &turned[..] } else { source };
            let mut out = vec![vec![0.0; grid.len()]; source.len()];
            for &o in task {
                sweep(grid, &paths[o], &ordinates[o], sigma_t, planes, &mut out);
            }
            (is_turned, out)
        })
        .collect();
    let mut total = vec![vec![0.0; grid.len()]; source.len()];
    total.par_iter_mut().enumerate().for_each(|(plane, sum)| {
        for (is_turned, part) in &parts {
            if *is_turned {
                add_turned(sum, &part[plane], grid.dims);
            } else {
                sum.iter_mut().zip(&part[plane]).for_each(|(s, p)| *s += p);
            }
        }
    });
    total
}

/// The rays of one direction: density and source radiance where they last met a slice, and what they carry.
struct Rays {
    /// [`OUTSIDE`] for a ray that has not met the grid yet.
    density: Vec<f32>,
    source: Vec<Vec<f32>>,
    radiance: Vec<Vec<f32>>,
    /// Integral of the density so far.
    depth: Vec<f32>,
    /// `1 - exp(-sigma_t depth)`, per channel: what a source of 1 all along the ray would have sent.
    opacity: Vec<Vec<f32>>,
}

/// Marks a ray that has not met the grid: no density is negative.
const OUTSIDE: f32 = -1.0;

fn sweep(
    grid: &SweepGrid,
    path: &Path,
    ordinate: &Ordinate,
    sigma_t: &[f32],
    planes: &[Vec<f32>],
    out: &mut [Vec<f32>],
) {
    let slices = &path.slices;
    let density = grid.density(slices);
    let rays = || vec![0.0; path.extent[0] * path.extent[1]];
    let each = || sigma_t.iter().map(|_| rays()).collect::<Vec<_>>();
    let mut rays = Rays {
        density: vec![OUTSIDE; path.extent[0] * path.extent[1]],
        source: each(),
        radiance: each(),
        depth: rays(),
        opacity: each(),
    };
    // An isotropic source is read where it lies; another is first summed up for this direction.
    let isotropic = ordinate.harmonics.len() == 1;
    let mut summed = vec![vec![0.0; if isotropic { 0 } else { slices.columns * slices.rows }]; sigma_t.len()];
    for step in 0..slices.count {
        let shift = path.shift(step);
        let source = if isotropic {
            let start = slices.row(shift.slice, 0);
            let stride = slices.row(shift.slice, 1) - start;
            let channels = planes.iter().map(|plane| &plane[start..]).collect();
            SliceSource { channels, stride, scale: ordinate.harmonics[0] }
        } else {
            source_along(grid, slices, shift.slice, &ordinate.harmonics, planes, &mut summed);
            let channels = summed.iter().map(|plane| &plane[..]).collect();
            SliceSource { channels, stride: slices.columns, scale: 1.0 }
        };
        advance(grid, &mut rays, path, &shift, sigma_t, density, &source);
        deposit(grid, &rays, path, &shift, sigma_t, ordinate, out);
    }
}

/// The source radiance of one slice into a sweep's direction: `scale * channels[c][row * stride + column]`.
struct SliceSource<'a> {
    channels: Vec<&'a [f32]>,
    stride: usize,
    scale: f32,
}

/// The source radiance of one slice into the sweep's direction, `sum over lm of J_lm y_lm`, at the nodes that rays with
/// anything to carry will read.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn source_along(
    grid: &SweepGrid,
    slices: &Slices,
    slice: usize,
    harmonics: &[f32],
    planes: &[Vec<f32>],
    out: &mut [Vec<f32>],
) {
    let channels = out.len();
    let n = slices.columns;
    for row in 0..slices.rows {
        // Row r is read by the rays between r - 1 and r and by those between r and r + 1.
        let [above, below] = [row.saturating_sub(1), row.min(slices.rows - 2)];
        let (a, b) = (grid.active_rays(slices, slice, above), grid.active_rays(slices, slice, below));
        let (first, end) = if a.is_empty() || b.is_empty() {
            (a.start.max(b.start), a.end.max(b.end))
        } else {
            (a.start.min(b.start), a.end.max(b.end))
        };
        if a.is_empty() && b.is_empty() {
            continue;
        }
        let range = first.min(n)..(end + 1).min(n);
        let at = slices.row(slice, row);
        for channel in 0..channels {
            let out = &mut out[channel][row * n..][range.clone()];
            for (coefficient, &y) in harmonics.iter().enumerate() {
                let plane = &planes[coefficient * channels + channel][at..][range.clone()];
                if coefficient == 0 {
                    out.iter_mut().zip(plane).for_each(|(o, p)| *o = y * p);
                } else {
                    out.iter_mut().zip(plane).for_each(|(o, p)| *o += y * p);
                }
            }
        }
    }
}

/// Rays a block holds: its scratch rows stay in the first-level cache.
const BLOCK: usize = 128;
/// Rays whose exponentials are taken together; divides [`BLOCK`].
const LANES: usize = 16;

/// Carries every ray from the slice before to this one: `L <- L e^-x + J (1 - e^-x)`, x the optical depth between the
/// slices and J the mean of a source that is linear in optical depth. A plain mean of both ends would be as good for
/// thin cells and wrong for thick ones, where only the near end is seen.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn advance(
    grid: &SweepGrid,
    rays: &mut Rays,
    path: &Path,
    shift: &Shift,
    sigma_t: &[f32],
    density: &[f32],
    slice_source: &SliceSource,
) {
    let slices = &path.slices;
    let weights = shift.ray_weights();
    let source_weights = weights.map(|row| row.map(|w| w * slice_source.scale));
    let half = 0.5 * path.length;
    let grey = sigma_t.iter().all(|s| *s == sigma_t[0]);
    let (mut met, mut depth, mut source, mut entering) = ([0.0; BLOCK], [0.0; BLOCK], [0.0; BLOCK], [false; BLOCK]);
    let (mut kept, mut near, mut far) = ([0.0; BLOCK], [0.0; BLOCK], [0.0; BLOCK]);
    for row in 0..slices.rows - 1 {
        let start = (shift.base[1] + row + 1) * path.extent[0] + shift.base[0] + 1;
        let low = &density[slices.row(shift.slice, row)..][..slices.columns];
        let high = &density[slices.row(shift.slice, row + 1)..][..slices.columns];
        let active = grid.active_rays(slices, shift.slice, row);
        for block in active.clone().step_by(BLOCK) {
            let len = (active.end - block).min(BLOCK);
            stencil(&mut met[..len], &low[block..], &high[block..], weights);
            let before = &mut rays.density[start + block..][..len];
            let total = &mut rays.depth[start + block..][..len];
            for c in 0..len {
                entering[c] = before[c] < 0.0;
                depth[c] = half * (before[c].max(0.0) + met[c]);
                before[c] = met[c];
                total[c] += depth[c];
            }
            for channel in 0..sigma_t.len() {
                if channel == 0 || !grey {
                    let sigma = sigma_t[channel];
                    // Whole vectors: what lies past `len` is scratch of an earlier block, and is not read.
                    for lane in (0..len).step_by(LANES) {
                        for c in lane..lane + LANES {
                            let x = sigma * depth[c];
                            let (through, rest) = exp_neg_and_rest(x);
                            let share = near_share(x, rest);
                            (kept[c], near[c], far[c]) = (through, rest * share, rest - rest * share);
                        }
                    }
                    let opacity = &mut rays.opacity[channel][start + block..][..len];
                    for c in 0..len {
                        opacity[c] = opacity[c] * kept[c] + (near[c] + far[c]);
                    }
                }
                let plane = slice_source.channels[channel];
                let low = &plane[row * slice_source.stride + block..][..len + 1];
                let high = &plane[(row + 1) * slice_source.stride + block..][..len + 1];
                stencil(&mut source[..len], low, high, source_weights);
                let before = &mut rays.source[channel][start + block..][..len];
                let radiance = &mut rays.radiance[channel][start + block..][..len];
                for c in 0..len {
                    // A ray that enters from the side has no source behind it yet: take the one ahead.
                    let behind = if entering[c] { source[c] } else { before[c] };
                    radiance[c] = radiance[c] * kept[c] + behind * far[c] + source[c] * near[c];
                    before[c] = source[c];
                }
            }
        }
    }
}

/// Adds the radiance that reaches each node of this slice to its moments.
///
/// Between rays, optical depth is smoother than what depends on it exponentially. So a node's radiance is that of the
/// rays around it, times what the interpolated depth lets a constant source send over what the rays' own mean sends:
/// then a constant source gives one minus the transmittance that single scattering uses, to rounding.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn deposit(
    grid: &SweepGrid,
    rays: &Rays,
    path: &Path,
    shift: &Shift,
    sigma_t: &[f32],
    ordinate: &Ordinate,
    out: &mut [Vec<f32>],
) {
    let slices = &path.slices;
    let around = shift.node_weights();
    let grey = sigma_t.iter().all(|s| *s == sigma_t[0]);
    let (mut reached, mut factor, mut opacity) = ([0.0; BLOCK], [0.0; BLOCK], [0.0; BLOCK]);
    for row in 0..slices.rows {
        let low = (shift.base[1] + row) * path.extent[0] + shift.base[0];
        let high = low + path.extent[0];
        let target = slices.row(shift.slice, row);
        let active = grid.active(slices, shift.slice, row);
        for block in active.clone().step_by(BLOCK) {
            let len = (active.end - block).min(BLOCK);
            let interpolate = |out: &mut [f32; BLOCK], carried: &[f32]| {
                stencil(&mut out[..len], &carried[low + block..], &carried[high + block..], around);
            };
            for channel in 0..sigma_t.len() {
                if channel == 0 || !grey {
                    interpolate(&mut factor, &rays.depth);
                    interpolate(&mut opacity, &rays.opacity[channel]);
                    let sigma = sigma_t[channel];
                    for lane in (0..len).step_by(LANES) {
                        for c in lane..lane + LANES {
                            let sends = exp_neg_and_rest(sigma * factor[c]).1;
                            // Where the rays are empty they carry no radiance either.
                            factor[c] = sends / opacity[c].max(1e-30);
                        }
                    }
                }
                interpolate(&mut reached, &rays.radiance[channel]);
                for c in 0..len {
                    reached[c] *= factor[c];
                }
                for (coefficient, &y) in ordinate.harmonics.iter().enumerate() {
                    let weight = y * ordinate.weight;
                    let plane = &mut out[coefficient * sigma_t.len() + channel][target + block..][..len];
                    plane.iter_mut().zip(reached.iter()).for_each(|(p, r)| *p += weight * r);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Beam;
    use crate::medium::field::DensityField;
    use crate::sphere::harmonics::evaluate;
    use crate::sphere::quadrature::Directions;
    use crate::transport::compensated::grid::single::{WeightedBeam, single_scattering};
    use glam::DAffine3;

    fn lumps() -> DensityField {
        let values: Vec<f32> = (0..9 * 11 * 10).map(|v| ((v * 7919) % 13) as f32 / 13.0).collect();
        DensityField::from_box([0; 3], [9, 11, 10], &values, DAffine3::IDENTITY)
    }

    fn ordinates(bands: usize) -> Vec<Ordinate> {
        let directions = Directions::product(4, 8);
        let ordinate = |q: usize| {
            let toward = directions.direction(q);
            let harmonics = evaluate(bands, toward)[..bands * bands].to_vec();
            Ordinate { toward, weight: directions.weights[q], harmonics }
        };
        (0..directions.len()).map(ordinate).collect()
    }

    #[test]
    fn a_constant_source_of_one_gathers_exactly_one_minus_transmittance() {
        let grid = SweepGrid::new(&lumps());
        let y0 = evaluate(1, Vec3::Z)[0];
        for sigma in [1e-6, 0.1, 1.0, 50.0, 1e6] {
            // J = 1 in every direction is J_00 = 1 / y_00.
            let gathered = gather(&grid, &ordinates(1), &[sigma; 3], &vec![vec![1.0 / y0; grid.len()]; 3]);
            let weigh = |o: &Ordinate| WeightedBeam {
                beam: Beam { toward: o.toward, irradiance: [1.0; 3] },
                weights: vec![o.weight * y0; 3],
            };
            let beams: Vec<WeightedBeam> = ordinates(1).iter().map(weigh).collect();
            let transmitted = single_scattering(&grid, &beams, &[sigma; 3]);
            for v in 0..grid.len() {
                let all = gathered[1][v] + transmitted[1][v];
                // 1 / y0 = 4 pi y0: light from everywhere. 32 directions of a dozen slices, a few roundings each.
                assert!((all * y0 - 1.0).abs() < 3e-5, "sigma_t {sigma}: {}", all * y0);
            }
        }
    }

    #[test]
    fn a_source_that_shines_one_way_is_gathered_by_looking_against_it() {
        // J = 1 + 1.5 w.x (look convention): what is seen looking along +x is brighter than looking along -x.
        let grid = SweepGrid::new(&lumps());
        let (y0, y1) = (evaluate(1, Vec3::Z)[0], evaluate(2, Vec3::X)[3]);
        let mut source = vec![vec![0.0; grid.len()]; 12];
        source[..3].fill(vec![1.0 / y0; grid.len()]);
        // Projection of 1.5 w.x on y_3 = y1 w.x: 1.5 / y1.
        source[9..].fill(vec![1.5 / y1; grid.len()]);
        let gathered = gather(&grid, &ordinates(2), &[1e4; 3], &source);
        let middle = 5 + 11 * (6 + 13 * 5);
        // Opaque all round: what is gathered in the middle is the source itself.
        assert!((gathered[0][middle] * y0 - 1.0).abs() < 1e-4);
        assert!((gathered[9][middle] * y1 / 1.5 - 1.0).abs() < 1e-4, "{}", gathered[9][middle] * y1);
        assert!(gathered[3][middle].abs() < 1e-4 && gathered[6][middle].abs() < 1e-4);
    }
}
