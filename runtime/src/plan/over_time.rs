//! What varies over a sequence's frames, from a few of them.
//!
//! One plan serves a whole sequence, so that neighbouring frames do not differ by their settings: it is made for the
//! thickest of the frames that were looked at. Those are [`sampled`]: the first, the middle and the last, and the one of
//! most voxels where that is known. Cost: at most four frames, however long the sequence is.

use super::Survey;

/// Least, mean and most of a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// The least.
    pub least: f64,
    /// The mean.
    pub mean: f64,
    /// The most.
    pub most: f64,
}

impl Range {
    /// Of some figures; zeros of none.
    pub fn of(values: impl ExactSizeIterator<Item = f64>) -> Self {
        let count = values.len().max(1) as f64;
        let start = (f64::INFINITY, 0.0, f64::NEG_INFINITY);
        let (least, sum, most) = values.fold(start, |(l, s, m), v| (v.min(l), s + v, v.max(m)));
        if least > most { Self { least: 0.0, mean: 0.0, most: 0.0 } } else { Self { least, mean: sum / count, most } }
    }
}

/// What varies.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OverTime {
    /// Voxels with density.
    pub voxels: Range,
    /// Integral of the density, density unit x world volume.
    pub mass: Range,
    /// Optical depth, 95th percentile, of the thickest channel.
    pub depth: Range,
}

impl OverTime {
    /// Of the frames that were looked at; `voxels` are those of all frames where a pack tells, else empty.
    pub fn of(surveys: &[Survey], voxels: &[u64]) -> Self {
        let counts = |s: &Survey| s.medium.voxels as f64;
        let voxels = match voxels.is_empty() {
            true => Range::of(surveys.iter().map(counts)),
            false => Range::of(voxels.iter().map(|&v| v as f64)),
        };
        Self {
            voxels,
            mass: Range::of(surveys.iter().map(|s| s.medium.mass)),
            depth: Range::of(surveys.iter().map(depth)),
        }
    }
}

fn depth(survey: &Survey) -> f64 {
    survey.medium.depth_p95().into_iter().fold(0.0, f64::max)
}

/// Positions of the frames to look at, ascending, of `count`; `largest` is the one of most voxels, if known.
pub fn sampled(count: usize, largest: Option<usize>) -> Vec<usize> {
    let mut positions: Vec<usize> = [0, count / 2, count.saturating_sub(1)].into_iter().chain(largest).collect();
    positions.retain(|&position| position < count);
    positions.sort_unstable();
    positions.dedup();
    positions
}

/// Which of the surveys has the greatest depth; the first of equals, none of none.
pub fn thickest(surveys: &[Survey]) -> Option<usize> {
    (0..surveys.len()).rev().max_by(|&a, &b| {
        let thickness = |i: usize| surveys[i].medium.column_p95;
        thickness(a).total_cmp(&thickness(b))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::survey;

    #[test]
    fn few_frames_are_looked_at_whatever_the_length() {
        assert!(sampled(0, None).is_empty());
        assert_eq!(sampled(1, Some(0)), [0]);
        assert_eq!(sampled(2, None), [0, 1]);
        assert_eq!(sampled(1001, Some(700)), [0, 500, 700, 1000]);
    }

    #[test]
    fn ranges_are_extremes_and_means_and_the_thickest_is_the_first_of_equals() {
        let range = Range::of([3.0, 1.0, 5.0].into_iter());
        assert_eq!((range.least, range.mean, range.most), (1.0, 3.0, 5.0));
        assert_eq!(Range::of(std::iter::empty::<f64>()), Range { least: 0.0, mean: 0.0, most: 0.0 });
        let mut surveys = vec![survey(2.0, 0.9, 0.0); 3];
        surveys[0].medium.column_p95 = 0.5;
        surveys[1].medium.column_p95 = 4.0;
        surveys[2].medium.column_p95 = 4.0;
        assert_eq!((thickest(&surveys), thickest(&[])), (Some(1), None));
        let over_time = OverTime::of(&surveys, &[10, 20]);
        assert_eq!((over_time.voxels.mean, over_time.depth.most, over_time.depth.least), (15.0, 8.0, 1.0));
    }
}
