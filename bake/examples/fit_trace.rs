//! Cost against evaluations of the L-BFGS-B solver, as JSON, for comparison with others (benches/peers).
//!
//! `fit_trace VOLUME N EVALUATIONS START` fits N Gaussians to a raw volume (three little-endian u32 sides, then f32
//! values, x fastest) without teleportation, and writes the starting vector (little-endian f64) to START.
//! `fit_trace NAME N EVALUATIONS` minimises a test function: `rosenbrock`, `bounded_rosenbrock`, `paired_rosenbrock`.

use argmin::core::Executor;
use smoke_baking::fit::descent::Descent;
use smoke_baking::fit::frame::FitSettings;
use smoke_baking::fit::initial::initial;
use smoke_baking::fit::lbfgsb::{CostGradient, Lbfgsb, State};
use smoke_baking::fit::objective::{Objective, Scope};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::volume::{DensityGrid, VoxelMask};

type Failure = Box<dyn std::error::Error>;

type Cost = fn(&[f64], &mut [f64]) -> f64;

struct Function(Cost);

impl CostGradient for Function {
    fn cost_gradient(&self, x: &[f64], gradient: &mut [f64]) -> f64 {
        self.0(x, gradient)
    }
}

/// `sum_i 100 (x_(i+1) - x_i^2)^2 + (1 - x_i)^2`.
fn rosenbrock(x: &[f64], g: &mut [f64]) -> f64 {
    g.fill(0.0);
    let mut f = 0.0;
    for i in 0..x.len() - 1 {
        let (a, b) = (1.0 - x[i], x[i + 1] - x[i] * x[i]);
        f += a * a + 100.0 * b * b;
        g[i] += -2.0 * a - 400.0 * x[i] * b;
        g[i + 1] += 200.0 * b;
    }
    f
}

fn paired_rosenbrock(x: &[f64], g: &mut [f64]) -> f64 {
    x.chunks(2).zip(g.chunks_mut(2)).map(|(x, g)| rosenbrock(x, g)).sum()
}

fn function(name: &str, n: usize, evaluations: usize) -> Result<Vec<(usize, f64)>, Failure> {
    let free = || (vec![f64::NEG_INFINITY; n], vec![f64::INFINITY; n]);
    let odd = |even: f64, odd: f64| (0..n).map(|i| if i % 2 == 0 { even } else { odd }).collect::<Vec<f64>>();
    let (f, start, (lower, upper)): (Cost, _, _) = match name {
        "rosenbrock" => (rosenbrock, odd(-1.2, 1.0), free()),
        "bounded_rosenbrock" => (rosenbrock, vec![3.0; n], (odd(1.5, -100.0), vec![100.0; n])),
        "paired_rosenbrock" => (paired_rosenbrock, odd(-1.2, 1.0), free()),
        _ => return Err(format!("no function {name}").into()),
    };
    let mut trace = Vec::new();
    let mut solver = Lbfgsb::new(lower, upper, 10)?.max_evaluations(evaluations);
    let mut at = (start, None);
    loop {
        let executor = Executor::new(Function(f), solver).timer(false).configure(|s: State| {
            let s = s.param(at.0.clone()).max_iters(1);
            if let Some((g, cost)) = at.1.take() { s.gradient(g).cost(cost) } else { s }
        });
        let mut result = executor.run()?;
        trace.push((result.solver.evaluations(), result.state.cost));
        let done = result.state.iter == 0 || result.solver.evaluations() >= evaluations;
        let lost = || Failure::from("the state lost its point");
        at =
            (result.state.take_param().ok_or_else(lost)?, result.state.take_gradient().map(|g| (g, result.state.cost)));
        solver = result.solver;
        if done {
            return Ok(trace);
        }
    }
}

fn volume(path: &str, n: usize, evaluations: usize, start: &str) -> Result<Vec<(usize, f64)>, Failure> {
    let bytes = std::fs::read(path)?;
    let words: Vec<u32> = bytes.as_chunks::<4>().0.iter().map(|&word| u32::from_le_bytes(word)).collect();
    let [nx, ny, nz, values @ ..] = &words[..] else { return Err("no sides".into()) };
    let dims = [*nx, *ny, *nz];
    let values: Vec<f32> = values.iter().map(|&bits| f32::from_bits(bits)).collect();
    let grid = DensityGrid {
        name: path.into(),
        origin: [0; 3],
        dims: dims.map(|d| d as usize),
        active: VoxelMask::new(values.len()),
        values,
        world_from_index: Default::default(),
    };
    let bounds = FitSettings::default().bounds()?;
    let objective = Objective::new(&grid, &UnitSpace::of_box([0; 3], dims), Scope::Box).ok_or("no density")?;
    let x = initial(&grid, &objective, n, &bounds);
    std::fs::write(start, x.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())?;
    let mut descent = Descent::new(&objective, x, bounds, 20, 0.0, evaluations)?;
    let mut trace = vec![(descent.evaluations(), descent.cost)];
    while descent.advance(1)? && descent.evaluations() < evaluations {
        trace.push((descent.evaluations(), descent.cost));
        if descent.iterations % 20 == 0 {
            descent.rescale();
        }
    }
    trace.push((descent.evaluations(), descent.cost));
    Ok(trace)
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let trace = match arguments[..] {
        [name, n, evaluations] => function(name, n.parse()?, evaluations.parse()?)?,
        [path, n, evaluations, start] => volume(path, n.parse()?, evaluations.parse()?, start)?,
        _ => return Err("usage: fit_trace VOLUME N EVALUATIONS START | NAME N EVALUATIONS".into()),
    };
    let pairs: Vec<String> = trace.iter().map(|(evaluations, cost)| format!("[{evaluations}, {cost:e}]")).collect();
    println!("[{}]", pairs.join(", "));
    Ok(())
}
