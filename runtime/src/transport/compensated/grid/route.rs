//! Source radiance on a grid: the default route.
//!
//! The paper solves at the Gaussians' centres and interpolates (Zhou et al. 2008, Eq. 7); where the mean free path is
//! shorter than a Gaussian's radius that interpolation dominates the error. Here both terms live on nodes: single
//! scattering on the density's own nodes (or every second, third ...), multiple scattering on coarser ones, because
//! radiance that was scattered often is smooth. Measured against the centres in `docs/accuracy.md`.
//! Where neither medium nor light has colour, one channel is carried in place of three ([`super::channels`]), up to
//! the shaded nodes: the march reads the three of a node as one vector anyway.
//! Cost: O(nodes x beams) + O(coarse nodes x ordinates x iterations); see [`super::single`] and [`super::scatter`].

use super::channels::channels;
use super::columns::SweepGrid;
use super::scatter::{Ordinate, gather};
use super::single::{WeightedBeam, single_scattering};
use crate::light::Beam;
use crate::medium::field::DensityField;
use crate::shaded_volume::ShadedVolume;
use crate::sphere::harmonics::{BAND, MAX_ORDER, evaluate};
use crate::sphere::quadrature::Directions;
use crate::transport::compensated::gmres;
use crate::transport::medium::BandedMedium;
use crate::transport::{ScatteringOrder, SourceRadiance};
use glam::DVec3;
use rayon::prelude::*;

/// The dials of the grid route.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridSettings {
    /// Beams an environment is cut into.
    pub beams: usize,
    /// Spacing of the single-scattering nodes, in voxels; 0 chooses (see [`single_step`]).
    pub single_step: usize,
    /// Spacing of the multiple-scattering nodes, in voxels; 0 chooses (see [`multiple_step`]).
    pub multiple_step: usize,
    /// Polar rings of the directions that multiple scattering is gathered along; twice as many in azimuth.
    pub rings: usize,
    /// Bands of the phase function that multiple scattering keeps, at most the order of the whole.
    pub multiple_order: usize,
    /// Relative residual at which the iteration for multiple scattering stops.
    pub tolerance: f64,
    /// Most products of that iteration.
    pub iterations: usize,
}

impl Default for GridSettings {
    fn default() -> Self {
        Self {
            beams: 64,
            single_step: 0,
            multiple_step: 0,
            rings: 5,
            multiple_order: 3,
            tolerance: 1e-3,
            iterations: 40,
        }
    }
}

/// Nodes above which single scattering moves to a coarser grid of its own accord.
const MOST_SINGLE_NODES: usize = 6_000_000;
/// Nodes above which multiple scattering does.
const MOST_MULTIPLE_NODES: usize = 1_500_000;

/// The finest spacing, in voxels, whose nodes stay below [`MOST_SINGLE_NODES`].
pub fn single_step(field: &DensityField) -> usize {
    (1..).find(|step| nodes(field.dims, *step) <= MOST_SINGLE_NODES).unwrap_or(1)
}

/// Two voxels, or more where that is too many nodes; one voxel where two would be more than 0.4 of optical depth at the
/// mean density. Radiance that falls off as e^-x is read as linear between nodes, five times over: an error of about
/// `5/12 x^2` of multiple scattering, 7 % at 0.4.
pub fn multiple_step(field: &DensityField, sigma_t: f32) -> usize {
    let (sum, count) =
        field.values.iter().filter(|&&d| d > 0.0).fold((0.0, 0u64), |(s, n), &d| (s + f64::from(d), n + 1));
    let voxel = field.world_from_node.matrix3.determinant().abs().cbrt();
    let depth = if count == 0 { 0.0 } else { sum / count as f64 * voxel * f64::from(sigma_t) };
    let finest = if depth > 0.2 { 1 } else { 2 };
    least_multiple_step(field.dims).max(finest)
}

/// The finest spacing of the multiple-scattering nodes, in voxels, whose nodes stay below [`MOST_MULTIPLE_NODES`].
pub fn least_multiple_step(dims: [usize; 3]) -> usize {
    (1..).find(|step| nodes(dims, *step) <= MOST_MULTIPLE_NODES).unwrap_or(2)
}

/// Nodes `step` >= 1 voxels apart that a field of `dims` nodes is solved on.
pub fn nodes(dims: [usize; 3], step: usize) -> usize {
    dims.iter().map(|n| (n - 1) / step + 3).product()
}

