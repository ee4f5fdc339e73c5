//! The host's side of the view pass, `march.wgsl`: a film from a volume on the device.
//!
//! What differs from the processor: places are f32 (see the shader), azimuths of environments are as exact as the
//! device's `atan2` (Vulkan allows 4,096 units in the last place, 2e-4 of a turn). At half resolution the processor
//! reads the pixels between the coarse ones, and the device marches those that need rays of their own. Pixels are done
//! in runs of at most 2^20 rays, so that no submission takes so long that a driver gives up on it.

use super::device::{Gpu, GpuError};
use super::layouts::{Environment, March, Pixel as DevicePixel};
use super::pass::{Kernel, Step};
use super::volume::DeviceVolume;
use crate::backdrop::Sky;
use crate::camera::Camera;
use crate::film::{Film, Pixel};
use crate::half_resolution;
use crate::march::{Lens, MarchMedium, MarchSettings, sample_distance};
use glam::DVec3;
use std::sync::Arc;

/// The shader, without its prelude.
pub const SHADER: &str = include_str!("../march.wgsl");
/// Rays of one submission.
const RAYS: usize = 1 << 20;
/// What the shader writes for infinity, which WGSL has no word for.
const FAR: f32 = 3.0e38;

/// The view pass, compiled.
pub struct MarchPass {
    kernel: Kernel,
}

/// A [`Sky`] on the device.
pub struct DeviceSky {
    sky: Arc<Sky>,
    count: u32,
    has_peak: bool,
    environments: wgpu::Buffer,
    texels: wgpu::Buffer,
}

impl DeviceSky {
    /// A copy of `sky`.
    pub fn new(gpu: &Gpu, sky: &Arc<Sky>) -> Result<Self, GpuError> {
        let four = |v: &[f32; 3]| [v[0], v[1], v[2], 0.0];
        let mut texels: Vec<[f32; 4]> = sky.peak().iter().map(four).collect();
        let mut environments = Vec::new();
        for environment in sky.visible() {
            environments.push(Environment {
                size: [environment.width as u32, environment.height as u32],
                first: texels.len() as u32,
                up_is_y: environment.up_is_y.into(),
                rotation: environment.rotation as f32,
                ..Environment::default()
            });
            texels.extend(environment.radiance.iter().map(four));
        }
        gpu.checked("backdrop", || {
            Ok(Self {
                sky: sky.clone(),
                count: environments.len() as u32,
                has_peak: !sky.peak().is_empty(),
                environments: gpu.upload("visible environments", &environments)?,
                texels: gpu.upload("texels of the visible environments", &texels)?,
            })
        })
    }
}

impl MarchPass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        Ok(Self { kernel: Kernel::new(gpu, "march", source, "march_pixels")? })
    }

    /// Marches every pixel.
    pub fn film(
        &self,
        gpu: &Gpu,
        volume: &DeviceVolume,
        camera: &Camera,
        medium: &MarchMedium,
        sky: &DeviceSky,
        settings: &MarchSettings,
    ) -> Result<Film, GpuError> {
        let uniform = placed(volume, camera, [camera.width, camera.height], medium, sky, settings);
        if !settings.half_resolution {
            let mut film = Film::new(camera.width, camera.height);
            self.run(gpu, volume, sky, &uniform, None, &mut film.pixels)?;
            return Ok(film);
        }
        let size = half_resolution::coarse_size(camera);
        let mut coarse = Film::new(size[0], size[1]);
        // The medium alone: nothing behind it, and no peak.
        let alone = March {
            peak_ratio: [1.0; 4],
            environments: 0,
            has_peak: 0,
            ..placed(volume, camera, size, medium, sky, settings)
        };
        self.run(gpu, volume, sky, &alone, None, &mut coarse.pixels)?;
        let lens = Lens { camera, medium, backdrop: &*sky.sky, settings };
        half_resolution::film(&lens, &coarse, |apart| {
            let mut pixels = vec![Pixel::EMPTY; apart.len()];
            self.run(gpu, volume, sky, &uniform, Some(apart), &mut pixels)?;
            Ok(pixels)
        })
    }

    /// Marches the pixels of the film that `all` describes, or those `listed` by column and row.
    fn run(
        &self,
        gpu: &Gpu,
        volume: &DeviceVolume,
        sky: &DeviceSky,
        all: &March,
        listed: Option<&[[usize; 2]]>,
        pixels: &mut [Pixel],
    ) -> Result<(), GpuError> {
        let most = (gpu.summary().storage_binding.min(gpu.summary().buffer) as usize / size_of::<DevicePixel>()).max(1);
        let run = (RAYS / (all.samples * all.samples) as usize).clamp(1, most).min(pixels.len().max(1));
        let out = gpu.storage("pixels of the image", (run * size_of::<DevicePixel>()) as u64)?;
        for (number, pixels) in pixels.chunks_mut(run).enumerate() {
            if let Some(listed) = listed {
                let place = |&[x, y]: &[usize; 2]| DevicePixel {
                    radiance: [x as f32, y as f32, 0.0, 0.0],
                    ..DevicePixel::default()
                };
                let places: Vec<DevicePixel> = listed[number * run..][..pixels.len()].iter().map(place).collect();
                gpu.queue.write_buffer(&out, 0, bytemuck::cast_slice(&places));
            }
            let uniform = March {
                first_pixel: (number * run) as u32,
                pixels: pixels.len() as u32,
                listed: listed.is_some().into(),
                ..*all
            };
            let uniform = gpu.uniform("march", &uniform);
            let [a, b, c, d] = [0, 1, 2, 3].map(|page| &volume.pages[page]);
            let inputs = [&uniform, &volume.table.places, a, b, c, d, &sky.environments, &sky.texels, &out];
            let buffers: Vec<(u32, &wgpu::Buffer)> = (0..).zip(inputs).collect();
            let step = Step { kernel: &self.kernel, buffers: &buffers, threads: pixels.len() as u32 };
            gpu.dispatch("view pass", &[step])?;
            let marched: Vec<DevicePixel> = gpu.read("view pass", &out, pixels.len())?;
            for (pixel, DevicePixel { radiance: [r, g, b, depth], transmittance: [x, y, z, _] }) in
                pixels.iter_mut().zip(marched)
            {
                let depth = if depth < FAR { depth } else { f32::INFINITY };
                *pixel = Pixel { radiance: [r, g, b], transmittance: [x, y, z], depth };
            }
        }
        Ok(())
    }
}

