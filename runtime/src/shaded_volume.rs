//! Source radiance and density in bricks: what the volume pass writes and the view pass reads.
//!
//! Only bricks with density are there, and each holds copies of the nodes at its far faces, so that every fetch of a ray
//! stays inside one brick. Bricks and density are made once for a frame; a change of light or view writes the radiance
//! anew, in the same memory: fresh memory takes as long as the volume pass itself.
//! Cost: to make, a few operations a node; to write, one copy a node of a brick, twice as many as there are nodes.

use crate::medium::field::DensityField;
use glam::DAffine3;
use rayon::prelude::*;
use std::ops::Range;

/// Cells along a side of a brick.
pub(crate) const BRICK: usize = 4;
/// Nodes along a side of a brick: those of its far faces belong to its neighbours as well.
pub(crate) const SIDE: usize = BRICK + 1;
/// Nodes of a brick.
pub(crate) const BRICK_NODES: usize = SIDE * SIDE * SIDE;
/// Marks a brick without density.
pub(crate) const EMPTY: u32 = u32::MAX;
/// Layers of bricks that one task writes: the planes between them are made once.
const LAYERS: usize = 4;

/// `[J red, J green, J blue, D]` of the nodes of a brick, x fastest.
pub(crate) type Brick = [[f32; 4]; BRICK_NODES];

/// Source radiance and density of one frame, ready to be marched.
pub struct ShadedVolume {
    /// Nodes along x, y, z, as in the [`DensityField`] it was made from.
    pub(crate) dims: [usize; 3],
    /// The bricks with density.
    pub(crate) nodes: Vec<Brick>,
    /// Where they are.
    pub(crate) table: BrickTable,
    /// Node to world space.
    pub(crate) world_from_node: DAffine3,
    /// Largest density.
    pub(crate) density_max: f32,
}

/// Which bricks of a box of nodes have density.
pub(crate) struct BrickTable {
    /// Along x, y, z.
    pub(crate) bricks: [usize; 3],
    /// Numbers of the dense ones, x fastest, ascending.
    pub(crate) dense: Vec<u32>,
    /// Where in `dense` a brick is, or [`EMPTY`]; x fastest.
    pub(crate) places: Vec<u32>,
}

impl BrickTable {
    /// Those of `field`.
    pub(crate) fn of(field: &DensityField) -> Self {
        let bricks = field.dims.map(|n| (n - 1).div_ceil(BRICK));
        let count: usize = bricks.iter().product();
        let is_dense =
            |b: &u32| rows(field.dims, bricks, *b).any(|(_, row)| field.values[row].iter().any(|&d| d > 0.0));
        let dense: Vec<u32> = (0..count as u32).into_par_iter().filter(is_dense).collect();
        let mut places = vec![EMPTY; count];
        dense.iter().enumerate().for_each(|(place, &b)| places[b as usize] = place as u32);
        Self { bricks, dense, places }
    }

    /// Boxes that all nodes of bricks with density lie in: the first node of each run of bricks along x, and how many
    /// nodes it is from there to the last along x, y and z.
    pub(crate) fn runs(&self) -> impl Iterator<Item = ([usize; 3], [usize; 3])> {
        let [bx, by, _] = self.bricks;
        let next_to = move |a: &u32, b: &u32| a + 1 == *b && !(*b as usize).is_multiple_of(bx);
        self.dense.chunk_by(next_to).map(move |run| {
            let first = run[0] as usize;
            let corner = [first % bx, first / bx % by, first / bx / by].map(|b| b * BRICK);
            (corner, [run.len() * BRICK, BRICK, BRICK])
        })
    }
}

/// The rows of nodes of brick `number`: the place of the first in the brick, and all of them in the box.
fn rows(dims: [usize; 3], [bx, by, _]: [usize; 3], number: u32) -> impl Iterator<Item = (usize, Range<usize>)> {
    let number = number as usize;
    let first = [number % bx, number / bx % by, number / bx / by].map(|b| b * BRICK);
    let end = [0, 1, 2].map(|a| (first[a] + SIDE).min(dims[a]));
    let lines = (first[2]..end[2]).flat_map(move |k| (first[1]..end[1]).map(move |j| (j, k)));
    lines.map(move |(j, k)| {
        let start = dims[0] * (j + dims[1] * k);
        (SIDE * (j - first[1] + SIDE * (k - first[2])), start + first[0]..start + end[0])
    })
}

impl ShadedVolume {
    /// The bricks of a frame, black.
    pub fn of(field: &DensityField) -> Self {
        let table = BrickTable::of(field);
        let black = |&number: &u32| {
            let mut brick = [[0.0; 4]; BRICK_NODES];
            for (place, row) in rows(field.dims, table.bricks, number) {
                brick[place..].iter_mut().zip(&field.values[row]).for_each(|(node, &density)| node[3] = density);
            }
            brick
        };
        let nodes = table.dense.par_iter().map(black).collect();
        let density_max = field.values.par_iter().copied().reduce(|| 0.0, f32::max);
        Self { dims: field.dims, nodes, table, world_from_node: field.world_from_node, density_max }
    }

