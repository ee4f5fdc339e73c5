//! Time per stage of the residual, for a frame of about 250 k voxels and a tile of 27 of them.
//!
//! `cargo bench -p smoke-baking --bench residual`. The frame is a ball of waves: as smooth as smoke, and made in a moment.

use divan::Bencher;
use smoke_baking::residual::perfect_hash::find;
use smoke_baking::residual::quantise::{Target, quantise};
use smoke_formats::residual::hash::assemble;
use smoke_formats::residual::{ResidualCodes, coded, rank};
use smoke_formats::volume::{DensityGrid, VoxelMask};
use std::path::Path;

fn main() {
    divan::main();
}

const SIDE: usize = 80;

/// Density, and a smooth approximation of it, of frame `t`.
fn frame(t: usize) -> (DensityGrid, Vec<f32>) {
    let n = SIDE;
    let mut active = VoxelMask::new(n * n * n);
    let (mut values, mut sum) = (vec![0.0; n * n * n], vec![0.0; n * n * n]);
    for v in 0..n * n * n {
        let [x, y, z] = [v % n, v / n % n, v / n / n].map(|i| i as f32 / n as f32 * 2.0 - 1.0);
        let q = x * x + y * y + z * z;
        sum[v] = (-3.0 * q).exp();
        if q < 0.97 {
            active.set(v);
            let wave = (x * 17.0 + t as f32 * 0.2).sin() * (y * 23.0).sin() * (z * 19.0 + t as f32 * 0.1).cos();
            values[v] = (sum[v] + 0.2 * wave).max(0.0);
        }
    }
    let world_from_index = glam::DAffine3::IDENTITY;
    let name = "density".into();
    (DensityGrid { name, origin: [0; 3], dims: [n; 3], values, active, world_from_index }, sum)
}

fn codes(t: usize) -> ResidualCodes {
    let (source, sum) = frame(t);
    quantise(&source, &sum, Target::MaxError(0.002)).expect("a frame").codes
}

#[divan::bench]
fn quantise_one_frame(bencher: Bencher) {
    let (source, sum) = frame(0);
    bencher.bench(|| quantise(&source, &sum, Target::MaxError(0.002)));
}

#[divan::bench]
fn quantise_one_frame_to_a_psnr(bencher: Bencher) {
    let (source, sum) = frame(0);
    bencher.bench(|| quantise(&source, &sum, Target::Psnr { db: 55.0, peak: 1.2 }));
}

#[divan::bench]
fn rank_layout_of_one_frame(bencher: Bencher) {
    let codes = codes(0);
    bencher.bench(|| rank::encode(&codes));
}

#[divan::bench]
fn check_and_unpack_the_rank_layout_of_one_frame(bencher: Bencher) {
    let bytes = rank::encode(&codes(0));
    bencher.bench(|| rank::RankView::new(Path::new("p"), &bytes[..]).map(|view| view.codes()));
}

#[divan::bench]
fn look_up_every_voxel_of_one_frame(bencher: Bencher) {
    let bytes = rank::encode(&codes(0));
    let view = rank::RankView::new(Path::new("p"), &bytes[..]).expect("a layout");
    let n = SIDE as u32;
    bencher.bench(|| {
        let voxels = (0..n).flat_map(|z| (0..n).flat_map(move |y| (0..n).map(move |x| [x, y, z])));
        voxels.filter_map(|v| view.code(v)).fold(0i32, i32::wrapping_add)
    });
}

#[divan::bench]
fn code_one_frame(bencher: Bencher) {
    let codes = codes(0);
    bencher.bench(|| coded::encode(&codes));
}

#[divan::bench(sample_count = 3, sample_size = 1)]
fn hash_of_one_tile(bencher: Bencher) {
    let tile: Vec<_> = (0..27).map(codes).collect();
    bencher.bench(|| find(&tile, 1).map(|table| assemble(Path::new("p"), &tile, &table)));
}
