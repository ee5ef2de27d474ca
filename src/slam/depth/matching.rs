//! The search for a keyframe pixel along its epipolar segment in another frame.
//!
//! A patch of `PATTERN` samples around the pixel, warped according to the geometry, is compared at 1-px steps along the
//! segment, then refined by Gauss–Newton in one dimension. The uncertainty of the match follows Engel, Sturm, Cremers
//! 2013 §2.2–2.3, summed over the patch.

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::{EpipolarLine, Projection, TwoView};
use crate::slam::depth::gain::Uncertainty;
use crate::slam::depth::gradient_image::{BORDER_PX, GradientImage};
use crate::slam::depth::line_search::{Along, MAX_STEPS};
use crate::slam::depth::pattern::PATTERN;
use crate::slam::image::noise::ImageNoise;
use crate::slam::image::quads_kernel::Sampled;
use crate::slam::kernel::Instructions;
use crate::slam::parameter::{ParameterError, check_range};

/// Tuning of the search.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MatchingParams {
    /// The camera's noise, configured once for all modules.
    #[serde(skip)]
    pub noise: ImageNoise,
    /// Standard deviation by which errors of an estimated pose beyond its covariance misplace the epipolar line,
    /// pixels, until the matches have shown it. A given pose without covariance has none. The covariance treats the
    /// errors of points as independent; an error common to a keyframe's depth is in every pose on it and recurs in
    /// every match. `docs/depth-noise.md` has the figures.
    pub line_noise_px: f32,
    /// Share of that variance that differs from one frame to the next; the rest moves all matches of a pixel together.
    pub independent_line_ratio: f32,
    /// The same for errors of the calibration, which affect every match, pixels.
    pub calibration_noise_px: f32,
    /// Standard deviation of a match due to interpolation and sampling, pixels: measured without noise and with hardly
    /// any parallax in the simulated room.
    pub sampling_noise_px: f32,
    /// Standard deviation of a match due to the slant of surfaces, pixels at a disparity of one focal length. The patch
    /// is assumed to lie at a single depth: on a surface slanted by θ a sample r pixels off the centre is misplaced by
    /// r tan θ times the disparity in focal lengths. r is 1 to 2, and most surfaces are slanted by less than 45°.
    pub slant_noise_px: f32,
    /// Longest segment that is searched, pixels: beyond it repeated structure causes false matches.
    pub max_search_px: f32,
    /// Smallest root mean square gradient along the line over the patch, grey levels per pixel: below it noise shifts
    /// the match.
    pub min_line_gradient: f32,
    /// Largest root mean square residual of a match for a patch without gradient, grey levels.
    pub max_residual: f32,
    /// Growth of that limit with each grey level per pixel of patch gradient: sub-pixel and perspective errors are
    /// proportional to it.
    pub residual_per_gradient: f32,
    /// Minimum ratio of the second minimum to the best one.
    pub min_ambiguity_ratio: f32,
}

impl Default for MatchingParams {
    fn default() -> Self {
        Self {
            noise: ImageNoise::default(),
            line_noise_px: 1.0,
            independent_line_ratio: 0.25,
            calibration_noise_px: 0.03,
            sampling_noise_px: 0.08,
            slant_noise_px: 0.7,
            max_search_px: 40.0,
            min_line_gradient: 2.0,
            max_residual: 10.0,
            residual_per_gradient: 0.4,
            min_ambiguity_ratio: 1.5,
        }
    }
}

impl MatchingParams {
    /// Displacement of the epipolar line for a pose uncertain by `pose_noise_px`, at most the reach of a search. A pose
    /// without uncertainty counts as given: only the calibration errs then.
    pub fn line_noise_with(&self, line_noise_px: f32, pose_noise_px: f64) -> f32 {
        let is_estimated = pose_noise_px > 0.0;
        let of_pose = if is_estimated { line_noise_px.hypot(pose_noise_px as f32) } else { 0.0 };
        of_pose.hypot(self.calibration_noise_px).min(self.max_search_px)
    }

    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("line_noise_px", self.line_noise_px, 0.0..=5.0)?;
        check_range("independent_line_ratio", self.independent_line_ratio, 0.0..=1.0)?;
        check_range("calibration_noise_px", self.calibration_noise_px, 0.0..=5.0)?;
        check_range("sampling_noise_px", self.sampling_noise_px, 0.0..=2.0)?;
        check_range("slant_noise_px", self.slant_noise_px, 0.0..=20.0)?;
        check_range("max_search_px", self.max_search_px, 5.0..=90.0)?;
        check_range("min_line_gradient", self.min_line_gradient, 0.1..=50.0)?;
        check_range("max_residual", self.max_residual, 1.0..=255.0)?;
        check_range("residual_per_gradient", self.residual_per_gradient, 0.0..=10.0)?;
        check_range("min_ambiguity_ratio", self.min_ambiguity_ratio, 1.0..=100.0)
    }
}

