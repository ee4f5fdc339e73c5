//! Precomputed radiance transfer of a frame: matrices from light to the light that leaves each voxel, compressed.
//!
//! A row of such a matrix belongs to a voxel (*direct*: light that was scattered once) or to a cell of voxels
//! (*indirect*: light that was scattered more often). Rows are compressed by clustered principal component analysis:
//! the rows of a cluster `c` lie near an affine space of few dimensions,
//!
//! ```text
//! row = scale * (mean_c + sum over t of weight_t * direction_(c,t))
//! ```
//!
//! so a row at rest is the number of its cluster and its weights; means and directions, the *bases*, are shared by
//! consecutive frames, a *run*. All numbers are half floats. Source: transfer by Zhang, Dong and Ma 2013; compression by
//! Sloan, Hall, Hart and Snyder 2003, section 4. Cost in memory: `1 + 2 terms` bytes a row, `2 (1 + terms) length`
//! bytes a cluster.
//!
//! Colour channels with the same medium share a *set* of bases and rows, so there are one to three sets of each.

use crate::{Error, Result};
use half::f16;
use std::path::Path;

/// Most clusters of a set: a row keeps its cluster in a byte.
pub const MAX_CLUSTERS: u32 = 256;
/// Most directions of a cluster.
pub const MAX_TERMS: u32 = 255;
/// Most sets: one for each colour channel.
pub const MAX_SETS: usize = 3;

/// The bases of one set: each cluster has a mean and `terms` directions, each of `length` numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Bases {
    /// Numbers of a row; 1 or more where there are clusters.
    pub length: u32,
    /// Clusters, 0 to 256; 0 only if no frame of the run has rows.
    pub clusters: u32,
    /// Directions of a cluster, 0 to 255.
    pub terms: u32,
    /// What every row is times: thin smoke sends out little, and half floats end at 6e-8. Above 0 and finite.
    pub scale: f32,
    /// `[cluster][1 + terms][length]`, the mean first; finite.
    pub values: Vec<f16>,
}

/// The rows of one set of one frame, by its [`Bases`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rows {
    /// For each row its cluster.
    pub ids: Vec<u8>,
    /// `[row][terms]`; finite.
    pub weights: Vec<f16>,
}

/// The bases of a run of frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TransferBases {
    /// For light that was scattered once: one for each distinct extinction, 1 to 3.
    pub direct: Vec<Bases>,
    /// For light that was scattered more often: one for each distinct pair of extinction and albedo, 1 to 3.
    pub indirect: Vec<Bases>,
}

/// The rows of one frame; sets as in the [`TransferBases`] of its run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TransferRows {
    /// A row a voxel.
    pub direct: Vec<Rows>,
    /// A row a cell.
    pub indirect: Vec<Rows>,
}

/// What is said of one set: that of bases and that of rows must agree, and the record's counts with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SetShape {
    /// Of bases: clusters. Of rows: the least number of clusters that has all their ids.
    pub(crate) clusters: u32,
    /// Directions of a cluster, weights of a row; 0 if there are no rows.
    pub(crate) terms: u32,
    /// Rows; 0 for bases.
    pub(crate) rows: u64,
}

/// The shapes of all sets, direct and indirect.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    pub(crate) direct: Vec<SetShape>,
    pub(crate) indirect: Vec<SetShape>,
}

impl Default for Bases {
    /// Of no rows.
    fn default() -> Self {
        Self { length: 0, clusters: 0, terms: 0, scale: 1.0, values: Vec::new() }
    }
}

impl Bases {
    fn check(&self, path: &Path, what: &str) -> Result<SetShape> {
        let Self { length, clusters, terms, .. } = *self;
        at_most(path, what, "clusters", clusters.into(), MAX_CLUSTERS.into())?;
        at_most(path, what, "terms", terms.into(), MAX_TERMS.into())?;
        if clusters > 0 && length == 0 {
            return Err(Error::invalid(path, format!("{what}.length"), 0, "1 or more"));
        }
        let good = self.scale > 0.0 && self.scale.is_finite();
        if !good {
            return Err(Error::invalid(path, format!("{what}.scale"), self.scale, "above 0 and finite"));
        }
        let expected = self.numbers();
        if self.values.len() as u128 != expected {
            return Err(Error::invalid(path, format!("{what}.values"), self.values.len(), expected));
        }
        finite(path, what, "values", &self.values)?;
        Ok(SetShape { clusters, terms, rows: 0 })
    }

    /// How many values there must be; exact for any counts.
    pub(crate) fn numbers(&self) -> u128 {
        u128::from(self.clusters) * (1 + u128::from(self.terms)) * u128::from(self.length)
    }
}

