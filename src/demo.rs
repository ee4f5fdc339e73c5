//! `smoke-bake demo OUT`: a small real plume, baked, rendered and relit, with every input that this takes.
//!
//! The inputs are compiled in, so that an installed program needs no checkout. They are written to OUT, and then the
//! demo runs the command lines that a user would type, and prints them: what it shows is what `bake` and `render` do.

use crate::cli::{Cli, DemoArgs};
use crate::contact_sheet::contact_sheet;
use crate::{answer, failure::Failure};
use clap::{Parser, ValueEnum};
use smoke_formats::image::{self, RgbImage};
use smoke_formats::{Error, atomic};
use std::ffi::OsString;
use std::path::Path;

macro_rules! input {
    ($path:literal) => {
        ($path, include_bytes!(concat!("../testdata/", $path)))
    };
}

/// What the demo needs, by its name in OUT.
const INPUTS: [(&str, &[u8]); 13] = [
    input!("plume/plume.0001.vdb"),
    input!("plume/plume.0002.vdb"),
    input!("plume/plume.0003.vdb"),
    input!("plume/plume.0004.vdb"),
    input!("plume/plume.0005.vdb"),
    input!("plume/plume.0006.vdb"),
    input!("plume/plume.0007.vdb"),
    input!("plume/plume.0008.vdb"),
    input!("scenes/sunset.toml"),
    input!("scenes/turned.toml"),
    input!("scenes/sun.toml"),
    input!("scenes/sunset.exr"),
    input!("scenes/sunset.license.txt"),
];

/// Frames of the plume.
const FRAMES: i32 = 8;

/// Options of the bake; Gaussians and promise are the defaults.
const BAKE: [&str; 2] = ["--fps", "8"];

/// The last frame in other lights and media: name, scene, further options of `render`.
const RELIT: [(&str, &str, &[&str]); 4] = [
    ("turned", "turned.toml", &[]),
    ("thin", "sunset.toml", &["--sigma-t", "6", "--g", "0.7"]),
    ("sun", "sun.toml", &[]),
    ("thick", "sun.toml", &["--sigma-t", "120"]),
];

/// Thumbnails in a row of the sheet, and the width of each in pixels.
const COLUMNS: usize = 4;
const THUMBNAIL: usize = 300;

/// Writes the inputs, bakes, renders the sequence and the relit last frame, and lays all out on one sheet.
pub fn run(args: &DemoArgs) -> Result<(), Failure> {
    let out = &args.output;
    for (name, bytes) in INPUTS {
        let path = out.join(name);
        folder(path.parent().unwrap_or(out))?;
        atomic::write_bytes(&path, bytes)?;
    }
    let work = Work { args };
    let path = |name: &str| out.join(name).into_os_string();
    let (volumes, pack) = (path("plume/plume.####.vdb"), path("plume.smoke"));
    work.run(&["bake".into(), volumes, "-o".into(), pack.clone()], &BAKE)?;

    folder(&out.join("frames"))?;
    let render = |scene: &str, to: &str, options: &[&str]| {
        let scene = path(&format!("scenes/{scene}"));
        let line = ["render".into(), pack.clone(), "--scene".into(), scene, "-o".into(), path(to)];
        work.run(&line, options)
    };
    render("sunset.toml", "frames/plume.####.exr", &[])?;
    let mut pictures: Vec<String> = (1..=FRAMES).map(|n| format!("frames/plume.{n:04}.exr")).collect();
    for (name, scene, options) in RELIT {
        let to = format!("frames/{name}.exr");
        render(scene, &to, &[&["--frames", &FRAMES.to_string()], options].concat())?;
        pictures.push(to);
    }

    let read = |name: &String| -> Result<RgbImage, Error> {
        let path = out.join(name);
        image::read(&path)?.rgb(&path)
    };
    let frames = pictures.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let sheet = out.join("contact_sheet.png");
    image::write_png(&sheet, &contact_sheet(&frames, COLUMNS, THUMBNAIL))?;
    let names = RELIT.map(|(name, _, _)| name).join(", ");
    let text = format!("rows 1 and 2: the plume over time; row 3: its last frame relit: {names}");
    answer::text(&format!("{}\n{text}\n", sheet.display()))
}

fn folder(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|e| Error::io(path, e))
}

/// Command lines, run one after the other.
struct Work<'a> {
    args: &'a DemoArgs,
}

impl Work<'_> {
    /// Shows the line `words` `options` and does what the program does when it is typed.
    fn run(&self, words: &[OsString], options: &[&str]) -> Result<(), Failure> {
        let mut line = vec![OsString::from("smoke-bake")];
        line.extend_from_slice(words);
        line.extend(options.iter().map(OsString::from));
        eprintln!("$ {}", line.iter().map(|w| w.to_string_lossy()).collect::<Vec<_>>().join(" "));
        // How the work is watched is no part of what is shown.
        if let Some(mode) = self.args.progress.to_possible_value() {
            line.extend(["--progress".into(), mode.get_name().into()]);
        }
        if let Some(threads) = self.args.threads {
            line.extend(["--threads".into(), threads.to_string().into()]);
        }
        crate::dispatch(Cli::try_parse_from(line)?.command)
    }
}
