//! The methods, the scenes they are driven through, and how images are held against the truth.

use glam::{DAffine3, DQuat, DVec3, Vec3};
use smoke_baking::transfer::at_rest::frame_transfer;
use smoke_baking::transfer::{TransferSettings, bake_run};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::residual::ResidualCodes;
use smoke_formats::volume::VoxelMask;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::{Film, Pixel};
use smoke_runtime::image_difference::debiased::debiased;
use smoke_runtime::image_difference::{Noise, Pair};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::march::MarchSettings;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderError, RenderSettings, Renderer, Route};
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, MultipleScattering};
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::reference::{Estimate, ReferenceSettings, trace};
use smoke_runtime::transport::transfer::frame::FrameTransfer;
use smoke_runtime::transport::transfer::source::TransferSettings as TransferDials;
use std::sync::{Arc, LazyLock};

/// Every way to an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    Grid,
    GridSingle,
    HalfResolution,
    /// Centres: direct exponential, integral transport.
    Centres,
    /// Centres: optimal-linear exponential, diffusion; the paper's own pair.
    Paper,
    /// Baked for each scene, with 42 directions and one photon a face.
    Transfer,
    Reference,
}

pub const ALL: [Method; 7] = [
    Method::Grid,
    Method::GridSingle,
    Method::HalfResolution,
    Method::Centres,
    Method::Paper,
    Method::Transfer,
    Method::Reference,
];

/// All that an image depends on.
#[derive(Clone)]
pub struct Scene {
    pub frame: Frame,
    pub medium: MediumParameters,
    pub lights: Vec<Light>,
    pub camera: Camera,
}

impl Method {
    /// The settings of the compensated methods; none for the reference.
    pub fn settings(self) -> Option<RenderSettings> {
        let plain = RenderSettings::default();
        Some(match self {
            Self::Grid => plain,
            Self::GridSingle => RenderSettings { scattering: ScatteringOrder::Single, ..plain },
            Self::HalfResolution => {
                RenderSettings { march: MarchSettings { half_resolution: true, ..plain.march }, ..plain }
            }
            Self::Centres => centres(Exponential::Direct, MultipleScattering::IntegralCentres),
            Self::Paper => centres(Exponential::OptimalLinear, MultipleScattering::Diffusion),
            Self::Transfer => RenderSettings { route: Route::Transfer(TransferDials::default()), ..plain },
            Self::Reference => return None,
        })
    }

    /// True if only light that has scattered once is in its images.
    pub fn is_single(self) -> bool {
        self == Self::GridSingle
    }

    /// True if it knows the smoke by its Gaussians.
    pub fn needs_gaussians(self) -> bool {
        matches!(self, Self::Centres | Self::Paper)
    }

    /// The image, or the message of a refusal. No pixel of it is anything but a number.
    pub fn image(self, scene: &Scene) -> Result<Film, String> {
        let film = match self.settings() {
            None => scene.reference(None, 16).film,
            Some(settings) => {
                let render = || -> Result<Film, RenderError> {
                    let mut renderer = Renderer::new(settings, scene.medium, scene.lights.clone())?;
                    let mut frame = scene.frame.clone();
                    if self == Self::Transfer {
                        frame.transfer = Some(Arc::new(transfer(&frame.field, scene.medium)));
                    }
                    renderer.set_frame(frame)?;
                    Ok(renderer.render(&scene.camera)?.0)
                };
                render().map_err(|e| e.to_string())?
            }
        };
        sound(&film).unwrap_or_else(|pixel| panic!("{self:?}: {pixel}"));
        Ok(film)
    }

    /// The image of a scene that it serves.
    pub fn served(self, scene: &Scene) -> Film {
        self.image(scene).unwrap_or_else(|e| panic!("{self:?}: {e}"))
    }
}

/// The first pixel that is anything but numbers: radiance from 0, transmittance from 0 to 1, depth from 0.
fn sound(film: &Film) -> Result<(), String> {
    let good = |p: &Pixel| {
        let finite = p.radiance.iter().all(|v| v.is_finite() && *v >= 0.0) && p.depth >= 0.0;
        // Products of rounded factors, and means of them.
        finite && p.transmittance.iter().all(|t| (0.0..=1.000_001).contains(t))
    };
    match film.pixels.iter().position(|p| !good(p)) {
        Some(i) => Err(format!("pixel {i}: {:?}", film.pixels[i])),
        None => Ok(()),
    }
}

