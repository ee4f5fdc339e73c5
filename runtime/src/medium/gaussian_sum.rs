//! The sum of Gaussians on a box of voxels: `S(x) = sum_l w_l B_l(x)`, `B_l(x) = exp(-|x - c_l|^2 / r_l^2)`.
//!
//! THE evaluation of the fit: the optimiser, the residual and the decoder all call the rows of this file, so what the
//! fit minimised is, bit for bit, what the residual is taken against and what the march sees.
//!
//! `B` is a product of three factors, one an axis. A [`Kernel`] holds the three tables (up to 3 * 70 exponentials
//! instead of one a voxel), and a row of 16 voxels costs one load, multiply, add and store.
//! Cost: `2 pi (3 r)^3` voxels of a Gaussian, rounded up to blocks of 16 along x.
//!
//! Support (Zhou et al. 2008, section 5.1, cut the sphere `|x - c| < 3 r`). Here it is the cylinder
//! `|dx| < 3 r, dy^2 + dz^2 < (3 r)^2` that contains that sphere: its rows along x have one length, so a row is a plain
//! loop over table entries in registers. The jump at the border is the paper's, `exp(-9) = 1.2e-4` of the weight, or
//! less. The cut depends on the Gaussian and the voxel alone, never on the box, so boxes of any origin agree bit for bit.
//!
//! Every operation is an IEEE f32 or f64 operation in a fixed order (own exponential, no contraction to fused
//! multiply-add, sums in the order of the Gaussians): the same bits on every machine, vector width and thread count.

use multiversion::multiversion;
use rayon::prelude::*;
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use std::ops::Range;

/// Where a Gaussian is cut off, in radii: the paper's 3.
pub const SUPPORT_RADII: f32 = 3.0;

/// Voxels in a block of a row.
pub const LANES: usize = 16;

/// A block of a row along x.
pub type Block = [f32; LANES];

/// Slices along z that are summed as one task.
pub const SLAB: usize = 4;

/// A box of voxels: which indices, and where they lie in unit space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lattice {
    /// Index space to unit space.
    pub space: UnitSpace,
    /// Index of the first voxel.
    pub origin: [i32; 3],
    /// Voxels along x, y, z.
    pub dims: [usize; 3],
}

impl Lattice {
    /// Blocks in a row along x; the last one may reach past the end of the row.
    pub fn row_blocks(&self) -> usize {
        self.dims[0].div_ceil(LANES)
    }

    /// Blocks in a slice of one z.
    pub fn slice_blocks(&self) -> usize {
        self.row_blocks() * self.dims[1]
    }
}

/// One axis of a kernel.
#[derive(Clone, Debug, Default)]
struct Axis {
    /// The first voxel of the support, and one past the last, in the box.
    range: Range<usize>,
    /// `(position - centre) / radius` at the voxels of `range`.
    u: Vec<f32>,
    /// `exp(-u^2)`, zero beyond the support.
    b: Vec<f32>,
}

/// One Gaussian's tables on a lattice. Reused from one evaluation to the next, so that it allocates only to grow.
#[derive(Clone, Debug, Default)]
pub struct Kernel {
    /// The first block of a row that the support meets.
    first_block: usize,
    /// `exp(-ux^2)` from `first_block` on; zero outside the support.
    bx: Vec<Block>,
    /// `(x - cx) / r`, same places.
    ux: Vec<Block>,
    y: Axis,
    z: Axis,
    /// For each z of the support, the rows whose `(y, z)` lies in the disc.
    rows: Vec<Range<usize>>,
}

/// The weighted sums of a field `e` under one kernel, `u = (x - c) / r`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moments {
    /// `sum e B`.
    pub zeroth: f64,
    /// `sum e B u`.
    pub first: [f64; 3],
    /// `sum e B |u|^2`.
    pub second: f64,
}

/// `exp(-t)` for `0 <= t < 80`, within 2 units in the last place; the same bits everywhere.
///
/// `exp(-t) = 2^k exp(f)`, `|f| <= ln 2 / 2`: Taylor's series to degree 7 (remainder below 6e-9).
#[inline(always)]
fn exp_of_minus(t: f32) -> f32 {
    // Adding and subtracting 1.5 * 2^23 rounds to the nearest whole number.
    const ROUND: f32 = 12_582_912.0;
    let k = (t * -std::f32::consts::LOG2_E + ROUND) - ROUND;
    // ln 2 in two parts; the first has few enough bits for k * LN2_HIGH to be exact.
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let f = (-t - k * LN2_HIGH) - k * LN2_LOW;
    let mut p = 1.0 / 5040.0;
    for c in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = p * f + c;
    }
    // 127 is the exponent's bias; k >= -116 keeps the result normal.
    p * f32::from_bits(((k as i32 + 127) as u32) << 23)
}

