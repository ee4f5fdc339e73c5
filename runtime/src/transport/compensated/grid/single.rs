//! Single scattering on a grid: every beam swept once through the density.
//!
//! `J_lm(x) = sum over beams  albedo g^l E y_lm(w) exp(-sigma_t t(x, w))` in look convention: w points to the light,
//! t is the integral of density from x towards it (Zhou et al. 2008, Eq. 3, with the optical depth of the true density
//! in place of that of the Gaussians, and without the detour over spherical harmonics of depth). Transmittance is
//! exponentiated at each node, so it lies in [0, 1] at any optical depth.
//! The optical depth is the trapezoidal sum along each ray, which is exact for the trilinear density up to the bilinear
//! bend inside a cell. Cost: about (25 + 6 coefficients) operations a node near density and beam, and up to 256 MiB.

use super::columns::{Path, Shift, SweepGrid, stencil};
use crate::lanes::exp_neg;
use crate::light::Beam;
use glam::Vec3;
use multiversion::multiversion;
use rayon::prelude::*;

/// What one beam adds to each coefficient of the source radiance, per unit of transmittance.
pub struct WeightedBeam {
    /// The beam's direction, to the light.
    pub beam: Beam,
    /// `albedo g^l E y_lm`, `[coefficient * channels + channel]`.
    pub weights: Vec<f32>,
}

/// Nodes that are summed together.
const LANES: usize = 16;
/// Planes that are summed together.
const GROUP: usize = 6;
/// Bytes of transmittances that are held at a time.
const MOST_BYTES: usize = 256 << 20;

/// Source radiance of all beams at the nodes near density, zero at the others: planes
/// `[coefficient * channels + channel]` of one value a node, x fastest; of no beams, a plane a channel.
///
/// `sigma_t` is extinction per unit density and world length, one for each channel. Beams are summed in their order, so the result
/// does not depend on the number of threads. Beams run in parallel; then nodes do, so that the sums of a few nodes stay in
/// registers while all beams pass by, instead of all planes passing by for each beam.
pub fn single_scattering(grid: &SweepGrid, beams: &[WeightedBeam], sigma_t: &[f32]) -> Vec<Vec<f32>> {
    let [nx, ny, nz] = grid.dims;
    let mut planes = vec![vec![0.0; grid.len()]; beams.first().map_or(sigma_t.len(), |b| b.weights.len())];
    let grey = sigma_t.iter().all(|s| *s == sigma_t[0]);
    let extinctions = if grey { &sigma_t[..1] } else { sigma_t };
    // Rows of transmittances are padded to whole blocks.
    let pitch = nx.next_multiple_of(LANES);
    let field = pitch * ny * nz;
    let most = (MOST_BYTES / (4 * field * extinctions.len())).clamp(8, beams.len().max(8));
    let mut held = vec![vec![0.0; field * extinctions.len()]; most.min(beams.len())];
    for beams in beams.chunks(most) {
        held.par_iter_mut().zip(beams).for_each_init(
            || vec![0.0; grid.len()],
            |turned, (out, beam)| {
                let path = grid.path(beam.beam.toward);
                let fields: Vec<&mut [f32]> = out.chunks_mut(field).collect();
                transmittances(grid, &path, extinctions, fields, pitch, turned);
            },
        );
        let groups = groups(beams, extinctions.len());
        let mut slabs: Vec<Vec<&mut [f32]>> = (0..nz).map(|_| Vec::with_capacity(planes.len())).collect();
        for plane in &mut planes {
            slabs.iter_mut().zip(plane.chunks_mut(nx * ny)).for_each(|(slab, part)| slab.push(part));
        }
        slabs.into_par_iter().enumerate().for_each(|(k, mut slab)| {
            for j in 0..ny {
                let active = grid.active_x(j, k);
                for start in (active.start / LANES * LANES..active.end).step_by(LANES) {
                    let nodes = nx * j + start..nx * j + nx.min(start + LANES);
                    for group in &groups {
                        let at = group.extinction * field + (j + ny * k) * pitch + start;
                        let mut sums = [[0.0f32; LANES]; GROUP];
                        for (sum, &plane) in sums.iter_mut().zip(&group.planes) {
                            sum[..nodes.len()].copy_from_slice(&slab[plane][nodes.clone()]);
                        }
                        add_beams(&held, at, &group.weights, &mut sums);
                        for (sum, &plane) in sums.iter().zip(&group.planes) {
                            slab[plane][nodes.clone()].copy_from_slice(&sum[..nodes.len()]);
                        }
                    }
                }
            }
        });
    }
    planes
}

