//! Which Gaussians share a place, and how: the shares `u_h = w_h B_h / sum w B` on a grid of cells.
//!
//! A cell lists the Gaussians within 3 radii of its centre with their share there (from 0.2 % on), and the density of their sum. The
//! grid spans all supports with up to 64 cells along its longest side, coarser where the lists would exceed
//! 4 million entries: memory is bounded at any overlap.
//!
//! Cost: one exponential for each entry; about 113 (r / cell)^3 entries a Gaussian.

use rayon::prelude::*;

use crate::medium::gaussian_points::GaussianPoints;
use crate::transport::compensated::centres::decay::decay;

/// Cells along the longest side of the box, at most.
const RESOLUTION: f64 = 64.0;
/// Entries of all lists together, about.
const LARGEST_LISTS: f64 = 4e6;
/// A Gaussian counts up to this many radii (Zhou et al. 2008, section 5.1).
const CUT: f32 = 3.0;
/// Shares below this are dropped and the others scaled up: the lists are half as long (600
/// overlapping Gaussians: 2.2 to 1.1 million entries), and rows still sum to what they must.
const SMALLEST_SHARE: f32 = 2e-3;

/// The shares of the Gaussians on a grid.
#[derive(Clone, Debug)]
pub struct OverlapGrid {
    low: [f32; 3],
    high: [f32; 3],
    per_unit: f32,
    dims: [usize; 3],
    starts: Vec<u32>,
    entries: Vec<(u32, f32)>,
    density: Vec<f32>,
}

impl OverlapGrid {
    /// Rasterises the shares. An empty set gives a grid of one empty cell.
    pub fn new(points: &GaussianPoints) -> Self {
        let (mut low, mut high, mut lists) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3], 0.0f64);
        for h in 0..points.len() {
            let center = points.center_of(h);
            for a in 0..3 {
                low[a] = low[a].min(center[a] - CUT * points.radius[h]);
                high[a] = high[a].max(center[a] + CUT * points.radius[h]);
            }
            lists += 113.1 * f64::from(points.radius[h]).powi(3);
        }
        if points.is_empty() {
            (low, high) = ([0.0; 3], [1.0; 3]);
        }
        let longest = (0..3).map(|a| f64::from(high[a]) - f64::from(low[a])).fold(0.0, f64::max);
        let cell = (longest / RESOLUTION).max((lists / LARGEST_LISTS).cbrt());
        let dims: [usize; 3] = std::array::from_fn(|a| {
            (((f64::from(high[a]) - f64::from(low[a])) / cell).ceil() as usize).clamp(1, RESOLUTION as usize + 1)
        });
        let slabs: Vec<Slab> =
            (0..dims[2]).into_par_iter().map(|k| slab(points, low, cell as f32, [dims[0], dims[1]], k)).collect();
        let per_unit = (1.0 / cell) as f32;
        let mut grid = Self { low, high, per_unit, dims, starts: vec![0], entries: Vec::new(), density: Vec::new() };
        for slab in slabs {
            let before = grid.entries.len() as u32;
            grid.starts.extend(slab.ends.iter().map(|end| before + end));
            grid.entries.extend(slab.entries);
            grid.density.extend(slab.density);
        }
        grid
    }

    /// Density (relative) at `at`, and the Gaussians there with their shares, which sum to 1; none outside.
    #[inline(always)]
    pub fn at(&self, at: [f32; 3]) -> (f32, &[(u32, f32)]) {
        let mut cell = 0;
        for a in (0..3).rev() {
            let x = (at[a] - self.low[a]) * self.per_unit;
            if !(x >= 0.0 && x < self.dims[a] as f32) {
                return (0.0, &[]);
            }
            cell = cell * self.dims[a] + x as usize;
        }
        (self.density[cell], &self.entries[self.starts[cell] as usize..self.starts[cell + 1] as usize])
    }

    /// Distance from `from` along the unit vector `direction` to where the ray leaves the box; 0 if it misses.
    #[inline]
    pub fn exit(&self, from: [f32; 3], direction: [f32; 3]) -> f32 {
        let (mut near, mut far) = (0.0f32, f32::INFINITY);
        for a in 0..3 {
            if direction[a] != 0.0 {
                let (t0, t1) = ((self.low[a] - from[a]) / direction[a], (self.high[a] - from[a]) / direction[a]);
                near = near.max(t0.min(t1));
                far = far.min(t0.max(t1));
            } else if from[a] < self.low[a] || from[a] > self.high[a] {
                return 0.0;
            }
        }
        if far > near && far.is_finite() { far } else { 0.0 }
    }
}

/// The finished lists of one slab of cells.
struct Slab {
    ends: Vec<u32>,
    entries: Vec<(u32, f32)>,
    density: Vec<f32>,
}

/// Lists the Gaussians of each cell of slab `k`: counts, then fills, then divides by the sums and drops small shares.
fn slab(points: &GaussianPoints, low: [f32; 3], cell: f32, dims: [usize; 2], k: usize) -> Slab {
    let cells = dims[0] * dims[1];
    let mut counts = vec![0usize; cells];
    visit(points, low, cell, dims, k, |c, _, _| counts[c] += 1);
    let starts: Vec<usize> = std::iter::once(0)
        .chain(counts.iter().scan(0, |sum, count| {
            *sum += count;
            Some(*sum)
        }))
        .collect();
    let (mut all, mut at) = (vec![(0, 0.0); starts[cells]], starts.clone());
    visit(points, low, cell, dims, k, |c, h, square| {
        all[at[c]] = (h as u32, points.weight[h] * decay(square));
        at[c] += 1;
    });
    let mut out = Slab { ends: Vec::with_capacity(cells), entries: Vec::new(), density: Vec::with_capacity(cells) };
    for c in 0..cells {
        let list = &all[starts[c]..starts[c + 1]];
        let density: f32 = list.iter().map(|e| e.1).sum();
        // Below the smallest normal number shares lose their digits: no smoke there.
        let present = density >= f32::MIN_POSITIVE;
        out.density.push(if present { density } else { 0.0 });
        if present {
            let kept = list.iter().filter(|e| e.1 >= SMALLEST_SHARE * density);
            let inverse = 1.0 / kept.clone().map(|e| e.1).sum::<f32>();
            out.entries.extend(kept.map(|&(h, term)| (h, term * inverse)));
        }
        out.ends.push(out.entries.len() as u32);
    }
    out
}

