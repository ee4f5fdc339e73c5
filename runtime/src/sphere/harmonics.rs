//! Real spherical harmonics up to order 6, as polynomials of the direction's coordinates.
//!
//! `y_lm = N_lm Q_l|m|(z) * Re (x + iy)^m` for m >= 0, the imaginary part of `(x + iy)^|m|` for m < 0, where `Q_lm` is the
//! associated Legendre function without its factor sin^m, and `N_lm = sqrt((2l+1)/4pi (l-m)!/(l+m)!)`, times sqrt 2
//! for m != 0. The Condon–Shortley sign (-1)^m is kept: `y_1 = -c y`, `y_2 = c z`, `y_3 = -c x` with `c = sqrt(3/4pi)`.
//! "Order n" means the bands l < n, n^2 coefficients; coefficient (l, m) is at index `l (l + 1) + m`.
//!
//! Cost: about 3 multiplications a coefficient; no trigonometry, no division.
//! Source: Sloan, Stupid Spherical Harmonics Tricks (2008), sections 2 and 3.2; Zhou et al. 2008, appendix.

use std::f64::consts::PI;

use glam::Vec3;

/// The highest order: bands 0 to 5.
pub const MAX_ORDER: usize = 6;
/// Coefficients at [`MAX_ORDER`].
pub const MAX_COEFFICIENTS: usize = MAX_ORDER * MAX_ORDER;

/// Square root by Newton's method: the one of `std` is not usable in constants.
const fn square_root(x: f64) -> f64 {
    let mut root = if x > 1.0 { x } else { 1.0 };
    let mut step = 0;
    while step < 64 {
        root = 0.5 * (root + x / root);
        step += 1;
    }
    root
}

/// `N_lm` with the factor sqrt 2 for m > 0, at `[l][m]`; zero above the diagonal.
const NORMALISATION: [[f32; MAX_ORDER]; MAX_ORDER] = {
    let mut table = [[0.0; MAX_ORDER]; MAX_ORDER];
    let mut l = 0;
    while l < MAX_ORDER {
        let mut m = 0;
        while m <= l {
            // (l-m)!/(l+m)! = 1 / ((l-m+1) ... (l+m))
            let mut factor = (2 * l + 1) as f64 / (4.0 * PI) * if m > 0 { 2.0 } else { 1.0 };
            let mut k = l - m + 1;
            while k <= l + m {
                factor /= k as f64;
                k += 1;
            }
            table[l][m] = square_root(factor) as f32;
            m += 1;
        }
        l += 1;
    }
    table
};

/// `sqrt(4pi / (2l+1))`: turns zonal coefficients into the eigenvalues of a rotation or a convolution.
pub const ZONAL_SCALE: [f32; MAX_ORDER] = {
    let mut scale = [0.0; MAX_ORDER];
    let mut l = 0;
    while l < MAX_ORDER {
        scale[l] = square_root(4.0 * PI / (2 * l + 1) as f64) as f32;
        l += 1;
    }
    scale
};

/// The band l of each coefficient.
pub const BAND: [usize; MAX_COEFFICIENTS] = {
    let mut band = [0; MAX_COEFFICIENTS];
    let mut l = 0;
    while l < MAX_ORDER {
        let mut i = l * l;
        while i < (l + 1) * (l + 1) {
            band[i] = l;
            i += 1;
        }
        l += 1;
    }
    band
};

/// All harmonics of the bands l < `order` at `L` unit directions at once; `out[l (l + 1) + m][lane]`.
///
/// Coefficients past `order^2` are left as they were. A vector that is not of length 1 gives the polynomials' values
/// there, band by band of mixed degree: normalise first.
///
/// # Panics
/// If `order > MAX_ORDER`.
#[inline(always)]
pub fn evaluate_lanes<const L: usize>(
    order: usize,
    x: &[f32; L],
    y: &[f32; L],
    z: &[f32; L],
    out: &mut [[f32; L]; MAX_COEFFICIENTS],
) {
    assert!(order <= MAX_ORDER, "order {order} is above {MAX_ORDER}");
    // (x + iy)^m, and Q_mm = (-1)^m (2m-1)!!.
    let (mut real, mut imaginary, mut diagonal) = ([1.0f32; L], [0.0f32; L], 1.0f32);
    for m in 0..order {
        let (mut before, mut current) = ([0.0f32; L], [diagonal; L]);
        for l in m..order {
            let norm = NORMALISATION[l][m];
            for lane in 0..L {
                let legendre = norm * current[lane];
                out[l * (l + 1) + m][lane] = legendre * real[lane];
                if m > 0 {
                    out[l * (l + 1) - m][lane] = legendre * imaginary[lane];
                }
            }
            // (l+1-m) Q_(l+1)m = (2l+1) z Q_lm - (l+m) Q_(l-1)m
            let (up, down) = ((2 * l + 1) as f32 / (l + 1 - m) as f32, (l + m) as f32 / (l + 1 - m) as f32);
            for lane in 0..L {
                let next = up * z[lane] * current[lane] - down * before[lane];
                before[lane] = current[lane];
                current[lane] = next;
            }
        }
        for lane in 0..L {
            let next = real[lane] * x[lane] - imaginary[lane] * y[lane];
            imaginary[lane] = real[lane] * y[lane] + imaginary[lane] * x[lane];
            real[lane] = next;
        }
        diagonal *= -((2 * m + 1) as f32);
    }
}

