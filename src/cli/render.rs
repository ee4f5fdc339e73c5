//! Options of `render`.

use super::plan::duration;
use super::{ProgressMode, Rgb, cutoff, exr_pattern, march_step, ratio, rgb, threads};
use clap::{Args, ValueEnum};
use smoke_formats::sequence::FrameSelection;
use std::path::PathBuf;

/// How an image is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum MethodChoice {
    /// What `plan` says: the fast method with what the scene needs, or the reference where it must be.
    #[default]
    Auto,
    /// Source radiance and a march: fast (Zhou et al. 2008, with its errors mended).
    Compensated,
    /// From the transfer that was baked with the pack: any light at once, in its medium (Zhang et al. 2013).
    Transfer,
    /// Unbiased path tracing: slow, and as exact as it is long.
    Reference,
}

/// Which scattering orders are rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScatteringOrders {
    /// Light of all orders.
    All,
    /// Light that was scattered at most so often, at least 1.
    UpTo(u32),
}

impl ScatteringOrders {
    /// Light that was scattered once.
    pub const SINGLE: Self = Self::UpTo(1);
}

impl std::fmt::Display for ScatteringOrders {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::All => f.write_str("all"),
            Self::UpTo(1) => f.write_str("single"),
            Self::UpTo(n) => n.fmt(f),
        }
    }
}

fn orders(text: &str) -> Result<ScatteringOrders, String> {
    match text {
        "all" => Ok(ScatteringOrders::All),
        "single" => Ok(ScatteringOrders::SINGLE),
        n => n
            .parse()
            .ok()
            .filter(|n| (1..=16_384).contains(n))
            .map(ScatteringOrders::UpTo)
            .ok_or_else(|| "expected single, all or a number from 1 to 16384".into()),
    }
}

/// Where the source radiance is solved.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RouteChoice {
    /// On grid nodes.
    Grid,
    /// At the Gaussians' centres, as Zhou et al. 2008 do.
    Centres,
}

/// From optical depth to transmittance, at centres.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ExponentialChoice {
    /// True depths along directions; right at any depth.
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

/// What a directional light brings directly, where light is baked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum SunChoice {
    /// Swept when it is rendered: sharp shadows.
    #[default]
    Sharp,
    /// From the pack: a lobe as wide as the basis's directions are apart.
    Lobes,
}

/// How much of a frame is decoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Detail {
    /// Gaussians and residual: the density within the bake's promise.
    #[default]
    Full,
    /// Gaussians alone: what the fit found, without reading the residual.
    Gaussians,
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
    /// How much of a frame is decoded.
    #[arg(long, value_enum, default_value_t)]
    pub detail: Detail,
    /// How the images are made.
    #[arg(long, value_enum, default_value_t)]
    pub method: MethodChoice,
    /// What lights and marches: cpu, gpu for the best graphics device, or part of the name of one that `devices` lists.
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    pub device: String,
    /// Error to meet, such as 5%: relative RMSE over the pixels with smoke (method auto).
    #[arg(long, value_name = "ERROR", value_parser = ratio, conflicts_with = "time")]
    pub error: Option<f64>,
    /// Seconds a frame to fit in, such as 0.1s or 100ms, as predicted for --threads or 2 (method auto).
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub time: Option<f64>,
    /// Scattering orders: single, all, or at most N (method reference) [default: all].
    #[arg(long, value_name = "ORDERS", value_parser = orders)]
    pub order: Option<ScatteringOrders>,
    /// Relative standard error at which an image is finished, such as 1% (method reference) [default: 2%].
    #[arg(long, value_name = "ERROR", value_parser = ratio)]
    pub target_error: Option<f64>,
    /// Most passes of an image, at least 2 (method reference) [default: 1000000].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(2..))]
    pub max_passes: Option<u32>,
    /// Seed of the paths (method reference) [default: 1].
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Where the source radiance is solved (method compensated) [default: grid].
    #[arg(long, value_enum)]
    pub route: Option<RouteChoice>,
    /// Order of the spherical harmonics of phase function and source radiance [default: 4].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=6))]
    pub sh_order: Option<u8>,
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
    /// What directional lights bring directly (method transfer) [default: sharp].
    #[arg(long, value_enum)]
    pub suns: Option<SunChoice>,
    /// Voxels between samples along a ray [default: 1, less where the medium is thick].
    #[arg(long, value_name = "VOXELS", value_parser = march_step)]
    pub march_step: Option<f64>,
    /// Transmittance below which a ray ends [default: 0.001].
    #[arg(long, value_name = "T", value_parser = cutoff)]
    pub cutoff: Option<f64>,
    /// Rays along a side of a pixel: N x N rays a pixel [default: 1].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=64))]
    pub samples: Option<u8>,
    /// March one ray for every 2 x 2 pixels, and more only where those differ.
    #[arg(long)]
    pub half_resolution: bool,
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

#[cfg(test)]
mod tests {
    use super::super::tests::parse;
    use super::*;

    #[test]
    fn render_takes_a_number_or_three_for_colours() {
        let line = ["a.smoke", "--scene", "s.toml", "-o", "out.####.exr", "--sigma-t", "8", "--albedo", ".9,.8,.7"];
        let args: RenderArgs = parse(&[&line[..], &["--g", "-0.5"]].concat()).unwrap();
        assert_eq!((args.sigma_t, args.albedo, args.g), (Some([8.0; 3]), Some([0.9, 0.8, 0.7]), Some(-0.5)));
        assert!(parse::<RenderArgs>(&[&line[..5], &["--sigma-t", "1,2"]].concat()).is_err());
        assert!(parse::<RenderArgs>(&[&line[..5], &["--sh-order", "7"]].concat()).is_err());
    }
}
