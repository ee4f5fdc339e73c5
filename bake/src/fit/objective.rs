//! What the fit minimises: `E = sum_v m_v (S_v - D_v)^2 / sum_v D_v^2` over the voxels v of a frame's box.
//!
//! S is the Gaussian sum as the decoder evaluates it ([`gaussian_sum`](smoke_runtime::medium::gaussian_sum)), D the
//! density, and `m` is 1 on all voxels, or zero off the support ([`Scope`]). The variables are, per Gaussian, centre,
//! radius and weight; lengths in unit space, weights in units of the largest density. With `e = S - D` and
//! `u = (x - c) / r` (Zhou et al. 2008, section 5.1):
//!
//! `dE/dw = 2 sum e B`, `dE/dc = (4 w / r) sum e B u`, `dE/dr = (4 w / r) sum e B |u|^2`, over `sum D^2`.
//!
//! One pass: tables, forward sum by slabs of z (1 multiply-add a voxel of support), backward sums by Gaussian (3).
//! Fields are f32, variables and sums over slabs f64. The same bits at any number of threads.

use super::lbfgsb::CostGradient;
use rayon::prelude::*;
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::volume::DensityGrid;
use smoke_runtime::medium::gaussian_sum::{Block, Kernel, LANES, Lattice, SLAB, add_slab, moments};
use std::sync::{Mutex, PoisonError};

/// Variables of a Gaussian: centre x, y, z, radius, weight.
pub const VARIABLES: usize = 5;

/// Which voxels count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Scope {
    /// All voxels of the frame's box.
    #[default]
    Box,
    /// The active voxels and those that hold density; the decoder is zero elsewhere.
    Support,
}

/// The objective of one frame. Costs two fields of f32 and the kernels' tables.
pub struct Objective {
    lattice: Lattice,
    /// The density over its maximum, rows padded with zeros to whole blocks.
    density: Vec<Block>,
    /// 1 where a voxel counts, else 0, same order; none if all count.
    mask: Option<Vec<Block>>,
    /// `sum D^2`, in squared units of the maximum.
    energy: f64,
    peak: f32,
    scratch: Mutex<Scratch>,
}

#[derive(Default)]
struct Scratch {
    kernels: Vec<Kernel>,
    error: Vec<Block>,
}

impl Objective {
    /// The objective of `grid`, or none where it holds no density at all. Values must be finite and not negative.
    pub fn new(grid: &DensityGrid, space: &UnitSpace, scope: Scope) -> Option<Self> {
        let lattice = Lattice { space: *space, origin: grid.origin, dims: grid.dims };
        let peak = grid.values.iter().copied().fold(0.0f32, f32::max);
        if !(peak > 0.0 && peak.is_finite()) {
            return None;
        }
        let blocks = lattice.slice_blocks() * grid.dims[2];
        let mut density = vec![[0.0; LANES]; blocks];
        let mut mask = (scope == Scope::Support).then(|| vec![[0.0; LANES]; blocks]);
        let width = lattice.row_blocks() * LANES;
        let mut energy = 0.0;
        for (row, values) in grid.values.chunks(grid.dims[0]).enumerate() {
            let target = &mut density.as_flattened_mut()[row * width..][..values.len()];
            let mut sum = 0.0;
            for (target, value) in target.iter_mut().zip(values) {
                // Division, not a product with the inverse: 1 / peak overflows for the smallest densities.
                *target = value / peak;
                sum += f64::from(*target) * f64::from(*target);
            }
            energy += sum;
            if let Some(mask) = &mut mask {
                let mask = &mut mask.as_flattened_mut()[row * width..][..values.len()];
                for (i, (mask, value)) in mask.iter_mut().zip(values).enumerate() {
                    *mask = f32::from(*value != 0.0 || grid.active.get(row * grid.dims[0] + i));
                }
            }
        }
        Some(Self { lattice, density, mask, energy, peak, scratch: Mutex::default() })
    }

    /// The largest density: the unit of the weights.
    pub fn peak(&self) -> f32 {
        self.peak
    }

