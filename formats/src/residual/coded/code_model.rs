//! One code, told apart from all others by yes/no decisions, given what its neighbours predict.
//!
//! Let `m` be the blend and `first = floor(m) + 1`. The decisions, each "is the code beyond this cut?":
//! 1. slot 0: `code >= first`. From here distances `d >= 0` count outwards from `first` (or down from `first - 1`).
//! 2. Buckets of width `2^k`, `k <= 30` the largest with `2^k <= max(1, 0.9 scale of the blend)`: "`d` is beyond this
//!    bucket", slot `1 + min(bucket, 6)`; from the fifth yes on every bucket is twice as wide as the one before it. A
//!    bucket of width 2^36 is the last, without a decision.
//! 3. The half of the bucket, then the half of that, ...: slot `8 + min(depth, 3)` if the code lies in the first
//!    bucket (depth from 0), else `8 + min(depth + 2, 3)`.
//!
//! Each of the four models (mean `m_i`, scale `s_i`) takes the code for logistic: beyond a cut `c` (half-way between
//! two codes) lies `S_i = squash(+-(m_i - c) / s_i)`. Given that the code is beyond `inner` and not beyond `outer`,
//! `x_i = ln((S(cut) - S(outer) + t) / (S(inner) - S(cut) + t))`, `t = 1e-5`. Two counters give `x_4` and `x_5`, their
//! contexts (slot, level, eighth) and (slot, discord, eighth); the eighth is that of the fraction of `m`, mirrored
//! after a "no" in slot 0. `x_6 = 0.3`, `x_7 = 0`. The weights of the mixture and its refinement are chosen by
//! (slot, level); the probability coded is the mean of mixed and refined one, `floor(65536 p)` within 64..65472.
//!
//! About log2(scale) + 3 decisions a code. Measured: the distance between predictors in the scales saves 0.4 %.
//!
//! Source: real-valued predictions with a parametric distribution as in Meyer and Tischer 1997 (TMW), section 4;
//! mixing as in Mahoney 2005 (see `mixing.rs`).

use super::logistic::{ln, squash};
use super::mixing::{Counter, Mixer, Refinement};
use super::range_coder::{BitChannel, ONE};

/// Models of the code: three predictors and their blend, which is the last.
pub(super) const MODELS: usize = 4;
/// Levels of the error of a neighbourhood, half an octave each.
pub(super) const LEVELS: usize = 48;
const INPUTS: usize = 8;
const SLOTS: usize = 12;
const EIGHTHS: usize = 8;
/// Decisions that a counter averages.
const LIMIT: f32 = 250.0;
/// No probability comes closer to 0 or 1 than this, of 2^16: every code takes two decisions of 0.0014 bit or more.
const MARGIN: u32 = 64;
/// Widest bucket, as a power of two: distances are below 2^33.
const LAST_BUCKET: u32 = 36;

/// What the neighbours of a voxel say.
pub(super) struct Guess {
    /// Means of the models, within +-2^31.
    pub(super) mean: [f32; MODELS],
    /// Scales of their logistic distributions, >= 0.1.
    pub(super) scale: [f32; MODELS],
    /// Level of the blend's error.
    pub(super) level: usize,
    /// Level of the distance between the predictors.
    pub(super) discord: usize,
}

/// The adaptive state.
pub(super) struct CodeModel {
    mixer: Mixer<INPUTS>,
    refinement: Refinement,
    by_level: Vec<Counter>,
    by_discord: Vec<Counter>,
}

/// A code on its way.
struct Search<'a> {
    guess: &'a Guess,
    inverse: [f32; MODELS],
    /// +1 upwards, -1 downwards.
    outward: f32,
    inner: [f32; MODELS],
    outer: [f32; MODELS],
    eighth: usize,
}

impl Search<'_> {
    #[inline(always)]
    fn beyond(&self, cut: f32) -> [f32; MODELS] {
        std::array::from_fn(|k| squash((self.guess.mean[k] - cut) * self.outward * self.inverse[k]))
    }
}

