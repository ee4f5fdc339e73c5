//! Bases for light from infinity: what a transfer is baked for, and how lights become its coefficients.
//!
//! Three of them (Zhang, Dong and Ma 2013, section 4.1):
//! - the *discrete spherical function*, DSF, the paper's: on the nodes of an [`Icosphere`],
//!   `w_k(l) = W(t_k) / sum_i W(t_i)`, `W(t) = (h^2 - t^2)^3` for t < h, t the angle to node k and h the smallest angle
//!   between two nodes. At most four nodes count for a direction;
//! - *hats* on the same mesh: barycentric in the triangle that holds the direction (its corners times b make l, b
//!   normalised to 1). Linear functions are kept, which the DSF, flat at every node, does not;
//! - real spherical harmonics, [`super::harmonics`], signed and global.
//!
//! Coefficients of the first two are the adjoint mean, `s_k = 1/A_k int w_k L`, `A_k = int w_k`: whatever the light,
//! `sum A_k s_k` is all of it, so a bright texel keeps its flux wherever it lies. The paper samples a Gaussian around
//! each node, which keeps 0.92 to 1.06 of it at best. A directional light of irradiance E goes to the corners of its
//! triangle, `s_k = E b_k / A_k`: without the 1/A_k it would have no units. What is known of a response for each function
//! is weighted with [`LightBasis::response_coefficients`], sharper.
//! Cost: a search of a triangle for each texel, of at most [`TEXELS_AN_EDGE`] an edge.

use super::harmonics::{MAX_ORDER, evaluate};
use super::icosphere::Icosphere;
use crate::light::{Environment, Light};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Environments with more texels across than this for each edge of the mesh round the sphere are pooled first: a texel
/// is then a sixth of an edge, and its flux and mean direction are exact.
const TEXELS_AN_EDGE: usize = 6;
/// The least of texels across that an environment is pooled to.
const LEAST_ACROSS: usize = 128;
/// Points along a side of a triangle in the quadrature of areas: 256 points a triangle.
const AREA_POINTS: usize = 16;

/// Which basis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BasisKind {
    /// The discrete spherical function on so many nodes: 42, 162, 642 or 2562.
    Discrete(usize),
    /// Hats on so many nodes: 42, 162, 642 or 2562.
    Hat(usize),
    /// Harmonics of order 1 to 6.
    Harmonics(usize),
}

impl BasisKind {
    /// The number of basis functions.
    pub fn len(self) -> usize {
        match self {
            Self::Discrete(nodes) | Self::Hat(nodes) => nodes,
            Self::Harmonics(order) => order * order,
        }
    }

    /// False: every basis has functions.
    pub fn is_empty(self) -> bool {
        false
    }

    /// Hats on a mesh of edges twice as long, down to 42 nodes; harmonics as they are. Light that was scattered is as smooth
    /// in the light's direction as the phase function and the smoke make it: half the nodes a side are enough, and hats,
    /// which keep linear functions, meet it better than the discrete function, with three in place of six a direction.
    pub fn coarser(self) -> Self {
        let fewer = |nodes: usize| ((nodes - 2) / 4 + 2).max(42);
        match self {
            Self::Discrete(nodes) | Self::Hat(nodes) => Self::Hat(fewer(nodes)),
            Self::Harmonics(order) => Self::Harmonics(order),
        }
    }

    /// The kind of a name such as `dsf642`, `hat162` or `sh6`.
    pub fn of_name(name: &str) -> Option<Self> {
        let split = name.find(|c: char| c.is_ascii_digit())?;
        let number: usize = name[split..].parse().ok()?;
        let nodes = number >= 42 && Icosphere::level_of(number).is_some();
        match &name[..split] {
            "dsf" if nodes => Some(Self::Discrete(number)),
            "hat" if nodes => Some(Self::Hat(number)),
            "sh" if (1..=MAX_ORDER).contains(&number) => Some(Self::Harmonics(number)),
            _ => None,
        }
    }

