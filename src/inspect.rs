//! `smoke-bake inspect PACK`: what is in a pack, as one table or one JSON document.
//!
//! Reads header and records only, not the frames: a thousand frames take milliseconds. Nothing is decoded, so figures
//! are those that the bake measured; `validate` reads every byte.

use crate::cli::InspectArgs;
use crate::seconds::{self, Seconds, Times, TransferSeconds};
use crate::{answer, failure::Failure};
use serde_json::{Value, json};
use smoke_formats::Error;
use smoke_formats::pack::container::VERSION;
use smoke_formats::pack::{FrameRecord, Pack, Promise, ResidualKind, TransferFrameRecord, TransferRecord};
use std::fmt::Write;

/// Opens the pack and prints what it says.
pub fn run(args: &InspectArgs) -> Result<(), Failure> {
    let pack = Pack::open(&args.pack)?;
    let times = seconds::read(&pack);
    match args.json {
        true => answer::json(&as_json(&pack, times.as_ref())?),
        false => answer::text(&as_text(&pack, times.map(|t| of_frames(&t)))),
    }
}

/// Sums, means and extremes over the frames.
struct Totals {
    active_voxels: u64,
    rbfs: u64,
    bytes_at_rest: u64,
    bytes_resident: u64,
    mean_fit_error: f64,
    max_error: f64,
    mean_psnr_db: f64,
    min_psnr_db: f64,
}

impl Totals {
    fn of(frames: &[FrameRecord]) -> Self {
        let sum = |field: fn(&FrameRecord) -> u64| frames.iter().map(field).sum::<u64>();
        // No frames: the mean is not a number, shown as null or a dash.
        let mean = |field: fn(&FrameRecord) -> f64| frames.iter().map(field).sum::<f64>() / frames.len() as f64;
        Self {
            active_voxels: sum(|f| f.active_voxels),
            rbfs: sum(|f| f.gaussians.into()),
            bytes_at_rest: sum(|f| f.bytes_at_rest),
            bytes_resident: sum(|f| f.bytes_resident),
            mean_fit_error: mean(|f| f.fit_error),
            max_error: frames.iter().fold(0.0, |most, f| f.max_error.max(most)),
            mean_psnr_db: mean(|f| f.psnr_db),
            min_psnr_db: frames.iter().fold(f64::INFINITY, |least, f| f.psnr_db.min(least)),
        }
    }

    fn bits_a_voxel(&self, bytes: u64) -> f64 {
        8.0 * bytes as f64 / self.active_voxels as f64
    }
}

/// Sums and largest errors over the frames with transfer.
struct TransferTotals {
    bytes_at_rest: u64,
    bytes_resident: u64,
    raw_bytes: u64,
    direct_error: f64,
    indirect_error: f64,
    truncated: f64,
}

impl TransferTotals {
    fn of(record: &TransferRecord) -> Self {
        // Saturating: a record may claim any number of bytes.
        let sum = |field: fn(&TransferFrameRecord) -> u64| record.frames.iter().map(field).fold(0, u64::saturating_add);
        let most = |field: fn(&TransferFrameRecord) -> f64| record.frames.iter().map(field).fold(0.0, f64::max);
        Self {
            bytes_at_rest: sum(|f| f.bytes_at_rest),
            bytes_resident: sum(|f| f.bytes_resident),
            raw_bytes: sum(|f| f.raw_bytes),
            direct_error: most(|f| f.direct_error),
            indirect_error: most(|f| f.indirect_error),
            truncated: most(|f| f.truncated),
        }
    }
}

fn of_frames(times: &Times) -> Vec<Seconds> {
    times.frames.iter().map(|(_, seconds)| *seconds).collect()
}

/// Sums over the runs, and the largest memory.
fn total_transfer_seconds(times: &Times) -> TransferSeconds {
    times.transfer.iter().fold(TransferSeconds::default(), |sum, (_, s)| TransferSeconds {
        direct: sum.direct + s.direct,
        photons: sum.photons + s.photons,
        compress: sum.compress + s.compress,
        peak_bytes: sum.peak_bytes.max(s.peak_bytes),
    })
}

