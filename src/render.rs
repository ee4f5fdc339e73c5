//! `smoke-bake render PACK --scene SCENE -o PATTERN`: frames of a pack as OpenEXR images.
//!
//! Every frame is made from the pack, the scene and the settings alone, never from another frame: one frame or all, one
//! thread or many, the bytes are the same. All settings go into each image's `smokebake:settings`.

use crate::cli::{Detail, RenderArgs};
use crate::devices::{Device, DeviceFrame};
use crate::method::{Image, Maker, Method};
use crate::progress::Progress;
use crate::staging::{SceneChanges, Stage};
use crate::{answer, failure::Failure, pipeline};
use serde_json::{Value, json};
use smoke_formats::Error;
use smoke_formats::image::{self, FrameMetadata, RenderedFrame, SamplePrecision};
use smoke_formats::pack::Pack;
use smoke_formats::scene::Scene;
use smoke_formats::sequence::OutputNames;
use smoke_runtime::medium::frame::Frame;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// What stages took, by name; wall seconds of different frames overlap.
type Stages = Vec<(&'static str, f64)>;

/// A frame where its device draws it from, ready to be lit.
struct Prepared {
    position: usize,
    frame: DeviceFrame,
    seconds: Stages,
}

/// What is told of one frame.
struct Report {
    frame: i32,
    path: PathBuf,
    seconds: Stages,
    device_microseconds: Stages,
    figures: Value,
    clamped: usize,
}

/// What all frames of one run have in common.
pub struct Job<'a> {
    /// The pack.
    pub pack: &'a Pack,
    /// The scene.
    pub scene: &'a Scene,
    /// Dials and scene, for the metadata.
    pub document: Value,
    /// How the images are made.
    pub method: Method,
    /// How much of a frame is decoded.
    pub detail: Detail,
    /// How samples are stored.
    pub precision: SamplePrecision,
}

/// Steps of progress that a frame counts for.
const STEPS: u64 = 1000;

/// Renders the frames, one after the other.
pub fn run(args: &RenderArgs) -> Result<(), Failure> {
    let device = Device::open(&args.device)?;
    let stage = Stage::read(&args.scene, &changes(args))?;
    let pack = Pack::open(&args.pack)?;
    let numbers: Vec<i32> = pack.frames().iter().map(|f| f.frame).collect();
    let frames = match &args.frames {
        Some(selection) => selection.positions(&args.pack, &numbers)?,
        None => (0..numbers.len()).collect(),
    };
    let names = OutputNames::new(&args.output, frames.len())?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build();
    let pool = pool.map_err(|e| Failure::work(format!("--threads: {e}")))?;
    let (method, said) = pool.install(|| Method::planned(args, &stage, &pack))?;
    if let Some(said) = said {
        eprintln!("smoke-bake: {said}");
    }
    let scene = &stage.scene;
    let mut document = document(&method, args.detail, scene);
    document["render"]["device"] = json!(device.name());
    let job = Job {
        pack: &pack,
        scene,
        document,
        method,
        detail: args.detail,
        precision: if args.float { SamplePrecision::Float } else { SamplePrecision::Half },
    };
    let progress = Progress::start(args.progress, "rendering frames", frames.len() as u64 * STEPS);
    let start = Instant::now();
    let reports = pool.install(|| -> Result<Vec<Report>, Failure> {
        let mut maker =
            method.maker(&stage, &device).map_err(|e| Failure::work(format!("{}: {e}", args.scene.display())))?;
        job.sequence(&frames, |position| names.path(numbers[position]), &mut maker, &device, &progress)
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
            "seconds": total, "settings": job.document, "frames": frames,
        }));
    }
    let count = reports.len();
    let each = total / count.max(1) as f64;
    answer::text(&format!("{count} images of {} x {} in {total:.2} s, {each:.2} s each\n", scene.width, scene.height))
}

/// As much as `method` needs and `detail` asks of the frame at `position` of a pack.
pub fn read(pack: &Pack, position: usize, method: &Method, detail: Detail) -> Result<Frame, Error> {
    match (method, detail) {
        (Method::Transfer(_), _) => Frame::read_with_transfer(pack, position),
        (_, Detail::Full) => Frame::read(pack, position),
        (_, Detail::Gaussians) => Frame::read_gaussians(pack, position),
    }
}

/// Everything that an image depends on, but for the pack: dials and scene. Image paths as the scene file has them.
pub fn document(method: &Method, detail: Detail, scene: &Scene) -> Value {
    let mut render = method.document();
    render["detail"] = json!(if detail == Detail::Full { "full" } else { "gaussians" });
    json!({ "render": render, "scene": serde_json::to_value(scene).unwrap_or(Value::Null) })
}

