//! A plan in words, and as JSON.

use super::Planned;
use serde_json::{Value, json};
use smoke_runtime::plan::Survey;
use smoke_runtime::plan::choose::{Candidate, Goal, Settings};
use smoke_runtime::plan::light_survey::LightSurvey;
use smoke_runtime::plan::methods::METHODS;
use smoke_runtime::plan::over_time::Range;
use smoke_runtime::plan::terms::percent;
use smoke_runtime::plan::transfer::TransferOutlook;
use std::fmt::Write;
use std::path::Path;

/// The report on a terminal.
pub fn as_text(input: &Path, planned: &Planned) -> String {
    let Planned { frames, sampled, thickest, survey, over_time, plan } = planned;
    let numbers: Vec<String> = sampled.iter().map(ToString::to_string).collect();
    let mut out = format!(
        "{}: {frames} frames, of which {} were looked at; the plan is for {thickest}, the thickest\n\nsurvey\n",
        input.display(),
        numbers.join(", "),
    );
    // Writing to a String cannot fail, here and below.
    let mut line = |name: &str, words: String| {
        let _ = writeln!(out, "  {name:<15} {words}");
    };
    let medium = &survey.medium;
    let [nx, ny, nz] = medium.dims.map(|n| n.saturating_sub(2));
    let [least, mean, most] = medium.density;
    line(
        "medium",
        format!("{} voxels in {nx} x {ny} x {nz}, density {least:.3} to {most:.3}, mean {mean:.3}", medium.voxels),
    );
    let (depth_mean, depth_p95) = (rgb(medium.depth_mean()), rgb(medium.depth_p95()));
    line("optical depth", format!("{depth_mean} mean, {depth_p95} at the 95th percentile of the rays through it"));
    let (voxels, radii) = free_paths(survey);
    let radii = radii.map_or_else(String::new, |radii| format!(", {} Gaussian radii", rgb(radii)));
    line("mean free path", format!("{} voxels{radii}", rgb(voxels)));
    let albedo = rgb(medium.parameters.albedo.map(f64::from));
    line("scattering", format!("albedo {albedo}, g {}", medium.parameters.g));
    line("light", light(&survey.light));
    let view = &survey.view;
    let seen = format!("{} of {} pixels see smoke", percent(view.seen), view.pixels);
    line("view", format!("{seen}, through {:.1} voxels on average", view.voxels_a_ray / view.seen.max(1e-9)));
    let [voxels, mass, depth] = [over_time.voxels, over_time.mass, over_time.depth].map(range);
    line("over time", format!("voxels {voxels}; mass {mass}; optical depth {depth}"));

    out += "\nmethods\n";
    for method in METHODS {
        let words = match method.refuses(survey) {
            None => format!("can serve: {}", method.good_for()),
            Some(error) => format!("cannot: {error}"),
        };
        let _ = writeln!(out, "  {:<15} {words}", method.name());
    }
    out += "\nterms\n";
    for term in &plan.terms {
        let what = if term.left_out { "left out" } else { "kept" };
        let _ = writeln!(out, "  {what:<8}  {}: {}", term.name, term.why);
    }
    out += "\ncandidates      error  seconds\n";
    for (i, candidate) in plan.candidates.iter().enumerate() {
        let mark = if i == plan.chosen { '*' } else { ' ' };
        let (error, seconds) = match (&candidate.refused, &candidate.prediction) {
            (Some(_), _) => ("cannot".to_owned(), String::new()),
            (None, None) => ("unknown".to_owned(), String::new()),
            (None, Some(p)) => (percent(p.error), format!("{:.3}", p.seconds.iter().sum::<f64>())),
        };
        let _ = writeln!(out, "{mark} {:<12} {error:>7} {seconds:>8}  {}", candidate.rung.name, candidate.rung.words);
    }
    if let Some(outlook) = &plan.transfer {
        out += &transfer(outlook, plan.candidate().rung.name);
    }
    let _ = writeln!(out, "\nchoice: {}", plan.sentence());
    out
}

