//! Source radiance of smoke made of Gaussians (Zhou, Ren, Lin, Bao, Guo, Shum 2008, Real-Time Smoke Rendering Using
//! Compensated Ray Marching): the paper's own route, radiance at the Gaussians' centres.

pub mod centres;
pub mod decay;
pub mod depth;
pub mod diffusion;
pub mod exponential;
pub mod gmres;
pub mod integral;
pub mod overlap;
pub mod route;
pub mod volume_pass;
pub mod zonal;

#[cfg(test)]
mod testing;
