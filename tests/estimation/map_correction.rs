//! A map that is corrected in the middle of a run: everything that follows agrees with the correction, and nothing
//! else changes.

use std::sync::LazyLock;

use nalgebra::Vector6;
use proptest::prelude::*;
use semidense::capture::simulator::Simulator;
use semidense::capture::simulator::params::{SensorParams, SimulatorParams};
use semidense::capture::source::FrameSource;
use semidense::service::map_file::{read_map, write_map};
use semidense::slam::alignment::reference::Reference;
use semidense::slam::frame::FrameView;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::keyframe::Keyframe;
use semidense::slam::map::{
    Correction, CorrectionError, EpochJoin, KeyframeCorrection, LogPlane, Map,
};
use semidense::slam::mapper::{Mapper, MapperParams};
use semidense::slam::pose::{PoseEstimate, TrackingState};
use semidense::slam::tracker::{Tracker, TrackerParams};

/// Frames of a run; the map begins within the first third.
const FRAMES: usize = 90;
/// The frame after which the map is corrected.
const CORRECTED_AT: usize = 60;
/// Time between frames.
const PERIOD_NANOS: i64 = 33_333_333;

/// A simulated sequence.
struct Footage {
    intrinsics: Intrinsics,
    frames: Vec<Vec<u8>>,
}

/// Rendered once per process, for all tests.
static FOOTAGE: LazyLock<Footage> = LazyLock::new(footage);

fn footage() -> Footage {
    let params = SimulatorParams {
        seed: 3,
        frames: FRAMES,
        sensor: SensorParams { noise_std_dev: 2.0, ..SensorParams::default() },
        ..SimulatorParams::half_size()
    };
    let mut source = Simulator::new(params).unwrap();
    let intrinsics = source.intrinsics();
    let mut pixels = vec![0; intrinsics.width * intrinsics.height];
    let mut frames = Vec::new();
    while source.next_into(&mut pixels).unwrap().is_some() {
        frames.push(pixels.clone());
    }
    Footage { intrinsics, frames }
}

/// Tracker and mapper in lockstep.
struct Run<'a> {
    footage: &'a Footage,
    tracker: Tracker,
    mapper: Mapper,
    poses: Vec<PoseEstimate>,
}

impl<'a> Run<'a> {
    fn new(footage: &'a Footage) -> Self {
        let mapper = Mapper::new(footage.intrinsics, MapperParams::default()).unwrap();
        let tracker = Tracker::new(footage.intrinsics, TrackerParams::default()).unwrap();
        Self { footage, tracker, mapper, poses: Vec::new() }
    }

    /// Processes `pixels` as the next frame.
    fn show(&mut self, pixels: &[u8]) {
        let sequence = self.poses.len() as u64;
        let capture_nanos = sequence as i64 * PERIOD_NANOS;
        let frame = FrameView::new(&self.footage.intrinsics, sequence, capture_nanos, pixels);
        let pose = self.tracker.track(&frame, &mut |_| true);
        self.poses.push(pose);
        let stepped = self.mapper.step(&frame, &pose, None, &mut || {});
        let finished = self.mapper.finish_keyframe();
        if stepped.needs_publishing() || finished.needs_publishing() {
            self.publish();
        }
    }

    fn publish(&mut self) {
        let keyframe = self.mapper.keyframe().unwrap();
        self.tracker.adopt(Box::new(Reference::prepare(keyframe)));
    }

    fn show_all(&mut self, frames: std::ops::Range<usize>) {
        let footage = self.footage;
        footage.frames[frames].iter().for_each(|pixels| self.show(pixels));
    }

    fn apply(&mut self, correction: &Correction) {
        let outcome = self.mapper.apply(correction).unwrap();
        assert!(outcome.keyframe_changed && outcome.graph_changed);
        self.publish();
    }
}