/// Planes of coefficients on nodes `step` voxels apart.
struct Layer {
    step: usize,
    dims: [usize; 3],
    /// `[coefficient * channels + channel][node]`.
    planes: Vec<Vec<f32>>,
}

/// The source radiance of a frame on its grids, in spherical harmonics.
pub struct GridSource {
    /// 1 where all three channels are the same, else 3.
    pub channels: usize,
    single: Layer,
    multiple: Option<Layer>,
    /// Products that the iteration for multiple scattering took; 0 without.
    pub iterations: usize,
    /// Its last relative residual.
    pub residual: f64,
}

/// One frame on the grids that sweeps need, ready to be lit. Its grids depend on the frame and their spacing alone.
pub struct GridTransport {
    settings: GridSettings,
    grids: Vec<(usize, SweepGrid)>,
}

impl GridTransport {
    /// Makes no grid yet: their spacing depends on the medium.
    pub fn new(settings: GridSettings) -> Self {
        Self { settings, grids: Vec::new() }
    }

    fn grid(&mut self, field: &DensityField, step: usize) -> &SweepGrid {
        let at = self.grids.iter().position(|(s, _)| *s == step).unwrap_or_else(|| {
            self.grids.push((step, SweepGrid::new(&field.coarsened(step))));
            self.grids.len() - 1
        });
        &self.grids[at].1
    }

    /// Solves for the source radiance of `field`, the same frame in every call, under `beams`.
    pub fn solve(
        &mut self,
        field: &DensityField,
        beams: &[Beam],
        medium: &BandedMedium,
        scattering: ScatteringOrder,
    ) -> GridSource {
        let settings = self.settings;
        let plan = Plan::new(&settings, field, beams, medium, scattering);
        let Plan { bands, channels, single_step, multiple } = plan;
        let single = single_layer(self.grid(field, single_step), single_step, beams, medium, (bands, channels));
        let Some((step, bands)) = multiple else {
            return GridSource { channels, single, multiple: None, iterations: 0, residual: 0.0 };
        };
        let grid = self.grid(field, step);
        let first = single_layer(grid, step, beams, medium, (bands, channels));
        let (multiple, iterations, residual) = multiple_layer(grid, first, medium, (bands, channels), &settings);
        GridSource { channels, single, multiple: Some(multiple), iterations, residual }
    }
}

/// What is solved for: spacings, bands and channels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// Bands of single scattering.
    pub bands: usize,
    /// 1 where all three channels are the same, else 3.
    pub channels: usize,
    /// Spacing of the single-scattering nodes, in voxels.
    pub single_step: usize,
    /// Spacing and bands of multiple scattering, where there is any.
    pub multiple: Option<(usize, usize)>,
}

impl Plan {
    /// The choices for `field` under `beams`.
    pub fn new(
        settings: &GridSettings,
        field: &DensityField,
        beams: &[Beam],
        medium: &BandedMedium,
        scattering: ScatteringOrder,
    ) -> Self {
        let bands = (1..=MAX_ORDER).rev().find(|&b| medium.moments[b - 1].abs() > 1e-6).unwrap_or(1);
        let step = settings.single_step;
        let single_step = if step == 0 { single_step(field) } else { step };
        let scatters = medium.albedo.iter().any(|&a| a > 0.0) && medium.sigma_t.iter().any(|&s| s > 0.0);
        let multiple = (scattering == ScatteringOrder::All && scatters && !beams.is_empty()).then(|| {
            let (step, thickest) = (settings.multiple_step, medium.sigma_t.iter().copied().fold(0.0, f32::max));
            let step = if step == 0 { multiple_step(field, thickest) } else { step };
            (step, bands.min(settings.multiple_order.max(1)))
        });
        Self { bands, channels: channels(medium, beams), single_step, multiple }
    }
}

/// The beams with what each adds to the coefficients of `bands` bands.
pub fn weighted(beams: &[Beam], medium: &BandedMedium, (bands, channels): (usize, usize)) -> Vec<WeightedBeam> {
    let weighted = |beam: &Beam| {
        let harmonics = evaluate(bands, beam.toward);
        let weight = |plane: usize| {
            let (k, c) = (plane / channels, plane % channels);
            medium.albedo[c] * (medium.moments[BAND[k]] * harmonics[k]) * beam.irradiance[c]
        };
        WeightedBeam { beam: *beam, weights: (0..bands * bands * channels).map(weight).collect() }
    };
    beams.iter().map(weighted).collect()
}

