//! The unbiased path tracer: serves everything, and its noise is its only error.

use super::Method;
use crate::plan::Survey;
use crate::renderer::RenderError;

/// See the module's head.
pub struct Reference;

impl Method for Reference {
    fn name(&self) -> &'static str {
        "reference"
    }

    fn good_for(&self) -> &'static str {
        "every light and medium, to any error, at the price of time"
    }

    fn refuses(&self, _: &Survey) -> Option<RenderError> {
        None
    }
}
