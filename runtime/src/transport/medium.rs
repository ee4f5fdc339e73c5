//! What the user sets of the medium, and the same medium as a truncated phase function sees it.
//!
//! Henyey–Greenstein scattering is diagonal in spherical harmonics: band l is multiplied by `albedo * g^l`. Cut off at
//! `order` bands, a strong forward peak rings and turns negative. Above [`PLAIN_LIMIT`] we therefore take part of the
//! peak as not scattered at all (delta-M, Wiscombe 1977):
//! `f = g^order`, `sigma_t' = (1 - albedo f) sigma_t`, `albedo' = (1 - f) albedo / (1 - albedo f)`,
//! `g_l' = (g^l - f) / (1 - f)`. A backward peak has no such twin; its bands are windowed by the Cesàro (C,2) weights
//! `(n-l)(n-l+1) / (n(n+1))`, with which a truncated Legendre series of a positive function stays positive.
//! Both come in smoothly between [`PLAIN_LIMIT`] and 0.7, so that dragging g does not pop.

/// |g| up to which the plain moments g^l are used (Zhou et al. 2008 use g up to about 0.6).
pub const PLAIN_LIMIT: f32 = 0.6;
/// |g| from which the peak is treated in full.
const FULL_LIMIT: f32 = 0.7;

/// The medium as the user edits it. Every value is per colour channel (linear Rec.709), except for `g`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MediumParameters {
    /// Extinction per unit density and world length, >= 0.
    pub sigma_t: [f32; 3],
    /// Scattered part of the extinction, 0 to 1.
    pub albedo: [f32; 3],
    /// Henyey–Greenstein mean cosine, -1 < g < 1, forward positive.
    pub g: f32,
}

/// Why a medium cannot be rendered: the parameter and what was found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("medium: {name} is {found}, expected {expected}")]
pub struct MediumError {
    /// The parameter.
    pub name: &'static str,
    /// Its value.
    pub found: f64,
    /// The legal range.
    pub expected: &'static str,
}

/// A medium whose phase function has `order` bands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BandedMedium {
    /// Extinction per unit density and world length that goes with `moments`: the one to march with.
    pub sigma_t: [f32; 3],
    /// Albedo that goes with it.
    pub albedo: [f32; 3],
    /// Gain of each band relative to band 0; `moments[0] = 1`, zero from `order` on.
    pub moments: [f32; 6],
}

impl MediumParameters {
    /// Checks every range; NaN fails.
    pub fn check(&self) -> Result<(), MediumError> {
        let fail = |name, found: f32, expected| Err(MediumError { name, found: f64::from(found), expected });
        for c in 0..3 {
            if !(self.sigma_t[c] >= 0.0 && self.sigma_t[c].is_finite()) {
                return fail("sigma_t", self.sigma_t[c], ">= 0 and finite");
            }
            if !(self.albedo[c] >= 0.0 && self.albedo[c] <= 1.0) {
                return fail("albedo", self.albedo[c], "0 to 1");
            }
        }
        let proper = self.g.abs() < 1.0;
        if !proper {
            return fail("g", self.g, "-1 < g < 1");
        }
        Ok(())
    }

    /// The medium for single scattering alone, order 1 to 6: nothing counts as not scattered, because every order of the
    /// peak but the first would come with it. Both peaks are windowed instead, as the backward one is in
    /// [`Self::banded`]: bright enough on the whole, but wider than it is.
    pub fn windowed(&self, order: usize) -> BandedMedium {
        let g = f64::from(self.g);
        let ramp = peak_ramp(g);
        let moments = std::array::from_fn(|l| {
            let window = if l < order { 1.0 + ramp * (cesaro(order, l) - 1.0) } else { 0.0 };
            (window * g.powi(l as i32)) as f32
        });
        BandedMedium { sigma_t: self.sigma_t, albedo: self.albedo, moments }
    }

    /// The medium for a phase function of `order` bands (1 to 6).
    pub fn banded(&self, order: usize) -> BandedMedium {
        let g = f64::from(self.g);
        let ramp = peak_ramp(g);
        let peak = if g > 0.0 { ramp * g.powi(order as i32) } else { 0.0 };
        let mut moments = [0.0; 6];
        for (l, moment) in moments.iter_mut().enumerate().take(order) {
            let window = if g < 0.0 { 1.0 + ramp * (cesaro(order, l) - 1.0) } else { 1.0 };
            *moment = (window * (g.powi(l as i32) - peak) / (1.0 - peak)) as f32;
        }
        let kept = self.albedo.map(|a| 1.0 - f64::from(a) * peak);
        BandedMedium {
            sigma_t: std::array::from_fn(|c| (f64::from(self.sigma_t[c]) * kept[c]) as f32),
            albedo: std::array::from_fn(|c| (f64::from(self.albedo[c]) * (1.0 - peak) / kept[c]) as f32),
            moments,
        }
    }
}

