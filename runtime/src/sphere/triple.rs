//! Products of two functions in spherical harmonics: `(a b)_i = sum_jk G_ijk a_j b_k`, `G_ijk = integral y_i y_j y_k`.
//!
//! The tensor is sparse (353 entries of 4096 at order 4) and is integrated once per order, at first use, by a product
//! rule that is exact for its degree 3 (order - 1). The product is the projection of the exact product onto the bands
//! l < order: bands above are lost, as they are in every truncated product.
//!
//! Cost: one multiplication-addition for each entry and product: 353 at order 4, 2907 at order 6.
//! Source: Zhou et al. 2008, appendix; Snyder, Code Generation and Factoring for Fast Evaluation of SH Products (2006).

use std::sync::LazyLock;

use crate::sphere::harmonics::{MAX_COEFFICIENTS, MAX_ORDER, evaluate};
use crate::sphere::quadrature::Directions;

/// One entry of the tensor.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Entry {
    i: u8,
    j: u8,
    k: u8,
    value: f32,
}

/// The tensor at [`MAX_ORDER`], by ascending `max(i, j, k)`, so that a lower order is a prefix; and the prefixes' lengths.
struct Tensor {
    entries: Vec<Entry>,
    prefix: [usize; MAX_ORDER + 1],
}

static TENSOR: LazyLock<Tensor> = LazyLock::new(|| {
    // Degree 15 needs 8 x 16 points. Values are sums of 128 terms of f32 harmonics: good to 1e-6, and the smallest
    // entry that is not zero is above 0.01.
    let directions = Directions::product(8, 16);
    let values: Vec<[f32; MAX_COEFFICIENTS]> =
        (0..directions.len()).map(|q| evaluate(MAX_ORDER, directions.direction(q))).collect();
    let mut tensor = Tensor { entries: Vec::new(), prefix: [0; MAX_ORDER + 1] };
    for order in 1..=MAX_ORDER {
        let (inner, outer) = ((order - 1) * (order - 1), order * order);
        for i in 0..outer {
            for j in 0..outer {
                for k in 0..outer {
                    if i.max(j).max(k) < inner {
                        continue;
                    }
                    let value: f64 = values
                        .iter()
                        .zip(&directions.weights)
                        .map(|(y, &w)| f64::from(w) * f64::from(y[i]) * f64::from(y[j]) * f64::from(y[k]))
                        .sum();
                    if value.abs() > 1e-4 {
                        tensor.entries.push(Entry { i: i as u8, j: j as u8, k: k as u8, value: value as f32 });
                    }
                }
            }
        }
        tensor.prefix[order] = tensor.entries.len();
    }
    tensor
});

/// The number of entries that are not zero at `order`.
pub fn entries(order: usize) -> usize {
    TENSOR.prefix[order]
}

/// Adds the product of `a` and `b`, both of `order`, to `out`.
///
/// # Panics
/// If a slice is shorter than `order^2` or `order > MAX_ORDER`.
pub fn add_product(order: usize, a: &[f32], b: &[f32], out: &mut [f32]) {
    let count = order * order;
    let (a, b, out) = (&a[..count], &b[..count], &mut out[..count]);
    for entry in &TENSOR.entries[..TENSOR.prefix[order]] {
        out[usize::from(entry.i)] += entry.value * a[usize::from(entry.j)] * b[usize::from(entry.k)];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sphere::harmonics::BAND;

    #[test]
    fn the_order_four_tensor_has_353_entries() {
        assert_eq!(entries(4), 353);
        assert_eq!((entries(1), entries(6)), (1, 2907));
        let smallest = TENSOR.entries.iter().map(|e| e.value.abs()).fold(f32::MAX, f32::min);
        assert!(smallest > 0.005, "the threshold of 1e-4 must lie in a gap: {smallest}");
    }

    #[test]
    fn the_tensor_is_symmetric_and_obeys_the_triangle_rule() {
        let find = |i, j, k| TENSOR.entries.iter().find(|e| (e.i, e.j, e.k) == (i, j, k)).map(|e| e.value);
        for e in &TENSOR.entries[..entries(4)] {
            for (i, j, k) in [(e.j, e.i, e.k), (e.i, e.k, e.j), (e.k, e.j, e.i)] {
                let other = find(i, j, k).expect("a permuted entry");
                assert!((other - e.value).abs() < 1e-6);
            }
            let l = [e.i, e.j, e.k].map(|i| BAND[usize::from(i)]);
            assert!(l[0] <= l[1] + l[2] && l[1] <= l[0] + l[2] && l[2] <= l[0] + l[1] && (l[0] + l[1] + l[2]) % 2 == 0);
        }
    }

    #[test]
    fn a_product_is_the_projection_of_the_pointwise_product() {
        for order in 1..=MAX_ORDER {
            let count = order * order;
            let a: Vec<f32> = (0..count).map(|i| (i as f32 * 1.3).sin()).collect();
            let b: Vec<f32> = (0..count).map(|i| (i as f32 * 0.7 + 1.0).cos()).collect();
            let mut found = vec![0.0f32; count];
            add_product(order, &a, &b, &mut found);
            // Another rule than the tensor's own, of higher degree.
            let directions = Directions::product(11, 23);
            let mut expected = vec![0.0f64; count];
            for q in 0..directions.len() {
                let y = evaluate(order, directions.direction(q));
                let value = |c: &[f32]| -> f64 { (0..count).map(|i| f64::from(c[i]) * f64::from(y[i])).sum() };
                let product = f64::from(directions.weights[q]) * value(&a) * value(&b);
                (0..count).for_each(|i| expected[i] += product * f64::from(y[i]));
            }
            for i in 0..count {
                // Up to about 100 f32 terms of size < 1 land on one coefficient: 100 * 6e-8, and the tensor's own 1e-6.
                assert!(
                    (f64::from(found[i]) - expected[i]).abs() < 2e-5,
                    "order {order}, {i}: {} {}",
                    found[i],
                    expected[i]
                );
            }
        }
    }
}
