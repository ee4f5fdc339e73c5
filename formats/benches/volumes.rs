//! Reading and writing one frame, at two sizes each: the time must grow with the voxels and no faster.
//!
//! `cargo bench -p smoke-formats --bench volumes`. The frame is a ball of smoke with as many active voxels as the name
//! says (thousands), noisy as real smoke is.

use glam::{DAffine3, DVec3};
use smoke_formats::volume::{DensityGrid, VoxelMask};
use smoke_formats::{mitsuba_vol, vdb};
use std::path::Path;

fn main() {
    divan::main();
}

/// A ball in a box of `side` voxels: 0.52 side³ active voxels.
fn ball(side: usize) -> DensityGrid {
    let voxels = side * side * side;
    let (mut values, mut active) = (vec![0.0; voxels], VoxelMask::new(voxels));
    let radius = side as f32 / 2.0;
    let mut state = 1u32;
    for (v, value) in values.iter_mut().enumerate() {
        let at = [v % side, v / side % side, v / side / side].map(|i| (i as f32 + 0.5) / radius - 1.0);
        let r2: f32 = at.iter().map(|a| a * a).sum();
        if r2 < 1.0 {
            state = state.wrapping_mul(1664525).wrapping_add(1013904223);
            *value = (1.0 - r2) * (0.75 + 0.25 * (state >> 8) as f32 / (1 << 24) as f32);
            active.set(v);
        }
    }
    let world_from_index = DAffine3::from_scale(DVec3::splat(0.1));
    DensityGrid { name: "density".into(), origin: [-5, 3, 0], dims: [side; 3], values, active, world_from_index }
}

/// Sides of boxes with 31 and 250 thousand active voxels.
const SIDES: [usize; 2] = [39, 78];

fn written(side: usize, options: vdb::WriteOptions) -> (tempfile::TempDir, Vec<u8>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vdb");
    vdb::write(&path, &ball(side), &options).unwrap();
    let bytes = std::fs::read(path).unwrap();
    (folder, bytes)
}

fn read_vdb(bencher: divan::Bencher, side: usize, half: bool, zip: bool) {
    let (_folder, bytes) = written(side, vdb::WriteOptions { half, zip });
    bencher.bench(|| vdb::read_bytes(Path::new("a.vdb"), &bytes, "density").unwrap());
}

#[divan::bench(args = SIDES)]
fn vdb_read_half_plain(bencher: divan::Bencher, side: usize) {
    read_vdb(bencher, side, true, false);
}

#[divan::bench(args = SIDES)]
fn vdb_read_half_zip(bencher: divan::Bencher, side: usize) {
    read_vdb(bencher, side, true, true);
}

#[divan::bench(args = SIDES)]
fn vdb_read_float_plain(bencher: divan::Bencher, side: usize) {
    read_vdb(bencher, side, false, false);
}

#[divan::bench(args = SIDES)]
fn vdb_write_half_zip(bencher: divan::Bencher, side: usize) {
    let (folder, grid) = (tempfile::tempdir().unwrap(), ball(side));
    let path = folder.path().join("a.vdb");
    bencher.bench(|| vdb::write(&path, &grid, &vdb::WriteOptions { half: true, zip: true }).unwrap());
}

#[divan::bench(args = SIDES)]
fn vol_read(bencher: divan::Bencher, side: usize) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.vol");
    mitsuba_vol::write(&path, &ball(side)).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    bencher.bench(|| mitsuba_vol::read_bytes(&path, &bytes).unwrap());
}
