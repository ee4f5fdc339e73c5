//! A dense box as an OpenVDB file: version 224, one grid, leaves wherever a voxel is active or not zero.
//!
//! The background is zero, values are float or half, blocks plain or zlib, always with active-mask compression (inactive
//! voxels that are zero take no room; `values` has the table of codes). No tiles are made: a uniform region costs its
//! leaves, which zlib makes small. The same grid and options give the same bytes: the UUID is a hash of the content.
//! Cost: two passes over the box, and zlib where asked (about 150 ns an active voxel with it). Source: as the readers beside it.

use super::topology::{INNER_LEVELS, LEAF_LOG2, LeafMask, ROOT_CHILD_LOG2};
use super::values::{ACTIVE_MASK, ZIP, describe};
use super::{header, transform};
use crate::volume::DensityGrid;
use crate::{Error, Result, atomic};
use flate2::Compression;
use flate2::write::ZlibEncoder;
use half::f16;
use std::io::Write;
use std::path::Path;

/// How [`write()`] stores the values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WriteOptions {
    /// As half floats, rounded to nearest: relative error at most 2^-11 from 6e-5 up to 65504, the largest.
    pub half: bool,
    /// As zlib streams, where that is shorter.
    pub zip: bool,
}

/// The library version that files of this layout carry; OpenVDB shows it and decides nothing by it.
const LIBRARY_VERSION: [u32; 2] = [10, 0];

/// Writes `grid` as the only grid of a fog-volume file at `path`, whole or not at all.
///
/// Errors: a name that OpenVDB reserves, a transform that is not invertible, a box beyond the i32 coordinates, and with
/// `half` a finite value that half floats cannot hold. Panics if `values` or `active` do not have one entry a voxel.
pub fn write(path: &Path, grid: &DensityGrid, options: &WriteOptions) -> Result<()> {
    atomic::write_bytes(path, &to_bytes(path, grid, options)?)
}

/// How far half floats move the value they move most: what [`WriteOptions::half`] adds to any error before it.
pub fn half_rounding(grid: &DensityGrid) -> f64 {
    let off = |v: f32| (f64::from(f16::from_f32(v).to_f32()) - f64::from(v)).abs();
    grid.values.iter().fold(0.0, |most: f64, &v| most.max(off(v)))
}

struct LeafPlace {
    /// Root child, slot in it, slot in that: the order of the file.
    order: ([i32; 3], usize, usize),
    origin: [i32; 3],
    mask: LeafMask,
}

pub(super) fn to_bytes(path: &Path, grid: &DensityGrid, options: &WriteOptions) -> Result<Vec<u8>> {
    let voxels = grid.dims.iter().product::<usize>();
    assert!(grid.values.len() == voxels && grid.active.len() == voxels, "{:?} and {}", grid.dims, grid.values.len());
    check(path, grid, options)?;
    let leaves = leaves(grid, options);
    let mut out = header::MAGIC.to_vec();
    put_u32s(&mut out, &[header::LAST_VERSION, LIBRARY_VERSION[0], LIBRARY_VERSION[1]]);
    out.push(1);
    let uuid_at = out.len();
    out.extend([b'0'; 36]);
    put_u32s(&mut out, &[0, 1]); // no metadata of the file, one grid

    put_string(&mut out, grid.name.as_bytes());
    put_string(&mut out, if options.half { b"Tree_float_5_4_3_HalfFloat" } else { b"Tree_float_5_4_3" });
    put_string(&mut out, b"");
    let offsets_at = out.len();
    let grid_pos = offsets_at + 24;
    out.resize(grid_pos, 0);
    let flags = ACTIVE_MASK | if options.zip { ZIP } else { 0 };
    put_u32s(&mut out, &[flags]);
    put_metadata(&mut out, grid, options, flags, leaves.len());
    transform::write(&mut out, path, &grid.world_from_index)?;
    put_topology(&mut out, &leaves, options);
    let block_pos = out.len();
    for leaf in &leaves {
        put_mask(&mut out, &leaf.mask);
        put_values(&mut out, &leaf.mask, &gather(grid, options, leaf.origin), options);
    }
    let offsets = [grid_pos, block_pos, out.len()].map(|o| (o as i64).to_le_bytes()).concat();
    out[offsets_at..grid_pos].copy_from_slice(&offsets);
    let uuid = uuid(&out[uuid_at + 36..]);
    out[uuid_at..uuid_at + 36].copy_from_slice(uuid.as_bytes());
    Ok(out)
}

