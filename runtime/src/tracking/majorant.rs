//! Bounds of the density from above and below, brick by brick, and the walk of a ray through them.
//!
//! Null-collision tracking (Woodcock et al. 1965) needs a bound of the density along the ray, and costs as many steps as
//! the bound is deep; a bound for each brick (Szirmay-Kalos et al. 2011, Yue et al. 2010) follows the smoke. Bricks have
//! `2^shift` cells a side, and a trilinear density is bounded by its nodes. A ray walks from brick to brick (Amanatides
//! and Woo 1987). Cost: O(nodes) once, a few operations a brick on the way.

use crate::medium::field::DensityField;
use glam::DVec3;
use rayon::prelude::*;

/// A brick's bounds of the density: `[lower, upper]`.
pub type Bounds = [f32; 2];

/// The bounds of one frame.
pub struct Majorants {
    /// Those of each brick, x fastest; or the middle between them twice.
    pub bounds: Vec<Bounds>,
    /// Bricks along x, y, z.
    pub bricks: [usize; 3],
    /// Cells along a side of a brick.
    pub side: f64,
    /// Far corner of the field, node space.
    top: DVec3,
}

impl Majorants {
    /// Bounds over bricks of `2^shift` cells a side.
    pub fn new(field: &DensityField, shift: u32) -> Self {
        let side = 1usize << shift;
        let bricks = field.dims.map(|n| (n - 1).div_ceil(side));
        let [nx, ny, nz] = field.dims;
        // A node on the face between two bricks counts for both.
        let of = |brick: usize, n: usize| brick * side..((brick + 1) * side + 1).min(n);
        let bound = |brick: usize| {
            let (y, z) = (brick / bricks[0] % bricks[1], brick / bricks[0] / bricks[1]);
            let (mut low, mut high) = (f32::INFINITY, 0.0f32);
            for k in of(z, nz) {
                for j in of(y, ny) {
                    let line = nx * (j + ny * k);
                    for &value in &field.values[line..line + nx][of(brick % bricks[0], nx)] {
                        (low, high) = (low.min(value), high.max(value));
                    }
                }
            }
            [low, high]
        };
        let bounds = (0..bricks.iter().product()).into_par_iter().map(bound).collect();
        let top = DVec3::new((nx - 1) as f64, (ny - 1) as f64, (nz - 1) as f64);
        Self { bounds, bricks, side: side as f64, top }
    }

    /// Not bounds but the middle between them: for guesses of a transmittance.
    pub fn middles(field: &DensityField, shift: u32) -> Self {
        let mut bricks = Self::new(field, shift);
        bricks.bounds.iter_mut().for_each(|[low, high]| (*low, *high) = (0.5 * (*low + *high), 0.5 * (*low + *high)));
        bricks
    }

    /// Where a ray is inside the field's box, as distances along `direction` from `origin`, node space, at least 0.
    #[inline(always)]
    pub fn span(&self, origin: DVec3, direction: DVec3) -> Option<(f64, f64)> {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for a in 0..3 {
            if direction[a] == 0.0 {
                if !(origin[a] >= 0.0 && origin[a] <= self.top[a]) {
                    return None;
                }
                continue;
            }
            let inverse = 1.0 / direction[a];
            let (t0, t1) = (-origin[a] * inverse, (self.top[a] - origin[a]) * inverse);
            near = near.max(t0.min(t1));
            far = far.min(t0.max(t1));
        }
        (near < far).then_some((near, far))
    }

    /// Calls `visit(from, to, bounds)` for every brick with density along the ray between the distances `near` and `far`
    /// (inside [`Self::span`]), in order, until it returns true.
    #[inline(always)]
    pub fn walk(
        &self,
        origin: DVec3,
        direction: DVec3,
        near: f64,
        far: f64,
        mut visit: impl FnMut(f64, f64, Bounds) -> bool,
    ) {
        self.walk_bricks(origin, direction, near, far, |from, to, brick| visit(from, to, self.bounds[brick]));
    }

