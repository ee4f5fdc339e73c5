//! The quantised residual of one frame: what the Gaussians miss, as integer codes on the frame's support.
//!
//! | file | what |
//! |---|---|
//! | [`brick`] | a frame cut into bricks of 8^3 voxels, each of eight cells of 4^3 |
//! | [`rank`] | resident layout A: masks, ranks and bit-packed codes, one frame each |
//! | [`hash`] | resident layout B: a perfect spatial hash over a tile of up to 27 frames |
//! | [`coded`] | the codes at rest |
//!
//! Both resident layouts answer the same question through [`Residual`]: the code of a voxel, or none outside the
//! support. [`dequantise`] turns it into density; the quantiser and the decoder both call it, so what was promised at
//! bake time is what is seen at render time.

pub mod brick;
pub mod coded;
pub mod hash;
pub mod rank;

use crate::bounded::MAX_DENSE_VOXELS;
use crate::volume::VoxelMask;
use crate::{Error, Result};
use std::path::Path;

/// Largest magnitude of a code: 2^23 - 1, so that a code is exact in f32 and a range of codes fits 24 bits.
pub const MAX_CODE: i32 = (1 << 23) - 1;

/// The density of a voxel of the support from the Gaussian sum there, its code and the frame's step.
///
/// `max(0, sum + step * code)` with two roundings, to nearest, and never as a fused multiply-add: every machine gets
/// the same bits. A voxel outside the support is exactly zero and does not come here. A sum that is not a number
/// gives zero.
#[inline]
pub fn dequantise(sum: f32, code: i32, step: f32) -> f32 {
    let density = sum + step * code as f32;
    // Not `f32::max`: its sign for two zeros may differ between machines.
    if density > 0.0 { density } else { 0.0 }
}

/// The residual of one frame before any layout: `density = max(0, gaussian_sum + step * code)` on the support,
/// and exactly zero elsewhere.
#[derive(Clone, Debug, PartialEq)]
pub struct ResidualCodes {
    /// Index coordinates of the first voxel of the frame's box.
    pub origin: [i32; 3],
    /// Voxels along x, y, z; all zero for an empty frame.
    pub dims: [u32; 3],
    /// The voxels where the source is active or not zero, x fastest. Everywhere else the density is exactly zero.
    pub support: VoxelMask,
    /// One code for each voxel of the support, in voxel order.
    pub codes: Vec<i32>,
}

impl ResidualCodes {
    /// Fails unless box, support and codes agree and every code is within ±[`MAX_CODE`]; `path` is named in the error.
    pub fn check(&self, path: &Path) -> Result<()> {
        let voxels = voxels_of(path, self.dims)?;
        if self.support.len() as u64 != voxels {
            return Err(Error::invalid(path, "residual.support", self.support.len(), format!("{voxels} voxels")));
        }
        let count = self.support.count();
        if self.codes.len() != count {
            return Err(Error::invalid(path, "residual.codes", self.codes.len(), format!("{count} codes")));
        }
        match self.codes.iter().position(|c| c.unsigned_abs() > MAX_CODE as u32) {
            Some(i) => {
                Err(Error::invalid(path, format!("residual.codes[{i}]"), self.codes[i], format!("within ±{MAX_CODE}")))
            }
            None => Ok(()),
        }
    }
}

/// The voxels of a box, refused above [`MAX_DENSE_VOXELS`] and for a box with some sides zero and some not.
pub(crate) fn voxels_of(path: &Path, dims: [u32; 3]) -> Result<u64> {
    let voxels = dims.iter().try_fold(1u64, |v, &d| v.checked_mul(u64::from(d)));
    let whole = dims == [0; 3] || dims.iter().all(|&d| d > 0);
    match voxels.filter(|&v| v <= MAX_DENSE_VOXELS && whole) {
        Some(v) => Ok(v),
        None => {
            let expected = format!("at most {MAX_DENSE_VOXELS} voxels, all sides zero or none");
            Err(Error::invalid(path, "dims", format!("{dims:?}"), expected))
        }
    }
}

/// The resident residual of one frame or of one tile of frames, behind one lookup.
#[derive(Clone, Debug)]
pub enum Residual<B = Vec<u8>> {
    /// One frame in bricks with ranks.
    Rank(rank::RankView<B>),
    /// Up to 27 frames in one perfect hash.
    Hash(hash::HashView<B>),
}

impl<B: AsRef<[u8]>> Residual<B> {
    /// The frames that it holds.
    pub fn frames(&self) -> usize {
        match self {
            Self::Rank(_) => 1,
            Self::Hash(view) => view.frames(),
        }
    }

    /// Origin and dims of the box of `frame < frames()`.
    pub fn frame_box(&self, frame: usize) -> ([i32; 3], [u32; 3]) {
        match self {
            Self::Rank(view) => (view.origin(), view.dims()),
            Self::Hash(view) => view.frame_box(frame),
        }
    }

    /// Voxels of the support of `frame < frames()`.
    pub fn active_voxels(&self, frame: usize) -> u64 {
        match self {
            Self::Rank(view) => view.active_voxels(),
            Self::Hash(view) => view.active_voxels(frame),
        }
    }

