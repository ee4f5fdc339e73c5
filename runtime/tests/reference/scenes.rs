//! Small scenes, and images that are held against each other.

use glam::{DAffine3, DQuat, DVec3, Vec3};
use smoke_runtime::camera::Camera;
use smoke_runtime::image_difference::z_test::{ZFigures, z_test};
use smoke_runtime::image_difference::{Noise, Pair};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::reference::{Estimate, ReferenceSettings, trace};

/// All that an image depends on.
#[derive(Clone)]
pub struct Scene {
    pub field: DensityField,
    pub medium: MediumParameters,
    pub lights: Vec<Light>,
    pub camera: Camera,
}

impl Scene {
    /// A ball under nothing, seen whole by 24 x 24 pixels.
    pub fn ball(medium: MediumParameters, lights: Vec<Light>) -> Self {
        Self { field: ball(), medium, lights, camera: camera(24) }
    }

    /// The mean of `passes` passes.
    pub fn trace(&self, orders: Option<u32>, passes: u32, seed: u64) -> Estimate {
        let settings = ReferenceSettings { orders, target_error: 0.0, max_passes: passes, seed };
        trace(&self.field, &self.medium, &self.lights, &self.camera, &settings, &mut |_, _| {}).unwrap()
    }

    pub fn image(&self, orders: Option<u32>, passes: u32, seed: u64) -> Image {
        Image::of(&self.trace(orders, passes, seed))
    }
}

/// Voxels of 0.1 around the world's origin.
pub fn field(dims: [usize; 3], density: impl Fn([usize; 3]) -> f32) -> DensityField {
    let at = |v: usize| [v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]];
    let values: Vec<f32> = (0..dims.iter().product()).map(|v| density(at(v))).collect();
    let centre = DVec3::from_array(dims.map(|d| 0.5 * (d - 1) as f64)) * 0.1;
    let map = DAffine3::from_scale_rotation_translation(DVec3::splat(0.1), DQuat::IDENTITY, -centre);
    DensityField::from_box([0; 3], dims, &values, map)
}

/// A soft and lopsided ball, 14 voxels across.
pub fn ball() -> DensityField {
    field([14; 3], |at| {
        let p = Vec3::from_array(at.map(|i| i as f32)) - 6.5;
        (-(p.length() / 4.5).powi(4)).exp() * (1.0 + 0.6 * (p.x * 0.9 + p.z).sin())
    })
}

/// A square camera that sees the ball from the side and a little above.
pub fn camera(side: usize) -> Camera {
    Camera::look_at(DVec3::new(0.6, -3.0, 0.5), DVec3::ZERO, DVec3::Z, 24.0, side, side)
}

pub fn grey(sigma_t: f32, albedo: f32, g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [sigma_t; 3], albedo: [albedo; 3], g }
}

/// A white sky, seen behind the smoke or not.
pub fn white(visible: bool) -> Light {
    Light::Environment(Environment { visible, ..Environment::constant([1.0; 3]) })
}

/// A sky of any colours, with a bright side.
pub fn sky() -> Environment {
    let radiance = |t: usize| {
        let (x, y) = ((t % 32) as f32, (t / 32) as f32);
        [0.2 + (x * 0.2).sin().powi(2), 0.3 + 0.05 * y, if y < 6.0 { 2.0 } else { 0.1 }]
    };
    Environment {
        width: 32,
        height: 16,
        radiance: (0..32 * 16).map(radiance).collect(),
        ..Environment::constant([0.0; 3])
    }
}

pub fn sun(toward: Vec3, irradiance: [f32; 3]) -> Light {
    Light::Directional { toward: toward.normalize(), irradiance }
}

/// Radiance with what is known of its error.
#[derive(Clone)]
pub struct Image {
    width: usize,
    pub radiance: Vec<[f32; 3]>,
    pub error: Vec<[f32; 3]>,
    passes: Option<u32>,
}

impl Image {
    pub fn of(estimate: &Estimate) -> Self {
        Self {
            width: estimate.film.width,
            radiance: estimate.film.pixels.iter().map(|p| p.radiance).collect(),
            error: estimate.standard_error.clone(),
            passes: Some(estimate.passes),
        }
    }

    /// An image without noise.
    pub fn exact(width: usize, radiance: Vec<[f32; 3]>) -> Self {
        Self::known_to(0.0, width, radiance)
    }

    /// An image whose pixels are off by `error`.
    pub fn known_to(error: f32, width: usize, radiance: Vec<[f32; 3]>) -> Self {
        Self { width, error: vec![[error; 3]; radiance.len()], radiance, passes: None }
    }

