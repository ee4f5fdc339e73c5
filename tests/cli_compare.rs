//! `compare` through the binary: figures of planted differences, pictures, exit codes, stdout alone for answers.

use serde_json::Value;
use smoke_formats::image::{self, Channel, FloatImage};
use std::path::Path;
use std::process::{Command, Output};

fn smoke_bake(folder: &Path, line: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_smoke-bake")).args(line).current_dir(folder).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// A folder with `a.exr` and `b.exr`, 5 x 4: b is 2 everywhere, alpha 1 in the upper half; a is b but for `planted`.
fn folder(planted: &[(usize, f32)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut values = vec![2.0; 20];
    let alpha: Vec<f32> = (0..20).map(|i| if i < 10 { 1.0 } else { 0.0 }).collect();
    let write = |name: &str, green: &[f32]| {
        let channel = |name: &str, values: &[f32]| Channel { name: name.into(), values: values.to_vec() };
        let channels =
            vec![channel("R", &[2.0; 20]), channel("G", green), channel("B", &[2.0; 20]), channel("A", &alpha)];
        image::write_channels(&folder.path().join(name), &FloatImage { width: 5, height: 4, channels }).unwrap();
    };
    write("b.exr", &values);
    planted.iter().for_each(|&(i, v)| values[i] = v);
    write("a.exr", &values);
    folder
}

#[test]
fn json_is_one_document_on_stdout_and_nothing_is_on_stderr() {
    let folder = folder(&[(13, 5.0)]);
    let output = smoke_bake(folder.path(), &["compare", "a.exr", "b.exr", "--json"]);
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), ""));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    // One of 60 samples is off by 3.
    let expected = (9.0_f64 / 60.0).sqrt();
    let number = |pointer: &str| json.pointer(pointer).unwrap().as_f64().unwrap();
    assert!((number("/all/rmse") - expected).abs() < 1e-15);
    assert!((number("/all/relative_rmse") - expected / 2.0).abs() < 1e-15);
    assert!((number("/all/bias") - 3.0 / 120.0).abs() < 1e-15);
    assert_eq!((number("/channels/R/rmse"), number("/channels/G/bias")), (0.0, 3.0 / 40.0));
    assert_eq!((number("/largest_error/x"), number("/largest_error/y")), (3.0, 2.0));
    assert_eq!((json["largest_error"]["channel"].as_str(), number("/pixels")), (Some("G"), 20.0));
}

#[test]
fn equal_images_have_no_error_and_a_planted_one_shows_in_the_text() {
    let equal = folder(&[]);
    let output = smoke_bake(equal.path(), &["compare", "a.exr", "b.exr"]);
    assert_eq!(output.status.code(), Some(0));
    assert!(text(&output.stdout).contains("relative RMSE    0.0000 %"), "{}", text(&output.stdout));
    let planted = folder(&[(0, 1.0)]);
    let output = smoke_bake(planted.path(), &["compare", "a.exr", "b.exr"]);
    assert!(text(&output.stdout).contains("largest error    1.000000e0 at (0, 0) in G"), "{}", text(&output.stdout));
}

#[test]
fn the_alpha_mask_leaves_out_an_error_where_alpha_is_zero() {
    let folder = folder(&[(13, 5.0)]);
    let output = smoke_bake(folder.path(), &["compare", "a.exr", "b.exr", "--mask-alpha", "--json"]);
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((json["pixels"].as_u64(), json["all"]["rmse"].as_f64()), (Some(10), Some(0.0)));
    assert_eq!(json["all"]["psnr_db"], Value::Null);
}

#[test]
fn the_difference_is_written_in_false_colour_or_as_numbers() {
    let folder = folder(&[(13, 5.0)]);
    let line = ["compare", "a.exr", "b.exr", "-o", "d.png", "--scale", "1", "--json"];
    let output = smoke_bake(folder.path(), &line);
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((json["difference"]["path"].as_str(), json["difference"]["scale"].as_f64()), (Some("d.png"), Some(1.0)));
    assert_eq!(&std::fs::read(folder.path().join("d.png")).unwrap()[1..4], b"PNG");
    assert_eq!(smoke_bake(folder.path(), &["compare", "a.exr", "b.exr", "-o", "d.exr"]).status.code(), Some(0));
    let difference = image::read(&folder.path().join("d.exr")).unwrap();
    let green = difference.channel("G").unwrap();
    assert_eq!((green[13], green.iter().sum::<f32>(), difference.channel("R").unwrap()[13]), (3.0, 3.0, 0.0));
}

