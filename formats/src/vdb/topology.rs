//! The tree of a grid, walked once from root to leaves: every tile and every leaf, with nothing kept.
//!
//! The root holds tiles and children of 4096³ voxels, keyed by their first voxel. A child has 32³ slots of 128³ voxels,
//! each of those 16³ slots of 8³, and a leaf 8³ voxels; z runs fastest in a node. A node stores a child mask, a value
//! mask (active tiles), and its values; then its children follow. Leaves store their value mask only: their values come
//! after the whole topology, in the same order.
//! Cost: reading 32768 + 4096 slots per inner node. Source: OpenVDB 12, `readTopology` of `tree/RootNode.h`,
//! `tree/InternalNode.h` and `tree/LeafNode.h`.

use super::values::{NodeHead, ValueReader};
use crate::Result;
use crate::bounded::Bytes;
use std::collections::BTreeSet;

/// log2 of the side of a child of the root, in voxels.
pub(super) const ROOT_CHILD_LOG2: u32 = 12;
/// log2 of the side of a leaf, in voxels.
pub(super) const LEAF_LOG2: u32 = 3;
/// log2 of the side of a slot, and of the number of slots along one axis, for the two inner levels.
pub(super) const INNER_LEVELS: [(u32, u32); 2] = [(7, 5), (3, 4)];
/// The active voxels of a leaf: bit `z + 8 y` of word `x`.
pub(super) type LeafMask = [u64; 8];

/// What a walk meets.
pub(super) enum Node {
    /// A cube of `2^log2` voxels a side with one value. Inactive tiles of background value are not reported.
    Tile {
        /// First voxel.
        origin: [i32; 3],
        /// log2 of the side.
        log2: u32,
        /// The value of all its voxels.
        value: f32,
        /// Their state.
        active: bool,
    },
    /// A leaf, whose values come later in the file.
    Leaf {
        /// First voxel.
        origin: [i32; 3],
        /// Its active voxels.
        mask: LeafMask,
    },
}

/// Walks the tree at `bytes` and ends behind it; `visit` gets the background value and each node, in file order.
///
/// For grids that are not float the values are stepped over: the background is 0, and there are leaves only.
pub(super) fn walk(
    bytes: &mut Bytes,
    reader: &mut ValueReader,
    visit: &mut dyn FnMut(f32, Node) -> Result<()>,
) -> Result<f32> {
    let buffers = bytes.i32("buffer count of the tree")?;
    if buffers != 1 {
        return Err(bytes.invalid("buffer count of the tree", buffers, 1));
    }
    let is_float = reader.size().full == 4;
    let value_of = |raw: &[u8]| raw.try_into().map_or(0.0, f32::from_le_bytes);
    let background = value_of(bytes.take(reader.size().full, "background value")?);
    let tiles = bytes.u32("tiles of the root")?;
    let children = bytes.u32("children of the root")?;
    let least = u64::from(tiles) * (13 + reader.size().full as u64) + u64::from(children) * (12 + 8192 + 1);
    if least > bytes.remaining() as u64 {
        let found = format!("{tiles} tiles and {children} children");
        return Err(bytes.invalid("root node", found, format!("what fits in {} bytes", bytes.remaining())));
    }
    let mut keys = BTreeSet::new();
    let mut key = |bytes: &mut Bytes| -> Result<[i32; 3]> {
        let what = "key of a root entry";
        let key = [bytes.i32(what)?, bytes.i32(what)?, bytes.i32(what)?];
        if key.iter().any(|k| k & ((1 << ROOT_CHILD_LOG2) - 1) != 0) {
            return Err(bytes.invalid(what, format!("{key:?}"), "multiples of 4096"));
        }
        // Two entries for one place would make every count and every bound of this reader wrong.
        if !keys.insert(key) {
            return Err(bytes.invalid(what, format!("{key:?} twice"), "each key once"));
        }
        Ok(key)
    };
    for _ in 0..tiles {
        let origin = key(bytes)?;
        let value = value_of(bytes.take(reader.size().full, "value of a root tile")?);
        let active = bytes.u8("state of a root tile")? != 0;
        if is_float && (active || value.to_bits() != background.to_bits()) {
            visit(background, Node::Tile { origin, log2: ROOT_CHILD_LOG2, value, active })?;
        }
    }
    let mut walk = Walk { reader, visit, background, is_float, values: Vec::new() };
    for _ in 0..children {
        let origin = key(bytes)?;
        walk.inner(bytes, origin, &INNER_LEVELS)?;
    }
    Ok(background)
}

