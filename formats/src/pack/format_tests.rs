//! `FORMAT.md` against the code, the golden pack, and round trips.

use super::*;
use crate::gaussian::Gaussian;
use crate::residual::hash::tests::trivial;
use crate::residual::tests::{Pcg, ball, empty};
use crate::residual::{ResidualCodes, hash, rank};
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// A frame's worth of snapped Gaussians.
pub(super) fn some_gaussians(n: usize, seed: u64) -> Vec<Gaussian> {
    let mut random = Pcg(seed);
    let mut unit = || random.next() as f32 / u32::MAX as f32;
    let one = |_| Gaussian {
        center: [unit() * 1.2 - 0.1, unit(), unit()],
        radius: 0.015 + 0.075 * unit(),
        weight: 0.01 + unit(),
    };
    let list: Vec<Gaussian> = (0..n).map(one).collect();
    snap_gaussians(Path::new("p"), &list).unwrap()
}

pub(super) struct Sample {
    pub(super) sequence: SequenceRecord,
    pub(super) settings: SettingsRecord,
    pub(super) frames: Vec<(FrameRecord, Vec<Gaussian>, ResidualCodes)>,
}

/// Six frames, one of them empty: three for the rank layout, three for a tile.
pub(super) fn sample() -> Sample {
    let sequence = SequenceRecord {
        world_from_index: [0.1, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 0.1, -3.0, 4.0, 0.5],
        origin: [-8, 0, 0],
        dims: [40, 40, 40],
        density_max: 1.25,
        promise: Promise::MaxError(0.002),
        frames_per_second: Some(24.0),
        name: "plume".into(),
        grid: "density".into(),
    };
    let settings = SettingsRecord { json: r#"{"max_error":0.002}"#.into() };
    let frames = (0..6).map(|i| {
        let codes = if i == 4 { empty() } else { ball([9, 6 + i, 7], 30, u64::from(i)) };
        let record = FrameRecord {
            frame: 1000 + i as i32,
            fit_error: 0.01,
            max_error: 0.001,
            psnr_db: 55.0,
            step: 0.0039,
            source_hash: [i as u8; 16],
            ..FrameRecord::default()
        };
        (record, some_gaussians(if i == 4 { 0 } else { 3 }, u64::from(i)), codes)
    });
    Sample { sequence, settings, frames: frames.collect() }
}

pub(super) fn pack_bytes(sample: &Sample, at_rest: AtRest) -> Vec<u8> {
    pack_bytes_with(sample, at_rest, |_| None)
}

/// `more` pushes what the frames do not have.
pub(super) fn pack_bytes_with(
    sample: &Sample,
    at_rest: AtRest,
    more: impl FnOnce(&mut PackWriter<&mut Cursor<Vec<u8>>>) -> Option<TransferRecord>,
) -> Vec<u8> {
    let mut bytes = Cursor::new(vec![]);
    let mut writer = PackWriter::new(Path::new("p"), &mut bytes).unwrap();
    let data: Vec<FrameData> = sample
        .frames
        .iter()
        .map(|(record, gaussians, codes)| FrameData { record: *record, gaussians, codes })
        .collect();
    let (ranks, tile) = data.split_at(data.len() / 2);
    ranks.iter().for_each(|frame| writer.push_rank(frame, at_rest).unwrap());
    let codes: Vec<ResidualCodes> = tile.iter().map(|f| f.codes.clone()).collect();
    writer.push_tile(tile, &trivial(&codes), at_rest).unwrap();
    let transfer = more(&mut writer);
    let length = writer.finish(&sample.sequence, &sample.settings, transfer.as_ref()).unwrap();
    assert_eq!(length, bytes.get_ref().len() as u64);
    bytes.into_inner()
}

pub(super) fn every_way() -> impl Iterator<Item = AtRest> {
    let gaussians = [Codec::Raw, Codec::Deflate, Codec::Snapped];
    let residual = [Codec::Raw, Codec::Coded, Codec::Deflate];
    gaussians.into_iter().flat_map(move |g| residual.map(|r| AtRest { gaussians: g, residual: r }))
}

pub(super) fn assert_holds(pack: &Pack, sample: &Sample) {
    assert_eq!((pack.sequence(), pack.settings()), (&sample.sequence, &sample.settings));
    assert_eq!(pack.frames().len(), sample.frames.len());
    // Not in order: a frame does not need the ones before it.
    for i in [5, 0, 3, 4, 2, 1, 5] {
        let (record, gaussians, codes) = &sample.frames[i];
        assert_eq!(&pack.gaussians(i).unwrap(), gaussians);
        assert_eq!(&pack.residual(i).unwrap().codes().unwrap(), codes);
        assert_eq!((pack.frames()[i].frame, pack.frames()[i].source_hash), (record.frame, record.source_hash));
        assert_eq!(pack.frames()[i].dims, codes.dims);
    }
    assert!(pack.gaussians(6).is_err() && pack.residual(6).is_err());
}

#[test]
fn a_pack_comes_back_from_every_codec_and_is_valid() {
    let sample = sample();
    for at_rest in every_way() {
        let bytes = pack_bytes(&sample, at_rest);
        let pack = Pack::from_bytes(Path::new("p"), bytes.clone()).unwrap();
        assert_holds(&pack, &sample);
        assert_eq!(validate_bytes(Path::new("p"), bytes), [], "{at_rest:?}");
        let residual: Vec<Vec<u8>> = (0..6).map(|i| pack.residual(i).unwrap().residual.bytes().to_vec()).collect();
        assert_eq!(residual[1], rank::encode(&sample.frames[1].2), "{at_rest:?}");
        let total: u64 = pack.frames().iter().map(|f| f.bytes_at_rest).sum();
        let data = pack.sections().iter().filter(|s| s.kind >= container::KIND_GAUSSIANS);
        assert_eq!(total, data.map(|s| s.bytes_at_rest).sum::<u64>());
    }
}

#[test]
fn a_pack_on_disk_appears_whole_or_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.smoke");
    let sample = sample();
    let (record, gaussians, codes) = &sample.frames[0];
    let frame = FrameData { record: *record, gaussians, codes };
    let bad = FrameRecord { step: f32::NAN, ..*record };
    let broken = write(&path, |mut writer| {
        writer.push_rank(&FrameData { record: bad, ..frame.clone() }, AtRest::SMALLEST)?;
        writer.finish(&sample.sequence, &sample.settings, None)
    });
    let message = broken.unwrap_err().to_string();
    assert!(message.contains("frames[0].step: found NaN, expected above 0"), "{message}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    let bytes = write(&path, |mut writer| {
        writer.push_rank(&frame, AtRest::SMALLEST)?;
        writer.finish(&sample.sequence, &sample.settings, None)
    });
    let pack = Pack::open(&path).unwrap();
    assert_eq!((pack.file_bytes(), pack.frames().len()), (bytes.unwrap(), 1));
    assert_eq!(&pack.residual(0).unwrap().codes().unwrap(), codes);
    assert_eq!(validate(&path), []);
}

