//! The library's odometry is the program's recipe: it gives the bits of a replay.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::{FrameView, Intrinsics, Odometry, OdometryError, OdometryParams};

/// Enough for a map, its first new keyframes and their joint estimates.
const FRAMES: usize = 90;

fn source() -> Simulator {
    let params = SimulatorParams { frames: FRAMES, ..SimulatorParams::half_size() };
    let mut source = Simulator::new(params).unwrap();
    source.prepare(&mut |_, _| true).unwrap();
    source
}

#[test]
fn poses_and_map_are_those_of_a_replay() {
    let record = replay(&mut source(), "sim", &ReplayConfig::default(), &mut |_| true).unwrap();
    let mut source = source();
    let camera = source.intrinsics();
    let mut odometry = Odometry::new(camera, OdometryParams::default()).unwrap();
    let mut pixels = vec![0; camera.width * camera.height];
    let (mut poses, mut frames) = (Vec::new(), Vec::new());
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        let frame = FrameView {
            exposure_nanos: stamp.exposure_nanos,
            ..FrameView::new(&camera, stamp.sequence, stamp.capture_nanos, &pixels)
        };
        poses.push(odometry.push(&frame));
        frames.push(pixels.clone());
    }
    odometry.finish();
    assert_eq!(poses.len(), record.poses.len());
    let tracked = poses.iter().filter(|pose| pose.state.is_tracked()).count();
    assert!(tracked >= FRAMES / 2, "{tracked} tracked");
    for (pose, replayed) in poses.iter().zip(&record.poses) {
        assert_eq!(*pose, replayed.estimate);
    }
    // Estimates have moved the map, and the last one all of it.
    assert!(odometry.map().revision >= 3, "{}", odometry.map().revision);
    assert_eq!(odometry.keyframes().len(), record.map.keyframes.len());
    for (keyframe, replayed) in odometry.keyframes().iter().zip(&record.map.keyframes) {
        assert_eq!(keyframe.map_from_keyframe, replayed.map_from_keyframe);
        assert_eq!(keyframe.points, replayed.points);
        assert!(keyframe.image[..] == frames[keyframe.sequence as usize], "{}", keyframe.sequence);
    }
}

#[test]
fn a_camera_that_is_none_and_a_frame_of_another_size_are_told() {
    let camera = Intrinsics { fx: f64::NAN, ..source().intrinsics() };
    let error = Odometry::new(camera, OdometryParams::default()).unwrap_err();
    assert!(matches!(error, OdometryError::Intrinsics(_)), "{error}");
    let camera = source().intrinsics();
    let mut odometry = Odometry::new(camera, OdometryParams::default()).unwrap();
    let pose = odometry.push(&FrameView::new(&camera, 0, 0, &[0; 10]));
    assert!(!pose.state.is_tracked());
    assert!(odometry.keyframes().is_empty() && odometry.active_keyframe().is_none());
}
