//! How thick a frame's medium is, and what it is made of.
//!
//! Optical depth `tau = sigma_t int D ds` along *parallel rays*: one through every column of nodes along each of the three
//! axes of the grid. Between nodes the density is trilinear and on a column linear, so that a column's integral is the sum
//! of its nodes times their distance, exactly. Rays that meet no density are not counted; the others count by their
//! cross-section. The figures belong to the medium alone, not to the camera: multiple scattering comes from the whole
//! cloud, also where the camera looks at its edge, and a camera that moves does not change the plan.
//! Cost: one pass over the nodes for each axis.

use crate::medium::field::DensityField;
use crate::medium::frame::Frame;
use crate::transport::compensated::centres::source::UnitPlacement;
use crate::transport::compensated::grid::channels::is_single_channel;
use crate::transport::compensated::grid::route::{multiple_step, single_step};
use crate::transport::medium::MediumParameters;

/// What a frame's Gaussians are like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GaussianSurvey {
    /// How many.
    pub count: usize,
    /// Mean radius (of `exp(-r^2 / radius^2)`), world units; by the geometric mean of the axes' scales.
    pub mean_radius: f64,
}

/// The figures of one frame's medium.
#[derive(Clone, Debug, PartialEq)]
pub struct MediumSurvey {
    /// The medium's parameters.
    pub parameters: MediumParameters,
    /// Nodes along x, y, z, the empty border included.
    pub dims: [usize; 3],
    /// Voxels with density.
    pub voxels: u64,
    /// Smallest density above zero, mean over the voxels with density, largest; zero in an empty frame.
    pub density: [f64; 3],
    /// Integral of the density, density unit x world volume.
    pub mass: f64,
    /// Side of a voxel, world units: the geometric mean of the three.
    pub voxel: f64,
    /// Integral of the density along a ray, mean over the rays that meet density; density unit x world units.
    pub column_mean: f64,
    /// The same, 95th percentile.
    pub column_p95: f64,
    /// Its Gaussians, if it has any.
    pub gaussians: Option<GaussianSurvey>,
    /// True if voxels have one size along all axes and right angles: the route through centres needs that.
    pub uniform: bool,
    /// Voxels between nodes that the grid route would choose, for single and for multiple scattering.
    pub steps: [usize; 2],
}

impl MediumSurvey {
    /// The figures of `frame` with the medium `parameters`.
    pub fn of(frame: &Frame, parameters: &MediumParameters) -> Self {
        let field = &frame.field;
        let sides = [0, 1, 2].map(|a| field.world_from_node.matrix3.col(a).length());
        let volume = field.world_from_node.matrix3.determinant().abs();
        let (mut voxels, mut sum, mut least) = (0u64, 0.0f64, f64::INFINITY);
        for &d in field.values.iter().filter(|&&d| d > 0.0) {
            voxels += 1;
            sum += f64::from(d);
            least = least.min(f64::from(d));
        }
        let density = if voxels == 0 { [0.0; 3] } else { [least, sum / voxels as f64, f64::from(field.max())] };
        let (column_mean, column_p95) = mean_and_p95(columns(field, sides));
        let world_from_unit = frame.world_from_unit().matrix3.determinant().abs().cbrt();
        let radii = frame.gaussians.iter().map(|g| f64::from(g.radius)).sum::<f64>();
        let count = frame.gaussians.len();
        let gaussians =
            (count > 0).then(|| GaussianSurvey { count, mean_radius: radii / count as f64 * world_from_unit });
        let thickest = parameters.sigma_t.into_iter().fold(0.0, f32::max);
        Self {
            parameters: *parameters,
            dims: field.dims,
            voxels,
            density,
            mass: sum * volume,
            voxel: volume.cbrt(),
            column_mean,
            column_p95,
            gaussians,
            uniform: UnitPlacement::of(frame).is_some(),
            steps: [single_step(field), multiple_step(field, thickest)],
        }
    }

    /// Optical depth of a ray, mean over the rays that meet density; per channel.
    pub fn depth_mean(&self) -> [f64; 3] {
        self.parameters.sigma_t.map(|s| f64::from(s) * self.column_mean)
    }

    /// Optical depth of a ray, 95th percentile of those that meet density; per channel.
    pub fn depth_p95(&self) -> [f64; 3] {
        self.parameters.sigma_t.map(|s| f64::from(s) * self.column_p95)
    }

    /// Mean free path at the mean density, world units, per channel; infinite where nothing is extinguished.
    pub fn mean_free_path(&self) -> [f64; 3] {
        self.parameters.sigma_t.map(|s| 1.0 / (f64::from(s) * self.density[1]))
    }

    /// True if extinction and albedo are the same in all three channels.
    pub fn is_grey(&self) -> bool {
        is_single_channel(&self.parameters, &[])
    }
}

/// Integral of the density along every column of nodes that has any, with the column's cross-section.
fn columns(field: &DensityField, sides: [f64; 3]) -> Vec<(f64, f64)> {
    let [nx, ny, nz] = field.dims;
    let mut along_y = vec![0.0f64; nx * nz];
    let mut along_z = vec![0.0f64; nx * ny];
    let mut out = Vec::new();
    let area = [sides[1] * sides[2], sides[0] * sides[2], sides[0] * sides[1]];
    for (row, values) in field.values.chunks_exact(nx.max(1)).enumerate() {
        let (j, k) = (row % ny, row / ny);
        let mut along_x = 0.0;
        for (i, &d) in values.iter().enumerate() {
            let d = f64::from(d);
            along_x += d;
            along_y[i + nx * k] += d;
            along_z[i + nx * j] += d;
        }
        out.push((along_x * sides[0], area[0]));
    }
    out.extend(along_y.iter().map(|sum| (sum * sides[1], area[1])));
    out.extend(along_z.iter().map(|sum| (sum * sides[2], area[2])));
    out.retain(|(depth, _)| *depth > 0.0);
    out
}

