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
