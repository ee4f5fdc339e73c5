//! Files that appear whole or not at all.
//!
//! The bytes go to a temporary file in the target's own folder, are flushed to the disk, and the file is renamed over
//! the target: a reader sees the old file or the new one, never half of one, whatever happens in between.

use crate::{Error, Result};
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

/// Writes `path` through `fill`; on any error the target is untouched and the temporary file is removed.
///
/// The temporary file is `.<name>.<process>.<n>.tmp` beside the target. Missing folders are not made.
pub fn write<T>(path: &Path, fill: impl FnOnce(&mut BufWriter<File>) -> Result<T>) -> Result<T> {
    let (temporary, file) = create_beside(path)?;
    let mut writer = BufWriter::new(file);
    let written = fill(&mut writer).and_then(|value| {
        writer.flush().map_err(|e| Error::io(path, e))?;
        writer.get_ref().sync_all().map_err(|e| Error::io(path, e))?;
        std::fs::rename(&temporary, path).map_err(|e| Error::io(path, e))?;
        Ok(value)
    });
    if written.is_err() {
        // The first error is the one to report; a file that cannot be removed changes nothing about it.
        let _ = std::fs::remove_file(&temporary);
    }
    written
}

fn create_beside(path: &Path) -> Result<(PathBuf, File)> {
    let name = path.file_name().ok_or_else(|| Error::io(path, ErrorKind::InvalidInput.into()))?;
    let mut last = ErrorKind::AlreadyExists.into();
    for n in 0..100 {
        let mut temporary = std::ffi::OsString::from(".");
        temporary.push(name);
        temporary.push(format!(".{}.{n}.tmp", std::process::id()));
        let temporary = path.with_file_name(temporary);
        match OpenOptions::new().read(true).write(true).create_new(true).open(&temporary) {
            Ok(file) => return Ok((temporary, file)),
            Err(e) if e.kind() == ErrorKind::AlreadyExists => last = e,
            Err(e) => return Err(Error::io(path, e)),
        }
    }
    Err(Error::io(path, last))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write(&path, |w| w.write_all(b"old").map_err(|e| Error::io(&path, e))).unwrap();
        let failed: Result<()> = write(&path, |w| {
            w.write_all(b"new").map_err(|e| Error::io(&path, e))?;
            Err(Error::invalid(&path, "x", 1, 2))
        });
        assert!(failed.is_err());
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        write(&path, |w| w.write_all(b"new").map_err(|e| Error::io(&path, e))).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
    }
}
