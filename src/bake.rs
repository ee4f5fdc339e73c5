//! `smoke-bake bake INPUT -o PACK`: a sequence of volumes to one pack.

use crate::cli::{AtRest, BakeArgs, GaussianCount, ResidualAddress, TeleportRule};
use crate::progress::Progress;
use crate::seconds::{self, Seconds, Times};
use crate::staging::{SceneChanges, Stage};
use crate::{answer, failure::Failure, inspect};
use serde_json::json;
use smoke_baking::fit::frame::FitSettings;
use smoke_baking::fit::teleport::Rule;
use smoke_baking::pipeline::{self, BakeSettings, Event, OnTransfer, TransferBake, default_promise};
use smoke_baking::residual::tile::ResidualMode;
use smoke_baking::survey::{Survey, survey};
use smoke_baking::transfer::{Stage as TransferStage, TransferSettings};
use smoke_formats::pack::{self, Pack, Promise};
use smoke_formats::sequence::{Sequence, SequenceFrame};
use std::collections::BTreeMap;

/// Finds the frames, reads each once, bakes them, and says what came out.
pub fn run(args: &BakeArgs) -> Result<(), Failure> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads.unwrap_or(0)).build();
    let pool = pool.map_err(|e| Failure::work(format!("--threads: {e}")))?;
    pool.install(|| bake(args))
}

fn bake(args: &BakeArgs) -> Result<(), Failure> {
    let (survey, settings) = prepare(args)?;
    if args.dry_run {
        return plan(args, &survey, &settings);
    }
    let pack = write(args, &survey, &settings)?;
    let times = seconds::read(&pack);
    if args.json {
        answer::json(&inspect::as_json(&pack, times.as_ref())?)
    } else {
        answer::text(&inspect::summary(&pack))
    }
}

/// Bakes as `bake` does, and answers with the pack instead of words. On the current pool of threads.
pub fn pack(args: &BakeArgs) -> Result<Pack, Failure> {
    let (survey, settings) = prepare(args)?;
    write(args, &survey, &settings)
}

/// Reads every frame once.
fn prepare(args: &BakeArgs) -> Result<(Survey, BakeSettings), Failure> {
    let (name, frames) = frames(args)?;
    pipeline::check_output(&args.output, &frames)?;
    let settings = BakeSettings { transfer: transfer(args, &frames)?, ..settings(args, name) };
    settings.fit.bounds().map_err(|e| Failure::work(e.to_string()))?;
    let progress = Progress::start(args.progress, "reading frames", frames.len() as u64);
    let survey = survey(&frames, &args.grid, args.clamp, &|| progress.advance(1))?;
    progress.finish();
    report_clamped(&survey);
    Ok((survey, settings))
}

/// The pack, and the seconds beside it.
fn write(args: &BakeArgs, survey: &Survey, settings: &BakeSettings) -> Result<Pack, Failure> {
    let json = settings_json(args, settings, survey);
    let times = watch(args, survey, settings, |observe, on_transfer| {
        pipeline::bake(survey, settings, &json, &args.output, args.resume, observe, on_transfer)
    })?;
    seconds::write(&args.output, &times)?;
    Ok(Pack::open(&args.output)?)
}

/// The sequence's name and the frames to bake; gaps are told by name.
fn frames(args: &BakeArgs) -> Result<(String, Vec<SequenceFrame>), Failure> {
    let input = args.input.to_str().ok_or_else(|| Failure::work("the input's name is not UTF-8"))?;
    let sequence = Sequence::find(input)?;
    let frames = match &args.frames {
        Some(selection) => sequence.select(selection)?,
        None => {
            for gap in sequence.gaps() {
                eprintln!("smoke-bake: note: missing in the sequence: {}", gap.names);
            }
            sequence.frames().to_vec()
        }
    };
    let file = args.input.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    let name = file.split('.').next().unwrap_or_default().to_owned();
    Ok((name, frames))
}

