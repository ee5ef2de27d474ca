//! A map that contradicts itself is estimated once more, with all of its newest keyframes free, and rejected if it
//! contradicts itself again.
//!
//! This helps where keyframes were left with wrong poses or units, not where depth is lost or the start was wrong. The
//! estimate is like any other: it is the next one to run, and enters in the same way. Until it has entered, poses
//! continue to be claimed, with the covariance of a keyframe whose depth is unknown.

use crate::slam::depth::gaussian::ObservationCounts;
use crate::slam::mapper::consistency::{Contradiction, is_plausible_ratio};
use crate::slam::mapper::phase::ElapsedTime;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::modes::ModeCovariance;
use crate::slam::pose::PoseEstimate;

/// Time by the frames' stamps within which the estimate must have entered, seconds: it waits for one that is running,
/// and takes a few tenths itself.
const MAX_WAIT_SECS: f64 = 0.7;

/// Keyframes without a contradiction after which a map may be estimated once more because of another.
const TRUSTED_AFTER: u64 = 4;

/// State of the map after a contradiction.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) enum Doubt {
    /// No contradiction since the map was started, or the camera last found on it.
    #[default]
    None,
    /// The map is to be estimated once more.
    Raised {
        /// Why.
        contradiction: Contradiction,
        /// The active keyframe at that time.
        keyframe_id: u64,
        /// Time since.
        elapsed: ElapsedTime,
        /// Frames since.
        frames: usize,
        /// Whether the estimate is under way.
        is_away: bool,
    },
    /// It was estimated again while this keyframe was active.
    Settled(u64),
}

impl Doubt {
    /// Whether the map is in doubt; if so, the next estimate is the one that settles it.
    pub(super) fn begin_estimate(&mut self) -> bool {
        let Self::Raised { is_away, .. } = self else { return false };
        *is_away = true;
        true
    }

    /// The estimate was dropped: the next one replaces it.
    pub(super) fn drop_estimate(&mut self) {
        if let Self::Raised { is_away, .. } = self {
            *is_away = false;
        }
    }
}

impl Mapper {
    /// Judges a frame's observations in the active keyframe; returns the outcome if they reject the map.
    pub(super) fn judge_frame(
        &mut self,
        observations: &ObservationCounts,
        pose: &PoseEstimate,
    ) -> Option<StepOutcome> {
        let points = self.num_points();
        let is_first = self.is_young(self.keyframe()?.epoch);
        let params = &self.params.consistency;
        let active = self.active.as_mut()?;
        let mut contradiction = active.consistency.observe(observations, points, params);
        if is_first {
            let displacement = pose.quality.displacement_px / self.intrinsics.width as f64;
            let of_start = active.consistency.observe_start(observations, displacement, params);
            contradiction = of_start.or(contradiction);
        }
        let is_rejected = contradiction.is_some_and(|contradiction| self.contradict(contradiction));
        if !(is_rejected || self.has_timed_out(pose.capture_nanos)) {
            return None;
        }
        Some(StepOutcome {
            keyframe_changed: true,
            graph_changed: contradiction == Some(Contradiction::WrongStart),
            observations: *observations,
            ..Default::default()
        })
    }

    /// Puts a map that contradicts itself in doubt, or rejects it and returns true.
    pub(super) fn contradict(&mut self, contradiction: Contradiction) -> bool {
        let may_help =
            matches!(contradiction, Contradiction::FailedSearches | Contradiction::ScaleJump);
        let active = self.keyframe().map_or(0, |keyframe| keyframe.keyframe_id);
        let is_new = match self.doubt {
            Doubt::None => true,
            Doubt::Raised { .. } if may_help => return false,
            Doubt::Raised { .. } => false,
            Doubt::Settled(then) => active >= then.saturating_add(TRUSTED_AFTER),
        };
        if may_help && is_new && self.is_estimated {
            let (elapsed, frames, is_away) = (ElapsedTime::default(), 0, false);
            self.doubt =
                Doubt::Raised { contradiction, keyframe_id: active, elapsed, frames, is_away };
            return false;
        }
        self.reject(contradiction);
        true
    }

