//! Reading little-endian fields from bytes that nobody vouches for.
//!
//! A [`Bytes`] never reads past its end and never allocates from an unchecked count: a count is compared with the
//! bytes that are left (and with a cap of the caller's) before a vector is made.

use crate::{Error, Result};
use std::path::Path;

/// Largest number of voxels of a dense box that any reader makes: 2^28 values are 1 GiB of f32.
pub const MAX_DENSE_VOXELS: u64 = 1 << 28;

/// A cursor over the bytes of one file or section. Fields are little-endian.
#[derive(Clone, Debug)]
pub struct Bytes<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    position: usize,
}

impl<'a> Bytes<'a> {
    /// A cursor at the start of `bytes`; `path` is named in errors.
    pub fn new(path: &'a Path, bytes: &'a [u8]) -> Self {
        Self { path, bytes, position: 0 }
    }

    /// The file that errors name.
    pub fn path(&self) -> &'a Path {
        self.path
    }

    /// Bytes read so far.
    pub fn position(&self) -> usize {
        self.position
    }

    /// Bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len() - self.position
    }

    /// Moves to an absolute position, which must lie inside the bytes.
    pub fn seek(&mut self, position: u64, what: &str) -> Result<()> {
        match usize::try_from(position).ok().filter(|&p| p <= self.bytes.len()) {
            Some(p) => {
                self.position = p;
                Ok(())
            }
            None => Err(self.invalid(what, format!("offset {position}"), format!("at most {}", self.bytes.len()))),
        }
    }

    /// The next `count` bytes.
    pub fn take(&mut self, count: usize, what: &str) -> Result<&'a [u8]> {
        if count > self.remaining() {
            return Err(self.invalid(what, format!("{} bytes left", self.remaining()), format!("{count} bytes")));
        }
        let slice = &self.bytes[self.position..self.position + count];
        self.position += count;
        Ok(slice)
    }

    fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N, what)?);
        Ok(out)
    }

    /// One byte.
    pub fn u8(&mut self, what: &str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    /// A u16.
    pub fn u16(&mut self, what: &str) -> Result<u16> {
        Ok(u16::from_le_bytes(self.array(what)?))
    }

    /// A u32.
    pub fn u32(&mut self, what: &str) -> Result<u32> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    /// An i32.
    pub fn i32(&mut self, what: &str) -> Result<i32> {
        Ok(i32::from_le_bytes(self.array(what)?))
    }

    /// A u64.
    pub fn u64(&mut self, what: &str) -> Result<u64> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    /// An i64.
    pub fn i64(&mut self, what: &str) -> Result<i64> {
        Ok(i64::from_le_bytes(self.array(what)?))
    }

    /// An f32, finite or not.
    pub fn f32(&mut self, what: &str) -> Result<f32> {
        Ok(f32::from_le_bytes(self.array(what)?))
    }

    /// An f64, finite or not.
    pub fn f64(&mut self, what: &str) -> Result<f64> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// A count of items that take at least `item_bytes` each, checked against the bytes that are left.
    pub fn count(&mut self, item_bytes: usize, what: &str) -> Result<usize> {
        let count = self.u32(what)? as usize;
        if count.saturating_mul(item_bytes.max(1)) > self.remaining() {
            let most = self.remaining() / item_bytes.max(1);
            return Err(self.invalid(what, count, format!("at most {most} in the bytes that are left")));
        }
        Ok(count)
    }

    /// An [`Error::Invalid`] that names this file.
    pub fn invalid(&self, what: &str, found: impl ToString, expected: impl ToString) -> Error {
        Error::invalid(self.path, what, found, expected)
    }

    /// Fails unless every byte was read.
    pub fn finish(&self, what: &str) -> Result<()> {
        match self.remaining() {
            0 => Ok(()),
            extra => Err(self.invalid(what, format!("{extra} bytes too many"), "the end")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reading_past_the_end_names_the_field_and_the_bytes_left() {
        let mut bytes = Bytes::new(Path::new("a.vdb"), &[1, 2, 3]);
        let message = bytes.u32("magic").unwrap_err().to_string();
        assert_eq!(message, "a.vdb: magic: found 3 bytes left, expected 4 bytes");
    }

    #[test]
    fn a_count_larger_than_the_bytes_left_is_refused_before_anything_is_allocated() {
        let mut bytes = Bytes::new(Path::new("a"), &[255, 255, 255, 255, 0, 0, 0, 0]);
        assert!(bytes.count(4, "items").is_err());
        let mut bytes = Bytes::new(Path::new("a"), &[1, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(bytes.count(4, "items").unwrap(), 1);
    }
}
