//! The command line: subcommands and their options, and nothing that acts on them.
//!
//! Each option's variable and settings key come from its long name (see `layers`).

use clap::{Args, Parser, Subcommand, ValueEnum};
use smoke_formats::sequence::FrameSelection;
use std::path::PathBuf;

const LAYERS_HELP: &str = "\
Every option --like-this (but --output) also reads the variable SMOKE_BAKE_LIKE_THIS, and the key like-this in the \
subcommand's table of smoke-bake.toml in the working directory. Flags win over variables, variables over the file.

Exit codes: 0 done, 1 bad input or failed work, 2 wrong usage. Answers go to stdout, everything else to stderr.";

/// Bakes smoke sequences once into compact, relightable packs, and renders them.
#[derive(Debug, Parser)]
#[command(name = "smoke-bake", version, max_term_width = 110, after_help = LAYERS_HELP)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Bake a sequence of volumes into one pack.
    Bake(BakeArgs),
    /// Render frames of a pack to OpenEXR.
    Render(RenderArgs),
    /// Show what a pack holds: sequence, settings, and sizes, errors and seconds of every frame.
    Inspect(InspectArgs),
    /// Check every byte of a pack and name the first thing that is wrong.
    Validate(ValidateArgs),
    /// Decode a pack's frames to OpenVDB or Mitsuba volumes.
    Unpack(UnpackArgs),
    /// Measure how far an image is from a reference: RMSE, PSNR, bias, largest error.
    Compare(CompareArgs),
    /// Bake and render a small plume that comes with the program, and relight it.
    Demo(DemoArgs),
}

/// Options of `compare`.
#[derive(Args, Debug)]
pub struct CompareArgs {
    /// The image under test: EXR or Radiance HDR with R, G, B.
    pub image: PathBuf,
    /// The image to measure against, of the same size.
    pub reference: PathBuf,
    /// Compare only pixels where the alpha of either image is above zero.
    #[arg(long)]
    pub mask_alpha: bool,
    /// Write the difference: .png in false colour (red too bright, blue too dark), .exr as signed numbers.
    #[arg(short, long, value_name = "PATH", value_parser = difference_path)]
    pub output: Option<PathBuf>,
    /// Error at which the false colours are full [default: three times the RMSE].
    #[arg(long, value_name = "RADIANCE", value_parser = positive)]
    pub scale: Option<f64>,
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

/// How progress is shown; `bake` and `render` take it as `--progress`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, lines otherwise.
    #[default]
    Auto,
    /// A bar with rate and time left.
    Bar,
    /// A line every few seconds.
    Plain,
    /// Lines for Open Job Description: `openjd_progress: 12.5`.
    Openjd,
    /// Nothing.
    None,
}

/// Which scattering orders are rendered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ScatteringOrder {
    /// Light that was scattered once.
    Single,
    /// Light of all orders.
    #[default]
    All,
}

/// Where the source radiance is solved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum RouteChoice {
    /// On grid nodes.
    #[default]
    Grid,
    /// At the Gaussians' centres, as Zhou et al. 2008 do.
    Centres,
}

/// From optical depth to transmittance, at centres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ExponentialChoice {
    /// True depths along directions; right at any depth.
    #[default]
    Direct,
    /// Harmonics of the depth, exponentiated along directions; good to depth 3.
    Pointwise,
    /// Optimal linear with scaling and squaring; good to depth 1.
    Hybrid,
    /// Optimal linear, the paper's; good to depth 0.5.
    Linear,
}

/// How light that scatters more than once is found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum MultipleChoice {
    /// Integral transport on grid nodes.
    Transport,
    /// Integral transport between centres.
    Integral,
    /// Diffusion between centres, the paper's, corrected.
    Diffusion,
}

/// How the addresses of the residual's voxels are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ResidualAddress {
    /// Perfect spatial hash: two reads a voxel.
    Hash,
    /// Bit mask with ranks: never fails, smaller above a few per cent of occupancy.
    Rank,
    /// The smaller of the two, frame by frame.
    #[default]
    Auto,
}

/// Which Gaussians are moved to where they are needed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum TeleportRule {
    /// Several at once, by expected gain and loss.
    #[default]
    Batch,
    /// The one of least integral, to the voxel of largest error (Zhou et al. 2008).
    Single,
}

