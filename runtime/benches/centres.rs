//! The centres route stage by stage: how cost grows with the number of Gaussians and the order.

use divan::{Bencher, black_box};
use smoke_formats::gaussian::{Gaussian, UnitSpace};
use smoke_runtime::medium::gaussian_points::GaussianPoints;
use smoke_runtime::sphere::quadrature::Directions;
use smoke_runtime::transport::compensated::centres::depth::{DirectionalDepth, harmonic_depth};
use smoke_runtime::transport::compensated::centres::diffusion::Diffusion;
use smoke_runtime::transport::compensated::centres::exponential::Exponential;
use smoke_runtime::transport::compensated::centres::integral::IntegralTransport;
use smoke_runtime::transport::compensated::centres::overlap::OverlapGrid;
use smoke_runtime::transport::compensated::centres::route::{CentreSettings, CentreTransport, MultipleScattering};
use smoke_runtime::transport::compensated::centres::single::IncidentRadiance;
use smoke_runtime::transport::compensated::centres::volume_pass::{ViewDirections, volume_pass};
use smoke_runtime::transport::medium::MediumParameters;

const COUNTS: [usize; 4] = [150, 300, 600, 1200];

fn main() {
    divan::main();
}

/// A widening plume of `n` Gaussians, radii 0.03 to 0.09, by a fixed low-discrepancy sequence.
fn plume(n: usize) -> Vec<Gaussian> {
    let at = |i: usize, k: f64| ((i as f64 + 0.5) * k).fract();
    (0..n)
        .map(|i| {
            let z = at(i, 0.618_033_988_7);
            let side = |k: f64| (0.5 + (0.1 + 0.25 * z) * (2.0 * at(i, k) - 1.0)) as f32;
            Gaussian {
                center: [side(0.754_877_666), side(0.569_840_290_9), (0.1 + 0.8 * z) as f32],
                radius: (0.03 + 0.06 * at(i, 0.819_172_513)) as f32,
                weight: (0.3 + 0.7 * at(i, 0.671_043_606_7)) as f32,
            }
        })
        .collect()
}

fn points(n: usize) -> GaussianPoints {
    GaussianPoints::new(&plume(n)).expect("good Gaussians")
}

const MEDIUM: MediumParameters = MediumParameters { sigma_t: [10.0; 3], albedo: [0.9, 0.85, 0.8], g: 0.4 };

fn lit(bencher: Bencher, n: usize, settings: CentreSettings) {
    let mut transport = CentreTransport::new(&plume(n), settings).expect("good settings");
    let light = IncidentRadiance::Sampled(vec![[1.0; 3]; transport.directions().len()]);
    bencher.bench_local(|| black_box(transport.radiance(&MEDIUM, 1.0, &light, None)));
}

#[divan::bench(args = COUNTS, sample_count = 5, sample_size = 1)]
fn depth_along_98_directions(bencher: Bencher, n: usize) {
    let (points, directions) = (points(n), Directions::product(7, 14));
    bencher.bench(|| DirectionalDepth::new(&points, &directions));
}

#[divan::bench(args = COUNTS, consts = [2, 4, 6], sample_count = 5, sample_size = 1)]
fn depth_as_harmonics<const ORDER: usize>(bencher: Bencher, n: usize) {
    let points = points(n);
    bencher.bench(|| harmonic_depth(&points, ORDER));
}

#[divan::bench(args = COUNTS, consts = [2, 4, 6], sample_count = 5, sample_size = 1)]
fn single_scattering_direct<const ORDER: usize>(bencher: Bencher, n: usize) {
    let multiple = MultipleScattering::None;
    lit(bencher, n, CentreSettings { order: ORDER, multiple, ..CentreSettings::default() });
}

#[divan::bench(args = COUNTS, sample_count = 5, sample_size = 1)]
fn single_scattering_optimal_linear(bencher: Bencher, n: usize) {
    let (multiple, exponential) = (MultipleScattering::None, Exponential::OptimalLinear);
    lit(bencher, n, CentreSettings { exponential, multiple, ..CentreSettings::default() });
}

#[divan::bench(args = COUNTS, sample_count = 3, sample_size = 1)]
fn diffusion_assembly(bencher: Bencher, n: usize) {
    let points = points(n);
    bencher.bench(|| Diffusion::new(&points));
}

#[divan::bench(args = COUNTS, sample_count = 3, sample_size = 1)]
fn relit_with_diffusion(bencher: Bencher, n: usize) {
    lit(bencher, n, CentreSettings { multiple: MultipleScattering::Diffusion, ..CentreSettings::default() });
}

#[divan::bench(args = COUNTS, consts = [1, 2], sample_count = 3, sample_size = 1)]
fn integral_matrix<const BANDS: usize>(bencher: Bencher, n: usize) {
    let (points, directions) = (points(n), Directions::product(7, 14));
    let (depth, grid) = (DirectionalDepth::new(&points, &directions), OverlapGrid::new(&points));
    bencher.bench(|| IntegralTransport::new(&points, &grid, &directions, &depth, 10.0, BANDS));
}

#[divan::bench(args = COUNTS, sample_count = 3, sample_size = 1)]
fn overlap_grid(bencher: Bencher, n: usize) {
    let points = points(n);
    bencher.bench(|| OverlapGrid::new(&points));
}

#[divan::bench(args = COUNTS, sample_count = 3, sample_size = 1)]
fn relit_with_integral_transport(bencher: Bencher, n: usize) {
    lit(bencher, n, CentreSettings::default());
}

#[divan::bench(args = [150, 600], consts = [1, 4], sample_count = 3, sample_size = 1)]
fn volume_pass_64<const ORDER: usize>(bencher: Bencher, n: usize) {
    let settings = CentreSettings { order: ORDER, multiple: MultipleScattering::None, ..CentreSettings::default() };
    let mut transport = CentreTransport::new(&plume(n), settings).expect("good settings");
    let light = IncidentRadiance::Sampled(vec![[1.0; 3]; 98]);
    let radiance = transport.radiance(&MEDIUM, 1.0, &light, None).expect("good light");
    let (space, view) = (UnitSpace::of_box([0; 3], [64; 3]), ViewDirections::Eye([0.5, -2.0, 0.5]));
    bencher.bench_local(|| volume_pass(transport.points(), &radiance, &space, [0; 3], [64; 3], view));
}
