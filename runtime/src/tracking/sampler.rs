//! Numbers for the path tracer: Sobol' points with Owen scrambling where a pass wants its samples spread evenly, and a
//! plain generator for the rest of a path.
//!
//! Pairs of dimensions are (0, 2)-sequences of their own: Sobol's first two dimensions (Sobol' 1967), with the order of
//! points and the digits of both coordinates scrambled by hashes that permute every subtree of the binary digits
//! (Owen 1995; Burley 2020, "Practical Hash-based Owen Scrambling", section 3). Any 2^k points of a pair put one point
//! into each of the 2^k elementary boxes of every shape, whatever the seed; a scrambled point by itself is uniform, so
//! the mean over a pass is unbiased, and passes with other seeds are independent, which is what a standard error needs.
//! Cost: about 30 operations a pair.

/// A generator whose whole state is one number (SplitMix64: Steele, Lea and Flood 2014).
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// The stream of `seed`.
    pub fn new(seed: u64) -> Self {
        Self(mix(seed))
    }

    /// Uniform in [0, 1), in steps of 2^-24.
    #[inline(always)]
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 * (1.0 / 16_777_216.0)
    }

    /// Exponential with mean 1, above 0 and finite.
    #[inline(always)]
    pub fn exponential(&mut self) -> f32 {
        // The middle of a step, so that the logarithm is finite; 2^-32 is the least value, 22 the largest result.
        let u = ((self.bits() >> 32) as f32 + 0.5) * (1.0 / 4_294_967_296.0);
        -u.min(1.0 - f32::EPSILON / 2.0).ln()
    }

    #[inline(always)]
    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.0)
    }
}

/// Sixty-four well mixed bits of `z`.
#[inline(always)]
pub fn mix(z: u64) -> u64 {
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Point `index` of a scrambled set, seen pair by pair.
#[derive(Clone, Copy, Debug)]
pub struct Strata {
    /// Which point.
    pub index: u32,
    /// Which set: other seeds are independent.
    pub seed: u64,
}

impl Strata {
    /// Coordinates number `2 pair` and `2 pair + 1`, in [0, 1).
    #[inline]
    pub fn pair(&self, pair: u32) -> [f32; 2] {
        let h = mix(self.seed ^ u64::from(pair).wrapping_mul(0xd6e8_feb8_6659_fd93));
        // Aligned blocks of indices stay aligned blocks: a set of 2^k points is a block of the sequence.
        let index = owen(self.index, h as u32);
        let x = owen(index.reverse_bits(), (h >> 32) as u32);
        let y = owen(second_dimension(index), mix(h) as u32);
        let unit = |bits: u32| (bits >> 8) as f32 * (1.0 / 16_777_216.0);
        [unit(x), unit(y)]
    }
}

/// Sobol's second dimension, the highest digit first.
#[inline]
fn second_dimension(mut index: u32) -> u32 {
    let (mut direction, mut sum) = (1u32 << 31, 0);
    while index != 0 {
        sum ^= direction & 0u32.wrapping_sub(index & 1);
        direction ^= direction >> 1;
        index >>= 1;
    }
    sum
}

/// Permutes the digits of `digits` (highest first), each by those above it: a hash in which bits only ever reach lower
/// ones of the number as it stands. On the bit-reversed number that is "only higher ones" (Laine and Karras 2011,
/// section 3.2; constants after Vegdahl as given by Burley).
#[inline(always)]
fn owen(digits: u32, seed: u32) -> u32 {
    let mut v = digits.reverse_bits();
    v ^= v.wrapping_mul(0x3d20_adea);
    v = v.wrapping_add(seed);
    v = v.wrapping_mul((seed >> 16) | 1);
    v ^= v.wrapping_mul(0x0552_6c56);
    v ^= v.wrapping_mul(0x53a2_2864);
    v.reverse_bits()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_elementary_box_gets_one_of_sixty_four_points_in_every_pair_and_set() {
        for seed in 0..50 {
            for pair in 0..6 {
                let points: Vec<_> = (0..64).map(|index| Strata { index, seed }.pair(pair)).collect();
                for split in 0..=6 {
                    let (across, down) = (1usize << split, 64usize >> split);
                    let mut hits = vec![0; 64];
                    for [x, y] in &points {
                        hits[(x * across as f32) as usize + across * (y * down as f32) as usize] += 1;
                    }
                    assert!(hits.iter().all(|&h| h == 1), "seed {seed}, pair {pair}, {across} x {down}: {hits:?}");
                }
            }
        }
    }

    #[test]
    fn a_single_scrambled_point_is_uniform_and_pairs_are_independent() {
        // Mean of n uniform numbers: 1/2 with deviation 1/sqrt(12 n); of products of two, 1/4 and sqrt(7/144 / n).
        let n = 20_000;
        for index in [0, 1, 5, 63] {
            let (mut x, mut y, mut xy, mut across) = (0.0, 0.0, 0.0, 0.0);
            for seed in 0..n {
                let point = Strata { index, seed: mix(seed) };
                let ([a, b], [c, _]) = (point.pair(0), point.pair(1));
                (x, y) = (x + f64::from(a), y + f64::from(b));
                (xy, across) = (xy + f64::from(a) * f64::from(b), across + f64::from(a) * f64::from(c));
            }
            let n = n as f64;
            let single = 4.0 / (12.0 * n).sqrt();
            let product = 4.0 * (7.0 / 144.0 / n).sqrt();
            assert!((x / n - 0.5).abs() < single && (y / n - 0.5).abs() < single, "{index}: {} {}", x / n, y / n);
            assert!((xy / n - 0.25).abs() < product && (across / n - 0.25).abs() < product, "{index}");
        }
    }

    #[test]
    fn the_mean_of_a_smooth_function_has_far_less_noise_than_with_plain_numbers() {
        let f = |[x, y]: [f32; 2]| f64::from((3.0 * x).sin() * (1.0 + y * y));
        let variance = |sample: &dyn Fn(u64, u32) -> [f32; 2]| {
            let means: Vec<f64> = (0..400).map(|s| (0..64).map(|i| f(sample(mix(s), i))).sum::<f64>() / 64.0).collect();
            let mean = means.iter().sum::<f64>() / 400.0;
            means.iter().map(|m| (m - mean).powi(2)).sum::<f64>() / 399.0
        };
        let scrambled = variance(&|seed, index| Strata { index, seed }.pair(2));
        let plain = variance(&|seed, index| {
            let mut random = Random::new(seed ^ u64::from(index) << 40);
            [random.unit(), random.unit()]
        });
        assert!(scrambled < plain / 100.0, "{scrambled} {plain}");
    }

    #[test]
    fn exponential_numbers_have_mean_and_variance_one_and_are_finite() {
        let mut random = Random::new(7);
        let n = 200_000;
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..n {
            let x = f64::from(random.exponential());
            assert!(x > 0.0 && x < 23.0);
            (sum, squares) = (sum + x, squares + x * x);
        }
        // Deviations of the means of x and x^2: 1 and sqrt(20), over sqrt(n).
        let n = f64::from(n);
        assert!((sum / n - 1.0).abs() < 4.0 / n.sqrt() && (squares / n - 2.0).abs() < 4.0 * (20.0 / n).sqrt());
    }
}
