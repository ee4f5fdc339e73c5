//! Where a first fit starts: Gaussians spread over the density, one for an equal share of it each.
//!
//! The non-zero voxels are put in Morton order, which keeps neighbours together, and cut into n strata of equal
//! `sum D`; each stratum gives one Gaussian at its centroid, with radius 0.7 times the edge of a cube of its volume.
//! All weights then follow from one factor, `<S, D> / <S, S>`: the least-squares best for those centres and radii.
//! Cost: one sort of the occupied voxels, one evaluation.

use super::descent::Bounds;
use super::objective::{Objective, VARIABLES};
use smoke_formats::volume::DensityGrid;

/// Measured: 0.7 starts at the same error as 1.0, costs a third of the voxels, and ends a little lower.
const RADIUS: f64 = 0.7;

/// The bits of `v < 2^21` spread to every third place.
fn spread(v: usize) -> u64 {
    (0..21).fold(0, |code, bit| code | ((v as u64 >> bit) & 1) << (3 * bit))
}

/// Starting variables of at most `n` Gaussians, inside `bounds`, for a grid whose objective exists.
pub fn initial(grid: &DensityGrid, objective: &Objective, n: usize, bounds: &Bounds) -> Vec<f64> {
    let [nx, ny, _] = grid.dims;
    let mut voxels: Vec<(u64, usize)> = (0..grid.len())
        .filter(|&v| grid.values[v] > 0.0)
        .map(|v| (spread(v % nx) | spread(v / nx % ny) << 1 | spread(v / (nx * ny)) << 2, v))
        .collect();
    voxels.sort_unstable();
    let share = |v: usize| f64::from(grid.values[v] / objective.peak());
    let total: f64 = voxels.iter().map(|&(_, v)| share(v)).sum();
    let mut x = Vec::with_capacity(n * VARIABLES);
    let (mut sum, mut at) = (0.0, 0);
    let voxel_volume = objective.lattice().space.scale.powi(3);
    for i in 0..n {
        let end = total * (i + 1) as f64 / n as f64;
        let (mut mass, mut centre, first) = (0.0, [0.0; 3], at);
        while at < voxels.len() && (sum < end || i + 1 == n) {
            let v = voxels[at].1;
            let s = share(v);
            let p = objective.position(v);
            (0..3).for_each(|a| centre[a] += s * p[a]);
            (mass, sum, at) = (mass + s, sum + s, at + 1);
        }
        if at == first {
            continue;
        }
        let volume = (at - first) as f64 * voxel_volume;
        let r = bounds.radius(RADIUS * volume.cbrt());
        let w = voxels[first..at].iter().map(|&(_, v)| f64::from(grid.values[v])).sum::<f64>() / (at - first) as f64;
        let w = w / f64::from(objective.peak());
        x.extend([centre[0] / mass, centre[1] / mass, centre[2] / mass, r, bounds.weight(w)]);
    }
    let (mut sd, mut ss) = (0.0, 0.0);
    objective.errors(&x).visit(|_, e, d| {
        let (e, d) = (f64::from(e), f64::from(d));
        sd += (e + d) * d;
        ss += (e + d) * (e + d);
    });
    let factor = if ss > 0.0 { sd / ss } else { 1.0 };
    x.chunks_mut(VARIABLES).for_each(|g| g[4] = bounds.weight(g[4] * factor));
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::objective::Scope;
    use smoke_formats::gaussian::UnitSpace;
    use smoke_formats::volume::VoxelMask;

    const BOUNDS: Bounds = Bounds { radius: [0.01, 0.5], weight: [0.01, 2.0] };

    fn start(side: usize, n: usize, value: impl Fn([usize; 3]) -> f32) -> (Vec<f64>, Objective) {
        let at = |v: usize| [v % side, v / side % side, v / (side * side)];
        let values: Vec<f32> = (0..side.pow(3)).map(|v| value(at(v))).collect();
        let (active, name) = (VoxelMask::new(values.len()), "density".to_owned());
        let world_from_index = Default::default();
        let grid = DensityGrid { name, origin: [7, -4, 0], dims: [side; 3], values, active, world_from_index };
        let objective = Objective::new(&grid, &UnitSpace::of_box([7, -4, 0], [side as u32; 3]), Scope::Box).unwrap();
        (initial(&grid, &objective, n, &BOUNDS), objective)
    }

    #[test]
    fn a_uniform_cube_gives_its_octants() {
        let (x, _) = start(16, 8, |_| 3.0);
        assert_eq!(x.len(), 8 * VARIABLES);
        for (i, g) in x.chunks(VARIABLES).enumerate() {
            // Morton order: x changes first.
            let centre = [i & 1, i >> 1 & 1, i >> 2].map(|half| 0.25 + 0.5 * half as f64);
            (0..3).for_each(|a| assert!((g[a] - centre[a]).abs() < 1e-12, "{g:?} {centre:?}"));
            assert!((g[3] - RADIUS * 0.5).abs() < 1e-12);
            assert_eq!(g[4], x[4]);
        }
    }

    #[test]
    fn the_common_factor_of_the_weights_is_the_best_one() {
        let (x, objective) = start(16, 20, |[i, j, k]| (1 + i + 2 * j + k * k) as f32);
        // At the least of sum (f S - D)^2 over f, here f = 1, sum e S = 0.
        let (mut es, mut ss) = (0.0, 0.0);
        objective.errors(&x).visit(|_, e, d| {
            let (e, d) = (f64::from(e), f64::from(d));
            es += e * (e + d);
            ss += (e + d) * (e + d);
        });
        assert!(x.chunks(VARIABLES).all(|g| g[4] > BOUNDS.weight[0] && g[4] < BOUNDS.weight[1]));
        // f32 rounds weights and sums by 2^-24 each, in up to 20 terms.
        assert!(es.abs() < 20.0 * 2f64.powi(-24) * ss, "{es} {ss}");
    }

    #[test]
    fn every_gaussian_stands_for_the_same_mass() {
        let value = |[i, j, k]: [usize; 3]| if (i, j) == (3, 3) { 0.0 } else { 1.0 + (i * j * k % 7) as f32 };
        let (x, _) = start(12, 25, value);
        assert_eq!(x.len(), 25 * VARIABLES);
        // r^3 is a stratum's volume, and its mean density is mass over volume: w r^3 is the same for all, but for the
        // last voxel of a stratum, of at most 7.
        let mass: Vec<f64> = x.chunks(VARIABLES).map(|g| g[4] * g[3].powi(3)).collect();
        let mean = mass.iter().sum::<f64>() / 25.0;
        let total: usize = (0..12usize.pow(3))
            .map(|v| [v % 12, v / 12 % 12, v / 144])
            .map(|[i, j, k]| if (i, j) == (3, 3) { 0 } else { 1 + i * j * k % 7 })
            .sum();
        let slack = 7.0 * 25.0 / total as f64;
        assert!(mass.iter().all(|m| (m / mean - 1.0).abs() < slack), "{mass:?}");
    }

    #[test]
    fn fewer_voxels_than_gaussians_give_one_each_and_bounds_are_kept() {
        let (x, _) = start(16, 8, |p| f32::from(u8::from(p == [1, 2, 3] || p == [9, 9, 9])));
        assert_eq!(x.len(), 2 * VARIABLES);
        // 0.7 of a voxel of 1/16 is .044, between the bounds; one voxel at .0625 (9 + .5).
        assert!((x[VARIABLES] - 9.5 / 16.0).abs() < 1e-12);
        assert!((x[3] - 0.7 / 16.0).abs() < 1e-12);
    }
}
