//! What is said about precomputed transfer.
//!
//! The record belongs to one medium: rows and bases hold its extinction, albedo and phase function. Frames that follow
//! one another in the record and share bases are a *run*.

use super::records::{FrameRecord, number};
use crate::transfer::{MAX_SETS, Shape};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Most bands of what goes out indirectly.
pub const MAX_BANDS: u32 = 6;
/// Largest `cell_shift`: cells have at most 16 voxels a side.
pub const MAX_CELL_SHIFT: u32 = 4;
/// Longest name of a basis, bytes.
pub const MAX_BASIS_BYTES: usize = 16;

/// What holds for all transfer of a pack.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TransferRecord {
    /// Extinction of the medium it belongs to, for each colour channel: 1 / (density unit * world length), 0 or more.
    pub sigma_t: [f32; 3],
    /// Albedo of the medium, for each colour channel, 0 to 1.
    pub albedo: [f32; 3],
    /// Mean cosine of the medium's Henyey-Greenstein phase function, above -1 and below 1.
    pub g: f32,
    /// Bands of spherical harmonics of what goes out indirectly, 1 to 6: `bands^2` coefficients.
    pub bands: u32,
    /// Cells of the indirect rows have `2^cell_shift` voxels a side; 0 to 4.
    pub cell_shift: u32,
    /// Photons that were traced for each face of a voxel on the border and each light of the indirect basis.
    pub photons: u32,
    /// Seed of the photons.
    pub seed: u64,
    /// Which direct set a colour channel uses: 0 to 2, and no number below the largest is left out.
    pub direct_of_channel: [u32; 3],
    /// Which indirect set a colour channel uses; likewise.
    pub indirect_of_channel: [u32; 3],
    /// Name of the basis of the light: 1 to 16 lower-case ASCII letters and digits.
    pub basis: String,
    /// The frames that have transfer, in ascending order; may be empty.
    pub frames: Vec<TransferFrameRecord>,
}

/// What holds for the transfer of one frame. [`super::PackWriter`] fills in the last two fields.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TransferFrameRecord {
    /// Which frame of the pack, counted from 0.
    pub frame: u32,
    /// The first frame of its run, counted from 0: that of the frame before in this list, or the frame itself.
    pub first_of_run: u32,
    /// Voxels with a direct row; at most those of the frame's box with one more on every side.
    pub voxels: u64,
    /// Cells with an indirect row.
    pub cells: u64,
    /// Relative RMS of what compression changed in the direct matrix.
    pub direct_error: f64,
    /// Relative RMS of what compression changed in the indirect matrix.
    pub indirect_error: f64,
    /// Share of the light that bounded paths dropped, 0 to 1.
    pub truncated: f64,
    /// Bytes of both matrices before compression.
    pub raw_bytes: u64,
    /// Bytes in the file: rows, and an even share of the run's bases (by the writer).
    pub bytes_at_rest: u64,
    /// Bytes in memory, likewise (by the writer).
    pub bytes_resident: u64,
}

impl TransferRecord {
    /// Fails on the first field that no transfer of a pack with these frames can have.
    pub fn check(&self, path: &Path, frames: &[FrameRecord]) -> Result<()> {
        for c in 0..3 {
            let (sigma_t, albedo) = (f64::from(self.sigma_t[c]), f64::from(self.albedo[c]));
            number(path, &format!("transfer.sigma_t[{c}]"), sigma_t, |v| v >= 0.0 && v.is_finite(), "0 or more")?;
            number(path, &format!("transfer.albedo[{c}]"), albedo, |v| (0.0..=1.0).contains(&v), "0 to 1")?;
        }
        number(path, "transfer.g", f64::from(self.g), |v| v.abs() < 1.0, "above -1 and below 1")?;
        number(path, "transfer.bands", self.bands.into(), |v| v >= 1.0 && v <= MAX_BANDS.into(), "1 to 6")?;
        number(path, "transfer.cell_shift", self.cell_shift.into(), |v| v <= MAX_CELL_SHIFT.into(), "0 to 4")?;
        sets_of(path, "direct_of_channel", self.direct_of_channel)?;
        sets_of(path, "indirect_of_channel", self.indirect_of_channel)?;
        let letter = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit();
        if !((1..=MAX_BASIS_BYTES).contains(&self.basis.len()) && self.basis.bytes().all(letter)) {
            let expected = format!("1 to {MAX_BASIS_BYTES} lower-case letters and digits");
            return Err(Error::invalid(path, "transfer.basis", format!("{:?}", self.basis), expected));
        }
        let mut before: Option<&TransferFrameRecord> = None;
        for (i, frame) in self.frames.iter().enumerate() {
            frame.check(path, i, before, frames)?;
            before = Some(frame);
        }
        Ok(())
    }