    /// The name that [`Self::of_name`] reads.
    pub fn name(self) -> String {
        match self {
            Self::Discrete(nodes) => format!("dsf{nodes}"),
            Self::Hat(nodes) => format!("hat{nodes}"),
            Self::Harmonics(order) => format!("sh{order}"),
        }
    }
}

/// A basis ready for use. The mesh of harmonics is the one that direct light is sampled on.
#[derive(Clone, Debug)]
pub struct LightBasis {
    kind: BasisKind,
    mesh: Icosphere,
    opposite: Vec<[u32; 3]>,
    /// `h`, radians.
    reach: f64,
    /// `A_k` of the mesh's functions, steradian; sum 4 pi.
    areas: Vec<f64>,
    /// `int w_j w_k` where it is not zero, `(j, k, value)` by j and then k.
    overlaps: Vec<(u32, u32, f64)>,
}

/// Nodes whose functions reach a triangle, the integrals of these over it, and those of their products.
type OfTriangle = ([u32; 6], [f64; 6], [[f64; 6]; 6]);

/// The mesh that harmonics are sampled on: 642 directions.
const HARMONICS_LEVEL: u32 = 3;

/// The local functions that are not zero at a direction, up to six of them: node and value.
#[derive(Clone, Copy, Debug, Default)]
pub struct Local {
    /// The three corners of the triangle that holds it, then the three nodes across its sides.
    pub nodes: [u32; 6],
    /// Their values, >= 0; sum 1.
    pub values: [f64; 6],
}

impl LightBasis {
    /// Makes the mesh and its areas.
    pub fn new(kind: BasisKind) -> Self {
        let level = match kind {
            BasisKind::Discrete(nodes) | BasisKind::Hat(nodes) => {
                Icosphere::level_of(nodes).expect("a number of nodes that a mesh has")
            }
            BasisKind::Harmonics(_) => HARMONICS_LEVEL,
        };
        let mesh = Icosphere::new(level);
        let nodes = mesh.directions();
        let edges = mesh.triangles().iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
        let reach =
            edges.map(|(a, b)| nodes[a as usize].angle_between(nodes[b as usize])).fold(f64::INFINITY, f64::min);
        let opposite = mesh.opposite_nodes();
        let mut basis = Self { kind, mesh, opposite, reach, areas: Vec::new(), overlaps: Vec::new() };
        (basis.areas, basis.overlaps) = basis.quadrature();
        basis
    }

    /// Which one it is.
    pub fn kind(&self) -> BasisKind {
        self.kind
    }

    /// The mesh of a local basis; of harmonics, the one that they are sampled on for direct light.
    pub fn mesh(&self) -> &Icosphere {
        &self.mesh
    }

    /// Integral of each of the mesh's functions, steradian.
    pub fn areas(&self) -> &[f64] {
        &self.areas
    }

    /// The functions of the mesh at a unit direction in `triangle`.
    pub fn local(&self, triangle: usize, direction: DVec3) -> Local {
        let (near, far) = (self.mesh.triangles()[triangle], self.opposite[triangle]);
        let nodes = [near[0], near[1], near[2], far[0], far[1], far[2]];
        let mut values = [0.0; 6];
        match self.kind {
            BasisKind::Discrete(_) => {
                for (value, node) in values.iter_mut().zip(nodes) {
                    let square = square_of_angle(self.mesh.directions()[node as usize].dot(direction));
                    *value = (self.reach * self.reach - square).max(0.0).powi(3);
                }
                // The farthest direction is 0.69 h from a node, so the sum is at least 0.43 h^6.
                let sum: f64 = values.iter().sum();
                values.iter_mut().for_each(|v| *v /= sum);
            }
            BasisKind::Hat(_) | BasisKind::Harmonics(_) => {
                values[..3].copy_from_slice(&self.mesh.barycentric(triangle, direction));
            }
        }
        Local { nodes, values }
    }

