//! Directions to an environment map, drawn in proportion to what comes from them.
//!
//! The map is bilinear between the middles of its texels ([`Environment::radiance_from`]), so the patches between four
//! middles are where it is one polynomial: width x (height + 1) of them, with half patches at the poles. A patch is drawn
//! by its flux, and a place in it by the bilinear density itself (inverting a marginal and a
//! conditional linear density, Pharr, Jakob and Humphreys 2016, section 13.6.7, and its second-edition errata on
//! bilinear patches). So radiance over density is almost constant; what is left is the cosine of the elevation within a
//! patch, and colour. Density over solid angle:
//! `p = P(patch) * b(s, t) / mean(b) / (width of the patch * height * cos(elevation))`.
//! Patches lie in blocks of 4 x 4, whose sums fill one line of the cache, and blocks in [`BINS`] tiles of the map, so that a caller who knows better where light gets through
//! ([`super::guide`]) can choose the tile: within it the draw is the same, and the density is multiplied by the chance
//! of the tile over its part of the flux. Cost: O(texels) once; one binary search over the blocks of a tile a direction.

use crate::light::Environment;
use glam::Vec3;
use std::f64::consts::{PI, TAU};

/// Tiles down and across.
const TILES: [usize; 2] = [8, 16];
/// Tiles of a sky.
pub const BINS: usize = TILES[0] * TILES[1];
/// Patches along a side of a block.
const BLOCK: usize = 4;

/// An environment with its tables.
pub struct Sky {
    environment: Environment,
    /// Blocks down and across.
    blocks: [usize; 2],
    /// Flux of a block's patches up to and with each, row by row; blocks row by row.
    patches: Vec<[f32; BLOCK * BLOCK]>,
    /// Flux of a tile's blocks up to and with each, row by row, tile after tile.
    sums: Vec<f32>,
    /// Where a tile's blocks start in `sums`, and where the last one's end.
    starts: [u32; BINS + 1],
    /// Each tile's part of the flux, `[tile down * across + tile across]`.
    parts: [f32; BINS],
    flux: f64,
    /// For each row of patches, density times the cosine of the elevation, over brightness: P(patch) / mean(b) is the
    /// patch's solid angle over the whole flux, and its width cancels.
    per_brightness: Vec<f32>,
}

/// Least cosine of an elevation: at the very poles the density is infinite, and nothing falls there.
const FLATTEST: f32 = 1e-6;

/// A drawn direction.
#[derive(Clone, Copy, Debug)]
pub struct Toward {
    /// Unit vector to the sky, world space.
    pub direction: Vec3,
    /// What comes from there.
    pub radiance: [f32; 3],
    /// Density of the draw, per solid angle; above zero.
    pub density: f32,
}

fn brightness(c: [f32; 3]) -> f32 {
    (c[0] + c[1] + c[2]) * (1.0 / 3.0)
}

/// First of `n` rows or columns in tile `tile` of `tiles`.
fn first(tile: usize, tiles: usize, n: usize) -> usize {
    tile * n / tiles
}

/// Tile of `tiles` that row or column `at` of `n` is in.
fn tile_of(at: usize, tiles: usize, n: usize) -> usize {
    // The largest t with t n / tiles < at + 1.
    ((at + 1) * tiles - 1) / n
}

impl Sky {
    /// Tables for `environment`; none if it is black.
    pub fn new(environment: &Environment) -> Option<Self> {
        let (width, rows) = (environment.width, environment.height + 1);
        let blocks = [rows.div_ceil(BLOCK), width.div_ceil(BLOCK)];
        let mut sky = Self {
            environment: environment.clone(),
            blocks,
            patches: vec![[0.0; BLOCK * BLOCK]; blocks[0] * blocks[1]],
            sums: Vec::with_capacity(blocks[0] * blocks[1]),
            starts: [0; BINS + 1],
            parts: [0.0; BINS],
            flux: 0.0,
            per_brightness: Vec::new(),
        };
        let bands: Vec<f64> = (0..rows)
            .map(|row| {
                let (top, bottom) = sky.band(row);
                ((0.5 - top) * PI).sin() - ((0.5 - bottom) * PI).sin()
            })
            .collect();
        for block in 0..sky.patches.len() {
            let mut sum = 0.0f64;
            for patch in 0..BLOCK * BLOCK {
                let row = block / blocks[1] * BLOCK + patch / BLOCK;
                let column = block % blocks[1] * BLOCK + patch % BLOCK;
                if row < rows && column < width {
                    let corners = sky.corners(column, row).map(brightness);
                    sum += f64::from(corners.iter().sum::<f32>()) * 0.25 * bands[row] * TAU / width as f64;
                }
                sky.patches[block][patch] = sum as f32;
            }
        }
        let mut sums = [0.0f64; BINS];
        for bin in 0..BINS {
            for block in sky.blocks_of(bin) {
                sums[bin] += f64::from(sky.patches[block][BLOCK * BLOCK - 1]);
                sky.sums.push(sums[bin] as f32);
            }
            sky.starts[bin + 1] = sky.sums.len() as u32;
        }
        sky.flux = sums.iter().sum();
        sky.parts = sums.map(|s| (s / sky.flux) as f32);
        let per_brightness = |row: usize| {
            let (top, bottom) = sky.band(row);
            (bands[row] / ((bottom - top) * PI * sky.flux)) as f32
        };
        sky.per_brightness = (0..rows).map(per_brightness).collect();
        (sky.flux > 0.0 && sky.flux.is_finite()).then_some(sky)
    }

