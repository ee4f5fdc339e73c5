//! The scene file: camera, image size, medium and lights, as TOML (`scene.toml`).
//!
//! Reading takes two steps. Serde fills the file's structure and refuses unknown keys; then every value is checked, so
//! that a [`Scene`] that was read holds only finite numbers in their ranges. Both kinds of error name the file, the
//! line and column, the key, what was found and what was expected. Image paths stay as written and are also resolved
//! against the scene file's folder; only the written form goes into metadata, so that the same scene gives the same
//! bytes in any folder.

mod file;

use crate::image::projection::{Pinhole, cross, unit};
use crate::{Error, Result, toml_text};
use serde::{Serialize, Serializer};
use std::path::{Path, PathBuf};

/// Most pixels of an image to render: 2^26.
pub const MAX_RENDER_PIXELS: u64 = 1 << 26;

/// Which world axis points to the sky; lights from environment images turn with it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// y, as in Houdini and most engines.
    Y,
    /// z, as in Blender.
    #[default]
    Z,
}

/// A pinhole camera, world space.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// The eye.
    pub position: [f64; 3],
    /// A point in the middle of the image; not the eye.
    pub target: [f64; 3],
    /// Points to the image's upper half; not zero, not along the view.
    pub up: [f64; 3],
    /// Horizontal field of view in degrees, in (0, 180).
    pub fov_degrees: f64,
}

/// The medium, per unit of density.
#[derive(Clone, Debug, PartialEq)]
pub struct Medium {
    /// Extinction per unit density and world unit, R, G, B, at least 0.
    pub sigma_t: [f64; 3],
    /// Single-scattering albedo, R, G, B, in [0, 1].
    pub albedo: [f64; 3],
    /// Henyey-Greenstein mean cosine, in (-1, 1), forward positive.
    pub g: f64,
}

/// What the sky shows.
#[derive(Clone, Debug, PartialEq)]
pub enum Sky {
    /// A latitude-longitude image.
    Image {
        /// The path as the scene file has it.
        written: PathBuf,
        /// The path to open: `written`, from the scene file's folder.
        resolved: PathBuf,
    },
    /// The same radiance from everywhere, linear Rec.709.
    Color([f64; 3]),
}

/// One light.
#[derive(Clone, Debug, PartialEq)]
pub enum Light {
    /// Light from all directions at infinity.
    Environment {
        /// Radiance by direction.
        sky: Sky,
        /// Degrees, counter-clockwise seen from above.
        rotation_degrees: f64,
        /// Factor on the radiance, at least 0.
        intensity: f64,
        /// Whether the camera sees it behind the smoke.
        visible: bool,
    },
    /// Parallel light, a sun.
    Directional {
        /// The way the light travels; not zero, any length.
        direction: [f64; 3],
        /// On a surface facing the light, R, G, B, at least 0.
        irradiance: [f64; 3],
    },
    /// An isotropic point.
    Point {
        /// World space.
        position: [f64; 3],
        /// W/sr, R, G, B, at least 0.
        intensity: [f64; 3],
    },
}

/// A scene: everything about an image but the smoke.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The world's vertical axis.
    pub up: UpAxis,
    /// The camera.
    pub camera: Camera,
    /// Pixels in a row, 1 to 65536.
    pub width: u32,
    /// Rows, 1 to 65536; at most [`MAX_RENDER_PIXELS`] pixels in all.
    pub height: u32,
    /// The medium.
    pub medium: Medium,
    /// The lights, in the order of the file.
    pub lights: Vec<Light>,
}

/// One value out of range: where, what it is, what it should be.
#[derive(Clone, Debug, PartialEq)]
struct Problem {
    /// Dotted key, `light[1].direction`.
    key: String,
    found: String,
    expected: String,
}

impl Scene {
    /// Reads and checks a scene file.
    pub fn read(path: &Path) -> Result<Self> {
        let text = toml_text::read(path)?;
        Self::parse(path, &text)
    }

