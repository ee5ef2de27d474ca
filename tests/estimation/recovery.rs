//! Loss and recovery with the whole pipeline: a blackout before a known view and before a new one, a standing camera,
//! and inconsistent maps: by their poses, and from the start.

use crate::recording::recording;
use nalgebra::Vector6;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{
    MotionKind, MotionParams, SensorParams, SimulatorParams,
};
use semidense::capture::source::{FrameSource, FrameStamp};
use semidense::capture::source_error::SourceError;
use semidense::capture::source_name::SourceName;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::evaluation::{
    MAX_DIFFERENCE_NANOS, TrajectoryEvaluation, evaluate_trajectory,
};
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::keyframe::MapState;
use semidense::slam::loops::SearchOutcome;
use semidense::slam::mapper::recovery::RecoveryParams;
use semidense::slam::mapper::situation::Situation;
use semidense::slam::mapper::{Mapper, MapperParams};
use semidense::slam::pose::{NO_KEYFRAME, PoseEstimate, TrackingState};
use semidense::slam::trajectory::StampedPose;

/// Time between frames.
const PERIOD_NANOS: i64 = 33_333_333;

/// Frames in a chosen order, at a steady rate.
struct Script {
    intrinsics: Intrinsics,
    frames: Vec<Vec<u8>>,
    truth: Vec<StampedPose>,
    next: usize,
}

/// The frames of a simulated sequence with their poses.
struct Footage {
    intrinsics: Intrinsics,
    frames: Vec<Vec<u8>>,
    poses: Vec<SE3>,
}

/// A sequence at 320 × 240 with noise of `noise_std_dev` grey levels.
fn footage(seed: u64, kind: MotionKind, frames: usize, noise_std_dev: f64) -> Footage {
    let params = SimulatorParams {
        seed,
        frames,
        motion: MotionParams { kind, ..MotionParams::default() },
        sensor: SensorParams { noise_std_dev, ..SensorParams::default() },
        ..SimulatorParams::half_size()
    };
    film(&mut Simulator::new(params).unwrap())
}

/// All frames of a source.
fn film(source: &mut dyn FrameSource) -> Footage {
    let intrinsics = source.intrinsics();
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    let (mut taken, mut poses) = (Vec::new(), Vec::new());
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        let truth = source.ground_truth();
        let nearest = truth.iter().min_by_key(|p| p.nanos.abs_diff(stamp.capture_nanos)).unwrap();
        poses.push(nearest.world_from_camera);
        taken.push(pixels.clone());
    }
    Footage { intrinsics, frames: taken, poses }
}

impl Script {
    fn new(intrinsics: Intrinsics) -> Self {
        Self { intrinsics, frames: Vec::new(), truth: Vec::new(), next: 0 }
    }

    fn show(&mut self, footage: &Footage, order: impl Iterator<Item = usize>) {
        for index in order {
            let nanos = self.frames.len() as i64 * PERIOD_NANOS;
            self.truth.push(StampedPose { nanos, world_from_camera: footage.poses[index] });
            self.frames.push(footage.frames[index].clone());
        }
    }

    fn black_out(&mut self, frames: usize) {
        let black = vec![0; self.intrinsics.width * self.intrinsics.height];
        self.frames.extend(std::iter::repeat_n(black, frames));
    }

    fn replay(mut self, config: &ReplayConfig) -> RunRecord {
        replay(&mut self, "script", config, &mut |_| true).unwrap()
    }
}

impl FrameSource for Script {
    fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    fn num_frames(&self) -> Option<usize> {
        Some(self.frames.len())
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        let Some(frame) = self.frames.get(self.next) else { return Ok(None) };
        pixels.copy_from_slice(frame);
        let sequence = self.next as u64;
        let capture_nanos = self.next as i64 * PERIOD_NANOS;
        self.next += 1;
        Ok(Some(FrameStamp { sequence, capture_nanos, exposure_nanos: 0, gain: 0.0, clocks: None }))
    }

    fn ground_truth(&self) -> &[StampedPose] {
        &self.truth
    }
}

fn estimates(record: &RunRecord) -> impl DoubleEndedIterator<Item = &PoseEstimate> {
    record.poses.iter().map(|pose| &pose.estimate)
}

fn count_tracked(record: &RunRecord, frames: std::ops::Range<usize>) -> usize {
    estimates(record).skip(frames.start).take(frames.len()).filter(|e| e.state.is_tracked()).count()
}

/// ATE over the tracked frames of an epoch, as a share of the path.
fn error_ratio(record: &RunRecord, epoch: u32) -> f64 {
    let evaluation = error_of(record, epoch);
    evaluation.ate.rmse / evaluation.path_length
}

