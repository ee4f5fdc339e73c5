//! Moves Gaussians that do little to where they would do much.
//!
//! [`Rule::Single`] is the paper's (Zhou et al. 2008, section 5.1): the Gaussian of least integral `pi^(3/2) w r^3` goes
//! to the voxel where the density most exceeds the sum.
//!
//! [`Rule::Batch`], the default, decides by the objective itself. Taking a Gaussian away costs about `w^2 sum B^2`;
//! one more at c with radius r gains `(sum e B)^2 / sum B^2` at its best weight (the greedy step of matching pursuit,
//! Mallat, Zhang 1993). Candidate places are the centroids of missing density in a grid of cells; pairs of the largest
//! gains and the least losses are exchanged, several at once, as long as the gain is at least the loss.
//! The optimiser keeps its memory, less the entries of the variables moved. A move that does not lower the cost
//! is undone. Cost: a forward pass, three moments a candidate, and one evaluation.

use super::descent::Descent;
use super::objective::{ErrorField, VARIABLES};
use rayon::prelude::*;

/// Which Gaussians move where.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Rule {
    /// The paper's: one Gaussian, to the voxel of the largest error.
    Single,
    /// Several, by expected gain and loss.
    #[default]
    Batch,
}

/// Radius of a Gaussian that the paper's rule moves.
const SINGLE_RADIUS: f64 = 0.03;

/// At most this share of the Gaussians moves at once.
const SHARE: f64 = 0.05;
/// The expected gain must be this many times the expected loss. The loss is an upper bound (neighbours take over).
const MARGIN: f64 = 1.0;
/// Candidate radii over the mean radius.
const CANDIDATE_RADII: [f64; 3] = [0.4, 0.6, 0.9];

/// Exchanges Gaussians; gives how many have moved.
pub fn teleport(descent: &mut Descent, rule: Rule) -> usize {
    if descent.x.is_empty() {
        return 0;
    }
    match rule {
        Rule::Single => single(descent, None),
        Rule::Batch => batch(descent),
    }
}

