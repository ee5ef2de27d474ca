//! Memory, places and corrections of the map.

use super::*;
use crate::slam::keyframe::{MAX_KEYFRAME_POINTS, most_keyframe_bytes};

fn keyframe(keyframe_id: u64) -> Keyframe {
    Keyframe {
        keyframe_id,
        sequence: keyframe_id,
        ..Keyframe::at(
            Sim3::identity(),
            Intrinsics::pinhole(20, 20, 20.0),
            vec![DepthPoint::default(); 25],
            vec![7; 400],
        )
    }
}

#[test]
fn a_keyframe_holds_what_is_stated() {
    const NUM_PIXELS: usize = 640 * 480;
    let mut full = keyframe(0);
    full.image = vec![0; NUM_PIXELS];
    full.points = vec![DepthPoint::default(); MAX_KEYFRAME_POINTS];
    assert_eq!(depth_bytes(&full), most_keyframe_bytes(NUM_PIXELS));
    assert_eq!(most_keyframe_bytes(NUM_PIXELS), 1_907_200);
}

#[test]
fn the_oldest_lose_their_depth_and_keep_their_pose() {
    let mut map = Map { keyframes: (0..5).map(keyframe).collect(), ..Map::default() };
    let one = depth_bytes(&map.keyframes[0]);
    map.forget_depth_beyond(2 * one);
    let kept: Vec<bool> = map.keyframes.iter().map(|k| !k.points.is_empty()).collect();
    assert_eq!(kept, [false, false, false, true, true]);
    assert_eq!(map.keyframes.iter().map(|k| k.image.len()).sum::<usize>(), 800);
    map.forget_depth_beyond(0);
    assert!(!map.keyframes[4].points.is_empty());
}
