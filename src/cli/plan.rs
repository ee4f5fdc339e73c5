//! Options of `plan`.

use super::{Rgb, ratio, rgb, threads};
use clap::Args;
use smoke_formats::sequence::FrameSelection;
use std::path::PathBuf;

/// Options of `plan`.
#[derive(Args, Debug)]
pub struct PlanArgs {
    /// A pack; or volumes: a pattern such as plume.####.vdb, or one file of a sequence.
    pub input: PathBuf,
    /// The scene file.
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// Frames to plan for [default: all, as `render --method auto` does].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Error to meet, such as 5%: relative RMSE over the pixels with smoke.
    #[arg(long, value_name = "ERROR", value_parser = ratio, conflicts_with = "time")]
    pub error: Option<f64>,
    /// Seconds a frame to fit in, such as 0.1s or 100ms.
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub time: Option<f64>,
    /// Threads that seconds are predicted for [default: the 2 of the measurements].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// Name of the density grid in volumes.
    #[arg(long, default_value = "density")]
    pub grid: String,
    /// Instead of the scene's sigma_t: a number, or R,G,B.
    #[arg(long, value_name = "RGB", value_parser = rgb)]
    pub sigma_t: Option<Rgb>,
    /// Instead of the scene's albedo: a number, or R,G,B.
    #[arg(long, value_name = "RGB", value_parser = rgb)]
    pub albedo: Option<Rgb>,
    /// Instead of the scene's g.
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    pub g: Option<f64>,
    /// Instead of the scene's width.
    #[arg(long, value_name = "PIXELS")]
    pub width: Option<u32>,
    /// Instead of the scene's height.
    #[arg(long, value_name = "PIXELS")]
    pub height: Option<u32>,
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

/// Seconds, as `0.1s`, `100ms` or a bare number of seconds.
pub(super) fn duration(text: &str) -> Result<f64, String> {
    let (number, scale) = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
        (Some(number), _) => (number, 1e-3),
        (None, Some(number)) => (number, 1.0),
        (None, None) => (text, 1.0),
    };
    let seconds = super::positive(number.trim_end()).map(|v| v * scale);
    seconds.map_err(|_| "expected a time above zero, such as 0.1s or 100ms".into())
}

#[cfg(test)]
mod tests {
    use super::super::tests::parse;
    use super::*;

    #[test]
    fn an_error_is_a_share_or_per_cent_and_a_time_has_its_unit() {
        let base = ["a.smoke", "--scene", "s.toml"];
        let args = |more: &[&str]| parse::<PlanArgs>(&[&base[..], more].concat());
        for (text, error) in [("5%", 0.05), ("0.05", 0.05), ("2.5 %", 0.025)] {
            assert!((args(&["--error", text]).unwrap().error.unwrap() - error).abs() < 1e-12, "{text}");
        }
        for (text, time) in [("0.1s", 0.1), ("100ms", 0.1), ("3", 3.0), ("2 s", 2.0)] {
            assert!((args(&["--time", text]).unwrap().time.unwrap() - time).abs() < 1e-12, "{text}");
        }
        for wrong in
            [&["--error", "0"][..], &["--error", "-5%"], &["--error", "nan"], &["--time", "0s"], &["--time", "1h"]]
        {
            assert!(args(wrong).is_err(), "{wrong:?}");
        }
        assert!(args(&["--error", "5%", "--time", "1s"]).is_err());
    }
}
