//! A matrix of long rows to short ones: the few directions that hold nearly all of it (principal components).
//!
//! Clusters are looked for among rows of about a hundred numbers instead of ten thousand. The directions are
//! orthonormal, so distances between short rows are those between long ones, but for what is left out, which is told.
//! Nothing is centred: the mean is one more direction. Two ways: from the Gram matrix of rows that are there
//! ([`of_sample`]), or, for rows too long for one, by a random sketch of the rows and one more pass (Halko, Martinsson
//! and Tropp 2011, section 5.1, algorithms 4.1 and 5.1), where the matrix may come in parts of its columns, twice, so
//! that it need never be there as a whole.
//! Cost: rows x length x rank for each pass, and rank^3.

use nalgebra::{DMatrix, SymmetricEigen};
use smoke_runtime::product::{add_product, add_transposed, gram};
use smoke_runtime::tracking::sampler::mix;
use std::sync::Arc;

/// Short rows, and what they are short for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reduced {
    /// Numbers a short row.
    pub rank: usize,
    /// `[row][rank]`.
    pub rows: Vec<f32>,
    /// Orthonormal directions, `[rank][length]`.
    pub directions: Vec<f32>,
    /// Sum of the squares of all long rows.
    pub energy: f64,
}

impl Reduced {
    /// Relative RMS of what the short rows leave out; 0 for a matrix of zeros.
    pub fn error(&self) -> f64 {
        let kept: f64 = self.rows.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        if self.energy > 0.0 { ((self.energy - kept).max(0.0) / self.energy).sqrt() } else { 0.0 }
    }
}

/// Eigenvectors of a symmetric `[n][n]`, the largest eigenvalue first: `(values, [vector][n])`.
pub fn eigenvectors(matrix: &[f64], n: usize) -> (Vec<f64>, Vec<f64>) {
    if n == 0 {
        return (Vec::new(), Vec::new());
    }
    let eigen = SymmetricEigen::new(DMatrix::from_row_slice(n, n, matrix));
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]).then(a.cmp(&b)));
    let values = order.iter().map(|&i| eigen.eigenvalues[i]).collect();
    let vector = |i: &usize| {
        let column: Vec<f64> = eigen.eigenvectors.column(*i).iter().copied().collect();
        // A vector and its negative are as good; the first large entry decides.
        let largest = column.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let sign = column.iter().find(|v| v.abs() > 0.5 * largest).map_or(1.0, |v| v.signum());
        column.into_iter().map(move |v| v * sign)
    };
    (values, order.iter().flat_map(vector).collect())
}

/// The `rank` directions, at most, that hold most of the rows of a sample (`[row][length]`): `[rank][length]`.
pub fn of_sample(sample: &[f32], length: usize, rank: usize) -> Vec<f32> {
    let (values, vectors) = eigenvectors(&gram(sample, length), length);
    let least = values.first().map_or(0.0, |v| v * 1e-14);
    let kept = values.iter().take(rank.min(length)).filter(|v| **v > least && **v > 0.0).count();
    vectors[..kept * length].iter().map(|&v| v as f32).collect()
}

/// Directions are random beyond this much more than the rank: their share of the matrix is then nearly the best one.
const OVERSAMPLING: usize = 16;

/// The short rows of a matrix of `rows` rows of `length` numbers that comes in parts of its columns: `parts` are ranges
/// of columns in order, and `part(i)` gives part i, `[row][its columns]`, the same every time; it is asked for each
/// twice.
pub fn sketch(
    rows: usize,
    length: usize,
    rank: usize,
    parts: &[std::ops::Range<usize>],
    mut part: impl FnMut(usize) -> Arc<Vec<f32>>,
) -> Reduced {
    let wide = (rank + OVERSAMPLING).min(rows).min(length);
    let (mut sketch, mut energy) = (vec![0.0f32; rows * wide], 0.0f64);
    for (i, columns) in parts.iter().enumerate() {
        let values = part(i);
        // Signs at random are as good as normal numbers.
        let signs: Vec<f32> = columns
            .clone()
            .flat_map(|c| (0..wide).map(move |w| if mix((c * wide + w) as u64) >> 63 == 0 { 1.0 } else { -1.0 }))
            .collect();
        add_product(&mut sketch, &values, &signs, columns.len(), wide);
        energy += values.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>();
    }
    // Orthonormal columns that span the sketch's: Y V / sqrt(lambda), from the eigenvectors of Y^T Y. Once more, as the
    // first time loses digits to the square.
    let mut span = orthonormal(&sketch, wide);
    let found = span.len().checked_div(rows).unwrap_or(0);
    span = orthonormal(&span, found);
    let found = span.len().checked_div(rows).unwrap_or(0);
    let mut back = vec![0.0f32; length * found];
    for (i, columns) in parts.iter().enumerate() {
        let values = part(i);
        let out = &mut back[columns.start * found..columns.end * found];
        add_transposed(out, &values, &span, columns.len(), found);
    }
    // The matrix is span back^T: rotate so that the directions are its principal ones.
    let (values, vectors) = eigenvectors(&gram(&back, found), found);
    let least = values.first().map_or(0.0, |v| v * 1e-12);
    let rank = values.iter().take(rank).filter(|v| **v > least && **v > 0.0).count();
    let turn: Vec<f32> =
        (0..found * rank).map(|at| vectors[at % rank.max(1) * found + at / rank.max(1)] as f32).collect();
    let (mut short, mut turned) = (vec![0.0f32; rows * rank], vec![0.0f32; length * rank]);
    add_product(&mut short, &span, &turn, found, rank);
    add_product(&mut turned, &back, &turn, found, rank);
    let scales: Vec<f32> = values.iter().take(rank).map(|v| v.sqrt() as f32).collect();
    short.chunks_exact_mut(rank.max(1)).for_each(|row| row.iter_mut().zip(&scales).for_each(|(v, s)| *v *= s));
    let directions =
        (0..rank * length).map(|at| turned[at % length * rank + at / length] / scales[at / length]).collect();
    Reduced { rank, rows: short, directions, energy }
}

