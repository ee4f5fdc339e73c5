//! The window without a display: frames of egui with a mouse, keys and files that are made up.

use super::*;
use crate::testing::small_pack;
use eframe::egui::{DroppedFile, Event, Key, Modifiers, PointerButton, Pos2, RawInput, pos2};
use smoke_formats::scene::Sky;

const SIZE: [u32; 2] = [900, 500];

/// A window on a small pack.
struct Window {
    app: App,
    folder: tempfile::TempDir,
}

impl Window {
    /// Of frames from 1 to `frames`, with the scene file `scene` if it is not empty.
    fn open(frames: i32, scene: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let pack = folder.path().join("a.smoke");
        small_pack(&pack, &(1..=frames).collect::<Vec<_>>(), 0.01);
        let path = folder.path().join("scene.toml");
        std::fs::write(&path, scene).unwrap();
        let args = ViewArgs {
            pack,
            scene: (!scene.is_empty()).then_some(path),
            frame: Some(1),
            width: SIZE[0],
            height: SIZE[1],
            method: MethodChoice::Auto,
            device: "cpu".into(),
            output: Some(folder.path().join("saved")),
            screenshot: None,
            seconds: 1.0,
        };
        let skies = Skies::default();
        let opened = Opening::of(&args).open(&skies).unwrap();
        let app = App::new(Context::default(), String::new(), &args, Device::Cpu, opened, skies, None);
        Self { app, folder }
    }

    /// One frame, with what happened.
    fn frame(&mut self, input: RawInput) {
        let screen = Rect::from_min_size(Pos2::ZERO, Vec2::new(SIZE[0] as f32, SIZE[1] as f32));
        let input = RawInput { screen_rect: Some(screen), ..input };
        let output = self.app.ctx.clone().run_ui(input, |ui| self.app.frame(ui));
        assert!(output.shapes.len() > 10, "timeline and picture are drawn");
    }

    fn events(&mut self, events: Vec<Event>) {
        self.frame(RawInput { events, ..RawInput::default() });
    }

    fn press(&mut self, key: Key) {
        let event =
            |pressed| Event::Key { key, physical_key: None, pressed, repeat: false, modifiers: Modifiers::NONE };
        self.events(vec![event(true), event(false)]);
    }

    /// Drags by `by` points on the picture.
    fn drag(&mut self, button: PointerButton, by: Vec2) {
        let at = pos2(200.0, 200.0);
        let click = |pos, pressed| Event::PointerButton { pos, button, pressed, modifiers: Modifiers::NONE };
        self.events(vec![Event::PointerMoved(at)]);
        self.events(vec![click(at, true)]);
        self.events(vec![Event::PointerMoved(at + 0.5 * by)]);
        self.events(vec![Event::PointerMoved(at + by)]);
        self.events(vec![click(at + by, false)]);
    }

    /// Frames until `done`.
    fn until(&mut self, what: &str, done: impl Fn(&App) -> bool) {
        let start = Instant::now();
        while !done(&self.app) {
            assert!(start.elapsed() < Duration::from_secs(60), "{what}");
            std::thread::sleep(Duration::from_millis(4));
            self.events(Vec::new());
        }
    }
}

fn is_sharp(app: &App) -> bool {
    app.shown.as_ref().is_some_and(|s| s.serial == app.asked.serial && s.passes[0] > 0)
}

#[derive(Debug)]
struct File(PathBuf);

impl DroppedFile for File {
    fn path(&self) -> &Path {
        &self.0
    }

    fn bytes(&self) -> Result<Vec<u8>, String> {
        std::fs::read(&self.0).map_err(|e| e.to_string())
    }
}

#[test]
fn a_picture_comes_is_sharp_and_fills_what_the_panels_leave() {
    let mut window = Window::open(2, "");
    window.until("a sharp picture", is_sharp);
    let shown = window.app.shown.as_ref().unwrap();
    let State { scene, stops, .. } = &window.app.state;
    assert_eq!((shown.film.width as u32, shown.film.height as u32), (scene.width, scene.height));
    assert!(scene.width > 500 && scene.width < SIZE[0] && scene.height > 400 && scene.height < SIZE[1], "{scene:?}");
    assert!(shown.film.pixels.iter().any(|p| p.alpha() > 0.5), "smoke is seen");
    assert!(*stops != 0.0 && shown.stops == *stops, "exposure was chosen");
    let (serial, film) = (shown.serial, shown.film.clone());
    window.press(Key::CloseBracket);
    let shown = window.app.shown.as_ref().unwrap();
    assert!(shown.serial == serial && shown.film.pixels == film.pixels, "exposure renders nothing");
}

