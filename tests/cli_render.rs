//! `render` through the binary: the shipped plume under the shipped scenes; same bytes alone, in a sequence and with any
//! number of threads; dials, names and bad input.

mod common;

use common::{answer, refusal, smoke_bake, text};
use serde_json::Value;
use smoke_formats::image::{self, FloatImage};
use std::path::Path;
use std::sync::LazyLock;

const SUNSET: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/testdata/scenes/sunset.toml");
/// Light from above and a sun, quick to read: for the many renders of a test of dials.
const PLAIN: &str = "[[light]]\nkind = \"environment\"\ncolor = [0.4, 0.6, 1.0]\n[[light]]\nkind = \"directional\"\n\
                     direction = [1, 0.4, -0.5]\nirradiance = [3, 2, 1]\n";
const SUN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/testdata/scenes/sun.toml");
const TURNED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/testdata/scenes/turned.toml");

/// A folder with three frames of the shipped plume as `plume.smoke`.
static BAKED: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let fit = ["--gaussians", "40", "--first-evaluations", "20", "--next-evaluations", "6", "--max-error", "0.004"];
    let line = ["bake", common::PLUME, "-o", "plume.smoke", "--frames", "6-8", "--progress", "none"];
    answer(folder.path(), &[&line[..], &fit].concat());
    folder
});

/// Renders into a folder of its own; small images.
fn render(scene: &str, output: &str, more: &[&str]) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let pack = BAKED.path().join("plume.smoke");
    let line = ["render", pack.to_str().unwrap(), "--scene", scene, "-o", output, "--progress", "none"];
    let said = answer(folder.path(), &[&line[..], &["--width", "60", "--height", "48"], more].concat());
    (folder, said)
}

fn refused(scene: &str, output: &str, more: &[&str]) -> (Option<i32>, String) {
    let folder = tempfile::tempdir().unwrap();
    let pack = BAKED.path().join("plume.smoke");
    let line = ["render", pack.to_str().unwrap(), "--scene", scene, "-o", output, "--progress", "none"];
    let output = smoke_bake(folder.path(), &[&line[..], more].concat());
    assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "{more:?}: nothing may be left behind");
    (output.status.code(), text(&output.stderr).to_owned())
}

fn read(folder: &Path, name: &str) -> FloatImage {
    image::read(&folder.join(name)).unwrap()
}

#[test]
fn a_frame_alone_in_a_sequence_and_on_any_number_of_threads_has_the_same_bytes() {
    for dials in
        [&["--g", "0.7"][..], &["--route", "centres"], &["--order", "single", "--samples", "2"], &["--half-resolution"]]
    {
        let (all, _) = render(SUNSET, "out.####.exr", &[dials, &["--threads", "1"]].concat());
        let (one, _) = render(SUNSET, "out.%04d.exr", &[dials, &["--threads", "3", "--frames", "8"]].concat());
        let bytes = |folder: &Path, name: &str| std::fs::read(folder.join(name)).unwrap();
        assert!(bytes(all.path(), "out.0008.exr") == bytes(one.path(), "out.0008.exr"), "{dials:?}");
        assert!(bytes(all.path(), "out.0008.exr") != bytes(all.path(), "out.0007.exr"));
        assert!(!one.path().join("out.0007.exr").exists());
    }
}

#[test]
fn images_hold_smoke_depth_and_every_setting() {
    let (folder, said) = render(SUNSET, "out.$F4.exr", &["--frames", "7", "--json", "--float", "--sigma-t", "9,8,7"]);
    let image = read(folder.path(), "out.0007.exr");
    let channel = |name: &str| image.channel(name).unwrap();
    assert_eq!((image.width, image.height, image.channels.len()), (60, 48, 5));
    let covered: Vec<usize> = (0..60 * 48).filter(|&p| channel("A")[p] > 0.5).collect();
    assert!(covered.len() > 20, "{} pixels of smoke", covered.len());
    for p in 0..60 * 48 {
        assert_eq!(channel("A")[p] == 0.0, channel("Z")[p].is_infinite(), "pixel {p}");
        assert!(channel("R")[p] > 0.0, "the sky of this scene is visible");
    }
    assert!(covered.iter().all(|&p| channel("G")[p] > 0.01 && channel("Z")[p] > 0.1));
    let json: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(json["settings"]["scene"]["medium"]["sigma_t"].to_string(), "[9.0,8.0,7.0]");
    assert_eq!(json["settings"]["render"]["route"], "grid");
    assert_eq!((json["frames"][0]["frame"].as_i64(), json["width"].as_i64()), (Some(7), Some(60)));
    for stage in ["decode", "source_radiance", "volume_pass", "view_pass", "write"] {
        assert!(json["frames"][0]["seconds"][stage].as_f64().unwrap() > 0.0, "{stage}");
    }
    let bytes = std::fs::read(folder.path().join("out.0007.exr")).unwrap();
    let has = |text: &str| bytes.windows(text.len()).any(|w| w == text.as_bytes());
    assert!(has("smokebake:settings") && has("\"beams\":64") && has("\"sigma_t\":[9.0,8.0,7.0]") && has("\"frame\":7"));
}

