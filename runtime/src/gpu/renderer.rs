//! The calls of [`Renderer`], with the grid route, transfer and the view pass on a device.
//!
//! Decoding is the processor's, and so is the projection of light onto transfer, whose result is copied. The solution
//! at centres is the solver's, with the device's kernels ([`super::centre_solve`]). A frame comes as it was uploaded
//! ([`UploadedFrame`]). Kept until an edit makes them void: grids, planes, light of clusters, nodes of bricks and
//! backdrop on the device. So other light costs sweeps and solve, another view the volume pass and the march.

use super::centre_solve::DeviceKernels;
use super::centres::{CentrePass, DeviceCentres};
use super::device::{Gpu, GpuError};
use super::grid_solve::{DeviceGrids, GridPass, GridProblem};
use super::march::{DeviceSky, MarchPass};
use super::self_test;
use super::transfer::{DeviceLight, DeviceTransfer, TransferPass};
use super::upload::UploadedFrame;
use super::volume::DeviceVolume;
use super::volume_pass::{DeviceSource, VolumePass};
use crate::backdrop::Sky;
use crate::camera::Camera;
use crate::film::Film;
use crate::light::Light;
use crate::march::{MarchMedium, MarchSettings};
use crate::renderer::{Lit, RenderError, RenderSettings, Renderer, Seconds, Unlit};
use crate::transport::compensated::grid::route::GridTransport;
use crate::transport::medium::MediumParameters;
use glam::DVec3;
use std::sync::Arc;
use std::time::Instant;

/// Why the device makes no image.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum GpuRenderError {
    /// The input is at fault, on any device.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The device is.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

/// What solves the grid route, and computes the heavy parts of the route through centres.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SolveOn {
    /// The device.
    Device,
    /// The processor; what it finds is copied.
    Processor,
}

impl SolveOn {
    /// The faster of them: a software device is the processor, and takes twenty times as long for it.
    pub fn best(gpu: &Gpu) -> Self {
        if gpu.summary().is_software() { Self::Processor } else { Self::Device }
    }
}

/// A frame with its nodes, for which there is room from its first image on.
struct Loaded {
    frame: Arc<UploadedFrame>,
    volume: Option<DeviceVolume>,
}

impl Loaded {
    /// The frame's density, and the volume to shade.
    fn density_and_volume(&mut self, gpu: &Gpu) -> Result<(&wgpu::Buffer, &DeviceVolume), GpuError> {
        let volume = match self.volume.take() {
            Some(volume) => volume,
            None => DeviceVolume::new(gpu, Arc::clone(&self.frame.bricks))?,
        };
        Ok((&self.frame.density, self.volume.insert(volume)))
    }
}

/// What a shaded volume is marched with, and what is behind it.
type Shaded = (MarchMedium, Arc<Sky>);

/// See the module's head.
pub struct GpuRenderer {
    gpu: Arc<Gpu>,
    /// Checks, solves, and keeps what is the processor's.
    solver: Renderer,
    march: MarchPass,
    march_settings: MarchSettings,
    volume_pass: VolumePass,
    sky: Option<DeviceSky>,
    solve_on: SolveOn,
    grid_pass: GridPass,
    grids: DeviceGrids,
    /// The frame's grids of the processor, if it solves.
    transport: Option<GridTransport>,
    source: Option<DeviceSource>,
    centre_pass: CentrePass,
    centres: Option<DeviceCentres>,
    transfer_pass: TransferPass,
    transfer: Option<DeviceTransfer>,
    light: Option<DeviceLight>,
    loaded: Option<Loaded>,
    /// The eye that the volume is shaded for.
    eye: Option<DVec3>,
}

