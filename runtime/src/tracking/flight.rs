//! Free flights and transmittance through a trilinear density, without bias and without a march.
//!
//! *Flight* (Woodcock et al. 1965; colours after Galtier et al. 2013 and Novák et al. 2014): tentative collisions come at
//! the rate of a bound, `sigma_max * bound`; at each, channel c collides with probability `q_c = sigma_c D / (sigma_max
//! bound)`. One draw decides for all channels: it is real with `P = sum w_c q_c / sum w_c`, w the weights so far, and the
//! weights are multiplied by `q_c / P`, or by `(1 - q_c) / (1 - P)` if it is not. The sum of the weights never changes,
//! so no weight grows, however different the channels are. In grey media weights do not change at all.
//! *Transmittance* (ratio tracking with a control: Novák et al. 2014): in a brick with the density between two bounds the
//! lower one, L, attenuates exactly, and tentative collisions come at the rate of their difference H:
//! `exp(-int sigma_c L) * product of (1 - sigma_c / sigma_max (D - L) / H)`. All factors lie in [0, 1]. The middle between
//! the bounds as control halves the collisions, but its factors reach 2: at sigma_t 40 on the plume it took five times
//! as long to the same error.
//! *Column*: along a camera ray the density's integral is exact. In a cell it is a cubic of the distance, and two Gauss
//! points integrate a cubic exactly; so the opacity of a ray has no noise, and the first collision can be placed evenly.
//! Cost: flight and transmittance a look-up for each tentative collision; a column two for each cell with density.

use super::majorant::Majorants;
use super::sampler::Random;
use crate::medium::field::DensityField;
use glam::{DAffine3, DVec3, Vec3};

/// Product of the collisions below which three of four rays end, and the fourth counts for all.
const FAINT: f32 = 0.05;
/// The same for the depth of the lower bounds, and again after each further [`FAINTER`].
const DEEP: f32 = 3.0;
/// The depth over which transmittance falls by four.
const FAINTER: f32 = 1.386_294_4;
/// Half the distance of the two Gauss points, of a piece's length: 1 / (2 sqrt(3)).
const GAUSS: f64 = 0.288_675_134_594_812_9;

/// A ray in node space; distances along it are in world units.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Where it starts.
    pub origin: DVec3,
    /// Nodes per world unit.
    pub direction: DVec3,
}

impl Ray {
    /// The point at `distance`.
    #[inline(always)]
    pub fn at(&self, distance: f64) -> DVec3 {
        self.origin + self.direction * distance
    }
}

/// Extinction per unit density and world length.
#[derive(Clone, Copy, Debug)]
pub struct Extinction {
    /// Each channel's over the largest, in [0, 1].
    ratio: Vec3,
    /// The largest.
    pub max: f32,
    /// All channels equal.
    pub grey: bool,
}

impl Extinction {
    /// `sigma_t` >= 0 and finite.
    pub fn new(sigma_t: [f32; 3]) -> Self {
        let max = sigma_t.into_iter().fold(0.0, f32::max);
        let ratio = if max > 0.0 { Vec3::from_array(sigma_t) / max } else { Vec3::ZERO };
        Self { ratio, max, grey: sigma_t[0] == sigma_t[1] && sigma_t[0] == sigma_t[2] }
    }
}

/// The tentative collisions of one flight: what is left of the optical depth to the next, from brick to brick.
pub struct Steps(f32);

impl Steps {
    /// The first is drawn.
    #[inline(always)]
    pub fn new(random: &mut Random) -> Self {
        Self(random.exponential())
    }

    /// Distance of the tentative collision after `from` where they come at `rate` up to `to`; none if it lies beyond, and
    /// then the next brick goes on with what is left.
    #[inline(always)]
    pub fn next(&mut self, from: f64, to: f64, rate: f32) -> Option<f64> {
        let next = from + f64::from(self.0 / rate);
        // Not "next >= to": an infinite or undefined distance lies beyond every brick.
        if next < to {
            return Some(next);
        }
        self.0 = (self.0 - rate * (to - from) as f32).max(0.0);
        None
    }