/// A correction that moves every keyframe of the map by a separate similarity.
fn moved(map: &Map, move_one: impl Fn(&Sim3) -> Sim3) -> Correction {
    let keyframes = map.keyframes.iter().map(|keyframe| {
        let map_from_keyframe = move_one(&keyframe.map_from_keyframe);
        KeyframeCorrection::of_pose(keyframe.keyframe_id, map_from_keyframe)
    });
    Correction { keyframes: keyframes.collect(), ..Correction::default() }
}

/// A correction that gives the whole map another gauge.
fn regauged(map: &Map, new_from_map: &Sim3) -> Correction {
    Correction { unit: Some(new_from_map.scale), ..moved(map, |place| *new_from_map * *place) }
}

/// Distance between two poses: their units and radians combined.
fn distance(one: &SE3, other: &SE3) -> f64 {
    (one.inverse() * *other).log().norm()
}

/// Largest distance in pixels between the projections of one keyframe's points into another, by two maps.
fn reprojection_error(one: (&Map, [usize; 2]), other: &Map) -> f64 {
    let (map, [from, to]) = one;
    let seen = |map: &Map| {
        let (host, target) = (&map.keyframes[from], &map.keyframes[to]);
        let k = host.intrinsics;
        let target_from_host = target.map_from_keyframe.inverse() * host.map_from_keyframe;
        let project = move |u: f64, v: f64, inverse_depth: f64| {
            let ray = k.ray(u, v);
            let at = target_from_host * (ray / inverse_depth);
            (k.fx * at.x / at.z, k.fy * at.y / at.z)
        };
        let points = host.points.iter().step_by(50);
        points.map(|p| project(p.u.into(), p.v.into(), p.inverse_depth.into())).collect::<Vec<_>>()
    };
    let pairs = seen(map).into_iter().zip(seen(other));
    pairs.map(|(a, b)| (a.0 - b.0).hypot(a.1 - b.1)).fold(0.0, f64::max)
}

fn similarity() -> impl Strategy<Value = Sim3> {
    (proptest::array::uniform6(-2.0f64..2.0), 0.2f64..5.0)
        .prop_map(|(twist, scale)| Sim3::new(SE3::exp(&Vector6::from(twist)), scale))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 4, ..ProptestConfig::default() })]

    /// Another pose and unit for the whole map does not affect its content.
    #[test]
    fn another_gauge_changes_nothing_but_the_gauge(new_from_map in similarity()) {
        let footage = &*FOOTAGE;
        let mut plain = Run::new(footage);
        plain.show_all(0..FRAMES);
        let mut corrected = Run::new(footage);
        corrected.show_all(0..CORRECTED_AT);
        let correction = regauged(corrected.mapper.map(), &new_from_map);
        prop_assert!(correction.keyframes.len() > 2, "a map worth correcting");
        corrected.apply(&correction);
        corrected.show_all(CORRECTED_AT..FRAMES);

        let (before, after) = (plain.mapper.map(), corrected.mapper.map());
        prop_assert_eq!(after.revision, 1);
        prop_assert_eq!(before.keyframes.len(), after.keyframes.len());
        for (one, other) in before.keyframes.iter().zip(&after.keyframes) {
            prop_assert_eq!(one.keyframe_id, other.keyframe_id);
            let expected = new_from_map * one.map_from_keyframe;
            let error = distance(&expected.rigid, &other.map_from_keyframe.rigid);
            prop_assert!(error < 1e-6 * new_from_map.scale.max(1.0), "keyframe {}: {error}", one.keyframe_id);
            prop_assert!((other.map_from_keyframe.scale / expected.scale - 1.0).abs() < 1e-6);
            // Depth is in the keyframe's own unit.
            prop_assert_eq!(one.points.len(), other.points.len());
        }
        for host in 0..before.keyframes.len() {
            let error = reprojection_error((before, [host, before.keyframes.len() - 1]), after);
            prop_assert!(error < 0.01, "keyframe {host}: {error} px");
        }
        for (one, other) in plain.poses.iter().zip(&corrected.poses) {
            let frame = one.sequence;
            prop_assert_eq!(one.state, other.state);
            prop_assert_eq!(one.keyframe_id, other.keyframe_id);
            let jump = distance(&one.world_from_camera, &other.world_from_camera);
            prop_assert!(jump < 1e-6, "odometry, frame {frame}: {jump}");
            let is_after = frame >= CORRECTED_AT as u64;
            prop_assert_eq!(other.map_revision, u64::from(is_after));
            let mut expected = one.map_from_camera;
            if is_after {
                expected = new_from_map.transform_pose(&expected);
            }
            let error = distance(&expected, &other.map_from_camera);
            prop_assert!(error < 1e-6 * new_from_map.scale.max(1.0), "map, frame {frame}: {error}");
            // Earlier frames follow their keyframes.
            let placed = after.frame_pose(other.keyframe_id, &other.keyframe_from_camera);
            if let Some(placed) = placed.filter(|_| one.state == TrackingState::Tracking) {
                let published = before.frame_pose(one.keyframe_id, &one.keyframe_from_camera).unwrap();
                let error = distance(&new_from_map.transform_pose(&published), &placed);
                prop_assert!(error < 1e-6 * new_from_map.scale.max(1.0), "result, frame {frame}: {error}");
            }
        }
    }
}

