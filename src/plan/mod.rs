//! `smoke-bake plan INPUT --scene SCENE`: which method and settings a scene needs, in words or as JSON; and the same plan
//! for `render --method auto`.
//!
//! A plan is made for a whole sequence: see `smoke_runtime::plan::over_time`.

mod report;

use crate::answer;
use crate::cli::PlanArgs;
use crate::failure::Failure;
use crate::staging::{SceneChanges, Stage};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::pack::Pack;
use smoke_formats::pack::container::MAGIC;
use smoke_formats::sequence::{FrameSelection, Sequence};
use smoke_formats::volume::DensityGrid;
use smoke_formats::{Error, volume_file};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::plan::Survey;
use smoke_runtime::plan::choose::{Goal, Plan, choose};
use smoke_runtime::plan::over_time::{OverTime, sampled, thickest};
use smoke_runtime::plan::table::MEASURED;
use smoke_runtime::transport::medium::MediumParameters;
use std::io::Read;
use std::path::Path;

/// Threads that seconds are predicted for where none are given: those of the measurements. The machine's own count would
/// make a plan, and so the image, depend on the machine.
const THREADS: usize = 2;

/// A plan and what it was made from.
pub struct Planned {
    /// Frames of the sequence.
    pub frames: usize,
    /// Numbers of the frames that were looked at.
    pub sampled: Vec<i32>,
    /// Number of the frame that the plan is for.
    pub thickest: i32,
    /// The figures of that frame.
    pub survey: Survey,
    /// What varies.
    pub over_time: OverTime,
    /// The choice.
    pub plan: Plan,
}

/// Surveys, plans and says so.
pub fn run(args: &PlanArgs) -> Result<(), Failure> {
    let PlanArgs { sigma_t, albedo, g, width, height, .. } = *args;
    let stage = Stage::read(&args.scene, &SceneChanges { sigma_t, albedo, g, width, height })?;
    let goal = goal(args.error, args.time);
    let planned = match is_pack(&args.input)? {
        true => of_pack(&Pack::open(&args.input)?, args.frames.as_ref(), &stage, goal, args.threads)?,
        false => of_volumes(args, &stage, goal)?,
    };
    if args.json {
        answer::json(&report::as_json(&args.input, &planned))
    } else {
        answer::text(&report::as_text(&args.input, &planned))
    }
}

/// What the options ask for.
pub fn goal(error: Option<f64>, time: Option<f64>) -> Goal {
    match (error, time) {
        (Some(error), _) => Goal::Error(error),
        (None, Some(time)) => Goal::Time(time),
        (None, None) => Goal::Best,
    }
}

/// The plan for the frames of a pack: all of them, or a selection.
pub fn of_pack(
    pack: &Pack,
    selection: Option<&FrameSelection>,
    stage: &Stage,
    goal: Goal,
    threads: Option<usize>,
) -> Result<Planned, Failure> {
    let numbers: Vec<i32> = pack.frames().iter().map(|f| f.frame).collect();
    let chosen = match selection {
        Some(selection) => selection.positions(pack.path(), &numbers)?,
        None => (0..numbers.len()).collect(),
    };
    let voxels: Vec<u64> = chosen.iter().map(|&position| pack.frames()[position].active_voxels).collect();
    // The first of equals.
    let largest = (0..voxels.len()).rev().max_by_key(|&i| voxels[i]);
    let baked = pack.transfer();
    let mut looked_at = Vec::new();
    for at in sampled(chosen.len(), largest) {
        let position = chosen[at];
        let frame = Frame::read(pack, position)?;
        let fit_error = (!frame.gaussians.is_empty()).then(|| pack.frames()[position].fit_error);
        let transfer = baked.filter(|_| pack.has_transfer(position)).map(|record| MediumParameters {
            sigma_t: record.sigma_t,
            albedo: record.albedo,
            g: record.g,
        });
        looked_at.push((numbers[position], Survey { transfer, ..survey(&frame, stage, fit_error) }));
    }
    planned(pack.path(), chosen.len(), looked_at, &voxels, goal, threads)
}

fn of_volumes(args: &PlanArgs, stage: &Stage, goal: Goal) -> Result<Planned, Failure> {
    let input = args.input.to_str().ok_or_else(|| Failure::work("the input's name is not UTF-8"))?;
    let sequence = Sequence::find(input)?;
    let frames = match &args.frames {
        Some(selection) => sequence.select(selection)?,
        None => sequence.frames().to_vec(),
    };
    let mut looked_at = Vec::new();
    for at in sampled(frames.len(), None) {
        let grid = volume_file::read(&frames[at].path, &args.grid)?;
        grid.check_density(&frames[at].path)?;
        looked_at.push((frames[at].number, survey(&unbaked(&grid), stage, None)));
    }
    planned(&args.input, frames.len(), looked_at, &[], goal, args.threads)
}

fn survey(frame: &Frame, stage: &Stage, fit_error: Option<f64>) -> Survey {
    Survey::of(frame, &stage.medium, &stage.lights, &stage.camera, fit_error)
}

/// A volume as a frame without Gaussians.
fn unbaked(grid: &DensityGrid) -> Frame {
    let field = DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index);
    let unit = UnitSpace::of_box(grid.origin, grid.dims.map(|d| d as u32));
    let first_node = grid.origin.map(|o| o.saturating_sub(1));
    Frame { field, gaussians: Vec::new(), unit, first_node, world_from_index: grid.world_from_index, transfer: None }
}

fn planned(
    path: &Path,
    frames: usize,
    looked_at: Vec<(i32, Survey)>,
    voxels: &[u64],
    goal: Goal,
    threads: Option<usize>,
) -> Result<Planned, Failure> {
    let (sampled, surveys): (Vec<i32>, Vec<Survey>) = looked_at.into_iter().unzip();
    let Some(at) = thickest(&surveys) else {
        return Err(Error::invalid(path, "frames", "none", "at least 1 to plan for").into());
    };
    let over_time = OverTime::of(&surveys, voxels);
    let survey = surveys[at].clone();
    let plan = choose(&survey, goal, threads.unwrap_or(THREADS), &MEASURED);
    Ok(Planned { frames, thickest: sampled[at], sampled, survey, over_time, plan })
}

/// Whether the file there begins as a pack does; a pattern is no file.
fn is_pack(path: &Path) -> Result<bool, Error> {
    if !path.is_file() {
        return Ok(false);
    }
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| Error::io(path, e))?;
    file.take(MAGIC.len() as u64).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
    let named = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("smoke"));
    // A damaged head goes by the name, so that the error is the one of a pack.
    Ok(head == MAGIC || named)
}
