//! The estimate of one pixel in one pass: what its rays meet, and the paths from there on.
//!
//! A camera ray's opacity is exact ([`super::tracking::Column`]); it ends in collisions that are spread evenly over it.
//! From each a path goes on: at every collision one light of infinity is drawn and connected through an estimate of the
//! transmittance, then a way is drawn from the phase function and flown along (Veach 1997, Raab et al. 2008). Rays that
//! run into the sky count too, both by the power heuristic. Points light the whole piece of ray before a collision:
//! a place on it is drawn by `1 / distance^2` to the point (equiangular: Kulla and Fajardo 2012, section 3), because at
//! the collisions themselves that factor has no finite variance. Paths whose weight has fallen go on by chance
//! (Russian roulette); the longest are cut, and what they still carried is reported.
//! Cost: a pixel without smoke one look along its rays; others `RAYS * ENDS` paths.

use super::lights::{Lights, share};
use crate::backdrop::Sky as Backdrop;
use crate::camera::Camera;
use crate::march::Backdrop as _;
use crate::tracking::flight::{Column, Extinction, Ray, Space};
use crate::tracking::phase;
use crate::tracking::sampler::{Random, Strata, mix};
use glam::{DVec3, Vec3};

/// Rays through a pixel in one pass.
pub const RAYS: u32 = 2;
/// Most collisions on each, for an opaque one; fewer where it is not.
pub const ENDS: u32 = 8;
/// Part of a path's first weight below which it goes on by chance.
const FALLEN: f32 = 0.5;
/// Collisions after which a path is cut: in an albedo of 1 a path comes out of thick smoke again after N collisions
/// with a chance of `N^(-1/2)` or so.
pub const LONGEST: u32 = 16_384;

/// All that a path depends on.
pub struct Scene<'a> {
    /// The density.
    pub space: Space<'a>,
    /// Extinction of each channel, and what all have in common.
    pub sigma_t: [f32; 3],
    /// The same, ready to fly.
    pub extinction: Extinction,
    /// Scattered part of it.
    pub albedo: Vec3,
    /// Mean cosine.
    pub g: f32,
    /// The lights.
    pub lights: Lights,
    /// Lights that the camera sees.
    pub backdrop: Backdrop,
    /// The camera.
    pub camera: Camera,
    /// The eye in node space.
    pub eye: DVec3,
    /// Most collisions of a path.
    pub orders: u32,
    /// Seed of everything.
    pub seed: u64,
}

/// Means over the rays of one pixel in one pass.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Radiance, premultiplied by nature, with what is seen behind.
    pub radiance: Vec3,
    /// Transmittance of each channel.
    pub transmittance: Vec3,
    /// Least depth along the view of any density, world units; infinite if there is none.
    pub depth: f32,
    /// Weight (mean channel) that paths still carried where they were cut.
    pub truncated: f32,
}

