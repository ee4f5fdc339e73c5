//! Source radiance at the centres as a source for the march: the volume pass on the field's nodes.
//!
//! The closed forms at the centres need Gaussians that are round in the world too, so the map from index to world space
//! must be a uniform scale with a rotation or reflection.

use super::single::CentreRadiance;
use super::volume_pass::{ViewDirections, axes, volume_pass};
use crate::medium::field::DensityField;
use crate::medium::frame::Frame;
use crate::medium::gaussian_points::GaussianPoints;
use crate::shaded_volume::ShadedVolume;
use crate::transport::SourceRadiance;
use glam::{DAffine3, DMat3, DVec3};
use smoke_formats::gaussian::UnitSpace;

/// How unit space lies in the world: a uniform scale, then a rotation or reflection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnitPlacement {
    /// World length of 1 in unit space.
    pub length_world: f64,
    /// Orthogonal.
    pub rotation: DMat3,
    unit_from_world: DAffine3,
}

impl UnitPlacement {
    /// None if the map stretches or shears: if two axes differ by more than 1e-4 in length or are off a right angle.
    pub fn of(frame: &Frame) -> Option<Self> {
        let world_from_unit = frame.world_from_unit();
        let m = world_from_unit.matrix3;
        let length_world = m.determinant().abs().cbrt();
        let rotation = m * (1.0 / length_world);
        let off = rotation.transpose() * rotation - DMat3::IDENTITY;
        let worst = off.to_cols_array().iter().fold(0.0f64, |w, v| w.max(v.abs()));
        (worst < 2e-4).then(|| Self { length_world, rotation, unit_from_world: world_from_unit.inverse() })
    }
}

/// The centres' radiance, with what the volume pass needs to interpolate it.
pub struct CentreSource {
    pub(crate) points: GaussianPoints,
    pub(crate) radiance: CentreRadiance,
    unit: UnitSpace,
    placement: UnitPlacement,
    first_node: [i32; 3],
}

impl CentreSource {
    /// `radiance` at the Gaussians `points` of `frame`.
    pub fn new(points: GaussianPoints, radiance: CentreRadiance, frame: &Frame, placement: UnitPlacement) -> Self {
        Self { points, radiance, unit: frame.unit, placement, first_node: frame.first_node }
    }

    /// Unit coordinates of the nodes of a field of `dims`, axis by axis.
    pub fn axes(&self, dims: [usize; 3]) -> [Vec<f32>; 3] {
        axes(&self.unit, self.first_node, dims)
    }

    /// A point of the world in unit space.
    pub fn unit_from_world(&self, point: DVec3) -> DVec3 {
        self.placement.unit_from_world.transform_point3(point)
    }
}

impl SourceRadiance for CentreSource {
    fn depends_on_view(&self) -> bool {
        !self.radiance.is_even()
    }

    fn as_centres(&self) -> Option<&CentreSource> {
        Some(self)
    }

    fn shade(&self, field: &DensityField, eye: DVec3, volume: &mut ShadedVolume) {
        let eye = self.unit_from_world(eye).as_vec3().to_array();
        let view = ViewDirections::Eye(eye);
        let source = volume_pass(&self.points, &self.radiance, &self.unit, self.first_node, field.dims, view);
        let [nx, ny, _] = field.dims;
        volume.write(field, |j, k, out| {
            let row = &source[nx * (j + ny * k)..][..nx];
            out.iter_mut().zip(row).for_each(|(out, &[r, g, b])| *out = [r, g, b, out[3]]);
        });
    }
}
