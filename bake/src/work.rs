//! The work folder of a bake: `OUT.work/`, one file a finished frame, so that an interrupted bake goes on where it was.
//!
//! A frame's file appears whole or not at all. What a bake does next depends on its settings, its sources and the
//! frames before; so the folder also holds a fingerprint of settings and sources, and `--resume` with any other is
//! refused. The pack itself is put together in the folder and renamed over the output at the end.

use crate::{Error, Result};
use smoke_formats::atomic;
use smoke_formats::pack::EncodedFrame;
use std::path::{Path, PathBuf};

/// The name of the fingerprint's file.
const FINGERPRINT: &str = "bake.json";

/// The work folder of one bake.
#[derive(Debug)]
pub struct Work {
    folder: PathBuf,
}

impl Work {
    /// The folder for `output`: a fresh one, or with `resume` the one that is there, if it has the same fingerprint.
    ///
    /// `fingerprint` is text that names settings and sources. Without `resume` an old folder is emptied first.
    pub fn open(output: &Path, fingerprint: &str, resume: bool) -> Result<Self> {
        let folder = Self::folder_of(output);
        let io = |e| Error::from(smoke_formats::Error::io(&folder, e));
        let file = folder.join(FINGERPRINT);
        if resume && file.exists() {
            let found = std::fs::read_to_string(&file).map_err(|e| smoke_formats::Error::io(&file, e))?;
            if found != fingerprint {
                let what = "other settings, other frames or other versions of the files";
                return Err(Error::Resume { path: folder, what });
            }
            return Ok(Self { folder });
        }
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(io)?;
        }
        std::fs::create_dir(&folder).map_err(io)?;
        atomic::write_bytes(&file, fingerprint.as_bytes())?;
        Ok(Self { folder })
    }

    /// `OUT.work`, beside the output.
    pub fn folder_of(output: &Path) -> PathBuf {
        let mut name = output.file_name().unwrap_or_default().to_owned();
        name.push(".work");
        output.with_file_name(name)
    }

    fn frame_file(&self, frame: i32) -> PathBuf {
        self.folder.join(format!("frame.{frame}"))
    }

    /// A frame that was finished before; none if it was not, or if its file is damaged (it is then baked again).
    pub fn load(&self, frame: i32) -> Option<EncodedFrame> {
        let path = self.frame_file(frame);
        EncodedFrame::from_bytes(&path, &std::fs::read(&path).ok()?).ok()
    }

    /// Keeps a finished frame.
    pub fn store(&self, frame: &EncodedFrame) -> Result<()> {
        let path = self.frame_file(frame.record().frame);
        Ok(atomic::write_bytes(&path, &frame.to_bytes(&path)?)?)
    }

    /// Where the pack is put together.
    pub fn pack_file(&self) -> PathBuf {
        self.folder.join("pack")
    }

    /// Moves the finished pack to `output` and removes the folder.
    pub fn finish(self, output: &Path) -> Result<()> {
        std::fs::rename(self.pack_file(), output).map_err(|e| smoke_formats::Error::io(output, e))?;
        std::fs::remove_dir_all(&self.folder).map_err(|e| smoke_formats::Error::io(&self.folder, e))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_resumed_only_with_its_own_fingerprint_and_emptied_otherwise() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("a.smoke");
        let marker = Work::folder_of(&output).join("frame.7");
        Work::open(&output, "one", false).unwrap();
        std::fs::write(&marker, b"damaged").unwrap();
        let work = Work::open(&output, "one", true).unwrap();
        assert!(marker.exists() && work.load(7).is_none(), "a damaged frame is baked again");
        let message = Work::open(&output, "two", true).unwrap_err().to_string();
        assert!(message.contains("other settings") && message.contains("--resume"), "{message}");
        assert!(marker.exists(), "a refusal changes nothing");
        Work::open(&output, "two", false).unwrap();
        assert!(!marker.exists());
    }
}
