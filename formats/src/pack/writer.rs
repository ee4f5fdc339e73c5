//! Frames in, a pack out, one pass, with no more than one tile of frames in memory.
//!
//! The header is written last, over a blank one, so that an unfinished file is never mistaken for a pack; [`write()`] adds
//! a temporary file and a rename. The same input gives the same bytes: nothing here knows the time or the machine.

use super::at_rest::encode_hash;
use super::container::{
    ALIGNMENT, HEADER_BYTES, Header, KIND_FRAMES, KIND_GAUSSIANS, KIND_HASH, KIND_RANK, KIND_SEQUENCE, KIND_SETTINGS,
    KIND_TRANSFER, KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS,
};
use super::encoded::{AtRest, EncodedFrame, FrameData};
use super::encoded_transfer::{EncodedSection, EncodedTransfer};
use super::gaussians::GAUSSIAN_BYTES;
use super::records::{Codec, FrameRecord, ResidualKind, SectionRecord, SequenceRecord, SettingsRecord, encode};
use super::transfer_record::TransferRecord;
use super::transfer_sections::{bytes_of_transfer, even_share, sections_of_transfer};
use crate::residual::ResidualCodes;
use crate::residual::hash::{HashTable, MAX_FRAMES};
use crate::transfer::{Shape, TransferBases, TransferRows};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use xxhash_rust::xxh3::xxh3_64;

/// Writes a pack as a whole or not at all: `fill` pushes the frames and ends with [`PackWriter::finish`].
pub fn write(path: &Path, fill: impl FnOnce(PackWriter<&mut BufWriter<std::fs::File>>) -> Result<u64>) -> Result<u64> {
    crate::atomic::write(path, |file| fill(PackWriter::new(path, file)?))
}

/// Writes one pack, frame after frame. Any error leaves it unfinished.
#[derive(Debug)]
pub struct PackWriter<W> {
    out: W,
    path: PathBuf,
    position: u64,
    toc: Vec<SectionRecord>,
    frames: Vec<FrameRecord>,
    /// What was pushed of transfer, by its place in `toc`.
    transfer: BTreeMap<usize, Shape>,
}

impl<W: Write + Seek> PackWriter<W> {
    /// A writer at the start of `out`; `path` is named in errors.
    pub fn new(path: &Path, mut out: W) -> Result<Self> {
        out.write_all(&[0; HEADER_BYTES as usize]).map_err(|e| Error::io(path, e))?;
        Ok(Self {
            out,
            path: path.to_owned(),
            position: HEADER_BYTES,
            toc: vec![],
            frames: vec![],
            transfer: BTreeMap::new(),
        })
    }

    /// Frames pushed so far.
    pub fn frames(&self) -> usize {
        self.frames.len()
    }

    /// The next frame, its residual in the rank layout.
    pub fn push_rank(&mut self, frame: &FrameData, at_rest: AtRest) -> Result<()> {
        let encoded = EncodedFrame::new(&self.path, frame, at_rest, None)?;
        self.push_encoded(&encoded)
    }

    /// The next frame, encoded before.
    pub fn push_encoded(&mut self, frame: &EncodedFrame) -> Result<()> {
        let number = self.frames.len() as u32;
        self.push_gaussians(number, frame)?;
        let resident = frame.record.rank_bytes;
        self.section(KIND_RANK, frame.at_rest.residual, number..number + 1, &frame.residual, resident)?;
        self.frames.push(frame.record);
        Ok(())
    }

