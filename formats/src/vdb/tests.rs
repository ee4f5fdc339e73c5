//! Files put together byte by byte, for what no tool at hand writes, and for damage at a chosen place.

use super::values::{ACTIVE_MASK, BLOSC, ZIP};
use super::*;
use half::f16;
use std::io::Write as _;

/// One grid of a file, in the pieces that the offsets separate.
#[derive(Clone)]
struct Part {
    name: &'static str,
    tree: &'static str,
    parent: &'static str,
    content: Vec<u8>,
    topology: Vec<u8>,
    blocks: Vec<u8>,
}

fn text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

fn words(words: &[u32]) -> Vec<u8> {
    words.iter().flat_map(|w| w.to_le_bytes()).collect()
}

fn file(version: u32, has_offsets: bool, parts: &[Part]) -> Vec<u8> {
    let mut out = header::MAGIC.to_vec();
    out.extend(words(&[version, 3, 0]));
    out.push(has_offsets.into());
    out.extend([b'0'; 36]);
    out.extend(words(&[0, parts.len() as u32]));
    for part in parts {
        text(&mut out, part.name);
        text(&mut out, part.tree);
        text(&mut out, part.parent);
        let content = out.len() + 24;
        let blocks = content + part.content.len() + part.topology.len();
        let offsets = [content, blocks, blocks + part.blocks.len()];
        out.extend(offsets.map(|o| if has_offsets { o as i64 } else { 0 }.to_le_bytes()).concat());
        out.extend([&part.content[..], &part.topology, &part.blocks].concat());
    }
    out
}

fn content(flags: u32) -> Vec<u8> {
    let mut out = words(&[flags, 0]);
    text(&mut out, "UniformScaleMap");
    out.extend([0.5f64; 15].iter().flat_map(|v| v.to_le_bytes()));
    out
}

/// How a grid stores values: flags, half floats, and plain bytes (negative length) in spite of the flags.
#[derive(Clone, Copy, Debug)]
struct Coding {
    flags: u32,
    half: bool,
    plain: bool,
}

/// Full floats, nothing compressed.
const RAW: Coding = Coding { flags: 0, half: false, plain: false };

impl Coding {
    fn block(&self, values: &[f32]) -> Vec<u8> {
        let bytes: Vec<u8> = match self.half {
            true => values.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect(),
            false => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
        };
        if self.flags & (ZIP | BLOSC) == 0 {
            return bytes;
        }
        if bytes.is_empty() && self.half {
            return Vec::new();
        }
        let packed = if self.flags & BLOSC != 0 {
            let lz4 = lz4_flex::block::compress(&bytes);
            let mut chunk = vec![2, 1, 0x20 | 0x10, 4];
            let (stored, stream) = (lz4.len() >= bytes.len(), (lz4.len() as u32).to_le_bytes());
            let body = if stored { bytes.clone() } else { [&20u32.to_le_bytes()[..], &stream, &lz4].concat() };
            chunk[2] |= u8::from(stored) << 1;
            chunk.extend(words(&[bytes.len() as u32, bytes.len() as u32, 16 + body.len() as u32]));
            [chunk, body].concat()
        } else {
            let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(&bytes).unwrap();
            encoder.finish().unwrap()
        };
        let (length, data) = if self.plain { (-(bytes.len() as i64), bytes) } else { (packed.len() as i64, packed) };
        [&length.to_le_bytes()[..], &data].concat()
    }

    /// A float tree with one leaf at the origin and the given root tiles.
    fn topology(&self, background: f32, mask: &[u64; 8], tiles: &[([i32; 3], f32, bool)]) -> Vec<u8> {
        let mut out = words(&[1, background.to_bits(), tiles.len() as u32, 1]);
        for (key, value, active) in tiles {
            out.extend(words(&key.map(|k| k as u32)));
            out.extend(value.to_le_bytes());
            out.push((*active).into());
        }
        out.extend(words(&[0, 0, 0]));
        for slots in [32768, 4096] {
            let mut masks = vec![0u8; slots / 4];
            masks[0] = 1;
            out.extend(masks);
            let masked = self.flags & ACTIVE_MASK != 0;
            out.push(if masked { 0 } else { 6 });
            out.extend(self.block(&vec![background; if masked { 0 } else { slots }]));
        }
        out.extend(mask.map(u64::to_le_bytes).concat());
        out
    }

