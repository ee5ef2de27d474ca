//! The interval filter: immature points chosen evenly over a frame and traced through the frames that
//! follow until their depth is certain (Engel, Koltun, Cremers 2018 §2.2).

use rayon::prelude::*;

use crate::slam::depth::candidate::{Candidate, CandidateParams, CandidateSelector};
use crate::slam::depth::immature::{ImmaturePoint, IntervalParams, TraceFrame, TraceStatus};
use crate::slam::depth::map::GradientImage;

/// What one frame did to the points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TraceCounts {
    /// Matched.
    pub good: usize,
    /// Ended by leaving the image.
    pub out_of_bounds: usize,
    /// Without an acceptable match.
    pub outlier: usize,
    /// Certain already.
    pub skipped: usize,
    /// Nothing to gain in this frame.
    pub bad_condition: usize,
    /// Not tried: ended in an earlier frame.
    pub ended: usize,
}

impl TraceCounts {
    fn of(status: TraceStatus) -> Self {
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

    /// The counts of two sets of points together.
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

/// A depth that became certain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatureDepth {
    /// Column of the pixel.
    pub u: u16,
    /// Row of the pixel.
    pub v: u16,
    /// Middle of the interval, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance that belongs to the interval.
    pub variance: f32,
}

/// Standard deviations in half an interval: it holds the truth in about 95 of 100 points.
const HALF_INTERVAL_SIGMAS: f32 = 2.0;

/// The immature points of one keyframe.
#[derive(Debug, Default)]
pub struct IntervalFilter {
    points: Vec<ImmaturePoint>,
    selector: CandidateSelector,
    candidates: Vec<Candidate>,
}

impl IntervalFilter {
    /// Starts over on a new image: evenly chosen points, all depths possible.
    pub fn restart(&mut self, image: &GradientImage, params: &CandidateParams) {
        self.selector.choose(image, params, &mut self.candidates);
        self.points.clear();
        let points = self.candidates.iter().filter_map(|c| ImmaturePoint::new(image, c.u, c.v));
        self.points.extend(points);
    }

    /// Traces every point in a frame. Points are independent: the result does not depend on the number
    /// of threads.
    pub fn trace(&mut self, frame: &TraceFrame<'_>, params: &IntervalParams) -> TraceCounts {
        /// Points a thread takes at once: some tens of microseconds.
        const CHUNK: usize = 128;
        self.points
            .par_chunks_mut(CHUNK)
            .map(|points| {
                points.iter_mut().fold(TraceCounts::default(), |counts, point| {
                    if point.is_ended() {
                        return counts.plus(TraceCounts { ended: 1, ..Default::default() });
                    }
                    counts.plus(TraceCounts::of(point.trace(frame, params)))
                })
            })
            .reduce(TraceCounts::default, TraceCounts::plus)
    }

    /// All points, in the order of their choice.
    pub fn points(&self) -> &[ImmaturePoint] {
        &self.points
    }

    /// The depths that are certain, in the order of the points.
    pub fn mature(&self, params: &IntervalParams) -> impl Iterator<Item = MatureDepth> {
        self.points.iter().filter(|p| p.is_mature(params)).filter_map(|p| {
            let (inverse_depth, max) = (p.inverse_depth()?, p.max_inverse_depth?);
            let std_dev = (max - inverse_depth) / HALF_INTERVAL_SIGMAS;
            Some(MatureDepth { u: p.u, v: p.v, inverse_depth, variance: std_dev * std_dev })
        })
    }

    /// Multiplies every interval by `factor`.
    pub fn rescale(&mut self, factor: f32) {
        self.points.iter_mut().for_each(|p| p.rescale(factor));
    }
}

/// The interval of a point after one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntervalSample {
    /// Lower end, 1/keyframe units.
    pub min_inverse_depth: f32,
    /// Upper end; unknown before the first match.
    pub max_inverse_depth: Option<f32>,
    /// Length of its segment in this frame, pixels.
    pub segment_px: f32,
    /// Energy of the second minimum over that of the best.
    pub quality: f32,
    /// What the trace came to.
    pub status: TraceStatus,
}

/// Traces the pixel `(u, v)` of `image` through `frames` and tells its interval after each of them, for
/// a picture of how it narrows; empty where the pixel is too near to the border.
pub fn interval_history<'a>(
    image: &GradientImage,
    (u, v): (u16, u16),
    frames: impl IntoIterator<Item = TraceFrame<'a>>,
    params: &IntervalParams,
) -> Vec<IntervalSample> {
    let Some(mut point) = ImmaturePoint::new(image, u, v) else { return Vec::new() };
    let trace = |frame: TraceFrame<'a>| {
        let status = point.trace(&frame, params);
        IntervalSample {
            min_inverse_depth: point.min_inverse_depth,
            max_inverse_depth: point.max_inverse_depth,
            segment_px: point.last_segment_px,
            quality: point.quality,
            status,
        }
    };
    frames.into_iter().map(trace).collect()
}

#[cfg(test)]
mod tests;
