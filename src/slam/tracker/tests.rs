//! The tracker on a plane with exact poses, and on frames that no camera should send.

use nalgebra::{Matrix6, Vector6};

use crate::slam::alignment::reference::Reference;
use crate::slam::alignment::scene::{Noise, Plane, small_camera, small_plane};
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::{
    KeyframePoseCovariance, KeyframePoseMatrix, UncertainPose,
};
use crate::slam::pose::full_covariance;
use crate::slam::pose::{
    DegradedReason, LostReason, PoseEstimate, TrackingState, UNKNOWN_VARIANCE,
};
use crate::slam::tracker::{Tracker, TrackerParams};

fn always(_level: usize) -> bool {
    true
}

fn frame(sequence: u64, pixels: &[u8]) -> FrameView<'_> {
    let camera = small_camera();
    FrameView::new(&camera, sequence, sequence as i64 * 33_333_333, pixels)
}

fn tracker_on(keyframe: &Keyframe) -> Tracker {
    let mut tracker = Tracker::new(small_camera(), TrackerParams::default()).unwrap();
    tracker.adopt(Box::new(Reference::prepare(keyframe)));
    tracker
}

/// Camera poses of a smooth path: out to 0.15 of the depth, 4° of turn.
fn path(index: u64) -> SE3 {
    let s = index as f64 / 12.0;
    SE3::exp(&Vector6::new(0.12 * s, -0.05 * s, 0.08 * s, 0.03 * s, 0.05 * s, -0.06 * s))
}

/// Whether every number of an estimate is finite.
pub(super) fn is_clean(estimate: &PoseEstimate) -> bool {
    let quality = &estimate.quality;
    estimate.world_from_camera.is_finite()
        && estimate.map_from_camera.is_finite()
        && estimate.keyframe_from_camera.is_finite()
        && estimate.covariance.iter().all(|x| x.is_finite())
        && estimate.map_covariance.iter().all(|x| x.is_finite())
        && [estimate.brightness.a, estimate.brightness.b].iter().all(|x| x.is_finite())
        && [quality.in_view_ratio, quality.inlier_ratio, quality.whitened_rmse]
            .iter()
            .chain(&[quality.residual_rmse, quality.mean_squared_flow])
            .all(|x| x.is_finite())
}

#[test]
fn a_path_over_a_plane_is_tracked() {
    let (plane, camera) = (small_plane(), small_camera());
    let mut tracker = tracker_on(&plane.keyframe(&camera, 2, 0.02));
    for sequence in 0..=12 {
        let truth = path(sequence);
        let image = plane.render(&camera, &truth, 2.0, (1.1, 5.0), 100 + sequence);
        let estimate = tracker.track(&frame(sequence, &image), &mut always);
        assert_eq!(estimate.state, TrackingState::Tracking, "frame {sequence}");
        let error = (estimate.keyframe_from_camera.inverse() * truth).log();
        assert!(error.norm() < 2e-3, "frame {sequence}: {error}");
        let gain = estimate.brightness.a.exp();
        assert!((gain - 1.1).abs() < 0.02, "frame {sequence}: gain {gain}");
        let placed = estimate.world_from_camera.inverse() * estimate.keyframe_from_camera;
        assert!(placed.log().norm() < 1e-9, "the keyframe stands at the world's origin");
        assert!(is_clean(&estimate) && estimate.quality.whitened_rmse < 1.2);
    }
}

