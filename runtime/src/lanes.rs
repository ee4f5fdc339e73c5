//! Exponentials that vectorise: written as straight-line arithmetic, so that a loop over them becomes vector code,
//! and with the same bits on every machine (no library call, no fused multiply-add).
//!
//! `e^-x = 2^k (1 + q)` with `k = round(-x / ln 2)` and `q = expm1(f)`, `|f| <= ln 2 / 2`, a polynomial of degree 7
//! (truncated Taylor series: relative error below 1.2e-8 before rounding). Cost: about 15 operations a lane.

const LOG2_E: f32 = std::f32::consts::LOG2_E;
// ln 2 in two parts (Cody and Waite 1980): the first has few bits, so that k * LN2_HIGH is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;
// 1.5 * 2^23: adding it rounds to the nearest integer, which then lies in the low mantissa bits.
const ROUND: f32 = 12_582_912.0;
/// Arguments beyond this give the same result as this: `e^-87` is the last normal power in f32.
pub const LARGEST_EXPONENT: f32 = 87.0;

/// `(2^k, expm1(f))` with `e^-x = 2^k (1 + expm1(f))`, for `x >= 0`; x is clamped to [`LARGEST_EXPONENT`].
#[inline(always)]
fn split(x: f32) -> (f32, f32) {
    let y = -(x.min(LARGEST_EXPONENT));
    let rounded = y * LOG2_E + ROUND;
    let k = rounded - ROUND;
    let scale = f32::from_bits((rounded.to_bits() << 23).wrapping_add(0x3f80_0000));
    let f = y - k * LN2_HIGH - k * LN2_LOW;
    let p = 1.0 / 5040.0;
    let p = p * f + 1.0 / 720.0;
    let p = p * f + 1.0 / 120.0;
    let p = p * f + 1.0 / 24.0;
    let p = p * f + 1.0 / 6.0;
    let p = p * f + 0.5;
    (scale, f + f * f * p)
}

/// `e^-x` for `x >= 0`, relative error below 2e-7; at most 1, never zero.
#[inline(always)]
pub fn exp_neg(x: f32) -> f32 {
    let (scale, q) = split(x);
    scale + scale * q
}

/// `(e^-x, 1 - e^-x)` for `x >= 0`; both with small relative error, the second also where x is tiny.
#[inline(always)]
pub fn exp_neg_and_rest(x: f32) -> (f32, f32) {
    let (scale, q) = split(x);
    (scale + scale * q, (1.0 - scale) - scale * q)
}

/// Share of a cell's emission `1 - e^-x` that its near end has, where the source is linear in optical depth across it:
/// `1 / (1 - e^-x) - 1 / x`, which is 1/2 for a thin cell and goes to 1 for a thick one. `rest` is `1 - e^-x`.
#[inline(always)]
pub fn near_share(x: f32, rest: f32) -> f32 {
    // Series below 0.5, where the difference cancels; the next term is x^5 / 30240.
    let thin = 0.5 + x * (1.0 / 12.0) - x * x * x * (1.0 / 720.0);
    let thick = 1.0 / rest.max(0.3) - 1.0 / x.max(0.3);
    if x < 0.5 { thin } else { thick }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_neg_agrees_with_f64_over_its_range() {
        for i in 0..200_000u32 {
            let x = i as f32 * 4.3e-4;
            let truth = (-f64::from(x)).exp();
            let (e, rest) = exp_neg_and_rest(x);
            // 2e-7: four roundings of 6e-8 on top of the polynomial's 1.2e-8.
            assert!((f64::from(e) / truth - 1.0).abs() < 3e-7, "{x}: {e} {truth}");
            let rest_truth = -(-f64::from(x)).exp_m1();
            assert!((f64::from(rest) - rest_truth).abs() <= 3e-7 * rest_truth.max(1e-30), "{x}: {rest} {rest_truth}");
        }
    }

    #[test]
    fn the_near_share_agrees_with_f64_on_both_sides_of_its_seam() {
        for i in 1..4000u32 {
            let x = i as f32 * 0.01;
            let truth = 1.0 / -(-f64::from(x)).exp_m1() - 1.0 / f64::from(x);
            let found = near_share(x, exp_neg_and_rest(x).1);
            // 1e-6 for the series' next term, and 1e-6 for the cancellation of the two reciprocals.
            assert!((f64::from(found) - truth).abs() < 2e-6, "{x}: {found} {truth}");
        }
        assert_eq!(near_share(0.0, 0.0), 0.5);
        assert!((near_share(1e6, 1.0) - 1.0).abs() < 2e-6);
    }

    #[test]
    fn exp_neg_stays_in_zero_to_one_at_the_extremes() {
        for x in [0.0, 1e-30, 1e-6, 87.0, 88.0, 1e6, f32::MAX, f32::INFINITY] {
            let (e, rest) = exp_neg_and_rest(x);
            assert!((0.0..=1.0).contains(&e) && (0.0..=1.0).contains(&rest), "{x}: {e} {rest}");
        }
        assert_eq!(exp_neg_and_rest(0.0), (1.0, 0.0));
        assert!((exp_neg_and_rest(1e-6).1 / 1e-6 - 1.0).abs() < 1e-6);
    }
}
