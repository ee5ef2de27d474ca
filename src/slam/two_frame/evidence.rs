//! Whether two frames show parallax, or noise and rotation alone.
//!
//! A rotation leaves no trace of depth: then each depth that is fitted explains no more than one
//! degree of freedom's share of the noise. Parallax explains many times more, and leaves no point
//! behind the camera.

use serde::{Deserialize, Serialize};

use crate::slam::depth::matching::PATTERN;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::two_frame::system::{State, System};

/// What counts as proof.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvidenceParams {
    /// Shortest translation, in mean depths: 1/60 moves a point at the mean depth by 9 px of a 640 px
    /// image (Engel, Koltun, Cremers 2018 latch there).
    pub min_translation: f64,
    /// Energy that a fitted depth explains over the energy of one degree of freedom of what remains.
    /// Without parallax 1 to 3, with 9 px of it 30 to 100.
    pub min_significance: f64,
    /// Most points behind the camera, as a share of the well-placed ones. More mean a wrong minimum.
    pub max_negative_ratio: f64,
    /// Largest median of the relative standard deviation of the inverse depths.
    pub max_std_dev_ratio: f64,
    /// Least share of the points in view.
    pub min_visible_ratio: f64,
    /// Largest root mean square residual of the middle point, grey levels: above it the frames do not
    /// show the same.
    pub max_median_residual: f64,
}

impl Default for EvidenceParams {
    fn default() -> Self {
        Self {
            min_translation: 1.0 / 60.0,
            min_significance: 8.0,
            max_negative_ratio: 0.05,
            max_std_dev_ratio: 0.1,
            min_visible_ratio: 0.6,
            max_median_residual: 15.0,
        }
    }
}

impl EvidenceParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("min_translation", self.min_translation, 1e-4..=1.0)?;
        check_range("min_significance", self.min_significance, 1.0..=1e4)?;
        check_range("max_negative_ratio", self.max_negative_ratio, 0.0..=0.5)?;
        check_range("max_std_dev_ratio", self.max_std_dev_ratio, 1e-3..=1.0)?;
        check_range("min_visible_ratio", self.min_visible_ratio, 0.1..=1.0)?;
        check_range("max_median_residual", self.max_median_residual, 1.0..=255.0)
    }
}

/// What is not proven yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Waiting {
    /// The frame has too little texture for enough points.
    Texture,
    /// Too few points are in view, or they do not look alike.
    Match,
    /// A rotation explains the frame about as well.
    Significance,
    /// Too many points come out behind the camera.
    NegativeDepth,
    /// The camera has hardly moved.
    Translation,
    /// The depths are too uncertain.
    Accuracy,
    /// All is proven, but not by enough frames in a row.
    Confirmation,
}

/// Figures of one frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Evidence {
    /// Length of the translation, in mean depths.
    pub translation: f64,
    /// Energy that a fitted depth explains over that of a remaining degree of freedom.
    pub significance: f64,
    /// Share of the well-placed points that come out behind the camera.
    pub negative_ratio: f64,
    /// Median relative standard deviation of the inverse depths.
    pub median_std_dev_ratio: f64,
    /// Share of the points in view.
    pub visible_ratio: f64,
    /// Root mean square residual (Huber) of the middle point, grey levels.
    pub median_residual: f64,
}

impl Evidence {
    /// What is missing; `None` when the parallax is proven.
    pub fn missing(&self, params: &EvidenceParams) -> Option<Waiting> {
        let matches = self.visible_ratio >= params.min_visible_ratio
            && self.median_residual <= params.max_median_residual;
        let checks = [
            (matches, Waiting::Match),
            (self.significance >= params.min_significance, Waiting::Significance),
            (self.negative_ratio <= params.max_negative_ratio, Waiting::NegativeDepth),
            (self.translation >= params.min_translation, Waiting::Translation),
            (self.median_std_dev_ratio <= params.max_std_dev_ratio, Waiting::Accuracy),
        ];
        checks.iter().find(|(met, _)| !met).map(|(_, waiting)| *waiting)
    }
}

/// Variance of a residual, grey levels²: the median over the points of the energy a degree of freedom,
/// which occlusions do not raise.
pub fn residual_variance(system: &System, sorted: &mut Vec<f32>) -> f32 {
    /// Degrees of freedom of a point: its samples less its depth.
    const FREEDOM_RATIO: f32 = (PATTERN.len() as f32 - 1.0) / PATTERN.len() as f32;
    sorted.clear();
    sorted.extend(
        system.points.iter().filter(|p| p.visible).map(|p| p.energy / (p.weight * FREEDOM_RATIO)),
    );
    median(sorted).unwrap_or(f32::INFINITY)
}

/// Judges the joint fit (`state`, `joint` and its variances) against the pure `rotation`.
pub fn judge(
    state: &State,
    joint: &System,
    variances: &[f32],
    rotation: &System,
    sorted: &mut Vec<f32>,
) -> Evidence {
    /// A point whose depth is known to better than this share of the mean has a sign.
    const PLACED_STD_DEV: f32 = 0.3;
    let (mut explained, mut remaining, mut both, mut depths) = (0.0f64, 0.0f64, 0usize, 0.0f64);
    let (mut placed, mut negative) = (0usize, 0usize);
    for (i, (point, alone)) in joint.points.iter().zip(&rotation.points).enumerate() {
        if !point.visible {
            continue;
        }
        let d = state.inverse_depths[i];
        depths += f64::from(d);
        if variances[i] < PLACED_STD_DEV * PLACED_STD_DEV {
            placed += 1;
            negative += usize::from(d <= 0.0);
        }
        if alone.visible {
            explained += f64::from(alone.energy - point.energy);
            remaining += f64::from(point.energy);
            both += 1;
        }
    }
    let mean = depths / joint.num_visible.max(1) as f64;
    let median_residual = f64::from(residual_variance(joint, sorted)).sqrt();
    sorted.clear();
    let ratio = |(v, d): (&f32, &f32)| v.sqrt() / d.abs().max(f32::MIN_POSITIVE);
    sorted.extend(variances.iter().zip(&state.inverse_depths).map(ratio));
    let freedoms = (PATTERN.len() - 1) as f64;
    Evidence {
        translation: state.current_from_first.translation.norm() * mean,
        significance: if both > 0 { explained * freedoms / remaining.max(1.0) } else { 0.0 },
        // Nothing well placed proves nothing.
        negative_ratio: if placed * 2 > joint.num_visible {
            negative as f64 / placed as f64
        } else {
            1.0
        },
        median_std_dev_ratio: f64::from(median(sorted).unwrap_or(f32::INFINITY)),
        visible_ratio: joint.num_visible as f64 / joint.points.len().max(1) as f64,
        median_residual,
    }
}

/// Median; `None` of nothing.
pub fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}
