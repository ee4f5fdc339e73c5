//! Options of `bake`.

use super::{ProgressMode, positive, threads};
use clap::{Args, ValueEnum};
use smoke_formats::sequence::FrameSelection;
use smoke_runtime::sphere::light_basis::BasisKind;
use std::path::PathBuf;

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

fn basis(text: &str) -> Result<BasisKind, String> {
    BasisKind::of_name(text).ok_or_else(|| "expected dsf or hat and 42, 162, 642 or 2562, or sh1 to sh6".into())
}

fn cell(text: &str) -> Result<u32, String> {
    let shift = (0..=4).find(|shift| text == (1u32 << shift).to_string());
    shift.ok_or_else(|| "expected 1, 2, 4, 8 or 16".into())
}

fn bytes(text: &str) -> Result<u64, String> {
    let split = text.find(|c: char| c.is_ascii_alphabetic()).unwrap_or(text.len());
    let unit = match &text[split..] {
        "KiB" => Some(1u64 << 10),
        "MiB" => Some(1 << 20),
        "GiB" => Some(1 << 30),
        "" | "B" => Some(1),
        _ => None,
    };
    let number: Option<u64> = text[..split].trim().parse().ok();
    let bytes = number.zip(unit).and_then(|(number, unit)| number.checked_mul(unit)).filter(|bytes| *bytes > 0);
    bytes.ok_or_else(|| "expected a whole number of B, KiB, MiB or GiB".into())
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
    /// Bake the light's transfer too: dsf, hat and a number of directions (42, 162, 642, 2562), or sh1 to sh6.
    #[arg(long, value_name = "BASIS", value_parser = basis, requires = "medium")]
    pub transfer: Option<BasisKind>,
    /// Scene file whose medium the transfer is for.
    #[arg(long, value_name = "SCENE", requires = "transfer")]
    pub medium: Option<PathBuf>,
    /// Frames that get transfer [default: all that are baked].
    #[arg(long, value_name = "RANGE", requires = "transfer")]
    pub transfer_frames: Option<FrameSelection>,
    /// Clusters of the transfer's rows; 1 for plain principal components.
    #[arg(long, value_name = "N", default_value_t = 128, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub clusters: u32,
    /// Directions of each cluster.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(0..=255))]
    pub terms: u32,
    /// Photons for each face of a voxel on the border and light of the indirect basis; 0 for no indirect light.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    pub photons: u32,
    /// Voxels along a side of a cell of indirect light: 1, 2, 4, 8 or 16.
    #[arg(long, value_name = "VOXELS", default_value = "2", value_parser = cell)]
    pub transfer_cell: u32,
    /// Frames in a row that share the transfer's clusters.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub transfer_run: u32,
    /// Memory for the transfer's matrices, such as 4GiB or 500MiB; photons fly twice where it is short.
    #[arg(long, value_name = "BYTES", default_value = "4GiB", value_parser = bytes)]
    pub memory: u64,
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
    /// Seed of the search for perfect hashes and of the transfer's photons, the only random choices.
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

#[cfg(test)]
mod tests {
    use super::super::tests::parse;
    use super::*;

    #[test]
    fn bake_takes_one_error_target_and_has_the_papers_defaults() {
        let args: BakeArgs = parse(&["in.####.vdb", "-o", "a.smoke", "--psnr", "47"]).unwrap();
        assert_eq!((args.gaussians, args.radius_min, args.radius_max, args.delete), (1000, 0.015, 0.09, 3));
        assert_eq!((args.psnr, args.max_error, args.residual), (Some(47.0), None, ResidualAddress::Auto));
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--psnr", "47", "--max-error", "0.1"]).is_err());
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--max-error", "nan"]).is_err());
        assert!(parse::<BakeArgs>(&["in", "-o", "a", "--gaussians", "65537"]).is_err());
    }
}