    /// The box.
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// `E` of the whole box, whatever the scope, of some Gaussians.
    pub fn box_error(&self, x: &[f64]) -> f64 {
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        self.forward(x, &mut scratch, None) / self.energy
    }

    /// `e = S - D` on every voxel that counts, at some Gaussians. Costs the forward half of an evaluation.
    pub fn errors(&self, x: &[f64]) -> ErrorField<'_> {
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        let cost = self.forward(x, &mut scratch, self.mask.as_deref()) / self.energy;
        ErrorField { objective: self, field: scratch.error.clone(), cost }
    }

    /// Unit-space position of voxel `v` of the grid.
    pub fn position(&self, v: usize) -> [f64; 3] {
        let [nx, ny, _] = self.lattice.dims;
        let local = [v % nx, v / nx % ny, v / (nx * ny)];
        let space = &self.lattice.space;
        std::array::from_fn(|a| space.offset[a] + space.scale * (f64::from(self.lattice.origin[a]) + local[a] as f64))
    }

    /// Tables and `e = m (S - D)`; gives `sum e^2`.
    fn forward(&self, x: &[f64], scratch: &mut Scratch, mask: Option<&[Block]>) -> f64 {
        let (lattice, slice) = (&self.lattice, self.lattice.slice_blocks());
        scratch.kernels.resize_with(x.len() / VARIABLES, Kernel::default);
        scratch.error.resize(self.density.len(), [0.0; LANES]);
        let kernels = &mut scratch.kernels;
        kernels.par_iter_mut().with_min_len(32).zip(x.par_chunks(VARIABLES)).for_each(|(kernel, g)| {
            kernel.place(lattice, [g[0], g[1], g[2]], g[3]);
        });
        let weights: Vec<f32> = x.chunks(VARIABLES).map(|g| g[4] as f32).collect();
        let slabs = scratch.error.par_chunks_mut(SLAB * slice).zip(self.density.par_chunks(SLAB * slice));
        let sums: Vec<f64> = slabs
            .enumerate()
            .map(|(s, (error, density))| {
                error.fill([0.0; LANES]);
                add_slab(kernels, &weights, error, s * SLAB, lattice);
                let first = s * SLAB * slice;
                subtract(error, density, mask.map(|m| &m[first..first + density.len()]))
            })
            .collect();
        sums.iter().sum()
    }
}

/// The errors `e = S - D` of a set of Gaussians, in units of the peak.
pub struct ErrorField<'a> {
    objective: &'a Objective,
    field: Vec<Block>,
    /// The objective there.
    pub cost: f64,
}

impl ErrorField<'_> {
    /// Calls `visit` with every voxel's position in the grid, its error and its density, ascending.
    pub fn visit(&self, mut visit: impl FnMut(usize, f32, f32)) {
        let Lattice { dims: [nx, ..], .. } = self.objective.lattice;
        let width = self.objective.lattice.row_blocks();
        let rows = self.field.chunks(width).zip(self.objective.density.chunks(width));
        for (row, (error, density)) in rows.enumerate() {
            let pairs = error.as_flattened().iter().zip(density.as_flattened());
            pairs.take(nx).enumerate().for_each(|(i, (&e, &d))| visit(row * nx + i, e, d));
        }
    }

    /// The weight that a Gaussian put at `center` would best have, and by how much the objective would fall.
    ///
    /// `E(w) = sum (e + w B)^2` is least at `w = -sum e B / sum B^2`, lower by `(sum e B)^2 / sum B^2`.
    pub fn gain(&self, center: [f64; 3], radius: f64) -> (f64, f64) {
        let Objective { lattice, energy, .. } = self.objective;
        let mut kernel = Kernel::default();
        kernel.place(lattice, center, radius);
        let found = -moments(&kernel, &self.field, lattice).zeroth;
        let square = square_integral(radius, lattice.space.scale);
        (found / square, if found > 0.0 { found * found / square / energy } else { 0.0 })
    }

    /// By how much the objective would rise without a Gaussian of this radius and weight whose weight is at its best.
    pub fn loss(&self, radius: f64, weight: f64) -> f64 {
        weight * weight * square_integral(radius, self.objective.lattice.space.scale) / self.objective.energy
    }
}

