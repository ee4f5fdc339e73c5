//! The compensated routes and the dials of each: edits, threads, symmetries, and what they refuse.

use crate::methods::{ball, camera, centres, frame, grey, lumps, sun, white};
use glam::{DAffine3, DVec3, Vec3};
use smoke_formats::gaussian::Gaussian;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::march::MarchSettings;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderError, RenderSettings, Renderer, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::route::MultipleScattering;
use smoke_runtime::transport::compensated::grid::route::GridSettings;
use smoke_runtime::transport::medium::MediumParameters;

pub fn render(
    settings: RenderSettings,
    frame: Frame,
    medium: MediumParameters,
    lights: Vec<Light>,
    from: &Camera,
) -> Film {
    let mut renderer = Renderer::new(settings, medium, lights).unwrap();
    renderer.set_frame(frame).unwrap();
    renderer.render(from).unwrap().0
}

fn all_routes() -> Vec<RenderSettings> {
    vec![
        RenderSettings::default(),
        RenderSettings { scattering: ScatteringOrder::Single, ..RenderSettings::default() },
        centres(Exponential::Direct, MultipleScattering::IntegralCentres),
        centres(Exponential::OptimalLinear, MultipleScattering::Diffusion),
    ]
}

fn sound(film: &Film, brightest: f32, what: &str) {
    for pixel in &film.pixels {
        let good = pixel.radiance.iter().all(|r| (0.0..=brightest).contains(r));
        let alpha = (-1e-6..=1.0).contains(&pixel.alpha());
        assert!(good && alpha && !pixel.depth.is_nan(), "{what}: {pixel:?}");
    }
}

#[test]
fn grazing_rays_see_little_and_rays_along_axes_and_faces_are_finite() {
    let slab = || frame([20, 20, 6], 0.1, 1.0, &[], |_| 1.0);
    for (eye, target) in [
        (DVec3::new(0.0, -4.0, 0.3499), DVec3::new(0.0, 4.0, 0.3499)),
        (DVec3::new(0.0, -4.0, 0.25), DVec3::new(0.0, 4.0, 0.25)),
        (DVec3::new(0.95, -4.0, 0.0), DVec3::new(0.95, 4.0, 0.0)),
        (DVec3::new(0.0, -4.0, 0.35), DVec3::new(0.0, 0.0, 0.35 - 1e-9)),
    ] {
        let camera = Camera::look_at(eye, target, DVec3::Z, 0.001, 5, 5);
        let film = render(RenderSettings::default(), slab(), grey(2.0, 0.9, 0.5), white(), &camera);
        sound(&film, 1.1, "grazing");
        // The density falls from 1 at z = 0.25 to 0 at 0.35; at 0.3499 it is 1e-3, over 2 world units.
        let most = if eye.z > 0.349 { 0.01 } else { 1.0 };
        assert!(film.pixels.iter().all(|p| p.alpha() <= most), "{eye}");
    }
}

#[test]
fn units_from_a_millionth_to_a_million_give_the_same_image_when_extinction_scales_inversely() {
    let lights = || [white(), sun(Vec3::new(0.6, 0.0, 0.8))].concat();
    for settings in all_routes() {
        let of = |voxel: f64| {
            let medium = MediumParameters { albedo: [0.9, 0.8, 0.7], ..grey((0.8 / voxel) as f32, 0.9, 0.4) };
            let mut camera = camera(4.0 * voxel / 0.1);
            camera.width = 20;
            render(settings, frame([20; 3], voxel, 1.0, &lumps(), |_| 0.0), medium, lights(), &camera)
        };
        let expected = of(0.1);
        for voxel in [1e-7, 1e-6, 1e-3, 1e3, 1e6] {
            for (a, b) in of(voxel).pixels.iter().zip(&expected.pixels) {
                for c in 0..3 {
                    // Lengths are rounded to f32 once or twice on the way: 1e-7 of the depth, times a depth of 16; and
                    // a sample may fall on the other side of a brick's face.
                    assert!(
                        (a.radiance[c] - b.radiance[c]).abs() < 1e-4 * b.radiance[c].max(0.01),
                        "{voxel} {a:?} {b:?}"
                    );
                    assert!((a.transmittance[c] - b.transmittance[c]).abs() < 1e-5, "{voxel}");
                }
                let depth = f64::from(a.depth) / voxel * 0.1;
                assert!(a.depth == b.depth || (depth / f64::from(b.depth) - 1.0).abs() < 1e-5, "{voxel} {depth} {b:?}");
            }
        }
    }
}

