//! A small pack and a scene for unit tests of the subcommands around them.

#[cfg(feature = "view")]
use crate::devices::Device;
use crate::staging::Stage;
use smoke_formats::gaussian::Gaussian;
use smoke_formats::pack::{
    AtRest, Codec, FrameData, FrameRecord, Promise, SequenceRecord, SettingsRecord, TransferFrameRecord,
    TransferRecord, write,
};
use smoke_formats::residual::ResidualCodes;
use smoke_formats::scene::Scene;
use smoke_formats::transfer::{Bases, Rows, TransferBases, TransferRows};
use smoke_formats::volume::VoxelMask;
use smoke_runtime::camera::Camera;
use smoke_runtime::transport::medium::MediumParameters;
use std::path::Path;

/// Writes a pack of the given frames, 4 x 3 x 2 voxels of 0.5 world units at index (10, -2, 0), every other voxel in the
/// support, three Gaussians a frame, codes that differ from frame to frame.
pub fn small_pack(path: &Path, frames: &[i32], step: f32) {
    write_small_pack(path, frames, step, None);
}

/// The small pack of frames 1001, 1002 and 1004; the first and the last are a run with transfer, all of it zero.
pub fn small_pack_with_transfer(path: &Path) {
    let frame = |frame: u32, direct_error: f64, indirect_error: f64| TransferFrameRecord {
        frame,
        voxels: 12 + u64::from(frame),
        cells: 2,
        direct_error,
        indirect_error,
        truncated: 0.125,
        raw_bytes: 150,
        ..TransferFrameRecord::default()
    };
    let record = TransferRecord {
        sigma_t: [2.0; 3],
        albedo: [0.5; 3],
        bands: 3,
        photons: 8,
        basis: "sh6".into(),
        frames: vec![frame(0, 0.25, 0.0), frame(2, 0.0, 0.5)],
        ..TransferRecord::default()
    };
    write_small_pack(path, &[1001, 1002, 1004], 0.01, Some(&record));
}

fn write_small_pack(path: &Path, frames: &[i32], step: f32, transfer: Option<&TransferRecord>) {
    let (origin, dims) = ([10, -2, 0], [4, 3, 2]);
    let gaussian = |i: usize| Gaussian { center: [0.3 * i as f32, 0.2, 0.1], radius: 0.4, weight: 0.25 };
    let gaussians: Vec<Gaussian> = (0..3).map(gaussian).collect();
    let mut support = VoxelMask::new(24);
    (0..24).step_by(2).for_each(|v| support.set(v));
    let sequence = SequenceRecord {
        world_from_index: [0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5, 1.0, 2.0, 3.0],
        origin,
        dims,
        density_max: 1.0,
        promise: Promise::MaxError(0.5 * f64::from(step)),
        frames_per_second: Some(24.0),
        name: "small".into(),
        grid: "density".into(),
    };
    let settings = SettingsRecord { json: r#"{"gaussians":3}"#.into() };
    let filled = write(path, |mut writer| {
        for &frame in frames {
            let codes = (0..12).map(|i| i * frame % 7).collect();
            let codes = ResidualCodes { origin, dims, support: support.clone(), codes };
            let max_error = 0.5 * f64::from(step);
            let record =
                FrameRecord { frame, fit_error: 0.02, max_error, psnr_db: 47.5, step, ..FrameRecord::default() };
            writer.push_rank(&FrameData { record, gaussians: &gaussians, codes: &codes }, AtRest::RAW)?;
        }
        for (i, frame) in transfer.iter().flat_map(|record| &record.frames).enumerate() {
            let bases =
                || vec![Bases { length: 1, clusters: 1, terms: 0, scale: 1.0, values: vec![Default::default()] }];
            let rows = |count: u64| vec![Rows { ids: vec![0; count as usize], weights: vec![] }];
            if i == 0 {
                writer.push_transfer_bases(0, 3, &TransferBases { direct: bases(), indirect: bases() }, Codec::Raw)?;
            }
            let rows = TransferRows { direct: rows(frame.voxels), indirect: rows(frame.cells) };
            writer.push_transfer_rows(frame.frame as usize, &rows, Codec::Raw)?;
        }
        writer.finish(&sequence, &settings, transfer)
    });
    filled.unwrap();
}

/// The processor, and a graphics device if there is one and `SMOKE_GPU` does not forbid it; with `require` there must be.
#[cfg(feature = "view")]
pub fn devices() -> Vec<Device> {
    let mode = std::env::var("SMOKE_GPU").unwrap_or_else(|_| "auto".into());
    let graphics = (mode != "off").then(|| Device::open("gpu").ok()).flatten();
    assert!(graphics.is_some() || mode != "require", "SMOKE_GPU=require: no graphics device");
    [Device::Cpu].into_iter().chain(graphics).collect()
}

/// A scene without lights, 8 x 6 pixels.
pub fn stage() -> Stage {
    let text = "[camera]\nposition = [0, 0, 0]\ntarget = [1, 0, 0]\nfov = 30\n[image]\nwidth = 8\nheight = 6\n\
                [medium]\nsigma_t = 1\n";
    let scene = Scene::parse(Path::new("scene.toml"), text).unwrap();
    let camera = Camera::from_pinhole(&scene.pinhole());
    Stage { scene, medium: MediumParameters { sigma_t: [1.0; 3], albedo: [1.0; 3], g: 0.0 }, lights: vec![], camera }
}
