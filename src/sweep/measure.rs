//! One reference, and one point against it.

use super::store::ReferenceImage;
use super::table::{Progressed, ReferenceFigures, Seconds};
use crate::cli::Detail;
use crate::devices::{Device, DeviceFrame};
use crate::failure::Failure;
use crate::method::Method;
use crate::staging::Stage;
use crate::{contact_sheet, render};
use smoke_formats::image::RgbImage;
use smoke_formats::pack::Pack;
use smoke_runtime::film::Film;
use smoke_runtime::image_difference::debiased::debiased;
use smoke_runtime::image_difference::flip::flip;
use smoke_runtime::image_difference::uncertainty::uncertainty;
use smoke_runtime::image_difference::{self, Incomparable, Noise, Pair, false_colour};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::renderer::RenderError;
use smoke_runtime::transport::reference::{ReferenceSettings, trace};
use std::sync::Arc;
use std::time::Instant;

/// Error at which the false colours of a difference are full, relative to the root mean square of the reference.
pub const FULL_COLOUR: f64 = 0.1;
/// Widest thumbnail, in pixels.
const WIDEST: usize = 160;
/// How close FLIP looks: a screen of 3840 pixels, 70 cm wide, from 70 cm; what `compare` has by default.
const PIXELS_PER_DEGREE: f64 = 67.0;
/// Seed of the references: not one that `render` has by default, or a sweep of its own reference would meet itself.
const SEED: u64 = 0x7377_6565_7001;

/// Traces the reference of `field` on `stage`: scattering orders up to `orders` until its relative standard error is
/// `target`. `on_pass` is told what has been reached.
pub fn reference(
    field: &DensityField,
    stage: &Stage,
    orders: Option<u32>,
    target: f64,
    on_pass: &mut dyn FnMut(u32, f64),
) -> Result<(ReferenceImage, ReferenceFigures), Failure> {
    let settings = ReferenceSettings { orders, target_error: target, seed: SEED, ..Default::default() };
    let start = Instant::now();
    let mut curve = Vec::new();
    let mut last = None;
    let mut watch = |passes: u32, error: f64| {
        // Infinite after the first pass, which knows no spread.
        if error.is_finite() {
            let now = Progressed { passes, seconds: start.elapsed().as_secs_f64(), relative_standard_error: error };
            if passes.is_power_of_two() {
                curve.push(now);
            }
            last = Some(now);
        }
        on_pass(passes, error);
    };
    let traced = trace(field, &stage.medium, &stage.lights, &stage.camera, &settings, &mut watch);
    let estimate = traced.map_err(|e| Failure::work(format!("reference: {e}")))?;
    let seconds = start.elapsed().as_secs_f64();
    if let Some(last) = last.filter(|last| curve.last() != Some(last)) {
        curve.push(last);
    }
    let image = ReferenceImage {
        width: estimate.film.width,
        radiance: estimate.film.pixels.iter().map(|p| p.radiance).collect(),
        standard_error: estimate.standard_error,
        alpha: estimate.film.pixels.iter().map(|p| p.alpha()).collect(),
    };
    // The tracer counts all pixels; a sweep those with smoke. The variance of both falls with the passes alike.
    let seen = image.noise().unwrap_or(estimate.relative_error);
    let scale = if estimate.relative_error > 0.0 { seen / estimate.relative_error } else { 1.0 };
    curve.iter_mut().for_each(|at| at.relative_standard_error *= scale);
    Ok((image, ReferenceFigures { passes: estimate.passes, seconds, relative_standard_error: seen, curve }))
}

/// Renders one frame of `pack` `repeat` times from the file to the film, on the current pool of threads; gives the film
/// and the seconds of the median. An inner error is a point that the method refuses.
pub fn render(
    pack: &Pack,
    position: usize,
    (method, detail): (&Method, Detail),
    stage: &Stage,
    repeat: u8,
) -> Result<Result<(Film, Seconds), String>, Failure> {
    if matches!(method, Method::Transfer(_)) && !pack.has_transfer(position) {
        return Ok(Err(RenderError::NoTransfer.to_string()));
    }
    let mut runs: Vec<(Seconds, Film)> = Vec::new();
    for _ in 0..repeat.max(1) {
        let mut maker = match method.maker(stage, &Device::Cpu) {
            Ok(maker) => maker,
            Err(why) => return Ok(Err(why)),
        };
        let start = Instant::now();
        let frame = render::read(pack, position, method, detail)?;
        let decode = ("decode", start.elapsed().as_secs_f64());
        match maker.image(DeviceFrame::Cpu(Arc::new(frame)), &mut |_| {}) {
            Ok(image) => runs.push((Seconds::new([decode].into_iter().chain(image.seconds)), image.film)),
            Err(why) => return Ok(Err(why)),
        }
    }
    runs.sort_by(|a, b| a.0.total.total_cmp(&b.0.total));
    let (seconds, film) = runs.swap_remove(runs.len() / 2);
    Ok(Ok((film, seconds)))
}