    /// Reads and checks the text of a scene file; `path` is named in errors, and its folder resolves image paths.
    pub fn parse(path: &Path, text: &str) -> Result<Self> {
        let file: file::SceneFile = toml::from_str(text).map_err(|e| toml_text::error(path, text, &e))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let scene = file.into_scene(folder);
        scene.and_then(|scene| scene.problem().map_or(Ok(scene), Err)).map_err(|p| {
            let what = format!("{}{}", toml_text::position(text, &p.key), p.key);
            Error::invalid(path, what, p.found, p.expected)
        })
    }

    /// Checks every value again, after a change from the command line. `path` is named in the error.
    pub fn validate(&self, path: &Path) -> Result<()> {
        self.problem().map_or(Ok(()), |p| Err(Error::invalid(path, p.key, p.found, p.expected)))
    }

    /// The scene as TOML text that reads back to the same scene.
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("a scene holds only tables, arrays, strings and finite numbers")
    }

    /// The camera with the image's size, for the matrices in an image's metadata.
    pub fn pinhole(&self) -> Pinhole {
        let Camera { position, target, up, fov_degrees } = self.camera;
        Pinhole { position, target, up, fov_degrees, width: self.width as usize, height: self.height as usize }
    }

    /// The first value that is out of its range. Guards are positive, so that NaN fails them.
    fn problem(&self) -> Option<Problem> {
        self.camera_problem()
            .or_else(|| self.image_problem())
            .or_else(|| self.medium_problem())
            .or_else(|| self.lights.iter().enumerate().find_map(|(i, light)| light_problem(i, light)))
    }

    fn camera_problem(&self) -> Option<Problem> {
        let Camera { position, target, up, fov_degrees } = self.camera;
        finite("camera.position", position).or_else(|| finite("camera.target", target)).or_else(|| {
            let view: [f64; 3] = std::array::from_fn(|a| target[a] - position[a]);
            check("camera.target", is_vector(view), target, "a point other than camera.position")
                .or_else(|| check("camera.up", is_vector(up), up, "a finite vector other than zero"))
                .or_else(|| {
                    // Below an angle of 1e-6 the image's roll would hang on rounding.
                    let sine = cross(unit(view), unit(up)).iter().map(|v| v * v).sum::<f64>().sqrt();
                    check("camera.up", sine > 1e-6, up, "a vector that is not parallel to the view")
                })
                .or_else(|| {
                    let good = fov_degrees > 0.0 && fov_degrees < 180.0;
                    check("camera.fov", good, fov_degrees, "degrees between 0 and 180")
                })
        })
    }

    fn image_problem(&self) -> Option<Problem> {
        let side = |key, value: u32| check(key, (1..=65536).contains(&value), value, "1 to 65536 pixels");
        side("image.width", self.width).or_else(|| side("image.height", self.height)).or_else(|| {
            let pixels = u64::from(self.width) * u64::from(self.height);
            let found = format!("{} x {}", self.width, self.height);
            let good = pixels <= MAX_RENDER_PIXELS;
            (!good).then(|| Problem::new("image", found, format!("at most {MAX_RENDER_PIXELS} pixels")))
        })
    }

    fn medium_problem(&self) -> Option<Problem> {
        let Medium { sigma_t, albedo, g } = self.medium;
        let unit_range = albedo.iter().all(|v| (0.0..=1.0).contains(v));
        not_negative("medium.sigma_t", sigma_t)
            .or_else(|| check("medium.albedo", unit_range, albedo, "values from 0 to 1"))
            .or_else(|| check("medium.g", g > -1.0 && g < 1.0, g, "a mean cosine between -1 and 1, both excluded"))
    }
}

