//! The colour spaces of FLIP and its distance of two colours, 0 to 1.
//!
//! Linear Rec.709 to XYZ over D65 white, which is as well the opponent space YCxCz (linear, for filtering) and CIELAB. A
//! and b of CIELAB are scaled by L / 100 (the Hunt effect: dark colours look less colourful). The distance is that of
//! Abasi et al. 2020, `|dL| + sqrt(da^2 + db^2)`, to the power 0.7; from 0 to 0.4 of the largest, which is that of green
//! and blue, it is stretched to 0 to 0.95, the rest is squeezed into what is left. Constants: Andersson et al. 2020,
//! colour pipeline.

/// Linear Rec.709 to XYZ over the white of D65; every row adds up to 1.
const XYZ_FROM_RGB: [[f32; 3]; 3] = [
    [0.433_895_4, 0.376_242_37, 0.189_862_24],
    [0.212_636_82, 0.715_183, 0.072_180_2],
    [0.017_752_423, 0.109_465_63, 0.872_781_95],
];

/// The inverse of [`XYZ_FROM_RGB`].
const RGB_FROM_XYZ: [[f32; 3]; 3] = [
    [3.080_342, -1.537_399, -0.542_943],
    [-0.921_178_4, 1.875_93, 0.045_248_41],
    [0.052_881_293, -0.204_011_2, 1.151_129_9],
];

/// The distance is taken to this power.
const POWER: f32 = 0.7;

/// Share of the largest distance up to which differences are stretched.
const KNEE: f32 = 0.4;

/// What that share is stretched to.
const KNEE_VALUE: f32 = 0.95;

fn transform(matrix: &[[f32; 3]; 3], v: [f32; 3]) -> [f32; 3] {
    matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// Linear Rec.709 as luminance (-16 to 100), red-green and blue-yellow.
pub fn opponent(rgb: [f32; 3]) -> [f32; 3] {
    let [x, y, z] = transform(&XYZ_FROM_RGB, rgb);
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// What [`opponent`] gave back as linear Rec.709, brought into the range 0 to 1 that a display has.
pub fn displayed([luminance, red_green, blue_yellow]: [f32; 3]) -> [f32; 3] {
    let y = (luminance + 16.0) / 116.0;
    transform(&RGB_FROM_XYZ, [y + red_green / 500.0, y, y - blue_yellow / 200.0]).map(|v| v.clamp(0.0, 1.0))
}

/// CIELAB with the Hunt effect, of linear Rec.709.
pub fn perceived(rgb: [f32; 3]) -> [f32; 3] {
    const DELTA: f32 = 6.0 / 29.0;
    let curve = |v: f32| if v > DELTA.powi(3) { v.cbrt() } else { v / (3.0 * DELTA * DELTA) + 4.0 / 29.0 };
    let [x, y, z] = transform(&XYZ_FROM_RGB, rgb).map(curve);
    let l = 116.0 * y - 16.0;
    [l, 0.01 * l * 500.0 * (x - y), 0.01 * l * 200.0 * (y - z)]
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    ((a[0] - b[0]).abs() + (a[1] - b[1]).hypot(a[2] - b[2])).powf(POWER)
}

/// The distance of two colours of [`perceived`].
#[derive(Clone, Copy, Debug)]
pub struct Metric {
    largest: f32,
}

impl Default for Metric {
    fn default() -> Self {
        Self { largest: distance(perceived([0.0, 1.0, 0.0]), perceived([0.0, 0.0, 1.0])) }
    }
}

impl Metric {
    /// From 0, the same, to 1, green and blue.
    pub fn difference(&self, a: [f32; 3], b: [f32; 3]) -> f32 {
        let (found, knee) = (distance(a, b), KNEE * self.largest);
        if found < knee {
            found * KNEE_VALUE / knee
        } else {
            // Two displayed colours are never farther apart than green and blue, but for rounding.
            (KNEE_VALUE + (found - knee) / (self.largest - knee) * (1.0 - KNEE_VALUE)).min(1.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_matrices_are_inverse_and_white_is_white() {
        for rgb in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.2, 0.7, 0.4], [1.0; 3]] {
            let back = displayed(opponent(rgb));
            // Eight digits of the matrices, times entries of at most 3.1 and 116 units of the opponent space.
            assert!(rgb.iter().zip(back).all(|(a, b)| (a - b).abs() < 2e-6), "{rgb:?} {back:?}");
        }
        let [l, a, b] = perceived([1.0; 3]);
        assert!((l - 100.0).abs() < 1e-4 && a.abs() < 1e-3 && b.abs() < 1e-3, "{l} {a} {b}");
        let [l, _, _] = perceived([0.0; 3]);
        assert!(l.abs() < 1e-5);
    }

    #[test]
    fn the_lightness_and_colours_of_known_stimuli_are_cielabs() {
        // Linear grey 0.184 186 5 has L* = 50 (CIE 15:2004); sRGB red is Lab (53.24, 80.09, 67.20) in every table.
        assert!((perceived([0.184_186_5; 3])[0] - 50.0).abs() < 1e-3);
        let [l, a, b] = perceived([1.0, 0.0, 0.0]);
        assert!((l - 53.24).abs() < 0.01 && (a / (0.01 * l) - 80.09).abs() < 0.02, "{l} {a}");
        assert!((b / (0.01 * l) - 67.20).abs() < 0.02, "{b}");
    }

    #[test]
    fn the_difference_is_0_for_equal_and_1_for_green_and_blue_and_monotone_over_the_knee() {
        let metric = Metric::default();
        let [green, blue] = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(perceived);
        assert_eq!((metric.difference(green, green), metric.difference(green, blue)), (0.0, 1.0));
        let mut before = 0.0;
        for i in 1..=1000 {
            let found = metric.difference([0.0; 3], [i as f32 * 0.2, 0.0, 0.0]);
            assert!(found > before && found <= 1.0 || found == 1.0);
            assert!(found - before < 0.02 || i < 3, "no jump at the knee: {i} {found} {before}");
            before = found;
        }
    }
}
