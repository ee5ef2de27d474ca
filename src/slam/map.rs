//! The map: keyframes, their poses, and corrections from outside the frame path.
//!
//! **Poses.** A keyframe has two poses: `map_from_keyframe` is the best estimate and moves when the map is corrected;
//! `world_from_keyframe` is that of the odometry and never jumps. Both are similarities whose scale is the keyframe's
//! unit; it is chosen when the keyframe is created (mean inverse depth 1) and changed only by a [`Correction`]. A frame
//! is stored relative to its keyframe, in the keyframe's unit, and so follows it.

use std::sync::Arc;

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::matching::is_inside;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::keyframe_pose_covariance::{KeyframePoseCovariance, UncertainPose};
use crate::slam::loops::record::LoopRecord;
use crate::slam::modes::ModeCovariance;

/// All keyframes of all epochs, with their depth. Each epoch has its own scale and drift.
#[derive(Debug, Clone, Default)]
pub struct Map {
    /// Keyframes in order of creation.
    pub keyframes: Vec<Keyframe>,
    /// Frames that were aligned again after tracking, in order of their sequence.
    pub frames: Vec<FramePose>,
    /// Points of the joint estimation; only in a complete map.
    pub confirmed: Vec<ConfirmedPoint>,
    /// Loops, and the keyframes that each keyframe was estimated against.
    pub loops: Arc<LoopRecord>,
    /// Number of corrections of the map.
    pub revision: u64,
    /// The keyframe that was active; only in a checkpoint.
    pub active: Option<u64>,
    /// First epoch number that is still free; see [`Mapper::checkpoint`](crate::slam::mapper::Mapper::checkpoint).
    pub free_epoch: u32,
}

/// The pose of a frame relative to its keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePose {
    /// Its sequence.
    pub sequence: u64,
    /// The keyframe.
    pub keyframe_id: u64,
    /// In the keyframe's unit.
    pub keyframe_from_camera: SE3,
}

/// The pose of a frame after it was aligned again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RealignedFrame {
    /// Its sequence.
    pub sequence: u64,
    /// Its keyframe.
    pub keyframe_id: u64,
    /// Its pose, in the unit of the map.
    pub keyframe_from_camera: SE3,
}

/// A point estimated jointly from several keyframes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfirmedPoint {
    /// The keyframe in which it was selected.
    pub keyframe_id: u64,
    /// Column of its pixel there, level 0.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Keyframes, other than its own, that agreed with it in the last estimate.
    pub confirmations: u32,
    /// 1/z along the keyframe's optical axis, 1/keyframe units.
    pub inverse_depth: f32,
    /// Brightness of its pixel, grey levels.
    pub intensity: f32,
}

/// Refined depth of a keyframe.
#[derive(Debug, Clone, PartialEq)]
pub struct RefinedDepth {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of the keyframe that was refined.
    pub of_revision: u64,
    /// Its points, inverse depth in 1/keyframe units.
    pub points: Vec<DepthPoint>,
}

/// An improved estimate of the map: new poses, depth and epochs, all at once.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Correction {
    /// Keyframes that move, each once. One that the map no longer contains is ignored.
    pub keyframes: Vec<KeyframeCorrection>,
    /// Epochs found to be parts of others; applied first.
    pub joins: Vec<EpochJoin>,
    /// Length of the map's old unit in the new one, if that changes for the whole map: odometry keeps its own.
    pub unit: Option<f64>,
}

/// A keyframe's new pose and depth. Frames that were tracked on it keep their pose relative to it, in its unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeCorrection {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Its new pose and unit.
    pub map_from_keyframe: Sim3,
    /// Factor on its inverse depths, in its unit.
    pub depth: LogPlane,
    /// Covariance of the errors common to its depth after that; `None` leaves it unchanged.
    pub modes: Option<ModeCovariance>,
    /// Covariance of the new pose; `None` transports that of the old one.
    pub place: Option<KeyframePoseCovariance>,
    /// Of an estimated pose: the part of it that is relative to the keyframes that held it in place.
    pub relative_place: Option<KeyframePoseCovariance>,
}

