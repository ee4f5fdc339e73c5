//! Key S: what is seen as a scene file, an OpenEXR image and a PNG.
//!
//! The image is made from the scene file after that was written and read back, by the way that `render` goes: the file's
//! first lines tell the command line that makes the same image.

use super::tone;
use crate::cli::Detail;
use crate::devices::{Device, DeviceFrame};
use crate::failure::Failure;
use crate::method::Method;
use crate::render::{self, Job};
use crate::staging::{SceneChanges, Stage};
use smoke_formats::image::{self, SamplePrecision};
use smoke_formats::pack::Pack;
use smoke_formats::scene::{Light, Scene, Sky};
use smoke_formats::{Error, atomic};
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::reference::ReferenceSettings;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Most pictures of one name in a folder.
const MOST: u32 = 9999;

/// What is to be saved.
pub struct Saving {
    /// The pack.
    pub pack: Arc<Pack>,
    /// The scene, with the size of the image.
    pub scene: Scene,
    /// Which frame, from 0.
    pub position: usize,
    /// How the image is made.
    pub method: Method,
    /// Exposure of the PNG.
    pub stops: f64,
    /// Where to.
    pub folder: PathBuf,
}

impl Saving {
    /// Writes `NAME.view.0001.toml`, `.exr` and `.png`, with the first number that is free; gives the scene file's path.
    pub fn run(&self) -> Result<PathBuf, Failure> {
        std::fs::create_dir_all(&self.folder).map_err(|e| Error::io(&self.folder, e))?;
        let [scene_path, exr, png] = self.free_names()?;
        let number = self.pack.frames()[self.position].frame;
        let scene = rehomed(&self.scene, &self.folder)?;
        let command = self.command(&scene_path, &exr, number);
        let head = command.map_or_else(String::new, |line| format!("# The image beside this file:\n# {line}\n"));
        atomic::write_bytes(&scene_path, (head + &scene.to_toml()).as_bytes())?;

        let stage = Stage::read(&scene_path, &SceneChanges::default())?;
        let mut document = render::document(&self.method, Detail::Full, &stage.scene);
        document["render"]["device"] = Device::Cpu.name().into();
        let (method, precision) = (self.method, SamplePrecision::Half);
        let job = Job { pack: &self.pack, scene: &stage.scene, document, method, detail: Detail::Full, precision };
        let frame = render::read(&self.pack, self.position, &method, Detail::Full)?;
        let mut maker =
            method.maker(&stage, &Device::Cpu).map_err(|e| Failure::work(format!("{}: {e}", scene_path.display())))?;
        let image = job.image(self.position, DeviceFrame::Cpu(Arc::new(frame)), &mut maker, &mut |_| {})?;
        job.write(number, &image, &exr)?;
        image::write_png(&png, &tone::picture(&image.film, self.stops))?;
        Ok(scene_path)
    }

    fn free_names(&self) -> Result<[PathBuf; 3], Failure> {
        let stem = self.pack.path().file_stem().unwrap_or_default();
        let names = |number: u32| {
            ["toml", "exr", "png"].map(|extension| {
                let mut name = stem.to_owned();
                name.push(format!(".view.{number:04}.{extension}"));
                self.folder.join(name)
            })
        };
        let free = (1..=MOST).map(names).find(|names| !names.iter().any(|path| path.exists()));
        free.ok_or_else(|| {
            let expected = format!("fewer than {MOST}; move them, or give another --output");
            Error::invalid(&self.folder, "pictures saved before", MOST, expected).into()
        })
    }

    /// The line that makes the image; none if a name in it would break a line.
    fn command(&self, scene: &Path, exr: &Path, number: i32) -> Option<String> {
        let mut words = vec!["smoke-bake".to_owned(), "render".to_owned(), self.pack.path().to_str()?.to_owned()];
        words.extend(["--scene".into(), scene.to_str()?.into(), "-o".into(), exr.to_str()?.into()]);
        words.push(format!("--frames={number}"));
        words.extend(options(&self.method));
        words.iter().map(|word| quoted(word)).collect::<Option<Vec<_>>>().map(|words| words.join(" "))
    }
}

