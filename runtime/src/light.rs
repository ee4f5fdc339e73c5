//! Lights: environments and suns at infinity, points; and the reduction of those at infinity to a bounded number of beams.
//!
//! A *beam* is all the light of a solid angle sent along that solid angle's mean direction. An environment is cut into
//! cells by repeated halving: the cell with the largest second moment `sum flux |w - mean|^2` is split, across its
//! widest axis, at the mean. So a small sun soon has cells of its own and keeps its place and flux exactly, and smooth
//! sky is shared out evenly. This is the quadrature of all single scattering; the number of beams is its dial.
//! Cost: O(texels log beams), after texels were pooled to at most [`POOLED_WIDTH`] across.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Environments wider than this are pooled before they are cut into cells: a texel of 1.4 degrees, far below the size
/// of any cell, and its flux and mean direction are kept exactly.
const POOLED_WIDTH: usize = 256;
/// Samples across, at least, when an environment is averaged over cells.
const CELL_SAMPLES: usize = 512;

/// A latitude-longitude environment of radiance: linear Rec.709, row 0 at the zenith.
///
/// For a unit direction d with up = z, texel coordinates are `u = 0.5 - atan2(d.y, d.x) / 2 pi` (less the rotation) and
/// `v = 0.5 - asin(d.z) / pi`; for up = y the direction is first turned to `(x, -z, y)`.
#[derive(Clone, Debug)]
pub struct Environment {
    /// Texels across.
    pub width: usize,
    /// Texels down.
    pub height: usize,
    /// Radiance, row by row from the top, W / (m^2 sr); finite, >= 0.
    pub radiance: Vec<[f32; 3]>,
    /// Counter-clockwise turn seen from above, radians.
    pub rotation: f64,
    /// True if y is up in the world, false if z is.
    pub up_is_y: bool,
    /// True if the camera sees it behind the smoke.
    pub visible: bool,
}

impl Environment {
    /// The same radiance from everywhere.
    pub fn constant(radiance: [f32; 3]) -> Self {
        Self { width: 64, height: 32, radiance: vec![radiance; 64 * 32], rotation: 0.0, up_is_y: false, visible: false }
    }

    /// Unit direction, world space, of texel coordinates (`u`, `v`) in [0, 1].
    pub fn direction(&self, u: f64, v: f64) -> DVec3 {
        let (azimuth, elevation) = (self.azimuth(u), Self::elevation(v));
        self.turned(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin())
    }

    fn azimuth(&self, u: f64) -> f64 {
        (0.5 - u) * std::f64::consts::TAU + self.rotation
    }

    fn elevation(v: f64) -> f64 {
        (0.5 - v) * std::f64::consts::PI
    }

    /// From a world where z is up.
    fn turned(&self, x: f64, y: f64, z: f64) -> DVec3 {
        if self.up_is_y { DVec3::new(x, z, -y) } else { DVec3::new(x, y, z) }
    }

    /// Texture coordinates in [0, 1] of a unit direction, world space: the way back of [`Self::direction`].
    pub fn place(&self, d: Vec3) -> [f64; 2] {
        let (x, y, z) = if self.up_is_y { (d.x, -d.z, d.y) } else { (d.x, d.y, d.z) };
        let u = 0.5 - (f64::from(y).atan2(f64::from(x)) - self.rotation) / std::f64::consts::TAU;
        let v = 0.5 - f64::from(z.clamp(-1.0, 1.0)).asin() / std::f64::consts::PI;
        [u - u.floor(), v]
    }

    /// Radiance that arrives from direction `d` (a unit vector that points to the sky), bilinear between the middles of
    /// the texels: round the horizon, and the topmost and lowest rows for the poles.
    pub fn radiance_from(&self, d: Vec3) -> [f32; 3] {
        self.radiance_at(self.place(d))
    }

