//! Transfer on the device against the processor: lit clusters, cells, nodes and images. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DVec3, Vec3};
use gpu_common::{cameras, device, difference, plume, radiance, shaded, sky, tiny, told};
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::gpu::device::{ForcedLimits, Gpu, GpuError};
use smoke_runtime::gpu::renderer::{GpuRenderError, GpuRenderer, SolveOn};
use smoke_runtime::gpu::transfer::{CELLS, DeviceTransfer, PRODUCT, SOURCE, TransferPass, VIEW_DIRECTIONS};
use smoke_runtime::gpu::transfer_rows::DeviceRows;
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::light::Light;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::sphere::harmonics::evaluate;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::tracking::phase;
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::transfer::cells::Cells;
use smoke_runtime::transport::transfer::frame::{Clustered, FrameTransfer};
use smoke_runtime::transport::transfer::lit_nodes::lit_nodes;
use smoke_runtime::transport::transfer::source::{TransferSettings, TransferTransport};
use std::sync::Arc;

/// Relative RMSE of images: what the device is promised to keep.
const IMAGE: f64 = 2e-3;
/// Largest difference of a lit cluster, over the largest: a sum of up to 162 products of one sign, each rounded in f32;
/// 162 x 2^-24 = 1e-5, and a phase function of five roundings whose power of 3/2 doubles that of its base.
const LIT: f64 = 2e-5;
/// Largest difference of a node, over the largest. Ways are good to 2e-7 of the way to the eye for nodes close to it,
/// which moves a place among 240 squares around by 2e-5 of a square, and as much of the difference between its corners.
const NODE: f64 = 5e-5;

/// [`NODE`], and of a narrow peak: a cosine rounded to 2 x 2^-24 is as much of the peak's base, `(1 - |g|)^2`, whose power
/// of 3/2 it is.
fn node(g: f32) -> f64 {
    NODE + 3.6e-7 / f64::from(1.0 - g.abs()).powi(2)
}

/// A transfer that is made up: positive where it would be, different for each set, cluster and direction.
fn transfer(field: &DensityField, medium: MediumParameters, terms: usize) -> FrameTransfer {
    let is_coloured = medium.sigma_t[0] != medium.sigma_t[1];
    let (kind, bands, shift) = (BasisKind::Hat(162), if medium.g == 0.0 { 1 } else { 4 }, 1);
    let mut state = 1u32;
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let mut made_up = |rows: usize, length: usize, size: f32| {
        let clusters = 7;
        let each = 1 + terms;
        let base = |at: usize, r: f32| {
            if (at / length).is_multiple_of(each) { size * (0.3 + 0.7 * r) } else { size * (r - 0.5) }
        };
        Clustered {
            length,
            terms,
            bases: (0..clusters * each * length).map(|at| base(at, random())).collect(),
            ids: (0..rows).map(|row| (row / 3 % clusters) as u8).collect(),
            weights: (0..rows * terms).map(|at| 0.2 * ((at * 7919 % 101) as f32 / 100.0 - 0.5)).collect(),
        }
    };
    let (nodes, cells) = (lit_nodes(field).len(), Cells::new(field, shift).len());
    let indirect = kind.coarser().len() * bands * bands;
    let sets = if is_coloured { 3 } else { 1 };
    FrameTransfer {
        medium,
        basis: Arc::new(LightBasis::new(kind)),
        indirect_basis: Arc::new(LightBasis::new(kind.coarser())),
        bands,
        shift,
        direct_of_channel: if is_coloured { [0, 1, 0] } else { [0; 3] },
        indirect_of_channel: if is_coloured { [0, 1, 2] } else { [0; 3] },
        direct: (0..sets.min(2)).map(|_| made_up(nodes, kind.len(), 1.0)).collect(),
        indirect: (0..sets).map(|_| made_up(cells, indirect, 0.01)).collect(),
    }
}

fn grey(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [7.0; 3], albedo: [0.9; 3], g }
}

fn coloured(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [6.0, 8.0, 6.0], albedo: [0.95, 0.9, 0.7], g }
}

