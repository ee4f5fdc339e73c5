//! What a sequence holds, before anything is baked: every frame is read once.
//!
//! The promise is relative to the largest density of all frames, and unit space to the box of all frames, so both must
//! be known before the first frame is fitted. And a frame that cannot be read is reported now, not after an hour.
//! Cost: one read of every file; frames are read side by side.

use crate::{Error, Result};
use glam::DAffine3;
use rayon::prelude::*;
use smoke_formats::sequence::SequenceFrame;
use smoke_formats::volume::{ClampReport, DensityGrid};
use smoke_formats::volume_file;
use std::path::{Path, PathBuf};

/// Largest side of a sequence's box: centres are f32 in a unit cube, and 2^20 voxels leave them a sixteenth of a voxel.
const MAX_SIDE: u64 = 1 << 20;

/// One frame as the survey saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct SurveyedFrame {
    /// Frame number.
    pub number: i32,
    /// Its file.
    pub path: PathBuf,
    /// XXH3-128 of the file's bytes.
    pub source_hash: [u8; 16],
    /// Index coordinates of the first voxel of its box.
    pub origin: [i32; 3],
    /// Voxels of its box; all zero for an empty frame.
    pub dims: [usize; 3],
    /// Active voxels.
    pub active_voxels: u64,
    /// Largest density.
    pub density_max: f32,
    /// What `clamp` repaired.
    pub clamped: ClampReport,
}

/// A sequence as the survey saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct Survey {
    /// Name of the grid in every file.
    pub grid: String,
    /// True if bad densities are repaired on reading.
    pub clamp: bool,
    /// The frames, ascending.
    pub frames: Vec<SurveyedFrame>,
    /// Index coordinates of the first voxel of the box of all frames.
    pub origin: [i32; 3],
    /// Voxels of that box.
    pub dims: [u32; 3],
    /// Largest density of all frames; 0 if all are empty.
    pub density_max: f32,
    /// Index to world, the same for all frames.
    pub world_from_index: DAffine3,
}

/// Reads every frame. `seen` is called once a frame, from any thread.
///
/// # Errors
/// A file that cannot be read, a density that is not one (unless `clamp`), two frames with different maps.
pub fn survey(frames: &[SequenceFrame], grid: &str, clamp: bool, seen: &(dyn Fn() + Sync)) -> Result<Survey> {
    let read = |frame: &SequenceFrame| -> Result<(SurveyedFrame, DAffine3)> {
        let source_hash = hash_file(&frame.path)?;
        let (density, clamped) = read_density(&frame.path, grid, clamp)?;
        seen();
        let surveyed = SurveyedFrame {
            number: frame.number,
            path: frame.path.clone(),
            source_hash,
            origin: density.origin,
            dims: density.dims,
            active_voxels: density.active.count() as u64,
            density_max: density.values.iter().copied().fold(0.0, f32::max),
            clamped,
        };
        Ok((surveyed, density.world_from_index))
    };
    // Each result has its place, and the first error in frame order is the one reported.
    let all: Vec<Result<(SurveyedFrame, DAffine3)>> = frames.par_iter().map(read).collect();
    let all = all.into_iter().collect::<Result<Vec<_>>>()?;
    let Some((first, map)) = all.first() else { return Err(Error::NoFrames) };
    if let Some((other, _)) = all.iter().find(|(_, other)| other != map) {
        return Err(Error::Map { first: first.path.clone(), other: other.path.clone() });
    }
    let map = *map;
    let frames: Vec<SurveyedFrame> = all.into_iter().map(|(frame, _)| frame).collect();
    let (origin, dims) = union(&frames)?;
    let density_max = frames.iter().map(|f| f.density_max).fold(0.0, f32::max);
    Ok(Survey { grid: grid.to_owned(), clamp, frames, origin, dims, density_max, world_from_index: map })
}

/// One frame's density, checked or repaired.
pub fn read_density(path: &Path, grid: &str, clamp: bool) -> Result<(DensityGrid, ClampReport)> {
    let mut density = volume_file::read(path, grid)?;
    let report = if clamp {
        density.clamp_density()
    } else {
        density.check_density(path)?;
        ClampReport::default()
    };
    Ok((density, report))
}

