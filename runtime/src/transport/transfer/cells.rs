//! The cells that indirect light is kept in: cubes of `2^shift` voxels a side, those with density, x fastest.
//!
//! What is kept of a cell is the mean over its *density*, `int D f / int D`: then the light that a cell scatters is
//! exact, and an edge of smoke that cuts a cell is not mixed with the empty part. Between cells, values are trilinear
//! between their middles; cells without density do not count, and the weights of the others are made to add up to 1.
//! Cost: O(nodes) to make; to read, four look-ups a cell for each line of nodes, and two a node.

use crate::medium::field::DensityField;
use crate::tracking::majorant::Majorants;
use glam::Vec4;
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
    /// The place in the box of each cell with density, x fastest.
    pub bricks: Vec<u32>,
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
        let bricks: Vec<u32> = (0..places.len() as u32).filter(|&b| places[b as usize] != EMPTY).collect();
        let mass = bricks.par_iter().map(|&brick| mass(brick as usize)).collect();
        Self { majorants, shift, places, bricks, mass }
    }

    /// The mean over each cell's density of each of some functions, trilinear as the density is, by their values at the
    /// nodes of the field that the cells are of: `[cell][function]`.
    ///
    /// The integral of the product of both, which is not the sum of their products at nodes: that one takes a function
    /// that falls where density rises for zero.
    pub fn means(&self, field: &DensityField, functions: &[Vec<f32>]) -> Vec<f32> {
        let side = 1usize << self.shift;
        let [nx, ny, _] = field.dims;
        let [bx, by, _] = self.majorants.bricks;
        let mut out = vec![0.0; self.len() * functions.len()];
        out.par_chunks_mut(functions.len().max(1)).zip(&self.bricks).for_each_init(
            Vec::new,
            |weights, (out, &brick)| {
                let brick = brick as usize;
                let first = [brick % bx, brick / bx % by, brick / bx / by].map(|b| b * side);
                let count = [0, 1, 2].map(|a| (first[a] + side).min(field.dims[a] - 1) - first[a] + 1);
                let place = |at: usize| {
                    let [i, j, k] = [at % count[0], at / count[0] % count[1], at / count[0] / count[1]];
                    first[0] + i + nx * (first[1] + j + ny * (first[2] + k))
                };
                weights.clear();
                weights.extend((0..count.iter().product()).map(|at| f64::from(field.values[place(at)])));
                for (n, stride) in [(count[0], 1), (count[1], count[0]), (count[2], count[0] * count[1])] {
                    weigh(weights, n, stride);
                }
                let mass: f64 = weights.iter().sum();
                // A cell has density; where it is too small to be summed, nothing is.
                let scale = if mass > 0.0 { 1.0 / mass } else { 0.0 };
                for (out, function) in out.iter_mut().zip(functions) {
                    let each = weights.iter().enumerate().map(|(at, weight)| weight * f64::from(function[place(at)]));
                    *out = (scale * each.sum::<f64>()) as f32;
                }
            },
        );
        out
    }

    /// The number of cells with density.
    pub fn len(&self) -> usize {
        self.mass.len()
    }

    /// True if there is no density at all.
    pub fn is_empty(&self) -> bool {
        self.mass.is_empty()
    }

    /// The cells next to a place along one axis, and how far it is from the first to the second, in cells: the first
    /// may be one before the box, and the second one after it.
    #[inline(always)]
    fn next_to(&self, node: usize) -> (isize, f32) {
        let at = node as f32 / (1u32 << self.shift) as f32 - 0.5;
        (at.floor() as isize, at - at.floor())
    }

    /// Sums of `values`, one a cell with density whose last component is 1, over the four cells around the line of
    /// nodes at `[j, k]`, for each cell along x, one before and one after the box included; those that nodes `from` to
    /// `to` are not between are left at zero.
    pub fn line(&self, node: [usize; 2], [from, to]: [usize; 2], values: &[Vec4]) -> Vec<Vec4> {
        let [bx, by, bz] = self.majorants.bricks;
        let mut out = vec![Vec4::ZERO; bx + 2];
        let ((y, f), (z, g)) = (self.next_to(node[0]), self.next_to(node[1]));
        let first = self.next_to(from).0.max(0) as usize;
        let end = ((self.next_to(to).0 + 2) as usize).min(bx);
        for (b, c, weight) in
            [(0, 0, (1.0 - f) * (1.0 - g)), (1, 0, f * (1.0 - g)), (0, 1, (1.0 - f) * g), (1, 1, f * g)]
        {
            let (y, z) = (y + b, z + c);
            if weight > 0.0 && (0..by as isize).contains(&y) && (0..bz as isize).contains(&z) {
                let places = &self.places[bx * (y as usize + by * z as usize)..][first..end];
                for (out, &place) in out[1 + first..].iter_mut().zip(places).filter(|(_, p)| **p != EMPTY) {
                    *out += values[place as usize] * weight;
                }
            }
        }
        out
    }

    /// The value at node `i` of a line, over its weights' sum in the last component; zero if no cell around has
    /// density.
    #[inline(always)]
    pub fn between(&self, i: usize, line: &[Vec4]) -> Vec4 {
        let (x, f) = self.next_to(i);
        let at = (x + 1) as usize;
        let sum = line[at] * (1.0 - f) + line[at + 1] * f;
        if sum.w > 0.0 { sum / sum.w } else { Vec4::ZERO }
    }
}

