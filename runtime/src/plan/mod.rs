//! Which method and which settings: surveys of a scene, predictions from measurements, and the choice.
//!
//! 1. [`medium_survey`], [`light_survey`] and [`view_survey`] put figures on a frame, its lights and its camera;
//!    [`over_time`] on a sequence.
//! 2. [`methods`] says who can serve, [`ladder`] has their settings from coarse to fine, [`terms`] says what can be left
//!    out.
//! 3. [`table`] predicts error and seconds of every rung from measurements ([`work`] scales the seconds).
//! 4. [`mod@transfer`] says what a bake of the light's transfer costs and brings.
//! 5. [`choose`] takes the cheapest rung that meets an error, or the best that fits a time.
//!
//! Nothing here looks at a clock or at the machine: the same scene, goal and count of threads give the same plan.

pub mod choose;
pub mod ladder;
pub mod light_survey;
pub mod medium_survey;
pub mod methods;
pub mod over_time;
pub mod table;
pub mod terms;
pub mod transfer;
pub mod view_survey;
pub mod work;

use crate::camera::Camera;
use crate::light::Light;
use crate::medium::frame::Frame;
use crate::transport::medium::MediumParameters;
use light_survey::LightSurvey;
use medium_survey::MediumSurvey;
use view_survey::ViewSurvey;

/// The figures of one frame in its scene: all that a plan depends on.
#[derive(Clone, Debug, PartialEq)]
pub struct Survey {
    /// Of the medium.
    pub medium: MediumSurvey,
    /// Of the lights.
    pub light: LightSurvey,
    /// Of the camera's view.
    pub view: ViewSurvey,
    /// Fit error of the frame's Gaussians, sum (D - fit)^2 / sum D^2, if it has any.
    pub fit_error: Option<f64>,
    /// The medium that the frame's transfer was baked for, if it has any.
    pub transfer: Option<MediumParameters>,
}

impl Survey {
    /// Of `frame`, whose Gaussians alone are off by `fit_error`.
    pub fn of(
        frame: &Frame,
        parameters: &MediumParameters,
        lights: &[Light],
        camera: &Camera,
        fit_error: Option<f64>,
    ) -> Self {
        let light = LightSurvey::of(lights);
        let view = ViewSurvey::of(frame, parameters, lights, &light, camera);
        let transfer = frame.transfer.as_ref().map(|transfer| transfer.medium);
        Self { medium: MediumSurvey::of(frame, parameters), light, view, fit_error, transfer }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::light::Environment;
    use crate::medium::frame::Frame;
    use glam::DVec3;
    use medium_survey::tests::{ball, grey};
    use smoke_formats::gaussian::Gaussian;

    /// A ball with one Gaussian under a constant grey sky that is not seen.
    pub(crate) fn survey(sigma_t: f32, albedo: f32, g: f32) -> Survey {
        let gaussians = vec![Gaussian { center: [0.5; 3], radius: 0.3, weight: 1.0 }];
        let frame = Frame { gaussians, ..ball(10.0, 0.1) };
        let lights = [Light::Environment(Environment::constant([1.0; 3]))];
        let camera = Camera::look_at(DVec3::new(1.2, -10.0, 1.2), DVec3::splat(1.2), DVec3::Z, 20.0, 40, 40);
        Survey::of(&frame, &grey(sigma_t, albedo, g), &lights, &camera, None)
    }
}
