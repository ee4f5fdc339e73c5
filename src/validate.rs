//! `smoke-bake validate PACK`: every byte of a pack, and the first thing that is wrong.

use crate::cli::ValidateArgs;
use crate::{answer, failure::Failure};
use smoke_formats::pack::{self, Pack};

/// Says what is wrong first, as a failure, or that nothing is.
pub fn run(args: &ValidateArgs) -> Result<(), Failure> {
    let findings = pack::validate(&args.pack);
    if let Some(first) = findings.first() {
        let place = if first.place.is_empty() { String::new() } else { format!("{}: ", first.place) };
        let more = match findings.len() - 1 {
            0 => String::new(),
            n => format!(" (and {n} more)"),
        };
        return Err(Failure::work(format!("{}: {place}{}{more}", args.pack.display(), first.message)));
    }
    let pack = Pack::open(&args.pack)?;
    let voxels: u64 = pack.frames().iter().map(|f| f.active_voxels).sum();
    let gaussians: u64 = pack.frames().iter().map(|f| u64::from(f.gaussians)).sum();
    let (frames, bytes) = (pack.frames().len(), pack.file_bytes());
    answer::text(&format!("ok: {frames} frames, {voxels} active voxels, {gaussians} Gaussians, {bytes} bytes\n"))
}
