//! A camera that moves back and forth: keyframes that it returns to are reused, so that the map does not grow and the
//! poses do not degrade.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{MotionKind, MotionParams, SimulatorParams};
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
use semidense::slam::mapper::MapperParams;
use semidense::slam::mapper::reuse::ReuseParams;
use semidense::slam::trajectory::StampedPose;

/// Frames of the sequence: back and forth twice.
const FRAMES: usize = 420;

struct Outcome {
    record: RunRecord,
    /// Number of reused keyframes.
    restored: usize,
    ate: f64,
}

fn back_and_forth(max_distance: f64) -> Outcome {
    let motion = MotionParams { kind: MotionKind::Straight, ..MotionParams::default() };
    let params = SimulatorParams { frames: FRAMES, motion, ..SimulatorParams::half_size() };
    let mut simulator = Simulator::new(params).unwrap();
    let reuse = ReuseParams { max_distance, ..ReuseParams::default() };
    let mapper = MapperParams { reuse, ..MapperParams::default() };
    let config = ReplayConfig { mapper, ..ReplayConfig::default() };
    let mut restored = 0;
    let record = replay(&mut simulator, "back and forth", &config, &mut |progress| {
        restored += usize::from(progress.outcome.keyframe_restored);
        true
    })
    .unwrap();
    let poses: Vec<StampedPose> = record
        .poses
        .iter()
        .filter(|p| p.estimate.state.is_tracked())
        .map(|p| StampedPose {
            nanos: p.estimate.capture_nanos,
            world_from_camera: p.estimate.world_from_camera,
        })
        .collect();
    assert!(poses.len() * 10 > FRAMES * 9, "{} tracked", poses.len());
    let truth = &record.ground_truth;
    let evaluation =
        evaluate_trajectory(&poses, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
            .unwrap();
    let (keyframes, ate) = (record.map.keyframes.len(), evaluation.ate.rmse);
    println!("max_distance {max_distance}: {keyframes} keyframes, {restored} restored, ATE {ate}");
    Outcome { record, restored, ate }
}

#[test]
fn moving_back_and_forth_does_not_grow_the_map() {
    let without = back_and_forth(0.0);
    let with = back_and_forth(ReuseParams::default().max_distance);
    assert_eq!(without.restored, 0);
    let (many, few) = (without.record.map.keyframes.len(), with.record.map.keyframes.len());
    assert!(few * 2 <= many, "{few} keyframes instead of {many}");
    assert!(with.restored + few >= many / 2, "{} taken up again", with.restored);
    assert!(with.ate <= 1.1 * without.ate, "{} instead of {}", with.ate, without.ate);
}
