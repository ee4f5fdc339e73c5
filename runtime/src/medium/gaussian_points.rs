//! The Gaussians of one frame as parallel arrays, checked and normalised, to be evaluated at points.
//!
//! `density(x) = density_scale * sum_h weight_h exp(-|x - c_h|^2 / r_h^2)`. Weights are divided by the largest, so that
//! any density unit serves; the scale goes with the extinction. The arrays are padded with weight zero to whole blocks
//! of lanes. No Gaussian is cut off here: the optical depths of infinite tails have closed forms.

use smoke_formats::gaussian::Gaussian;

/// Lanes of a block of Gaussians.
pub const LANES: usize = 16;
/// Coordinates and radii, and their inverses, beyond this are refused: nothing below can then overflow in f32.
const LARGEST: f32 = 1e6;

/// A Gaussian that cannot be rendered.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("Gaussian {index}: {what} is {found}, expected {expected}")]
pub struct GaussianError {
    /// Which one.
    pub index: usize,
    /// Which field.
    pub what: &'static str,
    /// Its value.
    pub found: f64,
    /// The legal range.
    pub expected: &'static str,
}

/// The Gaussians of a frame, field by field, padded to a multiple of [`LANES`].
#[derive(Clone, Debug, PartialEq)]
pub struct GaussianPoints {
    count: usize,
    /// Centres, unit space: x, then y, then z of all.
    pub center: [Vec<f32>; 3],
    /// Radii, unit space; 1 in the padding.
    pub radius: Vec<f32>,
    /// Weights relative to `density_scale`, 0 to 1; 0 in the padding.
    pub weight: Vec<f32>,
    /// The largest weight, in the source's density unit; 1 if there is no Gaussian.
    pub density_scale: f64,
}

impl GaussianPoints {
    /// Checks and transposes. A weight of zero is legal and adds nothing.
    pub fn new(gaussians: &[Gaussian]) -> Result<Self, GaussianError> {
        let fail =
            |index, what, found: f32, expected| Err(GaussianError { index, what, found: f64::from(found), expected });
        for (index, g) in gaussians.iter().enumerate() {
            for &c in &g.center {
                if !(-LARGEST..=LARGEST).contains(&c) {
                    return fail(index, "center", c, "-1e6 to 1e6");
                }
            }
            if !(g.radius >= 1.0 / LARGEST && g.radius <= LARGEST) {
                return fail(index, "radius", g.radius, "1e-6 to 1e6");
            }
            if !(g.weight >= 0.0 && g.weight.is_finite()) {
                return fail(index, "weight", g.weight, ">= 0 and finite");
            }
        }
        let largest = gaussians.iter().map(|g| g.weight).fold(0.0, f32::max);
        let density_scale = if largest > 0.0 { f64::from(largest) } else { 1.0 };
        let padded = gaussians.len().next_multiple_of(LANES);
        let column = |padding: f32, field: &dyn Fn(&Gaussian) -> f32| -> Vec<f32> {
            gaussians.iter().map(field).chain(std::iter::repeat(padding)).take(padded).collect()
        };
        Ok(Self {
            count: gaussians.len(),
            center: std::array::from_fn(|a| column(0.0, &|g| g.center[a])),
            radius: column(1.0, &|g| g.radius),
            weight: column(0.0, &|g| (f64::from(g.weight) / density_scale) as f32),
            density_scale,
        })
    }

    /// The number of Gaussians, without padding.
    pub fn len(&self) -> usize {
        self.count
    }

    /// True if there is none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Centre of Gaussian `h`.
    #[inline]
    pub fn center_of(&self, h: usize) -> [f32; 3] {
        [self.center[0][h], self.center[1][h], self.center[2][h]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: Gaussian = Gaussian { center: [0.5, 0.25, 2.0], radius: 0.03, weight: 8.0 };

    #[test]
    fn weights_are_relative_to_the_largest_and_padding_weighs_nothing() {
        let points = GaussianPoints::new(&[GOOD, Gaussian { weight: 2.0, ..GOOD }]).unwrap();
        assert_eq!((points.len(), points.radius.len(), points.density_scale), (2, LANES, 8.0));
        assert_eq!(points.weight[..3], [1.0, 0.25, 0.0]);
        assert_eq!(points.center_of(1), GOOD.center);
        assert!(GaussianPoints::new(&[]).unwrap().is_empty());
    }

    #[test]
    fn a_bad_field_is_named_with_its_index() {
        let what = |g: Gaussian| {
            let error = GaussianPoints::new(&[GOOD, g]).unwrap_err();
            assert_eq!(error.index, 1);
            error.what
        };
        assert_eq!(what(Gaussian { center: [0.0, f32::NAN, 0.0], ..GOOD }), "center");
        assert_eq!(what(Gaussian { radius: 0.0, ..GOOD }), "radius");
        assert_eq!(what(Gaussian { weight: f32::INFINITY, ..GOOD }), "weight");
        assert_eq!(what(Gaussian { weight: -1.0, ..GOOD }), "weight");
    }
}
