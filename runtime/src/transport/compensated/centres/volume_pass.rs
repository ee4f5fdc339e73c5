//! From the centres to voxels: `J(x, w_o) = sum_h w_h B_h(x) J_h(w_o) / sum_h w_h B_h(x)` on a box of voxels.
//!
//! Gaussians are cut at 3 radii and separable: one exponential per row end, then multiplications. The look direction w_o
//! at a voxel points from the eye to it. Where only band 0 is there, or the view is parallel, three sums a voxel serve;
//! else the 3 order^2 harmonics are summed and evaluated once a voxel.
//! Where no Gaussian reaches (sum < 1e-10 of the largest weight) the paper drops the smoke; we take the Gaussian that
//! dominates the sum of untruncated tails (least q - ln w) at the middle of the voxel's brick of 8^3.
//!
//! Cost: (1 + planes) multiplications-additions for each voxel of a support, 2.4e8 r^3 voxels a Gaussian at 128^3; planes
//! is 3, or 3 order^2 for an eye near an anisotropic medium.
//! Source: Zhou et al. 2008, section 5.5, equations 7 and 14 (without the density factor, which the march applies).

use multiversion::multiversion;
use rayon::prelude::*;
use smoke_formats::gaussian::UnitSpace;

use crate::medium::gaussian_points::GaussianPoints;
use crate::sphere::harmonics::{MAX_COEFFICIENTS, evaluate};
use crate::transport::compensated::centres::decay::decay;
use crate::transport::compensated::centres::single::CentreRadiance;

/// Radii after which a Gaussian ends.
const CUT: f32 = 3.0;
/// Sums below this, relative to the largest weight, count as uncovered.
const COVERED: f32 = 1e-10;
/// Side of the bricks that share one nearest Gaussian.
const BRICK: usize = 8;

/// From where the smoke is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ViewDirections {
    /// An eye at this point, unit space.
    Eye([f32; 3]),
    /// The same unit direction everywhere, from the eye into the scene.
    Parallel([f32; 3]),
}

/// Source radiance at the voxels `origin .. origin + dims` of `space`, x fastest; never negative.
///
/// A coarser grid is a `space` with a larger scale. Without Gaussians everything is zero.
pub fn volume_pass(
    points: &GaussianPoints,
    radiance: &CentreRadiance,
    space: &UnitSpace,
    origin: [i32; 3],
    dims: [usize; 3],
    view: ViewDirections,
) -> Vec<[f32; 3]> {
    let bands = radiance.order * radiance.order;
    let mut out = vec![[0.0; 3]; dims[0] * dims[1] * dims[2]];
    if points.is_empty() || out.is_empty() {
        return out;
    }
    // What is interpolated, per Gaussian: harmonics for an eye, else radiance along the one direction.
    let (stride, sources): (usize, Vec<[f32; 3]>) = match view {
        ViewDirections::Eye(_) if !radiance.is_even() => (bands, radiance.coefficients.clone()),
        _ => {
            let direction = if let ViewDirections::Parallel(d) = view { d } else { [0.0, 0.0, 1.0] };
            let y = evaluate(radiance.order, direction.into());
            (1, radiance.coefficients.chunks_exact(bands).map(|j| along(j, &y)).collect())
        }
    };
    let axes = axes(space, origin, dims);
    out.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(k, out)| {
        let (density, planes) = interpolate(points, &sources, stride, &axes, k);
        let mut nearest = vec![usize::MAX; dims[0].div_ceil(BRICK) * dims[1].div_ceil(BRICK)];
        let mut mixed = vec![[0.0; 3]; stride];
        for (v, out) in out.iter_mut().enumerate() {
            let (i, j) = (v % dims[0], v / dims[0]);
            if density[v] >= COVERED {
                let inverse = 1.0 / density[v];
                for (s, mixed) in mixed.iter_mut().enumerate() {
                    *mixed = std::array::from_fn(|c| planes[3 * s + c][v] * inverse);
                }
            } else {
                let brick = i / BRICK + dims[0].div_ceil(BRICK) * (j / BRICK);
                if nearest[brick] == usize::MAX {
                    nearest[brick] = dominant(points, middle(&axes, [i, j, k]));
                }
                mixed.copy_from_slice(&sources[nearest[brick] * stride..(nearest[brick] + 1) * stride]);
            }
            let value = match view {
                ViewDirections::Eye(eye) if stride > 1 => {
                    let to = glam::Vec3::new(axes[0][i] - eye[0], axes[1][j] - eye[1], axes[2][k] - eye[2]);
                    // At the eye itself every direction is as good as another.
                    along(&mixed, &evaluate(radiance.order, to.try_normalize().unwrap_or(glam::Vec3::Z)))
                }
                _ => mixed[0],
            };
            *out = value.map(|v| v.max(0.0));
        }
    });
    out
}

