//! Mitsuba's `.vol` grids, version 3: one channel in, one channel out.
//!
//! | bytes | field |
//! |---|---|
//! | 3 | `VOL` |
//! | 1 | version, 3 |
//! | 4 | i32 encoding: 1 = f32, 2 = half, 3 = u8 (0..255 means 0..1) |
//! | 12 | i32 voxels along x, y, z |
//! | 4 | i32 channels |
//! | 24 | f32 bounding box, least corner then greatest |
//! | rest | values, channel fastest, then x, y, z |
//!
//! The box spans the outer edges of the voxels: `world = low + (index + 1/2) (high - low) / n`. Mitsuba 3 itself uses
//! the box only with `use_grid_bbox`. Written are f32 values; the box is f32, so that placement keeps 24 bits only.
//! Source: Mitsuba 0.6 documentation, `gridvolume`; Mitsuba 3, `src/volumes/grid.cpp`.

use crate::bounded::{Bytes, MAX_DENSE_VOXELS};
use crate::volume::{DensityGrid, VoxelMask};
use crate::{Error, Result, atomic};
use glam::{DAffine3, DMat3, DVec3};
use half::f16;
use std::path::Path;

/// The first four bytes of a file: name and version.
pub(crate) const MAGIC: [u8; 4] = *b"VOL\x03";

/// Reads the file at `path`. Active are the voxels that are not zero.
pub fn read(path: &Path) -> Result<DensityGrid> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    read_bytes(path, &bytes)
}

/// As [`read`], from the bytes of a file; `path` is for the messages.
pub fn read_bytes(path: &Path, bytes: &[u8]) -> Result<DensityGrid> {
    let mut bytes = Bytes::new(path, bytes);
    let magic = bytes.take(4, "magic number and version")?;
    if magic != MAGIC {
        return Err(bytes.invalid(
            "magic number and version",
            format!("{magic:02x?}"),
            format!("{MAGIC:02x?} (VOL 3)"),
        ));
    }
    let encoding = bytes.i32("encoding")?;
    let value_bytes = match encoding {
        1 => 4,
        2 => 2,
        3 => 1,
        _ => {
            let hint = "float32 (1), float16 (2) and uint8 (3) are read";
            return Err(Error::unsupported(path, "encoding", encoding, hint));
        }
    };
    let mut dims = [0; 3];
    for (dim, what) in dims.iter_mut().zip(["voxels along x", "voxels along y", "voxels along z"]) {
        let count = bytes.i32(what)?;
        *dim = usize::try_from(count).ok().filter(|&d| d > 0).ok_or_else(|| bytes.invalid(what, count, "above 0"))?;
    }
    let channels = bytes.i32("channels")?;
    if channels != 1 {
        return Err(Error::unsupported(path, "channels", channels, "a density has 1 channel; split the file"));
    }
    let mut corners = [0.0; 6];
    for corner in &mut corners {
        *corner = f64::from(bytes.f32("bounding box")?);
    }
    let (low, high) = (DVec3::from_slice(&corners), DVec3::from_slice(&corners[3..]));
    let step = (high - low) / DVec3::from(dims.map(|d| d as f64));
    if !(step.min_element() > 0.0 && step.is_finite() && low.is_finite()) {
        return Err(bytes.invalid("bounding box", format!("{low} to {high}"), "a finite box of non-zero size"));
    }
    let voxels = dims.iter().map(|&d| d as u128).product::<u128>();
    if voxels > u128::from(MAX_DENSE_VOXELS) || voxels * value_bytes != bytes.remaining() as u128 {
        let expected = format!("{voxels} voxels of {value_bytes} bytes, at most {MAX_DENSE_VOXELS} voxels");
        return Err(bytes.invalid("values", format!("{} bytes", bytes.remaining()), expected));
    }
    let raw = bytes.take(bytes.remaining(), "values")?;
    let values: Vec<f32> = match encoding {
        1 => raw.chunks_exact(4).map(|v| f32::from_le_bytes([v[0], v[1], v[2], v[3]])).collect(),
        2 => raw.chunks_exact(2).map(|v| f16::from_le_bytes([v[0], v[1]]).to_f32()).collect(),
        _ => raw.iter().map(|&v| f32::from(v) / 255.0).collect(),
    };
    let mut active = VoxelMask::new(values.len());
    values.iter().enumerate().filter(|(_, v)| **v != 0.0).for_each(|(v, _)| active.set(v));
    let world_from_index = DAffine3 { matrix3: DMat3::from_diagonal(step), translation: low + 0.5 * step };
    Ok(DensityGrid { name: "density".into(), origin: [0; 3], dims, values, active, world_from_index })
}

/// Writes the box of `grid` as f32 at `path`, whole or not at all.
///
/// Errors: an empty grid, and a transform that turns, mirrors or shears: the format knows upright boxes only.
pub fn write(path: &Path, grid: &DensityGrid) -> Result<()> {
    atomic::write_bytes(path, &to_bytes(path, grid)?)
}

