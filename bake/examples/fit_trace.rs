//! Cost against evaluations of the L-BFGS-B solver, as JSON, for comparison with others (benches/peers).
//!
//! `fit_trace VOLUME N EVALUATIONS FOLDER` fits N Gaussians to the density of a volume file without teleportation. It
//! writes to FOLDER `start`, the starting vector (little-endian f64), and `volume`, the density over its maximum:
//! three little-endian u32 sides, then f32 values, x fastest.
//! `fit_trace NAME N EVALUATIONS` minimises a test function from its start, with the settings that SciPy has by
//! default: `rosenbrock`, `bounded_rosenbrock`, `paired_rosenbrock`, `powell`, `bounded_powell`, `beale`, and
//! `quadratic:SEED`.

use argmin::core::Executor;
use smoke_baking::fit::descent::Descent;
use smoke_baking::fit::frame::FitSettings;
use smoke_baking::fit::initial::initial;
use smoke_baking::fit::lbfgsb::{CostGradient, Lbfgsb, State};
use smoke_baking::fit::objective::{Objective, Scope};
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::volume;
use std::path::Path;

type Failure = Box<dyn std::error::Error>;

type Cost = Box<dyn Fn(&[f64], &mut [f64]) -> f64>;

/// A cost with its gradient, where it starts, and its bounds.
struct Function {
    cost: Cost,
    start: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
}

struct Problem<'a>(&'a Cost);

