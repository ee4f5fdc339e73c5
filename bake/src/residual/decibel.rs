//! PSNR in decibels, with the same bits on every machine: it lands in the pack, and so does the step chosen by it.
//!
//! `psnr = 10 log10(peak^2 / mean square)`. The standard library's logarithm and power are the system's and differ in the
//! last bit; here they are series of plain products and sums, good to 2e-15 relative.
//!
//! Source: ln m = 2 atanh((m - 1) / (m + 1)) (Abramowitz and Stegun 1964, 4.1.27), and the exponential's own series.

use std::f64::consts::{LN_2, LN_10, LOG2_10, SQRT_2};

/// Decibels of a mean square error under `peak`; infinite if the error is zero.
pub fn psnr(peak: f64, mean_square: f64) -> f64 {
    if mean_square == 0.0 {
        return f64::INFINITY;
    }
    // Two logarithms: the quotient could leave the range where its parts do not.
    10.0 * (2.0 * log10(peak) - log10(mean_square))
}

/// The mean square error that has `db` decibels under `peak`.
pub fn mean_square(peak: f64, db: f64) -> f64 {
    peak * peak * exp10(-db / 10.0)
}

/// log10 of a finite `v >= 0`; negative infinity at zero.
fn log10(v: f64) -> f64 {
    assert!(v >= 0.0 && v.is_finite(), "a logarithm of {v}");
    if v == 0.0 {
        return f64::NEG_INFINITY;
    }
    // Numbers below the normal range are lifted into it first.
    let (v, lifted) = if v < f64::MIN_POSITIVE { (v * 2f64.powi(64), 64.0) } else { (v, 0.0) };
    let exponent = (v.to_bits() >> 52) as i64 - 1023;
    let mantissa = f64::from_bits((v.to_bits() & 0x000f_ffff_ffff_ffff) | 0x3ff0_0000_0000_0000);
    let (mantissa, exponent) = if mantissa > SQRT_2 { (mantissa / 2.0, exponent + 1) } else { (mantissa, exponent) };
    let z = (mantissa - 1.0) / (mantissa + 1.0);
    // |z| <= 0.172, so the term after these is below 1e-18.
    let series = (0..11).rev().fold(0.0, |sum, k| sum * z * z + 1.0 / f64::from(2 * k + 1));
    ((exponent as f64 - lifted) * LN_2 + 2.0 * z * series) / LN_10
}

/// 10 to the power `x`: 0 below and infinite above the range of f64.
fn exp10(x: f64) -> f64 {
    let scaled = (x * LOG2_10).clamp(-1100.0, 1100.0);
    let whole = scaled.round_ties_even();
    let rest = (scaled - whole) * LN_2;
    // |rest| <= 0.35, so the term after these is below 1e-18.
    let series = (1..16).rev().fold(1.0, |sum, k| 1.0 + sum * rest / f64::from(k));
    // In two halves, so that neither leaves the range of exponents.
    let half = (whole / 2.0).round_ties_even();
    let power = |n: f64| f64::from_bits(((n as i64 + 1023) as u64) << 52);
    series * power(half) * power(whole - half)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithm_and_power_agree_with_the_standard_library() {
        for i in -3000..3000i32 {
            let x = f64::from(i) * 0.1;
            let power = exp10(x);
            // x log2(10) rounds by 1000 * 2^-53 at most, and the power by that times ln 2.
            assert!((power / 10f64.powf(x) - 1.0).abs() < 1.5e-13, "{x}");
            assert!((log10(power) - power.log10()).abs() < 1e-15 * x.abs().max(1.0) * 2.0, "{x}");
        }
        assert_eq!((log10(0.0), exp10(-1e9), exp10(1e9)), (f64::NEG_INFINITY, 0.0, f64::INFINITY));
        assert!((log10(5e-324) - 5e-324f64.log10()).abs() < 1e-12);
    }

    #[test]
    fn decibels_and_mean_square_are_inverse() {
        for db in [-20.0, 0.0, 47.3, 120.0] {
            assert!((psnr(0.7, mean_square(0.7, db)) - db).abs() < 1e-12);
        }
        assert!((psnr(1.0, 0.01) - 20.0).abs() < 1e-13);
        assert_eq!(psnr(1.0, 0.0), f64::INFINITY);
    }
}
