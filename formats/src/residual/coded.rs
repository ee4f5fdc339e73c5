//! The codes of one frame at rest: box, support and codes, deflated.
//!
//! Layout: origin 3 x i32, dims 3 x u32, number of codes u32, length of the deflated bytes u64, then the deflated
//! bytes: the support's words (u64 each), then the codes zig-zagged to u32, as four planes of bytes, low plane first.

use super::{ResidualCodes, voxels_of};
use crate::bounded::Bytes;
use crate::volume::VoxelMask;
use crate::{Error, Result};
use flate2::Compression;
use flate2::read::{ZlibDecoder, ZlibEncoder};
use std::io::Read;
use std::path::Path;

/// The bytes at rest of one frame.
///
/// # Panics
/// If `codes` fails [`ResidualCodes::check`].
pub fn encode(codes: &ResidualCodes) -> Vec<u8> {
    let zigzag: Vec<[u8; 4]> = codes.codes.iter().map(|&c| ((c << 1) ^ (c >> 31)).to_le_bytes()).collect();
    let mut plain: Vec<u8> = codes.support.words().iter().flat_map(|w| w.to_le_bytes()).collect();
    (0..4).for_each(|plane| plain.extend(zigzag.iter().map(|z| z[plane])));
    let mut packed = vec![];
    let read = ZlibEncoder::new(&plain[..], Compression::default()).read_to_end(&mut packed);
    debug_assert!(read.is_ok(), "reading from memory cannot fail");
    let mut bytes = vec![];
    codes.origin.iter().for_each(|o| bytes.extend(o.to_le_bytes()));
    codes.dims.iter().for_each(|d| bytes.extend(d.to_le_bytes()));
    bytes.extend((codes.codes.len() as u32).to_le_bytes());
    bytes.extend((packed.len() as u64).to_le_bytes());
    bytes.extend(packed);
    bytes
}

/// The codes of one frame from [`encode`]'s bytes, all of which must be used. `path` is named in errors.
pub fn decode(path: &Path, bytes: &[u8]) -> Result<ResidualCodes> {
    let mut head = Bytes::new(path, bytes);
    let origin = [head.i32("coded.origin")?, head.i32("coded.origin")?, head.i32("coded.origin")?];
    let dims = [head.u32("coded.dims")?, head.u32("coded.dims")?, head.u32("coded.dims")?];
    let voxels = voxels_of(path, dims)?;
    let count = head.u32("coded.count")? as usize;
    let length = head.u64("coded.length")?;
    if length != head.remaining() as u64 {
        return Err(Error::invalid(path, "coded.length", length, format!("{} bytes", head.remaining())));
    }
    if count as u64 > voxels {
        return Err(Error::invalid(path, "coded.count", count, format!("at most {voxels}")));
    }
    let packed = head.take(head.remaining(), "coded.bytes")?;
    let words = (voxels as usize).div_ceil(64);
    let expected = 8 * words + 4 * count;
    let mut plain = vec![];
    let mut inflate = ZlibDecoder::new(packed);
    // One byte more than expected, so that a longer stream is noticed.
    let read = inflate.by_ref().take(expected as u64 + 1).read_to_end(&mut plain);
    if read.is_err() || plain.len() != expected || inflate.total_in() != packed.len() as u64 {
        return Err(Error::invalid(path, "coded.bytes", format!("{} bytes", plain.len()), format!("{expected} bytes")));
    }
    let mut support = VoxelMask::new(voxels as usize);
    for (i, chunk) in plain[..8 * words].chunks_exact(8).enumerate() {
        let mut left = u64::from_le_bytes(chunk.try_into().unwrap_or_default());
        while left != 0 {
            let v = 64 * i + left.trailing_zeros() as usize;
            if v >= support.len() {
                return Err(Error::invalid(path, "coded.support", format!("voxel {v}"), format!("below {voxels}")));
            }
            support.set(v);
            left &= left - 1;
        }
    }
    let planes = &plain[8 * words..];
    let zigzag = |i: usize| u32::from_le_bytes([0, 1, 2, 3].map(|p| planes[p * count + i]));
    let codes = (0..count).map(|i| (zigzag(i) >> 1) as i32 ^ -((zigzag(i) & 1) as i32)).collect();
    let codes = ResidualCodes { origin, dims, support, codes };
    codes.check(path)?;
    Ok(codes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::{ball, frames_of_every_kind};

    #[test]
    fn every_kind_of_frame_comes_back() {
        for frame in frames_of_every_kind() {
            assert_eq!(decode(Path::new("p"), &encode(&frame)).unwrap(), frame);
        }
    }

    #[test]
    fn every_prefix_and_an_extra_byte_are_refused() {
        let bytes = encode(&ball([9, 9, 9], 30, 1));
        for length in 0..bytes.len() {
            assert!(decode(Path::new("p"), &bytes[..length]).is_err(), "{length}");
        }
        let longer = [&bytes[..], &[0]].concat();
        assert!(decode(Path::new("p"), &longer).is_err());
    }
}
