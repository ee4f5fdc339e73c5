//! The sphere as a mesh of nearly equal triangles: an icosahedron, halved again and again.
//!
//! Level s has `10 4^s + 2` nodes and `20 4^s` triangles: 12, 42, 162, 642, 2562 nodes. Edges are cut in the middle and
//! the middle is moved out to the sphere, so the children of a triangle cover it exactly, and the triangle of a direction
//! is found level by level. Cost: twenty products, and three for each level.
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
    /// The triangles of every level, coarsest first; children 4t .. 4t + 4 of triangle t are on the next.
    levels: Vec<Vec<[u32; 3]>>,
    /// For each level and triangle `abc`, `b x c`, `c x a`, `a x b`: how far inside a direction is of the sides across from
    /// a, b, c, and its place between them once their sum is made 1.
    sides: Vec<Vec<[DVec3; 3]>>,
    /// Directions to the middles of the icosahedron's triangles.
    middles: Vec<DVec3>,
}

impl Icosphere {
    /// The mesh of `level`, at most [`MAX_LEVEL`].
    ///
    /// # Panics
    /// If the level is above [`MAX_LEVEL`].
    pub fn new(level: u32) -> Self {
        assert!(level <= MAX_LEVEL, "level {level} is above {MAX_LEVEL}");
        let (mut directions, triangles) = icosahedron();
        let mut levels = vec![triangles];
        for _ in 0..level {
            let mut middles = HashMap::new();
            let mut middle = |a: u32, b: u32| {
                *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                    directions.push((directions[a as usize] + directions[b as usize]).normalize());
                    directions.len() as u32 - 1
                })
            };
            let mut finer = Vec::with_capacity(4 * levels[levels.len() - 1].len());
            for &[a, b, c] in &levels[levels.len() - 1] {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                finer.extend([[ab, bc, ca], [a, ab, ca], [b, bc, ab], [c, ca, bc]]);
            }
            levels.push(finer);
        }
        let sides = |&triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|n| directions[n as usize]);
            [b.cross(c), c.cross(a), a.cross(b)]
        };
        let middle = |triangle: &[u32; 3]| triangle.iter().map(|&n| directions[n as usize]).sum::<DVec3>().normalize();
        let middles = levels[0].iter().map(middle).collect();
        let sides = levels.iter().map(|triangles| triangles.iter().map(sides).collect()).collect();
        Self { level, directions, levels, sides, middles }
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
        &self.levels[self.levels.len() - 1]
    }

    /// The triangle that holds a unit direction; one of both on a common side.
    pub fn triangle(&self, direction: DVec3) -> usize {
        // The sides of the icosahedron's triangles are halfway between their middles: the nearest middle is that of the one.
        let nearest = |best: (f64, usize), (t, middle): (usize, &DVec3)| {
            let near = middle.dot(direction);
            if near > best.0 { (near, t) } else { best }
        };
        let mut found = self.middles.iter().enumerate().fold((f64::NEG_INFINITY, 0), nearest).1;
        for sides in &self.sides[1..] {
            // Beyond the side ab-bc of the middle child lies the child at b, and so on; the most is taken, so that rounding
            // never finds none.
            let [c, a, b] = sides[4 * found].map(|side| side.dot(direction));
            let (least, child) = if a <= b && a <= c {
                (a, 1)
            } else if b <= c {
                (b, 2)
            } else {
                (c, 3)
            };
            found = 4 * found + if least < 0.0 { child } else { 0 };
        }
        found
    }

    /// The place of a unit direction between the corners of a triangle of the finest level: the direction is their sum times
    /// these, up to its length. >= 0 inside, sum 1.
    pub fn barycentric(&self, triangle: usize, direction: DVec3) -> [f64; 3] {
        let inside = self.sides[self.sides.len() - 1][triangle].map(|side| side.dot(direction).max(0.0));
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