    /// The sum of independent images, whose variances add up; with as many degrees of freedom as one of them, a few less
    /// than it has.
    pub fn sum(images: &[Self]) -> Self {
        let mut sum = images[0].clone();
        for image in &images[1..] {
            for i in 0..sum.radiance.len() {
                for c in 0..3 {
                    sum.radiance[i][c] += image.radiance[i][c];
                    sum.error[i][c] = sum.error[i][c].hypot(image.error[i][c]);
                }
            }
        }
        sum
    }

    /// Channel `c` of each of three images.
    pub fn channels(images: [&Self; 3]) -> Self {
        let mut all = images[0].clone();
        for i in 0..all.radiance.len() {
            all.radiance[i] = [0, 1, 2].map(|c| images[c].radiance[i][c]);
            all.error[i] = [0, 1, 2].map(|c| images[c].error[i][c]);
        }
        all
    }

    pub fn scaled(&self, radiance: f32, error: f32) -> Self {
        let times = |pixels: &[[f32; 3]], by: f32| pixels.iter().map(|p| p.map(|v| v * by)).collect();
        Self { radiance: times(&self.radiance, radiance), error: times(&self.error, error), ..self.clone() }
    }

    fn noise(&self) -> Noise<'_> {
        Noise { standard_error: &self.error, passes: self.passes }
    }

    /// The same with the rounding of a pixel counted as noise.
    fn rounded(&self) -> Self {
        let mut rounded = self.clone();
        for (error, radiance) in rounded.error.iter_mut().zip(&self.radiance) {
            let brightest = radiance.iter().copied().fold(0.0, f32::max);
            *error = error.map(|e| e.hypot(ROUNDING * brightest));
        }
        rounded
    }
}

/// Relative rounding of a pixel: f32 over some operations, and directions, all of one sign. An image of 1000 pixels may
/// be off by 3 / sqrt(1000) of it.
const ROUNDING: f32 = 1e-5;

/// Whether two images can be told apart, by a z-test.
pub fn compare(test: &Image, reference: &Image) -> Result<(), String> {
    let (test, reference) = (test.rounded(), reference.rounded());
    let pair = Pair { width: test.width, test: &test.radiance, reference: &reference.radiance, mask: None };
    let found = z_test(&pair, &reference.noise(), Some(&test.noise())).map_err(|e| e.to_string())?;
    let told = |f: &ZFigures| {
        let (mean, largest) = (f.mean, f.largest);
        let share = format!("share {:.3} of {} (bound {:.3})", f.share.share, f.share.pixels, f.share.bound);
        format!("mean z {:.2}, {share}, largest z {:.1} at ({}, {})", mean.z, largest.z, largest.x, largest.y)
    };
    let mean = |image: &Image| image.radiance.iter().map(|p| f64::from(p[1])).sum::<f64>();
    let rows: Vec<String> = [&found.all].into_iter().chain(&found.channels).map(told).collect();
    let ratio = mean(&test) / mean(&reference);
    if found.passed() { Ok(()) } else { Err(format!("ratio {ratio:.5}\n{}", rows.join("\n"))) }
}

/// [`assert_agrees_to`] 1 %.
pub fn assert_agrees(test: &Image, reference: &Image, what: &str) {
    assert_agrees_to(0.01, test, reference, what);
}

/// Both images agree; and would not, were one of them brighter by a part `off` of itself, or its standard errors halved.
pub fn assert_agrees_to(off: f32, test: &Image, reference: &Image, what: &str) {
    if let Err(why) = compare(test, reference) {
        panic!("{what}: {why}");
    }
    let noise = test.error.iter().chain(&reference.error).map(|e| f64::from(e[1]).powi(2)).sum::<f64>().sqrt();
    let noise = noise / reference.radiance.iter().map(|p| f64::from(p[1])).sum::<f64>();
    assert!(compare(&test.scaled(1.0 + off, 1.0), reference).is_err(), "{what}: {noise:.5} is too noisy for {off}");
    // Pixels whose noise is that of passes, not what is otherwise known of them.
    let noisy = |i: &usize| {
        let of = |image: &Image, passes: bool| if image.passes.is_some() == passes { image.error[*i][1] } else { 0.0 };
        let known = of(test, false).max(of(reference, false)).max(ROUNDING * test.radiance[*i][1]);
        of(test, true).max(of(reference, true)) > 10.0 * known
    };
    let noisy = (0..test.radiance.len()).filter(noisy).count();
    // A third of the pixels lies beyond two halves of a standard error; of 100, 16 are enough to fail.
    if noisy >= 100 {
        let halved = compare(&test.scaled(1.0, 0.5), &reference.scaled(1.0, 0.5));
        assert!(halved.is_err(), "{what}: errors half as large would pass");
    }
}
