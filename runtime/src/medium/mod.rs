//! The medium: density on voxels, from the Gaussians and the residual of a pack.

pub mod gaussian_sum;
