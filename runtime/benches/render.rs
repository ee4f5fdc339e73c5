//! The render stage by stage on a plume of 64 x 64 x 96 voxels: new frame, new lights, new camera, for both phase
//! functions; `docs/speed.md` has the same of a real frame, and how cost grows.

use divan::{Bencher, black_box};
use glam::{DAffine3, DVec3, Vec3};
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer};
use smoke_runtime::transport::medium::MediumParameters;

const G: [f32; 2] = [0.0, 0.5];

fn main() {
    divan::main();
}

/// A column that widens and wobbles upwards, density up to 1.
fn frame() -> Frame {
    let dims = [64usize, 64, 96];
    let density = |v: usize| {
        let p = Vec3::new((v % 64) as f32, (v / 64 % 64) as f32, (v / 4096) as f32);
        let across = p.truncate() - 31.5 - 6.0 * glam::Vec2::new((p.z * 0.11).sin(), (p.z * 0.07).cos());
        let wide = 6.0 + 0.15 * p.z;
        (1.5 * (-across.length_squared() / (wide * wide)).exp() - 0.3).clamp(0.0, 1.0)
    };
    let values: Vec<f32> = (0..dims.iter().product()).map(density).collect();
    let map = DAffine3::from_scale(DVec3::splat(1.0 / 32.0));
    let field = DensityField::from_box([0; 3], dims, &values, map);
    let unit = UnitSpace::of_box([0; 3], dims.map(|d| d as u32));
    Frame { field, gaussians: vec![], unit, first_node: [-1; 3], world_from_index: map, transfer: None }
}

fn lights() -> Vec<Light> {
    let mut sky = Environment::constant([0.2, 0.3, 0.5]);
    sky.radiance.iter_mut().take(64 * 12).for_each(|r| *r = [1.0, 0.9, 0.8]);
    vec![Light::Environment(sky), Light::Directional { toward: Vec3::new(0.6, 0.0, 0.8), irradiance: [3.0; 3] }]
}

fn camera(shift: f64) -> Camera {
    Camera::look_at(DVec3::new(1.0 + shift, -4.0, 1.8), DVec3::new(1.0, 1.0, 1.5), DVec3::Z, 36.0, 400, 300)
}

fn renderer(g: f32) -> Renderer {
    let medium = MediumParameters { sigma_t: [8.0; 3], albedo: [0.92; 3], g };
    let mut renderer = Renderer::new(RenderSettings::default(), medium, lights()).expect("good settings");
    renderer.set_frame(frame()).expect("the grid route takes any frame");
    renderer
}

fn image(renderer: &mut Renderer, camera: &Camera) -> Film {
    renderer.render(camera).expect("a frame is set").0
}

#[divan::bench(args = G, sample_count = 5, sample_size = 1)]
fn new_frame(bencher: Bencher, g: f32) {
    let mut renderer = renderer(g);
    bencher.with_inputs(frame).bench_local_values(|frame| {
        renderer.set_frame(frame).expect("the grid route takes any frame");
        black_box(image(&mut renderer, &camera(0.0)))
    });
}

#[divan::bench(args = G, sample_count = 5, sample_size = 1)]
fn new_lights(bencher: Bencher, g: f32) {
    let mut renderer = renderer(g);
    bencher.with_inputs(lights).bench_local_values(|lights| {
        renderer.set_lights(lights).unwrap();
        black_box(image(&mut renderer, &camera(0.0)))
    });
}

#[divan::bench(args = G, sample_count = 10, sample_size = 1)]
fn new_camera(bencher: Bencher, g: f32) {
    let mut renderer = renderer(g);
    let mut shift = 0.0;
    bencher.bench_local(|| {
        shift += 1e-3;
        black_box(image(&mut renderer, &camera(shift)))
    });
}

/// The march alone: camera and eye stay where they are.
#[divan::bench(args = G, sample_count = 10, sample_size = 1)]
fn view_pass(bencher: Bencher, g: f32) {
    let mut renderer = renderer(g);
    image(&mut renderer, &camera(0.0));
    bencher.bench_local(|| black_box(image(&mut renderer, &camera(0.0))));
}