pub fn centres(exponential: Exponential, multiple: MultipleScattering) -> RenderSettings {
    let route = Route::Centres(CentreSettings { exponential, multiple, ..CentreSettings::default() });
    RenderSettings { route, ..RenderSettings::default() }
}

/// Directions of light, and those of indirect light.
static BASES: LazyLock<[Arc<LightBasis>; 2]> = LazyLock::new(|| {
    let basis = BasisKind::Discrete(42);
    [basis, basis.coarser()].map(|kind| Arc::new(LightBasis::new(kind)))
});

/// The transfer of a frame as a pack would give it.
fn transfer(field: &DensityField, medium: MediumParameters) -> FrameTransfer {
    let (clusters, terms, photons, shift, seed, memory) = (32, 4, 1, 1, 1, 1 << 30);
    let settings = TransferSettings { basis: BASES[0].kind(), medium, clusters, terms, photons, shift, seed, memory };
    let run = bake_run(&[field], [&BASES[0], &BASES[1]], &settings, &|_, _, _| ());
    frame_transfer(&run, &settings, &BASES, 0)
}

impl Scene {
    /// The two lumps of smoke, seen whole.
    pub fn lumps(medium: MediumParameters, lights: Vec<Light>) -> Self {
        Self { frame: frame([20; 3], 0.1, 1.0, &lumps(), |_| 0.0), medium, lights, camera: camera(4.0) }
    }

    pub fn reference(&self, orders: Option<u32>, passes: u32) -> Estimate {
        let settings = ReferenceSettings { orders, target_error: 0.0, max_passes: passes, seed: 1 };
        trace(&self.frame.field, &self.medium, &self.lights, &self.camera, &settings, &mut |_, _| {}).unwrap()
    }

    /// The reference with as many orders as `method` has.
    pub fn truth_for(&self, method: Method, passes: u32) -> Estimate {
        self.reference(method.is_single().then_some(1), passes)
    }
}

/// A frame whose density is `density` of the voxel, in the residual (with steps of 1/1000 of `unit`), beside that of the
/// Gaussians, at voxels of `voxel` world units around the world's origin.
pub fn frame(
    dims: [u32; 3],
    voxel: f64,
    unit: f32,
    gaussians: &[Gaussian],
    density: impl Fn([u32; 3]) -> f32,
) -> Frame {
    let count = dims.iter().product::<u32>() as usize;
    let mut support = VoxelMask::new(count);
    let mut codes = Vec::new();
    for v in 0..count as u32 {
        let at = [v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]];
        let code = (density(at) * 1000.0).round() as i32;
        if code > 0 || !gaussians.is_empty() {
            support.set(v as usize);
            codes.push(code);
        }
    }
    let residual = ResidualCodes { origin: [0; 3], dims, support, codes };
    let centre = DVec3::from_array(dims.map(|d| 0.5 * f64::from(d - 1))) * voxel;
    let map = DAffine3::from_scale_rotation_translation(DVec3::splat(voxel), DQuat::IDENTITY, -centre);
    Frame::decode(gaussians.to_vec(), &residual, unit / 1000.0, UnitSpace::of_box([0; 3], dims), map)
}

/// Two Gaussians.
pub fn lumps() -> Vec<Gaussian> {
    vec![
        Gaussian { center: [0.4, 0.5, 0.5], radius: 0.2, weight: 0.8 },
        Gaussian { center: [0.62, 0.52, 0.45], radius: 0.15, weight: 0.5 },
    ]
}

/// A soft ball without Gaussians, 20 voxels across, radius about 0.35 of the box.
pub fn ball(voxel: f64, unit: f32) -> Frame {
    frame([20; 3], voxel, unit, &[], |at| {
        let p = Vec3::from_array(at.map(|i| i as f32)) - 9.5;
        (-(p.length() / 6.0).powi(4)).exp()
    })
}

pub fn grey(sigma_t: f32, albedo: f32, g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [sigma_t; 3], albedo: [albedo; 3], g }
}

