//! A keyframe: a frame with a semi-dense depth map and a place in the world.

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;

/// One pixel with depth, as it goes over the wire.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct DepthPoint {
    /// Column of the pixel, level 0.
    pub u: u16,
    /// Row of the pixel, level 0.
    pub v: u16,
    /// 1/z along the keyframe's optical axis, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance of the inverse depth.
    pub variance: f32,
    /// Brightness of the pixel, 0 to 255.
    pub intensity: f32,
}

/// Most points of one keyframe: bounds the message and the tracker's memory.
pub const MAX_KEYFRAME_POINTS: usize = 100_000;

/// Most bytes of image and depth that a keyframe of `num_pixels` holds: one a pixel, 16 a point.
pub const fn most_keyframe_bytes(num_pixels: usize) -> usize {
    num_pixels + MAX_KEYFRAME_POINTS * size_of::<DepthPoint>()
}

/// Whether the map behind a keyframe can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapState {
    /// Depth is proven: poses on it are claimed.
    Established,
    /// The map contradicted itself: poses on it are `Lost` until a new keyframe or epoch.
    Rejected,
}

/// A keyframe as the tracker and every subscriber see it: self-contained.
#[derive(Debug, Clone, PartialEq)]
pub struct Keyframe {
    /// Its id, counted up in the order of creation.
    pub keyframe_id: u64,
    /// Life of the map it belongs to.
    pub epoch: u32,
    /// Counts up with every change of the depth or the pose of any keyframe.
    pub revision: u64,
    /// Sequence of the frame it was made from.
    pub sequence: u64,
    /// Stamp of that frame, nanoseconds.
    pub capture_nanos: i64,
    /// Whether its depth can be trusted.
    pub map_state: MapState,
    /// Where odometry has it, with its unit: never jumps while it is active.
    pub world_from_keyframe: Sim3,
    /// Where the map has it, with its unit: moves with every correction of the map.
    pub map_from_keyframe: Sim3,
    /// How often the map had been corrected by then.
    pub map_revision: u64,
    /// Intrinsics of its image.
    pub intrinsics: Intrinsics,
    /// Rectified grey image, `width * height` bytes.
    pub image: Vec<u8>,
    /// Pixels with depth in row-major order, at most [`MAX_KEYFRAME_POINTS`].
    pub points: Vec<DepthPoint>,
}

/// The pose of one keyframe in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Where the map has it, with its unit.
    pub map_from_keyframe: Sim3,
}

impl KeyframePose {
    /// Of a keyframe.
    pub fn of(keyframe: &Keyframe) -> Self {
        let Keyframe { keyframe_id, revision, map_from_keyframe, .. } = *keyframe;
        Self { keyframe_id, revision, map_from_keyframe }
    }
}