    /// Radiance at texture coordinates in [0, 1].
    pub fn radiance_at(&self, [u, v]: [f64; 2]) -> [f32; 3] {
        let (x, y) = (u * self.width as f64 - 0.5, v * self.height as f64 - 0.5);
        let (f, g) = ((x - x.floor()) as f32, (y - y.floor()) as f32);
        // One turn more than none, so that the cast of -1 cannot happen.
        let column = |step: usize| ((x + self.width as f64).floor() as usize + step) % self.width;
        let row = |step: f64| ((y.floor() + step).max(0.0) as usize).min(self.height - 1);
        let (left, right) = (column(0), column(1));
        let (above, below) = (row(0.0) * self.width, row(1.0) * self.width);
        let (a, b) = (&self.radiance[above + left], &self.radiance[above + right]);
        let (c, d) = (&self.radiance[below + left], &self.radiance[below + right]);
        let mix = |a: f32, b: f32, f: f32| a * (1.0 - f) + b * f;
        [0, 1, 2].map(|k| mix(mix(a[k], b[k], f), mix(c[k], d[k], f), g))
    }

    /// Mean radiance over each of `count` cells of a partition of the sphere, of which `cell` tells the one of a unit
    /// direction, world space. Texels are sampled in their middle, or on a grid where they are larger than
    /// 2 pi / [`CELL_SAMPLES`]. A cell that no sample falls in gets zero.
    pub fn mean_over_cells(&self, count: usize, cell: impl Fn(DVec3) -> usize + Sync) -> Vec<[f64; 3]> {
        let split = CELL_SAMPLES.div_ceil(self.width);
        let rows = self.height * split;
        let row_sums = (0..rows).into_par_iter().map(|row| {
            let (top, bottom) = (row as f64 / rows as f64, (row + 1) as f64 / rows as f64);
            let solid_angle = (std::f64::consts::PI * top).cos() - (std::f64::consts::PI * bottom).cos();
            let mut sums: Vec<(usize, [f64; 4])> = Vec::new();
            for column in 0..self.width * split {
                let direction =
                    self.direction((column as f64 + 0.5) / (self.width * split) as f64, 0.5 * (top + bottom));
                let radiance = self.radiance[row / split * self.width + column / split];
                let at = cell(direction);
                if sums.last().is_none_or(|(last, _)| *last != at) {
                    sums.push((at, [0.0; 4]));
                }
                if let Some((_, sum)) = sums.last_mut() {
                    (0..3).for_each(|c| sum[c] += f64::from(radiance[c]) * solid_angle);
                    sum[3] += solid_angle;
                }
            }
            sums
        });
        let mut cells = vec![[0.0f64; 4]; count];
        for (at, sum) in row_sums.collect::<Vec<_>>().into_iter().flatten() {
            (0..4).for_each(|c| cells[at][c] += sum[c]);
        }
        cells.iter().map(|s| [0, 1, 2].map(|c| if s[3] > 0.0 { s[c] / s[3] } else { 0.0 })).collect()
    }

    /// The sky as small beams: unit directions to it with what they bring, radiance times solid angle. Texels are pooled
    /// to at most `across` columns; then each beam has the exact flux and mean direction of its texels.
    pub fn texels(&self, across: usize) -> Vec<(DVec3, [f64; 3])> {
        let lit = self.pooled(across).into_iter().filter(|t| t.weight > 0.0);
        lit.map(|t| (t.moment.normalize_or(DVec3::Z), t.flux)).collect()
    }