/// A smooth correction of inverse depth: d ← d · exp(offset + per_x X + per_y Y), X and Y the coordinates of the
/// pixel's ray at depth 1.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LogPlane {
    /// At the optical axis.
    pub offset: f64,
    /// Along the columns.
    pub per_x: f64,
    /// Along the rows.
    pub per_y: f64,
}

/// One epoch that is part of another: its keyframes move to the other epoch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochJoin {
    /// The epoch that ends.
    pub epoch: u32,
    /// The epoch that remains.
    pub into: u32,
    /// Transforms the first one's map into the second one's.
    pub into_from_epoch: Sim3,
    /// Covariance of its left increment (translation, rotation, log scale).
    pub covariance: KeyframePoseCovariance,
}

/// Why a correction is rejected as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CorrectionError {
    /// A pose is not finite, or its scale not positive.
    #[error(
        "the correction of keyframe {0} is not a similarity, or its depth factor is not finite"
    )]
    Keyframe(u64),
    /// The same for an epoch.
    #[error("the join of epoch {0} is not a similarity, or joins the epoch to itself")]
    Join(u32),
    /// The unit is not finite, or not positive.
    #[error("the factor on the map's unit is not positive and finite")]
    Unit,
}

impl KeyframeCorrection {
    /// A new pose only.
    pub fn of_pose(keyframe_id: u64, map_from_keyframe: Sim3) -> Self {
        let depth = LogPlane::default();
        Self {
            keyframe_id,
            map_from_keyframe,
            depth,
            modes: None,
            place: None,
            relative_place: None,
        }
    }
}

impl EpochJoin {
    /// One without error.
    pub fn exact(epoch: u32, into: u32, into_from_epoch: Sim3) -> Self {
        Self { epoch, into, into_from_epoch, covariance: KeyframePoseCovariance::ZERO }
    }

    /// The place covariance of a keyframe that was moved by it.
    fn covariance_of(&self, moved: &Keyframe) -> KeyframePoseCovariance {
        // An increment at the origin is that of a place there.
        let origin =
            UncertainPose { map_from_keyframe: Sim3::identity(), covariance: self.covariance };
        let of_join = origin.covariance_at(&moved.map_from_keyframe.rigid.translation);
        moved.place_covariance.transported(&self.into_from_epoch).plus(&of_join)
    }
}

impl LogPlane {
    /// The factor at a pixel.
    pub fn factor(&self, intrinsics: &Intrinsics, u: f64, v: f64) -> f64 {
        let ray = intrinsics.ray(u, v);
        (self.offset + self.per_x * ray.x + self.per_y * ray.y).exp()
    }

    /// Whether it changes nothing.
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// Applies it to the points of a keyframe.
    pub fn apply(&self, intrinsics: &Intrinsics, points: &mut [DepthPoint]) {
        if self.is_identity() {
            return;
        }
        for point in points {
            let factor = self.factor(intrinsics, f64::from(point.u), f64::from(point.v)) as f32;
            point.inverse_depth *= factor;
            point.variance *= factor * factor;
        }
    }

    fn is_sane(&self) -> bool {
        /// No depth is corrected by more than a factor of e³ = 20; more is a broken solution.
        const LARGEST: f64 = 3.0;
        [self.offset, self.per_x, self.per_y].iter().all(|of| of.abs() <= LARGEST)
    }
}

impl Correction {
    /// Checks every number.
    pub fn validate(&self) -> Result<(), CorrectionError> {
        let is_broken =
            |of: &&KeyframeCorrection| !(of.map_from_keyframe.is_valid() && of.depth.is_sane());
        if let Some(broken) = self.keyframes.iter().find(is_broken) {
            return Err(CorrectionError::Keyframe(broken.keyframe_id));
        }
        if self.unit.is_some_and(|unit| !(unit.is_finite() && unit > 0.0)) {
            return Err(CorrectionError::Unit);
        }
        let is_broken =
            |join: &&EpochJoin| !join.into_from_epoch.is_valid() || join.epoch == join.into;
        self.joins
            .iter()
            .find(is_broken)
            .map_or(Ok(()), |join| Err(CorrectionError::Join(join.epoch)))
    }
}

