//! A density volume in memory: a dense box of voxels with its active set and its place in the world.

use crate::{Error, Result};
use glam::DAffine3;
use std::path::Path;

pub use crate::volume_file::read;

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

    /// Index coordinates of the voxel at position `v < len` of `values`.
    pub fn index(&self, v: usize) -> [i64; 3] {
        let local = [v % self.dims[0], v / self.dims[0] % self.dims[1], v / self.dims[0] / self.dims[1]];
        std::array::from_fn(|a| i64::from(self.origin[a]) + local[a] as i64)
    }

    /// Fails at the first voxel whose value is not a density: not finite, or below zero. `path` is named in the error.
    pub fn check_density(&self, path: &Path) -> Result<()> {
        match self.values.iter().position(|&value| !(0.0..f32::INFINITY).contains(&value)) {
            None => Ok(()),
            Some(v) => {
                let what = format!("density of grid '{}' at voxel {:?}", self.name.escape_debug(), self.index(v));
                Err(Error::invalid(path, what, self.values[v], "a finite value of 0 or more (--clamp repairs this)"))
            }
        }
    }

    /// Makes every value a density: what is not finite or is below zero becomes zero. Active states stay.
    pub fn clamp_density(&mut self) -> ClampReport {
        let mut report = ClampReport::default();
        for value in &mut self.values {
            if !value.is_finite() {
                report.non_finite += 1;
                *value = 0.0;
            } else if *value < 0.0 {
                report.negative += 1;
                *value = 0.0;
            }
        }
        report
    }
}

/// What [`DensityGrid::clamp_density`] repaired, in voxels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ClampReport {
    /// Infinities and NaN.
    pub non_finite: usize,
    /// Finite values below zero.
    pub negative: usize,
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

    #[test]
    fn ranges_and_runs_of_bits_set_what_single_voxels_would() {
        for (start, end) in [(0, 0), (0, 64), (5, 6), (63, 65), (3, 200), (130, 199)] {
            let (mut by_range, mut one_by_one) = (VoxelMask::new(200), VoxelMask::new(200));
            by_range.set_range(start..end);
            (start..end).for_each(|v| one_by_one.set(v));
            assert_eq!(by_range, one_by_one, "{start}..{end}");
        }
        for start in [0, 1, 57, 60, 63, 64, 190] {
            let mut by_bits = VoxelMask::new(200);
            by_bits.or_bits(start, 0b1010_0101);
            let set = [start, start + 2, start + 5, start + 7];
            assert_eq!(by_bits.iter_set().collect::<Vec<_>>(), set);
        }
    }

    fn row(values: &[f32]) -> DensityGrid {
        DensityGrid {
            name: "density".into(),
            origin: [-3, 7, 0],
            dims: [values.len(), 1, 1],
            values: values.to_vec(),
            active: VoxelMask::new(values.len()),
            world_from_index: DAffine3::IDENTITY,
        }
    }

    #[test]
    fn a_value_that_is_no_density_is_named_with_file_grid_and_voxel() {
        row(&[0.0, -0.0, f32::MIN_POSITIVE, f32::MAX]).check_density(Path::new("a.vdb")).unwrap();
        for bad in [-1e-30, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            let message = row(&[1.0, bad, -1.0]).check_density(Path::new("a.vdb")).unwrap_err().to_string();
            let start = format!("a.vdb: density of grid 'density' at voxel [-2, 7, 0]: found {bad}, expected");
            assert!(message.starts_with(&start), "{message}");
        }
    }

    #[test]
    fn clamping_repairs_exactly_what_the_check_refuses_and_counts_it() {
        let mut grid = row(&[1.0, -1.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.5]);
        assert_eq!(grid.clamp_density(), ClampReport { non_finite: 3, negative: 1 });
        assert_eq!(grid.values, [1.0, 0.0, 0.0, 0.0, 0.0, 0.5]);
        grid.check_density(Path::new("a")).unwrap();
        assert_eq!(grid.clamp_density(), ClampReport::default());
    }

    #[test]
    fn position_and_index_of_a_voxel_are_inverse() {
        let grid = DensityGrid { dims: [2, 3, 2], ..row(&[0.0; 12]) };
        for v in 0..12 {
            assert_eq!(grid.voxel(grid.index(v).map(|i| i as i32)), Some(v));
        }
    }
}
