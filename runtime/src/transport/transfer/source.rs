//! Source radiance of a frame with transfer, under any light from infinity (Zhang, Dong and Ma 2013, sections 6.3, 6.4).
//!
//! With the light's coefficients s and the clusters' bases, each cluster is lit, not each voxel (the paper's Eq. 19):
//! - *direct*: `I_i(w) = albedo sum over q of V_i[q] E_q p(w . l_q)`, E_q what the light brings from direction q of the
//!   mesh, p the phase function itself. It depends on where it is seen from, so it is found for the directions that the
//!   smoke is seen in ([`super::view_directions`]), and once where light scatters evenly;
//! - *indirect*: `I_i,lm = sum over k of s_k B_i[k, lm]`, then each cell's moments.
//!
//! A node sends out `sum over t of weight_t I_t` of its cluster, and the indirect light of the cells around it. What a sun
//! brings directly is swept at run time instead (`sharp_suns`): baked, it would be a lobe as wide as the mesh's edges.
//! Costs: *light* clusters x (1 + terms) x directions x 3, and lights x coefficients more for the indirect part; *view*
//! that of the direct part for each direction in use, and (1 + terms) x 4 vectors a node.

use super::cells::Cells;
use super::frame::{Clustered, FrameTransfer};
use super::lit_nodes::lit_nodes;
use super::view_directions::{Between, ViewDirections, squares};
use crate::light::Light;
use crate::medium::field::DensityField;
use crate::product::add_product;
use crate::shaded_volume::ShadedVolume;
use crate::sphere::harmonics::{MAX_COEFFICIENTS, evaluate_lanes};
use crate::sphere::light_basis::BasisKind;
use crate::tracking::phase;
use crate::transport::compensated::grid::columns::SweepGrid;
use crate::transport::compensated::grid::single::transmittance_from;
use crate::transport::{ScatteringOrder, SourceRadiance};
use glam::{DVec3, Vec3, Vec4};
use multiversion::multiversion;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::{Arc, OnceLock};

/// The dials of the method.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TransferSettings {
    /// True sweeps what directional lights bring directly at run time; false takes it from the pack, as a lobe.
    pub sharp_suns: bool,
}

impl Default for TransferSettings {
    fn default() -> Self {
        Self { sharp_suns: true }
    }
}

/// Why a frame cannot be rendered by its transfer.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("transfer: {part} has {found}, expected {expected}; bake the pack again")]
pub struct TransferError {
    /// Which part.
    pub part: &'static str,
    /// What it has.
    pub found: String,
    /// What the frame's density asks for.
    pub expected: String,
}

/// One frame with its transfer, ready to be lit: everything that depends on neither light nor view.
pub struct TransferTransport {
    transfer: Arc<FrameTransfer>,
    nodes: Arc<Vec<u32>>,
    lines: Arc<Vec<u32>>,
    cells: Arc<Cells>,
    settings: TransferSettings,
    /// For sweeps of suns; made for the first.
    grid: Option<SweepGrid>,
}

/// What a sun brings directly: its direction, irradiance times albedo, and transmittance to each lit node, by channel.
pub(crate) struct Sun {
    pub(crate) toward: Vec3,
    pub(crate) power: [f32; 3],
    pub(crate) transmittance: [Arc<Vec<f32>>; 3],
}

/// Radiance of the clusters of one set of direct rows.
struct LitClusters {
    /// `[cluster][view][term]`, RGB of each direction of a cluster; in the last components of the first three, that of its
    /// mean. Four terms are a cache line, and views that are blended lie near each other.
    radiance: Vec<Vec4>,
    /// Vectors of a cluster in one view, 3 at least.
    each: usize,
    /// Views of a cluster.
    views: usize,
}

