//! How far an image is from a reference that is itself an estimate, such as a path tracer's.
//!
//! For samples a (image), b (reference) and s (standard error of b), over the samples of a mask:
//!
//! | figure | formula |
//! |---|---|
//! | N, the squared error | `mean((a - b)^2 - s^2)` |
//! | D, the squared truth | `mean(b^2 - s^2)` |
//! | R, and the relative RMSE | `max(0, N / D)`, and `sqrt(R)` |
//! | bias | `mean(a - b) / mean(b)` |
//!
//! `E (a - b)^2 = (a - t)^2 + s^2` for the truth t, so that the reference's own noise falls out of N and D, and what is
//! left is the error of the image alone.
//!
//! How sure that is follows from the same samples. To first order R varies as `mean(z) / D` with
//! `z = ((a - b)^2 - s^2) - R (b^2 - s^2)`. For normal noise `var z = 4 (a - t + R t)^2 s^2 + 2 (1 - R)^2 s^4`, which
//! `4 (a - b + R b)^2 s^2 - 2 (1 - R)^2 s^4` estimates without bias. Pixels are independent; the three channels of a pixel
//! come from the same paths, so the variance of their sum is only known to be at most three times the sum of theirs, and
//! that is what is taken. The standard error of the relative RMSE is `sqrt(R + e) - sqrt(R)`, e the standard error of R:
//! for a large R that is the usual `e / (2 sqrt R)`, and it stays finite at R = 0.
//!
//! Cost: three passes, a few operations a sample. Sums are f64, row by row, each row added up on its own.

use crate::image_difference::{Incomparable, NotFinite, Pair, compare};

/// What an image is off by, the reference's noise taken out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Distance {
    /// Root of the mean squared error over the root of the mean squared truth; 0 where the noise explains all of it,
    /// infinite if only the truth is 0.
    pub relative_rmse: f64,
    /// Its standard error, from the reference's noise.
    pub relative_rmse_error: f64,
    /// Mean of the error over the mean of the reference.
    pub bias: f64,
    /// Its standard error, from the reference's noise.
    pub bias_error: f64,
    /// Root of the mean squared standard error over the root of the mean squared truth: the reference's own noise.
    pub noise: f64,
    /// Pixels compared.
    pub pixels: usize,
}

