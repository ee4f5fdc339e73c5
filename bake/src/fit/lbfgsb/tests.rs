//! Known optima: free, bounded, at corners; the contract on errors.

use super::*;
use argmin::core::Executor;
use std::cell::Cell;

/// A function by its closure.
struct Function<F>(F);

impl<F: Fn(&[f64], &mut [f64]) -> f64> CostGradient for Function<F> {
    fn cost_gradient(&self, x: &[f64], gradient: &mut [f64]) -> f64 {
        (self.0)(x, gradient)
    }
}

fn minimise(
    f: impl Fn(&[f64], &mut [f64]) -> f64,
    x: Vec<f64>,
    lower: Vec<f64>,
    upper: Vec<f64>,
) -> Result<(Vec<f64>, f64, usize), Error> {
    let solver = Lbfgsb::new(lower, upper, 10)?.gradient_tolerance(1e-9).cost_tolerance(0.0, 0.0);
    let result =
        Executor::new(Function(f), solver).configure(|s: State| s.param(x).max_iters(5000)).timer(false).run()?;
    let best = result.state.param.clone().unwrap_or_default();
    Ok((best, result.state.cost, result.solver.evaluations()))
}

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

const INF: f64 = f64::INFINITY;

/// Close to a minimum the error is about the gradient's tolerance over the smallest curvature, here above 0.3.
const NEAR: f64 = 1e-6;

fn assert_near(found: &[f64], truth: &[f64]) {
    found.iter().zip(truth).for_each(|(f, t)| assert!((f - t).abs() < NEAR, "{found:?} {truth:?}"));
}

#[test]
fn rosenbrock_without_bounds_ends_at_one() {
    let (x, f, evaluations) = minimise(rosenbrock, vec![-1.2, 1.0], vec![-INF; 2], vec![INF; 2]).unwrap();
    assert_near(&x, &[1.0, 1.0]);
    assert!(f < 1e-15 && evaluations < 60, "{f} after {evaluations}");
}

#[test]
fn rosenbrock_with_an_active_bound_ends_on_it() {
    // With x <= 0.8 the minimum lies at x = 0.8, y = x^2, f = 0.2^2.
    let (x, f, _) = minimise(rosenbrock, vec![-1.2, 1.0], vec![-INF; 2], vec![0.8, INF]).unwrap();
    assert_near(&x, &[0.8, 0.64]);
    assert!((f - 0.04).abs() < 1e-12);
}

#[test]
fn rosenbrock_confined_to_a_box_ends_in_its_corner() {
    // In [1.5, 2] x [-1, 1] both partial derivatives keep their sign: the corner (1.5, 1).
    let (x, f, _) = minimise(rosenbrock, vec![2.0, -1.0], vec![1.5, -1.0], vec![2.0, 1.0]).unwrap();
    assert_eq!(x, [1.5, 1.0]);
    assert_eq!(f, rosenbrock(&[1.5, 1.0], &mut [0.0; 2]));
}

#[test]
fn a_start_at_a_bound_leaves_it_and_a_start_outside_is_brought_in() {
    let bounds = (vec![-2.0, -2.0], vec![2.0, 2.0]);
    let (x, ..) = minimise(rosenbrock, vec![-2.0, 2.0], bounds.0.clone(), bounds.1.clone()).unwrap();
    assert_near(&x, &[1.0, 1.0]);
    let (x, ..) = minimise(rosenbrock, vec![-50.0, 70.0], bounds.0, bounds.1).unwrap();
    assert_near(&x, &[1.0, 1.0]);
}

#[test]
fn a_fixed_variable_stays_bit_for_bit() {
    let (x, ..) = minimise(rosenbrock, vec![0.3, 5.0], vec![0.3, -INF], vec![0.3, INF]).unwrap();
    assert_eq!(x[0], 0.3);
    assert_near(&x, &[0.3, 0.09]);
}