    fn tree(&self) -> &'static str {
        if self.half { "Tree_float_5_4_3_HalfFloat" } else { "Tree_float_5_4_3" }
    }

    fn part(&self, background: f32, mask: &[u64; 8], leaf: Vec<u8>) -> Part {
        let topology = self.topology(background, mask, &[]);
        let blocks = [mask.map(u64::to_le_bytes).concat(), leaf].concat();
        Part { name: "density", tree: self.tree(), parent: "", content: content(self.flags), topology, blocks }
    }
}

fn read_file(bytes: &[u8]) -> Result<DensityGrid> {
    read_bytes(Path::new("a.vdb"), bytes, "density")
}

/// Value of the leaf voxel that is bit `at % 64` of word `at / 64`, or the background outside the box.
fn leaf_value(grid: &DensityGrid, background: f32, at: usize) -> f32 {
    let index = [at >> 6, at >> 3 & 7, at & 7].map(|i| i as i32);
    grid.voxel(index).map_or(background, |v| grid.values[v])
}

const MASK: [u64; 8] = [0x8000_0000_0000_0001, 0, 0xff00, u64::MAX, 0, 0x1248_1248_0000_0000, 0, 0x8100_0000_0000_0081];

fn is_active(at: usize) -> bool {
    MASK[at / 64] >> (at % 64) & 1 == 1
}

/// Exactly representable in half floats.
fn sample(at: usize) -> f32 {
    (at % 200) as f32 * 0.25 + 0.25
}

#[test]
fn every_node_code_under_every_compression_gives_the_values_of_the_table() {
    let selected = |at: usize| (at * 7).is_multiple_of(3);
    let selection: Vec<u8> =
        (0..64).map(|b| (0..8).fold(0, |byte, i| byte | u8::from(selected(8 * b + i)) << i)).collect();
    for flags in 0..8 {
        for (half, plain) in [(false, false), (false, true), (true, false), (true, true)] {
            for (version, background) in [(222, 0.0f32), (223, 3.0), (224, 0.0)] {
                for code in 0..7u8 {
                    let coding = Coding { flags, half, plain };
                    let given = [0.125f32, -0.5];
                    let b = background;
                    let inactive = |at: usize| match (code, selected(at)) {
                        (0, _) => b,
                        (1, _) | (3, false) => -b,
                        (3 | 4, true) => b,
                        (2, _) | (4, false) | (5, false) => given[0],
                        (5, true) => given[1],
                        _ => sample(at),
                    };
                    let masked = flags & ACTIVE_MASK != 0 && code != 6;
                    let value = |at: usize| if is_active(at) || !masked { sample(at) } else { inactive(at) };
                    let mut leaf = vec![code];
                    let count = [0, 0, 1, 0, 1, 2, 0][usize::from(code)];
                    leaf.extend(given[..count].iter().flat_map(|v| v.to_le_bytes()));
                    if (3..=5).contains(&code) {
                        leaf.extend(&selection);
                    }
                    let stored: Vec<f32> = (0..512).filter(|&at| is_active(at) || !masked).map(sample).collect();
                    leaf.extend(coding.block(&stored));
                    let grid = read_file(&file(version, true, &[coding.part(b, &MASK, leaf)])).unwrap();
                    let case = format!("{coding:?} code {code} background {b}");
                    for at in 0..512 {
                        assert_eq!(leaf_value(&grid, b, at), value(at), "{case} voxel {at}");
                    }
                    assert_eq!(grid.active.count(), (0..512).filter(|&at| is_active(at)).count(), "{case}");
                }
            }
        }
    }
}

#[test]
fn root_tiles_active_and_inactive_take_part_in_the_box_and_the_values() {
    let mut part = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 512])].concat());
    // A root tile has 4096³ voxels, more than any box may: an active one is refused by the size of the box.
    part.topology = RAW.topology(0.0, &MASK, &[([4096, 0, 0], 2.0, true)]);
    let message = read_file(&file(224, true, &[part.clone()])).unwrap_err().to_string();
    assert!(message.contains("8192 x 4096 x 4096 voxels") && message.contains("grid 'density'"), "{message}");
    // An inactive tile is part of the box only if the background is zero; where it reaches into the box, it counts.
    part.topology = RAW.topology(0.0, &MASK, &[([-4096, 0, 0], 2.0, false)]);
    assert!(read_file(&file(224, true, &[part.clone()])).is_err());
    part.topology = RAW.topology(5.0, &MASK, &[([-4096, 0, 0], 2.0, false)]);
    let grid = read_file(&file(224, true, &[part])).unwrap();
    assert_eq!((grid.origin, grid.dims), ([0, 0, 0], [8, 8, 8]));
}

