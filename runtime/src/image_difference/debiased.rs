//! The error of an image without the noise of its reference.
//!
//! Against a reference b that is the mean of passes, with standard errors s, the mean of `(a - b)^2` holds the mean of
//! `s^2` on top of the error asked for, and the mean of `b^2` on top of the true one. Both are taken off again:
//!
//! `rel^2 = mean((a - b)^2 - s^2) / mean(b^2 - s^2)`, 0 if that is below 0.
//!
//! `s^2` is the unbiased estimate of the variance of b whatever the number of passes, so numerator and denominator are
//! unbiased. What is left scatters: where the noise is much above the error, half of the results are 0 and the others
//! about `noise (2 / samples)^(1/4)`. Noise of the image under test is its own error, and stays. Cost: one pass.

use super::{Incomparable, Noise, Pair, check, check_noise, counts};

/// The figures of one channel, or of all three together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DebiasedFigures {
    /// RMSE over the RMS of the reference, both without the reference's noise; `+inf` for a reference of noise alone.
    pub relative_rmse: f64,
    /// The noise itself: root of the mean `s^2` over the RMS of the reference.
    pub reference_noise: f64,
}

/// The figures of a comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Debiased {
    /// R, G and B together.
    pub all: DebiasedFigures,
    /// R, G, B.
    pub channels: [DebiasedFigures; 3],
}

/// Sums of one channel.
#[derive(Clone, Copy, Default)]
struct Sums {
    squared_error: f64,
    squared_reference: f64,
    variance: f64,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.squared_error += other.squared_error;
        self.squared_reference += other.squared_reference;
        self.variance += other.variance;
    }

    fn figures(&self) -> DebiasedFigures {
        let ratio = |over: f64, under: f64| match over > 0.0 {
            true if under > 0.0 => (over / under).sqrt(),
            true => f64::INFINITY,
            false => 0.0,
        };
        DebiasedFigures {
            relative_rmse: ratio(self.squared_error - self.variance, self.squared_reference - self.variance),
            reference_noise: ratio(self.variance, self.squared_reference),
        }
    }
}

/// Compares an image with a mean of known `noise`, over the pixels that count.
pub fn debiased(pair: &Pair<'_>, noise: &Noise<'_>) -> Result<Debiased, Incomparable> {
    check(pair)?;
    check_noise(pair, noise)?;
    let mut sums = [Sums::default(); 3];
    let mut pixels = 0;
    for y in 0..pair.test.len() / pair.width {
        let mut row = [Sums::default(); 3];
        for i in (y * pair.width..(y + 1) * pair.width).filter(|&i| counts(pair, i)) {
            pixels += 1;
            for channel in 0..3 {
                let sample = |image: &[[f32; 3]]| f64::from(image[i][channel]);
                let (a, b, s) = (sample(pair.test), sample(pair.reference), sample(noise.standard_error));
                let squares = Sums { squared_error: (a - b).powi(2), squared_reference: b * b, variance: s * s };
                row[channel].add(&squares);
            }
        }
        sums.iter_mut().zip(&row).for_each(|(sum, row)| sum.add(row));
    }
    if pixels == 0 {
        return Err(Incomparable::Empty);
    }
    let mut all = Sums::default();
    sums.iter().for_each(|s| all.add(s));
    Ok(Debiased { all: all.figures(), channels: sums.map(|s| s.figures()) })
}

#[cfg(test)]
mod tests {
    use super::super::compare;
    use super::super::testing::{Measured, Normal, truth};
    use super::*;

