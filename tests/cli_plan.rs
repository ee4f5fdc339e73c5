//! `plan` and `render --method auto` through the binary, on the shipped plume.

mod common;

use common::{answer, refusal, smoke_bake, text};
use serde_json::Value;
use std::path::Path;
use std::sync::LazyLock;

/// A folder with three frames of the shipped plume as `plume.smoke`, and scenes.
static BAKED: LazyLock<tempfile::TempDir> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let fit = ["--gaussians", "40", "--first-evaluations", "20", "--next-evaluations", "6", "--max-error", "0.004"];
    let line = ["bake", common::PLUME, "-o", "plume.smoke", "--frames", "6-8", "--progress", "none"];
    answer(folder.path(), &[&line[..], &fit].concat());
    let scene = |name: &str, lights: &str| {
        let camera = "[camera]\nposition = [1.1, -3.5, 0.95]\ntarget = [1.37, 1.3, 1.64]\nfov = 29.0\n";
        let medium = "[image]\nwidth = 60\nheight = 80\n[medium]\nsigma_t = 4.0\nalbedo = 0.92\n";
        std::fs::write(folder.path().join(name), format!("{camera}{medium}{lights}")).unwrap();
    };
    let sky = "[[light]]\nkind = \"environment\"\ncolor = [0.4, 0.6, 1.0]\n";
    let point = "[[light]]\nkind = \"point\"\nposition = [2, 0, 1]\nintensity = 10\n";
    scene("sky.toml", sky);
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/scenes/sunset.exr");
    std::fs::copy(shipped, folder.path().join("sunset.exr")).unwrap();
    scene("sunset.toml", "[[light]]\nkind = \"environment\"\nimage = \"sunset.exr\"\n");
    scene("point.toml", &format!("{sky}{point}"));
    scene("dark.toml", "");
    folder
});

/// The JSON of a plan.
fn plan(scene: &str, more: &[&str]) -> Value {
    let line = ["plan", "plume.smoke", "--scene", scene, "--json"];
    serde_json::from_str(&answer(BAKED.path(), &[&line[..], more].concat())).unwrap()
}

/// Renders frame 7; gives what was said on stderr, and the image's bytes.
fn render(scene: &str, more: &[&str]) -> (String, Vec<u8>) {
    let out = tempfile::tempdir().unwrap();
    let image = out.path().join("a.exr");
    let line = ["render", "plume.smoke", "--scene", scene, "-o", image.to_str().unwrap(), "--progress", "none"];
    let output = smoke_bake(BAKED.path(), &[&line[..], &["--frames", "7"], more].concat());
    assert_eq!(output.status.code(), Some(0), "{more:?}: {}", text(&output.stderr));
    (text(&output.stderr).to_owned(), std::fs::read(image).unwrap())
}

#[test]
fn thin_middle_and_thick_smoke_and_a_point_light_get_different_plans_each_with_its_reason() {
    let mut chosen = Vec::new();
    for (scene, sigma_t) in [("sunset.toml", "0.2"), ("sunset.toml", "4"), ("sunset.toml", "40"), ("point.toml", "4")] {
        let json = plan(scene, &["--sigma-t", sigma_t, "--error", "5%"]);
        let (rung, why) = (json["choice"]["rung"].as_str().unwrap(), json["choice"]["why"].as_str().unwrap());
        let of_rung = json["candidates"].as_array().unwrap().iter().find(|c| c["rung"] == rung).unwrap();
        let error = of_rung["error"].as_f64().unwrap();
        assert!(error <= 0.05, "{rung}: {error}");
        assert!(why.contains("5.0 %") || why.contains("found a point"), "{why}");
        chosen.push(rung.to_owned());
    }
    assert_eq!(chosen[3], "reference");
    // From thin to thick more has to be computed.
    let seconds = |sigma_t: &str, rung: &str| {
        let json = plan("sunset.toml", &["--sigma-t", sigma_t, "--error", "5%"]);
        let of_rung = json["candidates"].as_array().unwrap().iter().find(|c| c["rung"] == rung).unwrap().clone();
        of_rung["seconds"]["all"].as_f64().unwrap()
    };
    let mut different = chosen.clone();
    different.sort();
    different.dedup();
    assert_eq!(different.len(), 4, "{chosen:?}");
    assert!(seconds("40", &chosen[0]) < seconds("40", &chosen[2]));
}

#[test]
fn a_plan_names_what_it_saw_in_words_and_in_json() {
    let json = plan("sky.toml", &["--sigma-t", "4,4,2", "--g", "0.3"]);
    assert_eq!((json["frames"].as_i64(), json["choice"]["rung"].as_str()), (Some(3), Some("default")));
    let depth = &json["survey"]["optical_depth"]["p95"];
    assert!((depth[0].as_f64().unwrap() / depth[2].as_f64().unwrap() - 2.0).abs() < 1e-6);
    assert!(json["survey"]["mean_free_path"]["gaussian_radii"][0].as_f64().unwrap() > 0.0);
    assert!(json["light"]["bands"][0].as_f64().unwrap() > 0.999);
    let left = |name: &str| {
        let terms = json["terms"].as_array().unwrap();
        terms.iter().find(|t| t["term"] == name).unwrap()["left_out"].as_bool().unwrap()
    };
    assert!(!left("phase convolution") && !left("multiple scattering") && !left("two of three channels"));
    assert!(left("sky behind the smoke"));
    let words = answer(BAKED.path(), &["plan", "plume.smoke", "--scene", "sky.toml", "--time", "100ms"]);
    for expected in ["optical depth", "mean free path", "over time", "can serve", "left out", "candidates", "choice: "]
    {
        assert!(words.contains(expected), "{expected}: {words}");
    }
    assert!(words.contains("g is 0)") && words.contains("seconds"), "{words}");
}

