//! What both sides read: structures of bytes in the layout of WGSL, each with the name that it has in its shader.
//!
//! Three-vectors are padded to four, so that nothing is aligned differently here and there; a test parses the shaders
//! and compares the size and the offset of every member.

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

mod centres;
mod decode;
mod grid;
mod march;
mod transfer;

pub use centres::*;
pub use decode::*;
pub use grid::*;
pub use march::*;
pub use transfer::*;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::pass::PRELUDE;
    use crate::gpu::{centre_solve, centres, decode, gmres, march, scatter, single, transfer, volume_pass};
    use naga::TypeInner;

    const SHADERS: [(&str, &str); 15] = [
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
        ("centres/depth.wgsl", centre_solve::DEPTH),
        ("centres/single.wgsl", centre_solve::SINGLE),
        ("centres/integral.wgsl", centre_solve::PRODUCT),
    ];
    type Members = &'static [(&'static str, usize, usize)];
    /// Every structure of every shader.
    const LAYOUTS: [(&str, usize, Members); 19] = [
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
        ("CentreDepth", size_of::<CentreDepth>(), CentreDepth::MEMBERS),
        ("CentreSingle", size_of::<CentreSingle>(), CentreSingle::MEMBERS),
        ("CentreProduct", size_of::<CentreProduct>(), CentreProduct::MEMBERS),
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
