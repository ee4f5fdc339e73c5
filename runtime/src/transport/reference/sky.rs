//! Directions to an environment map, drawn in proportion to what comes from them.
//!
//! The map is bilinear between the middles of its texels ([`Environment::radiance_from`]), so the patches between four
//! middles are where it is one polynomial: width x (height + 1) of them, with half patches at the poles. A patch is drawn
//! by its flux, row first and then column, a place in it by the bilinear density itself (inverting a marginal and a
//! conditional linear density, Pharr, Jakob and Humphreys 2016, section 13.6.7, and its second-edition errata on
//! bilinear patches). So radiance over density is almost constant; what is left is the cosine of the elevation within a
//! patch, and colour. Density over solid angle:
//! `p = P(patch) * b(s, t) / mean(b) / (width of the patch * height * cos(elevation))`.
//! Cost: O(texels) once; two binary searches a direction.

use crate::light::Environment;
use glam::Vec3;
use std::f64::consts::{PI, TAU};

/// An environment with its tables.
pub struct Sky {
    environment: Environment,
    /// Sum up to and with each row, of all patches; the last is the whole flux.
    rows: Vec<f64>,
    /// The same within each row, `[row * width + column]`, from 0 to the row's flux.
    columns: Vec<f32>,
}

/// A drawn direction.
#[derive(Clone, Copy, Debug)]
pub struct Toward {
    /// Unit vector to the sky, world space.
    pub direction: Vec3,
    /// What comes from there.
    pub radiance: [f32; 3],
    /// Density of the draw, per solid angle; above zero.
    pub density: f32,
}

fn brightness(c: [f32; 3]) -> f32 {
    (c[0] + c[1] + c[2]) * (1.0 / 3.0)
}

impl Sky {
    /// Tables for `environment`; none if it is black.
    pub fn new(environment: &Environment) -> Option<Self> {
        let environment = environment.clone();
        let (width, height) = (environment.width, environment.height);
        let mut sky = Self { environment, rows: Vec::new(), columns: Vec::with_capacity(width * (height + 1)) };
        let mut all = 0.0f64;
        for row in 0..=height {
            let (top, bottom) = sky.band(row);
            let solid_angle = ((0.5 - top) * PI).sin() - ((0.5 - bottom) * PI).sin();
            let mut sum = 0.0f64;
            for column in 0..width {
                let corners = sky.corners(column, row).map(brightness);
                sum += f64::from(corners.iter().sum::<f32>()) * 0.25 * solid_angle * TAU / width as f64;
                sky.columns.push(sum as f32);
            }
            all += sum;
            sky.rows.push(all);
        }
        (all > 0.0 && all.is_finite()).then_some(sky)
    }

    /// Flux: the integral of the mean channel over the sphere.
    pub fn flux(&self) -> f64 {
        self.rows[self.rows.len() - 1]
    }

    /// Upper and lower end of a row of patches, as texture coordinates v.
    fn band(&self, row: usize) -> (f64, f64) {
        let at = |r: f64| (r / self.environment.height as f64).clamp(0.0, 1.0);
        (at(row as f64 - 0.5), at(row as f64 + 0.5))
    }

    /// Radiance at the corners of a patch: upper left, upper right, lower left, lower right.
    fn corners(&self, column: usize, row: usize) -> [[f32; 3]; 4] {
        let Environment { width, height, radiance, .. } = &self.environment;
        let right = if column + 1 == *width { 0 } else { column + 1 };
        let (above, below) = (row.saturating_sub(1), row.min(height - 1));
        [(column, above), (right, above), (column, below), (right, below)].map(|(i, j)| radiance[j * width + i])
    }

