//! The depth of the active keyframe while it is estimated, and the buffers for the next.

use crate::slam::depth::interval::IntervalFilter;
use crate::slam::depth::map::DepthMap;
use crate::slam::depth::propagation::{PropagationParams, propagate};
use crate::slam::depth::regularisation::{RegularisationScratch, regularise};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS};
use crate::slam::map::LogPlane;
use crate::slam::mapper::MapperParams;
use crate::slam::mapper::maturing::Maturing;
use crate::slam::pose::Brightness;

/// Owns the buffers that the depth filters work on.
#[derive(Debug)]
pub(super) struct DepthBuffers {
    /// The depth map of the active keyframe.
    pub(super) active: DepthMap,
    /// Buffer for the next one, without `structure`; after a change, the depth map of the previous keyframe.
    pub(super) spare: DepthMap,
    /// The immature points of the active keyframe.
    pub(super) points: IntervalFilter,
    /// Points to be estimated jointly; empty unless the interval filter provides them.
    pub(super) maturing: Maturing,
    regularisation: RegularisationScratch,
    /// Unit of `active`, in the keyframe's unit: 1 except where poses are given, which fixes the keyframe's unit before
    /// any depth is known.
    pub(super) unit: f64,
    /// Whether that unit is still to be determined.
    pub(super) is_unit_open: bool,
    /// Hypotheses changed since the depth was smoothed and published.
    pub(super) unpublished: usize,
}

impl DepthBuffers {
    /// Creates empty buffers for images of this size.
    pub(super) fn with_size(width: usize, height: usize) -> Self {
        let active = DepthMap::with_size(width, height);
        let mut spare = active.clone();
        spare.structure = Image::filled(0, 0, [0.0; 3]);
        Self {
            active,
            spare,
            points: IntervalFilter::default(),
            maturing: Maturing::default(),
            regularisation: RegularisationScratch::with_size(width, height),
            unit: 1.0,
            is_unit_open: false,
            unpublished: 0,
        }
    }

    /// Restarts the active depth on `pixels`, in the keyframe's unit.
    pub(super) fn restart(&mut self, pixels: &[u8], params: &MapperParams) {
        self.active.restart(pixels, params.min_gradient, params.max_candidates);
        self.maturing.clear();
        (self.unit, self.is_unit_open) = (1.0, false);
    }

    /// Swaps the active and the spare depth. `structure` and the lists' memory stay with the active one; `structure`
    /// still belongs to the image before, as the active depth is restarted before it is observed, or swapped back.
    pub(super) fn swap(&mut self) {
        std::mem::swap(&mut self.active, &mut self.spare);
        std::mem::swap(&mut self.active.structure, &mut self.spare.structure);
        self.active.hypotheses.take_lists(&mut self.spare.hypotheses);
    }

    /// Propagates the spare depth to the active one, whose frame is at `frame_from_spare`, in the unit of the spare
    /// depth, and has this brightness relative to the spare one's image.
    pub(super) fn propagate_spare(
        &mut self,
        frame_from_spare: &SE3,
        brightness: Brightness,
        intrinsics: &Intrinsics,
        params: &PropagationParams,
    ) {
        let (spare, active) = (&self.spare, &mut self.active);
        propagate(spare, active, intrinsics, frame_from_spare, brightness, params);
    }

    /// Chooses the points that the interval filter traces.
    pub(super) fn choose_traced_points(&mut self, params: &MapperParams) {
        if params.window.traces_candidates() {
            self.maturing.restart(&self.active.image, &params.candidates);
        }
        let filter = params.depth_filter;
        match filter.has_points() {
            true if filter.is_dense() => self.points.restart_where_empty(&self.active),
            true => self.points.restart_from_map(&mut self.active, &params.candidates),
            false => {}
        }
    }

    /// Regularises the observed depth where the filter is dense.
    pub(super) fn refine(&mut self, params: &MapperParams) {
        if params.depth_filter.is_dense() {
            regularise(&mut self.active, &mut self.regularisation, &params.regularisation);
        }
        self.unpublished = 0;
    }

    /// Rescales to mean inverse depth 1 and returns the factor by which the unit of the depth has grown.
    pub(super) fn normalise(&mut self) -> f64 {
        let Some(mean) = self.active.mean_inverse_depth().filter(|m| *m > 0.0) else { return 1.0 };
        let factor = 1.0 / mean;
        self.rescale(factor as f32);
        factor
    }

    /// Keeps the mean inverse depth at 1 while the unit is open; the keyframe's unit does not change.
    pub(super) fn keep_unit_mean(&mut self) {
        if self.is_unit_open {
            self.unit *= self.normalise();
        }
    }

    /// Multiplies the unit of all depth by `factor`.
    pub(super) fn scale_unit(&mut self, factor: f64) {
        self.unit *= factor;
        self.rescale(factor as f32);
    }

    fn rescale(&mut self, factor: f32) {
        self.active.rescale(factor);
        self.points.rescale(factor);
        self.maturing.rescale(factor);
    }

    /// Scales the active depth by a plane on its logarithm.
    pub(super) fn correct(&mut self, plane: &LogPlane, intrinsics: &Intrinsics) {
        if !plane.is_identity() {
            let factor_at = |u, v| plane.factor(intrinsics, u as f64, v as f64) as f32;
            self.active.rescale_by(factor_at);
            self.points.rescale_by(factor_at);
            self.maturing.rescale_by(factor_at);
        }
    }

    /// Keeps the mature points among those to be estimated jointly when the keyframe is left.
    pub(super) fn keep_mature_points(&mut self, keyframe_id: u64, params: &MapperParams) {
        self.maturing.keep_points(keyframe_id, &self.active.image, self.unit, &params.interval);
    }
}

/// Writes the hypotheses of `depth` into the keyframe as its points; `unit` is the unit of `depth` in the keyframe's.
pub(super) fn write_depth(depth: &DepthMap, unit: f64, keyframe: &mut Keyframe) {
    keyframe.points.clear();
    keyframe.points.reserve_exact(depth.num_hypotheses().min(MAX_KEYFRAME_POINTS));
    let image = &depth.image.intensity;
    let inverse_unit = (1.0 / unit) as f32;
    let mut memory = Vec::new();
    for v in 0..image.height() {
        let (row, intensities) = (depth.hypotheses.row(v), image.row(v));
        let known = depth.hypotheses.known_columns(v, &mut memory);
        keyframe.points.extend(known.iter().map(|&u| {
            let (h, intensity) = (&row[usize::from(u)], f32::from(intensities[usize::from(u)]));
            let inverse_depth = h.smoothed * inverse_unit;
            let variance = h.variance * (inverse_unit * inverse_unit);
            DepthPoint { u, v: v as u16, inverse_depth, variance, intensity }
        }));
    }
    keyframe.points.retain(|point| point.inverse_depth > 0.0);
    keyframe.points.truncate(MAX_KEYFRAME_POINTS);
}
