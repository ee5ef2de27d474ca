//! The map: keyframes, where they are, and what is changed in them from outside the frame path.
//!
//! **Places.** A keyframe is placed twice: `map_from_keyframe` is the best estimate and moves when the map is
//! corrected; `world_from_keyframe` is where the odometry has it and never jumps. Both are similarities whose
//! scale is the keyframe's unit; it is chosen when the keyframe is made (mean inverse depth 1) and changes by
//! a [`Correction`] only. A frame is kept relative to its keyframe, in the keyframe's unit, and so follows it.

use std::sync::Arc;

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::matching::is_inside;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::loops::known::KnownLoops;
use crate::slam::modes::ModeCovariance;
use crate::slam::place_covariance::PlaceCovariance;

/// All keyframes of all epochs, with their depth. Each epoch has a scale and a drift of its own.
#[derive(Debug, Clone, Default)]
pub struct Map {
    /// Keyframes in order of creation.
    pub keyframes: Vec<Keyframe>,
    /// Frames that were aligned again after they were tracked, in the order of their sequence.
    pub frames: Vec<FramePlace>,
    /// Of a map that is complete: points of the joint estimation.
    pub confirmed: Vec<ConfirmedPoint>,
    /// Loops, and what the keyframes say of each other without them.
    pub loops: Arc<KnownLoops>,
    /// How often the map was corrected.
    pub revision: u64,
    /// Of a checkpoint: the keyframe that was active.
    pub active: Option<u64>,
    /// Numbers of epochs from here on are given by nobody yet; see
    /// [`Mapper::checkpoint`](crate::slam::mapper::Mapper::checkpoint).
    pub free_epoch: u32,
}

/// Where a frame is relative to its keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FramePlace {
    /// Its sequence.
    pub sequence: u64,
    /// The keyframe.
    pub keyframe_id: u64,
    /// In the keyframe's unit.
    pub keyframe_from_camera: SE3,
}

/// Where a frame is after it was aligned again.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedFrame {
    /// Its sequence.
    pub sequence: u64,
    /// Its keyframe.
    pub keyframe_id: u64,
    /// Where it is, in the unit of the map.
    pub keyframe_from_camera: SE3,
}

/// A point that several keyframes were estimated from jointly.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfirmedPoint {
    /// The keyframe that it was chosen in.
    pub keyframe_id: u64,
    /// Column of its pixel there, level 0.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Keyframes that agreed with it when it was last estimated, beside its own.
    pub confirmations: u32,
    /// 1/z along the keyframe's optical axis, one over the keyframe's unit.
    pub inverse_depth: f32,
    /// Brightness of its pixel, grey levels.
    pub intensity: f32,
}

/// Depth of a keyframe as it is known better.
#[derive(Debug, Clone, PartialEq)]
pub struct RefinedDepth {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of the keyframe that it was refined from.
    pub of_revision: u64,
    /// Its points, inverse depth in one over the keyframe's unit.
    pub points: Vec<DepthPoint>,
}

/// What is known better of the map than before: new places, depth and epochs, all at once.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Correction {
    /// Keyframes that move, each once. One that the map does not hold any more is left out.
    pub keyframes: Vec<KeyframeCorrection>,
    /// Epochs that turn out to be parts of others; done first.
    pub joins: Vec<EpochJoin>,
    /// Length of the unit that the map had in the one that it has now, where that changes for all of it alike:
    /// odometry keeps its own.
    pub unit: Option<f64>,
}

/// A keyframe's new place and depth. Frames that were tracked on it keep their pose relative to it, in its unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeCorrection {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Its new place and unit.
    pub map_from_keyframe: Sim3,
    /// What its inverse depths, in its unit, are multiplied by.
    pub depth: LogPlane,
    /// How uncertain the errors are that all of its depth shares after that; as before where nothing is said.
    pub modes: Option<ModeCovariance>,
    /// How uncertain the new place is; where nothing is said, as the old one was.
    pub place: Option<PlaceCovariance>,
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

/// One epoch that is part of another: its keyframes go over into that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpochJoin {
    /// The epoch that ends.
    pub epoch: u32,
    /// The epoch whose number stays.
    pub into: u32,
    /// Where the first one's map lies in the second one's.
    pub into_from_epoch: Sim3,
}

/// Why a correction is refused as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum CorrectionError {
    /// A place is not finite, or its scale not positive.
    #[error(
        "the correction of keyframe {0} is not a similarity, or its depth factor is not finite"
    )]
    Keyframe(u64),
    /// The same of an epoch.
    #[error("the join of epoch {0} is not a similarity, or joins the epoch to itself")]
    Join(u32),
    /// The unit is not finite, or not positive.
    #[error("the map's unit is to be changed by a factor that is not positive and finite")]
    Unit,
}

