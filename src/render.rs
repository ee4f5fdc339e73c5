//! `smoke-bake render PACK --scene SCENE -o PATTERN`: frames of a pack as OpenEXR images.
//!
//! Every frame is made from the pack, the scene and the settings alone, never from another frame: one frame or all, one
//! thread or many, the bytes are the same. All settings go into each image's `smokebake:settings`.

use crate::cli::{ExponentialChoice, MultipleChoice, RenderArgs, RouteChoice, ScatteringOrder as Order};
use crate::progress::Progress;
use crate::staging::{SceneChanges, Stage};
use crate::{answer, failure::Failure};
use clap::error::ErrorKind;
use serde_json::{Value, json};
use smoke_formats::Error;
use smoke_formats::image::{self, FrameMetadata, RenderedFrame, SamplePrecision};
use smoke_formats::pack::Pack;
use smoke_formats::scene::Scene;
use smoke_formats::sequence::OutputNames;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::march::MarchSettings;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route, Seconds};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, MultipleScattering};
use smoke_runtime::transport::compensated::grid::route::GridSettings;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What is told of one frame.
struct Report {
    frame: i32,
    path: PathBuf,
    decode: f64,
    seconds: Seconds,
    write: f64,
    clamped: usize,
}

/// Renders the frames, one after the other, each by all threads.
pub fn run(args: &RenderArgs) -> Result<(), Failure> {
    let settings = settings(args)?;
    let Stage { scene, medium, lights, camera } = Stage::read(&args.scene, &changes(args))?;
    let pack = Pack::open(&args.pack)?;
    let numbers: Vec<i32> = pack.frames().iter().map(|f| f.frame).collect();
    let frames = match &args.frames {
        Some(selection) => selection.positions(&args.pack, &numbers)?,
        None => (0..numbers.len()).collect(),
    };
    let names = OutputNames::new(&args.output, frames.len())?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build();
    let pool = pool.map_err(|e| Failure::work(format!("--threads: {e}")))?;
    let document = document(args, &settings, &scene);
    let progress = Progress::start(args.progress, "rendering frames", frames.len() as u64);
    let start = Instant::now();
    let reports = pool.install(|| -> Result<Vec<Report>, Failure> {
        let failed = |e: &dyn std::fmt::Display| Failure::work(format!("{}: {e}", args.scene.display()));
        let mut renderer = Renderer::new(settings, medium, lights).map_err(|e| failed(&e))?;
        let mut reports = Vec::with_capacity(frames.len());
        for &position in &frames {
            let frame = numbers[position];
            let path = names.path(frame);
            let report = one_frame(&pack, position, &mut renderer, (&scene, &camera), &document, &path, args.float)?;
            reports.push(report);
            progress.advance(1);
        }
        Ok(reports)
    })?;
    progress.finish();
    let megapixels = f64::from(scene.width) * f64::from(scene.height) * 1e-6;
    let total = start.elapsed().as_secs_f64();
    for report in reports.iter().filter(|r| r.clamped > 0) {
        let path = report.path.display();
        eprintln!("smoke-bake: {path}: {} samples above 65504 stored as 65504; --float keeps them", report.clamped);
    }
    if args.json {
        let frames: Vec<Value> = reports.iter().map(|r| r.json(megapixels)).collect();
        let width_height = (scene.width, scene.height);
        return answer::json(&json!({
            "width": width_height.0, "height": width_height.1, "megapixels": megapixels,
            "seconds": total, "settings": document, "frames": frames,
        }));
    }
    let count = reports.len();
    let each = total / count.max(1) as f64;
    answer::text(&format!("{count} images of {} x {} in {total:.2} s, {each:.2} s each\n", scene.width, scene.height))
}

fn one_frame(
    pack: &Pack,
    position: usize,
    renderer: &mut Renderer,
    (scene, camera): (&Scene, &Camera),
    document: &Value,
    path: &Path,
    float: bool,
) -> Result<Report, Failure> {
    let number = pack.frames()[position].frame;
    let start = Instant::now();
    let frame = Frame::read(pack, position)?;
    let decode = start.elapsed().as_secs_f64();
    let failed = |e| Failure::work(format!("{}: frame {number}: {e}", pack.path().display()));
    let start = Instant::now();
    renderer.set_frame(frame).map_err(failed)?;
    let prepared = start.elapsed().as_secs_f64();
    let (film, mut seconds) = renderer.render(camera).map_err(failed)?;
    seconds.source_radiance += prepared;
    let start = Instant::now();
    let clamped = write(pack, number, &film, scene, document, path, float)?;
    Ok(Report { frame: number, path: path.to_owned(), decode, seconds, write: start.elapsed().as_secs_f64(), clamped })
}

