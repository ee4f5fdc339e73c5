//! One frame of a pack as transport needs it: density on nodes, Gaussians, and where both lie.

use super::decoder::{decode_field, decode_gaussians};
use super::field::DensityField;
use crate::transport::transfer::frame::FrameTransfer;
use glam::{DAffine3, DMat3, DVec3};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::pack::Pack;
use smoke_formats::residual::ResidualCodes;
use std::sync::Arc;

/// A decoded frame.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Its density.
    pub field: DensityField,
    /// Its Gaussians, in unit space.
    pub gaussians: Vec<Gaussian>,
    /// The sequence's unit space.
    pub unit: UnitSpace,
    /// Index coordinates of the field's first node.
    pub first_node: [i32; 3],
    /// Index to world space.
    pub world_from_index: DAffine3,
    /// Its precomputed transfer, where that was read too.
    pub transfer: Option<Arc<FrameTransfer>>,
}

impl Frame {
    /// A frame from what a pack holds of it: `density = max(0, Gaussians + step * code)` on the residual's support.
    pub fn decode(
        gaussians: Vec<Gaussian>,
        residual: &ResidualCodes,
        step: f32,
        unit: UnitSpace,
        world_from_index: DAffine3,
    ) -> Self {
        let field = decode_field(&gaussians, residual, step, &unit, world_from_index);
        let first_node = residual.origin.map(|o| o.saturating_sub(1));
        Self { field, gaussians, unit, first_node, world_from_index, transfer: None }
    }

    /// Frame `number`, counted from 0, of a pack.
    pub fn read(pack: &Pack, number: usize) -> smoke_formats::Result<Self> {
        let gaussians = pack.gaussians(number)?;
        let codes = pack.residual(number)?.codes()?;
        let sequence = pack.sequence();
        let unit = UnitSpace::of_box(sequence.origin, sequence.dims);
        let world_from_index = DAffine3::from_cols_array(&sequence.world_from_index);
        Ok(Self::decode(gaussians, &codes, pack.frames()[number].step, unit, world_from_index))
    }

    /// Frame `number`, counted from 0, of a pack, with its transfer.
    pub fn read_with_transfer(pack: &Pack, number: usize) -> smoke_formats::Result<Self> {
        let transfer = FrameTransfer::read(pack, number)?;
        Ok(Self { transfer: Some(Arc::new(transfer)), ..Self::read(pack, number)? })
    }

    /// Frame `number`, counted from 0, of a pack, by its Gaussians alone: the residual is not even read.
    pub fn read_gaussians(pack: &Pack, number: usize) -> smoke_formats::Result<Self> {
        let gaussians = pack.gaussians(number)?;
        let (sequence, record) = (pack.sequence(), &pack.frames()[number]);
        let unit = UnitSpace::of_box(sequence.origin, sequence.dims);
        let world_from_index = DAffine3::from_cols_array(&sequence.world_from_index);
        let (origin, dims) = (record.origin, record.dims);
        let density = decode_gaussians(&gaussians, origin, dims, record.step, &unit);
        let field = DensityField::from_box(origin, dims.map(|d| d as usize), &density, world_from_index);
        let first_node = origin.map(|o| o.saturating_sub(1));
        Ok(Self { field, gaussians, unit, first_node, world_from_index, transfer: None })
    }

    /// Unit space to world.
    pub fn world_from_unit(&self) -> DAffine3 {
        let index_from_unit = DAffine3 { matrix3: DMat3::IDENTITY * (1.0 / self.unit.scale), translation: DVec3::ZERO }
            * DAffine3::from_translation(-DVec3::from_array(self.unit.offset));
        self.world_from_index * index_from_unit
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use smoke_formats::volume::VoxelMask;

    #[test]
    fn unit_index_and_node_space_agree_on_where_a_voxel_is() {
        let support = VoxelMask::new(60);
        let residual = ResidualCodes { origin: [7, -3, 20], dims: [3, 4, 5], support, codes: vec![] };
        let unit = UnitSpace::of_box([5, -5, 11], [30, 20, 40]);
        let map = DAffine3::from_cols_array(&[0.1, 0.02, 0.0, 0.0, 0.2, 0.0, 0.0, 0.03, 0.3, 4.0, 5.0, 6.0]);
        let frame = Frame::decode(vec![], &residual, 0.1, unit, map);
        assert_eq!((frame.first_node, frame.field.dims), ([6, -4, 19], [5, 6, 7]));
        let voxel = DVec3::new(8.0, -1.0, 22.0);
        let world = map.transform_point3(voxel);
        let node = frame.field.world_from_node.transform_point3(DVec3::new(2.0, 3.0, 3.0));
        let at = DVec3::from_array([0, 1, 2].map(|a| unit.offset[a] + unit.scale * voxel[a]));
        assert!(
            (world - node).length() < 1e-12 && (world - frame.world_from_unit().transform_point3(at)).length() < 1e-12
        );
    }
}
