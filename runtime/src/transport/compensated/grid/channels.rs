//! How many channels the grid route carries: one where neither medium nor light has colour, else three.
//!
//! Where only the medium is grey, its exponentials are shared by the three channels all the same, which is most of a
//! sweep's arithmetic; what is left to each channel is the light's own (measured: `docs/decisions/032-left-out-terms.md`).

use crate::light::{Beam, Light};
use crate::transport::medium::{BandedMedium, MediumParameters};

/// Whether the source radiance under these lights is the same in all channels, so that one stands for the three: a grey
/// medium, and light that has red = green = blue from everywhere.
pub fn is_single_channel(medium: &MediumParameters, lights: &[Light]) -> bool {
    is_grey(medium.sigma_t)
        && is_grey(medium.albedo)
        && lights.iter().all(|light| match light {
            Light::Environment(environment) => environment.radiance.iter().copied().all(is_grey),
            Light::Directional { irradiance, .. } => is_grey(*irradiance),
            Light::Point { intensity, .. } => is_grey(*intensity),
        })
}

fn is_grey([red, green, blue]: [f32; 3]) -> bool {
    red == green && red == blue
}

/// Channels that the source radiance under `beams` is carried in: [`is_single_channel`] of what they were made from.
pub(super) fn channels(medium: &BandedMedium, beams: &[Beam]) -> usize {
    let grey = is_grey(medium.sigma_t) && is_grey(medium.albedo) && beams.iter().all(|b| is_grey(b.irradiance));
    if grey { 1 } else { 3 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::light::{Environment, beams};
    use crate::march::{Black, MarchMedium, MarchSettings, march};
    use crate::medium::field::DensityField;
    use crate::shaded_volume::ShadedVolume;
    use crate::transport::compensated::grid::route::{GridSettings, GridSource, GridTransport};
    use crate::transport::{ScatteringOrder, SourceRadiance};
    use glam::{DAffine3, DVec3, Vec3};

    fn blob() -> DensityField {
        let n = 16;
        let value = |v: usize| {
            let p = Vec3::new((v % n) as f32, (v / n % n) as f32, (v / n / n) as f32) - 7.5;
            (-(p / 4.0).length_squared()).exp()
        };
        let values: Vec<f32> = (0..n * n * n).map(value).collect();
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_scale(DVec3::splat(0.1)))
    }

    fn grey(g: f32) -> MediumParameters {
        MediumParameters { sigma_t: [6.0; 3], albedo: [0.9; 3], g }
    }

    fn solved(lights: &[Light], medium: &MediumParameters) -> GridSource {
        let settings = GridSettings { beams: 16, rings: 3, tolerance: 1e-5, ..Default::default() };
        let beams = beams(lights, settings.beams);
        let source = GridTransport::new(settings).solve(&blob(), &beams, &medium.banded(4), ScatteringOrder::All);
        assert_eq!(source.channels == 1, is_single_channel(medium, lights));
        source
    }

    /// A sky that is brighter above, and a sun.
    fn lights(sun: [f32; 3]) -> [Light; 2] {
        let mut sky = Environment::constant([1.0; 3]);
        sky.radiance.iter_mut().take(64 * 16).for_each(|r| *r = [3.0; 3]);
        [Light::Environment(sky), Light::Directional { toward: Vec3::new(0.6, 0.0, 0.8), irradiance: sun }]
    }

    /// The next float after 2: a colour that nobody sees, but a colour.
    const TINTED: [f32; 3] = [2.0, 2.0, 2.000_000_2];

    #[test]
    fn one_channel_gives_the_image_that_three_give() {
        let field = blob();
        let eye = field.world_from_node.transform_point3(DVec3::new(60.0, 20.0, 30.0));
        let centre = field.world_from_node.transform_point3(DVec3::splat(8.5));
        let camera = Camera::look_at(eye, centre, DVec3::Z, 20.0, 24, 24);
        for g in [0.0, 0.5] {
            let (one, three) = (solved(&lights([2.0; 3]), &grey(g)), solved(&lights(TINTED), &grey(g)));
            assert_eq!((one.channels, three.channels, one.iterations), (1, 3, three.iterations));
            let view = |source: &GridSource| {
                let settings = MarchSettings::default();
                let mut volume = ShadedVolume::of(&field);
                source.shade(&field, eye, &mut volume);
                march(&volume, &camera, &MarchMedium::plain([6.0; 3]), &Black, &settings)
            };
            let mut seen = 0;
            for (a, b) in view(&one).pixels.iter().zip(&view(&three).pixels) {
                assert_eq!((a.transmittance, a.depth), (b.transmittance, b.depth));
                seen += usize::from(a.alpha() > 0.1);
                // The tint is 1.2e-7 of the sun; the solver's dot products round differently over one channel and over
                // three, by a few 6e-8, which goes into its steps, and these into all of x.
                (0..3).for_each(|c| {
                    assert!((a.radiance[c] - b.radiance[c]).abs() <= 2e-6 * b.radiance[c], "{g} {a:?} {b:?}");
                });
            }
            assert!(seen > 50);
        }
    }

    #[test]
    fn any_colour_of_medium_or_light_needs_three() {
        let white = lights([2.0; 3]);
        assert_eq!(solved(&white, &grey(0.3)).channels, 1);
        assert_eq!(solved(&[], &grey(0.3)).channels, 1);
        assert_eq!(solved(&lights(TINTED), &grey(0.3)).channels, 3);
        assert_eq!(solved(&white, &MediumParameters { sigma_t: [3.0, 3.0, 4.0], ..grey(0.0) }).channels, 3);
        assert_eq!(solved(&white, &MediumParameters { albedo: [0.9, 0.8, 0.9], ..grey(0.8) }).channels, 3);
        let mut sky = Environment::constant([1.0; 3]);
        sky.radiance[77][2] = 1.5;
        assert_eq!(solved(&[Light::Environment(sky)], &grey(0.0)).channels, 3);
        let point = |intensity| Light::Point { position: DVec3::ZERO, intensity };
        assert!(is_single_channel(&grey(0.0), &[point([1.0; 3])]));
        assert!(!is_single_channel(&grey(0.0), &[point([1.0, 1.0, 0.0])]));
        assert!(!is_single_channel(&MediumParameters { sigma_t: [f32::NAN; 3], ..grey(0.0) }, &[]));
    }
}
