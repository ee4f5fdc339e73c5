//! `sweep` through the binary, on the shipped plume at thumbnail size: tables, page, axes, a kill and what follows it, and
//! bad input.

mod common;

use common::{answer, command, refusal, smoke_bake, text};
use serde_json::Value;
use std::path::Path;
use std::process::Stdio;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// Light from everywhere and a sun, on the shipped plume; quick to read.
const SCENE: &str = "[camera]\nposition = [1.1, -3.5, 0.95]\ntarget = [1.37, 1.3, 1.64]\nfov = 29.0\n[image]\nwidth = 30\n\
                     height = 40\n[medium]\nsigma_t = 8\nalbedo = 0.9\n[[light]]\nkind = \"environment\"\n\
                     color = [0.4, 0.6, 1.0]\n[[light]]\nkind = \"directional\"\ndirection = [1, 0.4, -0.5]\n\
                     irradiance = [3, 2, 1]\n";

/// A folder with the scene, and a quickly made pack of frame 8.
static FOLDER: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.toml"), SCENE).unwrap();
    let fit = ["--gaussians", "40", "--first-evaluations", "10", "--max-error", "0.004"];
    let line = ["bake", common::PLUME, "-o", "plume.smoke", "--frames", "8", "--progress", "none"];
    answer(folder.path(), &[&line[..], &fit].concat());
    folder
});

/// A sweep of `input` into `output`, with what makes it quick.
fn line<'a>(input: &'a str, output: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let line = ["sweep", input, "--scene", "scene.toml", "-o", output, "--progress", "none"];
    [&line[..], &["--frames", "8", "--repeat", "1", "--reference-error", "5%"], more].concat()
}

/// The CSV of a sweep without its seconds: a line of names, and the rows.
fn rows(folder: &Path) -> (Vec<String>, Vec<Vec<String>>) {
    let csv = std::fs::read_to_string(folder.join("sweep.csv")).unwrap();
    // The last column, the settings, is the only one with commas.
    let split = |line: &str, columns: usize| line.splitn(columns, ',').map(str::to_owned).collect::<Vec<_>>();
    let names = split(csv.lines().next().unwrap(), 99);
    let keep: Vec<usize> = (0..names.len()).filter(|&i| !names[i].ends_with("_seconds")).collect();
    let pick = |row: Vec<String>| keep.iter().map(|&i| row[i].clone()).collect::<Vec<_>>();
    let rows = csv.lines().skip(1).map(|line| pick(split(line, names.len()))).collect();
    (pick(names), rows)
}

#[test]
fn a_sweep_of_volumes_measures_every_dial_and_writes_tables_and_one_page() {
    let folder = FOLDER.path();
    let bake = ["--set", "gaussians=40", "--set", "first-evaluations=10", "--set", "scatter-step=8"];
    let dials = ["--dial", "source-step=4", "--dial", "max-error=0.004,0.1", "--json"];
    let said = answer(folder, &line(common::PLUME, "volumes", &[&bake[..], &dials].concat()));
    let json: Value = serde_json::from_str(&said).unwrap();
    let out = folder.join("volumes");
    assert_eq!(said, std::fs::read_to_string(out.join("sweep.json")).unwrap());
    let error = |row: usize| json["rows"][row]["relative_rmse"].as_f64().unwrap();
    let bits = |row: usize| json["rows"][row]["bits_per_active_voxel"].as_f64().unwrap();
    let name = |row: usize| format!("{} {}", json["rows"][row]["dial"], json["rows"][row]["value"]);
    let expected = ["defaults ", "source-step 4", "max-error 0.004", "max-error 0.1"];
    assert_eq!([0, 1, 2, 3].map(|row| name(row).replace('"', "")), expected);
    assert!(json["rows"].as_array().unwrap().len() == 4 && json["refused"].as_array().unwrap().is_empty());
    // Against the volume itself, a looser promise is a larger error in fewer bits; the method's own error is far below.
    assert!(error(0) < 0.2 && error(3) > 1.2 * error(2) && bits(3) < 0.7 * bits(2), "{said}");
    for row in 0..4 {
        let seconds = |stage: &str| json["rows"][row]["seconds"][stage].as_f64().unwrap();
        let parts = ["decode", "source_radiance", "volume_pass", "view_pass"].map(seconds);
        assert!(parts.iter().all(|s| *s > 0.0) && (parts.iter().sum::<f64>() - seconds("total")).abs() < 1e-9);
        assert_eq!(json["rows"][row]["settings"]["scatter_step"], 8);
    }
    let reference = &json["references"][0];
    assert!((reference["width"].as_i64(), reference["height"].as_i64()) == (Some(30), Some(40)));
    let curve: Vec<f64> = (0..reference["curve"].as_array().unwrap().len())
        .map(|i| reference["curve"][i]["relative_standard_error"].as_f64().unwrap())
        .collect();
    assert!(curve.len() >= 4 && curve[curve.len() - 1] < 0.7 * curve[0], "{curve:?}");
    let page = std::fs::read_to_string(out.join("index.html")).unwrap();
    assert!(page.ends_with("</html>\n") && !page.contains("http"));
    // The reference, and four rows with their differences; one of the two plots of all rows, one of packs, two of dials.
    assert_eq!((page.matches("<img").count(), page.matches("role=\"img\"").count()), (1 + 2 * 4, 4));
}

