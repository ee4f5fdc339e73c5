//! Whether an image differs from a reference by more than the noise of both.
//!
//! For samples a (test) and b (reference) with standard errors `s_a` and `s_b`, per channel and for their mean:
//!
//! | part | statistic | fails |
//! |---|---|---|
//! | mean | `z = sum(a - b) / sqrt(sum(s_a^2 + s_b^2))` | as surprising as 3 standard errors of a normal: a probability below 0.0027 |
//! | share | pixels with `abs(a - b) > 2 sqrt(s_a^2 + s_b^2)` | more than come up with a probability of 0.001 |
//! | exact | pixels where both standard errors are 0 and `a != b` | one |
//!
//! The mean finds a bias that is far below the noise of a pixel, the share an error that cancels in the mean, or standard
//! errors that are too small. The largest `z` of a pixel is told, with its probability among so many, and fails nothing:
//! pixels that few light paths reach are far from normal.
//!
//! A standard error that was estimated from n passes is itself uncertain, so the statistics follow Student's t, with
//! n - 1 degrees of freedom, or those of Welch (1947) and Satterthwaite (1946),
//! `(s_a^2 + s_b^2)^2 / (s_a^4 / (n_a - 1) + s_b^4 / (n_b - 1))`, sums over all pixels for the mean. With 8 passes 8.6 % of
//! the pixels lie beyond 2, not 4.6 %. The count of pixels with unequal probabilities is bounded by the binomial of their
//! mean (Hoeffding 1956). Pixels have to be independent: one pixel wide filters.
//!
//! The channels of a pixel come from the same light paths. Their mean is tested as if they moved together, with a
//! standard error of `(s_R + s_G + s_B) / 3`: the largest that it can have, so this row can only be too lenient.
//!
//! Cost: one pass, rows in parallel and added up in order; with noise on both sides a Student tail a sample.

use super::{Incomparable, Noise, Pair, check, check_noise, counts};
use crate::statistics::{binomial_bound, binomial_tail, normal_tail, student_tail};
use rayon::prelude::*;

/// Standard errors beyond which pixels are counted.
pub const BEYOND: f64 = 2.0;

/// The mean fails when its difference is as surprising as this many standard errors of a normal.
pub const MEAN_LIMIT: f64 = 3.0;

/// The share fails when so many pixels beyond [`BEYOND`] have a probability below this.
pub const SHARE_TAIL: f64 = 0.001;

/// The difference of the image means.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeanTest {
    /// In standard errors; positive is too bright.
    pub z: f64,
    /// Degrees of freedom of its t distribution; `+inf` is a normal.
    pub freedom: f64,
    /// Probability of a difference as large by chance.
    pub p: f64,
}

/// The share of pixels beyond two standard errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShareTest {
    /// Pixels with a standard error above 0.
    pub pixels: usize,
    /// How many lie beyond.
    pub beyond: usize,
    /// The same over `pixels`; 0 if there are none.
    pub share: f64,
    /// The share to expect.
    pub expected: f64,
    /// The largest share that passes.
    pub bound: f64,
    /// Probability of as many or more by chance.
    pub p: f64,
}

/// The pixel that is most standard errors off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LargestZ {
    /// In standard errors; positive is too bright.
    pub z: f64,
    /// Column.
    pub x: usize,
    /// Row from the top.
    pub y: usize,
    /// Probability that among so many pixels one is as far off by chance.
    pub p: f64,
}

/// What the test looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The difference of the image means.
    Mean,
    /// The share of pixels beyond two standard errors.
    Share,
    /// Pixels without noise.
    Exact,
}

/// The test of one channel, or of the mean of all three.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ZFigures {
    /// The difference of the image means.
    pub mean: MeanTest,
    /// The share of pixels beyond two standard errors.
    pub share: ShareTest,
    /// The largest difference; z = 0 without noisy pixels.
    pub largest: LargestZ,
    /// Pixels without noise in either image that are not equal.
    pub unequal: usize,
}

impl ZFigures {
    /// The parts that fail; none is a pass.
    pub fn failed(&self) -> Vec<Part> {
        let passed = [
            (Part::Mean, self.mean.p >= normal_tail(MEAN_LIMIT)),
            (Part::Share, self.share.p >= SHARE_TAIL),
            (Part::Exact, self.unequal == 0),
        ];
        passed.into_iter().filter(|(_, passed)| !passed).map(|(part, _)| part).collect()
    }
}

