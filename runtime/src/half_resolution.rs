//! The view pass at half resolution: one ray for every 2 x 2 pixels, and more only where those differ.
//!
//! A coarse film of `ceil(width / 2) x ceil(height / 2)` pixels covers the image. A pixel of the image is bilinear between
//! the four coarse ones around it, where they are alike; where any two of them are apart by more than [`ALIKE`], in
//! transmittance or in radiance over the smoke's root mean square, its own rays are marched, as at full resolution
//! (what is so narrow that every coarse ray misses it stays unseen).
//! Edges so keep their sharpness, and radiance and transmittance are read with the same weights, so that no colour
//! bleeds. Only the medium's part is read between rays: what is behind it is added for every pixel of the image.
//! Cost: a quarter of the rays and those of the pixels that differ (measured: `docs/decisions/032-left-out-terms.md`).

use crate::camera::Camera;
use crate::film::{Film, Pixel};
use crate::march::Lens;
use glam::Vec3A;
use rayon::prelude::*;

/// Largest difference of coarse pixels between which others are read: of transmittance, and of radiance over the smoke's
/// root mean square. Halving it takes a third more rays and a third off the error.
const ALIKE: f32 = 0.1;

/// Columns and rows of the coarse film.
pub(crate) fn coarse_size(camera: &Camera) -> [usize; 2] {
    [camera.width.div_ceil(2), camera.height.div_ceil(2)]
}

/// A film of which the medium alone is `coarse`, of [`coarse_size`]; `march` gives pixels with all that is behind them, by
/// column and row, which are asked for row by row.
pub(crate) fn film<E>(
    lens: &Lens,
    coarse: &Film,
    march: impl FnOnce(&[[usize; 2]]) -> Result<Vec<Pixel>, E>,
) -> Result<Film, E> {
    let (width, height) = (lens.camera.width, lens.camera.height);
    let bright = ALIKE * brightness(coarse);
    let across: Vec<Place> = (0..width).map(|x| Place::of(x, width)).collect();
    let mut film = Film::new(width, height);
    let rows = film.pixels.par_chunks_mut(width.max(1)).enumerate();
    let apart: Vec<[usize; 2]> = rows
        .flat_map_iter(|(y, row)| {
            let down = Place::of(y, height);
            let mut apart = Vec::new();
            for (x, (pixel, across)) in row.iter_mut().zip(&across).enumerate() {
                let near = Near::of(coarse, across, &down);
                if near.is_within(ALIKE, bright) {
                    *pixel = lens.in_front(near.between(across.fraction, down.fraction), x, y);
                } else {
                    apart.push([x, y]);
                }
            }
            apart
        })
        .collect();
    let marched = march(&apart)?;
    apart.iter().zip(marched).for_each(|(&[x, y], pixel)| film.pixels[x + width * y] = pixel);
    Ok(film)
}

/// Root mean square radiance of the pixels with smoke, over all channels; 0 without any.
fn brightness(film: &Film) -> f32 {
    let (mut sum, mut count) = (0.0, 0);
    for pixel in film.pixels.iter().filter(|p| p.alpha() > 0.0) {
        sum += pixel.radiance.iter().map(|&r| f64::from(r) * f64::from(r)).sum::<f64>();
        count += 3;
    }
    if count == 0 { 0.0 } else { (sum / f64::from(count)).sqrt() as f32 }
}

/// Where a pixel lies between coarse ones along one axis.
struct Place {
    coarse: [usize; 2],
    /// 0 at the first of them, 1 at the second.
    fraction: f32,
}

impl Place {
    /// Of pixel `at < count`.
    fn of(at: usize, count: usize) -> Self {
        let last = count.div_ceil(2) - 1;
        let place = ((at as f64 + 0.5) * (last + 1) as f64 / count as f64 - 0.5).clamp(0.0, last as f64);
        let first = place as usize;
        Self { coarse: [first, (first + 1).min(last)], fraction: (place - first as f64) as f32 }
    }
}

