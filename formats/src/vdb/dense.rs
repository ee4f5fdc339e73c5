//! A float tree to a dense box: the box first, then the values, with no copy of the tree between.
//!
//! The box holds the active voxels and, where the background is zero, every inactive voxel of another value as well.
//! Three passes over the bytes, so that memory stays at the file, one entry a leaf, and the box: 1 the topology (leaves
//! and active tiles), 2 the heads of the leaves (inactive values; blocks are only decoded where all values are stored),
//! 3 topology and leaves again, writing. Free checks on the way: the topology ends where the blocks begin, the blocks
//! end where the grid ends, and the two copies of each leaf's mask are the same.
//! Cost: about 5 ns an active voxel for Blosc half floats, most of it LZ4 and the turn from z-fastest to x-fastest.

use super::topology::{LEAF_LOG2, LeafMask, Node, read_mask, walk};
use super::values::ValueReader;
use crate::Result;
use crate::bounded::{Bytes, MAX_DENSE_VOXELS};
use crate::volume::VoxelMask;

/// A dense box of voxels, x fastest.
#[derive(Debug, Default)]
pub(super) struct Dense {
    /// Index coordinates of the first voxel.
    pub origin: [i32; 3],
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
    /// One value a voxel.
    pub values: Vec<f32>,
    /// The active voxels.
    pub active: VoxelMask,
}

struct Leaf {
    origin: [i32; 3],
    mask: LeafMask,
}

/// First and last voxel along each axis; i64, so that the end of the last voxel can be named too.
#[derive(Clone, Copy)]
struct Bounds {
    low: [i64; 3],
    high: [i64; 3],
}

impl Bounds {
    const EMPTY: Self = Self { low: [i64::MAX; 3], high: [i64::MIN; 3] };

    fn include(&mut self, low: [i64; 3], high: [i64; 3]) {
        for a in 0..3 {
            self.low[a] = self.low[a].min(low[a]);
            self.high[a] = self.high[a].max(high[a]);
        }
    }

    fn include_cube(&mut self, origin: [i32; 3], log2: u32) {
        let low = origin.map(i64::from);
        self.include(low, low.map(|l| l + (1 << log2) - 1));
    }

    /// The voxels of a leaf that are set in `mask`.
    fn include_mask(&mut self, origin: [i32; 3], mask: &LeafMask) {
        let all = mask.iter().fold(0, |a, w| a | w);
        if all == 0 {
            return;
        }
        let slabs = mask.iter().rev().fold(0u64, |bits, &w| bits << 1 | u64::from(w != 0));
        let rows = (0..8).rev().fold(0u64, |bits, y| bits << 1 | u64::from(all >> (8 * y) & 0xff != 0));
        let columns = (0..8).fold(0u64, |bits, y| bits | all >> (8 * y) & 0xff);
        let extent = [slabs, rows, columns];
        let at = origin.map(i64::from);
        let low = std::array::from_fn(|a| at[a] + i64::from(extent[a].trailing_zeros()));
        let high = std::array::from_fn(|a| at[a] + 63 - i64::from(extent[a].leading_zeros()));
        self.include(low, high);
    }

    fn dims(&self) -> [u64; 3] {
        std::array::from_fn(|a| u64::try_from(self.high[a].saturating_sub(self.low[a])).map_or(0, |d| d + 1))
    }
}

/// Reads the tree at `bytes`. `block_pos` and `end_pos` are where the file says that topology and values end.
pub(super) fn read(
    bytes: &mut Bytes,
    reader: &mut ValueReader,
    block_pos: Option<u64>,
    end_pos: Option<u64>,
) -> Result<Dense> {
    let topology = bytes.clone();
    let mut leaves = Vec::new();
    let mut bounds = Bounds::EMPTY;
    let background = walk(bytes, reader, &mut |background, node| {
        match node {
            Node::Tile { origin, log2, value, active } => {
                if active || (background == 0.0 && value != 0.0) {
                    bounds.include_cube(origin, log2);
                }
            }
            Node::Leaf { origin, mask } => {
                bounds.include_mask(origin, &mask);
                leaves.push(Leaf { origin, mask });
            }
        }
        Ok(())
    })?;
    check_position(bytes, "end of the topology", block_pos)?;
    if background == 0.0 {
        let mut blocks = bytes.clone();
        for leaf in &leaves {
            let other = inactive_values(&mut blocks, reader, leaf)?;
            bounds.include_mask(leaf.origin, &other);
        }
    }
    let mut dense = allocate(bytes, &bounds, background)?;
    walk(&mut topology.clone(), reader, &mut |_, node| {
        if let Node::Tile { origin, log2, value, active } = node {
            dense.put_tile(origin, log2, value, active);
        }
        Ok(())
    })?;
    let mut values = [0.0; 512];
    for leaf in &leaves {
        check_mask(bytes, leaf)?;
        let head = reader.head(bytes, &leaf.mask, background)?;
        reader.values(bytes, &head, &leaf.mask, &mut values)?;
        dense.put_leaf(leaf, &values);
    }
    check_position(bytes, "end of the grid", end_pos)?;
    Ok(dense)
}

