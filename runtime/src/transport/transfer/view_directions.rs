//! The directions from the eye to the smoke, on a grid: what depends on direction alone is found once for each.
//!
//! A cube around the eye has [`squares`] squares along a side of a face, the more the stronger light is scattered forward
//! or back; only corners of squares that the smoke is seen through are used. Between corners values are bilinear: a band l
//! of a function is off by `l (l + 1) h^2 / 8` at most, h the angle of a square, 0.1 radians at g = 0.5: 1.5 % of band 3,
//! which has an eighth of the light. For an orthographic view all of it would be one direction (Zhang et al. 2013, Eq. 20,
//! evaluates one for each cluster, which is right for that view only).
//! Cost: a few operations a node to read, and for a brick to mark what is used.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

const UNUSED: u32 = u32::MAX;

/// Squares along a side of a face of the cube: about five across the peak of a phase function, 12 to 64.
pub fn squares(g: f32) -> usize {
    ((10.0 / (1.0 - g.abs())) as usize).clamp(12, 64)
}

/// The corners in use.
pub struct ViewDirections {
    /// Place of each corner of each face among those used.
    places: Vec<u32>,
    /// Their unit directions from the eye.
    directions: Vec<DVec3>,
    squares: usize,
}

/// A direction between four corners.
#[derive(Clone, Copy, Debug)]
pub struct Between {
    square: usize,
    fraction: [f32; 2],
}

impl Between {
    /// The square of a vector from the eye of any length, where a side of a face has so many; a zero vector counts
    /// as +x.
    #[inline(always)]
    pub fn of(v: Vec3, squares: usize) -> Self {
        let size = v.abs();
        let axis = if size.x >= size.y && size.x >= size.z {
            0
        } else if size.y >= size.z {
            1
        } else {
            2
        };
        let [major, one, other] = match axis {
            0 => [v.x, v.y, v.z],
            1 => [v.y, v.z, v.x],
            _ => [v.z, v.x, v.y],
        };
        let scale = if major != 0.0 { 1.0 / major.abs() } else { 0.0 };
        let place = [one, other].map(|c| (c * scale + 1.0) * (0.5 * squares as f32));
        let low = place.map(|p| (p as usize).min(squares - 1));
        let face = 2 * axis + usize::from(major < 0.0);
        let fraction = [0, 1].map(|a| place[a] - low[a] as f32);
        let corners = squares + 1;
        Self { square: (face * corners + low[1]) * corners + low[0], fraction }
    }

    fn corners(&self, squares: usize) -> [usize; 4] {
        let next = self.square + squares + 1;
        [self.square, self.square + 1, next, next + 1]
    }
}

impl ViewDirections {
    /// The corners of the squares that the nodes of boxes lie in: for each box its first node from the eye and its sides;
    /// node `[i, j, k]` lies at `first + i edges[0] + ...`, `0 <= i <= sides[0]` and so on.
    pub fn of_boxes(boxes: &[(Vec3, [usize; 3])], edges: [Vec3; 3], squares: usize) -> Self {
        let nothing = || vec![false; 6 * (squares + 1) * (squares + 1)];
        let mark = |mut marks: Vec<bool>, (first, sides): &(Vec3, [usize; 3])| {
            let square =
                |[i, j, k]: [f32; 3]| Between::of(*first + edges[0] * i + edges[1] * j + edges[2] * k, squares).square;
            let edge = edges.iter().fold(f32::INFINITY, |least, edge| least.min(edge.length()));
            let nodes_away = first.abs().max_element() / edge.max(f32::MIN_POSITIVE);
            let margin = (LEAST_MARGIN + 1e-6 * nodes_away).min(0.05);
            mark(&mut marks, &square, squares + 1, margin, [0; 3], *sides);
            marks
        };
        let either = |mut a: Vec<bool>, b: Vec<bool>| {
            a.iter_mut().zip(b).for_each(|(a, b)| *a |= b);
            a
        };
        let marks = boxes.par_iter().fold(nothing, mark).reduce(nothing, either);
        let mut places = vec![UNUSED; marks.len()];
        let mut directions = Vec::new();
        for square in (0..marks.len()).filter(|&s| marks[s]) {
            for corner in (Between { square, fraction: [0.0; 2] }).corners(squares) {
                if places[corner] == UNUSED {
                    places[corner] = directions.len() as u32;
                    directions.push(direction(corner, squares));
                }
            }
        }
        Self { places, directions, squares }
    }

    /// Unit directions from the eye.
    pub fn directions(&self) -> &[DVec3] {
        &self.directions
    }

    /// Squares along a side of a face.
    pub fn squares(&self) -> usize {
        self.squares
    }

    /// For each corner of each face, `[face][row][column]`, its place in [`Self::directions`], or `u32::MAX`.
    pub fn places(&self) -> &[u32] {
        &self.places
    }

    /// Places in [`Self::directions`] of the four corners around a direction that was seen, and their weights.
    #[inline(always)]
    pub fn around(&self, between: Between) -> ([u32; 4], [f32; 4]) {
        let [f, g] = between.fraction;
        let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
        let corners = between.corners(self.squares);
        // A corner that is not in use has next to no weight, by rounding.
        let last = self.directions.len().saturating_sub(1) as u32;
        (corners.map(|c| self.places[c].min(last)), weights)
    }
}

/// What a box of nodes is enlarged by at least, in nodes, and more from far away: a node that is rounded to another square
/// than here has that one as well.
const LEAST_MARGIN: f32 = 1e-3;

