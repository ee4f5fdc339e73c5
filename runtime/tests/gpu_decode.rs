//! Decoding on the device against the processor: sums of Gaussians and densities. `gpu_common` says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use glam::{DAffine3, DVec3};
use gpu_common::{cameras, device, difference, plume, shaded, sky, tiny, told};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_formats::pack::FrameResidual;
use smoke_formats::residual::hash::{HashTable, HashView, assemble};
use smoke_formats::residual::rank::{RankView, encode};
use smoke_formats::residual::{Residual, ResidualCodes};
use smoke_formats::volume::VoxelMask;
use smoke_runtime::gpu::decode::{Coded, DECODER, DecodePass, GAUSSIAN_SUM};
use smoke_runtime::gpu::device::{ForcedLimits, Gpu, GpuError};
use smoke_runtime::gpu::volume::DeviceVolume;
use smoke_runtime::gpu::volume_pass::{DeviceSource, VolumePass};
use smoke_runtime::light::beams;
use smoke_runtime::medium::decoder::{decode_field, decode_gaussians};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::gaussian_sum::gaussian_sum;
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::grid::route::{GridSettings, GridTransport};
use smoke_runtime::transport::medium::MediumParameters;
use std::path::Path;
use std::sync::Arc;

const ORIGIN: [i32; 3] = [-7, 3, 40];
const TEXTS: [&str; 2] = [GAUSSIAN_SUM, DECODER];
/// Of the sum of magnitudes at a voxel: three exponentials of 2 units in the last place, places rounded twice at u <= 3
/// (|d exp(-u^2)| <= 2 u^2 exp(-u^2) 2 x 2^-24 an axis), four products, and as many sums as Gaussians, some 100.
const SUM: f64 = 120.0 / (1 << 24) as f64;
/// A voxel on the border of a support may be found on its other side: exp(-9) of a weight of 1.
const BORDER: f64 = 1.3e-4;

fn path() -> &'static Path {
    Path::new("made up")
}

/// Gaussians all over a box, some beyond it and one so far away that it counts for nothing.
fn spread(count: usize) -> Vec<Gaussian> {
    let mut state = 77u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let mut all: Vec<Gaussian> = (0..count)
        .map(|_| Gaussian {
            center: [0; 3].map(|_| next() * 1.4 - 0.2),
            radius: 0.015 + next() * 0.075,
            weight: 0.2 * next(),
        })
        .collect();
    all.push(Gaussian { center: [1e30, 0.5, 0.5], radius: 0.09, weight: 1.0 });
    all
}

/// The voxels of a field, without its border.
fn voxels(field: &DensityField) -> ([u32; 3], Vec<f32>) {
    let [nx, ny, nz] = field.dims;
    let row = |j: usize, k: usize| &field.values[1 + nx * (j + ny * k)..][..nx - 2];
    let values = (1..nz - 1).flat_map(|k| (1..ny - 1).flat_map(move |j| row(j, k).iter().copied()));
    ([nx, ny, nz].map(|n| n as u32 - 2), values.collect())
}

/// The residual of `field` against the Gaussians' sum.
fn residual(field: &DensityField, gaussians: &[Gaussian], step: f32) -> ResidualCodes {
    let (dims, values) = voxels(field);
    let sum = gaussian_sum(gaussians, &UnitSpace::of_box(ORIGIN, dims), ORIGIN, dims.map(|d| d as usize));
    let mut support = VoxelMask::new(values.len());
    let dense = (0..values.len()).filter(|&v| values[v] > 0.0);
    let codes = dense.map(|v| {
        support.set(v);
        ((values[v] - sum[v]) / step).round() as i32
    });
    let codes = codes.collect();
    let residual = ResidualCodes { origin: ORIGIN, dims, support, codes };
    residual.check(path()).unwrap();
    residual
}