/// The test of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ZTest {
    /// The mean of R, G and B.
    pub all: ZFigures,
    /// R, G, B.
    pub channels: [ZFigures; 3],
}

impl ZTest {
    /// Whether no part of any row fails. By chance alone about 1 image in 100 does not.
    pub fn passed(&self) -> bool {
        self.channels.iter().chain([&self.all]).all(|figures| figures.failed().is_empty())
    }
}

/// One noisy pixel.
#[derive(Clone, Copy)]
struct Sample {
    z: f64,
    freedom: f64,
    at: usize,
}

/// Sums of some pixels.
#[derive(Clone, Copy, Default)]
struct Sums {
    counted: usize,
    noisy: usize,
    beyond: usize,
    unequal: usize,
    difference: f64,
    variance: f64,
    /// `sum(s_a^4 / (n_a - 1) + s_b^4 / (n_b - 1))`.
    spread: f64,
    /// Sum of the probabilities to lie beyond.
    expected: f64,
    largest: Option<Sample>,
}

impl Sums {
    fn add(&mut self, other: &Self) {
        self.counted += other.counted;
        self.noisy += other.noisy;
        self.beyond += other.beyond;
        self.unequal += other.unequal;
        self.difference += other.difference;
        self.variance += other.variance;
        self.spread += other.spread;
        self.expected += other.expected;
        let magnitude = |s: &Option<Sample>| s.map_or(0.0, |s| s.z.abs());
        if magnitude(&other.largest) > magnitude(&self.largest) {
            self.largest = other.largest;
        }
    }

    fn figures(&self, width: usize) -> ZFigures {
        let z = if self.variance > 0.0 { self.difference / self.variance.sqrt() } else { 0.0 };
        let freedom = freedom(self.variance, self.spread);
        let (beyond, n) = (self.beyond as u64, self.noisy as u64);
        let over = |count: f64| if n > 0 { count / n as f64 } else { 0.0 };
        let expected = over(self.expected);
        let share = ShareTest {
            pixels: self.noisy,
            beyond: self.beyond,
            share: over(beyond as f64),
            expected,
            bound: over(binomial_bound(n, expected, SHARE_TAIL) as f64),
            p: binomial_tail(beyond, n, expected),
        };
        let largest = self.largest.map_or(LargestZ { z: 0.0, x: 0, y: 0, p: 1.0 }, |s| {
            // 1 - (1 - p)^n, and a difference of 1 itself has logarithm -inf: that gives 1.
            let none = n as f64 * (-student_tail(s.z, s.freedom)).ln_1p();
            LargestZ { z: s.z, x: s.at % width, y: s.at / width, p: -none.exp_m1() }
        });
        ZFigures { mean: MeanTest { z, freedom, p: student_tail(z, freedom) }, share, largest, unequal: self.unequal }
    }
}

/// Welch's and Satterthwaite's degrees of freedom; infinite where the variances are known.
fn freedom(variance: f64, spread: f64) -> f64 {
    if spread > 0.0 { variance * variance / spread } else { f64::INFINITY }
}

/// One row of the test; `value` takes the sample, or its standard error, from a pixel. None without pixels that count.
fn figures(
    pair: &Pair<'_>,
    reference: &Noise<'_>,
    test: Option<&Noise<'_>>,
    value: impl Fn(&[f32; 3]) -> f64 + Sync,
) -> Option<ZFigures> {
    // Variance of a mean, and its term of the spread.
    let variance = |noise: &Noise<'_>, i: usize| {
        let variance = value(&noise.standard_error[i]).powi(2);
        (variance, noise.passes.map_or(0.0, |n| variance * variance / (f64::from(n) - 1.0)))
    };
    let row = |y: usize| {
        let mut row = Sums::default();
        // The tail beyond, kept while the degrees of freedom stay: with noise on one side they are the same everywhere.
        let (mut known, mut tail) = (f64::INFINITY, student_tail(BEYOND, f64::INFINITY));
        for at in (y * pair.width..(y + 1) * pair.width).filter(|&i| counts(pair, i)) {
            let (of_reference, of_test) = (variance(reference, at), test.map_or((0.0, 0.0), |n| variance(n, at)));
            let (variance, spread) = (of_reference.0 + of_test.0, of_reference.1 + of_test.1);
            let difference = value(&pair.test[at]) - value(&pair.reference[at]);
            let mut one = Sums { counted: 1, ..Sums::default() };
            if variance > 0.0 {
                let sample = Sample { z: difference / variance.sqrt(), freedom: freedom(variance, spread), at };
                if sample.freedom != known {
                    (known, tail) = (sample.freedom, student_tail(BEYOND, sample.freedom));
                }
                let beyond = usize::from(sample.z.abs() > BEYOND);
                one = Sums {
                    noisy: 1,
                    beyond,
                    difference,
                    variance,
                    spread,
                    expected: tail,
                    largest: Some(sample),
                    ..one
                };
            } else {
                one.unequal = usize::from(difference != 0.0);
            }
            row.add(&one);
        }
        row
    };
    let rows: Vec<Sums> = (0..pair.test.len() / pair.width).into_par_iter().map(row).collect();
    let mut sums = Sums::default();
    rows.iter().for_each(|row| sums.add(row));
    (sums.counted > 0).then(|| sums.figures(pair.width))
}