/// The patch of a keyframe pixel: brightness as it would appear in the other frame, and gradients.
#[derive(Debug, Clone, Copy)]
pub struct Patch {
    intensity: [f32; 8],
    gradient_u: [f32; 8],
    gradient_v: [f32; 8],
}

impl Patch {
    /// The patch around `(u, v)`, at least [`BORDER_PX`] from the border, with the brightness `gain * I + offset`.
    #[inline(always)]
    pub fn new(image: &GradientImage, u: usize, v: usize, gain: f32, offset: f32) -> Self {
        let width = image.width() as i32;
        let centre = v as i32 * width + u as i32;
        let at = |k: usize| (centre + PATTERN[k].1 * width + PATTERN[k].0) as usize;
        let mut patch = Self { intensity: [0.0; 8], gradient_u: [0.0; 8], gradient_v: [0.0; 8] };
        for k in 0..PATTERN.len() {
            let i = at(k);
            let (gu, gv) = image.gradient(i);
            patch.intensity[k] = gain * f32::from(image.intensity.pixels()[i]) + offset;
            (patch.gradient_u[k], patch.gradient_v[k]) = (gain * gu, gain * gv);
        }
        patch
    }

    /// Gradient of each sample along a step in the keyframe, grey levels per step.
    #[inline(always)]
    fn gradients_along(&self, (along_u, along_v): (f32, f32)) -> [f32; 8] {
        let mut gradients = [0.0; 8];
        for k in 0..PATTERN.len() {
            gradients[k] = self.gradient_u[k] * along_u + self.gradient_v[k] * along_v;
        }
        gradients
    }
}

/// How precisely a match can be located along the line, before any search.
#[derive(Debug, Clone, Copy)]
pub struct Conditioning {
    /// Unit direction of the line in the frame, towards larger inverse depth.
    direction: (f32, f32),
    /// The same direction in the keyframe: the step there for one pixel in the frame.
    along: (f32, f32),
    /// Jacobian of the frame position with respect to the keyframe position, row-major.
    warp: [f32; 4],
    /// Mean squared gradient of the patch.
    squared_gradient: f32,
    /// Variance of the match along the line, pixels².
    pub match_variance: f32,
    /// The part that differs from one frame to the next, pixels²: the frame's noise, sampling, and a share of the
    /// line's displacement.
    pub independent_variance: f32,
    /// Without the line's displacement, pixels².
    own_variance: f32,
    /// ∂d/∂λ: inverse depth per pixel along the line.
    pub inverse_depth_per_px: f32,
}

/// A match.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Observed inverse depth.
    pub inverse_depth: f32,
    /// Its uncertainty.
    pub uncertainty: Uncertainty,
    /// Mean squared residual of the patch, grey levels².
    pub mean_squared_residual: f32,
}

/// Why there is no match.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Miss {
    /// The segment or the patch leaves the image, or the point is behind the camera.
    OutOfView,
    /// The segment is longer than the search allows.
    TooLong,
    /// The best residual exceeds what noise explains: occluded, moved or a different point.
    Mismatch,
    /// Another place on the segment matches about as well.
    Ambiguous,
}

/// A patch that shrinks or grows by more than this compares different texture.
pub(super) const DETERMINANT: std::ops::Range<f32> = 0.3..3.0;

