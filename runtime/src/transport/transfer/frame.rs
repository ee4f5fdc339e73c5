//! What a frame carries of its transfer: clustered rows for direct and indirect light, and the medium they are for.

use crate::sphere::light_basis::{BasisKind, LightBasis};
use crate::transport::medium::MediumParameters;
use smoke_formats::pack::Pack;
use smoke_formats::transfer::{Bases, Rows};
use std::sync::{Arc, Mutex, PoisonError};

/// Rows by clusters: `row = mean + sum over t of weight_t direction_t` of the row's cluster.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clustered {
    /// Numbers of a whole row.
    pub length: usize,
    /// Directions of a cluster.
    pub terms: usize,
    /// `[cluster][1 + terms][length]`: a mean and its directions.
    pub bases: Vec<f32>,
    /// The cluster of each row.
    pub ids: Vec<u8>,
    /// `[row][terms]`.
    pub weights: Vec<f32>,
}

impl Clustered {
    /// Rows of a pack, in single precision and with their scale.
    pub fn unpacked(bases: &Bases, rows: &Rows) -> Self {
        let (length, each) = (bases.length as usize, 1 + bases.terms as usize);
        let scale = bases.scale;
        // Means and weights are scaled, directions have length 1.
        let value = |(at, v): (usize, &half::f16)| {
            let is_mean = length > 0 && (at / length).is_multiple_of(each);
            v.to_f32() * if is_mean { scale } else { 1.0 }
        };
        Self {
            length,
            terms: bases.terms as usize,
            bases: bases.values.iter().enumerate().map(value).collect(),
            ids: rows.ids.clone(),
            weights: rows.weights.iter().map(|w| w.to_f32() * scale).collect(),
        }
    }

    /// The number of clusters.
    pub fn clusters(&self) -> usize {
        self.bases.len().checked_div((1 + self.terms) * self.length).unwrap_or(0)
    }
}

/// The transfer of one frame. A colour channel has one set of direct rows, by its extinction, and one of indirect rows, by
/// extinction and albedo; channels that are alike share them.
#[derive(Clone, Debug)]
pub struct FrameTransfer {
    /// The medium that it was baked for.
    pub medium: MediumParameters,
    /// The basis of the lights; direct light comes from the directions of its mesh.
    pub basis: Arc<LightBasis>,
    /// That of indirect light.
    pub indirect_basis: Arc<LightBasis>,
    /// Bands of what goes out indirectly: `bands^2` coefficients.
    pub bands: usize,
    /// Indirect cells have `2^shift` voxels a side.
    pub shift: u32,
    /// Which of [`Self::direct`] a channel uses.
    pub direct_of_channel: [usize; 3],
    /// Which of [`Self::indirect`] a channel uses.
    pub indirect_of_channel: [usize; 3],
    /// Transmittance from each direction of the basis's mesh to each lit node ([`super::lit_nodes`]).
    pub direct: Vec<Clustered>,
    /// What each cell ([`super::cells`]) sends out for each light of the indirect basis, scattered twice or more:
    /// `[light][l (l + 1) + m]` of `albedo g^l L_lm`.
    pub indirect: Vec<Clustered>,
}

impl FrameTransfer {
    /// The transfer of frame `number`, counted from 0, of a pack. An error names the frames that have one.
    pub fn read(pack: &Pack, number: usize) -> smoke_formats::Result<Self> {
        let invalid = |what: &str, found: String, expected: &str| {
            smoke_formats::Error::invalid(pack.path(), what, found, expected)
        };
        let Some(record) = pack.transfer() else {
            let expected = "transfer; bake the sequence with --transfer, or render it with another --method";
            return Err(invalid("transfer", "none".into(), expected));
        };
        let (rows, bases) = (pack.transfer_rows(number)?, pack.transfer_bases(number)?);
        let Some(kind) = BasisKind::of_name(&record.basis) else {
            return Err(invalid(
                "transfer.basis",
                record.basis.clone(),
                "dsf, hat or sh and a number that it comes in",
            ));
        };
        let unpacked = |bases: &[Bases], rows: &[Rows]| {
            bases.iter().zip(rows).map(|(bases, rows)| Clustered::unpacked(bases, rows)).collect()
        };
        Ok(Self {
            medium: MediumParameters { sigma_t: record.sigma_t, albedo: record.albedo, g: record.g },
            basis: basis(kind),
            indirect_basis: basis(kind.coarser()),
            bands: record.bands as usize,
            shift: record.cell_shift,
            direct_of_channel: record.direct_of_channel.map(|set| set as usize),
            indirect_of_channel: record.indirect_of_channel.map(|set| set as usize),
            direct: unpacked(&bases.direct, &rows.direct),
            indirect: unpacked(&bases.indirect, &rows.indirect),
        })
    }
}

/// A basis, made once: frames after frames have the same.
fn basis(kind: BasisKind) -> Arc<LightBasis> {
    static MADE: Mutex<Vec<Arc<LightBasis>>> = Mutex::new(Vec::new());
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    made.iter().find(|basis| basis.kind() == kind).cloned().unwrap_or_else(|| {
        made.push(Arc::new(LightBasis::new(kind)));
        made[made.len() - 1].clone()
    })
}