    /// All functions at a unit direction, in order.
    pub fn values(&self, direction: DVec3) -> Vec<f64> {
        match self.kind {
            BasisKind::Harmonics(order) => {
                evaluate(order, direction.as_vec3())[..order * order].iter().map(|&y| f64::from(y)).collect()
            }
            _ => {
                let mut out = vec![0.0; self.kind.len()];
                let local = self.local(self.mesh.triangle(direction), direction);
                local.nodes.iter().zip(local.values).for_each(|(&n, v)| out[n as usize] += v);
                out
            }
        }
    }

    /// The function with these coefficients at a unit direction.
    pub fn reconstruct(&self, coefficients: &[[f64; 3]], direction: DVec3) -> [f64; 3] {
        let add = |sum: &mut [f64; 3], value: f64, s: &[f64; 3]| (0..3).for_each(|c| sum[c] += value * s[c]);
        let mut sum = [0.0; 3];
        match self.kind {
            BasisKind::Harmonics(order) => {
                let values = evaluate(order, direction.as_vec3());
                coefficients.iter().zip(values).for_each(|(s, y)| add(&mut sum, f64::from(y), s));
            }
            _ => {
                let local = self.local(self.mesh.triangle(direction), direction);
                let each = local.nodes.iter().zip(local.values);
                each.for_each(|(&n, value)| add(&mut sum, value, &coefficients[n as usize]));
            }
        }
        sum
    }

    /// Coefficients of the sum of `lights`, RGB radiance. Points are not at infinity, and count for nothing.
    pub fn coefficients(&self, lights: &[Light]) -> Vec<[f64; 3]> {
        let mut sums = vec![[0.0; 3]; self.kind.len()];
        for light in lights {
            match light {
                Light::Environment(environment) => self.add_environment(environment, &mut sums),
                Light::Directional { toward, irradiance } => {
                    let flux = irradiance.map(f64::from);
                    match self.kind {
                        BasisKind::Harmonics(_) => self.add_harmonics(*toward, flux, &mut sums),
                        _ => {
                            let direction = toward.as_dvec3();
                            let triangle = self.mesh.triangle(direction);
                            let shares = self.mesh.barycentric(triangle, direction);
                            for (node, share) in self.mesh.triangles()[triangle].into_iter().zip(shares) {
                                (0..3).for_each(|c| sums[node as usize][c] += flux[c] * share);
                            }
                        }
                    }
                }
                Light::Point { .. } => {}
            }
        }
        if !matches!(self.kind, BasisKind::Harmonics(_)) {
            sums.iter_mut().zip(&self.areas).for_each(|(s, area)| *s = s.map(|v| v / area));
        }
        sums
    }

    /// Coefficients s that make `sum s_k F_k` of the integrals `F_k = int w_k f` of a smooth function f the integral of f
    /// against the light: what a response that is known for each function of the basis is weighted with.
    ///
    /// The adjoint mean would blur f twice, by what F_k is and by what is read between nodes. The best s is `M^-1 a`, with
    /// `M_jk = int w_j w_k` and `a_k = int w_k L`; the first two terms of its series, `s = A^-1 (2 a - M A^-1 a)`, leave
    /// a constant and (hats) a linear f exact, keep all of the light, and do not amplify noise as the inverse does.
    pub fn response_coefficients(&self, lights: &[Light]) -> Vec<[f64; 3]> {
        let means = self.coefficients(lights);
        if matches!(self.kind, BasisKind::Harmonics(_)) {
            return means;
        }
        let mut out: Vec<[f64; 3]> = means.iter().map(|s| s.map(|v| 2.0 * v)).collect();
        for &(j, k, overlap) in &self.overlaps {
            let share = overlap / self.areas[j as usize];
            (0..3).for_each(|c| out[j as usize][c] -= share * means[k as usize][c]);
        }
        out
    }

    fn add_harmonics(&self, toward: Vec3, flux: [f64; 3], sums: &mut [[f64; 3]]) {
        let values = evaluate(MAX_ORDER, toward);
        let each = sums.iter_mut().zip(values);
        each.for_each(|(s, y)| (0..3).for_each(|c| s[c] += flux[c] * f64::from(y)));
    }

