//! Resident layout B of the residual: a perfect spatial hash over a tile of up to 27 consecutive frames.
//!
//! The frames of a tile lie in one domain, 3 x 3 x 3, each at `spacing * (f % 3, f / 3 % 3, f / 9)` where `spacing` is
//! the largest box of the tile (at least [`LEAST_SPACING`]). A voxel at `p` of that domain has its code in slot
//!
//! ```text
//! h0 = p mod m,  h1 = p mod r,  slot = (h0 + step * offsets[h1]) mod m        (per axis; Lefebvre and Hoppe 2006, eq. 1)
//! ```
//!
//! of m^3 slots of 1, 2 or 4 bytes, with r^3 offsets of 3 x 8 bits. Only codes that are not zero have a slot. A hash
//! answers garbage outside its keys, so each frame also keeps two bits of domain: the support, and which of its codes
//! are not zero, as masks of 4^3 cells in bricks (see [`super::brick`]), left out where they are all ones or all zeros:
//!
//! ```text
//! word 0           bits 0-7 cells with support, 8-15 full cells, 16-23 cells with some but not only codes of zero,
//!                  24-31 cells with only codes of zero
//! 2 words a cell   support of each cell that is not full
//! 2 words a cell   codes that are not zero, of each cell of bits 16-23
//! ```
//!
//! Zhou et al. 2008 (section 5.1) use 8-bit codes and say nothing of empty voxels; wider slots and the domain bits are
//! our additions. `step = ceil(m / 256)` keeps the offsets at 8 bits for tables with m > 256.
//!
//! Cost: a lookup reads a table word, one to five words of the brick, three bytes of offset and one slot. On dense
//! codes it is larger than [`super::rank`] (m^3 slots, about 8 bits of offsets a code, domain bits); it is the smaller
//! one where few codes of the support differ from zero. On the real frames of [`super::rank`] it takes 31 to 36 bits a
//! voxel at 59 dB and 22 to 29 at 47 dB, four times the rank layout.

use super::brick::{Brick, bricks_of, cell_and_bit, for_each_brick, from_bricks, mask_at, overhang, word};
use super::rank::EMPTY;
use super::{MAX_CODE, ResidualCodes, voxels_of};
use crate::bounded::{Bytes, MAX_DENSE_VOXELS};
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Frames of a tile, at most.
pub const MAX_FRAMES: usize = 27;
/// Bytes before the frames' heads.
pub const HEADER_BYTES: usize = 64;
/// Bytes of one frame's head.
pub const FRAME_BYTES: usize = 64;
/// Smallest distance between two frames of a tile, so that frames of one voxel do not fall on each other's hash.
pub const LEAST_SPACING: u32 = 3;
/// Largest side of the table.
pub const MAX_SIDE: u32 = 1024;

/// The function of a perfect hash: what is searched for at bake time. No table at all is `side == 0`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HashTable {
    /// Slots along each axis, m.
    pub side: u32,
    /// Offsets along each axis, r.
    pub offset_side: u32,
    /// Three bytes for each of the r^3 offsets, x fastest.
    pub offsets: Vec<u8>,
}

/// What an offset is multiplied by, so that eight bits reach across a table of this side.
#[inline]
pub fn offset_step(side: u32) -> u32 {
    side.div_ceil(256)
}

/// The slot of domain position `p` under `offsets` (r^3 times three bytes).
#[inline]
pub fn slot_of(side: u32, offset_side: u32, offsets: &[u8], p: [u32; 3]) -> usize {
    let h1 = p.map(|p| (p % offset_side) as usize);
    let r = offset_side as usize;
    let at = 3 * (h1[0] + r * (h1[1] + r * h1[2]));
    let step = offset_step(side);
    let slot = |axis: usize| ((p[axis] % side + step * u32::from(offsets[at + axis])) % side) as usize;
    let m = side as usize;
    slot(0) + m * (slot(1) + m * slot(2))
}

/// The distance between frames of a tile whose largest sides are the maxima of `dims`.
pub fn spacing(dims: impl Iterator<Item = [u32; 3]>) -> [u32; 3] {
    dims.fold([LEAST_SPACING; 3], |most, d| [0, 1, 2].map(|a| most[a].max(d[a])))
}

