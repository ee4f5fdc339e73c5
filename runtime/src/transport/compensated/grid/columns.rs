//! Rays of one direction through a grid, as sheared columns (long characteristics).
//!
//! A direction has a dominant axis; along it the grid is cut into slices. Rays are laid so that they meet the slice
//! where they enter at the nodes' spacing: ray `c` is at `c + shift` on a slice, and `shift` grows by the same slope
//! from slice to slice. So a column of an array *is* a ray from end to end: a quantity carried along it (optical
//! depth, radiance) is never interpolated on the way, only the density when it enters and the result when it leaves.
//! Carrying it from node to node instead (short characteristics) blurs shadows by the square root of the distance.
//! On a slice all rays have the same fraction of a node, so both interpolations are stencils with constant weights.
//!
//! Cost: one visit a node and direction, all loops along rows without branches.

use crate::medium::field::DensityField;
use glam::{DMat3, DVec3, Vec3};
use std::ops::Range;

/// A field in the two layouts that sweeps need: rows must not run along the dominant axis.
pub struct SweepGrid {
    /// Nodes along x, y, z.
    pub dims: [usize; 3],
    /// Density, x fastest.
    natural: Vec<f32>,
    /// Density, y fastest, then z, then x.
    turned: Vec<f32>,
    /// For both layouts and each row, the nodes within [`REACH`] of density.
    active: [Vec<Range<usize>>; 2],
    node_from_world: DMat3,
}

/// Nodes further than this from any density are left out: they emit nothing and are never read with weight. A ray moves
/// by up to one node a slice and lies between two nodes, so what it needs is within two.
const REACH: usize = 2;

/// How a slice lies in an array: `start + slice * slice_stride + row * row_stride + column`.
#[derive(Clone, Copy, Debug)]
pub struct Slices {
    /// True for the layout with y fastest (dominant axis x).
    pub turned: bool,
    /// Slices along the dominant axis.
    pub count: usize,
    /// Nodes along a row.
    pub columns: usize,
    /// Rows of a slice.
    pub rows: usize,
    pub(crate) slice_stride: usize,
    pub(crate) row_stride: usize,
}

impl Slices {
    /// Position of the first node of a row.
    #[inline]
    pub fn row(&self, slice: usize, row: usize) -> usize {
        slice * self.slice_stride + row * self.row_stride
    }
}

/// One direction's way through the grid.
#[derive(Clone, Copy, Debug)]
pub struct Path {
    /// The slices it crosses.
    pub slices: Slices,
    /// World length between two slices.
    pub length: f32,
    /// Whether it meets the last slice first.
    pub reversed: bool,
    slope: [f64; 2],
    first: [isize; 2],
    /// Columns and rows of the array of rays.
    pub extent: [usize; 2],
}

/// Where the rays lie on one slice: node `x` is between rays `x - whole - 1` and `x - whole`.
#[derive(Clone, Copy, Debug)]
pub struct Shift {
    /// Index of the slice.
    pub slice: usize,
    /// Ray array position of the ray just below node 0, along columns and rows: node `x` lies between rays
    /// `base + x` and `base + x + 1`.
    pub base: [usize; 2],
    /// Fraction, in [0, 1), by which ray `base + x + 1` lies beyond node `x`.
    pub fraction: [f32; 2],
}

impl SweepGrid {
    /// The two layouts of a field.
    pub fn new(field: &DensityField) -> Self {
        let turned = turn(&field.values, field.dims);
        let active = active_rows(field);
        let node_from_world = field.world_from_node.matrix3.inverse();
        Self { dims: field.dims, natural: field.values.clone(), turned, active, node_from_world }
    }

    /// The number of nodes.
    pub fn len(&self) -> usize {
        self.natural.len()
    }

    /// True for a grid of no nodes, which no field makes.
    pub fn is_empty(&self) -> bool {
        self.natural.is_empty()
    }

    /// Columns of a row that are near density; empty for a row that is not.
    #[inline]
    pub fn active(&self, slices: &Slices, slice: usize, row: usize) -> Range<usize> {
        self.active[usize::from(slices.turned)][slices.row(slice, row) / slices.columns].clone()
    }

    /// The same for the row of nodes along x at `j`, `k`.
    #[inline]
    pub fn active_x(&self, j: usize, k: usize) -> Range<usize> {
        self.active[0][j + self.dims[1] * k].clone()
    }

    /// Rays between the nodes of two neighbouring rows that pass by density: ray c is between columns c and c + 1.
    #[inline]
    pub fn active_rays(&self, slices: &Slices, slice: usize, row: usize) -> Range<usize> {
        let (a, b) = (self.active(slices, slice, row), self.active(slices, slice, row + 1));
        let both = match (a.is_empty(), b.is_empty()) {
            (true, _) => b,
            (_, true) => a,
            _ => a.start.min(b.start)..a.end.max(b.end),
        };
        both.start.saturating_sub(1)..both.end.min(slices.columns - 1)
    }

