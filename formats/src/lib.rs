//! What smoke-bake reads and writes: volumes in, images in and out, scene files, and the pack.
//!
//! Nothing here knows about light or threads. Every reader is bounded: a count from a file is checked against the
//! bytes that are there before anything is allocated, and an error names the file, the field, what was found and what
//! was expected.

pub mod atomic;
pub mod bounded;
pub mod error;
mod frame_selection;
pub mod gaussian;
pub mod image;
pub mod mitsuba_vol;
pub mod pack;
pub mod pbrt;
pub mod residual;
pub mod scene;
pub mod sequence;
pub mod toml_text;
pub mod transfer;
pub mod vdb;
pub mod volume;
pub mod volume_file;

pub use error::{Error, Result};
