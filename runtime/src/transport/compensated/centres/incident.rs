//! Lights as radiance along the quadrature directions of the centres.
//!
//! Every direction of the product rule owns a cell of the sphere of exactly its weight: a band in z as wide as its
//! Gauss–Legendre weight (the weights separate the nodes) and an equal part of the azimuth. A direction gets the mean
//! radiance of its cell, so one bright texel keeps its flux, and a uniform sky is exactly uniform. A directional light
//! becomes the radiance `irradiance / solid angle` of the cell that it falls in; its place is then good to half a cell.
//! Cost: O(texels).

use super::single::IncidentRadiance;
use crate::light::Light;
use crate::sphere::quadrature::Directions;
use glam::{DMat3, DVec3};

/// Radiance along `directions = Directions::product(rings, 2 * rings)` of unit space. `world_from_unit` is its rotation
/// (or reflection) to the world: an orthogonal matrix.
pub fn incident(lights: &[Light], directions: &Directions, rings: usize, world_from_unit: DMat3) -> IncidentRadiance {
    let azimuth = 2 * rings;
    // Upper end in z of every ring's band; the weights of all rings are 2.
    let mut top = -1.0;
    let tops: Vec<f64> = (0..rings)
        .map(|ring| {
            top += f64::from(directions.weights[ring * azimuth]) * azimuth as f64 / std::f64::consts::TAU;
            top
        })
        .collect();
    let unit_from_world = world_from_unit.transpose();
    let cell = |toward: DVec3| -> usize {
        let d = unit_from_world * toward;
        let ring = tops[..rings - 1].partition_point(|&top| top <= d.z);
        let turn = d.y.atan2(d.x) / std::f64::consts::TAU;
        ring * azimuth + (((turn - turn.floor()) * azimuth as f64) as usize).min(azimuth - 1)
    };
    let mut radiance = vec![[0.0f64; 3]; directions.len()];
    for light in lights {
        match light {
            Light::Environment(environment) => {
                for (sum, mean) in radiance.iter_mut().zip(environment.mean_over_cells(directions.len(), cell)) {
                    (0..3).for_each(|c| sum[c] += mean[c]);
                }
            }
            Light::Directional { toward, irradiance } => {
                let q = cell(toward.as_dvec3());
                (0..3).for_each(|c| radiance[q][c] += f64::from(irradiance[c]) / f64::from(directions.weights[q]));
            }
            Light::Point { .. } => {}
        }
    }
    IncidentRadiance::Sampled(radiance.into_iter().map(|r| r.map(|v| v as f32)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::light::Environment;

    fn sampled(lights: &[Light], rings: usize, turn: DMat3) -> (Vec<[f32; 3]>, Directions) {
        let directions = Directions::product(rings, 2 * rings);
        let IncidentRadiance::Sampled(values) = incident(lights, &directions, rings, turn) else { unreachable!() };
        (values, directions)
    }

    #[test]
    fn every_direction_lies_in_its_own_cell_and_a_sun_keeps_its_flux() {
        let turn = DMat3::from_rotation_y(0.7) * DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0));
        for rings in [1, 2, 7, 16] {
            let directions = Directions::product(rings, 2 * rings);
            for q in 0..directions.len() {
                let toward = (turn * directions.direction(q).as_dvec3()).as_vec3();
                let (values, _) = sampled(&[Light::Directional { toward, irradiance: [1.0, 2.0, 3.0] }], rings, turn);
                let lit: Vec<usize> = (0..values.len()).filter(|&p| values[p] != [0.0; 3]).collect();
                assert_eq!(lit, [q], "rings {rings}");
                assert!((values[q][2] * directions.weights[q] - 3.0).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn a_uniform_sky_is_uniform_and_a_bright_texel_keeps_its_flux() {
        let (values, _) = sampled(&[Light::Environment(Environment::constant([2.0, 1.0, 0.5]))], 7, DMat3::IDENTITY);
        assert!(values.iter().all(|v| *v == [2.0, 1.0, 0.5]));
        let mut sky = Environment::constant([0.0; 3]);
        sky.radiance[64 * 9 + 20] = [1e4; 3];
        let (values, directions) = sampled(&[Light::Environment(sky)], 7, DMat3::IDENTITY);
        let flux: f64 = values.iter().zip(&directions.weights).map(|(v, w)| f64::from(v[0]) * f64::from(*w)).sum();
        let pi = std::f64::consts::PI;
        let solid_angle = ((pi * 9.0 / 32.0).cos() - (pi * 10.0 / 32.0).cos()) * 2.0 * pi / 64.0;
        // A cell's solid angle is counted in samples: 512 across, 36 to a cell's width, so one in 36 at its edges.
        assert!((flux / (1e4 * solid_angle) - 1.0).abs() < 0.03, "{flux} {solid_angle}");
    }
}
