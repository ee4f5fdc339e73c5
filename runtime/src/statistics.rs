//! Tail probabilities of the normal, Student's t and binomial distributions, for tests of images.
//!
//! | tail | formula |
//! |---|---|
//! | normal, `P(abs(Z) >= z)` | `erfc(z / sqrt 2)` |
//! | Student t, `P(abs(T) >= t)` | `I_x(v/2, 1/2)`, `x = v / (v + t^2)`, v degrees of freedom |
//! | binomial, `P(X >= k)` of n trials | `I_p(k, n - k + 1)` |
//!
//! `I_x(a, b)` is the regularised incomplete beta function (Abramowitz and Stegun 1964, 26.5.24 and 26.7.1), from its
//! continued fraction (26.5.8) by the method of Lentz (1976). The factor before the fraction is written as a distance
//! from the mode `a / (a + b)` and three remainders of Stirling's series, as Loader (2000, *Fast and Accurate Computation
//! of Binomial Probabilities*) does, so that 2^28 trials lose no digits to differences of large logarithms.
//! From 1e5 degrees of freedom on Student's t is the normal tail at Wallace's (1959) transformation of t.
//! Cost: about `sqrt(max(a, b))` terms near the mode, a few tens away from it.

use crate::error_function::erfcx;
use std::f64::consts::{PI, SQRT_2};

/// Degrees of freedom from which Student's t is transformed to a normal variate: the fraction loses digits with them.
const NORMAL_FROM: f64 = 1e5;

/// `P(|Z| >= |z|)` of a standard normal Z: 1 at 0, 0.0027 at 3. A NaN has 0, so that it never passes a test.
pub fn normal_tail(z: f64) -> f64 {
    let x = z.abs() / SQRT_2;
    if x >= 0.0 { if x < 40.0 { (-x * x).exp() * erfcx(x) } else { 0.0 } } else { 0.0 }
}

/// `P(|T| >= |t|)` of Student's t with `freedom` degrees of freedom, above 0; the normal tail if they are infinite.
/// A NaN in either has 0.
pub fn student_tail(t: f64, freedom: f64) -> f64 {
    let square = t * t;
    if !(freedom > 0.0 && square < f64::INFINITY) {
        return 0.0;
    }
    if freedom >= NORMAL_FROM {
        // Wallace 1959; what is left is of order 1/v^2.
        let (ratio, square) = if freedom < f64::INFINITY {
            ((8.0 * freedom + 1.0) / (8.0 * freedom + 3.0), freedom * (square / freedom).ln_1p())
        } else {
            (1.0, square)
        };
        return normal_tail(ratio * square.sqrt());
    }
    let sum = freedom + square;
    incomplete_beta(freedom / 2.0, 0.5, freedom / sum, square / sum)
}

/// `P(X >= k)` of a binomial X: `n` trials, each a success with probability `p` in [0, 1]. A NaN has 0.
pub fn binomial_tail(k: u64, n: u64, p: f64) -> f64 {
    match k {
        0 => 1.0,
        k if k > n || p <= 0.0 || p.is_nan() => 0.0,
        _ if p >= 1.0 => 1.0,
        k => incomplete_beta(k as f64, (n - k) as f64 + 1.0, p, 1.0 - p),
    }
}

/// The most successes that are not yet surprising: the largest k with `P(X >= k) >= tail`, for `tail` in (0, 1].
/// More than that come up with a probability below `tail`. Cost: `log2 n` tails.
pub fn binomial_bound(n: u64, p: f64, tail: f64) -> u64 {
    // P(X >= low) >= tail > P(X >= high), and the tail falls with k.
    let (mut low, mut high) = (0, n.saturating_add(1));
    while high - low > 1 {
        let middle = low + (high - low) / 2;
        if binomial_tail(middle, n, p) >= tail { low = middle } else { high = middle }
    }
    low
}

/// `I_x(a, b)` for `a, b > 0`, `x` and `y = 1 - x` in [0, 1]; both are taken because one may be too small beside 1.
fn incomplete_beta(a: f64, b: f64, x: f64, y: f64) -> f64 {
    // The fraction converges fast on this side of the mode; on the other it is that of the complement.
    if x <= (a + 1.0) / (a + b + 2.0) {
        beta_factor(a, b, x, y) / a * beta_fraction(a, b, x)
    } else {
        1.0 - beta_factor(b, a, y, x) / b * beta_fraction(b, a, y)
    }
}

