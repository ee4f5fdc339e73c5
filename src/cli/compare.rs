//! Options of `compare`.

use super::positive;
use clap::Args;
use std::path::PathBuf;

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
    /// Write the difference: .png in false colour (red too bright, blue too dark), .exr as signed numbers.
    #[arg(short, long, value_name = "PATH", value_parser = difference_path)]
    pub output: Option<PathBuf>,
    /// Error at which the false colours are full [default: three times the RMSE].
    #[arg(long, value_name = "RADIANCE", value_parser = positive)]
    pub scale: Option<f64>,
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
