//! Checks that the map still agrees with itself: wrong results are caught before they pass for poses.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::slam::depth::gaussian::{ObservationCounts, PROBE_STEP};
use crate::slam::parameter::{ParameterError, check_range};

/// Limits that a trustworthy map stays within.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ConsistencyParams {
    /// Largest share of failed searches among the hypotheses that a frame searches for or that its even sample
    /// represents. Counting the searches alone, recordings stayed below 0.57, nearly all of their frames below 0.4.
    pub max_failed_ratio: f64,
    /// Consecutive frames with more failures that reject the map: a single one may be a blink.
    pub max_failed_frames: u32,
    /// Share of the hypotheses that a keyframe must keep, and that must reach the next one.
    /// Recordings keep 0.4 at worst.
    pub min_kept_ratio: f64,
    /// Largest ratio, either way, of the mean inverse depths of successive keyframes. A new keyframe follows after a
    /// third of the mean depth: walking up to a wall gives 1.5, recordings 0.74 to 1.32.
    pub max_depth_ratio: f64,
    /// Largest share of the even sample of hypotheses that may fail in a frame on the first keyframes where the frame
    /// is also displaced against the keyframe by more than noise: a wrong start of the map exceeds it.
    pub max_start_refuted_ratio: f64,
    /// Consecutive frames above that share that reject the start. Of 16 starts on a plane with the wrong one of its two
    /// motions 15 had this many, of 45 correct ones none; at most 4 where the depth was accurate to a sixth.
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
            Self::FailedSearches => "most depth searches failed in consecutive frames",
            Self::LostDepth => "almost no depth is left",
            Self::ScaleJump => "the mean depth jumped from one keyframe to the next",
            Self::WrongStart => {
                "frames on the first keyframes do not fit the depth that the map started with"
            }
        })
    }
}

/// State of the checks from frame to frame on one keyframe.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Consistency {
    failed_frames: u32,
    refuted_frames: u32,
    most_points: usize,
}

/// Keyframes of an epoch whose frames judge its start, the first included.
pub(super) const START_KEYFRAMES: usize = 4;

/// Fewer searches than this allow no verdict on the map.
const MIN_SEARCHES: usize = 200;

impl Consistency {
    /// Takes in how much of an even sample of the depth a frame on one of the first keyframes refuted, and how far the
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

    /// Takes in the counts of a frame on a keyframe with this many points.
    pub(super) fn observe(
        &mut self,
        counts: &ObservationCounts,
        points: usize,
        params: &ConsistencyParams,
    ) -> Option<Contradiction> {
        /// A smaller searched share of the points allows no verdict either: where most of the view is new, only the
        /// edge of the map is seen.
        const MIN_SEARCHED_RATIO: f64 = 0.02;
        let enough = MIN_SEARCHED_RATIO * points as f64;
        let searched = counts.attempted + counts.probed;
        if searched >= MIN_SEARCHES && searched as f64 >= enough {
            // Hypotheses that are still refined are often those whose searches failed before, where light or a
            // reflection changed: they are the smaller part of all that the keyframe has.
            let of_all = |searched: usize, probed: usize| (searched + PROBE_STEP * probed) as f64;
            let failed_ratio =
                of_all(counts.failed, counts.refuted) / of_all(counts.attempted, counts.probed);
            let has_failed = failed_ratio > params.max_failed_ratio;
            self.failed_frames = if has_failed { self.failed_frames + 1 } else { 0 };
        } else {
            // A frame that allows no verdict does not extend a run of bad ones.
            self.failed_frames = self.failed_frames.saturating_sub(1);
        }
        (self.failed_frames >= params.max_failed_frames).then_some(Contradiction::FailedSearches)
    }

    /// Resets the counts of bad frames: the map that they failed on has been estimated again since.
    pub(super) fn forget_failures(&mut self) {
        (self.failed_frames, self.refuted_frames) = (0, 0);
    }

    /// Takes in the keyframe's current number of points.
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

/// Judges the change to a new keyframe: hypotheses before and after, and the ratio of the previous mean inverse depth
/// to the new one.
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

/// Whether the mean depths of successive keyframes may have this ratio.
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
    fn only_consecutive_failures_of_enough_searches_reject_the_map() {
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
        // Only a twentieth of the map is still uncertain: the sample of the rest holds.
        let certain = ObservationCounts { probed: 600, refuted: 20, ..counts(1000, 900) };
        let rest = (0..50).filter_map(|_| watched.observe(&certain, 20_000, &params));
        assert_eq!(rest.count(), 0);
        // Changed light fails most of the hypotheses that are still refined, which are the smaller part.
        let relit = ObservationCounts { probed: 271, refuted: 36, ..counts(3247, 3158) };
        let relit = (0..50).filter_map(|_| watched.observe(&relit, 19_000, &params));
        assert_eq!(relit.count(), 0);
        let last = (0..params.max_failed_frames)
            .map(|_| watched.observe(&counts(1000, 900), 5000, &params))
            .last();
        assert_eq!(last, Some(Some(Contradiction::FailedSearches)));
    }

    #[test]
    fn consecutive_frames_that_refute_the_first_depth_reject_the_start() {
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
