//! What is behind the smoke: visible environments, and the sky as a strong forward peak passes it on.
//!
//! Where part of the forward peak counts as not scattered (delta-M, [`crate::transport::medium`]), the light in it still
//! was scattered: it belongs to the medium's radiance, arrives from just about the viewing direction, and is as wide as
//! the peak. Its moments are 1 up to the order n of the harmonics and `g^(l-n)` beyond, half of which is left at band
//! `n + ln 2 / -ln g`; we blur the lights by the Henyey–Greenstein lobe with the same half-way band, at most g = 0.9,
//! because the map on which it is done has cells of 5.6 degrees. Weights are normalised, so a uniform sky stays exact.
//! Cost: O(2048^2) for the map, once for lights and g; one or two look-ups a ray.

use crate::light::{Environment, Light};
use crate::march::Backdrop;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// Cells of the peak's map, around and from pole to pole.
const MAP: [usize; 2] = [64, 32];
/// Sharpest lobe that the map can hold.
const SHARPEST: f64 = 0.9;

/// The lights as the camera sees them.
#[derive(Clone, Debug, Default)]
pub struct Sky {
    visible: Vec<Environment>,
    /// Blurred radiance, [`MAP`], the z axis as pole; empty if no peak was taken out.
    peak: Vec<[f32; 3]>,
}

impl Sky {
    /// `peak` is (g, order) where a peak was taken out.
    pub fn new(lights: &[Light], peak: Option<(f32, usize)>) -> Self {
        let visible = lights.iter().filter_map(|light| match light {
            Light::Environment(environment) if environment.visible => Some(environment.clone()),
            _ => None,
        });
        Self { visible: visible.collect(), peak: peak.map_or_else(Vec::new, |(g, order)| blurred(lights, g, order)) }
    }

    /// The environments that the camera sees.
    #[cfg(feature = "gpu")]
    pub(crate) fn visible(&self) -> &[Environment] {
        &self.visible
    }

    /// The peak's map, 64 across from +x over +y and 32 down from +z; empty if no peak was taken out.
    #[cfg(feature = "gpu")]
    pub(crate) fn peak(&self) -> &[[f32; 3]] {
        &self.peak
    }

    fn peak_at(&self, column: isize, row: isize) -> [f32; 3] {
        let row = row.clamp(0, MAP[1] as isize - 1) as usize;
        self.peak[row * MAP[0] + column.rem_euclid(MAP[0] as isize) as usize]
    }
}

/// Map coordinates, in cells: around from +x over +y, and down from +z.
fn place(d: DVec3) -> [f64; 2] {
    let turn = d.y.atan2(d.x) / TAU;
    [(turn - turn.floor()) * MAP[0] as f64, d.z.clamp(-1.0, 1.0).acos() / PI * MAP[1] as f64]
}

fn blurred(lights: &[Light], g: f32, order: usize) -> Vec<[f32; 3]> {
    let count = MAP[0] * MAP[1];
    let direction = |cell: usize| {
        let turn = (cell % MAP[0]) as f64 + 0.5;
        let (phi, theta) = (turn * TAU / MAP[0] as f64, ((cell / MAP[0]) as f64 + 0.5) * PI / MAP[1] as f64);
        DVec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos())
    };
    let solid_angle = |cell: usize| {
        let edge = |row: usize| (row as f64 * PI / MAP[1] as f64).cos();
        (edge(cell / MAP[0]) - edge(cell / MAP[0] + 1)) * TAU / MAP[0] as f64
    };
    let cell = |d: DVec3| {
        let [u, v] = place(d);
        (v as usize).min(MAP[1] - 1) * MAP[0] + (u as usize).min(MAP[0] - 1)
    };
    let mut sky = vec![[0.0f64; 3]; count];
    for light in lights {
        match light {
            Light::Environment(environment) => {
                let means = environment.mean_over_cells(count, cell);
                sky.iter_mut().zip(means).for_each(|(s, m)| (0..3).for_each(|c| s[c] += m[c]));
            }
            Light::Directional { toward, irradiance } => {
                let at = cell(toward.as_dvec3());
                (0..3).for_each(|c| sky[at][c] += f64::from(irradiance[c]) / solid_angle(at));
            }
            Light::Point { .. } => {}
        }
    }
    let half_way = order as f64 + std::f64::consts::LN_2 / -f64::from(g).ln();
    let lobe = 0.5f64.powf(1.0 / half_way).min(SHARPEST);
    let cells: Vec<(DVec3, f64)> = (0..count).map(|c| (direction(c), solid_angle(c))).collect();
    (0..count)
        .into_par_iter()
        .map(|to| {
            let (mut sum, mut total) = ([0.0; 3], 0.0);
            for ((d, solid_angle), radiance) in cells.iter().zip(&sky) {
                let base = 1.0 + lobe * lobe - 2.0 * lobe * d.dot(cells[to].0);
                let weight = solid_angle / (base * base.sqrt());
                (0..3).for_each(|c| sum[c] += weight * radiance[c]);
                total += weight;
            }
            sum.map(|s| (s / total) as f32)
        })
        .collect()
}

