//! Recovery from a loss: the mapper searches keyframes of all epochs for the camera and, if that fails for long, starts
//! a new epoch alongside the search. Whichever succeeds first wins: until the new epoch's start is proven, the camera
//! can be found in the old ones.

use serde::{Deserialize, Serialize};

use crate::slam::depth::common_error::rotation_std_dev;
use crate::slam::depth::gaussian::MAX_VALIDITY;
use crate::slam::depth::gradient_image::BORDER_PX;
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::propagation::merged_hypothesis;
use crate::slam::geometry::se3::SE3;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::mapper::consistency::Contradiction;
use crate::slam::mapper::doubt::Doubt;
use crate::slam::mapper::phase::{Loss, Phase};
use crate::slam::mapper::{Mapper, StepInput, StepOutcome};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{DegradedReason, PoseEstimate, TrackingState, full_covariance};
use crate::slam::tracker::MAX_POSE_DEVIATIONS;

/// Largest difference of two poses for one place, translation in mean depths plus rotation in radians: a wrong place is
/// further off, and a map that has drifted this far should not be continued.
pub(super) const MAX_DISAGREEMENT: f64 = 0.1;

/// How other keyframes confirm a place that was found.
pub(super) struct Confirmation {
    /// Index in the map of a keyframe that must not confirm it.
    pub except: Option<usize>,
    /// Largest difference of a pose on another keyframe from the one found, translation in mean depths plus rotation in
    /// radians.
    pub max_disagreement: f64,
}

impl Confirmation {
    /// After a loss any keyframe may confirm it.
    pub fn after_loss() -> Self {
        Self { except: None, max_disagreement: MAX_DISAGREEMENT }
    }
}

/// Tuning of the recovery from a loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecoveryParams {
    /// Keyframes, of all epochs, that are searched for the camera: those that look most like its image.
    pub num_keyframes: usize,
    /// How many of these are searched per frame, the most similar and, cyclically, the others: each costs about as much
    /// as preparing a keyframe in the tracker, and the time per frame must stay bounded.
    pub keyframes_per_frame: usize,
    /// Alignments start from the keyframe's pose and from poses turned by this angle about its axes, degrees; a coarse
    /// alignment reaches about as far on each side.
    pub rotation_deg: f64,
    /// Time of the frames' stamps without success after which a new epoch is started, seconds: two or three rounds of
    /// the search.
    pub lost_timeout_secs: f64,
}

impl Default for RecoveryParams {
    fn default() -> Self {
        Self {
            num_keyframes: 20,
            keyframes_per_frame: 2,
            rotation_deg: 6.0,
            lost_timeout_secs: 2.0,
        }
    }
}

impl RecoveryParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("num_keyframes", self.num_keyframes, 0..=10_000)?;
        check_range("keyframes_per_frame", self.keyframes_per_frame, 1..=100)?;
        check_range("rotation_deg", self.rotation_deg, 0.0..=45.0)?;
        check_range("lost_timeout_secs", self.lost_timeout_secs, 0.0..=1e6)
    }
}

impl Mapper {
    /// Uses one frame of a loss: searches some keyframes; after the timeout uses the frame for a new start as well.
    pub(super) fn recover(&mut self, input: &StepInput<'_>) -> StepOutcome {
        let StepInput { frame, pose, .. } = *input;
        let mut loss = self.phase.loss();
        // While a view holds the pose there is no loss and no new start; a pose on the map before this does not count.
        let is_held = pose.state.is_tracked()
            && !matches!(self.phase, Phase::Rejected(..))
            && !self.is_localising();
        let lost_secs = if is_held { 0.0 } else { loss.elapsed.secs(frame.capture_nanos) };
        let active = self.active.map(|active| active.index);
        if active.is_some() || self.is_localising() {
            let (keyframes, params) = (&mut self.map.keyframes, &self.params.recovery);
            let searched = &mut loss.searched;
            let found = self.finder.find(keyframes, active, searched, frame.pixels, params);
            if let Some((index, at)) = self.accepted(found, pose, frame.pixels) {
                return self.restore_keyframe(index, &at);
            }
            let (keyframes, params) = (&mut self.map.keyframes, &self.params.recovery);
            let compared = &mut loss.compared;
            let found = self.finder.find_turned(keyframes, active, compared, frame.pixels, params);
            if let Some((index, at)) = self.accepted(found, pose, frame.pixels) {
                return self.restore_keyframe(index, &at);
            }
        }
        self.phase = self.phase.with_loss(loss);
        if is_held || self.is_locating() {
            return StepOutcome::default();
        }
        let is_restarting = matches!(self.phase, Phase::Restarting(_));
        // A wrong start leaves nothing to find the camera on.
        let is_wrong = matches!(self.phase, Phase::Rejected(Contradiction::WrongStart, _));
        let is_late = lost_secs >= self.params.recovery.lost_timeout_secs;
        if !(is_restarting || is_wrong || is_late) {
            return StepOutcome::default();
        }
        if !is_restarting {
            self.start.forget();
            self.phase = Phase::Restarting(loss);
        }
        self.begin(input)
    }

