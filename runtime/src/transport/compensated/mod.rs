//! Compensated ray marching (Zhou, Ren, Lin, Bao, Guo, Shum 2008, Real-Time Smoke Rendering Using Compensated Ray
//! Marching).
//!
//! Two routes to the source radiance: on grid nodes ([`grid`], the default: measured several times closer to the truth,
//! `docs/accuracy.md`), and the paper's own at the Gaussians' centres ([`centres`]).

pub mod centres;
pub mod gmres;
pub mod grid;