impl CostGradient for Problem<'_> {
    fn cost_gradient(&self, x: &[f64], gradient: &mut [f64]) -> f64 {
        (self.0)(x, gradient)
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

/// Powell's singular function, extended: by fours `(a + 10 b)^2 + 5 (c - d)^2 + (b - 2 c)^4 + 10 (a - d)^4`.
fn powell(x: &[f64], g: &mut [f64]) -> f64 {
    let four = |(x, g): (&[f64], &mut [f64])| {
        let [p, q, r, s] = [x[0] + 10.0 * x[1], x[2] - x[3], x[1] - 2.0 * x[2], x[0] - x[3]];
        let (r3, s3) = (r * r * r, s * s * s);
        g[0] = 2.0 * p + 40.0 * s3;
        g[1] = 20.0 * p + 4.0 * r3;
        g[2] = 10.0 * q - 8.0 * r3;
        g[3] = -10.0 * q - 40.0 * s3;
        p * p + 5.0 * q * q + r * r3 + 10.0 * s * s3
    };
    x.chunks(4).zip(g.chunks_mut(4)).map(four).sum()
}

/// Beale's function, the sum over `(c, k)` in (1.5, 1), (2.25, 2), (2.625, 3) of `(c - x + x y^k)^2`.
fn beale(x: &[f64], g: &mut [f64]) -> f64 {
    let ([x, y], mut f) = ([x[0], x[1]], 0.0);
    g.fill(0.0);
    for (c, k) in [(1.5, 1), (2.25, 2), (2.625, 3)] {
        let before = (1..k).fold(1.0, |power, _| power * y);
        let t = c - x + x * before * y;
        f += t * t;
        g[0] += 2.0 * t * (before * y - 1.0);
        g[1] += 2.0 * t * x * f64::from(k) * before;
    }
    f
}

/// A convex quadratic of condition 1024 in the box from 0 to 1, about half of the bounds active at its optimum.
///
/// `H = R D R` with the reflection `R = I - 2 v v^T / v^T v`; the optimum and the multipliers are drawn first.
fn quadratic(n: usize, seed: u64) -> Function {
    let mut state = seed;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let v: Vec<f64> = (0..n).map(|_| 2.0 * random() - 1.0).collect();
    let vv: f64 = v.iter().map(|v| v * v).sum();
    let diagonal: Vec<f64> = (0..n).map(|i| (1.0 + 31.0 * i as f64 / (n - 1) as f64).powi(2)).collect();
    let product = move |x: &[f64]| -> Vec<f64> {
        let reflect = |x: &[f64]| -> Vec<f64> {
            let t = 2.0 * x.iter().zip(&v).map(|(x, v)| x * v).sum::<f64>() / vv;
            x.iter().zip(&v).map(|(x, v)| x - t * v).collect()
        };
        let scaled: Vec<f64> = reflect(x).iter().zip(&diagonal).map(|(x, d)| x * d).collect();
        reflect(&scaled)
    };
    // Per variable: at 0 or 1 with a multiplier, or free.
    let optimum: Vec<(f64, f64)> = (0..n)
        .map(|_| match (random(), random(), random()) {
            (kind, _, multiplier) if kind < 0.25 => (0.0, 10.0 * multiplier),
            (kind, _, multiplier) if kind < 0.5 => (1.0, -10.0 * multiplier),
            (_, place, _) => (place, 0.0),
        })
        .collect();
    let best: Vec<f64> = optimum.iter().map(|o| o.0).collect();
    let b: Vec<f64> = product(&best).iter().zip(&optimum).map(|(h, o)| h - o.1).collect();
    let cost = move |x: &[f64], g: &mut [f64]| {
        let h = product(x);
        (0..n).for_each(|i| g[i] = h[i] - b[i]);
        (0..n).map(|i| x[i] * (0.5 * h[i] - b[i])).sum()
    };
    Function { cost: Box::new(cost), start: vec![0.5; n], lower: vec![0.0; n], upper: vec![1.0; n] }
}

fn function(name: &str, n: usize) -> Result<Function, Failure> {
    let every = |period: &[f64]| (0..n).map(|i| period[i % period.len()]).collect::<Vec<f64>>();
    let (none, all) = (f64::NEG_INFINITY, f64::INFINITY);
    let of = |cost: fn(&[f64], &mut [f64]) -> f64, start: &[f64], lower: &[f64], upper: &[f64]| Function {
        cost: Box::new(cost),
        start: every(start),
        lower: every(lower),
        upper: every(upper),
    };
    Ok(match (name, name.strip_prefix("quadratic:")) {
        (_, Some(seed)) => quadratic(n, seed.parse()?),
        ("rosenbrock", _) => of(rosenbrock, &[-1.2, 1.0], &[none], &[all]),
        ("bounded_rosenbrock", _) => of(rosenbrock, &[3.0], &[1.5, -100.0], &[100.0]),
        ("paired_rosenbrock", _) => of(paired_rosenbrock, &[-1.2, 1.0], &[none], &[all]),
        ("powell", _) => of(powell, &[3.0, -1.0, 0.0, 1.0], &[none], &[all]),
        ("bounded_powell", _) => of(powell, &[3.0, -1.0, 0.5, 1.0], &[0.1, none, 0.2, none], &[all, all, all, 0.9]),
        ("beale", _) => of(beale, &[1.0, 1.0], &[-4.5], &[2.5, 4.5]),
        _ => return Err(format!("no function {name}").into()),
    })
}

fn minimise(name: &str, n: usize, evaluations: usize) -> Result<Vec<(usize, f64)>, Failure> {
    let Function { cost, start, lower, upper } = function(name, n)?;
    let mut trace = Vec::new();
    let mut solver = Lbfgsb::new(lower, upper, 10)?.max_evaluations(evaluations);
    let mut at = (start, None);
    loop {
        let executor = Executor::new(Problem(&cost), solver).timer(false).configure(|s: State| {
            let s = s.param(at.0.clone()).max_iters(1);
            if let Some((g, cost)) = at.1.take() { s.gradient(g).cost(cost) } else { s }
        });
        let mut result = executor.run()?;
        trace.push((result.solver.evaluations(), result.state.cost));
        let lost = || Failure::from("the state lost its point");
        at =
            (result.state.take_param().ok_or_else(lost)?, result.state.take_gradient().map(|g| (g, result.state.cost)));
        solver = result.solver;
        if solver.finished() {
            return Ok(trace);
        }
    }
}

fn fit(path: &Path, n: usize, evaluations: usize, folder: &Path) -> Result<Vec<(usize, f64)>, Failure> {
    let grid = volume::read(path, "density")?;
    let dims = grid.dims.map(|d| d as u32);
    let bounds = FitSettings::default().bounds()?;
    let objective = Objective::new(&grid, &UnitSpace::of_box(grid.origin, dims), Scope::Box).ok_or("no density")?;
    let x = initial(&grid, &objective, n, &bounds);
    std::fs::write(folder.join("start"), x.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>())?;
    let values = grid.values.iter().flat_map(|v| (v / objective.peak()).to_le_bytes());
    let bytes: Vec<u8> = dims.iter().flat_map(|d| d.to_le_bytes()).chain(values).collect();
    std::fs::write(folder.join("volume"), bytes)?;
    let mut descent = Descent::new(&objective, x, bounds, 20, 0.0, evaluations)?;
    let mut trace = vec![(descent.evaluations(), descent.cost)];
    loop {
        let going = descent.advance(1)?;
        trace.push((descent.evaluations(), descent.cost));
        if !going {
            return Ok(trace);
        }
        if descent.iterations % 20 == 0 {
            descent.rescale();
        }
    }
}

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let trace = match arguments[..] {
        [name, n, evaluations] => minimise(name, n.parse()?, evaluations.parse()?)?,
        [path, n, evaluations, folder] => fit(path.as_ref(), n.parse()?, evaluations.parse()?, folder.as_ref())?,
        _ => return Err("usage: fit_trace VOLUME N EVALUATIONS FOLDER | NAME N EVALUATIONS".into()),
    };
    let pairs: Vec<String> = trace.iter().map(|(evaluations, cost)| format!("[{evaluations}, {cost:e}]")).collect();
    println!("[{}]", pairs.join(", "));
    Ok(())
}
