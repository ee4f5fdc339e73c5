//! The line search of Moré and Thuente 1994 (ACM TOMS 20, 286): a step with sufficient decrease
//! `f(t) <= f(0) + 1e-3 t f'(0)` and curvature `|f'(t)| <= 0.9 |f'(0)|`.
//!
//! Ask [`Search::step`], evaluate there, tell [`Search::tell`]; it answers within [`MAX_EVALUATIONS`].

/// Sufficient decrease (the values of L-BFGS-B 3.0).
const DECREASE: f64 = 1e-3;
/// Curvature.
const CURVATURE: f64 = 0.9;
/// Relative width of the interval below which the search stops.
const WIDTH: f64 = 0.1;
/// Evaluations after which the search gives up.
pub(super) const MAX_EVALUATIONS: usize = 20;

/// One end of the interval.
#[derive(Clone, Copy, Debug)]
struct Trial {
    step: f64,
    cost: f64,
    slope: f64,
}

/// What to do next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Verdict {
    /// Evaluate at the new [`Search::step`].
    Continue,
    /// The last step holds both conditions.
    Accept,
    /// No further progress; the last step may still be a decrease.
    Stop,
}

/// A search under way.
pub(super) struct Search {
    /// Where to evaluate next.
    pub step: f64,
    longest: f64,
    start: Trial,
    best: Trial,
    other: Trial,
    bracketed: bool,
    first_stage: bool,
    limits: (f64, f64),
    width: f64,
    wider: f64,
    evaluations: usize,
}

impl Search {
    /// A search from cost and slope (`< 0`) at zero, trying `step` first, never beyond `longest`.
    pub fn new(cost: f64, slope: f64, step: f64, longest: f64) -> Self {
        let start = Trial { step: 0.0, cost, slope };
        Self {
            step,
            longest,
            start,
            best: start,
            other: start,
            bracketed: false,
            first_stage: true,
            limits: (0.0, step * 5.0),
            width: longest,
            wider: 2.0 * longest,
            evaluations: 0,
        }
    }

    /// Takes finite cost and slope at [`Search::step`].
    pub fn tell(&mut self, cost: f64, slope: f64) -> Verdict {
        self.evaluations += 1;
        let now = Trial { step: self.step, cost, slope };
        let test = DECREASE * self.start.slope;
        let enough = self.start.cost + self.step * test;
        if self.first_stage && cost <= enough && slope >= 0.0 {
            self.first_stage = false;
        }
        if cost <= enough && slope.abs() <= CURVATURE * -self.start.slope {
            return Verdict::Accept;
        }
        let stuck = self.bracketed
            && (self.step <= self.limits.0
                || self.step >= self.limits.1
                || self.limits.1 - self.limits.0 <= WIDTH * self.limits.1);
        let at_longest = self.step == self.longest && cost <= enough && slope <= test;
        if stuck || at_longest || self.evaluations >= MAX_EVALUATIONS {
            return Verdict::Stop;
        }
        if self.first_stage && cost <= self.best.cost && cost > enough {
            // Far from the minimum the auxiliary function f(t) - t * test leads to sufficient decrease.
            let tilt = |t: Trial, by: f64| Trial { cost: t.cost - t.step * by, slope: t.slope - by, ..t };
            let (mut best, mut other) = (tilt(self.best, test), tilt(self.other, test));
            self.step = narrow(&mut best, &mut other, tilt(now, test), &mut self.bracketed, self.limits);
            (self.best, self.other) = (tilt(best, -test), tilt(other, -test));
        } else {
            self.step = narrow(&mut self.best, &mut self.other, now, &mut self.bracketed, self.limits);
        }
        let (best, other) = (self.best.step, self.other.step);
        if self.bracketed {
            if (other - best).abs() >= 0.66 * self.wider {
                self.step = best + 0.5 * (other - best);
            }
            self.wider = self.width;
            self.width = (other - best).abs();
            self.limits = (best.min(other), best.max(other));
        } else {
            self.limits = (self.step + 1.1 * (self.step - best), self.step + 4.0 * (self.step - best));
        }
        self.step = self.step.clamp(0.0, self.longest);
        let (lo, hi) = self.limits;
        if self.bracketed && (self.step <= lo || self.step >= hi || hi - lo <= WIDTH * hi) {
            self.step = best;
        }
        Verdict::Continue
    }
}