/// The directions that multiple scattering is gathered along.
pub fn ordinates(rings: usize, bands: usize) -> Vec<Ordinate> {
    let directions = Directions::product(rings, 2 * rings);
    let ordinate = |q: usize| {
        let toward = directions.direction(q);
        let harmonics = evaluate(bands, toward)[..bands * bands].to_vec();
        Ordinate { toward, weight: directions.weights[q], harmonics }
    };
    (0..directions.len()).map(ordinate).collect()
}

/// How much of what is gathered in a plane is scattered again: `albedo g^l`.
pub fn gain(medium: &BandedMedium, channels: usize, plane: usize) -> f32 {
    medium.albedo[plane % channels] * medium.moments[BAND[plane / channels]]
}

fn single_layer(
    grid: &SweepGrid,
    step: usize,
    beams: &[Beam],
    medium: &BandedMedium,
    (bands, channels): (usize, usize),
) -> Layer {
    let weighted = weighted(beams, medium, (bands, channels));
    Layer { step, dims: grid.dims, planes: single_scattering(grid, &weighted, &medium.sigma_t[..channels]) }
}

/// From single scattering on the coarse nodes to what is scattered more than once.
fn multiple_layer(
    grid: &SweepGrid,
    first: Layer,
    medium: &BandedMedium,
    (bands, channels): (usize, usize),
    settings: &GridSettings,
) -> (Layer, usize, f64) {
    let ordinates = ordinates(settings.rings, bands);
    let n = grid.len();
    // (1 - F K) x, all planes one after the other.
    let product = |x: &[f32], out: &mut [f32]| {
        let source: Vec<Vec<f32>> = x.chunks(n).map(<[f32]>::to_vec).collect();
        let gathered = gather(grid, &ordinates, &medium.sigma_t[..channels], &source);
        out.par_chunks_mut(n).zip(x.par_chunks(n)).enumerate().for_each(|(plane, (out, x))| {
            let gain = gain(medium, channels, plane);
            out.iter_mut().zip(x).zip(&gathered[plane]).for_each(|((o, x), g)| *o = x - gain * g);
        });
    };
    let b = first.planes.concat();
    let mut x = b.clone();
    let solved = gmres::solve(product, &b, &mut x, settings.tolerance, settings.iterations);
    let planes = x.chunks(n).zip(&first.planes).map(|(all, one)| all.iter().zip(one).map(|(a, o)| a - o).collect());
    (Layer { planes: planes.collect(), ..first }, solved.iterations, solved.residual)
}

impl GridSource {
    /// Spacing in voxels, nodes along x, y, z, and planes `[coefficient * channels + channel][node]` of each layer, single
    /// scattering first.
    pub fn layers(&self) -> impl Iterator<Item = (usize, [usize; 3], &[Vec<f32>])> {
        let layers = std::iter::once(&self.single).chain(&self.multiple);
        layers.map(|layer| (layer.step, layer.dims, layer.planes.as_slice()))
    }
}

impl SourceRadiance for GridSource {
    fn depends_on_view(&self) -> bool {
        self.single.planes.len() > self.channels
    }

    fn shade(&self, field: &DensityField, eye: DVec3, volume: &mut ShadedVolume) {
        let nx = field.dims[0];
        let node_eye = field.world_from_node.inverse().transform_point3(eye);
        let linear = field.world_from_node.matrix3;
        let channels = self.channels;
        let bands = (self.single.planes.len() / channels).isqrt();
        volume.write(field, |j, k, out| {
            // Only nodes next to density are ever fetched with weight on a sample that has any.
            if !near_density(field, j, k) {
                return;
            }
            let mut harmonics = vec![[0.0f32; MAX_ORDER * MAX_ORDER]; if bands > 1 { nx } else { 0 }];
            for (i, y) in harmonics.iter_mut().enumerate() {
                // Look convention: the direction in which the ray that passes here goes on.
                let along = linear * (DVec3::new(i as f64, j as f64, k as f64) - node_eye);
                *y = evaluate(bands, along.normalize_or(DVec3::Z).as_vec3());
            }
            let mut row = vec![0.0f32; nx];
            let mut sum = vec![vec![0.0f32; nx]; channels];
            for layer in std::iter::once(&self.single).chain(&self.multiple) {
                for (plane, values) in layer.planes.iter().enumerate() {
                    layer.row(values, j, k, &mut row);
                    let sum = &mut sum[plane % channels];
                    if bands == 1 {
                        sum.iter_mut().zip(&row).for_each(|(s, v)| *s += v * Y_0);
                    } else {
                        let at = sum.iter_mut().zip(&row).zip(&harmonics);
                        at.for_each(|((s, v), y)| *s += v * y[plane / channels]);
                    }
                }
            }
            for (i, node) in out.iter_mut().enumerate() {
                // A truncated series can dip below zero beside a strong peak; radiance cannot.
                let [red, green, blue] = [0, channels / 2, channels - 1].map(|c| sum[c][i].max(0.0));
                *node = [red, green, blue, node[3]];
            }
        });
    }
}