    /// Adds the integral of every function against the environment.
    fn add_environment(&self, environment: &Environment, sums: &mut [[f64; 3]]) {
        // Five edges of the icosahedron go round the sphere, each halved so many times.
        let across = ((5 * TEXELS_AN_EDGE) << self.mesh.level()).max(LEAST_ACROSS);
        let texels = environment.texels(across);
        let rows = texels.par_chunks(texels.len().div_ceil(64).max(256));
        let parts = rows.map(|row| {
            // Nodes that this part of the sky touches, in the order in which they are met.
            let mut part = vec![[0.0; 3]; self.kind.len()];
            for (toward, flux) in row {
                match self.kind {
                    BasisKind::Harmonics(_) => self.add_harmonics(toward.as_vec3(), *flux, &mut part),
                    _ => {
                        let local = self.local(self.mesh.triangle(*toward), *toward);
                        for (&node, value) in local.nodes.iter().zip(local.values) {
                            (0..3).for_each(|c| part[node as usize][c] += flux[c] * value);
                        }
                    }
                }
            }
            part
        });
        for part in parts.collect::<Vec<_>>() {
            sums.iter_mut().zip(part).for_each(|(s, p)| (0..3).for_each(|c| s[c] += p[c]));
        }
    }

    /// `int w_k` and `int w_j w_k` over the sphere, triangle by triangle: midpoints of equal parts of the flat triangle, each with the
    /// solid angle that it is seen under.
    fn quadrature(&self) -> (Vec<f64>, Vec<(u32, u32, f64)>) {
        let n = AREA_POINTS;
        let parts: Vec<OfTriangle> = (0..self.mesh.triangles().len())
            .into_par_iter()
            .map(|t| {
                let corners = self.mesh.triangles()[t].map(|n| self.mesh.directions()[n as usize]);
                let (mut sums, mut products) = ([0.0; 6], [[0.0; 6]; 6]);
                let (mut total, mut nodes) = (0.0, [0; 6]);
                for i in 0..n {
                    for j in 0..2 * i + 1 {
                        // Row i of the cut triangle has i + 1 upright parts and i upside down between them.
                        let (third, up) = (1.0 / 3.0, j % 2 == 0);
                        let (a, b) = match up {
                            true => (i as f64 + 2.0 * third, (j / 2) as f64 + third),
                            false => (i as f64 + third, (j / 2) as f64 + 2.0 * third),
                        };
                        let (a, b) = (a / n as f64, b / n as f64);
                        let point = corners[0] * (1.0 - a) + corners[1] * (a - b) + corners[2] * b;
                        // Equal flat parts: solid angle goes with 1 / r^3 (their plane is the same for all).
                        let weight = point.length().powi(-3);
                        let local = self.local(t, point.normalize());
                        nodes = local.nodes;
                        for (a, v) in local.values.into_iter().enumerate() {
                            sums[a] += weight * v;
                            products[a].iter_mut().zip(local.values).for_each(|(p, other)| *p += weight * v * other);
                        }
                        total += weight;
                    }
                }
                let scale = self.mesh.solid_angle(t) / total;
                (nodes, sums.map(|s| s * scale), products.map(|row| row.map(|p| p * scale)))
            })
            .collect();
        let mut areas = vec![0.0; self.mesh.directions().len()];
        let mut overlaps = Vec::new();
        for (nodes, sums, products) in parts {
            nodes.iter().zip(sums).for_each(|(&node, area)| areas[node as usize] += area);
            for (j, row) in nodes.iter().zip(products) {
                overlaps.extend(nodes.iter().zip(row).filter(|(_, p)| *p > 0.0).map(|(k, p)| (*j, *k, p)));
            }
        }
        // Triangles come in order, so equal pairs are added in one order.
        overlaps.sort_by_key(|&(j, k, _)| (j, k));
        overlaps.dedup_by(|next, kept| {
            let same = (next.0, next.1) == (kept.0, kept.1);
            kept.2 += if same { next.2 } else { 0.0 };
            same
        });
        (areas, overlaps)
    }
}

