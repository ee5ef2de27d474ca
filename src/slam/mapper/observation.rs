//! What a frame tells of the depth of the active keyframe, by the filter that was chosen.

use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{ObservationCounts, ObservedPixels, Observer, observe};
use crate::slam::depth::immature::TraceFrame;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
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
    /// Observes the depth of the active keyframe in `frame`.
    pub(super) fn observe_frame(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
    ) -> ObservationCounts {
        let view = self.view_of(&pose.keyframe_from_camera);
        self.frame.fill(frame.pixels);
        let brightness = pose.brightness;
        let pixels = match self.params.depth_filter {
            DepthFilter::Gaussian => ObservedPixels::All,
            DepthFilter::Interval | DepthFilter::Both => ObservedPixels::Known,
        };
        let observer = Observer { image: &self.frame, view, brightness, pixels };
        let traced = TraceFrame { image: &self.frame, view, brightness };
        let matching = self.matching_at(pose);
        let (depth, points) = (&mut self.depth.active, &mut self.depth.points);
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

    /// The view of a frame from the active keyframe, in the unit of its depth buffer.
    pub(super) fn view_of(&self, keyframe_from_camera: &SE3) -> TwoView {
        let mut frame_from_keyframe = keyframe_from_camera.inverse();
        frame_from_keyframe.translation /= self.depth.unit;
        TwoView::new(&self.intrinsics, &frame_from_keyframe)
    }
}
