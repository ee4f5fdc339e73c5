//! The bases of lights beside harmonics of like size: how well they keep a chequer, and how long they take.
//!
//! ```console
//! $ cargo run --release --example basis_table -p smoke-runtime
//! ```
//!
//! Errors: relative L2 over the sphere of what the coefficients give back of a chequer of 0 and 1, 2 x 2 fields a face of a
//! cube: as a cube map of 128 texels a side, whose axes are the mesh's, and turned, the mean of four rotations of an
//! environment of 886 x 444 texels, as many as 6 x 256 x 256. Projection: the whole environment to coefficients, least of
//! five runs on all threads. Evaluation: one direction, mean of many, one
//! thread. Harmonics above order 6 are made here by the usual recurrence (Sloan 2008), as the library stops there.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use smoke_runtime::light::{Environment, Light};
use smoke_runtime::sphere::light_basis::{BasisKind, LightBasis};
use std::f64::consts::PI;
use std::hint::black_box;
use std::time::Instant;

const WIDTH: usize = 886;
const HEIGHT: usize = 444;

fn main() {
    println!("| basis | functions | cube map | turned | projection | evaluation |\n|---|---|---|---|---|---|");
    let cube = cube_map();
    let sky = environment(DQuat::from_rotation_y(0.3));
    for (nodes, order) in [(162, 13), (642, 26), (2562, 51)] {
        for kind in [BasisKind::Discrete(nodes), BasisKind::Hat(nodes)] {
            let basis = LightBasis::new(kind);
            let lights = [Light::Environment(sky.clone())];
            let (projection, coefficients) = least(|| basis.coefficients(&lights));
            let evaluation = mean(|d| basis.reconstruct(&coefficients, d));
            let error = over_rotations(|sky| {
                let coefficients = basis.coefficients(&[Light::Environment(sky.clone())]);
                Box::new({
                    let basis = basis.clone();
                    move |d| basis.reconstruct(&coefficients, d)[0]
                })
            });
            let of_cube = of_cube_map(&basis, &cube);
            let cube = relative_error(&cube, |d| basis.reconstruct(&of_cube, d)[0]);
            row(&kind.name(), nodes, [cube, error], projection, evaluation);
        }
        let (projection, coefficients) = least(|| project(&sky, order));
        let evaluation = mean(|d| reconstruct(&coefficients, order, d));
        let error = over_rotations(|sky| {
            let coefficients = project(sky, order);
            Box::new(move |d| reconstruct(&coefficients, order, d)[0])
        });
        let of_cube = harmonics_of_cube_map(&cube, order);
        let cube = relative_error(&cube, |d| reconstruct(&of_cube, order, d)[0]);
        row(&format!("harmonics of {order} bands"), order * order, [cube, error], projection, evaluation);
    }
}

fn row(name: &str, functions: usize, [cube, turned]: [f64; 2], projection: f64, evaluation: f64) {
    let (milliseconds, microseconds) = (1e3 * projection, 1e6 * evaluation);
    println!("| {name} | {functions} | {cube:.3} | {turned:.3} | {milliseconds:.2} ms | {microseconds:.3} us |");
}

/// A texel of a cube map: its direction and solid angle, and 0 or 1.
type Texel = (DVec3, f64, f64);

/// The chequer as a cube map of 6 x 128 x 128 texels: right and down on each face as cube maps have them.
fn cube_map() -> Vec<Texel> {
    const SIDE: usize = 128;
    let place = |i: f64| 2.0 * i / SIDE as f64 - 1.0;
    // Solid angle of the face's corner rectangle from its middle to (x, y).
    let corner = |x: f64, y: f64| (x * y).atan2((x * x + y * y + 1.0).sqrt());
    let texel = |t: usize| {
        let (face, i, j) = (t / (SIDE * SIDE), (t % SIDE) as f64, (t / SIDE % SIDE) as f64);
        let (u, v) = (place(i + 0.5), place(j + 0.5));
        let direction = match face {
            0 => DVec3::new(1.0, -v, -u),
            1 => DVec3::new(-1.0, -v, u),
            2 => DVec3::new(u, 1.0, v),
            3 => DVec3::new(u, -1.0, -v),
            4 => DVec3::new(u, -v, 1.0),
            _ => DVec3::new(-u, -v, -1.0),
        };
        let [left, right, top, bottom] = [place(i), place(i + 1.0), place(j), place(j + 1.0)];
        let solid = corner(left, top) - corner(left, bottom) - corner(right, top) + corner(right, bottom);
        (direction.normalize(), solid, f64::from(u8::from((u > 0.0) == (v > 0.0))))
    };
    (0..6 * SIDE * SIDE).map(texel).collect()
}

