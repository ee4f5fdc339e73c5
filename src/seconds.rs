//! How long each stage of a bake took, in a small file beside the pack: `PACK.seconds.json`.
//!
//! Not inside the pack, because the same input must give the same bytes. The file carries the checksum of the pack's
//! table of contents, so that times of another bake are never shown for this one.

use serde::{Deserialize, Serialize};
pub use smoke_baking::pipeline::Seconds;
pub use smoke_baking::transfer::TransferSeconds;
use smoke_formats::pack::Pack;
use smoke_formats::{Error, Result, atomic};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest file that is read: a million frames.
const MAX_BYTES: u64 = 256 << 20;

#[derive(Deserialize, Serialize)]
struct Row {
    frame: i32,
    #[serde(flatten)]
    seconds: Seconds,
}

#[derive(Deserialize, Serialize)]
struct TransferRow {
    frame: i32,
    #[serde(flatten)]
    seconds: TransferSeconds,
}

#[derive(Deserialize, Serialize)]
struct Sidecar {
    pack_checksum: String,
    frames: Vec<Row>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    transfer: Vec<TransferRow>,
}

/// How long a bake took.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Times {
    /// Each frame, by number.
    pub frames: Vec<(i32, Seconds)>,
    /// The transfer of each run of frames, by the number of its first.
    pub transfer: Vec<(i32, TransferSeconds)>,
}

/// The file beside `pack`.
pub fn path_beside(pack: &Path) -> PathBuf {
    let mut name = pack.as_os_str().to_owned();
    name.push(".seconds.json");
    name.into()
}

/// Writes the seconds beside the finished pack at `pack`, whole or not at all.
pub fn write(pack: &Path, times: &Times) -> Result<()> {
    let path = path_beside(pack);
    let pack_checksum = checksum(&Pack::open(pack)?);
    let frames = times.frames.iter().map(|&(frame, seconds)| Row { frame, seconds }).collect();
    let transfer = times.transfer.iter().map(|&(frame, seconds)| TransferRow { frame, seconds }).collect();
    let text = serde_json::to_string_pretty(&Sidecar { pack_checksum, frames, transfer });
    let text = text.map_err(|e| Error::invalid(&path, "seconds", e, "finite numbers"))?;
    atomic::write_bytes(&path, text.as_bytes())
}

/// The seconds, frames in the pack's order; none if there is no such file, or it belongs to another pack.
pub fn read(pack: &Pack) -> Option<Times> {
    let mut text = String::new();
    let file = std::fs::File::open(path_beside(pack.path())).ok()?;
    file.take(MAX_BYTES).read_to_string(&mut text).ok()?;
    let sidecar: Sidecar = serde_json::from_str(&text).ok()?;
    let frames = sidecar.frames.iter().map(|row| row.frame);
    let belongs = sidecar.pack_checksum == checksum(pack) && frames.eq(pack.frames().iter().map(|f| f.frame));
    belongs.then(|| Times {
        frames: sidecar.frames.into_iter().map(|row| (row.frame, row.seconds)).collect(),
        transfer: sidecar.transfer.into_iter().map(|row| (row.frame, row.seconds)).collect(),
    })
}

fn checksum(pack: &Pack) -> String {
    format!("{:016x}", pack.checksum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_pack;

    #[test]
    fn seconds_come_back_for_the_pack_they_belong_to_and_for_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let (a, b) = (folder.path().join("a.smoke"), folder.path().join("b.smoke"));
        small_pack(&a, &[1, 2], 0.01);
        small_pack(&b, &[1, 2], 0.02);
        let seconds = Seconds { read: 0.1, fit: 2.0, residual: 0.25, hash: 0.0, write: 1e-9 };
        let of_transfer = TransferSeconds { direct: 1.5, photons: 20.0, compress: 0.5, peak_bytes: 1 << 33 };
        let rows = Times { frames: vec![(1, seconds), (2, Seconds::default())], transfer: vec![(1, of_transfer)] };
        let open = |path: &Path| Pack::open(path).unwrap();
        assert_eq!(read(&open(&a)), None);
        write(&a, &rows).unwrap();
        assert_eq!(read(&open(&a)), Some(rows));
        let text = std::fs::read_to_string(path_beside(&a)).unwrap();
        let json: serde_json::Value = serde_json::from_str(&text).unwrap();
        assert_eq!((json["frames"][0]["frame"].as_i64(), json["frames"][0]["fit"].as_f64()), (Some(1), Some(2.0)));

        std::fs::copy(path_beside(&a), path_beside(&b)).unwrap();
        assert_eq!(read(&open(&b)), None);
        for damaged in ["", "{}", &text[..text.len() / 2]] {
            std::fs::write(path_beside(&a), damaged).unwrap();
            assert_eq!(read(&open(&a)), None, "{damaged}");
        }
    }
}
