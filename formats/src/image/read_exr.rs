//! OpenEXR into named f32 channels, through the `exr` crate: flat parts, any of its compressions, half, float and u32.
//!
//! The crate allocates every channel from the header alone, and the chunks from the tile size alone. So the header is
//! parsed first and its sizes are checked against our limits and against the bytes that are there; only then are the
//! pixels decoded. Of a file with several parts the first is read. Pixels of the display window that the data window
//! does not cover are zero, as the OpenEXR documentation has it.

use super::{Channel, FloatImage, check_size};
use crate::{Error, Result};
use exr::block::chunk::CompressedBlock;
use exr::compression::Compression;
use exr::image::read::image::ReadLayers;
use exr::image::read::layers::ReadChannels;
use exr::image::read::read;
use exr::meta::attribute::{AttributeValue, Text};
use exr::meta::header::Header;
use exr::meta::{BlockDescription, MetaData};
use std::io::{BufReader, Cursor, Read};
use std::path::Path;

/// Longest header that is read for an attribute alone. The longest of ours holds a settings text of some kilobytes.
const MAX_HEADER_BYTES: u64 = 1 << 24;

/// Longest side of a tile that is accepted. Common tiles are 16 to 512; a tile's buffer is allocated from this.
const MAX_TILE_SIDE: usize = 1 << 13;

/// Decodes the bytes of a file; `path` is named in errors.
pub(super) fn decode(path: &Path, bytes: &[u8]) -> Result<FloatImage> {
    let damaged = |e| damaged(path, e);
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    for header in &meta.headers {
        check_header(path, header, bytes.len())?;
    }
    check_dwa_counts(path, bytes, &meta.headers)?;
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_buffered(Cursor::new(bytes))
        .map_err(damaged)?;
    let window = image.attributes.display_window;
    let layer = image.layer_data;
    let (width, height) = (window.size.width(), window.size.height());
    check_size(path, width as u64, height as u64, layer.channel_data.list.len() as u64)?;
    let origin = layer.attributes.layer_position;
    // Where the data window starts inside the display window; i64 because the difference of two i32 may not fit i32.
    let start = [(origin.x(), window.position.x()), (origin.y(), window.position.y())]
        .map(|(data, display)| i64::from(data) - i64::from(display));
    let channels = layer.channel_data.list.into_iter().map(|channel| {
        let values: Vec<f32> = channel.sample_data.values_as_f32().collect();
        let data_size = [layer.size.width(), layer.size.height()];
        Channel { name: channel.name.to_string(), values: place(values, data_size, start, [width, height]) }
    });
    Ok(FloatImage { width, height, channels: channels.collect() })
}

/// The text attribute `name` of the first part of a file, from its header alone; none if there is no such text.
pub(super) fn text_attribute(path: &Path, file: impl Read, name: &str) -> Result<Option<String>> {
    // The bound is what a hostile header can make the crate read and hold.
    let header = BufReader::new(file.take(MAX_HEADER_BYTES));
    let meta = MetaData::read_from_buffered(header, false).map_err(|e| damaged(path, e))?;
    let own = meta.headers.first().map(|header| &header.own_attributes.other);
    let shared = meta.headers.first().map(|header| &header.shared_attributes.other);
    let value = [own, shared].into_iter().flatten().find_map(|attributes| attributes.get(&Text::from(name)));
    Ok(value.and_then(|value| match value {
        AttributeValue::Text(text) => Some(text.to_string()),
        _ => None,
    }))
}

fn damaged(path: &Path, error: exr::error::Error) -> Error {
    match error {
        exr::error::Error::NotSupported(what) => {
            Error::unsupported(path, "OpenEXR", what, "save it as a flat image with ZIP, PIZ or DWAA compression")
        }
        other => Error::invalid(path, "OpenEXR", other, "a readable file"),
    }
}

fn check_header(path: &Path, header: &Header, file_bytes: usize) -> Result<()> {
    let invalid = |what: &str, found: String, expected: String| Err(Error::invalid(path, what, found, expected));
    if header.deep {
        let hint = "flatten it first (for instance with oiiotool --flatten)";
        return Err(Error::unsupported(path, "OpenEXR", "deep data", hint));
    }
    let channels = header.channels.list.len() as u64;
    check_size(path, header.layer_size.width() as u64, header.layer_size.height() as u64, channels)?;
    let display = header.shared_attributes.display_window.size;
    check_size(path, display.width() as u64, display.height() as u64, channels)?;
    if let Some(channel) = header.channels.list.iter().find(|c| c.sampling.x() != 1 || c.sampling.y() != 1) {
        let found = format!("channel {} with subsampling", channel.name);
        return Err(Error::unsupported(path, "OpenEXR", found, "save it as R, G, B at full resolution"));
    }
    if let BlockDescription::Tiles(tiles) = header.blocks {
        let (width, height) = (tiles.tile_size.width(), tiles.tile_size.height());
        if !(1..=MAX_TILE_SIDE).contains(&width) || !(1..=MAX_TILE_SIDE).contains(&height) {
            return invalid("tile size", format!("{width} x {height}"), format!("1 to {MAX_TILE_SIDE} a side"));
        }
    }
    // Each chunk has eight bytes in the offset table.
    if header.chunk_count > file_bytes / 8 {
        let found = format!("{} chunks in {file_bytes} bytes", header.chunk_count);
        return invalid("chunk count", found, format!("at most {}", file_bytes / 8));
    }
    Ok(())
}

