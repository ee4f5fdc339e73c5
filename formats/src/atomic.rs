//! Files that appear whole or not at all.
//!
//! The bytes go to a temporary file in the same folder, are flushed to the disk, and then the file is renamed over the
//! target: a reader sees the old file or the new one, and a failure leaves the old one alone. One more fsync (of the
//! folder, on Unix) makes the new name last through a power cut.

use crate::{Error, Result};
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Writes the file `path` with `body` and gives what it returns. If `body` fails, nothing changes on the disk.
///
/// Errors of the writer inside `body` are best turned into ours by [`Error::io`] with the same `path`.
pub fn write<T>(path: &Path, body: impl FnOnce(&mut BufWriter<File>) -> Result<T>) -> Result<T> {
    let io = |e| Error::io(path, e);
    // A rename would replace a device or a pipe by a file; a folder could not be replaced at all.
    if fs::metadata(path).is_ok_and(|m| !m.is_file()) {
        return Err(Error::invalid(path, "output", "a folder or a device", "a regular file or a new name"));
    }
    let (temporary, file) = create_beside(path).map_err(io)?;
    let mut guard = RemoveOnDrop(Some(temporary));
    let mut writer = BufWriter::with_capacity(1 << 18, file);
    let result = body(&mut writer)?;
    let file = writer.into_inner().map_err(|e| io(e.into_error()))?;
    file.sync_all().map_err(io)?;
    drop(file);
    if let Some(temporary) = &guard.0 {
        fs::rename(temporary, path).map_err(io)?;
    }
    guard.0 = None;
    #[cfg(unix)]
    if let Ok(folder) = File::open(folder_of(path)) {
        // Some file systems cannot sync a folder; the file itself is safe already.
        let _ = folder.sync_all();
    }
    Ok(result)
}

/// As [`write()`], for bytes that are all there.
pub fn write_bytes(path: &Path, bytes: &[u8]) -> Result<()> {
    write(path, |file| file.write_all(bytes).map_err(|e| Error::io(path, e)))
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

fn create_beside(path: &Path) -> std::io::Result<(PathBuf, File)> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let name = path.file_name().ok_or_else(|| std::io::Error::other("the path names no file"))?;
    loop {
        let number = COUNTER.fetch_add(1, Ordering::Relaxed);
        let mut hidden = std::ffi::OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}-{number}.tmp", std::process::id()));
        let temporary = folder_of(path).join(hidden);
        match OpenOptions::new().read(true).write(true).create_new(true).open(&temporary) {
            Ok(file) => return Ok((temporary, file)),
            // Left behind by an earlier process of the same number.
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(e),
        }
    }
}

struct RemoveOnDrop(Option<PathBuf>);

impl Drop for RemoveOnDrop {
    fn drop(&mut self) {
        if let Some(path) = &self.0 {
            // Nothing better can be done if even this fails.
            let _ = fs::remove_file(path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(folder: &Path) -> Vec<String> {
        let names = fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        names.collect()
    }

    #[test]
    fn a_file_is_replaced_whole_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.bin");
        write_bytes(&path, b"old").unwrap();
        write_bytes(&path, b"newer").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"newer");
        assert_eq!(files(folder.path()), ["out.bin"]);
    }

    #[test]
    fn a_failure_or_a_panic_half_way_keeps_the_old_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.bin");
        write_bytes(&path, b"old").unwrap();
        let failed = write(&path, |file| {
            file.write_all(b"half").unwrap();
            Err::<(), _>(Error::invalid(&path, "test", 1, 2))
        });
        assert!(failed.is_err());
        let panicked = std::panic::catch_unwind(|| write(&path, |_| -> Result<()> { panic!("planted") }));
        assert!(panicked.is_err());
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(files(folder.path()), ["out.bin"]);
    }

    #[test]
    fn a_missing_folder_and_a_folder_as_target_are_errors_that_name_the_path() {
        let folder = tempfile::tempdir().unwrap();
        let error = write_bytes(&folder.path().join("none/out.bin"), b"").unwrap_err().to_string();
        assert!(error.contains("none/out.bin"), "{error}");
        assert!(write_bytes(folder.path(), b"").unwrap_err().to_string().contains("folder"));
    }
}