/// `x^a y^b / B(a, b)`.
fn beta_factor(a: f64, b: f64, x: f64, y: f64) -> f64 {
    if x <= 0.0 || y <= 0.0 {
        return 0.0;
    }
    let (mode_x, mode_y) = (a / (a + b), b / (a + b));
    // The difference of the two smaller numbers is the exact one.
    let offset = if x < y { x - mode_x } else { mode_y - y };
    let log = |ratio: f64, value: f64, mode: f64| if ratio > -0.5 { ratio.ln_1p() } else { (value / mode).ln() };
    let exponent = a * log(offset / mode_x, x, mode_x) + b * log(-offset / mode_y, y, mode_y);
    let stirling = stirling_remainder(a + b) - stirling_remainder(a) - stirling_remainder(b);
    (exponent + stirling).exp() * (a * mode_y / (2.0 * PI)).sqrt()
}

/// `ln Gamma(x) - ((x - 1/2) ln x - x + ln(2 pi) / 2)`, x > 0.
fn stirling_remainder(mut x: f64) -> f64 {
    let mut below = 0.0;
    // Up the recurrence of Gamma, until the series' first term left out is below 1e-17.
    while x < 16.0 {
        below += (x + 0.5) * (1.0 / x).ln_1p() - 1.0;
        x += 1.0;
    }
    let square = 1.0 / (x * x);
    let series = 1.0 / 1680.0 - square / 1188.0;
    below + (1.0 / 12.0 - square * (1.0 / 360.0 - square * (1.0 / 1260.0 - square * series))) / x
}

