//! The fit of one frame: the first in full, each later one from the one before it.
//!
//! First frame: spread Gaussians over the density ([`initial`](super::initial)), minimise, and exchange useless
//! Gaussians for needed ones every few iterations ([`teleport`]). Later frames (Zhou et al. 2008,
//! section 5.1): start from the frame before, delete the 3 of least integral, minimise; while the error is more than
//! `error_ratio` times that of the first frame, insert Gaussians where density is missing and minimise again, at most
//! 8 in all. Where we deviate: insertions go by expected gain, half of what is left of the 8 at a time, which takes
//! four rounds instead of eight; they compare with the least error so far ([`reference_error`]); and by default the
//! number of Gaussians is held instead ([`FitSettings::steady`]): over the 64 frames of a plume the mean error is .0449
//! instead of .0512 at the same evaluations (docs/decisions/023-fit-sequence.md).

use super::descent::{Bounds, Descent};
use super::initial::initial;
use super::objective::{Objective, Scope, VARIABLES};
use super::teleport::{self, Rule};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::volume::DensityGrid;

/// Occupied voxels that one Gaussian must stand for: below, its ten bytes are better spent on the residual.
const VOXELS_PER_GAUSSIAN: usize = 10;

/// The reference error is taken for at least this (a perfect frame allows no error at all).
const LEAST_REFERENCE: f64 = 1e-6;

/// A later frame that may hold more than this many times its Gaussians is fitted as a first one.
const GROWTH: usize = 2;

/// What radii and weights may be at all: their cubes and squares stay far from the limits of f32.
pub const BOUND_LIMITS: [f64; 2] = [1e-6, 1e6];

/// Evaluations before the variables' units are renewed, and Gaussians teleported.
const DEFAULT_INTERVAL: u64 = 20;

/// Iterations of a later frame before Gaussians are teleported: the density has moved, not appeared or vanished.
const SETTLING: u64 = 10;

/// All that can be chosen about a fit.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct FitSettings {
    /// Gaussians of the first frame (fewer where there is less than one for ten occupied voxels).
    pub gaussians: usize,
    /// The smallest and largest radius, in unit space (lengths over the longest side of the sequence's box).
    pub radius: [f64; 2],
    /// The smallest and largest weight, over the frame's largest density.
    pub weight: [f64; 2],
    /// Evaluations of the objective for a first frame.
    pub first_evaluations: usize,
    /// Evaluations for a later frame, without those after insertions.
    pub next_evaluations: usize,
    /// Evaluations after each round of insertions.
    pub insertion_evaluations: usize,
    /// Pairs that L-BFGS-B remembers.
    pub memory: usize,
    /// An iteration that lowers the error by less than this fraction ends the minimisation.
    pub tolerance: f64,
    /// Iterations between teleportations in the first frame; 0 = none.
    pub teleport_every: u64,
    /// How Gaussians are chosen for teleportation.
    pub teleport_rule: Rule,
    /// Gaussians deleted at the start of a later frame.
    pub deletions: usize,
    /// Gaussians inserted in a later frame, at most, where the number is not held.
    pub insertions: usize,
    /// Error over the reference error above which Gaussians are inserted, at least 1 (the paper: 1.05 to 1.2).
    pub error_ratio: f64,
    /// The number is held: later frames are filled up to `gaussians` again, and teleport once. False: the paper's rule,
    /// which deletes, and inserts where the error has grown.
    pub steady: bool,
    /// The voxels that count.
    pub scope: Scope,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self {
            gaussians: 1000,
            radius: [0.015, 0.09],
            weight: [0.01, 1.0],
            first_evaluations: 200,
            next_evaluations: 40,
            insertion_evaluations: 10,
            memory: 20,
            tolerance: 1e-6,
            teleport_every: DEFAULT_INTERVAL,
            teleport_rule: Rule::Batch,
            deletions: 3,
            insertions: 8,
            error_ratio: 1.1,
            steady: true,
            scope: Scope::Box,
        }
    }
}

