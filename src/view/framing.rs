//! The first sight of a pack that comes without a scene: a camera that has the smoke in its image, a medium of a depth at
//! which smoke has shape, a sun and a sky.
//!
//! The camera looks from the front, a little from above and from the left. What it must see is the *extent*: the dense
//! voxels of the fullest frame, and the middles of the edges of the box of all frames, whose corners smoke seldom fills.
//! A point that lies at (x, y, z) along right, up and forward from the middle is inside the image from the distance d if
//! `|x| <= m tan_w (d + z)` and `|y| <= m tan_h (d + z)`; the largest such d over all points is taken, m leaves a margin;
//! the middle is that of the points' box. The extinction is the one with which the 95th percentile of the rays through the densest frame has optical
//! depth [`DEPTH`].

use super::orbit::vertical;
use glam::{DAffine3, DVec3};
use smoke_formats::pack::Pack;
use smoke_formats::scene::{Camera, Light, Medium, Scene, Sky, UpAxis};
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::plan::medium_survey::MediumSurvey;
use smoke_runtime::transport::medium::MediumParameters;

/// Horizontal field of view, degrees: a short tele, which leaves verticals upright.
const FOV: f64 = 30.0;
/// Part of half the image that the box may fill.
const FILLED: f64 = 0.94;
/// Optical depth of the rays at the 95th percentile.
const DEPTH: f64 = 20.0;
/// Part of the largest density from which a voxel counts as dense.
const DENSE: f32 = 0.02;
/// Where the camera stands: degrees above the horizon.
const ELEVATION: f64 = 10.0;
/// The same, clockwise from the front, seen from above.
const ASIDE: f64 = 20.0;

/// The frame with most smoke, the first of equals.
pub fn fullest(pack: &Pack) -> usize {
    let frames = pack.frames();
    (0..frames.len()).rev().max_by_key(|&i| frames[i].active_voxels).unwrap_or(0)
}

/// A scene of `width` by `height` pixels for a pack, of which `frame` is the fullest and `extent` what is to be seen.
pub fn first_scene(pack: &Pack, frame: &Frame, extent: &[DVec3], up: UpAxis, [width, height]: [u32; 2]) -> Scene {
    let camera = camera(extent, up, f64::from(width) / f64::from(height.max(1)));
    let view = DVec3::from_array(camera.target) - DVec3::from_array(camera.position);
    let axis = vertical(up);
    let right = view.cross(axis).normalize_or(DVec3::X);
    let level = axis.cross(right);
    // From the left, before and above the smoke: half of it in the light.
    let direction = (right * 0.9 + level * 0.35 - axis * 0.5).to_array();
    let sun = Light::Directional { direction, irradiance: [14.0, 12.5, 10.5] };
    Scene { up, camera, width, height, medium: medium(pack, frame), lights: vec![plain_sky(), sun] }
}

/// The sky that needs no image.
pub fn plain_sky() -> Light {
    let sky = Sky::Color([0.16, 0.24, 0.38]);
    Light::Environment { sky, rotation_degrees: 0.0, intensity: 1.0, visible: true }
}

/// What a camera must see of a pack, of which `frame` is the fullest: points in world space, at least one.
pub fn extent(pack: &Pack, frame: &Frame) -> Vec<DVec3> {
    let frames = pack.frames().iter().filter(|f| f.active_voxels > 0);
    let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for frame in frames {
        let first = DVec3::from_array(frame.origin.map(f64::from));
        low = low.min(first - 0.5);
        high = high.max(first + DVec3::from_array(frame.dims.map(f64::from)) - 0.5);
    }
    if !(low.is_finite() && high.is_finite()) {
        (low, high) = (DVec3::ZERO, DVec3::ONE);
    }
    let middle = 0.5 * (low + high);
    let world_from_index = DAffine3::from_cols_array(&pack.sequence().world_from_index);
    // Edges along x, y and z, four each: one coordinate in the middle, the others at an end.
    let edges = (0..12).map(|edge| {
        let pick = |axis: usize, end: usize| if end == 1 { high[axis] } else { low[axis] };
        let (first, second) = ((edge / 4 + 1) % 3, (edge / 4 + 2) % 3);
        let mut point = middle;
        (point[first], point[second]) = (pick(first, edge & 1), pick(second, edge >> 1 & 1));
        world_from_index.transform_point3(point)
    });
    edges.chain(dense(&frame.field)).collect()
}

