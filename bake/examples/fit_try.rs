//! try
use smoke_baking::fit::{descent::Descent, initial::initial, objective::{Objective, Scope}};
use smoke_formats::{gaussian::UnitSpace, volume::{DensityGrid, VoxelMask}};
fn env(k: &str, d: f64) -> f64 { std::env::var(k).ok().map_or(d, |s| s.parse().unwrap()) }
fn main() {
    for path in std::env::args().skip(1) {
        let b = std::fs::read(&path).unwrap();
        let w: Vec<u32> = b.chunks(4).map(|c| u32::from_le_bytes(c.try_into().unwrap())).collect();
        let dims = [w[0], w[1], w[2]];
        let values: Vec<f32> = w[3..].iter().map(|&b| f32::from_bits(b)).collect();
        let grid = DensityGrid { name: "d".into(), origin: [0; 3], dims: dims.map(|d| d as usize), active: VoxelMask::new(values.len()), values, world_from_index: Default::default() };
        let space = UnitSpace::of_box([0; 3], dims);
        let scope = if env("SUP", 0.0) > 0.0 { Scope::Support } else { Scope::Box };
        let o = Objective::new(&grid, &space, scope).unwrap();
        let x = initial(&grid, &o, env("N", 600.0) as usize);
        let t = std::time::Instant::now();
        let mut d = Descent::new(&o, x, env("M", 10.0) as usize, 1e-7, env("EV", 400.0) as usize).unwrap();
        print!("{path} start {:.4} ", d.cost);
        let every = env("RS", 20.0) as u64;
        let mut next = 50; let mut moved = 0;
        while d.advance(every).unwrap() && d.evaluations() < env("EV", 400.0) as usize {
            d.rescale(); let tp = env("TP", 0.0); let left = env("EV", 400.0) - d.evaluations() as f64;
            if tp > 0.0 && left > env("LEFT", 40.0) { moved += smoke_baking::fit::teleport::teleport(&mut d, if tp == 1.0 { Default::default() } else { smoke_baking::fit::teleport::Rule::Single }); }
            if d.evaluations() >= next { print!(" {}:{:.5}", d.evaluations(), d.cost); next += 50; }
        }
        let s = t.elapsed().as_secs_f64();
        println!(" end {}:{:.5} box {:.5} it {} {:.2}s {:.2}ms/eval moved {moved}", d.evaluations(), d.cost, o.box_error(&d.x), d.iterations, s, s / d.evaluations() as f64 * 1e3);
    }
}