/// Where frame `frame` of a tile starts in the tile's domain.
pub fn frame_start(frame: usize, spacing: [u32; 3]) -> [u32; 3] {
    let at = [frame % 3, frame / 3 % 3, frame / 9];
    [0, 1, 2].map(|a| at[a] as u32 * spacing[a])
}

/// Calls `each(domain position, code)` for every code of the tile that is not zero, frame by frame, in voxel order.
pub fn for_each_key(frames: &[ResidualCodes], mut each: impl FnMut([u32; 3], i32)) {
    let spacing = spacing(frames.iter().map(|f| f.dims));
    for (number, frame) in frames.iter().enumerate() {
        let start = frame_start(number, spacing);
        let (nx, ny) = (frame.dims[0], frame.dims[1]);
        // The support is ascending, so the row only ever moves on: no division a voxel.
        let (mut row, mut y, mut z) = (0usize, 0u32, 0u32);
        for (v, &code) in frame.support.iter_set().zip(&frame.codes) {
            if v - row >= nx as usize {
                let rows = (v / nx as usize) as u32;
                (row, y, z) = (rows as usize * nx as usize, rows % ny, rows / ny);
            }
            if code != 0 {
                each([start[0] + (v - row) as u32, start[1] + y, start[2] + z], code);
            }
        }
    }
}

/// The resident bytes of a tile: 1 to [`MAX_FRAMES`] frames and the hash function found for them.
///
/// Fails if two codes fall into one slot, or the sides are not those of a table for these codes. `path` is named in
/// errors. The same input always gives the same bytes.
///
/// # Panics
/// If a frame fails [`ResidualCodes::check`].
pub fn assemble(path: &Path, frames: &[ResidualCodes], table: &HashTable) -> Result<Vec<u8>> {
    let keys: u64 = frames.iter().map(|f| f.codes.iter().filter(|&&c| c != 0).count() as u64).sum();
    let widest = frames.iter().flat_map(|f| &f.codes).map(|c| c.unsigned_abs()).max().unwrap_or(0);
    let slot_bytes = [1usize, 2, 4][usize::from(widest > 127) + usize::from(widest > 32_767)];
    let slots = check_sides(path, table.side, table.offset_side, keys)?;
    if table.offsets.len() as u64 != 3 * u64::from(table.offset_side).pow(3) {
        let expected = format!("3 x {}^3", table.offset_side);
        return Err(Error::invalid(path, "hash.offsets", table.offsets.len(), expected));
    }
    if frames.is_empty() || frames.len() > MAX_FRAMES {
        return Err(Error::invalid(path, "hash.frames", frames.len(), format!("1 to {MAX_FRAMES}")));
    }
    let mut bytes = vec![];
    let spacing = spacing(frames.iter().map(|f| f.dims));
    let head = [frames.len() as u32, table.side, table.offset_side, offset_step(table.side), slot_bytes as u32];
    head.iter().chain(&spacing).for_each(|w| bytes.extend(w.to_le_bytes()));
    bytes.extend(keys.to_le_bytes());
    bytes.resize(HEADER_BYTES + FRAME_BYTES * frames.len(), 0);
    bytes.extend(&table.offsets);
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    let first = bytes.len();
    bytes.resize((first + slots * slot_bytes).next_multiple_of(4), 0);
    let mut clash = None;
    for_each_key(frames, |p, code| {
        let slot = slot_of(table.side, table.offset_side, &table.offsets, p);
        let at = &mut bytes[first + slot * slot_bytes..][..slot_bytes];
        // A code is never zero here, so a slot that is not zero is taken.
        if at.iter().any(|&b| b != 0) {
            clash = clash.or(Some(p));
        }
        at.copy_from_slice(&code.to_le_bytes()[..slot_bytes]);
    });
    if let Some(p) = clash {
        return Err(Error::invalid(path, "hash.offsets", format!("two codes in the slot of {p:?}"), "one"));
    }
    for (number, frame) in frames.iter().enumerate() {
        let start = bytes.len() as u64;
        let mut table = vec![EMPTY; bricks_of(frame.dims).iter().map(|&b| b as usize).product()];
        let mut stream: Vec<u32> = vec![];
        for_each_brick(frame, |number, brick| {
            table[number] = stream.len() as u32;
            push_brick(brick, &mut stream);
        });
        table.iter().chain(&stream).for_each(|w| bytes.extend(w.to_le_bytes()));
        let mut head = vec![];
        frame.origin.iter().for_each(|o| head.extend(o.to_le_bytes()));
        frame.dims.iter().for_each(|d| head.extend(d.to_le_bytes()));
        let nonzero = frame.codes.iter().filter(|&&c| c != 0).count() as u64;
        for value in [frame.codes.len() as u64, nonzero, start, stream.len() as u64] {
            head.extend(value.to_le_bytes());
        }
        let at = HEADER_BYTES + FRAME_BYTES * number;
        bytes[at..at + head.len()].copy_from_slice(&head);
    }
    Ok(bytes)
}

