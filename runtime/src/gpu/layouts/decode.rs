//! Decoding: `medium/*.wgsl`.

use bytemuck::{Pod, Zeroable};

layout! {
    /// Sums of Gaussians: members as `gaussian_sum.wgsl` describes them.
    GaussianSum {
        /// Voxels of the box.
        dims: [u32; 4],
        /// Bricks of 8^3 voxels along each axis.
        bricks: [u32; 4],
        /// Gaussians.
        count: u32,
        /// Nothing.
        pad_0: u32,
        /// Nothing.
        pad_1: u32,
        /// Nothing.
        pad_2: u32,
    }
}

layout! {
    /// The residual: members as `decoder.wgsl` describes them.
    Decoder {
        /// Voxels of the box.
        dims: [u32; 4],
        /// Bricks of 8^3 voxels along each axis.
        bricks: [u32; 4],
        /// Density of a code of 1.
        step: f32,
        /// 0 none, 1 ranks, 2 a hash.
        kind: u32,
        /// Which frame of a hash.
        frame: u32,
        /// Nothing.
        pad: u32,
    }
}