/// How many Gaussians later frames have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum GaussianCount {
    /// As many as the first, as far as they are of use.
    #[default]
    Steady,
    /// What deletion and insertion by the error ratio leave (Zhou et al. 2008).
    Adaptive,
}

/// How sections lie in the pack.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum AtRest {
    /// Compressed; unpacked when a frame is loaded.
    #[default]
    Compressed,
    /// Ready to be mapped and uploaded.
    Raw,
}

/// Options of `bake`.
#[derive(Args, Debug)]
pub struct BakeArgs {
    /// The sequence: plume.####.vdb, plume.%04d.vdb, plume.$F4.vdb, @ for one digit, or any one file of it.
    pub input: PathBuf,
    /// The pack to write.
    #[arg(short, long, value_name = "PACK")]
    pub output: PathBuf,
    /// Name of the density grid.
    #[arg(long, default_value = "density")]
    pub grid: String,
    /// Frames to bake: 1001-1064, 1001-1064x2, 1,5,9 [default: all there are].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Gaussians in the first frame; 0 leaves everything to the residual.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u32).range(0..=65536))]
    pub gaussians: u32,
    /// Smallest radius, in lengths of the box's longest side.
    #[arg(long, value_name = "R", default_value_t = 0.015, value_parser = positive)]
    pub radius_min: f64,
    /// Largest radius, in lengths of the box's longest side.
    #[arg(long, value_name = "R", default_value_t = 0.09, value_parser = positive)]
    pub radius_max: f64,
    /// Smallest weight, as a part of the largest density.
    #[arg(long, value_name = "W", default_value_t = 0.01, value_parser = positive)]
    pub weight_min: f64,
    /// Largest weight, as a part of the largest density.
    #[arg(long, value_name = "W", default_value_t = 1.0, value_parser = positive)]
    pub weight_max: f64,
    /// Evaluations of the fit's error in the first frame.
    #[arg(long, value_name = "N", default_value_t = 200)]
    pub first_evaluations: u32,
    /// Evaluations of the fit's error in a later frame, without those after insertions.
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub next_evaluations: u32,
    /// Iterations between two moves of the least useful Gaussian in the first frame; 0 for never.
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub teleport_every: u32,
    /// Which Gaussians move then.
    #[arg(long, value_enum, default_value_t)]
    pub teleport_rule: TeleportRule,
    /// How many Gaussians a later frame has.
    #[arg(long, value_enum, default_value_t)]
    pub count: GaussianCount,
    /// Error over the first frame's error at which a later frame gets another Gaussian.
    #[arg(long, value_name = "RATIO", default_value_t = 1.1, value_parser = positive)]
    pub rho: f64,
    /// Gaussians that a later frame drops before it is fitted.
    #[arg(long, value_name = "N", default_value_t = 3)]
    pub delete: u32,
    /// Most Gaussians that a later frame adds.
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub insert_max: u32,
    /// Largest error of any voxel, in the density's unit.
    #[arg(long, value_name = "DENSITY", conflicts_with = "psnr", value_parser = positive)]
    pub max_error: Option<f64>,
    /// Least PSNR over the active voxels, in dB, peak = largest density.
    #[arg(long, value_name = "DB", value_parser = positive)]
    pub psnr: Option<f64>,
    /// Addresses of the residual's voxels.
    #[arg(long, value_enum, default_value_t)]
    pub residual: ResidualAddress,
    /// Sections compressed, or raw for mapping.
    #[arg(long, value_enum, default_value_t)]
    pub at_rest: AtRest,
    /// Every N-th frame can be read alone; those between are smaller, and need the ones before them back to there.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub key_every: u32,
    /// Replace negative and non-finite densities by zero, and report them, instead of stopping.
    #[arg(long)]
    pub clamp: bool,
    /// Continue an interrupted bake; the result has the same bytes as an uninterrupted one.
    #[arg(long)]
    pub resume: bool,
    /// Read and check the input, say what would be done, write nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Frames per second of the sequence, kept in the pack [default: not stated].
    #[arg(long, value_name = "FPS", value_parser = positive)]
    pub fps: Option<f64>,
    /// Seed of the search for perfect hashes, the only random choice.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
    /// Print one JSON document with sizes, errors and seconds per stage.
    #[arg(long)]
    pub json: bool,
}

