//! Header, sections and table of contents: the frame that everything else lies in.
//!
//! ```text
//! header (256) | section | zeros | section | zeros | ... | table of contents | end
//! ```
//!
//! Sections start on multiples of 256 (what GPUs ask of a storage buffer's offset), in the order of the table, with
//! nothing but zeros between. Every byte of the file is vouched for: the header by its own checksum, the table by one
//! in the header, the sections by theirs in the table, and the bytes between by being zero. Checksums are XXH3-64: they
//! find damage, not malice, so everything behind them is bounded as well.

use super::records::{Codec, SectionRecord, decode};
use crate::bounded::Bytes;
use crate::{Error, Result};
use std::path::Path;
use xxhash_rust::xxh3::xxh3_64;

/// First bytes of a pack. The high bit and the line ends betray transfers that are not binary.
pub const MAGIC: [u8; 8] = *b"\x93SMOKE\r\n";
/// Version that is written and read.
pub const VERSION: u32 = 1;
/// Bytes of the header.
pub const HEADER_BYTES: u64 = 256;
/// Sections start on multiples of this.
pub const ALIGNMENT: u64 = 256;
/// Bytes of one entry of the table of contents.
pub const SECTION_RECORD_BYTES: u64 = 48;
/// Bytes of the header that its checksum covers.
const CHECKED_BYTES: usize = 248;

/// A [`super::SequenceRecord`].
pub const KIND_SEQUENCE: u32 = 1;
/// A [`super::SettingsRecord`].
pub const KIND_SETTINGS: u32 = 2;
/// A vector of [`super::FrameRecord`].
pub const KIND_FRAMES: u32 = 3;
/// The Gaussians of one frame: 20 bytes each, in the order of the sum.
pub const KIND_GAUSSIANS: u32 = 4;
/// The residual of one frame, see [`crate::residual::rank`].
pub const KIND_RANK: u32 = 5;
/// The residual of a tile of frames, see [`crate::residual::hash`].
pub const KIND_HASH: u32 = 6;
/// A [`super::TransferRecord`]; only in packs with transfer, as are the kinds after it.
pub const KIND_TRANSFER: u32 = 7;
/// The bases that a run of frames shares, see [`crate::transfer`].
pub const KIND_TRANSFER_BASES: u32 = 8;
/// The rows of one frame.
pub const KIND_TRANSFER_ROWS: u32 = 9;

/// The fixed header.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Bytes of the file.
    pub file_bytes: u64,
    /// Where the table of contents starts.
    pub toc_offset: u64,
    /// Bytes of the table of contents.
    pub toc_bytes: u64,
    /// XXH3-64 of the table of contents.
    pub toc_checksum: u64,
    /// Entries of the table of contents.
    pub sections: u32,
}

impl Header {
    /// The header's bytes.
    pub fn encode(&self) -> [u8; HEADER_BYTES as usize] {
        let mut bytes = [0; HEADER_BYTES as usize];
        bytes[0..8].copy_from_slice(&MAGIC);
        bytes[8..12].copy_from_slice(&VERSION.to_le_bytes());
        bytes[12..16].copy_from_slice(&(HEADER_BYTES as u32).to_le_bytes());
        bytes[16..24].copy_from_slice(&self.file_bytes.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.toc_offset.to_le_bytes());
        bytes[32..40].copy_from_slice(&self.toc_bytes.to_le_bytes());
        bytes[40..48].copy_from_slice(&self.toc_checksum.to_le_bytes());
        bytes[48..52].copy_from_slice(&self.sections.to_le_bytes());
        let checksum = xxh3_64(&bytes[..CHECKED_BYTES]);
        bytes[CHECKED_BYTES..].copy_from_slice(&checksum.to_le_bytes());
        bytes
    }

