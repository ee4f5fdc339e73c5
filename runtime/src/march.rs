//! The view pass: source radiance and density marched along every pixel's ray (Zhou et al. 2008, section 5.5).
//!
//! `L = sum over samples of T J (1 - e^-x)`, `x = sigma_t D ds`, `T` the transmittance so far, front to back. The paper
//! adds `x J` instead of `(1 - e^-x) J`, which overshoots by 2.3 % at x = 0.05 and by 58 % at x = 1; and marches slices
//! back to front, where this stops as soon as nothing behind can be seen. Samples lie at fixed distances from the eye:
//! the paper's half a voxel apart on request, by default a voxel, or less where that would be more than
//! [`DEPTH_PER_SAMPLE`] of optical depth (measured on the plume: `docs/decisions/030-march-step.md`); bricks without density are stepped over, which changes no sample.
//! A fetch stays inside one brick of [`ShadedVolume`], 2000 bytes with fixed strides; the samples of a brick are placed and their exponentials taken by lanes, and added up one after the other.
//! Cost: O(pixels x samples in dense bricks), each one trilinear fetch of four channels at once.

use crate::camera::Camera;
use crate::film::{Film, Pixel};
use crate::half_resolution;
use crate::lanes::exp_neg_and_rest;
use crate::shaded_volume::{BRICK, BRICK_NODES, EMPTY, SIDE, ShadedVolume};
use glam::{DAffine3, DVec3, Vec4};
use multiversion::multiversion;
use rayon::prelude::*;
use std::convert::Infallible;

/// Node of the last cell of a brick.
const LAST_CELL: usize = (BRICK - 1) * (1 + SIDE + SIDE * SIDE);
/// Samples that are placed and exponentiated together.
const LANES: usize = 16;
/// Largest optical depth between two samples where the step is chosen.
const DEPTH_PER_SAMPLE: f64 = 0.3;
/// Smallest step that is chosen, in voxels: below it the density is known no better than linearly.
const LEAST_STEP: f64 = 0.25;
/// The dials of the march.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchSettings {
    /// Distance between samples in voxels (along the shortest voxel side), in (0, 4]; 0 chooses.
    pub step: f32,
    /// A ray ends where its transmittance falls below this; what is left is taken to be as bright as there.
    pub cutoff: f32,
    /// Rays along a side of a pixel: `samples^2` on a regular grid, at least 1.
    pub samples: usize,
    /// True marches a quarter of the rays and reads the other pixels between them ([`crate::half_resolution`]).
    pub half_resolution: bool,
}

impl Default for MarchSettings {
    /// A step that fits the medium, one part in a thousand, and one ray a pixel.
    fn default() -> Self {
        Self { step: 0.0, cutoff: 1e-3, samples: 1, half_resolution: false }
    }
}

impl ShadedVolume {
    /// Largest and smallest distance along a ray inside the box, or none.
    fn span(&self, origin: DVec3, direction: DVec3) -> Option<(f64, f64)> {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for a in 0..3 {
            let top = (self.dims[a] - 1) as f64;
            if direction[a].abs() < 1e-300 {
                if !(origin[a] >= 0.0 && origin[a] <= top) {
                    return None;
                }
                continue;
            }
            let (t0, t1) = (-origin[a] / direction[a], (top - origin[a]) / direction[a]);
            near = near.max(t0.min(t1));
            far = far.min(t0.max(t1));
        }
        (near < far).then_some((near, far))
    }
}

/// World length between samples.
pub(crate) fn sample_distance(world_from_node: &DAffine3, density_max: f32, step: f32, sigma_t: [f32; 3]) -> f64 {
    let sides = [0, 1, 2].map(|a| world_from_node.matrix3.col(a).length());
    let voxel = sides.into_iter().fold(f64::INFINITY, f64::min);
    if step > 0.0 {
        return voxel * f64::from(step);
    }
    let thickest = f64::from(sigma_t.into_iter().fold(0.0, f32::max)) * f64::from(density_max) * voxel;
    // No density at all divides by zero, and takes the largest step.
    voxel * (DEPTH_PER_SAMPLE / thickest).clamp(LEAST_STEP, 1.0)
}

