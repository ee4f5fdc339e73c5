//! Random ways of light through a density, without bias: what path tracing and photon tracing are made of.

pub mod flight;
pub mod majorant;
pub mod phase;
pub mod sampler;
