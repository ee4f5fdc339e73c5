//! Frame, lights, medium and camera in, image and seconds out.
//!
//! Everything that was computed is kept with what it was computed from, and an edit drops only what depends on it: a new
//! camera marches again (and shades again if the phase function is not isotropic), new lights or a new medium solve again
//! on the same grids or depths. Nothing of an earlier result goes into a later one, so a frame is the same to the bit
//! alone, in a sequence, and after any edits that end in the same place.

use crate::backdrop::Sky;
use crate::camera::Camera;
use crate::film::Film;
#[cfg(feature = "gpu")]
use crate::gpu::grid_solve::GridProblem;
use crate::light::{Beam, Light, beams};
use crate::march::{MarchMedium, MarchSettings, march};
use crate::medium::field::DensityField;
use crate::medium::frame::Frame;
use crate::shaded_volume::ShadedVolume;
use crate::transport::compensated::centres::incident::incident;
use crate::transport::compensated::centres::kernels::{CentreKernels, Processor};
use crate::transport::compensated::centres::route::{CentreError, CentreSettings, CentreTransport, MultipleScattering};
use crate::transport::compensated::centres::source::{CentreSource, UnitPlacement};
use crate::transport::compensated::grid::route::{GridSettings, GridTransport};
use crate::transport::medium::{BandedMedium, MediumError, MediumParameters};
use crate::transport::transfer::source::{TransferError, TransferSettings, TransferTransport};
use crate::transport::{ScatteringOrder, SourceRadiance};
use glam::DVec3;
use std::sync::Arc;
use std::time::Instant;

/// Where the source radiance is solved.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Route {
    /// On grid nodes: the default.
    Grid(GridSettings),
    /// At the Gaussians' centres, as the paper does. The order is that of [`RenderSettings`], and single scattering
    /// alone has no multiple scattering, whatever these settings say.
    Centres(CentreSettings),
    /// From the transfer that was baked for the frame (Zhang et al. 2013): any light, but one medium.
    Transfer(TransferSettings),
}

/// The dials of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RenderSettings {
    /// Where the source radiance is solved.
    pub route: Route,
    /// Bands of the spherical harmonics of the phase function and the source radiance, 1 to 6.
    pub sh_order: usize,
    /// Orders of scattering.
    pub scattering: ScatteringOrder,
    /// The march.
    pub march: MarchSettings,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            route: Route::Grid(GridSettings::default()),
            sh_order: 4,
            scattering: ScatteringOrder::All,
            march: MarchSettings::default(),
        }
    }
}

/// Rays of one direction that the grid route carries at most: the cross-section of the sheared box. 2^24 rays of nine
/// values are 600 MB, and allow a cube of 2,000 nodes a side or a column of 4,000 by 50 by 50.
const MOST_RAYS: usize = 1 << 24;

/// Why an image cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// A medium parameter out of range.
    #[error(transparent)]
    Medium(#[from] MediumError),
    /// The centres' route refuses its input.
    #[error(transparent)]
    Centres(#[from] CentreError),
    /// The transfer is none of this frame's density.
    #[error(transparent)]
    Transfer(#[from] TransferError),
    /// The frame has no transfer.
    #[error("the frame has no transfer, expected one; bake the sequence with --transfer")]
    NoTransfer,
    /// The transfer belongs to another medium.
    #[error(
        "medium.{name}: found {found}, expected {baked}, which the transfer was baked for; render with another method, or bake it for this medium"
    )]
    OtherMedium {
        /// Which parameter.
        name: &'static str,
        /// What the scene asks for.
        found: String,
        /// What was baked.
        baked: String,
    },
    /// The centres' route needs Gaussians that are round in the world.
    #[error(
        "the map from voxels to the world stretches or shears, expected a uniform scale for the route through centres; use the grid route"
    )]
    NotUniform,
    /// The centres' route needs Gaussians.
    #[error(
        "the frame has density but no Gaussians, expected at least 1 for the route through centres; use the grid route"
    )]
    NoGaussians,
    /// A direction's rays through the grid would not fit into memory.
    #[error(
        "the frame's box of {dims:?} nodes is too long and thin for the grid route, expected (a + b) (a + c) of its sides to be at most {MOST_RAYS}; use the route through centres, or bake the far parts apart"
    )]
    TooLong {
        /// Sides of the frame's field.
        dims: [usize; 3],
    },
    /// Source radiance is solved for light from infinity only.
    #[error(
        "light[{index}]: found a point, expected environment or directional: this method is for light from infinity only; use --method reference"
    )]
    PointLight {
        /// Which of the lights, from 0.
        index: usize,
    },
    /// A setting out of range.
    #[error("{name}: found {found}, expected {expected}")]
    Setting {
        /// Which one.
        name: &'static str,
        /// Its value.
        found: String,
        /// The legal values.
        expected: &'static str,
    },
}

