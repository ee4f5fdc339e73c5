//! Rendered frames to OpenEXR.
//!
//! Channels: `R`, `G`, `B` premultiplied linear Rec.709; `A` = 1 - mean transmittance; `Z` = front depth, the distance
//! along the view in world units (camera space z), always in float, and `+inf` where nothing was hit, so that the
//! smaller Z wins wherever two frames are merged. Half is what compositing expects of colour; float keeps everything.
//! An estimate also has `standard_error.R`, `.G`, `.B`: the standard error of each sample of R, G, B, always in float.
//!
//! Attributes: `software`, `framesPerSecond`, `worldToCamera`, `worldToNDC` (conventions: `projection`),
//! `chromaticities` (Rec.709, D65) and one own attribute, `smokebake:settings`, JSON text. It has to be ONE: the `exr`
//! crate keeps own attributes in a hash map, and two or more come out in an order that changes from run to run.
//! Lossless ZIP in blocks of 16 lines, written by one thread: the same input gives the same bytes.

use super::projection::RowMatrix;
use super::{Channel, FloatImage, check_size};
use crate::{Error, Result, atomic};
use exr::meta::attribute::{AttributeValue, Chromaticities};
use exr::prelude::{
    AnyChannel, AnyChannels, Blocks, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes, LineOrder,
    Text, Vec2, WritableImage, f16,
};
use std::path::Path;

/// Name of our own attribute.
pub const SETTINGS_ATTRIBUTE: &str = "smokebake:settings";

/// Channels of the standard error of R, G and B.
pub const STANDARD_ERROR: [&str; 3] = ["standard_error.R", "standard_error.G", "standard_error.B"];

/// How R, G, B and A are stored. Z is float in both.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SamplePrecision {
    /// 16 bits: 11 bits of precision, finite up to 65504. Larger radiance is stored as 65504.
    #[default]
    Half,
    /// 32 bits.
    Float,
}

/// The pixels of one frame, row by row from the top; every slice has `width * height` entries.
#[derive(Clone, Copy, Debug)]
pub struct RenderedFrame<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Premultiplied linear Rec.709, finite.
    pub rgb: &'a [[f32; 3]],
    /// 1 - mean transmittance, in [0, 1].
    pub alpha: &'a [f32],
    /// Front depth in world units along the view; `+inf` where nothing was hit. Never NaN.
    pub depth: &'a [f32],
    /// Standard error of the mean radiance, if the frame is an estimate; finite.
    pub standard_error: Option<&'a [[f32; 3]]>,
}

/// What a frame says about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameMetadata {
    /// Program and version.
    pub software: String,
    /// Frames per second as a fraction, when known.
    pub frames_per_second: Option<(i32, u32)>,
    /// See [`super::projection::Pinhole::world_to_camera`].
    pub world_to_camera: RowMatrix,
    /// See [`super::projection::Pinhole::world_to_ndc`].
    pub world_to_ndc: RowMatrix,
    /// The settings that made the image, JSON.
    pub settings_json: String,
}