#[test]
fn a_killed_sweep_continues_and_ends_with_the_same_rows() {
    let folder = FOLDER.path();
    let dials = ["--dial", "route=grid,centres", "--dial", "sh-order=1,2", "--vary", "albedo=0.5,0.9"];
    answer(folder, &line("plume.smoke", "whole", &[&dials[..], &["--threads", "2"]].concat()));
    let (names, expected) = rows(&folder.join("whole"));
    assert_eq!(names[..6], ["scene", "albedo", "frame", "method", "dial", "value"]);
    assert_eq!(expected.len(), 2 * 6);
    assert!(expected.iter().all(|row| row[0] == "scene.toml" && row[2] == "8"));
    assert_eq!((expected[0][1].as_str(), expected[11][1].as_str()), ("0.5", "0.9"));

    let again = line("plume.smoke", "killed", &[&dials[..], &["--threads", "2"]].concat());
    let mut child = command(folder, &again).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let journal = folder.join("killed/journal.jsonl");
    let kept = || std::fs::read_to_string(&journal).map_or(0, |text| text.lines().count());
    let start = Instant::now();
    while kept() < 4 && start.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let before = std::fs::read_to_string(&journal).unwrap();
    assert!(before.lines().count() >= 4 && !folder.join("killed/sweep.csv").exists(), "killed too early or too late");
    answer(folder, &[&again[..], &["--resume"]].concat());
    assert_eq!(rows(&folder.join("killed")), (names, expected));
    // What was there is what is there: nothing was measured twice.
    let after = std::fs::read_to_string(&journal).unwrap();
    let whole = before.rfind('\n').map_or("", |end| &before[..end]);
    assert!(whole.lines().skip(1).all(|line| after.contains(line)));
    let csv = std::fs::read(folder.join("killed/sweep.csv")).unwrap();
    answer(folder, &[&again[..], &["--resume"]].concat());
    assert!(csv == std::fs::read(folder.join("killed/sweep.csv")).unwrap(), "a finished sweep only reads");
}