    /// Where the frame with this number (counted from 0, as in the pack) is in [`Self::frames`].
    pub(super) fn place(&self, path: &Path, frame: usize) -> Result<usize> {
        let place = self.frames.binary_search_by_key(&(frame as u64), |f| f.frame.into());
        place.map_err(|_| {
            let expected = format!("one that has it: {}", ranges(&self.frames));
            Error::invalid(path, "transfer.frames", format!("no transfer of frame {frame}"), expected)
        })
    }

    /// Fails unless bases or rows have the sets that the colour channels use, `what` names them.
    pub(super) fn check_sets(&self, path: &Path, what: &str, shape: &Shape) -> Result<()> {
        let of_channels = |sets: [u32; 3]| sets.into_iter().max().map_or(0, |set| set as usize + 1);
        let names = [
            ("direct", shape.direct.len(), of_channels(self.direct_of_channel)),
            ("indirect", shape.indirect.len(), of_channels(self.indirect_of_channel)),
        ];
        for (name, found, expected) in names {
            if found != expected {
                let expected = format!("{expected}, as the colour channels use");
                return Err(Error::invalid(path, format!("{what}.{name}"), format!("{found} sets"), expected));
            }
        }
        Ok(())
    }
}

impl TransferFrameRecord {
    fn check(&self, path: &Path, i: usize, before: Option<&Self>, frames: &[FrameRecord]) -> Result<()> {
        let field = |name: &str| format!("transfer.frames[{i}].{name}");
        let Some(record) = frames.get(self.frame as usize) else {
            let expected = format!("below the {} frames of the pack", frames.len());
            return Err(Error::invalid(path, field("frame"), self.frame, expected));
        };
        if let Some(before) = before.filter(|b| b.frame >= self.frame) {
            let expected = format!("above {}, the frame before", before.frame);
            return Err(Error::invalid(path, field("frame"), self.frame, expected));
        }
        if self.first_of_run != self.frame && before.is_none_or(|b| b.first_of_run != self.first_of_run) {
            let or = before.map_or(String::new(), |b| format!(" or {}, that of the frame before", b.first_of_run));
            return Err(Error::invalid(path, field("first_of_run"), self.first_of_run, format!("{}{or}", self.frame)));
        }
        // An empty box has nothing around.
        let sides = record.dims.map(|d| if d == 0 { 0 } else { u64::from(d) + 2 });
        let most = sides.into_iter().fold(1, u64::saturating_mul);
        if self.voxels > most {
            let expected = format!("at most {most}, the frame's box and one voxel around");
            return Err(Error::invalid(path, field("voxels"), self.voxels, expected));
        }
        if self.cells > u32::MAX.into() {
            return Err(Error::invalid(path, field("cells"), self.cells, format!("at most {}", u32::MAX)));
        }
        let error = |v: f64| v >= 0.0 && v.is_finite();
        number(path, &field("direct_error"), self.direct_error, error, "0 or more")?;
        number(path, &field("indirect_error"), self.indirect_error, error, "0 or more")?;
        number(path, &field("truncated"), self.truncated, |v| (0.0..=1.0).contains(&v), "0 to 1")
    }

