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
            .cost_tolerance(tolerance)
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
        self.finished = iterations > 0 && result.state.iter < iterations;
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