/// `[J, D]` in cell `at` (its first node) of a brick, at `f` within the cell.
#[inline(always)]
fn fetch(brick: &[[f32; 4]; BRICK_NODES], at: usize, f: [f32; 3]) -> Vec4 {
    // Tells the compiler that all eight nodes are inside.
    let at = at.min(LAST_CELL);
    let lerp = |a: Vec4, b: Vec4, f: f32| a + (b - a) * f;
    let row = |start: usize| lerp(Vec4::from_array(brick[start]), Vec4::from_array(brick[start + 1]), f[0]);
    let low = lerp(row(at), row(at + SIDE), f[1]);
    let high = lerp(row(at + SIDE * SIDE), row(at + SIDE * SIDE + SIDE), f[1]);
    lerp(low, high, f[2])
}

/// What is seen where the medium lets light through, by unit direction, world space.
pub trait Backdrop: Sync {
    /// Radiance behind the medium that the camera sees.
    fn behind(&self, direction: DVec3) -> [f32; 3];
    /// Radiance that a forward peak which counts as not scattered brings along this direction.
    fn through_peak(&self, direction: DVec3) -> [f32; 3];
}

/// Nothing behind the medium.
pub struct Black;

impl Backdrop for Black {
    fn behind(&self, _: DVec3) -> [f32; 3] {
        [0.0; 3]
    }
    fn through_peak(&self, _: DVec3) -> [f32; 3] {
        [0.0; 3]
    }
}

/// What the march is told of the medium.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MarchMedium {
    /// Extinction per unit density and world length that the source radiance was made for.
    pub sigma_t: [f32; 3],
    /// The user's extinction over that: 1, or more where part of the forward peak counts as not scattered.
    pub peak_ratio: [f32; 3],
}

impl MarchMedium {
    /// A medium without a peak taken out.
    pub fn plain(sigma_t: [f32; 3]) -> Self {
        Self { sigma_t, peak_ratio: [1.0; 3] }
    }

    /// From the user's extinction and the one of the source radiance.
    pub fn of(user: [f32; 3], marched: [f32; 3]) -> Self {
        let ratio = |c: usize| if user[c] > marched[c] && marched[c] > 0.0 { user[c] / marched[c] } else { 1.0 };
        Self { sigma_t: marched, peak_ratio: [0, 1, 2].map(ratio) }
    }
}

/// Marches every pixel.
pub fn march(
    volume: &ShadedVolume,
    camera: &Camera,
    medium: &MarchMedium,
    backdrop: &dyn Backdrop,
    settings: &MarchSettings,
) -> Film {
    let node_from_world = volume.world_from_node.inverse();
    let ds = sample_distance(&volume.world_from_node, volume.density_max, settings.step, medium.sigma_t);
    let origin = node_from_world.transform_point3(camera.position);
    let lens = Lens { camera, medium, backdrop, settings };
    let view = View { lens, volume, node_from_world, origin, ds };
    if settings.half_resolution {
        let coarse = view.medium_alone(half_resolution::coarse_size(camera));
        let Ok(film) = half_resolution::film::<Infallible>(&lens, &coarse, |apart| Ok(view.pixels(apart)));
        return film;
    }
    let mut film = Film::new(camera.width, camera.height);
    let columns: Vec<usize> = (0..camera.width).collect();
    film.pixels
        .par_chunks_mut(camera.width)
        .enumerate()
        .for_each(|(y, row)| row.copy_from_slice(&view.row(y, &columns)));
    film
}

/// The rays of pixels, and what is behind the medium.
#[derive(Clone, Copy)]
pub(crate) struct Lens<'a> {
    /// Where it is seen from.
    pub(crate) camera: &'a Camera,
    pub(crate) medium: &'a MarchMedium,
    pub(crate) backdrop: &'a dyn Backdrop,
    pub(crate) settings: &'a MarchSettings,
}

/// All that pixels are marched with.
struct View<'a> {
    lens: Lens<'a>,
    volume: &'a ShadedVolume,
    node_from_world: DAffine3,
    /// The eye in node space.
    origin: DVec3,
    /// World length between samples.
    ds: f64,
}

