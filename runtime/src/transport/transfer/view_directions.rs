//! The directions from the eye to the smoke, on a grid: what depends on direction alone is found once for each.
//!
//! A cube around the eye has [`squares`] squares along a side of a face, the more the stronger light is scattered forward
//! or back; only corners of squares that the smoke is seen through are used. Between corners values are bilinear: a band l
//! of a function is off by `l (l + 1) h^2 / 8`, h the angle of a square, 0.1 radians at g = 0.5: 1.5 % of band 3, which
//! has an eighth of the light. For an orthographic view all of it would be one direction (Zhang et al. 2013, Eq. 20,
//! evaluates one for each cluster, which is right for that view only).
//! Cost: a few operations a node, once for the marks and once for the read.

use glam::DVec3;

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
    /// The square of a vector from the eye of any length above 0, where a side of a face has so many; a zero vector counts
    /// as +x.
    #[inline(always)]
    pub fn of(v: DVec3, squares: usize) -> Self {
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
        let place = [one, other].map(|c| (c * scale + 1.0) * (0.5 * squares as f64));
        let low = place.map(|p| (p as usize).min(squares - 1));
        let face = 2 * axis + usize::from(major < 0.0);
        let fraction = [0, 1].map(|a| (place[a] - low[a] as f64) as f32);
        let corners = squares + 1;
        Self { square: (face * corners + low[1]) * corners + low[0], fraction }
    }

    fn corners(&self, squares: usize) -> [usize; 4] {
        let next = self.square + squares + 1;
        [self.square, self.square + 1, next, next + 1]
    }
}

impl ViewDirections {
    /// The corners of the squares that any of `seen`, made with as many squares, lie in.
    pub fn of(seen: impl Iterator<Item = Between>, squares: usize) -> Self {
        let mut marks = vec![false; 6 * (squares + 1) * (squares + 1)];
        seen.for_each(|between| marks[between.square] = true);
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

    /// Places in [`Self::directions`] of the four corners around a direction that was seen, and their weights.
    #[inline(always)]
    pub fn around(&self, between: Between) -> [(u32, f32); 4] {
        let [f, g] = between.fraction;
        let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
        let corners = between.corners(self.squares);
        [0, 1, 2, 3].map(|c| (self.places[corners[c]], weights[c]))
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
        let view = ViewDirections::of(seen.iter().map(|v| Between::of(*v * 3.7, 32)), 32);
        for v in &seen {
            let around = view.around(Between::of(*v, 32));
            assert!((around.iter().map(|a| a.1).sum::<f32>() - 1.0).abs() < 1e-6);
            let mean = around.iter().fold(DVec3::ZERO, |s, (d, w)| s + view.directions()[*d as usize] * f64::from(*w));
            // A linear function, off by h^2 / 8 at most.
            assert!((mean - *v).length() < 0.0625f64.powi(2) / 4.0, "{v} {mean}");
        }
        assert!(view.directions().iter().all(|d| (d.length() - 1.0).abs() < 1e-12));
    }

    #[test]
    fn only_what_is_seen_is_used_and_odd_vectors_are_no_trouble() {
        let near = [DVec3::new(1.0, 0.1, 0.1), DVec3::new(1.0, 0.11, 0.1)].map(|v| Between::of(v, 12));
        let view = ViewDirections::of(near.into_iter(), 12);
        assert_eq!(view.directions().len(), 4);
        for v in [DVec3::ZERO, DVec3::new(1.0, 1.0, 1.0), DVec3::new(-1.0, 1.0, -1.0), DVec3::new(0.0, -1e-300, 0.0)] {
            let view = ViewDirections::of([v].map(|v| Between::of(v, 12)).into_iter(), 12);
            assert!(view.around(Between::of(v, 12)).iter().all(|(d, w)| (*d as usize) < 4 && w.is_finite()));
        }
    }
}
