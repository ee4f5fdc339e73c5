//! A pinhole camera: pixels to rays. The way back, points to pixels, is [`smoke_formats::image::projection`].

use glam::DVec3;
use smoke_formats::image::projection::Pinhole;

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
        // Scaled first, so that no square overflows or vanishes.
        let unit = |v: DVec3| (v / v.abs().max_element()).normalize();
        let forward = unit(target - position);
        let right = unit(forward.cross(unit(up)));
        let up = right.cross(forward);
        Self { position, right, up, forward, tan_half_width: (0.5 * fov.to_radians()).tan(), width, height }
    }

    /// The camera of a scene file, whose matrices go into the image's metadata.
    pub fn from_pinhole(pinhole: &Pinhole) -> Self {
        let [position, target, up] = [pinhole.position, pinhole.target, pinhole.up].map(DVec3::from_array);
        Self::look_at(position, target, up, pinhole.fov_degrees, pinhole.width, pinhole.height)
    }

    /// Unit direction, world space, through the point (`x`, `y`) of the image, in pixels from the top left corner: the
    /// centre of the first pixel is (0.5, 0.5).
    pub fn direction(&self, x: f64, y: f64) -> DVec3 {
        let pixel = 2.0 * self.tan_half_width / self.width as f64;
        let across = (x - 0.5 * self.width as f64) * pixel;
        let down = (y - 0.5 * self.height as f64) * pixel;
        (self.forward + self.right * across - self.up * down).normalize()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_on_a_pixels_ray_lands_on_that_pixel_by_the_matrices_of_the_image() {
        let pinhole = Pinhole {
            position: [1.4, -4.6, 1.9],
            target: [1.3, 1.3, 1.6],
            up: [0.1, 0.0, 1.0],
            fov_degrees: 36.0,
            width: 320,
            height: 400,
        };
        let camera = Camera::from_pinhole(&pinhole);
        let transform = |p: DVec3, m: [[f64; 4]; 4]| -> [f64; 4] {
            std::array::from_fn(|c| p.x * m[0][c] + p.y * m[1][c] + p.z * m[2][c] + m[3][c])
        };
        for (x, y) in [(0.5, 0.5), (319.5, 399.5), (17.25, 250.0), (160.0, 200.0)] {
            let direction = camera.direction(x, y);
            let point = camera.position + direction * 3.7;
            let ndc = transform(point, pinhole.world_to_ndc());
            assert!((ndc[0] / ndc[3] * 320.0 - x).abs() < 1e-9 && (ndc[1] / ndc[3] * 400.0 - y).abs() < 1e-9);
            let camera_space = transform(point, pinhole.world_to_camera());
            assert!((camera_space[2] - direction.dot(camera.forward) * 3.7).abs() < 1e-9);
        }
    }

    #[test]
    fn the_field_of_view_is_horizontal_and_the_image_is_not_mirrored() {
        let camera = Camera::look_at(DVec3::ZERO, DVec3::Y, DVec3::Z, 90.0, 2, 2);
        let left_top = camera.direction(0.5, 0.5);
        assert!(left_top.x < 0.0 && left_top.z > 0.0, "x is right and z is up when looking along y");
        let edge = Camera::look_at(DVec3::ZERO, DVec3::Y, DVec3::Z, 90.0, 20_000, 2).direction(19_999.5, 0.5);
        assert!((edge.x / edge.y - 1.0).abs() < 1e-3);
    }
}
