//! What stands round the picture: the panel beside it, the timeline below it, and what is written over it.

use super::app::App;
use super::painter;
use super::state::{QUALITIES, Sun, sky_name};
use crate::cli::MethodChoice;
use eframe::egui::{
    self, Align, Align2, Color32, ComboBox, Context, DragValue, FontId, Grid, Layout, Rect, RichText, ScrollArea,
    Slider, TextStyle, Ui,
};
use smoke_formats::scene::UpAxis;

/// Width of the panel, points.
const WIDTH: f32 = 316.0;
/// Width of a slider's rail, points.
const RAIL: f32 = 118.0;

/// What the keys and the mouse do.
const KEYS: [(&str, &str); 14] = [
    ("drag", "turn the camera"),
    ("Shift or right drag", "move the camera sideways"),
    ("wheel", "nearer, farther"),
    ("Ctrl or L drag", "turn all lights"),
    ("double click, F", "see the whole sequence"),
    ("Space", "play, stop"),
    ("Left, Right", "a frame back, on"),
    ("Home, End", "first frame, last frame"),
    ("[  ]", "exposure, a third of a stop"),
    ("E", "exposure from the picture"),
    ("S", "save scene, EXR and PNG"),
    ("H", "hide the panel"),
    ("F1", "this list"),
    ("Q", "close"),
];

/// Dark, and large enough to be read.
pub fn style(ctx: &Context) {
    ctx.set_theme(egui::Theme::Dark);
    ctx.all_styles_mut(|style| {
        for (text, size) in [(TextStyle::Body, 14.0), (TextStyle::Button, 14.0), (TextStyle::Small, 12.0)] {
            style.text_styles.insert(text, FontId::proportional(size));
        }
        style.text_styles.insert(TextStyle::Heading, FontId::proportional(15.0));
        style.spacing.slider_width = RAIL;
        style.spacing.item_spacing = egui::vec2(8.0, 3.0);
        style.visuals.panel_fill = Color32::from_gray(27);
        style.visuals.override_text_color = Some(Color32::from_gray(225));
    });
}

/// The panel beside the picture.
pub fn side(app: &mut App, ui: &mut Ui) {
    egui::Panel::right("panel").exact_size(WIDTH).resizable(false).show(ui, |ui| {
        ScrollArea::vertical().auto_shrink([false, false]).show(ui, |ui| {
            ui.add_space(4.0);
            section(ui, "Light", |ui| light(app, ui));
            section(ui, "Medium", |ui| medium(app, ui));
            section(ui, "Picture", |ui| picture(app, ui));
            section(ui, "Camera", |ui| camera(app, ui));
            section(ui, "Time", |ui| time(app, ui));
        });
    });
}

fn section(ui: &mut Ui, title: &str, contents: impl FnOnce(&mut Ui)) {
    ui.label(RichText::new(title).heading().strong().color(Color32::from_rgb(150, 190, 230)));
    Grid::new(title).num_columns(2).min_col_width(84.0).show(ui, contents);
    ui.add_space(7.0);
}

/// A row of a section: its name, and what stands beside it.
fn row(ui: &mut Ui, name: impl Into<egui::WidgetText>, contents: impl FnOnce(&mut Ui)) {
    ui.label(name);
    ui.horizontal(contents);
    ui.end_row();
}

