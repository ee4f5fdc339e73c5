//! The host's side of transfer: `transport/transfer/{view_directions,cells,source}.wgsl` and `product.wgsl`.
//!
//! Clusters and mixes of a frame go to the device once ([`DeviceTransfer`]). A change of the light uploads coefficients
//! and what suns let through ([`TransferPass::light`]); a change of the view uploads the directions in use
//! ([`TransferPass::shade`]), a few kB that the processor finds from the bricks' corners. Directions are done as many at a
//! time as fit, and rows of mixes as many as a shader may see: nodes add up.
//!
//! What differs from the processor: ways from the eye are taken in f32, and sums may be fused: see `tests/gpu_transfer.rs`
//! for how far. Costs are those of [`crate::transport::transfer::source`], and a cell's moments are mixed again for each
//! view instead of being stored.

use super::device::{Gpu, GpuError};
use super::layouts::{Cells as CellsUniform, Product, Transfer as TransferUniform, ViewDirections as ViewsUniform};
use super::pass::{Kernel, Step};
use super::volume::{DeviceVolume, PAGES};
use crate::medium::field::DensityField;
use crate::shaded_volume::{BRICK, BRICK_NODES, EMPTY};
use crate::transport::transfer::frame::Clustered;
use crate::transport::transfer::source::TransferSource;
use crate::transport::transfer::view_directions::{ViewDirections, squares};
use glam::{DVec3, Vec3};
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
    multiply: Kernel,
    scatter: Kernel,
    send: Kernel,
    interpolate: Kernel,
    add_direct: Kernel,
    add_sun: Kernel,
    finish: Kernel,
}

/// Clustered rows on the device, and the colour channels that they are for.
struct DeviceClusters {
    channels: [f32; 4],
    /// Means and directions of all clusters.
    vectors: usize,
    terms: usize,
    length: usize,
    bases: wgpu::Buffer,
    /// The first row, how many, and `array<u32>`: for each its cluster, then the bits of its weights.
    mixes: Vec<(usize, usize, wgpu::Buffer)>,
}

/// What a frame's transfer is on the device, whatever light and view.
pub struct DeviceTransfer {
    g: f32,
    bands: usize,
    cells: [usize; 3],
    side: usize,
    /// Directions of the mesh, and how many.
    mesh: (wgpu::Buffer, usize),
    direct: Vec<DeviceClusters>,
    indirect: Vec<DeviceClusters>,
    /// The row of each node of the field.
    lit_rows: wgpu::Buffer,
    /// The place of each cell among those with density, and which cell each place is.
    cell_places: wgpu::Buffer,
    cell_numbers: wgpu::Buffer,
    /// What cells send towards the eye.
    sent: wgpu::Buffer,
    /// Views at a time; the light of each direction of the mesh in them, and the clusters lit by it, set by set.
    views: usize,
    light: wgpu::Buffer,
    lit: Vec<wgpu::Buffer>,
}

/// A light on the device.
pub struct DeviceLight {
    /// Irradiance from each direction of the mesh, times the albedo; none where only suns shine.
    irradiance: Option<wgpu::Buffer>,
    /// Radiance of the direct clusters where it is the same from everywhere, set by set.
    even: Vec<wgpu::Buffer>,
    /// Moments of the indirect clusters, set by set.
    moments: Vec<wgpu::Buffer>,
    /// Towards each sun, its power in the channels of a transmittance, and that, a value a row.
    suns: Vec<(Vec3, [f32; 4], wgpu::Buffer)>,
}

/// A step whose uniform is still to be bound, as number 0.
struct Work<'a> {
    kernel: &'a Kernel,
    uniform: wgpu::Buffer,
    buffers: Vec<(u32, &'a wgpu::Buffer)>,
    threads: usize,
}

impl Work<'_> {
    fn all_buffers(&self) -> Vec<(u32, &wgpu::Buffer)> {
        [(0, &self.uniform)].into_iter().chain(self.buffers.iter().copied()).collect()
    }
}