fn golden_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/golden_1.smoke")
}

#[test]
fn the_golden_pack_is_read_and_written_to_the_byte() {
    let golden = std::fs::read(golden_path()).unwrap();
    assert_holds(&Pack::from_bytes(&golden_path(), golden.clone()).unwrap(), &sample());
    // Raw: no byte depends on a compressor's version.
    assert!(pack_bytes(&sample(), AtRest::RAW) == golden, "the bytes of version 1 have changed");
}

/// Writes the golden pack after a deliberate change of the format's version, where `SMOKE_BAKE_WRITE_GOLDEN` is set; it
/// then fails, so that it never passes as a test.
#[test]
#[ignore = "writes testdata/golden_1.smoke if SMOKE_BAKE_WRITE_GOLDEN is set"]
fn write_the_golden_pack() {
    if std::env::var_os("SMOKE_BAKE_WRITE_GOLDEN").is_some() {
        std::fs::write(golden_path(), pack_bytes(&sample(), AtRest::RAW)).unwrap();
        panic!("written; now run the tests");
    }
}

/// The rows (offset, size, field) of the table under `### heading` of FORMAT.md, up to the first without numbers.
fn rows(heading: &str) -> Vec<(usize, Option<usize>, String)> {
    let page = include_str!("../../../FORMAT.md");
    let start = page.find(&format!("### {heading}\n")).unwrap_or_else(|| panic!("no heading {heading}"));
    let table = page[start..].lines().skip(1).skip_while(|l| !l.starts_with("|---")).skip(1);
    let cells = table.take_while(|l| l.starts_with('|')).map(|l| l.split('|').map(str::trim).collect::<Vec<_>>());
    cells.map_while(|c| Some((c[1].parse().ok()?, c[2].parse().ok(), c[3].to_owned()))).collect()
}

/// Every row must name the next field, lie right after the row before it, and hold the field's bytes.
pub(super) fn assert_table(heading: &str, bytes: &[u8], fields: &[(&str, Vec<u8>)]) -> usize {
    let rows = rows(heading);
    assert_eq!(rows.iter().map(|r| r.2.as_str()).collect::<Vec<_>>(), fields.iter().map(|f| f.0).collect::<Vec<_>>());
    let mut next = 0;
    for ((offset, size, name), (_, value)) in rows.iter().zip(fields) {
        assert_eq!(*offset, next, "{heading}: {name}");
        if let Some(size) = size {
            assert_eq!(value.len(), *size, "{heading}: {name}");
        }
        assert_eq!(&bytes[*offset..offset + value.len()], value, "{heading}: {name}");
        next = offset + value.len();
    }
    next
}