/// `sum B^2` over all voxels of edge `h`, as the integral `(pi / 2)^(3/2) r^3 / h^3`.
fn square_integral(radius: f64, h: f64) -> f64 {
    std::f64::consts::FRAC_PI_2.powf(1.5) * (radius / h).powi(3)
}

/// `error = m (error - density)`; gives the sum of squares, f32 lanes within a block of 16 voxels, then f64.
#[multiversion::multiversion(targets(
    "x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma",
    "x86_64+avx2+fma",
    "aarch64+neon"
))]
fn subtract(error: &mut [Block], density: &[Block], mask: Option<&[Block]>) -> f64 {
    let mut sums = [0.0f64; LANES];
    for (b, (error, density)) in error.iter_mut().zip(density).enumerate() {
        for l in 0..LANES {
            error[l] -= density[l];
        }
        if let Some(mask) = mask {
            for l in 0..LANES {
                error[l] *= mask[b][l];
            }
        }
        for l in 0..LANES {
            let e = f64::from(error[l]);
            sums[l] += e * e;
        }
    }
    sums.iter().sum()
}

impl CostGradient for Objective {
    fn cost_gradient(&self, x: &[f64], gradient: &mut [f64]) -> f64 {
        if !x.iter().all(|x| x.is_finite()) {
            return f64::NAN;
        }
        let mut scratch = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        let cost = self.forward(x, &mut scratch, self.mask.as_deref());
        let Scratch { kernels, error } = &*scratch;
        let all = gradient.par_chunks_mut(VARIABLES).zip(x.par_chunks(VARIABLES)).zip(kernels).with_min_len(4);
        all.for_each(|((gradient, g), kernel)| {
            let m = moments(kernel, error, &self.lattice);
            let factor = 4.0 * g[4] / g[3] / self.energy;
            gradient[..3].copy_from_slice(&m.first.map(|m| factor * m));
            gradient[3] = factor * m.second;
            gradient[4] = 2.0 * m.zeroth / self.energy;
        });
        cost / self.energy
    }
}

/// Units in which the objective's curvature is about 1 along every variable, from its Gauss–Newton diagonal.
///
/// The sums over a Gaussian's voxels of squared derivatives are integrals of Gaussians: with
/// `I = (pi / 2)^(3/2) r^3 / voxel volume`, `sum (dS/dw)^2 = I`, `sum (dS/dc)^2 = w^2 I / r^2`,
/// `sum (dS/dr)^2 = (15 / 4) w^2 I / r^2`; times 2 over `sum D^2`. Neighbours overlap, which makes the weights stiffer
/// than the diagonal says, so centres and radii get 3 and 2 times their diagonal's unit.
pub fn natural_units(x: &[f64], objective: &Objective) -> Vec<f64> {
    let mut units = Vec::with_capacity(x.len());
    for g in x.chunks(VARIABLES) {
        let (r, w) = (g[3], g[4].max(LEAST_WEIGHT));
        let weight = (2.0 * square_integral(r, objective.lattice.space.scale) / objective.energy).sqrt().recip();
        let centre = CENTRE_UNIT * weight * r / w;
        units.extend([centre, centre, centre, RADIUS_UNIT * weight * r / w / 3.75f64.sqrt(), weight]);
    }
    units
}

/// Of the diagonal's. Measured, with [`RADIUS_UNIT`] and [`LEAST_WEIGHT`]: docs/decisions/022-fit-optimiser.md.
const CENTRE_UNIT: f64 = 3.0;
/// See `CENTRE_UNIT`.
const RADIUS_UNIT: f64 = 2.0;
/// A weight below this is taken for this: the units of a vanishing Gaussian's centre would be too large to be of use.
const LEAST_WEIGHT: f64 = 0.1;

#[cfg(test)]
mod tests;
