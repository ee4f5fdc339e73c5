//! `exp(-x)` and `exp(x^2) erfc(x)` for x >= 0 in f32, as loops that vectorise: polynomials, no tables, no branches.
//!
//! `exp(-x) = 2^n 2^f`, n an integer, |f| <= 1/2, and a polynomial of degree 5 for 2^f (minimax 9e-8, by weighted least
//! squares at Chebyshev points). `erfcx(x) = t P(t)`, `t = 1 / (1 + 0.4 x)`, degree 8 (minimax 1.3e-7). Own polynomials,
//! not the ones of `std`: they vectorise, and give the same bits on every machine.

/// `exp(-x)`, relative error below 5e-7 for 0 <= x <= 64; from there on 1.6e-28, which is as good as zero and far enough
/// above the subnormal numbers for products with it not to fall among them (which made the depths 2 to 3 times as slow).
/// A negative x counts as 0: a transmittance is never above 1.
#[inline(always)]
pub fn decay(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to the nearest integer, in the low bits.
    const ROUND: f32 = 12_582_912.0;
    // ln 2 in two parts: n * LN2_HIGH is exact, so that the fraction keeps its digits at large x.
    const LN2_HIGH: f32 = 0.693_145_75;
    const LN2_LOW: f32 = 1.428_606_8e-6;
    let x = -x.clamp(0.0, 64.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let f = ((x - n * LN2_HIGH) - n * LN2_LOW) * std::f32::consts::LOG2_E;
    let p = 0.001_326_472_2;
    let p = p * f + 0.009_671_513;
    let p = p * f + 0.055_507_336;
    let p = p * f + 0.240_222_42;
    let p = p * f + std::f32::consts::LN_2;
    let p = p * f + 1.0;
    // -93 <= n <= 0 sits in the low bits of `shifted`; moved into the exponent it multiplies p (0.7 to 1.42) by 2^n.
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// `exp(x^2) erfc(x)` for x >= 0, relative error below 6e-7 at any x up to the largest float.
#[inline(always)]
pub fn erfcx(x: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.4 * x);
    let p = 0.050_262_343;
    let p = p * t - 0.182_902_28;
    let p = p * t + 0.169_086_66;
    let p = p * t - 0.005_608_489;
    let p = p * t + 0.141_431_84;
    let p = p * t + 0.168_541_9;
    let p = p * t + 0.207_842_71;
    let p = p * t + 0.225_669_6;
    let p = p * t + 0.225_675_87;
    t * p
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error_function::erfcx as erfcx_f64;

    #[test]
    fn decay_follows_the_exponential_over_its_whole_range() {
        // 9e-8 of the polynomial, 2 roundings of the argument's fraction (|f| ln 2 < 0.35, twice 3e-8), 5 of Horner.
        for i in 0..64_000 {
            let x = i as f32 * 1e-3;
            let expected = (-f64::from(x)).exp();
            assert!((f64::from(decay(x)) / expected - 1.0).abs() < 5e-7, "{x}: {}", decay(x));
        }
        assert_eq!(decay(0.0), 1.0);
        assert_eq!(decay(-3.0), 1.0);
        assert!(decay(1e30) < 2e-28 && decay(f32::INFINITY) > 0.0);
    }

    #[test]
    fn erfcx_follows_the_double_precision_one() {
        for i in 0..20_000 {
            let x = if i < 10_000 { i as f32 * 1e-3 } else { 10.0 * 1.005f32.powi(i - 10_000).min(1e12) };
            let expected = erfcx_f64(f64::from(x));
            assert!((f64::from(erfcx(x)) / expected - 1.0).abs() < 6e-7, "{x}: {} {expected}", erfcx(x));
        }
    }
}
