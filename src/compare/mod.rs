//! `smoke-bake compare IMAGE REFERENCE`: how far an image is from a reference.

mod noise;
mod report;

use crate::cli::{CompareArgs, Picture};
use crate::{answer, failure::Failure};
use report::Report;
use smoke_formats::Error;
use smoke_formats::image::{self, Channel, FloatImage, RgbImage};
use smoke_runtime::image_difference::flip::{self, Flip};
use smoke_runtime::image_difference::{self, Incomparable, Pair, debiased, false_colour, z_test};
use std::path::Path;

/// Channels in the order of a pixel.
const CHANNELS: [&str; 3] = ["R", "G", "B"];

/// Reads both images, compares them, writes the difference if asked for, and prints the figures. A failed z-test is a
/// failure, after all figures.
pub fn run(args: &CompareArgs) -> Result<(), Failure> {
    let (test, reference) = (image::read(&args.image)?, image::read(&args.reference)?);
    check_same_size(&args.image, &test, &args.reference, &reference)?;
    let (test_rgb, reference_rgb) = (test.rgb(&args.image)?, reference.rgb(&args.reference)?);
    let mask = if args.mask_alpha { Some(mask(args, &test, &reference)?) } else { None };
    let reference_noise = noise::of(&reference, &args.reference, args.standard_error.as_deref(), args.passes)?;
    let image_noise = noise::of(&test, &args.image, args.image_standard_error.as_deref(), args.image_passes)?;
    if args.z_test && reference_noise.is_none() {
        return Err(noise::missing(&args.reference, "--z-test").into());
    }
    let pair =
        Pair { width: test.width, test: &test_rgb.pixels, reference: &reference_rgb.pixels, mask: mask.as_deref() };
    let failure =
        |what: &str| Failure::work(format!("{} against {}: {what}", args.image.display(), args.reference.display()));
    let incomparable = |e: Incomparable| failure(&e.to_string());
    let difference = image_difference::compare(&pair).map_err(incomparable);
    // Three RMSE: what stands out from the usual error is seen, and a single outlier does not wash out the rest.
    let scale = args.scale.unwrap_or_else(|| difference.as_ref().map_or(1.0, |d| 3.0 * d.all.rmse));
    let scale = if scale > 0.0 { scale } else { 1.0 };
    let (signed, flipped) = (args.picture == Picture::Signed, args.picture == Picture::Flip);
    if let Some(path) = args.output.as_ref().filter(|_| signed) {
        // Written even if there are no figures: the picture shows where the NaN are.
        write_signed(path, &pair, scale)?;
    }
    let difference = difference?;
    let flip = match args.flip || (flipped && args.output.is_some()) {
        true => Some(flip::flip(&pair, args.pixels_per_degree).map_err(incomparable)?),
        false => None,
    };
    if let (Some(path), Some(flip), true) = (&args.output, &flip, flipped) {
        write_flip(path, flip, pair.width)?;
    }
    let noise = reference_noise.as_ref().map(noise::Measured::noise);
    let of_image = image_noise.as_ref().map(noise::Measured::noise);
    let report = Report {
        args,
        difference,
        debiased: noise.map(|n| debiased::debiased(&pair, &n)).transpose().map_err(incomparable)?,
        z_test: match noise.filter(|_| args.z_test) {
            Some(noise) => Some(z_test::z_test(&pair, &noise, of_image.as_ref()).map_err(incomparable)?),
            None => None,
        },
        passes: [of_image, noise].map(|noise| noise.and_then(|n| n.passes)),
        flip: flip.map(|f| f.figures),
        scale,
    };
    if args.json {
        answer::json(&report.json())?;
    } else {
        answer::text(&report.text())?;
    }
    match report.failed_z_test() {
        Some(what) => Err(failure(&what)),
        None => Ok(()),
    }
}

/// An error that names `path` if its image has another size than that of `other_path`.
fn check_same_size(path: &Path, image: &FloatImage, other_path: &Path, other: &FloatImage) -> Result<(), Error> {
    if (image.width, image.height) == (other.width, other.height) {
        return Ok(());
    }
    let size = |i: &FloatImage| format!("{} x {}", i.width, i.height);
    let expected = format!("{} as in {}", size(other), other_path.display());
    Err(Error::invalid(path, "image size", size(image), expected))
}

/// Pixels where either image has alpha above zero.
fn mask(args: &CompareArgs, test: &FloatImage, reference: &FloatImage) -> Result<Vec<bool>, Failure> {
    match (test.channel("A"), reference.channel("A")) {
        (Some(a), other) => Ok(image_difference::seen(a, other)),
        (None, Some(a)) => Ok(image_difference::seen(a, None)),
        (None, None) => {
            let found = format!("no channel A in it, nor in {}", args.reference.display());
            let expected = "one in either image; leave out --mask-alpha to compare all pixels";
            Err(Error::invalid(&args.image, "--mask-alpha", found, expected).into())
        }
    }
}

/// PNG: signed false colour. EXR: the signed difference itself, in float.
fn write_signed(path: &Path, pair: &Pair<'_>, scale: f64) -> Result<(), Failure> {
    let (width, height) = (pair.width, pair.test.len() / pair.width);
    if is_png(path) {
        let pixels = false_colour::signed(pair, scale).map_err(|e| Failure::work(e.to_string()))?;
        return Ok(image::write_png(path, &RgbImage { width, height, pixels })?);
    }
    let difference = |c: usize| pair.test.iter().zip(pair.reference).map(|(a, b)| a[c] - b[c]).collect();
    let channels = CHANNELS.iter().enumerate();
    let channels = channels.map(|(c, name)| Channel { name: (*name).into(), values: difference(c) }).collect();
    Ok(image::write_channels(path, &FloatImage { width, height, channels })?)
}

/// PNG: the FLIP error from dark to light. EXR: the error itself, in float, as Y.
fn write_flip(path: &Path, flip: &Flip, width: usize) -> Result<(), Failure> {
    let height = flip.errors.len() / width;
    if is_png(path) {
        let pixels = flip.errors.iter().map(|e| false_colour::ramp(*e)).collect();
        return Ok(image::write_png(path, &RgbImage { width, height, pixels })?);
    }
    let channels = vec![Channel { name: "Y".into(), values: flip.errors.clone() }];
    Ok(image::write_channels(path, &FloatImage { width, height, channels })?)
}

fn is_png(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"))
}
