//! A camera in dim light: whose grey levels are an eighth of those of an ordinary exposure.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{MotionKind, MotionParams, SimulatorParams};
use semidense::capture::source::{FrameSource, FrameStamp};
use semidense::capture::source_error::SourceError;
use semidense::service::corrected::Corrections;
use semidense::service::replay::{ReplayConfig, replay};
use semidense::service::results::record::RunRecord;
use semidense::slam::evaluation::umeyama::TrajectoryAlignment;
use semidense::slam::evaluation::{MAX_DIFFERENCE_NANOS, evaluate_trajectory};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::trajectory::StampedPose;

/// The frames of another source with an eighth of its light.
struct Dimmed<S>(S);

impl<S: FrameSource> FrameSource for Dimmed<S> {
    fn intrinsics(&self) -> Intrinsics {
        self.0.intrinsics()
    }

    fn num_frames(&self) -> Option<usize> {
        self.0.num_frames()
    }

    fn next_into(&mut self, pixels: &mut [u8]) -> Result<Option<FrameStamp>, SourceError> {
        let stamp = self.0.next_into(pixels);
        pixels.iter_mut().for_each(|grey| *grey /= 8);
        stamp
    }

    fn ground_truth(&self) -> &[StampedPose] {
        self.0.ground_truth()
    }
}

/// Frames tracked, and their ATE as a share of the path.
pub fn tracked_and_error(record: &RunRecord) -> (usize, Option<f64>) {
    let estimates = record.poses.iter().map(|pose| &pose.estimate);
    let tracked: Vec<StampedPose> = estimates
        .filter(|e| e.state.is_tracked())
        .map(|e| StampedPose { nanos: e.capture_nanos, world_from_camera: e.map_from_camera })
        .collect();
    let truth = &record.ground_truth;
    let found =
        evaluate_trajectory(&tracked, truth, TrajectoryAlignment::Sim3, MAX_DIFFERENCE_NANOS);
    (tracked.len(), found.ok().map(|found| found.ate.rmse / found.path_length))
}

/// What is tracked of a room in dim light.
fn dimly_lit(brighten: bool) -> (usize, Option<f64>) {
    let motion = MotionParams { kind: MotionKind::Handheld, ..MotionParams::default() };
    let params = SimulatorParams { frames: 150, motion, ..SimulatorParams::half_size() };
    let mut source = Dimmed(Simulator::new(params).unwrap());
    let corrections = Corrections { brighten, ..Corrections::default() };
    let config = ReplayConfig { corrections, ..ReplayConfig::default() };
    let record = replay(&mut source, "dim", &config, &mut |_| true).unwrap();
    tracked_and_error(&record)
}

#[test]
fn a_room_in_dim_light_is_tracked_as_in_ordinary_light() {
    let (tracked, error_ratio) = dimly_lit(true);
    println!(
        "{tracked} of 150 tracked, ATE {error_ratio:?} of the path; unbrightened: {:?}",
        dimly_lit(false)
    );
    assert!(tracked >= 120, "{tracked}");
    assert!(error_ratio.unwrap() < 0.005, "{error_ratio:?}");
}
