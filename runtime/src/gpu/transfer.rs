//! The host's side of transfer: `transport/transfer/{view_directions,cells,source}.wgsl` and `product.wgsl`.
//!
//! Clusters and mixes of a frame go to the device once ([`DeviceRows`]). A change of the light uploads coefficients
//! and what suns let through ([`TransferPass::light`]); a change of the view ([`TransferPass::shade`], in
//! [`super::transfer_view`]) uploads the directions in use.
//!
//! What differs from the processor: ways from the eye are taken in f32, and sums may be fused: see
//! `tests/gpu_transfer.rs` for how far. Costs are those of [`crate::transport::transfer::source`], and a cell's moments
//! are mixed again for each view instead of being stored.

use super::device::{Gpu, GpuError};
use super::layouts::{Product, ViewDirections as ViewsUniform};
use super::pass::{Kernel, Step};
use super::transfer_rows::{DeviceClusters, DeviceRows};
use crate::transport::transfer::source::TransferSource;
use crate::transport::transfer::view_directions::squares;
use glam::Vec3;
use std::sync::Arc;

/// Clusters times a light, without the prelude.
pub const PRODUCT: &str = include_str!("../product.wgsl");
/// What directions bring into views.
pub const VIEW_DIRECTIONS: &str =
    concat!(include_str!("../tracking/phase.wgsl"), include_str!("../transport/transfer/view_directions.wgsl"));
/// Indirect light.
pub const CELLS: &str =
    concat!(include_str!("../sphere/harmonics.wgsl"), include_str!("../transport/transfer/cells.wgsl"));
/// Direct light at the nodes.
pub const SOURCE: &str =
    concat!(include_str!("../tracking/phase.wgsl"), include_str!("../transport/transfer/source.wgsl"));

/// Views whose clusters are lit at a time: with 642 directions, 10 MB of light.
const VIEWS: usize = 1024;

/// The shaders of transfer, compiled.
pub struct TransferPass {
    pub(super) multiply: Kernel,
    pub(super) weigh: Kernel,
    pub(super) scatter: Kernel,
    pub(super) send: Kernel,
    pub(super) interpolate: Kernel,
    pub(super) add_direct: Kernel,
    pub(super) add_sun: Kernel,
    pub(super) finish: Kernel,
}

/// A frame's transfer with the room that lighting it for a view takes: who draws has one of its own.
pub struct DeviceTransfer {
    pub(super) rows: Arc<DeviceRows>,
    /// What cells send towards the eye.
    pub(super) sent: wgpu::Buffer,
    /// Views at a time; the light of each direction of the mesh in them, and the clusters lit by it, set by set.
    pub(super) views: usize,
    pub(super) light: wgpu::Buffer,
    pub(super) lit: Vec<wgpu::Buffer>,
}

/// A light on the device.
pub struct DeviceLight {
    /// Irradiance from each direction of the mesh, times the albedo; none where only suns shine.
    pub(super) irradiance: Option<wgpu::Buffer>,
    /// Radiance of the direct clusters where it is the same from everywhere, set by set.
    pub(super) even: Vec<wgpu::Buffer>,
    /// Moments of the indirect clusters, set by set.
    pub(super) moments: Vec<wgpu::Buffer>,
    /// Towards each sun, its power in the channels of a transmittance, and that, a value a row.
    pub(super) suns: Vec<(Vec3, [f32; 4], wgpu::Buffer)>,
}

/// A step whose uniform is still to be bound, as number 0.
pub(super) struct Work<'a> {
    pub(super) kernel: &'a Kernel,
    pub(super) uniform: wgpu::Buffer,
    pub(super) buffers: Vec<(u32, &'a wgpu::Buffer)>,
    pub(super) threads: usize,
}

impl Work<'_> {
    fn all_buffers(&self) -> Vec<(u32, &wgpu::Buffer)> {
        [(0, &self.uniform)].into_iter().chain(self.buffers.iter().copied()).collect()
    }
}