/// Unit coordinates of the voxels `origin .. origin + dims` of `space`, axis by axis.
pub fn axes(space: &UnitSpace, origin: [i32; 3], dims: [usize; 3]) -> [Vec<f32>; 3] {
    std::array::from_fn(|a| (0..dims[a]).map(|i| space.coordinate(a, origin[a].saturating_add(i as i32))).collect())
}

fn along(coefficients: &[[f32; 3]], y: &[f32; MAX_COEFFICIENTS]) -> [f32; 3] {
    let mut sum = [0.0f32; 3];
    for (j, y) in coefficients.iter().zip(y) {
        (0..3).for_each(|c| sum[c] += j[c] * y);
    }
    sum
}

/// Middle of the brick of a voxel.
fn middle(axes: &[Vec<f32>; 3], voxel: [usize; 3]) -> [f32; 3] {
    std::array::from_fn(|a| {
        let first = voxel[a] / BRICK * BRICK;
        0.5 * (axes[a][first] + axes[a][(first + BRICK - 1).min(axes[a].len() - 1)])
    })
}

/// The Gaussian with the largest untruncated term at a point.
fn dominant(points: &GaussianPoints, at: [f32; 3]) -> usize {
    let (mut best, mut least) = (0, f32::INFINITY);
    for h in 0..points.len() {
        let q: f32 = (0..3).map(|a| ((at[a] - points.center[a][h]) / points.radius[h]).powi(2)).sum();
        let value = q - points.weight[h].ln();
        if value < least {
            (best, least) = (h, value);
        }
    }
    best
}

