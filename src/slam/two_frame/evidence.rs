//! Decides whether two frames show parallax, or only noise and rotation.
//!
//! A rotation contains no information about depth: each fitted depth then explains no more than one degree of freedom's
//! share of the noise. Parallax explains many times more, and leaves no point behind the camera. Nor is a motion proven
//! that another explains about as well.

use serde::{Deserialize, Serialize};

use crate::slam::depth::pattern::PATTERN;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::two_frame::hypothesis::Rival;
use crate::slam::two_frame::state::State;
use crate::slam::two_frame::system::System;
use crate::slam::upper_median::upper_median;

/// Thresholds of the proof.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvidenceParams {
    /// Shortest translation, in mean depths: 1/60 moves a point at the mean depth by 9 px of a 640 px
    /// image (Engel, Koltun, Cremers 2018 latch there).
    pub min_translation: f64,
    /// Longest translation, in mean depths. Beyond it the scene changes its size so much that nothing matches: a fit
    /// that gets there has drawn all points together on a few pixels.
    pub max_translation: f64,
    /// Shortest translation with which a start can be proven early, in mean depths: 2 px at 640. The earlier frames
    /// must confirm it; its depths are accurate to a tenth, and later frames correct them.
    pub min_early_translation: f64,
    /// Number of earlier frames that an early start needs.
    pub min_earlier_frames: usize,
    /// Least excess of another motion's energy, in this frame and the earlier ones together, as a share: residuals of a
    /// rolling shutter and the lens are of that size.
    pub min_rival_excess: f64,
    /// The same for a motion that does not rotate clearly less than its rival. On a plane the wrong motion adds a
    /// rotation to the true one, and the rolling shutter of a nodding camera favours it by up to 0.18.
    pub min_turning_rival_excess: f64,
    /// Largest ratio of its rotation to the rival's at which a motion rotates clearly less.
    pub max_turn_ratio: f64,
    /// Rotation between two motions, radians, over the translation in mean depths, below which neither rotates more.
    /// Along a plane the two differ by 1.
    pub min_turn_apart: f64,
    /// Largest median of the relative error that the uncertain pose causes in all depths together: later frames cannot
    /// see it, and take it for the shape of the scene.
    pub max_common_error: f64,
    /// Energy that a fitted depth explains over the energy of one remaining degree of freedom. Without parallax 1 to 3,
    /// with 9 px of it 30 to 100.
    pub min_significance: f64,
    /// Largest share of points behind the camera, of the well-placed ones in the half that fits best. More indicate a
    /// wrong minimum.
    pub max_negative_ratio: f64,
    /// Largest median of the relative standard deviation of the inverse depths.
    pub max_std_dev_ratio: f64,
    /// Least share of the points in view.
    pub min_visible_ratio: f64,
    /// Largest root mean square residual of the median point, grey levels: above it the frames do not show the same.
    pub max_median_residual: f64,
    /// The same as a multiple of the least residual of a frame of this start, which is the camera's noise: a fit that
    /// leaves more has ended in a wrong minimum.
    pub max_residual_growth: f64,
}

impl Default for EvidenceParams {
    fn default() -> Self {
        Self {
            min_translation: 1.0 / 60.0,
            max_translation: 0.5,
            min_early_translation: 0.004,
            min_earlier_frames: 4,
            min_rival_excess: 0.03,
            min_turning_rival_excess: 0.2,
            max_turn_ratio: 0.8,
            min_turn_apart: 0.1,
            max_common_error: 0.02,
            min_significance: 8.0,
            max_negative_ratio: 0.05,
            max_std_dev_ratio: 0.12,
            min_visible_ratio: 0.6,
            max_median_residual: 15.0,
            max_residual_growth: 2.0,
        }
    }
}

impl EvidenceParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("min_translation", self.min_translation, 1e-4..=1.0)?;
        check_range("max_translation", self.max_translation, 0.01..=100.0)?;
        check_range("min_early_translation", self.min_early_translation, 1e-4..=1.0)?;
        check_range("min_earlier_frames", self.min_earlier_frames, 1..=1000)?;
        check_range("min_rival_excess", self.min_rival_excess, 0.0..=10.0)?;
        check_range("min_turning_rival_excess", self.min_turning_rival_excess, 0.0..=10.0)?;
        check_range("max_turn_ratio", self.max_turn_ratio, 0.0..=1e6)?;
        check_range("min_turn_apart", self.min_turn_apart, 0.0..=10.0)?;
        check_range("max_common_error", self.max_common_error, 1e-3..=1.0)?;
        check_range("min_significance", self.min_significance, 1.0..=1e4)?;
        check_range("max_negative_ratio", self.max_negative_ratio, 0.0..=0.5)?;
        check_range("max_std_dev_ratio", self.max_std_dev_ratio, 1e-3..=1.0)?;
        check_range("min_visible_ratio", self.min_visible_ratio, 0.1..=1.0)?;
        check_range("max_median_residual", self.max_median_residual, 1.0..=255.0)?;
        check_range("max_residual_growth", self.max_residual_growth, 1.0..=100.0)
    }
}