fn dispatch(gpu: &Gpu, stage: &'static str, work: &[Work]) -> Result<Option<f64>, GpuError> {
    let buffers: Vec<Vec<(u32, &wgpu::Buffer)>> = work.iter().map(Work::all_buffers).collect();
    let steps = work.iter().zip(&buffers);
    let steps: Vec<Step> =
        steps.map(|(w, buffers)| Step { kernel: w.kernel, buffers, threads: w.threads as u32 }).collect();
    gpu.dispatch(stage, &steps)
}

impl DeviceTransfer {
    /// A copy of the transfer of `source`, whatever light it has, for the field that it was made for.
    pub fn new(gpu: &Gpu, source: &TransferSource, field: &DensityField) -> Result<Self, GpuError> {
        let (transfer, cells) = (&source.transfer, &source.cells);
        let mut lit_rows = vec![EMPTY; field.values.len()];
        source.nodes.iter().zip(0..).for_each(|(&node, row)| lit_rows[node as usize] = row);
        let mesh: Vec<[f32; 4]> =
            transfer.basis.mesh().directions().iter().map(|d| d.as_vec3().extend(0.0).to_array()).collect();
        let limit = (gpu.summary().storage_binding.min(gpu.summary().buffer)) as usize;
        gpu.checked("transfer", || {
            let sets = |sets: &[Clustered], of_channel: [usize; 3]| {
                let used = sets.iter().enumerate().filter(|(s, set)| set.length > 0 && of_channel.contains(s));
                used.map(|(s, set)| DeviceClusters::new(gpu, set, of_channel.map(|of| of == s), limit)).collect::<Result<Vec<_>, GpuError>>()
            };
            let direct = sets(&transfer.direct, transfer.direct_of_channel)?;
            let widest = direct.iter().map(|set| set.vectors).chain([mesh.len()]).max().unwrap_or(1);
            // All corners of the cube are the most that can be in use.
            let corners = 6 * (squares(transfer.medium.g) + 1).pow(2);
            let views = (limit / (16 * widest)).clamp(1, VIEWS).min(corners);
            let lit = |set: &DeviceClusters| gpu.storage("lit clusters", (16 * views * set.vectors) as u64);
            Ok(Self {
                g: transfer.medium.g,
                bands: transfer.bands,
                cells: cells.majorants.bricks,
                side: 1 << cells.shift,
                lit: direct.iter().map(lit).collect::<Result<_, _>>()?,
                light: gpu.storage("light of the views", (16 * views * mesh.len()) as u64)?,
                mesh: (gpu.upload("directions of the mesh", &mesh)?, mesh.len()),
                views,
                direct,
                indirect: sets(&transfer.indirect, transfer.indirect_of_channel)?,
                lit_rows: gpu.upload("rows of the nodes", &lit_rows)?,
                cell_places: gpu.upload("places of the cells", &cells.places)?,
                cell_numbers: gpu.upload("cells with density", &cells.bricks)?,
                sent: gpu.storage("radiance of the cells", 16 * cells.len() as u64)?,
            })
        })
    }

    /// What cells sent towards the last eye, RGB and 1: for comparisons.
    pub fn read_cells(&self, gpu: &Gpu, count: usize) -> Result<Vec<[f32; 4]>, GpuError> {
        gpu.read("radiance of the cells", &self.sent, count)
    }
}

impl DeviceClusters {
    fn new(gpu: &Gpu, set: &Clustered, channels: [bool; 3], limit: usize) -> Result<Self, GpuError> {
        let words = 1 + set.terms;
        let each = (limit / (4 * words)).max(1);
        let part = |(number, ids): (usize, &[u8])| {
            let first = number * each;
            let mut mixes = Vec::with_capacity(ids.len() * words);
            for (row, &id) in (first..).zip(ids) {
                mixes.push(u32::from(id));
                mixes.extend(set.weights[row * set.terms..][..set.terms].iter().map(|w| w.to_bits()));
            }
            Ok((first, ids.len(), gpu.upload("mixes of the rows", &mixes)?))
        };
        let [r, g, b] = channels.map(|used| f32::from(u8::from(used)));
        Ok(Self {
            channels: [r, g, b, 0.0],
            vectors: set.clusters() * words,
            terms: set.terms,
            length: set.length,
            bases: gpu.upload("clusters of the transfer", &set.bases)?,
            mixes: set.ids.chunks(each).enumerate().map(part).collect::<Result<_, GpuError>>()?,
        })
    }
}

