//! GMRES with restarts for `A x = b` given as a function, in double precision, with a bound on its iterations.
//!
//! Cost: one product with A and k dot products in iteration k of a cycle. Deterministic: sums run in index order.
//! Source: Saad and Schultz 1986, algorithms 3 and 4 (Givens rotations on the Hessenberg matrix).

/// Directions kept before a restart.
const CYCLE: usize = 30;

/// How a solve ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solved {
    /// Products with the matrix inside the cycles.
    pub iterations: usize,
    /// |b - A x| / |b|; 0 for b = 0.
    pub residual: f64,
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Improves `x` until the relative residual is below `tolerance` or `limit` iterations are spent. `product(v, out)`
/// writes `A v`. The best x found is kept either way.
pub fn solve(product: impl Fn(&[f64], &mut [f64]), b: &[f64], x: &mut [f64], tolerance: f64, limit: usize) -> Solved {
    let scale = dot(b, b).sqrt();
    if scale == 0.0 {
        x.fill(0.0);
        return Solved { iterations: 0, residual: 0.0 };
    }
    let mut iterations = 0;
    let mut work = vec![0.0; b.len()];
    loop {
        product(x, &mut work);
        let mut first: Vec<f64> = b.iter().zip(&work).map(|(b, a)| b - a).collect();
        let norm = dot(&first, &first).sqrt();
        // NaN ends here too.
        let unfinished = norm > tolerance * scale && iterations < limit;
        if !unfinished {
            return Solved { iterations, residual: norm / scale };
        }
        first.iter_mut().for_each(|v| *v /= norm);
        let mut basis = vec![first];
        let mut rotations: Vec<(f64, f64)> = Vec::new();
        let mut columns: Vec<Vec<f64>> = Vec::new();
        let mut right = vec![norm];
        while columns.len() < CYCLE && iterations < limit {
            let k = columns.len();
            product(&basis[k], &mut work);
            iterations += 1;
            let mut column = Vec::with_capacity(k + 2);
            for v in &basis {
                let h = dot(v, &work);
                work.iter_mut().zip(v).for_each(|(w, v)| *w -= h * v);
                column.push(h);
            }
            let next = dot(&work, &work).sqrt();
            for (i, &(c, s)) in rotations.iter().enumerate() {
                let (a, b) = (column[i], column[i + 1]);
                (column[i], column[i + 1]) = (c * a + s * b, c * b - s * a);
            }
            let length = column[k].hypot(next);
            // A zero column: the matrix is singular on this space, and the cycle ends with what it has.
            if length == 0.0 {
                break;
            }
            let (c, s) = (column[k] / length, next / length);
            rotations.push((c, s));
            column[k] = length;
            columns.push(column);
            right.push(-s * right[k]);
            right[k] *= c;
            if right[k + 1].abs() <= tolerance * scale || next <= 1e-14 * length {
                break;
            }
            basis.push(work.iter().map(|w| w / next).collect());
        }
        if columns.is_empty() {
            return Solved { iterations, residual: norm / scale };
        }
        let count = columns.len();
        let mut y = vec![0.0; count];
        for i in (0..count).rev() {
            let known: f64 = (i + 1..count).map(|j| columns[j][i] * y[j]).sum();
            y[i] = (right[i] - known) / columns[i][i];
        }
        for (v, y) in basis.iter().zip(&y) {
            x.iter_mut().zip(v).for_each(|(x, v)| *x += y * v);
        }
        // No progress in a whole cycle: more of them would not help.
        if right[count].abs() > 0.999_999 * norm {
            product(x, &mut work);
            let rest: f64 = b.iter().zip(&work).map(|(b, a)| (b - a) * (b - a)).sum();
            return Solved { iterations, residual: rest.sqrt() / scale };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// I - 0.9 P, P a cyclic, lopsided chain.
    fn chain(v: &[f64], out: &mut [f64]) {
        let n = v.len();
        for i in 0..n {
            out[i] = v[i] - 0.9 * (0.7 * v[(i + 1) % n] + 0.3 * v[(i + n - 1) % n]);
        }
    }

    #[test]
    fn a_known_solution_is_found_across_restarts() {
        let expected: Vec<f64> = (0..200).map(|i| (f64::from(i) * 0.37).sin() + 2.0).collect();
        let (mut b, mut x) = (vec![0.0; 200], vec![0.0; 200]);
        chain(&expected, &mut b);
        let solved = solve(chain, &b, &mut x, 1e-11, 500);
        assert!(solved.residual < 1e-11 && solved.iterations > CYCLE, "{solved:?}");
        // |error| <= |A^-1| |residual|, |A^-1| <= 1 / (1 - 0.9).
        let scale = dot(&b, &b).sqrt();
        assert!(x.iter().zip(&expected).all(|(x, e)| (x - e).abs() < 10.0 * 1e-11 * scale));
    }

    #[test]
    fn the_limit_holds_and_odd_systems_end() {
        let (b, mut x) = (vec![1.0; 50], vec![0.0; 50]);
        let lopsided: Vec<f64> = (0..50).map(|i| f64::from(i % 7)).collect();
        let solved = solve(chain, &lopsided, &mut x, 1e-14, 3);
        assert!(solved.iterations <= 3 && solved.residual > 1e-14 && x.iter().all(|v| v.is_finite()));
        x.fill(1.0);
        assert_eq!(solve(|_, out: &mut [f64]| out.fill(0.0), &b, &mut x, 1e-6, 10).residual, 1.0);
        assert_eq!(solve(chain, &[0.0; 50], &mut x, 1e-6, 10), Solved { iterations: 0, residual: 0.0 });
        assert_eq!(x, [0.0; 50]);
        assert_eq!(solve(chain, &[], &mut [], 1e-6, 10).residual, 0.0);
    }
}