/// Largest difference over the largest expected; infinite where one is not a number.
fn worst<T: Copy + Into<f64>>(expected: &[T], found: &[f32]) -> f64 {
    assert_eq!(expected.len(), found.len());
    let largest = expected.iter().fold(0.0f64, |m, &e| m.max(e.into().abs()));
    assert!(largest > 0.0, "nothing to compare");
    let off = |(&e, &f): (&T, &f32)| (e.into() - f64::from(f)).abs() / largest;
    expected.iter().zip(found).map(off).fold(0.0, |m, d| m.max(if d.is_nan() { f64::INFINITY } else { d }))
}

/// The transport of `field` and a pass from `texts`, ready to be compared.
struct Case<'a> {
    gpu: &'a Gpu,
    pass: TransferPass,
    field: DensityField,
    transfer: Arc<FrameTransfer>,
    lights: Vec<Light>,
}

impl<'a> Case<'a> {
    fn new(gpu: &'a Gpu, texts: [&str; 4], field: DensityField, medium: MediumParameters, terms: usize) -> Self {
        let transfer = Arc::new(transfer(&field, medium, terms));
        Self { gpu, pass: TransferPass::from_sources(gpu, texts).unwrap(), field, transfer, lights: sky() }
    }

    fn transport(&self) -> TransferTransport {
        TransferTransport::new(&self.field, self.transfer.clone(), TransferSettings::default()).unwrap()
    }

    /// Moments of the cluster vectors of a set, `[cluster][1 + terms][lm]`, RGB, by their definition in f64.
    fn moments(&self, set: usize) -> Vec<[f64; 3]> {
        let (transfer, n) = (&self.transfer, self.transfer.bands * self.transfer.bands);
        let light = transfer.indirect_basis.response_coefficients(&self.lights);
        let rows = transfer.indirect[set].bases.chunks_exact(light.len() * n);
        let sum = |row: &[f32], lm: usize| {
            [0, 1, 2].map(|c| {
                let is_used = transfer.indirect_of_channel[c] == set;
                let terms = light.iter().enumerate().map(|(k, s)| s[c] * f64::from(row[k * n + lm]));
                if is_used { terms.sum() } else { 0.0 }
            })
        };
        rows.flat_map(|row| (0..n).map(move |lm| sum(row, lm)).collect::<Vec<_>>()).collect()
    }

    /// Radiance of the direct cluster vectors of a set where it is the same from everywhere, in f64.
    fn even(&self, set: usize) -> Vec<[f64; 3]> {
        let transfer = &self.transfer;
        // The sun is swept.
        let light = transfer.basis.coefficients(&self.lights[..1]);
        let scattered = f64::from(phase::value(0.0, 0.0));
        let rows = transfer.direct[set].bases.chunks_exact(light.len());
        let sum = |row: &[f32]| {
            [0, 1, 2].map(|c| {
                let is_used = transfer.direct_of_channel[c] == set;
                let terms =
                    light.iter().zip(transfer.basis.areas()).zip(row).map(|((s, a), r)| s[c] * a * f64::from(*r));
                if is_used { terms.sum::<f64>() * scattered * f64::from(transfer.medium.albedo[c]) } else { 0.0 }
            })
        };
        rows.map(sum).collect()
    }

    /// Differences of lit clusters, of cells, and of nodes from `eye`; the first is 0 for direct light that depends on it.
    fn differences(&self, eye: DVec3) -> [f64; 3] {
        let Self { gpu, pass, field, transfer, lights } = self;
        let source = self.transport().light(field, lights, ScatteringOrder::All);
        let expected = DeviceVolume::of_shaded(gpu, &shaded(&source, field, eye)).unwrap().read(gpu).unwrap();
        let frame = DeviceTransfer::new(gpu, Arc::new(DeviceRows::new(gpu, field, transfer).unwrap())).unwrap();
        let light = pass.light(gpu, &frame, &source).unwrap();
        let volume = DeviceVolume::of_field(gpu, field).unwrap();
        let density = gpu.upload("density", &field.values).unwrap();
        // Twice: nothing of an earlier pass may be left.
        for eye in [eye + DVec3::splat(0.3), eye] {
            pass.shade(gpu, &frame, &light, (field, &density), &volume, eye).unwrap();
        }
        let found = volume.read(gpu).unwrap();

        let direct = if transfer.medium.g == 0.0 { transfer.direct.len() } else { 0 };
        let truths =
            (0..direct).map(|set| self.even(set)).chain((0..transfer.indirect.len()).map(|set| self.moments(set)));
        let lit = light.read(gpu, &frame).unwrap();
        assert_eq!(lit.len(), direct + transfer.indirect.len());
        let pairs = lit.iter().zip(truths);
        let lit = pairs.map(|(lit, truth)| worst(truth.as_flattened(), &three(lit))).fold(0.0, f64::max);

        let cells = Cells::new(field, transfer.shift);
        let sent = frame.read_cells(gpu, cells.len()).unwrap();
        [
            lit,
            worst(self.cells(&cells, eye).as_flattened(), &three(&sent)),
            worst(expected.as_flattened(), found.as_flattened()),
        ]
    }