/// How far an image is from a reference; standard errors are those that the reference's noise leaves.
pub struct Distance {
    /// Relative RMSE without the reference's noise, and its standard error.
    pub relative_rmse: [f64; 2],
    /// Mean error over the mean of the reference, and its standard error.
    pub bias: [f64; 2],
    /// Mean FLIP.
    pub flip: f64,
}

impl ReferenceImage {
    /// How far `radiance` with opacities `alpha` is from this reference, over the pixels where either sees smoke.
    pub fn distance(&self, radiance: &[[f32; 3]], alpha: &[f32]) -> Result<Distance, Incomparable> {
        let mask = image_difference::seen(alpha, Some(&self.alpha));
        let pair = Pair { width: self.width, test: radiance, reference: &self.radiance, mask: Some(&mask) };
        let noise = Noise { standard_error: &self.standard_error, passes: None };
        let (figures, sure) = (debiased(&pair, &noise)?.all, uncertainty(&pair, &noise)?);
        Ok(Distance {
            relative_rmse: [figures.relative_rmse, sure.relative_rmse],
            bias: [image_difference::compare(&pair)?.all.bias, sure.bias],
            flip: flip(&pair, PIXELS_PER_DEGREE)?.figures.mean,
        })
    }

    /// Relative standard error of this reference over the pixels where it sees smoke; none if there are none.
    fn noise(&self) -> Option<f64> {
        let mask = image_difference::seen(&self.alpha, None);
        let pair = Pair { width: self.width, test: &self.radiance, reference: &self.radiance, mask: Some(&mask) };
        let noise = Noise { standard_error: &self.standard_error, passes: None };
        debiased(&pair, &noise).ok().map(|d| d.all.reference_noise)
    }

    /// The reference as a thumbnail.
    pub fn thumbnail(&self) -> RgbImage {
        self.exposed(&self.radiance)
    }

    /// `radiance` as a thumbnail, as bright as the reference's.
    pub fn exposed(&self, radiance: &[[f32; 3]]) -> RgbImage {
        let image = |pixels: &[[f32; 3]]| RgbImage {
            width: self.width,
            height: pixels.len() / self.width,
            pixels: pixels.to_vec(),
        };
        let exposure = contact_sheet::exposure(&[image(&self.radiance)]);
        contact_sheet::thumbnail(&image(radiance), self.thumbnail_size(), exposure)
    }

    /// The signed difference of `radiance` from the reference in false colour, full at [`FULL_COLOUR`].
    pub fn false_colour(&self, radiance: &[[f32; 3]], alpha: &[f32]) -> Result<RgbImage, Failure> {
        let mask = image_difference::seen(alpha, Some(&self.alpha));
        let samples = self.radiance.iter().zip(&mask).filter(|(_, seen)| **seen).flat_map(|(p, _)| p);
        let (sum, count) =
            samples.fold((0.0, 0.0), |(sum, count), &v| (sum + f64::from(v) * f64::from(v), count + 1.0));
        let scale = FULL_COLOUR * (sum / f64::max(count, 1.0)).sqrt();
        let pair = Pair { width: self.width, test: radiance, reference: &self.radiance, mask: Some(&mask) };
        let pixels = false_colour::signed(&pair, if scale > 0.0 { scale } else { 1.0 });
        let pixels = pixels.map_err(|e| Failure::work(e.to_string()))?;
        let image = RgbImage { width: self.width, height: pixels.len() / self.width, pixels };
        Ok(contact_sheet::thumbnail(&image, self.thumbnail_size(), 1.0))
    }

    fn thumbnail_size(&self) -> [usize; 2] {
        let height = self.radiance.len() / self.width;
        let width = self.width.min(WIDEST);
        [width, (width * height).div_ceil(self.width).max(1)]
    }
}
