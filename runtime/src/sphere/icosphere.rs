//! The sphere as a mesh of nearly equal triangles: an icosahedron, halved again and again.
//!
//! Level s has `10 4^s + 2` nodes and `20 4^s` triangles: 12, 42, 162, 642, 2562 nodes. Edges are cut in the middle and
//! the middle is moved out to the sphere. The triangle of a direction is found from one near it, by a table over a cube,
//! and across the sides that the direction is outside of: three products for each triangle on the way, most often one.
//! Source: Zhang, Dong and Ma 2013, section 4.1 (the directions of the discrete spherical function).

use glam::DVec3;
use std::collections::HashMap;

/// The finest level that is made: 2562 nodes.
pub const MAX_LEVEL: u32 = 4;

/// Directions and the triangles between them.
#[derive(Clone, Debug)]
pub struct Icosphere {
    level: u32,
    directions: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    /// For each triangle `abc`: `b x c`, `c x a`, `a x b`: how far inside a direction is of the sides across from a, b, c,
    /// and its place between them once their sum is made 1.
    sides: Vec<[DVec3; 3]>,
    /// For each triangle, the one across the side across from a, b, c.
    across: Vec<[u16; 3]>,
    /// A triangle near the middle of each field of a cube's faces, `[face][row][column]`.
    near: Vec<u16>,
}

impl Icosphere {
    /// The mesh of `level`, at most [`MAX_LEVEL`].
    ///
    /// # Panics
    /// If the level is above [`MAX_LEVEL`].
    pub fn new(level: u32) -> Self {
        assert!(level <= MAX_LEVEL, "level {level} is above {MAX_LEVEL}");
        let (mut directions, triangles) = icosahedron();
        let mut triangles = triangles;
        for _ in 0..level {
            let mut middles = HashMap::new();
            let mut middle = |a: u32, b: u32| {
                *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    directions.push((directions[a as usize] + directions[b as usize]).normalize());
                    directions.len() as u32 - 1
                })
            };
            let mut finer = Vec::with_capacity(4 * triangles.len());
            for &[a, b, c] in &triangles {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                finer.extend([[ab, bc, ca], [a, ab, ca], [b, bc, ab], [c, ca, bc]]);
            }
            triangles = finer;
        }
        let sides = |&triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|n| directions[n as usize]);
            [b.cross(c), c.cross(a), a.cross(b)]
        };
        let sides = triangles.iter().map(sides).collect();
        let mut of_edge = HashMap::new();
        for (t, &[a, b, c]) in triangles.iter().enumerate() {
            // At most 5120 triangles.
            of_edge.extend([(b, c), (c, a), (a, b)].map(|edge| (edge, t as u16)));
        }
        let across = triangles.iter().map(|&[a, b, c]| [(c, b), (a, c), (b, a)].map(|edge| of_edge[&edge])).collect();
        let mut mesh = Self { level, directions, triangles, sides, across, near: Vec::new() };
        let mut t = 0;
        for field in 0..6 * FIELDS * FIELDS {
            t = mesh.holding(t, middle(field));
            mesh.near.push(t as u16);
        }
        mesh
    }

    /// The level with `nodes` nodes, if there is one.
    pub fn level_of(nodes: usize) -> Option<u32> {
        (0..=MAX_LEVEL).find(|level| 10 * 4usize.pow(*level) + 2 == nodes)
    }

    /// How often edges were halved.
    pub fn level(&self) -> u32 {
        self.level
    }

    /// The nodes: unit vectors.
    pub fn directions(&self) -> &[DVec3] {
        &self.directions
    }

    /// The triangles of the finest level: three nodes each, counter-clockwise seen from outside.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// The triangle that holds a unit direction; one of both on a common side.
    pub fn triangle(&self, direction: DVec3) -> usize {
        self.holding(usize::from(self.near[field(direction)]), direction)
    }

    /// The triangle that holds a direction, on a way from another.
    fn holding(&self, from: usize, direction: DVec3) -> usize {
        let mut found = from;
        // A way is never as long; rounding, or a direction that is no number, must not make it endless.
        for _ in 0..self.triangles.len() {
            let [a, b, c] = self.sides[found].map(|side| side.dot(direction));
            let least = a.min(b).min(c);
            // On a side, by rounding outside of both; no number ends the way too.
            if least >= -5e-16 || least.is_nan() {
                break;
            }
            let side = if least == a {
                0
            } else if least == b {
                1
            } else {
                2
            };
            found = usize::from(self.across[found][side]);
        }
        found
    }

    /// The place of a unit direction between the corners of a triangle of the finest level: the direction is their sum times
    /// these, up to its length. >= 0 inside, sum 1.
    pub fn barycentric(&self, triangle: usize, direction: DVec3) -> [f64; 3] {
        let inside = self.sides[triangle].map(|side| side.dot(direction).max(0.0));
        let sum: f64 = inside.iter().sum();
        inside.map(|v| v / sum)
    }

    /// Solid angle of a triangle of the finest level (Van Oosterom and Strackee 1983).
    pub fn solid_angle(&self, triangle: usize) -> f64 {
        let [a, b, c] = self.triangles()[triangle].map(|n| self.directions[n as usize]);
        let below = 1.0 + a.dot(b) + b.dot(c) + c.dot(a);
        2.0 * a.dot(b.cross(c)).atan2(below)
    }

    /// For each triangle of the finest level, the node across each of its sides `ab`, `bc`, `ca`.
    pub fn opposite_nodes(&self) -> Vec<[u32; 3]> {
        let mut across = HashMap::new();
        for &[a, b, c] in self.triangles() {
            across.extend([((a, b), c), ((b, c), a), ((c, a), b)]);
        }
        self.triangles().iter().map(|&[a, b, c]| [across[&(b, a)], across[&(c, b)], across[&(a, c)]]).collect()
    }
}

