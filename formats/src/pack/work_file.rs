//! Work files of a bake: a magic, the lengths of the parts, the parts, and a checksum of all before it.
//!
//! An interrupted bake finds them again. They are no part of the pack's format, and no other version reads them.

use crate::Result;
use crate::bounded::Bytes;
use std::path::Path;
use xxhash_rust::xxh3::xxh3_64;

/// The parts as one file.
pub(super) fn join<const N: usize>(magic: [u8; 8], parts: [&[u8]; N]) -> Vec<u8> {
    let mut bytes = magic.to_vec();
    parts.iter().for_each(|part| bytes.extend((part.len() as u64).to_le_bytes()));
    parts.iter().for_each(|part| bytes.extend(*part));
    bytes.extend(xxh3_64(&bytes).to_le_bytes());
    bytes
}

/// The parts of [`join`], told by `names` in errors; anything else is an error.
pub(super) fn split<'a, const N: usize>(
    path: &'a Path,
    magic: [u8; 8],
    names: [&str; N],
    bytes: &'a [u8],
) -> Result<[&'a [u8]; N]> {
    let mut head = Bytes::new(path, bytes);
    if head.take(8, "magic")? != magic {
        return Err(head.invalid("magic", "other bytes", "a work file of this kind and version"));
    }
    let sum = bytes.len().saturating_sub(8);
    if head.remaining() < 8 || xxh3_64(&bytes[..sum]).to_le_bytes() != bytes[sum..] {
        return Err(head.invalid("checksum", "another", "that of the bytes before it"));
    }
    let mut lengths = [0; N];
    for length in &mut lengths {
        *length = usize::try_from(head.u64("length")?).unwrap_or(usize::MAX);
    }
    let mut parts: [&[u8]; N] = [&[]; N];
    for ((part, length), name) in parts.iter_mut().zip(lengths).zip(names) {
        *part = head.take(length, name)?;
    }
    head.take(8, "checksum")?;
    head.finish("end")?;
    Ok(parts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_come_back_and_every_damage_and_other_kind_is_noticed() {
        let path = Path::new("w");
        let bytes = join(*b"MAGIC\x01\x02\n", [b"one", b"", b"three"]);
        let parts =
            |bytes: &[u8]| split(path, *b"MAGIC\x01\x02\n", ["a", "b", "c"], bytes).map(|p| p.map(<[u8]>::to_vec));
        assert_eq!(parts(&bytes).unwrap(), [&b"one"[..], b"", b"three"]);
        assert!(split(path, *b"MAGIC\x01\x03\n", ["a", "b", "c"], &bytes).is_err());
        assert!(
            (0..bytes.len()).all(|cut| parts(&bytes[..cut]).is_err()) && parts(&[&bytes[..], b"0"].concat()).is_err()
        );
        for bit in 0..bytes.len() * 8 {
            let mut bad = bytes.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(parts(&bad).is_err(), "bit {bit}");
        }
    }
}