impl Kernel {
    /// Makes the tables of the Gaussian at `center` with `radius`, in unit space, both finite, `radius > 0`.
    pub fn place(&mut self, lattice: &Lattice, center: [f64; 3], radius: f64) {
        let inverse = lattice.space.scale / radius;
        // The centre in index space; a function of the Gaussian alone, so that boxes of any origin agree.
        let at = |a: usize| (center[a] - lattice.space.offset[a]) / lattice.space.scale;
        let reach = f64::from(SUPPORT_RADII) / inverse;
        let range = |a: usize| {
            let local = at(a) - f64::from(lattice.origin[a]);
            // Casts saturate, so a centre far away gives an empty range.
            let lo = ((local - reach).floor().max(0.0) as usize).min(lattice.dims[a]);
            let hi = ((local + reach).ceil() + 1.0).max(0.0) as usize;
            lo..hi.min(lattice.dims[a]).max(lo)
        };
        let u = |a: usize, i: usize| ((f64::from(lattice.origin[a]) + i as f64 - at(a)) * inverse) as f32;
        for (a, axis) in [(1, &mut self.y), (2, &mut self.z)] {
            axis.range = range(a);
            axis.u.clear();
            axis.u.extend(axis.range.clone().map(|i| u(a, i)));
            axis.b.clear();
            axis.b.extend(axis.u.iter().map(|&u| factor(u)));
        }
        let x = range(0);
        self.first_block = x.start / LANES;
        let blocks = if x.is_empty() { 0 } else { x.end.div_ceil(LANES) - self.first_block };
        self.ux.clear();
        self.ux.extend((0..blocks).map(|b| std::array::from_fn(|l| u(0, (self.first_block + b) * LANES + l))));
        self.bx.clear();
        self.bx.resize(blocks, [0.0; LANES]);
        factors(&self.ux, &mut self.bx, lattice.dims[0], self.first_block);
        self.cut_rows();
    }

    /// The rows inside the disc, for each z. The disc's half-width changes little from one z to the next.
    fn cut_rows(&mut self) {
        let (y, limit) = (&self.y, SUPPORT_RADII * SUPPORT_RADII);
        self.rows.clear();
        let nearest = (0..y.u.len()).min_by(|&a, &b| y.u[a].abs().total_cmp(&y.u[b].abs())).unwrap_or(0);
        let (mut lo, mut hi) = (nearest, nearest);
        for &uz in &self.z.u {
            let inside = |i: usize| y.u[i] * y.u[i] + uz * uz < limit;
            while lo > 0 && inside(lo - 1) {
                lo -= 1;
            }
            while lo < nearest && !inside(lo) {
                lo += 1;
            }
            while hi < y.u.len() && inside(hi) {
                hi += 1;
            }
            while hi > nearest && !inside(hi - 1) {
                hi -= 1;
            }
            // With not even the nearest row inside, lo = hi = nearest.
            self.rows.push(lo..hi.max(lo));
        }
    }

    /// Adds `weight * B` to a slab: whole slices from `z0` on, rows padded to [`Lattice::row_blocks`].
    #[inline(always)]
    fn add_to(&self, weight: f32, slab: &mut [Block], z0: usize, lattice: &Lattice) {
        let (stride, slice) = (lattice.row_blocks(), lattice.slice_blocks());
        if self.bx.is_empty() {
            return;
        }
        let z1 = z0 + slab.len() / slice;
        for z in self.z.range.start.max(z0)..self.z.range.end.min(z1) {
            let local = z - self.z.range.start;
            let wz = weight * self.z.b[local];
            let rows = self.rows[local].clone();
            if rows.is_empty() {
                continue;
            }
            let first = (z - z0) * slice + (self.y.range.start + rows.start) * stride + self.first_block;
            let (by, field) = (&self.y.b[rows], &mut slab[first..]);
            for (block, bx) in self.bx.iter().enumerate() {
                // One block of columns at a time: its table stays in one register.
                for (row, &by) in field[block..].iter_mut().step_by(stride).zip(by) {
                    add_scaled(row, wz * by, bx);
                }
            }
        }
    }
}