/// The paper's rule once the optimiser has converged: the voxel of the largest error, and if that fails a random voxel
/// that holds density. `draw` numbers the attempts, and decides the voxel. Gives how many have moved, 0 if both fail.
pub fn at_rest(descent: &mut Descent, draw: u64) -> usize {
    if descent.x.is_empty() {
        return 0;
    }
    let mut occupied = Vec::new();
    descent.objective().errors(&descent.x).visit(|v, _, d| {
        if d > 0.0 {
            occupied.push(v);
        }
    });
    // A hash of the draw (Steele, Lea, Flood 2014, SplitMix64): the same voxels in every run.
    let mut h = draw.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    h = (h ^ (h >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    let random = occupied[((h ^ (h >> 31)) % occupied.len() as u64) as usize];
    match single(descent, None) {
        0 => single(descent, Some(random)),
        moved => moved,
    }
}

/// Moves the Gaussian of least integral to `voxel`, or else to the voxel of the largest error.
fn single(descent: &mut Descent, voxel: Option<usize>) -> usize {
    let integral = |g: &[f64]| g[4] * g[3].powi(3);
    let gaussians = descent.x.chunks(VARIABLES).enumerate();
    let least = gaussians.min_by(|a, b| integral(a.1).total_cmp(&integral(b.1))).map(|(i, _)| i);
    let Some(least) = least else { return 0 };
    let (mut at, mut error) = (voxel.unwrap_or(0), f32::MIN);
    descent.objective().errors(&descent.x).visit(|v, e, _| {
        if voxel.map_or(-e > error, |voxel| v == voxel) {
            (at, error) = (v, -e);
        }
    });
    let [cx, cy, cz] = descent.objective().position(at);
    let mut x = descent.x.clone();
    let bounds = descent.bounds();
    let new = [cx, cy, cz, bounds.radius(SINGLE_RADIUS), bounds.weight(f64::from(error))];
    x[least * VARIABLES..(least + 1) * VARIABLES].copy_from_slice(&new);
    usize::from(descent.try_move(x, &[least]))
}

/// A place for a Gaussian: its variables and by how much it would lower the objective.
pub struct Candidate {
    /// Centre, radius, weight.
    pub gaussian: [f64; VARIABLES],
    /// See [`ErrorField::gain`].
    pub gain: f64,
}

/// Up to `most` places for new Gaussians, well apart, the best first.
pub fn places(descent: &Descent, errors: &ErrorField, most: usize) -> Vec<Candidate> {
    let (lattice, bounds) = (descent.objective().lattice(), descent.bounds());
    let n = descent.x.len() / VARIABLES;
    let mean = descent.x.chunks(VARIABLES).map(|g| g[3]).sum::<f64>() / n.max(1) as f64;
    // Missing density, and its first moments, in cells of a mean radius.
    let edge = ((mean / lattice.space.scale).round() as usize).max(1);
    let cells = lattice.dims.map(|d| d.div_ceil(edge));
    let mut missing = vec![[0.0f64; 4]; cells.iter().product()];
    let [nx, ny, _] = lattice.dims;
    errors.visit(|v, e, _| {
        if e < 0.0 {
            let [i, j, k] = [v % nx, v / nx % ny, v / (nx * ny)];
            let sums = &mut missing[i / edge + cells[0] * (j / edge + cells[1] * (k / edge))];
            let m = f64::from(-e);
            [1.0, i as f64, j as f64, k as f64].iter().zip(sums).for_each(|(f, s)| *s += f * m);
        }
    });
    let mut order: Vec<usize> = (0..missing.len()).filter(|&c| missing[c][0] > 0.0).collect();
    order.sort_by(|&a, &b| missing[b][0].total_cmp(&missing[a][0]).then(a.cmp(&b)));
    order.truncate(8 * most);
    let best_at = |&cell: &usize| {
        let [m, local @ ..] = missing[cell];
        let center: [f64; 3] = std::array::from_fn(|a| {
            lattice.space.offset[a] + lattice.space.scale * (f64::from(lattice.origin[a]) + local[a] / m)
        });
        let tries = CANDIDATE_RADII.map(|f| {
            let radius = bounds.radius(f * mean);
            let (weight, gain) = errors.gain(center, radius);
            Candidate { gaussian: [center[0], center[1], center[2], radius, weight.min(bounds.weight[1])], gain }
        });
        tries.into_iter().max_by(|a, b| a.gain.total_cmp(&b.gain)).filter(|c| c.gaussian[4] >= bounds.weight[0])
    };
    let mut candidates: Vec<Candidate> = order.par_iter().filter_map(best_at).collect();
    candidates.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    let mut chosen: Vec<Candidate> = Vec::new();
    for candidate in candidates {
        let g = candidate.gaussian;
        // Two new Gaussians on the same missing density would count it twice.
        let apart = |other: &Candidate| {
            let square: f64 = (0..3).map(|a| (g[a] - other.gaussian[a]).powi(2)).sum();
            square > (1.5 * g[3].max(other.gaussian[3])).powi(2)
        };
        if chosen.len() < most && chosen.iter().all(apart) {
            chosen.push(candidate);
        }
    }
    chosen
}

fn batch(descent: &mut Descent) -> usize {
    let n = descent.x.len() / VARIABLES;
    let errors = descent.objective().errors(&descent.x);
    let places = places(descent, &errors, ((n as f64 * SHARE) as usize).max(1));
    let loss = |i: usize| errors.loss(descent.x[i * VARIABLES + 3], descent.x[i * VARIABLES + 4]);
    let mut worst: Vec<usize> = (0..n).collect();
    worst.sort_by(|&a, &b| loss(a).total_cmp(&loss(b)).then(a.cmp(&b)));
    let pairs = worst.into_iter().zip(places);
    let mut moves: Vec<(usize, [f64; VARIABLES])> =
        pairs.take_while(|(i, place)| place.gain >= MARGIN * loss(*i)).map(|(i, place)| (i, place.gaussian)).collect();
    while !moves.is_empty() {
        let mut x = descent.x.clone();
        moves.iter().for_each(|(i, g)| x[i * VARIABLES..(i + 1) * VARIABLES].copy_from_slice(g));
        let moved: Vec<usize> = moves.iter().map(|m| m.0).collect();
        if descent.try_move(x, &moved) {
            break;
        }
        moves.truncate(moves.len() / 2);
    }
    moves.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::descent::Bounds;
    use crate::fit::objective::{Objective, Scope};
    use smoke_formats::gaussian::{Gaussian, UnitSpace};
    use smoke_formats::volume::{DensityGrid, VoxelMask};
    use smoke_runtime::medium::gaussian_sum::gaussian_sum;

    const SIDE: usize = 40;
    const BOUNDS: Bounds = Bounds { radius: [0.015, 0.09], weight: [0.01, 2.0] };
    /// What the density is made of; the last is the one that the start lacks.
    const TRUTH: [[f64; VARIABLES]; 3] =
        [[0.3, 0.3, 0.3, 0.08, 0.9], [0.6, 0.3, 0.4, 0.07, 0.7], [0.5, 0.7, 0.6, 0.06, 0.8]];
    /// A Gaussian where there is no density.
    const USELESS: [f64; VARIABLES] = [0.9, 0.9, 0.1, 0.02, 0.01];

    fn objective() -> Objective {
        let space = UnitSpace::of_box([0; 3], [SIDE as u32; 3]);
        let gaussians = TRUTH.map(|g| {
            let [x, y, z, radius, weight] = g.map(|v| v as f32);
            Gaussian { center: [x, y, z], radius, weight }
        });
        let values = gaussian_sum(&gaussians, &space, [0; 3], [SIDE; 3]);
        let grid = DensityGrid {
            name: "density".into(),
            origin: [0; 3],
            dims: [SIDE; 3],
            active: VoxelMask::new(values.len()),
            values,
            world_from_index: Default::default(),
        };
        Objective::new(&grid, &space, Scope::Box).unwrap()
    }

    fn descent<'a>(objective: &'a Objective, gaussians: &[[f64; VARIABLES]]) -> Descent<'a> {
        // Weights of the objective are in units of the peak.
        let unit = |g: &[f64; VARIABLES]| [g[0], g[1], g[2], g[3], BOUNDS.weight(g[4] / f64::from(objective.peak()))];
        let x = gaussians.iter().flat_map(unit).collect();
        Descent::new(objective, x, BOUNDS, 10, 0.0, 1000).unwrap()
    }

    #[test]
    fn a_useless_gaussian_goes_to_where_density_is_missing_by_every_rule() {
        let objective = objective();
        for rule in [Rule::Single, Rule::Batch] {
            let mut descent = descent(&objective, &[TRUTH[0], USELESS, TRUTH[1]]);
            let (before, kept) = (descent.cost, descent.x.clone());
            assert_eq!(teleport(&mut descent, rule), 1);
            assert!(descent.cost < before);
            assert_eq!((&descent.x[..5], &descent.x[10..]), (&kept[..5], &kept[10..]));
            // A voxel is 1/40; a cell of the candidates 2 voxels.
            (0..3).for_each(|a| assert!((descent.x[5 + a] - TRUTH[2][a]).abs() < 0.05, "{rule:?} {:?}", descent.x));
            // The optimiser goes on from there to the exact sum.
            descent.advance(200).unwrap();
            assert!(descent.cost < 1e-6, "{rule:?} {}", descent.cost);
        }
    }

    #[test]
    fn without_need_nothing_moves_and_a_move_that_does_not_help_is_undone() {
        let objective = objective();
        for rule in [Rule::Single, Rule::Batch] {
            let mut descent = descent(&objective, &TRUTH);
            let (cost, x) = (descent.cost, descent.x.clone());
            assert_eq!(teleport(&mut descent, rule), 0);
            assert_eq!((descent.cost, &descent.x), (cost, &x));
        }
    }

    #[test]
    fn at_rest_the_draw_decides_the_voxel_and_the_same_draw_gives_the_same() {
        let objective = objective();
        // Nothing is missing, so the voxel of the largest error is no use, and a random one is tried after it.
        let run = |draw| {
            let mut descent = descent(&objective, &[TRUTH[0], TRUTH[1], TRUTH[2], USELESS]);
            let (before, moved) = (descent.cost, at_rest(&mut descent, draw));
            assert!(descent.cost <= before && (moved == 1) == (descent.cost < before));
            descent.x
        };
        (0..4).for_each(|draw| assert_eq!(run(draw), run(draw)));
    }

    #[test]
    fn places_come_by_gain_and_lie_apart() {
        let objective = objective();
        let descent = descent(&objective, &[USELESS]);
        let errors = objective.errors(&descent.x);
        let found = places(&descent, &errors, 3);
        assert_eq!(found.len(), 3);
        assert!(found.windows(2).all(|w| w[0].gain >= w[1].gain));
        for (i, a) in found.iter().enumerate() {
            for b in &found[..i] {
                let square: f64 = (0..3).map(|k| (a.gaussian[k] - b.gaussian[k]).powi(2)).sum();
                assert!(square.sqrt() > 1.5 * a.gaussian[3].max(b.gaussian[3]));
            }
        }
        // No density is missing where the sum is above it everywhere.
        let full = self::descent(&objective, &[[0.5, 0.5, 0.5, 0.09, 1.0]; 1]);
        assert!(places(&full, &objective.errors(&full.x), 0).is_empty());
    }

    #[test]
    fn without_gaussians_nothing_happens() {
        let objective = objective();
        let mut descent = descent(&objective, &[]);
        assert_eq!((teleport(&mut descent, Rule::Batch), at_rest(&mut descent, 0)), (0, 0));
    }
}
