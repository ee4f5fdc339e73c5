//! The bake: a surveyed sequence to a pack, frame after frame.
//!
//! Each frame starts from the Gaussians of the one before *as they lie in the pack*, so the state of a bake is what is
//! already written: an interrupted one goes on from its work folder and ends with the same bytes.
//! Memory: one frame, and the codes of one tile of 27 frames where a hash is to be tried.

use crate::fit::frame::{Fit, FitProgress, FitSettings, fit_first, fit_next, reference_error};
use crate::residual::quantise::{Target, quantise};
use crate::residual::tile::{ResidualMode, choose};
use crate::survey::{Survey, SurveyedFrame, hash_file, read_density};
use crate::transfer::at_rest::to_pack;
use crate::transfer::{Stage, TransferSeconds, TransferSettings, bake_run};
use crate::work::Work;
use crate::{Error, Result};
use rayon::prelude::*;
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::pack::{
    self, AtRest, Codec, EncodedFrame, EncodedTransfer, FrameData, FrameRecord, Promise, SequenceRecord,
    SettingsRecord, TransferFrameRecord, TransferRecord,
};
use smoke_formats::residual::ResidualCodes;
use smoke_formats::residual::hash::{HashTable, MAX_FRAMES};
use smoke_formats::sequence::SequenceFrame;
use smoke_formats::volume::DensityGrid;
use smoke_runtime::medium::decoder::decode_field;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::gaussian_sum::gaussian_sum;
use smoke_runtime::sphere::light_basis::LightBasis;
use std::path::Path;
use std::time::Instant;

/// Everything that decides the bytes of a pack, besides the frames themselves.
#[derive(Clone, Debug, PartialEq)]
pub struct BakeSettings {
    /// Name of the sequence, for people.
    pub name: String,
    /// The fit.
    pub fit: FitSettings,
    /// What is promised; none is [`default_promise`].
    pub promise: Option<Promise>,
    /// The residual's resident layout.
    pub residual: ResidualMode,
    /// Sections coded, or raw to be mapped.
    pub at_rest: AtRest,
    /// Every how many frames one stands alone at rest; those between are coded after the one before. 1 to 64.
    pub key_every: usize,
    /// Frames a second, if known.
    pub frames_per_second: Option<f64>,
    /// Seed of the search for hashes.
    pub seed: u64,
    /// Transfer, if it is wanted.
    pub transfer: Option<TransferBake>,
}

/// What transfer is baked, and for which frames.
#[derive(Clone, Debug, PartialEq)]
pub struct TransferBake {
    /// The transfer of a frame.
    pub settings: TransferSettings,
    /// Source numbers of the frames that get one, ascending; each a frame of the sequence.
    pub frames: Vec<i32>,
    /// Frames in a row that share bases, at least 1.
    pub run: usize,
}

impl TransferBake {
    /// What the pack says of it.
    fn record(&self, frames: Vec<TransferFrameRecord>) -> TransferRecord {
        let TransferSettings { basis, medium, photons, shift, seed, .. } = self.settings;
        TransferRecord {
            sigma_t: medium.sigma_t,
            albedo: medium.albedo,
            g: medium.g,
            bands: self.settings.bands() as u32,
            cell_shift: shift,
            photons,
            seed,
            direct_of_channel: self.settings.extinctions().1.map(|set| set as u32),
            indirect_of_channel: self.settings.media().1.map(|set| set as u32),
            basis: basis.name(),
            frames,
        }
    }
}

/// 8 bits: no voxel is further off than 1/510 of the sequence's largest density.
pub fn default_promise(survey: &Survey) -> Promise {
    // An empty sequence has no scale of its own; any promise holds.
    let peak = if survey.density_max > 0.0 { f64::from(survey.density_max) } else { 1.0 };
    Promise::MaxError(peak / 510.0)
}

/// Seconds that a frame took, by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Deserialize, serde::Serialize)]
pub struct Seconds {
    /// Reading and checking the source.
    pub read: f64,
    /// Fitting Gaussians.
    pub fit: f64,
    /// Summing them and quantising what they miss.
    pub residual: f64,
    /// Laying out the codes: ranks, and the frame's share of its tile's hash.
    pub hash: f64,
    /// Coding and writing.
    pub write: f64,
}

