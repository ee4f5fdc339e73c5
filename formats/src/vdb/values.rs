//! The values of one node: a code for the inactive ones, then a block of stored values.
//!
//! With active-mask compression only the active values are stored; the inactive ones are rebuilt from the background
//! `b`, from one or two values given in full, and from a mask that selects between them:
//!
//! | code | inactive values | selection mask |
//! |---|---|---|
//! | 0 | `b` | no |
//! | 1 | `-b` | no |
//! | 2 | one given | no |
//! | 3 | off `-b`, on `b` | yes |
//! | 4 | off given, on `b` | yes |
//! | 5 | off first given, on second given | yes |
//! | 6 | all values are stored | no |
//!
//! A block is plain, or an i64 length `n` and `n` bytes of zlib or Blosc, or `-n` and `n` plain bytes. An empty block of
//! half floats is nothing at all; an empty block of full floats still has its length. Given values are full floats in
//! half grids too. Source: OpenVDB 12, `io/Compression.h` (`readCompressedValues`), `io/Compression.cc`.

use super::blosc;
use crate::bounded::Bytes;
use crate::{Error, Result};
use flate2::{Decompress, FlushDecompress, Status};
use half::f16;
use half::slice::{HalfBitsSliceExt, HalfFloatSliceExt};

/// Flag of a grid: blocks are zlib streams.
pub(super) const ZIP: u32 = 1;
/// Flag of a grid: inactive values are left out of the blocks.
pub(super) const ACTIVE_MASK: u32 = 2;
/// Flag of a grid: blocks are Blosc chunks; wins over [`ZIP`].
pub(super) const BLOSC: u32 = 4;

/// Bytes of one value of a grid in a node's head, and in its block (where half floats may be used).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ValueSize {
    /// As a background, a tile of the root, or an inactive value.
    pub full: usize,
    /// In a block.
    pub stored: usize,
    /// The grid's reals are stored as half floats.
    pub half: bool,
}

impl ValueSize {
    /// The size for a value type's name in a tree type, or none for types whose nodes are laid out otherwise.
    pub fn of(value_type: &str, half: bool) -> Option<Self> {
        let (full, as_half) = match value_type {
            "float" => (4, 2),
            "double" => (8, 2),
            "int32" => (4, 4),
            "int64" => (8, 8),
            "vec3i" => (12, 12),
            "vec3s" => (12, 6),
            "vec3d" => (24, 6),
            _ => return None,
        };
        let half = half && as_half < full;
        Some(Self { full, stored: if half { as_half } else { full }, half })
    }
}

/// What stands before a node's block.
pub(super) struct NodeHead<'a> {
    /// The values that a clear and a set bit of the selection mean.
    pub inactive: [f32; 2],
    selection: Option<&'a [u8]>,
    /// Values in the block: all of the node, or the active ones.
    pub stored: usize,
}

impl NodeHead<'_> {
    /// Words of the selection mask; zero where there is none.
    #[inline]
    pub fn selection(&self, word: usize) -> u64 {
        self.selection.map_or(0, |s| s[word * 8..][..8].iter().rev().fold(0, |w, &b| w << 8 | u64::from(b)))
    }
}

/// Reads or steps over the values of the nodes of one grid.
pub(super) struct ValueReader {
    flags: u32,
    size: ValueSize,
    inflate: Decompress,
    scratch: Vec<u8>,
    words: Vec<u32>,
    halves: Vec<u16>,
    active: Vec<f32>,
}

impl ValueReader {
    /// For a grid with these compression flags.
    pub fn new(flags: u32, size: ValueSize) -> Self {
        let (scratch, words, halves, active) = Default::default();
        Self { flags, size, inflate: Decompress::new(true), scratch, words, halves, active }
    }

    /// The size of this grid's values.
    pub fn size(&self) -> ValueSize {
        self.size
    }

