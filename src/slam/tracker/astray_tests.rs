//! A camera that was lost for long, and is found again by the tracker alone or with the mapper.

use nalgebra::Vector6;

use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::scene::{Noise, small_camera, small_plane};
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::{LostReason, PoseEstimate, TrackingState};
use crate::slam::tracker::{Tracker, TrackerParams};

/// Time between two frames of a usual and of a slow camera, nanoseconds.
const USUAL: i64 = 33_333_333;
const SLOW: i64 = 333_333_333;

/// The view of `keyframe`, of which two ninths now show something else.
fn changed_view(keyframe: &Keyframe) -> Vec<u8> {
    let mut noise = Noise(5);
    let mut image = keyframe.image.to_vec();
    let changed = keyframe.intrinsics.width * (keyframe.intrinsics.height * 7 / 9);
    image[changed..].fill_with(|| (128.0 + 100.0 * noise.uniform()) as u8);
    image
}

/// A camera is tracked up to `away` (0: at its keyframe, 12: a quarter of the mean depth away) and returns to the
/// keyframe after `lost` frames, where it sees its changed view; the mapper switches to another keyframe before that or
/// not.
fn returned(interval_nanos: i64, away: u64, lost: u64, is_sought: bool) -> PoseEstimate {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = Keyframe { keyframe_id: 7, ..plane.keyframe(&camera, 2, 0.02) };
    let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&keyframe)));
    let mut sequence = 0;
    let mut track = |tracker: &mut Tracker, pixels: &[u8]| {
        let nanos = sequence as i64 * interval_nanos;
        sequence += 1;
        tracker.track(&FrameView::new(&camera, sequence, nanos, pixels), &mut |_| true)
    };
    for step in (0..=away).step_by(2) {
        let part = 0.02 * step as f64;
        let at = SE3::exp(&Vector6::new(part, 0.0, 0.0, 0.0, 0.0, 0.0));
        let state = track(&mut tracker, &plane.render(&camera, &at, 2.0, (1.0, 0.0), step)).state;
        assert_eq!(state, TrackingState::Tracking);
    }
    let black = vec![0; keyframe.image.len()];
    for _ in 0..lost {
        let state = track(&mut tracker, &black).state;
        assert!(matches!(state, TrackingState::Lost(_)), "{state:?}");
    }
    if is_sought {
        let found = Keyframe { keyframe_id: 3, ..keyframe.clone() };
        tracker.adopt(Box::new(Reference::prepare(&found)));
    }
    track(&mut tracker, &changed_view(&keyframe))
}

#[test]
fn away_from_where_it_was_a_camera_lost_for_long_must_be_surer_without_the_mapper() {
    let soon = returned(USUAL, 12, 3, false);
    let inliers = soon.quality.inlier_ratio;
    assert!((0.81..0.86).contains(&inliers), "{inliers}: the test needs an image in between");
    assert!(soon.state.is_tracked(), "{:?}", soon.state);
    for interval in [USUAL, SLOW] {
        let late = returned(interval, 12, 20, false);
        assert_eq!(late.state, TrackingState::Lost(LostReason::TooFewInliers));
    }
    for (away, is_sought) in [(12, true), (0, false)] {
        let found = returned(USUAL, away, 20, is_sought);
        assert!(found.state.is_tracked(), "{away}, {is_sought}: {:?}", found.state);
    }
}

#[test]
fn a_few_frames_of_a_slow_camera_are_not_long() {
    let soon = returned(SLOW, 12, 3, false);
    assert!(soon.state.is_tracked(), "{:?}", soon.state);
}

/// A camera is lost for 20 frames on a keyframe of `keyframe_id`, the first one at all or that of a later epoch, before it
/// has a pose on it and sees its changed view.
fn first_pose(keyframe_id: u64, is_later_epoch: bool) -> TrackingState {
    let (plane, camera) = (small_plane(), small_camera());
    let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
    let mut sequence = 0;
    let mut track = |tracker: &mut Tracker, pixels: &[u8]| {
        let nanos = sequence as i64 * USUAL;
        sequence += 1;
        tracker.track(&FrameView::new(&camera, sequence, nanos, pixels), &mut |_| true).state
    };
    let initial = Keyframe { keyframe_id: 0, sequence: 1, ..plane.keyframe(&camera, 2, 0.02) };
    if is_later_epoch {
        tracker.adopt(Box::new(Reference::prepare(&initial)));
    }
    let black = vec![0; initial.image.len()];
    for _ in 0..20 {
        assert!(!track(&mut tracker, &black).is_tracked());
    }
    let epoch = initial.epoch + u32::from(is_later_epoch);
    let keyframe = Keyframe { keyframe_id, epoch, ..initial };
    tracker.adopt(Box::new(Reference::prepare(&keyframe)));
    if !is_later_epoch {
        tracker.begin_lost();
    }
    for _ in 0..20 {
        let state = track(&mut tracker, &black);
        assert!(matches!(state, TrackingState::Lost(_)), "{state:?}");
    }
    track(&mut tracker, &changed_view(&keyframe))
}

#[test]
fn before_its_first_pose_a_camera_is_near_the_keyframe_of_a_new_map() {
    for (keyframe_id, is_later_epoch) in [(0, false), (5, true)] {
        let state = first_pose(keyframe_id, is_later_epoch);
        assert!(state.is_tracked(), "{keyframe_id}, {is_later_epoch}: {state:?}");
    }
}

#[test]
fn on_the_map_of_another_tracker_a_camera_may_be_anywhere() {
    assert_eq!(first_pose(5, false), TrackingState::Lost(LostReason::TooFewInliers));
}
