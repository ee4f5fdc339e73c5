//! Transfer as sections: the bases of a run, the rows of a frame. Half floats and bytes as they are in memory, with
//! counts before them; each set ends on a multiple of four bytes. `FORMAT.md` states every offset.
//!
//! A layout has one way to be written: rows that are not there have no terms, and filling bytes are zero, so that
//! reading and writing again gives the same bytes.

use super::container::kind_name;
use super::records::Codec;
use super::zlib::{deflate, inflate};
use crate::bounded::Bytes;
use crate::transfer::{Bases, Rows, TransferBases, TransferRows, check_sets};
use crate::{Error, Result};
use half::f16;
use std::path::Path;

/// Bytes before the sets: their numbers, direct and indirect.
pub const HEADER_BYTES: usize = 8;
/// Bytes before the values of a set of bases: length, clusters, terms, scale.
pub const BASES_BYTES: usize = 16;
/// Bytes before the weights of a set of rows: rows, terms.
pub const ROWS_BYTES: usize = 8;
/// Sets start on multiples of this.
const ALIGNMENT: usize = 4;

/// The resident bytes of good bases.
pub fn encode_bases(bases: &TransferBases) -> Vec<u8> {
    let mut bytes = header(bases.direct.len(), bases.indirect.len());
    for set in bases.direct.iter().chain(&bases.indirect) {
        [set.length, set.clusters, set.terms].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(set.scale.to_le_bytes());
        set.values.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        fill(&mut bytes);
    }
    bytes
}

/// The resident bytes of good rows.
pub fn encode_rows(rows: &TransferRows) -> Vec<u8> {
    let mut bytes = header(rows.direct.len(), rows.indirect.len());
    for set in rows.direct.iter().chain(&rows.indirect) {
        [set.ids.len(), set.terms()].iter().for_each(|&v| bytes.extend((v as u32).to_le_bytes()));
        set.weights.iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        bytes.extend(&set.ids);
        fill(&mut bytes);
    }
    bytes
}

/// Bases from all of their resident bytes. Counts are held against the bytes; what the numbers say is for
/// [`TransferBases::check`].
pub fn decode_bases(path: &Path, what: &str, bytes: &[u8]) -> Result<TransferBases> {
    let (direct, indirect) = sets(path, what, bytes, |head, what| {
        let mut field = |name: &str| head.u32(&format!("{what}.{name}"));
        let (length, clusters, terms) = (field("length")?, field("clusters")?, field("terms")?);
        let scale = head.f32(&format!("{what}.scale"))?;
        let mut set = Bases { length, clusters, terms, scale, values: vec![] };
        set.values = halves(head, &format!("{what}.values"), set.numbers())?;
        Ok(set)
    })?;
    Ok(TransferBases { direct, indirect })
}

/// Rows from all of their resident bytes; as [`decode_bases`].
pub fn decode_rows(path: &Path, what: &str, bytes: &[u8]) -> Result<TransferRows> {
    let (direct, indirect) = sets(path, what, bytes, |head, what| {
        let (rows, terms) = (head.u32(&format!("{what}.rows"))?, head.u32(&format!("{what}.terms"))?);
        if rows == 0 && terms != 0 {
            return Err(head.invalid(&format!("{what}.terms"), terms, "0, as there are no rows"));
        }
        let weights = halves(head, &format!("{what}.weights"), u128::from(rows) * u128::from(terms))?;
        let ids = head.take(rows as usize, &format!("{what}.ids"))?.to_vec();
        Ok(Rows { ids, weights })
    })?;
    Ok(TransferRows { direct, indirect })
}

/// Resident bytes as they lie at rest; `kind` names them in errors.
pub fn to_rest(path: &Path, kind: u32, resident: Vec<u8>, codec: Codec) -> Result<Vec<u8>> {
    match codec {
        Codec::Raw => Ok(resident),
        Codec::Deflate => Ok(deflate(&resident)),
        Codec::Coded | Codec::Snapped | Codec::CodedAfter => {
            let what = format!("transfer.{}.codec", kind_name(kind));
            Err(Error::invalid(path, what, format!("{codec:?}"), "Raw, Deflate"))
        }
    }
}

/// The resident bytes of a section at rest that claims `resident` of them.
pub fn from_rest(path: &Path, what: &str, bytes: Vec<u8>, codec: Codec, resident: u64) -> Result<Vec<u8>> {
    let bytes = if codec == Codec::Deflate { inflate(path, what, &bytes, resident)? } else { bytes };
    match bytes.len() as u64 == resident {
        true => Ok(bytes),
        false => Err(Error::invalid(path, format!("{what}.bytes_resident"), resident, bytes.len())),
    }
}

