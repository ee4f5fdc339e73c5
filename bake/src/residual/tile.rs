//! Picks the resident layout of a tile of frames: one rank layout a frame, or one perfect hash for all.
//!
//! The tile is the unit of choice because a hash is shared by up to 27 frames. With [`ResidualMode::Auto`] both are built
//! and the smaller one in memory is taken; where the search for a hash gives up, the rank layout is taken in any mode.

use super::perfect_hash;
use rayon::prelude::*;
use smoke_formats::Result;
use smoke_formats::residual::hash::{HashTable, MAX_FRAMES, assemble};
use smoke_formats::residual::{ResidualCodes, rank};
use std::path::Path;

/// Frames of a tile.
pub const TILE_FRAMES: usize = MAX_FRAMES;

/// Which layout the user asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ResidualMode {
    /// The rank layout.
    Rank,
    /// The perfect hash.
    Hash,
    /// The smaller one of each tile.
    #[default]
    Auto,
}

/// The layout of a tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TileLayout {
    /// The hash to be used, or none for the rank layout.
    pub hash: Option<HashTable>,
    /// Resident bytes of each frame's rank layout; empty if it was not built.
    pub rank_bytes: Vec<u64>,
    /// Resident bytes of the tile's hash; none if it was not built or not found.
    pub hash_bytes: Option<u64>,
}

/// The layout of a tile of 1 to [`TILE_FRAMES`] frames; `path` names the pack in errors.
pub fn choose(path: &Path, frames: &[ResidualCodes], mode: ResidualMode, seed: u64) -> Result<TileLayout> {
    let hash = match mode {
        ResidualMode::Rank => None,
        ResidualMode::Hash | ResidualMode::Auto => perfect_hash::find(frames, seed),
    };
    let hash_bytes = match &hash {
        Some(table) => Some(assemble(path, frames, table)?.len() as u64),
        None => None,
    };
    let rank_bytes: Vec<u64> = match (mode, &hash) {
        (ResidualMode::Hash, Some(_)) => vec![],
        _ => frames.par_iter().map(|codes| rank::encode(codes).len() as u64).collect(),
    };
    let rank_total: u64 = rank_bytes.iter().sum();
    let keep = mode == ResidualMode::Hash || hash_bytes.is_some_and(|h| h < rank_total);
    Ok(TileLayout { hash: hash.filter(|_| keep), rank_bytes, hash_bytes })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::frame;

    fn pick(frames: &[ResidualCodes], mode: ResidualMode) -> TileLayout {
        choose(Path::new("p"), frames, mode, 1).unwrap()
    }

    #[test]
    fn auto_takes_the_smaller_layout_and_reports_both() {
        // Every code needs its bits: ranks win. One code in 200 differs from zero, by much: the hash wins.
        let dense = [frame([24, 24, 24], |x, y, z| Some(((x * 7 + y * 5 + z * 3) % 100) as i32 - 40))];
        let sparse = [frame([24, 24, 24], |x, y, z| {
            let v = x + 24 * (y + 24 * z);
            Some(if v * 31 % 199 == 0 { 100_000 + v as i32 } else { 0 })
        })];
        for (frames, hash_wins) in [(dense, false), (sparse, true)] {
            let layout = pick(&frames, ResidualMode::Auto);
            assert_eq!(layout.hash.is_some(), hash_wins);
            let (rank, hash) = (layout.rank_bytes[0], layout.hash_bytes.unwrap());
            assert_eq!(hash < rank, hash_wins, "{hash} {rank}");
            assert!(pick(&frames, ResidualMode::Hash).hash.is_some());
            assert_eq!(pick(&frames, ResidualMode::Rank).hash, None);
            assert_eq!(pick(&frames, ResidualMode::Rank).rank_bytes, [rank]);
        }
    }

    #[test]
    fn frames_without_a_hash_keep_the_rank_layout_in_every_mode() {
        let line = [frame([4096, 1, 1], |_, _, _| Some(1))];
        for mode in [ResidualMode::Hash, ResidualMode::Auto] {
            let layout = pick(&line, mode);
            assert_eq!((layout.hash, layout.hash_bytes, layout.rank_bytes.len()), (None, None, 1));
        }
    }
}
