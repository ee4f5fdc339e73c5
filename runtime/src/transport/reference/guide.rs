//! A guess of how much of each part of the sky reaches each part of the smoke, to draw directions by.
//!
//! The light's own density draws directions most of which are blocked by smoke. Here every brick with density guesses the
//! transmittance `T` from its middle to the middle of each tile of the sky, through the middles of the bricks' bounds, and draws
//! tiles by `flux (T + FLOOR mean T)`. Whatever the guess, the estimate stays unbiased, because the density that was
//! drawn from is known exactly: chances are whole numbers of 1/65535, at least one for each tile with light (importance
//! sampling by product; Clarberg and Akenine-Möller 2008 for surfaces). A vertex looks up a brick at a random place
//! around it, so that the guess is smooth. Where little of the sky gets through at all, it is looked at by chance only. Measured on the plume under a sunset: see `docs/decisions/040-reference.md`.
//! Cost: bricks x tiles short walks, once; one binary search a direction.

use super::sky::{BINS, Sky};
use crate::tracking::flight::{Ray, Space};
use crate::tracking::majorant::Majorants;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// What a tile gets however little light the guess lets through, of the mean over all tiles.
const FLOOR: f32 = 0.2;
/// Least chance of a look.
const SELDOM: f32 = 0.05;
/// Mean guessed transmittance from which the sky is looked at every time.
const FULL: f32 = 0.15;
/// Whole numbers that the chances of a brick add up to.
const WHOLE: u32 = 65_535;

/// What a brick guesses of a sky.
pub struct Outlook {
    /// Sum of the chances up to and with each tile.
    pub sums: [u16; BINS],
    /// Chance with which the sky is looked at from here: where little of it gets through, seldom.
    pub look: f32,
}

/// The tables of one sky.
pub struct Guide {
    /// Of the bricks with density, after that of all others.
    outlooks: Vec<Outlook>,
    /// Where a brick's is in `outlooks`.
    places: Vec<u32>,
    bricks: [usize; 3],
    per_brick: f64,
}

impl Guide {
    /// Tables over `middles`, the middle densities of bricks, at extinction `sigma` per unit density and world length.
    pub fn new(space: &Space, middles: &Majorants, sky: &Sky, sigma: f32) -> Self {
        let ways: Vec<Vec3> = (0..BINS).map(|bin| sky.middle(bin)).collect();
        let dense: Vec<usize> = (0..middles.bounds.len()).filter(|&b| middles.bounds[b][1] > 0.0).collect();
        let of_brick = |brick: &usize| {
            let at = [brick % middles.bricks[0], brick / middles.bricks[0] % middles.bricks[1]];
            let at = [at[0], at[1], brick / middles.bricks[0] / middles.bricks[1]];
            let middle = DVec3::from_array(at.map(|b| (b as f64 + 0.5) * middles.side));
            let through = |way: &Vec3| {
                let ray: Ray = space.ray(middle, *way);
                let Some((near, far)) = middles.span(ray.origin, ray.direction) else { return 1.0 };
                let mut depth = 0.0;
                middles.walk(ray.origin, ray.direction, near, far, |from, to, middle| {
                    depth += middle[0] * (to - from) as f32;
                    false
                });
                (-sigma * depth).exp()
            };
            let through: Vec<f32> = ways.iter().map(through).collect();
            outlook(sky.parts(), |bin| through[bin])
        };
        let mut outlooks = vec![outlook(sky.parts(), |_| 1.0)];
        let mut places = vec![0; middles.bounds.len()];
        for (place, &brick) in dense.iter().enumerate() {
            places[brick] = place as u32 + 1;
        }
        outlooks.extend(dense.par_iter().map(of_brick).collect::<Vec<_>>());
        Self { outlooks, places, bricks: middles.bricks, per_brick: 1.0 / middles.side }
    }

    /// The guess that holds around `at` (node space), for `jitter` in [0, 1)^3.
    #[inline(always)]
    pub fn around(&self, at: DVec3, jitter: [f32; 3]) -> &Outlook {
        let brick = |a: usize| {
            let b = at[a] * self.per_brick + f64::from(jitter[a]) - 0.5;
            (b as i64).clamp(0, self.bricks[a] as i64 - 1) as usize
        };
        let brick = brick(0) + self.bricks[0] * (brick(1) + self.bricks[1] * brick(2));
        &self.outlooks[self.places[brick] as usize]
    }
}

/// The guess of a brick through whose smoke a part `through` of each tile's light comes.
fn outlook(parts: &[f32; BINS], through: impl Fn(usize) -> f32) -> Outlook {
    let mean: f32 = (0..BINS).map(|b| parts[b] * through(b)).sum();
    Outlook { sums: chances(parts, through), look: (mean / FULL).clamp(SELDOM, 1.0) }
}

