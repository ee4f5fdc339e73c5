//! Single scattering on a grid: every beam swept once through the density.
//!
//! `J_lm(x) = sum over beams  albedo g^l E y_lm(w) exp(-sigma_t t(x, w))` in look convention: w points to the light,
//! t is the integral of density from x towards it (Zhou et al. 2008, Eq. 3, with the optical depth of the true density
//! in place of that of the Gaussians, and without the detour over spherical harmonics of depth). Transmittance is
//! exponentiated at each node, so it lies in [0, 1] at any optical depth.
//! The optical depth is the trapezoidal sum along each ray, which is exact for the trilinear density up to the bilinear
//! bend inside a cell. Cost: about (25 + 2 coefficients) operations a node and beam.

use super::columns::{Path, Shift, Slices, SweepGrid, add_turned, stencil};
use crate::lanes::exp_neg;
use crate::light::Beam;
use multiversion::multiversion;
use rayon::prelude::*;

/// What one beam adds to each coefficient of the source radiance, per unit of transmittance: `[coefficient][channel]`.
pub struct WeightedBeam {
    /// The beam's direction, to the light.
    pub beam: Beam,
    /// `albedo g^l E y_lm`.
    pub weights: Vec<[f32; 3]>,
}

/// The beams that one task sweeps together: they cross the slices in the same order.
struct Bundle<'a> {
    slices: Slices,
    beams: Vec<(&'a WeightedBeam, Path)>,
}

/// Source radiance of all beams: planes `[coefficient * 3 + channel]` of one value a node, x fastest.
///
/// `sigma_t` is extinction per unit density and world length, per channel. The sum over beams is taken in an order that
/// depends on the beams alone, so the result does not depend on the number of threads.
pub fn single_scattering(grid: &SweepGrid, beams: &[WeightedBeam], sigma_t: [f32; 3]) -> Vec<Vec<f32>> {
    let planes = beams.first().map_or(3, |b| b.weights.len() * 3);
    let parts: Vec<(bool, Vec<Vec<f32>>)> = bundles(grid, beams)
        .into_par_iter()
        .map(|bundle| {
            let mut out = vec![vec![0.0; grid.len()]; planes];
            sweep(grid, &bundle, sigma_t, &mut out);
            (bundle.slices.turned, out)
        })
        .collect();
    let mut total = vec![vec![0.0; grid.len()]; planes];
    total.par_iter_mut().enumerate().for_each(|(plane, sum)| {
        for (turned, part) in &parts {
            if *turned {
                add_turned(sum, &part[plane], grid.dims);
            } else {
                sum.iter_mut().zip(&part[plane]).for_each(|(s, p)| *s += p);
            }
        }
    });
    total
}

/// Beams that share an axis and a sense, in groups of at most an eighth of all (so that eight threads have work).
fn bundles<'a>(grid: &SweepGrid, beams: &'a [WeightedBeam]) -> Vec<Bundle<'a>> {
    let most = beams.len().div_ceil(8).max(1);
    let mut groups: [Vec<(&WeightedBeam, Path)>; 6] = Default::default();
    for beam in beams {
        let path = grid.path(beam.beam.toward);
        groups[path.group()].push((beam, path));
    }
    let chunk = |group: &Vec<(&'a WeightedBeam, Path)>| -> Vec<Bundle<'a>> {
        group.chunks(most).map(|beams| Bundle { slices: beams[0].1.slices, beams: beams.to_vec() }).collect()
    };
    groups.iter().flat_map(chunk).collect()
}

/// The rays of one beam: optical depth (of density) so far, and the density where they last met a slice.
struct Rays {
    depth: Vec<f32>,
    density: Vec<f32>,
}

fn sweep(grid: &SweepGrid, bundle: &Bundle, sigma_t: [f32; 3], out: &mut [Vec<f32>]) {
    let slices = &bundle.slices;
    let density = grid.density(slices);
    let mut rays: Vec<Rays> = bundle
        .beams
        .iter()
        .map(|(_, path)| {
            let len = path.extent[0] * path.extent[1];
            Rays { depth: vec![0.0; len], density: vec![0.0; len] }
        })
        .collect();
    let mut tau = vec![0.0; slices.columns];
    for step in 0..slices.count {
        for ((beam, path), rays) in bundle.beams.iter().zip(&mut rays) {
            let shift = path.shift(step);
            advance(rays, path, &shift, density);
            deposit(rays, path, &shift, sigma_t, &beam.weights, &mut tau, out);
        }
    }
}

/// Carries every ray from the slice before to this one.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn advance(rays: &mut Rays, path: &Path, shift: &Shift, density: &[f32]) {
    let slices = &path.slices;
    let weights = shift.ray_weights();
    let half = 0.5 * path.length;
    let n = slices.columns - 1;
    let mut met = [0.0; 256];
    for row in 0..slices.rows - 1 {
        let start = (shift.base[1] + row + 1) * path.extent[0] + shift.base[0] + 1;
        let low = &density[slices.row(shift.slice, row)..][..slices.columns];
        let high = &density[slices.row(shift.slice, row + 1)..][..slices.columns];
        for block in (0..n).step_by(256) {
            let len = (n - block).min(256);
            let met = &mut met[..len];
            stencil(met, &low[block..], &high[block..], weights);
            let depth = &mut rays.depth[start + block..][..len];
            let before = &mut rays.density[start + block..][..len];
            for c in 0..len {
                depth[c] += half * (before[c] + met[c]);
                before[c] = met[c];
            }
        }
    }
}

