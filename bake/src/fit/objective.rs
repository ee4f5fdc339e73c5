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
/// than the diagonal says, so centres and radii get [`CENTRE_UNIT`] and [`RADIUS_UNIT`] times their diagonal's unit.
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

/// Measured, with [`RADIUS_UNIT`] and [`LEAST_WEIGHT`]: docs/decisions/fit-optimiser.md.
const CENTRE_UNIT: f64 = 3.0;
/// See [`CENTRE_UNIT`].
const RADIUS_UNIT: f64 = 2.0;
/// A weight below this is taken for this: the units of a vanishing Gaussian's centre would be too large to be of use.
const LEAST_WEIGHT: f64 = 0.1;

#[cfg(test)]
mod tests {
    use super::*;
    use smoke_formats::gaussian::Gaussian;
    use smoke_formats::volume::VoxelMask;
    use smoke_runtime::medium::gaussian_sum::gaussian_sum;

    fn grid(dims: [usize; 3], value: impl Fn([usize; 3]) -> f32) -> (DensityGrid, UnitSpace) {
        let [nx, ny, nz] = dims;
        let values: Vec<f32> = (0..nx * ny * nz).map(|v| value([v % nx, v / nx % ny, v / (nx * ny)])).collect();
        let (active, origin) = (VoxelMask::new(values.len()), [-3, 5, 9]);
        let space = UnitSpace::of_box(origin, dims.map(|d| d as u32));
        let name = "density".to_owned();
        (DensityGrid { name, origin, dims, values, active, world_from_index: Default::default() }, space)
    }

    /// A blob with ripples and empty corners, peak 40.
    fn blob() -> (DensityGrid, UnitSpace) {
        grid([40, 30, 20], |[i, j, k]| {
            let r2 = (i as f32 - 20.0).powi(2) + (j as f32 - 15.0).powi(2) + (k as f32 - 10.0).powi(2);
            (40.0 * (-r2 / 80.0).exp() * (1.0 + 0.2 * (i as f32).sin()) - 1.0).max(0.0)
        })
    }

    /// Gaussians inside, outside, at both bounds of radius and weight.
    fn variables() -> Vec<f64> {
        let mut x = vec![
            [0.5, 0.4, 0.25, 0.09, 1.0],
            [0.45, 0.36, 0.2, 0.015, 0.5],
            [0.52, 0.31, 0.27, 0.04, 0.01],
            [-0.05, 0.4, 0.25, 0.08, 0.3],
            [0.3, 0.76, 0.25, 0.05, 0.7],
            [0.501, 0.401, 0.251, 0.085, 0.4],
        ];
        x.extend((0..8).map(|i| {
            let t = f64::from(i);
            [0.5 + 0.1 * t.sin(), 0.37 + 0.1 * (2.0 * t).cos(), 0.25 + 0.05 * t.cos(), 0.02 + 0.008 * t, 0.1 + 0.1 * t]
        }));
        x.concat()
    }

    /// The definition, in f64, with the f32 sums of the decoder.
    fn brute(x: &[f64], grid: &DensityGrid, space: &UnitSpace, support: bool) -> f64 {
        let peak = grid.values.iter().copied().fold(0.0f32, f32::max);
        let gaussians: Vec<Gaussian> = x
            .chunks(5)
            .map(|g| {
                let [cx, cy, cz, radius, weight] = [g[0], g[1], g[2], g[3], g[4]].map(|v| v as f32);
                Gaussian { center: [cx, cy, cz], radius, weight }
            })
            .collect();
        let sum = gaussian_sum(&gaussians, space, grid.origin, grid.dims);
        let pairs = sum.iter().zip(&grid.values).map(|(s, d)| (f64::from(*s), f64::from(d / peak)));
        let error: f64 = pairs.clone().filter(|(_, d)| !support || *d > 0.0).map(|(s, d)| (s - d) * (s - d)).sum();
        error / pairs.map(|(_, d)| d * d).sum::<f64>()
    }

    #[test]
    fn the_cost_equals_its_definition_with_the_decoders_sum_in_both_scopes() {
        let (grid, space) = blob();
        // Variables that f32 holds exactly, so that both see the same Gaussians.
        let x: Vec<f64> = variables().iter().map(|&v| f64::from(v as f32)).collect();
        let mut costs = Vec::new();
        for (scope, support) in [(Scope::Box, false), (Scope::Support, true)] {
            let objective = Objective::new(&grid, &space, scope).unwrap();
            let cost = objective.cost_gradient(&x, &mut vec![0.0; x.len()]);
            let truth = brute(&x, &grid, &space, support);
            // The differences are rounded to f32 here and not there: 2^-24 each, twice that in the square.
            assert!((cost - truth).abs() < 2f64.powi(-23) * truth, "{scope:?}: {cost} {truth}");
            costs.push(cost);
        }
        assert!(costs[1] < costs[0], "the kernels must reach outside the support");
    }