/// Wall seconds of the stages of one image; zero for what was still valid.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Seconds {
    /// Density and lights to source radiance.
    pub source_radiance: f64,
    /// Source radiance to the nodes, for the eye.
    pub volume_pass: f64,
    /// The march.
    pub view_pass: f64,
}

/// The frame with what depends on it alone.
struct Loaded {
    frame: Arc<Frame>,
    transport: Transport,
    /// Its bricks; made for the first image.
    volume: Option<ShadedVolume>,
}

enum Transport {
    Grid(GridTransport),
    Centres(Box<CentreTransport>, UnitPlacement),
    Transfer(Box<TransferTransport>),
}

/// See the module's head.
pub struct Renderer {
    settings: RenderSettings,
    /// Who computes the heavy parts of the route through centres.
    kernels: Arc<dyn CentreKernels>,
    medium: MediumParameters,
    lights: Vec<Light>,
    /// The lights as beams, for the grid route.
    beams: Option<Vec<Beam>>,
    sky: Option<Arc<Sky>>,
    loaded: Option<Loaded>,
    source: Option<(Box<dyn SourceRadiance>, MarchMedium)>,
    /// The eye that the frame's volume is shaded for.
    shaded: Option<DVec3>,
}

impl Renderer {
    /// Checks settings and medium. There is nothing to see before [`Self::set_frame`].
    pub fn new(settings: RenderSettings, medium: MediumParameters, lights: Vec<Light>) -> Result<Self, RenderError> {
        medium.check()?;
        check(&settings)?;
        check_lights(&lights)?;
        let (beams, sky, loaded, source, shaded) = (None, None, None, None, None);
        Ok(Self { settings, kernels: Arc::new(Processor), medium, lights, beams, sky, loaded, source, shaded })
    }

    /// Other kernels for the frames to come.
    #[cfg(feature = "gpu")]
    pub(crate) fn set_kernels(&mut self, kernels: Arc<dyn CentreKernels>) {
        self.kernels = kernels;
    }

    /// Another frame.
    pub fn set_frame(&mut self, frame: impl Into<Arc<Frame>>) -> Result<(), RenderError> {
        let frame = frame.into();
        (self.source, self.shaded, self.loaded) = (None, None, None);
        let transport = match self.settings.route {
            Route::Grid(settings) => {
                check_box(frame.field.dims)?;
                Transport::Grid(GridTransport::new(settings))
            }
            Route::Centres(settings) => {
                let placement = UnitPlacement::of(&frame).ok_or(RenderError::NotUniform)?;
                if frame.gaussians.is_empty() && frame.field.max() > 0.0 {
                    return Err(RenderError::NoGaussians);
                }
                let multiple = match self.settings.scattering {
                    ScatteringOrder::Single => MultipleScattering::None,
                    ScatteringOrder::All => settings.multiple,
                };
                let settings = CentreSettings { order: self.settings.sh_order, multiple, ..settings };
                let kernels = Arc::clone(&self.kernels);
                let transport = CentreTransport::with_kernels(&frame.gaussians, settings, kernels)?;
                Transport::Centres(Box::new(transport), placement)
            }
            Route::Transfer(settings) => {
                check_box(frame.field.dims)?;
                let transfer = frame.transfer.clone().ok_or(RenderError::NoTransfer)?;
                check_medium(&self.medium, &transfer.medium)?;
                Transport::Transfer(Box::new(TransferTransport::new(&frame.field, transfer, settings)?))
            }
        };
        self.loaded = Some(Loaded { frame, transport, volume: None });
        Ok(())
    }

    /// Other lights.
    pub fn set_lights(&mut self, lights: Vec<Light>) -> Result<(), RenderError> {
        check_lights(&lights)?;
        self.lights = lights;
        (self.beams, self.sky, self.source, self.shaded) = (None, None, None, None);
        Ok(())
    }

