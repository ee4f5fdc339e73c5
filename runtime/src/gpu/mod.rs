//! The graphics processor: compute passes beside their twins on the processor (feature `gpu`).
//!
//! A shader lies beside the file whose work it does, under the same name: `march.wgsl` beside `march.rs`. Here are the
//! device, the layouts that both sides share, and the host's side of each pass. Fields are storage buffers read with
//! written-out trilinear interpolation, in f32: filtering hardware keeps eight bits of a weight.
//! A frame is uploaded on any thread ([`upload`]), and drawn when its turn comes ([`renderer`]).
//! On the device: the grid route (sweeps, gather, GMRES), the centres' depths,
//! single scattering and products of the solve, the volume passes, the light and view of transfer, the view pass; and
//! decoding, which the renderer does not use yet. On the processor: the matrix between the centres.

pub mod centre_solve;
pub mod centres;
pub mod decode;
pub mod device;
pub mod gmres;
pub mod grid_solve;
pub mod layouts;
pub mod march;
pub mod pass;
pub mod planes;
pub mod renderer;
pub mod scatter;
pub mod self_test;
pub mod single;
pub mod sweep_grid;
pub mod transfer;
pub mod transfer_rows;
pub mod transfer_view;
pub mod upload;
pub mod volume;
pub mod volume_pass;