impl Rows {
    fn check(&self, path: &Path, what: &str) -> Result<SetShape> {
        let rows = self.ids.len();
        at_most(path, what, "ids", rows as u64, u32::MAX.into())?;
        let terms = self.terms();
        if self.weights.len() != rows * terms {
            let expected = format!("a multiple of the {rows} rows");
            return Err(Error::invalid(path, format!("{what}.weights"), self.weights.len(), expected));
        }
        at_most(path, what, "terms", terms as u64, MAX_TERMS.into())?;
        finite(path, what, "weights", &self.weights)?;
        let clusters = self.ids.iter().max().map_or(0, |&id| u32::from(id) + 1);
        Ok(SetShape { clusters, terms: terms as u32, rows: rows as u64 })
    }

    /// Weights of a row; 0 if there are no rows.
    pub fn terms(&self) -> usize {
        self.weights.len().checked_div(self.ids.len()).unwrap_or(0)
    }
}

impl TransferBases {
    /// Fails on the first thing that no bases can be; `what` names them in errors.
    pub(crate) fn check(&self, path: &Path, what: &str) -> Result<Shape> {
        shapes(path, what, &self.direct, &self.indirect, Bases::check)
    }
}

impl TransferRows {
    /// Fails on the first thing that no rows can be; `what` names them in errors.
    pub(crate) fn check(&self, path: &Path, what: &str) -> Result<Shape> {
        shapes(path, what, &self.direct, &self.indirect, Rows::check)
    }
}

impl Shape {
    /// Fails unless every row has its cluster in `bases`, and a weight for each direction; `what` names the rows.
    pub(crate) fn check_rows_by(&self, path: &Path, what: &str, bases: &Self) -> Result<()> {
        for (name, rows, bases) in
            [("direct", &self.direct, &bases.direct), ("indirect", &self.indirect, &bases.indirect)]
        {
            if rows.len() != bases.len() {
                let expected = format!("{} sets, as in the bases", bases.len());
                return Err(Error::invalid(path, format!("{what}.{name}"), format!("{} sets", rows.len()), expected));
            }
            for (i, (rows, bases)) in rows.iter().zip(bases).enumerate() {
                if rows.rows > 0 && rows.terms != bases.terms {
                    let expected = format!("{}, as in the bases", bases.terms);
                    return Err(Error::invalid(path, format!("{what}.{name}[{i}].terms"), rows.terms, expected));
                }
                if rows.clusters > bases.clusters {
                    let expected = format!("below the {} clusters of the bases", bases.clusters);
                    return Err(Error::invalid(path, format!("{what}.{name}[{i}].ids"), rows.clusters - 1, expected));
                }
            }
        }
        Ok(())
    }
}

/// Fails unless there are 1 to 3 sets; gives their number.
pub(crate) fn check_sets(path: &Path, what: &str, name: &str, sets: usize) -> Result<usize> {
    match (1..=MAX_SETS).contains(&sets) {
        true => Ok(sets),
        false => {
            Err(Error::invalid(path, format!("{what}.{name}"), format!("{sets} sets"), format!("1 to {MAX_SETS}")))
        }
    }
}

fn shapes<T>(
    path: &Path,
    what: &str,
    direct: &[T],
    indirect: &[T],
    check: fn(&T, &Path, &str) -> Result<SetShape>,
) -> Result<Shape> {
    let all = |name: &str, sets: &[T]| -> Result<Vec<SetShape>> {
        check_sets(path, what, name, sets.len())?;
        sets.iter().enumerate().map(|(i, set)| check(set, path, &format!("{what}.{name}[{i}]"))).collect()
    };
    Ok(Shape { direct: all("direct", direct)?, indirect: all("indirect", indirect)? })
}

fn at_most(path: &Path, what: &str, field: &str, found: u64, most: u64) -> Result<()> {
    match found <= most {
        true => Ok(()),
        false => Err(Error::invalid(path, format!("{what}.{field}"), found, format!("at most {most}"))),
    }
}

