//! The density of one frame.

pub mod gaussian_points;