#[test]
fn the_covariance_in_the_map_combines_those_of_the_keyframe_and_of_the_pose_on_it() {
    let (plane, camera) = (small_plane(), small_camera());
    let image = plane.render(&camera, &path(3), 2.0, (1.0, 0.0), 7);
    let estimate = |deviation: f64| {
        let mut keyframe = plane.keyframe(&camera, 2, 0.02);
        keyframe.map_from_keyframe = Sim3::new(path(30), 0.5);
        let place = KeyframePoseMatrix::from_diagonal_element(deviation * deviation);
        keyframe.place_covariance = KeyframePoseCovariance::bounded(&place);
        tracker_on(&keyframe).track(&frame(0, &image), &mut always)
    };
    let (exact, uncertain) = (estimate(0.0), estimate(0.1));
    assert_eq!(exact.covariance, uncertain.covariance);
    let matrices = [&exact.map_covariance, &uncertain.map_covariance].map(full_covariance);
    let place = UncertainPose::exact(Sim3::new(path(30), 0.5));
    let of_pose = place.of_camera(&exact.keyframe_from_camera, &full_covariance(&exact.covariance));
    assert!((matrices[0] - of_pose).norm() < 1e-12 * of_pose.norm(), "{}", matrices[0]);
    // The pose on the keyframe does not rotate the increment of the keyframe's pose, but the unit moves the camera.
    let along = exact.map_from_camera.translation - place.map_from_keyframe.rigid.translation;
    let mut expected = Matrix6::from_diagonal_element(0.01);
    let mut positions = expected.fixed_view_mut::<3, 3>(0, 0);
    positions += along * along.transpose() * 0.01;
    assert!((matrices[1] - matrices[0] - expected).norm() < 1e-12, "{}", matrices[1]);
    let lost = tracker_on(&plane.keyframe(&camera, 2, 0.02))
        .track(&frame(0, &vec![0; camera.width * camera.height]), &mut always);
    assert_eq!(lost.map_covariance, lost.covariance);
    assert_eq!(lost.map_covariance[0], UNKNOWN_VARIANCE);
}

#[test]
fn arbitrary_frames_neither_panic_nor_claim_a_pose() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    let size = camera.width * camera.height;
    let mut noise = Noise(5);
    let mut random: Vec<u8> = (0..size).map(|_| noise.bits() as u8).collect();
    let saturated: Vec<u8> = keyframe.image.iter().map(|&p| p.saturating_mul(40)).collect();
    let unrelated = Plane::new([-0.3, 0.1, 0.8], [7.0, 90.0], &camera);
    let unrelated = unrelated.render(&camera, &path(40), 2.0, (1.0, 0.0), 3);
    for image in [vec![0; size], vec![255; size], vec![128; size], random.clone(), unrelated] {
        let mut tracker = tracker_on(&keyframe);
        for sequence in 0..3 {
            let estimate = tracker.track(&frame(sequence, &image), &mut always);
            assert!(matches!(estimate.state, TrackingState::Lost(_)), "{:?}", estimate.state);
            assert!(is_clean(&estimate));
        }
        // And tracking recovers.
        let estimate = tracker.track(&frame(9, &keyframe.image), &mut always);
        assert!(estimate.state.is_tracked(), "{estimate:?}");
    }
    let estimate = tracker_on(&keyframe).track(&frame(0, &saturated), &mut always);
    assert!(is_clean(&estimate));
    random.truncate(size - 1);
    for (width, height) in [(camera.width, camera.height), (size - 1, 1), (0, 0), (usize::MAX, 2)] {
        let wrong = FrameView { width, height, ..frame(0, &random) };
        let estimate = tracker_on(&keyframe).track(&wrong, &mut always);
        assert_eq!(estimate.state, TrackingState::Lost(LostReason::UnusableFrame));
        assert!(is_clean(&estimate));
    }
}

#[test]
fn a_bright_or_dark_scene_does_not_make_white_or_black_frames_fit() {
    let (plane, camera) = (small_plane(), small_camera());
    let exact = plane.keyframe(&camera, 2, 0.02);
    let size = camera.width * camera.height;
    // Near an end of the sensor's range a little gain and offset push every point beyond it.
    for (from, to) in [(150.0f32, 250.0), (5.0, 60.0), (100.0, 254.0)] {
        let mut keyframe = exact.clone();
        let [low, high] = [keyframe.image.iter().min(), keyframe.image.iter().max()]
            .map(|grey| f32::from(*grey.unwrap()));
        let stretched = |grey: f32| from + (grey - low) / (high - low) * (to - from);
        let stretch = |grey: &u8| stretched(f32::from(*grey)) as u8;
        keyframe.image = keyframe.image.iter().map(stretch).collect();
        keyframe.points.iter_mut().for_each(|point| point.intensity = stretched(point.intensity));
        for grey in [0, 1, 254, 255] {
            let mut tracker = tracker_on(&keyframe);
            for sequence in 0..5 {
                let estimate = tracker.track(&frame(sequence, &vec![grey; size]), &mut always);
                assert!(matches!(estimate.state, TrackingState::Lost(_)), "{grey}: {estimate:?}");
            }
            let estimate = tracker.track(&frame(9, &keyframe.image), &mut always);
            assert!(estimate.state.is_tracked(), "{estimate:?}");
        }
    }
}

