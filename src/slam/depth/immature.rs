//! One immature point: an interval of inverse depth, narrowed by a search along the epipolar segment in each new frame
//! (Engel, Koltun, Cremers 2018 §2.2).

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::{EpipolarLine, Projection, TwoView};
use crate::slam::depth::gradient_image::{BORDER_PX, GradientImage};
use crate::slam::depth::matching::is_inside;
use crate::slam::depth::pattern::{PATTERN, sample_weight};
use crate::slam::depth::segment::{Segment, search};
use crate::slam::image::quads::QuadImage;
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::Brightness;

/// Tuning of a trace.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct IntervalParams {
    /// Longest first search as a share of width + height: 30 px at 640×480.
    pub max_first_search_ratio: f32,
    /// Shortest segment that is searched, pixels: below it the depth is already certain.
    pub min_segment_px: f32,
    /// Error of a match where the gradient lies along the line, pixels: once for the search and once for the direction
    /// of the gradient.
    pub match_error_px: f32,
    /// Largest error of a match, pixels: beyond it the direction is practically unknown.
    pub max_match_error_px: f32,
    /// A match with a larger root mean square residual over the pattern (Huber) is an outlier, grey levels: 9, every
    /// sample at the end of Huber's parabola. The literature allows 13 (1.2 × 8·12² for the sum), which lets more
    /// patches that straddle two surfaces keep a wrong depth: in the simulated room 94.4 instead of 95.2 % of the
    /// unambiguous intervals then contain the truth.
    pub max_residual: f32,
    /// The last segment of a mature point is shorter, pixels.
    pub mature_segment_px: f32,
    /// The second minimum of a mature point is more than this many times worse than its best.
    pub mature_quality: f32,
    /// The standard deviation of a mature point over its inverse depth is smaller: with poses estimated on depths that
    /// are known only to a quarter, drift in the simulated room is nine times as large as with a tenth.
    pub mature_std_dev_ratio: f32,
}

impl Default for IntervalParams {
    fn default() -> Self {
        Self {
            max_first_search_ratio: 0.027,
            min_segment_px: 1.5,
            match_error_px: 0.2,
            max_match_error_px: 10.0,
            max_residual: 9.0,
            mature_segment_px: 8.0,
            mature_quality: 3.0,
            mature_std_dev_ratio: 0.1,
        }
    }
}

impl IntervalParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("max_first_search_ratio", self.max_first_search_ratio, 0.001..=0.2)?;
        check_range("min_segment_px", self.min_segment_px, 0.1..=20.0)?;
        check_range("match_error_px", self.match_error_px, 0.01..=5.0)?;
        check_range("max_match_error_px", self.max_match_error_px, 0.5..=50.0)?;
        check_range("max_residual", self.max_residual, 1.0..=255.0)?;
        check_range("mature_segment_px", self.mature_segment_px, 1.0..=100.0)?;
        check_range("mature_quality", self.mature_quality, 1.0..=100.0)?;
        check_range("mature_std_dev_ratio", self.mature_std_dev_ratio, 0.01..=10.0)
    }
}

/// The result of the last trace of a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum TraceStatus {
    /// Never traced.
    Uninitialized,
    /// Matched: the interval was updated.
    Good,
    /// The segment leaves the image, or the patch is seen much larger or smaller. Final.
    OutOfBounds,
    /// No acceptable match. A second one in a row is final.
    Outlier,
    /// The segment is so short that the depth is already certain.
    Skipped,
    /// A match would be less certain than the interval: no parallax, or the gradient lies across the line.
    BadCondition,
}

/// The effect of one frame on the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TraceCounts {
    /// Matched.
    pub good: usize,
    /// Ended by leaving the image.
    pub out_of_bounds: usize,
    /// Without an acceptable match.
    pub outlier: usize,
    /// Already certain.
    pub skipped: usize,
    /// Nothing to gain in this frame.
    pub bad_condition: usize,
    /// Not tried: ended in an earlier frame.
    pub ended: usize,
}

impl TraceCounts {
    /// The counts for one point with this `status`.
    pub(super) fn of(status: TraceStatus) -> Self {
        let mut counts = Self::default();
        match status {
            TraceStatus::Good => counts.good = 1,
            TraceStatus::OutOfBounds => counts.out_of_bounds = 1,
            TraceStatus::Outlier => counts.outlier = 1,
            TraceStatus::Skipped => counts.skipped = 1,
            TraceStatus::BadCondition => counts.bad_condition = 1,
            TraceStatus::Uninitialized => {}
        }
        counts
    }

