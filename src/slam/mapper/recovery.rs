//! What the mapper does while the camera is lost: it looks for it on recent keyframes, and when that
//! fails for long begins a new epoch beside the search. Whichever is first wins: until the new
//! epoch's start is proven the old one can be found again.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::align::{Aligner, Alignment, AlignmentParams};
use crate::slam::alignment::kernel::SimdMode;
use crate::slam::alignment::normal_equations::NormalEquations;
use crate::slam::alignment::reference::{Reference, ReferenceParams, finest_level, num_levels};
use crate::slam::depth::gaussian::MAX_VALIDITY;
use crate::slam::depth::map::{BORDER_PX, DepthMap, Hypothesis};
use crate::slam::depth::propagation::joined;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::image::sums::SumPyramid;
use crate::slam::keyframe::{DepthPoint, Keyframe, MapState};
use crate::slam::mapper::consistency::Contradiction;
use crate::slam::mapper::phase::{Loss, Phase};
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{Brightness, PoseEstimate};
use crate::slam::tracker::motion::turned;
use crate::slam::tracker::verdict::{VerdictParams, is_better, quality_of};

/// Tuning of the recovery from a loss.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecoveryParams {
    /// Recent keyframes of the epoch that are searched for the camera, in turn.
    pub num_keyframes: usize,
    /// Keyframes that are searched in one frame: each costs about as much as a keyframe's
    /// preparation in the tracker, and a frame must stay bounded.
    pub keyframes_per_frame: usize,
    /// The camera is looked for where the keyframe was taken and turned so far about its axes,
    /// degrees; a coarse alignment reaches about as far on each side.
    pub rotation_deg: f64,
    /// Time of the frames' stamps without success after which a new epoch is begun, seconds: two
    /// or three rounds of the search.
    pub lost_timeout_secs: f64,
}

