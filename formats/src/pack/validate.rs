//! What is wrong with a pack, the first thing first.
//!
//! Order: magic, version, lengths, checksum, table of contents, kinds and codecs, places, records (these are what
//! opening checks); then the zeros between sections; then each frame's Gaussians and residual, where a layout must be
//! the one that its codes give, to the byte; then each frame's transfer.

use super::container::HEADER_BYTES;
use super::reader::Pack;
use crate::residual::{Residual, hash, rank};
use crate::{Error, Result};
use std::path::Path;

/// One thing that is wrong.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Where, such as `frames[3].gaussians[17].radius`; empty if the file cannot be read.
    pub place: String,
    /// What was found, and what was expected.
    pub message: String,
}

impl From<Error> for Finding {
    fn from(error: Error) -> Self {
        match error {
            Error::Invalid { what, found, expected, .. } => {
                Self { place: what, message: format!("found {found}, expected {expected}") }
            }
            Error::Unsupported { what, found, hint, .. } => {
                Self { place: what, message: format!("{found} is not supported; {hint}") }
            }
            Error::Io { source, .. } => Self { place: String::new(), message: source.to_string() },
        }
    }
}

/// What is wrong with the pack at `path`: nothing for a good one. Each frame adds at most one finding, and its
/// transfer one.
pub fn validate(path: &Path) -> Vec<Finding> {
    match Pack::open(path) {
        Ok(pack) => check(&pack),
        Err(error) => vec![error.into()],
    }
}

/// [`validate`] for a pack in memory; `path` only names it.
pub fn validate_bytes(path: &Path, bytes: Vec<u8>) -> Vec<Finding> {
    match Pack::from_bytes(path, bytes) {
        Ok(pack) => check(&pack),
        Err(error) => vec![error.into()],
    }
}

fn check(pack: &Pack) -> Vec<Finding> {
    let gaps = check_gaps(pack);
    let frames = (0..pack.frames().len()).map(|frame| check_frame(pack, frame));
    let transfer = pack.transfer().into_iter().flat_map(|record| &record.frames);
    let transfer = transfer.map(|frame| pack.transfer_rows(frame.frame as usize).map(drop));
    std::iter::once(gaps).chain(frames).chain(transfer).filter_map(Result::err).map(Finding::from).collect()
}

fn check_gaps(pack: &Pack) -> Result<()> {
    let mut end = HEADER_BYTES;
    let starts = pack.sections().iter().map(|s| (s.offset, s.offset + s.bytes_at_rest));
    for (i, (start, after)) in starts.chain([(pack.toc_offset(), 0)]).enumerate() {
        let what = format!("sections[{i}].padding");
        let gap = pack.bytes_at(end, start - end, &what)?;
        if let Some(at) = gap.iter().position(|&b| b != 0) {
            let found = format!("{} at byte {}", gap[at], end + at as u64);
            return Err(Error::invalid(pack.path(), what, found, "zeros before it"));
        }
        end = after;
    }
    Ok(())
}

fn check_frame(pack: &Pack, frame: usize) -> Result<()> {
    pack.gaussians(frame)?;
    let residual = pack.residual(frame)?;
    residual.codes()?.check(pack.path())?;
    // A tile is checked as a whole, with its first frame.
    if residual.frame > 0 {
        return Ok(());
    }
    let rebuilt = match &*residual.residual {
        Residual::Rank(view) => rank::encode(&view.codes()),
        Residual::Hash(view) => {
            let codes = (0..view.frames()).map(|f| view.codes(f)).collect::<Result<Vec<_>>>()?;
            hash::assemble(pack.path(), &codes, &view.table())?
        }
    };
    match rebuilt == residual.residual.bytes() {
        true => Ok(()),
        false => {
            let what = format!("frames[{frame}].residual");
            Err(Error::invalid(pack.path(), what, "bytes that its codes do not give", "the layout of its codes"))
        }
    }
}
