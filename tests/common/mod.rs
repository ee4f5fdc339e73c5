//! What the end-to-end tests share: the binary, the shipped plume, and voxels held against voxels.
#![allow(dead_code, reason = "each test file uses its part")]

use smoke_formats::volume::{self, DensityGrid};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Debian installs pyopenvdb for its own Python.
const PYTHON: &str = "/usr/bin/python3";

/// The shipped sequence.
pub const PLUME: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/testdata/plume/plume.####.vdb");

/// Frame `number` of the shipped sequence.
pub fn plume(number: i32) -> PathBuf {
    PLUME.replace("####", &format!("{number:04}")).into()
}

/// The shared data; a test that needs it is ignored by default and fails without it.
pub fn shared_data() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let folder = std::env::var_os("SMOKE_BAKE_DATA").map_or_else(default, PathBuf::from);
    assert!(folder.is_dir(), "{}: no data; set SMOKE_BAKE_DATA", folder.display());
    folder
}

/// The program with `line`, in `folder`, not started yet.
pub fn command(folder: &Path, line: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_smoke-bake"));
    command.args(line).current_dir(folder);
    command
}

/// Runs the program to its end.
pub fn smoke_bake(folder: &Path, line: &[&str]) -> Output {
    command(folder, line).output().unwrap()
}

/// Runs the program, which must succeed; gives its answer.
pub fn answer(folder: &Path, line: &[&str]) -> String {
    let output = smoke_bake(folder, line);
    assert_eq!(output.status.code(), Some(0), "{line:?}: {}", text(&output.stderr));
    text(&output.stdout).to_owned()
}

/// Runs the program, which must refuse its input: exit code 1, nothing on stdout, one line on stderr; gives the line.
pub fn refusal(folder: &Path, line: &[&str]) -> String {
    let output = smoke_bake(folder, line);
    let message = text(&output.stderr);
    assert_eq!((output.status.code(), text(&output.stdout)), (Some(1), ""), "{line:?}: {message}");
    assert_eq!(message.matches('\n').count(), 1, "{line:?}: {message}");
    message.to_owned()
}

/// What `SMOKE_GPU` says of graphics devices: off, require, or auto, the default.
pub fn gpu_mode() -> String {
    let mode = std::env::var("SMOKE_GPU").unwrap_or_else(|_| "auto".into());
    assert!(
        ["off", "auto", "require"].contains(&mode.as_str()),
        "SMOKE_GPU: found {mode}, expected off, auto, require"
    );
    mode
}

/// Bytes as text.
pub fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// The density grid of a volume.
pub fn density(path: &Path) -> DensityGrid {
    volume::read(path, "density").unwrap()
}

/// Largest difference of any voxel of two volumes; outside its box a volume is zero.
pub fn largest_difference(a: &DensityGrid, b: &DensityGrid) -> f64 {
    let one_way = |from: &DensityGrid, to: &DensityGrid| {
        let error = |v: usize| {
            let other = to.voxel(from.index(v).map(|i| i as i32)).map_or(0.0, |w| to.values[w]);
            let error = (f64::from(from.values[v]) - f64::from(other)).abs();
            // A NaN must not slip through a comparison.
            if error.is_nan() { f64::INFINITY } else { error }
        };
        (0..from.len()).map(error).fold(0.0, f64::max)
    };
    one_way(a, b).max(one_way(b, a))
}

/// What OpenVDB's own library says of two files' `density`: largest difference of any voxel, whether the second's active
/// set is the first's together with its voxels that are not zero, and whether eight corners lie at the same place.
pub fn by_openvdb(pairs: &[(PathBuf, PathBuf)]) -> Vec<(f64, bool, bool)> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/common/openvdb_pairs.py");
    let output = Command::new(PYTHON).arg(script).args(pairs.iter().flat_map(|(a, b)| [a, b])).output().expect(PYTHON);
    assert!(output.status.success(), "is python3-openvdb there? {}", text(&output.stderr));
    let parse = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        (words[0].parse().unwrap(), words[1] == "True", words[2] == "True")
    };
    let rows: Vec<_> = text(&output.stdout).lines().map(parse).collect();
    assert_eq!(rows.len(), pairs.len());
    rows
}

/// A generator whose numbers depend on the seed alone (SplitMix64, Steele et al. 2014).
pub struct Random(pub u64);

impl Random {
    /// The next number below `n`.
    pub fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((u128::from(z ^ z >> 31) * u128::from(n)) >> 64) as u64
    }
}
