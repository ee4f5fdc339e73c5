//! The grid route on the device, from beams to planes of source radiance: nothing but a column of numbers an iteration
//! comes back to the host.
//!
//! The twin of [`crate::transport::compensated::grid::route`], whose choices it shares ([`Plan`]). Grids are kept for
//! the frame; a change of the light or the medium costs sweeps and solve.

use super::device::{Gpu, GpuError};
use super::gmres::GmresPass;
use super::planes::Planes;
use super::scatter::ScatterPass;
use super::single::SinglePass;
use super::sweep_grid::DeviceSweepGrid;
use super::transfer::dispatch;
use super::volume_pass::{DeviceLayer, DeviceSource};
use crate::light::Beam;
use crate::medium::field::DensityField;
use crate::transport::ScatteringOrder;
use crate::transport::compensated::grid::route::{GridSettings, Plan, gain, ordinates, weighted};
use crate::transport::medium::BandedMedium;

/// The grid route, compiled.
pub struct GridPass {
    /// Single scattering.
    pub single: SinglePass,
    /// The gather of multiple scattering.
    pub scatter: ScatterPass,
    /// Its iteration.
    pub gmres: GmresPass,
}

/// One frame on the grids that sweeps need, by their spacing in voxels.
#[derive(Default)]
pub struct DeviceGrids(Vec<(usize, DeviceSweepGrid)>);

/// What is lit, and how.
#[derive(Clone, Copy, Debug)]
pub struct GridProblem<'a> {
    /// The frame's density.
    pub field: &'a DensityField,
    /// Its lights.
    pub beams: &'a [Beam],
    /// The medium whose phase function has as many bands as are solved for.
    pub medium: BandedMedium,
    /// Orders of scattering.
    pub scattering: ScatteringOrder,
    /// The dials.
    pub settings: GridSettings,
}

impl DeviceGrids {
    fn grid(&mut self, gpu: &Gpu, field: &DensityField, step: usize) -> Result<&DeviceSweepGrid, GpuError> {
        let at = match self.0.iter().position(|(s, _)| *s == step) {
            Some(at) => at,
            None => {
                self.0.push((step, DeviceSweepGrid::new(gpu, &field.coarsened(step))?));
                self.0.len() - 1
            }
        };
        Ok(&self.0[at].1)
    }
}

impl GridPass {
    /// Compiles the shaders.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Ok(Self { single: SinglePass::new(gpu)?, scatter: ScatterPass::new(gpu)?, gmres: GmresPass::new(gpu)? })
    }

    /// Solves for the source radiance; `grids` are those of the same frame in every call.
    pub fn solve(&self, gpu: &Gpu, grids: &mut DeviceGrids, problem: &GridProblem) -> Result<DeviceSource, GpuError> {
        gpu.checked("source radiance", || self.solved(gpu, grids, problem))
    }

    fn solved(&self, gpu: &Gpu, grids: &mut DeviceGrids, problem: &GridProblem) -> Result<DeviceSource, GpuError> {
        let GridProblem { field, beams, ref medium, scattering, settings } = *problem;
        let Plan { bands, channels, single_step, multiple } = Plan::new(&settings, field, beams, medium, scattering);
        let sigma_t = &medium.sigma_t[..channels];
        let grid = grids.grid(gpu, field, single_step)?;
        let planes =
            self.single.source_radiance(gpu, grid, &weighted(beams, medium, (bands, channels)), sigma_t, false)?;
        let mut out = DeviceSource::of_layer(channels, DeviceLayer::new(single_step, grid.dims, channels, planes));
        let Some((step, bands)) = multiple else { return Ok(out) };
        let grid = grids.grid(gpu, field, step)?;
        let weighted = weighted(beams, medium, (bands, channels));
        let first = self.single.source_radiance(gpu, grid, &weighted, sigma_t, true)?;
        let count = first.count();
        let all = Planes::new(gpu, "unknowns of multiple scattering", count, grid.near.len())?;
        let ordinates = ordinates(settings.rings, bands);
        let gather = self.scatter.gather(gpu, grid, &ordinates, sigma_t, |plane| -gain(medium, channels, plane))?;
        // The first guess is light that was scattered once.
        self.gmres.add(gpu, &all, 0.0, 1.0, &first)?;
        let solved = self.gmres.solve(gpu, &gather, &first, &all, settings.tolerance, settings.iterations)?;
        self.gmres.add(gpu, &all, 1.0, -1.0, &first)?;
        let planes = Planes::new(gpu, "planes of source radiance", count, grid.nodes())?;
        dispatch(gpu, "multiple scattering", &self.scatter.spread(gpu, grid, &all, &planes))?;
        (out.iterations, out.residual) = (solved.iterations, solved.residual);
        out.layers.push(DeviceLayer::new(step, grid.dims, channels, planes));
        Ok(out)
    }
}
