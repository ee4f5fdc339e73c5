//! Clustered principal components (Sloan, Hall, Hart and Snyder 2003, section 4): rows to a cluster's mean and a few of
//! its directions.
//!
//! Rows are first clustered by distance (k-means, started by k-means++ with a seed); then, over and over, each cluster
//! gets its mean and the `terms` directions that hold most of its rows, and each row moves to the cluster that leaves
//! the least of it, `|x - mean|^2 - |V (x - mean)|^2`. The error falls in every round. A cluster that lost all its rows
//! starts again from the row that is worst off. Rows are short ones, see [`super::reduce`]. With one cluster this is
//! plain principal components, and with no terms plain k-means.
//! Cost: rows x clusters x (1 + terms) x length a round; rounds see at most [`TRAINING`] rows, and the last all of
//! them.

use super::reduce::eigenvectors;
use rayon::prelude::*;
use smoke_runtime::product::{add_product, gram};
use smoke_runtime::tracking::sampler::{Random, mix};

/// Rows that clusters are made from, at most, evenly picked.
const TRAINING: usize = 40_000;
/// Rounds of k-means, and of principal components after it.
const ROUNDS: [usize; 2] = [6, 6];

/// Clusters, and which of them each row is in.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clusters {
    /// Directions of each cluster.
    pub terms: usize,
    /// `[cluster][1 + terms][length]`: a mean, then orthonormal directions; zeros where a cluster has fewer.
    pub bases: Vec<f32>,
    /// The cluster of each row.
    pub ids: Vec<u8>,
    /// `[row][terms]`: the row less the mean along each direction.
    pub weights: Vec<f32>,
}

impl Clusters {
    /// Sum of the squares of what the clusters leave of `rows` (`[n][length]`), the rows that they are of.
    pub fn left(&self, rows: &[f32], length: usize) -> f64 {
        let each = (1 + self.terms) * length;
        if self.bases.is_empty() {
            return rows.iter().map(|&v| f64::from(v) * f64::from(v)).sum();
        }
        let of_row = |(i, row): (usize, &[f32])| {
            let (mean, directions) = self.bases[usize::from(self.ids[i]) * each..][..each].split_at(length);
            let weights = &self.weights[i * self.terms..][..self.terms];
            let mut left: Vec<f32> = row.iter().zip(mean).map(|(v, m)| v - m).collect();
            for (weight, direction) in weights.iter().zip(directions.chunks_exact(length)) {
                left.iter_mut().zip(direction).for_each(|(l, d)| *l -= weight * d);
            }
            left.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>()
        };
        // In blocks, so that the sum has one order.
        let block = |(b, rows): (usize, &[f32])| {
            rows.chunks_exact(length).enumerate().map(|(i, row)| of_row((b * 4096 + i, row))).sum::<f64>()
        };
        rows.par_chunks(4096 * length).enumerate().map(block).collect::<Vec<_>>().iter().sum()
    }
}

/// Clusters `rows` (`[n][length]`) into at most `clusters` (1 to 256) of `terms` directions, so that the least is left
/// of rows times their `weights`, >= 0.
pub fn cluster(rows: &[f32], length: usize, weights: &[f32], clusters: usize, terms: usize, seed: u64) -> Clusters {
    let n = rows.len().checked_div(length).unwrap_or(0);
    if n == 0 {
        return Clusters { terms, ..Clusters::default() };
    }
    let every = n.div_ceil(TRAINING);
    let training: Vec<f32> = rows.chunks_exact(length).step_by(every).flatten().copied().collect();
    let important: Vec<f32> = weights.iter().step_by(every).copied().collect();
    let count = clusters.clamp(1, 256).min(training.len() / length);
    let mut bases = Bases { length, terms: 0, values: seeds(&training, length, &important, count, seed) };
    let k_means = [0].repeat(ROUNDS[0]);
    let components = if terms > 0 { [terms].repeat(ROUNDS[1]) } else { Vec::new() };
    for terms in k_means.into_iter().chain(components) {
        let (ids, left) = bases.nearest(&training);
        let left: Vec<f32> = left.iter().zip(&important).map(|(left, weight)| left * weight * weight).collect();
        bases = Bases::fitted(&training, length, &important, &ids, &left, [count, terms]);
    }
    let (ids, _) = bases.nearest(rows);
    let weights = bases.weights(rows, &ids);
    Clusters { terms, bases: bases.values, ids, weights }
}

