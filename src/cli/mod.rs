//! The command line: subcommands and their options, and nothing that acts on them. Options of the larger subcommands
//! have a file each.
//!
//! Each option's variable and settings key come from its long name (see `layers`).

mod bake;
mod compare;
mod plan;
mod render;
mod sweep;
mod view;

pub use bake::{AtRest, BakeArgs, GaussianCount, ResidualAddress, TeleportRule};
pub use compare::{CompareArgs, Picture};
pub use plan::PlanArgs;
pub use render::{
    Detail, ExponentialChoice, MethodChoice, MultipleChoice, RenderArgs, RouteChoice, ScatteringOrders, SunChoice,
};
pub use sweep::{ALL_RUNGS, Assignment, SweepArgs};
pub use view::ViewArgs;

use clap::{Args, Parser, Subcommand, ValueEnum};
use smoke_formats::sequence::FrameSelection;
use std::path::PathBuf;

const LAYERS_HELP: &str = "\
Every option --like-this (but --output) also reads the variable SMOKE_BAKE_LIKE_THIS, and the key like-this in the \
subcommand's table of smoke-bake.toml in the working directory. Flags win over variables, variables over the file.

Exit codes: 0 done, 1 bad input or failed work, 2 wrong usage. Answers go to stdout, everything else to stderr.";

/// Bakes smoke sequences once into compact, relightable packs, and renders them.
#[derive(Debug, Parser)]
#[command(name = "smoke-bake", version, max_term_width = 110, after_help = LAYERS_HELP)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Bake a sequence of volumes into one pack.
    Bake(BakeArgs),
    /// Render frames of a pack to OpenEXR.
    Render(RenderArgs),
    /// Say which method and settings a scene needs, what can be left out, and what error and seconds to expect.
    Plan(PlanArgs),
    /// Show what a pack holds: sequence, settings, and sizes, errors and seconds of every frame.
    Inspect(InspectArgs),
    /// Check every byte of a pack and name the first thing that is wrong.
    Validate(ValidateArgs),
    /// Decode a pack's frames to OpenVDB or Mitsuba volumes.
    Unpack(UnpackArgs),
    /// Measure how far an image is from a reference: RMSE, bias, FLIP, and a test against its noise.
    Compare(CompareArgs),
    /// Measure what every dial costs and buys, against a reference: tables and a page of plots.
    Sweep(SweepArgs),
    /// Look at a pack in a window: turn, relight, play, and save what is seen.
    View(ViewArgs),
    /// Bake and render a small plume that comes with the program, and relight it.
    Demo(DemoArgs),
    /// List the graphics devices that `render --device` can use.
    Devices(DevicesArgs),
}

/// How progress is shown; `bake` and `render` take it as `--progress`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, lines otherwise.
    #[default]
    Auto,
    /// A bar with rate and time left.
    Bar,
    /// A line every few seconds.
    Plain,
    /// Lines for Open Job Description: `openjd_progress: 12.5`.
    Openjd,
    /// Nothing.
    None,
}

/// Three channels.
pub type Rgb = [f64; 3];

/// Options of `inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// The pack.
    pub pack: PathBuf,
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

/// Options of `devices`.
#[derive(Args, Debug)]
pub struct DevicesArgs {
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

/// Options of `validate`.
#[derive(Args, Debug)]
pub struct ValidateArgs {
    /// The pack.
    pub pack: PathBuf,
}

/// Options of `unpack`.
#[derive(Args, Debug)]
pub struct UnpackArgs {
    /// The pack.
    pub pack: PathBuf,
    /// The volumes to write, such as out.####.vdb or out.####.vol.
    #[arg(short, long, value_name = "PATTERN", value_parser = volume_pattern)]
    pub output: PathBuf,
    /// Frames to unpack [default: all in the pack].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Store densities in 16 bits instead of 32 (VDB only); the error that this adds is reported.
    #[arg(long)]
    pub half: bool,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
}

/// Options of `demo`.
#[derive(Args, Debug)]
pub struct DemoArgs {
    /// The folder to fill: the inputs, a pack, rendered frames and a contact sheet.
    pub output: PathBuf,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 => Ok(v),
        _ => Err("expected a finite number above zero".into()),
    }
}

/// A positive ratio, as a number or in per cent.
pub(super) fn ratio(text: &str) -> Result<f64, String> {
    let value = match text.strip_suffix('%') {
        Some(percent) => positive(percent.trim_end()).map(|v| v / 100.0),
        None => positive(text),
    };
    value.map_err(|_| "expected a number above zero, such as 0.02 or 2%".into())
}

/// One number for R, G and B, or three with commas.
pub(super) fn rgb(text: &str) -> Result<[f64; 3], String> {
    let values: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    match values.as_deref() {
        Ok([v]) if v.is_finite() => Ok([*v; 3]),
        Ok([r, g, b]) if [r, g, b].iter().all(|v| v.is_finite()) => Ok([*r, *g, *b]),
        _ => Err("expected a number, or three as R,G,B".into()),
    }
}

pub(super) fn exr_pattern(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("exr") => Ok(path),
        _ => Err("expected a name that ends in .exr".into()),
    }
}

pub(super) fn march_step(text: &str) -> Result<f64, String> {
    let in_range = |v: &f64| (1.0 / 64.0..=4.0).contains(v);
    positive(text).ok().filter(in_range).ok_or_else(|| "expected voxels from 1/64 to 4".into())
}

pub(super) fn threads(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| (1..=1024).contains(n)).ok_or_else(|| "expected 1 to 1024".into())
}

pub(super) fn cutoff(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if (0.0..1.0).contains(&v) => Ok(v),
        _ => Err("expected a transmittance from 0 to below 1".into()),
    }
}

fn volume_pattern(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("vdb" | "vol") => Ok(path),
        _ => Err("expected a name that ends in .vdb or .vol".into()),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use clap::{CommandFactory, FromArgMatches};

    #[test]
    fn the_definitions_of_all_subcommands_are_sound() {
        Cli::command().debug_assert();
    }

    pub(super) fn parse<A: Args + FromArgMatches>(line: &[&str]) -> Result<A, clap::Error> {
        let command = A::augment_args(clap::Command::new("x").no_binary_name(true));
        A::from_arg_matches(&command.try_get_matches_from(line)?)
    }
}