impl Map {
    /// The keyframe with this id.
    pub fn get(&self, keyframe_id: u64) -> Option<&Keyframe> {
        self.keyframes.get(self.index_of(keyframe_id)?)
    }

    /// Keyframes that have not been reduced to their poses.
    pub fn num_with_depth(&self) -> usize {
        self.keyframes.iter().filter(|keyframe| !keyframe.image.is_empty()).count()
    }

    /// Index of a keyframe in the list. Ids ascend in a mapper's map; one of another order is searched from the end.
    pub fn index_of(&self, keyframe_id: u64) -> Option<usize> {
        let is_it = |keyframe: &Keyframe| keyframe.keyframe_id == keyframe_id;
        let place = self.keyframes.partition_point(|keyframe| keyframe.keyframe_id < keyframe_id);
        match self.keyframes.get(place).is_some_and(is_it) {
            true => Some(place),
            false => self.keyframes.iter().rposition(is_it),
        }
    }

    /// `map_from_camera` of a frame whose pose relative to a keyframe is given.
    pub fn frame_pose(&self, keyframe_id: u64, keyframe_from_camera: &SE3) -> Option<SE3> {
        Some(self.get(keyframe_id)?.map_from_keyframe.transform_pose(keyframe_from_camera))
    }

    /// Stores the pose of a frame that was aligned again.
    pub fn store_frame_pose(&mut self, placed: &RealignedFrame) {
        let Some(keyframe) = self.get(placed.keyframe_id) else { return };
        let mut keyframe_from_camera = placed.keyframe_from_camera;
        keyframe_from_camera.translation /= keyframe.map_from_keyframe.scale;
        let RealignedFrame { sequence, keyframe_id, .. } = *placed;
        let frame = FramePose { sequence, keyframe_id, keyframe_from_camera };
        match self.frames.binary_search_by_key(&sequence, |known| known.sequence) {
            Ok(known) => self.frames[known] = frame,
            Err(place) => self.frames.insert(place, frame),
        }
    }

    /// The pose of a frame, if it was aligned again.
    pub fn frame(&self, sequence: u64) -> Option<&FramePose> {
        let place = self.frames.binary_search_by_key(&sequence, |known| known.sequence).ok()?;
        self.frames.get(place)
    }

    /// Keyframes of `epoch` with image and depth of which a camera sees points, by their indices in the list, with the
    /// share of their points that is in view: all whose distance from the camera is below `max_distance` of their mean
    /// depths.
    pub fn seen_from(
        &self,
        epoch: u32,
        map_from_camera: &SE3,
        max_distance: f64,
    ) -> impl Iterator<Item = (usize, View)> {
        let map_from_camera = *map_from_camera;
        let of_epoch = self.keyframes.iter().enumerate().filter(move |(_, k)| k.epoch == epoch);
        of_epoch.filter(|(_, keyframe)| keyframe.has_depth()).filter_map(
            move |(index, keyframe)| {
                let keyframe_from_camera =
                    keyframe.map_from_keyframe.inverse_transform_pose(&map_from_camera);
                let distance = keyframe_from_camera.translation.norm();
                (distance < max_distance).then(|| {
                    let usage = keyframe.usage(&keyframe_from_camera);
                    (index, View { keyframe_from_camera, usage })
                })
            },
        )
    }