#[test]
fn arbitrary_keyframes_neither_panic_nor_claim_a_pose() {
    let (plane, camera) = (small_plane(), small_camera());
    let good = plane.keyframe(&camera, 2, 0.02);
    let image = good.image.clone();
    let mut empty = good.clone();
    empty.points.clear();
    let mut one = good.clone();
    one.points.truncate(1);
    let mut wrong_size = good.clone();
    wrong_size.image = wrong_size.image[1..].into();
    let mut hostile = good.clone();
    hostile.points.iter_mut().for_each(|point| point.inverse_depth = f32::NAN);
    let mut outside = good.clone();
    outside.points.iter_mut().for_each(|point| point.u = u16::MAX);
    let mut nowhere = good.clone();
    nowhere.world_from_keyframe.scale = f64::NAN;
    for keyframe in [empty, one, wrong_size, hostile, outside, nowhere] {
        let estimate = tracker_on(&keyframe).track(&frame(0, &image), &mut always);
        assert!(matches!(estimate.state, TrackingState::Lost(_)), "{:?}", estimate.state);
        assert!(is_clean(&estimate), "{estimate:?}");
    }
}

#[test]
fn a_frame_with_all_points_behind_the_camera_is_lost() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    let mut tracker = tracker_on(&keyframe);
    let turned = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, std::f64::consts::PI, 0.0));
    tracker.memory.motion.observe(0, &turned);
    let estimate = tracker.track(&frame(1, &keyframe.image), &mut always);
    assert!(matches!(estimate.state, TrackingState::Lost(_)), "{:?}", estimate.state);
    assert!(is_clean(&estimate));
}

#[test]
fn only_tracked_frames_define_a_good_fit() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    let mut tracker = tracker_on(&keyframe);
    assert!(tracker.track(&frame(0, &keyframe.image), &mut always).state.is_tracked());
    let good = tracker.memory.coarse_fit;
    assert!(good.is_some());
    let unrelated = Plane::new([-0.3, 0.1, 0.8], [7.0, 90.0], &camera);
    let unrelated = unrelated.render(&camera, &path(40), 2.0, (1.0, 0.0), 3);
    let estimate = tracker.track(&frame(1, &unrelated), &mut always);
    assert!(matches!(estimate.state, TrackingState::Lost(_)), "{:?}", estimate.state);
    assert_eq!(tracker.memory.coarse_fit, good, "a lost frame");
    // Time runs out on the first level of a frame that is hard to track.
    let image = plane.render(&camera, &path(6), 2.0, (1.0, 0.0), 7);
    let mut left = 2;
    let mut short = |_: usize| {
        left -= 1;
        left >= 0
    };
    tracker.memory.was_lost = false;
    tracker.track(&frame(2, &image), &mut short);
    assert_eq!(tracker.memory.coarse_fit, good, "a frame cut short");
}

#[test]
fn the_right_one_of_coarsest_level_and_prediction_is_continued() {
    let (plane, camera) = (small_plane(), small_camera());
    let mut tracker = tracker_on(&plane.keyframe(&camera, 2, 0.02));
    let reference = tracker.reference.take().unwrap();
    tracker.pyramid.fill(&plane.render(&camera, &path(6), 2.0, (1.0, 0.0), 7));
    // From 10° away the finer level does not converge.
    let astray = path(6) * SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.1, -0.15, 0.0));
    for (of_coarsest, predicted) in [(astray, path(5)), (path(6), astray)] {
        let (aligner, frame) = (&tracker.aligner, &tracker.pyramid);
        let brightness = tracker.memory.brightness;
        let coarsest = aligner.start(&reference, frame, &of_coarsest.inverse(), brightness);
        let best = tracker.better_on_next(&reference, coarsest.clone(), &predicted, &mut always);
        assert_eq!(best.level + 1, coarsest.level);
        let error = (best.state.current_from_keyframe * path(6)).log();
        assert!(error.norm() < 0.01, "{error}");
    }
}

