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

/// A size from 0 to 1 as colour: black through violet, magenta and orange to light yellow, linear Rec.709. Lightness grows
/// evenly with the size, which is what an eye orders by, in print without colour too: in Oklab (Ottosson 2020) it is
/// `0.97 v`, at chroma `0.16 sin(pi v)` and hues from 280 to 460 degrees, the largest round numbers that stay inside
/// Rec.709 all the way. Beyond 1 it is 1, below 0 and NaN it is 0.
pub fn ramp(value: f32) -> [f32; 3] {
    let v = if value > 0.0 { f64::from(value).min(1.0) } else { 0.0 };
    let (lightness, chroma) = (0.97 * v, 0.16 * (std::f64::consts::PI * v).sin());
    let (sine, cosine) = (280.0 + 180.0 * v).to_radians().sin_cos();
    let (a, b) = (chroma * cosine, chroma * sine);
    let long = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let middle = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let short = (lightness - 0.089_484_177_5 * a - 1.291_485_548_0 * b).powi(3);
    [
        4.076_741_662_1 * long - 3.307_711_591_3 * middle + 0.230_969_929_2 * short,
        -1.268_438_004_6 * long + 2.609_757_401_1 * middle - 0.341_319_396_5 * short,
        -0.004_196_086_3 * long - 0.703_418_614_7 * middle + 1.707_614_701_0 * short,
    ]
    .map(|v| v as f32)
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

    #[test]
    fn the_ramp_stays_in_gamut_and_its_luminance_grows_all_the_way() {
        let mut before = -1.0;
        for i in 0..=1000 {
            let [r, g, b] = ramp(i as f32 / 1000.0);
            // Oklab's matrices have ten digits.
            assert!([r, g, b].iter().all(|v| (-1e-7..=1.0).contains(v)), "{i}: {r} {g} {b}");
            let luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
            assert!(luminance > before, "{i}");
            before = luminance;
        }
        assert!(ramp(0.0).iter().all(|v| *v == 0.0) && before > 0.85);
        assert_eq!((ramp(7.0), ramp(-1.0), ramp(f32::NAN)), (ramp(1.0), ramp(0.0), ramp(0.0)));
    }
}
