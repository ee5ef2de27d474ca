//! A keyframe: a frame with a semi-dense depth map and a pose in the world.

use std::sync::Arc;

#[cfg(feature = "service")]
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, UncertainPose};
use crate::slam::modes::ModeCovariance;
use crate::slam::places::Description;

/// One pixel with depth, as sent over the wire.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "service", derive(FromBytes, IntoBytes, Immutable, KnownLayout))]
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

/// Weights of the distance of a camera from a keyframe (Engel, Schöps, Cremers 2014, §3.4, with the share of points in
/// view).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DistanceWeights {
    /// w_d: a translation of 1/w_d of the mean depth alone is a distance of 1.
    pub translation: f64,
    /// w_u: 1/w_u of the points out of view alone is a distance of 1.
    pub usage: f64,
}

impl Default for DistanceWeights {
    fn default() -> Self {
        Self { translation: 3.0, usage: 4.0 }
    }
}

impl DistanceWeights {
    /// `(w_d ‖t‖ d̄)² + (w_u (1 − usage))²` of a camera `translation` mean depths away that sees a share `usage` of the
    /// keyframe's points. Beyond 1 a new keyframe is requested.
    pub fn distance(&self, translation: f64, usage: f64) -> f64 {
        let from_translation = self.translation * translation;
        let from_usage = self.usage * (1.0 - usage);
        from_translation * from_translation + from_usage * from_usage
    }

    /// The translation, in mean depths, that alone makes a `distance`: nothing further away has a smaller one.
    pub fn reach(&self, distance: f64) -> f64 {
        distance.sqrt() / self.translation.max(f64::MIN_POSITIVE)
    }
}

/// Whether the map behind a keyframe can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapState {
    /// Depth is established: poses on it are claimed.
    Established,
    /// The map contradicted itself: poses on it are `Lost` until a new keyframe or epoch.
    Rejected,
}

/// A keyframe as the tracker and every subscriber receive it: self-contained.
#[derive(Debug, Clone, PartialEq)]
pub struct Keyframe {
    /// Its id, increasing in the order of creation.
    pub keyframe_id: u64,
    /// Epoch of the map that it belongs to.
    pub epoch: u32,
    /// Increases with every change of the depth or the pose of any keyframe.
    pub revision: u64,
    /// Sequence of the frame it was created from.
    pub sequence: u64,
    /// Stamp of that frame, nanoseconds.
    pub capture_nanos: i64,
    /// Whether its depth can be trusted.
    pub map_state: MapState,
    /// Its pose in the world, with its unit: never jumps while it is active.
    pub world_from_keyframe: Sim3,
    /// Its pose in the map, with its unit: moves with every correction of the map.
    pub map_from_keyframe: Sim3,
    /// Number of corrections of the map at that time.
    pub map_revision: u64,
    /// Intrinsics of its image.
    pub intrinsics: Intrinsics,
    /// Rectified grey image, `width * height` bytes; shared between copies.
    pub image: Arc<[u8]>,
    /// Covariance of the errors common to all of its depth.
    pub mode_covariance: ModeCovariance,
    /// Covariance of its pose in the map, relative to the first keyframe of its epoch, for which it is zero.
    pub place_covariance: KeyframePoseCovariance,
    /// Whether its depth was observed again in the surrounding keyframes, which is done once.
    pub is_refined: bool,
    /// Pixels with depth in row-major order, at most [`MAX_KEYFRAME_POINTS`].
    pub points: Vec<DepthPoint>,
    /// Description of its image, for place recognition: only in the mapper, which computes it once.
    pub description: Option<Arc<Description>>,
}

impl Keyframe {
    /// A keyframe at `place`, with its unit, in map and odometry; its numbers and stamps are 0.
    pub fn at(
        place: Sim3,
        intrinsics: Intrinsics,
        points: Vec<DepthPoint>,
        image: Vec<u8>,
    ) -> Self {
        Self {
            keyframe_id: 0,
            epoch: 0,
            revision: 0,
            sequence: 0,
            capture_nanos: 0,
            map_state: MapState::Established,
            world_from_keyframe: place,
            map_from_keyframe: place,
            map_revision: 0,
            mode_covariance: ModeCovariance::ZERO,
            place_covariance: KeyframePoseCovariance::ZERO,
            is_refined: false,
            intrinsics,
            image: image.into(),
            points,
            description: None,
        }
    }

    /// Its pose in the map, with the covariance.
    pub fn uncertain_pose(&self) -> UncertainPose {
        let Self { map_from_keyframe, place_covariance: covariance, .. } = *self;
        UncertainPose { map_from_keyframe, covariance }
    }
}

/// The pose of one keyframe in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframePose {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth.
    pub revision: u64,
    /// Its pose in the map, with its unit.
    pub map_from_keyframe: Sim3,
}

impl KeyframePose {
    /// The pose of a keyframe.
    pub fn of(keyframe: &Keyframe) -> Self {
        let Keyframe { keyframe_id, revision, map_from_keyframe, .. } = *keyframe;
        Self { keyframe_id, revision, map_from_keyframe }
    }
}

#[cfg(test)]
mod tests {
    use super::DistanceWeights;

    #[test]
    fn each_weight_alone_reaches_the_limit_at_its_share() {
        let weights = DistanceWeights { translation: 2.0, usage: 4.0 };
        assert_eq!(weights.distance(0.5, 1.0), 1.0);
        assert_eq!(weights.distance(0.0, 0.75), 1.0);
        assert_eq!(weights.distance(0.25, 0.875), 0.5);
        assert_eq!(weights.reach(1.0), 0.5);
        assert_eq!(weights.distance(weights.reach(0.25), 1.0), 0.25);
    }
}