    /// The next 1 to 27 frames, their residuals in one perfect hash. Fails if `table` is not one for these codes.
    pub fn push_tile(&mut self, tile: &[FrameData], table: &HashTable, at_rest: AtRest) -> Result<()> {
        if tile.is_empty() || tile.len() > MAX_FRAMES {
            let expected = format!("1 to {MAX_FRAMES}");
            return Err(Error::invalid(&self.path, "hash.frames", tile.len(), expected));
        }
        let first = self.frames.len() as u32;
        let mut records = vec![];
        for (number, frame) in (first..).zip(tile) {
            // Only the Gaussians are taken of it; the residual goes into the tile's own section.
            let encoded = EncodedFrame::new(&self.path, frame, AtRest { residual: Codec::Raw, ..at_rest }, None)?;
            self.push_gaussians(number, &encoded)?;
            let residual = (encoded.residual.len() as u64, encoded.record.rank_bytes);
            records.push(FrameRecord {
                bytes_at_rest: encoded.record.bytes_at_rest - residual.0,
                bytes_resident: encoded.record.bytes_resident - residual.1,
                rank_bytes: frame.record.rank_bytes,
                ..encoded.record
            });
        }
        let codes: Vec<ResidualCodes> = tile.iter().map(|f| f.codes.clone()).collect();
        let (bytes, resident) = encode_hash(&self.path, &codes, table, at_rest.residual)?;
        self.section(KIND_HASH, at_rest.residual, first..first + tile.len() as u32, &bytes, resident)?;
        let share = |total: u64, i: usize| even_share(total, tile.len(), i);
        for (i, mut record) in records.into_iter().enumerate() {
            record.residual = ResidualKind::Hash;
            record.hash_bytes = share(resident, i);
            record.bytes_at_rest += share(bytes.len() as u64, i);
            record.bytes_resident += share(resident, i);
            self.frames.push(record);
        }
        Ok(())
    }

    /// The bases of a run of transfer: `frames` frames of the pack (counted from 0) from its first to its last, those
    /// without transfer between them included. `codec` is `Raw` or `Deflate`.
    pub fn push_transfer_bases(
        &mut self,
        first_frame: usize,
        frames: usize,
        bases: &TransferBases,
        codec: Codec,
    ) -> Result<()> {
        let encoded = EncodedSection::of_bases(&self.path, "transfer.bases", bases, codec)?;
        self.push_transfer(KIND_TRANSFER_BASES, first_frame, frames, &encoded)
    }

    /// The rows of transfer of a frame of the pack (counted from 0). `codec` is `Raw` or `Deflate`.
    pub fn push_transfer_rows(&mut self, frame: usize, rows: &TransferRows, codec: Codec) -> Result<()> {
        let encoded = EncodedSection::of_rows(&self.path, "transfer.rows", rows, codec)?;
        self.push_transfer(KIND_TRANSFER_ROWS, frame, 1, &encoded)
    }

    /// The transfer of a frame, encoded before; bases that it brings are those of `frames` frames from it on, as in
    /// [`Self::push_transfer_bases`].
    pub fn push_encoded_transfer(&mut self, frames: usize, transfer: &EncodedTransfer) -> Result<()> {
        let frame = transfer.record().frame as usize;
        if let Some(bases) = &transfer.bases {
            self.push_transfer(KIND_TRANSFER_BASES, frame, frames, bases)?;
        }
        self.push_transfer(KIND_TRANSFER_ROWS, frame, 1, &transfer.rows)
    }

    /// Writes records, table of contents and header; gives the bytes of the file. `transfer` names all transfer that was
    /// pushed, and is none if none was.
    pub fn finish(
        mut self,
        sequence: &SequenceRecord,
        settings: &SettingsRecord,
        transfer: Option<&TransferRecord>,
    ) -> Result<u64> {
        sequence.check(&self.path)?;
        settings.check(&self.path)?;
        for (number, frame) in self.frames.iter().enumerate() {
            frame.check(&self.path, number, sequence)?;
        }
        let transfer = self.finish_transfer(transfer)?;
        let path = self.path.clone();
        let records = [
            (KIND_SEQUENCE, encode(&path, "sequence", sequence)?),
            (KIND_SETTINGS, encode(&path, "settings", settings)?),
            (KIND_FRAMES, encode(&path, "frames", &self.frames)?),
        ];
        for (kind, bytes) in records.into_iter().chain(transfer) {
            let resident = bytes.len() as u64;
            self.section(kind, Codec::Raw, 0..0, &bytes, resident)?;
        }
        let toc = encode(&path, "toc", &self.toc)?;
        let header = Header {
            file_bytes: self.position + toc.len() as u64,
            toc_offset: self.position,
            toc_bytes: toc.len() as u64,
            toc_checksum: xxh3_64(&toc),
            sections: self.toc.len() as u32,
        };
        let io = |e| Error::io(&path, e);
        self.out.write_all(&toc).map_err(io)?;
        self.out.seek(SeekFrom::Start(0)).map_err(io)?;
        self.out.write_all(&header.encode()).map_err(io)?;
        self.out.flush().map_err(io)?;
        Ok(header.file_bytes)
    }