#[test]
fn a_far_hypothesis_does_not_win_by_its_tolerance() {
    let (plane, camera) = (small_plane(), small_camera());
    // From afar, depth as uncertain as this explains any image.
    let keyframe = plane.keyframe(&camera, 2, 0.4);
    let mut tracker = tracker_on(&keyframe);
    let far = SE3::exp(&Vector6::new(0.3, 0.2, -2.0, 0.0, 0.0, 0.0));
    tracker.memory.motion.observe(0, &far);
    tracker.memory.was_lost = true;
    let truth = SE3::exp(&Vector6::new(0.01, 0.0, 0.0, 0.04, -0.03, 0.0));
    let mut image = plane.render(&camera, &truth, 2.0, (1.0, 0.0), 4);
    // Something hides an eighth of the view: the right pose does not explain that.
    let is_hidden = |i: &usize| i % camera.width < camera.width / 8;
    for i in (0..image.len()).filter(is_hidden) {
        image[i] = if i / camera.width / 20 % 2 == 0 { 20 } else { 230 };
    }
    let estimate = tracker.track(&frame(1, &image), &mut always);
    assert!(estimate.state.is_tracked(), "{:?}", estimate.state);
    let error = (estimate.keyframe_from_camera.inverse() * truth).log();
    assert!(error.norm() < 0.02, "{error}");
}

#[test]
fn images_of_one_level_are_tracked_on_it() {
    // Thermal cameras deliver 32×24.
    for (width, height) in [(32, 24), (64, 47), (47, 64)] {
        let (fx, fy) = (0.8 * width as f64, 0.8 * width as f64);
        let (cx, cy) = (0.5 * width as f64 - 0.3, 0.5 * height as f64 - 0.7);
        let camera = Intrinsics { fx, fy, cx, cy, width, height };
        let plane = Plane::new([0.12, -0.2, 0.95], [8.0, 60.0], &camera);
        let keyframe = plane.keyframe(&camera, 1, 0.01);
        let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        for sequence in 0..=4 {
            let truth = path(sequence);
            let image = plane.render(&camera, &truth, 2.0, (1.0, 0.0), 100 + sequence);
            let view = FrameView { width, height, ..frame(sequence, &image) };
            let estimate = tracker.track(&view, &mut always);
            assert_eq!(estimate.state, TrackingState::Tracking, "{width}×{height}, {sequence}");
            assert_eq!(estimate.quality.finest_level, 0);
            let error = (estimate.keyframe_from_camera.inverse() * truth).log();
            // Half a pixel.
            assert!(error.norm() * camera.fx < 0.5, "{width}×{height}, {sequence}: {error}");
        }
    }
}

#[test]
fn without_a_trusted_keyframe_nothing_is_claimed() {
    let (plane, camera) = (small_plane(), small_camera());
    let mut keyframe = plane.keyframe(&camera, 2, 0.02);
    let image = keyframe.image.clone();
    let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
    let estimate = tracker.track(&frame(0, &image), &mut always);
    assert_eq!(estimate.state, TrackingState::Initializing);
    keyframe.map_state = MapState::Rejected;
    tracker.adopt(Box::new(Reference::prepare(&keyframe)));
    let estimate = tracker.track(&frame(2, &image), &mut always);
    assert_eq!(estimate.state, TrackingState::Lost(LostReason::MapRejected));
}

#[test]
fn a_camera_found_again_is_where_it_was_before() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = Keyframe { keyframe_id: 7, ..plane.keyframe(&camera, 2, 0.02) };
    let seen = |index: u64, pose: &SE3| plane.render(&camera, pose, 2.0, (1.0, 0.0), index);
    // Rolled by 40° against a keyframe, which is placed such that the camera keeps its pose.
    let found = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.7));
    // A keyframe is newer than all others where a later epoch begins, and older where it is resumed.
    for (is_rejected, keyframe_id, epoch, state) in [
        (false, 3, 1, TrackingState::Tracking),
        (false, 9, 1, TrackingState::Lost(LostReason::TooFewInliers)),
        (true, 3, 0, TrackingState::Tracking),
    ] {
        let mut tracker = tracker_on(&keyframe);
        let before = tracker.track(&frame(1, &seen(1, &path(1))), &mut always).world_from_camera;
        if is_rejected {
            // On a keyframe that is elsewhere the same view would be another pose.
            let elsewhere = Sim3::new(SE3::exp(&Vector6::new(0.4, 0.0, 0.0, 0.0, 0.0, 1.0)), 1.0);
            let rejected = Keyframe {
                keyframe_id: 8,
                map_state: MapState::Rejected,
                world_from_keyframe: elsewhere,
                ..keyframe.clone()
            };
            tracker.adopt(Box::new(Reference::prepare(&rejected)));
            let estimate = tracker.track(&frame(2, &seen(2, &path(2))), &mut always);
            assert_eq!(estimate.state, TrackingState::Lost(LostReason::MapRejected));
            assert_eq!(estimate.world_from_camera, before);
        }
        let world_from_keyframe = Sim3::new(before * found.inverse(), 1.0);
        let at = Keyframe { keyframe_id, epoch, world_from_keyframe, ..keyframe.clone() };
        tracker.adopt(Box::new(Reference::prepare(&at)));
        let estimate = tracker.track(&frame(3, &seen(3, &found)), &mut always);
        assert_eq!(estimate.state, state, "{keyframe_id}");
    }
}

