//! FLIP: the difference that a viewer sees who flips between an image and its reference, 0 to 1 for every pixel.
//!
//! For images that a display can show (Andersson, Nilsson, Akenine-Moller, Oskarsson, Astrom, Fairchild 2020, *FLIP: A
//! Difference Evaluator for Alternating Images*), with `c` the difference of colours after the eye's blur ([`colour`]) and
//! `f = sqrt(max(|edge_r - edge_t|, |point_r - point_t|) / sqrt 2)` that of edges and points in luminance ([`filters`]):
//!
//! `flip = c^(1 - f)`.
//!
//! For radiance without an upper end (Andersson, Nilsson, Shirley, Akenine-Moller 2021, *Visualizing Errors in Rendered
//! High Dynamic Range Images*): the largest over N exposures `2^e`, each tone mapped with the ACES fit. The exposures run
//! evenly from that which takes the largest luminance of the reference to 0.85 on the display to that which takes the
//! median there; N is their distance in stops, rounded up, and at least 2.
//!
//! Deviations: the median is that of the pixels that are not black. A plume covers less than half of its picture, and the
//! median of all pixels would be 0 and the last exposure infinite; without black pixels it is the paper's. The weighted
//! quartiles are those of the errors themselves and not of a histogram. Samples below 0 are taken as 0.
//!
//! Cost: N times about 700 multiplications, 6 cube roots and 3 powers a pixel at 67 pixels per degree; rows in parallel,
//! the same bytes on any number of threads. Memory: 20 floats a pixel.

pub mod colour;
pub mod filters;

use super::{Incomparable, Pair, check, counts};
use colour::Metric;
use filters::{Filters, along_both, along_columns, along_rows};
use rayon::prelude::*;

/// The tone map: `(k0 x^2 + k1 x) / (k3 x^2 + k4 x + k5)`, Narkowicz's (2015) fit of ACES without its exposure of 0.6.
const ACES: [f64; 5] = [0.36 * 2.51, 0.6 * 0.03, 0.36 * 2.43, 0.6 * 0.59, 0.14];

/// Where on the display the first exposure has the largest luminance and the last one the median.
const DISPLAY_TARGET: f64 = 0.85;

/// FLIP of an image.
#[derive(Clone, Debug)]
pub struct Flip {
    /// 0 to 1 for every pixel, in the order of the images.
    pub errors: Vec<f32>,
    /// Over the pixels that count.
    pub figures: FlipFigures,
}

/// The errors of an image in a few numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlipFigures {
    /// The mean error.
    pub mean: f64,
    /// Errors below which a quarter, a half and three quarters of the sum of all errors lie.
    pub weighted_quartiles: [f64; 3],
    /// The largest error.
    pub largest: f64,
    /// The first and the last exposure in stops.
    pub exposures: [f64; 2],
    /// How many exposures were compared.
    pub exposure_count: usize,
}

/// Compares two images of linear Rec.709, finite everywhere, as seen with `pixels_per_degree` of visual angle, at least 1.
/// 67 is a 70 cm wide screen of 3840 pixels seen from 70 cm. The mask decides which pixels count in the figures; the map
/// holds all.
pub fn flip(pair: &Pair<'_>, pixels_per_degree: f64) -> Result<Flip, Incomparable> {
    check(&Pair { mask: None, ..*pair })?;
    let (filters, metric) = (Filters::new(pixels_per_degree), Metric::default());
    let (exposures, count) = exposures(pair.reference);
    let mut errors = vec![0.0f32; pair.test.len()];
    for i in 0..count {
        let stops = exposures[0] + (exposures[1] - exposures[0]) * i as f64 / (count - 1) as f64;
        let exposure = stops.exp2();
        let [reference, test] = [pair.reference, pair.test].map(|image| {
            let shown: Vec<_> = image.par_iter().map(|p| p.map(|v| tone_mapped(f64::from(v), exposure))).collect();
            Seen::new(&shown, pair.width, &filters)
        });
        let found = errors.par_iter_mut().enumerate();
        found.for_each(|(i, error)| *error = error.max(difference(&reference, &test, i, &metric)));
    }
    let counted: Vec<f32> = errors.iter().enumerate().filter(|(i, _)| counts(pair, *i)).map(|(_, e)| *e).collect();
    if counted.is_empty() {
        return Err(Incomparable::Empty);
    }
    let figures = figures(counted, exposures, count);
    Ok(Flip { errors, figures })
}