/// `exp(-u^2)` inside the support, else zero.
#[inline(always)]
fn factor(u: f32) -> f32 {
    let t = u * u;
    let inside = t < SUPPORT_RADII * SUPPORT_RADII;
    let b = exp_of_minus(if inside { t } else { 0.0 });
    if inside { b } else { 0.0 }
}

/// [`factor`] of whole blocks; lanes at or past `width` (the row's padding) get zero.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn factors(u: &[Block], b: &mut [Block], width: usize, first_block: usize) {
    for (b, u) in b.iter_mut().zip(u) {
        for l in 0..LANES {
            b[l] = factor(u[l]);
        }
    }
    if let Some(last) = b.last_mut() {
        let start = (first_block + u.len() - 1) * LANES;
        last[(width - start).min(LANES)..].fill(0.0);
    }
}

/// Adds the Gaussians to one slab, in their order: `weights[l] * B_l`.
///
/// `slab` holds whole slices from `z0` on, rows padded to [`Lattice::row_blocks`].
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub fn add_slab(kernels: &[Kernel], weights: &[f32], slab: &mut [Block], z0: usize, lattice: &Lattice) {
    for (kernel, &weight) in kernels.iter().zip(weights) {
        kernel.add_to(weight, slab, z0, lattice);
    }
}

/// The sums of `field` (the whole lattice, rows padded to [`Lattice::row_blocks`]) under one kernel.
///
/// Sums over y in f32 lanes, over x and z of their results in f64: relative error below `60 * 2^-24` of the sum of
/// magnitudes at the largest support in use (60 rows).
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub fn moments(kernel: &Kernel, field: &[Block], lattice: &Lattice) -> Moments {
    let mut sums = Moments::default();
    for block in 0..kernel.bx.len() {
        gather(kernel, block, field, lattice, &mut sums);
    }
    sums
}

/// `sum += s * e`.
#[inline(always)]
fn add_scaled(sum: &mut Block, s: f32, e: &Block) {
    for l in 0..LANES {
        sum[l] += s * e[l];
    }
}

/// Adds the sums under one block of columns. Several blocks at once were slower (1.8 s against 1.1 s for a whole fit):
/// the compiler then takes the loops over lanes apart and uses narrow vectors.
#[inline(always)]
fn gather(kernel: &Kernel, block: usize, field: &[Block], lattice: &Lattice, sums: &mut Moments) {
    let (stride, slice) = (lattice.row_blocks(), lattice.slice_blocks());
    // Per voxel column x: sums over y and z of e times 1, uy, uz, uy^2 + uz^2, each times by * bz.
    let mut columns = [[0.0f32; LANES]; 4];
    for (local, rows) in kernel.rows.iter().enumerate().filter(|(_, rows)| !rows.is_empty()) {
        let z = kernel.z.range.start + local;
        let start = z * slice + (kernel.y.range.start + rows.start) * stride + kernel.first_block + block;
        let (mut a0, mut a1, mut a2) = ([0.0f32; LANES], [0.0f32; LANES], [0.0f32; LANES]);
        let (by, uy) = (&kernel.y.b[rows.clone()], &kernel.y.u[rows.clone()]);
        for (e, (&by, &uy)) in field[start..].iter().step_by(stride).zip(by.iter().zip(uy)) {
            let (s1, s2) = (by * uy, by * (uy * uy));
            add_scaled(&mut a0, by, e);
            add_scaled(&mut a1, s1, e);
            add_scaled(&mut a2, s2, e);
        }
        let (bz, uz) = (kernel.z.b[local], kernel.z.u[local]);
        add_scaled(&mut columns[0], bz, &a0);
        add_scaled(&mut columns[1], bz, &a1);
        add_scaled(&mut columns[2], bz * uz, &a0);
        add_scaled(&mut columns[3], bz, &a2);
        add_scaled(&mut columns[3], bz * (uz * uz), &a0);
    }
    let (bx, ux) = (&kernel.bx[block], &kernel.ux[block]);
    for l in 0..LANES {
        let (bx, ux) = (f64::from(bx[l]), f64::from(ux[l]));
        let [m0, my, mz, m2] = columns.map(|column| bx * f64::from(column[l]));
        sums.zeroth += m0;
        sums.first[0] += m0 * ux;
        sums.first[1] += my;
        sums.first[2] += mz;
        sums.second += m2 + m0 * ux * ux;
    }
}