/// Steps over a whole tree of any value type and ends behind its last leaf.
pub(super) fn skip(bytes: &mut Bytes, reader: &mut ValueReader) -> Result<()> {
    let mut leaves = Vec::new();
    walk(bytes, reader, &mut |_, node| {
        if let Node::Leaf { origin, mask } = node {
            leaves.push(Leaf { origin, mask });
        }
        Ok(())
    })?;
    for leaf in &leaves {
        check_mask(bytes, leaf)?;
        let head = reader.head(bytes, &leaf.mask, 0.0)?;
        reader.skip_block(bytes, &head)?;
    }
    Ok(())
}

/// The inactive voxels of a leaf that are not zero, in a grid whose background is.
fn inactive_values(bytes: &mut Bytes, reader: &mut ValueReader, leaf: &Leaf) -> Result<LeafMask> {
    check_mask(bytes, leaf)?;
    let head = reader.head(bytes, &leaf.mask, 0.0)?;
    let mut other = LeafMask::default();
    if head.stored == 512 {
        let mut values = [0.0; 512];
        reader.values(bytes, &head, &leaf.mask, &mut values)?;
        for (word, values) in other.iter_mut().zip(values.chunks_exact(64)) {
            *word = values.iter().rev().fold(0, |bits, &v| bits << 1 | u64::from(v != 0.0));
        }
    } else {
        reader.skip_block(bytes, &head)?;
        for (w, word) in other.iter_mut().enumerate() {
            let selection = head.selection(w);
            let [off, on] = head.inactive.map(|v| if v != 0.0 { u64::MAX } else { 0 });
            *word = selection & on | !selection & off;
        }
    }
    for (word, mask) in other.iter_mut().zip(&leaf.mask) {
        *word &= !mask;
    }
    Ok(other)
}

fn check_mask(bytes: &mut Bytes, leaf: &Leaf) -> Result<()> {
    let mut again = LeafMask::default();
    read_mask(bytes, &mut again)?;
    if again != leaf.mask {
        let what = format!("mask of the leaf at {:?}", leaf.origin);
        return Err(bytes.invalid(&what, "two different copies", "the same mask in topology and values"));
    }
    Ok(())
}

fn check_position(bytes: &Bytes, what: &str, expected: Option<u64>) -> Result<()> {
    match expected {
        Some(expected) if expected != bytes.position() as u64 => {
            Err(bytes.invalid(what, format!("byte {}", bytes.position()), format!("byte {expected}")))
        }
        _ => Ok(()),
    }
}

fn allocate(bytes: &Bytes, bounds: &Bounds, background: f32) -> Result<Dense> {
    let dims = bounds.dims();
    if dims.contains(&0) {
        return Ok(Dense::default());
    }
    let voxels = dims.iter().map(|&d| u128::from(d)).product::<u128>();
    if voxels > u128::from(MAX_DENSE_VOXELS) {
        let found = format!("{} x {} x {} voxels from {:?}", dims[0], dims[1], dims[2], bounds.low);
        let expected = format!("at most {MAX_DENSE_VOXELS} voxels; crop or resample the grid");
        return Err(bytes.invalid("box of the grid", found, expected));
    }
    let voxels = voxels as usize;
    // Every bound came from an i32 coordinate, and each side is below the limit on voxels.
    Ok(Dense {
        origin: bounds.low.map(|l| l as i32),
        dims: dims.map(|d| d as usize),
        values: vec![background; voxels],
        active: VoxelMask::new(voxels),
    })
}

impl Dense {
    /// The part of a cube that lies in the box: first and end voxel relative to the box, and the cube's own start.
    fn clip(&self, origin: [i32; 3], log2: u32) -> Option<[(usize, usize, i64); 3]> {
        let mut out = [(0, 0, 0); 3];
        for a in 0..3 {
            let start = i64::from(origin[a]) - i64::from(self.origin[a]);
            let (low, end) = (start.max(0), (start + (1 << log2)).min(self.dims[a] as i64));
            if low >= end {
                return None;
            }
            out[a] = (low as usize, end as usize, start);
        }
        Some(out)
    }

    fn put_tile(&mut self, origin: [i32; 3], log2: u32, value: f32, active: bool) {
        let Some([(x0, x1, _), (y0, y1, _), (z0, z1, _)]) = self.clip(origin, log2) else { return };
        for z in z0..z1 {
            for y in y0..y1 {
                let row = self.dims[0] * (y + self.dims[1] * z);
                self.values[row + x0..row + x1].fill(value);
                if active {
                    self.active.set_range(row + x0..row + x1);
                }
            }
        }
    }

    fn put_leaf(&mut self, leaf: &Leaf, values: &[f32; 512]) {
        let Some([(x0, x1, xs), (y0, y1, ys), (z0, z1, zs)]) = self.clip(leaf.origin, LEAF_LOG2) else { return };
        let skipped = (x0 as i64 - xs) as usize;
        for z in z0..z1 {
            for y in y0..y1 {
                // Bit and value of (x, y, z) in a leaf: word x, bit 8 y + z.
                let at = 8 * (y as i64 - ys) as usize + (z as i64 - zs) as usize;
                let row = self.dims[0] * (y + self.dims[1] * z) + x0;
                let mut bits = 0;
                for (i, to) in self.values[row..row + x1 - x0].iter_mut().enumerate() {
                    let x = (i + skipped) & 7;
                    *to = values[64 * x + at];
                    bits |= (leaf.mask[x] >> at & 1) << i;
                }
                self.active.or_bits(row, bits);
            }
        }
    }
}
