//! The filters of FLIP, all separable, and their convolution with an image whose borders are repeated outwards.
//!
//! With p pixels per degree of visual angle and x in degrees, the contrast sensitivity of the eye is a sum of Gaussians
//! `a sqrt(pi/b) exp(-pi^2 |x|^2 / b)`, one for luminance and red-green, two for blue-yellow, out to three standard
//! deviations of the widest. Features are found with a Gaussian of standard deviation `w p / 2` pixels, w = 0.082
//! degrees, and its first and second derivatives. Weights add up to 1; those of a derivative above zero to 1, those below
//! zero to -1. Constants: Andersson et al. 2020, colour pipeline and feature pipeline.
//!
//! Cost: `2 r + 1` multiplications a sample and direction, r about `0.135 p`; rows in parallel.

use rayon::prelude::*;
use std::f64::consts::PI;

/// `(a, b)` of the Gaussians: luminance, red-green, and the two of blue-yellow.
const SENSITIVITY: [(f64, f64); 4] = [(1.0, 0.0047), (1.0, 0.0053), (34.1, 0.04), (13.5, 0.025)];

/// Width of a feature in degrees.
const FEATURE_WIDTH: f64 = 0.082;

/// Weights of one direction, an odd number of them.
pub type Kernel = Vec<f32>;

/// The kernels for a viewing distance.
#[derive(Debug)]
pub struct Filters {
    /// Luminance.
    pub luminance: Kernel,
    /// Red-green.
    pub red_green: Kernel,
    /// Blue-yellow: the images that these two give are added up.
    pub blue_yellow: [Kernel; 2],
    /// The Gaussian across a feature.
    pub gaussian: Kernel,
    /// Its first derivative: edges.
    pub first: Kernel,
    /// Its second derivative: points.
    pub second: Kernel,
}

impl Filters {
    /// The kernels at `pixels_per_degree`, at least 1.
    pub fn new(pixels_per_degree: f64) -> Self {
        let widest = SENSITIVITY.iter().map(|s| s.1).fold(0.0, f64::max);
        let radius = (3.0 * (widest / (2.0 * PI * PI)).sqrt() * pixels_per_degree).ceil() as i32;
        // Square root of the height, because both directions have it.
        let gaussian = |(a, b): (f64, f64)| -> Vec<f64> {
            let height = (a * (PI / b).sqrt()).sqrt();
            (-radius..=radius)
                .map(|x| height * (-PI * PI * (f64::from(x) / pixels_per_degree).powi(2) / b).exp())
                .collect()
        };
        let [luminance, red_green, yellow, blue] = SENSITIVITY.map(gaussian);
        let sum = |kernel: &[f64]| kernel.iter().sum::<f64>();
        let both = (sum(&yellow).powi(2) + sum(&blue).powi(2)).sqrt();

        let deviation = 0.5 * FEATURE_WIDTH * pixels_per_degree;
        let radius = (3.0 * deviation).ceil() as i32;
        let feature = |factor: &dyn Fn(f64) -> f64| -> Vec<f64> {
            let weight = |x: f64| factor(x / deviation) * (-0.5 * (x / deviation).powi(2)).exp();
            (-radius..=radius).map(|x| weight(f64::from(x))).collect()
        };
        let smooth = feature(&|_| 1.0);
        Self {
            luminance: scaled(&luminance, sum(&luminance)),
            red_green: scaled(&red_green, sum(&red_green)),
            blue_yellow: [scaled(&yellow, both), scaled(&blue, both)],
            gaussian: scaled(&smooth, sum(&smooth)),
            first: balanced(&feature(&|x| -x)),
            second: balanced(&feature(&|x| x * x - 1.0)),
        }
    }
}

fn scaled(kernel: &[f64], by: f64) -> Kernel {
    kernel.iter().map(|w| (w / by) as f32).collect()
}

/// Weights above zero over their sum, weights below zero over the magnitude of theirs.
fn balanced(kernel: &[f64]) -> Kernel {
    let positive: f64 = kernel.iter().filter(|w| **w > 0.0).sum();
    let negative: f64 = kernel.iter().filter(|w| **w < 0.0).sum();
    kernel.iter().map(|w| (if *w > 0.0 { w / positive } else { w / -negative }) as f32).collect()
}