#[test]
fn transfer_is_swept_beside_the_other_methods_and_left_out_of_frames_that_have_none() {
    let folder = FOLDER.path();
    let bake = ["--set", "gaussians=40", "--set", "first-evaluations=10", "--set", "clusters=32"];
    let transfer = ["--set", "transfer=hat42", "--set", "medium=medium.toml", "--set", "photons=1"];
    let dials = ["--dial", "method=compensated,transfer", "--dial", "clusters=1", "--json"];
    std::fs::write(folder.join("medium.toml"), SCENE).unwrap();
    let line = line(common::PLUME, "transfer", &[&bake[..], &transfer, &dials].concat());
    let said = answer(folder, &line);
    let json: Value = serde_json::from_str(&said).unwrap();
    let rows = json["rows"].as_array().unwrap();
    let of = |row: &Value| {
        let [method, dial] = ["method", "dial"].map(|name| row[name].as_str().unwrap().to_owned());
        (method.split(' ').next().unwrap_or_default().to_owned(), dial)
    };
    let expected =
        [("compensated", "defaults"), ("transfer", "defaults"), ("compensated", "clusters"), ("transfer", "clusters")];
    assert_eq!(rows.iter().map(of).collect::<Vec<_>>(), expected.map(|(a, b)| (a.to_owned(), b.to_owned())));
    let error = |row: usize| rows[row]["relative_rmse"].as_f64().unwrap();
    // The pack is the same to the fast method, whatever its transfer; one cluster of four terms keeps less than 32.
    assert!(error(0) == error(2) && error(1) < 0.1 && error(3) > error(1), "{said}");
    assert!(rows.iter().all(|row| row["seconds"]["source_radiance"].as_f64().unwrap() > 0.0));
    let page = std::fs::read_to_string(folder.join("transfer/index.html")).unwrap();
    assert!(page.contains(">transfer<") && page.matches("<img").count() == 1 + 2 * 4, "{page}");
    // Another medium in the file is another pack, also where a sweep goes on.
    std::fs::write(folder.join("medium.toml"), SCENE.replace("albedo = 0.9", "albedo = 0.8")).unwrap();
    let resumed = [&line[..], &["--resume"]].concat();
    let json: Value = serde_json::from_str(&answer(folder, &resumed)).unwrap();
    let refused = json["refused"].to_string();
    assert!(refused.contains("medium.albedo: found [0.9, 0.9, 0.9], expected [0.8"), "{refused}");

    let dial = ["--dial", "method=compensated,transfer", "--json"];
    let json: Value = serde_json::from_str(&answer(folder, &self::line("plume.smoke", "without", &dial))).unwrap();
    let refused = json["refused"].to_string();
    assert!(json["rows"].as_array().unwrap().len() == 1 && refused.contains("the frame has no transfer"), "{refused}");
}

#[test]
fn what_cannot_be_swept_is_refused_before_anything_is_written() {
    let folder = FOLDER.path();
    let refused = |input: &str, more: &[&str]| refusal(folder, &line(input, "nothing", more));
    let message = refused("plume.smoke", &["--dial", "gaussians=10"]);
    assert!(message.contains("plume.smoke: --dial gaussians") && message.contains("volumes"), "{message}");
    assert!(refused("none.smoke", &[]).contains("none.smoke"));
    assert!(refused("plume.smoke", &["--vary", "g=2"]).contains("medium.g"));
    for (more, named) in [
        (&["--dial", "shorder=1"][..], "sh-order"),
        (&["--dial", "sh-order=9"], "--sh-order"),
        (&["--dial", "sh-order=1", "--dial", "sh-order=2"], "given twice"),
        (&["--dial", "scatter-order=6"], "--scatter-order"),
        (&["--vary", "cutoff=0.1"], "sigma-t"),
        (&["--set", "cutoff=0.1,0.2"], "one value"),
        (&["--dial", "sh-order"], "NAME"),
        (&["--resume", "--resume"], "--resume"),
    ] {
        let output = smoke_bake(folder, &line("plume.smoke", "nothing", more));
        let message = text(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains(named), "{more:?}: {message}");
    }
    assert!(!folder.join("nothing").exists());
    let point = "\n[[light]]\nkind = \"point\"\nposition = [0, 0, 1]\nintensity = 10\n";
    std::fs::write(folder.join("point.toml"), SCENE.to_owned() + point).unwrap();
    let line = ["sweep", "plume.smoke", "--scene", "point.toml", "-o", "point", "--dial", "sh-order=2", "--width", "8"];
    let output = smoke_bake(folder, &[&line[..], &["--reference-error", "50%", "--progress", "none"]].concat());
    let message = text(&output.stderr);
    assert!(output.status.code() == Some(1) && message.contains("nothing could be measured"), "{message}");
    assert!(message.contains("sh-order 2: left out") && !folder.join("point/sweep.csv").exists());
    std::fs::create_dir(folder.join("strange")).unwrap();
    std::fs::write(folder.join("strange/index.html"), "the user's").unwrap();
    for more in [&[][..], &["--resume"]] {
        assert!(refusal(folder, &self::line("plume.smoke", "strange", more)).contains("other files"));
    }
    assert_eq!(std::fs::read_to_string(folder.join("strange/index.html")).unwrap(), "the user's");
}

