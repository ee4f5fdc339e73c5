//! The logistic function and the natural logarithm, by tables: the same bits on every machine.
//!
//! `squash(x) = 1 / (1 + exp(-x))` and `ln(x)`, both in f32 with only `+ - * /` and linear interpolation; the tables
//! are made at compile time from a Taylor series in f64. Absolute error of `squash` below 4e-6, of `ln` below 1e-5.

const STEPS_PER_UNIT: usize = 64;
const RANGE: usize = 12;
const SQUASH: [f32; 2 * RANGE * STEPS_PER_UNIT + 2] = squash_table();
const LN_STEPS: usize = 128;
const LN: [f32; LN_STEPS + 1] = ln_table();
const LN_2: f64 = std::f64::consts::LN_2;

const fn exp(x: f64) -> f64 {
    // exp(x) = exp(x / 64)^64, |x / 64| < 0.2: twelve terms leave less than 1e-17.
    let (y, mut sum, mut term, mut i) = (x / 64.0, 1.0, 1.0, 1);
    while i < 13 {
        term = term * y / i as f64;
        sum += term;
        i += 1;
    }
    let mut squarings = 0;
    while squarings < 6 {
        sum *= sum;
        squarings += 1;
    }
    sum
}

const fn squash_table() -> [f32; 2 * RANGE * STEPS_PER_UNIT + 2] {
    let mut table = [0.0; 2 * RANGE * STEPS_PER_UNIT + 2];
    let mut i = 0;
    while i < table.len() {
        let x = i as f64 / STEPS_PER_UNIT as f64 - RANGE as f64;
        table[i] = (1.0 / (1.0 + exp(-x))) as f32;
        i += 1;
    }
    table
}

const fn ln_table() -> [f32; LN_STEPS + 1] {
    let mut table = [0.0; LN_STEPS + 1];
    let mut i = 0;
    while i < table.len() {
        // ln(m) = 2 artanh(u), u = (m - 1) / (m + 1) <= 1/3: 2 u^(2j+1) / (2j+1) falls below 1e-17 within 17 terms.
        let m = 1.0 + i as f64 / LN_STEPS as f64;
        let u = (m - 1.0) / (m + 1.0);
        let (mut power, mut sum, mut j) = (u, 0.0, 0);
        while j < 18 {
            sum += 2.0 * power / (2 * j + 1) as f64;
            power *= u * u;
            j += 1;
        }
        table[i] = sum as f32;
        i += 1;
    }
    table
}

/// The logistic function; beyond |x| = 12 it stays at its value there. NaN gives the value at -12.
#[inline(always)]
pub(super) fn squash(x: f32) -> f32 {
    static TABLE: [f32; 2 * RANGE * STEPS_PER_UNIT + 2] = SQUASH;
    let limit = RANGE as f32;
    let x = if x > -limit { if x < limit { x } else { limit } } else { -limit };
    let at = (x + limit) * STEPS_PER_UNIT as f32;
    let i = at as usize;
    let fraction = at - i as f32;
    TABLE[i] + (TABLE[i + 1] - TABLE[i]) * fraction
}

/// The natural logarithm of a positive normal number.
#[inline(always)]
pub(super) fn ln(x: f32) -> f32 {
    static TABLE: [f32; LN_STEPS + 1] = LN;
    let bits = x.to_bits();
    let exponent = (bits >> 23 & 0xff) as i32 - 127;
    let i = (bits >> 16 & 0x7f) as usize;
    let fraction = (bits & 0xffff) as f32 * (1.0 / 65536.0);
    exponent as f32 * LN_2 as f32 + (TABLE[i] + (TABLE[i + 1] - TABLE[i]) * fraction)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tables_agree_with_the_functions_they_stand_for() {
        for i in -4000..4000 {
            let x = i as f32 * 0.00299;
            let truth = 1.0 / (1.0 + (-f64::from(x)).exp());
            // Linear interpolation: h^2/8 max|f''| = (1/64)^2/8 * 0.0963 = 2.9e-6, plus f32 rounding.
            assert!((f64::from(squash(x)) - truth).abs() < 4e-6, "{x}");
        }
        for i in 1..4000 {
            let x = i as f32 * i as f32 * 1e-3;
            // h^2/8 max|f''| = (1/128)^2/8 = 7.6e-6, plus rounding of exponent * ln 2 (20 * 6e-8).
            assert!((f64::from(ln(x)) - f64::from(x).ln()).abs() < 1e-5, "{x}");
        }
    }

    #[test]
    fn the_logistic_function_is_bounded_for_every_input() {
        for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 12.0, -12.0] {
            let y = squash(x);
            assert!(y > 0.0 && y < 1.0, "{x} gives {y}");
        }
    }
}
