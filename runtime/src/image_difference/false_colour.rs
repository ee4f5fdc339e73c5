//! Differences as pictures, in linear Rec.709.

use super::{Incomparable, Pair, check, counts};

/// The signed error as colour, `mean over R, G, B of (a - b)` against `scale`: white is no error, red too bright, blue
/// too dark, full colour at `scale` and beyond. Linear in the sRGB-coded value, so that half the scale looks half as
/// strong; the result is linear Rec.709. Pixels outside the mask are grey, pixels that are not finite magenta.
/// `scale > 0`, in the images' unit.
pub fn signed(pair: &Pair<'_>, scale: f64) -> Result<Vec<[f32; 3]>, Incomparable> {
    match check(pair) {
        Ok(()) | Err(Incomparable::NotFinite(_)) => {}
        Err(e) => return Err(e),
    }
    let pixels = pair.test.iter().zip(pair.reference).enumerate().map(|(i, (a, b))| {
        if !counts(pair, i) {
            return [0.2; 3];
        }
        let error = (0..3).map(|c| f64::from(a[c]) - f64::from(b[c])).sum::<f64>() / 3.0;
        if !error.is_finite() {
            return [1.0, 0.0, 1.0];
        }
        let strength = (error.abs() / scale).min(1.0);
        let faded = srgb_to_linear(1.0 - strength);
        if error >= 0.0 { [1.0, faded, faded] } else { [faded, faded, 1.0] }
    });
    Ok(pixels.collect())
}

/// The inverse of the sRGB curve (IEC 61966-2-1), `v` in [0, 1].
fn srgb_to_linear(v: f64) -> f32 {
    (if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn false_colours_show_sign_strength_mask_and_nan() {
        let r = vec![[1.0; 3]; 6];
        let t = vec![[1.0; 3], [1.5; 3], [0.5; 3], [9.0; 3], [f32::NAN; 3], [3.0; 3]];
        let mask = [true, true, true, true, true, false];
        let colours = signed(&Pair { width: 6, test: &t, reference: &r, mask: Some(&mask) }, 1.0).unwrap();
        let half = srgb_to_linear(0.5);
        assert!((half - 0.21404114).abs() < 1e-7);
        let expected = [[1.0; 3], [1.0, half, half], [half, half, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.2; 3]];
        assert_eq!(colours, expected);
    }
}
