//! Damaged packs: an error or the right answer, never a panic, a hang, or much memory.

mod common;

use common::{Random, answer, smoke_bake, text};
use rayon::prelude::*;
use smoke_formats::gaussian::UnitSpace;
use smoke_formats::pack::{Pack, validate_bytes};
use smoke_runtime::medium::decoder;
use std::path::Path;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// Longest that any damaged pack may take: a good one takes well below a second.
const PATIENCE: Duration = Duration::from_secs(20);

/// The bytes of a pack of one frame, and of a pack of two, the second of which lies after the first.
static PACKS: LazyLock<[Vec<u8>; 2]> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    ["1", "1-2"].map(|frames| {
        let few = [
            "--gaussians",
            "40",
            "--first-evaluations",
            "10",
            "--next-evaluations",
            "4",
            "--max-error",
            "0.01",
            "--progress",
            "none",
        ];
        let line = ["bake", common::PLUME, "-o", "a.smoke", "--frames", frames];
        answer(folder.path(), &[&line[..], &few].concat());
        std::fs::read(folder.path().join("a.smoke")).unwrap()
    })
});

/// The bits of every voxel of every frame, or the first error.
fn decoded(bytes: Vec<u8>) -> smoke_formats::Result<Vec<Vec<u32>>> {
    let pack = Pack::from_bytes(Path::new("damaged.smoke"), bytes)?;
    let space = UnitSpace::of_box(pack.sequence().origin, pack.sequence().dims);
    let frame = |f: usize| {
        let (gaussians, residual) = (pack.gaussians(f)?, pack.residual(f)?.codes()?);
        let values = decoder::decode(&gaussians, &residual, pack.frames()[f].step, &space);
        Ok(values.into_iter().map(f32::to_bits).collect())
    };
    (0..pack.frames().len()).map(frame).collect()
}

/// Reads the damaged bytes in every way; says what went wrong. `right` is what the undamaged pack decodes to.
fn offence(bytes: Vec<u8>, right: &[Vec<u32>]) -> Option<String> {
    let start = Instant::now();
    let read = std::panic::catch_unwind(|| {
        let findings = validate_bytes(Path::new("damaged.smoke"), bytes.clone());
        (findings.is_empty(), decoded(bytes))
    });
    match read {
        Err(_) => Some("a panic".into()),
        Ok((_, Ok(values))) if values != right => Some("a wrong answer".into()),
        Ok((true, Err(error))) => Some(format!("valid, but: {error}")),
        Ok(_) if start.elapsed() > PATIENCE => Some(format!("{:?}", start.elapsed())),
        Ok(_) => None,
    }
}

/// The most memory that this process has held, in bytes (Linux).
fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix(" kB")?.parse::<u64>().ok().map(|kib| kib << 10)
}

/// `bytes` with one bit changed.
fn flipped(bytes: &[u8], bit: u64) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[(bit / 8) as usize] ^= 1 << (bit % 8);
    bytes
}

#[test]
fn a_pack_cut_short_anywhere_is_refused() {
    let [one, _] = &*PACKS;
    let right = decoded(one.clone()).unwrap();
    assert_eq!(offence(one.clone(), &right), None, "the undamaged pack");
    let lengths: Vec<usize> = (0..one.len()).step_by(997).chain(one.len() - 9..one.len()).collect();
    lengths.into_par_iter().for_each(|length| {
        let cut = one[..length].to_vec();
        assert!(!validate_bytes(Path::new("cut.smoke"), cut.clone()).is_empty(), "valid at {length} bytes");
        assert_eq!(offence(cut, &right), None, "at {length} of {} bytes", one.len());
    });
}

#[test]
fn two_thousand_flipped_bits_give_errors_and_nothing_worse() {
    let seed = 0x5eed_0002;
    println!("seed {seed:#x}");
    let mut random = Random(seed);
    // One flip in forty goes to a pack of two frames, where the first may stay good and costs its decoding.
    let mut cases: Vec<(usize, u64)> = vec![];
    for i in 0..2000 {
        let which = usize::from(i % 40 == 0);
        cases.push((which, random.below(8 * PACKS[which].len() as u64)));
    }
    let right = PACKS.each_ref().map(|p| decoded(p.clone()).unwrap());
    cases.into_par_iter().for_each(|(which, bit)| {
        let damaged = flipped(&PACKS[which], bit);
        // Every byte is under a checksum or must be zero, so that no flip goes unseen.
        assert!(!validate_bytes(Path::new("flipped.smoke"), damaged.clone()).is_empty(), "bit {bit} passes as valid");
        assert_eq!(offence(damaged, &right[which]), None, "bit {bit} of pack {which}");
    });
    if let Some(bytes) = peak_memory() {
        assert!(bytes < 2 << 30, "{bytes} bytes at the peak");
    }
}

#[test]
fn a_wrong_answer_and_a_good_one_are_told_apart() {
    let [one, _] = &*PACKS;
    let mut right = decoded(one.clone()).unwrap();
    right[0][0] ^= 1;
    assert_eq!(offence(one.clone(), &right).as_deref(), Some("a wrong answer"));
}

#[test]
fn the_program_refuses_damaged_packs_in_one_line() {
    let seed = 0x5eed_0003;
    println!("seed {seed:#x}");
    let mut random = Random(seed);
    let [one, _] = &*PACKS;
    let folder = tempfile::tempdir().unwrap();
    for round in 0..40 {
        let bytes = match round % 2 {
            0 => flipped(one, random.below(8 * one.len() as u64)),
            _ => one[..random.below(one.len() as u64) as usize].to_vec(),
        };
        std::fs::write(folder.path().join("bad.smoke"), bytes).unwrap();
        common::refusal(folder.path(), &["validate", "bad.smoke"]);
        // What does not need the damaged bytes may still work.
        for line in [&["inspect", "bad.smoke"][..], &["unpack", "bad.smoke", "-o", "a.vdb", "--progress", "none"]] {
            let output = smoke_bake(folder.path(), line);
            let (code, message) = (output.status.code(), text(&output.stderr));
            let lines = usize::from(code == Some(1));
            assert!(matches!(code, Some(0 | 1)) && message.matches('\n').count() == lines, "{code:?} {message}");
        }
    }
}
