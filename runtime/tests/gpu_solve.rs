//! The grid route on the device against the processor: sweeps, gather, iteration, planes and images. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DAffine3, DVec3, Vec3};
use gpu_common::{cameras, device, difference, plume, radiance, sky, tiny, told};
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::gpu::device::{ForcedLimits, Gpu, GpuError};
use smoke_runtime::gpu::gmres::{self, GmresPass};
use smoke_runtime::gpu::grid_solve::{DeviceGrids, GridPass, GridProblem};
use smoke_runtime::gpu::planes::Planes;
use smoke_runtime::gpu::renderer::{GpuRenderer, SolveOn};
use smoke_runtime::gpu::scatter::{self, ScatterPass};
use smoke_runtime::gpu::single::{self, SinglePass};
use smoke_runtime::gpu::sweep_grid::DeviceSweepGrid;
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::light::{Beam, Environment, Light, beams};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Renderer, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::grid::channels::is_single_channel;
use smoke_runtime::transport::compensated::grid::columns::SweepGrid;
use smoke_runtime::transport::compensated::grid::route::{GridSettings, GridTransport, ordinates, weighted};
use smoke_runtime::transport::compensated::grid::scatter::gather;
use smoke_runtime::transport::compensated::grid::single::{WeightedBeam, single_scattering};
use smoke_runtime::transport::medium::{BandedMedium, MediumParameters};

/// Largest difference of a sweep over the largest value. A depth x is a sum over up to a hundred slices, each rounded by 6e-8
/// of it: of a transmittance that is x e^-x times 6e-6, at most 2e-6.
const SWEEP: f64 = 5e-6;
/// The same of a gather: a quotient of two such sums, and a sum over ordinates.
const GATHER: f64 = 1e-5;
/// The same of a solution. Both sides do the same iteration from the same start: they differ by rounding, a few 6e-8 that the
/// solution takes over 1 / (1 - albedo) = 20 times.
const SOLUTION: f64 = 1e-5;
/// Relative residual at which it ends, and the most products.
const END: (f64, usize) = (1e-5, 40);
/// Relative RMSE of images: what the device is promised to keep.
const IMAGE: f64 = 2e-3;

fn coloured(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [6.0, 8.0, 9.0], albedo: [0.95, 0.9, 0.8], g }
}

fn grey(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [8.0; 3], albedo: [0.9; 3], g }
}

/// A sky that is brighter on one side, and a sun, both without colour.
fn white_sky() -> Vec<Light> {
    let mut environment = Environment::constant([1.0; 3]);
    environment.radiance.iter_mut().take(64 * 16).for_each(|r| *r = [3.0; 3]);
    let sun = Light::Directional { toward: Vec3::new(0.48, -0.64, 0.6), irradiance: [3.0; 3] };
    vec![Light::Environment(environment), sun]
}

/// A frame of the plume on nodes as far apart as multiple scattering has them.
fn field() -> DensityField {
    plume(3).coarsened(2)
}

/// Largest difference over the largest value, of planes of all nodes, at those near density; infinite if any is not a
/// number.
fn worst(grid: &DeviceSweepGrid, expected: &[Vec<f32>], found: &[Vec<f32>]) -> f64 {
    assert_eq!(expected.len(), found.len());
    let (mut off, mut size) = (0.0f64, 0.0f64);
    for (expected, found) in expected.iter().zip(found) {
        for &node in &grid.near {
            let (a, b) = (f64::from(expected[node as usize]), f64::from(found[node as usize]));
            off = if (a - b).abs() <= off { off } else { (a - b).abs() };
            off = if (a - b).is_finite() { off } else { f64::INFINITY };
            size = size.max(a.abs());
        }
    }
    assert!(size > 0.0, "nothing to compare");
    off / size
}

/// Planes of all nodes from those of the nodes near density.
fn spread(grid: &DeviceSweepGrid, planes: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let mut out = vec![vec![0.0; grid.nodes()]; planes.len()];
    for (out, plane) in out.iter_mut().zip(planes) {
        grid.near.iter().zip(plane).for_each(|(&node, v)| out[node as usize] = *v);
    }
    out
}

/// And the other way.
fn compacted(grid: &DeviceSweepGrid, planes: &[Vec<f32>]) -> Vec<Vec<f32>> {
    planes.iter().map(|plane| grid.near.iter().map(|&node| plane[node as usize]).collect()).collect()
}