/// What a bake tells while it works.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A fit goes on.
    Fit {
        /// Frame number.
        frame: i32,
        /// Where it is.
        progress: FitProgress,
    },
    /// A frame is done.
    Frame {
        /// What is known of it; sizes of the hash come later.
        record: FrameRecord,
        /// How long it took, in whichever bake; none if that was not kept.
        seconds: Option<Seconds>,
    },
    /// The transfer of a run of frames is done.
    TransferDone {
        /// Frames of the run.
        frames: Vec<i32>,
        /// How long it took, in whichever bake; none if that was not kept.
        seconds: Option<TransferSeconds>,
    },
    /// A tile of frames is laid out: its share of seconds goes to each frame's `hash`.
    Tile {
        /// Frames of the tile.
        frames: Vec<i32>,
        /// Seconds for all of them.
        seconds: f64,
    },
}

/// Fails, before anything is read, if `output` cannot be what the bake writes: one of its own sources, a folder or a
/// device, or in a folder that is not there.
pub fn check_output(output: &Path, frames: &[SequenceFrame]) -> Result<()> {
    let fail = |found, expected| Err(Error::Output { path: output.to_owned(), found, expected });
    if output.file_name().is_none() {
        return fail("no file name", "the name of a file");
    }
    let parent = output.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if !parent.is_dir() {
        return fail("a folder that does not exist", "a name in a folder that does");
    }
    if std::fs::metadata(output).is_ok_and(|m| !m.is_file()) {
        return fail("a folder or a device", "a regular file or a new name");
    }
    let Ok(place) = output.canonicalize() else { return Ok(()) };
    match frames.iter().any(|frame| frame.path.canonicalize().is_ok_and(|source| source == place)) {
        true => fail("a frame of the sequence itself", "another file"),
        false => Ok(()),
    }
}

/// Told where the transfer of a run is, from any thread: its first frame, the stage, and how far, from 0 to 1.
pub type OnTransfer<'a> = &'a (dyn Fn(i32, Stage, f64) + Sync);

/// Bakes a surveyed sequence to the file `output`.
///
/// `settings_json` is the JSON document that the pack keeps of its settings. With `resume`, frames that an interrupted
/// bake of the same settings and sources finished are taken over.
pub fn bake(
    survey: &Survey,
    settings: &BakeSettings,
    settings_json: &str,
    output: &Path,
    resume: bool,
    observe: &mut dyn FnMut(Event),
    on_transfer: OnTransfer,
) -> Result<()> {
    let work = Work::open(output, &fingerprint(survey, settings_json), resume)?;
    let space = UnitSpace::of_box(survey.origin, survey.dims);
    let promise = settings.promise.unwrap_or_else(|| default_promise(survey));
    let target = match promise {
        Promise::MaxError(error) => Target::MaxError(error),
        Promise::Psnr(db) => Target::Psnr { db, peak: survey.density_max },
    };
    let mut before: Option<Before> = None;
    for (number, frame) in survey.frames.iter().enumerate() {
        // What lies at rest after the frame before needs that frame's codes; a key frame needs none.
        let codes_before = match &before {
            Some(b) if number % settings.key_every != 0 => Some(b.encoded.codes(output)?),
            _ => None,
        };
        let encoded = match work.load(frame.number) {
            Some(done) => {
                observe(Event::Frame { record: *done.record(), seconds: work.load_seconds(frame.number) });
                done
            }
            None => {
                let (encoded, seconds) = bake_frame(
                    survey,
                    frame,
                    &space,
                    settings,
                    target,
                    before.as_ref(),
                    codes_before,
                    output,
                    observe,
                )?;
                let start = Instant::now();
                work.store(&encoded)?;
                let seconds = Seconds { write: seconds.write + start.elapsed().as_secs_f64(), ..seconds };
                work.store_seconds(frame.number, &seconds)?;
                observe(Event::Frame { record: *encoded.record(), seconds: Some(seconds) });
                encoded
            }
        };
        let least = before.as_ref().map_or(f64::INFINITY, |b| b.reference);
        let reference = reference_error(least, encoded.record().fit_error);
        before = Some(Before { gaussians: encoded.decode_gaussians(output)?, reference, encoded });
    }
    let sequence = SequenceRecord {
        world_from_index: survey.world_from_index.to_cols_array(),
        origin: survey.origin,
        dims: survey.dims,
        density_max: survey.density_max,
        promise,
        frames_per_second: settings.frames_per_second,
        name: settings.name.clone(),
        grid: survey.grid.clone(),
    };
    if let Some(transfer) = &settings.transfer {
        bake_transfer(survey, transfer, &space, &work, output, observe, on_transfer)?;
    }
    assemble(survey, settings, settings_json, &sequence, &work, observe)?;
    work.finish(output)
}