/// A lit frame: the light's coefficients, and the clusters that the processor has lit with them.
pub struct TransferSource {
    pub(crate) transfer: Arc<FrameTransfer>,
    pub(crate) nodes: Arc<Vec<u32>>,
    /// Place in `nodes` of the first node of each line along x, and the end of the last.
    lines: Arc<Vec<u32>>,
    pub(crate) cells: Arc<Cells>,
    /// Irradiance from each direction of the mesh.
    pub(crate) irradiance: Vec<[f32; 3]>,
    pub(crate) suns: Vec<Sun>,
    /// What the light brings into each function of the indirect basis.
    pub(crate) coefficients: Vec<[f64; 3]>,
    /// `[cell][lm]`, RGB and a zero.
    moments: OnceLock<Vec<Vec4>>,
    /// Direct radiance of each set's clusters where it is the same from everywhere.
    even: OnceLock<Vec<LitClusters>>,
}

/// The nodes and cells that the rows of `transfer` are for, in their order; checks that it is one for the density `field`.
pub(crate) fn rows_of(field: &DensityField, transfer: &FrameTransfer) -> Result<(Vec<u32>, Cells), TransferError> {
    let (nodes, cells) = (lit_nodes(field), Cells::new(field, transfer.shift));
    let check = |part, sets: &[Clustered], rows: usize, length: usize| {
        let bad = sets.iter().find(|set| {
            let ids = set.ids.iter().all(|&id| usize::from(id) < set.clusters());
            !(set.ids.len() == rows && set.weights.len() == rows * set.terms && ids)
                || !(set.length == length || rows == 0)
        });
        bad.map_or(Ok(()), |set| {
            let found = format!("{} rows of {} numbers", set.ids.len(), set.length);
            Err(TransferError { part, found, expected: format!("{rows} rows of {length} numbers") })
        })
    };
    let lights = transfer.indirect_basis.kind().len();
    check("direct light", &transfer.direct, nodes.len(), transfer.basis.areas().len())?;
    check("indirect light", &transfer.indirect, cells.len(), lights * transfer.bands * transfer.bands)?;
    Ok((nodes, cells))
}

impl TransferTransport {
    /// Checks that the transfer is one for this density.
    pub fn new(
        field: &DensityField,
        transfer: Arc<FrameTransfer>,
        settings: TransferSettings,
    ) -> Result<Self, TransferError> {
        let (nodes, cells) = rows_of(field, &transfer)?;
        let [nx, ny, nz] = field.dims;
        let before = |line: usize| nodes.partition_point(|&node| (node as usize) < line * nx) as u32;
        let lines = (0..=ny * nz).into_par_iter().map(before).collect::<Vec<_>>();
        Ok(Self {
            transfer,
            nodes: Arc::new(nodes),
            lines: Arc::new(lines),
            cells: Arc::new(cells),
            settings,
            grid: None,
        })
    }

    /// Lights the frame `field`, the same as at [`Self::new`]; points count for nothing.
    pub fn light(&mut self, field: &DensityField, lights: &[Light], scattering: ScatteringOrder) -> TransferSource {
        let source = self.project(field, lights, scattering);
        source.prepare();
        source
    }

    /// The light's coefficients alone: [`SourceRadiance::prepare`] lights the clusters with them.
    pub(crate) fn project(
        &mut self,
        field: &DensityField,
        lights: &[Light],
        scattering: ScatteringOrder,
    ) -> TransferSource {
        let transfer = self.transfer.clone();
        let basis = &transfer.basis;
        let (suns, rest): (Vec<&Light>, Vec<&Light>) =
            lights.iter().partition(|l| self.settings.sharp_suns && matches!(l, Light::Directional { .. }));
        let without_suns = basis.coefficients(&rest.into_iter().cloned().collect::<Vec<_>>());
        let irradiance: Vec<[f32; 3]> = (0..basis.areas().len())
            .map(|q| {
                let radiance = match basis.kind() {
                    BasisKind::Harmonics(_) => basis.reconstruct(&without_suns, basis.mesh().directions()[q]),
                    _ => without_suns[q],
                };
                radiance.map(|r| (r * basis.areas()[q]) as f32)
            })
            .collect();
        let suns = suns.into_iter().filter_map(|sun| self.sweep(field, sun)).collect();
        let indirect: &[Light] = if scattering == ScatteringOrder::Single { &[] } else { lights };
        TransferSource {
            nodes: self.nodes.clone(),
            lines: self.lines.clone(),
            cells: self.cells.clone(),
            coefficients: transfer.indirect_basis.response_coefficients(indirect),
            transfer,
            irradiance,
            suns,
            moments: OnceLock::new(),
            even: OnceLock::new(),
        }
    }