/// Transmittance to every node near density from each of some directions to the light, unit vectors; zero at the other
/// nodes. `sigma_t` is extinction per unit density and world length.
pub fn transmittance_from(grid: &SweepGrid, toward: &[Vec3], sigma_t: f32) -> Vec<Vec<f32>> {
    let sweep = |turned: &mut Vec<f32>, toward: &Vec3| {
        let mut out = vec![0.0; grid.len()];
        let path = grid.path(*toward);
        transmittances(grid, &path, &[sigma_t], vec![&mut out], grid.dims[0], turned);
        out
    };
    toward.par_iter().map_init(|| vec![0.0; grid.len()], sweep).collect()
}

/// Up to [`GROUP`] planes that need the same transmittances.
struct Group {
    extinction: usize,
    planes: Vec<usize>,
    /// For each beam; zero for planes that are not there.
    weights: Vec<[f32; GROUP]>,
}

fn groups(beams: &[WeightedBeam], extinctions: usize) -> Vec<Group> {
    let planes = beams.first().map_or(0, |b| b.weights.len());
    let group = |extinction: usize, planes: &[usize]| {
        let weight = |beam: &WeightedBeam| {
            let mut weights = [0.0; GROUP];
            weights.iter_mut().zip(planes).for_each(|(w, p)| *w = beam.weights[*p]);
            weights
        };
        Group { extinction, planes: planes.to_vec(), weights: beams.iter().map(weight).collect() }
    };
    let of = |extinction: usize| -> Vec<Group> {
        let own: Vec<usize> = (0..planes).filter(|p| p % extinctions == extinction).collect();
        own.chunks(GROUP).map(|planes| group(extinction, planes)).collect()
    };
    (0..extinctions).flat_map(of).collect()
}

/// Adds all beams, in their order, to the planes of a group in a block of nodes.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_beams(held: &[Vec<f32>], at: usize, weights: &[[f32; GROUP]], sums: &mut [[f32; LANES]; GROUP]) {
    // One variable each, or the compiler vectorises across the planes, with gathers.
    let [mut s0, mut s1, mut s2, mut s3, mut s4, mut s5] = *sums;
    for (held, weights) in held.iter().zip(weights) {
        let Some(t) = held.get(at..).and_then(|h| h.first_chunk::<LANES>()) else { return };
        add_scaled(&mut s0, weights[0], t);
        add_scaled(&mut s1, weights[1], t);
        add_scaled(&mut s2, weights[2], t);
        add_scaled(&mut s3, weights[3], t);
        add_scaled(&mut s4, weights[4], t);
        add_scaled(&mut s5, weights[5], t);
    }
    *sums = [s0, s1, s2, s3, s4, s5];
}

#[inline(always)]
fn add_scaled(sum: &mut [f32; LANES], weight: f32, values: &[f32; LANES]) {
    for lane in 0..LANES {
        sum[lane] += weight * values[lane];
    }
}

/// The rays of one beam: optical depth (of density) so far, and the density where they last met a slice.
struct Rays {
    depth: Vec<f32>,
    density: Vec<f32>,
}