#[test]
fn every_dial_changes_the_image_and_a_scene_may_have_y_up() {
    let folder = tempfile::tempdir().unwrap();
    let plain = folder.path().join("plain.toml");
    let sun = std::fs::read_to_string(SUN).unwrap();
    std::fs::write(&plain, sun[..sun.find("[[light]]").unwrap()].to_owned() + PLAIN).unwrap();
    let plain = plain.to_str().unwrap();
    let picture = |scene: &str, dials: &[&str]| {
        let (folder, _) = render(scene, "out.exr", &[&["--frames", "8", "--float"], dials].concat());
        read(folder.path(), "out.exr")
    };
    let default = picture(plain, &["--g", "0.4", "--sigma-t", "5"]);
    for dials in [
        &["--route", "centres"][..],
        &["--route", "centres", "--exponential", "linear"],
        &["--route", "centres", "--multiple", "diffusion"],
        &["--order", "single"],
        &["--sh-order", "2"],
        &["--beams", "12"],
        &["--source-step", "2"],
        &["--scatter-step", "3"],
        &["--scatter-rings", "3"],
        &["--scatter-order", "1"],
        &["--march-step", "0.5"],
        &["--cutoff", "0.2"],
        &["--samples", "2"],
        &["--half-resolution"],
        &["--detail", "gaussians"],
        &["--albedo", "0.5"],
    ] {
        assert!(picture(plain, &[&["--g", "0.4", "--sigma-t", "5"], dials].concat()) != default, "{dials:?}");
    }
    for scene in [SUN, TURNED] {
        let image = picture(scene, &["--sigma-t", "5"]);
        assert!(image.channel("R").unwrap().iter().any(|&r| r > 0.01), "{scene}");
    }
}

#[test]
fn options_that_do_not_apply_are_wrong_usage_and_not_ignored() {
    for (dials, named) in [
        (&["--exponential", "direct"][..], "--exponential"),
        (&["--multiple", "diffusion"], "--multiple"),
        (&["--route", "centres", "--beams", "5"], "--beams"),
        (&["--route", "centres", "--scatter-step", "2"], "--scatter-step"),
        (&["--route", "centres", "--multiple", "transport"], "--multiple"),
        (&["--order", "single", "--multiple", "transport"], "--multiple"),
        (&["--order", "single", "--scatter-step", "2"], "--scatter-step"),
        (&["--method", "reference", "--half-resolution"], "--half-resolution"),
        (&["--march-step", "5"], "--march-step"),
        (&["--cutoff", "1"], "--cutoff"),
        (&["--samples", "0"], "--samples"),
    ] {
        let (code, message) = refused(SUNSET, "out.####.exr", dials);
        assert_eq!(code, Some(2), "{dials:?}: {message}");
        assert!(message.contains(named), "{message}");
    }
    assert_eq!(refused(SUNSET, "out.png", &[]).0, Some(2));
}