#[test]
fn a_nan_fails_with_its_pixel_but_the_picture_is_still_written() {
    let folder = folder(&[(6, f32::NAN)]);
    let output = smoke_bake(folder.path(), &["compare", "a.exr", "b.exr", "-o", "d.png", "--json"]);
    assert_eq!((output.status.code(), text(&output.stdout)), (Some(1), ""));
    let expected =
        "smoke-bake: a.exr against b.exr: not finite: 1 pixels of the image, 0 of the reference, the first at (1, 1)\n";
    assert_eq!(text(&output.stderr), expected);
    assert!(folder.path().join("d.png").exists());
}

#[test]
fn bad_input_is_one_line_on_stderr_and_exit_code_1() {
    let folder = folder(&[]);
    std::fs::write(folder.path().join("c.exr"), b"not an image").unwrap();
    let small = FloatImage { width: 1, height: 1, channels: vec![Channel { name: "Y".into(), values: vec![0.0] }] };
    image::write_channels(&folder.path().join("small.exr"), &small).unwrap();
    let cases = [
        (&["compare", "a.exr", "no.exr"][..], "smoke-bake: no.exr: "),
        (&["compare", "c.exr", "b.exr"], "smoke-bake: c.exr: first bytes: found [6e 6f 74 20], expected"),
        (
            &["compare", "small.exr", "b.exr"],
            "smoke-bake: small.exr: image size: found 1 x 1, expected 5 x 4 as in b.exr",
        ),
        (
            &["compare", "small.exr", "small.exr", "--mask-alpha"],
            "smoke-bake: small.exr: --mask-alpha: found no channel A",
        ),
        (&["compare", "a.exr", "b.exr", "-o", "no/such/d.png"], "smoke-bake: no/such/d.png: "),
    ];
    for (line, expected) in cases {
        let output = smoke_bake(folder.path(), line);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(1), ""), "{line:?}");
        let message = text(&output.stderr);
        assert!(message.starts_with(expected) && message.matches('\n').count() == 1, "{message}");
    }
}

/// Independent normal numbers, from sums of twelve hashes: close enough to the bell out to three standard deviations.
fn normal(i: usize) -> f64 {
    let uniform = |k: u64| {
        let mut z = (i as u64 * 12 + k).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as f64 / u64::MAX as f64
    };
    (0..12).map(uniform).sum::<f64>() - 6.0
}

/// A folder with `mean.exr`, 64 x 48 and the mean of 8 noisy passes, its standard errors in layers; `error.exr`, the same
/// standard errors as an image; `bare.exr`, the mean alone; `true.exr`, the truth; `off.exr`, the truth and 1 %.
fn measured() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let (width, height, passes) = (64, 48, 8);
    let truth: Vec<f32> = (0..3 * width * height).map(|i| 1.0 + (i % 7) as f32).collect();
    // A pass is off by 20 %: the mean by 7 % a sample, and by 0.13 % over the image.
    let sample = |(i, truth): (usize, &f32)| {
        let values: Vec<f64> = (0..passes).map(|k| f64::from(*truth) * (1.0 + 0.2 * normal(i * passes + k))).collect();
        let mean = values.iter().sum::<f64>() / passes as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (passes - 1) as f64;
        (mean as f32, (variance / passes as f64).sqrt() as f32)
    };
    let (mean, error): (Vec<f32>, Vec<f32>) = truth.iter().enumerate().map(sample).unzip();
    let channels = |prefix: &str, samples: &[f32]| -> Vec<Channel> {
        let channel = |(c, name): (usize, &str)| {
            let values = samples.iter().skip(c).step_by(3).copied().collect();
            Channel { name: format!("{prefix}{name}"), values }
        };
        ["R", "G", "B"].into_iter().enumerate().map(channel).collect()
    };
    let write = |name: &str, channels: Vec<Channel>| {
        image::write_channels(&folder.path().join(name), &FloatImage { width, height, channels }).unwrap();
    };
    write("true.exr", channels("", &truth));
    write("off.exr", channels("", &truth.iter().map(|v| v * 1.01).collect::<Vec<_>>()));
    write("bare.exr", channels("", &mean));
    write("error.exr", channels("", &error));
    write("mean.exr", [channels("", &mean), channels("standard_error.", &error)].concat());
    folder
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", text(&output.stderr)))
}

