//! Which sections of a pack are its transfer: held against the record by reader and writer alike.
//!
//! A run of frames has one section of bases, which spans it from its first frame to its last; each of its frames has one
//! of rows. Cost: `n log n` for `n` sections.

use super::container::{KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS, kind_name};
use super::records::SectionRecord;
use super::transfer_record::TransferFrameRecord;
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// The sections of the transfer of a frame: which sections of the table of contents.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct TransferSections {
    /// The bases of its run.
    pub(super) bases: usize,
    /// Its rows.
    pub(super) rows: usize,
}

/// The sections of each of `frames`, which were checked: each exactly once, and no others of their kinds.
pub(super) fn sections_of_transfer(
    path: &Path,
    toc: &[SectionRecord],
    frames: &[TransferFrameRecord],
) -> Result<Vec<TransferSections>> {
    let mut left = BTreeMap::new();
    for (i, s) in toc.iter().enumerate().filter(|(_, s)| matches!(s.kind, KIND_TRANSFER_BASES | KIND_TRANSFER_ROWS)) {
        if left.insert((s.kind, s.first_frame), i).is_some() {
            let found = format!("more {} of frame {}", kind_name(s.kind), s.first_frame);
            return Err(Error::invalid(path, format!("sections[{i}].first_frame"), found, "one section"));
        }
    }
    let mut take = |place: usize, kind: u32, first: u32, span: u32| {
        let what = format!("transfer.frames[{place}].{}", kind_name(kind));
        let Some(i) = left.remove(&(kind, first)) else {
            return Err(Error::invalid(path, what, "no section", format!("one from frame {first}")));
        };
        match toc[i].frames == span {
            true => Ok(i),
            false => Err(Error::invalid(path, what, format!("a section of {} frames", toc[i].frames), span)),
        }
    };
    let mut sections = vec![];
    for run in frames.chunk_by(|a, b| a.first_of_run == b.first_of_run) {
        let (first, last) = (run[0].frame, run[run.len() - 1].frame);
        let bases = take(sections.len(), KIND_TRANSFER_BASES, first, last - first + 1)?;
        for frame in run {
            sections.push(TransferSections { bases, rows: take(sections.len(), KIND_TRANSFER_ROWS, frame.frame, 1)? });
        }
    }
    match left.into_values().min() {
        None => Ok(sections),
        Some(i) => {
            let found = format!("{} of frame {}", kind_name(toc[i].kind), toc[i].first_frame);
            Err(Error::invalid(path, format!("sections[{i}]"), found, "a section that the transfer record names"))
        }
    }
}

/// Bytes at rest and resident of each frame: its rows, and its even share of its run's bases.
pub(super) fn bytes_of_transfer(toc: &[SectionRecord], sections: &[TransferSections]) -> Vec<(u64, u64)> {
    let mut bytes = vec![];
    for run in sections.chunk_by(|a, b| a.bases == b.bases) {
        let bases = &toc[run[0].bases];
        for (i, frame) in run.iter().enumerate() {
            let rows = &toc[frame.rows];
            let share = |total: u64| even_share(total, run.len(), i);
            bytes.push((
                rows.bytes_at_rest.saturating_add(share(bases.bytes_at_rest)),
                rows.bytes_resident.saturating_add(share(bases.bytes_resident)),
            ));
        }
    }
    bytes
}

/// Part `i` of `total` in `n` parts that differ by one at most and add up to it.
pub(super) fn even_share(total: u64, n: usize, i: usize) -> u64 {
    let (n, i) = (n as u64, i as u64);
    total / n + u64::from(i < total % n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bases_of_a_run_are_shared_out_evenly() {
        let section =
            |bytes_at_rest, bytes_resident| SectionRecord { bytes_at_rest, bytes_resident, ..Default::default() };
        let toc =
            [section(8, 100), section(10, 10), section(20, 20), section(30, 30), section(5, 6), section(1, u64::MAX)];
        let of = |bases, rows| TransferSections { bases, rows };
        let bytes = bytes_of_transfer(&toc, &[of(0, 1), of(0, 2), of(0, 3), of(4, 5)]);
        // 8 is 3 + 3 + 2, 100 is 34 + 33 + 33; sums that no file has do not overflow.
        assert_eq!(bytes, [(13, 44), (23, 53), (32, 63), (6, u64::MAX)]);
    }

    #[test]
    fn shares_are_even_and_add_up() {
        for (total, n) in [(0, 1), (7, 3), (9, 3), (2, 5), (u64::MAX, 6)] {
            let shares: Vec<u64> = (0..n).map(|i| even_share(total, n, i)).collect();
            assert_eq!(shares.iter().sum::<u64>(), total);
            assert!(shares[0] - shares[n - 1] <= 1, "{shares:?}");
        }
    }
}
