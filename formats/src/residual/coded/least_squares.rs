//! Weighted least squares that learn as they go and forget.
//!
//! For taps `x`, value `y` and weight `g` the sums `A = sum x x^T g f^-t`, `b = sum x y g f^-t` grow by one term a
//! voxel, `t` counting the voxels and `f` the factor of forgetting; every `interval` voxels the coefficients become the
//! solution of `(A + r I) w = b`, `r = ridge f^-t + 1e-6 trace(A)`, by elimination of the symmetric matrix without
//! pivots (LDL^T). The elements of the sums are independent and every other sum runs in the order written, so that the
//! bits do not depend on the vector width. An update costs N^2 and a
//! solution N^3 / 2 multiplications.
//!
//! Source: Meyer and Tischer 2001, "GLICBAWLS", section 3 (weighted least squares in lossless coding); we keep the sums
//! for tiles of the image (see `predict.rs`) in place of solving anew for every voxel.

/// Sums are scaled back when the newest term's factor has grown past this.
const LARGEST_GAIN: f32 = 1e4;
/// A solution with a coefficient beyond this is noise, and the coefficients before it stay.
const LARGEST_COEFFICIENT: f32 = 1e3;

/// The state of one predictor over `N` taps, `N` a multiple of 8.
#[derive(Clone)]
pub(super) struct LeastSquares<const N: usize> {
    covariance: [[f32; N]; N],
    cross: [f32; N],
    coefficients: [f32; N],
    gain: f32,
    growth: f32,
    ridge: f32,
    interval: u32,
    countdown: u32,
}

impl<const N: usize> LeastSquares<N> {
    /// Starts as the mean of the first three taps. `forget` is the factor `f`, in (0.5, 1).
    pub(super) fn new(forget: f32, ridge: f32, interval: u32) -> Self {
        let coefficients = std::array::from_fn(|i| if i < 3 { 1.0 / 3.0 } else { 0.0 });
        let (covariance, cross) = ([[0.0; N]; N], [0.0; N]);
        Self { covariance, cross, coefficients, gain: 1.0, growth: 1.0 / forget, ridge, interval, countdown: interval }
    }

    /// `x . w`: lane `l` of eight sums the taps `l, l + 8, ...`, then the lanes are added as the tree below.
    #[inline(always)]
    pub(super) fn predict(&self, taps: &[f32; N]) -> f32 {
        let mut lanes = [0.0f32; 8];
        for (t, w) in taps.chunks_exact(8).zip(self.coefficients.chunks_exact(8)) {
            for l in 0..8 {
                lanes[l] += t[l] * w[l];
            }
        }
        ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7]))
    }

    /// Adds one voxel to the sums.
    #[inline(always)]
    pub(super) fn learn(&mut self, taps: &[f32; N], value: f32, weight: f32) {
        let gain = weight * self.gain;
        for (row, tap) in self.covariance.iter_mut().zip(taps) {
            let scaled = tap * gain;
            // The branch keeps the compiler from turning rows into columns; most taps are not zero.
            if scaled != 0.0 {
                for (sum, t) in row.iter_mut().zip(taps) {
                    *sum += scaled * t;
                }
            }
        }
        let scaled = value * gain;
        for (sum, t) in self.cross.iter_mut().zip(taps) {
            *sum += scaled * t;
        }
        self.gain *= self.growth;
        self.countdown -= 1;
        if self.countdown == 0 {
            self.countdown = self.interval;
            self.rescale();
            self.solve();
        }
    }

    #[inline(always)]
    fn rescale(&mut self) {
        if self.gain > LARGEST_GAIN {
            let back = 1.0 / self.gain;
            self.covariance.iter_mut().flatten().for_each(|c| *c *= back);
            self.cross.iter_mut().for_each(|c| *c *= back);
            self.gain = 1.0;
        }
    }

    #[inline(always)]
    fn solve(&mut self) {
        let mut rows = self.covariance;
        let mut right = self.cross;
        let mut trace = 0.0;
        for (i, row) in rows.iter().enumerate() {
            trace += row[i];
        }
        let ridge = self.ridge * self.gain + 1e-6 * trace;
        let mut lower = [[0.0f32; N]; N];
        let mut solution = [0.0f32; N];
        for j in 0..N {
            let pivot = rows[j][j] + ridge;
            // Positive in exact arithmetic; rounding may say otherwise, and NaN fails here too.
            let regular = pivot > 0.0;
            if !regular {
                return;
            }
            let inverse = 1.0 / pivot;
            solution[j] = right[j] * inverse;
            let row = rows[j];
            for i in j + 1..N {
                let factor = row[i] * inverse;
                lower[i][j] = factor;
                if factor != 0.0 {
                    for (a, b) in rows[i].iter_mut().zip(&row) {
                        *a -= factor * b;
                    }
                    right[i] -= factor * right[j];
                }
            }
        }
        for i in (1..N).rev() {
            let known = solution[i];
            for k in 0..i {
                solution[k] -= known * lower[i][k];
            }
        }
        if solution.iter().all(|w| w.abs() < LARGEST_COEFFICIENT) {
            self.coefficients = solution;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Taps that span all directions, from a linear congruential generator, in (-1, 1).
    fn taps(seed: &mut u32) -> [f32; 8] {
        std::array::from_fn(|_| {
            *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (*seed >> 8) as f32 / (1 << 23) as f32 - 1.0
        })
    }

    #[test]
    fn a_linear_rule_is_found() {
        let rule = [0.5, -0.25, 1.0, 0.0, 2.0, 0.125, -1.5, 0.75];
        let mut predictor = LeastSquares::<8>::new(0.99, 1e-6, 4);
        let value = |x: &[f32; 8]| x.iter().zip(rule).map(|(x, w)| x * w).sum::<f32>();
        let mut seed = 1;
        for _ in 0..400 {
            let x = taps(&mut seed);
            predictor.learn(&x, value(&x), 1.0);
        }
        let x = taps(&mut seed);
        // The relative ridge is 1e-6 * 8 of a mean eigenvalue: errors near 1e-5 |w| |x| < 1e-4.
        assert!((predictor.predict(&x) - value(&x)).abs() < 1e-4);
    }

    #[test]
    fn old_rules_are_forgotten() {
        let mut predictor = LeastSquares::<8>::new(0.9, 1e-6, 1);
        let mut seed = 1;
        for t in 0..400 {
            let x = taps(&mut seed);
            predictor.learn(&x, if t < 200 { x[0] } else { -x[0] }, 1.0);
        }
        // 0.9^200 = 7e-10 of the first rule is left.
        assert!((predictor.predict(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]) + 1.0).abs() < 1e-3);
    }

    #[test]
    fn taps_that_say_nothing_and_extreme_ones_leave_finite_coefficients() {
        let mut predictor = LeastSquares::<8>::new(0.94, 3.0, 1);
        for t in 0..3000 {
            let x = match t / 1000 {
                0 => [0.0; 8],
                1 => [i32::MIN as f32; 8],
                _ => [i32::MAX as f32, i32::MIN as f32, 0.0, 1.0, -1.0, 0.0, 0.0, 3.0],
            };
            predictor.learn(&x, i32::MIN as f32, 1.0 / 0.3);
            assert!(predictor.predict(&x).is_finite());
        }
    }
}