/// The transfer of every run of frames, against the density as it lies in the pack.
fn bake_transfer(
    survey: &Survey,
    transfer: &TransferBake,
    space: &UnitSpace,
    work: &Work,
    output: &Path,
    observe: &mut dyn FnMut(Event),
    on_transfer: OnTransfer,
) -> Result<()> {
    let kind = transfer.settings.basis;
    let bases = [LightBasis::new(kind), LightBasis::new(kind.coarser())];
    for frames in transfer.frames.chunks(transfer.run.max(1)) {
        if frames.iter().all(|&frame| work.load_transfer(frame).is_some()) {
            let seconds = work.load_transfer_seconds(frames[0]);
            observe(Event::TransferDone { frames: frames.to_vec(), seconds });
            continue;
        }
        let mut fields = Vec::with_capacity(frames.len());
        for &frame in frames {
            let encoded = work.load(frame).ok_or_else(|| Error::Changed { path: output.to_owned() })?;
            let (gaussians, codes) = (encoded.decode_gaussians(output)?, encoded.codes(output)?);
            let step = encoded.record().step;
            fields.push(decode_field(&gaussians, &codes, step, space, survey.world_from_index));
        }
        let fields: Vec<&DensityField> = fields.iter().collect();
        let tell = |stage, done: u64, all: u64| on_transfer(frames[0], stage, done as f64 / all.max(1) as f64);
        let run = bake_run(&fields, [&bases[0], &bases[1]], &transfer.settings, &tell);
        let position = |frame: &i32| survey.frames.iter().position(|f| f.number == *frame).unwrap_or_default();
        let numbers: Vec<usize> = frames.iter().map(position).collect();
        let (bases, rows) = to_pack(&run, &numbers);
        // Last frame first: the run is there once the frame that brings the bases is.
        for ((record, rows), &frame) in rows.iter().zip(frames).rev() {
            let bases = (frame == frames[0]).then_some(&bases);
            work.store_transfer(frame, &EncodedTransfer::new(output, record, rows, bases, Codec::Raw)?)?;
        }
        work.store_transfer_seconds(frames[0], &run.seconds)?;
        observe(Event::TransferDone { frames: frames.to_vec(), seconds: Some(run.seconds) });
    }
    Ok(())
}

/// What a later frame needs of the ones before it.
struct Before {
    gaussians: Vec<Gaussian>,
    /// The error that the rule for insertions compares with.
    reference: f64,
    encoded: EncodedFrame,
}

#[expect(clippy::too_many_arguments, reason = "one call; the frame's own part of `bake`")]
fn bake_frame(
    survey: &Survey,
    frame: &SurveyedFrame,
    space: &UnitSpace,
    settings: &BakeSettings,
    target: Target,
    before: Option<&Before>,
    codes_before: Option<ResidualCodes>,
    output: &Path,
    observe: &mut dyn FnMut(Event),
) -> Result<(EncodedFrame, Seconds)> {
    let mut clock = Clock(Instant::now());
    let mut seconds = Seconds::default();
    if hash_file(&frame.path)? != frame.source_hash {
        return Err(Error::Changed { path: frame.path.clone() });
    }
    let (density, _) = read_density(&frame.path, &survey.grid, survey.clamp)?;
    seconds.read = clock.lap();

    let mut progress = |progress| observe(Event::Fit { frame: frame.number, progress });
    let fit = match before {
        None => fit_first(&density, space, &settings.fit, &mut progress),
        Some(b) => fit_next(&density, space, &b.gaussians, b.reference, &settings.fit, &mut progress),
    };
    let Fit { gaussians, .. } = fit.map_err(|source| Error::Fit { path: frame.path.clone(), source })?;
    seconds.fit = clock.lap();

    // Rounded to what the pack stores, in its order, before the residual is taken against them.
    let gaussians = pack::snap_gaussians(output, &gaussians)?;
    let sum = gaussian_sum(&gaussians, space, density.origin, density.dims);
    let quantised = quantise(&density, &sum, target);
    let quantised = quantised.map_err(|source| Error::Quantise { path: frame.path.clone(), source })?;
    let record = FrameRecord {
        frame: frame.number,
        fit_error: fit_error(&density, &sum),
        max_error: quantised.max_error,
        psnr_db: quantised.psnr_db,
        step: quantised.step,
        source_hash: frame.source_hash,
        ..FrameRecord::default()
    };
    seconds.residual = clock.lap();

    let data = FrameData { record, gaussians: &gaussians, codes: &quantised.codes };
    let encoded = EncodedFrame::new(output, &data, settings.at_rest, codes_before.as_ref())?;
    seconds.write = clock.lap();
    Ok((encoded, seconds))
}

