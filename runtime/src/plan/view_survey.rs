//! What the camera sees of a frame: how many pixels, how deep, and how much of it is sky.
//!
//! [`RAYS`] of the camera's own rays along each side of the image are marched a voxel at a time through the density. Errors
//! are relative to all that is seen in a pixel with smoke; where a sky is visible through thin smoke, they are diluted by
//! `sqrt(sum S^2 / sum (S + B)^2)`, `B = L(d) e^-tau` the sky behind and `S = albedo (1 - e^-tau) L_mean` a guess of the
//! smoke; but not below [`LEAST_DILUTION`], because transmittance has errors too, and they show where the sky is bright.
//! Cost: `RAYS^2` rays.

use crate::camera::Camera;
use crate::light::Light;
use crate::medium::frame::Frame;
use crate::plan::light_survey::LightSurvey;
use crate::transport::medium::MediumParameters;
use glam::DVec3;
use rayon::prelude::*;

/// Rays along a side of the image.
const RAYS: usize = 48;
/// What a visible sky leaves of an error at least. Of the plume under a visible sunset, rung `draft`, the share that was
/// left was 0.5 at optical depth 6 and 0.3 at 60, where `S` and `B` alone give 0.26 and 0.38; at 0.3 at most 0.45 (0.02).
const LEAST_DILUTION: f64 = 0.4;

/// The figures of one view of one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewSurvey {
    /// Pixels of the image.
    pub pixels: f64,
    /// Share of the rays that meet density, 0 to 1.
    pub seen: f64,
    /// Voxels with density that a ray passes, mean over all rays.
    pub voxels_a_ray: f64,
    /// What is left of a relative error of the smoke beside the sky that shows through, above 0; 1 without a visible sky.
    pub dilution: f64,
}

impl ViewSurvey {
    /// The figures of `frame` under `lights` from `camera`.
    pub fn of(
        frame: &Frame,
        parameters: &MediumParameters,
        lights: &[Light],
        light: &LightSurvey,
        camera: &Camera,
    ) -> Self {
        let rows = |row: usize| {
            let ray = |column: usize| {
                let at = |i: usize, size: usize| (i as f64 + 0.5) * size as f64 / RAYS as f64;
                let direction = camera.direction(at(column, camera.width), at(row, camera.height));
                let (voxels, column) = through(frame, camera.position, direction);
                let behind = if voxels > 0 && light.visible { behind(lights, direction) } else { [0.0; 3] };
                Ray::of(voxels, column, behind, parameters, light)
            };
            (0..RAYS).map(ray).fold(Ray::default(), Ray::plus)
        };
        // Rows are added up in order, so that the sum does not depend on threads.
        let sum = (0..RAYS).into_par_iter().map(rows).collect::<Vec<_>>().into_iter().fold(Ray::default(), Ray::plus);
        let rays = (RAYS * RAYS) as f64;
        let diluted = light.visible && sum.smoke > 0.0;
        Self {
            pixels: camera.width as f64 * camera.height as f64,
            seen: sum.seen / rays,
            voxels_a_ray: sum.voxels / rays,
            dilution: if diluted { (sum.smoke / sum.all).sqrt().max(LEAST_DILUTION) } else { 1.0 },
        }
    }
}

/// Sums over rays.
#[derive(Clone, Copy, Default)]
struct Ray {
    seen: f64,
    voxels: f64,
    smoke: f64,
    all: f64,
}

impl Ray {
    fn of(voxels: usize, column: f64, behind: [f32; 3], parameters: &MediumParameters, light: &LightSurvey) -> Self {
        let mut ray = Self { seen: f64::from(u8::from(voxels > 0)), voxels: voxels as f64, ..Self::default() };
        for c in 0..3 {
            let transmittance = (-f64::from(parameters.sigma_t[c]) * column).exp();
            let smoke = f64::from(parameters.albedo[c]) * (1.0 - transmittance) * light.mean_radiance[c];
            let all = smoke + transmittance * f64::from(behind[c]);
            ray.smoke += smoke * smoke;
            ray.all += all * all;
        }
        ray
    }

    fn plus(self, other: Self) -> Self {
        Self {
            seen: self.seen + other.seen,
            voxels: self.voxels + other.voxels,
            smoke: self.smoke + other.smoke,
            all: self.all + other.all,
        }
    }
}