#[test]
fn a_scene_that_is_only_looked_at_keeps_every_value() {
    let scene = "world.up = \"y\"\n[camera]\nposition = [7.1234567, 3.5, 9.0]\ntarget = [7, 1.7, 3.5]\n\
                 up = [0.1, 1, 0]\nfov = 150.123456\n[image]\nwidth = 37\nheight = 23\n[medium]\n\
                 sigma_t = [2345.678, 0, 1e-7]\nalbedo = [0.123456, 1, 0]\ng = 0.987654\n[[light]]\n\
                 kind = \"environment\"\ncolor = [1, 2, 3]\nrotation = -1234.5678\nintensity = 1e-9\n[[light]]\n\
                 kind = \"directional\"\ndirection = [1, -2, 3e-5]\nirradiance = [1e6, 2, 0]\n";
    let mut window = Window::open(2, scene);
    let before = window.app.state.scene.clone();
    window.until("a sharp picture", is_sharp);
    assert_eq!(window.app.state.scene, before);
    assert!(window.app.message.is_none());
}

#[test]
fn mouse_and_keys_turn_move_and_play() {
    let mut window = Window::open(5, "");
    window.until("a sharp picture", is_sharp);
    let camera = window.app.state.scene.camera.clone();
    window.drag(PointerButton::Primary, Vec2::new(60.0, 20.0));
    let turned = window.app.state.scene.camera.clone();
    assert!(turned.position != camera.position && turned.target == camera.target, "{turned:?}");
    window.drag(PointerButton::Secondary, Vec2::new(60.0, 20.0));
    assert!(window.app.state.scene.camera.target != camera.target);
    window.press(Key::F);
    assert_eq!(window.app.state.scene.camera, camera, "the first view again");
    for (key, position) in
        [(Key::ArrowRight, 1), (Key::End, 4), (Key::ArrowRight, 0), (Key::ArrowLeft, 4), (Key::Home, 0)]
    {
        window.press(key);
        assert_eq!(window.app.state.position, position, "{key:?}");
    }
    window.press(Key::H);
    window.press(Key::F1);
    assert_eq!(window.app.open, [false, true]);
    window.press(Key::H);
    window.until("a sharp picture of the first frame", is_sharp);
}

#[test]
fn playback_shows_all_64_frames_and_waits_for_none_once_they_are_decoded() {
    let mut window = Window::open(64, "");
    window.until("all frames", |app| app.playback.fill() == (64, 64));
    window.app.fps = 50.0;
    window.press(Key::Space);
    let start = Instant::now();
    let mut seen = [false; 64];
    while !seen.iter().all(|s| *s) {
        assert!(start.elapsed() < Duration::from_secs(60), "{seen:?}");
        window.events(Vec::new());
        seen[window.app.state.position] = true;
    }
    assert_eq!(window.app.waits, 0);
    window.press(Key::Space);
    assert!(!window.app.is_playing());
    window.until("a sharp picture", is_sharp);
}

#[test]
fn dropped_files_open_and_others_are_refused_in_words() {
    let mut window = Window::open(2, "");
    window.until("a sharp picture", is_sharp);
    let drop = |window: &mut Window, name: &str| {
        let file: Arc<dyn DroppedFile + Send + Sync> = Arc::new(File(window.folder.path().join(name)));
        window.frame(RawInput { dropped_files: vec![file], ..RawInput::default() });
    };
    drop(&mut window, "a.vdb");
    assert!(window.app.message.as_ref().is_some_and(|m| m.bad && m.text.contains("bake it first")));
    drop(&mut window, "none.exr");
    let sky = window.app.state.environment().map(|(sky, ..)| sky.clone());
    assert!(matches!(sky, Some(Sky::Image { resolved, .. }) if resolved.ends_with("none.exr")));
    window.until("the reason", |app| app.message.as_ref().is_some_and(|m| m.bad && m.text.contains("none.exr: ")));
    let mut scene = window.app.state.scene.clone();
    scene.lights.remove(0);
    (scene.width, scene.height) = (44, 33);
    std::fs::write(window.folder.path().join("other.toml"), scene.to_toml()).unwrap();
    drop(&mut window, "other.toml");
    window.until("the other scene", |app| app.state.scene.width == 44 && is_sharp(app));
    assert_eq!(window.app.state.scene, scene);
    small_pack(&window.folder.path().join("b.smoke"), &[7], 0.01);
    drop(&mut window, "b.smoke");
    window.until("the other pack", |app| app.pack.path().ends_with("b.smoke") && is_sharp(app));
}

#[test]
fn key_s_saves_and_an_edit_of_the_light_is_seen_in_the_next_picture() {
    let mut window = Window::open(2, "");
    window.until("a sharp picture", is_sharp);
    let before = window.app.shown.as_ref().unwrap().film.clone();
    window.press(Key::S);
    window.until("the file", |app| app.message.as_ref().is_some_and(|m| !m.bad && m.text.starts_with("saved ")));
    for extension in ["toml", "exr", "png"] {
        assert!(window.folder.path().join("saved/a.view.0001").with_extension(format!("0001.{extension}")).exists());
    }
    window.app.state.turn_lights(120.0);
    window.until("another picture", is_sharp);
    assert!(window.app.shown.as_ref().unwrap().film.pixels != before.pixels);
    window.app.state.method = MethodChoice::Reference;
    window.until("a traced picture", |app| {
        is_sharp(app) && app.shown.as_ref().is_some_and(|s| s.stages.wall[0].0 == "trace")
    });
    window.app.state.method = MethodChoice::Transfer;
    window.until("why not", |app| app.message.as_ref().is_some_and(|m| m.bad));
}
