//! The paper's route as a whole: Gaussians, medium and light in, source radiance at the centres out.
//!
//! What depends on the frame alone (depths, overlaps, the diffusion geometry) and on the extinction alone (the integral
//! transport's matrix) is kept, so that an edit of light, albedo or g costs the single scattering and one solve.

use crate::medium::gaussian_points::{GaussianError, GaussianPoints};
use crate::sphere::harmonics::{MAX_COEFFICIENTS, MAX_ORDER, limit_to_positive};
use crate::sphere::quadrature::Directions;
use crate::transport::compensated::centres::depth::{DirectionalDepth, harmonic_depth};
use crate::transport::compensated::centres::diffusion::{Channel, Diffusion};
use crate::transport::compensated::centres::exponential::Exponential;
use crate::transport::compensated::centres::integral::IntegralTransport;
use crate::transport::compensated::centres::kernels::{
    Attenuation, CentreKernels, KernelError, Processor, TransportMatrix,
};
use crate::transport::compensated::centres::overlap::OverlapGrid;
use crate::transport::compensated::centres::single::{
    Basis, CentreRadiance, IncidentRadiance, evaluate_depth, gains, scatter_harmonics,
};
use crate::transport::medium::{MediumError, MediumParameters};
use smoke_formats::gaussian::Gaussian;
use std::sync::Arc;

/// How light that scatters more than once is found at the centres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MultipleScattering {
    /// Not at all.
    None,
    /// The paper's diffusion, corrected and damped.
    Diffusion,
    /// Integral transport between the centres: better nearly everywhere at the same size.
    #[default]
    IntegralCentres,
}

/// The dials of the route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CentreSettings {
    /// Bands of the source radiance, 1 to 6; the paper's is 4.
    pub order: usize,
    /// From depth to transmittance.
    pub exponential: Exponential,
    /// Beyond single scattering.
    pub multiple: MultipleScattering,
    /// Rings of quadrature directions, 1 to 64; `2 rings^2` directions in all. At least `order` to project well.
    pub rings: usize,
}

impl Default for CentreSettings {
    fn default() -> Self {
        Self { order: 4, exponential: Exponential::Direct, multiple: MultipleScattering::IntegralCentres, rings: 7 }
    }
}

