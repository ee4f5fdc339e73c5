//! Precomputed volume radiance transfer (Zhang, Dong and Ma 2013): what the smoke sends out under each light of a
//! basis.
//!
//! A run of frames, in order: [`mod@visibility`] (how much of each direction reaches each voxel); [`photons`] (what is
//! scattered more often) and their [`final_gather`], on [`rays`]; each [`reduce`]d to short rows and [`clusters`] of
//! them. Frames of a run share their clusters. What this gives is what the pack holds and the runtime lights:
//! [`smoke_runtime::transport::transfer`].

pub mod at_rest;
pub mod clusters;
pub mod final_gather;
pub mod photons;
pub mod rays;
pub mod reduce;
pub mod seen;
pub mod visibility;

use clusters::{Clusters, cluster};
use final_gather::FinalGather;
use photons::{GreyMedium, PhotonSettings, Photons};
use reduce::{Reduced, sketch};
use seen::{seen_of_cells, seen_of_nodes, weights};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::product::add_product;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::transfer::cells::Cells;
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;
use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;
use visibility::visibility;

/// Everything that decides a transfer, besides the density.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TransferSettings {
    /// The basis of the lights.
    pub basis: BasisKind,
    /// The medium that it is for.
    pub medium: MediumParameters,
    /// Clusters, 1 to 256.
    pub clusters: usize,
    /// Directions of each cluster, 0 to 255.
    pub terms: usize,
    /// Photons for each face of a voxel on the border and each light of the indirect basis.
    pub photons: u32,
    /// Indirect cells have `2^shift` voxels a side, 0 to 4.
    pub shift: u32,
    /// Seed of photons and clusters.
    pub seed: u64,
    /// Bytes that one frame's bake may take, about.
    pub memory: u64,
}

/// Bands of indirect light where the phase function has more than one: the next is below 7 % of it at g = 0.5.
const BANDS: usize = 4;
/// Numbers of a short row, at least, direct and indirect; more if there are more terms. With 128 in place of 256 the
/// sun at g = 0.5 would be off by 3.0 % in place of 2.3 (128 x 4): lobes of suns are what is cut off first.
const RANKS: [usize; 2] = [96, 256];

impl TransferSettings {
    /// Bands of what goes out indirectly: one where light scatters evenly.
    pub fn bands(&self) -> usize {
        if self.medium.g == 0.0 { 1 } else { BANDS }
    }

    /// The distinct extinctions, and which of them each channel has.
    pub fn extinctions(&self) -> (Vec<f32>, [usize; 3]) {
        distinct(self.medium.sigma_t)
    }

    /// The distinct pairs of extinction and albedo, and which of them each channel has.
    pub fn media(&self) -> (Vec<GreyMedium>, [usize; 3]) {
        let MediumParameters { sigma_t, albedo, g } = self.medium;
        distinct([0, 1, 2].map(|c| GreyMedium { sigma_t: sigma_t[c], albedo: albedo[c], g }))
    }
}

fn distinct<T: PartialEq + Copy>(values: [T; 3]) -> (Vec<T>, [usize; 3]) {
    let mut found: Vec<T> = Vec::new();
    let of_channel = values.map(|value| {
        found.iter().position(|f| *f == value).unwrap_or_else(|| {
            found.push(value);
            found.len() - 1
        })
    });
    (found, of_channel)
}

/// Where a bake is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Sweeps done, of so many.
    Direct,
    /// Photons done, of so many.
    Photons,
    /// Lights gathered, of so many.
    Gather,
    /// Rows to clusters.
    Compress,
}

/// Wall seconds of a run, by stage, and the memory that it took.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Deserialize, serde::Serialize)]
pub struct TransferSeconds {
    /// Sweeps.
    pub direct: f64,
    /// Photons and their final gather, those of a second pass where memory is short included.
    pub photons: f64,
    /// Reducing and clustering.
    pub compress: f64,
    /// Bytes of the largest matrices that were there at a time.
    pub peak_bytes: u64,
}

