//! A frame's box cut into bricks of 8^3 voxels, each made of eight cells of 4^3, one 64-bit mask a cell.
//!
//! Bricks are counted x fastest from the box's first voxel; the box's last bricks may hang over its end. In a brick,
//! cell `c` sits at (c & 1, c >> 1 & 1, c >> 2); in a cell, voxel `b` at (b & 3, b >> 2 & 3, b >> 4). Both resident
//! layouts use this order, which is part of the format.
//!
//! Why cells: a 4^3 cell's mask is one machine word, so a rank is one popcount. On the densities of three real frames
//! (63 k, 162 k and 251 k voxels, step 1/250 of the maximum) one code width a 4^3 cell took 8.4, 7.8 and 7.7 bits a voxel
//! in all, against 9.9, 9.4 and 9.3 for one width a brick, and 9.1 to 10.1 for slabs of one or two voxels. A plane
//! predicted in each cell saved 0.2 to 0.6 bits of code and cost 0.5 bits for its slopes, so there is none.
//!
//! Cost: 64 row reads a brick plus one step a voxel of the support; 1 bit a voxel of extra memory for the ranks.

use super::ResidualCodes;
use crate::volume::VoxelMask;

/// Bricks along each axis of a box.
pub fn bricks_of(dims: [u32; 3]) -> [u32; 3] {
    dims.map(|d| d.div_ceil(8))
}

/// Cell and voxel-in-cell of a voxel, by the low three bits of its coordinates.
#[inline]
pub fn cell_and_bit([x, y, z]: [u32; 3]) -> (u32, u32) {
    let cell = x >> 2 & 1 | (y >> 2 & 1) << 1 | (z >> 2 & 1) << 2;
    let bit = x & 3 | (y & 3) << 2 | (z & 3) << 4;
    (cell, bit)
}

/// One brick: cell `c`'s support is `masks[c]`, the code of its voxel `b` is `codes[64 * c + b]` (zero off the support).
#[derive(Clone, Debug, PartialEq)]
pub struct Brick {
    /// The support of each cell.
    pub masks: [u64; 8],
    /// The codes, dense.
    pub codes: [i32; 512],
}

impl Default for Brick {
    fn default() -> Self {
        Self { masks: [0; 8], codes: [0; 512] }
    }
}

/// Support voxels before each 64-voxel word of a mask.
fn ranks(mask: &VoxelMask) -> Vec<u32> {
    let mut total = 0;
    mask.words()
        .iter()
        .map(|w| {
            let before = total;
            total += w.count_ones();
            before
        })
        .collect()
}

/// Calls `each(brick number, brick)` for every brick with support, in order.
///
/// # Panics
/// If `codes` fails [`ResidualCodes::check`].
pub fn for_each_brick(codes: &ResidualCodes, mut each: impl FnMut(usize, &Brick)) {
    let [nx, ny, nz] = codes.dims.map(|d| d as usize);
    let [bx, by, bz] = bricks_of(codes.dims).map(|b| b as usize);
    let words = codes.support.words();
    let ranks = ranks(&codes.support);
    let mut brick = Brick::default();
    for number in 0..bx * by * bz {
        let [x0, y0, z0] = [number % bx * 8, number / bx % by * 8, number / bx / by * 8];
        let width = (nx - x0).min(8);
        let mut any = false;
        brick.masks = [0; 8];
        for z in z0..(z0 + 8).min(nz) {
            for y in y0..(y0 + 8).min(ny) {
                // Up to eight mask bits of this row, which may straddle two words.
                let first = x0 + nx * (y + ny * z);
                let (word, shift) = (first / 64, first % 64);
                let mut row = words[word] >> shift;
                if shift + width > 64 {
                    row |= words[word + 1] << (64 - shift);
                }
                row &= (1 << width) - 1;
                if row == 0 {
                    continue;
                }
                if !any {
                    any = true;
                    brick.codes = [0; 512];
                }
                let below = words[word] & ((1 << shift) - 1);
                let mut code = (ranks[word] + below.count_ones()) as usize;
                while row != 0 {
                    let x = row.trailing_zeros();
                    let (cell, bit) = cell_and_bit([x, y as u32, z as u32]);
                    brick.masks[cell as usize] |= 1 << bit;
                    brick.codes[(64 * cell + bit) as usize] = codes.codes[code];
                    code += 1;
                    row &= row - 1;
                }
            }
        }
        if any {
            each(number, &brick);
        }
    }
}

