//! Known motions between rendered images.

use nalgebra::UnitQuaternion;

use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::test_scene::{CAMERA, Scene};

#[test]
fn a_rotation_and_a_zoom_are_measured_whatever_the_light() {
    let mut estimator = MotionEstimator::new(&CAMERA);
    let mut pyramid = SumPyramid::with_size(CAMERA.width, CAMERA.height, MAX_LEVELS, 1);
    let scene = Scene::new(2);
    let turn = Vector3::new(0.02, -0.05, 0.03);
    let turned = SE3 { rotation: UnitQuaternion::from_scaled_axis(turn), ..SE3::identity() };
    let zoomed = Intrinsics { fx: 1.03 * CAMERA.fx, fy: 1.03 * CAMERA.fy, ..CAMERA };
    pyramid.fill(&scene.render(&CAMERA, &turned).noisy(2.0, 1));
    estimator.take(&pyramid);
    // The scene turns the other way: the directions of the first image, seen in the second.
    let mut pixels = scene.render(&zoomed, &SE3::identity()).noisy(2.0, 2);
    pixels.iter_mut().for_each(|grey| *grey = (f32::from(*grey) * 0.8 + 10.0) as u8);
    pyramid.fill(&pixels);
    estimator.take(&pyramid);
    let [x, y, z, zoom] = estimator.motion(None).unwrap();
    let error = (Vector3::new(x, y, z) - turn).norm();
    assert!(error < 1e-3, "{x} {y} {z}");
    assert!((zoom - 0.03).abs() < 1e-3, "{zoom}");
    let mut usual = pixels.clone();
    // Light that grows fourfold, as when images are brightened, and falls again.
    for factor in [4.0f32, 0.25] {
        pixels.iter_mut().for_each(|grey| *grey = (f32::from(*grey) * factor) as u8);
        if factor > 1.0 {
            pyramid.fill(&pixels.iter().map(|grey| grey / 4).collect::<Vec<_>>());
            estimator.take(&pyramid);
        }
        pyramid.fill(&pixels);
        estimator.take(&pyramid);
        let motion = estimator.motion(None).unwrap();
        assert!(motion.iter().all(|value| value.abs() < 1e-3), "{motion:?}");
    }
    // Neither another scene nor a covered lens has moved.
    pyramid.fill(&usual);
    estimator.take(&pyramid);
    usual.reverse();
    pyramid.fill(&usual);
    estimator.take(&pyramid);
    assert_eq!(estimator.motion(None), None);
    pyramid.fill(&vec![40; usual.len()]);
    estimator.take(&pyramid);
    assert_eq!(estimator.motion(None), None);
}
