//! Voxel for voxel against other readers: what OpenVDB's own library wrote we read, what we write it reads.
//!
//! The expectation comes from `openvdb_expectation.py`, which uses pyopenvdb alone (Debian: python3-openvdb,
//! python3-numpy). A missing library is a failure, not a skip.

use glam::{DAffine3, DMat3, DVec3};
use smoke_formats::vdb;
use smoke_formats::volume::{DensityGrid, VoxelMask};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Debian installs pyopenvdb for its own Python.
const PYTHON: &str = "/usr/bin/python3";

/// `POINTS` of the script.
const POINTS: [[f64; 3]; 6] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [12.25, -7.5, 1000.0],
    [-123456.0, 98765.0, 3.0],
];

struct Expectation {
    origin: [i32; 3],
    dims: [usize; 3],
    active_voxels: u64,
    world: Vec<DVec3>,
    values: Vec<u32>,
    active: Vec<bool>,
}

fn script(name: &str, arguments: &[&str]) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(name);
    let output = Command::new(PYTHON).arg(path).args(arguments).output().expect(PYTHON);
    assert!(output.status.success(), "{name} (is python3-openvdb there?): {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn expectations(grids: &[(PathBuf, String)], folder: &Path) -> Vec<Expectation> {
    let out = |i: usize| folder.join(format!("{i}.expected")).to_str().unwrap().to_owned();
    let triples = grids.iter().enumerate().flat_map(|(i, (f, g))| [f.to_str().unwrap().to_owned(), g.clone(), out(i)]);
    let triples: Vec<String> = triples.collect();
    script("openvdb_expectation.py", &triples.iter().map(String::as_str).collect::<Vec<_>>());
    (0..grids.len()).map(|i| parse(&std::fs::read(out(i)).unwrap())).collect()
}

fn parse(mut bytes: &[u8]) -> Expectation {
    let mut take = |n: usize| {
        let (head, tail) = bytes.split_at(n);
        bytes = tail;
        head.to_vec()
    };
    let mut word = || u32::from_le_bytes(take(4).try_into().unwrap());
    let origin = [word(), word(), word()].map(|w| w as i32);
    let dims = [word(), word(), word()].map(|d| d as usize);
    let active_voxels = u64::from_le_bytes(take(8).try_into().unwrap());
    let mut f64s = || f64::from_le_bytes(take(8).try_into().unwrap());
    let world = POINTS.iter().map(|_| DVec3::new(f64s(), f64s(), f64s())).collect();
    let voxels = dims.iter().product::<usize>();
    let values = take(4 * voxels).chunks_exact(4).map(|v| u32::from_le_bytes(v.try_into().unwrap())).collect();
    let active = take(voxels).iter().map(|&a| a == 1).collect();
    Expectation { origin, dims, active_voxels, world, values, active }
}

/// The first difference between a grid of ours and the expectation, if there is one.
fn difference(grid: &DensityGrid, expected: &Expectation) -> Option<String> {
    if (grid.origin, grid.dims) != (expected.origin, expected.dims) {
        let (o, d) = (expected.origin, expected.dims);
        return Some(format!("box {:?} {:?}, expected {o:?} {d:?}", grid.origin, grid.dims));
    }
    if grid.active.count() as u64 != expected.active_voxels {
        return Some(format!("{} active voxels, expected {}", grid.active.count(), expected.active_voxels));
    }
    for v in 0..grid.len() {
        if grid.values[v].to_bits() != expected.values[v] || grid.active.get(v) != expected.active[v] {
            let (value, active) = (f32::from_bits(expected.values[v]), expected.active[v]);
            return Some(format!("voxel {v}: {} {}, expected {value} {active}", grid.values[v], grid.active.get(v)));
        }
    }
    for (point, expected) in POINTS.iter().zip(&expected.world) {
        let at = grid.world_from_index.transform_point3(DVec3::from(*point));
        // Three products and three sums in either program, in any order: at most 6 roundings of the terms together.
        let terms = (0..3).map(|a| (grid.world_from_index.matrix3.col(a) * point[a]).abs()).sum::<DVec3>();
        let tolerance = 6.0 * f64::EPSILON * (terms + grid.world_from_index.translation.abs());
        if !(at - *expected).abs().cmple(tolerance).all() {
            return Some(format!("{point:?} lies at {at}, expected {expected}"));
        }
    }
    None
}

