//! The density of a pbrt medium, from pbrt's scene text: version 3 `heterogeneous`, version 4 `uniformgrid`.
//!
//! One `MakeNamedMedium` with `nx ny nz`, `density` (x fastest) and the box `p0 p1` (default the unit cube). Samples sit
//! at cell centres: `world = p0 + (index + 1/2) (p1 - p0) / n`. Other parameters are stepped over: what the medium
//! scatters is set in our scene file. Placement by transform statements is refused, since it would be lost.
//! Cost: one pass over the text, about 20 ns a number. Source: pbrt-v3 `media/grid.cpp`, pbrt-v4 `media.cpp`.

use crate::bounded::MAX_DENSE_VOXELS;
use crate::volume::{DensityGrid, VoxelMask};
use crate::{Error, Result};
use glam::{DAffine3, DMat3, DVec3};
use std::path::Path;

/// Statements that move what follows them.
const TRANSFORMS: [&str; 8] =
    ["Translate", "Scale", "Rotate", "LookAt", "Transform", "ConcatTransform", "CoordSysTransform", "Include"];

/// Reads the one density grid of the file at `path`. Active are the voxels that are not zero.
pub fn read(path: &Path) -> Result<DensityGrid> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    read_bytes(path, &bytes)
}

/// As [`read`], from the bytes of a file; `path` is for the messages.
pub fn read_bytes(path: &Path, bytes: &[u8]) -> Result<DensityGrid> {
    let text = std::str::from_utf8(bytes).map_err(|e| Error::invalid(path, "pbrt text", e, "UTF-8"))?;
    let mut found: Option<Medium> = None;
    let mut medium: Option<Medium> = None;
    let mut moved_by = None;
    let mut tokens = Tokens { path, text, at: 0 };
    while let Some(token) = tokens.next()? {
        match token {
            Token::Word(word) => {
                keep(path, &mut found, medium.take())?;
                match word {
                    "MakeNamedMedium" => medium = Some(Medium { moved_by, ..Medium::default() }),
                    // The world starts at the identity again.
                    "WorldBegin" | "Identity" => moved_by = None,
                    _ => moved_by = TRANSFORMS.into_iter().find(|t| *t == word).or(moved_by),
                }
            }
            Token::Quoted(declaration) => {
                let mut parts = declaration.split_ascii_whitespace();
                if let (Some(medium), Some(_), Some(name)) = (&mut medium, parts.next(), parts.next()) {
                    medium.parameter(&mut tokens, name)?;
                }
            }
            Token::Open | Token::Close | Token::Number(_) => {}
        }
    }
    keep(path, &mut found, medium)?;
    match found {
        Some(medium) => medium.into_grid(path),
        None => Err(Error::invalid(path, "pbrt text", "no density", "a MakeNamedMedium with \"float density\" [...]")),
    }
}

/// Keeps a finished medium if it has a density; two of them cannot be told apart.
fn keep(path: &Path, found: &mut Option<Medium>, finished: Option<Medium>) -> Result<()> {
    let Some(medium) = finished.filter(|m| m.density.is_some()) else { return Ok(()) };
    if found.replace(medium).is_some() {
        return Err(Error::unsupported(path, "pbrt text", "more than one density", "keep one medium in the file"));
    }
    Ok(())
}

#[derive(Default)]
struct Medium {
    counts: [Option<f64>; 3],
    corners: [Option<[f64; 3]>; 2],
    density: Option<Vec<f32>>,
    moved_by: Option<&'static str>,
}

impl Medium {
    fn parameter(&mut self, tokens: &mut Tokens, name: &str) -> Result<()> {
        let path = tokens.path;
        match name {
            "nx" | "ny" | "nz" => {
                let axis = usize::from(name.as_bytes()[1] - b'x');
                self.counts[axis] = tokens.values::<f64>(name)?.first().copied();
            }
            "p0" | "p1" => {
                let values = tokens.values(name)?;
                let point = <[f64; 3]>::try_from(values)
                    .map_err(|v| Error::invalid(path, name, format!("{} numbers", v.len()), "3 numbers"))?;
                self.corners[usize::from(name == "p1")] = Some(point);
            }
            "density" => self.density = Some(tokens.values(name)?),
            _ => {}
        }
        Ok(())
    }