    /// A direction for `u` in [0, 1)^2.
    pub fn sample(&self, u: [f32; 2]) -> Toward {
        let width = self.environment.width;
        let target = f64::from(u[1]) * self.flux();
        let row = self.rows.partition_point(|&sum| sum <= target).min(self.rows.len() - 1);
        let before = if row == 0 { 0.0 } else { self.rows[row - 1] };
        let flux = self.rows[row] - before;
        let rest_y = if flux > 0.0 { ((target - before) / flux) as f32 } else { 0.5 };
        let line = &self.columns[row * width..(row + 1) * width];
        let target = u[0] * line[width - 1];
        let column = line.partition_point(|&sum| sum <= target).min(width - 1);
        let before = if column == 0 { 0.0 } else { line[column - 1] };
        let share = line[column] - before;
        let rest_x = if share > 0.0 { (target - before) / share } else { 0.5 };

        let corners = self.corners(column, row);
        let [a, b, c, d] = corners.map(brightness);
        let t = linear(a + b, c + d, rest_y.clamp(0.0, 1.0));
        let s = linear(a + (c - a) * t, b + (d - b) * t, rest_x.clamp(0.0, 1.0));
        let mix = |k: usize| {
            let upper = corners[0][k] + (corners[1][k] - corners[0][k]) * s;
            let lower = corners[2][k] + (corners[3][k] - corners[2][k]) * s;
            upper + (lower - upper) * t
        };
        let radiance = [mix(0), mix(1), mix(2)];
        let (top, bottom) = self.band(row);
        let v = top + (bottom - top) * f64::from(t);
        let direction = self.environment.direction((column as f64 + 0.5 + f64::from(s)) / width as f64, v).as_vec3();
        let density = self.density(row, brightness(radiance), v);
        Toward { direction, radiance, density: density.max(f32::MIN_POSITIVE) }
    }

    /// Radiance from a unit direction, world space, and the density with which [`Self::sample`] draws it.
    pub fn seen(&self, direction: Vec3) -> Toward {
        let [u, v] = self.environment.place(direction);
        let height = self.environment.height;
        let row = ((v * height as f64 + 0.5) as usize).min(height);
        let radiance = self.environment.radiance_at([u, v]);
        Toward { direction, radiance, density: self.density(row, brightness(radiance), v) }
    }

    /// Density at texture coordinate `v` in a row of patches, where the brightness is `there`: P(patch) / mean(b) is the
    /// patch's solid angle over the whole flux, and its width cancels.
    fn density(&self, row: usize, there: f32, v: f64) -> f32 {
        let (top, bottom) = self.band(row);
        let band = ((0.5 - top) * PI).sin() - ((0.5 - bottom) * PI).sin();
        // At the very poles the density is infinite, and nothing falls there.
        let flat = (bottom - top) * PI * ((0.5 - v) * PI).cos().max(1e-9);
        (f64::from(there) * band / (flat * self.flux())) as f32
    }
}

