//! The library's odometry is the program's recipe: it gives the same bits as a replay.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::slam::evaluation::evaluate_trajectory;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::trajectory::StampedPose;
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
fn poses_and_map_equal_those_of_a_replay() {
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
fn zero_is_black_unless_it_is_said_to_be_hidden() {
    let greys = [false, true].map(|zero_is_hidden| {
        let mut source = source();
        let camera = source.intrinsics();
        let params = OdometryParams { zero_is_hidden, ..OdometryParams::default() };
        let mut odometry = Odometry::new(camera, params).unwrap();
        let mut pixels = vec![0; camera.width * camera.height];
        while odometry.keyframes().is_empty()
            && let Some(stamp) = source.next_into(&mut pixels).unwrap()
        {
            pixels[..10 * camera.width].fill(0);
            odometry.push(&FrameView::new(&camera, stamp.sequence, stamp.capture_nanos, &pixels));
        }
        let image = &odometry.keyframes()[0].image;
        assert!(image[10 * camera.width..].iter().all(|&grey| grey > 0));
        image[..10 * camera.width].to_vec()
    });
    assert!(greys[0].iter().all(|&grey| grey == 1));
    assert!(greys[1].iter().all(|&grey| grey == 0));
}

#[test]
fn frames_continue_after_the_end() {
    let mut source = source();
    let truth = source.ground_truth().to_vec();
    let camera = source.intrinsics();
    let mut odometry = Odometry::new(camera, OdometryParams::default()).unwrap();
    let mut pixels = vec![0; camera.width * camera.height];
    let (mut estimates, mut at_end) = (Vec::new(), None);
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        let frame = FrameView::new(&camera, stamp.sequence, stamp.capture_nanos, &pixels);
        let pose = odometry.push(&frame);
        if at_end.is_some() {
            assert!(pose.state.is_tracked(), "{}: {:?}", stamp.sequence, pose.state);
        }
        if stamp.sequence as usize == 2 * FRAMES / 3 {
            odometry.finish();
            at_end = Some((odometry.keyframes().len(), odometry.map().revision));
        }
        estimates.push(pose);
    }
    let (num_keyframes, revision) = at_end.unwrap();
    let keyframes = odometry.keyframes();
    assert!(keyframes.len() > num_keyframes, "{} keyframes", keyframes.len());
    assert!(odometry.map().revision > revision, "new keyframes are estimated with the others");
    odometry.finish();
    let keyframes = odometry.keyframes();
    assert!(keyframes.iter().all(|keyframe| keyframe.epoch == 0 && !keyframe.points.is_empty()));
    let tracked = estimates.iter().filter(|pose| pose.state.is_tracked());
    let poses: Vec<StampedPose> = tracked
        .map(|pose| StampedPose {
            nanos: pose.capture_nanos,
            world_from_camera: pose.world_from_camera,
        })
        .collect();
    let found = evaluate_trajectory(&poses, &truth, TrajectoryAlignment::Sim3, 1_000_000).unwrap();
    assert!(found.ate.rmse < 0.01, "{} m of {} m", found.ate.rmse, found.path_length);
}

#[test]
fn an_invalid_camera_and_a_frame_of_another_size_are_reported() {
    let camera = Intrinsics { fx: f64::NAN, ..source().intrinsics() };
    let error = Odometry::new(camera, OdometryParams::default()).unwrap_err();
    assert!(matches!(error, OdometryError::Intrinsics(_)), "{error}");
    let camera = source().intrinsics();
    let mut odometry = Odometry::new(camera, OdometryParams::default()).unwrap();
    let pose = odometry.push(&FrameView::new(&camera, 0, 0, &[0; 10]));
    assert!(!pose.state.is_tracked());
    assert!(odometry.keyframes().is_empty() && odometry.active_keyframe().is_none());
}
