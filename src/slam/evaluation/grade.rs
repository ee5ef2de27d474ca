//! Grade of a run from what can be measured without ground truth: good, doubtful, poor, or not judged.
//!
//! Nothing is good by default: a map without distant keyframes that see the same place is not judged. `docs/grade.md`
//! lists the grades of all sequences against their truth, and what the grade cannot see.

use serde::{Deserialize, Serialize};

use crate::slam::counted::counted;
use crate::slam::evaluation::map_consistency::MapConsistency;

/// Fewest wide pairs: three come with the fourth keyframe that shares a view.
const MIN_WIDE_PAIRS: u64 = 3;
/// Misfit of wide pairs up to which a map is good, as a share of the image's width: 2.6 px of 640. Where the map is
/// right, what remains comes from patches that deform between the views: 1 to 2 px.
const GOOD_MISFIT: f64 = 0.004;
/// Misfit from which a map is poor: 8 px of 640, two thirds of the search range along an axis. Shifts unrelated to the
/// place have their median at 9 px, so hardly any agreement is left.
const POOR_MISFIT: f64 = 0.0125;
/// Share of frames lost, of those after the first pose, above which a run is poor: a robot is blind for every tenth
/// frame.
const POOR_LOST: f64 = 0.1;

/// The levels of a grade.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum GradeLevel {
    /// There is too little to judge by.
    #[serde(rename = "not judged")]
    NotJudged,
    /// Nothing contradicts the map, and there was something that could have.
    #[serde(rename = "good")]
    Good,
    /// The map contradicts itself somewhat, or tracking was lost.
    #[serde(rename = "doubtful")]
    Doubtful,
    /// The map contradicts itself, or tracking was lost for long.
    #[serde(rename = "poor")]
    Poor,
}

impl GradeLevel {
    /// The level in words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Doubtful => "doubtful",
            Self::Poor => "poor",
            Self::NotJudged => "not judged",
        }
    }
}

/// The figures that a grade is computed from.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GradeInput {
    /// Frames with a pose, claimed in real time or found afterwards.
    pub frames_tracked: u64,
    /// Frames without one because tracking was lost.
    pub frames_lost: u64,
    /// Number of times that tracking was lost.
    pub losses: u64,
    /// Parts of the map, each with its own coordinate frame and scale.
    pub epochs: u64,
    /// Whether poses were given: then all parts are to scale.
    pub are_poses_given: bool,
    /// Number of times that the map was found to contradict itself; 0 where unknown.
    pub rejections: u64,
    /// Frames from the first to the last.
    pub frames: u64,
    /// Width of the images, pixels.
    pub width: usize,
    /// Agreement of the keyframes.
    pub consistency: MapConsistency,
}

/// The grade of a run, why, and the figures behind it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Grade {
    /// The level.
    pub level: GradeLevel,
    /// The reasons, the gravest first, in words.
    pub reasons: Vec<String>,
    /// What this grade cannot see, in words.
    pub caveat: String,
    /// Figures of the comparison of keyframes.
    pub figures: MapConsistency,
}

impl Grade {
    /// Grades a run.
    pub fn of(input: &GradeInput) -> Self {
        let mut findings = vec![misfit(input)];
        findings.extend(losses(input));
        if input.epochs > 1 {
            let what = match input.are_poses_given {
                true => "depth was restarted in each",
                false => "each with its own scale",
            };
            let parts = format!("the map has {} separate parts, {what}", input.epochs);
            findings.push((GradeLevel::Doubtful, parts));
        }
        if input.rejections > 0 {
            let times = times(input.rejections);
            findings.push((GradeLevel::Doubtful, format!("the map contradicted itself {times}")));
        }
        let worst = findings.iter().map(|(level, _)| *level).max().unwrap_or(GradeLevel::NotJudged);
        let is_judged = findings.iter().all(|(level, _)| *level != GradeLevel::NotJudged);
        let is_certain = worst > GradeLevel::Good || is_judged;
        let level = if is_certain { worst } else { GradeLevel::NotJudged };
        // The gravest first; a good finding is listed only if the grade is good.
        findings.sort_by_key(|(level, _)| std::cmp::Reverse(*level));
        findings.retain(|(of, _)| level == GradeLevel::Good || *of != GradeLevel::Good);
        Self {
            level,
            reasons: findings.into_iter().map(|(_, reason)| reason).collect(),
            caveat: caveat(input),
            figures: input.consistency,
        }
    }
}

/// Finding from the agreement of the keyframes.
fn misfit(input: &GradeInput) -> (GradeLevel, String) {
    let figures = &input.consistency;
    if input.frames_tracked == 0 {
        return (GradeLevel::NotJudged, "no frame was tracked".to_owned());
    }
    let misfit = figures.wide_misfit_px.filter(|_| figures.wide_pairs >= MIN_WIDE_PAIRS);
    let Some(misfit) = misfit else {
        let pairs = counted(figures.wide_pairs, "pair");
        let reason = format!(
            "too few keyframes far apart see the same place ({pairs}, {MIN_WIDE_PAIRS} are needed)"
        );
        return (GradeLevel::NotJudged, reason);
    };
    let share = misfit / input.width.max(1) as f64;
    let (level, verb) = match share {
        share if share <= GOOD_MISFIT => (GradeLevel::Good, "agree to within"),
        share if share <= POOR_MISFIT => (GradeLevel::Doubtful, "disagree by"),
        _ => (GradeLevel::Poor, "disagree by"),
    };
    let pairs = figures.wide_pairs;
    let reason = format!(
        "keyframes that see the same place {verb} {misfit:.1} px (median of {pairs} pairs)"
    );
    (level, reason)
}

