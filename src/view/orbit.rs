//! How the mouse moves a scene's camera: round its target, beside it, towards it.
//!
//! The camera stays a scene's own, so that what is seen can be saved as it is. Angles are those of the offset
//! `position - target` about the world's vertical axis; the elevation ends short of the poles, where "up" would flip.

use glam::{DQuat, DVec3};
use smoke_formats::scene::{Camera, UpAxis};

/// Highest elevation, degrees.
const MOST_ELEVATION: f64 = 89.0;
/// Nearest and farthest that a camera gets to its target, as a factor of where it is, in one step.
const STEP: std::ops::RangeInclusive<f64> = 0.1..=10.0;

/// Unit vector of the world's vertical axis.
pub fn vertical(up: UpAxis) -> DVec3 {
    match up {
        UpAxis::Y => DVec3::Y,
        UpAxis::Z => DVec3::Z,
    }
}

/// Turns the camera about its target by degrees: `azimuth` counter-clockwise seen from above, `elevation` upwards. A
/// roll that the scene gave it is undone.
pub fn turn(camera: &mut Camera, up: UpAxis, azimuth: f64, elevation: f64) {
    let axis = vertical(up);
    let target = DVec3::from_array(camera.target);
    let offset = DVec3::from_array(camera.position) - target;
    let distance = offset.length();
    let height = offset.dot(axis);
    let level = offset - axis * height;
    // Straight above or below, the image's own up tells where the camera came from.
    let from = -DVec3::from_array(camera.up) * height.signum();
    let outward = level.try_normalize().or_else(|| from.reject_from(axis).try_normalize()).unwrap_or(DVec3::X);
    let now = (height / distance).clamp(-1.0, 1.0).asin().to_degrees();
    let then = (now + elevation).clamp(-MOST_ELEVATION, MOST_ELEVATION).to_radians();
    let outward = DQuat::from_axis_angle(axis, azimuth.to_radians()) * outward;
    let position = target + (outward * then.cos() + axis * then.sin()) * distance;
    if position.is_finite() {
        (camera.position, camera.up) = (position.to_array(), axis.to_array());
    }
}

/// Moves camera and target beside each other so that the target's picture moves by (`x`, `y`) of the image's width, to
/// the right and down.
pub fn pan(camera: &mut Camera, x: f64, y: f64) {
    let [position, target, up] = [camera.position, camera.target, camera.up].map(DVec3::from_array);
    let view = target - position;
    let right = view.cross(up).normalize_or_zero();
    let above = right.cross(view).normalize_or_zero();
    let width = 2.0 * view.length() * (0.5 * camera.fov_degrees.to_radians()).tan();
    let step = (above * y - right * x) * width;
    let (position, target) = (position + step, target + step);
    if position.is_finite() && target.is_finite() && position != target {
        (camera.position, camera.target) = (position.to_array(), target.to_array());
    }
}

/// Takes the camera to `factor` of its distance from the target.
pub fn approach(camera: &mut Camera, factor: f64) {
    let [position, target] = [camera.position, camera.target].map(DVec3::from_array);
    let factor = factor.clamp(*STEP.start(), *STEP.end());
    let position = target + (position - target) * factor;
    if position.is_finite() && position != target {
        camera.position = position.to_array();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use smoke_formats::image::projection::Pinhole;

    fn camera() -> Camera {
        Camera { position: [3.0, -4.0, 2.0], target: [1.0, 0.5, 0.5], up: [0.1, 0.0, 1.0], fov_degrees: 40.0 }
    }

    fn offset(camera: &Camera) -> DVec3 {
        DVec3::from_array(camera.position) - DVec3::from_array(camera.target)
    }

    #[test]
    fn a_whole_turn_comes_back_and_keeps_the_distance_all_the_way() {
        let before = offset(&camera());
        let mut turned = camera();
        for _ in 0..36 {
            turn(&mut turned, UpAxis::Z, 10.0, 0.0);
            // 36 steps with a few roundings of 1e-16 each, of lengths about 5.
            assert!((offset(&turned).length() - before.length()).abs() < 1e-13);
            assert!((offset(&turned).z - before.z).abs() < 1e-13);
        }
        assert!((offset(&turned) - before).length() < 1e-12);
        assert_eq!((turned.target, turned.up), (camera().target, [0.0, 0.0, 1.0]));
    }

    #[test]
    fn a_quarter_turn_counter_clockwise_from_the_front_looks_from_the_right() {
        for (up, front, right) in [(UpAxis::Z, [0.0, -2.0, 0.0], DVec3::X), (UpAxis::Y, [0.0, 0.0, 2.0], DVec3::X)] {
            let mut camera =
                Camera { position: front, target: [0.0; 3], up: vertical(up).to_array(), fov_degrees: 40.0 };
            turn(&mut camera, up, 90.0, 0.0);
            assert!((offset(&camera) - 2.0 * right).length() < 1e-12, "{up:?} {camera:?}");
        }
    }

    #[test]
    fn the_camera_stops_short_of_the_poles_and_comes_back_from_one() {
        let mut camera = camera();
        turn(&mut camera, UpAxis::Z, 0.0, 500.0);
        let sine = (offset(&camera).z / offset(&camera).length()).asin().to_degrees();
        assert!((sine - MOST_ELEVATION).abs() < 1e-9);
        let mut above = Camera { position: [0.0, 0.0, 5.0], target: [0.0; 3], up: [0.0, 1.0, 0.0], fov_degrees: 40.0 };
        turn(&mut above, UpAxis::Z, 0.0, -50.0);
        assert!(offset(&above).y < -3.0, "what was up in the picture is behind the target: {above:?}");
    }

    #[test]
    fn panning_by_a_tenth_moves_the_targets_picture_by_a_tenth_of_the_width() {
        let mut moved = camera();
        pan(&mut moved, 0.1, -0.05);
        let Camera { position, target, up, fov_degrees } = moved.clone();
        let ndc = Pinhole { position, target, up, fov_degrees, width: 200, height: 100 }.world_to_ndc();
        let p = camera().target;
        let at = |column: usize| (0..3).map(|row| p[row] * ndc[row][column]).sum::<f64>() + ndc[3][column];
        let (x, y) = (at(0) / at(3), at(1) / at(3));
        assert!((x - 0.6).abs() < 1e-12 && (y - 0.4).abs() < 1e-12, "{x} {y}");
        assert!((offset(&moved) - offset(&camera())).length() < 1e-12);
    }

    #[test]
    fn approaching_scales_the_distance_and_never_reaches_the_target() {
        for scale in [1e-6, 1.0, 1e6] {
            let mut near = Camera { position: [scale, 0.0, 0.0], target: [0.0; 3], ..camera() };
            approach(&mut near, 0.5);
            assert!((near.position[0] / scale - 0.5).abs() < 1e-15);
            (0..2000).for_each(|_| approach(&mut near, 0.0));
            assert!(near.position != near.target && near.position[0].is_finite());
        }
        let mut camera = camera();
        for bad in [f64::NAN, f64::INFINITY] {
            turn(&mut camera, UpAxis::Z, bad, bad);
            pan(&mut camera, bad, bad);
            approach(&mut camera, bad);
            assert!(camera.position.iter().chain(&camera.target).all(|v| v.is_finite()), "{bad}");
        }
    }
}
