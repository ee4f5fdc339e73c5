//! Damaged packs: every flip is noticed, every defect is named, nothing panics.

use super::container::{ALIGNMENT, HEADER_BYTES, Header, KIND_FRAMES, KIND_GAUSSIANS, KIND_RANK, KIND_SEQUENCE};
use super::format_tests::{Sample, every_way, pack_bytes, sample, some_gaussians};
use super::records::SectionRecord;
use super::*;
use crate::residual::tests::{Pcg, ball};
use std::path::Path;
use xxhash_rust::xxh3::xxh3_64;

fn path() -> &'static Path {
    Path::new("p")
}

pub(super) fn findings(bytes: &[u8]) -> Vec<Finding> {
    validate_bytes(path(), bytes.to_vec())
}

/// Reads all there is: the pack is refused, or every frame gives an error or an answer.
pub(super) fn read_all(bytes: &[u8]) {
    if let Ok(pack) = Pack::from_bytes(path(), bytes.to_vec()) {
        for frame in 0..pack.frames().len() {
            drop(pack.gaussians(frame));
            drop(pack.residual(frame).and_then(|r| r.codes()));
            drop(pack.transfer_rows(frame));
        }
    }
}

pub(super) fn sections(bytes: &[u8]) -> Vec<SectionRecord> {
    Pack::from_bytes(path(), bytes.to_vec()).unwrap().sections().to_vec()
}

/// Makes all checksums right again after the bytes were changed: damage becomes malice.
pub(super) fn reseal(bytes: &mut [u8], sections: &[SectionRecord]) {
    let toc_at = u64::from_le_bytes(bytes[24..32].try_into().unwrap()) as usize;
    for (i, s) in sections.iter().enumerate() {
        let checksum = xxh3_64(&bytes[s.offset as usize..(s.offset + s.bytes_at_rest) as usize]);
        bytes[toc_at + 8 + 48 * i + 40..][..8].copy_from_slice(&checksum.to_le_bytes());
    }
    reseal_toc(bytes, toc_at);
}

fn reseal_toc(bytes: &mut [u8], toc_at: usize) {
    let checksum = xxh3_64(&bytes[toc_at..]);
    bytes[40..48].copy_from_slice(&checksum.to_le_bytes());
    reseal_header(bytes);
}

fn reseal_header(bytes: &mut [u8]) {
    let checksum = xxh3_64(&bytes[..248]);
    bytes[248..256].copy_from_slice(&checksum.to_le_bytes());
}