impl DeviceLight {
    /// Lit clusters, set by set, first direct where they are the same from everywhere, then indirect: `[cluster][1 + terms]`
    /// vectors, or those for each coefficient. For comparisons.
    pub fn read(&self, gpu: &Gpu, frame: &DeviceTransfer) -> Result<Vec<Vec<[f32; 4]>>, GpuError> {
        let n = frame.bands * frame.bands;
        let even = self.even.iter().zip(&frame.direct).map(|(buffer, set)| (buffer, set.vectors));
        let moments = self.moments.iter().zip(&frame.indirect).map(|(buffer, set)| (buffer, set.vectors * n));
        even.chain(moments).map(|(buffer, count)| gpu.read("lit clusters", buffer, count)).collect()
    }
}

impl TransferPass {
    /// Compiles the shaders.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        Self::from_sources(gpu, [PRODUCT, VIEW_DIRECTIONS, CELLS, SOURCE])
    }

    /// From other texts of the same bindings, in the order of [`Self::new`]: how a planted difference is shown to be found.
    pub fn from_sources(gpu: &Gpu, [product, views, cells, source]: [&str; 4]) -> Result<Self, GpuError> {
        let kernel = |text, entry| Kernel::new(gpu, "transfer", text, entry);
        Ok(Self {
            multiply: kernel(product, "multiply")?,
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
        let (n, medium) = (frame.bands * frame.bands, &source.transfer.medium);
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
        let is_even = frame.g == 0.0 && shines;
        let light = DeviceLight {
            irradiance: if shines { Some(gpu.upload("irradiance", &irradiance)?) } else { None },
            even: frame.direct.iter().filter(|_| is_even).map(|set| room(set, 1)).collect::<Result<_, _>>()?,
            moments: frame.indirect.iter().map(|set| room(set, n)).collect::<Result<_, _>>()?,
            suns,
        };
        let coefficients = gpu.upload("coefficients of the light", &coefficients)?;
        let view = gpu.upload("directions from the eye", &[[0.0f32, 0.0, 1.0, 0.0]])?;
        let mut work = Vec::new();
        if let (true, Some(irradiance)) = (is_even, &light.irradiance) {
            work.push(self.scattered(gpu, frame, irradiance, &view, (0, 1)));
        }
        for (set, lit) in frame.direct.iter().zip(&light.even) {
            work.push(self.multiplied(gpu, set, (&frame.light, 1), lit, 1));
        }
        for (set, lit) in frame.indirect.iter().zip(&light.moments) {
            work.push(self.multiplied(gpu, set, (&coefficients, 1), lit, n));
        }
        dispatch(gpu, "light of the transfer", &work)?;
        Ok(light)
    }

    /// The light of each direction of the mesh in `count` of `views` from `first` on.
    fn scattered<'a>(
        &'a self,
        gpu: &Gpu,
        frame: &'a DeviceTransfer,
        irradiance: &'a wgpu::Buffer,
        views: &'a wgpu::Buffer,
        (first, count): (usize, usize),
    ) -> Work<'a> {
        let (mesh, directions) = (&frame.mesh.0, frame.mesh.1);
        let uniform = ViewsUniform {
            g: frame.g,
            directions: directions as u32,
            first_view: first as u32,
            views: count as u32,
        };
        Work {
            kernel: &self.scatter,
            uniform: gpu.uniform("light of the views", &uniform),
            buffers: vec![(1, mesh), (2, irradiance), (3, views), (4, &frame.light)],
            threads: directions * count,
        }
    }

    /// The clusters of a set times `columns` of light.
    fn multiplied<'a>(
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

    /// Shades `volume`, which was made of `field`, for an eye in world space; microseconds where the device can tell.
    /// `density` is the field's, one value a node.
    pub fn shade(
        &self,
        gpu: &Gpu,
        frame: &DeviceTransfer,
        light: &DeviceLight,
        (field, density): (&DensityField, &wgpu::Buffer),
        volume: &DeviceVolume,
        eye: DVec3,
    ) -> Result<Option<f64>, GpuError> {
        let linear = field.world_from_node.matrix3;
        let node_eye = field.world_from_node.inverse().transform_point3(eye);
        let largest = linear.to_cols_array().into_iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let four = |v: DVec3| v.as_vec3().extend(0.0).to_array();
        let [column_x, column_y, column_z] = [linear.x_axis, linear.y_axis, linear.z_axis].map(|c| four(c / largest));
        let wide = |v: [usize; 3]| [v[0] as u32, v[1] as u32, v[2] as u32, 0];
        let (eye, dims, bricks) = (four(node_eye), wide(field.dims), wide(volume.bricks));
        let cells = CellsUniform {
            eye,
            column_x,
            column_y,
            column_z,
            dims,
            bricks,
            cells: wide(frame.cells),
            side: frame.side as u32,
            bands: frame.bands as u32,
            ..CellsUniform::default()
        };
        let nodes =
            TransferUniform { eye, column_x, column_y, column_z, dims, bricks, g: frame.g, ..TransferUniform::default() };
        // Directions that the smoke is seen in; none are needed where light is the same from everywhere, or black.
        let seen = (frame.g != 0.0 && light.irradiance.is_some()).then(|| {
            let along = |[i, j, k]: [usize; 3]| linear * (DVec3::new(i as f64, j as f64, k as f64) - node_eye);
            let corners: Vec<Vec3> = volume.corners.iter().map(|&corner| along(corner).as_vec3()).collect();
            let edges = [linear.x_axis, linear.y_axis, linear.z_axis].map(|edge| edge.as_vec3());
            ViewDirections::of_boxes(&corners, edges, BRICK, squares(frame.g))
        });
        let directions: Vec<[f32; 4]> =
            seen.iter().flat_map(|seen| seen.directions().iter().map(|&d| four(d))).collect();
        let places = gpu.upload("places of the views", seen.as_ref().map_or(&[][..], |seen| seen.places()))?;
        let views = gpu.upload("directions from the eye", &directions)?;
        let target = Target { gpu, frame, volume, places: &places, uniform: nodes };
        let mut work = self.indirect(&target, light, &cells);
        if let (Some(seen), Some(irradiance)) = (&seen, &light.irradiance) {
            for first in (0..directions.len()).step_by(frame.views) {
                let count = frame.views.min(directions.len() - first);
                work.push(self.scattered(gpu, frame, irradiance, &views, (first, count)));
                for (set, lit) in frame.direct.iter().zip(&frame.lit) {
                    work.push(self.multiplied(gpu, set, (&frame.light, count), lit, 1));
                }
                work.extend(self.direct(&target, &frame.lit, [first, count, seen.squares()]));
            }
        }
        work.extend(self.direct(&target, &light.even, [0, 1, 0]));
        for (toward, power, transmittance) in &light.suns {
            let uniform = TransferUniform { toward: toward.extend(0.0).to_array(), power: *power, ..nodes };
            let own = [(2, &frame.lit_rows), (6, transmittance)];
            work.extend(target.pages().map(|page| target.on_page(&self.add_sun, &uniform, page, &own)));
        }
        work.extend(target.pages().map(|page| target.on_page(&self.finish, &nodes, page, &[(7, density)])));
        dispatch(gpu, "volume pass of transfer", &work)
    }

    /// What cells send towards the eye, and that at the nodes, which it overwrites.
    fn indirect<'a>(&'a self, target: &Target<'a>, light: &'a DeviceLight, uniform: &CellsUniform) -> Vec<Work<'a>> {
        let Target { gpu, frame, volume, .. } = *target;
        let mut work = Vec::new();
        for (number, (set, moments)) in frame.indirect.iter().zip(&light.moments).enumerate() {
            for (first, count, mixes) in &set.mixes {
                let uniform = CellsUniform {
                    terms: set.terms as u32,
                    starts: u32::from(number == 0),
                    first_row: *first as u32,
                    rows: *count as u32,
                    ..*uniform
                };
                work.push(Work {
                    kernel: &self.send,
                    uniform: gpu.uniform("radiance of the cells", &uniform),
                    buffers: vec![(4, &frame.cell_numbers), (5, mixes), (6, moments), (7, &frame.sent)],
                    threads: *count,
                });
            }
        }
        let (rows, places, sent) = ((2, &frame.lit_rows), (3, &frame.cell_places), (7, &frame.sent));
        work.extend(target.pages().map(|page| {
            let (first, count) = volume.page(page);
            let uniform = CellsUniform { first_brick: first as u32, page_bricks: count as u32, ..*uniform };
            Work {
                kernel: &self.interpolate,
                uniform: gpu.uniform("volume pass of transfer", &uniform),
                buffers: vec![(1, &volume.dense_bricks), rows, places, sent, (8, &volume.pages[page])],
                threads: count * BRICK_NODES,
            }
        }));
        work
    }

    /// Adds the direct light of clusters in `views` views from `first` on, which `lit` holds set by set.
    fn direct<'a>(
        &'a self,
        target: &Target<'a>,
        lit: &'a [wgpu::Buffer],
        [first, views, squares]: [usize; 3],
    ) -> Vec<Work<'a>> {
        let frame = target.frame;
        let mut work = Vec::new();
        for (set, lit) in frame.direct.iter().zip(lit) {
            for (first_row, rows, mixes) in &set.mixes {
                let uniform = TransferUniform {
                    first_row: *first_row as u32,
                    rows: *rows as u32,
                    terms: set.terms as u32,
                    first_view: first as u32,
                    views: views as u32,
                    each_view: set.vectors as u32,
                    squares: squares as u32,
                    ..target.uniform
                };
                let own = [(2, &frame.lit_rows), (3, mixes), (4, lit), (5, target.places)];
                work.extend(target.pages().map(|page| target.on_page(&self.add_direct, &uniform, page, &own)));
            }
        }
        work
    }
}