/// Everything but the pixels of a dispatch, for an image of `size` columns and rows. All differences of large numbers
/// are taken here, in f64.
fn placed(
    volume: &DeviceVolume,
    camera: &Camera,
    size: [usize; 2],
    medium: &MarchMedium,
    sky: &DeviceSky,
    settings: &MarchSettings,
) -> March {
    let node_from_world = volume.table.world_from_node.inverse();
    let ds = sample_distance(&volume.table.world_from_node, volume.table.density_max, settings.step, medium.sigma_t);
    let top = volume.table.dims.map(|n| (n - 1) as f64);
    let middle = volume.table.world_from_node.transform_point3(DVec3::from_array(top) * 0.5);
    // An eye past the middle counts from itself.
    let plane = (middle - camera.position).dot(camera.forward).max(0.0);
    let samples = (plane / ds).min(f64::from(1 << 30));
    let whole = samples.floor();
    let pixel = 2.0 * camera.tan_half_width / camera.width as f64;
    let [across, along] =
        [camera.width as f64 / size[0] as f64, camera.height as f64 / size[1] as f64].map(|n| n * pixel);
    let (right, down) = (camera.right * across, -camera.up * along);
    let four = |v: DVec3| v.as_vec3().extend(0.0).to_array();
    let node = |v: DVec3| four(node_from_world.transform_vector3(v));
    let wide = |v: [f32; 3], last: f32| [v[0], v[1], v[2], last];
    March {
        centre: four(node_from_world.transform_point3(camera.position + camera.forward * plane)),
        plane_right: node(right * plane),
        plane_down: node(down * plane),
        step_forward: node(camera.forward * ds),
        step_right: node(right * ds),
        step_down: node(down * ds),
        forward: four(camera.forward),
        right: four(right),
        down: four(down),
        sigma_t: wide(medium.sigma_t, 0.0),
        peak_ratio: wide(medium.peak_ratio, 1.0),
        top: wide(top.map(|t| t as f32), 0.0),
        bricks: [volume.table.bricks[0] as u32, volume.table.bricks[1] as u32, volume.table.bricks[2] as u32, 0],
        size: size.map(|n| n as u32),
        first_pixel: 0,
        pixels: 0,
        samples: settings.samples as u32,
        bricks_a_page: volume.bricks_a_page.min(u32::MAX as usize) as u32,
        environments: sky.count,
        has_peak: (sky.has_peak && medium.peak_ratio != [1.0; 3]).into(),
        pixel: [across as f32, along as f32],
        ds: ds as f32,
        plane: plane as f32,
        plane_fraction: (samples - whole) as f32,
        plane_samples: samples as f32,
        least: -(whole as i32),
        cutoff: settings.cutoff,
        ..March::default()
    }
}
