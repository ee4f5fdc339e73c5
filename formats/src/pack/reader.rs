//! One frame out of a pack, without reading the others.
//!
//! Opening reads header, table of contents and the records, and checks that every frame has its sections. A frame
//! costs one read of its Gaussians and one of its residual; a tile of frames is read whole and kept until another
//! section is asked for. Every section's checksum is verified each time it is read.
//!
//! Files are read at positions rather than mapped: a map needs unsafe code, and a file that another process cuts short
//! would end the program instead of giving an error. The one copy is small beside the checksum and the checks.

use super::at_rest::{decode_gaussians, decode_hash, decode_rank};
use super::container::{
    HEADER_BYTES, Header, KIND_FRAMES, KIND_GAUSSIANS, KIND_HASH, KIND_RANK, KIND_SEQUENCE, KIND_SETTINGS,
    KIND_TRANSFER, codec_of, decode_toc, kind_name,
};
use super::records::{
    Codec, FrameRecord, MAX_RECORD_BYTES, ResidualKind, SectionRecord, SequenceRecord, SettingsRecord, decode,
};
use super::transfer_reader::PackTransfer;
use super::transfer_record::TransferRecord;
use super::transfer_sections::sections_of_transfer;
use crate::gaussian::Gaussian;
use crate::residual::{Residual, ResidualCodes};
use crate::{Error, Result};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use xxhash_rust::xxh3::xxh3_64;

#[derive(Debug)]
enum Source {
    File(Mutex<File>),
    Memory(Vec<u8>),
}

/// A pack that was opened and whose records are good.
#[derive(Debug)]
pub struct Pack {
    path: PathBuf,
    source: Source,
    header: Header,
    toc: Vec<SectionRecord>,
    sequence: SequenceRecord,
    settings: SettingsRecord,
    frames: Vec<FrameRecord>,
    /// For each frame its section of Gaussians and its section of residual.
    sections: Vec<(usize, usize)>,
    /// The residual section read last: neighbouring frames share a tile.
    last: Mutex<Option<(usize, Arc<Residual>)>>,
    pub(super) transfer: Option<PackTransfer>,
}

/// The residual of one frame, in its resident layout.
#[derive(Clone, Debug)]
pub struct FrameResidual {
    /// The layout, which may hold other frames as well.
    pub residual: Arc<Residual>,
    /// Which of its frames this is.
    pub frame: usize,
}

impl FrameResidual {
    /// The code of a voxel by its place in the frame's box; none outside the support or the box.
    #[inline]
    pub fn code(&self, voxel: [u32; 3]) -> Option<i32> {
        self.residual.code(self.frame, voxel)
    }

    /// All codes of the frame.
    pub fn codes(&self) -> Result<ResidualCodes> {
        self.residual.codes(self.frame)
    }
}

impl Pack {
    /// Opens a pack; an error names the first thing wrong with header, table of contents or records.
    pub fn open(path: &Path) -> Result<Self> {
        let io = |e| Error::io(path, e);
        let mut file = File::open(path).map_err(io)?;
        let bytes = file.seek(SeekFrom::End(0)).map_err(io)?;
        Self::of(path, Source::File(Mutex::new(file)), bytes)
    }

    /// A pack that is already in memory; `path` is named in errors.
    pub fn from_bytes(path: &Path, bytes: Vec<u8>) -> Result<Self> {
        let length = bytes.len() as u64;
        Self::of(path, Source::Memory(bytes), length)
    }

    fn of(path: &Path, source: Source, file_bytes: u64) -> Result<Self> {
        let read = |offset, length, what: &str| read_at(path, &source, file_bytes, offset, length, what);
        let head = read(0, HEADER_BYTES.min(file_bytes), "header")?;
        let header = Header::decode(path, &head, file_bytes)?;
        let most = MAX_RECORD_BYTES as u64;
        let small = |length: u64, what: &str| match length <= most {
            true => Ok(()),
            false => Err(Error::invalid(path, what, length, format!("at most {most}"))),
        };
        small(header.toc_bytes, "header.toc_bytes")?;
        let toc = decode_toc(path, &header, &read(header.toc_offset, header.toc_bytes, "toc")?)?;
        let count = |kind: u32| toc.iter().filter(|s| s.kind == kind).count();
        let record = |kind: u32| -> Result<Vec<u8>> {
            let what = kind_name(kind);
            let mut found = toc.iter().filter(|s| s.kind == kind);
            let (Some(section), None) = (found.next(), found.next()) else {
                return Err(Error::invalid(path, format!("sections: {what}"), count(kind), "1"));
            };
            if (section.first_frame, section.frames, section.bytes_resident) != (0, 0, section.bytes_at_rest) {
                let found = format!("{section:?}");
                return Err(Error::invalid(path, what, found, "no frames, resident as it is at rest"));
            }
            small(section.bytes_at_rest, what)?;
            let bytes = read(section.offset, section.bytes_at_rest, what)?;
            checked(path, what, section, &bytes)?;
            Ok(bytes)
        };
        let sequence: SequenceRecord = decode(path, "sequence", &record(KIND_SEQUENCE)?)?;
        sequence.check(path)?;
        let settings: SettingsRecord = decode(path, "settings", &record(KIND_SETTINGS)?)?;
        settings.check(path)?;
        let frames: Vec<FrameRecord> = decode(path, "frames", &record(KIND_FRAMES)?)?;
        for (number, frame) in frames.iter().enumerate() {
            frame.check(path, number, &sequence)?;
        }
        let sections = sections_of_frames(path, &toc, &frames)?;
        check_chains(path, &toc, &sections)?;
        let transfer = match count(KIND_TRANSFER) {
            // Without a record there are no sections either.
            0 => sections_of_transfer(path, &toc, &[]).map(|_| None)?,
            _ => {
                let record: TransferRecord = decode(path, "transfer", &record(KIND_TRANSFER)?)?;
                Some(PackTransfer::new(path, &toc, &frames, record)?)
            }
        };
        let last = Mutex::new(None);
        Ok(Self { path: path.to_owned(), source, header, toc, sequence, settings, frames, sections, last, transfer })
    }

