//! The nodes that direct light is kept for: those with density and their neighbours, whose light is read with weight
//! between the two. In the order of the field, x fastest. Cost: a few operations a node.

use crate::medium::field::DensityField;

/// Positions of those nodes in `field.values`, ascending.
pub fn lit_nodes(field: &DensityField) -> Vec<u32> {
    let [nx, ny, nz] = field.dims;
    let mut near: Vec<bool> = field.values.iter().map(|&d| d > 0.0).collect();
    for (n, stride) in [(nx, 1), (ny, nx), (nz, nx * ny)] {
        let dense = near.clone();
        for outer in (0..dense.len()).step_by(n * stride) {
            for at in 0..n {
                let here = outer + at * stride..outer + (at + 1) * stride;
                for step in [-1isize, 1] {
                    if (at == 0 && step < 0) || (at + 1 == n && step > 0) {
                        continue;
                    }
                    let there = (here.start as isize + step * stride as isize) as usize;
                    near[here.clone()].iter_mut().zip(&dense[there..]).for_each(|(n, d)| *n |= *d);
                }
            }
        }
    }
    (0..near.len() as u32).filter(|&v| near[v as usize]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DAffine3;

    #[test]
    fn a_single_voxel_has_twenty_six_neighbours_and_emptiness_none() {
        let mut values = [0.0f32; 5 * 4 * 6];
        values[2 + 5 * (1 + 4 * 3)] = 0.5;
        let field = DensityField::from_box([0; 3], [5, 4, 6], &values, DAffine3::IDENTITY);
        let nodes = lit_nodes(&field);
        assert_eq!(nodes.len(), 27);
        let place = |v: u32| [v % 7, v / 7 % 6, v / 42];
        assert!(nodes.iter().all(|&v| place(v).iter().zip([3, 2, 4]).all(|(p, c)| p.abs_diff(c) <= 1)));
        assert!(nodes.is_sorted());
        let empty = DensityField::from_box([0; 3], [3; 3], &[0.0; 27], DAffine3::IDENTITY);
        assert!(lit_nodes(&empty).is_empty());
    }
}
