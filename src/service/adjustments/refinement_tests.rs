//! Depth that is refined while frames arrive.

use super::tests::{Walk, start, until};
use super::*;
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::consistency::ConsistencyParams;
use crate::slam::mapper::situation::Situation;
use crate::slam::window::params::WindowParams;

/// Two free keyframes: the third before the newest has settled.
fn short_window() -> MapperParams {
    let window = WindowParams { num_first: 2, num_free: 2, ..WindowParams::default() };
    MapperParams { window, ..MapperParams::default() }
}

/// 19 frames with five keyframes; live, each estimate is in the map before the next frame.
fn walk(entry: Entry) -> (Walk, Vec<u64>) {
    let mut adjustments = start(entry, Box::new(Window::optimise));
    let mut walk = Walk::with(short_window());
    let mut left = Vec::new();
    for _ in 0..19 {
        walk.go(&mut adjustments);
        until(|| {
            adjustments.apply_ready(&mut walk.mapper);
            adjustments.in_flight.is_none() || entry != Entry::WhenReady
        });
        left.extend(std::iter::from_fn(|| {
            walk.mapper.take_keyframe_to_save().map(|of| of.keyframe_id)
        }));
    }
    (walk, left)
}

fn refined(walk: &Walk) -> Vec<u64> {
    let of_map = walk.mapper.map().keyframes.iter();
    of_map.filter(|keyframe| keyframe.is_refined).map(|keyframe| keyframe.keyframe_id).collect()
}

#[test]
fn settled_keyframes_are_refined_and_reported() {
    let (live, left) = walk(Entry::WhenReady);
    assert_eq!(live.mapper.map().keyframes.len(), 5);
    assert_eq!(refined(&live), [0, 1, 2]);
    for id in [0, 1, 2] {
        let told = left.iter().filter(|&&of| of == id).count();
        assert!(told >= 2, "keyframe {id}: when it was left and when it was refined: {left:?}");
    }
    let (lockstep, _) = walk(Entry::AfterFrames(1));
    assert!(refined(&lockstep).is_empty(), "there it is done after the last frame");
    let points = |walk: &Walk| walk.mapper.map().get(1).unwrap().points.clone();
    assert_ne!(points(&live), points(&lockstep));
    // Poses are exact here, so the filter's depth is as good: 0.2 %.
    let mut errors = live.depth_errors(1);
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 0.005, "{}", errors[errors.len() / 2]);
}

#[test]
fn depth_that_was_dropped_is_refined_later() {
    let (mut live, _) = walk(Entry::AfterFrames(1));
    let mut first = live.mapper.begin_adjustment(true).unwrap();
    assert_eq!(first.optimise(), None);
    live.mapper.drop_adjustment(first);
    assert!(refined(&live).is_empty());
    let mut again = live.mapper.begin_adjustment(true).unwrap();
    again.optimise();
    live.mapper.end_adjustment(again);
    assert_eq!(refined(&live), [1], "the newest that has settled in the estimate before");
}

#[test]
fn keyframes_of_a_map_that_ends_rejected_are_estimated_and_refined_nevertheless() {
    let mut adjustments = start(Entry::AfterFrames(1), Box::new(Window::optimise));
    let consistency = ConsistencyParams { max_failed_ratio: 0.3, ..Default::default() };
    let mut walk = Walk::with(MapperParams { consistency, ..MapperParams::default() });
    for _ in 0..18 {
        walk.go(&mut adjustments);
    }
    walk.replace_scene(9);
    for _ in 0..100 {
        walk.go(&mut adjustments);
        if matches!(walk.mapper.situation(), Situation::Rejected(_)) {
            break;
        }
    }
    assert!(matches!(walk.mapper.situation(), Situation::Rejected(_)));
    drop(adjustments.take_records());
    adjustments.finish(&mut walk.mapper);
    let last = adjustments.take_records().last().unwrap();
    assert_eq!(last.fate, Fate::Entered);
    let refined = walk.mapper.map().keyframes.iter().filter(|keyframe| keyframe.is_refined);
    assert!(refined.count() >= 3);
}
