//! The extremes of rendering, through the library as a user of it would: `docs/extremes.md` lists them all.
//!
//! Every method meets every extreme that it can serve ([`methods::Method`]); the right answer is a closed form, the
//! furnace, a symmetry, or the path tracer's image with its own standard errors and a stated error of the method.
//! Whatever else is asked, no pixel may be anything but a finite number ([`methods::Method::image`]).

#[path = "extremes/lights.rs"]
mod lights;
#[path = "extremes/media.rs"]
mod media;
#[path = "extremes/methods.rs"]
mod methods;
#[path = "extremes/routes.rs"]
mod routes;
#[path = "extremes/shapes.rs"]
mod shapes;
