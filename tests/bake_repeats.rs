//! The same input, settings and seed give the same bytes: on any number of threads, twice in a row, and however often
//! the bake is killed and resumed.

mod common;

use common::{Random, answer, command};
use std::path::Path;
use std::process::Stdio;
use std::time::Instant;

/// Frames that stand alone, and frames that lie after the one before.
const KEYS: [&[&str]; 2] = [&[], &["--key-every", "3"]];

/// A bake of the first frames, small enough to be repeated often.
fn line<'a>(output: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let few = [
        "--frames",
        "1-3",
        "--gaussians",
        "16",
        "--first-evaluations",
        "10",
        "--next-evaluations",
        "4",
        "--max-error",
        "0.01",
    ];
    [&["bake", common::PLUME, "-o", output, "--progress", "none"], &few[..], more].concat()
}

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    std::fs::read(folder.join(name)).unwrap()
}

#[test]
fn threads_and_repetition_do_not_change_a_byte_and_another_seed_does() {
    let folder = tempfile::tempdir().unwrap();
    for (name, more) in [
        ("a.smoke", &["--threads", "1"][..]),
        ("b.smoke", &["--threads", "2"]),
        ("c.smoke", &["--threads", "2"]),
        ("d.smoke", &["--seed", "2"]),
        ("e.smoke", &["--threads", "1", "--key-every", "3"]),
        ("f.smoke", &["--threads", "2", "--key-every", "3"]),
    ] {
        answer(folder.path(), &line(name, more));
    }
    let a = bytes(folder.path(), "a.smoke");
    assert!(a == bytes(folder.path(), "b.smoke"), "1 and 2 threads differ");
    assert!(a == bytes(folder.path(), "c.smoke"), "two runs differ");
    assert!(bytes(folder.path(), "e.smoke") == bytes(folder.path(), "f.smoke"), "1 and 2 threads differ");
    assert!(a != bytes(folder.path(), "e.smoke"), "--key-every does nothing");
    assert!(a != bytes(folder.path(), "d.smoke"), "the comparison would not see a difference");
}

#[test]
fn a_bake_killed_at_any_moment_and_resumed_ends_with_the_same_bytes() {
    let seed = 0x5eed_0001;
    println!("seed {seed:#x}");
    let mut random = Random(seed);
    let folder = tempfile::tempdir().unwrap();
    let start = Instant::now();
    answer(folder.path(), &line("whole.smoke", KEYS[0]));
    let mut whole = start.elapsed();
    answer(folder.path(), &line("chained.smoke", KEYS[1]));
    let whole_packs = ["whole.smoke", "chained.smoke"].map(|name| bytes(folder.path(), name));

    let (mut killed, mut kept_work) = (0, 0);
    for round in 0..200 {
        let name = format!("killed{round}.smoke");
        let (keys, expected) = (KEYS[round % 2], &whole_packs[round % 2]);
        let start = Instant::now();
        let mut child = command(folder.path(), &line(&name, keys));
        let mut child = child.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(whole.mul_f64(random.below(1000) as f64 / 1000.0));
        // SIGKILL on Unix: nothing of the program runs after it.
        child.kill().unwrap();
        let status = child.wait().unwrap();
        let pack = folder.path().join(&name);
        if status.code() == Some(0) {
            assert!(bytes(folder.path(), &name) == *expected, "round {round}");
            // It was done before the kill: the machine is faster now than it was.
            whole = whole.min(start.elapsed());
            continue;
        }
        killed += 1;
        // A pack under its name is whole, whatever happened.
        assert!(!pack.exists() || bytes(folder.path(), &name) == *expected, "round {round}: a part of a pack");
        kept_work += usize::from(std::fs::read_dir(folder.path()).unwrap().any(|entry| {
            let path = entry.unwrap().path();
            path.is_dir() && path.file_name().unwrap().to_str().unwrap().starts_with(&name)
        }));
        answer(folder.path(), &line(&name, &[keys, &["--resume"]].concat()));
        assert!(bytes(folder.path(), &name) == *expected, "round {round}: other bytes after --resume");
        if killed == 20 {
            break;
        }
    }
    println!("{killed} kills, {kept_work} with work kept, {whole:?} a bake");
    assert!(killed >= 20, "only {killed} of 200 bakes were caught alive");
    assert!(kept_work > 0, "no kill came after work had been kept: the test resumed nothing");
}
