//! The fit of Gaussians to a density sequence: `D = sum w B + R`, the residual R being somebody else's.
//!
//! [`frame::fit_first`] and [`frame::fit_next`] are what the pipeline calls, frame after frame; the rest is what they
//! are made of: the [`objective`] and its gradient, the [`lbfgsb`] solver, a minimisation under way ([`descent`]), the
//! starting Gaussians ([`initial`]), and the exchange of useless for needed ones ([`teleport`]).

pub mod descent;
pub mod frame;
pub mod initial;
pub mod lbfgsb;
pub mod objective;
pub mod teleport;
