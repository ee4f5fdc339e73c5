//! Kernels, buffers, dispatch and reading back.
//!
//! A dispatch has at most 65,535 groups along an axis: more are folded into two axes, and the shader unfolds them
//! (`pass.wgsl`, which goes before the text of every kernel).

use super::device::{Gpu, GpuError, StageTimes};
use bytemuck::Pod;
use std::sync::{PoisonError, mpsc};

/// Invocations of a group, as in `pass.wgsl`.
pub const GROUP: u32 = 64;
/// Groups along one axis.
const MOST_GROUPS: u32 = 65_535;
/// Bytes of a buffer at least: a binding must hold one element of its array, even if the array is empty.
const LEAST_BYTES: u64 = 64;
/// Text that all kernels begin with.
pub const PRELUDE: &str = include_str!("pass.wgsl");

/// A compute pipeline.
pub struct Kernel {
    pipeline: wgpu::ComputePipeline,
    name: &'static str,
}

impl Kernel {
    /// The entry point `entry` of a shader without its prelude; `name` is told in errors. Binding numbers are the
    /// shader's own, all in group 0.
    pub fn new(gpu: &Gpu, name: &'static str, source: &str, entry: &str) -> Result<Self, GpuError> {
        gpu.checked(name, || {
            let text = format!("{PRELUDE}{source}");
            let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(name),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
            let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(name),
                layout: None,
                module: &module,
                entry_point: Some(entry),
                compilation_options: Default::default(),
                cache: None,
            });
            Ok(Self { pipeline, name })
        })
    }
}

/// A kernel with what it works on.
pub struct Step<'a> {
    /// Which kernel.
    pub kernel: &'a Kernel,
    /// Buffers by binding number.
    pub buffers: &'a [(u32, &'a wgpu::Buffer)],
    /// Invocations that have work.
    pub threads: u32,
}

/// Groups along x and y that hold `threads` invocations.
fn groups(threads: u32) -> [u32; 2] {
    let groups = threads.div_ceil(GROUP).max(1);
    let across = groups.min(MOST_GROUPS);
    [across, groups.div_ceil(across)]
}

impl Gpu {
    /// A buffer that holds `values`, never of none; refused if a shader could not see all of it.
    pub fn upload<T: Pod>(&self, what: &'static str, values: &[T]) -> Result<wgpu::Buffer, GpuError> {
        let bytes: &[u8] = bytemuck::cast_slice(values);
        let buffer = self.storage(what, bytes.len() as u64)?;
        self.queue.write_buffer(&buffer, 0, bytes);
        Ok(buffer)
    }

    /// A storage buffer of zeros, never of none; refused if a shader could not see all of it.
    pub fn storage(&self, what: &'static str, bytes: u64) -> Result<wgpu::Buffer, GpuError> {
        let limit = self.summary().storage_binding.min(self.summary().buffer);
        if bytes > limit {
            return Err(GpuError::Limit { what, needed: bytes, limit });
        }
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC;
        Ok(self.buffer(what, bytes, usage))
    }

    /// A uniform buffer that holds `value`.
    pub fn uniform<T: Pod>(&self, what: &'static str, value: &T) -> wgpu::Buffer {
        let bytes = bytemuck::bytes_of(value);
        let usage = wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST;
        let buffer = self.buffer(what, bytes.len() as u64, usage);
        self.queue.write_buffer(&buffer, 0, bytes);
        buffer
    }