/// `y_00`.
const Y_0: f32 = 0.282_094_8;

/// Whether any node of the row or of the rows around it has density.
fn near_density(field: &DensityField, j: usize, k: usize) -> bool {
    let [nx, ny, nz] = field.dims;
    let rows = |k: usize| (j.saturating_sub(1)..=(j + 1).min(ny - 1)).map(move |j| nx * (j + ny * k));
    let mut starts = (k.saturating_sub(1)..=(k + 1).min(nz - 1)).flat_map(rows);
    starts.any(|start| field.values[start..start + nx].iter().any(|&d| d > 0.0))
}

impl Layer {
    /// One row of fine nodes of a plane, trilinear between the layer's nodes.
    fn row(&self, values: &[f32], j: usize, k: usize, out: &mut [f32]) {
        let [nx, ny, _] = self.dims;
        if self.step == 1 {
            out.copy_from_slice(&values[nx * (j + ny * k)..][..nx]);
            return;
        }
        // Coarse node c sits at fine position (c - 1) * step.
        let place = |fine: usize| (fine / self.step + 1, (fine % self.step) as f32 / self.step as f32);
        let ((j, g), (k, h)) = (place(j), place(k));
        let start = nx * (j + ny * k);
        let rows = [start, start + nx, start + nx * ny, start + nx * ny + nx].map(|s| &values[s..s + nx]);
        let weights = [(1.0 - g) * (1.0 - h), g * (1.0 - h), (1.0 - g) * h, g * h];
        for (i, out) in out.iter_mut().enumerate() {
            let (c, f) = place(i);
            let at = |c: usize| (0..4).map(|r| weights[r] * rows[r][c]).sum::<f32>();
            *out = at(c) * (1.0 - f) + at(c + 1) * f;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Camera;
    use crate::film::Film;
    use crate::light::{Environment, Light, beams};
    use crate::march::{Black, MarchMedium, MarchSettings, march};
    use crate::transport::medium::MediumParameters;
    use glam::{DAffine3, Vec3};

    /// A ball with a soft edge, radius about 0.5 world units, 24 voxels across the box.
    fn ball() -> DensityField {
        let n = 24;
        let value = |v: usize| {
            let p = Vec3::new((v % n) as f32, (v / n % n) as f32, (v / n / n) as f32) - 11.5;
            (-(p.length() / 7.0).powi(4)).exp()
        };
        let values: Vec<f32> = (0..n * n * n).map(value).map(|d| if d < 1e-3 { 0.0 } else { d }).collect();
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_scale(DVec3::splat(1.0 / 14.0)))
    }

    fn solve(
        field: &DensityField,
        lights: &[Light],
        medium: &BandedMedium,
        scattering: ScatteringOrder,
        settings: &GridSettings,
    ) -> GridSource {
        GridTransport::new(*settings).solve(field, &beams(lights, settings.beams), medium, scattering)
    }

    fn image(field: &DensityField, lights: &[Light], medium: &MediumParameters, settings: &GridSettings) -> Film {
        let banded = medium.banded(4);
        let source = solve(field, lights, &banded, ScatteringOrder::All, settings);
        let centre = field.world_from_node.transform_point3(DVec3::splat(12.5));
        let camera = Camera::look_at(centre - DVec3::new(5.0, 0.3, 0.2), centre, DVec3::Z, 20.0, 24, 24);
        march(
            &shaded(&source, field, camera.position),
            &camera,
            &MarchMedium::plain(banded.sigma_t),
            &Black,
            &MarchSettings::default(),
        )
    }

    fn shaded(source: &GridSource, field: &DensityField, eye: DVec3) -> ShadedVolume {
        let mut volume = ShadedVolume::of(field);
        source.shade(field, eye, &mut volume);
        volume
    }

    fn grey(sigma_t: f32, albedo: f32, g: f32) -> MediumParameters {
        MediumParameters { sigma_t: [sigma_t; 3], albedo: [albedo; 3], g }
    }

    #[test]
    fn the_white_furnace_holds_for_thin_and_thick_media_and_any_g() {
        let sky = [Light::Environment(Environment::constant([1.0; 3]))];
        // One node a voxel: what is left is the difference of two quadratures of the sphere and of J inside a cell.
        let settings =
            GridSettings { single_step: 1, multiple_step: 1, multiple_order: 4, tolerance: 1e-4, ..Default::default() };
        for (sigma, g, tolerance) in [
            (0.02, 0.0, 0.01),
            (1.0, 0.0, 0.01),
            (8.0, 0.0, 0.01),
            (8.0, 0.6, 0.02),
            (8.0, -0.6, 0.02),
            (8.0, 0.99, 0.02),
            (8.0, -0.99, 0.02),
        ] {
            let film = image(&ball(), &sky, &grey(sigma, 1.0, g), &settings);
            let (mut worst, mut seen) = (0.0f32, 0);
            // Below an opacity of 1e-3 its own rounding (6e-8 of 1) would show.
            for pixel in film.pixels.iter().filter(|p| p.alpha() > 1e-3) {
                worst = worst.max((pixel.radiance[1] / pixel.alpha() - 1.0).abs());
                seen += 1;
            }
            assert!(seen > 50 && worst < tolerance, "sigma_t {sigma} g {g}: {worst} over {seen} pixels");
        }
    }

    #[test]
    fn source_radiance_in_the_middle_is_what_random_walks_find() {
        // J(x) = albedo E[ albedo^k L ] over walks that start at x in a uniform direction; the sky is bright above.
        let field = ball();
        let mut sky = Environment::constant([1.0; 3]);
        sky.radiance.iter_mut().take(64 * 16).for_each(|r| *r = [3.0; 3]);
        for (sigma, albedo) in [(2.0f64, 0.9f64), (5.0, 0.9), (5.0, 0.5)] {
            let settings =
                GridSettings { beams: 800, multiple_step: 1, rings: 12, tolerance: 1e-5, ..Default::default() };
            let medium = grey(sigma as f32, albedo as f32, 0.0).banded(4);
            let source = solve(&field, &[Light::Environment(sky.clone())], &medium, ScatteringOrder::All, &settings);
            let v = 12 + 26 * (13 + 26 * 16);
            let multiple = source.multiple.as_ref().map_or(0.0, |m| m.planes[0][v]);
            let found = f64::from((source.single.planes[0][v] + multiple) * Y_0);
            let (mut sum, mut squares, walks) = (0.0, 0.0, 40_000);
            let mut state = 7u64;
            let mut uniform = || {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                ((state ^ (state >> 22)) >> 11) as f64 / (1u64 << 53) as f64
            };
            for _ in 0..walks {
                let (mut p, mut weight) = (DVec3::new(12.0, 13.0, 16.0), albedo);
                let value = 'walk: loop {
                    let (z, a) = (2.0 * uniform() - 1.0, std::f64::consts::TAU * uniform());
                    let d = DVec3::new((1.0 - z * z).sqrt() * a.cos(), (1.0 - z * z).sqrt() * a.sin(), z);
                    loop {
                        // Delta tracking with majorant 1; 14 voxels a world unit.
                        p += d * (-(1.0 - uniform()).ln() / sigma * 14.0);
                        if p.min_element() < 0.0 || p.max_element() > 25.0 {
                            break 'walk weight * if z > 0.0 { 3.0 } else { 1.0 };
                        }
                        if uniform() < f64::from(field.sample(p.as_vec3())) {
                            break;
                        }
                    }
                    weight *= albedo;
                };
                sum += value;
                squares += value * value;
            }
            let mean = sum / f64::from(walks);
            let error = ((squares / f64::from(walks) - mean * mean) / f64::from(walks)).sqrt();
            // Three standard errors; and J and L are read between nodes five times over (three axes of J, two of L)
            // as if they were linear, where they fall off as e^-x: a twelfth of a voxel's optical depth squared each.
            let cell = 5.0 / 12.0 * (sigma / 14.0).powi(2);
            assert!((found - mean).abs() < 3.0 * error + cell * mean, "{sigma} {albedo}: {found} {mean} +- {error}");
        }
    }

