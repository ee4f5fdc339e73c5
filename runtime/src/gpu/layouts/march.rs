//! The view pass: `march.wgsl`.

use bytemuck::{Pod, Zeroable};

layout! {
    /// The view pass: members as `march.wgsl` describes them.
    March {
        /// The axis's crossing of the plane through the middle of the box, node space.
        centre: [f32; 4],
        /// Across by one pixel there, node space.
        plane_right: [f32; 4],
        /// Down by one pixel there, node space.
        plane_down: [f32; 4],
        /// Along the axis by one sample, node space.
        step_forward: [f32; 4],
        /// What one pixel across adds to it.
        step_right: [f32; 4],
        /// What one pixel down adds to it.
        step_down: [f32; 4],
        /// The axis, world space, a unit vector.
        forward: [f32; 4],
        /// What one pixel across adds to it.
        right: [f32; 4],
        /// What one pixel down adds to it.
        down: [f32; 4],
        /// Extinction of the march, per unit density and world length.
        sigma_t: [f32; 4],
        /// The user's extinction over that.
        peak_ratio: [f32; 4],
        /// Last node along each axis.
        top: [f32; 4],
        /// Bricks along each axis.
        bricks: [u32; 4],
        /// Pixels across and down.
        size: [u32; 2],
        /// First pixel of the dispatch.
        first_pixel: u32,
        /// Pixels of the dispatch.
        pixels: u32,
        /// Rays along a side of a pixel.
        samples: u32,
        /// Bricks of a page of nodes.
        bricks_a_page: u32,
        /// Visible environments.
        environments: u32,
        /// 1 where a forward peak counts as not scattered.
        has_peak: u32,
        /// Tangents of a pixel, across and down.
        pixel: [f32; 2],
        /// World length between samples.
        ds: f32,
        /// Distance of the plane along the axis, world length.
        plane: f32,
        /// Its fraction in samples.
        plane_fraction: f32,
        /// It in samples.
        plane_samples: f32,
        /// Number of the eye's first sample, counted from the plane.
        least: i32,
        /// Transmittance at which a ray ends.
        cutoff: f32,
        /// 1 where the film lists its pixels.
        listed: u32,
        /// Nothing.
        pad_0: f32,
        /// Nothing.
        pad_1: f32,
        /// Nothing.
        pad_2: f32,
    }
}

layout! {
    /// What the view pass leaves in a pixel.
    Pixel {
        /// Radiance and depth; 3e38 where there is no density.
        radiance: [f32; 4],
        /// Transmittance; the fourth is nothing.
        transmittance: [f32; 4],
    }
}

layout! {
    /// A visible environment.
    Environment {
        /// Texels across and down.
        size: [u32; 2],
        /// Its first texel.
        first: u32,
        /// 1 if y is up.
        up_is_y: u32,
        /// Radians.
        rotation: f32,
        /// Nothing.
        pad_0: f32,
        /// Nothing.
        pad_1: f32,
        /// Nothing.
        pad_2: f32,
    }
}
