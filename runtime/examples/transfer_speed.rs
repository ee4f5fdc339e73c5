//! What a change of the light and of the view cost with transfer, before the march: a ball in 128 x 128 x 128 voxels,
//! 128 clusters x 4 terms, 642 directions, least of seven runs.
//!
//! ```console
//! $ cargo run --release --example transfer_speed -p smoke-runtime
//! ```
//!
//! Clusters and weights are made up: what they hold does not change the time.

use glam::{DAffine3, DVec3, Vec3};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::transfer::cells::Cells;
use smoke_runtime::transport::transfer::frame::{Clustered, FrameTransfer};
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;
use smoke_runtime::transport::transfer::source::{TransferSettings, TransferTransport};
use smoke_runtime::transport::{ScatteringOrder, SourceRadiance};
use std::sync::Arc;
use std::time::Instant;

const SIDE: usize = 128;
const CLUSTERS: usize = 128;
const TERMS: usize = 4;

fn main() {
    let field = ball();
    let active = field.values.iter().filter(|v| **v > 0.0).count();
    println!("{active} active voxels of {SIDE}^3, {} threads\n", rayon::current_num_threads());
    println!("| g | light | change of the light | change of the view |\n|---|---|---|---|");
    for g in [0.0f32, 0.5] {
        let transfer = Arc::new(transfer(&field, g));
        let settings = TransferSettings::default();
        let mut volume = ShadedVolume::of(&field);
        let mut transport = TransferTransport::new(&field, transfer, settings).expect("made for this field");
        for (name, light) in [("sky of 1024 x 512", sky()), ("sun", sun())] {
            let lights = [light];
            let (mut lit, mut viewed) = (f64::INFINITY, f64::INFINITY);
            for run in 0..7 {
                let start = Instant::now();
                let source = transport.light(&field, &lights, ScatteringOrder::All);
                lit = lit.min(start.elapsed().as_secs_f64());
                let eye = DVec3::new(0.5, -1.5 - 0.01 * f64::from(run), 0.6);
                let start = Instant::now();
                source.shade(&field, eye, &mut volume);
                viewed = viewed.min(start.elapsed().as_secs_f64());
            }
            println!("| {g} | {name} | {:.1} ms | {:.1} ms |", 1e3 * lit, 1e3 * viewed);
        }
    }
}

fn ball() -> DensityField {
    let value = |v: usize| {
        let p = Vec3::new((v % SIDE) as f32, (v / SIDE % SIDE) as f32, (v / SIDE / SIDE) as f32) - 63.5;
        let inside = p.length() < 55.0;
        if inside { 0.5 + 0.5 * (p.x * 0.3).sin() * (p.y * 0.2).cos() + 0.01 } else { 0.0 }
    };
    let values: Vec<f32> = (0..SIDE * SIDE * SIDE).map(value).map(|v| v.max(0.0)).collect();
    DensityField::from_box([0; 3], [SIDE; 3], &values, DAffine3::from_scale(DVec3::splat(1.0 / SIDE as f64)))
}

fn transfer(field: &DensityField, g: f32) -> FrameTransfer {
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
        medium: MediumParameters { sigma_t: [8.0; 3], albedo: [0.9; 3], g },
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

fn sky() -> Light {
    let mut environment = Environment::constant([0.0; 3]);
    (environment.width, environment.height) = (1024, 512);
    environment.radiance =
        (0..1024 * 512).map(|t| [(t % 1024) as f32 / 1024.0, 0.5, (t / 1024) as f32 / 512.0]).collect();
    Light::Environment(environment)
}

fn sun() -> Light {
    Light::Directional { toward: Vec3::new(0.3, -0.5, 0.8).normalize(), irradiance: [3.0, 2.5, 2.0] }
}