fn to_bytes(path: &Path, grid: &DensityGrid) -> Result<Vec<u8>> {
    if grid.is_empty() {
        return Err(Error::invalid(path, "grid to write", "no voxels", "at least one"));
    }
    let map = &grid.world_from_index;
    let step = DVec3::new(map.matrix3.x_axis.x, map.matrix3.y_axis.y, map.matrix3.z_axis.z);
    let upright = map.matrix3 == DMat3::from_diagonal(step) && step.min_element() > 0.0;
    if !upright {
        let hint = "resample the grid to upright voxels, or write OpenVDB";
        return Err(Error::unsupported(path, "transform to write", format!("{:?}", map.matrix3), hint));
    }
    let edge = |index: [f64; 3]| map.transform_point3(DVec3::from(index)).as_vec3();
    let low = edge(grid.origin.map(|o| f64::from(o) - 0.5));
    let high = edge(std::array::from_fn(|a| f64::from(grid.origin[a]) + grid.dims[a] as f64 - 0.5));
    if !(high.is_finite() && low.is_finite() && low.cmplt(high).all()) {
        let expected = "a finite box of non-zero size in f32";
        return Err(Error::invalid(path, "bounding box to write", format!("{low} to {high}"), expected));
    }
    let mut out = MAGIC.to_vec();
    out.extend(1i32.to_le_bytes());
    for dim in grid.dims {
        let count = i32::try_from(dim).map_err(|_| Error::invalid(path, "voxels along an axis", dim, i32::MAX))?;
        out.extend(count.to_le_bytes());
    }
    out.extend(1i32.to_le_bytes());
    out.extend(low.to_array().iter().chain(&high.to_array()).flat_map(|c| c.to_le_bytes()));
    out.extend(grid.values.iter().flat_map(|v| v.to_le_bytes()));
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> DensityGrid {
        let values: Vec<f32> = (0..24).map(|v| (v % 5) as f32 * 0.25).collect();
        let mut active = VoxelMask::new(24);
        (0..24).filter(|v| v % 5 != 0).for_each(|v| active.set(v));
        let (name, translation) = ("density".to_owned(), DVec3::new(1.25, 2.5, -0.75));
        let world_from_index = DAffine3 { matrix3: DMat3::from_diagonal(DVec3::new(0.5, 1.0, 0.25)), translation };
        DensityGrid { name, origin: [0; 3], dims: [2, 3, 4], values, active, world_from_index }
    }

    fn bytes() -> Vec<u8> {
        to_bytes(Path::new("a.vol"), &sample()).unwrap()
    }

    #[test]
    fn a_written_grid_reads_back_and_its_box_spans_the_voxels_edges() {
        // Every corner is a short binary fraction: nothing is rounded.
        let grid = read_bytes(Path::new("a.vol"), &bytes()).unwrap();
        assert_eq!(grid, sample());
        let corners: Vec<f32> =
            bytes()[24..48].chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect();
        assert_eq!(corners, [1.0, 2.0, -0.875, 2.0, 5.0, 0.125]);
    }

    #[test]
    fn half_and_byte_values_are_read() {
        let mut half = bytes()[..48].to_vec();
        half[4] = 2;
        half.extend(sample().values.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()));
        assert_eq!(read_bytes(Path::new("a"), &half).unwrap().values, sample().values);
        let mut byte = bytes()[..48].to_vec();
        byte[4] = 3;
        byte.extend([0, 255, 51].repeat(8));
        assert_eq!(read_bytes(Path::new("a"), &byte).unwrap().values, [0.0, 1.0, 0.2].repeat(8));
    }

    #[test]
    fn every_prefix_an_extra_byte_and_every_wrong_field_is_refused() {
        let good = bytes();
        (0..good.len()).for_each(|end| assert!(read_bytes(Path::new("a"), &good[..end]).is_err(), "prefix {end}"));
        assert!(read_bytes(Path::new("a"), &[&good[..], &[0]].concat()).is_err());
        for (at, byte, what) in [
            (0, b'W', "magic"),
            (3, 2, "magic"),
            (4, 4, "encoding"),
            (8, 0, "along x"),
            (15, 255, "along y"),
            (20, 3, "channels"),
            (47, 255, "bounding box"),
            (11, 127, "values"),
        ] {
            let mut bad = good.clone();
            bad[at] = byte;
            let message = read_bytes(Path::new("a.vol"), &bad).unwrap_err().to_string();
            assert!(message.contains(what), "{at}: {message}");
        }
    }

    #[test]
    fn a_turned_a_mirrored_and_an_empty_grid_cannot_be_written() {
        let write = |matrix3| {
            to_bytes(Path::new("a"), &DensityGrid { world_from_index: DAffine3::from_mat3(matrix3), ..sample() })
        };
        assert!(write(DMat3::from_rotation_z(0.1)).is_err());
        assert!(write(DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0))).is_err());
        assert!(write(DMat3::from_diagonal(DVec3::splat(1e300))).is_err());
        let empty = DensityGrid { dims: [0; 3], values: vec![], active: VoxelMask::new(0), ..sample() };
        assert!(to_bytes(Path::new("a"), &empty).is_err());
    }
}