fn write(
    pack: &Pack,
    number: i32,
    film: &Film,
    scene: &Scene,
    document: &Value,
    path: &Path,
    float: bool,
) -> Result<usize, Error> {
    let rgb: Vec<[f32; 3]> = film.pixels.iter().map(|p| p.radiance).collect();
    let alpha: Vec<f32> = film.pixels.iter().map(|p| p.alpha()).collect();
    let depth: Vec<f32> = film.pixels.iter().map(|p| p.depth).collect();
    let image = RenderedFrame { width: film.width, height: film.height, rgb: &rgb, alpha: &alpha, depth: &depth };
    let mut settings = document.clone();
    settings["frame"] = json!(number);
    settings["sequence"] = json!(pack.sequence().name);
    let metadata = FrameMetadata {
        software: format!("smoke-bake {}", env!("CARGO_PKG_VERSION")),
        frames_per_second: pack.sequence().frames_per_second.and_then(fraction),
        world_to_camera: scene.pinhole().world_to_camera(),
        world_to_ndc: scene.pinhole().world_to_ndc(),
        settings_json: settings.to_string(),
    };
    let precision = if float { SamplePrecision::Float } else { SamplePrecision::Half };
    image::write_frame(path, &image, &metadata, precision)
}

/// A frame rate as a fraction: whole, NTSC's (24000/1001), or in thousandths.
fn fraction(fps: f64) -> Option<(i32, u32)> {
    [1u32, 1001, 1000].into_iter().find_map(|below| {
        let above = (fps * f64::from(below)).round();
        let near = (above / f64::from(below) - fps).abs() < 1e-3 / f64::from(below) * fps.max(1.0);
        // 1001 divides NTSC rates, whose numerator is a multiple of 1000.
        let good = near && (below != 1001 || above % 1000.0 == 0.0) && above >= 1.0 && above <= f64::from(i32::MAX);
        (good || (below == 1000 && above >= 1.0 && above <= f64::from(i32::MAX))).then_some((above as i32, below))
    })
}

/// What the command line changes in the scene.
pub(crate) fn changes(args: &RenderArgs) -> SceneChanges {
    let RenderArgs { sigma_t, albedo, g, width, height, .. } = *args;
    SceneChanges { sigma_t, albedo, g, width, height }
}

