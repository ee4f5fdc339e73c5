//! GMRES with restarts for `A x = b` given as a function, with a bound on its iterations.
//!
//! Vectors are f32 (millions of nodes of a grid) or f64 (thousands of unknowns at centres); the small system and all
//! sums are f64. Sums run over fixed blocks, so the result does not depend on the number of threads.
//! Cost: one product with A and k dot products in iteration k of a cycle; memory for [`CYCLE`] vectors.
//! Source: Saad and Schultz 1986, algorithms 3 and 4 (Givens rotations on the Hessenberg matrix).

use rayon::prelude::*;

/// Directions kept before a restart.
pub(crate) const CYCLE: usize = 30;

/// How a solve ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Solved {
    /// Products with the matrix inside the cycles.
    pub iterations: usize,
    /// |b - A x| / |b|; 0 for b = 0.
    pub residual: f64,
}

/// Entries summed at a time; fixed, because it decides the order of summation.
const BLOCK: usize = 4096;

/// The type of a vector's entries.
pub trait Entry: Copy + Send + Sync {
    /// The nearest entry.
    fn of(value: f64) -> Self;
    /// Without loss.
    fn wide(self) -> f64;
}

impl Entry for f32 {
    fn of(value: f64) -> Self {
        value as f32
    }
    fn wide(self) -> f64 {
        f64::from(self)
    }
}

impl Entry for f64 {
    fn of(value: f64) -> Self {
        value
    }
    fn wide(self) -> f64 {
        self
    }
}

fn dot<E: Entry>(a: &[E], b: &[E]) -> f64 {
    let block = |(a, b): (&[E], &[E])| -> f64 {
        let mut lanes = [0.0f64; 8];
        for (a, b) in a.chunks(8).zip(b.chunks(8)) {
            a.iter().zip(b).zip(&mut lanes).for_each(|((a, b), lane)| *lane += a.wide() * b.wide());
        }
        lanes.iter().sum()
    };
    let blocks: Vec<f64> = a.par_chunks(BLOCK).zip(b.par_chunks(BLOCK)).map(block).collect();
    blocks.iter().sum()
}

/// `a += factor b`.
fn add<E: Entry>(a: &mut [E], factor: f64, b: &[E]) {
    a.par_chunks_mut(BLOCK).zip(b.par_chunks(BLOCK)).for_each(|(a, b)| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a = E::of(a.wide() + factor * b.wide()));
    });
}

fn scaled<E: Entry>(a: &[E], factor: f64) -> Vec<E> {
    a.iter().map(|a| E::of(a.wide() * factor)).collect()
}

/// Improves `x` until the relative residual is below `tolerance` or `limit` iterations are spent. `product(v, out)`
/// writes `A v`. The best x found is kept either way.
pub fn solve<E: Entry>(product: impl Fn(&[E], &mut [E]), b: &[E], x: &mut [E], tolerance: f64, limit: usize) -> Solved {
    let scale = dot(b, b).sqrt();
    if scale == 0.0 {
        x.fill(E::of(0.0));
        return Solved { iterations: 0, residual: 0.0 };
    }
    let mut iterations = 0;
    let mut work = vec![E::of(0.0); b.len()];
    loop {
        product(x, &mut work);
        let first: Vec<E> = b.iter().zip(&work).map(|(b, a)| E::of(b.wide() - a.wide())).collect();
        let norm = dot(&first, &first).sqrt();
        // NaN ends here too.
        let unfinished = norm > tolerance * scale && iterations < limit;
        if !unfinished {
            return Solved { iterations, residual: norm / scale };
        }
        let mut basis = vec![scaled(&first, 1.0 / norm)];
        let mut small = LeastSquares::new(norm);
        while small.len() < CYCLE && iterations < limit {
            product(&basis[small.len()], &mut work);
            iterations += 1;
            let mut column = Vec::with_capacity(basis.len() + 1);
            for v in &basis {
                let h = dot(v, &work);
                add(&mut work, -h, v);
                column.push(h);
            }
            let next = dot(&work, &work).sqrt();
            if !small.push(column, next) || small.rest() <= tolerance * scale {
                break;
            }
            basis.push(scaled(&work, 1.0 / next));
        }
        if small.len() == 0 {
            return Solved { iterations, residual: norm / scale };
        }
        for (v, y) in basis.iter().zip(small.solution()) {
            add(x, y, v);
        }
        // No progress in a whole cycle: more of them would not help.
        if small.rest() > NO_PROGRESS * norm {
            product(x, &mut work);
            let rest: f64 = b.iter().zip(&work).map(|(b, a)| (b.wide() - a.wide()).powi(2)).sum();
            return Solved { iterations, residual: rest.sqrt() / scale };
        }
    }
}