/// Marks the squares of the nodes `low` to `high`; `square` is that of a place in nodes, a face has `n` to a row. A box
/// whose corners are seen through one face lies between them there, as lines stay lines; others are halved, and those with
/// more squares between them than nodes along a side.
fn mark(
    marks: &mut [bool],
    square: &impl Fn([f32; 3]) -> usize,
    n: usize,
    margin: f32,
    low: [usize; 3],
    high: [usize; 3],
) {
    let corner = |c: usize| {
        square([0, 1, 2].map(|a| if c >> a & 1 == 0 { low[a] as f32 - margin } else { high[a] as f32 + margin }))
    };
    let squares = [0, 1, 2, 3, 4, 5, 6, 7].map(corner);
    let places = squares.map(|square| [square % n, square / n % n, square / n / n]);
    let [first, last] = [usize::min, usize::max].map(|most: fn(usize, usize) -> usize| {
        places.iter().fold(places[0], |so_far, place| [0, 1, 2].map(|a| most(so_far[a], place[a])))
    });
    let longest = [0, 1, 2].into_iter().max_by_key(|&a| high[a] - low[a]).unwrap_or(0);
    // A slanted box, or one near the eye, passes few of the squares between its corners.
    let between = (last[0] - first[0] + 1) * (last[1] - first[1] + 1);
    if first[2] == last[2] && between <= high[longest] - low[longest] + 1 {
        for row in first[1]..=last[1] {
            marks[(first[2] * n + row) * n..][first[0]..=last[0]].fill(true);
        }
    } else if high[longest] > low[longest] {
        let middle = (low[longest] + high[longest]) / 2;
        let (mut end, mut start) = (high, low);
        (end[longest], start[longest]) = (middle, middle + 1);
        mark(marks, square, n, margin, low, end);
        mark(marks, square, n, margin, start, high);
    } else {
        // At the eye, or near it, its own square may be none of its corners'.
        let own = square(low.map(|n| n as f32));
        squares.iter().chain([&own]).for_each(|&square| marks[square] = true);
    }
}

fn direction(corner: usize, squares: usize) -> DVec3 {
    let n = squares + 1;
    let (face, row, column) = (corner / (n * n), corner / n % n, corner % n);
    let place = [column, row].map(|p| 2.0 * p as f64 / squares as f64 - 1.0);
    let major = if face % 2 == 0 { 1.0 } else { -1.0 };
    let v = match face / 2 {
        0 => DVec3::new(major, place[0], place[1]),
        1 => DVec3::new(place[1], major, place[0]),
        _ => DVec3::new(place[0], place[1], major),
    };
    v.normalize()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sphere::icosphere::tests::directions;

    #[test]
    fn a_direction_lies_between_the_corners_of_its_square_whatever_its_face() {
        let seen: Vec<DVec3> = directions(5000).collect();
        let points: Vec<_> = seen.iter().map(|v| (v.as_vec3() * 3.7, [1; 3])).collect();
        let view = ViewDirections::of_boxes(&points, [Vec3::ZERO; 3], 32);
        for v in &seen {
            let (places, weights) = view.around(Between::of(v.as_vec3() * 3.7, 32));
            assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            let around = places.iter().zip(weights);
            let mean = around.fold(DVec3::ZERO, |s, (d, w)| s + view.directions()[*d as usize] * f64::from(w));
            // A linear function, off by h^2 / 8 at most.
            assert!((mean - *v).length() < 0.0625f64.powi(2) / 4.0, "{v} {mean}");
        }
        assert!(view.directions().iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
    }

    #[test]
    fn every_node_of_a_box_has_its_corners_near_and_far_around_the_eye_too() {
        let eyes = [Vec3::new(20.0, 3.0, -4.0), Vec3::new(-2.0, -1.5, -2.2), Vec3::new(3.0, -2.0, 2.9)];
        for corner in eyes.into_iter().chain([Vec3::new(-1.0, -2.1, -1.0), Vec3::splat(-1.01), Vec3::ZERO]) {
            let edges = [Vec3::new(1.0, 0.1, 0.0), Vec3::Y, Vec3::new(0.0, -0.2, 1.0)];
            let view = ViewDirections::of_boxes(&[(corner, [4; 3])], edges, 20);
            for v in 0..125 {
                let at =
                    corner + edges[0] * (v % 5) as f32 + edges[1] * (v / 5 % 5) as f32 + edges[2] * (v / 25) as f32;
                let corners = Between::of(at, 20).corners(20);
                assert!(corners.iter().all(|&c| view.places[c] != UNUSED), "{at}");
            }
        }
    }

    #[test]
    fn only_what_is_seen_is_used_and_odd_vectors_are_no_trouble() {
        let near = [Vec3::new(1.0, 0.1, 0.1), Vec3::new(1.0, 0.11, 0.1)].map(|corner| (corner, [4; 3]));
        let view = ViewDirections::of_boxes(&near, [Vec3::X * 0.01, Vec3::Y * 0.001, Vec3::Z * 0.001], 12);
        assert_eq!(view.directions().len(), 4);
        for v in [Vec3::ZERO, Vec3::ONE, Vec3::new(-1.0, 1.0, -1.0), Vec3::new(0.0, -1e-38, 0.0), Vec3::splat(1e30)] {
            let view = ViewDirections::of_boxes(&[(v, [1; 3])], [Vec3::ZERO; 3], 12);
            let (places, weights) = view.around(Between::of(v, 12));
            assert!(places.iter().all(|d| *d < 4) && weights.iter().all(|w| w.is_finite()));
        }
    }
}
