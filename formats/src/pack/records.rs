//! The records of a pack, and the only place that knows how they are encoded: serde and bincode, little-endian, fixed
//! integers (an enum is a u32, an option a byte, a string a u64 length and its bytes), under a size limit.
//!
//! Fields of fixed size come first, so that their offsets can be stated in `FORMAT.md`.

use crate::bounded::MAX_DENSE_VOXELS;
use crate::{Error, Result};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Largest record section that is read or written, bytes.
pub const MAX_RECORD_BYTES: usize = 64 << 20;

const CONFIG: bincode::config::Configuration<
    bincode::config::LittleEndian,
    bincode::config::Fixint,
    bincode::config::Limit<MAX_RECORD_BYTES>,
> = bincode::config::standard().with_fixed_int_encoding().with_limit::<MAX_RECORD_BYTES>();

/// How the bytes of a section lie in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Codec {
    /// As they are resident.
    Raw = 0,
    /// Residual only: the coded codes, from which the resident layout is built again, byte for byte.
    Coded = 1,
    /// The resident bytes in a zlib stream.
    Deflate = 2,
    /// Gaussians only: 16 bits a parameter on the frame's own lattice.
    Snapped = 3,
    /// Rank layout only: coded with the help of the frame before, which must be decoded first.
    CodedAfter = 4,
}

impl Codec {
    /// The codec of a number in a file, if it is one.
    pub fn from_number(number: u32) -> Option<Self> {
        [Self::Raw, Self::Coded, Self::Deflate, Self::Snapped, Self::CodedAfter]
            .into_iter()
            .find(|&c| c as u32 == number)
    }
}

/// One entry of the table of contents.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SectionRecord {
    /// What it holds: one of the `KIND_` constants of [`super::container`].
    pub kind: u32,
    /// A [`Codec`].
    pub codec: u32,
    /// First frame that it belongs to, counted from 0; 0 for the sequence's own sections.
    pub first_frame: u32,
    /// Frames that it belongs to; 0 for the sequence's own sections.
    pub frames: u32,
    /// Where it starts in the file, a multiple of 256.
    pub offset: u64,
    /// Bytes in the file.
    pub bytes_at_rest: u64,
    /// Bytes after decoding.
    pub bytes_resident: u64,
    /// XXH3-64 of the bytes in the file.
    pub checksum: u64,
}

/// What the bake promised of every frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Promise {
    /// No voxel is further off than this, in the source's density unit.
    MaxError(f64),
    /// At least this PSNR over active voxels, in decibels; the peak is the sequence's largest density.
    Psnr(f64),
}

/// What holds for the whole sequence.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SequenceRecord {
    /// Exact affine map of the source, index to world: images of the x, y, z axis, then the origin's.
    pub world_from_index: [f64; 12],
    /// Index coordinates of the first voxel of the box of all frames.
    pub origin: [i32; 3],
    /// Voxels of that box along x, y, z.
    pub dims: [u32; 3],
    /// Largest density of the source over all frames.
    pub density_max: f32,
    /// What the bake promised.
    pub promise: Promise,
    /// Frames a second, if the source said.
    pub frames_per_second: Option<f64>,
    /// Name of the sequence.
    pub name: String,
    /// Name of the source's grid.
    pub grid: String,
}

impl Default for SequenceRecord {
    fn default() -> Self {
        Self {
            world_from_index: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0],
            origin: [0; 3],
            dims: [0; 3],
            density_max: 0.0,
            promise: Promise::MaxError(0.0),
            frames_per_second: None,
            name: String::new(),
            grid: String::new(),
        }
    }
}

/// The settings that made the pack.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SettingsRecord {
    /// A JSON document.
    pub json: String,
}

/// The resident layout of a frame's residual.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum ResidualKind {
    /// [`crate::residual::rank`].
    #[default]
    Rank,
    /// [`crate::residual::hash`].
    Hash,
}

/// What holds for one frame. [`super::PackWriter`] fills in the fields that it says it does.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// The source's frame number.
    pub frame: i32,
    /// Index coordinates of the first voxel of the frame's box (by the writer).
    pub origin: [i32; 3],
    /// Voxels of the frame's box along x, y, z (by the writer).
    pub dims: [u32; 3],
    /// Voxels of the support (by the writer).
    pub active_voxels: u64,
    /// Gaussians (by the writer).
    pub gaussians: u32,
    /// Fit error of the Gaussians alone, sum (D - sum)^2 / sum D^2.
    pub fit_error: f64,
    /// Largest error of any voxel after decoding, measured, in the source's density unit.
    pub max_error: f64,
    /// PSNR over active voxels after decoding, measured; infinite if exact.
    pub psnr_db: f64,
    /// Density a code, > 0.
    pub step: f32,
    /// Background of the source's grid.
    pub background: f32,
    /// XXH3-128 of the source's voxels, big end first.
    pub source_hash: [u8; 16],
    /// Resident layout of the residual (by the writer).
    pub residual: ResidualKind,
    /// Resident bytes of the rank layout; 0 if it was not built.
    pub rank_bytes: u64,
    /// Resident bytes of the hash layout, the frame's share of its tile; 0 if it was not built.
    pub hash_bytes: u64,
    /// Bytes in the file, Gaussians and residual; a tile's are shared out evenly (by the writer).
    pub bytes_at_rest: u64,
    /// Bytes in memory, likewise (by the writer).
    pub bytes_resident: u64,
}