impl Job<'_> {
    /// Makes and writes the images of `frames`. While one is made, the next frame is decoded and taken to the device, and the
    /// image before is written: a graphics device does not wait for the processor.
    fn sequence(
        &self,
        frames: &[usize],
        path: impl Fn(usize) -> PathBuf + Sync,
        maker: &mut Maker,
        device: &Device,
        progress: &Progress,
    ) -> Result<Vec<Report>, Failure> {
        pipeline::run(
            frames.len(),
            |turn| self.prepare(frames[turn], device),
            |_, prepared| self.make(prepared, maker, progress),
            |turn, (image, seconds)| self.finish(frames[turn], path(frames[turn]), image, seconds),
        )
    }

    fn prepare(&self, position: usize, device: &Device) -> Result<Prepared, Failure> {
        let start = Instant::now();
        let frame = read(self.pack, position, &self.method, self.detail)?;
        let mut seconds = vec![("decode", start.elapsed().as_secs_f64())];
        let start = Instant::now();
        let frame = device.take(Arc::new(frame)).map_err(|e| self.failure(position, e))?;
        if device.is_graphics() {
            seconds.push(("upload", start.elapsed().as_secs_f64()));
        }
        Ok(Prepared { position, frame, seconds })
    }

    /// The image, and the seconds of the frame's stages so far.
    fn make(&self, prepared: Prepared, maker: &mut Maker, progress: &Progress) -> Result<(Image, Stages), Failure> {
        let mut steps = 0;
        let mut advance = |part: f64| {
            let now = (part * STEPS as f64) as u64;
            progress.advance(now.saturating_sub(steps));
            steps = steps.max(now);
        };
        let Prepared { position, frame, mut seconds } = prepared;
        let image = self.image(position, frame, maker, &mut advance)?;
        advance(1.0);
        seconds.extend_from_slice(&image.seconds);
        Ok((image, seconds))
    }

    fn finish(&self, position: usize, path: PathBuf, image: Image, mut seconds: Stages) -> Result<Report, Failure> {
        let number = self.pack.frames()[position].frame;
        let start = Instant::now();
        let clamped = self.write(number, &image, &path)?;
        seconds.push(("write", start.elapsed().as_secs_f64()));
        let Image { device_microseconds, figures, .. } = image;
        Ok(Report { frame: number, path, seconds, device_microseconds, figures, clamped })
    }

    /// The image of `frame`, which is the one at `position` of the pack.
    pub fn image(
        &self,
        position: usize,
        frame: DeviceFrame,
        maker: &mut Maker,
        done: &mut dyn FnMut(f64),
    ) -> Result<Image, Failure> {
        maker.image(frame, done).map_err(|e| self.failure(position, e))
    }

    /// What is wrong with the frame at `position`.
    fn failure(&self, position: usize, message: String) -> Failure {
        let number = self.pack.frames()[position].frame;
        Failure::work(format!("{}: frame {number}: {message}", self.pack.path().display()))
    }

    /// Writes the image of frame `number`; gives how many samples did not fit.
    pub fn write(&self, number: i32, image: &Image, path: &Path) -> Result<usize, Error> {
        let film = &image.film;
        let rgb: Vec<[f32; 3]> = film.pixels.iter().map(|p| p.radiance).collect();
        let alpha: Vec<f32> = film.pixels.iter().map(|p| p.alpha()).collect();
        let depth: Vec<f32> = film.pixels.iter().map(|p| p.depth).collect();
        let frame = RenderedFrame {
            width: film.width,
            height: film.height,
            rgb: &rgb,
            alpha: &alpha,
            depth: &depth,
            standard_error: image.standard_error.as_deref(),
        };
        let mut settings = self.document.clone();
        settings["frame"] = json!(number);
        settings["sequence"] = json!(self.pack.sequence().name);
        for (name, value) in image.figures.as_object().into_iter().flatten() {
            settings[name] = value.clone();
        }
        let metadata = FrameMetadata {
            software: format!("smoke-bake {}", env!("CARGO_PKG_VERSION")),
            frames_per_second: self.pack.sequence().frames_per_second.and_then(fraction),
            world_to_camera: self.scene.pinhole().world_to_camera(),
            world_to_ndc: self.scene.pinhole().world_to_ndc(),
            settings_json: settings.to_string(),
        };
        image::write_frame(path, &frame, &metadata, self.precision)
    }
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
pub fn changes(args: &RenderArgs) -> SceneChanges {
    let RenderArgs { sigma_t, albedo, g, width, height, .. } = *args;
    SceneChanges { sigma_t, albedo, g, width, height }
}

impl Report {
    fn json(&self, megapixels: f64) -> Value {
        let by_name = |stages: &Stages| -> serde_json::Map<String, Value> {
            stages.iter().map(|(name, took)| ((*name).to_owned(), json!(took))).collect()
        };
        let seconds = by_name(&self.seconds);
        let mut report = json!({
            "frame": self.frame,
            "image": self.path.display().to_string(),
            "seconds": seconds,
            "samples_above_half": self.clamped,
        });
        if !self.device_microseconds.is_empty() {
            report["device_microseconds"] = by_name(&self.device_microseconds).into();
        }
        if let Some((_, view_pass)) = self.seconds.iter().find(|(name, _)| *name == "view_pass") {
            report["view_pass_megapixels_per_second"] = json!(megapixels / view_pass);
        }
        for (name, value) in self.figures.as_object().into_iter().flatten() {
            report[name] = value.clone();
        }
        report
    }
}