#[test]
fn a_large_change_of_light_requests_another_keyframe() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    let proposes = |light: (f64, f64)| {
        let image = plane.render(&camera, &path(1), 2.0, light, 7);
        let estimate = tracker_on(&keyframe).track(&frame(1, &image), &mut always);
        assert_eq!(estimate.state, TrackingState::Tracking, "{light:?}");
        estimate.proposes_keyframe
    };
    assert!(!proposes((1.0, 0.0)) && !proposes((1.2, 3.0)) && !proposes((0.85, -4.0)));
    assert!(proposes((0.5, 0.0)) && proposes((0.6, -10.0)));
}

/// An image without noise, from which many are made with independent noise.
struct Shot(Vec<f64>);

impl Shot {
    fn of(plane: &Plane, camera: &Intrinsics, keyframe_from_camera: &SE3) -> Self {
        let grey = |i: usize| {
            let (u, v) = ((i % camera.width) as f64, (i / camera.width) as f64);
            plane.grey(camera, keyframe_from_camera, u, v)
        };
        Self((0..camera.width * camera.height).map(grey).collect())
    }

    fn noisy(&self, seed: u64) -> Vec<u8> {
        let mut noise = Noise(seed);
        let noisy = |grey: &f64| (grey + 2.0 * noise.normal()).round().clamp(0.0, 255.0) as u8;
        self.0.iter().map(noisy).collect()
    }
}

#[test]
fn sub_pixel_motion_is_found_without_bias_from_or_to_whole_pixels() {
    /// Pairs of images with independent noise. One keyframe for all frames would leave its own
    /// noise, 0.02 px, in the mean.
    const PAIRS: u64 = 36;
    let camera = small_camera();
    let plane = Plane::new([0.12, -0.2, 0.95], [16.0, 180.0], &camera);
    let mut keyframe = plane.keyframe(&camera, 1, 0.0);
    let at_keyframe = Shot::of(&plane, &camera, &SE3::identity());
    for shift_px in [0.0, 0.25, 0.5] {
        let shift = shift_px / camera.fx;
        let truth = SE3::exp(&Vector6::new(shift, 0.3 * shift, 0.0, 0.0, 0.0, 0.0));
        let shifted = Shot::of(&plane, &camera, &truth);
        let mut sum = Vector6::zeros();
        for pair in 0..PAIRS {
            keyframe.image = at_keyframe.noisy(2 * pair).into();
            let image = shifted.noisy(2 * pair + 1);
            let estimate = tracker_on(&keyframe).track(&frame(1, &image), &mut always);
            sum += (estimate.keyframe_from_camera.inverse() * truth).log() * camera.fx;
        }
        let mean = sum / PAIRS as f64;
        // Pixels of level 0. The mean of so many scatters by 0.006. A gradient that shares noise
        // with the residual leaves 0.12 here.
        assert!(mean.norm() < 0.02, "{shift_px} px: {mean}");
    }
}

