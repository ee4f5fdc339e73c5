//! What a bake of the light's transfer (Zhang et al. 2013) would cost a scene and bring it, told before it is baked.
//!
//! Transfer is the answer where one medium is seen under many lights and from many sides: a bake, and then images for the
//! price of a march. All figures are for `bake --transfer dsf642` with its other defaults.
//!
//! - *error*: from the measured table, as that of every rung.
//! - *change of light and view*: measured seconds to project a sky, to sweep for a sun and to shade; the march is the table's.
//! - *bytes*: counted, as they lie in a pack: `128 x 5 x (642 e + 162 b^2 m)` half floats of clusters for e extinctions, m
//!   pairs of extinction and albedo and b bands, and [`ROW_BYTES`] for each lit node and each cell.
//! - *bake*: seconds a million voxels on two threads, measured over depth at two phase functions ([`BAKED`]).
//!
//! Cost: nothing is looked at but the survey's figures.

use super::Survey;
use super::table::Prediction;
use super::work::speedup;

/// Clusters of a bake, each a mean and four directions, that is five rows.
const BASES: f64 = 128.0 * 5.0;
/// Directions of light, and those of indirect light.
const DIRECTIONS: [f64; 2] = [642.0, 162.0];
/// Bytes of a row in a pack: its cluster and four weights.
const ROW_BYTES: f64 = 9.0;
/// Rows a voxel with density, of frames 3 and 6 of the shipped plume: nodes with a dense neighbour, and cells of two voxels
/// a side.
const ROWS: [f64; 2] = [1.16, 0.145];
/// Seconds on two threads by `runtime/examples/transfer_speed.rs`, with balls in 64^3 and 128^3 voxels: to light the clusters
/// under any light; more under each environment, isotropic and with four bands; and a node more for each sun's sweep.
const LIGHT: f64 = 1.5e-3;
const ENVIRONMENT: [f64; 2] = [4.5e-3, 9e-3];
const SUN_A_NODE: f64 = 2.7e-9;
/// The same to shade: once, each voxel with density, and with a peak the clusters' directions for each environment.
const SHADE: f64 = 1.2e-3;
const SHADE_A_VOXEL: f64 = 1.25e-8;
const DIRECTED: f64 = 6e-3;
/// Measured bakes of frame 6 of the shipped plume (`docs/decisions/033-plan.md`): optical depth (95th percentile), and
/// seconds a million voxels on two threads at g = 0 and g = 0.5.
const BAKED: [(f64, [f64; 2]); 3] = [(1.51, [200.0, 270.0]), (9.08, [260.0, 340.0]), (60.5, [330.0, 430.0])];
/// g at which the second of [`BAKED`] was measured.
const PEAKED: f64 = 0.5;
/// Threads of all that was measured.
const THREADS: usize = 2;

/// What a bake of transfer costs and brings, for the frame of a survey.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TransferOutlook {
    /// True if the frame has transfer for this medium already.
    pub is_baked: bool,
    /// Relative RMSE over the pixels with smoke.
    pub error: f64,
    /// Seconds from another light to the nodes' source radiance for the eye.
    pub light_change: f64,
    /// Seconds from another eye to the same; none where light scatters evenly.
    pub view_change: f64,
    /// Seconds of the march after either.
    pub march: f64,
    /// Bytes of transfer for each voxel with density, at rest.
    pub bytes_a_voxel: f64,
    /// Seconds to bake a million voxels.
    pub bake_seconds_a_million: f64,
    /// Seconds to bake this frame.
    pub bake_seconds: f64,
    /// Images of this frame from which on a bake is the faster way, against the seconds of the plan's choice; none if that
    /// is as fast as transfer.
    pub pays_from: Option<u64>,
}