/// Calls `found(cell, Gaussian, q)` for the Gaussians within the cut of each cell's centre, Gaussians ascending.
#[inline(always)]
fn visit(
    points: &GaussianPoints,
    low: [f32; 3],
    cell: f32,
    dims: [usize; 2],
    k: usize,
    mut found: impl FnMut(usize, usize, f32),
) {
    let center = |a: usize, i: usize| low[a] + (i as f32 + 0.5) * cell;
    for h in 0..points.len() {
        let ([cx, cy, cz], radius) = (points.center_of(h), points.radius[h]);
        let dz = (center(2, k) - cz) / radius;
        if dz.abs() > CUT || points.weight[h] == 0.0 {
            continue;
        }
        let range = |a: usize, c: f32, reach: f32| {
            let first = ((c - reach - low[a]) / cell - 0.5).ceil().max(0.0) as usize;
            let last = ((c + reach - low[a]) / cell - 0.5).floor();
            first..if last < 0.0 { 0 } else { (last as usize + 1).min(dims[a]) }
        };
        for j in range(1, cy, radius * (CUT * CUT - dz * dz).max(0.0).sqrt()) {
            let dy = (center(1, j) - cy) / radius;
            let beside = dy * dy + dz * dz;
            for i in range(0, cx, radius * (CUT * CUT - beside).max(0.0).sqrt()) {
                let dx = (center(0, i) - cx) / radius;
                found(i + dims[0] * j, h, dx * dx + beside);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::compensated::centres::testing::{Pcg, cloud, points};

    #[test]
    fn shares_sum_to_one_where_there_is_density() {
        let set = points(&cloud(100, 8));
        let grid = OverlapGrid::new(&set);
        let mut pcg = Pcg::new(3);
        let mut filled = 0;
        for _ in 0..2000 {
            let at = [pcg.uniform() as f32, pcg.uniform() as f32, pcg.uniform() as f32];
            let (density, list) = grid.at(at);
            if density > 0.0 {
                filled += 1;
                assert!((list.iter().map(|e| e.1).sum::<f32>() - 1.0).abs() < 1e-5);
            } else {
                assert!(list.is_empty());
            }
        }
        assert!(filled > 200);
    }

    #[test]
    fn a_cell_centre_has_exact_shares() {
        let set = points(&cloud(30, 2));
        let grid = OverlapGrid::new(&set);
        let mut seen = 0;
        for cell in (0..grid.density.len()).step_by(97).filter(|&c| grid.density[c] > 0.0) {
            let index = [cell % grid.dims[0], cell / grid.dims[0] % grid.dims[1], cell / grid.dims[0] / grid.dims[1]];
            let at: [f32; 3] = std::array::from_fn(|a| grid.low[a] + (index[a] as f32 + 0.5) / grid.per_unit);
            let term = |h: usize| {
                let q: f64 = (0..3).map(|a| f64::from((at[a] - set.center[a][h]) / set.radius[h]).powi(2)).sum();
                if q <= 9.0 { f64::from(set.weight[h]) * (-q).exp() } else { 0.0 }
            };
            let total: f64 = (0..set.len()).map(term).sum();
            // A term at the cut, exp(-9) = 1.2e-4, may fall to either side of it.
            assert!((f64::from(grid.density[cell]) - total).abs() < 4e-5 * total + 1.3e-4);
            for &(h, share) in grid.at(at).1 {
                let expected = term(h as usize) / f64::from(grid.density[cell]);
                if expected == 0.0 {
                    continue;
                }
                // q <= 9 from coordinates of size 1 rounded to 1e-7, divided by r: 2 sqrt(q) 1e-7 / 0.03 = 2e-5. Of 30
                // Gaussians, what is dropped is below 30 * 2e-3.
                let ratio = f64::from(share) / expected;
                assert!(ratio > 1.0 - 4e-5 && ratio < 1.0 + 0.06, "{ratio}");
                seen += 1;
            }
        }
        assert!(seen > 50);
    }

    #[test]
    fn lists_stay_bounded_and_odd_sets_are_served() {
        let wide: Vec<_> =
            cloud(3000, 5).into_iter().map(|g| smoke_formats::gaussian::Gaussian { radius: 0.3, ..g }).collect();
        let grid = OverlapGrid::new(&points(&wide));
        assert!((grid.entries.len() as f64) < 1.3 * LARGEST_LISTS, "{}", grid.entries.len());
        assert_eq!(OverlapGrid::new(&points(&[])).at([0.5; 3]).1.len(), 0);
        let one = OverlapGrid::new(&points(&cloud(1, 1)));
        assert_eq!(one.exit([9.0; 3], [1.0, 0.0, 0.0]), 0.0);
        assert!(one.exit(points(&cloud(1, 1)).center_of(0), [1.0, 0.0, 0.0]) > 0.08);
    }
}
