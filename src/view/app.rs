//! The window: takes what the user does to the state, the state to the workers, and their pictures to the screen.

use super::opening::{Opened, Opening};
use super::playback::Playback;
use super::saving::Saving;
use super::shot::{Outcome, Shot};
use super::state::State;
use super::worker::{Picture, Request, Skies, Worker};
use super::{painter, panel, tone};
use crate::cli::{MethodChoice, ViewArgs};
use crate::devices::Device;
use crate::failure::Failure;
use crate::method::Method;
use eframe::egui::{self, ColorImage, Context, Rect, TextureHandle, TextureOptions, Vec2, ViewportBuilder};
use smoke_formats::pack::Pack;
use smoke_formats::scene::{Light, Medium, Scene, UpAxis};
use smoke_runtime::film::Film;
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, PoisonError};
use std::time::{Duration, Instant};

/// Time without a change after which a picture is refined.
const SETTLED: Duration = Duration::from_millis(120);
/// Frames a second where the pack does not say.
const FPS: f64 = 24.0;

/// A line for the user.
pub struct Message {
    /// What to say.
    pub text: String,
    /// True if something failed.
    pub bad: bool,
}

/// The picture on the screen.
pub struct Shown {
    serial: u64,
    rank: u32,
    film: Arc<Film>,
    texture: TextureHandle,
    /// Exposure of the texture.
    stops: f64,
    /// Passes in it, and how many it will have; no passes while moving.
    pub passes: [u32; 2],
    /// What its stages took.
    pub stages: painter::Stages,
}

/// What was asked of the workers last.
#[derive(Default)]
struct Asked {
    serial: u64,
    seen: Option<(Scene, usize, Method)>,
    at: Option<Instant>,
    at_rest: bool,
}

/// All that the full worker has to solve anew when it changes: not the camera.
type Solved = (UpAxis, Vec<Light>, Medium, usize, Method);

/// What runs while it plays.
struct Playing {
    since: Instant,
    from: usize,
}

/// See the module's head.
pub struct App {
    /// The pack.
    pub pack: Arc<Pack>,
    /// What is edited.
    pub state: State,
    /// Its frames.
    pub playback: Playback,
    /// Frames a second.
    pub fps: f64,
    /// Frames that playback had to wait for.
    pub waits: u32,
    /// What is on the screen.
    pub shown: Option<Shown>,
    /// What to say.
    pub message: Option<Message>,
    /// Whether the panel is there, and the list of keys.
    pub open: [bool; 2],
    /// What makes the pictures.
    pub device: Device,
    /// What draws the window.
    pub screen: String,
    /// Pictures of the last second.
    pictures: VecDeque<Instant>,
    /// True until the exposure was chosen from a picture at full quality.
    pub choose_exposure: bool,
    playing: Option<Playing>,
    asked: Asked,
    solved: Option<Solved>,
    solving: Option<(u64, Solved)>,
    quick: Worker,
    full: Worker,
    /// Environment images.
    pub skies: Skies,
    with_transfer: bool,
    /// What is being opened.
    pub opening: Option<Receiver<Result<Opened, Failure>>>,
    /// The method that was asked for, for what is opened later.
    pub method: MethodChoice,
    saving: Option<Receiver<Result<PathBuf, Failure>>>,
    output: PathBuf,
    shot: Option<Shot>,
    /// The window.
    pub ctx: Context,
}

/// Opens pack and scene, then the window.
pub fn run(args: &ViewArgs) -> Result<(), Failure> {
    let skies = Skies::default();
    let device = Device::open(&args.device)?;
    let opened = Opening::of(args).open(&skies)?;
    let outcome = Outcome::default();
    let shot = args.screenshot.clone().map(|path| Shot::new(path, args.seconds, outcome.clone()));
    let title = format!("{} - smoke-bake", opened.pack.path().display());
    let size = Vec2::new(args.width as f32, args.height as f32);
    let viewport = ViewportBuilder::default().with_title(title).with_inner_size(size).with_drag_and_drop(true);
    let options = eframe::NativeOptions { viewport, ..Default::default() };
    let create: eframe::AppCreator<'_> = Box::new(|cc| {
        let info = cc.wgpu_render_state.as_ref().map(|render| render.adapter.get_info());
        let screen = info.map_or_else(String::new, |info| format!("{} ({})", info.name, info.backend));
        Ok(Box::new(App::new(cc.egui_ctx.clone(), screen, args, device, opened, skies, shot)))
    });
    eframe::run_native("smoke-bake", options, create).map_err(|e| {
        let (missing, why) = match e {
            // Its text names a line of the source.
            eframe::Error::WinitEventLoop(_) => ("a display (DISPLAY or WAYLAND_DISPLAY)", String::new()),
            eframe::Error::Wgpu(e) => ("a graphics driver (Vulkan, Metal or Direct3D 12)", format!(": {e}")),
            e => ("a display and a graphics driver", format!(": {e}")),
        };
        Failure::work(format!("view needs {missing} and cannot open its window{why}; without one, use render"))
    })?;
    match outcome.lock().unwrap_or_else(PoisonError::into_inner).take() {
        Some(outcome) => outcome.map_err(Failure::work),
        None if args.screenshot.is_some() => Err(Failure::work("the window was closed before its screenshot")),
        None => Ok(()),
    }
}