/// A word as a shell takes it; none for one with control characters.
fn quoted(word: &str) -> Option<String> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./=,:#%+@".contains(c);
    match word {
        word if word.chars().any(char::is_control) => None,
        word if !word.is_empty() && word.chars().all(plain) && !word.starts_with('#') => Some(word.to_owned()),
        word => Some(format!("'{}'", word.replace('\'', "'\\''"))),
    }
}

/// The options of `render` that choose a method and the dials in which it differs from its defaults.
pub fn options(method: &Method) -> Vec<String> {
    let mut words = Vec::new();
    let mut option = |name: &str, value: String| words.push(format!("--{name}={value}"));
    match method {
        Method::Transfer(_) => option("method", "transfer".into()),
        Method::Reference(settings) => {
            option("method", "reference".into());
            if settings.target_error != ReferenceSettings::default().target_error {
                option("target-error", settings.target_error.to_string());
            }
        }
        Method::Compensated(settings) => {
            option("method", "compensated".into());
            let base = RenderSettings::default();
            let mut differs = |name: &str, value: f64, default: f64| {
                if value != default {
                    option(name, value.to_string());
                }
            };
            differs("sh-order", settings.sh_order as f64, base.sh_order as f64);
            if let (Route::Grid(grid), Route::Grid(base)) = (settings.route, base.route) {
                differs("beams", grid.beams as f64, base.beams as f64);
                differs("source-step", grid.single_step as f64, base.single_step as f64);
                differs("scatter-step", grid.multiple_step as f64, base.multiple_step as f64);
                differs("scatter-rings", grid.rings as f64, base.rings as f64);
                differs("scatter-order", grid.multiple_order as f64, base.multiple_order as f64);
            }
            differs("march-step", f64::from(settings.march.step), f64::from(base.march.step));
            differs("samples", settings.march.samples as f64, base.march.samples as f64);
        }
    }
    words
}