    fn sweep(&mut self, field: &DensityField, sun: &Light) -> Option<Sun> {
        let Light::Directional { toward, irradiance } = *sun else { return None };
        let grid = self.grid.get_or_insert_with(|| SweepGrid::new(field));
        let medium = &self.transfer.medium;
        let mut found: Vec<(f32, Arc<Vec<f32>>)> = Vec::new();
        for sigma_t in medium.sigma_t {
            if !found.iter().any(|(sigma, _)| *sigma == sigma_t) {
                let plane = &transmittance_from(grid, &[toward], sigma_t)[0];
                let at_nodes = self.nodes.iter().map(|&node| plane[node as usize]).collect();
                found.push((sigma_t, Arc::new(at_nodes)));
            }
        }
        let of = |sigma_t: f32| found.iter().find(|(sigma, _)| *sigma == sigma_t).map(|(_, t)| t.clone());
        let transmittance = [0, 1, 2].map(|c| of(medium.sigma_t[c]).unwrap_or_default());
        Some(Sun { toward, power: [0, 1, 2].map(|c| irradiance[c] * medium.albedo[c]), transmittance })
    }
}

/// Cells whose harmonics are found together.
const LANES: usize = 16;

/// The radiance of `moments` (`[cell][bands^2]`) along the way to each cell, of any length; its last component is 1, see
/// [`Cells::line`].
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn along_ways(out: &mut [Vec4], moments: &[Vec4], ways: &[Vec3], bands: usize) {
    let n = bands * bands;
    let mut harmonics = [[0.0; LANES]; MAX_COEFFICIENTS];
    for ((out, moments), ways) in out.chunks_mut(LANES).zip(moments.chunks(LANES * n)).zip(ways.chunks(LANES)) {
        let [mut x, mut y, mut z] = [[0.0f32; LANES]; 3];
        ways.iter().enumerate().for_each(|(lane, way)| [x[lane], y[lane], z[lane]] = way.to_array());
        for lane in 0..LANES {
            let squares = x[lane] * x[lane] + y[lane] * y[lane] + z[lane] * z[lane];
            // At the eye, and in the lanes past the last way, any way will do.
            let scale = if squares > 0.0 { 1.0 / squares.sqrt() } else { 0.0 };
            (x[lane], y[lane]) = (x[lane] * scale, y[lane] * scale);
            z[lane] = if squares > 0.0 { z[lane] * scale } else { 1.0 };
        }
        evaluate_lanes(bands, &x, &y, &z, &mut harmonics);
        for (lane, (out, moments)) in out.iter_mut().zip(moments.chunks_exact(n)).enumerate() {
            let terms = moments.iter().zip(&harmonics);
            *out = terms.fold(Vec4::ZERO, |sum, (m, y)| sum + *m * y[lane]).with_w(1.0);
        }
    }
}

/// Moments of every cell, from the indirect light of the clusters.
fn moments(transfer: &FrameTransfer, cells: &Cells, coefficients: &[[f64; 3]]) -> Vec<Vec4> {
    let n = transfer.bands * transfer.bands;
    let mut out = vec![Vec4::ZERO; cells.len() * n];
    for (s, set) in transfer.indirect.iter().enumerate() {
        let channels: Vec<usize> = (0..3).filter(|&c| transfer.indirect_of_channel[c] == s).collect();
        if set.length == 0 || channels.is_empty() {
            continue;
        }
        // One light's coefficients after another: the sums are over a cluster's `[light][lm]`.
        let lit: Vec<[Vec4; 1]> = set
            .bases
            .par_chunks_exact(set.length)
            .flat_map_iter(|basis| {
                let mut sums = vec![[Vec4::ZERO; 1]; n];
                for (row, s) in basis.chunks_exact(n).zip(coefficients) {
                    let mut light = Vec4::ZERO;
                    channels.iter().for_each(|&c| light[c] = s[c] as f32);
                    sums.iter_mut().zip(row).for_each(|(sum, v)| sum[0] += light * *v);
                }
                sums
            })
            .collect();
        let each = 1 + set.terms;
        out.par_chunks_exact_mut(n).enumerate().for_each(|(cell, out)| {
            let first = usize::from(set.ids[cell]) * each * n;
            let (mean, directions) = lit[first..first + each * n].split_at(n);
            out.iter_mut().zip(mean).for_each(|(o, m)| *o += m[0]);
            let weights = &set.weights[cell * set.terms..][..set.terms];
            for (weight, direction) in weights.iter().zip(directions.chunks_exact(n)) {
                out.iter_mut().zip(direction).for_each(|(o, d)| *o += d[0] * *weight);
            }
        });
    }
    out
}