#[test]
fn the_truth_passes_the_z_test_and_one_per_cent_more_fails_it_with_all_figures_on_stdout() {
    let folder = measured();
    let line = ["mean.exr", "--z-test", "--passes", "8", "--json"];
    let output = smoke_bake(folder.path(), &[&["compare", "true.exr"], &line[..]].concat());
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), ""));
    let found = json(&output);
    assert_eq!(
        (found["z_test"]["passed"].as_bool(), found["z_test"]["reference_passes"].as_u64()),
        (Some(true), Some(8))
    );
    // Student's t with 7 degrees of freedom beyond 2, tables of the distribution: 0.0856.
    let expected = found["z_test"]["channels"]["G"]["beyond_2"]["expected"].as_f64().unwrap();
    assert!((expected - 0.0856).abs() < 5e-5, "{expected}");

    let output = smoke_bake(folder.path(), &[&["compare", "off.exr"], &line[..]].concat());
    let message = "smoke-bake: off.exr against mean.exr: z-test failed: mean of R, G, B, R+G+B\n";
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(1), message));
    let found = json(&output);
    let z = found["z_test"]["channels"]["R"]["mean"]["z"].as_f64().unwrap();
    // 1 % over a noise of 20 % / sqrt(8 * 3072), times sqrt(mean^2 / mean square) = 0.9 of the truth: 7.1, give or take 3.
    assert!((3.0..12.0).contains(&z), "{z}");
    assert_eq!(found["z_test"]["all"]["passed"].as_bool(), Some(false));
}

