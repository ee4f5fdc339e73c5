//! What a graphics device has to do for a frame, what it should take, and what it takes: the page `docs/gpu.md`.
//!
//! ```console
//! $ cargo run --release -p smoke-runtime --features gpu --example gpu_stages > docs/gpu.md
//! ```
//!
//! A ball in 128^3 voxels, 600 Gaussians, four bands, 800 x 600 pixels, a sky and a sun, grey. A software device is
//! measured on a smaller frame and image, which the page says.

mod counts;
#[path = "../made_up/mod.rs"]
mod made_up;

use counts::{CARDS, Card, Shape, Stage, When, stages};
use glam::{DAffine3, DVec3};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_runtime::camera::Camera;
use smoke_runtime::gpu::device::{Choice, ForcedLimits, Gpu};
use smoke_runtime::gpu::renderer::{GpuRenderer, SolveOn};
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::light::Light;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::transport::compensated::centres::route::CentreSettings;
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;
use smoke_runtime::transport::transfer::source::TransferSettings;
use smoke_runtime::transport::transfer::view_directions::{ViewDirections, squares};
use std::sync::Arc;
use std::time::Instant;

const G: f32 = 0.5;
const GAUSSIANS: usize = 600;
/// Voxels along a side, and the image.
const FULL: (usize, [usize; 2]) = (128, [800, 600]);
const SOFTWARE: (usize, [usize; 2]) = (32, [200, 150]);

fn main() {
    let gpu = Gpu::open(&Choice::Best, ForcedLimits::default()).ok().map(Arc::new);
    let measured_on = gpu.as_ref().map(|gpu| if gpu.summary().is_software() { SOFTWARE } else { FULL });
    println!("# What a graphics device does\n");
    println!("Made by `cargo run --release -p smoke-runtime --features gpu --example gpu_stages > docs/gpu.md`.\n");
    let (side, [width, height]) = FULL;
    println!(
        "A ball in {side}^3 voxels, {GAUSSIANS} Gaussians, four bands (g = {G}), grey, a sky of 64 beams and a sun, {width} x {height} \
         pixels. Bytes are what must pass through memory at least, operations those of the shaders \
         (`runtime/examples/gpu_stages/counts.rs` has them stage by stage); the predicted time is the longer of both, and \
         10 us for each submission or read-back that is waited for: a lower bound.\n"
    );
    let all = stages(&shape(FULL));
    counted(&all);
    rates(&all);
    if let (Some(gpu), Some(at)) = (&gpu, measured_on) {
        measured(gpu, at);
    } else {
        println!("No device was at hand: nothing is measured.");
    }
}

fn counted(all: &[Stage]) {
    println!("| method | stage | on | MB | million operations | {} | {} |", CARDS[0].name, CARDS[1].name);
    println!("|---|---|---|---|---|---|---|");
    for stage in all {
        let on = if stage.when == When::Light { "light" } else { "view" };
        let [new, old] = CARDS.map(|card: Card| microseconds(card.seconds(stage)));
        let (bytes, operations) = (stage.bytes * 1e-6, stage.operations * 1e-6);
        println!("| {} | {} | {on} | {bytes:.1} | {operations:.0} | {new} | {old} |", stage.method, stage.name);
    }
}

/// Images a second that the counts allow.
fn rates(all: &[Stage]) {
    println!(
        "\nImages a second that these allow (Zhou et al. 2008 had 19 to 95 on an 8800 GTX; goals 300 and 1,000):\n"
    );
    println!("| method | card | other light and eye | other eye |\n|---|---|---|---|");
    for method in ["compensated, grid", "compensated, centres", "transfer"] {
        for card in CARDS {
            let of = |light: bool| -> f64 {
                let stages = all.iter().filter(|s| s.method == method && (light || s.when == When::View));
                1.0 / stages.map(|stage| card.seconds(stage)).sum::<f64>()
            };
            println!("| {method} | {} | {:.0} | {:.0} |", card.name, of(true), of(false));
        }
    }
}

