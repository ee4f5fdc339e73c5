//! A pinhole camera: pixels to rays.

use glam::{DMat4, DVec3, DVec4};

/// A perspective camera in world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// The eye, world units.
    pub position: DVec3,
    /// Unit vectors: to the right of the image, up, and into the scene.
    pub right: DVec3,
    /// Up in the image.
    pub up: DVec3,
    /// Viewing direction.
    pub forward: DVec3,
    /// Tangent of half the horizontal field of view.
    pub tan_half_width: f64,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
}

impl Camera {
    /// A camera at `position` that looks at `target`. `fov` is horizontal, in degrees, within (0, 180); `up` must not
    /// be parallel to the view (the scene reader has checked both).
    pub fn look_at(position: DVec3, target: DVec3, up: DVec3, fov: f64, width: usize, height: usize) -> Self {
        let forward = (target - position).normalize();
        let right = forward.cross(up).normalize();
        let up = right.cross(forward);
        Self { position, right, up, forward, tan_half_width: (0.5 * fov.to_radians()).tan(), width, height }
    }

    /// Unit direction, world space, through the centre of pixel (`x`, `y`); row 0 is the top.
    pub fn direction(&self, x: usize, y: usize) -> DVec3 {
        let pixel = 2.0 * self.tan_half_width / self.width as f64;
        let across = (x as f64 + 0.5 - 0.5 * self.width as f64) * pixel;
        let down = (y as f64 + 0.5 - 0.5 * self.height as f64) * pixel;
        (self.forward + self.right * across - self.up * down).normalize()
    }

    /// World to camera space, column vectors: x right, y up, z into the scene (the left-handed frame of `worldToCamera`
    /// in OpenEXR and RenderMan).
    pub fn camera_from_world(&self) -> DMat4 {
        let row = |axis: DVec3| axis.extend(-axis.dot(self.position));
        DMat4::from_cols(row(self.right), row(self.up), row(self.forward), DVec4::W).transpose()
    }

    /// World to normalised device coordinates, column vectors: x and y in [0, 1] from the top left of the image after
    /// the division by w (the `worldToNDC` of OpenEXR).
    pub fn ndc_from_world(&self) -> DMat4 {
        let half_x = 1.0 / self.tan_half_width;
        let half_y = half_x * self.width as f64 / self.height as f64;
        let ndc_from_camera = DMat4::from_cols(
            DVec4::new(0.5 * half_x, 0.0, 0.0, 0.0),
            DVec4::new(0.0, -0.5 * half_y, 0.0, 0.0),
            DVec4::new(0.5, 0.5, 1.0, 1.0),
            DVec4::ZERO,
        );
        ndc_from_camera * self.camera_from_world()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_on_a_pixels_ray_lands_on_that_pixel_in_ndc() {
        let camera = Camera::look_at(DVec3::new(1.4, -4.6, 1.9), DVec3::new(1.3, 1.3, 1.6), DVec3::Z, 36.0, 320, 400);
        for (x, y) in [(0, 0), (319, 399), (17, 250), (160, 200)] {
            let point = camera.position + camera.direction(x, y) * 3.7;
            let ndc = camera.ndc_from_world() * point.extend(1.0);
            assert!((ndc.x / ndc.w * 320.0 - (x as f64 + 0.5)).abs() < 1e-9);
            assert!((ndc.y / ndc.w * 400.0 - (y as f64 + 0.5)).abs() < 1e-9);
            let depth = camera.camera_from_world() * point.extend(1.0);
            assert!((depth.z - camera.direction(x, y).dot(camera.forward) * 3.7).abs() < 1e-9);
        }
    }

    #[test]
    fn the_field_of_view_is_horizontal_and_the_image_is_not_mirrored() {
        let camera = Camera::look_at(DVec3::ZERO, DVec3::Y, DVec3::Z, 90.0, 2, 2);
        let left_top = camera.direction(0, 0);
        assert!(left_top.x < 0.0 && left_top.z > 0.0, "x is right and z is up when looking along y");
        let edge = Camera::look_at(DVec3::ZERO, DVec3::Y, DVec3::Z, 90.0, 20_000, 2).direction(19_999, 0);
        assert!((edge.x / edge.y - 1.0).abs() < 1e-3);
    }
}