/// The scene with paths to images as a scene file in `folder` has them: relative below it, else absolute.
pub fn rehomed(scene: &Scene, folder: &Path) -> Result<Scene, Failure> {
    let home = |path: &Path| std::fs::canonicalize(path).map_err(|e| Error::io(path, e));
    let folder = home(folder)?;
    let mut scene = scene.clone();
    for light in &mut scene.lights {
        if let Light::Environment { sky: Sky::Image { written, resolved }, .. } = light {
            let path = home(resolved)?;
            let relative = path.strip_prefix(&folder).map(Path::to_owned).unwrap_or_else(|_| path.clone());
            if relative.to_str().is_none() {
                let expected = "UTF-8, which a scene file needs; rename it";
                return Err(Error::invalid(&path, "name", "other characters", expected).into());
            }
            (*written, *resolved) = (relative, path);
        }
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::super::state::{QUALITIES, State};
    use super::*;
    use crate::cli::{Cli, Command, MethodChoice};
    use crate::testing::{small_pack, stage};
    use clap::Parser;
    use smoke_formats::image::RgbImage;
    use std::collections::BTreeMap;

    /// A state with an environment image, a sun and edits, its pack in the folder.
    fn edited(folder: &Path) -> (Arc<Pack>, State) {
        let pack = folder.join("it's a.smoke");
        small_pack(&pack, &[7, 8], 0.01);
        std::fs::create_dir(folder.join("maps")).unwrap();
        let sky = folder.join("maps/sky.exr");
        let image = RgbImage { width: 4, height: 2, pixels: vec![[0.5, 1.0, 2.0]; 8] };
        let channel = |name: &str, c: usize| image::Channel {
            name: name.into(),
            values: image.pixels.iter().map(|p| p[c]).collect(),
        };
        let channels = vec![channel("B", 2), channel("G", 1), channel("R", 0)];
        let image = image::FloatImage { width: 4, height: 2, channels };
        image::write_channels(&sky, &image).unwrap();
        let mut scene = stage().scene;
        (scene.camera.position, scene.camera.target) = ([7.0, -6.0, 3.5], [7.0, 1.7, 3.5]);
        let mut state = State::new(scene, false, 1, MethodChoice::Auto, Vec::new(), Vec::new());
        let at = state.offer(super::super::state::sky_at(&sky).unwrap());
        state.pick(Some(at));
        state.set_sun(Some(super::super::state::Sun { azimuth: 30.0, elevation: 20.0, strength: 2.0 }));
        state.turn_lights(33.3);
        state.set_sigma_t(3.7);
        (Arc::new(Pack::open(&pack).unwrap()), state)
    }

    fn saving(pack: &Arc<Pack>, state: &State, folder: &Path) -> Saving {
        let State { scene, position, stops, .. } = state.clone();
        Saving { pack: pack.clone(), scene, position, method: state.method(), stops, folder: folder.to_owned() }
    }

    #[test]
    fn a_saved_scene_renders_to_the_bytes_that_were_saved_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let (pack, state) = edited(folder.path());
        let out = folder.path().join("out");
        for save in 1..=2 {
            let scene = saving(&pack, &state, &out).run().unwrap();
            assert!(scene.ends_with(format!("it's a.view.{save:04}.toml")), "{scene:?}");
            let saved = std::fs::read(scene.with_extension("exr")).unwrap();
            assert!(scene.with_extension("png").exists());
            let stage = Stage::read(&scene, &SceneChanges::default()).unwrap();
            assert_eq!(stage.medium.sigma_t, state.scene.medium.sigma_t.map(|v| v as f32));
            assert_eq!(stage.scene.camera, state.scene.camera);
            let text = std::fs::read_to_string(&scene).unwrap();
            let line = text.lines().nth(1).unwrap().strip_prefix("# ").unwrap().replace("'\\''", "\u{1}");
            // The shell's part, for names that have only this quote and spaces.
            let parts = line.split('\'').enumerate().flat_map(|(i, part)| match i % 2 {
                0 => part.split_whitespace().map(str::to_owned).collect(),
                _ => vec![part.replace('\u{1}', "'")],
            });
            let mut words: Vec<String> = parts.collect();
            let again = folder.path().join("again.exr");
            let at = words.iter().position(|w| w == "-o").unwrap() + 1;
            words[at] = again.to_str().unwrap().to_owned();
            words.extend(["--progress".to_owned(), "none".to_owned()]);
            crate::dispatch(Cli::try_parse_from(&words).unwrap().command).unwrap();
            assert!(std::fs::read(&again).unwrap() == saved, "{words:?}");
        }
    }

    #[test]
    fn the_options_of_every_method_and_quality_choose_the_same_settings() {
        let folder = tempfile::tempdir().unwrap();
        let (_, mut state) = edited(folder.path());
        let mut seen = BTreeMap::new();
        for method in [MethodChoice::Compensated, MethodChoice::Transfer, MethodChoice::Reference] {
            for quality in 0..QUALITIES.len() {
                (state.method, state.quality) = (method, quality);
                let options = options(&state.method());
                let line = ["smoke-bake", "render", "a.smoke", "--scene", "s.toml", "-o", "o.exr"].map(str::to_owned);
                let line: Vec<String> = line.into_iter().chain(options.clone()).collect();
                let Command::Render(args) = Cli::try_parse_from(&line).unwrap().command else { panic!("{line:?}") };
                assert_eq!(Method::choose(&args, &stage()).unwrap(), state.method(), "{line:?}");
                seen.insert(options, ());
            }
        }
        assert_eq!(seen.len(), 11, "transfer has one quality");
    }

    #[test]
    fn images_below_the_folder_are_named_from_it_and_others_by_their_whole_path() {
        let folder = tempfile::tempdir().unwrap();
        let (_, state) = edited(folder.path());
        let written = |home: &Path| {
            let scene = rehomed(&state.scene, home).unwrap();
            let skies = scene.lights.into_iter().filter_map(|light| match light {
                Light::Environment { sky: Sky::Image { written, .. }, .. } => Some(written),
                _ => None,
            });
            skies.collect::<Vec<_>>()
        };
        assert_eq!(written(folder.path()), [Path::new("maps/sky.exr")]);
        let elsewhere = tempfile::tempdir().unwrap();
        assert!(written(elsewhere.path())[0].is_absolute());
    }

    #[test]
    fn words_are_quoted_for_a_shell_and_control_characters_are_refused() {
        assert_eq!(quoted("a-b_c.####.exr").as_deref(), Some("a-b_c.####.exr"));
        assert_eq!(quoted("it's $HOME").as_deref(), Some("'it'\\''s $HOME'"));
        assert_eq!((quoted("").as_deref(), quoted("#").as_deref(), quoted("a\nb")), (Some("''"), Some("'#'"), None));
    }
}