/// Times of the device at hand, beside what its stages must do there.
fn measured(gpu: &Arc<Gpu>, at: (usize, [usize; 2])) {
    let (side, [width, height]) = at;
    let summary = gpu.summary();
    println!(
        "\n## Measured\n\n{} ({}, {}, {}), {side}^3 voxels, {width} x {height} pixels; the second of two images after the",
        summary.name, summary.kind, summary.backend, summary.driver
    );
    println!(
        "edit. A software device computes on the processor, and shows that the stages are counted, not how fast they can be.\n"
    );
    println!("| method | stage | on | microseconds | GB/s | billion operations a second |\n|---|---|---|---|---|---|");
    let all = stages(&shape(at));
    let field = made_up::ball(side);
    for (method, route) in [
        ("compensated, grid", RenderSettings::default().route),
        ("compensated, centres", Route::Centres(CentreSettings::default())),
        ("transfer", Route::Transfer(TransferSettings::default())),
    ] {
        let settings = RenderSettings { route, ..RenderSettings::default() };
        let new = GpuRenderer::new(gpu.clone(), settings, made_up::medium(G), lights(0.0), SolveOn::Device);
        let mut renderer = new.expect("the device serves");
        let uploaded = UploadedFrame::new(gpu, frame(&field)).expect("the device holds the frame");
        renderer.set_frame(uploaded).expect("the frame is good");
        let mut wall = Vec::new();
        for turn in 0..2 {
            renderer.set_lights(lights(0.1 * f64::from(turn))).expect("lights are good");
            gpu.take_times();
            let start = Instant::now();
            renderer.render(&camera(at, 0.01 * f64::from(turn))).expect("the device serves");
            wall.push(start.elapsed().as_secs_f64());
        }
        for (name, microseconds) in gpu.take_times() {
            let Some(stage) = all.iter().find(|s| s.method == method && s.name == name) else { continue };
            let on = if stage.when == When::Light { "light" } else { "view" };
            let [bytes, operations] = [stage.bytes, stage.operations].map(|count| count / microseconds * 1e-3);
            println!("| {method} | {name} | {on} | {microseconds:.0} | {bytes:.2} | {operations:.2} |");
        }
        let start = Instant::now();
        renderer.render(&camera(at, 0.03)).expect("the device serves");
        let eye = start.elapsed().as_secs_f64();
        println!(
            "| {method} | all, wall clock | other light and eye / other eye | {:.0} / {:.0} | | |",
            1e6 * wall[1],
            1e6 * eye
        );
    }
}

fn microseconds(seconds: f64) -> String {
    format!("{:.0} us", 1e6 * seconds)
}

fn lights(turn: f64) -> Vec<Light> {
    let mut sky = made_up::sky();
    if let Light::Environment(environment) = &mut sky {
        environment.rotation = turn;
    }
    vec![sky, made_up::sun()]
}

fn camera((_, [width, height]): (usize, [usize; 2]), turn: f64) -> Camera {
    Camera::look_at(DVec3::new(0.5 + turn, -1.5, 0.6), DVec3::splat(0.5), DVec3::Z, 40.0, width, height)
}

/// Spread evenly over the ball, the same every time.
fn gaussians() -> Vec<Gaussian> {
    let spread = |i: usize, by: f32| (0.5 + i as f32 * by).fract();
    let at = |i: usize| [spread(i, 0.754_877_7), spread(i, 0.569_840_3), spread(i, 0.415_926_5)];
    let inside = |c: &[f32; 3]| c.iter().map(|v| (v - 0.5).powi(2)).sum::<f32>() < 0.18;
    let gaussian = |(i, center)| Gaussian { center, radius: 0.03 + 0.03 * spread(i, 0.618_034), weight: 0.5 };
    (0..).map(at).filter(inside).take(GAUSSIANS).enumerate().map(gaussian).collect()
}

fn frame(field: &DensityField) -> Frame {
    let voxels = field.dims.map(|n| n as u32 - 2);
    let unit = UnitSpace::of_box([0; 3], voxels);
    let world_from_index = DAffine3::from_scale(DVec3::splat(1.0 / f64::from(voxels[0])));
    let transfer = Some(Arc::new(made_up::transfer(field, G)));
    Frame { field: field.clone(), gaussians: gaussians(), unit, first_node: [-1; 3], world_from_index, transfer }
}

/// Counted on the frame itself.
fn shape(at: (usize, [usize; 2])) -> Shape {
    let (side, [width, height]) = at;
    let field = made_up::ball(side);
    let bricks = ShadedVolume::of(&field).bricks();
    let radius = 55.0 / 128.0 * side as f64;
    let camera = camera(at, 0.0);
    let distance = (camera.position - DVec3::splat(0.5)).length() * side as f64;
    // Rays that meet the ball, and its mean chord, two thirds of the diameter.
    let tangent = radius / (distance * distance - radius * radius).sqrt();
    let disc = std::f64::consts::PI * (0.5 * width as f64 * tangent / camera.tan_half_width).powi(2);
    let samples = disc.min((width * height) as f64) * 4.0 / 3.0 * radius;
    let linear = field.world_from_node.matrix3;
    let edges = [linear.x_axis, linear.y_axis, linear.z_axis].map(|edge| edge.as_vec3());
    let corner = (field.world_from_node.transform_point3(DVec3::ZERO) - camera.position).as_vec3();
    let views = ViewDirections::of_boxes(&[(corner, field.dims.map(|n| n - 1))], edges, squares(G));
    Shape {
        nodes: field.values.len() as f64,
        near: lit_nodes(&field).len() as f64,
        bricks: bricks as f64,
        gaussians: GAUSSIANS as f64,
        // A Gaussian ends at three radii: 36 pi r^3 of the unit cube, of which the ball has 0.33.
        reaching: gaussians().iter().map(|g| 113.1 * f64::from(g.radius).powi(3)).sum::<f64>() / 0.33,
        views: views.directions().len() as f64,
        pixels: (width * height) as f64,
        samples,
    }
}