impl TransferSource {
    fn moments(&self) -> &[Vec4] {
        self.moments.get_or_init(|| moments(&self.transfer, &self.cells, &self.coefficients))
    }

    fn even(&self) -> Option<&Vec<LitClusters>> {
        let is_even = self.transfer.medium.g == 0.0;
        is_even.then(|| self.even.get_or_init(|| self.lit_clusters(&[DVec3::Z])))
    }

    /// Radiance that each direct cluster and each of its directions sends the way that is seen along each of `views`,
    /// unit vectors from the eye, for each set.
    fn lit_clusters(&self, views: &[DVec3]) -> Vec<LitClusters> {
        let transfer = &self.transfer;
        let (mesh, medium) = (transfer.basis.mesh(), &transfer.medium);
        let of_set = |(s, set): (usize, &Clustered)| {
            let channels: Vec<usize> = (0..3).filter(|&c| transfer.direct_of_channel[c] == s).collect();
            // What each direction q brings into each view: [q][view][channel].
            let columns = views.len() * channels.len();
            let mut light = vec![0.0f32; self.irradiance.len() * columns];
            // The mesh's sum of p over all directions is 1 while lobes are as wide as its edges; narrower ones fall between
            // the nodes, or on one, and are made to add up to 1 so that no light is lost or made.
            let whole = |view: &DVec3| {
                let sum =
                    |(toward, area): (&DVec3, &f64)| area * f64::from(phase::value(medium.g, view.dot(*toward) as f32));
                mesh.directions().iter().zip(transfer.basis.areas()).map(sum).sum::<f64>() as f32
            };
            let scales: Vec<f32> = views.par_iter().map(|view| 1.0 / whole(view).max(f32::MIN_POSITIVE)).collect();
            light.par_chunks_exact_mut(columns.max(1)).enumerate().for_each(|(q, out)| {
                let toward = mesh.directions()[q].as_vec3();
                for ((view, scale), out) in views.iter().zip(&scales).zip(out.chunks_exact_mut(channels.len())) {
                    let scattered = scale * phase::value(medium.g, view.as_vec3().dot(toward));
                    let each = out.iter_mut().zip(&channels);
                    each.for_each(|(o, &c)| *o = scattered * medium.albedo[c] * self.irradiance[q][c]);
                }
            });
            let rows = set.bases.len().checked_div(set.length).unwrap_or(0);
            let mut lit = vec![0.0f32; rows * columns];
            add_product(&mut lit, &set.bases, &light, set.length, columns);
            // From [cluster][1 + term][view][channel].
            let each = set.terms.max(3);
            let mut radiance = vec![Vec4::ZERO; set.clusters() * views.len() * each];
            let clusters = radiance.par_chunks_exact_mut((views.len() * each).max(1));
            clusters.zip(lit.par_chunks_exact((1 + set.terms) * columns.max(1))).for_each(|(out, lit)| {
                let (mean, directions) = lit.split_at(columns);
                for (out, mean) in out.chunks_exact_mut(each).zip(mean.chunks_exact(channels.len())) {
                    channels.iter().zip(mean).for_each(|(&c, v)| out[c].w = *v);
                }
                for (t, row) in directions.chunks_exact(columns).enumerate() {
                    for (out, from) in out.chunks_exact_mut(each).zip(row.chunks_exact(channels.len())) {
                        channels.iter().zip(from).for_each(|(&c, v)| out[t][c] = *v);
                    }
                }
            });
            LitClusters { radiance, each, views: views.len() }
        };
        transfer.direct.iter().enumerate().map(of_set).collect()
    }
}