/// The sample problem of the original package (driver 1), n = 25: `f = (x0 - 1)^2 + 4 sum (xi - x(i-1)^2)^2`, optimum 0.
#[test]
fn the_sample_problem_of_the_original_code_is_solved() {
    let f = |x: &[f64], g: &mut [f64]| {
        g.fill(0.0);
        let mut f = (x[0] - 1.0).powi(2);
        g[0] = 2.0 * (x[0] - 1.0);
        for i in 1..x.len() {
            let t = x[i] - x[i - 1] * x[i - 1];
            f += 4.0 * t * t;
            g[i] += 8.0 * t;
            g[i - 1] -= 16.0 * x[i - 1] * t;
        }
        f
    };
    let lower = (0..25).map(|i| if i % 2 == 0 { 1.0 } else { -100.0 }).collect();
    let (x, f, evaluations) = minimise(f, vec![3.0; 25], lower, vec![100.0; 25]).unwrap();
    // The printed run of the package: about 1.08e-9 after 27 evaluations at a looser tolerance; here to the end.
    assert!(f < 1e-12 && evaluations < 120, "{f} after {evaluations}");
    assert!((x[0] - 1.0).abs() < 1e-6);
}

#[test]
fn a_thousand_variables_of_the_paired_rosenbrock_function_are_solved() {
    let f = |x: &[f64], g: &mut [f64]| {
        (0..x.len() / 2).map(|p| rosenbrock(&x[2 * p..2 * p + 2], &mut g[2 * p..2 * p + 2])).sum()
    };
    let start = (0..1000).map(|i| if i % 2 == 0 { -1.2 } else { 1.0 }).collect();
    let (x, f, evaluations) = minimise(f, start, vec![-INF; 1000], vec![INF; 1000]).unwrap();
    assert_near(&x, &vec![1.0; 1000]);
    assert!(f < 1e-12 && evaluations < 80, "{f} after {evaluations}");
}

/// A convex quadratic with condition 100 and random bounds, against projected gradient descent (a contraction of
/// 1 - 1/100 an iteration: 1e-13 of the way left after 3000).
#[test]
fn random_bounded_quadratics_agree_with_projected_gradient_descent() {
    let mut state = 99u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
    };
    for _ in 0..20 {
        let n = 12;
        let v: Vec<f64> = (0..n).map(|_| random()).collect();
        let vv = dot(&v, &v);
        let diagonal: Vec<f64> = (0..n).map(|i| 1.0 + 99.0 * i as f64 / (n - 1) as f64).collect();
        // H = R D R with the reflection R = I - 2 v v^T / v^T v.
        let reflect = |x: &[f64]| -> Vec<f64> {
            let t = 2.0 * dot(&v, x) / vv;
            x.iter().zip(&v).map(|(x, v)| x - t * v).collect()
        };
        let b: Vec<f64> = (0..n).map(|_| 20.0 * random()).collect();
        let gradient = |x: &[f64]| -> Vec<f64> {
            let r: Vec<f64> = reflect(x).iter().zip(&diagonal).map(|(x, d)| x * d).collect();
            reflect(&r).iter().zip(&b).map(|(h, b)| h - b).collect()
        };
        let lower: Vec<f64> = (0..n).map(|_| random() - 0.5).collect();
        let upper: Vec<f64> = lower.iter().map(|l| l + random() + 1.0).collect();
        let f = |x: &[f64], g: &mut [f64]| {
            g.copy_from_slice(&gradient(x));
            0.5 * (dot(g, x) - dot(&b, x))
        };
        let (found, ..) = minimise(f, vec![0.0; n], lower.clone(), upper.clone()).unwrap();
        let mut truth = lower.clone();
        for _ in 0..3000 {
            let g = gradient(&truth);
            (0..n).for_each(|i| truth[i] = (truth[i] - g[i] / 100.0).clamp(lower[i], upper[i]));
        }
        assert_near(&found, &truth);
        assert!(truth.iter().enumerate().any(|(i, t)| *t == lower[i] || *t == upper[i]), "no bound is active");
    }
}