/// The dials, after a check that each given one applies.
pub(crate) fn settings(args: &RenderArgs) -> Result<RenderSettings, Failure> {
    let single = args.order == Order::Single;
    let refuse = |given: bool, option: &str, with: &str| match given {
        true => Err(clap::Error::raw(
            ErrorKind::ArgumentConflict,
            format!("{option} does not apply to {with}; leave it out, or change the other\n"),
        )),
        false => Ok(()),
    };
    refuse(single && args.multiple.is_some(), "--multiple", "--order single")?;
    refuse(single && args.scatter_step.is_some(), "--scatter-step", "--order single")?;
    refuse(single && args.scatter_rings.is_some(), "--scatter-rings", "--order single")?;
    refuse(single && args.scatter_order.is_some(), "--scatter-order", "--order single")?;
    let too_many = args.scatter_order.is_some_and(|order| order > args.sh_order);
    refuse(too_many, "--scatter-order", "a smaller --sh-order")?;
    let route = match args.route {
        RouteChoice::Grid => {
            let with = "--route grid";
            refuse(args.exponential.is_some(), "--exponential", with)?;
            refuse(args.multiple.is_some_and(|m| m != MultipleChoice::Transport), "this --multiple", with)?;
            let d = GridSettings::default();
            Route::Grid(GridSettings {
                beams: args.beams.map_or(d.beams, |v| v as usize),
                single_step: args.source_step.map_or(d.single_step, |v| v as usize),
                multiple_step: args.scatter_step.map_or(d.multiple_step, |v| v as usize),
                rings: args.scatter_rings.map_or(d.rings, usize::from),
                multiple_order: args.scatter_order.map_or(d.multiple_order, usize::from),
                ..d
            })
        }
        RouteChoice::Centres => {
            let with = "--route centres";
            refuse(args.beams.is_some(), "--beams", with)?;
            refuse(args.source_step.is_some(), "--source-step", with)?;
            refuse(args.scatter_step.is_some(), "--scatter-step", with)?;
            refuse(args.scatter_rings.is_some(), "--scatter-rings", with)?;
            refuse(args.scatter_order.is_some(), "--scatter-order", with)?;
            refuse(args.multiple == Some(MultipleChoice::Transport), "--multiple transport", with)?;
            let exponential = match args.exponential.unwrap_or_default() {
                ExponentialChoice::Direct => Exponential::Direct,
                ExponentialChoice::Pointwise => Exponential::Pointwise,
                ExponentialChoice::Hybrid => Exponential::Hybrid,
                ExponentialChoice::Linear => Exponential::OptimalLinear,
            };
            let multiple = match args.multiple {
                _ if single => MultipleScattering::None,
                Some(MultipleChoice::Diffusion) => MultipleScattering::Diffusion,
                _ => MultipleScattering::IntegralCentres,
            };
            let order = usize::from(args.sh_order);
            Route::Centres(CentreSettings { order, exponential, multiple, ..CentreSettings::default() })
        }
    };
    let scattering = if single { ScatteringOrder::Single } else { ScatteringOrder::All };
    let march = MarchSettings {
        step: args.march_step.unwrap_or(0.0) as f32,
        cutoff: args.cutoff as f32,
        samples: usize::from(args.samples),
    };
    Ok(RenderSettings { route, sh_order: usize::from(args.sh_order), scattering, march })
}

/// Everything that an image depends on, but for the pack: dials and scene. Image paths as the scene file has them.
pub(crate) fn document(args: &RenderArgs, settings: &RenderSettings, scene: &Scene) -> Value {
    let automatic = |step: usize| if step == 0 { json!("automatic") } else { json!(step) };
    let mut render = json!({
        "order": if args.order == Order::Single { "single" } else { "all" },
        "sh_order": settings.sh_order,
        "march_step": args.march_step.map_or(json!("automatic"), |step| json!(step)),
        "cutoff": args.cutoff,
        "samples": args.samples,
    });
    match settings.route {
        Route::Grid(grid) => {
            render["route"] = json!("grid");
            render["multiple"] = json!("transport");
            render["beams"] = json!(grid.beams);
            render["source_step"] = automatic(grid.single_step);
            render["scatter_step"] = automatic(grid.multiple_step);
            render["scatter_rings"] = json!(grid.rings);
            render["scatter_order"] = json!(grid.multiple_order);
            render["tolerance"] = json!(grid.tolerance);
            render["iterations"] = json!(grid.iterations);
        }
        Route::Centres(centres) => {
            render["route"] = json!("centres");
            render["exponential"] = json!(match centres.exponential {
                Exponential::Direct => "direct",
                Exponential::Pointwise => "pointwise",
                Exponential::Hybrid => "hybrid",
                Exponential::OptimalLinear => "linear",
            });
            render["multiple"] = json!(match centres.multiple {
                MultipleScattering::None => "none",
                MultipleScattering::Diffusion => "diffusion",
                MultipleScattering::IntegralCentres => "integral",
            });
            render["rings"] = json!(centres.rings);
        }
    }
    if args.order == Order::Single {
        render["multiple"] = json!("none");
    }
    let scene = serde_json::to_value(scene).unwrap_or(Value::Null);
    json!({ "render": render, "scene": scene })
}

impl Report {
    fn json(&self, megapixels: f64) -> Value {
        let Seconds { source_radiance, volume_pass, view_pass } = self.seconds;
        json!({
            "frame": self.frame,
            "image": self.path.display().to_string(),
            "seconds": {
                "decode": self.decode,
                "source_radiance": source_radiance,
                "volume_pass": volume_pass,
                "view_pass": view_pass,
                "write": self.write,
            },
            "view_pass_megapixels_per_second": megapixels / view_pass,
            "samples_above_half": self.clamped,
        })
    }
}
