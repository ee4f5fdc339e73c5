//! Fits a sequence of raw volumes and prints one line a frame: `fit_sequence N VOLUME...`.
//!
//! A raw volume holds three little-endian u32 sides, three i32 indices of the first voxel, then f32 values, x fastest.

use smoke_baking::fit::frame::{FitSettings, fit_first, fit_next};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::volume::{DensityGrid, VoxelMask};
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

fn read(path: &str) -> Result<DensityGrid, Failure> {
    let bytes = std::fs::read(path)?;
    let words: Vec<u32> = bytes.as_chunks::<4>().0.iter().map(|&word| u32::from_le_bytes(word)).collect();
    let [nx, ny, nz, ox, oy, oz, values @ ..] = &words[..] else { return Err(format!("{path}: no sides").into()) };
    let values: Vec<f32> = values.iter().map(|&bits| f32::from_bits(bits)).collect();
    Ok(DensityGrid {
        name: path.into(),
        origin: [*ox, *oy, *oz].map(|o| o as i32),
        dims: [*nx, *ny, *nz].map(|d| d as usize),
        active: VoxelMask::new(values.len()),
        values,
        world_from_index: Default::default(),
    })
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [n, paths @ ..] = &arguments[..] else { return Err("usage: fit_sequence N VOLUME...".into()) };
    let grids = paths.iter().map(|p| read(p)).collect::<Result<Vec<_>, _>>()?;
    let low: [i32; 3] = std::array::from_fn(|a| grids.iter().map(|g| g.origin[a]).min().unwrap_or(0));
    let high: [i32; 3] =
        std::array::from_fn(|a| grids.iter().map(|g| g.origin[a] + g.dims[a] as i32).max().unwrap_or(0));
    let space = UnitSpace::of_box(low, std::array::from_fn(|a| (high[a] - low[a]) as u32));
    let settings = FitSettings { gaussians: n.parse()?, ..FitSettings::default() };
    let (mut previous, mut first, mut sum, start) = (Vec::new(), None, 0.0, Instant::now());
    for grid in &grids {
        let began = Instant::now();
        let fit = match first {
            None => fit_first(grid, &space, &settings, &mut |_| ())?,
            Some(first) => fit_next(grid, &space, &previous, first, &settings, &mut |_| ())?,
        };
        first.get_or_insert(fit.fit_error);
        sum += fit.fit_error;
        println!(
            "{} {} Gaussians, error {:.5}, on the support {:.5}, {} evaluations, {} moved, {} new, {} deleted, {:.3} s",
            grid.name,
            fit.gaussians.len(),
            fit.fit_error,
            fit.support_error,
            fit.evaluations,
            fit.teleports,
            fit.inserted,
            fit.deleted,
            began.elapsed().as_secs_f64()
        );
        previous = fit.gaussians;
    }
    let frames = grids.len().max(1) as f64;
    println!("mean error {:.5}, {:.3} s a frame", sum / frames, start.elapsed().as_secs_f64() / frames);
    Ok(())
}