fn le<const N: usize, T: Copy>(values: &[T], bytes: impl Fn(T) -> [u8; N]) -> Vec<u8> {
    values.iter().flat_map(|&v| bytes(v)).collect()
}

pub(super) fn u32s(values: &[u32]) -> Vec<u8> {
    le(values, u32::to_le_bytes)
}

pub(super) fn u64s(values: &[u64]) -> Vec<u8> {
    le(values, u64::to_le_bytes)
}

fn i32s(values: &[i32]) -> Vec<u8> {
    le(values, i32::to_le_bytes)
}

pub(super) fn f32s(values: &[f32]) -> Vec<u8> {
    le(values, f32::to_le_bytes)
}

pub(super) fn f64s(values: &[f64]) -> Vec<u8> {
    le(values, f64::to_le_bytes)
}

#[test]
fn header_and_table_of_contents_lie_where_the_page_says() {
    let header = container::Header { file_bytes: 9, toc_offset: 8, toc_bytes: 7, toc_checksum: 6, sections: 5 };
    let bytes = header.encode();
    let fields = [
        ("magic", container::MAGIC.to_vec()),
        ("version", u32s(&[container::VERSION])),
        ("header_bytes", u32s(&[256])),
        ("file_bytes", u64s(&[9])),
        ("toc_offset", u64s(&[8])),
        ("toc_bytes", u64s(&[7])),
        ("toc_checksum", u64s(&[6])),
        ("sections", u32s(&[5])),
        ("reserved", vec![0; 196]),
        ("checksum", u64s(&[xxhash_rust::xxh3::xxh3_64(&bytes[..248])])),
    ];
    assert_eq!(assert_table("Header", &bytes, &fields), container::HEADER_BYTES as usize);
    let page = include_str!("../../../FORMAT.md");
    assert!(page.contains(&container::MAGIC.map(|b| format!("{b:02x}")).join(" ")));
    let section = records::SectionRecord {
        kind: 1,
        codec: 2,
        first_frame: 3,
        frames: 4,
        offset: 5,
        bytes_at_rest: 6,
        bytes_resident: 7,
        checksum: 8,
    };
    let bytes = records::encode(Path::new("p"), "toc", &vec![section; 2]).unwrap();
    assert_eq!(assert_table("Table of contents", &bytes, &[("count", u64s(&[2]))]), 8);
    let fields = [
        ("kind", u32s(&[1])),
        ("codec", u32s(&[2])),
        ("first_frame", u32s(&[3])),
        ("frames", u32s(&[4])),
        ("offset", u64s(&[5])),
        ("bytes_at_rest", u64s(&[6])),
        ("bytes_resident", u64s(&[7])),
        ("checksum", u64s(&[8])),
    ];
    assert_eq!(assert_table("Section record", &bytes[8..], &fields) as u64, container::SECTION_RECORD_BYTES);
}

#[test]
fn the_records_lie_where_the_page_says() {
    let path = Path::new("p");
    let sequence = sample().sequence;
    let bytes = records::encode(path, "sequence", &sequence).unwrap();
    let fields = [
        ("world_from_index", f64s(&sequence.world_from_index)),
        ("origin", i32s(&sequence.origin)),
        ("dims", u32s(&sequence.dims)),
        ("density_max", f32s(&[1.25])),
        ("promise", [u32s(&[0]), f64s(&[0.002])].concat()),
        ("frames_per_second", [vec![1], f64s(&[24.0])].concat()),
    ];
    let end = assert_table("Sequence record", &bytes, &fields);
    assert_eq!(bytes[end..], [u64s(&[5]), b"plume".to_vec(), u64s(&[7]), b"density".to_vec()].concat());
    let psnr = SequenceRecord { promise: Promise::Psnr(50.0), ..sequence };
    assert_eq!(records::encode(path, "", &psnr).unwrap()[124..136], [u32s(&[1]), f64s(&[50.0])].concat());

    let bytes = records::encode(path, "settings", &SettingsRecord { json: "{}".into() }).unwrap();
    assert_table("Settings record", &bytes, &[("json", [u64s(&[2]), b"{}".to_vec()].concat())]);

    let frame = FrameRecord {
        frame: -1,
        origin: [2, 3, 4],
        dims: [5, 6, 7],
        active_voxels: 8,
        gaussians: 9,
        fit_error: 10.0,
        max_error: 11.0,
        psnr_db: 12.0,
        step: 13.0,
        background: 14.0,
        source_hash: [15; 16],
        residual: ResidualKind::Hash,
        rank_bytes: 16,
        hash_bytes: 17,
        bytes_at_rest: 18,
        bytes_resident: 19,
    };
    let fields = [
        ("frame", i32s(&[-1])),
        ("origin", i32s(&[2, 3, 4])),
        ("dims", u32s(&[5, 6, 7])),
        ("active_voxels", u64s(&[8])),
        ("gaussians", u32s(&[9])),
        ("fit_error", f64s(&[10.0])),
        ("max_error", f64s(&[11.0])),
        ("psnr_db", f64s(&[12.0])),
        ("step", f32s(&[13.0])),
        ("background", f32s(&[14.0])),
        ("source_hash", vec![15; 16]),
        ("residual", u32s(&[1])),
        ("rank_bytes", u64s(&[16])),
        ("hash_bytes", u64s(&[17])),
        ("bytes_at_rest", u64s(&[18])),
        ("bytes_resident", u64s(&[19])),
    ];
    let bytes = records::encode(path, "frames", &vec![frame; 2]).unwrap();
    assert_eq!(assert_table("Frame record", &bytes[8..], &fields), (bytes.len() - 8) / 2);
}

