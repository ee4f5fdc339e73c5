//! `render --device gpu` through the binary: the frames that the processor renders, all of them, once each, by every
//! method. `SMOKE_GPU` decides: `off` leaves it out, `auto` (the default) takes the best device there is, `require` fails
//! where there is none.
#![cfg(feature = "gpu")]

mod common;

use common::{PLUME, answer};
use serde_json::Value;
use smoke_formats::image::{self, FloatImage};
use std::path::Path;

/// Relative RMSE that images are promised to agree to.
const IMAGE: f64 = 2e-3;
const SCENES: [&str; 3] = ["sunset", "sun", "turned"];
const FRAMES: std::ops::RangeInclusive<i32> = 1..=8;

/// The name of the device, or none where tests are told to do without or there is none; says which.
fn device(folder: &Path) -> Option<String> {
    let mode = common::gpu_mode();
    let list: Value = serde_json::from_str(&answer(folder, &["devices", "--json"])).unwrap();
    let name = list[0]["name"].as_str().filter(|_| mode != "off").map(str::to_owned);
    assert!(name.is_some() || mode != "require", "SMOKE_GPU=require: no graphics device");
    eprintln!("SMOKE_GPU={mode}: {}", name.as_deref().unwrap_or("0 GPU cases, no device is used"));
    name
}

fn scene(name: &str) -> String {
    format!("{}/testdata/scenes/{name}.toml", env!("CARGO_MANIFEST_DIR"))
}

fn bake(folder: &Path, sequence: &str, pack: &str, frames: &str, more: &[&str]) {
    let fit = ["--gaussians", "40", "--first-evaluations", "20", "--next-evaluations", "6", "--max-error", "0.004"];
    let line = ["bake", sequence, "-o", pack, "--frames", frames, "--progress", "none"];
    answer(folder, &[&line[..], &fit, more].concat());
}

/// Renders to `DEVICE.####.exr`; gives the answer.
fn render(folder: &Path, pack: &str, device: &str, scene: &str, more: &[&str]) -> String {
    let output = format!("{device}.####.exr");
    let size = ["--width", "50", "--height", "60", "--float", "--progress", "none"];
    let line = ["render", pack, "--device", device, "--scene", scene, "-o", &output];
    answer(folder, &[&line[..], &size, more].concat())
}

/// RMSE of all channels but depth over the RMS of the first; infinite if any is not a number.
fn difference(a: &FloatImage, b: &FloatImage) -> f64 {
    let values = |image: &FloatImage| -> Vec<f64> {
        let colour = image.channels.iter().filter(|channel| channel.name != "Z");
        colour.flat_map(|channel| channel.values.iter().map(|&v| f64::from(v))).collect()
    };
    let (a, b) = (values(a), values(b));
    assert_eq!(a.len(), b.len());
    let size: f64 = a.iter().map(|v| v * v).sum();
    let error: f64 = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum();
    assert!(size > 0.0, "nothing to compare");
    let relative = (error / size).sqrt();
    if relative.is_finite() { relative } else { f64::INFINITY }
}

fn read(folder: &Path, device: &str, frame: i32) -> FloatImage {
    image::read(&folder.join(format!("{device}.{frame:04}.exr"))).unwrap()
}

#[test]
fn no_frame_of_a_sequence_is_left_out_or_comes_twice() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let Some(name) = device(folder) else { return };
    bake(folder, PLUME, "p.smoke", "1-8", &[]);
    for device in ["cpu", "gpu"] {
        // Few beams: a software device is slow.
        render(
            folder,
            "p.smoke",
            device,
            &scene("sunset"),
            &["--method", "compensated", "--order", "single", "--beams", "16"],
        );
    }
    for frame in FRAMES {
        let found = read(folder, "gpu", frame);
        for other in FRAMES {
            let off = difference(&read(folder, "cpu", other), &found);
            // Frames are further apart than devices: what is shown is this frame and no other.
            assert!(if other == frame { off <= IMAGE } else { off > 5.0 * IMAGE }, "{frame} beside {other}: {off}");
        }
    }
    eprintln!("{name}: {} GPU cases", FRAMES.count());
}