    /// Counts a frame of a map in doubt; rejects the map and returns true if it was not estimated again in time.
    fn has_timed_out(&mut self, nanos: i64) -> bool {
        // In lockstep an estimate enters after a fixed number of frames: first one that is running, then its own.
        let least_frames = 2 * (self.params.window.delay_frames + 1);
        let Doubt::Raised { contradiction, elapsed, frames, .. } = &mut self.doubt else {
            return false;
        };
        *frames += 1;
        let is_late = elapsed.secs(nanos) > MAX_WAIT_SECS && *frames > least_frames;
        let contradiction = *contradiction;
        if is_late {
            self.reject(contradiction);
        }
        is_late
    }

    /// Publishes the modes of the active keyframe of a map in doubt as unknown until an estimate replaces them; true
    /// where that changed them.
    pub(super) fn publish_doubt(&mut self) -> bool {
        if !matches!(self.doubt, Doubt::Raised { .. }) {
            return false;
        }
        self.modes.enter(&ModeCovariance::unknown(), &self.params.modes);
        let said = self.modes.published(&self.params.modes);
        if self.keyframe().is_none_or(|keyframe| keyframe.mode_covariance == said) {
            return false;
        }
        self.revision += 1;
        self.publish_pose();
        let Some(keyframe) = self.keyframe_mut() else { return false };
        keyframe.mode_covariance = said;
        true
    }