/// Writes one rendered frame; it appears whole or not at all. Returns how many samples were too large for half and
/// were stored as 65504. A sample that is not finite (Z: that is NaN) is an error that names channel and pixel.
pub fn write_frame(
    path: &Path,
    frame: &RenderedFrame<'_>,
    metadata: &FrameMetadata,
    precision: SamplePrecision,
) -> Result<usize> {
    check_size(path, frame.width as u64, frame.height as u64, if frame.standard_error.is_some() { 8 } else { 5 })?;
    let pixels = frame.width * frame.height;
    let errors = frame.standard_error.map_or(pixels, <[_]>::len);
    for (what, length) in
        [("R, G, B", frame.rgb.len()), ("A", frame.alpha.len()), ("Z", frame.depth.len()), ("standard error", errors)]
    {
        if length != pixels {
            return Err(Error::invalid(path, format!("samples of {what}"), length, pixels));
        }
    }
    let colour = |c: usize| frame.rgb.iter().map(move |p| p[c]).collect::<Vec<f32>>();
    let mut clamped = 0;
    let mut channels = Vec::with_capacity(5);
    for (name, values) in [("R", colour(0)), ("G", colour(1)), ("B", colour(2)), ("A", frame.alpha.to_vec())] {
        check_samples(path, name, &values, frame.width, |v| v.is_finite())?;
        let samples = match precision {
            SamplePrecision::Float => FlatSamples::F32(values),
            SamplePrecision::Half => {
                let largest = f16::MAX.to_f32();
                clamped += values.iter().filter(|v| v.abs() > largest).count();
                FlatSamples::F16(values.iter().map(|v| f16::from_f32(v.clamp(-largest, largest))).collect())
            }
        };
        channels.push(AnyChannel::new(name, samples));
    }
    check_samples(path, "Z", frame.depth, frame.width, |v| !v.is_nan())?;
    channels.push(AnyChannel::new("Z", FlatSamples::F32(frame.depth.to_vec())));
    for (c, name) in STANDARD_ERROR.into_iter().enumerate() {
        if let Some(errors) = frame.standard_error {
            let values: Vec<f32> = errors.iter().map(|e| e[c]).collect();
            check_samples(path, name, &values, frame.width, |v| v.is_finite())?;
            channels.push(AnyChannel::new(name, FlatSamples::F32(values)));
        }
    }

    let matrix = |m: &RowMatrix| std::array::from_fn(|i| m[i / 4][i % 4] as f32);
    let mut attributes = LayerAttributes {
        software_name: Some(latin1(path, "software", &metadata.software)?),
        frames_per_second: metadata.frames_per_second,
        world_to_camera: Some(matrix(&metadata.world_to_camera)),
        world_to_normalized_device: Some(matrix(&metadata.world_to_ndc)),
        ..LayerAttributes::default()
    };
    let settings = latin1(path, SETTINGS_ATTRIBUTE, &ascii_json(&metadata.settings_json))?;
    attributes.other.insert(Text::from(SETTINGS_ATTRIBUTE), AttributeValue::Text(settings));
    save(path, [frame.width, frame.height], channels, attributes)?;
    Ok(clamped)
}

/// Writes channels as they are, in float, without metadata.
pub fn write_channels(path: &Path, image: &FloatImage) -> Result<()> {
    check_size(path, image.width as u64, image.height as u64, image.channels.len() as u64)?;
    let channel = |c: &Channel| {
        if c.values.len() != image.width * image.height {
            let what = format!("samples of {}", c.name);
            return Err(Error::invalid(path, what, c.values.len(), image.width * image.height));
        }
        Ok(AnyChannel::new(latin1(path, "channel name", &c.name)?, FlatSamples::F32(c.values.clone())))
    };
    let channels = image.channels.iter().map(channel).collect::<Result<_>>()?;
    save(path, [image.width, image.height], channels, LayerAttributes::default())
}

fn save(
    path: &Path,
    size: [usize; 2],
    channels: Vec<AnyChannel<FlatSamples>>,
    attributes: LayerAttributes,
) -> Result<()> {
    let encoding =
        Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order: LineOrder::Increasing };
    let layer = Layer::new((size[0], size[1]), attributes, encoding, AnyChannels::sort(channels.into_iter().collect()));
    let mut image = Image::from_layer(layer);
    // ITU-R BT.709: the primaries and D65.
    image.attributes.chromaticities = Some(Chromaticities {
        red: Vec2(0.64, 0.33),
        green: Vec2(0.30, 0.60),
        blue: Vec2(0.15, 0.06),
        white: Vec2(0.3127, 0.3290),
    });
    atomic::write(path, |file| {
        image.write().non_parallel().to_buffered(file).map_err(|e| match e {
            exr::error::Error::Io(e) => Error::io(path, e),
            other => Error::invalid(path, "OpenEXR", other, "a writable image"),
        })
    })
}

/// Text as OpenEXR holds it, one byte a character.
fn latin1(path: &Path, what: &str, text: &str) -> Result<Text> {
    Text::new_or_none(text).ok_or_else(|| Error::invalid(path, what, format!("{text:?}"), "characters of Latin-1"))
}