    /// The same with what beams are cut by.
    fn pooled(&self, across: usize) -> Vec<Texel> {
        let pool = self.width.div_ceil(across).max(1);
        let (columns, rows) = (self.width.div_ceil(pool), self.height.div_ceil(pool));
        let mut texels = vec![Texel::default(); columns * rows];
        let across: Vec<[f64; 2]> = (0..self.width)
            .map(|column| {
                let azimuth = self.azimuth((column as f64 + 0.5) / self.width as f64);
                [azimuth.cos(), azimuth.sin()]
            })
            .collect();
        texels.par_chunks_mut(columns).enumerate().for_each(|(pooled, texels)| {
            for row in pooled * pool..((pooled + 1) * pool).min(self.height) {
                let (top, bottom) = (row as f64 / self.height as f64, (row + 1) as f64 / self.height as f64);
                let band = (std::f64::consts::PI * top).cos() - (std::f64::consts::PI * bottom).cos();
                let solid_angle = band * std::f64::consts::TAU / self.width as f64;
                let elevation = Self::elevation(0.5 * (top + bottom));
                let (level, z) = (elevation.cos(), elevation.sin());
                let line = &self.radiance[row * self.width..][..self.width];
                for ((texel, line), across) in texels.iter_mut().zip(line.chunks(pool)).zip(across.chunks(pool)) {
                    for (radiance, [cosine, sine]) in line.iter().zip(across) {
                        let flux = radiance.map(|r| f64::from(r) * solid_angle);
                        texel.add(&Texel::new(self.turned(level * cosine, level * sine, z), flux));
                    }
                }
            }
        });
        texels
    }
}

/// A light.
#[derive(Clone, Debug)]
pub enum Light {
    /// Light from the whole sphere.
    Environment(Environment),
    /// Parallel light: `toward` is the unit vector to the light, `irradiance` what a surface facing it receives, W/m^2.
    Directional {
        /// Unit vector to the light, world space.
        toward: Vec3,
        /// On a surface that faces the light.
        irradiance: [f32; 3],
    },
    /// An isotropic point, which no camera sees. Only methods that say so serve it.
    Point {
        /// World space, finite.
        position: DVec3,
        /// Radiant intensity, W/sr, finite, >= 0.
        intensity: [f32; 3],
    },
}

/// Light from one direction: `irradiance` on a surface that faces it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Unit vector to the light, world space.
    pub toward: Vec3,
    /// Irradiance on a surface facing the beam, RGB.
    pub irradiance: [f32; 3],
}

/// Flux and its first moments over a patch of sky.
#[derive(Clone, Copy, Debug, Default)]
struct Texel {
    flux: [f64; 3],
    weight: f64,
    moment: DVec3,
}

impl Texel {
    fn new(direction: DVec3, flux: [f64; 3]) -> Self {
        let weight = flux.iter().sum::<f64>();
        Self { flux, weight, moment: direction * weight }
    }

    fn add(&mut self, other: &Self) {
        (0..3).for_each(|c| self.flux[c] += other.flux[c]);
        self.weight += other.weight;
        self.moment += other.moment;
    }

    fn mean(&self) -> DVec3 {
        self.moment / self.weight
    }
}

/// A set of texels, its sum and its second moment about the mean along each axis.
struct Cell {
    texels: Vec<Texel>,
    sum: Texel,
    spread: DVec3,
}

impl Cell {
    fn new(texels: Vec<Texel>) -> Self {
        let mut sum = Texel::default();
        texels.iter().for_each(|t| sum.add(t));
        let mean = sum.mean();
        let spread = texels.iter().fold(DVec3::ZERO, |s, t| {
            let d = t.mean() - mean;
            s + d * d * t.weight
        });
        Self { texels, sum, spread }
    }

    fn moment(&self) -> f64 {
        self.spread.element_sum()
    }

    /// Two cells across the widest axis, at the mean; none if one of them would be empty.
    fn split(&self) -> Option<(Self, Self)> {
        let axis = (0..3).max_by(|&a, &b| self.spread[a].total_cmp(&self.spread[b]))?;
        let at = self.sum.mean()[axis];
        let (low, high): (Vec<_>, Vec<_>) = self.texels.iter().partition(|t| t.mean()[axis] < at);
        (!low.is_empty() && !high.is_empty()).then(|| (Self::new(low), Self::new(high)))
    }
}

/// All lights at infinity as beams: one for each directional light, and at most `per_environment` for each environment.
/// Beams without light are left out. The sum of their irradiances is the light's whole flux.
pub fn beams(lights: &[Light], per_environment: usize) -> Vec<Beam> {
    let mut out = Vec::new();
    for light in lights {
        match light {
            Light::Directional { toward, irradiance } => out.push(Beam { toward: *toward, irradiance: *irradiance }),
            Light::Environment(environment) => environment_beams(environment, per_environment.max(1), &mut out),
            Light::Point { .. } => {}
        }
    }
    out.retain(|b| b.irradiance.iter().any(|&e| e > 0.0));
    out
}