impl Lens<'_> {
    /// Unit directions of the rays through a rectangle of the image: its top left corner and its sides, in pixels.
    fn rays(&self, [x, y]: [f64; 2], [across, down]: [f64; 2]) -> impl Iterator<Item = DVec3> {
        let side = self.settings.samples;
        let part = move |ray: usize| (ray as f64 + 0.5) / side as f64;
        (0..side * side)
            .map(move |ray| self.camera.direction(x + across * part(ray % side), y + down * part(ray / side)))
    }

    /// The mean of the rays through a pixel, or of as many through a larger rectangle.
    fn mean(&self, rays: impl Iterator<Item = Pixel>) -> Pixel {
        let share = 1.0 / (self.settings.samples * self.settings.samples) as f32;
        let mut sum = Pixel { transmittance: [0.0; 3], ..Pixel::EMPTY };
        for ray in rays {
            (0..3).for_each(|c| sum.radiance[c] += ray.radiance[c]);
            (0..3).for_each(|c| sum.transmittance[c] += ray.transmittance[c]);
            sum.depth = sum.depth.min(ray.depth);
        }
        let mean = |sum: [f32; 3]| sum.map(|s| s * share);
        Pixel { radiance: mean(sum.radiance), transmittance: mean(sum.transmittance), depth: sum.depth }
    }

    /// Pixel (`x`, `y`), of which the medium alone leaves `marched`.
    pub(crate) fn in_front(&self, marched: Pixel, x: usize, y: usize) -> Pixel {
        let rays = self.rays([x as f64, y as f64], [1.0; 2]);
        self.mean(rays.map(|direction| before(marched, self.medium, self.backdrop, direction)))
    }
}

impl View<'_> {
    /// The pixels of row `y` in some columns.
    fn row(&self, y: usize, columns: &[usize]) -> Vec<Pixel> {
        let lens = self.lens;
        let corner = |x: usize| [x as f64, y as f64];
        let directions: Vec<DVec3> = columns.iter().flat_map(|&x| lens.rays(corner(x), [1.0; 2])).collect();
        let marched = march_rays(self, &directions);
        let count = lens.settings.samples * lens.settings.samples;
        let pixel = |(marched, directions): (&[Pixel], &[DVec3])| {
            let rays = marched.iter().zip(directions);
            lens.mean(rays.map(|(ray, direction)| before(*ray, lens.medium, lens.backdrop, *direction)))
        };
        marched.chunks(count).zip(directions.chunks(count)).map(pixel).collect()
    }

    /// Some pixels, by column and row, row by row.
    fn pixels(&self, some: &[[usize; 2]]) -> Vec<Pixel> {
        let rows: Vec<&[[usize; 2]]> = some.chunk_by(|a, b| a[1] == b[1]).collect();
        let row = |row: &[[usize; 2]]| self.row(row[0][1], &row.iter().map(|at| at[0]).collect::<Vec<_>>());
        rows.into_par_iter().flat_map_iter(row).collect()
    }

    /// What the medium alone leaves in rectangles that divide the image into so many columns and rows.
    fn medium_alone(&self, [width, height]: [usize; 2]) -> Film {
        let (lens, camera) = (self.lens, self.lens.camera);
        let size = [camera.width as f64 / width as f64, camera.height as f64 / height as f64];
        let count = lens.settings.samples * lens.settings.samples;
        let mut film = Film::new(width, height);
        film.pixels.par_chunks_mut(width).enumerate().for_each(|(j, row)| {
            let corners = (0..width).map(|i| [i as f64 * size[0], j as f64 * size[1]]);
            let directions: Vec<DVec3> = corners.flat_map(|corner| lens.rays(corner, size)).collect();
            let marched = march_rays(self, &directions);
            row.iter_mut().zip(marched.chunks(count)).for_each(|(out, rays)| *out = lens.mean(rays.iter().copied()));
        });
        film
    }
}

/// Marches rays of these directions.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn march_rays(view: &View, directions: &[DVec3]) -> Vec<Pixel> {
    let mut out = Vec::with_capacity(directions.len());
    for world in directions {
        let direction = view.node_from_world.transform_vector3(*world);
        let depth_per_distance = world.dot(view.lens.camera.forward);
        let ray = Ray { origin: view.origin, direction, ds: view.ds, depth_per_distance };
        out.push(march_ray(view.volume, &ray, view.lens.medium.sigma_t, view.lens.settings.cutoff));
    }
    out
}

