//! Resident layout A of the residual: support masks, ranks and bit-packed codes. One frame, one lookup, no search.
//!
//! A dense table has one word a brick of 8^3 voxels: where the brick starts in the word stream, or [`EMPTY`]. A brick
//! holds, in this order and only for cells (4^3 voxels) that have support,
//!
//! ```text
//! word 0        bits 0-7 cells with support, 8-15 cells whose 64 voxels all have support, 16-20 shift
//! word 1        smallest code of the brick, i32
//! a word a cell bits 0-4 width, 5-18 first bit of its values in the brick, 19-31 (smallest code - brick's) >> shift
//! 2 words a cell that is not full: its mask
//! values        code - cell's base, `width` bits each, in voxel order, cells in order, no gaps, low bits first
//! ```
//!
//! A cell's base is `word 1 + (bits 19-31 << shift)`; the shift (0 unless a brick's codes span more than 13 bits) makes
//! every range of 24-bit codes fit. The rank of a voxel is the popcount of its cell's mask below it.
//!
//! Cost: a lookup reads the table, two words of the brick, one mask and one or two words of values, with four popcounts.
//! Encoding takes 5 ns a voxel of the support, checking and unpacking 12 ns.
//! Size on real frames of 63 k, 162 k and 251 k voxels, less a smooth approximation (a blur of two voxels), everything
//! included: 8.8, 8.1 and 7.8 bits a voxel at a step of 1/250 of the maximum (59 dB), 6.8, 6.1 and 5.9 bits at 47 dB.
//! The choice of cells: see [`super::brick`].
//!
//! Source: mask and rank are those of succinct bit vectors (Jacobson 1989) as VDB leaf nodes use them (Museth 2013,
//! section 3); the width per group is frame-of-reference coding (Goldstein et al. 1998).

use super::brick::{Brick, bricks_of, cell_and_bit, for_each_brick, from_bricks, mask_at, overhang, word};
use super::{MAX_CODE, ResidualCodes, voxels_of};
use crate::bounded::Bytes;
use crate::{Error, Result};
use std::path::Path;

/// Table word of a brick without support.
pub const EMPTY: u32 = u32::MAX;
/// Bytes before the table.
pub const HEADER_BYTES: usize = 64;
/// Bits of a cell's base, relative to its brick's smallest code.
const BASE_BITS: u32 = 13;

/// The resident bytes of one frame. The same codes always give the same bytes.
///
/// # Panics
/// If `codes` fails [`ResidualCodes::check`].
pub fn encode(codes: &ResidualCodes) -> Vec<u8> {
    let bricks = bricks_of(codes.dims).iter().map(|&b| b as usize).product();
    let mut table = vec![EMPTY; bricks];
    let mut stream: Vec<u32> = vec![];
    for_each_brick(codes, |number, brick| {
        table[number] = stream.len() as u32;
        push_brick(brick, &mut stream);
    });
    // A value may be read as two words: the second must exist.
    stream.push(0);
    let mut bytes = Vec::with_capacity(HEADER_BYTES + 4 * (table.len() + stream.len()));
    codes.origin.iter().for_each(|o| bytes.extend(o.to_le_bytes()));
    codes.dims.iter().for_each(|d| bytes.extend(d.to_le_bytes()));
    bytes.extend((codes.codes.len() as u64).to_le_bytes());
    bytes.extend((stream.len() as u64).to_le_bytes());
    bytes.resize(HEADER_BYTES, 0);
    table.iter().chain(&stream).for_each(|w| bytes.extend(w.to_le_bytes()));
    bytes
}

