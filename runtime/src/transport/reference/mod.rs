//! The truth that all other methods are measured against: unbiased path tracing of the density itself.
//!
//! `L(x, w) = int T(x, y) sigma_t D(y) albedo int p(w, w') L(y, w') dw' dy + T L_sky`, estimated without any grid of
//! radiance, band or fit: the only things cut are the seed's numbers and [`path::LONGEST`] collisions. Paths are made as
//! [`path`] says, flights and transmittance as [`crate::tracking::flight`] says.
//!
//! *Passes.* Every pass gives each pixel an independent estimate: its samples are spread evenly within the pass and
//! scrambled by a seed of their own. So the standard error of a pixel's mean over n passes is that of n independent
//! numbers, Student's t with n - 1 degrees of freedom. The image is finished when its relative standard error,
//! `sqrt(mean of squared errors) / sqrt(mean of squared means)` over all pixels and channels, is below the one asked;
//! at least [`LEAST_PASSES`] are made. To stop where an estimate of the error first falls below a bound makes that
//! estimate low, by less than a part in a hundred after 16 passes of many pixels; the mean has no such memory of more
//! than the same order of the error.
//! Cost: about 16 paths a pixel and pass where there is smoke. Same bytes on any number of threads: a pixel's numbers
//! depend on the seed, its place and the pass alone.

mod guide;
mod lights;
mod path;
mod sky;

use crate::backdrop::Sky;
use crate::camera::Camera;
use crate::film::{Film, Pixel};
use crate::light::Light;
use crate::medium::field::DensityField;
use crate::tracking::flight::{Column, Extinction, Space};
use crate::transport::medium::{MediumError, MediumParameters};
use glam::Vec3;
use lights::Lights;
use path::Scene;
use rayon::prelude::*;

/// Fewest passes of an image: a standard error from fewer is itself off by a fifth.
pub const LEAST_PASSES: u32 = 16;
/// Pixels that one thread does at a time.
const CHUNK: usize = 32;

/// What is asked of the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferenceSettings {
    /// Most scattering orders of a path; none for all. `Some(1)` is single scattering, `Some(0)` the background alone.
    pub orders: Option<u32>,
    /// Relative standard error of the image at which it is finished; 0 for all of `max_passes`.
    pub target_error: f64,
    /// Most passes, at least 2.
    pub max_passes: u32,
    /// Seed of all numbers.
    pub seed: u64,
}

impl Default for ReferenceSettings {
    /// All orders to 2 %, by at most a million passes.
    fn default() -> Self {
        Self { orders: None, target_error: 0.02, max_passes: 1_000_000, seed: 1 }
    }
}

/// Why there is no reference.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReferenceError {
    /// A medium parameter out of range.
    #[error(transparent)]
    Medium(#[from] MediumError),
    /// A pixel's radiance, which overflows for lights near the largest f32.
    #[error("pixel ({x}, {y}): found radiance that is not finite, expected lights below 1e18")]
    NotFinite {
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
    /// A setting out of range.
    #[error("{name}: found {found}, expected {expected}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        found: String,
        /// The legal values.
        expected: &'static str,
    },
}

/// An image and how well it is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// Means over all passes; depth is the least of all rays.
    pub film: Film,
    /// Standard error of each pixel's mean radiance, RGB, in the order of the film.
    pub standard_error: Vec<[f32; 3]>,
    /// Passes made.
    pub passes: u32,
    /// Relative standard error of the image, see the module's head; 0 for a black image.
    pub relative_error: f64,
    /// Weight that paths still carried where they were cut, over that of all camera rays: at most this part of the
    /// brightest light is missing.
    pub truncated: f64,
}

/// Sums of one pixel over its passes.
#[derive(Clone, Copy)]
struct Sums {
    radiance: [f64; 3],
    squares: [f64; 3],
    transmittance: [f64; 3],
    depth: f32,
    truncated: f64,
}

const NOTHING: Sums =
    Sums { radiance: [0.0; 3], squares: [0.0; 3], transmittance: [0.0; 3], depth: f32::INFINITY, truncated: 0.0 };

