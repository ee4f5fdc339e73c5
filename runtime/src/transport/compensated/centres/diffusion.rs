//! Multiple scattering by diffusion, collocated at the Gaussians' centres: the paper's route, corrected.
//!
//! P1 approximation `L_m = L0 + L1 . w`, Gaussian interpolation of L0, J0, J1 with the shares `u_h = w_h B_h / D`. The
//! equation `div(kappa grad L0) - sigma_a D L0 + S = 0`, `kappa = 1/(3 sigma_tr D)`,
//! `S = sigma_t D J0 - sigma_t/(3 sigma_tr) div J1`, is asked for at every centre. Multiplied by 3 sigma_tr D and written in
//! logarithmic derivatives `a_h = grad B_h / B_h`, `b_h = lap B_h / B_h`, `a = sum u a`, `b = sum u b`, it reads
//!
//! ```text
//! A_h = u_h { b_h - 3 a.a_h + 3 |a|^2 - b - 3 sigma_a sigma_tr D^2 }
//! rhs = sum_h u_h { sigma_t D (a_h - a).J1_h - 3 sigma_tr sigma_t D^2 J0_h }
//! ```
//!
//! in which nothing overflows where D is tiny (u comes from a softmax) or sigma_t is 0. J1 is in propagation directions,
//! the negative of the look convention's. Then `L1 = (-grad L0 + sigma_t D J1) / (sigma_tr D)` and `J_ms = albedo (L0, g L1)`.
//!
//! Source: Zhou et al. 2008, section 5.4; the printed equations 5, 6 and 13 count albedo twice in S and miss a factor 3 in
//! S and in L1: up to 39 % too bright in a slab, against 10 to 12 % with the forms above.
//! The system itself is ill-posed: it knows no outflow, and for albedo 1 the constant is a null vector. We therefore
//! scale rows to length 1, damp by 0.1 (Tikhonov), solve by CGLS, and clamp `0 <= L0 <= max L_in` and
//! `|L1| <= L0` (radiance is positive). Use [`super::integral`] unless the paper's look is asked for.
//!
//! The damping was tuned on 48 settings (300 and 600 Gaussians put on one plume, uniform and one-sided light, sigma_t 3
//! to 30, albedo 0.66 to 0.99, g 0 and 0.42), mean and largest relative difference of J to integral transport's: 0.001:
//! .47, 2.4; 0.01: .46, 2.2; 0.03: .39, 1.5; 0.06: .33, .71; 0.1: .31, .55; 0.15: .33, .63; no multiple scattering: .43,
//! .78. From 0.06 on diffusion is never worse than leaving it out.
//!
//! Cost: n^2 exponentials, then 4 n^2 per iteration and channel. Memory: 16 n^2 bytes.

use rayon::prelude::*;

use crate::medium::gaussian_points::GaussianPoints;
use crate::transport::medium::BandedMedium;

/// Tikhonov parameter on rows of length 1: minimises |A x - b|^2 + DAMPING^2 |x - x0|^2, x0 = 0.
const DAMPING: f64 = 0.1;
/// CGLS iterations at most; the paper uses 20 to 40, without damping.
const ITERATIONS: usize = 60;
/// CGLS ends when the gradient has fallen by this factor.
const TOLERANCE: f64 = 1e-6;
/// Rows of one task in transposed products: partial sums are added in chunk order.
const CHUNK: usize = 64;

/// The geometry of the collocation system of one frame: valid for every medium and light.
#[derive(Clone, Debug)]
pub struct Diffusion {
    count: usize,
    /// Row i, column h: `u_h {b_h - 3 a.a_h + 3|a|^2 - b}`.
    geometry: Vec<f64>,
    /// Row i, column h: u_h.
    share: Vec<f64>,
    /// Relative density at the centres.
    density: Vec<f64>,
    /// `a` at the centres.
    slope: Vec<[f64; 3]>,
    centers: Vec<[f64; 3]>,
    /// 1 / r^2.
    inverse_square: Vec<f64>,
}

/// One colour channel of a solve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Channel {
    /// 0 to 2.
    pub index: usize,
    /// Extinction per unit length at relative density 1.
    pub optical_scale: f64,
    /// The largest radiance of the light, which bounds L0.
    pub brightest: f32,
}

/// Mean and vector of the source in one channel, per centre.
#[derive(Clone, Copy)]
struct Moments {
    mean: f64,
    vector: [f64; 3],
}

