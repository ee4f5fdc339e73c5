//! The rungs of the plan as points of a sweep, and what was measured of them as the plan's table.
//!
//! A rung is a method with all its dials, so it is no combination of options: it goes into the renderer as it is. The
//! table's row of the reference is the reference's own run: the noise that it ended with, and its seconds.

use super::options::{self, Options, Owner};
use super::points::Point;
use super::setting::Setting;
use super::table::{Figures, ReferenceFigures};
use crate::cli::{ALL_RUNGS, SweepArgs};
use crate::failure::Failure;
use crate::method::does_not_apply;
use serde_json::Value;
use smoke_formats::pack::Pack;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::plan::Survey;
use smoke_runtime::plan::ladder::{REFERENCE, Rung, ladder, rung};
use smoke_runtime::plan::light_survey::LightSurvey;
use smoke_runtime::plan::table::{HEADER, Row};

/// Name of the dial of a rung's point.
pub const DIAL: &str = "rung";

/// The points of the rungs that `args` names, in the ladder's order; the reference's is no point, see [`Rows`].
///
/// # Errors
/// Options of `render` beside the rungs, which have all their dials; scenes that the table has no place for.
pub fn points(args: &SweepArgs, base: &Options, settings: &[Setting]) -> Result<Vec<Point>, Failure> {
    let of_render = args.set.iter().find(|set| options::owner(&set.name) == Some(Owner::Render));
    does_not_apply(of_render.is_some(), &format!("--set {}", of_render.map_or("", |set| &set.name)), "--ladder")?;
    does_not_apply(settings.iter().any(|s| s.orders.is_some()), "--vary order", "--ladder")?;
    for setting in settings {
        let (medium, lights) = (&setting.stage.medium, &setting.stage.lights);
        let refuse = |field: &str, found: &str, expected: &str| {
            let scene = setting.scene.display();
            Err(Failure::work(format!("{scene}: {field}: found {found}, expected {expected} for --ladder")))
        };
        let grey = |v: [f32; 3]| v[0] == v[1] && v[0] == v[2];
        if !(grey(medium.sigma_t) && grey(medium.albedo)) {
            return refuse("medium", "a coloured one", "the same sigma_t and albedo in all channels");
        }
        if LightSurvey::of(lights).visible {
            return refuse("light", "a visible sky", "visible = false, as errors are those of the smoke");
        }
    }
    let point =
        |rung: Rung| Point { dial: DIAL.into(), value: rung.name.into(), options: base.clone(), rung: Some(rung) };
    Ok(chosen(args).filter(|rung| rung.settings.is_some()).map(point).collect())
}

fn chosen(args: &SweepArgs) -> impl Iterator<Item = Rung> {
    ladder().into_iter().filter(|rung| args.ladder.iter().any(|name| name == ALL_RUNGS || name == rung.name))
}

/// The survey of the frame at `position` of `pack` under `setting`.
pub fn survey(pack: &Pack, position: usize, setting: &Setting) -> Result<Survey, Failure> {
    let stage = &setting.stage;
    Ok(Survey::of(&Frame::read(pack, position)?, &stage.medium, &stage.lights, &stage.camera, None))
}

/// Rows of the plan's table, as they are measured.
#[derive(Default)]
pub struct Rows(Vec<Row>);

impl Rows {
    /// Adds what was measured of the rung called `name` in the scene of `survey`; `scene` is its name in the table.
    pub fn push(&mut self, scene: &str, survey: &Survey, name: &str, figures: &Figures) {
        let Some(rung) = rung(name) else { return };
        let stage = |name: &str| figures.seconds.stages.get(name).and_then(Value::as_f64).unwrap_or(0.0);
        let seconds = ["source_radiance", "volume_pass", "view_pass"].map(stage);
        let threads = figures.settings["threads"].as_u64().unwrap_or(1) as usize;
        self.0.push(Row::new(scene, survey, &rung, figures.relative_rmse, seconds, threads));
    }

    /// Adds the reference's own row, if `args` names that rung.
    pub fn push_reference(
        &mut self,
        args: &SweepArgs,
        scene: &str,
        survey: &Survey,
        figures: &ReferenceFigures,
        threads: usize,
    ) {
        if let Some(rung) = chosen(args).find(|rung| rung.name == REFERENCE) {
            let seconds = [0.0, 0.0, figures.seconds];
            self.0.push(Row::new(scene, survey, &rung, figures.relative_standard_error, seconds, threads));
        }
    }

    /// The table: its line of names, and the rows by rung in the ladder's order.
    pub fn csv(&self) -> String {
        let of = |rung: Rung| self.0.iter().filter(move |row| row.rung == rung.name).map(|row| format!("{row}\n"));
        format!("{HEADER}\n") + &ladder().into_iter().flat_map(of).collect::<String>()
    }
}
