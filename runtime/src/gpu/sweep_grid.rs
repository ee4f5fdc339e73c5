//! A frame's grid on the device, and the ways of light through it in batches.
//!
//! The twin of [`crate::transport::compensated::grid::columns`]. Where rays lie on a slice is computed here, in f64,
//! and uploaded: 16 bytes a direction and slice. What the rays of a batch carry is held for all slices, up to
//! [`MOST_BYTES`]: about one value a node, direction and quantity.

use super::device::{Gpu, GpuError};
use super::layouts::{Path as DevicePath, Shift};
use crate::medium::field::DensityField;
use crate::transport::compensated::grid::columns::{Path, near_density, turn};
use glam::{DMat3, Vec3};

/// Bytes of what rays carry at a time.
const MOST_BYTES: u64 = 256 << 20;

/// A [`SweepGrid`](crate::transport::compensated::grid::columns::SweepGrid) on the device.
pub struct DeviceSweepGrid {
    /// Nodes along x, y, z.
    pub dims: [usize; 3],
    /// Nodes near density, x fastest: all that source radiance is solved for.
    pub near: Vec<u32>,
    node_from_world: DMat3,
    /// Density x fastest, then y fastest, then z, then x.
    pub(super) density: wgpu::Buffer,
    pub(super) near_buffer: wgpu::Buffer,
}

/// Directions that are swept together.
pub(super) struct Batch {
    /// Number of the first, and how many.
    pub(super) first: usize,
    pub(super) count: usize,
    pub(super) paths: wgpu::Buffer,
    pub(super) shifts: wgpu::Buffer,
    /// Rays of the widest.
    pub(super) most_rays: usize,
}

/// All directions of a stage.
pub(super) struct Batches {
    pub(super) batches: Vec<Batch>,
    /// Rays that pass the slices of a direction: values of each quantity.
    pub(super) stride: usize,
    /// What the rays of a batch carry.
    pub(super) carried: wgpu::Buffer,
    /// Directions of the largest batch.
    pub(super) most: usize,
}

impl DeviceSweepGrid {
    /// Of a field, coarsened to the spacing of the nodes.
    pub fn new(gpu: &Gpu, field: &DensityField) -> Result<Self, GpuError> {
        let near = near_density(field);
        let near: Vec<u32> = (0u32..).zip(near).filter(|(_, near)| *near).map(|(v, _)| v).collect();
        let layouts = [field.values.clone(), turn(&field.values, field.dims)].concat();
        gpu.checked("grid", || {
            Ok(Self {
                dims: field.dims,
                node_from_world: field.world_from_node.matrix3.inverse(),
                density: gpu.upload("density of the grid", &layouts)?,
                near_buffer: gpu.upload("nodes near density", &near)?,
                near,
            })
        })
    }

    /// The number of nodes.
    pub fn nodes(&self) -> usize {
        self.dims.iter().product()
    }

    pub(super) fn dims(&self) -> [u32; 4] {
        [self.dims[0] as u32, self.dims[1] as u32, self.dims[2] as u32, 0]
    }

    /// The ways of light from `toward`, whose rays carry some quantities; in as few batches as there is room for.
    pub(super) fn batches(&self, gpu: &Gpu, toward: &[Vec3], quantities: usize) -> Result<Batches, GpuError> {
        let paths: Vec<Path> = toward.iter().map(|t| Path::new(self.dims, self.node_from_world, *t)).collect();
        let passing = |p: &Path| (p.slices.columns + 1) * (p.slices.rows + 1) * p.slices.count;
        let stride = paths.iter().map(passing).max().unwrap_or(0);
        let bytes = 4 * (quantities * stride) as u64;
        let room = gpu.most_bytes().min(MOST_BYTES) / bytes.max(1);
        // Threads are numbered in 32 bits: at most 2^24 rays or nodes a direction, times 128.
        let most = (room as usize).clamp(1, paths.len().clamp(1, 128));
        let carried = gpu.storage("rays through the grid", bytes * most as u64)?;
        let batch = |(number, paths): (usize, &[Path])| {
            let mut shifts = Vec::new();
            let mut described = Vec::with_capacity(paths.len());
            for path in paths {
                described.push(self.described(path, shifts.len()));
                shifts.extend((0..path.slices.count).map(|step| {
                    let shift = path.shift(step);
                    Shift { base: shift.base.map(|b| b as u32), fraction: shift.fraction }
                }));
            }
            let most_rays = paths.iter().map(|p| p.extent[0] * p.extent[1]).max().unwrap_or(1);
            let (paths_buffer, shifts) = (gpu.upload("directions", &described)?, gpu.upload("shifts", &shifts)?);
            Ok(Batch { first: number * most, count: paths.len(), paths: paths_buffer, shifts, most_rays })
        };
        let batches = paths.chunks(most).enumerate().map(batch).collect::<Result<_, GpuError>>()?;
        Ok(Batches { batches, stride, carried, most })
    }

    fn described(&self, path: &Path, first_shift: usize) -> DevicePath {
        let slices = &path.slices;
        DevicePath {
            columns: slices.columns as u32,
            rows: slices.rows as u32,
            slices: slices.count as u32,
            axis: (path.group() / 2) as u32,
            extent_columns: path.extent[0] as u32,
            extent_rows: path.extent[1] as u32,
            reversed: path.reversed.into(),
            length: path.length,
            slice_stride: slices.slice_stride as u32,
            row_stride: slices.row_stride as u32,
            density_start: if slices.turned { self.nodes() as u32 } else { 0 },
            first_shift: first_shift as u32,
        }
    }
}

/// A table of factors `[direction][coefficient * channels + channel]` as the shaders read it, `[direction][channel]`
/// and coefficients in vectors of four, padded to 16; and how many vectors.
pub(super) fn quads<'a>(rows: impl Iterator<Item = &'a [f32]>, channels: usize) -> (Vec<f32>, usize) {
    let (mut out, mut padded) = (Vec::new(), 16);
    for row in rows {
        padded = (row.len() / channels).next_multiple_of(16);
        for channel in 0..channels {
            let start = out.len();
            out.extend(row.iter().skip(channel).step_by(channels));
            out.resize(start + padded, 0.0);
        }
    }
    (out, padded / 4)
}
