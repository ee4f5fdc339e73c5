//! Standard errors of an image, from a file of their own or from layers of the image, and the passes behind them.

use crate::failure::Failure;
use serde_json::Value;
use smoke_formats::Error;
use smoke_formats::image::{self, FloatImage, SETTINGS_ATTRIBUTE};
use smoke_runtime::image_difference::Noise;
use std::path::Path;

/// Layers of an image that hold its standard errors.
const LAYERS: [&str; 3] = ["standard_error.R", "standard_error.G", "standard_error.B"];

/// Standard errors as they were read.
pub struct Measured {
    standard_error: Vec<[f32; 3]>,
    /// Passes behind them, at least 2; none if nobody knows.
    pub passes: Option<u32>,
}

impl Measured {
    /// The noise as the figures take it.
    pub fn noise(&self) -> Noise<'_> {
        Noise { standard_error: &self.standard_error, passes: self.passes }
    }
}

/// The noise of `image`, which was read from `path`; none if nothing tells it. `file` and `passes` win over what the image
/// itself holds.
pub fn of(
    image: &FloatImage,
    path: &Path,
    file: Option<&Path>,
    passes: Option<u32>,
) -> Result<Option<Measured>, Failure> {
    let standard_error = match file {
        Some(file) => {
            let errors = image::read(file)?;
            super::check_same_size(file, &errors, path, image)?;
            errors.rgb(file)?.pixels
        }
        None => match LAYERS.map(|layer| image.channel(layer)) {
            [Some(r), Some(g), Some(b)] => r.iter().zip(g).zip(b).map(|((&r, &g), &b)| [r, g, b]).collect(),
            _ if passes.is_some() => {
                return Err(missing(path, "--passes").into());
            }
            _ => return Ok(None),
        },
    };
    let passes = match passes {
        Some(passes) => Some(passes),
        None => passes_in_settings(path)?,
    };
    Ok(Some(Measured { standard_error, passes }))
}

/// What is wrong with an image that has no standard errors where `what` needs them.
pub fn missing(path: &Path, what: &str) -> Error {
    let expected = format!("channels {}, or a file with them: --standard-error", LAYERS.join(", "));
    Error::invalid(path, what, "no standard errors", expected)
}

/// `passes` of the settings that made an image of ours.
fn passes_in_settings(path: &Path) -> Result<Option<u32>, Error> {
    let Some(text) = image::read_settings(path)? else { return Ok(None) };
    let settings: Value =
        serde_json::from_str(&text).map_err(|e| Error::invalid(path, SETTINGS_ATTRIBUTE, e, "JSON"))?;
    let Some(value) = settings.get("passes") else { return Ok(None) };
    let passes = value.as_u64().and_then(|n| u32::try_from(n).ok()).filter(|n| *n >= 2);
    let invalid =
        || Error::invalid(path, format!("{SETTINGS_ATTRIBUTE}: passes"), value, "a whole number of at least 2");
    passes.map(Some).ok_or_else(invalid)
}