/// Transmittance of one beam to every node near density, for each extinction, in rows of `pitch`. `turned` is scratch.
fn transmittances(
    grid: &SweepGrid,
    path: &Path,
    extinctions: &[f32],
    mut out: Vec<&mut [f32]>,
    pitch: usize,
    turned: &mut [f32],
) {
    let slices = &path.slices;
    let [nx, ny, nz] = grid.dims;
    let density = grid.density(slices);
    for (c, &sigma) in extinctions.iter().enumerate() {
        let len = path.extent[0] * path.extent[1];
        let mut rays = Rays { depth: vec![0.0; len], density: vec![0.0; len] };
        let (target, pitch_here) = if slices.turned { (&mut *turned, ny) } else { (&mut *out[c], pitch) };
        for step in 0..slices.count {
            let shift = path.shift(step);
            advance(grid, &mut rays, path, &shift, density);
            deposit(grid, &rays, path, &shift, sigma, target, pitch_here);
        }
        if slices.turned {
            for k in 0..nz {
                for block in (0..ny).step_by(16) {
                    let rows = block..(block + 16).min(ny);
                    let active = rows.clone().map(|j| grid.active_x(j, k)).filter(|r| !r.is_empty());
                    let (start, end) = active.fold((nx, 0), |(s, e), r| (s.min(r.start), e.max(r.end)));
                    for i in start..end {
                        let source = &turned[ny * (k + nz * i)..];
                        rows.clone().for_each(|j| out[c][(j + ny * k) * pitch + i] = source[j]);
                    }
                }
            }
        }
    }
}

/// Carries every ray from the slice before to this one.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn advance(grid: &SweepGrid, rays: &mut Rays, path: &Path, shift: &Shift, density: &[f32]) {
    let slices = &path.slices;
    let weights = shift.ray_weights();
    let half = 0.5 * path.length;
    let mut met = [0.0; 256];
    for row in 0..slices.rows - 1 {
        let start = (shift.base[1] + row + 1) * path.extent[0] + shift.base[0] + 1;
        let low = &density[slices.row(shift.slice, row)..][..slices.columns];
        let high = &density[slices.row(shift.slice, row + 1)..][..slices.columns];
        let active = grid.active_rays(slices, shift.slice, row);
        for block in active.clone().step_by(256) {
            let len = (active.end - block).min(256);
            let met = &mut met[..len];
            stencil(met, &low[block..], &high[block..], weights);
            let depth = &mut rays.depth[start + block..][..len];
            let before = &mut rays.density[start + block..][..len];
            for c in 0..len {
                depth[c] += half * (before[c] + met[c]);
            }
            before.copy_from_slice(met);
        }
    }
}

/// Writes the transmittance of the nodes of this slice.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn deposit(grid: &SweepGrid, rays: &Rays, path: &Path, shift: &Shift, sigma: f32, out: &mut [f32], pitch: usize) {
    let slices = &path.slices;
    let around = shift.node_weights();
    for row in 0..slices.rows {
        let active = grid.active(slices, shift.slice, row);
        if active.is_empty() {
            continue;
        }
        let start = (shift.base[1] + row) * path.extent[0] + shift.base[0] + active.start;
        let (low, high) = (&rays.depth[start..], &rays.depth[start + path.extent[0]..]);
        let target = slices.row(shift.slice, row) / slices.columns * pitch + active.start;
        let out = &mut out[target..][..active.len()];
        stencil(out, low, high, around);
        out.iter_mut().for_each(|t| *t = exp_neg(sigma * *t));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::medium::field::DensityField;
    use glam::{DAffine3, DMat3, DVec3};

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
            let beam = WeightedBeam { beam: Beam { toward, irradiance: [1.0; 3] }, weights: vec![1.0, 2.0, 3.0] };
            let planes = single_scattering(&grid, &[beam], &[1.5, 1.5, 3.0]);
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
            weights: vec![e; 3],
        };
        for sigma in [0.0, 1e-6, 1.0, 1e3, 1e6, 1e30] {
            let planes = single_scattering(&grid, &[beam(1.0)], &[sigma; 3]);
            assert!(planes.iter().flatten().all(|t| (0.0..=1.0).contains(t)), "sigma_t {sigma}");
        }
        assert!(single_scattering(&grid, &[], &[1.0; 3]).iter().flatten().all(|&j| j == 0.0));
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let grid = SweepGrid::new(&blob());
        let beams: Vec<WeightedBeam> = (0..17)
            .map(|d| {
                let toward =
                    DVec3::new((d as f64).sin(), (d as f64 * 1.7).cos(), (d as f64 * 0.3).sin()).normalize().as_vec3();
                WeightedBeam { beam: Beam { toward, irradiance: [1.0; 3] }, weights: vec![0.1 + d as f32; 3] }
            })
            .collect();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| single_scattering(&grid, &beams, &[2.0; 3]))
        };
        assert!(with(1) == with(3));
    }
}