/// The square of the angle whose cosine this is: the series of arccos^2 in `1 - cos`, to 1e-9 of it up to 0.55 radians, the
/// farthest that a function reaches, and rising beyond. Near 0 arccos itself would lose half of its digits.
fn square_of_angle(cosine: f64) -> f64 {
    // a_n = 2^n (n - 1)!^2 / (2n)! * 2: each coefficient is n^2 / ((n + 1) (2n + 1)) of the one before.
    let x = (1.0 - cosine).max(0.0);
    const RATIOS: [f64; 5] = [25.0 / 66.0, 16.0 / 45.0, 9.0 / 28.0, 4.0 / 15.0, 1.0 / 6.0];
    2.0 * x * RATIOS.iter().fold(1.0, |sum, ratio| 1.0 + x * ratio * sum)
}

#[cfg(test)]
mod tests {
    use super::super::icosphere::tests::directions;
    use super::*;

    const LOCAL: [BasisKind; 8] = [
        BasisKind::Discrete(42),
        BasisKind::Discrete(162),
        BasisKind::Discrete(642),
        BasisKind::Discrete(2562),
        BasisKind::Hat(42),
        BasisKind::Hat(162),
        BasisKind::Hat(642),
        BasisKind::Hat(2562),
    ];

    #[test]
    fn responses_to_a_sun_are_read_with_a_quarter_of_the_blur_and_all_of_the_light() {
        // Responses to a sun as smooth as scattered light: a lobe and a slope. F_k = int w_k f by brute force.
        let axis = DVec3::new(0.4, -0.6, 0.7).normalize();
        let response = |l: DVec3| (4.0 * (l.dot(axis) - 1.0)).exp() + 0.2 * l.x;
        let samples: Vec<DVec3> = directions(60_000).collect();
        for kind in [BasisKind::Discrete(162), BasisKind::Hat(162)] {
            let basis = LightBasis::new(kind);
            let (mut known, mut counted) = (vec![0.0; 162], vec![0.0; 162]);
            for l in &samples {
                let local = basis.local(basis.mesh.triangle(*l), *l);
                for (&k, value) in local.nodes.iter().zip(local.values) {
                    known[k as usize] += value * response(*l);
                    counted[k as usize] += value;
                }
            }
            // By the same points as the functions' integrals, so that the spread of the points cancels.
            known.iter_mut().zip(&counted).zip(basis.areas()).for_each(|((f, n), area)| *f *= area / n);
            let (mut blurred, mut sharp) = (0.0f64, 0.0f64);
            for toward in samples.iter().step_by(601) {
                let sun = [Light::Directional { toward: toward.as_vec3(), irradiance: [1.0; 3] }];
                let read = |s: Vec<[f64; 3]>| s.iter().zip(&known).map(|(s, f)| s[0] * f).sum::<f64>();
                blurred += (read(basis.coefficients(&sun)) - response(*toward)).powi(2);
                let coefficients = basis.response_coefficients(&sun);
                let flux: f64 = coefficients.iter().zip(basis.areas()).map(|(s, area)| s[0] * area).sum();
                assert!((flux - 1.0).abs() < 1e-9, "{kind:?} {flux}");
                sharp += (read(coefficients) - response(*toward)).powi(2);
            }
            assert!(sharp < blurred / 4.0, "{kind:?}: {} {}", sharp.sqrt(), blurred.sqrt());
        }
        let harmonics = LightBasis::new(BasisKind::Harmonics(4));
        let sun = [Light::Directional { toward: Vec3::Z, irradiance: [1.0; 3] }];
        assert_eq!(harmonics.response_coefficients(&sun), harmonics.coefficients(&sun));
    }

    #[test]
    fn the_square_of_an_angle_is_that_of_arccos_as_far_as_functions_reach() {
        for step in 0..=550 {
            let angle = f64::from(step) * 1e-3;
            let found = square_of_angle(angle.cos());
            // The cosine itself is rounded: 1e-16 of it is 2e-16 of the square.
            assert!((found - angle * angle).abs() <= 1e-8 * angle * angle + 1e-15, "{angle} {found}");
        }
        assert!((0..100).all(|i| square_of_angle(0.8 - f64::from(i) * 0.018) > 0.3));
    }

