//! One Gaussian of the fit, as it lies in a pack.

use bytemuck::{Pod, Zeroable};

/// An isotropic Gaussian `weight * exp(-|x - center|^2 / radius^2)` (Zhou et al. 2008, section 5.1).
///
/// Lengths are in the unit space of the sequence (`unit_from_index` in its record): voxels times one scale, so that
/// the longest side of the sequence's box is 1. The standard deviation is `radius / sqrt(2)`.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct Gaussian {
    /// Centre, unit space; may lie outside the box.
    pub center: [f32; 3],
    /// Radius, unit space, > 0.
    pub radius: f32,
    /// Density at the centre, > 0, in the source's density unit.
    pub weight: f32,
}

/// Where index space lies in the unit space of a sequence: `unit = offset + scale * index`, per axis.
///
/// `scale = 1 / (longest side of the sequence's box in voxels)`, and `offset` puts the centre of the box's first voxel
/// at `scale / 2`, so that the box spans `[0, side * scale]` along each axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitSpace {
    /// Unit lengths per voxel, > 0.
    pub scale: f64,
    /// Unit coordinates of index (0, 0, 0).
    pub offset: [f64; 3],
}

impl UnitSpace {
    /// The unit space of a sequence whose box starts at index `origin` and has `dims` voxels (a side of zero counts as 1).
    pub fn of_box(origin: [i32; 3], dims: [u32; 3]) -> Self {
        let side = dims.iter().copied().max().unwrap_or(1).max(1);
        let scale = 1.0 / f64::from(side);
        Self { scale, offset: origin.map(|o| (0.5 - f64::from(o)) * scale) }
    }

    /// Unit coordinate, along `axis`, of voxel `index`; rounded to f32 once, at the end.
    #[inline]
    pub fn coordinate(&self, axis: usize, index: i32) -> f32 {
        (self.offset[axis] + self.scale * f64::from(index)) as f32
    }
}