    /// The same with the number of the brick in place of its bounds.
    #[inline(always)]
    pub fn walk_bricks(
        &self,
        origin: DVec3,
        direction: DVec3,
        near: f64,
        far: f64,
        mut visit: impl FnMut(f64, f64, usize) -> bool,
    ) {
        let start = origin + direction * near;
        let per_brick = 1.0 / self.side;
        let (mut place, mut leaves, mut between) = ([0isize; 3], [f64::INFINITY; 3], [f64::INFINITY; 3]);
        let (mut stride, mut step, mut at) = ([0isize; 3], [0isize; 3], 0isize);
        let mut size = 1isize;
        for a in 0..3 {
            let last = self.bricks[a] as isize - 1;
            let mut b = ((start[a] * per_brick) as isize).clamp(0, last);
            // On a face, the brick ahead.
            if direction[a] < 0.0 && start[a] <= b as f64 * self.side && b > 0 {
                b -= 1;
            }
            if direction[a] != 0.0 {
                let inverse = 1.0 / direction[a];
                let face = (b + isize::from(direction[a] > 0.0)) as f64 * self.side;
                leaves[a] = (face - origin[a]) * inverse;
                between[a] = self.side * inverse.abs();
                step[a] = if direction[a] > 0.0 { 1 } else { -1 };
            }
            place[a] = b;
            at += b * size;
            stride[a] = step[a] * size;
            size *= self.bricks[a] as isize;
        }
        let mut from = near;
        loop {
            let axis = if leaves[0] < leaves[1] {
                if leaves[0] < leaves[2] { 0 } else { 2 }
            } else if leaves[1] < leaves[2] {
                1
            } else {
                2
            };
            let to = leaves[axis].min(far);
            if self.bounds[at as usize][1] > 0.0 && to > from && visit(from, to, at as usize) {
                return;
            }
            if leaves[axis] >= far {
                return;
            }
            place[axis] += step[axis];
            if place[axis] < 0 || place[axis] >= self.bricks[axis] as isize {
                return;
            }
            from = from.max(to);
            at += stride[axis];
            leaves[axis] += between[axis];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tracking::sampler::Random;
    use glam::DAffine3;

    fn field() -> DensityField {
        let dims = [13, 7, 10];
        let mut random = Random::new(5);
        let values: Vec<f32> =
            (0..dims.iter().product()).map(|_| (random.unit() - 0.9).max(0.0) * random.unit() * 100.0).collect();
        DensityField::from_box([0; 3], dims, &values, DAffine3::IDENTITY)
    }

    #[test]
    fn every_density_along_a_ray_is_inside_a_visited_piece_and_below_its_bound() {
        let field = field();
        let mut random = Random::new(9);
        let mut met = 0;
        for shift in [0, 1, 2, 3, 5] {
            let majorants = Majorants::new(&field, shift);
            for case in 0..3000 {
                let mut unit = || f64::from(random.unit());
                let mut origin = DVec3::new(unit() * 20.0 - 3.0, unit() * 14.0 - 3.0, unit() * 17.0 - 3.0);
                let mut direction = DVec3::new(unit() - 0.5, unit() - 0.5, unit() - 0.5);
                if case % 3 == 0 {
                    // Along axes and through nodes.
                    direction[case % 2] = 0.0;
                    origin = origin.round();
                }
                if case % 6 == 0 {
                    direction[2] = 0.0;
                }
                let Some((near, far)) = majorants.span(origin, direction) else { continue };
                let mut pieces = Vec::new();
                majorants.walk(origin, direction, near, far, |from, to, bound| {
                    pieces.push((from, to, bound));
                    false
                });
                assert!(pieces.windows(2).all(|w| w[0].1 <= w[1].0 + 1e-12), "{pieces:?}");
                for i in 0..100 {
                    let t = near + (far - near) * (f64::from(i) + 0.5) / 100.0;
                    let density = field.sample((origin + direction * t).as_vec3());
                    if density > 1e-4 {
                        met += 1;
                        let bounds = pieces.iter().filter(|p| p.0 - 1e-9 <= t && t <= p.1 + 1e-9).map(|p| p.2);
                        let bound = bounds.clone().map(|b| b[1]).fold(0.0, f32::max);
                        let least = bounds.map(|b| b[0]).fold(f32::INFINITY, f32::min);
                        assert!(
                            least * 0.99999 <= density && density <= bound * 1.00001,
                            "{density} {bound} {shift} {origin} {direction} {t}"
                        );
                    }
                }
            }
        }
        assert!(met > 10_000);
    }

    #[test]
    fn a_walk_ends_where_it_is_told_to_and_misses_have_no_span() {
        let majorants = Majorants::new(&field(), 1);
        let (origin, direction) = (DVec3::new(-2.0, 4.1, 5.2), DVec3::X);
        let (near, far) = majorants.span(origin, direction).unwrap();
        assert!((near - 2.0).abs() < 1e-12 && (far - 16.0).abs() < 1e-12);
        let mut count = 0;
        majorants.walk(origin, direction, near, far, |_, _, _| {
            count += 1;
            count == 2
        });
        assert_eq!(count, 2);
        assert!(majorants.span(origin, DVec3::NEG_X).is_none());
        assert!(majorants.span(origin, DVec3::Y).is_none());
    }
}
