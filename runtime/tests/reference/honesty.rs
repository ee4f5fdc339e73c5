//! Whether the stated errors are the true ones, and the same numbers give the same bytes.

use crate::scenes::{Scene, camera, compare, grey, sky, sun, white};
use glam::Vec3;
use smoke_runtime::light::Light;
use smoke_runtime::transport::medium::MediumParameters;
use smoke_runtime::transport::reference::{Estimate, LEAST_PASSES, ReferenceSettings, trace};

fn scene() -> Scene {
    let medium = MediumParameters { sigma_t: [2.0, 5.0, 9.0], ..grey(0.0, 0.9, 0.5) };
    Scene::ball(medium, vec![Light::Environment(sky()), sun(Vec3::new(1.0, 1.0, 1.0), [2.0; 3])])
}

#[test]
fn threads_and_repetition_change_no_bit_and_another_seed_every_pixel() {
    let scene = scene();
    let first = scene.trace(None, 4, 1);
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert_eq!(pool.install(|| scene.trace(None, 4, 1)), first, "{threads}");
    }
    let other = scene.trace(None, 4, 2);
    let same = first.film.pixels.iter().zip(&other.film.pixels).filter(|(a, b)| a.alpha() > 0.0 && a == b).count();
    assert_eq!(same, 0);
}

/// Upper bound of chi^2 over its `n` degrees of freedom at `z` standard deviations of a normal (Wilson and Hilferty 1931).
fn chi_square_bound(n: f64, z: f64) -> f64 {
    let spread = 2.0 / (9.0 * n);
    (1.0 - spread + z * spread.sqrt()).powi(3)
}

/// Spread of the means over seeds, over the stated errors: that of pixels one by one, and that of whole images.
fn spread(estimates: &[Estimate], error: f64) -> [f64; 2] {
    let n = estimates.len() as f64;
    let pixels = estimates[0].film.pixels.len();
    let (mut ratios, mut counted) = (0.0, 0.0);
    let (mut image_means, mut image_variance) = (vec![0.0; estimates.len()], 0.0);
    for i in 0..pixels {
        let values: Vec<f64> = estimates.iter().map(|e| f64::from(e.film.pixels[i].radiance[1])).collect();
        let stated = |e: &Estimate| (error * f64::from(e.standard_error[i][1])).powi(2);
        let stated = estimates.iter().map(stated).sum::<f64>() / n;
        let mean = values.iter().sum::<f64>() / n;
        let found = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
        if stated > 0.0 {
            ratios += found / stated;
            counted += 1.0;
        }
        image_means.iter_mut().zip(&values).for_each(|(sum, v)| *sum += v);
        image_variance += stated;
    }
    let mean = image_means.iter().sum::<f64>() / n;
    let found = image_means.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    [ratios / counted, found / image_variance]
}

#[test]
fn the_spread_of_fifty_seeds_is_the_stated_standard_error() {
    let seeds = 50;
    let mut scene = scene();
    scene.camera = camera(10);
    let estimates: Vec<Estimate> = (0..seeds).map(|seed| scene.trace(None, 16, seed)).collect();
    let seen = estimates[0].standard_error.iter().filter(|e| e[1] > 0.0).count() as f64;
    let freedom = f64::from(seeds as u32 - 1);
    let passes = |[pixels, image]: [f64; 2]| {
        // Every seen pixel has a chi-square with 49 degrees of freedom, and they are independent; the variances they are
        // held against are known from 50 x 15 numbers. The means of 16 passes of 16 paths each are taken as normal.
        let all = seen * freedom * 750.0 / (750.0 + freedom);
        let inside = |found: f64, n: f64| (chi_square_bound(n, -3.0)..chi_square_bound(n, 3.0)).contains(&found);
        inside(pixels, all) && inside(image, freedom)
    };
    let found = spread(&estimates, 1.0);
    assert!(seen > 60.0 && passes(found), "{seen} pixels: {found:?}");
    // A tenth off is found, and so are halves; the image's own spread sees what pixels have in common.
    for error in [0.5, 0.9, 1.1] {
        assert!(!passes(spread(&estimates, error)), "{error}");
    }
    let mut shared = estimates.clone();
    for (number, estimate) in shared.iter_mut().enumerate() {
        // The noise of one pixel in all of them.
        let first = estimate.film.pixels[45].radiance[1] - estimates[(number + 1) % 50].film.pixels[45].radiance[1];
        estimate.film.pixels.iter_mut().for_each(|p| p.radiance[1] += 0.3 * first);
    }
    assert!(!passes(spread(&shared, 1.0)), "noise that pixels share");
}

#[test]
fn an_albedo_one_per_cent_off_is_found_and_the_right_one_is_not() {
    let lights = vec![white(false), sun(Vec3::new(1.0, -1.0, 0.5), [3.0; 3])];
    let of = |albedo: f32, seed| Scene::ball(grey(6.0, albedo, 0.6), lights.clone()).image(None, 64, seed);
    let reference = of(0.9, 1);
    compare(&of(0.9, 2), &reference).unwrap();
    for albedo in [0.891, 0.909] {
        assert!(compare(&of(albedo, 2), &reference).is_err(), "{albedo}");
    }
}

#[test]
fn an_image_is_finished_at_the_error_asked_and_never_before_the_least_passes() {
    let scene = scene();
    for target_error in [0.5, 0.05, 0.02] {
        let settings = ReferenceSettings { target_error, max_passes: 10_000, ..ReferenceSettings::default() };
        let mut told = vec![];
        let estimate = trace(&scene.field, &scene.medium, &scene.lights, &scene.camera, &settings, &mut |n, error| {
            told.push((n, error));
        })
        .unwrap();
        assert!(estimate.passes >= LEAST_PASSES && estimate.relative_error <= target_error);
        assert_eq!(told.len() as u32, estimate.passes);
        assert_eq!(told.last(), Some(&(estimate.passes, estimate.relative_error)));
        // It would not have been finished one pass earlier.
        let before = told[told.len() - 2];
        assert!(estimate.passes == LEAST_PASSES || before.1 > target_error, "{before:?}");
        // The stated relative error is that of the stated image.
        let sum = |pixels: &mut dyn Iterator<Item = [f32; 3]>| -> f64 {
            pixels.flatten().map(|v| f64::from(v) * f64::from(v)).sum()
        };
        let errors = sum(&mut estimate.standard_error.iter().copied());
        let means = sum(&mut estimate.film.pixels.iter().map(|p| p.radiance));
        assert!(((errors / means).sqrt() / estimate.relative_error - 1.0).abs() < 1e-5);
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    let scene = scene();
    let message = |settings: ReferenceSettings, medium| {
        trace(&scene.field, &medium, &scene.lights, &scene.camera, &settings, &mut |_, _| {}).unwrap_err().to_string()
    };
    let good = ReferenceSettings::default();
    assert!(message(ReferenceSettings { max_passes: 1, ..good }, scene.medium).starts_with("passes: found 1"));
    for target_error in [-0.1, f64::NAN, f64::INFINITY] {
        assert!(message(ReferenceSettings { target_error, ..good }, scene.medium).starts_with("target error"));
    }
    assert!(message(good, grey(f32::NAN, 0.5, 0.0)).starts_with("medium: sigma_t"));
    assert!(message(good, grey(1.0, 1.5, 0.0)).starts_with("medium: albedo"));
    assert!(message(good, grey(1.0, 0.5, 1.0)).starts_with("medium: g"));
}
