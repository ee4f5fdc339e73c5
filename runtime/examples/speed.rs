//! Measures the render's stages and how the cost grows with Gaussians and order; prints `docs/speed.md`:
//! `SMOKE_BAKE_DATA=../shared/data cargo run --release -p smoke-runtime --example speed > docs/speed.md`.

use glam::DAffine3;
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::{image, scene::Scene, volume};
use smoke_runtime::camera::Camera;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::medium::gaussian_sum::gaussian_sum;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route, Seconds};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::route::CentreSettings;
use smoke_runtime::transport::medium::MediumParameters;
use std::path::{Path, PathBuf};
use std::time::Instant;

type Failure = Box<dyn std::error::Error>;
/// A name, and which of the figures of new frame, new lights, new camera it is.
type Stage = (&'static str, fn(&[Seconds; 3]) -> f64);
const RUNS: usize = 5;
const COUNTS: [usize; 4] = [150, 300, 600, 1200];

/// A widening plume of `n` Gaussians, radii 0.03 to 0.09, by a fixed low-discrepancy sequence, on 64^3 voxels.
fn cloud(n: usize) -> Frame {
    let at = |i: usize, k: f64| ((i as f64 + 0.5) * k).fract();
    let gaussians: Vec<Gaussian> = (0..n)
        .map(|i| {
            let z = at(i, 0.618_033_988_7);
            let side = |k: f64| (0.5 + (0.1 + 0.25 * z) * (2.0 * at(i, k) - 1.0)) as f32;
            Gaussian {
                center: [side(0.754_877_666), side(0.569_840_290_9), (0.1 + 0.8 * z) as f32],
                radius: (0.03 + 0.06 * at(i, 0.819_172_513)) as f32,
                weight: (0.3 + 0.7 * at(i, 0.671_043_606_7)) as f32,
            }
        })
        .collect();
    let unit = UnitSpace::of_box([0; 3], [64; 3]);
    let map = DAffine3::from_scale(glam::DVec3::splat(1.0 / 64.0));
    let values = gaussian_sum(&gaussians, &unit, [0; 3], [64; 3]);
    let field = DensityField::from_box([0; 3], [64; 3], &values, map);
    Frame { field, gaussians, unit, first_node: [-1; 3], world_from_index: map, transfer: None }
}

/// Least seconds of [`RUNS`] runs, stage by stage: new frame, new lights, new camera.
fn measure(
    settings: RenderSettings,
    medium: MediumParameters,
    frame: &Frame,
    lights: &[Light],
    camera: &Camera,
) -> Result<[Seconds; 3], Failure> {
    let far = Seconds { source_radiance: f64::MAX, volume_pass: f64::MAX, view_pass: f64::MAX };
    let mut best = [far; 3];
    for _ in 0..RUNS {
        let mut renderer = Renderer::new(settings, medium, lights.to_vec())?;
        for best in best.iter_mut().enumerate() {
            let (edit, best) = best;
            let mut camera = *camera;
            let (frame, lights) = (frame.clone(), lights.to_vec());
            let start = Instant::now();
            match edit {
                0 => renderer.set_frame(frame)?,
                1 => renderer.set_lights(lights)?,
                _ => camera.position.x += 1e-3,
            }
            let edited = start.elapsed().as_secs_f64();
            let (_, seconds) = renderer.render(&camera)?;
            best.source_radiance = best.source_radiance.min(seconds.source_radiance + edited);
            best.volume_pass = best.volume_pass.min(seconds.volume_pass);
            best.view_pass = best.view_pass.min(seconds.view_pass);
        }
    }
    Ok(best)
}

/// Exponent of the least-squares power law.
fn exponent(x: &[f64], y: &[f64]) -> f64 {
    let (x, y): (Vec<f64>, Vec<f64>) = (x.iter().map(|v| v.ln()).collect(), y.iter().map(|v| v.ln()).collect());
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mx, my) = (mean(&x), mean(&y));
    let covariance: f64 = x.iter().zip(&y).map(|(x, y)| (x - mx) * (y - my)).sum();
    covariance / x.iter().map(|x| (x - mx) * (x - mx)).sum::<f64>()
}

fn cells(values: &[f64]) -> String {
    values.iter().map(|v| format!("{v:.3}")).collect::<Vec<_>>().join(" | ")
}

