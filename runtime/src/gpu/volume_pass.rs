//! The host's side of the volume pass, `transport/compensated/grid/route.wgsl`.
//!
//! Planes stay on the device until the light changes.

use super::device::{Gpu, GpuError};
use super::layouts::VolumePass as Uniform;
use super::pass::{Kernel, Step};
use super::planes::{Part, Planes};
use super::volume::{DeviceVolume, PAGES, seen_from, wide};
use crate::medium::field::DensityField;
use crate::shaded_volume::BRICK_NODES;
use crate::transport::compensated::grid::route::GridSource;
use glam::DVec3;

/// The shader, without its prelude.
pub const SHADER: &str =
    concat!(include_str!("../sphere/harmonics.wgsl"), include_str!("../transport/compensated/grid/route.wgsl"));

/// The volume pass, compiled.
pub struct VolumePass {
    add: Kernel,
    finish: Kernel,
}

/// Planes of coefficients on nodes `step` voxels apart.
pub(super) struct DeviceLayer {
    step: usize,
    dims: [usize; 3],
    bands: usize,
    planes: Planes,
}

/// A [`GridSource`] on the device.
pub struct DeviceSource {
    channels: usize,
    pub(super) layers: Vec<DeviceLayer>,
    /// Products that the iteration for multiple scattering took; 0 without.
    pub iterations: usize,
    /// Its last relative residual.
    pub residual: f64,
}

impl DeviceLayer {
    /// Of planes `[coefficient * channels + channel]` of all nodes.
    pub(super) fn new(step: usize, dims: [usize; 3], channels: usize, planes: Planes) -> Self {
        Self { step, dims, bands: (planes.count() / channels).isqrt(), planes }
    }
}

impl DeviceSource {
    /// A copy of `source`.
    pub fn new(gpu: &Gpu, source: &GridSource) -> Result<Self, GpuError> {
        let layer = |(step, dims, planes): (usize, [usize; 3], &[Vec<f32>])| {
            let planes = Planes::upload(gpu, "planes of source radiance", planes, dims.iter().product())?;
            Ok(DeviceLayer::new(step, dims, source.channels, planes))
        };
        let layers =
            gpu.checked("source radiance", || source.layers().map(layer).collect::<Result<Vec<_>, GpuError>>())?;
        Ok(Self { channels: source.channels, layers, iterations: source.iterations, residual: source.residual })
    }

    /// Of single scattering.
    pub(super) fn of_layer(channels: usize, single: DeviceLayer) -> Self {
        Self { channels, layers: vec![single], iterations: 0, residual: 0.0 }
    }

    /// True if the volume must be shaded again when the camera moves.
    pub fn depends_on_view(&self) -> bool {
        self.layers.iter().any(|layer| layer.bands > 1)
    }

    /// Planes of each layer, as [`GridSource::layers`] has them: for comparisons.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<Vec<Vec<f32>>>, GpuError> {
        self.layers.iter().map(|layer| layer.planes.read(gpu)).collect()
    }
}

impl VolumePass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        let add = Kernel::new(gpu, "volume pass", source, "add_planes")?;
        Ok(Self { add, finish: Kernel::new(gpu, "volume pass", source, "finish")? })
    }

    /// Shades `volume`, which was made of `field`, for an eye in world space.
    /// `density` is the field's, one value a node.
    pub fn shade(
        &self,
        gpu: &Gpu,
        source: &DeviceSource,
        (field, density): (&DensityField, &wgpu::Buffer),
        volume: &DeviceVolume,
        eye: DVec3,
    ) -> Result<(), GpuError> {
        let [eye, column_x, column_y, column_z] = seen_from(eye, field);
        let base = Uniform {
            eye,
            column_x,
            column_y,
            column_z,
            dims: wide(field.dims),
            bricks: wide(volume.table.bricks),
            channels: source.channels as u32,
            ..Uniform::default()
        };
        // Uniforms first: steps borrow them.
        let mut uniforms = Vec::new();
        for page in (0..PAGES).filter(|&page| volume.page(page).1 > 0) {
            let (first_brick, bricks) = volume.page(page);
            let base = Uniform { first_brick: first_brick as u32, page_bricks: bricks as u32, ..base };
            for layer in &source.layers {
                for Part { first, count, buffer } in &layer.planes.parts {
                    let uniform = Uniform {
                        layer_dims: wide(layer.dims),
                        step: layer.step as u32,
                        first_plane: *first as u32,
                        planes: *count as u32,
                        bands: layer.bands as u32,
                        ..base
                    };
                    uniforms.push((page, Some(buffer), gpu.uniform("volume pass", &uniform)));
                }
            }
            uniforms.push((page, None, gpu.uniform("volume pass", &base)));
        }
        let buffers: Vec<Vec<(u32, &wgpu::Buffer)>> = uniforms
            .iter()
            .map(|(page, planes, uniform)| {
                let own = if let Some(planes) = planes { (2, *planes) } else { (3, density) };
                vec![(0, uniform), (1, &volume.table.dense_bricks), own, (4, &volume.pages[*page])]
            })
            .collect();
        let steps: Vec<Step> = uniforms
            .iter()
            .zip(&buffers)
            .map(|((page, planes, _), buffers)| Step {
                kernel: if planes.is_some() { &self.add } else { &self.finish },
                buffers,
                threads: (volume.page(*page).1 * BRICK_NODES) as u32,
            })
            .collect();
        gpu.checked("volume pass", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            volume.pages.iter().for_each(|page| encoder.clear_buffer(page, 0, None));
            gpu.queue.submit([encoder.finish()]);
            Ok(())
        })?;
        gpu.dispatch("volume pass", &steps)
    }
}