    /// Writes the radiance of all nodes anew: `row(j, k, out)` gives that of the nodes `[.., j, k]` in the first three
    /// components of `out`, which come as zeros, with the density of `field`, the same as at [`Self::of`], in the fourth.
    /// It is asked for rows of bricks with density only, some of them twice.
    pub fn write(&mut self, field: &DensityField, row: impl Fn(usize, usize, &mut [[f32; 4]]) + Sync) {
        let ([nx, ny, nz], [bx, by, _]) = (self.dims, self.table.bricks);
        let layer = |number: u32| number as usize / (bx * by);
        let mut tasks: Vec<(&[u32], &mut [Brick])> = Vec::new();
        let (mut numbers, mut nodes) = (&self.table.dense[..], &mut self.nodes[..]);
        while let Some(&first) = numbers.first() {
            let end = numbers.partition_point(|&n| layer(n) / LAYERS == layer(first) / LAYERS);
            let (these, rest) = std::mem::take(&mut nodes).split_at_mut(end);
            tasks.push((&numbers[..end], these));
            (numbers, nodes) = (&numbers[end..], rest);
        }
        tasks.into_par_iter().for_each(|(numbers, nodes)| {
            let mut planes = vec![vec![[0.0f32; 4]; nx * ny]; SIDE];
            let mut made = vec![vec![false; ny]; SIDE];
            let (mut start, mut before) = (0, usize::MAX);
            while start < numbers.len() {
                let z = layer(numbers[start]);
                let end = start + numbers[start..].partition_point(|&n| layer(n) == z);
                // The last plane of the layer before is the first of this one.
                planes.swap(0, BRICK);
                made.swap(0, BRICK);
                made[usize::from(before.wrapping_add(1) == z)..].iter_mut().for_each(|made| made.fill(false));
                before = z;
                for (number, brick) in numbers[start..end].iter().zip(&mut nodes[start..end]) {
                    let (x, y) = (*number as usize % bx * BRICK, *number as usize / bx % by * BRICK);
                    for (k, (plane, made)) in planes.iter_mut().zip(&mut made).enumerate().take(nz - z * BRICK) {
                        for j in y..(y + SIDE).min(ny) {
                            let line = &mut plane[j * nx..][..nx];
                            if !std::mem::replace(&mut made[j], true) {
                                let density = &field.values[nx * (j + ny * (z * BRICK + k))..][..nx];
                                line.iter_mut().zip(density).for_each(|(out, &d)| *out = [0.0, 0.0, 0.0, d]);
                                row(j, z * BRICK + k, line);
                            }
                            let place = SIDE * (j - y + SIDE * k);
                            match (brick[place..].first_chunk_mut::<SIDE>(), line[x..].first_chunk::<SIDE>()) {
                                (Some(nodes), Some(from)) => *nodes = *from,
                                _ => brick[place..][..nx - x].copy_from_slice(&line[x..]),
                            }
                        }
                    }
                }
                start = end;
            }
        });
    }

    /// A volume of `nodes`: `[J red, J green, J blue, D]`, x fastest, `dims` of them.
    pub fn of_nodes(dims: [usize; 3], nodes: &[[f32; 4]], world_from_node: DAffine3) -> Self {
        let values = nodes.iter().map(|n| n[3]).collect();
        let field = DensityField { dims, values, world_from_node };
        let mut volume = Self::of(&field);
        volume.write(&field, |j, k, out| out.copy_from_slice(&nodes[dims[0] * (j + dims[1] * k)..][..dims[0]]));
        volume
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_node_of_every_brick_is_that_of_the_field_and_again_after_another_write() {
        for dims in [[9usize, 14, 38], [2, 2, 2], [5, 6, 18], [4, 3, 33]] {
            // Two thirds of the slices in z are empty, in runs of several layers.
            let density =
                |v: usize| f32::from(u8::from(v / dims[0] / dims[1] % 15 < 5 && v.is_multiple_of(3))) * (1 + v) as f32;
            let values: Vec<f32> = (0..dims.iter().product()).map(density).collect();
            let field = DensityField { dims, values: values.clone(), world_from_node: DAffine3::IDENTITY };
            let mut volume = ShadedVolume::of(&field);
            for scale in [1.0f32, -2.0] {
                let value = |i: usize, j: usize, k: usize| scale * (i + 100 * (j + 100 * k)) as f32;
                volume.write(&field, |j, k, out| {
                    assert!(out.len() == dims[0] && out.iter().all(|v| v[..3] == [0.0; 3]));
                    out.iter_mut().enumerate().for_each(|(i, o)| *o = [value(i, j, k), 1.0, 2.0, o[3]]);
                });
                let [bx, by, _] = volume.table.bricks;
                for (b, &place) in volume.table.places.iter().enumerate() {
                    let first = [b % bx, b / bx % by, b / bx / by].map(|b| b * BRICK);
                    let mut most = 0.0f32;
                    for n in 0..BRICK_NODES {
                        let at = [n % SIDE, n / SIDE % SIDE, n / SIDE / SIDE];
                        let [i, j, k] = [0, 1, 2].map(|a| first[a] + at[a]);
                        if [i, j, k].iter().zip(dims).any(|(at, n)| *at >= n) {
                            continue;
                        }
                        let density = values[i + dims[0] * (j + dims[1] * k)];
                        most = most.max(density);
                        if place != EMPTY {
                            assert_eq!(volume.nodes[place as usize][n], [value(i, j, k), 1.0, 2.0, density]);
                        }
                    }
                    assert_eq!(place == EMPTY, most == 0.0);
                }
            }
        }
    }
}
