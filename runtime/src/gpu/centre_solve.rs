//! The host's side of the solution at centres: `centres/depth.wgsl`, `single.wgsl` and `integral.wgsl`.
//!
//! The device's twin of the processor behind [`CentreKernels`]: the route itself is the same. On the processor stay the
//! transport matrix's rays, which goes up once a frame and extinction, harmonics of the depth and their exponentials,
//! diffusion, and the vectors of GMRES: one goes up and one comes back an iteration, a few thousand numbers each.
//! Products are f32: their rounding, some 1e-7, lies below the solve's tolerance.

use super::device::{Gpu, GpuError};
use super::layouts::{CentreDepth, CentreProduct, CentreSingle};
use super::pass::{GROUP, Kernel, Step};
use crate::medium::gaussian_points::GaussianPoints;
use crate::sphere::harmonics::BAND;
use crate::sphere::quadrature::Directions;
use crate::transport::compensated::centres::depth::DirectionalDepth;
use crate::transport::compensated::centres::integral::IntegralTransport;
use crate::transport::compensated::centres::kernels::{Attenuation, CentreKernels, KernelError, TransportMatrix};
use crate::transport::compensated::centres::single::gains;
use std::fmt::{Debug, Formatter};
use std::sync::Arc;

/// The shader of the depths, without its prelude.
pub const DEPTH: &str = concat!(
    include_str!("../transport/compensated/centres/decay.wgsl"),
    include_str!("../transport/compensated/centres/depth.wgsl")
);
/// The shader of single scattering, without its prelude.
pub const SINGLE: &str = concat!(
    include_str!("../transport/compensated/centres/decay.wgsl"),
    include_str!("../transport/compensated/centres/single.wgsl")
);
/// The shader of the products, without its prelude.
pub const PRODUCT: &str = include_str!("../transport/compensated/centres/integral.wgsl");

impl From<GpuError> for KernelError {
    fn from(error: GpuError) -> Self {
        Self(error.to_string())
    }
}

/// The heavy parts, compiled for a device.
pub struct DeviceKernels {
    gpu: Arc<Gpu>,
    depth: Kernel,
    single: Kernel,
    product: Arc<Kernel>,
}

/// A transport matrix on the device.
pub struct DeviceMatrix {
    gpu: Arc<Gpu>,
    kernel: Arc<Kernel>,
    count: usize,
    bands: usize,
    /// Planes, each with its uniform.
    planes: Vec<(wgpu::Buffer, wgpu::Buffer)>,
    sent: wgpu::Buffer,
    arrived: wgpu::Buffer,
}

impl DeviceKernels {
    /// Compiles the shaders.
    pub fn new(gpu: Arc<Gpu>) -> Result<Self, GpuError> {
        Self::from_sources(gpu, [DEPTH, SINGLE, PRODUCT])
    }

    /// From other texts of the same bindings: how a planted difference is shown to be found.
    pub fn from_sources(gpu: Arc<Gpu>, [depth, single, product]: [&str; 3]) -> Result<Self, GpuError> {
        Ok(Self {
            depth: Kernel::new(&gpu, "depths of centres", depth, "depth_along")?,
            single: Kernel::new(&gpu, "single scattering at centres", single, "attenuate_and_project")?,
            product: Arc::new(Kernel::new(&gpu, "product of centres", product, "multiply")?),
            gpu,
        })
    }
}

impl Debug for DeviceKernels {
    fn fmt(&self, f: &mut Formatter) -> std::fmt::Result {
        f.debug_struct("DeviceKernels").field("device", &self.gpu.summary().name).finish_non_exhaustive()
    }
}

impl CentreKernels for DeviceKernels {
    fn depth(&self, points: &GaussianPoints, directions: &Directions) -> Result<DirectionalDepth, KernelError> {
        const STAGE: &str = "depths of centres";
        let (n, stride, gpu) = (points.len(), directions.padded(), &*self.gpu);
        let gaussian = |h: usize| {
            let [x, y, z] = points.center_of(h);
            [x, y, z, points.radius[h]]
        };
        let gaussians: Vec<[f32; 4]> = (0..n).map(gaussian).collect();
        let along: Vec<[f32; 4]> = (0..stride).map(|q| directions.direction(q).extend(0.0).to_array()).collect();
        let uniform = CentreDepth { count: n as u32, directions: stride as u32, ..Default::default() };
        let buffers = gpu.checked(STAGE, || {
            Ok([
                gpu.uniform(STAGE, &uniform),
                gpu.upload("Gaussians", &gaussians)?,
                gpu.upload("weights of the Gaussians", &points.weight[..n])?,
                gpu.upload("directions", &along)?,
                gpu.storage("depths of the centres", 4 * (n * stride) as u64)?,
            ])
        })?;
        let bound: Vec<(u32, &wgpu::Buffer)> = (0..).zip(&buffers).collect();
        let threads = (n * stride) as u32;
        gpu.dispatch(STAGE, &[Step { kernel: &self.depth, buffers: &bound, threads }])?;
        Ok(DirectionalDepth::from_values(stride, gpu.read(STAGE, &buffers[4], n * stride)?))
    }

