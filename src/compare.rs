//! `smoke-bake compare IMAGE REFERENCE`: how far an image is from a reference.

use crate::cli::CompareArgs;
use crate::{answer, failure::Failure};
use serde_json::{Value, json};
use smoke_formats::image::{self, Channel, FloatImage, RgbImage};
use smoke_runtime::image_difference::{self, Difference, Figures, Pair, false_colour};
use std::fmt::Write;
use std::path::Path;

/// Channels in the order of a pixel.
const CHANNELS: [&str; 3] = ["R", "G", "B"];

/// Reads both images, compares them, writes the difference if asked for, and prints the figures.
pub fn run(args: &CompareArgs) -> Result<(), Failure> {
    let (test, reference) = (image::read(&args.image)?, image::read(&args.reference)?);
    if (test.width, test.height) != (reference.width, reference.height) {
        let size = |i: &FloatImage| format!("{} x {}", i.width, i.height);
        let (found, expected) = (size(&test), format!("{} as in {}", size(&reference), args.reference.display()));
        return Err(smoke_formats::Error::invalid(&args.image, "image size", found, expected).into());
    }
    let (test_rgb, reference_rgb) = (test.rgb(&args.image)?, reference.rgb(&args.reference)?);
    let mask = if args.mask_alpha { Some(mask(args, &test, &reference)?) } else { None };
    let pair =
        Pair { width: test.width, test: &test_rgb.pixels, reference: &reference_rgb.pixels, mask: mask.as_deref() };
    let compared = image_difference::compare(&pair)
        .map_err(|e| Failure::work(format!("{} against {}: {e}", args.image.display(), args.reference.display())));
    // Three RMSE: what stands out from the usual error is seen, and a single outlier does not wash out the rest.
    let scale = args.scale.unwrap_or_else(|| compared.as_ref().map_or(1.0, |d| 3.0 * d.all.rmse));
    let scale = if scale > 0.0 { scale } else { 1.0 };
    if let Some(path) = &args.output {
        // Written even if there are no figures: the picture shows where the NaN are.
        write_difference(path, &pair, scale)?;
    }
    let difference = compared?;
    let picture = args.output.as_deref().map(|path| (path, scale));
    if args.json {
        answer::json(&as_json(args, &difference, picture))
    } else {
        answer::text(&as_text(&difference, picture))
    }
}

/// Pixels where either image has alpha above zero.
fn mask(args: &CompareArgs, test: &FloatImage, reference: &FloatImage) -> Result<Vec<bool>, Failure> {
    match (test.channel("A"), reference.channel("A")) {
        (Some(a), other) => Ok(image_difference::seen(a, other)),
        (None, Some(a)) => Ok(image_difference::seen(a, None)),
        (None, None) => {
            let found = format!("no channel A in it, nor in {}", args.reference.display());
            let expected = "one in either image; leave out --mask-alpha to compare all pixels";
            Err(smoke_formats::Error::invalid(&args.image, "--mask-alpha", found, expected).into())
        }
    }
}

/// PNG: signed false colour. EXR: the signed difference itself, in float.
fn write_difference(path: &Path, pair: &Pair<'_>, scale: f64) -> Result<(), Failure> {
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

fn is_png(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"))
}

fn as_text(d: &Difference, picture: Option<(&Path, f64)>) -> String {
    let mut out = format!("pixels compared  {}\n", d.pixels);
    let mut row = |name: &str, figure: &dyn Fn(&Figures) -> String| {
        let [r, g, b] = d.channels.each_ref().map(figure);
        // Writing to a String cannot fail.
        let _ = writeln!(out, "{name:<15}  {:<12} R {r:<12} G {g:<12} B {b}", figure(&d.all));
    };
    row("relative RMSE", &|f| format!("{:.4} %", 100.0 * f.relative_rmse));
    row("RMSE", &|f| format!("{:.6e}", f.rmse));
    row("PSNR", &|f| format!("{:.2} dB", f.psnr));
    row("bias", &|f| format!("{:+.4} %", 100.0 * f.bias));
    row("mean", &|f| format!("{:.6e}", f.mean_test));
    row("reference mean", &|f| format!("{:.6e}", f.mean_reference));
    let l = d.largest;
    let _ = writeln!(out, "largest error    {:.6e} at ({}, {}) in {}", l.error, l.x, l.y, CHANNELS[l.channel]);
    if let Some((path, scale)) = picture {
        let _ = match is_png(path) {
            true => writeln!(out, "{}: red too bright, blue too dark, full at {scale:.6e}", path.display()),
            false => writeln!(out, "{}: the image minus the reference", path.display()),
        };
    }
    out
}

fn as_json(args: &CompareArgs, d: &Difference, picture: Option<(&Path, f64)>) -> Value {
    let figures = |f: &Figures| {
        json!({
            "rmse": f.rmse, "relative_rmse": f.relative_rmse, "psnr_db": f.psnr, "bias": f.bias,
            "mean": f.mean_test, "reference_mean": f.mean_reference,
        })
    };
    let [r, g, b] = d.channels.each_ref().map(figures);
    json!({
        "image": args.image,
        "reference": args.reference,
        "pixels": d.pixels,
        "masked_by_alpha": args.mask_alpha,
        "all": figures(&d.all),
        "channels": { "R": r, "G": g, "B": b },
        "largest_error": {
            "error": d.largest.error, "x": d.largest.x, "y": d.largest.y, "channel": CHANNELS[d.largest.channel],
        },
        "difference": picture.map(|(path, scale)| json!({ "path": path, "scale": scale })),
    })
}