/// Adds the light that reaches each node of this slice.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn deposit(
    rays: &Rays,
    path: &Path,
    shift: &Shift,
    sigma_t: [f32; 3],
    weights: &[[f32; 3]],
    tau: &mut [f32],
    out: &mut [Vec<f32>],
) {
    let slices = &path.slices;
    let around = shift.node_weights();
    let n = slices.columns;
    let grey = sigma_t[0] == sigma_t[1] && sigma_t[0] == sigma_t[2];
    for row in 0..slices.rows {
        let low = &rays.depth[(shift.base[1] + row) * path.extent[0] + shift.base[0]..][..n + 1];
        let high = &rays.depth[(shift.base[1] + row + 1) * path.extent[0] + shift.base[0]..][..n + 1];
        let target = slices.row(shift.slice, row);
        for channel in 0..3 {
            if channel == 0 || !grey {
                let tau = &mut tau[..n];
                stencil(tau, low, high, around);
                let sigma = sigma_t[channel];
                tau.iter_mut().for_each(|t| *t = exp_neg(sigma * *t));
            }
            for (coefficient, weight) in weights.iter().enumerate() {
                let weight = weight[channel];
                let plane = &mut out[coefficient * 3 + channel][target..][..n];
                plane.iter_mut().zip(&tau[..n]).for_each(|(p, t)| *p += weight * t);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::medium::field::DensityField;
    use glam::{DAffine3, DMat3, DVec3, Vec3};

    /// A Gaussian blob of radius 5 voxels in a 24-cube, in a sheared and stretched world.
    fn blob() -> DensityField {
        let n = 24;
        let value = |v: usize| {
            let p = Vec3::new((v % n) as f32, (v / n % n) as f32, (v / n / n) as f32) - 11.5;
            (-(p / 5.0).length_squared()).exp()
        };
        let values: Vec<f32> = (0..n * n * n).map(value).collect();
        let map = DMat3::from_cols_array(&[0.2, 0.02, 0.0, 0.0, 0.25, 0.05, 0.03, 0.0, 0.15]);
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_mat3(map))
    }

    fn transmittance(field: &DensityField, node: Vec3, toward: Vec3, sigma: f64) -> f64 {
        let direction = field.world_from_node.matrix3.inverse() * toward.as_dvec3();
        let (mut depth, ds) = (0.0, 2e-3);
        for step in 0..6000 {
            let p = node.as_dvec3() + direction * ((f64::from(step) + 0.5) * ds);
            depth += f64::from(field.sample(p.as_vec3())) * ds;
        }
        (-sigma * depth).exp()
    }

    #[test]
    fn every_beam_reaches_every_node_as_a_ray_marched_there_does() {
        let field = blob();
        let grid = SweepGrid::new(&field);
        for d in 0..24 {
            let (z, a) = (1.0 - (d as f32 + 0.5) / 12.0, d as f32 * 2.4);
            let toward = Vec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let beam = WeightedBeam { beam: Beam { toward, irradiance: [1.0; 3] }, weights: vec![[1.0, 2.0, 3.0]] };
            let planes = single_scattering(&grid, &[beam], [1.5, 1.5, 3.0]);
            for node in [[13usize, 12, 11], [4, 20, 9], [1, 1, 1], [25, 14, 3]] {
                let v = node[0] + field.dims[0] * (node[1] + field.dims[1] * node[2]);
                let position = Vec3::new(node[0] as f32, node[1] as f32, node[2] as f32);
                let truth = [1.5, 1.5, 3.0].map(|s| transmittance(&field, position, toward, s));
                for c in 0..3 {
                    let found = f64::from(planes[c][v]) / (c + 1) as f64;
                    // The density's relative curvature is at most 0.08 a voxel along each axis: read between nodes it
                    // errs by 1/8 of that for each of two axes (2 %), and trapezoids of up to sqrt 3 voxels by 3/12 of it
                    // (2 %), of the depth; in the tail, cut at the box, the curvature is ten times that and the depth 0.02.
                    let depth = -truth[c].ln();
                    assert!(
                        (found / truth[c]).ln().abs() < 0.04 * depth + 4e-3,
                        "{toward} {node:?} {found} {}",
                        truth[c]
                    );
                }
            }
        }
    }

    #[test]
    fn transmittance_stays_in_zero_to_one_at_any_optical_depth() {
        let grid = SweepGrid::new(&blob());
        let beam = |e: f32| WeightedBeam {
            beam: Beam { toward: Vec3::new(0.6, 0.0, 0.8), irradiance: [e; 3] },
            weights: vec![[e; 3]],
        };
        for sigma in [0.0, 1e-6, 1.0, 1e3, 1e6, 1e30] {
            let planes = single_scattering(&grid, &[beam(1.0)], [sigma; 3]);
            assert!(planes.iter().flatten().all(|t| (0.0..=1.0).contains(t)), "sigma_t {sigma}");
        }
        assert!(single_scattering(&grid, &[], [1.0; 3]).iter().flatten().all(|&j| j == 0.0));
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let grid = SweepGrid::new(&blob());
        let beams: Vec<WeightedBeam> = (0..17)
            .map(|d| {
                let toward =
                    DVec3::new((d as f64).sin(), (d as f64 * 1.7).cos(), (d as f64 * 0.3).sin()).normalize().as_vec3();
                WeightedBeam { beam: Beam { toward, irradiance: [1.0; 3] }, weights: vec![[0.1 + d as f32; 3]] }
            })
            .collect();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| single_scattering(&grid, &beams, [2.0; 3]))
        };
        assert!(with(1) == with(3));
    }
}
