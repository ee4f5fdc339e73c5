//! How much each stage of a rung has to do, in units that its seconds are proportional to.
//!
//! | stage | grid | centres | transfer | reference |
//! |---|---|---|---|---|
//! | source radiance | `n_1 B + n_m (B + 2 rings^2 K)` | `G^1.4` | nodes | 0 |
//! | volume pass | nodes | `nodes G^0.6` | nodes | 0 |
//! | view pass | `pixels (1 + voxels a ray / step) samples^2` | the same | the same | pixels that see smoke |
//!
//! `n_1`, `n_m`: nodes of single and of multiple scattering; `B`: beams; `K` = [`PRODUCTS`] of the iteration; `G`:
//! Gaussians, with the exponents of `docs/speed.md`. What else the seconds depend on (bands, thickness, iterations) is the
//! table's part: seconds per unit are measured for each rung and kind of scene.

use super::Survey;
use super::ladder::Rung;
use crate::renderer::{RenderSettings, Route};
use crate::transport::ScatteringOrder;
use crate::transport::compensated::grid::route::nodes;

/// Products that the iteration for multiple scattering takes, roughly.
const PRODUCTS: f64 = 8.0;
/// Seconds fall as threads to this power: between 0.6 and 0.9 for the stages in `docs/speed.md`.
const THREADS: f64 = 0.8;

/// Units of the three stages of an image: source radiance, volume pass, view pass.
pub fn work(rung: &Rung, survey: &Survey) -> [f64; 3] {
    match rung.settings_for(survey) {
        Some(settings) => compensated(&settings, survey),
        None => [0.0, 0.0, survey.view.pixels * survey.view.seen],
    }
}

fn compensated(settings: &RenderSettings, survey: &Survey) -> [f64; 3] {
    let (medium, view) = (&survey.medium, &survey.view);
    let all_nodes = nodes(medium.dims, 1) as f64;
    let (source, volume) = match settings.route {
        Route::Grid(grid) => {
            let beams = (survey.light.environments * grid.beams + survey.light.directional) as f64;
            let chosen = |step: usize, automatic: usize| if step == 0 { automatic } else { step };
            let single = nodes(medium.dims, chosen(grid.single_step, medium.steps[0])) as f64 * beams;
            let multiple = match settings.scattering {
                ScatteringOrder::Single => 0.0,
                ScatteringOrder::All => {
                    let gathered = (2 * grid.rings * grid.rings) as f64 * PRODUCTS;
                    nodes(medium.dims, chosen(grid.multiple_step, medium.steps[1])) as f64 * (beams + gathered)
                }
            };
            (single + multiple, all_nodes)
        }
        // To light the clusters is a part of it, and the sweep of a sun and what a frame takes to be taken up another.
        Route::Transfer(_) => (all_nodes, all_nodes),
        Route::Centres(_) => {
            let gaussians = medium.gaussians.map_or(0.0, |g| g.count as f64);
            (gaussians.powf(1.4), all_nodes * gaussians.powf(0.6))
        }
    };
    let step = if settings.march.step > 0.0 { f64::from(settings.march.step) } else { 1.0 };
    let rays = view.pixels * (settings.march.samples * settings.march.samples) as f64;
    [source, volume, rays * (1.0 + view.voxels_a_ray / step)]
}

/// By how much `threads` divide the seconds of one.
pub fn speedup(threads: usize) -> f64 {
    (threads.max(1) as f64).powf(THREADS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::ladder::{REFERENCE, rung};
    use crate::plan::tests::survey;

    #[test]
    fn work_grows_with_voxels_pixels_beams_and_rings_each_in_its_stage() {
        let small = survey(1.0, 0.9, 0.0);
        let mut large = small.clone();
        (large.medium.dims, large.view.pixels) = (small.medium.dims.map(|n| 2 * n), 4.0 * small.view.pixels);
        for name in ["single", "default", "fine"] {
            let rung = rung(name).unwrap();
            let (a, b) = (work(&rung, &small), work(&rung, &large));
            assert!(b[0] > 6.0 * a[0] && b[1] > 6.0 * a[1] && b[2] == 4.0 * a[2], "{name}: {a:?} {b:?}");
        }
        let at = |name: &str| work(&rung(name).unwrap(), &small);
        assert!(at("single-draft")[0] < at("single")[0] && at("single")[0] < at("default")[0]);
        assert!(at("default")[0] < at("fine")[0]);
        assert_eq!(at(REFERENCE), [0.0, 0.0, small.view.pixels * small.view.seen]);
        assert_eq!(speedup(1), 1.0);
    }
}
