//! Options of `compare`.

use super::positive;
use clap::{Args, ValueEnum};
use std::path::PathBuf;

/// What the difference image shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Picture {
    /// The image minus the reference: red too bright, blue too dark.
    #[default]
    Signed,
    /// The FLIP error of every pixel, 0 to 1: dark is none, light is much.
    Flip,
}

/// Options of `compare`.
#[derive(Args, Debug)]
pub struct CompareArgs {
    /// The image under test: EXR or Radiance HDR with R, G, B.
    pub image: PathBuf,
    /// The image to measure against, of the same size.
    pub reference: PathBuf,
    /// Compare only pixels where the alpha of either image is above zero.
    #[arg(long)]
    pub mask_alpha: bool,
    /// Write the difference: .png in false colour, .exr as numbers.
    #[arg(short, long, value_name = "PATH", value_parser = difference_path)]
    pub output: Option<PathBuf>,
    /// What the difference image shows.
    #[arg(long, value_enum, default_value_t)]
    pub picture: Picture,
    /// Error at which the false colours of a signed picture are full [default: three times the RMSE].
    #[arg(long, value_name = "RADIANCE", value_parser = positive)]
    pub scale: Option<f64>,
    /// Test whether the difference can be told from the noise; exit code 1 if it can.
    #[arg(long)]
    pub z_test: bool,
    /// Standard errors of the reference, an image with R, G, B [default: its channels standard_error.R, .G, .B].
    #[arg(long, value_name = "PATH")]
    pub standard_error: Option<PathBuf>,
    /// Passes that these were estimated from [default: those in the settings of the reference, or very many].
    #[arg(long, value_name = "N", value_parser = passes)]
    pub passes: Option<u32>,
    /// Standard errors of the image under test [default: its channels standard_error.R, .G, .B, or none].
    #[arg(long, value_name = "PATH")]
    pub image_standard_error: Option<PathBuf>,
    /// Passes that those were estimated from [default: those in the settings of the image, or very many].
    #[arg(long, value_name = "N", value_parser = passes)]
    pub image_passes: Option<u32>,
    /// Add FLIP, the difference that a viewer sees.
    #[arg(long)]
    pub flip: bool,
    /// Pixels that a degree of the viewer's visual angle holds, for FLIP.
    #[arg(long, value_name = "N", value_parser = pixels_per_degree, default_value_t = 67.0)]
    pub pixels_per_degree: f64,
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

fn difference_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("png" | "exr") => Ok(path),
        _ => Err("expected a name that ends in .png or .exr".into()),
    }
}

fn passes(text: &str) -> Result<u32, String> {
    text.parse().ok().filter(|n| *n >= 2).ok_or_else(|| "expected a whole number of at least 2".into())
}

/// From a picture seen as a thumbnail to one seen through a magnifier: the filters grow with it.
fn pixels_per_degree(text: &str) -> Result<f64, String> {
    let in_range = |v: &f64| (1.0..=1000.0).contains(v);
    positive(text).ok().filter(in_range).ok_or_else(|| "expected a number from 1 to 1000".into())
}
