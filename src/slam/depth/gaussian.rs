//! The semi-dense Gaussian filter: every pixel with gradient keeps an inverse depth and a variance, narrowed by each
//! observation (Engel, Sturm, Cremers 2013 §2.4).

use rayon::prelude::*;

use crate::slam::depth::epipolar::{EpipolarLine, Projection, TwoView};
use crate::slam::depth::expected_gain::{LANES, PixelLanes, worth_observing};
use crate::slam::depth::gain::{Gain, Uncertainty};
use crate::slam::depth::gradient_image::{BORDER_PX, GradientImage};
use crate::slam::depth::hypotheses::{ChangedColumns, ListedRow};
use crate::slam::depth::line_noise::Innovations;
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::matching::{
    Conditioning, Match, MatchingParams, Miss, Patch, SearchRange, condition, is_inside, search,
};
use crate::slam::image::buffer::Image;
use crate::slam::image::quads::QuadImage;
use crate::slam::image::quads_kernel::Sampled;
use crate::slam::kernel::{Body, Instructions, Kernel};
use crate::slam::pose::Brightness;

mod params;

pub use params::GaussianParams;

/// Validity of a new hypothesis: this many failures in a row drop it.
pub const NEW_VALIDITY: u8 = 4;
/// Upper bound of the validity: a long-proven hypothesis survives a short occlusion.
pub const MAX_VALIDITY: u8 = 20;

/// The effect of one frame on the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ObservationCounts {
    /// Searches for pixels that had a hypothesis.
    pub attempted: usize,
    /// Those that were fused.
    pub fused: usize,
    /// Those that contradicted or had no match.
    pub failed: usize,
    /// New hypotheses.
    pub created: usize,
    /// Searches for an even sample of the hypotheses that the frame cannot improve, to check whether they still hold:
    /// those that it can improve are often those that failed before.
    pub probed: usize,
    /// Probes that contradicted or had no match.
    pub refuted: usize,
}

/// The effect of one frame on the map, and how well it fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Observation {
    /// Numbers of pixels.
    pub counts: ObservationCounts,
    /// Distances of matches from the positions predicted by known depth.
    pub innovations: Innovations,
}

impl Observation {
    /// The sum over two parts of the map.
    pub fn plus(self, other: Self) -> Self {
        Self {
            counts: self.counts.plus(other.counts),
            innovations: self.innovations.plus(other.innovations),
        }
    }
}

impl ObservationCounts {
    /// The sum of the counts of two parts of the map.
    pub fn plus(self, other: Self) -> Self {
        Self {
            attempted: self.attempted + other.attempted,
            fused: self.fused + other.fused,
            failed: self.failed + other.failed,
            created: self.created + other.created,
            probed: self.probed + other.probed,
            refuted: self.refuted + other.refuted,
        }
    }
}

/// A frame that observes the map.
#[derive(Debug, Clone, Copy)]
pub struct Observer<'a> {
    /// Its brightness, level 0.
    pub image: &'a QuadImage,
    /// Its geometry relative to the keyframe.
    pub view: TwoView,
    /// Its brightness relative to the keyframe.
    pub brightness: Brightness,
    /// The pixels to observe.
    pub pixels: ObservedPixels,
}

/// The pixels of a map that are observed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObservedPixels {
    /// Hypotheses, and pixels that may get one.
    All,
    /// Without the hypotheses that already contain the frame's information: those propagated from the previous
    /// keyframe, if the frame predates this keyframe, and the points of a start in the frame that verified it.
    New,
    /// Hypotheses alone: new ones come from elsewhere.
    Known,
}

/// Observes every pixel of `map` in a frame. Rows are independent: the result does not depend on the number of threads.
pub fn observe(
    map: &mut DepthMap,
    observer: &Observer<'_>,
    matching: &MatchingParams,
    params: &GaussianParams,
) -> Observation {
    let [known, unknown] = map.hypotheses.count_known_and_unknown(&map.candidates);
    let is_short_of_depth = unknown > MAX_UNKNOWN_PER_KNOWN * known;
    let pixel = PixelObserver {
        max_new_search_px: match is_short_of_depth {
            true => matching.max_search_px.max(params.max_first_search_px),
            false => matching.max_search_px,
        },
        is_short_of_depth,
        image: &map.image,
        candidates: &map.candidates,
        structure: &map.structure,
        observer,
        gain: observer.brightness.a.exp() as f32,
        offset: observer.brightness.b as f32,
        matching,
        params,
    };
    let kernel = Kernel::fastest();
    map.hypotheses
        .observed_rows()
        .enumerate()
        .map(|(v, row)| kernel.run(ObservedRow { pixel: &pixel, row, v }))
        .reduce(Observation::default, Observation::plus)
}