#[test]
fn a_streamed_file_is_walked_past_grids_of_other_types() {
    let float = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 512])].concat());
    let mut vector = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 3 * 512])].concat());
    (vector.name, vector.tree) = ("velocity", "Tree_vec3s_5_4_3");
    vector.topology = words(&[1, 0, 0, 0, 0, 1, 0, 0, 0]);
    for slots in [32768usize, 4096] {
        let mut masks = vec![0u8; slots / 4];
        masks[0] = 1;
        vector.topology.extend(masks);
        vector.topology.push(6);
        vector.topology.extend(RAW.block(&vec![0.0; 3 * slots]));
    }
    vector.topology.extend(MASK.map(u64::to_le_bytes).concat());
    let streamed = file(224, false, &[vector.clone(), float.clone()]);
    let grid = read_file(&streamed).unwrap();
    assert_eq!(grid, read_file(&file(224, true, &[vector.clone(), float.clone()])).unwrap());
    let mut bytes = Bytes::new(Path::new("a.vdb"), &streamed);
    let list = Directory::read(&mut bytes).unwrap().list(&bytes).unwrap();
    assert_eq!(list.iter().map(|g| g.value_type.as_str()).collect::<Vec<_>>(), ["vec3s", "float"]);

    // A type whose length is not known ends the walk: what came before is still readable.
    let mut points = vector;
    (points.name, points.tree) = ("points", "Tree_ptdataidx32_5_4_3");
    assert_eq!(read_file(&file(224, false, &[float.clone(), points.clone()])).unwrap(), grid);
    let message = read_file(&file(224, false, &[points.clone(), float.clone()])).unwrap_err().to_string();
    assert!(message.contains("ptdataidx32") && message.contains("points"), "{message}");
    // With offsets it is stepped over.
    assert_eq!(read_file(&file(224, true, &[points, float])).unwrap(), grid);
}

#[test]
fn an_instance_shares_the_voxels_and_keeps_its_own_map() {
    let float = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 512])].concat());
    let mut moved = words(&[0, 0]);
    text(&mut moved, "TranslationMap");
    moved.extend([1.0f64, 2.0, 3.0].iter().flat_map(|v| v.to_le_bytes()));
    let instance =
        |name, parent| Part { name, parent, content: moved.clone(), topology: vec![], blocks: vec![], ..float.clone() };
    for has_offsets in [true, false] {
        let bytes = file(224, has_offsets, &[instance("copy", "density"), float.clone()]);
        let read = |name| read_bytes(Path::new("a.vdb"), &bytes, name).unwrap();
        assert_eq!(read("copy").values, read("density").values);
        assert_eq!(read("copy").world_from_index, glam::DAffine3::from_translation(glam::DVec3::new(1.0, 2.0, 3.0)));
    }
    for parts in [vec![instance("density", "density")], vec![instance("density", "gone")]] {
        let message = read_file(&file(224, true, &parts)).unwrap_err().to_string();
        assert!(message.contains("instance parent"), "{message}");
    }
}

#[test]
fn each_integrity_check_sees_the_defect_it_is_for() {
    let good = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 512])].concat());
    let refused = |part: Part, what: &str| {
        let message = read_file(&file(224, true, &[part])).unwrap_err().to_string();
        assert!(message.starts_with("a.vdb: grid 'density': ") && message.contains(what), "{message}");
    };
    read_file(&file(224, true, std::slice::from_ref(&good))).unwrap();
    let mut part = good.clone();
    part.blocks[3] ^= 1;
    refused(part, "mask of the leaf at [0, 0, 0]");
    let mut part = good.clone();
    part.topology.push(0);
    refused(part, "end of the topology");
    let mut part = good.clone();
    part.blocks.push(0);
    refused(part, "end of the grid");
    let mut part = good.clone();
    part.blocks[64] = 7;
    refused(part, "node code");
    let mut part = good.clone();
    part.content[0] = 8;
    refused(part, "compression flags");
    let mut part = good.clone();
    part.topology[16] = 8;
    refused(part, "multiples of 4096");
    let mut part = good.clone();
    part.topology = RAW.topology(0.0, &MASK, &[([0; 3], 1.0, false)]);
    refused(part, "twice");
    let mut part = good.clone();
    part.topology[12..16].fill(255);
    refused(part, "4294967295 children");
    let mut part = good;
    part.tree = "Tree_float_4_3";
    refused(part, "Tree_float_4_3");
}

