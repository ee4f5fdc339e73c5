//! One frame, ready to be copied into a pack: what a bake keeps of a frame when it is done with it.
//!
//! Encoding is the slow part of writing, and needs only the frame; so it is apart from [`super::PackWriter`], which
//! only copies. The bytes of [`EncodedFrame::to_bytes`] are for a bake's own work files, which an interrupted bake
//! finds again; they carry a checksum and are no part of the pack's format.

use super::at_rest::{decode_gaussians, encode_rank};
use super::gaussians::{self, GAUSSIAN_BYTES};
use super::records::{self, Codec, FrameRecord, ResidualKind};
use super::work_file;
use super::zlib::deflate;
use crate::gaussian::Gaussian;
use crate::residual::ResidualCodes;
use crate::residual::rank::{self, RankView};
use crate::{Error, Result};
use std::path::Path;

const MAGIC: [u8; 8] = *b"SBWORK\x01\n";

/// One frame as it goes into a pack.
#[derive(Clone, Debug)]
pub struct FrameData<'a> {
    /// What is known of it; the fields that [`FrameRecord`] says the writer fills in may hold anything.
    pub record: FrameRecord,
    /// Its Gaussians, in the order of the sum; for [`Codec::Snapped`] from [`super::snap_gaussians`].
    pub gaussians: &'a [Gaussian],
    /// Its residual.
    pub codes: &'a ResidualCodes,
}

/// How sections lie in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AtRest {
    /// `Raw`, `Deflate` or `Snapped`.
    pub gaussians: Codec,
    /// `Raw`, `Deflate` or `Coded`.
    pub residual: Codec,
}

impl AtRest {
    /// The smallest file: Gaussians at 16 bits a parameter, coded residual.
    pub const SMALLEST: Self = Self { gaussians: Codec::Snapped, residual: Codec::Coded };
    /// Resident bytes as they are, to be uploaded without decoding.
    pub const RAW: Self = Self { gaussians: Codec::Raw, residual: Codec::Raw };
}

/// A frame with its Gaussians and its residual, in the rank layout, as they lie at rest.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedFrame {
    pub(super) record: FrameRecord,
    pub(super) at_rest: AtRest,
    pub(super) gaussians: Vec<u8>,
    pub(super) residual: Vec<u8>,
    /// The residual's rank layout, resident: the quick way back to the codes.
    ranks: Vec<u8>,
}

impl EncodedFrame {
    /// Encodes a frame; `path` is the pack that errors name. With `previous`, a coded residual is coded after that
    /// frame's, which must be the one before in the pack.
    pub fn new(path: &Path, frame: &FrameData, at_rest: AtRest, previous: Option<&ResidualCodes>) -> Result<Self> {
        let at_rest = match (at_rest.residual, previous) {
            (Codec::Coded, Some(_)) => AtRest { residual: Codec::CodedAfter, ..at_rest },
            _ => at_rest,
        };
        frame.codes.check(path)?;
        gaussians::check(path, &format!("frame {}", frame.record.frame), frame.gaussians)?;
        let plain: Vec<u8> = frame.gaussians.iter().flat_map(gaussians::to_bytes).collect();
        let gaussians_resident = (frame.gaussians.len() * GAUSSIAN_BYTES) as u64;
        let gaussians = match at_rest.gaussians {
            Codec::Raw => plain,
            Codec::Deflate => deflate(&plain),
            Codec::Snapped => gaussians::encode(path, frame.gaussians)?,
            Codec::Coded | Codec::CodedAfter => {
                return Err(Error::invalid(path, "gaussians.codec", "Coded", "Raw, Deflate, Snapped"));
            }
        };
        let ranks = rank::encode(frame.codes);
        let residual = encode_rank(frame.codes, &ranks, at_rest.residual, previous);
        let record = FrameRecord {
            origin: frame.codes.origin,
            dims: frame.codes.dims,
            active_voxels: frame.codes.codes.len() as u64,
            gaussians: frame.gaussians.len() as u32,
            residual: ResidualKind::Rank,
            rank_bytes: ranks.len() as u64,
            bytes_at_rest: (gaussians.len() + residual.len()) as u64,
            bytes_resident: gaussians_resident + ranks.len() as u64,
            ..frame.record
        };
        Ok(Self { record, at_rest, gaussians, residual, ranks })
    }

