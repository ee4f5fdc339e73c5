//! A pinhole camera as the two matrices of OpenEXR's standard attributes.
//!
//! Conventions (OpenEXR, "Standard Attributes"): points are row vectors, `p' = [x y z 1] * M`, stored row by row.
//! `worldToCamera` is left-handed: x right, y up, z along the view. `worldToNDC` maps, after division by w, the upper
//! left corner of the display window to (0, 0) and the lower right one to (1, 1): pixel (i, j)'s centre lies at
//! `((i + 0.5) / width, (j + 0.5) / height)`. NDC depth is free there; we use `1 - 1 / z`, which grows with distance
//! from minus infinity at the camera to 1 at infinity, so that the matrix can be inverted without clip planes.

/// A 4 x 4 matrix for row vectors: `matrix[row][column]`.
pub type RowMatrix = [[f64; 4]; 4];

/// A pinhole camera in world space. `target - position` and `up` are neither zero nor parallel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// The eye.
    pub position: [f64; 3],
    /// A point in the middle of the image.
    pub target: [f64; 3],
    /// Points to the image's upper half.
    pub up: [f64; 3],
    /// Horizontal field of view in degrees, in (0, 180).
    pub fov_degrees: f64,
    /// Pixels in a row.
    pub width: usize,
    /// Rows; pixels are square.
    pub height: usize,
}

impl Pinhole {
    /// Unit vectors right, up, forward.
    fn axes(&self) -> [[f64; 3]; 3] {
        let forward = unit(sub(self.target, self.position));
        let right = unit(cross(forward, unit(self.up)));
        [right, cross(right, forward), forward]
    }

    /// The attribute `worldToCamera`.
    pub fn world_to_camera(&self) -> RowMatrix {
        let axes = self.axes();
        let mut m = [[0.0; 4]; 4];
        for (column, axis) in axes.iter().enumerate() {
            (0..3).for_each(|row| m[row][column] = axis[row]);
            m[3][column] = -dot(*axis, self.position);
        }
        m[3][3] = 1.0;
        m
    }

    /// The attribute `worldToNDC`.
    pub fn world_to_ndc(&self) -> RowMatrix {
        // ndc.x = 1/2 + x / (2 z tan), ndc.y = 1/2 - y / (2 z tan) * width / height, with tan of half the horizontal
        // field of view; w = z.
        let across = 0.5 / (0.5 * self.fov_degrees).to_radians().tan();
        let down = -across * self.width as f64 / self.height as f64;
        let ndc_from_camera =
            [[across, 0.0, 0.0, 0.0], [0.0, down, 0.0, 0.0], [0.5, 0.5, 1.0, 1.0], [0.0, 0.0, -1.0, 0.0]];
        product(&self.world_to_camera(), &ndc_from_camera)
    }
}

fn product(a: &RowMatrix, b: &RowMatrix) -> RowMatrix {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..4).map(|k| a[row][k] * b[k][column]).sum()))
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `a` at length 1. Scaled first, so that the square neither overflows nor vanishes.
pub(crate) fn unit(a: [f64; 3]) -> [f64; 3] {
    let scale = a.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
    let scaled = a.map(|v| v / scale);
    let length = dot(scaled, scaled).sqrt();
    scaled.map(|v| v / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn transform(p: [f64; 3], m: &RowMatrix) -> [f64; 4] {
        std::array::from_fn(|c| p[0] * m[0][c] + p[1] * m[1][c] + p[2] * m[2][c] + m[3][c])
    }

    const CAMERA: Pinhole = Pinhole {
        position: [1.4, -4.6, 1.9],
        target: [1.3, 1.3, 1.6],
        up: [0.0, 0.0, 1.0],
        fov_degrees: 36.0,
        width: 320,
        height: 400,
    };

    #[test]
    fn a_point_on_a_pixels_ray_projects_to_that_pixels_centre() {
        // The ray as a renderer shoots it, from angles and not from a matrix.
        let forward = unit(sub(CAMERA.target, CAMERA.position));
        let right = unit(cross(forward, CAMERA.up));
        let up = cross(right, forward);
        let half = 18.0_f64.to_radians().tan();
        for (i, j) in [(0, 0), (319, 0), (0, 399), (160, 200), (17, 301)] {
            let (x, y) = ((f64::from(i) + 0.5) / 320.0, (f64::from(j) + 0.5) / 400.0);
            let (across, upward) = (half * (2.0 * x - 1.0), half * (400.0 / 320.0) * (1.0 - 2.0 * y));
            for distance in [1e-3, 7.0, 1e6] {
                let p = std::array::from_fn(|a| {
                    CAMERA.position[a] + distance * (forward[a] + across * right[a] + upward * up[a])
                });
                let ndc = transform(p, &CAMERA.world_to_ndc());
                // Rounding of p (|position| < 8, about 1e-15) over the distance, times a few operations.
                let tolerance = 1e-14 / distance.min(1.0) + 1e-13;
                assert!((ndc[0] / ndc[3] - x).abs() < tolerance && (ndc[1] / ndc[3] - y).abs() < tolerance);
                let camera = transform(p, &CAMERA.world_to_camera());
                assert!((camera[2] - distance).abs() < 1e-13 * distance + 1e-14, "z is the distance along the view");
            }
        }
    }

    #[test]
    fn camera_space_has_x_right_y_up_and_z_along_the_view() {
        let camera = Pinhole { position: [0.0; 3], target: [0.0, 1.0, 0.0], ..CAMERA };
        let m = camera.world_to_camera();
        assert_eq!(transform([2.0, 3.0, 4.0], &m), [2.0, 4.0, 3.0, 1.0]);
    }

    #[test]
    fn ndc_depth_grows_with_distance_and_stays_below_one() {
        let camera = Pinhole { position: [0.0; 3], target: [0.0, 1.0, 0.0], ..CAMERA };
        let depth = |y| {
            let p = transform([0.0, y, 0.0], &camera.world_to_ndc());
            p[2] / p[3]
        };
        assert_eq!((depth(1.0), depth(4.0)), (0.0, 0.75));
        assert!(depth(1e6) > depth(1e3) && depth(1e6) < 1.0);
    }

    #[test]
    fn huge_and_tiny_scenes_keep_their_axes() {
        for scale in [1e-200, 1e-6, 1e6, 1e200] {
            let s = |v: [f64; 3]| v.map(|x| x * scale);
            let camera = Pinhole { position: s(CAMERA.position), target: s(CAMERA.target), up: s(CAMERA.up), ..CAMERA };
            for (a, b) in camera.axes().iter().flatten().zip(CAMERA.axes().iter().flatten()) {
                assert!((a - b).abs() < 1e-13);
            }
        }
    }
}
