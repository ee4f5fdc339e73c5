//! Which settings a sweep measures.
//!
//! By default a star: from the defaults of each method, one dial is turned at a time, so that d dials of v values cost
//! `1 + d v` points and not `v^d`. Methods are the values of `method` and `route`; a dial that a method refuses has no arm
//! in its star, and a dial that no swept method takes is tried on the other routes (`exponential` brings `route=centres`
//! with it). With `--grid` it is the full product, without the combinations that do not go together.

use super::options::{self, Options, Owner};
use crate::cli::Assignment;
use crate::failure::Failure;
use crate::method::Method;
use crate::staging::Stage;
use clap::error::ErrorKind;
use smoke_runtime::plan::ladder::Rung;

/// The options whose values are the methods.
const METHODS: [&str; 2] = ["method", "route"];

/// Name of the dial of a star's middle.
pub const DEFAULTS: &str = "defaults";

/// Name of the dial of a point of the full product.
pub const COMBINED: &str = "combined";

/// One point: settings, and which dial was turned to get there.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// The dial: an option's name, [`DEFAULTS`], [`COMBINED`] or [`super::rungs::DIAL`].
    pub dial: String,
    /// Its value as it was given; all values of a combined point; empty at the defaults.
    pub value: String,
    /// All options that are not at their default.
    pub options: Options,
    /// The rung of the plan whose dials it has, in place of those of the options.
    pub rung: Option<Rung>,
}

/// The points of a sweep around `base`.
///
/// # Errors
/// A value that its option does not take, as wrong usage of that option; a dial that applies nowhere.
pub fn expand(base: &Options, dials: &[Assignment], product: bool, stage: &Stage) -> Result<Vec<Point>, Failure> {
    if product { combine(base, dials, stage) } else { star(base, dials, stage) }
}

fn star(base: &Options, dials: &[Assignment], stage: &Stage) -> Result<Vec<Point>, Failure> {
    let check = |options: &Options| check(options, stage);
    let middle = |options| Point { dial: DEFAULTS.into(), value: String::new(), options, rung: None };
    let (methods, dials): (Vec<_>, Vec<_>) = dials.iter().cloned().partition(|d| METHODS.contains(&d.name.as_str()));
    let mut middles = combine(base, &methods, stage)?;
    middles.iter_mut().for_each(|point| *point = middle(point.options.clone()));
    let swept = middles.len();
    let mut arms = Vec::new();
    for dial in &dials {
        for value in &dial.values {
            let arm = |from: &Point| Point {
                dial: dial.name.clone(),
                value: value.clone(),
                options: from.options.with(&dial.name, value),
                rung: None,
            };
            let before = arms.len();
            let mut refused = None;
            for from in &middles[..swept] {
                let point = arm(from);
                match check(&point.options) {
                    Ok(()) => arms.push(point),
                    Err(failure) => refused = refused.or(Some(conflict(failure)?)),
                }
            }
            if arms.len() > before {
                continue;
            }
            let routes = options::possible_values("route").into_iter();
            let mut others = routes.map(|route| middle(base.with("route", &route)));
            let other = others.find(|other| check(&arm(other).options).is_ok());
            match (other, refused) {
                (Some(other), _) => {
                    arms.push(arm(&other));
                    if !middles.contains(&other) {
                        middles.push(other);
                    }
                }
                (None, Some(conflict)) => return Err(conflict.into()),
                (None, None) => {}
            }
        }
    }
    middles.extend(arms);
    Ok(middles)
}

fn combine(base: &Options, dials: &[Assignment], stage: &Stage) -> Result<Vec<Point>, Failure> {
    let mut all = vec![(Vec::new(), base.clone())];
    for dial in dials {
        let turned = |(words, options): &(Vec<String>, Options)| -> Vec<(Vec<String>, Options)> {
            let value = |value: &String| {
                let words = words.iter().cloned().chain([format!("{}={value}", dial.name)]);
                (words.collect(), options.with(&dial.name, value))
            };
            dial.values.iter().map(value).collect()
        };
        all = all.iter().flat_map(turned).collect();
    }
    let mut points = Vec::new();
    let mut refused = None;
    for (words, options) in all {
        match check(&options, stage) {
            Ok(()) => points.push(Point { dial: COMBINED.into(), value: words.join(" "), options, rung: None }),
            Err(failure) => refused = refused.or(Some(conflict(failure)?)),
        }
    }
    match (points.is_empty(), refused) {
        (true, Some(conflict)) => Err(conflict.into()),
        _ => Ok(points),
    }
}