/// By ranks, and as the last frame of a tile in a perfect hash. Offsets are even on an even side of the table, two an
/// axis, so that places of one parity stay there: no two of them meet.
fn layouts(codes: &ResidualCodes, tile: usize) -> Vec<FrameResidual> {
    let rank = RankView::new(path(), encode(codes)).unwrap();
    let mut out = vec![FrameResidual { residual: Arc::new(Residual::Rank(rank)), frame: 0 }];
    let most = codes.dims.into_iter().max().unwrap().next_multiple_of(2);
    let side = if tile > 1 { 2 * most } else { most };
    let offsets = (0..24u32).map(|i| (2 * (i * 37 % 91)) as u8).collect();
    let table = HashTable { side, offset_side: 2, offsets };
    let bytes = assemble(path(), &vec![codes.clone(); tile], &table).unwrap();
    let hash = HashView::new(path(), bytes).unwrap();
    assert_eq!(hash.codes(tile - 1).unwrap(), *codes);
    out.push(FrameResidual { residual: Arc::new(Residual::Hash(hash)), frame: tile - 1 });
    out
}

fn read(gpu: &Gpu, pass: &DecodePass, frame: &Coded, sums: bool) -> Vec<f32> {
    let buffer = if sums { pass.sum(gpu, frame) } else { pass.density(gpu, frame) }.unwrap();
    let nodes = frame.dims.iter().map(|&n| n as usize + 2).product();
    gpu.read("density", &buffer, nodes).unwrap()
}

/// Voxels of the device's that are further from the processor's than rounding explains, and the largest difference; a
/// value that is not a number is as far as can be.
fn compare(expected: &[f32], found: &[f32], tolerance: f64) -> (usize, f64) {
    assert_eq!(expected.len(), found.len());
    let off = expected.iter().zip(found).map(|(a, b)| f64::from(a - b).abs());
    off.fold((0, 0.0), |(count, most), d| match d <= tolerance {
        true => (count, d.max(most)),
        false => (
            count + 1,
            if d > most {
                d
            } else if d.is_nan() {
                f64::INFINITY
            } else {
                most
            },
        ),
    })
}

fn padded(dims: [u32; 3], values: &[f32]) -> Vec<f32> {
    DensityField::from_box(ORIGIN, dims.map(|d| d as usize), values, DAffine3::IDENTITY).values
}

#[test]
fn sums_and_densities_are_the_same_on_both_sides_for_every_layout_and_width_of_codes() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = DecodePass::new(&gpu).unwrap();
    let mut cases = 0;
    for (field, tile) in [(plume(2), 1), (plume(6), 1), (tiny(), 1), (tiny(), 2)] {
        let gaussians = spread(300);
        let (dims, _) = voxels(&field);
        let unit = UnitSpace::of_box(ORIGIN, dims);
        let largest = f64::from(field.max());
        for parts in [40.0f32, 2000.0, 2e6] {
            let step = field.max() / parts;
            let codes = residual(&field, &gaussians, step);
            let sum = gaussian_sum(&gaussians, &unit, ORIGIN, dims.map(|d| d as usize));
            let peak = f64::from(sum.iter().copied().fold(0.0, f32::max));
            let tolerance = SUM * (peak + largest);
            let frame = Coded { gaussians: &gaussians, unit: &unit, origin: ORIGIN, dims, residual: None, step };
            let expected = padded(dims, &sum);
            let (beyond, most) = compare(&expected, &read(&gpu, &pass, &frame, true), tolerance);
            eprintln!("{dims:?}, sums up to {peak:.2}: {most:.1e}, {beyond} beyond {tolerance:.1e}");
            assert!(most <= BORDER && beyond * 10_000 <= expected.len(), "{most} {beyond}");
            let alone = padded(dims, &decode_gaussians(&gaussians, ORIGIN, dims, step, &unit));
            let (beyond, most) = compare(&alone, &read(&gpu, &pass, &frame, false), tolerance);
            // A sum of half a step may be found on the other side of it.
            assert!(most <= f64::from(step).max(BORDER) && beyond * 10_000 <= alone.len(), "{most} {beyond}");
            let expected = decode_field(&gaussians, &codes, step, &unit, DAffine3::IDENTITY).values;
            for residual in layouts(&codes, tile) {
                let frame = Coded { residual: Some(&residual), ..frame };
                let (beyond, most) = compare(&expected, &read(&gpu, &pass, &frame, false), tolerance);
                let kind = if matches!(*residual.residual, Residual::Rank(_)) { "ranks" } else { "hash" };
                eprintln!("{dims:?}, 1/{parts} by {kind}: {most:.1e}, {beyond} beyond, of {largest:.2}");
                assert!(most <= BORDER && beyond * 10_000 <= expected.len(), "{most} {beyond}");
                cases += 1;
            }
            cases += 2;
        }
    }
    told(cases);
}