/// The part of the proof that is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Waiting {
    /// The frame has too little texture for enough points.
    Texture,
    /// Too few points are in view, or they do not match.
    Match,
    /// A rotation explains the frame about as well.
    Significance,
    /// Too many points are behind the camera.
    NegativeDepth,
    /// Another motion explains the frames about as well.
    Rival,
    /// The camera has hardly moved.
    Translation,
    /// The depths are too uncertain.
    Accuracy,
    /// All is proven, but not by enough consecutive frames.
    Confirmation,
}

/// Figures of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Evidence {
    /// Length of the translation, in mean depths.
    pub translation: f64,
    /// Energy that a fitted depth explains over that of a remaining degree of freedom.
    pub significance: f64,
    /// Share of the well-placed points that are behind the camera, of the half that fits best.
    pub negative_ratio: f64,
    /// Median relative standard deviation of the inverse depths.
    pub median_std_dev_ratio: f64,
    /// Median relative error that the uncertain pose causes in all inverse depths together.
    pub common_error: f64,
    /// Share of the points in view.
    pub visible_ratio: f64,
    /// Root mean square residual (Huber) of the median point, grey levels.
    pub median_residual: f64,
    /// The least of these among the frames of this start, at least the camera's noise.
    pub least_residual: f64,
    /// Logarithm of the gain against the first frame.
    pub log_gain: f64,
    /// The second best motion; `None` where there is no other.
    pub rival: Option<Rival>,
    /// Number of earlier frames that scored the motions.
    pub earlier_frames: usize,
}

impl Evidence {
    /// The first part of the proof that is missing; `None` when the parallax is proven.
    pub fn missing(&self, params: &EvidenceParams) -> Option<Waiting> {
        /// A factor of four: no exposure changes by more within a start, and with a small gain a uniform image explains
        /// any other.
        const MAX_LOG_GAIN: f64 = 1.4;
        let matches = self.visible_ratio >= params.min_visible_ratio
            && self.translation <= params.max_translation
            && self.median_residual <= params.max_median_residual
            && self.median_residual <= params.max_residual_growth * self.least_residual
            && self.log_gain.abs() <= MAX_LOG_GAIN;
        let is_unrivalled = self.rival.is_none_or(|rival| {
            let turns_less = rival.turn_ratio <= params.max_turn_ratio
                || rival.turn_apart < params.min_turn_apart;
            let min_excess =
                if turns_less { params.min_rival_excess } else { params.min_turning_rival_excess };
            rival.excess >= min_excess
        });
        let is_accurate = self.median_std_dev_ratio <= params.max_std_dev_ratio
            && self.common_error <= params.max_common_error;
        let checks = [
            (matches, Waiting::Match),
            (self.significance >= params.min_significance, Waiting::Significance),
            (self.negative_ratio <= params.max_negative_ratio, Waiting::NegativeDepth),
            (is_unrivalled, Waiting::Rival),
            (self.has_moved(params), Waiting::Translation),
            (is_accurate, Waiting::Accuracy),
        ];
        checks.iter().find(|(met, _)| !met).map(|(_, waiting)| *waiting)
    }

    /// Whether the translation is long enough, or short but confirmed.
    fn has_moved(&self, params: &EvidenceParams) -> bool {
        let is_confirmed = self.earlier_frames >= params.min_earlier_frames;
        self.translation >= params.min_translation
            || is_confirmed && self.translation >= params.min_early_translation
    }
}

/// Degrees of freedom of a point (its samples minus its depth) over its samples.
const FREEDOM_RATIO: f32 = (PATTERN.len() as f32 - 1.0) / PATTERN.len() as f32;

/// Variance of a residual, grey levels²: the median over the points of the energy per degree of freedom, which
/// occlusions do not raise.
pub fn residual_variance(system: &System, sorted: &mut Vec<f32>) -> f32 {
    sorted.clear();
    sorted.extend(
        system.points().filter(|p| p.visible).map(|p| p.energy / (p.weight * FREEDOM_RATIO)),
    );
    upper_median(sorted, f32::total_cmp).unwrap_or(f32::INFINITY)
}