fn push_brick(brick: &Brick, stream: &mut Vec<u32>) {
    let mut range = [(i32::MAX, i32::MIN); 8];
    let (mut occupied, mut full) = (0u32, 0u32);
    for (cell, &mask) in brick.masks.iter().enumerate() {
        if mask == 0 {
            continue;
        }
        occupied |= 1 << cell;
        full |= u32::from(mask == u64::MAX) << cell;
        let codes = &brick.codes[64 * cell..64 * cell + 64];
        for (bit, &code) in codes.iter().enumerate() {
            if mask >> bit & 1 == 1 {
                range[cell] = (range[cell].0.min(code), range[cell].1.max(code));
            }
        }
    }
    let least = range.iter().map(|r| r.0).min().unwrap_or(0);
    let span = range.iter().map(|r| r.0).filter(|&m| m != i32::MAX).max().unwrap_or(0) - least;
    let shift = (i32::BITS - span.leading_zeros()).saturating_sub(BASE_BITS);
    stream.push(occupied | full << 8 | shift << 16);
    stream.push(least as u32);
    let mut bases = [(0, 0); 8];
    let mut first = 0;
    for cell in (0..8).filter(|c| occupied >> c & 1 == 1) {
        let up = (range[cell].0 - least) >> shift;
        let base = least + (up << shift);
        let width = i32::BITS - (range[cell].1 - base).leading_zeros();
        stream.push(width | first << 5 | (up as u32) << (32 - BASE_BITS));
        first += width * brick.masks[cell].count_ones();
        bases[cell] = (base, width);
    }
    for cell in (0..8).filter(|c| (occupied & !full) >> c & 1 == 1) {
        stream.push(brick.masks[cell] as u32);
        stream.push((brick.masks[cell] >> 32) as u32);
    }
    let (mut pending, mut bits) = (0u64, 0);
    for (cell, &(base, width)) in bases.iter().enumerate() {
        let mut left = if width == 0 { 0 } else { brick.masks[cell] };
        while left != 0 {
            let bit = left.trailing_zeros() as usize;
            pending |= u64::from((brick.codes[64 * cell + bit] - base) as u32) << bits;
            bits += width;
            if bits >= 32 {
                stream.push(pending as u32);
                pending >>= 32;
                bits -= 32;
            }
            left &= left - 1;
        }
    }
    if bits > 0 {
        stream.push(pending as u32);
    }
}

/// A checked view of the resident bytes of one frame.
#[derive(Clone, Debug)]
pub struct RankView<B = Vec<u8>> {
    bytes: B,
    origin: [i32; 3],
    dims: [u32; 3],
    bricks: [u32; 3],
    count: u64,
    /// Word at which the stream starts.
    stream: usize,
}

/// What the two words and the cell words of a brick say about one cell.
struct Cell {
    base: i32,
    width: u32,
    mask: u64,
    /// First bit of its values, counted from the start of the bytes.
    first_bit: u64,
}

impl<B: AsRef<[u8]>> RankView<B> {
    /// Checks every table word, brick and cell, in one pass, so that no lookup can leave the bytes.
    ///
    /// Errors name the brick that is wrong. `path` is the file that they name.
    pub fn new(path: &Path, bytes: B) -> Result<Self> {
        let mut head = Bytes::new(path, bytes.as_ref());
        let origin = [head.i32("rank.origin")?, head.i32("rank.origin")?, head.i32("rank.origin")?];
        let dims = [head.u32("rank.dims")?, head.u32("rank.dims")?, head.u32("rank.dims")?];
        voxels_of(path, dims)?;
        let count = head.u64("rank.active_voxels")?;
        let stream_words = head.u64("rank.stream_words")?;
        if head.take(HEADER_BYTES - 40, "rank.reserved")?.iter().any(|&b| b != 0) {
            return Err(Error::invalid(path, "rank.reserved", "a byte that is not zero", "zeros"));
        }
        let bricks = bricks_of(dims);
        let table_words: u64 = bricks.iter().map(|&b| u64::from(b)).product();
        let words = table_words.checked_add(stream_words).and_then(|w| w.checked_mul(4));
        if words != Some(head.remaining() as u64) || stream_words > u64::from(EMPTY) || stream_words == 0 {
            let found = format!("{stream_words} for {} bytes", head.remaining());
            return Err(Error::invalid(path, "rank.stream_words", found, "1 or more, to the end of the layout"));
        }
        let stream = HEADER_BYTES / 4 + table_words as usize;
        let view = Self { bytes, origin, dims, bricks, count, stream };
        view.check_bricks(path, stream_words as usize)?;
        Ok(view)
    }