fn total_seconds(frames: &[Seconds]) -> Seconds {
    frames.iter().fold(Seconds::default(), |sum, s| Seconds {
        read: sum.read + s.read,
        fit: sum.fit + s.fit,
        residual: sum.residual + s.residual,
        hash: sum.hash + s.hash,
        write: sum.write + s.write,
    })
}

fn residual_name(kind: ResidualKind) -> &'static str {
    match kind {
        ResidualKind::Rank => "rank",
        ResidualKind::Hash => "hash",
    }
}

/// The document of `--json`; `bake --json` prints the same of the pack it wrote.
pub fn as_json(pack: &Pack, times: Option<&Times>) -> Result<Value, Failure> {
    let seconds = times.map(of_frames);
    let seconds = seconds.as_deref();
    let (sequence, totals) = (pack.sequence(), Totals::of(pack.frames()));
    // The reader has seen that it is JSON; numbers beyond f64 could still fail here.
    let settings: Value = serde_json::from_str(&pack.settings().json)
        .map_err(|e| Error::invalid(pack.path(), "settings.json", e, "a JSON document"))?;
    let promise = match sequence.promise {
        Promise::MaxError(v) => json!({ "max_error": v }),
        Promise::Psnr(v) => json!({ "psnr_db": v }),
    };
    let frames = pack.frames().iter().enumerate().map(|(i, f)| {
        json!({
            "frame": f.frame,
            "active_voxels": f.active_voxels,
            "rbfs": f.gaussians,
            "fit_error": f.fit_error,
            "max_error": f.max_error,
            "psnr_db": f.psnr_db,
            "bytes_at_rest": f.bytes_at_rest,
            "bytes_resident": f.bytes_resident,
            "seconds": seconds.map(|s| s[i]),
            "residual": residual_name(f.residual),
            "rank_bytes": f.rank_bytes,
            "hash_bytes": f.hash_bytes,
            "step": f.step,
            "box": { "origin": f.origin, "dims": f.dims },
        })
    });
    Ok(json!({
        "pack": pack.path(),
        "format_version": VERSION,
        "sequence": {
            "name": sequence.name,
            "grid": sequence.grid,
            "frames": pack.frames().len(),
            "first_frame": pack.frames().first().map(|f| f.frame),
            "last_frame": pack.frames().last().map(|f| f.frame),
            "frames_per_second": sequence.frames_per_second,
            "box": { "origin": sequence.origin, "dims": sequence.dims },
            "world_from_index": sequence.world_from_index,
            "density_max": sequence.density_max,
            "promise": promise,
        },
        "settings": settings,
        "frames": frames.collect::<Vec<_>>(),
        "totals": {
            "frames": pack.frames().len(),
            "active_voxels": totals.active_voxels,
            "rbfs": totals.rbfs,
            "fit_error_mean": totals.mean_fit_error,
            "max_error": totals.max_error,
            "psnr_db_mean": totals.mean_psnr_db,
            "psnr_db_min": totals.min_psnr_db,
            "bytes_at_rest": totals.bytes_at_rest,
            "bytes_resident": totals.bytes_resident,
            "bits_per_active_voxel_at_rest": totals.bits_a_voxel(totals.bytes_at_rest),
            "bits_per_active_voxel_resident": totals.bits_a_voxel(totals.bytes_resident),
            "file_bytes": pack.file_bytes(),
            "seconds": seconds.map(total_seconds),
        },
        "transfer": pack.transfer().map(|record| transfer_json(pack, record, times)),
    }))
}

