//! Which methods can serve a scene, and why the others cannot.
//!
//! A method is one file here and one line in [`METHODS`]; it gives the same reasons as the method itself would when asked
//! to render ([`RenderError`]).

mod centres;
mod grid;
mod reference;
mod transfer;

pub use centres::Centres;
pub use grid::Grid;
pub use reference::Reference;
pub use transfer::Transfer;

use super::Survey;
use crate::renderer::RenderError;

/// A way from density and lights to an image.
pub trait Method: Sync {
    /// Its name, one word or two.
    fn name(&self) -> &'static str;

    /// What it is good at, a few words.
    fn good_for(&self) -> &'static str;

    /// Why it cannot serve, if it cannot.
    fn refuses(&self, survey: &Survey) -> Option<RenderError>;
}

/// All of them.
pub const METHODS: [&dyn Method; 4] = [&Grid, &Centres, &Transfer, &Reference];

/// The method called `name`, if its rungs may be used at all.
pub fn refusal(name: &str, survey: &Survey) -> Option<RenderError> {
    METHODS.iter().find(|method| method.name() == name).and_then(|method| method.refuses(survey))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::survey;
    use crate::transport::medium::MediumParameters;

    fn refused(survey: &Survey) -> [Option<RenderError>; 4] {
        METHODS.map(|method| method.refuses(survey))
    }

    #[test]
    fn a_point_light_leaves_the_reference_alone() {
        let mut point = survey(1.0, 0.9, 0.0);
        point.light.points = vec![2];
        let error = Some(RenderError::PointLight { index: 2 });
        assert_eq!(refused(&point), [error.clone(), error.clone(), error, None]);
    }

    #[test]
    fn centres_need_gaussians_and_voxels_of_one_size_and_the_grid_a_box_that_is_not_too_long() {
        let mut plain = survey(1.0, 0.9, 0.0);
        assert_eq!(refused(&plain), [None, None, None, None]);
        plain.medium.gaussians = None;
        assert_eq!(refused(&plain), [None, Some(RenderError::NoGaussians), None, None]);
        plain.medium.voxels = 0;
        assert_eq!(refused(&plain), [None, None, None, None], "an empty frame needs none");
        plain.medium.uniform = false;
        assert_eq!(refused(&plain)[1], Some(RenderError::NotUniform));
        plain.medium.dims = [1 << 20, 3, 3];
        let too_long = Some(RenderError::TooLong { dims: [1 << 20, 3, 3] });
        assert_eq!([0, 2].map(|method| refused(&plain)[method].clone()), [too_long.clone(), too_long]);
    }

    #[test]
    fn transfer_that_was_baked_serves_its_own_medium_alone_and_before_a_bake_any() {
        let mut scene = survey(1.0, 0.9, 0.5);
        assert_eq!((scene.transfer, refused(&scene)[2].clone()), (None, None));
        let baked = scene.medium.parameters;
        scene.transfer = Some(baked);
        assert_eq!(refused(&scene)[2], None);
        for other in [
            MediumParameters { sigma_t: [1.0, 1.0, 1.1], ..baked },
            MediumParameters { albedo: [0.8; 3], ..baked },
            MediumParameters { g: 0.0, ..baked },
        ] {
            scene.transfer = Some(other);
            assert!(matches!(refused(&scene)[2], Some(RenderError::OtherMedium { .. })), "{other:?}");
        }
    }
}
