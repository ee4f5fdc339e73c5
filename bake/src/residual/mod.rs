//! The residual of a sequence: what the Gaussians miss, as codes, laid out for the pack.
//!
//! [`quantise`] makes codes with a promised error, [`perfect_hash`] looks for a hash of a tile's codes, [`tile`] picks
//! the layout.

pub mod decibel;
pub mod perfect_hash;
pub mod quantise;
pub mod tile;

#[cfg(test)]
pub(crate) mod tests {
    use smoke_formats::residual::ResidualCodes;
    use smoke_formats::volume::VoxelMask;

    /// A frame whose code at a voxel is `code(x, y, z)`, or which has no support there.
    pub(crate) fn frame(dims: [u32; 3], code: impl Fn(u32, u32, u32) -> Option<i32>) -> ResidualCodes {
        let mut support = VoxelMask::new(dims.iter().product::<u32>() as usize);
        let mut codes = vec![];
        for v in 0..support.len() as u32 {
            if let Some(code) = code(v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]) {
                support.set(v as usize);
                codes.push(code);
            }
        }
        ResidualCodes { origin: [0; 3], dims, support, codes }
    }
}
