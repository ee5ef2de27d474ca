//! Pieces of a pass over all keyframes, between the estimates of new ones.

use std::sync::mpsc::channel;

use super::tests::{KEYFRAME_INTERVAL, Walk, start};
use super::*;
use crate::slam::geometry::se3::SE3;
use crate::slam::map::{Correction, KeyframeCorrection, LogPlane};
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::reuse::ReuseParams;
use crate::slam::window::params::WindowParams;

/// Endless passes, in pieces of three, from the third keyframe on.
fn with_passes() -> MapperParams {
    let window = WindowParams {
        num_free: 2,
        num_first: 2,
        pass_every: 1,
        pass_piece: 3,
        ..WindowParams::default()
    };
    // Every change of the keyframe makes a new one.
    let reuse = ReuseParams { max_distance: 0.0, ..ReuseParams::default() };
    MapperParams { window, reuse, ..MapperParams::default() }
}

#[test]
fn a_new_keyframe_goes_first_and_waits_for_at_most_one_piece() {
    let (say, begun) = channel();
    let optimise = move |window: &mut Window| {
        say.send(window.is_piece()).unwrap();
        window.optimise()
    };
    let mut adjustments = start(Entry::AfterFrames(3), Box::new(optimise));
    let mut walk = Walk::with(with_passes());
    let (mut waits_since, mut pieces, mut last) = (Some(0), 0, None);
    for _ in 0..40 {
        let sequence = walk.frames;
        if sequence > 0 && sequence.is_multiple_of(KEYFRAME_INTERVAL) {
            waits_since.get_or_insert(sequence);
        }
        walk.go(&mut adjustments);
        let began = adjustments.in_flight.map(|in_flight| in_flight.began);
        if began == Some(adjustments.frames) && began != last {
            let is_piece = begun.recv().unwrap();
            assert_eq!(is_piece, waits_since.is_none(), "frame {sequence}");
            assert!(waits_since.is_none_or(|since| sequence - since <= 3), "frame {sequence}");
            pieces += u64::from(is_piece);
            waits_since = None;
        }
        last = began;
    }
    assert!(pieces >= 3, "{pieces}");
}

#[test]
fn a_piece_moves_the_map_and_odometry_does_not_jump() {
    let mut adjustments = start(Entry::AfterFrames(1), Box::new(Window::optimise));
    let mut walk = Walk::with(with_passes());
    for _ in 0..=14 {
        walk.go(&mut adjustments);
    }
    while adjustments.in_flight.is_some() {
        adjustments.after_frame(&mut walk.mapper, walk.frames);
    }
    // Move a keyframe in the middle out of line.
    let bent = walk.mapper.map().get(1).unwrap();
    let right = bent.map_from_keyframe.rigid.translation;
    let mut map_from_keyframe = bent.map_from_keyframe;
    map_from_keyframe.rigid.translation.y += 0.02;
    let correction = KeyframeCorrection {
        keyframe_id: 1,
        map_from_keyframe,
        depth: LogPlane::default(),
        modes: None,
        place: None,
        relative_place: None,
    };
    let correction = Correction { keyframes: vec![correction], ..Correction::default() };
    walk.mapper.apply(&correction).unwrap();
    // The estimate of the next keyframe, 4, does not reach it.
    for _ in 15..=17 {
        walk.go(&mut adjustments);
    }
    let off = |walk: &Walk| {
        let at = walk.mapper.map().get(1).unwrap().map_from_keyframe.rigid.translation;
        (at - right).norm()
    };
    assert!(off(&walk) > 0.015, "{}", off(&walk));
    let camera = SE3 { translation: [0.06 * 17.0, 0.0, 0.0].into(), ..SE3::identity() };
    let keyframe_from_camera =
        walk.mapper.keyframe().unwrap().world_from_keyframe.inverse_transform_pose(&camera);
    let mut pieces = 0;
    while adjustments.in_flight.is_some() {
        adjustments.after_frame(&mut walk.mapper, walk.frames);
        pieces += 1;
        let at = walk
            .mapper
            .keyframe()
            .unwrap()
            .world_from_keyframe
            .transform_pose(&keyframe_from_camera);
        assert!((at.inverse() * camera).log().norm() < 1e-9, "{at:?}");
    }
    assert!(pieces >= 3 && off(&walk) < 0.007, "{pieces}, {}", off(&walk));
}