fn push_brick(brick: &Brick, stream: &mut Vec<u32>) {
    let nonzero = |cell: usize| {
        let codes = &brick.codes[64 * cell..64 * cell + 64];
        codes.iter().enumerate().fold(0u64, |m, (bit, &c)| m | u64::from(c != 0) << bit) & brick.masks[cell]
    };
    let (mut head, mut support, mut domain) = (0u32, vec![], vec![]);
    for (cell, &mask) in brick.masks.iter().enumerate().filter(|(_, m)| **m != 0) {
        head |= 1 << cell;
        match mask {
            u64::MAX => head |= 1 << (8 + cell),
            _ => support.extend([mask as u32, (mask >> 32) as u32]),
        }
        let keys = nonzero(cell);
        if keys == 0 {
            head |= 1 << (24 + cell);
        } else if keys != mask {
            head |= 1 << (16 + cell);
            domain.extend([keys as u32, (keys >> 32) as u32]);
        }
    }
    stream.push(head);
    stream.extend(support);
    stream.extend(domain);
}

/// The number of slots, at most 16 for each code plus 2^18, if the sides can be those of a table with `keys` codes.
pub(crate) fn check_sides(path: &Path, side: u32, offset_side: u32, keys: u64) -> Result<usize> {
    let none = keys == 0 && side == 0 && offset_side == 0;
    let some = keys > 0 && (1..=MAX_SIDE).contains(&side) && (1..=MAX_SIDE).contains(&offset_side);
    let cube = |side: u32| u64::from(side).pow(3);
    // A search ends well below this; a file that claims more would cost memory that its codes do not need.
    let most = keys.saturating_mul(16).saturating_add(1 << 18);
    let slots = if some { cube(side) } else { 0 };
    if !(none || some && keys <= slots && slots.max(cube(offset_side)) <= most) {
        let found = format!("{side}^3 slots and {offset_side}^3 offsets");
        return Err(Error::invalid(path, "hash.sides", found, format!("a table for {keys} codes")));
    }
    Ok(slots as usize)
}

/// One frame's head, checked.
#[derive(Clone, Debug)]
struct Frame {
    origin: [i32; 3],
    dims: [u32; 3],
    active: u64,
    bricks: [u32; 3],
    start: [u32; 3],
    /// Words, counted from the start of the bytes.
    table: usize,
    stream: usize,
}

/// A checked view of the resident bytes of one tile.
#[derive(Clone, Debug)]
pub struct HashView<B = Vec<u8>> {
    bytes: B,
    /// Named in errors.
    path: PathBuf,
    frames: Vec<Frame>,
    side: u32,
    offset_side: u32,
    slot_bytes: usize,
    /// Bytes, counted from the start.
    offsets: usize,
    slots: usize,
}

