//! A film as bytes for the screen and as a picture for PNG: exposure, then the curve of sRGB, as the contact sheet has it.
//!
//! `shown = exposure (radiance + transmittance * backdrop)`, clamped to [0, 1]. The window and the PNG that it saves show
//! the same bytes. Cost: a search among 255 numbers for each sample, over all threads.

use crate::contact_sheet;
use rayon::prelude::*;
use smoke_formats::image::{RgbImage, srgb_byte};
use smoke_runtime::film::{Film, Pixel};
use std::sync::LazyLock;

/// What stands behind smoke that has no visible sky, on the screen alone: linear grey after exposure.
const BACKDROP: f32 = 0.012;
/// Opacity from which a pixel counts as smoke when the exposure is chosen.
const SMOKE: f32 = 0.1;
/// Pixels that one thread does at a time.
const CHUNK: usize = 4096;

/// For each byte from 1 the least f32 that [`srgb_byte`] gives it.
static LEAST: LazyLock<[f32; 255]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        // Positive floats are in the order of their bits.
        let (mut low, mut high) = (0f32.to_bits(), 1f32.to_bits());
        while low < high {
            let middle = low + (high - low) / 2;
            if usize::from(srgb_byte(f32::from_bits(middle))) > i { high = middle } else { low = middle + 1 }
        }
        f32::from_bits(low)
    })
});

/// The factor of an exposure in stops.
pub fn factor(stops: f64) -> f32 {
    stops.exp2() as f32
}

/// Stops that show the smoke of `film` as bright as it can be: the 99.5th percentile of its pixels becomes white. None
/// where there is nothing to see.
pub fn stops_for(film: &Film) -> Option<f64> {
    let smoke = |least: f32| film.pixels.iter().filter(move |p| p.alpha() > least).map(|p| p.radiance);
    let mut pixels: Vec<[f32; 3]> = smoke(SMOKE).collect();
    if pixels.is_empty() {
        pixels = smoke(0.0).collect();
    }
    let lit = pixels.iter().flatten().any(|v| *v > 0.0);
    let image = RgbImage { width: pixels.len(), height: 1, pixels };
    let stops = contact_sheet::exposure(&[image]).log2();
    (lit && stops.is_finite()).then_some(stops)
}

fn seen(pixel: &Pixel, exposure: f32) -> [f32; 3] {
    let value = [0, 1, 2].map(|c| pixel.radiance[c] * exposure + pixel.transmittance[c] * BACKDROP);
    // What is not finite must be seen, as on the contact sheet.
    if value.iter().all(|v| v.is_finite()) { value } else { [1.0, 0.0, 1.0] }
}

/// The picture as it is shown, linear, for PNG.
pub fn picture(film: &Film, stops: f64) -> RgbImage {
    let exposure = factor(stops);
    let pixels = film.pixels.par_iter().map(|p| seen(p, exposure)).collect();
    RgbImage { width: film.width, height: film.height, pixels }
}

/// The same as bytes of sRGB: `[R, G, B]` pixel by pixel, row by row from the top.
pub fn bytes(film: &Film, stops: f64) -> Vec<u8> {
    let exposure = factor(stops);
    let mut bytes = vec![0; 3 * film.pixels.len()];
    bytes.par_chunks_mut(3 * CHUNK).zip(film.pixels.par_chunks(CHUNK)).for_each(|(bytes, pixels)| {
        for (byte, pixel) in bytes.chunks_exact_mut(3).zip(pixels) {
            let seen = seen(pixel, exposure);
            (0..3).for_each(|c| byte[c] = LEAST.partition_point(|least| *least <= seen[c]) as u8);
        }
    });
    bytes
}

/// The linear picture whose PNG has these bytes of sRGB, `[R, G, B]` each.
pub fn from_bytes(width: usize, height: usize, bytes: impl Iterator<Item = [u8; 3]>) -> RgbImage {
    let linear = |byte: u8| if byte == 0 { 0.0 } else { LEAST[usize::from(byte) - 1] };
    RgbImage { width, height, pixels: bytes.map(|b| b.map(linear)).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn film(values: &[f32]) -> Film {
        let pixels = values.iter().map(|&v| Pixel { radiance: [v; 3], transmittance: [0.0; 3], depth: 1.0 }).collect();
        Film { width: values.len(), height: 1, pixels }
    }

    #[test]
    fn screen_and_png_have_the_same_bytes() {
        let values: Vec<f32> = (0..20_000).map(|i| (i as f32 * 1e-3 - 15.0).exp2()).chain([0.0, -1.0, 7.0]).collect();
        let film = film(&values);
        for stops in [-3.0, 0.0, 0.7] {
            let png = picture(&film, stops).pixels.into_iter().flatten().map(srgb_byte).collect::<Vec<_>>();
            assert!(png.contains(&0) && png.contains(&255) && png.contains(&100));
            assert_eq!(bytes(&film, stops), png, "{stops}");
        }
    }

    #[test]
    fn every_byte_survives_the_way_to_linear_light_and_back() {
        let image = from_bytes(256, 1, (0..=255).map(|b| [b; 3]));
        assert!((0..256).all(|b| image.pixels[b].map(srgb_byte) == [b as u8; 3]));
    }

    #[test]
    fn the_chosen_exposure_makes_the_bright_smoke_white_whatever_the_light() {
        for light in [1e-6, 1.0, 3e5] {
            let film = film(&[0.25 * light, 0.5 * light, light]);
            // An index of 995/1000 of two steps is the second: half the light becomes white.
            let stops = stops_for(&film).unwrap();
            assert!((f64::from(factor(stops)) * f64::from(0.5 * light) - 1.0).abs() < 1e-5, "{light}");
        }
        let sky = Pixel { radiance: [9.0; 3], ..Pixel::EMPTY };
        let mut film = film(&[1.0, 1.0]);
        film.pixels.extend([sky; 50]);
        film.width = 52;
        assert_eq!(stops_for(&film), Some(0.0), "a sky beside the smoke does not count");
        assert_eq!((stops_for(&Film::new(4, 4)), stops_for(&Film::new(0, 0))), (None, None));
    }

    #[test]
    fn a_pixel_that_is_not_finite_is_magenta_and_black_smoke_shows_before_the_backdrop() {
        let mut film = film(&[f32::NAN, f32::INFINITY, 0.0]);
        film.pixels.push(Pixel::EMPTY);
        film.width = 4;
        let bytes = bytes(&film, 0.0);
        assert_eq!((&bytes[..6], &bytes[6..9]), (&[255, 0, 255, 255, 0, 255][..], &[0, 0, 0][..]));
        assert!(bytes[9] > 10);
    }
}
