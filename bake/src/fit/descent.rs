//! A minimisation of the objective under way: L-BFGS-B in rescaled variables, to be stopped, changed and continued.

use super::lbfgsb::{CostGradient, Lbfgsb, State};
use super::objective::{Objective, VARIABLES, natural_units};
use argmin::core::{Error, Executor};

/// The radii and weights that a fit may use, smallest and largest: positive, finite, in order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// In unit space.
    pub radius: [f64; 2],
    /// Over the largest density.
    pub weight: [f64; 2],
}

impl Bounds {
    /// The nearest radius inside.
    pub fn radius(&self, radius: f64) -> f64 {
        radius.clamp(self.radius[0], self.radius[1])
    }

    /// The nearest weight inside.
    pub fn weight(&self, weight: f64) -> f64 {
        weight.clamp(self.weight[0], self.weight[1])
    }

    /// Brings variables inside.
    fn confine(&self, x: &mut [f64]) {
        for g in x.chunks_mut(VARIABLES) {
            (g[3], g[4]) = (self.radius(g[3]), self.weight(g[4]));
        }
    }

    /// The bounds of variables measured in `units`, lower and upper.
    fn scaled(&self, units: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let of = |k: usize| match k % VARIABLES {
            3 => self.radius,
            4 => self.weight,
            _ => [f64::NEG_INFINITY, f64::INFINITY],
        };
        units.iter().enumerate().map(|(k, u)| (of(k)[0] / u, of(k)[1] / u)).unzip()
    }
}

/// The objective in variables `z = x / unit`.
struct Scaled<'a> {
    objective: &'a Objective,
    units: &'a [f64],
}

impl CostGradient for Scaled<'_> {
    fn cost_gradient(&self, z: &[f64], gradient: &mut [f64]) -> f64 {
        let x: Vec<f64> = z.iter().zip(self.units).map(|(z, u)| z * u).collect();
        let cost = self.objective.cost_gradient(&x, gradient);
        gradient.iter_mut().zip(self.units).for_each(|(g, u)| *g *= u);
        cost
    }
}

/// Variables, cost, gradient and the solver that moves them.
pub struct Descent<'a> {
    objective: &'a Objective,
    bounds: Bounds,
    solver: Lbfgsb,
    units: Vec<f64>,
    /// Per Gaussian: centre, radius, weight.
    pub x: Vec<f64>,
    gradient: Vec<f64>,
    /// The objective at `x`.
    pub cost: f64,
    /// Iterations so far.
    pub iterations: u64,
    finished: bool,
    /// Evaluations outside the solver.
    extra: usize,
}

impl<'a> Descent<'a> {
    /// A minimisation from `x` inside `bounds`, with `memory` pairs, of at most `evaluations` of the objective.
    pub fn new(
        objective: &'a Objective,
        x: Vec<f64>,
        bounds: Bounds,
        memory: usize,
        tolerance: f64,
        evaluations: usize,
    ) -> Result<Self, Error> {
        let units = natural_units(&x, objective);
        let (lower, upper) = bounds.scaled(&units);
        let solver = Lbfgsb::new(lower, upper, memory)?
            .gradient_tolerance(1e-9)
            .cost_tolerance(tolerance, 0.0)
            .max_evaluations(evaluations)
            .first_step(0.5);
        let mut new = Self {
            objective,
            bounds,
            solver,
            units,
            x,
            gradient: Vec::new(),
            cost: 0.0,
            iterations: 0,
            finished: false,
            extra: 0,
        };
        new.run(0)?;
        Ok(new)
    }

    /// Evaluations of the objective so far.
    pub fn evaluations(&self) -> usize {
        self.solver.evaluations() + self.extra
    }

    /// Goes on for at most so many iterations; false once the solver has nothing more to do.
    pub fn advance(&mut self, iterations: u64) -> Result<bool, Error> {
        if !self.finished {
            self.run(iterations)?;
        }
        Ok(!self.finished)
    }