/// The distance of `pair.test` from the truth that `pair.reference` estimates; `standard_error` is that of every sample
/// of the reference, in the reference's order, finite and at least 0.
///
/// # Errors
/// Those of [`compare`]; a `standard_error` that is not finite or of another length counts as the reference's fault.
pub fn distance(pair: &Pair<'_>, standard_error: &[[f32; 3]]) -> Result<Distance, Incomparable> {
    let plain = compare(pair)?;
    let (size, width) = (pair.test.len(), pair.width);
    if standard_error.len() != size {
        return Err(Incomparable::Size { test: size, reference: standard_error.len(), mask: size, width });
    }
    let counts = |i: &usize| pair.mask.is_none_or(|mask| mask[*i]);
    let legal = |i: usize| standard_error[i].iter().all(|s| (0.0..f32::INFINITY).contains(s));
    let mut bad = (0..size).filter(counts).filter(|&i| !legal(i));
    if let Some(first) = bad.next() {
        let first = [first % width, first / width];
        return Err(Incomparable::NotFinite(NotFinite { in_test: 0, in_reference: 1 + bad.count(), first }));
    }
    // Over all samples that count, of a function of error, reference and variance.
    let sum = |of: &dyn Fn(f64, f64, f64) -> f64| -> f64 {
        let sample = |i: usize, c: usize| {
            let (b, s) = (f64::from(pair.reference[i][c]), f64::from(standard_error[i][c]));
            of(f64::from(pair.test[i][c]) - b, b, s * s)
        };
        let pixel = |i: usize| (0..3).map(|c| sample(i, c)).sum::<f64>();
        let row = |start: usize| (start..start + width).filter(counts).map(pixel).sum::<f64>();
        (0..size).step_by(width).map(row).sum()
    };
    let error = sum(&|d, _, v| d * d - v);
    let truth = sum(&|_, b, v| b * b - v);
    let variance = sum(&|_, _, v| v);
    let (relative_rmse, relative_rmse_error, noise) = if truth > 0.0 {
        let ratio = (error / truth).max(0.0);
        let spread = sum(&|d, b, v| 4.0 * (d + ratio * b).powi(2) * v - 2.0 * (1.0 - ratio).powi(2) * v * v);
        let spread = (3.0 * spread).max(0.0).sqrt() / truth;
        (ratio.sqrt(), (ratio + spread).sqrt() - ratio.sqrt(), (variance / truth).sqrt())
    } else {
        // Noise alone, or black: there is nothing to be relative to.
        let figure = |over: f64| if over > 0.0 { f64::INFINITY } else { 0.0 };
        (figure(error), figure(variance), figure(variance))
    };
    let mean = plain.all.mean_reference * 3.0 * plain.pixels as f64;
    let bias_error = if variance == 0.0 { 0.0 } else { ((3.0 * variance).sqrt() / mean).abs() };
    let (bias, pixels) = (plain.all.bias, plain.pixels);
    Ok(Distance { relative_rmse, relative_rmse_error, bias, bias_error, noise, pixels })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Normal numbers: sums of twelve uniform ones (Irwin-Hall), variance 1, from a multiplicative generator.
    struct Noise(u64);

    impl Noise {
        fn next(&mut self) -> f64 {
            let mut uniform = || {
                self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (self.0 >> 11) as f64 / (1u64 << 53) as f64
            };
            (0..12).map(|_| uniform()).sum::<f64>() - 6.0
        }
    }

    /// 40 x 25 pixels of 0.2 to 1.2, no channel like the other.
    fn truth() -> Vec<[f32; 3]> {
        (0..1000).map(|i| [0, 1, 2].map(|c| 0.2 + ((7 * i + 31 * c) % 101) as f32 / 101.0)).collect()
    }

    /// The truth with noise of a tenth of each value; the same noise in all channels, or one for each.
    fn estimate(truth: &[[f32; 3]], noise: &mut Noise, together: bool) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let pixel = |p: &[f32; 3]| {
            let common = noise.next();
            p.map(|v| v * (1.0 + 0.1 * if together { common } else { noise.next() } as f32))
        };
        (truth.iter().map(pixel).collect(), truth.iter().map(|p| p.map(|v| 0.1 * v)).collect())
    }

    fn pair<'a>(test: &'a [[f32; 3]], reference: &'a [[f32; 3]]) -> Pair<'a> {
        Pair { width: 40, test, reference, mask: None }
    }

    /// Mean and standard deviation.
    fn moments(values: &[f64]) -> (f64, f64) {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt())
    }

    #[test]
    fn without_noise_the_figures_are_those_of_a_plain_comparison() {
        let truth = truth();
        let test: Vec<_> = truth.iter().map(|p| p.map(|v| 1.25 * v)).collect();
        let d = distance(&pair(&test, &truth), &vec![[0.0; 3]; 1000]).unwrap();
        assert!((d.relative_rmse - 0.25).abs() < 1e-6 && (d.bias - 0.25).abs() < 1e-6, "{d:?}");
        assert_eq!((d.relative_rmse_error, d.bias_error, d.noise, d.pixels), (0.0, 0.0, 0.0, 1000));
    }

    #[test]
    fn a_known_error_is_found_under_larger_noise_and_its_spread_is_the_one_foretold() {
        let truth = truth();
        for (factor, together) in [(1.05f32, false), (1.05, true), (1.3, false)] {
            let test: Vec<_> = truth.iter().map(|p| p.map(|v| factor * v)).collect();
            let mut noise = Noise(7);
            let found: Vec<Distance> = (0..400)
                .map(|_| {
                    let (reference, error) = estimate(&truth, &mut noise, together);
                    distance(&pair(&test, &reference), &error).unwrap()
                })
                .collect();
            let figures = |of: fn(&Distance) -> f64| moments(&found.iter().map(of).collect::<Vec<_>>());
            // Four standard errors of the mean of 400 runs, and the bias of a square root: var / (8 mean^3) < 1e-3.
            let expected = f64::from(factor) - 1.0;
            let ((mean, spread), (foretold, _)) = (figures(|d| d.relative_rmse), figures(|d| d.relative_rmse_error));
            assert!((mean - expected).abs() < 4.0 * spread / 20.0 + 1e-3, "{factor}: {mean}");
            let ((bias, bias_spread), (bias_foretold, _)) = (figures(|d| d.bias), figures(|d| d.bias_error));
            assert!((bias - expected).abs() < 4.0 * bias_spread / 20.0 + 1e-3, "{factor}: {bias}");
            // Channels in step: what is foretold is met; each on its own: sqrt(3) too much, and never too little. The
            // spread of 400 runs is known to 4 in 100, three of which are 12 %.
            let most = if together { 1.15 } else { 1.15 * 3f64.sqrt() };
            assert!(foretold > 0.88 * spread && foretold < most * spread, "{factor} {together}: {foretold} {spread}");
            assert!(bias_foretold > 0.88 * bias_spread && bias_foretold < most * bias_spread);
            let (noise, _) = figures(|d| d.noise);
            assert!((noise - 0.1).abs() < 0.002, "{noise}");
        }
    }

    #[test]
    fn a_perfect_image_is_within_its_standard_error_of_zero_where_a_plain_comparison_reports_the_noise() {
        let truth = truth();
        let mut noise = Noise(3);
        let mut within = 0;
        for _ in 0..200 {
            let (reference, error) = estimate(&truth, &mut noise, true);
            let d = distance(&pair(&truth, &reference), &error).unwrap();
            let plain = compare(&pair(&truth, &reference)).unwrap().all.relative_rmse;
            assert!((plain - 0.1).abs() < 0.02, "{plain}");
            // The square is what is normal: (relative + its error)^2 = R + e.
            let square = d.relative_rmse.powi(2);
            within += usize::from(square <= 2.0 * ((d.relative_rmse + d.relative_rmse_error).powi(2) - square));
        }
        // Two deviations to one side: 195 of 200 expected, with a deviation of 2.1; four of them below that.
        assert!(within >= 187, "{within} of 200");
    }

    #[test]
    fn black_images_and_broken_errors_give_no_nan() {
        let (black, white) = (vec![[0.0; 3]; 40], vec![[1.0; 3]; 40]);
        let none = vec![[0.0; 3]; 40];
        let d = distance(&pair(&black, &black), &none).unwrap();
        assert_eq!((d.relative_rmse, d.relative_rmse_error, d.bias, d.noise), (0.0, 0.0, 0.0, 0.0));
        let d = distance(&pair(&white, &black), &none).unwrap();
        assert_eq!((d.relative_rmse, d.bias), (f64::INFINITY, f64::INFINITY));
        let mut broken = none.clone();
        broken[41 - 2][1] = f32::NAN;
        let expected = NotFinite { in_test: 0, in_reference: 1, first: [39, 0] };
        assert_eq!(distance(&pair(&white, &white), &broken), Err(Incomparable::NotFinite(expected)));
        broken[39][1] = -1.0;
        assert!(distance(&pair(&white, &white), &broken).is_err());
        assert!(matches!(distance(&pair(&white, &white), &none[1..]), Err(Incomparable::Size { .. })));
    }
}
