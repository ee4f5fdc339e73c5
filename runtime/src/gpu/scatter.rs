//! The host's side of the gather, `transport/compensated/grid/scatter.wgsl`.
//!
//! Planes hold the nodes near density alone: nothing else is read with weight, so vectors are as small as they can be.
//! What differs from the processor is the order of sums over ordinates, and rounding where sums are fused. Cost: of a
//! node and ordinate one visit for each coefficient, twice, and one of a ray.

use super::device::{Gpu, GpuError};
use super::layouts::Scatter;
use super::pass::Kernel;
use super::planes::Planes;
use super::sweep_grid::{Batch, Batches, DeviceSweepGrid, quads};
use super::transfer::{Work, dispatch};
use crate::transport::compensated::grid::scatter::Ordinate;
use glam::Vec3;

/// The shader, without its prelude.
pub const SHADER: &str = concat!(
    include_str!("../lanes.wgsl"),
    include_str!("../transport/compensated/grid/columns.wgsl"),
    include_str!("../transport/compensated/grid/scatter.wgsl")
);

/// The gather, compiled.
pub struct ScatterPass {
    look: Kernel,
    carry: Kernel,
    project: Kernel,
    spread: Kernel,
}

/// The gather along some ordinates of a grid.
pub struct Gather<'a> {
    pass: &'a ScatterPass,
    grid: &'a DeviceSweepGrid,
    sigma_t: Vec<f32>,
    batches: Batches,
    /// Harmonics of the ordinates, and these times weight and gain.
    harmonics: wgpu::Buffer,
    factors: wgpu::Buffer,
    coefficients: usize,
    quads: usize,
    /// Source radiance along the ordinates of a batch.
    along: wgpu::Buffer,
}

impl ScatterPass {
    /// Compiles the shader.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_source(gpu, SHADER)
    }

    /// From another text of the same bindings: how a planted difference is shown to be found.
    pub fn from_source(gpu: &Gpu, source: &str) -> Result<Self, GpuError> {
        let kernel = |entry| Kernel::new(gpu, "multiple scattering", source, entry);
        Ok(Self {
            look: kernel("look")?,
            carry: kernel("carry")?,
            project: kernel("project")?,
            spread: kernel("spread")?,
        })
    }

    /// The gather along `ordinates`, times `gain(plane)`; `sigma_t` is extinction per unit density and world length,
    /// one for each channel.
    pub fn gather<'a>(
        &'a self,
        gpu: &Gpu,
        grid: &'a DeviceSweepGrid,
        ordinates: &[Ordinate],
        sigma_t: &[f32],
        gain: impl Fn(usize) -> f32,
    ) -> Result<Gather<'a>, GpuError> {
        let channels = sigma_t.len();
        let toward: Vec<Vec3> = ordinates.iter().map(|o| o.toward).collect();
        let batches = grid.batches(gpu, &toward, 3)?;
        let coefficients = ordinates.first().map_or(0, |o| o.harmonics.len());
        let table = |factor: &dyn Fn(&Ordinate, usize) -> f32| {
            let row = |o: &Ordinate| -> Vec<f32> {
                (0..coefficients * channels).map(|plane| o.harmonics[plane / channels] * factor(o, plane)).collect()
            };
            let rows: Vec<Vec<f32>> = ordinates.iter().map(row).collect();
            quads(rows.iter().map(|row| &row[..]), channels)
        };
        let (harmonics, quads) = table(&|_, _| 1.0);
        let (factors, _) = table(&|ordinate, plane| ordinate.weight * gain(plane));
        Ok(Gather {
            pass: self,
            grid,
            sigma_t: sigma_t.to_vec(),
            harmonics: gpu.upload("ordinates", &harmonics)?,
            factors: gpu.upload("ordinates", &factors)?,
            coefficients,
            quads,
            along: gpu.storage("source radiance along ordinates", (4 * batches.most * grid.nodes()) as u64)?,
            batches,
        })
    }

    /// Planes of the nodes near density to planes of all nodes.
    pub(super) fn spread<'a>(
        &'a self,
        gpu: &Gpu,
        grid: &'a DeviceSweepGrid,
        from: &'a Planes,
        to: &'a Planes,
    ) -> Vec<Work<'a>> {
        let mut work = Vec::new();
        for part in &from.parts {
            for plane in part.first..part.first + part.count {
                let Some(into) = to.parts.iter().find(|to| (to.first..to.first + to.count).contains(&plane)) else {
                    continue;
                };
                let uniform = Scatter {
                    near: grid.near.len() as u32,
                    first_plane: (plane - part.first) as u32,
                    target_start: ((plane - into.first) * to.stride) as u32,
                    ..Scatter::default()
                };
                work.push(Work {
                    kernel: &self.spread,
                    uniform: gpu.uniform("multiple scattering", &uniform),
                    buffers: vec![(4, &grid.near_buffer), (6, &into.buffer), (8, &part.buffer)],
                    threads: grid.near.len(),
                });
            }
        }
        work
    }
}

