//! Precomputed volume radiance transfer (Zhang, Dong and Ma 2013): a fixed medium under any light from infinity.
//!
//! The bake leaves, for each voxel, how much light of each direction reaches it unscattered, and for each cell of a few
//! voxels, what it sends out indirectly under each basis light; both by clusters ([`frame`]). A light is projected onto
//! the basis, the clusters are lit, and voxels mix their cluster's few radiances ([`source`]).

pub mod cells;
pub mod frame;
pub mod lit_nodes;
pub mod source;
pub mod view_directions;