    /// What each cell sends towards `eye`, by its definition in f64.
    fn cells(&self, cells: &Cells, eye: DVec3) -> Vec<[f64; 3]> {
        let (transfer, n) = (&self.transfer, self.transfer.bands * self.transfer.bands);
        let [bx, by, _] = cells.majorants.bricks;
        let mut out = vec![[0.0; 3]; cells.len()];
        for (s, set) in transfer.indirect.iter().enumerate() {
            let moments = self.moments(s);
            for (cell, out) in out.iter_mut().enumerate() {
                let brick = cells.bricks[cell] as usize;
                let at = [brick % bx, brick / bx % by, brick / bx / by]
                    .map(|b| (b as f64 + 0.5) * f64::from(1 << cells.shift));
                let way = (self.field.world_from_node.transform_point3(DVec3::from_array(at)) - eye).normalize();
                let y = evaluate(transfer.bands, way.as_vec3());
                let first = usize::from(set.ids[cell]) * (1 + set.terms) * n;
                for t in 0..=set.terms {
                    let weight = if t == 0 { 1.0 } else { f64::from(set.weights[cell * set.terms + t - 1]) };
                    for lm in 0..n {
                        (0..3).for_each(|c| out[c] += weight * moments[first + t * n + lm][c] * f64::from(y[lm]));
                    }
                }
            }
        }
        out
    }
}

fn three(values: &[[f32; 4]]) -> Vec<f32> {
    values.iter().flat_map(|v| [v[0], v[1], v[2]]).collect()
}

const TEXTS: [&str; 4] = [PRODUCT, VIEW_DIRECTIONS, CELLS, SOURCE];

#[test]
fn clusters_cells_and_nodes_are_the_same_on_both_sides_for_any_eye_and_in_parts() {
    // Views in parts; and rows and bricks.
    let [few_views, few_rows] = [60 << 10, 800 << 10].map(|bytes| ForcedLimits { storage_binding: Some(bytes) });
    let whole = ForcedLimits::default();
    assert!(lit_nodes(&plume(2)).len() * 4 * 5 > 800 << 10);
    let mut cases = 0;
    for (forced, fields) in [(whole, vec![plume(2), tiny()]), (few_views, vec![tiny()]), (few_rows, vec![plume(2)])] {
        let Some(gpu) = device(forced) else { return };
        for field in fields {
            for (medium, terms) in [
                (grey(0.0), 4),
                (grey(0.5), 4),
                (coloured(0.5), 2),
                (coloured(0.0), 0),
                (grey(-0.7), 1),
                (grey(0.95), 1),
            ] {
                // There is no room for sixteen coefficients of four terms, nor for the squares of a narrow peak.
                if forced == few_views && (medium.g > 0.9 || medium.g != 0.0 && terms == 4) {
                    continue;
                }
                let case = Case::new(&gpu, TEXTS, field.clone(), medium, terms);
                for camera in cameras(&case.field) {
                    let [lit, cells, nodes] = case.differences(camera.position);
                    eprintln!(
                        "{:?}, {medium:?}: clusters {lit:.1e}, cells {cells:.1e}, nodes {nodes:.1e}",
                        case.field.dims
                    );
                    assert!(lit <= LIT && cells <= LIT && nodes <= node(medium.g), "{lit} {cells} {nodes}");
                    cases += 1;
                }
            }
        }
    }
    told(cases);
}