/// Tests an image against a mean with `reference` noise, over the pixels that count; `test` is the image's own noise, if
/// it has any.
pub fn z_test(pair: &Pair<'_>, reference: &Noise<'_>, test: Option<&Noise<'_>>) -> Result<ZTest, Incomparable> {
    check(pair)?;
    check_noise(pair, reference)?;
    test.map_or(Ok(()), |noise| check_noise(pair, noise))?;
    let row = |value: &(dyn Fn(&[f32; 3]) -> f64 + Sync)| figures(pair, reference, test, value);
    let channel = |c: usize| row(&move |p: &[f32; 3]| f64::from(p[c]));
    let all = row(&|p: &[f32; 3]| p.iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0);
    let (Some(all), Some(r), Some(g), Some(b)) = (all, channel(0), channel(1), channel(2)) else {
        return Err(Incomparable::Empty);
    };
    Ok(ZTest { all, channels: [r, g, b] })
}

#[cfg(test)]
mod tests {
    use super::super::testing::{Measured, Normal, truth};
    use super::*;

    fn pair<'a>(width: usize, test: &'a [[f32; 3]], reference: &'a [[f32; 3]]) -> Pair<'a> {
        Pair { width, test, reference, mask: None }
    }

    #[test]
    fn every_figure_of_four_pixels_has_its_closed_form() {
        // Differences of 1, -2, 5 and 3 standard errors of 0.5, 0.5, 0.5 and 1 in green; the others are equal.
        let reference = vec![[4.0; 3]; 4];
        let mut test = reference.clone();
        [0.5, -1.0, 2.5, 3.0].iter().zip(&mut test).for_each(|(d, pixel)| pixel[1] += d);
        let standard_error = vec![[0.5; 3], [0.5; 3], [0.5; 3], [1.0; 3]];
        let noise = Noise { standard_error: &standard_error, passes: Some(8) };
        let found = z_test(&pair(2, &test, &reference), &noise, None).unwrap();
        let green = found.channels[1];
        let close = |a: f64, b: f64| assert!((a - b).abs() <= 1e-12 * b.abs(), "{a} {b}");
        close(green.mean.z, 5.0 / 1.75f64.sqrt());
        close(green.mean.freedom, 1.75 * 1.75 / ((3.0 / 16.0 + 1.0) / 7.0));
        close(green.mean.p, student_tail(green.mean.z, green.mean.freedom));
        let expected = student_tail(2.0, 7.0);
        assert_eq!((green.share.pixels, green.share.beyond, green.share.share), (4, 2, 0.5));
        close(green.share.expected, expected);
        close(green.share.p, binomial_tail(2, 4, expected));
        // Three of four pixels come up with 2.3e-3, four with 5e-5.
        assert_eq!(green.share.bound, 0.75);
        assert_eq!((green.largest.z, green.largest.x, green.largest.y), (5.0, 0, 1));
        close(green.largest.p, 1.0 - (1.0 - student_tail(5.0, 7.0)).powi(4));
        assert_eq!((found.channels[0].mean.z, found.channels[0].share.beyond), (0.0, 0));
        // The mean of the channels: a third of green's differences, and the same standard errors.
        close(found.all.mean.z, green.mean.z / 3.0);
    }

