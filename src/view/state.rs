//! What the user edits: a scene, a frame, a method with its quality, an exposure. Nothing here draws or renders.
//!
//! The scene is the one that is saved: what the panel shows as angles and strengths is read from it and written back to
//! it, and what is not touched keeps its exact value.

use super::framing;
use super::orbit::vertical;
use crate::cli::MethodChoice;
use crate::method::Method;
use glam::{DQuat, DVec3};
use smoke_formats::image;
use smoke_formats::scene::{Light, Scene, Sky, UpAxis};
use smoke_runtime::plan::ladder::rung;
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::reference::ReferenceSettings;
use smoke_runtime::transport::transfer::source::TransferSettings;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Qualities by the names of the plan's rungs, with the error that the reference is traced to.
pub const QUALITIES: [(&str, f64); 5] =
    [("draft", 0.2), ("coarse", 0.1), ("middle", 0.05), ("default", 0.02), ("fine", 0.01)];

/// The rung of pictures that are moving.
const MOVING: &str = "sketch";

/// What the picker of environments offers.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyChoice {
    /// For the panel.
    pub name: String,
    /// What it shows.
    pub sky: Sky,
}

/// What is edited.
#[derive(Clone, Debug)]
pub struct State {
    /// Camera, size, medium and lights.
    pub scene: Scene,
    /// True if the picture takes the shape of the window; a scene file has its own.
    pub fills_window: bool,
    /// Which frame, from 0.
    pub position: usize,
    /// Never auto.
    pub method: MethodChoice,
    /// Place in [`QUALITIES`].
    pub quality: usize,
    /// Exposure in stops.
    pub stops: f64,
    /// What the picker offers.
    pub skies: Vec<SkyChoice>,
    /// What a camera that sees all must see, world space.
    extent: Arc<[DVec3]>,
    /// The sun that comes when it is switched on.
    sun: Light,
}

/// The sun as the panel has it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sun {
    /// Degrees, counter-clockwise seen from above, from x.
    pub azimuth: f64,
    /// Degrees above the horizon.
    pub elevation: f64,
    /// Its irradiance, largest channel.
    pub strength: f64,
}

impl State {
    /// A state that shows `scene` at `position`, by `method` or by what the scene needs. The picker offers the scene's
    /// skies, a plain one, and `skies`.
    pub fn new(
        scene: Scene,
        fills_window: bool,
        position: usize,
        method: MethodChoice,
        skies: Vec<SkyChoice>,
        extent: Vec<DVec3>,
    ) -> Self {
        let point = scene.lights.iter().any(|light| matches!(light, Light::Point { .. }));
        let method = match method {
            MethodChoice::Auto if point => MethodChoice::Reference,
            MethodChoice::Auto => MethodChoice::Compensated,
            given => given,
        };
        let directional = scene.lights.iter().find(|light| matches!(light, Light::Directional { .. }));
        let plain = Light::Directional { direction: [0.6, 0.6, -0.5], irradiance: [3.0; 3] };
        let sun = directional.cloned().unwrap_or(match scene.up {
            UpAxis::Z => plain,
            UpAxis::Y => Light::Directional { direction: [0.6, -0.5, -0.6], irradiance: [3.0; 3] },
        });
        let quality = QUALITIES.iter().position(|q| q.0 == "default").unwrap_or(0);
        let (stops, extent) = (0.0, extent.into());
        let mut state = Self { scene, fills_window, position, method, quality, stops, skies: Vec::new(), extent, sun };
        let plain = SkyChoice { name: "plain sky".into(), sky: sky_of(&framing::plain_sky()) };
        let own = state.scene.lights.iter().filter(|l| matches!(l, Light::Environment { .. })).map(sky_of);
        let choice = |sky: Sky| if sky == plain.sky { plain.clone() } else { SkyChoice { name: sky_name(&sky), sky } };
        let own: Vec<SkyChoice> = own.map(choice).collect();
        own.into_iter().chain([plain]).chain(skies).for_each(|choice| {
            state.offer(choice);
        });
        state
    }

    /// Adds to the picker what it does not have; gives its place there.
    pub fn offer(&mut self, choice: SkyChoice) -> usize {
        let same = |a: &Sky, b: &Sky| match (a, b) {
            (Sky::Image { resolved: a, .. }, Sky::Image { resolved: b, .. }) => a == b,
            _ => a == b,
        };
        self.skies.iter().position(|c| same(&c.sky, &choice.sky)).unwrap_or_else(|| {
            self.skies.push(choice);
            self.skies.len() - 1
        })
    }