    fn check_bricks(&self, path: &Path, stream_words: usize) -> Result<()> {
        let words = self.bytes.as_ref();
        let (mut next, mut voxels) = (0usize, 0u64);
        for number in 0..self.stream - HEADER_BYTES / 4 {
            let at = word(words, HEADER_BYTES / 4 + number);
            if at == EMPTY {
                continue;
            }
            let wrong = |field: &str, found: String, expected: &str| {
                Error::invalid(path, format!("rank.bricks[{number}].{field}"), found, expected)
            };
            if at as usize != next || next + 2 >= stream_words {
                return Err(wrong("start", format!("word {at}"), "the word after the brick before it, in the stream"));
            }
            let head = word(words, self.stream + next);
            let least = word(words, self.stream + next + 1) as i32;
            let (occupied, full, shift) = (head & 255, head >> 8 & 255, head >> 16);
            if occupied == 0 || full & !occupied != 0 || shift > 11 {
                return Err(wrong("head", format!("{head:#x}"), "some cells, full cells among them, shift at most 11"));
            }
            let partial = (occupied & !full).count_ones() as usize;
            let values = next + 2 + occupied.count_ones() as usize + 2 * partial;
            if values >= stream_words {
                return Err(wrong("head", format!("{head:#x}"), "cells that end inside the stream"));
            }
            let mut bits = 0u64;
            for cell in (0..8).filter(|c| occupied >> c & 1 == 1) {
                let found = self.cell(self.stream + next, head, cell);
                let first = 32 * (self.stream + values) as u64 + bits;
                if found.width > 24 || found.first_bit != first {
                    return Err(wrong("cell", format!("{} bits from {}", found.width, found.first_bit), "no gap"));
                }
                let most = i64::from(found.base) + (1i64 << found.width) - 1;
                // The top of the range may pass MAX_CODE by rounding up to a power of two; no code does.
                let limit = i64::from(MAX_CODE);
                if least < -MAX_CODE || i64::from(found.base) > limit || most > limit + (1 << 24) {
                    return Err(wrong("cell", format!("codes from {}", found.base), "codes of 24 bits"));
                }
                let is_full = full >> cell & 1 == 1;
                if found.mask == 0 || (found.mask == u64::MAX) != is_full {
                    return Err(wrong("mask", format!("{:#x}", found.mask), "not empty, and full only where marked"));
                }
                if found.mask & overhang(self.dims, number, cell) != 0 {
                    return Err(wrong("mask", format!("{:#x}", found.mask), "no voxel outside the box"));
                }
                bits += u64::from(found.width * found.mask.count_ones());
                voxels += u64::from(found.mask.count_ones());
            }
            next = values + bits.div_ceil(32) as usize;
            if next >= stream_words {
                return Err(wrong("values", format!("{bits} bits"), "values that end before the last word"));
            }
        }
        if next + 1 != stream_words || word(words, self.stream + next) != 0 {
            let found = format!("{} words after the last brick", stream_words - next);
            return Err(Error::invalid(path, "rank.stream", found, "one word of zero"));
        }
        if voxels != self.count {
            return Err(Error::invalid(path, "rank.active_voxels", self.count, voxels));
        }
        Ok(())
    }