/// What a bake of transfer would bring, beside the rung `chosen`.
fn transfer(outlook: &TransferOutlook, chosen: &str) -> String {
    let milliseconds = |seconds: f64| format!("{} ms", number(1e3 * seconds));
    let [light, view, march] = [outlook.light_change, outlook.view_change, outlook.march].map(milliseconds);
    let bake =
        if outlook.is_baked { "this frame has it" } else { "not baked: `bake --transfer dsf642 --medium SCENE`" };
    let pays = match outlook.pays_from {
        Some(images) => format!("from {images} images of a frame on, against {chosen}"),
        None => format!("never: {chosen} is as fast"),
    };
    format!(
        "\ntransfer, for one medium under changing light and camera: {bake}\n  \
         error           {}\n  \
         change          light {light}, view {view}; and {march} to march\n  \
         size            {:.1} bytes a voxel\n  \
         bake            {} s this frame, {} s a million voxels\n  \
         pays            {pays}\n",
        percent(outlook.error),
        outlook.bytes_a_voxel,
        number(outlook.bake_seconds),
        number(outlook.bake_seconds_a_million),
    )
}

/// The document of `--json`.
pub fn as_json(input: &Path, planned: &Planned) -> Value {
    let Planned { frames, sampled, thickest, survey, over_time, plan } = planned;
    let (medium, view) = (&survey.medium, &survey.view);
    let (free_voxels, free_radii) = free_paths(survey);
    let methods: Vec<Value> = METHODS
        .iter()
        .map(|method| {
            let refused = method.refuses(survey).map(|error| error.to_string());
            json!({ "method": method.name(), "serves": refused.is_none(), "why_not": refused })
        })
        .collect();
    let terms: Vec<Value> =
        plan.terms.iter().map(|t| json!({ "term": t.name, "left_out": t.left_out, "why": t.why })).collect();
    json!({
        "input": input,
        "frames": frames,
        "looked_at": sampled,
        "planned_for": thickest,
        "survey": {
            "voxels": medium.voxels,
            "nodes": medium.dims,
            "voxel": medium.voxel,
            "density": { "least": medium.density[0], "mean": medium.density[1], "most": medium.density[2] },
            "mass": medium.mass,
            "optical_depth": { "mean": medium.depth_mean(), "p95": medium.depth_p95() },
            "mean_free_path": { "world": medium.mean_free_path(), "voxels": free_voxels, "gaussian_radii": free_radii },
            "gaussians": medium.gaussians.map(|g| json!({ "count": g.count, "mean_radius": g.mean_radius })),
            "uniform_voxels": medium.uniform,
            "sigma_t": medium.parameters.sigma_t,
            "albedo": medium.parameters.albedo,
            "g": medium.parameters.g,
            "grey_medium": medium.is_grey(),
            "fit_error": survey.fit_error,
        },
        "light": {
            "environments": survey.light.environments,
            "directional": survey.light.directional,
            "points": survey.light.points,
            "bands": survey.light.bands,
            "directionality": survey.light.directionality(),
            "brightest_beam": survey.light.brightest,
            "mean_radiance": survey.light.mean_radiance,
            "grey": survey.light.grey,
            "visible": survey.light.visible,
        },
        "view": {
            "pixels": view.pixels,
            "seen": view.seen,
            "voxels_a_ray": view.voxels_a_ray,
            "dilution": view.dilution,
        },
        "over_time": {
            "voxels": range_json(over_time.voxels),
            "mass": range_json(over_time.mass),
            "optical_depth_p95": range_json(over_time.depth),
        },
        "methods": methods,
        "terms": terms,
        "candidates": plan.candidates.iter().map(candidate).collect::<Vec<_>>(),
        "transfer": plan.transfer.map(|outlook| json!({
            "baked": outlook.is_baked,
            "error": outlook.error,
            "seconds": {
                "light_change": outlook.light_change,
                "view_change": outlook.view_change,
                "march": outlook.march,
            },
            "bytes_a_voxel": outlook.bytes_a_voxel,
            "bake_seconds": outlook.bake_seconds,
            "bake_seconds_a_million_voxels": outlook.bake_seconds_a_million,
            "pays_from_images": outlook.pays_from,
        })),
        "goal": match plan.goal {
            Goal::Best => json!({}),
            Goal::Error(error) => json!({ "error": error }),
            Goal::Time(seconds) => json!({ "seconds": seconds }),
        },
        "choice": {
            "rung": plan.candidate().rung.name,
            "method": plan.candidate().rung.method(),
            "settings": match plan.settings {
                Settings::Compensated(settings) => crate::compensated::document(&settings),
                Settings::Reference { target_error } => json!({ "method": "reference", "target_error": target_error }),
            },
            "why": plan.why,
            "sentence": plan.sentence(),
        },
    })
}

