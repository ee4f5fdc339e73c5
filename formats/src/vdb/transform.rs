//! The affine maps of OpenVDB, read and written: index space to world space.
//!
//! Scale maps store scale, |scale|, 1/scale, 1/scale² and 1/(2 scale) (three f64 each); only the first is read. A
//! translating scale map has its translation in front. Affine and unitary maps are 4x4 matrices for row vectors, row by
//! row: `world = (x, y, z, 1) · M`, so a row of the file is a column of ours. Source: OpenVDB 12, `math/Maps.h`.

use super::header::name;
use crate::bounded::Bytes;
use crate::{Error, Result};
use glam::{DAffine3, DMat3, DVec3};

/// Reads the type name of a map, such as `UniformScaleMap`.
pub(super) fn read_kind(bytes: &mut Bytes) -> Result<String> {
    name(bytes, "transform type")
}

/// Reads a map of the type that [`read_kind`] gave.
pub(super) fn read(bytes: &mut Bytes, kind: &str) -> Result<DAffine3> {
    let matrix = match kind {
        "UniformScaleMap" | "ScaleMap" => {
            let scale = vector(bytes)?;
            bytes.take(4 * 24, "transform")?;
            DAffine3::from_scale(scale)
        }
        "UniformScaleTranslateMap" | "ScaleTranslateMap" => {
            let (translation, scale) = (vector(bytes)?, vector(bytes)?);
            bytes.take(4 * 24, "transform")?;
            DAffine3 { matrix3: DMat3::from_diagonal(scale), translation }
        }
        "TranslationMap" => DAffine3::from_translation(vector(bytes)?),
        "AffineMap" | "UnitaryMap" => {
            let mut columns = [DVec3::ZERO; 4];
            let mut last = [0.0; 4];
            for (column, last) in columns.iter_mut().zip(&mut last) {
                *column = vector(bytes)?;
                *last = bytes.f64("transform")?;
            }
            if last != [0.0, 0.0, 0.0, 1.0] {
                return Err(bytes.invalid("last column of the transform", format!("{last:?}"), "[0, 0, 0, 1]"));
            }
            DAffine3::from_cols(columns[0], columns[1], columns[2], columns[3])
        }
        "NonlinearFrustumMap" => {
            let hint = "resample the grid to an ordinary (affine) volume first";
            return Err(Error::unsupported(bytes.path(), "transform type", kind, hint));
        }
        _ => {
            let hint = "uniform, scale, translation, affine and unitary maps are read";
            return Err(Error::unsupported(bytes.path(), "transform type", kind.escape_debug(), hint));
        }
    };
    if !invertible(&matrix) {
        return Err(bytes.invalid("transform", format!("{matrix:?}"), "a finite, invertible map"));
    }
    Ok(matrix)
}

fn vector(bytes: &mut Bytes) -> Result<DVec3> {
    Ok(DVec3::new(bytes.f64("transform")?, bytes.f64("transform")?, bytes.f64("transform")?))
}

/// Finite and of full rank, at any scale: the axes are normalised first, so that tiny voxels do not underflow.
fn invertible(map: &DAffine3) -> bool {
    let axes = [map.matrix3.x_axis, map.matrix3.y_axis, map.matrix3.z_axis];
    let unit = axes.map(|axis| {
        let largest = axis.abs().max_element();
        (axis / largest).normalize()
    });
    map.is_finite() && DMat3::from_cols(unit[0], unit[1], unit[2]).determinant().abs() > 0.0
}