fn light(app: &mut App, ui: &mut Ui) {
    let state = &mut app.state;
    let now = state.environment().map(|(sky, ..)| sky.clone());
    let mut pick = None;
    row(ui, "Sky", |ui| {
        let at = now.as_ref().and_then(|sky| state.skies.iter().position(|c| c.sky == *sky));
        let text = at.map(|at| state.skies[at].name.clone()).or_else(|| now.as_ref().map(sky_name));
        let text = text.unwrap_or_else(|| "none".into());
        ComboBox::from_id_salt("sky").width(RAIL + 62.0).truncate().selected_text(text).show_ui(ui, |ui| {
            for (i, choice) in state.skies.iter().enumerate() {
                if ui.selectable_label(at == Some(i), &choice.name).clicked() {
                    pick = Some(Some(i));
                }
            }
            if ui.selectable_label(now.is_none(), "none").clicked() {
                pick = Some(None);
            }
        });
    });
    if let Some(choice) = pick {
        state.pick(choice);
    }
    if let Some((_, rotation, intensity, visible)) = state.environment() {
        row(ui, "Rotation", |ui| {
            ui.add(slider(rotation, 0.0..=360.0).suffix("°").fixed_decimals(1));
        });
        row(ui, "Intensity", |ui| {
            ui.add(logarithmic(intensity, 1e-3, 1e3));
        });
        row(ui, "Visible", |ui| {
            ui.checkbox(visible, "behind the smoke");
        });
    }
    let before = state.sun();
    let mut on = before.is_some();
    row(ui, "Sun", |ui| {
        ui.checkbox(&mut on, "");
    });
    if on != before.is_some() {
        state.set_sun(on.then_some(Sun { azimuth: 0.0, elevation: 0.0, strength: 0.0 }));
    } else if let Some(mut sun) = before {
        row(ui, "Azimuth", |ui| {
            ui.add(slider(&mut sun.azimuth, -180.0..=180.0).suffix("°").fixed_decimals(1));
        });
        row(ui, "Elevation", |ui| {
            ui.add(slider(&mut sun.elevation, -90.0..=90.0).suffix("°").fixed_decimals(1));
        });
        row(ui, "Strength", |ui| {
            ui.add(logarithmic(&mut sun.strength, 1e-3, 1e4));
        });
        state.set_sun(Some(sun));
    }
}

/// A slider that leaves a value outside its range as it is, until the user moves it.
fn slider(value: &mut f64, range: std::ops::RangeInclusive<f64>) -> Slider<'_> {
    Slider::new(value, range).clamping(egui::SliderClamping::Edits)
}

/// The same over orders of magnitude, and zero.
fn logarithmic(value: &mut f64, low: f64, high: f64) -> Slider<'_> {
    slider(value, 0.0..=high).logarithmic(true).smallest_positive(low).max_decimals(4)
}

fn medium(app: &mut App, ui: &mut Ui) {
    let state = &mut app.state;
    if state.method == MethodChoice::Transfer {
        row(ui, "", |ui| {
            ui.label(RichText::new("as it was baked").small().weak());
        });
    }
    let free = state.method != MethodChoice::Transfer;
    row(ui, "sigma_t", |ui| {
        let mut largest = state.sigma_t();
        ui.add_enabled(free, logarithmic(&mut largest, 1e-3, 1e3));
        state.set_sigma_t(largest);
    });
    let medium = &mut state.scene.medium;
    row(ui, "albedo", |ui| {
        for (channel, letter) in medium.albedo.iter_mut().zip(["R ", "G ", "B "]) {
            let value = DragValue::new(channel).range(0.0..=1.0).speed(0.002).max_decimals(3).prefix(letter);
            ui.add_enabled(free, value);
        }
    });
    row(ui, "g", |ui| {
        ui.add_enabled(free, slider(&mut medium.g, -0.95..=0.95).max_decimals(3));
    });
}

fn picture(app: &mut App, ui: &mut Ui) {
    let has_transfer = app.pack.transfer().is_some_and(|t| !t.frames.is_empty());
    row(ui, "Method", |ui| {
        let name = |method| match method {
            MethodChoice::Transfer => "transfer: baked light",
            MethodChoice::Reference => "reference: path tracing",
            MethodChoice::Auto | MethodChoice::Compensated => "compensated: fast",
        };
        let now = app.state.method;
        ComboBox::from_id_salt("method").width(RAIL + 62.0).selected_text(name(now)).show_ui(ui, |ui| {
            ui.selectable_value(&mut app.state.method, MethodChoice::Compensated, name(MethodChoice::Compensated));
            ui.add_enabled_ui(has_transfer, |ui| {
                ui.selectable_value(&mut app.state.method, MethodChoice::Transfer, name(MethodChoice::Transfer))
                    .on_disabled_hover_text("this pack has no transfer; bake it with --transfer");
            });
            ui.selectable_value(&mut app.state.method, MethodChoice::Reference, name(MethodChoice::Reference));
        });
    });
    row(ui, "Quality", |ui| {
        let free = app.state.method != MethodChoice::Transfer;
        ui.add_enabled_ui(free, |ui| {
            let now = QUALITIES[app.state.quality].0;
            ComboBox::from_id_salt("quality").width(RAIL + 62.0).selected_text(now).show_ui(ui, |ui| {
                for (i, (name, _)) in QUALITIES.iter().enumerate() {
                    ui.selectable_value(&mut app.state.quality, i, *name);
                }
            });
        });
    });
    row(ui, "Exposure", |ui| {
        ui.add(DragValue::new(&mut app.state.stops).speed(0.02).range(-60.0..=60.0).fixed_decimals(2).suffix(" stops"));
        if ui.button("fit").on_hover_text("from the picture (E)").clicked() {
            app.expose();
        }
    });
    row(ui, "", |ui| {
        if ui.button("save scene, EXR, PNG").on_hover_text("S").clicked() {
            app.save();
        }
    });
}

