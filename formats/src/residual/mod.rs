//! The quantised residual of one frame: what the Gaussians miss, as integer codes on the frame's support.

mod code_model;
pub mod coded;
mod earlier;
mod least_squares;
mod logistic;
mod mixing;
mod predict;
mod range_coder;
mod ranks;
mod support;
mod sweep;

use crate::volume::VoxelMask;

/// The residual of one frame before any layout: `density = max(0, gaussian_sum + step * code)` on the support,
/// and exactly zero elsewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct ResidualCodes {
    /// Index coordinates of the first voxel of the frame's box.
    pub origin: [i32; 3],
    /// Voxels along x, y, z; all zero for an empty frame.
    pub dims: [u32; 3],
    /// The voxels where the source is active or not zero, x fastest. Everywhere else the density is exactly zero.
    pub support: VoxelMask,
    /// One code for each voxel of the support, in voxel order.
    pub codes: Vec<i32>,
}