/// Checks the counters at the head of every DWA chunk, which its decoder allocates from without looking at the sizes.
fn check_dwa_counts(path: &Path, bytes: &[u8], headers: &[Header]) -> Result<()> {
    let damaged = |e| damaged(path, e);
    if !headers.iter().any(|h| matches!(h.compression, Compression::DWAA(_) | Compression::DWAB(_))) {
        return Ok(());
    }
    let reader = exr::block::read(Cursor::new(bytes), false).map_err(damaged)?;
    for chunk in reader.all_chunks(false).map_err(damaged)? {
        let chunk = chunk.map_err(damaged)?;
        let Some(header) = headers.get(chunk.layer_index) else { continue };
        let data = match &chunk.compressed_block {
            CompressedBlock::ScanLine(block) => &block.compressed_pixels_le,
            CompressedBlock::Tile(block) => &block.compressed_pixels_le,
            _ => continue,
        };
        let tile = header.get_block_data_indices(&chunk.compressed_block).map_err(damaged)?;
        let size = header.get_absolute_block_pixel_coordinates(tile).map_err(damaged)?.size;
        let raw = size.area() * header.channels.bytes_per_pixel;
        if data.len() == raw {
            // Stored without compression, and so without counters.
            continue;
        }
        // Sides are padded to 8. No section unpacks to more than the samples, run lengths at worst to twice that.
        let padded = size.width().next_multiple_of(8) * size.height().next_multiple_of(8);
        let most = 2 * (padded * header.channels.bytes_per_pixel) as u64;
        for (at, what) in [(1, "unknown"), (6, "packed runs"), (7, "runs"), (8, "AC"), (9, "DC")] {
            let Some(count) = data.get(8 * at..8 * at + 8).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes)
            else {
                break;
            };
            if count > most {
                let what = format!("DWA chunk, {what} count");
                return Err(Error::invalid(path, what, count, format!("at most {most}")));
            }
        }
    }
    Ok(())
}

