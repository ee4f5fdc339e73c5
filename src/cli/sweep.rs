//! Options of `sweep`.

use super::{ProgressMode, ratio, threads};
use clap::Args;
use clap::builder::PossibleValuesParser;
use smoke_formats::sequence::FrameSelection;
use smoke_runtime::plan::ladder::ladder;
use std::path::PathBuf;

/// An option of `bake` or `render` by its long name, and values for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// The option's long name.
    pub name: String,
    /// Its values as text, at least one.
    pub values: Vec<String>,
}

/// Options of `sweep`.
#[derive(Args, Debug)]
pub struct SweepArgs {
    /// A pack, or a sequence of volumes as `bake` takes it.
    pub input: PathBuf,
    /// The scene file; several sweep over them all.
    #[arg(long, value_name = "SCENE", required = true)]
    pub scene: Vec<PathBuf>,
    /// The folder to fill: sweep.csv, sweep.json, index.html, and what --resume needs.
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Values to try of an option of `render`, or of `bake` if the input is volumes [default: a set of all dials].
    #[arg(long, value_name = "NAME=V1,V2", value_parser = assignment)]
    pub dial: Vec<Assignment>,
    /// Every combination of the dials' values, instead of one dial at a time around the defaults.
    #[arg(long)]
    pub grid: bool,
    /// Measure the plan's rungs, each with all its dials, instead of dials: all of them, or those named; writes
    /// measured.csv too, in the form of the plan's table.
    #[arg(long, value_name = "RUNG,RUNG", num_args = 0.., require_equals = true, value_delimiter = ',',
          default_missing_value = ALL_RUNGS, value_parser = rungs(), conflicts_with_all = ["dial", "grid"])]
    pub ladder: Vec<String>,
    /// An option of `render` or `bake` that holds throughout, in place of its default.
    #[arg(long, value_name = "NAME=VALUE", value_parser = assignment)]
    pub set: Vec<Assignment>,
    /// Values of sigma-t, albedo, g or order: each combination is a scene of its own, with its own reference.
    #[arg(long, value_name = "NAME=V1,V2", value_parser = assignment)]
    pub vary: Vec<Assignment>,
    /// Frames to render [default: the middle one and the last].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Instead of the scene's width [default: the scene's, scaled to about 20,000 pixels].
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..=65536))]
    pub width: Option<u32>,
    /// Instead of the scene's height [default: in proportion].
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..=65536))]
    pub height: Option<u32>,
    /// Relative standard error of the whole image at which a reference is good enough.
    #[arg(long, value_name = "ERROR", default_value = "0.7%", value_parser = ratio)]
    pub reference_error: f64,
    /// Renders of each point; the seconds are those of the median.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..=99))]
    pub repeat: u8,
    /// Continue a sweep that was interrupted; what is done is not done again.
    #[arg(long)]
    pub resume: bool,
    /// Threads; errors do not depend on it, seconds do [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
    /// Print the JSON document too.
    #[arg(long)]
    pub json: bool,
}

/// What `--ladder` names them all by.
pub const ALL_RUNGS: &str = "all";

/// Names that `--ladder` takes.
fn rungs() -> PossibleValuesParser {
    [ALL_RUNGS].into_iter().chain(ladder().map(|rung| rung.name)).collect::<Vec<_>>().into()
}

/// `NAME=V1,V2`.
fn assignment(text: &str) -> Result<Assignment, String> {
    let (name, values) = text.split_once('=').ok_or("expected NAME=VALUE, or NAME=VALUE,VALUE")?;
    let name = name.trim().trim_start_matches('-').to_owned();
    let values: Vec<String> = values.split(',').map(|v| v.trim().to_owned()).collect();
    match name.is_empty() || values.iter().any(String::is_empty) {
        true => Err("expected NAME=VALUE, or NAME=VALUE,VALUE".into()),
        false => Ok(Assignment { name, values }),
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::parse;
    use super::*;

    #[test]
    fn sweep_takes_dials_axes_and_several_scenes() {
        let line = ["a.smoke", "--scene", "s.toml", "--scene", "t.toml", "-o", "out", "--dial", "sh-order=1, 2,4"];
        let args: SweepArgs = parse(&[&line[..], &["--dial", "route=grid", "--vary", "g=-0.5"]].concat()).unwrap();
        let dial = |i: usize| (args.dial[i].name.as_str(), args.dial[i].values.join(" "));
        assert_eq!((dial(0), dial(1)), (("sh-order", "1 2 4".into()), ("route", "grid".into())));
        assert_eq!((args.scene.len(), args.vary[0].values[0].as_str(), args.repeat), (2, "-0.5", 3));
        assert!((args.reference_error - 0.007).abs() < 1e-15);
        assert!(parse::<SweepArgs>(&[&line[..], &["--reference-error", "0"]].concat()).is_err());
        let ladder = |more: &[&str]| parse::<SweepArgs>(&[&line[..6], &["out"], more].concat()).map(|a| a.ladder);
        assert_eq!(ladder(&["--ladder"]).unwrap(), [ALL_RUNGS]);
        assert_eq!(ladder(&["--ladder=fine,reference", "--json"]).unwrap(), ["fine", "reference"]);
        assert!(ladder(&["--ladder=finest"]).is_err() && ladder(&["--ladder", "--grid"]).is_err());
        assert!(args.ladder.is_empty());
        for bad in ["sh-order", "=1", "sh-order=", "sh-order=1,,2"] {
            assert!(parse::<SweepArgs>(&[&line[..], &["--dial", bad]].concat()).is_err(), "{bad}");
        }
    }
}
