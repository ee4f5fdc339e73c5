//! Quantises what the Gaussians miss, with a promise.
//!
//! On the support (source active or not zero) the code is `round((D - S) / step)` and a voxel decodes to
//! `max(0, S + step * code)` through [`dequantise`], the function that the decoder uses; elsewhere both are zero.
//!
//! Step for a promised error e. Let u = 2^-24, R = max |D - S|, M = max D. In exact numbers the code is off by half a
//! step. The division is f64 and the code below 2^23, so rounding it adds at most 2^-28 steps. The product rounds by at
//! most u |step * code| <= u (R + step), the sum by at most u (M + step) up to terms in u^2. The clamp moves the result
//! towards D >= 0, never away. So the error is at most `step / 2 * (1 + 2^-27) + u (R + M + 2 step)`, and with
//! step <= 2 e
//!
//! ```text
//! step = 2 (e - u (1 + 2^-20) (R + M + 4 e)) / (1 + 2^-26)        rounded down to f32
//! ```
//!
//! keeps the promise at every voxel. The result is measured all the same. A promise finer than f32 can keep is an error.
//!
//! For a promised PSNR the first step is that of a uniform quantiser, error step^2 / 12 (Widrow 1956), and the search
//! goes on with measured errors: a clamp at zero and codes of zero make it smaller.
//!
//! Cost: one pass over the box and one over the support, about 12 ns a voxel of the support; a PSNR tries a few steps and
//! takes three times as long.

use super::decibel;
use smoke_formats::residual::{MAX_CODE, ResidualCodes, dequantise};
use smoke_formats::volume::{DensityGrid, VoxelMask};

/// What is promised of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// No voxel is further off than this, > 0, in the source's density unit.
    MaxError(f64),
    /// At least this PSNR over active voxels.
    Psnr {
        /// Decibels.
        db: f64,
        /// Largest density of the sequence.
        peak: f32,
    },
}

/// The codes of a frame and how good they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Quantised {
    /// Density a code, > 0.
    pub step: f32,
    /// The codes.
    pub codes: ResidualCodes,
    /// Largest error of any voxel after decoding, measured.
    pub max_error: f64,
    /// PSNR over active voxels after decoding, measured; infinite if exact. The peak is [`Target::Psnr`]'s, or else the
    /// frame's largest density.
    pub psnr_db: f64,
}

/// Why a frame could not be quantised.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum QuantiseError {
    /// The Gaussian sum has another number of voxels than the source.
    #[error("the Gaussian sum has {sum} voxels, the source {source_voxels}")]
    Shape {
        /// Voxels of the sum.
        sum: usize,
        /// Voxels of the source.
        source_voxels: usize,
    },
    /// A density is negative or not finite.
    #[error("density of voxel {voxel}: found {found}, expected a finite number of 0 or more")]
    Density {
        /// Place in the grid's values.
        voxel: usize,
        /// Its density.
        found: f32,
    },
    /// A Gaussian sum is not finite.
    #[error("Gaussian sum of voxel {voxel}: found {found}, expected a finite number")]
    Sum {
        /// Place in the grid's values.
        voxel: usize,
        /// The sum there.
        found: f32,
    },
    /// 24-bit codes and f32 densities cannot keep the promise.
    #[error("promise {promise:?} cannot be kept by f32 densities up to {peak} and codes of 24 bits; promise less")]
    TooTight {
        /// The promise.
        promise: Target,
        /// Largest density or residual of the frame.
        peak: f64,
    },
}

/// The support of a frame, gathered once: densities, sums and whether a voxel is active.
struct Support {
    mask: VoxelMask,
    density: Vec<f32>,
    sum: Vec<f32>,
    active: Vec<bool>,
    /// max |D - S|.
    residual_max: f64,
    density_max: f64,
}

