//! The host's side of single scattering, `transport/compensated/grid/single.wgsl`.
//!
//! Beams are swept in batches, and each batch is added to all planes before the next; one submission a batch. What
//! differs from the processor is rounding where sums are fused. Cost: a visit a ray and slice for each beam, then four
//! reads a node, beam and run of 16 coefficients of a channel.

use super::device::{Gpu, GpuError};
use super::layouts::Single;
use super::pass::Kernel;
use super::planes::Planes;
use super::sweep_grid::{DeviceSweepGrid, quads};
use super::transfer::{Work, dispatch};
use crate::transport::compensated::grid::single::WeightedBeam;
use glam::Vec3;

/// The shader, without its prelude.
pub const SHADER: &str = concat!(
    include_str!("../lanes.wgsl"),
    include_str!("../transport/compensated/grid/columns.wgsl"),
    include_str!("../transport/compensated/grid/single.wgsl")
);

/// Single scattering, compiled.
pub struct SinglePass {
    carry: Kernel,
    light: Kernel,
}

impl SinglePass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        let kernel = |entry| Kernel::new(gpu, "single scattering", source, entry);
        Ok(Self { carry: kernel("carry")?, light: kernel("light")? })
    }

    /// Source radiance of all beams, planes `[coefficient * channels + channel]`; of no beams, a plane a channel.
    /// Planes hold all nodes, zero far from density, or where `compact` those near density alone. `sigma_t` is
    /// extinction per unit density and world length, one for each channel.
    pub fn source_radiance(
        &self,
        gpu: &Gpu,
        grid: &DeviceSweepGrid,
        beams: &[WeightedBeam],
        sigma_t: &[f32],
        compact: bool,
    ) -> Result<Planes, GpuError> {
        let channels = sigma_t.len();
        let count = beams.first().map_or(channels, |beam| beam.weights.len());
        let stride = if compact { grid.near.len() } else { grid.nodes() };
        let planes = Planes::new(gpu, "planes of source radiance", count, stride)?;
        if grid.near.is_empty() {
            return Ok(planes);
        }
        let toward: Vec<Vec3> = beams.iter().map(|beam| beam.beam.toward).collect();
        let batches = grid.batches(gpu, &toward, 1)?;
        let (weights, quads) = quads(beams.iter().map(|beam| &beam.weights[..]), channels);
        let weights = gpu.upload("weights of the beams", &weights)?;
        for (number, batch) in batches.batches.iter().enumerate() {
            let base = Single {
                dims: grid.dims(),
                directions: batch.count as u32,
                first_direction: batch.first as u32,
                most_rays: batch.most_rays as u32,
                carried_stride: batches.stride as u32,
                near: grid.near.len() as u32,
                channels: channels as u32,
                quads: quads as u32,
                plane_stride: stride as u32,
                compact: compact.into(),
                starts: (number == 0).into(),
                ..Single::default()
            };
            let ways = [(1, &batch.paths), (2, &batch.shifts)];
            let mut work = vec![Work {
                kernel: &self.carry,
                uniform: gpu.uniform("single scattering", &base),
                buffers: [&ways[..], &[(3, &grid.density), (6, &batches.carried)]].concat(),
                threads: batch.count * batch.most_rays,
            }];
            for (channel, &sigma_t) in sigma_t.iter().enumerate() {
                for part in &planes.parts {
                    for first_coefficient in part.runs(channels) {
                        let uniform = Single {
                            channel: channel as u32,
                            sigma_t,
                            first_coefficient: first_coefficient as u32,
                            first_plane: part.first as u32,
                            planes: part.count as u32,
                            ..base
                        };
                        let own = [(4, &grid.near_buffer), (5, &weights), (6, &batches.carried), (7, &part.buffer)];
                        work.push(Work {
                            kernel: &self.light,
                            uniform: gpu.uniform("single scattering", &uniform),
                            buffers: [&ways[..], &own].concat(),
                            threads: grid.near.len(),
                        });
                    }
                }
            }
            dispatch(gpu, "single scattering", &work)?;
        }
        Ok(planes)
    }
}
