//! What many lights send along one direction through the cells, ray by ray, slice by slice.
//!
//! `L <- L e^-x + J (1 - e^-x)`, x the optical depth between two slices and J the mean of a source that is linear in
//! optical depth. The rays are sheared columns ([`columns`]): a ray is never interpolated on its way, only what a slice
//! sends where the ray meets it, and what has arrived where a cell lies between rays. A slice's source is weighted by
//! density, so what lies beside smoke is not mixed in. Lights go together, as all of them have the same depths.
//! Cost: one exponential a ray and slice, and for each light 16 operations.
//!
//! [`columns`]: smoke_runtime::transport::compensated::grid::columns

use multiversion::multiversion;
use smoke_runtime::lanes::{exp_neg_and_rest, near_share};
use smoke_runtime::transport::compensated::grid::columns::{Path, Slices, SweepGrid};
use smoke_runtime::transport::transfer::cells::Cells;

/// Lights that go together.
pub const LANES: usize = 8;
/// One number for each of them.
pub type Lanes = [f32; LANES];

/// A cell of a slice: its place there, `row * columns + column`, and which cell it is.
pub type Placed = (u32, u32);

/// The cells of each slice across an axis, of a grid that has a node for each cell of the box and a border of one
/// around.
pub fn of_slices(cells: &Cells, dims: [usize; 3], axis: usize) -> Vec<Vec<Placed>> {
    let [bx, by, _] = cells.majorants.bricks;
    let mut out = vec![Vec::new(); dims[axis]];
    // Columns and rows of a slice: y and z across x, x and the other one across y and z.
    let across = if axis == 0 { [1, 2] } else { [0, 3 - axis] };
    for (cell, &brick) in cells.bricks.iter().enumerate() {
        let brick = brick as usize;
        let node = [brick % bx + 1, brick / bx % by + 1, brick / bx / by + 1];
        let place = node[across[1]] * dims[across[0]] + node[across[0]];
        out[node[axis]].push((place as u32, cell as u32));
    }
    out
}

/// The rays of one direction: what was where they last met a slice, and what they carry.
pub struct Rays {
    density: Vec<f32>,
    source: Vec<Lanes>,
    radiance: Vec<Lanes>,
    /// What a source of 1 would have sent.
    opacity: Vec<f32>,
}

impl Rays {
    /// Before the first slice.
    pub fn new(path: &Path) -> Self {
        let count = path.extent[0] * path.extent[1];
        let lanes = vec![[0.0; LANES]; count];
        Self { density: vec![0.0; count], source: lanes.clone(), radiance: lanes, opacity: vec![0.0; count] }
    }
}

