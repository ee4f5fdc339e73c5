//! Limits of small devices: 64 MiB a binding under a frame that is larger, and no texture in any shader. `gpu_common` says
//! where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DAffine3, DVec3};
use gpu_common::{cameras, device, difference, radiance, sky, told};
use naga::TypeInner;
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::backdrop::Sky;
use smoke_runtime::camera::Camera;
use smoke_runtime::gpu::device::ForcedLimits;
use smoke_runtime::gpu::march::{self as gpu_march, DeviceSky, MarchPass};
use smoke_runtime::gpu::pass::PRELUDE;
use smoke_runtime::gpu::renderer::{GpuRenderer, SolveOn};
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::gpu::{centre_solve, centres, decode, gmres, scatter, single, transfer, volume_pass};
use smoke_runtime::march::{self, MarchMedium, MarchSettings};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::grid::route::GridSettings;
use smoke_runtime::transport::medium::MediumParameters;
use std::path::Path;
use std::sync::Arc;

/// Relative RMSE of images: what the device is promised to keep.
const IMAGE: f64 = 2e-3;
/// Bytes that a shader sees of one buffer: half of what Vulkan and WebGPU promise.
const BINDING: u64 = 64 << 20;
/// Voxels a side of a box that is full of smoke: 49^3 bricks of 2,000 bytes, 235 MB in four pages.
const SIDE: usize = 192;

/// Smoke in every voxel.
fn full() -> DensityField {
    let value = |v: usize| 0.02 + 0.01 * ((v % SIDE) as f32 * 0.2).sin() * ((v / SIDE / SIDE) as f32 * 0.1).cos();
    let values: Vec<f32> = (0..SIDE * SIDE * SIDE).map(value).collect();
    DensityField::from_box([0; 3], [SIDE; 3], &values, DAffine3::from_scale(DVec3::splat(1.0 / SIDE as f64)))
}

#[test]
fn a_frame_above_64_mib_is_shown_in_pages_and_its_image_does_not_depend_on_them() {
    let field = full();
    // Sources on every eighth node, of one band: what is tested are the nodes of the frame.
    let grid = GridSettings { beams: 1, single_step: 8, multiple_step: 8, rings: 1, ..GridSettings::default() };
    let scattering = ScatteringOrder::Single;
    let settings = RenderSettings { route: Route::Grid(grid), scattering, ..RenderSettings::default() };
    let medium = MediumParameters { sigma_t: [40.0, 60.0, 80.0], albedo: [0.95, 0.9, 0.8], g: 0.0 };
    let camera = cameras(&field)[0];
    let frame = |field: DensityField| {
        let (unit, world_from_index) = (UnitSpace::of_box([0; 3], [8; 3]), field.world_from_node);
        Frame { field, gaussians: vec![], unit, first_node: [0; 3], world_from_index, transfer: None }
    };
    let mut images = Vec::new();
    for binding in [Some(BINDING), None] {
        let Some(gpu) = device(ForcedLimits { storage_binding: binding }) else { return };
        let volume = DeviceVolume::of_field(&gpu, &field).unwrap();
        let used = (0..volume.pages.len()).filter(|&page| volume.page(page).1 > 0).count();
        assert!(binding.is_none() || used == 4, "{used} pages");
        assert!(binding.is_none() || volume.pages.iter().all(|page| page.size() <= BINDING));
        drop(volume);
        let frame = UploadedFrame::new(&gpu, frame(field.clone())).unwrap();
        let mut renderer = GpuRenderer::new(gpu, settings, medium, sky(), SolveOn::Processor).unwrap();
        renderer.set_frame(frame).unwrap();
        let (film, seconds) = renderer.render(&camera).unwrap();
        eprintln!("binding {binding:?}, {used} pages: {seconds:?}");
        images.push(radiance(&film));
    }
    // A page changes where a node lies, not what is done with it.
    assert!(images[0] == images[1], "{}", difference(&images[0], &images[1]));
    let mut renderer = Renderer::new(settings, medium, sky()).unwrap();
    renderer.set_frame(frame(field)).unwrap();
    let off = difference(&radiance(&renderer.render(&camera).unwrap().0), &images[0]);
    eprintln!("{SIDE}^3 under {BINDING} bytes a binding: {off:.1e}");
    assert!(off <= IMAGE, "{off}");
    told(2);
}