impl FitSettings {
    /// The bounds of radius and weight.
    ///
    /// # Errors
    /// [`FitError::Bounds`] where they are not in order, or not within [`BOUND_LIMITS`].
    pub fn bounds(&self) -> Result<Bounds, FitError> {
        for (setting, [min, max]) in [("radius", self.radius), ("weight", self.weight)] {
            let sound = BOUND_LIMITS[0] <= min && min <= max && max <= BOUND_LIMITS[1];
            if !sound {
                return Err(FitError::Bounds { setting, min, max });
            }
        }
        Ok(Bounds { radius: self.radius, weight: self.weight })
    }
}

/// Where a fit is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitProgress {
    /// Evaluations done.
    pub evaluations: usize,
    /// Evaluations at most, as far as known now.
    pub most: usize,
    /// The objective.
    pub error: f64,
}

/// A fitted frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fit {
    /// The Gaussians; weights in the density's unit.
    pub gaussians: Vec<Gaussian>,
    /// `sum (D - S)^2 / sum D^2` over all voxels of the frame's box; 0 for an empty frame.
    pub fit_error: f64,
    /// The same sum over the voxels of the support only, where the decoder evaluates it.
    pub support_error: f64,
    /// Evaluations of objective and gradient.
    pub evaluations: usize,
    /// Iterations of L-BFGS-B.
    pub iterations: u64,
    /// Gaussians moved.
    pub teleports: usize,
    /// Gaussians inserted.
    pub inserted: usize,
    /// Gaussians deleted or merged.
    pub deleted: usize,
}

/// Why a frame could not be fitted.
#[derive(Debug, thiserror::Error)]
pub enum FitError {
    /// A density that cannot be fitted.
    #[error("grid {grid}: voxel {index:?} is {value}, expected a finite density, zero or more")]
    Density {
        /// The grid's name.
        grid: String,
        /// Index coordinates.
        index: [i32; 3],
        /// What it holds.
        value: f32,
    },
    /// Bounds that no Gaussian can keep.
    #[error("fit: {setting} from {min} to {max}, expected 1e-6 <= smallest <= largest <= 1e6")]
    Bounds {
        /// `radius` or `weight`.
        setting: &'static str,
        /// The smallest.
        min: f64,
        /// The largest.
        max: f64,
    },
    /// The optimiser gave up.
    #[error("fit of grid {grid}: {message}")]
    Optimiser {
        /// The grid's name.
        grid: String,
        /// What it said.
        message: String,
    },
}

/// Fits a frame without knowledge of others. `space` is that of the whole sequence.
///
/// # Errors
/// A density that is negative or not finite; bounds that make no sense.
pub fn fit_first(
    grid: &DensityGrid,
    space: &UnitSpace,
    settings: &FitSettings,
    progress: &mut dyn FnMut(FitProgress),
) -> Result<Fit, FitError> {
    let bounds = settings.bounds()?;
    let Some(objective) = objective(grid, space, settings)? else { return Ok(Fit::default()) };
    let n = settings.gaussians.min(affordable(grid, space, &bounds));
    if n == 0 {
        return Ok(finish(grid, space, Fit::default(), &objective, &[]));
    }
    let mut optimise = || -> Result<Fit, argmin::core::Error> {
        let most = settings.first_evaluations;
        let x = initial(grid, &objective, n, &bounds);
        let mut descent = Descent::new(&objective, x, bounds, settings.memory, settings.tolerance, most)?;
        let interval = if settings.teleport_every == 0 { DEFAULT_INTERVAL } else { settings.teleport_every };
        let mut fit = Fit::default();
        loop {
            let going = descent.advance(interval)?;
            progress(FitProgress { evaluations: descent.evaluations(), most, error: descent.cost });
            if descent.evaluations() >= most {
                break;
            }
            // A Gaussian that moves late has no time to settle.
            let time = settings.teleport_every > 0 && descent.evaluations() + 2 * interval as usize <= most;
            let moved = match settings.teleport_rule {
                _ if !time => 0,
                Rule::Single if !going => teleport::at_rest(&mut descent, fit.teleports as u64),
                rule => teleport::teleport(&mut descent, rule),
            };
            fit.teleports += moved;
            if !going && moved == 0 {
                break;
            }
            descent.rescale();
        }
        Ok(close(grid, space, fit, &objective, &descent))
    };
    optimise().map_err(|e| FitError::Optimiser { grid: grid.name.clone(), message: e.to_string() })
}