#[test]
fn offsets_that_go_back_are_refused() {
    let good = RAW.part(0.0, &MASK, [vec![6], RAW.block(&[1.0; 512])].concat());
    let bytes = file(224, true, &[good.clone(), good]);
    // Head and counts, name, tree type, empty parent.
    let offsets = 65 + (4 + 7) + (4 + 16) + 4;
    for (at, value) in [(0, 5i64), (8, 5), (16, 5), (16, -1), (16, i64::MAX)] {
        let mut bad = bytes.clone();
        bad[offsets + at..][..8].copy_from_slice(&value.to_le_bytes());
        let message = read_file(&bad).unwrap_err().to_string();
        assert!(message.contains("offset"), "{at} {value}: {message}");
    }
}

fn written(dims: [usize; 3], values: Vec<f32>, active: impl Fn(usize) -> bool) -> DensityGrid {
    let mut mask = crate::volume::VoxelMask::new(values.len());
    (0..values.len()).filter(|&v| active(v)).for_each(|v| mask.set(v));
    let (name, world_from_index) = ("density".to_owned(), glam::DAffine3::from_scale(glam::DVec3::splat(0.1)));
    DensityGrid { name, origin: [-5, 4093, -1], dims, values, active: mask, world_from_index }
}

#[test]
fn what_is_written_reads_back_with_the_same_bits_and_the_same_bytes_every_time() {
    let every = [0.0, -0.0, 1.5, -2.25, f32::NAN, f32::INFINITY, 0.0, 1.0, 0.5];
    for kinds in 1..=every.len() {
        let values: Vec<f32> = (0..17 * 9 * 11).map(|i| every[i * 31 % 97 % kinds]).collect();
        // The corners are active, so that the box that is read is the box that was written.
        let last = values.len() - 1;
        let grid = written([17, 9, 11], values, |v| v == 0 || v == last || v % 5 == 0);
        for (half, zip) in [(false, false), (false, true), (true, false), (true, true)] {
            let options = WriteOptions { half, zip };
            let bytes = write::to_bytes(Path::new("a.vdb"), &grid, &options).unwrap();
            assert_eq!(bytes, write::to_bytes(Path::new("a.vdb"), &grid, &options).unwrap());
            let back = read_file(&bytes).unwrap();
            assert!((back.origin, back.dims, &back.active) == (grid.origin, grid.dims, &grid.active));
            let bits = |g: &DensityGrid| g.values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert!(bits(&back) == bits(&grid), "{kinds} kinds {options:?}");
            assert_eq!(back.world_from_index, grid.world_from_index);
        }
    }
}

#[test]
fn what_cannot_be_written_is_an_error() {
    let write = |grid: &DensityGrid, half| write::to_bytes(Path::new("a.vdb"), grid, &WriteOptions { half, zip: true });
    let good = written([1, 1, 1], vec![65520.0], |_| true);
    write(&good, false).unwrap();
    assert!(write(&good, true).unwrap_err().to_string().contains("65520"));
    assert!(write(&DensityGrid { name: "a\u{1e}1".into(), ..good.clone() }, false).is_err());
    assert!(write(&DensityGrid { world_from_index: glam::DAffine3::ZERO, ..good.clone() }, false).is_err());
    let edge = DensityGrid { origin: [i32::MAX; 3], ..good };
    assert_eq!(read_file(&write(&edge, false).unwrap()).unwrap(), edge);
    let mut past = written([2, 1, 1], vec![1.0; 2], |_| true);
    past.origin = [i32::MAX; 3];
    assert!(write(&past, false).unwrap_err().to_string().contains("last voxel"));
    let empty = written([0; 3], vec![], |_| true);
    assert!(read_file(&write(&empty, true).unwrap()).unwrap().is_empty());
}