impl<B: AsRef<[u8]>> HashView<B> {
    /// Checks all heads, table words and masks so that no lookup can leave the bytes; `path` is the file that errors name.
    ///
    /// The codes in the slots are checked by [`HashView::codes`].
    pub fn new(path: &Path, bytes: B) -> Result<Self> {
        let wrong = |what: &str, found: String, expected: String| Err(Error::invalid(path, what, found, expected));
        let all = bytes.as_ref();
        let mut head = Bytes::new(path, all);
        let count = head.u32("hash.frames")? as usize;
        if !(1..=MAX_FRAMES).contains(&count) {
            return wrong("hash.frames", count.to_string(), format!("1 to {MAX_FRAMES}"));
        }
        let (side, offset_side) = (head.u32("hash.side")?, head.u32("hash.offset_side")?);
        let (step, slot_bytes) = (head.u32("hash.offset_step")?, head.u32("hash.slot_bytes")? as usize);
        let spaced = [head.u32("hash.spacing")?, head.u32("hash.spacing")?, head.u32("hash.spacing")?];
        let keys = head.u64("hash.keys")?;
        if spaced.iter().any(|&s| u64::from(s) > MAX_DENSE_VOXELS) {
            return wrong("hash.spacing", format!("{spaced:?}"), format!("at most {MAX_DENSE_VOXELS}"));
        }
        if step != offset_step(side) {
            return wrong("hash.offset_step", step.to_string(), offset_step(side).to_string());
        }
        if ![1, 2, 4].contains(&slot_bytes) {
            return wrong("hash.slot_bytes", slot_bytes.to_string(), "1, 2 or 4".into());
        }
        if head.take(HEADER_BYTES - 40, "hash.reserved")?.iter().any(|&b| b != 0) {
            return wrong("hash.reserved", "a byte that is not zero".into(), "zeros".into());
        }
        let slots = check_sides(path, side, offset_side, keys)? as u64;
        let offsets = HEADER_BYTES + FRAME_BYTES * count;
        let first_slot = (offsets as u64 + 3 * u64::from(offset_side).pow(3)).next_multiple_of(4);
        let end = (first_slot + slots * slot_bytes as u64).next_multiple_of(4);
        if end > all.len() as u64 {
            return wrong("hash.length", format!("{} bytes", all.len()), format!("at least {end}"));
        }
        let mut next = end;
        let (mut frames, mut total) = (vec![], 0u64);
        for number in 0..count {
            let field = |name: &str| format!("hash.frames[{number}].{name}");
            let origin = [head.i32("hash.origin")?, head.i32("hash.origin")?, head.i32("hash.origin")?];
            let dims = [head.u32("hash.dims")?, head.u32("hash.dims")?, head.u32("hash.dims")?];
            voxels_of(path, dims)?;
            let (active, nonzero) = (head.u64("hash.active_voxels")?, head.u64("hash.nonzero")?);
            let (start, words) = (head.u64("hash.start")?, head.u64("hash.stream_words")?);
            if head.u64("hash.reserved")? != 0 {
                return wrong(&field("reserved"), "a byte that is not zero".into(), "zeros".into());
            }
            let bricks = bricks_of(dims);
            let table: u64 = bricks.iter().map(|&b| u64::from(b)).product();
            let after = words.checked_add(table).and_then(|w| w.checked_mul(4)).and_then(|b| b.checked_add(next));
            let Some(after) = after.filter(|&a| start == next && a <= all.len() as u64) else {
                return wrong(&field("start"), format!("byte {start}, {words} words"), format!("from byte {next}"));
            };
            let table_at = (start / 4) as usize;
            let frame = Frame {
                origin,
                dims,
                active,
                bricks,
                start: frame_start(number, spaced),
                table: table_at,
                stream: table_at + table as usize,
            };
            let found = check_frame(path, all, &frame, words as usize, number)?;
            if found != (active, nonzero) {
                return wrong(&field("active_voxels"), format!("{active}, {nonzero}"), format!("{found:?}"));
            }
            total += nonzero;
            next = after;
            frames.push(frame);
        }
        if spaced != spacing(frames.iter().map(|f| f.dims)) {
            return wrong("hash.spacing", format!("{spaced:?}"), "the largest box of the tile".into());
        }
        if next != all.len() as u64 || total != keys {
            return wrong("hash.length", format!("{} bytes, {keys} codes", all.len()), format!("{next}, {total}"));
        }
        Ok(Self {
            bytes,
            path: path.to_owned(),
            frames,
            side,
            offset_side,
            slot_bytes,
            offsets,
            slots: first_slot as usize,
        })
    }

    /// Frames of the tile.
    pub fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Origin and dims of the box of `frame < frames()`.
    pub fn frame_box(&self, frame: usize) -> ([i32; 3], [u32; 3]) {
        (self.frames[frame].origin, self.frames[frame].dims)
    }

    /// Voxels of the support of `frame < frames()`.
    pub fn active_voxels(&self, frame: usize) -> u64 {
        self.frames[frame].active
    }

    /// The hash function.
    pub fn table(&self) -> HashTable {
        let length = 3 * (self.offset_side as usize).pow(3);
        let offsets = self.bytes.as_ref()[self.offsets..self.offsets + length].to_vec();
        HashTable { side: self.side, offset_side: self.offset_side, offsets }
    }

