//! The Henyey–Greenstein phase function (Henyey and Greenstein 1941), and directions drawn from it.
//!
//! `p(mu) = (1 - g^2) / (4 pi (1 + g^2 - 2 g mu)^(3/2))`, mu the cosine between the ways before and after, so that g > 0
//! is forward; the integral over the sphere is 1. Inverted: `mu = (1 + g^2 - ((1 - g^2) / (1 - g + 2 g u))^2) / 2 g`.

use glam::Vec3;
use std::f32::consts::{PI, TAU};

/// |g| below which directions are drawn evenly: the two differ by at most 3 g.
const EVEN: f32 = 1e-4;

/// Value at the cosine `mu`, in 1/sr. -1 < g < 1.
#[inline(always)]
pub fn value(g: f32, mu: f32) -> f32 {
    // 1 + g^2 - 2 g mu without the cancellation at g = mu = 1.
    let base = (1.0 - g) * (1.0 - g) + 2.0 * g * (1.0 - mu);
    // Up to rounding of mu the base is at least (1 - |g|)^2.
    let base = base.max((1.0 - g.abs()) * (1.0 - g.abs()));
    (1.0 - g * g) / (4.0 * PI * base * base.sqrt())
}

/// A way after scattering for the unit way `before`, drawn with density [`value`]; `u` in [0, 1)^2. Also its cosine.
#[inline(always)]
pub fn sample(g: f32, before: Vec3, u: [f32; 2]) -> (Vec3, f32) {
    let mu = if g.abs() < EVEN {
        1.0 - 2.0 * u[0]
    } else {
        let ratio = (1.0 - g * g) / (1.0 - g + 2.0 * g * u[0]);
        ((1.0 + g * g - ratio * ratio) / (2.0 * g)).clamp(-1.0, 1.0)
    };
    let sine = (1.0 - mu * mu).max(0.0).sqrt();
    let (sin, cos) = (TAU * u[1]).sin_cos();
    let (x, y) = before.any_orthonormal_pair();
    ((x * (sine * cos) + y * (sine * sin) + before * mu).normalize(), mu)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::sampler::Random;

    const G: [f32; 9] = [-0.99, -0.6, -0.2, -5e-5, 0.0, 0.3, 0.6, 0.85, 0.99];

    #[test]
    fn the_integral_over_the_sphere_is_one_and_the_mean_cosine_is_g() {
        for g in G {
            // Midpoints in the angle, which is where the peak is smooth: relative error below 1e-5 at |g| = 0.99.
            let n = 200_000;
            let (mut sum, mut mean) = (0.0, 0.0);
            for i in 0..n {
                let theta = (f64::from(i) + 0.5) * std::f64::consts::PI / f64::from(n);
                let weight =
                    f64::from(value(g, theta.cos() as f32)) * theta.sin() * std::f64::consts::PI / f64::from(n);
                sum += weight * std::f64::consts::TAU;
                mean += weight * std::f64::consts::TAU * theta.cos();
            }
            // The cosine in f32 is off by 6e-8, over the peak's width of 1.5 (1-|g|)^2 = 1.5e-4: 4e-4.
            assert!((sum - 1.0).abs() < 1e-3 && (mean - f64::from(g)).abs() < 1e-3, "{g}: {sum} {mean}");
        }
    }

    #[test]
    fn drawn_directions_have_the_density_that_is_stated() {
        for g in G {
            let mut random = Random::new(3);
            let before = Vec3::new(0.48, -0.6, 0.64);
            let n = 100_000;
            // The density inverted: u = integral of p from -1 to mu is uniform; ten bins, each 10 % with a deviation of
            // sqrt(0.09 / n), and 4 of them allowed for 90 bins.
            let mut bins = [0u32; 10];
            for _ in 0..n {
                let (after, mu) = sample(g, before, [random.unit(), random.unit()]);
                assert!((after.length() - 1.0).abs() < 1e-6 && (after.dot(before) - mu).abs() < 1e-5);
                let (g, mu) = (f64::from(g), f64::from(mu));
                let below = if g.abs() < 1e-4 {
                    (1.0 + mu) / 2.0
                } else {
                    (1.0 - g * g) / (2.0 * g) * ((1.0 + g * g - 2.0 * g * mu).sqrt().recip() - (1.0 + g).recip())
                };
                bins[((below * 10.0) as usize).min(9)] += 1;
            }
            for hits in bins {
                assert!(
                    (f64::from(hits) / f64::from(n) - 0.1).abs() < 4.0 * (0.09 / f64::from(n)).sqrt(),
                    "{g} {bins:?}"
                );
            }
        }
    }

    #[test]
    fn ends_of_the_unit_square_and_of_g_are_finite() {
        for g in [-0.999_999, -0.99, 0.0, 0.99, 0.999_999] {
            for u in [0.0, 0.5, 1.0 - f32::EPSILON / 2.0] {
                let (after, mu) = sample(g, Vec3::NEG_Z, [u, u]);
                assert!(after.is_finite() && value(g, mu).is_finite() && value(g, mu) > 0.0, "{g} {u}");
            }
            assert!(value(g, 1.0).is_finite() && value(g, -1.0).is_finite());
        }
    }
}