    /// The sum of the counts of two sets of points.
    pub fn plus(self, other: Self) -> Self {
        Self {
            good: self.good + other.good,
            out_of_bounds: self.out_of_bounds + other.out_of_bounds,
            outlier: self.outlier + other.outlier,
            skipped: self.skipped + other.skipped,
            bad_condition: self.bad_condition + other.bad_condition,
            ended: self.ended + other.ended,
        }
    }
}

/// A frame to trace in.
#[derive(Debug, Clone, Copy)]
pub struct TraceFrame<'a> {
    /// Its brightness, level 0.
    pub image: &'a QuadImage,
    /// Its geometry relative to the frame of the points.
    pub view: TwoView,
    /// Its brightness relative to that frame.
    pub brightness: Brightness,
}

/// A point whose depth is still uncertain.
#[derive(Debug, Clone)]
pub struct ImmaturePoint {
    /// Column of its pixel.
    pub u: u16,
    /// Row of its pixel.
    pub v: u16,
    /// Brightness at the samples of the `PATTERN`.
    pub intensities: [f32; 8],
    /// Weight of each sample.
    pub weights: [f32; 8],
    /// Gradient structure tensor Σ g gᵀ over the pattern: uu, uv, vv.
    structure: [f32; 3],
    /// Lower end of the interval, 1/keyframe units; slightly below zero where infinity is within it.
    pub min_inverse_depth: f32,
    /// Upper end; unknown before the first match.
    pub max_inverse_depth: Option<f32>,
    /// Energy of the second minimum over that of the best; 0 before the first match.
    pub quality: f32,
    /// Position of the last match in its frame.
    pub last_match: Option<(f32, f32)>,
    /// Length of the interval's segment in the last frame, pixels; infinite before the first match.
    pub last_segment_px: f32,
    /// The result of the last trace.
    pub status: TraceStatus,
    /// Whether tracing has ended.
    ended: bool,
}

/// Standard deviations in half an interval. The interval is meant to contain the truth nearly always, hence 3σ: in the
/// simulated room with 3 grey levels of noise 66, 83 and 88 % of the mature points are then within 1, 2 and 3 σ
/// (`tests/estimation/interval_filter.rs` prints it), without noise 79, 87 and 90 %.
pub const HALF_INTERVAL_SIGMAS: f32 = 3.0;

impl ImmaturePoint {
    /// The point of pixel `(u, v)` with all depths possible; `None` within [`BORDER_PX`] of the border.
    pub fn new(image: &GradientImage, u: u16, v: u16) -> Option<Self> {
        let (width, height) = (image.width(), image.height());
        let (column, row) = (usize::from(u), usize::from(v));
        let columns = BORDER_PX..width.saturating_sub(BORDER_PX);
        let rows = BORDER_PX..height.saturating_sub(BORDER_PX);
        if !columns.contains(&column) || !rows.contains(&row) {
            return None;
        }
        let (mut intensities, mut weights, mut structure) = ([0.0; 8], [0.0; 8], [0.0; 3]);
        for (k, (x, y)) in PATTERN.iter().enumerate() {
            let i = ((row as i32 + y) * width as i32 + column as i32 + x) as usize;
            let (gu, gv) = image.gradient(i);
            intensities[k] = f32::from(image.intensity.pixels()[i]);
            weights[k] = sample_weight(gu, gv);
            structure[0] += gu * gu;
            structure[1] += gu * gv;
            structure[2] += gv * gv;
        }
        Some(Self {
            u,
            v,
            intensities,
            weights,
            structure,
            min_inverse_depth: 0.0,
            max_inverse_depth: None,
            quality: 0.0,
            last_match: None,
            last_segment_px: f32::INFINITY,
            status: TraceStatus::Uninitialized,
            ended: false,
        })
    }

    /// The point with an interval from elsewhere; it counts as unambiguous until observed otherwise.
    pub fn with_interval(self, min_inverse_depth: f32, max_inverse_depth: f32) -> Self {
        let max_inverse_depth = Some(max_inverse_depth);
        Self { min_inverse_depth, max_inverse_depth, quality: f32::INFINITY, ..self }
    }

    /// Ends the point: another filter continues with its depth.
    pub fn end(&mut self) {
        self.ended = true;
    }

    /// Centre of the interval; `None` before the first match.
    pub fn inverse_depth(&self) -> Option<f32> {
        self.max_inverse_depth.map(|max| 0.5 * (self.min_inverse_depth + max))
    }

