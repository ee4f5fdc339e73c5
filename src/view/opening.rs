//! Packs, scenes and dropped files into what the window shows.

use super::framing;
use super::state::{State, is_sky, skies_of_folder};
use super::worker::Skies;
use crate::cli::{MethodChoice, ViewArgs};
use crate::failure::Failure;
use smoke_formats::Error;
use smoke_formats::pack::Pack;
use smoke_formats::scene::{Light, Scene, Sky, UpAxis};
use smoke_runtime::medium::frame::Frame;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What to open.
#[derive(Clone, Debug, PartialEq)]
pub struct Opening {
    /// The pack.
    pub pack: PathBuf,
    /// The scene file, if there is one.
    pub scene: Option<PathBuf>,
    /// Number of the frame to begin with.
    pub frame: Option<i32>,
    /// How pictures are made.
    pub method: MethodChoice,
    /// Size of a scene that has no file, pixels.
    pub size: [u32; 2],
}

/// A pack with the state that it begins with.
pub struct Opened {
    /// The pack.
    pub pack: Arc<Pack>,
    /// The state.
    pub state: State,
}

/// What a dropped file is, by its name.
#[derive(Clone, Debug, PartialEq)]
pub enum Dropped {
    /// A pack.
    Pack,
    /// A scene file.
    Scene,
    /// An environment image.
    Sky,
    /// Something else, and what to do about it.
    Other(String),
}

impl Opening {
    /// What the command line asks for.
    pub fn of(args: &ViewArgs) -> Self {
        let ViewArgs { pack, scene, frame, method, width, height, .. } = args;
        let (pack, scene) = (pack.clone(), scene.clone());
        Self { pack, scene, frame: *frame, method: *method, size: [*width, *height] }
    }

    /// Opens it all; reads the scene's images into `skies`.
    pub fn open(&self, skies: &Skies) -> Result<Opened, Failure> {
        let pack = Pack::open(&self.pack)?;
        if pack.frames().is_empty() {
            return Err(Error::invalid(&self.pack, "frames", "none", "at least 1 to show").into());
        }
        let fullest = framing::fullest(&pack);
        let position = match self.frame {
            None => fullest,
            Some(number) => pack.frames().iter().position(|f| f.frame == number).ok_or_else(|| {
                let expected = match pack.frames() {
                    [first, .., last] => format!("one of its frames, {} to {}", first.frame, last.frame),
                    frames => format!("its frame, {}", frames.iter().map(|f| f.frame).sum::<i32>()),
                };
                Error::invalid(&self.pack, "frame", number, expected)
            })?,
        };
        let frame = Frame::read(&pack, fullest)?;
        let extent = framing::extent(&pack, &frame);
        let (scene, folder) = match &self.scene {
            Some(path) => {
                let scene = Scene::read(path)?;
                for light in &scene.lights {
                    if let Light::Environment { sky: Sky::Image { resolved, .. }, .. } = light {
                        skies.get(resolved)?;
                    }
                }
                (scene, path.parent())
            }
            None => (framing::first_scene(&pack, &frame, &extent, UpAxis::Z, self.size), self.pack.parent()),
        };
        let offered = folder.map(skies_of_folder).unwrap_or_default();
        let state = State::new(scene, self.scene.is_none(), position, self.method, offered, extent);
        Ok(Opened { pack: Arc::new(pack), state })
    }
}

impl Dropped {
    /// Of the file at `path`.
    pub fn of(path: &Path) -> Self {
        let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        match extension.as_deref() {
            Some("smoke") => Self::Pack,
            Some("toml") => Self::Scene,
            _ if is_sky(path) => Self::Sky,
            Some("vdb" | "pbrt" | "vol") => {
                Self::Other(format!("{}: a volume; bake it first: smoke-bake bake", path.display()))
            }
            _ => {
                let expected = "a pack (.smoke), a scene (.toml) or a sky (.exr, .hdr)";
                Self::Other(format!("{}: found another kind of file, expected {expected}", path.display()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_pack;

    fn opening(folder: &Path, frames: &[i32]) -> Opening {
        let pack = folder.join("a.smoke");
        small_pack(&pack, frames, 0.01);
        Opening { pack, scene: None, frame: None, method: MethodChoice::Auto, size: [640, 480] }
    }

    fn refusal(opening: &Opening) -> String {
        match opening.open(&Skies::default()) {
            Err(Failure::Work(message)) => message,
            _ => panic!("{opening:?} must be refused"),
        }
    }

    #[test]
    fn a_pack_alone_opens_with_a_scene_of_its_own_and_a_scene_keeps_its_size() {
        let folder = tempfile::tempdir().unwrap();
        let mut opening = opening(folder.path(), &[3, 5]);
        let opened = opening.open(&Skies::default()).unwrap();
        assert_eq!((opened.state.position, opened.state.fills_window), (0, true));
        assert_eq!((opened.state.scene.width, opened.state.scene.height), (640, 480));
        let mut scene = opened.state.scene;
        (scene.width, scene.height) = (12, 34);
        let path = folder.path().join("scene.toml");
        std::fs::write(&path, scene.to_toml()).unwrap();
        (opening.scene, opening.frame) = (Some(path), Some(5));
        let opened = opening.open(&Skies::default()).unwrap();
        assert_eq!((opened.state.position, opened.state.fills_window), (1, false));
        assert_eq!(opened.state.scene, scene);
    }

    #[test]
    fn what_cannot_be_opened_is_named_in_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let good = opening(folder.path(), &[3, 5]);
        let message = refusal(&Opening { frame: Some(4), ..good.clone() });
        assert!(message.ends_with("frame: found 4, expected one of its frames, 3 to 5"), "{message}");
        assert!(refusal(&Opening { pack: "none.smoke".into(), ..good.clone() }).contains("none.smoke"));
        assert!(refusal(&Opening { scene: Some("none.toml".into()), ..good.clone() }).contains("none.toml"));
        let path = folder.path().join("scene.toml");
        let mut scene = good.open(&Skies::default()).unwrap().state.scene;
        let sky = Sky::Image { written: "none.exr".into(), resolved: "none.exr".into() };
        scene.lights[0] = Light::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: true };
        std::fs::write(&path, scene.to_toml()).unwrap();
        assert!(refusal(&Opening { scene: Some(path), ..good }).contains("none.exr"));
    }

    #[test]
    fn dropped_files_are_told_apart_by_their_names() {
        let kinds = ["a.smoke", "b.TOML", "c.hdr", "d.Exr"].map(|name| Dropped::of(Path::new(name)));
        assert_eq!(kinds, [Dropped::Pack, Dropped::Scene, Dropped::Sky, Dropped::Sky]);
        let said = |name: &str| match Dropped::of(Path::new(name)) {
            Dropped::Other(message) => message,
            kind => panic!("{kind:?}"),
        };
        assert!(said("a.vdb").contains("bake it first"));
        assert!(said("README").contains("expected a pack"));
    }
}
