//! The device against the processor, pass by pass on buffers, and on images. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::DVec3;
use gpu_common::{cameras, device, difference, plume, radiance, shaded, sky, tiny, told};
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::backdrop::Sky;
use smoke_runtime::camera::Camera;
use smoke_runtime::gpu::device::{Choice, ForcedLimits, Gpu, GpuError};
use smoke_runtime::gpu::march::{self, DeviceSky, MarchPass};
use smoke_runtime::gpu::renderer::{GpuRenderError, GpuRenderer, SolveOn};
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::gpu::volume_pass::{self, DeviceSource, VolumePass};
use smoke_runtime::light::{Environment, Light, beams};
use smoke_runtime::march::{MarchMedium, MarchSettings, march};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::grid::route::{GridSettings, GridSource, GridTransport};
use smoke_runtime::transport::medium::MediumParameters;
use std::sync::Arc;

/// Relative RMSE of images: what the device is promised to keep.
const IMAGE: f64 = 2e-3;
/// Relative RMSE of a march of the same volume. Places are good to 2e-7 of the box's side, so that a density is off by 2e-5
/// of the difference between nodes; Vulkan allows `exp` 3 + 2x units in the last place, and `atan2` 4,096, which is 1e-4
/// of the test's sky. A software device keeps 3e-7.
const PASS: f64 = 1e-4;

fn medium(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [6.0, 8.0, 9.0], albedo: [0.95, 0.9, 0.8], g }
}

fn source(field: &DensityField, g: f32) -> GridSource {
    let settings = GridSettings { beams: 8, rings: 2, single_step: 2, ..GridSettings::default() };
    GridTransport::new(settings).solve(field, &beams(&sky(), 8), &medium(g).banded(4), ScatteringOrder::All)
}

fn films_differ(gpu: &Gpu, pass: &MarchPass, shaded: &ShadedVolume, volume: &DeviceVolume, camera: &Camera) -> f64 {
    let mut worst = 0.0f64;
    for (medium, samples) in [(MarchMedium::plain([6.0; 3]), 1), (MarchMedium::of([6.0, 8.0, 9.0], [4.0, 5.0, 6.0]), 2)]
    {
        let sky = Arc::new(Sky::new(&sky(), (samples == 2).then_some((0.8, 4))));
        let settings = MarchSettings { samples, ..MarchSettings::default() };
        let expected = march(shaded, camera, &medium, &*sky, &settings);
        let on_device = DeviceSky::new(gpu, &sky).unwrap();
        let found = pass.film(gpu, volume, camera, &medium, &on_device, &settings).unwrap();
        worst = worst.max(difference(&radiance(&expected), &radiance(&found)));
        // Depth is the first sample with density: a rounding makes it the next in a few pixels.
        let agree = |a: f32, b: f32| a == b || (a - b).abs() <= 1e-5 * a.abs();
        let pairs = expected.pixels.iter().zip(&found.pixels);
        let same = pairs.filter(|(a, b)| agree(a.depth, b.depth)).count();
        let share = same as f64 / expected.pixels.len() as f64;
        assert!(worst > PASS || share > 0.98, "depth agrees in {share} of the pixels");
    }
    worst
}

#[test]
fn a_march_is_the_same_on_both_sides_from_anywhere() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = MarchPass::new(&gpu).unwrap();
    let mut cases = 0;
    for field in [plume(4), tiny()] {
        let source = source(&field, 0.3);
        for camera in cameras(&field) {
            let shaded = shaded(&source, &field, camera.position);
            let volume = DeviceVolume::of_shaded(&gpu, &shaded).unwrap();
            let worst = films_differ(&gpu, &pass, &shaded, &volume, &camera);
            eprintln!("march {:?} from {:?}: {worst:.1e}", field.dims, camera.position);
            assert!(worst <= PASS, "{worst}");
            cases += 1;
        }
    }
    told(cases);
}

/// Largest relative difference of the shaded nodes that the processor computes.
fn nodes_differ(gpu: &Gpu, pass: &VolumePass, field: &DensityField, source: &GridSource, eye: DVec3) -> f64 {
    let expected = DeviceVolume::of_shaded(gpu, &shaded(source, field, eye)).unwrap().read(gpu).unwrap();
    let volume = DeviceVolume::of_field(gpu, field).unwrap();
    let density = gpu.upload("density", &field.values).unwrap();
    let on_device = DeviceSource::new(gpu, source).unwrap();
    pass.shade(gpu, &on_device, (field, &density), &volume, eye).unwrap();
    let found = volume.read(gpu).unwrap();
    assert_eq!(expected.len(), found.len());
    // The processor leaves out nodes that no sample reads.
    let (a, b): (Vec<[f32; 4]>, Vec<[f32; 4]>) =
        expected.iter().zip(found).filter(|(e, _)| e.iter().any(|&v| v > 0.0)).unzip();
    difference(a.as_flattened(), b.as_flattened())
}