    /// Judges a map in doubt again once its estimate has entered; true where that rejects the map.
    pub(super) fn settle_doubt(&mut self) -> bool {
        let Doubt::Raised { contradiction, keyframe_id: id, is_away: true, .. } = self.doubt else {
            return false;
        };
        let Some(active) = &mut self.active else { return false };
        active.consistency.forget_failures();
        let Some(active) = self.keyframe().map(|keyframe| keyframe.keyframe_id) else {
            return false;
        };
        self.doubt = Doubt::Settled(active);
        // The keyframe whose unit jumped: another may be active by now.
        let Some(keyframe) = self.map.get(id) else { return false };
        let (epoch, unit) = (keyframe.epoch, keyframe.map_from_keyframe.scale);
        let known = self.map.keyframes.iter().rev().filter(|k| k.epoch == epoch);
        let before = known.clone().find(|k| k.keyframe_id < id);
        // A keyframe's unit is its mean depth.
        let ratio = before.map_or(1.0, |before| unit / before.map_from_keyframe.scale);
        let jumps = contradiction == Contradiction::ScaleJump
            && !is_plausible_ratio(ratio, &self.params.consistency);
        if jumps {
            self.reject(contradiction);
        }
        jumps
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::mapper::MapperParams;
    use crate::slam::mapper::phase::{Active, Phase};
    use crate::slam::test_scene::{CAMERA, Scene};

    /// A mapper on the second of two keyframes, whose map is estimated jointly or not.
    fn mapper(is_estimated: bool) -> Mapper {
        let scene = Scene::new(3);
        let mut mapper = Mapper::new(CAMERA, MapperParams::default()).unwrap();
        let side = SE3 { translation: [0.2, 0.0, 0.0].into(), ..SE3::identity() };
        mapper.map.keyframes =
            vec![scene.keyframe(0, SE3::identity(), 1.0), scene.keyframe(1, side, 1.0)];
        mapper.active = Some(Active::new(1));
        mapper.phase = Phase::Mapping;
        mapper.is_estimated = is_estimated;
        mapper.revision = 1;
        mapper
    }

    fn is_rejected(mapper: &Mapper) -> bool {
        matches!(mapper.phase, Phase::Rejected(..))
    }

    #[test]
    fn a_first_contradiction_leads_to_another_estimate_and_a_second_one_rejects_the_map() {
        let mut mapper = mapper(true);
        assert!(!mapper.contradict(Contradiction::FailedSearches) && !is_rejected(&mapper));
        // While the estimate is pending, further contradictions change nothing.
        assert!(!mapper.contradict(Contradiction::FailedSearches));
        let mut window = mapper.begin_adjustment(false).unwrap();
        window.optimise();
        mapper.end_adjustment(window);
        assert!(!is_rejected(&mapper));
        assert_eq!(mapper.doubt, Doubt::Settled(1));
        assert!(mapper.contradict(Contradiction::FailedSearches) && is_rejected(&mapper));
    }

    #[test]
    fn contradictions_that_an_estimate_cannot_resolve_reject_the_map_at_once() {
        for contradiction in [Contradiction::LostDepth, Contradiction::WrongStart] {
            let mut mapper = mapper(true);
            assert!(mapper.contradict(contradiction) && is_rejected(&mapper));
        }
        let mut without = mapper(false);
        assert!(without.contradict(Contradiction::ScaleJump) && is_rejected(&without));
    }

    #[test]
    fn a_unit_that_still_jumps_after_the_estimate_rejects_the_map() {
        for (scale, rejects) in [(1.0, false), (3.0, true)] {
            let mut mapper = mapper(true);
            assert!(!mapper.contradict(Contradiction::ScaleJump));
            assert!(mapper.doubt.begin_estimate());
            mapper.map.keyframes[1].map_from_keyframe.scale = scale;
            assert_eq!((mapper.settle_doubt(), is_rejected(&mapper)), (rejects, rejects));
        }
    }

    #[test]
    fn a_map_that_is_not_estimated_again_is_rejected_in_time() {
        let mut mapper = mapper(true);
        mapper.contradict(Contradiction::FailedSearches);
        // A dropped estimate is repeated.
        assert!(mapper.doubt.begin_estimate());
        mapper.doubt.drop_estimate();
        assert!(!mapper.settle_doubt(), "another's estimate is not it");
        assert!(matches!(mapper.doubt, Doubt::Raised { is_away: false, .. }));
        let is_waiting =
            |mapper: &mut Mapper, frame: i64| !mapper.has_timed_out(frame * 10_000_000);
        // At 100 Hz: a higher frame rate does not shorten the time.
        let waits = (0..500).take_while(|&frame| is_waiting(&mut mapper, frame)).count();
        assert!((65..=75).contains(&waits), "{waits}");
        assert!(is_rejected(&mapper));
    }

    #[test]
    fn at_a_low_frame_rate_an_estimate_has_as_many_frames_as_it_takes() {
        let mut mapper = mapper(true);
        mapper.contradict(Contradiction::FailedSearches);
        let is_waiting =
            |mapper: &mut Mapper, frame: i64| !mapper.has_timed_out(frame * 1_000_000_000);
        let waits = (0..100).take_while(|&frame| is_waiting(&mut mapper, frame)).count();
        assert_eq!(waits, 2 * (mapper.params.window.delay_frames + 1));
    }

    #[test]
    fn the_modes_of_a_map_in_doubt_are_published_as_unknown() {
        let mut mapper = mapper(true);
        let deviations = |mapper: &Mapper| mapper.keyframe().unwrap().mode_covariance.std_devs();
        let before = mapper.keyframe().unwrap().revision;
        assert!(!mapper.publish_doubt() && deviations(&mapper).max() == 0.0);
        mapper.contradict(Contradiction::FailedSearches);
        assert!(mapper.publish_doubt() && deviations(&mapper).min() > 0.9);
        assert!(mapper.keyframe().unwrap().revision > before);
        // Once is enough, until the covariance is overwritten.
        assert!(!mapper.publish_doubt());
        mapper.keyframe_mut().unwrap().mode_covariance = ModeCovariance::ZERO;
        assert!(mapper.publish_doubt());
        // The estimate replaces it.
        let mut window = mapper.begin_adjustment(false).unwrap();
        window.optimise();
        mapper.end_adjustment(window);
        assert_eq!(mapper.doubt, Doubt::Settled(1));
        assert!(!mapper.publish_doubt() && deviations(&mapper).max() < 0.5);
    }
}