    fn single(&self, light: &Attenuation) -> Result<Vec<[f32; 3]>, KernelError> {
        const STAGE: &str = "single scattering at centres";
        let (n, rows, gpu) = (light.count, light.basis.rows(), &*self.gpu);
        let (bands, stride) = (rows.len(), light.radiance[0].len());
        let wide = |v: [f32; 3]| [v[0], v[1], v[2], 0.0];
        let radiance: Vec<[f32; 4]> = (0..stride).map(|q| wide([0, 1, 2].map(|c| light.radiance[c][q]))).collect();
        let by_band = [0, 1, 2].map(|c| gains(light.medium, c));
        let gains: Vec<[f32; 4]> = (0..bands).map(|k| wide(by_band.map(|gains| gains[BAND[k]]))).collect();
        let uniform = CentreSingle {
            scale: wide(light.optical_scale.map(|s| s as f32)),
            count: n as u32,
            directions: stride as u32,
            coefficients: bands as u32,
            pad_0: 0,
        };
        let buffers = gpu.checked(STAGE, || {
            Ok([
                gpu.uniform(STAGE, &uniform),
                gpu.upload("depths of the centres", light.depth.values())?,
                gpu.upload("light of the centres", &radiance)?,
                gpu.upload("basis of the centres", &rows.concat())?,
                gpu.upload("gains of the centres", &gains)?,
                gpu.storage("source radiance of the centres", 16 * (n * bands) as u64)?,
            ])
        })?;
        let bound: Vec<(u32, &wgpu::Buffer)> = (0..).zip(&buffers).collect();
        let threads = (n * bands) as u32;
        gpu.dispatch(STAGE, &[Step { kernel: &self.single, buffers: &bound, threads }])?;
        let found: Vec<[f32; 4]> = gpu.read(STAGE, &buffers[5], n * bands)?;
        Ok(found.into_iter().map(|[r, g, b, _]| [r, g, b]).collect())
    }

    fn matrix(&self, matrix: IntegralTransport) -> Result<Box<dyn TransportMatrix>, KernelError> {
        let (count, bands, gpu) = (matrix.count(), matrix.bands(), &*self.gpu);
        let bytes = 4 * (count * bands * bands) as u64;
        let uploaded = gpu.checked("transport matrix of the centres", || {
            let plane = |((a, b), values): ((usize, usize), &[f32])| {
                let uniform = CentreProduct { count: count as u32, a: a as u32, b: b as u32, pad_0: 0 };
                let values = gpu.upload("transport matrix of the centres", values)?;
                Ok((values, gpu.uniform("product of centres", &uniform)))
            };
            Ok(DeviceMatrix {
                planes: matrix.planes().map(plane).collect::<Result<_, GpuError>>()?,
                sent: gpu.storage("radiance sent", bytes)?,
                arrived: gpu.storage("radiance arrived", bytes)?,
                gpu: Arc::clone(&self.gpu),
                kernel: Arc::clone(&self.product),
                count,
                bands,
            })
        })?;
        Ok(Box::new(uploaded))
    }
}

impl Debug for DeviceMatrix {
    fn fmt(&self, f: &mut Formatter) -> std::fmt::Result {
        f.debug_struct("DeviceMatrix").field("count", &self.count).field("bands", &self.bands).finish_non_exhaustive()
    }
}

impl TransportMatrix for DeviceMatrix {
    fn count(&self) -> usize {
        self.count
    }

    fn bands(&self) -> usize {
        self.bands
    }

    fn product(&self, v: &[f64], out: &mut [f64]) -> Result<(), KernelError> {
        const STAGE: &str = "product of centres";
        let narrow: Vec<f32> = v.iter().map(|&v| v as f32).collect();
        self.gpu.queue.write_buffer(&self.sent, 0, bytemuck::cast_slice(&narrow));
        // Planes add to what is there.
        self.gpu.queue.write_buffer(&self.arrived, 0, bytemuck::cast_slice(&vec![0.0f32; v.len()]));
        let buffers: Vec<[(u32, &wgpu::Buffer); 4]> = self
            .planes
            .iter()
            .map(|(plane, uniform)| [(0, uniform), (1, plane), (2, &self.sent), (3, &self.arrived)])
            .collect();
        let threads = self.count as u32 * GROUP;
        let steps: Vec<Step> = buffers.iter().map(|buffers| Step { kernel: &self.kernel, buffers, threads }).collect();
        self.gpu.dispatch(STAGE, &steps)?;
        let found: Vec<f32> = self.gpu.read(STAGE, &self.arrived, v.len())?;
        out.iter_mut().zip(found).for_each(|(out, found)| *out = f64::from(found));
        Ok(())
    }
}
