//! Pixels without data in the frame and in the keyframe.

use crate::slam::alignment::points::Point;
use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::residual::accumulate_reference;
use crate::slam::alignment::scene::{small_camera, small_plane};
use crate::slam::alignment::tests::{LEVEL, LEVELS, evaluation, move_of, pyramid};
use crate::slam::image::NO_DATA;
use crate::slam::kernel::Kernel;
use crate::slam::pose::Brightness;

#[test]
fn points_on_pixels_without_data_are_out_of_view_in_every_kernel() {
    let (plane, camera) = (small_plane(), small_camera());
    let reference = Reference::prepare(&plane.keyframe(&camera, 1, 0.01));
    let points = reference.level(LEVEL);
    let pose = move_of(9, 0.02);
    let mut frame = plane.render(&camera, &pose, 1.0, (1.0, 0.0), 8);
    let at = evaluation(&pose.inverse(), Brightness::default());
    let whole = accumulate_reference(points, pyramid(&frame).level(LEVEL), &at);
    let hidden = camera.height / 2 * camera.width;
    frame[hidden..].fill(NO_DATA);
    let image = pyramid(&frame);
    let image = image.level(LEVEL);
    let expected = accumulate_reference(points, image, &at);
    let share = f64::from(expected.in_view) / f64::from(whole.in_view);
    assert!((0.3..0.7).contains(&share), "{share}");
    assert_eq!(expected.compared, expected.in_view);
    assert!(f64::from(expected.inliers) > 0.98 * f64::from(expected.compared), "{expected:?}");
    for kernel in Kernel::available() {
        let sums = kernel.accumulate(points, image, &at);
        // A point exactly on the edge may fall to either side by rounding.
        assert!(sums.in_view.abs_diff(expected.in_view) <= 2, "{kernel:?}");
        assert!(sums.inliers.abs_diff(expected.inliers) <= 4, "{kernel:?}");
        assert!((sums.energy / expected.energy - 1.0).abs() < 0.02, "{kernel:?}");
    }
}

#[test]
fn a_keyframe_has_no_points_next_to_pixels_without_data() {
    let (plane, camera) = (small_plane(), small_camera());
    let mut keyframe = plane.keyframe(&camera, 1, 0.01);
    let mut pixels = keyframe.image.to_vec();
    let first_hidden = camera.height / 2;
    pixels[first_hidden * camera.width..].fill(NO_DATA);
    keyframe.image = pixels.into();
    let reference = Reference::prepare(&keyframe);
    for level in 1..LEVELS {
        let at_level = camera.at_level(level);
        let lowest = ((first_hidden >> level) as f64 - 1.0 - at_level.cy) / at_level.fy;
        let points: Vec<Point> = reference.level(level).iter().collect();
        assert!(points.len() > 20, "level {level}");
        assert!(points.iter().all(|point| f64::from(point.ray_y) < lowest - 1e-6), "level {level}");
    }
}
