//! Light in a participating medium.

pub mod medium;
pub mod sphere;
pub mod transport;
