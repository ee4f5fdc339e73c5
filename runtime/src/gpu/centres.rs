//! The host's side of the route through centres: `centres/volume_pass.wgsl`.
//!
//! Gaussians and coordinates go up once for a frame, what the Gaussians send once for a light; an eye costs one
//! uniform.

use super::device::{Gpu, GpuError};
use super::layouts::CentreVolume as Uniform;
use super::pass::{GROUP, Kernel, Step};
use super::volume::{DeviceVolume, PAGES, wide};
use crate::medium::field::DensityField;
use crate::transport::compensated::centres::source::CentreSource;
use glam::DVec3;

/// The shader, without its prelude.
pub const SHADER: &str = concat!(
    include_str!("../sphere/harmonics.wgsl"),
    include_str!("../transport/compensated/centres/volume_pass.wgsl")
);

/// The volume pass of the route through centres, compiled.
pub struct CentrePass {
    interpolate: Kernel,
}

/// A [`CentreSource`] on the device.
pub struct DeviceCentres {
    count: usize,
    bands: usize,
    gaussians: wgpu::Buffer,
    weights: wgpu::Buffer,
    radiance: wgpu::Buffer,
    axes: wgpu::Buffer,
}

impl DeviceCentres {
    /// A copy of `source` for the nodes of `field`.
    pub fn new(gpu: &Gpu, source: &CentreSource, field: &DensityField) -> Result<Self, GpuError> {
        let points = &source.points;
        let gaussian = |h: usize| {
            let [x, y, z] = points.center_of(h);
            [x, y, z, points.radius[h]]
        };
        let gaussians: Vec<[f32; 4]> = (0..points.len()).map(gaussian).collect();
        // Where light is the same from everywhere, its mean is all there is.
        let (all, bands) = (source.radiance.order, if source.radiance.is_even() { 1 } else { source.radiance.order });
        let each = source.radiance.coefficients.chunks_exact(all * all).flat_map(|j| &j[..bands * bands]);
        let radiance: Vec<[f32; 4]> = each.map(|&[r, g, b]| [r, g, b, 0.0]).collect();
        let axes = source.axes(field.dims).concat();
        gpu.checked("Gaussians", || {
            Ok(Self {
                count: points.len(),
                bands,
                gaussians: gpu.upload("Gaussians", &gaussians)?,
                weights: gpu.upload("weights of the Gaussians", &points.weight[..points.len()])?,
                radiance: gpu.upload("source radiance of the Gaussians", &radiance)?,
                axes: gpu.upload("coordinates of the nodes", &axes)?,
            })
        })
    }
}

impl CentrePass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        Ok(Self { interpolate: Kernel::new(gpu, "volume pass of centres", source, "interpolate")? })
    }

    /// Shades `volume`, which was made of `field`, for an eye in unit space.
    /// `density` is the field's, one value a node.
    pub fn shade(
        &self,
        gpu: &Gpu,
        source: &DeviceCentres,
        (field, density): (&DensityField, &wgpu::Buffer),
        volume: &DeviceVolume,
        eye: DVec3,
    ) -> Result<(), GpuError> {
        let pages: Vec<usize> = (0..PAGES).filter(|&page| volume.page(page).1 > 0).collect();
        let uniforms = pages.iter().map(|&page| {
            let (first_brick, bricks) = volume.page(page);
            let uniform = Uniform {
                eye: eye.as_vec3().extend(0.0).to_array(),
                dims: wide(field.dims),
                bricks: wide(volume.table.bricks),
                first_brick: first_brick as u32,
                page_bricks: bricks as u32,
                count: source.count as u32,
                bands: source.bands as u32,
            };
            gpu.uniform("volume pass of centres", &uniform)
        });
        let uniforms: Vec<wgpu::Buffer> = uniforms.collect();
        let buffers: Vec<Vec<(u32, &wgpu::Buffer)>> = pages
            .iter()
            .zip(&uniforms)
            .map(|(&page, uniform)| {
                let of_source = [&source.gaussians, &source.weights, &source.radiance, &source.axes];
                let mut buffers = vec![(0, uniform), (1, &volume.table.dense_bricks)];
                buffers.extend((2..).zip(of_source));
                buffers.extend([(6, density), (7, &volume.pages[page])]);
                buffers
            })
            .collect();
        let steps: Vec<Step> = pages
            .iter()
            .zip(&buffers)
            .map(|(&page, buffers)| {
                // A group a brick.
                Step { kernel: &self.interpolate, buffers, threads: volume.page(page).1 as u32 * GROUP }
            })
            .collect();
        gpu.dispatch("volume pass of centres", &steps)
    }
}
