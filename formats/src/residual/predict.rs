//! What the voxels before say about the next code.
use super::code_model::{Guess, MODELS};
use super::least_squares::LeastSquares;
use super::logistic::ln;

const PAD: usize = 2;
const LARGE: usize = 24;
const SMALL: usize = 16;
const LEVELS: usize = super::code_model::LEVELS;
const TAPS: [[isize; 3]; LARGE] = [
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

struct Plane {
    value: Vec<f32>,
    error: Vec<[f32; 4]>,
    present: Vec<f32>,
}

pub(super) struct Predictor {
    width: usize,
    planes: [Plane; 3],
    large: LeastSquares<LARGE>,
    small: LeastSquares<SMALL>,
    scales: [[f32; LEVELS + 1]; MODELS],
}
pub(super) struct Seen {
    at: usize,
    taps: [f32; LARGE],
    small_taps: [f32; SMALL],
    e: [f32; 4],
    m2: f32,
    pub(super) guess: Guess,
}
impl Predictor {
    pub(super) fn new(nx: usize, ny: usize) -> Self {
        let width = nx + 2 * PAD;
        let area = width * (ny + 2 * PAD);
        let planes = std::array::from_fn(|_| Plane {
            value: vec![0.0; area],
            error: vec![[0.0; 4]; area],
            present: vec![0.0; area],
        });
        let large = LeastSquares::<LARGE>::new(0.9995, 0.01, 16);
        let small = LeastSquares::<SMALL>::new(0.985, 0.01, 8);
        let mut scales = [[1.0f32; LEVELS + 1]; MODELS];
        for s in &mut scales {
            let mut v = 0.125;
            for l in s.iter_mut() {
                *l = v * 0.8;
                v *= 1.414;
            }
        }
        Self { width, planes, large, small, scales }
    }
    pub(super) fn next_plane(&mut self) {
        self.planes.rotate_right(1);
        self.planes[0].value.fill(0.0);
        self.planes[0].error.fill([0.0; 4]);
        self.planes[0].present.fill(0.0);
    }
    #[inline]
    pub(super) fn guess(&self, i: usize, j: usize) -> Seen {
        let width = self.width;
        let planes = &self.planes;
        let at = (i + PAD) + width * (j + PAD);
        let index = |d: [isize; 3]| at.wrapping_add_signed(d[0] + width as isize * d[1]);
        let mut taps = [0.0f32; LARGE];
        for (t, &d) in taps.iter_mut().zip(&TAPS) {
            *t = planes[(-d[2]) as usize].value[index(d)];
        }
        let near: [[isize; 3]; 9] = [
            [-1, 0, 0],
            [0, -1, 0],
            [0, 0, -1],
            [-1, -1, 0],
            [1, -1, 0],
            [-1, 0, -1],
            [1, 0, -1],
            [0, -1, -1],
            [0, 1, -1],
        ];
        let near_weight = [2.0f32, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        let mut sum = [0.0f32; 4];
        let mut total = 0.0;
        for (&d, w) in near.iter().zip(near_weight) {
            let p = &planes[(-d[2]) as usize];
            let e = &p.error[index(d)];
            for l in 0..4 {
                sum[l] += w * e[l];
            }
            total += w * p.present[index(d)];
        }
        let norm = 1.0 / (total + 0.5);
        let e = sum.map(|s| (s + 0.25) * norm);
        let small_taps: [f32; SMALL] = std::array::from_fn(|i| taps[i]);
        let m0 = self.large.predict(&taps);
        let m1 = self.small.predict(&small_taps);
        let m2 = (taps[0] + taps[1] + taps[2]) * (1.0 / 3.0);
        let bw = |e: f32| {
            let q = e * e;
            1.0 / (q * q + 1e-3)
        };
        let (b0, b1, b2) = (bw(e[0]), bw(e[1]), bw(e[2]));
        let blend = (m0 * b0 + m1 * b1 + m2 * b2) / (b0 + b1 + b2);
        let limit = 2147483648.0f32;
        let clamp = |m: f32| if m > -limit { if m < limit { m } else { limit } } else { -limit };
        let means = [clamp(m0), clamp(m1), clamp(blend)];
        let errs = [e[0], e[1], e[3]];
        let mut scale = [0.0; MODELS];
        let mut top = 0;
        for q in 0..MODELS {
            let (l, f) = level(errs[q]);
            top = l;
            scale[q] = (self.scales[q][l] * (1.0 - f) + self.scales[q][l + 1] * f) * 0.72 + 0.1;
        }
        let guess = Guess { mean: means, scale, centre: means[2], spread: scale[2], level: top };
        Seen { at, taps, small_taps, e, m2, guess }
    }
    #[inline]
    pub(super) fn learn(&mut self, s: &Seen, c: i32) {
        let c = c as f32;
        let means = s.guess.mean;
        let e = s.e;
        let errs = [e[0], e[1], e[3]];
        let err = [(c - means[0]).abs(), (c - means[1]).abs(), (c - s.m2).abs(), (c - means[2]).abs()];
        for q in 0..MODELS {
            let (l, f) = level(errs[q]);
            let a = [err[0], err[1], err[3]][q];
            self.scales[q][l] += (a - self.scales[q][l]) * 0.01 * (1.0 - f);
            self.scales[q][l + 1] += (a - self.scales[q][l + 1]) * 0.01 * f;
        }
        self.planes[0].value[s.at] = c;
        self.planes[0].error[s.at] = err;
        self.planes[0].present[s.at] = 1.0;
        let weight = 1.0 / (e[3] * e[3] + 0.3);
        self.large.update(&s.taps, c, weight);
        self.small.update(&s.small_taps, c, weight);
    }
}
fn level(e: f32) -> (usize, f32) {
    let x = (ln(e) * (2.0 / std::f32::consts::LN_2) + 6.0).clamp(0.0, LEVELS as f32 - 1.001);
    let l = x as usize;
    (l, x - l as f32)
}
