//! Density and lights to source radiance: one folder a method, all behind [`SourceRadiance`].

pub mod compensated;
pub mod medium;
pub mod reference;
pub mod transfer;

use crate::medium::field::DensityField;
use crate::shaded_volume::ShadedVolume;
use compensated::centres::source::CentreSource;
use glam::DVec3;
use transfer::source::TransferSource;

/// Which orders of scattering are computed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ScatteringOrder {
    /// Light that was scattered once.
    Single,
    /// All of it.
    #[default]
    All,
}

/// The radiance that a frame's medium sends out at every point, into every direction: what transport makes and the
/// march reads.
pub trait SourceRadiance: Send + Sync {
    /// True if the shaded volume must be made again when the camera moves.
    fn depends_on_view(&self) -> bool;

    /// Makes now what the processor's volume pass needs of any view; [`Self::shade`] makes it where this was not called.
    fn prepare(&self) {}

    /// The volume pass: source radiance towards `eye` (world space), into the volume of the same field.
    fn shade(&self, field: &DensityField, eye: DVec3, volume: &mut ShadedVolume);

    /// The radiance at the Gaussians' centres, if it is that: its volume pass has a twin on the device.
    fn as_centres(&self) -> Option<&CentreSource> {
        None
    }

    /// The transfer and its light, if it is that: clusters can be lit on the device instead.
    fn as_transfer(&self) -> Option<&TransferSource> {
        None
    }
}