fn light_problem(i: usize, light: &Light) -> Option<Problem> {
    let key = |name: &str| format!("light[{i}].{name}");
    match light {
        Light::Environment { sky, rotation_degrees, intensity, .. } => {
            let sky = match sky {
                Sky::Color(color) => not_negative(&key("color"), *color),
                Sky::Image { written, .. } => {
                    check(&key("image"), !written.as_os_str().is_empty(), written, "a path to an EXR or HDR image")
                }
            };
            sky.or_else(|| check(&key("rotation"), rotation_degrees.is_finite(), rotation_degrees, "finite degrees"))
                .or_else(|| {
                    let good = intensity.is_finite() && *intensity >= 0.0;
                    check(&key("intensity"), good, intensity, "a finite number, at least 0")
                })
        }
        Light::Directional { direction, irradiance } => {
            check(&key("direction"), is_vector(*direction), direction, "a finite vector other than zero")
                .or_else(|| not_negative(&key("irradiance"), *irradiance))
        }
        Light::Point { position, intensity } => {
            finite(&key("position"), *position).or_else(|| not_negative(&key("intensity"), *intensity))
        }
    }
}

impl Problem {
    fn new(key: impl Into<String>, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { key: key.into(), found: found.into(), expected: expected.into() }
    }
}

fn check(key: &str, good: bool, found: impl std::fmt::Debug, expected: &str) -> Option<Problem> {
    (!good).then(|| Problem::new(key, format!("{found:?}"), expected))
}

fn finite(key: &str, v: [f64; 3]) -> Option<Problem> {
    check(key, v.iter().all(|x| x.is_finite()), v, "three finite numbers")
}

fn not_negative(key: &str, v: [f64; 3]) -> Option<Problem> {
    check(key, v.iter().all(|x| x.is_finite() && *x >= 0.0), v, "finite numbers, at least 0")
}

/// Finite and not zero.
fn is_vector(v: [f64; 3]) -> bool {
    v.iter().all(|x| x.is_finite()) && v.iter().any(|x| *x != 0.0)
}

impl Serialize for Scene {
    /// The structure of the scene file, with every default written out; image paths as the file had them.
    fn serialize<S: Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        file::SceneFile::from_scene(self).serialize(serializer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FULL: &str = r#"
[world]
up = "y"
[camera]
position = [1.4, -4.6, 1.9]
target   = [1.3, 1.3, 1.6]
up       = [0, 0, 1]
fov      = 36.0
[image]
width = 800
height = 600
[medium]
sigma_t = 8
albedo  = [0.92, 0.9, 0.8]
g       = -0.5
[[light]]
kind = "environment"
image = "maps/sunset.exr"
rotation = 10
[[light]]
kind = "environment"
color = [1, 2, 3]
visible = true
[[light]]
kind = "directional"
direction = [0, 0, -1]
irradiance = [3, 3, 3]
[[light]]
kind = "point"
position = [0, 0, 1]
intensity = 10
"#;

    fn parse(text: &str) -> Result<Scene> {
        Scene::parse(Path::new("shots/scene.toml"), text)
    }

    #[test]
    fn every_field_of_a_full_scene_is_read() {
        let scene = parse(FULL).unwrap();
        assert_eq!((scene.up, scene.width, scene.height), (UpAxis::Y, 800, 600));
        assert_eq!(scene.camera.up, [0.0, 0.0, 1.0]);
        assert_eq!(scene.medium, Medium { sigma_t: [8.0; 3], albedo: [0.92, 0.9, 0.8], g: -0.5 });
        let sky = Sky::Image { written: "maps/sunset.exr".into(), resolved: "shots/maps/sunset.exr".into() };
        let first = Light::Environment { sky, rotation_degrees: 10.0, intensity: 1.0, visible: false };
        assert_eq!(scene.lights[0], first);
        let sky = Sky::Color([1.0, 2.0, 3.0]);
        let second = Light::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: true };
        assert_eq!(scene.lights[1], second);
        assert_eq!(scene.lights[2], Light::Directional { direction: [0.0, 0.0, -1.0], irradiance: [3.0; 3] });
        assert_eq!(scene.lights[3], Light::Point { position: [0.0, 0.0, 1.0], intensity: [10.0; 3] });
        assert_eq!(scene.pinhole().width, 800);
    }

