//! The lights as the path tracer asks for them: one light of infinity drawn by its power, its direction by the guide to
//! where light gets through ([`super::guide`]); and points.

use super::guide::{self, Guide};
use super::sky::Sky;
use crate::light::Light;
use crate::medium::field::DensityField;
use crate::tracking::flight::Space;
use crate::tracking::majorant::Majorants;
use glam::{DVec3, Vec3};

/// Cells along the side of a guide's brick, as a power of two.
const GUIDE_SHIFT: u32 = 2;

/// A light of infinity.
enum Distant {
    Sky(Box<Sky>, Guide),
    Sun { toward: Vec3, irradiance: Vec3 },
}

/// All lights of a scene.
#[derive(Default)]
pub struct Lights {
    distant: Vec<Distant>,
    /// Sum of the parts of the power up to and with each; the last is 1.
    chances: Vec<f32>,
    /// Position in world space, and radiant intensity in W/sr.
    pub points: Vec<(DVec3, Vec3)>,
}

/// Light from one drawn direction.
pub struct Drawn {
    /// Unit vector to the light.
    pub toward: Vec3,
    /// Radiance over the density of the draw, W / m^2.
    pub irradiance: Vec3,
    /// Density over solid angle with which the direction is drawn; infinite for a sun.
    pub density: f32,
}

impl Lights {
    /// Tables for `lights` around `field` with extinction `sigma`; black ones are left out.
    pub fn new(lights: &[Light], field: &DensityField, space: &Space, sigma: f32) -> Self {
        let middles = Majorants::middles(field, GUIDE_SHIFT);
        let mut all = Self::default();
        let mut powers = Vec::new();
        for light in lights {
            match light {
                Light::Environment(environment) => {
                    if let Some(sky) = Sky::new(environment) {
                        powers.push(sky.flux());
                        let guide = Guide::new(space, &middles, &sky, sigma);
                        all.distant.push(Distant::Sky(Box::new(sky), guide));
                    }
                }
                Light::Directional { toward, irradiance } => {
                    let irradiance = Vec3::from_array(*irradiance);
                    if irradiance.max_element() > 0.0 {
                        powers.push(f64::from(irradiance.element_sum()) / 3.0);
                        all.distant.push(Distant::Sun { toward: *toward, irradiance });
                    }
                }
                Light::Point { position, intensity } => {
                    let intensity = Vec3::from_array(*intensity);
                    if intensity.max_element() > 0.0 {
                        all.points.push((*position, intensity));
                    }
                }
            }
        }
        let total = powers.iter().sum::<f64>();
        let mut sum = 0.0;
        all.chances = powers
            .iter()
            .map(|p| {
                sum += p;
                (sum / total) as f32
            })
            .collect();
        if let Some(last) = all.chances.last_mut() {
            *last = 1.0;
        }
        all
    }

    /// True if there is light from infinity.
    pub fn has_distant(&self) -> bool {
        !self.distant.is_empty()
    }

    /// True if there is light that a scattered ray can run into.
    pub fn has_sky(&self) -> bool {
        self.distant.iter().any(|d| matches!(d, Distant::Sky(..)))
    }

    fn chance(&self, i: usize) -> f32 {
        self.chances[i] - if i == 0 { 0.0 } else { self.chances[i - 1] }
    }

    /// Light from a direction drawn for `at` (node space) by `choice` and `u`, all in [0, 1), and `jitter` around it; there
    /// must be some. None where `look` in [0, 1) says that a sky of which little arrives is not looked at this time; when it
    /// is, it counts for those.
    #[inline]
    pub fn draw(&self, at: DVec3, jitter: [f32; 3], choice: f32, u: [f32; 2], look: f32) -> Option<Drawn> {
        let i = self.chances.partition_point(|&c| c <= choice).min(self.distant.len() - 1);
        let chance = self.chance(i);
        Some(match &self.distant[i] {
            Distant::Sky(sky, guide) => {
                let outlook = guide.around(at, jitter);
                if look >= outlook.look {
                    return None;
                }
                let (bin, tile, v) = guide::draw(&outlook.sums, u[1]);
                let drawn = sky.sample(bin, [u[0], v]);
                let density = drawn.density * (chance * tile / sky.parts()[bin]);
                Drawn {
                    toward: drawn.direction,
                    irradiance: Vec3::from_array(drawn.radiance) / (density * outlook.look),
                    density,
                }
            }
            Distant::Sun { toward, irradiance } => {
                Drawn { toward: *toward, irradiance: *irradiance / chance, density: f32::INFINITY }
            }
        })
    }

    /// Radiance that a ray along `way` runs into, each sky by the share of it that is not [`Self::draw`]'s, when `way`
    /// was drawn with `density` at `at` (power heuristic: Veach 1997, section 9.2.4). `jitter` as in that draw.
    #[inline]
    pub fn run_into(&self, at: DVec3, jitter: [f32; 3], way: Vec3, density: f32) -> Vec3 {
        let mut sum = Vec3::ZERO;
        for (i, distant) in self.distant.iter().enumerate() {
            if let Distant::Sky(sky, guide) = distant {
                let (seen, bin) = sky.seen(way);
                if sky.parts()[bin] > 0.0 {
                    let tile = guide::chance(&guide.around(at, jitter).sums, bin) / sky.parts()[bin];
                    let drawn = seen.density * (self.chance(i) * tile);
                    sum += Vec3::from_array(seen.radiance) * share(density, drawn);
                }
            }
        }
        sum
    }
}

/// Part of the first of two densities by the power heuristic; an infinite second one takes all.
#[inline(always)]
pub fn share(of: f32, other: f32) -> f32 {
    let ratio = other / of;
    1.0 / (1.0 + ratio * ratio)
}