/// Options of `render`.
#[derive(Args, Debug)]
pub struct RenderArgs {
    /// The pack.
    pub pack: PathBuf,
    /// The scene file.
    #[arg(long, value_name = "SCENE")]
    pub scene: PathBuf,
    /// The images to write, such as out.####.exr; also %04d, $F4 or @@@@, or a plain name for one frame.
    #[arg(short, long, value_name = "PATTERN", value_parser = exr_pattern)]
    pub output: PathBuf,
    /// Frames to render [default: all in the pack].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Where the source radiance is solved.
    #[arg(long, value_enum, default_value_t)]
    pub route: RouteChoice,
    /// Scattering orders.
    #[arg(long, value_enum, default_value_t)]
    pub order: ScatteringOrder,
    /// Order of the spherical harmonics of phase function and source radiance.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u8).range(1..=6))]
    pub sh_order: u8,
    /// Beams that an environment is cut into (route grid) [default: 64].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65536))]
    pub beams: Option<u32>,
    /// Voxels between nodes of single scattering (route grid) [default: 1, more in huge frames].
    #[arg(long, value_name = "VOXELS", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub source_step: Option<u32>,
    /// Voxels between nodes of multiple scattering (route grid) [default: 2; 1 in thick smoke, more in huge frames].
    #[arg(long, value_name = "VOXELS", value_parser = clap::value_parser!(u32).range(1..=64))]
    pub scatter_step: Option<u32>,
    /// Rings of directions that multiple scattering is gathered along; twice as many in azimuth [default: 5].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(2..=32))]
    pub scatter_rings: Option<u8>,
    /// Bands of the phase function that multiple scattering keeps, at most --sh-order [default: 3].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=6))]
    pub scatter_order: Option<u8>,
    /// From optical depth to transmittance (route centres) [default: direct].
    #[arg(long, value_enum)]
    pub exponential: Option<ExponentialChoice>,
    /// Light scattered more than once [default: transport with route grid, integral with route centres].
    #[arg(long, value_enum)]
    pub multiple: Option<MultipleChoice>,
    /// Voxels between samples along a ray [default: 1, less where the medium is thick].
    #[arg(long, value_name = "VOXELS", value_parser = march_step)]
    pub march_step: Option<f64>,
    /// Transmittance below which a ray ends.
    #[arg(long, value_name = "T", default_value_t = 0.001, value_parser = cutoff)]
    pub cutoff: f64,
    /// Rays along a side of a pixel: N x N rays a pixel.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=64))]
    pub samples: u8,
    /// Instead of the scene's sigma_t: a number, or R,G,B.
    #[arg(long, value_name = "RGB", value_parser = rgb)]
    pub sigma_t: Option<Rgb>,
    /// Instead of the scene's albedo: a number, or R,G,B.
    #[arg(long, value_name = "RGB", value_parser = rgb)]
    pub albedo: Option<Rgb>,
    /// Instead of the scene's g.
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    pub g: Option<f64>,
    /// Instead of the scene's width.
    #[arg(long, value_name = "PIXELS")]
    pub width: Option<u32>,
    /// Instead of the scene's height.
    #[arg(long, value_name = "PIXELS")]
    pub height: Option<u32>,
    /// Store R, G, B, A in 32 bits instead of 16.
    #[arg(long)]
    pub float: bool,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
    /// Print one JSON document with settings and seconds per stage and frame.
    #[arg(long)]
    pub json: bool,
}

/// Three channels.
pub type Rgb = [f64; 3];

/// Options of `inspect`.
#[derive(Args, Debug)]
pub struct InspectArgs {
    /// The pack.
    pub pack: PathBuf,
    /// Print one JSON document.
    #[arg(long)]
    pub json: bool,
}

/// Options of `validate`.
#[derive(Args, Debug)]
pub struct ValidateArgs {
    /// The pack.
    pub pack: PathBuf,
}

