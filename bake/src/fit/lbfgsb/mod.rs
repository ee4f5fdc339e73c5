//! L-BFGS-B: minimises a smooth function under bounds, as an [`argmin`] solver.
//!
//! Per iteration: the generalised Cauchy point along the projected gradient (`cauchy`), the minimum of the quadratic
//! model over the variables that are free there (`subspace`), and a Moré–Thuente search towards it
//! (`line_search`). Byrd, Lu, Nocedal, Zhu 1995 (SIAM J. Sci. Comput. 16, 1190); the projection of the subspace
//! minimum is that of version 3.0 (Morales, Nocedal 2011, ACM TOMS 38). About `20 m n` operations beside the objective.
//!
//! A cost or gradient that is not finite is an error at the start; in a line search the step is cut tenfold instead,
//! at most 10 times, then it is an error too.

mod cauchy;
mod line_search;
mod linear;
mod memory;
mod subspace;

use argmin::core::{Error, IterState, KV, Problem, Solver, TerminationReason, TerminationStatus};
use line_search::{Search, Verdict};
use linear::dot;
use memory::Memory;

/// Steps shortened tenfold for a cost that is not finite, in one line search.
const MAX_RETREATS: usize = 10;

/// An objective that gives its cost and gradient in one pass.
pub trait CostGradient {
    /// The cost at `x`; writes the gradient. Both must be finite inside the bounds.
    fn cost_gradient(&self, x: &[f64], gradient: &mut [f64]) -> f64;
}

/// Why a minimisation failed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LbfgsbError {
    /// The objective is not finite where it has to be.
    #[error("the objective is not finite after {evaluations} evaluations: cost {cost}")]
    NotFinite {
        /// Evaluations so far.
        evaluations: usize,
        /// The cost; where it is finite the gradient is not.
        cost: f64,
    },
    /// The bounds do not fit the variables.
    #[error("bounds: {0}")]
    Bounds(String),
}

/// The state of the executor: variables, gradient, cost.
pub type State = IterState<Vec<f64>, Vec<f64>, (), (), (), f64>;

/// The solver; keeps its memory between runs, so that a run can be continued.
#[derive(Clone, Debug)]
pub struct Lbfgsb {
    lower: Vec<f64>,
    upper: Vec<f64>,
    memory: Memory,
    evaluations: usize,
    max_evaluations: usize,
    gradient_tolerance: f64,
    cost_tolerance: f64,
    cost_floor: f64,
    first_step: Option<f64>,
    finished: Option<&'static str>,
}

impl Lbfgsb {
    /// A solver between the bounds (infinite = none), with `memory` pairs: 5 to 30 are useful.
    pub fn new(lower: Vec<f64>, upper: Vec<f64>, memory: usize) -> Result<Self, LbfgsbError> {
        if lower.len() != upper.len() {
            return Err(LbfgsbError::Bounds(format!("{} lower and {} upper", lower.len(), upper.len())));
        }
        let ordered = |i: usize| lower[i] <= upper[i];
        if let Some(i) = (0..lower.len()).find(|&i| !ordered(i)) {
            return Err(LbfgsbError::Bounds(format!("variable {i}: lower {} and upper {}", lower[i], upper[i])));
        }
        Ok(Self {
            lower,
            upper,
            memory: Memory::new(memory),
            evaluations: 0,
            max_evaluations: usize::MAX,
            gradient_tolerance: 1e-5,
            cost_tolerance: 1e7 * f64::EPSILON,
            cost_floor: 1.0,
            first_step: None,
            finished: None,
        })
    }

    /// Stops when the projected gradient's largest entry is at most this (default 1e-5).
    pub fn gradient_tolerance(mut self, tolerance: f64) -> Self {
        self.gradient_tolerance = tolerance;
        self
    }

    /// Stops when an iteration lowers the cost by at most `tolerance * max(|before|, |after|, floor)` (default 2.2e-9
    /// and 1, as in the original code, which takes any cost below 1 for 1). The floor is 0 where small costs count.
    pub fn cost_tolerance(mut self, tolerance: f64, floor: f64) -> Self {
        (self.cost_tolerance, self.cost_floor) = (tolerance, floor);
        self
    }

    /// Starts no iteration after this many evaluations (default no limit).
    pub fn max_evaluations(mut self, evaluations: usize) -> Self {
        self.max_evaluations = evaluations;
        self
    }

    /// Length of the first step in units of the gradient, where the variables' scale is known; without it the first
    /// step has length 1.
    pub fn first_step(mut self, step: f64) -> Self {
        self.first_step = Some(step);
        self
    }

    /// Evaluations of the objective so far.
    pub fn evaluations(&self) -> usize {
        self.evaluations
    }

