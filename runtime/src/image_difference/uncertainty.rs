//! How sure the figures of [`super::debiased`] and the bias are, from the reference's own noise.
//!
//! For samples a (image), b (reference) and s (standard error of b), N = mean((a - b)^2 - s^2) and D = mean(b^2 - s^2),
//! the debiased relative RMSE is sqrt(R), R = max(0, N / D). To first order R varies as `mean(z) / D` with
//! `z = ((a - b)^2 - s^2) - R (b^2 - s^2)`. For normal noise around the truth t,
//! `var z = 4 (a - t + R t)^2 s^2 + 2 (1 - R)^2 s^4`, which `4 (a - b + R b)^2 s^2 - 2 (1 - R)^2 s^4` estimates without
//! bias. Pixels are independent; the three channels of a pixel come from the same paths, so the variance of their sum is
//! only known to be at most three times the sum of theirs, and that is what is taken. The standard error of sqrt(R) is
//! `sqrt(R + e) - sqrt(R)`, e the standard error of R: for a large R that is the usual `e / (2 sqrt R)`, and it stays
//! finite at R = 0. That s is itself an estimate, from n passes, is left out: it adds `2 s^4 / (n - 1)` to `var z`.
//! Cost: four passes, a few operations a sample.

use super::{Incomparable, Noise, Pair, check, check_noise, counts};

/// Standard errors of the figures of a comparison, R, G and B together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uncertainty {
    /// Of [`super::debiased::DebiasedFigures::relative_rmse`]; infinite where that is.
    pub relative_rmse: f64,
    /// Of [`super::Figures::bias`]; infinite for noise around a mean of 0.
    pub bias: f64,
}

/// The uncertainty of a comparison with a mean of known `noise`, over the pixels that count.
pub fn uncertainty(pair: &Pair<'_>, noise: &Noise<'_>) -> Result<Uncertainty, Incomparable> {
    check(pair)?;
    check_noise(pair, noise)?;
    let size = pair.test.len();
    if !(0..size).any(|i| counts(pair, i)) {
        return Err(Incomparable::Empty);
    }
    // Over all samples that count, of a function of error, reference and variance; row by row, as everywhere here.
    let sum = |of: &dyn Fn(f64, f64, f64) -> f64| -> f64 {
        let sample = |i: usize, c: usize| {
            let (b, s) = (f64::from(pair.reference[i][c]), f64::from(noise.standard_error[i][c]));
            of(f64::from(pair.test[i][c]) - b, b, s * s)
        };
        let pixel = |i: usize| (0..3).map(|c| sample(i, c)).sum::<f64>();
        let row = |start: usize| (start..start + pair.width).filter(|i| counts(pair, *i)).map(pixel).sum::<f64>();
        (0..size).step_by(pair.width).map(row).sum()
    };
    let variance = sum(&|_, _, v| v);
    if variance == 0.0 {
        return Ok(Uncertainty { relative_rmse: 0.0, bias: 0.0 });
    }
    let truth = sum(&|_, b, v| b * b - v);
    let relative_rmse = if truth > 0.0 {
        let ratio = (sum(&|d, _, v| d * d - v) / truth).max(0.0);
        let spread = sum(&|d, b, v| 4.0 * (d + ratio * b).powi(2) * v - 2.0 * (1.0 - ratio).powi(2) * v * v);
        (ratio + (3.0 * spread).max(0.0).sqrt() / truth).sqrt() - ratio.sqrt()
    } else {
        f64::INFINITY
    };
    let bias = ((3.0 * variance).sqrt() / sum(&|_, b, _| b)).abs();
    Ok(Uncertainty { relative_rmse, bias })
}

#[cfg(test)]
mod tests {
    use super::super::debiased::debiased;
    use super::super::testing::{Normal, truth};
    use super::super::{Figures, compare};
    use super::*;

    /// The truth with noise of a tenth of each value; the same noise in all channels, or one for each.
    fn estimate(truth: &[[f32; 3]], normal: &mut Normal, together: bool) -> Vec<[f32; 3]> {
        let pixel = |p: &[f32; 3]| {
            let common = normal.next();
            p.map(|v| v * (1.0 + 0.1 * if together { common } else { normal.next() } as f32))
        };
        truth.iter().map(pixel).collect()
    }