    /// Another medium.
    pub fn set_medium(&mut self, medium: MediumParameters) -> Result<(), RenderError> {
        medium.check()?;
        self.medium = medium;
        (self.sky, self.source, self.shaded) = (None, None, None);
        Ok(())
    }

    /// The image from `camera`, and the seconds it took; an image of empty pixels before any frame.
    pub fn render(&mut self, camera: &Camera) -> Result<(Film, Seconds), RenderError> {
        let mut seconds = Seconds::default();
        let start = Instant::now();
        let Some(lit) = self.lit()? else {
            return Ok((Film::new(camera.width, camera.height), seconds));
        };
        lit.source.prepare();
        seconds.source_radiance = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let still_good = |eye: DVec3| eye == camera.position || !lit.source.depends_on_view();
        let volume = lit.volume.get_or_insert_with(|| ShadedVolume::of(lit.field));
        if !lit.shaded.is_some_and(still_good) {
            lit.source.shade(lit.field, camera.position, volume);
            *lit.shaded = Some(camera.position);
        }
        seconds.volume_pass = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let film = march(volume, camera, lit.medium, &**lit.sky, lit.march);
        seconds.view_pass = start.elapsed().as_secs_f64();
        Ok((film, seconds))
    }

    /// What the grid route is to solve, and what its passes need, for the device. None before any frame, and for other routes.
    #[cfg(feature = "gpu")]
    pub(crate) fn unlit(&mut self) -> Option<Unlit<'_>> {
        let (Some(loaded), Route::Grid(settings)) = (&self.loaded, self.settings.route) else { return None };
        let beams = self.beams.get_or_insert_with(|| beams(&self.lights, settings.beams)).as_slice();
        let (banded, medium) = grid_medium(&self.medium, &self.settings);
        let sky = sky(&mut self.sky, &self.lights, &medium, (self.medium.g, self.settings.sh_order));
        let (field, scattering) = (&loaded.frame.field, self.settings.scattering);
        Some(Unlit { problem: GridProblem { field, beams, medium: banded, scattering, settings }, medium, sky })
    }

    /// Solves for the source radiance, if an edit has dropped it. None before any frame.
    pub(crate) fn lit(&mut self) -> Result<Option<Lit<'_>>, RenderError> {
        let Some(loaded) = &mut self.loaded else { return Ok(None) };
        if self.source.is_none() {
            let beams = match self.settings.route {
                Route::Grid(grid) => self.beams.get_or_insert_with(|| beams(&self.lights, grid.beams)).as_slice(),
                Route::Centres(_) | Route::Transfer(_) => &[],
            };
            self.source = Some(solve(loaded, &self.settings, &self.medium, &self.lights, beams)?);
        }
        let Some((source, medium)) = &self.source else { return Ok(None) };
        let sky = sky(&mut self.sky, &self.lights, medium, (self.medium.g, self.settings.sh_order));
        let (field, volume, march) = (&loaded.frame.field, &mut loaded.volume, &self.settings.march);
        let shaded = &mut self.shaded;
        Ok(Some(Lit { field, volume, shaded, source: source.as_ref(), medium, sky, march }))
    }
}

/// A frame before it is lit.
#[cfg(feature = "gpu")]
pub(crate) struct Unlit<'a> {
    pub(crate) problem: GridProblem<'a>,
    pub(crate) medium: MarchMedium,
    pub(crate) sky: &'a Arc<Sky>,
}

/// A frame under its lights: what the passes after the solution need.
pub(crate) struct Lit<'a> {
    pub(crate) field: &'a DensityField,
    pub(crate) volume: &'a mut Option<ShadedVolume>,
    /// The eye that the volume is shaded for, if it is.
    pub(crate) shaded: &'a mut Option<DVec3>,
    pub(crate) source: &'a dyn SourceRadiance,
    pub(crate) medium: &'a MarchMedium,
    pub(crate) sky: &'a Arc<Sky>,
    pub(crate) march: &'a MarchSettings,
}

/// The medium that the grid route solves for, and the one that is marched with it.
fn grid_medium(medium: &MediumParameters, settings: &RenderSettings) -> (BandedMedium, MarchMedium) {
    let banded = match settings.scattering {
        ScatteringOrder::Single => medium.windowed(settings.sh_order),
        ScatteringOrder::All => medium.banded(settings.sh_order),
    };
    (banded, MarchMedium::of(medium.sigma_t, banded.sigma_t))
}