#[test]
fn densities_of_sixteen_bit_range_render_as_those_of_one_when_extinction_scales_inversely() {
    let of = |unit: f32| {
        render(RenderSettings::default(), ball(0.1, unit), grey(8.0 / unit, 0.9, 0.5), white(), &camera(4.0))
    };
    let expected = of(1.0);
    for unit in [1e-6, 65535.0, 1e6] {
        for (a, b) in of(unit).pixels.iter().zip(&expected.pixels) {
            // Relative roundings of density and extinction, 6e-8 each, over a depth of up to 10.
            assert!((a.radiance[1] - b.radiance[1]).abs() < 2e-5 * b.radiance[1].max(0.01), "{unit}: {a:?} {b:?}");
        }
    }
}

#[test]
fn a_light_turned_round_with_the_camera_gives_the_image_turned_round() {
    // Nodes at every voxel: those at every second one are not mirrored in an even number of voxels.
    let grid = GridSettings { multiple_step: 1, ..GridSettings::default() };
    let settings = RenderSettings { route: Route::Grid(grid), ..RenderSettings::default() };
    let view = |x: f64, light: f32| {
        let camera = Camera::look_at(DVec3::new(x, -3.0, 0.5), DVec3::ZERO, DVec3::Z, 40.0, 16, 16);
        render(settings, ball(0.1, 1.0), grey(6.0, 0.9, 0.4), sun(Vec3::new(light, 0.8, 0.0)), &camera)
    };
    let (a, b) = (view(1.0, 0.6), view(-1.0, -0.6));
    for at in 0..256 {
        let (p, q) = (a.pixels[at].radiance[0], b.pixels[at / 16 * 16 + 15 - at % 16].radiance[0]);
        // Directions, grids and samples are mirrored; what is left is rounding, and the solver's where it stops.
        assert!((p - q).abs() < 1e-3 * p.max(0.05), "{at}: {p} {q}");
    }
}

#[test]
fn one_gaussian_and_coincident_gaussians_are_finite_and_agree() {
    let one = Gaussian { center: [0.5; 3], radius: 0.2, weight: 1.0 };
    let half = Gaussian { weight: 0.5, ..one };
    for exponential in [Exponential::Direct, Exponential::Pointwise, Exponential::Hybrid, Exponential::OptimalLinear] {
        for multiple in [MultipleScattering::IntegralCentres, MultipleScattering::Diffusion] {
            let settings = centres(exponential, multiple);
            let of = |gaussians: &[Gaussian]| {
                render(
                    settings,
                    frame([20; 3], 0.1, 1.0, gaussians, |_| 0.0),
                    grey(3.0, 0.9, 0.3),
                    white(),
                    &camera(4.0),
                )
            };
            let (single, twice) = (of(&[one]), of(&[half, half]));
            sound(&single, 1.1, "one");
            sound(&twice, 1.1, "two");
            assert!(single.pixels.iter().any(|p| p.radiance[0] > 0.05), "{exponential:?} {multiple:?}");
            if multiple == MultipleScattering::IntegralCentres {
                for (a, b) in single.pixels.iter().zip(&twice.pixels) {
                    assert!((a.radiance[1] - b.radiance[1]).abs() < 1e-3 * a.radiance[1].max(0.05), "{a:?} {b:?}");
                }
            }
        }
    }
}

#[test]
fn edits_give_the_same_bits_as_a_fresh_start_and_so_does_any_number_of_threads() {
    for settings in all_routes() {
        let make = || frame([20; 3], 0.1, 1.0, &lumps(), |_| 0.0);
        let (first, last) = (grey(2.0, 0.5, 0.2), grey(6.0, 0.9, 0.7));
        let fresh = render(settings, make(), last, sun(Vec3::X), &camera(4.0));
        let mut renderer = Renderer::new(settings, first, white()).unwrap();
        assert!(renderer.render(&camera(3.0)).unwrap().0.pixels.iter().all(|p| p.alpha() == 0.0), "no frame yet");
        renderer.set_frame(ball_with_gaussians()).unwrap();
        renderer.render(&camera(3.0)).unwrap();
        renderer.set_lights(sun(Vec3::X)).unwrap();
        renderer.render(&camera(5.0)).unwrap();
        renderer.set_medium(last).unwrap();
        renderer.render(&camera(5.0)).unwrap();
        renderer.set_frame(make()).unwrap();
        renderer.render(&camera(3.0)).unwrap();
        let (edited, seconds) = renderer.render(&camera(4.0)).unwrap();
        assert_eq!(edited, fresh, "{settings:?}");
        assert!(seconds.source_radiance < seconds.view_pass, "the source radiance was kept");
        for threads in [1, 3] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            assert_eq!(pool.install(|| render(settings, make(), last, sun(Vec3::X), &camera(4.0))), fresh, "{threads}");
        }
    }
}

fn ball_with_gaussians() -> Frame {
    frame([20; 3], 0.1, 1.0, &lumps()[..1], |at| if at[0] > 10 { 0.2 } else { 0.0 })
}

