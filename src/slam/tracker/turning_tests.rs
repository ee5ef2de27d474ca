//! A camera that pans beyond the known depth, in the room of the tests.

use nalgebra::Vector6;

use crate::slam::alignment::reference::Reference;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::{Sim3, Twist7};
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::full_covariance;
use crate::slam::pose::{DegradedReason, LostReason, PoseEstimate, TrackingState};
use crate::slam::test_scene::{CAMERA, Scene};
use crate::slam::tracker::{Tracker, TrackerParams};

const TURNING: TrackingState = TrackingState::Degraded(DegradedReason::Turning);

/// Pose of a camera that pans by 2.5° and moves by so many metres per frame.
fn panned(frame: u64, metres_a_frame: f64) -> SE3 {
    let frames = frame as f64;
    let angle = 2.5f64.to_radians() * frames;
    let mut pose = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, angle, 0.0));
    pose.translation.x = metres_a_frame * frames;
    pose
}

/// Estimates of a pan over so many frames.
fn pan(params: TrackerParams, frames: u64, metres_a_frame: f64) -> Vec<PoseEstimate> {
    let scene = Scene::new(3);
    let mut tracker = Tracker::new(CAMERA, params).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
    let say = |frame: u64| {
        let pixels = scene.render(&CAMERA, &panned(frame, metres_a_frame)).noisy(2.0, 10 + frame);
        let frame = FrameView::new(&CAMERA, frame, frame as i64 * 33_333_333, &pixels);
        tracker.track(&frame, &mut |_| true)
    };
    (0..frames).map(say).collect()
}

#[test]
fn a_pan_away_from_all_depth_is_held_with_a_realistic_covariance() {
    const FRAMES: u64 = 40;
    for metres_a_frame in [0.0, 0.004] {
        let said = pan(TrackerParams::default(), FRAMES, metres_a_frame);
        let held = said.iter().filter(|estimate| estimate.state == TURNING).count();
        assert!(held > 10, "{held} frames were held");
        assert!(said.iter().all(|estimate| estimate.state.is_tracked()));
        let mut worst = 0.0f64;
        for (frame, estimate) in (0..).zip(&said).filter(|(_, of)| of.state == TURNING) {
            let truth = panned(frame, metres_a_frame);
            let error = (estimate.keyframe_from_camera.inverse() * truth).log();
            let covariance = full_covariance(&estimate.covariance);
            let nees = error.dot(&(covariance.try_inverse().unwrap() * error));
            worst = worst.max(nees);
            let rotation = error.fixed_rows::<3>(3).norm();
            assert!(rotation < 0.06, "frame {frame}: {rotation}");
            assert!(!estimate.proposes_keyframe);
        }
        // Of six degrees of freedom 99.9 % are below.
        assert!(worst < 22.5, "{metres_a_frame}: {worst}");
        let deviation = |of: &PoseEstimate| of.covariance[0].sqrt();
        // Without parallax the camera has not moved, and noise adds up; a path has the error of its depth.
        let path = metres_a_frame * FRAMES as f64 / 4.0;
        let least = f64::max(2.0 * deviation(&said[3]), 0.3 * path);
        let last = deviation(said.last().unwrap());
        assert!(last > least, "{metres_a_frame}: {last} of {least}");
    }
}

/// Like [`pan`] at constant pace, with a sideways jerk in one frame, for which there is no time for an iteration.
fn pan_cut_short(frames: u64, cut_short: u64, jerk_rad: f64) -> Vec<(SE3, PoseEstimate)> {
    let scene = Scene::new(3);
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
    let say = |frame: u64| {
        let jerk = if frame >= cut_short { jerk_rad } else { 0.0 };
        let truth = panned(frame, 0.0) * SE3::exp(&Vector6::new(0.0, 0.0, 0.0, jerk, 0.0, 0.0));
        let pixels = scene.render(&CAMERA, &truth).noisy(2.0, 10 + frame);
        let seen = FrameView::new(&CAMERA, frame, frame as i64 * 33_333_333, &pixels);
        (truth, tracker.track(&seen, &mut |_| frame != cut_short))
    };
    (0..frames).map(say).collect()
}

#[test]
fn a_held_frame_that_is_cut_short_does_not_end_the_hold() {
    const CUT_SHORT: u64 = 25;
    // Where the motion is even the predicted pose fits; otherwise only this frame has no pose.
    for (jerk_rad, state) in
        [(0.0, TURNING), (0.06, TrackingState::Lost(LostReason::TooFewInliers))]
    {
        let said = pan_cut_short(40, CUT_SHORT, jerk_rad);
        let at = |frame: u64| said[frame as usize].1;
        assert_eq!(at(CUT_SHORT - 1).state, TURNING);
        match (at(CUT_SHORT).state, state) {
            (TrackingState::Lost(_), TrackingState::Lost(_)) => {}
            (said, expected) => assert_eq!(said, expected, "{jerk_rad}"),
        }
        for (frame, (truth, estimate)) in said.iter().enumerate().skip(CUT_SHORT as usize + 1) {
            assert_eq!(estimate.state, TURNING, "{jerk_rad}: frame {frame}");
            let error = (estimate.keyframe_from_camera.inverse() * *truth).log();
            let rotation = error.fixed_rows::<3>(3).norm();
            assert!(rotation < 0.06, "{jerk_rad}: frame {frame}: {rotation}");
        }
        // Less certain than the adjacent frames.
        let deviation = |frame: u64| at(frame).covariance[20].sqrt();
        assert!(deviation(CUT_SHORT) > 1.5 * deviation(CUT_SHORT + 1), "{jerk_rad}");
    }
}

