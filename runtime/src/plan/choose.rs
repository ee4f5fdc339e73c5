//! The choice: the cheapest rung that is predicted to meet an error, or the best that fits a time.
//!
//! An error counts as met if the predicted one times [`MARGIN`] is below it, or [`LOOSE_MARGIN`] where predictions are
//! known to hold less. If no rung of the fast methods meets it, the
//! reference is traced until its noise does. A time is met if the predicted seconds are below it; of the rungs that meet
//! it, the reference among them, the one of least error is taken. If neither is asked, it is the default rung, and the
//! reference only where nothing else can serve.
//! Baked transfer is told of, and never chosen: whether it pays to bake is not for one image to say ([`TransferOutlook`]).
//! Seconds come from the table and the given count of threads, never from a clock: the same call makes the same choice.

use super::Survey;
use super::ladder::{DEFAULT, REFERENCE, Rung, TRANSFER, ladder};
use super::methods::refusal;
use super::table::{Prediction, Table};
use super::terms::{NOTHING, Term, multiple_over_single, percent, terms};
use super::transfer::TransferOutlook;
use crate::renderer::{RenderError, RenderSettings, Route};
use crate::transport::ScatteringOrder;

/// Factor by which a predicted error must stay below the one asked: predictions are right to a factor of 2, and mostly
/// to this (see `docs/decisions/033-plan.md`).
pub const MARGIN: f64 = 1.5;
/// The same where the angle between view and light decides, which the table has no axis for: strong peaks (|g| from
/// [`STRONG`]) under directional light, and rungs with one band of multiple scattering from |g| = [`BANDED`] on. Held
/// measurements of both are within this factor (`runtime/tests/plan_predictions.rs`, but for one row at 4.1).
pub const LOOSE_MARGIN: f64 = 4.0;
/// |g| and directionality from which a peak is strong and light directional.
const STRONG: f64 = 0.5;
/// |g| from which one band is few.
const BANDED: f64 = 0.2;
/// Rungs whose predicted seconds differ by less than this factor cost the same: the coarser one is taken.
const SAME_SECONDS: f64 = 1.3;
/// Error that the reference is traced to where none is asked: its own default.
pub const REFERENCE_ERROR: f64 = 0.02;
/// Least and most error that the reference is asked for.
const REFERENCE_RANGE: [f64; 2] = [1e-4, 1.0];

/// What is wanted of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Goal {
    /// The best that is fast.
    #[default]
    Best,
    /// A relative RMSE, above 0, over the pixels with smoke.
    Error(f64),
    /// Seconds a frame, above 0.
    Time(f64),
}

/// A rung with what is predicted of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The rung.
    pub rung: Rung,
    /// Why it cannot serve, if it cannot.
    pub refused: Option<RenderError>,
    /// Its predicted error and seconds, unless it cannot serve or was not measured.
    pub prediction: Option<Prediction>,
}

impl Candidate {
    fn error(&self) -> f64 {
        self.prediction.map_or(f64::INFINITY, |p| p.error)
    }

    fn seconds(&self) -> f64 {
        self.prediction.map_or(f64::INFINITY, |p| p.seconds.iter().sum())
    }
}

/// How the frames are to be rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Settings {
    /// By the compensated method with these dials.
    Compensated(RenderSettings),
    /// By the reference, until its relative standard error is below this.
    Reference {
        /// Relative standard error of the image.
        target_error: f64,
    },
}

/// What was chosen and why.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// What was asked.
    pub goal: Goal,
    /// All rungs, in the ladder's order; the reference at the error or in the time that is asked.
    pub candidates: Vec<Candidate>,
    /// Which of them was chosen.
    pub chosen: usize,
    /// Its dials.
    pub settings: Settings,
    /// Why, in half a sentence.
    pub why: String,
    /// The terms that it leaves out and those that it keeps.
    pub terms: Vec<Term>,
    /// What a bake of transfer costs and brings, if transfer can serve.
    pub transfer: Option<TransferOutlook>,
}

impl Plan {
    /// The rung that was chosen.
    pub fn candidate(&self) -> &Candidate {
        &self.candidates[self.chosen]
    }

    /// One line: what was chosen, what was left out and why.
    pub fn sentence(&self) -> String {
        let candidate = self.candidate();
        let error =
            candidate.prediction.map_or_else(String::new, |p| format!("; predicted error {}", percent(p.error)));
        let left: Vec<String> =
            self.terms.iter().filter(|t| t.left_out).map(|t| format!("{} ({})", t.name, t.why)).collect();
        let left = if left.is_empty() { "nothing".to_owned() } else { left.join(", ") };
        format!("{}: {}{error}; left out: {left}", candidate.rung.name, self.why)
    }
}