/// A record's bytes.
pub fn encode<T: Serialize>(path: &Path, what: &str, record: &T) -> Result<Vec<u8>> {
    let most = format!("at most {MAX_RECORD_BYTES} bytes");
    let bytes = bincode::serde::encode_to_vec(record, CONFIG).map_err(|e| Error::invalid(path, what, e, &most))?;
    match bytes.len() <= MAX_RECORD_BYTES {
        true => Ok(bytes),
        false => Err(Error::invalid(path, what, bytes.len(), most)),
    }
}

/// A record from all of `bytes`: a byte too few or too many is an error.
pub fn decode<T: DeserializeOwned>(path: &Path, what: &str, bytes: &[u8]) -> Result<T> {
    let decoded = bincode::serde::decode_from_slice(bytes, CONFIG);
    let (record, used): (T, usize) = decoded.map_err(|e| Error::invalid(path, what, e, "a record"))?;
    match used == bytes.len() {
        true => Ok(record),
        false => Err(Error::invalid(path, what, format!("{} bytes", bytes.len()), format!("{used} bytes"))),
    }
}

impl SequenceRecord {
    /// Fails on the first field that no sequence can have.
    pub fn check(&self, path: &Path) -> Result<()> {
        for (i, v) in self.world_from_index.iter().enumerate() {
            number(path, &format!("sequence.world_from_index[{i}]"), *v, f64::is_finite, "a finite number")?;
        }
        box_of(path, "sequence", self.origin, self.dims)?;
        let not_negative = |v: f64| v >= 0.0 && v.is_finite();
        number(path, "sequence.density_max", f64::from(self.density_max), not_negative, "a density")?;
        match self.promise {
            Promise::MaxError(v) => number(path, "sequence.promise", v, not_negative, "an error of 0 or more")?,
            Promise::Psnr(v) => number(path, "sequence.promise", v, f64::is_finite, "decibels")?,
        }
        let positive = |v: f64| v > 0.0 && v.is_finite();
        number(path, "sequence.frames_per_second", self.frames_per_second.unwrap_or(24.0), positive, "above 0")
    }
}

impl SettingsRecord {
    /// Fails unless it is a JSON document.
    pub fn check(&self, path: &Path) -> Result<()> {
        let parsed = serde_json::from_str::<serde::de::IgnoredAny>(&self.json);
        parsed.map(drop).map_err(|e| Error::invalid(path, "settings.json", e, "a JSON document"))
    }
}

impl FrameRecord {
    /// Fails on the first field that no frame `number` (counted from 0) of `sequence` can have.
    pub fn check(&self, path: &Path, number_of_frame: usize, sequence: &SequenceRecord) -> Result<()> {
        let field = |name: &str| format!("frames[{number_of_frame}].{name}");
        box_of(path, &field("box"), self.origin, self.dims)?;
        for a in 0..3 {
            let (first, end) = (i64::from(self.origin[a]), i64::from(self.origin[a]) + i64::from(self.dims[a]));
            let whole = i64::from(sequence.origin[a]);
            if self.dims != [0; 3] && !(first >= whole && end <= whole + i64::from(sequence.dims[a])) {
                let found = format!("{:?} from {:?}", self.dims, self.origin);
                return Err(Error::invalid(path, field("dims"), found, "a box inside the sequence's"));
            }
        }
        let voxels = self.dims.iter().try_fold(1u64, |n, &d| n.checked_mul(u64::from(d)));
        let Some(voxels) = voxels.filter(|&n| n <= MAX_DENSE_VOXELS) else {
            let expected = format!("at most {MAX_DENSE_VOXELS} voxels");
            return Err(Error::invalid(path, field("dims"), format!("{:?}", self.dims), expected));
        };
        if self.active_voxels > voxels {
            return Err(Error::invalid(path, field("active_voxels"), self.active_voxels, format!("at most {voxels}")));
        }
        let not_negative = |v: f64| v >= 0.0 && v.is_finite();
        number(path, &field("fit_error"), self.fit_error, not_negative, "0 or more")?;
        number(path, &field("max_error"), self.max_error, not_negative, "0 or more")?;
        number(path, &field("psnr_db"), self.psnr_db, |v| v > f64::NEG_INFINITY, "decibels")?;
        let positive = |v: f64| v > 0.0 && v.is_finite();
        number(path, &field("step"), f64::from(self.step), positive, "above 0")?;
        number(path, &field("background"), f64::from(self.background), f64::is_finite, "a finite number")
    }
}

pub(super) fn number(path: &Path, what: &str, v: f64, good: impl Fn(f64) -> bool, expected: &str) -> Result<()> {
    match good(v) {
        true => Ok(()),
        false => Err(Error::invalid(path, what, v, expected)),
    }
}

/// A box is either empty or has no empty side, and every voxel of it has i32 coordinates.
fn box_of(path: &Path, what: &str, origin: [i32; 3], dims: [u32; 3]) -> Result<()> {
    let fits = (0..3).all(|a| i64::from(origin[a]) + i64::from(dims[a]) <= i64::from(i32::MAX) + 1);
    match fits && (dims == [0; 3] || dims.iter().all(|&d| d > 0)) {
        true => Ok(()),
        false => Err(Error::invalid(path, what, format!("{dims:?} from {origin:?}"), "a box of i32 coordinates")),
    }
}