/// First and last exposure in stops, and how many.
fn exposures(reference: &[[f32; 3]]) -> ([f64; 2], usize) {
    let luminance = |p: &[f32; 3]| 0.2126 * f64::from(p[0]) + 0.7152 * f64::from(p[1]) + 0.0722 * f64::from(p[2]);
    let mut lit: Vec<f64> = reference.iter().map(luminance).filter(|v| *v > 0.0).collect();
    if lit.is_empty() {
        // Nothing to expose for.
        return ([0.0; 2], 2);
    }
    let at = lit.len() / 2;
    let (_, median, brighter) = lit.select_nth_unstable_by(at, f64::total_cmp);
    let largest = brighter.iter().fold(*median, |a, b| a.max(*b));
    // The tone map is 0.85 at the positive root of a x^2 + b x + c.
    let [k0, k1, k3, k4, k5] = ACES;
    let (a, b, c) = (k0 - DISPLAY_TARGET * k3, k1 - DISPLAY_TARGET * k4, -DISPLAY_TARGET * k5);
    let target = (-b + (b * b - 4.0 * a * c).sqrt()) / (2.0 * a);
    let [first, last] = [largest, *median].map(|v| (target / v).log2());
    ([first, last], ((last - first).ceil() as usize).max(2))
}

/// Radiance times an exposure on a display, 0 to 1.
fn tone_mapped(radiance: f64, exposure: f64) -> f32 {
    let x = radiance.max(0.0) * exposure;
    let [k0, k1, k3, k4, k5] = ACES;
    ((x * (k0 * x + k1)) / (x * (k3 * x + k4) + k5)).min(1.0) as f32
}

/// What a viewer sees of a displayed image.
struct Seen {
    /// CIELAB with the Hunt effect, after the eye's blur.
    colours: Vec<[f32; 3]>,
    /// Magnitude of the luminance's gradient, and of its second derivatives along x and y.
    features: Vec<[f32; 2]>,
}

impl Seen {
    /// `image`: linear Rec.709, 0 to 1.
    fn new(image: &[[f32; 3]], width: usize, filters: &Filters) -> Self {
        let opponent: Vec<_> = image.par_iter().map(|p| colour::opponent(*p)).collect();
        let plane = |c: usize| -> Vec<f32> { opponent.iter().map(|p| p[c]).collect() };
        let (mut luminance, blue_yellow) = (plane(0), plane(2));
        let blurred = [
            along_both(&luminance, width, &filters.luminance),
            along_both(&plane(1), width, &filters.red_green),
            along_both(&blue_yellow, width, &filters.blue_yellow[0]),
            along_both(&blue_yellow, width, &filters.blue_yellow[1]),
        ];
        let [y, cx, yellow, blue] = &blurred;
        let colour = |i: usize| colour::perceived(colour::displayed([y[i], cx[i], yellow[i] + blue[i]]));
        let colours = (0..image.len()).into_par_iter().map(colour).collect();

        luminance.iter_mut().for_each(|v| *v = (*v + 16.0) / 116.0);
        let [smooth, first, second] =
            [&filters.gaussian, &filters.first, &filters.second].map(|kernel| along_rows(&luminance, width, kernel));
        let dx = along_columns(&first, width, &filters.gaussian);
        let dy = along_columns(&smooth, width, &filters.first);
        let dxx = along_columns(&second, width, &filters.gaussian);
        let dyy = along_columns(&smooth, width, &filters.second);
        let feature = |i: usize| [dx[i].hypot(dy[i]), dxx[i].hypot(dyy[i])];
        Self { colours, features: (0..image.len()).into_par_iter().map(feature).collect() }
    }
}

/// FLIP of one pixel.
fn difference(reference: &Seen, test: &Seen, i: usize, metric: &Metric) -> f32 {
    let colour = metric.difference(reference.colours[i], test.colours[i]);
    let ([edge_r, point_r], [edge_t, point_t]) = (reference.features[i], test.features[i]);
    let feature = ((edge_r - edge_t).abs().max((point_r - point_t).abs()) * std::f32::consts::FRAC_1_SQRT_2).sqrt();
    // The weights above zero add up to 1 in each direction, so the feature is at most 1, but for rounding.
    colour.powf((1.0 - feature).max(0.0))
}

