//! The limited memory of L-BFGS-B: the Hessian's approximation `B = theta I - W M W^T` in compact form.
//!
//! `W = [Y, theta S]`, `M^-1 = [[-D, L^T], [L, theta S^T S]]`, with the steps `s_j` and gradient changes `y_j` as
//! columns of S and Y, `D = diag(s_j . y_j)`, `L_ij = s_i . y_j` for `i > j` (Byrd, Lu, Nocedal, Zhu 1995, equations
//! 3.1 to 3.4). For n variables and m pairs a new pair costs `4 m n`, and a product with W `2 m n`.

use super::linear::{dot, invert};

/// The pairs and all their products.
#[derive(Clone, Debug)]
pub(super) struct Memory {
    capacity: usize,
    /// Scale of the identity in B.
    pub theta: f64,
    s: Vec<Vec<f64>>,
    y: Vec<Vec<f64>>,
    /// `s_i . s_j`, `s_i . y_j`, `y_i . y_j`, row i.
    ss: Vec<Vec<f64>>,
    sy: Vec<Vec<f64>>,
    yy: Vec<Vec<f64>>,
    /// M, `2k` by `2k`, row by row.
    middle: Vec<f64>,
}

impl Memory {
    pub fn new(capacity: usize) -> Self {
        let none = Vec::new;
        Self { capacity, theta: 1.0, s: none(), y: none(), ss: none(), sy: none(), yy: none(), middle: Vec::new() }
    }

    /// Pairs held.
    pub fn pairs(&self) -> usize {
        self.s.len()
    }

    /// Forgets every pair and the scale.
    pub fn clear(&mut self) {
        *self = Self::new(self.capacity);
    }

    /// Takes the step `s` and the gradient's change `y`, dropping the oldest pair of a full memory.
    ///
    /// A pair without positive curvature, `s . y <= 2.2e-16 |y|^2` (the guard of the original code), is not taken: B
    /// must stay positive definite.
    pub fn push(&mut self, s: Vec<f64>, y: Vec<f64>) {
        let (curvature, yy) = (dot(&s, &y), dot(&y, &y));
        if !(curvature > f64::EPSILON * yy && curvature.is_finite() && yy.is_finite()) || self.capacity == 0 {
            return;
        }
        if self.pairs() == self.capacity {
            self.remove(0);
        }
        self.s.push(s);
        self.y.push(y);
        let k = self.pairs() - 1;
        let product = |a: &[Vec<f64>], b: &[Vec<f64>], i: usize, j: usize| dot(&a[i], &b[j]);
        for i in 0..k {
            self.ss[i].push(product(&self.s, &self.s, i, k));
            self.sy[i].push(product(&self.s, &self.y, i, k));
            self.yy[i].push(product(&self.y, &self.y, i, k));
        }
        self.ss.push((0..=k).map(|j| product(&self.s, &self.s, k, j)).collect());
        self.sy.push((0..=k).map(|j| product(&self.s, &self.y, k, j)).collect());
        self.yy.push((0..=k).map(|j| product(&self.y, &self.y, k, j)).collect());
        self.theta = yy / curvature;
        self.factor();
    }

    fn remove(&mut self, pair: usize) {
        self.s.remove(pair);
        self.y.remove(pair);
        for matrix in [&mut self.ss, &mut self.sy, &mut self.yy] {
            matrix.remove(pair);
            matrix.iter_mut().for_each(|row| {
                row.remove(pair);
            });
        }
    }

    /// Changes every pair (variables rescaled, or forgotten) and makes the products again, at `3 m^2 n`.
    pub fn transform(&mut self, change: impl Fn(&mut Vec<f64>, &mut Vec<f64>)) {
        let (s, y) = (std::mem::take(&mut self.s), std::mem::take(&mut self.y));
        self.clear();
        for (mut s, mut y) in s.into_iter().zip(y) {
            change(&mut s, &mut y);
            self.push(s, y);
        }
    }

    /// Makes M. A singular M^-1 (pairs that depend on each other to the last digit) drops the oldest pair.
    fn factor(&mut self) {
        loop {
            let k = self.pairs();
            let mut inverse = vec![0.0; 4 * k * k];
            for i in 0..k {
                inverse[i * 2 * k + i] = -self.sy[i][i];
                for j in 0..k {
                    inverse[(k + i) * 2 * k + k + j] = self.theta * self.ss[i][j];
                    if i > j {
                        inverse[(k + i) * 2 * k + j] = self.sy[i][j];
                        inverse[j * 2 * k + k + i] = self.sy[i][j];
                    }
                }
            }
            match invert(inverse, 2 * k) {
                Some(middle) => {
                    self.middle = middle;
                    return;
                }
                None => self.remove(0),
            }
        }
    }

    /// `M v`.
    pub fn middle(&self, v: &[f64]) -> Vec<f64> {
        self.middle.chunks(v.len().max(1)).map(|row| dot(row, v)).collect()
    }

    /// Row i of W.
    pub fn row(&self, i: usize) -> Vec<f64> {
        self.y.iter().map(|y| y[i]).chain(self.s.iter().map(|s| self.theta * s[i])).collect()
    }