/// The sky behind the medium, made if it is not there; `peak` is its forward peak, if the march takes one out.
fn sky<'a>(sky: &'a mut Option<Arc<Sky>>, lights: &[Light], medium: &MarchMedium, peak: (f32, usize)) -> &'a Arc<Sky> {
    let peak = (medium.peak_ratio != [1.0; 3]).then_some(peak);
    sky.get_or_insert_with(|| Arc::new(Sky::new(lights, peak)))
}

fn solve(
    loaded: &mut Loaded,
    settings: &RenderSettings,
    medium: &MediumParameters,
    lights: &[Light],
    beams: &[Beam],
) -> Result<(Box<dyn SourceRadiance>, MarchMedium), RenderError> {
    let Loaded { frame, transport, .. } = loaded;
    Ok(match transport {
        Transport::Grid(transport) => {
            let (banded, marched) = grid_medium(medium, settings);
            let source = transport.solve(&frame.field, beams, &banded, settings.scattering);
            (Box::new(source), marched)
        }
        Transport::Centres(transport, placement) => {
            let light = incident(lights, transport.directions(), transport.rings(), placement.rotation);
            let radiance = transport.radiance(medium, placement.length_world as f32, &light, None)?;
            let marched = MarchMedium::of(medium.sigma_t, radiance.sigma_t);
            (Box::new(CentreSource::new(transport.points().clone(), radiance, frame, *placement)), marched)
        }
        Transport::Transfer(transport) => {
            let transfer = frame.transfer.as_ref().ok_or(RenderError::NoTransfer)?;
            check_medium(medium, &transfer.medium)?;
            let source = transport.project(&frame.field, lights, settings.scattering);
            (Box::new(source), MarchMedium::plain(medium.sigma_t))
        }
    })
}

/// Refuses a box of nodes that is too long and thin for the grid route.
pub(crate) fn check_box(dims: [usize; 3]) -> Result<(), RenderError> {
    let [nx, ny, nz] = dims;
    let rays = [(nx, ny, nz), (ny, nx, nz), (nz, nx, ny)].map(|(a, b, c)| (a + b) * (a + c));
    match rays.iter().all(|&rays| rays <= MOST_RAYS) {
        true => Ok(()),
        false => Err(RenderError::TooLong { dims }),
    }
}

/// Refuses a medium that transfer was not baked for.
pub(crate) fn check_medium(asked: &MediumParameters, baked: &MediumParameters) -> Result<(), RenderError> {
    let colours = |name, asked: [f32; 3], baked: [f32; 3]| match asked == baked {
        true => Ok(()),
        false => Err(RenderError::OtherMedium { name, found: format!("{asked:?}"), baked: format!("{baked:?}") }),
    };
    colours("sigma_t", asked.sigma_t, baked.sigma_t)?;
    colours("albedo", asked.albedo, baked.albedo)?;
    match asked.g == baked.g {
        true => Ok(()),
        false => Err(RenderError::OtherMedium { name: "g", found: asked.g.to_string(), baked: baked.g.to_string() }),
    }
}

fn check_lights(lights: &[Light]) -> Result<(), RenderError> {
    let point = lights.iter().position(|light| matches!(light, Light::Point { .. }));
    point.map_or(Ok(()), |index| Err(RenderError::PointLight { index }))
}

fn check(settings: &RenderSettings) -> Result<(), RenderError> {
    let setting = |good: bool, name, found: String, expected| match good {
        true => Ok(()),
        false => Err(RenderError::Setting { name, found, expected }),
    };
    let march = settings.march;
    setting((1..=6).contains(&settings.sh_order), "SH order", settings.sh_order.to_string(), "1 to 6")?;
    let step = march.step == 0.0 || (1.0 / 64.0..=4.0).contains(&march.step);
    setting(step, "march step", march.step.to_string(), "1/64 to 4 voxels, or 0 to choose")?;
    setting((0.0..1.0).contains(&march.cutoff), "cutoff", march.cutoff.to_string(), "0 to below 1")?;
    setting((1..=64).contains(&march.samples), "samples", march.samples.to_string(), "1 to 64")?;
    if let Route::Grid(grid) = settings.route {
        setting((1..=65536).contains(&grid.beams), "beams", grid.beams.to_string(), "1 to 65536")?;
    }
    Ok(())
}
