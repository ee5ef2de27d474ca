//! The interval filter: immature points chosen evenly over a frame and traced through subsequent frames until their
//! depth is certain (Engel, Koltun, Cremers 2018 §2.2).

use rayon::prelude::*;

use crate::slam::depth::candidate::{Candidate, CandidateParams, CandidateSelector};
use crate::slam::depth::gaussian::{MAX_VALIDITY, NEW_VALIDITY, ObservationCounts};
use crate::slam::depth::gradient_image::GradientImage;
use crate::slam::depth::immature::{
    HALF_INTERVAL_SIGMAS, ImmaturePoint, IntervalParams, TraceCounts, TraceFrame, TraceStatus,
};
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::trace_kernel::Tracing;
use crate::slam::kernel::Kernel;

/// A depth that has become certain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatureDepth {
    /// Column of the pixel.
    pub u: u16,
    /// Row of the pixel.
    pub v: u16,
    /// Centre of the interval, 1/keyframe units.
    pub inverse_depth: f32,
    /// Variance equivalent to the interval.
    pub variance: f32,
}

impl MatureDepth {
    /// The depth given by the interval of `point`; `None` before its first match.
    fn of(point: &ImmaturePoint) -> Option<Self> {
        let (inverse_depth, std_dev) = (point.inverse_depth()?, point.std_dev()?);
        Some(Self { u: point.u, v: point.v, inverse_depth, variance: std_dev * std_dev })
    }

    fn hypothesis(&self, validity: u8) -> Hypothesis {
        Hypothesis {
            inverse_depth: self.inverse_depth,
            variance: self.variance,
            independent: self.variance,
            smoothed: self.inverse_depth,
            validity,
            propagated: false,
            failures: 0,
        }
    }
}

/// The immature points of one keyframe.
#[derive(Debug, Default)]
pub struct IntervalFilter {
    points: Vec<ImmaturePoint>,
    selector: CandidateSelector,
    candidates: Vec<Candidate>,
    /// Indices of the chosen pixels, ascending.
    chosen: Vec<usize>,
}

impl IntervalFilter {
    /// Restarts on a new image: evenly chosen points, all depths possible.
    pub fn restart(&mut self, image: &GradientImage, params: &CandidateParams) {
        self.selector.choose(image, params, &mut self.candidates);
        self.points.clear();
        let points = self.candidates.iter().filter_map(|c| ImmaturePoint::new(image, c.u, c.v));
        self.points.extend(points);
    }

    /// Removes all points.
    pub fn clear(&mut self) {
        self.points.clear();
    }

    /// Restarts at every pixel of `map` that may carry depth but has none.
    pub fn restart_where_empty(&mut self, map: &DepthMap) {
        let width = map.image.width();
        self.points.clear();
        let pixels = map.candidates.pixels().iter().zip(map.hypotheses.pixels()).enumerate();
        let empty = pixels.filter(|(_, (candidate, h))| **candidate && !h.is_some());
        self.points.extend(empty.filter_map(|(i, _)| {
            ImmaturePoint::new(&map.image, (i % width) as u16, (i / width) as u16)
        }));
    }

    /// Restarts with the hypotheses of `map` and, between them, evenly chosen points of unknown depth. If a start or a
    /// sensor gave depth to every pixel, only the chosen ones keep it.
    pub fn restart_from_map(&mut self, map: &mut DepthMap, params: &CandidateParams) {
        /// More hypotheses than this multiple of the wanted number mean a map with depth at every pixel.
        const MAX_HYPOTHESES_PER_WANTED: usize = 3;
        self.selector.choose(&map.image, params, &mut self.candidates);
        if map.num_hypotheses() > MAX_HYPOTHESES_PER_WANTED * params.wanted {
            self.chosen.clear();
            self.chosen.extend(self.candidates.iter().map(|c| map.index(c.u, c.v)));
            self.chosen.sort_unstable();
            for (i, hypothesis) in map.hypotheses.pixels_mut().iter_mut().enumerate() {
                if self.chosen.binary_search(&i).is_err() {
                    *hypothesis = Hypothesis::NONE;
                }
            }
        }
        let width = map.image.width();
        self.points.clear();
        let hypotheses = map.hypotheses.pixels().iter().enumerate();
        self.points.extend(hypotheses.filter(|(_, h)| h.is_some()).filter_map(|(i, h)| {
            let half = HALF_INTERVAL_SIGMAS * h.variance.sqrt();
            let point = ImmaturePoint::new(&map.image, (i % width) as u16, (i / width) as u16)?;
            Some(point.with_interval(h.smoothed - half, h.smoothed + half))
        }));
        let unknown = self.candidates.iter().filter(|c| !is_near_known(map, c));
        self.points.extend(unknown.filter_map(|c| ImmaturePoint::new(&map.image, c.u, c.v)));
    }

