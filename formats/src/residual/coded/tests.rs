//! The codec kit: round trips at the extremes, golden bytes, damage of every kind.

use super::*;
use proptest::prelude::*;

/// A frame from a rule for each voxel (x, y, z): no code or a code.
fn frame(dims: [u32; 3], rule: impl Fn(i64, i64, i64) -> Option<i32>) -> ResidualCodes {
    let [nx, ny, nz] = dims.map(i64::from);
    let mut support = VoxelMask::new((nx * ny * nz) as usize);
    let mut codes = Vec::new();
    for v in 0..nx * ny * nz {
        if let Some(code) = rule(v % nx, v / nx % ny, v / (nx * ny)) {
            support.set(v as usize);
            codes.push(code);
        }
    }
    ResidualCodes { origin: [-3, 7, 1 << 20], dims, support, codes }
}

/// A fixed pseudo-random number for each voxel (the finaliser of SplitMix64).
fn noise(x: i64, y: i64, z: i64) -> i64 {
    let mut h = (x + 1000 * y + 1_000_000 * z) as u64;
    h = (h ^ h >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    h = (h ^ h >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    (h ^ h >> 31) as i64
}

/// A ball of smooth codes with a little noise: what a residual looks like, in small.
fn ball(side: u32) -> ResidualCodes {
    let r = i64::from(side) / 2;
    frame([side; 3], |x, y, z| {
        let d = (x - r).pow(2) + (y - r).pow(2) + (z - r).pow(2);
        (d < r * r).then(|| ((x * x + 3 * y * z) / 20 - d / 3 + noise(x, y, z).rem_euclid(5)) as i32)
    })
}

fn decoded(bytes: &[u8]) -> Result<ResidualCodes> {
    decode(Path::new("frame.residual"), bytes)
}

fn returns(residual: &ResidualCodes) -> usize {
    let bytes = encode(residual);
    assert_eq!(&decoded(&bytes).unwrap(), residual);
    bytes.len()
}

#[test]
fn a_frame_without_voxels_takes_a_header_and_a_checksum() {
    assert_eq!(returns(&frame([0; 3], |_, _, _| None)), 30 + 8);
    assert_eq!(returns(&frame([5, 0, 9], |_, _, _| None)), 30 + 8);
    assert_eq!(returns(&frame([5, 4, 9], |_, _, _| None)), 30 + 8);
}

#[test]
fn a_single_voxel_returns_whatever_its_code() {
    for code in [0, 1, -1, 1 << 23, -(1 << 23), i32::MAX, i32::MIN] {
        returns(&frame([1; 3], |_, _, _| Some(code)));
        returns(&frame([7, 9, 8], |x, y, z| (x == 3 && y == 8 && z == 2).then_some(code)));
    }
}

#[test]
fn equal_codes_take_the_least_that_the_format_allows_and_are_not_refused() {
    for code in [0, -77] {
        let residual = frame([64; 3], |_, _, _| Some(code));
        let bytes = returns(&residual);
        // Two decisions at 64 / 65536 from certainty are 0.0028 bit; learning that costs a few hundred bytes.
        assert!(bytes < residual.codes.len() / 2848 + 2500, "{bytes} bytes");
    }
}

#[test]
fn random_codes_cost_little_more_than_their_information() {
    let bytes = returns(&frame([32; 3], |x, y, z| Some(noise(x, y, z) as i32 & 0xff)));
    assert!(bytes * 8 < 32 * 32 * 32 * 84 / 10, "{bytes} bytes for 8 bits a voxel");
}

#[test]
fn extreme_codes_in_every_pattern_return() {
    returns(&frame([17, 9, 12], |x, y, z| Some(if (x + y + z) % 2 == 0 { i32::MAX } else { i32::MIN })));
    returns(&frame([17, 9, 12], |x, y, z| Some(noise(x, y, z) as i32)));
    returns(&frame([17, 9, 12], |x, y, z| Some((noise(x, y, z) as i32) >> 8)));
    returns(&frame([17, 9, 12], |x, y, z| Some(if noise(x, y, z) % 50 == 0 { i32::MIN } else { 0 })));
    returns(&frame([40, 30, 2], |x, _, _| Some((x * 50_000_000 - 1_000_000_000) as i32)));
}

#[test]
fn supports_of_every_shape_return() {
    let code = |x: i64, y: i64, z: i64| (x + 2 * y - z) as i32;
    returns(&frame([20, 21, 22], |x, y, z| ((x + y + z) % 2 == 0).then(|| code(x, y, z))));
    returns(&frame([20, 21, 22], |x, y, z| (noise(x, y, z) % 3 == 0).then(|| code(x, y, z))));
    for dims in [[500, 1, 1], [1, 500, 1], [1, 1, 500], [60, 50, 1], [60, 1, 50], [1, 60, 50], [2, 3, 4]] {
        returns(&frame(dims, |x, y, z| Some(code(x, y, z))));
        returns(&frame(dims, |x, y, z| (noise(x, y, z) % 2 == 0).then(|| code(x, y, z))));
    }
}

#[test]
fn a_smooth_ball_takes_less_than_half_of_its_plain_size() {
    let residual = ball(24);
    let bytes = returns(&residual);
    assert!(bytes < residual.codes.len() / 2, "{bytes} bytes for {} codes", residual.codes.len());
}

#[test]
fn the_bytes_never_change_without_a_new_version() {
    let bytes = encode(&ball(24));
    let sum = xxhash_rust::xxh3::xxh3_64(&bytes);
    assert_eq!((bytes.len(), sum), (2944, 0x1ac64ec15d964550), "({}, 0x{sum:016x})", bytes.len());
}

/// The ball, moved by a voxel and with other noise: a frame before it.
fn earlier_ball(side: u32) -> ResidualCodes {
    let mut earlier = ball(side);
    earlier.origin[0] += 1;
    earlier.codes.iter_mut().enumerate().for_each(|(i, c)| *c += i32::from(i % 11 == 0));
    earlier
}

#[test]
fn a_frame_after_another_returns_in_fewer_bytes() {
    let (frame, earlier) = (ball(24), earlier_ball(24));
    let bytes = encode_after(&frame, &earlier);
    assert_eq!(decode_after(Path::new("frame.residual"), &bytes, &earlier).unwrap(), frame);
    let alone = encode(&frame).len();
    assert!(bytes.len() < alone, "{} bytes after a frame, {alone} alone", bytes.len());
    let sum = xxhash_rust::xxh3::xxh3_64(&bytes);
    assert_eq!((bytes.len(), sum), (856, 0x2e55330cc45c899e), "({}, 0x{sum:016x})", bytes.len());
}

#[test]
fn a_frame_returns_after_frames_that_share_nothing_with_it() {
    let frame = ball(9);
    let mut far = ball(5);
    far.origin = [i32::MIN, 0, i32::MAX - 4];
    for earlier in
        [super::tests::frame([0; 3], |_, _, _| None), far, super::tests::frame([3; 3], |_, _, _| Some(i32::MIN))]
    {
        let bytes = encode_after(&frame, &earlier);
        assert_eq!(decode_after(Path::new("frame.residual"), &bytes, &earlier).unwrap(), frame);
    }
}

#[test]
fn the_wrong_earlier_frame_or_none_is_refused_by_name() {
    let (frame, earlier) = (ball(8), earlier_ball(8));
    let path = Path::new("frame.residual");
    let bytes = encode_after(&frame, &earlier);
    assert!(decode(path, &bytes).unwrap_err().to_string().contains("residual kind"));
    assert!(decode_after(path, &encode(&frame), &earlier).unwrap_err().to_string().contains("residual kind"));
    assert!(decode_after(path, &bytes, &frame).unwrap_err().to_string().contains("earlier frame"));
    for length in 0..bytes.len() {
        assert!(decode_after(path, &bytes[..length], &earlier).is_err(), "prefix of {length} bytes");
    }
}

#[test]
fn the_bytes_do_not_depend_on_the_width_of_the_vectors() {
    let (frame, earlier) = (ball(16), earlier_ball(16));
    let sweep = Sweep::new(frame.dims);
    for previous in [None, Some(&earlier)] {
        let earlier = || previous.map(|p| Earlier::new(p, frame.origin, &sweep));
        let (mut plain, mut wide) = (Encoder::new(Vec::new()), Encoder::new(Vec::new()));
        // Called here, the model is compiled for the oldest processors; `encode_codes` picks the newest.
        code_codes(&mut plain, &sweep, &frame.support, earlier(), &mut frame.codes.clone());
        encode_codes(&mut wide, &sweep, &frame.support, earlier(), &mut frame.codes.clone());
        assert_eq!(plain.finish(), wide.finish());
    }
}

#[test]
fn every_prefix_and_an_extra_byte_are_refused() {
    let mut bytes = encode(&ball(8));
    for length in 0..bytes.len() {
        assert!(decoded(&bytes[..length]).is_err(), "prefix of {length} bytes");
    }
    bytes.push(0);
    assert!(decoded(&bytes).is_err());
}

#[test]
fn every_flipped_bit_is_refused() {
    let bytes = encode(&ball(8));
    for bit in 0..bytes.len() * 8 {
        let mut damaged = bytes.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        assert!(decoded(&damaged).is_err(), "bit {bit}");
    }
}

/// A header with nothing right behind it.
fn header(dims: [u32; 3], count: u32, stream: usize) -> Vec<u8> {
    let mut bytes = vec![VERSION, 0];
    bytes.extend([0; 12]);
    dims.iter().for_each(|d| bytes.extend(d.to_le_bytes()));
    bytes.extend(count.to_le_bytes());
    bytes.extend(vec![0; stream + 8]);
    bytes
}

#[test]
fn boxes_and_counts_that_the_bytes_cannot_hold_are_refused_by_name() {
    let message = |bytes: Vec<u8>| decoded(&bytes).unwrap_err().to_string();
    assert!(message(header([u32::MAX; 3], 0, 0)).contains("residual box"));
    assert!(message(header([1 << 10, 1 << 10, 1 << 9], 0, 0)).contains("residual box"));
    assert!(message(header([100; 3], 100_001, 20)).contains("residual code count"));
    assert!(message(header([10; 3], 1001, 1000)).contains("residual code count"));
    assert!(message(header([100; 3], 50_000, 20)).contains("residual"));
    let mut far = header([1; 3], 0, 0);
    far[2..6].copy_from_slice(&i32::MAX.to_le_bytes());
    assert!(message(far.clone()).contains("checksum"), "the last index of i32 is legal");
    far[14] = 2;
    assert!(message(far).contains("residual box"));
    assert!(message(vec![2; 60]).contains("residual version"));
}

#[test]
fn a_wrong_checksum_alone_is_reported_as_such() {
    let mut bytes = encode(&ball(8));
    *bytes.last_mut().unwrap() ^= 1;
    assert!(decoded(&bytes).unwrap_err().to_string().contains("residual checksum"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn any_bytes_behind_a_legal_header_end_in_an_error(
        dims in prop::array::uniform3(1u32..40), share in 0.0f64..1.0, stream in prop::collection::vec(any::<u8>(), 4..300),
    ) {
        let voxels: u32 = dims.iter().product();
        let mut bytes = header(dims, (f64::from(voxels) * share) as u32, 0);
        bytes.truncate(30);
        bytes.extend(stream);
        bytes.extend([0; 8]);
        prop_assert!(decoded(&bytes).is_err());
    }

    #[test]
    fn any_frame_returns(dims in prop::array::uniform3(1u32..12), shift in 0u32..32, density in 1i64..6, seed in any::<u32>()) {
        returns(&frame(dims, |x, y, z| {
            let n = noise(x + i64::from(seed), y, z);
            (n % density == 0).then_some((n >> 20) as i32 >> shift)
        }));
    }
}