struct Walk<'w> {
    reader: &'w mut ValueReader,
    visit: &'w mut dyn FnMut(f32, Node) -> Result<()>,
    background: f32,
    is_float: bool,
    /// Values of the node at hand; a node is done with them before its children begin.
    values: Vec<f32>,
}

impl Walk<'_> {
    fn inner(&mut self, bytes: &mut Bytes, origin: [i32; 3], levels: &[(u32, u32)]) -> Result<()> {
        let Some((&(slot_log2, side_log2), below)) = levels.split_first() else {
            let mut mask = LeafMask::default();
            read_mask(bytes, &mut mask)?;
            return (self.visit)(self.background, Node::Leaf { origin, mask });
        };
        let words = 1usize << (3 * side_log2 - 6);
        let (mut children, mut active) = (vec![0; words], vec![0; words]);
        read_mask(bytes, &mut children)?;
        read_mask(bytes, &mut active)?;
        let head = self.reader.head(bytes, &active, self.background)?;
        let place = |slot: usize| {
            let side_mask = (1 << side_log2) - 1;
            let at = |shift: u32| ((slot >> (shift * side_log2) & side_mask) << slot_log2) as i32;
            [origin[0] + at(2), origin[1] + at(1), origin[2] + at(0)]
        };
        if self.is_float {
            self.tiles(bytes, &head, &children, &active, slot_log2, &place)?;
        } else {
            self.reader.skip_block(bytes, &head)?;
        }
        for slot in set_bits(&children) {
            self.inner(bytes, place(slot), below)?;
        }
        Ok(())
    }

    fn tiles(
        &mut self,
        bytes: &mut Bytes,
        head: &NodeHead,
        children: &[u64],
        active: &[u64],
        log2: u32,
        place: &dyn Fn(usize) -> [i32; 3],
    ) -> Result<()> {
        let mut values = std::mem::take(&mut self.values);
        values.resize(active.len() * 64, 0.0);
        self.reader.values(bytes, head, active, &mut values)?;
        let background = self.background.to_bits();
        for (w, values) in values.chunks_exact(64).enumerate() {
            let differs = values.iter().rev().fold(0, |bits, v| bits << 1 | u64::from(v.to_bits() != background));
            let mut tiles = (differs | active[w]) & !children[w];
            while tiles != 0 {
                let bit = tiles.trailing_zeros() as usize;
                let (origin, active) = (place(w * 64 + bit), active[w] >> bit & 1 == 1);
                (self.visit)(self.background, Node::Tile { origin, log2, value: values[bit], active })?;
                tiles &= tiles - 1;
            }
        }
        self.values = values;
        Ok(())
    }
}

/// Reads a mask, 64 bits a word.
pub(super) fn read_mask(bytes: &mut Bytes, mask: &mut [u64]) -> Result<()> {
    let raw = bytes.take(mask.len() * 8, "node mask")?;
    for (word, raw) in mask.iter_mut().zip(raw.chunks_exact(8)) {
        *word = raw.iter().rev().fold(0, |w, &b| w << 8 | u64::from(b));
    }
    Ok(())
}

fn set_bits(words: &[u64]) -> impl Iterator<Item = usize> + '_ {
    words.iter().enumerate().flat_map(|(w, &word)| {
        let bits = std::iter::successors(Some(word), |b| Some(b & b.wrapping_sub(1))).take_while(|&b| b != 0);
        bits.map(move |b| w * 64 + b.trailing_zeros() as usize)
    })
}
