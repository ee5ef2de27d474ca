//! What a real camera adds to the picture: changes of exposure, vignette, noise, motion blur. With all
//! of it the simulated room is still tracked without a loss, at less than twice the error.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{SensorParams, SimulatorParams};
use semidense::capture::source::FrameSource;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::RunRecord;
use semidense::slam::evaluation::umeyama::Alignment;
use semidense::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
use semidense::slam::pose::TrackingState;
use semidense::slam::trajectory::StampedPose;

/// Half a second may pass until the map begins; frames between that and the end.
const FRAMES: usize = 200;

/// Trajectory of the final map against the truth, share of the path; frames lost and tracked.
struct Outcome {
    ate_per_path: f64,
    lost: usize,
    tracked: usize,
}

fn outcome(seed: u64, sensor: &SensorParams) -> Outcome {
    let params = SimulatorParams {
        seed,
        frames: FRAMES,
        width: 320,
        height: 240,
        focal_px: 262.5,
        sensor: sensor.clone(),
        ..SimulatorParams::default()
    };
    let mut source = Simulator::new(params).unwrap();
    source.prepare(&mut |_, _| true).unwrap();
    let record = replay(&mut source, "sim", &ReplayConfig::default(), &mut |_| true).unwrap();
    let truth = source.ground_truth();
    let estimate = trajectory(&record);
    let evaluation =
        evaluate_trajectory(&estimate, truth, Alignment::Sim3, MAX_DIFFERENCE_NANOS).unwrap();
    let is_lost = |state: TrackingState| matches!(state, TrackingState::Lost(_));
    Outcome {
        ate_per_path: evaluation.ate.rmse / evaluation.path_length,
        lost: record.poses.iter().filter(|pose| is_lost(pose.estimate.state)).count(),
        tracked: estimate.len(),
    }
}

/// The claimed poses as they were published.
fn trajectory(record: &RunRecord) -> Vec<StampedPose> {
    let poses = record.poses.iter().map(|pose| pose.estimate);
    let tracked = poses.filter(|pose| pose.state.is_tracked());
    let stamped = tracked.map(|pose| StampedPose {
        nanos: pose.capture_nanos,
        world_from_camera: pose.world_from_camera,
    });
    stamped.collect()
}

/// Median error over the seeds; no loss in any.
fn median_error(name: &str, sensor: &SensorParams) -> f64 {
    let mut errors = Vec::new();
    for seed in 1..=3 {
        let Outcome { ate_per_path, lost, tracked } = outcome(seed, sensor);
        println!(
            "{name}, seed {seed}: ATE {:.3} % of the path, {tracked} tracked, {lost} lost",
            100.0 * ate_per_path
        );
        errors.push(ate_per_path);
    }
    errors.sort_by(f64::total_cmp);
    println!("{name}: median {:.3} %", 100.0 * errors[1]);
    errors[1]
}

#[test]
fn effects_of_a_camera_do_not_double_the_error() {
    let clean = SensorParams { noise_std_dev: 0.0, ..SensorParams::default() };
    let noise = SensorParams { noise_std_dev: 3.0, ..clean.clone() };
    let exposure = SensorParams { gain_amplitude: 0.25, offset_amplitude: 8.0, ..clean.clone() };
    let vignette = SensorParams { vignette: 0.3, ..clean.clone() };
    let blur = SensorParams { exposure_ms: 10.0, ..clean.clone() };
    let shutter = SensorParams { row_time_us: 60.0, ..clean.clone() };
    let all = SensorParams {
        noise_std_dev: 3.0,
        gain_amplitude: 0.25,
        offset_amplitude: 8.0,
        vignette: 0.3,
        exposure_ms: 10.0,
        ..clean.clone()
    };
    for (name, sensor) in [
        ("clean", &clean),
        ("default noise", &SensorParams::default()),
        ("noise", &noise),
        ("exposure", &exposure),
        ("vignette", &vignette),
        ("blur", &blur),
        ("all", &all),
        ("rolling shutter", &shutter),
    ] {
        median_error(name, sensor);
    }
}
