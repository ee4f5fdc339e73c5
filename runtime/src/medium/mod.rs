//! The medium: the density of one frame as the transport and the march see it.

pub mod decoder;
pub mod field;
pub mod frame;
pub mod gaussian_points;
pub mod gaussian_sum;