#[test]
fn a_sweep_of_rungs_writes_rows_that_the_plans_table_takes() {
    let folder = FOLDER.path();
    // A grey medium under light that is not seen; two values on every axis, as a table wants them.
    let more = ["--vary", "sigma-t=0.5,8", "--vary", "g=0,0.5", "--vary", "albedo=0.5,0.9", "--threads", "2"];
    let rungs = ["--ladder=sketch,single-draft,centres,reference", "--width", "12"];
    let line = line("plume.smoke", "rungs", &[&rungs[..], &more].concat());
    answer(folder, &line);
    let text = std::fs::read_to_string(folder.join("rungs/measured.csv")).unwrap();
    let table = smoke_runtime::plan::table::Table::parse(&text).unwrap();
    let rows = smoke_runtime::plan::table::rows(&text).unwrap();
    assert_eq!(rows.len(), 4 * 8);
    let order: Vec<&str> = rows.iter().step_by(8).map(|row| row.rung.as_str()).collect();
    assert_eq!(order, ["single-draft", "sketch", "centres", "reference"]);
    assert!(rows.iter().all(|row| row.scene == "scene 8" && row.threads == 2 && row.seconds[2] > 0.0));
    // The rows of sweep.csv are the same measurements; the reference's is its noise, below the 5 % asked, over fewer
    // pixels than the whole image.
    let (names, swept) = self::rows(&folder.join("rungs"));
    let at = |name: &str| names.iter().position(|n| n == name).unwrap();
    assert_eq!(swept.len(), 3 * 8);
    for row in rows.iter().filter(|row| row.rung != "reference") {
        let same = |csv: &&Vec<String>| {
            let number = |name: &str| csv[at(name)].parse::<f64>().unwrap();
            csv[at("value")] == row.rung
                && number("g") == row.g
                && number("albedo") == row.albedo
                && (number("sigma-t") > 1.0) == (row.depth > 1.0)
        };
        let error: f64 = swept.iter().find(same).unwrap()[at("relative_rmse")].parse().unwrap();
        assert!((error - row.error).abs() <= 1e-4 * error, "{}: {error} {}", row.rung, row.error);
    }
    let found = |rung: &str| table.error_at(rung, 1.0, 0.0, 0.9, 0.0).unwrap();
    assert!(found("reference") < 0.06 && found("single-draft") > found("reference"));
    answer(folder, &[&line[..], &["--resume"]].concat());
    assert!(text == std::fs::read_to_string(folder.join("rungs/measured.csv")).unwrap(), "a finished sweep only reads");

    let changed =
        |name: &str, from: &str, to: &str| std::fs::write(folder.join(name), SCENE.replace(from, to)).unwrap();
    changed("seen.toml", "color =", "visible = true\ncolor =");
    changed("coloured.toml", "albedo = 0.9", "albedo = [0.9, 0.9, 0.8]");
    // What has no place in the table is refused before anything is written.
    for (more, named) in [
        (&["--ladder", "--set", "sh-order=2"][..], "--set sh-order does not apply to --ladder"),
        (&["--ladder", "--vary", "order=single"], "--vary order does not apply to --ladder"),
        (&["--ladder", "--scene", "seen.toml"], "seen.toml: light: found a visible sky"),
        (&["--ladder", "--scene", "coloured.toml"], "coloured.toml: medium: found a coloured one"),
        (&["--ladder", "--dial", "sh-order=2"], "--dial"),
        (&["--ladder=finest"], "finest"),
    ] {
        let output = smoke_bake(folder, &self::line("plume.smoke", "none", more));
        assert_ne!(output.status.code(), Some(0), "{more:?}");
        assert!(common::text(&output.stderr).contains(named), "{more:?}: {}", common::text(&output.stderr));
        assert!(!folder.join("none").exists());
    }
}