#[test]
fn pages_that_are_taken_for_each_other_are_found() {
    // 8^3 bricks of 2,000 bytes: four pages of 131 bricks at most.
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(256 << 10) }) else { return };
    let node = |v: usize| {
        let at = [v % 33, v / 33 % 33, v / 1089].map(|c| c as f32 / 32.0);
        [at[0], at[1], at[2], 0.5 + 0.4 * (9.0 * at[2]).sin()]
    };
    let nodes: Vec<[f32; 4]> = (0..33 * 33 * 33).map(node).collect();
    let shaded = ShadedVolume::of_nodes([33; 3], &nodes, DAffine3::from_scale(DVec3::splat(1.0 / 32.0)));
    let volume = DeviceVolume::of_shaded(&gpu, &shaded).unwrap();
    assert!((0..4).all(|page| volume.page(page).1 > 0));
    let camera = Camera::look_at(DVec3::new(2.0, -1.5, 1.2), DVec3::splat(0.5), DVec3::Z, 50.0, 48, 36);
    let (medium, settings) = (MarchMedium::plain([3.0; 3]), MarchSettings::default());
    let sky = Arc::new(Sky::new(&[], None));
    let expected = radiance(&march::march(&shaded, &camera, &medium, &*sky, &settings));
    let off = |source: &str| {
        let pass = MarchPass::from_source(&gpu, source).unwrap();
        let on_device = DeviceSky::new(&gpu, &sky).unwrap();
        difference(&expected, &radiance(&pass.film(&gpu, &volume, &camera, &medium, &on_device, &settings).unwrap()))
    };
    assert!(off(gpu_march::SHADER) <= 1e-5);
    let mut cases = 1;
    for (page, other) in
        [("nodes_0", "nodes_1"), ("nodes_1", "nodes_2"), ("nodes_2", "nodes_3"), ("nodes_3", "nodes_0")]
    {
        let (from, to) = (format!("return {page}[at]"), format!("return {other}[at]"));
        assert!(gpu_march::SHADER.contains(&from) && gpu_march::SHADER.contains(&to));
        // One for the other and back: a buffer that is not read has no binding.
        let mixed =
            gpu_march::SHADER.replace(&from, "return both[at]").replace(&to, &from).replace("return both[at]", &to);
        let worst = off(&mixed);
        eprintln!("{from} -> {to}: {worst:.1e}");
        assert!(worst > 1e-3, "{from}: {worst}");
        cases += 1;
    }
    told(cases);
}

const SHADERS: [&str; 15] = [
    gpu_march::SHADER,
    volume_pass::SHADER,
    centres::SHADER,
    centre_solve::DEPTH,
    centre_solve::SINGLE,
    centre_solve::PRODUCT,
    transfer::PRODUCT,
    transfer::VIEW_DIRECTIONS,
    transfer::CELLS,
    transfer::SOURCE,
    decode::GAUSSIAN_SUM,
    decode::DECODER,
    single::SHADER,
    scatter::SHADER,
    gmres::SHADER,
];

/// Textures and samplers among the types of a shader.
fn textures(text: &str) -> usize {
    let text = format!("{PRELUDE}{text}");
    let module = naga::front::wgsl::parse_str(&text).unwrap_or_else(|e| panic!("{}", e.emit_to_string(&text)));
    let is_texture = |inner: &TypeInner| matches!(inner, TypeInner::Image { .. } | TypeInner::Sampler { .. });
    module.types.iter().filter(|(_, kind)| is_texture(&kind.inner)).count()
}

/// All texts of shaders under a folder.
fn texts(folder: &Path, out: &mut Vec<(String, String)>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            texts(&path, out);
        } else if path.extension().is_some_and(|e| e == "wgsl") {
            out.push((path.display().to_string(), std::fs::read_to_string(&path).unwrap()));
        }
    }
}

#[test]
fn no_shader_declares_a_texture_so_that_no_limit_on_their_sides_matters() {
    let mut files = Vec::new();
    texts(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut files);
    assert!(files.len() >= SHADERS.len());
    // Every file is part of a shader that is looked at.
    for (path, text) in &files {
        assert!(PRELUDE == text || SHADERS.iter().any(|shader| shader.contains(text)), "{path} is in no shader");
    }
    for shader in SHADERS {
        assert_eq!(textures(shader), 0, "{}", &shader[..shader.len().min(80)]);
    }
    // One that does is found.
    let planted = "@group(0) @binding(9) var volume: texture_3d<f32>;\n@group(0) @binding(10) var s: sampler;\n";
    assert_eq!(textures(&format!("{planted}{}", gpu_march::SHADER)), 2);
}
