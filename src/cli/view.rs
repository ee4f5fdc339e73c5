//! Options of `view`.

use super::MethodChoice;
use clap::Args;
use std::path::PathBuf;

/// Options of `view`.
#[derive(Args, Debug)]
pub struct ViewArgs {
    /// The pack.
    pub pack: PathBuf,
    /// The scene file [default: camera, medium and light that suit the pack].
    pub scene: Option<PathBuf>,
    /// Number of the frame to begin with [default: the one with most smoke].
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    pub frame: Option<i32>,
    /// Width of the window, in pixels.
    #[arg(long, value_name = "PIXELS", default_value_t = 1280, value_parser = clap::value_parser!(u32).range(320..=16384))]
    pub width: u32,
    /// Height of the window, in pixels.
    #[arg(long, value_name = "PIXELS", default_value_t = 800, value_parser = clap::value_parser!(u32).range(240..=16384))]
    pub height: u32,
    /// How the pictures are made; auto is the fast method, or the reference where a light needs it.
    #[arg(long, value_enum, default_value_t)]
    pub method: MethodChoice,
    /// What lights and marches: cpu, gpu for the best graphics device, or part of the name of one that `devices` lists.
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
    /// Folder that key S saves to [default: the working directory].
    #[arg(short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
    /// Write a picture of the window there, as PNG, and end.
    #[arg(long, value_name = "PNG")]
    pub screenshot: Option<PathBuf>,
    /// Seconds that the window is open before the screenshot; a picture at full size is awaited in any case.
    #[arg(long, value_name = "SECONDS", value_parser = super::positive, default_value = "2", requires = "screenshot")]
    pub seconds: f64,
}