/// Chooses for the scene of `survey`, by the predictions of `table` for `threads`.
pub fn choose(survey: &Survey, goal: Goal, threads: usize, table: &Table) -> Plan {
    let candidate = |rung: Rung| {
        let refused = refusal(rung.method(), survey);
        let prediction = if refused.is_some() { None } else { table.predict(&rung, survey, threads) };
        let prediction = match rung.name {
            REFERENCE => prediction.map(|p| reference(p, goal)),
            _ => prediction,
        };
        Candidate { rung, refused, prediction }
    };
    let candidates: Vec<Candidate> = ladder().into_iter().map(candidate).collect();
    let (chosen, why) = match goal {
        Goal::Best => best(survey, &candidates),
        Goal::Error(error) => for_error(survey, &candidates, error),
        Goal::Time(seconds) => for_time(&candidates, seconds),
    };
    let rung = candidates[chosen].rung;
    let settings = match (rung.settings_for(survey), goal) {
        (Some(settings), _) => Settings::Compensated(settings),
        (None, Goal::Error(error)) => Settings::Reference { target_error: error },
        (None, _) => {
            let error = candidates[chosen].prediction.map_or(REFERENCE_ERROR, |p| p.error);
            Settings::Reference { target_error: error }
        }
    };
    let single = candidates.iter().find(|c| c.rung.name == "single").and_then(|c| c.prediction);
    let terms = terms(survey, &rung, single.map(|p| p.error));
    let transfer = candidates[position(&candidates, TRANSFER)]
        .prediction
        .map(|predicted| TransferOutlook::of(survey, &predicted, candidates[chosen].seconds(), threads));
    Plan { goal, candidates, chosen, settings, why, terms, transfer }
}

/// The reference at the error that is asked, or at the one it reaches in the time: its seconds go as error^-2.
fn reference(measured: Prediction, goal: Goal) -> Prediction {
    let all: f64 = measured.seconds.iter().sum();
    let wanted = match goal {
        Goal::Best => REFERENCE_ERROR,
        Goal::Error(error) => error,
        Goal::Time(seconds) => measured.error * (all / seconds).sqrt(),
    };
    let error = wanted.clamp(REFERENCE_RANGE[0], REFERENCE_RANGE[1]);
    let factor = (measured.error / error).powi(2);
    Prediction { error, seconds: measured.seconds.map(|s| s * factor) }
}

fn position(candidates: &[Candidate], name: &str) -> usize {
    candidates.iter().position(|c| c.rung.name == name).expect("a test holds that the ladder has this rung")
}

/// Why only the reference is left.
fn only_reference(candidates: &[Candidate]) -> String {
    let refused = candidates.iter().find_map(|c| c.refused.as_ref()).map_or_else(String::new, |e| format!(" ({e})"));
    format!("no fast method can serve{refused}")
}

fn best(survey: &Survey, candidates: &[Candidate]) -> (usize, String) {
    let default = position(candidates, DEFAULT);
    let ratio = multiple_over_single(survey);
    if candidates[default].refused.is_none() {
        return match ratio < NOTHING {
            true => {
                let why = format!("multiple scattering is below {} of the single", percent(NOTHING));
                (position(candidates, "single"), why)
            }
            false => (default, "the default, as no error and no time is asked".to_owned()),
        };
    }
    let centres = position(candidates, "centres");
    match candidates[centres].refused {
        None => (centres, candidates[default].refused.as_ref().map(ToString::to_string).unwrap_or_default()),
        Some(_) => (position(candidates, REFERENCE), only_reference(candidates)),
    }
}

/// By how much a rung's prediction must stay below the error asked.
fn margin(survey: &Survey, rung: &Rung) -> f64 {
    let g = f64::from(survey.medium.parameters.g).abs();
    let one_band = match rung.settings.map(|s| (s.scattering, s.route)) {
        Some((ScatteringOrder::All, Route::Grid(grid))) => grid.multiple_order == 1,
        _ => false,
    };
    let strong = g >= STRONG && survey.light.directionality() >= STRONG;
    if strong || (one_band && g >= BANDED) { LOOSE_MARGIN } else { MARGIN }
}