/// The error that later frames are compared with: the least of all frames before; `before` starts as infinity.
///
/// The paper takes the first frame's. A sequence that begins with a puff much smaller than its box has a large error
/// there, and its rule would never insert. Frames without density, whose error is 0, do not count.
pub fn reference_error(before: f64, fit_error: f64) -> f64 {
    if fit_error > 0.0 { before.min(fit_error) } else { before }
}

/// Fits a frame that follows another. `previous` are that frame's Gaussians (as they lie in the pack), `reference` is
/// the [`reference_error`] of the frames before (it matters only where the number is not held).
///
/// A frame that may hold more than twice as many Gaussians as are left of the frame before is fitted as a first one.
///
/// # Errors
/// As [`fit_first`].
pub fn fit_next(
    grid: &DensityGrid,
    space: &UnitSpace,
    previous: &[Gaussian],
    reference: f64,
    settings: &FitSettings,
    progress: &mut dyn FnMut(FitProgress),
) -> Result<Fit, FitError> {
    let bounds = settings.bounds()?;
    let Some(objective) = objective(grid, space, settings)? else { return Ok(Fit::default()) };
    let affordable = affordable(grid, space, &bounds);
    let mut x = merged(variables(previous, objective.peak(), &bounds), &bounds);
    let keep = (x.len() / VARIABLES).saturating_sub(settings.deletions).min(affordable);
    retain_largest(&mut x, keep);
    let wanted = if settings.steady { settings.gaussians.min(affordable) } else { keep };
    if x.is_empty() || wanted > GROWTH * (x.len() / VARIABLES) {
        return fit_first(grid, space, settings, progress);
    }
    let optimise = || -> Result<Fit, argmin::core::Error> {
        let deleted = previous.len() - x.len() / VARIABLES;
        let mut most = settings.next_evaluations;
        let mut descent = Descent::new(&objective, x, bounds, settings.memory, settings.tolerance, most)?;
        let mut fit = Fit { deleted, ..Fit::default() };
        if settings.steady {
            let missing = wanted.saturating_sub(descent.x.len() / VARIABLES);
            fit.inserted += insert(&mut descent, missing);
            descent.advance(SETTLING)?;
            fit.teleports += teleport::teleport(&mut descent, settings.teleport_rule);
            descent.rescale();
        }
        loop {
            while descent.advance(DEFAULT_INTERVAL)? && descent.evaluations() < most {
                descent.rescale();
            }
            progress(FitProgress { evaluations: descent.evaluations(), most, error: descent.cost });
            let left = settings.insertions - fit.inserted.min(settings.insertions);
            if settings.steady || left == 0 || descent.cost <= settings.error_ratio * reference.max(LEAST_REFERENCE) {
                break;
            }
            let inserted = insert(&mut descent, left.div_ceil(2));
            if inserted == 0 {
                break;
            }
            fit.inserted += inserted;
            descent.allow(settings.insertion_evaluations);
            most = descent.evaluations() + settings.insertion_evaluations;
        }
        Ok(close(grid, space, fit, &objective, &descent))
    };
    optimise().map_err(|e| FitError::Optimiser { grid: grid.name.clone(), message: e.to_string() })
}

/// Inserts up to `most` Gaussians where they gain most; gives how many.
fn insert(descent: &mut Descent, most: usize) -> usize {
    let errors = descent.objective().errors(&descent.x);
    let places = teleport::places(descent, &errors, most);
    let mut new: Vec<[f64; VARIABLES]> = places.iter().map(|p| p.gaussian).collect();
    // Too many at once may overlap so much that the error rises.
    while !new.is_empty() && !descent.try_insert(&new) {
        new.truncate(new.len() / 2);
    }
    new.len()
}

fn objective(grid: &DensityGrid, space: &UnitSpace, settings: &FitSettings) -> Result<Option<Objective>, FitError> {
    if let Some(v) = grid.values.iter().position(|v| !(*v >= 0.0 && v.is_finite())) {
        let [nx, ny, _] = grid.dims;
        let local = [v % nx, v / nx % ny, v / (nx * ny)];
        let index = std::array::from_fn(|a| grid.origin[a] + local[a] as i32);
        return Err(FitError::Density { grid: grid.name.clone(), index, value: grid.values[v] });
    }
    Ok(Objective::new(grid, space, settings.scope))
}

