//! The scenes of a sweep: each file with every combination of the axes' values. Each has its own reference.

use super::options::{self, AXES, Options};
use crate::cli::{ScatteringOrders, SweepArgs};
use crate::failure::Failure;
use crate::render;
use crate::staging::{SceneChanges, Stage};
use smoke_baking::survey::hash_file;
use smoke_formats::scene::{Light, Scene, Sky};
use std::path::PathBuf;

/// Pixels of an image whose size is not given.
const PIXELS: f64 = 20_000.0;

/// One scene file with one value for each axis.
pub struct Setting {
    /// The file.
    pub scene: PathBuf,
    /// Value of each axis, in the order of the command line.
    pub axes: Vec<(String, String)>,
    /// The scene with these values.
    pub stage: Stage,
    /// Most scattering orders of the reference; none for all.
    pub orders: Option<u32>,
}

/// Every scene with every combination of the axes' values, read and checked.
pub fn all(args: &SweepArgs) -> Result<Vec<Setting>, Failure> {
    for (i, axis) in args.vary.iter().enumerate() {
        if !AXES.contains(&axis.name.as_str()) || args.vary[..i].iter().any(|other| other.name == axis.name) {
            return Err(options::unknown("--vary", &axis.name, &AXES));
        }
    }
    let mut combinations = vec![Vec::new()];
    for axis in &args.vary {
        let longer = |before: &Vec<(String, String)>| -> Vec<Vec<(String, String)>> {
            let with = |value: &String| before.iter().cloned().chain([(axis.name.clone(), value.clone())]).collect();
            axis.values.iter().map(with).collect()
        };
        combinations = combinations.iter().flat_map(longer).collect();
    }
    let mut all = Vec::new();
    for scene in &args.scene {
        let stage = Stage::read(scene, &SceneChanges::default())?;
        let [width, height] = size(&stage.scene, args.width, args.height).map(Some);
        for axes in &combinations {
            let mut options = Options::default();
            for (name, value) in axes {
                options = options.with(name, value);
            }
            let render = options.render()?;
            let stage = stage.changed(scene, &SceneChanges { width, height, ..render::changes(&render) })?;
            let orders = match render.order {
                None | Some(ScatteringOrders::All) => None,
                Some(ScatteringOrders::UpTo(orders)) => Some(orders),
            };
            all.push(Setting { scene: scene.clone(), axes: axes.clone(), stage, orders });
        }
    }
    Ok(all)
}

impl Setting {
    /// The options of a point in this scene: an axis that is an option and not a value of the scene joins them.
    pub fn options(&self, point: &Options) -> Options {
        let order = self.axes.iter().find(|(name, _)| name == "order" && !point.has("order"));
        order.map_or(point.clone(), |(name, value)| point.with(name, value))
    }

    /// What a reference depends on, but for the density: scene, contents of its images, orders.
    pub fn identity(&self) -> Result<String, Failure> {
        let scene = serde_json::to_string(&self.stage.scene).map_err(|e| Failure::work(e.to_string()))?;
        let mut text = format!("{scene} {:?}", self.orders);
        for light in &self.stage.scene.lights {
            if let Light::Environment { sky: Sky::Image { resolved, .. }, .. } = light {
                text += &format!(" {:032x}", u128::from_le_bytes(hash_file(resolved)?));
            }
        }
        Ok(text)
    }
}

/// Width and height: what is given, the other in proportion; else the scene's, but no more than [`PIXELS`] in all.
fn size(scene: &Scene, width: Option<u32>, height: Option<u32>) -> [u32; 2] {
    let (w, h) = (f64::from(scene.width), f64::from(scene.height));
    let scaled = |length: f64, by: f64| (length * by).round().clamp(1.0, 65536.0) as u32;
    match (width, height) {
        (Some(width), Some(height)) => [width, height],
        (Some(width), None) => [width, scaled(h, f64::from(width) / w)],
        (None, Some(height)) => [scaled(w, f64::from(height) / h), height],
        (None, None) => [w, h].map(|length| scaled(length, (PIXELS / (w * h)).sqrt().min(1.0))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_has_about_twenty_thousand_pixels_in_the_scenes_shape_and_is_never_enlarged() {
        let path = std::path::Path::new("a.toml");
        let text = "[camera]\nposition = [0, 0, 0]\ntarget = [1, 0, 0]\nfov = 30\n[image]\nwidth = W\nheight = H\n\
                    [medium]\nsigma_t = 1\n";
        let scene = |w: u32, h: u32| {
            let text = text.replace('W', &w.to_string()).replace('H', &h.to_string());
            Scene::parse(path, &text).unwrap()
        };
        assert_eq!(size(&scene(300, 400), None, None), [122, 163]);
        assert_eq!(size(&scene(30, 40), None, None), [30, 40]);
        assert_eq!(size(&scene(65536, 1), None, None), [36204, 1]);
        assert_eq!(size(&scene(300, 400), Some(60), None), [60, 80]);
        assert_eq!(size(&scene(300, 400), None, Some(40)), [30, 40]);
        assert_eq!(size(&scene(300, 400), Some(7), Some(9)), [7, 9]);
    }

    #[test]
    fn the_axes_of_the_scene_are_in_the_stage_and_the_order_is_an_option_of_every_point() {
        let axes = vec![("g".into(), "0.5".into()), ("order".into(), "single".into())];
        let setting = Setting { scene: "s".into(), axes, stage: crate::testing::stage(), orders: Some(1) };
        let point = Options::default().with("sh-order", "2");
        assert_eq!(setting.options(&point), point.with("order", "single"));
        // A dial wins: what leaving orders out costs is measured against all of them.
        assert_eq!(setting.options(&point.with("order", "all")), point.with("order", "all"));
        let other = Setting { orders: None, ..setting };
        let first = Setting { orders: Some(1), stage: crate::testing::stage(), scene: "t".into(), axes: vec![] };
        assert!(other.identity().unwrap() != first.identity().unwrap());
    }
}