    /// Density in the layout of `slices`.
    pub fn density(&self, slices: &Slices) -> &[f32] {
        if slices.turned { &self.turned } else { &self.natural }
    }

    /// The way of rays that come in from direction `toward` (unit vector, world space): slices in the order in which
    /// light from there meets them.
    pub fn path(&self, toward: Vec3) -> Path {
        Path::new(self.dims, self.node_from_world, toward)
    }
}

impl Path {
    /// See [`SweepGrid::path`]; `node_from_world` is the linear map to node space.
    pub fn new(dims: [usize; 3], node_from_world: DMat3, toward: Vec3) -> Self {
        let v: DVec3 = node_from_world * toward.as_dvec3();
        let axis = (0..3).max_by(|&a, &b| v[a].abs().total_cmp(&v[b].abs())).unwrap_or(2);
        let [nx, ny, nz] = dims;
        let (slices, across) = match axis {
            0 => {
                let slices =
                    Slices { turned: true, count: nx, columns: ny, rows: nz, slice_stride: ny * nz, row_stride: ny };
                (slices, [v.y, v.z])
            }
            1 => {
                let slices =
                    Slices { turned: false, count: ny, columns: nx, rows: nz, slice_stride: nx, row_stride: nx * ny };
                (slices, [v.x, v.z])
            }
            _ => {
                let slices =
                    Slices { turned: false, count: nz, columns: nx, rows: ny, slice_stride: nx * ny, row_stride: nx };
                (slices, [v.x, v.y])
            }
        };
        // From the light inwards a ray moves by -v; per slice by -v / |v_axis| across.
        let slope = across.map(|a| -a / v[axis].abs());
        let last = (slices.count - 1) as f64;
        let first = slope.map(|s| (s * last).min(0.0).floor() as isize);
        let reach = slope.map(|s| (s * last).max(0.0).floor() as isize);
        // Rays needed: from -1 - max(whole) to columns - 1 - min(whole).
        let extent = [
            (slices.columns as isize + reach[0] - first[0] + 1) as usize,
            (slices.rows as isize + reach[1] - first[1] + 1) as usize,
        ];
        let length = (1.0 / v[axis].abs()) as f32;
        Path { slices, length, reversed: v[axis] > 0.0, slope, first: reach, extent }
    }

    /// Which of the six senses (axis and sign) the path has: paths of one group visit slices in the same order.
    pub fn group(&self) -> usize {
        let axis = if self.slices.turned {
            0
        } else if self.slices.slice_stride < self.slices.row_stride {
            1
        } else {
            2
        };
        2 * axis + usize::from(self.reversed)
    }

    /// The rays on the `step`-th slice from the light's side.
    pub fn shift(&self, step: usize) -> Shift {
        let shift = self.slope.map(|s| s * step as f64);
        let whole = shift.map(f64::floor);
        let fraction = [(shift[0] - whole[0]) as f32, (shift[1] - whole[1]) as f32];
        let base = [(self.first[0] - whole[0] as isize) as usize, (self.first[1] - whole[1] as isize) as usize];
        let slice = if self.reversed { self.slices.count - 1 - step } else { step };
        Shift { slice, base, fraction }
    }
}

impl Shift {
    /// Weights of the four nodes around a ray: `[row][column]`.
    pub fn ray_weights(&self) -> [[f32; 2]; 2] {
        let [f, g] = self.fraction;
        [[(1.0 - g) * (1.0 - f), (1.0 - g) * f], [g * (1.0 - f), g * f]]
    }

    /// Weights of the four rays around a node: `[row][column]`.
    pub fn node_weights(&self) -> [[f32; 2]; 2] {
        let [f, g] = self.fraction;
        [[g * f, g * (1.0 - f)], [(1.0 - g) * f, (1.0 - g) * (1.0 - f)]]
    }
}

/// `out[c] = sum of the four neighbours of c` in two rows of at least `out.len() + 1` values.
#[inline(always)]
pub fn stencil(out: &mut [f32], low: &[f32], high: &[f32], weights: [[f32; 2]; 2]) {
    let n = out.len();
    let (low0, low1) = (&low[..n], &low[1..n + 1]);
    let (high0, high1) = (&high[..n], &high[1..n + 1]);
    for c in 0..n {
        out[c] =
            weights[0][0] * low0[c] + weights[0][1] * low1[c] + weights[1][0] * high0[c] + weights[1][1] * high1[c];
    }
}