    #[test]
    fn names_and_kinds_are_the_same_thing() {
        for kind in LOCAL.into_iter().chain([BasisKind::Harmonics(1), BasisKind::Harmonics(6)]) {
            assert_eq!(BasisKind::of_name(&kind.name()), Some(kind));
        }
        assert_eq!(BasisKind::Hat(2562).coarser().coarser().coarser().coarser(), BasisKind::Hat(42));
        for bad in ["", "dsf", "642", "dsf12", "dsf643", "hat", "sh0", "sh7", "sh", "DSF642", "dsf642x"] {
            assert_eq!(BasisKind::of_name(bad), None, "{bad}");
        }
    }

    #[test]
    fn local_functions_are_a_partition_of_unity_and_interpolate() {
        for kind in LOCAL {
            let basis = LightBasis::new(kind);
            for d in directions(4000) {
                let local = basis.local(basis.mesh().triangle(d), d);
                assert!((local.values.iter().sum::<f64>() - 1.0).abs() < 4e-16 * 4.0);
                assert!(
                    local.values.iter().all(|v| *v >= 0.0) && local.values.iter().filter(|v| **v > 0.0).count() <= 4
                );
            }
            for (k, d) in basis.mesh().directions().iter().enumerate().step_by(7) {
                let values = basis.values(*d);
                // A node on the border of its triangle by rounding: 1e-15 of a barycentric coordinate.
                assert!((values[k] - 1.0).abs() < 1e-12, "{kind:?} node {k}: {}", values[k]);
            }
            let total: f64 = basis.areas().iter().sum();
            assert!((total / (4.0 * std::f64::consts::PI) - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn no_function_that_reaches_a_direction_is_left_out() {
        // The six nodes of a triangle are all within h of any direction in it: brute force over all nodes.
        let basis = LightBasis::new(BasisKind::Discrete(642));
        for d in directions(3000) {
            let near = basis.mesh().directions().iter().filter(|n| n.angle_between(d) < basis.reach).count();
            let local = basis.local(basis.mesh().triangle(d), d);
            assert_eq!(local.values.iter().filter(|v| **v > 0.0).count(), near, "{d}");
        }
    }

    #[test]
    fn areas_agree_with_a_quadrature_over_the_whole_sphere() {
        for kind in [BasisKind::Discrete(162), BasisKind::Hat(162)] {
            let basis = LightBasis::new(kind);
            let count = 400_000;
            let mut areas = vec![0.0; 162];
            for d in directions(count) {
                let local = basis.local(basis.mesh().triangle(d), d);
                let each = 4.0 * std::f64::consts::PI / count as f64;
                local.nodes.iter().zip(local.values).for_each(|(&n, v)| areas[n as usize] += v * each);
            }
            // 2,500 spiral points a function, whose sums are good to about the root of a point's share: 1e-3.
            for (found, expected) in basis.areas().iter().zip(areas) {
                assert!((found / expected - 1.0).abs() < 1e-3, "{kind:?}: {found} {expected}");
            }
        }
    }

    #[test]
    fn a_bright_texel_keeps_its_flux_wherever_it_is_and_a_sun_too() {
        for kind in [BasisKind::Discrete(642), BasisKind::Hat(642)] {
            let basis = LightBasis::new(kind);
            for (row, column) in [(0, 0), (1, 100), (64, 511), (200, 77), (255, 300)] {
                let mut environment = Environment::constant([0.0; 3]);
                (environment.width, environment.height, environment.rotation) = (512, 256, 0.7);
                environment.radiance = vec![[0.0; 3]; 512 * 256];
                environment.radiance[row * 512 + column] = [0.0, 1e6, 0.0];
                let edge = |row: usize| (std::f64::consts::PI * row as f64 / 256.0).cos();
                let flux = 1e6 * (edge(row) - edge(row + 1)) * std::f64::consts::TAU / 512.0;
                let coefficients = basis.coefficients(&[Light::Environment(environment)]);
                let sum: f64 = coefficients.iter().zip(basis.areas()).map(|(s, a)| s[1] * a).sum();
                assert!((sum / flux - 1.0).abs() < 1e-9, "{kind:?} {row} {column}: {sum} {flux}");
            }
            for toward in directions(50) {
                let sun = Light::Directional { toward: toward.as_vec3(), irradiance: [3.0, 0.0, 1.0] };
                let coefficients = basis.coefficients(&[sun]);
                let sum: f64 = coefficients.iter().zip(basis.areas()).map(|(s, a)| s[0] * a).sum();
                assert!((sum / 3.0 - 1.0).abs() < 1e-12);
                assert!(coefficients.iter().filter(|s| s[0] > 0.0).count() <= 3);
            }
        }
    }

    #[test]
    fn a_black_sky_and_no_light_at_all_have_zero_coefficients() {
        for kind in [BasisKind::Discrete(42), BasisKind::Hat(42), BasisKind::Harmonics(6)] {
            let basis = LightBasis::new(kind);
            let black = Light::Environment(Environment::constant([0.0; 3]));
            for lights in [&[][..], &[black]] {
                assert!(basis.coefficients(lights).iter().flatten().all(|v| *v == 0.0));
            }
        }
    }

    /// Relative L2 distance of what the basis makes of `light` from it.
    fn error(basis: &LightBasis, environment: &Environment) -> f64 {
        let coefficients = basis.coefficients(&[Light::Environment(environment.clone())]);
        let (mut difference, mut square) = (0.0, 0.0);
        for d in directions(60_000) {
            let [u, v] = environment.place(d.as_vec3());
            let at = (u * environment.width as f64) as usize % environment.width;
            let row = ((v * environment.height as f64) as usize).min(environment.height - 1);
            let truth = f64::from(environment.radiance[row * environment.width + at][0]);
            let found = basis.reconstruct(&coefficients, d)[0];
            difference += (truth - found).powi(2);
            square += truth * truth;
        }
        (difference / square).sqrt()
    }

    /// 0 and 1 on a chequer of 2 x 2 fields a face of the cube.
    fn chequer() -> Environment {
        let mut environment = Environment::constant([0.0; 3]);
        (environment.width, environment.height) = (1024, 512);
        environment.radiance = (0..1024 * 512)
            .map(|t| {
                let d = environment.direction(((t % 1024) as f64 + 0.5) / 1024.0, ((t / 1024) as f64 + 0.5) / 512.0);
                let major = d.abs().max_element();
                let others = d.to_array().map(|c| if c.abs() < major { f64::from(c < 0.0) } else { 0.0 });
                [(others.iter().sum::<f64>() as i32 % 2) as f32; 3]
            })
            .collect();
        environment
    }

    /// The chequer as a cube map of 128 texels a side: direction, solid angle and value of each.
    fn cube_map() -> Vec<(DVec3, f64, f64)> {
        let place = |i: f64| i / 64.0 - 1.0;
        let corner = |x: f64, y: f64| (x * y).atan2((x * x + y * y + 1.0).sqrt());
        let texel = |t: usize| {
            let (face, i, j) = (t >> 14, (t & 127) as f64, (t >> 7 & 127) as f64);
            let (u, v) = (place(i + 0.5), place(j + 0.5));
            let [left, right, top, bottom] = [place(i), place(i + 1.0), place(j), place(j + 1.0)];
            let solid = corner(left, top) - corner(left, bottom) - corner(right, top) + corner(right, bottom);
            let direction = match face {
                0 => DVec3::new(1.0, -v, -u),
                1 => DVec3::new(-1.0, -v, u),
                2 => DVec3::new(u, 1.0, v),
                3 => DVec3::new(u, -1.0, -v),
                4 => DVec3::new(u, -v, 1.0),
                _ => DVec3::new(-u, -v, -1.0),
            };
            (direction.normalize(), solid, f64::from(u8::from((u > 0.0) == (v > 0.0))))
        };
        (0..6 * 128 * 128).map(texel).collect()
    }

    #[test]
    fn a_chequer_is_met_better_by_more_nodes_as_in_the_paper_and_better() {
        // The paper's figures are 13.2 : 8.9 : 7.3 for 162, 642, 2562 nodes, 1 : 0.67 : 0.55, of a pattern and a norm that
        // it does not give. Measured beforehand for the discrete function on this cube map: 0.428, 0.282, 0.211 with the
        // adjoint mean, 1 : 0.66 : 0.49.
        let cube = cube_map();
        let error = |kind: BasisKind| {
            let basis = LightBasis::new(kind);
            let mut sums = vec![0.0; kind.len()];
            for &(direction, solid, value) in &cube {
                let local = basis.local(basis.mesh().triangle(direction), direction);
                local.nodes.iter().zip(local.values).for_each(|(&node, w)| sums[node as usize] += w * solid * value);
            }
            let coefficients: Vec<[f64; 3]> = sums.iter().zip(basis.areas()).map(|(s, area)| [s / area; 3]).collect();
            let (mut left, mut whole) = (0.0, 0.0);
            for &(direction, solid, value) in &cube {
                left += solid * (basis.reconstruct(&coefficients, direction)[0] - value).powi(2);
                whole += solid * value * value;
            }
            (left / whole).sqrt()
        };
        let discrete = [162, 642, 2562].map(|nodes| error(BasisKind::Discrete(nodes)));
        let hats = [162, 642, 2562].map(|nodes| error(BasisKind::Hat(nodes)));
        println!("dsf: {discrete:.4?}, hats: {hats:.4?}");
        assert!(discrete.iter().zip([0.428, 0.282, 0.211]).all(|(e, known)| (e - known).abs() < 6e-4), "{discrete:?}");
        assert!(discrete[1] / discrete[0] < 0.66 && discrete[2] / discrete[0] < 0.495, "{discrete:?}");
        assert!(hats.iter().zip([0.426, 0.293, 0.212]).all(|(e, most)| e < &most), "{hats:?}");
    }

    #[test]
    fn a_chequer_is_met_better_by_six_bands_than_by_42_nodes_and_worse_than_by_162() {
        // Where the borders of the fields lie between nodes moves the errors, so in the mean over some turns.
        let turned =
            |kind: BasisKind, rotation: f64| error(&LightBasis::new(kind), &Environment { rotation, ..chequer() });
        let mean = |kind: BasisKind| [0.0, 0.2, 0.6, 1.1].map(|r| turned(kind, r)).iter().sum::<f64>() / 4.0;
        let [few, harmonics, many] =
            [BasisKind::Discrete(42), BasisKind::Harmonics(6), BasisKind::Discrete(162)].map(mean);
        assert!(few > harmonics && harmonics > many, "{few} {harmonics} {many}");
    }

    #[test]
    fn hats_meet_a_smooth_sky_better_than_the_discrete_function() {
        let mut sky = Environment::constant([0.0; 3]);
        (sky.width, sky.height) = (1024, 512);
        sky.radiance = (0..1024 * 512)
            .map(|t| [(1.0 + (std::f64::consts::PI * ((t / 1024) as f64 + 0.5) / 512.0).cos()) as f32; 3])
            .collect();
        let (hat, discrete) = (
            error(&LightBasis::new(BasisKind::Hat(642)), &sky),
            error(&LightBasis::new(BasisKind::Discrete(642)), &sky),
        );
        // 0.36 % and 1.26 % were measured beforehand for a lobe 1 + cos.
        assert!(hat < 0.005 && discrete < 0.015 && hat < 0.5 * discrete, "{hat} {discrete}");
    }

    #[test]
    fn harmonics_of_a_sun_are_its_irradiance_times_the_harmonics_there() {
        let basis = LightBasis::new(BasisKind::Harmonics(4));
        let toward = Vec3::new(0.48, -0.6, 0.64);
        let found = basis.coefficients(&[Light::Directional { toward, irradiance: [2.0; 3] }]);
        let expected = evaluate(4, toward);
        assert!(found.iter().zip(expected).all(|(s, y)| (s[1] - 2.0 * f64::from(y)).abs() < 1e-6));
    }
}