fn header(direct: usize, indirect: usize) -> Vec<u8> {
    [direct as u32, indirect as u32].iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn fill(bytes: &mut Vec<u8>) {
    bytes.resize(bytes.len().next_multiple_of(ALIGNMENT), 0);
}

/// Direct and indirect sets, each read by `read`, which is told its name.
fn sets<T>(
    path: &Path,
    what: &str,
    bytes: &[u8],
    read: impl Fn(&mut Bytes, &str) -> Result<T>,
) -> Result<(Vec<T>, Vec<T>)> {
    let mut head = Bytes::new(path, bytes);
    let mut count = |name: &str| check_sets(path, what, name, head.u32(&format!("{what}.{name}"))? as usize);
    let (direct, indirect) = (count("direct")?, count("indirect")?);
    let mut set = |name: &str, i: usize| {
        let what = format!("{what}.{name}[{i}]");
        let set = read(&mut head, &what)?;
        let filling = head.position().next_multiple_of(ALIGNMENT) - head.position();
        match head.take(filling, &what)?.iter().any(|&b| b != 0) {
            true => Err(head.invalid(&what, "filling bytes that are not zero", "zeros")),
            false => Ok(set),
        }
    };
    let direct = (0..direct).map(|i| set("direct", i)).collect::<Result<_>>()?;
    let indirect = (0..indirect).map(|i| set("indirect", i)).collect::<Result<_>>()?;
    head.finish(what)?;
    Ok((direct, indirect))
}

/// The next `count` half floats: more than there are bytes for is refused before anything is allocated.
fn halves(head: &mut Bytes, what: &str, count: u128) -> Result<Vec<f16>> {
    let count = usize::try_from(2 * count).unwrap_or(usize::MAX);
    let bytes = head.take(count, what)?;
    Ok(bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]])).collect())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::pack::container::{KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS};
    use crate::transfer::tests::{some_bases, some_rows};

    /// Bases and the rows of a frame with `voxels` voxels and `cells` cells. Odd counts, so that filling is needed.
    pub(in crate::pack) fn some_transfer(voxels: usize, cells: usize, seed: u64) -> (TransferBases, TransferRows) {
        let bases = TransferBases {
            direct: vec![some_bases(3, 3, 2, seed)],
            indirect: vec![some_bases(5, 1, 0, seed + 1), some_bases(5, 2, 1, seed + 2)],
        };
        let rows = TransferRows {
            direct: bases.direct.iter().map(|b| some_rows(voxels, b, seed + 3)).collect(),
            indirect: bases.indirect.iter().map(|b| some_rows(cells, b, seed + 4)).collect(),
        };
        (bases, rows)
    }

    fn path() -> &'static Path {
        Path::new("p")
    }

    #[test]
    fn small_bases_and_rows_have_golden_bytes() {
        let half = |v: f32| f16::from_f32(v);
        let set = Bases { length: 1, clusters: 1, terms: 0, scale: 2.0, values: vec![half(1.0)] };
        let more =
            Bases { length: 1, clusters: 2, terms: 1, scale: 0.5, values: [1.0, -2.0, 0.5, 0.0].map(half).to_vec() };
        let bases = TransferBases { direct: vec![set], indirect: vec![more] };
        // 1 is 3c00, -2 is c000, 0.5 is 3800; of the scales, 2 is 40000000 and 0.5 is 3f000000.
        let expected = [
            &[1, 0, 0, 0, 1, 0, 0, 0][..],
            &[1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x40, 0x00, 0x3c, 0, 0],
            &[1, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0x3f, 0x00, 0x3c, 0x00, 0xc0, 0x00, 0x38, 0, 0],
        ];
        assert_eq!(encode_bases(&bases), expected.concat());
        assert_eq!(decode_bases(path(), "b", &expected.concat()).unwrap(), bases);
        let rows = TransferRows {
            direct: vec![Rows { ids: vec![0], weights: vec![] }],
            indirect: vec![Rows { ids: vec![1, 0, 1], weights: [0.5, 1.0, -2.0].map(half).to_vec() }],
        };
        let expected = [
            &[1, 0, 0, 0, 1, 0, 0, 0][..],
            &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            &[3, 0, 0, 0, 1, 0, 0, 0, 0x00, 0x38, 0x00, 0x3c, 0x00, 0xc0, 1, 0, 1, 0, 0, 0],
        ];
        assert_eq!(encode_rows(&rows), expected.concat());
        assert_eq!(decode_rows(path(), "r", &expected.concat()).unwrap(), rows);
    }

    #[test]
    fn bases_and_rows_come_back_from_every_codec_and_no_other_is_taken() {
        for (voxels, cells) in [(0, 0), (1, 1), (61, 7), (5000, 300)] {
            let (bases, rows) = some_transfer(voxels, cells, 1);
            for codec in [Codec::Raw, Codec::Deflate] {
                let back = |kind: u32, resident: Vec<u8>| {
                    let length = resident.len() as u64;
                    assert!(length.is_multiple_of(4));
                    from_rest(path(), "s", to_rest(path(), kind, resident, codec).unwrap(), codec, length).unwrap()
                };
                let bytes = back(KIND_TRANSFER_BASES, encode_bases(&bases));
                assert_eq!(decode_bases(path(), "b", &bytes).unwrap(), bases);
                let bytes = back(KIND_TRANSFER_ROWS, encode_rows(&rows));
                assert_eq!(decode_rows(path(), "r", &bytes).unwrap(), rows);
            }
        }
        for codec in [Codec::Coded, Codec::Snapped, Codec::CodedAfter] {
            let message = to_rest(path(), KIND_TRANSFER_ROWS, vec![], codec).unwrap_err().to_string();
            assert_eq!(message, format!("p: transfer.rows.codec: found {codec:?}, expected Raw, Deflate"));
        }
    }

    #[test]
    fn every_prefix_an_extra_byte_and_a_wrong_length_are_refused() {
        let (bases, rows) = some_transfer(61, 7, 2);
        let decode_bases = |bytes: &[u8]| decode_bases(path(), "b", bytes).map(drop);
        let decode_rows = |bytes: &[u8]| decode_rows(path(), "r", bytes).map(drop);
        type Decode<'a> = &'a dyn Fn(&[u8]) -> Result<()>;
        let kinds: [(Decode, Vec<u8>); 2] = [(&decode_bases, encode_bases(&bases)), (&decode_rows, encode_rows(&rows))];
        for (decode, good) in kinds {
            decode(&good).unwrap();
            for length in 0..good.len() {
                assert!(decode(&good[..length]).is_err(), "{length}");
            }
            assert!(decode(&[&good[..], &[0]].concat()).is_err());
            let resident = good.len() as u64;
            for codec in [Codec::Raw, Codec::Deflate] {
                let rest = to_rest(path(), KIND_TRANSFER_ROWS, good.clone(), codec).unwrap();
                let back = |bytes: &[u8], resident| from_rest(path(), "s", bytes.to_vec(), codec, resident);
                for length in 0..rest.len() {
                    assert!(back(&rest[..length], resident).is_err(), "{codec:?} {length}");
                }
                assert!(back(&[&rest[..], &[0]].concat(), resident).is_err(), "{codec:?}");
                assert!(back(&rest, resident - 1).is_err() && back(&rest, resident + 1).is_err());
                assert!(back(&rest, u64::MAX).is_err() && back(&rest, resident).is_ok());
            }
        }
    }

    #[test]
    fn hostile_counts_are_refused_before_anything_of_their_size_is_made() {
        let (bases, rows) = some_transfer(61, 7, 3);
        let (bases, rows) = (encode_bases(&bases), encode_rows(&rows));
        for value in [4, 1 << 16, 1 << 31, u32::MAX] {
            let spoilt = |good: &[u8], at: usize| {
                let mut bytes = good.to_vec();
                bytes[at..at + 4].copy_from_slice(&u32::to_le_bytes(value));
                bytes
            };
            // Numbers of sets; length, clusters, terms; rows, terms.
            for at in [0, 4, 8, 12, 16] {
                assert!(decode_bases(path(), "b", &spoilt(&bases, at)).is_err(), "{at} {value}");
            }
            for at in [0, 4, 8, 12] {
                assert!(decode_rows(path(), "r", &spoilt(&rows, at)).is_err(), "{at} {value}");
            }
        }
        // All three at once: their product is past 2^64.
        let all = [&bases[..8], &[255; 12], &bases[20..]].concat();
        let message = decode_bases(path(), "b", &all).unwrap_err().to_string();
        assert!(message.starts_with("p: b.direct[0].values: found "), "{message}");
        for (sets, named) in [([0, 1], "b.direct"), ([1, 0], "b.indirect"), ([4, 1], "b.direct")] {
            let bytes = [header(sets[0], sets[1]), bases[8..].to_vec()].concat();
            let message = decode_bases(path(), "b", &bytes).unwrap_err().to_string();
            assert_eq!(
                message,
                format!("p: {named}: found {} sets, expected 1 to 3", if sets[0] == 1 { 0 } else { sets[0] })
            );
        }
    }

    #[test]
    fn there_is_one_way_to_write_a_layout() {
        let (_, rows) = some_transfer(0, 1, 4);
        let mut bytes = encode_rows(&rows);
        // Rows that are not there, with terms.
        bytes[12] = 1;
        let message = decode_rows(path(), "r", &bytes).unwrap_err().to_string();
        assert_eq!(message, "p: r.direct[0].terms: found 1, expected 0, as there are no rows");
        let (_, rows) = some_transfer(1, 1, 4);
        let mut bytes = encode_rows(&rows);
        // Two weights and an id leave three filling bytes.
        bytes[8 + 8 + 4 + 1] = 1;
        let message = decode_rows(path(), "r", &bytes).unwrap_err().to_string();
        assert_eq!(message, "p: r.direct[0]: found filling bytes that are not zero, expected zeros");
    }
}