/// First and last dense node of each row of a field, world space: no node of a row lies outside these.
fn dense(field: &DensityField) -> impl Iterator<Item = DVec3> + '_ {
    let [nx, ny, _] = field.dims;
    let least = DENSE * field.max();
    field.values.chunks_exact(nx).enumerate().flat_map(move |(row, values)| {
        let is_dense = |d: &f32| *d > least;
        let ends = [values.iter().position(is_dense), values.iter().rposition(is_dense)];
        ends.into_iter().flatten().map(move |i| {
            let node = DVec3::new(i as f64, (row % ny) as f64, (row / ny) as f64);
            field.world_from_node.transform_point3(node)
        })
    })
}

/// A camera that has all `points` in an image `aspect` times as wide as it is high.
pub fn camera(points: &[DVec3], up: UpAxis, aspect: f64) -> Camera {
    let axis = vertical(up);
    let low = points.iter().copied().reduce(DVec3::min).unwrap_or(DVec3::ZERO);
    let high = points.iter().copied().reduce(DVec3::max).unwrap_or(DVec3::ZERO);
    let centre = low + 0.5 * (high - low);
    // The front is where -y is with z up, and z with y up: both have x to the right.
    let front = if up == UpAxis::Z { DVec3::NEG_Y } else { DVec3::Z };
    let (high, aside) = (ELEVATION.to_radians(), ASIDE.to_radians());
    let outward = front * (high.cos() * aside.cos()) - DVec3::X * (high.cos() * aside.sin()) + axis * high.sin();
    let forward = -outward;
    let right = forward.cross(axis).normalize();
    let above = right.cross(forward);
    let tan_width = (0.5 * FOV.to_radians()).tan();
    let tan_height = tan_width / aspect;
    let distance = points.iter().map(|&point| {
        let c = point - centre;
        let across = c.dot(right).abs() / (FILLED * tan_width);
        let down = c.dot(above).abs() / (FILLED * tan_height);
        across.max(down) - c.dot(forward)
    });
    let distance = distance.fold(0.0, f64::max);
    let distance = if distance > 0.0 && distance.is_finite() { distance } else { 1.0 };
    let position = centre + outward * distance;
    Camera { position: position.to_array(), target: centre.to_array(), up: axis.to_array(), fov_degrees: FOV }
}

/// The medium that a pack's transfer was baked for, or one of depth [`DEPTH`].
fn medium(pack: &Pack, frame: &Frame) -> Medium {
    if let Some(transfer) = pack.transfer() {
        let wide = |v: [f32; 3]| v.map(f64::from);
        return Medium { sigma_t: wide(transfer.sigma_t), albedo: wide(transfer.albedo), g: f64::from(transfer.g) };
    }
    let one = MediumParameters { sigma_t: [1.0; 3], albedo: [1.0; 3], g: 0.0 };
    let sigma_t = DEPTH / MediumSurvey::of(frame, &one).column_p95;
    let sigma_t = if sigma_t > 0.0 && sigma_t.is_finite() { rounded(sigma_t) } else { 1.0 };
    Medium { sigma_t: [sigma_t; 3], albedo: [0.99; 3], g: 0.0 }
}

