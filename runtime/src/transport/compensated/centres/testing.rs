//! Seeded media and random numbers for this folder's tests.

use smoke_formats::gaussian::Gaussian;

use crate::medium::gaussian_points::GaussianPoints;

/// PCG-XSH-RR 64/32 (O'Neill 2014).
pub struct Pcg(u64);

impl Pcg {
    /// A generator of its own for every seed.
    pub fn new(seed: u64) -> Self {
        let mut pcg = Self(seed.wrapping_add(0x853c_49e6_748f_ea9b));
        pcg.uniform();
        pcg
    }

    /// Uniform in [0, 1), 32 bits.
    pub fn uniform(&mut self) -> f64 {
        let old = self.0;
        self.0 = old.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let shifted = (((old >> 18) ^ old) >> 27) as u32;
        f64::from(shifted.rotate_right((old >> 59) as u32)) / 4_294_967_296.0
    }

    /// Uniform on the unit sphere.
    pub fn direction(&mut self) -> glam::DVec3 {
        let (z, phi) = (2.0 * self.uniform() - 1.0, 2.0 * std::f64::consts::PI * self.uniform());
        let sine = (1.0 - z * z).sqrt();
        glam::DVec3::new(sine * phi.cos(), sine * phi.sin(), z)
    }
}

/// `n` Gaussians along a rising, widening plume in the unit cube; radii 0.03 to 0.09, weights 0.3 to 1.
pub fn cloud(n: usize, seed: u64) -> Vec<Gaussian> {
    let mut pcg = Pcg::new(seed);
    (0..n)
        .map(|_| {
            let z = pcg.uniform();
            let wide = 0.08 + 0.2 * z;
            let mut side = || (0.5 + wide * (pcg.uniform() + pcg.uniform() + pcg.uniform() - 1.5)) as f32;
            let center = [side(), side(), (0.1 + 0.8 * z) as f32];
            let radius = (0.03 + 0.06 * pcg.uniform()) as f32;
            Gaussian { center, radius, weight: (0.3 + 0.7 * pcg.uniform()) as f32 }
        })
        .collect()
}

/// The set checked and transposed; panics on a bad one.
pub fn points(gaussians: &[Gaussian]) -> GaussianPoints {
    GaussianPoints::new(gaussians).expect("good Gaussians")
}