/// A marched ray in front of the backdrop. The background is seen through the user's extinction, `T^ratio`; what the
/// marched extinction lets through beyond that, `T - T^ratio`, is light of the forward peak, and belongs to the medium.
fn before(marched: Pixel, medium: &MarchMedium, backdrop: &dyn Backdrop, direction: DVec3) -> Pixel {
    let mut pixel = marched;
    let behind = backdrop.behind(direction);
    if medium.peak_ratio != [1.0; 3] {
        let peak = backdrop.through_peak(direction);
        for (c, peak) in peak.into_iter().enumerate() {
            let through = marched.transmittance[c];
            pixel.transmittance[c] = through.powf(medium.peak_ratio[c]);
            pixel.radiance[c] += (through - pixel.transmittance[c]) * peak;
        }
    }
    (0..3).for_each(|c| pixel.radiance[c] += pixel.transmittance[c] * behind[c]);
    pixel
}

/// A ray in node space; distances along it are in world units.
struct Ray {
    origin: DVec3,
    direction: DVec3,
    ds: f64,
    depth_per_distance: f64,
}

/// Walks the bricks along the ray (Amanatides and Woo 1987), collects the samples of those with density, and adds them
/// up, [`LANES`] at a time.
#[inline(always)]
fn march_ray(volume: &ShadedVolume, ray: &Ray, sigma_t: [f32; 3], cutoff: f32) -> Pixel {
    let Some((near, far)) = volume.span(ray.origin, ray.direction) else { return Pixel::EMPTY };
    let optics =
        Optics { sigma_t, grey: sigma_t[0] == sigma_t[1] && sigma_t[0] == sigma_t[2], cutoff, ds: ray.ds as f32 };
    let mut state = State { radiance: Vec4::ZERO, transmittance: Vec4::ONE, first: f64::INFINITY };
    let mut samples = Samples::default();
    let inside = ray.origin + ray.direction * (near + 1e-6 * ray.ds);
    let mut brick = [0, 1, 2].map(|a| ((inside[a] / BRICK as f64).max(0.0) as usize).min(volume.table.bricks[a] - 1));
    // Distance at which the ray leaves its brick along each axis, and from there on from brick to brick.
    let (mut leaves, mut between) = ([f64::INFINITY; 3], [f64::INFINITY; 3]);
    for a in 0..3 {
        if ray.direction[a] != 0.0 {
            let side = (brick[a] + usize::from(ray.direction[a] > 0.0)) * BRICK;
            leaves[a] = (side as f64 - ray.origin[a]) / ray.direction[a];
            between[a] = BRICK as f64 / ray.direction[a].abs();
        }
    }
    let step = (ray.direction * ray.ds).as_vec3();
    // Samples are numbered from the eye: number s is at (s + 1/2) ds.
    let per_ds = 1.0 / ray.ds;
    let number = |distance: f64| (distance * per_ds - 0.5).ceil();
    let mut next = number(near).max(0.0);
    loop {
        let axis = if leaves[0] < leaves[1] {
            if leaves[0] < leaves[2] { 0 } else { 2 }
        } else if leaves[1] < leaves[2] {
            1
        } else {
            2
        };
        let exit = leaves[axis];
        let after = number(exit.min(far)).max(next);
        let place =
            volume.table.places[brick[0] + volume.table.bricks[0] * (brick[1] + volume.table.bricks[1] * brick[2])];
        if place != EMPTY && after > next {
            let corner = DVec3::new(brick[0] as f64, brick[1] as f64, brick[2] as f64) * BRICK as f64;
            let start = (ray.origin + ray.direction * ((next + 0.5) * ray.ds) - corner).as_vec3();
            for s in 0..(after - next) as u32 {
                samples.push(place, (start + step * s as f32).to_array(), next + f64::from(s));
                if samples.count == LANES && state.add(volume, &mut samples, &optics) {
                    return state.pixel(ray);
                }
            }
        }
        next = after;
        brick[axis] = if ray.direction[axis] > 0.0 { brick[axis] + 1 } else { brick[axis].wrapping_sub(1) };
        if exit >= far || brick[axis] >= volume.table.bricks[axis] {
            state.add(volume, &mut samples, &optics);
            return state.pixel(ray);
        }
        leaves[axis] += between[axis];
    }
}

/// What a sample's radiance and transmittance depend on, but for the volume.
struct Optics {
    sigma_t: [f32; 3],
    grey: bool,
    cutoff: f32,
    ds: f32,
}

/// Samples that wait to be added, in the order of the ray: number, brick, and place in it in nodes from its corner.
#[derive(Default)]
struct Samples {
    count: usize,
    number: [f64; LANES],
    brick: [u32; LANES],
    place: [[f32; LANES]; 3],
}