    /// The file's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes of the file.
    pub fn file_bytes(&self) -> u64 {
        self.header.file_bytes
    }

    /// XXH3-64 of the table of contents, which holds the checksums of all sections: it tells packs apart.
    pub fn checksum(&self) -> u64 {
        self.header.toc_checksum
    }

    /// The table of contents.
    pub fn sections(&self) -> &[SectionRecord] {
        &self.toc
    }

    /// What holds for the whole sequence.
    pub fn sequence(&self) -> &SequenceRecord {
        &self.sequence
    }

    /// The settings that made the pack.
    pub fn settings(&self) -> &SettingsRecord {
        &self.settings
    }

    /// What holds for each frame, in the order of the sequence.
    pub fn frames(&self) -> &[FrameRecord] {
        &self.frames
    }

    /// The Gaussians of frame `frame < frames().len()` (counted from 0), in the order of the sum.
    pub fn gaussians(&self, frame: usize) -> Result<Vec<Gaussian>> {
        let what = format!("frames[{frame}]");
        let section = &self.toc[self.section(frame)?.0];
        let bytes = self.section_bytes(&what, section)?;
        let codec = codec_of(&self.path, &what, section)?;
        let list = decode_gaussians(&self.path, &what, &bytes, codec, section.bytes_resident)?;
        let expected = u64::from(self.frames[frame].gaussians);
        if list.len() as u64 != expected {
            return Err(Error::invalid(&self.path, format!("{what}.gaussians"), list.len(), expected));
        }
        Ok(list)
    }

    /// The residual of frame `frame < frames().len()` (counted from 0), resident.
    pub fn residual(&self, frame: usize) -> Result<FrameResidual> {
        let number = self.section(frame)?.1;
        let section = &self.toc[number];
        let kept = self.last.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let residual = match kept {
            Some((of, residual)) if of == number => residual,
            _ => {
                let what = format!("frames[{frame}]");
                let codec = codec_of(&self.path, &what, section)?;
                let bytes = self.section_bytes(&what, section)?;
                let residual = Arc::new(match section.kind {
                    KIND_HASH => decode_hash(&self.path, bytes, codec, section.bytes_resident)?,
                    _ => {
                        // At most [`MAX_CHAIN`] deep, which was checked on opening.
                        let previous = match codec {
                            Codec::CodedAfter => Some(self.residual(frame - 1)?.codes()?),
                            _ => None,
                        };
                        decode_rank(&self.path, bytes, codec, section.bytes_resident, previous.as_ref())?
                    }
                });
                *self.last.lock().unwrap_or_else(PoisonError::into_inner) = Some((number, residual.clone()));
                residual
            }
        };
        let local = frame - section.first_frame as usize;
        let record = &self.frames[frame];
        let in_section = residual.frames() == section.frames as usize;
        if !in_section || residual.frame_box(local) != (record.origin, record.dims) {
            let expected = format!("{:?} from {:?}, as in the frame's record", record.dims, record.origin);
            return Err(Error::invalid(&self.path, format!("frames[{frame}].residual.box"), "another box", expected));
        }
        let active = residual.active_voxels(local);
        if active != record.active_voxels {
            let what = format!("frames[{frame}].active_voxels");
            return Err(Error::invalid(&self.path, what, record.active_voxels, active));
        }
        Ok(FrameResidual { residual, frame: local })
    }

    /// What holds for the precomputed transfer, if the pack has any.
    pub fn transfer(&self) -> Option<&TransferRecord> {
        self.transfer.as_ref().map(PackTransfer::record)
    }

    fn section(&self, frame: usize) -> Result<(usize, usize)> {
        self.sections.get(frame).copied().ok_or_else(|| {
            let expected = format!("below {}", self.sections.len());
            Error::invalid(&self.path, "frame", frame, expected)
        })
    }