/// XXH3-128 of a file's bytes.
pub fn hash_file(path: &Path) -> Result<[u8; 16]> {
    let bytes = std::fs::read(path).map_err(|e| smoke_formats::Error::io(path, e))?;
    Ok(xxhash_rust::xxh3::xxh3_128(&bytes).to_le_bytes())
}

/// The box of all frames that have one; empty frames have no place.
fn union(frames: &[SurveyedFrame]) -> Result<([i32; 3], [u32; 3])> {
    let boxes: Vec<&SurveyedFrame> = frames.iter().filter(|f| f.dims != [0; 3]).collect();
    if boxes.is_empty() {
        return Ok(([0; 3], [0; 3]));
    }
    let (mut low, mut high) = ([i64::MAX; 3], [i64::MIN; 3]);
    for frame in boxes {
        for a in 0..3 {
            low[a] = low[a].min(i64::from(frame.origin[a]));
            high[a] = high[a].max(i64::from(frame.origin[a]) + frame.dims[a] as i64);
        }
    }
    let found = [0, 1, 2].map(|a| (high[a] - low[a]) as u64);
    if found.iter().any(|&side| side > MAX_SIDE) {
        return Err(Error::Box { found, most: MAX_SIDE });
    }
    Ok((low.map(|l| l as i32), found.map(|side| side as u32)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use smoke_formats::vdb::{self, WriteOptions};
    use smoke_formats::volume::VoxelMask;

    pub(crate) fn frame(
        folder: &Path,
        number: i32,
        origin: [i32; 3],
        dims: [usize; 3],
        scale: f64,
        value: f32,
    ) -> SequenceFrame {
        let count = dims.iter().product();
        let mut active = VoxelMask::new(count);
        (0..count).for_each(|v| active.set(v));
        let world_from_index = DAffine3::from_scale(glam::DVec3::splat(scale));
        let grid =
            DensityGrid { name: "density".into(), origin, dims, values: vec![value; count], active, world_from_index };
        let path = folder.join(format!("a.{number}.vdb"));
        vdb::write(&path, &grid, &WriteOptions::default()).unwrap();
        SequenceFrame { number, path }
    }

    #[test]
    fn the_box_and_the_largest_density_are_those_of_all_frames() {
        let folder = tempfile::tempdir().unwrap();
        let f = folder.path();
        let frames = [
            frame(f, 1, [2, -3, 4], [2, 2, 2], 0.5, 0.25),
            frame(f, 2, [0; 3], [0; 3], 0.5, 0.0),
            frame(f, 3, [-5, 0, 0], [3, 1, 1], 0.5, 0.75),
        ];
        let survey = survey(&frames, "density", false, &|| ()).unwrap();
        assert_eq!((survey.origin, survey.dims, survey.density_max), ([-5, -3, 0], [9, 4, 6], 0.75));
        assert_eq!(survey.frames[0].active_voxels, 8);
        assert_eq!(survey.frames[1].dims, [0; 3]);
    }

    #[test]
    fn frames_that_do_not_belong_together_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let f = folder.path();
        let a = frame(f, 1, [0; 3], [2; 3], 0.5, 1.0);
        let message = |frames: &[SequenceFrame]| survey(frames, "density", false, &|| ()).unwrap_err().to_string();
        assert!(message(&[a.clone(), frame(f, 2, [0; 3], [2; 3], 0.25, 1.0)]).contains("a.2.vdb: index-to-world"));
        assert!(message(&[a.clone(), frame(f, 3, [1 << 21, 0, 0], [2; 3], 0.5, 1.0)]).contains("stray voxel"));
        assert!(message(&[a.clone(), frame(f, 4, [0; 3], [2; 3], 0.5, -1.0)]).contains("a.4.vdb: density of grid"));
        assert!(message(&[]).contains("no frames"));
        let clamped = survey(&[a, frame(f, 5, [0; 3], [2; 3], 0.5, f32::NAN)], "density", true, &|| ()).unwrap();
        assert_eq!((clamped.frames[1].clamped.non_finite, clamped.frames[1].density_max), (8, 0.0));
    }
}
