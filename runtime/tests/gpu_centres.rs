//! The route through centres on the device against the processor: nodes, and images. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DAffine3, DVec3};
use gpu_common::{cameras, device, difference, radiance, shaded, sky, told};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_runtime::gpu::centre_solve::{DEPTH, DeviceKernels, PRODUCT, SINGLE};
use smoke_runtime::gpu::centres::{self, CentrePass, DeviceCentres};
use smoke_runtime::gpu::device::{ForcedLimits, Gpu};
use smoke_runtime::gpu::renderer::{GpuRenderer, SolveOn};
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::light::Light;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::medium::gaussian_points::GaussianPoints;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::sphere::quadrature::Directions;
use smoke_runtime::transport::SourceRadiance;
use smoke_runtime::transport::compensated::centres::incident::incident;
use smoke_runtime::transport::compensated::centres::integral::IntegralTransport;
use smoke_runtime::transport::compensated::centres::kernels::{Attenuation, CentreKernels, Processor, TransportMatrix};
use smoke_runtime::transport::compensated::centres::overlap::OverlapGrid;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, CentreTransport, MultipleScattering};
use smoke_runtime::transport::compensated::centres::single::{Basis, IncidentRadiance};
use smoke_runtime::transport::compensated::centres::source::{CentreSource, UnitPlacement};
use smoke_runtime::transport::medium::MediumParameters;
use std::sync::Arc;

/// Relative RMSE of depths, single scattering and products: the same polynomials in the same order of terms, of which a
/// device may fuse multiplication and addition. Depths: some roundings a term, 3e-7. Single scattering: those of a
/// transmittance, 4e-7 (an exponent x errs by 6e-8 x, which x exp(-x) < 0.4 takes back), and 98 products added in another
/// order, sqrt(98) 6e-8 = 6e-7. Products: a vector rounded to f32, sums of some hundred products, 5e-7.
const LIMITS: [f64; 3] = [2e-6; 3];
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
        let mut device = GpuRenderer::new(Arc::clone(&gpu), settings, medium(0.4), sky(), SolveOn::Device).unwrap();
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
        device.set_frame(UploadedFrame::new(&gpu, clone(&first)).unwrap()).unwrap();
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
        device.set_frame(UploadedFrame::new(&gpu, clone(&other)).unwrap()).unwrap();
        same(&mut cpu, &mut device, 0, "another frame");
        assert_eq!(camera.len(), 4);
    }
    told(cases);
}

/// Relative RMSE of depths, single scattering and products on both sides, each from the processor's input.
fn stages_differ(kernels: &DeviceKernels, frame: &Frame, g: f32, sigma_t: f32) -> [f64; 3] {
    let (points, directions) = (GaussianPoints::new(&frame.gaussians).unwrap(), Directions::product(7, 14));
    let depth = Processor.depth(&points, &directions).unwrap();
    let depths = difference(depth.values(), kernels.depth(&points, &directions).unwrap().values());
    let medium = MediumParameters { sigma_t: [1.0, 0.7, 0.3].map(|s| s * sigma_t), ..medium(g) }.banded(4);
    let scale = medium.sigma_t.map(|s| f64::from(s) * points.density_scale);
    let incident = incident(&sky(), &directions, 7, UnitPlacement::of(frame).unwrap().rotation);
    let (radiance, basis) = (IncidentRadiance::sampled(&incident, &directions), Basis::new(4, &directions));
    let light = Attenuation {
        depth: &depth,
        count: points.len(),
        optical_scale: scale,
        medium: &medium,
        radiance: &radiance,
        basis: &basis,
    };
    let (expected, found) = (Processor.single(&light).unwrap(), kernels.single(&light).unwrap());
    let single = difference(expected.as_flattened(), found.as_flattened());
    let bands = if g == 0.0 { 1 } else { 2 };
    let grid = OverlapGrid::new(&points);
    let matrix = IntegralTransport::new(&points, &grid, &directions, &depth, scale[0], bands);
    let v: Vec<f64> = (0..points.len() * bands * bands).map(|i| (i as f64 * 0.37).sin() + 0.5).collect();
    let (mut expected, mut found) = (v.clone(), v.clone());
    matrix.product(&v, &mut expected).unwrap();
    kernels.matrix(matrix).unwrap().product(&v, &mut found).unwrap();
    // Without extinction nothing arrives, on both sides.
    if scale[0] == 0.0 {
        assert!(expected.iter().chain(&found).all(|&v| v == 0.0));
        return [depths, single, 0.0];
    }
    let narrow = |v: Vec<f64>| -> Vec<f32> { v.into_iter().map(|v| v as f32).collect() };
    [depths, single, difference(&narrow(expected), &narrow(found))]
}

fn told_of([depths, single, product]: [f64; 3]) -> String {
    format!("depths {depths:.1e}, single {single:.1e}, product {product:.1e}")
}

#[test]
fn depths_single_scattering_and_products_are_the_same_on_both_sides() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let kernels = DeviceKernels::new(gpu).unwrap();
    let (mut cases, mut most) = (0, [0.0f64; 3]);
    for (count, radius) in [(1, 0.2), (300, 0.04)] {
        let frame = frame(count, radius);
        for g in [0.0, 0.5] {
            for sigma_t in [0.0, 1.0, 1e6] {
                let found = stages_differ(&kernels, &frame, g, sigma_t);
                eprintln!("{count} Gaussians, g {g}, sigma_t {sigma_t}: {}", told_of(found));
                (0..3).for_each(|k| most[k] = most[k].max(found[k]));
                cases += 3;
            }
        }
    }
    eprintln!("largest: {}", told_of(most));
    assert!((0..3).all(|k| most[k] <= LIMITS[k]), "{most:?}");
    told(cases);
}

#[test]
fn a_difference_planted_in_the_shaders_of_the_solution_is_found() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let frame = frame(70, 0.05);
    let mut cases = 0;
    for (stage, from, to) in [
        (0, "along < 0.0", "along > 0.0"),
        (0, "t * p;", "1.0001 * t * p;"),
        (0, "- n * 1.4286068e-6", "- n * 1.4286068e-5"),
        (0, "to - along * w", "to"),
        (0, "SQRT_PI = 1.7724539", "SQRT_PI = 1.7726"),
        (1, "* transmittance *", "*"),
        (1, "q = 0u", "q = 1u"),
        (1, "gains[k]", "gains[0]"),
        (1, "p * f + 0.055507336", "p * f + 0.0557"),
        (2, "half > 0u", "half > 1u"),
        (2, "h = local;", "h = local + 1u;"),
        (2, "product_.a != product_.b", "product_.a == product_.b"),
        (2, "vec2(sent[product_.b", "vec2(sent[product_.a"),
    ] {
        let mut sources = [DEPTH, SINGLE, PRODUCT].map(str::to_owned);
        assert!(sources[stage].contains(from), "{from}");
        sources[stage] = sources[stage].replace(from, to);
        let kernels = DeviceKernels::from_sources(Arc::clone(&gpu), sources.each_ref().map(String::as_str)).unwrap();
        let found = stages_differ(&kernels, &frame, 0.5, 10.0)[stage];
        eprintln!("{from} -> {to}: {found:.1e}");
        assert!(found > LIMITS[stage], "{from} -> {to}: {found}");
        cases += 1;
    }
    told(cases);
}