/// Carries rays to slice number `step` of their way. `emit(cell)` is the source radiance of a cell of that slice along
/// them; `receive(cell, radiance, opacity)` is told what has arrived there, and what a source of 1 would have sent.
/// `emitted` is scratch, one a node of a slice.
#[expect(clippy::too_many_arguments, reason = "the inner loop of a sweep")]
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub fn advance(
    rays: &mut Rays,
    grid: &SweepGrid,
    path: &Path,
    step: usize,
    sigma_t: f32,
    cells: &[Placed],
    emitted: &mut [Lanes],
    emit: impl Fn(usize) -> Lanes,
    mut receive: impl FnMut(usize, Lanes, f32),
) {
    let slices = &path.slices;
    let &Slices { columns, rows, .. } = slices;
    let shift = path.shift(step);
    let density = grid.density(slices);
    emitted.fill([0.0; LANES]);
    for &(place, cell) in cells {
        let place = place as usize;
        let density = density[slices.row(shift.slice, place / columns) + place % columns];
        emitted[place] = emit(cell as usize).map(|v| v * density);
    }
    let weights = shift.ray_weights();
    let half = 0.5 * path.length;
    for row in 0..rows - 1 {
        let start = (shift.base[1] + row + 1) * path.extent[0] + shift.base[0] + 1;
        let low = &density[slices.row(shift.slice, row)..][..columns];
        let high = &density[slices.row(shift.slice, row + 1)..][..columns];
        for column in grid.active_rays(slices, shift.slice, row) {
            let at = start + column;
            let met = weights[0][0] * low[column]
                + weights[0][1] * low[column + 1]
                + weights[1][0] * high[column]
                + weights[1][1] * high[column + 1];
            let before = std::mem::replace(&mut rays.density[at], met);
            let x = sigma_t * (half * (before + met));
            let (kept, rest) = exp_neg_and_rest(x);
            let share = near_share(x, rest);
            let (near, far) = (rest * share, rest - rest * share);
            rays.opacity[at] = rays.opacity[at] * kept + rest;
            let mut source = rays.source[at];
            if met > 0.0 {
                let place = row * columns + column;
                let [a, b] = [emitted[place], emitted[place + 1]];
                let [c, d] = [emitted[place + columns], emitted[place + columns + 1]];
                for lane in 0..LANES {
                    let above = weights[0][0] * a[lane] + weights[0][1] * b[lane];
                    source[lane] = (above + (weights[1][0] * c[lane] + weights[1][1] * d[lane])) / met;
                }
            }
            // Where there was no smoke before, what is sent there is as here.
            let behind = if before > 0.0 { rays.source[at] } else { source };
            let radiance = &mut rays.radiance[at];
            for lane in 0..LANES {
                radiance[lane] = radiance[lane] * kept + (near * source[lane] + far * behind[lane]);
            }
            rays.source[at] = source;
        }
    }
    let around = shift.node_weights();
    for &(place, cell) in cells {
        let (row, column) = (place as usize / columns, place as usize % columns);
        let low = (shift.base[1] + row) * path.extent[0] + shift.base[0] + column;
        let high = low + path.extent[0];
        let opacity = around[0][0] * rays.opacity[low]
            + around[0][1] * rays.opacity[low + 1]
            + around[1][0] * rays.opacity[high]
            + around[1][1] * rays.opacity[high + 1];
        let [a, b] = [rays.radiance[low], rays.radiance[low + 1]];
        let [c, d] = [rays.radiance[high], rays.radiance[high + 1]];
        let mut arrived = [0.0; LANES];
        for lane in 0..LANES {
            let above = around[0][0] * a[lane] + around[0][1] * b[lane];
            arrived[lane] = above + (around[1][0] * c[lane] + around[1][1] * d[lane]);
        }
        receive(cell as usize, arrived, opacity);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, Vec3};
    use smoke_runtime::medium::field::DensityField;

    /// Every direction, through a box of constant density: a constant source sends the opacity of the way, and a source
    /// that is linear in depth what the integral says.
    #[test]
    fn a_box_sends_what_its_depth_says_along_each_axis_and_sense() {
        let n = 8;
        let field = DensityField::from_box([0; 3], [n; 3], &vec![1.0; n * n * n], DAffine3::IDENTITY);
        let cells = Cells::new(&field, 0);
        // A node a cell: n + 1 cells along each axis, and the outer ones are half as dense.
        let density: Vec<f32> = cells.mass.iter().map(|m| *m as f32).collect();
        let coarse = DensityField::from_box([0; 3], cells.majorants.bricks, &density, DAffine3::IDENTITY);
        let grid = SweepGrid::new(&coarse);
        for (axis, toward) in [Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y, Vec3::Z, Vec3::NEG_Z].into_iter().enumerate()
        {
            let axis = axis / 2;
            let path = grid.path(toward);
            let slices = of_slices(&cells, coarse.dims, axis);
            assert_eq!(slices.iter().map(Vec::len).sum::<usize>(), cells.len());
            let mut rays = Rays::new(&path);
            let mut emitted = vec![[0.0; LANES]; path.slices.columns * path.slices.rows];
            let (mut depth, mut linear) = (0.0f64, 0.0f64);
            for step in 0..path.slices.count {
                let slice = path.shift(step).slice;
                // The lanes: 1, twice that, and the number of the slice.
                let emit = |_| [1.0, 2.0, step as f32, 0.0, 0.0, 0.0, 0.0, 0.0];
                let mut seen = 0;
                let middle = |cell: usize| {
                    let brick = cells.bricks[cell] as usize;
                    let [bx, by, _] = cells.majorants.bricks;
                    let at = [brick % bx, brick / bx % by, brick / bx / by];
                    (0..3).all(|a| a == axis || at[a] == n / 2)
                };
                let mut arrived = None;
                advance(
                    &mut rays,
                    &grid,
                    &path,
                    step,
                    0.3,
                    &slices[slice],
                    &mut emitted,
                    emit,
                    |cell, radiance, opacity| {
                        seen += 1;
                        if middle(cell) {
                            arrived = Some((radiance, opacity));
                        }
                    },
                );
                assert_eq!(seen, slices[slice].len());
                // Density along the middle line: 1 inside, a half at both ends, 0 on the border.
                let at = |step: usize| match step {
                    0 => 0.0,
                    s if s == 1 || s == n + 1 => 0.5,
                    s if s <= n => 1.0,
                    _ => 0.0,
                };
                if step > 0 {
                    let x = 0.3 * 0.5 * (at(step - 1) + at(step));
                    depth += x;
                    // Linear in depth from the slice before, by Simpson's rule in 200 pieces.
                    let (mut sum, pieces) = (0.0, 200);
                    for piece in 0..=pieces {
                        let t = f64::from(piece) / f64::from(pieces);
                        let weight = if piece == 0 || piece == pieces { 1.0 } else { f64::from(2 + 2 * (piece % 2)) };
                        let source = if at(step - 1) > 0.0 { step as f64 - t } else { step as f64 };
                        sum += weight / (3.0 * f64::from(pieces)) * source * x * (-x * t).exp();
                    }
                    linear = linear * (-x).exp() + if at(step) > 0.0 { sum } else { 0.0 };
                }
                if let Some((radiance, opacity)) = arrived {
                    let expected = -(-depth).exp_m1();
                    assert!((f64::from(opacity) - expected).abs() < 2e-6, "{toward} {step}: {opacity} {expected}");
                    assert!((radiance[0] - opacity).abs() < 1e-6 && (radiance[1] - 2.0 * opacity).abs() < 2e-6);
                    let error = (f64::from(radiance[2]) - linear).abs();
                    assert!(error < 1e-5 * linear.max(1.0), "{toward} {step}: {} {linear}", radiance[2]);
                }
            }
        }
    }
}