fn for_error(survey: &Survey, candidates: &[Candidate], error: f64) -> (usize, String) {
    let fast = |i: &usize| candidates[*i].rung.is_fast();
    let meets = |i: &usize| candidates[*i].error() * margin(survey, &candidates[*i].rung) <= error;
    let by_seconds = |a: &usize, b: &usize| candidates[*a].seconds().total_cmp(&candidates[*b].seconds());
    let cheapest = (0..candidates.len()).filter(fast).filter(meets).min_by(by_seconds);
    if let Some(cheapest) = cheapest {
        let most = candidates[cheapest].seconds() * SAME_SECONDS;
        // The ladder goes from coarse to fine.
        let mut as_cheap =
            (0..candidates.len()).filter(fast).filter(meets).filter(|i| candidates[*i].seconds() <= most);
        let cheapest = as_cheap.next().unwrap_or(cheapest);
        return (cheapest, format!("the cheapest predicted to meet {}", percent(error)));
    }
    let by_error = |a: &usize, b: &usize| candidates[*a].error().total_cmp(&candidates[*b].error());
    let nearest = (0..candidates.len()).filter(fast).filter(|i| candidates[*i].prediction.is_some()).min_by(by_error);
    let why = match nearest {
        None => only_reference(candidates),
        Some(nearest) => {
            let Candidate { rung, .. } = &candidates[nearest];
            let predicted = percent(candidates[nearest].error());
            format!("{} asked, and of the fast methods {} comes nearest with {predicted}", percent(error), rung.name)
        }
    };
    (position(candidates, REFERENCE), why)
}