/// Sums of the chances of tiles drawn by `parts * (through + FLOOR * mean)`.
fn chances(parts: &[f32; BINS], through: impl Fn(usize) -> f32) -> [u16; BINS] {
    let mean: f32 = (0..BINS).map(|b| parts[b] * through(b)).sum();
    let weight = |b: usize| f64::from(parts[b] * (through(b) + FLOOR * mean + f32::MIN_POSITIVE));
    let total: f64 = (0..BINS).map(weight).sum();
    let lit = parts.iter().filter(|&&p| p > 0.0).count() as u32;
    // One for each tile with light, the rest by weight; what rounding leaves over goes to the heaviest.
    let free = f64::from(WHOLE - lit);
    let mut counts: [u32; BINS] =
        std::array::from_fn(|b| if parts[b] > 0.0 { 1 + (weight(b) / total * free) as u32 } else { 0 });
    let heaviest = (0..BINS).max_by(|&a, &b| counts[a].cmp(&counts[b])).unwrap_or(0);
    counts[heaviest] += WHOLE.saturating_sub(counts.iter().sum());
    let mut sum = 0;
    counts.map(|count| {
        sum += count;
        sum as u16
    })
}

/// Draws a tile by `u` in [0, 1): the tile, its chance, and `u` stretched again to [0, 1).
#[inline(always)]
pub fn draw(sums: &[u16; BINS], u: f32) -> (usize, f32, f32) {
    let target = f64::from(u) * f64::from(WHOLE);
    let whole = target as u32;
    let bin = sums.partition_point(|&s| u32::from(s) <= whole).min(BINS - 1);
    let (before, count) = span(sums, bin);
    (bin, count as f32 / WHOLE as f32, ((target - f64::from(before)) / f64::from(count.max(1))) as f32)
}

/// Chance of a tile.
#[inline(always)]
pub fn chance(sums: &[u16; BINS], bin: usize) -> f32 {
    span(sums, bin).1 as f32 / WHOLE as f32
}

/// Sum before a tile, and its own count.
#[inline(always)]
fn span(sums: &[u16; BINS], bin: usize) -> (u32, u32) {
    let before = if bin == 0 { 0 } else { u32::from(sums[bin - 1]) };
    (before, u32::from(sums[bin]) - before)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Environment;
    use crate::medium::field::DensityField;
    use glam::DAffine3;

    /// A sky with a black third, and one tile like a sun.
    fn sky() -> Sky {
        let (width, height) = (64, 32);
        let radiance = |t: usize| match (t % width, t / width) {
            (x, _) if x < 20 => [0.0; 3],
            (40, 9) => [900.0, 700.0, 300.0],
            _ => [0.5, 0.7, 1.0],
        };
        let radiance = (0..width * height).map(radiance).collect();
        Sky::new(&Environment { width, height, radiance, ..Environment::constant([0.0; 3]) }).unwrap()
    }

    #[test]
    fn chances_add_up_to_the_whole_and_every_tile_with_light_has_one() {
        let sky = sky();
        for through in
            [|_: usize| 1.0, |b: usize| if b == 77 { 1.0 } else { 0.0 }, |_| 0.0, |b| (b as f32 * -1.5).exp()]
        {
            let sums = chances(sky.parts(), through);
            assert_eq!(u32::from(sums[BINS - 1]), WHOLE);
            let total: f32 = (0..BINS).map(|b| chance(&sums, b)).sum();
            assert!((total - 1.0).abs() < 1e-5);
            for bin in 0..BINS {
                assert_eq!(chance(&sums, bin) > 0.0, sky.parts()[bin] > 0.0, "{bin}");
            }
        }
    }

    #[test]
    fn tiles_are_drawn_by_their_chances_and_what_is_left_of_the_number_is_uniform() {
        let sums = chances(sky().parts(), |b| 1.0 + (b % 5) as f32);
        let n = 1 << 20;
        let (mut hits, mut rest) = ([0u32; BINS], 0.0);
        for i in 0..n {
            let (bin, chance_drawn, left) = draw(&sums, i as f32 / n as f32);
            hits[bin] += 1;
            rest += f64::from(left);
            assert_eq!(chance_drawn, chance(&sums, bin));
            assert!((0.0..=1.0).contains(&left));
        }
        // Evenly spaced numbers: off by one at either end of a tile.
        for bin in 0..BINS {
            let expected = f64::from(chance(&sums, bin)) * f64::from(n);
            assert!((f64::from(hits[bin]) - expected).abs() <= 2.0, "{bin} {} {expected}", hits[bin]);
        }
        assert!((rest / f64::from(n) - 0.5).abs() < 1e-3);
    }

    #[test]
    fn behind_a_wall_the_open_side_of_the_sky_is_preferred() {
        let values: Vec<f32> = (0..16 * 16 * 16).map(|v| if v % 16 < 8 { 1.0 } else { 0.01 }).collect();
        let field = DensityField::from_box([0; 3], [16; 3], &values, DAffine3::IDENTITY);
        let sky = Sky::new(&Environment::constant([1.0; 3])).unwrap();
        let space = Space::new(&field, 1.0);
        let guide = Guide::new(&space, &Majorants::middles(&field, 2), &sky, 1.0);
        let sums = &guide.around(DVec3::new(10.0, 8.5, 8.5), [0.5; 3]).sums;
        let toward =
            |x: f32| -> f32 { (0..BINS).filter(|&b| sky.middle(b).x * x > 0.5).map(|b| chance(sums, b)).sum() };
        assert!(toward(1.0) > 3.0 * toward(-1.0), "{} {}", toward(1.0), toward(-1.0));
    }
}
