//! Transfer: `transfer/*.wgsl` and `product.wgsl`.

use bytemuck::{Pod, Zeroable};

layout! {
    /// A product with a light: members as `product.wgsl` describes them.
    Product {
        /// Colour channels of the rows, 1 or 0.
        channels: [f32; 4],
        /// Rows times `inner`.
        rows: u32,
        /// Terms of a sum.
        depth: u32,
        /// Rows whose terms lie together.
        inner: u32,
        /// Columns.
        columns: u32,
    }
}

layout! {
    /// What directions bring into views: members as `view_directions.wgsl` describes them.
    ViewDirections {
        /// Mean cosine of the phase function.
        g: f32,
        /// Directions of the mesh.
        directions: u32,
        /// First view of the dispatch.
        first_view: u32,
        /// Views of the dispatch.
        views: u32,
    }
}

layout! {
    /// Indirect light of cells: members as `cells.wgsl` describes them.
    Cells {
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
        /// Bricks along each axis.
        bricks: [u32; 4],
        /// Cells along each axis.
        cells: [u32; 4],
        /// Nodes along a cell.
        side: u32,
        /// Bands of the moments.
        bands: u32,
        /// Directions of a cluster.
        terms: u32,
        /// 1 for the first set of rows.
        starts: u32,
        /// First cell of the dispatch.
        first_row: u32,
        /// Cells of the dispatch.
        rows: u32,
        /// First brick of the page.
        first_brick: u32,
        /// Bricks of the page.
        page_bricks: u32,
    }
}

layout! {
    /// Direct light of transfer: members as `source.wgsl` describes them.
    Transfer {
        /// The eye, node space.
        eye: [f32; 4],
        /// First column of the map to the world, scaled.
        column_x: [f32; 4],
        /// Second.
        column_y: [f32; 4],
        /// Third.
        column_z: [f32; 4],
        /// Towards the sun.
        toward: [f32; 4],
        /// Its irradiance times the albedo.
        power: [f32; 4],
        /// Nodes of the field.
        dims: [u32; 4],
        /// Bricks along each axis.
        bricks: [u32; 4],
        /// First brick of the page.
        first_brick: u32,
        /// Bricks of the page.
        page_bricks: u32,
        /// First row of the dispatch.
        first_row: u32,
        /// Rows of the dispatch.
        rows: u32,
        /// Directions of a cluster.
        terms: u32,
        /// First view of the dispatch.
        first_view: u32,
        /// Views of the dispatch.
        views: u32,
        /// Vectors of a view.
        each_view: u32,
        /// Squares along a side of a face.
        squares: u32,
        /// Mean cosine of the phase function.
        g: f32,
        /// Nothing.
        pad_0: u32,
        /// Nothing.
        pad_1: u32,
    }
}