/// The safeguarded step of Moré and Thuente (section 4, cases 1 to 4), and the new interval.
fn narrow(best: &mut Trial, other: &mut Trial, now: Trial, bracketed: &mut bool, (lo, hi): (f64, f64)) -> f64 {
    let (b, t) = (*best, now);
    let along = t.step - b.step;
    let sign = t.slope * b.slope.signum();
    let theta = 3.0 * (b.cost - t.cost) / along + b.slope + t.slope;
    let size = theta.abs().max(b.slope.abs()).max(t.slope.abs());
    let root = size * ((theta / size).powi(2) - (b.slope / size) * (t.slope / size)).max(0.0).sqrt();
    let secant = t.step + t.slope / (t.slope - b.slope) * (b.step - t.step);
    let step;
    if t.cost > b.cost {
        // A higher cost: the minimum is bracketed; the cubic step if closer to the best, else halfway to the quadratic.
        let gamma = root * along.signum();
        let r = (gamma - b.slope + theta) / (2.0 * gamma - b.slope + t.slope);
        let cubic = b.step + r * along;
        let quadratic = b.step + b.slope / ((b.cost - t.cost) / along + b.slope) / 2.0 * along;
        let cubic_is_closer = (cubic - b.step).abs() < (quadratic - b.step).abs();
        step = if cubic_is_closer { cubic } else { cubic + (quadratic - cubic) / 2.0 };
        *bracketed = true;
    } else if sign < 0.0 {
        // A lower cost and slopes of opposite sign: bracketed; the one of cubic and secant farther from here.
        let gamma = root * -along.signum();
        let r = (gamma - t.slope + theta) / (2.0 * gamma - t.slope + b.slope);
        let cubic = t.step + r * (b.step - t.step);
        step = if (cubic - t.step).abs() > (secant - t.step).abs() { cubic } else { secant };
        *bracketed = true;
    } else if t.slope.abs() < b.slope.abs() {
        // A lower cost, the slope flatter: the cubic only if it tends to infinity along the step or ends beyond it.
        let gamma = root * -along.signum();
        let r = (gamma - t.slope + theta) / (gamma + (b.slope - t.slope) + gamma);
        let cubic = if r < 0.0 && gamma != 0.0 {
            t.step + r * (b.step - t.step)
        } else if along > 0.0 {
            hi
        } else {
            lo
        };
        if *bracketed {
            let nearer = (cubic - t.step).abs() < (secant - t.step).abs();
            let raw = if nearer { cubic } else { secant };
            let limit = t.step + 0.66 * (other.step - t.step);
            step = if along > 0.0 { raw.min(limit) } else { raw.max(limit) };
        } else {
            let farther = (cubic - t.step).abs() > (secant - t.step).abs();
            step = (if farther { cubic } else { secant }).clamp(lo.min(hi), hi.max(lo));
        }
    } else if *bracketed {
        // A lower cost, the slope no flatter: the cubic through here and the other end.
        let o = *other;
        let theta = 3.0 * (t.cost - o.cost) / (o.step - t.step) + o.slope + t.slope;
        let size = theta.abs().max(o.slope.abs()).max(t.slope.abs());
        let inside = (theta / size).powi(2) - (o.slope / size) * (t.slope / size);
        let gamma = size * inside.max(0.0).sqrt() * (o.step - t.step).signum();
        let r = (gamma - t.slope + theta) / (2.0 * gamma - t.slope + o.slope);
        step = t.step + r * (o.step - t.step);
    } else {
        step = if along > 0.0 { hi } else { lo };
    }
    if t.cost > b.cost {
        *other = t;
    } else {
        if sign < 0.0 {
            *other = b;
        }
        *best = t;
    }
    // Equal costs and slopes give 0 / 0; halving goes on from there.
    if step.is_finite() { step } else { 0.5 * (best.step + other.step) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn search(f: impl Fn(f64) -> (f64, f64), first: f64) -> (f64, usize, Verdict) {
        let (cost, slope) = f(0.0);
        let mut search = Search::new(cost, slope, first, 1e10);
        loop {
            let (cost, slope) = f(search.step);
            let verdict = search.tell(cost, slope);
            if verdict != Verdict::Continue {
                return (search.step, search.evaluations, verdict);
            }
        }
    }

    #[test]
    fn the_conditions_hold_from_far_too_small_to_far_too_long_steps() {
        // Moré and Thuente 1994, equation 5.1 with beta = 2.
        let f = |t: f64| (-t / (t * t + 2.0), (t * t - 2.0) / (t * t + 2.0).powi(2));
        for start in [1e-3, 1e-1, 10.0, 1e3] {
            let (step, evaluations, verdict) = search(f, start);
            let ((f0, s0), (ft, st)) = (f(0.0), f(step));
            assert_eq!(verdict, Verdict::Accept, "from {start}: {step}");
            assert!(ft <= f0 + DECREASE * step * s0 && st.abs() <= -CURVATURE * s0);
            assert!(evaluations <= 15, "{evaluations}");
        }
    }

    #[test]
    fn a_long_flat_start_ends_close_to_the_minimum() {
        // Moré and Thuente 1994, equation 5.2 with beta = 0.004: slope -5e-7 at zero, minimum at 1.596.
        let f = |t: f64| {
            let u = t + 0.004;
            (u.powi(5) - 2.0 * u.powi(4), 5.0 * u.powi(4) - 8.0 * u.powi(3))
        };
        for start in [1e-3, 1e-1, 10.0, 1e3] {
            let (step, ..) = search(f, start);
            // The search may stop once the interval is a tenth of the step.
            assert!((step - 1.596).abs() < 0.16, "from {start}: {step}");
        }
    }

    #[test]
    fn a_cost_that_only_falls_ends_at_the_longest_step() {
        let mut search = Search::new(0.0, -1.0, 1.0, 8.0);
        while search.tell(-search.step, -1.0) == Verdict::Continue {}
        assert_eq!(search.step, 8.0);
    }

    #[test]
    fn a_cost_that_never_falls_is_given_up() {
        let mut search = Search::new(0.0, -1.0, 1.0, 8.0);
        while search.tell(1.0, -1.0) == Verdict::Continue {}
        assert!(search.evaluations <= MAX_EVALUATIONS);
        assert_eq!(search.best.step, 0.0);
    }
}