    /// The first environment of the scene: what it shows, its rotation in degrees, intensity, and whether it is seen.
    pub fn environment(&mut self) -> Option<(&mut Sky, &mut f64, &mut f64, &mut bool)> {
        self.scene.lights.iter_mut().find_map(|light| match light {
            Light::Environment { sky, rotation_degrees, intensity, visible } => {
                Some((sky, rotation_degrees, intensity, visible))
            }
            _ => None,
        })
    }

    /// Shows another sky in the first environment; adds one to a scene that has none. `None` takes it away.
    pub fn pick(&mut self, choice: Option<usize>) {
        let Some(choice) = choice else {
            let first = self.scene.lights.iter().position(|l| matches!(l, Light::Environment { .. }));
            first.map(|at| self.scene.lights.remove(at));
            return;
        };
        let Some(new) = self.skies.get(choice).map(|c| c.sky.clone()) else { return };
        match self.environment() {
            Some((sky, ..)) => *sky = new,
            None => {
                let light = Light::Environment { sky: new, rotation_degrees: 0.0, intensity: 1.0, visible: true };
                self.scene.lights.insert(0, light);
            }
        }
    }

    /// The sun, if it is on.
    pub fn sun(&self) -> Option<Sun> {
        self.scene.lights.iter().find_map(|light| match light {
            Light::Directional { direction, irradiance } => Some(Sun::of(*direction, *irradiance, self.scene.up)),
            _ => None,
        })
    }

    /// Another sun, or none; its colour stays, and what the panel left as it was keeps its exact value.
    pub fn set_sun(&mut self, sun: Option<Sun>) {
        let up = self.scene.up;
        let at = self.scene.lights.iter().position(|light| matches!(light, Light::Directional { .. }));
        match (at, sun) {
            (Some(at), None) => self.sun = self.scene.lights.remove(at),
            (None, Some(_)) => self.scene.lights.push(self.sun.clone()),
            (Some(at), Some(sun)) => {
                if let Light::Directional { direction, irradiance } = &mut self.scene.lights[at] {
                    let before = Sun::of(*direction, *irradiance, up);
                    if (sun.azimuth, sun.elevation) != (before.azimuth, before.elevation) {
                        *direction = sun.direction(up);
                    }
                    if sun.strength != before.strength {
                        let scale = |v: f64| if before.strength > 0.0 { v / before.strength } else { 1.0 };
                        *irradiance = irradiance.map(|v| scale(v) * sun.strength);
                    }
                }
            }
            (None, None) => {}
        }
    }

    /// Turns all light about the vertical axis, counter-clockwise seen from above; points stay where they are.
    pub fn turn_lights(&mut self, degrees: f64) {
        if !degrees.is_finite() || degrees == 0.0 {
            return;
        }
        let turn = DQuat::from_axis_angle(vertical(self.scene.up), degrees.to_radians());
        for light in &mut self.scene.lights {
            match light {
                Light::Environment { rotation_degrees, .. } => {
                    *rotation_degrees = (*rotation_degrees + degrees).rem_euclid(360.0);
                }
                Light::Directional { direction, .. } => *direction = (turn * DVec3::from_array(*direction)).to_array(),
                Light::Point { .. } => {}
            }
        }
    }

    /// Largest channel of sigma_t.
    pub fn sigma_t(&self) -> f64 {
        self.scene.medium.sigma_t.into_iter().fold(0.0, f64::max)
    }

    /// Scales sigma_t to another largest channel; its colour stays.
    pub fn set_sigma_t(&mut self, largest: f64) {
        let before = self.sigma_t();
        if largest.is_finite() && largest >= 0.0 && largest != before {
            let scale = |v: f64| if before > 0.0 { v / before } else { 1.0 };
            self.scene.medium.sigma_t = self.scene.medium.sigma_t.map(|v| scale(v) * largest);
        }
    }

    /// Turns the world's up, camera and sun with it.
    pub fn set_up(&mut self, up: UpAxis) {
        if up == self.scene.up {
            return;
        }
        let sun = self.sun();
        self.scene.up = up;
        self.frame_all();
        if let (Some(sun), Some(Light::Directional { direction, .. })) =
            (sun, self.scene.lights.iter_mut().find(|l| matches!(l, Light::Directional { .. })))
        {
            *direction = sun.direction(up);
        }
    }

    /// A camera that sees the whole sequence, from where the first one would.
    pub fn frame_all(&mut self) {
        let aspect = f64::from(self.scene.width) / f64::from(self.scene.height);
        self.scene.camera = framing::camera(&self.extent, self.scene.up, aspect);
    }

