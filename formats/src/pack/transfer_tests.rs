//! Transfer in a pack: `FORMAT.md` against the code, the golden pack, round trips, and damage.

use super::container::{KIND_TRANSFER, KIND_TRANSFER_BASES, KIND_TRANSFER_ROWS};
use super::damage_tests::{findings, read_all, reseal, sections};
use super::format_tests::{
    Sample, assert_holds, assert_table, f32s, f64s, pack_bytes, pack_bytes_with, sample, u32s, u64s,
};
use super::transfer_layout::tests::some_transfer;
use super::transfer_layout::{BASES_BYTES, HEADER_BYTES, ROWS_BYTES, encode_bases, encode_rows};
use super::transfer_record::tests::some_record;
use super::*;
use crate::Error;
use crate::residual::tests::Pcg;
use crate::transfer::{TransferBases, TransferRows};
use std::io::Cursor;
use std::path::{Path, PathBuf};

type Writer<'a> = PackWriter<&'a mut Cursor<Vec<u8>>>;

fn path() -> &'static Path {
    Path::new("p")
}

/// Bases and rows of a frame of the record; bases are the same all over a run.
fn transfer_of(frame: &TransferFrameRecord) -> (TransferBases, TransferRows) {
    let of = |seed: u32| some_transfer(frame.voxels as usize, frame.cells as usize, u64::from(seed));
    (of(frame.first_of_run).0, of(frame.frame).1)
}

fn push(writer: &mut Writer, record: &TransferRecord, codec: Codec) {
    for run in record.frames.chunk_by(|a, b| a.first_of_run == b.first_of_run) {
        let (first, last) = (run[0].frame as usize, run[run.len() - 1].frame as usize);
        writer.push_transfer_bases(first, last - first + 1, &transfer_of(&run[0]).0, codec).unwrap();
        for frame in run {
            writer.push_transfer_rows(frame.frame as usize, &transfer_of(frame).1, codec).unwrap();
        }
    }
}

fn with_transfer(sample: &Sample, at_rest: AtRest, record: &TransferRecord, codec: Codec) -> Vec<u8> {
    pack_bytes_with(sample, at_rest, |writer| {
        push(writer, record, codec);
        Some(record.clone())
    })
}

/// Two frames and their transfer: small, for the tests that try every bit or byte.
fn small() -> (Sample, TransferRecord) {
    let (mut sample, mut record) = (sample(), some_record());
    sample.frames.truncate(2);
    record.frames.truncate(1);
    record.frames.push(TransferFrameRecord { frame: 1, voxels: 5, ..record.frames[0] });
    record.frames[0].voxels = 4;
    (sample, record)
}

fn assert_transfer_holds(pack: &Pack, record: &TransferRecord) {
    let mut said = pack.transfer().unwrap().clone();
    said.frames.iter_mut().for_each(|f| (f.bytes_at_rest, f.bytes_resident) = (0, 0));
    assert_eq!(&said, record);
    for frame in record.frames.iter().rev() {
        let (bases, rows) = transfer_of(frame);
        assert_eq!(pack.transfer_rows(frame.frame as usize).unwrap(), rows);
        assert_eq!(*pack.transfer_bases(frame.frame as usize).unwrap(), bases);
    }
}

#[test]
fn transfer_comes_back_from_every_codec_beside_frames_as_they_were() {
    let (sample, record) = (sample(), some_record());
    for codec in [Codec::Raw, Codec::Deflate] {
        let bytes = with_transfer(&sample, AtRest::SMALLEST, &record, codec);
        assert_eq!(findings(&bytes), []);
        let pack = Pack::from_bytes(path(), bytes).unwrap();
        assert_holds(&pack, &sample);
        assert_transfer_holds(&pack, &record);
        let data = || pack.sections().iter().filter(|s| s.kind > KIND_TRANSFER);
        let sum =
            |field: fn(&TransferFrameRecord) -> u64| pack.transfer().unwrap().frames.iter().map(field).sum::<u64>();
        assert_eq!(sum(|f| f.bytes_at_rest), data().map(|s| s.bytes_at_rest).sum::<u64>());
        assert_eq!(sum(|f| f.bytes_resident), data().map(|s| s.bytes_resident).sum::<u64>());
        let spans: Vec<(u32, u32)> =
            data().filter(|s| s.kind == KIND_TRANSFER_BASES).map(|s| (s.first_frame, s.frames)).collect();
        assert_eq!(spans, [(0, 3), (3, 3)]);
    }
}

