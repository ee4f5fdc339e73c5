//! `smoke-bake view PACK [SCENE]`: a window that shows a pack, lets it be turned, relit and played, and saves what is seen.
//!
//! | file | what |
//! |---|---|
//! | `opening` | packs, scenes and dropped files into what the window shows |
//! | `framing` | first camera, medium and light from the data |
//! | `state` | what the user edits: a scene, a frame, a method, an exposure |
//! | `orbit` | the mouse moves the camera |
//! | `playback` | frames decoded ahead |
//! | `painter` | a stage into pictures, pass after pass |
//! | `worker` | threads on which the newest request wins |
//! | `tone` | a film into bytes |
//! | `saving` | scene file, OpenEXR and PNG |
//! | `shot` | the picture of the window itself |
//! | `app`, `input`, `panel` | the window, what the user does, what stands round the picture |
//!
//! Two workers make pictures: one with few terms of light, which answers at once while something moves, and one with the
//! chosen quality, which also follows a camera that moves, because that solves nothing anew.

#[cfg(feature = "view")]
mod app;
#[cfg(feature = "view")]
mod framing;
#[cfg(feature = "view")]
mod input;
#[cfg(feature = "view")]
mod opening;
#[cfg(feature = "view")]
mod orbit;
#[cfg(feature = "view")]
mod painter;
#[cfg(feature = "view")]
mod panel;
#[cfg(feature = "view")]
mod playback;
#[cfg(feature = "view")]
mod saving;
#[cfg(feature = "view")]
mod shot;
#[cfg(feature = "view")]
mod state;
#[cfg(feature = "view")]
mod tone;
#[cfg(feature = "view")]
mod worker;

use crate::cli::ViewArgs;
use crate::failure::Failure;

/// Opens the window, and ends when it closes.
#[cfg(feature = "view")]
pub fn run(args: &ViewArgs) -> Result<(), Failure> {
    app::run(args)
}

/// Says what is missing.
#[cfg(not(feature = "view"))]
pub fn run(_: &ViewArgs) -> Result<(), Failure> {
    Err(Failure::work("view: this program was built without its window; build it with `--features view`"))
}
