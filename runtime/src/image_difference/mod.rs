//! How far an image is from a reference.
//!
//! | file | what |
//! |---|---|
//! | here | RMSE, PSNR, bias, largest error |
//! | `debiased` | the RMSE without the reference's own noise |
//! | `uncertainty` | how sure RMSE and bias are, given that noise |
//! | `z_test` | whether the difference can be told from noise |
//! | `flip` | the difference that a viewer sees |
//! | `false_colour` | differences as pictures |
//!
//! For samples a (test) and b (reference), over the pixels of a mask and per channel or over all three:
//!
//! | figure | formula |
//! |---|---|
//! | RMSE | `sqrt(mean((a - b)^2))` |
//! | relative RMSE | `RMSE / sqrt(mean(b^2))` |
//! | PSNR | `20 log10(max(b) / RMSE)` in dB, the peak is the reference's largest sample |
//! | bias | `mean(a - b) / mean(b)` |
//! | largest error | `max |a - b|`, with its pixel |
//!
//! Sums are f64, row by row from the top, each row added up on its own: the error of a mean over 2^26 pixels of f32 is
//! below 1e-12 of the mean magnitude. A sample that is not finite in either image is counted and named, and makes every
//! figure void: it is never averaged, and never skipped. Cost: one pass, a few operations a sample.

pub mod debiased;
pub mod false_colour;
pub mod flip;
pub mod uncertainty;
pub mod z_test;

#[cfg(test)]
mod testing;

/// Two images and the pixels to compare; pixels row by row from the top.
#[derive(Clone, Copy, Debug)]
pub struct Pair<'a> {
    /// Pixels in a row, at least 1.
    pub width: usize,
    /// The image under test.
    pub test: &'a [[f32; 3]],
    /// The truth, as many pixels as `test`.
    pub reference: &'a [[f32; 3]],
    /// Which pixels count, as many as `test`; all of them if none is given.
    pub mask: Option<&'a [bool]>,
}

/// The noise of an image that is the mean of passes.
#[derive(Clone, Copy, Debug)]
pub struct Noise<'a> {
    /// Standard error of every sample of the mean, as many pixels as the image; finite, at least 0, in its unit.
    pub standard_error: &'a [[f32; 3]],
    /// Passes that the standard errors were estimated from, at least 2; none: so many that they are exact.
    pub passes: Option<u32>,
}

/// The figures of one channel, or of all three together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figures {
    /// Root of the mean squared error.
    pub rmse: f64,
    /// RMSE over the RMS of the reference; 0 for equal images, `+inf` against a black reference.
    pub relative_rmse: f64,
    /// Peak signal-to-noise ratio in dB; `+inf` for equal images, `-inf` against a black reference.
    pub psnr: f64,
    /// Mean of the error over the mean of the reference; 0 for equal means, infinite if only the reference's is 0.
    pub bias: f64,
    /// Mean of the test image.
    pub mean_test: f64,
    /// Mean of the reference.
    pub mean_reference: f64,
}

/// The largest error of one sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LargestError {
    /// `|a - b|`.
    pub error: f64,
    /// Column.
    pub x: usize,
    /// Row from the top.
    pub y: usize,
    /// 0, 1, 2 for R, G, B.
    pub channel: usize,
}

/// A sample that is not finite, the first of its image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotFinite {
    /// Pixels of the test image with such a sample.
    pub in_test: usize,
    /// Pixels of the reference with such a sample.
    pub in_reference: usize,
    /// Column and row of the first in either image.
    pub first: [usize; 2],
}

/// All figures of a comparison.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// R, G and B together.
    pub all: Figures,
    /// R, G, B.
    pub channels: [Figures; 3],
    /// The largest error; the first of them, if several are equal.
    pub largest: LargestError,
    /// Pixels compared.
    pub pixels: usize,
}

