//! Truth tests of the path tracer: closed forms, brute force, sums that must hold, and the honesty of its errors.
//!
//! Every comparison is a z-test with the tracer's own standard errors; where it passes, it is shown that it would have
//! found the image 1 % off, or the standard errors halved ([`scenes::assert_agrees`]).

mod closed_forms;
mod honesty;
mod scenes;
mod sums;
