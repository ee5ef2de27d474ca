//! Estimates that are fast, slow, late, for another map, or that panic.

use std::sync::mpsc::{Receiver, Sender, channel};

use super::*;
use crate::service::checkpoint::{Kept, read_checkpoint};
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::DepthPoint;
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane};
use crate::slam::mapper::MapperParams;
use crate::slam::pose::{PoseEstimate, TrackingState};
use crate::slam::test_scene::{CAMERA, Scene};

/// Frames between two keyframes.
pub(in crate::service) const KEYFRAME_INTERVAL: u64 = 4;

/// A camera moving sideways, with exact poses, depth for its first keyframe, and a keyframe every fourth frame.
pub(in crate::service) struct Walk {
    scene: Scene,
    pub(in crate::service) mapper: Mapper,
    keeps_keyframe: bool,
    pub(super) frames: u64,
}

impl Walk {
    pub(in crate::service) fn new() -> Self {
        Self::with(MapperParams::default())
    }

    pub(super) fn with(params: MapperParams) -> Self {
        let mapper = Mapper::new(CAMERA, params).unwrap();
        Self { scene: Scene::new(3), mapper, keeps_keyframe: false, frames: 0 }
    }

    /// Maps the next frame, without the joint estimation that follows it.
    pub(in crate::service) fn step(&mut self) -> StepOutcome {
        let k = self.frames;
        self.frames += 1;
        let x = 0.06 * k as f64;
        let world_from_camera = SE3 { translation: [x, 0.0, 0.0].into(), ..SE3::identity() };
        let view = self.scene.render(&CAMERA, &world_from_camera);
        let mut depth = view.inverse_depth.clone();
        depth.pixels_mut().iter_mut().for_each(|d| *d = 1.0 / *d);
        let pixels = view.noisy(1.0, k);
        let frame = FrameView::new(&CAMERA, k, k as i64 * 33_333_333, &pixels);
        let active = self.mapper.keyframe();
        let pose = PoseEstimate {
            state: TrackingState::Tracking,
            keyframe_id: active.map_or(u64::MAX, |k| k.keyframe_id),
            world_from_camera,
            keyframe_from_camera: active.map_or(SE3::identity(), |k| {
                k.world_from_keyframe.inverse_transform_pose(&world_from_camera)
            }),
            proposes_keyframe: !self.keeps_keyframe && k > 0 && k.is_multiple_of(KEYFRAME_INTERVAL),
            ..PoseEstimate::unknown(&frame)
        };
        let outcome = self.mapper.step(&frame, &pose, (k == 0).then_some(&depth), &mut || {});
        self.mapper.finish_keyframe();
        outcome
    }

    /// From now on the camera sees another scene, whatever its poses say, and stays on its keyframe.
    pub(super) fn replace_scene(&mut self, seed: u64) {
        (self.scene, self.keeps_keyframe) = (Scene::new(seed), true);
    }

    /// Maps the next frame; returns the outcome of the joint estimation.
    pub(super) fn go(&mut self, adjustments: &mut Adjustments) -> StepOutcome {
        let sequence = self.frames;
        self.step();
        adjustments.after_frame(&mut self.mapper, sequence)
    }

    /// Relative errors of a keyframe's depth.
    pub(super) fn depth_errors(&self, keyframe_id: u64) -> Vec<f64> {
        let keyframe = self.mapper.map().get(keyframe_id).unwrap();
        let place = keyframe.map_from_keyframe;
        let truth = self.scene.render(&CAMERA, &place.rigid).inverse_depth;
        let error = |point: &DepthPoint| {
            let exact = truth.at(usize::from(point.u), usize::from(point.v));
            (f64::from(point.inverse_depth) / place.scale / f64::from(exact)).ln().abs()
        };
        keyframe.points.iter().map(error).collect()
    }

    fn places(&self) -> Vec<[f64; 4]> {
        let keyframes = self.mapper.map().keyframes.iter();
        let place =
            keyframes.map(|k| (k.map_from_keyframe.rigid.translation, k.map_from_keyframe.scale));
        place.map(|(at, scale)| [at.x, at.y, at.z, scale]).collect()
    }
}

pub(super) fn start(entry: Entry, optimise: Optimise) -> Adjustments {
    Adjustments::start_with(entry, Background::Other, optimise).unwrap()
}