impl Scene<'_> {
    /// Pixel (`x`, `y`) in pass `pass`.
    pub fn pixel(&self, x: usize, y: usize, pass: u32, column: &mut Column) -> Sample {
        let number = (y * self.camera.width + x) as u64;
        let seed = mix(self.seed ^ mix(number << 32 | u64::from(pass)));
        let mut sum = Sample { radiance: Vec3::ZERO, transmittance: Vec3::ZERO, depth: f32::INFINITY, truncated: 0.0 };
        for number in 0..RAYS {
            let [dx, dy] = Strata { index: number, seed }.pair(0);
            let way = self.camera.direction(x as f64 + f64::from(dx), y as f64 + f64::from(dy));
            let ray = self.space.ray(self.eye, way.as_vec3());
            column.measure(&self.space, &ray);
            let optical = |c: usize| f64::from(self.sigma_t[c]) * column.total;
            let through = Vec3::new((-optical(0)).exp() as f32, (-optical(1)).exp() as f32, (-optical(2)).exp() as f32);
            sum.transmittance += through;
            let behind = self.backdrop.behind(way);
            sum.radiance += through * Vec3::from_array(behind);
            if let Some(first) = column.first() {
                let depth = first * way.dot(self.camera.forward);
                sum.depth = sum.depth.min(depth as f32);
            }
            self.ends(&ray, way.as_vec3(), column, Strata { index: number, seed }, &mut sum);
        }
        let share = 1.0 / RAYS as f32;
        sum.radiance *= share;
        sum.transmittance *= share;
        sum.truncated *= share;
        sum
    }

    /// Adds what the smoke along a camera ray sends to the eye.
    fn ends(&self, ray: &Ray, way: Vec3, column: &Column, strata: Strata, sum: &mut Sample) {
        let opacity = |c: usize| -(-f64::from(self.sigma_t[c]) * column.total).exp_m1();
        let opacities = [opacity(0), opacity(1), opacity(2)];
        let whole: f64 = opacities.iter().sum();
        let any = whole > 0.0 && self.albedo.max_element() > 0.0 && self.orders > 0;
        if !any {
            return;
        }
        let mean = whole / 3.0;
        let ends = (mean * f64::from(ENDS)).ceil().clamp(1.0, f64::from(ENDS)) as u32;
        let ends = ends.next_power_of_two();
        let share = 1.0 / ends as f32;
        for end in 0..ends {
            let points = Strata { index: strata.index * ends + end, seed: strata.seed };
            let [u, choice] = points.pair(1);
            let mut random = Random::new(mix(strata.seed ^ (u64::from(points.index) + 1)));
            if !self.lights.points.is_empty() {
                let line = self.point_light(ray, way, &mut random);
                sum.radiance += self.albedo * line * share;
            }
            // The channel whose opacity is drawn, and a place at which that channel has become opaque so far.
            let mut u = f64::from(u) * whole;
            let c = (0..2).find(|&c| {
                let inside = u < opacities[c];
                if !inside {
                    u -= opacities[c];
                }
                inside
            });
            let c = c.unwrap_or(2);
            let sigma = f64::from(self.sigma_t[c]);
            let inside = sigma > 0.0 && u < 1.0;
            let depth = if inside { (-(-u).ln_1p() / sigma).min(column.total) } else { column.total };
            // Each channel's density over the mean one of the draw, all at this depth.
            let density = Vec3::from_array(std::array::from_fn(|c| {
                let sigma = f64::from(self.sigma_t[c]);
                (sigma * (-sigma * depth).exp()) as f32
            }));
            let weight = if self.extinction.grey {
                Vec3::splat(mean as f32)
            } else {
                density * (whole as f32 / density.element_sum())
            };
            let place = ray.at(column.place(&self.space, ray, depth));
            let path = Path { place, way, weight: weight * share, points, choice };
            self.follow(path, &mut random, sum);
        }
    }

    /// Adds what arrives by paths that go on from a first collision.
    fn follow(&self, path: Path, random: &mut Random, sum: &mut Sample) {
        let Path { mut place, mut way, mut weight, points, choice } = path;
        let fallen = FALLEN * weight.max_element();
        let sky = self.lights.has_sky();
        for collision in 1..=LONGEST {
            weight *= self.albedo;
            let lives = weight.max_element() > 0.0;
            if !lives {
                return;
            }
            let jitter = [random.unit(), random.unit(), random.unit()];
            let stratified = collision <= 2;
            let draw = |pair: u32, random: &mut Random| {
                if stratified { points.pair(pair + 2 * (collision - 1)) } else { [random.unit(), random.unit()] }
            };
            if self.lights.has_distant() {
                let choice = if collision == 1 { choice } else { random.unit() };
                let (u, look) = (draw(2, random), random.unit());
                if let Some(drawn) = self.lights.draw(place, jitter, choice, u, look) {
                    let scattered = phase::value(self.g, way.dot(drawn.toward));
                    let counted = if sky { share(drawn.density, scattered) } else { 1.0 };
                    let ray = self.space.ray(place, drawn.toward);
                    let through = self.space.transmittance(&ray, f64::INFINITY, &self.extinction, random);
                    sum.radiance += weight * drawn.irradiance * through * (scattered * counted);
                }
            }
            let last = collision >= self.orders;
            if last && !sky {
                return;
            }
            let (after, cosine) = phase::sample(self.g, way, draw(3, random));
            way = after;
            let ray = self.space.ray(place, way);
            if last {
                let through = self.space.transmittance(&ray, f64::INFINITY, &self.extinction, random);
                sum.radiance +=
                    weight * through * self.lights.run_into(place, jitter, way, phase::value(self.g, cosine));
                return;
            }
            if !self.lights.points.is_empty() {
                sum.radiance += weight * self.albedo * self.point_light(&ray, way, random);
            }
            let Some(distance) = self.space.flight(&ray, f64::INFINITY, &self.extinction, &mut weight, random) else {
                if sky {
                    sum.radiance += weight * self.lights.run_into(place, jitter, way, phase::value(self.g, cosine));
                }
                return;
            };
            place = ray.at(distance);
            let left = weight.max_element();
            if left < fallen {
                let chance = left / fallen;
                let goes_on = random.unit() < chance;
                if !goes_on {
                    return;
                }
                weight *= 1.0 / chance;
            }
        }
        sum.truncated += weight.element_sum() / 3.0;
    }

    /// Radiance that the points send back along `ray` (unit vector of the world: `way`) by one collision on it,
    /// albedo not yet counted.
    fn point_light(&self, ray: &Ray, way: Vec3, random: &mut Random) -> Vec3 {
        let Some((near, far)) = self.space.span(ray) else { return Vec3::ZERO };
        let origin = self.space.world(ray.origin);
        let mut sum = Vec3::ZERO;
        for &(position, intensity) in &self.lights.points {
            let along = (position - origin).dot(way.as_dvec3());
            let apart = (position - (origin + way.as_dvec3() * along)).length();
            // On the line itself the density of the draw is infinite, and nothing falls there.
            let apart = apart.max(1e-12 * (far - near));
            let (first, last) = (((near - along) / apart).atan(), ((far - along) / apart).atan());
            let turn = last - first;
            let angle = first + turn * f64::from(random.unit());
            let distance = (along + apart * angle.tan()).clamp(near, far);
            let place = ray.at(distance);
            let density = self.space.density(place);
            let lit = density > 0.0 && turn > 0.0;
            if !lit {
                continue;
            }
            let there = position - (origin + way.as_dvec3() * distance);
            let length = there.length();
            let toward = (there / length).as_vec3();
            // 1 / length^2 over the density `apart / (turn length^2)` of the draw.
            let factor = (turn / apart) as f32 * density * phase::value(self.g, way.dot(toward));
            let before = self.space.transmittance(ray, distance, &self.extinction, random);
            let beyond = self.space.transmittance(&self.space.ray(place, toward), length, &self.extinction, random);
            sum += intensity * before * beyond * Vec3::from_array(self.sigma_t) * factor;
        }
        sum
    }
}

/// A path at its first collision.
struct Path {
    /// Node space.
    place: DVec3,
    /// The way there, a unit vector of the world.
    way: Vec3,
    /// What it counts for.
    weight: Vec3,
    points: Strata,
    choice: f32,
}