/// Convolves every row of an image, `width` samples each, with a kernel.
pub fn along_rows(image: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    let radius = kernel.len() / 2;
    let mut out = vec![0.0; image.len()];
    out.par_chunks_mut(width).zip(image.par_chunks(width)).for_each(|(out, row)| {
        let mut padded = vec![row[0]; width + 2 * radius];
        padded[radius..radius + width].copy_from_slice(row);
        padded[radius + width..].fill(row[width - 1]);
        for (k, weight) in kernel.iter().enumerate() {
            add(out, *weight, &padded[k..k + width]);
        }
    });
    out
}

/// Convolves every column of an image with a kernel.
pub fn along_columns(image: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    let (radius, last) = (kernel.len() / 2, image.len() / width - 1);
    let mut out = vec![0.0; image.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (k, weight) in kernel.iter().enumerate() {
            let from = (y + k).saturating_sub(radius).min(last);
            add(out, *weight, &image[width * from..width * (from + 1)]);
        }
    });
    out
}

/// Convolves an image with a kernel in both directions.
pub fn along_both(image: &[f32], width: usize, kernel: &[f32]) -> Vec<f32> {
    along_columns(&along_rows(image, width, kernel), width, kernel)
}

fn add(out: &mut [f32], weight: f32, row: &[f32]) {
    out.iter_mut().zip(row).for_each(|(out, v)| *out += weight * v);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_add_up_and_derivatives_balance() {
        for pixels_per_degree in [1.0, 12.5, 67.0, 1000.0] {
            let f = Filters::new(pixels_per_degree);
            let sum = |kernel: &[f32]| kernel.iter().map(|w| f64::from(*w)).sum::<f64>();
            let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-5, "{pixels_per_degree}: {a} {b}");
            [&f.luminance, &f.red_green, &f.gaussian].iter().for_each(|kernel| close(sum(kernel), 1.0));
            close(sum(&f.blue_yellow[0]).powi(2) + sum(&f.blue_yellow[1]).powi(2), 1.0);
            for kernel in [&f.first, &f.second] {
                close(sum(kernel), 0.0);
                close(kernel.iter().map(|w| f64::from(w.abs())).sum(), 2.0);
            }
            assert!(f.first.iter().zip(f.first.iter().rev()).all(|(a, b)| *a == -*b));
        }
        // 3 sqrt(0.04 / 2 pi^2) 67 = 9.05 and 3 * 0.041 * 67 = 8.24.
        let f = Filters::new(67.0);
        assert_eq!((f.luminance.len(), f.gaussian.len()), (21, 19));
    }

    #[test]
    fn both_directions_are_the_sum_over_the_kernels_square_with_borders_repeated() {
        let (width, height, kernel) = (5, 3, [0.25f32, 0.5, -1.0, 0.125, 2.0]);
        let image: Vec<f32> = (0..15).map(|i| ((i * 7) % 11) as f32).collect();
        let found = along_both(&image, width, &kernel);
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for (j, w) in kernel.iter().enumerate() {
                    for (i, v) in kernel.iter().enumerate() {
                        let (from_x, from_y) = ((x + i).saturating_sub(2).min(4), (y + j).saturating_sub(2).min(2));
                        sum += w * v * image[from_x + width * from_y];
                    }
                }
                // Every product is a multiple of 1/64 below 2^12: exact in f32.
                assert_eq!(found[x + width * y], sum, "{x} {y}");
            }
        }
    }

    #[test]
    fn a_kernel_wider_than_the_image_sees_the_repeated_border() {
        let f = Filters::new(67.0);
        let found = along_both(&[3.0, 3.0], 2, &f.luminance);
        assert!(found.iter().all(|v| (v - 3.0).abs() < 1e-5));
        assert!(along_rows(&[3.0, 3.0], 2, &f.first).iter().all(|v| v.abs() < 1e-5));
    }
}