impl Samples {
    #[inline(always)]
    fn push(&mut self, brick: u32, place: [f32; 3], number: f64) {
        let at = self.count.min(LANES - 1);
        (self.brick[at], self.number[at]) = (brick, number);
        (0..3).for_each(|a| self.place[a][at] = place[a]);
        self.count = at + 1;
    }
}

struct State {
    /// The fourth component of both means nothing.
    radiance: Vec4,
    transmittance: Vec4,
    /// Number of the first sample with density.
    first: f64,
}

impl State {
    /// Adds the samples and forgets them. True if the ray ends here: what it can still see is taken to be as bright as
    /// its last sample.
    #[inline(always)]
    fn add(&mut self, volume: &ShadedVolume, samples: &mut Samples, optics: &Optics) -> bool {
        let (mut cell, mut fraction) = ([0usize; LANES], [[0.0f32; LANES]; 3]);
        let mut stride = 1;
        for (fraction, place) in fraction.iter_mut().zip(&samples.place) {
            for s in 0..LANES {
                let p = place[s].clamp(0.0, BRICK as f32);
                let base = (p as i32).min(BRICK as i32 - 1);
                cell[s] += base as usize * stride;
                fraction[s] = p - base as f32;
            }
            stride *= SIDE;
        }
        let (mut fetched, mut column) = ([Vec4::ZERO; LANES], [0.0f32; LANES]);
        let count = samples.count.min(LANES);
        for s in 0..count {
            let nodes = &volume.nodes[samples.brick[s] as usize];
            fetched[s] = fetch(nodes, cell[s], [fraction[0][s], fraction[1][s], fraction[2][s]]);
            column[s] = fetched[s].w * optics.ds;
        }
        samples.count = 0;
        let (mut kept, mut rest) = ([[1.0f32; LANES]; 3], [[0.0f32; LANES]; 3]);
        for c in 0..if optics.grey { 1 } else { 3 } {
            for s in 0..LANES {
                (kept[c][s], rest[c][s]) = exp_neg_and_rest(optics.sigma_t[c] * column[s]);
            }
        }
        for s in 0..count {
            if fetched[s].w > 0.0 {
                self.first = self.first.min(samples.number[s]);
                let three = |v: &[[f32; LANES]; 3]| {
                    if optics.grey { Vec4::splat(v[0][s]) } else { Vec4::new(v[0][s], v[1][s], v[2][s], 0.0) }
                };
                self.radiance += self.transmittance * fetched[s] * three(&rest);
                self.transmittance *= three(&kept);
                if self.transmittance.truncate().max_element() < optics.cutoff {
                    self.radiance += self.transmittance * fetched[s];
                    self.transmittance = Vec4::ZERO;
                    return true;
                }
            }
        }
        false
    }