/// Keyframes that move relative to each other take their frames along, and odometry does not move.
#[test]
fn moved_keyframes_take_their_frames_along() {
    let footage = &*FOOTAGE;
    let mut run = Run::new(footage);
    run.show_all(0..CORRECTED_AT);
    let before = run.mapper.map().clone();
    let bend = |place: &Sim3| {
        let x = place.rigid.translation.x;
        let turned = SE3::exp(&Vector6::new(0.1, 0.0, 0.02, 0.0, 0.03 * (1.0 + x), 0.0));
        Sim3::new(turned * place.rigid, 1.1 * place.scale)
    };
    let correction = moved(&before, bend);
    let active = run.mapper.keyframe().unwrap().clone();
    run.apply(&correction);
    let anchored = run.mapper.keyframe().unwrap();
    let last = run.poses[CORRECTED_AT - 1];
    let again = anchored.world_from_keyframe.transform_pose(&last.keyframe_from_camera);
    let moved_by = distance(&again, &last.world_from_camera);
    assert!(moved_by < 1e-9, "odometry's place of the camera moved by {moved_by}");
    assert_eq!(anchored.map_from_keyframe, bend(&active.map_from_keyframe));
    // Odometry's unit is the map's, which has not changed: the unit of the keyframe, which has, is longer there too.
    let unit =
        |keyframe: &Keyframe| keyframe.world_from_keyframe.scale / keyframe.map_from_keyframe.scale;
    assert!((unit(anchored) / unit(&active) - 1.0).abs() < 1e-12, "odometry's unit changes");
    run.show_all(CORRECTED_AT..CORRECTED_AT + 1);
    let next = run.poses[CORRECTED_AT];
    let step = distance(&last.world_from_camera, &next.world_from_camera);
    assert!(step < 0.05, "odometry jumps by {step}");
    let expected =
        run.mapper.map().frame_pose(next.keyframe_id, &next.keyframe_from_camera).unwrap();
    assert!(distance(&expected, &next.map_from_camera) < 1e-9, "the tracker has the new place");
    // A later keyframe is placed according to the corrected map.
    run.show_all(CORRECTED_AT + 1..FRAMES);
    let map = run.mapper.map();
    assert!(map.keyframes.len() > before.keyframes.len(), "no keyframe was made afterwards");
    let made_on = |sequence: u64| run.poses.iter().find(|pose| pose.sequence == sequence);
    let new = &map.keyframes[before.keyframes.len()];
    let pose = made_on(new.sequence).unwrap();
    let expected = map.frame_pose(pose.keyframe_id, &pose.keyframe_from_camera).unwrap();
    assert!(distance(&expected, &new.map_from_keyframe.rigid) < 1e-9);
    let in_world = new.world_from_keyframe.rigid;
    assert!(distance(&in_world, &pose.world_from_camera) < 1e-6, "odometry continues");
}

