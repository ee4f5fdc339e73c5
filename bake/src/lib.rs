//! A density sequence in, a pack out.

pub mod residual;
