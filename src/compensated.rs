//! The method `compensated` of `render`: which options it takes.

use crate::cli::{ExponentialChoice, MultipleChoice, RenderArgs, RouteChoice, ScatteringOrders};
use crate::failure::Failure;
use crate::method::does_not_apply;
use serde_json::{Value, json};
use smoke_runtime::march::MarchSettings;
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, MultipleScattering};
use smoke_runtime::transport::compensated::grid::route::GridSettings;

/// The dials, after a check that each given one applies.
pub fn settings(args: &RenderArgs) -> Result<RenderSettings, Failure> {
    let refuse = does_not_apply;
    let with = "--method compensated";
    refuse(args.target_error.is_some(), "--target-error", with)?;
    refuse(args.max_passes.is_some(), "--max-passes", with)?;
    refuse(args.seed.is_some(), "--seed", with)?;
    let single = args.order == ScatteringOrders::SINGLE;
    refuse(!single && args.order != ScatteringOrders::All, "--order N above 1", with)?;
    refuse(single && args.multiple.is_some(), "--multiple", "--order single")?;
    refuse(single && args.scatter_step.is_some(), "--scatter-step", "--order single")?;
    refuse(single && args.scatter_rings.is_some(), "--scatter-rings", "--order single")?;
    refuse(single && args.scatter_order.is_some(), "--scatter-order", "--order single")?;
    let too_many = args.scatter_order.is_some_and(|order| order > args.sh_order);
    refuse(too_many, "--scatter-order", "a smaller --sh-order")?;
    let route = match args.route {
        RouteChoice::Grid => {
            let with = "--route grid";
            refuse(args.exponential.is_some(), "--exponential", with)?;
            refuse(args.multiple.is_some_and(|m| m != MultipleChoice::Transport), "this --multiple", with)?;
            let d = GridSettings::default();
            Route::Grid(GridSettings {
                beams: args.beams.map_or(d.beams, |v| v as usize),
                single_step: args.source_step.map_or(d.single_step, |v| v as usize),
                multiple_step: args.scatter_step.map_or(d.multiple_step, |v| v as usize),
                rings: args.scatter_rings.map_or(d.rings, usize::from),
                multiple_order: args.scatter_order.map_or(d.multiple_order, usize::from),
                ..d
            })
        }
        RouteChoice::Centres => {
            let with = "--route centres";
            refuse(args.beams.is_some(), "--beams", with)?;
            refuse(args.source_step.is_some(), "--source-step", with)?;
            refuse(args.scatter_step.is_some(), "--scatter-step", with)?;
            refuse(args.scatter_rings.is_some(), "--scatter-rings", with)?;
            refuse(args.scatter_order.is_some(), "--scatter-order", with)?;
            refuse(args.multiple == Some(MultipleChoice::Transport), "--multiple transport", with)?;
            let exponential = match args.exponential.unwrap_or_default() {
                ExponentialChoice::Direct => Exponential::Direct,
                ExponentialChoice::Pointwise => Exponential::Pointwise,
                ExponentialChoice::Hybrid => Exponential::Hybrid,
                ExponentialChoice::Linear => Exponential::OptimalLinear,
            };
            let multiple = match args.multiple {
                _ if single => MultipleScattering::None,
                Some(MultipleChoice::Diffusion) => MultipleScattering::Diffusion,
                _ => MultipleScattering::IntegralCentres,
            };
            let order = usize::from(args.sh_order);
            Route::Centres(CentreSettings { order, exponential, multiple, ..CentreSettings::default() })
        }
    };
    let scattering = if single { ScatteringOrder::Single } else { ScatteringOrder::All };
    let march = MarchSettings {
        step: args.march_step.unwrap_or(0.0) as f32,
        cutoff: args.cutoff as f32,
        samples: usize::from(args.samples),
        half_resolution: args.half_resolution,
    };
    Ok(RenderSettings { route, sh_order: usize::from(args.sh_order), scattering, march })
}

/// The settings as an image's metadata has them.
pub fn document(settings: &RenderSettings) -> Value {
    let automatic = |step: usize| if step == 0 { json!("automatic") } else { json!(step) };
    let mut render = json!({
        "method": "compensated",
        "order": if settings.scattering == ScatteringOrder::Single { "single" } else { "all" },
        "sh_order": settings.sh_order,
        "march_step": if settings.march.step == 0.0 { json!("automatic") } else { json!(settings.march.step) },
        "cutoff": settings.march.cutoff,
        "samples": settings.march.samples,
        "half_resolution": settings.march.half_resolution,
    });
    match settings.route {
        Route::Grid(grid) => {
            render["route"] = json!("grid");
            render["multiple"] = json!("transport");
            render["beams"] = json!(grid.beams);
            render["source_step"] = automatic(grid.single_step);
            render["scatter_step"] = automatic(grid.multiple_step);
            render["scatter_rings"] = json!(grid.rings);
            render["scatter_order"] = json!(grid.multiple_order);
            render["tolerance"] = json!(grid.tolerance);
            render["iterations"] = json!(grid.iterations);
        }
        Route::Centres(centres) => {
            render["route"] = json!("centres");
            render["exponential"] = json!(match centres.exponential {
                Exponential::Direct => "direct",
                Exponential::Pointwise => "pointwise",
                Exponential::Hybrid => "hybrid",
                Exponential::OptimalLinear => "linear",
            });
            render["multiple"] = json!(match centres.multiple {
                MultipleScattering::None => "none",
                MultipleScattering::Diffusion => "diffusion",
                MultipleScattering::IntegralCentres => "integral",
            });
            render["rings"] = json!(centres.rings);
        }
    }
    if settings.scattering == ScatteringOrder::Single {
        render["multiple"] = json!("none");
    }
    render
}