impl App {
    fn new(
        ctx: Context,
        screen: String,
        args: &ViewArgs,
        device: Device,
        opened: Opened,
        skies: Skies,
        shot: Option<Shot>,
    ) -> Self {
        panel::style(&ctx);
        let waker = |ctx: &Context| {
            let ctx = ctx.clone();
            move || ctx.request_repaint()
        };
        let Opened { pack, state } = opened;
        let with_transfer = state.method == MethodChoice::Transfer;
        Self {
            playback: Playback::start(pack.clone(), with_transfer, device.clone(), state.position, waker(&ctx)),
            fps: pack.sequence().frames_per_second.unwrap_or(FPS),
            waits: 0,
            shown: None,
            message: None,
            open: [true, false],
            device: device.clone(),
            screen,
            pictures: VecDeque::new(),
            choose_exposure: true,
            playing: None,
            asked: Asked::default(),
            solved: None,
            solving: None,
            quick: Worker::start(device.clone(), skies.clone(), waker(&ctx)),
            full: Worker::start(device, skies.clone(), waker(&ctx)),
            skies,
            with_transfer,
            opening: None,
            method: args.method,
            saving: None,
            output: args.output.clone().unwrap_or_else(|| ".".into()),
            shot,
            pack,
            state,
            ctx,
        }
    }

    /// True while a picture at rest is in work or done.
    pub fn is_at_rest(&self) -> bool {
        self.asked.at_rest
    }

    /// True while it plays.
    pub fn is_playing(&self) -> bool {
        self.playing.is_some()
    }

    /// Pictures a second, of the last second.
    pub fn rate(&self) -> usize {
        self.pictures.len()
    }

    /// Begins to play, or stops.
    pub fn toggle_play(&mut self) {
        let from = self.state.position;
        self.playing = match self.playing {
            Some(_) => None,
            None => (self.playback.count() > 1).then(|| Playing { since: Instant::now(), from }),
        };
    }

    /// Stops at another frame, `step` from this one, round the ends.
    pub fn step(&mut self, step: isize) {
        self.playing = None;
        let count = self.playback.count() as isize;
        self.state.position = (self.state.position as isize + step).rem_euclid(count.max(1)) as usize;
    }

    /// Saves what is seen, on a thread.
    pub fn save(&mut self) {
        if self.saving.is_some() {
            return;
        }
        let State { scene, position, stops, .. } = self.state.clone();
        let (pack, method, folder) = (self.pack.clone(), self.state.method(), self.output.clone());
        let saving = Saving { pack, scene, position, method, stops, folder };
        self.saving = Some(self.on_a_thread(move || saving.run()));
        self.say("saving at full quality ...", false);
    }

    /// Says something over the picture.
    pub fn say(&mut self, text: impl Into<String>, bad: bool) {
        self.message = Some(Message { text: text.into(), bad });
    }

    /// Does `work` beside the window.
    pub fn on_a_thread<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Receiver<T> {
        let (sender, receiver) = channel();
        let ctx = self.ctx.clone();
        std::thread::spawn(move || {
            // If the window has closed, nobody is there to be told.
            let _ = sender.send(work());
            ctx.request_repaint();
        });
        receiver
    }

