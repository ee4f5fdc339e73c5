//! The compensated method with source radiance on a grid.

use super::Method;
use crate::plan::Survey;
use crate::renderer::{RenderError, check_box};

/// See the module's head.
pub struct Grid;

impl Method for Grid {
    fn name(&self) -> &'static str {
        "grid"
    }

    fn good_for(&self) -> &'static str {
        "light from infinity, thin to thick; lights and medium free to change"
    }

    fn refuses(&self, survey: &Survey) -> Option<RenderError> {
        super::centres::point_light(survey).or_else(|| check_box(survey.medium.dims).err())
    }
}