    /// Returns `found` if it is confirmed and does not contradict the rotation that a view holds; otherwise the next
    /// search leaves it out.
    fn accepted(
        &mut self,
        found: Option<(usize, SE3)>,
        pose: &PoseEstimate,
        pixels: &[u8],
    ) -> Option<(usize, SE3)> {
        let (index, keyframe_from_camera) = found?;
        let is_possible = !self.contradicts_hold(pose, index, &keyframe_from_camera);
        if is_possible
            && self.finder.resembles(
                &self.map.keyframes[index],
                &keyframe_from_camera.rotation,
                pixels,
            )
            && self.is_confirmed(index, &keyframe_from_camera, pixels, &Confirmation::after_loss())
            && self.points_agree(index, &keyframe_from_camera, pixels)
        {
            return found;
        }
        self.finder.doubted = Some(index);
        None
    }

    /// Whether a pose in the epoch of a held pose is rotated against it by more than drift and uncertainty allow.
    fn contradicts_hold(&self, pose: &PoseEstimate, index: usize, at: &SE3) -> bool {
        /// Rotation by which the map may have drifted since the place was mapped, radians.
        const MAX_DRIFT_RAD: f64 = 0.15;
        let (Some(known), Some(held_on)) =
            (self.map.keyframes.get(index), self.map.get(pose.keyframe_id))
        else {
            return false;
        };
        let is_held = pose.state == TrackingState::Degraded(DegradedReason::Turning);
        if !is_held || known.epoch != held_on.epoch {
            return false;
        }
        let found = known.map_from_keyframe.transform_pose(at).rotation;
        // Without the drift of the map, which the limit allows for.
        let uncertain = rotation_std_dev(&full_covariance(&pose.covariance));
        found.angle_to(&pose.map_from_camera.rotation)
            > MAX_DRIFT_RAD + MAX_POSE_DEVIATIONS * uncertain
    }

    /// Whether another keyframe that sees the same place confirms the camera's pose: one alone may resemble something
    /// that it does not show. It is accepted alone only where the map is so young that there may be no other.
    pub(super) fn is_confirmed(
        &mut self,
        index: usize,
        keyframe_from_camera: &SE3,
        pixels: &[u8],
        by: &Confirmation,
    ) -> bool {
        /// Keyframes that are checked.
        const MAX_CONFIRMING: usize = 3;
        /// Largest distance of the camera from them, in their mean depths.
        const REACH: f64 = 0.7;
        /// Least share of their points that the camera must see: one that is turned far away sees no more of any.
        const MIN_USAGE: f64 = 0.2;
        let found = &self.map.keyframes[index];
        let epoch = found.epoch;
        let map_from_camera = found.map_from_keyframe.transform_pose(keyframe_from_camera);
        let mut others: Vec<(f64, usize, SE3)> = self
            .map
            .seen_from(epoch, &map_from_camera, REACH)
            .filter(|(other, _)| *other != index && Some(*other) != by.except)
            .filter(|(_, view)| view.usage >= MIN_USAGE)
            .filter(|(other, _)| self.map.keyframes[*other].map_state == MapState::Established)
            .map(|(other, view)| (view.usage, other, view.keyframe_from_camera))
            .collect();
        others.sort_by(|one, other| other.0.total_cmp(&one.0));
        others.truncate(MAX_CONFIRMING);
        let is_young = self.is_young(epoch);
        let mut agrees = |(_, other, expected): &(f64, usize, SE3)| {
            let keyframe = &self.map.keyframes[*other];
            self.finder.locate(keyframe, pixels, expected, by.max_disagreement).is_some()
        };
        others.is_empty() && is_young || others.iter().any(&mut agrees)
    }