/// `sum (D - S)^2 / sum D^2` over all voxels of the frame's box; 0 for an empty one.
fn fit_error(density: &DensityGrid, sum: &[f32]) -> f64 {
    let pairs = density.values.iter().zip(sum);
    let (error, energy) = pairs.fold((0.0, 0.0), |(error, energy), (&d, &s)| {
        let (d, e) = (f64::from(d), f64::from(d) - f64::from(s));
        (error + e * e, energy + d * d)
    });
    if energy > 0.0 { error / energy } else { 0.0 }
}

/// Puts the pack together, tile by tile.
fn assemble(
    survey: &Survey,
    settings: &BakeSettings,
    settings_json: &str,
    sequence: &SequenceRecord,
    work: &Work,
    observe: &mut dyn FnMut(Event),
) -> Result<()> {
    let path = work.pack_file();
    let mut failed = None;
    let written = pack::write(&path, |mut writer| {
        for tile in survey.frames.chunks(MAX_FRAMES) {
            let start = Instant::now();
            let mut frames = vec![];
            for frame in tile {
                match work.load(frame.number) {
                    Some(encoded) => frames.push(encoded),
                    None => {
                        failed = Some(Error::Changed { path: path.clone() });
                        return Err(smoke_formats::Error::invalid(&path, "work", "a frame lost", "all frames"));
                    }
                }
            }
            match lay_out(&path, &mut frames, settings)? {
                None => frames.iter().try_for_each(|frame| writer.push_encoded(frame))?,
                Some((table, codes)) => {
                    let gaussians =
                        frames.iter().map(|f| f.decode_gaussians(&path)).collect::<smoke_formats::Result<Vec<_>>>()?;
                    let data = |i: usize| FrameData {
                        record: *frames[i].record(),
                        gaussians: &gaussians[i],
                        codes: &codes[i],
                    };
                    let tile: Vec<FrameData> = (0..frames.len()).map(data).collect();
                    writer.push_tile(&tile, &table, settings.at_rest)?;
                }
            }
            let seconds = start.elapsed().as_secs_f64();
            observe(Event::Tile { frames: tile.iter().map(|f| f.number).collect(), seconds });
        }
        let transfer = match &settings.transfer {
            None => None,
            Some(transfer) => {
                let mut records = vec![];
                for frames in transfer.frames.chunks(transfer.run.max(1)) {
                    let mut span = 0;
                    let mut run = vec![];
                    for &frame in frames {
                        let Some(encoded) = work.load_transfer(frame) else {
                            failed = Some(Error::Changed { path: path.clone() });
                            return Err(smoke_formats::Error::invalid(&path, "work", "transfer lost", "all of it"));
                        };
                        span = 1 + (encoded.record().frame - encoded.record().first_of_run) as usize;
                        run.push(encoded);
                    }
                    for encoded in &run {
                        writer.push_encoded_transfer(span, encoded)?;
                        records.push(*encoded.record());
                    }
                }
                Some(transfer.record(records))
            }
        };
        writer.finish(sequence, &SettingsRecord { json: settings_json.to_owned() }, transfer.as_ref())
    });
    match failed {
        Some(error) => Err(error),
        None => Ok(written.map(drop)?),
    }
}

/// The hash of a tile and its codes, where it is wanted or smaller; none for ranks, which lie ready.
fn lay_out(
    path: &Path,
    frames: &mut [EncodedFrame],
    settings: &BakeSettings,
) -> smoke_formats::Result<Option<(HashTable, Vec<ResidualCodes>)>> {
    if settings.residual == ResidualMode::Rank {
        return Ok(None);
    }
    let codes = frames.par_iter().map(|f| f.codes(path)).collect::<smoke_formats::Result<Vec<_>>>()?;
    let layout = choose(path, &codes, settings.residual, settings.seed)?;
    if let Some(bytes) = layout.hash_bytes {
        let share = bytes / frames.len() as u64;
        frames.iter_mut().for_each(|frame| frame.set_hash_bytes(share));
    }
    Ok(layout.hash.map(|table| (table, codes)))
}

/// Text that is the same exactly when the same bake would give the same pack.
fn fingerprint(survey: &Survey, settings_json: &str) -> String {
    let hex = |hash: &[u8; 16]| hash.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let frames: Vec<String> = survey.frames.iter().map(|f| format!("{} {}", f.number, hex(&f.source_hash))).collect();
    let version = env!("CARGO_PKG_VERSION");
    format!("smoke-bake {version}\n{settings_json}\n{}\nclamp {}\n{}\n", survey.grid, survey.clamp, frames.join("\n"))
}

/// Time since the last lap.
struct Clock(Instant);

impl Clock {
    fn lap(&mut self) -> f64 {
        let now = Instant::now();
        let seconds = now.duration_since(self.0).as_secs_f64();
        self.0 = now;
        seconds
    }
}
