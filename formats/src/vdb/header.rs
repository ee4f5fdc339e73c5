//! The head of a file and the metadata maps: magic, version, offsets flag, UUID; then name, type and bytes of each entry.
//!
//! Source: OpenVDB 12, `io/Archive.cc` (`readHeader`) and `MetaMap.cc` (`readMeta`). From version 222 on the head no
//! longer says whether the data are compressed (each grid does), and the three versions read here share one layout.

use crate::bounded::Bytes;
use crate::{Error, Result};

/// The first eight bytes: `0x56444220` as a little-endian i64.
pub(crate) const MAGIC: [u8; 8] = *b" BDV\0\0\0\0";
/// Oldest file version read: the first with a code byte in front of each node's values.
pub(super) const FIRST_VERSION: u32 = 222;
/// Newest file version read, and the one written.
pub(super) const LAST_VERSION: u32 = 224;
/// A name longer than this is damage, not a name.
const LONGEST_NAME: usize = 4096;

/// What the head of a file says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Header {
    /// False for files that were written to a stream: the grids must then be walked to find the next one.
    pub has_grid_offsets: bool,
}

/// Reads the head, up to and including the UUID.
pub(super) fn read(bytes: &mut Bytes) -> Result<Header> {
    let magic = bytes.take(MAGIC.len(), "magic number of an OpenVDB file")?;
    if magic != MAGIC {
        return Err(bytes.invalid("magic number", format!("{magic:02x?}"), format!("{MAGIC:02x?} (OpenVDB)")));
    }
    let version = bytes.u32("file version")?;
    if !(FIRST_VERSION..=LAST_VERSION).contains(&version) {
        let hint = match version < FIRST_VERSION {
            true => "open the file in OpenVDB 3 to 9 (Houdini 14 to 19) and save it again",
            false => "save it with OpenVDB 12 or earlier, whose files have version 224",
        };
        return Err(Error::unsupported(bytes.path(), "file version", version, hint));
    }
    let (_major, _minor) = (bytes.u32("library version")?, bytes.u32("library version")?);
    let has_grid_offsets = bytes.u8("grid offsets flag")? != 0;
    bytes.take(36, "UUID")?;
    Ok(Header { has_grid_offsets })
}

/// A name: u32 length, then as many bytes. Bytes that are not UTF-8 become replacement characters.
pub(super) fn name(bytes: &mut Bytes, what: &str) -> Result<String> {
    Ok(String::from_utf8_lossy(raw_name(bytes, what)?).into_owned())
}

fn raw_name<'a>(bytes: &mut Bytes<'a>, what: &str) -> Result<&'a [u8]> {
    let length = bytes.count(1, what)?;
    if length > LONGEST_NAME {
        return Err(bytes.invalid(what, format!("{length} bytes"), format!("at most {LONGEST_NAME}")));
    }
    bytes.take(length, what)
}

/// One metadata map: name, type and value of each entry as they lie in the file, in its order.
#[derive(Clone, Debug, Default)]
pub(super) struct Metadata<'a> {
    entries: Vec<[&'a [u8]; 3]>,
}

impl<'a> Metadata<'a> {
    /// Reads a map. Entries of unknown types are kept as bytes: each states its length.
    pub fn read(bytes: &mut Bytes<'a>) -> Result<Self> {
        let count = bytes.count(12, "metadata count")?;
        let mut entries = Vec::with_capacity(count);
        for _ in 0..count {
            let (name, kind) = (raw_name(bytes, "metadata name")?, raw_name(bytes, "metadata type")?);
            let length = bytes.count(1, "metadata length")?;
            entries.push([name, kind, bytes.take(length, "metadata value")?]);
        }
        Ok(Self { entries })
    }

    fn value(&self, name: &str, kind: &str) -> Option<&'a [u8]> {
        self.entries.iter().find(|[n, k, _]| *n == name.as_bytes() && *k == kind.as_bytes()).map(|[_, _, value]| *value)
    }

    /// The string entry `name`.
    pub fn string(&self, name: &str) -> Option<String> {
        self.value(name, "string").map(|value| String::from_utf8_lossy(value).into_owned())
    }

    /// The int64 entry `name`.
    pub fn int64(&self, name: &str) -> Option<i64> {
        self.value(name, "int64")?.try_into().ok().map(i64::from_le_bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn head(version: u32) -> Vec<u8> {
        let mut file = MAGIC.to_vec();
        file.extend([version, 9, 1].map(u32::to_le_bytes).concat());
        file.push(0);
        file.extend([b'0'; 36]);
        file
    }

    #[test]
    fn the_three_versions_are_read_and_their_neighbours_refused_with_a_hint() {
        for version in 222..=224 {
            let file = head(version);
            let mut bytes = Bytes::new(Path::new("a.vdb"), &file);
            assert!(!read(&mut bytes).unwrap().has_grid_offsets);
            assert_eq!(bytes.remaining(), 0);
        }
        for (version, hint) in [(221, "save it again"), (225, "OpenVDB 12 or earlier")] {
            let message = read(&mut Bytes::new(Path::new("a.vdb"), &head(version))).unwrap_err().to_string();
            assert!(message.contains(hint) && message.contains(&version.to_string()), "{message}");
        }
    }

    #[test]
    fn another_kind_of_file_is_refused_by_its_first_bytes() {
        let message = read(&mut Bytes::new(Path::new("a.vdb"), b"v/1\x01 not OpenVDB")).unwrap_err().to_string();
        assert!(message.starts_with("a.vdb: magic number: found"), "{message}");
    }

    #[test]
    fn metadata_of_unknown_types_are_stepped_over_by_their_length() {
        let mut map = 2u32.to_le_bytes().to_vec();
        for (name, kind, value) in [("odd", "__delayedload", &[1u8, 2, 3][..]), ("class", "string", b"fog volume")] {
            for text in [name.as_bytes(), kind.as_bytes(), value] {
                map.extend((text.len() as u32).to_le_bytes());
                map.extend(text);
            }
        }
        let metadata = Metadata::read(&mut Bytes::new(Path::new("a"), &map)).unwrap();
        assert_eq!(metadata.string("class").as_deref(), Some("fog volume"));
        assert_eq!(metadata.int64("class"), None);
        assert!(Metadata::read(&mut Bytes::new(Path::new("a"), &map[..map.len() - 1])).is_err());
    }
}