    fn run(&mut self, iterations: u64) -> Result<(), Error> {
        let problem = Scaled { objective: self.objective, units: &self.units };
        let z = self.x.iter().zip(&self.units).map(|(x, u)| x / u).collect();
        let gradient: Vec<f64> = self.gradient.iter().zip(&self.units).map(|(g, u)| g * u).collect();
        let executor = Executor::new(problem, self.solver.clone()).timer(false).configure(|s: State| {
            let s = s.param(z).max_iters(iterations);
            if gradient.is_empty() { s } else { s.gradient(gradient).cost(self.cost) }
        });
        let mut result = executor.run()?;
        self.finished = result.solver.finished();
        self.iterations += result.state.iter;
        self.cost = result.state.cost;
        let z = result.state.take_param().unwrap_or_default();
        let gradient = result.state.take_gradient().unwrap_or_default();
        self.x = z.iter().zip(&self.units).map(|(z, u)| z * u).collect();
        // The rounding of scaled bounds.
        self.bounds.confine(&mut self.x);
        self.gradient = gradient.iter().zip(&self.units).map(|(g, u)| g / u).collect();
        self.solver = result.solver;
        Ok(())
    }

    /// The objective.
    pub fn objective(&self) -> &'a Objective {
        self.objective
    }

    /// The bounds.
    pub fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Puts the variables of some Gaussians where they are in `x`, if that lowers the cost; tells whether it did.
    ///
    /// The memory keeps what it knows of all other variables. Costs one evaluation.
    pub fn try_move(&mut self, x: Vec<f64>, moved: &[usize]) -> bool {
        let mut gradient = vec![0.0; x.len()];
        let cost = self.objective.cost_gradient(&x, &mut gradient);
        self.extra += 1;
        let lower = cost < self.cost;
        if !lower {
            return false;
        }
        (self.x, self.gradient, self.cost, self.finished) = (x, gradient, cost, false);
        let variables: Vec<usize> = moved.iter().flat_map(|g| g * VARIABLES..(g + 1) * VARIABLES).collect();
        self.solver.forget(&variables);
        self.rescale();
        true
    }

    /// Adds Gaussians, if that lowers the cost; tells whether it did. Costs one evaluation.
    pub fn try_insert(&mut self, gaussians: &[[f64; VARIABLES]]) -> bool {
        let mut x = self.x.clone();
        x.extend(gaussians.as_flattened());
        let mut gradient = vec![0.0; x.len()];
        let cost = self.objective.cost_gradient(&x, &mut gradient);
        self.extra += 1;
        let lower = cost < self.cost;
        if !lower {
            return false;
        }
        (self.x, self.gradient, self.cost, self.finished) = (x, gradient, cost, false);
        let units = natural_units(gaussians.as_flattened(), self.objective);
        let (lower, upper) = self.bounds.scaled(&units);
        self.units.extend(units);
        self.solver.append(&lower, &upper);
        true
    }

    /// Allows `evaluations` more.
    pub fn allow(&mut self, evaluations: usize) {
        self.solver.allow(self.solver.evaluations() + evaluations);
        self.finished = false;
    }

    /// Measures the variables in the units that are natural where they are now; the memory is carried over.
    pub fn rescale(&mut self) {
        let old = std::mem::replace(&mut self.units, natural_units(&self.x, self.objective));
        let ratio: Vec<f64> = old.iter().zip(&self.units).map(|(old, new)| old / new).collect();
        let (lower, upper) = self.bounds.scaled(&self.units);
        self.solver.rescale(&ratio, lower, upper);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::initial::initial;
    use crate::fit::objective::Scope;
    use smoke_formats::gaussian::UnitSpace;
    use smoke_formats::volume::{DensityGrid, VoxelMask};

    const BOUNDS: Bounds = Bounds { radius: [0.03, 0.1], weight: [0.05, 0.9] };

    /// A ball of radius 8 in 24 voxels, dense at its rim, and where a fit of it starts.
    fn ball() -> (Objective, Vec<f64>) {
        let side = 24usize;
        let value = |v: usize| {
            let square: f32 =
                [v % side, v / side % side, v / (side * side)].map(|i| (i as f32 - 11.5).powi(2)).iter().sum();
            if square < 64.0 { 0.3 + square / 100.0 } else { 0.0 }
        };
        let values: Vec<f32> = (0..side.pow(3)).map(value).collect();
        let (active, name) = (VoxelMask::new(values.len()), "density".to_owned());
        let world_from_index = Default::default();
        let grid = DensityGrid { name, origin: [0; 3], dims: [side; 3], values, active, world_from_index };
        let objective = Objective::new(&grid, &UnitSpace::of_box([0; 3], [side as u32; 3]), Scope::Box).unwrap();
        let x = initial(&grid, &objective, 12, &BOUNDS);
        (objective, x)
    }

    #[test]
    fn the_cost_is_that_of_the_variables_after_every_step_and_change() {
        let (objective, x) = ball();
        let mut descent = Descent::new(&objective, x, BOUNDS, 10, 0.0, 500).unwrap();
        let (mut last, mut evaluations) = (descent.cost, descent.evaluations());
        assert_eq!(evaluations, 1);
        for round in 0..6 {
            descent.advance(5).unwrap();
            match round {
                1 | 4 => descent.rescale(),
                2 => assert!(descent.try_insert(&[[0.5, 0.5, 0.2, 0.05, 0.2]])),
                3 => {
                    let mut x = descent.x.clone();
                    x[4] *= 0.99;
                    let before = (descent.cost, descent.x.clone());
                    let moved = descent.try_move(x, &[0]);
                    assert!(moved == (descent.cost < before.0) && (moved || descent.x == before.1));
                }
                _ => (),
            }
            assert!(descent.cost <= last && descent.evaluations() > evaluations);
            (last, evaluations) = (descent.cost, descent.evaluations());
            // Units are divided out and multiplied in again: a few rounding steps of f64, of which f32 sees little.
            let again = objective.cost_gradient(&descent.x, &mut vec![0.0; descent.x.len()]);
            assert!((again / last - 1.0).abs() < 1e-6, "{again} {last}");
            for g in descent.x.chunks(VARIABLES) {
                assert_eq!((g[3], g[4]), (BOUNDS.radius(g[3]), BOUNDS.weight(g[4])));
            }
        }
        assert_eq!(descent.x.len(), 13 * VARIABLES);
    }

    #[test]
    fn it_ends_at_the_limit_of_evaluations_and_goes_on_when_more_are_allowed() {
        let (objective, x) = ball();
        let mut descent = Descent::new(&objective, x, BOUNDS, 10, 0.0, 10).unwrap();
        assert!(!descent.advance(100).unwrap());
        let (evaluations, cost) = (descent.evaluations(), descent.cost);
        // An iteration that has begun is finished: at most 20 evaluations of a line search.
        assert!((10..30).contains(&evaluations));
        assert!(!descent.advance(100).unwrap());
        assert_eq!(descent.evaluations(), evaluations);
        descent.allow(10);
        descent.advance(100).unwrap();
        assert!(descent.evaluations() > evaluations && descent.cost < cost);
    }

    #[test]
    fn a_gaussian_that_does_not_help_is_not_inserted() {
        let (objective, x) = ball();
        let mut descent = Descent::new(&objective, x, BOUNDS, 10, 0.0, 10).unwrap();
        let (x, cost) = (descent.x.clone(), descent.cost);
        assert!(!descent.try_insert(&[[0.05, 0.05, 0.05, 0.1, 0.9]]));
        assert_eq!((descent.x, descent.cost), (x, cost));
    }
}