impl Gather<'_> {
    /// Adds to `out` what `source` sends to every node, times the gain; both are planes
    /// `[coefficient * channels + channel]` of the nodes near density.
    pub(super) fn add<'b>(&'b self, gpu: &Gpu, source: &'b Planes, out: &'b Planes) -> Vec<Work<'b>> {
        let mut work = Vec::new();
        if self.grid.near.is_empty() {
            return work;
        }
        for channel in 0..self.sigma_t.len() {
            for batch in &self.batches.batches {
                self.add_batch(gpu, (channel, batch), source, out, &mut work);
            }
        }
        work
    }

    /// [`Self::add`] at once.
    pub fn add_now(&self, gpu: &Gpu, source: &Planes, out: &Planes) -> Result<(), GpuError> {
        dispatch(gpu, "multiple scattering", &self.add(gpu, source, out))
    }

    fn add_batch<'b>(
        &'b self,
        gpu: &Gpu,
        (channel, batch): (usize, &'b Batch),
        source: &'b Planes,
        out: &'b Planes,
        work: &mut Vec<Work<'b>>,
    ) {
        let (grid, channels) = (self.grid, self.sigma_t.len());
        let base = Scatter {
            dims: grid.dims(),
            directions: batch.count as u32,
            first_direction: batch.first as u32,
            most_rays: batch.most_rays as u32,
            carried_stride: self.batches.stride as u32,
            near: grid.near.len() as u32,
            nodes: grid.nodes() as u32,
            channel: channel as u32,
            channels: channels as u32,
            sigma_t: self.sigma_t[channel],
            coefficients: self.coefficients as u32,
            quads: self.quads as u32,
            ..Scatter::default()
        };
        let uniform = |uniform: &Scatter| gpu.uniform("multiple scattering", uniform);
        let (paths, shifts) = ((1, &batch.paths), (2, &batch.shifts));
        let (near, along, carried) = ((4, &grid.near_buffer), (6, &self.along), (7, &self.batches.carried));
        for (number, part) in source.parts.iter().enumerate() {
            let (first_plane, planes) = (part.first as u32, part.count as u32);
            work.push(Work {
                kernel: &self.pass.look,
                uniform: uniform(&Scatter { first_plane, planes, starts: (number == 0).into(), ..base }),
                buffers: vec![paths, near, (5, &self.harmonics), along, (8, &part.buffer)],
                threads: batch.count * grid.near.len(),
            });
        }
        work.push(Work {
            kernel: &self.pass.carry,
            uniform: uniform(&base),
            buffers: vec![paths, shifts, (3, &grid.density), along, carried],
            threads: batch.count * batch.most_rays,
        });
        for part in &out.parts {
            for run in part.runs(channels) {
                let (first_plane, planes) = (part.first as u32, part.count as u32);
                work.push(Work {
                    kernel: &self.pass.project,
                    uniform: uniform(&Scatter { first_plane, planes, first_coefficient: run as u32, ..base }),
                    buffers: vec![paths, shifts, near, (5, &self.factors), carried, (8, &part.buffer)],
                    threads: grid.near.len(),
                });
            }
        }
    }
}
