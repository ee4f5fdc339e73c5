//! Planes of values on the device: coefficients of source radiance, and the vectors of GMRES that are made of them.
//!
//! All values of a plane lie together, x fastest, and as many planes in a buffer as a shader may see of one.

use super::device::{Gpu, GpuError};

/// Planes, some to a buffer.
pub struct Planes {
    /// Values of a plane.
    pub stride: usize,
    pub(super) parts: Vec<Part>,
}

/// Planes that share a buffer.
pub(super) struct Part {
    /// Number of the first.
    pub(super) first: usize,
    /// How many.
    pub(super) count: usize,
    pub(super) buffer: wgpu::Buffer,
}

impl Planes {
    /// `count` planes of zeros; refused under the name `what` if a shader could not see all of one.
    pub fn new(gpu: &Gpu, what: &'static str, count: usize, stride: usize) -> Result<Self, GpuError> {
        let bytes = 4 * stride as u64;
        let most = ((gpu.most_bytes() / bytes.max(1)) as usize).clamp(1, count.max(1));
        let part = |first: usize| {
            let count = most.min(count - first);
            Ok(Part { first, count, buffer: gpu.storage(what, bytes * count as u64)? })
        };
        let parts = (0..count).step_by(most).map(part).collect::<Result<_, GpuError>>()?;
        Ok(Self { stride, parts })
    }

    /// A copy of `planes` of `stride` values each.
    pub fn upload(gpu: &Gpu, what: &'static str, planes: &[Vec<f32>], stride: usize) -> Result<Self, GpuError> {
        let out = Self::new(gpu, what, planes.len(), stride)?;
        for part in &out.parts {
            let planes = planes[part.first..][..part.count].concat();
            gpu.queue.write_buffer(&part.buffer, 0, bytemuck::cast_slice(&planes));
        }
        Ok(out)
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.parts.iter().map(|part| part.count).sum()
    }

    /// All of them: for comparisons.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<Vec<f32>>, GpuError> {
        let mut out = Vec::new();
        for part in &self.parts {
            let values: Vec<f32> = gpu.read("planes", &part.buffer, part.count * self.stride)?;
            out.extend(values.chunks(self.stride.max(1)).map(<[f32]>::to_vec));
        }
        Ok(out)
    }
}

impl Part {
    /// For each run of up to 16 coefficients of a channel that the part holds one of: the first.
    pub(super) fn runs(&self, channels: usize) -> impl Iterator<Item = usize> {
        let last = (self.first + self.count - 1) / channels;
        (self.first / channels / 16 * 16..=last).step_by(16)
    }
}

impl Gpu {
    /// Bytes that a buffer which a shader reads may have.
    pub(super) fn most_bytes(&self) -> u64 {
        self.summary().storage_binding.min(self.summary().buffer)
    }
}