#[test]
fn transfer_encoded_before_gives_the_same_pack() {
    let (sample, record) = (sample(), some_record());
    for codec in [Codec::Raw, Codec::Deflate] {
        let bytes = pack_bytes_with(&sample, AtRest::RAW, |writer| {
            for frame in &record.frames {
                let (bases, rows) = transfer_of(frame);
                let brings = (frame.frame == frame.first_of_run).then_some(&bases);
                let encoded = EncodedTransfer::new(path(), frame, &rows, brings, codec).unwrap();
                let encoded = EncodedTransfer::from_bytes(path(), &encoded.to_bytes(path()).unwrap()).unwrap();
                writer.push_encoded_transfer(3, &encoded).unwrap();
            }
            Some(record.clone())
        });
        assert!(bytes == with_transfer(&sample, AtRest::RAW, &record, codec));
    }
}

#[test]
fn a_record_without_frames_and_a_pack_without_transfer_are_good() {
    let record = TransferRecord { frames: vec![], ..some_record() };
    let bytes = with_transfer(&sample(), AtRest::RAW, &record, Codec::Raw);
    assert_eq!(findings(&bytes), []);
    let pack = Pack::from_bytes(path(), bytes).unwrap();
    assert_eq!(pack.transfer(), Some(&record));
    let message = pack.transfer_rows(0).unwrap_err().to_string();
    assert_eq!(message, "p: transfer.frames: found no transfer of frame 0, expected one that has it: none");
    let pack = Pack::from_bytes(path(), pack_bytes(&sample(), AtRest::RAW)).unwrap();
    assert_eq!(pack.transfer(), None);
    let message = pack.transfer_bases(0).unwrap_err().to_string();
    assert_eq!(message, "p: transfer: found no transfer of frame 0, expected a pack that was baked with transfer");
}

#[test]
fn a_frame_without_transfer_names_those_that_have_it() {
    let pack = Pack::from_bytes(path(), with_transfer(&sample(), AtRest::RAW, &some_record(), Codec::Raw)).unwrap();
    for frame in [1, 4, 6, usize::MAX] {
        let expected =
            format!("p: transfer.frames: found no transfer of frame {frame}, expected one that has it: 0, 2-3, 5");
        assert_eq!(pack.transfer_rows(frame).unwrap_err().to_string(), expected);
        assert_eq!(pack.transfer_bases(frame).unwrap_err().to_string(), expected);
    }
}

fn golden_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/golden_1_transfer.smoke")
}

#[test]
fn the_golden_pack_with_transfer_is_read_and_written_to_the_byte() {
    let (sample, record) = small();
    let golden = std::fs::read(golden_path()).unwrap();
    assert_transfer_holds(&Pack::from_bytes(&golden_path(), golden.clone()).unwrap(), &record);
    let bytes = with_transfer(&sample, AtRest::RAW, &record, Codec::Raw);
    assert!(bytes == golden, "the bytes of version 1 have changed");
}

/// As `write_the_golden_pack`.
#[test]
#[ignore = "writes testdata/golden_1_transfer.smoke if SMOKE_BAKE_WRITE_GOLDEN is set"]
fn write_the_golden_pack_with_transfer() {
    if std::env::var_os("SMOKE_BAKE_WRITE_GOLDEN").is_some() {
        let (sample, record) = small();
        std::fs::write(golden_path(), with_transfer(&sample, AtRest::RAW, &record, Codec::Raw)).unwrap();
        panic!("written; now run the tests");
    }
}

