//! The compensated method with source radiance at the Gaussians' centres.

use super::Method;
use crate::plan::Survey;
use crate::renderer::RenderError;

/// See the module's head.
pub struct Centres;

impl Method for Centres {
    fn name(&self) -> &'static str {
        "centres"
    }

    fn good_for(&self) -> &'static str {
        "boxes too long for a grid; mean free paths longer than a Gaussian's radius"
    }

    fn refuses(&self, survey: &Survey) -> Option<RenderError> {
        let no_gaussians = survey.medium.gaussians.is_none() && survey.medium.voxels > 0;
        point_light(survey)
            .or_else(|| (!survey.medium.uniform).then_some(RenderError::NotUniform))
            .or_else(|| no_gaussians.then_some(RenderError::NoGaussians))
    }
}

/// The first point light, which the compensated method does not solve for.
pub(super) fn point_light(survey: &Survey) -> Option<RenderError> {
    survey.light.points.first().map(|&index| RenderError::PointLight { index })
}