/// Voxels with density along a ray, and the integral of the density.
fn through(frame: &Frame, eye: DVec3, direction: DVec3) -> (usize, f64) {
    let field = &frame.field;
    let node_from_world = field.world_from_node.inverse();
    let (origin, along) = (node_from_world.transform_point3(eye), node_from_world.transform_vector3(direction));
    let (mut near, mut far) = (0.0f64, f64::INFINITY);
    for a in 0..3 {
        let top = (field.dims[a] - 1) as f64;
        let (t0, t1) = (-origin[a] / along[a], (top - origin[a]) / along[a]);
        if along[a].abs() < 1e-300 {
            if !(origin[a] >= 0.0 && origin[a] <= top) {
                return (0, 0.0);
            }
            continue;
        }
        (near, far) = (near.max(t0.min(t1)), far.min(t0.max(t1)));
    }
    // A voxel a step, in node space; a box has at most the sum of its sides of them.
    let voxel = 1.0 / along.length();
    let most = field.dims.iter().sum::<usize>();
    let (mut voxels, mut column) = (0, 0.0);
    for step in 0..most {
        let t = near + (step as f64 + 0.5) * voxel;
        let inside = t < far;
        if !inside {
            break;
        }
        let density = field.sample((origin + along * t).as_vec3());
        voxels += usize::from(density > 0.0);
        column += f64::from(density) * voxel;
    }
    (voxels, column)
}

/// The visible environments' radiance from `direction`.
fn behind(lights: &[Light], direction: DVec3) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for light in lights {
        if let Light::Environment(environment) = light
            && environment.visible
        {
            let radiance = environment.radiance_from(direction.as_vec3());
            (0..3).for_each(|c| sum[c] += radiance[c]);
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Environment;
    use crate::plan::medium_survey::tests::{ball, grey};

    fn survey(sigma_t: f32, visible: bool, target: DVec3) -> ViewSurvey {
        let frame = ball(20.0, 0.05);
        let centre = frame.field.world_from_node.transform_point3(DVec3::splat(22.0));
        let lights = [Light::Environment(Environment { visible, ..Environment::constant([1.0; 3]) })];
        let camera = Camera::look_at(centre - DVec3::Y * 100.0, centre + target, DVec3::Z, 2.0, 200, 200);
        ViewSurvey::of(&frame, &grey(sigma_t, 1.0, 0.0), &lights, &LightSurvey::of(&lights), &camera)
    }

    #[test]
    fn a_ball_fills_its_share_of_the_image_and_its_rays_pass_its_mean_chord() {
        let view = survey(1.0, false, DVec3::ZERO);
        // The image is 200 tan(1 degree) = 3.491 wide; the ball's disc, radius 1, is 3.1416 of its 12.187. The trilinear
        // edge adds half a voxel on average to the radius: 5 % of the area, and as much again to be sure.
        let disc = std::f64::consts::PI / (200.0 * 1f64.to_radians().tan()).powi(2);
        assert!((view.seen / disc - 1.05).abs() < 0.06, "{} {disc}", view.seen);
        // Mean chord of 4/3 of a radius of 20 voxels, and about a voxel of edge.
        assert!((view.voxels_a_ray / view.seen - 4.0 / 3.0 * 20.0 - 1.0).abs() < 1.5, "{}", view.voxels_a_ray);
        assert_eq!((view.pixels, view.dilution), (40_000.0, 1.0));
    }

    #[test]
    fn a_visible_sky_dilutes_the_error_of_thin_smoke_and_not_of_thick() {
        // Smoke of albedo 1 under a sky of 1: S = 1 - T and B = T, together 1. Over a disc chords c of a ball of radius 1
        // have the density c / 2: the mean of (1 - e^-c)^2 is 1/2 (2 - 2 (1 - 3 e^-2) + (1 - 5 e^-4) / 4), its root 0.721;
        // the trilinear edge adds rays to the disc, 5 % of its area, that see next to nothing.
        let middle = survey(1.0, true, DVec3::ZERO).dilution;
        assert!((middle / 0.721 - 1.0).abs() < 0.06, "{middle}");
        assert_eq!(survey(0.01, true, DVec3::ZERO).dilution, LEAST_DILUTION);
        assert!(survey(1e3, true, DVec3::ZERO).dilution > 0.97);
    }

    #[test]
    fn a_camera_that_looks_away_sees_nothing() {
        let view = survey(1.0, true, DVec3::new(0.0, -200.0, 0.0));
        assert_eq!((view.seen, view.voxels_a_ray, view.dilution), (0.0, 0.0, 1.0));
    }
}