/// Coefficients by the adjoint mean, over the texels as they are.
fn of_cube_map(basis: &LightBasis, cube: &[Texel]) -> Vec<[f64; 3]> {
    let mut sums = vec![0.0; basis.kind().len()];
    for &(direction, solid, value) in cube {
        let local = basis.local(basis.mesh().triangle(direction), direction);
        local.nodes.iter().zip(local.values).for_each(|(&node, w)| sums[node as usize] += w * solid * value);
    }
    sums.iter().zip(basis.areas()).map(|(sum, area)| [sum / area; 3]).collect()
}

fn harmonics_of_cube_map(cube: &[Texel], order: usize) -> Vec<[f32; 3]> {
    let (mut sums, mut values) = (vec![[0.0f32; 3]; order * order], vec![0.0f32; order * order]);
    for &(direction, solid, value) in cube.iter().filter(|texel| texel.2 != 0.0) {
        harmonics(order, direction, &mut values);
        let flux = (solid * value) as f32;
        sums.iter_mut().zip(&values).for_each(|(s, y)| s.iter_mut().for_each(|s| *s += flux * y));
    }
    sums
}

fn relative_error(cube: &[Texel], answer: impl Fn(DVec3) -> f64 + Sync) -> f64 {
    let squares =
        cube.par_iter().map(|&(d, solid, value)| [solid * (answer(d) - value).powi(2), solid * value * value]);
    let [left, whole] = squares.collect::<Vec<_>>().iter().fold([0.0; 2], |[a, b], [c, d]| [a + c, b + d]);
    (left / whole).sqrt()
}

/// Least wall seconds of five runs, and the result.
fn least<T>(run: impl Fn() -> T) -> (f64, T) {
    let mut best = f64::INFINITY;
    let mut out = run();
    for _ in 0..5 {
        let start = Instant::now();
        out = run();
        best = best.min(start.elapsed().as_secs_f64());
    }
    (best, out)
}

/// Mean seconds for one of many directions.
fn mean(of: impl Fn(DVec3) -> [f64; 3]) -> f64 {
    let directions: Vec<DVec3> = points(20_000).collect();
    let start = Instant::now();
    directions.iter().for_each(|d| {
        black_box(of(*d));
    });
    start.elapsed().as_secs_f64() / directions.len() as f64
}

/// Directions spread evenly (Fibonacci).
fn points(count: usize) -> impl Iterator<Item = DVec3> {
    (0..count).map(move |i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / count as f64;
        let phi = i as f64 * PI * (3.0 - 5.0f64.sqrt());
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * phi.cos(), r * phi.sin(), z)
    })
}

fn chequer(turn: DQuat, direction: DVec3) -> f64 {
    let d = turn * direction;
    let size = d.abs();
    let [u, v] = if size.x >= size.y && size.x >= size.z {
        [d.y, d.z]
    } else if size.y >= size.z {
        [d.z, d.x]
    } else {
        [d.x, d.y]
    };
    f64::from(u8::from((u > 0.0) == (v > 0.0)))
}

/// The chequer as an image, four by four samples a texel.
fn environment(turn: DQuat) -> Environment {
    let mut sky = Environment::constant([0.0; 3]);
    (sky.width, sky.height) = (WIDTH, HEIGHT);
    let texel = |t: usize| {
        let mut sum = 0.0;
        for sample in 0..16 {
            let column = (t % WIDTH) as f64 + (f64::from(sample % 4) + 0.5) / 4.0;
            let line = (t / WIDTH) as f64 + (f64::from(sample / 4) + 0.5) / 4.0;
            sum += chequer(turn, sky.direction(column / WIDTH as f64, line / HEIGHT as f64));
        }
        [(sum / 16.0) as f32; 3]
    };
    let radiance = (0..WIDTH * HEIGHT).into_par_iter().map(texel).collect();
    Environment { radiance, ..sky }
}