#[test]
fn several_frames_with_one_name_a_missing_frame_and_a_light_that_a_method_cannot_serve_are_refused() {
    let (code, message) = refused(SUNSET, "out.exr", &[]);
    assert!(code == Some(1) && message.contains("one name for 3 frames"), "{message}");
    let (code, message) = refused(SUNSET, "out.####.exr", &["--frames", "9"]);
    assert!(code == Some(1) && message.contains("frame 9"), "{message}");
    let (code, message) = refused(SUNSET, "out.####.exr", &["--g", "1"]);
    assert!(code == Some(1) && message.contains("medium.g"), "{message}");
    let folder = tempfile::tempdir().unwrap();
    let point = "\n[[light]]\nkind = \"point\"\nposition = [0, 0, 1]\nintensity = 10\n";
    std::fs::write(folder.path().join("scene.toml"), std::fs::read_to_string(SUN).unwrap() + point).unwrap();
    let pack = BAKED.path().join("plume.smoke");
    let line = ["render", pack.to_str().unwrap(), "--scene", "scene.toml", "-o", "a.####.exr", "--progress", "none"];
    let message = refusal(folder.path(), &[&line[..], &["--method", "compensated"]].concat());
    assert!(message.contains("light[") && message.contains("point"), "{message}");
    let few = ["--max-passes", "2", "--width", "12", "--height", "16"];
    answer(folder.path(), &[&line[..], &few].concat());
    assert!(read(folder.path(), "a.0008.exr").channel("standard_error.R").is_some(), "paths serve points");
}

#[test]
fn the_reference_has_the_same_bytes_on_any_number_of_threads_and_tells_how_well_it_is_known() {
    let dials = ["--method", "reference", "--frames", "8", "--max-passes", "20", "--target-error", "30%"];
    let (one, said) = render(SUNSET, "out.exr", &[&dials[..], &["--threads", "1", "--json"]].concat());
    let (three, _) = render(SUNSET, "out.exr", &[&dials[..], &["--threads", "3"]].concat());
    let (seed, _) = render(SUNSET, "out.exr", &[&dials[..], &["--seed", "7"]].concat());
    let bytes = |folder: &Path| std::fs::read(folder.join("out.exr")).unwrap();
    assert!(bytes(one.path()) == bytes(three.path()), "threads");
    assert!(bytes(one.path()) != bytes(seed.path()), "seed");
    let json: Value = serde_json::from_str(&said).unwrap();
    let frame = &json["frames"][0];
    let (passes, error) = (frame["passes"].as_u64().unwrap(), frame["relative_error"].as_f64().unwrap());
    assert!((16..=20).contains(&passes) && error > 0.0 && (passes == 20 || error <= 0.3), "{frame}");
    let image = read(one.path(), "out.exr");
    let rms = |names: [&str; 3]| {
        let squares = names.map(|n| image.channel(n).unwrap().iter().map(|v| f64::from(*v).powi(2)).sum::<f64>());
        squares.iter().sum::<f64>().sqrt()
    };
    let stored = rms(["standard_error.R", "standard_error.G", "standard_error.B"]) / rms(["R", "G", "B"]);
    // R, G and B are stored in half: 2^-11 each.
    assert!((stored / error - 1.0).abs() < 2e-3, "{stored} {error}");
    for (dials, named) in [
        (&["--method", "reference", "--beams", "4"][..], "--beams"),
        (&["--method", "compensated", "--seed", "4"], "--seed"),
        (&["--method", "compensated", "--order", "3"], "--order"),
        (&["--method", "reference", "--max-passes", "1"], "--max-passes"),
    ] {
        let (code, message) = refused(SUNSET, "out.####.exr", dials);
        assert!(code == Some(2) && message.contains(named), "{dials:?}: {message}");
    }
}

#[test]
fn the_gaussians_alone_are_the_same_smoke_by_and_large_and_the_image_says_so() {
    let picture = |dials: &[&str]| {
        let dials = [&["--frames", "8", "--float", "--json", "--order", "single", "--sigma-t", "5"], dials].concat();
        let (folder, said) = render(SUNSET, "out.exr", &dials);
        let json: Value = serde_json::from_str(&said).unwrap();
        (read(folder.path(), "out.exr"), json["settings"]["render"].clone())
    };
    let (full, settings) = picture(&[]);
    assert_eq!((settings["detail"].as_str(), settings["half_resolution"].as_bool()), (Some("full"), Some(false)));
    let (alone, settings) = picture(&["--detail", "gaussians", "--half-resolution"]);
    assert_eq!((settings["detail"].as_str(), settings["half_resolution"].as_bool()), (Some("gaussians"), Some(true)));
    let opacity = |image: &FloatImage| image.channel("A").unwrap().iter().map(|&a| f64::from(a)).sum::<f64>();
    // 40 Gaussians for a plume: a crude fit, which still has to put the smoke where it is.
    let ratio = opacity(&alone) / opacity(&full);
    assert!((0.7..1.4).contains(&ratio), "{ratio}");
}
