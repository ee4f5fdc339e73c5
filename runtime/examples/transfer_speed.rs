//! What a change of the light and of the view cost with transfer, before the march: a ball in 128 x 128 x 128 voxels,
//! 128 clusters x 4 terms, 642 directions, least of seven runs.
//!
//! ```console
//! $ cargo run --release --example transfer_speed -p smoke-runtime
//! ```
//!
//! Clusters and weights are made up: what they hold does not change the time.

mod made_up;

use glam::DVec3;
use made_up::{ball, sky, sun, transfer};
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::transport::transfer::source::{TransferSettings, TransferTransport};
use smoke_runtime::transport::{ScatteringOrder, SourceRadiance};
use std::sync::Arc;
use std::time::Instant;

const SIDE: usize = 128;

fn main() {
    let field = ball(SIDE);
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