/// Renders `field` as [`ReferenceSettings`] ask. `on_pass` is told after each pass how many there were, and the relative
/// error so far (infinite after the first).
pub fn trace(
    field: &DensityField,
    medium: &MediumParameters,
    lights: &[Light],
    camera: &Camera,
    settings: &ReferenceSettings,
    on_pass: &mut dyn FnMut(u32, f64),
) -> Result<Estimate, ReferenceError> {
    medium.check()?;
    let refuse = |name, found, expected| Err(ReferenceError::Setting { name, found, expected });
    if settings.max_passes < 2 {
        return refuse("passes", settings.max_passes.to_string(), "at least 2");
    }
    let target = settings.target_error >= 0.0 && settings.target_error.is_finite();
    if !target {
        return refuse("target error", settings.target_error.to_string(), "a finite number, at least 0");
    }
    let extinction = Extinction::new(medium.sigma_t);
    let space = Space::new(field, extinction.max);
    let lights = (Lights::new(lights, field, &space, extinction.max), Sky::new(lights, None));
    let scene = Scene {
        eye: space.node(camera.position),
        space,
        sigma_t: medium.sigma_t,
        extinction,
        albedo: Vec3::from_array(medium.albedo),
        g: medium.g,
        lights: lights.0,
        backdrop: lights.1,
        camera: *camera,
        orders: settings.orders.unwrap_or(u32::MAX),
        seed: settings.seed,
    };
    let mut sums = vec![NOTHING; camera.width * camera.height];
    let mut passes = 0;
    loop {
        sums.par_chunks_mut(CHUNK).enumerate().for_each_init(Column::default, |column, (chunk, sums)| {
            for (i, sum) in sums.iter_mut().enumerate() {
                let at = chunk * CHUNK + i;
                sum.add(&scene.pixel(at % camera.width, at / camera.width, passes, column));
            }
        });
        passes += 1;
        if let Some(pixel) = sums.iter().position(|s| !s.radiance.iter().chain(&s.squares).all(|v| v.is_finite())) {
            return Err(ReferenceError::NotFinite { x: pixel % camera.width, y: pixel / camera.width });
        }
        let relative_error = relative_error(&sums, passes);
        on_pass(passes, relative_error);
        let enough = passes >= LEAST_PASSES && relative_error <= settings.target_error;
        if enough || passes >= settings.max_passes {
            return Ok(estimate(&sums, camera, passes, relative_error));
        }
    }
}

impl Sums {
    fn add(&mut self, sample: &path::Sample) {
        for c in 0..3 {
            let radiance = f64::from(sample.radiance[c]);
            self.radiance[c] += radiance;
            self.squares[c] += radiance * radiance;
            self.transmittance[c] += f64::from(sample.transmittance[c]);
        }
        self.depth = self.depth.min(sample.depth);
        self.truncated += f64::from(sample.truncated);
    }

    /// Square of the standard error of channel `c`'s mean over `n` passes.
    fn variance(&self, c: usize, n: f64) -> f64 {
        let mean = self.radiance[c] / n;
        // Sums of f64 squares of f32 numbers: what rounding leaves below zero is zero.
        ((self.squares[c] / n - mean * mean) / (n - 1.0)).max(0.0)
    }
}

fn relative_error(sums: &[Sums], passes: u32) -> f64 {
    let n = f64::from(passes);
    if passes < 2 {
        return f64::INFINITY;
    }
    let (mut errors, mut means) = (0.0, 0.0);
    for sum in sums {
        for c in 0..3 {
            errors += sum.variance(c, n);
            means += (sum.radiance[c] / n).powi(2);
        }
    }
    if means > 0.0 { (errors / means).sqrt() } else { 0.0 }
}

fn estimate(sums: &[Sums], camera: &Camera, passes: u32, relative_error: f64) -> Estimate {
    let n = f64::from(passes);
    let mut film = Film::new(camera.width, camera.height);
    let mut standard_error = Vec::with_capacity(sums.len());
    for (pixel, sum) in film.pixels.iter_mut().zip(sums) {
        *pixel = Pixel {
            radiance: sum.radiance.map(|r| (r / n) as f32),
            transmittance: sum.transmittance.map(|t| (t / n) as f32),
            depth: sum.depth,
        };
        standard_error.push([0, 1, 2].map(|c| sum.variance(c, n).sqrt() as f32));
    }
    let truncated = sums.iter().map(|s| s.truncated).sum::<f64>() / (n * sums.len().max(1) as f64);
    Estimate { film, standard_error, passes, relative_error, truncated }
}
