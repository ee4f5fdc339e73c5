//! The route through centres on the device against the processor: nodes, and images. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DAffine3, DVec3};
use gpu_common::{cameras, device, difference, radiance, shaded, sky, told};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_runtime::gpu::centres::{self, CentrePass, DeviceCentres};
use smoke_runtime::gpu::device::{ForcedLimits, Gpu};
use smoke_runtime::gpu::renderer::GpuRenderer;
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::light::Light;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::transport::SourceRadiance;
use smoke_runtime::transport::compensated::centres::incident::incident;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, CentreTransport, MultipleScattering};
use smoke_runtime::transport::compensated::centres::source::{CentreSource, UnitPlacement};
use smoke_runtime::transport::medium::MediumParameters;
use std::sync::Arc;

const DIMS: [usize; 3] = [25, 19, 30];

fn medium(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [6.0, 8.0, 9.0], albedo: [0.95, 0.9, 0.8], g }
}

/// `count` Gaussians in a part of the box, turned and scaled; the rest of it is thin smoke that no Gaussian reaches.
fn frame(count: usize, radius: f32) -> Frame {
    let unit = UnitSpace::of_box([2, -3, 1], DIMS.map(|n| n as u32));
    // Multiples of irrational numbers: spread evenly, the same every time.
    let spread = |i: usize, by: f32| (0.5 + i as f32 * by).fract();
    let gaussian = |i: usize| Gaussian {
        center: [0.1 + 0.4 * spread(i, 0.754_877_7), 0.1 + 0.5 * spread(i, 0.569_840_3), 0.6 * spread(i, 0.415_926_5)],
        radius: radius * (0.5 + spread(i, 0.618_034)),
        weight: 0.1 + spread(i, 0.324_717_96),
    };
    let gaussians: Vec<Gaussian> = (0..count).map(gaussian).collect();
    let first_node = [1, -4, 0];
    let value = |v: usize| {
        let at = [v % DIMS[0], v / DIMS[0] % DIMS[1], v / DIMS[0] / DIMS[1]];
        let x = [0, 1, 2].map(|a| unit.coordinate(a, first_node[a] + at[a] as i32));
        let inside = (0..3).all(|a| at[a] > 0 && at[a] + 1 < DIMS[a]);
        let term = |g: &Gaussian| {
            let q: f32 = (0..3).map(|a| ((x[a] - g.center[a]) / g.radius).powi(2)).sum();
            g.weight * (-q).exp()
        };
        if inside { 0.01 + gaussians.iter().map(term).sum::<f32>() } else { 0.0 }
    };
    let values: Vec<f32> = (0..DIMS.iter().product()).map(value).collect();
    let world_from_index =
        DAffine3::from_rotation_y(0.3) * DAffine3::from_scale(DVec3::splat(0.1)) * DAffine3::from_rotation_z(0.8);
    let world_from_node = world_from_index * DAffine3::from_translation(DVec3::from_array(first_node.map(f64::from)));
    let field = DensityField { dims: DIMS, values, world_from_node };
    Frame { field, gaussians, unit, first_node, world_from_index, transfer: None }
}

fn source(frame: &Frame, medium: &MediumParameters, settings: CentreSettings) -> CentreSource {
    let placement = UnitPlacement::of(frame).unwrap();
    let mut transport = CentreTransport::new(&frame.gaussians, settings).unwrap();
    let light = incident(&sky(), transport.directions(), transport.rings(), placement.rotation);
    let radiance = transport.radiance(medium, placement.length_world as f32, &light, None).unwrap();
    CentreSource::new(transport.points().clone(), radiance, frame, placement)
}

/// Relative RMSE of the shaded nodes.
fn nodes_differ(gpu: &Gpu, pass: &CentrePass, frame: &Frame, source: &CentreSource, eye: DVec3) -> f64 {
    let field = &frame.field;
    let expected = DeviceVolume::of_shaded(gpu, &shaded(source, field, eye)).unwrap().read(gpu).unwrap();
    let volume = DeviceVolume::of_field(gpu, field).unwrap();
    let density = gpu.upload("density", &field.values).unwrap();
    let on_device = DeviceCentres::new(gpu, source, field).unwrap();
    let eye = source.unit_from_world(eye);
    pass.shade(gpu, &on_device, (field, &density), &volume, eye).unwrap();
    let found = volume.read(gpu).unwrap();
    difference(expected.as_flattened(), found.as_flattened())
}