    /// The bytes of a section at rest, whose checksum is right.
    pub(super) fn section_bytes(&self, what: &str, section: &SectionRecord) -> Result<Vec<u8>> {
        let bytes = self.bytes_at(section.offset, section.bytes_at_rest, what)?;
        checked(&self.path, what, section, &bytes)?;
        Ok(bytes)
    }

    /// Any bytes of the file.
    pub(super) fn bytes_at(&self, offset: u64, length: u64, what: &str) -> Result<Vec<u8>> {
        read_at(&self.path, &self.source, self.header.file_bytes, offset, length, what)
    }

    /// Where the table of contents starts.
    pub(super) fn toc_offset(&self) -> u64 {
        self.header.toc_offset
    }
}

fn checked(path: &Path, what: &str, section: &SectionRecord, bytes: &[u8]) -> Result<()> {
    let checksum = xxh3_64(bytes);
    match checksum == section.checksum {
        true => Ok(()),
        false => {
            let what = format!("{what}.{}.checksum", kind_name(section.kind));
            Err(Error::invalid(path, what, format!("{checksum:016x}"), format!("{:016x}", section.checksum)))
        }
    }
}

fn read_at(path: &Path, source: &Source, file_bytes: u64, offset: u64, length: u64, what: &str) -> Result<Vec<u8>> {
    let inside = offset.checked_add(length).is_some_and(|end| end <= file_bytes);
    let (Some(start), Some(count), true) = (usize::try_from(offset).ok(), usize::try_from(length).ok(), inside) else {
        let expected = format!("inside the {file_bytes} of the file");
        return Err(Error::invalid(path, what, format!("{length} bytes from {offset}"), expected));
    };
    match source {
        Source::Memory(bytes) => Ok(bytes[start..start + count].to_vec()),
        Source::File(file) => {
            let io = |e| Error::io(path, e);
            let mut bytes = vec![0; count];
            let mut file = file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(offset)).map_err(io)?;
            file.read_exact(&mut bytes).map_err(io)?;
            Ok(bytes)
        }
    }
}

/// Frames that one frame may need before it: a hostile chain must not cost more than a short one.
const MAX_CHAIN: usize = 63;

/// Fails on a first frame that is coded after another, and on too many of them in a row.
fn check_chains(path: &Path, toc: &[SectionRecord], sections: &[(usize, usize)]) -> Result<()> {
    let mut chain = MAX_CHAIN;
    for (frame, &(_, residual)) in sections.iter().enumerate() {
        let after = toc[residual].codec == Codec::CodedAfter as u32;
        chain = if after { chain + 1 } else { 0 };
        if chain > MAX_CHAIN {
            let expected = format!("a frame before, and at most {MAX_CHAIN} of them in a row");
            return Err(Error::invalid(path, format!("frames[{frame}].residual.codec"), "coded after", expected));
        }
    }
    Ok(())
}

/// Finds every frame's two sections: each exactly once, of the kind that its record says.
fn sections_of_frames(path: &Path, toc: &[SectionRecord], frames: &[FrameRecord]) -> Result<Vec<(usize, usize)>> {
    let mut found = vec![(None, None); frames.len()];
    for (i, section) in toc.iter().enumerate() {
        let is_gaussians = section.kind == KIND_GAUSSIANS;
        if !is_gaussians && section.kind != KIND_RANK && section.kind != KIND_HASH {
            continue;
        }
        let first = section.first_frame as usize;
        let count = section.frames as usize;
        let most = if section.kind == KIND_HASH { crate::residual::hash::MAX_FRAMES } else { 1 };
        if !((1..=most).contains(&count) && first + count <= frames.len()) {
            let expected = format!("1 to {most} of {} frames", frames.len());
            let what = format!("sections[{i}].frames");
            return Err(Error::invalid(path, what, format!("{count} from {first}"), expected));
        }
        for frame in first..first + count {
            let place = if is_gaussians { &mut found[frame].0 } else { &mut found[frame].1 };
            if place.replace(i).is_some() {
                let what = format!("frames[{frame}].{}", kind_name(section.kind));
                return Err(Error::invalid(path, what, "two sections", "one"));
            }
            let hash = frames[frame].residual == ResidualKind::Hash;
            if !is_gaussians && hash != (section.kind == KIND_HASH) {
                let what = format!("frames[{frame}].residual");
                return Err(Error::invalid(
                    path,
                    what,
                    format!("{:?}", frames[frame].residual),
                    kind_name(section.kind),
                ));
            }
        }
    }
    let both = |(i, (g, r)): (usize, (Option<usize>, Option<usize>))| match (g, r) {
        (Some(g), Some(r)) => Ok((g, r)),
        _ => Err(Error::invalid(path, format!("frames[{i}]"), "a section missing", "Gaussians and residual")),
    };
    found.into_iter().enumerate().map(both).collect()
}