/// Copies the data window to its place in the display window; zero outside.
fn place(values: Vec<f32>, data: [usize; 2], start: [i64; 2], display: [usize; 2]) -> Vec<f32> {
    if start == [0, 0] && data == display {
        return values;
    }
    let mut out = vec![0.0; display[0] * display[1]];
    // The span of display pixels that the data covers, along x and y.
    let span: [std::ops::Range<i64>; 2] =
        std::array::from_fn(|a| start[a].max(0)..(start[a] + data[a] as i64).min(display[a] as i64));
    if span[0].is_empty() {
        return out;
    }
    for y in span[1].clone() {
        let from = (y - start[1]) as usize * data[0] + (span[0].start - start[0]) as usize;
        let to = y as usize * display[0] + span[0].start as usize;
        let count = (span[0].end - span[0].start) as usize;
        out[to..to + count].copy_from_slice(&values[from..from + count]);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::write_channels;
    use super::*;
    use exr::prelude::*;

    fn ramp(n: usize) -> Vec<f32> {
        (0..n).map(|i| i as f32).collect()
    }

    fn encoded(compression: Compression, blocks: Blocks) -> Vec<u8> {
        // Multiples of 1/4 below 2048 are exact in half.
        let channel = |name: &str, scale: f32| {
            let values: Vec<f32> = ramp(37 * 21).iter().map(|v| v * scale).collect();
            AnyChannel::new(name, FlatSamples::F32(values))
        };
        let half = (0..37 * 21).map(|i| f16::from_f32(i as f32)).collect();
        let list =
            [channel("R", 1.0), channel("G", 0.5), channel("B", 0.25), AnyChannel::new("A", FlatSamples::F16(half))];
        let channels = AnyChannels::sort(list.into_iter().collect());
        let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
        let layer = Layer::new((37, 21), LayerAttributes::named("beauty"), encoding, channels);
        let mut bytes = Vec::new();
        Image::from_layer(layer).write().to_buffered(Cursor::new(&mut bytes)).unwrap();
        bytes
    }

    #[test]
    fn lossless_compressions_give_back_every_sample_from_scan_lines_and_tiles() {
        use Compression::{PIZ, RLE, Uncompressed, ZIP1, ZIP16};
        for compression in [Uncompressed, RLE, ZIP1, ZIP16, PIZ] {
            for blocks in [Blocks::ScanLines, Blocks::Tiles(Vec2(16, 8))] {
                let image = decode(Path::new("a.exr"), &encoded(compression, blocks)).unwrap();
                assert_eq!((image.width, image.height), (37, 21));
                let rgb = image.rgb(Path::new("a.exr")).unwrap();
                for (i, pixel) in rgb.pixels.iter().enumerate() {
                    let v = i as f32;
                    assert_eq!(*pixel, [v, v * 0.5, v * 0.25], "{compression:?}");
                }
                assert_eq!(image.channel("A").unwrap(), ramp(37 * 21));
            }
        }
    }

    #[test]
    fn a_data_window_lands_at_its_place_in_the_display_window() {
        // 2 x 2 data at (-1, 1) of a 3 x 3 display: only its right column is seen.
        let out = place(vec![1.0, 2.0, 3.0, 4.0], [2, 2], [-1, 1], [3, 3]);
        assert_eq!(out, [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 4.0, 0.0, 0.0]);
        assert_eq!(place(vec![1.0], [1, 1], [5, 0], [2, 1]), [0.0, 0.0]);
        assert_eq!(place(vec![1.0], [1, 1], [0, -9], [2, 1]), [0.0, 0.0]);
    }

    /// A header of `width` x `height` with one float channel, and nothing after it.
    fn bare_header(width: i32, height: i32, tile: Option<u32>) -> Vec<u8> {
        let mut b = vec![0x76, 0x2f, 0x31, 0x01, 2, if tile.is_some() { 2 } else { 0 }, 0, 0];
        let mut attribute = |name: &str, kind: &str, value: Vec<u8>| {
            b.extend(name.bytes().chain([0]).chain(kind.bytes()).chain([0]));
            b.extend((value.len() as u32).to_le_bytes());
            b.extend(value);
        };
        let words = |w: &[i32]| w.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let channel = [b"Y\0".to_vec(), words(&[2, 0, 1, 1]), vec![0]].concat();
        attribute("channels", "chlist", channel);
        attribute("compression", "compression", vec![0]);
        attribute("dataWindow", "box2i", words(&[0, 0, width - 1, height - 1]));
        attribute("displayWindow", "box2i", words(&[0, 0, width - 1, height - 1]));
        attribute("lineOrder", "lineOrder", vec![0]);
        attribute("pixelAspectRatio", "float", 1f32.to_le_bytes().to_vec());
        attribute("screenWindowCenter", "v2f", vec![0; 8]);
        attribute("screenWindowWidth", "float", 1f32.to_le_bytes().to_vec());
        if let Some(side) = tile {
            attribute(
                "tiles",
                "tiledesc",
                [side.to_le_bytes().to_vec(), side.to_le_bytes().to_vec(), vec![0]].concat(),
            );
        }
        b.push(0);
        b
    }

    #[test]
    fn hostile_sizes_are_refused_before_anything_is_allocated() {
        let message = |bytes: Vec<u8>| decode(Path::new("a.exr"), &bytes).unwrap_err().to_string();
        assert!(message(bare_header(1 << 20, 1 << 20, None)).contains("image size"));
        assert!(message(bare_header(1 << 14, 1 << 14, None)).contains("chunk count"));
        assert!(message(bare_header(1 << 13, 1 << 13, Some(1 << 20))).contains("tile size"));
        assert!(message(bare_header(64, 64, Some(0))).contains("tile"));
    }

    #[test]
    fn every_prefix_is_refused() {
        let bytes = encoded(Compression::ZIP16, Blocks::ScanLines);
        for length in 4..bytes.len() {
            assert!(decode(Path::new("a.exr"), &bytes[..length]).is_err(), "prefix of {length} bytes");
        }
    }

    #[test]
    fn damaged_files_end_in_an_image_or_an_error_never_in_a_panic() {
        let mut state = 1u64;
        let mut random = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as usize
        };
        use Compression::{B44, DWAA, PIZ, PXR24, RLE, Uncompressed, ZIP16};
        for compression in [Uncompressed, RLE, ZIP16, PIZ, PXR24, B44, DWAA(None)] {
            for blocks in [Blocks::ScanLines, Blocks::Tiles(Vec2(16, 8))] {
                let good = encoded(compression, blocks);
                for _ in 0..300 {
                    let mut bad = good.clone();
                    for _ in 0..=random() % 3 {
                        let at = random() % bad.len();
                        bad[at] ^= 1 << (random() % 8);
                    }
                    // The result does not matter; reaching the next round does.
                    let _ = decode(Path::new("a.exr"), &bad);
                }
            }
        }
    }

    #[test]
    fn written_channels_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let channel = |name: &str| Channel { name: name.into(), values: ramp(6) };
        let image = FloatImage { width: 3, height: 2, channels: vec![channel("A"), channel("Z")] };
        write_channels(&path, &image).unwrap();
        assert_eq!(super::super::read(&path).unwrap(), image);
    }
}