    /// The method with the dials of its quality.
    pub fn method(&self) -> Method {
        let (name, target_error) = QUALITIES[self.quality.min(QUALITIES.len() - 1)];
        match self.method {
            MethodChoice::Reference => {
                Method::Reference(ReferenceSettings { target_error, ..ReferenceSettings::default() })
            }
            MethodChoice::Transfer => {
                let route = Route::Transfer(TransferSettings { sharp_suns: true });
                Method::Transfer(RenderSettings { route, ..RenderSettings::default() })
            }
            MethodChoice::Auto | MethodChoice::Compensated => Method::Compensated(settings(name)),
        }
    }

    /// What stands in for the method while something moves.
    pub fn moving_method(&self) -> Method {
        let point = self.scene.lights.iter().any(|light| matches!(light, Light::Point { .. }));
        match self.method() {
            Method::Compensated(_) => Method::Compensated(settings(MOVING)),
            Method::Reference(_) if !point => Method::Compensated(settings(MOVING)),
            other => other,
        }
    }
}

impl Sun {
    /// Azimuth and elevation are those of the way back, to the sun.
    fn of(direction: [f64; 3], irradiance: [f64; 3], up: UpAxis) -> Self {
        let toward = -DVec3::from_array(direction).normalize();
        let (x, y, z) = match up {
            UpAxis::Z => (toward.x, toward.y, toward.z),
            UpAxis::Y => (toward.x, -toward.z, toward.y),
        };
        let strength = irradiance.into_iter().fold(0.0, f64::max);
        Self { azimuth: y.atan2(x).to_degrees(), elevation: z.clamp(-1.0, 1.0).asin().to_degrees(), strength }
    }

    /// The way its light travels, of length 1.
    fn direction(&self, up: UpAxis) -> [f64; 3] {
        let (azimuth, elevation) = (self.azimuth.to_radians(), self.elevation.to_radians());
        let [x, y, z] = [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()];
        match up {
            UpAxis::Z => [-x, -y, -z],
            UpAxis::Y => [-x, -z, y],
        }
    }
}

/// The dials of a rung of the plan.
fn settings(name: &str) -> RenderSettings {
    rung(name).and_then(|rung| rung.settings).unwrap_or_default()
}

fn sky_of(light: &Light) -> Sky {
    match light {
        Light::Environment { sky, .. } => sky.clone(),
        Light::Directional { .. } | Light::Point { .. } => Sky::Color([0.0; 3]),
    }
}

/// The name of a sky for the panel.
pub fn sky_name(sky: &Sky) -> String {
    match sky {
        Sky::Image { resolved, .. } => name_of(resolved),
        Sky::Color([r, g, b]) => format!("colour {r}, {g}, {b}"),
    }
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// The image at `path` for the picker; none if a scene file could not name it.
pub fn sky_at(path: &Path) -> Option<SkyChoice> {
    let path: PathBuf = path.to_str()?.into();
    Some(SkyChoice { name: name_of(&path), sky: Sky::Image { written: path.clone(), resolved: path } })
}

/// The images of a folder that may be environments, by name: `.exr` and `.hdr`, but no rendered frames of ours. A folder
/// that cannot be read has none.
pub fn skies_of_folder(folder: &Path) -> Vec<SkyChoice> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let mut paths: Vec<PathBuf> =
        std::fs::read_dir(folder).into_iter().flatten().filter_map(|e| Some(e.ok()?.path())).collect();
    paths.retain(|path| is_sky(path) && !matches!(image::read_settings(path), Ok(Some(_))));
    paths.sort();
    paths.iter().filter_map(|path| sky_at(path)).collect()
}

