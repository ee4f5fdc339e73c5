//! Threads that make pictures while the window stays awake: the newest request wins.
//!
//! A request that is *moving* gets one picture at once, with as many pixels as fit into [`MOVING_SECONDS`]; one at rest is
//! refined pass after pass, and each pass gives the mean so far, until something newer is asked. The first pass at rest is
//! the image that `render` makes at this size; the passes after it look through other points of their pixels, by a turn of
//! the camera of less than a pixel: the offsets are the first two dimensions of Sobol's sequence (1967), whose first 4^k
//! points have one in each of 4^k equal squares of the pixel.

use super::painter::{Painter, Stages};
use crate::devices::{Device, DeviceFrame};
use crate::failure::Failure;
use crate::method::Method;
use crate::staging::{Stage, read_sky};
use smoke_formats::image::RgbImage;
use smoke_formats::scene::Scene;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// Seconds that the pixels of a moving picture may take.
const MOVING_SECONDS: f64 = 0.03;
/// Pixels along a side that one pixel of a moving picture stands for, at most.
const COARSEST: usize = 8;
/// Passes of a picture at rest: of one without noise, and of one that is traced.
const PASSES: [u32; 2] = [16, 1024];

/// What is to be seen.
#[derive(Clone)]
pub struct Request {
    /// Grows with every change.
    pub serial: u64,
    /// Camera, lights, medium, and the size of the picture.
    pub scene: Scene,
    /// The smoke, where the device of the pictures draws it from.
    pub frame: DeviceFrame,
    /// How.
    pub method: Method,
    /// True while more changes are expected.
    pub moving: bool,
}

/// What came of it.
pub struct Picture {
    /// Serial of the request.
    pub serial: u64,
    /// The mean of all passes so far; smaller than asked if moving.
    pub film: Arc<Film>,
    /// Passes in it; 0 if moving.
    pub passes: u32,
    /// Passes that it will have.
    pub of: u32,
    /// What the last pass took.
    pub stages: Stages,
}

/// A picture, or the serial and the reason why there is none.
pub type Answer = Result<Picture, (u64, String)>;

/// An image, or why there is none.
type ReadSky = Result<Arc<RgbImage>, String>;

/// Environment images that were read, by path; those that could not be, with the reason.
#[derive(Clone, Default)]
pub struct Skies(Arc<Mutex<HashMap<PathBuf, ReadSky>>>);

impl Skies {
    /// The image at `path`, read once.
    pub fn get(&self, path: &Path) -> Result<Arc<RgbImage>, Failure> {
        // Both threads need the same image at the same time: the second waits here for the first.
        let mut skies = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let read = || match read_sky(path) {
            Ok(image) => Ok(Arc::new(image)),
            Err(Failure::Work(message)) => Err(message),
            Err(Failure::Usage(e)) => Err(e.to_string()),
        };
        skies.entry(path.to_owned()).or_insert_with(read).clone().map_err(Failure::Work)
    }
}

#[derive(Default)]
struct Slot {
    newest: Option<Request>,
    closed: bool,
}

#[derive(Default)]
struct Mailbox {
    slot: Mutex<Slot>,
    wake: Condvar,
}