/// Judges the joint fit (`state`, `joint` and its variances) against the pure `rotation`; rival motions and earlier
/// frames are not included yet.
pub fn judge(
    state: &State,
    joint: &System,
    variances: &[f32],
    rotation: &System,
    sorted: &mut Vec<f32>,
) -> Evidence {
    /// A point whose depth is more accurate than this share of the mean has a definite sign.
    const PLACED_STD_DEV: f32 = 0.3;
    /// Standard deviations by which a point must lie behind the camera: of points at infinity every second one comes
    /// out slightly behind it.
    const BEHIND_STD_DEVS: f32 = 2.0;
    let (mut explained, mut remaining, mut both, mut depths) = (0.0f64, 0.0f64, 0usize, 0.0f64);
    let (mut placed, mut negative) = (0usize, 0usize);
    // A near point that moves far sometimes ends in a wrong minimum, also behind the camera, but does not fit there.
    let variance = residual_variance(joint, sorted);
    for (i, (point, alone)) in joint.points().zip(rotation.points()).enumerate() {
        if !point.visible {
            continue;
        }
        let d = state.inverse_depths[i];
        depths += f64::from(d);
        let fits = point.energy <= variance * point.weight * FREEDOM_RATIO;
        if fits && variances[i] < PLACED_STD_DEV * PLACED_STD_DEV {
            placed += 1;
            negative += usize::from(d < -BEHIND_STD_DEVS * variances[i].sqrt());
        }
        if alone.visible {
            explained += f64::from(alone.energy - point.energy);
            remaining += f64::from(point.energy);
            both += 1;
        }
    }
    let mean = depths / joint.num_visible.max(1) as f64;
    let median_residual = f64::from(variance).sqrt();
    sorted.clear();
    let ratio = |(v, d): (&f32, &f32)| v.sqrt() / d.abs().max(f32::MIN_POSITIVE);
    sorted.extend(variances.iter().zip(&state.inverse_depths).map(ratio));
    let freedoms = (PATTERN.len() - 1) as f64;
    Evidence {
        translation: state.current_from_first.translation.norm() * mean,
        significance: if both > 0 { explained * freedoms / remaining.max(1.0) } else { 0.0 },
        // Without well-placed points nothing is proven: half of the points fit.
        negative_ratio: if placed * 4 > joint.num_visible {
            negative as f64 / placed as f64
        } else {
            1.0
        },
        median_std_dev_ratio: f64::from(
            upper_median(sorted, f32::total_cmp).unwrap_or(f32::INFINITY),
        ),
        visible_ratio: joint.num_visible as f64 / joint.num_points.max(1) as f64,
        median_residual,
        common_error: f64::INFINITY,
        least_residual: median_residual,
        log_gain: state.brightness.a,
        rival: None,
        earlier_frames: 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Everything that a start requires.
    fn proven() -> Evidence {
        Evidence {
            translation: 0.03,
            significance: 30.0,
            negative_ratio: 0.0,
            median_std_dev_ratio: 0.05,
            visible_ratio: 0.9,
            median_residual: 3.0,
            common_error: 0.01,
            least_residual: 3.0,
            log_gain: 0.1,
            rival: None,
            earlier_frames: 8,
        }
    }

    #[test]
    fn two_motions_that_explain_the_frames_equally_prove_nothing() {
        let params = EvidenceParams::default();
        assert_eq!(proven().missing(&params), None);
        let against = |excess| {
            let rival = Some(Rival { excess, turn_ratio: 0.5, turn_apart: 1.0 });
            Evidence { rival, ..proven() }.missing(&params)
        };
        assert_eq!(against(0.2), None);
        assert_eq!(against(0.01), Some(Waiting::Rival));
        assert_eq!(against(f64::NAN), Some(Waiting::Rival));
    }

    #[test]
    fn a_motion_that_rotates_more_than_its_rival_needs_more_evidence() {
        let params = EvidenceParams::default();
        let against = |excess, turn_ratio, turn_apart| {
            let rival = Some(Rival { excess, turn_ratio, turn_apart });
            Evidence { rival, ..proven() }.missing(&params)
        };
        assert_eq!(against(0.1, 0.5, 1.0), None);
        assert_eq!(against(0.1, 1.9, 1.0), Some(Waiting::Rival));
        assert_eq!(against(0.1, f64::NAN, 1.0), Some(Waiting::Rival));
        assert_eq!(against(0.1, 1.9, f64::NAN), Some(Waiting::Rival));
        assert_eq!(against(0.4, 1.9, 1.0), None);
        assert_eq!(against(0.1, 1.9, 0.01), None, "they hardly differ in their rotation");
    }

    #[test]
    fn a_start_waits_on_an_error_common_to_all_depths_and_on_a_bad_fit() {
        let params = EvidenceParams::default();
        let uncertain = Evidence { common_error: 0.05, ..proven() };
        assert_eq!(uncertain.missing(&params), Some(Waiting::Accuracy));
        let ended_elsewhere = Evidence { median_residual: 8.0, ..proven() };
        assert_eq!(ended_elsewhere.missing(&params), Some(Waiting::Match));
        let noisy = Evidence { least_residual: 6.0, ..ended_elsewhere };
        assert_eq!(noisy.missing(&params), None);
        for gain in [0.05f64, 20.0] {
            let nearly_even = Evidence { log_gain: gain.ln(), ..proven() };
            assert_eq!(nearly_even.missing(&params), Some(Waiting::Match));
        }
    }

    #[test]
    fn a_short_translation_must_be_confirmed_by_earlier_frames() {
        let params = EvidenceParams::default();
        let early = Evidence { translation: 0.006, ..proven() };
        assert_eq!(early.missing(&params), None);
        let waits = |evidence: Evidence| evidence.missing(&params) == Some(Waiting::Translation);
        assert!(waits(Evidence { earlier_frames: 2, ..early }));
        assert!(waits(Evidence { translation: 0.001, ..early }));
        let too_far = Evidence { translation: 0.8, ..early };
        assert_eq!(too_far.missing(&params), Some(Waiting::Match));
    }
}
