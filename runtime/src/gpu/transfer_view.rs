//! A change of the view with transfer: `transport/transfer/{cells,source}.wgsl`, from the lit clusters to the bricks'
//! nodes.
//!
//! In order: what cells send towards the eye, that at the nodes, direct light of clusters, that of suns, density. The
//! directions that the smoke is seen in are found by the processor, from the bricks' corners: a few kB. Their clusters
//! are lit as many at a time as there is room for, and rows are as many as a shader may see: nodes add up.

use super::device::{Gpu, GpuError};
use super::layouts::{Cells as CellsUniform, Transfer as TransferUniform};
use super::pass::Kernel;
use super::transfer::{DeviceLight, DeviceTransfer, TransferPass, Work, dispatch};
use super::volume::{DeviceVolume, PAGES, seen_from, wide};
use crate::medium::field::DensityField;
use crate::shaded_volume::BRICK_NODES;
use crate::transport::transfer::view_directions::{ViewDirections, squares};
use glam::DVec3;

impl TransferPass {
    /// Shades `volume`, which was made of `field`, for an eye in world space.
    /// `density` is the field's, one value a node.
    pub fn shade(
        &self,
        gpu: &Gpu,
        frame: &DeviceTransfer,
        light: &DeviceLight,
        (field, density): (&DensityField, &wgpu::Buffer),
        volume: &DeviceVolume,
        eye: DVec3,
    ) -> Result<(), GpuError> {
        let linear = field.world_from_node.matrix3;
        let node_eye = field.world_from_node.inverse().transform_point3(eye);
        let four = |v: DVec3| v.as_vec3().extend(0.0).to_array();
        let [eye, column_x, column_y, column_z] = seen_from(eye, field);
        let (dims, bricks) = (wide(field.dims), wide(volume.table.bricks));
        let cells = CellsUniform {
            eye,
            column_x,
            column_y,
            column_z,
            dims,
            bricks,
            cells: wide(frame.rows.cells),
            side: frame.rows.side as u32,
            bands: frame.rows.bands as u32,
            ..CellsUniform::default()
        };
        let nodes = TransferUniform {
            eye,
            column_x,
            column_y,
            column_z,
            dims,
            bricks,
            g: frame.rows.g,
            ..TransferUniform::default()
        };
        // Directions that the smoke is seen in; none are needed where light is the same from everywhere, or black.
        let seen = (frame.rows.g != 0.0 && light.irradiance.is_some()).then(|| {
            let along = |[i, j, k]: [usize; 3]| linear * (DVec3::new(i as f64, j as f64, k as f64) - node_eye);
            let boxes = volume.table.runs.iter().map(|&(corner, sides)| (along(corner).as_vec3(), sides));
            let edges = [linear.x_axis, linear.y_axis, linear.z_axis].map(|edge| edge.as_vec3());
            ViewDirections::of_boxes(&boxes.collect::<Vec<_>>(), edges, squares(frame.rows.g))
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
                work.extend(self.scattered(gpu, frame, irradiance, &views, (first, count)));
                for (set, lit) in frame.rows.direct.iter().zip(&frame.lit) {
                    work.push(self.multiplied(gpu, set, (&frame.light, count), lit, 1));
                }
                work.extend(self.direct(&target, &frame.lit, [first, count, seen.squares()]));
            }
        }
        work.extend(self.direct(&target, &light.even, [0, 1, 0]));
        for (toward, power, transmittance) in &light.suns {
            let uniform = TransferUniform { toward: toward.extend(0.0).to_array(), power: *power, ..nodes };
            let own = [(2, &frame.rows.lit_rows), (6, transmittance)];
            work.extend(target.pages().map(|page| target.on_page(&self.add_sun, &uniform, page, &own)));
        }
        work.extend(target.pages().map(|page| target.on_page(&self.finish, &nodes, page, &[(7, density)])));
        dispatch(gpu, "volume pass of transfer", &work)
    }

    /// What cells send towards the eye, and that at the nodes, which it overwrites.
    fn indirect<'a>(&'a self, target: &Target<'a>, light: &'a DeviceLight, uniform: &CellsUniform) -> Vec<Work<'a>> {
        let Target { gpu, frame, volume, .. } = *target;
        let mut work = Vec::new();
        for (number, (set, moments)) in frame.rows.indirect.iter().zip(&light.moments).enumerate() {
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
                    buffers: vec![(4, &frame.rows.cell_numbers), (5, mixes), (6, moments), (7, &frame.sent)],
                    threads: *count,
                });
            }
        }
        let (rows, places, sent) = ((2, &frame.rows.lit_rows), (3, &frame.rows.cell_places), (7, &frame.sent));
        work.extend(target.pages().map(|page| {
            let (first, count) = volume.page(page);
            let uniform = CellsUniform { first_brick: first as u32, page_bricks: count as u32, ..*uniform };
            Work {
                kernel: &self.interpolate,
                uniform: gpu.uniform("volume pass of transfer", &uniform),
                buffers: vec![(1, &volume.table.dense_bricks), rows, places, sent, (8, &volume.pages[page])],
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
        for (set, lit) in frame.rows.direct.iter().zip(lit) {
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
                let own = [(2, &frame.rows.lit_rows), (3, mixes), (4, lit), (5, target.places)];
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
        let shared = [(1, &self.volume.table.dense_bricks), (8, &self.volume.pages[page])];
        Work {
            kernel,
            uniform: self.gpu.uniform("volume pass of transfer", &uniform),
            buffers: shared.into_iter().chain(own.iter().copied()).collect(),
            threads: count * BRICK_NODES,
        }
    }
}
