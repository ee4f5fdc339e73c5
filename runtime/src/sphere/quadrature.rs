//! Directions with weights that integrate over the sphere: Gauss–Legendre in `z`, equal steps in azimuth.
//!
//! `n` polar by `m` azimuthal points integrate every polynomial of degree <= min(2n - 1, m - 1) exactly; 7 x 14 = 98
//! points do degree 13, enough to project products of two functions of order 6. The weights sum to 4 pi.
//!
//! Cost: n Newton iterations of n operations, once; everything in f64, rounded at the end.
//! Source: Atkinson, Numerical integration on the sphere (1982), section 2; Newton start of Tricomi.

use std::f64::consts::PI;

use glam::Vec3;

/// Lanes of the padded arrays in [`Directions`].
pub const LANES: usize = 16;

/// Nodes (ascending) and weights of the n-point Gauss–Legendre rule on [-1, 1]; exact for degree 2n - 1.
pub fn gauss_legendre(n: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut nodes, mut weights) = (vec![0.0; n], vec![0.0; n]);
    for i in 0..n.div_ceil(2) {
        let mut x = (PI * (i as f64 + 0.75) / (n as f64 + 0.5)).cos();
        let mut slope = 1.0;
        // Tricomi's start is good to 1e-3 at worst: Newton ends in four steps, the rest costs nothing.
        for _ in 0..8 {
            let (mut before, mut current) = (0.0, 1.0);
            for k in 0..n {
                let next = ((2 * k + 1) as f64 * x * current - k as f64 * before) / (k + 1) as f64;
                (before, current) = (current, next);
            }
            slope = n as f64 * (x * current - before) / (x * x - 1.0);
            x -= current / slope;
        }
        if n % 2 == 1 && i == n / 2 {
            x = 0.0;
        }
        let weight = 2.0 / ((1.0 - x * x) * slope * slope);
        (nodes[i], nodes[n - 1 - i]) = (-x, x);
        (weights[i], weights[n - 1 - i]) = (weight, weight);
    }
    (nodes, weights)
}

/// Quadrature directions, coordinate by coordinate, padded to a multiple of [`LANES`].
///
/// Padding repeats +z with weight zero, so that a loop over whole blocks stays finite and adds nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct Directions {
    count: usize,
    /// x of every direction, then the padding.
    pub x: Vec<f32>,
    /// y of every direction, then the padding.
    pub y: Vec<f32>,
    /// z of every direction, then the padding.
    pub z: Vec<f32>,
    /// Solid angle of every direction, steradian; sum 4 pi. Zero in the padding.
    pub weights: Vec<f32>,
}

impl Directions {
    /// The product rule of `polar` Gauss–Legendre rings (ascending z) by `azimuth` points each, ring after ring.
    ///
    /// # Panics
    /// If either count is zero.
    pub fn product(polar: usize, azimuth: usize) -> Self {
        assert!(polar > 0 && azimuth > 0, "{polar} x {azimuth} directions");
        let count = polar * azimuth;
        let padded = count.next_multiple_of(LANES);
        let mut out = Self {
            count,
            x: vec![0.0; padded],
            y: vec![0.0; padded],
            z: vec![1.0; padded],
            weights: vec![0.0; padded],
        };
        let (nodes, weights) = gauss_legendre(polar);
        for (ring, (&z, &w)) in nodes.iter().zip(&weights).enumerate() {
            let sine = (1.0 - z * z).sqrt();
            for k in 0..azimuth {
                // Half a step off the axes: no direction lies in a plane of symmetry of the cube.
                let phi = 2.0 * PI * (k as f64 + 0.5) / azimuth as f64;
                let q = ring * azimuth + k;
                out.x[q] = (sine * phi.cos()) as f32;
                out.y[q] = (sine * phi.sin()) as f32;
                out.z[q] = z as f32;
                out.weights[q] = (w * 2.0 * PI / azimuth as f64) as f32;
            }
        }
        out
    }

    /// The number of directions, without padding.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Never: there is at least one direction.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The number of directions with padding: a multiple of [`LANES`].
    pub fn padded(&self) -> usize {
        self.x.len()
    }

    /// Direction `q < padded()`.
    pub fn direction(&self, q: usize) -> Vec3 {
        Vec3::new(self.x[q], self.y[q], self.z[q])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gauss_legendre_integrates_every_power_it_should_and_not_the_next() {
        for n in 1..=32 {
            let (x, w) = gauss_legendre(n);
            for degree in 0..2 * n {
                let found: f64 = x.iter().zip(&w).map(|(x, w)| w * x.powi(degree as i32)).sum();
                let expected = if degree % 2 == 0 { 2.0 / (degree + 1) as f64 } else { 0.0 };
                assert!((found - expected).abs() < 4e-15 * n as f64, "n {n} degree {degree}: {found}");
            }
        }
        let (x, w) = gauss_legendre(3);
        let found: f64 = x.iter().zip(&w).map(|(x, w)| w * x.powi(6)).sum();
        assert!((found - 2.0 / 7.0).abs() > 1e-2, "degree 6 must be out of reach of 3 nodes");
    }

    #[test]
    fn weights_sum_to_the_sphere_and_padding_weighs_nothing() {
        for (polar, azimuth) in [(1, 1), (1, 4), (7, 14), (12, 24), (28, 56)] {
            let d = Directions::product(polar, azimuth);
            assert_eq!((d.len(), d.padded() % LANES), (polar * azimuth, 0));
            let sum: f64 = d.weights.iter().map(|&w| f64::from(w)).sum();
            assert!((sum - 4.0 * PI).abs() < 1e-6 * 4.0 * PI);
            assert!(d.weights[d.len()..].iter().all(|&w| w == 0.0));
            assert!((0..d.padded()).all(|q| (d.direction(q).length() - 1.0).abs() < 2e-7));
        }
    }
}