/// Sums of `w B` and `w B source` in slab `k`: the density, and the planes `3 s + channel`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn interpolate(
    points: &GaussianPoints,
    sources: &[[f32; 3]],
    stride: usize,
    axes: &[Vec<f32>; 3],
    k: usize,
) -> (Vec<f32>, Vec<Vec<f32>>) {
    let nx = axes[0].len();
    let mut density = vec![0.0f32; nx * axes[1].len()];
    let mut planes = vec![vec![0.0f32; density.len()]; 3 * stride];
    let mut row = vec![0.0f32; nx];
    for h in 0..points.len() {
        let ([cx, cy, cz], radius, weight) = (points.center_of(h), points.radius[h], points.weight[h]);
        let dz = (axes[2][k] - cz) / radius;
        if dz.abs() > CUT || weight == 0.0 {
            continue;
        }
        let reach = radius * (CUT * CUT - dz * dz).max(0.0).sqrt();
        let range = |axis: &[f32], c: f32, reach: f32| {
            axis.partition_point(|&x| x < c - reach)..axis.partition_point(|&x| x <= c + reach)
        };
        let across = range(&axes[0], cx, reach);
        for (value, x) in row[across.clone()].iter_mut().zip(&axes[0][across.clone()]) {
            let d = (x - cx) / radius;
            *value = decay(d * d);
        }
        for j in range(&axes[1], cy, reach) {
            let dy = (axes[1][j] - cy) / radius;
            let half = radius * (CUT * CUT - dz * dz - dy * dy).max(0.0).sqrt();
            let inside = range(&axes[0][across.clone()], cx, half);
            let (from, to) = (across.start + inside.start, across.start + inside.end);
            let scale = weight * decay(dy * dy + dz * dz);
            let row = &row[from..to];
            for (sum, b) in density[j * nx + from..j * nx + to].iter_mut().zip(row) {
                *sum += scale * b;
            }
            for (plane, &source) in planes.iter_mut().zip(sources[h * stride..(h + 1) * stride].as_flattened()) {
                let scale = scale * source;
                for (sum, b) in plane[j * nx + from..j * nx + to].iter_mut().zip(row) {
                    *sum += scale * b;
                }
            }
        }
    }
    (density, planes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::compensated::centres::testing::{Pcg, cloud, points};
    use smoke_formats::gaussian::Gaussian;

    fn random(n: usize, order: usize) -> CentreRadiance {
        let mut pcg = Pcg::new(8);
        let coefficients = (0..n * order * order)
            .map(|k| {
                let mean = if k % (order * order) == 0 { 4.0 } else { 0.0 };
                [(); 3].map(|()| (mean + pcg.uniform() - 0.5) as f32)
            })
            .collect();
        CentreRadiance { order, coefficients, sigma_t: [1.0; 3], level: Vec::new() }
    }

    const DIMS: [usize; 3] = [20, 21, 24];

    #[test]
    fn voxels_have_the_weighted_mean_of_the_centres() {
        let gaussians = cloud(40, 41);
        let (set, space) = (points(&gaussians), UnitSpace::of_box([-3, 5, 0], DIMS.map(|d| d as u32)));
        let (eye, parallel) = ([0.4, -2.0, 0.6], [0.0, 0.6, 0.8]);
        for order in [1, 2, 4] {
            let radiance = random(40, order);
            for view in [ViewDirections::Eye(eye), ViewDirections::Parallel(parallel)] {
                let found = volume_pass(&set, &radiance, &space, [-3, 5, 0], DIMS, view);
                let mut covered = 0;
                for (v, found) in found.iter().enumerate() {
                    let index = [v % 20, v / 20 % 21, v / 420];
                    let x: [f32; 3] = std::array::from_fn(|a| space.coordinate(a, [-3, 5, 0][a] + index[a] as i32));
                    let w = match view {
                        ViewDirections::Eye(e) => (glam::Vec3::from(x) - glam::Vec3::from(e)).normalize(),
                        ViewDirections::Parallel(d) => d.into(),
                    };
                    let y = evaluate(order, w);
                    let (mut density, mut sum) = (0.0f64, 0.0f64);
                    for h in 0..40 {
                        let q: f64 = (0..3)
                            .map(|a| (f64::from(x[a] - set.center[a][h]) / f64::from(set.radius[h])).powi(2))
                            .sum();
                        if q <= 9.0 {
                            let term = f64::from(set.weight[h]) * (-q).exp();
                            let j: f32 = (0..order * order)
                                .map(|k| y[k] * radiance.coefficients[h * order * order + k][1])
                                .sum();
                            density += term;
                            sum += term * f64::from(j);
                        }
                    }
                    // Rounding may put a term of 1.2e-4 to either side of the cut: 1.2e-4 / 0.1 of J's spread (< 2).
                    if density > 0.1 {
                        covered += 1;
                        assert!(
                            (f64::from(found[1]) - (sum / density).max(0.0)).abs() < 2.5e-3,
                            "{v}: {found:?} {}",
                            sum / density
                        );
                    }
                }
                assert!(covered > 300, "{covered}");
            }
        }
    }

    #[test]
    fn a_voxel_that_no_gaussian_reaches_takes_the_nearest_one() {
        let at = |x, weight| Gaussian { center: [x, 0.5, 0.5], radius: 0.02, weight };
        let set = points(&[at(0.2, 1.0), at(0.8, 1.0), at(0.5, 0.0)]);
        let mut radiance = random(3, 1);
        radiance.coefficients = vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]];
        let space = UnitSpace::of_box([0; 3], [32; 3]);
        let found = volume_pass(&set, &radiance, &space, [0; 3], [32; 3], ViewDirections::Eye([0.0; 3]));
        let y0 = 0.282_094_8;
        for (v, found) in found.iter().enumerate() {
            let expected = if v % 32 < 16 { 1.0 } else { 4.0 };
            assert!((found[0] - expected * y0).abs() < 1e-5, "{v}: {found:?}");
        }
    }

    #[test]
    fn odd_boxes_and_views_are_served() {
        let (set, space) = (points(&cloud(5, 1)), UnitSpace::of_box([0; 3], [4; 3]));
        let eye = ViewDirections::Eye([space.coordinate(0, 0); 3]);
        assert!(volume_pass(&set, &random(5, 4), &space, [0; 3], [0, 4, 4], eye).is_empty());
        assert!(
            volume_pass(&set, &random(5, 4), &space, [0; 3], [1, 1, 1], eye).iter().flatten().all(|v| v.is_finite())
        );
        let none = volume_pass(&points(&[]), &random(0, 4), &space, [0; 3], [2, 2, 2], eye);
        assert_eq!(none, [[0.0; 3]; 8]);
        let far = volume_pass(&set, &random(5, 4), &space, [i32::MAX - 1; 3], [2, 2, 2], eye);
        assert!(far.iter().flatten().all(|v| v.is_finite() && *v >= 0.0));
    }
}
