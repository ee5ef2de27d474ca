//! Whether the map still agrees with itself: what must not pass for a pose is caught here.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::{ObservationCounts, PROBE_STEP};
use crate::slam::parameter::{ParameterError, check_range};

/// What a map that can be trusted does not do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConsistencyParams {
    /// Share of the hypotheses that a frame is searched for, or that its even sample stands for, whose search may
    /// fail. By the searches alone recordings stayed below 0.57, nearly all of their frames below 0.4.
    pub max_failed_ratio: f64,
    /// Frames in a row with more failures that reject the map: one alone may be a blink.
    pub max_failed_frames: u32,
    /// Share of the hypotheses that a keyframe must keep, and that must reach the next one.
    /// Recordings keep 0.4 at worst.
    pub min_kept_ratio: f64,
    /// Largest ratio, either way, of mean inverse depths of a keyframe and the next one. A keyframe
    /// comes after a third of the mean depth: walking up to a wall gives 1.5, recordings 0.74 to 1.32.
    pub max_depth_ratio: f64,
    /// Share of the even sample of hypotheses that may fail in a frame of the first keyframes, where the frame is also
    /// displaced against the keyframe by more than noise: more is what a wrong start of the map leaves.
    pub max_start_refuted_ratio: f64,
    /// Frames in a row with more that reject the start. Of 16 starts of a plane with the wrong one of its two motions
    /// 15 had as many, of 45 right ones none; 4 at most where the depth was good to a sixth.
    pub max_start_refuted_frames: u32,
}

impl Default for ConsistencyParams {
    fn default() -> Self {
        Self {
            max_failed_ratio: 0.7,
            max_failed_frames: 5,
            min_kept_ratio: 0.1,
            max_depth_ratio: 2.5,
            max_start_refuted_ratio: 0.45,
            max_start_refuted_frames: 6,
        }
    }
}

impl ConsistencyParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_failed_ratio", self.max_failed_ratio, 0.0..=1.0)?;
        check_range("max_failed_frames", self.max_failed_frames, 1..=1000)?;
        check_range("min_kept_ratio", self.min_kept_ratio, 0.0..=1.0)?;
        check_range("max_depth_ratio", self.max_depth_ratio, 1.0..=1e6)?;
        check_range("max_start_refuted_ratio", self.max_start_refuted_ratio, 0.0..=1.0)?;
        check_range("max_start_refuted_frames", self.max_start_refuted_frames, 1..=1000)
    }
}

/// Why a map is rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Contradiction {
    /// Frame after frame most searches fail: the poses or the depths are wrong.
    FailedSearches,
    /// Almost no depth is left.
    LostDepth,
    /// The mean depth jumped from one keyframe to the next.
    ScaleJump,
    /// Frames on the first keyframes do not fit the depth that the map began with.
    WrongStart,
}

impl fmt::Display for Contradiction {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::FailedSearches => "frame after frame most searches for depth fail",
            Self::LostDepth => "almost no depth is left",
            Self::ScaleJump => "the mean depth jumped from one keyframe to the next",
            Self::WrongStart => {
                "frames on the first keyframes do not fit the depth that it began with"
            }
        })
    }
}

/// What is watched from frame to frame on one keyframe.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Consistency {
    failed_frames: u32,
    refuted_frames: u32,
    most_points: usize,
}

/// Keyframes of an epoch whose frames judge its start, the first included.
pub(super) const START_KEYFRAMES: usize = 4;

/// Fewer searches than this say nothing about the map.
const MIN_SEARCHES: usize = 200;

impl Consistency {
    /// Takes in what a frame on one of the first keyframes said of an even sample of its depth, and by how much the
    /// tiles of the image are displaced, in image widths.
    pub(super) fn observe_start(
        &mut self,
        counts: &ObservationCounts,
        displacement: f64,
        params: &ConsistencyParams,
    ) -> Option<Contradiction> {
        /// Displacement that shutter and lens seldom reach: 1.3 px of 640.
        const MIN_DISPLACEMENT: f64 = 1.3 / 640.0;
        let allowed = params.max_start_refuted_ratio * counts.probed as f64;
        let is_refuted = counts.probed >= MIN_SEARCHES
            && counts.refuted as f64 > allowed
            && displacement > MIN_DISPLACEMENT;
        self.refuted_frames = if is_refuted { self.refuted_frames + 1 } else { 0 };
        (self.refuted_frames >= params.max_start_refuted_frames)
            .then_some(Contradiction::WrongStart)
    }

    /// Takes in what a frame did to a map of `points`.
    pub(super) fn observe(
        &mut self,
        counts: &ObservationCounts,
        points: usize,
        params: &ConsistencyParams,
    ) -> Option<Contradiction> {
        /// Nor do searches of so small a share of it: where most of the view is new, what is seen of the map
        /// is its edge.
        const MIN_SEARCHED_RATIO: f64 = 0.02;
        let enough = MIN_SEARCHED_RATIO * points as f64;
        let searched = counts.attempted + counts.probed;
        if searched >= MIN_SEARCHES && searched as f64 >= enough {
            // What is searched to be learnt from is often what failed before, where light or a reflection changed: of
            // all that the keyframe knows it is the smaller part.
            let of_all = |searched: usize, probed: usize| (searched + PROBE_STEP * probed) as f64;
            let failed_ratio =
                of_all(counts.failed, counts.refuted) / of_all(counts.attempted, counts.probed);
            let has_failed = failed_ratio > params.max_failed_ratio;
            self.failed_frames = if has_failed { self.failed_frames + 1 } else { 0 };
        } else {
            // A frame that says nothing is not one of a row of bad ones.
            self.failed_frames = self.failed_frames.saturating_sub(1);
        }
        (self.failed_frames >= params.max_failed_frames).then_some(Contradiction::FailedSearches)
    }

