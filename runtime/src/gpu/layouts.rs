//! What both sides read: structures of bytes in the layout of WGSL, each with the name that it has in its shader.
//!
//! Three-vectors are padded to four, so that nothing is aligned differently here and there; a test parses the shaders
//! and compares the size and the offset of every member.

use bytemuck::{Pod, Zeroable};

/// Declares a structure for both sides, and its members for the test.
macro_rules! layout {
    ($(#[$doc:meta])* $name:ident { $($(#[$member_doc:meta])* $member:ident: $kind:ty,)* }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
        pub struct $name { $($(#[$member_doc])* pub $member: $kind,)* }

        impl $name {
            /// Name, offset and size of each member, bytes.
            pub const MEMBERS: &[(&str, usize, usize)] =
                &[$((stringify!($member), std::mem::offset_of!($name, $member), size_of::<$kind>()),)*];
        }
    };
}

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::pass::PRELUDE;
    use crate::gpu::{centres, decode, gmres, march, scatter, single, transfer, volume_pass};
    use naga::TypeInner;

    const SHADERS: [(&str, &str); 12] = [
        ("march.wgsl", march::SHADER),
        ("route.wgsl", volume_pass::SHADER),
        ("centres/volume_pass.wgsl", centres::SHADER),
        ("product.wgsl", transfer::PRODUCT),
        ("view_directions.wgsl", transfer::VIEW_DIRECTIONS),
        ("cells.wgsl", transfer::CELLS),
        ("source.wgsl", transfer::SOURCE),
        ("gaussian_sum.wgsl", decode::GAUSSIAN_SUM),
        ("decoder.wgsl", decode::DECODER),
        ("single.wgsl", single::SHADER),
        ("scatter.wgsl", scatter::SHADER),
        ("gmres.wgsl", gmres::SHADER),
    ];
    type Members = &'static [(&'static str, usize, usize)];
    /// Every structure of every shader.
    const LAYOUTS: [(&str, usize, Members); 16] = [
        ("March", size_of::<March>(), March::MEMBERS),
        ("Pixel", size_of::<Pixel>(), Pixel::MEMBERS),
        ("Environment", size_of::<Environment>(), Environment::MEMBERS),
        ("VolumePass", size_of::<VolumePass>(), VolumePass::MEMBERS),
        ("CentreVolume", size_of::<CentreVolume>(), CentreVolume::MEMBERS),
        ("Product", size_of::<Product>(), Product::MEMBERS),
        ("ViewDirections", size_of::<ViewDirections>(), ViewDirections::MEMBERS),
        ("Cells", size_of::<Cells>(), Cells::MEMBERS),
        ("Transfer", size_of::<Transfer>(), Transfer::MEMBERS),
        ("GaussianSum", size_of::<GaussianSum>(), GaussianSum::MEMBERS),
        ("Decoder", size_of::<Decoder>(), Decoder::MEMBERS),
        ("Path", size_of::<Path>(), Path::MEMBERS),
        ("Shift", size_of::<Shift>(), Shift::MEMBERS),
        ("Single", size_of::<Single>(), Single::MEMBERS),
        ("Scatter", size_of::<Scatter>(), Scatter::MEMBERS),
        ("Gmres", size_of::<Gmres>(), Gmres::MEMBERS),
    ];

    fn parse(name: &str, text: &str) -> naga::Module {
        let text = format!("{PRELUDE}{text}");
        naga::front::wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&text)))
    }

    /// The first structure that differs from its twin, or the names of those that were compared.
    fn compare(module: &naga::Module) -> Result<Vec<String>, String> {
        let mut layouter = naga::proc::Layouter::default();
        layouter.update(module.to_ctx()).map_err(|e| e.to_string())?;
        let mut compared = Vec::new();
        for (_, kind) in module.types.iter() {
            let (TypeInner::Struct { members, span }, Some(name)) = (&kind.inner, &kind.name) else { continue };
            let Some((_, size, ours)) = LAYOUTS.iter().find(|(n, ..)| n == name) else {
                return Err(format!("{name} has no twin"));
            };
            let theirs: Vec<(&str, usize, usize)> = members
                .iter()
                .map(|m| (m.name.as_deref().unwrap_or(""), m.offset as usize, layouter[m.ty].size as usize))
                .collect();
            if *span as usize != *size || theirs != *ours {
                return Err(format!("{name}: {span} {theirs:?}, expected {size} {ours:?}"));
            }
            compared.push(name.clone());
        }
        Ok(compared)
    }

    #[test]
    fn every_structure_has_the_same_size_and_offsets_on_both_sides() {
        let compared = SHADERS.iter().flat_map(|(name, text)| compare(&parse(name, text)).unwrap());
        // Two shaders may share one.
        let compared: std::collections::BTreeSet<String> = compared.collect();
        assert_eq!(compared.len(), LAYOUTS.len());
    }

    #[test]
    fn a_member_that_is_moved_renamed_or_missing_is_found() {
        for (from, to) in [
            ("    least: i32,\n    cutoff: f32,", "    cutoff: f32,\n    least: i32,"),
            ("    pixel: vec2<f32>,", "    texel: vec2<f32>,"),
            ("    peak_ratio: vec4<f32>,", ""),
            ("    up_is_y: u32,", "    up_is_y: vec2<u32>,"),
        ] {
            assert!(march::SHADER.contains(from));
            // Parsed only: what reads the member is of no interest.
            let structures: String = march::SHADER.replace(from, to);
            let end = structures.find("@group").unwrap();
            assert!(compare(&parse("changed", &structures[..end])).is_err(), "{from}");
        }
    }

    #[test]
    fn shaders_are_valid_without_any_capability() {
        for (name, text) in SHADERS {
            let module = parse(name, text);
            let flags = naga::valid::ValidationFlags::all();
            naga::valid::Validator::new(flags, naga::valid::Capabilities::empty())
                .validate(&module)
                .unwrap_or_else(|e| panic!("{name}: {}", e.emit_to_string(&format!("{PRELUDE}{text}"))));
            assert!(!module.entry_points.is_empty());
            let storage = |v: &naga::GlobalVariable| matches!(v.space, naga::AddressSpace::Storage { .. });
            let count = module.global_variables.iter().filter(|(_, v)| storage(v)).count();
            assert!(count <= 8, "{name}: {count} storage buffers, of which a stage has 8");
        }
    }
}