    /// The blocks of a tile, row by row.
    fn blocks_of(&self, bin: usize) -> impl Iterator<Item = usize> + use<> {
        let [down, across] = self.blocks;
        let (tile_down, tile_across) = (bin / TILES[1], bin % TILES[1]);
        let columns = first(tile_across, TILES[1], across)..first(tile_across + 1, TILES[1], across);
        let rows = first(tile_down, TILES[0], down)..first(tile_down + 1, TILES[0], down);
        rows.flat_map(move |row| columns.clone().map(move |column| row * across + column))
    }

    /// Flux: the integral of the mean channel over the sphere.
    pub fn flux(&self) -> f64 {
        self.flux
    }

    /// Each tile's part of the flux.
    pub fn parts(&self) -> &[f32; BINS] {
        &self.parts
    }

    /// Unit vector to the middle of a tile, world space.
    pub fn middle(&self, bin: usize) -> Vec3 {
        let middle = |tile: usize, tiles: usize, n: usize| {
            0.5 * (BLOCK * (first(tile, tiles, n) + first(tile + 1, tiles, n))) as f64
        };
        let u = (middle(bin % TILES[1], TILES[1], self.blocks[1]) + 0.5) / self.environment.width as f64;
        let v = (middle(bin / TILES[1], TILES[0], self.blocks[0]) - 0.5) / self.environment.height as f64;
        self.environment.direction(u.clamp(0.0, 1.0), v.clamp(0.0, 1.0)).as_vec3()
    }

    /// Upper and lower end of a row of patches, as texture coordinates v.
    #[inline(always)]
    fn band(&self, row: usize) -> (f64, f64) {
        let at = |r: f64| (r / self.environment.height as f64).clamp(0.0, 1.0);
        (at(row as f64 - 0.5), at(row as f64 + 0.5))
    }

    /// Radiance at the corners of a patch: upper left, upper right, lower left, lower right.
    #[inline(always)]
    fn corners(&self, column: usize, row: usize) -> [[f32; 3]; 4] {
        let Environment { width, height, radiance, .. } = &self.environment;
        let right = if column + 1 == *width { 0 } else { column + 1 };
        let (above, below) = (row.saturating_sub(1) * width, row.min(height - 1) * width);
        [radiance[above + column], radiance[above + right], radiance[below + column], radiance[below + right]]
    }

    /// A direction in tile `bin`, whose part of the flux is above zero, for `u` in [0, 1)^2; the density is that of
    /// tiles drawn by their parts.
    #[inline(always)]
    pub fn sample(&self, bin: usize, u: [f32; 2]) -> Toward {
        let width = self.environment.width;
        let (start, end) = (self.starts[bin] as usize, self.starts[bin + 1] as usize);
        let (block, rest_y) = draw(&self.sums[start..end], u[1]);
        let across =
            first(bin % TILES[1] + 1, TILES[1], self.blocks[1]) - first(bin % TILES[1], TILES[1], self.blocks[1]);
        let block_row = first(bin / TILES[1], TILES[0], self.blocks[0]) + block / across;
        let block_column = first(bin % TILES[1], TILES[1], self.blocks[1]) + block % across;
        let (patch, rest_x) = draw(&self.patches[block_row * self.blocks[1] + block_column], u[0]);
        let (row, column) = (block_row * BLOCK + patch / BLOCK, block_column * BLOCK + patch % BLOCK);
        let corners = self.corners(column, row);
        let [a, b, c, d] = corners.map(brightness);
        let t = linear(a + b, c + d, rest_y);
        let s = linear(a + (c - a) * t, b + (d - b) * t, rest_x);
        let mix = |k: usize| {
            let upper = corners[0][k] + (corners[1][k] - corners[0][k]) * s;
            let lower = corners[2][k] + (corners[3][k] - corners[2][k]) * s;
            upper + (lower - upper) * t
        };
        let radiance = [mix(0), mix(1), mix(2)];
        let (top, bottom) = self.band(row);
        let v = top + (bottom - top) * f64::from(t);
        // In f32, whose angles are good to 2e-7: a tenth of a thousandth of a texel of the largest maps.
        let turn =
            ((0.5 - (column as f64 + 0.5 + f64::from(s)) / width as f64) * TAU + self.environment.rotation) as f32;
        let ((sin, cos), (up, flat)) = (turn.sin_cos(), (((0.5 - v) * PI) as f32).sin_cos());
        let (x, y) = (flat * cos, flat * sin);
        let direction = if self.environment.up_is_y { Vec3::new(x, up, -y) } else { Vec3::new(x, y, up) };
        let density = brightness(radiance) * self.per_brightness[row] / flat.max(FLATTEST);
        Toward { direction, radiance, density: density.max(f32::MIN_POSITIVE) }
    }

