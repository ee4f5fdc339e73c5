//! One volume from a file of any kind that is read: OpenVDB, pbrt medium, Mitsuba `.vol`.
//!
//! The first bytes decide between OpenVDB and Mitsuba; text has no mark, so that pbrt goes by its extension.

use crate::volume::DensityGrid;
use crate::{Error, Result, mitsuba_vol, pbrt, vdb};
use std::io::Read;
use std::path::Path;

/// Reads the float grid called `grid` of the file at `path`. Grids of pbrt and Mitsuba are called "density".
pub fn read(path: &Path, grid: &str) -> Result<DensityGrid> {
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    // A pipe or a device might never end.
    if !metadata.is_file() {
        return Err(Error::invalid(path, "file", "a folder or a device", "a regular file"));
    }
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(|e| Error::io(path, e))?;
    file.take(8).read_to_end(&mut head).map_err(|e| Error::io(path, e))?;
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    let read_only = |read: fn(&Path) -> Result<DensityGrid>| match grid {
        "density" => read(path),
        _ => Err(Error::invalid(path, "grid", "density (float)", format!("a grid named '{grid}'"))),
    };
    // Content first: a VDB file stays one whatever it is called. A damaged head goes by the extension.
    match extension.as_deref() {
        _ if head == vdb::MAGIC => vdb::read(path, grid),
        _ if head.starts_with(&mitsuba_vol::MAGIC[..3]) => read_only(mitsuba_vol::read),
        Some("pbrt") => read_only(pbrt::read),
        Some("vol") => read_only(mitsuba_vol::read),
        Some("vdb") => vdb::read(path, grid),
        _ => {
            let expected = "an OpenVDB (.vdb), pbrt (.pbrt) or Mitsuba (.vol) volume";
            Err(Error::invalid(path, "kind of file", format!("first bytes {head:02x?}"), expected))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn content_decides_before_the_extension_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let text = "MakeNamedMedium \"a\" \"float density\" 0.5";
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("a.pbrt"), text).unwrap();
        let grid = read(&path("a.pbrt"), "density").unwrap();
        assert_eq!(grid.values, [0.5]);
        vdb::write(&path("named.vol"), &grid, &vdb::WriteOptions::default()).unwrap();
        mitsuba_vol::write(&path("named.vdb"), &grid).unwrap();
        assert_eq!(read(&path("named.vol"), "density").unwrap(), grid);
        assert_eq!(read(&path("named.vdb"), "density").unwrap(), grid);
        assert!(read(&path("a.pbrt"), "heat").unwrap_err().to_string().contains("density (float)"));
        std::fs::write(path("a.txt"), "hello").unwrap();
        std::fs::write(path("empty.vdb"), "").unwrap();
        for (name, what) in
            [("a.txt", "kind of file"), ("empty.vdb", "magic number"), ("none.vdb", "none.vdb"), ("", "folder")]
        {
            let message = read(&path(name), "density").unwrap_err().to_string();
            assert!(message.contains(what), "{message}");
        }
    }
}