/// Fields along a side of a face of the cube: at 642 nodes a third of an edge.
const FIELDS: usize = 32;

/// The field of a direction of any length.
#[inline(always)]
fn field(v: DVec3) -> usize {
    let size = v.abs();
    let axis = if size.x >= size.y.max(size.z) { 0 } else { 1 + usize::from(size.z > size.y) };
    let [x, y, z] = v.to_array();
    let [major, one, other] = [[x, y, z], [y, z, x], [z, x, y]][axis];
    let scale = (0.5 * FIELDS as f64) / major.abs();
    let [column, row] = [one, other].map(|c| ((c * scale + 0.5 * FIELDS as f64) as usize).min(FIELDS - 1));
    ((2 * axis + usize::from(major < 0.0)) * FIELDS + row) * FIELDS + column
}

/// A direction to the middle of a field, not of unit length.
fn middle(field: usize) -> DVec3 {
    let place = |n: usize| (2 * n + 1) as f64 / FIELDS as f64 - 1.0;
    let (one, other) = (place(field % FIELDS), place(field / FIELDS % FIELDS));
    let face = field / (FIELDS * FIELDS);
    let major = if face.is_multiple_of(2) { 1.0 } else { -1.0 };
    match face / 2 {
        0 => DVec3::new(major, one, other),
        1 => DVec3::new(other, major, one),
        _ => DVec3::new(one, other, major),
    }
}

/// Twelve nodes, twenty triangles, counter-clockwise seen from outside.
fn icosahedron() -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let golden = 0.5 * (1.0 + 5.0f64.sqrt());
    let mut nodes = Vec::with_capacity(12);
    for (one, phi) in [(1.0, golden), (-1.0, golden), (1.0, -golden), (-1.0, -golden)] {
        nodes.extend([DVec3::new(0.0, one, phi), DVec3::new(one, phi, 0.0), DVec3::new(phi, 0.0, one)]);
    }
    // Neighbours are 2 apart; the next nodes 2 phi.
    let near = |a: usize, b: usize| (nodes[a] - nodes[b]).length_squared() < 4.1;
    let mut triangles = Vec::with_capacity(20);
    for a in 0..12 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                if near(a, b) && near(b, c) && near(c, a) {
                    let outward = nodes[a].dot(nodes[b].cross(nodes[c])) > 0.0;
                    triangles.push(if outward { [a, b, c] } else { [a, c, b] }.map(|n| n as u32));
                }
            }
        }
    }
    (nodes.into_iter().map(DVec3::normalize).collect(), triangles)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Directions in general position, the same every time.
    pub(crate) fn directions(count: usize) -> impl Iterator<Item = DVec3> {
        // A spiral of the golden angle.
        (0..count).map(move |i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
            let (s, c) = (i as f64 * 2.399_963_229_728_653).sin_cos();
            let r = (1.0 - z * z).sqrt();
            DVec3::new(r * c, r * s, z)
        })
    }

    #[test]
    fn levels_have_their_nodes_and_triangles_and_cover_the_sphere_once() {
        for level in 0..=MAX_LEVEL {
            let mesh = Icosphere::new(level);
            assert_eq!(mesh.directions().len(), 10 * 4usize.pow(level) + 2);
            assert_eq!(mesh.triangles().len(), 20 * 4usize.pow(level));
            let total: f64 = (0..mesh.triangles().len()).map(|t| mesh.solid_angle(t)).sum();
            assert!((total / (4.0 * std::f64::consts::PI) - 1.0).abs() < 1e-12, "{total}");
            assert!(mesh.directions().iter().all(|d| (d.length() - 1.0).abs() < 1e-15));
        }
        assert_eq!((Icosphere::level_of(642), Icosphere::level_of(643)), (Some(3), None));
    }

    #[test]
    fn the_triangle_of_a_direction_is_the_one_that_holds_it() {
        let mesh = Icosphere::new(3);
        for d in directions(5000).chain(mesh.directions().iter().copied()) {
            let [a, b, c] = mesh.triangles()[mesh.triangle(d)].map(|n| mesh.directions()[n as usize]);
            for (p, q) in [(a, b), (b, c), (c, a)] {
                // A direction on a side may be a rounding outside.
                assert!(p.cross(q).dot(d) > -1e-15, "{d}");
            }
        }
    }

    #[test]
    fn a_field_of_the_cube_holds_its_middle_and_odd_directions_have_some_triangle() {
        for at in 0..6 * FIELDS * FIELDS {
            assert_eq!(field(middle(at)), at);
        }
        let mesh = Icosphere::new(2);
        for d in [DVec3::ZERO, DVec3::NAN, DVec3::X, DVec3::ONE, DVec3::new(-1.0, 1.0, -1.0), DVec3::NEG_Z] {
            assert!(mesh.triangle(d) < mesh.triangles().len(), "{d}");
        }
    }

    #[test]
    fn opposite_nodes_are_the_third_nodes_of_the_neighbours() {
        let mesh = Icosphere::new(2);
        for (t, across) in mesh.opposite_nodes().iter().enumerate() {
            let [a, b, c] = mesh.triangles()[t];
            for (pair, far) in [([a, b], across[0]), ([b, c], across[1]), ([c, a], across[2])] {
                let holds = |t: &&[u32; 3]| pair.iter().chain([&far]).all(|n| t.contains(n));
                assert_eq!(mesh.triangles().iter().filter(holds).count(), 1);
                assert!(![a, b, c].contains(&far));
            }
        }
    }
}