/// The most Gaussians that are worth their bytes; none where even the largest is smaller than a voxel.
fn affordable(grid: &DensityGrid, space: &UnitSpace, bounds: &Bounds) -> usize {
    if bounds.radius[1] < space.scale {
        return 0;
    }
    grid.values.iter().filter(|v| **v > 0.0).count() / VOXELS_PER_GAUSSIAN
}

/// The variables of Gaussians, inside the bounds.
fn variables(gaussians: &[Gaussian], peak: f32, bounds: &Bounds) -> Vec<f64> {
    let one = |g: &Gaussian| {
        let [x, y, z] = g.center.map(f64::from);
        [x, y, z, bounds.radius(f64::from(g.radius)), bounds.weight(f64::from(g.weight / peak))]
    };
    gaussians.iter().flat_map(one).collect()
}

/// Makes one of Gaussians that have grown into one another: centres within a tenth of the radius, radii within a tenth.
fn merged(mut x: Vec<f64>, bounds: &Bounds) -> Vec<f64> {
    let mut i = 0;
    while i < x.len() {
        let mut j = i + VARIABLES;
        while j < x.len() {
            let r = x[i + 3];
            let square: f64 = (0..3).map(|a| (x[i + a] - x[j + a]).powi(2)).sum();
            if square < (0.1 * r).powi(2) && (x[j + 3] - r).abs() < 0.1 * r {
                x[i + 4] = bounds.weight(x[i + 4] + x[j + 4]);
                x.drain(j..j + VARIABLES);
            } else {
                j += VARIABLES;
            }
        }
        i += VARIABLES;
    }
    x
}

/// Deletes all but the `keep` Gaussians of largest integral; the order stays.
fn retain_largest(x: &mut Vec<f64>, keep: usize) {
    let integral = |i: &usize| x[i * VARIABLES + 4] * x[i * VARIABLES + 3].powi(3);
    let mut order: Vec<usize> = (0..x.len() / VARIABLES).collect();
    order.sort_by(|a, b| integral(b).total_cmp(&integral(a)).then(a.cmp(b)));
    order.truncate(keep);
    order.sort_unstable();
    *x = order.iter().flat_map(|i| x[i * VARIABLES..(i + 1) * VARIABLES].to_vec()).collect();
}

fn close(grid: &DensityGrid, space: &UnitSpace, fit: Fit, objective: &Objective, descent: &Descent) -> Fit {
    let counted = Fit { evaluations: descent.evaluations(), iterations: descent.iterations, ..fit };
    finish(grid, space, counted, objective, &descent.x)
}

/// Rounds the variables to f32 and measures what then is the sum, by the decoder's function.
fn finish(grid: &DensityGrid, space: &UnitSpace, mut fit: Fit, objective: &Objective, x: &[f64]) -> Fit {
    let one = |g: &[f64]| Gaussian {
        center: [g[0] as f32, g[1] as f32, g[2] as f32],
        radius: g[3] as f32,
        weight: g[4] as f32 * objective.peak(),
    };
    fit.gaussians = x.chunks(VARIABLES).map(one).collect();
    (fit.fit_error, fit.support_error) = errors_of(grid, space, &fit.gaussians);
    fit
}

/// `sum (D - S)^2 / sum D^2` of any Gaussians: over all voxels of the box, and over the support (the active voxels and
/// those with density). Zero for a frame without density.
pub fn errors_of(grid: &DensityGrid, space: &UnitSpace, gaussians: &[Gaussian]) -> (f64, f64) {
    let sum = smoke_runtime::medium::gaussian_sum::gaussian_sum(gaussians, space, grid.origin, grid.dims);
    let peak = grid.values.iter().copied().fold(0.0f32, f32::max);
    let (mut all, mut support, mut energy) = (0.0, 0.0, 0.0);
    for (v, (s, d)) in sum.iter().zip(&grid.values).enumerate() {
        let (e, d) = (f64::from((s - d) / peak), f64::from(d / peak));
        all += e * e;
        energy += d * d;
        if d != 0.0 || grid.active.get(v) {
            support += e * e;
        }
    }
    if energy > 0.0 { (all / energy, support / energy) } else { (0.0, 0.0) }
}

#[cfg(test)]
mod tests;