/// States of a pan by so many degrees per frame; after frame `at` the tracker gets another keyframe.
fn pan_with(degrees: f64, frames: u64, at: u64, other: &Keyframe) -> Vec<TrackingState> {
    let scene = Scene::new(3);
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
    let say = |frame: u64| {
        let angle = (degrees * frame as f64).to_radians();
        let truth = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, angle, 0.0));
        let pixels = scene.render(&CAMERA, &truth).noisy(2.0, 10 + frame);
        let seen = FrameView::new(&CAMERA, frame, frame as i64 * 33_333_333, &pixels);
        let state = tracker.track(&seen, &mut |_| true).state;
        if frame == at {
            tracker.adopt(Box::new(Reference::prepare(other)));
        }
        state
    };
    (0..frames).map(say).collect()
}

#[test]
fn a_keyframe_hidden_without_a_rotation_is_not_held_for_long() {
    // The keyframe shows another room at the same pose.
    let other = Scene::new(9).keyframe(2, SE3::identity(), 2.0);
    let said = pan_with(0.3, 40, 3, &other);
    let held = said.iter().filter(|&&state| state == TURNING).count();
    assert!((10..=15).contains(&held), "{held} frames were held");
    assert!(matches!(said.last(), Some(TrackingState::Lost(_))));
}

#[test]
fn a_repeated_image_before_the_hold_does_not_stop_the_pan() {
    let (scene, other) = (Scene::new(3), Scene::new(9).keyframe(2, SE3::identity(), 2.0));
    let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
    for (frame, image) in (0..).zip([0, 1, 2, 3, 3, 4, 5, 6, 7]) {
        let truth = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.1 * image as f64, 0.0));
        let pixels = scene.render(&CAMERA, &truth).noisy(2.0, 10 + image);
        let seen = FrameView::new(&CAMERA, frame, frame as i64 * 33_333_333, &pixels);
        let estimate = tracker.track(&seen, &mut |_| true);
        let expected = if frame < 5 { TrackingState::Tracking } else { TURNING };
        assert_eq!(estimate.state, expected, "frame {frame}");
        let error = estimate.world_from_camera.rotation.angle_to(&truth.rotation);
        assert!(error < 0.03, "frame {frame}: {error}");
        if frame == 4 {
            // It shows another room at the same pose.
            tracker.adopt(Box::new(Reference::prepare(&other)));
        }
    }
}

#[test]
fn a_find_that_is_rotated_against_the_held_pose_is_refused() {
    const AT: u64 = 24;
    let found = Scene::new(3).keyframe(2, panned(AT, 0.0), 2.0);
    let turned = Sim3::exp(&Twist7::from([0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 0.0]));
    let world_from_keyframe = turned * found.world_from_keyframe;
    let elsewhere = Keyframe { world_from_keyframe, ..found.clone() };
    for (keyframe, is_believed) in [(found, true), (elsewhere, false)] {
        let said = pan_with(2.5, AT + 4, AT, &keyframe);
        assert_eq!(said[AT as usize], TURNING);
        let after = &said[AT as usize + 1..];
        let is_found = after.iter().all(|&state| state == TrackingState::Tracking);
        assert_eq!(is_found, is_believed, "{after:?}");
        assert!(is_believed || after.iter().all(|&state| state == TURNING), "{after:?}");
    }
}

#[test]
fn preparing_ahead_changes_no_bit() {
    let scene = Scene::new(3);
    let run = |is_prepared: bool| {
        let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
        let say = |frame: u64| {
            let pixels = scene.render(&CAMERA, &panned(frame, 0.0)).noisy(2.0, 10 + frame);
            let seen = FrameView::new(&CAMERA, frame, frame as i64 * 33_333_333, &pixels);
            let estimate = tracker.track(&seen, &mut |_| true);
            if is_prepared {
                tracker.prepare_next();
            }
            estimate
        };
        (0..30).map(say).collect::<Vec<_>>()
    };
    let said = run(true);
    assert!(said.last().unwrap().state == TURNING);
    assert_eq!(said, run(false));
}

#[test]
fn nothing_is_held_when_switched_off_or_after_a_lost_frame() {
    let off = TrackerParams { max_turning_deviation: 0.0, ..TrackerParams::default() };
    let said = pan(off, 40, 0.0);
    assert!(said.iter().all(|estimate| estimate.state != TURNING));
    assert!(!said.last().unwrap().state.is_tracked());
    // As long as the translation is certain enough, and no longer.
    let short = TrackerParams { max_turning_deviation: 0.05, ..TrackerParams::default() };
    let said = pan(short, 40, 0.0);
    let last_held = said.iter().rposition(|estimate| estimate.state == TURNING).unwrap();
    assert!(said[last_held + 1..].iter().all(|estimate| !estimate.state.is_tracked()));
    assert!(last_held < 39);
}

#[test]
fn a_stall_of_more_than_a_second_ends_the_hold() {
    let scene = Scene::new(3);
    for (stall_secs, is_held) in [(0.8, true), (1.2, false)] {
        let mut tracker = Tracker::new(CAMERA, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&scene.keyframe(1, SE3::identity(), 2.0))));
        let mut track = |frame: u64, late_secs: f64| {
            let pixels = scene.render(&CAMERA, &panned(frame, 0.0)).noisy(2.0, 10 + frame);
            let nanos = frame as i64 * 33_333_333 + (late_secs * 1e9) as i64;
            tracker.track(&FrameView::new(&CAMERA, frame, nanos, &pixels), &mut |_| true).state
        };
        assert!((0..25).all(|frame| track(frame, 0.0).is_tracked()));
        assert_eq!(track(25, 0.0), TURNING);
        // The camera has not turned on meanwhile: the view would fit.
        let after = track(26, stall_secs);
        assert_eq!(after == TURNING, is_held, "{after:?} after {stall_secs} s");
    }
}
