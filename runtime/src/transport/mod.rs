//! From density and light to source radiance; a folder for each method.

pub mod compensated;
pub mod medium;