/// k-means++ (Arthur and Vassilvitskii 2007): each seed is a row drawn by its squared and weighted distance from the
/// seeds before.
fn seeds(rows: &[f32], length: usize, weights: &[f32], count: usize, seed: u64) -> Vec<f32> {
    let n = rows.len() / length;
    let mut random = Random::new(mix(seed));
    let mut chosen = (f64::from(random.unit()) * n as f64) as usize;
    let mut distances = vec![f64::INFINITY; n];
    let mut out = Vec::with_capacity(count * length);
    for _ in 0..count {
        let centre = rows[chosen * length..][..length].to_vec();
        distances.par_iter_mut().zip(rows.par_chunks_exact(length)).zip(weights).for_each(
            |((distance, row), weight)| {
                let square: f32 = row.iter().zip(&centre).map(|(a, b)| (a - b) * (a - b)).sum();
                *distance = distance.min(f64::from(square) * f64::from(*weight).powi(2));
            },
        );
        out.extend(centre);
        let mut rest = f64::from(random.unit()) * distances.iter().sum::<f64>();
        chosen = n - 1;
        for (row, distance) in distances.iter().enumerate() {
            rest -= distance;
            if rest < 0.0 {
                chosen = row;
                break;
            }
        }
    }
    out
}

/// The `terms` directions that hold most of `rows` (`[n][length]`), `[term][length]`; zeros where there are fewer. From
/// the smaller of the two matrices: rows by rows has the same eigenvalues, and `V = X^T U / sqrt(lambda)`.
fn principal(rows: &[f32], length: usize, terms: usize) -> Vec<f32> {
    let n = rows.len() / length;
    let side = n.min(length);
    let transposed: Vec<f32>;
    let (of, across) = if n < length {
        transposed = (0..rows.len()).map(|at| rows[at % n * length + at / n]).collect();
        (&transposed[..], n)
    } else {
        (rows, length)
    };
    let (values, vectors) = eigenvectors(&gram(of, across), side);
    let mut out = Vec::with_capacity(terms * length);
    for t in 0..terms.min(side) {
        let vector = &vectors[t * side..][..side];
        if !(values[t] > values[0] * 1e-10 && values[t] > 0.0) {
            break;
        }
        if n < length {
            let mut direction = vec![0.0f64; length];
            for (row, u) in rows.chunks_exact(length).zip(vector) {
                direction.iter_mut().zip(row).for_each(|(d, v)| *d += u * f64::from(*v));
            }
            let norm = direction.iter().map(|d| d * d).sum::<f64>().sqrt();
            out.extend(direction.iter().map(|d| (d / norm) as f32));
        } else {
            out.extend(vector.iter().map(|&v| v as f32));
        }
    }
    out.resize(terms * length, 0.0);
    out
}

struct Bases {
    length: usize,
    terms: usize,
    /// `[cluster][1 + terms][length]`.
    values: Vec<f32>,
}