fn single_differs(gpu: &Gpu, pass: &SinglePass, field: &DensityField, beams: &[WeightedBeam], sigma_t: &[f32]) -> f64 {
    let (cpu, grid) = (SweepGrid::new(field), DeviceSweepGrid::new(gpu, field).unwrap());
    let expected = single_scattering(&cpu, beams, sigma_t);
    let found = pass.source_radiance(gpu, &grid, beams, sigma_t, false).unwrap().read(gpu).unwrap();
    let compact = pass.source_radiance(gpu, &grid, beams, sigma_t, true).unwrap().read(gpu).unwrap();
    assert!(compacted(&grid, &found) == compact && spread(&grid, &compact) == found);
    worst(&grid, &expected, &found)
}

#[test]
fn beams_from_everywhere_light_the_nodes_as_they_do_on_the_processor() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = SinglePass::new(&gpu).unwrap();
    let mut cases = 0;
    for field in [field(), tiny()] {
        let grid = SweepGrid::new(&field);
        for (lights, medium, g) in [
            (sky(), coloured as fn(f32) -> MediumParameters, 0.0),
            (sky(), coloured, 0.85),
            (sky(), grey, 0.5),
            (white_sky(), grey, 0.85),
            (vec![sky().remove(1)], grey, 0.0),
        ] {
            let beams = beams(&lights, 24);
            let mut senses = [false; 6];
            beams.iter().for_each(|b| senses[grid.path(b.toward).group()] = true);
            assert!(lights.len() == 1 || senses == [true; 6]);
            let banded = medium(g).banded(4);
            let bands = if g == 0.0 { 1 } else { 4 };
            let channels = if is_single_channel(&medium(g), &lights) { 1 } else { 3 };
            let weighted = weighted(&beams, &banded, (bands, channels));
            let worst = single_differs(&gpu, &pass, &field, &weighted, &banded.sigma_t[..channels]);
            eprintln!("single scattering {:?}, g {g}, {} beams, {channels}: {worst:.1e}", field.dims, beams.len());
            assert!(worst <= SWEEP, "{worst}");
            cases += 1;
        }
    }
    told(cases);
}

fn gather_differs(gpu: &Gpu, pass: &ScatterPass, field: &DensityField, medium: &BandedMedium, bands: usize) -> f64 {
    let (cpu, grid) = (SweepGrid::new(field), DeviceSweepGrid::new(gpu, field).unwrap());
    let channels = if medium.sigma_t[0] == medium.sigma_t[1] { 1 } else { 3 };
    let sigma_t = &medium.sigma_t[..channels];
    let (ordinates, beams) = (ordinates(3, bands), beams(&sky(), 4));
    let source = single_scattering(&cpu, &weighted(&beams, medium, (bands, channels)), sigma_t);
    let expected = gather(&cpu, &ordinates, sigma_t, &source);
    let source = compacted(&grid, &source);
    let source = Planes::upload(gpu, "source", &source, grid.near.len()).unwrap();
    let gathered = Planes::new(gpu, "gathered", expected.len(), grid.near.len()).unwrap();
    pass.gather(gpu, &grid, &ordinates, sigma_t, |_| 1.0).unwrap().add_now(gpu, &source, &gathered).unwrap();
    worst(&grid, &expected, &spread(&grid, &gathered.read(gpu).unwrap()))
}

#[test]
fn what_is_gathered_along_ordinates_is_the_same_on_both_sides() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = ScatterPass::new(&gpu).unwrap();
    let mut cases = 0;
    for field in [field(), tiny()] {
        for (medium, bands) in [(coloured(0.85), 3), (grey(0.5), 5), (grey(0.0), 1)] {
            let worst = gather_differs(&gpu, &pass, &field, &medium.banded(6), bands);
            eprintln!("gather {:?}, {bands} bands, {:?}: {worst:.1e}", field.dims, medium.sigma_t);
            assert!(worst <= GATHER, "{worst}");
            cases += 1;
        }
    }
    told(cases);
}

