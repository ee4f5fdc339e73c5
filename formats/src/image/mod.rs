//! Images in and out: environment maps and references in, rendered frames and previews out.
//!
//! | file | what |
//! |---|---|
//! | `read_exr` | OpenEXR into named f32 channels |
//! | `read_hdr` | Radiance `.hdr` into R, G, B |
//! | `write_exr` | rendered frames and plain channels to OpenEXR, the same bytes on every run |
//! | `write_png` | 8-bit sRGB previews |
//! | `projection` | the camera as the two matrices that OpenEXR stores |
//!
//! All colour is linear Rec.709. Pixels are stored row by row from the top, left to right: `values[x + width * y]`.

pub mod projection;
mod read_exr;
mod read_hdr;
mod write_exr;
mod write_png;

pub use write_exr::{
    FrameMetadata, RenderedFrame, SETTINGS_ATTRIBUTE, STANDARD_ERROR, SamplePrecision, write_channels, write_frame,
};
pub use write_png::{srgb_byte, write_png};

use crate::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Most pixels of an image that any reader accepts: 2^28, a map of 23,170 x 11,585.
pub const MAX_PIXELS: u64 = 1 << 28;

/// Most samples over all channels that any reader accepts: 2^29 (2 GiB of f32), a 16k x 8k map with four channels.
pub const MAX_SAMPLES: u64 = 1 << 29;

/// Longest image file that is read: twice the largest image without compression.
const MAX_FILE_BYTES: u64 = 2 * 4 * MAX_SAMPLES;

/// The first bytes of an OpenEXR file.
const EXR_MAGIC: [u8; 4] = [0x76, 0x2f, 0x31, 0x01];

/// One channel of a [`FloatImage`].
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// Name as in the file: `R`, `A`, `Z`, `layer.R`.
    pub name: String,
    /// `width * height` samples, row by row from the top. May hold infinities and NaN if the file does.
    pub values: Vec<f32>,
}

/// An image of named channels, all of the same size.
#[derive(Clone, Debug, PartialEq)]
pub struct FloatImage {
    /// Pixels in a row, at least 1.
    pub width: usize,
    /// Rows, at least 1.
    pub height: usize,
    /// The channels, in the order of the file.
    pub channels: Vec<Channel>,
}

/// An image of linear Rec.709 colour.
#[derive(Clone, Debug, PartialEq)]
pub struct RgbImage {
    /// Pixels in a row, at least 1.
    pub width: usize,
    /// Rows, at least 1.
    pub height: usize,
    /// `width * height` pixels, row by row from the top.
    pub pixels: Vec<[f32; 3]>,
}

impl FloatImage {
    /// The samples of the channel called `name`.
    pub fn channel(&self, name: &str) -> Option<&[f32]> {
        self.channels.iter().find(|c| c.name == name).map(|c| c.values.as_slice())
    }

    /// The colour: channels R, G, B, or grey from Y alone. `path` is named if they are missing.
    pub fn rgb(&self, path: &Path) -> Result<RgbImage> {
        let all = |names: [&str; 3]| Some([self.channel(names[0])?, self.channel(names[1])?, self.channel(names[2])?]);
        let Some([r, g, b]) = all(["R", "G", "B"]).or_else(|| all(["Y", "Y", "Y"])) else {
            let names: Vec<_> = self.channels.iter().map(|c| c.name.as_str()).collect();
            return Err(Error::invalid(path, "channels", names.join(", "), "R, G and B, or Y"));
        };
        let pixels = r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect();
        Ok(RgbImage { width: self.width, height: self.height, pixels })
    }
}

/// Reads an OpenEXR or Radiance HDR image, told apart by its first bytes. Values are as stored: check for NaN and
/// infinities where they would hurt. Sizes are checked against [`MAX_PIXELS`] and [`MAX_SAMPLES`] first.
pub fn read(path: &Path) -> Result<FloatImage> {
    let io = |e| Error::io(path, e);
    let mut file = File::open(path).map_err(io)?;
    let mut bytes = Vec::new();
    // The first bytes first: what is no image is not read to its end, which a device may not have.
    file.by_ref().take(4).read_to_end(&mut bytes).map_err(io)?;
    let decode = match bytes.as_slice() {
        start if start == EXR_MAGIC => read_exr::decode,
        [b'#', b'?', ..] => read_hdr::decode,
        start => {
            let start: Vec<_> = start.iter().map(|b| format!("{b:02x}")).collect();
            let found = format!("[{}]", start.join(" "));
            return Err(Error::invalid(path, "first bytes", found, "an OpenEXR or Radiance HDR image"));
        }
    };
    file.take(MAX_FILE_BYTES).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(Error::invalid(path, "file size", "more", format!("at most {MAX_FILE_BYTES} bytes")));
    }
    decode(path, &bytes)
}

/// The settings that made an image of ours, JSON as [`FrameMetadata::settings_json`]; none if the file has none, or is not
/// OpenEXR. Only the header is read.
pub fn read_settings(path: &Path) -> Result<Option<String>> {
    let io = |e| Error::io(path, e);
    let mut file = File::open(path).map_err(io)?;
    let mut start = Vec::new();
    file.by_ref().take(4).read_to_end(&mut start).map_err(io)?;
    if start != EXR_MAGIC {
        return Ok(None);
    }
    read_exr::text_attribute(path, start.as_slice().chain(file), SETTINGS_ATTRIBUTE)
}

