//! The order in which the voxels of a box are coded.
//!
//! The longest axis is the slowest, so that the planes a coder keeps hold at most `voxels^(2/3)` voxels, whatever box a
//! file declares; the other two keep their order. Of equally long axes the last counts as the longest.

/// Maps coding coordinates to voxels.
pub(super) struct Sweep {
    /// Voxels along the fastest, the middle and the slowest axis.
    pub(super) dims: [usize; 3],
    strides: [usize; 3],
    axes: [usize; 3],
}

impl Sweep {
    /// The sweep over a box of `dims` voxels, x fastest.
    pub(super) fn new(dims: [u32; 3]) -> Self {
        let dims = dims.map(|d| d as usize);
        let strides = [1, dims[0], dims[0] * dims[1]];
        let axes = match (0..3).max_by_key(|&a| dims[a]) {
            Some(0) => [1, 2, 0],
            Some(1) => [0, 2, 1],
            _ => [0, 1, 2],
        };
        Self { dims: axes.map(|a| dims[a]), strides: axes.map(|a| strides[a]), axes }
    }

    /// The voxel at coding coordinates (fastest, middle, slowest).
    #[inline(always)]
    pub(super) fn voxel(&self, i: usize, j: usize, k: usize) -> usize {
        i * self.strides[0] + j * self.strides[1] + k * self.strides[2]
    }

    /// The voxel's coordinates along x, y, z in its box.
    #[inline(always)]
    pub(super) fn coordinates(&self, swept: [usize; 3]) -> [usize; 3] {
        let mut index = [0; 3];
        (0..3).for_each(|a| index[self.axes[a]] = swept[a]);
        index
    }

    /// A step of the sweep along x, y, z.
    #[cfg(test)]
    pub(super) fn coordinates_signed(&self, swept: [isize; 3]) -> [i64; 3] {
        let mut step = [0; 3];
        (0..3).for_each(|a| step[self.axes[a]] = swept[a] as i64);
        step
    }

    /// Calls `visit` for every voxel of a box in coding coordinates, in coding order.
    #[inline(always)]
    pub(super) fn for_each(&self, start: [usize; 3], end: [usize; 3], mut visit: impl FnMut(usize)) {
        for k in start[2]..end[2] {
            for j in start[1]..end[1] {
                for i in start[0]..end[0] {
                    visit(self.voxel(i, j, k));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_voxel_is_visited_once_with_the_longest_axis_slowest() {
        for (dims, swept) in
            [([2, 3, 4], [2, 3, 4]), ([5, 3, 4], [3, 4, 5]), ([2, 6, 4], [2, 4, 6]), ([3, 3, 3], [3, 3, 3])]
        {
            let sweep = Sweep::new(dims);
            assert_eq!(sweep.dims, swept);
            let mut visited = Vec::new();
            sweep.for_each([0; 3], sweep.dims, |v| visited.push(v));
            visited.sort_unstable();
            assert_eq!(visited, (0..dims.iter().product::<u32>() as usize).collect::<Vec<_>>());
        }
    }
}