fn report_clamped(survey: &Survey) {
    for frame in survey.frames.iter().filter(|f| f.clamped != Default::default()) {
        let (bad, negative) = (frame.clamped.non_finite, frame.clamped.negative);
        eprintln!(
            "smoke-bake: note: {}: {bad} voxels not finite and {negative} below zero set to 0",
            frame.path.display()
        );
    }
}

fn settings(args: &BakeArgs, name: String) -> BakeSettings {
    let fit = FitSettings {
        gaussians: args.gaussians as usize,
        radius: [args.radius_min, args.radius_max],
        weight: [args.weight_min, args.weight_max],
        first_evaluations: args.first_evaluations as usize,
        next_evaluations: args.next_evaluations as usize,
        teleport_every: args.teleport_every.into(),
        teleport_rule: match args.teleport_rule {
            TeleportRule::Batch => Rule::Batch,
            TeleportRule::Single => Rule::Single,
        },
        deletions: args.delete as usize,
        insertions: args.insert_max as usize,
        error_ratio: args.rho,
        steady: args.count == GaussianCount::Steady,
        ..FitSettings::default()
    };
    BakeSettings {
        name,
        fit,
        promise: args.max_error.map(Promise::MaxError).or(args.psnr.map(Promise::Psnr)),
        residual: match args.residual {
            ResidualAddress::Hash => ResidualMode::Hash,
            ResidualAddress::Rank => ResidualMode::Rank,
            ResidualAddress::Auto => ResidualMode::Auto,
        },
        at_rest: match args.at_rest {
            AtRest::Compressed => pack::AtRest::SMALLEST,
            AtRest::Raw => pack::AtRest::RAW,
        },
        key_every: args.key_every as usize,
        frames_per_second: args.fps,
        seed: args.seed,
        transfer: None,
    }
}

/// The transfer that is asked for: of the scene's medium, for frames that are baked.
fn transfer(args: &BakeArgs, frames: &[SequenceFrame]) -> Result<Option<TransferBake>, Failure> {
    let (Some(basis), Some(scene)) = (args.transfer, &args.medium) else { return Ok(None) };
    let stage = Stage::read(scene, &SceneChanges::default())?;
    let baked: Vec<i32> = frames.iter().map(|frame| frame.number).collect();
    let chosen = match &args.transfer_frames {
        None => baked,
        Some(selection) => {
            let positions = selection.positions(&args.input, &baked)?;
            positions.into_iter().map(|position| baked[position]).collect()
        }
    };
    let settings = TransferSettings {
        basis,
        medium: stage.medium,
        clusters: args.clusters as usize,
        terms: args.terms as usize,
        photons: args.photons,
        shift: args.transfer_cell,
        seed: args.seed,
        memory: args.memory,
    };
    Ok(Some(TransferBake { settings, frames: chosen, run: args.transfer_run as usize }))
}

/// What the pack keeps of the settings that made it: everything that decides its bytes.
fn settings_json(args: &BakeArgs, settings: &BakeSettings, survey: &Survey) -> String {
    let promise = match settings.promise.unwrap_or_else(|| default_promise(survey)) {
        Promise::MaxError(error) => json!({ "max_error": error }),
        Promise::Psnr(db) => json!({ "psnr_db": db }),
    };
    let mut document = json!({
        "program": concat!("smoke-bake ", env!("CARGO_PKG_VERSION")),
        "grid": args.grid,
        "clamp": args.clamp,
        "fit": settings.fit,
        "promise": promise,
        "residual": settings.residual,
        "at_rest": if args.at_rest == AtRest::Raw { "raw" } else { "compressed" },
        "key_every": settings.key_every,
        "frames_per_second": settings.frames_per_second,
        "seed": settings.seed,
    });
    if let Some(transfer) = &settings.transfer {
        let TransferSettings { basis, medium, clusters, terms, photons, shift, memory, .. } = transfer.settings;
        document["transfer"] = json!({
            "basis": basis.name(),
            "sigma_t": medium.sigma_t,
            "albedo": medium.albedo,
            "g": medium.g,
            "clusters": clusters,
            "terms": terms,
            "photons": photons,
            "cell": 1u32 << shift,
            "memory": memory,
            "run": transfer.run,
            "frames": transfer.frames,
        });
    }
    document.to_string()
}

