//! Small dense linear algebra of L-BFGS-B: dot products and the inverse of a `2m` by `2m` matrix.

use multiversion::multiversion;

/// `a . b`, in eight interleaved partial sums (fixed order, vector lanes).
#[multiversion(targets("x86_64+avx512f+avx2", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (blocks_a, rest_a) = a.as_chunks::<8>();
    let (blocks_b, rest_b) = b.as_chunks::<8>();
    let mut lanes = [0.0; 8];
    for (a, b) in blocks_a.iter().zip(blocks_b) {
        for l in 0..8 {
            lanes[l] += a[l] * b[l];
        }
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum();
    lanes.iter().sum::<f64>() + rest
}

/// The inverse of the `n` by `n` matrix `a` (row by row) by Gauss–Jordan elimination with row pivoting, or none where
/// a pivot vanishes. `O(n^3)`.
///
/// Rows and columns are first brought to a unit diagonal: the blocks of `M^-1` have different units.
pub(super) fn invert(mut a: Vec<f64>, n: usize) -> Option<Vec<f64>> {
    let scale: Vec<f64> = (0..n).map(|i| a[i * n + i].abs().sqrt().recip()).collect();
    if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
        return None;
    }
    for i in 0..n {
        (0..n).for_each(|j| a[i * n + j] *= scale[i] * scale[j]);
    }
    let mut inverse: Vec<f64> = (0..n * n).map(|v| if v / n == v % n { 1.0 } else { 0.0 }).collect();
    for column in 0..n {
        let pivot = (column..n).max_by(|&i, &j| a[i * n + column].abs().total_cmp(&a[j * n + column].abs()))?;
        let value = a[pivot * n + column];
        // The diagonal is 1: a pivot below 1e-14 is rounding noise.
        let sound = value.abs() > 1e-14;
        if !sound {
            return None;
        }
        for j in 0..n {
            a.swap(pivot * n + j, column * n + j);
            inverse.swap(pivot * n + j, column * n + j);
        }
        for j in 0..n {
            a[column * n + j] /= value;
            inverse[column * n + j] /= value;
        }
        for i in (0..n).filter(|&i| i != column) {
            let factor = a[i * n + column];
            if factor != 0.0 {
                for j in 0..n {
                    a[i * n + j] -= factor * a[column * n + j];
                    inverse[i * n + j] -= factor * inverse[column * n + j];
                }
            }
        }
    }
    for i in 0..n {
        (0..n).for_each(|j| inverse[i * n + j] *= scale[i] * scale[j]);
    }
    Some(inverse)
}

/// The solution of `a x = b` by Gaussian elimination with row pivoting, or none where a pivot vanishes. `O(n^3)`.
pub(super) fn solve(mut a: Vec<f64>, mut b: Vec<f64>) -> Option<Vec<f64>> {
    let n = b.len();
    for column in 0..n {
        let pivot = (column..n).max_by(|&i, &j| a[i * n + column].abs().total_cmp(&a[j * n + column].abs()))?;
        let value = a[pivot * n + column];
        let sound = value.abs() > f64::MIN_POSITIVE;
        if !sound {
            return None;
        }
        (0..n).for_each(|j| a.swap(pivot * n + j, column * n + j));
        b.swap(pivot, column);
        for i in column + 1..n {
            let factor = a[i * n + column] / value;
            (column..n).for_each(|j| a[i * n + j] -= factor * a[column * n + j]);
            b[i] -= factor * b[column];
        }
    }
    for i in (0..n).rev() {
        let known: f64 = (i + 1..n).map(|j| a[i * n + j] * b[j]).sum();
        b[i] = (b[i] - known) / a[i * n + i];
    }
    Some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inverse_and_solution_undo_the_matrix_and_a_singular_one_is_refused() {
        let a = vec![-1.0, 0.0, 1.0, 2.0, 0.0, -3.0, 0.5, 1.0, 1.0, 0.5, 5.0, 1.0, 2.0, 1.0, 1.0, 4.0];
        let inverse = invert(a.clone(), 4).unwrap();
        for i in 0..4 {
            for j in 0..4 {
                let entry: f64 = (0..4).map(|k| a[i * 4 + k] * inverse[k * 4 + j]).sum();
                assert!((entry - if i == j { 1.0 } else { 0.0 }).abs() < 1e-13);
            }
        }
        let x = solve(a.clone(), vec![1.0, 2.0, 3.0, 4.0]).unwrap();
        (0..4).for_each(|i| assert!((dot(&a[i * 4..i * 4 + 4], &x) - (i + 1) as f64).abs() < 1e-13));
        assert!(invert(vec![1.0, 1.0, 1.0, 1.0], 2).is_none());
        assert!(solve(vec![0.0; 4], vec![1.0; 2]).is_none());
    }

    #[test]
    fn a_dot_product_covers_the_rest_after_the_blocks() {
        let a: Vec<f64> = (0..19).map(f64::from).collect();
        assert_eq!(dot(&a, &a), (0..19).map(|i| f64::from(i * i)).sum::<f64>());
    }
}