    /// What is known of the frame.
    pub fn record(&self) -> &FrameRecord {
        &self.record
    }

    /// Notes the size of the hash that was built for the frame's tile and not used: its share, in bytes.
    pub fn set_hash_bytes(&mut self, bytes: u64) {
        self.record.hash_bytes = bytes;
    }

    /// The Gaussians, decoded.
    pub fn decode_gaussians(&self, path: &Path) -> Result<Vec<Gaussian>> {
        let resident = u64::from(self.record.gaussians) * GAUSSIAN_BYTES as u64;
        decode_gaussians(path, "frame", &self.gaussians, self.at_rest.gaussians, resident)
    }

    /// The residual.
    pub fn codes(&self, path: &Path) -> Result<ResidualCodes> {
        Ok(RankView::new(path, &self.ranks[..])?.codes())
    }

    /// The frame as bytes of a work file.
    pub fn to_bytes(&self, path: &Path) -> Result<Vec<u8>> {
        let record = records::encode(
            path,
            "frame",
            &(self.record, [self.at_rest.gaussians as u32, self.at_rest.residual as u32]),
        )?;
        Ok(work_file::join(MAGIC, [&record, &self.gaussians, &self.residual, &self.ranks]))
    }

    /// The frame of [`Self::to_bytes`]; anything else is an error.
    pub fn from_bytes(path: &Path, bytes: &[u8]) -> Result<Self> {
        let [record, gaussians, residual, ranks] =
            work_file::split(path, MAGIC, ["record", "gaussians", "residual", "ranks"], bytes)?;
        let (record, codecs): (FrameRecord, [u32; 2]) = records::decode(path, "frame", record)?;
        let [gaussians, residual, ranks] = [gaussians, residual, ranks].map(<[u8]>::to_vec);
        let codec = |number: u32| {
            Codec::from_number(number).ok_or_else(|| Error::invalid(path, "codec", number, "a codec's number"))
        };
        let at_rest = AtRest { gaussians: codec(codecs[0])?, residual: codec(codecs[1])? };
        Ok(Self { record, at_rest, gaussians, residual, ranks })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::ball;

    #[test]
    fn a_work_file_returns_the_frame_and_every_damage_is_noticed() {
        let path = Path::new("frame.1001");
        let codes = ball([17, 9, 20], 60, 3);
        let gaussians = [Gaussian { center: [0.25, 0.5, 0.5], radius: 0.125, weight: 0.5 }];
        let record = FrameRecord { frame: 1001, step: 0.01, ..FrameRecord::default() };
        for at_rest in [AtRest::SMALLEST, AtRest::RAW] {
            let gaussians = super::super::snap_gaussians(path, &gaussians).unwrap();
            let frame =
                EncodedFrame::new(path, &FrameData { record, gaussians: &gaussians, codes: &codes }, at_rest, None)
                    .unwrap();
            let bytes = frame.to_bytes(path).unwrap();
            let back = EncodedFrame::from_bytes(path, &bytes).unwrap();
            assert_eq!(back, frame);
            assert_eq!(back.codes(path).unwrap(), codes);
            assert_eq!(back.decode_gaussians(path).unwrap(), gaussians);
            for cut in 0..bytes.len() {
                assert!(EncodedFrame::from_bytes(path, &bytes[..cut]).is_err(), "cut at {cut}");
            }
            for bit in 0..bytes.len() * 8 {
                let mut bad = bytes.clone();
                bad[bit / 8] ^= 1 << (bit % 8);
                assert!(EncodedFrame::from_bytes(path, &bad).is_err(), "bit {bit}");
            }
        }
    }
}
