//! The grid route: `grid/*.wgsl` and `gmres.wgsl`.

use bytemuck::{Pod, Zeroable};

layout! {
    /// The volume pass: members as `route.wgsl` describes them.
    VolumePass {
        /// The eye, node space.
        eye: [f32; 4],
        /// First column of the map to the world, scaled.
        column_x: [f32; 4],
        /// Second.
        column_y: [f32; 4],
        /// Third.
        column_z: [f32; 4],
        /// Nodes of the field.
        dims: [u32; 4],
        /// Nodes of the layer.
        layer_dims: [u32; 4],
        /// Bricks along each axis.
        bricks: [u32; 4],
        /// Spacing of the layer, in nodes of the field.
        step: u32,
        /// 1 or 3.
        channels: u32,
        /// Number of the dispatch's first plane.
        first_plane: u32,
        /// Planes of the dispatch.
        planes: u32,
        /// Bands of the layer.
        bands: u32,
        /// First brick of the page.
        first_brick: u32,
        /// Bricks of the page.
        page_bricks: u32,
        /// Nothing.
        pad: u32,
    }
}

layout! {
    /// A way through a grid: members as `columns.wgsl` describes them.
    Path {
        /// Nodes along a row.
        columns: u32,
        /// Rows of a slice.
        rows: u32,
        /// Slices.
        slices: u32,
        /// Dominant axis.
        axis: u32,
        /// Columns of the array of rays.
        extent_columns: u32,
        /// Its rows.
        extent_rows: u32,
        /// 1 where the last slice is met first.
        reversed: u32,
        /// World length between slices.
        length: f32,
        /// Values from slice to slice.
        slice_stride: u32,
        /// Values from row to row.
        row_stride: u32,
        /// Where the density of the axis's layout starts.
        density_start: u32,
        /// Its first shift.
        first_shift: u32,
    }
}

layout! {
    /// Where rays lie on a slice: members as `columns.wgsl` describes them.
    Shift {
        /// The ray just below node 0.
        base: [u32; 2],
        /// By how much the next one lies beyond node 0.
        fraction: [f32; 2],
    }
}

layout! {
    /// Single scattering: members as `single.wgsl` describes them.
    Single {
        /// Nodes of the grid.
        dims: [u32; 4],
        /// Beams of the dispatch.
        directions: u32,
        /// The first of them.
        first_direction: u32,
        /// Rays of the widest.
        most_rays: u32,
        /// Values that a beam's rays leave.
        carried_stride: u32,
        /// Nodes near density.
        near: u32,
        /// Which channel.
        channel: u32,
        /// 1 or 3.
        channels: u32,
        /// Its extinction.
        sigma_t: f32,
        /// The first of 16 coefficients.
        first_coefficient: u32,
        /// Vectors of weights a beam and channel.
        quads: u32,
        /// First plane of the buffer.
        first_plane: u32,
        /// Planes of the buffer.
        planes: u32,
        /// Values of a plane.
        plane_stride: u32,
        /// 1 where planes hold the nodes near density alone.
        compact: u32,
        /// 1 for the first beams.
        starts: u32,
        /// Nothing.
        pad: u32,
    }
}

layout! {
    /// Multiple scattering: members as `scatter.wgsl` describes them.
    Scatter {
        /// Nodes of the grid.
        dims: [u32; 4],
        /// Ordinates of the dispatch.
        directions: u32,
        /// The first of them.
        first_direction: u32,
        /// Rays of the widest.
        most_rays: u32,
        /// Rays of all slices of an ordinate.
        carried_stride: u32,
        /// Nodes near density.
        near: u32,
        /// All nodes.
        nodes: u32,
        /// Which channel.
        channel: u32,
        /// 1 or 3.
        channels: u32,
        /// Its extinction.
        sigma_t: f32,
        /// The first of 16 coefficients.
        first_coefficient: u32,
        /// All coefficients.
        coefficients: u32,
        /// Vectors of them an ordinate and channel.
        quads: u32,
        /// First plane of the buffer.
        first_plane: u32,
        /// Planes of the buffer.
        planes: u32,
        /// 1 for the first part of a sum.
        starts: u32,
        /// Values before the plane that is spread.
        target_start: u32,
    }
}

layout! {
    /// Vectors of GMRES: members as `gmres.wgsl` describes them.
    Gmres {
        /// Entries, or blocks.
        length: u32,
        /// Which of the sums.
        slot: u32,
        /// Block of the first entry.
        first_block: u32,
        /// What the factor is multiplied by.
        kind: u32,
        /// Factor of the vector itself.
        own: f32,
        /// Factor of the other.
        factor: f32,
        /// Nothing.
        pad_0: u32,
        /// Nothing.
        pad_1: u32,
    }
}