/// Reads an environment map: finite linear radiance, at least 0. Also returns how many samples were negative: colours
/// outside the gamut and lossy compression leave some in real maps (`-6e-6` beside a sun of 3000), and they are set to
/// zero. A sample that is not finite is an error that names its pixel.
pub fn read_environment(path: &Path) -> Result<(RgbImage, usize)> {
    let mut image = read(path)?.rgb(path)?;
    if let Some(i) = image.pixels.iter().position(|p| !p.iter().all(|v| v.is_finite())) {
        let what = format!("pixel ({}, {})", i % image.width, i / image.width);
        return Err(Error::invalid(path, what, format!("{:?}", image.pixels[i]), "finite radiance"));
    }
    let mut negative = 0;
    for v in image.pixels.iter_mut().flatten().filter(|v| **v < 0.0) {
        *v = 0.0;
        negative += 1;
    }
    Ok((image, negative))
}

/// Checks a size before anything is allocated for it.
fn check_size(path: &Path, width: u64, height: u64, channels: u64) -> Result<()> {
    let pixels = width.checked_mul(height);
    if !pixels.is_some_and(|p| p > 0 && p <= MAX_PIXELS) {
        return Err(Error::invalid(
            path,
            "image size",
            format!("{width} x {height}"),
            format!("1 to {MAX_PIXELS} pixels"),
        ));
    }
    if !pixels.and_then(|p| p.checked_mul(channels)).is_some_and(|s| s > 0 && s <= MAX_SAMPLES) {
        let found = format!("{width} x {height} with {channels} channels");
        return Err(Error::invalid(path, "image size", found, format!("1 to {MAX_SAMPLES} samples over all channels")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn constant(names: &[&str]) -> FloatImage {
        let channels = names.iter().zip(1..).map(|(n, v)| Channel { name: (*n).into(), values: vec![v as f32; 2] });
        FloatImage { width: 2, height: 1, channels: channels.collect() }
    }

    #[test]
    fn colour_comes_from_r_g_b_in_any_order_or_from_y() {
        let path = Path::new("a.exr");
        assert_eq!(constant(&["B", "G", "R"]).rgb(path).unwrap().pixels[1], [3.0, 2.0, 1.0]);
        assert_eq!(constant(&["Y"]).rgb(path).unwrap().pixels[0], [1.0; 3]);
    }

    #[test]
    fn an_image_without_colour_names_the_channels_it_has() {
        let message = constant(&["Z", "depth.V"]).rgb(Path::new("a.exr")).unwrap_err().to_string();
        assert_eq!(message, "a.exr: channels: found Z, depth.V, expected R, G and B, or Y");
    }

    #[test]
    fn a_file_of_another_kind_is_refused_by_its_first_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        std::fs::write(&path, b"\x89PNG\r\n").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("found [89 50 4e 47]"));
        std::fs::write(&path, b"").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("found []"));
    }

    #[test]
    fn an_environment_with_a_planted_nan_is_refused_by_position_and_negative_samples_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let mut image = constant(&["R", "G", "B"]);
        write_channels(&path, &image).unwrap();
        assert_eq!(read_environment(&path).unwrap().1, 0);
        image.channels[1].values[1] = -1e-6;
        write_channels(&path, &image).unwrap();
        let (clamped, negative) = read_environment(&path).unwrap();
        assert_eq!((clamped.pixels[1], negative), ([1.0, 0.0, 3.0], 1));
        for bad in [f32::NAN, f32::INFINITY] {
            image.channels[1].values[1] = bad;
            write_channels(&path, &image).unwrap();
            assert!(read_environment(&path).unwrap_err().to_string().contains("pixel (1, 0)"));
        }
    }

    #[test]
    fn sizes_past_the_limits_are_refused() {
        let path = Path::new("a.exr");
        assert!(check_size(path, 1 << 14, 1 << 14, 2).is_ok());
        assert!(check_size(path, (1 << 14) + 1, 1 << 14, 1).is_err());
        assert!(check_size(path, 1 << 14, 1 << 14, 3).is_err());
        assert!(check_size(path, u64::MAX, 2, 1).is_err());
        assert!(check_size(path, 0, 2, 1).is_err());
    }

    #[test]
    #[ignore = "needs ../shared/data"]
    fn the_environment_maps_and_references_of_the_shared_data_are_read() {
        let data = std::env::var_os("SMOKE_BAKE_DATA")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), Into::into);
        let images = |folder: std::path::PathBuf| {
            let paths = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path());
            let paths: Vec<_> = paths.filter(|p| p.extension().is_some_and(|e| e == "exr")).collect();
            assert!(!paths.is_empty(), "{}", folder.display());
            paths
        };
        for path in images(data.join("env")) {
            let (map, negative) = read_environment(&path).unwrap();
            assert_eq!(map.width, 2 * map.height, "{}", path.display());
            // Lossy compression leaves a negative sample here and there, not a negative map.
            assert!(negative * 100 < 3 * map.pixels.len(), "{negative} negative samples in {}", path.display());
        }
        for path in images(data.join("../peers/references")) {
            let image = read(&path).unwrap().rgb(&path).unwrap();
            assert_eq!((image.width, image.height), (320, 400));
            assert!(image.pixels.iter().flatten().all(|v| v.is_finite() && *v >= 0.0), "{}", path.display());
        }
    }
}
