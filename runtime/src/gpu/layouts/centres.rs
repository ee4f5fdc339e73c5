//! The route through centres: `centres/*.wgsl`.

use bytemuck::{Pod, Zeroable};

layout! {
    /// The volume pass of the route through centres: members as `centres/volume_pass.wgsl` describes them.
    CentreVolume {
        /// The eye, unit space.
        eye: [f32; 4],
        /// Nodes of the field.
        dims: [u32; 4],
        /// Bricks along each axis.
        bricks: [u32; 4],
        /// First brick of the page.
        first_brick: u32,
        /// Bricks of the page.
        page_bricks: u32,
        /// Gaussians.
        count: u32,
        /// Bands of what they send.
        bands: u32,
    }
}

layout! {
    /// Depths from the centres: members as `depth.wgsl` describes them.
    CentreDepth {
        /// Gaussians.
        count: u32,
        /// Directions with their padding.
        directions: u32,
        /// Nothing.
        pad_0: u32,
        /// Nothing.
        pad_1: u32,
    }
}

layout! {
    /// Single scattering at the centres: members as `centres/single.wgsl` describes them.
    CentreSingle {
        /// Optical depth over depth.
        scale: [f32; 4],
        /// Centres.
        count: u32,
        /// Directions with their padding.
        directions: u32,
        /// Coefficients a centre.
        coefficients: u32,
        /// Nothing.
        pad_0: u32,
    }
}

layout! {
    /// A plane of the product between the centres: members as `integral.wgsl` describes them.
    CentreProduct {
        /// Centres.
        count: u32,
        /// First of the pair of harmonics.
        a: u32,
        /// Second of them.
        b: u32,
        /// Nothing.
        pad_0: u32,
    }
}