/// Orthonormal columns that span those of `matrix` (`[row][width]`), without those that are not there.
fn orthonormal(matrix: &[f32], width: usize) -> Vec<f32> {
    if width == 0 {
        return Vec::new();
    }
    let (values, vectors) = eigenvectors(&gram(matrix, width), width);
    let least = values[0] * 1e-12;
    let kept = values.iter().filter(|v| **v > least && **v > 0.0).count();
    let scaled: Vec<f32> = (0..width * kept)
        .map(|at| (vectors[at % kept * width + at / kept] / values[at % kept].sqrt()) as f32)
        .collect();
    let mut out = vec![0.0f32; matrix.len() / width * kept];
    add_product(&mut out, matrix, &scaled, width, kept);
    out
}

#[cfg(test)]
#[expect(clippy::single_range_in_vec_init, reason = "parts are a list of ranges, here of one")]
mod tests {
    use super::*;

    /// Rows of rank 5 with singular values that fall by 10, and noise of a size.
    fn rows(count: usize, length: usize, noise: f32) -> Vec<f32> {
        (0..count * length)
            .map(|at| {
                let (i, j) = ((at / length) as f32, (at % length) as f32);
                let low: f32 = (0..5)
                    .map(|t| {
                        let t = t as f32;
                        10f32.powf(-t) * (i * (0.13 + 0.07 * t) + t).sin() * (j * (0.05 + 0.11 * t)).cos()
                    })
                    .sum();
                low + noise * ((mix(at as u64) >> 40) as f32 / 8_388_608.0 - 1.0)
            })
            .collect()
    }

    fn rebuilt(reduced: &Reduced, length: usize) -> Vec<f32> {
        let mut out = vec![0.0; reduced.rows.len() / reduced.rank.max(1) * length];
        add_product(&mut out, &reduced.rows, &reduced.directions, reduced.rank, length);
        out
    }

    #[test]
    fn a_matrix_of_low_rank_comes_back_whole_and_in_any_parts() {
        let (count, length) = (300, 120);
        let matrix = rows(count, length, 0.0);
        let cut = |columns: std::ops::Range<usize>| -> Vec<f32> {
            matrix.chunks(length).flat_map(|row| row[columns.clone()].to_vec()).collect()
        };
        for parts in [vec![0..120], vec![0..50, 50..51, 51..120]] {
            let reduced = sketch(count, length, 8, &parts, |i| Arc::new(cut(parts[i].clone())));
            let back = rebuilt(&reduced, length);
            let worst = matrix.iter().zip(&back).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            // Squares of f32 numbers keep singular values down to 1e-6 of the largest, about 1e-6 of numbers up to 1.
            assert!(worst < 5e-5 && reduced.error() < 1e-3, "{worst} {}", reduced.error());
        }
    }

    #[test]
    fn what_is_left_out_is_what_the_error_says() {
        let (count, length) = (200, 90);
        let matrix = rows(count, length, 0.05);
        let parts = [0..length];
        let reduced = sketch(count, length, 3, &parts, |_| Arc::new(matrix.clone()));
        let back = rebuilt(&reduced, length);
        let left: f64 = matrix.iter().zip(&back).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        let whole: f64 = matrix.iter().map(|v| f64::from(*v).powi(2)).sum();
        assert!(
            (reduced.error() - (left / whole).sqrt()).abs() < 1e-4,
            "{} {}",
            reduced.error(),
            (left / whole).sqrt()
        );
        assert!(reduced.error() > 0.03);
    }

    #[test]
    fn directions_are_orthonormal_and_sorted() {
        let matrix = rows(400, 60, 0.02);
        let sampled = of_sample(&matrix, 60, 10);
        let parts = [0..60];
        let sketched = sketch(400, 60, 10, &parts, |_| Arc::new(matrix.clone()));
        for directions in [&sampled, &sketched.directions] {
            for i in 0..10 {
                for j in 0..10 {
                    let dot: f32 = (0..60).map(|k| directions[i * 60 + k] * directions[j * 60 + k]).sum();
                    assert!((dot - f32::from(u8::from(i == j))).abs() < 2e-3, "{i} {j} {dot}");
                }
            }
        }
        let energy = |t: usize| sketched.rows.chunks(10).map(|r| r[t] * r[t]).sum::<f32>();
        assert!((1..10).all(|t| energy(t) <= energy(t - 1) * 1.001));
    }

    #[test]
    fn zeros_and_nothing_at_all_have_no_directions() {
        for (count, length) in [(0, 7), (5, 7)] {
            let parts = [0..length];
            let reduced = sketch(count, length, 4, &parts, |_| Arc::new(vec![0.0; count * length]));
            assert_eq!((reduced.rank, reduced.error()), (0, 0.0));
        }
        assert!(of_sample(&[0.0; 21], 7, 3).is_empty());
    }
}