#[test]
fn frames_that_are_uploaded_ahead_have_the_bytes_of_frames_in_turn_and_the_upload_is_a_stage() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let Some(name) = device(folder) else { return };
    let scene = scene("turned");
    let transfer = ["--transfer", "hat162", "--clusters", "16", "--photons", "1", "--medium", &scene];
    bake(folder, PLUME, "p.smoke", "5-7", &transfer);
    let grid = ["--method", "compensated", "--order", "single", "--beams", "16"];
    let mut cases = 0;
    for method in [&grid[..], &["--method", "transfer"]] {
        let seconds = |device: &str, more: &[&str]| -> Vec<Value> {
            let line = [method, &["--json"], more].concat();
            let told: Value = serde_json::from_str(&render(folder, "p.smoke", device, &scene, &line)).unwrap();
            told["frames"].as_array().unwrap().iter().map(|frame| frame["seconds"].clone()).collect()
        };
        let bytes = |frame: i32| std::fs::read(folder.join(format!("gpu.{frame:04}.exr"))).unwrap();
        // On one thread a frame is uploaded when the one before it is done; alone, nothing is beside it.
        let images =
            [&["--threads", "1"][..], &["--threads", "2"], &["--threads", "2", "--frames", "6,7"]].map(|more| {
                let seconds = seconds("gpu", more);
                assert!(seconds.iter().all(|s| s["upload"].as_f64().is_some_and(|s| s >= 0.0)), "{seconds:?}");
                assert!(seconds.iter().all(|s| s["decode"].is_number() && s["view_pass"].is_number()), "{seconds:?}");
                cases += seconds.len();
                (5..=7).map(bytes).collect::<Vec<_>>()
            });
        assert!(images[0] == images[1] && images[1] == images[2], "{method:?}");
        assert!(images[0][0] != images[0][1] && images[0][1] != images[0][2]);
        assert!(seconds("cpu", &["--frames", "6"]).iter().all(|s| s["decode"].is_number() && s["upload"].is_null()));
    }
    eprintln!("{name}: {cases} GPU cases");
}

#[test]
fn images_of_every_method_and_scene_agree_with_the_processors() {
    agree(PLUME, &[6], "2");
}

#[test]
#[ignore = "needs the real sequence, and minutes"]
fn images_of_the_real_plume_agree_with_the_processors() {
    let plume = common::shared_data().join("plume/plume.####.vdb");
    agree(plume.to_str().unwrap(), &[1020, 1060], "1");
}

/// Holds images of some frames against each other, with so many photons a face.
fn agree(sequence: &str, frames: &[i32], photons: &str) {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let Some(name) = device(folder) else { return };
    let mut cases = 0;
    for (scene_name, &frame) in SCENES.iter().flat_map(|scene| frames.iter().map(move |frame| (scene, frame))) {
        let scene = scene(scene_name);
        let transfer = ["--transfer", "hat162", "--clusters", "32", "--photons", photons, "--medium", &scene];
        let pack = format!("{scene_name}.{frame}.smoke");
        bake(folder, sequence, &pack, &frame.to_string(), &transfer);
        for method in [
            &["--beams", "16", "--scatter-step", "4", "--half-resolution"][..],
            &["--route", "centres"],
            &["--method", "transfer"],
        ] {
            for device in ["cpu", "gpu"] {
                render(folder, &pack, device, &scene, method);
            }
            let off = difference(&read(folder, "cpu", frame), &read(folder, "gpu", frame));
            eprintln!("{scene_name}, frame {frame}, {method:?}: {off:.1e}");
            assert!(off <= IMAGE, "{scene_name}, frame {frame}, {method:?}: {off}");
            cases += 1;
        }
    }
    eprintln!("{name}: {cases} GPU cases");
}