impl Default for RecoveryParams {
    fn default() -> Self {
        Self {
            num_keyframes: 20,
            keyframes_per_frame: 1,
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

/// Looks for the camera on keyframes; owns the memory for that.
#[derive(Debug)]
pub(super) struct Finder {
    aligner: Aligner,
    verdict: VerdictParams,
    reference: Reference,
    pyramid: SumPyramid,
}

impl Finder {
    /// For images of `intrinsics`. What it finds is only proposed, and the tracker judges by
    /// its own parameters, so that the defaults do here; portable, so that every CPU finds the same.
    pub(super) fn new(intrinsics: &Intrinsics) -> Self {
        let Intrinsics { width, height, .. } = *intrinsics;
        let reference = ReferenceParams::default();
        let levels = num_levels(width, height);
        let alignment = AlignmentParams { simd: SimdMode::Portable, ..Default::default() };
        Self {
            aligner: Aligner::new(alignment),
            verdict: VerdictParams::default(),
            pyramid: SumPyramid::with_size(width, height, levels, finest_level(levels, &reference)),
            reference: Reference::new(reference),
        }
    }

    /// The next of `keyframes`, newest first and in turn after so many `searched`, that shows what `pixels` do, and
    /// the camera's pose on it.
    fn find(
        &mut self,
        keyframes: &[Keyframe],
        active: usize,
        searched: &mut usize,
        pixels: &[u8],
        params: &RecoveryParams,
    ) -> Option<(usize, SE3)> {
        let epoch = keyframes.get(active)?.epoch;
        // The tracker itself looks around the active keyframe.
        let is_eligible = |index: &usize| {
            let keyframe = &keyframes[*index];
            *index != active
                && keyframe.epoch == epoch
                && keyframe.map_state == MapState::Established
                && keyframe.has_depth()
        };
        let newest_first = (0..keyframes.len()).rev().filter(is_eligible);
        let candidates: Vec<usize> = newest_first.take(params.num_keyframes).collect();
        if candidates.is_empty() {
            return None;
        }
        self.pyramid.fill(pixels);
        for _ in 0..params.keyframes_per_frame.min(candidates.len()) {
            let index = candidates[*searched % candidates.len()];
            *searched += 1;
            let rotation_rad = params.rotation_deg.to_radians();
            if let Some(found) = self.find_near(&keyframes[index], rotation_rad) {
                return Some((index, found));
            }
        }
        None
    }

    /// Aligns a frame to `keyframe` from where the camera is expected; `None` where it does not fit.
    pub(super) fn locate(
        &mut self,
        keyframe: &Keyframe,
        pixels: &[u8],
        keyframe_from_camera: &SE3,
    ) -> Option<Alignment> {
        self.pyramid.fill(pixels);
        self.reference.prepare_into(keyframe);
        let (start, brightness) = (keyframe_from_camera.inverse(), Brightness::default());
        let (reference, pyramid) = (&self.reference, &self.pyramid);
        let found = self.aligner.align(reference, pyramid, &start, brightness, &mut |_| true);
        self.verdict.judge(&found, &quality_of(&found), true, 0).is_tracked().then_some(found)
    }

    /// `keyframe_from_camera` of the frame in the pyramid, where it can be aligned to `keyframe` from some view
    /// near it.
    fn find_near(&mut self, keyframe: &Keyframe, rotation_rad: f64) -> Option<SE3> {
        self.reference.prepare_into(keyframe);
        let (aligner, reference, pyramid) = (&self.aligner, &self.reference, &self.pyramid);
        let mut best: Option<(Alignment, NormalEquations)> = None;
        for keyframe_from_camera in turned(&SE3::identity(), rotation_rad) {
            let start = keyframe_from_camera.inverse();
            let mut other = aligner.start(reference, pyramid, &start, Brightness::default());
            let level = other.level;
            aligner.solve_level(reference, pyramid, level, &mut other, &mut |_| true);
            let explained = aligner.explanation(reference, pyramid, &other);
            if best.as_ref().is_none_or(|(_, by_best)| is_better(&explained, by_best)) {
                best = Some((other, explained));
            }
        }
        let (mut best, _) = best?;
        aligner.descend(reference, pyramid, &mut best, &mut |_| true);
        let verdict = self.verdict.judge(&best, &quality_of(&best), true, 0);
        let keyframe_from_camera = best.state.current_from_keyframe.inverse();
        (verdict.is_tracked() && keyframe_from_camera.is_finite()).then_some(keyframe_from_camera)
    }
}

impl Mapper {
    /// One frame of a loss: searches some keyframes; after the timeout gives the frame to a new
    /// start as well.
    pub(super) fn recover(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        let mut loss = self.phase.loss();
        let lost_secs = loss.lasted_secs(frame.capture_nanos);
        if let Some(active) = self.active {
            let (keyframes, params) = (&self.map.keyframes, &self.params.recovery);
            let searched = &mut loss.searched;
            let found = self.finder.find(keyframes, active.index, searched, frame.pixels, params);
            if let Some((index, keyframe_from_camera)) = found {
                return self.restore_keyframe(index, &keyframe_from_camera);
            }
        }
        self.phase = self.phase.with_loss(loss);
        let is_restarting = matches!(self.phase, Phase::Restarting(_));
        // Of a wrong start there is nothing to be found again.
        let is_wrong = matches!(self.phase, Phase::Rejected(Contradiction::WrongStart, _));
        let is_late = lost_secs >= self.params.recovery.lost_timeout_secs;
        if !(is_restarting || is_wrong || is_late) {
            return StepOutcome::default();
        }
        if !is_restarting {
            self.start.forget();
            self.phase = Phase::Restarting(loss);
        }
        self.begin(frame, pose, sensor_depth)
    }

    /// Declares the active keyframe contradictory, or all of its epoch where its start was wrong: nothing is claimed
    /// on them any more.
    pub(super) fn reject(&mut self, contradiction: Contradiction) {
        self.phase = Phase::Rejected(contradiction, Loss::default());
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

    /// Makes an earlier keyframe active again, with the depth it was left with. The camera was found on it;
    /// odometry goes on from its last pose.
    fn restore_keyframe(&mut self, index: usize, keyframe_from_camera: &SE3) -> StepOutcome {
        self.leave_keyframe();
        let Some(keyframe) = self.map.keyframes.get(index) else {
            return StepOutcome::default();
        };
        self.depth.restart(&keyframe.image, &self.params);
        restore_points(&mut self.depth.active, &keyframe.points);
        let map_from_camera = keyframe.map_from_keyframe.place(keyframe_from_camera);
        self.anchor(&map_from_camera);
        self.past.clear();
        self.drop_early_frames();
        self.phase = Phase::Mapping;
        self.enter_keyframe(index);
        StepOutcome { keyframe_restored: true, keyframe_changed: true, ..Default::default() }
    }
}

/// Puts the points of a keyframe back into its depth map: each as its filter left it, half proven, and
/// joined with what is there already if that is the same surface.
pub(super) fn restore_points(map: &mut DepthMap, points: &[DepthPoint]) {
    let inside = |at: u16, side: usize| {
        (BORDER_PX..side.saturating_sub(BORDER_PX)).contains(&usize::from(at))
    };
    let (width, height) = (map.image.width(), map.image.height());
    // A checkpoint of other parameters may hold others.
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
                true => joined(restored, hypothesis).unwrap_or(restored),
                false => restored,
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::test_scene::{CAMERA, Scene};
    use nalgebra::Vector6;

    /// A keyframe with exact depth at every fourth pixel.
    fn keyframe(scene: &Scene, keyframe_id: u64, world_from_camera: SE3) -> Keyframe {
        let view = scene.render(&CAMERA, &world_from_camera);
        let pixels = (4..CAMERA.height - 4)
            .step_by(2)
            .flat_map(|v| (4..CAMERA.width - 4).step_by(2).map(move |u| (u, v)));
        let points = pixels.map(|(u, v)| DepthPoint {
            u: u as u16,
            v: v as u16,
            inverse_depth: view.inverse_depth.at(u, v),
            variance: 1e-4,
            intensity: view.intensity.at(u, v),
        });
        Keyframe {
            keyframe_id,
            revision: 1,
            sequence: keyframe_id,
            ..Keyframe::at(
                Sim3::new(world_from_camera, 1.0),
                CAMERA,
                points.collect(),
                view.noisy(1.0, keyframe_id),
            )
        }
    }

    fn at(twist: [f64; 6]) -> SE3 {
        SE3::exp(&Vector6::from(twist))
    }

    #[test]
    fn points_that_no_filter_could_have_left_are_not_restored() {
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        let point = DepthPoint { u: 50, v: 40, inverse_depth: 1.0, variance: 1e-4, intensity: 0.0 };
        let right = CAMERA.width as u16 - 1;
        let points = [
            point,
            DepthPoint { u: 51, variance: 0.0, ..point },
            DepthPoint { u: 52, variance: f32::NAN, ..point },
            DepthPoint { u: 53, inverse_depth: -1.0, ..point },
            DepthPoint { u: right, ..point },
            DepthPoint { v: 0, ..point },
            DepthPoint { v: u16::MAX, ..point },
        ];
        restore_points(&mut map, &points);
        assert_eq!(map.num_hypotheses(), 1);
        assert!(map.hypotheses.row(40)[50].is_some());
    }

    #[test]
    fn a_known_view_is_found_on_its_keyframe_and_an_unknown_one_on_none() {
        let scene = Scene::new(3);
        let home = at([0.0; 6]);
        let away = at([0.0, 0.0, 0.0, 0.0, 1.2, 0.0]);
        let elsewhere = at([0.0, 0.0, 0.0, 0.0, 2.8, 0.0]);
        let keyframes =
            [keyframe(&scene, 0, home), keyframe(&scene, 1, away), keyframe(&scene, 2, elsewhere)];
        let params = RecoveryParams { keyframes_per_frame: 3, ..Default::default() };
        let mut searched = 0;
        let mut find = |finder: &mut Finder, view: SE3| {
            let pixels = scene.render(&CAMERA, &view).noisy(2.0, 9);
            let (index, found) = finder.find(&keyframes, 2, &mut searched, &pixels, &params)?;
            let placed = keyframes[index].map_from_keyframe.place(&found);
            let error = (view.inverse() * placed).log().norm();
            assert!(error < 0.02, "found {error} away from where it is");
            Some(index)
        };
        let mut recovery = Finder::new(&CAMERA);
        let near_home = at([0.1, -0.05, 0.1, 0.05, 0.1, -0.05]);
        assert_eq!(find(&mut recovery, near_home), Some(0));
        assert_eq!(find(&mut recovery, away * near_home), Some(1));
        assert_eq!(find(&mut recovery, at([0.0, 0.0, 0.0, 0.0, -1.5, 0.0])), None);
        assert_eq!(find(&mut recovery, elsewhere), None, "the one in force is the tracker's");
    }

    #[test]
    fn keyframes_take_turns_and_rejected_ones_and_other_epochs_are_left_out() {
        let scene = Scene::new(3);
        let known = keyframe(&scene, 0, SE3::identity());
        let mut rejected = known.clone();
        rejected.map_state = MapState::Rejected;
        let other_epoch = Keyframe { epoch: 1, ..known.clone() };
        let in_force = keyframe(&scene, 3, at([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
        let pixels = known.image.clone();
        let params = RecoveryParams::default();
        let (mut finder, mut searched) = (Finder::new(&CAMERA), 0);
        let mut find = |keyframes: &[Keyframe]| {
            let found = finder.find(keyframes, 2, &mut searched, &pixels, &params);
            (found.map(|(index, _)| index), searched)
        };
        let without = [rejected, other_epoch, in_force.clone()];
        assert_eq!(find(&without), (None, 0));
        let far = keyframe(&scene, 1, at([0.0, 0.0, 0.0, 0.0, -2.0, 0.0]));
        let with = [known, far, in_force];
        assert_eq!(find(&with), (None, 1), "the newest is first");
        assert_eq!(find(&with), (Some(0), 2));
    }

    #[test]
    fn a_depth_map_is_restored_from_its_points() {
        let scene = Scene::new(4);
        let keyframe = keyframe(&scene, 0, SE3::identity());
        let mut map = DepthMap::with_size(CAMERA.width, CAMERA.height);
        map.restart(&keyframe.image, 5.0, 100_000);
        restore_points(&mut map, &keyframe.points);
        assert_eq!(map.num_hypotheses(), keyframe.points.len());
        let point = keyframe.points[77];
        let hypothesis = map.hypotheses.at(usize::from(point.u), usize::from(point.v));
        assert_eq!(hypothesis.smoothed, point.inverse_depth);
        assert_eq!(hypothesis.variance, point.variance);
    }
}