impl KeyframeCorrection {
    /// A new place alone.
    pub fn of_place(keyframe_id: u64, map_from_keyframe: Sim3) -> Self {
        let depth = LogPlane::default();
        Self { keyframe_id, map_from_keyframe, depth, modes: None, place: None }
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

    /// Applies it to points of a keyframe.
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
        /// No correction of depth is by more than a factor of e³ = 20; more is a broken solution.
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
    pub fn num_held(&self) -> usize {
        self.keyframes.iter().filter(|keyframe| !keyframe.image.is_empty()).count()
    }

    /// Its place in the list: the newest are asked for most.
    pub fn index_of(&self, keyframe_id: u64) -> Option<usize> {
        self.keyframes.iter().rposition(|keyframe| keyframe.keyframe_id == keyframe_id)
    }

    /// `map_from_camera` of a frame that is known relative to a keyframe.
    pub fn place(&self, keyframe_id: u64, keyframe_from_camera: &SE3) -> Option<SE3> {
        Some(self.get(keyframe_id)?.map_from_keyframe.place(keyframe_from_camera))
    }

    /// Keeps where a frame is that was aligned again.
    pub fn place_frame(&mut self, placed: &PlacedFrame) {
        let Some(keyframe) = self.get(placed.keyframe_id) else { return };
        let mut keyframe_from_camera = placed.keyframe_from_camera;
        keyframe_from_camera.translation /= keyframe.map_from_keyframe.scale;
        let PlacedFrame { sequence, keyframe_id, .. } = *placed;
        let frame = FramePlace { sequence, keyframe_id, keyframe_from_camera };
        match self.frames.binary_search_by_key(&sequence, |known| known.sequence) {
            Ok(known) => self.frames[known] = frame,
            Err(place) => self.frames.insert(place, frame),
        }
    }

    /// Where a frame is, if it was aligned again.
    pub fn frame(&self, sequence: u64) -> Option<&FramePlace> {
        let place = self.frames.binary_search_by_key(&sequence, |known| known.sequence).ok()?;
        self.frames.get(place)
    }

    /// Keyframes of `epoch` with image and depth that a camera sees points of, by their places in the list, with
    /// the share of their points that is in view: all whose distance from the camera is below `max_distance`
    /// of their mean depths.
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
                let keyframe_from_camera = keyframe.map_from_keyframe.locate(&map_from_camera);
                let distance = keyframe_from_camera.translation.norm();
                (distance < max_distance).then(|| {
                    let usage = keyframe.usage(&keyframe_from_camera);
                    (index, View { keyframe_from_camera, usage })
                })
            },
        )
    }

    /// Moves what a correction moves; the revisions of what changed become `revision`. Numbers are checked first,
    /// so that it is done as a whole or not at all.
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
                // The join itself is taken for exact.
                keyframe.place_covariance =
                    keyframe.place_covariance.transported(&join.into_from_epoch);
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

    /// Gives a keyframe depth that is known better, as `revision` of it.
    pub fn refine(&mut self, refined: RefinedDepth, revision: u64) {
        let Some(index) = self.index_of(refined.keyframe_id) else { return };
        let keyframe = &mut self.keyframes[index];
        (keyframe.points, keyframe.is_refined) = (refined.points, true);
        keyframe.revision = revision;
    }

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
            keyframe.forget_depth();
        }
    }
}

/// How a camera sees a keyframe.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Where it stands, in the keyframe's unit.
    pub keyframe_from_camera: SE3,
    /// Share of the keyframe's points in view, 0 to 1.
    pub usage: f64,
}

impl Keyframe {
    /// Whether it has image and depth: the oldest of a large map keep only their poses.
    pub fn has_depth(&self) -> bool {
        !self.image.is_empty() && !self.points.is_empty()
    }

    /// Whether it can be compared with others: it has image and depth that can be trusted.
    pub fn is_usable(&self) -> bool {
        self.has_depth() && self.map_state == MapState::Established
    }

    /// The same without image, its description and points.
    pub fn without_depth(&self) -> Self {
        Self { image: Arc::default(), points: Vec::new(), description: None, ..*self }
    }

    /// Gives up image, its description and points; the pose stays.
    pub fn forget_depth(&mut self) {
        (self.image, self.points, self.description) = (Arc::default(), Vec::new(), None);
    }

    /// Share of its points that a camera sees; every so many are enough for a share.
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
