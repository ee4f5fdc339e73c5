//! What has to add up: orders, channels, lights, directions.

use crate::scenes::{Image, Scene, assert_agrees_to, compare, grey, sky, sun, white};
use glam::{DAffine3, DQuat, DVec3, Vec3};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::transport::medium::MediumParameters;

fn turned_sky(rotation: f64) -> Light {
    Light::Environment(Environment { rotation, visible: true, ..sky() })
}

#[test]
fn each_order_adds_light_and_what_is_missing_is_bounded_by_the_albedo() {
    // Under a sun alone, paths of the same seed are the same as far as they go: no pixel can be darker with more orders.
    let scene = Scene::ball(grey(6.0, 0.7, 0.4), vec![sun(Vec3::new(1.0, -0.5, 0.8), [3.0, 2.0, 1.0])]);
    let mut before = scene.trace(Some(0), 4, 9);
    assert!(before.film.pixels.iter().all(|p| p.radiance == [0.0; 3]));
    for order in [1, 2, 3, 5, 8, 12] {
        let image = scene.trace(Some(order), 4, 9);
        let mut more = 0;
        for (a, b) in image.film.pixels.iter().zip(&before.film.pixels) {
            // Equal sums in another order: rounding.
            assert!((0..3).all(|c| a.radiance[c] >= b.radiance[c] * (1.0 - 1e-6)), "{order}: {a:?} {b:?}");
            more += usize::from(a.radiance[0] > b.radiance[0]);
        }
        assert!(more > 20, "{order} adds to {more} pixels");
        before = image;
    }
    // Order k of a white sky is at most albedo^k; more than 40 orders at 0.7 are 1e-6.
    let scene = Scene::ball(grey(6.0, 0.7, 0.4), vec![white(false)]);
    let all = scene.image(None, 16, 2);
    assert_agrees_to(0.02, &scene.image(Some(40), 16, 3), &all, "40 orders");
    let mean = |image: &Image| image.radiance.iter().map(|p| f64::from(p[1])).sum::<f64>();
    for order in [1, 2, 4, 8] {
        let part = scene.image(Some(order), 16, 4);
        let missing = mean(&all) - mean(&part);
        let bound = all.radiance.len() as f64 * 0.7f64.powi(order as i32 + 1) / 0.3;
        assert!(missing > 0.0 && missing < bound, "{order}: {missing} {bound}");
        assert!(order > 4 || compare(&part, &all).is_err(), "{order} orders are not all");
    }
}

#[test]
fn each_channel_is_the_grey_render_of_its_own_medium() {
    let lights = vec![Light::Environment(sky()), sun(Vec3::new(-1.0, -1.0, 0.5), [1.0, 2.0, 3.0])];
    for orders in [Some(1), None] {
        for (sigma_t, albedo, g) in
            [([2.0, 6.0, 20.0], [0.99, 0.8, 0.5], 0.5), ([12.0, 0.5, 4.0], [0.6, 1.0, 0.9], -0.3)]
        {
            let scene = Scene::ball(MediumParameters { sigma_t, albedo, g }, lights.clone());
            let grey = [0, 1, 2].map(|c| {
                let medium = grey(sigma_t[c], albedo[c], g);
                Scene { medium, ..scene.clone() }.image(orders, 32, 20 + c as u64)
            });
            let expected = Image::channels([&grey[0], &grey[1], &grey[2]]);
            let found = scene.image(orders, 32, 17);
            assert_agrees_to(0.03, &found, &expected, &format!("{sigma_t:?} {albedo:?} {orders:?}"));
            // An albedo off in one channel alone.
            let off = MediumParameters { albedo: [albedo[0], albedo[1], albedo[2] * 0.96], ..scene.medium };
            assert!(compare(&Scene { medium: off, ..scene }.image(orders, 32, 8), &expected).is_err());
        }
    }
}

#[test]
fn a_sun_is_the_limit_of_a_bright_texel_of_the_same_flux() {
    let (width, height) = (512, 256);
    let (column, row) = (70, 60);
    let mut map =
        Environment { width, height, radiance: vec![[0.0; 3]; width * height], ..Environment::constant([0.0; 3]) };
    let at = |texel: usize, texels: usize| (texel as f64 + 0.5) / texels as f64;
    let toward = map.direction(at(column, width), at(row, height)).as_vec3();
    // Bilinear: a tent of a texel to both sides. Over the elevation it holds its cosine's mean, 1 - d^2/12 of that in
    // the middle, d = pi / 256: 1e-5.
    let solid_angle = std::f32::consts::TAU / width as f32 * std::f32::consts::PI / height as f32
        * (1.0 - toward.z * toward.z).sqrt();
    let irradiance = [3.0, 2.0, 1.0];
    map.radiance[row * width + column] = irradiance.map(|e| e / solid_angle);
    // The phase function is even to 1e-4 over a texel.
    for (orders, g) in [(Some(1), 0.6), (None, 0.0), (None, 0.6)] {
        let from = |light: Light, seed| Scene::ball(grey(5.0, 0.9, g), vec![light]).image(orders, 40, seed);
        let found = from(Light::Environment(map.clone()), 4);
        assert_agrees_to(0.03, &found, &from(sun(toward, irradiance), 5), &format!("{orders:?} {g}"));
    }
}

#[test]
fn lights_add_up() {
    let point = Light::Point { position: DVec3::new(0.2, -0.9, 0.6), intensity: [2.0, 1.0, 3.0] };
    let lights = [white(true), turned_sky(1.0), sun(Vec3::new(0.2, 1.0, 0.3), [4.0, 3.0, 2.0]), point];
    for orders in [Some(1), Some(2), None] {
        let medium = MediumParameters { sigma_t: [3.0, 5.0, 8.0], ..grey(0.0, 0.9, 0.4) };
        let scene = Scene::ball(medium, lights.to_vec());
        let parts = [0, 1, 2, 3]
            .map(|i| Scene { lights: vec![lights[i].clone()], ..scene.clone() }.image(orders, 24, 30 + i as u64));
        assert_agrees_to(0.02, &scene.image(orders, 24, 6), &Image::sum(&parts), &format!("{orders:?}"));
        assert!(compare(&scene.image(orders, 24, 7), &Image::sum(&parts[..3])).is_err(), "the point must be missed");
    }
}

#[test]
fn a_scene_turned_as_a_whole_gives_the_same_image() {
    let of = |turn: f64, seed: u64| {
        let rotation = DAffine3::from_quat(DQuat::from_rotation_z(turn));
        let toward = rotation.transform_vector3(DVec3::new(0.6, 0.0, 0.8)).as_vec3();
        let position = rotation.transform_point3(DVec3::new(0.2, 1.1, -0.6));
        let point = Light::Point { position, intensity: [1.0; 3] };
        let lights = vec![turned_sky(turn), sun(toward, [2.0; 3]), point];
        let mut scene = Scene::ball(grey(5.0, 0.95, 0.5), lights);
        scene.field.world_from_node = rotation * scene.field.world_from_node;
        let camera = scene.camera;
        scene.camera.position = rotation.transform_point3(camera.position);
        for (to, from) in [
            (&mut scene.camera.right, camera.right),
            (&mut scene.camera.up, camera.up),
            (&mut scene.camera.forward, camera.forward),
        ] {
            *to = rotation.transform_vector3(from);
        }
        scene.image(None, 24, seed)
    };
    for turn in [0.7, std::f64::consts::FRAC_PI_2, -2.9] {
        assert_agrees_to(0.02, &of(turn, 1), &of(0.0, 2), &format!("turned by {turn}"));
    }
}