/// True for the name of an environment image.
pub fn is_sky(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    matches!(extension.as_deref(), Some("exr" | "hdr"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stage;

    fn sunny(up: UpAxis) -> State {
        let mut scene = stage().scene;
        scene.up = up;
        scene.lights = vec![
            framing::plain_sky(),
            Light::Directional { direction: [0.9, 0.35, -0.5], irradiance: [14.0, 12.0, 7.0] },
        ];
        State::new(scene, true, 0, MethodChoice::Auto, Vec::new(), Vec::new())
    }

    #[test]
    fn a_sun_that_is_only_looked_at_keeps_its_exact_value() {
        for up in [UpAxis::Y, UpAxis::Z] {
            let mut state = sunny(up);
            let before = state.scene.clone();
            let sun = state.sun();
            state.set_sun(sun);
            assert_eq!(state.scene, before);
            let sigma_t = state.sigma_t();
            state.set_sigma_t(sigma_t);
            assert_eq!(state.scene, before);
            state.set_sun(None);
            assert_eq!((state.sun(), state.scene.lights.len()), (None, 1));
            state.set_sun(sun);
            assert_eq!(state.scene, before, "off and on again");
        }
    }

    #[test]
    fn angles_of_the_sun_are_those_of_environments() {
        for (up, direction, azimuth, elevation) in [
            (UpAxis::Z, [-1.0, 0.0, 0.0], 0.0, 0.0),
            (UpAxis::Z, [0.0, -2.0, 0.0], 90.0, 0.0),
            (UpAxis::Z, [-1.0, 0.0, -1.0], 0.0, 45.0),
            (UpAxis::Y, [0.0, 0.0, 3.0], 90.0, 0.0),
            (UpAxis::Y, [-1.0, -1.0, 0.0], 0.0, 45.0),
        ] {
            let sun = Sun::of(direction, [1.0; 3], up);
            assert!((sun.azimuth - azimuth).abs() < 1e-12 && (sun.elevation - elevation).abs() < 1e-12, "{sun:?}");
            let back = DVec3::from_array(sun.direction(up));
            assert!((back - DVec3::from_array(direction).normalize()).length() < 1e-15, "{back}");
        }
    }

    #[test]
    fn turning_the_lights_turns_sky_and_sun_by_the_same_angle_and_the_way_round_the_same() {
        for up in [UpAxis::Y, UpAxis::Z] {
            let mut state = sunny(up);
            let before = state.sun().unwrap();
            (0..9).for_each(|_| state.turn_lights(10.0));
            let after = state.sun().unwrap();
            assert!(((after.azimuth - before.azimuth).rem_euclid(360.0) - 90.0).abs() < 1e-9);
            assert!((after.elevation - before.elevation).abs() < 1e-9 && after.strength == before.strength);
            assert_eq!(*state.environment().unwrap().1, 90.0);
            state.turn_lights(f64::NAN);
            assert_eq!(state.sun(), Some(after));
        }
    }

    #[test]
    fn strengths_scale_and_keep_the_colour_and_come_back_from_zero_white() {
        let mut state = sunny(UpAxis::Z);
        let sun = state.sun().unwrap();
        state.set_sun(Some(Sun { strength: 28.0, ..sun }));
        assert_eq!(
            state.scene.lights[1],
            Light::Directional { direction: [0.9, 0.35, -0.5], irradiance: [28.0, 24.0, 14.0] }
        );
        state.scene.medium.sigma_t = [4.0, 2.0, 1.0];
        state.set_sigma_t(8.0);
        assert_eq!(state.scene.medium.sigma_t, [8.0, 4.0, 2.0]);
        state.set_sigma_t(0.0);
        state.set_sigma_t(3.0);
        assert_eq!(state.scene.medium.sigma_t, [3.0; 3]);
        state.set_sigma_t(f64::NAN);
        assert_eq!(state.scene.medium.sigma_t, [3.0; 3]);
    }

    #[test]
    fn every_edit_leaves_a_scene_that_reads_back() {
        let mut state = sunny(UpAxis::Z);
        state.turn_lights(123.456);
        state.set_sun(Some(Sun { azimuth: 77.0, elevation: -3.0, strength: 0.1 }));
        state.pick(None);
        assert!(state.environment().is_none());
        let dropped = state.offer(sky_at(Path::new("maps/a.exr")).unwrap());
        assert_eq!(state.offer(sky_at(Path::new("maps/a.exr")).unwrap()), dropped, "once in the picker");
        state.pick(Some(dropped));
        state.pick(Some(99));
        let text = state.scene.to_toml();
        assert_eq!(Scene::parse(Path::new("scene.toml"), &text).unwrap(), state.scene);
        assert!(text.contains("maps/a.exr"));
    }

    #[test]
    fn auto_is_the_fast_method_and_a_point_light_needs_the_reference() {
        let mut scene = stage().scene;
        scene.lights.push(Light::Point { position: [0.0; 3], intensity: [1.0; 3] });
        let point = State::new(scene, false, 0, MethodChoice::Auto, Vec::new(), Vec::new());
        assert!(matches!((point.method(), point.moving_method()), (Method::Reference(_), Method::Reference(_))));
        let state = sunny(UpAxis::Z);
        assert_eq!(state.method(), Method::Compensated(RenderSettings::default()));
        assert!(matches!(state.moving_method(), Method::Compensated(s) if s != RenderSettings::default()));
        assert!(QUALITIES.iter().all(|(name, _)| rung(name).is_some_and(|r| r.settings.is_some())));
        assert!(rung(MOVING).is_some());
    }

    #[test]
    fn a_folder_offers_its_images_but_no_frames_of_ours() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["b.hdr", "a.EXR", "notes.txt"] {
            std::fs::write(folder.path().join(name), "x").unwrap();
        }
        let names: Vec<String> = skies_of_folder(folder.path()).into_iter().map(|c| c.name).collect();
        assert_eq!(names, ["a.EXR", "b.hdr"]);
        assert!(skies_of_folder(Path::new("no/such/folder")).is_empty());
    }
}