    /// Radiance from a unit direction, world space, with the density with which [`Self::sample`] draws it, and its tile.
    #[inline(always)]
    pub fn seen(&self, direction: Vec3) -> (Toward, usize) {
        let [u, v] = self.environment.place(direction);
        let Environment { width, height, .. } = self.environment;
        let row = ((v * height as f64 + 0.5) as usize).min(height);
        let column = (((u + 1.0) * width as f64 - 0.5) as usize) % width;
        let radiance = self.environment.radiance_at([u, v]);
        let side = if self.environment.up_is_y { direction.z } else { direction.y };
        let flat = (direction.x * direction.x + side * side).sqrt().max(FLATTEST);
        let density = brightness(radiance) * self.per_brightness[row] / flat;
        let [down, across] = self.blocks;
        let bin = tile_of(row / BLOCK, TILES[0], down) * TILES[1] + tile_of(column / BLOCK, TILES[1], across);
        (Toward { direction, radiance, density }, bin)
    }
}

/// Which of `sums` (rising) `u` in [0, 1) falls into, and how far into it.
#[inline(always)]
fn draw(sums: &[f32], u: f32) -> (usize, f32) {
    let last = sums.len() - 1;
    let target = u * sums[last];
    let at = sums.partition_point(|&sum| sum <= target).min(last);
    let start = if at == 0 { 0.0 } else { sums[at - 1] };
    let width = sums[at] - start;
    (at, if width > 0.0 { ((target - start) / width).clamp(0.0, 1.0) } else { 0.5 })
}