    /// The resident bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.as_ref()
    }

    #[inline]
    fn slot(&self, p: [u32; 3]) -> i32 {
        let all = self.bytes.as_ref();
        let slot = slot_of(self.side, self.offset_side, &all[self.offsets..], p);
        let at = &all[self.slots + slot * self.slot_bytes..];
        match self.slot_bytes {
            1 => i32::from(at[0] as i8),
            2 => i32::from(i16::from_le_bytes([at[0], at[1]])),
            _ => i32::from_le_bytes([at[0], at[1], at[2], at[3]]),
        }
    }

    /// The code of the voxel at `voxel` in the box of `frame < frames()`; none outside the support or the box.
    #[inline]
    pub fn code(&self, frame: usize, voxel: [u32; 3]) -> Option<i32> {
        let frame = &self.frames[frame];
        let [x, y, z] = voxel;
        if !(x < frame.dims[0] && y < frame.dims[1] && z < frame.dims[2]) {
            return None;
        }
        let all = self.bytes.as_ref();
        let number = x / 8 + frame.bricks[0] * (y / 8 + frame.bricks[1] * (z / 8));
        let at = word(all, frame.table + number as usize);
        if at == EMPTY {
            return None;
        }
        let brick = frame.stream + at as usize;
        let (cell, bit) = cell_and_bit(voxel);
        let (support, keys) = cell_masks(all, brick, word(all, brick), cell);
        if support >> bit & 1 == 0 {
            return None;
        }
        if keys >> bit & 1 == 0 {
            return Some(0);
        }
        Some(self.slot([0, 1, 2].map(|a| frame.start[a] + voxel[a])))
    }

    /// All codes of `frame < frames()`. Fails if a slot holds zero or a code that is too large.
    pub fn codes(&self, frame: usize) -> Result<ResidualCodes> {
        let about = &self.frames[frame];
        let all = self.bytes.as_ref();
        let [bx, by, _] = about.bricks;
        let wrong = std::cell::Cell::new(None);
        let codes = from_bricks(about.origin, about.dims, |each| {
            let mut brick = Brick::default();
            for number in 0..(about.stream - about.table) as u32 {
                let at = word(all, about.table + number as usize);
                if at == EMPTY {
                    continue;
                }
                let start = about.stream + at as usize;
                let first = [number % bx, number / bx % by, number / bx / by];
                for cell in 0..8u32 {
                    let (support, keys) = cell_masks(all, start, word(all, start), cell);
                    brick.masks[cell as usize] = support;
                    let mut left = support;
                    while left != 0 {
                        let bit = left.trailing_zeros();
                        let mut code = 0;
                        if keys >> bit & 1 == 1 {
                            let local = [
                                (cell & 1) * 4 + (bit & 3),
                                (cell >> 1 & 1) * 4 + (bit >> 2 & 3),
                                (cell >> 2) * 4 + (bit >> 4),
                            ];
                            code = self.slot([0, 1, 2].map(|a| about.start[a] + 8 * first[a] + local[a]));
                            if code == 0 || code.unsigned_abs() > MAX_CODE as u32 {
                                wrong.set(Some(code));
                            }
                        }
                        brick.codes[(64 * cell + bit) as usize] = code;
                        left &= left - 1;
                    }
                }
                each(number as usize, &brick);
            }
        });
        match wrong.get() {
            Some(code) => {
                let what = format!("hash.frames[{frame}].codes");
                Err(Error::invalid(&self.path, what, code, format!("not zero, within ±{MAX_CODE}")))
            }
            None => Ok(codes),
        }
    }
}

/// Support and keys of one cell of the brick at word `brick`, whose first word is `head`.
#[inline]
fn cell_masks(all: &[u8], brick: usize, head: u32, cell: u32) -> (u64, u64) {
    let (occupied, full, mixed) = (head & 255, head >> 8 & 255, head >> 16 & 255);
    if occupied >> cell & 1 == 0 {
        return (0, 0);
    }
    let below = (1 << cell) - 1;
    let partial = occupied & !full;
    let support = match full >> cell & 1 {
        1 => u64::MAX,
        _ => mask_at(all, brick + 1 + 2 * (partial & below).count_ones() as usize),
    };
    let keys = if head >> (24 + cell) & 1 == 1 {
        0
    } else if mixed >> cell & 1 == 1 {
        mask_at(all, brick + 1 + 2 * (partial.count_ones() + (mixed & below).count_ones()) as usize)
    } else {
        support
    };
    (support, keys)
}

