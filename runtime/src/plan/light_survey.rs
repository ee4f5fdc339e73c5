//! How directional the light is, and whether it has a colour.
//!
//! Lights from infinity, all together, have coefficients `c_lm = sum over beams E y_lm(toward)`, and band l the energy
//! `e_l = sum over m of c_lm^2`, which no rotation of the sky changes. Normalised over the six bands, a constant sky has
//! (1, 0, 0, 0, 0, 0) and a sun, by the addition theorem, (2l + 1) / 36. *Directionality* is `(1 - e_0) 36 / 35`: 0 for a
//! constant sky, 1 for a sun, and also for two suns from opposite sides. Environments are cut into [`CELLS`] beams with
//! exact flux and mean direction: cells of 7 degrees, which a harmonic of band 5 sees as points to about 2 %.
//! Cost: one pass over the texels, and one over the beams.

use crate::light::{Light, beams};
use crate::sphere::harmonics::{BAND, MAX_ORDER, evaluate};
use crate::transport::compensated::grid::channels::is_single_channel;
use crate::transport::medium::MediumParameters;

/// Beams that each environment is cut into.
const CELLS: usize = 1024;
/// A medium that leaves the question of colour to the light.
const GREY: MediumParameters = MediumParameters { sigma_t: [1.0; 3], albedo: [1.0; 3], g: 0.0 };

/// The figures of a scene's lights.
#[derive(Clone, Debug, PartialEq)]
pub struct LightSurvey {
    /// Environments.
    pub environments: usize,
    /// Directional lights.
    pub directional: usize,
    /// Which of the lights are points, from 0.
    pub points: Vec<usize>,
    /// Energy of each band of the light from infinity, normalised to the sum 1; all zero in the dark.
    pub bands: [f64; MAX_ORDER],
    /// Share of the flux from infinity that the brightest beam brings, 0 to 1.
    pub brightest: f64,
    /// Radiance of the light from infinity, mean over the sphere, RGB.
    pub mean_radiance: [f64; 3],
    /// True if every light is the same in all three channels.
    pub grey: bool,
    /// True if the camera sees an environment behind the smoke.
    pub visible: bool,
}

impl LightSurvey {
    /// The figures of `lights`.
    pub fn of(lights: &[Light]) -> Self {
        let beams = beams(lights, CELLS);
        let mut coefficients = [0.0f64; MAX_ORDER * MAX_ORDER];
        let (mut flux, mut brightest, mut mean_radiance) = (0.0f64, 0.0f64, [0.0f64; 3]);
        for beam in &beams {
            let channels = beam.irradiance.map(f64::from);
            let power = channels.iter().sum::<f64>();
            let harmonics = evaluate(MAX_ORDER, beam.toward);
            coefficients.iter_mut().zip(harmonics).for_each(|(c, y)| *c += power * f64::from(y));
            (flux, brightest) = (flux + power, brightest.max(power));
            (0..3).for_each(|c| mean_radiance[c] += channels[c] / (4.0 * std::f64::consts::PI));
        }
        let mut bands = [0.0; MAX_ORDER];
        coefficients.iter().enumerate().for_each(|(i, c)| bands[BAND[i]] += c * c);
        let energy: f64 = bands.iter().sum();
        let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
        let count = |kind: fn(&Light) -> bool| lights.iter().filter(|light| kind(light)).count();
        let is_point = |light: &Light| matches!(light, Light::Point { .. });
        Self {
            environments: count(|light| matches!(light, Light::Environment(_))),
            directional: count(|light| matches!(light, Light::Directional { .. })),
            points: (0..lights.len()).filter(|&i| is_point(&lights[i])).collect(),
            bands: bands.map(|band| share(band, energy)),
            brightest: share(brightest, flux),
            mean_radiance,
            grey: is_single_channel(&GREY, lights),
            visible: lights.iter().any(|light| matches!(light, Light::Environment(e) if e.visible)),
        }
    }