#[test]
fn rehearsals_with_any_budget_leave_the_tracker_unchanged() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    let (mut rehearsing, mut other) = (tracker_on(&keyframe), tracker_on(&keyframe));
    for sequence in 0..=8 {
        let image = plane.render(&camera, &path(sequence), 2.0, (1.0, 0.0), 100 + sequence);
        let frame = frame(sequence, &image);
        let memory = rehearsing.memory().clone();
        let estimate = rehearsing.track(&frame, &mut always);
        assert_eq!(estimate, other.track(&frame, &mut always), "frame {sequence}");
        assert_eq!(estimate, rehearsing.rehearse(&memory, &frame, &mut always));
        for iterations in [0, 1, 3] {
            let mut left = iterations;
            let mut budget = |_: usize| {
                left -= 1;
                left >= 0
            };
            let short = rehearsing.rehearse(&memory, &frame, &mut budget);
            assert_ne!(short.state, TrackingState::Tracking, "{iterations} iterations");
            assert!(is_clean(&short));
        }
    }
}

#[test]
fn a_short_budget_is_never_worse_than_the_prediction() {
    let (plane, camera) = (small_plane(), small_camera());
    let mut tracker = tracker_on(&plane.keyframe(&camera, 2, 0.02));
    // By the number of iterations that there is time for.
    let mut errors = [const { Vec::new() }; 7];
    let mut whole_errors = Vec::new();
    for sequence in 0..=12 {
        let image = plane.render(&camera, &path(sequence), 2.0, (1.0, 0.0), 100 + sequence);
        let (frame, truth) = (frame(sequence, &image), path(sequence).inverse());
        let memory = tracker.memory().clone();
        let error_of = |estimate: &PoseEstimate| {
            (estimate.keyframe_from_camera.inverse() * truth.inverse()).log() * camera.fx
        };
        let estimate = tracker.track(&frame, &mut always);
        let finest = estimate.quality.finest_level;
        let whole = error_of(&estimate).norm();
        if sequence > 2 {
            whole_errors.push(whole);
        }
        // The third frame is the first with a known velocity.
        for (iterations, errors) in errors.iter_mut().enumerate().filter(|_| sequence > 2) {
            let mut left = iterations;
            let mut budget = |_: usize| {
                let is_left = left > 0;
                left = left.saturating_sub(1);
                is_left
            };
            let short = tracker.rehearse(&memory, &frame, &mut budget);
            assert_eq!(short.state, TrackingState::Degraded(DegradedReason::Budget));
            // A coarse level takes more than one iteration, or no level is needed at all.
            assert!(short.quality.finest_level > finest || iterations > 2, "{sequence}");
            let error = error_of(&short);
            errors.push(error.norm());
            // The covariance reflects it: within three of its standard deviations in every direction.
            let std_dev =
                [0, 6, 11, 15, 18, 20].map(|i| short.alignment_covariance[i].sqrt() * camera.fx);
            assert!((0..6).all(|i| error[i].abs() < 3.0 * std_dev[i] + 0.1), "{error} {std_dev:?}");
        }
    }
    let median = |errors: &mut Vec<f64>| {
        errors.sort_by(f64::total_cmp);
        errors[errors.len() / 2]
    };
    let medians = errors.each_mut().map(median);
    // A good prediction may be nearer to the truth than noise allows for any alignment.
    let allowed = 1.05 * medians[0].max(median(&mut whole_errors));
    assert!(medians.iter().all(|&error| error <= allowed), "{allowed} px: {medians:?}");
}

#[test]
fn a_tracker_that_starts_on_another_map_must_fit_as_well_as_a_lost_one() {
    let (plane, camera) = (small_plane(), small_camera());
    let keyframe = plane.keyframe(&camera, 2, 0.02);
    // Two fifths of the view show something else.
    let mut image = keyframe.image.to_vec();
    let changed = camera.width * (camera.height * 3 / 5);
    image[changed..].iter_mut().for_each(|grey| *grey = 255 - *grey);
    let track = |begins_lost: bool| {
        let mut tracker = Tracker::new(camera, TrackerParams::default()).unwrap();
        tracker.adopt(Box::new(Reference::prepare(&keyframe)));
        if begins_lost {
            tracker.begin_lost();
        }
        tracker.track(&frame(0, &image), &mut always)
    };
    let fresh = track(false);
    assert!(fresh.state.is_tracked(), "{:?}", fresh.state);
    let inliers = fresh.quality.inlier_ratio;
    assert!((0.5..0.65).contains(&inliers), "{inliers}: the test needs an image in between");
    assert!(matches!(track(true).state, TrackingState::Lost(_)));
}
