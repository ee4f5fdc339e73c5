//! The shipped plume through the binary: baked, inspected, checked, unpacked, and held against its source.

mod common;

use common::{answer, by_openvdb, density, largest_difference, plume, refusal, shared_data, smoke_bake, text};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// Largest error that the bake is asked to promise.
const MAX_ERROR: f64 = 0.004;

/// Frames of the shipped plume.
const FRAMES: std::ops::RangeInclusive<i32> = 1..=8;

/// A folder with the shipped sequence baked (few Gaussians: the promise must hold for any number) and unpacked.
static BAKED: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let target = MAX_ERROR.to_string();
    let line = [
        "bake",
        common::PLUME,
        "-o",
        "plume.smoke",
        "--gaussians",
        "40",
        "--first-evaluations",
        "20",
        "--next-evaluations",
        "6",
        "--max-error",
    ];
    answer(folder.path(), &[&line[..], &[&target, "--progress", "none"]].concat());
    answer(folder.path(), &["unpack", "plume.smoke", "-o", "float.####.vdb", "--progress", "none"]);
    folder
});

fn inspect(folder: &Path) -> Value {
    serde_json::from_str(&answer(folder, &["inspect", "plume.smoke", "--json"])).unwrap()
}

#[test]
fn every_voxel_keeps_the_promise_and_the_recorded_error_is_the_real_one() {
    let json = inspect(BAKED.path());
    assert_eq!(json["frames"].as_array().unwrap().len(), FRAMES.count());
    for (frame, row) in FRAMES.zip(json["frames"].as_array().unwrap()) {
        assert_eq!(row["frame"].as_i64(), Some(frame.into()));
        let (source, mut unpacked) =
            (density(&plume(frame)), density(&BAKED.path().join(format!("float.{frame:04}.vdb"))));
        let error = largest_difference(&source, &unpacked);
        assert!(error <= MAX_ERROR, "frame {frame}: {error}");
        // Both are the same f64 difference of the same floats.
        assert_eq!(Some(error), row["max_error"].as_f64(), "frame {frame}");
        assert_eq!(row["active_voxels"].as_u64(), Some(unpacked.active.count() as u64));
        assert_eq!(unpacked.world_from_index, source.world_from_index);
        // The comparison sees one voxel that is a step too far off.
        let last = unpacked.active.iter_set().last().unwrap();
        unpacked.values[last] += 2.1 * MAX_ERROR as f32;
        assert!(largest_difference(&source, &unpacked) > MAX_ERROR);
    }
}

#[test]
fn openvdb_reads_what_was_unpacked_with_the_same_active_set_and_place() {
    let unpacked = |frame: i32| BAKED.path().join(format!("float.{frame:04}.vdb"));
    let pairs: Vec<_> = [1, 8].map(|frame| (plume(frame), unpacked(frame))).into();
    for (error, same_support, same_place) in by_openvdb(&pairs) {
        assert!(error <= MAX_ERROR && same_support && same_place, "{error} {same_support} {same_place}");
    }
    // Another frame is seen to be another one.
    let (error, same_support, same_place) = by_openvdb(&[(plume(1), unpacked(2))])[0];
    assert!(error > MAX_ERROR && !same_support && same_place, "{error} {same_support} {same_place}");
}

#[test]
fn inspect_has_every_key_with_sums_that_add_up_and_seconds_of_every_stage() {
    let json = inspect(BAKED.path());
    for pointer in ["/sequence/name", "/sequence/grid", "/sequence/promise/max_error", "/settings", "/totals/seconds"] {
        assert!(json.pointer(pointer).is_some_and(|v| !v.is_null()), "{pointer}");
    }
    assert_eq!(json["sequence"]["promise"]["max_error"].as_f64(), Some(MAX_ERROR));
    let frames = json["frames"].as_array().unwrap();
    for row in frames {
        for key in ["active_voxels", "rbfs", "fit_error", "max_error", "psnr_db", "bytes_at_rest", "bytes_resident"] {
            assert!(row[key].as_f64().is_some_and(|v| v > 0.0), "{key}: {row}");
        }
        for stage in ["read", "fit", "residual", "hash", "write"] {
            assert!(row["seconds"][stage].as_f64().is_some_and(|v| v >= 0.0), "{stage}: {row}");
        }
    }
    let bytes: u64 = frames.iter().map(|row| row["bytes_at_rest"].as_u64().unwrap()).sum();
    let file = std::fs::metadata(BAKED.path().join("plume.smoke")).unwrap().len();
    assert_eq!(json["totals"]["bytes_at_rest"].as_u64(), Some(bytes));
    assert_eq!(json["totals"]["file_bytes"].as_u64(), Some(file));
    assert!(bytes < file);
    let table = answer(BAKED.path(), &["inspect", "plume.smoke"]);
    assert!(table.contains("fit error") && table.contains("bits an active voxel"), "{table}");
    // Seconds are in a file of their own: without it the pack says nothing of time.
    let copy = tempfile::tempdir().unwrap();
    std::fs::copy(BAKED.path().join("plume.smoke"), copy.path().join("plume.smoke")).unwrap();
    assert_eq!(inspect(copy.path())["frames"][0]["seconds"], Value::Null);
}