#[test]
fn nodes_get_the_same_from_the_centres_on_both_sides() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = CentrePass::new(&gpu).unwrap();
    let single = CentreSettings { multiple: MultipleScattering::None, ..CentreSettings::default() };
    let mut cases = 0;
    // One Gaussian, some, and more than a group finds at once.
    for (count, radius, settings) in [
        (1, 0.2, CentreSettings::default()),
        (70, 0.05, CentreSettings::default()),
        (70, 0.05, CentreSettings { order: 6, ..single }),
        (2300, 0.01, single),
    ] {
        let frame = frame(count, radius);
        for g in [0.0, 0.5] {
            let source = source(&frame, &medium(g), settings);
            assert_eq!(source.depends_on_view(), g != 0.0);
            for camera in cameras(&frame.field) {
                let worst = nodes_differ(&gpu, &pass, &frame, &source, camera.position);
                eprintln!("{count} Gaussians, g {g}: {worst:.1e}");
                // A few thousand products of a sum; a Gaussian at its cut, of 1e-4 of its height, may count on one side only.
                assert!(worst <= 1e-4, "{worst}");
                cases += 1;
            }
        }
    }
    told(cases);
}

#[test]
fn a_difference_planted_in_the_shader_of_the_centres_is_found() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let frame = frame(70, 0.05);
    let source = source(&frame, &medium(0.5), CentreSettings::default());
    let eye = cameras(&frame.field)[0].position;
    let mut cases = 0;
    for (from, to) in [
        ("SQUARE_CUT = 9.0", "SQUARE_CUT = 6.0"),
        ("32u * local, low", "31u * local, low"),
        ("exp(-square)", "exp(-1.01 * square)"),
        ("sum /= covered", "sum /= covered * 1.001"),
        ("SHARED = 8u", "SHARED = 16u"),
        ("- log(weights[h])", ""),
        ("k < each; k++) { sent", "k + 1u < each; k++) { sent"),
        ("axes[pass_.dims.x + at.y]", "axes[pass_.dims.x + at.x]"),
        ("if value < least", "if value > least"),
        ("place - pass_.eye.xyz", "place + pass_.eye.xyz"),
    ] {
        assert!(centres::SHADER.contains(from), "{from}");
        let pass = CentrePass::from_source(&gpu, &centres::SHADER.replace(from, to)).unwrap();
        let worst = nodes_differ(&gpu, &pass, &frame, &source, eye);
        eprintln!("{from} -> {to}: {worst:.1e}");
        assert!(worst > 1e-4, "{from} -> {to}: {worst}");
        cases += 1;
    }
    told(cases);
}

#[test]
fn images_through_the_centres_agree_after_every_kind_of_edit() {
    let tight = ForcedLimits { storage_binding: Some(1 << 20) };
    let mut cases = 0;
    for forced in [ForcedLimits::default(), tight] {
        let Some(gpu) = device(forced) else { return };
        let settings = RenderSettings { route: Route::Centres(CentreSettings::default()), ..RenderSettings::default() };
        let (first, other) = (frame(70, 0.05), frame(1, 0.2));
        let camera = cameras(&first.field);
        let mut cpu = Renderer::new(settings, medium(0.4), sky()).unwrap();
        let mut device = GpuRenderer::new(Arc::clone(&gpu), settings, medium(0.4), sky()).unwrap();
        let mut same = |cpu: &mut Renderer, device: &mut GpuRenderer, camera: usize, what: &str| {
            let (expected, _) = cpu.render(&cameras(&first.field)[camera]).unwrap();
            let (found, _) = device.render(&cameras(&first.field)[camera]).unwrap();
            let off = difference(&radiance(&expected), &radiance(&found));
            eprintln!("{what}: {off:.1e}");
            assert!(off <= 2e-3, "{what}: {off}");
            cases += 1;
        };
        let clone = |f: &Frame| Frame { field: f.field.clone(), gaussians: f.gaussians.clone(), transfer: None, ..*f };
        cpu.set_frame(clone(&first)).unwrap();
        device.set_frame(clone(&first)).unwrap();
        same(&mut cpu, &mut device, 0, "first");
        same(&mut cpu, &mut device, 2, "another eye");
        let light: Vec<Light> = vec![sky().remove(1)];
        cpu.set_lights(light.clone()).unwrap();
        device.set_lights(light).unwrap();
        same(&mut cpu, &mut device, 2, "other lights");
        cpu.set_medium(medium(0.7)).unwrap();
        device.set_medium(medium(0.7)).unwrap();
        same(&mut cpu, &mut device, 3, "another medium");
        cpu.set_frame(clone(&other)).unwrap();
        device.set_frame(clone(&other)).unwrap();
        same(&mut cpu, &mut device, 0, "another frame");
        assert_eq!(camera.len(), 4);
    }
    told(cases);
}