/// An optimisation that waits until it is released, and the sender that releases it.
fn held() -> (Optimise, Sender<()>) {
    let (let_go, wait): (Sender<()>, Receiver<()>) = channel();
    let optimise = move |window: &mut Window| {
        wait.recv().unwrap();
        window.optimise()
    };
    (Box::new(optimise), let_go)
}

pub(super) fn until(mut holds: impl FnMut() -> bool) {
    let start = Instant::now();
    while !holds() {
        assert!(start.elapsed() < Duration::from_secs(60), "waited in vain");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn an_estimate_enters_at_its_frame_however_long_it_took() {
    let run = |pause: Duration| {
        let optimise = move |window: &mut Window| {
            std::thread::sleep(pause);
            window.optimise()
        };
        let mut adjustments = start(Entry::AfterFrames(2), Box::new(optimise));
        let mut walk = Walk::new();
        let mut records = Vec::new();
        for _ in 0..14 {
            walk.go(&mut adjustments);
            // Gives a fast thread the time to finish.
            std::thread::sleep(Duration::from_millis(20));
            records.extend(adjustments.take_records());
        }
        let entered: Vec<(u64, u64, Fate)> =
            records.iter().map(|r| (r.sequence, r.frames, r.fate)).collect();
        (entered, walk.places())
    };
    let (fast, slow) = (run(Duration::ZERO), run(Duration::from_millis(60)));
    let expected = [4, 8].map(|keyframe| (keyframe + 2, 2, Fate::Entered));
    assert_eq!(fast.0, expected);
    assert_eq!(fast, slow);
}

#[test]
fn with_no_delay_an_estimate_enters_with_its_own_frame() {
    let mut adjustments = start(Entry::AfterFrames(0), Box::new(Window::optimise));
    let mut walk = Walk::new();
    let outcomes: Vec<bool> = (0..6).map(|_| walk.go(&mut adjustments).keyframe_changed).collect();
    assert_eq!(outcomes, [false, false, false, false, true, false]);
    assert_eq!(adjustments.take_records().next().map(|r| (r.sequence, r.frames)), Some((4, 0)));
}

#[test]
fn live_no_frame_waits_and_a_late_estimate_is_merged() {
    let (optimise, let_go) = held();
    let mut adjustments = start(Entry::WhenReady, optimise);
    let mut walk = Walk::new();
    // The first keyframe alone holds nothing to estimate: it comes back at once.
    let_go.send(()).unwrap();
    for _ in 0..=9 {
        assert!(!walk.go(&mut adjustments).graph_changed, "nothing was estimated yet");
    }
    assert_eq!(walk.mapper.map().keyframes.len(), 3);
    let before = walk.places();
    let_go.send(()).unwrap();
    // No frame arrives.
    until(|| adjustments.apply_ready(&mut walk.mapper).needs_publishing());
    let record = adjustments.take_records().last().unwrap();
    assert_eq!(record.fate, Fate::Merged, "{record:?}");
    assert!(record.adjustment.keyframe_id < 2 && record.frames > 0, "{record:?}");
    assert_ne!(walk.places(), before);
    // The keyframe that had to wait is next.
    let_go.send(()).unwrap();
    until(|| adjustments.apply_ready(&mut walk.mapper).needs_publishing());
    let record = adjustments.take_records().last().unwrap();
    assert_eq!((record.fate, record.adjustment.keyframe_id), (Fate::Entered, 2), "{record:?}");
}

#[test]
fn the_checkpoint_holds_the_correction_and_its_depth() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.checkpoint");
    let (Some(mut kept), None) = Kept::open(&path) else { panic!("an empty folder") };
    let mut adjustments = start(Entry::AfterFrames(2), Box::new(Window::optimise));
    let mut walk = Walk::new();
    for _ in 0..=10 {
        let sequence = walk.frames;
        let stepped = walk.step();
        kept.follow(&mut walk.mapper, &stepped);
        let adjusted = adjustments.after_frame(&mut walk.mapper, sequence);
        kept.follow(&mut walk.mapper, &adjusted);
    }
    // Killed after the last frame's correction, before the next frame.
    let map = walk.mapper.map();
    assert_eq!(map.keyframes.len(), 3);
    until(|| {
        read_checkpoint(&path).unwrap().is_some_and(|read| read.revision == map.revision)
            && read_checkpoint(&path)
                .unwrap()
                .is_some_and(|read| read.keyframes[1].points == map.keyframes[1].points)
    });
    let read = read_checkpoint(&path).unwrap().unwrap();
    for (read, held) in read.keyframes.iter().zip(&map.keyframes) {
        assert_eq!(read.map_from_keyframe, held.map_from_keyframe);
    }
    assert_eq!(read.keyframes[2].points, map.keyframes[2].points, "the active one");
}

#[test]
fn an_estimate_of_a_map_that_was_corrected_meanwhile_is_dropped() {
    let mut adjustments = start(Entry::AfterFrames(2), Box::new(Window::optimise));
    let mut walk = Walk::new();
    for _ in 0..=4 {
        walk.go(&mut adjustments);
    }
    let moved = walk.mapper.map().keyframes.last().unwrap();
    let correction = KeyframeCorrection {
        keyframe_id: moved.keyframe_id,
        map_from_keyframe: moved.map_from_keyframe,
        depth: LogPlane::default(),
        modes: None,
        place: None,
        relative_place: None,
    };
    let correction = Correction { keyframes: vec![correction], ..Correction::default() };
    walk.mapper.apply(&correction).unwrap();
    let before = walk.places();
    walk.go(&mut adjustments);
    walk.go(&mut adjustments);
    assert_eq!(walk.places(), before);
    assert_eq!(adjustments.take_records().map(|r| r.fate).collect::<Vec<_>>(), [Fate::Dropped]);
    // The window has come back: the next keyframe is estimated.
    for _ in 7..=10 {
        walk.go(&mut adjustments);
    }
    assert_eq!(adjustments.take_records().map(|r| r.fate).collect::<Vec<_>>(), [Fate::Entered]);
}

#[test]
fn an_estimate_for_a_replaced_camera_is_dropped() {
    let mut adjustments = start(Entry::AfterFrames(2), Box::new(Window::optimise));
    let mut walk = Walk::new();
    for _ in 0..=4 {
        walk.go(&mut adjustments);
    }
    let mut next = Walk::new();
    adjustments.abandon();
    for _ in 0..=6 {
        next.go(&mut adjustments);
    }
    let fates: Vec<_> = adjustments.take_records().map(|r| r.fate).collect();
    assert_eq!(fates, [Fate::Dropped, Fate::Entered]);
}

#[test]
fn a_panic_is_reported_once_and_mapping_continues() {
    let panics = |_: &mut Window| -> Option<Adjustment> { panic!("a broken estimate") };
    for entry in [Entry::AfterFrames(1), Entry::WhenReady] {
        let mut adjustments = start(entry, Box::new(panics));
        let mut walk = Walk::new();
        let mut failures = Vec::new();
        for _ in 0..=9 {
            walk.go(&mut adjustments);
            std::thread::sleep(Duration::from_millis(20));
            failures.extend(adjustments.take_failure());
        }
        assert_eq!(failures.len(), 1, "{failures:?}");
        assert!(failures[0].contains("a broken estimate"), "{failures:?}");
        assert_eq!(walk.mapper.map().keyframes.len(), 3);
        assert_eq!(adjustments.finish(&mut walk.mapper), StepOutcome::default());
    }
}

#[test]
fn the_last_keyframe_is_estimated_before_the_end() {
    // The previous estimate is still in flight then.
    for entry in [Entry::AfterFrames(6), Entry::WhenReady] {
        let pauses = |window: &mut Window| {
            std::thread::sleep(Duration::from_millis(200));
            window.optimise()
        };
        let mut adjustments = start(entry, Box::new(pauses));
        let mut walk = Walk::new();
        for _ in 0..=8 {
            walk.go(&mut adjustments);
        }
        assert!(adjustments.finish(&mut walk.mapper).keyframe_changed);
        let last = adjustments.take_records().last().unwrap();
        assert_eq!(last.adjustment.keyframe_id, 2, "{last:?}");
    }
}

#[test]
fn the_end_does_not_wait_long_for_a_thread_without_cpu() {
    let (optimise, let_go) = held();
    let mut adjustments = start(Entry::WhenReady, optimise);
    Walk::new().go(&mut adjustments);
    assert!(adjustments.in_flight.is_some());
    // It returns although the estimate never comes back.
    drop(adjustments);
    drop(let_go);
}