#[test]
fn every_single_bit_of_a_pack_is_vouched_for() {
    // One frame in ranks, one in a hash: small, because each of its bits is flipped.
    let mut sample = sample();
    sample.frames.truncate(2);
    let good = pack_bytes(&sample, AtRest::SMALLEST);
    assert_eq!(findings(&good), []);
    let mut bytes = good.clone();
    for bit in 0..8 * bytes.len() {
        bytes[bit / 8] ^= 1 << (bit % 8);
        assert!(!findings(&bytes).is_empty(), "bit {bit} of {}", 8 * good.len());
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
}

#[test]
fn every_prefix_and_an_extra_byte_are_refused() {
    let good = pack_bytes(&sample(), AtRest::RAW);
    for length in 0..good.len() {
        assert!(Pack::from_bytes(path(), good[..length].to_vec()).is_err(), "{length}");
    }
    assert!(Pack::from_bytes(path(), [&good[..], &[0]].concat()).is_err());
}

#[test]
fn the_first_thing_wrong_is_named_in_the_order_of_the_file() {
    let good = pack_bytes(&sample(), AtRest::RAW);
    let all = sections(&good);
    let toc_at = u64::from_le_bytes(good[24..32].try_into().unwrap()) as usize;
    let gaussians = all.iter().find(|s| s.kind == KIND_GAUSSIANS && s.first_frame == 2).unwrap();
    let rank = all.iter().find(|s| s.kind == KIND_RANK && s.first_frame == 1).unwrap();
    let frames = all.iter().find(|s| s.kind == KIND_FRAMES).unwrap();
    let sequence = all.iter().position(|s| s.kind == KIND_SEQUENCE).unwrap();
    let (sequence_at, frames_at) = (all[sequence].offset as usize, frames.offset as usize + 8);
    let padding = (all[0].offset + all[0].bytes_at_rest) as usize;
    assert!(!padding.is_multiple_of(ALIGNMENT as usize));
    type Spoil<'a> = Box<dyn Fn(&mut Vec<u8>) + 'a>;
    let put = |at: usize, value: Vec<u8>| -> Spoil {
        Box::new(move |b: &mut Vec<u8>| b[at..at + value.len()].copy_from_slice(&value))
    };
    let sealed = |at: usize, value: Vec<u8>| -> Spoil {
        let (all, put) = (all.clone(), put(at, value));
        Box::new(move |b: &mut Vec<u8>| {
            put(b);
            reseal(b, &all);
        })
    };
    let toc = |at: usize, value: Vec<u8>| -> Spoil {
        let put = put(toc_at + at, value);
        Box::new(move |b: &mut Vec<u8>| {
            put(b);
            reseal_toc(b, toc_at);
        })
    };
    let f32b = |v: f32| v.to_le_bytes().to_vec();
    let f64b = |v: f64| v.to_le_bytes().to_vec();
    // In the order in which they are found: each defect is planted on top of all those after it.
    let defects: Vec<(&str, Spoil)> = vec![
        ("header.magic", put(0, vec![0])),
        ("header.version", put(8, vec![2])),
        ("header.file_bytes", put(16, vec![1])),
        ("header.checksum", put(60, vec![1])),
        ("toc.checksum", put(toc_at + 20, vec![9])),
        ("sections[1].kind", toc(8 + 48, vec![77])),
        ("sections[1].codec", toc(8 + 48 + 4, vec![3])),
        ("sections[1].offset", toc(8 + 48 + 16, vec![1])),
        ("sequence.promise", sealed(sequence_at + 128, f64b(f64::NAN))),
        ("frames[1].step", sealed(frames_at + 124 + 64, f32b(-1.0))),
        ("sections[1].padding", put(padding, vec![1])),
        ("frames[1].rank.checksum", put(rank.offset as usize + 70, vec![99])),
        ("frames[2].gaussians[1].radius", sealed(gaussians.offset as usize + 20 + 12, f32b(0.0))),
    ];
    for (i, (expected, _)) in defects.iter().enumerate() {
        let mut bytes = good.clone();
        // Last first: what reseals must not repair a checksum that is to be wrong.
        for (_, spoil) in defects[i..].iter().rev() {
            spoil(&mut bytes);
        }
        let first = findings(&bytes).into_iter().next().expect(expected);
        assert_eq!(first.place, *expected, "{}", first.message);
        let mut bytes = good.clone();
        (defects[i].1)(&mut bytes);
        let alone = findings(&bytes);
        assert_eq!(alone[0].place, *expected, "{}", alone[0].message);
    }
}

#[test]
fn a_layout_that_its_codes_do_not_give_is_found() {
    // A wider width than needed would decode alike: only the bytes tell.
    let good = pack_bytes(&sample(), AtRest::RAW);
    let all = sections(&good);
    let rank = all.iter().find(|s| s.kind == KIND_RANK).unwrap();
    let mut found = 0;
    for at in 64..rank.bytes_at_rest as usize {
        let mut bytes = good.clone();
        bytes[rank.offset as usize + at] ^= 1;
        reseal(&mut bytes, &all);
        // A flipped value bit is another good frame; all else is not.
        found += usize::from(!findings(&bytes).is_empty());
    }
    assert!(found > 20, "{found}");
}

#[test]
fn malicious_packs_with_good_checksums_never_panic() {
    let mut random = Pcg(11);
    for at_rest in every_way() {
        let good = pack_bytes(&sample(), at_rest);
        let all = sections(&good);
        for _ in 0..400 {
            let mut bytes = good.clone();
            let s = all[random.below(all.len() as u32) as usize];
            if s.bytes_at_rest == 0 {
                continue;
            }
            let at = s.offset as usize + random.below(s.bytes_at_rest.min(200) as u32) as usize;
            bytes[at] = [0, 1, 127, 128, 255, random.next() as u8][random.below(6) as usize];
            reseal(&mut bytes, &all);
            read_all(&bytes);
            findings(&bytes);
        }
    }
}

#[test]
fn hostile_counts_in_the_table_of_contents_and_header_are_refused() {
    let good = pack_bytes(&sample(), AtRest::SMALLEST);
    let toc_at = u64::from_le_bytes(good[24..32].try_into().unwrap()) as usize;
    for at in (toc_at..good.len() - 8).step_by(4) {
        for value in [0u32, 1, 1 << 20, 1 << 31, u32::MAX] {
            let mut bytes = good.clone();
            bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            reseal_toc(&mut bytes, toc_at);
            assert!(bytes == good || !findings(&bytes).is_empty(), "{at} {value}");
        }
    }
    for at in (12..248).step_by(4) {
        for value in [1u32, 1 << 20, 1 << 31, u32::MAX] {
            let mut bytes = good.clone();
            bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            reseal_header(&mut bytes);
            assert!(
                bytes == good
                    || Header::decode(path(), &bytes[..HEADER_BYTES as usize], good.len() as u64).is_err()
                    || Pack::from_bytes(path(), bytes).is_err(),
                "{at} {value}"
            );
        }
    }
}

#[test]
fn hostile_lengths_in_records_are_refused() {
    // A string of 2^60 bytes in the settings, a list of 2^60 frames.
    let good = pack_bytes(&sample(), AtRest::RAW);
    let all = sections(&good);
    for s in all.iter().filter(|s| s.kind < KIND_GAUSSIANS) {
        for at in 0..s.bytes_at_rest as usize - 7 {
            for value in [u64::MAX, 1 << 60, 1 << 25, 1 << 31] {
                let mut bytes = good.clone();
                bytes[s.offset as usize + at..][..8].copy_from_slice(&value.to_le_bytes());
                reseal(&mut bytes, &all);
                drop(Pack::from_bytes(path(), bytes));
            }
        }
    }
}

#[test]
fn a_pack_of_real_size_survives_truncation_and_two_thousand_flips() {
    let mut sample = sample();
    let frame = (sample.frames[0].0, some_gaussians(600, 1), ball([64, 70, 80], 90, 1));
    sample.sequence.dims = [100; 3];
    let tile = (sample.frames[1].0, some_gaussians(600, 2), ball([24, 24, 24], 90, 2));
    let sample = Sample { frames: vec![frame, tile], ..sample };
    for at_rest in [AtRest::SMALLEST, AtRest::RAW] {
        let good = pack_bytes(&sample, at_rest);
        assert!(good.len() > 100_000, "{}", good.len());
        for length in (0..good.len()).step_by(997) {
            assert!(Pack::from_bytes(path(), good[..length].to_vec()).is_err());
        }
        let mut random = Pcg(5);
        let (mut right, mut refused) = (0, 0);
        for _ in 0..2000 {
            let bit = random.below(8 * good.len() as u32) as usize;
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            let Ok(pack) = Pack::from_bytes(path(), bytes) else {
                refused += 1;
                continue;
            };
            // The section with the flip, and only that one, must refuse; elsewhere the answer must be right.
            for (i, (_, gaussians, codes)) in sample.frames.iter().enumerate() {
                match pack.gaussians(i) {
                    Ok(found) => assert_eq!(&found, gaussians),
                    Err(_) => refused += 1,
                }
                let hit = pack.sections().iter().any(|s| {
                    let inside = (s.offset..s.offset + s.bytes_at_rest).contains(&(bit as u64 / 8));
                    inside && s.kind > KIND_GAUSSIANS && s.first_frame as usize == i
                });
                // Decoding 150 000 voxels 4000 times says nothing new: the untouched ones are read now and then.
                if hit || right < 20 {
                    match pack.residual(i).and_then(|r| r.codes()) {
                        Ok(found) => {
                            assert!(!hit && &found == codes);
                            right += 1;
                        }
                        Err(_) => {
                            assert!(hit);
                            refused += 1;
                        }
                    }
                }
            }
        }
        assert!(right >= 20 && refused > 1500, "{right} {refused}");
    }
}

#[test]
fn a_box_that_no_memory_holds_is_refused_before_anything_is_made_of_its_size() {
    let dims = [1 << 30; 3];
    let sequence = SequenceRecord { dims, ..SequenceRecord::default() };
    let frame = FrameRecord { dims, step: 0.1, ..FrameRecord::default() };
    let message = frame.check(path(), 3, &sequence).unwrap_err().to_string();
    assert!(message.contains("frames[3].dims") && message.contains("at most 268435456 voxels"), "{message}");
    assert!(FrameRecord { dims: [1 << 10, 1 << 10, 1 << 8], ..frame }.check(path(), 3, &sequence).is_ok());
}
