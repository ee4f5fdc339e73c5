//! `smoke-bake unpack PACK -o PATTERN`: the frames of a pack as OpenVDB or Mitsuba volumes.
//!
//! A voxel gets the value of the decoder that `render` uses, on the box of the frame; active is the stored support, and
//! the map is the source's. Float is the default: the promised error holds as it is. Half floats move a value by at
//! most 2^-11 of itself more, which is measured and reported, never silent.
//! Cost: decoding; frames run in parallel, one box each in memory.

use crate::cli::UnpackArgs;
use crate::progress::Progress;
use crate::{answer, failure::Failure};
use clap::error::ErrorKind;
use glam::DAffine3;
use rayon::prelude::*;
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::pack::Pack;
use smoke_formats::sequence::OutputNames;
use smoke_formats::vdb::{self, WriteOptions};
use smoke_formats::volume::DensityGrid;
use smoke_formats::{Error, mitsuba_vol};
use smoke_runtime::medium::decoder;

/// Decodes the frames and writes each to its file.
pub fn run(args: &UnpackArgs) -> Result<(), Failure> {
    let is_vol = args.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("vol"));
    if is_vol && args.half {
        let message = "--half cannot be used with .vol, which is written in full floats\n";
        return Err(clap::Error::raw(ErrorKind::ArgumentConflict, message).into());
    }
    let pack = Pack::open(&args.pack)?;
    let numbers: Vec<i32> = pack.frames().iter().map(|f| f.frame).collect();
    let frames = match &args.frames {
        Some(selection) => selection.positions(&args.pack, &numbers)?,
        None => (0..numbers.len()).collect(),
    };
    let names = OutputNames::new(&args.output, frames.len())?;
    let progress = Progress::start(args.progress, "unpacking frames", frames.len() as u64);
    let write = |&frame: &usize| -> Result<f64, Error> {
        let grid = decode(&pack, frame)?;
        let path = names.path(pack.frames()[frame].frame);
        if is_vol {
            mitsuba_vol::write(&path, &grid)?;
        } else {
            vdb::write(&path, &grid, &WriteOptions { half: args.half, zip: true })?;
        }
        progress.advance(1);
        Ok(if args.half { vdb::half_rounding(&grid) } else { 0.0 })
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build();
    let pool = pool.map_err(|e| Failure::work(format!("--threads: {e}")))?;
    let rounding = pool.install(|| frames.par_iter().map(write).collect::<Result<Vec<f64>, Error>>())?;
    progress.finish();

    let max_error = frames.iter().fold(0.0, |most: f64, &f| most.max(pack.frames()[f].max_error));
    let rounding = rounding.into_iter().fold(0.0, f64::max);
    let mut text = format!("{} volumes; no voxel is off by more than {max_error:.6e}", frames.len());
    if args.half {
        text += &format!(" in the pack, and half floats add at most {rounding:.6e}: {:.6e}", max_error + rounding);
    }
    answer::text(&(text + "\n"))
}

/// Frame `frame` (counted from 0) as a volume with the source's grid name and map.
pub fn decode(pack: &Pack, frame: usize) -> Result<DensityGrid, Error> {
    let (sequence, record) = (pack.sequence(), &pack.frames()[frame]);
    let gaussians = pack.gaussians(frame)?;
    let residual = pack.residual(frame)?.codes()?;
    let space = UnitSpace::of_box(sequence.origin, sequence.dims);
    let values = decoder::decode(&gaussians, &residual, record.step, &space);
    Ok(DensityGrid {
        name: sequence.grid.clone(),
        origin: residual.origin,
        dims: residual.dims.map(|d| d as usize),
        values,
        active: residual.support,
        world_from_index: DAffine3::from_cols_array(&sequence.world_from_index),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::ProgressMode;
    use crate::testing::small_pack;
    use smoke_formats::volume;
    use std::path::Path;

    fn unpack(folder: &Path, output: &str, frames: Option<&str>, half: bool) -> Result<(), Failure> {
        let (pack, output) = (folder.join("small.smoke"), folder.join(output));
        let frames = frames.map(|f| f.parse().unwrap());
        run(&UnpackArgs { pack, output, frames, half, threads: Some(2), progress: ProgressMode::None })
    }

    fn folder(frames: &[i32]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        small_pack(&folder.path().join("small.smoke"), frames, 0.01);
        folder
    }

    #[test]
    fn a_volume_holds_the_decoded_voxels_the_support_and_the_exact_map() {
        let folder = folder(&[8, 9]);
        unpack(folder.path(), "out.####.vdb", None, false).unwrap();
        unpack(folder.path(), "out.##.vol", Some("9"), false).unwrap();
        let pack = Pack::open(&folder.path().join("small.smoke")).unwrap();
        let expected = decode(&pack, 1).unwrap();
        let vdb = volume::read(&folder.path().join("out.0009.vdb"), "density").unwrap();
        assert_eq!((vdb.world_from_index, vdb.active.count()), (expected.world_from_index, 12));
        let vol = volume::read(&folder.path().join("out.09.vol"), "density").unwrap();
        for v in 0..expected.len() {
            let found = vdb.voxel(expected.index(v).map(|i| i as i32));
            let (value, active) = found.map_or((0.0, false), |f| (vdb.values[f], vdb.active.get(f)));
            assert_eq!((value.to_bits(), active), (expected.values[v].to_bits(), expected.active.get(v)));
            assert_eq!(vol.values[v].to_bits(), expected.values[v].to_bits());
        }
        assert!(!folder.path().join("out.08.vol").exists());
    }

    #[test]
    fn half_floats_stay_within_the_error_that_is_reported_for_them() {
        let folder = folder(&[8]);
        unpack(folder.path(), "half.vdb", None, true).unwrap();
        let pack = Pack::open(&folder.path().join("small.smoke")).unwrap();
        let exact = decode(&pack, 0).unwrap();
        let half = volume::read(&folder.path().join("half.vdb"), "density").unwrap();
        let error = |v: usize| {
            let found = half.voxel(exact.index(v).map(|i| i as i32)).map_or(0.0, |f| half.values[f]);
            (f64::from(found) - f64::from(exact.values[v])).abs()
        };
        let most = (0..exact.len()).map(error).fold(0.0, f64::max);
        assert!(most > 0.0 && most == vdb::half_rounding(&exact), "{most}");
    }

    #[test]
    fn wrong_selections_and_names_are_told_apart_from_bad_input() {
        let folder = folder(&[8, 9]);
        let usage = |r: Result<(), Failure>| matches!(r, Err(Failure::Usage(_)));
        assert!(usage(unpack(folder.path(), "a.####.vol", None, true)));
        let work = |r: Result<(), Failure>| match r {
            Err(Failure::Work(message)) => message,
            other => panic!("{other:?}"),
        };
        assert!(work(unpack(folder.path(), "a.####.vdb", Some("10"), false)).contains("frame 10"));
        assert!(work(unpack(folder.path(), "a.vdb", None, false)).contains("one name for 2 frames"));
    }
}