    /// 0 for a constant sky, 1 for a sun; 0 in the dark.
    pub fn directionality(&self) -> f64 {
        let all = (MAX_ORDER * MAX_ORDER) as f64;
        if self.is_dark() { 0.0 } else { (1.0 - self.bands[0]) * all / (all - 1.0) }
    }

    /// True if nothing comes from infinity.
    pub fn is_dark(&self) -> bool {
        self.bands == [0.0; MAX_ORDER]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Environment;
    use glam::{DVec3, Vec3};

    fn sun(toward: Vec3, irradiance: [f32; 3]) -> Light {
        Light::Directional { toward: toward.normalize(), irradiance }
    }

    fn sky(color: [f32; 3]) -> Light {
        Light::Environment(Environment::constant(color))
    }

    /// Radiance 1 from the upper half.
    fn dome(rotation: f64, up_is_y: bool) -> Light {
        let mut environment = Environment::constant([0.0; 3]);
        environment.radiance[..64 * 16].fill([1.0; 3]);
        Light::Environment(Environment { rotation, up_is_y, ..environment })
    }

    #[test]
    fn a_constant_sky_has_one_band_and_a_sun_all_of_them_by_the_addition_theorem() {
        let constant = LightSurvey::of(&[sky([1.0, 2.0, 3.0])]);
        // Cells of a constant sky are not quite even: a per cent of amplitude at most.
        assert!(constant.bands[0] > 0.999 && constant.directionality() < 1e-3, "{:?}", constant.bands);
        (0..3).for_each(|c| assert!((constant.mean_radiance[c] - (c + 1) as f64).abs() < 1e-5));
        assert!(!constant.grey && constant.brightest < 0.01);
        let sun = LightSurvey::of(&[sun(Vec3::new(0.3, -0.5, 0.8), [2.0; 3])]);
        (0..6).for_each(|l| assert!((sun.bands[l] - (2 * l + 1) as f64 / 36.0).abs() < 1e-5, "{:?}", sun.bands));
        assert!((sun.directionality() - 1.0).abs() < 1e-5 && sun.grey && sun.brightest == 1.0);
    }

    #[test]
    fn half_a_sky_has_its_closed_form_whichever_way_it_is_turned() {
        // c_l0 = sqrt((2l+1) pi) int_0^1 P_l = sqrt((2l+1) pi) (1, 1/2, 0, -1/8, 0, 1/16).
        let integral = [1.0, 0.5, 0.0, -0.125, 0.0, 0.0625f64];
        let energy: Vec<f64> = (0..6).map(|l| (2 * l + 1) as f64 * integral[l] * integral[l]).collect();
        let total: f64 = energy.iter().sum();
        for (rotation, up_is_y) in [(0.0, false), (1.0, false), (0.0, true)] {
            let survey = LightSurvey::of(&[dome(rotation, up_is_y)]);
            // Cells of 7 degrees: see the module's head.
            (0..6).for_each(|l| assert!((survey.bands[l] - energy[l] / total).abs() < 2e-3, "{:?}", survey.bands));
        }
    }

    #[test]
    fn two_opposite_suns_are_directional_and_lights_are_counted() {
        let point = Light::Point { position: DVec3::ZERO, intensity: [1.0; 3] };
        let both = [sun(Vec3::Z, [1.0; 3]), point.clone(), sun(-Vec3::Z, [1.0; 3])];
        let survey = LightSurvey::of(&both);
        // Odd bands cancel: 1 + 5 + 9 of energy, a fifteenth of it in band 0.
        assert!((survey.directionality() - 14.0 / 15.0 * 36.0 / 35.0).abs() < 1e-5);
        assert_eq!((survey.directional, survey.environments, &survey.points[..]), (2, 0, &[1][..]));
        assert!((survey.brightest - 0.5).abs() < 1e-9);
        let alone = LightSurvey::of(&[point]);
        assert!(alone.is_dark() && alone.directionality() == 0.0 && alone.brightest == 0.0);
        assert!(LightSurvey::of(&[]).is_dark() && !LightSurvey::of(&[sun(Vec3::X, [1.0, 1.0, 0.9])]).grey);
    }
}