/// A keyframe with more candidates without depth than this per candidate with depth is short of depth.
const MAX_UNKNOWN_PER_KNOWN: usize = 2;

/// One in this many pixels is probed, on behalf of the others.
pub const PROBE_STEP: usize = 32;
/// Columns by which the probed pixels shift from one row to the next, so that no column contains all of them.
const PROBE_ROW_SHIFT: usize = 11;

/// Everything that the observation of a pixel needs.
struct PixelObserver<'a> {
    image: &'a GradientImage,
    candidates: &'a Image<bool>,
    structure: &'a Image<[f32; 3]>,
    observer: &'a Observer<'a>,
    gain: f32,
    offset: f32,
    matching: &'a MatchingParams,
    params: &'a GaussianParams,
    /// Longest segment that is searched for a new pixel.
    max_new_search_px: f32,
    /// Whether the far part of longer ones is searched.
    is_short_of_depth: bool,
}

/// A row of the map whose pixels are observed.
struct ObservedRow<'a> {
    pixel: &'a PixelObserver<'a>,
    row: ListedRow<'a>,
    v: usize,
}

impl Body for ObservedRow<'_> {
    type Output = Observation;

    #[inline(always)]
    fn run<I: Instructions>(self, instructions: I) -> Observation {
        self.pixel.observe_row(instructions, self.row, self.v)
    }
}

