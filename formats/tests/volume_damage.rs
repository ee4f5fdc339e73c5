//! Damaged volume files: an error or a well-formed grid, never a panic, a hang, or memory beyond the bound.
//!
//! The allocator of this program counts, so that the peak of each read is known. The bound: the dense box at its limit
//! (values and mask), a small multiple of the file, and some fixed room.
#![expect(unsafe_code, reason = "a global allocator that counts cannot be written without it")]

use glam::{DAffine3, DVec3};
use smoke_formats::bounded::MAX_DENSE_VOXELS;
use smoke_formats::volume::{DensityGrid, VoxelMask};
use smoke_formats::{Result, mitsuba_vol, pbrt, vdb};
use std::alloc::{GlobalAlloc, Layout, System};
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);
/// The counters belong to one read at a time.
static ONE_AT_A_TIME: Mutex<()> = Mutex::new(());

// SAFETY: every call goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(NOW.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        PEAK.fetch_max(NOW.fetch_add(layout.size(), Relaxed) + layout.size(), Relaxed);
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Relaxed);
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

type Reader = fn(&Path, &[u8]) -> Result<DensityGrid>;

fn read_vdb(path: &Path, bytes: &[u8]) -> Result<DensityGrid> {
    vdb::read_bytes(path, bytes, "density")
}

/// Bytes that a read may hold beside the dense box: leaves, masks, decoders and metadata.
fn allowance(file: usize) -> usize {
    4 * file + (4 << 20)
}

/// Reads damaged bytes; `case` names the damage.
fn survives(reader: Reader, bytes: &[u8], case: &str) -> bool {
    let start = Instant::now();
    let before = NOW.load(Relaxed);
    PEAK.store(before, Relaxed);
    let read = catch_unwind(|| reader(Path::new("damaged"), bytes)).unwrap_or_else(|_| panic!("{case}: panic"));
    let (peak, time) = (PEAK.load(Relaxed) - before, start.elapsed());
    let voxels = match &read {
        Ok(grid) => {
            let voxels = grid.dims.iter().product::<usize>();
            assert!(grid.values.len() == voxels && grid.active.len() == voxels, "{case}: {:?}", grid.dims);
            voxels
        }
        // An error may come after the box was made.
        Err(error) => {
            assert!(error.to_string().starts_with("damaged: "), "{case}: {error}");
            MAX_DENSE_VOXELS as usize
        }
    };
    let bound = voxels * 4 + voxels / 8 + allowance(bytes.len());
    assert!(peak <= bound, "{case}: {peak} bytes at the peak, at most {bound}");
    assert!(time < Duration::from_secs(3), "{case}: {time:?}");
    read.is_ok()
}

/// Truncations at every `step`th byte must fail; `flips` single bits must not crash. Gives how many flips were errors.
fn damage(reader: Reader, bytes: &[u8], step: usize, flips: usize, name: &str) -> usize {
    let _guard = ONE_AT_A_TIME.lock().unwrap_or_else(|e| e.into_inner());
    assert!(survives(reader, bytes, name), "{name} itself");
    for end in (0..bytes.len()).step_by(step) {
        assert!(!survives(reader, &bytes[..end], &format!("{name} cut at {end}")), "{name} cut at {end} passed");
    }
    let mut bytes = bytes.to_vec();
    let mut state = 1u64;
    let mut refused = 0;
    for _ in 0..flips {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        let bit = (state >> 16) as usize % (bytes.len() * 8);
        bytes[bit / 8] ^= 1 << (bit % 8);
        refused += usize::from(!survives(reader, &bytes, &format!("{name} bit {bit}")));
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
    refused
}

fn sample() -> DensityGrid {
    let dims = [21, 13, 17];
    let values: Vec<f32> = (0..21 * 13 * 17).map(|v| (v * 37 % 101) as f32 * 0.25).collect();
    let mut active = VoxelMask::new(values.len());
    (0..values.len()).filter(|v| v % 3 != 1).for_each(|v| active.set(v));
    let world_from_index = DAffine3::from_scale_rotation_translation(DVec3::ONE, Default::default(), DVec3::ONE);
    DensityGrid { name: "density".into(), origin: [-9, 4090, 0], dims, values, active, world_from_index }
}

#[test]
fn damaged_files_of_our_own_are_refused_or_read_in_bounds() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    for (half, zip) in [(false, false), (false, true), (true, false), (true, true)] {
        vdb::write(&path, &sample(), &vdb::WriteOptions { half, zip }).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let refused = damage(read_vdb, &bytes, 97, 1000, &format!("vdb half {half} zip {zip}"));
        // Damage in plain values cannot be seen; damage in masks and lengths must be, and zlib has a checksum.
        assert!(refused > if zip { 500 } else { 5 }, "{refused} of 1000 flips refused");
    }
    mitsuba_vol::write(&path, &sample()).unwrap();
    damage(mitsuba_vol::read_bytes, &std::fs::read(&path).unwrap(), 97, 1000, "vol");
    let text = "MakeNamedMedium \"a\" \"integer nx\" 3 \"point p1\" [ 1 1 1 ] \"float density\" [ 1 2.5 -3e-2 ]";
    damage(pbrt::read_bytes, text.as_bytes(), 1, 1000, "pbrt");
}

#[test]
fn the_harness_sees_memory_beyond_the_bound_and_a_panic() {
    let _guard = ONE_AT_A_TIME.lock().unwrap_or_else(|e| e.into_inner());
    let greedy: Reader = |path, bytes| {
        std::hint::black_box(vec![1u8; allowance(bytes.len()) + 1024]);
        pbrt::read_bytes(path, b"MakeNamedMedium \"a\" \"float density\" 1")
    };
    assert!(catch_unwind(|| survives(greedy, &[], "planted")).is_err());
    let panicking: Reader = |_, _| panic!("planted");
    assert!(catch_unwind(|| survives(panicking, &[], "planted")).is_err());
}

#[test]
#[ignore = "needs ../shared/data"]
fn damaged_real_files_are_refused_or_read_in_bounds() {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data");
    let data = std::env::var_os("SMOKE_BAKE_DATA").map_or_else(default, PathBuf::from);
    for (name, step, flips) in [
        ("plume/plume.1001.vdb", 997, 2000),
        ("plume/plume.1020.vdb", 9973, 300),
        ("grids/dragon_affine.vdb", 9973, 300),
        ("grids/blender_five_grids.vdb", 99_991, 300),
    ] {
        let bytes = std::fs::read(data.join(name)).unwrap();
        let refused = damage(read_vdb, &bytes, step, flips, name);
        println!("{name}: {refused} of {flips} flips refused");
    }
}