/// To two digits, so that the number can be read and typed.
fn rounded(value: f64) -> f64 {
    let digit = 10f64.powf(value.log10().floor() - 1.0);
    (value / digit).round() * digit
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_pack;
    use smoke_formats::image::projection::Pinhole;
    use std::path::Path;

    fn open(frames: &[i32]) -> Pack {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.smoke");
        small_pack(&path, frames, 0.01);
        Pack::open(&path).unwrap()
    }

    #[test]
    fn every_point_lies_in_the_image_and_one_near_its_edge() {
        let bent = |c: DVec3| DVec3::new(2.0 * c.x + 0.3 * c.y, 3.0 * c.y, 5.0 * c.z + 7.0);
        for (scale, up, aspect) in
            [(1e-6, UpAxis::Z, 1.5), (1.0, UpAxis::Y, 0.4), (1e6, UpAxis::Z, 4.0), (1.0, UpAxis::Y, 1.0)]
        {
            let corners: [DVec3; 8] =
                std::array::from_fn(|c| scale * bent(DVec3::new((c & 1) as f64, (c >> 1 & 1) as f64, (c >> 2) as f64)));
            let Camera { position, target, up, fov_degrees } = camera(&corners, up, aspect);
            let height = 10_000;
            let width = (aspect * height as f64) as usize;
            let ndc = Pinhole { position, target, up, fov_degrees, width, height }.world_to_ndc();
            let mut farthest = 0.0f64;
            for p in corners {
                let at = |column: usize| (0..3).map(|row| p[row] * ndc[row][column]).sum::<f64>() + ndc[3][column];
                assert!(at(3) > 0.0, "before the camera");
                farthest = farthest.max((2.0 * at(0) / at(3) - 1.0).abs()).max((2.0 * at(1) / at(3) - 1.0).abs());
            }
            // The point that set the distance lies where the margin begins; rounding is 1e-16 of 1e6 / 1e-6.
            assert!((farthest - FILLED).abs() < 1e-6, "{farthest}");
        }
    }

    #[test]
    fn the_first_scene_of_a_pack_is_sound_and_reads_back() {
        let pack = open(&[1001, 1002]);
        let frame = Frame::read(&pack, 0).unwrap();
        for up in [UpAxis::Y, UpAxis::Z] {
            let scene = first_scene(&pack, &frame, &extent(&pack, &frame), up, [300, 200]);
            scene.validate(Path::new("first")).unwrap();
            assert_eq!(Scene::parse(Path::new("first"), &scene.to_toml()).unwrap(), scene);
            let one = MediumParameters { sigma_t: scene.medium.sigma_t.map(|v| v as f32), albedo: [1.0; 3], g: 0.0 };
            let depth = MediumSurvey::of(&frame, &one).depth_p95()[0];
            // Two digits are good to 5 %.
            assert!((depth / DEPTH - 1.0).abs() < 0.051, "{depth}");
        }
    }

    #[test]
    fn no_dense_voxel_lies_outside_the_extent() {
        let pack = open(&[1001]);
        let frame = Frame::read(&pack, 0).unwrap();
        let extent = extent(&pack, &frame);
        assert!(extent.len() > 12);
        let ([nx, ny, nz], field) = (frame.field.dims, &frame.field);
        let outermost = |direction: DVec3| extent.iter().map(|p| p.dot(direction)).fold(f64::NEG_INFINITY, f64::max);
        let directions = [DVec3::X, DVec3::NEG_X, DVec3::ONE, DVec3::new(-1.0, 2.0, -3.0), DVec3::new(0.3, -1.0, 0.9)];
        for direction in directions {
            let most = outermost(direction) + 1e-12;
            for node in 0..nx * ny * nz {
                let at = DVec3::new((node % nx) as f64, (node / nx % ny) as f64, (node / nx / ny) as f64);
                let inside = field.world_from_node.transform_point3(at).dot(direction) <= most;
                assert!(inside || field.values[node] <= DENSE * field.max(), "{at}");
            }
        }
    }

    #[test]
    fn a_frame_without_smoke_still_has_a_camera_and_a_medium() {
        let pack = open(&[1]);
        let mut frame = Frame::read(&pack, 0).unwrap();
        frame.field.values.fill(0.0);
        assert_eq!((medium(&pack, &frame).sigma_t, extent(&pack, &frame).len()), ([1.0; 3], 12));
        let flat = camera(&[DVec3::ONE; 8], UpAxis::Z, 1.0);
        assert!(flat.position != flat.target && flat.position.iter().all(|v| v.is_finite()));
    }
}
