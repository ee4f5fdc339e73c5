//! The scene file's structure as serde sees it, and the way from it to a [`Scene`] and back.
//!
//! Lights are read as one flat table of optional keys and sorted out here: serde's tagged enums would lose the line
//! and column of an error.

use super::{Camera, Light, Medium, Problem, Scene, Sky, UpAxis};
use serde::de::{Deserializer, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SceneFile {
    #[serde(default)]
    world: WorldTable,
    camera: CameraTable,
    image: ImageTable,
    medium: MediumTable,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    light: Vec<LightTable>,
}

#[derive(Default, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct WorldTable {
    #[serde(default)]
    up: UpAxis,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct CameraTable {
    position: [f64; 3],
    target: [f64; 3],
    up: Option<[f64; 3]>,
    fov: f64,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct ImageTable {
    width: u32,
    height: u32,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct MediumTable {
    sigma_t: Rgb,
    #[serde(default = "Rgb::one")]
    albedo: Rgb,
    #[serde(default)]
    g: f64,
}

#[derive(Clone, Copy, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Environment,
    Directional,
    Point,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct LightTable {
    kind: Kind,
    #[serde(skip_serializing_if = "Option::is_none")]
    image: Option<PathBuf>,
    #[serde(skip_serializing_if = "Option::is_none")]
    color: Option<Rgb>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rotation: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    visible: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    direction: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    irradiance: Option<Rgb>,
    #[serde(skip_serializing_if = "Option::is_none")]
    position: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    intensity: Option<Rgb>,
}

/// A number for all three channels, or one for each.
#[derive(Clone, Copy, Serialize)]
#[serde(transparent)]
struct Rgb([f64; 3]);

impl Rgb {
    fn one() -> Self {
        Self([1.0; 3])
    }
}

impl<'de> Deserialize<'de> for Rgb {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct RgbVisitor;
        impl<'de> Visitor<'de> for RgbVisitor {
            type Value = Rgb;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a number or an array of three")
            }
            fn visit_f64<E>(self, v: f64) -> Result<Rgb, E> {
                Ok(Rgb([v; 3]))
            }
            fn visit_i64<E>(self, v: i64) -> Result<Rgb, E> {
                Ok(Rgb([v as f64; 3]))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Rgb, A::Error> {
                let mut values = Vec::with_capacity(3);
                while let Some(v) = seq.next_element::<f64>()? {
                    values.push(v);
                }
                let count = values.len();
                let wrong = || serde::de::Error::invalid_length(count, &self);
                values.try_into().map(Rgb).map_err(|_| wrong())
            }
        }
        deserializer.deserialize_any(RgbVisitor)
    }
}

impl SceneFile {
    /// Sorts the lights out and fills in the defaults; values are not checked yet.
    pub(super) fn into_scene(self, folder: &Path) -> Result<Scene, Problem> {
        let up = self.world.up;
        let lights =
            self.light.into_iter().enumerate().map(|(i, l)| l.into_light(i, folder)).collect::<Result<_, _>>()?;
        let sky = match up {
            UpAxis::Y => [0.0, 1.0, 0.0],
            UpAxis::Z => [0.0, 0.0, 1.0],
        };
        let CameraTable { position, target, up: camera_up, fov } = self.camera;
        Ok(Scene {
            up,
            camera: Camera { position, target, up: camera_up.unwrap_or(sky), fov_degrees: fov },
            width: self.image.width,
            height: self.image.height,
            medium: Medium { sigma_t: self.medium.sigma_t.0, albedo: self.medium.albedo.0, g: self.medium.g },
            lights,
        })
    }

    pub(super) fn from_scene(scene: &Scene) -> Self {
        let Camera { position, target, up, fov_degrees } = scene.camera;
        let Medium { sigma_t, albedo, g } = scene.medium;
        Self {
            world: WorldTable { up: scene.up },
            camera: CameraTable { position, target, up: Some(up), fov: fov_degrees },
            image: ImageTable { width: scene.width, height: scene.height },
            medium: MediumTable { sigma_t: Rgb(sigma_t), albedo: Rgb(albedo), g },
            light: scene.lights.iter().map(LightTable::from_light).collect(),
        }
    }
}

impl LightTable {
    fn empty(kind: Kind) -> Self {
        Self {
            kind,
            image: None,
            color: None,
            rotation: None,
            visible: None,
            direction: None,
            irradiance: None,
            position: None,
            intensity: None,
        }
    }

    fn from_light(light: &Light) -> Self {
        match light {
            Light::Environment { sky, rotation_degrees, intensity, visible } => {
                let (image, color) = match sky {
                    Sky::Image { written, .. } => (Some(written.clone()), None),
                    Sky::Color(color) => (None, Some(Rgb(*color))),
                };
                Self {
                    image,
                    color,
                    rotation: Some(*rotation_degrees),
                    intensity: Some(Rgb([*intensity; 3])),
                    visible: Some(*visible),
                    ..Self::empty(Kind::Environment)
                }
            }
            Light::Directional { direction, irradiance } => Self {
                direction: Some(*direction),
                irradiance: Some(Rgb(*irradiance)),
                ..Self::empty(Kind::Directional)
            },
            Light::Point { position, intensity } => {
                Self { position: Some(*position), intensity: Some(Rgb(*intensity)), ..Self::empty(Kind::Point) }
            }
        }
    }

    fn into_light(self, i: usize, folder: &Path) -> Result<Light, Problem> {
        let at = |key: &str| format!("light[{i}].{key}");
        let given = [
            ("image", self.image.is_some()),
            ("color", self.color.is_some()),
            ("rotation", self.rotation.is_some()),
            ("visible", self.visible.is_some()),
            ("direction", self.direction.is_some()),
            ("irradiance", self.irradiance.is_some()),
            ("position", self.position.is_some()),
            ("intensity", self.intensity.is_some()),
        ];
        let allowed: &[&str] = match self.kind {
            Kind::Environment => &["image", "color", "rotation", "visible", "intensity"],
            Kind::Directional => &["direction", "irradiance"],
            Kind::Point => &["position", "intensity"],
        };
        if let Some((key, _)) = given.iter().find(|(key, given)| *given && !allowed.contains(key)) {
            let expected = format!("only {} here", allowed.join(", "));
            return Err(Problem::new(at(key), "a key of another light", expected));
        }
        let missing = |key: &str| Problem::new(format!("light[{i}]"), format!("no {key}"), allowed.join(" and "));
        match self.kind {
            Kind::Environment => {
                let one_of = |found| Problem::new(format!("light[{i}]"), found, "image or color");
                let sky = match (self.image, self.color) {
                    (Some(written), None) => Sky::Image { resolved: folder.join(&written), written },
                    (None, Some(color)) => Sky::Color(color.0),
                    (None, None) => return Err(one_of("neither")),
                    (Some(_), Some(_)) => return Err(one_of("both")),
                };
                let [r, g, b] = self.intensity.unwrap_or(Rgb::one()).0;
                if r.to_bits() != g.to_bits() || g.to_bits() != b.to_bits() {
                    return Err(Problem::new(at("intensity"), format!("{:?}", [r, g, b]), "one number"));
                }
                Ok(Light::Environment {
                    sky,
                    rotation_degrees: self.rotation.unwrap_or(0.0),
                    intensity: r,
                    visible: self.visible.unwrap_or(false),
                })
            }
            Kind::Directional => Ok(Light::Directional {
                direction: self.direction.ok_or_else(|| missing("direction"))?,
                irradiance: self.irradiance.ok_or_else(|| missing("irradiance"))?.0,
            }),
            Kind::Point => Ok(Light::Point {
                position: self.position.ok_or_else(|| missing("position"))?,
                intensity: self.intensity.ok_or_else(|| missing("intensity"))?.0,
            }),
        }
    }
}