fn dot3(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

impl Diffusion {
    /// Assembles the rows at the centres.
    pub fn new(points: &GaussianPoints) -> Self {
        let n = points.len();
        let centers: Vec<[f64; 3]> = (0..n).map(|h| points.center_of(h).map(f64::from)).collect();
        let inverse_square: Vec<f64> = (0..n).map(|h| f64::from(points.radius[h]).powi(-2)).collect();
        let mut this = Self {
            count: n,
            geometry: vec![0.0; n * n],
            share: vec![0.0; n * n],
            density: vec![0.0; n],
            slope: vec![[0.0; 3]; n],
            centers,
            inverse_square,
        };
        let (centers, inverse_square) = (&this.centers, &this.inverse_square);
        let rows = this.geometry.par_chunks_mut(n.max(1)).zip(this.share.par_chunks_mut(n.max(1)));
        rows.zip(this.density.par_iter_mut().zip(this.slope.par_iter_mut())).enumerate().for_each(
            |(i, ((geometry, share), (density, slope)))| {
                // Softmax of ln w - q: shares stay right where every term underflows.
                let mut largest = f64::NEG_INFINITY;
                for (h, share) in share.iter_mut().enumerate() {
                    let to: [f64; 3] = std::array::from_fn(|a| centers[i][a] - centers[h][a]);
                    *share = f64::from(points.weight[h]).ln() - dot3(to, to) * inverse_square[h];
                    largest = largest.max(*share);
                }
                if largest == f64::NEG_INFINITY {
                    // Only weightless Gaussians: an empty row.
                    share.fill(0.0);
                    return;
                }
                let mut sum = 0.0;
                for share in share.iter_mut() {
                    *share = (*share - largest).exp();
                    sum += *share;
                }
                *density = sum * largest.exp();
                let (mut a, mut b) = ([0.0; 3], 0.0);
                for h in 0..n {
                    share[h] /= sum;
                    let (ah, bh) = derivatives(centers[i], centers[h], inverse_square[h]);
                    (0..3).for_each(|k| a[k] += share[h] * ah[k]);
                    b += share[h] * bh;
                }
                *slope = a;
                for h in 0..n {
                    let (ah, bh) = derivatives(centers[i], centers[h], inverse_square[h]);
                    geometry[h] = share[h] * (bh - 3.0 * dot3(a, ah) + 3.0 * dot3(a, a) - b);
                }
            },
        );
        this
    }

    /// Adds multiple scattering to `radiance` (single scattering, `order^2` coefficients a centre) in one channel.
    ///
    /// `start` is L0 of an earlier solve. Returns L0 at the centres.
    pub fn add(
        &self,
        radiance: &mut [[f32; 3]],
        order: usize,
        medium: &BandedMedium,
        channel: Channel,
        start: Option<&[f32]>,
    ) -> Vec<f32> {
        let Channel { index: channel, optical_scale, brightest } = channel;
        let (n, stride) = (self.count, order * order);
        let albedo = f64::from(medium.albedo[channel]);
        let forward = if order > 1 { f64::from(medium.moments[1]) } else { 0.0 };
        let transport = optical_scale * (1.0 - albedo * forward);
        let mean_scale = 1.0 / (4.0 * std::f64::consts::PI).sqrt();
        let vector_scale = (3.0 / (4.0 * std::f64::consts::PI)).sqrt();
        let sources: Vec<Moments> = (0..n)
            .map(|i| {
                let at = |k: usize| f64::from(radiance[i * stride + k][channel]);
                // Look to propagation: odd bands change sign; then f1 = sqrt(3/4pi) (-f_3, -f_1, f_2).
                let vector = if order > 1 { [at(3), at(1), -at(2)].map(|v| v * vector_scale) } else { [0.0; 3] };
                Moments { mean: at(0) * mean_scale, vector }
            })
            .collect();
        let level = self.solve(&sources, optical_scale, transport, albedo, start);
        let level: Vec<f64> = level.iter().map(|&l| l.clamp(0.0, f64::from(brightest))).collect();
        for i in 0..n {
            let vector = self.flux(i, &level, &sources, optical_scale, transport);
            radiance[i * stride][channel] += (albedo * level[i] / mean_scale) as f32;
            if order > 1 {
                // Harmonics in look directions of a propagation vector: sqrt(4pi/3) (L1_y, -L1_z, L1_x).
                let gain = albedo * forward / vector_scale;
                for (k, value) in [(1, vector[1]), (2, -vector[2]), (3, vector[0])] {
                    radiance[i * stride + k][channel] += (gain * value) as f32;
                }
            }
        }
        level.iter().map(|&l| l as f32).collect()
    }

    /// L1 at centre i, limited to L0.
    fn flux(&self, i: usize, level: &[f64], sources: &[Moments], optical_scale: f64, transport: f64) -> [f64; 3] {
        let (mut gradient, mut source) = ([0.0; 3], [0.0; 3]);
        for h in 0..self.count {
            let share = self.share[i * self.count + h];
            let (a, _) = derivatives(self.centers[i], self.centers[h], self.inverse_square[h]);
            for k in 0..3 {
                gradient[k] += share * level[h] * (a[k] - self.slope[i][k]);
                source[k] += share * sources[h].vector[k];
            }
        }
        let density = self.density[i];
        let vector: [f64; 3] = std::array::from_fn(|k| optical_scale * density * source[k] - gradient[k]);
        let (length, limit) = (dot3(vector, vector).sqrt(), level[i] * transport * density);
        if length > limit {
            // Also where transport * density is 0: the direction alone remains.
            return vector.map(|v| v / length * level[i]);
        }
        if limit > 0.0 { vector.map(|v| v / (transport * density)) } else { [0.0; 3] }
    }

    /// L0 by damped CGLS on rows of length 1.
    fn solve(
        &self,
        sources: &[Moments],
        optical_scale: f64,
        transport: f64,
        albedo: f64,
        start: Option<&[f32]>,
    ) -> Vec<f64> {
        let n = self.count;
        // 3 sigma_a sigma_tr D^2 is subtracted from the geometry, as a factor of the share.
        let absorbed: Vec<f64> =
            self.density.iter().map(|d| 3.0 * optical_scale * (1.0 - albedo) * transport * d * d).collect();
        let row = |i: usize| (&self.geometry[i * n..(i + 1) * n], &self.share[i * n..(i + 1) * n]);
        let (scale, right): (Vec<f64>, Vec<f64>) = (0..n)
            .into_par_iter()
            .map(|i| {
                let (geometry, share) = row(i);
                let square: f64 = geometry.iter().zip(share).map(|(g, u)| (g - absorbed[i] * u).powi(2)).sum();
                let density = self.density[i];
                let mut right = 0.0;
                for h in 0..n {
                    if share[h] > 0.0 {
                        let (a, _) = derivatives(self.centers[i], self.centers[h], self.inverse_square[h]);
                        let along = std::array::from_fn(|k| a[k] - self.slope[i][k]);
                        right += share[h]
                            * (optical_scale * density * dot3(along, sources[h].vector)
                                - 3.0 * transport * optical_scale * density * density * sources[h].mean);
                    }
                }
                // One Gaussian alone and albedo 1: an empty row says nothing.
                let scale = if square > 0.0 { 1.0 / square.sqrt() } else { 0.0 };
                (scale, right * scale)
            })
            .unzip();
        let apply = |x: &[f64]| -> Vec<f64> {
            (0..n)
                .into_par_iter()
                .with_min_len(16)
                .map(|i| {
                    let (geometry, share) = row(i);
                    let sum: f64 = geometry.iter().zip(share).zip(x).map(|((g, u), x)| (g - absorbed[i] * u) * x).sum();
                    sum * scale[i]
                })
                .collect()
        };
        let transpose = |r: &[f64]| -> Vec<f64> {
            let partial: Vec<Vec<f64>> = (0..n.div_ceil(CHUNK))
                .into_par_iter()
                .map(|chunk| {
                    let mut sum = vec![0.0; n];
                    for i in chunk * CHUNK..((chunk + 1) * CHUNK).min(n) {
                        let ((geometry, share), weight) = (row(i), r[i] * scale[i]);
                        for ((s, g), u) in sum.iter_mut().zip(geometry).zip(share) {
                            *s += weight * (g - absorbed[i] * u);
                        }
                    }
                    sum
                })
                .collect();
            let mut total = vec![0.0; n];
            partial.iter().for_each(|p| total.iter_mut().zip(p).for_each(|(t, p)| *t += p));
            total
        };
        let mut x: Vec<f64> = match start {
            Some(start) if start.len() == n => start.iter().map(|&v| f64::from(v)).collect(),
            _ => vec![0.0; n],
        };
        let damping = DAMPING * DAMPING;
        let norm = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>();
        let mut rest: Vec<f64> = right.iter().zip(apply(&x)).map(|(b, a)| b - a).collect();
        let gradient = |rest: &[f64], x: &[f64]| -> Vec<f64> {
            transpose(rest).iter().zip(x).map(|(g, x)| g - damping * x).collect()
        };
        let mut g = gradient(&rest, &x);
        let mut p = g.clone();
        let mut square = norm(&g);
        // Against the gradient at x = 0, so that a warm start may end at once.
        let enough = TOLERANCE * TOLERANCE * norm(&transpose(&right));
        for _ in 0..ITERATIONS {
            if square <= enough {
                break;
            }
            let q = apply(&p);
            let curvature = norm(&q) + damping * norm(&p);
            if curvature == 0.0 {
                break;
            }
            let step = square / curvature;
            x.iter_mut().zip(&p).for_each(|(x, p)| *x += step * p);
            rest.iter_mut().zip(&q).for_each(|(r, q)| *r -= step * q);
            g = gradient(&rest, &x);
            let next = norm(&g);
            let keep = next / square;
            p.iter_mut().zip(&g).for_each(|(p, g)| *p = g + keep * *p);
            square = next;
        }
        x
    }
}

/// Logarithmic gradient and Laplacian of `exp(-|x - c|^2 / r^2)`: `-2 (x - c) / r^2` and `(4 q - 6) / r^2`.
#[inline]
fn derivatives(at: [f64; 3], center: [f64; 3], inverse_square: f64) -> ([f64; 3], f64) {
    let to: [f64; 3] = std::array::from_fn(|k| at[k] - center[k]);
    (to.map(|t| -2.0 * t * inverse_square), (4.0 * dot3(to, to) * inverse_square - 6.0) * inverse_square)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::compensated::centres::testing::{Pcg, cloud, points};
    use crate::transport::medium::MediumParameters;

    const ROOT: f32 = 3.544_907_7;

    fn channel(index: usize, optical_scale: f64, brightest: f32) -> Channel {
        Channel { index, optical_scale, brightest }
    }

    fn medium(albedo: f32, g: f32) -> BandedMedium {
        MediumParameters { sigma_t: [1.0; 3], albedo: [albedo; 3], g }.banded(4)
    }

    #[test]
    fn rows_are_the_equation_by_central_differences() {
        // 3 sigma_tr D times [div(kappa grad L) - sigma_a D L] of an interpolated random L0, sigma_a and sigma_tr = 2 and 5.
        let gaussians = cloud(30, 31);
        let (set, mut pcg) = (points(&gaussians), Pcg::new(1));
        let system = Diffusion::new(&set);
        let level: Vec<f64> = (0..30).map(|_| pcg.uniform()).collect();
        let (sigma_a, sigma_tr) = (2.0, 5.0);
        let fields = |at: [f64; 3]| -> (f64, f64) {
            let (mut d, mut s) = (0.0, 0.0);
            for (h, level) in level.iter().enumerate() {
                let to: [f64; 3] = std::array::from_fn(|k| at[k] - system.centers[h][k]);
                let term = f64::from(set.weight[h]) * (-dot3(to, to) * system.inverse_square[h]).exp();
                d += term;
                s += term * level;
            }
            (d, s / d)
        };
        for i in 0..30 {
            let (at, h) = (system.centers[i], 1e-4);
            let shifted = |k: usize, by: f64| {
                let mut p = at;
                p[k] += by;
                p
            };
            let (density, l) = fields(at);
            let kappa = |p: [f64; 3]| 1.0 / (3.0 * sigma_tr * fields(p).0);
            let mut divergence = 0.0;
            for k in 0..3 {
                let ahead = kappa(shifted(k, h / 2.0)) * (fields(shifted(k, h)).1 - l) / h;
                let back = kappa(shifted(k, -h / 2.0)) * (l - fields(shifted(k, -h)).1) / h;
                divergence += (ahead - back) / h;
            }
            let expected = 3.0 * sigma_tr * density * (divergence - sigma_a * density * l);
            let mut found = 0.0;
            let mut size = 0.0;
            for (j, level) in level.iter().enumerate() {
                let entry = system.geometry[i * 30 + j]
                    - 3.0 * sigma_a * sigma_tr * density * density * system.share[i * 30 + j];
                found += entry * level;
                size += (entry * level).abs();
            }
            // Second order: h^2 / r^2 = 1e-5 of each term's size, with a factor of 10 for fourth derivatives; rounding
            // 1e-16 / h^2 = 1e-8 of L / kappa terms.
            assert!((found - expected).abs() < 1e-4 * size.max(1.0), "{i}: {found} {expected} of {size}");
        }
    }

    #[test]
    fn a_constant_is_a_null_vector_of_the_geometry() {
        let system = Diffusion::new(&points(&cloud(40, 32)));
        for row in system.geometry.chunks(40) {
            let (sum, size) = row.iter().fold((0.0, 0.0), |(s, z), v| (s + v, z + v.abs()));
            assert!(f64::abs(sum) <= 1e-12 * size);
        }
    }

    #[test]
    fn one_gaussian_gives_the_known_and_clamped_answer() {
        // L0 = J0 / (1 - albedo), damped by 1 + 0.1^2, clamped to the light.
        let system = Diffusion::new(&points(&cloud(1, 1)));
        for (albedo, expected) in [(0.5, 0.2 / 1.01), (0.99, 1.0)] {
            let mut j = vec![[0.0; 3]; 16];
            j[0][1] = 0.1 * ROOT;
            let level = system.add(&mut j, 4, &medium(albedo, 0.3), channel(1, 5.0, 1.0), None);
            assert!((level[0] - expected).abs() < 1e-6, "{level:?}");
            assert!((j[0][1] - (0.1 + albedo * level[0]) * ROOT).abs() < 1e-5);
            assert_eq!((j[0][0], j[1][1]), (0.0, 0.0));
        }
        let mut j = vec![[0.1; 3]; 16];
        let level = system.add(&mut j, 4, &medium(1.0, 0.0), channel(0, 5.0, 1.0), None);
        assert_eq!(level, [0.0], "albedo 1: the only row is empty, and damping leaves nothing");
    }

    #[test]
    fn the_answer_is_finite_and_bounded_in_every_medium() {
        let mut gaussians = cloud(60, 33);
        gaussians[1] = gaussians[0];
        gaussians[2].weight = 0.0;
        gaussians[3].center = [20.0, -20.0, 5.0];
        gaussians[4].weight = 1e-30;
        let system = Diffusion::new(&points(&gaussians));
        for optical_scale in [0.0, 1e-6, 1.0, 1e3, 1e6] {
            for (albedo, g) in [(0.0, 0.0), (0.9, 0.6), (1.0, -0.6), (1.0, 0.99), (1.0, -0.99)] {
                let mut j: Vec<[f32; 3]> = (0..60 * 16).map(|k| [if k % 16 == 0 { 1.0 } else { 0.1 }; 3]).collect();
                let before = j.clone();
                let level = system.add(&mut j, 4, &medium(albedo, g), channel(0, optical_scale, 2.0), None);
                assert!(level.iter().all(|&l| (0.0..=2.0).contains(&l)));
                assert!(j.iter().flatten().all(|v| v.is_finite()));
                if albedo == 0.0 {
                    assert_eq!(j, before);
                }
            }
        }
        assert!(Diffusion::new(&points(&[])).add(&mut [], 4, &medium(0.9, 0.0), channel(0, 1.0, 1.0), None).is_empty());
    }

    #[test]
    fn a_warm_start_agrees_with_a_cold_one() {
        let system = Diffusion::new(&points(&cloud(50, 34)));
        let source: Vec<[f32; 3]> = (0..50).map(|i| [0.5 + 0.01 * i as f32, 0.0, 0.0]).collect();
        let medium = medium(0.9, 0.0);
        let cold = system.add(&mut source.clone(), 1, &medium, channel(0, 10.0, 10.0), None);
        let warm = system.add(&mut source.clone(), 1, &medium, channel(0, 10.0, 10.0), Some(&cold));
        // Stopped at a gradient of 1e-6 of |A^T b| <= |A|^2 |x|; undone by (A^T A + damping^2)^-1 <= 100, |A|^2 of a few.
        for (a, b) in cold.iter().zip(&warm) {
            assert!((a - b).abs() < 3e-3, "{a} {b}");
        }
    }
}