    fn buffer(&self, label: &'static str, bytes: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let size = bytes.max(LEAST_BYTES).next_multiple_of(4);
        self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage,
            mapped_at_creation: false,
        })
    }

    /// Does the steps in order, as one submission, and waits. What they took goes to [`Self::take_times`], where the
    /// device can tell.
    pub fn dispatch(&self, stage: &'static str, steps: &[Step]) -> Result<(), GpuError> {
        self.checked(stage, || {
            let clock = self.summary().timestamps.then(|| {
                let descriptor =
                    wgpu::QuerySetDescriptor { label: Some(stage), ty: wgpu::QueryType::Timestamp, count: 2 };
                self.device.create_query_set(&descriptor)
            });
            let mut encoder = self.device.create_command_encoder(&Default::default());
            for (number, step) in steps.iter().enumerate() {
                let entries: Vec<wgpu::BindGroupEntry> = step
                    .buffers
                    .iter()
                    .map(|(binding, buffer)| wgpu::BindGroupEntry {
                        binding: *binding,
                        resource: buffer.as_entire_binding(),
                    })
                    .collect();
                let group = self.device.create_bind_group(&wgpu::BindGroupDescriptor {
                    label: Some(step.kernel.name),
                    layout: &step.kernel.pipeline.get_bind_group_layout(0),
                    entries: &entries,
                });
                let timestamp_writes = clock.as_ref().map(|query_set| wgpu::ComputePassTimestampWrites {
                    query_set,
                    beginning_of_pass_write_index: (number == 0).then_some(0),
                    end_of_pass_write_index: (number + 1 == steps.len()).then_some(1),
                });
                // A pass in the middle writes no timestamp, and may then have no set.
                let ends = number == 0 || number + 1 == steps.len();
                let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
                    label: Some(step.kernel.name),
                    timestamp_writes: timestamp_writes.filter(|_| ends),
                });
                pass.set_pipeline(&step.kernel.pipeline);
                pass.set_bind_group(0, &group, &[]);
                let [across, down] = groups(step.threads);
                pass.dispatch_workgroups(across, down, 1);
            }
            let times = clock.filter(|_| !steps.is_empty()).map(|clock| {
                let usage = wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC;
                let times = self.buffer("timestamps", 16, usage);
                encoder.resolve_query_set(&clock, 0..2, &times, 0);
                times
            });
            self.queue.submit([encoder.finish()]);
            self.wait(stage)?;
            let Some(times) = times else { return Ok(()) };
            let ticks: Vec<u64> = self.copy_back(stage, &times, 16)?;
            let period = f64::from(self.queue.get_timestamp_period());
            if let Some(ticks) = ticks[1].checked_sub(ticks[0]) {
                let took = ticks as f64 * period * 1e-3;
                let mut times = self.times.lock().unwrap_or_else(PoisonError::into_inner);
                match times.iter_mut().find(|(name, _)| *name == stage) {
                    Some((_, sum)) => *sum += took,
                    None => times.push((stage, took)),
                }
            }
            Ok(())
        })
    }

    /// What was dispatched since the last call took; nothing where the device cannot tell.
    pub fn take_times(&self) -> StageTimes {
        std::mem::take(&mut *self.times.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The first `count` values of a storage buffer.
    pub fn read<T: Pod>(&self, stage: &'static str, buffer: &wgpu::Buffer, count: usize) -> Result<Vec<T>, GpuError> {
        self.checked(stage, || self.copy_back(stage, buffer, (count * size_of::<T>()) as u64))
    }

    fn copy_back<T: Pod>(&self, stage: &'static str, buffer: &wgpu::Buffer, bytes: u64) -> Result<Vec<T>, GpuError> {
        let failed = |reason: String| GpuError::Failed { stage, reason };
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let staging = self.buffer("read back", bytes, usage);
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
        self.queue.submit([encoder.finish()]);
        let (send, receive) = mpsc::channel();
        staging.map_async(wgpu::MapMode::Read, .., move |result| {
            // Nobody waits any more if the wait below has failed.
            let _ = send.send(result);
        });
        self.wait(stage)?;
        receive.recv().map_err(|e| failed(e.to_string()))?.map_err(|e| failed(e.to_string()))?;
        let view = staging.get_mapped_range(..).map_err(|e| failed(e.to_string()))?;
        let mut values = vec![T::zeroed(); bytes as usize / size_of::<T>()];
        let into: &mut [u8] = bytemuck::cast_slice_mut(&mut values);
        into.copy_from_slice(&view[..into.len()]);
        Ok(values)
    }

    fn wait(&self, stage: &'static str) -> Result<(), GpuError> {
        let failed = |e: wgpu::PollError| GpuError::Failed { stage, reason: e.to_string() };
        self.device.poll(wgpu::PollType::wait_indefinitely()).map(|_| ()).map_err(failed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_groups_than_an_axis_holds_are_folded_and_all_are_there() {
        assert_eq!(groups(0), [1, 1]);
        assert_eq!(groups(GROUP * MOST_GROUPS), [MOST_GROUPS, 1]);
        for threads in [GROUP * MOST_GROUPS + 1, 1 << 24, u32::MAX - GROUP] {
            let [across, down] = groups(threads);
            assert!(across <= MOST_GROUPS && down <= MOST_GROUPS);
            assert!(u64::from(across) * u64::from(down) * u64::from(GROUP) >= u64::from(threads));
        }
    }
}
