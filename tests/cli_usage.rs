//! The command line itself: help, exit codes, and settings from flag, variable and file.

use std::path::Path;
use std::process::{Command, Output};

fn smoke_bake(folder: &Path, line: &[&str], variables: &[(&str, &str)]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_smoke-bake"));
    command.args(line).current_dir(folder).envs(variables.iter().copied()).output().unwrap()
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// A folder with a settings file and two equal grey images.
fn folder(settings: &str) -> tempfile::TempDir {
    use smoke_formats::image::{Channel, FloatImage, write_channels};
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("smoke-bake.toml"), settings).unwrap();
    let image = FloatImage { width: 1, height: 1, channels: vec![Channel { name: "Y".into(), values: vec![0.5] }] };
    write_channels(&folder.path().join("a.exr"), &image).unwrap();
    folder
}

#[test]
fn help_and_version_go_to_stdout_with_exit_code_0() {
    let folder = folder("");
    for (line, expected) in [
        (&["--help"][..], "compare"),
        (&["--help"], "Exit codes: 0 done, 1 bad input or failed work, 2 wrong usage"),
        (&["--version"], concat!("smoke-bake ", env!("CARGO_PKG_VERSION"))),
        (&["compare", "--help"], "--mask-alpha"),
        (&["help", "compare"], "--mask-alpha"),
    ] {
        let output = smoke_bake(folder.path(), line, &[]);
        assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), ""), "{line:?}");
        let words = text(&output.stdout).split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words.contains(expected), "{line:?}: {words}");
    }
}

#[test]
fn wrong_usage_goes_to_stderr_with_exit_code_2() {
    let folder = folder("");
    for (line, expected) in [
        (&[][..], "Usage"),
        (&["relight"], "unrecognized subcommand 'relight'"),
        (&["compare", "a.exr"], "<REFERENCE>"),
        (&["compare", "a.exr", "a.exr", "--jsn"], "'--json'"),
        (&["compare", "a.exr", "a.exr", "-o", "d.jpg"], "expected a name that ends in .png or .exr"),
        (&["compare", "a.exr", "a.exr", "--scale", "0"], "expected a finite number above zero"),
        (&["compare", "a.exr", "a.exr", "--passes", "1"], "expected a whole number of at least 2"),
        (&["compare", "a.exr", "a.exr", "--pixels-per-degree", "0"], "expected a number from 1 to 1000"),
    ] {
        let output = smoke_bake(folder.path(), line, &[]);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(2), ""), "{line:?}");
        assert!(text(&output.stderr).contains(expected), "{line:?}: {}", text(&output.stderr));
    }
}

/// The scale of the false colours that a run used.
fn scale_used(settings: &str, variables: &[(&str, &str)], flags: &[&str]) -> f64 {
    let folder = folder(settings);
    let line = [&["compare", "a.exr", "a.exr", "--json", "-o", "d.png"], flags].concat();
    let output = smoke_bake(folder.path(), &line, variables);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    json["difference"]["scale"].as_f64().unwrap()
}

#[test]
fn a_flag_wins_over_a_variable_and_a_variable_over_the_file() {
    let (file, variable) = ("[compare]\nscale = 2.0\n", [("SMOKE_BAKE_SCALE", "3")]);
    assert_eq!(scale_used(file, &[], &[]), 2.0);
    assert_eq!(scale_used(file, &variable, &[]), 3.0);
    assert_eq!(scale_used(file, &variable, &["--scale", "4"]), 4.0);
    assert_eq!(scale_used("", &variable, &[]), 3.0);
}

#[test]
fn a_switch_can_be_set_in_the_file() {
    let folder = folder("[compare]\njson = true\n");
    let output = smoke_bake(folder.path(), &["compare", "a.exr", "a.exr"], &[]);
    assert!(serde_json::from_slice::<serde_json::Value>(&output.stdout).is_ok());
}

#[test]
fn a_wrong_settings_file_is_named_with_its_line_and_key() {
    for (settings, expected) in [
        ("[compare]\nscael = 2", "smoke-bake: smoke-bake.toml: line 2, column 9: compare.scael: found an unknown key"),
        ("[compare]\nscale = -2", "smoke-bake: smoke-bake.toml: line 2, column 9: compare.scale: found -2"),
        ("[compare]\noutput = \"d.png\"", "smoke-bake: smoke-bake.toml: line 2, column 10: compare.output"),
        ("[comparison]\n", "smoke-bake: smoke-bake.toml: line 1, column 1: comparison: found an unknown key"),
        ("[compare\n", "smoke-bake: smoke-bake.toml: line 1"),
    ] {
        let folder = folder(settings);
        let output = smoke_bake(folder.path(), &["compare", "a.exr", "a.exr"], &[]);
        assert_eq!((output.status.code(), text(&output.stdout)), (Some(1), ""), "{settings}");
        let message = text(&output.stderr);
        assert!(message.starts_with(expected) && message.matches('\n').count() == 1, "{message}");
    }
}

#[test]
fn a_reader_that_stops_early_is_no_failure() {
    let folder = folder("");
    let mut command = Command::new(env!("CARGO_BIN_EXE_smoke-bake"));
    command.args(["compare", "a.exr", "a.exr"]).current_dir(folder.path());
    let mut child = command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), ""));
}

/// The first code block of the guide that starts with `start`.
fn guide_block(start: &str) -> String {
    let guide = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/guide.md")).unwrap();
    let mut blocks = guide.split("```").skip(1).step_by(2).map(|b| b.split_once('\n').unwrap().1.to_owned());
    blocks.find(|b| b.starts_with(start)).unwrap_or_else(|| panic!("no block of the guide starts with {start}"))
}

#[test]
fn the_files_and_messages_of_the_guide_are_true() {
    let scene = smoke_formats::scene::Scene::parse(Path::new("scene.toml"), &guide_block("[world]")).unwrap();
    assert_eq!((scene.lights.len(), scene.width), (3, 800));
    let settings = guide_block("# smoke-bake.toml").replace("mask-alpha = true", "");
    assert_eq!(scale_used(&settings, &[], &[]), 0.05);
    let folder = folder("[compare]\nscael = 2");
    let output = smoke_bake(folder.path(), &["compare", "a.exr", "a.exr"], &[]);
    assert_eq!(text(&output.stderr), guide_block("smoke-bake: "));
}