fn compare(grids: &[(PathBuf, String)]) {
    let folder = tempfile::tempdir().unwrap();
    for ((path, name), expected) in grids.iter().zip(expectations(grids, folder.path())) {
        let grid = vdb::read(path, name).unwrap();
        assert_eq!(&grid.name, name);
        if let Some(difference) = difference(&grid, &expected) {
            panic!("{} {name}: {difference}", path.display());
        }
    }
}

fn shared_data() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let folder = std::env::var_os("SMOKE_BAKE_DATA").map_or_else(default, PathBuf::from);
    assert!(folder.is_dir(), "{}: no data; set SMOKE_BAKE_DATA", folder.display());
    folder
}

#[test]
fn every_shape_of_file_that_openvdb_writes_reads_back_voxel_for_voxel() {
    let folder = tempfile::tempdir().unwrap();
    let listing = script("openvdb_files.py", &[folder.path().to_str().unwrap()]);
    let grids = listing.lines().map(|line| line.split_once('\t').unwrap());
    let grids: Vec<_> = grids.map(|(file, name)| (folder.path().join(file), name.to_owned())).collect();
    assert!(grids.len() > 40, "{listing}");
    compare(&grids);

    // Grids of one name are told apart by number; the plain name is the first.
    let same = folder.path().join("same_name.vdb");
    let read = |name: &str| vdb::read(&same, name).unwrap();
    assert!(read("density") == read("density[0]"));
    assert!(read("density").values != read("density[1]").values);

    // A grid of another type is refused by name, and a missing one by listing those that are there.
    let several = folder.path().join("several.vdb");
    let message = vdb::read(&several, "velocity").unwrap_err().to_string();
    assert!(message.contains("grid 'velocity'") && message.contains("Tree_vec3s_5_4_3"), "{message}");
    let message = vdb::read(&several, "smoke").unwrap_err().to_string();
    assert!(message.contains("flags (bool), heat (float), velocity (vec3s), density (float)"), "{message}");
    let types: Vec<_> = vdb::list(&several).unwrap().into_iter().map(|g| (g.value_type, g.half)).collect();
    let expected = [("bool", false), ("float", false), ("vec3s", false), ("float", true)];
    assert_eq!(types, expected.map(|(t, h)| (t.to_owned(), h)));
}

#[test]
fn the_comparison_sees_a_changed_value_state_box_or_map() {
    let folder = tempfile::tempdir().unwrap();
    script("openvdb_files.py", &[folder.path().to_str().unwrap(), "map_rotated"]);
    let path = folder.path().join("map_rotated.vdb");
    let expected = expectations(&[(path.clone(), "density".to_owned())], folder.path()).remove(0);
    let good = vdb::read(&path, "density").unwrap();
    assert_eq!(difference(&good, &expected), None);
    let defects: [fn(&mut DensityGrid); 5] = [
        |g| g.values[17] = f32::from_bits(g.values[17].to_bits() ^ 1),
        |g| g.origin[2] += 1,
        |g| g.world_from_index.translation.x += 1e-11,
        |g| g.world_from_index.matrix3.x_axis.y *= 1.0 + 1e-14,
        |g| {
            // One active voxel and one inactive voxel change places: the count stays.
            let (on, off) = (g.active.iter_set().next().unwrap(), (0..g.len()).find(|&v| !g.active.get(v)).unwrap());
            let mut mask = VoxelMask::new(g.len());
            g.active.iter_set().filter(|&v| v != on).for_each(|v| mask.set(v));
            mask.set(off);
            g.active = mask;
        },
    ];
    for (i, defect) in defects.iter().enumerate() {
        let mut bad = good.clone();
        defect(&mut bad);
        assert!(difference(&bad, &expected).is_some(), "defect {i} passed");
    }
}

/// A grid with active and inactive voxels of many values, and room to spare in its box.
fn speckle(origin: [i32; 3], dims: [usize; 3], world_from_index: DAffine3) -> DensityGrid {
    let voxels = dims.iter().product();
    let mut active = VoxelMask::new(voxels);
    let mut values = vec![0.0; voxels];
    let mut state = 12345u32;
    for (v, value) in values.iter_mut().enumerate() {
        state = state.wrapping_mul(1664525).wrapping_add(1013904223);
        match state >> 28 {
            0..8 => active.set(v),
            8 => *value = [0.25, -0.5, 1.75][v / 97 % 3],
            _ => continue,
        }
        // Multiples of 2^-8 below 8: exact in half floats, so that one expectation serves both.
        if active.get(v) {
            *value = (state >> 17 & 0x7ff) as f32 / 256.0;
        }
    }
    DensityGrid { name: "density".into(), origin, dims, values, active, world_from_index }
}