impl TransferOutlook {
    /// For the scene of `survey`, of which the table predicts `predicted` of transfer; the plan's choice would take
    /// `otherwise` seconds an image on `threads`.
    pub fn of(survey: &Survey, predicted: &Prediction, otherwise: f64, threads: usize) -> Self {
        let (medium, light) = (&survey.medium, &survey.light);
        let isotropic = medium.parameters.g == 0.0;
        let (environments, suns) = (light.environments as f64, light.directional as f64);
        let nodes: f64 = medium.dims.iter().map(|&n| n as f64).product();
        let faster = speedup(threads) / speedup(THREADS);
        let directed = if isotropic { 0.0 } else { DIRECTED * environments };
        let shade = (SHADE + SHADE_A_VOXEL * medium.voxels as f64 + directed) / faster;
        let lit = LIGHT + ENVIRONMENT[usize::from(!isotropic)] * environments + SUN_A_NODE * nodes * suns;
        let march = predicted.seconds[2];
        let light_change = lit / faster + shade;
        let voxels = medium.voxels.max(1) as f64;
        let bake_seconds_a_million = bake_seconds(survey) * medium_sets(survey)[1] / faster;
        let bake_seconds = bake_seconds_a_million * 1e-6 * medium.voxels as f64;
        let saved = otherwise - light_change - march;
        Self {
            is_baked: survey.transfer.is_some(),
            error: predicted.error,
            light_change,
            view_change: if isotropic { 0.0 } else { shade },
            march,
            bytes_a_voxel: bytes(survey) / voxels,
            bake_seconds_a_million,
            bake_seconds,
            pays_from: (saved > 0.0 && saved.is_finite()).then(|| (bake_seconds / saved).ceil().max(1.0) as u64),
        }
    }
}

/// How many extinctions, and how many pairs of extinction and albedo, the channels have.
fn medium_sets(survey: &Survey) -> [f64; 2] {
    let medium = &survey.medium.parameters;
    let distinct = |same: &dyn Fn(usize, usize) -> bool| {
        (0..3).filter(|&c| (0..c).all(|earlier| !same(earlier, c))).count() as f64
    };
    let extinction = |a: usize, b: usize| medium.sigma_t[a] == medium.sigma_t[b];
    [distinct(&extinction), distinct(&|a, b| extinction(a, b) && medium.albedo[a] == medium.albedo[b])]
}

/// Bytes of the frame's transfer.
fn bytes(survey: &Survey) -> f64 {
    let coefficients = if survey.medium.parameters.g == 0.0 { 1.0 } else { 16.0 };
    let lengths = [DIRECTIONS[0], DIRECTIONS[1] * coefficients];
    let sets = medium_sets(survey);
    let voxels = survey.medium.voxels as f64;
    (0..2).map(|i| sets[i] * (2.0 * BASES * lengths[i] + ROW_BYTES * ROWS[i] * voxels)).sum()
}