    /// `W^T v`.
    pub fn transposed(&self, v: &[f64]) -> Vec<f64> {
        self.y.iter().map(|y| dot(y, v)).chain(self.s.iter().map(|s| self.theta * dot(s, v))).collect()
    }

    /// `out += W v`.
    pub fn add_product(&self, v: &[f64], out: &mut [f64]) {
        let (vy, vs) = v.split_at(self.pairs());
        let mut add = |column: &[f64], factor: f64| out.iter_mut().zip(column).for_each(|(o, c)| *o += factor * c);
        self.y.iter().zip(vy).for_each(|(y, &v)| add(y, v));
        self.s.iter().zip(vs).for_each(|(s, &v)| add(s, self.theta * v));
    }

    /// `W^T Z Z^T W`, Z = the free variables, row by row; `fixed[i]` tells the others.
    ///
    /// From the stored products minus the fixed rows when those are fewer (`4 m^2` each), else from the free rows.
    pub fn free_gram(&self, fixed: &[bool]) -> Vec<f64> {
        let (k, width) = (self.pairs(), 2 * self.pairs());
        let held = fixed.iter().filter(|&&f| f).count();
        let subtract = 2 * held < fixed.len();
        let mut gram = vec![0.0; width * width];
        if subtract {
            for i in 0..k {
                for j in 0..k {
                    gram[i * width + j] = self.yy[i][j];
                    gram[(k + i) * width + j] = self.theta * self.sy[i][j];
                    gram[j * width + k + i] = self.theta * self.sy[i][j];
                    gram[(k + i) * width + k + j] = self.theta * self.theta * self.ss[i][j];
                }
            }
        }
        let sign = if subtract { -1.0 } else { 1.0 };
        for i in (0..fixed.len()).filter(|&i| fixed[i] == subtract) {
            let w = self.row(i);
            for (row, &a) in gram.chunks_mut(width.max(1)).zip(&w) {
                row.iter_mut().zip(&w).for_each(|(g, &b)| *g += sign * a * b);
            }
        }
        gram
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// B by the update formula, pair after pair: `B - B s s^T B / s^T B s + y y^T / y^T s`, from `theta I`.
    fn dense(pairs: &[(Vec<f64>, Vec<f64>)], theta: f64) -> Vec<Vec<f64>> {
        let n = pairs[0].0.len();
        let mut b: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| if i == j { theta } else { 0.0 }).collect()).collect();
        for (s, y) in pairs {
            let bs: Vec<f64> = b.iter().map(|row| dot(row, s)).collect();
            let (sbs, sy) = (dot(s, &bs), dot(s, y));
            for i in 0..n {
                for j in 0..n {
                    b[i][j] += y[i] * y[j] / sy - bs[i] * bs[j] / sbs;
                }
            }
        }
        b
    }

    fn pair(k: usize) -> (Vec<f64>, Vec<f64>) {
        let s: Vec<f64> = (0..5).map(|i| ((i * 7 + k * 3) as f64).sin()).collect();
        let y = s.iter().enumerate().map(|(i, s)| s * (1.0 + i as f64) + 0.1 * ((i + k) as f64).cos()).collect();
        (s, y)
    }

    #[test]
    fn the_compact_form_equals_the_update_formula_also_after_dropping_old_pairs() {
        let mut memory = Memory::new(3);
        let pairs: Vec<_> = (0..5).map(pair).collect();
        pairs.iter().for_each(|(s, y)| memory.push(s.clone(), y.clone()));
        let truth = dense(&pairs[2..], memory.theta);
        let v = [0.3, -1.0, 0.5, 2.0, 0.1];
        let mut product: Vec<f64> = v.iter().map(|v| -memory.theta * v).collect();
        memory.add_product(&memory.middle(&memory.transposed(&v)), &mut product);
        for (p, row) in product.iter().zip(&truth) {
            // Condition of the 6 x 6 middle matrix here is below 1e4: 1e4 * 2^-52 is 2e-12.
            assert!((-p - dot(row, &v)).abs() < 1e-10, "{p} {}", dot(row, &v));
        }
    }

    #[test]
    fn the_gram_of_the_free_variables_is_the_same_by_both_ways() {
        let mut memory = Memory::new(3);
        (0..3).map(pair).for_each(|(s, y)| memory.push(s, y));
        for fixed in [[true, false, false, true, false], [true, true, false, true, true]] {
            let gram = memory.free_gram(&fixed);
            for a in 0..6 {
                for b in 0..6 {
                    let truth: f64 = (0..5).filter(|&i| !fixed[i]).map(|i| memory.row(i)[a] * memory.row(i)[b]).sum();
                    assert!((gram[a * 6 + b] - truth).abs() < 1e-10);
                }
            }
        }
    }

    #[test]
    fn a_pair_without_positive_curvature_is_not_taken() {
        let mut memory = Memory::new(3);
        memory.push(vec![1.0, 0.0], vec![-1.0, 0.0]);
        memory.push(vec![1.0, 0.0], vec![f64::NAN, 0.0]);
        assert_eq!(memory.pairs(), 0);
    }
}
