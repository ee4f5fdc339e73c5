//! Products of tall matrices, in one order of sums on every machine and any number of threads.
//!
//! Libraries choose their kernels by the processor they run on, so their last bits differ from one machine of a farm to
//! the next. Here rows run in parallel, and every sum has a fixed order. Plain loops over fixed blocks become
//! vector code. Cost: one multiplication and one addition for each term, a third to a half of a library's speed.

use multiversion::multiversion;
use rayon::prelude::*;

/// Columns that are summed together, in registers.
const LANES: usize = 32;
/// Rows that share what is loaded of the right factor.
const ROWS: usize = 4;
/// Terms of a sum before the next block of the right factor is loaded.
const DEPTH: usize = 256;
/// Rows of the left factor that one task of [`add_transposed`] takes columns of.
const COLUMNS: usize = 16;

/// `out += left right`: `left` is `[rows][depth]`, `right` is `[depth][columns]`, `out` is `[rows][columns]`.
pub fn add_product(out: &mut [f32], left: &[f32], right: &[f32], depth: usize, columns: usize) {
    if depth == 0 || columns == 0 {
        return;
    }
    assert_eq!(right.len(), depth * columns, "the right factor has depth rows");
    assert_eq!(left.len() / depth, out.len() / columns, "as many rows in as out");
    let block = 16 * ROWS;
    out.par_chunks_mut(block * columns).zip(left.par_chunks(block * depth)).for_each(|(out, left)| {
        for first in (0..depth).step_by(DEPTH) {
            let terms = DEPTH.min(depth - first);
            for column in (0..columns).step_by(LANES) {
                for (out, left) in out.chunks_mut(ROWS * columns).zip(left.chunks(ROWS * depth)) {
                    block_product(out, left, right, [first, terms, column], [depth, columns]);
                }
            }
        }
    });
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn block_product(
    out: &mut [f32],
    left: &[f32],
    right: &[f32],
    [first, terms, column]: [usize; 3],
    [depth, columns]: [usize; 2],
) {
    let rows = left.len() / depth;
    let width = LANES.min(columns - column);
    let mut sums = [[0.0f32; LANES]; ROWS];
    for (row, sum) in sums.iter_mut().enumerate().take(rows) {
        sum[..width].copy_from_slice(&out[row * columns + column..][..width]);
    }
    if rows == ROWS && width == LANES {
        let [mut s0, mut s1, mut s2, mut s3] = sums;
        for k in first..first + terms {
            let Some(r) = right[k * columns + column..].first_chunk::<LANES>() else { return };
            let (a, b, c, d) = (left[k], left[depth + k], left[2 * depth + k], left[3 * depth + k]);
            for lane in 0..LANES {
                s0[lane] += a * r[lane];
                s1[lane] += b * r[lane];
                s2[lane] += c * r[lane];
                s3[lane] += d * r[lane];
            }
        }
        sums = [s0, s1, s2, s3];
    } else {
        for (row, sum) in sums.iter_mut().enumerate().take(rows) {
            for k in first..first + terms {
                let factor = left[row * depth + k];
                let r = &right[k * columns + column..][..width];
                sum[..width].iter_mut().zip(r).for_each(|(s, r)| *s += factor * r);
            }
        }
    }
    for (row, sum) in sums.iter().enumerate().take(rows) {
        out[row * columns + column..][..width].copy_from_slice(&sum[..width]);
    }
}

/// `out += left^T right`: `left` is `[rows][depth]`, `right` is `[rows][columns]`, `out` is `[depth][columns]`.
pub fn add_transposed(out: &mut [f32], left: &[f32], right: &[f32], depth: usize, columns: usize) {
    if depth == 0 || columns == 0 {
        return;
    }
    assert_eq!(out.len(), depth * columns, "a row of the result for each column of the left factor");
    assert_eq!(left.len() / depth, right.len() / columns, "both have the same rows");
    out.par_chunks_mut(COLUMNS * columns).enumerate().for_each(|(block, out)| {
        let first = block * COLUMNS;
        let count = COLUMNS.min(depth - first);
        for (left, right) in left.chunks_exact(depth).zip(right.chunks_exact(columns)) {
            add_outer(out, &left[first..first + count], right);
        }
    });
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_outer(out: &mut [f32], left: &[f32], right: &[f32]) {
    for (out, factor) in out.chunks_exact_mut(right.len()).zip(left) {
        if *factor != 0.0 {
            out.iter_mut().zip(right).for_each(|(o, r)| *o += factor * r);
        }
    }
}

/// Sums of products of the columns of `rows` (`[n][width]`), in f64: a symmetric `[width][width]`.
pub fn gram(rows: &[f32], width: usize) -> Vec<f64> {
    const CHUNK: usize = 512;
    let parts: Vec<Vec<f64>> = rows
        .par_chunks(CHUNK * width.max(1))
        .map(|rows| {
            let mut sums = vec![0.0f64; width * width];
            for row in rows.chunks_exact(width.max(1)) {
                for (i, &a) in row.iter().enumerate() {
                    let a = f64::from(a);
                    let sums = &mut sums[i * width..][..=i];
                    sums.iter_mut().zip(row).for_each(|(s, &b)| *s += a * f64::from(b));
                }
            }
            sums
        })
        .collect();
    let mut total = vec![0.0f64; width * width];
    for part in parts {
        total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
    }
    for i in 0..width {
        for j in 0..i {
            total[j * width + i] = total[i * width + j];
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, seed: u32) -> Vec<f32> {
        (0..count as u32).map(|i| ((i.wrapping_mul(2_654_435_761) ^ seed) >> 8) as f32 / 8_388_608.0 - 1.0).collect()
    }

    #[test]
    fn products_are_those_of_the_definition_for_sizes_that_fill_no_block() {
        for (rows, depth, columns) in [(1, 1, 1), (3, 5, 7), (9, 300, 33), (130, 17, 64), (4, 256, 32), (65, 513, 100)]
        {
            let (left, right) = (numbers(rows * depth, 1), numbers(depth * columns, 2));
            let mut out = vec![0.5f32; rows * columns];
            add_product(&mut out, &left, &right, depth, columns);
            for i in 0..rows {
                for j in 0..columns {
                    let truth: f64 =
                        (0..depth).map(|k| f64::from(left[i * depth + k]) * f64::from(right[k * columns + j])).sum();
                    // Sums of up to 513 numbers below 1, in f32: 513 * 6e-8 * 12 for partial sums up to 12.
                    assert!((f64::from(out[i * columns + j]) - truth - 0.5).abs() < 4e-4, "{rows} {depth} {columns}");
                }
            }
            let tall = numbers(rows * columns, 3);
            let mut out = vec![0.0f32; depth * columns];
            add_transposed(&mut out, &left, &tall, depth, columns);
            for k in 0..depth {
                for j in 0..columns {
                    let truth: f64 =
                        (0..rows).map(|i| f64::from(left[i * depth + k]) * f64::from(tall[i * columns + j])).sum();
                    assert!((f64::from(out[k * columns + j]) - truth).abs() < 1e-4, "{rows} {depth} {columns}");
                }
            }
        }
    }

    #[test]
    fn a_gram_matrix_is_symmetric_and_has_the_sums_of_squares_on_its_diagonal() {
        let rows = numbers(1300 * 6, 4);
        let gram = gram(&rows, 6);
        for i in 0..6 {
            for j in 0..6 {
                let truth: f64 = rows.chunks(6).map(|r| f64::from(r[i]) * f64::from(r[j])).sum();
                assert!((gram[i * 6 + j] - truth).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn one_thread_and_many_give_the_same_bits() {
        let (left, right) = (numbers(500 * 70, 1), numbers(70 * 90, 2));
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut out = vec![0.0; 500 * 90];
                add_product(&mut out, &left, &right, 70, 90);
                let mut back = vec![0.0; 70 * 90];
                add_transposed(&mut back, &left, &out, 70, 90);
                (out, back, gram(&left, 70))
            })
        };
        assert!(with(1) == with(3));
    }
}
