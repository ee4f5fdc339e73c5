//! What a frame's transfer is on the device, whatever light and view: clusters, and how the rows of nodes and cells are
//! mixed of them.
//!
//! It follows from the frame alone and is only read, so it is made ahead and shared. Cost: a few operations a node to
//! find the rows, and the bytes of clusters and mixes.

use super::device::{Gpu, GpuError};
use super::renderer::GpuRenderError;
use crate::medium::field::DensityField;
use crate::renderer::RenderError;
use crate::shaded_volume::EMPTY;
use crate::transport::transfer::frame::{Clustered, FrameTransfer};
use crate::transport::transfer::source::rows_of;

/// Clustered rows on the device, and the colour channels that they are for.
pub(super) struct DeviceClusters {
    pub(super) channels: [f32; 4],
    /// Means and directions of all clusters.
    pub(super) vectors: usize,
    pub(super) terms: usize,
    pub(super) length: usize,
    pub(super) bases: wgpu::Buffer,
    /// The first row, how many, and `array<u32>`: for each its cluster, then the bits of its weights.
    pub(super) mixes: Vec<(usize, usize, wgpu::Buffer)>,
}

/// See the module's head.
pub struct DeviceRows {
    pub(super) g: f32,
    pub(super) bands: usize,
    pub(super) cells: [usize; 3],
    pub(super) side: usize,
    /// Cells with density.
    pub(super) lit_cells: usize,
    /// Directions of the mesh with their solid angles, and how many.
    pub(super) mesh: (wgpu::Buffer, usize),
    pub(super) direct: Vec<DeviceClusters>,
    pub(super) indirect: Vec<DeviceClusters>,
    /// The row of each node of the field.
    pub(super) lit_rows: wgpu::Buffer,
    /// The place of each cell among those with density, and which cell each place is.
    pub(super) cell_places: wgpu::Buffer,
    pub(super) cell_numbers: wgpu::Buffer,
}

impl DeviceRows {
    /// A copy of `transfer`; refused if it is none of the density `field`, or too large for the device.
    pub fn new(gpu: &Gpu, field: &DensityField, transfer: &FrameTransfer) -> Result<Self, GpuRenderError> {
        let (nodes, cells) = rows_of(field, transfer).map_err(RenderError::Transfer)?;
        let mut lit_rows = vec![EMPTY; field.values.len()];
        nodes.iter().zip(0..).for_each(|(&node, row)| lit_rows[node as usize] = row);
        let mesh = transfer.basis.mesh().directions().iter().zip(transfer.basis.areas());
        let mesh: Vec<[f32; 4]> = mesh.map(|(d, &area)| d.as_vec3().extend(area as f32).to_array()).collect();
        let limit = (gpu.summary().storage_binding.min(gpu.summary().buffer)) as usize;
        let rows = gpu.checked("transfer", || {
            let sets = |sets: &[Clustered], of_channel: [usize; 3]| {
                let used = sets.iter().enumerate().filter(|(s, set)| set.length > 0 && of_channel.contains(s));
                used.map(|(s, set)| DeviceClusters::new(gpu, set, of_channel.map(|of| of == s), limit))
                    .collect::<Result<Vec<_>, GpuError>>()
            };
            Ok(Self {
                g: transfer.medium.g,
                bands: transfer.bands,
                cells: cells.majorants.bricks,
                side: 1 << cells.shift,
                lit_cells: cells.len(),
                mesh: (gpu.upload("directions of the mesh", &mesh)?, mesh.len()),
                direct: sets(&transfer.direct, transfer.direct_of_channel)?,
                indirect: sets(&transfer.indirect, transfer.indirect_of_channel)?,
                lit_rows: gpu.upload("rows of the nodes", &lit_rows)?,
                cell_places: gpu.upload("places of the cells", &cells.places)?,
                cell_numbers: gpu.upload("cells with density", &cells.bricks)?,
            })
        })?;
        Ok(rows)
    }

    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        let sets = self.direct.iter().chain(&self.indirect);
        let buffers = sets.flat_map(|set| set.mixes.iter().map(|mix| &mix.2).chain([&set.bases]));
        let own = [&self.mesh.0, &self.lit_rows, &self.cell_places, &self.cell_numbers];
        buffers.chain(own).map(wgpu::Buffer::size).sum()
    }
}

impl DeviceClusters {
    fn new(gpu: &Gpu, set: &Clustered, channels: [bool; 3], limit: usize) -> Result<Self, GpuError> {
        let words = 1 + set.terms;
        let each = (limit / (4 * words)).max(1);
        let part = |(number, ids): (usize, &[u8])| {
            let first = number * each;
            let mut mixes = Vec::with_capacity(ids.len() * words);
            for (row, &id) in (first..).zip(ids) {
                mixes.push(u32::from(id));
                mixes.extend(set.weights[row * set.terms..][..set.terms].iter().map(|w| w.to_bits()));
            }
            Ok((first, ids.len(), gpu.upload("mixes of the rows", &mixes)?))
        };
        let [r, g, b] = channels.map(|used| f32::from(u8::from(used)));
        Ok(Self {
            channels: [r, g, b, 0.0],
            vectors: set.clusters() * words,
            terms: set.terms,
            length: set.length,
            bases: gpu.upload("clusters of the transfer", &set.bases)?,
            mixes: set.ids.chunks(each).enumerate().map(part).collect::<Result<_, GpuError>>()?,
        })
    }
}
