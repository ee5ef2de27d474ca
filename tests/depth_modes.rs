//! Depth of every keyframe of simulated rooms against exact truth: its bias, its tilt and its relief, with exact
//! poses and with the program's own. The median error hides what is common to a keyframe, and poses absorb it.

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::SimulatorParams;
use semidense::capture::source::FrameSource;
use semidense::service::replay::{PoseOrigin, ReplayConfig, replay};
use semidense::slam::evaluation::depth_error::{DepthErrors, DepthScale};
use semidense::slam::evaluation::depth_modes::DepthModes;

/// Half the size of the default room's images: the same field of view at a quarter of the time.
const FRAMES: usize = 150;

/// Relative depth error for each unit of the ray along columns and rows, and of ln d, in the worst keyframe: a
/// fifth above what is measured. The same of the mean over all keyframes of one mode.
const EXACT_WORST: [f64; 3] = [0.0035, 0.0035, 0.0076];
const EXACT_MEAN: f64 = 0.0034;
const OWN_WORST: [f64; 3] = [0.038, 0.049, 0.074];
const OWN_MEAN: f64 = 0.029;
/// Relative depth error of a whole keyframe, of poses in metres.
const EXACT_WORST_BIAS: f64 = 0.0008;
/// Shares of the pixels within 1, 2 and 3 σ below which depth is over-sure, and above which it is over-cautious.
const LEAST_COVERAGE: [f64; 3] = [0.55, 0.85, 0.90];
const MOST_COVERAGE: [f64; 3] = [0.80, 0.98, 1.0];

/// What is common to a keyframe's depth, by keyframe, and the depth errors of all.
struct Outcome {
    modes: Vec<DepthModes>,
    errors: DepthErrors,
}

fn room(seed: u64, poses: PoseOrigin) -> Outcome {
    let params = SimulatorParams { seed, frames: FRAMES, ..SimulatorParams::half_size() };
    let mut simulator = Simulator::new(params).unwrap();
    let config = ReplayConfig { poses, ..ReplayConfig::default() };
    let record = replay(&mut simulator, "room", &config, &mut |_| true).unwrap();
    let (mut modes, mut errors) = (Vec::new(), DepthErrors::default());
    for keyframe in record.map.keyframes.iter().filter(|keyframe| !keyframe.points.is_empty()) {
        let truth = simulator.depth_at(keyframe.capture_nanos).unwrap().unwrap();
        errors.add(keyframe, &truth, record.depth_scale);
        // The unit of estimated poses is not metres: only what differs within a keyframe can be judged.
        let unit = match record.depth_scale {
            DepthScale::Given => keyframe.map_from_keyframe.scale,
            DepthScale::MedianRatio => 1.0,
        };
        let found = DepthModes::of(keyframe, &truth, unit).unwrap();
        println!("seed {seed}, {poses:?}, frame {}: {found:?}", keyframe.sequence);
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

/// Prints and holds every keyframe's modes, and their means, to bounds.
fn assert_modes(outcomes: &[Outcome], worst_bounds: [f64; 3], mean_bound: f64) {
    let modes: [(&str, Mode); 3] =
        [("column", |m| m.column), ("row", |m| m.row), ("relief", |m| m.relief)];
    for ((name, mode), bound) in modes.into_iter().zip(worst_bounds) {
        let (worst, mean) = worst_and_mean(outcomes, mode);
        println!("{name}: worst {worst:.4}, mean {mean:.4}");
        assert!(worst <= bound, "{name} of a keyframe: {worst}");
        assert!(mean.abs() <= mean_bound, "{name} in the mean: {mean}");
    }
}

/// Holds the shares within 1, 2 and 3 σ to bounds.
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
fn with_exact_poses_depth_has_no_bias_no_tilt_and_its_relief() {
    let outcomes = [1, 2, 3].map(|seed| room(seed, PoseOrigin::GroundTruth));
    assert_modes(&outcomes, EXACT_WORST, EXACT_MEAN);
    assert_coverage(&outcomes, LEAST_COVERAGE, MOST_COVERAGE);
    let (worst, mean) = worst_and_mean(&outcomes, |m| m.scale);
    println!("bias: worst {worst:.4}, mean {mean:.4}");
    assert!(worst <= EXACT_WORST_BIAS && mean.abs() <= EXACT_MEAN, "{worst} {mean}");
}

#[test]
fn with_own_poses_depth_is_hardly_tilted_and_keeps_its_relief() {
    let outcomes = [1, 2, 3].map(|seed| room(seed, PoseOrigin::Tracker));
    assert_modes(&outcomes, OWN_WORST, OWN_MEAN);
    // The noise of lines that serves real cameras is too much for a simulated one.
    assert_coverage(&outcomes, LEAST_COVERAGE, [1.0; 3]);
}
