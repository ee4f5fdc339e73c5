//! `smoke-bake view PACK [SCENE]`: a window that shows a pack, lets it be turned, relit and played, and saves what is seen.
//!
//! | file | what |
//! |---|---|
//! | `opening` | packs, scenes and dropped files into what the window shows |
//! | `framing` | first camera, medium and light from the data |
//! | `state` | what the user edits: a scene, a frame, a method, an exposure |
//! | `orbit` | the mouse moves the camera |
//! | `playback` | frames decoded and uploaded ahead |
//! | `painter` | a stage into pictures, pass after pass |
//! | `worker` | threads on which the newest request wins |
//! | `tone` | a film into bytes |
//! | `saving` | scene file, OpenEXR and PNG |
//! | `shot` | the picture of the window itself |
//! | `app`, `input`, `panel` | the window, what the user does, what stands round the picture |
//!
//! Two workers make pictures: one with few terms of light, which answers at once while something moves, and one with the
//! chosen quality, which also follows a camera that moves, because that solves nothing anew.

mod app;
mod framing;
mod input;
mod opening;
mod orbit;
mod painter;
mod panel;
mod playback;
mod saving;
mod shot;
mod state;
mod tone;
mod worker;

use crate::cli::ViewArgs;
use crate::failure::Failure;

/// Opens the window, and ends when it closes.
pub fn run(args: &ViewArgs) -> Result<(), Failure> {
    app::run(args)
}