/// Draws x in [0, 1] with a density that goes linearly from `a` to `b`, both >= 0.
#[inline(always)]
fn linear(a: f32, b: f32, u: f32) -> f32 {
    let sum = a + b;
    let positive = sum > 0.0;
    if !positive {
        return u;
    }
    // u (a + b) / (a + sqrt((1 - u) a^2 + u b^2)), scaled so that no square overflows or vanishes.
    let (a, b) = (a / sum, b / sum);
    let root = (a * a * (1.0 - u) + b * b * u).sqrt();
    if a + root > 0.0 { (u / (a + root)).min(1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::sampler::{Random, Strata};

    /// A dim slope with one texel like a sun, and a black quarter.
    fn map() -> Environment {
        let (width, height) = (24, 12);
        let radiance = (0..width * height).map(|t| match (t % width, t / width) {
            (7, 3) => [4000.0, 3000.0, 1000.0],
            (x, _) if x >= 18 => [0.0; 3],
            (x, y) => [0.1 + 0.02 * x as f32, 0.3, 0.05 * y as f32],
        });
        let radiance = radiance.collect();
        Environment { width, height, radiance, rotation: 0.7, ..Environment::constant([0.0; 3]) }
    }

    /// Integral over the sphere by midpoints, `n` times finer than the texels.
    fn integral(environment: &Environment, n: usize, f: impl Fn(Vec3, [f64; 2]) -> f64) -> f64 {
        let (columns, rows) = (environment.width * n, environment.height * n);
        let mut sum = 0.0;
        for j in 0..rows {
            for i in 0..columns {
                let [u, v] = [(i as f64 + 0.5) / columns as f64, (j as f64 + 0.5) / rows as f64];
                let weight = ((0.5 - v) * PI).cos() * PI / rows as f64 * TAU / columns as f64;
                sum += weight * f(environment.direction(u, v).as_vec3(), [u, v]);
            }
        }
        sum
    }

    #[test]
    fn the_density_is_above_zero_where_there_is_light_and_its_integral_is_one() {
        for up_is_y in [false, true] {
            let environment = Environment { up_is_y, ..map() };
            let sky = Sky::new(&environment).unwrap();
            let total = integral(&environment, 16, |d, _| f64::from(sky.seen(d).0.density));
            // Midpoints of a bilinear function over a cosine: (1/16)^2 of a per cent.
            assert!((total - 1.0).abs() < 1e-3, "{total}");
            let flux = integral(&environment, 16, |d, _| f64::from(brightness(environment.radiance_from(d))));
            assert!((sky.flux() / flux - 1.0).abs() < 0.02, "{} {flux}", sky.flux());
        }
    }

    #[test]
    fn a_drawn_direction_comes_with_the_radiance_and_density_that_are_seen_there() {
        let sky = Sky::new(&map()).unwrap();
        let mut random = Random::new(1);
        for _ in 0..20_000 {
            let lit: Vec<usize> = (0..BINS).filter(|&b| sky.parts()[b] > 0.0).collect();
            let bin = lit[(random.unit() * lit.len() as f32) as usize];
            let drawn = sky.sample(bin, [random.unit(), random.unit()]);
            let (seen, there) = sky.seen(drawn.direction);
            let edge = |x: f32| !(1e-3..=1.0 - 1e-3).contains(&x);
            let [u, v] = sky.environment.place(drawn.direction);
            let (across, down) = ((u * 24.0 - 0.5).fract() as f32, (v * 12.0 + 0.5).fract() as f32);
            assert!(there == bin || edge(across) || edge(down), "{bin} {there} {u} {v}");
            // A direction in f32 moves by 1e-7, a texel is 0.26 wide and the sun's edges are as steep as 4000 over it.
            let close = |a: f32, b: f32| (a - b).abs() <= 1e-3 * a.abs() + 5e-3;
            assert!((0..3).all(|c| close(drawn.radiance[c], seen.radiance[c])), "{drawn:?} {seen:?}");
            assert!(close(drawn.density, seen.density) && (drawn.direction.length() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn the_mean_of_radiance_over_density_is_the_flux_of_every_channel_with_little_noise() {
        let environment = map();
        let sky = Sky::new(&environment).unwrap();
        let mut means = Vec::new();
        for seed in 0..200 {
            let mut mean = [0.0f64; 3];
            for index in 0..64 {
                let mut u = Strata { index, seed }.pair(0);
                let sums: Vec<f32> = sky
                    .parts()
                    .iter()
                    .scan(0.0, |s, p| {
                        *s += p;
                        Some(*s)
                    })
                    .collect();
                let bin;
                (bin, u[1]) = draw(&sums, u[1]);
                let drawn = sky.sample(bin, u);
                (0..3).for_each(|c| mean[c] += f64::from(drawn.radiance[c] / drawn.density) / 64.0);
            }
            means.push(mean);
        }
        for c in 0..3 {
            let flux = integral(&environment, 40, |d, _| f64::from(environment.radiance_from(d)[c]));
            let mean = means.iter().map(|m| m[c]).sum::<f64>() / 200.0;
            let error = (means.iter().map(|m| (m[c] - mean).powi(2)).sum::<f64>() / 199.0 / 200.0).sqrt();
            // The midpoints are good to 1e-4 themselves.
            assert!((mean - flux).abs() < 4.0 * error + 2e-4 * flux, "{c}: {mean} {flux} {error}");
            assert!(error < 0.01 * mean, "{error} {mean}");
        }
    }

    #[test]
    fn tiles_share_out_rows_and_columns_of_any_number() {
        for n in 1..60 {
            for tiles in [8, 16] {
                for at in 0..n {
                    let tile = tile_of(at, tiles, n);
                    assert!(
                        first(tile, tiles, n) <= at && at < first(tile + 1, tiles, n),
                        "{at} of {n} in {tile} of {tiles}"
                    );
                }
            }
        }
    }

    #[test]
    fn black_and_single_texel_maps_are_answered() {
        assert!(Sky::new(&Environment::constant([0.0; 3])).is_none());
        let one = Environment { width: 1, height: 1, radiance: vec![[2.0; 3]], ..Environment::constant([0.0; 3]) };
        let sky = Sky::new(&one).unwrap();
        for u in [[0.0, 0.0], [0.5, 0.25], [0.999_999_9, 0.999_999_9]] {
            for bin in (0..BINS).filter(|&b| sky.parts()[b] > 0.0) {
                let drawn = sky.sample(bin, u);
                assert_eq!(drawn.radiance, [2.0; 3]);
                assert!(drawn.density > 0.0 && drawn.density.is_finite() && drawn.direction.is_finite());
            }
        }
        let (above, _) = sky.seen(Vec3::Z);
        assert!(above.density.is_finite() && above.radiance == [2.0; 3]);
    }
}