/// Assesses the line of a pixel at the projection `at`, from the structure of its patch (Σ g_u², g_u g_v, g_v²) times
/// `gain`²; `None` where a match would carry no information: no parallax, or no gradient along the line.
#[inline(always)]
pub fn condition(
    view: &TwoView,
    line: &EpipolarLine,
    at: &Projection,
    structure: &[f32; 3],
    gain: f32,
    params: &MatchingParams,
) -> Option<Conditioning> {
    let LineAxes { direction, warp, along, across, speed } = LineAxes::of(view, line, at)?;
    let [uu, uv, vv] = structure.map(|sum| gain * gain * sum);
    let product = |a: (f32, f32), b: (f32, f32)| {
        uu * a.0 * b.0 + uv * (a.0 * b.1 + a.1 * b.0) + vv * a.1 * b.1
    };
    let measured = product(along, along);
    let samples = PATTERN.len() as f32;
    // Noise of the keyframe adds gradient: half its variance for a central difference.
    let squared_along = along.0 * along.0 + along.1 * along.1;
    let pixel_std_dev = params.noise.pixel_std_dev;
    let by_noise = 0.5 * samples * (gain * pixel_std_dev).powi(2) * squared_along;
    let information = measured - by_noise;
    if !(information >= samples * params.min_line_gradient * params.min_line_gradient) {
        return None;
    }
    let tangent = product(along, across) / information;
    let geometric = params.line_noise_px * params.line_noise_px * (1.0 + tangent * tangent);
    // Noise of the frame, and of the keyframe after the brightness change.
    let noise = (1.0 + gain * gain) * pixel_std_dev * pixel_std_dev;
    // The match is where Σ ĝ r = 0, with noisy ĝ: its variance is σ² Σ ĝ²/(Σ ĝ g)².
    let photometric = noise * measured / (information * information);
    let slant = params.slant_noise_px * view.disparity(line, at);
    let sampling = params.sampling_noise_px * params.sampling_noise_px + slant * slant;
    // The keyframe's noise and the slant affect every match alike.
    let independent = params.independent_line_ratio * geometric
        + photometric / (1.0 + gain * gain)
        + params.sampling_noise_px * params.sampling_noise_px;
    Some(Conditioning {
        direction,
        along,
        warp,
        squared_gradient: (measured + product(across, across)) / samples,
        match_variance: geometric + photometric + sampling,
        independent_variance: independent,
        own_variance: photometric + sampling,
        inverse_depth_per_px: 1.0 / speed,
    })
}

/// A line at one projection, in the frame and warped back into the keyframe.
struct LineAxes {
    /// Unit direction of the line in the frame, towards larger inverse depth.
    direction: (f32, f32),
    /// Jacobian of the frame position with respect to the keyframe position, row-major.
    warp: [f32; 4],
    /// The steps in the keyframe for one pixel in the frame, along the line and across it.
    along: (f32, f32),
    across: (f32, f32),
    /// Pixels per unit of inverse depth.
    speed: f32,
}

impl LineAxes {
    /// `None` without parallax, or if the patch is seen much smaller or larger.
    #[inline(always)]
    fn of(view: &TwoView, line: &EpipolarLine, at: &Projection) -> Option<Self> {
        let (vu, vv) = line.velocity(at);
        let speed = (vu * vu + vv * vv).sqrt();
        if !(speed > f32::MIN_POSITIVE) {
            return None;
        }
        let direction = (vu / speed, vv / speed);
        let warp = view.patch_warp(at);
        let determinant = warp[0] * warp[3] - warp[1] * warp[2];
        if !DETERMINANT.contains(&determinant) {
            return None;
        }
        let inverse = [warp[3], -warp[1], -warp[2], warp[0]].map(|x| x / determinant);
        let along = (
            inverse[0] * direction.0 + inverse[1] * direction.1,
            inverse[2] * direction.0 + inverse[3] * direction.1,
        );
        let across = (
            -inverse[0] * direction.1 + inverse[1] * direction.0,
            -inverse[2] * direction.1 + inverse[3] * direction.0,
        );
        Some(Self { direction, warp, along, across, speed })
    }
}

impl Conditioning {
    /// Uncertainty of the inverse depth after a match.
    #[inline(always)]
    pub fn predicted_uncertainty(&self) -> Uncertainty {
        self.times(self.inverse_depth_per_px * self.inverse_depth_per_px)
    }

    /// Standard deviation of a match due to image noise, sampling and slant, pixels.
    #[inline(always)]
    pub fn match_std_dev_px(&self) -> f32 {
        self.own_variance.sqrt()
    }

    /// Largest mean squared residual of a match, grey levels².
    #[inline(always)]
    fn residual_limit(&self, params: &MatchingParams) -> f32 {
        params.max_residual * params.max_residual
            + params.residual_per_gradient * params.residual_per_gradient * self.squared_gradient
    }

    #[inline(always)]
    fn times(&self, factor: f32) -> Uncertainty {
        Uncertainty {
            variance: factor * self.match_variance,
            independent: factor * self.independent_variance,
        }
    }
}

/// The part of a line that is searched.
#[derive(Debug, Clone, Copy)]
pub struct SearchRange {
    /// The end of smaller inverse depth.
    pub from: Projection,
    /// The end of larger inverse depth.
    pub to: Projection,
    /// Longest range that is searched, pixels. At most a hundred positions a pixel apart are tried.
    pub max_px: f32,
}

