//! 8-bit sRGB previews to PNG.
//!
//! The curve is that of IEC 61966-2-1: `12.92 x` below 0.0031308, else `1.055 x^(1/2.4) - 0.055`; values are clamped to
//! [0, 1] and rounded to the nearest of 255 steps. A NaN would become a plausible black, so it is an error.

use super::{RgbImage, check_size};
use crate::{Error, Result, atomic};
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use std::path::Path;

/// Writes linear Rec.709 `image` as 8-bit sRGB; it appears whole or not at all.
pub fn write_png(path: &Path, image: &RgbImage) -> Result<()> {
    check_size(path, image.width as u64, image.height as u64, 3)?;
    if image.pixels.len() != image.width * image.height {
        return Err(Error::invalid(path, "pixels", image.pixels.len(), image.width * image.height));
    }
    if let Some(i) = image.pixels.iter().position(|p| p.iter().any(|v| v.is_nan())) {
        let what = format!("pixel ({}, {})", i % image.width, i / image.width);
        return Err(Error::invalid(path, what, "NaN", "a number"));
    }
    let bytes: Vec<u8> = image.pixels.iter().flatten().map(|&v| srgb_byte(v)).collect();
    atomic::write(path, |file| {
        // The size is at most 2^28 pixels, so both sides fit.
        let (width, height) = (image.width as u32, image.height as u32);
        PngEncoder::new(file).write_image(&bytes, width, height, ExtendedColorType::Rgb8).map_err(|e| match e {
            image::ImageError::IoError(e) => Error::io(path, e),
            other => Error::invalid(path, "PNG", other, "a writable image"),
        })
    })
}

/// Linear light as a byte of sRGB: 0 for NaN.
pub fn srgb_byte(linear: f32) -> u8 {
    let v = f64::from(linear).clamp(0.0, 1.0);
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (encoded * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_points_of_the_curve() {
        // 0.18 grey is 118 and 0.5 is 188 in every table of the sRGB curve.
        for (linear, byte) in [(0.0, 0), (1.0, 255), (0.18, 118), (0.5, 188), (0.0031308, 10), (9.0, 255), (-1.0, 0)] {
            assert_eq!(srgb_byte(linear), byte, "{linear}");
        }
        assert_eq!((srgb_byte(f32::INFINITY), srgb_byte(f32::NEG_INFINITY)), (255, 0));
    }

    #[test]
    fn a_written_preview_is_read_back_by_position() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let pixels = vec![[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.18; 3], [0.5; 3], [0.0; 3]];
        write_png(&path, &RgbImage { width: 3, height: 2, pixels }).unwrap();
        let back = image::open(&path).unwrap().into_rgb8();
        assert_eq!(back.dimensions(), (3, 2));
        let flat = [255, 0, 0, 0, 255, 0, 0, 0, 255, 118, 118, 118, 188, 188, 188, 0, 0, 0];
        assert_eq!(back.into_raw(), flat);
    }

    #[test]
    fn a_nan_pixel_is_refused_by_position() {
        let pixels = vec![[0.0; 3], [0.0, f32::NAN, 0.0]];
        let error = write_png(Path::new("a.png"), &RgbImage { width: 2, height: 1, pixels }).unwrap_err();
        assert_eq!(error.to_string(), "a.png: pixel (1, 0): found NaN, expected a number");
    }
}
