//! Adaptive probabilities of yes/no decisions: counters, their mixture in the logistic domain, and a last correction.
//!
//! With `stretch(p) = ln(p / (1 - p))`, a [`Mixer`] forms `p = squash(sum_i w_i x_i)` from stretched probabilities
//! `x_i` and follows the gradient of the coding cost, `w_i += rate (bit - p) x_i`. A [`Refinement`] is a piecewise
//! linear map of `stretch(p)` learned for each context. All in f32 with `+ - * /` in the order written.
//!
//! Source: Mahoney 2005, "Adaptive weighing of context models for lossless data compression", sections 3 and 4.

use super::logistic::{ln, squash};

/// Probability of yes in one context: a running mean over the first `limit` decisions, exponential after that.
#[derive(Clone, Copy)]
pub(super) struct Counter {
    probability: f32,
    count: f32,
}

impl Counter {
    /// Knows nothing yet.
    pub(super) const NEW: Self = Self { probability: 0.5, count: 0.0 };

    /// `stretch` of the probability.
    #[inline(always)]
    pub(super) fn stretch(&self) -> f32 {
        ln(self.probability / (1.0 - self.probability))
    }

    /// Learns one decision; the step is `1 / (decisions so far + 1.5)`, the count stopping at `limit`.
    #[inline(always)]
    pub(super) fn learn(&mut self, bit: bool, limit: f32) {
        // The target stays off 0 and 1, so that the stretched value is bounded by ln(4095) = 8.3.
        let target = if bit { 1.0 - 1.0 / 4096.0 } else { 1.0 / 4096.0 };
        self.probability += (target - self.probability) / (self.count + 1.5);
        self.count += if self.count < limit { 1.0 } else { 0.0 };
    }
}

/// Largest stretched probability that a mixer gives, just below 8.
const LIMIT: f32 = 7.99;

/// Sets of weights over `N` stretched probabilities.
pub(super) struct Mixer<const N: usize> {
    sets: Vec<[f32; N]>,
    rate: f32,
}

impl<const N: usize> Mixer<N> {
    /// `sets` sets, each starting from `weights`.
    pub(super) fn new(sets: usize, weights: [f32; N], rate: f32) -> Self {
        Self { sets: vec![weights; sets], rate }
    }

    /// The mixed probability, still stretched, within +-[`LIMIT`].
    #[inline(always)]
    pub(super) fn mix(&self, set: usize, inputs: &[f32; N]) -> f32 {
        let weights = &self.sets[set];
        let mut dot = 0.0;
        for i in 0..N {
            dot += inputs[i] * weights[i];
        }
        if dot > -LIMIT { if dot < LIMIT { dot } else { LIMIT } } else { -LIMIT }
    }

    /// Follows the gradient after the decision; `probability` is what the mixer had said.
    #[inline(always)]
    pub(super) fn learn(&mut self, set: usize, inputs: &[f32; N], probability: f32, bit: bool) {
        let step = (f32::from(u8::from(bit)) - probability) * self.rate;
        let weights = &mut self.sets[set];
        for i in 0..N {
            weights[i] += step * inputs[i];
        }
    }
}

const KNOTS: usize = 33;

/// A learned piecewise linear map from stretched probability to probability, one for each context.
pub(super) struct Refinement {
    lines: Vec<[f32; KNOTS]>,
    rate: f32,
}

impl Refinement {
    /// `contexts` maps, each the plain logistic function at first.
    pub(super) fn new(contexts: usize, rate: f32) -> Self {
        Self { lines: vec![std::array::from_fn(|i| squash((i as f32 - 16.0) * 0.5)); contexts], rate }
    }

    #[inline(always)]
    fn knot(stretched: f32) -> (usize, f32) {
        let at = (stretched + 8.0) * 2.0;
        let knot = at as usize;
        (knot, at - knot as f32)
    }

    /// The probability that the map gives; |stretched| < 8.
    #[inline(always)]
    pub(super) fn refine(&self, context: usize, stretched: f32) -> f32 {
        let (knot, fraction) = Self::knot(stretched);
        let line = &self.lines[context];
        line[knot] * (1.0 - fraction) + line[knot + 1] * fraction
    }

    /// Moves the two knots that were used towards the decision.
    #[inline(always)]
    pub(super) fn learn(&mut self, context: usize, stretched: f32, bit: bool) {
        let (knot, fraction) = Self::knot(stretched);
        let target = f32::from(u8::from(bit));
        let line = &mut self.lines[context];
        line[knot] += (target - line[knot]) * (1.0 - fraction) * self.rate;
        line[knot + 1] += (target - line[knot + 1]) * fraction * self.rate;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_approaches_the_share_of_yes() {
        let mut counter = Counter::NEW;
        (0..3000).for_each(|i| counter.learn(i % 4 == 0, 250.0));
        // The last 250 decisions weigh most; their mean deviates by less than one decision in 250, twice over.
        assert!((squash(counter.stretch()) - 0.25).abs() < 2.0 / 250.0);
    }

    #[test]
    fn a_mixer_learns_to_trust_the_input_that_is_right() {
        let mut mixer = Mixer::<2>::new(1, [0.5; 2], 0.02);
        for i in 0..4000u32 {
            let bit = i.wrapping_mul(2_654_435_761) >> 31 == 1;
            let x = [if bit { 2.0 } else { -2.0 }, if i % 2 == 0 { 2.0 } else { -2.0 }];
            let p = squash(mixer.mix(0, &x));
            mixer.learn(0, &x, p, bit);
        }
        assert!(squash(mixer.mix(0, &[2.0, -2.0])) > 0.95 && squash(mixer.mix(0, &[-2.0, 2.0])) < 0.05);
    }

    #[test]
    fn a_refinement_is_the_logistic_function_until_it_learns_otherwise() {
        let mut refinement = Refinement::new(1, 0.02);
        // Knots half a unit apart: h^2/8 max|f''| = 0.25 / 8 * 0.0963 = 0.003.
        (-79..80).map(|i| i as f32 * 0.1).for_each(|x| assert!((refinement.refine(0, x) - squash(x)).abs() < 0.0031));
        (0..1000).for_each(|i| refinement.learn(0, 1.25, i % 2 == 0));
        assert!((refinement.refine(0, 1.25) - 0.5).abs() < 0.02);
        assert!((refinement.refine(0, -3.0) - squash(-3.0)).abs() < 0.0031, "other knots stay");
    }
}
