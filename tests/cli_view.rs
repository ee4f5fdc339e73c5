//! `view` through the binary: what it says without its window, and a screenshot of the window on a display of its own.
//!
//! The window needs a display and a graphics driver. `SMOKE_GPU` decides: `off` leaves its test out, `auto` (the default)
//! runs it where `xvfb-run` is, `require` fails where it cannot run. What was done is printed.

mod common;

#[cfg(not(feature = "view"))]
#[test]
fn without_its_window_view_says_how_to_build_it() {
    let folder = tempfile::tempdir().unwrap();
    let message = common::refusal(folder.path(), &["view", "a.smoke"]);
    assert!(message.contains("--features view"), "{message}");
}

#[cfg(feature = "view")]
mod window {
    use super::common;
    use std::path::Path;
    use std::process::{Command, Output};

    /// Bakes two frames of the plume, coarsely.
    fn bake(folder: &Path) {
        let fit = ["--gaussians", "40", "--first-evaluations", "20", "--next-evaluations", "6", "--max-error", "0.004"];
        let line = ["bake", common::PLUME, "-o", "p.smoke", "--frames", "7-8", "--progress", "none"];
        common::answer(folder, &[&line[..], &fit].concat());
    }

    /// Runs the program on a display of its own.
    fn on_a_display(folder: &Path, line: &[&str]) -> std::io::Result<Output> {
        let mut command = Command::new("xvfb-run");
        command.args(["-a", "-s", "-screen 0 1280x800x24", env!("CARGO_BIN_EXE_smoke-bake")]).args(line);
        // Drivers write there, and complain where it is not set.
        command.current_dir(folder).env("XDG_RUNTIME_DIR", folder).env_remove("WAYLAND_DISPLAY").output()
    }

    /// Whether the test of the window is to run, and whether it must.
    fn wanted() -> Option<bool> {
        match common::gpu_mode().as_str() {
            "off" => None,
            mode => Some(mode == "require"),
        }
    }

    /// Why the window cannot open here, if that is what the output says.
    fn missing(output: &std::io::Result<Output>) -> Option<String> {
        match output {
            Err(e) => Some(format!("xvfb-run: {e}")),
            Ok(output) => {
                let said = String::from_utf8_lossy(&output.stderr);
                said.lines().find(|line| line.contains("cannot open its window")).map(str::to_owned)
            }
        }
    }

    /// The PNG as bytes of sRGB, by another way than the program's.
    fn read_png(path: &Path) -> (u32, u32, Vec<[u8; 3]>) {
        let image = image::open(path).unwrap().into_rgb8();
        (image.width(), image.height(), image.pixels().map(|p| p.0).collect())
    }

    #[test]
    fn a_screenshot_shows_the_smoke_and_a_legible_panel() {
        let Some(must) = wanted() else { return eprintln!("SMOKE_GPU=off: the window is not tested") };
        let folder = tempfile::tempdir().unwrap();
        bake(folder.path());
        let line = ["view", "p.smoke", "--screenshot", "shot.png", "--seconds", "1"];
        let output = on_a_display(folder.path(), &line);
        if let Some(why) = missing(&output) {
            assert!(!must, "SMOKE_GPU=require: {why}");
            return eprintln!("SMOKE_GPU=auto: the window is not tested: {why}");
        }
        let output = output.unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(0), "{said}");
        let (width, height, pixels) = read_png(&folder.path().join("shot.png"));
        assert_eq!((width, height), (1280, 800));
        eprintln!("the window was tested: {width} x {height}");
        let at = |x: u32, y: u32| pixels[(x + width * y) as usize];
        let count = |xs: std::ops::Range<u32>, test: &dyn Fn([u8; 3]) -> bool| {
            xs.flat_map(|x| (0..height).map(move |y| (x, y))).filter(|&(x, y)| test(at(x, y))).count()
        };
        // Smoke under the sun is brighter than the sky, which is blue, and fills some of the picture but not most of it.
        let smoke = count(0..960, &|[r, _, b]| r > 150 && r + 10 >= b);
        assert!((20_000..400_000).contains(&smoke), "{smoke} pixels of smoke");
        let sky = count(0..960, &|[r, _, b]| b > r + 15);
        assert!(sky > 200_000, "{sky} pixels of sky");
        // Text: light strokes on a dark ground, thinner than a tenth of it.
        let [light, dark] = [count(970..1280, &|p| p.iter().all(|&v| v > 190)), count(970..1280, &|p| p[0] < 40)];
        assert!(light > 1500 && dark > 10 * light, "{light} light, {dark} dark pixels");
    }

    #[test]
    fn bad_input_is_one_line_and_opens_no_window() {
        let folder = tempfile::tempdir().unwrap();
        assert!(common::refusal(folder.path(), &["view", "none.smoke"]).contains("none.smoke"));
        std::fs::write(folder.path().join("a.smoke"), "no pack").unwrap();
        assert!(common::refusal(folder.path(), &["view", "a.smoke"]).starts_with("smoke-bake: a.smoke: "));
        let output = common::smoke_bake(folder.path(), &["view", "a.smoke", "--seconds", "2"]);
        assert_eq!(output.status.code(), Some(2), "--seconds is for a screenshot");
    }

    #[test]
    fn without_a_display_one_line_says_what_is_missing() {
        let folder = tempfile::tempdir().unwrap();
        bake(folder.path());
        let mut command = common::command(folder.path(), &["view", "p.smoke"]);
        let output = command.env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET").output();
        let output = output.unwrap();
        let message = common::text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{message}");
        assert!(message.contains("view needs a display") && message.matches('\n').count() == 1, "{message}");
    }
}