    /// Frames that failed did so on a map that has been estimated again since.
    pub(super) fn forget_failures(&mut self) {
        (self.failed_frames, self.refuted_frames) = (0, 0);
    }

    /// Takes in how many points the keyframe has now.
    pub(super) fn count_points(
        &mut self,
        points: usize,
        params: &ConsistencyParams,
    ) -> Option<Contradiction> {
        self.most_points = self.most_points.max(points);
        let kept = params.min_kept_ratio * self.most_points as f64;
        ((points as f64) < kept).then_some(Contradiction::LostDepth)
    }
}

/// Judges the step to a new keyframe: hypotheses before and after, and the new mean inverse depth in
/// units of the one before.
pub(super) fn judge_change(
    before: usize,
    after: usize,
    depth_ratio: f64,
    params: &ConsistencyParams,
) -> Option<Contradiction> {
    if (after as f64) < params.min_kept_ratio * before as f64 {
        return Some(Contradiction::LostDepth);
    }
    (!is_plausible_ratio(depth_ratio, params)).then_some(Contradiction::ScaleJump)
}

/// Whether mean depths of one keyframe and the next may have this ratio.
pub(super) fn is_plausible_ratio(ratio: f64, params: &ConsistencyParams) -> bool {
    let bound = params.max_depth_ratio;
    ratio <= bound && ratio * bound >= 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(attempted: usize, failed: usize) -> ObservationCounts {
        ObservationCounts { attempted, failed, fused: attempted - failed, ..Default::default() }
    }

    #[test]
    fn failures_reject_only_in_a_row_and_in_number() {
        let params = ConsistencyParams::default();
        let mut watched = Consistency::default();
        for _ in 0..50 {
            for _ in 1..params.max_failed_frames {
                assert_eq!(watched.observe(&counts(1000, 900), 5000, &params), None);
            }
            assert_eq!(watched.observe(&counts(1000, 300), 5000, &params), None);
        }
        let few = (0..50).filter_map(|_| watched.observe(&counts(100, 100), 500, &params)).count();
        assert_eq!(few, 0);
        // A map of which only a twentieth is not certain yet: the sample of the others holds.
        let certain = ObservationCounts { probed: 600, refuted: 20, ..counts(1000, 900) };
        let rest = (0..50).filter_map(|_| watched.observe(&certain, 20_000, &params));
        assert_eq!(rest.count(), 0);
        // Light that has changed fails most of what is still to be learnt from, which is the smaller part.
        let relit = ObservationCounts { probed: 271, refuted: 36, ..counts(3247, 3158) };
        let relit = (0..50).filter_map(|_| watched.observe(&relit, 19_000, &params));
        assert_eq!(relit.count(), 0);
        let last = (0..params.max_failed_frames)
            .map(|_| watched.observe(&counts(1000, 900), 5000, &params))
            .last();
        assert_eq!(last, Some(Some(Contradiction::FailedSearches)));
    }

    #[test]
    fn frames_that_refute_the_first_depth_in_a_row_reject_the_start() {
        let params = ConsistencyParams::default();
        let saying = |refuted| ObservationCounts { probed: 1000, refuted, ..counts(1000, 100) };
        let shifted = 2.0 / 640.0;
        let after = |frames: u32, refuted, displacement| {
            let mut watched = Consistency::default();
            let mut last = None;
            for _ in 0..frames {
                last = watched.observe_start(&saying(refuted), displacement, &params);
            }
            last
        };
        let enough = params.max_start_refuted_frames;
        assert_eq!(after(enough, 500, shifted), Some(Contradiction::WrongStart));
        assert_eq!(after(enough - 1, 500, shifted), None);
        assert_eq!(after(50, 400, shifted), None);
        assert_eq!(after(50, 500, 1.0 / 640.0), None);
        assert_eq!(after(50, 500, f64::NAN), None);
        let mut watched = Consistency::default();
        for frame in 0..50 {
            let refuted = if frame % enough == 0 { 100 } else { 500 };
            assert_eq!(watched.observe_start(&saying(refuted), shifted, &params), None);
        }
    }

    #[test]
    fn a_jump_of_the_scale_and_a_collapse_are_rejected() {
        let params = ConsistencyParams::default();
        assert_eq!(judge_change(1000, 500, 1.4, &params), None);
        assert_eq!(judge_change(0, 0, 1.0, &params), None);
        assert_eq!(judge_change(1000, 50, 1.0, &params), Some(Contradiction::LostDepth));
        for ratio in [3.0, 0.3, f64::NAN, f64::INFINITY, 0.0] {
            assert_eq!(judge_change(1000, 900, ratio, &params), Some(Contradiction::ScaleJump));
        }
        let mut watched = Consistency::default();
        assert_eq!(watched.count_points(1000, &params), None);
        assert_eq!(watched.count_points(400, &params), None);
        assert_eq!(watched.count_points(40, &params), Some(Contradiction::LostDepth));
    }
}
