//! Many frames on one page: a grid of thumbnails with thin lines between them.
//!
//! One exposure serves all frames, so that brightness can be compared from frame to frame: the 99.5th percentile of
//! every pixel's largest channel becomes white. The few pixels above it clip; taking the maximum instead would let one
//! sun glint blacken the sheet. Thumbnails are box-filtered in linear light (each source pixel counts once, with the
//! share of its area), so that their mean is the frame's mean. Cost: one pass over the pixels, one partial sort.

use smoke_formats::image::RgbImage;

/// Width of the lines between thumbnails, in pixels.
const LINE: usize = 2;

/// Linear grey of the lines.
const LINE_COLOUR: [f32; 3] = [0.1; 3];

/// Lays `frames` out in rows of `columns`, each `width` pixels wide and as high as the first frame's shape asks.
/// Exposed to [0, 1], linear Rec.709; [`smoke_formats::image::write_png`] codes it as sRGB. Pixels that are not finite
/// show in magenta. An empty slice gives a single pixel.
pub fn contact_sheet(frames: &[RgbImage], columns: usize, width: usize) -> RgbImage {
    let (columns, width) = (columns.clamp(1, frames.len().max(1)), width.max(1));
    let Some(first) = frames.first() else { return RgbImage { width: 1, height: 1, pixels: vec![LINE_COLOUR] } };
    let height = (width * first.height).div_ceil(first.width).max(1);
    let rows = frames.len().div_ceil(columns);
    let (sheet_width, sheet_height) = (columns * (width + LINE) - LINE, rows * (height + LINE) - LINE);
    let mut pixels = vec![LINE_COLOUR; sheet_width * sheet_height];
    let exposure = exposure(frames);
    for (i, frame) in frames.iter().enumerate() {
        let (left, top) = (i % columns * (width + LINE), i / columns * (height + LINE));
        let small = thumbnail(frame, [width, height], exposure);
        for (y, row) in small.pixels.chunks(width).enumerate() {
            let at = left + sheet_width * (top + y);
            pixels[at..at + width].copy_from_slice(row);
        }
    }
    RgbImage { width: sheet_width, height: sheet_height, pixels }
}

/// The factor that takes the 99.5th percentile of the brightest channel, over pixels that are not black, to 1.
/// Black pixels are left out because most of a frame around a small plume is empty.
pub fn exposure(frames: &[RgbImage]) -> f64 {
    let brightest = |p: &[f32; 3]| p[0].max(p[1]).max(p[2]);
    let pixels = frames.iter().flat_map(|f| &f.pixels).filter(|p| p.iter().all(|v| v.is_finite()));
    let mut values: Vec<f32> = pixels.map(brightest).filter(|v| *v > 0.0).collect();
    if values.is_empty() {
        return 1.0;
    }
    let at = (values.len() - 1) * 995 / 1000;
    let (_, white, _) = values.select_nth_unstable_by(at, f32::total_cmp);
    1.0 / f64::from(*white)
}

/// `frame` box-filtered to `size` (width and height, at least 1), times `exposure`, cut to [0, 1]. Pixels that are not
/// finite are magenta.
pub fn thumbnail(frame: &RgbImage, [width, height]: [usize; 2], exposure: f64) -> RgbImage {
    let (across, down) = (spans(frame.width, width), spans(frame.height, height));
    let pixel = |x: &[(usize, f64)], y: &[(usize, f64)]| {
        let mut sum = [0.0; 3];
        for (j, weight_y) in y {
            for (i, weight_x) in x {
                let source = frame.pixels[i + frame.width * j];
                (0..3).for_each(|c| sum[c] += weight_x * weight_y * f64::from(source[c]));
            }
        }
        match sum.iter().all(|v| v.is_finite()) {
            true => sum.map(|v| (v * exposure).clamp(0.0, 1.0) as f32),
            false => [1.0, 0.0, 1.0],
        }
    };
    let pixels = down.iter().flat_map(|y| across.iter().map(move |x| pixel(x, y))).collect();
    RgbImage { width, height, pixels }
}

/// For each of `to` pixels: the pixels of `from` that it covers, with their shares, which add up to 1.
fn spans(from: usize, to: usize) -> Vec<Vec<(usize, f64)>> {
    let scale = from as f64 / to as f64;
    let span = |k: usize| {
        let (start, end) = (k as f64 * scale, (k + 1) as f64 * scale);
        let covered = start as usize..(end.ceil() as usize).min(from);
        let share = |i: usize| (end.min((i + 1) as f64) - start.max(i as f64)).max(0.0) / scale;
        covered.map(|i| (i, share(i))).collect()
    };
    (0..to).map(span).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(width: usize, height: usize, value: f32) -> RgbImage {
        RgbImage { width, height, pixels: vec![[value; 3]; width * height] }
    }

    #[test]
    fn shares_add_up_to_one_and_cover_every_source_pixel_equally() {
        for (from, to) in [(320, 96), (7, 3), (3, 7), (1, 1), (1, 5), (64, 64)] {
            let spans = spans(from, to);
            let mut counted = vec![0.0; from];
            for span in &spans {
                // At most 300 terms, each with a few roundings of 1e-16.
                assert!((span.iter().map(|s| s.1).sum::<f64>() - 1.0).abs() < 1e-12);
                span.iter().for_each(|(i, share)| counted[*i] += share);
            }
            assert!(counted.iter().all(|c| (c - to as f64 / from as f64).abs() < 1e-12), "{from} {to}");
        }
    }

    #[test]
    fn frames_lie_row_by_row_with_lines_between_them() {
        let frames = [flat(8, 4, 1.0), flat(8, 4, 0.5), flat(8, 4, 0.25)];
        let sheet = contact_sheet(&frames, 2, 4);
        assert_eq!((sheet.width, sheet.height), (4 + 2 + 4, 2 + 2 + 2));
        let at = |x: usize, y: usize| sheet.pixels[x + sheet.width * y];
        assert_eq!((at(0, 0), at(3, 1), at(6, 0)), ([1.0; 3], [1.0; 3], [0.5; 3]));
        assert_eq!((at(0, 4), at(3, 5)), ([0.25; 3], [0.25; 3]));
        assert_eq!((at(4, 0), at(0, 2), at(9, 5)), (LINE_COLOUR, LINE_COLOUR, LINE_COLOUR));
    }

    #[test]
    fn one_glint_among_many_pixels_does_not_darken_the_sheet_and_a_nan_is_seen() {
        let mut frame = flat(100, 100, 2.0);
        frame.pixels[50] = [1e6; 3];
        frame.pixels[9999] = [f32::NAN; 3];
        let sheet = contact_sheet(&[frame], 1, 100);
        assert_eq!((sheet.pixels[5000], sheet.pixels[9999]), ([1.0; 3], [1.0, 0.0, 1.0]));
    }

    #[test]
    fn black_frames_and_no_frames_give_a_sheet() {
        assert!(contact_sheet(&[flat(3, 2, 0.0)], 4, 3).pixels.iter().all(|p| *p == [0.0; 3]));
        assert_eq!(contact_sheet(&[], 4, 3).pixels.len(), 1);
    }
}