    #[test]
    fn noise_on_both_sides_adds_up_with_welchs_degrees_of_freedom() {
        let (test, reference) = (vec![[3.0; 3]], vec![[1.0; 3]]);
        let (of_test, of_reference) = (vec![[0.3; 3]], vec![[0.4; 3]]);
        let noise = |standard_error, passes| Noise { standard_error, passes };
        let run =
            |a, b| z_test(&pair(1, &test, &reference), &noise(&of_reference, b), Some(&noise(&of_test, a))).unwrap();
        let found = run(Some(5), Some(11)).all;
        // Standard errors are in f32: 6e-8 of themselves.
        assert!((found.largest.z - 4.0).abs() < 1e-6);
        let freedom = 0.25f64 * 0.25 / (0.0081 / 4.0 + 0.0256 / 10.0);
        assert!((found.mean.freedom / freedom - 1.0).abs() < 1e-6, "{}", found.mean.freedom);
        assert_eq!(run(None, None).all.mean.freedom, f64::INFINITY);
        let one_side = run(None, Some(11)).all.mean.freedom;
        assert!((one_side - 0.0625 / 0.00256).abs() < 1e-4, "{one_side}");
    }

    /// How many of `images` fail by mean and by share, over all channels; three tests an image.
    fn failures(images: usize, mut image: impl FnMut() -> ZTest) -> [u64; 2] {
        let mut failures = [0; 2];
        for _ in 0..images {
            for figures in image().channels {
                let failed = figures.failed();
                failures[0] += u64::from(failed.contains(&Part::Mean));
                failures[1] += u64::from(failed.contains(&Part::Share));
            }
        }
        failures
    }

    #[test]
    fn an_image_that_is_right_passes_at_the_stated_rate_however_few_the_passes() {
        let truth = truth(20, 20);
        for (passes, seed) in [(2, 1), (4, 2), (8, 3), (64, 4)] {
            let mut normal = Normal::new(seed);
            let [mean, share] = failures(200, || {
                let reference = Measured::new(&truth, 0.3, passes, &mut normal);
                z_test(&pair(20, &truth, &reference.mean), &reference.noise(), None).unwrap()
            });
            // 600 tests each: as many failures come up with a probability of 1e-4 at most.
            assert!(mean <= binomial_bound(600, normal_tail(3.0), 1e-4), "{passes} passes: {mean} means");
            assert!(share <= binomial_bound(600, SHARE_TAIL, 1e-4), "{passes} passes: {share} shares");
        }
    }

    #[test]
    fn two_noisy_images_of_the_same_truth_pass_at_the_stated_rate() {
        let truth = truth(20, 20);
        let mut normal = Normal::new(5);
        let [mean, share] = failures(200, || {
            let reference = Measured::new(&truth, 0.3, 8, &mut normal);
            let test = Measured::new(&truth, 0.9, 24, &mut normal);
            z_test(&pair(20, &test.mean, &reference.mean), &reference.noise(), Some(&test.noise())).unwrap()
        });
        assert!(mean <= binomial_bound(600, normal_tail(3.0), 1e-4), "{mean} means");
        // Welch's t is an approximation: the share may be off by a tenth of its 5 %, less than 400 pixels can see.
        assert!(share <= binomial_bound(600, 2.0 * SHARE_TAIL, 1e-4), "{share} shares");
    }

    #[test]
    fn taking_few_passes_for_many_is_found_out() {
        let truth = truth(64, 64);
        let reference = Measured::new(&truth, 0.3, 8, &mut Normal::new(6));
        let images = pair(64, &truth, &reference.mean);
        assert!(z_test(&images, &reference.noise(), None).unwrap().passed());
        // 8.6 % lie beyond two, and a normal would have 4.6 %.
        let found = z_test(&images, &Noise { passes: None, ..reference.noise() }, None).unwrap();
        assert!(found.channels.iter().all(|c| c.failed() == [Part::Share]), "{found:?}");
    }

    #[test]
    fn a_bias_of_one_per_cent_under_ten_times_as_much_noise_is_found() {
        let truth = truth(64, 64);
        // 16 passes of 40 %: 10 % a pixel, 0.2 % in the mean of 4096.
        let reference = Measured::new(&truth, 0.4, 16, &mut Normal::new(7));
        assert!(z_test(&pair(64, &truth, &reference.mean), &reference.noise(), None).unwrap().passed());
        for (factor, sign) in [(1.01, 1.0), (0.99, -1.0)] {
            let biased: Vec<_> = truth.iter().map(|p| p.map(|v| v * factor)).collect();
            let found = z_test(&pair(64, &biased, &reference.mean), &reference.noise(), None).unwrap();
            assert!(!found.passed());
            for figures in found.channels {
                assert_eq!(figures.failed(), [Part::Mean], "{figures:?}");
                assert!(figures.mean.z * sign > 3.0);
            }
        }
    }

