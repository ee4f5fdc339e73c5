//! The work folder of a bake: `OUT.work/`, one file a finished frame, so that an interrupted bake goes on where it was.
//!
//! A frame's file appears whole or not at all. What a bake does next depends on its settings, its sources and the
//! frames before; so the folder also holds a fingerprint of settings and sources, and `--resume` with any other is
//! refused. While a bake runs it holds a lock in the folder, so that a second one for the same output ends at once.
//! The pack itself is put together in the folder and renamed over the output at the end.

use crate::pipeline::Seconds;
use crate::transfer::TransferSeconds;
use crate::{Error, Result};
use smoke_formats::atomic;
use smoke_formats::pack::{EncodedFrame, EncodedTransfer};
use std::fs::File;
use std::path::{Path, PathBuf};

/// The name of the fingerprint's file.
const FINGERPRINT: &str = "bake.json";

/// The file that a running bake holds locked.
const LOCK: &str = "lock";

/// The work folder of one bake.
#[derive(Debug)]
pub struct Work {
    folder: PathBuf,
    /// Locked until the bake ends, however it ends.
    _lock: File,
}

impl Work {
    /// The folder for `output`: a fresh one, or with `resume` the one that is there, if it has the same fingerprint.
    ///
    /// `fingerprint` is text that names settings and sources. Without `resume` the folder of an earlier bake is emptied
    /// first; a folder of that name that no bake made is refused.
    pub fn open(output: &Path, fingerprint: &str, resume: bool) -> Result<Self> {
        let folder = Self::folder_of(output);
        let io = |e| Error::from(smoke_formats::Error::io(&folder, e));
        let file = folder.join(FINGERPRINT);
        let lock_file = folder.join(LOCK);
        if folder.exists() {
            // An empty one may be left from a bake that was stopped before it had its lock.
            let mut entries = std::fs::read_dir(&folder).map_err(io)?;
            if !lock_file.exists() && entries.next().is_some() {
                return Err(Error::Foreign { path: folder });
            }
        } else {
            std::fs::create_dir(&folder).map_err(io)?;
        }
        let lock = File::options().create(true).append(true).open(&lock_file).map_err(io)?;
        if lock.try_lock().is_err() {
            return Err(Error::Busy { path: folder });
        }
        if resume && file.exists() {
            let found = std::fs::read_to_string(&file).map_err(|e| smoke_formats::Error::io(&file, e))?;
            if found != fingerprint {
                let what = "other settings, other frames or other versions of the files";
                return Err(Error::Resume { path: folder, what });
            }
            return Ok(Self { folder, _lock: lock });
        }
        let work = Self { folder, _lock: lock };
        work.empty()?;
        atomic::write_bytes(&file, fingerprint.as_bytes())?;
        Ok(work)
    }