    /// The code of a voxel of `frame < frames()`, by its place in the frame's box; none outside the support or the box.
    #[inline]
    pub fn code(&self, frame: usize, voxel: [u32; 3]) -> Option<i32> {
        match self {
            Self::Rank(view) => view.code(voxel),
            Self::Hash(view) => view.code(frame, voxel),
        }
    }

    /// All codes of `frame < frames()`.
    pub fn codes(&self, frame: usize) -> Result<ResidualCodes> {
        match self {
            Self::Rank(view) => Ok(view.codes()),
            Self::Hash(view) => view.codes(frame),
        }
    }

    /// The resident bytes, ready to be uploaded.
    pub fn bytes(&self) -> &[u8] {
        match self {
            Self::Rank(view) => view.bytes(),
            Self::Hash(view) => view.bytes(),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A generator for tests: PCG-XSH-RR 64/32 (O'Neill 2014).
    pub(crate) struct Pcg(pub u64);

    impl Pcg {
        pub(crate) fn next(&mut self) -> u32 {
            let state = self.0;
            self.0 = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            ((((state >> 18) ^ state) >> 27) as u32).rotate_right((state >> 59) as u32)
        }

        pub(crate) fn below(&mut self, n: u32) -> u32 {
            ((u64::from(self.next()) * u64::from(n)) >> 32) as u32
        }
    }

    /// A frame of `dims` voxels: a ball of smooth codes with holes, `spread` wide, at an odd origin.
    pub(crate) fn ball(dims: [u32; 3], spread: i32, seed: u64) -> ResidualCodes {
        let mut random = Pcg(seed);
        let mut support = VoxelMask::new(dims.iter().product::<u32>() as usize);
        let mut codes = vec![];
        for v in 0..support.len() as u32 {
            let at = [v % dims[0], v / dims[0] % dims[1], v / dims[0] / dims[1]];
            let q: f32 = (0..3).map(|a| ((at[a] as f32 + 0.5) / dims[a] as f32 * 2.0 - 1.0).powi(2)).sum();
            if q <= 1.0 && random.below(50) != 0 {
                support.set(v as usize);
                let smooth = ((1.0 - q) * spread as f32) as i32;
                codes.push(smooth - spread / 3 + random.below(spread.max(1) as u32 / 8 + 1) as i32);
            }
        }
        ResidualCodes { origin: [-3, 5, 11], dims, support, codes }
    }

    /// The empty frame.
    pub(crate) fn empty() -> ResidualCodes {
        ResidualCodes { origin: [0; 3], dims: [0; 3], support: VoxelMask::new(0), codes: vec![] }
    }

    /// Frames that every layout must take: empty, one voxel, no support, full, extreme codes, thin, not a multiple of 8.
    pub(crate) fn frames_of_every_kind() -> Vec<ResidualCodes> {
        let one = |dims: [u32; 3], codes: Vec<i32>| {
            let mut support = VoxelMask::new(dims.iter().product::<u32>() as usize);
            (0..codes.len()).for_each(|v| support.set(v));
            ResidualCodes { origin: [i32::MIN, 0, i32::MAX - 600], dims, support, codes }
        };
        vec![
            empty(),
            one([1, 1, 1], vec![]),
            one([1, 1, 1], vec![0]),
            one([1, 1, 1], vec![-MAX_CODE]),
            one([2, 1, 1], vec![-MAX_CODE, MAX_CODE]),
            one([513, 1, 1], (0..513).map(|i| i * 31_111 - MAX_CODE).collect()),
            one([8, 8, 8], (0..512).map(|i| (i * i) % 77 - 5).collect()),
            one([9, 7, 17], vec![0; 9 * 7 * 17]),
            ball([20, 31, 17], 100, 1),
            ball([33, 8, 9], 3_000_000, 2),
            ball([5, 64, 3], 0, 3),
        ]
    }

    #[test]
    fn a_density_below_zero_becomes_plain_zero() {
        assert_eq!(dequantise(0.25, -2, 0.25).to_bits(), 0);
        assert_eq!(dequantise(-0.0, 0, 1.0).to_bits(), 0);
        assert_eq!(dequantise(f32::NAN, 1, 1.0).to_bits(), 0);
        assert_eq!(dequantise(0.5, 3, 0.25), 1.25);
    }

    #[test]
    fn codes_that_disagree_with_their_support_are_refused() {
        let good = ball([9, 9, 9], 40, 4);
        let path = Path::new("p");
        assert!(good.check(path).is_ok());
        for (spoil, named) in [
            ((|c| c.codes.truncate(3)) as fn(&mut ResidualCodes), "residual.codes"),
            (|c| c.codes[2] = MAX_CODE + 1, "residual.codes[2]"),
            (|c| c.codes[1] = i32::MIN, "residual.codes[1]"),
            (|c| c.dims = [9, 9, 8], "residual.support"),
            (|c| c.dims = [9, 9, 0], "dims"),
            (|c| c.dims = [u32::MAX; 3], "dims"),
        ] {
            let mut bad = good.clone();
            spoil(&mut bad);
            let message = bad.check(path).unwrap_err().to_string();
            assert!(message.starts_with(&format!("p: {named}: ")), "{message}");
        }
    }
}