/// The active columns of every row, in both layouts.
fn active_rows(field: &DensityField) -> [Vec<Range<usize>>; 2] {
    let [nx, ny, nz] = field.dims;
    let near = near_density(field);
    let mut rows = [vec![0..0; ny * nz], vec![0..0; nz * nx]];
    let widen = |row: &mut Range<usize>, at: usize| {
        *row = if Range::is_empty(row) { at..at + 1 } else { row.start.min(at)..row.end.max(at + 1) };
    };
    for v in (0..near.len()).filter(|&v| near[v]) {
        let (i, j, k) = (v % nx, v / nx % ny, v / nx / ny);
        widen(&mut rows[0][j + ny * k], i);
        widen(&mut rows[1][k + nz * i], j);
    }
    rows
}

/// Which nodes are within [`REACH`] of density, x fastest.
pub fn near_density(field: &DensityField) -> Vec<bool> {
    let [nx, ny, nz] = field.dims;
    let mut near: Vec<bool> = field.values.iter().map(|&d| d > 0.0).collect();
    for (n, stride) in [(nx, 1), (ny, nx), (nz, nx * ny)] {
        let dense = near.clone();
        for (v, near) in near.iter_mut().enumerate() {
            let at = v / stride % n;
            let (back, on) = (REACH.min(at), REACH.min(n - 1 - at));
            *near = (0..=back + on).any(|s| dense[v + s * stride - back * stride]);
        }
    }
    near
}

/// From x fastest to y fastest, then z, then x.
pub fn turn(values: &[f32], [nx, ny, nz]: [usize; 3]) -> Vec<f32> {
    let mut out = vec![0.0; values.len()];
    for k in 0..nz {
        for j in 0..ny {
            let row = &values[nx * (j + ny * k)..][..nx];
            row.iter().enumerate().for_each(|(i, &v)| out[j + ny * (k + nz * i)] = v);
        }
    }
    out
}

/// Adds a turned array (y fastest, then z, then x) to a natural one (x fastest).
pub fn add_turned(out: &mut [f32], turned: &[f32], [nx, ny, nz]: [usize; 3]) {
    for k in 0..nz {
        for j in 0..ny {
            let row = &mut out[nx * (j + ny * k)..][..nx];
            row.iter_mut().enumerate().for_each(|(i, v)| *v += turned[j + ny * (k + nz * i)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DAffine3;

    /// A path's rays and nodes must agree on where things are: a function that is linear in space and sampled at the
    /// nodes must come back unchanged at the nodes after it went to the rays.
    #[test]
    fn a_linear_function_goes_to_the_rays_and_back_unchanged() {
        let dims = [9, 7, 8];
        let shear = DMat3::from_cols_array(&[0.7, 0.1, 0.0, -0.2, 1.1, 0.3, 0.0, 0.4, 0.9]);
        let value = |i: usize, j: usize, k: usize| 3.0 + i as f32 - 2.0 * j as f32 + 0.5 * k as f32;
        let values = (0..504).map(|v| value(v % 9, v / 9 % 7, v / 63)).collect();
        let field = DensityField { dims, values, world_from_node: DAffine3::from_mat3(shear) };
        let grid = SweepGrid::new(&field);
        let mut groups = [0; 6];
        for d in 0..200 {
            let (z, a) = (1.0 - (d as f32 + 0.5) / 100.0, d as f32 * 2.4);
            let toward = Vec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
            let path = grid.path(toward);
            groups[path.group()] += 1;
            let slices = path.slices;
            let density = grid.density(&slices);
            for step in 0..slices.count {
                let shift = path.shift(step);
                let mut rays = vec![f32::NAN; path.extent[0] * path.extent[1]];
                for row in 0..slices.rows - 1 {
                    let start = (shift.base[1] + row + 1) * path.extent[0] + shift.base[0] + 1;
                    let out = &mut rays[start..start + slices.columns - 1];
                    let (low, high) = (slices.row(shift.slice, row), slices.row(shift.slice, row + 1));
                    stencil(
                        out,
                        &density[low..low + slices.columns],
                        &density[high..high + slices.columns],
                        shift.ray_weights(),
                    );
                }
                // Inner nodes have all their rays between nodes.
                let mut back = vec![0.0; slices.columns];
                for row in 1..slices.rows - 1 {
                    let low = (shift.base[1] + row) * path.extent[0] + shift.base[0];
                    stencil(&mut back, &rays[low..], &rays[low + path.extent[0]..], shift.node_weights());
                    let at = slices.row(shift.slice, row);
                    for c in 1..slices.columns - 1 {
                        // Values up to 15, eight roundings of 6e-8 each.
                        assert!((back[c] - density[at + c]).abs() < 1e-5, "{toward} step {step} row {row} column {c}");
                    }
                }
            }
        }
        assert!(groups.iter().all(|&g| g > 0), "every axis and sense was met: {groups:?}");
    }

    #[test]
    fn turning_there_and_back_is_the_identity() {
        let values: Vec<f32> = (0..24).map(|v| v as f32).collect();
        let mut back = vec![0.0; 24];
        add_turned(&mut back, &turn(&values, [2, 3, 4]), [2, 3, 4]);
        assert_eq!(back, values);
    }
}