/// Searches a part of the line; a segment shorter than a pixel is only refined.
#[inline(always)]
pub fn search<S: Instructions>(
    frame: Sampled<'_, S>,
    line: &EpipolarLine,
    patch: &Patch,
    conditioning: &Conditioning,
    range: &SearchRange,
    params: &MatchingParams,
) -> Result<Match, Miss> {
    /// Shorter segments are within the reach of the refinement.
    const MIN_SEARCH_PX: f32 = 1.0;
    /// Reach of the refinement from its start, pixels.
    const REFINE_REACH_PX: f32 = 1.5;
    let SearchRange { from, to, max_px } = range;
    let (du, dv) = conditioning.direction;
    let length = (to.u - from.u) * du + (to.v - from.v) * dv;
    if !(length <= *max_px) || length < 0.0 {
        return Err(Miss::TooLong);
    }
    let middle = (0.5 * (from.u + to.u), 0.5 * (from.v + to.v));
    let reach = 0.5 * length + REFINE_REACH_PX;
    let (width, height) = (frame.image.width(), frame.image.height());
    if !is_inside(width, height, middle.0 - reach * du, middle.1 - reach * dv)
        || !is_inside(width, height, middle.0 + reach * du, middle.1 + reach * dv)
    {
        return Err(Miss::OutOfView);
    }
    let along = along(frame, patch, conditioning, middle);
    let steps =
        if length < MIN_SEARCH_PX { 0 } else { (length.ceil() as usize).min(MAX_STEPS - 1) };
    let best =
        if steps == 0 { along.evaluate_at(0.0) } else { along.scan(-0.5 * steps as f32, steps) };
    let gradients = patch.gradients_along(conditioning.along);
    let (lambda, cost) = along.refine(&best, |_| gradients, REFINE_REACH_PX);
    let mean_squared_residual = cost / PATTERN.len() as f32;
    if !(mean_squared_residual <= conditioning.residual_limit(params)) {
        // What matches may be behind the mask.
        let is_hidden = |step: usize| along.is_hidden(step as f32 - 0.5 * steps as f32);
        let may_be_hidden = frame.image.has_hidden() && (0..=steps).any(is_hidden);
        return Err(if may_be_hidden { Miss::OutOfView } else { Miss::Mismatch });
    }
    if along.is_hidden(lambda) {
        return Err(Miss::OutOfView);
    }
    let pixel_std_dev = params.noise.pixel_std_dev;
    let noise_floor = 2.0 * pixel_std_dev * pixel_std_dev * PATTERN.len() as f32;
    if best.second < params.min_ambiguity_ratio * cost.max(noise_floor) {
        return Err(Miss::Ambiguous);
    }
    let (u, v) = (middle.0 + lambda * du, middle.1 + lambda * dv);
    let inverse_depth = line.inverse_depth_at(u, v).ok_or(Miss::OutOfView)?;
    // ∂d/∂λ at the match: it changes along the line when the camera moves towards the scene.
    let at = line.project(inverse_depth).ok_or(Miss::OutOfView)?;
    let (vu, vv) = line.velocity(&at);
    let alpha = 1.0 / (vu * vu + vv * vv).sqrt().max(f32::MIN_POSITIVE);
    let uncertainty = conditioning.times(alpha * alpha);
    Ok(Match { inverse_depth, uncertainty, mean_squared_residual })
}

/// The patch of a keyframe pixel in a frame, starting at `middle` along its line.
#[inline(always)]
fn along<'a, S: Instructions>(
    frame: Sampled<'a, S>,
    patch: &'a Patch,
    conditioning: &Conditioning,
    middle: (f32, f32),
) -> Along<'a, S> {
    let Conditioning { direction, warp, .. } = *conditioning;
    let (mut u, mut v) = ([0.0; 8], [0.0; 8]);
    for k in 0..PATTERN.len() {
        let (x, y) = (PATTERN[k].0 as f32, PATTERN[k].1 as f32);
        u[k] = middle.0 + (warp[0] * x + warp[1] * y);
        v[k] = middle.1 + (warp[2] * x + warp[3] * y);
    }
    Along { frame, intensity: &patch.intensity, direction, u, v }
}

/// How far inside the frame a patch must be: it reaches 2 px, stretched by at most √3 (see [`condition`]), plus one for
/// the bilinear sample.
pub(super) const MARGIN_PX: f32 = BORDER_PX as f32 + 1.0;

/// Whether a patch at this position lies inside the image; false for NaN.
#[inline]
pub fn is_inside(width: usize, height: usize, u: f32, v: f32) -> bool {
    u >= MARGIN_PX
        && v >= MARGIN_PX
        && u < width as f32 - 1.0 - MARGIN_PX
        && v < height as f32 - 1.0 - MARGIN_PX
}

#[cfg(test)]
mod tests;
