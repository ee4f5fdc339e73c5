//! Noisy images for this folder's tests.

use super::Noise;

/// Independent standard normal numbers: SplitMix64 (Steele, Lea, Flood 2014) through Box and Muller (1958).
pub struct Normal(u64);

impl Normal {
    /// A sequence of its own for every seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xd134_2543_de82_ef95))
    }

    /// Uniform in (0, 1], 53 bits.
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (((z ^ (z >> 31)) >> 11) + 1) as f64 / (1u64 << 53) as f64
    }

    /// The next number.
    pub fn next(&mut self) -> f64 {
        let (radius, angle) = ((-2.0 * self.uniform().ln()).sqrt(), 2.0 * std::f64::consts::PI * self.uniform());
        radius * angle.cos()
    }
}

/// A mean image and its standard errors, from passes.
pub struct Measured {
    /// The mean.
    pub mean: Vec<[f32; 3]>,
    /// Its standard errors, estimated from the passes.
    pub standard_error: Vec<[f32; 3]>,
    passes: u32,
}

impl Measured {
    /// `passes` noisy images of `truth`; one pass has the standard deviation `deviation` of each sample's truth.
    pub fn new(truth: &[[f32; 3]], deviation: f64, passes: u32, normal: &mut Normal) -> Self {
        let sample = |v: f32, normal: &mut Normal| {
            let values: Vec<f64> = (0..passes).map(|_| f64::from(v) * (1.0 + deviation * normal.next())).collect();
            let mean = values.iter().sum::<f64>() / f64::from(passes);
            let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / f64::from(passes - 1);
            (mean as f32, (variance / f64::from(passes)).sqrt() as f32)
        };
        let pixels = truth.iter().map(|p| p.map(|v| sample(v, normal)));
        let (mean, standard_error) = pixels.map(|p| (p.map(|s| s.0), p.map(|s| s.1))).unzip();
        Self { mean, standard_error, passes }
    }

    /// The noise as the tests take it.
    pub fn noise(&self) -> Noise<'_> {
        Noise { standard_error: &self.standard_error, passes: Some(self.passes) }
    }
}

/// `width` x `height` pixels of 0.5 to 8, different from pixel to pixel and channel to channel.
pub fn truth(width: usize, height: usize) -> Vec<[f32; 3]> {
    let pixel = |i: usize| [0, 1, 2].map(|c| 0.5 * 2f32.powf(((i * 7 + c * 3) % 17) as f32 / 4.0));
    (0..width * height).map(pixel).collect()
}
