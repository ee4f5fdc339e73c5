//! Which methods can serve a scene, and why the others cannot.
//!
//! A method is one file here and one line in [`METHODS`]; it gives the same reasons as the method itself would when asked
//! to render ([`RenderError`]).

mod centres;
mod grid;
mod reference;

pub use centres::Centres;
pub use grid::Grid;
pub use reference::Reference;

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
pub const METHODS: [&dyn Method; 3] = [&Grid, &Centres, &Reference];

/// The method called `name`, if its rungs may be used at all.
pub fn refusal(name: &str, survey: &Survey) -> Option<RenderError> {
    METHODS.iter().find(|method| method.name() == name).and_then(|method| method.refuses(survey))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::survey;

    fn refused(survey: &Survey) -> [Option<RenderError>; 3] {
        METHODS.map(|method| method.refuses(survey))
    }

    #[test]
    fn a_point_light_leaves_the_reference_alone() {
        let mut point = survey(1.0, 0.9, 0.0);
        point.light.points = vec![2];
        let error = Some(RenderError::PointLight { index: 2 });
        assert_eq!(refused(&point), [error.clone(), error, None]);
    }

    #[test]
    fn centres_need_gaussians_and_voxels_of_one_size_and_the_grid_a_box_that_is_not_too_long() {
        let mut plain = survey(1.0, 0.9, 0.0);
        assert_eq!(refused(&plain), [None, None, None]);
        plain.medium.gaussians = None;
        assert_eq!(refused(&plain), [None, Some(RenderError::NoGaussians), None]);
        plain.medium.voxels = 0;
        assert_eq!(refused(&plain), [None, None, None], "an empty frame needs none");
        plain.medium.uniform = false;
        assert_eq!(refused(&plain)[1], Some(RenderError::NotUniform));
        plain.medium.dims = [1 << 20, 3, 3];
        assert_eq!(refused(&plain)[0], Some(RenderError::TooLong { dims: [1 << 20, 3, 3] }));
    }
}
