//! A tiny image, on the processor and on the device: a driver that computes wrongly is found before it is believed.

use super::device::{Gpu, GpuError};
use super::march::{DeviceSky, MarchPass};
use super::volume::DeviceVolume;
use crate::backdrop::Sky;
use crate::camera::Camera;
use crate::march::{MarchMedium, MarchSettings, march};
use crate::shaded_volume::ShadedVolume;
use glam::{DAffine3, DVec3};
use std::sync::Arc;

/// Largest difference of radiance or transmittance, both up to about 1: some ten samples of a few roundings each are
/// 1e-5, and a place that is off by a rounding of the box's side moves a density by as little.
const TOLERANCE: f32 = 1e-4;

/// Marches a coloured ramp of 9 x 10 x 11 nodes, 16 x 12 pixels, on both sides.
pub fn check(gpu: &Gpu, pass: &MarchPass) -> Result<(), GpuError> {
    let dims = [9, 10, 11];
    let node = |v: usize| {
        let (i, j, k) = (v % 9, v / 9 % 10, v / 90);
        let inside = [i, j, k].iter().zip(dims).all(|(&c, n)| c > 0 && c + 1 < n);
        let density = if inside { 0.1 + 0.05 * (i + j % 3) as f32 } else { 0.0 };
        [0.1 * i as f32, 0.5, 0.08 * k as f32, density]
    };
    let nodes: Vec<[f32; 4]> = (0..dims.iter().product()).map(node).collect();
    let volume = ShadedVolume::of_nodes(dims, &nodes, DAffine3::from_scale(DVec3::splat(0.25)));
    let camera = Camera::look_at(DVec3::new(-4.0, 1.5, 2.5), DVec3::new(1.0, 1.1, 1.2), DVec3::Z, 40.0, 16, 12);
    let (medium, settings) = (MarchMedium::plain([0.5, 1.0, 1.5]), MarchSettings::default());
    let sky = Arc::new(Sky::new(&[], None));
    let expected = march(&volume, &camera, &medium, &*sky, &settings);
    let on_device = DeviceVolume::of_shaded(gpu, &volume)?;
    let found = pass.film(gpu, &on_device, &camera, &medium, &DeviceSky::new(gpu, &sky)?, &settings)?;
    let mut worst = 0.0f32;
    for (a, b) in expected.pixels.iter().zip(&found.pixels) {
        for c in 0..3 {
            let off = (a.radiance[c] - b.radiance[c]).abs().max((a.transmittance[c] - b.transmittance[c]).abs());
            // A value that is not a number is as wrong as can be.
            worst = if off <= worst { worst } else { off };
            worst = if off.is_nan() { f32::INFINITY } else { worst };
        }
    }
    match worst <= TOLERANCE {
        true => Ok(()),
        false => Err(GpuError::SelfTest { found: worst.to_string(), expected: TOLERANCE.to_string() }),
    }
}