/// The harmonics of the bands l < `order` at one unit direction; zero past `order^2`.
pub fn evaluate(order: usize, direction: Vec3) -> [f32; MAX_COEFFICIENTS] {
    let mut out = [[0.0f32; 1]; MAX_COEFFICIENTS];
    evaluate_lanes(order, &[direction.x], &[direction.y], &[direction.z], &mut out);
    out.map(|[value]| value)
}

/// The zonal function with coefficients `zonal[l]` about +z, turned so that its axis is the unit vector `axis`:
/// `f_lm = sqrt(4pi/(2l+1)) zonal_l y_lm(axis)`. The order is `zonal.len()`; zero past it.
pub fn rotate_zonal(zonal: &[f32], axis: Vec3) -> [f32; MAX_COEFFICIENTS] {
    let mut out = evaluate(zonal.len(), axis);
    for (i, value) in out.iter_mut().enumerate().take(zonal.len() * zonal.len()) {
        *value *= ZONAL_SCALE[BAND[i]] * zonal[BAND[i]];
    }
    out
}

/// Convolves `coefficients` (of any order up to `zonal.len()`) with a zonal kernel, in place:
/// `(f * k)_lm = sqrt(4pi/(2l+1)) f_lm k_l`.
pub fn convolve(coefficients: &mut [f32], zonal: &[f32]) {
    for (i, value) in coefficients.iter_mut().enumerate() {
        *value *= ZONAL_SCALE[BAND[i]] * zonal[BAND[i]];
    }
}