    #[test]
    fn a_planted_error_is_found_under_three_times_as_much_noise() {
        let truth = truth(200, 200);
        // Every sample is off by 1 % of itself, up or down; 8 passes of 8.5 % leave a noise of 3 %.
        let sign = |i: usize| if i.is_multiple_of(2) { 1.01 } else { 0.99 };
        let image: Vec<_> = truth.iter().enumerate().map(|(i, p)| p.map(|v| v * sign(i))).collect();
        let reference = Measured::new(&truth, 0.085, 8, &mut Normal::new(1));
        let pair = Pair { width: 200, test: &image, reference: &reference.mean, mask: None };
        let found = debiased(&pair, &reference.noise()).unwrap();
        // rel^2 = 1e-4 scatters by noise^2 sqrt(2 (1 + 1/7) / samples) = 9e-4 * 1.5 / sqrt(120,000) = 4e-6, samples of
        // unlike brightness at most double that: 4 % of rel at 1 standard deviation, 12 % at 3.
        assert!((found.all.relative_rmse - 0.01).abs() < 1.2e-3, "{}", found.all.relative_rmse);
        assert!((found.all.reference_noise - 0.03).abs() < 1e-3, "{}", found.all.reference_noise);
        found.channels.iter().for_each(|c| assert!((c.relative_rmse - 0.01).abs() < 2e-3, "{}", c.relative_rmse));
        // The plain figure holds the noise: that is the defect which this one repairs.
        assert!(compare(&pair).unwrap().all.relative_rmse > 0.03);
    }

    #[test]
    fn the_square_is_unbiased_with_two_passes_too() {
        let truth = truth(40, 40);
        let image: Vec<_> = truth.iter().map(|p| p.map(|v| v * 1.05)).collect();
        let mut normal = Normal::new(2);
        let mut square = || {
            let reference = Measured::new(&truth, 0.1, 2, &mut normal);
            let pair = Pair { width: 40, test: &image, reference: &reference.mean, mask: None };
            debiased(&pair, &reference.noise()).unwrap().all.relative_rmse.powi(2)
        };
        let squares: Vec<f64> = (0..100).map(|_| square()).collect();
        let mean = squares.iter().sum::<f64>() / 100.0;
        let variance = squares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / 99.0;
        // Four standard errors of the mean of 100 squares; without the correction it would be 0.0075.
        assert!((mean - 0.0025).abs() < 4.0 * (variance / 100.0).sqrt(), "{mean} {variance}");
        assert!(variance.sqrt() < 0.0005, "the test could not see the correction: {variance}");
    }

    #[test]
    fn without_noise_it_is_the_plain_figure_and_an_image_that_is_right_has_none() {
        let (truth, zero) = (truth(6, 5), vec![[0.0; 3]; 30]);
        let image: Vec<_> = truth.iter().map(|p| p.map(|v| v + 0.25)).collect();
        let noise = Noise { standard_error: &zero, passes: None };
        let pair = Pair { width: 6, test: &image, reference: &truth, mask: None };
        let found = debiased(&pair, &noise).unwrap();
        assert!((found.all.relative_rmse / compare(&pair).unwrap().all.relative_rmse - 1.0).abs() < 1e-14);
        assert_eq!(found.all.reference_noise, 0.0);
        let some = vec![[0.1; 3]; 30];
        let equal = Pair { test: &truth, ..pair };
        let found = debiased(&equal, &Noise { standard_error: &some, ..noise }).unwrap();
        assert!(found.all.relative_rmse == 0.0 && found.all.reference_noise > 0.0);
    }

    #[test]
    fn a_reference_of_noise_alone_gives_infinity_and_bad_standard_errors_are_named() {
        let (image, mut noisy) = (vec![[5.0; 3]; 6], vec![[1.0; 3]; 6]);
        let pair = Pair { width: 3, test: &image, reference: &noisy.clone(), mask: None };
        let with = |standard_error: &[[f32; 3]], passes| debiased(&pair, &Noise { standard_error, passes });
        assert_eq!(with(&noisy, None).unwrap().all.relative_rmse, f64::INFINITY);
        assert_eq!(with(&noisy[1..], None), Err(Incomparable::NoiseSize { found: 5, expected: 6 }));
        assert_eq!(with(&noisy, Some(1)), Err(Incomparable::Passes(1)));
        for bad in [f32::NAN, f32::INFINITY, -1e-9] {
            noisy[4][2] = bad;
            assert!(matches!(with(&noisy, None), Err(Incomparable::StandardError { x: 1, y: 1, .. })));
        }
        noisy[4][2] = f32::NAN;
        let mask = [true, true, true, true, false, true];
        let hidden = Pair { mask: Some(&mask), ..pair };
        assert!(debiased(&hidden, &Noise { standard_error: &noisy, passes: None }).is_ok());
    }
}
