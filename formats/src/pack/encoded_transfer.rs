//! The transfer of one frame, ready to be copied into a pack: what a bake keeps of it, as [`super::EncodedFrame`] is
//! what it keeps of a frame's density.
//!
//! The first frame of a run may carry the bases that its run shares. The bytes of [`EncodedTransfer::to_bytes`] are for
//! a bake's own work files, which an interrupted bake finds again; they carry a checksum and are no part of the pack's
//! format.

use super::container::{KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS};
use super::records::{self, Codec};
use super::transfer_layout::{decode_bases, decode_rows, encode_bases, encode_rows, from_rest, to_rest};
use super::transfer_record::TransferFrameRecord;
use super::work_file;
use crate::transfer::{Shape, TransferBases, TransferRows};
use crate::{Error, Result};
use std::path::Path;

const MAGIC: [u8; 8] = *b"SBTRANS\n";

/// A section as it lies at rest, and what is known of it without decoding.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct EncodedSection {
    pub(super) codec: Codec,
    pub(super) bytes: Vec<u8>,
    pub(super) bytes_resident: u64,
    pub(super) shape: Shape,
}

impl EncodedSection {
    /// Bases at rest; fails unless they are good.
    pub(super) fn of_bases(path: &Path, what: &str, bases: &TransferBases, codec: Codec) -> Result<Self> {
        let shape = bases.check(path, what)?;
        Self::new(path, KIND_TRANSFER_BASES, encode_bases(bases), codec, shape)
    }

    /// Rows at rest; fails unless they are good.
    pub(super) fn of_rows(path: &Path, what: &str, rows: &TransferRows, codec: Codec) -> Result<Self> {
        let shape = rows.check(path, what)?;
        Self::new(path, KIND_TRANSFER_ROWS, encode_rows(rows), codec, shape)
    }

    fn new(path: &Path, kind: u32, resident: Vec<u8>, codec: Codec, shape: Shape) -> Result<Self> {
        let bytes_resident = resident.len() as u64;
        Ok(Self { codec, bytes: to_rest(path, kind, resident, codec)?, bytes_resident, shape })
    }

    fn resident(&self, path: &Path, what: &str) -> Result<Vec<u8>> {
        from_rest(path, what, self.bytes.clone(), self.codec, self.bytes_resident)
    }
}

/// The rows of a frame, and the bases of its run if it brings them, as they lie at rest.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedTransfer {
    record: TransferFrameRecord,
    pub(super) rows: EncodedSection,
    pub(super) bases: Option<EncodedSection>,
}

impl EncodedTransfer {
    /// Encodes the transfer of a frame with [`Codec::Raw`] or [`Codec::Deflate`]; `path` is the pack that errors name.
    /// Fails on rows that disagree with the record's counts or with `bases`, which are those of the frame's run.
    pub fn new(
        path: &Path,
        record: &TransferFrameRecord,
        rows: &TransferRows,
        bases: Option<&TransferBases>,
        codec: Codec,
    ) -> Result<Self> {
        let rows = EncodedSection::of_rows(path, "transfer.rows", rows, codec)?;
        let bases = bases.map(|bases| EncodedSection::of_bases(path, "transfer.bases", bases, codec)).transpose()?;
        let encoded = Self { record: *record, rows, bases };
        encoded.check(path)?;
        Ok(encoded)
    }

    /// What is known of it; the fields that the writer of the pack fills in are as they were given.
    pub fn record(&self) -> &TransferFrameRecord {
        &self.record
    }

    /// The rows, decoded.
    pub fn decode_rows(&self, path: &Path) -> Result<TransferRows> {
        decode_rows(path, "transfer.rows", &self.rows.resident(path, "transfer.rows")?)
    }

    /// The bases, decoded, if it brings them.
    pub fn decode_bases(&self, path: &Path) -> Result<Option<TransferBases>> {
        let decode = |s: &EncodedSection| decode_bases(path, "transfer.bases", &s.resident(path, "transfer.bases")?);
        self.bases.as_ref().map(decode).transpose()
    }

    /// The transfer as bytes of a work file.
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>> {
        let rows = (self.rows.codec as u32, self.rows.bytes_resident);
        let bases = self.bases.as_ref().map(|bases| (bases.codec as u32, bases.bytes_resident));
        let record = records::encode(path, "transfer", &(self.record, rows, bases))?;
        let bases = self.bases.as_ref().map_or(&[][..], |bases| &bases.bytes);
        Ok(work_file::join(MAGIC, [&record, &self.rows.bytes, bases]))
    }

    /// The transfer of [`Self::to_bytes`], all of it checked; anything else is an error.
    pub fn from_bytes(path: &Path, bytes: &[u8]) -> Result<Self> {
        let [record, rows_bytes, bases_bytes] =
            work_file::split(path, MAGIC, ["record", "transfer.rows", "transfer.bases"], bytes)?;
        type Head = (u32, u64);
        let (record, rows, bases): (TransferFrameRecord, Head, Option<Head>) =
            records::decode(path, "transfer", record)?;
        let [rows_bytes, bases_bytes] = [rows_bytes, bases_bytes].map(<[u8]>::to_vec);
        let rows = section(path, "transfer.rows", rows, rows_bytes, |what, resident| {
            decode_rows(path, what, resident)?.check(path, what)
        })?;
        let bases = match bases {
            Some(bases) => Some(section(path, "transfer.bases", bases, bases_bytes, |what, resident| {
                decode_bases(path, what, resident)?.check(path, what)
            })?),
            None if bases_bytes.is_empty() => None,
            None => return Err(Error::invalid(path, "transfer.bases", format!("{} bytes", bases_bytes.len()), "none")),
        };
        let encoded = Self { record, rows, bases };
        encoded.check(path)?;
        Ok(encoded)
    }