/// A function of the direction, the red channel of a basis's answer.
type Answer = Box<dyn Fn(DVec3) -> f64 + Sync>;

fn over_rotations(of: impl Fn(&Environment) -> Answer) -> f64 {
    let turns = [0.0, 0.2, 0.6, 1.1].map(|a| DQuat::from_euler(glam::EulerRot::XYZ, a, 0.7 * a, 0.3 * a));
    let error = |turn: &DQuat| {
        let answer = of(&environment(*turn));
        let sums: Vec<[f64; 2]> = points(200_000)
            .collect::<Vec<_>>()
            .par_chunks(4096)
            .map(|chunk| {
                let mut sums = [0.0; 2];
                for d in chunk {
                    let truth = chequer(*turn, *d);
                    sums[0] += (answer(*d) - truth).powi(2);
                    sums[1] += truth * truth;
                }
                sums
            })
            .collect();
        let [left, whole] = [0, 1].map(|s| sums.iter().map(|sum| sum[s]).sum::<f64>());
        (left / whole).sqrt()
    };
    turns.iter().map(error).sum::<f64>() / turns.len() as f64
}

/// Real harmonics of `order` bands at a direction, `l (l + 1) + m`.
fn harmonics(order: usize, d: DVec3, out: &mut [f32]) {
    let (mut diagonal, mut cosine, mut sine) = ((0.25 / PI).sqrt(), 1.0f64, 0.0f64);
    for m in 0..order {
        // Normalised Legendre functions over sin^m, from the diagonal up.
        let (mut before, mut here) = (0.0, diagonal);
        for l in m..order {
            if l > m {
                let (l, m) = (l as f64, m as f64);
                let a = ((4.0 * l * l - 1.0) / (l * l - m * m)).sqrt();
                let b = (((l - 1.0) * (l - 1.0) - m * m) / (4.0 * (l - 1.0) * (l - 1.0) - 1.0)).max(0.0).sqrt();
                let next = a * (d.z * here - b * before);
                (before, here) = (here, next);
            }
            let middle = l * (l + 1);
            let scale = if m == 0 { 1.0 } else { std::f64::consts::SQRT_2 };
            out[middle + m] = (scale * here * cosine) as f32;
            out[middle - m] = if m == 0 { out[middle] } else { (scale * here * sine) as f32 };
        }
        diagonal *= -((2.0 * m as f64 + 3.0) / (2.0 * m as f64 + 2.0)).sqrt();
        (cosine, sine) = (cosine * d.x - sine * d.y, cosine * d.y + sine * d.x);
    }
}

/// Coefficients of an environment, RGB.
fn project(sky: &Environment, order: usize) -> Vec<[f32; 3]> {
    let parts: Vec<Vec<[f32; 3]>> = (0..HEIGHT)
        .collect::<Vec<_>>()
        .par_chunks(8)
        .map(|lines| {
            let (mut sums, mut values) = (vec![[0.0f32; 3]; order * order], vec![0.0f32; order * order]);
            for &line in lines {
                let top = PI * line as f64 / HEIGHT as f64;
                let solid = (2.0 * PI / WIDTH as f64 * (top.cos() - (top + PI / HEIGHT as f64).cos())) as f32;
                for column in 0..WIDTH {
                    let d = sky.direction((column as f64 + 0.5) / WIDTH as f64, (line as f64 + 0.5) / HEIGHT as f64);
                    harmonics(order, d, &mut values);
                    let flux = sky.radiance[line * WIDTH + column].map(|r| r * solid);
                    sums.iter_mut().zip(&values).for_each(|(s, y)| (0..3).for_each(|c| s[c] += flux[c] * y));
                }
            }
            sums
        })
        .collect();
    let mut sums = vec![[0.0; 3]; order * order];
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(s, p)| (0..3).for_each(|c| s[c] += p[c]));
    }
    sums
}

fn reconstruct(coefficients: &[[f32; 3]], order: usize, d: DVec3) -> [f64; 3] {
    let mut values = vec![0.0f32; order * order];
    harmonics(order, d, &mut values);
    let mut sum = [0.0f32; 3];
    coefficients.iter().zip(&values).for_each(|(s, y)| (0..3).for_each(|c| sum[c] += s[c] * y));
    sum.map(f64::from)
}
