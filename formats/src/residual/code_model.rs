//! How one code is told apart from all others, given what its neighbours predict.
use super::logistic::{ln, squash};
use super::mixing::{Counter, Mixer, Refinement};
use super::range_coder::{BitChannel, ONE};

pub(super) const MODELS: usize = 3;
const INPUTS: usize = 8;
const SLOTS: usize = 12;
pub(super) const LEVELS: usize = 24;
const FRACTIONS: usize = 8;
/// No probability comes closer to 0 or 1 than this, of 2^16: a code costs at least two decisions of 0.0014 bit.
const MARGIN: u32 = 64;

pub(super) struct Guess {
    pub(super) mean: [f32; MODELS],
    pub(super) scale: [f32; MODELS],
    pub(super) centre: f32,
    pub(super) spread: f32,
    pub(super) level: usize,
}

pub(super) struct CodeModel {
    mixer: Mixer<INPUTS>,
    fast: Vec<Counter>,
    slow: Vec<Counter>,
    refinement: Refinement,
}

struct Voxel<'a> {
    guess: &'a Guess,
    inverse: [f32; MODELS],
    outward: f32,
    inner: [f32; MODELS],
    outer: [f32; MODELS],
    fraction: usize,
}

impl Voxel<'_> {
    #[inline]
    fn survival(&self, cut: f32) -> [f32; MODELS] {
        std::array::from_fn(|k| squash((self.guess.mean[k] - cut) * self.outward * self.inverse[k]))
    }
}

impl CodeModel {
    pub(super) fn new() -> Self {
        let mut w = [0.0; INPUTS];
        w[..MODELS].fill(0.35);
        let contexts = SLOTS * LEVELS * FRACTIONS;
        Self {
            mixer: Mixer::new(SLOTS * LEVELS, w, 0.003),
            fast: vec![Counter::NEW; contexts],
            slow: vec![Counter::NEW; contexts],
            refinement: Refinement::new(SLOTS * LEVELS, 0.02),
        }
    }

    #[inline]
    fn decide(&mut self, channel: &mut impl BitChannel, v: &mut Voxel, cut: f32, slot: usize, bit: bool) -> bool {
        let middle = v.survival(cut);
        let mut x = [0.0f32; INPUTS];
        for k in 0..MODELS {
            const TINY: f32 = 1e-5;
            let yes = (middle[k] - v.outer[k]).max(0.0) + TINY;
            let no = (v.inner[k] - middle[k]).max(0.0) + TINY;
            x[k] = ln(yes / no);
        }
        let set = slot * LEVELS + v.guess.level;
        let context = set * FRACTIONS + v.fraction;
        x[MODELS] = self.fast[context].stretch();
        x[MODELS + 1] = self.slow[context].stretch();
        x[MODELS + 2] = 0.3;
        let mixed = self.mixer.mix(set, &x);
        let p = squash(mixed);
        let q = 0.5 * (p + self.refinement.refine(set, mixed));
        let bit = channel.bit(bit, ((q * ONE as f32) as u32).clamp(MARGIN, ONE - MARGIN));
        self.mixer.learn(set, &x, p, bit);
        self.refinement.learn(set, mixed, bit);
        self.fast[context].learn(bit, 50.0);
        self.slow[context].learn(bit, 250.0);
        if bit {
            v.inner = middle;
        } else {
            v.outer = middle;
        }
        bit
    }

    pub(super) fn code(&mut self, channel: &mut impl BitChannel, guess: &Guess, code: i64) -> i64 {
        let floor = guess.centre.floor();
        let first = floor as i64 + 1;
        let fraction = (((guess.centre - floor) * FRACTIONS as f32) as usize).min(FRACTIONS - 1);
        let inverse = guess.scale.map(|s| 1.0 / s);
        let mut v = Voxel { guess, inverse, outward: 1.0, inner: [1.0; MODELS], outer: [0.0; MODELS], fraction };
        let up = self.decide(channel, &mut v, first as f32 - 0.5, 0, code >= first);
        let sign: i64 = if up { 1 } else { -1 };
        let origin = if up { first } else { first - 1 };
        if !up {
            v.outward = -1.0;
            v.fraction = FRACTIONS - 1 - v.fraction;
        }
        v.inner = v.survival(first as f32 - 0.5);
        v.outer = [0.0; MODELS];
        let distance = (code - origin) * sign;
        let mut exponent = 0;
        while exponent < 30 && (1i64 << (exponent + 1)) as f32 <= guess.spread * 0.9 {
            exponent += 1;
        }
        let mut start = 0i64;
        let mut bucket = 0;
        loop {
            let next = start + (1i64 << exponent);
            let cut = (origin + sign * next) as f32 - 0.5 * sign as f32;
            let slot = 1 + bucket.min(6);
            if exponent >= 36 || !self.decide(channel, &mut v, cut, slot, distance >= next) {
                break;
            }
            start = next;
            bucket += 1;
            if bucket > 4 {
                exponent += 1;
            }
        }
        let mut depth = 0;
        while exponent > 0 {
            exponent -= 1;
            let next = start + (1i64 << exponent);
            let cut = (origin + sign * next) as f32 - 0.5 * sign as f32;
            if self.decide(channel, &mut v, cut, 8 + (depth + 2 * usize::from(bucket > 0)).min(3), distance >= next) {
                start = next;
            }
            depth += 1;
        }
        origin + sign * start
    }
}