impl GpuRenderer {
    /// Checks settings and medium, compiles, and tests the device against the processor.
    pub fn new(
        gpu: Arc<Gpu>,
        settings: RenderSettings,
        medium: MediumParameters,
        lights: Vec<Light>,
        solve_on: SolveOn,
    ) -> Result<Self, GpuRenderError> {
        let mut solver = Renderer::new(settings, medium, lights)?;
        if solve_on == SolveOn::Device {
            solver.set_kernels(Arc::new(DeviceKernels::new(Arc::clone(&gpu))?));
        }
        let (march, volume_pass) = (MarchPass::new(&gpu)?, VolumePass::new(&gpu)?);
        self_test::check(&gpu, &march)?;
        let transfer_pass = TransferPass::new(&gpu)?;
        let (grid_pass, grids) = (GridPass::new(&gpu)?, DeviceGrids::default());
        let centre_pass = CentrePass::new(&gpu)?;
        Ok(Self {
            gpu,
            solver,
            march,
            march_settings: settings.march,
            volume_pass,
            sky: None,
            solve_on,
            grid_pass,
            grids,
            transport: None,
            source: None,
            centre_pass,
            centres: None,
            transfer_pass,
            transfer: None,
            light: None,
            loaded: None,
            eye: None,
        })
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Another frame, which this device holds.
    pub fn set_frame(&mut self, frame: impl Into<Arc<UploadedFrame>>) -> Result<(), RenderError> {
        let frame = frame.into();
        (self.source, self.centres, self.eye) = (None, None, None);
        (self.transfer, self.light, self.loaded) = (None, None, None);
        (self.grids, self.transport) = (DeviceGrids::default(), None);
        self.solver.set_frame(Arc::clone(&frame.frame))?;
        self.loaded = Some(Loaded { frame, volume: None });
        Ok(())
    }

    /// Other lights.
    pub fn set_lights(&mut self, lights: Vec<Light>) -> Result<(), RenderError> {
        self.unlit();
        self.solver.set_lights(lights)
    }

    /// Another medium.
    pub fn set_medium(&mut self, medium: MediumParameters) -> Result<(), RenderError> {
        self.unlit();
        self.solver.set_medium(medium)
    }

    /// Drops what depends on lights and medium.
    fn unlit(&mut self) {
        (self.sky, self.source, self.centres, self.light, self.eye) = (None, None, None, None, None);
    }

    /// The image from `camera`, and the seconds it took, copies included; empty pixels before any frame.
    pub fn render(&mut self, camera: &Camera) -> Result<(Film, Seconds), GpuRenderError> {
        let mut seconds = Seconds::default();
        let shaded = match self.shade_grid(camera, &mut seconds)? {
            Some(shaded) => Some(shaded),
            None => self.shade(camera, &mut seconds)?,
        };
        let start = Instant::now();
        let volume = self.loaded.as_ref().and_then(|loaded| loaded.volume.as_ref());
        let film = match (shaded, volume) {
            (Some((medium, sky)), Some(volume)) => {
                let sky = match self.sky.take() {
                    Some(sky) => sky,
                    None => DeviceSky::new(&self.gpu, &sky)?,
                };
                let sky = self.sky.insert(sky);
                self.march.film(&self.gpu, volume, camera, &medium, sky, &self.march_settings)?
            }
            _ => Film::new(camera.width, camera.height),
        };
        seconds.view_pass = start.elapsed().as_secs_f64();
        Ok((film, seconds))
    }

    /// The grid route up to its shaded volume; gives what is marched and what is behind it, none for other routes and
    /// before any frame.
    fn shade_grid(&mut self, camera: &Camera, seconds: &mut Seconds) -> Result<Option<Shaded>, GpuRenderError> {
        let start = Instant::now();
        let (Some(Unlit { problem, medium, sky }), Some(loaded)) = (self.solver.unlit(), &mut self.loaded) else {
            return Ok(None);
        };
        let gpu = &*self.gpu;
        let source = match self.source.take() {
            Some(source) => source,
            None if self.solve_on == SolveOn::Device => self.grid_pass.solve(gpu, &mut self.grids, &problem)?,
            None => {
                let GridProblem { field, beams, ref medium, scattering, settings } = problem;
                let transport = self.transport.get_or_insert_with(|| GridTransport::new(settings));
                DeviceSource::new(gpu, &transport.solve(field, beams, medium, scattering))?
            }
        };
        let source = self.source.insert(source);
        seconds.source_radiance = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let eye = self.eye.take().filter(|&eye| eye == camera.position || !source.depends_on_view());
        let (density, volume) = loaded.density_and_volume(gpu)?;
        if eye.is_none() {
            self.volume_pass.shade(gpu, source, (problem.field, density), volume, camera.position)?;
        }
        self.eye = Some(eye.unwrap_or(camera.position));
        seconds.volume_pass = start.elapsed().as_secs_f64();
        Ok(Some((medium, sky.clone())))
    }

    /// The same for the other routes; none before any frame.
    fn shade(&mut self, camera: &Camera, seconds: &mut Seconds) -> Result<Option<Shaded>, GpuRenderError> {
        let start = Instant::now();
        let (Some(Lit { field, source, medium, sky, .. }), Some(loaded)) = (self.solver.lit()?, &mut self.loaded)
        else {
            return Ok(None);
        };
        let gpu = &*self.gpu;
        if let (None, Some(centres)) = (&self.centres, source.as_centres()) {
            self.centres = Some(DeviceCentres::new(gpu, centres, field)?);
        }
        let transfer = source.as_transfer();
        if let (None, Some(rows)) = (&self.transfer, transfer.and(loaded.frame.rows.as_ref())) {
            self.transfer = Some(DeviceTransfer::new(gpu, Arc::clone(rows))?);
        }
        if let (None, Some(source), Some(frame)) = (&self.light, transfer, &self.transfer) {
            self.light = Some(self.transfer_pass.light(gpu, frame, source)?);
        }
        seconds.source_radiance = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let eye = self.eye.take().filter(|&eye| eye == camera.position || !source.depends_on_view());
        let (density, volume) = loaded.density_and_volume(gpu)?;
        if let (None, Some(device), Some(centres)) = (eye, &self.centres, source.as_centres()) {
            let eye = centres.unit_from_world(camera.position);
            self.centre_pass.shade(gpu, device, (field, density), volume, eye)?;
        }
        if let (None, Some(light), Some(frame)) = (eye, &self.light, &self.transfer) {
            self.transfer_pass.shade(gpu, frame, light, (field, density), volume, camera.position)?;
        }
        self.eye = Some(eye.unwrap_or(camera.position));
        seconds.volume_pass = start.elapsed().as_secs_f64();
        Ok(Some((*medium, sky.clone())))
    }
}
