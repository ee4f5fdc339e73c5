//! OpenVDB files: float grids in and out, without OpenVDB.
//!
//! Read: file versions 222 to 224; full and half floats; no compression, zlib or Blosc, with or without active-mask
//! compression, which may differ from grid to grid; tiles, backgrounds, instances, several grids, files without grid
//! offsets; every affine map. Refused by name: other value types and tree shapes, frustum maps.
//!
//! A file is: head and metadata (`header`), then for each grid a descriptor (`directory`), compression flags, metadata,
//! transform (`transform`), topology (`topology`), and the values of the leaves (`values`, `blosc`), which go into a
//! dense box (`dense`). The voxels are those of OpenVDB's `tree.getValue`, bit for bit, and the tests compare them with
//! OpenVDB's own library.
//!
//! Written: the same voxels, active set and map, with background zero (`write`).
//!
//! Memory of a reader is the file, the dense box, and less than the file for the list of leaves, whatever the bytes say.
//! Format: OpenVDB 12 (Museth 2013, "VDB: High-Resolution Sparse Volumes with Dynamic Topology"); no written
//! specification exists, so each file here names the part of the library whose behaviour it follows.

mod blosc;
mod dense;
mod directory;
mod header;
#[cfg(test)]
mod tests;
mod topology;
mod transform;
mod values;
mod write;

use crate::bounded::Bytes;
use crate::volume::DensityGrid;
use crate::{Error, Result};
use directory::Directory;
use std::path::Path;

pub(crate) use header::MAGIC;
pub use write::{WriteOptions, half_rounding, write};

/// What a file says about one of its grids.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct GridInfo {
    /// The name; `name[1]` if the file has several of that name. Either form can be given to [`read`].
    pub name: String,
    /// Type of a voxel, such as `float` or `vec3s`; the whole tree type if the tree's shape is unusual.
    pub value_type: String,
    /// `fog volume`, `level set`, `staggered` or `unknown`, if the file says so.
    pub class: Option<String>,
    /// Active voxels, if the file says so.
    pub active_voxels: Option<u64>,
    /// Values are stored as half floats.
    pub half: bool,
    /// As OpenVDB words it, such as `blosc + active values`.
    pub compression: String,
    /// Type of the map from index to world space, such as `UniformScaleMap`.
    pub map: String,
}

/// Reads the float grid called `grid` (usually "density") of the file at `path`.
///
/// The box holds the active voxels and, if the background is zero, every inactive voxel of another value too. A voxel
/// of the box has the value that OpenVDB would give, background included; outside the box a [`DensityGrid`] is zero even
/// if the background is not. Values are not judged: see [`DensityGrid::check_density`]. An empty grid is a box of no
/// voxels. The box has at most [`crate::bounded::MAX_DENSE_VOXELS`] voxels.
pub fn read(path: &Path, grid: &str) -> Result<DensityGrid> {
    read_bytes(path, &load(path)?, grid)
}

/// As [`read`], from the bytes of a file; `path` is for the messages.
pub fn read_bytes(path: &Path, bytes: &[u8], grid: &str) -> Result<DensityGrid> {
    let mut bytes = Bytes::new(path, bytes);
    let directory = Directory::read(&mut bytes)?;
    let descriptor = directory.find(&bytes, grid)?;
    let (world_from_index, voxels) = directory.read_grid(&bytes, descriptor)?;
    let dense::Dense { origin, dims, values, active } = voxels;
    Ok(DensityGrid { name: descriptor.name().to_owned(), origin, dims, values, active, world_from_index })
}

/// The grids of the file at `path`, in file order, readable or not.
pub fn list(path: &Path) -> Result<Vec<GridInfo>> {
    let file = load(path)?;
    let mut bytes = Bytes::new(path, &file);
    Directory::read(&mut bytes)?.list(&bytes)
}

/// The bytes of a regular file; a pipe or a device might never end.
fn load(path: &Path) -> Result<Vec<u8>> {
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if !metadata.is_file() {
        return Err(Error::invalid(path, "file", "a folder or a device", "a regular file"));
    }
    std::fs::read(path).map_err(|e| Error::io(path, e))
}