    #[test]
    fn no_extinction_no_albedo_and_no_light_are_answered_exactly() {
        let sky = [Light::Environment(Environment::constant([1.0; 3]))];
        let settings = GridSettings::default();
        for (medium, lights) in
            [(grey(0.0, 0.9, 0.0), &sky[..]), (grey(3.0, 0.0, 0.5), &sky[..]), (grey(3.0, 1.0, 0.0), &[][..])]
        {
            let film = image(&ball(), lights, &medium, &settings);
            assert!(film.pixels.iter().all(|p| p.radiance == [0.0; 3]), "{medium:?}");
        }
        let empty = DensityField::from_box([0; 3], [0; 3], &[], DAffine3::IDENTITY);
        let film = image(&empty, &sky, &grey(3.0, 1.0, 0.0), &settings);
        assert!(film.pixels.iter().all(|p| p.transmittance == [1.0; 3]));
    }

    #[test]
    fn an_isotropic_phase_function_has_one_band_and_costs_one_at_any_order() {
        let sky = [Light::Environment(Environment::constant([1.0, 0.8, 0.6]))];
        for scattering in [ScatteringOrder::Single, ScatteringOrder::All] {
            let solved = |order: usize, g: f32| {
                let medium = match scattering {
                    ScatteringOrder::Single => grey(5.0, 0.9, g).windowed(order),
                    ScatteringOrder::All => grey(5.0, 0.9, g).banded(order),
                };
                solve(&ball(), &sky, &medium, scattering, &GridSettings::default())
            };
            let (four, one) = (solved(4, 0.0), solved(1, 0.0));
            let planes = |source: &GridSource| {
                let layers = std::iter::once(&source.single).chain(&source.multiple);
                layers.flat_map(|layer| layer.planes.clone()).collect::<Vec<_>>()
            };
            assert!(planes(&four) == planes(&one) && planes(&one).len() <= 6, "the same planes, three a layer");
            // Cost: as many products, and no volume pass for a new camera.
            assert_eq!((four.iterations, four.depends_on_view()), (one.iterations, false));
            assert!(solved(4, 0.1).depends_on_view(), "the check must see bands where there are any");
        }
    }