/// Clusters that the frames of a run share, with the rows of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SharedRows {
    /// Numbers of a whole row.
    pub length: usize,
    /// Directions of a cluster.
    pub terms: usize,
    /// `[cluster][1 + terms][length]`.
    pub bases: Vec<f32>,
    /// For each frame, the cluster of each row and its weights, `[row][terms]`.
    pub frames: Vec<(Vec<u8>, Vec<f32>)>,
    /// Relative RMS of what all of this leaves out, over the frames together.
    pub error: f64,
}

/// The transfer of a run of frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RunTransfer {
    /// For each distinct extinction, rows of transmittances of lit nodes.
    pub direct: Vec<SharedRows>,
    /// For each distinct extinction and albedo, rows of what cells send out.
    pub indirect: Vec<SharedRows>,
    /// For each frame, the bytes of its matrices uncompressed, in f32.
    pub raw_bytes: Vec<u64>,
    /// Photons of the run.
    pub photons: u64,
    /// Share of their power that was left where paths were cut.
    pub truncated: f64,
    /// Where the time went.
    pub seconds: TransferSeconds,
}

/// Bakes the transfer of a run of frames, for light of `basis` (that of the settings) and indirect light of its coarser
/// one. `observe(stage, done, all)` is told where it is.
pub fn bake_run(
    fields: &[&DensityField],
    [basis, indirect_basis]: [&LightBasis; 2],
    settings: &TransferSettings,
    observe: &(dyn Fn(Stage, u64, u64) + Sync),
) -> RunTransfer {
    let mut out = RunTransfer::default();
    let rank =
        |at: usize| if settings.clusters == 1 { settings.terms.max(1) } else { RANKS[at].max(2 * settings.terms) };
    let (extinctions, _) = settings.extinctions();
    let sweeps = (2 * extinctions.len() * fields.len() * basis.areas().len()) as u64;
    let swept = std::sync::atomic::AtomicU64::new(0);
    let lit: Vec<Vec<u32>> = fields.iter().map(|field| lit_nodes(field)).collect();
    let rows: Vec<usize> = lit.iter().map(Vec::len).collect();
    // For each extinction, what is seen of the nodes of each field.
    let mut seen: Vec<Vec<Vec<f32>>> = Vec::new();
    for &sigma_t in &extinctions {
        let start = Instant::now();
        let done = |sweeps_done: u64| {
            let before = swept.fetch_add(sweeps_done, std::sync::atomic::Ordering::Relaxed);
            observe(Stage::Direct, before + sweeps_done, sweeps);
        };
        let reduced = visibility(fields, basis, sigma_t, rank(0), &done);
        out.seconds.direct += start.elapsed().as_secs_f64();
        out.seconds.peak_bytes = out.seconds.peak_bytes.max(4 * reduced.rows.len() as u64);
        let start = Instant::now();
        observe(Stage::Compress, 0, 1);
        let of_fields: Vec<Vec<f32>> = fields.iter().map(|field| seen_of_nodes(field, sigma_t)).collect();
        let of_nodes = lit.iter().zip(&of_fields).flat_map(|(lit, seen)| lit.iter().map(|&node| seen[node as usize]));
        out.direct.push(shared(&reduced, basis.areas().len(), &rows, &weights(of_nodes), settings));
        seen.push(of_fields);
        out.seconds.compress += start.elapsed().as_secs_f64();
    }
    let cells: Vec<Cells> = fields.iter().map(|field| Cells::new(field, settings.shift)).collect();
    for medium in settings.media().0 {
        let of_extinction = extinctions.iter().zip(&seen).find(|(sigma_t, _)| **sigma_t == medium.sigma_t);
        let seen = of_extinction.map_or(&[][..], |(_, seen)| seen);
        indirect(fields, &cells, seen, indirect_basis, medium, settings, rank(1), observe, &mut out);
    }
    let numbers = |frame: usize| {
        let nodes = out.direct.first().map_or(0, |d| d.frames[frame].0.len()) * basis.areas().len() * out.direct.len();
        let n = settings.bands() * settings.bands();
        nodes + cells[frame].len() * indirect_basis.kind().len() * n * out.indirect.len()
    };
    out.raw_bytes = (0..fields.len()).map(|frame| 4 * numbers(frame) as u64).collect();
    out
}

