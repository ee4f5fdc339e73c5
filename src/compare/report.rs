//! The figures of a comparison as text and as JSON.

use super::{CHANNELS, is_png};
use crate::cli::{CompareArgs, Picture};
use serde_json::{Value, json};
use smoke_runtime::image_difference::debiased::{Debiased, DebiasedFigures};
use smoke_runtime::image_difference::flip::FlipFigures;
use smoke_runtime::image_difference::z_test::{Part, ZFigures, ZTest};
use smoke_runtime::image_difference::{Difference, Figures};
use std::fmt::Write;

/// All that was found out.
pub struct Report<'a> {
    /// What was asked.
    pub args: &'a CompareArgs,
    /// The plain figures.
    pub difference: Difference,
    /// Without the reference's noise, where that is known.
    pub debiased: Option<Debiased>,
    /// The test, if asked for.
    pub z_test: Option<ZTest>,
    /// Passes behind the standard errors of the image and of the reference.
    pub passes: [Option<u32>; 2],
    /// FLIP, if asked for.
    pub flip: Option<FlipFigures>,
    /// Error at which the false colours of a signed picture are full.
    pub scale: f64,
}

impl Report<'_> {
    /// One line on what failed in the z-test; none if it passed or was not asked for.
    pub fn failed_z_test(&self) -> Option<String> {
        let test = self.z_test.as_ref().filter(|test| !test.passed())?;
        let parts = [
            (Part::Mean, "mean of"),
            (Part::Share, "share beyond 2 standard errors in"),
            (Part::Exact, "pixels without noise in"),
        ];
        let failed = parts.iter().filter_map(|(part, name)| {
            let rows = CHANNELS.iter().zip(&test.channels).chain([(&"R+G+B", &test.all)]);
            let rows: Vec<&str> = rows.filter(|(_, f)| f.failed().contains(part)).map(|(row, _)| *row).collect();
            (!rows.is_empty()).then(|| format!("{name} {}", rows.join(", ")))
        });
        Some(format!("z-test failed: {}", failed.collect::<Vec<_>>().join("; ")))
    }

    /// A table for people.
    pub fn text(&self) -> String {
        let d = &self.difference;
        let mut out = format!("pixels compared  {}\n", d.pixels);
        let mut row = |name: &str, all: String, [r, g, b]: [String; 3]| {
            // Writing to a String cannot fail.
            let _ = writeln!(out, "{name:<15}  {all:<12} R {r:<12} G {g:<12} B {b}");
        };
        let mut plain = |name: &str, figure: &dyn Fn(&Figures) -> String| {
            row(name, figure(&d.all), d.channels.each_ref().map(figure));
        };
        plain("relative RMSE", &|f| format!("{:.4} %", 100.0 * f.relative_rmse));
        plain("RMSE", &|f| format!("{:.6e}", f.rmse));
        plain("PSNR", &|f| format!("{:.2} dB", f.psnr));
        plain("bias", &|f| format!("{:+.4} %", 100.0 * f.bias));
        plain("mean", &|f| format!("{:.6e}", f.mean_test));
        plain("reference mean", &|f| format!("{:.6e}", f.mean_reference));
        if let Some(debiased) = &self.debiased {
            let mut debiased = |name: &str, figure: &dyn Fn(&DebiasedFigures) -> String| {
                row(name, figure(&debiased.all), debiased.channels.each_ref().map(figure));
            };
            debiased("debiased RMSE", &|f| format!("{:.4} %", 100.0 * f.relative_rmse));
            debiased("reference noise", &|f| format!("{:.4} %", 100.0 * f.reference_noise));
        }
        if let Some(test) = &self.z_test {
            let mut tested = |name: &str, figure: &dyn Fn(&ZFigures) -> String| {
                row(name, figure(&test.all), test.channels.each_ref().map(figure));
            };
            tested("z of the mean", &|f| format!("{:+.3}", f.mean.z));
            tested("  by chance", &|f| format!("{:.3e}", f.mean.p));
            tested("beyond 2 errors", &|f| format!("{:.4} %", 100.0 * f.share.share));
            tested("  expected", &|f| format!("{:.4} %", 100.0 * f.share.expected));
            tested("  at most", &|f| format!("{:.4} %", 100.0 * f.share.bound));
            tested("largest z", &|f| format!("{:+.3}", f.largest.z));
            tested("  by chance", &|f| format!("{:.3e}", f.largest.p));
            tested("unequal, exact", &|f| f.unequal.to_string());
            tested("z-test", &|f| if f.failed().is_empty() { "passed" } else { "failed" }.into());
        }
        if let Some(flip) = &self.flip {
            let [first, median, third] = flip.weighted_quartiles;
            let _ = writeln!(out, "FLIP             {:.6}, largest {:.6}", flip.mean, flip.largest);
            let _ = writeln!(out, "FLIP, weighted   quartiles {first:.6} {median:.6} {third:.6}");
            let [from, to] = flip.exposures;
            let _ = writeln!(out, "FLIP exposures   {} from {from:+.3} to {to:+.3} stops", flip.exposure_count);
        }
        let l = d.largest;
        let _ = writeln!(out, "largest error    {:.6e} at ({}, {}) in {}", l.error, l.x, l.y, CHANNELS[l.channel]);
        if let Some(path) = &self.args.output {
            let what = match (self.args.picture, is_png(path)) {
                (Picture::Signed, true) => format!("red too bright, blue too dark, full at {:.6e}", self.scale),
                (Picture::Signed, false) => "the image minus the reference".into(),
                (Picture::Flip, true) => "FLIP from 0, black, to 1, light yellow".into(),
                (Picture::Flip, false) => "FLIP of every pixel".into(),
            };
            let _ = writeln!(out, "{}: {what}", path.display());
        }
        out
    }

    /// Everything for programs.
    pub fn json(&self) -> Value {
        let (args, d) = (self.args, &self.difference);
        let signed = args.picture == Picture::Signed;
        json!({
            "image": args.image,
            "reference": args.reference,
            "pixels": d.pixels,
            "masked_by_alpha": args.mask_alpha,
            "all": figures(&d.all),
            "channels": by_channel(&d.channels, figures),
            "largest_error": {
                "error": d.largest.error, "x": d.largest.x, "y": d.largest.y, "channel": CHANNELS[d.largest.channel],
            },
            "debiased": self.debiased.as_ref().map(|d| json!({
                "all": debiased(&d.all), "channels": by_channel(&d.channels, debiased),
            })),
            "z_test": self.z_test.as_ref().map(|test| json!({
                "passed": test.passed(),
                "image_passes": self.passes[0],
                "reference_passes": self.passes[1],
                "all": tested(&test.all),
                "channels": by_channel(&test.channels, tested),
            })),
            "flip": self.flip.as_ref().map(|f| json!({
                "mean": f.mean,
                "weighted_quartiles": f.weighted_quartiles,
                "largest": f.largest,
                "exposures": { "first": f.exposures[0], "last": f.exposures[1], "count": f.exposure_count },
                "pixels_per_degree": args.pixels_per_degree,
            })),
            "difference": args.output.as_ref().map(|path| match signed {
                true => json!({ "path": path, "picture": "signed", "scale": self.scale }),
                false => json!({ "path": path, "picture": "flip" }),
            }),
        })
    }
}

fn by_channel<T>(channels: &[T; 3], json: impl Fn(&T) -> Value) -> Value {
    let [r, g, b] = channels.each_ref().map(json);
    json!({ "R": r, "G": g, "B": b })
}

fn figures(f: &Figures) -> Value {
    json!({
        "rmse": f.rmse, "relative_rmse": f.relative_rmse, "psnr_db": f.psnr, "bias": f.bias,
        "mean": f.mean_test, "reference_mean": f.mean_reference,
    })
}

fn debiased(f: &DebiasedFigures) -> Value {
    json!({ "relative_rmse": f.relative_rmse, "reference_noise": f.reference_noise })
}

fn tested(f: &ZFigures) -> Value {
    let (share, largest) = (&f.share, &f.largest);
    json!({
        "passed": f.failed().is_empty(),
        "mean": { "z": f.mean.z, "degrees_of_freedom": f.mean.freedom, "p": f.mean.p },
        "beyond_2": {
            "pixels": share.pixels, "beyond": share.beyond, "share": share.share, "expected": share.expected,
            "bound": share.bound, "p": share.p,
        },
        "largest": { "z": largest.z, "x": largest.x, "y": largest.y, "p": largest.p },
        "unequal": f.unequal,
    })
}
