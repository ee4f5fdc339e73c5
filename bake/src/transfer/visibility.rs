//! Direct light: how much of each direction of the basis's mesh reaches each voxel.
//!
//! For local bases with one direction a function, the transfer of light that is scattered once has rank 1: what a voxel
//! sends out under basis light k is `T(x, l_k) A_k` times the phase function. So one transmittance is kept for each
//! direction and voxel, whatever the output's bands, and the phase function is applied when the light is known, exactly
//! at any g. (Zhang et al. 2013, section 6.2, keeps n numbers for each.) Harmonics are sampled on the same mesh. Each
//! direction is one sweep of sheared columns, O(N), as in [`single_scattering`], which a march from every voxel would
//! take O(N^(4/3)) for. Two passes: some voxels' rows give the directions that hold most of all rows
//! ([`super::reduce`]), and then each sweep is projected on them as it comes, so the whole matrix is never there.
//! Cost: two sweeps a direction, about 30 operations a node each, and voxels x directions x rank.
//!
//! [`single_scattering`]: smoke_runtime::transport::compensated::grid::single::single_scattering

use super::reduce::{Reduced, of_sample};
use glam::Vec3;
use rayon::prelude::*;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::product::add_product;
use smoke_runtime::sphere::light_basis::LightBasis;
use smoke_runtime::transport::compensated::grid::columns::SweepGrid;
use smoke_runtime::transport::compensated::grid::single::transmittance_from;
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;

/// Voxels whose rows the directions are found from, evenly picked.
const SAMPLE: usize = 4096;
/// Bytes of transmittances that are held at a time.
const HELD_BYTES: usize = 512 << 20;

/// The transmittances from the basis's directions to the lit nodes of `fields`, one field after the other, reduced to
/// at most `rank` directions; `done` is told sweeps as they are finished, two for each field and direction.
pub fn visibility(
    fields: &[&DensityField],
    basis: &LightBasis,
    sigma_t: f32,
    rank: usize,
    done: &(dyn Fn(u64) + Sync),
) -> Reduced {
    let toward: Vec<Vec3> = basis.mesh().directions().iter().map(|d| d.as_vec3()).collect();
    let length = toward.len();
    let frames: Vec<Frame> = fields.iter().map(|field| Frame::new(field)).collect();
    let total: usize = frames.iter().map(|f| f.nodes.len()).sum();
    if total == 0 {
        return Reduced::default();
    }
    let every = total.div_ceil(SAMPLE);
    let mut sample = Vec::new();
    for frame in &frames {
        let sampled: Vec<u32> = frame.nodes.iter().copied().step_by(every).collect();
        let mut rows = vec![0.0f32; sampled.len() * length];
        sweeps(&frame.grid, &toward, sigma_t, |first, planes| {
            rows.par_chunks_exact_mut(length).zip(&sampled).for_each(|(row, &node)| {
                row[first..].iter_mut().zip(planes).for_each(|(v, plane)| *v = plane[node as usize]);
            });
            done(planes.len() as u64);
        });
        sample.extend(rows);
    }
    let directions = of_sample(&sample, length, rank);
    let rank = directions.len() / length;
    let mut reduced = Reduced { rank, rows: vec![0.0; total * rank], directions, energy: 0.0 };
    let mut rest = &mut reduced.rows[..];
    for frame in &frames {
        let (rows, after) = std::mem::take(&mut rest).split_at_mut(frame.nodes.len() * rank);
        rest = after;
        sweeps(&frame.grid, &toward, sigma_t, |first, planes| {
            reduced.energy += project(rows, &frame.nodes, planes, first, &reduced.directions, length);
            done(planes.len() as u64);
        });
    }
    reduced
}

/// A field with its lit nodes, ready for sweeps.
struct Frame {
    grid: SweepGrid,
    nodes: Vec<u32>,
}

impl Frame {
    fn new(field: &DensityField) -> Self {
        Self { grid: SweepGrid::new(field), nodes: lit_nodes(field) }
    }
}

