//! Light in a participating medium.

pub mod medium;