#[test]
fn a_volume_pass_is_the_same_on_both_sides_for_any_eye_and_coloured_or_grey() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = VolumePass::new(&gpu).unwrap();
    let mut cases = 0;
    for field in [plume(2), tiny()] {
        for g in [0.0, 0.5] {
            let source = source(&field, g);
            for camera in cameras(&field) {
                let worst = nodes_differ(&gpu, &pass, &field, &source, camera.position);
                eprintln!("volume pass {:?}, g {g}: {worst:.1e}", field.dims);
                // Up to 16 products of a sum, each with a few roundings.
                assert!(worst <= 1e-5, "{worst}");
                cases += 1;
            }
        }
    }
    let field = tiny();
    let grey = MediumParameters { sigma_t: [5.0; 3], albedo: [0.9; 3], g: 0.2 };
    let lights = [Light::Environment(Environment::constant([1.0; 3]))];
    let source = GridTransport::new(GridSettings::default()).solve(
        &field,
        &beams(&lights, 8),
        &grey.banded(4),
        ScatteringOrder::All,
    );
    assert_eq!(source.channels, 1);
    assert!(nodes_differ(&gpu, &pass, &field, &source, DVec3::new(3.0, 4.0, -2.0)) <= 1e-5);
    told(cases + 1);
}

#[test]
fn a_difference_planted_in_a_shader_is_found_by_the_comparison_of_its_pass() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let (field, mut cases) = (tiny(), 0);
    let source = source(&field, 0.5);
    let camera = cameras(&field)[0];
    let shaded = shaded(&source, &field, camera.position);
    let volume = DeviceVolume::of_shaded(&gpu, &shaded).unwrap();
    for (from, to) in [
        ("x * 0.5 *", "x * 0.52 *"),
        ("let offset = 0.5", "let offset = 0.6"),
        ("at + 31u", "at + 30u"),
        ("march.peak_ratio.xyz)", "march.peak_ratio.xyz * 1.02)"),
        ("environment.rotation) / TAU", "environment.rotation * 1.05) / TAU"),
        ("acos(clamp(d.z", "acos(clamp(-d.z"),
        (" < march.cutoff", " < 300.0 * march.cutoff"),
    ] {
        assert!(march::SHADER.contains(from), "{from}");
        let pass = MarchPass::from_source(&gpu, &march::SHADER.replace(from, to)).unwrap();
        let worst = films_differ(&gpu, &pass, &shaded, &volume, &camera);
        eprintln!("{from} -> {to}: {worst:.1e}");
        assert!(worst > PASS, "{from}: {worst}");
        cases += 1;
    }
    for (from, to) in [
        ("0.282094792 * q00", "0.2822 * q00"),
        ("let q11 = -1.0", "let q11 = 1.0"),
        ("c = at / pass_.step + 1u", "c = at / pass_.step"),
        ("number % pass_.channels", "(number + 1u) % pass_.channels"),
        ("max(nodes[thread].xyz, vec3(0.0))", "nodes[thread].xyz * 1.001"),
    ] {
        assert!(volume_pass::SHADER.contains(from), "{from}");
        let pass = VolumePass::from_source(&gpu, &volume_pass::SHADER.replace(from, to)).unwrap();
        let worst = nodes_differ(&gpu, &pass, &field, &source, camera.position);
        eprintln!("{from} -> {to}: {worst:.1e}");
        assert!(worst > 1e-5, "{from}: {worst}");
        cases += 1;
    }
    told(cases);
}

fn frame(field: DensityField) -> Frame {
    let unit = UnitSpace::of_box([0; 3], [8; 3]);
    let world_from_index = field.world_from_node;
    Frame { field, gaussians: vec![], unit, first_node: [0; 3], world_from_index, transfer: None }
}

#[test]
fn images_agree_after_every_kind_of_edit_and_with_pages_of_few_bricks() {
    let tight = ForcedLimits { storage_binding: Some(4 << 20) };
    let mut cases = 0;
    for (forced, solve_on) in [(ForcedLimits::default(), SolveOn::Processor), (tight, SolveOn::Device)] {
        let Some(gpu) = device(forced) else { return };
        // A software device takes minutes for the default's 64 beams and 50 ordinates.
        let grid = GridSettings { beams: 16, rings: 3, ..GridSettings::default() };
        let settings = RenderSettings { route: Route::Grid(grid), ..RenderSettings::default() };
        let (field, other) = (plume(6), tiny());
        let camera = cameras(&field);
        let mut cpu = Renderer::new(settings, medium(0.4), sky()).unwrap();
        let mut device = GpuRenderer::new(Arc::clone(&gpu), settings, medium(0.4), sky(), solve_on).unwrap();
        let mut same = |cpu: &mut Renderer, device: &mut GpuRenderer, camera: &Camera, what: &str| {
            let (expected, a) = cpu.render(camera).unwrap();
            let (found, b) = device.render(camera).unwrap();
            let off = difference(&radiance(&expected), &radiance(&found));
            eprintln!("{what}: {off:.1e}; {a:?}, {b:?}");
            assert!(off <= IMAGE, "{what}: {off}");
            cases += 1;
        };
        cpu.set_frame(frame(field.clone())).unwrap();
        device.set_frame(UploadedFrame::new(&gpu, frame(field)).unwrap()).unwrap();
        same(&mut cpu, &mut device, &camera[0], "first");
        same(&mut cpu, &mut device, &camera[2], "another eye");
        let light = vec![sky().remove(1)];
        cpu.set_lights(light.clone()).unwrap();
        device.set_lights(light).unwrap();
        same(&mut cpu, &mut device, &camera[2], "other lights");
        cpu.set_medium(medium(0.75)).unwrap();
        device.set_medium(medium(0.75)).unwrap();
        same(&mut cpu, &mut device, &camera[2], "a medium with a peak");
        let camera = cameras(&other);
        cpu.set_frame(frame(other.clone())).unwrap();
        device.set_frame(UploadedFrame::new(&gpu, frame(other)).unwrap()).unwrap();
        same(&mut cpu, &mut device, &camera[0], "another frame");
    }
    told(cases);
}

