//! The method `reference` of `render`: which options it takes, and what is told of its images.

use crate::cli::{RenderArgs, ScatteringOrders};
use crate::failure::Failure;
use crate::method::does_not_apply;
use serde_json::{Value, json};
use smoke_runtime::transport::reference::{Estimate, ReferenceSettings};

/// What the options ask for, after a check that each given one applies; to the error of `base` where they name none.
pub fn settings(args: &RenderArgs, base: &ReferenceSettings) -> Result<ReferenceSettings, Failure> {
    let with = "--method reference";
    let numbers = [
        (args.route.is_some(), "--route"),
        (args.beams.is_some(), "--beams"),
        (args.source_step.is_some(), "--source-step"),
        (args.scatter_step.is_some(), "--scatter-step"),
        (args.scatter_rings.is_some(), "--scatter-rings"),
        (args.scatter_order.is_some(), "--scatter-order"),
        (args.exponential.is_some(), "--exponential"),
        (args.multiple.is_some(), "--multiple"),
        (args.march_step.is_some(), "--march-step"),
        (args.sh_order.is_some(), "--sh-order"),
        (args.cutoff.is_some(), "--cutoff"),
        (args.samples.is_some(), "--samples"),
        (args.half_resolution, "--half-resolution"),
        (args.suns.is_some(), "--suns"),
    ];
    for (given, option) in numbers {
        does_not_apply(given, option, with)?;
    }
    let d = base;
    Ok(ReferenceSettings {
        orders: match args.order {
            None | Some(ScatteringOrders::All) => None,
            Some(ScatteringOrders::UpTo(n)) => Some(n),
        },
        target_error: args.target_error.unwrap_or(d.target_error),
        max_passes: args.max_passes.unwrap_or(d.max_passes),
        seed: args.seed.unwrap_or(d.seed),
    })
}

/// The settings as an image's metadata has them.
pub fn document(settings: &ReferenceSettings) -> Value {
    json!({
        "method": "reference",
        "order": settings.orders.map_or(ScatteringOrders::All, ScatteringOrders::UpTo).to_string(),
        "target_error": settings.target_error,
        "max_passes": settings.max_passes,
        "seed": settings.seed,
    })
}

/// Which part of the work is done after `passes` with relative error `error`: the error falls as their root.
pub fn part_done(settings: &ReferenceSettings, passes: u32, error: f64) -> f64 {
    let by_count = f64::from(passes) / f64::from(settings.max_passes);
    let by_error = if error > 0.0 { (settings.target_error / error).powi(2) } else { 1.0 };
    by_count.max(by_error).min(1.0)
}

/// What is told of an estimate, beside its image.
pub fn figures(estimate: &Estimate) -> Value {
    json!({
        "passes": estimate.passes,
        "relative_error": estimate.relative_error,
        "truncated": estimate.truncated,
    })
}
