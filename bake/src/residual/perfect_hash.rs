//! Looks for a perfect spatial hash of the codes of a tile that are not zero.
//!
//! `slot = (p mod m + step * offsets[p mod r]) mod m` per axis (see [`smoke_formats::residual::hash`]). Keys with the
//! same `p mod r` form a bucket that moves as one. Buckets are placed from the largest to the smallest: first at the
//! offsets of their neighbours, then at random ones; a bucket of one key takes the next free slot. If a bucket finds no
//! place the tables grow and all starts again.
//!
//! Source: Lefebvre and Hoppe 2006, section 4; Zhou et al. 2008, section 5.1 (m = cbrt(K), r = cbrt(K / 3) + 9).
//! Deviations, each because the published sizes fail without it:
//! - m and r share no divisor: two keys that agree mod both can never be told apart. The published sizes give
//!   m = r = 28 for 20 000 keys, and with them thousands of such pairs;
//! - r with which the frames of a tile, one spacing apart, fall into the same buckets are skipped;
//! - growth is bounded: r by a tenth up to eight times, then m by one up to four times, then there is no
//!   hash and the caller keeps the rank layout. Each attempt has a bounded number of tries. It always ends.
//!
//! Cost: about K log K; 0.2 microseconds a key for a tile of 6.9 million that succeeds at once. Deterministic: own generator (PCG,
//! O'Neill 2014), seeded by the caller.

use smoke_formats::residual::ResidualCodes;
use smoke_formats::residual::hash::{HashTable, MAX_SIDE, for_each_key, offset_step, spacing};

/// How often r grows.
const GROWTHS: u32 = 8;
/// How often m grows after that.
const WIDENINGS: u32 = 4;
/// Random offsets that one bucket tries.
const TRIES_OF_A_BUCKET: usize = 1 << 14;
/// Keys of the largest bucket that is tried at all: what remains of a bucket's freedom falls exponentially with it.
const LARGEST_BUCKET: usize = 256;
/// Free slots that a bucket of one key looks at; more than one matters only for m > 256, where offsets skip slots.
const FREE_SLOTS: usize = 4096;

/// A perfect hash of the codes that are not zero, or none if the bounded search found none. No codes need no table.
pub fn find(frames: &[ResidualCodes], seed: u64) -> Option<HashTable> {
    let mut keys = vec![];
    for_each_key(frames, |p, _| keys.push(p));
    if keys.is_empty() {
        return Some(HashTable::default());
    }
    let stacks = stacking(frames);
    let mut random = Pcg::new(seed);
    let mut side = cube_root_up(keys.len() as u64);
    let mut offset_side = cube_root_up((keys.len() as u64).div_ceil(3)) + 9;
    for attempt in 0..=GROWTHS + WIDENINGS {
        if attempt > GROWTHS {
            side += 1;
        } else if attempt > 0 {
            offset_side += offset_side.div_ceil(10);
        }
        // A step that divides the side would leave each key a fraction of the slots.
        while gcd(side, offset_step(side)) > 1 {
            side += 1;
        }
        offset_side = usable(side, offset_side, &stacks);
        if side > MAX_SIDE || offset_side > MAX_SIDE {
            return None;
        }
        if let Some(offsets) = place(&keys, side, offset_side, &mut random) {
            return Some(HashTable { side, offset_side, offsets });
        }
    }
    None
}

/// The smallest n with n^3 >= v.
fn cube_root_up(v: u64) -> u32 {
    (1u32..).find(|&n| u64::from(n).pow(3) >= v).unwrap_or(u32::MAX)
}

/// Distances between frames of the tile, per axis, that a bucket side must not nearly divide.
fn stacking(frames: &[ResidualCodes]) -> Vec<u32> {
    let spacing = spacing(frames.iter().map(|f| f.dims));
    let across = [frames.len(), frames.len().div_ceil(3), frames.len().div_ceil(9)].map(|n| n.min(3) as u32);
    (0..3).flat_map(|a| (1..across[a]).map(move |n| n * spacing[a])).collect()
}

