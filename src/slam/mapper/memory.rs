//! Bounds the memory of the map: a robot runs for days.

use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::slam::mapper::{Map, MapperParams};

/// Bytes in the megabyte of the configuration.
const BYTES_PER_MEGABYTE: usize = 1_000_000;

impl MapperParams {
    /// Bytes of image and depth that the map may hold.
    pub fn max_map_bytes(&self) -> usize {
        self.max_map_megabytes * BYTES_PER_MEGABYTE
    }
}

impl Map {
    /// Takes image and depth from the oldest keyframes until the rest fit into `max_bytes`; their poses
    /// stay. The newest keeps everything.
    pub fn forget_depth_beyond(&mut self, max_bytes: usize) {
        let mut bytes: usize = self.keyframes.iter().map(depth_bytes).sum();
        let Some((_, older)) = self.keyframes.split_last_mut() else { return };
        for keyframe in older {
            if bytes <= max_bytes {
                return;
            }
            bytes -= depth_bytes(keyframe);
            keyframe.image = Vec::new();
            keyframe.points = Vec::new();
        }
    }
}

/// Bytes held by a keyframe's image and points.
fn depth_bytes(keyframe: &Keyframe) -> usize {
    keyframe.image.capacity() + keyframe.points.capacity() * size_of::<DepthPoint>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::{MAX_KEYFRAME_POINTS, MapState, most_keyframe_bytes};
    use crate::slam::mapper::past::PastFrames;
    use crate::slam::pose::Brightness;

    fn keyframe(keyframe_id: u64) -> Keyframe {
        Keyframe {
            keyframe_id,
            epoch: 0,
            revision: 0,
            sequence: keyframe_id,
            capture_nanos: 0,
            map_state: MapState::Established,
            world_from_keyframe: Sim3::identity(),
            intrinsics: Intrinsics { fx: 20.0, fy: 20.0, cx: 9.5, cy: 9.5, width: 20, height: 20 },
            image: vec![7; 400],
            points: vec![DepthPoint::default(); 25],
        }
    }

    #[test]
    fn a_keyframe_and_a_frame_hold_what_is_stated() {
        const NUM_PIXELS: usize = 640 * 480;
        let mut full = keyframe(0);
        full.image = vec![0; NUM_PIXELS];
        full.points = vec![DepthPoint::default(); MAX_KEYFRAME_POINTS];
        assert_eq!(depth_bytes(&full), most_keyframe_bytes(NUM_PIXELS));
        assert_eq!(most_keyframe_bytes(NUM_PIXELS), 1_907_200);
        let mut past = PastFrames::with_capacity(4);
        for _ in 0..9 {
            past.push(&full.image, SE3::identity(), Brightness::default());
        }
        let held: usize = past.newest_first().map(|frame| frame.pixels.capacity()).sum();
        assert_eq!(held, 4 * NUM_PIXELS);
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
}