fn environment_beams(environment: &Environment, count: usize, out: &mut Vec<Beam>) {
    let lit: Vec<Texel> = environment.pooled(POOLED_WIDTH).into_iter().filter(|t| t.weight > 0.0).collect();
    if lit.is_empty() {
        return;
    }
    let mut cells = vec![Cell::new(lit)];
    while cells.len() < count {
        // The first of equal ones, so that the result does not depend on anything but the picture.
        let widest = (0..cells.len()).rev().max_by(|&a, &b| cells[a].moment().total_cmp(&cells[b].moment()));
        let Some((low, high)) = widest.and_then(|w| cells[w].split().map(|halves| (w, halves))).map(|(w, (l, h))| {
            cells.swap_remove(w);
            (l, h)
        }) else {
            break;
        };
        cells.push(low);
        cells.push(high);
    }
    out.extend(cells.iter().map(|cell| Beam {
        toward: cell.sum.moment.normalize_or(DVec3::Z).as_vec3(),
        irradiance: cell.sum.flux.map(|f| f as f32),
    }));
}

#[cfg(test)]
mod tests {
    use super::*;

    fn total(beams: &[Beam]) -> f64 {
        beams.iter().map(|b| f64::from(b.irradiance[1])).sum()
    }

    #[test]
    fn beams_of_a_constant_sky_carry_four_pi_and_share_it_evenly() {
        let beams = beams(&[Light::Environment(Environment::constant([1.0; 3]))], 64);
        assert_eq!(beams.len(), 64);
        assert!((total(&beams) / (4.0 * std::f64::consts::PI) - 1.0).abs() < 1e-6);
        let mean = beams.iter().fold(Vec3::ZERO, |s, b| s + b.toward * b.irradiance[1]);
        assert!(mean.length() < 1e-3 * total(&beams) as f32, "{mean}");
        let largest = beams.iter().map(|b| b.irradiance[1]).fold(0.0, f32::max);
        assert!(largest < 3.0 * 4.0 * std::f32::consts::PI / 64.0);
    }

    #[test]
    fn one_bright_texel_keeps_its_flux_and_its_direction() {
        for (row, column) in [(0, 0), (3, 100), (64, 511), (200, 77), (255, 300)] {
            let mut environment = Environment::constant([0.0; 3]);
            (environment.width, environment.height, environment.rotation) = (512, 256, 0.3);
            environment.radiance = vec![[1e-6; 3]; 512 * 256];
            environment.radiance[row * 512 + column] = [1e6; 3];
            let all = beams(&[Light::Environment(environment.clone())], 32);
            let sun = all.iter().max_by(|a, b| a.irradiance[1].total_cmp(&b.irradiance[1])).unwrap();
            let direction = environment.direction((column as f64 + 0.5) / 512.0, (row as f64 + 0.5) / 256.0).as_vec3();
            assert!((sun.toward - direction).length() < 1e-4);
            // A direction in f32 is off by 1e-7, and half a texel from a pole (0.006) its angles by 1e-7 / 0.006: of a
            // texel of 0.012, 1.4e-3 in each of two angles.
            assert!((environment.radiance_from(direction)[1] / 1e6 - 1.0).abs() < 3e-3);
            assert!(f64::from(sun.irradiance[1]) / total(&all) > 0.99);
        }
    }

    #[test]
    fn a_dark_sky_gives_no_beams_and_up_is_y_turns_the_sky() {
        assert!(beams(&[Light::Environment(Environment::constant([0.0; 3]))], 32).is_empty());
        let mut sky = Environment::constant([0.0; 3]);
        sky.radiance[..64 * 4].fill([1.0; 3]);
        sky.up_is_y = true;
        let all = beams(&[Light::Environment(sky)], 4);
        assert!(all.iter().all(|b| b.toward.y > 0.8));
    }
}