/// The Gaussian sum on the voxels `origin .. origin + dims`, x fastest, in the density unit of the weights.
///
/// Each voxel's value is the sum over the Gaussians in their order, and does not depend on the box. Centres, radii and
/// weights must be finite and radii positive, as a pack guarantees. A box without voxels gives no values.
pub fn gaussian_sum(gaussians: &[Gaussian], space: &UnitSpace, origin: [i32; 3], dims: [usize; 3]) -> Vec<f32> {
    let lattice = Lattice { space: *space, origin, dims };
    let voxels = dims.iter().product();
    if voxels == 0 {
        return Vec::new();
    }
    let mut kernels = vec![Kernel::default(); gaussians.len()];
    kernels.par_iter_mut().with_min_len(32).zip(gaussians).for_each(|(kernel, g)| {
        kernel.place(&lattice, g.center.map(f64::from), f64::from(g.radius));
    });
    let weights: Vec<f32> = gaussians.iter().map(|g| g.weight).collect();
    let mut out = vec![0.0; voxels];
    out.par_chunks_mut(SLAB * dims[0] * dims[1]).enumerate().for_each(|(s, out)| {
        let mut slab = vec![[0.0; LANES]; out.len() / dims[0] * lattice.row_blocks()];
        add_slab(&kernels, &weights, &mut slab, s * SLAB, &lattice);
        for (out, row) in out.chunks_mut(dims[0]).zip(slab.chunks(lattice.row_blocks())) {
            out.copy_from_slice(&row.as_flattened()[..dims[0]]);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gaussian(center: [f32; 3], radius: f32, weight: f32) -> Gaussian {
        Gaussian { center, radius, weight }
    }

    /// A spread of Gaussians, some outside the box, by a fixed linear congruence.
    fn spread(n: usize) -> Vec<Gaussian> {
        let mut state = 12345u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        (0..n).map(|_| gaussian([0; 3].map(|_| next() * 1.4 - 0.2), 0.015 + next() * 0.075, next())).collect()
    }

    /// Every voxel by the definition, in f64.
    fn brute(gaussians: &[Gaussian], space: &UnitSpace, origin: [i32; 3], dims: [usize; 3]) -> Vec<f64> {
        let mut out = Vec::new();
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let index = [i, j, k];
                    let sum = gaussians.iter().map(|g| {
                        let u: [f64; 3] = std::array::from_fn(|a| {
                            let x = space.offset[a] + space.scale * (f64::from(origin[a]) + index[a] as f64);
                            (x - f64::from(g.center[a])) / f64::from(g.radius)
                        });
                        let [x, y, z] = u.map(|u| u * u);
                        if x < 9.0 && y + z < 9.0 { f64::from(g.weight) * (-x - y - z).exp() } else { 0.0 }
                    });
                    out.push(sum.sum());
                }
            }
        }
        out
    }

    #[test]
    fn the_exponential_is_within_two_units_in_the_last_place() {
        for i in 0..=90_000 {
            let t = i as f32 * 1e-4;
            let truth = (-f64::from(t)).exp();
            let error = (f64::from(exp_of_minus(t)) - truth).abs() / truth;
            // A unit in the last place is at most 2^-23 of the value.
            assert!(error < 2.0 * f64::from(f32::EPSILON), "t {t}: {error}");
        }
        assert_eq!(exp_of_minus(0.0), 1.0);
    }

    #[test]
    fn the_sum_equals_the_definition_at_every_voxel() {
        let (origin, dims) = ([-7, 3, 40], [37, 29, 23]);
        let space = UnitSpace::of_box(origin, dims.map(|d| d as u32));
        let gaussians = spread(60);
        let sum = gaussian_sum(&gaussians, &space, origin, dims);
        let truth = brute(&gaussians, &space, origin, dims);
        // A term: three exponentials of 2 units each, u rounded to f32 (|d exp(-u^2)| <= 2 u^2 exp(-u^2) 2^-24 < 2^-24),
        // three products; then a sum of up to 60 terms, here below 4. A voxel exactly at the cut may differ by exp(-9).
        let tolerance = 4.0 * (14.0 + 60.0) * 2f64.powi(-24);
        for (v, (s, t)) in sum.iter().zip(&truth).enumerate() {
            assert!((f64::from(*s) - t).abs() < tolerance, "voxel {v}: {s} {t}");
        }
        assert!(truth.iter().any(|&t| t > 0.5), "the box must not be empty");
        // The checker sees a wrong weight of one part in a thousand.
        let mut wrong = gaussians.clone();
        wrong.iter_mut().for_each(|g| g.weight *= 1.001);
        let wrong = gaussian_sum(&wrong, &space, origin, dims);
        assert!(wrong.iter().zip(&truth).any(|(s, t)| (f64::from(*s) - t).abs() >= tolerance));
    }

    #[test]
    fn boxes_of_any_origin_give_the_same_bits() {
        let space = UnitSpace::of_box([0; 3], [64; 3]);
        let gaussians = spread(40);
        let whole = gaussian_sum(&gaussians, &space, [0; 3], [64; 3]);
        let (origin, dims) = ([5, 9, 11], [33, 21, 17]);
        let part = gaussian_sum(&gaussians, &space, origin, dims);
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let w = whole[(i + 5) + 64 * ((j + 9) + 64 * (k + 11))];
                    let p = part[i + dims[0] * (j + dims[1] * k)];
                    assert_eq!(w.to_bits(), p.to_bits());
                }
            }
        }
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let space = UnitSpace::of_box([0; 3], [50; 3]);
        let gaussians = spread(80);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| gaussian_sum(&gaussians, &space, [0; 3], [50; 3]))
        };
        assert_eq!(run(1), run(5));
    }

    #[test]
    fn moments_equal_the_definition() {
        let lattice = Lattice { space: UnitSpace::of_box([0; 3], [70, 30, 30]), origin: [0; 3], dims: [70, 30, 30] };
        let mut field = vec![[0.0f32; LANES]; lattice.slice_blocks() * 30];
        // Values in the padding must not be seen.
        field
            .as_flattened_mut()
            .iter_mut()
            .enumerate()
            .for_each(|(i, v)| *v = ((i * 7919) % 1000) as f32 / 500.0 - 1.0);
        for g in
            [gaussian([0.5, 0.2, 0.2], 0.09, 1.0), gaussian([0.97, 0.4, 0.1], 0.05, 1.0), gaussian([0.0; 3], 0.3, 1.0)]
        {
            let mut kernel = Kernel::default();
            kernel.place(&lattice, g.center.map(f64::from), f64::from(g.radius));
            let found = moments(&kernel, &field, &lattice);
            let (mut truth, mut magnitude) = (Moments::default(), 0.0);
            for (row, values) in field.chunks(lattice.row_blocks()).enumerate() {
                let (j, k) = (row % 30, row / 30);
                for (i, &e) in values.as_flattened()[..70].iter().enumerate() {
                    let u: [f64; 3] = std::array::from_fn(|a| {
                        let x = lattice.space.offset[a] + lattice.space.scale * [i, j, k][a] as f64;
                        (x - f64::from(g.center[a])) / f64::from(g.radius)
                    });
                    let [x, y, z] = u.map(|u| u * u);
                    if x < 9.0 && y + z < 9.0 {
                        let eb = f64::from(e) * (-x - y - z).exp();
                        truth.zeroth += eb;
                        (0..3).for_each(|a| truth.first[a] += eb * u[a]);
                        truth.second += eb * (x + y + z);
                        magnitude += eb.abs();
                    }
                }
            }
            // Sums of at most 60 rows and slices in f32; |u|^2 exp(-|u|^2) adds at most a factor 3 on average.
            let tolerance = 3.0 * 120.0 * 2f64.powi(-24) * magnitude;
            let pairs = [(found.zeroth, truth.zeroth), (found.second, truth.second)];
            let pairs = pairs.into_iter().chain((0..3).map(|a| (found.first[a], truth.first[a])));
            pairs.for_each(|(f, t)| assert!((f - t).abs() < tolerance, "{f} {t}"));
        }
    }

    #[test]
    fn an_empty_box_no_gaussians_and_far_centres_give_zeros() {
        let space = UnitSpace::of_box([0; 3], [4; 3]);
        assert!(gaussian_sum(&spread(3), &space, [0; 3], [0, 4, 4]).is_empty());
        assert_eq!(gaussian_sum(&[], &space, [0; 3], [4; 3]), vec![0.0; 64]);
        let far = [gaussian([1e30, 0.5, 0.5], 0.09, 1.0), gaussian([0.5, -1e30, 0.5], 0.09, 1.0)];
        assert_eq!(gaussian_sum(&far, &space, [0; 3], [4; 3]), vec![0.0; 64]);
    }

    #[test]
    fn a_single_voxel_at_a_centre_gets_the_weight_exactly() {
        let space = UnitSpace::of_box([3; 3], [1; 3]);
        assert_eq!(gaussian_sum(&[gaussian([0.5; 3], 0.015, 0.75)], &space, [3; 3], [1; 3]), vec![0.75]);
    }
}