impl Backdrop for Sky {
    fn behind(&self, direction: DVec3) -> [f32; 3] {
        let mut sum = [0.0; 3];
        for environment in &self.visible {
            let radiance = environment.radiance_from(direction.as_vec3());
            (0..3).for_each(|c| sum[c] += radiance[c]);
        }
        sum
    }

    fn through_peak(&self, direction: DVec3) -> [f32; 3] {
        if self.peak.is_empty() {
            return [0.0; 3];
        }
        let [u, v] = place(direction).map(|p| p - 0.5);
        let (i, j) = (u.floor() as isize, v.floor() as isize);
        let (f, g) = ((u - u.floor()) as f32, (v - v.floor()) as f32);
        let lerp = |a: [f32; 3], b: [f32; 3], f: f32| [0, 1, 2].map(|c| a[c] + (b[c] - a[c]) * f);
        let row = |j: isize| lerp(self.peak_at(i, j), self.peak_at(i + 1, j), f);
        lerp(row(j), row(j + 1), g)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn a_uniform_sky_passes_through_a_peak_unchanged_and_only_visible_ones_are_seen() {
        let mut sky = Environment::constant([1.0, 2.0, 3.0]);
        let hidden = Sky::new(&[Light::Environment(sky.clone())], Some((0.9, 4)));
        for d in [DVec3::X, DVec3::NEG_Z, DVec3::Z, DVec3::new(0.6, -0.8, 0.0)] {
            assert_eq!(hidden.behind(d), [0.0; 3]);
            (0..3).for_each(|c| assert!((hidden.through_peak(d)[c] - (c + 1) as f32).abs() < 1e-5));
        }
        sky.visible = true;
        let seen = Sky::new(&[Light::Environment(sky)], None);
        assert_eq!((seen.behind(DVec3::X), seen.through_peak(DVec3::X)), ([1.0, 2.0, 3.0], [0.0; 3]));
    }

    #[test]
    fn a_sun_becomes_a_lobe_around_it_that_keeps_most_of_its_flux() {
        let toward = Vec3::new(0.48, 0.64, 0.6);
        let sky = Sky::new(&[Light::Directional { toward, irradiance: [5.0; 3] }], Some((0.8, 4)));
        let (mut flux, n) = (0.0, 20_000);
        for i in 0..n {
            let (z, phi) = (1.0 - (f64::from(i) + 0.5) * 2.0 / f64::from(n), f64::from(i) * 2.399_963_229_7);
            let d = DVec3::new((1.0 - z * z).sqrt() * phi.cos(), (1.0 - z * z).sqrt() * phi.sin(), z);
            flux += f64::from(sky.through_peak(d)[0]) * 4.0 * PI / f64::from(n);
        }
        // Weights are normalised where they arrive, not where they start: the same up to the cells' unevenness.
        assert!((flux / 5.0 - 1.0).abs() < 0.1, "{flux}");
        assert!(sky.through_peak(toward.as_dvec3())[0] > 50.0 * sky.through_peak(-toward.as_dvec3())[0]);
    }
}
