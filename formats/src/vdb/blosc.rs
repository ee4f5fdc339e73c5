//! Blosc-1 chunks as OpenVDB writes them: LZ4 inside, bytes shuffled by element size.
//!
//! A chunk is a head of 16 bytes (format version, codec version, flags, element size, then u32 lengths: decoded, block,
//! encoded), one u32 start per block, then the blocks. A block of enough elements is cut into one stream per byte of an
//! element; each stream is an i32 length and LZ4 data, or the plain bytes where that was no longer. Unshuffling puts
//! byte `j` of element `i` from `j * elements + i` back to `i * size + j`; bytes past the last whole element stay.
//! Cost: one LZ4 pass and one transposition, below 2 ns a byte.
//!
//! Source: Blosc 1.21, `README_CHUNK_FORMAT.rst` and the split rule of `blosc_d`. OpenVDB only ever writes LZ4 with
//! byte shuffle and one block a chunk; other codecs are refused by name.

use crate::bounded::Bytes;
use crate::{Error, Result};

const SHUFFLED: u8 = 0x01;
const STORED: u8 = 0x02;
const BIT_SHUFFLED: u8 = 0x04;
const NOT_SPLIT: u8 = 0x10;
const CODECS: [&str; 8] = ["BloscLZ", "LZ4", "Snappy", "Zlib", "Zstd", "codec 5", "codec 6", "codec 7"];
/// Elements of more bytes than this are never split into streams.
const MOST_STREAMS: usize = 16;
/// Blocks of fewer elements than this are never split into streams.
const FEWEST_SPLIT: usize = 128;

/// Decodes one whole chunk into `out`, whose length must be the decoded length; `scratch` is reused between calls.
pub(super) fn decode(chunk: &mut Bytes, out: &mut [u8], scratch: &mut Vec<u8>) -> Result<()> {
    let whole = chunk.clone();
    let chunk_length = chunk.remaining();
    let version = chunk.u8("Blosc format version")?;
    if version != 2 {
        return Err(chunk.invalid("Blosc format version", version, 2));
    }
    chunk.u8("Blosc codec version")?;
    let flags = chunk.u8("Blosc flags")?;
    let element = usize::from(chunk.u8("Blosc element size")?);
    let decoded = chunk.u32("Blosc decoded length")? as usize;
    let block = chunk.u32("Blosc block length")? as usize;
    let encoded = chunk.u32("Blosc encoded length")? as usize;
    if decoded != out.len() {
        return Err(chunk.invalid("Blosc decoded length", decoded, out.len()));
    }
    if encoded != chunk_length {
        return Err(chunk.invalid("Blosc encoded length", encoded, chunk_length));
    }
    if flags & STORED != 0 || decoded == 0 {
        out.copy_from_slice(chunk.take(decoded, "stored Blosc bytes")?);
        return Ok(());
    }
    if flags >> 5 != 1 || flags & BIT_SHUFFLED != 0 {
        let found = if flags >> 5 != 1 { CODECS[usize::from(flags >> 5)] } else { "bit shuffle" };
        let hint = "OpenVDB writes LZ4 with byte shuffle; save the file again with OpenVDB";
        return Err(Error::unsupported(chunk.path(), "Blosc codec", found, hint));
    }
    if element == 0 || block == 0 {
        return Err(chunk.invalid("Blosc element size and block length", format!("{element} and {block}"), "above 0"));
    }
    let shuffled = flags & SHUFFLED != 0 && element > 1;
    for to in out.chunks_mut(block) {
        let start = chunk.u32("Blosc block start")?;
        let mut block_bytes = whole.clone();
        block_bytes.take(start as usize, "Blosc block start")?;
        let split = flags & NOT_SPLIT == 0 && element <= MOST_STREAMS && block / element >= FEWEST_SPLIT;
        // Only whole blocks are split; a last, shorter one is a single stream.
        let streams = if split && to.len() == block { element } else { 1 };
        if shuffled {
            scratch.resize(to.len(), 0);
            decode_streams(&mut block_bytes, scratch, streams)?;
            unshuffle(scratch, to, element);
        } else {
            decode_streams(&mut block_bytes, to, streams)?;
        }
    }
    Ok(())
}

fn decode_streams(bytes: &mut Bytes, out: &mut [u8], streams: usize) -> Result<()> {
    if !out.len().is_multiple_of(streams) {
        return Err(bytes.invalid("Blosc block length", out.len(), format!("a multiple of {streams}")));
    }
    for to in out.chunks_mut(out.len() / streams) {
        let length = bytes.count(1, "Blosc stream length")?;
        let stream = bytes.take(length, "Blosc stream")?;
        if length == to.len() {
            to.copy_from_slice(stream);
            continue;
        }
        let expected = format!("{} bytes of LZ4", to.len());
        match lz4_flex::block::decompress_into(stream, to) {
            Ok(n) if n == to.len() => {}
            Ok(n) => return Err(bytes.invalid("Blosc stream", format!("{n} bytes"), expected)),
            Err(e) => return Err(bytes.invalid("Blosc stream", e, expected)),
        }
    }
    Ok(())
}

