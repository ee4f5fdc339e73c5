//! What the user does with files, keys and mouse.

use super::app::App;
use super::opening::{Dropped, Opening};
use super::orbit;
use super::state::{State, sky_at};
use eframe::egui::{self, Key, Rect, Vec2};

/// Degrees that a drag across the picture's width turns.
const TURN: f64 = 270.0;

impl App {
    /// Files that were dropped onto the window.
    pub fn take_dropped(&mut self) {
        for file in self.ctx.input(|i| i.raw.dropped_files.clone()) {
            let path = file.path().to_owned();
            let (pack, scene) = match Dropped::of(&path) {
                Dropped::Pack => (path, None),
                Dropped::Scene => (self.pack.path().to_owned(), Some(path)),
                Dropped::Sky => {
                    match sky_at(&path) {
                        Some(choice) => {
                            let at = self.state.offer(choice);
                            self.state.pick(Some(at));
                        }
                        None => self.say("the image's name is not UTF-8, which a scene file needs; rename it", true),
                    }
                    continue;
                }
                Dropped::Other(message) => {
                    self.say(message, true);
                    continue;
                }
            };
            let size = [self.state.scene.width, self.state.scene.height];
            let opening = Opening { pack, scene, frame: None, method: self.method, size };
            let skies = self.skies.clone();
            self.say("opening ...", false);
            self.opening = Some(self.on_a_thread(move || opening.open(&skies)));
        }
    }

    /// What was typed.
    pub fn keys(&mut self) {
        if self.ctx.egui_wants_keyboard_input() {
            return;
        }
        let ctx = self.ctx.clone();
        let pressed = |key: Key| ctx.input(|i| i.key_pressed(key) && !i.modifiers.command);
        if pressed(Key::Space) {
            self.toggle_play();
        }
        if pressed(Key::ArrowLeft) {
            self.step(-1);
        }
        if pressed(Key::ArrowRight) {
            self.step(1);
        }
        if pressed(Key::Home) {
            self.step(-(self.state.position as isize));
        }
        if pressed(Key::End) {
            self.step(-1 - self.state.position as isize);
        }
        if pressed(Key::S) {
            self.save();
        }
        if pressed(Key::F) {
            self.state.frame_all();
        }
        if pressed(Key::E) {
            self.expose();
        }
        let stops = f64::from(i8::from(pressed(Key::CloseBracket)) - i8::from(pressed(Key::OpenBracket)));
        self.state.stops += stops / 3.0;
        if pressed(Key::H) {
            self.open[0] = !self.open[0];
        }
        if pressed(Key::F1) {
            self.open[1] = !self.open[1];
        }
        if pressed(Key::Q) || ctx.input(|i| i.modifiers.command && i.key_pressed(Key::Q)) {
            ctx.send_viewport_cmd(egui::ViewportCommand::Close);
        }
        if pressed(Key::Escape) {
            (self.message, self.open[1]) = (None, false);
        }
    }

    /// The mouse on the picture, whose rectangle is `rect`.
    pub fn mouse(&mut self, response: &egui::Response, rect: Rect) {
        let (lights, pan) = self.ctx.input(|i| {
            let shift = i.modifiers.shift || i.pointer.secondary_down() || i.pointer.middle_down();
            (i.key_down(Key::L) || i.modifiers.ctrl, shift)
        });
        let moved = response.drag_delta() / rect.width().max(1.0);
        let (x, y) = (f64::from(moved.x), f64::from(moved.y));
        let State { scene, .. } = &mut self.state;
        if moved != Vec2::ZERO {
            if lights {
                self.state.turn_lights(x * TURN);
            } else if pan {
                orbit::pan(&mut scene.camera, x, y);
            } else {
                orbit::turn(&mut scene.camera, scene.up, -x * TURN, y * TURN);
            }
        }
        if response.hovered() {
            let (scroll, pinch) = self.ctx.input(|i| (i.smooth_scroll_delta().y, i.zoom_delta()));
            let factor = (f64::from(-scroll) * 0.003).exp() / f64::from(pinch.max(0.1));
            if factor != 1.0 {
                orbit::approach(&mut self.state.scene.camera, factor);
            }
        }
        if response.double_clicked() {
            self.state.frame_all();
        }
    }
}
