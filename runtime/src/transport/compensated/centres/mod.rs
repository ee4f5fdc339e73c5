//! The paper's route: source radiance solved at the Gaussians' centres, then interpolated ([`route`]).

pub mod decay;
pub mod depth;
pub mod diffusion;
pub mod exponential;
pub mod incident;
pub mod integral;
pub mod kernels;
pub mod overlap;
pub mod route;
pub mod single;
pub mod source;
pub mod volume_pass;
pub mod zonal;

#[cfg(test)]
mod testing;