impl SourceRadiance for TransferSource {
    fn prepare(&self) {
        self.moments();
        self.even();
    }

    fn as_transfer(&self) -> Option<&TransferSource> {
        Some(self)
    }

    fn depends_on_view(&self) -> bool {
        self.transfer.medium.g != 0.0
    }

    fn shade(&self, field: &DensityField, eye: DVec3, volume: &mut ShadedVolume) {
        let node_eye = field.world_from_node.inverse().transform_point3(eye);
        let linear = field.world_from_node.matrix3;
        let along = |[i, j, k]: [usize; 3]| (linear * (DVec3::new(i as f64, j as f64, k as f64) - node_eye)).as_vec3();
        let across = linear.x_axis.as_vec3();
        let squares = squares(self.transfer.medium.g);
        // Where only suns shine, there is no direct light of clusters.
        let even = self.even();
        let seen = (even.is_none() && self.irradiance.iter().any(|e| *e != [0.0; 3])).then(|| {
            let boxes: Vec<_> = volume.table.runs().map(|(corner, sides)| (along(corner), sides)).collect();
            let edges = [linear.x_axis, linear.y_axis, linear.z_axis].map(|edge| edge.as_vec3());
            let directions = ViewDirections::of_boxes(&boxes, edges, squares);
            let lit = self.lit_clusters(directions.directions());
            (directions, lit)
        });
        let direct = match (even, &seen) {
            (Some(lit), _) => Direct::Even(lit),
            (None, Some((directions, lit))) => Direct::Seen(directions, squares, lit),
            (None, None) => Direct::None,
        };
        let cells = self.seen_cells(field, eye);
        volume.write(field, |j, k, out| {
            let at = j + field.dims[1] * k;
            let rows = self.lines[at] as usize..self.lines[at + 1] as usize;
            let nodes = &self.nodes[rows.clone()];
            let (Some(from), Some(to)) = (nodes.first(), nodes.last()) else { return };
            let before = at * out.len();
            let cells = self.cells.line([j, k], [from, to].map(|&node| node as usize - before), &cells);
            shade_line(self, &direct, &cells, Line { rows, before, first: along([0, j, k]), across }, out);
        });
    }
}

/// Direct light of clusters, as a view needs it.
enum Direct<'a> {
    /// The same from everywhere.
    Even(&'a [LitClusters]),
    /// For directions on a cube of so many squares.
    Seen(&'a ViewDirections, usize, &'a [LitClusters]),
    /// Black.
    None,
}

/// Nodes along x.
struct Line {
    /// The lit ones, as rows of direct light.
    rows: Range<usize>,
    /// Nodes of the field before the line.
    before: usize,
    /// From the eye to its first node.
    first: Vec3,
    /// From node to node.
    across: Vec3,
}

/// Writes the lit nodes of a line, one kind of light after another; `cells` are sums along it, see [`Cells::line`].
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn shade_line(source: &TransferSource, direct: &Direct, cells: &[Vec4], line: Line, out: &mut [[f32; 4]]) {
    let g = source.transfer.medium.g;
    let nodes = &source.nodes[line.rows.clone()];
    let along = |node: u32| (node as usize - line.before) as f32;
    let mut sums: Vec<Vec4> =
        nodes.iter().map(|&node| source.cells.between(node as usize - line.before, cells)).collect();
    match direct {
        Direct::Even(lit) => source.add_direct(lit, line.rows.clone(), &vec![([0], [1.0]); nodes.len()], &mut sums),
        Direct::Seen(view, squares, lit) => {
            let around = |&node| view.around(Between::of(line.first + line.across * along(node), *squares));
            let views: Vec<_> = nodes.iter().map(around).collect();
            source.add_direct(lit, line.rows.clone(), &views, &mut sums);
        }
        Direct::None => {}
    }
    for sun in &source.suns {
        let [red, green, blue] = sun.transmittance.each_ref().map(|t| &t[line.rows.clone()]);
        for (at, (sum, &node)) in sums.iter_mut().zip(nodes).enumerate() {
            let way = line.first + line.across * along(node);
            let cosine = if g == 0.0 { 0.0 } else { way.normalize_or(Vec3::Z).dot(sun.toward) };
            let [r, g, b] = sun.power.map(|power| power * phase::value(g, cosine));
            *sum += Vec4::new(r * red[at], g * green[at], b * blue[at], 0.0);
        }
    }
    for (sum, &node) in sums.iter().zip(nodes) {
        let out = &mut out[node as usize - line.before];
        // A truncated series can dip below zero; radiance cannot.
        *out = sum.max(Vec4::ZERO).with_w(out[3]).to_array();
    }
}