/// Whether the options parse, and apply to each other.
fn check(options: &Options, stage: &Stage) -> Result<(), Failure> {
    Method::choose(&options.render()?, stage)?;
    options.bake("volumes".as_ref(), "pack".as_ref(), "1", false).map(|_| ())
}

/// What the parser says, if it is only that two options do not go together; else the failure, which ends the sweep.
pub fn conflict(failure: Failure) -> Result<clap::Error, Failure> {
    match failure {
        Failure::Usage(e) if e.kind() == ErrorKind::ArgumentConflict => Ok(e),
        other => Err(other),
    }
}

/// The dials of a sweep that names none: every one that trades accuracy for speed or size, with a few values to either
/// side of its default. Bake dials only if the input is volumes, whose largest density is `density_max`.
pub fn usual(density_max: Option<f32>) -> Vec<Assignment> {
    let mut dials = vec![
        ("route", "grid,centres".to_owned()),
        ("order", "single".into()),
        ("sh-order", "1,2,3,6".into()),
        ("beams", "16,256".into()),
        ("source-step", "2,4".into()),
        ("scatter-step", "1,4,8".into()),
        ("scatter-rings", "3,8".into()),
        ("march-step", "0.5,2,4".into()),
        ("cutoff", "0.01,0.05,0.2".into()),
        ("exponential", "pointwise,hybrid,linear".into()),
        ("multiple", "diffusion".into()),
        ("samples", "2".into()),
        ("half-resolution", "true".into()),
        ("detail", "gaussians".into()),
        ("threads", "1".into()),
    ];
    if let Some(peak) = density_max {
        // The default promise is the peak over 510.
        let peak = if peak > 0.0 { peak } else { 1.0 };
        // Two digits, as a person would write it.
        let part = |by: f32| format!("{:.1e}", peak / by).parse::<f32>().unwrap_or(peak);
        dials.push(("gaussians", "100,300".into()));
        dials.push(("max-error", format!("{},{},{}", part(2000.0), part(100.0), part(30.0))));
    }
    let split = |(name, values): (&str, String)| Assignment {
        name: name.into(),
        values: values.split(',').map(str::to_owned).collect(),
    };
    dials.into_iter().map(split).collect()
}