    /// Draws the way to the one after.
    #[inline(always)]
    pub fn draw(&mut self, random: &mut Random) {
        self.0 = random.exponential();
    }
}

/// A frame's density with its bounds.
pub struct Space<'a> {
    field: &'a DensityField,
    majorants: Majorants,
    /// Bounds cell by cell: which cells hold anything.
    cells: Majorants,
    node_from_world: DAffine3,
}

/// Mean optical depth across a brick, at the mean density of the smoke, up to which bricks are made larger: a step from
/// brick to brick costs about as much as a tentative collision.
const BRICK_DEPTH: f64 = 0.5;

impl<'a> Space<'a> {
    /// `sigma_max` is the largest extinction, for the size of the bricks.
    pub fn new(field: &'a DensityField, sigma_max: f32) -> Self {
        let (sum, count) =
            field.values.iter().filter(|&&d| d > 0.0).fold((0.0, 0u64), |(s, n), &d| (s + f64::from(d), n + 1));
        let voxel = field.world_from_node.matrix3.determinant().abs().cbrt();
        let depth = sum / count.max(1) as f64 * voxel * f64::from(sigma_max);
        let shift = (2..=4).rev().find(|s| depth * f64::from(1u32 << s) <= BRICK_DEPTH).unwrap_or(2);
        Self {
            field,
            majorants: Majorants::new(field, shift),
            cells: Majorants::new(field, 0),
            node_from_world: field.world_from_node.inverse(),
        }
    }

    /// A ray from a point of node space along a unit vector of the world.
    #[inline(always)]
    pub fn ray(&self, origin: DVec3, way: Vec3) -> Ray {
        Ray { origin, direction: self.node_from_world.matrix3 * way.as_dvec3() }
    }

    /// World to node space.
    pub fn node(&self, world: DVec3) -> DVec3 {
        self.node_from_world.transform_point3(world)
    }

    /// Node to world space.
    pub fn world(&self, node: DVec3) -> DVec3 {
        self.field.world_from_node.transform_point3(node)
    }

    /// Where the ray is inside the box.
    #[inline(always)]
    pub fn span(&self, ray: &Ray) -> Option<(f64, f64)> {
        self.majorants.span(ray.origin, ray.direction)
    }

    /// Trilinear density at a point inside the box; a point outside by rounding counts as on the box.
    #[inline(always)]
    pub fn density(&self, p: DVec3) -> f32 {
        let [nx, ny, nz] = self.field.dims;
        let base = |v: f64, n: usize| (v as i32).clamp(0, n as i32 - 2);
        let (i, j, k) = (base(p.x, nx), base(p.y, ny), base(p.z, nz));
        let f = [(p.x - f64::from(i)) as f32, (p.y - f64::from(j)) as f32, (p.z - f64::from(k)) as f32];
        let start = i as usize + nx * (j as usize + ny * k as usize);
        let values = &self.field.values;
        let row = |at: usize| values[at] + (values[at + 1] - values[at]) * f[0];
        let lerp = |a: f32, b: f32, f: f32| a + (b - a) * f;
        let near = lerp(row(start), row(start + nx), f[1]);
        let far = lerp(row(start + nx * ny), row(start + nx * ny + nx), f[1]);
        lerp(near, far, f[2])
    }

    /// Distance of the next collision along `ray` before `end` (world units), or none. `weight` is multiplied by each
    /// channel's probability over that of what was drawn.
    #[inline(always)]
    pub fn flight(
        &self,
        ray: &Ray,
        end: f64,
        extinction: &Extinction,
        weight: &mut Vec3,
        random: &mut Random,
    ) -> Option<f64> {
        let (near, far) = self.span(ray)?;
        let mut steps = Steps::new(random);
        let mut hit = None;
        self.majorants.walk(ray.origin, ray.direction, near, far.min(end), |from, to, [_, bound]| {
            let rate = extinction.max * bound;
            let per_bound = 1.0 / bound;
            let mut t = from;
            loop {
                let Some(next) = steps.next(t, to, rate) else { return false };
                t = next;
                let q = (self.density(ray.at(t)) * per_bound).clamp(0.0, 1.0);
                let u = random.unit();
                if extinction.grey {
                    if u < q {
                        hit = Some(t);
                        return true;
                    }
                } else {
                    let q = extinction.ratio * q;
                    let real = weight.dot(q) / weight.element_sum();
                    if u < real {
                        *weight *= q / real;
                        hit = Some(t);
                        return true;
                    }
                    *weight *= (Vec3::ONE - q) / (1.0 - real);
                }
                steps.draw(random);
            }
        });
        hit
    }

