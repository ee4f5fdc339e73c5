//! What the tests of the device share.
//!
//! `SMOKE_GPU=off` leaves all out and says so, `require` fails where there is no device, `auto` (the default) takes the
//! best there is. Every test prints the adapter and how many cases it compared.
// Not every test file uses all of it.
#![allow(dead_code)]

use glam::{DAffine3, DVec3, Vec3};
use smoke_formats::volume;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::gpu::device::{Choice, ForcedLimits, Gpu, adapters};
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::transport::SourceRadiance;
use std::path::Path;
use std::sync::Arc;

/// The device, or none where tests are told to do without or there is none; says which.
pub fn device(forced: ForcedLimits) -> Option<Arc<Gpu>> {
    let mode = std::env::var("SMOKE_GPU").unwrap_or_else(|_| "auto".into());
    assert!(
        ["off", "auto", "require"].contains(&mode.as_str()),
        "SMOKE_GPU: found {mode}, expected off, auto, require"
    );
    if mode == "off" || (mode == "auto" && adapters().is_empty()) {
        eprintln!("SMOKE_GPU={mode}: 0 GPU cases, no device is used");
        return None;
    }
    let gpu = Gpu::open(&Choice::Best, forced).unwrap_or_else(|e| panic!("SMOKE_GPU={mode}: {e}"));
    eprintln!("SMOKE_GPU={mode}: {} ({}, {})", gpu.summary().name, gpu.summary().backend, gpu.summary().driver);
    Some(Arc::new(gpu))
}

/// Says how many cases were compared.
pub fn told(cases: usize) {
    assert!(cases > 0);
    eprintln!("{cases} GPU cases");
}

/// A frame of the test data.
pub fn plume(number: i32) -> DensityField {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../testdata/plume/plume.{number:04}.vdb"));
    let grid = volume::read(&path, "density").unwrap();
    DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index)
}

/// A box of 7 x 5 x 6 voxels without symmetry, stretched and turned.
pub fn tiny() -> DensityField {
    let values: Vec<f32> = (0..210).map(|v| if v % 11 < 3 { 0.0 } else { 0.2 + (v % 7) as f32 * 0.1 }).collect();
    let turn = DAffine3::from_rotation_z(0.4) * DAffine3::from_scale(DVec3::new(0.2, 0.25, 0.3));
    DensityField::from_box([3, -4, 5], [7, 5, 6], &values, turn)
}

/// A coloured sky that is seen, and a sun.
pub fn sky() -> Vec<Light> {
    let mut environment = Environment::constant([0.3, 0.5, 0.9]);
    for (texel, radiance) in environment.radiance.iter_mut().enumerate() {
        radiance[0] *= 1.0 + (texel % 64) as f32 / 32.0;
    }
    (environment.visible, environment.rotation) = (true, 0.7);
    let sun = Light::Directional { toward: Vec3::new(0.48, -0.64, 0.6), irradiance: [3.0, 2.5, 2.0] };
    vec![Light::Environment(environment), sun]
}

/// Cameras outside, far away, close and inside the box.
pub fn cameras(field: &DensityField) -> Vec<Camera> {
    let middle = field.world_from_node.transform_point3(DVec3::from_array(field.dims.map(|n| n as f64 / 2.0)));
    let side = field.world_from_node.transform_vector3(DVec3::from_array(field.dims.map(|n| n as f64))).length();
    let at = |distance: f64, fov: f64| {
        let eye = middle + DVec3::new(0.6, -0.75, 0.3).normalize() * (distance * side);
        Camera::look_at(eye, middle + DVec3::new(0.02, 0.0, 0.03) * side, DVec3::Z, fov, 64, 48)
    };
    vec![at(1.5, 40.0), at(1e4, 0.006), at(0.5, 100.0), at(0.05, 80.0)]
}

/// RMSE of all values over the RMS of the expected; infinite if any is not a number.
pub fn difference(expected: &[f32], found: &[f32]) -> f64 {
    assert_eq!(expected.len(), found.len());
    let square = |v: f32| f64::from(v) * f64::from(v);
    let error: f64 = expected.iter().zip(found).map(|(a, b)| square(a - b)).sum();
    let size: f64 = expected.iter().map(|&a| square(a)).sum();
    assert!(size > 0.0, "nothing to compare");
    let relative = (error / size).sqrt();
    if relative.is_finite() { relative } else { f64::INFINITY }
}

/// Radiance and transmittance of all pixels.
pub fn radiance(film: &Film) -> Vec<f32> {
    film.pixels.iter().flat_map(|p| p.radiance.into_iter().chain(p.transmittance)).collect()
}

/// The processor's volume pass.
pub fn shaded(source: &dyn SourceRadiance, field: &DensityField, eye: DVec3) -> ShadedVolume {
    let mut volume = ShadedVolume::of(field);
    source.shade(field, eye, &mut volume);
    volume
}