/// `--dry-run`: what would be baked.
fn plan(args: &BakeArgs, survey: &Survey, settings: &BakeSettings) -> Result<(), Failure> {
    let active: u64 = survey.frames.iter().map(|f| f.active_voxels).sum();
    let document = json!({
        "output": args.output,
        "frames": survey.frames.iter().map(|f| json!({
            "frame": f.number,
            "path": f.path,
            "active_voxels": f.active_voxels,
            "density_max": f.density_max,
        })).collect::<Vec<_>>(),
        "box": { "origin": survey.origin, "dims": survey.dims },
        "density_max": survey.density_max,
        "active_voxels": active,
        "settings": serde_json::from_str::<serde_json::Value>(&settings_json(args, settings, survey)).unwrap_or_default(),
    });
    if args.json {
        return answer::json(&document);
    }
    let (first, last) = (&survey.frames[0], &survey.frames[survey.frames.len() - 1]);
    let text = format!(
        "would bake {} frames ({} to {}) to {}\nbox {:?} from {:?}, {active} active voxels, largest density {}\nsettings {}\n",
        survey.frames.len(),
        first.number,
        last.number,
        args.output.display(),
        survey.dims,
        survey.origin,
        survey.density_max,
        document["settings"],
    );
    answer::text(&text)
}

/// Runs the bake under a progress bar, and gathers the seconds of every frame.
fn watch(
    args: &BakeArgs,
    survey: &Survey,
    settings: &BakeSettings,
    bake: impl FnOnce(&mut dyn FnMut(Event), OnTransfer) -> smoke_baking::Result<()>,
) -> Result<Times, Failure> {
    let runs = settings.transfer.as_ref().map_or(0, |t| t.frames.len().div_ceil(t.run.max(1)));
    let steps = survey.frames.len() + runs;
    let progress = Progress::start(args.progress, "baking frames", steps as u64);
    let on_transfer = |frame: i32, stage: TransferStage, part: f64| {
        let stage = match stage {
            TransferStage::Direct => "direct light",
            TransferStage::Photons => "photons",
            TransferStage::Gather => "gathering",
            TransferStage::Compress => "compressing",
        };
        progress.describe(format!("frame {frame}, transfer, {stage} {:.0} %", 100.0 * part));
    };
    let mut transfer = Vec::new();
    let mut times: BTreeMap<i32, Seconds> = survey.frames.iter().map(|f| (f.number, Seconds::default())).collect();
    let observe = &mut |event| match event {
        Event::Fit { frame, progress: fit } => {
            let (done, most, error) = (fit.evaluations, fit.most, fit.error);
            progress.describe(format!("frame {frame}, evaluation {done}/{most}, error {error:.4}"));
        }
        Event::Frame { record, seconds } => {
            if let Some(seconds) = seconds {
                times.insert(record.frame, seconds);
            }
            progress.describe(format!("frame {}, error {:.4}", record.frame, record.fit_error));
            progress.advance(1);
        }
        Event::Tile { frames, seconds } => {
            let share = seconds / frames.len() as f64;
            frames.iter().for_each(|frame| times.entry(*frame).or_default().hash += share);
        }
        Event::TransferDone { frames, seconds } => {
            transfer.push((frames[0], seconds.unwrap_or_default()));
            progress.advance(1);
        }
    };
    bake(observe, &on_transfer)?;
    progress.finish();
    Ok(Times { frames: times.into_iter().collect(), transfer })
}
