//! The objective against its definition, its gradient against differences.

use super::*;
use smoke_formats::gaussian::Gaussian;
use smoke_formats::volume::VoxelMask;
use smoke_runtime::medium::gaussian_sum::gaussian_sum;

fn grid(dims: [usize; 3], value: impl Fn([usize; 3]) -> f32) -> (DensityGrid, UnitSpace) {
    let [nx, ny, nz] = dims;
    let values: Vec<f32> = (0..nx * ny * nz).map(|v| value([v % nx, v / nx % ny, v / (nx * ny)])).collect();
    let (active, origin) = (VoxelMask::new(values.len()), [-3, 5, 9]);
    let space = UnitSpace::of_box(origin, dims.map(|d| d as u32));
    let name = "density".to_owned();
    (DensityGrid { name, origin, dims, values, active, world_from_index: Default::default() }, space)
}

/// A blob with ripples and empty corners, peak 40.
fn blob() -> (DensityGrid, UnitSpace) {
    grid([40, 30, 20], |[i, j, k]| {
        let r2 = (i as f32 - 20.0).powi(2) + (j as f32 - 15.0).powi(2) + (k as f32 - 10.0).powi(2);
        (40.0 * (-r2 / 80.0).exp() * (1.0 + 0.2 * (i as f32).sin()) - 1.0).max(0.0)
    })
}

/// Gaussians inside, outside, at both bounds of radius and weight.
fn variables() -> Vec<f64> {
    let mut x = vec![
        [0.5, 0.4, 0.25, 0.09, 1.0],
        [0.45, 0.36, 0.2, 0.015, 0.5],
        [0.52, 0.31, 0.27, 0.04, 0.01],
        [-0.05, 0.4, 0.25, 0.08, 0.3],
        [0.3, 0.76, 0.25, 0.05, 0.7],
        [0.501, 0.401, 0.251, 0.085, 0.4],
    ];
    x.extend((0..8).map(|i| {
        let t = f64::from(i);
        [0.5 + 0.1 * t.sin(), 0.37 + 0.1 * (2.0 * t).cos(), 0.25 + 0.05 * t.cos(), 0.02 + 0.008 * t, 0.1 + 0.1 * t]
    }));
    x.concat()
}

/// The definition, in f64, with the f32 sums of the decoder.
fn brute(x: &[f64], grid: &DensityGrid, space: &UnitSpace, support: bool) -> f64 {
    let peak = grid.values.iter().copied().fold(0.0f32, f32::max);
    let gaussians: Vec<Gaussian> = x
        .chunks(5)
        .map(|g| {
            let [cx, cy, cz, radius, weight] = [g[0], g[1], g[2], g[3], g[4]].map(|v| v as f32);
            Gaussian { center: [cx, cy, cz], radius, weight }
        })
        .collect();
    let sum = gaussian_sum(&gaussians, space, grid.origin, grid.dims);
    let pairs = sum.iter().zip(&grid.values).map(|(s, d)| (f64::from(*s), f64::from(d / peak)));
    let error: f64 = pairs.clone().filter(|(_, d)| !support || *d > 0.0).map(|(s, d)| (s - d) * (s - d)).sum();
    error / pairs.map(|(_, d)| d * d).sum::<f64>()
}

#[test]
fn the_cost_equals_its_definition_with_the_decoders_sum_in_both_scopes() {
    let (grid, space) = blob();
    // Variables that f32 holds exactly, so that both see the same Gaussians.
    let x: Vec<f64> = variables().iter().map(|&v| f64::from(v as f32)).collect();
    let mut costs = Vec::new();
    for (scope, support) in [(Scope::Box, false), (Scope::Support, true)] {
        let objective = Objective::new(&grid, &space, scope).unwrap();
        let cost = objective.cost_gradient(&x, &mut vec![0.0; x.len()]);
        let truth = brute(&x, &grid, &space, support);
        // The differences are rounded to f32 here and not there: 2^-24 each, twice that in the square.
        assert!((cost - truth).abs() < 2f64.powi(-23) * truth, "{scope:?}: {cost} {truth}");
        costs.push(cost);
    }
    assert!(costs[1] < costs[0], "the kernels must reach outside the support");
}