#[test]
fn a_volume_pass_reads_a_density_that_was_decoded_on_the_device() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let (gaussians, (dims, _)) = (spread(300), voxels(&plume(2)));
    let unit = UnitSpace::of_box(ORIGIN, dims);
    let step = 0.01;
    let codes = residual(&plume(2), &gaussians, step);
    let field = decode_field(&gaussians, &codes, step, &unit, DAffine3::from_scale(DVec3::splat(0.02)));
    let residual = &layouts(&codes, 1)[0];
    let frame = Coded { gaussians: &gaussians, unit: &unit, origin: ORIGIN, dims, residual: Some(residual), step };
    let density = DecodePass::new(&gpu).unwrap().density(&gpu, &frame).unwrap();
    let medium = MediumParameters { sigma_t: [6.0; 3], albedo: [0.9; 3], g: 0.3 };
    let (beams, settings) = (beams(&sky(), 8), GridSettings { beams: 8, rings: 2, ..GridSettings::default() });
    let source = GridTransport::new(settings).solve(&field, &beams, &medium.banded(4), ScatteringOrder::Single);
    let eye = cameras(&field)[0].position;
    let volume = DeviceVolume::of_field(&gpu, &field).unwrap();
    let on_device = DeviceSource::new(&gpu, &source).unwrap();
    VolumePass::new(&gpu).unwrap().shade(&gpu, &on_device, (&field, &density), &volume, eye).unwrap();
    let expected = DeviceVolume::of_shaded(&gpu, &shaded(&source, &field, eye)).unwrap().read(&gpu).unwrap();
    let found = volume.read(&gpu).unwrap();
    // The processor leaves out radiance of nodes that no sample reads, but not their density.
    let fourth = |nodes: &[[f32; 4]]| nodes.iter().map(|n| n[3]).collect::<Vec<_>>();
    let density = difference(&fourth(&expected), &fourth(&found));
    let pairs = expected.iter().zip(found).filter(|(e, _)| e[..3].iter().any(|&v| v > 0.0));
    let (expected, found): (Vec<[f32; 4]>, Vec<[f32; 4]>) = pairs.unzip();
    let nodes = difference(expected.as_flattened(), found.as_flattened());
    eprintln!("density {density:.1e}, nodes {nodes:.1e}");
    // As far as the volume pass goes.
    assert!(density <= 1e-6 && nodes <= 1e-5, "{density} {nodes}");
    told(1);
}

#[test]
fn an_empty_frame_no_gaussians_and_a_single_voxel_are_no_trouble() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let pass = DecodePass::new(&gpu).unwrap();
    let unit = UnitSpace::of_box(ORIGIN, [4; 3]);
    let empty = Coded { gaussians: &[], unit: &unit, origin: ORIGIN, dims: [0; 3], residual: None, step: 0.1 };
    assert_eq!(read(&gpu, &pass, &empty, false), vec![0.0; 8]);
    assert_eq!(read(&gpu, &pass, &Coded { dims: [4; 3], ..empty }, false), vec![0.0; 216]);
    let unit = UnitSpace::of_box(ORIGIN, [1; 3]);
    let gaussians = [Gaussian { center: [0.5; 3], radius: 0.015, weight: 0.75 }];
    let one = Coded { gaussians: &gaussians, unit: &unit, dims: [1; 3], ..empty };
    let found = read(&gpu, &pass, &one, false);
    assert_eq!((found[13], found.iter().filter(|&&v| v != 0.0).count()), (0.75, 1));
    told(3);
}