/// Draws x in [0, 1] with a density that goes linearly from `a` to `b`, both >= 0.
#[inline(always)]
fn linear(a: f32, b: f32, u: f32) -> f32 {
    let sum = a + b;
    let positive = sum > 0.0;
    if !positive {
        return u;
    }
    // u (a + b) / (a + sqrt((1 - u) a^2 + u b^2)), scaled so that no square overflows or vanishes.
    let (a, b) = (a / sum, b / sum);
    let root = (a * a * (1.0 - u) + b * b * u).sqrt();
    if a + root > 0.0 { (u / (a + root)).min(1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::reference::sampler::{Random, Strata};

    /// A dim slope with one texel like a sun, and a black quarter.
    fn map() -> Environment {
        let (width, height) = (24, 12);
        let radiance = (0..width * height).map(|t| match (t % width, t / width) {
            (7, 3) => [4000.0, 3000.0, 1000.0],
            (x, _) if x >= 18 => [0.0; 3],
            (x, y) => [0.1 + 0.02 * x as f32, 0.3, 0.05 * y as f32],
        });
        let radiance = radiance.collect();
        Environment { width, height, radiance, rotation: 0.7, ..Environment::constant([0.0; 3]) }
    }

    /// Integral over the sphere by midpoints, `n` times finer than the texels.
    fn integral(environment: &Environment, n: usize, f: impl Fn(Vec3, [f64; 2]) -> f64) -> f64 {
        let (columns, rows) = (environment.width * n, environment.height * n);
        let mut sum = 0.0;
        for j in 0..rows {
            for i in 0..columns {
                let [u, v] = [(i as f64 + 0.5) / columns as f64, (j as f64 + 0.5) / rows as f64];
                let weight = ((0.5 - v) * PI).cos() * PI / rows as f64 * TAU / columns as f64;
                sum += weight * f(environment.direction(u, v).as_vec3(), [u, v]);
            }
        }
        sum
    }

    #[test]
    fn the_density_is_above_zero_where_there_is_light_and_its_integral_is_one() {
        for up_is_y in [false, true] {
            let environment = Environment { up_is_y, ..map() };
            let sky = Sky::new(&environment).unwrap();
            let total = integral(&environment, 16, |d, _| f64::from(sky.seen(d).density));
            // Midpoints of a bilinear function over a cosine: (1/16)^2 of a per cent.
            assert!((total - 1.0).abs() < 1e-3, "{total}");
            let flux = integral(&environment, 16, |d, _| f64::from(brightness(environment.radiance_from(d))));
            assert!((sky.flux() / flux - 1.0).abs() < 0.02, "{} {flux}", sky.flux());
        }
    }

    #[test]
    fn a_drawn_direction_comes_with_the_radiance_and_density_that_are_seen_there() {
        let sky = Sky::new(&map()).unwrap();
        let mut random = Random::new(1);
        for _ in 0..20_000 {
            let drawn = sky.sample([random.unit(), random.unit()]);
            let seen = sky.seen(drawn.direction);
            // A direction in f32 moves by 1e-7, a texel is 0.26 wide and the sun's edges are as steep as 4000 over it.
            let close = |a: f32, b: f32| (a - b).abs() <= 1e-3 * a.abs() + 5e-3;
            assert!((0..3).all(|c| close(drawn.radiance[c], seen.radiance[c])), "{drawn:?} {seen:?}");
            assert!(close(drawn.density, seen.density) && (drawn.direction.length() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn the_mean_of_radiance_over_density_is_the_flux_of_every_channel_with_little_noise() {
        let environment = map();
        let sky = Sky::new(&environment).unwrap();
        let mut means = Vec::new();
        for seed in 0..200 {
            let mut mean = [0.0f64; 3];
            for index in 0..64 {
                let drawn = sky.sample(Strata { index, seed }.pair(0));
                (0..3).for_each(|c| mean[c] += f64::from(drawn.radiance[c] / drawn.density) / 64.0);
            }
            means.push(mean);
        }
        for c in 0..3 {
            let flux = integral(&environment, 40, |d, _| f64::from(environment.radiance_from(d)[c]));
            let mean = means.iter().map(|m| m[c]).sum::<f64>() / 200.0;
            let error = (means.iter().map(|m| (m[c] - mean).powi(2)).sum::<f64>() / 199.0 / 200.0).sqrt();
            // The midpoints are good to 1e-4 themselves.
            assert!((mean - flux).abs() < 4.0 * error + 2e-4 * flux, "{c}: {mean} {flux} {error}");
            assert!(error < 0.01 * mean, "{error} {mean}");
        }
    }

    #[test]
    fn black_and_single_texel_maps_are_answered() {
        assert!(Sky::new(&Environment::constant([0.0; 3])).is_none());
        let one = Environment { width: 1, height: 1, radiance: vec![[2.0; 3]], ..Environment::constant([0.0; 3]) };
        let sky = Sky::new(&one).unwrap();
        for u in [[0.0, 0.0], [0.5, 0.25], [0.999_999_9, 0.999_999_9]] {
            let drawn = sky.sample(u);
            assert_eq!(drawn.radiance, [2.0; 3]);
            assert!(drawn.density > 0.0 && drawn.density.is_finite() && drawn.direction.is_finite());
        }
        let above = sky.seen(Vec3::Z);
        assert!(above.density.is_finite() && above.radiance == [2.0; 3]);
    }
}