fn check(path: &Path, grid: &DensityGrid, options: &WriteOptions) -> Result<()> {
    if grid.name.is_empty() || grid.name.contains('\u{1e}') || grid.name.len() > 1024 {
        let expected = "1 to 1024 bytes without the record separator";
        return Err(Error::invalid(path, "grid name", grid.name.escape_debug(), expected));
    }
    for a in 0..3 {
        let end = i64::from(grid.origin[a]) + grid.dims[a] as i64 - 1;
        if end > i64::from(i32::MAX) {
            return Err(Error::invalid(path, "last voxel of the box", end, format!("at most {}", i32::MAX)));
        }
    }
    if options.half {
        let lost = |v: &&f32| v.is_finite() && f16::from_f32(**v).is_infinite();
        if let Some(value) = grid.values.iter().find(lost) {
            let expected = "at most 65504 in half floats; write full floats instead";
            return Err(Error::invalid(path, "value", value, expected));
        }
    }
    Ok(())
}

/// The values of the leaf at `origin` as they will be read back, zero outside the box, z fastest.
fn gather(grid: &DensityGrid, options: &WriteOptions, origin: [i32; 3]) -> [f32; 512] {
    let mut values = [0.0; 512];
    each_voxel(grid, origin, |at, v| {
        let value = grid.values[v];
        values[at] = if options.half { f16::from_f32(value).to_f32() } else { value };
    });
    values
}

/// Calls `visit(position in the leaf, position in the box)` for the voxels of a leaf that lie in the box.
fn each_voxel(grid: &DensityGrid, origin: [i32; 3], mut visit: impl FnMut(usize, usize)) {
    let start: [i64; 3] = std::array::from_fn(|a| i64::from(origin[a]) - i64::from(grid.origin[a]));
    let range = |a: usize| {
        let low = (-start[a]).clamp(0, 8) as usize;
        low..(grid.dims[a] as i64 - start[a]).clamp(low as i64, 8) as usize
    };
    let (xs, ys, zs) = (range(0), range(1), range(2));
    for z in zs {
        for y in ys.clone() {
            let row = grid.dims[0] as i64 * ((start[1] + y as i64) + grid.dims[1] as i64 * (start[2] + z as i64));
            for x in xs.clone() {
                visit(64 * x + 8 * y + z, (row + start[0] + x as i64) as usize);
            }
        }
    }
}

/// The leaves to write, in the order of the file.
fn leaves(grid: &DensityGrid, options: &WriteOptions) -> Vec<LeafPlace> {
    let mut leaves = Vec::new();
    if grid.is_empty() {
        return leaves;
    }
    let first = grid.origin.map(|o| o >> LEAF_LOG2);
    let last: [i32; 3] = std::array::from_fn(|a| {
        // The end of the box was checked to be an i32.
        ((i64::from(grid.origin[a]) + grid.dims[a] as i64 - 1) >> LEAF_LOG2) as i32
    });
    for z in first[2]..=last[2] {
        for y in first[1]..=last[1] {
            for x in first[0]..=last[0] {
                let origin = [x, y, z].map(|i| i << LEAF_LOG2);
                let mut mask = LeafMask::default();
                each_voxel(grid, origin, |at, v| mask[at / 64] |= u64::from(grid.active.get(v)) << (at % 64));
                let empty = mask == LeafMask::default();
                if !empty || gather(grid, options, origin).iter().any(|v| v.to_bits() != 0) {
                    let root = origin.map(|o| o >> ROOT_CHILD_LOG2 << ROOT_CHILD_LOG2);
                    let [upper, lower] = INNER_LEVELS.map(|(slot_log2, side_log2)| {
                        let at = origin.map(|o| (o >> slot_log2) as usize & ((1 << side_log2) - 1));
                        (at[0] << side_log2 | at[1]) << side_log2 | at[2]
                    });
                    leaves.push(LeafPlace { order: (root, upper, lower), origin, mask });
                }
            }
        }
    }
    leaves.sort_unstable_by_key(|leaf| leaf.order);
    leaves
}

fn put_topology(out: &mut Vec<u8>, leaves: &[LeafPlace], options: &WriteOptions) {
    let roots = leaves.chunk_by(|a, b| a.order.0 == b.order.0);
    put_u32s(out, &[1, 0f32.to_bits(), 0, roots.clone().count() as u32]);
    for root in roots {
        put_u32s(out, &root[0].order.0.map(|k| k as u32));
        put_inner::<32768>(out, root.iter().map(|leaf| leaf.order.1), options);
        for upper in root.chunk_by(|a, b| a.order.1 == b.order.1) {
            put_inner::<4096>(out, upper.iter().map(|leaf| leaf.order.2), options);
            for leaf in upper {
                put_mask(out, &leaf.mask);
            }
        }
    }
}

/// An inner node without tiles: child mask, empty value mask, code 0, no values.
fn put_inner<const SLOTS: usize>(out: &mut Vec<u8>, slots: impl Iterator<Item = usize>, options: &WriteOptions) {
    let mut children = vec![0; SLOTS / 64];
    slots.for_each(|s| children[s / 64] |= 1 << (s % 64));
    put_mask(out, &children);
    put_mask(out, &vec![0; SLOTS / 64]);
    out.push(0);
    put_block(out, &[], options);
}