    /// Whether the points of the joint estimate, where available and in view, confirm the camera's pose: each depends
    /// on several keyframes, while a keyframe's depth may depend on that keyframe alone.
    pub(super) fn points_agree(
        &mut self,
        index: usize,
        keyframe_from_camera: &SE3,
        pixels: &[u8],
    ) -> bool {
        /// Least share of the points in view that the image must agree with. Estimates have 0.9 and more, blurred
        /// images of the right place 0.44 and occasionally less, a different scene of low contrast 0.37. A wrong
        /// refusal costs a frame or two.
        const MIN_AGREEING: f64 = 0.4;
        /// Largest difference of the two poses: that of two keyframes which each differ this far from the points.
        const MAX_APART: f64 = 2.0 * MAX_DISAGREEMENT;
        let Some(window) = &mut self.window else { return true };
        let keyframe_id = self.map.keyframes[index].keyframe_id;
        let Some(seen) = window.localise(keyframe_id, keyframe_from_camera, pixels) else {
            return true;
        };
        let apart = keyframe_from_camera.inverse() * seen.keyframe_from_camera;
        seen.agreeing >= MIN_AGREEING
            && apart.translation.norm() + apart.rotation.angle() <= MAX_APART
    }

    /// Rejects the active keyframe, or its whole epoch where the start was wrong: no pose is claimed on them any more.
    pub(super) fn reject(&mut self, contradiction: Contradiction) {
        self.phase = Phase::Rejected(contradiction, Loss::default());
        self.doubt = Doubt::None;
        self.revision += 1;
        let Some(active) = self.keyframe() else { return };
        let (id, epoch, revision) = (active.keyframe_id, active.epoch, self.revision);
        let whole_epoch = contradiction == Contradiction::WrongStart;
        let is_concerned =
            |k: &&mut Keyframe| k.keyframe_id == id || whole_epoch && k.epoch == epoch;
        for keyframe in self.map.keyframes.iter_mut().filter(is_concerned) {
            keyframe.map_state = MapState::Rejected;
            keyframe.revision = revision;
        }
    }

    /// Makes an earlier keyframe, on which the camera was found, active again with the depth it was left with; odometry
    /// continues from its last pose.
    pub(super) fn restore_keyframe(
        &mut self,
        index: usize,
        keyframe_from_camera: &SE3,
    ) -> StepOutcome {
        self.deactivate_keyframe();
        let Some(keyframe) = self.map.keyframes.get(index) else {
            return StepOutcome::default();
        };
        self.depth.restart(&keyframe.image, &self.params);
        restore_points(&mut self.depth.active, &keyframe.points);
        // A keyframe of another epoch restores the pose and the unit of its map in odometry's world.
        let is_first = self.active.is_none();
        let left = self.keyframe().map(|active| active.epoch);
        if left != Some(keyframe.epoch) {
            let before = self.left_worlds.get(&keyframe.epoch).copied();
            self.left_worlds.extend(left.map(|epoch| (epoch, self.world_from_map)));
            self.world_from_map = before.unwrap_or_else(|| Self::world_from_map_of(keyframe));
        }
        self.anchor(keyframe.keyframe_id, keyframe_from_camera);
        self.past.clear();
        self.early.clear();
        self.start.give_up();
        self.phase = Phase::Mapping;
        self.doubt = Doubt::None;
        if self.is_locating() {
            return self.enter_unchanged(index);
        }
        self.activate_keyframe(index);
        // The first keyframe of a map of earlier runs publishes the others with it.
        StepOutcome::keyframe_restored(is_first)
    }
}

/// Restores the points of a keyframe to its depth map: each as its filter left it, with half the validity, and joined
/// with an existing hypothesis if that is the same surface.
pub(super) fn restore_points(map: &mut DepthMap, points: &[DepthPoint]) {
    let inside = |at: u16, side: usize| {
        (BORDER_PX..side.saturating_sub(BORDER_PX)).contains(&usize::from(at))
    };
    let (width, height) = (map.image.width(), map.image.height());
    // A checkpoint made with other parameters may hold unusable points.
    let usable = points.iter().filter(|point| {
        inside(point.u, width)
            && inside(point.v, height)
            && point.inverse_depth > 0.0
            && point.variance > 0.0
    });
    for point in usable {
        let index = usize::from(point.v) * map.image.width() + usize::from(point.u);
        if let Some(hypothesis) = map.hypotheses.pixels_mut().get_mut(index) {
            let restored = Hypothesis {
                inverse_depth: point.inverse_depth,
                variance: point.variance,
                independent: point.variance,
                smoothed: point.inverse_depth,
                validity: MAX_VALIDITY / 2,
                propagated: true,
                failures: 0,
            };
            *hypothesis = match hypothesis.is_some() {
                true => merged_hypothesis(restored, hypothesis).unwrap_or(restored),
                false => restored,
            };
        }
    }
    // Points of another image, or of other parameters, need not be candidates.
    map.sum_structure();
}

#[cfg(test)]
mod tests;