#[test]
fn transfer_lies_where_the_page_says() {
    let frame = TransferFrameRecord {
        frame: 1,
        first_of_run: 2,
        voxels: 3,
        cells: 4,
        direct_error: 5.0,
        indirect_error: 6.0,
        truncated: 7.0,
        raw_bytes: 8,
        bytes_at_rest: 9,
        bytes_resident: 10,
    };
    let record = TransferRecord {
        sigma_t: [1.0, 2.0, 3.0],
        albedo: [4.0, 5.0, 6.0],
        g: 7.0,
        bands: 8,
        cell_shift: 9,
        photons: 10,
        seed: 11,
        direct_of_channel: [12, 13, 14],
        indirect_of_channel: [15, 16, 17],
        basis: "sh6".into(),
        frames: vec![frame; 2],
    };
    let bytes = records::encode(path(), "transfer", &record).unwrap();
    let fields = [
        ("sigma_t", f32s(&[1.0, 2.0, 3.0])),
        ("albedo", f32s(&[4.0, 5.0, 6.0])),
        ("g", f32s(&[7.0])),
        ("bands", u32s(&[8])),
        ("cell_shift", u32s(&[9])),
        ("photons", u32s(&[10])),
        ("seed", u64s(&[11])),
        ("direct_of_channel", u32s(&[12, 13, 14])),
        ("indirect_of_channel", u32s(&[15, 16, 17])),
        ("basis", [u64s(&[3]), b"sh6".to_vec()].concat()),
    ];
    let end = assert_table("Transfer record", &bytes, &fields);
    assert_eq!(bytes[end..end + 8], u64s(&[2]));
    let fields = [
        ("frame", u32s(&[1])),
        ("first_of_run", u32s(&[2])),
        ("voxels", u64s(&[3])),
        ("cells", u64s(&[4])),
        ("direct_error", f64s(&[5.0])),
        ("indirect_error", f64s(&[6.0])),
        ("truncated", f64s(&[7.0])),
        ("raw_bytes", u64s(&[8])),
        ("bytes_at_rest", u64s(&[9])),
        ("bytes_resident", u64s(&[10])),
    ];
    assert_eq!(assert_table("Transfer frame record", &bytes[end + 8..], &fields), (bytes.len() - end - 8) / 2);

    let (bases, rows) = some_transfer(7, 3, 1);
    let halves = |values: &[half::f16]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let bytes = encode_bases(&bases);
    let counts = [("direct", u32s(&[1])), ("indirect", u32s(&[2]))];
    assert_eq!(assert_table("Transfer sets", &bytes, &counts), HEADER_BYTES);
    let set = &bases.direct[0];
    let fields = [
        ("length", u32s(&[set.length])),
        ("clusters", u32s(&[set.clusters])),
        ("terms", u32s(&[set.terms])),
        ("scale", f32s(&[set.scale])),
        ("values", halves(&set.values)),
    ];
    let end = assert_table("Set of bases", &bytes[HEADER_BYTES..], &fields);
    assert_eq!(end, BASES_BYTES + 2 * 3 * (1 + 2) * 3);
    // 27 values leave two bytes; then the next set.
    assert_eq!(bytes[HEADER_BYTES + end..][..6], [&[0, 0][..], &5u32.to_le_bytes()].concat());

    let bytes = encode_rows(&rows);
    assert_eq!(assert_table("Transfer sets", &bytes, &counts), HEADER_BYTES);
    let set = &rows.direct[0];
    let fields = [("rows", u32s(&[7])), ("terms", u32s(&[2])), ("weights", halves(&set.weights))];
    let end = assert_table("Set of rows", &bytes[HEADER_BYTES..], &fields);
    assert_eq!(end, ROWS_BYTES + 2 * 7 * 2);
    // Seven ids leave a byte; then the next set.
    assert_eq!(bytes[HEADER_BYTES + end..][..12], [&set.ids[..], &[0], &3u32.to_le_bytes()].concat());
}

#[test]
fn every_single_bit_of_transfer_is_vouched_for() {
    let (sample, record) = small();
    let mut bytes = with_transfer(&sample, AtRest::SMALLEST, &record, Codec::Deflate);
    // All from the first section of transfer on: the records and the table of contents too.
    let start = sections(&bytes).iter().find(|s| s.kind == KIND_TRANSFER_BASES).unwrap().offset as usize;
    for bit in 8 * start..8 * bytes.len() {
        bytes[bit / 8] ^= 1 << (bit % 8);
        assert!(!findings(&bytes).is_empty(), "bit {bit}");
        bytes[bit / 8] ^= 1 << (bit % 8);
    }
}

#[test]
fn every_prefix_of_a_pack_with_transfer_and_an_extra_byte_are_refused() {
    let (sample, record) = small();
    for codec in [Codec::Raw, Codec::Deflate] {
        let good = with_transfer(&sample, AtRest::RAW, &record, codec);
        for length in 0..good.len() {
            assert!(Pack::from_bytes(path(), good[..length].to_vec()).is_err(), "{length}");
        }
        assert!(Pack::from_bytes(path(), [&good[..], &[0]].concat()).is_err());
    }
}