    /// What other threads have done.
    fn take_answers(&mut self) {
        if let Some(opened) = self.opening.as_ref().and_then(|r| r.try_recv().ok()) {
            self.opening = None;
            match opened {
                Ok(Opened { pack, state }) => {
                    (self.pack, self.state, self.message, self.playing) = (pack, state, None, None);
                    (self.choose_exposure, self.waits) = (true, 0);
                    self.fps = self.pack.sequence().frames_per_second.unwrap_or(FPS);
                    self.restart_playback();
                    let title = format!("{} - smoke-bake", self.pack.path().display());
                    self.ctx.send_viewport_cmd(egui::ViewportCommand::Title(title));
                }
                Err(failure) => self.say(one_line(failure), true),
            }
        }
        if let Some(saved) = self.saving.as_ref().and_then(|r| r.try_recv().ok()) {
            self.saving = None;
            match saved {
                Ok(path) => self.say(said_of(&path), false),
                Err(failure) => self.say(one_line(failure), true),
            }
        }
        for full in [false, true] {
            loop {
                let answer = if full { self.full.answer() } else { self.quick.answer() };
                match answer {
                    Ok(None) => break,
                    Ok(Some(Ok(picture))) => self.show(picture, full),
                    // What was refused long ago is not said any more.
                    Ok(Some(Err((serial, message)))) if serial == self.asked.serial => self.say(message, true),
                    Ok(Some(Err(_))) => {}
                    Err(message) => {
                        self.say(message, true);
                        break;
                    }
                }
            }
        }
    }

    fn show(&mut self, picture: Picture, full: bool) {
        let Picture { serial, film, passes, of, stages } = picture;
        if full
            && let Some((asked, solved)) = &self.solving
            && *asked == serial
        {
            self.solved = Some(solved.clone());
        }
        let rank = if passes == 0 { u32::from(full) } else { 1 + passes };
        if self.shown.as_ref().is_some_and(|s| (s.serial, s.rank) > (serial, rank)) {
            return;
        }
        if self.choose_exposure {
            self.state.stops = tone::stops_for(&film).unwrap_or(self.state.stops);
            self.choose_exposure = passes == 0;
        }
        if self.message.as_ref().is_some_and(|m| m.bad) && self.shown.as_ref().is_some_and(|s| s.serial < serial) {
            self.message = None;
        }
        self.pictures.push_back(Instant::now());
        let stops = self.state.stops;
        let (image, options) = (image(&film, stops), TextureOptions::LINEAR);
        let texture = match self.shown.take() {
            Some(mut shown) => {
                shown.texture.set(image, options);
                shown.texture
            }
            None => self.ctx.load_texture("picture", image, options),
        };
        self.shown = Some(Shown { serial, rank, film, texture, stops, passes: [passes, of], stages });
    }

    fn restart_playback(&mut self) {
        self.with_transfer = self.state.method == MethodChoice::Transfer;
        let ctx = self.ctx.clone();
        let (pack, device, position) = (self.pack.clone(), self.device.clone(), self.state.position);
        self.playback = Playback::start(pack, self.with_transfer, device, position, move || ctx.request_repaint());
        self.asked.seen = None;
        self.solved = None;
    }

    /// Moves on to the frame that the time asks for, once it is there.
    fn play(&mut self) {
        let Some(Playing { since, from }) = &self.playing else { return };
        let steps = (since.elapsed().as_secs_f64() * self.fps) as usize;
        let wanted = (from + steps) % self.playback.count().max(1);
        if wanted != self.state.position {
            if self.playback.has(wanted) {
                self.state.position = wanted;
            } else {
                // From the next frame on again, when it comes.
                self.waits += 1;
                let from = (self.state.position + 1) % self.playback.count().max(1);
                self.playing = Some(Playing { since: Instant::now(), from });
            }
        }
        self.ctx.request_repaint_after(Duration::from_secs_f64(0.5 / self.fps.max(1.0)));
    }

    /// Asks the workers for what has changed; and for more of what has not.
    fn ask(&mut self, size: [u32; 2]) {
        if (self.state.method == MethodChoice::Transfer) != self.with_transfer {
            self.restart_playback();
        }
        let frame = match self.playback.at(self.state.position) {
            None => return,
            Some(Err(message)) => return self.say(message, true),
            Some(Ok(frame)) => frame,
        };
        let mut scene = self.state.scene.clone();
        [scene.width, scene.height] = size;
        let method = self.state.method();
        let key = (scene, self.state.position, method);
        let changed = self.asked.seen.as_ref() != Some(&key);
        if changed {
            self.asked.serial += 1;
            (self.asked.at, self.asked.at_rest) = (Some(Instant::now()), false);
            self.asked.seen = Some(key.clone());
        }
        let (scene, position, method) = key;
        let solved = (scene.up, scene.lights.clone(), scene.medium.clone(), position, method);
        let mut request = Request { serial: self.asked.serial, scene, frame, method, moving: true };
        if changed {
            if self.solved.as_ref() == Some(&solved) {
                self.solving = Some((request.serial, solved));
                self.full.ask(request);
            } else {
                request.method = self.state.moving_method();
                self.quick.ask(request);
            }
        } else if !self.asked.at_rest && self.playing.is_none() {
            let still = self.asked.at.map_or(SETTLED, |at| at.elapsed());
            if still < SETTLED {
                self.ctx.request_repaint_after(SETTLED - still);
                return;
            }
            self.asked.at_rest = true;
            self.solving = Some((request.serial, solved));
            self.full.ask(Request { moving: false, ..request });
        }
    }