/// Checks one frame's bricks; gives its support and its keys.
fn check_frame(path: &Path, all: &[u8], frame: &Frame, words: usize, number: usize) -> Result<(u64, u64)> {
    let (mut next, mut voxels, mut nonzero) = (0usize, 0u64, 0u64);
    for brick in 0..frame.stream - frame.table {
        let wrong = |field: &str, found: String, expected: &str| {
            Err(Error::invalid(path, format!("hash.frames[{number}].bricks[{brick}].{field}"), found, expected))
        };
        let at = word(all, frame.table + brick);
        if at == EMPTY {
            continue;
        }
        if at as usize != next || next >= words {
            return wrong("start", format!("word {at}"), "the word after the brick before it, in the stream");
        }
        let head = word(all, frame.stream + next);
        let (occupied, full, mixed, zero) = (head & 255, head >> 8 & 255, head >> 16 & 255, head >> 24);
        if occupied == 0 || (full | mixed | zero) & !occupied != 0 || mixed & zero != 0 {
            return wrong("head", format!("{head:#x}"), "cells, and flags of those cells alone");
        }
        let after = next + 1 + 2 * ((occupied & !full).count_ones() + mixed.count_ones()) as usize;
        if after > words {
            return wrong("head", format!("{head:#x}"), "cells that end inside the stream");
        }
        for cell in (0..8).filter(|c| occupied >> c & 1 == 1) {
            let (support, keys) = cell_masks(all, frame.stream + next, head, cell);
            let is_full = full >> cell & 1 == 1;
            if support == 0 || (support == u64::MAX) != is_full || support & overhang(frame.dims, brick, cell) != 0 {
                return wrong("support", format!("{support:#x}"), "not empty, full only where marked, inside the box");
            }
            let is_mixed = mixed >> cell & 1 == 1;
            if keys & !support != 0 || is_mixed && (keys == 0 || keys == support) {
                return wrong("keys", format!("{keys:#x}"), "some but not all of the support");
            }
            voxels += u64::from(support.count_ones());
            nonzero += u64::from(keys.count_ones());
        }
        next = after;
    }
    if next != words {
        let found = format!("{words} words");
        return Err(Error::invalid(path, format!("hash.frames[{number}].stream_words"), found, next));
    }
    Ok((voxels, nonzero))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::residual::tests::{Pcg, ball, empty, frames_of_every_kind};

    /// A hash that needs no search: a table as wide as the domain, and no offsets.
    pub(crate) fn trivial(frames: &[ResidualCodes]) -> HashTable {
        let spacing = spacing(frames.iter().map(|f| f.dims));
        let across = if frames.len() > 1 { 3 } else { 1 };
        let side = across * spacing.iter().max().copied().unwrap_or(0);
        match frames.iter().any(|f| f.codes.iter().any(|&c| c != 0)) {
            true => HashTable { side, offset_side: 1, offsets: vec![0; 3] },
            false => HashTable::default(),
        }
    }

    fn tile() -> Vec<ResidualCodes> {
        let mut frames: Vec<_> = (0..10).map(|i| ball([9 + i % 3, 12, 10], 40, u64::from(i))).collect();
        frames[4] = empty();
        frames[7].codes.iter_mut().for_each(|c| *c = 0);
        frames[8].codes.iter_mut().step_by(2).for_each(|c| *c = 0);
        frames
    }

    fn view(bytes: Vec<u8>) -> Result<HashView> {
        HashView::new(Path::new("p"), bytes)
    }

    fn check(frames: &[ResidualCodes]) {
        let view = view(assemble(Path::new("p"), frames, &trivial(frames)).unwrap()).unwrap();
        assert_eq!(view.frames(), frames.len());
        assert_eq!(view.table(), trivial(frames));
        for (number, frame) in frames.iter().enumerate() {
            assert_eq!(&view.codes(number).unwrap(), frame);
            assert_eq!(view.frame_box(number), (frame.origin, frame.dims));
            let mut next = frame.codes.iter();
            for v in 0..frame.support.len() as u32 {
                let voxel = [v % frame.dims[0], v / frame.dims[0] % frame.dims[1], v / frame.dims[0] / frame.dims[1]];
                let expected = frame.support.get(v as usize).then(|| *next.next().unwrap());
                assert_eq!(view.code(number, voxel), expected);
            }
            assert_eq!(view.code(number, frame.dims), None);
        }
    }

    #[test]
    fn a_tile_comes_back_in_bulk_and_voxel_by_voxel() {
        check(&tile());
        check(&tile()[4..5]);
        check(&tile()[7..8]);
        // One at a time: a trivial table for the longest thin frame would be large.
        frames_of_every_kind().into_iter().filter(|f| f.dims[0] < 100).for_each(|f| check(&[f]));
    }

    #[test]
    fn codes_of_zero_need_no_table_and_answer_zero() {
        let bytes = assemble(Path::new("p"), &tile()[7..8], &HashTable::default()).unwrap();
        assert!(bytes.len() < 600, "{}", bytes.len());
    }

    #[test]
    #[rustfmt::skip]
    fn one_voxel_has_golden_bytes() {
        let mut support = crate::volume::VoxelMask::new(2);
        support.set(1);
        let frame = ResidualCodes { origin: [7, 0, -1], dims: [2, 1, 1], support, codes: vec![-300] };
        let table = HashTable { side: 1, offset_side: 1, offsets: vec![9, 9, 9] };
        let words: [i32; 37] = [
            1, 1, 1, 1, 2, 3, 3, 3, 1, 0, 0, 0, 0, 0, 0, 0, // frames, m, r, step, bytes a slot, spacing, 1 code
            7, 0, -1, 2, 1, 1, 1, 0, 1, 0, 136, 0, 3, 0, 0, 0, // origin, dims, 1 voxel, 1 code, from byte 136, 3 words
            0x0009_0909, 0xfed4, // offsets, slot
            0, 1, 2, // table; brick: cell 0; its support (low half)
        ];
        let mut expected: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
        expected.extend([0; 4]);
        assert_eq!(assemble(Path::new("p"), &[frame], &table).unwrap(), expected);
    }

    #[test]
    fn two_codes_in_one_slot_are_an_error() {
        let frames = [ball([4, 4, 4], 40, 1), ball([4, 4, 4], 40, 2)];
        let keys = frames.iter().flat_map(|f| &f.codes).filter(|&&c| c != 0).count() as f64;
        let side = keys.cbrt().ceil() as u32;
        let table = HashTable { side, offset_side: 1, offsets: vec![0; 3] };
        let message = assemble(Path::new("p"), &frames, &table).unwrap_err().to_string();
        assert!(message.contains("two codes"), "{message}");
    }

    #[test]
    fn every_prefix_and_an_extra_byte_are_refused() {
        let bytes = assemble(Path::new("p"), &tile()[..3], &trivial(&tile()[..3])).unwrap();
        for length in (0..bytes.len()).step_by(7).chain(bytes.len() - 100..bytes.len()) {
            assert!(view(bytes[..length].to_vec()).is_err(), "{length}");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert!(view(longer).is_err());
    }

    #[test]
    fn hostile_counts_and_flipped_bits_never_panic() {
        let frames = &tile()[6..10];
        let bytes = assemble(Path::new("p"), frames, &trivial(frames)).unwrap();
        for at in (0..HEADER_BYTES + FRAME_BYTES * frames.len()).step_by(4) {
            for value in [0, 1, u32::MAX, 1 << 28, 1 << 31] {
                let mut bad = bytes.clone();
                bad[at..at + 4].copy_from_slice(&u32::to_le_bytes(value));
                let origin = at >= HEADER_BYTES && (at - HEADER_BYTES) % FRAME_BYTES < 12;
                assert!(bad == bytes || origin || view(bad).is_err(), "{at} {value}");
            }
        }
        let mut random = Pcg(1);
        let masks = bytes.len() - 2000;
        for i in 0..3000 {
            let mut bad = bytes.clone();
            let bit =
                if i % 2 == 0 { random.below(8 * bad.len() as u32) } else { 8 * masks as u32 + random.below(16_000) };
            bad[bit as usize / 8] ^= 1 << (bit % 8);
            if let Ok(view) = view(bad) {
                (0..frames.len()).for_each(|f| drop(view.codes(f)));
            }
        }
    }
}