    fn push_transfer(&mut self, kind: u32, frame: usize, frames: usize, encoded: &EncodedSection) -> Result<()> {
        let end = frame.checked_add(frames).and_then(|end| u32::try_from(end).ok());
        let Some(end) = end.filter(|_| frames > 0) else {
            let found = format!("{frames} frames from {frame}");
            return Err(Error::invalid(&self.path, "transfer.frames", found, "1 or more frames of the pack"));
        };
        self.transfer.insert(self.toc.len(), encoded.shape.clone());
        self.section(kind, encoded.codec, frame as u32..end, &encoded.bytes, encoded.bytes_resident)
    }

    /// The section of the record of transfer, its bytes filled in; fails unless it fits what was pushed.
    fn finish_transfer(&self, record: Option<&TransferRecord>) -> Result<Option<(u32, Vec<u8>)>> {
        let Some(record) = record else {
            sections_of_transfer(&self.path, &self.toc, &[])?;
            return Ok(None);
        };
        record.check(&self.path, &self.frames)?;
        let sections = sections_of_transfer(&self.path, &self.toc, &record.frames)?;
        let mut record = record.clone();
        let bytes = bytes_of_transfer(&self.toc, &sections);
        for (i, section) in sections.iter().enumerate() {
            let what = format!("transfer.frames[{i}].rows");
            let (rows, bases) = (&self.transfer[&section.rows], &self.transfer[&section.bases]);
            record.check_sets(&self.path, &what, rows)?;
            record.frames[i].check_rows(&self.path, &what, rows)?;
            rows.check_rows_by(&self.path, &what, bases)?;
            (record.frames[i].bytes_at_rest, record.frames[i].bytes_resident) = bytes[i];
        }
        Ok(Some((KIND_TRANSFER, encode(&self.path, "transfer", &record)?)))
    }

    fn push_gaussians(&mut self, number: u32, frame: &EncodedFrame) -> Result<()> {
        let resident = u64::from(frame.record.gaussians) * GAUSSIAN_BYTES as u64;
        self.section(KIND_GAUSSIANS, frame.at_rest.gaussians, number..number + 1, &frame.gaussians, resident)
    }

    fn section(
        &mut self,
        kind: u32,
        codec: Codec,
        frames: std::ops::Range<u32>,
        bytes: &[u8],
        resident: u64,
    ) -> Result<()> {
        let section = SectionRecord {
            kind,
            codec: codec as u32,
            first_frame: frames.start,
            frames: frames.end - frames.start,
            offset: self.position,
            bytes_at_rest: bytes.len() as u64,
            bytes_resident: resident,
            checksum: xxh3_64(bytes),
        };
        super::container::codec_of(&self.path, "section", &section)?;
        let end = (self.position + bytes.len() as u64).next_multiple_of(ALIGNMENT);
        let zeros = [0; ALIGNMENT as usize];
        let padding = &zeros[..(end - self.position) as usize - bytes.len()];
        self.out.write_all(bytes).and_then(|()| self.out.write_all(padding)).map_err(|e| Error::io(&self.path, e))?;
        self.position = end;
        self.toc.push(section);
        Ok(())
    }
}