pub fn white() -> Vec<Light> {
    vec![Light::Environment(Environment::constant([1.0; 3]))]
}

pub fn visible(lights: Vec<Light>) -> Vec<Light> {
    let see = |light| match light {
        Light::Environment(environment) => Light::Environment(Environment { visible: true, ..environment }),
        other => other,
    };
    lights.into_iter().map(see).collect()
}

pub fn sun(toward: Vec3) -> Vec<Light> {
    vec![Light::Directional { toward: toward.normalize(), irradiance: [3.0, 2.0, 1.0] }]
}

pub fn camera(distance: f64) -> Camera {
    Camera::look_at(DVec3::new(0.3, -1.0, 0.2) * distance, DVec3::ZERO, DVec3::Z, 40.0, 24, 18)
}

/// Sum over all pixels and channels.
pub fn light_in(film: &Film) -> f64 {
    film.pixels.iter().flat_map(|p| p.radiance).map(f64::from).sum()
}

/// Sum of the opacities.
pub fn smoke_in(film: &Film) -> f64 {
    film.pixels.iter().map(|p| f64::from(p.alpha())).sum()
}

/// Standard error of [`light_in`], its channels taken to move together.
pub fn noise_of(estimate: &Estimate) -> f64 {
    let pixel = |e: &[f32; 3]| f64::from(e[0] + e[1] + e[2]).powi(2);
    estimate.standard_error.iter().map(pixel).sum::<f64>().sqrt()
}

/// Relative RMS difference from a reference over its pixels with smoke, the reference's own noise taken off.
pub fn distance(film: &Film, truth: &Estimate) -> f64 {
    let radiance = |film: &Film| -> Vec<[f32; 3]> { film.pixels.iter().map(|p| p.radiance).collect() };
    let (test, reference) = (radiance(film), radiance(&truth.film));
    let mask: Vec<bool> = truth.film.pixels.iter().map(|p| p.alpha() > 0.0).collect();
    let pair = Pair { width: film.width, test: &test, reference: &reference, mask: Some(&mask) };
    let noise = Noise { standard_error: &truth.standard_error, passes: Some(truth.passes) };
    debiased(&pair, &noise).unwrap().all.relative_rmse
}

/// Two noisy images have the same mean, within four of their standard errors.
pub fn assert_same_light(a: &Estimate, b: &Estimate, what: &str) {
    let (found, expected) = (light_in(&a.film), light_in(&b.film));
    let noise = noise_of(a).hypot(noise_of(b));
    assert!((found - expected).abs() <= 4.0 * noise + 1e-6 * expected, "{what}: {found} {expected} +- {noise}");
    assert!(expected == 0.0 || noise < 0.05 * expected, "{what}: {noise} of {expected} shows nothing");
}

#[test]
fn poison_and_planted_errors_are_found() {
    let scene = Scene::lumps(grey(3.0, 0.9, 0.0), white());
    let (truth, film) = (scene.reference(None, 16), Method::Grid.served(&scene));
    assert_eq!(sound(&film), Ok(()));
    for poison in [f32::NAN, f32::INFINITY, -0.1] {
        for plant in [
            |p: &mut Pixel, v| p.radiance[2] = v,
            |p: &mut Pixel, v| p.transmittance[1] = v,
            |p: &mut Pixel, v| p.depth = -f32::abs(v),
        ] {
            let mut spoilt = film.clone();
            plant(&mut spoilt.pixels[200], poison);
            assert!(sound(&spoilt).unwrap_err().starts_with("pixel 200"));
        }
    }
    let scaled = |film: &Film, by: f32| {
        let mut film = film.clone();
        film.pixels.iter_mut().for_each(|p| p.radiance = p.radiance.map(|r| r * by));
        film
    };
    // The largest error that a method of grids is allowed anywhere under a sky.
    for by in [0.88, 1.12] {
        assert!(distance(&scaled(&film, by), &truth) > 0.08, "{by}");
    }
    let other = Estimate { film: scaled(&truth.film, 1.1), ..truth.clone() };
    assert!(std::panic::catch_unwind(|| assert_same_light(&other, &truth, "planted")).is_err());
}