    /// Fails unless each direct set has a row a voxel, and each indirect set one a cell; `what` names the rows.
    pub(super) fn check_rows(&self, path: &Path, what: &str, shape: &Shape) -> Result<()> {
        let sets =
            [("direct", &shape.direct, self.voxels, "voxels"), ("indirect", &shape.indirect, self.cells, "cells")];
        for (name, sets, expected, of) in sets {
            if let Some(i) = sets.iter().position(|set| set.rows != expected) {
                let expected = format!("{expected}, a row for each of the {of}");
                return Err(Error::invalid(path, format!("{what}.{name}[{i}].rows"), sets[i].rows, expected));
            }
        }
        Ok(())
    }
}

fn sets_of(path: &Path, name: &str, sets: [u32; 3]) -> Result<()> {
    let largest = sets.into_iter().max().unwrap_or(0);
    match (largest as usize) < MAX_SETS && (0..largest).all(|set| sets.contains(&set)) {
        true => Ok(()),
        false => {
            let expected = "numbers from 0 to at most 2, none left out";
            Err(Error::invalid(path, format!("transfer.{name}"), format!("{sets:?}"), expected))
        }
    }
}

/// The frames' numbers, those in a row as a range; the first few of them.
fn ranges(frames: &[TransferFrameRecord]) -> String {
    let runs: Vec<&[TransferFrameRecord]> = frames.chunk_by(|a, b| a.frame + 1 == b.frame).collect();
    let name = |run: &&[TransferFrameRecord]| match run {
        [one] => one.frame.to_string(),
        _ => format!("{}-{}", run[0].frame, run[run.len() - 1].frame),
    };
    let mut names: Vec<String> = runs.iter().take(8).map(name).collect();
    match runs.len() {
        0 => names.push("none".into()),
        1..=8 => {}
        more => names.push(format!("and {} more ranges", more - 8)),
    }
    names.join(", ")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The transfer of frames 0, 2, 3 and 5 of six: runs 0 to 2 and 3 to 5.
    pub(in crate::pack) fn some_record() -> TransferRecord {
        let frame = |frame: u32, first_of_run: u32| TransferFrameRecord {
            frame,
            first_of_run,
            voxels: 20 + u64::from(frame),
            cells: 3,
            direct_error: 0.01,
            indirect_error: 0.02,
            truncated: 1e-5,
            raw_bytes: 12_345,
            ..TransferFrameRecord::default()
        };
        TransferRecord {
            sigma_t: [1.0, 1.0, 1.0],
            albedo: [0.9, 0.8, 0.9],
            g: -0.25,
            bands: 3,
            cell_shift: 1,
            photons: 64,
            seed: 7,
            direct_of_channel: [0, 0, 0],
            indirect_of_channel: [0, 1, 0],
            basis: "dsf642".into(),
            frames: vec![frame(0, 0), frame(2, 0), frame(3, 3), frame(5, 3)],
        }
    }

    fn path() -> &'static Path {
        Path::new("p")
    }

    fn frames() -> Vec<FrameRecord> {
        vec![FrameRecord { dims: [3, 4, 5], ..FrameRecord::default() }; 6]
    }

    #[test]
    fn good_records_are_good_at_their_extremes() {
        let check = |record: &TransferRecord| record.check(path(), &frames()).unwrap();
        let record = some_record();
        check(&record);
        check(&TransferRecord { frames: vec![], basis: "a".repeat(16), bands: 6, cell_shift: 4, ..record.clone() });
        check(&TransferRecord { sigma_t: [0.0, f32::MAX, 1e-30], albedo: [0.0, 1.0, 0.5], ..record.clone() });
        check(&TransferRecord {
            direct_of_channel: [2, 1, 0],
            indirect_of_channel: [1, 0, 1],
            g: 0.999,
            ..record.clone()
        });
        // A box of 3 x 4 x 5 voxels has 5 x 6 x 7 with one around.
        let frame = TransferFrameRecord { voxels: 210, cells: u32::MAX.into(), truncated: 1.0, ..record.frames[0] };
        check(&TransferRecord { frames: vec![frame], ..record });
    }

    #[test]
    fn poison_in_every_field_is_named() {
        type Spoil = Box<dyn Fn(&mut TransferRecord)>;
        let mut defects: Vec<(String, Spoil)> = vec![];
        for v in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -0.5] {
            defects.push(("sigma_t[1]".into(), Box::new(move |r| r.sigma_t[1] = v)));
            defects.push(("albedo[2]".into(), Box::new(move |r| r.albedo[2] = v)));
            defects.push(("g".into(), Box::new(move |r| r.g = if v == -0.5 { -1.0 } else { v })));
            let w = f64::from(v);
            defects.push(("frames[1].direct_error".into(), Box::new(move |r| r.frames[1].direct_error = w)));
            defects.push(("frames[1].indirect_error".into(), Box::new(move |r| r.frames[1].indirect_error = w)));
            defects.push(("frames[1].truncated".into(), Box::new(move |r| r.frames[1].truncated = w)));
        }
        let mut more = |name: &str, spoil: fn(&mut TransferRecord)| defects.push((name.into(), Box::new(spoil)));
        more("albedo[0]", |r| r.albedo[0] = 1.0001);
        more("g", |r| r.g = 1.0);
        more("bands", |r| r.bands = 0);
        more("bands", |r| r.bands = 7);
        more("cell_shift", |r| r.cell_shift = 5);
        more("direct_of_channel", |r| r.direct_of_channel = [1, 1, 1]);
        more("direct_of_channel", |r| r.direct_of_channel = [0, 2, 0]);
        more("indirect_of_channel", |r| r.indirect_of_channel = [0, 1, 3]);
        more("indirect_of_channel", |r| r.indirect_of_channel = [0, 1, u32::MAX]);
        more("basis", |r| r.basis.clear());
        more("basis", |r| r.basis = "a".repeat(17));
        more("basis", |r| r.basis = "DSF642".into());
        more("basis", |r| r.basis = "a\n".into());
        more("frames[3].frame", |r| r.frames[3].frame = 6);
        more("frames[2].frame", |r| r.frames[2].frame = 2);
        more("frames[1].frame", |r| r.frames[1].frame = 0);
        more("frames[0].first_of_run", |r| r.frames[0] = TransferFrameRecord { frame: 1, ..r.frames[0] });
        more("frames[2].first_of_run", |r| r.frames[2].first_of_run = 1);
        more("frames[3].first_of_run", |r| r.frames[3].first_of_run = 0);
        more("frames[0].voxels", |r| r.frames[0].voxels = 211);
        more("frames[0].cells", |r| r.frames[0].cells = 1 << 32);
        more("frames[0].truncated", |r| r.frames[0].truncated = 1.5);
        for (named, spoil) in defects {
            let mut record = some_record();
            spoil(&mut record);
            let message = record.check(path(), &frames()).unwrap_err().to_string();
            assert!(message.starts_with(&format!("p: transfer.{named}: found ")), "{message} does not name {named}");
            assert!(!message.contains('\n'), "{message}");
        }
    }

    #[test]
    fn an_empty_frame_has_no_voxels() {
        let frames = vec![FrameRecord::default(); 6];
        let message = some_record().check(path(), &frames).unwrap_err().to_string();
        assert!(message.starts_with("p: transfer.frames[0].voxels: found 20, expected at most 0, "), "{message}");
    }

    #[test]
    fn a_frame_without_transfer_is_told_which_frames_have_it() {
        let mut record = some_record();
        assert_eq!(record.place(path(), 3).unwrap(), 2);
        let message = record.place(path(), 4).unwrap_err().to_string();
        let expected = "p: transfer.frames: found no transfer of frame 4, expected one that has it: 0, 2-3, 5";
        assert_eq!(message, expected);
        record.frames.clear();
        assert!(record.place(path(), usize::MAX).unwrap_err().to_string().ends_with("that has it: none"));
        record.frames = (0..20).map(|i| TransferFrameRecord { frame: 2 * i, ..Default::default() }).collect();
        let message = record.place(path(), 1).unwrap_err().to_string();
        assert!(message.ends_with("0, 2, 4, 6, 8, 10, 12, 14, and 12 more ranges"), "{message}");
    }
}