/// The part on precomputed transfer; frames are told by the source's numbers.
fn transfer_json(pack: &Pack, record: &TransferRecord, times: Option<&Times>) -> Value {
    let times = times.filter(|t| !t.transfer.is_empty()).map(total_transfer_seconds);
    let totals = TransferTotals::of(record);
    let number = |frame: u32| pack.frames()[frame as usize].frame;
    let frames = record.frames.iter().map(|f| {
        json!({
            "frame": number(f.frame),
            "first_of_run": number(f.first_of_run),
            "voxels": f.voxels,
            "cells": f.cells,
            "compression_error": { "direct": f.direct_error, "indirect": f.indirect_error },
            "truncated": f.truncated,
            "raw_bytes": f.raw_bytes,
            "bytes_at_rest": f.bytes_at_rest,
            "bytes_resident": f.bytes_resident,
        })
    });
    json!({
        "basis": record.basis,
        "frames": record.frames.iter().map(|f| number(f.frame)).collect::<Vec<_>>(),
        "medium": { "sigma_t": record.sigma_t, "albedo": record.albedo, "g": record.g },
        "bands": record.bands,
        "cell_shift": record.cell_shift,
        "photons": record.photons,
        "bytes_at_rest": totals.bytes_at_rest,
        "bytes_resident": totals.bytes_resident,
        "raw_bytes": totals.raw_bytes,
        "compression_error": { "direct": totals.direct_error, "indirect": totals.indirect_error },
        "truncated": totals.truncated,
        "seconds": times.map(|t| json!({ "direct": t.direct, "photons": t.photons, "compress": t.compress })),
        "peak_bytes": times.map(|t| t.peak_bytes),
        "per_frame": frames.collect::<Vec<_>>(),
    })
}

/// One line: what `bake` says of the pack it wrote.
pub fn summary(pack: &Pack) -> String {
    let totals = Totals::of(pack.frames());
    format!(
        "{}: {} frames, {} bytes, {} bits an active voxel at rest, {} resident; no voxel is off by more than {}\n",
        pack.path().display(),
        pack.frames().len(),
        pack.file_bytes(),
        number(totals.bits_a_voxel(totals.bytes_at_rest), 2),
        number(totals.bits_a_voxel(totals.bytes_resident), 2),
        small(totals.max_error),
    )
}

fn as_text(pack: &Pack, seconds: Option<Vec<Seconds>>) -> String {
    let (sequence, frames, totals) = (pack.sequence(), pack.frames(), Totals::of(pack.frames()));
    let [nx, ny, nz] = sequence.dims;
    let count = match (frames.first(), frames.last()) {
        (Some(first), Some(last)) => format!("{} frames from {} to {}", frames.len(), first.frame, last.frame),
        _ => "no frames".into(),
    };
    let promise = match sequence.promise {
        Promise::MaxError(v) => format!("no voxel off by more than {v}"),
        Promise::Psnr(v) => format!("PSNR of {v} dB or more"),
    };
    // A name comes from a file: control characters must not reach the terminal.
    let grid = sequence.grid.escape_debug();
    let mut out = format!("{}: {count}, grid '{grid}', {nx} x {ny} x {nz} voxels\n", pack.path().display());
    // Writing to a String cannot fail, here and below.
    let _ = writeln!(out, "promise: {promise}; largest density {}\n", sequence.density_max);

    let mut header = ["frame", "voxels", "rbfs", "fit error", "max error", "PSNR dB"].map(str::to_owned).to_vec();
    header.extend(["at rest", "resident", "bits/voxel", "layout"].map(str::to_owned));
    if seconds.is_some() {
        header.extend(["read s", "fit s", "residual s", "hash s", "write s"].map(str::to_owned));
    }
    let mut rows = vec![header];
    let bits = |bytes: u64, voxels: u64| number(8.0 * bytes as f64 / voxels as f64, 2);
    for (i, f) in frames.iter().enumerate() {
        let mut row = vec![f.frame.to_string(), f.active_voxels.to_string(), f.gaussians.to_string()];
        row.extend([small(f.fit_error), small(f.max_error), number(f.psnr_db, 2)]);
        row.extend([f.bytes_at_rest.to_string(), f.bytes_resident.to_string()]);
        row.extend([bits(f.bytes_at_rest, f.active_voxels), residual_name(f.residual).to_owned()]);
        row.extend(seconds.iter().flat_map(|s| stages(&s[i])));
        rows.push(row);
    }
    let mut last = vec!["all".into(), totals.active_voxels.to_string(), totals.rbfs.to_string()];
    last.extend([small(totals.mean_fit_error), small(totals.max_error), number(totals.mean_psnr_db, 2)]);
    last.extend([totals.bytes_at_rest.to_string(), totals.bytes_resident.to_string()]);
    last.extend([bits(totals.bytes_at_rest, totals.active_voxels), String::new()]);
    last.extend(seconds.iter().flat_map(|s| stages(&total_seconds(s))));
    rows.push(last);
    out += &table(&rows);
    let _ = write!(
        out,
        "\nall: sums; fit error and PSNR are means, max error is the largest, the lowest PSNR is {} dB\n\
         file: {} bytes; {} bits an active voxel at rest, {} resident\n",
        number(totals.min_psnr_db, 2),
        pack.file_bytes(),
        bits(totals.bytes_at_rest, totals.active_voxels),
        bits(totals.bytes_resident, totals.active_voxels),
    );
    if let Some(record) = pack.transfer() {
        let totals = TransferTotals::of(record);
        let _ = writeln!(
            out,
            "transfer: {} of {} frames, basis {}, sigma_t {:?}, albedo {:?}, g {}; {} bytes at rest, {} resident; \
             compression is off by {} direct, {} indirect at most",
            record.frames.len(),
            frames.len(),
            record.basis,
            record.sigma_t,
            record.albedo,
            record.g,
            totals.bytes_at_rest,
            totals.bytes_resident,
            small(totals.direct_error),
            small(totals.indirect_error),
        );
    }
    out
}