/// The first side from `offset_side` on that shares no divisor with `side` and does not stack frames; failing that,
/// among the next 64, one that shares no divisor.
fn usable(side: u32, offset_side: u32, stacks: &[u32]) -> u32 {
    let coprime = |r: u32| gcd(side, r) == 1;
    let apart = |r: u32| stacks.iter().all(|d| (d % r).min(r - d % r) > 2);
    let mut candidates = (offset_side..offset_side + 64).filter(|&r| coprime(r));
    let first = candidates.clone().next().unwrap_or(offset_side);
    candidates.find(|&r| apart(r)).unwrap_or(first)
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// The slots taken so far.
struct Slots {
    side: u32,
    taken: Vec<u64>,
}

impl Slots {
    /// The slot of packed position `h0` moved by `shift` (already times the step, mod m).
    #[inline]
    fn at(&self, h0: u32, shift: [u32; 3]) -> usize {
        let wrapped = |axis: usize| {
            let sum = (h0 >> (10 * axis) & 1023) + shift[axis];
            (if sum >= self.side { sum - self.side } else { sum }) as usize
        };
        let m = self.side as usize;
        wrapped(0) + m * (wrapped(1) + m * wrapped(2))
    }

    #[inline]
    fn is_free(&self, slot: usize) -> bool {
        self.taken[slot / 64] >> (slot % 64) & 1 == 0
    }

    /// Takes the slots of all of `bucket` if they are free.
    #[inline]
    fn take(&mut self, bucket: &[u32], shift: [u32; 3]) -> bool {
        if !bucket.iter().all(|&h0| self.is_free(self.at(h0, shift))) {
            return false;
        }
        for &h0 in bucket {
            let slot = self.at(h0, shift);
            self.taken[slot / 64] |= 1 << (slot % 64);
        }
        true
    }
}

/// The offsets with which every key has its own slot.
fn place(keys: &[[u32; 3]], side: u32, offset_side: u32, random: &mut Pcg) -> Option<Vec<u8>> {
    let (m, r, step) = (side, offset_side as usize, offset_step(side));
    let bucket_of = |p: &[u32; 3]| {
        let h1 = p.map(|p| (p % offset_side) as usize);
        h1[0] + r * (h1[1] + r * h1[2])
    };
    let mut starts = vec![0u32; r * r * r + 1];
    keys.iter().for_each(|p| starts[bucket_of(p) + 1] += 1);
    let largest = starts.iter().copied().max().unwrap_or(0) as usize;
    if largest > LARGEST_BUCKET {
        return None;
    }
    let mut by_size = vec![vec![]; largest + 1];
    for (bucket, &size) in starts[1..].iter().enumerate().filter(|(_, s)| **s > 0) {
        by_size[size as usize].push(bucket as u32);
    }
    (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
    let mut next = starts.clone();
    let mut items = vec![0u32; keys.len()];
    for p in keys {
        let at = &mut next[bucket_of(p)];
        items[*at as usize] = (p[0] % m) | ((p[1] % m) << 10) | ((p[2] % m) << 20);
        *at += 1;
    }
    let mut slots = Slots { side, taken: vec![0; (m as usize).pow(3).div_ceil(64)] };
    let mut offsets = vec![0u8; 3 * r * r * r];
    let mut placed = vec![false; r * r * r];
    let mut tries_left = 64 * keys.len() + (1 << 20);
    let shift_of = |offset: [u8; 3]| offset.map(|o| step * u32::from(o) % m);
    for bucket in by_size[2..].iter().rev().flatten().map(|&b| b as usize) {
        let members = &mut items[starts[bucket] as usize..starts[bucket + 1] as usize];
        members.sort_unstable();
        if members.windows(2).any(|pair| pair[0] == pair[1]) {
            return None;
        }
        let mut found = None;
        let at = [bucket % r, bucket / r % r, bucket / r / r];
        for (axis, way) in [(0, 1), (0, r - 1), (1, 1), (1, r - 1), (2, 1), (2, r - 1)] {
            let mut near = at;
            near[axis] = (near[axis] + way) % r;
            let near = near[0] + r * (near[1] + r * near[2]);
            if placed[near] {
                let offset = [offsets[3 * near], offsets[3 * near + 1], offsets[3 * near + 2]];
                if slots.take(members, shift_of(offset)) {
                    found = Some(offset);
                    break;
                }
            }
        }
        let mut tries = TRIES_OF_A_BUCKET.min(tries_left);
        while found.is_none() && tries > 0 {
            tries -= 1;
            tries_left -= 1;
            let offset = [0; 3].map(|_: u8| random.below(m.min(256)) as u8);
            found = slots.take(members, shift_of(offset)).then_some(offset);
        }
        offsets[3 * bucket..3 * bucket + 3].copy_from_slice(&found?);
        placed[bucket] = true;
    }
    let mut free: Vec<u32> = (0..m.pow(3)).filter(|&s| slots.is_free(s as usize)).collect();
    for (used, &bucket) in by_size.get(1).into_iter().flatten().enumerate() {
        let h0 = items[starts[bucket as usize] as usize];
        let reached = (used..free.len().min(used + FREE_SLOTS)).find_map(|i| {
            let slot = [free[i] % m, free[i] / m % m, free[i] / m / m];
            let o = [0, 1, 2].map(|a| reach(h0 >> (10 * a) & 1023, slot[a], m, step));
            Some((i, [o[0]?, o[1]?, o[2]?]))
        });
        let (i, offset) = reached?;
        free.swap(i, used);
        offsets[3 * bucket as usize..3 * bucket as usize + 3].copy_from_slice(&offset);
    }
    Some(offsets)
}

/// The offset that takes `from` to `to` mod m, if one of eight bits does.
fn reach(from: u32, to: u32, m: u32, step: u32) -> Option<u8> {
    let distance = (to + m - from) % m;
    (0..step).map(|turn| distance + turn * m).find(|d| d % step == 0).and_then(|d| u8::try_from(d / step).ok())
}

/// PCG-XSH-RR 64/32 (O'Neill 2014).
struct Pcg(u64);

impl Pcg {
    fn new(seed: u64) -> Self {
        let mut pcg = Self(seed.wrapping_add(1442695040888963407));
        pcg.next();
        pcg
    }

    fn next(&mut self) -> u32 {
        let state = self.0;
        self.0 = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        ((((state >> 18) ^ state) >> 27) as u32).rotate_right((state >> 59) as u32)
    }

    /// Below `n`, even to n / 2^32.
    fn below(&mut self, n: u32) -> u32 {
        ((u64::from(self.next()) * u64::from(n)) >> 32) as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::residual::tests::frame;
    use smoke_formats::residual::hash::{HashView, assemble, slot_of};
    use std::path::Path;

    /// Finds a hash, assembles it (which fails on any clash) and reads all codes back.
    fn check(frames: &[ResidualCodes]) -> HashTable {
        let table = find(frames, 7).expect("a hash");
        assert_eq!(find(frames, 7).as_ref(), Some(&table), "the same seed gives the same hash");
        let view = HashView::new(Path::new("p"), assemble(Path::new("p"), frames, &table).unwrap()).unwrap();
        for (i, f) in frames.iter().enumerate() {
            assert_eq!(&view.codes(i).unwrap(), f);
        }
        table
    }

    fn ball(n: u32, shift: u32) -> ResidualCodes {
        frame([n, n, n], |x, y, z| {
            let c = |v: u32| f64::from(v + shift % 3) - f64::from(n) / 2.0;
            let q = c(x) * c(x) + c(y) * c(y) + c(z) * c(z);
            (q < f64::from(n * n) / 4.0).then(|| ((x * 7 + y * 13 + z * 29 + shift) % 100) as i32 - 50)
        })
    }

    #[test]
    fn a_tile_of_drifting_frames_has_a_hash() {
        check(&(0..27).map(|i| ball(24, i)).collect::<Vec<_>>());
    }

    #[test]
    fn no_codes_need_no_table() {
        assert_eq!(check(&[frame([4, 4, 4], |_, _, _| Some(0))]), HashTable::default());
        assert_eq!(check(&[frame([0, 0, 0], |_, _, _| None)]), HashTable::default());
    }

    #[test]
    fn a_single_voxel_has_a_table_of_one_slot() {
        assert_eq!(check(&[frame([100, 1, 1], |x, _, _| (x == 99).then_some(5))]).side, 1);
    }

    #[test]
    fn voxels_with_even_coordinates_only_have_a_hash() {
        let even = frame([40, 40, 40], |x, y, z| (x % 2 + y % 2 + z % 2 == 0).then_some(3));
        check(&[even]);
    }

    #[test]
    fn a_thin_slab_has_a_hash() {
        let slab = frame([128, 128, 1], |x, y, _| ((x * x + y) % 3 > 0).then_some(1));
        check(&[slab]);
    }

    #[test]
    fn twenty_thousand_voxels_whose_published_sides_are_both_28_have_a_hash() {
        let frames = [frame([50, 40, 10], |x, y, z| Some(((x + y + z) % 9) as i32 + 1))];
        assert_eq!(cube_root_up(20_000), 28);
        assert_eq!(cube_root_up(20_000u64.div_ceil(3)) + 9, 28);
        let table = check(&frames);
        assert_eq!(gcd(table.side, table.offset_side), 1);
        // And the published sides do fail, so the rule is needed.
        let mut keys = vec![];
        for_each_key(
            &[frame([200, 200, 200], |x, y, z| ((x * 31 + y * 17 + z * 7) % 400 == 0).then_some(1))],
            |p, _| {
                keys.push(p);
            },
        );
        assert_eq!(keys.len(), 20_000);
        assert!(place(&keys, 28, 28, &mut Pcg::new(1)).is_none());
    }

    #[test]
    fn a_line_of_voxels_ends_without_a_hash() {
        // All keys lie in one row of buckets and agree mod m and r from m * r < 4096 on: no sides of the schedule help.
        assert_eq!(find(&[frame([4096, 1, 1], |_, _, _| Some(1))], 1), None);
    }

    #[test]
    fn twenty_seven_identical_copies_have_a_hash() {
        check(&vec![ball(20, 0); 27]);
    }

    #[test]
    fn a_side_that_stacks_the_frames_is_skipped() {
        let stacks = stacking(&vec![ball(16, 0); 27]);
        assert_eq!(stacks, [16, 32, 16, 32, 16, 32]);
        for r in 10..100 {
            let used = usable(9, r, &stacks);
            assert!(used >= r && !used.is_multiple_of(3) && !(14..=18).contains(&used), "{r} {used}");
        }
    }

    #[test]
    fn keys_have_their_own_slots_in_a_table_too_wide_for_eight_bits() {
        let mut keys = vec![];
        for_each_key(&[frame([300, 300, 2], |x, y, _| ((x * 31 + y * 17) % 9 == 0).then_some(1))], |p, _| keys.push(p));
        let (side, offset_side) = (257, 24);
        let offsets = place(&keys, side, offset_side, &mut Pcg::new(1)).unwrap();
        let mut slots: Vec<usize> = keys.iter().map(|&p| slot_of(side, offset_side, &offsets, p)).collect();
        slots.sort_unstable();
        assert!(slots.len() == 20_000 && slots.windows(2).all(|pair| pair[0] < pair[1]));
    }

    #[test]
    fn eight_bits_reach_256_slots_along_an_axis_of_a_wide_table() {
        for (m, step) in [(255, 1), (256, 1), (301, 2), (514, 3)] {
            let mut reached = 0;
            for to in 0..m {
                if let Some(o) = reach(5, to, m, step) {
                    assert_eq!((5 + step * u32::from(o)) % m, to);
                    reached += 1;
                }
            }
            assert_eq!(reached, m.min(256), "{m}");
        }
    }
}