#[test]
fn a_constant_source_of_one_gathers_one_minus_transmittance_on_the_device_too() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let (single, scatter) = (SinglePass::new(&gpu).unwrap(), ScatterPass::new(&gpu).unwrap());
    let values: Vec<f32> = (0..9 * 11 * 10).map(|v| ((v * 7919) % 13) as f32 / 13.0).collect();
    let field = DensityField::from_box([0; 3], [9, 11, 10], &values, DAffine3::IDENTITY);
    let grid = DeviceSweepGrid::new(&gpu, &field).unwrap();
    let ordinates = ordinates(4, 1);
    let y0 = ordinates[0].harmonics[0];
    for sigma in [1e-6, 0.1, 1.0, 50.0, 1e6, 1e30] {
        let ones = Planes::upload(&gpu, "ones", &[vec![1.0 / y0; grid.near.len()]], grid.near.len()).unwrap();
        let beam = |o: &smoke_runtime::transport::compensated::grid::scatter::Ordinate| WeightedBeam {
            beam: Beam { toward: o.toward, irradiance: [1.0; 3] },
            weights: vec![o.weight * y0],
        };
        let beams: Vec<WeightedBeam> = ordinates.iter().map(beam).collect();
        let all = single.source_radiance(&gpu, &grid, &beams, &[sigma], true).unwrap();
        scatter.gather(&gpu, &grid, &ordinates, &[sigma], |_| 1.0).unwrap().add_now(&gpu, &ones, &all).unwrap();
        for all in &all.read(&gpu).unwrap()[0] {
            // As on the processor (scatter.rs): 32 directions of a dozen slices, a few roundings each.
            assert!((all * y0 - 1.0).abs() < 3e-5, "sigma_t {sigma}: {}", all * y0);
        }
    }
    told(6);
}

/// Largest difference of each layer, and products of both sides; infinite where these differ by more than one, because both
/// do the same iteration.
fn solutions_differ(
    gpu: &Gpu,
    pass: &GridPass,
    field: &DensityField,
    medium: &MediumParameters,
    lights: &[Light],
    (tolerance, iterations): (f64, usize),
) -> (Vec<f64>, [usize; 2]) {
    let settings = GridSettings { beams: 8, rings: 3, single_step: 2, tolerance, iterations, ..Default::default() };
    let (beams, banded) = (beams(lights, settings.beams), medium.banded(4));
    let expected = GridTransport::new(settings).solve(field, &beams, &banded, ScatteringOrder::All);
    let scattering = ScatteringOrder::All;
    let problem = GridProblem { field, beams: &beams, medium: banded, scattering, settings };
    let found = pass.solve(gpu, &mut DeviceGrids::default(), &problem).unwrap();
    let layers = found.read(gpu).unwrap();
    assert_eq!(layers.len(), expected.layers().count());
    let layers = expected.layers().zip(layers).map(|((step, dims, expected), found)| {
        let grid = DeviceSweepGrid::new(gpu, &field.coarsened(step)).unwrap();
        assert_eq!(grid.dims, dims);
        worst(&grid, expected, &found)
    });
    let products = [expected.iterations, found.iterations];
    let alike = if products[0].abs_diff(products[1]) <= 1 { 0.0 } else { f64::INFINITY };
    (layers.map(|worst| worst + alike).collect(), products)
}

#[test]
fn both_sides_find_the_same_source_radiance_whatever_the_phase_and_colour() {
    let mut cases = 0;
    // The second has room for two or three planes in a buffer, and for a few directions.
    for forced in [ForcedLimits::default(), ForcedLimits { storage_binding: Some(1 << 20) }] {
        let Some(gpu) = device(forced) else { return };
        let pass = GridPass::new(&gpu).unwrap();
        for (field, lights, medium) in [
            (plume(3), sky(), coloured(0.5)),
            (plume(3), white_sky(), grey(0.85)),
            (tiny(), sky(), grey(0.0)),
            (tiny(), white_sky(), coloured(-0.4)),
        ] {
            let (worst, products) = solutions_differ(&gpu, &pass, &field, &medium, &lights, END);
            eprintln!("solution {:?}, {medium:?}: {worst:?}, products {products:?}", field.dims);
            assert!(worst[0] <= SWEEP && worst[1] <= SOLUTION, "{worst:?}");
            cases += 1;
        }
    }
    told(cases);
}

#[test]
fn the_iteration_ends_as_it_does_on_the_processor_at_a_limit_after_a_restart_and_at_the_extremes() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = GridPass::new(&gpu).unwrap();
    let mut cases = 0;
    let of = |sigma: f32, albedo: f32, g: f32| MediumParameters { sigma_t: [sigma; 3], albedo: [albedo; 3], g };
    for (medium, end) in [
        (coloured(0.5), (1e-5, 2)),
        (coloured(0.5), (1e-5, 1)),
        // Out of f32's reach: cycles of 30 until one brings nothing.
        (coloured(0.5), (1e-12, 40)),
        (of(1.0, 1.0, 0.0), END),
        (of(1e3, 0.99, 0.85), END),
        (of(1e6, 0.5, -0.85), END),
        (of(1e30, 0.5, 0.0), END),
    ] {
        let (worst, products) = solutions_differ(&gpu, &pass, &tiny(), &medium, &sky(), end);
        eprintln!("{medium:?} to {end:?}: {worst:?}, products {products:?}");
        assert!(worst[0] <= SWEEP && worst[1] <= SOLUTION, "{worst:?}");
        cases += 1;
    }
    told(cases);
}