#[test]
fn malicious_transfer_with_good_checksums_never_panics_and_is_never_out_of_range() {
    let (sample, record) = small();
    let mut random = Pcg(3);
    for codec in [Codec::Raw, Codec::Deflate] {
        let good = with_transfer(&sample, AtRest::SMALLEST, &record, codec);
        let all = sections(&good);
        for s in all.iter().filter(|s| s.kind >= KIND_TRANSFER) {
            for at in 0..s.bytes_at_rest as usize {
                for value in [0, 1, 127, 128, 255, random.next() as u8] {
                    let mut bytes = good.clone();
                    bytes[s.offset as usize + at] = value;
                    reseal(&mut bytes, &all);
                    read_all(&bytes);
                    let Ok(pack) = Pack::from_bytes(path(), bytes) else { continue };
                    for frame in 0..2 {
                        let Ok(rows) = pack.transfer_rows(frame) else { continue };
                        let bases = pack.transfer_bases(frame).unwrap();
                        for (rows, bases) in rows.direct.iter().zip(&bases.direct) {
                            assert!(rows.ids.iter().all(|&id| u32::from(id) < bases.clusters));
                            assert!(rows.terms() as u32 == bases.terms && bases.values.iter().all(|v| v.is_finite()));
                        }
                    }
                }
            }
        }
    }
}

#[test]
fn hostile_lengths_in_the_record_of_transfer_are_refused() {
    let (sample, record) = small();
    let good = with_transfer(&sample, AtRest::RAW, &record, Codec::Raw);
    let all = sections(&good);
    let s = all.iter().find(|s| s.kind == KIND_TRANSFER).unwrap();
    let basis = s.offset as usize + 72;
    for (at, least) in [(basis, 17), (basis + 8 + 6, 3)] {
        for value in [least, 1 << 25, 1 << 31, 1 << 60, u64::MAX] {
            let mut bytes = good.clone();
            bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            reseal(&mut bytes, &all);
            assert!(Pack::from_bytes(path(), bytes).is_err(), "{at} {value}");
        }
    }
}

#[test]
fn every_defect_of_transfer_is_named() {
    let (sample, record) = small();
    let good = with_transfer(&sample, AtRest::RAW, &record, Codec::Raw);
    let all = sections(&good);
    let at = |kind: u32, frame: u32| all.iter().position(|s| s.kind == kind && s.first_frame == frame).unwrap();
    let (said, bases, rows) = (at(KIND_TRANSFER, 0), at(KIND_TRANSFER_BASES, 0), at(KIND_TRANSFER_ROWS, 1));
    let byte = |section: usize, offset: usize| all[section].offset as usize + offset;
    let toc_at = u64::from_le_bytes(good[24..32].try_into().unwrap()) as usize;
    let toc = |section: usize, offset: usize| toc_at + 8 + 48 * section + offset;
    // The list of frames is after a basis of six letters and a count; ids after five rows of two weights.
    let list = byte(said, 72 + 8 + 6 + 8);
    let infinite = half::f16::INFINITY.to_le_bytes();
    let defects: [(&str, usize, Vec<u8>); 19] = [
        ("transfer.g", byte(said, 24), f32s(&[1.0])),
        ("transfer.basis", byte(said, 80), b"D".to_vec()),
        ("transfer.frames[1].frame", list + 72, u32s(&[2])),
        ("transfer.frames[0].voxels", list + 8, u64s(&[1000])),
        ("transfer.frames[1].bytes_at_rest", list + 72 + 56, u64s(&[1])),
        ("transfer.frames[0].bytes_resident", list + 64, u64s(&[1])),
        ("transfer.frames[0].bases", list + 72 + 4, u32s(&[1])),
        ("transfer.frames[0].bases.indirect", byte(said, 60), u32s(&[0, 0, 0])),
        ("transfer.frames[1].rows.direct[0].rows", list + 72 + 8, u64s(&[6])),
        ("transfer.frames[0].bases.direct[0].values[1]", byte(bases, 8 + 16 + 2), infinite.to_vec()),
        ("transfer.frames[0].bases.direct[0].scale", byte(bases, 8 + 12), f32s(&[f32::NAN])),
        ("transfer.frames[1].rows.direct[0].weights[1]", byte(rows, 8 + 8 + 2), infinite.to_vec()),
        ("transfer.frames[1].rows.direct[0].ids", byte(rows, 8 + 8 + 20), vec![3]),
        ("transfer.frames[1].rows.direct[0]", byte(rows, 8 + 8 + 25), vec![1]),
        ("sections: transfer", toc(rows, 0), u32s(&[KIND_TRANSFER])),
        ("transfer", toc(said, 8), u32s(&[1])),
        ("transfer.frames[0].bases", toc(bases, 12), u32s(&[1])),
        ("transfer.frames[1].rows", toc(rows, 8), u32s(&[7])),
        ("sections[5].first_frame", toc(bases, 0), u32s(&[KIND_TRANSFER_ROWS])),
    ];
    for (named, at, value) in defects {
        let mut bytes = good.clone();
        bytes[at..at + value.len()].copy_from_slice(&value);
        reseal(&mut bytes, &all);
        let first = findings(&bytes).into_iter().next().expect(named);
        assert_eq!(first.place, named, "{}", first.message);
    }
    // Damage alone, without its checksum made right.
    let mut bytes = good.clone();
    bytes[byte(rows, 20)] ^= 1;
    assert_eq!(findings(&bytes)[0].place, "transfer.frames[1].rows.checksum");
}

