//! The three heavy parts of the route, as whoever computes them sees them: depths, single scattering, products with the
//! transport matrix. [`Processor`] is the reference; a device has its own.

use std::fmt::Debug;

use crate::medium::gaussian_points::GaussianPoints;
use crate::sphere::harmonics::{BAND, MAX_ORDER};
use crate::sphere::quadrature::Directions;
use crate::transport::compensated::centres::depth::DirectionalDepth;
use crate::transport::compensated::centres::integral::IntegralTransport;
use crate::transport::compensated::centres::single::{Basis, scatter_directions};
use crate::transport::compensated::gmres::{Solved, solve};
use crate::transport::medium::BandedMedium;

/// Relative residual of the solve: ten times the rounding of K.
pub(super) const TOLERANCE: f64 = 1e-6;
/// Products with K, at most, per channel.
const ITERATIONS: usize = 120;

/// Why a part was not computed: one line, in the words of the device. The processor never fails.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct KernelError(pub String);

/// Light that reaches centres along directions.
#[derive(Clone, Copy, Debug)]
pub struct Attenuation<'a> {
    /// Depths from the centres.
    pub depth: &'a DirectionalDepth,
    /// Centres.
    pub count: usize,
    /// What turns such a depth into optical depth, channel by channel; at most 1e30.
    pub optical_scale: [f64; 3],
    /// What scatters it.
    pub medium: &'a BandedMedium,
    /// Radiance along the directions, channel by channel, with their padding.
    pub radiance: &'a [Vec<f32>; 3],
    /// Weighted harmonics along them.
    pub basis: &'a Basis,
}

/// Who computes the heavy parts.
pub trait CentreKernels: Debug + Send + Sync {
    /// Depths from all centres along all directions: [`DirectionalDepth::new`].
    fn depth(&self, points: &GaussianPoints, directions: &Directions) -> Result<DirectionalDepth, KernelError>;

    /// Single scattering along directions, coefficient `k` of centre `i` at `i * order^2 + k`: [`scatter_directions`].
    fn single(&self, light: &Attenuation) -> Result<Vec<[f32; 3]>, KernelError>;

    /// A matrix made ready for products.
    fn matrix(&self, matrix: IntegralTransport) -> Result<Box<dyn TransportMatrix>, KernelError>;
}

/// A transport matrix K ready for products.
pub trait TransportMatrix: Debug + Send + Sync {
    /// Centres.
    fn count(&self) -> usize;

    /// Bands of the matrix, 1 or 2.
    fn bands(&self) -> usize;

    /// `out = K v`: harmonics of the light that arrives; coefficient `a` of centre i at `a * n + i` in both.
    fn product(&self, v: &[f64], out: &mut [f64]) -> Result<(), KernelError>;

    /// Adds multiple scattering to `radiance` (single scattering, `order^2` coefficients a centre) in one channel.
    ///
    /// Solves `x = J_ss + F K x` on the matrix's bands; bands above keep single scattering. `start` (same layout as
    /// `radiance`) speeds up a solve after a small edit. Radiance means below zero, possible only where the solve
    /// stopped early, are set to zero. After an error `radiance` is as it was.
    fn add(
        &self,
        radiance: &mut [[f32; 3]],
        order: usize,
        channel: usize,
        gains: &[f32; MAX_ORDER],
        start: Option<&[[f32; 3]]>,
    ) -> Result<Solved, KernelError> {
        let (n, stride, all) = (self.count(), order * order, self.bands() * self.bands());
        let coefficients = all.min(stride);
        let gather = |from: &[[f32; 3]]| -> Vec<f64> {
            let mut out = vec![0.0; n * all];
            for i in 0..n {
                (0..coefficients).for_each(|a| out[a * n + i] = f64::from(from[i * stride + a][channel]));
            }
            out
        };
        let b = gather(radiance);
        let mut x = start.filter(|s| s.len() == radiance.len()).map_or_else(|| b.clone(), gather);
        let gain = |a: usize| if a < coefficients { f64::from(gains[BAND[a]]) } else { 0.0 };
        let failed = std::cell::OnceCell::new();
        let apply = |v: &[f64], out: &mut [f64]| {
            // What is not a number ends the solve at once.
            if failed.get().is_some() {
                out.fill(f64::NAN);
                return;
            }
            if let Err(error) = self.product(v, out) {
                failed.get_or_init(|| error);
                out.fill(f64::NAN);
                return;
            }
            for (k, (out, v)) in out.iter_mut().zip(v).enumerate() {
                *out = v - gain(k / n) * *out;
            }
        };
        let solved = solve(apply, &b, &mut x, TOLERANCE, ITERATIONS);
        if let Some(error) = failed.into_inner() {
            return Err(error);
        }
        for i in 0..n {
            for a in 0..coefficients {
                let value = x[a * n + i] as f32;
                radiance[i * stride + a][channel] = if a == 0 { value.max(0.0) } else { value };
            }
        }
        Ok(solved)
    }
}

/// The processor.
#[derive(Clone, Copy, Debug)]
pub struct Processor;

impl CentreKernels for Processor {
    fn depth(&self, points: &GaussianPoints, directions: &Directions) -> Result<DirectionalDepth, KernelError> {
        Ok(DirectionalDepth::new(points, directions))
    }

    fn single(&self, light: &Attenuation) -> Result<Vec<[f32; 3]>, KernelError> {
        let Attenuation { depth, count, optical_scale, medium, radiance, basis } = *light;
        Ok(scatter_directions(depth, count, optical_scale, medium, radiance, basis))
    }

    fn matrix(&self, matrix: IntegralTransport) -> Result<Box<dyn TransportMatrix>, KernelError> {
        Ok(Box::new(matrix))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct FailsAfter(std::sync::atomic::AtomicUsize);

    impl TransportMatrix for FailsAfter {
        fn count(&self) -> usize {
            3
        }
        fn bands(&self) -> usize {
            1
        }
        fn product(&self, v: &[f64], out: &mut [f64]) -> Result<(), KernelError> {
            let left = self.0.load(std::sync::atomic::Ordering::Relaxed);
            if left == 0 {
                return Err(KernelError("lost".into()));
            }
            self.0.store(left - 1, std::sync::atomic::Ordering::Relaxed);
            // A cyclic shift: not solved in fewer than three iterations.
            (0..3).for_each(|i| out[i] = v[(i + 1) % 3]);
            Ok(())
        }
    }

    #[test]
    fn a_product_that_fails_at_any_time_is_an_error_and_changes_nothing() {
        for products in 0..3 {
            let mut radiance = vec![[1.0; 3], [2.0; 3], [4.0; 3]];
            let before = radiance.clone();
            let matrix = FailsAfter(products.into());
            let error = matrix.add(&mut radiance, 1, 0, &[0.9, 0.0, 0.0, 0.0, 0.0, 0.0], None).unwrap_err();
            assert_eq!((error.to_string().as_str(), radiance), ("lost", before));
        }
    }
}
