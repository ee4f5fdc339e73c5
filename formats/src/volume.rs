//! A density volume in memory: a dense box of voxels with its active set and its place in the world.

use glam::DAffine3;

/// One bit a voxel, in voxel order (x fastest): bit `v % 64` of word `v / 64`. Bits past `len` are zero.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VoxelMask {
    words: Vec<u64>,
    len: usize,
}

impl VoxelMask {
    /// `len` voxels, none set.
    pub fn new(len: usize) -> Self {
        Self { words: vec![0; len.div_ceil(64)], len }
    }

    /// The number of voxels covered, set or not.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True if it covers no voxels.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether voxel `v < len` is set.
    #[inline]
    pub fn get(&self, v: usize) -> bool {
        self.words[v / 64] >> (v % 64) & 1 == 1
    }

    /// Sets voxel `v < len`.
    #[inline]
    pub fn set(&mut self, v: usize) {
        assert!(v < self.len, "voxel {v} of {}", self.len);
        self.words[v / 64] |= 1 << (v % 64);
    }

    /// Sets the voxels of a range, whose end is at most `len`.
    pub fn set_range(&mut self, range: std::ops::Range<usize>) {
        assert!(range.end <= self.len, "voxels {range:?} of {}", self.len);
        let mut v = range.start;
        while v < range.end {
            let count = (64 - v % 64).min(range.end - v);
            self.words[v / 64] |= (u64::MAX >> (64 - count)) << (v % 64);
            v += count;
        }
    }

    /// Sets voxel `v + i` for each set bit `i` of `bits`; all of them must be below `len`.
    #[inline]
    pub fn or_bits(&mut self, v: usize, bits: u64) {
        assert!(v + (64 - bits.leading_zeros() as usize) <= self.len, "voxels from {v} of {}", self.len);
        if bits == 0 {
            return;
        }
        let shift = v % 64;
        self.words[v / 64] |= bits << shift;
        let over = if shift == 0 { 0 } else { bits >> (64 - shift) };
        if over != 0 {
            self.words[v / 64 + 1] |= over;
        }
    }

    /// The number of voxels set.
    pub fn count(&self) -> usize {
        self.words.iter().map(|w| w.count_ones() as usize).sum()
    }

    /// The words, 64 voxels each.
    pub fn words(&self) -> &[u64] {
        &self.words
    }

    /// The voxels that are set, ascending.
    pub fn iter_set(&self) -> impl Iterator<Item = usize> + '_ {
        self.words.iter().enumerate().flat_map(|(i, &word)| {
            std::iter::successors((word != 0).then_some(word), |w| Some(w & (w - 1)).filter(|w| *w != 0))
                .map(move |w| i * 64 + w.trailing_zeros() as usize)
        })
    }
}

/// A scalar volume on a dense box of voxels.
///
/// A voxel's value sits at its integer index (OpenVDB's BoxSampler convention); outside the box the density is zero.
#[derive(Clone, Debug, PartialEq)]
pub struct DensityGrid {
    /// The grid's name in its file.
    pub name: String,
    /// Index coordinates of the first voxel.
    pub origin: [i32; 3],
    /// Voxels along x, y, z; all zero for an empty grid.
    pub dims: [usize; 3],
    /// One value a voxel, x fastest: `values[i + nx * (j + ny * k)]`.
    pub values: Vec<f32>,
    /// The active voxels, same order. An inactive voxel may hold a value other than zero.
    pub active: VoxelMask,
    /// Index to world space, exact as in the source.
    pub world_from_index: DAffine3,
}

impl DensityGrid {
    /// Voxels in the box.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// True if the box holds no voxels.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Position in `values` of the voxel at index coordinates `index`, or none outside the box.
    pub fn voxel(&self, index: [i32; 3]) -> Option<usize> {
        let at = |a: usize| {
            let local = i64::from(index[a]) - i64::from(self.origin[a]);
            usize::try_from(local).ok().filter(|&l| l < self.dims[a])
        };
        let (i, j, k) = (at(0)?, at(1)?, at(2)?);
        Some(i + self.dims[0] * (j + self.dims[1] * k))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_lists_exactly_the_voxels_that_were_set() {
        let mut mask = VoxelMask::new(200);
        let set = [0, 1, 63, 64, 127, 128, 199];
        set.iter().for_each(|&v| mask.set(v));
        assert_eq!(mask.iter_set().collect::<Vec<_>>(), set);
        assert_eq!(mask.count(), set.len());
        assert!(mask.get(63) && !mask.get(62));
    }
}