/// Depth corrected by a plane on its logarithm: in the keyframe, in further observations, and in the file.
#[test]
fn depth_is_corrected_for_further_observations_too() {
    let footage = &*FOOTAGE;
    let mut run = Run::new(footage);
    run.show_all(0..CORRECTED_AT);
    let before = run.mapper.map().clone();
    let plane = LogPlane { offset: 0.4, per_x: 0.04, per_y: -0.03 };
    let active = run.mapper.keyframe().unwrap().keyframe_id;
    let mut correction = moved(&before, |place| *place);
    correction.keyframes.iter_mut().for_each(|corrected| corrected.depth = plane);
    run.apply(&correction);
    for (old, new) in before.keyframes.iter().zip(&run.mapper.map().keyframes) {
        assert_eq!(old.points.len(), new.points.len());
        for (p, q) in old.points.iter().zip(&new.points) {
            let factor = plane.factor(&old.intrinsics, p.u.into(), p.v.into()) as f32;
            assert!((q.inverse_depth / p.inverse_depth - factor).abs() < 1e-5 * factor);
            assert!((q.variance / p.variance - factor * factor).abs() < 1e-4 * factor * factor);
        }
    }
    let corrected = run.mapper.map().get(active).unwrap().clone();
    let published = (CORRECTED_AT..FRAMES).find(|&frame| {
        run.show_all(frame..frame + 1);
        run.mapper.map().get(active).unwrap().revision > corrected.revision
    });
    assert!(published.is_some(), "its depth is never published again");
    // The frames change depth by their own small amount, not back by the plane.
    let observed = run.mapper.map().get(active).unwrap();
    let mean = |points: &[semidense::slam::keyframe::DepthPoint]| {
        points.iter().map(|p| f64::from(p.inverse_depth)).sum::<f64>() / points.len() as f64
    };
    let kept = mean(&observed.points) / mean(&corrected.points);
    assert!((kept - 1.0).abs() < 0.1, "the depth went to {kept} of itself");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.bin");
    write_map(&path, run.mapper.map(), &mut || ()).unwrap();
    let read = read_map(&path).unwrap();
    // Descriptions are not in the file: they are computed again from the image.
    let mut written = run.mapper.map().keyframes.clone();
    written.iter_mut().for_each(|keyframe| keyframe.description = None);
    assert_eq!((read.revision, read.keyframes), (1, written));
}

/// A mapper that dies after a correction is succeeded from the corrected map, with odometry unchanged.
#[test]
fn a_successor_continues_from_the_corrected_map() {
    let footage = &*FOOTAGE;
    let mut run = Run::new(footage);
    run.show_all(0..CORRECTED_AT);
    let new_from_map = Sim3::new(SE3::exp(&Vector6::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)), 2.0);
    let correction = regauged(run.mapper.map(), &new_from_map);
    run.apply(&correction);
    let died_with = run.mapper.keyframe().unwrap().clone();
    let mut successor = Mapper::new(footage.intrinsics, MapperParams::default()).unwrap();
    successor.resume(run.mapper.checkpoint().unwrap());
    let resumed = successor.keyframe().unwrap();
    assert_eq!(resumed.map_from_keyframe, died_with.map_from_keyframe);
    let moved_by =
        distance(&resumed.world_from_keyframe.rigid, &died_with.world_from_keyframe.rigid);
    assert!(moved_by < 1e-9, "{moved_by}");
    assert_eq!((resumed.map_revision, successor.map().revision), (1, 1));
}

