//! How much of a voxel's light is seen from outside: what an error of its row is worth.
//!
//! A voxel of optical depth x that is seen through transmittance T adds `T (1 - e^-x)` of its error to a pixel, so
//! clusters are fitted to rows times `sqrt(mean over directions of T^2) (1 - e^-x)`: the eye may be anywhere. Without
//! it most rows are those of the thin rim and of the inside, which hardly count in any image.
//! Cost: one sweep for each of 42 directions.

use glam::Vec3;
use rayon::prelude::*;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::sphere::icosphere::Icosphere;
use smoke_runtime::transport::compensated::grid::columns::SweepGrid;
use smoke_runtime::transport::compensated::grid::single::transmittance_from;
use smoke_runtime::transport::transfer::cells::{Cells, EMPTY};

/// Least weight over the largest: a row that is hardly seen still has a cluster that is not far off.
const LEAST: f32 = 0.02;

/// What is seen of each node near density of `field`, in order of the field; zero at the others.
pub fn seen_of_nodes(field: &DensityField, sigma_t: f32) -> Vec<f32> {
    let toward: Vec<Vec3> = Icosphere::new(1).directions().iter().map(|d| d.as_vec3()).collect();
    let planes = transmittance_from(&SweepGrid::new(field), &toward, sigma_t);
    let [nx, ny, nz] = field.dims;
    let voxel = field.world_from_node.matrix3.determinant().abs().cbrt();
    let near = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
    let of_node = |at: usize| {
        let square: f32 = planes.iter().map(|plane| plane[at] * plane[at]).sum();
        if square == 0.0 {
            return 0.0;
        }
        // A node without density is read from beside it: the densest of its neighbours counts.
        let mut density = 0.0f32;
        for k in near(at / nx / ny, nz) {
            for j in near(at / nx % ny, ny) {
                for i in near(at % nx, nx) {
                    density = density.max(field.values[i + nx * (j + ny * k)]);
                }
            }
        }
        let depth = f64::from(sigma_t) * f64::from(density) * voxel;
        (square / planes.len() as f32).sqrt() * -(-depth).exp_m1() as f32
    };
    (0..field.values.len()).into_par_iter().map(of_node).collect()
}

/// What is seen of each cell: the most of any of its nodes.
pub fn seen_of_cells(nodes: &[f32], field: &DensityField, cells: &Cells) -> Vec<f32> {
    let [nx, ny, nz] = field.dims;
    let [bx, by, _] = cells.majorants.bricks;
    let mut out = vec![0.0f32; cells.len()];
    for (at, &seen) in nodes.iter().enumerate().filter(|(_, seen)| **seen > 0.0) {
        let node = [at % nx, at / nx % ny, at / nx / ny];
        let [i, j, k] = [0, 1, 2].map(|a| (node[a].min([nx, ny, nz][a] - 2)) >> cells.shift);
        let place = cells.places[i + bx * (j + by * k)];
        if place != EMPTY {
            out[place as usize] = out[place as usize].max(seen);
        }
    }
    out
}

/// Weights as clusters take them: over the largest, and at least [`LEAST`]; 1 where nothing is seen.
pub fn weights(seen: impl IntoIterator<Item = f32>) -> Vec<f32> {
    let seen: Vec<f32> = seen.into_iter().collect();
    let most = seen.iter().copied().fold(0.0, f32::max);
    seen.into_iter().map(|s| if most > 0.0 { (s / most).max(LEAST) } else { 1.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};

    /// A cube of 9^3 voxels of density 1, voxels of 0.1.
    fn cube() -> DensityField {
        DensityField::from_box([0; 3], [9; 3], &[1.0; 729], DAffine3::from_scale(DVec3::splat(0.1)))
    }

    #[test]
    fn the_border_of_thick_smoke_is_seen_and_its_inside_is_not() {
        let field = cube();
        let seen = seen_of_nodes(&field, 20.0);
        let [nx, ny, _] = field.dims;
        let at = |i: usize, j: usize, k: usize| seen[i + nx * (j + ny * k)];
        // The density rises over half a voxel's depth, 1, before the first node: mean of e^(-2 / mu) over the half of
        // the sphere outside, E_2(2) / 2 = 0.018767. A mean over 42 directions is good to a few per cent.
        let expected = 0.018_767f32.sqrt() * (1.0 - (-2.0f32).exp());
        assert!((at(1, 5, 5) / expected - 1.0).abs() < 0.06, "{} {expected}", at(1, 5, 5));
        assert!(at(5, 5, 5) < 0.01 && at(5, 5, 5) > 0.0, "{}", at(5, 5, 5));
        let cells = Cells::new(&field, 1);
        let of_cells = seen_of_cells(&seen, &field, &cells);
        assert_eq!(of_cells.len(), cells.len());
        assert!(of_cells.iter().all(|s| *s > 0.0));
    }

    #[test]
    fn weights_are_above_zero_and_at_most_one_whatever_is_seen() {
        let thin = seen_of_nodes(&cube(), 1e-6);
        assert!(thin.iter().all(|s| s.is_finite()) && weights(thin).iter().all(|w| *w >= LEAST && *w <= 1.0));
        let thick = seen_of_nodes(&cube(), 1e6);
        assert!(weights(thick).iter().all(|w| *w >= LEAST && *w <= 1.0));
        assert_eq!(weights([0.0, 0.0]), [1.0, 1.0]);
        assert!(
            weights(seen_of_nodes(&DensityField::from_box([0; 3], [3; 3], &[0.0; 27], DAffine3::IDENTITY), 1.0))
                .iter()
                .all(|w| *w == 1.0)
        );
    }
}