fn main() -> Result<(), Failure> {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let data = std::env::var_os("SMOKE_BAKE_DATA").map_or_else(default, PathBuf::from);
    let mut scene = Scene::read(&data.join("../peers/scenes/plume.toml"))?;
    (scene.width, scene.height) = (800, 600);
    let camera = Camera::from_pinhole(&scene.pinhole());
    let sky = image::read_environment(&data.join("env/sunset.exr"))?.0;
    let sky =
        Environment { width: sky.width, height: sky.height, radiance: sky.pixels, ..Environment::constant([0.0; 3]) };
    let lights = [Light::Environment(sky)];
    let grid = volume::read(&data.join("plume/plume.1060.vdb"), "density")?;
    let field = DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index);
    let unit = UnitSpace::of_box(grid.origin, grid.dims.map(|d| d as u32));
    let world_from_index = grid.world_from_index;
    let plume = Frame {
        field,
        gaussians: vec![],
        unit,
        first_node: grid.origin.map(|o| o - 1),
        world_from_index,
        transfer: None,
    };
    let medium = |g| MediumParameters { sigma_t: [8.0; 3], albedo: [0.92; 3], g };

    println!("# Speed\n");
    println!(
        "Generated by `SMOKE_BAKE_DATA=../shared/data cargo run --release -p smoke-runtime --example speed > docs/speed.md`."
    );
    println!(
        "Wall seconds, the least of {RUNS} runs for each stage. `cargo bench -p smoke-runtime` has the same stages with their spread."
    );
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split(' ').next().unwrap_or("unknown").to_owned();
    println!(
        "Load average before the run: {load}, on {} cores. Above 0.5, absolute figures are too high: read ratios.\n",
        std::thread::available_parallelism()?
    );
    let [nx, ny, nz] = grid.dims;
    println!("## Frame 1060 of the plume, {nx} x {ny} x {nz} voxels, 800 x 600 pixels, SH order 4, route grid\n");
    println!(
        "A new frame solves for everything; new lights keep the frame's grids; a new camera keeps the source radiance, and the volume pass too if scattering is isotropic.\n"
    );
    println!("| threads | g | orders | edit | source radiance | volume pass | view pass | together |");
    println!("|---|---|---|---|---|---|---|---|");
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        for (g, scattering) in
            [(0.0, ScatteringOrder::Single), (0.0, ScatteringOrder::All), (0.5, ScatteringOrder::All)]
        {
            let settings = RenderSettings { scattering, ..RenderSettings::default() };
            let best =
                pool.install(|| measure(settings, medium(g), &plume, &lights, &camera).map_err(|e| e.to_string()))?;
            for (edit, s) in ["frame", "lights", "camera"].iter().zip(best) {
                let parts = [s.source_radiance, s.volume_pass, s.view_pass];
                let all = parts.iter().sum::<f64>();
                let orders = if scattering == ScatteringOrder::Single { "single" } else { "all" };
                println!("| {threads} | {g} | {orders} | {edit} | {} | {all:.3} |", cells(&parts));
            }
        }
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let one = |settings: RenderSettings, n: usize| -> Result<[Seconds; 3], Failure> {
        let small = Camera { width: 8, height: 8, ..camera };
        Ok(pool.install(|| measure(settings, medium(0.5), &cloud(n), &lights, &small).map_err(|e| e.to_string()))?)
    };
    let centres = |order| RenderSettings {
        route: Route::Centres(CentreSettings::default()),
        sh_order: order,
        ..RenderSettings::default()
    };
    println!("\n## Route centres: cost against the number of Gaussians, g = 0.5, order 4, 64^3 voxels, one thread\n");
    println!("| stage | {} | exponent |", COUNTS.map(|n| n.to_string()).join(" | "));
    println!("|---|---|---|---|---|---|");
    let runs = COUNTS.iter().map(|&n| one(centres(4), n)).collect::<Result<Vec<_>, _>>()?;
    let x = COUNTS.map(|n| n as f64);
    let stages: [Stage; 3] = [
        ("source radiance, new frame", |s| s[0].source_radiance),
        ("source radiance, new lights", |s| s[1].source_radiance),
        ("volume pass", |s| s[0].volume_pass),
    ];
    for (name, stage) in stages {
        let y: Vec<f64> = runs.iter().map(stage).collect();
        println!("| {name} | {} | {:.2} |", cells(&y), exponent(&x, &y));
    }
    println!("\n## Cost against the SH order, g = 0.5, 64^3 voxels, 300 Gaussians, one thread\n");
    println!("| stage | 1 | 2 | 3 | 4 | 5 | 6 | exponent |");
    println!("|---|---|---|---|---|---|---|---|");
    for (route, settings) in [("centres", centres(4)), ("grid", RenderSettings::default())] {
        let orders = 1..=6usize;
        let run = |order| one(RenderSettings { sh_order: order, ..settings }, 300);
        let runs = orders.clone().map(run).collect::<Result<Vec<_>, _>>()?;
        let x: Vec<f64> = orders.map(|o| o as f64).collect();
        for (name, stage) in stages {
            let y: Vec<f64> = runs.iter().map(stage).collect();
            println!("| {route}: {name} | {} | {:.2} |", cells(&y), exponent(&x, &y));
        }
    }
    Ok(())
}