    /// The next collision of `steps` on the piece of `ray` from `from` to `to`, or none, by the exact depth of its cells:
    /// a fixed price where the density lies so far below its bound that tentative collisions would not end.
    pub fn collision(&self, ray: &Ray, from: f64, to: f64, sigma_t: f32, steps: &mut Steps) -> Option<f64> {
        let mut hit = None;
        self.cells.walk(ray.origin, ray.direction, from, to, |from, to, _| {
            let whole = integral(self, ray, from, to);
            let depth = (f64::from(sigma_t) * whole) as f32;
            if steps.0 < depth {
                hit = Some(place_in(self, ray, from, to, f64::from(steps.0) / f64::from(sigma_t), whole));
                return true;
            }
            steps.0 -= depth;
            false
        });
        hit
    }

    /// An estimate of the transmittance of each channel along `ray` up to `end` (world units; infinite for all the way).
    #[inline(always)]
    pub fn transmittance(&self, ray: &Ray, end: f64, extinction: &Extinction, random: &mut Random) -> Vec3 {
        let Some((near, far)) = self.span(ray) else { return Vec3::ONE };
        let (mut factor, mut depth, mut deep) = (Vec3::ONE, 0.0f32, DEEP);
        let mut steps = Steps::new(random);
        self.majorants.walk(ray.origin, ray.direction, near, far.min(end), |from, to, [low, high]| {
            let (rate, per_difference) = (extinction.max * (high - low), 1.0 / (high - low));
            let mut t = from;
            loop {
                let Some(next) = steps.next(t, to, rate) else {
                    depth += extinction.max * low * (to - from) as f32;
                    if depth > deep {
                        if random.unit() < 0.75 {
                            factor = Vec3::ZERO;
                            return true;
                        }
                        factor *= 4.0;
                        deep = depth + FAINTER;
                    }
                    return false;
                };
                t = next;
                let q = ((self.density(ray.at(t)) - low) * per_difference).clamp(0.0, 1.0);
                factor *= Vec3::ONE - extinction.ratio * q;
                if factor.max_element() < FAINT {
                    if random.unit() < 0.75 {
                        factor = Vec3::ZERO;
                        return true;
                    }
                    factor *= 4.0;
                }
                steps.draw(random);
            }
        });
        let through = extinction.ratio * -depth;
        factor * if extinction.grey { Vec3::splat(through.x.exp()) } else { through.exp() }
    }
}

/// The integral of the density along one ray, piece by piece. Kept from ray to ray for its memory.
#[derive(Default)]
pub struct Column {
    /// From, to, and the integral before.
    pieces: Vec<(f64, f64, f64)>,
    /// Density times world length along the whole ray.
    pub total: f64,
}

impl Column {
    /// Measures `ray` from its start on.
    pub fn measure(&mut self, space: &Space, ray: &Ray) {
        self.pieces.clear();
        self.total = 0.0;
        let Some((near, far)) = space.span(ray) else { return };
        space.majorants.walk(ray.origin, ray.direction, near, far, |from, to, _| {
            space.cells.walk(ray.origin, ray.direction, from, to, |from, to, _| {
                self.pieces.push((from, to, self.total));
                self.total += integral(space, ray, from, to);
                false
            });
            false
        });
    }