fn unshuffle(from: &[u8], to: &mut [u8], element: usize) {
    let count = from.len() / element;
    let whole = count * element;
    if element == 4 {
        // The only size OpenVDB uses; four streams read side by side vectorise.
        let (planes, tail) = from.split_at(whole);
        let (a, rest) = planes.split_at(count);
        let (b, rest) = rest.split_at(count);
        let (c, d) = rest.split_at(count);
        for ((((to, a), b), c), d) in to.chunks_exact_mut(4).zip(a).zip(b).zip(c).zip(d) {
            to.copy_from_slice(&[*a, *b, *c, *d]);
        }
        to[whole..].copy_from_slice(tail);
        return;
    }
    for (i, to) in to[..whole].chunks_exact_mut(element).enumerate() {
        for (j, to) in to.iter_mut().enumerate() {
            *to = from[j * count + i];
        }
    }
    to[whole..].copy_from_slice(&from[whole..]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn shuffle(bytes: &[u8], element: usize) -> Vec<u8> {
        let count = bytes.len() / element;
        let planes = (0..element).flat_map(|j| (0..count).map(move |i| bytes[i * element + j]));
        planes.chain(bytes[count * element..].iter().copied()).collect()
    }

    /// A chunk as Blosc lays it out, from its own description of the format.
    fn chunk(data: &[u8], block: usize, element: usize, shuffled: bool, plain_streams: bool) -> Vec<u8> {
        let blocks: Vec<Vec<u8>> = data
            .chunks(block)
            .map(|bytes| {
                let bytes = if shuffled { shuffle(bytes, element) } else { bytes.to_vec() };
                let split = bytes.len() == block && block / element >= 128 && element <= 16;
                let stream = bytes.len() / if split { element } else { 1 };
                // A stream that LZ4 does not make shorter is stored plain: its length is how a reader can tell.
                let packed =
                    |s: &[u8]| Some(lz4_flex::block::compress(s)).filter(|p| !plain_streams && p.len() < s.len());
                let encode = |s: &[u8]| packed(s).unwrap_or_else(|| s.to_vec());
                let cut = bytes.chunks(stream).map(encode);
                cut.flat_map(|s| [(s.len() as u32).to_le_bytes().to_vec(), s].concat()).collect()
            })
            .collect();
        let mut out = vec![2, 1, 0x20 | u8::from(shuffled), element as u8];
        let length = 16 + 4 * blocks.len() + blocks.iter().map(Vec::len).sum::<usize>();
        out.extend([data.len(), block, length].map(|n| (n as u32).to_le_bytes()).concat());
        let mut start = 16 + 4 * blocks.len();
        for b in &blocks {
            out.extend((start as u32).to_le_bytes());
            start += b.len();
        }
        out.extend(blocks.concat());
        out
    }

    fn decoded(chunk: &[u8], length: usize) -> Result<Vec<u8>> {
        let mut out = vec![0; length];
        decode(&mut Bytes::new(Path::new("a.vdb"), chunk), &mut out, &mut Vec::new())?;
        Ok(out)
    }

    #[test]
    fn every_layout_comes_back_as_it_was() {
        let data: Vec<u8> = (0..2051u32).map(|i| (i / 7 * i % 251) as u8).collect();
        for element in [1, 2, 4, 8, 17] {
            for block in [2051, 1024, 640] {
                for (shuffled, plain) in [(true, true), (true, false), (false, false)] {
                    // Only a block that divides by the element size can be cut into streams.
                    if block % element != 0 && block / element >= 128 && element <= 16 {
                        continue;
                    }
                    let chunk = chunk(&data, block, element, shuffled, plain);
                    assert!(decoded(&chunk, data.len()).unwrap() == data, "element {element} block {block}");
                }
            }
        }
    }

    #[test]
    fn a_stored_chunk_and_an_empty_chunk_are_plain_bytes() {
        let stored = [&[2, 1, 0x23, 4][..], &[3, 0, 0, 0, 3, 0, 0, 0, 19, 0, 0, 0], &[7, 8, 9]].concat();
        assert_eq!(decoded(&stored, 3).unwrap(), [7, 8, 9]);
        let empty = [&[2, 1, 0x23, 4][..], &[0, 0, 0, 0, 1, 0, 0, 0, 16, 0, 0, 0]].concat();
        assert!(decoded(&empty, 0).unwrap().is_empty());
    }

    #[test]
    fn every_prefix_and_every_other_codec_is_refused_by_name() {
        let data = [5u8; 1024];
        let good = chunk(&data, 1024, 4, true, false);
        for end in 0..good.len() {
            assert!(decoded(&good[..end], 1024).is_err(), "prefix {end}");
        }
        let mut zstd = good.clone();
        zstd[2] = 0x81;
        assert!(decoded(&zstd, 1024).unwrap_err().to_string().contains("Zstd"));
        let mut bits = good;
        bits[2] |= BIT_SHUFFLED;
        assert!(decoded(&bits, 1024).unwrap_err().to_string().contains("bit shuffle"));
    }
}