fn camera(app: &mut App, ui: &mut Ui) {
    row(ui, "View angle", |ui| {
        ui.add(slider(&mut app.state.scene.camera.fov_degrees, 2.0..=120.0).suffix("°").fixed_decimals(1));
    });
    row(ui, "Up", |ui| {
        for (axis, name) in [(UpAxis::Y, "y"), (UpAxis::Z, "z")] {
            if ui.selectable_label(app.state.scene.up == axis, name).clicked() {
                app.state.set_up(axis);
            }
        }
        if ui.button("see all").on_hover_text("F").clicked() {
            app.state.frame_all();
        }
    });
    row(ui, "Picture", |ui| {
        let scene = &app.state.scene;
        ui.label(format!("{} x {}", scene.width, scene.height));
        ui.checkbox(&mut app.state.fills_window, "as the window");
    });
}

fn time(app: &mut App, ui: &mut Ui) {
    let text = |ui: &mut Ui, text: String| {
        ui.label(RichText::new(text).small());
    };
    let device = painter::name_of(&app.device);
    row(ui, "Renders on", |ui| text(ui, device));
    row(ui, "Window on", |ui| {
        let name = app.screen.split(" (").next().unwrap_or_default().to_owned();
        ui.add(egui::Label::new(RichText::new(name).small()).truncate()).on_hover_text(&app.screen);
    });
    let Some(shown) = &app.shown else { return };
    let [passes, of] = shown.passes;
    let progress = match passes {
        0 if app.is_at_rest() => "a sketch; full quality is in work".to_owned(),
        0 => "moving".to_owned(),
        _ => format!("pass {passes} of {of}"),
    };
    row(ui, "Picture", |ui| text(ui, progress));
    for (name, seconds) in &shown.stages.wall {
        row(ui, RichText::new(*name).small(), |ui| text(ui, format!("{:.1} ms", seconds * 1e3)));
    }
    for (name, microseconds) in &shown.stages.device {
        let name = RichText::new(format!("on the device: {name}")).small();
        row(ui, name, |ui| text(ui, format!("{microseconds:.0} us")));
    }
    row(ui, "Pictures", |ui| text(ui, format!("{} a second", app.rate())));
    let (decoded, kept) = app.playback.fill();
    let waits = app.waits;
    row(ui, "Decoded", |ui| text(ui, format!("{decoded} of {kept} frames, {waits} waited for")));
    if app.device.is_graphics() {
        let ready = app.playback.ready();
        row(ui, "Uploaded", |ui| text(ui, format!("{ready} of them")));
    }
}

/// What a button of the timeline shows; the fonts have no such signs.
#[derive(Clone, Copy)]
enum Icon {
    First,
    Play,
    Stop,
    Last,
}