    fn into_grid(self, path: &Path) -> Result<DensityGrid> {
        if let Some(statement) = self.moved_by {
            let hint = "copy the MakeNamedMedium statement to a file of its own and place it in the scene file";
            return Err(Error::unsupported(path, "statement before the medium", statement, hint));
        }
        let mut dims = [1usize; 3];
        for (a, dim) in dims.iter_mut().enumerate() {
            // pbrt's default is one sample.
            let count = self.counts[a].unwrap_or(1.0);
            if !(count >= 1.0 && count <= MAX_DENSE_VOXELS as f64 && count.fract() == 0.0) {
                let expected = format!("a whole number from 1 to {MAX_DENSE_VOXELS}");
                return Err(Error::invalid(path, ["nx", "ny", "nz"][a], count, expected));
            }
            *dim = count as usize;
        }
        let values = self.density.unwrap_or_default();
        let voxels = dims.iter().map(|&d| d as u128).product::<u128>();
        if values.len() as u128 != voxels || voxels > u128::from(MAX_DENSE_VOXELS) {
            let expected = format!("{} x {} x {} (at most {MAX_DENSE_VOXELS})", dims[0], dims[1], dims[2]);
            return Err(Error::invalid(path, "density", format!("{} numbers", values.len()), expected));
        }
        let [p0, p1] = [(0, 0.0), (1, 1.0)].map(|(i, default)| DVec3::from(self.corners[i].unwrap_or([default; 3])));
        let (low, high) = (p0.min(p1), p0.max(p1));
        let step = (high - low) / DVec3::from(dims.map(|d| d as f64));
        if !(step.min_element() > 0.0 && step.is_finite() && low.is_finite()) {
            return Err(Error::invalid(path, "p0 and p1", format!("{p0} and {p1}"), "a box of finite, non-zero size"));
        }
        let mut active = VoxelMask::new(values.len());
        values.iter().enumerate().filter(|(_, v)| **v != 0.0).for_each(|(v, _)| active.set(v));
        let world_from_index = DAffine3 { matrix3: DMat3::from_diagonal(step), translation: low + 0.5 * step };
        Ok(DensityGrid { name: "density".into(), origin: [0; 3], dims, values, active, world_from_index })
    }
}