#[test]
fn volumes_are_planned_for_without_a_bake_and_cannot_be_served_at_centres() {
    for input in [common::PLUME, common::plume(8).to_str().unwrap()] {
        let line = ["plan", input, "--scene", "sky.toml", "--frames", "8", "--json"];
        let json: Value = serde_json::from_str(&answer(BAKED.path(), &line)).unwrap();
        let centres = json["methods"].as_array().unwrap().iter().find(|m| m["method"] == "centres").unwrap().clone();
        assert!(centres["why_not"].as_str().unwrap().contains("no Gaussians"), "{centres}");
        // The same figures as from the pack, but for its promised error.
        let of_pack = plan("sky.toml", &["--frames", "8"]);
        let depth = |json: &Value| json["survey"]["optical_depth"]["p95"][1].as_f64().unwrap();
        assert!((depth(&json) / depth(&of_pack) - 1.0).abs() < 0.02, "{} {}", depth(&json), depth(&of_pack));
    }
}

#[test]
fn render_follows_the_plan_says_so_in_one_line_and_has_the_bytes_of_those_settings() {
    let (said, auto) = render("sky.toml", &[]);
    assert_eq!(said.lines().count(), 1, "{said}");
    assert!(
        said.starts_with("smoke-bake: default: ") && said.contains("left out: phase convolution (g is 0)"),
        "{said}"
    );
    let (nothing, explicit) = render("sky.toml", &["--method", "compensated"]);
    assert_eq!(nothing, "");
    assert!(auto == explicit, "the default plan is the default settings");
    for goal in [["--error", "5%"], ["--time", "0.2s"]] {
        let (one, a) = render("sky.toml", &[&goal[..], &["--threads", "1"]].concat());
        let (again, b) = render("sky.toml", &[&goal[..], &["--threads", "1"]].concat());
        assert!(a == b && one == again, "{goal:?}");
    }
    // An error is met by the same settings on any number of threads.
    let (_, one) = render("sky.toml", &["--error", "3%", "--threads", "1"]);
    let (_, two) = render("sky.toml", &["--error", "3%", "--threads", "2"]);
    assert!(one == two);
}

#[test]
fn dials_that_are_given_win_over_the_plan_and_the_reference_serves_where_nothing_else_can() {
    let (_, plain) = render("sky.toml", &["--error", "5%"]);
    let (_, dialled) = render("sky.toml", &["--error", "5%", "--beams", "7"]);
    assert!(plain != dialled);
    let (said, _) = render("point.toml", &["--error", "30%"]);
    assert!(said.starts_with("smoke-bake: reference: ") && said.contains("found a point"), "{said}");
    let (said, _) = render("dark.toml", &["--error", "5%"]);
    assert!(!said.contains("reference"), "{said}");
}

#[test]
fn what_is_wrong_is_named_in_one_line() {
    let folder: &Path = BAKED.path();
    let say = |line: &[&str]| {
        let output = smoke_bake(folder, line);
        (output.status.code(), text(&output.stderr).to_owned())
    };
    for (more, named) in [
        (&["--error", "0"][..], "--error"),
        (&["--error", "5%", "--time", "1s"], "--time"),
        (&["--time", "soon"], "100ms"),
        (&["--threads", "0"], "--threads"),
    ] {
        let (code, message) = say(&[&["plan", "plume.smoke", "--scene", "sky.toml"], more].concat());
        assert!(code == Some(2) && message.contains(named), "{message}");
    }
    let (code, message) = say(&[
        "render",
        "plume.smoke",
        "--scene",
        "sky.toml",
        "-o",
        "a.####.exr",
        "--method",
        "reference",
        "--error",
        "1%",
    ]);
    assert!(code == Some(2) && message.contains("--error"), "{message}");
    std::fs::write(folder.join("damaged.smoke"), b"\x93SMOKE\r\nand no more").unwrap();
    std::fs::write(folder.join("empty.smoke"), b"").unwrap();
    for (input, named) in [
        ("damaged.smoke", "damaged.smoke"),
        ("empty.smoke", "empty.smoke"),
        ("none.vdb", "none.vdb"),
        ("none.####.vdb", "none.####.vdb"),
        ("sky.toml", "kind of file"),
    ] {
        let message = refusal(folder, &["plan", input, "--scene", "sky.toml"]);
        assert!(message.contains(named), "{message}");
    }
    let message = refusal(folder, &["plan", "plume.smoke", "--scene", "sky.toml", "--frames", "99"]);
    assert!(message.contains("99"), "{message}");
    let message = refusal(folder, &["plan", common::PLUME, "--scene", "sky.toml", "--grid", "heat"]);
    assert!(message.contains("heat"), "{message}");
}
