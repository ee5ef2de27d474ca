//! The two-frame start on simulated sequences: it starts where there is parallax, with the correct pose and depth, and
//! never without parallax.

use crate::recording::{recording, say};
use semidense::capture::opening::{SourceParams, open};
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{
    MotionKind, MotionParams, SensorParams, SimulatorParams,
};
use semidense::capture::simulator::scene_kind::SceneKind;
use semidense::capture::source::FrameSource;
use semidense::capture::source_name::SourceName;
use semidense::slam::evaluation::start_error::StartErrors;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::image::buffer::Image;
use semidense::slam::two_frame::evidence::EvidenceParams;
use semidense::slam::two_frame::{InitState, TwoFrameInitializer, TwoFrameParams};

/// Largest direction error of a start that is proven by earlier frames and not by a long translation, degrees: it
/// corresponds to about 2 px, and the following frames correct the map.
const EARLY_DIRECTION_DEG: f64 = 20.0;

/// Outcome of a start.
#[derive(Debug)]
struct Start {
    /// Frames from the very first one to the proof, including failed starts.
    frames: usize,
    /// Length of the translation in mean depths.
    translation: f64,
    errors: StartErrors,
}

impl Start {
    /// Median relative error of its depths, if the truth is known.
    fn depth_error(&self) -> Option<f64> {
        self.errors.depth.map(|depth| depth.relative_error_median)
    }
}

/// One frame of a source.
struct Frame {
    pixels: Vec<u8>,
    world_from_camera: SE3,
    depth: Option<Image<f32>>,
}

/// A frame of a source, with its true pose and depth; `None` after the last.
fn next(source: &mut dyn FrameSource) -> Option<Frame> {
    let camera = source.intrinsics();
    let mut pixels = vec![0; camera.width * camera.height];
    let nanos = source.next_into(&mut pixels).unwrap()?.capture_nanos;
    let nearest = source.ground_truth().iter().min_by_key(|p| p.nanos.abs_diff(nanos));
    let world_from_camera = nearest.expect("a source with ground truth").world_from_camera;
    let depth = source.depth_at(nanos).unwrap();
    Some(Frame { pixels, world_from_camera, depth })
}

/// The first start on these frames.
fn start<'a>(camera: Intrinsics, frames: impl Iterator<Item = &'a Frame>) -> Option<Start> {
    let mut initializer = TwoFrameInitializer::new(camera, TwoFrameParams::default()).unwrap();
    let (mut first, mut before) = (None, None);
    for (index, frame) in frames.enumerate() {
        let outcome = initializer.step(&frame.pixels);
        match outcome.frames {
            0 => first = Some(frame),
            1 => first = before,
            _ => {}
        }
        before = Some(frame);
        match outcome.state {
            InitState::Failed(_) | InitState::Waiting(_) => {}
            InitState::Proven => {
                let first: &Frame = first.expect("a start takes two frames");
                let truth = first.world_from_camera.inverse() * frame.world_from_camera;
                let (found, depths) = (&outcome.first_from_current, initializer.depths());
                let errors = StartErrors::of(found, depths, &camera, &truth, first.depth.as_ref());
                let translation = outcome.evidence.translation;
                return Some(Start { frames: index, translation, errors });
            }
        }
    }
    None
}

/// Up to `most` frames of a source.
fn read(source: &mut dyn FrameSource, most: usize) -> Vec<Frame> {
    std::iter::from_fn(|| next(source)).take(most).collect()
}

