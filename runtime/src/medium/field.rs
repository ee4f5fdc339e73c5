//! The density of one frame on a dense box of voxels, with a border of empty ones.
//!
//! Positions are in *node space*: node (0, 0, 0) is the first voxel of the border, so the frame's own voxels are nodes
//! 1 ..= n along each axis. A voxel's value sits at its node; between nodes the density is trilinear, and it is zero on
//! the border and beyond (OpenVDB's BoxSampler over a background of zero).

use glam::{DAffine3, DVec3, Vec3};

/// Density of one frame, with its place in the world.
#[derive(Clone, Debug)]
pub struct DensityField {
    /// Nodes along x, y, z, the border of one empty node on every side included; at least 2.
    pub dims: [usize; 3],
    /// One value a node, x fastest: `values[i + nx * (j + ny * k)]`; finite, >= 0, zero on the border.
    pub values: Vec<f32>,
    /// Node to world space.
    pub world_from_node: DAffine3,
}

impl DensityField {
    /// A field from the values of a box of voxels (x fastest) whose first voxel has index coordinates `origin`.
    pub fn from_box(origin: [i32; 3], dims: [usize; 3], values: &[f32], world_from_index: DAffine3) -> Self {
        let padded = dims.map(|n| n + 2);
        let mut out = vec![0.0; padded.iter().product()];
        for (row, source) in values.chunks_exact(dims[0].max(1)).enumerate() {
            let (j, k) = (row % dims[1] + 1, row / dims[1] + 1);
            let start = 1 + padded[0] * (j + padded[1] * k);
            out[start..start + dims[0]].copy_from_slice(source);
        }
        let first = DVec3::from_array(origin.map(|o| f64::from(o) - 1.0));
        let world_from_node = world_from_index * DAffine3::from_translation(first);
        Self { dims: padded, values: out, world_from_node }
    }

    /// Largest density, zero if there is none.
    pub fn max(&self) -> f32 {
        self.values.iter().copied().fold(0.0, f32::max)
    }

    /// Trilinear density at a position in node space; zero outside.
    pub fn sample(&self, p: Vec3) -> f32 {
        let mut base = [0; 3];
        let mut fraction = [0.0; 3];
        for a in 0..3 {
            if !(p[a] >= 0.0 && p[a] <= (self.dims[a] - 1) as f32) {
                return 0.0;
            }
            base[a] = (p[a] as usize).min(self.dims[a] - 2);
            fraction[a] = p[a] - base[a] as f32;
        }
        let [nx, ny, _] = self.dims;
        let at = |i: usize, j: usize, k: usize| self.values[base[0] + i + nx * (base[1] + j + ny * (base[2] + k))];
        let lerp = |a: f32, b: f32, f: f32| a + (b - a) * f;
        let row = |j, k| lerp(at(0, j, k), at(1, j, k), fraction[0]);
        let slice = |k| lerp(row(0, k), row(1, k), fraction[1]);
        lerp(slice(0), slice(1), fraction[2])
    }

    /// The same medium on nodes `step` times as far apart along each axis: each coarse node holds the mean of the
    /// density weighted by a tent of half-width `step` (so that trilinear mass is kept). `step = 1` is a copy.
    pub fn coarsened(&self, step: usize) -> Self {
        if step <= 1 {
            return self.clone();
        }
        let mut values = self.values.clone();
        let mut dims = self.dims;
        for axis in 0..3 {
            (values, dims) = coarsen_axis(&values, dims, axis, step);
        }
        // Coarse node 0 lies `step` fine nodes before fine node 0 (see `coarsen_axis`).
        let s = step as f64;
        let node_from_coarse =
            DAffine3::from_scale_rotation_translation(DVec3::splat(s), glam::DQuat::IDENTITY, DVec3::splat(-s));
        Self { dims, values, world_from_node: self.world_from_node * node_from_coarse }
    }
}

/// Tent-filtered decimation along one axis: coarse node c sits at fine position `(c - 1) * step`.
fn coarsen_axis(values: &[f32], dims: [usize; 3], axis: usize, step: usize) -> (Vec<f32>, [usize; 3]) {
    let n = dims[axis];
    let coarse = (n - 1).div_ceil(step) + 3;
    let mut out_dims = dims;
    out_dims[axis] = coarse;
    let stride: usize = dims[..axis].iter().product();
    let outer: usize = dims[axis + 1..].iter().product();
    let mut out = vec![0.0; out_dims.iter().product()];
    for o in 0..outer {
        for c in 0..coarse {
            let target = &mut out[(o * coarse + c) * stride..][..stride];
            let centre = (c as isize - 1) * step as isize;
            for offset in -(step as isize) + 1..step as isize {
                let fine = centre + offset;
                if fine < 0 || fine >= n as isize {
                    continue;
                }
                let weight = (step as isize - offset.abs()) as f32 / (step * step) as f32;
                let source = &values[(o * n + fine as usize) * stride..][..stride];
                target.iter_mut().zip(source).for_each(|(t, s)| *t += weight * s);
            }
        }
    }
    (out, out_dims)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> DensityField {
        let values: Vec<f32> = (0..4 * 5 * 6).map(|v| 1.0 + (v % 7) as f32).collect();
        DensityField::from_box([-3, 7, 2], [4, 5, 6], &values, DAffine3::from_scale(DVec3::splat(0.5)))
    }

    #[test]
    fn a_voxel_sits_at_its_index_and_the_border_is_empty() {
        let field = ramp();
        let world = field.world_from_node.transform_point3(DVec3::new(1.0, 1.0, 1.0));
        assert_eq!(world, DVec3::new(-1.5, 3.5, 1.0));
        assert_eq!(field.sample(Vec3::new(1.0, 1.0, 1.0)), 1.0);
        assert_eq!(field.sample(Vec3::new(0.5, 1.0, 1.0)), 0.5);
        assert_eq!(field.sample(Vec3::new(0.0, 1.0, 1.0)), 0.0);
        assert_eq!(field.sample(Vec3::new(f32::NAN, 1.0, 1.0)), 0.0);
    }

    #[test]
    fn coarsening_keeps_the_mass_and_the_place() {
        let field = ramp();
        let mass = |f: &DensityField| {
            let cell = f.world_from_node.matrix3.determinant();
            let centre = f.values.iter().enumerate().fold(DVec3::ZERO, |sum, (v, &d)| {
                let p = DVec3::new(
                    (v % f.dims[0]) as f64,
                    (v / f.dims[0] % f.dims[1]) as f64,
                    (v / f.dims[0] / f.dims[1]) as f64,
                );
                sum + f.world_from_node.transform_point3(p) * f64::from(d) * cell
            });
            (f.values.iter().map(|&d| f64::from(d)).sum::<f64>() * cell, centre)
        };
        let (m1, c1) = mass(&field);
        for step in [2, 3] {
            let (m, c) = mass(&field.coarsened(step));
            // f32 sums of 120 values: 1e-6 relative.
            assert!((m / m1 - 1.0).abs() < 1e-5, "{m} {m1}");
            assert!((c / m - c1 / m1).length() < 1e-5, "{c} {c1}");
        }
    }
}