/// Does `work` in order, as one submission.
pub(super) fn dispatch(gpu: &Gpu, stage: &'static str, work: &[Work]) -> Result<(), GpuError> {
    let buffers: Vec<Vec<(u32, &wgpu::Buffer)>> = work.iter().map(Work::all_buffers).collect();
    let steps = work.iter().zip(&buffers);
    let steps: Vec<Step> =
        steps.map(|(w, buffers)| Step { kernel: w.kernel, buffers, threads: w.threads as u32 }).collect();
    gpu.dispatch(stage, &steps)
}

impl DeviceTransfer {
    /// Room to light `rows` in.
    pub fn new(gpu: &Gpu, rows: Arc<DeviceRows>) -> Result<Self, GpuError> {
        let limit = (gpu.summary().storage_binding.min(gpu.summary().buffer)) as usize;
        let directions = rows.mesh.1;
        let widest = rows.direct.iter().map(|set| set.vectors).chain([directions]).max().unwrap_or(1);
        // All corners of the cube are the most that can be in use.
        let corners = 6 * (squares(rows.g) + 1).pow(2);
        let views = (limit / (16 * widest)).clamp(1, VIEWS).min(corners);
        let lit = |set: &DeviceClusters| gpu.storage("lit clusters", (16 * views * set.vectors) as u64);
        gpu.checked("transfer", || {
            Ok(Self {
                lit: rows.direct.iter().map(lit).collect::<Result<_, _>>()?,
                light: gpu.storage("light of the views", (16 * views * directions) as u64)?,
                sent: gpu.storage("radiance of the cells", 16 * rows.lit_cells as u64)?,
                views,
                rows,
            })
        })
    }

    /// What cells sent towards the last eye, RGB and 1: for comparisons.
    pub fn read_cells(&self, gpu: &Gpu, count: usize) -> Result<Vec<[f32; 4]>, GpuError> {
        gpu.read("radiance of the cells", &self.sent, count)
    }
}

impl DeviceLight {
    /// Lit clusters, set by set, first direct where they are the same from everywhere, then indirect: `[cluster][1 +
    /// terms]` vectors, or those for each coefficient. For comparisons.
    pub fn read(&self, gpu: &Gpu, frame: &DeviceTransfer) -> Result<Vec<Vec<[f32; 4]>>, GpuError> {
        let n = frame.rows.bands * frame.rows.bands;
        let even = self.even.iter().zip(&frame.rows.direct).map(|(buffer, set)| (buffer, set.vectors));
        let moments = self.moments.iter().zip(&frame.rows.indirect).map(|(buffer, set)| (buffer, set.vectors * n));
        even.chain(moments).map(|(buffer, count)| gpu.read("lit clusters", buffer, count)).collect()
    }
}