/// Share of the residual that a cycle must have left to be the last one.
pub(crate) const NO_PROGRESS: f64 = 0.999_999;

/// The small system of a cycle: least squares on the Hessenberg matrix, by Givens rotations.
pub(crate) struct LeastSquares {
    rotations: Vec<(f64, f64)>,
    columns: Vec<Vec<f64>>,
    right: Vec<f64>,
}

impl LeastSquares {
    /// Of a cycle whose residual starts at `norm`.
    pub(crate) fn new(norm: f64) -> Self {
        Self { rotations: Vec::new(), columns: Vec::new(), right: vec![norm] }
    }

    /// Columns so far.
    pub(crate) fn len(&self) -> usize {
        self.columns.len()
    }

    /// The next column: its products with the basis, and the length of what is left of it. False where the cycle ends here:
    /// the column is zero, and not taken, or nothing is left of it.
    pub(crate) fn push(&mut self, mut column: Vec<f64>, next: f64) -> bool {
        let k = self.columns.len();
        for (i, &(c, s)) in self.rotations.iter().enumerate() {
            let (a, b) = (column[i], column[i + 1]);
            (column[i], column[i + 1]) = (c * a + s * b, c * b - s * a);
        }
        let length = column[k].hypot(next);
        // A zero column: the matrix is singular on this space, and the cycle ends with what it has.
        if length == 0.0 {
            return false;
        }
        let (c, s) = (column[k] / length, next / length);
        self.rotations.push((c, s));
        column[k] = length;
        self.columns.push(column);
        self.right.push(-s * self.right[k]);
        self.right[k] *= c;
        next > 1e-14 * length
    }

    /// Length of the residual that the best combination leaves.
    pub(crate) fn rest(&self) -> f64 {
        self.right.last().map_or(0.0, |r| r.abs())
    }

    /// That combination: a factor for each vector of the basis.
    pub(crate) fn solution(&self) -> Vec<f64> {
        let count = self.columns.len();
        let mut y = vec![0.0; count];
        for i in (0..count).rev() {
            let known: f64 = (i + 1..count).map(|j| self.columns[j][i] * y[j]).sum();
            y[i] = (self.right[i] - known) / self.columns[i][i];
        }
        y
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
    fn single_precision_gets_as_far_as_its_rounding_and_threads_change_no_bit() {
        // 9000 unknowns: more than two blocks. |A^-1| <= 10; the residual's own rounding is a few 6e-8.
        let narrow = |v: &[f32], out: &mut [f32]| {
            let (v, mut wide): (Vec<f64>, _) = (v.iter().map(|v| f64::from(*v)).collect(), vec![0.0; v.len()]);
            chain(&v, &mut wide);
            out.iter_mut().zip(wide).for_each(|(o, w)| *o = w as f32);
        };
        let expected: Vec<f32> = (0..9000).map(|i| (i as f32 * 0.37).sin() + 2.0).collect();
        let mut b = vec![0.0; 9000];
        narrow(&expected, &mut b);
        let with = |threads| {
            let mut x = vec![0.0f32; 9000];
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let solved = pool.install(|| solve(narrow, &b, &mut x, 1e-6, 200));
            assert!(solved.residual < 1e-6, "{solved:?}");
            x
        };
        let x = with(1);
        let scale = dot(&b, &b).sqrt() as f32;
        assert!(x.iter().zip(&expected).all(|(x, e)| (x - e).abs() < 10.0 * 1e-6 * scale));
        assert!(x == with(3));
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
