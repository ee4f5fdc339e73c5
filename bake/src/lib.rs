//! A density sequence in, a pack out.
//!
//! The way of a frame, in order: [`survey`] (what is there: boxes, largest density, one map) → [`fit`] (Gaussians) →
//! [`residual`] (what they miss, quantised with a promise) → [`work`] (kept, so that an interrupted bake goes on) →
//! the pack. [`pipeline`] is that list.

pub mod error;
pub mod fit;
pub mod pipeline;
pub mod residual;
pub mod survey;
pub mod transfer;
pub mod work;

pub use error::{Error, Result};
