//! The kernels of the fit on a made-up plume of 64 x 64 x 100 voxels: objective and gradient, the sum alone, a frame.

use divan::Bencher;
use smoke_baking::fit::frame::{FitSettings, fit_first, fit_next};
use smoke_baking::fit::initial::initial;
use smoke_baking::fit::lbfgsb::CostGradient;
use smoke_baking::fit::objective::{Objective, Scope, VARIABLES};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::volume::{DensityGrid, VoxelMask};
use smoke_runtime::medium::gaussian_sum::gaussian_sum;

fn main() {
    divan::main();
}

/// A wavy column, about a third of the box occupied; `shift` moves it by so many voxels.
fn plume(shift: f32) -> (DensityGrid, UnitSpace) {
    let dims = [64usize, 64, 100];
    let mut values = Vec::new();
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                let [x, y, z] = [i as f32 - shift, j as f32, k as f32];
                let centre = [32.0 + 8.0 * (z * 0.1).sin(), 32.0 + 8.0 * (z * 0.13).cos()];
                let r = ((x - centre[0]).powi(2) + (y - centre[1]).powi(2)).sqrt();
                let edge = 18.0 + 3.0 * (x * 0.7).sin() * (y * 0.6).sin() * (z * 0.5).sin();
                values.push((1.0 - r / edge).clamp(0.0, 0.3) / 0.3);
            }
        }
    }
    let active = VoxelMask::new(values.len());
    let grid = DensityGrid {
        name: "plume".into(),
        origin: [0; 3],
        dims,
        values,
        active,
        world_from_index: Default::default(),
    };
    (grid, UnitSpace::of_box([0; 3], [64, 64, 100]))
}

#[divan::bench(args = [300, 600, 1200])]
fn objective_and_gradient(bencher: Bencher, n: usize) {
    let (grid, space) = plume(0.0);
    let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
    let bounds = FitSettings::default().bounds().unwrap();
    let x = initial(&grid, &objective, n, &bounds);
    let mut gradient = vec![0.0; n * VARIABLES];
    bencher.bench_local(|| objective.cost_gradient(&x, &mut gradient));
}

#[divan::bench(args = [300, 600, 1200])]
fn sum_alone(bencher: Bencher, n: usize) {
    let (grid, space) = plume(0.0);
    let settings = FitSettings { gaussians: n, first_evaluations: 20, ..FitSettings::default() };
    let fit = fit_first(&grid, &space, &settings, &mut |_| ()).unwrap();
    bencher.bench_local(|| gaussian_sum(&fit.gaussians, &space, grid.origin, grid.dims));
}

#[divan::bench(args = [600], sample_count = 3)]
fn first_frame(bencher: Bencher, n: usize) {
    let (grid, space) = plume(0.0);
    let settings = FitSettings { gaussians: n, ..FitSettings::default() };
    bencher.bench_local(|| fit_first(&grid, &space, &settings, &mut |_| ()).unwrap().fit_error);
}

#[divan::bench(args = [600], sample_count = 5)]
fn next_frame(bencher: Bencher, n: usize) {
    let ((grid, space), (moved, _)) = (plume(0.0), plume(1.0));
    let settings = FitSettings { gaussians: n, ..FitSettings::default() };
    let first = fit_first(&grid, &space, &settings, &mut |_| ()).unwrap();
    let next =
        || fit_next(&moved, &space, &first.gaussians, first.fit_error, &settings, &mut |_| ()).unwrap().fit_error;
    bencher.bench_local(next);
}
