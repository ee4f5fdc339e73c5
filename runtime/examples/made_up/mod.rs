//! A made-up frame for examples that measure time: a ball of smoke, its transfer, lights.
// Not every example uses all of it.
#![allow(dead_code)]

use glam::{DAffine3, DVec3, Vec3};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::transfer::cells::Cells;
use smoke_runtime::transport::transfer::frame::{Clustered, FrameTransfer};
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;
use std::sync::Arc;

pub const CLUSTERS: usize = 128;
pub const TERMS: usize = 4;

/// A ball in `side^3` voxels, in a world of 1.
pub fn ball(side: usize) -> DensityField {
    let scale = side as f32 / 128.0;
    let value = |v: usize| {
        let p =
            Vec3::new((v % side) as f32, (v / side % side) as f32, (v / side / side) as f32) - 0.5 * (side - 1) as f32;
        let p = p / scale;
        let inside = p.length() < 55.0;
        if inside { 0.5 + 0.5 * (p.x * 0.3).sin() * (p.y * 0.2).cos() + 0.01 } else { 0.0 }
    };
    let values: Vec<f32> = (0..side * side * side).map(value).map(|v| v.max(0.0)).collect();
    DensityField::from_box([0; 3], [side; 3], &values, DAffine3::from_scale(DVec3::splat(1.0 / side as f64)))
}

/// The medium of [`transfer`].
pub fn medium(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [8.0; 3], albedo: [0.9; 3], g }
}

/// Transfer of 128 clusters x 4 terms and 642 directions. What clusters and weights hold does not change the time.
pub fn transfer(field: &DensityField, g: f32) -> FrameTransfer {
    let kind = BasisKind::Discrete(642);
    let bands = if g == 0.0 { 1 } else { 4 };
    let made_up = |rows: usize, length: usize| Clustered {
        length,
        terms: TERMS,
        bases: (0..CLUSTERS * (1 + TERMS) * length).map(|i| (i % 97) as f32 * 1e-3).collect(),
        ids: (0..rows).map(|row| (row * 31 % CLUSTERS) as u8).collect(),
        weights: (0..rows * TERMS).map(|i| (i % 13) as f32 * 1e-2).collect(),
    };
    FrameTransfer {
        medium: medium(g),
        basis: Arc::new(LightBasis::new(kind)),
        indirect_basis: Arc::new(LightBasis::new(kind.coarser())),
        bands,
        shift: 1,
        direct_of_channel: [0; 3],
        indirect_of_channel: [0; 3],
        direct: vec![made_up(lit_nodes(field).len(), kind.len())],
        indirect: vec![made_up(Cells::new(field, 1).len(), kind.coarser().len() * bands * bands)],
    }
}

/// A sky of 1024 x 512 texels.
pub fn sky() -> Light {
    let mut environment = Environment::constant([0.0; 3]);
    (environment.width, environment.height) = (1024, 512);
    environment.radiance =
        (0..1024 * 512).map(|t| [(t % 1024) as f32 / 1024.0, 0.5, (t / 1024) as f32 / 512.0]).collect();
    Light::Environment(environment)
}

/// A sun.
pub fn sun() -> Light {
    Light::Directional { toward: Vec3::new(0.3, -0.5, 0.8).normalize(), irradiance: [3.0, 2.5, 2.0] }
}
