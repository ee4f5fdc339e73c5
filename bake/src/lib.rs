//! A density sequence in, a pack out.

pub mod fit;
pub mod residual;