/// A button with an icon.
fn icon(ui: &mut Ui, icon: Icon) -> egui::Response {
    let (rect, response) = ui.allocate_exact_size(egui::vec2(32.0, 24.0), egui::Sense::click());
    let look = ui.style().interact(&response);
    let (painter, colour, c) = (ui.painter(), look.fg_stroke.color, rect.center());
    painter.rect_filled(rect, look.corner_radius, look.weak_bg_fill);
    let bar = |x: f32| {
        painter.rect_filled(Rect::from_center_size(c + egui::vec2(x, 0.0), egui::vec2(3.0, 12.0)), 0.0, colour);
    };
    let arrow = |tip: f32, base: f32| {
        let points = vec![c + egui::vec2(tip, 0.0), c + egui::vec2(base, 6.0), c + egui::vec2(base, -6.0)];
        painter.add(egui::Shape::convex_polygon(points, colour, egui::Stroke::NONE));
    };
    match icon {
        Icon::First => {
            bar(-5.0);
            arrow(-3.0, 6.0);
        }
        Icon::Play => arrow(6.0, -4.0),
        Icon::Stop => [-3.5, 3.5].into_iter().for_each(bar),
        Icon::Last => {
            arrow(3.0, -6.0);
            bar(5.0);
        }
    }
    response
}

/// The timeline below the picture.
pub fn timeline(app: &mut App, ui: &mut Ui) {
    egui::Panel::bottom("timeline").exact_size(40.0).resizable(false).show(ui, |ui| {
        ui.horizontal_centered(|ui| {
            let count = app.playback.count();
            if icon(ui, Icon::First).on_hover_text("first frame (Home)").clicked() {
                app.step(-(app.state.position as isize));
            }
            let play = if app.is_playing() { Icon::Stop } else { Icon::Play };
            if icon(ui, play).on_hover_text("play, stop (Space)").clicked() {
                app.toggle_play();
            }
            if icon(ui, Icon::Last).on_hover_text("last frame (End)").clicked() {
                app.step(-1 - app.state.position as isize);
            }
            let number = app.pack.frames().get(app.state.position).map_or(0, |f| f.frame);
            let label = format!("frame {number}  ({} of {count})", app.state.position + 1);
            ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
                let fps = DragValue::new(&mut app.fps).range(1.0..=240.0).speed(0.1).max_decimals(3);
                ui.add(fps.suffix(" fps"));
                ui.label(label);
                ui.spacing_mut().slider_width = ui.available_width() - 8.0;
                let mut position = app.state.position;
                let last = count.saturating_sub(1);
                if ui.add(Slider::new(&mut position, 0..=last).show_value(false)).changed() {
                    app.step(position as isize - app.state.position as isize);
                }
            });
        });
    });
}

/// What is written over the picture: a message, the keys, and where to find them.
pub fn over_picture(app: &mut App, ui: &mut Ui, rect: Rect) {
    let painter = ui.painter();
    let write = |at, align: Align2, text: &str, size: f32, colour: Color32| {
        let width = (rect.width() - 24.0).max(40.0);
        let mut job = egui::text::LayoutJob::simple(text.to_owned(), FontId::proportional(size), colour, width);
        job.halign = Align::LEFT;
        let text = painter.layout_job(job);
        let place = align.anchor_size(at, text.size());
        painter.rect_filled(place.expand(6.0), 4.0, Color32::from_black_alpha(200));
        painter.galley(place.min, text, colour);
    };
    if let Some(message) = &app.message {
        let colour = if message.bad { Color32::from_rgb(255, 140, 120) } else { Color32::from_gray(220) };
        write(rect.left_top() + egui::vec2(12.0, 12.0), Align2::LEFT_TOP, &message.text, 14.0, colour);
    }
    if app.open[1] {
        let widest = KEYS.iter().map(|k| k.0.len()).max().unwrap_or(0);
        let lines: Vec<String> = KEYS.iter().map(|(key, what)| format!("{key:widest$}  {what}")).collect();
        let font = FontId::monospace(14.0);
        let text = painter.layout_no_wrap(lines.join("\n"), font, Color32::from_gray(230));
        let place = Align2::CENTER_CENTER.anchor_size(rect.center(), text.size());
        painter.rect_filled(place.expand(14.0), 6.0, Color32::from_black_alpha(225));
        painter.galley(place.min, text, Color32::from_gray(230));
    } else {
        let at = rect.left_bottom() + egui::vec2(12.0, -12.0);
        write(at, Align2::LEFT_BOTTOM, "F1: keys", 12.0, Color32::from_gray(170));
    }
}