#[test]
fn an_eye_on_the_diagonals_of_the_box_and_on_a_node_sees_every_node() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let values: Vec<f32> = (0..512).map(|v| 0.1 + (v % 5) as f32).collect();
    let field = DensityField::from_box([0; 3], [8; 3], &values, glam::DAffine3::IDENTITY);
    let case = Case::new(&gpu, TEXTS, field, grey(0.5), 4);
    // Nodes at the edges of the cube of directions: every rounding of them must find a direction.
    for eye in [[-5.0; 3], [4.0, 4.0, -3.0], [3.0; 3], [0.1, 0.1, 0.1], [1e3, 1e3, 0.0]] {
        let [_, _, nodes] = case.differences(DVec3::from_array(eye));
        eprintln!("{eye:?}: {nodes:.1e}");
        assert!(nodes <= node(0.5), "{eye:?}: {nodes}");
    }
    told(5);
}

#[test]
fn a_difference_planted_in_a_shader_of_transfer_is_found_by_the_comparison_of_its_stage() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let eye = cameras(&tiny())[0].position;
    let mut cases = 0;
    for (file, stage, g, from, to) in [
        (0, 0, 0.0, "at += product.inner", "at += product.inner + select(0u, 1u, k == 7u)"),
        (0, 0, 0.5, "% product.inner;", "% product.inner * 0u;"),
        (0, 0, 0.5, "* product.channels", "* product.channels * 1.0001"),
        (1, 2, 0.5, "2.0 * g * (1.0 - mu)", "2.0 * g * (1.001 - mu)"),
        (1, 2, 0.5, "whole += mesh[q].w *", "whole += 1.001 * mesh[q].w *"),
        (1, 2, 0.5, "seen.first_view + thread %", "seen.first_view + 1u + thread %"),
        (2, 1, 0.5, "+ t * n + lm", "+ n + lm"),
        (2, 1, 0.5, "vec3<f32>(cell) + 0.5", "vec3<f32>(cell) + 0.51"),
        (2, 2, 0.0, "f32(pass_.side) - 0.5;", "f32(pass_.side) - 0.49;"),
        (2, 2, 0.0, "sum.xyz / max(sum.w, 1e-30)", "sum.xyz"),
        (3, 2, 0.5, "vec4((1.0 - f.x) * (1.0 - f.y)", "vec4((1.0 - f.x) * (1.0 - 0.9 * f.y)"),
        (3, 2, 0.0, "lit[at + t].xyz", "lit[at + 1u].xyz"),
        (3, 2, 0.5, "lit_rows[in_field(at)]", "min(lit_rows[in_field(at)], 1u)"),
        (3, 2, 0.5, "dot(unit, pass_.toward.xyz)", "dot(-unit, pass_.toward.xyz)"),
        (3, 2, 0.5, "max(nodes[thread].xyz, vec3(0.0))", "nodes[thread].xyz * 1.0005"),
    ] {
        let mut texts = TEXTS.map(String::from);
        assert!(texts[file].contains(from), "{from}");
        texts[file] = texts[file].replace(from, to);
        let case = Case::new(&gpu, texts.each_ref().map(String::as_str), tiny(), coloured(g), 2);
        let off = case.differences(eye)[stage];
        eprintln!("{from} -> {to}: {off:.1e}");
        assert!(off > [LIT, LIT, node(g)][stage], "{from}: {off}");
        cases += 1;
    }
    told(cases);
}

fn frame(field: DensityField, medium: MediumParameters) -> Frame {
    let transfer = Some(Arc::new(transfer(&field, medium, 4)));
    let unit = UnitSpace::of_box([0; 3], [8; 3]);
    let world_from_index = field.world_from_node;
    Frame { field, gaussians: vec![], unit, first_node: [0; 3], world_from_index, transfer }
}

