//! Why a sequence could not be baked.

use std::path::PathBuf;

/// Result of the pipeline.
pub type Result<T> = std::result::Result<T, Error>;

/// Why a sequence could not be baked. One line each, made to be shown to a user as it is.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file could not be read or written.
    #[error(transparent)]
    File(#[from] smoke_formats::Error),
    /// No frames to bake.
    #[error("no frames to bake; give a sequence of at least one frame")]
    NoFrames,
    /// Two frames lie differently in the world.
    #[error(
        "{}: index-to-world map differs from that of {}; bake the two parts of the sequence apart",
        other.display(), first.display()
    )]
    Map {
        /// The first frame.
        first: PathBuf,
        /// A frame with another map.
        other: PathBuf,
    },
    /// The box of all frames together is too large for f32 centres and 32-bit sides.
    #[error(
        "box of the whole sequence: found sides {found:?}, expected at most {most} voxels each; check for a stray voxel far away"
    )]
    Box {
        /// Sides in voxels.
        found: [u64; 3],
        /// Largest side.
        most: u64,
    },
    /// A frame could not be fitted.
    #[error("{}: {source}", path.display())]
    Fit {
        /// The frame's file.
        path: PathBuf,
        /// Why.
        source: crate::fit::frame::FitError,
    },
    /// A frame could not be quantised.
    #[error("{}: {source}", path.display())]
    Quantise {
        /// The frame's file.
        path: PathBuf,
        /// Why.
        source: crate::residual::quantise::QuantiseError,
    },
    /// A source file changed between the survey and the bake.
    #[error("{}: changed while it was being baked; start again", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// A folder has the name of the work folder and is not one.
    #[error("{}: a folder that no bake made is in the way; move it, or choose another output", path.display())]
    Foreign {
        /// The folder.
        path: PathBuf,
    },
    /// Another bake of the same output is under way.
    #[error("{}: another bake writes to this output; wait for it, or choose another output", path.display())]
    Busy {
        /// The work folder.
        path: PathBuf,
    },
    /// The output would replace something that is not to be replaced.
    #[error("{}: output: found {found}, expected {expected}", path.display())]
    Output {
        /// The output.
        path: PathBuf,
        /// What is there.
        found: &'static str,
        /// What may be there.
        expected: &'static str,
    },
    /// An interrupted bake was made with other settings or from other files.
    #[error("{}: the interrupted bake there had {what}; bake without --resume to start again", path.display())]
    Resume {
        /// The work folder.
        path: PathBuf,
        /// What differs.
        what: &'static str,
    },
}
