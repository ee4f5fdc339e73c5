//! GMRES (Saad and Schultz 1986) for `x = b + T x` where only the product with T is known.
//!
//! The basis is kept whole (no restart): a transport operator is a contraction, and a dozen products suffice. Sums run
//! over fixed blocks in f64, so the result does not depend on the number of threads. Cost: one product and
//! O(iteration x unknowns) an iteration.

use rayon::prelude::*;

/// Values summed at a time; fixed, because it decides the order of summation.
const BLOCK: usize = 4096;

/// What came out.
pub struct Solution {
    /// The unknowns.
    pub x: Vec<f32>,
    /// Products with T.
    pub iterations: usize,
    /// `|b + T x - x| / |b|`, as the method estimates it.
    pub residual: f64,
}

/// Solves `x = b + T x` to a relative residual of `tolerance`, with at most `most` products after the first.
///
/// `start` is a first guess (warm start); zero unknowns or b = 0 give x = 0. Stops early, with what it has, where the
/// residual is not finite.
pub fn solve(
    apply: impl Fn(&[f32]) -> Vec<f32>,
    b: &[f32],
    start: Option<&[f32]>,
    tolerance: f64,
    most: usize,
) -> Solution {
    let scale = norm(b);
    if !(scale > 0.0) {
        return Solution { x: vec![0.0; b.len()], iterations: 0, residual: 0.0 };
    }
    let mut x = start.map_or_else(|| b.to_vec(), <[f32]>::to_vec);
    let product = apply(&x);
    let mut residual: Vec<f32> = (0..b.len()).into_par_iter().map(|i| b[i] + product[i] - x[i]).collect();
    let beta = norm(&residual);
    if !(beta > tolerance * scale) {
        return Solution { x, iterations: 1, residual: beta / scale };
    }
    divide(&mut residual, beta);
    let mut basis = vec![residual];
    let mut columns: Vec<Vec<f64>> = Vec::new();
    let (mut cosines, mut sines, mut rhs) = (Vec::new(), Vec::new(), vec![beta]);
    while columns.len() < most && rhs[columns.len()].abs() > tolerance * scale {
        let last = &basis[columns.len()];
        let product = apply(last);
        // The system's matrix is I - T.
        let mut w: Vec<f32> = last.par_iter().zip(&product).map(|(v, p)| v - p).collect();
        let mut column = Vec::with_capacity(basis.len() + 1);
        for v in &basis {
            let h = dot(v, &w);
            w.par_iter_mut().zip(v).for_each(|(w, v)| *w -= (h * f64::from(*v)) as f32);
            column.push(h);
        }
        let rest = norm(&w);
        if !rest.is_finite() {
            break;
        }
        for (i, (c, s)) in cosines.iter().zip(&sines).enumerate() {
            let (a, b): (f64, f64) = (column[i], column[i + 1..].first().copied().unwrap_or(rest));
            column[i] = c * a + s * b;
            if i + 1 < column.len() {
                column[i + 1] = -s * a + c * b;
            }
        }
        let k = column.len() - 1;
        let length = column[k].hypot(rest);
        let (c, s) = (column[k] / length, rest / length);
        column[k] = length;
        cosines.push(c);
        sines.push(s);
        rhs.push(-s * rhs[k]);
        rhs[k] *= c;
        columns.push(column);
        if !(rest > 1e-12 * scale) {
            break;
        }
        divide(&mut w, rest);
        basis.push(w);
    }
    let iterations = columns.len();
    let mut y = vec![0.0; iterations];
    for row in (0..iterations).rev() {
        let known: f64 = (row + 1..iterations).map(|j| columns[j][row] * y[j]).sum();
        y[row] = (rhs[row] - known) / columns[row][row];
    }
    for (v, y) in basis.iter().zip(&y) {
        x.par_iter_mut().zip(v).for_each(|(x, v)| *x += (y * f64::from(*v)) as f32);
    }
    Solution { x, iterations: iterations + 1, residual: rhs[iterations].abs() / scale }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let blocks: Vec<f64> = a
        .par_chunks(BLOCK)
        .zip(b.par_chunks(BLOCK))
        .map(|(a, b)| {
            let mut lanes = [0.0f64; 8];
            for (a, b) in a.chunks(8).zip(b.chunks(8)) {
                a.iter().zip(b).zip(&mut lanes).for_each(|((a, b), lane)| *lane += f64::from(*a) * f64::from(*b));
            }
            lanes.iter().sum()
        })
        .collect();
    blocks.iter().sum()
}

fn norm(a: &[f32]) -> f64 {
    dot(a, a).sqrt()
}

fn divide(a: &mut [f32], by: f64) {
    let factor = (1.0 / by) as f32;
    a.par_iter_mut().for_each(|a| *a *= factor);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_dense_system_is_solved_and_a_warm_start_saves_products() {
        // T = a contraction of 40 unknowns, not symmetric, spectral radius below 0.9.
        let n = 40;
        let t = |x: &[f32]| -> Vec<f32> {
            (0..n).map(|i| 0.5 * x[(i + 1) % n] + 0.3 * x[(i * 7 + 3) % n] + 0.01 * x[0]).collect()
        };
        let b: Vec<f32> = (0..n).map(|i| (i as f32 * 0.7).sin() + 1.1).collect();
        let cold = solve(t, &b, None, 1e-6, 60);
        let product = t(&cold.x);
        let worst = (0..n).map(|i| (b[i] + product[i] - cold.x[i]).abs()).fold(0.0, f32::max);
        assert!(worst < 2e-5, "{worst} after {}", cold.iterations);
        let warm = solve(t, &b, Some(&cold.x), 1e-5, 60);
        assert!(warm.iterations < cold.iterations / 4);
    }

    #[test]
    fn nothing_to_solve_gives_zero_and_no_scattering_gives_b() {
        assert_eq!(solve(|x| x.to_vec(), &[0.0; 5], None, 1e-3, 9).x, [0.0; 5]);
        let none = solve(|x| vec![0.0; x.len()], &[1.0, 2.0], None, 1e-3, 9);
        assert_eq!((none.x, none.iterations), (vec![1.0, 2.0], 1));
    }
}