    fn check(&self, path: &Path) -> Result<()> {
        self.record.check_rows(path, "transfer.rows", &self.rows.shape)?;
        match &self.bases {
            Some(bases) => self.rows.shape.check_rows_by(path, "transfer.rows", &bases.shape),
            None => Ok(()),
        }
    }
}

/// A section of a work file; `shape` decodes and checks its resident bytes.
fn section(
    path: &Path,
    what: &str,
    (codec, bytes_resident): (u32, u64),
    bytes: Vec<u8>,
    shape: impl Fn(&str, &[u8]) -> Result<Shape>,
) -> Result<EncodedSection> {
    let Some(codec) = Codec::from_number(codec).filter(|c| matches!(c, Codec::Raw | Codec::Deflate)) else {
        return Err(Error::invalid(path, format!("{what}.codec"), codec, "0 or 2: Raw, Deflate"));
    };
    let shape = shape(what, &from_rest(path, what, bytes.clone(), codec, bytes_resident)?)?;
    Ok(EncodedSection { codec, bytes, bytes_resident, shape })
}

#[cfg(test)]
mod tests {
    use super::super::transfer_layout::tests::some_transfer;
    use super::*;

    #[test]
    fn a_work_file_returns_the_transfer_and_every_damage_is_noticed() {
        let path = Path::new("transfer.1001");
        let (bases, rows) = some_transfer(17, 3, 1);
        let record = TransferFrameRecord { frame: 4, voxels: 17, cells: 3, truncated: 0.25, ..Default::default() };
        for (codec, brings) in [(Codec::Raw, Some(&bases)), (Codec::Deflate, Some(&bases)), (Codec::Deflate, None)] {
            let encoded = EncodedTransfer::new(path, &record, &rows, brings, codec).unwrap();
            let bytes = encoded.to_bytes(path).unwrap();
            let back = EncodedTransfer::from_bytes(path, &bytes).unwrap();
            assert_eq!(back, encoded);
            assert_eq!(back.record(), &record);
            assert_eq!(back.decode_rows(path).unwrap(), rows);
            assert_eq!(back.decode_bases(path).unwrap().as_ref(), brings);
            for cut in 0..bytes.len() {
                assert!(EncodedTransfer::from_bytes(path, &bytes[..cut]).is_err(), "cut at {cut}");
            }
            assert!(EncodedTransfer::from_bytes(path, &[&bytes[..], &[0]].concat()).is_err());
            for bit in 0..bytes.len() * 8 {
                let mut bad = bytes.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                assert!(EncodedTransfer::from_bytes(path, &bad).is_err(), "bit {bit}");
            }
        }
    }

    #[test]
    fn rows_that_disagree_with_their_record_or_their_bases_are_refused() {
        let path = Path::new("p");
        let (bases, rows) = some_transfer(17, 3, 1);
        let record = TransferFrameRecord { voxels: 17, cells: 3, ..Default::default() };
        let refused = |record: &TransferFrameRecord, bases: Option<&TransferBases>, codec| {
            EncodedTransfer::new(path, record, &rows, bases, codec).unwrap_err().to_string()
        };
        let wrong = TransferFrameRecord { cells: 4, ..record };
        let expected = "p: transfer.rows.indirect[0].rows: found 3, expected 4, a row for each of the cells";
        assert_eq!(refused(&wrong, None, Codec::Raw), expected);
        let mut few = bases.clone();
        few.direct[0].clusters = 2;
        few.direct[0].values.truncate(2 * 3 * 3);
        let expected = "p: transfer.rows.direct[0].ids: found 2, expected below the 2 clusters of the bases";
        assert_eq!(refused(&record, Some(&few), Codec::Raw), expected);
        assert!(refused(&record, None, Codec::Snapped).contains("transfer.rows.codec: found Snapped"));
    }

    #[test]
    fn malicious_work_files_with_good_checksums_never_panic() {
        use xxhash_rust::xxh3::xxh3_64;
        let path = Path::new("p");
        let (bases, rows) = some_transfer(9, 2, 1);
        let record = TransferFrameRecord { voxels: 9, cells: 2, ..Default::default() };
        let good = EncodedTransfer::new(path, &record, &rows, Some(&bases), Codec::Raw).unwrap();
        let good = good.to_bytes(path).unwrap();
        for at in 8..good.len() - 16 {
            for value in [0u64, 1 << 31, 1 << 60, u64::MAX] {
                let mut bytes = good.clone();
                bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
                let sum = bytes.len() - 8;
                let checksum = xxh3_64(&bytes[..sum]);
                bytes[sum..].copy_from_slice(&checksum.to_le_bytes());
                // What is taken all the same is another good one.
                if let Ok(back) = EncodedTransfer::from_bytes(path, &bytes) {
                    assert!(back.decode_rows(path).is_ok() && back.decode_bases(path).is_ok());
                }
            }
        }
    }
}
