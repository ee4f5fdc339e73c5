//! The codes of the frame before, seen from the voxels of this one.
//!
//! Both frames lie in one index space; where the earlier one has no code its value is 0. Four planes are kept, in the
//! sweep of the later frame: two before the plane that is coded, the plane itself, and the one after it.

use super::ranks::Ranks;
use super::sweep::Sweep;
use crate::residual::ResidualCodes;

/// Taps in the earlier frame, as steps along the fastest, middle and slowest axis of the sweep.
pub(super) const TAPS: [[isize; 3]; 8] =
    [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0, 0, -2]];
/// Columns and rows of zeros on each side of a plane.
const PAD: usize = 1;

/// Four planes of the earlier frame.
pub(super) struct Earlier<'a> {
    frame: &'a ResidualCodes,
    ranks: Ranks<'a>,
    /// Coordinates of the later frame's first voxel in the earlier frame.
    shift: [i64; 3],
    planes: [Vec<f32>; 4],
    width: usize,
}

impl<'a> Earlier<'a> {
    /// `origin` is the later frame's, `sweep` the order of its voxels. Starts one plane before the first.
    pub(super) fn new(frame: &'a ResidualCodes, origin: [i32; 3], sweep: &Sweep) -> Self {
        let width = sweep.dims[0] + 2 * PAD;
        let planes = std::array::from_fn(|_| vec![0.0; width * (sweep.dims[1] + 2 * PAD)]);
        let shift = std::array::from_fn(|a| i64::from(origin[a]) - i64::from(frame.origin[a]));
        let mut this = Self { frame, ranks: Ranks::new(&frame.support), shift, planes, width };
        this.load(sweep, 0);
        this
    }

    /// Moves on to plane `k` of the sweep, planes in order from 0.
    pub(super) fn next_plane(&mut self, sweep: &Sweep, k: usize) {
        self.load(sweep, k + 1);
    }

    fn load(&mut self, sweep: &Sweep, k: usize) {
        self.planes.rotate_right(1);
        self.planes[0].fill(0.0);
        let dims = self.frame.dims.map(|d| d as usize);
        for j in 0..sweep.dims[1] {
            for i in 0..sweep.dims[0] {
                let index = sweep.coordinates([i, j, k]);
                let [x, y, z]: [Option<usize>; 3] = std::array::from_fn(|a| {
                    usize::try_from(index[a] as i64 + self.shift[a]).ok().filter(|&x| x < dims[a])
                });
                let (Some(x), Some(y), Some(z)) = (x, y, z) else { continue };
                if let Some(rank) = self.ranks.get(x + dims[0] * (y + dims[1] * z)) {
                    self.planes[0][i + PAD + self.width * (j + PAD)] = self.frame.codes[rank] as f32;
                }
            }
        }
    }

    /// The taps around voxel (i, j) of the plane that is coded.
    #[inline(always)]
    pub(super) fn taps(&self, i: usize, j: usize) -> [f32; TAPS.len()] {
        let at = i + PAD + self.width * (j + PAD);
        TAPS.map(|[x, y, z]| self.planes[(1 - z) as usize][at.wrapping_add_signed(x + self.width as isize * y)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::VoxelMask;

    #[test]
    fn taps_are_the_codes_at_the_same_index_in_any_sweep_and_placing() {
        let dims = [4, 5, 3];
        let mut support = VoxelMask::new(60);
        (0..60).filter(|v| v % 7 != 2).for_each(|v| support.set(v));
        let codes: Vec<i32> = support.iter_set().map(|v| v as i32 + 1).collect();
        let frame = ResidualCodes { origin: [10, -5, 2], dims, support, codes };
        let truth = |p: [i64; 3]| {
            let q: [i64; 3] = std::array::from_fn(|a| p[a] - i64::from(frame.origin[a]));
            let inside = (0..3).all(|a| (0..i64::from(dims[a])).contains(&q[a]));
            let v = q[0] + 4 * (q[1] + 5 * q[2]);
            if inside && v % 7 != 2 { (v + 1) as f32 } else { 0.0 }
        };
        for (origin, dims) in [([9, -6, 1], [6, 7, 9]), ([11, -4, 3], [9, 2, 2]), ([8, -9, 0], [5, 12, 6])] {
            let sweep = Sweep::new(dims);
            let mut earlier = Earlier::new(&frame, origin, &sweep);
            for k in 0..sweep.dims[2] {
                earlier.next_plane(&sweep, k);
                for (i, j) in (0..sweep.dims[0]).flat_map(|i| (0..sweep.dims[1]).map(move |j| (i, j))) {
                    for (tap, step) in earlier.taps(i, j).into_iter().zip(TAPS) {
                        let here = sweep.coordinates([i, j, k]);
                        let step = sweep.coordinates_signed(step);
                        let at = std::array::from_fn(|a| i64::from(origin[a]) + here[a] as i64 + step[a]);
                        assert_eq!(tap, truth_or_edge(&truth, at, origin, dims), "{i} {j} {k} {step:?}");
                    }
                }
            }
        }
    }

    /// Taps beyond the sides of the planes are zero; those before the first or after the last plane are not.
    fn truth_or_edge(truth: &impl Fn([i64; 3]) -> f32, at: [i64; 3], origin: [i32; 3], dims: [u32; 3]) -> f32 {
        let longest = (0..3).max_by_key(|&a| dims[a]).unwrap();
        let beside = (0..3).any(|a| !(0..i64::from(dims[a])).contains(&(at[a] - i64::from(origin[a]))) && a != longest);
        let before = at[longest] < i64::from(origin[longest]);
        if beside || before { 0.0 } else { truth(at) }
    }
}
