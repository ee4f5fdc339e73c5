//! The cells that indirect light is kept in: cubes of `2^shift` voxels a side, those with density, x fastest.
//!
//! What is kept of a cell is the mean over its *density*, `int D f / int D`: then the light that a cell scatters is exact,
//! and an edge of smoke that cuts a cell is not mixed with the empty part. Between cells, values are trilinear between
//! their middles; cells without density do not count, and the weights of the others are made to add up to 1.
//! Cost: O(nodes) to make; eight look-ups a node to read.

use crate::medium::field::DensityField;
use crate::tracking::majorant::Majorants;
use rayon::prelude::*;

/// Marks a cell without density.
pub const EMPTY: u32 = u32::MAX;

/// The cells of one frame.
pub struct Cells {
    /// Bounds of the density, cell by cell, and the walk of rays through them.
    pub majorants: Majorants,
    /// Cells are `2^shift` voxels a side.
    pub shift: u32,
    /// For each cell of the box, its place among those with density, or [`EMPTY`].
    pub places: Vec<u32>,
    /// Integral of the density over each cell with density, world units; > 0.
    pub mass: Vec<f64>,
}

impl Cells {
    /// The cells of `field`.
    pub fn new(field: &DensityField, shift: u32) -> Self {
        let majorants = Majorants::new(field, shift);
        let mut count = 0;
        let places = majorants.bounds.iter().map(|bounds| {
            let place = if bounds[1] > 0.0 { count } else { EMPTY };
            count += u32::from(bounds[1] > 0.0);
            place
        });
        let places: Vec<u32> = places.collect();
        let voxel = field.world_from_node.matrix3.determinant().abs();
        let side = 1usize << shift;
        let [nx, ny, nz] = field.dims;
        let [bx, by, _] = majorants.bricks;
        let mass = |brick: usize| {
            let first = [brick % bx, brick / bx % by, brick / bx / by].map(|b| b * side);
            let mut sum = 0.0;
            // The integral of a trilinear voxel is the mean of its corners.
            for k in first[2]..(first[2] + side).min(nz - 1) {
                for j in first[1]..(first[1] + side).min(ny - 1) {
                    for i in first[0]..(first[0] + side).min(nx - 1) {
                        let at = i + nx * (j + ny * k);
                        let corners = [0, 1, nx, nx + 1].map(|c| [at + c, at + c + nx * ny]);
                        sum += corners.iter().flatten().map(|&c| f64::from(field.values[c])).sum::<f64>();
                    }
                }
            }
            // A density too small to be summed still makes a cell; nothing is divided by zero.
            (sum * 0.125 * voxel).max(f64::MIN_POSITIVE)
        };
        let active: Vec<usize> = (0..places.len()).filter(|&b| places[b] != EMPTY).collect();
        let mass = active.into_par_iter().map(mass).collect();
        Self { majorants, shift, places, mass }
    }

    /// The number of cells with density.
    pub fn len(&self) -> usize {
        self.mass.len()
    }

    /// True if there is no density at all.
    pub fn is_empty(&self) -> bool {
        self.mass.is_empty()
    }

    /// The cells around a node and their weights, which add up to 1; all zero if none of them has density.
    #[inline]
    pub fn around(&self, node: [usize; 3]) -> [(u32, f32); 8] {
        let side = (1u32 << self.shift) as f32;
        let bricks = self.majorants.bricks;
        let mut low = [0isize; 3];
        let mut fraction = [0.0f32; 3];
        for a in 0..3 {
            let at = node[a] as f32 / side - 0.5;
            low[a] = at.floor() as isize;
            fraction[a] = at - at.floor();
        }
        let mut out = [(0u32, 0.0f32); 8];
        let mut sum = 0.0;
        for (corner, out) in out.iter_mut().enumerate() {
            let (mut at, mut size, mut weight) = (0isize, 1isize, 1.0f32);
            let mut inside = true;
            for a in 0..3 {
                let up = corner >> a & 1;
                let b = low[a] + up as isize;
                inside &= b >= 0 && b < bricks[a] as isize;
                weight *= if up == 1 { fraction[a] } else { 1.0 - fraction[a] };
                at += b * size;
                size *= bricks[a] as isize;
            }
            if inside && weight > 0.0 {
                let place = self.places[at as usize];
                if place != EMPTY {
                    *out = (place, weight);
                    sum += weight;
                }
            }
        }
        if sum > 0.0 {
            out.iter_mut().for_each(|(_, weight)| *weight /= sum);
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};

    #[test]
    fn masses_add_up_to_the_density_and_cells_without_it_are_left_out() {
        let mut values = vec![0.0f32; 11 * 9 * 10];
        values[3 + 11 * (4 + 9 * 5)] = 2.0;
        values[9 + 11 * (7 + 9 * 8)] = 1.5;
        let field = DensityField::from_box([0; 3], [11, 9, 10], &values, DAffine3::from_scale(DVec3::splat(0.5)));
        for shift in 0..4 {
            let cells = Cells::new(&field, shift);
            assert!((cells.mass.iter().sum::<f64>() - 3.5 * 0.125).abs() < 1e-12);
            assert_eq!(cells.len(), cells.places.iter().filter(|&&p| p != EMPTY).count());
            assert!(cells.len() < cells.places.len() || shift == 3);
        }
        let empty = DensityField::from_box([0; 3], [3; 3], &[0.0; 27], DAffine3::IDENTITY);
        assert!(Cells::new(&empty, 1).is_empty());
    }

    #[test]
    fn weights_around_a_node_with_density_add_up_to_one_and_keep_linear_functions_inside() {
        let field = DensityField::from_box([0; 3], [16; 3], &[1.0; 4096], DAffine3::IDENTITY);
        let cells = Cells::new(&field, 2);
        let middle = |place: u32| (place % cells.majorants.bricks[0] as u32) as f32 * 4.0 + 2.0;
        for node in [[1, 1, 1], [7, 8, 9], [2, 2, 2], [16, 16, 16], [10, 3, 5]] {
            let around = cells.around(node);
            assert!((around.iter().map(|a| a.1).sum::<f32>() - 1.0).abs() < 1e-6);
            if node.iter().all(|&n| (2..=14).contains(&n)) {
                let x: f32 = around.iter().map(|&(p, w)| w * middle(p)).sum();
                assert!((x - node[0] as f32).abs() < 1e-5, "{node:?}: {x}");
            }
        }
    }
}