/// What a volume pass writes, and what all of its steps share.
struct Target<'a> {
    gpu: &'a Gpu,
    frame: &'a DeviceTransfer,
    volume: &'a DeviceVolume,
    /// Places of the views.
    places: &'a wgpu::Buffer,
    uniform: TransferUniform,
}

impl<'a> Target<'a> {
    /// Pages with bricks.
    fn pages(&self) -> impl Iterator<Item = usize> {
        let volume = self.volume;
        (0..PAGES).filter(move |&page| volume.page(page).1 > 0)
    }

    /// A step of `source.wgsl` over the nodes of a page, with buffers of its own.
    fn on_page(
        &self,
        kernel: &'a Kernel,
        uniform: &TransferUniform,
        page: usize,
        own: &[(u32, &'a wgpu::Buffer)],
    ) -> Work<'a> {
        let (first, count) = self.volume.page(page);
        let uniform = TransferUniform { first_brick: first as u32, page_bricks: count as u32, ..*uniform };
        let shared = [(1, &self.volume.dense_bricks), (8, &self.volume.pages[page])];
        Work {
            kernel,
            uniform: self.gpu.uniform("volume pass of transfer", &uniform),
            buffers: shared.into_iter().chain(own.iter().copied()).collect(),
            threads: count * BRICK_NODES,
        }
    }
}
