//! Depth of every keyframe compared with exact truth, in simulated rooms with exact and with estimated poses, and in a
//! rendered office: its bias, its tilt and its relief. The median error hides errors common to a keyframe, and poses
//! absorb them. Their current size is in the table `tests/figures.toml`.

use crate::figures::{Figure, hold};
use crate::recording::recording;
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::service::replay::{PoseOrigin, ReplayConfig, replay};
use semidense::slam::evaluation::depth_error::{DepthErrors, DepthScale};
use semidense::slam::evaluation::depth_modes::DepthModes;
use semidense::slam::kernel::SimdMode;

/// Frames of a room.
const FRAMES: usize = 150;

/// Shares of the pixels within 1, 2 and 3 σ below which depth is overconfident, and above which it is underconfident.
const MIN_COVERAGE: [f64; 3] = [0.55, 0.85, 0.90];
const MAX_COVERAGE: [f64; 3] = [0.80, 0.98, 1.0];

/// The common errors of each keyframe's depth, and the depth errors of all.
struct Outcome {
    modes: Vec<DepthModes>,
    errors: DepthErrors,
}

/// Portable arithmetic gives the same bits on every machine.
fn config(poses: PoseOrigin) -> ReplayConfig {
    let mut config = ReplayConfig { poses, ..ReplayConfig::default() };
    config.tracker.alignment.simd = SimdMode::Portable;
    config
}

fn room(seed: u64, poses: PoseOrigin) -> Outcome {
    let params = SimulatorParams { seed, frames: FRAMES, ..SimulatorParams::half_size() };
    outcome(&mut Simulator::new(params).unwrap(), &format!("room {seed}, {poses:?}"), poses)
}

/// The depth of all keyframes of a source.
fn outcome(source: &mut dyn FrameSource, name: &str, poses: PoseOrigin) -> Outcome {
    let record = replay(source, name, &config(poses), &mut |_| true).unwrap();
    let (mut modes, mut errors) = (Vec::new(), DepthErrors::default());
    for keyframe in record.map.keyframes.iter().filter(|keyframe| !keyframe.points.is_empty()) {
        let truth = source.depth_at(keyframe.capture_nanos).unwrap().unwrap();
        errors.add(keyframe, &truth, record.depth_scale);
        // Estimated poses have no metric unit: only differences within a keyframe can be judged.
        let unit = match record.depth_scale {
            DepthScale::Given => keyframe.map_from_keyframe.scale,
            DepthScale::MedianRatio => 1.0,
        };
        let found = DepthModes::of(keyframe, &truth, unit).unwrap();
        println!("{name}, frame {}: {found:?}", keyframe.sequence);
        modes.push(found);
    }
    Outcome { modes, errors }
}

/// One of the modes.
type Mode = fn(&DepthModes) -> f64;

/// The largest magnitude of a mode over all keyframes, and its mean.
fn worst_and_mean(outcomes: &[Outcome], mode: Mode) -> (f64, f64) {
    let all: Vec<f64> = outcomes.iter().flat_map(|o| o.modes.iter().map(mode)).collect();
    let worst = all.iter().fold(0.0, |worst: f64, mode| worst.max(mode.abs()));
    (worst, all.iter().sum::<f64>() / all.len() as f64)
}

/// Worst and mean tilt and relief over all keyframes.
fn mode_figures(outcomes: &[Outcome], slack: f64) -> Vec<Figure> {
    let modes: [(&str, &str, Mode); 3] = [
        ("column_worst", "column_mean", |m| m.column),
        ("row_worst", "row_mean", |m| m.row),
        ("relief_worst", "relief_mean", |m| m.relief),
    ];
    let figures = modes.into_iter().flat_map(|(worst_name, mean_name, mode)| {
        let (worst, mean) = worst_and_mean(outcomes, mode);
        [Figure::new(worst_name, worst, slack), Figure::new(mean_name, mean, slack)]
    });
    figures.collect()
}

/// Checks the shares within 1, 2 and 3 σ against bounds.
fn assert_coverage(outcomes: &[Outcome], least: [f64; 3], most: [f64; 3]) {
    for outcome in outcomes {
        let coverage = outcome.errors.statistics().unwrap().coverage;
        println!("within 1, 2, 3 sigma: {coverage:.3?}");
        for ((share, least), most) in coverage.into_iter().zip(least).zip(most) {
            assert!((least..=most).contains(&share), "within 1, 2, 3 sigma: {coverage:?}");
        }
    }
}

#[test]
fn with_exact_poses_depth_has_no_bias_no_tilt_and_keeps_its_relief() {
    let outcomes = [1, 2, 3].map(|seed| room(seed, PoseOrigin::GroundTruth));
    assert_coverage(&outcomes, MIN_COVERAGE, MAX_COVERAGE);
    let (worst, mean) = worst_and_mean(&outcomes, |m| m.scale);
    let mut figures = mode_figures(&outcomes, 0.001);
    figures.push(Figure::new("bias_worst", worst, 0.0002));
    figures.push(Figure::new("bias_mean", mean, 0.0002));
    hold("rooms-exact-poses", &figures);
}

#[test]
fn with_estimated_poses_depth_is_hardly_tilted_and_keeps_its_relief() {
    let outcomes = [1, 2, 3].map(|seed| room(seed, PoseOrigin::Tracker));
    hold("rooms-own-poses", &mode_figures(&outcomes, 0.005));
    // Half as many pixels as the rooms for which the line noise was chosen.
    assert_coverage(&outcomes, MIN_COVERAGE, [0.86, 0.98, 1.0]);
}

#[test]
fn the_rendered_office_keeps_its_relief_from_the_start_to_the_end() {
    let Some(folder) = recording("icl-office3") else { return };
    let mut source = open(&SourceName::Tum(folder), None, &SourceParams::default()).unwrap();
    let outcomes = [outcome(source.as_mut(), "office", PoseOrigin::Tracker)];
    let modes = &outcomes[0].modes;
    let mut figures = mode_figures(&outcomes, 0.005);
    figures.push(Figure::count("keyframes", modes.len() as f64, 1.0));
    figures.push(Figure::new("relief_first", modes[0].relief, 0.005));
    figures.push(Figure::new("relief_last", modes[modes.len() - 1].relief, 0.005));
    hold("icl-office3-depth", &figures);
}