/// Calls `visit(first, planes)` with the transmittances from the directions from `first` on, as many at a time as
/// [`HELD_BYTES`] hold.
pub fn sweeps(grid: &SweepGrid, toward: &[Vec3], sigma_t: f32, mut visit: impl FnMut(usize, &[Vec<f32>])) {
    let held = (HELD_BYTES / (4 * grid.len())).max(8);
    for (chunk, first) in toward.chunks(held).zip((0..).step_by(held)) {
        visit(first, &transmittance_from(grid, chunk, sigma_t));
    }
}

/// Adds what `planes`, the directions of the mesh from `first` on, have along the reduced directions (`[rank][length]`)
/// to the short rows of `nodes`. Gives the sum of their squares.
fn project(
    rows: &mut [f32],
    nodes: &[u32],
    planes: &[Vec<f32>],
    first: usize,
    directions: &[f32],
    length: usize,
) -> f64 {
    const BLOCK: usize = 1024;
    let (columns, rank) = (planes.len(), directions.len() / length);
    let factor: Vec<f32> = (0..columns * rank).map(|at| directions[at % rank * length + first + at / rank]).collect();
    let squares = rows.par_chunks_mut(BLOCK * rank.max(1)).zip(nodes.par_chunks(BLOCK)).map(|(rows, nodes)| {
        let mut block = vec![0.0f32; nodes.len() * columns];
        for (row, &node) in block.chunks_exact_mut(columns).zip(nodes) {
            row.iter_mut().zip(planes).for_each(|(v, plane)| *v = plane[node as usize]);
        }
        add_product(rows, &block, &factor, columns, rank);
        block.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>()
    });
    squares.collect::<Vec<_>>().iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};
    use smoke_runtime::sphere::light_basis::BasisKind;

    fn blob(n: usize) -> DensityField {
        let value = |v: usize| {
            let p = Vec3::new((v % n) as f32, (v / n % n) as f32, (v / n / n) as f32) - 0.5 * (n as f32 - 1.0);
            (-(p / (0.25 * n as f32)).length_squared()).exp()
        };
        let values: Vec<f32> = (0..n * n * n).map(value).map(|d| if d < 0.02 { 0.0 } else { d }).collect();
        DensityField::from_box([0; 3], [n; 3], &values, DAffine3::from_scale(DVec3::splat(1.0 / n as f64)))
    }

    #[test]
    fn short_rows_give_back_the_transmittance_from_every_direction() {
        let field = blob(16);
        let basis = LightBasis::new(BasisKind::Hat(162));
        let reduced = visibility(&[&field], &basis, 6.0, 60, &|_| ());
        let mut back = vec![0.0f32; reduced.rows.len() / reduced.rank * 162];
        add_product(&mut back, &reduced.rows, &reduced.directions, reduced.rank, 162);
        let toward: Vec<Vec3> = basis.mesh().directions().iter().map(|d| d.as_vec3()).collect();
        let planes = transmittance_from(&SweepGrid::new(&field), &toward, 6.0);
        let (mut left, mut whole) = (0.0, 0.0);
        for (row, &voxel) in back.chunks(162).zip(&lit_nodes(&field)) {
            for (found, plane) in row.iter().zip(&planes) {
                left += f64::from(found - plane[voxel as usize]).powi(2);
                whole += f64::from(plane[voxel as usize]).powi(2);
            }
        }
        let error = (left / whole).sqrt();
        // The energies are sums in another order, and the error is a difference of them: 1e-3 of a part.
        assert!(error < 0.01 && (error - reduced.error()).abs() < 1e-3, "{error} {}", reduced.error());
    }

    #[test]
    fn empty_clear_and_black_smoke_are_no_trouble() {
        let basis = LightBasis::new(BasisKind::Hat(42));
        let empty = DensityField::from_box([0; 3], [4; 3], &[0.0; 64], DAffine3::IDENTITY);
        assert_eq!(visibility(&[&empty], &basis, 1.0, 8, &|_| ()), Reduced::default());
        let field = blob(8);
        let clear = visibility(&[&field], &basis, 0.0, 8, &|_| ());
        // All rows are ones: one direction.
        assert!(clear.rank == 1 && clear.error() < 1e-3);
        let black = visibility(&[&field], &basis, 1e6, 8, &|_| ());
        assert!(black.rows.iter().all(|v| v.is_finite()) && black.error() <= 1.0);
    }
}