/// Photons of one medium through all frames of a run, light by light as memory allows, to clusters.
#[expect(clippy::too_many_arguments, reason = "one call; the indirect half of `bake_run`")]
fn indirect(
    fields: &[&DensityField],
    cells: &[Cells],
    seen: &[Vec<f32>],
    basis: &LightBasis,
    medium: GreyMedium,
    settings: &TransferSettings,
    rank: usize,
    observe: &(dyn Fn(Stage, u64, u64) + Sync),
    out: &mut RunTransfer,
) {
    let bands = settings.bands();
    let n = bands * bands;
    let lights = basis.kind().len();
    let rows: Vec<usize> = cells.iter().map(Cells::len).collect();
    let total: usize = rows.iter().sum();
    let photon_settings = PhotonSettings { per_face: settings.photons, seed: settings.seed, bands, lowest_order: 1 };
    let photons: Vec<Photons> = fields
        .iter()
        .zip(cells)
        .map(|(field, cells)| Photons::new(field, cells, basis, medium, photon_settings))
        .collect();
    let all: u64 = photons.iter().map(Photons::count).sum();
    let start = Instant::now();
    // Without photons there is no indirect light.
    let gathers: Vec<Option<FinalGather>> = fields
        .iter()
        .zip(cells)
        .map(|(field, cells)| FinalGather::new(field, cells, basis, medium, bands).filter(|_| settings.photons > 0))
        .collect();
    // Moments of a light in each cell, and how much of it reaches the cell.
    let parts = parts(lights, 4 * (total * (n + 1)) as u64, settings.memory / 2);
    let columns: Vec<Range<usize>> = parts.iter().map(|p| p.start * n..p.end * n).collect();
    let (flown, gathered) = (std::sync::atomic::AtomicU64::new(0), std::sync::atomic::AtomicU64::new(0));
    let passes = if parts.len() > 1 { 2 } else { 1 };
    let mut kept: Option<Arc<Vec<f32>>> = None;
    let (mut seconds, mut truncated, mut counted) = (start.elapsed().as_secs_f64(), 0.0f64, 0);
    let trace = |part: usize| -> Arc<Vec<f32>> {
        if let Some(values) = &kept {
            return values.clone();
        }
        let start = Instant::now();
        let mut values = Vec::with_capacity(total * parts[part].len() * n);
        for (photons, gather) in photons.iter().zip(&gathers) {
            let done = |number: u64| {
                let before = flown.fetch_add(number, std::sync::atomic::Ordering::Relaxed);
                observe(Stage::Photons, (before + number).min(passes * all), passes * all);
            };
            let (mut moments, traced) = photons.trace(parts[part].clone(), &done);
            if let Some(gather) = gather {
                let gather_all = passes * (lights * fields.len()) as u64;
                gather.gather(&parts[part], &mut moments, &|number| {
                    let before = gathered.fetch_add(number, std::sync::atomic::Ordering::Relaxed);
                    observe(Stage::Gather, (before + number).min(gather_all), gather_all);
                });
            }
            values.extend(moments);
            truncated = truncated.max(traced.truncated);
            counted += traced.photons;
        }
        for row in values.chunks_exact_mut(n) {
            for (lm, v) in row.iter_mut().enumerate() {
                *v *= medium.gain(lm);
            }
        }
        let values = Arc::new(values);
        if parts.len() == 1 {
            kept = Some(values.clone());
        }
        seconds += start.elapsed().as_secs_f64();
        values
    };
    let reduced = sketch(total, lights * n, rank, &columns, trace);
    observe(Stage::Compress, 0, 1);
    let widest = parts.iter().map(|p| p.len()).max().unwrap_or(0);
    let peak = 4 * (2 * total * widest * n + total * rank) as u64;
    out.seconds.peak_bytes = out.seconds.peak_bytes.max(peak);
    let of_cells =
        seen.iter().zip(fields).zip(cells).flat_map(|((seen, field), cells)| seen_of_cells(seen, field, cells));
    out.indirect.push(shared(&reduced, lights * n, &rows, &weights(of_cells), settings));
    out.photons += counted;
    out.truncated = out.truncated.max(truncated);
    out.seconds.photons += seconds;
    out.seconds.compress += start.elapsed().as_secs_f64() - seconds;
}