#[test]
fn half_floats_add_no_more_than_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    let pack = BAKED.path().join("plume.smoke");
    let line = ["unpack", pack.to_str().unwrap(), "-o", "half.%04d.vdb", "--half", "--frames", "8", "--threads", "1"];
    let report = answer(folder.path(), &line);
    let reported: f64 = report.trim().rsplit(' ').next().unwrap().parse().unwrap();
    let error = largest_difference(&density(&plume(8)), &density(&folder.path().join("half.0008.vdb")));
    // The report is rounded to seven digits.
    assert!(error <= reported * (1.0 + 1e-6) && reported < 2.0 * MAX_ERROR, "{error} {report}");
}

#[test]
fn mitsuba_volumes_hold_the_same_voxels() {
    let folder = tempfile::tempdir().unwrap();
    let pack = BAKED.path().join("plume.smoke");
    answer(folder.path(), &["unpack", pack.to_str().unwrap(), "-o", "a.$F4.vol", "--frames", "1,3"]);
    let vol = density(&folder.path().join("a.0003.vol"));
    let vdb = density(&BAKED.path().join("float.0003.vdb"));
    let sum = |values: &[f32]| values.iter().map(|&v| f64::from(v)).sum::<f64>();
    // The same values in the same order, with zeros around them: the sums are equal to the bit.
    assert_eq!(sum(&vol.values), sum(&vdb.values));
    assert!(!folder.path().join("a.0002.vol").exists());
}

#[test]
fn a_good_pack_is_valid_and_a_damaged_one_is_named_with_the_place() {
    assert!(answer(BAKED.path(), &["validate", "plume.smoke"]).starts_with("ok: 8 frames, "));
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = std::fs::read(BAKED.path().join("plume.smoke")).unwrap();
    bytes[300] ^= 4;
    std::fs::write(folder.path().join("bad.smoke"), bytes).unwrap();
    let message = refusal(folder.path(), &["validate", "bad.smoke"]);
    assert!(
        message.contains("bad.smoke: ") && message.contains("checksum") && message.contains("expected"),
        "{message}"
    );
}

#[test]
fn bad_input_is_one_line_with_file_found_and_expected() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("text.smoke"), "not a pack").unwrap();
    std::fs::write(folder.path().join("text.vdb"), "not a volume").unwrap();
    let pack = BAKED.path().join("plume.smoke").to_str().unwrap().to_owned();
    let cases: [(&[&str], &[&str]); 8] = [
        (&["validate", "none.smoke"], &["none.smoke: "]),
        (&["inspect", "text.smoke"], &["text.smoke: ", "found ", "expected "]),
        (&["unpack", "text.smoke", "-o", "a.####.vdb"], &["text.smoke: ", "found ", "expected "]),
        (&["unpack", &pack, "-o", "a.####.vdb", "--frames", "9"], &["frame 9: found no such frame, expected one of"]),
        (&["unpack", &pack, "-o", "a.vdb"], &["a.vdb: output: found one name for 8 frames, expected "]),
        (&["bake", "none.####.vdb", "-o", "a.smoke"], &["none.####.vdb: ", "found ", "expected "]),
        (&["bake", "text.vdb", "-o", "a.smoke"], &["text.vdb: ", "found ", "expected "]),
        (&["bake", common::PLUME, "-o", "a.smoke", "--grid", "heat"], &["plume.0001.vdb: ", "heat", "density"]),
    ];
    for (line, parts) in cases {
        let message = refusal(folder.path(), line);
        assert!(message.starts_with("smoke-bake: ") && parts.iter().all(|p| message.contains(p)), "{message}");
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "nothing was written");
}

#[test]
fn wrong_usage_ends_with_exit_code_2() {
    let folder = tempfile::tempdir().unwrap();
    for line in [
        &["unpack", "a.smoke", "-o", "a.####.exr"][..],
        &["unpack", "a.smoke", "-o", "a.####.vol", "--half"],
        &["unpack", "a.smoke", "-o", "a.####.vdb", "--frames", "5-1"],
        &["bake", "a.vdb", "-o", "a.smoke", "--psnr", "40", "--max-error", "0.1"],
        &["bake", "a.vdb"],
        &["inspect"],
    ] {
        let output = smoke_bake(folder.path(), line);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(2), ""), "{line:?}: {}", text(&output.stderr));
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn all_64_frames_of_the_plume_keep_the_promise_by_openvdbs_own_reader() {
    let folder = tempfile::tempdir().unwrap();
    let input = shared_data().join("plume/plume.####.vdb");
    let line = ["bake", input.to_str().unwrap(), "-o", "plume.smoke", "--max-error", "0.002"];
    answer(
        folder.path(),
        &[&line[..], &["--gaussians", "100", "--first-evaluations", "60", "--next-evaluations", "12"]].concat(),
    );
    answer(folder.path(), &["unpack", "plume.smoke", "-o", "out.####.vdb"]);
    let pair = |frame: i32| -> (PathBuf, PathBuf) {
        (shared_data().join(format!("plume/plume.{frame}.vdb")), folder.path().join(format!("out.{frame}.vdb")))
    };
    let pairs: Vec<_> = (1001..=1064).map(pair).collect();
    for ((source, unpacked), (error, same_support, same_place)) in pairs.iter().zip(by_openvdb(&pairs)) {
        let name = source.display();
        assert!(error <= 0.002 && same_support && same_place, "{name}: {error} {same_support} {same_place}");
        assert!(largest_difference(&density(source), &density(unpacked)) <= 0.002, "{name}");
    }
}
