//! The residual of one frame at rest: a lossless code of support and codes, alone or after the frame before.
//!
//! # Layout (little-endian)
//! | bytes | field |
//! |---|---|
//! | 1 | version, 1 |
//! | 1 | 0: stands alone; 1: coded after an earlier frame |
//! | 3 x 4 | origin of the box, i32 |
//! | 3 x 4 | voxels along x, y, z, u32; the product at most 2^28, the last index of each axis within i32 |
//! | 4 | number of codes `n`, u32 |
//! | 8 | only with 1 above: XXH3-64 of the earlier frame's content |
//! | ... | one range-coded stream (`range_coder.rs`); empty if `n` = 0 |
//! | 8 | XXH3-64 of all bytes before it, followed by this frame's content |
//!
//! The content of a frame, for the checksums: origin and voxels as above, the words of the support mask (u64), the codes
//! (i32). The stream holds the support (`support.rs`), then the codes: for every voxel of the support, in the order of
//! `sweep.rs`, a prediction (`predict.rs`, from `least_squares.rs` and `earlier.rs`) and the decisions that tell the code
//! (`code_model.rs`, with the tables of `logistic.rs` and the adaptive parts of `mixing.rs`). Encoder and decoder run the
//! same model over either side of the channel. Everything is f32 with `+ - * /` in a fixed order and without fused
//! operations, so all machines agree on every bit; should one not, the checksum says so.
//!
//! # Bounds
//! A code takes at least two decisions that cost 0.001409 bit each, so `B` bytes of stream hold at most `2848 B` codes;
//! more are refused before anything is allocated. The box may be large and empty: a mask takes one bit a voxel, and a
//! sweep over the largest box takes seconds, whatever it holds. Planes
//! of the sweep hold at most `voxels^(2/3)` voxels. A stream that ends early is noticed within one row.
//!
//! # Cost
//! About 0.6 us a code to encode or decode, 0.9 us after an earlier frame (`docs/residual-codec.md` has the table);
//! 4.2 to 3.6 bits a voxel of a rough plume at max error 0.002, 2.5 to 2.0 at 0.01, and a sixth less after the frame
//! before. Support included; SZ3 takes 6.4 to 5.6 and 4.0 to 3.3.

mod code_model;
mod earlier;
mod least_squares;
mod logistic;
mod mixing;
mod predict;
mod range_coder;
mod ranks;
mod support;
mod sweep;

use super::ResidualCodes;
use code_model::CodeModel;
use earlier::Earlier;
use predict::Predictor;
use range_coder::{BitChannel, Decoder, Encoder};
use ranks::Ranks;
use sweep::Sweep;

use crate::bounded::{Bytes, MAX_DENSE_VOXELS};
use crate::volume::VoxelMask;
use crate::{Error, Result};
use std::path::Path;
use xxhash_rust::xxh3::Xxh3;

const VERSION: u8 = 1;
const CHECKSUM_BYTES: usize = 8;
/// 8 / (2 * 0.001409) = 2839 and the slack of the coder's four start bytes.
const CODES_PER_BYTE: u64 = 2848;

/// Encodes a frame that can be read without any other.
///
/// # Panics
/// If the support does not cover the box, if there is not one code for each voxel of it, or if the box is not legal
/// (see the layout): such a frame is a mistake of the program, not of a file.
pub fn encode(residual: &ResidualCodes) -> Vec<u8> {
    encode_frame(residual, None)
}

/// Encodes a frame that needs `previous` to be read: 13 to 25 % smaller than [`encode`] if that is the frame before.
///
/// # Panics
/// As [`encode`], for either frame.
pub fn encode_after(residual: &ResidualCodes, previous: &ResidualCodes) -> Vec<u8> {
    encode_frame(residual, Some(previous))
}

/// Decodes what [`encode`] made; `path` is named in errors.
///
/// # Errors
/// [`Error::Invalid`] if the bytes are damaged, cut, too long, or need an earlier frame; [`Error::Unsupported`] for
/// another version.
pub fn decode(path: &Path, bytes: &[u8]) -> Result<ResidualCodes> {
    decode_frame(path, bytes, None)
}

/// Decodes what [`encode_after`] made after the same `previous`; `path` is named in errors.
///
/// # Errors
/// As [`decode`], and [`Error::Invalid`] if the bytes were made after another frame, or after none.
pub fn decode_after(path: &Path, bytes: &[u8], previous: &ResidualCodes) -> Result<ResidualCodes> {
    decode_frame(path, bytes, Some(previous))
}

