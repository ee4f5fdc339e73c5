//! What a transfer costs and how far off it is: the tables of `docs/decisions/050-transfer.md`.
//!
//! ```console
//! $ cargo run --release --example transfer_error -p smoke-baking -- plume.1040.vdb sunset.exr [TABLE ...]
//! ```
//!
//! Errors are relative RMSE over the pixels with smoke against the path tracer, its own noise taken out; 100 x 125
//! pixels of `scenes/plume.toml`. Tables: `cells`, `photons`, `clusters`, `bases`; all of them by default.

use glam::{DVec3, Vec3};
use smoke_baking::transfer::at_rest::frame_transfer;
use smoke_baking::transfer::{RunTransfer, TransferSettings, bake_run};
use smoke_formats::{image, volume};
use smoke_runtime::backdrop::Sky;
use smoke_runtime::camera::Camera;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::march::{MarchMedium, MarchSettings, march};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::shaded_volume::ShadedVolume;
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::reference::{Estimate, ReferenceSettings, trace};
use smoke_runtime::transport::transfer::frame::FrameTransfer;
use smoke_runtime::transport::transfer::source::{TransferSettings as Dials, TransferTransport};
use smoke_runtime::transport::{ScatteringOrder, SourceRadiance};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

const REFERENCE_ERROR: f64 = 0.01;

struct Case {
    name: &'static str,
    g: f32,
    lights: Vec<Light>,
    truth: Estimate,
}

fn main() {
    let mut args = std::env::args().skip(1);
    let usage = "usage: transfer_error VOLUME ENVIRONMENT [TABLE ...]";
    let (volume, environment) = (args.next().expect(usage), args.next().expect(usage));
    let tables: Vec<String> = args.collect();
    let wants = |table: &str| tables.is_empty() || tables.iter().any(|t| t == table);
    let field = field(Path::new(&volume));
    let camera = Camera::look_at(DVec3::new(1.4, -4.6, 1.9), DVec3::new(1.3, 1.3, 1.6), DVec3::Z, 36.0, 100, 125);
    let cases = cases(&field, &camera, Path::new(&environment));
    let settings = TransferSettings {
        basis: BasisKind::Hat(642),
        medium: medium(0.0),
        clusters: 128,
        terms: 4,
        photons: 10,
        shift: 1,
        seed: 1,
        memory: 4 << 30,
    };
    let fine = TransferSettings { clusters: 1, terms: 255, ..settings };
    let show = |name: String, settings: TransferSettings, dials: Dials| {
        for g in [0.0f32, 0.5] {
            let settings = TransferSettings { medium: medium(g), ..settings };
            let baked = bake(&field, &settings);
            let errors: Vec<String> = cases
                .iter()
                .filter(|c| c.g == g)
                .map(|case| format!("{:.2} %", 100.0 * error(&field, &camera, case, &baked.1, dials)))
                .collect();
            let run = &baked.0;
            let matrix = |sets: &[smoke_baking::transfer::SharedRows]| 100.0 * sets[0].error;
            println!(
                "| {name} | {g} | {} | {:.1} / {:.1} % | {:.1} / {:.1} / {:.1} s | {:.1} M | {:.1} |",
                errors.join(" | "),
                matrix(&run.direct),
                matrix(&run.indirect),
                run.seconds.direct,
                run.seconds.photons,
                run.seconds.compress,
                run.photons as f64 * 1e-6,
                bytes(run) as f64 / active(&field) as f64,
            );
        }
    };
    let head = || {
        println!(
            "\n| what | g | sky | sun | matrix, direct / indirect | direct / photons / compress | photons | bytes a voxel |"
        );
        println!("|---|---|---|---|---|---|---|---|");
    };
    println!("{} active voxels, nodes {:?}", active(&field), field.dims);
    if wants("cells") {
        head();
        for shift in [2, 1] {
            show(
                format!("cells of {} voxels, uncompressed", 1 << shift),
                TransferSettings { shift, ..fine },
                Dials::default(),
            );
        }
    }
    if wants("photons") {
        head();
        for photons in [1, 10, 20] {
            show(
                format!("{photons} photons a face, uncompressed"),
                TransferSettings { photons, ..fine },
                Dials::default(),
            );
        }
    }
    if wants("clusters") {
        head();
        for clusters in [32, 64, 128, 256] {
            show(format!("{clusters} clusters x 4"), TransferSettings { clusters, ..settings }, Dials::default());
        }
        show("1 cluster x 64".into(), TransferSettings { clusters: 1, terms: 64, ..settings }, Dials::default());
    }
    if wants("bases") {
        head();
        for basis in ["hat162", "hat642", "dsf642", "sh6"] {
            let basis = BasisKind::of_name(basis).expect("a basis");
            show(basis.name(), TransferSettings { basis, ..settings }, Dials::default());
        }
        show("hat642, suns as lobes".into(), settings, Dials { sharp_suns: false });
    }
}