#[test]
fn a_difference_planted_in_a_shader_of_the_decoder_is_found_by_the_comparison() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let (field, gaussians) = (plume(2), spread(300));
    let (dims, _) = voxels(&field);
    let unit = UnitSpace::of_box(ORIGIN, dims);
    let step = field.max() / 40.0;
    let codes = residual(&field, &gaussians, step);
    let expected = decode_field(&gaussians, &codes, step, &unit, DAffine3::IDENTITY).values;
    let layouts = layouts(&codes, 1);
    let peak = gaussian_sum(&gaussians, &unit, ORIGIN, dims.map(|d| d as usize)).into_iter().fold(0.0, f32::max);
    let tolerance = SUM * f64::from(peak + field.max());
    let mut cases = 0;
    for (file, layout, from, to) in [
        (0, 0, "const LIMIT = 9.0", "const LIMIT = 8.0"),
        (0, 0, "p * f + 1.0 / 6.0", "p * f + 1.0 / 6.2"),
        (0, 0, "- bitcast<f32>(rest)", "- 1.001 * bitcast<f32>(rest)"),
        (0, 0, "y_squares[local * 8u + i] = y.x", "y_squares[local * 8u + i] = 0.0"),
        (0, 0, "left &= left - 1u", "left &= left - 2u"),
        (0, 0, "1u << (local % 32u)", "1u << (local % 31u)"),
        (1, 0, "bits_below(mask, bit) * width", "bits_below(mask, bit & 31u) * width"),
        (1, 0, "first % 32u + width > 32u", "first % 32u + width > 33u"),
        (1, 0, "about >> 19u <<", "about >> 20u <<"),
        (1, 0, "is_support && value", "value"),
        (1, 1, "countOneBits(mixed & below)", "countOneBits(mixed)"),
        (1, 1, "words[3] * vec3(byte(at), byte(at + 1u)", "words[3] * vec3(byte(at + 1u), byte(at)"),
        (1, 1, ") >> (32u - bits)", ") >> (31u - bits)"),
        (1, 1, "box_.step * f32(code)", "1.001 * box_.step * f32(code)"),
    ] {
        let mut texts = TEXTS.map(String::from);
        assert!(texts[file].contains(from), "{from}");
        texts[file] = texts[file].replace(from, to);
        let pass = DecodePass::from_sources(&gpu, texts.each_ref().map(String::as_str)).unwrap();
        let residual = Some(&layouts[layout]);
        let frame = Coded { gaussians: &gaussians, unit: &unit, origin: ORIGIN, dims, residual, step };
        let (beyond, most) = compare(&expected, &read(&gpu, &pass, &frame, false), tolerance);
        eprintln!("{from} -> {to}: {most:.1e}, {beyond} beyond");
        assert!(most > BORDER || beyond * 10_000 > expected.len(), "{from}: {most} {beyond}");
        cases += 1;
    }
    told(cases);
}

#[test]
fn a_frame_that_a_device_cannot_hold_is_refused_by_name() {
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(64 << 10) }) else { return };
    let pass = DecodePass::new(&gpu).unwrap();
    let unit = UnitSpace::of_box(ORIGIN, [60; 3]);
    let frame = Coded { gaussians: &[], unit: &unit, origin: ORIGIN, dims: [60; 3], residual: None, step: 0.1 };
    let error = pass.density(&gpu, &frame).unwrap_err();
    assert!(matches!(error, GpuError::Limit { what: "density of the frame", limit: 65536, .. }), "{error}");
    assert!(error.to_string().ends_with("use --device cpu"), "{error}");
    told(1);
}
