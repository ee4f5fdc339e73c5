//! The pack: one file that holds a baked sequence. `FORMAT.md` at the repository root states every offset.
//!
//! | file | what |
//! |---|---|
//! | [`container`] | header, sections on 256-byte boundaries, table of contents |
//! | [`records`] | what is said about sequence, settings, frames and sections |
//! | [`gaussians`] | Gaussians at rest: plain, or at 16 bits a parameter |
//! | [`at_rest`] | a section's bytes at rest and resident |
//! | [`encoded`] | a frame at rest, before it is in a pack |
//! | [`transfer_record`] | what is said about precomputed transfer |
//! | [`transfer_sections`] | which sections belong to it |
//! | [`transfer_layout`] | bases and rows of transfer as bytes |
//! | [`encoded_transfer`] | the transfer of a frame at rest, before it is in a pack |
//! | [`writer`] | frames in, a file out |
//! | [`reader`] | one frame out, without reading the others |
//! | [`transfer_reader`] | the transfer of one frame out |
//! | [`validate`] | the first thing that is wrong with a file |

pub mod at_rest;
pub mod container;
pub mod encoded;
pub mod encoded_transfer;
pub mod gaussians;
pub mod reader;
pub mod records;
pub mod transfer_layout;
mod transfer_reader;
pub mod transfer_record;
mod transfer_sections;
mod validate;
mod work_file;
pub mod writer;
mod zlib;

pub use encoded::{AtRest, EncodedFrame, FrameData};
pub use encoded_transfer::EncodedTransfer;
pub use gaussians::snap_gaussians;
pub use reader::{FrameResidual, Pack};
pub use records::{Codec, FrameRecord, Promise, ResidualKind, SequenceRecord, SettingsRecord};
pub use transfer_record::{TransferFrameRecord, TransferRecord};
pub use validate::{Finding, validate, validate_bytes};
pub use writer::{PackWriter, write};

#[cfg(test)]
mod damage_tests;
#[cfg(test)]
mod format_tests;
#[cfg(test)]
mod transfer_tests;