    #[test]
    fn every_pixel_is_finite_and_bounded_by_the_light_at_any_optical_depth() {
        let sky = [Light::Environment(Environment::constant([1.0; 3]))];
        for sigma in [1e-6, 1.0, 1e2, 1e3, 1e6] {
            for (albedo, g) in [(1.0, 0.0), (0.9, 0.99), (0.9, -0.99)] {
                let film = image(&ball(), &sky, &grey(sigma, albedo, g), &GridSettings::default());
                for pixel in &film.pixels {
                    let most = pixel.radiance.iter().copied().fold(0.0, f32::max);
                    assert!(
                        pixel.radiance.iter().all(|r| r.is_finite() && *r >= 0.0) && most < 1.1,
                        "{sigma} {albedo} {g}: {pixel:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn one_voxel_scatters_light_and_mirrored_light_gives_a_mirrored_image() {
        let one = DensityField::from_box([5, 5, 5], [1; 3], &[1.0], DAffine3::from_scale(DVec3::splat(0.1)));
        let sky = [Light::Environment(Environment::constant([1.0; 3]))];
        let film = image(&one, &sky, &grey(5.0, 0.9, 0.0), &GridSettings::default());
        assert!(film.pixels.iter().all(|p| p.radiance[0].is_finite()));
        let sun = |x: f32| [Light::Directional { toward: Vec3::new(x, 0.8, 0.0).normalize(), irradiance: [3.0; 3] }];
        let field = ball();
        let source = |x: f32| {
            solve(&field, &sun(x), &grey(4.0, 0.9, 0.3).banded(4), ScatteringOrder::All, &GridSettings::default())
        };
        let (a, b) = (source(0.6), source(-0.6));
        let eye = |x: f64| field.world_from_node.transform_point3(DVec3::splat(12.5)) + DVec3::new(x, -4.0, 1.0);
        let view = |source: &GridSource, x: f64| {
            let target = field.world_from_node.transform_point3(DVec3::splat(12.5));
            let camera = Camera::look_at(eye(x), target, DVec3::Z, 20.0, 16, 16);
            march(
                &shaded(source, &field, camera.position),
                &camera,
                &MarchMedium::plain([4.0; 3]),
                &Black,
                &MarchSettings::default(),
            )
        };
        let (a, b) = (view(&a, 2.0), view(&b, -2.0));
        for y in 0..16 {
            for x in 0..16 {
                let (p, q) = (a.pixels[y * 16 + x].radiance[0], b.pixels[y * 16 + 15 - x].radiance[0]);
                assert!((p - q).abs() < 2e-3 * p.max(0.05), "{x} {y}: {p} {q}");
            }
        }
    }
}
