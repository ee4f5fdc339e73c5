//! From a voxel of the support to the place of its code: the number of support voxels before it.
//!
//! One running count a word of 64 voxels, and a population count inside the word: 4 bytes for 64 voxels, 1 ns.

use crate::volume::VoxelMask;

/// A support with its running counts.
pub(super) struct Ranks<'a> {
    support: &'a VoxelMask,
    before: Vec<u32>,
}

impl<'a> Ranks<'a> {
    /// Counts once over the whole support.
    pub(super) fn new(support: &'a VoxelMask) -> Self {
        let mut sum = 0;
        let before = support.words().iter().map(|word| {
            sum += word.count_ones();
            sum - word.count_ones()
        });
        Self { support, before: before.collect() }
    }

    /// The place of voxel `v`'s code, or none outside the support.
    #[inline(always)]
    pub(super) fn get(&self, v: usize) -> Option<usize> {
        let word = self.support.words()[v / 64];
        let bit = 1u64 << (v % 64);
        (word & bit != 0).then(|| (self.before[v / 64] + (word & (bit - 1)).count_ones()) as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_number_the_support_in_order() {
        let mut support = VoxelMask::new(300);
        (0..300).filter(|v| v * v % 7 < 3).for_each(|v| support.set(v));
        let ranks = Ranks::new(&support);
        let found: Vec<_> = (0..300).filter_map(|v| ranks.get(v)).collect();
        assert_eq!(found, (0..support.count()).collect::<Vec<_>>());
        assert!((0..300).all(|v| ranks.get(v).is_some() == support.get(v)));
    }
}
