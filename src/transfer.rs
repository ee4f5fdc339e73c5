//! The method `transfer` of `render`: which options it takes.

use crate::cli::{Detail, RenderArgs, ScatteringOrders, SunChoice};
use crate::compensated;
use crate::failure::Failure;
use crate::method::does_not_apply;
use serde_json::{Value, json};
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::transfer::source::TransferSettings;

/// The dials, after a check that each one given applies.
pub fn settings(args: &RenderArgs) -> Result<RenderSettings, Failure> {
    let refuse = does_not_apply;
    let with = "--method transfer";
    refuse(args.target_error.is_some(), "--target-error", with)?;
    refuse(args.max_passes.is_some(), "--max-passes", with)?;
    refuse(args.seed.is_some(), "--seed", with)?;
    refuse(args.route.is_some(), "--route", with)?;
    refuse(args.sh_order.is_some(), "--sh-order", with)?;
    refuse(args.beams.is_some(), "--beams", with)?;
    refuse(args.source_step.is_some(), "--source-step", with)?;
    refuse(args.scatter_step.is_some(), "--scatter-step", with)?;
    refuse(args.scatter_rings.is_some(), "--scatter-rings", with)?;
    refuse(args.scatter_order.is_some(), "--scatter-order", with)?;
    refuse(args.exponential.is_some(), "--exponential", with)?;
    refuse(args.multiple.is_some(), "--multiple", with)?;
    refuse(args.detail == Detail::Gaussians, "--detail gaussians", with)?;
    let single = args.order == Some(ScatteringOrders::SINGLE);
    refuse(!single && args.order.is_some_and(|o| o != ScatteringOrders::All), "--order N above 1", with)?;
    let sharp_suns = args.suns.unwrap_or_default() == SunChoice::Sharp;
    let base = RenderSettings::default();
    Ok(RenderSettings {
        route: Route::Transfer(TransferSettings { sharp_suns }),
        scattering: if single { ScatteringOrder::Single } else { ScatteringOrder::All },
        march: compensated::march(args, &base.march),
        ..base
    })
}

/// The settings as an image's metadata has them.
pub fn document(settings: &RenderSettings, transfer: TransferSettings) -> Value {
    let mut render = compensated::march_document(&settings.march);
    render["method"] = json!("transfer");
    render["order"] = json!(if settings.scattering == ScatteringOrder::Single { "single" } else { "all" });
    render["suns"] = json!(if transfer.sharp_suns { "sharp" } else { "lobes" });
    render
}
