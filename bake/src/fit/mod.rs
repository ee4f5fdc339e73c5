//! The fit of Gaussians to a density sequence.

pub mod descent;
pub mod frame;
pub mod initial;
pub mod lbfgsb;
pub mod objective;
pub mod teleport;
