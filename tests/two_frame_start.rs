//! The two-frame start on simulated sequences: it starts where there is parallax, with the right pose
//! and depth, and never where there is none.

use std::path::PathBuf;

use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{
    MotionKind, MotionParams, SceneKind, SensorParams, SimulatorParams,
};
use semidense::capture::source::{FrameSource, SourceName, SourceParams, open};
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::buffer::Image;
use semidense::slam::two_frame::evidence::EvidenceParams;
use semidense::slam::two_frame::{InitOutcome, InitState, TwoFrameInitializer, TwoFrameParams};

/// Largest error of the direction of a start that is proven by earlier frames and not by a long
/// translation, degrees: it is of some 2 px, and its map is mended by the frames that follow.
const EARLY_DIRECTION_DEG: f64 = 20.0;

/// What a start came to.
#[derive(Debug)]
#[allow(dead_code, reason = "printed as a whole")]
struct Start {
    /// Frames it took, failed starts included.
    frames: usize,
    /// Length of the translation in mean depths.
    translation: f64,
    /// True length of the translation, metres.
    baseline_m: f64,
    direction_error_deg: f64,
    rotation_error_deg: f64,
    median_depth_error: f64,
    /// Share of the points whose depth is right within two standard deviations.
    within_two_sigmas: f64,
}

/// The ground truth nearest to a stamp.
fn pose_at(source: &dyn FrameSource, nanos: i64) -> SE3 {
    let nearest = source.ground_truth().iter().min_by_key(|p| p.nanos.abs_diff(nanos));
    nearest.expect("a source with ground truth").world_from_camera
}

/// The first start on a source after its first `skip` frames.
fn start(source: &mut dyn FrameSource, skip: usize) -> Option<Start> {
    let intrinsics = source.intrinsics();
    let mut initializer = TwoFrameInitializer::new(intrinsics, TwoFrameParams::default()).unwrap();
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    let mut first = None;
    let mut tried = 0;
    while let Some(stamp) = source.next_into(&mut pixels).unwrap() {
        if (stamp.sequence as usize) < skip {
            continue;
        }
        let outcome = initializer.step(&pixels);
        tried += 1;
        let nanos = stamp.capture_nanos;
        match outcome.state {
            InitState::Failed(_) => first = Some(nanos),
            InitState::Waiting(_) => first = first.or(Some(nanos)),
            InitState::Proven => {
                let first = first.expect("a start takes two frames");
                let truth = pose_at(source, first).inverse() * pose_at(source, nanos);
                let depth = source.depth_at(first).unwrap();
                return Some(figures(&initializer, outcome, &truth, depth, tried));
            }
        }
    }
    None
}

fn figures(
    initializer: &TwoFrameInitializer,
    outcome: InitOutcome,
    truth: &SE3,
    depth: Option<Image<f32>>,
    frames: usize,
) -> Start {
    let found = outcome.first_from_current;
    let cosine = found.translation.normalize().dot(&truth.translation.normalize());
    let mut start = Start {
        frames,
        direction_error_deg: cosine.clamp(-1.0, 1.0).acos().to_degrees(),
        rotation_error_deg: found.rotation.angle_to(&truth.rotation).to_degrees(),
        translation: outcome.evidence.translation,
        baseline_m: truth.translation.norm(),
        median_depth_error: f64::NAN,
        within_two_sigmas: f64::NAN,
    };
    let Some(depth) = depth else { return start };
    let known = |z: &f64| *z > 0.0;
    let mut scaled: Vec<(f64, f64)> = initializer
        .depths()
        .map(|d| (d, f64::from(depth.at(usize::from(d.u), usize::from(d.v)))))
        .filter(|(_, z)| known(z))
        .map(|(d, z)| (f64::from(d.inverse_depth) * z, f64::from(d.variance.sqrt()) * z))
        .collect();
    scaled.sort_by(|a, b| a.0.total_cmp(&b.0));
    let scale = scaled[scaled.len() / 2].0;
    let within = scaled.iter().filter(|(product, sigma)| (product - scale).abs() < 2.0 * sigma);
    start.within_two_sigmas = within.count() as f64 / scaled.len() as f64;
    let mut errors: Vec<f64> =
        scaled.iter().map(|(product, _)| (scale / product - 1.0).abs()).collect();
    errors.sort_by(f64::total_cmp);
    start.median_depth_error = errors[errors.len() / 2];
    start
}

fn simulated(params: SimulatorParams) -> Option<Start> {
    start(&mut Simulator::new(params).unwrap(), 0)
}

