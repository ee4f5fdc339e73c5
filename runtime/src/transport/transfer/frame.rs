//! What a frame carries of its transfer: clustered rows for direct and indirect light, and the medium they are for.

use crate::sphere::light_basis::LightBasis;
use crate::transport::medium::MediumParameters;
use std::sync::Arc;

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