/// Why two images have no figures.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Incomparable {
    /// The slices do not fit together.
    #[error("images differ in size: {test} and {reference} pixels, {mask} in the mask, in rows of {width}")]
    Size {
        /// Pixels of the test image.
        test: usize,
        /// Pixels of the reference.
        reference: usize,
        /// Entries of the mask, or as many as the test image without one.
        mask: usize,
        /// Pixels in a row.
        width: usize,
    },
    /// No pixel counts.
    #[error("no pixel to compare: the mask is empty")]
    Empty,
    /// NaN or infinity among the pixels that count.
    #[error(
        "not finite: {} pixels of the image, {} of the reference, the first at ({}, {})",
        .0.in_test, .0.in_reference, .0.first[0], .0.first[1]
    )]
    NotFinite(NotFinite),
    /// Standard errors for another image.
    #[error("standard errors of {found} pixels for an image of {expected}")]
    NoiseSize {
        /// Pixels with standard errors.
        found: usize,
        /// Pixels of the image.
        expected: usize,
    },
    /// A standard error below zero, NaN or infinite, at a pixel that counts.
    #[error("standard error {value} at ({x}, {y}): expected a finite number of at least 0")]
    StandardError {
        /// The first such sample.
        value: f32,
        /// Column.
        x: usize,
        /// Row from the top.
        y: usize,
    },
    /// One pass, or none, which has no standard error.
    #[error("standard errors from {0} passes: expected at least 2")]
    Passes(u32),
}

/// Sums of one channel.
#[derive(Clone, Copy, Default)]
struct Sums {
    squared_error: f64,
    squared_reference: f64,
    test: f64,
    reference: f64,
    peak: f64,
}

impl Sums {
    fn add_sample(&mut self, a: f64, b: f64) {
        let error = a - b;
        self.squared_error += error * error;
        self.squared_reference += b * b;
        self.test += a;
        self.reference += b;
        self.peak = self.peak.max(b);
    }

    fn add(&mut self, other: &Self) {
        self.squared_error += other.squared_error;
        self.squared_reference += other.squared_reference;
        self.test += other.test;
        self.reference += other.reference;
        self.peak = self.peak.max(other.peak);
    }

    fn figures(&self, samples: f64) -> Figures {
        let rmse = (self.squared_error / samples).sqrt();
        let rms = (self.squared_reference / samples).sqrt();
        // 0 / 0 is agreement here: both are black.
        let ratio = |over: f64, under: f64| if over == 0.0 { 0.0 } else { over / under };
        let psnr = if rmse == 0.0 { f64::INFINITY } else { 20.0 * (self.peak / rmse).log10() };
        Figures {
            rmse,
            relative_rmse: ratio(rmse, rms),
            psnr,
            bias: ratio(self.test - self.reference, self.reference),
            mean_test: self.test / samples,
            mean_reference: self.reference / samples,
        }
    }
}

/// Compares two images.
pub fn compare(pair: &Pair<'_>) -> Result<Difference, Incomparable> {
    check(pair)?;
    let mut sums = [Sums::default(); 3];
    let mut largest = LargestError { error: -1.0, x: 0, y: 0, channel: 0 };
    let mut pixels = 0;
    let rows = pair.test.chunks(pair.width).zip(pair.reference.chunks(pair.width));
    for (y, (test_row, reference_row)) in rows.enumerate() {
        let mut row = [Sums::default(); 3];
        for (x, (a, b)) in test_row.iter().zip(reference_row).enumerate() {
            if !counts(pair, x + pair.width * y) {
                continue;
            }
            pixels += 1;
            for channel in 0..3 {
                let (a, b) = (f64::from(a[channel]), f64::from(b[channel]));
                row[channel].add_sample(a, b);
                let error = (a - b).abs();
                if error > largest.error {
                    largest = LargestError { error, x, y, channel };
                }
            }
        }
        sums.iter_mut().zip(&row).for_each(|(sum, row)| sum.add(row));
    }
    if pixels == 0 {
        return Err(Incomparable::Empty);
    }
    let mut all = Sums::default();
    sums.iter().for_each(|s| all.add(s));
    let channels = sums.map(|s| s.figures(pixels as f64));
    Ok(Difference { all: all.figures(3.0 * pixels as f64), channels, largest, pixels })
}

/// Pixels where either alpha is above zero. A NaN counts as seen, so that it is not hidden by the mask.
pub fn seen(alpha: &[f32], other: Option<&[f32]>) -> Vec<bool> {
    let is_seen = |v: f32| v > 0.0 || v.is_nan();
    let other = |i: usize| other.is_some_and(|o| o.get(i).is_some_and(|v| is_seen(*v)));
    alpha.iter().enumerate().map(|(i, v)| is_seen(*v) || other(i)).collect()
}

fn counts(pair: &Pair<'_>, i: usize) -> bool {
    pair.mask.is_none_or(|mask| mask[i])
}