/// The inverse of [`for_each_brick`]: collects bricks, in any order and each at most once, into the codes of a frame.
///
/// Bits that hang over the box must be zero: [`overhang`] tells.
pub fn from_bricks(origin: [i32; 3], dims: [u32; 3], bricks: impl Fn(&mut dyn FnMut(usize, &Brick))) -> ResidualCodes {
    let [nx, ny, nz] = dims.map(|d| d as usize);
    let mut support = VoxelMask::new(nx * ny * nz);
    let [bx, by, _] = bricks_of(dims).map(|b| b as usize);
    let voxel = |number: usize, cell: usize, bit: usize| {
        let x = number % bx * 8 + (cell & 1) * 4 + (bit & 3);
        let y = number / bx % by * 8 + (cell >> 1 & 1) * 4 + (bit >> 2 & 3);
        let z = number / bx / by * 8 + (cell >> 2) * 4 + (bit >> 4);
        x + nx * (y + ny * z)
    };
    let voxels = |number: usize, brick: &Brick, each: &mut dyn FnMut(usize, i32)| {
        for (cell, &mask) in brick.masks.iter().enumerate() {
            let mut left = mask;
            while left != 0 {
                let bit = left.trailing_zeros() as usize;
                each(voxel(number, cell, bit), brick.codes[64 * cell + bit]);
                left &= left - 1;
            }
        }
    };
    bricks(&mut |number, brick| voxels(number, brick, &mut |v, _| support.set(v)));
    let ranks = ranks(&support);
    let mut codes = vec![0; support.count()];
    bricks(&mut |number, brick| {
        voxels(number, brick, &mut |v, code| {
            let below = support.words()[v / 64] & ((1 << (v % 64)) - 1);
            codes[(ranks[v / 64] + below.count_ones()) as usize] = code;
        });
    });
    ResidualCodes { origin, dims, support, codes }
}

/// The bits of cell `cell` of brick `number` that lie outside the box: a good mask has none of them.
pub fn overhang(dims: [u32; 3], number: usize, cell: u32) -> u64 {
    let [bx, by, _] = bricks_of(dims).map(|b| b as usize);
    let at = [number % bx, number / bx % by, number / bx / by];
    let inside = |axis: usize| {
        let first = at[axis] * 8 + (cell as usize >> axis & 1) * 4;
        (dims[axis] as usize).saturating_sub(first).min(4)
    };
    let (x, y, z) = (inside(0), inside(1), inside(2));
    if (x, y, z) == (4, 4, 4) {
        return 0;
    }
    let mut mask = 0u64;
    for k in 0..z {
        for j in 0..y {
            mask |= ((1 << x) - 1) << (4 * j + 16 * k);
        }
    }
    !mask
}

/// The 32-bit little-endian word `i` of `bytes`.
#[inline]
pub(super) fn word(bytes: &[u8], i: usize) -> u32 {
    let at = &bytes[4 * i..4 * i + 4];
    u32::from_le_bytes([at[0], at[1], at[2], at[3]])
}

/// The 64-bit mask in words `i` (low half) and `i + 1`.
#[inline]
pub(super) fn mask_at(bytes: &[u8], i: usize) -> u64 {
    u64::from(word(bytes, i)) | u64::from(word(bytes, i + 1)) << 32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::frames_of_every_kind;

    #[test]
    fn bricks_of_every_kind_of_frame_collect_to_the_same_frame() {
        for frame in frames_of_every_kind() {
            let back = from_bricks(frame.origin, frame.dims, |each| for_each_brick(&frame, |n, b| each(n, b)));
            assert_eq!(back, frame);
        }
    }

    #[test]
    fn a_voxel_lies_in_the_cell_and_bit_of_the_brute_force_search() {
        let frame = crate::residual::tests::ball([13, 18, 9], 50, 7);
        let mut next = 0;
        let mut bricks = vec![];
        for_each_brick(&frame, |n, b| bricks.push((n, b.clone())));
        for v in 0..13 * 18 * 9u32 {
            let at = [v % 13, v / 13 % 18, v / 13 / 18];
            let number = (at[0] / 8 + 2 * (at[1] / 8 + 3 * (at[2] / 8))) as usize;
            let (cell, bit) = cell_and_bit(at);
            let brick = bricks.iter().find(|(n, _)| *n == number).map(|(_, b)| b);
            let inside = brick.is_some_and(|b| b.masks[cell as usize] >> bit & 1 == 1);
            assert_eq!(inside, frame.support.get(v as usize));
            if inside {
                assert_eq!(brick.unwrap().codes[(64 * cell + bit) as usize], frame.codes[next]);
                next += 1;
            }
        }
    }

    #[test]
    fn the_overhang_is_exactly_the_bits_past_the_end_of_the_box() {
        for dims in [[1, 1, 1], [8, 8, 8], [9, 4, 13], [3, 12, 5]] {
            let [bx, by, bz] = bricks_of(dims);
            for number in 0..(bx * by * bz) as usize {
                for z in 0..8 {
                    for y in 0..8 {
                        for x in 0..8 {
                            let (cell, bit) = cell_and_bit([x, y, z]);
                            let n = number as u32;
                            let at = [n % bx * 8 + x, n / bx % by * 8 + y, n / bx / by * 8 + z];
                            let outside = (0..3).any(|a| at[a] >= dims[a]);
                            assert_eq!(overhang(dims, number, cell) >> bit & 1 == 1, outside, "{dims:?} {at:?}");
                        }
                    }
                }
            }
        }
    }
}