#[test]
fn standard_errors_come_from_layers_or_from_a_file_and_passes_that_nobody_knows_are_many() {
    let folder = measured();
    let run =
        |line: &[&str]| smoke_bake(folder.path(), &[&["compare", "true.exr"], line, &["--z-test", "--json"]].concat());
    let layers = json(&run(&["mean.exr", "--passes", "8"]));
    let file = json(&run(&["bare.exr", "--standard-error", "error.exr", "--passes", "8"]));
    assert_eq!((&layers["z_test"], &layers["debiased"]), (&file["z_test"], &file["debiased"]));
    // Without the passes 4.6 % are expected beyond 2 where there are 8.6 %: that is found out.
    let output = run(&["mean.exr"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(text(&output.stderr).contains("share beyond 2 standard errors in R, G, B"), "{}", text(&output.stderr));
    assert_eq!(json(&output)["z_test"]["reference_passes"], Value::Null);
    // Noise on both sides: the mean against itself, as if it were another.
    let output = smoke_bake(
        folder.path(),
        &["compare", "mean.exr", "mean.exr", "--z-test", "--passes", "8", "--image-passes", "8", "--json"],
    );
    let freedom = json(&output)["z_test"]["channels"]["R"]["mean"]["degrees_of_freedom"].as_f64().unwrap();
    let one_side = layers["z_test"]["channels"]["R"]["mean"]["degrees_of_freedom"].as_f64().unwrap();
    // The same variances twice: (2v)^2 / (2 v^2 / 7) is twice as many.
    assert!((freedom / one_side - 2.0).abs() < 1e-9, "{freedom} {one_side}");
}

#[test]
fn the_passes_are_read_from_the_settings_of_the_reference() {
    use smoke_formats::image::{FrameMetadata, RenderedFrame, SamplePrecision};
    let folder = measured();
    let rgb = image::read(&folder.path().join("bare.exr")).unwrap().rgb(Path::new("bare.exr")).unwrap();
    let (zero, identity) = (vec![0.0; rgb.pixels.len()], [[0.0; 4]; 4]);
    let write = |name: &str, settings: &str| {
        let frame =
            RenderedFrame { width: 64, height: 48, rgb: &rgb.pixels, alpha: &zero, depth: &zero, standard_error: None };
        let metadata = FrameMetadata {
            software: "test".into(),
            frames_per_second: None,
            world_to_camera: identity,
            world_to_ndc: identity,
            settings_json: settings.into(),
        };
        image::write_frame(&folder.path().join(name), &frame, &metadata, SamplePrecision::Float).unwrap();
    };
    write("eight.exr", r#"{"passes": 8}"#);
    write("one.exr", r#"{"passes": 1}"#);
    let run = |name: &str, more: &[&str]| {
        let line = ["compare", "true.exr", name, "--standard-error", "error.exr", "--z-test", "--json"];
        smoke_bake(folder.path(), &[&line[..], more].concat())
    };
    assert_eq!(json(&run("eight.exr", &[]))["z_test"]["reference_passes"].as_u64(), Some(8));
    assert_eq!(json(&run("eight.exr", &["--passes", "9"]))["z_test"]["reference_passes"].as_u64(), Some(9));
    let message = text(&run("one.exr", &[]).stderr).to_owned();
    assert!(message.contains("one.exr: smokebake:settings: passes: found 1, expected a whole number of at least 2"));
}

#[test]
fn the_debiased_error_leaves_out_the_noise_of_the_reference() {
    let folder = measured();
    let output = smoke_bake(folder.path(), &["compare", "off.exr", "mean.exr", "--json"]);
    let found = json(&output);
    let number = |pointer: &str| found.pointer(pointer).unwrap().as_f64().unwrap();
    // A noise of 7 % of each sample, on top of 1 %.
    assert!((number("/all/relative_rmse") - 0.0714).abs() < 0.004, "{}", number("/all/relative_rmse"));
    assert!((number("/debiased/all/reference_noise") - 0.0707).abs() < 0.004);
    // rel^2 = 1e-4 scatters by 0.005 sqrt(2.3 / 9216) = 8e-5.
    assert!(number("/debiased/all/relative_rmse") < 0.02, "{}", number("/debiased/all/relative_rmse"));
    assert_eq!((&found["z_test"], &found["flip"]), (&Value::Null, &Value::Null));
}

#[test]
fn flip_is_0_for_equal_images_and_its_map_shows_a_planted_error_of_one_per_cent_in_its_place() {
    let folder = measured();
    let equal = json(&smoke_bake(folder.path(), &["compare", "true.exr", "true.exr", "--flip", "--json"]));
    assert_eq!((equal["flip"]["mean"].as_f64(), equal["flip"]["largest"].as_f64()), (Some(0.0), Some(0.0)));
    // 1 % more in the left eight columns of the truth.
    let mut image = image::read(&folder.path().join("true.exr")).unwrap();
    for channel in &mut image.channels {
        channel.values.iter_mut().enumerate().filter(|(i, _)| i % 64 < 8).for_each(|(_, v)| *v *= 1.01);
    }
    image::write_channels(&folder.path().join("left.exr"), &image).unwrap();
    let line = ["compare", "left.exr", "true.exr", "--picture", "flip", "-o", "map.exr", "--json"];
    let found = json(&smoke_bake(folder.path(), &line));
    assert_eq!(
        (found["difference"]["picture"].as_str(), found["flip"]["pixels_per_degree"].as_f64()),
        (Some("flip"), Some(67.0))
    );
    let map = image::read(&folder.path().join("map.exr")).unwrap();
    let map = map.channel("Y").unwrap();
    let mean = map.iter().map(|v| f64::from(*v)).sum::<f64>() / map.len() as f64;
    assert!((found["flip"]["mean"].as_f64().unwrap() - mean).abs() < 1e-9);
    // The filters reach 10 pixels.
    assert!(map.iter().enumerate().all(|(i, v)| if i % 64 < 8 { *v > 0.0 } else { i % 64 < 18 || *v == 0.0 }));
    let line = ["compare", "left.exr", "true.exr", "--picture", "flip", "-o", "map.png"];
    let output = smoke_bake(folder.path(), &line);
    assert!(
        text(&output.stdout).contains("map.png: FLIP from 0, black, to 1, light yellow"),
        "{}",
        text(&output.stdout)
    );
    assert_eq!(&std::fs::read(folder.path().join("map.png")).unwrap()[1..4], b"PNG");
}

#[test]
fn a_test_without_standard_errors_or_with_bad_ones_is_refused_in_one_line() {
    let folder = measured();
    let small = FloatImage { width: 1, height: 1, channels: vec![Channel { name: "Y".into(), values: vec![0.0] }] };
    image::write_channels(&folder.path().join("small.exr"), &small).unwrap();
    let mut bad = image::read(&folder.path().join("error.exr")).unwrap();
    bad.channels[0].values[65] = -1.0;
    image::write_channels(&folder.path().join("bad.exr"), &bad).unwrap();
    let cases = [
        (&["--z-test"][..], "bare.exr: --z-test: found no standard errors, expected channels standard_error.R"),
        (&["--passes", "8"], "bare.exr: --passes: found no standard errors"),
        (&["--standard-error", "small.exr"], "small.exr: image size: found 1 x 1, expected 64 x 48 as in bare.exr"),
        (&["--standard-error", "bad.exr"], "true.exr against bare.exr: standard error -1 at (1, 1)"),
    ];
    for (line, expected) in cases {
        let output = smoke_bake(folder.path(), &[&["compare", "true.exr", "bare.exr"], line].concat());
        let message = text(&output.stderr);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(1), ""), "{line:?}: {message}");
        assert!(
            message.starts_with(&format!("smoke-bake: {expected}")) && message.matches('\n').count() == 1,
            "{message}"
        );
    }
}

#[test]
#[ignore = "needs ../shared/data"]
fn two_references_of_the_plume_differ_and_one_equals_itself() {
    let data = std::env::var_os("SMOKE_BAKE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), Into::into);
    let references = data.join("../peers/references");
    let compare = |a: &str, b: &str| {
        let output = smoke_bake(&references, &["compare", a, b, "--json"]);
        assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
        serde_json::from_slice::<Value>(&output.stdout).unwrap()["all"]["relative_rmse"].as_f64().unwrap()
    };
    assert_eq!(compare("plume_1040.exr", "plume_1040.exr"), 0.0);
    // Single scattering lacks more than a tenth of the light of a plume with albedo 0.92.
    assert!(compare("plume_1040_single.exr", "plume_1040.exr") > 0.1);
}

#[test]
#[ignore = "needs ../shared/data"]
fn the_noise_and_the_flip_of_the_plumes_references_are_what_others_measured() {
    let data = std::env::var_os("SMOKE_BAKE_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), Into::into);
    let references = data.join("../peers/references");
    let line = ["--standard-error", "plume_1040.std.exr", "--z-test", "--flip", "--json"];
    let compare = |image: &str| smoke_bake(&references, &[&["compare", image, "plume_1040.exr"], &line[..]].concat());
    let found = json(&compare("plume_1040_single.exr"));
    let number = |pointer: &str| found.pointer(pointer).unwrap().as_f64().unwrap();
    // flip-evaluator 1.7 at 67 pixels per degree, 2 exposures from 1.8865242 to 2.6354589 stops.
    assert!((number("/flip/mean") - 0.083_258_5).abs() < 1e-5, "{}", number("/flip/mean"));
    // The renderer printed a relative standard error of 1.0 %.
    assert!((number("/debiased/all/reference_noise") - 0.0101).abs() < 5e-5);
    assert_eq!(found["z_test"]["passed"].as_bool(), Some(false));
    assert_eq!(compare("plume_1040.exr").status.code(), Some(0));
}
