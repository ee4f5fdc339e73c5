//! Files that appear whole or not at all.
//!
//! The bytes go to a temporary file in the folder of the target, reach the disk (`fsync`), and only then take the
//! target's name. A reader, a render farm's "skip existing" and a resumed run never see half a file, and a failed
//! write leaves the file that was there before untouched.

use crate::{Error, Result};
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes `path` through `fill`. On any error the temporary file is removed and `path` keeps what it held.
pub fn write(path: &Path, fill: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let temporary = temporary_beside(path);
    let result = write_temporary(path, &temporary, fill);
    if result.is_err() {
        // Nothing more can be done about a temporary file that cannot be removed; the first error is the one to tell.
        let _ = fs::remove_file(&temporary);
    }
    result
}

fn write_temporary(path: &Path, temporary: &Path, fill: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let io = |e| Error::io(path, e);
    let file = OpenOptions::new().read(true).write(true).create_new(true).open(temporary).map_err(io)?;
    let mut writer = BufWriter::new(file);
    fill(&mut writer)?;
    writer.flush().map_err(io)?;
    writer.get_ref().sync_all().map_err(io)?;
    // The handle must be closed before the rename on systems that lock open files.
    drop(writer);
    fs::rename(temporary, path).map_err(io)
}

/// A name in the same folder (a rename across file systems would not be atomic), unique in this process and, by its
/// number, among processes.
fn temporary_beside(path: &Path) -> PathBuf {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.{}.tmp", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed)));
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_written_file_holds_the_bytes_and_leaves_no_temporary_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, |w| w.write_all(b"smoke").map_err(|e| Error::io(&path, e))).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"smoke");
        assert_eq!(names(folder.path()), ["a.bin"]);
    }

    #[test]
    fn a_failed_write_keeps_the_old_file_and_leaves_no_temporary_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        fs::write(&path, b"old").unwrap();
        let failed = write(&path, |w| {
            w.write_all(b"half").map_err(|e| Error::io(&path, e))?;
            Err(Error::invalid(&path, "planted", 1, 2))
        });
        assert!(failed.is_err());
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["a.bin"]);
    }

    #[test]
    fn a_missing_folder_is_an_error_that_names_the_target() {
        let message = write(Path::new("no/such/folder/a.bin"), |_| Ok(())).unwrap_err().to_string();
        assert!(message.starts_with("no/such/folder/a.bin: "), "{message}");
    }
}