impl TransferPass {
    /// Compiles the shaders.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_sources(gpu, [PRODUCT, VIEW_DIRECTIONS, CELLS, SOURCE])
    }

    /// From other texts of the same bindings, in the order of [`Self::new`]: how a planted difference is shown to be
    /// found.
    pub fn from_sources(gpu: &Gpu, [product, views, cells, source]: [&str; 4]) -> Result<Self, GpuError> {
        let kernel = |text, entry| Kernel::new(gpu, "transfer", text, entry);
        Ok(Self {
            multiply: kernel(product, "multiply")?,
            weigh: kernel(views, "weigh")?,
            scatter: kernel(views, "scatter")?,
            send: kernel(cells, "send")?,
            interpolate: kernel(cells, "interpolate")?,
            add_direct: kernel(source, "add_direct")?,
            add_sun: kernel(source, "add_sun")?,
            finish: kernel(source, "finish")?,
        })
    }

    /// The clusters under the light of `source`, of the same frame as `frame`.
    pub fn light(&self, gpu: &Gpu, frame: &DeviceTransfer, source: &TransferSource) -> Result<DeviceLight, GpuError> {
        let (n, medium) = (frame.rows.bands * frame.rows.bands, &source.transfer.medium);
        let four = |v: [f32; 3]| [v[0], v[1], v[2], 0.0];
        let shines = source.irradiance.iter().any(|e| *e != [0.0; 3]);
        let scattered = |e: &[f32; 3]| four([0, 1, 2].map(|c| e[c] * medium.albedo[c]));
        let irradiance: Vec<[f32; 4]> = source.irradiance.iter().map(scattered).collect();
        let coefficients: Vec<[f32; 4]> = source.coefficients.iter().map(|s| four(s.map(|s| s as f32))).collect();
        let mut suns = Vec::new();
        for sun in &source.suns {
            for (c, transmittance) in sun.transmittance.iter().enumerate() {
                // Channels that share it come as one.
                let same = |other: usize| Arc::ptr_eq(&sun.transmittance[other], transmittance);
                if !(0..c).any(same) {
                    let power = four([0, 1, 2].map(|other| if same(other) { sun.power[other] } else { 0.0 }));
                    suns.push((sun.toward, power, gpu.upload("light of the suns", transmittance)?));
                }
            }
        }
        let room = |set: &DeviceClusters, inner: usize| gpu.storage("lit clusters", (16 * set.vectors * inner) as u64);
        let is_even = frame.rows.g == 0.0 && shines;
        let light = DeviceLight {
            irradiance: if shines { Some(gpu.upload("irradiance", &irradiance)?) } else { None },
            even: frame.rows.direct.iter().filter(|_| is_even).map(|set| room(set, 1)).collect::<Result<_, _>>()?,
            moments: frame.rows.indirect.iter().map(|set| room(set, n)).collect::<Result<_, _>>()?,
            suns,
        };
        let coefficients = gpu.upload("coefficients of the light", &coefficients)?;
        let view = gpu.upload("directions from the eye", &[[0.0f32, 0.0, 1.0, 0.0]])?;
        let mut work = Vec::new();
        if let (true, Some(irradiance)) = (is_even, &light.irradiance) {
            work.extend(self.scattered(gpu, frame, irradiance, &view, (0, 1)));
        }
        for (set, lit) in frame.rows.direct.iter().zip(&light.even) {
            work.push(self.multiplied(gpu, set, (&frame.light, 1), lit, 1));
        }
        for (set, lit) in frame.rows.indirect.iter().zip(&light.moments) {
            work.push(self.multiplied(gpu, set, (&coefficients, 1), lit, n));
        }
        dispatch(gpu, "light of the transfer", &work)?;
        Ok(light)
    }

    /// The light of each direction of the mesh in `count` of `views` from `first` on.
    pub(super) fn scattered<'a>(
        &'a self,
        gpu: &Gpu,
        frame: &'a DeviceTransfer,
        irradiance: &'a wgpu::Buffer,
        views: &'a wgpu::Buffer,
        (first, count): (usize, usize),
    ) -> [Work<'a>; 2] {
        let (mesh, directions) = (&frame.rows.mesh.0, frame.rows.mesh.1);
        let uniform = ViewsUniform {
            g: frame.rows.g,
            directions: directions as u32,
            first_view: first as u32,
            views: count as u32,
        };
        let uniform = gpu.uniform("light of the views", &uniform);
        let weigh = Work {
            kernel: &self.weigh,
            uniform: uniform.clone(),
            buffers: vec![(1, mesh), (3, views)],
            threads: count,
        };
        let buffers = vec![(1, mesh), (2, irradiance), (3, views), (4, &frame.light)];
        [weigh, Work { kernel: &self.scatter, uniform, buffers, threads: directions * count }]
    }

    /// The clusters of a set times `columns` of light.
    pub(super) fn multiplied<'a>(
        &'a self,
        gpu: &Gpu,
        set: &'a DeviceClusters,
        (light, columns): (&'a wgpu::Buffer, usize),
        lit: &'a wgpu::Buffer,
        inner: usize,
    ) -> Work<'a> {
        let rows = set.vectors * inner;
        let uniform = Product {
            channels: set.channels,
            rows: rows as u32,
            depth: (set.length / inner) as u32,
            inner: inner as u32,
            columns: columns as u32,
        };
        Work {
            kernel: &self.multiply,
            uniform: gpu.uniform("lit clusters", &uniform),
            buffers: vec![(1, &set.bases), (2, light), (3, lit)],
            threads: rows.div_ceil(4) * columns,
        }
    }
}