    /// Removes all files but the lock.
    fn empty(&self) -> Result<()> {
        let lock = self.folder.join(LOCK);
        for entry in std::fs::read_dir(&self.folder).map_err(|e| smoke_formats::Error::io(&self.folder, e))? {
            let path = entry.map_err(|e| smoke_formats::Error::io(&self.folder, e))?.path();
            if path != lock {
                std::fs::remove_file(&path).map_err(|e| smoke_formats::Error::io(&path, e))?;
            }
        }
        Ok(())
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

    fn seconds_file(&self, frame: i32) -> PathBuf {
        self.folder.join(format!("seconds.{frame}"))
    }

    /// Keeps how long a frame took, for the bake that takes it over.
    pub fn store_seconds(&self, frame: i32, seconds: &Seconds) -> Result<()> {
        let path = self.seconds_file(frame);
        let text = serde_json::to_string(seconds);
        let text = text.map_err(|e| smoke_formats::Error::invalid(&path, "seconds", e, "finite numbers"))?;
        Ok(atomic::write_bytes(&path, text.as_bytes())?)
    }

    /// How long a finished frame took, if that was kept.
    pub fn load_seconds(&self, frame: i32) -> Option<Seconds> {
        serde_json::from_slice(&std::fs::read(self.seconds_file(frame)).ok()?).ok()
    }

    /// Keeps a finished frame.
    pub fn store(&self, frame: &EncodedFrame) -> Result<()> {
        let path = self.frame_file(frame.record().frame);
        Ok(atomic::write_bytes(&path, &frame.to_bytes(&path)?)?)
    }

    fn transfer_file(&self, frame: i32) -> PathBuf {
        self.folder.join(format!("transfer.{frame}"))
    }

    /// The transfer of a frame that was finished before; none if it was not, or if its file is damaged.
    pub fn load_transfer(&self, frame: i32) -> Option<EncodedTransfer> {
        let path = self.transfer_file(frame);
        EncodedTransfer::from_bytes(&path, &std::fs::read(&path).ok()?).ok()
    }

    /// Keeps the transfer of a frame.
    pub fn store_transfer(&self, frame: i32, transfer: &EncodedTransfer) -> Result<()> {
        let path = self.transfer_file(frame);
        Ok(atomic::write_bytes(&path, &transfer.to_bytes(&path)?)?)
    }

    /// Keeps how long a run took that starts with `frame`, for the bake that takes it over.
    pub fn store_transfer_seconds(&self, frame: i32, seconds: &TransferSeconds) -> Result<()> {
        let path = self.folder.join(format!("transfer_seconds.{frame}"));
        let text = serde_json::to_string(seconds);
        let text = text.map_err(|e| smoke_formats::Error::invalid(&path, "seconds", e, "finite numbers"))?;
        Ok(atomic::write_bytes(&path, text.as_bytes())?)
    }

    /// How long that run took, if it was kept.
    pub fn load_transfer_seconds(&self, frame: i32) -> Option<TransferSeconds> {
        let path = self.folder.join(format!("transfer_seconds.{frame}"));
        serde_json::from_slice(&std::fs::read(path).ok()?).ok()
    }

    /// Where the pack is put together.
    pub fn pack_file(&self) -> PathBuf {
        self.folder.join("pack")
    }

    /// Moves the finished pack to `output` and removes the folder.
    pub fn finish(self, output: &Path) -> Result<()> {
        std::fs::rename(self.pack_file(), output).map_err(|e| smoke_formats::Error::io(output, e))?;
        // The new name must last before what it was made from is gone.
        #[cfg(unix)]
        if let Some(Ok(parent)) =
            self.folder.parent().map(|p| File::open(if p.as_os_str().is_empty() { Path::new(".") } else { p }))
        {
            // Some file systems cannot sync a folder; the pack itself is safe already.
            let _ = parent.sync_all();
        }
        // The lock last: a folder with files and without it would be taken for somebody else's.
        self.empty()?;
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
        drop(Work::open(&output, "one", false).unwrap());
        std::fs::write(&marker, b"damaged").unwrap();
        let work = Work::open(&output, "one", true).unwrap();
        assert!(marker.exists() && work.load(7).is_none(), "a damaged frame is baked again");
        let busy = Work::open(&output, "one", true).unwrap_err().to_string();
        assert!(busy.contains("another bake"), "{busy}");
        drop(work);
        let message = Work::open(&output, "two", true).unwrap_err().to_string();
        assert!(message.contains("other settings") && message.contains("--resume"), "{message}");
        assert!(marker.exists(), "a refusal changes nothing");
        Work::open(&output, "two", false).unwrap();
        assert!(!marker.exists());
    }

    #[test]
    fn a_folder_whose_bake_was_stopped_while_it_was_removed_is_resumed() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("a.smoke");
        let work = Work::open(&output, "one", false).unwrap();
        for file in ["frame.1", "frame.2", "transfer.1"] {
            std::fs::write(Work::folder_of(&output).join(file), b"some").unwrap();
        }
        work.empty().unwrap();
        let left: Vec<_> =
            std::fs::read_dir(Work::folder_of(&output)).unwrap().map(|e| e.unwrap().file_name()).collect();
        assert_eq!(left, [LOCK]);
        drop(work);
        drop(Work::open(&output, "one", true).unwrap());
        std::fs::remove_dir_all(Work::folder_of(&output)).unwrap();
        std::fs::create_dir(Work::folder_of(&output)).unwrap();
        drop(Work::open(&output, "one", true).unwrap());
    }

    #[test]
    fn a_folder_that_no_bake_made_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("a.smoke");
        let own = Work::folder_of(&output).join("thesis.txt");
        std::fs::create_dir(Work::folder_of(&output)).unwrap();
        std::fs::write(&own, b"mine").unwrap();
        for resume in [false, true] {
            let message = Work::open(&output, "one", resume).unwrap_err().to_string();
            assert!(message.contains("no bake made"), "{message}");
        }
        assert_eq!(std::fs::read(&own).unwrap(), b"mine");
    }
}