    /// Traces every point in a frame. Points are independent: the result does not depend on the number of threads.
    pub fn trace(&mut self, frame: &TraceFrame<'_>, params: &IntervalParams) -> TraceCounts {
        /// Points that a thread takes at once: some tens of microseconds.
        const CHUNK: usize = 128;
        let kernel = Kernel::fastest();
        self.points
            .par_chunks_mut(CHUNK)
            .map(|points| kernel.run(Tracing { points, frame, params }))
            .reduce(TraceCounts::default, TraceCounts::plus)
    }

    /// Gives the pixels of mature points their first hypothesis in `map` and ends these points: from then on the map's
    /// own filter continues. Returns the number of new hypotheses.
    pub fn hand_over(&mut self, map: &mut DepthMap, params: &IntervalParams) -> usize {
        let mut created = 0;
        for point in self.points.iter_mut().filter(|p| !p.is_ended() && p.is_mature(params)) {
            let Some(mature) = MatureDepth::of(point) else { continue };
            let index = map.index(point.u, point.v);
            let hypothesis = &mut map.hypotheses.pixels_mut()[index];
            if !hypothesis.is_some() {
                *hypothesis = mature.hypothesis(NEW_VALIDITY);
                created += 1;
            }
            point.end();
        }
        created
    }

    /// Writes the depth of mature points into `map` after a trace and removes that of points without a match; returns
    /// the counts.
    pub fn write_into(&self, map: &mut DepthMap, params: &IntervalParams) -> ObservationCounts {
        let mut counts = ObservationCounts::default();
        for point in &self.points {
            let index = map.index(point.u, point.v);
            let hypothesis = &mut map.hypotheses.pixels_mut()[index];
            let was_known = hypothesis.is_some();
            match point.status {
                TraceStatus::Outlier if point.is_ended() && was_known => {
                    counts.attempted += 1;
                    counts.failed += 1;
                    hypothesis.reject();
                }
                TraceStatus::Good if point.is_mature(params) => {
                    let Some(mature) = MatureDepth::of(point) else { continue };
                    if !was_known {
                        counts.created += 1;
                        *hypothesis = mature.hypothesis(NEW_VALIDITY);
                        continue;
                    }
                    let confirmed = hypothesis.validity.saturating_add(1).min(MAX_VALIDITY);
                    *hypothesis = mature.hypothesis(confirmed);
                    counts.attempted += 1;
                    counts.fused += 1;
                }
                _ => {}
            }
        }
        counts
    }

    /// All points, in the order in which they were chosen.
    pub fn points(&self) -> &[ImmaturePoint] {
        &self.points
    }

    /// The certain depths, in the order of the points.
    pub fn mature(&self, params: &IntervalParams) -> impl Iterator<Item = MatureDepth> {
        self.points.iter().filter(|p| p.is_mature(params)).filter_map(MatureDepth::of)
    }

    /// Multiplies every interval by `factor`.
    pub fn rescale(&mut self, factor: f32) {
        self.rescale_by(|_, _| factor);
    }

    /// Multiplies the interval of each pixel `(u, v)` by its own factor.
    pub fn rescale_by(&mut self, factor_at: impl Fn(usize, usize) -> f32) {
        let factor = |p: &ImmaturePoint| factor_at(usize::from(p.u), usize::from(p.v));
        self.points.iter_mut().for_each(|p| p.rescale(factor(p)));
    }
}

/// Whether `map` has a hypothesis within the pattern's reach of the candidate.
fn is_near_known(map: &DepthMap, candidate: &Candidate) -> bool {
    const REACH_PX: usize = 2;
    let (u, v) = (usize::from(candidate.u), usize::from(candidate.v));
    (v - REACH_PX..=v + REACH_PX)
        .any(|y| map.hypotheses.row(y)[u - REACH_PX..=u + REACH_PX].iter().any(Hypothesis::is_some))
}

/// Traces the pixel `(u, v)` of `image` through `frames`: the point after each of them, to plot how its interval
/// narrows. Empty if the pixel is too close to the border.
pub fn interval_history<'a>(
    image: &GradientImage,
    (u, v): (u16, u16),
    frames: impl IntoIterator<Item = TraceFrame<'a>>,
    params: &IntervalParams,
) -> Vec<ImmaturePoint> {
    let Some(mut point) = ImmaturePoint::new(image, u, v) else { return Vec::new() };
    let trace = |frame: TraceFrame<'a>| {
        point.trace(&frame, params);
        point.clone()
    };
    frames.into_iter().map(trace).collect()
}

#[cfg(test)]
mod tests;