    #[test]
    fn what_may_be_left_out_has_its_default() {
        let text =
            "[camera]\nposition=[0,-5,0]\ntarget=[0,0,0]\nfov=40\n[image]\nwidth=4\nheight=3\n[medium]\nsigma_t=1";
        let scene = parse(text).unwrap();
        assert_eq!((scene.up, scene.camera.up), (UpAxis::Z, [0.0, 0.0, 1.0]));
        assert_eq!(scene.medium, Medium { sigma_t: [1.0; 3], albedo: [1.0; 3], g: 0.0 });
        assert!(scene.lights.is_empty());
        let y_up = parse(&text.replace("[camera]", "world.up = \"y\"\n[camera]").replace("-5,0", "0,5")).unwrap();
        assert_eq!(y_up.camera.up, [0.0, 1.0, 0.0]);
    }

    #[test]
    fn a_scene_written_as_toml_reads_back_the_same() {
        let scene = parse(FULL).unwrap();
        assert_eq!(parse(&scene.to_toml()).unwrap(), scene);
        let json = serde_json::to_value(&scene).unwrap();
        assert_eq!(json["light"][0]["image"], "maps/sunset.exr");
        assert_eq!(json["camera"]["fov"], 36.0);
    }

    #[test]
    fn each_value_out_of_range_is_refused_by_its_key_with_found_and_expected() {
        let cases = [
            ("fov      = 36.0", "fov = 180.0", "line 8, column 7: camera.fov: found 180.0, expected degrees between 0"),
            ("fov      = 36.0", "fov = nan", "camera.fov: found NaN"),
            ("width = 800", "width = 0", "image.width: found 0, expected 1 to 65536 pixels"),
            ("width = 800", "width = 65537", "image.width: found 65537"),
            ("width = 800", "width = -1", "image.width"),
            (
                "width = 800\nheight = 600",
                "width = 65536\nheight = 1025",
                "image: found 65536 x 1025, expected at most",
            ),
            ("sigma_t = 8", "sigma_t = -1e-9", "medium.sigma_t: found [-1e-9, -1e-9, -1e-9]"),
            ("sigma_t = 8", "sigma_t = [1, inf, 1]", "medium.sigma_t: found [1.0, inf, 1.0]"),
            ("[0.92, 0.9, 0.8]", "1.5", "medium.albedo: found [1.5, 1.5, 1.5], expected values from 0 to 1"),
            ("g       = -0.5", "g = 1", "medium.g: found 1.0"),
            ("g       = -0.5", "g = -1.0", "medium.g: found -1.0"),
            ("[1.3, 1.3, 1.6]", "[1.4, -4.6, 1.9]", "camera.target: found [1.4, -4.6, 1.9]"),
            ("up       = [0, 0, 1]", "up = [0, 0, 0]", "camera.up: found [0.0, 0.0, 0.0]"),
            ("up       = [0, 0, 1]", "up = [-0.1, 5.9, -0.3]", "a vector that is not parallel to the view"),
            ("[1.4, -4.6, 1.9]", "[nan, 0, 0]", "camera.position: found [NaN, 0.0, 0.0]"),
            ("direction = [0, 0, -1]", "direction = [0, 0, 0]", "light[2].direction: found [0.0, 0.0, 0.0]"),
            ("irradiance = [3, 3, 3]", "irradiance = [3, -3, 3]", "line 27, column 14: light[2].irradiance: found"),
            ("color = [1, 2, 3]", "color = [1, 2, -3]", "light[1].color: found [1.0, 2.0, -3.0]"),
            ("rotation = 10", "rotation = inf", "light[0].rotation: found inf"),
            ("visible = true", "intensity = -1", "light[1].intensity: found -1.0"),
            ("position = [0, 0, 1]", "position = [0, inf, 1]", "light[3].position: found [0.0, inf, 1.0]"),
            ("intensity = 10", "intensity = -10", "light[3].intensity: found [-10.0, -10.0, -10.0]"),
            ("\"maps/sunset.exr\"", "\"\"", "light[0].image: found \"\","),
        ];
        for (good, bad, expected) in cases {
            assert_eq!(FULL.matches(good).count(), 1, "{good} must name one place of the scene");
            let message = parse(&FULL.replace(good, bad)).expect_err(bad).to_string();
            assert!(message.starts_with("shots/scene.toml: line "), "{message}");
            assert!(message.contains(expected), "{message}\nshould contain\n{expected}");
            assert!(!message.contains('\n'));
        }
    }