    /// Index coordinates of the first voxel of the box.
    pub fn origin(&self) -> [i32; 3] {
        self.origin
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// Voxels of the support.
    pub fn active_voxels(&self) -> u64 {
        self.count
    }

    /// The resident bytes.
    pub fn bytes(&self) -> &[u8] {
        self.bytes.as_ref()
    }

    #[inline]
    fn cell(&self, brick: usize, head: u32, cell: u32) -> Cell {
        let words = self.bytes.as_ref();
        let (occupied, full) = (head & 255, head >> 8 & 255);
        let (partial, below) = (occupied & !full, (1 << cell) - 1);
        let cells = brick + 2;
        let masks = cells + occupied.count_ones() as usize;
        let values = masks + 2 * partial.count_ones() as usize;
        let about = word(words, cells + (occupied & below).count_ones() as usize);
        let up = about >> (32 - BASE_BITS) << (head >> 16 & 31);
        let mask = match full >> cell & 1 {
            1 => u64::MAX,
            _ => mask_at(words, masks + 2 * (partial & below).count_ones() as usize),
        };
        Cell {
            base: (word(words, brick + 1)).wrapping_add(up) as i32,
            width: about & 31,
            mask,
            first_bit: 32 * values as u64 + u64::from(about >> 5 & 0x3fff),
        }
    }

    #[inline]
    fn value(&self, cell: &Cell, rank: u32) -> i32 {
        if cell.width == 0 {
            return cell.base;
        }
        let bit = cell.first_bit + u64::from(rank * cell.width);
        let pair = mask_at(self.bytes.as_ref(), (bit / 32) as usize);
        let value = pair >> (bit % 32) & ((1 << cell.width) - 1);
        cell.base.wrapping_add(value as i32)
    }

    /// The code of the voxel at `voxel` in the box; none outside the support or the box.
    #[inline]
    pub fn code(&self, voxel: [u32; 3]) -> Option<i32> {
        let [x, y, z] = voxel;
        if !(x < self.dims[0] && y < self.dims[1] && z < self.dims[2]) {
            return None;
        }
        let number = x / 8 + self.bricks[0] * (y / 8 + self.bricks[1] * (z / 8));
        let words = self.bytes.as_ref();
        let at = word(words, HEADER_BYTES / 4 + number as usize);
        if at == EMPTY {
            return None;
        }
        let brick = self.stream + at as usize;
        let head = word(words, brick);
        let (cell, bit) = cell_and_bit(voxel);
        if head >> cell & 1 == 0 {
            return None;
        }
        let cell = self.cell(brick, head, cell);
        if cell.mask >> bit & 1 == 0 {
            return None;
        }
        Some(self.value(&cell, (cell.mask & ((1 << bit) - 1)).count_ones()))
    }

    /// All codes of the frame.
    pub fn codes(&self) -> ResidualCodes {
        from_bricks(self.origin, self.dims, |each| {
            let words = self.bytes.as_ref();
            let mut brick = Brick::default();
            for number in 0..self.stream - HEADER_BYTES / 4 {
                let at = word(words, HEADER_BYTES / 4 + number);
                if at == EMPTY {
                    continue;
                }
                let start = self.stream + at as usize;
                let head = word(words, start);
                brick.masks = [0; 8];
                for cell in (0..8).filter(|c| head >> c & 1 == 1) {
                    let about = self.cell(start, head, cell);
                    brick.masks[cell as usize] = about.mask;
                    let mut left = about.mask;
                    for rank in 0..about.mask.count_ones() {
                        brick.codes[(64 * cell + left.trailing_zeros()) as usize] = self.value(&about, rank);
                        left &= left - 1;
                    }
                }
                each(number, &brick);
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::{Pcg, ball, frames_of_every_kind};

    fn view(bytes: Vec<u8>) -> Result<RankView> {
        RankView::new(Path::new("p"), bytes)
    }

    #[test]
    fn every_kind_of_frame_comes_back_in_bulk_and_voxel_by_voxel() {
        for frame in frames_of_every_kind() {
            let view = view(encode(&frame)).unwrap();
            assert_eq!(view.codes(), frame);
            assert_eq!(view.active_voxels(), frame.codes.len() as u64);
            let mut next = 0;
            for v in 0..frame.support.len() as u32 {
                let voxel = [v % frame.dims[0], v / frame.dims[0] % frame.dims[1], v / frame.dims[0] / frame.dims[1]];
                let expected = frame.support.get(v as usize).then(|| {
                    next += 1;
                    frame.codes[next - 1]
                });
                assert_eq!(view.code(voxel), expected);
            }
            assert_eq!(view.code(frame.dims), None);
            assert_eq!(view.code([u32::MAX; 3]), None);
        }
    }

    #[test]
    #[rustfmt::skip]
    fn a_brick_of_known_codes_has_golden_bytes() {
        let mut support = crate::volume::VoxelMask::new(8);
        [0, 3, 7].iter().for_each(|&v| support.set(v));
        let frame = ResidualCodes { origin: [1, -1, 0], dims: [8, 1, 1], support, codes: vec![-2, 3, 9] };
        let words: [i32; 25] = [
            1, -1, 0, 8, 1, 1, 3, 0, 10, 0, 0, 0, 0, 0, 0, 0, // header: origin, dims, 3 voxels, 10 words
            0, // table: brick 0 at word 0
            0b11, // cells 0 and 1, none full, no shift
            -2, // smallest code
            3, // cell 0: 3 bits from bit 0, base -2
            6 << 5 | 11 << 19, // cell 1: no bits, base -2 + 11
            0b1001, 0, 0b1000, 0, // masks
        ];
        let mut expected: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
        expected.extend([0b101_000, 0, 0, 0]); // values 0 and 5
        expected.extend([0; 4]); // the word past the end
        assert_eq!(encode(&frame), expected);
    }

    #[test]
    fn every_prefix_and_an_extra_byte_are_refused() {
        let bytes = encode(&ball([9, 12, 10], 60, 5));
        for length in 0..bytes.len() {
            assert!(view(bytes[..length].to_vec()).is_err(), "{length}");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert!(view(longer).is_err());
        assert!(view(bytes).is_ok());
    }

    #[test]
    fn hostile_counts_are_refused_before_anything_is_allocated() {
        let bytes = encode(&ball([9, 12, 10], 60, 5));
        for at in [12, 16, 20, 24, 28, 32, 36] {
            for value in [0, u32::MAX, 1 << 28, 1 << 31] {
                let mut bad = bytes.clone();
                bad[at..at + 4].copy_from_slice(&value.to_le_bytes());
                assert!(bad == bytes || view(bad).is_err(), "{at} {value}");
            }
        }
    }

    #[test]
    fn a_flipped_bit_is_refused_or_read_without_a_panic() {
        let bytes = encode(&ball([17, 12, 10], 60, 6));
        let mut random = Pcg(1);
        let mut refused = 0;
        for _ in 0..4000 {
            let mut bad = bytes.clone();
            let bit = random.below(8 * bad.len() as u32) as usize;
            bad[bit / 8] ^= 1 << (bit % 8);
            match view(bad) {
                Ok(view) => {
                    view.codes();
                }
                Err(_) => refused += 1,
            }
        }
        assert!(refused > 0);
    }

    #[test]
    fn codes_one_bit_wide_cost_their_bits_and_little_else() {
        // A full 64^3 box of codes 0 and 1: 1 bit a voxel, 10 words a brick, one table word, header and end.
        let n = 64u32;
        let mut support = crate::volume::VoxelMask::new((n * n * n) as usize);
        (0..support.len()).for_each(|v| support.set(v));
        let codes = (0..n * n * n).map(|v| (v % 2) as i32).collect();
        let frame = ResidualCodes { origin: [0; 3], dims: [n; 3], support, codes };
        let bricks = (n / 8).pow(3) as usize;
        assert_eq!(encode(&frame).len(), HEADER_BYTES + 4 * (bricks * (1 + 10 + 16) + 1));
    }
}
