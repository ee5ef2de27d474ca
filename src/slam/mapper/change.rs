//! The step to a new keyframe: carry the depth over, look back for new pixels, rescale, publish.

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{ObservedPixels, Observer, observe};
use crate::slam::depth::map::{KnownColumns, for_each_known};
use crate::slam::depth::propagation::propagate;
use crate::slam::frame::FrameView;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS, MapState};
use crate::slam::mapper::Mapper;
use crate::slam::mapper::consistency::judge_change;
use crate::slam::mapper::memory::BYTES_PER_MEGABYTE;
use crate::slam::mapper::observation::DepthFilter;
use crate::slam::mapper::start::take_sensor_depth;
use crate::slam::pose::{Brightness, PoseEstimate};

impl Mapper {
    /// Makes `frame` the keyframe: carries the depth over, looks back for its new pixels, rescales.
    pub(super) fn change_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) {
        self.is_unit_open = false;
        let Some(before) = self.keyframe() else { return };
        let epoch = before.epoch;
        let world_from_before = before.world_from_keyframe;
        let brightness = pose.brightness;
        let before_from_frame = world_from_before.locate(&pose.world_from_camera);
        if self.unpublished > 0 {
            self.refine();
        }
        self.publish_depth();

        let (min_gradient, max_candidates) = (self.params.min_gradient, self.params.max_candidates);
        self.next_depth.restart(frame.pixels, min_gradient, max_candidates);
        let frame_from_before = before_from_frame.inverse();
        propagate(
            &self.depth,
            &mut self.next_depth,
            &self.intrinsics,
            &frame_from_before,
            brightness,
            &self.params.propagation,
        );
        std::mem::swap(&mut self.depth, &mut self.next_depth);
        self.past.rebase(brightness);
        let mut world_from_keyframe = Sim3::new(pose.world_from_camera, world_from_before.scale);
        // What is asked of new pixels is asked in units of the mean inverse depth.
        let carried = self.rescale_to_unit_mean();
        world_from_keyframe.scale *= carried;
        if let Some(sensor) = sensor_depth {
            take_sensor_depth(&mut self.depth, sensor, world_from_keyframe.scale);
        } else {
            self.seed_from_past(&world_from_keyframe);
        }
        self.refine();
        let factor = self.rescale_to_unit_mean();
        world_from_keyframe.scale *= factor;
        let (before, after) = (self.next_depth.num_hypotheses(), self.depth.num_hypotheses());
        // A first keyframe without depth had nothing to be rescaled by: its mean is not 1.
        let depth_ratio =
            self.next_depth.mean_inverse_depth().map_or(1.0, |mean| mean * carried * factor);
        let contradiction = judge_change(before, after, depth_ratio, &self.params.consistency);
        self.add_keyframe(frame, world_from_keyframe, MapState::Established, epoch);
        if let Some(contradiction) = contradiction {
            self.reject(contradiction);
        }
    }

    /// Gives new pixels of the keyframe their depth from frames before it, shortest baseline first:
    /// each narrows the search of the next.
    fn seed_from_past(&mut self, world_from_keyframe: &Sim3) {
        /// Each frame's baseline is at least this many times the one before.
        const BASELINE_STEP: f64 = 1.7;
        /// Baselines shorter than this share of the mean depth tell nothing.
        const MIN_BASELINE: f64 = 0.01;
        if self.params.depth_filter != DepthFilter::Gaussian {
            return;
        }
        let mut least = MIN_BASELINE;
        let mut used = 0;
        for past in self.past.newest_first() {
            if used >= self.params.num_seed_frames {
                break;
            }
            let keyframe_from_camera = world_from_keyframe.locate(&past.world_from_camera);
            let baseline = keyframe_from_camera.translation.norm();
            if baseline < least {
                continue;
            }
            self.frame.fill(&past.pixels);
            let observer = Observer {
                image: &self.frame,
                view: TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse()),
                brightness: past.brightness,
                pixels: ObservedPixels::New,
            };
            observe(&mut self.depth, &observer, &self.params.matching, &self.params.gaussian);
            least = baseline * BASELINE_STEP;
            used += 1;
        }
    }

    /// Rescales the depth map to mean inverse depth 1; the factor belongs to the keyframe's scale.
    pub(super) fn rescale_to_unit_mean(&mut self) -> f64 {
        let Some(mean) = self.depth.mean_inverse_depth().filter(|m| *m > 0.0) else { return 1.0 };
        let factor = 1.0 / mean;
        self.depth.rescale(factor as f32);
        self.points.rescale(factor as f32);
        factor
    }

    pub(super) fn add_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        world_from_keyframe: Sim3,
        map_state: MapState,
        epoch: u32,
    ) {
        self.map.keyframes.push(Keyframe {
            keyframe_id: self.next_keyframe_id,
            epoch,
            revision: self.revision,
            sequence: frame.sequence,
            capture_nanos: frame.capture_nanos,
            map_state,
            world_from_keyframe,
            intrinsics: self.intrinsics,
            image: frame.pixels.to_vec(),
            points: Vec::new(),
        });
        self.map.forget_depth_beyond(self.params.max_map_megabytes * BYTES_PER_MEGABYTE);
        self.next_keyframe_id += 1;
        self.past.push(frame.pixels, world_from_keyframe.rigid, Brightness::default());
        self.enter_keyframe(self.map.keyframes.len() - 1);
        self.plant_points();
        self.publish_depth();
    }

    /// Writes the depth map into the keyframe in force.
    pub(super) fn publish_depth(&mut self) {
        self.revision += 1;
        let in_force = self.in_force;
        let known = self.depth.num_hypotheses();
        let Some(keyframe) = in_force.and_then(|index| self.map.keyframes.get_mut(index)) else {
            return;
        };
        keyframe.revision = self.revision;
        keyframe.points.clear();
        keyframe.points.reserve_exact(known.min(MAX_KEYFRAME_POINTS));
        let image = &self.depth.image.intensity;
        let mut columns = KnownColumns::default();
        for v in 0..image.height() {
            let (row, intensities) = (self.depth.hypotheses.row(v), image.row(v));
            for_each_known(row, &mut columns, |known| {
                keyframe.points.extend(known.iter().map(|&u| {
                    let (h, intensity) = (&row[usize::from(u)], intensities[usize::from(u)]);
                    let (inverse_depth, variance) = (h.smoothed, h.variance);
                    DepthPoint { u, v: v as u16, inverse_depth, variance, intensity }
                }));
            });
        }
        keyframe.points.retain(|point| point.inverse_depth > 0.0);
        keyframe.points.truncate(MAX_KEYFRAME_POINTS);
    }

    pub(super) fn remember(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) {
        self.past.push(frame.pixels, pose.world_from_camera, pose.brightness);
    }
}