/// Seconds a million voxels, on two threads, of the thickest channel: linear in `ln depth` and `|g|` of the logarithms,
/// constant beyond what was measured.
fn bake_seconds(survey: &Survey) -> f64 {
    let depth = survey.medium.depth_p95().into_iter().fold(f64::MIN_POSITIVE, f64::max).ln();
    let peaked = (f64::from(survey.medium.parameters.g).abs() / PEAKED).min(1.0);
    let at = |i: usize| {
        let (depth, [even, strong]) = BAKED[i];
        (depth.ln(), even.ln() * (1.0 - peaked) + strong.ln() * peaked)
    };
    let next = (1..BAKED.len() - 1).find(|&i| depth < at(i).0).unwrap_or(BAKED.len() - 1);
    let ((from, low), (to, high)) = (at(next - 1), at(next));
    let part = ((depth - from) / (to - from)).clamp(0.0, 1.0);
    (low + (high - low) * part).exp()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::survey;

    const PREDICTED: Prediction = Prediction { error: 0.01, seconds: [0.5, 0.2, 0.03] };

    fn of(survey: &Survey, otherwise: f64, threads: usize) -> TransferOutlook {
        TransferOutlook::of(survey, &PREDICTED, otherwise, threads)
    }

    #[test]
    fn bytes_are_those_of_clusters_and_rows_and_channels_that_differ_have_their_own() {
        let mut scene = survey(4.0, 0.9, 0.0);
        scene.medium.voxels = 124_835;
        // Frame 6 of the shipped plume: its pack has 144,302 nodes, 18,038 cells and 2,490,248 bytes of transfer.
        let all = |scene: &Survey| of(scene, 1.0, 2).bytes_a_voxel * scene.medium.voxels as f64;
        assert!((all(&scene) / 2_490_248.0 - 1.0).abs() < 0.01, "{}", all(&scene));
        scene.medium.parameters.g = 0.5;
        assert!((all(&scene) / 5_600_648.0 - 1.0).abs() < 0.01, "{}", all(&scene));
        let seconds = of(&scene, 1.0, 2).bake_seconds;
        scene.medium.parameters.albedo = [0.9, 0.8, 0.9];
        assert!(all(&scene) > 1.5 * 5_600_648.0 && of(&scene, 1.0, 2).bake_seconds == 2.0 * seconds);
        scene.medium.parameters.sigma_t = [4.0, 2.0, 1.0];
        assert!((all(&scene) / (3.0 * 5_600_648.0) - 1.0).abs() < 0.01);
        scene.medium.voxels = 0;
        assert!(of(&scene, 1.0, 2).bytes_a_voxel.is_finite());
    }

    #[test]
    fn a_bake_takes_longer_in_thicker_media_with_peaks_and_shorter_on_more_threads() {
        let at = |sigma_t, g, threads| of(&survey(sigma_t, 0.9, g), 1.0, threads).bake_seconds_a_million;
        assert!(at(0.5, 0.0, 2) < at(8.0, 0.0, 2) && at(8.0, 0.0, 2) < at(8.0, 0.5, 2));
        assert!(at(8.0, 0.25, 2) > at(8.0, 0.0, 2) && at(8.0, 0.9, 2) == at(8.0, -0.5, 2));
        assert!(at(8.0, 0.0, 4) < at(8.0, 0.0, 2) && at(1e9, 0.0, 2).is_finite() && at(0.0, 0.0, 2) > 0.0);
        // At the measured places, what was measured.
        for (depth, [even, strong]) in BAKED {
            let mut scene = survey(1.0, 0.9, 0.0);
            scene.medium.column_p95 = depth;
            assert!((of(&scene, 1.0, 2).bake_seconds_a_million / even - 1.0).abs() < 1e-6);
            scene.medium.parameters.g = PEAKED as f32;
            assert!((of(&scene, 1.0, 2).bake_seconds_a_million / strong - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn an_eye_costs_nothing_where_light_scatters_evenly_and_a_bake_pays_where_images_are_slower_otherwise() {
        let (even, peaked) = (of(&survey(4.0, 0.9, 0.0), 1.0, 2), of(&survey(4.0, 0.9, 0.5), 1.0, 2));
        assert!(even.view_change == 0.0 && peaked.view_change > 0.0 && even.march == 0.03);
        assert!(peaked.view_change < peaked.light_change && even.light_change < peaked.light_change);
        assert!(of(&survey(4.0, 0.9, 0.0), 1.0, 8).light_change < even.light_change);
        let images = even.pays_from.unwrap() as f64;
        assert!((images - even.bake_seconds / (1.0 - even.light_change - 0.03)).abs() <= 1.0);
        let never = [0.0, even.light_change, f64::INFINITY].map(|seconds| of(&survey(4.0, 0.9, 0.0), seconds, 2));
        assert!(never.iter().all(|outlook| outlook.pays_from.is_none()));
    }

    #[test]
    fn bakes_and_changes_that_the_figures_were_not_made_from_are_right_to_a_factor_of_2() {
        let right = |predicted: f64, measured: f64| {
            let factor = (predicted / measured).max(measured / predicted);
            println!("predicted {predicted:.4}, measured {measured:.4}");
            assert!(factor <= 2.0, "{predicted} {measured}");
        };
        // Frame 3 of the shipped plume, 82,817 voxels: sigma_t 3 and 15, albedo 0.9, processor seconds over two threads.
        for (depth, g, seconds, bytes) in [
            (3.34, 0.0, 19.8, 2_013_932.0),
            (16.7, 0.0, 25.6, 2_013_932.0),
            (3.34, 0.3, 25.2, 5_124_332.0),
            (16.7, 0.3, 32.2, 5_124_332.0),
        ] {
            let mut scene = survey(1.0, 0.9, g);
            (scene.medium.column_p95, scene.medium.voxels) = (depth, 82_817);
            let outlook = of(&scene, 1.0, 2);
            right(outlook.bake_seconds, seconds);
            right(outlook.bytes_a_voxel * 82_817.0, bytes);
        }
        // `transfer_speed` with a ball in 96^3 voxels: light without shading, and shading, under a sky and under a sun.
        for (g, sun, light, view) in [
            (0.0, false, 0.0103, 0.0044),
            (0.0, true, 0.0035, 0.0043),
            (0.5, false, 0.0094, 0.012),
            (0.5, true, 0.0037, 0.0045),
        ] {
            let mut scene = survey(1.0, 0.9, g);
            (scene.medium.dims, scene.medium.voxels) = ([98; 3], 195_360);
            (scene.light.environments, scene.light.directional) = if sun { (0, 1) } else { (1, 0) };
            let outlook = of(&scene, 1.0, 2);
            right(outlook.light_change, light + view);
            if g != 0.0 {
                right(outlook.view_change, view);
            }
        }
    }
}