impl CodeModel {
    /// Knows nothing yet.
    pub(super) fn new() -> Self {
        let weights = std::array::from_fn(|i| if i < MODELS { 0.27 } else { 0.0 });
        let counters = || vec![Counter::NEW; SLOTS * LEVELS * EIGHTHS];
        Self {
            mixer: Mixer::new(SLOTS * LEVELS, weights, 0.003),
            refinement: Refinement::new(SLOTS * LEVELS, 0.02),
            by_level: counters(),
            by_discord: counters(),
        }
    }

    #[inline(always)]
    fn decide(&mut self, channel: &mut impl BitChannel, s: &mut Search, cut: f32, slot: usize, bit: bool) -> bool {
        let middle = s.beyond(cut);
        let mut x = [0.0f32; INPUTS];
        for k in 0..MODELS {
            const TINY: f32 = 1e-5;
            x[k] = ln(((middle[k] - s.outer[k]).max(0.0) + TINY) / ((s.inner[k] - middle[k]).max(0.0) + TINY));
        }
        let set = slot * LEVELS + s.guess.level;
        let by_level = &mut self.by_level[set * EIGHTHS + s.eighth];
        let by_discord = &mut self.by_discord[(slot * LEVELS + s.guess.discord) * EIGHTHS + s.eighth];
        x[MODELS] = by_level.stretch();
        x[MODELS + 1] = by_discord.stretch();
        x[MODELS + 2] = 0.3;
        let stretched = self.mixer.mix(set, &x);
        let mixed = squash(stretched);
        let p = 0.5 * (mixed + self.refinement.refine(set, stretched));
        let bit = channel.bit(bit, ((p * ONE as f32) as u32).clamp(MARGIN, ONE - MARGIN));
        self.mixer.learn(set, &x, mixed, bit);
        self.refinement.learn(set, stretched, bit);
        by_level.learn(bit, LIMIT);
        by_discord.learn(bit, LIMIT);
        *(if bit { &mut s.inner } else { &mut s.outer }) = middle;
        bit
    }

    /// Codes `code` (the decoder gives any) and returns it; hostile bytes may give one outside of i32.
    #[inline(always)]
    pub(super) fn code(&mut self, channel: &mut impl BitChannel, guess: &Guess, code: i64) -> i64 {
        let centre = guess.mean[MODELS - 1];
        let floor = centre.floor();
        let first = floor as i64 + 1;
        let eighth = (((centre - floor) * EIGHTHS as f32) as usize).min(EIGHTHS - 1);
        let inverse = guess.scale.map(|s| 1.0 / s);
        let mut s = Search { guess, inverse, outward: 1.0, inner: [1.0; MODELS], outer: [0.0; MODELS], eighth };
        let middle = first as f32 - 0.5;
        let up = self.decide(channel, &mut s, middle, 0, code >= first);
        if !up {
            s.outward = -1.0;
            s.eighth = EIGHTHS - 1 - eighth;
        }
        s.inner = s.beyond(middle);
        s.outer = [0.0; MODELS];

        let (origin, sign) = if up { (first, 1) } else { (first - 1, -1) };
        let distance = (code - origin) * sign;
        let cut = |distance: i64| (origin + sign * distance) as f32 - 0.5 * sign as f32;
        let mut exponent = 0;
        while exponent < 30 && (2i64 << exponent) as f32 <= guess.scale[MODELS - 1] * 0.9 {
            exponent += 1;
        }
        let (mut start, mut bucket) = (0, 0);
        while exponent < LAST_BUCKET {
            let next = start + (1i64 << exponent);
            if !self.decide(channel, &mut s, cut(next), 1 + bucket.min(6), distance >= next) {
                break;
            }
            start = next;
            bucket += 1;
            exponent += u32::from(bucket > 4);
        }
        let mut depth = if bucket > 0 { 2 } else { 0 };
        while exponent > 0 {
            exponent -= 1;
            let next = start + (1i64 << exponent);
            if self.decide(channel, &mut s, cut(next), 8 + depth.min(3), distance >= next) {
                start = next;
            }
            depth += 1;
        }
        origin + sign * start
    }
}