/// The continued fraction of `I_x(a, b)`.
fn beta_fraction(a: f64, b: f64, x: f64) -> f64 {
    // Keeps a denominator that happens to vanish from dividing by zero.
    let away_from_zero = |v: f64| if v.abs() < 1e-300 { 1e-300 } else { v };
    let mut denominator = 1.0 / away_from_zero(1.0 - (a + b) * x / (a + 1.0));
    let (mut numerator, mut fraction) = (1.0, denominator);
    // At most 1e5 terms near the mode for the largest parameters in use; the limit guards against a loop without end.
    for m in 1..10_000_000 {
        let m = f64::from(m);
        let even = m * (b - m) * x / ((a + 2.0 * m - 1.0) * (a + 2.0 * m));
        let odd = -(a + m) * (a + b + m) * x / ((a + 2.0 * m) * (a + 2.0 * m + 1.0));
        let mut step = 1.0;
        for term in [even, odd] {
            denominator = 1.0 / away_from_zero(1.0 + term * denominator);
            numerator = away_from_zero(1.0 + term / numerator);
            step = denominator * numerator;
            fraction *= step;
        }
        if (step - 1.0).abs() < 1e-15 {
            break;
        }
    }
    fraction
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(found: f64, expected: f64, relative: f64) {
        assert!((found - expected).abs() <= relative * expected, "{found:e} {expected:e}");
    }

    #[test]
    fn the_normal_tail_has_its_tabulated_values() {
        // Abramowitz and Stegun, table 26.1, and the asymptotic series at 30.
        for (z, tail) in [
            (0.0, 1.0),
            (1.0, 0.317_310_507_862_914_1),
            (2.0, 0.045_500_263_896_358_4),
            (3.0, 0.002_699_796_063_260_19),
            (5.0, 5.733_031_437_583_87e-7),
            (30.0, 9.813_427_854_297_5e-198),
        ] {
            close(normal_tail(z), tail, 1e-12);
            assert_eq!(normal_tail(-z), normal_tail(z));
        }
        assert_eq!((normal_tail(1e9), normal_tail(f64::INFINITY), normal_tail(f64::NAN)), (0.0, 0.0, 0.0));
    }

    #[test]
    fn the_student_tail_has_its_tabulated_quantiles() {
        // Table 26.10: t with a tail of 0.05 on both sides together, and of 0.001.
        for (freedom, t_05, t_001) in [
            (1.0, 12.706_204_736, 636.619_248_8),
            (2.0, 4.302_652_730, 31.599_054_58),
            (7.0, 2.364_624_252, 5.407_882_521),
            (30.0, 2.042_272_456, 3.645_958_635),
            (120.0, 1.979_930_405, 3.373_453_769),
        ] {
            // Ten printed digits, and a tail that changes by at most 6 times as much.
            close(student_tail(t_05, freedom), 0.05, 1e-8);
            close(student_tail(-t_001, freedom), 0.001, 1e-8);
        }
    }

    #[test]
    fn the_student_tail_follows_the_closed_forms_of_one_and_two_degrees_of_freedom() {
        for i in -60..=60 {
            let t = 10f64.powf(f64::from(i) / 10.0);
            close(student_tail(t, 1.0), 1.0 - 2.0 / PI * t.atan(), 1e-9);
            // 1 - t / sqrt(2 + t^2) without the cancellation.
            let root = (2.0 + t * t).sqrt();
            close(student_tail(t, 2.0), 2.0 / (root * (root + t)), 1e-12);
        }
    }

    #[test]
    fn the_student_tail_tends_to_the_normal_one_and_its_branches_meet() {
        for t in [0.01, 1.0, 2.0, 4.0, 6.0] {
            for freedom in [1e4, 0.999e5, 1e5, 1e7, 1e12] {
                let difference = student_tail(t, freedom) / normal_tail(t) - 1.0;
                // First term of the expansion in 1/v: the tail grows by t (t^2 + 1) pdf(t) / (2 v); the next is smaller by
                // about t^4 / 4v, 3 % at most. Nine digits of the tails themselves.
                let density = (-t * t / 2.0).exp() / (2.0 * PI).sqrt();
                let expected = t * (t * t + 1.0) * density / (2.0 * freedom) / normal_tail(t);
                assert!((difference - expected).abs() < 0.03 * expected + 1e-9, "{t} {freedom}: {difference:e}");
            }
            let [below, above] = [NORMAL_FROM * (1.0 - 1e-12), NORMAL_FROM].map(|v| student_tail(t, v));
            // Both are off by at most t^6 / v^2 and by 1e5 roundings.
            assert!((below / above - 1.0).abs() < 1e-8, "{t}: {below:e} {above:e}");
            assert_eq!(student_tail(t, f64::INFINITY), normal_tail(t));
        }
    }

    #[test]
    fn poison_has_no_tail_and_so_fails_every_test() {
        for (t, freedom) in [(f64::NAN, 7.0), (2.0, f64::NAN), (2.0, 0.0), (2.0, -1.0), (f64::INFINITY, 7.0)] {
            assert_eq!(student_tail(t, freedom), 0.0);
        }
        assert_eq!((binomial_tail(3, 10, f64::NAN), student_tail(0.0, 7.0)), (0.0, 1.0));
    }

    #[test]
    fn the_binomial_tail_is_the_sum_of_its_terms() {
        for (n, p) in [(1, 0.3), (10, 0.2), (50, 0.0455), (200, 0.7), (500, 1e-3)] {
            let mut term: f64 = (1.0f64 - p).powi(n);
            let mut terms = vec![term];
            for k in 1..=n {
                term *= f64::from(n - k + 1) / f64::from(k) * p / (1.0 - p);
                terms.push(term);
            }
            for k in 0..=n {
                // From the smallest term: at most 500 roundings of 1e-16 each, and 500 in the recurrence.
                let sum: f64 = terms[k as usize..].iter().rev().sum();
                let found = binomial_tail(k as u64, n as u64, p);
                assert!((found - sum).abs() <= 1e-12 * sum.max(1e-3), "{n} {p} {k}: {found:e} {sum:e}");
            }
        }
    }

    #[test]
    fn two_to_the_28_trials_lose_no_digits() {
        // An odd number of fair trials: half of them or more with probability 1/2.
        let n: u64 = (1 << 28) - 1;
        close(binomial_tail(n.div_ceil(2), n, 0.5), 0.5, 1e-10);
        // Four standard deviations above the mean: the normal tail at the corrected distance, and the skewness term
        // (1 - 2p) (z^2 - 1) pdf(z) / (6 s) of the Edgeworth expansion; the next is z^5 / s^2 = 1e-4 of it.
        let p = 0.0455;
        let (mean, deviation) = (n as f64 * p, (n as f64 * p * (1.0 - p)).sqrt());
        let k = (mean + 4.0 * deviation).round();
        let z = (k - 0.5 - mean) / deviation;
        let density = (-z * z / 2.0).exp() / (2.0 * PI).sqrt();
        let expected = normal_tail(z) / 2.0 + (1.0 - 2.0 * p) * (z * z - 1.0) * density / (6.0 * deviation);
        close(binomial_tail(k as u64, n, p), expected, 1e-5);
    }

    #[test]
    fn the_bound_is_the_last_count_that_is_not_surprising() {
        for (n, p, tail) in [(1, 0.5, 0.6), (20, 0.0455, 1e-3), (128_000, 0.0856, 1e-3), (1 << 28, 0.0455, 1e-3)] {
            let bound = binomial_bound(n, p, tail);
            assert!(binomial_tail(bound, n, p) >= tail && binomial_tail(bound + 1, n, p) < tail, "{n}: {bound}");
        }
        assert_eq!(
            (binomial_bound(0, 0.5, 1e-3), binomial_bound(9, 0.0, 1e-3), binomial_bound(9, 1.0, 1e-3)),
            (0, 0, 9)
        );
    }
}
