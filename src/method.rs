//! The methods that `render` and its kin make images by, treated alike: options in, a frame's image and its story out.

use crate::cli::{MethodChoice, RenderArgs};
use crate::devices::{Device, DeviceFrame};
use crate::failure::Failure;
use crate::marcher::{Marcher, marcher};
use crate::staging::Stage;
use crate::{compensated, plan, reference, transfer};
use clap::error::ErrorKind;
use serde_json::{Value, json};
use smoke_formats::pack::Pack;
use smoke_runtime::film::Film;
use smoke_runtime::light::Light;
use smoke_runtime::plan::choose::Settings;
use smoke_runtime::renderer::{RenderSettings, Route, Seconds};
use smoke_runtime::transport::reference::{ReferenceSettings, trace};
use std::time::Instant;

/// A method with its settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Method {
    /// Source radiance and a march.
    Compensated(RenderSettings),
    /// The same march, with source radiance from baked transfer.
    Transfer(RenderSettings),
    /// Path tracing.
    Reference(ReferenceSettings),
}

/// A method ready for frames of one scene.
pub enum Maker<'a> {
    /// Keeps what frames have in common.
    Marched(Box<dyn Marcher>, &'a Stage),
    /// Keeps nothing.
    Reference(ReferenceSettings, &'a Stage),
}

/// One frame's image.
pub struct Image {
    /// The pixels.
    pub film: Film,
    /// Standard error of each pixel's radiance, where the image is an estimate.
    pub standard_error: Option<Vec<[f32; 3]>>,
    /// Wall seconds of each stage, by name.
    pub seconds: Vec<(&'static str, f64)>,
    /// Microseconds of the stages on a graphics device, where there is one and it can tell.
    pub device_microseconds: Vec<(&'static str, f64)>,
    /// Further figures for `--json`.
    pub figures: Value,
}

/// Refuses an option that the choice of another makes void.
pub fn does_not_apply(given: bool, option: &str, with: &str) -> Result<(), clap::Error> {
    match given {
        true => Err(clap::Error::raw(
            ErrorKind::ArgumentConflict,
            format!("{option} does not apply to {with}; leave it out, or change the other\n"),
        )),
        false => Ok(()),
    }
}

impl Method {
    /// The method that the options ask for, without a plan: where they leave it open, the fast method as it is by default,
    /// or the reference if a light of `stage` needs it.
    pub fn choose(args: &RenderArgs, stage: &Stage) -> Result<Self, Failure> {
        let point = stage.lights.iter().any(|light| matches!(light, Light::Point { .. }));
        match args.method {
            MethodChoice::Reference => Self::traced(args, ReferenceSettings::default()),
            MethodChoice::Transfer => transfer::settings(args).map(Self::Transfer),
            MethodChoice::Auto if point => Self::traced(args, ReferenceSettings::default()),
            MethodChoice::Auto | MethodChoice::Compensated => Self::marched(args, RenderSettings::default()),
        }
    }

    /// The same by the plan for the whole of `pack`, whichever frames are rendered; and a line that tells what the plan
    /// chose, if it had to choose.
    pub fn planned(args: &RenderArgs, stage: &Stage, pack: &Pack) -> Result<(Self, Option<String>), Failure> {
        if args.method != MethodChoice::Auto {
            let with = "a --method other than auto";
            does_not_apply(args.error.is_some(), "--error", with)?;
            does_not_apply(args.time.is_some(), "--time", with)?;
            return Ok((Self::choose(args, stage)?, None));
        }
        let goal = plan::goal(args.error, args.time);
        let plan = plan::of_pack(pack, None, stage, goal, args.threads)?.plan;
        let method = match plan.settings {
            Settings::Compensated(settings) => Self::marched(args, settings)?,
            Settings::Reference { target_error } => {
                Self::traced(args, ReferenceSettings { target_error, ..ReferenceSettings::default() })?
            }
        };
        Ok((method, Some(plan.sentence())))
    }

    /// The method of these dials.
    pub fn of(settings: RenderSettings) -> Self {
        match settings.route {
            Route::Transfer(_) => Self::Transfer(settings),
            Route::Grid(_) | Route::Centres(_) => Self::Compensated(settings),
        }
    }

    fn marched(args: &RenderArgs, base: RenderSettings) -> Result<Self, Failure> {
        compensated::settings(args, &base).map(Self::Compensated)
    }

    fn traced(args: &RenderArgs, base: ReferenceSettings) -> Result<Self, Failure> {
        reference::settings(args, &base).map(Self::Reference)
    }

    /// Name and settings, as an image's metadata has them.
    pub fn document(&self) -> Value {
        match self {
            Self::Compensated(settings) | Self::Transfer(settings) => compensated::document(settings),
            Self::Reference(settings) => reference::document(settings),
        }
    }

    /// Ready for frames under the lights and medium of `stage`, on `device`.
    pub fn maker<'a>(&self, stage: &'a Stage, device: &Device) -> Result<Maker<'a>, String> {
        Ok(match (self, device) {
            (Self::Compensated(settings) | Self::Transfer(settings), device) => {
                Maker::Marched(marcher(device, *settings, stage)?, stage)
            }
            (Self::Reference(settings), Device::Cpu) => Maker::Reference(*settings, stage),
            #[cfg(feature = "gpu")]
            (Self::Reference(_), Device::Gpu(_)) => {
                return Err("method: found reference, expected another on a graphics device; use --device cpu".into());
            }
        })
    }
}

impl Maker<'_> {
    /// The image of `frame`; `done` is told which part of it is finished, from 0 to 1.
    pub fn image(&mut self, frame: DeviceFrame, done: &mut dyn FnMut(f64)) -> Result<Image, String> {
        let start = Instant::now();
        match self {
            Self::Marched(marcher, stage) => {
                marcher.set_frame(frame)?;
                let prepared = start.elapsed().as_secs_f64();
                let (film, Seconds { source_radiance, volume_pass, view_pass }) = marcher.render(&stage.camera)?;
                // What a frame takes to be taken up is part of its solution.
                let source_radiance = source_radiance + prepared;
                let seconds =
                    vec![("source_radiance", source_radiance), ("volume_pass", volume_pass), ("view_pass", view_pass)];
                let device_microseconds = marcher.device_microseconds();
                Ok(Image { film, standard_error: None, seconds, device_microseconds, figures: json!({}) })
            }
            Self::Reference(settings, stage) => {
                let mut on_pass = |passes, error| done(reference::part_done(settings, passes, error));
                let Stage { medium, lights, camera, .. } = stage;
                let traced = trace(&frame.frame().field, medium, lights, camera, settings, &mut on_pass);
                let traced = traced.map_err(|e| e.to_string())?;
                let figures = reference::figures(&traced);
                let seconds = vec![("trace", start.elapsed().as_secs_f64())];
                let (film, standard_error) = (traced.film, Some(traced.standard_error));
                Ok(Image { film, standard_error, seconds, device_microseconds: Vec::new(), figures })
            }
        }
    }
}