fn check(pair: &Pair<'_>) -> Result<(), Incomparable> {
    let (test, reference, width) = (pair.test.len(), pair.reference.len(), pair.width);
    let mask = pair.mask.map_or(test, <[bool]>::len);
    if test != reference || test != mask || width == 0 || !test.is_multiple_of(width) {
        return Err(Incomparable::Size { test, reference, mask, width });
    }
    let bad = |pixels: &[[f32; 3]], i: usize| counts(pair, i) && !pixels[i].iter().all(|v| v.is_finite());
    let count = |pixels: &[[f32; 3]]| (0..test).filter(|&i| bad(pixels, i)).count();
    match (0..test).find(|&i| bad(pair.test, i) || bad(pair.reference, i)) {
        None => Ok(()),
        Some(i) => Err(Incomparable::NotFinite(NotFinite {
            in_test: count(pair.test),
            in_reference: count(pair.reference),
            first: [i % width, i / width],
        })),
    }
}

fn check_noise(pair: &Pair<'_>, noise: &Noise<'_>) -> Result<(), Incomparable> {
    let (found, expected) = (noise.standard_error.len(), pair.test.len());
    if found != expected {
        return Err(Incomparable::NoiseSize { found, expected });
    }
    if let Some(passes) = noise.passes.filter(|n| *n < 2) {
        return Err(Incomparable::Passes(passes));
    }
    let good = |v: &f32| v.is_finite() && *v >= 0.0;
    for (i, pixel) in noise.standard_error.iter().enumerate().filter(|(i, _)| counts(pair, *i)) {
        if let Some(value) = pixel.iter().find(|v| !good(v)) {
            return Err(Incomparable::StandardError { value: *value, x: i % pair.width, y: i / pair.width });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::false_colour::signed;
    use super::*;

    fn pair<'a>(test: &'a [[f32; 3]], reference: &'a [[f32; 3]]) -> Pair<'a> {
        Pair { width: 4, test, reference, mask: None }
    }

    /// 4 x 3 pixels that are exact in f32, none zero.
    fn reference() -> Vec<[f32; 3]> {
        (0..12).map(|i| [1.0 + i as f32, 2.0 + 0.5 * i as f32, 4.0]).collect()
    }

    #[test]
    fn equal_images_have_no_error_and_infinite_psnr() {
        let r = reference();
        let d = compare(&pair(&r, &r)).unwrap();
        assert_eq!((d.all.rmse, d.all.relative_rmse, d.all.bias, d.largest.error), (0.0, 0.0, 0.0, 0.0));
        assert_eq!((d.all.psnr, d.pixels), (f64::INFINITY, 12));
    }

    #[test]
    fn one_planted_error_gives_the_closed_form_of_every_figure() {
        let r = reference();
        let mut t = r.clone();
        t[6][1] -= 1.5;
        let d = compare(&pair(&t, &r)).unwrap();
        let close = |a: f64, b: f64| assert!((a - b).abs() <= 1e-14 * b.abs(), "{a} {b}");
        // One of 36 samples is off by 1.5; the reference's squares by their sums of squares.
        let squares: f64 = (0..12).map(f64::from).map(|i| (1.0 + i).powi(2) + (2.0 + 0.5 * i).powi(2) + 16.0).sum();
        let sum: f64 = (0..12).map(f64::from).map(|i| 1.0 + i + 2.0 + 0.5 * i + 4.0).sum();
        close(d.all.rmse, 1.5 / 6.0);
        close(d.all.relative_rmse, 0.25 / (squares / 36.0).sqrt());
        close(d.all.psnr, 20.0 * (12.0_f64 / 0.25).log10());
        close(d.all.bias, -1.5 / sum);
        close(d.all.mean_reference, sum / 36.0);
        assert_eq!(d.largest, LargestError { error: 1.5, x: 2, y: 1, channel: 1 });
        assert_eq!((d.channels[0].rmse, d.channels[2].rmse), (0.0, 0.0));
        close(d.channels[1].rmse, 1.5 / 12f64.sqrt());
        close(d.channels[1].psnr, 20.0 * (7.5 / (1.5 / 12f64.sqrt())).log10());
        close(d.channels[1].bias, -1.5 / (0..12).map(|i| 2.0 + 0.5 * f64::from(i)).sum::<f64>());
    }

    #[test]
    fn opposite_errors_cancel_in_the_bias_and_not_in_the_rmse() {
        let r = reference();
        let mut t = r.clone();
        (t[0][0], t[1][0]) = (t[0][0] + 1.0, t[1][0] - 1.0);
        let d = compare(&pair(&t, &r)).unwrap();
        assert_eq!(d.all.bias, 0.0);
        assert!((d.all.rmse - (2.0f64 / 36.0).sqrt()).abs() < 1e-15);
    }

    #[test]
    fn a_mask_hides_what_lies_outside_and_keeps_what_lies_inside() {
        let r = reference();
        let mut t = r.clone();
        t[3] = [f32::NAN; 3];
        t[5][0] += 2.0;
        let alpha: Vec<f32> = (0..12).map(|i| if i == 5 { 1.0 } else { 0.0 }).collect();
        let mask = seen(&alpha, None);
        let d = compare(&Pair { mask: Some(&mask), ..pair(&t, &r) }).unwrap();
        assert_eq!((d.pixels, d.channels[0].rmse, d.channels[0].mean_reference), (1, 2.0, 6.0));
        let nothing = vec![false; 12];
        assert_eq!(compare(&Pair { mask: Some(&nothing), ..pair(&t, &r) }), Err(Incomparable::Empty));
    }

    #[test]
    fn the_mask_of_two_alphas_is_their_union_and_a_nan_counts_as_seen() {
        let mask = seen(&[0.0, 0.5, 0.0, f32::NAN], Some(&[1e-9, 0.0, 0.0, 0.0]));
        assert_eq!(mask, [true, true, false, true]);
    }

    #[test]
    fn samples_that_are_not_finite_are_counted_and_named_and_never_averaged() {
        let r = reference();
        let mut t = r.clone();
        (t[6][2], t[9][0]) = (f32::NAN, f32::INFINITY);
        let found = NotFinite { in_test: 2, in_reference: 0, first: [2, 1] };
        assert_eq!(compare(&pair(&t, &r)), Err(Incomparable::NotFinite(found)));
        let found = NotFinite { in_test: 0, in_reference: 2, first: [2, 1] };
        assert_eq!(compare(&pair(&r, &t)), Err(Incomparable::NotFinite(found)));
    }

    #[test]
    fn images_that_do_not_fit_together_are_refused() {
        let r = reference();
        for bad in [
            pair(&r[..8], &r),
            Pair { width: 5, ..pair(&r, &r) },
            Pair { width: 0, ..pair(&r, &r) },
            Pair { mask: Some(&[true]), ..pair(&r, &r) },
        ] {
            assert!(matches!(compare(&bad), Err(Incomparable::Size { .. })));
            assert!(matches!(signed(&bad, 1.0), Err(Incomparable::Size { .. })));
        }
        assert_eq!(compare(&Pair { width: 1, ..pair(&[], &[]) }), Err(Incomparable::Empty));
    }

    #[test]
    fn black_references_give_infinite_ratios_unless_the_image_is_black_too() {
        let (black, white) = (vec![[0.0; 3]; 4], vec![[1.0; 3]; 4]);
        let d = compare(&pair(&white, &black)).unwrap().all;
        assert_eq!((d.rmse, d.relative_rmse, d.bias), (1.0, f64::INFINITY, f64::INFINITY));
        assert_eq!(d.psnr, f64::NEG_INFINITY);
        let d = compare(&pair(&black, &black)).unwrap().all;
        assert_eq!((d.relative_rmse, d.bias, d.psnr), (0.0, 0.0, f64::INFINITY));
    }

    #[test]
    fn large_and_small_units_change_no_ratio() {
        let r = reference();
        let mut t = r.clone();
        t[4][2] *= 1.25;
        let expected = compare(&pair(&t, &r)).unwrap();
        for scale in [2f32.powi(-100), 2f32.powi(100)] {
            let by = |v: &[[f32; 3]]| v.iter().map(|p| p.map(|x| x * scale)).collect::<Vec<_>>();
            let d = compare(&pair(&by(&t), &by(&r))).unwrap();
            // Powers of two scale every operation exactly.
            assert_eq!((d.all.relative_rmse, d.all.bias), (expected.all.relative_rmse, expected.all.bias));
            assert!((d.all.psnr - expected.all.psnr).abs() < 1e-12 * expected.all.psnr);
        }
    }
}