/// Errors over the tracked frames of an epoch.
fn error_of(record: &RunRecord, epoch: u32) -> TrajectoryEvaluation {
    let tracked: Vec<StampedPose> = estimates(record)
        .filter(|e| e.state.is_tracked() && e.epoch == epoch)
        .map(|e| StampedPose { nanos: e.capture_nanos, world_from_camera: e.map_from_camera })
        .collect();
    let truth = &record.ground_truth;
    let evaluation =
        evaluate_trajectory(&tracked, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
            .unwrap();
    println!(
        "epoch {epoch}: ATE {} over {} of {}",
        evaluation.ate.rmse,
        tracked.len(),
        evaluation.path_length
    );
    evaluation
}

#[test]
fn after_a_blackout_the_camera_is_relocalised_in_a_known_view() {
    let room = footage(1, MotionKind::Handheld, 140, 2.0);
    let replay = |recovery: RecoveryParams| {
        let mut script = Script::new(room.intrinsics);
        script.show(&room, 0..140);
        script.black_out(20);
        // The camera is back where it was four seconds ago.
        script.show(&room, 20..80);
        let mapper = MapperParams { recovery, ..MapperParams::default() };
        script.replay(&ReplayConfig { mapper, ..ReplayConfig::default() })
    };
    let record = replay(RecoveryParams::default());
    let mut lost = estimates(&record).skip(140).take(20);
    assert!(lost.all(|e| matches!(e.state, TrackingState::Lost(_))), "black is no pose");
    let after = count_tracked(&record, 160..220);
    println!("{after} of 60 tracked after the blackout");
    assert!(after >= 50, "{after}");
    assert!(estimates(&record).all(|e| e.epoch == 0), "it is the same map");
    let ratio = error_ratio(&record, 0);
    assert!(ratio < 0.02, "{ratio}");
    // In the map it is back at the earlier pose; odometry continues from where it was lost.
    let tracked: Vec<_> = estimates(&record).filter(|e| e.state.is_tracked()).collect();
    let found = tracked.iter().position(|e| e.sequence >= 160).unwrap();
    let (last, first) = (tracked[found - 1], tracked[found]);
    let step = |one: &SE3, other: &SE3| (one.translation - other.translation).norm();
    let jump = step(&last.world_from_camera, &first.world_from_camera);
    let back = step(&last.map_from_camera, &first.map_from_camera);
    assert!(jump < 0.03 && back > 5.0 * jump, "odometry jumps by {jump}, the map pose by {back}");

    let without_search =
        RecoveryParams { num_keyframes: 0, lost_timeout_secs: 1e3, ..RecoveryParams::default() };
    let alone = count_tracked(&replay(without_search), 160..220);
    assert!(2 * alone < after, "the tracker alone finds it late, if at all: {alone} of {after}");
}

#[test]
fn after_a_blackout_a_new_view_starts_a_new_epoch() {
    let room = footage(1, MotionKind::Handheld, 80, 2.0);
    let elsewhere = footage(7, MotionKind::Handheld, 170, 2.0);
    let mut script = Script::new(room.intrinsics);
    script.show(&room, 0..80);
    script.black_out(20);
    script.show(&elsewhere, 0..170);
    let record = script.replay(&ReplayConfig::default());
    for (index, estimate) in estimates(&record).enumerate() {
        let claims_the_old = index >= 80 && estimate.epoch == 0 && estimate.state.is_tracked();
        assert!(!claims_the_old, "frame {index} is claimed on a map of another place");
    }
    let after = count_tracked(&record, 100..270);
    println!("{after} of 170 tracked after the blackout");
    assert!(after >= 100, "{after}");
    assert_eq!(estimates(&record).last().unwrap().epoch, 1);
    assert!(error_ratio(&record, 1) < 0.03);
    let epochs: Vec<u32> = record.map.keyframes.iter().map(|k| k.epoch).collect();
    assert!(epochs.is_sorted() && epochs[0] == 0, "earlier epochs stay: {epochs:?}");
    // The new epoch starts near the last known pose of the camera.
    let last = estimates(&record).rfind(|e| e.epoch == 0 && e.state.is_tracked()).unwrap();
    let first = record.map.keyframes.iter().find(|k| k.epoch == 1).unwrap();
    assert_eq!(first.map_from_keyframe.rigid, last.world_from_camera);
}

#[test]
fn back_at_a_place_of_an_earlier_epoch_the_camera_is_relocalised_there() {
    let room = footage(1, MotionKind::Handheld, 100, 2.0);
    let elsewhere = footage(7, MotionKind::Handheld, 170, 2.0);
    let mut script = Script::new(room.intrinsics);
    script.show(&room, 0..100);
    script.black_out(20);
    script.show(&elsewhere, 0..170);
    script.black_out(5);
    script.show(&room, 40..90);
    let record = script.replay(&ReplayConfig::default());
    let between: Vec<_> = estimates(&record).skip(120).take(170).collect();
    assert_eq!(between.last().unwrap().epoch, 1, "elsewhere there is another map");
    let back: Vec<_> = estimates(&record).skip(295).collect();
    let found = back.iter().filter(|e| e.epoch == 0 && e.state.is_tracked()).count();
    println!("{found} of 50 tracked on the first map again");
    assert!(found >= 40, "{found}");
    assert!(back.iter().all(|e| e.epoch == 0 || !e.state.is_tracked()), "claimed elsewhere");
    let ratio = error_ratio(&record, 0);
    assert!(ratio < 0.02, "{ratio}");
    // Odometry continues from where it was lost.
    let last = between.iter().rfind(|e| e.state.is_tracked()).unwrap();
    let first = back.iter().find(|e| e.state.is_tracked()).unwrap();
    let jump = (last.world_from_camera.translation - first.world_from_camera.translation).norm();
    assert!(jump < 0.1, "odometry jumps by {jump}");
}

#[test]
fn a_camera_that_returns_elsewhere_is_not_relocalised_at_a_wrong_place() {
    // Frames seen before, between and after two blackouts, during which the camera moves on.
    for (name, most_m, seen) in [
        ("redkitchen", 0.08, [0..175, 224..350, 399..500]),
        ("redkitchen", 0.08, [20..188, 235..356, 403..500]),
        ("tsukuba", 0.02, [0..52, 72..105, 125..150]),
    ] {
        let Some(folder) = recording(name) else { return };
        let mut source = open(&SourceName::Tum(folder), None, &SourceParams::default()).unwrap();
        let footage = film(source.as_mut());
        let mut script = Script::new(footage.intrinsics);
        for (part, frames) in seen.into_iter().enumerate() {
            script.black_out(if part > 0 { 8 } else { 0 });
            script.show(&footage, frames);
        }
        let record = script.replay(&ReplayConfig::default());
        let tracked = estimates(&record).filter(|e| e.state.is_tracked()).count();
        println!("{name}: {tracked} of {} tracked", record.poses.len());
        // A wrong place after a blackout would be 0.7 m off, and 0.1 m in the other room.
        let error = error_of(&record, 0).ate.rmse;
        assert!(error < most_m, "{name}: {error} m");
    }
}

#[test]
fn frames_from_before_the_start_of_the_map_have_a_pose_in_the_end() {
    let room = footage(1, MotionKind::Handheld, 100, 2.0);
    let mut script = Script::new(room.intrinsics);
    script.show(&room, 0..100);
    let record = script.replay(&ReplayConfig::default());
    let begun = estimates(&record).position(|e| e.state.is_tracked()).unwrap();
    assert!(begun > 2, "the map began at once");
    let placed = |e: &PoseEstimate| {
        let (keyframe_id, at) = match record.map.frame(e.sequence) {
            Some(again) => (again.keyframe_id, again.keyframe_from_camera),
            None => (e.keyframe_id, e.keyframe_from_camera),
        };
        let world_from_camera = record.map.frame_pose(keyframe_id, &at)?;
        Some(StampedPose { nanos: e.capture_nanos, world_from_camera })
    };
    let all: Vec<StampedPose> = estimates(&record).filter_map(placed).collect();
    assert_eq!(all.len(), 100, "every frame has a pose");
    let error = |poses: &[StampedPose]| {
        let truth = &record.ground_truth;
        evaluate_trajectory(poses, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
            .unwrap()
            .ate
    };
    let (with, without) = (error(&all), error(&all[begun..]));
    println!("{begun} frames before; ATE {} with them, {} without", with.rmse, without.rmse);
    assert!(with.rmse < 1.5 * without.rmse, "{} {}", with.rmse, without.rmse);
}

#[test]
fn a_standing_camera_never_initialises() {
    for (seed, noise_std_dev) in [(1, 2.0), (2, 4.0)] {
        let still = footage(seed, MotionKind::Standing, 75, noise_std_dev);
        let mut script = Script::new(still.intrinsics);
        script.show(&still, 0..75);
        let record = script.replay(&ReplayConfig::default());
        assert!(record.map.keyframes.is_empty(), "{seed}");
        assert!(estimates(&record).all(|e| e.state == TrackingState::Initializing), "{seed}");
    }
}

#[test]
fn a_camera_that_comes_to_rest_does_not_drift() {
    const REST: usize = 70;
    let room = footage(3, MotionKind::Handheld, REST, 0.0);
    let mut script = Script::new(room.intrinsics);
    script.show(&room, 0..REST);
    script.show(&room, std::iter::repeat_n(REST - 1, 150));
    let mut random = 1u64;
    for pixel in script.frames.iter_mut().flatten() {
        // A sum of four uniform bytes is close enough to a Gaussian: σ = 148 / 49 = 3 grey levels.
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let sum: i32 = (random >> 32).to_le_bytes()[..4].iter().map(|&b| i32::from(b)).sum();
        *pixel = (i32::from(*pixel) + (sum - 510) / 49).clamp(0, 255) as u8;
    }
    let record = script.replay(&ReplayConfig::default());
    // The first frames at rest belong to the end of the motion: refined depth moves the pose a little.
    let resting: Vec<_> = estimates(&record).skip(REST + 20).collect();
    assert!(resting.iter().all(|e| e.state == TrackingState::Tracking));
    let last = record.map.keyframes.last().unwrap();
    assert!(last.sequence < REST as u64 + 5, "no keyframe is made at rest: {}", last.sequence);
    // Relative to the mean depth: a few millimetres in a room of a few metres.
    let unit = last.map_from_keyframe.scale;
    let first = resting[0].world_from_camera.translation;
    let furthest = resting
        .iter()
        .map(|e| (e.world_from_camera.translation - first).norm() / unit)
        .fold(0.0, f64::max);
    println!("furthest from rest: {furthest} of the mean depth");
    assert!(furthest < 0.004, "{furthest}");
}

#[test]
fn a_map_with_wrong_poses_is_rejected() {
    const WRONG: usize = 50;
    let room = footage(1, MotionKind::Handheld, WRONG + 10, 2.0);
    let mut mapper = Mapper::new(room.intrinsics, MapperParams::default()).unwrap();
    let mut rejected_at = None;
    for (index, pixels) in room.frames.iter().enumerate() {
        let frame =
            FrameView::new(&room.intrinsics, index as u64, index as i64 * PERIOD_NANOS, pixels);
        // Three degrees correspond to thirteen pixels.
        let rotation = if index < WRONG { 0.0 } else { 3_f64.to_radians() };
        let wrong = SE3::exp(&Vector6::new(0.0, 0.0, 0.0, rotation, 0.0, rotation));
        let world_from_camera = room.poses[0].inverse() * room.poses[index] * wrong;
        let (keyframe_id, epoch) =
            mapper.keyframe().map_or((NO_KEYFRAME, 0), |k| (k.keyframe_id, k.epoch));
        let pose = PoseEstimate {
            state: TrackingState::Tracking,
            world_from_camera,
            keyframe_from_camera: mapper.keyframe().map_or(SE3::identity(), |k| {
                k.world_from_keyframe.inverse_transform_pose(&world_from_camera)
            }),
            keyframe_id,
            epoch,
            proposes_keyframe: index % 15 == 0,
            ..PoseEstimate::unknown(&frame)
        };
        mapper.step(&frame, &pose, None, &mut || {});
        rejected_at = rejected_at.or_else(|| {
            let is_rejected = matches!(mapper.situation(), Situation::Rejected(_));
            is_rejected.then_some((index, mapper.keyframe()?.map_state))
        });
        if index + 1 == WRONG {
            assert_eq!(mapper.situation(), Situation::Mapping);
        }
    }
    let (index, state) = rejected_at.unwrap();
    assert!((WRONG..WRONG + 10).contains(&index), "{index}");
    assert_eq!(state, MapState::Rejected);
}

#[test]
fn a_start_with_the_wrong_motion_is_rejected_and_a_new_one_begun() {
    // A plane seen from two places has two explanations, and here the wrong one fits better.
    wrong_start(6, 40);
    wrong_start(10, 40);
}

#[test]
fn a_start_with_the_wrong_motion_is_rejected_even_if_the_joint_estimate_makes_it_fit() {
    wrong_start(3, 50);
}

/// Checks that a start on the floor from `first_frame` with the wrong of two motions is rejected within `most_frames`.
fn wrong_start(first_frame: usize, most_frames: u64) {
    let Some(folder) = recording("fr1-floor") else { return };
    let mut source = open(&SourceName::Tum(folder), None, &SourceParams::default()).unwrap();
    let floor = film(source.as_mut());
    let mut script = Script::new(floor.intrinsics);
    script.show(&floor, first_frame..floor.frames.len());
    let mut config = ReplayConfig::default();
    let evidence = &mut config.mapper.two_frame.evidence;
    (evidence.min_rival_excess, evidence.min_turning_rival_excess) = (0.0, 0.0);
    let record = script.replay(&config);
    let of_epoch = |epoch| record.map.keyframes.iter().filter(move |k| k.epoch == epoch);
    assert!(of_epoch(0).count() > 1 && of_epoch(1).count() > 1);
    assert!(of_epoch(0).all(|keyframe| keyframe.map_state == MapState::Rejected));
    assert!(of_epoch(1).all(|keyframe| keyframe.map_state == MapState::Established));
    let [first, second] = [0, 1].map(|epoch| {
        let mut claimed = estimates(&record).filter(|e| e.epoch == epoch && e.state.is_tracked());
        let first = claimed.next().unwrap().sequence;
        (first, claimed.next_back().unwrap().sequence)
    });
    // Judged by its first keyframes; the next start follows at once, not after the seconds spent on relocalising.
    assert!(first.1 - first.0 < most_frames && second.0 - first.1 < 15, "{first:?} {second:?}");
    let (wrong, right) = (error_ratio(&record, 0), error_ratio(&record, 1));
    assert!(right < 0.01 && wrong > 2.0 * right, "{wrong} {right}");
}

/// A camera that is lost, starts an epoch elsewhere and returns to the first place: the frame at which it is back
/// there, and the run.
fn separated_and_back(num_candidates: usize) -> (usize, RunRecord) {
    let motion = MotionParams { mean_turn_deg_s: 18.0, ..MotionParams::default() };
    let params = SimulatorParams { seed: 1, frames: 600, motion, ..SimulatorParams::half_size() };
    let room = film(&mut Simulator::new(params).unwrap());
    let mut script = Script::new(room.intrinsics);
    script.show(&room, 280..420);
    script.black_out(80);
    let begin = script.frames.len();
    // It looks the other way, and turns back to the first place.
    script.show(&room, 170..600);
    let mut mapper = MapperParams::default();
    mapper.loops.num_candidates = num_candidates;
    let record = script.replay(&ReplayConfig { mapper, ..ReplayConfig::default() });
    (begin + 280 - 170, record)
}

#[test]
fn an_epoch_that_sees_a_place_of_an_earlier_one_is_joined_to_it() {
    let (back, record) = separated_and_back(MapperParams::default().loops.num_candidates);
    assert!(estimates(&record).any(|e| e.epoch == 1 && e.state.is_tracked()), "none was begun");
    let searches = record.searches.as_deref().unwrap_or_default();
    let joins: Vec<u64> = searches
        .iter()
        .filter(|search| search.report.outcome == SearchOutcome::Joined)
        .map(|search| search.sequence)
        .collect();
    println!("joined at {joins:?}, back at {back}");
    assert_eq!(joins.len(), 1, "it is told once");
    assert!(record.map.keyframes.iter().all(|k| k.epoch == 0), "the older numbering stays");
    let after: Vec<_> = estimates(&record).filter(|e| e.sequence > joins[0] + 20).collect();
    assert!(after.iter().all(|e| e.epoch == 0));
    // Frames of both are in one map now; odometry has not moved.
    let placed = |e: &PoseEstimate| {
        let world_from_camera = record.map.frame_pose(e.keyframe_id, &e.keyframe_from_camera)?;
        Some(StampedPose { nanos: e.capture_nanos, world_from_camera })
    };
    let tracked = || estimates(&record).filter(|e| e.state.is_tracked());
    let poses: Vec<StampedPose> = tracked().filter_map(placed).collect();
    let truth = &record.ground_truth;
    let found = evaluate_trajectory(&poses, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
        .unwrap();
    println!("ATE {} over {} poses, path {}", found.ate.rmse, poses.len(), found.path_length);
    assert!(found.ate.rmse < 0.01 * found.path_length, "{}", found.ate.rmse);
    let of_odometry: Vec<_> =
        tracked().filter(|e| e.sequence > joins[0].saturating_sub(5)).collect();
    let steps = of_odometry.windows(2).map(|pair| {
        (pair[1].world_from_camera.translation - pair[0].world_from_camera.translation).norm()
    });
    let mut steps: Vec<f64> = steps.take(20).collect();
    steps.sort_by(f64::total_cmp);
    assert!(steps[19] < 4.0 * steps[10], "odometry jumps: {steps:?}");
    // Without the search it stays separate.
    let (_, alone) = separated_and_back(0);
    assert!(alone.map.keyframes.iter().any(|k| k.epoch == 1));
}