fn candidate(candidate: &Candidate) -> Value {
    let predicted = candidate.prediction;
    json!({
        "rung": candidate.rung.name,
        "method": candidate.rung.method(),
        "words": candidate.rung.words,
        "refused": candidate.refused.as_ref().map(ToString::to_string),
        "error": predicted.map(|p| p.error),
        "seconds": predicted.map(|p| json!({
            "source_radiance": p.seconds[0],
            "volume_pass": p.seconds[1],
            "view_pass": p.seconds[2],
            "all": p.seconds.iter().sum::<f64>(),
        })),
    })
}

/// Mean free path in voxels, and in radii of the Gaussians.
fn free_paths(survey: &Survey) -> ([f64; 3], Option<[f64; 3]>) {
    let path = survey.medium.mean_free_path();
    let radii = survey.medium.gaussians.map(|g| path.map(|p| p / g.mean_radius));
    (path.map(|p| p / survey.medium.voxel), radii)
}

fn light(light: &LightSurvey) -> String {
    let count = |n: usize, one: &str, many: &str| match n {
        0 => None,
        1 => Some(format!("1 {one}")),
        n => Some(format!("{n} {many}")),
    };
    let kinds = [
        count(light.environments, "environment", "environments"),
        count(light.directional, "sun", "suns"),
        count(light.points.len(), "point", "points"),
    ];
    let kinds: Vec<String> = kinds.into_iter().flatten().collect();
    let kinds = if kinds.is_empty() { "none".to_owned() } else { kinds.join(", ") };
    if light.is_dark() {
        return format!("{kinds}; nothing from infinity");
    }
    let bands: Vec<String> = light.bands.iter().map(|band| format!("{:.0}", 100.0 * band)).collect();
    format!(
        "{kinds}; directionality {:.2} (energy of the bands {} %), brightest beam {} of the flux, {}",
        light.directionality(),
        bands.join(" "),
        percent(light.brightest),
        if light.grey { "grey" } else { "coloured" },
    )
}

/// One number where the channels agree, three where they do not.
fn rgb(values: [f64; 3]) -> String {
    match values {
        [r, g, b] if r == g && g == b => number(r),
        [r, g, b] => format!("{} {} {}", number(r), number(g), number(b)),
    }
}

/// Three significant digits.
fn number(v: f64) -> String {
    match v.abs() {
        _ if !v.is_finite() => "infinite".to_owned(),
        a if a >= 100.0 => format!("{v:.0}"),
        a if a >= 10.0 => format!("{v:.1}"),
        a if a >= 1.0 => format!("{v:.2}"),
        a if a >= 1e-3 || a == 0.0 => format!("{v:.3}"),
        _ => format!("{v:.2e}"),
    }
}

fn range(range: Range) -> String {
    let Range { least, mean, most } = range;
    format!("{} to {}, mean {}", number(least), number(most), number(mean))
}

fn range_json(range: Range) -> Value {
    json!({ "least": range.least, "mean": range.mean, "most": range.most })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_equal_channels_are_one() {
        assert_eq!(rgb([1.5, 1.5, 1.5]), "1.50");
        assert_eq!(rgb([123.4, 12.34, 1.234]), "123 12.3 1.23");
        assert_eq!([0.0, 1.2e-5, f64::INFINITY].map(number), ["0.000", "1.20e-5", "infinite"]);
    }
}