/// Quantises `source - sum`; `sum` is the Gaussian sum at every voxel of the source's box, in the same order.
pub fn quantise(source: &DensityGrid, sum: &[f32], target: Target) -> Result<Quantised, QuantiseError> {
    let support = gather(source, sum)?;
    let step = match target {
        Target::MaxError(max_error) => step_for_error(&support, max_error),
        Target::Psnr { db, peak } if db.is_finite() && peak >= 0.0 && peak.is_finite() => {
            step_for_psnr(&support, db, peak)
        }
        Target::Psnr { .. } => None,
    };
    let peak = support.residual_max.max(support.density_max);
    let too_tight = QuantiseError::TooTight { promise: target, peak };
    let step = step.filter(|&s| support.residual_max / f64::from(s) < f64::from(MAX_CODE) - 1.0);
    let step = step.ok_or(too_tight.clone())?;
    let mut codes = vec![0; support.density.len()];
    let measured = measure(&support, step, |i, code| codes[i] = code);
    let (promised, peak) = match target {
        Target::MaxError(max_error) => (measured.max_error <= max_error, support.density_max),
        Target::Psnr { db, peak } => (measured.psnr(f64::from(peak)) >= db, f64::from(peak)),
    };
    if !promised {
        return Err(too_tight);
    }
    let codes =
        ResidualCodes { origin: source.origin, dims: source.dims.map(|d| d as u32), support: support.mask, codes };
    Ok(Quantised { step, codes, max_error: measured.max_error, psnr_db: measured.psnr(peak) })
}

fn gather(source: &DensityGrid, sum: &[f32]) -> Result<Support, QuantiseError> {
    if sum.len() != source.len() {
        return Err(QuantiseError::Shape { sum: sum.len(), source_voxels: source.len() });
    }
    let mut s = Support {
        mask: VoxelMask::new(source.len()),
        density: vec![],
        sum: vec![],
        active: vec![],
        residual_max: 0.0,
        density_max: 0.0,
    };
    for (word, densities) in source.values.chunks(64).enumerate() {
        let active = source.active.words()[word];
        if active == 0 && densities.iter().all(|&d| d == 0.0) {
            continue;
        }
        for (bit, &density) in densities.iter().enumerate() {
            let (v, active) = (64 * word + bit, active >> bit & 1 == 1);
            if !active && density == 0.0 {
                continue;
            }
            if !(density >= 0.0 && density.is_finite()) {
                return Err(QuantiseError::Density { voxel: v, found: density });
            }
            if !sum[v].is_finite() {
                return Err(QuantiseError::Sum { voxel: v, found: sum[v] });
            }
            s.mask.set(v);
            s.density.push(density);
            s.sum.push(sum[v]);
            s.active.push(active);
            s.residual_max = s.residual_max.max((f64::from(density) - f64::from(sum[v])).abs());
            s.density_max = s.density_max.max(f64::from(density));
        }
    }
    Ok(s)
}

/// A step that f32 can hold with full precision, not above `step`.
fn round_down(step: f64) -> Option<f32> {
    let nearest = step.min(f64::from(f32::MAX)) as f32;
    let down = if f64::from(nearest) > step { nearest.next_down() } else { nearest };
    (down >= f32::MIN_POSITIVE).then_some(down)
}

/// The step of the module head.
fn step_for_error(s: &Support, max_error: f64) -> Option<f32> {
    const U: f64 = 1.0 / (1u64 << 24) as f64;
    let unit = U * (1.0 + 1.0 / f64::from(1 << 20));
    let margin = unit * (s.residual_max + s.density_max + 4.0 * max_error);
    round_down(2.0 * (max_error - margin) / (1.0 + 1.0 / f64::from(1 << 26)))
}

/// The largest step found whose measured PSNR is at least `db`: within 0.01 dB, or where no finer search helps.
fn step_for_psnr(s: &Support, db: f64, peak: f32) -> Option<f32> {
    let peak = f64::from(peak);
    let allowed = decibel::mean_square(peak, db);
    // A step at which every code is zero: larger ones are all the same.
    let widest = round_down((2.5 * s.residual_max).max(peak).max(f64::from(f32::MIN_POSITIVE)))?;
    let good = |squared: f64| decibel::psnr(peak, squared) >= db;
    if good(measure(s, widest, |_, _| ()).mean_square) {
        return Some(widest);
    }
    let (mut passing, mut failing) = (None::<f32>, widest);
    let mut step = round_down((12.0 * allowed).sqrt().min(0.5 * f64::from(widest)))?;
    for _ in 0..24 {
        if s.residual_max / f64::from(step) >= f64::from(MAX_CODE) - 1.0 {
            return passing;
        }
        let squared = measure(s, step, |_, _| ()).mean_square;
        if good(squared) {
            passing = Some(passing.map_or(step, |p| p.max(step)));
        } else {
            failing = step;
        }
        let bottom = f64::from(passing.unwrap_or(0.0));
        // 0.002 in the ratio of steps is 0.02 dB; a result within 0.01 dB of the target ends the search at once.
        if good(squared) && squared >= 0.9977 * allowed || bottom > 0.999 * f64::from(failing) {
            break;
        }
        let guess = f64::from(step) * (0.9995 * allowed / squared).sqrt();
        let inside = guess > bottom && guess < f64::from(failing);
        let middle = if bottom > 0.0 { (bottom * f64::from(failing)).sqrt() } else { 0.5 * f64::from(failing) };
        step = round_down(if inside { guess } else { middle })?;
    }
    passing
}