fn for_time(candidates: &[Candidate], seconds: f64) -> (usize, String) {
    let serves = |i: &usize| candidates[*i].prediction.is_some() && candidates[*i].rung.name != TRANSFER;
    let fits = |i: &usize| candidates[*i].seconds() <= seconds * (1.0 + 1e-9);
    let order = |a: f64, b: f64, c: f64, d: f64| a.total_cmp(&b).then(c.total_cmp(&d));
    let by_error = |a: &usize, b: &usize| {
        let (a, b) = (&candidates[*a], &candidates[*b]);
        order(a.error(), b.error(), a.seconds(), b.seconds())
    };
    let fast = |i: &usize| candidates[*i].rung.is_fast();
    let by_seconds = |a: &usize, b: &usize| candidates[*a].seconds().total_cmp(&candidates[*b].seconds());
    if let Some(best) = (0..candidates.len()).filter(serves).filter(fits).min_by(by_error) {
        let predicted = candidates[best].seconds();
        return (best, format!("of what fits {seconds} s the one of least error, {predicted:.3} s predicted"));
    }
    match (0..candidates.len()).filter(serves).filter(fast).min_by(by_seconds) {
        Some(cheapest) => {
            let predicted = candidates[cheapest].seconds();
            (cheapest, format!("nothing fits {seconds} s; the cheapest, {predicted:.3} s predicted"))
        }
        None => (position(candidates, REFERENCE), only_reference(candidates)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::table::HEADER;
    use crate::plan::tests::survey;

    /// Errors and seconds of four rungs, the same in every scene.
    fn table(rows: &[(&str, f64, f64)]) -> Table {
        let row = |(rung, error, seconds): &(&str, f64, f64)| {
            let survey = survey(1.0, 0.9, 0.0);
            let rung = crate::plan::ladder::rung(rung).unwrap();
            super::super::table::Row::new("x", &survey, &rung, *error, [0.0, 0.0, *seconds], 1).to_string()
        };
        let rows: Vec<String> = rows.iter().map(row).collect();
        Table::parse(&format!("{HEADER}\n{}", rows.join("\n"))).unwrap()
    }

    fn four() -> Table {
        table(&[("single", 0.2, 0.1), ("default", 0.02, 0.5), ("fine", 0.01, 5.0), ("reference", 0.02, 50.0)])
    }

    fn chosen(goal: Goal) -> (&'static str, Settings) {
        let plan = choose(&survey(1.0, 0.9, 0.0), goal, 1, &four());
        (plan.candidate().rung.name, plan.settings)
    }

    #[test]
    fn an_error_gets_the_cheapest_rung_that_meets_it_with_the_margin_or_the_reference() {
        for (error, rung) in
            [(0.5, "single"), (0.2, "default"), (0.031, "default"), (0.029, "fine"), (0.014, REFERENCE)]
        {
            assert_eq!(chosen(Goal::Error(error)).0, rung, "{error}");
        }
        assert_eq!(chosen(Goal::Error(0.014)).1, Settings::Reference { target_error: 0.014 });
        let plan = choose(&survey(1.0, 0.9, 0.0), Goal::Error(0.01), 1, &four());
        // Half the error costs four times the time.
        assert!((plan.candidate().seconds() - 200.0).abs() < 0.1);
        assert!(plan.why.contains("fine comes nearest with 1.0 %"), "{}", plan.why);
    }

    #[test]
    fn where_predictions_hold_less_the_margin_is_larger() {
        let table = table(&[("draft", 0.01, 0.1), ("default", 0.02, 0.5), ("reference", 0.02, 50.0)]);
        let rung = |g: f64, error: f64| {
            choose(&survey(1.0, 0.9, g as f32), Goal::Error(error), 1, &table).candidate().rung.name
        };
        assert_eq!((rung(0.0, 0.016), rung(0.3, 0.016), rung(0.3, 0.031)), ("draft", REFERENCE, "default"));
        assert_eq!(rung(0.3, 0.041), "draft");
    }

    #[test]
    fn of_rungs_that_cost_about_the_same_the_coarser_is_taken() {
        let rung = |seconds: f64| {
            let table = table(&[("sketch", 0.02, seconds), ("draft", 0.01, 0.5)]);
            choose(&survey(1.0, 0.9, 0.0), Goal::Error(0.05), 1, &table).candidate().rung.name
        };
        assert_eq!((rung(0.6), rung(0.7)), ("sketch", "draft"));
    }

    #[test]
    fn a_time_gets_the_least_error_that_fits_and_the_reference_when_there_is_time_for_it() {
        for (seconds, rung) in [(0.01, "single"), (0.2, "single"), (0.6, "default"), (6.0, "fine"), (400.0, REFERENCE)]
        {
            assert_eq!(chosen(Goal::Time(seconds)).0, rung, "{seconds}");
        }
        let (_, settings) = chosen(Goal::Time(5000.0));
        let Settings::Reference { target_error } = settings else { panic!("{settings:?}") };
        assert!((target_error - 0.002).abs() < 1e-6);
    }

    #[test]
    fn without_a_goal_the_default_serves_unless_it_cannot_or_has_nothing_to_add() {
        assert_eq!(chosen(Goal::Best), (DEFAULT, Settings::Compensated(RenderSettings::default())));
        let mut scene = survey(1.0, 0.9, 0.0);
        scene.medium.column_p95 = 1e-3;
        assert_eq!(choose(&scene, Goal::Best, 1, &four()).candidate().rung.name, "single");
        scene.medium.dims = [1 << 20, 3, 3];
        assert_eq!(choose(&scene, Goal::Best, 1, &four()).candidate().rung.name, "centres");
        scene.light.points = vec![0];
        for goal in [Goal::Best, Goal::Error(0.05), Goal::Time(1.0)] {
            let plan = choose(&scene, goal, 1, &four());
            assert_eq!(plan.candidate().rung.name, REFERENCE, "{goal:?}");
            assert!(!plan.sentence().contains('\n') && plan.sentence().starts_with("reference"));
        }
        let plan = choose(&scene, Goal::Best, 1, &four());
        assert!(plan.why.contains("light[0]: found a point"), "{}", plan.why);
        assert_eq!(plan.settings, Settings::Reference { target_error: REFERENCE_ERROR });
    }

    #[test]
    fn transfer_is_told_of_where_it_can_serve_and_never_chosen_however_good_it_is() {
        let table = table(&[("default", 0.02, 0.5), ("transfer", 0.002, 0.01), ("reference", 0.01, 90.0)]);
        let mut scene = survey(1.0, 0.9, 0.0);
        for goal in [Goal::Best, Goal::Error(0.003), Goal::Error(0.05), Goal::Time(0.2), Goal::Time(1e3)] {
            let plan = choose(&scene, goal, 1, &table);
            assert_ne!(plan.candidate().rung.name, TRANSFER, "{goal:?}");
            let outlook = plan.transfer.unwrap();
            assert!((outlook.error / 0.002 - 1.0).abs() < 1e-6, "{goal:?} {outlook:?}");
            assert!(!outlook.is_baked && outlook.pays_from.is_some(), "{goal:?} {outlook:?}");
        }
        scene.transfer = Some(scene.medium.parameters);
        assert!(choose(&scene, Goal::Best, 1, &table).transfer.unwrap().is_baked);
        scene.medium.parameters.albedo[2] = 0.8;
        assert_eq!(choose(&scene, Goal::Best, 1, &table).transfer, None);
        scene.transfer = None;
        scene.light.points = vec![0];
        assert_eq!(choose(&scene, Goal::Best, 1, &table).transfer, None);
    }

    #[test]
    fn rungs_that_were_not_measured_are_never_chosen_for_an_error() {
        let plan = choose(&survey(1.0, 0.9, 0.0), Goal::Error(0.3), 1, &table(&[("default", 0.02, 0.5)]));
        assert_eq!(plan.candidate().rung.name, DEFAULT);
        let none = choose(&survey(1.0, 0.9, 0.0), Goal::Error(0.01), 1, &table(&[("default", 0.02, 0.5)]));
        assert_eq!(none.settings, Settings::Reference { target_error: 0.01 });
    }
}