    /// Reads a node's head. `mask` is the node's value mask; `background` is ignored for grids that are not float.
    pub fn head<'a>(&self, bytes: &mut Bytes<'a>, mask: &[u64], background: f32) -> Result<NodeHead<'a>> {
        let code = bytes.u8("node code")?;
        if code > 6 {
            return Err(bytes.invalid("node code", code, "0 to 6"));
        }
        let mut inactive = [if code == 0 { background } else { -background }, background];
        let given = match code {
            2 | 4 => 1,
            5 => 2,
            _ => 0,
        };
        for value in &mut inactive[..given] {
            let raw = bytes.take(self.size.full, "inactive value")?;
            if let Ok(raw) = raw.try_into() {
                *value = f32::from_le_bytes(raw);
            }
        }
        let selection = match code {
            3..=5 => Some(bytes.take(mask.len() * 8, "selection mask")?),
            _ => None,
        };
        let stored = match self.flags & ACTIVE_MASK != 0 && code != 6 {
            true => mask.iter().map(|w| w.count_ones() as usize).sum(),
            false => mask.len() * 64,
        };
        Ok(NodeHead { inactive, selection, stored })
    }

    /// Steps over the block that belongs to `head`.
    pub fn skip_block(&self, bytes: &mut Bytes, head: &NodeHead) -> Result<()> {
        let mut length = head.stored * self.size.stored;
        if self.has_length(head) {
            length = self.encoded_length(bytes, length)?.0;
        }
        bytes.take(length, "node values").map(drop)
    }

    /// Reads the block that belongs to `head` and fills `out`, one value for each bit of `mask`.
    pub fn values(&mut self, bytes: &mut Bytes, head: &NodeHead, mask: &[u64], out: &mut [f32]) -> Result<()> {
        debug_assert!(self.size.full == 4 && out.len() == mask.len() * 64);
        if head.stored == out.len() {
            return self.block(bytes, head, out);
        }
        let mut active = std::mem::take(&mut self.active);
        active.resize(head.stored, 0.0);
        self.block(bytes, head, &mut active)?;
        let mut next = 0;
        for (w, out) in out.chunks_exact_mut(64).enumerate() {
            let selection = head.selection(w);
            match selection {
                0 => out.fill(head.inactive[0]),
                _ => out.iter_mut().enumerate().for_each(|(i, o)| *o = head.inactive[(selection >> i & 1) as usize]),
            }
            let mut bits = mask[w];
            while bits != 0 {
                out[bits.trailing_zeros() as usize] = active[next];
                next += 1;
                bits &= bits - 1;
            }
        }
        self.active = active;
        Ok(())
    }

    /// Whether the block begins with its length.
    fn has_length(&self, head: &NodeHead) -> bool {
        self.flags & (ZIP | BLOSC) != 0 && !(self.size.half && head.stored == 0)
    }

    /// The encoded length of a block, and whether it is plain all the same.
    fn encoded_length(&self, bytes: &mut Bytes, decoded: usize) -> Result<(usize, bool)> {
        let what = "length of a compressed block";
        let length = bytes.i64(what)?;
        if length <= 0 {
            if length.unsigned_abs() != decoded as u64 {
                return Err(bytes.invalid(what, length, format!("-{decoded} (plain) or above 0")));
            }
            return Ok((decoded, true));
        }
        match usize::try_from(length).ok().filter(|&n| n <= bytes.remaining()) {
            Some(length) => Ok((length, false)),
            None => Err(bytes.invalid(what, length, format!("at most {}", bytes.remaining()))),
        }
    }

    /// Decodes a block into as many values as it stores.
    fn block(&mut self, bytes: &mut Bytes, head: &NodeHead, out: &mut [f32]) -> Result<()> {
        // Whole words, so that no value is read from an unaligned place; the file is little-endian.
        if self.size.half {
            let mut halves = std::mem::take(&mut self.halves);
            halves.resize(head.stored, 0);
            self.block_bytes(bytes, head, bytemuck::cast_slice_mut(&mut halves))?;
            halves.iter_mut().for_each(|h| *h = u16::from_le(*h));
            halves.reinterpret_cast::<f16>().convert_to_f32_slice(out);
            self.halves = halves;
        } else {
            let mut words = std::mem::take(&mut self.words);
            words.resize(head.stored, 0);
            self.block_bytes(bytes, head, bytemuck::cast_slice_mut(&mut words))?;
            out.iter_mut().zip(&words).for_each(|(o, &w)| *o = f32::from_bits(u32::from_le(w)));
            self.words = words;
        }
        Ok(())
    }

    fn block_bytes(&mut self, bytes: &mut Bytes, head: &NodeHead, out: &mut [u8]) -> Result<()> {
        let (length, plain) = match self.has_length(head) {
            true => self.encoded_length(bytes, out.len())?,
            false => (out.len(), true),
        };
        let encoded = bytes.take(length, "node values")?;
        if plain {
            out.copy_from_slice(encoded);
            return Ok(());
        }
        if self.flags & BLOSC != 0 {
            return blosc::decode(&mut Bytes::new(bytes.path(), encoded), out, &mut self.scratch);
        }
        self.inflate.reset(true);
        let status = self.inflate.decompress(encoded, out, FlushDecompress::Finish);
        match status {
            Ok(Status::StreamEnd) if self.inflate.total_out() == out.len() as u64 => Ok(()),
            Ok(_) => {
                let found = format!("{} bytes", self.inflate.total_out());
                Err(bytes.invalid("zlib block", found, format!("{} bytes and the end", out.len())))
            }
            Err(e) => Err(bytes.invalid("zlib block", e, format!("{} bytes", out.len()))),
        }
    }
}

/// The flags as OpenVDB words them, such as "blosc + active values".
pub(super) fn describe(flags: u32) -> String {
    let names = [(ZIP, "zip"), (BLOSC, "blosc"), (ACTIVE_MASK, "active values")];
    let set: Vec<&str> = names.iter().filter(|(bit, _)| flags & bit != 0).map(|&(_, name)| name).collect();
    if set.is_empty() { "none".to_owned() } else { set.join(" + ") }
}

/// Reads a grid's compression flags.
pub(super) fn read_flags(bytes: &mut Bytes) -> Result<u32> {
    let flags = bytes.u32("compression flags")?;
    if flags & !(ZIP | ACTIVE_MASK | BLOSC) != 0 {
        let hint = "save the file again with OpenVDB 12 or earlier";
        return Err(Error::unsupported(bytes.path(), "compression flags", format!("{flags:#x}"), hint));
    }
    Ok(flags)
}
