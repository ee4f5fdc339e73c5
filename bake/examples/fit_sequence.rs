//! try
use smoke_baking::fit::{frame::*, objective::Scope};
use smoke_formats::{gaussian::UnitSpace, volume::{DensityGrid, VoxelMask}};
fn env(k: &str, d: f64) -> f64 { std::env::var(k).ok().map_or(d, |s| s.parse().unwrap()) }
fn main() {
    let mut grids = Vec::new();
    for path in std::env::args().skip(1) {
        let b = std::fs::read(&path).unwrap();
        let w: Vec<u32> = b.chunks(4).map(|c| u32::from_le_bytes(c.try_into().unwrap())).collect();
        let values: Vec<f32> = w[6..].iter().map(|&b| f32::from_bits(b)).collect();
        grids.push(DensityGrid { name: path, origin: [w[3] as i32, w[4] as i32, w[5] as i32], dims: [w[0], w[1], w[2]].map(|d| d as usize), active: VoxelMask::new(values.len()), values, world_from_index: Default::default() });
    }
    let lo: [i32; 3] = std::array::from_fn(|a| grids.iter().map(|g| g.origin[a]).min().unwrap());
    let hi: [i32; 3] = std::array::from_fn(|a| grids.iter().map(|g| g.origin[a] + g.dims[a] as i32).max().unwrap());
    let space = UnitSpace::of_box(lo, std::array::from_fn(|a| (hi[a] - lo[a]) as u32));
    let d = FitSettings::default();
    let settings = FitSettings { gaussians: env("N", 600.) as usize, first_evaluations: env("EV", 200.) as usize, next_evaluations: env("NEV", 40.) as usize, memory: env("M", 20.) as usize,
        error_ratio: env("RHO", 1.1), scope: if env("SUP", 0.) > 0. { Scope::Support } else { Scope::Box }, deletions: env("DEL", 3.) as usize, teleport_every: env("TE", 20.) as u64, steady: env("ST", 1.) > 0., ..d };
    let (mut previous, mut first): (Vec<_>, f64) = (Vec::new(), 0.0);
    let start = std::time::Instant::now();
    let (mut sum, mut worst, mut sup) = (0.0, 0.0f64, 0.0);
    for (i, g) in grids.iter().enumerate() {
        let t = std::time::Instant::now();
        let fit = if i == 0 { fit_first(g, &space, &settings, &mut |_| ()) } else { fit_next(g, &space, &previous, first, &settings, &mut |_| ()) }.unwrap();
        if i == 0 { first = fit.fit_error; }
        sum += fit.fit_error; worst = worst.max(fit.fit_error); sup += fit.support_error;
        if i % 8 == 0 || i + 1 == grids.len() { println!("{} n {} error {:.5} support {:.5} ev {} it {} tel {} ins {} del {} {:.3}s", &g.name[g.name.len()-8..], fit.gaussians.len(), fit.fit_error, fit.support_error, fit.evaluations, fit.iterations, fit.teleports, fit.inserted, fit.deleted, t.elapsed().as_secs_f64()); }
        previous = fit.gaussians;
    }
    let n = grids.len() as f64;
    println!("mean error {:.5} worst {worst:.5} support {:.5} {:.3} s/frame", sum / n, sup / n, start.elapsed().as_secs_f64() / n);
}