#[test]
fn the_cost_never_rises_from_one_iteration_to_the_next() {
    let solver = Lbfgsb::new(vec![-1.5; 10], vec![1.5; 10], 5).unwrap();
    let problem = Function(rosenbrock);
    let mut result =
        Executor::new(problem, solver).configure(|s: State| s.param(vec![-1.2; 10]).max_iters(1)).run().unwrap();
    for _ in 0..200 {
        let before = result.state.cost;
        let (x, g) = (result.state.take_param().unwrap(), result.state.take_gradient().unwrap());
        let problem = result.problem.take_problem().unwrap();
        result = Executor::new(problem, result.solver)
            .configure(|s: State| s.param(x).gradient(g).cost(before).max_iters(1))
            .run()
            .unwrap();
        assert!(result.state.cost <= before);
    }
    assert!(result.state.cost < 1e-6, "{}", result.state.cost);
}

#[test]
fn a_cost_that_is_not_a_number_is_a_typed_error() {
    let calls = Cell::new(0);
    let late = |x: &[f64], g: &mut [f64]| {
        calls.set(calls.get() + 1);
        let f = rosenbrock(x, g);
        if calls.get() > 5 { f64::NAN } else { f }
    };
    for error in [
        minimise(|_, _| f64::NAN, vec![0.0; 2], vec![-INF; 2], vec![INF; 2]).unwrap_err(),
        minimise(late, vec![-1.2, 1.0], vec![-INF; 2], vec![INF; 2]).unwrap_err(),
    ] {
        assert!(matches!(error.downcast_ref(), Some(LbfgsbError::NotFinite { .. })), "{error}");
    }
    assert!(calls.get() < 30);
}

#[test]
fn a_cost_that_is_infinite_far_out_is_stepped_around() {
    // -ln(1 - x) - ln(x) + 3 x: finite in (0, 1), no bounds told.
    let f = |x: &[f64], g: &mut [f64]| {
        g[0] = 1.0 / (1.0 - x[0]) - 1.0 / x[0] + 3.0;
        -(1.0 - x[0]).ln() - x[0].ln() + 3.0 * x[0]
    };
    let (x, ..) = minimise(f, vec![0.99], vec![-INF], vec![INF]).unwrap();
    // 3 x^2 - 5 x + 1 = 0.
    assert_near(&x, &[(5.0 - 13f64.sqrt()) / 6.0]);
}

#[test]
fn bounds_that_cross_or_are_not_numbers_are_refused() {
    assert!(Lbfgsb::new(vec![1.0], vec![0.0], 5).is_err());
    assert!(Lbfgsb::new(vec![f64::NAN], vec![0.0], 5).is_err());
    assert!(Lbfgsb::new(vec![0.0], vec![], 5).is_err());
}

#[test]
fn rescaling_the_variables_in_the_middle_changes_nothing_but_the_path() {
    let ratio = [3.0, 0.2];
    let solver = Lbfgsb::new(vec![-INF; 2], vec![INF; 2], 10).unwrap();
    let start = |s: State| s.param(vec![-1.2, 1.0]).max_iters(12);
    let mut first = Executor::new(Function(rosenbrock), solver).configure(start).run().unwrap();
    let (x, g) = (first.state.take_param().unwrap(), first.state.take_gradient().unwrap());
    first.solver.rescale(&ratio, vec![-INF; 2], vec![INF; 2]);
    let scaled = Function(|z: &[f64], g: &mut [f64]| {
        let f = rosenbrock(&[z[0] / ratio[0], z[1] / ratio[1]], g);
        (0..2).for_each(|i| g[i] /= ratio[i]);
        f
    });
    let z = vec![x[0] * ratio[0], x[1] * ratio[1]];
    let gz = vec![g[0] / ratio[0], g[1] / ratio[1]];
    let cost = first.state.cost;
    let second = Executor::new(scaled, first.solver)
        .configure(|s: State| s.param(z).gradient(gz).cost(cost).max_iters(60))
        .run()
        .unwrap();
    let z = second.state.param.clone().unwrap();
    assert!((z[0] / 3.0 - 1.0).abs() < 1e-3 && second.solver.evaluations() < 60);
}