/// The four coarse pixels around one of the image, row by row.
struct Near {
    radiance: [Vec3A; 4],
    transmittance: [Vec3A; 4],
    depth: f32,
}

impl Near {
    fn of(coarse: &Film, across: &Place, down: &Place) -> Self {
        let [a, b] = down.coarse.map(|j| j * coarse.width);
        let [i, k] = across.coarse;
        let four = [a + i, a + k, b + i, b + k].map(|at| &coarse.pixels[at]);
        Self {
            radiance: four.map(|p| Vec3A::from_array(p.radiance)),
            transmittance: four.map(|p| Vec3A::from_array(p.transmittance)),
            depth: four.iter().map(|p| p.depth).fold(f32::INFINITY, f32::min),
        }
    }

    /// Whether no two differ by more than this, in transmittance and in radiance.
    fn is_within(&self, transmittance: f32, radiance: f32) -> bool {
        let range = |[a, b, c, d]: [Vec3A; 4]| (a.max(b).max(c.max(d)) - a.min(b).min(c.min(d))).max_element();
        range(self.transmittance) <= transmittance && range(self.radiance) <= radiance
    }

    /// Bilinear; the nearest depth of the four, unless nothing is seen there.
    fn between(&self, across: f32, down: f32) -> Pixel {
        // This form gives equal values back exactly.
        let lerp = |a: Vec3A, b: Vec3A, f: f32| a + (b - a) * f;
        let read = |[a, b, c, d]: [Vec3A; 4]| lerp(lerp(a, b, across), lerp(c, d, across), down).to_array();
        let mut pixel =
            Pixel { radiance: read(self.radiance), transmittance: read(self.transmittance), depth: f32::INFINITY };
        if pixel.alpha() > 0.0 {
            pixel.depth = self.depth;
        }
        pixel
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::march::{Backdrop, Black, MarchMedium, MarchSettings, march};
    use crate::shaded_volume::ShadedVolume;
    use glam::{DAffine3, DVec3};

    /// Source radiance 1 everywhere, and a box of `density` from x = 3 on in a world of 16 voxels a side.
    fn boxed(density: f32) -> ShadedVolume {
        let nodes: Vec<[f32; 4]> = (0..16 * 16 * 16)
            .map(|v| [v % 16, v / 16 % 16, v / 256])
            .map(|[i, j, k]| [(3..15).contains(&i), (1..15).contains(&j), (1..15).contains(&k)])
            .map(|inside| [1.0, 1.0, 1.0, if inside == [true; 3] { density } else { 0.0 }])
            .collect();
        ShadedVolume::of_nodes([16; 3], &nodes, DAffine3::IDENTITY)
    }

    fn camera(width: usize, height: usize, fov: f64) -> Camera {
        let target = DVec3::new(7.5, 7.5, 7.5);
        Camera::look_at(target + DVec3::new(2.0, 1.0, 60.0), target, DVec3::Y, fov, width, height)
    }

    fn both(volume: &ShadedVolume, camera: &Camera, sigma_t: f32, backdrop: &dyn Backdrop) -> [Film; 2] {
        [true, false].map(|half_resolution| {
            let settings = MarchSettings { half_resolution, ..MarchSettings::default() };
            march(volume, camera, &MarchMedium::plain([sigma_t; 3]), backdrop, &settings)
        })
    }

    /// White and black in turn, finer than any pixel.
    struct Stripes;

    impl Backdrop for Stripes {
        fn behind(&self, d: DVec3) -> [f32; 3] {
            [if (d.x * 1e4).floor() as i64 % 2 == 0 { 1.0 } else { 0.0 }; 3]
        }
        fn through_peak(&self, _: DVec3) -> [f32; 3] {
            [0.0; 3]
        }
    }

    #[test]
    fn a_uniform_image_stays_uniform_exactly() {
        // So opaque that a ray sees its first sample alone: radiance 1, transmittance 0, whatever its length.
        for (width, height) in [(32, 24), (31, 23), (2, 2), (3, 1)] {
            let [half, _] = both(&boxed(1.0), &camera(width, height, 4.0), 1e9, &Black);
            assert!(half.pixels.iter().all(|p| (p.radiance, p.transmittance) == ([1.0; 3], [0.0; 3])));
        }
    }

    #[test]
    fn edges_are_those_of_full_resolution_and_no_colour_bleeds_over_them() {
        for sigma in [0.05, 0.5, 1e3] {
            let [half, full] = both(&boxed(1.0), &camera(61, 47, 30.0), sigma, &Black);
            let (mut same, mut empty) = (0, 0);
            for (h, f) in half.pixels.iter().zip(&full.pixels) {
                same += usize::from(h == f && f.alpha() > 0.0);
                empty += usize::from(f.alpha() == 0.0);
                // A source of 1 in front of nothing: radiance and transmittance make 1 in any mixture of pixels.
                (0..3).for_each(|c| assert!((h.radiance[c] + h.transmittance[c] - 1.0).abs() < 1e-5, "{h:?}"));
                // Between pixels that differ by no more than ALIKE, a bilinear value is within that of the truth here,
                // where the image is monotone from the edge inwards.
                assert!((h.transmittance[0] - f.transmittance[0]).abs() <= ALIKE, "sigma_t {sigma}: {h:?} {f:?}");
                assert_eq!(h.alpha() == 0.0, h.depth.is_infinite());
            }
            assert!(empty > 200 && (sigma < 0.1 || same > 50), "sigma_t {sigma}: {empty} empty, {same} marched again");
        }
    }

    #[test]
    fn what_is_behind_keeps_the_full_resolution() {
        let [half, full] = both(&boxed(0.0), &camera(33, 20, 20.0), 1.0, &Stripes);
        assert_eq!(half, full);
        assert!(full.pixels.windows(2).any(|p| p[0] != p[1]), "neighbours must differ, or this shows nothing");
        let [half, full] = both(&boxed(1.0), &camera(33, 20, 6.0), 0.02, &Stripes);
        for (h, f) in half.pixels.iter().zip(&full.pixels) {
            // The box fills the view; its depth changes by a few per cent of 0.24 over it, slowly.
            (0..3).for_each(|c| assert!((h.radiance[c] - f.radiance[c]).abs() < 1e-3, "{h:?} {f:?}"));
        }
    }

    #[test]
    fn images_of_one_pixel_and_of_odd_sides_are_whole() {
        for (width, height) in [(1, 1), (1, 7), (7, 1), (2, 1), (5, 3), (3, 8)] {
            let [half, full] = both(&boxed(1.0), &camera(width, height, 20.0), 0.3, &Stripes);
            assert_eq!((half.width, half.height, half.pixels.len()), (width, height, width * height));
            assert!(half.pixels.iter().all(|p| p.radiance.iter().all(|r| (0.0..=1.1).contains(r))));
            assert!(width * height > 1 || half == full, "the one coarse ray is the one ray");
        }
    }

    #[test]
    fn depth_is_the_nearest_of_the_four_and_infinite_where_nothing_is_seen() {
        let seen = |transmittance: f32, depth| Pixel { transmittance: [transmittance; 3], depth, ..Pixel::EMPTY };
        let mut coarse = Film::new(2, 2);
        let middle = [Place::of(1, 4), Place::of(1, 4)];
        let read = |film: &Film| Near::of(film, &middle[0], &middle[1]).between(0.25, 0.25);
        assert_eq!(read(&coarse), Pixel::EMPTY);
        coarse.pixels[1..3].copy_from_slice(&[seen(0.98, 7.0), seen(0.99, 5.0)]);
        assert_eq!(read(&coarse).depth, 5.0);
    }
}
