//! Functions on the sphere: real spherical harmonics, quadrature of directions, products.

pub mod harmonics;
pub mod quadrature;
pub mod triple;