#[test]
fn gaussians_and_residual_layouts_lie_where_the_page_says() {
    let path = Path::new("p");
    let g = Gaussian { center: [1.0, 2.0, 3.0], radius: 4.0, weight: 5.0 };
    let fields = [("center", f32s(&[1.0, 2.0, 3.0])), ("radius", f32s(&[4.0])), ("weight", f32s(&[5.0]))];
    let bytes = gaussians::to_bytes(&g);
    assert_eq!(bytes, *bytemuck::bytes_of(&g), "the layout is that of the struct in memory");
    assert_eq!(assert_table("Gaussian", &bytes, &fields), gaussians::GAUSSIAN_BYTES);

    let bytes = gaussians::encode(path, &[g]).unwrap();
    let lattice = f32s(&[1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0, 5.0, 5.0]);
    let fields = [("count", u32s(&[1])), ("lattice", lattice), ("packing", u32s(&[0]))];
    assert_eq!(assert_table("Snapped Gaussians", &bytes, &fields), gaussians::HEADER_BYTES);

    let codes = ball([9, 7, 6], 40, 3);
    let bytes = rank::encode(&codes);
    let (active, keys) = (codes.codes.len() as u64, codes.codes.iter().filter(|&&c| c != 0).count() as u64);
    let words = (bytes.len() - rank::HEADER_BYTES) as u64 / 4 - 2;
    let fields = [
        ("origin", i32s(&codes.origin)),
        ("dims", u32s(&codes.dims)),
        ("active_voxels", u64s(&[active])),
        ("stream_words", u64s(&[words])),
        ("reserved", vec![0; 24]),
    ];
    assert_eq!(assert_table("Rank header", &bytes, &fields), rank::HEADER_BYTES);

    let table = trivial(std::slice::from_ref(&codes));
    let bytes = hash::assemble(path, std::slice::from_ref(&codes), &table).unwrap();
    let fields = [
        ("frames", u32s(&[1])),
        ("side", u32s(&[9])),
        ("offset_side", u32s(&[1])),
        ("offset_step", u32s(&[1])),
        ("slot_bytes", u32s(&[1])),
        ("spacing", u32s(&codes.dims)),
        ("keys", u64s(&[keys])),
        ("reserved", vec![0; 24]),
    ];
    assert_eq!(assert_table("Hash header", &bytes, &fields), hash::HEADER_BYTES);
    // One offset (3 bytes) and 9^3 slots of a byte, each up to a multiple of four.
    let start = (hash::HEADER_BYTES + hash::FRAME_BYTES + 4 + 732) as u64;
    let fields = [
        ("origin", i32s(&codes.origin)),
        ("dims", u32s(&codes.dims)),
        ("active_voxels", u64s(&[active])),
        ("keys", u64s(&[keys])),
        ("start", u64s(&[start])),
        ("stream_words", u64s(&[(bytes.len() as u64 - start) / 4 - 2])),
        ("reserved", vec![0; 8]),
    ];
    assert_eq!(assert_table("Hash frame", &bytes[hash::HEADER_BYTES..], &fields), hash::FRAME_BYTES);

    let (bytes, _) = at_rest::encode_hash(path, std::slice::from_ref(&codes), &table, Codec::Coded).unwrap();
    let fields = [("frames", u32s(&[1])), ("side", u32s(&[9])), ("offset_side", u32s(&[1]))];
    assert_eq!(assert_table("Coded tile", &bytes, &fields), 12);
}