/// Finding from the losses of tracking.
fn losses(input: &GradeInput) -> Option<(GradeLevel, String)> {
    let after_start = input.frames_tracked + input.frames_lost;
    if input.frames_lost == 0 || input.frames_tracked == 0 {
        return None;
    }
    let share = input.frames_lost as f64 / after_start as f64;
    let level = if share > POOR_LOST { GradeLevel::Poor } else { GradeLevel::Doubtful };
    let percent = 100.0 * share;
    Some((
        level,
        format!("tracking was lost {}, for {percent:.1} % of the frames", times(input.losses)),
    ))
}

/// What the grade cannot see, in words.
fn caveat(input: &GradeInput) -> String {
    let (span, frames) = (input.consistency.longest_span_frames, input.frames);
    if span == 0 {
        return "without ground truth and without a place that is seen twice, drift cannot be detected"
            .to_owned();
    }
    format!(
        "places were seen again after at most {span} of {frames} frames; drift between places that are \
         seen only once, and an error that all keyframes share, cannot be detected without ground truth"
    )
}

fn times(count: u64) -> String {
    match count {
        1 => "once".to_owned(),
        count => format!("{count} times"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn input(misfit: f64) -> GradeInput {
        let consistency = MapConsistency {
            wide_pairs: 20,
            longest_span_frames: 80,
            wide_misfit_px: Some(misfit),
            ..Default::default()
        };
        GradeInput {
            frames_tracked: 95,
            epochs: 1,
            frames: 100,
            width: 640,
            consistency,
            ..Default::default()
        }
    }

    #[test]
    fn the_misfit_decides_and_scales_with_the_image() {
        for (misfit, width, level) in [
            (1.5, 640, GradeLevel::Good),
            (4.0, 640, GradeLevel::Doubtful),
            (9.0, 640, GradeLevel::Poor),
            (4.0, 1280, GradeLevel::Good),
            (1.5, 320, GradeLevel::Doubtful),
        ] {
            let grade = Grade::of(&GradeInput { width, ..input(misfit) });
            assert_eq!(grade.level, level, "{misfit} px of {width}");
            assert!(grade.reasons[0].contains(&format!("{misfit:.1} px")), "{:?}", grade.reasons);
            assert!(grade.caveat.contains("80 of 100 frames"), "{}", grade.caveat);
        }
    }

    #[test]
    fn nothing_is_good_by_default() {
        let untracked = Grade::of(&GradeInput::default());
        assert_eq!(untracked.level, GradeLevel::NotJudged);
        assert_eq!(untracked.reasons, ["no frame was tracked"]);
        let mut short = input(0.5);
        for (pairs, word) in [(1, "(1 pair, 3 are needed)"), (2, "(2 pairs, ")] {
            short.consistency.wide_pairs = pairs;
            let grade = Grade::of(&short);
            assert_eq!(grade.level, GradeLevel::NotJudged);
            assert!(grade.reasons[0].contains(word), "{:?}", grade.reasons);
        }
        short.consistency = MapConsistency::default();
        assert_eq!(Grade::of(&short).level, GradeLevel::NotJudged);
        // What is known to be bad is reported all the same.
        let lost = Grade::of(&GradeInput { frames_lost: 60, losses: 1, ..short });
        assert_eq!(lost.level, GradeLevel::Poor);
        assert!(
            lost.reasons.iter().any(|reason| reason.contains("lost once")),
            "{:?}",
            lost.reasons
        );
    }

    #[test]
    fn losses_parts_and_contradictions_prevent_a_good_grade() {
        let good = input(1.0);
        for (worse, word, level) in [
            (
                GradeInput { frames_lost: 2, losses: 2, ..good },
                "lost 2 times",
                GradeLevel::Doubtful,
            ),
            (GradeInput { frames_lost: 30, losses: 1, ..good }, "lost once", GradeLevel::Poor),
            (GradeInput { epochs: 3, ..good }, "each with its own scale", GradeLevel::Doubtful),
            (
                GradeInput { epochs: 3, are_poses_given: true, ..good },
                "3 separate parts, depth was restarted in each",
                GradeLevel::Doubtful,
            ),
            (
                GradeInput { rejections: 1, ..good },
                "contradicted itself once",
                GradeLevel::Doubtful,
            ),
        ] {
            let grade = Grade::of(&worse);
            assert_eq!(grade.level, level, "{word}");
            assert!(
                grade.reasons.len() == 1 && grade.reasons[0].contains(word),
                "{:?}",
                grade.reasons
            );
        }
    }
}