impl Mailbox {
    fn slot(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The newest request; none when all is over.
    fn wait(&self) -> Option<Request> {
        let mut slot = self.slot();
        loop {
            if slot.closed {
                return None;
            }
            if let Some(request) = slot.newest.take() {
                return Some(request);
            }
            slot = self.wake.wait(slot).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn has_news(&self) -> bool {
        let slot = self.slot();
        slot.closed || slot.newest.is_some()
    }
}

/// A thread with a renderer. Ends after its pass when it is dropped.
pub struct Worker {
    mailbox: Arc<Mailbox>,
    answers: Receiver<Answer>,
}

impl Worker {
    /// A thread that works in a pool of its own, so that two workers share the processor fairly. `answered` is called
    /// after each answer.
    pub fn start(device: Device, skies: Skies, answered: impl Fn() + Send + 'static) -> Self {
        let mailbox = Arc::new(Mailbox::default());
        let (sender, answers) = channel();
        let inbox = mailbox.clone();
        std::thread::spawn(move || {
            let work = move || run(device, &inbox, &skies, &sender, &answered);
            match rayon::ThreadPoolBuilder::new().build() {
                Ok(pool) => pool.install(work),
                Err(_) => work(),
            }
        });
        Self { mailbox, answers }
    }

    /// Asks for a picture instead of all that was asked before.
    pub fn ask(&self, request: Request) {
        self.mailbox.slot().newest = Some(request);
        self.mailbox.wake.notify_all();
    }

    /// The next answer, if there is one; an error if the thread has ended.
    pub fn answer(&self) -> Result<Option<Answer>, String> {
        match self.answers.try_recv() {
            Ok(answer) => Ok(Some(answer)),
            Err(TryRecvError::Empty) => Ok(None),
            Err(TryRecvError::Disconnected) => Err("the rendering thread has ended; start view again".into()),
        }
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.mailbox.slot().closed = true;
        self.mailbox.wake.notify_all();
    }
}

fn run(device: Device, inbox: &Mailbox, skies: &Skies, sender: &Sender<Answer>, answered: &dyn Fn()) {
    let mut painter = Painter::new(device);
    let mut pace = Pace::default();
    while let Some(request) = inbox.wait() {
        let serial = request.serial;
        let outcome = serve(&request, &mut painter, &mut pace, skies, &mut |picture| {
            // A window that has closed wants nothing.
            let wanted = sender.send(Ok(picture)).is_ok();
            answered();
            wanted && !inbox.has_news()
        });
        if let Err(message) = outcome {
            if sender.send(Err((serial, message))).is_err() {
                return;
            }
            answered();
        }
    }
}

/// Makes the pictures of one request; `give` takes each and says whether to go on.
fn serve(
    request: &Request,
    painter: &mut Painter,
    pace: &mut Pace,
    skies: &Skies,
    give: &mut dyn FnMut(Picture) -> bool,
) -> Result<(), String> {
    let stage = Stage::with(request.scene.clone(), &mut |path| skies.get(path)).map_err(|e| match e {
        Failure::Work(message) => message,
        Failure::Usage(e) => e.to_string(),
    })?;
    let Request { serial, ref method, ref frame, moving, .. } = *request;
    let of = PASSES[usize::from(matches!(method, Method::Reference(_)))];
    if moving {
        let camera = coarse(&stage.camera, pace.divisor(stage.camera.width * stage.camera.height));
        let pass = painter.pass(method, &stage, frame, &camera, 0)?;
        pace.took(camera.width * camera.height, &pass.stages);
        give(Picture { serial, film: Arc::new(pass.film), passes: 0, of, stages: pass.stages });
        return Ok(());
    }
    let mut mean = Mean::new();
    for number in 0..of {
        let camera = shifted(&stage.camera, offset(number));
        let pass = painter.pass(method, &stage, frame, &camera, number)?;
        pace.took(camera.width * camera.height, &pass.stages);
        mean.add(pass.film, pass.weight);
        let film = Arc::new(mean.film.clone());
        if !give(Picture { serial, film, passes: number + 1, of, stages: pass.stages }) {
            break;
        }
    }
    Ok(())
}

/// How long pixels take.
#[derive(Default)]
struct Pace {
    seconds_per_pixel: Option<f64>,
}

impl Pace {
    /// Notes the last stage, the only one that depends on the pixels.
    fn took(&mut self, pixels: usize, stages: &Stages) {
        let last = stages.wall.last().map(|s| s.1 / pixels.max(1) as f64);
        self.seconds_per_pixel = last.filter(|s| s.is_finite()).or(self.seconds_per_pixel);
    }

    /// Pixels along a side that one may stand for, so that `pixels` are done in time.
    fn divisor(&self, pixels: usize) -> usize {
        let Some(each) = self.seconds_per_pixel else { return COARSEST / 2 };
        let fits = |d: &usize| each * pixels as f64 / (d * d) as f64 <= MOVING_SECONDS;
        (1..COARSEST).find(fits).unwrap_or(COARSEST)
    }
}

/// The mean of films of one size, by their weights.
struct Mean {
    film: Film,
    weight: u32,
}

impl Mean {
    fn new() -> Self {
        Self { film: Film::new(0, 0), weight: 0 }
    }

    fn add(&mut self, film: Film, weight: u32) {
        self.weight = self.weight.saturating_add(weight);
        if self.weight == weight {
            self.film = film;
            return;
        }
        let share = weight as f32 / self.weight as f32;
        for (mean, new) in self.film.pixels.iter_mut().zip(&film.pixels) {
            for c in 0..3 {
                mean.radiance[c] += (new.radiance[c] - mean.radiance[c]) * share;
                mean.transmittance[c] += (new.transmittance[c] - mean.transmittance[c]) * share;
            }
            mean.depth = mean.depth.min(new.depth);
        }
    }
}

/// The same view with one pixel for `divisor` x `divisor`.
fn coarse(camera: &Camera, divisor: usize) -> Camera {
    let side = |pixels: usize| pixels.div_ceil(divisor).max(1);
    Camera { width: side(camera.width), height: side(camera.height), ..*camera }
}

/// Where pass `number` looks through its pixels, in pixels from their middle: the middle first.
fn offset(number: u32) -> [f64; 2] {
    let (mut second, mut direction) = (0u32, 1u32 << 31);
    for bit in 0..32 {
        second ^= direction * (number >> bit & 1);
        direction ^= direction >> 1;
    }
    // The first point is 0: half a pixel on, round the end, lies the middle.
    [number.reverse_bits(), second].map(|v| f64::from(v ^ 1 << 31) / 2f64.powi(32) - 0.5)
}

/// `camera` turned so that the middle of its image is `x` pixels to the right and `y` down from where it was.
fn shifted(camera: &Camera, [x, y]: [f64; 2]) -> Camera {
    if [x, y] == [0.0; 2] {
        return *camera;
    }
    let (middle_x, middle_y) = (0.5 * camera.width as f64, 0.5 * camera.height as f64);
    let forward = camera.direction(middle_x + x, middle_y + y);
    let right = forward.cross(camera.up).normalize();
    Camera { forward, right, up: right.cross(forward), ..*camera }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{small_pack, stage};
    use smoke_formats::pack::Pack;
    use smoke_formats::scene::{Light, Sky};
    use smoke_runtime::film::Pixel;
    use smoke_runtime::medium::frame::Frame;
    use smoke_runtime::renderer::{RenderSettings, Renderer};
    use std::collections::BTreeSet;
    use std::time::{Duration, Instant};

    fn request() -> Request {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.smoke");
        small_pack(&path, &[1], 0.01);
        let frame = DeviceFrame::Cpu(Arc::new(Frame::read(&Pack::open(&path).unwrap(), 0).unwrap()));
        let mut scene = stage().scene;
        (scene.camera.position, scene.camera.target) = ([7.0, -6.0, 3.5], [7.0, 1.7, 3.5]);
        let sky = Sky::Color([1.0, 0.5, 0.25]);
        scene.lights = vec![Light::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: false }];
        Request { serial: 1, scene, frame, method: Method::Compensated(RenderSettings::default()), moving: false }
    }

    fn wait(worker: &Worker) -> Answer {
        let start = Instant::now();
        loop {
            if let Some(answer) = worker.answer().unwrap() {
                return answer;
            }
            assert!(start.elapsed() < Duration::from_secs(60));
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    #[test]
    fn the_first_pass_at_rest_is_the_image_of_render_and_the_last_is_a_smooth_mean() {
        let request = request();
        let worker = Worker::start(Device::Cpu, Skies::default(), || {});
        worker.ask(request.clone());
        let first = wait(&worker).map_err(|e| e.1).unwrap();
        let stage = Stage::with(request.scene, &mut |_| unreachable!()).unwrap();
        let mut renderer = Renderer::new(RenderSettings::default(), stage.medium, stage.lights.clone()).unwrap();
        renderer.set_frame(request.frame.frame().clone()).unwrap();
        assert_eq!((*first.film).clone(), renderer.render(&stage.camera).unwrap().0);
        assert_eq!((first.passes, first.of, first.stages.wall.len()), (1, PASSES[0], 3));
        let mut last = first;
        while last.passes < PASSES[0] {
            last = wait(&worker).map_err(|e| e.1).unwrap();
        }
        let levels = |film: &Film| film.pixels.iter().filter(|p| p.alpha() > 0.0).count();
        assert!(levels(&last.film) > 0);
    }

    #[test]
    fn the_newest_request_wins_and_a_refusal_names_its_serial() {
        let worker = Worker::start(Device::Cpu, Skies::default(), || {});
        let mut asked = request();
        for serial in 1..=50 {
            asked.serial = serial;
            worker.ask(asked.clone());
        }
        asked.serial = 51;
        asked.scene.lights.push(Light::Point { position: [0.0; 3], intensity: [1.0; 3] });
        worker.ask(asked.clone());
        let refused = loop {
            match wait(&worker) {
                Ok(picture) => assert!(picture.serial <= 50),
                Err(refused) => break refused,
            }
        };
        assert!(refused.0 == 51 && refused.1.contains("light[1]"), "{refused:?}");
        let sky = Sky::Image { written: "none.exr".into(), resolved: "none.exr".into() };
        asked.scene.lights = vec![Light::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: true }];
        asked.serial = 52;
        worker.ask(asked);
        assert!(wait(&worker).map(|_| ()).unwrap_err().1.contains("none.exr"));
    }

    #[test]
    fn moving_pictures_have_as_many_pixels_as_there_is_time_for() {
        let mut pace = Pace::default();
        assert_eq!(pace.divisor(1_000_000), COARSEST / 2);
        for (seconds, divisor) in [(0.029, 1), (0.031, 2), (0.12, 2), (0.26, 3), (1e9, COARSEST)] {
            let wall = vec![("solve", 100.0), ("march", seconds)];
            pace.took(1_000_000, &Stages { wall, device: Vec::new() });
            assert_eq!(pace.divisor(1_000_000), divisor, "{seconds}");
        }
        let worker = Worker::start(Device::Cpu, Skies::default(), || {});
        worker.ask(Request { moving: true, ..request() });
        let picture = wait(&worker).map_err(|e| e.1).unwrap();
        assert_eq!((picture.passes, picture.film.width, picture.film.height), (0, 2, 2));
    }

    #[test]
    fn a_shift_by_a_pixel_shows_what_the_next_pixel_saw() {
        let camera = Camera { width: 300, height: 200, ..stage().camera };
        let moved = shifted(&camera, [1.0, -2.0]);
        let error = (moved.direction(150.0, 100.0) - camera.direction(151.0, 98.0)).length();
        assert!(error < 1e-15, "{error}");
        // Off the middle a turn moves a point by up to 1 + tan^2 pixels: 1.07 at 15 degrees.
        let pixel = 2.0 * camera.tan_half_width / 300.0;
        let error = (moved.direction(0.0, 0.0) - camera.direction(1.0, -2.0)).length();
        assert!(error < 0.25 * pixel, "{error} {pixel}");
    }

    #[test]
    fn offsets_begin_in_the_middle_and_spread_evenly() {
        assert_eq!(offset(0), [0.0, 0.0]);
        for side in [2, 4, 8] {
            let cell = |number| offset(number).map(|v| ((v + 0.5) * side as f64) as usize);
            let cells: BTreeSet<[usize; 2]> = (0..side * side).map(cell).collect();
            assert_eq!(cells.len() as u32, side * side, "one point in each square");
            assert!(cells.iter().flatten().all(|&c| c < side as usize));
        }
    }

    #[test]
    fn a_mean_weighs_its_films_and_keeps_the_first_to_the_bit() {
        let film = |v: f32, depth| Film {
            width: 1,
            height: 1,
            pixels: vec![Pixel { radiance: [v; 3], transmittance: [0.5 * v; 3], depth }],
        };
        let mut mean = Mean::new();
        mean.add(film(0.1, 3.0), 2);
        assert_eq!(mean.film, film(0.1, 3.0));
        mean.add(film(0.4, 2.0), 4);
        // (2 * 0.1 + 4 * 0.4) / 6, a few roundings of 6e-8.
        assert!((mean.film.pixels[0].radiance[0] - 0.3).abs() < 1e-7);
        assert!((mean.film.pixels[0].transmittance[1] - 0.15).abs() < 1e-7 && mean.film.pixels[0].depth == 2.0);
    }
}