    /// Standard deviation equivalent to the interval; `None` before the first match.
    pub fn std_dev(&self) -> Option<f32> {
        let length = self.max_inverse_depth? - self.min_inverse_depth;
        Some(0.5 * length / HALF_INTERVAL_SIGMAS)
    }

    /// Whether tracing has ended.
    pub fn is_ended(&self) -> bool {
        self.ended
    }

    /// Whether the depth is certain enough to be used.
    pub fn is_mature(&self, params: &IntervalParams) -> bool {
        let usable = matches!(
            self.status,
            TraceStatus::Good | TraceStatus::Skipped | TraceStatus::BadCondition
        );
        usable
            && self.last_segment_px < params.mature_segment_px
            && self.quality > params.mature_quality
            && self
                .std_dev()
                .zip(self.inverse_depth())
                .is_some_and(|(std_dev, d)| d > 0.0 && std_dev < params.mature_std_dev_ratio * d)
    }

    /// Multiplies the interval by `factor`.
    pub fn rescale(&mut self, factor: f32) {
        self.min_inverse_depth *= factor;
        self.max_inverse_depth = self.max_inverse_depth.map(|max| factor * max);
    }

    /// Searches for the point in a frame and narrows its interval.
    #[inline(always)]
    pub fn trace(&mut self, frame: &TraceFrame<'_>, params: &IntervalParams) -> TraceStatus {
        if self.ended {
            return self.status;
        }
        let status = self.try_trace(frame, params);
        self.ended = match status {
            TraceStatus::OutOfBounds => true,
            TraceStatus::Outlier => self.status == TraceStatus::Outlier,
            _ => false,
        };
        self.status = status;
        status
    }

    #[inline(always)]
    fn try_trace(&mut self, frame: &TraceFrame<'_>, params: &IntervalParams) -> TraceStatus {
        let segment = match self.segment(frame, params) {
            Ok(segment) => segment,
            Err(status) => return status,
        };
        let first = self.max_inverse_depth.is_none();
        let error = self.match_error(&segment, params);
        if !first && 2.0 * error > segment.length {
            return TraceStatus::BadCondition;
        }
        let error = error.min(params.max_match_error_px);
        let patch = self.brightened(&frame.brightness);
        let found = search(frame.image, &segment, &patch, self.dither());
        let samples = PATTERN.len() as f32;
        if !(found.energy <= samples * params.max_residual * params.max_residual) {
            return TraceStatus::Outlier;
        }
        let ends = [found.lambda - error, found.lambda + error].map(|lambda| {
            let (u, v) = segment.at(lambda);
            segment.line.inverse_depth_at(u, v)
        });
        let [Some(a), Some(b)] = ends else { return TraceStatus::Outlier };
        if a.max(b) < 0.0 {
            return TraceStatus::Outlier;
        }
        /// A longer search sees enough of the line to re-assess its ambiguity.
        const REJUDGE_STEPS: usize = 10;
        if first || found.quality < self.quality || found.steps > REJUDGE_STEPS {
            self.quality = found.quality;
        }
        (self.min_inverse_depth, self.max_inverse_depth) = (a.min(b), Some(a.max(b)));
        self.last_match = Some(segment.at(found.lambda));
        self.last_segment_px = 2.0 * error;
        TraceStatus::Good
    }

    /// The part of the epipolar line that the interval allows.
    #[inline(always)]
    fn segment(
        &mut self,
        frame: &TraceFrame<'_>,
        params: &IntervalParams,
    ) -> Result<Segment, TraceStatus> {
        /// Depth in the keyframe over depth in the frame at the far end: outside, the patch is seen at a different
        /// level of detail.
        const DEPTH_RATIO: std::ops::RangeInclusive<f32> = 0.75..=1.5;
        let image = frame.image;
        let line = frame.view.line(f32::from(self.u), f32::from(self.v));
        let visible = |p: &Projection| is_inside(image.width(), image.height(), p.u, p.v);
        let far = line.project(self.min_inverse_depth).filter(visible);
        let far = far.ok_or(TraceStatus::OutOfBounds)?;
        if !DEPTH_RATIO.contains(&far.depth_ratio) {
            return Err(TraceStatus::OutOfBounds);
        }
        let centre = self.inverse_depth().and_then(|d| line.project(d)).unwrap_or(far);
        let (direction, length) = match self.max_inverse_depth {
            Some(max) => {
                let near = line.project(max).filter(visible).ok_or(TraceStatus::OutOfBounds)?;
                self.extent(&far, &near, params)?
            }
            None => first_extent(image, &line, &far, params)?,
        };
        // Warped according to the centre of the interval; the literature takes the rotation alone, the upper left of
        // K R K⁻¹, which brings 2 % fewer points to maturity.
        let warp = frame.view.patch_warp(&centre);
        let determinant = warp[0] * warp[3] - warp[1] * warp[2];
        /// Area of a warped pixel: outside, the view is so oblique that the patch is not comparable.
        const AREA: std::ops::RangeInclusive<f32> = 0.3..=3.0;
        if !AREA.contains(&determinant) {
            return Err(TraceStatus::BadCondition);
        }
        let inverse_warp = [warp[3], -warp[1], -warp[2], warp[0]].map(|x| x / determinant);
        let offsets_u = PATTERN.map(|(x, y)| warp[0] * x as f32 + warp[1] * y as f32);
        let offsets_v = PATTERN.map(|(x, y)| warp[2] * x as f32 + warp[3] * y as f32);
        let start = (far.u, far.v);
        Ok(Segment { line, start, direction, length, offsets_u, offsets_v, inverse_warp })
    }