/// Number of voxels of a legal box, or the box in words if it is none.
fn voxels(origin: [i32; 3], dims: [u32; 3]) -> std::result::Result<usize, String> {
    let count = dims.iter().try_fold(1u64, |n, &d| n.checked_mul(u64::from(d)));
    let inside = (0..3).all(|a| i64::from(origin[a]) + i64::from(dims[a]) <= i64::from(i32::MAX) + 1);
    match count.filter(|&n| n <= MAX_DENSE_VOXELS && inside) {
        Some(count) => Ok(count as usize),
        None => Err(format!("{} x {} x {} voxels at {origin:?}", dims[0], dims[1], dims[2])),
    }
}

fn check(residual: &ResidualCodes) {
    let voxels = voxels(residual.origin, residual.dims);
    assert_eq!(voxels.as_ref(), Ok(&residual.support.len()), "the support covers a legal box");
    assert_eq!(residual.codes.len(), residual.support.count(), "one code for each voxel of the support");
}

fn encode_frame(residual: &ResidualCodes, previous: Option<&ResidualCodes>) -> Vec<u8> {
    check(residual);
    previous.iter().for_each(|p| check(p));
    let ResidualCodes { origin, dims, support, codes } = residual;
    let mut out = vec![VERSION, u8::from(previous.is_some())];
    origin.iter().for_each(|o| out.extend(o.to_le_bytes()));
    dims.iter().for_each(|d| out.extend(d.to_le_bytes()));
    out.extend((codes.len() as u32).to_le_bytes());
    if let Some(previous) = previous {
        out.extend(digest(&[], previous).to_le_bytes());
    }
    if !codes.is_empty() {
        let mut channel = Encoder::new(out);
        let sweep = Sweep::new(*dims);
        support::code(&mut channel, &sweep, &mut support.clone());
        let earlier = previous.map(|p| Earlier::new(p, *origin, &sweep));
        encode_codes(&mut channel, &sweep, support, earlier, &mut codes.clone());
        out = channel.finish();
    }
    let checksum = digest(&out, residual);
    out.extend(checksum.to_le_bytes());
    out
}

fn decode_frame(path: &Path, bytes: &[u8], previous: Option<&ResidualCodes>) -> Result<ResidualCodes> {
    let mut fields = Bytes::new(path, bytes);
    let version = fields.u8("residual version")?;
    if version != VERSION {
        return Err(Error::unsupported(path, "residual version", version, "read it with the program that wrote it"));
    }
    let kind = fields.u8("residual kind")?;
    if kind != u8::from(previous.is_some()) {
        let expected = if previous.is_some() { "1, after an earlier frame" } else { "0, standing alone" };
        return Err(fields.invalid("residual kind", kind, expected));
    }
    let what = "residual box";
    let origin = [fields.i32(what)?, fields.i32(what)?, fields.i32(what)?];
    let dims = [fields.u32(what)?, fields.u32(what)?, fields.u32(what)?];
    let voxels = voxels(origin, dims).map_err(|found| {
        fields.invalid(what, found, format!("at most {MAX_DENSE_VOXELS} voxels inside the range of i32"))
    })?;
    let count = fields.u32("residual code count")?;
    if let Some(previous) = previous {
        let (stored, found) = (fields.u64("earlier frame")?, digest(&[], previous));
        if stored != found {
            return Err(fields.invalid("earlier frame", format!("{found:016x}"), format!("{stored:016x}")));
        }
    }
    let Some(stream_bytes) = fields.remaining().checked_sub(CHECKSUM_BYTES) else {
        return Err(fields.invalid("residual checksum", format!("{} bytes left", fields.remaining()), "8 bytes"));
    };
    let most = (voxels as u64).min(stream_bytes as u64 * CODES_PER_BYTE);
    if u64::from(count) > most {
        return Err(fields.invalid("residual code count", count, format!("at most {most} in {stream_bytes} bytes")));
    }
    let stream = fields.take(stream_bytes, "residual stream")?;
    let stored = fields.u64("residual checksum")?;

    let mut residual = ResidualCodes { origin, dims, support: VoxelMask::new(voxels), codes: Vec::new() };
    let mut used = 0;
    if count > 0 {
        used = decode_stream(stream, count, &mut residual, previous)
            .map_err(|(what, found, expected)| fields.invalid(what, found, expected))?;
    }
    if used != stream_bytes {
        return Err(fields.invalid("residual stream", format!("{stream_bytes} bytes"), used));
    }
    let found = digest(&bytes[..bytes.len() - CHECKSUM_BYTES], &residual);
    if stored != found {
        return Err(fields.invalid("residual checksum", format!("{found:016x}"), format!("{stored:016x}")));
    }
    Ok(residual)
}