#[test]
fn openvdb_reads_what_we_write() {
    let rotated = DAffine3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.4) * DAffine3::from_scale(DVec3::splat(0.3));
    let translation = DVec3::new(1e4, -2.5, 0.125);
    let maps = [
        DAffine3::from_scale(DVec3::splat(0.1)),
        DAffine3 { matrix3: DMat3::from_diagonal(DVec3::splat(0.1)), translation },
        DAffine3::from_scale(DVec3::new(0.1, 0.2, -0.3)),
        DAffine3 { matrix3: DMat3::from_diagonal(DVec3::new(0.1, 0.2, 0.3)), translation },
        DAffine3 { matrix3: rotated.matrix3, translation },
        DAffine3::from_translation(translation),
    ];
    let mut grids: Vec<DensityGrid> = maps.iter().map(|&map| speckle([-13, 4090, 5], [33, 21, 19], map)).collect();
    grids.push(speckle([0; 3], [0; 3], maps[0]));
    grids.push(speckle([-4097, 127, -1], [1, 1, 1], maps[0]));
    grids[7].active.set(0);
    let folder = tempfile::tempdir().unwrap();
    let (mut files, mut written) = (Vec::new(), Vec::new());
    for (i, grid) in grids.iter().enumerate() {
        let options = [(false, false), (false, true), (true, false), (true, true)];
        // Every option with the rotated and the empty grid, one with each other.
        for &(half, zip) in if [4, 6].contains(&i) { &options[..] } else { &options[i % 4..][..1] } {
            let path = folder.path().join(format!("{i}_{half}_{zip}.vdb"));
            vdb::write(&path, grid, &vdb::WriteOptions { half, zip }).unwrap();
            files.push((path, grid.name.clone()));
            written.push(grid);
        }
    }
    // OpenVDB and we read the same voxels, and those are the voxels that were written.
    compare(&files);
    for ((path, name), grid) in files.iter().zip(written) {
        let back = vdb::read(path, name).unwrap();
        assert_eq!(back.active.count(), grid.active.count());
        assert_eq!(back.world_from_index, grid.world_from_index);
        for v in 0..grid.len() {
            let found = back.voxel(grid.index(v).map(|i| i as i32));
            let (value, active) = found.map_or((0.0, false), |f| (back.values[f], back.active.get(f)));
            assert_eq!((value, active), (grid.values[v], grid.active.get(v)), "{} voxel {v}", path.display());
        }
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn every_real_file_reads_as_openvdb_reads_it() {
    let data = shared_data();
    let file = |name: &str| data.join(name);
    let mut grids = vec![(file("grids/dragon_affine.vdb"), "density".to_owned())];
    for name in ["density", "flame", "shadow", "temperature"] {
        grids.push((file("grids/blender_five_grids.vdb"), name.to_owned()));
    }
    grids.extend((1001..=1064).map(|n| (file(&format!("plume/plume.{n}.vdb")), "density".to_owned())));
    compare(&grids);
    let message = vdb::read(&grids[1].0, "velocity").unwrap_err().to_string();
    assert!(message.contains("grid 'velocity'") && message.contains("Tree_vec3s_5_4_3"), "{message}");
}

#[test]
#[ignore = "needs ../shared/data"]
fn the_pbrt_smoke_reads_as_another_reader_reads_it() {
    let folder = tempfile::tempdir().unwrap();
    let (path, out) = (shared_data().join("grids/pbrt_smoke_100x100x40.pbrt"), folder.path().join("expected"));
    script("pbrt_expectation.py", &[path.to_str().unwrap(), out.to_str().unwrap()]);
    let expected = parse(&std::fs::read(out).unwrap());
    let grid = smoke_formats::volume::read(&path, "density").unwrap();
    assert_eq!(grid.dims, [100, 100, 40]);
    assert_eq!(difference(&grid, &expected), None);
}
