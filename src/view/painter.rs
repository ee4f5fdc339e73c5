//! Pictures of a stage by one method, one pass after the other.
//!
//! A painter keeps what its renderer was last told, and tells it only what is new, so that an edit costs what it must: a
//! camera that moves is a march alone.

use crate::devices::{Device, DeviceFrame};
use crate::marcher::{Marcher, marcher};
use crate::method::Method;
use crate::staging::Stage;
use smoke_formats::scene;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::renderer::{RenderSettings, Seconds};
use smoke_runtime::transport::reference::{ReferenceSettings, trace};
use std::sync::Arc;
use std::time::Instant;

/// What the stages of a picture took, by name, in their order.
#[derive(Clone, Default)]
pub struct Stages {
    /// Wall seconds.
    pub wall: Vec<(&'static str, f64)>,
    /// Microseconds on the graphics device, where there is one and it can tell.
    pub device: Vec<(&'static str, f64)>,
}

/// Passes that the path tracer makes at once, from the first pass of a picture on: the least that give an image, then
/// more, because each call builds its tables anew.
const TRACED: [u32; 4] = [2, 2, 4, 8];

/// Stages as the panel names them.
fn wall(Seconds { source_radiance, volume_pass, view_pass }: Seconds) -> Vec<(&'static str, f64)> {
    vec![("source radiance", source_radiance), ("volume pass", volume_pass), ("view pass", view_pass)]
}

/// The name of a device, for the panel.
pub fn name_of(device: &Device) -> String {
    match device {
        Device::Cpu => {
            let threads = rayon::current_num_threads();
            format!("processor, {threads} thread{}", if threads == 1 { "" } else { "s" })
        }
        Device::Gpu(_) => device.name().to_owned(),
    }
}

/// One pass of a picture.
pub struct Pass {
    /// The image.
    pub film: Film,
    /// How many times it counts in the mean of all passes.
    pub weight: u32,
    /// What its stages took.
    pub stages: Stages,
}

/// What a renderer was last told.
struct Told {
    settings: RenderSettings,
    marcher: Box<dyn Marcher>,
    up: scene::UpAxis,
    lights: Vec<scene::Light>,
    medium: scene::Medium,
    frame: DeviceFrame,
}

/// See the module's head.
pub struct Painter {
    device: Device,
    told: Option<Told>,
}

impl Painter {
    /// A painter on a device.
    pub fn new(device: Device) -> Self {
        Self { device, told: None }
    }

    /// Pass `pass`, counted from 0, of the picture of `frame` on `stage` from `camera`. Passes of one picture differ in
    /// their random numbers alone, if the method has any.
    pub fn pass(
        &mut self,
        method: &Method,
        stage: &Stage,
        frame: &DeviceFrame,
        camera: &Camera,
        pass: u32,
    ) -> Result<Pass, String> {
        match method {
            Method::Compensated(settings) | Method::Transfer(settings) => {
                // A renderer that refused something holds a mixture: the next picture begins anew.
                let mut told = self.tell(*settings, stage, frame)?;
                let (film, seconds) = told.marcher.render(camera)?;
                let stages = Stages { wall: wall(seconds), device: told.marcher.device_microseconds() };
                self.told = Some(told);
                Ok(Pass { film, weight: 1, stages })
            }
            Method::Reference(settings) => {
                let start = Instant::now();
                let passes = TRACED[(pass as usize).min(TRACED.len() - 1)];
                let seed = settings.seed.wrapping_add(u64::from(pass));
                let settings = ReferenceSettings { target_error: 0.0, max_passes: passes, seed, ..*settings };
                let traced =
                    trace(&frame.frame().field, &stage.medium, &stage.lights, camera, &settings, &mut |_, _| {});
                let film = traced.map_err(|e| e.to_string())?.film;
                let stages = Stages { wall: vec![("trace", start.elapsed().as_secs_f64())], device: Vec::new() };
                Ok(Pass { film, weight: passes, stages })
            }
        }
    }

    fn tell(&mut self, settings: RenderSettings, stage: &Stage, frame: &DeviceFrame) -> Result<Told, String> {
        let scene = &stage.scene;
        let Some(mut told) = self.told.take().filter(|told| told.settings == settings) else {
            let mut marcher = marcher(&self.device, settings, stage)?;
            marcher.set_frame(frame.clone())?;
            let (lights, medium) = (scene.lights.clone(), scene.medium.clone());
            return Ok(Told { settings, marcher, up: scene.up, lights, medium, frame: frame.clone() });
        };
        if told.medium != scene.medium {
            told.marcher.set_medium(stage.medium)?;
            told.medium = scene.medium.clone();
        }
        if told.lights != scene.lights || told.up != scene.up {
            told.marcher.set_lights(stage.lights.clone())?;
            (told.lights, told.up) = (scene.lights.clone(), scene.up);
        }
        if !Arc::ptr_eq(told.frame.frame(), frame.frame()) {
            told.marcher.set_frame(frame.clone())?;
            told.frame = frame.clone();
        }
        Ok(told)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{devices, small_pack, stage};
    use smoke_formats::pack::Pack;
    use smoke_formats::scene::{Camera as SceneCamera, Light as SceneLight, Scene, Sky};
    use smoke_runtime::medium::frame::Frame;

    fn stage_of(scene: Scene) -> Stage {
        Stage::with(scene, &mut |_| unreachable!("no images")).unwrap()
    }

    fn scene() -> Scene {
        let mut scene = stage().scene;
        scene.camera =
            SceneCamera { position: [7.0, -6.0, 3.5], target: [7.0, 1.7, 3.5], up: [0.0, 0.0, 1.0], fov_degrees: 30.0 };
        let sky = Sky::Color([1.0, 0.5, 0.25]);
        scene.lights = vec![SceneLight::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: false }];
        scene
    }

    #[test]
    fn after_any_edits_a_picture_is_the_one_that_a_new_painter_makes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.smoke");
        small_pack(&path, &[1, 2], 0.01);
        let pack = Pack::open(&path).unwrap();
        let frames = [0, 1].map(|i| Arc::new(Frame::read(&pack, i).unwrap()));
        let mut edits: Vec<(Scene, usize)> = vec![(scene(), 0)];
        let mut edit = |frame, change: &dyn Fn(&mut Scene)| {
            let mut scene = edits.last().unwrap().0.clone();
            change(&mut scene);
            edits.push((scene, frame));
        };
        edit(0, &|s| s.medium.sigma_t = [3.0, 2.0, 1.0]);
        edit(1, &|s| s.camera.position = [6.0, -5.0, 4.0]);
        edit(1, &|s| {
            s.lights.push(SceneLight::Directional { direction: [1.0, 0.3, -0.4], irradiance: [3.0, 2.0, 1.0] });
        });
        edit(0, &|s| (s.medium.albedo, s.medium.g) = ([0.5; 3], 0.4));
        let method = Method::Compensated(RenderSettings::default());
        for device in devices() {
            let frames = frames.each_ref().map(|frame| device.take(frame.clone()).unwrap());
            let mut painter = Painter::new(device.clone());
            let mut before: Option<Film> = None;
            for (scene, frame) in &edits {
                let stage = stage_of(scene.clone());
                let film = |p: &mut Painter| p.pass(&method, &stage, &frames[*frame], &stage.camera, 0).unwrap().film;
                let edited = film(&mut painter);
                assert_eq!(edited, film(&mut Painter::new(device.clone())));
                assert!(before.as_ref() != Some(&edited), "each edit shows");
                before = Some(edited);
            }
        }
    }

    #[test]
    fn a_refusal_is_said_and_the_next_picture_is_right_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.smoke");
        small_pack(&path, &[1], 0.01);
        let frame = DeviceFrame::Cpu(Arc::new(Frame::read(&Pack::open(&path).unwrap(), 0).unwrap()));
        let method = Method::Compensated(RenderSettings::default());
        let (good, mut bad) = (stage_of(scene()), scene());
        bad.lights.push(SceneLight::Point { position: [0.0; 3], intensity: [1.0; 3] });
        let bad = stage_of(bad);
        let mut painter = Painter::new(Device::Cpu);
        let first = painter.pass(&method, &good, &frame, &good.camera, 0).unwrap().film;
        let error = painter.pass(&method, &bad, &frame, &bad.camera, 0).map(|_| ()).unwrap_err();
        assert!(error.contains("light[1]: found a point"), "{error}");
        assert_eq!(painter.pass(&method, &good, &frame, &good.camera, 0).unwrap().film, first);
        let method = Method::Reference(ReferenceSettings::default());
        let traced = painter.pass(&method, &bad, &frame, &bad.camera, 3).unwrap();
        assert_eq!((traced.weight, traced.film.pixels.len()), (8, 48));
    }
}