fn simulated(params: SimulatorParams) -> Option<Start> {
    let mut simulator = Simulator::new(params).unwrap();
    let frames = read(&mut simulator, usize::MAX);
    start(simulator.intrinsics(), frames.iter())
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
fn a_handheld_camera_starts() {
    for seed in 1..=5 {
        let start = simulated(params(MotionKind::Handheld, seed, 60, 2.0)).unwrap();
        println!("handheld {seed}: {start:.3?}");
        assert!(start.depth_error().unwrap() <= 0.1, "{seed}: {start:?}");
        assert!(start.errors.direction_deg <= allowed_deg(&start, 6.0), "{seed}: {start:?}");
    }
}

#[test]
fn a_camera_on_a_rail_starts_in_every_scene() {
    for scene in [SceneKind::Room, SceneKind::Plane, SceneKind::Corridor] {
        let params = SimulatorParams { scene, ..params(MotionKind::Straight, 2, 60, 2.0) };
        let start = simulated(params).unwrap();
        println!("rail {scene:?}: {start:.3?}");
        assert!(start.depth_error().unwrap() <= 0.1, "{scene:?}: {start:?}");
        assert!(start.errors.direction_deg <= allowed_deg(&start, 6.0), "{scene:?}: {start:?}");
    }
}

#[test]
fn a_rotating_camera_never_starts() {
    for seed in 1..=3 {
        let start = simulated(params(MotionKind::Rotation, seed, 100, 2.0));
        assert!(start.is_none(), "{seed}: {start:?}");
    }
}

/// The allowed direction error: that required of a start with enough translation.
fn allowed_deg(start: &Start, direction_deg: f64) -> f64 {
    let is_early = start.translation < EvidenceParams::default().min_translation;
    if is_early { direction_deg.max(EARLY_DIRECTION_DEG) } else { direction_deg }
}

/// Number of frames within which a start must be proven.
const PATIENCE: usize = 60;

/// Starts of a recording after each of `skips` frames, with the largest direction and depth errors that the accuracy
/// of the ground truth permits: `truth_error_m` across a baseline of some centimetres rotates its direction.
fn assert_recording_starts(
    name: &str,
    skips: &[usize],
    direction_deg: f64,
    depth: f64,
    truth_error_m: f64,
) {
    let Some(folder) = recording(name) else { return };
    let mut source = open(&SourceName::Tum(folder), None, &SourceParams::default()).unwrap();
    let most = skips.last().unwrap() + PATIENCE;
    let frames = read(source.as_mut(), most);
    for &skip in skips {
        let start = start(source.intrinsics(), frames[skip..].iter()).unwrap();
        println!("{name} from {skip}: {start:.3?}");
        let truth_deg = (truth_error_m / start.errors.baseline_m).min(1.0).asin().to_degrees();
        assert!(
            start.errors.direction_deg <= allowed_deg(&start, direction_deg) + truth_deg,
            "{name} from {skip}: {start:?}"
        );
        // If the first frame has no depth there is nothing to compare.
        assert!(
            !start.depth_error().is_some_and(|error| error > depth),
            "{name} from {skip}: {start:?}"
        );
    }
}

#[test]
fn the_recording_of_a_kitchen_starts() {
    // Depth fusion is accurate to some millimetres: over the first 10 frames it moves the camera by 9 mm, whereas
    // tracking on the depth camera gives 10 mm in a direction 37° away.
    assert_recording_starts("redkitchen", &[0, 152, 300], 10.0, 0.15, 0.006);
}

#[test]
fn the_recording_of_a_floor_starts() {
    // From the 12th frame on: a plane seen from two places has two explanations.
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

/// Number of first frames that are tried, and their distance.
const FIRST_FRAMES: usize = 12;
const APART: usize = 3;

/// Starts a recording from each of its first frames with every `stride`-th frame, prints each outcome, and returns how
/// many started and how many of these were wrong.
fn starts(name: &str, stride: usize) -> Option<(usize, usize)> {
    let folder = recording(name)?;
    let mut source = open(&SourceName::Tum(folder), None, &SourceParams::default()).unwrap();
    let frames = read(source.as_mut(), FIRST_FRAMES * APART + PATIENCE);
    let (mut started, mut wrong) = (0, 0);
    for first in (0..FIRST_FRAMES).map(|i| i * APART) {
        let rest = frames.iter().skip(first).take(PATIENCE).step_by(stride);
        let Some(Start { frames, translation, errors }) = start(source.intrinsics(), rest) else {
            say(&format!("{name} / {stride} from {first}: no start"));
            continue;
        };
        started += 1;
        wrong += usize::from(errors.is_wrong());
        let StartErrors { direction_deg, rotation_deg, depth, modes, shape, .. } = &errors;
        say(&format!(
            "{name} / {stride} from {first}: frame {frames}, moved {translation:.4}, direction {direction_deg:.1}°, \
             rotation {rotation_deg:.2}°, depth {:.3?}, shape {shape:.3?}, modes {:+.2?}{}",
            depth.map(|depth| depth.relative_error_median),
            modes.map(|modes| [modes.column, modes.row, modes.relief]),
            if errors.is_wrong() { "  WRONG" } else { "" }
        ));
    }
    Some((started, wrong))
}

const RECORDINGS: [&str; 4] = ["redkitchen", "fr1-floor", "tsukuba", "icl-office3"];

/// Over all recordings: how many of the first frames started, and how many starts were wrong.
fn all_starts(stride: usize) -> Option<(usize, usize)> {
    let found: Option<Vec<_>> = RECORDINGS.iter().map(|name| starts(name, stride)).collect();
    let sum = |(a, b): (usize, usize), (c, d): (usize, usize)| (a + c, b + d);
    let (started, wrong) = found?.into_iter().fold((0, 0), sum);
    let tried = RECORDINGS.len() * FIRST_FRAMES;
    say(&format!("one frame in {stride}: {started} of {tried} first frames start, {wrong} wrong"));
    Some((started, wrong))
}

#[test]
#[ignore = "a minute and a half with the next one; the CI runs both"]
fn no_start_from_any_first_frame_is_wrong() {
    let Some((started, wrong)) = all_starts(1) else { return };
    assert_eq!((started, wrong), (RECORDINGS.len() * FIRST_FRAMES, 0));
}

#[test]
#[ignore = "see above"]
fn no_start_is_wrong_where_two_of_three_frames_are_skipped() {
    let Some((started, wrong)) = all_starts(3) else { return };
    assert!(started >= 46 && wrong == 0, "{started} started, {wrong} wrong");
}