impl Bases {
    /// The weighted mean and the directions of each cluster; what `left` of a row says how badly off it is.
    fn fitted(
        rows: &[f32],
        length: usize,
        weights: &[f32],
        ids: &[u8],
        left: &[f32],
        [count, terms]: [usize; 2],
    ) -> Self {
        let mut members: Vec<Vec<usize>> = vec![Vec::new(); count];
        ids.iter().enumerate().for_each(|(row, &id)| members[usize::from(id)].push(row));
        // Rows that are worst off, for clusters without any.
        let mut worst: Vec<usize> = (0..ids.len()).collect();
        let empty = members.iter().filter(|m| m.is_empty()).count();
        if empty > 0 {
            worst.sort_by(|&a, &b| left[b].total_cmp(&left[a]).then(a.cmp(&b)));
        }
        let mut next = worst.into_iter();
        for members in members.iter_mut().filter(|m| m.is_empty()) {
            members.extend(next.next());
        }
        let fit = |members: &Vec<usize>| {
            let (mut mean, mut whole) = (vec![0.0f64; length], 0.0);
            for &row in members {
                let share = f64::from(weights[row]).powi(2);
                whole += share;
                mean.iter_mut().zip(&rows[row * length..][..length]).for_each(|(m, v)| *m += share * f64::from(*v));
            }
            let mean: Vec<f32> = mean.iter().map(|m| (m / whole) as f32).collect();
            let mut out = mean.clone();
            if terms > 0 {
                let centred: Vec<f32> = members
                    .iter()
                    .flat_map(|&row| {
                        let weight = weights[row];
                        rows[row * length..][..length].iter().zip(&mean).map(move |(v, m)| (v - m) * weight)
                    })
                    .collect();
                out.extend(principal(&centred, length, terms));
            }
            out.resize((1 + terms) * length, 0.0);
            out
        };
        let values = members.par_iter().map(fit).collect::<Vec<_>>().concat();
        Self { length, terms, values }
    }

    fn len(&self) -> usize {
        self.values.len() / ((1 + self.terms) * self.length)
    }

    /// The cluster that leaves the least of each row, and how much: `|x - m|^2 - |V (x - m)|^2`.
    fn nearest(&self, rows: &[f32]) -> (Vec<u8>, Vec<f32>) {
        const BLOCK: usize = 2048;
        let (length, each) = (self.length, 1 + self.terms);
        let columns = self.len() * each;
        let transposed: Vec<f32> =
            (0..length * columns).map(|at| self.values[at % columns * length + at / columns]).collect();
        // m.m and V m of each cluster.
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        let own: Vec<f32> = (0..columns)
            .map(|c| dot(&self.values[c * length..][..length], &self.values[c / each * each * length..][..length]))
            .collect();
        let blocks: Vec<(Vec<u8>, Vec<f32>)> = rows
            .par_chunks(BLOCK * length)
            .map(|rows| {
                let mut products = vec![0.0f32; rows.len() / length * columns];
                add_product(&mut products, rows, &transposed, length, columns);
                let best = rows.chunks_exact(length).zip(products.chunks_exact(columns)).map(|(row, products)| {
                    let square = dot(row, row);
                    let left = |(products, own): (&[f32], &[f32])| {
                        let along = products[1..].iter().zip(&own[1..]).map(|(p, o)| (p - o) * (p - o)).sum::<f32>();
                        square - 2.0 * products[0] + own[0] - along
                    };
                    let each = products.chunks_exact(each).zip(own.chunks_exact(each)).map(left).enumerate();
                    // The first of equal ones.
                    each.fold((0, f32::INFINITY), |best, (id, left)| if left < best.1 { (id, left) } else { best })
                });
                best.map(|(id, left)| (id as u8, left)).unzip()
            })
            .collect();
        let (mut ids, mut left) = (Vec::new(), Vec::new());
        for (i, l) in blocks {
            ids.extend(i);
            left.extend(l);
        }
        (ids, left)
    }