fn figures(mut errors: Vec<f32>, exposures: [f64; 2], exposure_count: usize) -> FlipFigures {
    errors.sort_unstable_by(f32::total_cmp);
    let sum: f64 = errors.iter().map(|e| f64::from(*e)).sum();
    let largest = errors.last().map_or(0.0, |e| f64::from(*e));
    let quartile = |share: f64| {
        let mut below = 0.0;
        let reaches = |e: &&f32| {
            below += f64::from(**e);
            below >= share * sum
        };
        errors.iter().find(reaches).map_or(largest, |e| f64::from(*e))
    };
    let weighted_quartiles = [0.25, 0.5, 0.75].map(quartile);
    FlipFigures { mean: sum / errors.len() as f64, weighted_quartiles, largest, exposures, exposure_count }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 24;

    fn pair<'a>(test: &'a [[f32; 3]], reference: &'a [[f32; 3]]) -> Pair<'a> {
        Pair { width: WIDTH, test, reference, mask: None }
    }

    /// A reference of 24 x 16, dark but for its six lowest rows, and a copy with defects: too bright on the left, too blue
    /// on the right, one firefly. Every sample is exact in f32.
    fn images() -> [Vec<[f32; 3]>; 2] {
        let at = |i: usize| (i % WIDTH, i / WIDTH);
        let reference = (0..WIDTH * 16).map(at).map(|(x, y)| {
            let scale = if y < 10 { 0.0625 } else { 1.0 };
            let red = 0.125 + 0.25 * ((3 * x + 5 * y) % 8) as f32;
            [scale * red, scale * (0.25 + x as f32 / 16.0), scale * (0.125 + y as f32 / 8.0)]
        });
        let reference: Vec<_> = reference.collect();
        let test = reference.iter().enumerate().map(|(i, p)| match at(i) {
            (12, 8) => [40.0; 3],
            (x, _) if x < 8 => p.map(|v| v * 1.125),
            (x, _) if x >= 16 => [p[0], p[1], p[2] + 0.5],
            _ => *p,
        });
        [test.collect(), reference]
    }

    /// What flip-evaluator 1.7 (the authors' program, from PyPI) gives for [`images`] in HDR mode: pixels per degree; mean;
    /// its weighted quartiles from the map; pixels of the map.
    type Golden = (f64, f64, [f64; 3], [((usize, usize), f64); 7]);
    const GOLDEN: [Golden; 2] = [
        (
            67.0,
            0.331_571_4,
            [0.230_039_3, 0.635_724_3, 0.900_140_0],
            [
                ((0, 0), 0.170_722),
                ((4, 7), 0.167_167),
                ((7, 8), 0.123_613),
                ((12, 8), 0.564_134),
                ((12, 3), 0.308_904),
                ((20, 12), 0.265_990),
                ((23, 15), 0.136_822),
            ],
        ),
        (
            20.0,
            0.287_722_7,
            [0.195_097_8, 0.845_743_2, 0.953_793_4],
            [
                ((0, 0), 0.185_763),
                ((4, 7), 0.174_099),
                ((7, 8), 0.167_040),
                ((12, 8), 0.979_287),
                ((12, 3), 0.0),
                ((20, 12), 0.125_032),
                ((23, 15), 0.094_945),
            ],
        ),
    ];

    #[test]
    fn the_map_and_its_figures_are_those_of_the_authors_program() {
        let [test, reference] = images();
        for (pixels_per_degree, mean, quartiles, pixels) in GOLDEN {
            let found = flip(&pair(&test, &reference), pixels_per_degree).unwrap();
            // Both work in f32. Where the features are equal, rounding (1e-7) goes through a square root into the
            // exponent: 3e-4 of e ln e, 1.2e-4 at most.
            let close = |a: f64, b: f64, within: f64| assert!((a - b).abs() < within, "{pixels_per_degree}: {a} {b}");
            close(found.figures.mean, mean, 5e-5);
            (0..3).for_each(|i| close(found.figures.weighted_quartiles[i], quartiles[i], 2e-4));
            for ((x, y), error) in pixels {
                close(f64::from(found.errors[x + WIDTH * y]), error, 2e-4);
            }
            assert_eq!(found.figures.exposure_count, 5);
            close(found.figures.exposures[0], 0.313_694_75, 1e-6);
            close(found.figures.exposures[1], 4.729_381_1, 1e-6);
        }
    }

    #[test]
    fn equal_images_have_none_and_units_do_not_matter() {
        let [test, reference] = images();
        let found = flip(&pair(&reference, &reference), 67.0).unwrap();
        assert!(found.errors.iter().all(|e| *e == 0.0));
        assert_eq!((found.figures.mean, found.figures.weighted_quartiles, found.figures.largest), (0.0, [0.0; 3], 0.0));
        let expected = flip(&pair(&test, &reference), 67.0).unwrap().figures;
        for scale in [2f32.powi(-100), 2f32.powi(100)] {
            let by = |image: &[[f32; 3]]| image.iter().map(|p| p.map(|v| v * scale)).collect::<Vec<_>>();
            let found = flip(&pair(&by(&test), &by(&reference)), 67.0).unwrap().figures;
            assert!((found.mean - expected.mean).abs() < 1e-5, "{} {}", found.mean, expected.mean);
        }
    }

    #[test]
    fn a_planted_defect_of_one_per_cent_is_seen_where_it_is() {
        let [_, reference] = images();
        let test: Vec<_> =
            reference.iter().enumerate().map(|(i, p)| if i % WIDTH < 2 { p.map(|v| v * 1.01) } else { *p }).collect();
        let found = flip(&pair(&test, &reference), 67.0).unwrap();
        // The filters reach 10 pixels.
        assert!(found.errors.iter().enumerate().all(|(i, e)| (i % WIDTH < 12) || *e == 0.0));
        assert!(found.errors.chunks(WIDTH).all(|row| row[0] > 0.005 && row[0] > row[6]));
    }

    #[test]
    fn black_around_a_plume_does_not_set_the_exposures_and_a_black_reference_has_some() {
        let [test, reference] = images();
        let framed = |image: &[[f32; 3]]| [image, &vec![[0.0; 3]; 3 * image.len()]].concat();
        let found = flip(&pair(&framed(&test), &framed(&reference)), 67.0).unwrap();
        let alone = flip(&pair(&test, &reference), 67.0).unwrap();
        assert_eq!(found.figures.exposures, alone.figures.exposures);
        let black = vec![[0.0; 3]; reference.len()];
        let found = flip(&pair(&reference, &black), 67.0).unwrap().figures;
        assert!(found.exposures == [0.0; 2] && found.mean > 0.1, "{found:?}");
        let one = flip(&Pair { width: 1, ..pair(&[[1.0; 3]], &[[2.0; 3]]) }, 67.0).unwrap().figures;
        assert!(one.mean > 0.0 && one.mean == one.weighted_quartiles[1]);
    }

    #[test]
    fn extremes_give_errors_from_0_to_1_and_poison_is_refused() {
        let mut reference = [[1e-38, 1.0, f32::MAX], [-5.0, 0.0, 1e-45]].repeat(WIDTH);
        let test = [[f32::MAX, 0.0, 0.0], [f32::MAX, 1e-45, -f32::MAX]].repeat(WIDTH);
        for pixels_per_degree in [1.0, 67.0, 1000.0] {
            let found = flip(&pair(&test, &reference), pixels_per_degree).unwrap();
            assert!(found.errors.iter().all(|e| (0.0..=1.0).contains(e)));
        }
        // Also outside of the mask: the filters would spread it.
        reference[3][1] = f32::NAN;
        let mask: Vec<bool> = (0..2 * WIDTH).map(|i| i != 3).collect();
        let masked = Pair { mask: Some(&mask), ..pair(&test, &reference) };
        assert!(matches!(flip(&masked, 67.0), Err(Incomparable::NotFinite(_))));
        let empty = vec![false; 2 * WIDTH];
        assert_eq!(flip(&Pair { mask: Some(&empty), ..pair(&test, &test) }, 67.0).unwrap_err(), Incomparable::Empty);
    }

    #[test]
    fn the_mask_chooses_the_pixels_of_the_figures_and_not_of_the_map() {
        let [test, reference] = images();
        let all = flip(&pair(&test, &reference), 67.0).unwrap();
        let mask: Vec<bool> = (0..test.len()).map(|i| i == 12 + WIDTH * 8).collect();
        let one = flip(&Pair { mask: Some(&mask), ..pair(&test, &reference) }, 67.0).unwrap();
        assert_eq!(one.errors, all.errors);
        assert_eq!(one.figures.mean, f64::from(all.errors[12 + WIDTH * 8]));
    }

    #[test]
    fn the_same_bytes_on_any_number_of_threads() {
        let [test, reference] = images();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| flip(&pair(&test, &reference), 67.0).unwrap())
        };
        let (one, four) = (run(1), run(4));
        assert_eq!((one.errors, one.figures), (four.errors, four.figures));
    }
}