/// Fills support and codes; gives the bytes used, or what is wrong, what was found and what was expected.
fn decode_stream(
    stream: &[u8],
    count: u32,
    residual: &mut ResidualCodes,
    previous: Option<&ResidualCodes>,
) -> std::result::Result<usize, (&'static str, String, String)> {
    let short =
        || ("residual stream", format!("no end within {} bytes", stream.len()), format!("{count} codes of i32"));
    let mut channel = Decoder::new(stream);
    let sweep = Sweep::new(residual.dims);
    if !support::code(&mut channel, &sweep, &mut residual.support) {
        return Err(short());
    }
    let found = residual.support.count();
    if found != count as usize {
        return Err(("residual support", format!("{found} voxels"), count.to_string()));
    }
    residual.codes = vec![0; found];
    let earlier = previous.map(|p| Earlier::new(p, residual.origin, &sweep));
    if !decode_codes(&mut channel, &sweep, &residual.support, earlier, &mut residual.codes) {
        return Err(short());
    }
    Ok(channel.position())
}

/// XXH3-64 of `bytes` and the content of a frame.
fn digest(bytes: &[u8], residual: &ResidualCodes) -> u64 {
    let mut hash = Xxh3::new();
    hash.update(bytes);
    residual.origin.iter().for_each(|o| hash.update(&o.to_le_bytes()));
    residual.dims.iter().for_each(|d| hash.update(&d.to_le_bytes()));
    residual.support.words().iter().for_each(|w| hash.update(&w.to_le_bytes()));
    residual.codes.iter().for_each(|c| hash.update(&c.to_le_bytes()));
    hash.digest()
}

#[multiversion::multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn encode_codes(
    channel: &mut Encoder,
    sweep: &Sweep,
    support: &VoxelMask,
    earlier: Option<Earlier>,
    codes: &mut [i32],
) -> bool {
    code_codes(channel, sweep, support, earlier, codes)
}

#[multiversion::multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn decode_codes(
    channel: &mut Decoder,
    sweep: &Sweep,
    support: &VoxelMask,
    earlier: Option<Earlier>,
    codes: &mut [i32],
) -> bool {
    code_codes(channel, sweep, support, earlier, codes)
}

#[inline(always)]
fn code_codes(
    channel: &mut impl BitChannel,
    sweep: &Sweep,
    support: &VoxelMask,
    earlier: Option<Earlier>,
    codes: &mut [i32],
) -> bool {
    match earlier {
        None => sweep_codes::<24, 16>(channel, sweep, support, None, codes),
        earlier => sweep_codes::<32, 24>(channel, sweep, support, earlier, codes),
    }
}

/// Codes every voxel of the support; `codes` are read by the encoder and written by the decoder. False if the channel
/// ran dry or a code left i32.
#[inline(always)]
fn sweep_codes<const LARGE: usize, const SMALL: usize>(
    channel: &mut impl BitChannel,
    sweep: &Sweep,
    support: &VoxelMask,
    mut earlier: Option<Earlier>,
    codes: &mut [i32],
) -> bool {
    let ranks = Ranks::new(support);
    let [nx, ny, nz] = sweep.dims;
    let mut predictor = Predictor::<LARGE, SMALL>::new([nx, ny]);
    let mut model = CodeModel::new();
    for k in 0..nz {
        predictor.next_plane();
        if let Some(earlier) = &mut earlier {
            earlier.next_plane(sweep, k);
        }
        for j in 0..ny {
            for i in 0..nx {
                let Some(rank) = ranks.get(sweep.voxel(i, j, k)) else { continue };
                let before = earlier.as_ref().map_or([0.0; earlier::TAPS.len()], |e| e.taps(i, j));
                let seen = predictor.guess(i, j, before);
                let Ok(code) = i32::try_from(model.code(channel, &seen.guess, i64::from(codes[rank]))) else {
                    return false;
                };
                codes[rank] = code;
                predictor.learn(&seen, code);
            }
            if channel.exhausted() {
                return false;
            }
        }
    }
    true
}

#[cfg(test)]
mod tests;