    /// Chooses the exposure from the picture that is shown.
    pub fn expose(&mut self) {
        if let Some(stops) = self.shown.as_ref().and_then(|s| tone::stops_for(&s.film)) {
            self.state.stops = stops;
        }
    }

    /// One frame of the window.
    fn frame(&mut self, ui: &mut egui::Ui) {
        self.take_dropped();
        self.take_answers();
        self.keys();
        self.play();
        let now = Instant::now();
        self.pictures.retain(|at| now - *at < Duration::from_secs(1));
        panel::timeline(self, ui);
        if self.open[0] {
            panel::side(self, ui);
        }
        let frame = egui::Frame::new().fill(egui::Color32::from_gray(8));
        egui::CentralPanel::default().frame(frame).show(ui, |ui| self.picture(ui));
        let sharp = |s: &Shown| s.serial == self.asked.serial && s.passes[0] > 0;
        let complete = self.shown.as_ref().is_some_and(|s| self.is_playing() || sharp(s));
        if let Some(shot) = &mut self.shot {
            shot.advance(&self.ctx, complete || self.message.as_ref().is_some_and(|m| m.bad));
        }
    }

    /// The picture, in what the panels leave.
    fn picture(&mut self, ui: &mut egui::Ui) {
        let all = ui.available_rect_before_wrap();
        let scale = self.ctx.pixels_per_point();
        let whole = |points: f32| ((points * scale).round() as u32).clamp(1, 16_384);
        if self.state.fills_window {
            (self.state.scene.width, self.state.scene.height) = (whole(all.width()), whole(all.height()));
        }
        let shape = Vec2::new(self.state.scene.width as f32, self.state.scene.height as f32);
        let fit = (all.width() / shape.x).min(all.height() / shape.y);
        let rect = Rect::from_center_size(all.center(), shape * fit);
        let response = ui.allocate_rect(all, egui::Sense::click_and_drag());
        self.mouse(&response, rect);
        self.ask([whole(rect.width()), whole(rect.height())]);
        if let Some(shown) = &mut self.shown {
            if shown.stops != self.state.stops {
                shown.stops = self.state.stops;
                shown.texture.set(image(&shown.film, shown.stops), TextureOptions::LINEAR);
            }
            let uv = Rect::from_min_max(egui::pos2(0.0, 0.0), egui::pos2(1.0, 1.0));
            ui.painter().image(shown.texture.id(), rect, uv, egui::Color32::WHITE);
        } else {
            let font = egui::FontId::proportional(18.0);
            ui.painter().text(rect.center(), egui::Align2::CENTER_CENTER, "...", font, egui::Color32::GRAY);
        }
        panel::over_picture(self, ui, rect);
    }
}

impl eframe::App for App {
    fn ui(&mut self, ui: &mut egui::Ui, _: &mut eframe::Frame) {
        self.frame(ui);
    }

    fn on_exit(&mut self) {
        // What was asked to be saved is saved.
        match self.saving.take().map(|saving| saving.recv()) {
            Some(Ok(Ok(path))) => eprintln!("smoke-bake: {}", said_of(&path)),
            Some(Ok(Err(failure))) => eprintln!("smoke-bake: {}", one_line(failure)),
            Some(Err(_)) | None => {}
        }
    }
}

fn said_of(path: &Path) -> String {
    format!("saved {}, with its .exr and .png", path.display())
}

fn image(film: &Film, stops: f64) -> ColorImage {
    ColorImage::from_rgb([film.width, film.height], &tone::bytes(film, stops))
}

fn one_line(failure: Failure) -> String {
    match failure {
        Failure::Work(message) => message,
        Failure::Usage(e) => e.to_string(),
    }
}

#[cfg(test)]
#[path = "app_tests.rs"]
mod tests;
