//! The method `compensated` of `render`: which options it takes.

use crate::cli::{ExponentialChoice, MultipleChoice, RenderArgs, RouteChoice, ScatteringOrders};
use crate::failure::Failure;
use crate::method::does_not_apply;
use crate::transfer;
use serde_json::{Value, json};
use smoke_runtime::march::MarchSettings;
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, MultipleScattering};
use smoke_runtime::transport::compensated::grid::route::GridSettings;

/// The dials: those given, after a check that each applies, and those of `base` for the rest.
pub fn settings(args: &RenderArgs, base: &RenderSettings) -> Result<RenderSettings, Failure> {
    let refuse = does_not_apply;
    let with = "--method compensated";
    refuse(args.suns.is_some(), "--suns", with)?;
    refuse(args.target_error.is_some(), "--target-error", with)?;
    refuse(args.max_passes.is_some(), "--max-passes", with)?;
    refuse(args.seed.is_some(), "--seed", with)?;
    let single = args.order == Some(ScatteringOrders::SINGLE);
    refuse(!single && args.order.is_some_and(|o| o != ScatteringOrders::All), "--order N above 1", with)?;
    refuse(single && args.multiple.is_some(), "--multiple", "--order single")?;
    refuse(single && args.scatter_step.is_some(), "--scatter-step", "--order single")?;
    refuse(single && args.scatter_rings.is_some(), "--scatter-rings", "--order single")?;
    refuse(single && args.scatter_order.is_some(), "--scatter-order", "--order single")?;
    let sh_order = args.sh_order.map_or(base.sh_order, usize::from);
    let too_many = args.scatter_order.is_some_and(|order| usize::from(order) > sh_order);
    refuse(too_many, "--scatter-order", "a smaller --sh-order")?;
    // Who sets a dial of multiple scattering wants it, even if the plan would do without.
    let multiple_dial = args.multiple.is_some()
        || args.scatter_step.is_some()
        || args.scatter_rings.is_some()
        || args.scatter_order.is_some();
    let scattering = match args.order {
        Some(ScatteringOrders::All) => ScatteringOrder::All,
        Some(_) => ScatteringOrder::Single,
        None if multiple_dial => ScatteringOrder::All,
        None => base.scattering,
    };
    let route = match (args.route, base.route) {
        // A base of this method never has transfer; the grid is what it falls back to.
        (Some(RouteChoice::Grid), _) | (None, Route::Grid(_) | Route::Transfer(_)) => {
            let with = "--route grid";
            refuse(args.exponential.is_some(), "--exponential", with)?;
            refuse(args.multiple.is_some_and(|m| m != MultipleChoice::Transport), "this --multiple", with)?;
            let d = if let Route::Grid(grid) = base.route { grid } else { GridSettings::default() };
            Route::Grid(GridSettings {
                beams: args.beams.map_or(d.beams, |v| v as usize),
                single_step: args.source_step.map_or(d.single_step, |v| v as usize),
                multiple_step: args.scatter_step.map_or(d.multiple_step, |v| v as usize),
                rings: args.scatter_rings.map_or(d.rings, usize::from),
                multiple_order: args.scatter_order.map_or(d.multiple_order, usize::from),
                ..d
            })
        }
        (Some(RouteChoice::Centres), _) | (None, Route::Centres(_)) => {
            let with = "--route centres";
            refuse(args.beams.is_some(), "--beams", with)?;
            refuse(args.source_step.is_some(), "--source-step", with)?;
            refuse(args.scatter_step.is_some(), "--scatter-step", with)?;
            refuse(args.scatter_rings.is_some(), "--scatter-rings", with)?;
            refuse(args.scatter_order.is_some(), "--scatter-order", with)?;
            refuse(args.multiple == Some(MultipleChoice::Transport), "--multiple transport", with)?;
            let d = if let Route::Centres(centres) = base.route { centres } else { CentreSettings::default() };
            let exponential = match args.exponential {
                Some(ExponentialChoice::Direct) => Exponential::Direct,
                Some(ExponentialChoice::Pointwise) => Exponential::Pointwise,
                Some(ExponentialChoice::Hybrid) => Exponential::Hybrid,
                Some(ExponentialChoice::Linear) => Exponential::OptimalLinear,
                None => d.exponential,
            };
            let multiple = match args.multiple {
                _ if single => MultipleScattering::None,
                Some(MultipleChoice::Diffusion) => MultipleScattering::Diffusion,
                Some(_) => MultipleScattering::IntegralCentres,
                None => d.multiple,
            };
            Route::Centres(CentreSettings { order: sh_order, exponential, multiple, ..d })
        }
    };
    Ok(RenderSettings { route, sh_order, scattering, march: march(args, &base.march) })
}

/// The dials of the march: those given, and those of `base` for the rest.
pub fn march(args: &RenderArgs, base: &MarchSettings) -> MarchSettings {
    MarchSettings {
        step: args.march_step.map_or(base.step, |v| v as f32),
        cutoff: args.cutoff.map_or(base.cutoff, |v| v as f32),
        samples: args.samples.map_or(base.samples, usize::from),
        half_resolution: args.half_resolution || base.half_resolution,
    }
}

/// The march as an image's metadata has it.
pub fn march_document(march: &MarchSettings) -> Value {
    json!({
        "march_step": if march.step == 0.0 { json!("automatic") } else { json!(march.step) },
        "cutoff": march.cutoff,
        "samples": march.samples,
        "half_resolution": march.half_resolution,
    })
}

/// The settings as an image's metadata has them.
pub fn document(settings: &RenderSettings) -> Value {
    let automatic = |step: usize| if step == 0 { json!("automatic") } else { json!(step) };
    if let Route::Transfer(dials) = settings.route {
        return transfer::document(settings, dials);
    }
    let mut render = json!({
        "method": "compensated",
        "order": if settings.scattering == ScatteringOrder::Single { "single" } else { "all" },
        "sh_order": settings.sh_order,
    });
    if let (Some(render), Value::Object(march)) = (render.as_object_mut(), march_document(&settings.march)) {
        render.extend(march);
    }
    match settings.route {
        Route::Transfer(_) => {}
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