/// An epoch that turns out to be part of another is joined to it, with all its frames.
#[test]
fn joined_epochs_are_one() {
    let footage = &*FOOTAGE;
    let mut run = Run::new(footage);
    run.show_all(0..CORRECTED_AT);
    let black = vec![0; footage.frames[0].len()];
    (0..80).for_each(|_| run.show(&black));
    // The mirror image: a place that no keyframe shows.
    let width = footage.intrinsics.width;
    for pixels in &footage.frames {
        let rows = pixels.chunks_exact(width);
        run.show(&rows.flat_map(|row| row.iter().rev().copied()).collect::<Vec<_>>());
    }
    let epochs: Vec<u32> = run.mapper.map().keyframes.iter().map(|k| k.epoch).collect();
    assert_eq!((epochs[0], *epochs.last().unwrap()), (0, 1), "{epochs:?}");
    let into_from_epoch = Sim3::new(SE3::exp(&Vector6::new(0.5, 0.0, 1.0, 0.0, 1.0, 0.0)), 0.7);
    let join = EpochJoin::exact(1, 0, into_from_epoch);
    let before = run.mapper.keyframe().unwrap().clone();
    run.apply(&Correction { joins: vec![join], ..Correction::default() });
    let after = run.mapper.keyframe().unwrap();
    assert!(run.mapper.map().keyframes.iter().all(|keyframe| keyframe.epoch == 0));
    assert_eq!(after.map_from_keyframe, into_from_epoch * before.map_from_keyframe);
    let moved_by = distance(&after.world_from_keyframe.rigid, &before.world_from_keyframe.rigid);
    assert!(moved_by < 1e-9, "odometry moved by {moved_by}");
    let last = *run.poses.last().unwrap();
    assert_eq!((last.epoch, last.state), (1, TrackingState::Tracking));
    // The camera retraces its path.
    for pixels in footage.frames.iter().rev().take(5) {
        let rows = pixels.chunks_exact(width);
        run.show(&rows.flat_map(|row| row.iter().rev().copied()).collect::<Vec<_>>());
    }
    let next = run.poses[run.poses.len() - 5];
    assert_eq!((next.epoch, next.state), (0, TrackingState::Tracking));
    let step = distance(&last.world_from_camera, &next.world_from_camera);
    assert!(step < 0.05, "odometry jumps by {step} where the epochs are joined");
}

#[test]
fn an_invalid_correction_is_refused_as_a_whole() {
    let footage = &*FOOTAGE;
    let mut run = Run::new(footage);
    run.show_all(0..CORRECTED_AT);
    let before = run.mapper.map().clone();
    let sane = moved(&before, |place| Sim3::new(SE3::identity(), 1.0) * *place);
    let broken_scale = |scale: f64| {
        let mut correction = sane.clone();
        correction.keyframes.last_mut().unwrap().map_from_keyframe.scale = scale;
        correction
    };
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let refused = run.mapper.apply(&broken_scale(scale)).unwrap_err();
        assert!(matches!(refused, CorrectionError::Keyframe(_)), "{refused}");
    }
    let mut correction = sane.clone();
    correction.keyframes[0].depth.per_x = 1e9;
    assert!(run.mapper.apply(&correction).is_err());
    let join = EpochJoin::exact(0, 0, Sim3::identity());
    let refused = run.mapper.apply(&Correction { joins: vec![join], ..Correction::default() });
    assert!(matches!(refused.unwrap_err(), CorrectionError::Join(0)));
    for unit in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let refused = run.mapper.apply(&Correction { unit: Some(unit), ..sane.clone() });
        assert!(matches!(refused.unwrap_err(), CorrectionError::Unit), "{unit}");
    }
    assert_eq!((run.mapper.map().revision, &run.mapper.map().keyframes), (0, &before.keyframes));
    // Corrections of unknown keyframes have no effect.
    let mut unknown = sane;
    unknown.keyframes.iter_mut().for_each(|corrected| corrected.keyframe_id += 1000);
    run.mapper.apply(&unknown).unwrap();
    let places = |map: &Map| map.keyframes.iter().map(|k| k.map_from_keyframe).collect::<Vec<_>>();
    assert_eq!(places(run.mapper.map()), places(&before));
}
