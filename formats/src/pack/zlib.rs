//! Zlib streams (RFC 1950) of bytes in memory; reading is bounded by the length that is expected.

use crate::{Error, Result};
use flate2::Compression;
use flate2::bufread::{ZlibDecoder, ZlibEncoder};
use std::io::Read;
use std::path::Path;

/// A zlib stream of `bytes`.
pub fn deflate(bytes: &[u8]) -> Vec<u8> {
    let mut packed = vec![];
    let read = ZlibEncoder::new(bytes, Compression::default()).read_to_end(&mut packed);
    assert!(read.is_ok(), "reading from memory cannot fail");
    packed
}

/// The `expected` bytes of a zlib stream that fills all of `packed`. Memory grows with what is really there.
pub fn inflate(path: &Path, what: &str, packed: &[u8], expected: u64) -> Result<Vec<u8>> {
    let mut bytes = vec![];
    let mut stream = ZlibDecoder::new(packed);
    // One byte more than expected, so that a longer stream is noticed.
    let read = stream.by_ref().take(expected.saturating_add(1)).read_to_end(&mut bytes);
    if let Err(e) = read {
        return Err(Error::invalid(path, what, format!("a damaged zlib stream ({e})"), "a whole one"));
    }
    if bytes.len() as u64 != expected {
        return Err(Error::invalid(path, what, format!("{} bytes or more", bytes.len()), format!("{expected} bytes")));
    }
    match packed.len() as u64 - stream.total_in() {
        0 => Ok(bytes),
        extra => Err(Error::invalid(path, what, format!("{extra} bytes after the zlib stream"), "its end")),
    }
}