struct Measured {
    max_error: f64,
    /// Over active voxels; 0 if there are none.
    mean_square: f64,
}

impl Measured {
    fn psnr(&self, peak: f64) -> f64 {
        decibel::psnr(peak, self.mean_square)
    }
}

/// Quantises with `step` and measures what the decoder will give; `each(i, code)` sees every code.
fn measure(s: &Support, step: f32, mut each: impl FnMut(usize, i32)) -> Measured {
    let (mut max_error, mut square, mut voxels) = (0f64, 0f64, 0u64);
    for (i, ((&density, &sum), &active)) in s.density.iter().zip(&s.sum).zip(&s.active).enumerate() {
        let residual = f64::from(density) - f64::from(sum);
        let code = (residual / f64::from(step)).round_ties_even() as i32;
        let error = (f64::from(dequantise(sum, code, step)) - f64::from(density)).abs();
        max_error = max_error.max(error);
        if active {
            square += error * error;
            voxels += 1;
        }
        each(i, code);
    }
    Measured { max_error, mean_square: square / voxels.max(1) as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of `n` voxels in a row; voxels past `active` are inactive.
    fn grid(values: Vec<f32>, active: usize) -> DensityGrid {
        let mut mask = VoxelMask::new(values.len());
        (0..active).for_each(|v| mask.set(v));
        DensityGrid {
            name: "density".into(),
            origin: [-4, 0, 9],
            dims: [values.len(), 1, 1],
            values,
            active: mask,
            world_from_index: glam::DAffine3::IDENTITY,
        }
    }

    fn noise(seed: u64, n: usize) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (state >> 40) as f32 / (1 << 24) as f32
        };
        (0..n).map(|_| next()).collect()
    }

    /// The error at each voxel as the decoder sees it.
    fn errors(source: &DensityGrid, sum: &[f32], q: &Quantised) -> Vec<f64> {
        let mut next = q.codes.codes.iter();
        (0..source.len())
            .map(|v| {
                let decoded = match q.codes.support.get(v) {
                    true => dequantise(sum[v], *next.next().unwrap(), q.step),
                    false => 0.0,
                };
                (f64::from(decoded) - f64::from(source.values[v])).abs()
            })
            .collect()
    }

    #[test]
    fn the_promise_holds_at_every_voxel_for_every_scale_and_tightness() {
        for scale in [1e-6f32, 1.0, 1e6] {
            for relative in [0.3, 1e-2, 1e-4, 3e-6, 1e-6] {
                let values: Vec<f32> = noise(1, 20_000).iter().map(|v| (v - 0.2).max(0.0) * scale).collect();
                let sum: Vec<f32> = noise(2, 20_000).iter().map(|v| v * 1.3 * scale).collect();
                let source = grid(values, 15_000);
                let promise = relative * f64::from(scale);
                let q = quantise(&source, &sum, Target::MaxError(promise)).unwrap();
                let worst = errors(&source, &sum, &q).into_iter().fold(0.0, f64::max);
                assert!(worst <= promise, "{scale} {relative}: {worst}");
                assert_eq!(worst, q.max_error);
                // The step is not wasted: a promise well above f32 rounding is used to more than 99 %.
                assert!(relative < 1e-4 || worst > 0.99 * promise, "{scale} {relative}: {worst}");
            }
        }
    }

    #[test]
    fn a_step_without_its_margin_would_break_the_promise() {
        // The planted defect: step = 2 e. On the same data as above some voxel is off by more than e.
        let values: Vec<f32> = noise(1, 200_000).iter().map(|v| (v - 0.2).max(0.0)).collect();
        let sum: Vec<f32> = noise(2, 200_000).iter().map(|v| v * 1.3).collect();
        let source = grid(values, 200_000);
        let support = gather(&source, &sum).unwrap();
        let promise = 3e-6;
        assert!(measure(&support, (2.0 * promise) as f32, |_, _| ()).max_error > promise);
        assert!(quantise(&source, &sum, Target::MaxError(promise)).is_ok());
    }

    #[test]
    fn a_promise_finer_than_f32_is_an_error() {
        let source = grid(noise(1, 100), 100);
        let sum = noise(2, 100);
        for promise in [1e-8, 0.0, -1.0, f64::NAN] {
            let result = quantise(&source, &sum, Target::MaxError(promise));
            assert!(matches!(result, Err(QuantiseError::TooTight { .. })), "{promise}");
        }
        for (db, peak) in [(400.0, 1.0), (f64::NAN, 1.0), (f64::INFINITY, 1.0), (50.0, f32::NAN), (50.0, -1.0)] {
            let result = quantise(&source, &sum, Target::Psnr { db, peak });
            assert!(matches!(result, Err(QuantiseError::TooTight { .. })), "{db} {peak}");
        }
    }

    #[test]
    fn the_support_is_what_is_active_or_not_zero_and_the_rest_is_exactly_zero() {
        let source = grid(vec![0.0, 1.0, 0.0, 0.5, 0.0], 2);
        let sum = [0.2f32, 0.9, 0.7, 0.1, 0.3];
        let q = quantise(&source, &sum, Target::MaxError(0.01)).unwrap();
        assert_eq!(q.codes.support.iter_set().collect::<Vec<_>>(), [0, 1, 3]);
        assert!(errors(&source, &sum, &q).iter().all(|&e| e <= 0.01));
        assert_eq!((q.codes.origin, q.codes.dims), ([-4, 0, 9], [5, 1, 1]));
    }

    #[test]
    fn a_voxel_that_the_sum_already_keeps_has_code_zero() {
        let source = grid(vec![1.0, 0.5, 0.25], 3);
        let q = quantise(&source, &[1.009, 0.491, 0.25], Target::MaxError(0.01)).unwrap();
        assert_eq!(q.codes.codes, [0, 0, 0]);
    }

    #[test]
    fn the_psnr_is_met_and_not_by_much() {
        let values: Vec<f32> = noise(1, 20_000).iter().map(|v| (v - 0.2).max(0.0)).collect();
        let sum: Vec<f32> = values.iter().zip(noise(2, 20_000)).map(|(d, n)| (d + 0.2 * (n - 0.5)).max(0.0)).collect();
        let source = grid(values, 18_000);
        for db in [25.0, 40.0, 60.0, 90.0] {
            let q = quantise(&source, &sum, Target::Psnr { db, peak: 0.8 }).unwrap();
            assert!(q.psnr_db >= db && q.psnr_db < db + 0.05, "{db}: {}", q.psnr_db);
            let e = errors(&source, &sum, &q);
            let square = e[..18_000].iter().map(|e| e * e).sum::<f64>() / 18_000.0;
            assert!((10.0 * (0.64 / square).log10() - q.psnr_db).abs() < 1e-5);
        }
    }

    #[test]
    fn a_psnr_that_the_sum_already_has_needs_no_codes() {
        let source = grid(vec![1.0, 0.5], 2);
        let q = quantise(&source, &[0.99, 0.5], Target::Psnr { db: 20.0, peak: 1.0 }).unwrap();
        assert_eq!(q.codes.codes, [0, 0]);
    }

    #[test]
    fn empty_and_all_zero_frames_have_codes_of_zero() {
        for source in [grid(vec![], 0), grid(vec![0.0; 9], 0), grid(vec![0.0; 9], 9)] {
            let sum = vec![0.0; source.len()];
            for target in [Target::MaxError(0.01), Target::Psnr { db: 50.0, peak: 0.0 }] {
                let q = quantise(&source, &sum, target).unwrap();
                assert!(q.step > 0.0 && q.max_error == 0.0 && q.psnr_db == f64::INFINITY);
                assert!(q.codes.codes.iter().all(|&c| c == 0));
            }
        }
    }

    #[test]
    fn numbers_that_are_no_density_are_named() {
        for bad in [f32::NAN, f32::INFINITY, -1.0] {
            let source = grid(vec![0.0, bad], 2);
            let error = quantise(&source, &[0.0; 2], Target::MaxError(0.1)).unwrap_err();
            assert!(matches!(error, QuantiseError::Density { voxel: 1, .. }));
        }
        let source = grid(vec![0.0, 1.0], 2);
        let error = quantise(&source, &[f32::NAN, 1.0], Target::MaxError(0.1)).unwrap_err();
        assert!(matches!(error, QuantiseError::Sum { voxel: 0, .. }));
        assert!(matches!(
            quantise(&source, &[0.0], Target::MaxError(0.1)),
            Err(QuantiseError::Shape { sum: 1, source_voxels: 2 })
        ));
    }
}