#[test]
fn a_difference_planted_in_a_shader_of_the_solution_is_found_by_its_comparison() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let (field, large, mut cases) = (tiny(), plume(2), 0);
    let banded = coloured(0.5).banded(4);
    let beams = weighted(&beams(&sky(), 8), &banded, (3, 3));
    let mut found = |what: &str, worst: f64, limit: f64| {
        eprintln!("{what}: {worst:.1e}");
        assert!(worst > limit, "{what}: {worst}");
        cases += 1;
    };
    let planted = |text: &str, from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        text.replace(from, to)
    };
    for (from, to) in [
        ("0.5 * path.length", "0.501 * path.length"),
        ("vec4(g * f, g * (1.0 - f)", "vec4(g * f, f * (1.0 - f)"),
        ("path.slices - 1u - step", "step"),
        ("return at.yzx", "return at.zyx"),
        ("min(x, 87.0)", "min(x, 0.5)"),
        ("1.0 / 24.0", "1.0 / 23.0"),
        ("* single.channels + single.channel;", "* single.channels;"),
        ("weights[first + quad]", "weights[first]"),
        ("depth += half * (before + met)", "depth += half * (met + met)"),
    ] {
        let pass = SinglePass::from_source(&gpu, &planted(single::SHADER, from, to)).unwrap();
        found(from, single_differs(&gpu, &pass, &field, &beams, &banded.sigma_t), SWEEP);
    }
    for (from, to) in [
        ("kept.y * near_share(x, kept.y)", "kept.y * 0.5"),
        ("1.0 / 720.0);", "1.0 / 360.0);"),
        ("opacity * kept.x + (near_end + far_end)", "opacity * kept.x + near_end"),
        ("behind * far_end + source * near_end", "source * far_end + source * near_end"),
        ("max(opacity, 1e-30)", "max(opacity, 1e-2)"),
        ("planes[plane * scatter.near + rank]; }\n    }\n    along", "planes[rank]; }\n    }\n    along"),
        ("(1.0 - g) * f, g * (1.0 - f), g * f);", "(1.0 - g) * f, g * f, g * (1.0 - f));"),
        ("factors[first + quad] * reached", "factors[first + quad] * 1.0001 * reached"),
    ] {
        let pass = ScatterPass::from_source(&gpu, &planted(scatter::SHADER, from, to)).unwrap();
        found(from, gather_differs(&gpu, &pass, &field, &banded, 3), GATHER);
    }
    for (from, to) in [
        ("own + factor *", "own + 0.999 * factor *"),
        ("mine += a[entry] * b[entry]", "mine = a[entry] * b[entry]"),
        ("lanes[local] += lanes[local + half]", "lanes[local] += lanes[local]"),
        ("mine += blocks[block]", "mine = blocks[block]"),
        ("inverseSqrt(sums[gmres.slot])", "inverseSqrt(2.0 * sums[gmres.slot])"),
    ] {
        // A group's threads have more than one block to add only where there are more than 64 of them.
        let field = if from.contains("block]") { &large } else { &field };
        let mut pass = GridPass::new(&gpu).unwrap();
        pass.gmres = GmresPass::from_source(&gpu, &planted(gmres::SHADER, from, to)).unwrap();
        let (worst, _) = solutions_differ(&gpu, &pass, field, &coloured(0.5), &sky(), END);
        found(from, worst[1], SOLUTION);
    }
    told(cases);
}

fn frame(field: DensityField) -> Frame {
    let unit = UnitSpace::of_box([0; 3], [8; 3]);
    let world_from_index = field.world_from_node;
    Frame { field, gaussians: vec![], unit, first_node: [0; 3], world_from_index, transfer: None }
}