fn finite(path: &Path, what: &str, field: &str, values: &[f16]) -> Result<()> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(i) => Err(Error::invalid(path, format!("{what}.{field}[{i}]"), values[i], "a finite number")),
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::residual::tests::Pcg;

    pub(crate) fn some_values(n: usize, seed: u64) -> Vec<f16> {
        let mut random = Pcg(seed);
        (0..n).map(|_| f16::from_f32((f64::from(random.next()) / 2f64.powi(32) - 0.25) as f32)).collect()
    }

    pub(crate) fn some_bases(length: u32, clusters: u32, terms: u32, seed: u64) -> Bases {
        let empty = Bases { length, clusters, terms, scale: 0.25, values: vec![] };
        Bases { values: some_values(empty.numbers() as usize, seed), ..empty }
    }

    /// Every cluster is used, the last one first.
    pub(crate) fn some_rows(rows: usize, bases: &Bases, seed: u64) -> Rows {
        let ids = (0..rows).map(|i| (bases.clusters as usize - 1 - i % bases.clusters as usize) as u8).collect();
        Rows { ids, weights: some_values(rows * bases.terms as usize, seed) }
    }

    fn good() -> (TransferBases, TransferRows) {
        let bases = TransferBases {
            direct: vec![some_bases(5, 3, 2, 1), some_bases(5, 256, 0, 2)],
            indirect: vec![some_bases(7, 1, 255, 3)],
        };
        let rows = TransferRows {
            direct: bases.direct.iter().map(|b| some_rows(300, b, 4)).collect(),
            indirect: vec![some_rows(2, &bases.indirect[0], 5)],
        };
        (bases, rows)
    }

    fn path() -> &'static Path {
        Path::new("p")
    }

    fn refused<T: std::fmt::Debug>(result: Result<T>, start: &str) {
        let message = result.unwrap_err().to_string();
        assert!(message.starts_with(&format!("p: {start}: found ")), "{message} does not name {start}");
    }

    #[test]
    fn rows_by_their_bases_are_good_at_the_extremes_of_clusters_and_terms() {
        let (bases, rows) = good();
        let shape = rows.check(path(), "rows").unwrap();
        assert_eq!(shape.direct[0], SetShape { clusters: 3, terms: 2, rows: 300 });
        assert_eq!(shape.direct[1], SetShape { clusters: 256, terms: 0, rows: 300 });
        shape.check_rows_by(path(), "rows", &bases.check(path(), "bases").unwrap()).unwrap();
        let none = TransferRows { direct: vec![Rows::default(); 2], indirect: vec![Rows::default()] };
        let no_bases = TransferBases { direct: vec![Bases::default(); 2], indirect: vec![Bases::default()] };
        for bases in [&bases, &no_bases] {
            let bases = bases.check(path(), "bases").unwrap();
            none.check(path(), "rows").unwrap().check_rows_by(path(), "rows", &bases).unwrap();
        }
    }

    #[test]
    fn every_wrong_field_of_bases_is_named() {
        type Spoil = fn(&mut TransferBases);
        let defects: [(&str, Spoil); 8] = [
            ("b.direct", |b| b.direct.clear()),
            ("b.indirect", |b| b.indirect = vec![b.indirect[0].clone(); 4]),
            ("b.direct[1].clusters", |b| b.direct[1].clusters = 257),
            ("b.indirect[0].terms", |b| b.indirect[0].terms = 256),
            ("b.direct[0].length", |b| b.direct[0].length = 0),
            ("b.direct[0].values", |b| b.direct[0].length = u32::MAX),
            ("b.direct[0].values[44]", |b| b.direct[0].values[44] = f16::NAN),
            ("b.indirect[0].values[3]", |b| b.indirect[0].values[3] = f16::NEG_INFINITY),
        ];
        for (named, spoil) in defects {
            let (mut bases, _) = good();
            spoil(&mut bases);
            refused(bases.check(path(), "b"), named);
        }
    }

    #[test]
    fn every_wrong_field_of_rows_is_named() {
        type Spoil = fn(&mut TransferRows);
        let defects: [(&str, Spoil); 9] = [
            ("r.indirect", |r| r.indirect.clear()),
            ("r.direct", |r| r.direct = vec![r.direct[0].clone(); 4]),
            ("r.direct", |r| r.direct.truncate(1)),
            ("r.direct[0].weights", |r| r.direct[0].weights.truncate(599)),
            ("r.direct[0].weights", |r| r.direct[0].ids.clear()),
            ("r.indirect[0].terms", |r| r.indirect[0] = Rows { ids: vec![0], weights: vec![f16::ZERO; 256] }),
            ("r.direct[0].weights[7]", |r| r.direct[0].weights[7] = f16::INFINITY),
            ("r.direct[0].ids", |r| r.direct[0].ids[299] = 3),
            ("r.direct[1].terms", |r| r.direct[1].weights = vec![f16::ZERO; 300]),
        ];
        let (bases, _) = good();
        let bases = bases.check(path(), "b").unwrap();
        for (named, spoil) in defects {
            let (_, mut rows) = good();
            spoil(&mut rows);
            refused(rows.check(path(), "r").and_then(|shape| shape.check_rows_by(path(), "r", &bases)), named);
        }
    }
}
