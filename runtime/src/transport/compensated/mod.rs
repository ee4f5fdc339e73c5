//! Compensated ray marching (Zhou, Ren, Lin, Bao, Guo, Shum 2008, Real-Time Smoke Rendering Using Compensated Ray
//! Marching).
//!
//! Two routes to the source radiance: the paper's own, at the Gaussians' centres ([`route`]), and on grid nodes
//! ([`grid`], the default: measured several times closer to the truth).

pub mod centres;
pub mod columns;
pub mod decay;
pub mod depth;
pub mod diffusion;
pub mod exponential;
pub mod gmres;
pub mod grid;
pub mod integral;
pub mod krylov;
pub mod overlap;
pub mod route;
pub mod scatter;
pub mod single;
pub mod volume_pass;
pub mod zonal;

#[cfg(test)]
mod testing;