/// How far the peak is treated: 0 up to [`PLAIN_LIMIT`], 1 from [`FULL_LIMIT`] on.
fn peak_ramp(g: f64) -> f64 {
    let ramp = ((g.abs() - f64::from(PLAIN_LIMIT)) / f64::from(FULL_LIMIT - PLAIN_LIMIT)).clamp(0.0, 1.0);
    ramp * ramp * (3.0 - 2.0 * ramp)
}

/// Weight of band `l < order` with which the series of a positive function stays positive.
fn cesaro(order: usize, l: usize) -> f64 {
    let (n, k) = (order as f64, l as f64);
    (n - k) * (n - k + 1.0) / (n * (n + 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn medium(g: f32) -> MediumParameters {
        MediumParameters { sigma_t: [2.0, 3.0, 4.0], albedo: [0.0, 0.9, 1.0], g }
    }

    #[test]
    fn moderate_phase_functions_keep_the_plain_moments() {
        for g in [-0.6f32, -0.3, 0.0, 0.42, 0.6] {
            let banded = medium(g).banded(4);
            assert_eq!((banded.sigma_t, banded.albedo), ([2.0, 3.0, 4.0], [0.0, 0.9, 1.0]));
            for l in 0..4 {
                assert!((banded.moments[l] - g.powi(l as i32)).abs() < 1e-7);
            }
            assert_eq!(banded.moments[4..], [0.0, 0.0]);
        }
    }

    #[test]
    fn a_forward_peak_keeps_absorption_and_the_transport_cross_section() {
        // sigma_a and (1 - albedo g) sigma_t are what diffusion sees; delta-M keeps both.
        for g in [0.65, 0.8, 0.99] {
            let (plain, banded) = (medium(g), medium(g).banded(4));
            for c in 0..3 {
                let absorbed = |s: f32, a: f32| f64::from(s) * (1.0 - f64::from(a));
                assert!(
                    (absorbed(plain.sigma_t[c], plain.albedo[c]) - absorbed(banded.sigma_t[c], banded.albedo[c])).abs()
                        < 2e-6
                );
                let transport = |s: f32, a: f32, g: f32| f64::from(s) * (1.0 - f64::from(a) * f64::from(g));
                let expected = transport(plain.sigma_t[c], plain.albedo[c], g);
                let found = transport(banded.sigma_t[c], banded.albedo[c], banded.moments[1]);
                assert!((found - expected).abs() < 2e-6, "g {g}: {found} {expected}");
            }
        }
    }

    #[test]
    fn the_treated_phase_function_is_positive_where_the_plain_one_is_not() {
        let value = |moments: &[f32; 6], mu: f64| -> f64 {
            let (mut before, mut current, mut sum) = (0.0, 1.0, 0.0);
            for (l, &moment) in moments.iter().enumerate() {
                sum += (2 * l + 1) as f64 * f64::from(moment) * current;
                let next = ((2 * l + 1) as f64 * mu * current - l as f64 * before) / (l + 1) as f64;
                (before, current) = (current, next);
            }
            sum
        };
        for order in 1..=6 {
            let lowest =
                |moments: &[f32; 6]| (0..=200).map(|i| value(moments, i as f64 / 100.0 - 1.0)).fold(9.0, f64::min);
            assert!(lowest(&medium(-0.99).banded(order).moments) > -1e-6, "order {order}");
            assert!(lowest(&medium(0.99).windowed(order).moments) > -1e-6, "order {order}");
            if order > 1 {
                let plain: [f32; 6] = std::array::from_fn(|l| if l < order { (-0.99f32).powi(l as i32) } else { 0.0 });
                assert!(lowest(&plain) < -0.5, "the plain series must ring, or the test shows nothing");
            }
        }
    }

    #[test]
    fn single_scattering_keeps_extinction_and_albedo_at_any_g() {
        for g in [-0.99, -0.5, 0.0, 0.5, 0.65, 0.99] {
            for order in 1..=6 {
                let banded = medium(g).windowed(order);
                assert_eq!((banded.sigma_t, banded.albedo), (medium(g).sigma_t, medium(g).albedo));
                assert!(banded.moments[0] == 1.0 && banded.moments[order..].iter().all(|&m| m == 0.0));
                assert!(g.abs() > 0.6 || (1..order).all(|l| banded.moments[l] == f64::from(g).powi(l as i32) as f32));
            }
        }
    }

    #[test]
    fn a_bad_parameter_is_named() {
        let name = |m: MediumParameters| m.check().unwrap_err().name;
        assert_eq!(name(MediumParameters { sigma_t: [1.0, f32::NAN, 1.0], ..medium(0.0) }), "sigma_t");
        assert_eq!(name(MediumParameters { albedo: [1.0, 1.01, 1.0], ..medium(0.0) }), "albedo");
        assert_eq!(name(medium(1.0)), "g");
        assert!(medium(-0.99).check().is_ok());
    }
}