fn params(kind: MotionKind, seed: u64, frames: usize, noise_std_dev: f64) -> SimulatorParams {
    SimulatorParams {
        seed,
        frames,
        motion: MotionParams { kind, ..MotionParams::default() },
        sensor: SensorParams { noise_std_dev, ..SensorParams::default() },
        ..SimulatorParams::half_size()
    }
}

#[test]
fn a_hand_held_camera_starts() {
    for seed in 1..=5 {
        let start = simulated(params(MotionKind::Handheld, seed, 60, 2.0)).unwrap();
        println!("handheld {seed}: {start:.3?}");
        assert!(start.median_depth_error <= 0.1, "{seed}: {start:?}");
        assert!(start.direction_error_deg <= allowed_deg(&start, 6.0), "{seed}: {start:?}");
    }
}

#[test]
fn a_camera_on_a_rail_starts_in_every_scene() {
    for scene in [SceneKind::Room, SceneKind::Plane, SceneKind::Corridor] {
        let params = SimulatorParams { scene, ..params(MotionKind::Straight, 2, 60, 2.0) };
        let start = simulated(params).unwrap();
        println!("rail {scene:?}: {start:.3?}");
        assert!(start.median_depth_error <= 0.1, "{scene:?}: {start:?}");
        assert!(start.direction_error_deg <= allowed_deg(&start, 6.0), "{scene:?}: {start:?}");
    }
}

#[test]
fn a_standing_camera_never_starts() {
    for (seed, noise_std_dev) in [(1, 2.0), (2, 4.0)] {
        let start = simulated(params(MotionKind::Standing, seed, 200, noise_std_dev));
        assert!(start.is_none(), "{seed}: {start:?}");
    }
}

#[test]
fn a_turning_camera_never_starts() {
    for seed in 1..=3 {
        let start = simulated(params(MotionKind::Rotation, seed, 100, 2.0));
        assert!(start.is_none(), "{seed}: {start:?}");
    }
}

/// The error of the direction that is allowed: what is asked of a start with enough translation.
fn allowed_deg(start: &Start, direction_deg: f64) -> f64 {
    let is_early = start.translation < EvidenceParams::default().min_translation;
    if is_early { direction_deg.max(EARLY_DIRECTION_DEG) } else { direction_deg }
}

/// The folder of a development recording; `None`, and a word about it, where it is not there.
fn recording(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SEMIDENSE_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let folder = root.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: {} is not there; SEMIDENSE_DATA names its parent", folder.display());
    None
}

/// Starts of a recording after so many frames, with the largest error of direction and depth that the
/// ground truth lets us ask for: `truth_error_m` across a baseline of some centimetres turns its direction.
fn assert_recording_starts(
    name: &str,
    skips: &[usize],
    direction_deg: f64,
    depth: f64,
    truth_error_m: f64,
) {
    let Some(folder) = recording(name) else { return };
    for &skip in skips {
        let mut source =
            open(&SourceName::Tum(folder.clone()), None, &SourceParams::default()).unwrap();
        let start = start(source.as_mut(), skip).unwrap();
        println!("{name} from {skip}: {start:.3?}");
        let truth_deg = (truth_error_m / start.baseline_m).min(1.0).asin().to_degrees();
        assert!(
            start.direction_error_deg <= allowed_deg(&start, direction_deg) + truth_deg,
            "{name} from {skip}: {start:?}"
        );
        // Where the first frame has no depth there is nothing to compare.
        assert!(!(start.median_depth_error > depth), "{name} from {skip}: {start:?}");
    }
}

#[test]
fn the_recording_of_a_kitchen_starts() {
    // Depth fusion places the camera within some millimetres: over the first 10 frames it moves it by 9 mm, and
    // tracking against the depth camera says 10 mm in a direction 37° off.
    assert_recording_starts("redkitchen", &[0, 152, 300], 10.0, 0.15, 0.006);
}

#[test]
fn the_recording_of_a_floor_starts() {
    // From the 12th frame on a plane seen from two places has two explanations.
    assert_recording_starts("fr1-floor", &[0, 12, 20, 40], 10.0, 0.1, 0.0);
}

#[test]
fn the_rendered_office_starts() {
    assert_recording_starts("icl-office3", &[0, 20, 40], 5.0, 0.1, 0.0);
}

#[test]
fn the_rendered_desk_starts() {
    assert_recording_starts("tsukuba", &[0, 40, 80], 5.0, 0.1, 0.0);
}