#[test]
fn a_writer_refuses_transfer_that_does_not_fit_its_record() {
    let (sample, record) = (sample(), some_record());
    let refused = |record: Option<&TransferRecord>, fill: &dyn Fn(&mut Writer)| -> String {
        let mut bytes = Cursor::new(vec![]);
        let mut writer = PackWriter::new(path(), &mut bytes).unwrap();
        for (record, gaussians, codes) in &sample.frames {
            writer.push_rank(&FrameData { record: *record, gaussians, codes }, AtRest::RAW).unwrap();
        }
        fill(&mut writer);
        let error = writer.finish(&sample.sequence, &sample.settings, record).unwrap_err();
        assert!(matches!(error, Error::Invalid { .. }));
        error.to_string().lines().collect::<Vec<_>>().join("NEW LINE")
    };
    let all = |writer: &mut Writer| push(writer, &record, Codec::Raw);
    let rows = |frame: usize| transfer_of(&record.frames[frame]).1;
    let message = refused(None, &all);
    assert_eq!(message, "p: sections[12]: found bases of frame 0, expected a section that the transfer record names");
    let message = refused(Some(&record), &|_| {});
    assert_eq!(message, "p: transfer.frames[0].bases: found no section, expected one from frame 0");
    let message = refused(Some(&record), &|writer| {
        all(writer);
        writer.push_transfer_rows(5, &rows(3), Codec::Deflate).unwrap();
    });
    assert_eq!(message, "p: sections[18].first_frame: found more rows of frame 5, expected one section");
    let message = refused(Some(&record), &|writer| {
        all(writer);
        writer.push_transfer_rows(4, &rows(3), Codec::Deflate).unwrap();
    });
    assert_eq!(message, "p: sections[18]: found rows of frame 4, expected a section that the transfer record names");
    let with = |spoil: fn(&mut TransferRecord)| {
        let mut record = record.clone();
        spoil(&mut record);
        record
    };
    let message = refused(Some(&with(|r| r.frames[3].voxels += 1)), &all);
    let expected = "p: transfer.frames[3].rows.direct[0].rows: found 25, expected 26, a row for each of the voxels";
    assert_eq!(message, expected);
    let message = refused(Some(&with(|r| r.indirect_of_channel = [0, 0, 0])), &all);
    let expected = "p: transfer.frames[0].rows.indirect: found 2 sets, expected 1, as the colour channels use";
    assert_eq!(message, expected);
    let message = refused(Some(&with(|r| r.frames[3].first_of_run = 5)), &all);
    assert_eq!(message, "p: transfer.frames[2].bases: found a section of 3 frames, expected 1");
    assert!(refused(Some(&with(|r| r.g = f32::NAN)), &all).starts_with("p: transfer.g: found NaN"));

    let mut bytes = Cursor::new(vec![]);
    let mut writer = PackWriter::new(path(), &mut bytes).unwrap();
    let bases = transfer_of(&record.frames[0]).0;
    for (first, frames) in [(0, 0), (usize::MAX, 1), (1 << 32, 1), (1, usize::MAX)] {
        assert!(writer.push_transfer_bases(first, frames, &bases, Codec::Raw).is_err(), "{first} {frames}");
    }
    let message = writer.push_transfer_rows(0, &rows(0), Codec::Coded).unwrap_err().to_string();
    assert_eq!(message, "p: transfer.rows.codec: found Coded, expected Raw, Deflate");
}
