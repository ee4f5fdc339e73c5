//! A section's bytes, at rest in the file and resident in memory.
//!
//! A residual at rest is either its resident bytes (plain or deflated) or the coded codes of its frames. From codes the
//! resident layout is built again by the functions that built it first, so both ways give the same bytes. A tile of
//! coded codes also keeps the function of its hash, which would be slow to find again:
//!
//! ```text
//! frames u32 | m u32 | r u32 | deflated offsets: length u64 | each frame: length u64 | deflated offsets | coded frames
//! ```

use super::gaussians::{self, GAUSSIAN_BYTES};
use super::records::Codec;
use super::zlib::{deflate, inflate};
use crate::bounded::Bytes;
use crate::gaussian::Gaussian;
use crate::residual::hash::{HashTable, HashView, MAX_FRAMES};
use crate::residual::rank::RankView;
use crate::residual::{Residual, ResidualCodes, coded, hash, rank};
use crate::{Error, Result};
use std::path::Path;

/// The Gaussians of a section at rest that claims `resident` bytes; `what` names the frame in errors.
pub fn decode_gaussians(path: &Path, what: &str, bytes: &[u8], codec: Codec, resident: u64) -> Result<Vec<Gaussian>> {
    let list = match codec {
        Codec::Snapped => gaussians::decode(path, bytes)?,
        Codec::Deflate => gaussians::from_bytes(path, what, &inflate(path, what, bytes, resident)?)?,
        Codec::Raw | Codec::Coded | Codec::CodedAfter => gaussians::from_bytes(path, what, bytes)?,
    };
    if (list.len() * GAUSSIAN_BYTES) as u64 != resident {
        return Err(Error::invalid(path, format!("{what}.gaussians"), list.len(), resident / GAUSSIAN_BYTES as u64));
    }
    gaussians::check(path, what, &list)?;
    Ok(list)
}

/// A rank section at rest; `resident` is the rank layout of `codes`, `previous` the frame before.
pub fn encode_rank(codes: &ResidualCodes, resident: &[u8], codec: Codec, previous: Option<&ResidualCodes>) -> Vec<u8> {
    match (codec, previous) {
        (Codec::CodedAfter, Some(previous)) => coded::encode_after(codes, previous),
        (Codec::Coded | Codec::CodedAfter, _) => coded::encode(codes),
        (Codec::Deflate, _) => deflate(resident),
        (Codec::Raw | Codec::Snapped, _) => resident.to_vec(),
    }
}

/// The resident rank layout of a section at rest that claims `resident` bytes. `previous` is the frame before; only
/// [`Codec::CodedAfter`] reads it.
pub fn decode_rank(
    path: &Path,
    bytes: Vec<u8>,
    codec: Codec,
    resident: u64,
    previous: Option<&ResidualCodes>,
) -> Result<Residual> {
    let bytes = match (codec, previous) {
        (Codec::Coded, _) => rank::encode(&coded::decode(path, &bytes)?),
        (Codec::CodedAfter, Some(previous)) => rank::encode(&coded::decode_after(path, &bytes, previous)?),
        (Codec::CodedAfter, None) => return Err(Error::invalid(path, "rank.codec", "coded after", "a frame before")),
        (Codec::Deflate, _) => inflate(path, "rank", &bytes, resident)?,
        (Codec::Raw | Codec::Snapped, _) => bytes,
    };
    resident_length(path, "rank", &bytes, resident)?;
    Ok(Residual::Rank(RankView::new(path, bytes)?))
}

/// A hash section at rest, and the number of its resident bytes. Fails if `table` is not a perfect hash of the codes.
pub fn encode_hash(path: &Path, frames: &[ResidualCodes], table: &HashTable, codec: Codec) -> Result<(Vec<u8>, u64)> {
    let resident = hash::assemble(path, frames, table)?;
    let length = resident.len() as u64;
    Ok(match codec {
        Codec::Coded => {
            let offsets = deflate(&table.offsets);
            let coded: Vec<Vec<u8>> = frames.iter().map(coded::encode).collect();
            let mut bytes = vec![];
            for head in [frames.len() as u32, table.side, table.offset_side] {
                bytes.extend(head.to_le_bytes());
            }
            std::iter::once(&offsets).chain(&coded).for_each(|b| bytes.extend((b.len() as u64).to_le_bytes()));
            std::iter::once(&offsets).chain(&coded).for_each(|b| bytes.extend(b));
            (bytes, length)
        }
        Codec::Deflate => (deflate(&resident), length),
        Codec::Raw | Codec::Snapped | Codec::CodedAfter => (resident, length),
    })
}

/// The resident hash layout of a section at rest that claims `resident` bytes.
pub fn decode_hash(path: &Path, bytes: Vec<u8>, codec: Codec, resident: u64) -> Result<Residual> {
    let bytes = match codec {
        Codec::Coded => assemble_coded(path, &bytes)?,
        Codec::Deflate => inflate(path, "hash", &bytes, resident)?,
        Codec::Raw | Codec::Snapped | Codec::CodedAfter => bytes,
    };
    resident_length(path, "hash", &bytes, resident)?;
    Ok(Residual::Hash(HashView::new(path, bytes)?))
}