fn medium(g: f32) -> MediumParameters {
    MediumParameters { sigma_t: [8.0; 3], albedo: [0.92; 3], g }
}

fn field(path: &Path) -> DensityField {
    let grid = volume::read(path, "density").expect("a volume");
    DensityField::from_box(grid.origin, grid.dims, &grid.values, grid.world_from_index)
}

fn active(field: &DensityField) -> usize {
    field.values.iter().filter(|v| **v > 0.0).count()
}

fn cases(field: &DensityField, camera: &Camera, environment: &Path) -> Vec<Case> {
    let (image, _) = image::read_environment(environment).expect("an environment");
    let sky = Environment {
        width: image.width,
        height: image.height,
        radiance: image.pixels,
        ..Environment::constant([0.0; 3])
    };
    let sun = Light::Directional { toward: Vec3::new(-0.9, -0.35, 0.5).normalize(), irradiance: [14.0, 12.5, 10.5] };
    let mut out = Vec::new();
    for g in [0.0, 0.5] {
        for (name, lights) in [("sky", vec![Light::Environment(sky.clone())]), ("sun", vec![sun.clone()])] {
            let settings = ReferenceSettings { target_error: REFERENCE_ERROR, ..ReferenceSettings::default() };
            let truth = trace(field, &medium(g), &lights, camera, &settings, &mut |_, _| ()).expect("a reference");
            eprintln!("reference, {name}, g {g}: {:.2} %", 100.0 * truth.relative_error);
            out.push(Case { name, g, lights, truth });
        }
    }
    out
}

fn bake(field: &DensityField, settings: &TransferSettings) -> (RunTransfer, Arc<FrameTransfer>) {
    let bases = [settings.basis, settings.basis.coarser()].map(|kind| Arc::new(LightBasis::new(kind)));
    let run = bake_run(&[field], [&bases[0], &bases[1]], settings, &|_, _, _| ());
    let transfer = frame_transfer(&run, settings, &bases, 0);
    (run, Arc::new(transfer))
}

/// Bytes at rest: half floats and an id a row.
fn bytes(run: &RunTransfer) -> usize {
    let of = |set: &smoke_baking::transfer::SharedRows| {
        2 * set.bases.len() + set.frames[0].0.len() + 2 * set.frames[0].1.len()
    };
    run.direct.iter().chain(&run.indirect).map(of).sum()
}

fn error(field: &DensityField, camera: &Camera, case: &Case, transfer: &Arc<FrameTransfer>, dials: Dials) -> f64 {
    let mut transport = TransferTransport::new(field, transfer.clone(), dials).expect("a transfer of this field");
    let start = Instant::now();
    let source = transport.light(field, &case.lights, ScatteringOrder::All);
    let lit = start.elapsed().as_secs_f64();
    let start = Instant::now();
    let mut shaded = ShadedVolume::of(field);
    source.shade(field, camera.position, &mut shaded);
    let viewed = start.elapsed().as_secs_f64();
    eprintln!("{} g {}: light {:.1} ms, view {:.1} ms", case.name, case.g, 1e3 * lit, 1e3 * viewed);
    let sky = Sky::new(&case.lights, None);
    let film = march(
        &shaded,
        camera,
        &MarchMedium::plain([8.0; 3]),
        &sky,
        &MarchSettings { samples: 3, ..MarchSettings::default() },
    );
    let (mut errors, mut squares) = (0.0f64, 0.0f64);
    for (i, (a, b)) in film.pixels.iter().zip(&case.truth.film.pixels).enumerate() {
        if a.alpha() > 0.0 || b.alpha() > 0.0 {
            for c in 0..3 {
                let (a, b) = (f64::from(a.radiance[c]), f64::from(b.radiance[c]));
                let variance = f64::from(case.truth.standard_error[i][c]).powi(2);
                errors += (a - b).powi(2) - variance;
                squares += b * b - variance;
            }
        }
    }
    (errors.max(0.0) / squares).sqrt()
}