enum Token<'a> {
    Word(&'a str),
    Quoted(&'a str),
    Number(&'a str),
    Open,
    Close,
}

struct Tokens<'a> {
    path: &'a Path,
    text: &'a str,
    at: usize,
}

impl<'a> Tokens<'a> {
    fn next(&mut self) -> Result<Option<Token<'a>>> {
        let bytes = self.text.as_bytes();
        loop {
            match bytes.get(self.at) {
                None => return Ok(None),
                Some(b) if b.is_ascii_whitespace() => self.at += 1,
                Some(b'#') => {
                    self.at = bytes[self.at..].iter().position(|&b| b == b'\n').map_or(bytes.len(), |n| self.at + n);
                }
                Some(_) => break,
            }
        }
        let start = self.at;
        // Every byte looked for below is ASCII, so that slices never cut a character.
        let until = |from: usize, end: fn(u8) -> bool| {
            bytes[from..].iter().position(|&b| end(b)).map_or(bytes.len(), |n| from + n)
        };
        Ok(Some(match bytes[start] {
            b'"' => {
                let end = until(start + 1, |b| b == b'"');
                if end == bytes.len() {
                    return Err(Error::invalid(
                        self.path,
                        "pbrt text",
                        format!("an open quote at byte {start}"),
                        "its end",
                    ));
                }
                self.at = end + 1;
                Token::Quoted(&self.text[start + 1..end])
            }
            open @ (b'[' | b']') => {
                self.at += 1;
                if open == b'[' { Token::Open } else { Token::Close }
            }
            first => {
                self.at = until(start + 1, |b| b.is_ascii_whitespace() || matches!(b, b'"' | b'[' | b']' | b'#'));
                let token = &self.text[start..self.at];
                let number = first.is_ascii_digit() || matches!(first, b'-' | b'+' | b'.');
                if number { Token::Number(token) } else { Token::Word(token) }
            }
        }))
    }

    /// The numbers of one parameter: one alone, or a list in brackets.
    fn values<T: std::str::FromStr>(&mut self, name: &str) -> Result<Vec<T>> {
        let path = self.path;
        let parse =
            |number: &str| number.parse().map_err(|_| Error::invalid(path, name, number.escape_debug(), "a number"));
        match self.next()? {
            Some(Token::Number(number)) => return Ok(vec![parse(number)?]),
            Some(Token::Open) => {}
            _ => return Err(Error::invalid(path, name, "no value", "a number or a list in brackets")),
        }
        let mut values = Vec::new();
        loop {
            match self.next()? {
                Some(Token::Number(number)) => values.push(parse(number)?),
                Some(Token::Close) => return Ok(values),
                Some(Token::Word(word)) => return Err(Error::invalid(path, name, word.escape_debug(), "a number")),
                _ => return Err(Error::invalid(path, name, "no closing bracket", "]")),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<DensityGrid> {
        read_bytes(Path::new("a.pbrt"), text.as_bytes())
    }

    const TWO: &str = "\"integer nx\" [2] \"integer ny\" 1 \"integer nz\" 1 \"float density\" [0 .5]";

    #[test]
    fn both_versions_place_samples_at_cell_centres() {
        for (kind, point) in [("heterogeneous", "point"), ("uniformgrid", "point3")] {
            let text = format!(
                "LookAt 1 2 3 0 0 0 0 0 1 # camera\nWorldBegin\nMakeNamedMedium \"a\" \"string type\" \"{kind}\" {TWO}
                 \"{point} p0\" [3 -1 0] \"{point} p1\" [1 1 .5] \"rgb sigma_a\" [1 1 1]\nShape \"sphere\" \"float density\" 3"
            );
            let grid = parse(&text).unwrap();
            assert_eq!((grid.dims, grid.values.as_slice()), ([2, 1, 1], &[0.0, 0.5][..]));
            assert_eq!(grid.active.iter_set().collect::<Vec<_>>(), [1]);
            assert_eq!(grid.world_from_index.transform_point3(DVec3::X), DVec3::new(2.5, 0.0, 0.25));
        }
    }

    #[test]
    fn what_is_missing_or_wrong_is_named() {
        let named = |text: String, what: &str| {
            let message = parse(&text).unwrap_err().to_string();
            assert!(message.starts_with("a.pbrt: ") && message.contains(what), "{message}");
        };
        let medium = |rest: &str| format!("MakeNamedMedium \"a\" {rest}");
        named("WorldBegin".into(), "no density");
        named(medium("\"float density\" [1 2"), "closing bracket");
        named(medium("\"float density\" [1 two]"), "two");
        named(medium("\"float density\" [1 2.2.2]"), "2.2.2");
        named(medium("\"float density"), "open quote");
        named(medium("\"integer nx\" 3 \"float density\" [1 2]"), "2 numbers");
        named(medium("\"integer nx\" 1e300 \"float density\" [1 2]"), "nx");
        named(medium("\"integer nx\" -2 \"float density\" [1 2]"), "nx");
        named(medium(&format!("{TWO} \"point p1\" [1 1 0]")), "p0 and p1");
        named(medium(&format!("{TWO} \"point p1\" [1 1]")), "2 numbers");
        named(format!("{}\n{}", medium(TWO), medium(TWO)), "more than one density");
        named(format!("Scale 2 2 2\n{}", medium(TWO)), "Scale");
    }

    #[test]
    fn every_prefix_of_a_file_is_an_error_or_a_whole_grid() {
        let text = format!("MakeNamedMedium \"a\" {TWO} \"point p1\" [1 1 1] ");
        for end in 0..text.len() {
            if let Ok(grid) = parse(&text[..end]) {
                assert_eq!(grid.values, [0.0, 0.5]);
            }
        }
    }
}