/// Values at the `n` nodes of lines that are `stride` apart to the integrals of their piecewise linear function with
/// the hat function of each node.
fn weigh(values: &mut [f64], n: usize, stride: usize) {
    for start in (0..values.len()).filter(|at| (at / stride).is_multiple_of(n)) {
        let mut before = 0.0;
        for node in 0..n {
            let at = start + node * stride;
            let here = values[at];
            let after = if node + 1 < n { values[at + stride] } else { 0.0 };
            let sides = f64::from(u8::from(node > 0) + u8::from(node + 1 < n));
            values[at] = (before + after) / 6.0 + sides * here / 3.0;
            before = here;
        }
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
    fn means_over_the_density_are_those_of_the_trilinear_product() {
        // D = x + 2 y, f = 3 - x + z (and 1) in cells of two voxels: both trilinear, so that the integrals are
        // polynomials.
        let dims = [5, 5, 7];
        let at = |v: usize| [v % 5, v / 5 % 5, v / 25].map(|n| n as f64);
        let of = |f: &dyn Fn([f64; 3]) -> f64| (0..175).map(|v| f(at(v)) as f32).collect::<Vec<f32>>();
        let values = of(&|[x, y, _]| x + 2.0 * y);
        let field = DensityField { dims, values, world_from_node: DAffine3::from_scale(DVec3::splat(0.1)) };
        let cells = Cells::new(&field, 1);
        let means = cells.means(&field, &[of(&|[x, _, z]| 3.0 - x + z), vec![1.0; 175]]);
        assert_eq!(means.len(), 2 * cells.len());
        for (mean, &brick) in means.chunks(2).zip(&cells.bricks) {
            let brick = brick as usize;
            let [a, b, c] = [brick % 2, brick / 2 % 2, brick / 4].map(|n| 2.0 * n as f64);
            // Over [a, a + 2] and so on: means of x, x^2, y, z.
            let (x, xx, y, z) = (a + 1.0, a * a + 2.0 * a + 4.0 / 3.0, b + 1.0, c + 1.0);
            let expected = (x + 2.0 * y) * (3.0 + z) - (xx + 2.0 * y * x);
            let expected = expected / (x + 2.0 * y);
            assert!(
                (f64::from(mean[0]) - expected).abs() < 1e-5 && (mean[1] - 1.0).abs() < 1e-6,
                "{mean:?} {expected}"
            );
        }
    }

    #[test]
    fn linear_functions_of_the_cells_are_kept_inside_and_constants_everywhere() {
        let field = DensityField::from_box([0; 3], [16; 3], &[1.0; 4096], DAffine3::IDENTITY);
        let cells = Cells::new(&field, 2);
        let [bx, by, _] = cells.majorants.bricks;
        let mut values = vec![Vec4::ZERO; cells.len()];
        for (brick, &place) in cells.places.iter().enumerate() {
            let middle = [brick % bx, brick / bx % by, brick / bx / by].map(|b| b as f32 * 4.0 + 2.0);
            values[place as usize] = Vec4::new(middle[0] + 10.0 * middle[1] + 100.0 * middle[2], 3.0, 0.0, 1.0);
        }
        for [i, j, k] in [[1, 1, 1], [7, 8, 9], [2, 2, 2], [16, 16, 16], [10, 3, 5], [0, 17, 3]] {
            let found = cells.between(i, &cells.line([j, k], [0, 16], &values));
            assert!((found.y - 3.0).abs() < 1e-5, "{found}");
            if [i, j, k].iter().all(|n| (2..=14).contains(n)) {
                let expected = i as f32 + 10.0 * j as f32 + 100.0 * k as f32;
                assert!((found.x - expected).abs() < 1e-3 * expected, "{found} {expected}");
            }
        }
        let empty = DensityField::from_box([0; 3], [4; 3], &[0.0; 64], DAffine3::IDENTITY);
        let cells = Cells::new(&empty, 1);
        assert_eq!(cells.between(2, &cells.line([2, 2], [0, 4], &[])), Vec4::ZERO);
    }
}