    /// The header of a file of `file_bytes` bytes: magic, version, lengths and checksum are checked, in this order.
    pub fn decode(path: &Path, bytes: &[u8], file_bytes: u64) -> Result<Self> {
        let mut head = Bytes::new(path, bytes);
        let magic = head.take(8, "header.magic")?;
        if magic != MAGIC {
            return Err(head.invalid("header.magic", format!("{:02x?}", magic), format!("{MAGIC:02x?}")));
        }
        let version = head.u32("header.version")?;
        if version != VERSION {
            let hint = match version > VERSION {
                true => "the pack is newer than this program: take a newer one",
                false => "bake the sequence again",
            };
            return Err(Error::unsupported(path, "header.version", version, hint));
        }
        let header_bytes = head.u32("header.header_bytes")?;
        if u64::from(header_bytes) != HEADER_BYTES {
            return Err(head.invalid("header.header_bytes", header_bytes, HEADER_BYTES));
        }
        let header = Self {
            file_bytes: head.u64("header.file_bytes")?,
            toc_offset: head.u64("header.toc_offset")?,
            toc_bytes: head.u64("header.toc_bytes")?,
            toc_checksum: head.u64("header.toc_checksum")?,
            sections: head.u32("header.sections")?,
        };
        if header.file_bytes != file_bytes {
            return Err(head.invalid("header.file_bytes", header.file_bytes, format!("the {file_bytes} of the file")));
        }
        let aligned = header.toc_offset >= HEADER_BYTES && header.toc_offset.is_multiple_of(ALIGNMENT);
        if !aligned || header.toc_offset.checked_add(header.toc_bytes) != Some(file_bytes) {
            let found = format!("{} from {}", header.toc_bytes, header.toc_offset);
            return Err(head.invalid("header.toc_bytes", found, format!("aligned, to the end at {file_bytes}")));
        }
        if header.toc_bytes != 8 + SECTION_RECORD_BYTES * u64::from(header.sections) {
            return Err(head.invalid(
                "header.sections",
                header.sections,
                format!("as {} bytes hold", header.toc_bytes),
            ));
        }
        let reserved = head.take(CHECKED_BYTES - head.position(), "header.reserved")?;
        let reserved_is_zero = reserved.iter().all(|&b| b == 0);
        let checksum = head.u64("header.checksum")?;
        let expected = xxh3_64(&bytes[..CHECKED_BYTES]);
        if checksum != expected {
            return Err(head.invalid("header.checksum", format!("{checksum:016x}"), format!("{expected:016x}")));
        }
        if !reserved_is_zero {
            return Err(head.invalid("header.reserved", "a byte that is not zero", "zeros"));
        }
        head.finish("header")?;
        Ok(header)
    }
}

/// The name of a kind, used as the start of the path in errors.
pub fn kind_name(kind: u32) -> &'static str {
    match kind {
        KIND_SEQUENCE => "sequence",
        KIND_SETTINGS => "settings",
        KIND_FRAMES => "frames",
        KIND_GAUSSIANS => "gaussians",
        KIND_RANK => "rank",
        KIND_HASH => "hash",
        KIND_TRANSFER => "transfer",
        KIND_TRANSFER_BASES => "bases",
        KIND_TRANSFER_ROWS => "rows",
        _ => "unknown",
    }
}

/// The table of contents: its checksum, then kinds and codecs, then where the sections lie, then their frames.
pub fn decode_toc(path: &Path, header: &Header, bytes: &[u8]) -> Result<Vec<SectionRecord>> {
    let checksum = xxh3_64(bytes);
    if checksum != header.toc_checksum {
        let expected = format!("{:016x}", header.toc_checksum);
        return Err(Error::invalid(path, "toc.checksum", format!("{checksum:016x}"), expected));
    }
    let toc: Vec<SectionRecord> = decode(path, "toc", bytes)?;
    if toc.len() as u64 != u64::from(header.sections) {
        return Err(Error::invalid(path, "toc", format!("{} sections", toc.len()), header.sections));
    }
    for (i, section) in toc.iter().enumerate() {
        codec_of(path, &format!("sections[{i}]"), section)?;
    }
    let mut next = HEADER_BYTES;
    for (i, section) in toc.iter().enumerate() {
        let end = section.offset.checked_add(section.bytes_at_rest).filter(|&e| e <= header.toc_offset);
        if section.offset != next {
            let expected = format!("{next}: aligned, after the section before it");
            return Err(Error::invalid(path, format!("sections[{i}].offset"), section.offset, expected));
        }
        let Some(end) = end else {
            let expected = format!("an end before the table of contents at {}", header.toc_offset);
            return Err(Error::invalid(path, format!("sections[{i}].bytes_at_rest"), section.bytes_at_rest, expected));
        };
        next = end.next_multiple_of(ALIGNMENT);
    }
    if next != header.toc_offset {
        return Err(Error::invalid(path, "header.toc_offset", header.toc_offset, next));
    }
    Ok(toc)
}

/// A section's codec, if its kind is known and may have it.
pub fn codec_of(path: &Path, what: &str, section: &SectionRecord) -> Result<Codec> {
    let allowed: &[Codec] = match section.kind {
        KIND_SEQUENCE | KIND_SETTINGS | KIND_FRAMES | KIND_TRANSFER => &[Codec::Raw],
        KIND_GAUSSIANS => &[Codec::Raw, Codec::Deflate, Codec::Snapped],
        KIND_RANK => &[Codec::Raw, Codec::Coded, Codec::Deflate, Codec::CodedAfter],
        KIND_HASH => &[Codec::Raw, Codec::Coded, Codec::Deflate],
        KIND_TRANSFER_BASES | KIND_TRANSFER_ROWS => &[Codec::Raw, Codec::Deflate],
        _ => return Err(Error::invalid(path, format!("{what}.kind"), section.kind, "1 to 9")),
    };
    allowed.iter().copied().find(|&c| c as u32 == section.codec).ok_or_else(|| {
        let expected = format!("a codec of {}: {allowed:?}", kind_name(section.kind));
        Error::invalid(path, format!("{what}.codec"), section.codec, expected)
    })
}