/// Mean and 95th percentile of values with weights; zero without any.
fn mean_and_p95(mut values: Vec<(f64, f64)>) -> (f64, f64) {
    values.sort_by(|a, b| a.0.total_cmp(&b.0));
    let weight: f64 = values.iter().map(|v| v.1).sum();
    let mean = values.iter().map(|v| v.0 * v.1).sum::<f64>();
    let mut below = 0.0;
    let p95 = values.iter().find(|v| {
        below += v.1;
        below >= 0.95 * weight
    });
    p95.map_or((0.0, 0.0), |p| (mean / weight, p.0))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};
    use smoke_formats::gaussian::{Gaussian, UnitSpace};

    /// A frame without Gaussians: a box of voxels of side `voxel`, each axis stretched by `stretch`.
    pub(crate) fn frame(dims: [usize; 3], values: &[f32], voxel: f64, stretch: [f64; 3]) -> Frame {
        let map = DAffine3::from_scale(DVec3::from_array(stretch) * voxel);
        Frame {
            field: DensityField::from_box([0; 3], dims, values, map),
            gaussians: vec![],
            unit: UnitSpace::of_box([0; 3], dims.map(|d| d as u32)),
            first_node: [-1; 3],
            world_from_index: map,
            transfer: None,
        }
    }

    pub(crate) fn grey(sigma_t: f32, albedo: f32, g: f32) -> MediumParameters {
        MediumParameters { sigma_t: [sigma_t; 3], albedo: [albedo; 3], g }
    }

    /// A ball of density 1 and the given radius in voxels.
    pub(crate) fn ball(radius: f64, voxel: f64) -> Frame {
        let n = 2 * radius.ceil() as usize + 3;
        let c = (n - 1) as f64 / 2.0;
        let inside = |v: usize| {
            let p = DVec3::new((v % n) as f64, (v / n % n) as f64, (v / n / n) as f64) - c;
            if p.length() <= radius { 1.0 } else { 0.0 }
        };
        frame([n; 3], &(0..n * n * n).map(inside).collect::<Vec<f32>>(), voxel, [1.0; 3])
    }

    #[test]
    fn a_slab_has_the_depths_of_its_three_sides_and_the_right_mean_free_path() {
        // 20 x 10 x 5 voxels of density 2, side 0.1: columns of 4, 2 and 1 by 50, 100 and 200 rays.
        let survey = MediumSurvey::of(&frame([20, 10, 5], &[2.0; 1000], 0.1, [1.0; 3]), &grey(3.0, 0.9, 0.0));
        let near = |a: f64, b: f64| assert!((a / b - 1.0).abs() < 1e-6, "{a} {b}");
        near(survey.column_mean, (50.0 * 4.0 + 100.0 * 2.0 + 200.0 * 1.0) / 350.0);
        // 95 % of 350 rays is 332.5: among the 50 of depth 4.
        near(survey.depth_p95()[1], 12.0);
        near(survey.mean_free_path()[0], 1.0 / 6.0);
        near(survey.mass, 2.0);
        assert_eq!((survey.voxels, survey.density, survey.gaussians), (1000, [2.0; 3], None));
        assert!(survey.uniform && survey.is_grey());
    }

    #[test]
    fn a_ball_has_the_mean_chord_of_cauchy() {
        // Mean chord 4/3 r over its cross-section; its 95th percentile 2 r sqrt(1 - 0.05). A voxel ball of radius 20
        // has the true volume to 1e-2 and rim rays that are half in: 3 %.
        let survey = MediumSurvey::of(&ball(20.0, 0.05), &grey(1.0, 1.0, 0.0));
        assert!((survey.column_mean / (4.0 / 3.0) - 1.0).abs() < 0.03, "{}", survey.column_mean);
        assert!((survey.column_p95 / (2.0 * 0.95f64.sqrt()) - 1.0).abs() < 0.03, "{}", survey.column_p95);
    }

    #[test]
    fn stretched_voxels_keep_the_mass_and_weigh_rays_by_their_cross_section() {
        let survey = MediumSurvey::of(&frame([4, 4, 4], &[1.0; 64], 1.0, [1.0, 1.0, 8.0]), &grey(1.0, 1.0, 0.0));
        assert!(!survey.uniform);
        assert_eq!(survey.mass, 512.0);
        // Each axis has area x depth = volume; areas 128, 128 and 16.
        assert!((survey.column_mean - 3.0 * 512.0 / 272.0).abs() < 1e-9);
    }

    #[test]
    fn radii_are_in_world_units_and_an_empty_frame_has_no_depth() {
        let mut some = frame([10, 10, 10], &[1.0; 1000], 0.2, [1.0; 3]);
        some.gaussians = vec![Gaussian { center: [0.5; 3], radius: 0.25, weight: 1.0 }; 3];
        let survey = MediumSurvey::of(&some, &grey(1.0, 1.0, 0.0));
        // The unit cube is the box: 10 voxels of 0.2.
        let gaussians = survey.gaussians.unwrap();
        assert!(gaussians.count == 3 && (gaussians.mean_radius - 0.5).abs() < 1e-6);
        let empty = MediumSurvey::of(&frame([0; 3], &[], 0.2, [1.0; 3]), &grey(1.0, 1.0, 0.0));
        assert_eq!((empty.voxels, empty.column_mean, empty.column_p95, empty.mass), (0, 0.0, 0.0, 0.0));
        assert_eq!(empty.mean_free_path(), [f64::INFINITY; 3]);
    }
}