    fn weights(&self, rows: &[f32], ids: &[u8]) -> Vec<f32> {
        let (length, each) = (self.length, 1 + self.terms);
        let weights = rows.par_chunks_exact(length).zip(ids).flat_map_iter(|(row, &id)| {
            let basis = &self.values[usize::from(id) * each * length..][..each * length];
            let (mean, directions) = basis.split_at(length);
            directions
                .chunks_exact(length)
                .map(move |direction| row.iter().zip(mean).zip(direction).map(|((v, m), d)| (v - m) * d).sum::<f32>())
        });
        weights.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Rows near three planes of two directions each, far apart.
    fn planes(n: usize, length: usize) -> Vec<f32> {
        let mut random = Random::new(3);
        (0..n)
            .flat_map(|row| {
                let plane = row % 3;
                let (a, b) = (random.unit() - 0.5, random.unit() - 0.5);
                (0..length)
                    .map(|j| {
                        let x = j as f32 + 1.0;
                        let p = plane as f32;
                        5.0 * (p * 2.1 + x).sin() + a * (x * (1.0 + p)).cos() + b * (x * (0.3 + p)).sin()
                    })
                    .collect::<Vec<_>>()
            })
            .collect()
    }

    fn error(rows: &[f32], length: usize, clusters: &Clusters) -> f64 {
        let each = 1 + clusters.terms;
        let (mut left, mut whole) = (0.0, 0.0);
        for (i, row) in rows.chunks(length).enumerate() {
            let basis = &clusters.bases[usize::from(clusters.ids[i]) * each * length..][..each * length];
            for (j, v) in row.iter().enumerate() {
                let along: f32 = (0..clusters.terms)
                    .map(|t| clusters.weights[i * clusters.terms + t] * basis[(1 + t) * length + j])
                    .sum();
                left += f64::from(v - basis[j] - along).powi(2);
                whole += f64::from(*v).powi(2);
            }
        }
        (left / whole).sqrt()
    }

    #[test]
    fn rows_of_three_planes_are_found_by_three_clusters_of_two_terms() {
        let rows = planes(600, 20);
        let found = cluster(&rows, 20, &[1.0; 600], 3, 2, 1);
        // f32 throughout, numbers up to 6.
        assert!(error(&rows, 20, &found) < 1e-5, "{}", error(&rows, 20, &found));
        assert!((0..600).all(|i| found.ids[i] == found.ids[i % 3]));
    }

    #[test]
    fn few_rows_have_the_directions_that_their_columns_have() {
        // Seven rows of twelve numbers, of rank 6 about their mean; ten zeros more make the other matrix the smaller
        // one.
        let mut random = Random::new(5);
        let rows: Vec<f32> = (0..7 * 12).map(|_| random.unit() - 0.5).collect();
        let more = [&rows[..], &[0.0; 10 * 12]].concat();
        let (few, many) = (principal(&rows, 12, 9), principal(&more, 12, 9));
        for (t, (a, b)) in few.chunks_exact(12).zip(many.chunks_exact(12)).enumerate() {
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
            // The same up to sign, by sums in single precision; after the seventh there is none.
            let expected = f64::from(u8::from(t < 7));
            assert!((dot(a, b).abs() - expected).abs() < 1e-4, "{t}: {}", dot(a, b));
            assert!((dot(a, a) - expected).abs() < 1e-5, "{t}");
        }
        assert_eq!(principal(&[0.0; 24], 12, 2), vec![0.0; 24]);
    }

    #[test]
    fn more_clusters_and_more_terms_leave_less() {
        let rows: Vec<f32> = planes(900, 16).iter().enumerate().map(|(i, v)| v + (i as f32 * 0.37).sin()).collect();
        let errors: Vec<f64> = [(1, 0), (4, 0), (4, 2), (16, 2), (16, 4)]
            .map(|(clusters, terms)| error(&rows, 16, &cluster(&rows, 16, &[1.0; 900], clusters, terms, 1)))
            .to_vec();
        assert!(errors.windows(2).all(|e| e[1] < e[0]), "{errors:?}");
    }

    #[test]
    fn rows_fewer_than_clusters_equal_rows_and_no_rows_are_no_trouble() {
        let few = planes(3, 8);
        let found = cluster(&few, 8, &[1.0; 3], 128, 4, 1);
        assert!(error(&few, 8, &found) < 1e-6 && found.bases.len() == 3 * 5 * 8);
        let equal = [1.0f32, 2.0, 3.0, 4.0].repeat(50);
        let found = cluster(&equal, 4, &[1.0; 50], 8, 2, 1);
        assert!(error(&equal, 4, &found) < 1e-7 && found.bases.iter().chain(&found.weights).all(|v| v.is_finite()));
        assert_eq!(cluster(&[], 4, &[], 8, 2, 1), Clusters { terms: 2, ..Clusters::default() });
        assert!(cluster(&[0.0; 40], 4, &[1.0; 10], 8, 2, 1).weights.iter().all(|w| *w == 0.0));
    }

    #[test]
    fn the_same_seed_gives_the_same_bits_on_any_number_of_threads() {
        let rows = planes(500, 12);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| cluster(&rows, 12, &[1.0; 500], 8, 3, 7))
        };
        assert_eq!(with(1), with(3));
    }
}
