//! What a frame tells of the depth of the keyframe in force, by the filter that was chosen.

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{ObservationCounts, ObservedPixels, Observer, observe};
use crate::slam::depth::immature::TraceFrame;
use crate::slam::depth::regularisation::regularise;
use crate::slam::frame::FrameView;
use crate::slam::mapper::Mapper;
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
    /// New pixels are brought to maturity by the interval filter and go on in the Gaussian one.
    Both,
}

impl Mapper {
    /// Observes the depth of the keyframe in force in `frame`.
    pub(super) fn observe_frame(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
    ) -> ObservationCounts {
        let Some(keyframe) = self.keyframe() else { return ObservationCounts::default() };
        let keyframe_from_camera = keyframe.world_from_keyframe.locate(&pose.world_from_camera);
        let view = TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse());
        self.frame.fill(frame.pixels);
        let brightness = pose.brightness;
        let pixels = match self.params.depth_filter {
            DepthFilter::Gaussian => ObservedPixels::All,
            DepthFilter::Interval | DepthFilter::Both => ObservedPixels::Known,
        };
        let observer = Observer { image: &self.frame, view, brightness, pixels };
        let traced = TraceFrame { image: &self.frame, view, brightness };
        let matching = self.matching_at(pose);
        let (depth, points) = (&mut self.depth, &mut self.points);
        let (gaussian, interval) = (&self.params.gaussian, &self.params.interval);
        match self.params.depth_filter {
            DepthFilter::Gaussian => observe(depth, &observer, &matching, gaussian),
            DepthFilter::Interval => {
                points.trace(&traced, interval);
                points.write_into(depth, interval)
            }
            DepthFilter::Both => {
                let counts = observe(depth, &observer, &matching, gaussian);
                points.trace(&traced, interval);
                ObservationCounts { created: points.hand_over(depth, interval), ..counts }
            }
        }
    }

    /// Chooses the points that the interval filter traces from the keyframe in force.
    pub(super) fn plant_points(&mut self) {
        match self.params.depth_filter {
            DepthFilter::Gaussian => {}
            DepthFilter::Interval => {
                self.points.restart_with_known(&mut self.depth, &self.params.candidates);
            }
            DepthFilter::Both => self.points.restart_where_empty(&self.depth),
        }
    }

    /// Smooths what was observed; points of the interval filter have no neighbours to agree with.
    pub(super) fn refine(&mut self) {
        if self.params.depth_filter != DepthFilter::Interval {
            regularise(&mut self.depth, &mut self.regularisation, &self.params.regularisation);
        }
        self.unpublished = 0;
    }
}
