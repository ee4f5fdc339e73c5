//! Baked transfer: one medium, under any light from infinity and from any side.

use super::Method;
use super::centres::point_light;
use crate::plan::Survey;
use crate::renderer::{RenderError, check_box, check_medium};

/// See the module's head.
pub struct Transfer;

impl Method for Transfer {
    fn name(&self) -> &'static str {
        "transfer"
    }

    fn good_for(&self) -> &'static str {
        "one medium, baked once; lights from infinity and camera free to change"
    }

    fn refuses(&self, survey: &Survey) -> Option<RenderError> {
        let asked = &survey.medium.parameters;
        let other = survey.transfer.as_ref().and_then(|baked| check_medium(asked, baked).err());
        point_light(survey).or_else(|| check_box(survey.medium.dims).err()).or(other)
    }
}
