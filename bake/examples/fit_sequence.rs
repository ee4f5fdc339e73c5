//! Fits a sequence of volume files and prints one line a frame: `fit_sequence N VOLUME...`.
//!
//! As in a bake, a frame starts from the Gaussians of the frame before as they lie in the pack (16 bits a number).

use smoke_baking::fit::frame::{FitSettings, fit_next, reference_error};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::pack::snap_gaussians;
use smoke_formats::volume;
use std::path::Path;
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [n, paths @ ..] = &arguments[..] else { return Err("usage: fit_sequence N VOLUME...".into()) };
    let grids = paths.iter().map(|p| volume::read(Path::new(p), "density")).collect::<Result<Vec<_>, _>>()?;
    let low: [i32; 3] = std::array::from_fn(|a| grids.iter().map(|g| g.origin[a]).min().unwrap_or(0));
    let high: [i32; 3] =
        std::array::from_fn(|a| grids.iter().map(|g| g.origin[a] + g.dims[a] as i32).max().unwrap_or(0));
    let space = UnitSpace::of_box(low, std::array::from_fn(|a| (high[a] - low[a]) as u32));
    let settings = FitSettings { gaussians: n.parse()?, ..FitSettings::default() };
    let (mut previous, mut reference, mut sum, start) = (Vec::new(), f64::INFINITY, 0.0, Instant::now());
    for (grid, path) in grids.iter().zip(paths) {
        let began = Instant::now();
        // Without Gaussians of a frame before this is a first frame.
        let fit = fit_next(grid, &space, &previous, reference, &settings, &mut |_| ())?;
        reference = reference_error(reference, fit.fit_error);
        sum += fit.fit_error;
        println!(
            "{path} {} Gaussians, error {:.5}, on the support {:.5}, {} evaluations, {} moved, {} new, {} deleted, {:.3} s",
            fit.gaussians.len(),
            fit.fit_error,
            fit.support_error,
            fit.evaluations,
            fit.teleports,
            fit.inserted,
            fit.deleted,
            began.elapsed().as_secs_f64()
        );
        previous = snap_gaussians(Path::new(path), &fit.gaussians)?;
    }
    let frames = grids.len().max(1) as f64;
    println!("mean error {:.5}, {:.3} s a frame", sum / frames, start.elapsed().as_secs_f64() / frames);
    Ok(())
}