#[test]
fn a_sky_with_y_up_lights_from_above_along_y_on_both_routes() {
    // Bright upper half; seen from the side, the smoke is brighter on its upper side in the sense of the world's up.
    for up_is_y in [false, true] {
        let mut sky = Environment::constant([0.0; 3]);
        sky.radiance.iter_mut().take(64 * 16).for_each(|r| *r = [1.0; 3]);
        sky.up_is_y = up_is_y;
        let up = if up_is_y { DVec3::Y } else { DVec3::Z };
        let camera = Camera::look_at(DVec3::X * 4.0, DVec3::ZERO, up, 40.0, 9, 9);
        for settings in [RenderSettings::default(), centres(Exponential::Direct, MultipleScattering::IntegralCentres)] {
            let cloud: Vec<Gaussian> = [0.35, 0.5, 0.65]
                .iter()
                .flat_map(|&y| [0.35, 0.5, 0.65].map(|z| Gaussian { center: [0.5, y, z], radius: 0.12, weight: 1.0 }))
                .collect();
            let smoke = frame([20; 3], 0.1, 1.0, &cloud, |_| 0.0);
            let film = render(settings, smoke, grey(10.0, 0.9, 0.0), vec![Light::Environment(sky.clone())], &camera);
            let (upper, lower) = (film.pixels[3 * 9 + 4], film.pixels[5 * 9 + 4]);
            assert!(upper.radiance[0] > 1.3 * lower.radiance[0], "{upper:?} {lower:?}");
        }
    }
}

#[test]
fn what_a_route_or_a_dial_cannot_serve_is_refused_by_name() {
    let mut stretched = frame([20; 3], 0.1, 1.0, &lumps(), |_| 0.0);
    stretched.world_from_index.matrix3.z_axis.z *= 1.5;
    let settings = centres(Exponential::Direct, MultipleScattering::IntegralCentres);
    let mut renderer = Renderer::new(settings, grey(1.0, 0.5, 0.0), white()).unwrap();
    assert_eq!(renderer.set_frame(stretched).unwrap_err(), RenderError::NotUniform);
    assert_eq!(renderer.set_frame(ball(0.1, 1.0)).unwrap_err(), RenderError::NoGaussians);
    assert!(RenderError::NotUniform.to_string().contains("grid"));
    let message = |settings: RenderSettings| match Renderer::new(settings, grey(1.0, 0.5, 0.0), vec![]) {
        Err(e) => e.to_string(),
        Ok(_) => panic!("accepted"),
    };
    let march = |step, cutoff, samples| RenderSettings {
        march: MarchSettings { step, cutoff, samples, ..MarchSettings::default() },
        ..RenderSettings::default()
    };
    assert!(message(march(f32::NAN, 0.0, 1)).starts_with("march step: found NaN"));
    assert!(message(march(0.5, 1.0, 1)).starts_with("cutoff"));
    assert!(message(march(0.5, 0.1, 0)).starts_with("samples"));
    assert!(message(RenderSettings { sh_order: 7, ..RenderSettings::default() }).starts_with("SH order"));
    assert!(Renderer::new(RenderSettings::default(), grey(f32::NAN, 0.5, 0.0), vec![]).is_err());
}

#[test]
fn a_turned_and_mirrored_placement_changes_nothing_when_lights_and_camera_turn_with_it() {
    let turn = DAffine3::from_mat3(
        glam::DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2)
            * glam::DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0)),
    );
    let settings = centres(Exponential::Direct, MultipleScattering::IntegralCentres);
    let place = |turned: bool| {
        let mut smoke = frame([20; 3], 0.1, 1.0, &lumps(), |_| 0.0);
        let (mut eye, mut up, mut light) = (DVec3::new(3.0, -2.0, 1.0), DVec3::Z, DVec3::new(0.36, 0.48, 0.8));
        if turned {
            smoke.world_from_index = turn * smoke.world_from_index;
            smoke.field.world_from_node = turn * smoke.field.world_from_node;
            (eye, up, light) = (turn.matrix3 * eye, turn.matrix3 * up, turn.matrix3 * light);
        }
        let camera = Camera::look_at(eye, DVec3::ZERO, up, 40.0, 12, 12);
        render(settings, smoke, grey(5.0, 0.9, 0.4), sun(light.as_vec3()), &camera)
    };
    let (plain, turned) = (place(false), place(true));
    for at in 0..144 {
        // A mirror turns the image's x round.
        let (p, q) = (plain.pixels[at].radiance[0], turned.pixels[at / 12 * 12 + 11 - at % 12].radiance[0]);
        assert!((p - q).abs() < 1e-3 * p.max(0.01), "{at}: {p} {q}");
    }
}