/// JSON with every character beyond ASCII as `\u` escapes: the same document, readable by any EXR tool. Such
/// characters stand only inside strings, where an escape is allowed.
fn ascii_json(json: &str) -> String {
    let mut out = String::with_capacity(json.len());
    for c in json.chars() {
        match c.is_ascii() {
            true => out.push(c),
            false => c.encode_utf16(&mut [0; 2]).iter().for_each(|unit| out.push_str(&format!("\\u{unit:04x}"))),
        }
    }
    out
}

fn check_samples(path: &Path, name: &str, values: &[f32], width: usize, good: impl Fn(f32) -> bool) -> Result<()> {
    match values.iter().position(|&v| !good(v)) {
        None => Ok(()),
        Some(i) => {
            let what = format!("rendered {name} at pixel ({}, {})", i % width, i / width);
            Err(Error::invalid(path, what, values[i], "a finite value"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{projection::Pinhole, read, read_settings};
    use super::*;

    const RGB: [[f32; 3]; 6] = [[0.0, 0.25, 1.0], [7e4, 2.0, 3.0], [0.1, 0.2, 0.3], [0.0; 3], [1e-3; 3], [5.0; 3]];
    const ALPHA: [f32; 6] = [0.0, 0.5, 1.0, 0.25, 0.125, 0.75];
    const DEPTH: [f32; 6] = [f32::INFINITY, 1.25, 1e6, 3.1, 1e-6, 2.0];

    fn frame() -> RenderedFrame<'static> {
        RenderedFrame { width: 3, height: 2, rgb: &RGB, alpha: &ALPHA, depth: &DEPTH, standard_error: None }
    }

    fn metadata() -> FrameMetadata {
        let camera = Pinhole {
            position: [1.0, -4.0, 2.0],
            target: [0.0; 3],
            up: [0.0, 0.0, 1.0],
            fov_degrees: 40.0,
            width: 3,
            height: 2,
        };
        FrameMetadata {
            software: "smoke-bake 0.1.0".into(),
            frames_per_second: Some((24, 1)),
            world_to_camera: camera.world_to_camera(),
            world_to_ndc: camera.world_to_ndc(),
            settings_json: "{\"seed\":1}".into(),
        }
    }

    #[test]
    fn float_keeps_every_sample_and_half_rounds_colour_but_not_depth() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        assert_eq!(write_frame(&path, &frame(), &metadata(), SamplePrecision::Float).unwrap(), 0);
        let image = read(&path).unwrap();
        assert_eq!(image.rgb(&path).unwrap().pixels, RGB);
        assert_eq!((image.channel("A").unwrap(), image.channel("Z").unwrap()), (&ALPHA[..], &DEPTH[..]));

        assert_eq!(write_frame(&path, &frame(), &metadata(), SamplePrecision::Half).unwrap(), 1);
        let image = read(&path).unwrap();
        assert_eq!(image.channel("R").unwrap()[1], 65504.0);
        assert_eq!((image.channel("A").unwrap(), image.channel("Z").unwrap()), (&ALPHA[..], &DEPTH[..]));
        for (a, b) in image.channel("G").unwrap().iter().zip(RGB) {
            // Half has 11 significant bits, so rounding moves a value by at most 2^-11 of itself.
            assert!((a - b[1]).abs() <= b[1] * 2f32.powi(-11));
        }
    }

    #[test]
    fn the_attributes_are_in_the_file_by_their_standard_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        write_frame(&path, &frame(), &metadata(), SamplePrecision::Half).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let has = |text: &str| bytes.windows(text.len()).any(|w| w == text.as_bytes());
        for name in ["software\0string", "framesPerSecond\0rational", "worldToCamera\0m44f", "worldToNDC\0m44f"] {
            assert!(has(name), "{name}");
        }
        assert!(has("chromaticities\0chromaticities") && has("smokebake:settings\0string"));
        assert!(has("{\"seed\":1}") && !has("smokebake:missing"));

        let meta = exr::meta::MetaData::read_from_file(&path, true).unwrap();
        let own = &meta.headers[0].own_attributes;
        let ndc = own.world_to_normalized_device.unwrap();
        // The target is the middle of the image: row vector (0, 0, 0, 1) times the matrix is its last row.
        assert!((ndc[12] / ndc[15] - 0.5).abs() < 1e-6 && (ndc[13] / ndc[15] - 0.5).abs() < 1e-6);
        assert_eq!((own.frames_per_second, own.other.len()), (Some((24, 1)), 1));
    }

    #[test]
    fn the_same_frame_gives_the_same_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let bytes = |name: &str| {
            let path = folder.path().join(name);
            write_frame(&path, &frame(), &metadata(), SamplePrecision::Half).unwrap();
            std::fs::read(path).unwrap()
        };
        let first = bytes("0.exr");
        (1..6).for_each(|i| assert_eq!(bytes(&format!("{i}.exr")), first));
    }

    #[test]
    fn a_planted_nan_is_refused_by_channel_and_pixel_and_nothing_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let mut rgb = RGB;
        rgb[4][2] = f32::NAN;
        let bad = RenderedFrame { rgb: &rgb, ..frame() };
        let message = write_frame(&path, &bad, &metadata(), SamplePrecision::Half).unwrap_err().to_string();
        assert!(message.contains("rendered B at pixel (1, 1)"), "{message}");
        let mut depth = DEPTH;
        depth[0] = f32::NAN;
        let bad = RenderedFrame { depth: &depth, ..frame() };
        assert!(write_frame(&path, &bad, &metadata(), SamplePrecision::Half).unwrap_err().to_string().contains("Z"));
        assert!(!path.exists());
    }

    #[test]
    fn a_slice_of_the_wrong_length_is_refused() {
        let bad = RenderedFrame { alpha: &ALPHA[..5], ..frame() };
        let message = write_frame(Path::new("a.exr"), &bad, &metadata(), SamplePrecision::Half).unwrap_err();
        assert_eq!(message.to_string(), "a.exr: samples of A: found 5, expected 6");
    }

    #[test]
    fn settings_beyond_ascii_read_back_as_the_same_document() {
        let json = r#"{"image":"Köln/夜🌫.exr"}"#;
        let ascii = ascii_json(json);
        assert!(ascii.is_ascii());
        let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
        assert_eq!(value(&ascii), value(json));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let metadata = FrameMetadata { settings_json: json.into(), ..metadata() };
        write_frame(&path, &frame(), &metadata, SamplePrecision::Half).unwrap();
        assert_eq!(value(&read_settings(&path).unwrap().unwrap()), value(json));
        let bad = FrameMetadata { software: "烟".into(), ..metadata };
        assert!(write_frame(&path, &frame(), &bad, SamplePrecision::Half).is_err());
    }

    #[test]
    fn an_image_without_settings_has_none_and_a_damaged_header_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let channels = vec![Channel { name: "Y".into(), values: vec![0.0] }];
        write_channels(&path, &FloatImage { width: 1, height: 1, channels }).unwrap();
        assert_eq!(read_settings(&path).unwrap(), None);
        std::fs::write(&path, b"#?RADIANCE\n").unwrap();
        assert_eq!(read_settings(&path).unwrap(), None);
        write_frame(&path, &frame(), &metadata(), SamplePrecision::Half).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..100]).unwrap();
        assert!(read_settings(&path).unwrap_err().to_string().starts_with(&path.display().to_string()));
    }

    #[test]
    fn channels_that_make_no_image_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let image = |names: &[&str], length: usize| {
            let channels = names.iter().map(|n| Channel { name: (*n).into(), values: vec![0.0; length] }).collect();
            FloatImage { width: 2, height: 1, channels }
        };
        assert!(write_channels(&path, &image(&["R"], 2)).is_ok());
        for bad in [image(&["R", "R"], 2), image(&[], 2), image(&["R"], 3), image(&["烟"], 2), image(&[""], 2)] {
            assert!(write_channels(&path, &bad).is_err(), "{bad:?}");
        }
    }
}
