//! Functions on the sphere: real spherical harmonics, quadrature of directions, products, bases for light.

pub mod harmonics;
pub mod icosphere;
pub mod light_basis;
pub mod quadrature;
pub mod triple;
