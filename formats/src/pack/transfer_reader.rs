//! The transfer of one frame out of a pack: its rows, and the bases of its run.
//!
//! Rows are held against their bases each time they are read, so that whoever has both may index without looking. The
//! bases read last are kept: the frames of a run share them.

use super::container::codec_of;
use super::reader::Pack;
use super::records::{FrameRecord, SectionRecord};
use super::transfer_layout::{decode_bases, decode_rows, from_rest};
use super::transfer_record::TransferRecord;
use super::transfer_sections::{TransferSections, bytes_of_transfer, sections_of_transfer};
use crate::transfer::{Shape, TransferBases, TransferRows};
use crate::{Error, Result};
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// Bases with their shape, so that rows need not look at every value again.
type Bases = (Arc<TransferBases>, Shape);

/// What an open pack knows of its transfer.
#[derive(Debug)]
pub(super) struct PackTransfer {
    record: TransferRecord,
    /// Of each frame of the record.
    sections: Vec<TransferSections>,
    /// The section of bases read last.
    last: Mutex<Option<(usize, Bases)>>,
}

impl PackTransfer {
    /// Fails unless the record is good, each frame has its sections, and they have the bytes that the record says.
    pub(super) fn new(
        path: &Path,
        toc: &[SectionRecord],
        frames: &[FrameRecord],
        record: TransferRecord,
    ) -> Result<Self> {
        record.check(path, frames)?;
        let sections = sections_of_transfer(path, toc, &record.frames)?;
        for (i, (frame, bytes)) in record.frames.iter().zip(bytes_of_transfer(toc, &sections)).enumerate() {
            let fields =
                [("bytes_at_rest", frame.bytes_at_rest, bytes.0), ("bytes_resident", frame.bytes_resident, bytes.1)];
            if let Some((field, found, expected)) = fields.into_iter().find(|f| f.1 != f.2) {
                return Err(Error::invalid(path, format!("transfer.frames[{i}].{field}"), found, expected));
            }
        }
        Ok(Self { record, sections, last: Mutex::new(None) })
    }

    pub(super) fn record(&self) -> &TransferRecord {
        &self.record
    }
}

impl Pack {
    /// Whether frame `frame` (counted from 0) has transfer.
    pub fn has_transfer(&self, frame: usize) -> bool {
        self.transfer_of(frame).is_ok()
    }

    /// The bases of transfer of the run that frame `frame` (counted from 0) belongs to; fails if it has no transfer.
    /// They are kept until those of another run are asked for.
    pub fn transfer_bases(&self, frame: usize) -> Result<Arc<TransferBases>> {
        let (transfer, place) = self.transfer_of(frame)?;
        Ok(self.bases(transfer, place)?.0)
    }

    /// The rows of transfer of frame `frame` (counted from 0); fails if it has none. Every row has its cluster in the
    /// bases of its run, and a weight for each of their directions.
    pub fn transfer_rows(&self, frame: usize) -> Result<TransferRows> {
        let (transfer, place) = self.transfer_of(frame)?;
        let (_, bases) = self.bases(transfer, place)?;
        let what = format!("transfer.frames[{place}].rows");
        let rows = decode_rows(self.path(), &what, &self.transfer_bytes(place, transfer.sections[place].rows, &what)?)?;
        let shape = rows.check(self.path(), &what)?;
        transfer.record.check_sets(self.path(), &what, &shape)?;
        transfer.record.frames[place].check_rows(self.path(), &what, &shape)?;
        shape.check_rows_by(self.path(), &what, &bases)?;
        Ok(rows)
    }

    /// The bases of the run of frame `place` of the record.
    fn bases(&self, transfer: &PackTransfer, place: usize) -> Result<Bases> {
        let section = transfer.sections[place].bases;
        let kept = transfer.last.lock().unwrap_or_else(PoisonError::into_inner).clone();
        if let Some((_, bases)) = kept.filter(|(of, _)| *of == section) {
            return Ok(bases);
        }
        let what = format!("transfer.frames[{place}].bases");
        let bases = decode_bases(self.path(), &what, &self.transfer_bytes(place, section, &what)?)?;
        let shape = bases.check(self.path(), &what)?;
        transfer.record.check_sets(self.path(), &what, &shape)?;
        let bases = (Arc::new(bases), shape);
        *transfer.last.lock().unwrap_or_else(PoisonError::into_inner) = Some((section, bases.clone()));
        Ok(bases)
    }

    /// The transfer, and which frame of its record this is.
    fn transfer_of(&self, frame: usize) -> Result<(&PackTransfer, usize)> {
        let Some(transfer) = &self.transfer else {
            let found = format!("no transfer of frame {frame}");
            return Err(Error::invalid(self.path(), "transfer", found, "a pack that was baked with transfer"));
        };
        Ok((transfer, transfer.record.place(self.path(), frame)?))
    }

    /// The resident bytes of a section of frame `place` of the record; `what` names them.
    fn transfer_bytes(&self, place: usize, section: usize, what: &str) -> Result<Vec<u8>> {
        let section = &self.sections()[section];
        let bytes = self.section_bytes(&format!("transfer.frames[{place}]"), section)?;
        from_rest(self.path(), what, bytes, codec_of(self.path(), what, section)?, section.bytes_resident)
    }
}
