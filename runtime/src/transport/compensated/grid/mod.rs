//! The grid route: source radiance on nodes, by sweeps along sheared columns ([`route`]).

pub mod channels;
pub mod columns;
pub mod route;
pub mod scatter;
pub mod single;