    /// Whether the last run ended by a test of the solver (converged, stuck, or out of evaluations), not by the
    /// executor's limit of iterations.
    pub fn finished(&self) -> bool {
        self.finished.is_some() || self.evaluations >= self.max_evaluations
    }

    /// Changes the unit of the variables: variable i is now worth `ratio[i]` times its old value.
    pub fn rescale(&mut self, ratio: &[f64], lower: Vec<f64>, upper: Vec<f64>) {
        self.memory.transform(|s, y| {
            s.iter_mut().zip(ratio).for_each(|(s, r)| *s *= r);
            y.iter_mut().zip(ratio).for_each(|(y, r)| *y /= r);
        });
        (self.lower, self.upper) = (lower, upper);
    }

    /// Forgets what the memory knows of some variables, and keeps the rest.
    pub fn forget(&mut self, variables: &[usize]) {
        self.memory.transform(|s, y| {
            for &i in variables {
                (s[i], y[i]) = (0.0, 0.0);
            }
        });
        self.finished = None;
    }

    /// Adds variables at the end, of which the memory knows nothing.
    pub fn append(&mut self, lower: &[f64], upper: &[f64]) {
        self.lower.extend(lower);
        self.upper.extend(upper);
        let n = self.lower.len();
        self.memory.transform(|s, y| {
            s.resize(n, 0.0);
            y.resize(n, 0.0);
        });
        self.finished = None;
    }

    /// Allows `evaluations` in all from now on.
    pub fn allow(&mut self, evaluations: usize) {
        self.max_evaluations = evaluations;
    }

    fn evaluate<O: CostGradient>(&mut self, problem: &mut Problem<O>, x: &[f64], g: &mut [f64]) -> Result<f64, Error> {
        self.evaluations += 1;
        problem.problem("cost_gradient_count", |o| Ok(o.cost_gradient(x, g)))
    }

    fn not_finite(&self, cost: f64) -> Error {
        LbfgsbError::NotFinite { evaluations: self.evaluations, cost }.into()
    }

    /// The largest entry of `P(x - g) - x`.
    fn projected_gradient(&self, x: &[f64], g: &[f64]) -> f64 {
        let entry = |i: usize| ((x[i] - g[i]).clamp(self.lower[i], self.upper[i]) - x[i]).abs();
        (0..x.len()).map(entry).fold(0.0, f64::max)
    }

    /// The longest multiple of `d` that stays inside the bounds.
    fn longest(&self, x: &[f64], d: &[f64]) -> f64 {
        let room = |i: usize| {
            let bound = if d[i] > 0.0 { self.upper[i] } else { self.lower[i] };
            if d[i] == 0.0 { f64::INFINITY } else { (bound - x[i]) / d[i] }
        };
        (0..x.len()).map(room).fold(1e10, f64::min).max(0.0)
    }
}

/// Evaluates `x + t d` until the search is done; gives the point, its gradient and its cost, or none without descent.
type Step = Option<(Vec<f64>, Vec<f64>, f64)>;

impl Lbfgsb {
    fn search<O: CostGradient>(
        &mut self,
        problem: &mut Problem<O>,
        (x, g, cost): (&[f64], &[f64], f64),
        target: &[f64],
    ) -> Result<Step, Error> {
        let d: Vec<f64> = target.iter().zip(x).map(|(t, x)| t - x).collect();
        let slope = dot(&d, g);
        let falling = slope < 0.0;
        if !falling {
            return Ok(None);
        }
        // Without memory the target is only a direction; its length means nothing unless the box gives it one
        // (L-BFGS-B: a first step of length 1, or to the Cauchy point where all variables are boxed).
        let fresh = self.memory.pairs() == 0;
        let finite = |bounds: &[f64]| bounds.iter().filter(|b| b.is_finite()).count();
        let (low, high) = (finite(&self.lower), finite(&self.upper));
        let first = match self.first_step {
            Some(step) if fresh => step.min(1.0),
            None if fresh && low.min(high) < x.len() => dot(&d, &d).sqrt().recip().min(1.0),
            _ => 1.0,
        };
        let longest = if fresh && low + high > 0 { 1.0 } else { self.longest(x, &d).max(1.0) };
        let mut search = Search::new(cost, slope, first, longest);
        let mut best: Step = None;
        let mut retreats = 0;
        loop {
            let t = search.step;
            let point: Vec<f64> = if t == 1.0 {
                target.to_vec()
            } else {
                (0..x.len()).map(|i| (x[i] + t * d[i]).clamp(self.lower[i], self.upper[i])).collect()
            };
            let mut gradient = vec![0.0; x.len()];
            let new = self.evaluate(problem, &point, &mut gradient)?;
            let slope_here = dot(&gradient, &d);
            if !(new.is_finite() && slope_here.is_finite()) {
                retreats += 1;
                if retreats > MAX_RETREATS {
                    return Err(self.not_finite(new));
                }
                search = Search::new(cost, slope, 0.1 * t, longest);
                continue;
            }
            let verdict = search.tell(new, slope_here);
            // An accepted point has the curvature that the memory needs; otherwise the lowest cost counts.
            if verdict == Verdict::Accept && new < cost || new < best.as_ref().map_or(cost, |b| b.2) {
                best = Some((point, gradient, new));
            }
            if verdict != Verdict::Continue {
                return Ok(best);
            }
        }
    }
}