fn assemble_coded(path: &Path, bytes: &[u8]) -> Result<Vec<u8>> {
    let mut head = Bytes::new(path, bytes);
    let frames = head.u32("hash.frames")? as usize;
    if !(1..=MAX_FRAMES).contains(&frames) {
        return Err(head.invalid("hash.frames", frames, format!("1 to {MAX_FRAMES}")));
    }
    let (side, offset_side) = (head.u32("hash.side")?, head.u32("hash.offset_side")?);
    let lengths = (0..=frames).map(|_| head.u64("hash.lengths")).collect::<Result<Vec<u64>>>()?;
    let mut next = |what: &str, length: u64| head.take(usize::try_from(length).unwrap_or(usize::MAX), what);
    let packed = next("hash.offsets", lengths[0])?;
    let mut codes = vec![];
    for &length in &lengths[1..] {
        codes.push(coded::decode(path, next("hash.coded", length)?)?);
    }
    head.finish("hash.coded")?;
    // Only now is it known how large the tables may be.
    let keys = codes.iter().flat_map(|f| &f.codes).filter(|&&c| c != 0).count();
    hash::check_sides(path, side, offset_side, keys as u64)?;
    let offsets = inflate(path, "hash.offsets", packed, 3 * u64::from(offset_side).pow(3))?;
    hash::assemble(path, &codes, &HashTable { side, offset_side, offsets })
}

fn resident_length(path: &Path, what: &str, bytes: &[u8], expected: u64) -> Result<()> {
    match bytes.len() as u64 == expected {
        true => Ok(()),
        false => Err(Error::invalid(path, format!("{what}.bytes_resident"), expected, bytes.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::hash::tests::trivial;
    use crate::residual::tests::{ball, frames_of_every_kind};

    const CODECS: [Codec; 3] = [Codec::Raw, Codec::Coded, Codec::Deflate];

    #[test]
    fn a_rank_section_is_resident_in_the_same_bytes_from_every_codec() {
        let path = Path::new("p");
        for frame in frames_of_every_kind() {
            for codec in CODECS {
                let resident = rank::encode(&frame);
                let bytes = encode_rank(&frame, &resident, codec, None);
                let back = decode_rank(path, bytes, codec, resident.len() as u64, None).unwrap();
                assert_eq!(back.bytes(), resident);
                assert_eq!(back.codes(0).unwrap(), frame);
            }
        }
    }

    #[test]
    fn a_frame_coded_after_another_needs_just_that_one() {
        let path = Path::new("p");
        let (before, frame) = (ball([20, 30, 17], 90, 1), ball([22, 30, 15], 90, 2));
        let resident = rank::encode(&frame);
        let length = resident.len() as u64;
        let bytes = encode_rank(&frame, &resident, Codec::CodedAfter, Some(&before));
        let decode =
            |previous: Option<&ResidualCodes>| decode_rank(path, bytes.clone(), Codec::CodedAfter, length, previous);
        assert_eq!(decode(Some(&before)).unwrap().bytes(), resident);
        assert!(decode(None).is_err() && decode(Some(&frame)).is_err());
    }

    #[test]
    fn a_hash_section_is_resident_in_the_same_bytes_from_every_codec() {
        let path = Path::new("p");
        let frames: Vec<_> = (0..5).map(|i| ball([9, 8, 7 + i], 60, u64::from(i))).collect();
        let table = trivial(&frames);
        for codec in CODECS {
            let (bytes, resident) = encode_hash(path, &frames, &table, codec).unwrap();
            let back = decode_hash(path, bytes, codec, resident).unwrap();
            assert_eq!(back.bytes(), hash::assemble(path, &frames, &table).unwrap());
            assert_eq!(back.codes(3).unwrap(), frames[3]);
        }
    }

    #[test]
    fn every_prefix_an_extra_byte_and_a_wrong_length_are_refused_by_every_codec() {
        let path = Path::new("p");
        let frames = [ball([9, 8, 7], 60, 1)];
        let resident = rank::encode(&frames[0]);
        let hash = |codec, bytes: &[u8], resident| decode_hash(path, bytes.to_vec(), codec, resident);
        let rank = |codec, bytes: &[u8], resident| decode_rank(path, bytes.to_vec(), codec, resident, None);
        type Decode<'a> = &'a dyn Fn(Codec, &[u8], u64) -> Result<Residual>;
        for codec in CODECS {
            let kinds: [(Decode, (Vec<u8>, u64)); 2] = [
                (&rank, (encode_rank(&frames[0], &resident, codec, None), resident.len() as u64)),
                (&hash, encode_hash(path, &frames, &trivial(&frames), codec).unwrap()),
            ];
            for (decode, (bytes, resident)) in kinds {
                for length in (0..bytes.len()).step_by(3).chain([bytes.len() - 1]) {
                    assert!(decode(codec, &bytes[..length], resident).is_err(), "{codec:?} {length}");
                }
                assert!(decode(codec, &[&bytes[..], &[0]].concat(), resident).is_err(), "{codec:?}");
                assert!(decode(codec, &bytes, resident + 1).is_err());
                assert!(decode(codec, &bytes, resident - 1).is_err());
                assert!(decode(codec, &bytes, resident).is_ok());
            }
        }
    }

    #[test]
    fn a_zlib_bomb_stops_at_the_length_that_was_claimed() {
        let bomb = deflate(&vec![0; 10 << 20]);
        let message = inflate(Path::new("p"), "x", &bomb, 100).unwrap_err().to_string();
        assert_eq!(message, "p: x: found 101 bytes or more, expected 100 bytes");
    }
}
