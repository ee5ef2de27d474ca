//! Effects of a real camera on the image: changes of exposure, noise, motion blur. With all of them the simulated room
//! is still tracked without a loss, at less than twice the error. A rolling shutter is undone. The cost of each effect
//! alone is printed by `cargo test --release --test estimation camera_effects -- --ignored --nocapture`.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{MotionParams, SensorParams, SimulatorParams};
use semidense::capture::source::FrameSource;
use semidense::service::corrected::Corrections;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
use semidense::slam::pose::TrackingState;
use semidense::slam::trajectory::StampedPose;

/// Half a second may pass until the map starts; frames from then to the end.
const FRAMES: usize = 200;
/// Seeds of the rooms, whose median error is taken: single errors differ by a factor of five.
const SEEDS: std::ops::RangeInclusive<u64> = 1..=5;

/// Error of the final map's trajectory relative to the path; frames lost and tracked.
struct Outcome {
    ate_per_path: f64,
    lost: usize,
    tracked: usize,
}

fn outcome(
    seed: u64,
    sensor: &SensorParams,
    motion: &MotionParams,
    config: &ReplayConfig,
) -> Outcome {
    let params = SimulatorParams {
        seed,
        frames: FRAMES,
        sensor: sensor.clone(),
        motion: motion.clone(),
        ..SimulatorParams::half_size()
    };
    let mut source = Simulator::new(params).unwrap();
    source.prepare(&mut |_, _| true).unwrap();
    let record = replay(&mut source, "sim", config, &mut |_| true).unwrap();
    let truth = source.ground_truth();
    let estimate = trajectory(&record);
    let evaluation =
        evaluate_trajectory(&estimate, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS)
            .unwrap();
    let is_lost = |state: TrackingState| matches!(state, TrackingState::Lost(_));
    Outcome {
        ate_per_path: evaluation.ate.rmse / evaluation.path_length,
        lost: record.poses.iter().filter(|pose| is_lost(pose.estimate.state)).count(),
        tracked: estimate.len(),
    }
}

/// The claimed poses as published.
fn trajectory(record: &RunRecord) -> Vec<StampedPose> {
    let poses = record.poses.iter().map(|pose| pose.estimate);
    let tracked = poses.filter(|pose| pose.state.is_tracked());
    let stamped = tracked.map(|pose| StampedPose {
        nanos: pose.capture_nanos,
        world_from_camera: pose.world_from_camera,
    });
    stamped.collect()
}

/// Median error over the seeds, none of which may have a loss.
fn median_error(name: &str, sensor: &SensorParams) -> f64 {
    let (motion, config) = (MotionParams::default(), ReplayConfig::default());
    let mut errors = Vec::new();
    for seed in SEEDS {
        let Outcome { ate_per_path, lost, tracked } = outcome(seed, sensor, &motion, &config);
        let percent = 100.0 * ate_per_path;
        println!(
            "{name}, seed {seed}: ATE {percent:.3} % of the path, {tracked} tracked, {lost} lost"
        );
        assert_eq!(lost, 0, "{name}, seed {seed}");
        assert!(tracked > FRAMES * 9 / 10, "{name}, seed {seed}: {tracked} of {FRAMES} frames");
        errors.push(ate_per_path);
    }
    errors.sort_by(f64::total_cmp);
    let median = errors[errors.len() / 2];
    println!("{name}: median {:.3} %", 100.0 * median);
    median
}

/// Each effect as strong as in a room with a cheap camera: one and a half times the usual noise, an exposure that
/// varies by a third in either direction, 10 ms of blur.
fn effects() -> SensorParams {
    SensorParams {
        noise_std_dev: 3.0,
        gain_amplitude: 0.25,
        offset_amplitude: 8.0,
        exposure_ms: 10.0,
        ..SensorParams::default()
    }
}

#[test]
fn camera_effects_do_not_double_the_error() {
    let clean = median_error("without", &SensorParams::default());
    let all = median_error("with all", &effects());
    assert!(all < 2.0 * clean, "{all} with effects, {clean} without");
}

#[test]
fn a_rolling_shutter_is_undone() {
    // Read out in 29 ms of 33, by a hand that turns.
    let motion = MotionParams { mean_turn_deg_s: 40.0, tremor: 2.0, ..MotionParams::default() };
    let sensor = SensorParams { row_time_us: 120.0, ..SensorParams::default() };
    let error = |corrections: Corrections| {
        let config = ReplayConfig { corrections, ..ReplayConfig::default() };
        let mut errors = [1, 2, 3].map(|seed| outcome(seed, &sensor, &motion, &config));
        errors.sort_by(|one, other| one.ate_per_path.total_cmp(&other.ate_per_path));
        println!("{:.3} % of the path", 100.0 * errors[1].ate_per_path);
        errors[1].ate_per_path
    };
    let undone = error(Corrections::default());
    let left = error(Corrections { readout_s: Some(0.0), ..Corrections::default() });
    assert!(left > 4.0 * undone, "{left} left, {undone} undone");
}

#[test]
#[ignore = "says what each effect costs"]
fn each_effect_alone() {
    let (usual, all) = (SensorParams::default(), effects());
    let (noise, exposure) = (all.noise_std_dev, all.exposure_ms);
    let gain = (all.gain_amplitude, all.offset_amplitude);
    for (name, sensor) in [
        ("noise", SensorParams { noise_std_dev: noise, ..usual.clone() }),
        (
            "gain",
            SensorParams { gain_amplitude: gain.0, offset_amplitude: gain.1, ..usual.clone() },
        ),
        // A third less light in the corners.
        ("vignette", SensorParams { vignette: 0.3, ..usual.clone() }),
        ("blur", SensorParams { exposure_ms: exposure, ..usual.clone() }),
        ("rolling shutter", SensorParams { row_time_us: 120.0, ..usual.clone() }),
    ] {
        median_error(name, &sensor);
    }
}