impl<O: CostGradient> Solver<O, State> for Lbfgsb {
    fn name(&self) -> &str {
        "L-BFGS-B"
    }

    fn init(&mut self, problem: &mut Problem<O>, mut state: State) -> Result<(State, Option<KV>), Error> {
        let mut x = state.take_param().ok_or_else(|| LbfgsbError::Bounds("no starting point".into()))?;
        if x.len() != self.lower.len() {
            let message = format!("{} variables and {} bounds", x.len(), self.lower.len());
            return Err(LbfgsbError::Bounds(message).into());
        }
        self.finished = None;
        let (gradient, cost) = match state.take_gradient() {
            // A run that goes on from where another stopped.
            Some(gradient) if state.cost.is_finite() => (gradient, state.cost),
            _ => {
                x.iter_mut().zip(self.lower.iter().zip(&self.upper)).for_each(|(x, (&l, &u))| *x = x.clamp(l, u));
                let mut gradient = vec![0.0; x.len()];
                let cost = self.evaluate(problem, &x, &mut gradient)?;
                (gradient, cost)
            }
        };
        if !(cost.is_finite() && gradient.iter().all(|g| g.is_finite())) {
            return Err(self.not_finite(cost));
        }
        if self.projected_gradient(&x, &gradient) <= self.gradient_tolerance {
            self.finished = Some("the projected gradient vanishes");
        }
        Ok((state.param(x).gradient(gradient).cost(cost), None))
    }

    fn next_iter(&mut self, problem: &mut Problem<O>, mut state: State) -> Result<(State, Option<KV>), Error> {
        let missing = || LbfgsbError::Bounds("the state lost its point".into());
        let x = state.take_param().ok_or_else(missing)?;
        let g = state.take_gradient().ok_or_else(missing)?;
        let cost = state.cost;
        let bounds = (&self.lower[..], &self.upper[..]);
        let bounded = bounds.0.iter().chain(bounds.1).any(|b| b.is_finite());
        let cauchy = if bounded || self.memory.pairs() == 0 {
            cauchy::cauchy_point(&x, &g, bounds.0, bounds.1, &self.memory)
        } else {
            // Without bounds the subspace is the whole space, whose minimum does not depend on where it is sought from.
            cauchy::Cauchy { point: x.clone(), c: vec![0.0; 2 * self.memory.pairs()] }
        };
        let target = subspace::subspace_point(&x, &g, bounds, &self.memory, cauchy);
        match self.search(problem, (&x, &g, cost), &target)? {
            Some((point, gradient, new)) => {
                if !gradient.iter().all(|g| g.is_finite()) {
                    return Err(self.not_finite(new));
                }
                let s = point.iter().zip(&x).map(|(p, x)| p - x).collect();
                let y = gradient.iter().zip(&g).map(|(p, g)| p - g).collect();
                self.memory.push(s, y);
                if self.projected_gradient(&point, &gradient) <= self.gradient_tolerance {
                    self.finished = Some("the projected gradient vanishes");
                } else if cost - new <= self.cost_tolerance * cost.abs().max(new.abs()).max(self.cost_floor) {
                    self.finished = Some("the cost falls no more");
                }
                Ok((state.param(point).gradient(gradient).cost(new), None))
            }
            None => {
                // A direction without descent: start again from the gradient; if that fails too, this is the end.
                if self.memory.pairs() == 0 {
                    self.finished = Some("no descent along the gradient");
                }
                self.memory.clear();
                Ok((state.param(x).gradient(g).cost(cost), None))
            }
        }
    }

    fn terminate(&mut self, _state: &State) -> TerminationStatus {
        match self.finished {
            Some(reason) => TerminationStatus::Terminated(TerminationReason::SolverExit(reason.into())),
            None if self.evaluations >= self.max_evaluations => {
                TerminationStatus::Terminated(TerminationReason::MaxItersReached)
            }
            None => TerminationStatus::NotTerminated,
        }
    }
}

#[cfg(test)]
mod tests;
