//! Light in a participating medium.
pub mod image_difference;
