//! A camera that was lost for long, and is found again by the tracker alone or with the mapper.

use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::scene::{Noise, small_camera, small_plane};
use crate::slam::frame::FrameView;
use crate::slam::keyframe::Keyframe;
use crate::slam::pose::{LostReason, PoseEstimate, TrackingState};
use crate::slam::tracker::{Tracker, TrackerParams};

/// Two ninths of the keyframe's view show something else when the camera returns after `lost` frames; the mapper switches
/// to another keyframe there or not.
fn returned(lost: u64, is_sought: bool) -> PoseEstimate {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = Keyframe { keyframe_id: 7, ..plane.keyframe(&camera, 2, 0.02) };
    let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(&keyframe)));
    let track = |tracker: &mut Tracker, sequence: u64, pixels: &[u8]| {
        let nanos = sequence as i64 * 33_333_333;
        tracker.track(&FrameView::new(&camera, sequence, nanos, pixels), &mut |_| true)
    };
    let before = track(&mut tracker, 0, &keyframe.image);
    assert_eq!(before.state, TrackingState::Tracking);
    let black = vec![0; keyframe.image.len()];
    for sequence in 1..=lost {
        let state = track(&mut tracker, sequence, &black).state;
        assert!(matches!(state, TrackingState::Lost(_)), "{state:?}");
    }
    if is_sought {
        let found = Keyframe { keyframe_id: 3, ..keyframe.clone() };
        tracker.adopt(Box::new(Reference::prepare(&found)));
    }
    let mut noise = Noise(5);
    let mut image = keyframe.image.to_vec();
    let changed = camera.width * (camera.height * 7 / 9);
    image[changed..].fill_with(|| (128.0 + 100.0 * noise.uniform()) as u8);
    track(&mut tracker, lost + 1, &image)
}

#[test]
fn after_many_lost_frames_the_tracker_alone_must_be_surer() {
    let soon = returned(3, false);
    let inliers = soon.quality.inlier_ratio;
    assert!((0.81..0.86).contains(&inliers), "{inliers}: the test needs an image in between");
    assert!(soon.state.is_tracked(), "{:?}", soon.state);
    let late = returned(20, false);
    assert_eq!(late.state, TrackingState::Lost(LostReason::TooFewInliers));
    let found = returned(20, true);
    assert!(found.state.is_tracked(), "{:?}", found.state);
}