#[test]
fn images_by_transfer_agree_after_every_kind_of_edit() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let settings = RenderSettings { route: Route::Transfer(TransferSettings::default()), ..RenderSettings::default() };
    let mut cases = 0;
    for medium in [grey(0.0), coloured(0.5)] {
        let mut cpu = Renderer::new(settings, medium, sky()).unwrap();
        let mut device = GpuRenderer::new(Arc::clone(&gpu), settings, medium, sky(), SolveOn::Device).unwrap();
        let mut same =
            |cpu: &mut Renderer, device: &mut GpuRenderer, field: &DensityField, camera: usize, what: &str| {
                let camera = &cameras(field)[camera];
                let (expected, a) = cpu.render(camera).unwrap();
                let (found, b) = device.render(camera).unwrap();
                let off = difference(&radiance(&expected), &radiance(&found));
                eprintln!("{what}: {off:.1e}; {a:?}, {b:?}");
                assert!(off <= IMAGE, "{what}: {off}");
                cases += 1;
            };
        for field in [plume(6), tiny()] {
            cpu.set_frame(frame(field.clone(), medium)).unwrap();
            device.set_frame(UploadedFrame::new(&gpu, frame(field.clone(), medium)).unwrap()).unwrap();
            same(&mut cpu, &mut device, &field, 0, "first");
            same(&mut cpu, &mut device, &field, 2, "another eye");
            let sun = Light::Directional { toward: Vec3::new(0.0, 0.6, 0.8), irradiance: [3.0, 2.5, 2.0] };
            for (lights, what) in [(vec![sun], "a sun alone"), (sky()[..1].to_vec(), "a sky alone"), (sky(), "both")] {
                cpu.set_lights(lights.clone()).unwrap();
                device.set_lights(lights).unwrap();
                same(&mut cpu, &mut device, &field, 2, what);
            }
        }
    }
    told(cases);
}

#[test]
fn renderers_that_share_an_uploaded_transfer_draw_what_each_draws_alone() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let settings = RenderSettings { route: Route::Transfer(TransferSettings::default()), ..RenderSettings::default() };
    let (field, medium) = (plume(6), coloured(0.5));
    let bare = Frame { transfer: None, ..frame(field.clone(), medium) };
    let bare = UploadedFrame::new(&gpu, bare).unwrap();
    let uploaded = Arc::new(UploadedFrame::new(&gpu, frame(field.clone(), medium)).unwrap());
    assert!(uploaded.bytes() > bare.bytes() + 4 * field.values.len() as u64, "rows of the nodes are uploaded too");
    let draw = |light: usize| {
        let lights = vec![sky().remove(light)];
        let mut renderer = GpuRenderer::new(Arc::clone(&gpu), settings, medium, lights, SolveOn::Device).unwrap();
        renderer.set_frame(Arc::clone(&uploaded)).unwrap();
        (0..3).map(|eye| radiance(&renderer.render(&cameras(&field)[eye]).unwrap().0)).collect::<Vec<_>>()
    };
    let alone = [0, 1].map(draw);
    assert!(alone[0][0] != alone[1][0]);
    let draw = &draw;
    let together = std::thread::scope(|scope| {
        [0, 1].map(|light| scope.spawn(move || draw(light))).map(|drawn| drawn.join().unwrap())
    });
    assert!(together == alone);
    // One of another density is refused before it is copied.
    let other = Frame { field: tiny(), ..frame(field.clone(), medium) };
    let error = UploadedFrame::new(&gpu, other).map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("transfer: direct light has"), "{error}");
    told(3);
}

#[test]
fn a_transfer_that_a_device_cannot_hold_is_refused_by_name() {
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(64 << 10) }) else { return };
    let settings = RenderSettings { route: Route::Transfer(TransferSettings::default()), ..RenderSettings::default() };
    let mut renderer = GpuRenderer::new(Arc::clone(&gpu), settings, grey(0.5), sky(), SolveOn::Device).unwrap();
    let field = plume(1);
    let mut show = || -> Result<(), GpuRenderError> {
        renderer.set_frame(UploadedFrame::new(&gpu, frame(field.clone(), grey(0.5)))?)?;
        renderer.render(&cameras(&field)[0]).map(|_| ())
    };
    let error = show().unwrap_err();
    assert!(matches!(error, GpuRenderError::Gpu(GpuError::Limit { limit: 65536, .. })), "{error}");
    assert!(error.to_string().ends_with("use --device cpu"), "{error}");
    told(1);
}