#[test]
fn images_agree_for_a_sun_a_sky_both_and_darkness() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let field = plume(5);
    let camera = &cameras(&field)[0];
    let mut cases = 0;
    for scattering in [ScatteringOrder::Single, ScatteringOrder::All] {
        let grid = GridSettings { beams: 16, rings: 3, ..GridSettings::default() };
        let settings = RenderSettings { route: Route::Grid(grid), scattering, ..RenderSettings::default() };
        let mut cpu = Renderer::new(settings, coloured(0.0), vec![]).unwrap();
        let mut device = GpuRenderer::new(gpu.clone(), settings, coloured(0.0), vec![], SolveOn::Device).unwrap();
        cpu.set_frame(frame(field.clone())).unwrap();
        device.set_frame(UploadedFrame::new(&gpu, frame(field.clone())).unwrap()).unwrap();
        for (lights, medium) in [
            (vec![], coloured(0.3)),
            (vec![sky().remove(1)], coloured(0.5)),
            (vec![sky().remove(0)], grey(0.0)),
            (sky(), coloured(0.85)),
            (white_sky(), MediumParameters { albedo: [0.0; 3], ..grey(0.0) }),
        ] {
            cpu.set_lights(lights.clone()).unwrap();
            cpu.set_medium(medium).unwrap();
            device.set_lights(lights).unwrap();
            device.set_medium(medium).unwrap();
            let (expected, a) = cpu.render(camera).unwrap();
            let (found, b) = device.render(camera).unwrap();
            let off = difference(&radiance(&expected), &radiance(&found));
            eprintln!("{scattering:?} {medium:?}: {off:.1e}; {a:?} {b:?}");
            assert!(off <= IMAGE, "{off}");
            // Another view solves nothing.
            let (_, again) = device.render(&cameras(&field)[2]).unwrap();
            assert!(b.source_radiance == 0.0 || again.source_radiance < 0.1 * b.source_radiance, "{again:?}");
            cases += 1;
        }
    }
    told(cases);
}

/// Minutes on a software device; `SMOKE_BAKE_DATA` says where the real sequence is. Fewer beams and ordinates than by
/// default, on coarser nodes, which a comparison does not mind.
#[test]
#[ignore = "needs the real sequence"]
fn images_of_the_real_plume_agree_in_three_scenes() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let data = std::env::var("SMOKE_BAKE_DATA").unwrap_or_else(|_| "../../shared/data".into());
    let mut cases = 0;
    for number in [1020, 1060] {
        let path = std::path::Path::new(&data).join(format!("plume/plume.{number:04}.vdb"));
        let grid = smoke_formats::volume::read(&path, "density").unwrap();
        let field = DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index);
        let settings =
            GridSettings { beams: 16, rings: 3, single_step: 2, multiple_step: 4, ..GridSettings::default() };
        let settings = RenderSettings { route: Route::Grid(settings), ..RenderSettings::default() };
        let mut cpu = Renderer::new(settings, grey(0.0), vec![]).unwrap();
        let mut device = GpuRenderer::new(gpu.clone(), settings, grey(0.0), vec![], SolveOn::Device).unwrap();
        cpu.set_frame(frame(field.clone())).unwrap();
        device.set_frame(UploadedFrame::new(&gpu, frame(field.clone())).unwrap()).unwrap();
        for (name, lights, medium) in [
            ("sun, g = 0.85", vec![sky().remove(1)], grey(0.85)),
            ("sky, g = 0", vec![sky().remove(0)], grey(0.0)),
            ("sky and sun, g = 0.5, coloured", sky(), coloured(0.5)),
        ] {
            cpu.set_lights(lights.clone()).unwrap();
            cpu.set_medium(medium).unwrap();
            device.set_lights(lights).unwrap();
            device.set_medium(medium).unwrap();
            let (expected, _) = cpu.render(&cameras(&field)[0]).unwrap();
            let (found, _) = device.render(&cameras(&field)[0]).unwrap();
            let off = difference(&radiance(&expected), &radiance(&found));
            eprintln!("plume {number}, {name}: {off:.1e}");
            assert!(off <= IMAGE, "{off}");
            cases += 1;
        }
    }
    told(cases);
}

#[test]
fn an_empty_frame_and_one_too_large_for_the_device_are_told_apart() {
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(64 << 10) }) else { return };
    let pass = GridPass::new(&gpu).unwrap();
    let beams = beams(&sky(), 4);
    let solve = |field: &DensityField| {
        let (scattering, settings) = (ScatteringOrder::All, GridSettings::default());
        let problem = GridProblem { field, beams: &beams, medium: coloured(0.3).banded(4), scattering, settings };
        pass.solve(&gpu, &mut DeviceGrids::default(), &problem)
    };
    let empty = DensityField::from_box([0; 3], [3; 3], &[0.0; 27], DAffine3::from_scale(DVec3::splat(0.1)));
    let planes = solve(&empty).unwrap().read(&gpu).unwrap();
    assert!(planes.iter().flatten().flatten().all(|&v| v == 0.0));
    let error = solve(&plume(1)).err().unwrap();
    assert!(matches!(error, GpuError::Limit { limit: 65536, .. }), "{error}");
    assert!(error.to_string().ends_with("use --device cpu"), "{error}");
    eprintln!("{error}");
    told(2);
}