impl TransferSource {
    /// Adds the direct radiance of the lit nodes `rows`, weighted means of that along `views` of `lit`, which is by
    /// [`Self::lit_clusters`]: for each node their places and weights.
    #[inline(always)]
    fn add_direct<const N: usize>(
        &self,
        lit: &[LitClusters],
        rows: Range<usize>,
        views: &[([u32; N], [f32; N])],
        sums: &mut [Vec4],
    ) {
        for (set, lit) in self.transfer.direct.iter().zip(lit) {
            let ids = &set.ids[rows.clone()];
            let weights = &set.weights[rows.start * set.terms..rows.end * set.terms];
            let of = |id: u8, view: u32| &lit.radiance[(usize::from(id) * lit.views + view as usize) * lit.each..];
            let mean = |v: &[Vec4]| Vec4::new(v[0].w, v[1].w, v[2].w, 0.0);
            let each = sums.iter_mut().zip(ids).zip(views);
            // What most packs have is unrolled.
            if let (4, (weights, [])) = (set.terms, weights.as_chunks::<4>()) {
                for (((sum, &id), (places, shares)), weights) in each.zip(weights) {
                    let mut blended = [Vec4::ZERO; 4];
                    for (&place, &share) in places.iter().zip(shares) {
                        let Some(radiance) = of(id, place).first_chunk::<4>() else { break };
                        (0..4).for_each(|t| blended[t] += radiance[t] * share);
                    }
                    let [a, b, c, d] = [0, 1, 2, 3].map(|t| blended[t] * weights[t]);
                    *sum += mean(&blended) + ((a + b) + (c + d));
                }
            } else {
                for (at, ((sum, &id), (places, shares))) in each.enumerate() {
                    let weights = &weights[at * set.terms..][..set.terms];
                    for (&place, &share) in places.iter().zip(shares) {
                        let radiance = of(id, place);
                        *sum += radiance.iter().zip(weights).fold(mean(radiance), |sum, (d, w)| sum + *d * *w) * share;
                    }
                }
            }
        }
    }

    /// Indirect radiance of each cell the way it is seen from `eye`.
    fn seen_cells(&self, field: &DensityField, eye: DVec3) -> Vec<Vec4> {
        let bands = self.transfer.bands;
        let (n, side) = (bands * bands, self.cells.majorants.side);
        let [bx, by, _] = self.cells.majorants.bricks;
        // Ways are as long as the smoke is far, in bricks: their squares fit single precision in any units.
        let linear = field.world_from_node.matrix3 * side;
        let linear = (linear * linear.determinant().abs().cbrt().recip()).as_mat3();
        let node_eye = field.world_from_node.inverse().transform_point3(eye) / side - 0.5;
        let middle = |brick: usize| {
            let at = DVec3::new((brick % bx) as f64, (brick / bx % by) as f64, (brick / bx / by) as f64);
            linear * (at - node_eye).as_vec3()
        };
        let mut out = vec![Vec4::ZERO; self.cells.len()];
        let blocks = out.par_chunks_mut(1024).zip(self.moments().par_chunks(1024 * n));
        blocks.zip(self.cells.bricks.par_chunks(1024)).for_each(|((out, moments), bricks)| {
            let ways: Vec<Vec3> = bricks.iter().map(|&brick| middle(brick as usize)).collect();
            along_ways(out, moments, &ways, bands);
        });
        out
    }
}