    /// Applies a correction; the revisions of changed keyframes become `revision`. Values are checked first, so that it
    /// is applied as a whole or not at all.
    pub fn correct(
        &mut self,
        correction: &Correction,
        revision: u64,
    ) -> Result<(), CorrectionError> {
        correction.validate()?;
        for join in &correction.joins {
            for keyframe in self.keyframes.iter_mut().filter(|k| k.epoch == join.epoch) {
                keyframe.epoch = join.into;
                keyframe.map_from_keyframe = join.into_from_epoch * keyframe.map_from_keyframe;
                keyframe.place_covariance = join.covariance_of(keyframe);
                keyframe.revision = revision;
            }
        }
        for corrected in &correction.keyframes {
            let Some(index) = self.index_of(corrected.keyframe_id) else { continue };
            let keyframe = &mut self.keyframes[index];
            let moved = || {
                let (was, is) = (keyframe.map_from_keyframe, corrected.map_from_keyframe);
                let unit = correction.unit.unwrap_or(1.0);
                keyframe.place_covariance.transported(&Sim3::between(&was.rigid, &is.rigid, unit))
            };
            keyframe.place_covariance = corrected.place.unwrap_or_else(moved);
            keyframe.map_from_keyframe = corrected.map_from_keyframe;
            corrected.depth.apply(&keyframe.intrinsics, &mut keyframe.points);
            keyframe.mode_covariance = corrected.modes.unwrap_or(keyframe.mode_covariance);
            keyframe.revision = revision;
        }
        self.revision += 1;
        Ok(())
    }

    /// Replaces the depth of a keyframe by refined depth, with `revision`.
    pub fn refine(&mut self, refined: RefinedDepth, revision: u64) {
        let Some(index) = self.index_of(refined.keyframe_id) else { return };
        let keyframe = &mut self.keyframes[index];
        (keyframe.points, keyframe.is_refined) = (refined.points, true);
        keyframe.revision = revision;
    }

    /// Drops image and depth of the oldest keyframes until the rest fit into `max_bytes`; their poses stay. The newest
    /// keeps everything.
    pub fn forget_depth_beyond(&mut self, max_bytes: usize) {
        let mut bytes: usize = self.keyframes.iter().map(depth_bytes).sum();
        let Some((_, older)) = self.keyframes.split_last_mut() else { return };
        for keyframe in older {
            if bytes <= max_bytes {
                return;
            }
            bytes -= depth_bytes(keyframe);
            keyframe.forget_depth();
        }
    }
}

/// A camera's view of a keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Its pose, in the keyframe's unit.
    pub keyframe_from_camera: SE3,
    /// Share of the keyframe's points in view, 0 to 1.
    pub usage: f64,
}

impl Keyframe {
    /// Whether it has image and depth: the oldest of a large map keep only their poses.
    pub fn has_depth(&self) -> bool {
        !self.image.is_empty() && !self.points.is_empty()
    }

    /// Whether both were made from the same frame. Their epochs may differ: one may have been joined to another since.
    pub fn is_same(&self, other: &Self) -> bool {
        let made = |of: &Self| (of.keyframe_id, of.sequence, of.capture_nanos, of.intrinsics);
        made(self) == made(other)
    }

    /// Whether it can be compared with others: it has image and depth, and its map is established.
    pub fn is_usable(&self) -> bool {
        self.has_depth() && self.map_state == MapState::Established
    }

    /// A copy without image, description and points.
    pub fn without_depth(&self) -> Self {
        Self { image: Arc::default(), points: Vec::new(), description: None, ..*self }
    }

    /// Drops image, description and points; the pose stays.
    pub fn forget_depth(&mut self) {
        (self.image, self.points, self.description) = (Arc::default(), Vec::new(), None);
    }

    /// Share of its points that a camera sees; a sample of them is enough.
    pub fn usage(&self, keyframe_from_camera: &SE3) -> f64 {
        const STRIDE: usize = 16;
        let Intrinsics { width, height, .. } = self.intrinsics;
        let view = TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse());
        let (mut seen, mut all) = (0u32, 0u32);
        for point in self.points.iter().step_by(STRIDE) {
            let at = view.line(f32::from(point.u), f32::from(point.v)).project(point.inverse_depth);
            seen += u32::from(at.is_some_and(|at| is_inside(width, height, at.u, at.v)));
            all += 1;
        }
        f64::from(seen) / f64::from(all.max(1))
    }
}

/// Bytes held by a keyframe's image and points.
fn depth_bytes(keyframe: &Keyframe) -> usize {
    keyframe.image.len() + keyframe.points.capacity() * size_of::<DepthPoint>()
}

#[cfg(test)]
mod tests;
