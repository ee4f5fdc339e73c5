//! Radiance `.hdr` (RGBE) into R, G, B, through the `image` crate.
//!
//! The non-strict decoder is used because files that start with `#?RGBE` instead of `#?RADIANCE` are common.

use super::{Channel, FloatImage, check_size};
use crate::{Error, Result};
use image::codecs::hdr::HdrDecoder;
use image::{DynamicImage, ImageDecoder};
use std::io::Cursor;
use std::path::Path;

/// Decodes the bytes of a file; `path` is named in errors.
pub(super) fn decode(path: &Path, bytes: &[u8]) -> Result<FloatImage> {
    let damaged = |e: image::ImageError| Error::invalid(path, "Radiance HDR", e, "a readable file");
    let decoder = HdrDecoder::new_nonstrict(Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    check_size(path, width.into(), height.into(), 3)?;
    // However long its runs are, a row starts with four bytes.
    let least = 4 * u64::from(height);
    if least > bytes.len() as u64 {
        let found = format!("{} bytes for {width} x {height} pixels", bytes.len());
        return Err(Error::invalid(path, "Radiance HDR", found, format!("at least {least} bytes")));
    }
    let pixels = DynamicImage::from_decoder(decoder).map_err(damaged)?.into_rgb32f().into_raw();
    let channel = |offset: usize, name: &str| Channel {
        name: name.into(),
        values: pixels.iter().skip(offset).step_by(3).copied().collect(),
    };
    let channels = vec![channel(0, "R"), channel(1, "G"), channel(2, "B")];
    Ok(FloatImage { width: width as usize, height: height as usize, channels })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A flat (not run-length coded) file of `pixels` in one row.
    fn file(signature: &str, width: u32, pixels: &[[u8; 4]]) -> Vec<u8> {
        let mut bytes = format!("#?{signature}\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X {width}\n").into_bytes();
        bytes.extend(pixels.iter().flatten());
        bytes
    }

    #[test]
    fn mantissa_and_exponent_give_the_radiance() {
        // value = mantissa / 256 * 2^(exponent - 128), Ward 1991.
        for signature in ["RADIANCE", "RGBE"] {
            let bytes = file(signature, 3, &[[128, 64, 32, 129], [255, 0, 1, 138], [0, 0, 0, 0]]);
            let image = decode(Path::new("a.hdr"), &bytes).unwrap();
            let rgb = image.rgb(Path::new("a.hdr")).unwrap();
            assert_eq!((rgb.width, rgb.height), (3, 1));
            assert_eq!(rgb.pixels, [[1.0, 0.5, 0.25], [1020.0, 0.0, 4.0], [0.0; 3]]);
        }
    }

    #[test]
    fn every_prefix_and_a_hostile_size_are_refused() {
        let bytes = file("RADIANCE", 2, &[[128, 64, 32, 129]; 2]);
        for length in 2..bytes.len() {
            assert!(decode(Path::new("a.hdr"), &bytes[..length]).is_err(), "prefix of {length}");
        }
        let hostile = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n";
        assert!(decode(Path::new("a.hdr"), hostile).unwrap_err().to_string().contains("image size"));
        let starved = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 10000 +X 10000\n";
        assert!(decode(Path::new("a.hdr"), starved).unwrap_err().to_string().contains("bytes for 10000 x 10000"));
    }

    #[test]
    fn damaged_files_end_in_an_image_or_an_error_never_in_a_panic() {
        // Four rows of 16 pixels, each component as one run of 16 (128 + 16), and one literal row.
        let mut good = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 5 +X 16\n".to_vec();
        for row in 0..4 {
            good.extend([2, 2, 0, 16]);
            (0..4).for_each(|c| good.extend([144, 100 + 10 * c + row]));
        }
        good.extend([2, 2, 0, 16]);
        (0..4).for_each(|c| good.extend([16].into_iter().chain([120 + c; 16])));
        let image = decode(Path::new("a.hdr"), &good).unwrap();
        assert_eq!((image.width, image.height), (16, 5));
        // Mantissa 100 with exponent 130: 100 / 256 * 2^2.
        assert_eq!(image.channel("R").unwrap()[0], 1.5625);
        let mut state = 1u64;
        let mut random = move || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 33) as usize
        };
        for _ in 0..20_000 {
            let mut bad = good.clone();
            for _ in 0..=random() % 3 {
                let at = random() % bad.len();
                bad[at] ^= 1 << (random() % 8);
            }
            // The result does not matter; reaching the next round does.
            let _ = decode(Path::new("a.hdr"), &bad);
        }
    }
}
