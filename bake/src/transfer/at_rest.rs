//! A baked run as the pack holds it: half floats with a scale for each set, and what is said of each frame.

use super::{RunTransfer, SharedRows, TransferSettings};
use half::f16;
use smoke_formats::pack::TransferFrameRecord;
use smoke_formats::transfer::{Bases, Rows, TransferBases, TransferRows};
use smoke_runtime::sphere::light_basis::LightBasis;
use smoke_runtime::transport::transfer::frame::{Clustered, FrameTransfer};
use std::sync::Arc;

/// Bases of the run, and rows and record of each of its frames, which have the numbers `frames` in the pack.
pub fn to_pack(run: &RunTransfer, frames: &[usize]) -> (TransferBases, Vec<(TransferFrameRecord, TransferRows)>) {
    let scales = |sets: &[SharedRows]| sets.iter().map(scale).collect::<Vec<_>>();
    let (direct, indirect) = (scales(&run.direct), scales(&run.indirect));
    let bases = |sets: &[SharedRows], scales: &[f32]| sets.iter().zip(scales).map(|(s, k)| bases(s, *k)).collect();
    let rows = |sets: &[SharedRows], scales: &[f32], at: usize| {
        sets.iter().zip(scales).map(|(set, scale)| rows(set, *scale, at)).collect()
    };
    let count = |sets: &[SharedRows], at: usize| sets.first().map_or(0, |set| set.frames[at].0.len() as u64);
    let error = |sets: &[SharedRows]| sets.iter().map(|set| set.error).fold(0.0, f64::max);
    let each = frames.iter().enumerate().map(|(at, &frame)| {
        let record = TransferFrameRecord {
            frame: frame as u32,
            first_of_run: frames[0] as u32,
            voxels: count(&run.direct, at),
            cells: count(&run.indirect, at),
            direct_error: error(&run.direct),
            indirect_error: error(&run.indirect),
            truncated: run.truncated.clamp(0.0, 1.0),
            raw_bytes: run.raw_bytes[at],
            ..TransferFrameRecord::default()
        };
        let rows =
            TransferRows { direct: rows(&run.direct, &direct, at), indirect: rows(&run.indirect, &indirect, at) };
        (record, rows)
    });
    let bases = TransferBases { direct: bases(&run.direct, &direct), indirect: bases(&run.indirect, &indirect) };
    (bases, each.collect())
}

/// Frame `at` of a run as the runtime has it once it was at rest: what a pack would give. `bases` are those that it was
/// baked for.
pub fn frame_transfer(
    run: &RunTransfer,
    settings: &TransferSettings,
    [basis, indirect_basis]: &[Arc<LightBasis>; 2],
    at: usize,
) -> FrameTransfer {
    let frames: Vec<usize> = (0..run.raw_bytes.len()).collect();
    let (bases, rows) = to_pack(run, &frames);
    let rows = &rows[at].1;
    let sets =
        |bases: &[Bases], rows: &[Rows]| bases.iter().zip(rows).map(|(b, r)| Clustered::unpacked(b, r)).collect();
    FrameTransfer {
        medium: settings.medium,
        basis: basis.clone(),
        indirect_basis: indirect_basis.clone(),
        bands: settings.bands(),
        shift: settings.shift,
        direct_of_channel: settings.extinctions().1,
        indirect_of_channel: settings.media().1,
        direct: sets(&bases.direct, &rows.direct),
        indirect: sets(&bases.indirect, &rows.indirect),
    }
}

/// The largest mean or weight, so that half floats hold all of them; 1 where all are zero.
fn scale(set: &SharedRows) -> f32 {
    let cluster = (1 + set.terms) * set.length;
    let means = set.bases.chunks(cluster.max(1)).flat_map(|cluster| &cluster[..set.length]);
    let weights = set.frames.iter().flat_map(|(_, weights)| weights);
    let largest = means.chain(weights).fold(0.0f32, |most, v| most.max(v.abs()));
    // Not a number that is too small to divide by.
    if largest >= f32::MIN_POSITIVE { largest } else { 1.0 }
}

fn bases(set: &SharedRows, scale: f32) -> Bases {
    let (length, each) = (set.length, 1 + set.terms);
    let clusters = set.bases.len().checked_div(length * each).unwrap_or(0);
    let value = |(at, v): (usize, &f32)| {
        let is_mean = (at / length).is_multiple_of(each);
        f16::from_f32(if is_mean { v / scale } else { *v })
    };
    Bases {
        length: if clusters > 0 { length as u32 } else { 0 },
        clusters: clusters as u32,
        terms: if clusters > 0 { set.terms as u32 } else { 0 },
        scale,
        values: set.bases.iter().enumerate().map(value).collect(),
    }
}

fn rows(set: &SharedRows, scale: f32, at: usize) -> Rows {
    let (ids, weights) = &set.frames[at];
    Rows { ids: ids.clone(), weights: weights.iter().map(|w| f16::from_f32(w / scale)).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back_from_half_floats_whatever_their_size() {
        for size in [1.0f32, 1e-20, 1e20, 0.0] {
            let bases: Vec<f32> = vec![0.5 * size, -0.25 * size, 0.6, 0.8, size, 0.0, 0.8, -0.6];
            let set = SharedRows {
                length: 2,
                terms: 1,
                bases: bases.clone(),
                frames: vec![(vec![1, 0], vec![2.0 * size, -0.3 * size])],
                error: 0.01,
            };
            let run = RunTransfer {
                direct: vec![set.clone()],
                indirect: vec![set],
                raw_bytes: vec![7],
                ..Default::default()
            };
            let (bases_at_rest, frames) = to_pack(&run, &[3]);
            let (record, rows) = &frames[0];
            assert_eq!((record.frame, record.first_of_run, record.voxels, record.raw_bytes), (3, 3, 2, 7));
            let back = Clustered::unpacked(&bases_at_rest.direct[0], &rows.direct[0]);
            let near =
                |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-3 * b.abs() + 1e-6 * size);
            assert!(near(&back.bases, &bases) && near(&back.weights, &[2.0 * size, -0.3 * size]), "{back:?}");
        }
    }
}