    fn pixel(self, ray: &Ray) -> Pixel {
        let depth = ((self.first + 0.5) * ray.ds * ray.depth_per_distance) as f32;
        let three = |v: Vec4| v.truncate().to_array();
        Pixel { radiance: three(self.radiance), transmittance: three(self.transmittance), depth }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slab 8 voxels thick between z = 0.5 and 8.5 (linear edges of one voxel), seen along -z.
    fn slab(density: f32, source: f32) -> (ShadedVolume, Camera) {
        let dims = [12, 12, 14];
        let nodes = (0..dims.iter().product()).map(|v| {
            let k = v / 144;
            [source, source, source, if (1..=8).contains(&k) { density } else { 0.0 }]
        });
        let volume = ShadedVolume::of_nodes(dims, &nodes.collect::<Vec<_>>(), DAffine3::IDENTITY);
        let camera = Camera::look_at(DVec3::new(5.5, 5.5, 60.0), DVec3::new(5.5, 5.5, 0.0), DVec3::Y, 2.0, 3, 3);
        (volume, camera)
    }

    fn see(volume: &ShadedVolume, camera: &Camera, sigma_t: [f32; 3], settings: &MarchSettings) -> Film {
        march(volume, camera, &MarchMedium::plain(sigma_t), &Black, settings)
    }

    #[test]
    fn a_slab_transmits_by_beer_and_lambert_at_any_optical_depth() {
        for depth in [1e-6f32, 1e-3, 0.1, 1.0, 5.0, 20.0, 1e3, 1e6] {
            let (volume, camera) = slab(1.0, 2.0);
            let film = see(
                &volume,
                &camera,
                [depth / 8.0; 3],
                &MarchSettings { step: 0.25, cutoff: 0.0, ..Default::default() },
            );
            let pixel = film.pixels[4];
            let truth = (-f64::from(depth)).exp();
            // The midpoint rule is exact on the linear edges but for the sample that holds the kink.
            assert!((f64::from(pixel.transmittance[0]) - truth).abs() < 2e-3 * truth.max(1e-3), "{depth}: {pixel:?}");
            let emitted = 2.0 * -(-f64::from(depth)).exp_m1();
            assert!((f64::from(pixel.radiance[1]) / emitted - 1.0).abs() < 2e-3, "{depth}: {pixel:?} {emitted}");
        }
    }

    #[test]
    fn stepping_over_empty_bricks_and_stopping_early_change_no_more_than_they_promise() {
        let (volume, camera) = slab(1.0, 1.0);
        let mut dense = slab(1.0, 1.0).0;
        assert!(dense.table.places.contains(&EMPTY), "there must be something to step over");
        let none = dense.nodes.len() as u32;
        dense.nodes.push([[1.0, 1.0, 1.0, 0.0]; BRICK_NODES]);
        dense.table.places.iter_mut().filter(|p| **p == EMPTY).for_each(|p| *p = none);
        let settings = MarchSettings { step: 0.5, cutoff: 0.0, ..Default::default() };
        let (a, b) = (see(&volume, &camera, [0.3; 3], &settings), see(&dense, &camera, [0.3; 3], &settings));
        assert_eq!(a.pixels, b.pixels);
        let early = see(&volume, &camera, [2.0; 3], &MarchSettings { cutoff: 1e-3, ..settings });
        assert!((early.pixels[4].radiance[0] - 1.0).abs() < 1e-5, "a constant source stays constant");
    }

    #[test]
    fn no_density_on_the_way_leaves_the_pixel_empty() {
        let (volume, camera) = slab(0.0, 1.0);
        assert_eq!(see(&volume, &camera, [1.0; 3], &MarchSettings::default()).pixels[4], Pixel::EMPTY);
    }

    #[test]
    fn a_peak_taken_out_of_the_extinction_is_in_the_radiance_and_not_in_the_transmittance() {
        struct Sky;
        impl Backdrop for Sky {
            fn behind(&self, _: DVec3) -> [f32; 3] {
                [1.0, 0.0, 1.0]
            }
            fn through_peak(&self, _: DVec3) -> [f32; 3] {
                [1.0; 3]
            }
        }
        let (volume, camera) = slab(1.0, 1.0);
        let medium = MarchMedium::of([0.2; 3], [0.1; 3]);
        let pixel = march(&volume, &camera, &medium, &Sky, &MarchSettings::default()).pixels[4];
        let truth = (-1.6f32).exp();
        assert!((pixel.transmittance[0] - truth).abs() < 1e-3 * truth, "{pixel:?}");
        // The furnace: a source of 1, a sky of 1, behind a peak of 1.
        assert!((pixel.radiance[0] - 1.0).abs() < 1e-6 && (pixel.radiance[1] - (1.0 - truth)).abs() < 1e-3);
        let plain = march(&volume, &camera, &MarchMedium::plain([0.1; 3]), &Sky, &MarchSettings::default()).pixels[4];
        assert!((plain.radiance[0] - 1.0).abs() < 1e-6 && (plain.transmittance[1] - (-0.8f32).exp()).abs() < 1e-3);
    }

    #[test]
    fn more_rays_a_pixel_average_what_they_see() {
        // A sky that is bright on the right half of the middle pixel: one ray in its middle cannot tell.
        struct Half;
        impl Backdrop for Half {
            fn behind(&self, d: DVec3) -> [f32; 3] {
                [if d.x > 1e-9 { 1.0 } else { 0.0 }; 3]
            }
            fn through_peak(&self, _: DVec3) -> [f32; 3] {
                [0.0; 3]
            }
        }
        let (volume, camera) = slab(0.0, 1.0);
        let settings = MarchSettings { samples: 4, ..MarchSettings::default() };
        let film = march(&volume, &camera, &MarchMedium::plain([1.0; 3]), &Half, &settings);
        assert_eq!([3, 4, 5].map(|p| film.pixels[p].radiance[0]), [0.0, 0.5, 1.0]);
    }
}
