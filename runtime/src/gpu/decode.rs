//! The host's side of decoding, `medium/gaussian_sum.wgsl` and `medium/decoder.wgsl`: a frame's density on the device.
//!
//! Gaussians are placed in the box here, in f64; the residual is uploaded as it lies in memory after it was read from a
//! pack, and looked up there. Cost: each brick of 8^3 voxels looks at every Gaussian once, and sums those that reach
//! it.
//!
//! What differs from the processor: a place in radii is rounded twice instead of once, and products and sums may be
//! fused. A density is off by a few 2^-24 of each of the Gaussians that reach it, and by `exp(-9)` of a weight, 1.2e-4,
//! where a voxel lies within 2^-22 of the border of a support and is found on its other side.

use super::device::{Gpu, GpuError};
use super::layouts::{Decoder as DecoderUniform, GaussianSum as SumUniform};
use super::pass::{GROUP, Kernel, Step};
use crate::medium::gaussian_sum::SUPPORT_RADII;
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::pack::FrameResidual;
use smoke_formats::residual::Residual;
use smoke_formats::residual::brick::bricks_of;

/// The shader of the sum, without its prelude.
pub const GAUSSIAN_SUM: &str = include_str!("../medium/gaussian_sum.wgsl");
/// The shader of the residual.
pub const DECODER: &str = include_str!("../medium/decoder.wgsl");

/// The decoder's shaders, compiled.
pub struct DecodePass {
    sum: Kernel,
    decode: Kernel,
}

/// A frame as a pack holds it.
#[derive(Clone, Copy)]
pub struct Coded<'a> {
    /// In unit space; finite, radii positive, as a pack guarantees.
    pub gaussians: &'a [Gaussian],
    /// Index to unit space.
    pub unit: &'a UnitSpace,
    /// Index coordinates of the first voxel of the frame's box.
    pub origin: [i32; 3],
    /// Voxels of the box along x, y, z.
    pub dims: [u32; 3],
    /// The residual of this box; without it, density is the Gaussians' sum down to half a step.
    pub residual: Option<&'a FrameResidual>,
    /// Density of a code of 1.
    pub step: f32,
}

/// Two vectors for each Gaussian that reaches the box, in their order; see `gaussian_sum.wgsl`.
fn placed(frame: &Coded) -> Vec<[u32; 4]> {
    let mut out = Vec::with_capacity(2 * frame.gaussians.len());
    for g in frame.gaussians {
        let radius = f64::from(g.radius) / frame.unit.scale;
        let at = [0, 1, 2]
            .map(|a| (f64::from(g.center[a]) - frame.unit.offset[a]) / frame.unit.scale - f64::from(frame.origin[a]));
        let reach = f64::from(SUPPORT_RADII) * radius;
        let meets = |a: usize| at[a] + reach >= 0.0 && at[a] - reach <= f64::from(frame.dims[a]);
        if !(0..3).all(meets) {
            continue;
        }
        // A centre that is too far for an i32 has a radius beside which the box is a point.
        let nearest = at.map(|v| v.round().clamp(-1e9, 1e9));
        let rest = [0, 1, 2].map(|a| ((at[a] - nearest[a]) as f32).to_bits());
        let [x, y, z] = nearest.map(|v| v as i32 as u32);
        out.push([x, y, z, g.weight.to_bits()]);
        out.push([rest[0], rest[1], rest[2], ((1.0 / radius) as f32).to_bits()]);
    }
    out
}

impl DecodePass {
    /// Compiles the shaders.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_sources(gpu, [GAUSSIAN_SUM, DECODER])
    }

    /// From other texts of the same bindings: how a planted difference is shown to be found.
    pub fn from_sources(gpu: &Gpu, [sum, decoder]: [&str; 2]) -> Result<Self, GpuError> {
        let sum = Kernel::new(gpu, "Gaussian sum", sum, "sum_gaussians")?;
        Ok(Self { sum, decode: Kernel::new(gpu, "decoder", decoder, "decode")? })
    }

    /// The sum of the Gaussians at the nodes of the frame's field, which has a border of one empty node, x fastest.
    pub fn sum(&self, gpu: &Gpu, frame: &Coded) -> Result<wgpu::Buffer, GpuError> {
        self.run(gpu, frame, false)
    }

    /// The density at the nodes of the frame's field, as [`crate::medium::field::DensityField::values`] has it.
    pub fn density(&self, gpu: &Gpu, frame: &Coded) -> Result<wgpu::Buffer, GpuError> {
        self.run(gpu, frame, true)
    }

    fn run(&self, gpu: &Gpu, frame: &Coded, decodes: bool) -> Result<wgpu::Buffer, GpuError> {
        let gaussians = placed(frame);
        let wide = |v: [u32; 3]| [v[0], v[1], v[2], 0];
        let (dims, bricks) = (wide(frame.dims), wide(bricks_of(frame.dims)));
        let product = |v: [u32; 4]| v[..3].iter().map(|&n| u64::from(n)).product::<u64>();
        let (kind, number, bytes): (u32, usize, &[u8]) = match frame.residual {
            None => (0, 0, &[]),
            Some(FrameResidual { residual, frame }) => {
                let kind = if matches!(**residual, Residual::Rank(_)) { 1 } else { 2 };
                (kind, *frame, residual.bytes())
            }
        };
        let nodes = frame.dims.iter().map(|&n| u64::from(n) + 2).product::<u64>();
        let density = gpu.storage("density of the frame", 4 * nodes)?;
        let gaussians_there = gpu.upload("Gaussians", &gaussians)?;
        let residual = gpu.upload("residual of the frame", bytes)?;
        let count = (gaussians.len() / 2) as u32;
        let sum = gpu.uniform("Gaussian sum", &SumUniform { dims, bricks, count, ..SumUniform::default() });
        let decoder = DecoderUniform { dims, bricks, step: frame.step, kind, frame: number as u32, pad: 0 };
        let decoder = gpu.uniform("decoder", &decoder);
        let sums = [(0, &sum), (1, &gaussians_there), (2, &density)];
        let codes = [(0, &decoder), (1, &residual), (2, &density)];
        // A group for each brick; a buffer of as many nodes has been found to fit, so that both are u32.
        let mut steps = vec![Step { kernel: &self.sum, buffers: &sums, threads: product(bricks) as u32 * GROUP }];
        if decodes {
            steps.push(Step { kernel: &self.decode, buffers: &codes, threads: product(dims) as u32 });
        }
        gpu.dispatch("decoding", &steps)?;
        Ok(density)
    }
}
