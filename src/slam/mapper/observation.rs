//! Observes the depth of the active keyframe in a frame, by the chosen filter.

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{ObservationCounts, ObservedPixels, Observer, observe};
use crate::slam::depth::immature::TraceFrame;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::mapper::Mapper;
use crate::slam::mapper::modes::in_unit;
use crate::slam::pose::PoseEstimate;

/// Which filter estimates depth; `docs/depth-filters.md` compares them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthFilter {
    /// Immature points, evenly chosen: an interval each, narrowed by every better match (DSO18 §2.2).
    /// Sparse, and without smoothing.
    Interval,
    /// A mean and a variance at every pixel with gradient, fused and smoothed (SD13 §2.4–2.6).
    #[default]
    Gaussian,
    /// New pixels mature in the interval filter and continue in the Gaussian one.
    Both,
}

/// The only place that distinguishes the filters.
impl DepthFilter {
    /// Which pixels the Gaussian filter observes; `None` where the interval filter runs alone.
    fn observed(self) -> Option<ObservedPixels> {
        match self {
            Self::Gaussian => Some(ObservedPixels::All),
            Self::Both => Some(ObservedPixels::Known),
            Self::Interval => None,
        }
    }

    /// Whether points of the interval filter are traced.
    pub(super) fn has_points(self) -> bool {
        self != Self::Gaussian
    }

    /// Whether depth is smoothed: evenly chosen points have no neighbours to agree with.
    pub(super) fn is_dense(self) -> bool {
        self.observed().is_some()
    }

    /// Whether new pixels are searched in frames before their keyframe: interval points wait for later ones.
    pub(super) fn searches_past(self) -> bool {
        !self.has_points()
    }
}

impl Mapper {
    /// Observes the depth of the active keyframe in `frame`.
    pub(super) fn observe_frame(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
    ) -> ObservationCounts {
        let view = self.view_of(&pose.keyframe_from_camera);
        self.frame.fill(frame.pixels);
        let (image, brightness) = (&self.frame, pose.brightness);
        let matching = self.matching_at(pose);
        let filter = self.params.depth_filter;
        let (depth, points) = (&mut self.depth.active, &mut self.depth.points);
        let mut counts = ObservationCounts::default();
        if let Some(pixels) = filter.observed() {
            let observer = Observer { image, view, brightness, pixels };
            let seen = observe(depth, &observer, &matching, &self.params.gaussian);
            self.line_noise.observe(&seen.innovations, &self.params.line_noise);
            counts = seen.counts;
        }
        self.depth.maturing.trace(&TraceFrame { image, view, brightness }, &self.params.interval);
        if filter.has_points() {
            let interval = &self.params.interval;
            points.trace(&TraceFrame { image, view, brightness }, interval);
            // Alongside the Gaussian filter, mature points are handed over to it.
            counts = match filter.is_dense() {
                true => ObservationCounts { created: points.hand_over(depth, interval), ..counts },
                false => points.write_into(depth, interval),
            };
        }
        counts
    }

    /// The view of a frame from the active keyframe, in the unit of its depth buffer.
    pub(super) fn view_of(&self, keyframe_from_camera: &SE3) -> TwoView {
        TwoView::new(&self.intrinsics, &in_unit(keyframe_from_camera, self.depth.unit))
    }
}