/// Failures of the gradient against central differences, as a table.
fn failures(gradient: &[f64], x: &[f64], objective: &Objective) -> Vec<String> {
    let scale = gradient.iter().map(|g| g.abs()).sum::<f64>() / gradient.len() as f64;
    let mut none = vec![0.0; x.len()];
    let mut check = |k: usize| {
        // The step balances the third derivative, up to 300 / r^2 of the first, against f32 rounding of the field.
        let h = if k % VARIABLES == 4 { 1e-3 } else { 3e-3 * x[k - k % VARIABLES + 3] };
        let mut at = |d: f64| {
            let mut x = x.to_vec();
            x[k] += d;
            objective.cost_gradient(&x, &mut none)
        };
        let difference = (at(h) - at(-h)) / (2.0 * h);
        // Truncation: h^2 / 6 times the third derivative is up to 1e-5 / 6 * 300 = 5e-4 of the entry itself. The
        // cut's border moves with the radius: for a constant e its share of dE/dr is 3 exp(-9) 40 r^2 (area weighted
        // with B) over 3 pi^(3/2) r^2 = 9e-4, and more where e has the other sign there: 1e-2, and of the mean entry.
        let tolerance = 1e-2 * difference.abs() + 1e-2 * scale;
        let right = (gradient[k] - difference).abs() <= tolerance;
        (!right).then(|| format!("variable {k}: gradient {:e}, difference {difference:e}", gradient[k]))
    };
    (0..x.len()).filter_map(&mut check).collect()
}

#[test]
fn the_gradient_agrees_with_central_differences_and_a_wrong_one_does_not() {
    let (grid, space) = blob();
    for scope in [Scope::Box, Scope::Support] {
        let objective = Objective::new(&grid, &space, scope).unwrap();
        let x = variables();
        let mut gradient = vec![0.0; x.len()];
        objective.cost_gradient(&x, &mut gradient);
        let wrong = failures(&gradient, &x, &objective);
        assert!(wrong.is_empty(), "{scope:?}\n{}", wrong.join("\n"));
        // A planted defect: the radius' derivative without its factor of two.
        gradient.iter_mut().skip(3).step_by(VARIABLES).for_each(|g| *g *= 0.5);
        assert!(failures(&gradient, &x, &objective).len() >= 5);
    }
}

#[test]
fn one_thread_and_many_give_the_same_bits() {
    let (grid, space) = blob();
    let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
    let x = variables();
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut gradient = vec![0.0; x.len()];
        let cost = pool.install(|| objective.cost_gradient(&x, &mut gradient));
        (cost, gradient)
    };
    assert_eq!(run(1), run(7));
}

#[test]
fn the_scale_of_the_density_does_not_matter() {
    let (grid, space) = blob();
    let x = variables();
    let cost = |factor: f32| {
        let values = grid.values.iter().map(|v| v * factor).collect();
        let scaled = DensityGrid { values, ..grid.clone() };
        Objective::new(&scaled, &space, Scope::Box).unwrap().cost_gradient(&x, &mut vec![0.0; x.len()])
    };
    // Powers of two: the same bits.
    assert_eq!(cost(1.0), cost(2f32.powi(100)));
    assert_eq!(cost(1.0), cost(2f32.powi(-100)));
}

#[test]
fn an_empty_grid_has_no_objective_and_a_variable_that_is_not_a_number_gives_no_cost() {
    let (empty, space) = grid([3, 3, 3], |_| 0.0);
    assert!(Objective::new(&empty, &space, Scope::Box).is_none());
    let (grid, space) = blob();
    let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
    let mut x = variables();
    x[7] = f64::NAN;
    assert!(objective.cost_gradient(&x, &mut vec![0.0; x.len()]).is_nan());
}

#[test]
fn gain_and_loss_are_what_the_objective_does() {
    let (grid, space) = blob();
    let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
    let mut x = variables();
    let errors = objective.errors(&x);
    let (centre, radius) = ([0.62, 0.42, 0.27], 0.05);
    let (weight, gain) = errors.gain(centre, radius);
    assert!(weight > 0.05, "{weight}");
    x.extend([centre[0], centre[1], centre[2], radius, weight]);
    let after = objective.errors(&x);
    // The integral stands for the sum over voxels to 1e-6 at two voxels a radius; the cut takes exp(-18).
    assert!((errors.cost - after.cost - gain).abs() < 1e-4 * gain, "{} {gain}", errors.cost - after.cost);
    assert!((after.loss(radius, weight) - gain).abs() < 1e-4 * gain);
}