    /// Failures of the gradient against central differences, as a table.
    fn failures(gradient: &[f64], x: &[f64], objective: &Objective) -> Vec<String> {
        let scale = gradient.iter().map(|g| g.abs()).sum::<f64>() / gradient.len() as f64;
        let mut none = vec![0.0; x.len()];
        let mut check = |k: usize| {
            // The step balances the third derivative, up to 300 / r^2 of the first, against f32 rounding of the field.
            let h = if k % VARIABLES == 4 { 1e-3 } else { 3e-3 * x[k - k % VARIABLES + 3] };
            let mut at = |d: f64| {
                let mut x = x.to_vec();
                x[k] += d;
                objective.cost_gradient(&x, &mut none)
            };
            let difference = (at(h) - at(-h)) / (2.0 * h);
            // Truncation: h^2 / 6 times the third derivative is up to 1e-5 / 6 * 300 = 5e-4 of the entry itself. The
            // cut's border moves with the radius: for a constant e its share of dE/dr is 3 exp(-9) 40 r^2 (area weighted
            // with B) over 3 pi^(3/2) r^2 = 9e-4, and more where e has the other sign there: 1e-2, and of the mean entry.
            let tolerance = 1e-2 * difference.abs() + 1e-2 * scale;
            let wrong = !((gradient[k] - difference).abs() <= tolerance);
            wrong.then(|| format!("variable {k}: gradient {:e}, difference {difference:e}", gradient[k]))
        };
        (0..x.len()).filter_map(&mut check).collect()
    }

    #[test]
    fn the_gradient_agrees_with_central_differences_and_a_wrong_one_does_not() {
        let (grid, space) = blob();
        for scope in [Scope::Box, Scope::Support] {
            let objective = Objective::new(&grid, &space, scope).unwrap();
            let x = variables();
            let mut gradient = vec![0.0; x.len()];
            objective.cost_gradient(&x, &mut gradient);
            let wrong = failures(&gradient, &x, &objective);
            assert!(wrong.is_empty(), "{scope:?}\n{}", wrong.join("\n"));
            // A planted defect: the radius' derivative without its factor of two.
            gradient.iter_mut().skip(3).step_by(VARIABLES).for_each(|g| *g *= 0.5);
            assert!(failures(&gradient, &x, &objective).len() >= 5);
        }
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let (grid, space) = blob();
        let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
        let x = variables();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut gradient = vec![0.0; x.len()];
            let cost = pool.install(|| objective.cost_gradient(&x, &mut gradient));
            (cost, gradient)
        };
        assert_eq!(run(1), run(7));
    }

    #[test]
    fn the_scale_of_the_density_does_not_matter() {
        let (grid, space) = blob();
        let x = variables();
        let cost = |factor: f32| {
            let values = grid.values.iter().map(|v| v * factor).collect();
            let scaled = DensityGrid { values, ..grid.clone() };
            Objective::new(&scaled, &space, Scope::Box).unwrap().cost_gradient(&x, &mut vec![0.0; x.len()])
        };
        // Powers of two: the same bits.
        assert_eq!(cost(1.0), cost(2f32.powi(100)));
        assert_eq!(cost(1.0), cost(2f32.powi(-100)));
    }

    #[test]
    fn an_empty_grid_has_no_objective_and_a_variable_that_is_not_a_number_gives_no_cost() {
        let (empty, space) = grid([3, 3, 3], |_| 0.0);
        assert!(Objective::new(&empty, &space, Scope::Box).is_none());
        let (grid, space) = blob();
        let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
        let mut x = variables();
        x[7] = f64::NAN;
        assert!(objective.cost_gradient(&x, &mut vec![0.0; x.len()]).is_nan());
    }

    #[test]
    fn gain_and_loss_are_what_the_objective_does() {
        let (grid, space) = blob();
        let objective = Objective::new(&grid, &space, Scope::Box).unwrap();
        let mut x = variables();
        let errors = objective.errors(&x);
        let (centre, radius) = ([0.62, 0.42, 0.27], 0.05);
        let (weight, gain) = errors.gain(centre, radius);
        assert!(weight > 0.05, "{weight}");
        x.extend([centre[0], centre[1], centre[2], radius, weight]);
        let after = objective.errors(&x);
        // The integral stands for the sum over voxels to 1e-6 at two voxels a radius; the cut takes exp(-18).
        assert!((errors.cost - after.cost - gain).abs() < 1e-4 * gain, "{} {gain}", errors.cost - after.cost);
        assert!((after.loss(radius, weight) - gain).abs() < 1e-4 * gain);
    }
}
