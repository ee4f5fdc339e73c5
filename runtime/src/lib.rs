//! Light in a participating medium: a frame of a pack becomes a density, density and lights become source radiance,
//! and a march through both becomes an image.

pub mod backdrop;
pub mod camera;
pub mod error_function;
pub mod film;
#[cfg(feature = "gpu")]
pub mod gpu;
mod half_resolution;
pub mod image_difference;
pub mod lanes;
pub mod light;
pub mod march;
pub mod medium;
pub mod plan;
pub mod product;
pub mod renderer;
pub mod shaded_volume;
pub mod sphere;
pub mod statistics;
pub mod tracking;
pub mod transport;