    /// Debiased relative RMSE, bias, and their standard errors.
    fn figures(test: &[[f32; 3]], reference: &[[f32; 3]], standard_error: &[[f32; 3]]) -> ([f64; 2], [f64; 2]) {
        let pair = Pair { width: 40, test, reference, mask: None };
        let noise = Noise { standard_error, passes: None };
        let Figures { bias, .. } = compare(&pair).unwrap().all;
        let sure = uncertainty(&pair, &noise).unwrap();
        ([debiased(&pair, &noise).unwrap().all.relative_rmse, bias], [sure.relative_rmse, sure.bias])
    }

    /// Mean and standard deviation.
    fn moments(values: &[f64]) -> (f64, f64) {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt())
    }

    #[test]
    fn the_spread_of_many_noisy_references_is_the_one_foretold() {
        for (factor, together) in [(1.05f32, false), (1.05, true), (1.3, false)] {
            // Grey, and its noise too, or every channel on its own.
            let truth = truth(40, 25).into_iter().map(|p| if together { [p[0]; 3] } else { p }).collect::<Vec<_>>();
            let error: Vec<_> = truth.iter().map(|p| p.map(|v| 0.1 * v)).collect();
            let test: Vec<_> = truth.iter().map(|p| p.map(|v| factor * v)).collect();
            let mut normal = Normal::new(7);
            // The square of the relative RMSE is what is normal and without bias: (relative + its error)^2 = R + e.
            let runs: Vec<_> = (0..400)
                .map(|_| {
                    let ([rel, bias], [sure, bias_error]) =
                        figures(&test, &estimate(&truth, &mut normal, together), &error);
                    ([rel * rel, bias], [(rel + sure).powi(2) - rel * rel, bias_error])
                })
                .collect();
            let off = f64::from(factor) - 1.0;
            for (figure, expected) in [off * off, off].into_iter().enumerate() {
                let (mean, spread) = moments(&runs.iter().map(|r| r.0[figure]).collect::<Vec<_>>());
                let (foretold, _) = moments(&runs.iter().map(|r| r.1[figure]).collect::<Vec<_>>());
                // Four standard errors of the mean of 400 runs. The bias divides by a mean that is noise too: 1e-4.
                assert!((mean - expected).abs() < 4.0 * spread / 20.0 + 1e-4, "{factor}: {mean}");
                // Channels in step: what is foretold is met; each on its own: sqrt(3) too much, and never too little.
                // The spread of 400 runs is known to 4 in 100, three of which are 12 %.
                let most = if together { 1.15 } else { 1.15 * 3f64.sqrt() };
                assert!(foretold > 0.88 * spread && foretold < most * spread, "{factor}: {foretold} {spread}");
            }
        }
    }

    #[test]
    fn a_perfect_image_is_within_its_standard_error_of_zero() {
        let truth = truth(40, 25);
        let error: Vec<_> = truth.iter().map(|p| p.map(|v| 0.1 * v)).collect();
        let mut normal = Normal::new(3);
        let within = |_: &usize| {
            let ([relative, _], [sure, _]) = figures(&truth, &estimate(&truth, &mut normal, true), &error);
            // The square is what is normal: (relative + its error)^2 = R + e.
            relative.powi(2) <= 2.0 * ((relative + sure).powi(2) - relative.powi(2))
        };
        let within = (0..200).filter(within).count();
        // Two deviations to one side: 195 of 200 expected, with a deviation of 2.1; four of them below that.
        assert!(within >= 187, "{within} of 200");
    }

    #[test]
    fn no_noise_is_certain_and_noise_alone_is_not_known_at_all() {
        let (black, white) = (vec![[0.0; 3]; 40], vec![[1.0; 3]; 40]);
        assert_eq!(figures(&white, &black, &black).1, [0.0, 0.0]);
        assert_eq!(figures(&white, &black, &white).1, [f64::INFINITY; 2]);
        let pair = Pair { width: 40, test: &white, reference: &white, mask: Some(&[false; 40]) };
        let noise = Noise { standard_error: &white, passes: None };
        assert_eq!(uncertainty(&pair, &noise), Err(Incomparable::Empty));
        let mut broken = white.clone();
        broken[39][1] = f32::NAN;
        let noise = Noise { standard_error: &broken, passes: None };
        assert!(uncertainty(&Pair { mask: None, ..pair }, &noise).is_err());
    }
}