impl PixelObserver<'_> {
    /// Observes the pixels of row `v`.
    #[inline(always)]
    fn observe_row<S: Instructions>(
        &self,
        sampler: S,
        row: ListedRow<'_>,
        v: usize,
    ) -> Observation {
        let mut seen = Observation::default();
        let ListedRow { hypotheses: row, mut lists } = row;
        let candidates = self.candidates.row(v);
        lists.fill(row, candidates);
        if !(BORDER_PX..self.image.height() - BORDER_PX).contains(&v) {
            return seen;
        }
        let mut changed = ChangedColumns::none();
        let skips_propagated = self.observer.pixels == ObservedPixels::New;
        for columns in self.inside(lists.known()).chunks(LANES) {
            self.update_promising(sampler, row, columns, v, skips_propagated, &mut seen);
            let gone = columns.iter().filter(|&&u| !row[usize::from(u)].is_some());
            gone.for_each(|&u| changed.push(u));
        }
        if self.observer.pixels != ObservedPixels::Known {
            for &column in self.inside(lists.unknown()) {
                let u = usize::from(column);
                self.create(sampler, &mut row[u], u, v, &mut seen.counts);
                if row[u].is_some() {
                    changed.push(column);
                }
            }
        }
        lists.update_lists(&changed, row, candidates);
        seen
    }

    /// Those of the ascending columns that are far enough from the border.
    fn inside<'a>(&self, columns: &'a [u16]) -> &'a [u16] {
        let end = self.image.width() - BORDER_PX;
        let before = |bound: usize| columns.partition_point(|&u| usize::from(u) < bound);
        &columns[before(BORDER_PX)..before(end)]
    }

    /// Updates those of the `columns` of row `v`, at most [`LANES`], whose match promises to be informative.
    #[inline(always)]
    fn update_promising<S: Instructions>(
        &self,
        sampler: S,
        row: &mut [Hypothesis],
        columns: &[u16],
        v: usize,
        skips_propagated: bool,
        seen: &mut Observation,
    ) {
        let mut pixels = PixelLanes::default();
        for (k, u) in columns.iter().map(|&u| usize::from(u)).enumerate() {
            let hypothesis = &row[u];
            pixels.u[k] = u as f32;
            pixels.inverse_depth[k] = hypothesis.smoothed;
            pixels.variance[k] = hypothesis.variance;
            pixels.independent[k] = hypothesis.independent;
            let structure = &self.structure.row(v)[u];
            for (plane, &sum) in pixels.structure.iter_mut().zip(structure) {
                plane[k] = sum;
            }
        }
        let Observer { image: frame, view, .. } = self.observer;
        let size = (frame.width(), frame.height());
        let enough = self.params.max_variance_ratio;
        let worth_observing =
            worth_observing(&pixels, v as f32, view, size, self.gain, enough, self.matching);
        for (&u, &worth_observing) in columns.iter().zip(&worth_observing) {
            let u = usize::from(u);
            if skips_propagated && row[u].propagated {
                continue;
            }
            if worth_observing {
                self.update(sampler, &mut row[u], u, v, seen);
            } else if (u + PROBE_ROW_SHIFT * v).is_multiple_of(PROBE_STEP) {
                self.probe(sampler, &row[u], u, v, &mut seen.counts);
            }
        }
    }

    /// The epipolar line of a pixel, its projection at this inverse depth, and how precisely a match could be located
    /// there; `None` if the frame does not see it or carries no information about it.
    #[inline(always)]
    fn conditioned(
        &self,
        inverse_depth: f32,
        u: usize,
        v: usize,
    ) -> Option<(EpipolarLine, Projection, Conditioning)> {
        let Observer { image: frame, view, .. } = self.observer;
        let line = view.line(u as f32, v as f32);
        let at = line
            .project(inverse_depth)
            .filter(|p| is_inside(frame.width(), frame.height(), p.u, p.v))?;
        let structure = &self.structure.row(v)[u];
        let conditioning = condition(view, &line, &at, structure, self.gain, self.matching)?;
        Some((line, at, conditioning))
    }

    /// Observes a pixel that has a hypothesis.
    #[inline(always)]
    fn update<S: Instructions>(
        &self,
        sampler: S,
        hypothesis: &mut Hypothesis,
        u: usize,
        v: usize,
        seen: &mut Observation,
    ) {
        let Observation { counts, innovations } = seen;
        let centre = hypothesis.smoothed;
        let Some((line, _, conditioning)) = self.conditioned(centre, u, v) else { return };
        let left = Gain::of(hypothesis.uncertainty(), conditioning.predicted_uncertainty()).left;
        if left.variance > self.params.max_variance_ratio * hypothesis.variance {
            return;
        }
        // At most the longest search: half its length to either side.
        let longest = 0.45 * self.matching.max_search_px * conditioning.inverse_depth_per_px;
        let reach = (self.params.search_sigmas * hypothesis.variance.sqrt()).min(longest);
        let (Some(from), Some(to)) =
            (line.project((centre - reach).max(0.0)), line.project(centre + reach))
        else {
            return;
        };
        let patch = Patch::new(self.image, u, v, self.gain, self.offset);
        let frame = Sampled { image: self.observer.image, sampler };
        let range = SearchRange { from, to, max_px: self.matching.max_search_px };
        match search(frame, &line, &patch, &conditioning, &range, self.matching) {
            Ok(found) => {
                counts.attempted += 1;
                let innovation = found.inverse_depth - hypothesis.inverse_depth;
                innovations.add(
                    innovation / conditioning.inverse_depth_per_px,
                    conditioning.match_std_dev_px(),
                );
                if self.fuse(hypothesis, &found) {
                    counts.fused += 1;
                } else {
                    counts.failed += 1;
                }
            }
            Err(Miss::Mismatch) => {
                counts.attempted += 1;
                counts.failed += 1;
                hypothesis.validity = hypothesis.validity.saturating_sub(1);
                if hypothesis.validity == 0 {
                    hypothesis.reject();
                }
            }
            Err(Miss::Ambiguous | Miss::OutOfView | Miss::TooLong) => {}
        }
    }

    /// Checks a hypothesis against the frame without changing it.
    #[inline(always)]
    fn probe<S: Instructions>(
        &self,
        sampler: S,
        hypothesis: &Hypothesis,
        u: usize,
        v: usize,
        counts: &mut ObservationCounts,
    ) {
        let Some((line, at, conditioning)) = self.conditioned(hypothesis.smoothed, u, v) else {
            return;
        };
        let patch = Patch::new(self.image, u, v, self.gain, self.offset);
        let frame = Sampled { image: self.observer.image, sampler };
        let range = SearchRange { from: at, to: at, max_px: self.matching.max_search_px };
        let found = search(frame, &line, &patch, &conditioning, &range, self.matching);
        match found {
            Ok(found) => {
                counts.probed += 1;
                let difference = found.inverse_depth - hypothesis.inverse_depth;
                let joint = hypothesis.variance + found.uncertainty.variance;
                let gate = self.params.gate_sigmas;
                counts.refuted += usize::from(difference * difference > gate * gate * joint);
            }
            Err(Miss::Mismatch) => {
                counts.probed += 1;
                counts.refuted += 1;
            }
            Err(Miss::Ambiguous | Miss::OutOfView | Miss::TooLong) => {}
        }
    }

    /// Fuses an observation into a hypothesis; returns false if it contradicts.
    fn fuse(&self, hypothesis: &mut Hypothesis, found: &Match) -> bool {
        let inflation = self.params.process_inflation;
        let (prior, independent) =
            (hypothesis.variance * inflation, hypothesis.independent * inflation);
        let difference = found.inverse_depth - hypothesis.inverse_depth;
        let gate = self.params.gate_sigmas;
        if difference * difference > gate * gate * (prior + found.uncertainty.variance) {
            hypothesis.variance = prior * self.params.contradiction_inflation;
            hypothesis.independent = independent * self.params.contradiction_inflation;
            hypothesis.validity = hypothesis.validity.saturating_sub(1);
            let too_uncertain = hypothesis.variance > self.params.max_std_dev.powi(2);
            if hypothesis.validity == 0 || too_uncertain {
                hypothesis.reject();
            }
            return false;
        }
        let known = Uncertainty { variance: prior, independent };
        let Gain { weight, left } = Gain::of(known, found.uncertainty);
        hypothesis.inverse_depth += weight * difference;
        hypothesis.smoothed += weight * (found.inverse_depth - hypothesis.smoothed);
        (hypothesis.variance, hypothesis.independent) = (left.variance, left.independent);
        hypothesis.validity = (hypothesis.validity + 1).min(MAX_VALIDITY);
        if !(hypothesis.inverse_depth > 0.0 && hypothesis.smoothed > 0.0) {
            hypothesis.reject();
            return false;
        }
        true
    }

    /// The part of a new pixel's line that is searched: from infinity to the nearest depth considered, or, in a
    /// keyframe short of depth, as far as a search reaches. `None` if it is too short or too long.
    #[inline(always)]
    fn new_range(&self, line: &EpipolarLine) -> Option<SearchRange> {
        /// Share of the longest search that a truncated segment uses, so that rounding does not make it too long.
        const SEARCHED: f32 = 0.99;
        let (from, to) = (line.project(0.0)?, line.project(self.params.max_inverse_depth)?);
        let (du, dv) = (to.u - from.u, to.v - from.v);
        let length = (du * du + dv * dv).sqrt();
        let max_px = self.max_new_search_px;
        if !(length >= self.params.min_new_segment_px) {
            return None;
        }
        if length <= max_px {
            return Some(SearchRange { from, to, max_px });
        }
        if !self.is_short_of_depth {
            return None;
        }
        let share = SEARCHED * max_px / length;
        let end = line.inverse_depth_at(from.u + share * du, from.v + share * dv)?;
        Some(SearchRange { from, to: line.project(end)?, max_px })
    }

    /// Tries to give a pixel its first hypothesis, searching all depths.
    #[inline(always)]
    fn create<S: Instructions>(
        &self,
        sampler: S,
        hypothesis: &mut Hypothesis,
        u: usize,
        v: usize,
        counts: &mut ObservationCounts,
    ) {
        /// Failures after which a pixel is ignored on this keyframe.
        const MAX_FAILURES: u8 = 6;
        if hypothesis.failures >= MAX_FAILURES {
            return;
        }
        let Observer { image: frame, view, .. } = self.observer;
        let line = view.line(u as f32, v as f32);
        let (Some(range), Some(at)) = (self.new_range(&line), line.project(1.0)) else { return };
        if !is_inside(frame.width(), frame.height(), at.u, at.v) {
            return;
        }
        let structure = &self.structure.row(v)[u];
        let conditioning = condition(view, &line, &at, structure, self.gain, self.matching);
        let Some(conditioning) = conditioning else { return };
        let patch = Patch::new(self.image, u, v, self.gain, self.offset);
        let frame = Sampled { image: frame, sampler };
        match search(frame, &line, &patch, &conditioning, &range, self.matching) {
            Ok(found)
                if found.inverse_depth > 0.0
                    && found.uncertainty.variance < self.params.max_std_dev.powi(2) =>
            {
                counts.created += 1;
                *hypothesis = Hypothesis {
                    inverse_depth: found.inverse_depth,
                    variance: found.uncertainty.variance,
                    independent: found.uncertainty.independent,
                    smoothed: found.inverse_depth,
                    validity: NEW_VALIDITY,
                    propagated: false,
                    failures: hypothesis.failures,
                };
            }
            Ok(_) | Err(Miss::OutOfView | Miss::TooLong) => {}
            Err(Miss::Mismatch | Miss::Ambiguous) => {
                hypothesis.failures = hypothesis.failures.saturating_add(1);
            }
        }
    }
}

#[cfg(test)]
mod tests;