    #[test]
    fn standard_errors_that_are_a_fifth_too_small_and_errors_that_cancel_are_found_by_the_share() {
        let truth = truth(64, 64);
        let reference = Measured::new(&truth, 0.4, 16, &mut Normal::new(8));
        let small: Vec<_> = reference.standard_error.iter().map(|p| p.map(|v| v * 0.8)).collect();
        let noise = Noise { standard_error: &small, ..reference.noise() };
        let found = z_test(&pair(64, &truth, &reference.mean), &noise, None).unwrap();
        assert!(found.channels.iter().all(|c| c.failed() == [Part::Share]), "{found:?}");
        // Brighter and darker in turn, by one standard error.
        let turn = |i: usize| if i.is_multiple_of(2) { 1.1 } else { 0.9 };
        let striped: Vec<_> = truth.iter().enumerate().map(|(i, p)| p.map(|v| v * turn(i))).collect();
        let found = z_test(&pair(64, &striped, &reference.mean), &reference.noise(), None).unwrap();
        assert!(found.channels.iter().all(|c| c.failed().contains(&Part::Share)), "{found:?}");
    }

    #[test]
    fn channels_that_move_together_do_not_count_three_times() {
        let truth = vec![[2.0; 3]; 400];
        let mut normal = Normal::new(9);
        let mut failed = 0;
        for _ in 0..300 {
            let mut reference = Measured::new(&truth, 0.3, 8, &mut normal);
            for image in [&mut reference.mean, &mut reference.standard_error] {
                image.iter_mut().for_each(|p| *p = [p[0]; 3]);
            }
            let found = z_test(&pair(20, &truth, &reference.mean), &reference.noise(), None).unwrap();
            assert!((found.all.mean.z - found.channels[0].mean.z).abs() < 1e-9);
            failed += u64::from(!found.all.failed().is_empty());
        }
        assert!(failed <= binomial_bound(300, normal_tail(3.0) + SHARE_TAIL, 1e-4), "{failed}");
    }

    #[test]
    fn pixels_without_noise_must_be_equal_to_the_last_bit() {
        let (reference, zero) = (vec![[0.7; 3]; 9], vec![[0.0; 3]; 9]);
        let noise = Noise { standard_error: &zero, passes: Some(8) };
        let found = z_test(&pair(3, &reference, &reference), &noise, None).unwrap();
        assert!(found.passed());
        let share = ShareTest { pixels: 0, beyond: 0, share: 0.0, expected: 0.0, bound: 0.0, p: 1.0 };
        assert_eq!((found.all.share, found.all.mean.p, found.all.largest.p), (share, 1.0, 1.0));
        let mut test = reference.clone();
        test[4][2] = 0.7f32.next_up();
        let found = z_test(&pair(3, &test, &reference), &noise, None).unwrap();
        assert_eq!((found.channels[2].failed(), found.channels[2].unequal), (vec![Part::Exact], 1));
        assert_eq!(found.channels[0].failed(), []);
        assert!(!found.passed());
    }

    #[test]
    fn the_mask_counts_and_poison_is_refused() {
        let (reference, error) = (vec![[1.0; 3]; 4], vec![[0.1; 3]; 4]);
        let mut test = reference.clone();
        test[3] = [9.0; 3];
        let noise = Noise { standard_error: &error, passes: None };
        let mask = [true, true, true, false];
        let masked = Pair { mask: Some(&mask), ..pair(2, &test, &reference) };
        let found = z_test(&masked, &noise, None).unwrap();
        assert!(found.passed() && found.all.share.pixels == 3);
        assert!(!z_test(&pair(2, &test, &reference), &noise, None).unwrap().passed());
        assert_eq!(z_test(&Pair { mask: Some(&[false; 4]), ..masked }, &noise, None), Err(Incomparable::Empty));
        let bad = Noise { passes: Some(1), ..noise };
        assert_eq!(z_test(&masked, &noise, Some(&bad)), Err(Incomparable::Passes(1)));
        test[0][0] = f32::NAN;
        assert!(matches!(z_test(&pair(2, &test, &reference), &noise, None), Err(Incomparable::NotFinite(_))));
    }

    #[test]
    fn the_figures_do_not_depend_on_the_threads() {
        let truth = truth(37, 29);
        let reference = Measured::new(&truth, 0.3, 8, &mut Normal::new(10));
        let test = Measured::new(&truth, 0.3, 5, &mut Normal::new(11));
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let images = pair(37, &test.mean, &reference.mean);
            pool.install(|| z_test(&images, &reference.noise(), Some(&test.noise())).unwrap())
        };
        assert_eq!(run(1), run(4));
    }
}
