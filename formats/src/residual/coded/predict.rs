//! What the voxels before say about the next code: four predictions, their blend, and how far each may be off.
//!
//! Predictors 0, 1, 2 are least squares (`least_squares.rs`) kept apart for square tiles of the plane (all planes of a
//! tile share one state), predictor 3 is one for the whole frame:
//!
//! | predictor | taps, alone / after a frame | tile side | tile shift | forget | ridge | interval |
//! |---|---|---|---|---|---|---|
//! | 0 | 24 / 32 | 8 | 4 | 0.985 | 3 | 12 |
//! | 1 | 16 / 24 | 8 | 0 | 0.97 | 3 | 6 |
//! | 2 | 16 / 24 | 4 | 2 | 0.94 | 3 | 6 |
//! | 3 | 24 / 32 | none | - | 0.9998 | 0.01 | 16 |
//!
//! The tile of voxel (i, j) is `((i + shift) / side, (j + shift) / side)`. Taps are the codes, as f32, at the first 24
//! or 16 steps of [`TAPS`] (0 outside the support), then those of the frame before ([`earlier::TAPS`]).
//!
//! For each predictor and for the blend (index 4) the mean error of the neighbourhood is
//! `e = (0.25 + sum_n w_n min(|code_n - prediction_n|, 1e6)) / (0.5 + sum_n w_n)` over the nine nearest voxels of the
//! support, weight 2 for the first three and 1 for the others. The blend is `sum_p m_p u_p / sum_p u_p`,
//! `u_p = 1 / (e_p^4 + 0.001)`. Least squares take the voxel with weight `1 / (e_4^2 + 0.3)`.
//!
//! The scale of a prediction is `0.6 s(l) + 0.1`, `s` a table (at first `s(l) = 0.1 * 2^(l/2)`, by
//! repeated rounding) for each of predictors 0, 1, 2 and the blend, linear in
//! the level `l = 2 log2(e + d / 20) + 6` within 0..47; `d = |m_0 - m_1| + |m_1 - m_2| + |m_2 - m_0|`. Both entries
//! follow the error that came, at a rate of 0.01 times their part.
//!
//! Sources: local least squares and blending by local error: Meyer and Tischer 2001 (GLICBAWLS); Meyer and Tischer
//! 1997 (TMW), section 3. Tiles that live through the planes are ours: 5.6 % fewer bits than one state in sweep order.

use super::code_model::{Guess, LEVELS, MODELS};
use super::earlier;
use super::least_squares::LeastSquares;
use super::logistic::ln;