#[test]
fn what_a_device_cannot_hold_or_do_is_refused_by_name() {
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(64 << 10) }) else { return };
    assert_eq!(gpu.summary().storage_binding, 64 << 10);
    let mut renderer =
        GpuRenderer::new(Arc::clone(&gpu), RenderSettings::default(), medium(0.0), sky(), SolveOn::Device).unwrap();
    let mut show = |field: DensityField| -> Result<(), GpuRenderError> {
        let camera = cameras(&field)[0];
        renderer.set_frame(UploadedFrame::new(&gpu, frame(field))?)?;
        renderer.render(&camera).map(|_| ())
    };
    let error = show(plume(1)).unwrap_err();
    assert!(matches!(error, GpuRenderError::Gpu(GpuError::Limit { limit: 65536, .. })), "{error}");
    assert!(error.to_string().ends_with("use --device cpu"), "{error}");
    // The device serves on: a frame that fits is shown.
    show(tiny()).unwrap();

    let error = Gpu::open(&Choice::Named("no such thing".into()), ForcedLimits::default()).err().unwrap();
    assert!(matches!(&error, GpuError::NoDevice { found, .. } if !found.is_empty()), "{error}");
    told(3);
}

#[test]
fn half_resolution_is_the_same_on_both_sides_for_odd_sizes_and_with_a_peak() {
    // Runs of some hundred pixels: lists are cut as films are.
    let tight = ForcedLimits { storage_binding: Some(1 << 16) };
    let mut cases = 0;
    for (forced, field) in [(ForcedLimits::default(), plume(6)), (tight, tiny())] {
        let Some(gpu) = device(forced) else { return };
        let source = source(&field, 0.5);
        let pass = MarchPass::new(&gpu).unwrap();
        for (width, height) in [(64, 48), (63, 47), (61, 1)] {
            let camera = Camera { width, height, ..cameras(&field)[0] };
            let shaded = shaded(&source, &field, camera.position);
            let volume = DeviceVolume::of_shaded(&gpu, &shaded).unwrap();
            for (medium, samples) in
                [(MarchMedium::plain([6.0; 3]), 1), (MarchMedium::of([6.0, 8.0, 9.0], [4.0, 5.0, 6.0]), 2)]
            {
                let sky = Arc::new(Sky::new(&sky(), (samples == 2).then_some((0.8, 4))));
                let settings = MarchSettings { samples, half_resolution: true, ..MarchSettings::default() };
                let expected = march(&shaded, &camera, &medium, &*sky, &settings);
                let whole = MarchSettings { half_resolution: false, ..settings };
                let whole = march(&shaded, &camera, &medium, &*sky, &whole);
                let on_device = DeviceSky::new(&gpu, &sky).unwrap();
                let found = pass.film(&gpu, &volume, &camera, &medium, &on_device, &settings).unwrap();
                let off = difference(&radiance(&expected), &radiance(&found));
                let apart = difference(&radiance(&expected), &radiance(&whole));
                eprintln!("half resolution {width} x {height}: {off:.1e}; from whole resolution {apart:.1e}");
                // It is half resolution that is compared: a quarter of the rays.
                assert!(off <= PASS && (height == 1 || apart > 10.0 * PASS), "{off} {apart}");
                cases += 1;
            }
        }
    }
    told(cases);
}

#[test]
fn a_lost_device_is_an_error_that_says_what_to_do() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let mut renderer =
        GpuRenderer::new(Arc::clone(&gpu), RenderSettings::default(), medium(0.0), sky(), SolveOn::Device).unwrap();
    renderer.set_frame(UploadedFrame::new(&gpu, frame(tiny())).unwrap()).unwrap();
    gpu.parts().0.destroy();
    let error = renderer.render(&cameras(&tiny())[0]).unwrap_err();
    assert!(error.to_string().contains("--device cpu"), "{error}");
    eprintln!("{error}");
    told(1);
}
