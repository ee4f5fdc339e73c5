//! A scene file on stage: read, changed by the command line, checked, and turned into what the runtime renders with.

use crate::cli::Rgb;
use crate::failure::Failure;
use glam::{DVec3, Vec3};
use smoke_formats::image::{self, RgbImage};
use smoke_formats::scene::{self, Scene, Sky, UpAxis};
use smoke_runtime::camera::Camera;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::transport::medium::MediumParameters;
use std::path::Path;
use std::sync::Arc;

/// Values that stand in for those of the scene file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SceneChanges {
    /// Instead of `medium.sigma_t`.
    pub sigma_t: Option<Rgb>,
    /// Instead of `medium.albedo`.
    pub albedo: Option<Rgb>,
    /// Instead of `medium.g`.
    pub g: Option<f64>,
    /// Instead of `image.width`.
    pub width: Option<u32>,
    /// Instead of `image.height`.
    pub height: Option<u32>,
}

/// A scene, and the same for the runtime.
pub struct Stage {
    /// As read, with the changes.
    pub scene: Scene,
    /// Its medium.
    pub medium: MediumParameters,
    /// Its lights, images read.
    pub lights: Vec<Light>,
    /// Its camera, with the image's size.
    pub camera: Camera,
}

impl Stage {
    /// Reads the scene file at `path` and the images that it names.
    pub fn read(path: &Path, changes: &SceneChanges) -> Result<Self, Failure> {
        Self::with(changed(Scene::read(path)?, path, changes)?, &mut |sky| read_sky(sky).map(Arc::new))
    }

    /// A scene that was checked, its images from `sky`.
    pub fn with(scene: Scene, sky: &mut ReadSky) -> Result<Self, Failure> {
        let lights = lights(&scene, sky)?;
        Ok(Self::of(scene, lights))
    }

    /// The same scene, read from `path`, with other values; its images are not read again.
    pub fn changed(&self, path: &Path, changes: &SceneChanges) -> Result<Self, Failure> {
        Ok(Self::of(changed(self.scene.clone(), path, changes)?, self.lights.clone()))
    }

    fn of(scene: Scene, lights: Vec<Light>) -> Self {
        let medium = MediumParameters {
            sigma_t: scene.medium.sigma_t.map(|v| v as f32),
            albedo: scene.medium.albedo.map(|v| v as f32),
            g: scene.medium.g as f32,
        };
        let camera = Camera::from_pinhole(&scene.pinhole());
        Self { scene, medium, lights, camera }
    }
}

/// `scene` with other values, checked.
fn changed(mut scene: Scene, path: &Path, changes: &SceneChanges) -> Result<Scene, Failure> {
    scene.medium.sigma_t = changes.sigma_t.unwrap_or(scene.medium.sigma_t);
    scene.medium.albedo = changes.albedo.unwrap_or(scene.medium.albedo);
    scene.medium.g = changes.g.unwrap_or(scene.medium.g);
    scene.width = changes.width.unwrap_or(scene.width);
    scene.height = changes.height.unwrap_or(scene.height);
    scene.validate(path)?;
    Ok(scene)
}

/// Gives the environment image of a path.
pub type ReadSky<'a> = dyn FnMut(&Path) -> Result<Arc<RgbImage>, Failure> + 'a;

/// The environment image at `path`; says on stderr how many samples were below zero.
pub fn read_sky(path: &Path) -> Result<RgbImage, Failure> {
    let (image, negative) = image::read_environment(path)?;
    if negative > 0 {
        eprintln!("smoke-bake: {}: {negative} negative samples count as 0", path.display());
    }
    Ok(image)
}

/// The scene's lights for the renderer.
fn lights(scene: &Scene, read: &mut ReadSky) -> Result<Vec<Light>, Failure> {
    let mut light = |light: &scene::Light| match light {
        scene::Light::Environment { sky, rotation_degrees, intensity, visible } => {
            let factor = *intensity as f32;
            let mut environment = match sky {
                Sky::Color(color) => Environment::constant(color.map(|v| v as f32 * factor)),
                Sky::Image { resolved, .. } => {
                    let image = read(resolved)?;
                    let radiance = image.pixels.iter().map(|p| p.map(|v| v * factor)).collect();
                    Environment {
                        width: image.width,
                        height: image.height,
                        radiance,
                        ..Environment::constant([0.0; 3])
                    }
                }
            };
            environment.rotation = rotation_degrees.to_radians();
            environment.up_is_y = scene.up == UpAxis::Y;
            environment.visible = *visible;
            Ok(Light::Environment(environment))
        }
        scene::Light::Directional { direction, irradiance } => {
            let direction = DVec3::from_array(*direction);
            let toward: Vec3 = -(direction / direction.abs().max_element()).normalize().as_vec3();
            Ok(Light::Directional { toward, irradiance: irradiance.map(|v| v as f32) })
        }
        scene::Light::Point { position, intensity } => {
            Ok(Light::Point { position: DVec3::from_array(*position), intensity: intensity.map(|v| v as f32) })
        }
    };
    scene.lights.iter().map(&mut light).collect()
}