    /// Direction and length of the segment between the ends of the interval.
    #[inline(always)]
    fn extent(
        &mut self,
        far: &Projection,
        near: &Projection,
        params: &IntervalParams,
    ) -> Result<((f32, f32), f32), TraceStatus> {
        let (du, dv) = (near.u - far.u, near.v - far.v);
        let length = du.hypot(dv);
        self.last_segment_px = length;
        if length < params.min_segment_px {
            return Err(TraceStatus::Skipped);
        }
        Ok(((du / length, dv / length), length))
    }

    /// Expected error of a match, pixels: `e = c + c (h_∥ + h_⊥)/h_∥` with the structure tensor along and across the
    /// line, whose direction is warped back into the keyframe.
    #[inline(always)]
    fn match_error(&self, segment: &Segment, params: &IntervalParams) -> f32 {
        let (m, (du, dv)) = (segment.inverse_warp, segment.direction);
        let information = |x: f32, y: f32| {
            let (u, v) = (m[0] * x + m[1] * y, m[2] * x + m[3] * y);
            let h = self.structure;
            u * u * h[0] + 2.0 * u * v * h[1] + v * v * h[2]
        };
        let (along, across) = (information(du, dv), information(-dv, du));
        if !(along > 0.0) {
            return f32::INFINITY;
        }
        params.match_error_px * (1.0 + (along + across) / along)
    }

    /// The pattern's brightness as it would appear in the frame.
    #[inline(always)]
    fn brightened(&self, brightness: &Brightness) -> [f32; 8] {
        let (gain, offset) = (brightness.a.exp() as f32, brightness.b as f32);
        self.intensities.map(|i| gain * i + offset)
    }

    /// A number in [0, 1) that differs from pixel to pixel, so that no two neighbours search the same grid.
    fn dither(&self) -> f32 {
        let mixed = (u32::from(self.u) << 16 | u32::from(self.v)).wrapping_mul(0x9E37_79B9);
        ((mixed ^ (mixed >> 15)).wrapping_mul(0x85EB_CA6B) >> 8) as f32 / (1 << 24) as f32
    }
}

/// Direction and length of the first segment, which is limited only by the longest search and the epipole.
#[inline(always)]
fn first_extent(
    image: &QuadImage,
    line: &EpipolarLine,
    far: &Projection,
    params: &IntervalParams,
) -> Result<((f32, f32), f32), TraceStatus> {
    /// Motion over all depths below which the line has no direction, pixels.
    const NO_MOTION_PX: f32 = 1e-4;
    let (du, dv) = line.velocity(far);
    let speed = du.hypot(dv);
    if !(speed > NO_MOTION_PX) {
        return Err(TraceStatus::BadCondition);
    }
    let direction = (du / speed, dv / speed);
    let most = params.max_first_search_ratio * (image.width() + image.height()) as f32;
    let length = most.min(distance_to_epipole(line, far));
    let end = (far.u + length * direction.0, far.v + length * direction.1);
    if !is_inside(image.width(), image.height(), end.0, end.1) {
        return Err(TraceStatus::OutOfBounds);
    }
    Ok((direction, length))
}

/// Distance from `far` to the image of infinitely near points, if the line runs towards it.
fn distance_to_epipole(line: &EpipolarLine, far: &Projection) -> f32 {
    // With kt_z > 0 the projection runs towards kt/kt_z; else it leaves the image at a finite depth.
    if line.kt[2] > 0.0 {
        (line.kt[0] / line.kt[2] - far.u).hypot(line.kt[1] / line.kt[2] - far.v)
    } else {
        f32::INFINITY
    }
}