/// Columns and rows of zeros on each side of a plane: the farthest tap.
const PAD: usize = 2;
/// Predictors.
const PREDICTORS: usize = 4;
/// Index of the blend among the errors.
const BLEND: usize = PREDICTORS;
/// Taps of this frame in the larger and in the smaller predictors.
const OWN_LARGE: usize = 24;
const OWN_SMALL: usize = 16;
/// Steps to voxels that are coded before, along the fastest, middle and slowest axis; nearest first.
const TAPS: [[isize; 3]; OWN_LARGE] = [
    [-1, 0, 0],
    [0, -1, 0],
    [0, 0, -1],
    [-1, -1, 0],
    [1, -1, 0],
    [-1, 0, -1],
    [1, 0, -1],
    [0, -1, -1],
    [0, 1, -1],
    [-1, -1, -1],
    [1, -1, -1],
    [-1, 1, -1],
    [1, 1, -1],
    [-2, 0, 0],
    [0, -2, 0],
    [0, 0, -2],
    [-2, -1, 0],
    [2, -1, 0],
    [-1, -2, 0],
    [1, -2, 0],
    [-1, 0, -2],
    [1, 0, -2],
    [0, -1, -2],
    [0, 1, -2],
];
/// Weights of the first nine of them in the errors of a neighbourhood.
const NEAR: [f32; 9] = [2.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
/// Predictions stay within the codes.
const LARGEST: f32 = 2_147_483_648.0;

/// One plane of what is known of the voxels before; all zero outside the support.
struct Plane {
    value: Vec<f32>,
    error: Vec<[f32; 8]>,
    present: Vec<f32>,
}

/// Least squares with a state for each tile.
struct Tiled<const N: usize> {
    states: Vec<LeastSquares<N>>,
    per_row: usize,
    side: usize,
    shift: usize,
}

impl<const N: usize> Tiled<N> {
    fn new(plane: [usize; 2], side: usize, shift: usize, state: LeastSquares<N>) -> Self {
        let tiles = plane.map(|n| (n + shift).div_ceil(side));
        Self { states: vec![state; tiles[0] * tiles[1]], per_row: tiles[0], side, shift }
    }

    #[inline(always)]
    fn tile(&self, i: usize, j: usize) -> usize {
        (i + self.shift) / self.side + self.per_row * ((j + self.shift) / self.side)
    }
}

/// The predictors of a frame. `LARGE` and `SMALL` are 24 and 16, or 32 and 24 with taps in the frame before.
pub(super) struct Predictor<const LARGE: usize, const SMALL: usize> {
    width: usize,
    planes: [Plane; 3],
    wide: Tiled<LARGE>,
    middle: Tiled<SMALL>,
    narrow: Tiled<SMALL>,
    whole: LeastSquares<LARGE>,
    scales: [[f32; LEVELS + 1]; MODELS],
}

/// All that a voxel's neighbours say, kept until its code is known.
pub(super) struct Seen<const LARGE: usize, const SMALL: usize> {
    at: usize,
    tiles: [usize; 3],
    large: [f32; LARGE],
    small: [f32; SMALL],
    predictions: [f32; PREDICTORS],
    blend_error: f32,
    levels: [(usize, f32); MODELS],
    /// What the code model needs.
    pub(super) guess: Guess,
}

impl<const LARGE: usize, const SMALL: usize> Predictor<LARGE, SMALL> {
    /// For planes of `plane` voxels.
    pub(super) fn new(plane: [usize; 2]) -> Self {
        let width = plane[0] + 2 * PAD;
        let area = width * (plane[1] + 2 * PAD);
        let empty = || Plane { value: vec![0.0; area], error: vec![[0.0; 8]; area], present: vec![0.0; area] };
        // Level l stands for an error of 2^(l / 2 - 3); the first guess of the scale is 0.8 times that.
        let mut value = 0.1;
        let scales = std::array::from_fn(|_| {
            let here = value;
            value *= std::f32::consts::SQRT_2;
            here
        });
        Self {
            width,
            planes: std::array::from_fn(|_| empty()),
            wide: Tiled::new(plane, 8, 4, LeastSquares::new(0.985, 3.0, 12)),
            middle: Tiled::new(plane, 8, 0, LeastSquares::new(0.97, 3.0, 6)),
            narrow: Tiled::new(plane, 4, 2, LeastSquares::new(0.94, 3.0, 6)),
            whole: LeastSquares::new(0.9998, 0.01, 16),
            scales: [scales; MODELS],
        }
    }

    /// Begins the next plane.
    pub(super) fn next_plane(&mut self) {
        self.planes.rotate_right(1);
        self.planes[0].value.fill(0.0);
        self.planes[0].error.fill([0.0; 8]);
        self.planes[0].present.fill(0.0);
    }

    /// Predicts voxel (i, j) of the plane; `before` are its taps in the frame before, or zeros.
    #[inline(always)]
    pub(super) fn guess(&self, i: usize, j: usize, before: [f32; earlier::TAPS.len()]) -> Seen<LARGE, SMALL> {
        let at = (i + PAD) + self.width * (j + PAD);
        let index = |[x, y, z]: [isize; 3]| ((-z) as usize, at.wrapping_add_signed(x + self.width as isize * y));
        let own = TAPS.map(|step| {
            let (plane, at) = index(step);
            self.planes[plane].value[at]
        });
        let large: [f32; LARGE] = std::array::from_fn(|t| if t < OWN_LARGE { own[t] } else { before[t - OWN_LARGE] });
        let small: [f32; SMALL] = std::array::from_fn(|t| if t < OWN_SMALL { own[t] } else { before[t - OWN_SMALL] });

        let (mut sums, mut present) = ([0.0f32; 8], 0.0);
        for (&step, weight) in TAPS.iter().zip(NEAR) {
            let (plane, at) = index(step);
            let errors = &self.planes[plane].error[at];
            for l in 0..8 {
                sums[l] += weight * errors[l];
            }
            present += weight * self.planes[plane].present[at];
        }
        let share = 1.0 / (present + 0.5);
        let errors = sums.map(|sum| (sum + 0.25) * share);

        let tiles = [self.wide.tile(i, j), self.middle.tile(i, j), self.narrow.tile(i, j)];
        let predictions = [
            self.wide.states[tiles[0]].predict(&large),
            self.middle.states[tiles[1]].predict(&small),
            self.narrow.states[tiles[2]].predict(&small),
            self.whole.predict(&large),
        ]
        .map(|m| if m > -LARGEST { if m < LARGEST { m } else { LARGEST } } else { -LARGEST });
        let (mut top, mut bottom) = (0.0, 0.0);
        for (m, e) in predictions.iter().zip(errors) {
            let square = e * e;
            let weight = 1.0 / (square * square + 0.001);
            top += m * weight;
            bottom += weight;
        }
        let blend = top / bottom;

        let [a, b, c, _] = predictions;
        let discord = (a - b).abs() + (b - c).abs() + (c - a).abs();
        let levels = [0, 1, 2, BLEND].map(|p| level(errors[p] + discord * 0.05));
        let scale = std::array::from_fn(|m| {
            let (level, part) = levels[m];
            (self.scales[m][level] * (1.0 - part) + self.scales[m][level + 1] * part) * 0.6 + 0.1
        });
        let guess =
            Guess { mean: [a, b, c, blend], scale, level: levels[MODELS - 1].0, discord: level(discord + 0.05).0 };
        Seen { at, tiles, large, small, predictions, blend_error: errors[BLEND], levels, guess }
    }

    /// Learns the code of the voxel that was predicted last.
    #[inline(always)]
    pub(super) fn learn(&mut self, seen: &Seen<LARGE, SMALL>, code: i32) {
        let code = code as f32;
        let miss = |prediction: f32| {
            let error = (code - prediction).abs();
            if error < 1e6 { error } else { 1e6 }
        };
        let [a, b, c, d] = seen.predictions.map(miss);
        let blend = miss(seen.guess.mean[MODELS - 1]);
        for (m, error) in [a, b, c, blend].into_iter().enumerate() {
            let (level, part) = seen.levels[m];
            let scales = &mut self.scales[m];
            scales[level] += (error - scales[level]) * (0.01 * (1.0 - part));
            scales[level + 1] += (error - scales[level + 1]) * (0.01 * part);
        }
        self.planes[0].value[seen.at] = code;
        self.planes[0].error[seen.at] = [a, b, c, d, blend, 0.0, 0.0, 0.0];
        self.planes[0].present[seen.at] = 1.0;
        let weight = 1.0 / (seen.blend_error * seen.blend_error + 0.3);
        self.wide.states[seen.tiles[0]].learn(&seen.large, code, weight);
        self.middle.states[seen.tiles[1]].learn(&seen.small, code, weight);
        self.narrow.states[seen.tiles[2]].learn(&seen.small, code, weight);
        self.whole.learn(&seen.large, code, weight);
    }
}

/// The level of an error > 0 and the part of the way to the next level.
#[inline(always)]
fn level(error: f32) -> (usize, f32) {
    let x = ln(error) * (2.0 / std::f32::consts::LN_2) + 6.0;
    let last = LEVELS as f32 - 1.0;
    let x = if x > 0.0 { if x < last { x } else { last } } else { 0.0 };
    let level = x as usize;
    (level, x - level as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_of_codes_is_predicted_and_its_scale_shrinks() {
        let mut predictor = Predictor::<24, 16>::new([20, 20]);
        let mut last = None;
        for k in 0..6 {
            predictor.next_plane();
            for (j, i) in (0..20).flat_map(|j| (0..20).map(move |i| (j, i))) {
                let seen = predictor.guess(i, j, [0.0; 8]);
                let code = 500 + 3 * i as i32 - 2 * j as i32 + 5 * k;
                last = Some((seen.guess.mean[MODELS - 1] - code as f32, seen.guess.scale[MODELS - 1]));
                predictor.learn(&seen, code);
            }
        }
        let (error, scale) = last.unwrap();
        // Half a code is where rounding would hit the right one.
        assert!(error.abs() < 0.5 && scale < 0.5, "error {error}, scale {scale}");
    }

    #[test]
    fn levels_are_half_octaves_from_an_eighth() {
        for (error, expected) in [(0.125, 0), (0.5, 4), (1.0, 6), (8.0, 12), (0.0001, 0), (1e30, LEVELS - 1)] {
            assert_eq!(level(error * 1.0001).0, expected, "{error}");
        }
    }
}