/// Limits coefficients to what a function with values in [0, `largest`] can have: a mean between 0 and `largest`, and in
/// band l, by the addition theorem, a vector of length <= sqrt(2l+1) times coefficient 0. Legal ones stay as they are.
pub fn limit_to_positive(coefficients: &mut [f32], largest: f32) {
    let mean = coefficients[0].clamp(0.0, largest * ZONAL_SCALE[0]);
    coefficients[0] = mean;
    for l in 1..coefficients.len().isqrt() {
        let band = &mut coefficients[l * l..(l + 1) * (l + 1)];
        let square: f64 = band.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        let bound = f64::from(mean) * ((2 * l + 1) as f64).sqrt();
        if square > bound * bound {
            let scale = bound / square.sqrt();
            band.iter_mut().for_each(|v| *v = (f64::from(*v) * scale) as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sphere::quadrature::Directions;

    fn unit(i: u32) -> Vec3 {
        // A few directions in general position, and the axes.
        match i {
            0 => Vec3::X,
            1 => Vec3::Y,
            2 => Vec3::Z,
            3 => -Vec3::Z,
            _ => Vec3::new((i as f32 * 1.7).sin(), (i as f32 * 2.3).cos(), (i as f32 * 0.9).sin() + 0.1).normalize(),
        }
    }

    fn legendre(l: usize, x: f64) -> f64 {
        let (mut before, mut current) = (0.0, 1.0);
        for k in 0..l {
            let next = ((2 * k + 1) as f64 * x * current - k as f64 * before) / (k + 1) as f64;
            (before, current) = (current, next);
        }
        current
    }

    #[test]
    fn the_first_two_bands_have_the_stated_signs() {
        let d = Vec3::new(0.48, -0.6, 0.64);
        let (y, c) = (evaluate(2, d), (3.0 / (4.0 * std::f32::consts::PI)).sqrt());
        let expected = [(1.0 / (4.0 * std::f32::consts::PI)).sqrt(), -c * d.y, c * d.z, -c * d.x];
        for i in 0..4 {
            assert!((y[i] - expected[i]).abs() < 2e-7, "{i}: {} {}", y[i], expected[i]);
        }
        assert!(y[4..].iter().all(|&v| v == 0.0));
    }

    #[test]
    fn harmonics_are_orthonormal() {
        // Degree 10 products: exact on 6 x 12 points, so that only f32 rounding is left: 72 terms of size <= 2.
        let directions = Directions::product(6, 12);
        let mut gram = vec![0.0f64; MAX_COEFFICIENTS * MAX_COEFFICIENTS];
        for q in 0..directions.len() {
            let y = evaluate(MAX_ORDER, directions.direction(q));
            for i in 0..MAX_COEFFICIENTS {
                for j in 0..MAX_COEFFICIENTS {
                    gram[i * MAX_COEFFICIENTS + j] +=
                        f64::from(directions.weights[q]) * f64::from(y[i]) * f64::from(y[j]);
                }
            }
        }
        for i in 0..MAX_COEFFICIENTS {
            for j in 0..MAX_COEFFICIENTS {
                let expected = if i == j { 1.0 } else { 0.0 };
                let found = gram[i * MAX_COEFFICIENTS + j];
                assert!((found - expected).abs() < 2e-6, "{i} {j}: {found}");
            }
        }
    }

    #[test]
    fn the_addition_theorem_holds_in_every_band() {
        for i in 0..8 {
            for j in 0..8 {
                let (a, b) = (evaluate(MAX_ORDER, unit(i)), evaluate(MAX_ORDER, unit(j)));
                for l in 0..MAX_ORDER {
                    let sum: f64 = (l * l..(l + 1) * (l + 1)).map(|k| f64::from(a[k]) * f64::from(b[k])).sum();
                    let expected = (2 * l + 1) as f64 / (4.0 * PI) * legendre(l, f64::from(unit(i).dot(unit(j))));
                    // Values up to (2l+1)/4pi < 0.9; coordinates are rounded to 6e-8 and P_l' <= l(l+1)/2 = 15.
                    assert!((sum - expected).abs() < 3e-6, "{i} {j} band {l}: {sum} {expected}");
                }
            }
        }
    }

    #[test]
    fn a_rotated_zonal_function_has_the_values_of_the_original_about_its_new_axis() {
        let zonal = [0.7f32, -0.4, 0.3, 0.2, -0.1, 0.05];
        let axis = unit(5);
        let rotated = rotate_zonal(&zonal, axis);
        for i in 0..9 {
            let y = evaluate(MAX_ORDER, unit(i));
            let found: f32 = (0..MAX_COEFFICIENTS).map(|k| rotated[k] * y[k]).sum();
            let mu = f64::from(axis.dot(unit(i)));
            let expected: f64 = (0..MAX_ORDER)
                .map(|l| f64::from(zonal[l]) * ((2 * l + 1) as f64 / (4.0 * PI)).sqrt() * legendre(l, mu))
                .sum();
            assert!((f64::from(found) - expected).abs() < 3e-6, "{i}: {found} {expected}");
        }
    }

    #[test]
    fn convolution_with_a_delta_function_changes_nothing() {
        // A delta about +z has zonal coefficients y_l0(z) = sqrt((2l+1)/4pi) = 1 / ZONAL_SCALE.
        let delta: Vec<f32> = ZONAL_SCALE.iter().map(|s| 1.0 / s).collect();
        let original = evaluate(MAX_ORDER, unit(6));
        let mut convolved = original;
        convolve(&mut convolved, &delta);
        for i in 0..MAX_COEFFICIENTS {
            assert!((convolved[i] - original[i]).abs() <= 2e-7 * original[i].abs().max(1e-3), "{i}");
        }
    }

    #[test]
    fn limits_keep_every_positive_function_and_catch_others() {
        // A narrow positive function is on the bound: a delta has |band l| = sqrt(2l+1) c_0 exactly.
        let delta = evaluate(MAX_ORDER, unit(7));
        let mut limited = delta;
        limit_to_positive(&mut limited, 1.0);
        for i in 0..MAX_COEFFICIENTS {
            assert!((limited[i] - delta[i]).abs() < 1e-6);
        }
        limited[3] += 1.0;
        limited[0] = 9.0;
        limit_to_positive(&mut limited, 2.0);
        assert!((limited[0] - 2.0 * ZONAL_SCALE[0]).abs() < 1e-6);
        let mut negative = delta.map(|v| -v);
        limit_to_positive(&mut negative, 1.0);
        assert_eq!(negative, [0.0; MAX_COEFFICIENTS]);
    }

    #[test]
    fn lanes_give_the_bits_of_single_directions() {
        let d: [Vec3; 8] = std::array::from_fn(|i| unit(i as u32));
        let mut out = [[0.0f32; 8]; MAX_COEFFICIENTS];
        evaluate_lanes(MAX_ORDER, &d.map(|v| v.x), &d.map(|v| v.y), &d.map(|v| v.z), &mut out);
        for (lane, &direction) in d.iter().enumerate() {
            let single = evaluate(MAX_ORDER, direction);
            assert!((0..MAX_COEFFICIENTS).all(|i| out[i][lane].to_bits() == single[i].to_bits()));
        }
    }
}
