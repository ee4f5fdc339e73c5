//! Bricks of source radiance and density on the device.
//!
//! Where the bricks lie ([`DeviceBricks`]) follows from the frame alone, and is made ahead and shared; their nodes
//! ([`DeviceVolume`]) are written for each light and eye, and belong to who draws.
//!
//! Nodes are split into at most [`PAGES`] buffers, because a shader may see as little as 128 MiB of one: about 67,000
//! bricks a page, 17 million dense cells in all. A frame with more is refused by name.

use super::device::{Gpu, GpuError};
use crate::medium::field::DensityField;
use crate::shaded_volume::{BRICK_NODES, BrickTable, ShadedVolume};
use glam::{DAffine3, DVec3};
use std::sync::Arc;

/// Buffers that the nodes are spread over.
pub const PAGES: usize = 4;
/// Bytes of a brick.
const BRICK_BYTES: u64 = (BRICK_NODES * 16) as u64;

/// A [`BrickTable`] on the device, with the box of nodes that it is for.
pub struct DeviceBricks {
    /// Nodes along x, y, z.
    pub dims: [usize; 3],
    /// Bricks along x, y, z.
    pub bricks: [usize; 3],
    /// Bricks with density.
    pub dense: usize,
    /// Runs of them along x, see [`BrickTable::runs`].
    pub(crate) runs: Vec<([usize; 3], [usize; 3])>,
    /// Node to world space.
    pub world_from_node: DAffine3,
    /// Largest density.
    pub density_max: f32,
    /// `array<u32>`: the place of each brick of the box among the dense ones, or `u32::MAX`; x fastest.
    pub places: wgpu::Buffer,
    /// `array<u32>`: the brick of each place.
    pub dense_bricks: wgpu::Buffer,
}

/// A [`ShadedVolume`] on the device: what the view pass reads.
pub struct DeviceVolume {
    /// Where its bricks are.
    pub table: Arc<DeviceBricks>,
    /// Bricks of a full page.
    pub bricks_a_page: usize,
    /// [`PAGES`] buffers `array<vec4<f32>>`, 125 nodes a brick, x fastest: `[J red, J green, J blue, D]`.
    pub pages: Vec<wgpu::Buffer>,
}

/// Three counts as a uniform has them.
pub(super) fn wide(v: [usize; 3]) -> [u32; 4] {
    [v[0] as u32, v[1] as u32, v[2] as u32, 0]
}

/// An eye of the world in node space, and the columns of the map to the world scaled to at most 1, which give
/// directions alone, as uniforms have them.
pub(super) fn seen_from(eye: DVec3, field: &DensityField) -> [[f32; 4]; 4] {
    let linear = field.world_from_node.matrix3;
    let largest = linear.to_cols_array().into_iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let node_eye = field.world_from_node.inverse().transform_point3(eye);
    [node_eye, linear.x_axis / largest, linear.y_axis / largest, linear.z_axis / largest]
        .map(|v| v.as_vec3().extend(0.0).to_array())
}

impl DeviceBricks {
    /// The bricks of `field` that have density.
    pub fn of_field(gpu: &Gpu, field: &DensityField) -> Result<Self, GpuError> {
        Self::with_table(gpu, &BrickTable::of(field), field.dims, field.world_from_node, field.max())
    }

    fn with_table(
        gpu: &Gpu,
        table: &BrickTable,
        dims: [usize; 3],
        world_from_node: DAffine3,
        density_max: f32,
    ) -> Result<Self, GpuError> {
        gpu.checked("bricks", || {
            Ok(Self {
                dims,
                bricks: table.bricks,
                dense: table.dense.len(),
                runs: table.runs().collect(),
                world_from_node,
                density_max,
                places: gpu.upload("places of the bricks", &table.places)?,
                dense_bricks: gpu.upload("dense bricks", &table.dense)?,
            })
        })
    }
}

impl DeviceVolume {
    /// Room for the bricks of `table`, all nodes zero.
    pub fn new(gpu: &Gpu, table: Arc<DeviceBricks>) -> Result<Self, GpuError> {
        let limit = gpu.summary().storage_binding.min(gpu.summary().buffer);
        let bricks_a_page = ((limit / BRICK_BYTES) as usize).max(1);
        let dense = table.dense;
        if dense > PAGES * bricks_a_page {
            let needed = dense as u64 * BRICK_BYTES;
            return Err(GpuError::Limit { what: "nodes of the frame", needed, limit: PAGES as u64 * limit });
        }
        let page = |page: usize| {
            let bricks = dense.saturating_sub(page * bricks_a_page).min(bricks_a_page);
            gpu.storage("nodes of the frame", bricks as u64 * BRICK_BYTES)
        };
        let pages = gpu.checked("volume", || (0..PAGES).map(page).collect())?;
        Ok(Self { table, bricks_a_page, pages })
    }

    /// The same for the bricks of `field`.
    pub fn of_field(gpu: &Gpu, field: &DensityField) -> Result<Self, GpuError> {
        Self::new(gpu, Arc::new(DeviceBricks::of_field(gpu, field)?))
    }

    /// A copy of a volume that the processor has shaded.
    pub fn of_shaded(gpu: &Gpu, shaded: &ShadedVolume) -> Result<Self, GpuError> {
        let ShadedVolume { ref table, dims, world_from_node, density_max, .. } = *shaded;
        let table = DeviceBricks::with_table(gpu, table, dims, world_from_node, density_max)?;
        let out = Self::new(gpu, Arc::new(table))?;
        for (page, bricks) in out.pages.iter().zip(shaded.nodes.chunks(out.bricks_a_page)) {
            gpu.queue.write_buffer(page, 0, bytemuck::cast_slice(bricks.as_flattened()));
        }
        Ok(out)
    }

    /// Bricks of page `page`: the number of the first, and how many.
    pub fn page(&self, page: usize) -> (usize, usize) {
        let first = (page * self.bricks_a_page).min(self.table.dense);
        (first, (self.table.dense - first).min(self.bricks_a_page))
    }

    /// All nodes, brick after brick: for comparisons.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<[f32; 4]>, GpuError> {
        let mut out = Vec::new();
        for (number, page) in self.pages.iter().enumerate() {
            let count = self.page(number).1 * BRICK_NODES;
            let nodes: Vec<[f32; 4]> = if count > 0 { gpu.read("nodes of the frame", page, count)? } else { vec![] };
            out.extend(nodes);
        }
        Ok(out)
    }
}
