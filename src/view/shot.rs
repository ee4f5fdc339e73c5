//! `--screenshot`: the picture of the window, when it has been open long enough and shows a picture at full size.

use super::tone;
use crate::failure::Failure;
use eframe::egui::{ColorImage, Context, ViewportCommand};
use smoke_formats::image;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Seconds after which the window is taken as it is.
const LONGEST: Duration = Duration::from_secs(120);
/// Seconds that the window system has to hand the pixels over.
const HANDOVER: Duration = Duration::from_secs(10);

/// How the screenshot ended, for when the window is closed.
pub type Outcome = Arc<Mutex<Option<Result<(), String>>>>;

/// See the module's head.
pub struct Shot {
    path: PathBuf,
    seconds: Duration,
    opened: Instant,
    asked: Option<Instant>,
    pixels: Arc<Mutex<Option<Arc<ColorImage>>>>,
    outcome: Outcome,
}

impl Shot {
    /// A screenshot to `path` after `seconds`.
    pub fn new(path: PathBuf, seconds: f64, outcome: Outcome) -> Self {
        // Longer than a day is a day.
        let seconds = Duration::from_secs_f64(seconds.min(86_400.0));
        Self { path, seconds, opened: Instant::now(), asked: None, pixels: Arc::default(), outcome }
    }

    /// To be called with each frame of the window; `complete` once there is nothing to wait for. Closes the window when
    /// all is done.
    pub fn advance(&mut self, ctx: &Context, complete: bool) {
        ctx.request_repaint_after(Duration::from_millis(30));
        let open = self.opened.elapsed();
        let Some(asked) = self.asked else {
            if open >= self.seconds && (complete || open >= self.seconds + LONGEST) {
                self.asked = Some(Instant::now());
                let (pixels, waker) = (self.pixels.clone(), ctx.clone());
                ctx.request_screenshot(move |image| {
                    *pixels.lock().unwrap_or_else(PoisonError::into_inner) = Some(image);
                    waker.request_repaint();
                });
            }
            return;
        };
        let outcome = match self.pixels.lock().unwrap_or_else(PoisonError::into_inner).take() {
            Some(image) => self.write(&image).map_err(|e| match e {
                Failure::Work(message) => message,
                Failure::Usage(e) => e.to_string(),
            }),
            None if asked.elapsed() > HANDOVER => {
                Err(format!("{}: the window gave no pixels; is its desktop locked?", self.path.display()))
            }
            None => return,
        };
        *self.outcome.lock().unwrap_or_else(PoisonError::into_inner) = Some(outcome);
        ctx.send_viewport_cmd(ViewportCommand::Close);
    }

    fn write(&self, image: &ColorImage) -> Result<(), Failure> {
        let [width, height] = image.size;
        let bytes = image.pixels.iter().map(|p| [p.r(), p.g(), p.b()]);
        Ok(image::write_png(&self.path, &tone::from_bytes(width, height, bytes))?)
    }
}