/// Why source radiance cannot be found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CentreError {
    /// A Gaussian out of range.
    #[error(transparent)]
    Gaussian(#[from] GaussianError),
    /// A medium parameter out of range.
    #[error(transparent)]
    Medium(#[from] MediumError),
    /// The device that computes failed.
    #[error(transparent)]
    Kernel(#[from] KernelError),
    /// A setting, length or light out of range.
    #[error("{name}: found {found}, expected {expected}")]
    Input {
        /// What is wrong.
        name: &'static str,
        /// Its value.
        found: String,
        /// The legal values.
        expected: String,
    },
}

impl CentreError {
    fn input(name: &'static str, found: impl ToString, expected: impl ToString) -> Self {
        Self::Input { name, found: found.to_string(), expected: expected.to_string() }
    }
}

/// One frame, ready to be lit.
#[derive(Debug)]
pub struct CentreTransport {
    settings: CentreSettings,
    kernels: Arc<dyn CentreKernels>,
    points: GaussianPoints,
    directions: Directions,
    basis: Basis,
    /// Closed-form depths along the directions, if any part needs them.
    depth: Option<DirectionalDepth>,
    /// Order-6 harmonics of the depth evaluated along the directions, for [`Exponential::Pointwise`].
    evaluated: Option<DirectionalDepth>,
    /// Harmonics of the depth at the settings' order, for the exponentials of harmonics.
    harmonics: Option<Vec<f32>>,
    grid: Option<OverlapGrid>,
    diffusion: Option<Diffusion>,
    /// Transport matrices of the last medium, by the bits of their optical scale.
    matrices: Vec<(u64, Box<dyn TransportMatrix>)>,
}

impl CentreTransport {
    /// [`Self::with_kernels`] of the processor.
    pub fn new(gaussians: &[Gaussian], settings: CentreSettings) -> Result<Self, CentreError> {
        Self::with_kernels(gaussians, settings, Arc::new(Processor))
    }

    /// Checks the Gaussians and computes what depends on the frame alone; `kernels` compute the heavy parts.
    pub fn with_kernels(
        gaussians: &[Gaussian],
        settings: CentreSettings,
        kernels: Arc<dyn CentreKernels>,
    ) -> Result<Self, CentreError> {
        if !(1..=MAX_ORDER).contains(&settings.order) {
            return Err(CentreError::input("order", settings.order, "1 to 6"));
        }
        if !(1..=64).contains(&settings.rings) {
            return Err(CentreError::input("rings", settings.rings, "1 to 64"));
        }
        let points = GaussianPoints::new(gaussians)?;
        let directions = Directions::product(settings.rings, 2 * settings.rings);
        let integral = settings.multiple == MultipleScattering::IntegralCentres;
        let direct = settings.exponential == Exponential::Direct;
        let linear = matches!(settings.exponential, Exponential::OptimalLinear | Exponential::Hybrid);
        let pointwise = settings.exponential == Exponential::Pointwise;
        let depth = if direct || integral { Some(kernels.depth(&points, &directions)?) } else { None };
        Ok(Self {
            settings,
            kernels,
            basis: Basis::new(settings.order, &directions),
            depth,
            evaluated: pointwise.then(|| evaluate_depth(&harmonic_depth(&points, MAX_ORDER), MAX_ORDER, &directions)),
            harmonics: linear.then(|| harmonic_depth(&points, settings.order)),
            grid: integral.then(|| OverlapGrid::new(&points)),
            diffusion: (settings.multiple == MultipleScattering::Diffusion).then(|| Diffusion::new(&points)),
            matrices: Vec::new(),
            directions,
            points,
        })
    }

    /// The quadrature directions along which [`IncidentRadiance::Sampled`] is expected.
    pub fn directions(&self) -> &Directions {
        &self.directions
    }

    /// Rings of these directions; each has twice as many.
    pub fn rings(&self) -> usize {
        self.settings.rings
    }

    /// The checked Gaussians.
    pub fn points(&self) -> &GaussianPoints {
        &self.points
    }

    /// Source radiance at the centres, limited to what light of this strength can cause: J is positive, and its mean is at
    /// most albedo times the brightest light.
    ///
    /// `unit_length_world` is the length of unit space's 1 in world units. `start`, an earlier result for the same number
    /// of Gaussians, makes a solve after a small edit shorter; it never changes what is solved for.
    pub fn radiance(
        &mut self,
        medium: &MediumParameters,
        unit_length_world: f32,
        light: &IncidentRadiance,
        start: Option<&CentreRadiance>,
    ) -> Result<CentreRadiance, CentreError> {
        medium.check()?;
        if !(unit_length_world > 0.0 && unit_length_world.is_finite()) {
            return Err(CentreError::input("unit_length_world", unit_length_world, "> 0 and finite"));
        }
        self.check_light(light)?;
        let (order, n) = (self.settings.order, self.points.len());
        let banded = match self.settings.multiple {
            MultipleScattering::None => medium.windowed(order),
            _ => medium.banded(order),
        };
        // Above 1e30 everything is opaque at any depth that f32 can tell from 0, and products stay finite.
        let scale =
            banded.sigma_t.map(|s| (f64::from(s) * f64::from(unit_length_world) * self.points.density_scale).min(1e30));
        let sampled = light.sampled(&self.directions);
        let single = match (self.settings.exponential, &self.depth, &self.evaluated, &self.harmonics) {
            (Exponential::Direct, Some(depth), ..) | (Exponential::Pointwise, _, Some(depth), _) => {
                self.kernels.single(&Attenuation {
                    depth,
                    count: n,
                    optical_scale: scale,
                    medium: &banded,
                    radiance: &sampled,
                    basis: &self.basis,
                })?
            }
            (exponential, _, _, harmonics) => {
                let squared = exponential == Exponential::Hybrid;
                let depth = harmonics.as_deref().unwrap_or_default();
                scatter_harmonics(depth, order, squared, scale, &banded, &light.harmonics(order, &self.directions))
            }
        };
        let mut out = CentreRadiance { order, coefficients: single, sigma_t: banded.sigma_t, level: Vec::new() };
        let start = start.filter(|s| s.order == order && s.coefficients.len() == out.coefficients.len());
        // Without extinction or albedo nothing scatters twice.
        let active: Vec<usize> = (0..3).filter(|&c| banded.albedo[c] > 0.0 && scale[c] > 0.0 && n > 0).collect();
        if let Some(diffusion) = &self.diffusion {
            out.level = vec![[0.0; 3]; n];
            for &c in &active {
                let brightest = sampled[c].iter().copied().fold(0.0, f32::max);
                let before: Option<Vec<f32>> =
                    start.filter(|s| s.level.len() == n).map(|s| s.level.iter().map(|l| l[c]).collect());
                let channel = Channel { index: c, optical_scale: scale[c], brightest };
                let level = diffusion.add(&mut out.coefficients, order, &banded, channel, before.as_deref());
                out.level.iter_mut().zip(level).for_each(|(out, l)| out[c] = l);
            }
        }
        if let (Some(grid), Some(depth)) = (&self.grid, &self.depth) {
            let bands = if banded.moments[1] == 0.0 { 1 } else { 2 };
            let wanted: Vec<u64> = active.iter().map(|&c| scale[c].to_bits()).collect();
            self.matrices.retain(|(bits, matrix)| wanted.contains(bits) && matrix.bands() >= bands);
            for &c in &active {
                let bits = scale[c].to_bits();
                let at = match self.matrices.iter().position(|(b, _)| *b == bits) {
                    Some(at) => at,
                    None => {
                        let (points, directions) = (&self.points, &self.directions);
                        let matrix = IntegralTransport::new(points, grid, directions, depth, scale[c], bands);
                        self.matrices.push((bits, self.kernels.matrix(matrix)?));
                        self.matrices.len() - 1
                    }
                };
                let start = start.map(|s| &s.coefficients[..]);
                self.matrices[at].1.add(&mut out.coefficients, order, c, &gains(&banded, c), start)?;
            }
        }
        for c in 0..3 {
            let largest = banded.albedo[c] * sampled[c].iter().copied().fold(0.0, f32::max);
            for j in out.coefficients.chunks_exact_mut(order * order) {
                let mut coefficients = [0.0; MAX_COEFFICIENTS];
                coefficients.iter_mut().zip(j.iter()).for_each(|(k, j)| *k = j[c]);
                limit_to_positive(&mut coefficients[..order * order], largest);
                j.iter_mut().zip(coefficients).for_each(|(j, k)| j[c] = k);
            }
        }
        Ok(out)
    }

    fn check_light(&self, light: &IncidentRadiance) -> Result<(), CentreError> {
        let (values, fits, expected) = match light {
            IncidentRadiance::Sampled(v) => (v, v.len() == self.directions.len(), self.directions.len().to_string()),
            IncidentRadiance::Harmonics(v) => {
                let order = v.len().isqrt();
                (v, order * order == v.len() && (1..=MAX_ORDER).contains(&order), "1, 4, 9, 16, 25 or 36".to_owned())
            }
        };
        if !fits {
            return Err(CentreError::input("light values", values.len(), expected));
        }
        let negative = matches!(light, IncidentRadiance::Sampled(_));
        match values.iter().flatten().find(|v| !(v.is_finite() && (!negative || **v >= 0.0))) {
            Some(bad) => Err(CentreError::input("light", bad, "finite, and >= 0 along directions")),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::compensated::centres::testing::cloud;

    const ROOT: f32 = 3.544_907_7;
    const EXPONENTIALS: [Exponential; 4] =
        [Exponential::OptimalLinear, Exponential::Hybrid, Exponential::Pointwise, Exponential::Direct];
    const MULTIPLES: [MultipleScattering; 3] =
        [MultipleScattering::None, MultipleScattering::Diffusion, MultipleScattering::IntegralCentres];

    fn medium(sigma_t: f32, albedo: f32, g: f32) -> MediumParameters {
        MediumParameters { sigma_t: [sigma_t; 3], albedo: [albedo; 3], g }
    }

    fn uniform(t: &CentreTransport) -> IncidentRadiance {
        IncidentRadiance::Sampled(vec![[1.0; 3]; t.directions().len()])
    }

    #[test]
    fn every_setting_is_finite_and_bounded_in_every_medium() {
        let mut gaussians = cloud(12, 51);
        gaussians[1] = gaussians[0];
        gaussians[2].center = [1.5, 0.5, 0.5];
        for exponential in EXPONENTIALS {
            for multiple in MULTIPLES {
                for order in [1, 4, 6] {
                    let settings = CentreSettings { order, exponential, multiple, rings: 7 };
                    let mut t = CentreTransport::new(&gaussians, settings).unwrap();
                    let light = uniform(&t);
                    for sigma_t in [0.0, 1e-6, 1.0, 1e3, 1e6, 1e30] {
                        for (albedo, g) in [(0.0, 0.0), (0.9, 0.6), (1.0, -0.6), (1.0, 0.99), (1.0, -0.99)] {
                            let j = t.radiance(&medium(sigma_t, albedo, g), 1.0, &light, None).unwrap();
                            assert_eq!(j.coefficients.len(), 12 * order * order);
                            for j in j.coefficients.chunks(order * order) {
                                assert!(j.iter().flatten().all(|v| v.is_finite()));
                                assert!(
                                    j[0].iter().all(|&v| (0.0..1.0001 * ROOT).contains(&v)),
                                    "{settings:?} {sigma_t} {albedo} {g}: {:?}",
                                    j[0]
                                );
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn an_empty_frame_and_bad_input_are_told_apart() {
        let mut none = CentreTransport::new(&[], CentreSettings::default()).unwrap();
        let light = uniform(&none);
        assert!(none.radiance(&medium(1.0, 1.0, 0.5), 1.0, &light, None).unwrap().coefficients.is_empty());
        assert!(none.radiance(&medium(1.0, 1.0, 0.5), f32::NAN, &light, None).is_err());
        assert!(none.radiance(&medium(-1.0, 1.0, 0.5), 1.0, &light, None).is_err());
        let short = IncidentRadiance::Sampled(vec![[1.0; 3]; 97]);
        let error = none.radiance(&medium(1.0, 1.0, 0.5), 1.0, &short, None).unwrap_err();
        assert_eq!(error.to_string(), "light values: found 97, expected 98");
        let poison = IncidentRadiance::Harmonics(vec![[f32::NAN; 3]; 4]);
        assert!(none.radiance(&medium(1.0, 1.0, 0.5), 1.0, &poison, None).is_err());
        assert!(CentreTransport::new(&[], CentreSettings { order: 7, ..CentreSettings::default() }).is_err());
        assert!(CentreTransport::new(&[], CentreSettings { rings: 0, ..CentreSettings::default() }).is_err());
    }

    #[test]
    fn only_extinction_times_length_times_density_counts() {
        // Powers of two shift no digit: the same bits.
        let gaussians = cloud(20, 52);
        let dense: Vec<Gaussian> =
            gaussians.iter().map(|g| Gaussian { weight: g.weight * 1_048_576.0, ..*g }).collect();
        let mut a = CentreTransport::new(&gaussians, CentreSettings::default()).unwrap();
        let mut b = CentreTransport::new(&dense, CentreSettings::default()).unwrap();
        let light = uniform(&a);
        let first = a.radiance(&medium(16.0, 0.9, 0.3), 1.0, &light, None).unwrap();
        let second = b.radiance(&medium(16.0 / 1_048_576.0 / 4096.0, 0.9, 0.3), 4096.0, &light, None).unwrap();
        assert_eq!(first.coefficients, second.coefficients);
    }

    #[test]
    fn channels_are_lit_each_by_its_own_medium() {
        let gaussians = cloud(20, 53);
        let mut t = CentreTransport::new(&gaussians, CentreSettings::default()).unwrap();
        let light = IncidentRadiance::Harmonics(vec![[3.0, 2.0, 1.0], [0.1; 3], [0.5, 0.2, 0.1], [0.0; 3]]);
        let colours = MediumParameters { sigma_t: [5.0, 20.0, 5.0], albedo: [0.9, 0.5, 1.0], g: 0.4 };
        let together = t.radiance(&colours, 1.0, &light, None).unwrap();
        assert_eq!(t.matrices.len(), 2, "two extinctions, two matrices");
        for c in 0..3 {
            let alone = t.radiance(&medium(colours.sigma_t[c], colours.albedo[c], 0.4), 1.0, &light, None).unwrap();
            assert!(alone.coefficients.iter().zip(&together.coefficients).all(|(a, b)| a[c] == b[c]));
        }
    }

    #[test]
    fn an_edit_from_a_warm_start_agrees_with_a_cold_one() {
        let gaussians = cloud(30, 54);
        let mut t = CentreTransport::new(&gaussians, CentreSettings::default()).unwrap();
        let light = uniform(&t);
        let before = t.radiance(&medium(20.0, 0.9, 0.0), 1.0, &light, None).unwrap();
        let cold = t.radiance(&medium(20.0, 0.92, 0.0), 1.0, &light, None).unwrap();
        let warm = t.radiance(&medium(20.0, 0.92, 0.0), 1.0, &light, Some(&before)).unwrap();
        // Both residuals are 1e-6 of |J_ss|, times 1 / (1 - 0.92).
        let scale = ROOT * (30.0f32).sqrt();
        assert!(cold.coefficients.iter().zip(&warm.coefficients).all(|(a, b)| (a[0] - b[0]).abs() < 3e-5 * scale));
    }

    #[test]
    fn the_number_of_threads_changes_no_bit() {
        let gaussians = cloud(70, 55);
        let run = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                MULTIPLES.map(|multiple| {
                    let settings = CentreSettings { multiple, ..CentreSettings::default() };
                    let mut t = CentreTransport::new(&gaussians, settings).unwrap();
                    let light = uniform(&t);
                    t.radiance(&medium(10.0, 0.9, 0.4), 1.0, &light, None).unwrap().coefficients
                })
            })
        };
        assert_eq!(run(1), run(3));
    }
}