/// Fails if a dial is no option, is given twice, or is one of `bake` although the input is a pack.
pub fn check_names(option: &str, given: &[Assignment], pack: Option<&std::path::Path>) -> Result<(), Failure> {
    for (i, assignment) in given.iter().enumerate() {
        let name = assignment.name.as_str();
        let Some(owner) = options::owner(name) else {
            let known = options::dials();
            return Err(options::unknown(option, name, &known.iter().map(String::as_str).collect::<Vec<_>>()));
        };
        if given[..i].iter().any(|other| other.name == name) {
            let text = format!("{option} {name}: given twice; put all values into one\n");
            return Err(clap::Error::raw(ErrorKind::ArgumentConflict, text).into());
        }
        if let (Owner::Bake, Some(pack)) = (owner, pack) {
            let pack = pack.display();
            let hint = "expected an option of render, for a pack is baked already; give the volumes instead";
            return Err(Failure::work(format!("{pack}: {option} {name}: found an option of bake, {hint}")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stage;

    fn dials(text: &[&str]) -> Vec<Assignment> {
        let dial = |text: &&str| {
            let (name, values) = text.split_once('=').unwrap();
            Assignment { name: name.into(), values: values.split(',').map(str::to_owned).collect() }
        };
        text.iter().map(dial).collect()
    }

    fn names(points: &[Point]) -> Vec<String> {
        let name = |p: &Point| {
            let options: Vec<_> = p.options.iter().map(|(name, value)| format!("{name}={value}")).collect();
            format!("{}:{}:{}", p.dial, p.value, options.join("+"))
        };
        points.iter().map(name).collect()
    }

    fn expanded(text: &[&str], product: bool) -> Vec<String> {
        names(&expand(&Options::default(), &dials(text), product, &stage()).unwrap_or_else(|_| panic!("{text:?}")))
    }

    #[test]
    fn a_star_turns_one_dial_at_a_time_around_the_defaults() {
        let expected = [
            "defaults::",
            "sh-order:1:sh-order=1",
            "sh-order:2:sh-order=2",
            "cutoff:0.1:cutoff=0.1",
            "gaussians:50:gaussians=50",
        ];
        assert_eq!(expanded(&["sh-order=1,2", "cutoff=0.1", "gaussians=50"], false), expected);
        assert_eq!(expanded(&[], false), ["defaults::"]);
    }

    #[test]
    fn each_method_has_a_star_of_the_dials_that_it_takes() {
        let expected = [
            "defaults::route=grid",
            "defaults::route=centres",
            "sh-order:2:route=grid+sh-order=2",
            "sh-order:2:route=centres+sh-order=2",
            "beams:16:route=grid+beams=16",
        ];
        assert_eq!(expanded(&["route=grid,centres", "sh-order=2", "beams=16"], false), expected);
    }

    #[test]
    fn a_dial_of_another_method_brings_that_method_and_its_defaults() {
        let expected = [
            "defaults::",
            "defaults::route=centres",
            "exponential:linear:route=centres+exponential=linear",
            "exponential:hybrid:route=centres+exponential=hybrid",
        ];
        assert_eq!(expanded(&["exponential=linear,hybrid"], false), expected);
    }

    #[test]
    fn the_product_leaves_out_what_does_not_go_together() {
        let found = expanded(&["route=grid,centres", "beams=8,16", "sh-order=2"], true);
        let expected = [
            "combined:route=grid beams=8 sh-order=2:route=grid+beams=8+sh-order=2",
            "combined:route=grid beams=16 sh-order=2:route=grid+beams=16+sh-order=2",
        ];
        assert_eq!(found, expected);
        assert_eq!(expanded(&["sh-order=1,2", "cutoff=0,0.1", "samples=1,2,3"], true).len(), 12);
    }

    #[test]
    fn a_value_out_of_range_or_a_dial_that_applies_nowhere_is_wrong_usage() {
        for (text, product) in [
            (&["sh-order=2,9"][..], false),
            (&["sh-order=2,9"], true),
            (&["scatter-order=6"], false),
            (&["scatter-order=6"], true),
            (&["route=nowhere"], false),
            (&["max-error=-1"], false),
        ] {
            let failure = expand(&Options::default(), &dials(text), product, &stage());
            assert!(matches!(failure, Err(Failure::Usage(_))), "{text:?}");
        }
    }

    #[test]
    fn names_are_checked_and_a_pack_takes_no_dial_of_bake() {
        assert!(check_names("--dial", &dials(&["sh-order=1", "gaussians=5"]), None).is_ok());
        assert!(matches!(check_names("--dial", &dials(&["shorder=1"]), None), Err(Failure::Usage(_))));
        assert!(matches!(check_names("--dial", &dials(&["g=1"]), None), Err(Failure::Usage(_))));
        assert!(matches!(check_names("--dial", &dials(&["sh-order=1", "sh-order=2"]), None), Err(Failure::Usage(_))));
        let pack = std::path::Path::new("a.smoke");
        match check_names("--dial", &dials(&["gaussians=5"]), Some(pack)) {
            Err(Failure::Work(line)) => assert!(line.starts_with("a.smoke: --dial gaussians: "), "{line}"),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_usual_dials_all_apply_and_those_of_bake_follow_the_density() {
        let render_only = usual(None);
        let all = usual(Some(0.5));
        assert!(check_names("--dial", &render_only, Some("a.smoke".as_ref())).is_ok());
        assert_eq!(all.len(), render_only.len() + 2);
        assert_eq!(all.last().unwrap().values, ["0.00025", "0.005", "0.017"]);
        let points = expand(&Options::default(), &all, false, &stage()).unwrap();
        for dial in &all {
            assert!(dial.name == "route" || points.iter().any(|p| p.dial == dial.name), "{}", dial.name);
        }
        assert!(usual(Some(0.0)).last().unwrap().values.iter().all(|v| v.parse::<f64>().unwrap() > 0.0));
    }
}