/// Appends the type name and the data of the plainest map that says exactly `map`; fails if it is not invertible.
pub(super) fn write(out: &mut Vec<u8>, path: &std::path::Path, map: &DAffine3) -> Result<()> {
    if !invertible(map) {
        return Err(Error::invalid(path, "transform to write", format!("{map:?}"), "a finite, invertible map"));
    }
    let DAffine3 { matrix3, translation } = *map;
    let scale = DVec3::new(matrix3.x_axis.x, matrix3.y_axis.y, matrix3.z_axis.z);
    let moved = translation != DVec3::ZERO;
    let mut put_kind = |kind: &str| {
        out.extend((kind.len() as u32).to_le_bytes());
        out.extend(kind.as_bytes());
    };
    let mut numbers: Vec<f64> = Vec::new();
    if matrix3 == DMat3::from_diagonal(scale) {
        let uniform = scale.x == scale.y && scale.y == scale.z;
        put_kind(match (uniform, moved) {
            (true, false) => "UniformScaleMap",
            (true, true) => "UniformScaleTranslateMap",
            (false, false) => "ScaleMap",
            (false, true) => "ScaleTranslateMap",
        });
        if moved {
            numbers.extend(translation.to_array());
        }
        let inverse = scale.recip();
        for part in [scale, scale.abs(), inverse, inverse * inverse, inverse * 0.5] {
            numbers.extend(part.to_array());
        }
    } else {
        put_kind("AffineMap");
        let rows = [(matrix3.x_axis, 0.0), (matrix3.y_axis, 0.0), (matrix3.z_axis, 0.0), (translation, 1.0)];
        for (row, last) in rows {
            numbers.extend(row.to_array());
            numbers.push(last);
        }
    }
    out.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn round_trip(map: DAffine3) -> (String, DAffine3) {
        let mut out = Vec::new();
        write(&mut out, Path::new("a"), &map).unwrap();
        let mut bytes = Bytes::new(Path::new("a"), &out);
        let kind = read_kind(&mut bytes).unwrap();
        let back = read(&mut bytes, &kind).unwrap();
        bytes.finish("transform").unwrap();
        (kind, back)
    }

    #[test]
    fn every_written_map_reads_back_with_the_same_bits() {
        let rotation = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7) * 0.1;
        let far = DVec3::new(1e6, -2.5, 1e-6);
        for (kind, map) in [
            ("UniformScaleMap", DAffine3::from_scale(DVec3::splat(1e-6))),
            (
                "UniformScaleTranslateMap",
                DAffine3 { matrix3: DMat3::from_diagonal(DVec3::splat(1e6)), translation: far },
            ),
            ("ScaleMap", DAffine3::from_scale(DVec3::new(0.1, -0.2, 0.3))),
            (
                "ScaleTranslateMap",
                DAffine3 { matrix3: DMat3::from_diagonal(DVec3::new(3.0, 2.0, 1.0)), translation: far },
            ),
            ("AffineMap", DAffine3 { matrix3: rotation, translation: far }),
        ] {
            assert_eq!(round_trip(map), (kind.to_owned(), map));
        }
    }

    #[test]
    fn translations_and_unitary_maps_are_read() {
        let numbers = |n: &[f64]| n.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let data = numbers(&[1.0, 2.0, 3.0]);
        let map = read(&mut Bytes::new(Path::new("a"), &data), "TranslationMap").unwrap();
        assert_eq!(map, DAffine3::from_translation(DVec3::new(1.0, 2.0, 3.0)));
        // A quarter turn about z for row vectors: x goes to y.
        let data = numbers(&[0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.]);
        let map = read(&mut Bytes::new(Path::new("a"), &data), "UnitaryMap").unwrap();
        assert_eq!(map.transform_point3(DVec3::X), DVec3::Y);
    }

    #[test]
    fn frusta_and_singular_maps_are_refused_by_name() {
        let error = read(&mut Bytes::new(Path::new("a.vdb"), &[]), "NonlinearFrustumMap").unwrap_err().to_string();
        assert!(error.contains("NonlinearFrustumMap") && error.contains("resample"), "{error}");
        for scale in [[1.0, 0.0, 1.0], [f64::NAN, 1.0, 1.0], [1.0, 1.0, f64::INFINITY]] {
            let data: Vec<u8> = scale.iter().chain(&[1.0; 12]).flat_map(|v| v.to_le_bytes()).collect();
            assert!(read(&mut Bytes::new(Path::new("a"), &data), "ScaleMap").is_err(), "{scale:?}");
        }
    }
}