/// Code, inactive values, selection and block of a leaf.
fn put_values(out: &mut Vec<u8>, mask: &LeafMask, values: &[f32; 512], options: &WriteOptions) {
    let active = |i: usize| mask[i / 64] >> (i % 64) & 1 == 1;
    // Compared by bits, so that -0.0 and NaN come back as they are.
    let mut inactive: Vec<u32> = Vec::with_capacity(3);
    for (i, value) in values.iter().enumerate() {
        if !active(i) && inactive.len() < 3 && !inactive.contains(&value.to_bits()) {
            inactive.push(value.to_bits());
        }
    }
    let zero = inactive.contains(&0);
    inactive.retain(|&v| v != 0);
    let (code, stored) = match (inactive.len(), zero) {
        (0, _) => (0, false),
        (1, false) => (2, false),
        (1, true) => (4, false),
        (2, false) => (5, false),
        _ => (6, true),
    };
    out.push(code);
    if !stored {
        put_u32s(out, &inactive);
    }
    if code == 4 || code == 5 {
        // A set bit means the background for code 4 and the second value for code 5: anything but the first.
        let mut selection = LeafMask::default();
        for (i, value) in values.iter().enumerate() {
            selection[i / 64] |= u64::from(!active(i) && value.to_bits() != inactive[0]) << (i % 64);
        }
        put_mask(out, &selection);
    }
    let kept: Vec<f32> = (0..512).filter(|&i| stored || active(i)).map(|i| values[i]).collect();
    put_block(out, &kept, options);
}

fn put_block(out: &mut Vec<u8>, values: &[f32], options: &WriteOptions) {
    let plain: Vec<u8> = match options.half {
        true => values.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect(),
        false => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
    };
    if !options.zip {
        out.extend(plain);
        return;
    }
    if values.is_empty() {
        // Half floats write no length for an empty block.
        out.extend(if options.half { &[][..] } else { &[0; 8] });
        return;
    }
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    let packed = encoder.write_all(&plain).and_then(|()| encoder.finish()).unwrap_or_default();
    if !packed.is_empty() && packed.len() < plain.len() {
        out.extend((packed.len() as i64).to_le_bytes());
        out.extend(packed);
    } else {
        out.extend((-(plain.len() as i64)).to_le_bytes());
        out.extend(plain);
    }
}

/// The entries that OpenVDB's tools show, in alphabetical order as OpenVDB keeps them.
fn put_metadata(out: &mut Vec<u8>, grid: &DensityGrid, options: &WriteOptions, flags: u32, leaves: usize) {
    let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
    for v in grid.active.iter_set() {
        let local = [v % grid.dims[0], v / grid.dims[0] % grid.dims[1], v / grid.dims[0] / grid.dims[1]];
        for a in 0..3 {
            let at = (i64::from(grid.origin[a]) + local[a] as i64) as i32;
            (low[a], high[a]) = (low[a].min(at), high[a].max(at));
        }
    }
    let corner = |c: [i32; 3]| c.map(i32::to_le_bytes).concat();
    let count = |n: usize| (n as i64).to_le_bytes().to_vec();
    let entries: [(&str, &str, Vec<u8>); 9] = [
        ("class", "string", b"fog volume".to_vec()),
        ("creator", "string", concat!("smoke-bake ", env!("CARGO_PKG_VERSION")).into()),
        ("file_bbox_max", "vec3i", corner(high)),
        ("file_bbox_min", "vec3i", corner(low)),
        ("file_compression", "string", describe(flags).into_bytes()),
        ("file_mem_bytes", "int64", count(leaves * (512 * 4 + 64))),
        ("file_voxel_count", "int64", count(grid.active.count())),
        ("is_saved_as_half_float", "bool", vec![options.half.into()]),
        ("name", "string", grid.name.clone().into_bytes()),
    ];
    put_u32s(out, &[entries.len() as u32]);
    for (name, kind, value) in &entries {
        put_string(out, name.as_bytes());
        put_string(out, kind.as_bytes());
        put_string(out, value);
    }
}

/// 128 bits of hash in the form of a UUID of version 8 (RFC 9562: the bits are the maker's own).
fn uuid(content: &[u8]) -> String {
    let hash = xxhash_rust::xxh3::xxh3_128(content);
    let hash = hash & !(0xf << 76) & !(0b11 << 62) | 8 << 76 | 0b10 << 62;
    let hex = format!("{hash:032x}");
    [&hex[..8], &hex[8..12], &hex[12..16], &hex[16..20], &hex[20..]].join("-")
}

fn put_u32s(out: &mut Vec<u8>, numbers: &[u32]) {
    out.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
}

fn put_string(out: &mut Vec<u8>, text: &[u8]) {
    put_u32s(out, &[text.len() as u32]);
    out.extend(text);
}

fn put_mask(out: &mut Vec<u8>, words: &[u64]) {
    out.extend(words.iter().flat_map(|w| w.to_le_bytes()));
}
