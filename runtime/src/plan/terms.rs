//! Which terms of the full solution a scene does not need, each with its reason and the numbers behind it.
//!
//! Multiple scattering: light that scattered n + 1 times is at most `albedo P` times as bright as that of n times, with P
//! the largest probability that light scatters again before it leaves. From the middle of a ray of depth tau that is
//! `1 - e^(-tau/2)`; with the 95th percentile of tau the sum over all orders is at most about `q / (1 - q)` of the single
//! scattering, `q = albedo (1 - e^(-tau/2))`. It is an estimate from above: light leaves sooner along shorter ways.

use super::Survey;
use super::ladder::Rung;
use crate::transport::medium::PLAIN_LIMIT;

/// Multiple scattering below this share of the single cannot be seen, and is left out even where no error was asked.
pub const NOTHING: f64 = 2e-3;

/// One term.
#[derive(Clone, Debug, PartialEq)]
pub struct Term {
    /// What it is.
    pub name: &'static str,
    /// Whether the plan leaves it out.
    pub left_out: bool,
    /// Why, or why not, with numbers.
    pub why: String,
}

/// The estimate of the module's head: multiple over single scattering, the largest of the channels; infinite at albedo 1
/// and infinite depth.
pub fn multiple_over_single(survey: &Survey) -> f64 {
    let (depth, albedo) = (survey.medium.depth_p95(), survey.medium.parameters.albedo);
    let ratio = |c: usize| {
        let q = f64::from(albedo[c]) * -(-0.5 * depth[c]).exp_m1();
        q / (1.0 - q)
    };
    [0, 1, 2].map(ratio).into_iter().fold(0.0, f64::max)
}

/// All terms, for a plan that chose `rung`.
///
/// `without_multiple` is the predicted error of single scattering alone, if it was predicted.
pub fn terms(survey: &Survey, rung: &Rung, without_multiple: Option<f64>) -> Vec<Term> {
    let term = |name, left_out, why| Term { name, left_out, why };
    let Some(settings) = rung.settings else {
        return vec![term("multiple scattering", false, "the reference traces all orders".to_owned())];
    };
    let medium = &survey.medium;
    let parameters = medium.parameters;
    let depth = medium.depth_p95().into_iter().fold(0.0, f64::max);
    let albedo = parameters.albedo.into_iter().fold(0.0, f32::max);
    let measured = without_multiple.map_or_else(String::new, |error| format!(", error without it {}", percent(error)));
    let bound = percent(multiple_over_single(survey));
    let g = parameters.g;
    let bands = settings.sh_order;
    let mut out = vec![
        term(
            "multiple scattering",
            rung.is_single(),
            format!("optical depth {depth:.3}, albedo {albedo:.3}: at most about {bound} of the single{measured}"),
        ),
        match g {
            0.0 => term("phase convolution", true, "g is 0".to_owned()),
            _ => term("phase convolution", false, format!("g is {g}: {bands} bands")),
        },
        match g > PLAIN_LIMIT {
            true => term("forward peak", false, format!("g is {g}, above {PLAIN_LIMIT}: beyond the bands")),
            false => term("forward peak", true, format!("g is at most {PLAIN_LIMIT}")),
        },
        match survey.light.visible {
            true => {
                let dilution = percent(survey.view.dilution);
                term("sky behind the smoke", false, format!("visible; beside it errors count {dilution}"))
            }
            false => term("sky behind the smoke", true, "not visible".to_owned()),
        },
        term("transfer bake", true, "the lights of the scene are solved for directly".to_owned()),
    ];
    if let Some(fit_error) = survey.fit_error {
        let rms = fit_error.sqrt();
        let why = format!("without it (--detail gaussians) densities are off by {} of their RMS", percent(rms));
        out.push(term("residual", false, why));
    }
    let fewer = "--half-resolution saves about half of the view pass, for 0.1 to 0.4 % of error";
    out.push(term("rays between pixels", settings.march.half_resolution, fewer.to_owned()));
    let grey = medium.is_grey() && survey.light.grey;
    let coloured = match (medium.is_grey(), survey.light.grey) {
        (true, true) => "medium and lights are grey: the three channels are equal",
        (false, _) => "the medium has a colour",
        (true, false) => "the light has a colour",
    };
    out.push(term("two of three channels", grey, coloured.to_owned()));
    out
}

/// A share in per cent: two significant digits below 10 %, whole above.
pub fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    match percent {
        p if !p.is_finite() => "without bound".to_owned(),
        p if p >= 9.95 => format!("{p:.0} %"),
        p if p >= 0.995 => format!("{p:.1} %"),
        p if p > 0.0 && p < 0.0095 => "below 0.01 %".to_owned(),
        p => format!("{p:.2} %"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ladder::{DEFAULT, REFERENCE, rung};
    use crate::plan::tests::survey;

    fn of(survey: &Survey, name: &str) -> Vec<Term> {
        terms(survey, &rung(name).unwrap(), Some(0.04))
    }

    fn term(terms: &[Term], name: &str) -> Term {
        terms.iter().find(|t| t.name == name).unwrap().clone()
    }

    #[test]
    fn the_estimate_of_multiple_scattering_has_its_limits() {
        let at = |depth: f64, albedo: f32| {
            let mut survey = survey(1.0, albedo, 0.0);
            survey.medium.column_p95 = depth;
            multiple_over_single(&survey)
        };
        // Thin: albedo tau / 2. Thick: albedo / (1 - albedo). Nothing scatters: nothing scatters twice.
        assert!((at(1e-4, 0.5) / 2.5e-5 - 1.0).abs() < 1e-3);
        assert!((at(1e4, 0.5) - 1.0).abs() < 1e-9);
        assert_eq!((at(1e4, 0.0), at(0.0, 1.0), at(1e4, 1.0)), (0.0, 0.0, f64::INFINITY));
    }

    #[test]
    fn terms_are_left_out_for_reasons_that_hold_and_kept_when_they_stop_holding() {
        let mut scene = survey(1.0, 0.9, 0.0);
        let plain = of(&scene, DEFAULT);
        let left = |terms: &[Term], name: &str| term(terms, name).left_out;
        assert!(left(&plain, "phase convolution") && left(&plain, "two of three channels"));
        assert!(left(&plain, "forward peak") && left(&plain, "sky behind the smoke"));
        assert!(!left(&plain, "multiple scattering") && left(&of(&scene, "single"), "multiple scattering"));
        assert!(term(&plain, "multiple scattering").why.ends_with("error without it 4.0 %"), "{plain:?}");
        scene.medium.parameters.g = 0.8;
        scene.medium.parameters.albedo[1] = 0.8;
        scene.light.visible = true;
        scene.fit_error = Some(0.04);
        let rich = of(&scene, DEFAULT);
        assert!(rich.iter().filter(|t| t.name != "transfer bake").all(|t| !t.left_out), "{rich:?}");
        assert!(term(&rich, "residual").why.contains("20 %"));
        assert!(term(&rich, "two of three channels").why.contains("medium"));
        assert!(of(&scene, REFERENCE).iter().all(|t| !t.left_out));
    }

    #[test]
    fn shares_are_written_with_two_digits() {
        let words = [0.5, 0.0123, 0.00123, 1e-6, 0.0, f64::INFINITY].map(percent);
        assert_eq!(words, ["50 %", "1.2 %", "0.12 %", "below 0.01 %", "0.00 %", "without bound"]);
    }
}