    /// Distance to the first density, or none.
    pub fn first(&self) -> Option<f64> {
        self.pieces
            .iter()
            .zip(self.pieces.iter().skip(1).map(|p| p.2).chain([self.total]))
            .find_map(|(piece, after)| (after > piece.2).then_some(piece.0))
    }

    /// Distance at which the integral reaches `target`, between 0 and [`Self::total`].
    pub fn place(&self, space: &Space, ray: &Ray, target: f64) -> f64 {
        let after = self.pieces.partition_point(|p| p.2 <= target).max(1);
        let Some(&(from, to, before)) = self.pieces.get(after - 1) else { return 0.0 };
        let end = self.pieces.get(after).map_or(self.total, |p| p.2);
        place_in(space, ray, from, to, target - before, end - before)
    }
}

/// Distance at which the density's integral from `from` on reaches `target`, on a piece of a ray that lies in one cell and
/// whose integral is `whole`: Newton's method on a rising cubic's integral, bisected where it would leave the bracket.
fn place_in(space: &Space, ray: &Ray, from: f64, to: f64, target: f64, whole: f64) -> f64 {
    let (mut low, mut high) = (from, to);
    let mut t = if whole > 0.0 { from + (to - from) * (target / whole).clamp(0.0, 1.0) } else { from };
    for _ in 0..60 {
        let miss = integral(space, ray, from, t) - target;
        if miss > 0.0 {
            high = t
        } else {
            low = t
        }
        if miss.abs() <= 1e-7 * target || high - low <= 1e-15 * high {
            break;
        }
        let newton = t - miss / f64::from(space.density(ray.at(t)));
        t = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    t
}

/// Integral of the density over a piece of a ray that lies in one cell: exact, up to rounding.
#[inline(always)]
fn integral(space: &Space, ray: &Ray, from: f64, to: f64) -> f64 {
    let (middle, length) = (0.5 * (from + to), to - from);
    let one = space.density(ray.at(middle - GAUSS * length));
    let other = space.density(ray.at(middle + GAUSS * length));
    0.5 * length * f64::from(one + other)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_collision_by_exact_depth_lies_where_the_column_reaches_that_depth() {
        let n = 9;
        let value = |v: usize| ((v * 7919 % 23) as f32 / 23.0 - 0.3).max(0.0) * 0.2f32.powi((v % n / 2) as i32);
        let values: Vec<f32> = (0..n * n * n).map(value).collect();
        let field = DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_scale(DVec3::new(0.5, 0.4, 0.6)));
        let sigma_t = 5.0;
        let space = Space::new(&field, sigma_t);
        let (mut random, mut column, mut met) = (Random::new(3), Column::default(), 0);
        for _ in 0..400 {
            let way = Vec3::new(random.unit(), random.unit() - 0.5, random.unit() - 0.5).normalize();
            let ray = space.ray(DVec3::new(0.5, 5.0, 4.5), way);
            column.measure(&space, &ray);
            let (near, far) = space.span(&ray).unwrap();
            let mut steps = Steps::new(&mut random);
            let depth = steps.0;
            let hit = space.collision(&ray, near, far, sigma_t, &mut steps);
            let left = f64::from(depth) - f64::from(sigma_t) * column.total;
            // Depths are kept in single precision: 1e-6 of ten.
            match hit {
                Some(hit) => {
                    let place = column.place(&space, &ray, f64::from(depth / sigma_t));
                    let between = integral_between(&space, &ray, hit.min(place), hit.max(place));
                    assert!(f64::from(sigma_t) * between < 1e-5 && left < 1e-5, "{hit} {place}");
                    met += 1;
                }
                None => assert!(left > -1e-5 && (f64::from(steps.0) - left).abs() < 1e-5, "{left} {}", steps.0),
            }
        }
        assert!(met > 100 && met < 390, "{met}");
    }

    fn integral_between(space: &Space, ray: &Ray, from: f64, to: f64) -> f64 {
        let mut sum = 0.0;
        space.cells.walk(ray.origin, ray.direction, from, to, |from, to, _| {
            sum += integral(space, ray, from, to);
            false
        });
        sum
    }
}