/// Options of `unpack`.
#[derive(Args, Debug)]
pub struct UnpackArgs {
    /// The pack.
    pub pack: PathBuf,
    /// The volumes to write, such as out.####.vdb or out.####.vol.
    #[arg(short, long, value_name = "PATTERN", value_parser = volume_pattern)]
    pub output: PathBuf,
    /// Frames to unpack [default: all in the pack].
    #[arg(long, value_name = "RANGE")]
    pub frames: Option<FrameSelection>,
    /// Store densities in 16 bits instead of 32 (VDB only); the error that this adds is reported.
    #[arg(long)]
    pub half: bool,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
}

/// Options of `demo`.
#[derive(Args, Debug)]
pub struct DemoArgs {
    /// The folder to fill: the inputs, a pack, rendered frames and a contact sheet.
    pub output: PathBuf,
    /// Threads; the result does not depend on it [default: one for each core].
    #[arg(long, value_name = "N", value_parser = threads)]
    pub threads: Option<usize>,
    /// How progress is shown.
    #[arg(long, value_enum, default_value_t)]
    pub progress: ProgressMode,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 => Ok(v),
        _ => Err("expected a finite number above zero".into()),
    }
}

/// One number for R, G and B, or three with commas.
fn rgb(text: &str) -> Result<[f64; 3], String> {
    let values: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    match values.as_deref() {
        Ok([v]) if v.is_finite() => Ok([*v; 3]),
        Ok([r, g, b]) if [r, g, b].iter().all(|v| v.is_finite()) => Ok([*r, *g, *b]),
        _ => Err("expected a number, or three as R,G,B".into()),
    }
}

fn difference_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("png" | "exr") => Ok(path),
        _ => Err("expected a name that ends in .png or .exr".into()),
    }
}

fn exr_pattern(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("exr") => Ok(path),
        _ => Err("expected a name that ends in .exr".into()),
    }
}

fn march_step(text: &str) -> Result<f64, String> {
    let in_range = |v: &f64| (1.0 / 64.0..=4.0).contains(v);
    positive(text).ok().filter(in_range).ok_or_else(|| "expected voxels from 1/64 to 4".into())
}

fn threads(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|n| (1..=1024).contains(n)).ok_or_else(|| "expected 1 to 1024".into())
}

fn cutoff(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if (0.0..1.0).contains(&v) => Ok(v),
        _ => Err("expected a transmittance from 0 to below 1".into()),
    }
}

fn volume_pattern(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("vdb" | "vol") => Ok(path),
        _ => Err("expected a name that ends in .vdb or .vol".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{CommandFactory, FromArgMatches};

    #[test]
    fn the_definitions_of_all_subcommands_are_sound() {
        Cli::command().debug_assert();
    }

    fn parse<A: Args + FromArgMatches>(line: &[&str]) -> Result<A, clap::Error> {
        let command = A::augment_args(clap::Command::new("x").no_binary_name(true));
        A::from_arg_matches(&command.try_get_matches_from(line)?)
    }

    #[test]
    fn bake_takes_one_error_target_and_has_the_papers_defaults() {
        let args: BakeArgs = parse(&["in.####.vdb", "-o", "a.smoke", "--psnr", "47"]).unwrap();
        assert_eq!((args.gaussians, args.radius_min, args.radius_max, args.delete), (1000, 0.015, 0.09, 3));
        assert_eq!((args.psnr, args.max_error, args.residual), (Some(47.0), None, ResidualAddress::Auto));
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--psnr", "47", "--max-error", "0.1"]).is_err());
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--max-error", "nan"]).is_err());
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--gaussians", "65537"]).is_err());
    }

    #[test]
    fn render_takes_a_number_or_three_for_colours() {
        let line = ["a.smoke", "--scene", "s.toml", "-o", "out.####.exr", "--sigma-t", "8", "--albedo", ".9,.8,.7"];
        let args: RenderArgs = parse(&[&line[..], &["--g", "-0.5"]].concat()).unwrap();
        assert_eq!((args.sigma_t, args.albedo, args.g), (Some([8.0; 3]), Some([0.9, 0.8, 0.7]), Some(-0.5)));
        assert!(parse::<RenderArgs>(&[&line[..5], &["--sigma-t", "1,2"]].concat()).is_err());
        assert!(parse::<RenderArgs>(&[&line[..5], &["--sh-order", "7"]].concat()).is_err());
    }
}
