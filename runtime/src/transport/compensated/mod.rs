//! Compensated ray marching (Zhou, Ren, Lin, Bao, Guo, Shum 2008).

pub mod columns;
pub mod grid;
pub mod krylov;
pub mod scatter;
pub mod single;
