//! A frame of a pack to its density: THE decoder. The march sees what this gives, and the bake takes its residual
//! against the same sum and the same arithmetic, so the promised error holds for what is rendered.
//!
//! `D = max(0, sum of Gaussians + step * code)` on the support, exactly zero elsewhere (Zhou et al. 2008, section 5.1,
//! with the support kept: the paper lets kernel tails glow outside the smoke).
//! Cost: the Gaussian sum, and one pass over the voxels.

use super::field::DensityField;
use super::gaussian_sum::gaussian_sum;
use glam::DAffine3;
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::residual::{ResidualCodes, dequantise};

/// Density of every voxel of the residual's box, x fastest.
pub fn decode(gaussians: &[Gaussian], residual: &ResidualCodes, step: f32, space: &UnitSpace) -> Vec<f32> {
    let dims = residual.dims.map(|d| d as usize);
    let sum = gaussian_sum(gaussians, space, residual.origin, dims);
    let mut density = vec![0.0; sum.len()];
    for (v, &code) in residual.support.iter_set().zip(&residual.codes) {
        density[v] = dequantise(sum[v], code, step);
    }
    density
}

/// Density of every voxel of a frame's box by the Gaussians alone, x fastest.
///
/// The support is stored with the residual and unknown here. Tails that the kernels let out of the smoke are bounded by
/// the frame's box, which is that of the support, and by half a step: a sum below that counts as no density, as it may
/// for the residual.
pub fn decode_gaussians(
    gaussians: &[Gaussian],
    origin: [i32; 3],
    dims: [u32; 3],
    step: f32,
    space: &UnitSpace,
) -> Vec<f32> {
    let mut density = gaussian_sum(gaussians, space, origin, dims.map(|d| d as usize));
    density.iter_mut().for_each(|d| *d = if *d >= 0.5 * step { *d } else { 0.0 });
    density
}

/// The same as a field in the world, ready for transport and march.
pub fn decode_field(
    gaussians: &[Gaussian],
    residual: &ResidualCodes,
    step: f32,
    space: &UnitSpace,
    world_from_index: DAffine3,
) -> DensityField {
    let density = decode(gaussians, residual, step, space);
    DensityField::from_box(residual.origin, residual.dims.map(|d| d as usize), &density, world_from_index)
}

#[cfg(test)]
mod tests {
    use super::*;
    use smoke_formats::volume::VoxelMask;

    #[test]
    fn the_gaussians_alone_are_their_sum_down_to_half_a_step() {
        let space = UnitSpace::of_box([10, 0, -4], [3; 3]);
        let gaussian = Gaussian { center: [0.5; 3], radius: 0.4, weight: 0.5 };
        let sum = gaussian_sum(&[gaussian], &space, [10, 0, -4], [3; 3]);
        // Half a step between the corners, 0.5 exp(-(1/3) / 0.16) = 0.062, and the edges, 0.125.
        let density = decode_gaussians(&[gaussian], [10, 0, -4], [3; 3], 0.2, &space);
        for (v, (found, sum)) in density.iter().zip(&sum).enumerate() {
            let is_corner = [v % 3, v / 3 % 3, v / 9].iter().all(|&i| i != 1);
            assert_eq!(*found, if is_corner { 0.0 } else { *sum }, "voxel {v}");
        }
        assert!(sum.iter().all(|&s| s > 0.0) && density.iter().filter(|&&d| d == 0.0).count() == 8);
        assert!(decode_gaussians(&[gaussian], [0; 3], [0; 3], 0.2, &space).is_empty());
    }

    #[test]
    fn density_is_sum_plus_steps_on_the_support_and_zero_elsewhere() {
        let mut support = VoxelMask::new(27);
        [4, 13, 26].iter().for_each(|&v| support.set(v));
        let residual = ResidualCodes { origin: [10, 0, -4], dims: [3; 3], support, codes: vec![2, -1, -100] };
        let space = UnitSpace::of_box([10, 0, -4], [3; 3]);
        let gaussian = Gaussian { center: [0.5; 3], radius: 0.4, weight: 0.5 };
        let density = decode(&[gaussian], &residual, 0.1, &space);
        // The middle voxel is at the centre of the Gaussian.
        assert!((density[13] - 0.4).abs() < 1e-6);
        let off = 0.5 * (-(1.0f32 / 9.0) / 0.16).exp();
        assert!((density[4] - (off + 0.2)).abs() < 1e-6);
        assert_eq!(density[26], 0.0);
        assert_eq!(density.iter().filter(|&&d| d != 0.0).count(), 2);
        let field = decode_field(&[gaussian], &residual, 0.1, &space, DAffine3::IDENTITY);
        assert_eq!(field.sample(glam::Vec3::splat(2.0)), density[13]);
    }
}