/// Ranges of the lights, in order, whose matrices of `bytes_a_light` stay below `memory` where that is possible.
fn parts(lights: usize, bytes_a_light: u64, memory: u64) -> Vec<Range<usize>> {
    // The matrix and a copy of it while it is worked on.
    let at_once = (memory / (2 * bytes_a_light).max(1)).clamp(1, lights as u64) as usize;
    (0..lights).step_by(at_once).map(|first| first..(first + at_once).min(lights)).collect()
}

/// Short rows of all frames to clusters of whole rows.
fn shared(
    reduced: &Reduced,
    length: usize,
    rows: &[usize],
    weights: &[f32],
    settings: &TransferSettings,
) -> SharedRows {
    let rank = reduced.rank;
    let found = if rank == 0 {
        // Nothing but zeros: one cluster of them.
        let total = rows.iter().sum();
        Clusters { terms: 0, bases: Vec::new(), ids: vec![0; total], weights: Vec::new() }
    } else {
        cluster(&reduced.rows, rank, weights, settings.clusters, settings.terms.min(rank), settings.seed)
    };
    let terms = found.terms;
    let mut bases = vec![0.0f32; found.bases.len().checked_div(rank).unwrap_or(0) * length];
    add_product(&mut bases, &found.bases, &reduced.directions, rank, length);
    if rank == 0 && !found.ids.is_empty() {
        bases = vec![0.0; length];
    }
    let kept = found.left(&reduced.rows, rank);
    let all: f64 = reduced.rows.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
    let left = (reduced.energy - all).max(0.0) + kept;
    let mut frames = Vec::with_capacity(rows.len());
    let mut first = 0;
    for count in rows {
        let weights = found.weights[first * terms..(first + count) * terms].to_vec();
        frames.push((found.ids[first..first + count].to_vec(), weights));
        first += count;
    }
    let error = if reduced.energy > 0.0 { (left / reduced.energy).sqrt() } else { 0.0 };
    SharedRows { length, terms, bases, frames, error }
}

#[cfg(test)]
#[expect(clippy::single_range_in_vec_init, reason = "parts are a list of ranges, here of one")]
mod tests {
    use super::*;

    #[test]
    fn parts_cover_the_lights_and_stay_below_the_memory() {
        assert_eq!(parts(642, 1000, u64::MAX / 4), [0..642]);
        let cut = parts(642, 1 << 20, 200 << 20);
        assert_eq!((cut[0].clone(), cut.last().unwrap().end), (0..100, 642));
        assert!(cut.windows(2).all(|p| p[0].end == p[1].start));
        assert_eq!(parts(3, 1 << 40, 1).len(), 3);
    }

    #[test]
    fn channels_that_are_alike_share_what_is_baked() {
        let settings = TransferSettings {
            basis: BasisKind::Hat(42),
            medium: MediumParameters { sigma_t: [4.0; 3], albedo: [0.9, 0.8, 0.9], g: 0.0 },
            clusters: 4,
            terms: 1,
            photons: 1,
            shift: 1,
            seed: 1,
            memory: 1 << 30,
        };
        assert_eq!((settings.extinctions().0.len(), settings.media().0.len()), (1, 2));
        assert_eq!((settings.media().1, settings.bands()), ([0, 1, 0], 1));
    }
}