fn stages(s: &Seconds) -> [String; 5] {
    [s.read, s.fit, s.residual, s.hash, s.write].map(|v| number(v, 3))
}

fn number(v: f64, digits: usize) -> String {
    if v.is_finite() { format!("{v:.digits$}") } else { "-".into() }
}

fn small(v: f64) -> String {
    if v.is_finite() { format!("{v:.3e}") } else { "-".into() }
}

/// Columns as wide as their widest entry, set to the right, two spaces between.
fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |c: usize| rows.iter().map(|row| row[c].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, &w)| format!("{cell:>w$}")).collect();
        cells.join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{small_pack, small_pack_with_transfer};
    use smoke_formats::pack::container::{KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS};
    use smoke_formats::pack::validate;

    fn packed(frames: &[i32]) -> (tempfile::TempDir, Pack) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("small.smoke");
        small_pack(&path, frames, 0.01);
        let pack = Pack::open(&path).unwrap();
        (folder, pack)
    }

    #[test]
    fn totals_are_the_sums_and_extremes_of_the_frames() {
        let (_folder, pack) = packed(&[3, 5]);
        let stage = Seconds { read: 1.0, fit: 2.0, residual: 3.0, hash: 4.0, write: 5.0 };
        let times = Times { frames: vec![(1, stage), (2, stage)], transfer: vec![] };
        let json = as_json(&pack, Some(&times)).unwrap();
        let at = |pointer: &str| json.pointer(pointer).and_then(Value::as_f64).unwrap();
        assert_eq!((at("/totals/active_voxels"), at("/totals/rbfs"), at("/totals/seconds/write")), (24.0, 6.0, 10.0));
        let sum = at("/frames/0/bytes_at_rest") + at("/frames/1/bytes_at_rest");
        assert_eq!(at("/totals/bytes_at_rest"), sum);
        assert_eq!(at("/totals/bits_per_active_voxel_at_rest"), 8.0 * sum / 24.0);
        assert_eq!((at("/totals/psnr_db_min"), at("/frames/1/seconds/fit")), (47.5, 2.0));
        assert_eq!(json["settings"]["gaussians"], 3);
        assert_eq!(json["sequence"]["promise"], json!({ "max_error": 0.5 * f64::from(0.01f32) }));
    }

    #[test]
    fn a_frame_has_exactly_the_keys_that_are_promised_and_null_for_unknown_seconds() {
        let (_folder, pack) = packed(&[1001]);
        let json = as_json(&pack, None).unwrap();
        let keys: Vec<&str> = json["frames"][0].as_object().unwrap().keys().map(String::as_str).collect();
        let expected = [
            "frame",
            "active_voxels",
            "rbfs",
            "fit_error",
            "max_error",
            "psnr_db",
            "bytes_at_rest",
            "bytes_resident",
            "seconds",
            "residual",
            "rank_bytes",
            "hash_bytes",
            "step",
            "box",
        ];
        assert_eq!(keys, expected);
        assert_eq!((&json["frames"][0]["seconds"], &json["totals"]["seconds"]), (&Value::Null, &Value::Null));
    }

    #[test]
    fn transfer_is_null_or_has_exactly_the_keys_that_are_promised() {
        let (_folder, pack) = packed(&[7]);
        assert_eq!(as_json(&pack, None).unwrap()["transfer"], Value::Null);
        assert!(!as_text(&pack, None).contains("transfer"));

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("transfer.smoke");
        small_pack_with_transfer(&path);
        let pack = Pack::open(&path).unwrap();
        let json = as_json(&pack, None).unwrap();
        let transfer = json["transfer"].as_object().unwrap();
        let keys: Vec<&str> = transfer.keys().map(String::as_str).collect();
        let expected = [
            "basis",
            "frames",
            "medium",
            "bands",
            "cell_shift",
            "photons",
            "bytes_at_rest",
            "bytes_resident",
            "raw_bytes",
            "compression_error",
            "truncated",
            "seconds",
            "peak_bytes",
            "per_frame",
        ];
        assert_eq!(keys, expected);
        // By the source's numbers; the largest errors; sums of bytes.
        assert_eq!(transfer["frames"], json!([1001, 1004]));
        assert_eq!(transfer["per_frame"][1]["first_of_run"], 1001);
        assert_eq!(transfer["compression_error"], json!({ "direct": 0.25, "indirect": 0.5 }));
        assert_eq!((&transfer["truncated"], &transfer["raw_bytes"]), (&json!(0.125), &json!(300)));
        assert_eq!(transfer["medium"], json!({ "sigma_t": [2.0, 2.0, 2.0], "albedo": [0.5, 0.5, 0.5], "g": 0.0 }));
        let sections = pack.sections().iter().filter(|s| s.kind == KIND_TRANSFER_BASES || s.kind == KIND_TRANSFER_ROWS);
        assert_eq!(transfer["bytes_at_rest"], sections.map(|s| s.bytes_at_rest).sum::<u64>());
        let text = as_text(&pack, None);
        let line = "transfer: 2 of 3 frames, basis sh6, sigma_t [2.0, 2.0, 2.0], albedo [0.5, 0.5, 0.5], g 0; ";
        let last = text.lines().last().unwrap();
        assert!(last.starts_with(line), "{text}");
        assert!(last.ends_with("compression is off by 2.500e-1 direct, 5.000e-1 indirect at most"), "{text}");
        assert_eq!(validate(&path), []);
    }

    #[test]
    fn every_line_of_the_table_is_as_wide_for_one_frame_and_for_a_thousand() {
        for count in [1, 1000] {
            let (_folder, pack) = packed(&(1..=count).collect::<Vec<_>>());
            for seconds in [None, Some(vec![Seconds::default(); count as usize])] {
                let text = as_text(&pack, seconds);
                let rows: Vec<&str> = text.lines().skip(3).take(count as usize + 1).collect();
                assert!(rows[0].trim_start().starts_with("frame") && rows[0].contains("PSNR dB"), "{text}");
                // Every frame's row ends in the same column; words in the header are set to the right.
                assert!(rows.iter().all(|row| row.chars().count() == rows[0].chars().count()), "{text}");
                assert!(text.contains("\n  all") || text.contains("all  "), "{text}");
            }
        }
    }

    #[test]
    fn a_pack_without_frames_has_dashes_for_means() {
        let (_folder, pack) = packed(&[]);
        let text = as_text(&pack, None);
        assert!(text.contains("no frames") && text.contains('-'), "{text}");
        assert_eq!(as_json(&pack, None).unwrap()["totals"]["fit_error_mean"], Value::Null);
    }
}