    #[test]
    fn structural_errors_name_line_column_and_key_and_guess_what_was_meant() {
        let cases = [
            ("albedo  =", "albdo =", "line 14, column 1: medium.albdo: found an unknown key"),
            ("albedo  =", "albdo =", "did you mean `albedo`?"),
            ("[medium]", "[media]", "did you mean `medium`?"),
            ("rotation = 10", "rotatoin = 10", "light[0].rotatoin"),
            ("fov      = 36.0", "", "camera"),
            ("fov      = 36.0", "", "missing field `fov`"),
            ("fov      = 36.0", "fov = \"wide\"", "camera.fov: found \"wide\", expected a number"),
            ("[1.3, 1.3, 1.6]", "[1.3, 1.3]", "camera.target"),
            ("[0.92, 0.9, 0.8]", "[0.92, 0.9]", "medium.albedo: found an array of 2"),
            ("[0.92, 0.9, 0.8]", "\"white\"", "medium.albedo: found \"white\", expected a number or"),
            ("kind = \"directional\"", "kind = \"sun\"", "light[2].kind"),
            ("kind = \"directional\"", "kind = \"point\"", "light[2].direction: found a key of another light"),
            ("color = [1, 2, 3]", "", "light[1]: found neither, expected image or color"),
            ("color = [1, 2, 3]", "color = 1\nimage = \"a.exr\"", "light[1]: found both, expected image or color"),
            ("irradiance = [3, 3, 3]", "", "light[2]: found no irradiance"),
            ("up = \"y\"", "up = \"x\"", "world.up"),
            ("[image]", "[image", "line 9"),
        ];
        for (good, bad, expected) in cases {
            assert_eq!(FULL.matches(good).count(), 1, "{good} must name one place of the scene");
            let message = parse(&FULL.replace(good, bad)).expect_err(bad).to_string();
            assert!(message.starts_with("shots/scene.toml: "), "{message}");
            assert!(message.contains(expected), "{message}\nshould contain\n{expected}");
            assert!(!message.contains('\n'), "{message}");
        }
    }

    #[test]
    fn a_change_from_the_command_line_is_checked_again() {
        let mut scene = parse(FULL).unwrap();
        assert!(scene.validate(Path::new("a")).is_ok());
        scene.medium.g = f64::NAN;
        let message = scene.validate(Path::new("a")).unwrap_err().to_string();
        assert_eq!(message, "a: medium.g: found NaN, expected a mean cosine between -1 and 1, both excluded");
    }

    #[test]
    #[ignore = "needs ../shared/data"]
    fn the_scene_of_the_peers_is_read_and_its_sky_is_there() {
        let data = std::env::var_os("SMOKE_BAKE_DATA")
            .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data"), PathBuf::from);
        let scene = Scene::read(&data.join("../peers/scenes/plume.toml")).unwrap();
        assert_eq!((scene.width, scene.height, scene.medium.sigma_t), (320, 400, [8.0; 3]));
        let [Light::Environment { sky: Sky::Image { resolved, .. }, .. }] = &scene.lights[..] else {
            panic!("one environment light: {:?}", scene.lights)
        };
        let (sky, negative) = crate::image::read_environment(resolved).unwrap();
        assert_eq!(sky.width, 2 * sky.height);
        assert!(negative < sky.pixels.len() / 10, "{negative} negative samples");
    }
}
