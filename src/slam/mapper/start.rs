//! How a map begins: from two frames, from random depth, from a sensor, or from given poses.

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{
    NEW_VALIDITY, ObservationCounts, ObservedPixels, Observer, observe,
};
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::matching::MatchingParams;
use crate::slam::depth::pose_noise::pose_noise_px;
use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::initializer::{StartEvidence, StartMethod, proven_ratio, randomise};
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::mapper::situation::{StartFrame, StartProgress};
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::{PoseEstimate, TrackingState};
use crate::slam::two_frame::evidence::Waiting;
use crate::slam::two_frame::{InitOutcome, InitState};

impl Mapper {
    /// Begins an epoch on this frame: with the sensor's depth, with random depth, or, where the pose is
    /// claimed without a map (it is given, so the baselines will be true), without any. An epoch after
    /// the first begins where the camera was last known to be and in the unit of the last keyframe:
    /// nothing ties it to the one before, and who does not look at the epoch sees the smallest jump.
    pub(super) fn start(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        let is_given = pose.state.is_tracked();
        let from_images = sensor_depth.is_none() && !is_given;
        if from_images && self.params.initializer.method == StartMethod::TwoFrame {
            return self.start_from_two_frames(frame, pose);
        }
        let (origin, unit) = self.origin(pose);
        self.begin_epoch(frame.pixels);
        self.is_unit_open = is_given && sensor_depth.is_none();
        let map_state = match sensor_depth {
            Some(sensor) => {
                take_sensor_depth(&mut self.depth, sensor, 1.0);
                MapState::Established
            }
            None if is_given => MapState::Established,
            None => {
                self.start_at_random(frame);
                MapState::Initializing
            }
        };
        let unit = if from_images { unit } else { 1.0 };
        let scale = unit * self.rescale_to_unit_mean();
        let world_from_camera = if is_given { pose.world_from_camera } else { origin };
        let epoch = self.next_epoch();
        self.add_keyframe(frame, Sim3::new(world_from_camera, scale), map_state, epoch);
        StepOutcome {
            keyframe_created: true,
            keyframe_changed: true,
            graph_changed: true,
            ..Default::default()
        }
    }

    /// How to search in a frame at `pose`: the less is known of the pose, the less is believed of a match.
    pub(super) fn matching_at(&self, pose: &PoseEstimate) -> MatchingParams {
        let matching = &self.params.matching;
        let line_noise_px = match self.map_state() {
            MapState::Initializing => self.params.initializer.line_noise_px,
            _ => matching
                .line_noise_with(pose_noise_px(&self.intrinsics, &pose.alignment_covariance)),
        };
        MatchingParams { line_noise_px, ..matching.clone() }
    }

    /// Gives a keyframe without depth, at given poses, the unit in which the longest search in a frame
    /// at `pose` reaches the nearest depth that is looked for: what the poses are measured in says
    /// nothing about how far away things are.
    pub(super) fn guess_unit(&mut self, pose: &PoseEstimate) {
        /// Share of the longest search that is used, so that rounding does not make it too long.
        const USED_SEARCH: f64 = 0.95;
        if !self.is_unit_open {
            return;
        }
        let focal_px = self.intrinsics.fx.max(self.intrinsics.fy);
        let nearest = f64::from(self.params.gaussian.max_inverse_depth);
        let search_px = USED_SEARCH * f64::from(self.params.matching.max_search_px);
        let Some(keyframe) = self.keyframe_mut().filter(|keyframe| keyframe.points.is_empty())
        else {
            return;
        };
        let placed = &mut keyframe.world_from_keyframe;
        let baseline = (pose.world_from_camera.translation - placed.rigid.translation).norm();
        if baseline > 0.0 {
            let factor = baseline * focal_px * nearest / search_px / placed.scale;
            placed.scale *= factor;
            self.points.rescale(factor as f32);
        }
    }

    /// Once such a keyframe has depth, its mean inverse depth is kept at 1.
    pub(super) fn keep_unit_mean(&mut self) {
        if !self.is_unit_open {
            return;
        }
        let factor = self.rescale_to_unit_mean();
        if let Some(keyframe) = self.keyframe_mut() {
            keyframe.world_from_keyframe.scale *= factor;
        }
    }

    /// Where the next epoch begins and what its unit is in the one before, as far as can be known.
    fn origin(&self, pose: &PoseEstimate) -> (SE3, f64) {
        let trusted = |keyframe: &&Keyframe| keyframe.map_state == MapState::Established;
        match self.map.keyframes.iter().rev().find(trusted) {
            Some(last) => (pose.world_from_camera, last.world_from_keyframe.scale),
            None => (SE3::identity(), 1.0),
        }
    }

    /// The number of the next epoch: one that no epoch had before, here or in a mapper that died.
    pub(super) fn next_epoch(&self) -> u32 {
        let after_last = self.map.keyframes.last().map_or(0, |last| last.epoch.saturating_add(1));
        after_last.max(self.first_free_epoch)
    }

    /// Leaves the keyframe in force, discards a start that was never proven, and begins depth on `pixels`.
    fn begin_epoch(&mut self, pixels: &[u8]) {
        self.leave_keyframe();
        self.map.keyframes.retain(|keyframe| keyframe.map_state != MapState::Initializing);
        self.in_force = None;
        self.contradiction = None;
        self.is_unit_open = false;
        self.recovery.end();
        self.past.clear();
        self.depth.restart(pixels, self.params.min_gradient, self.params.max_candidates);
    }

    /// Forgets what a two-frame start has seen.
    pub(super) fn forget_start(&mut self) {
        self.first_stamp = None;
        self.start_progress = StartProgress::default();
        self.two_frame.begin(&[]);
    }

    /// Judges a start that is not proven yet: proves it, goes on, or begins again.
    pub(super) fn continue_start(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        observations: ObservationCounts,
        sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        let params = &self.params.initializer;
        let evidence = StartEvidence {
            median_parallax_px: self.median_parallax(pose),
            proven_ratio: proven_ratio(&self.depth, params.proven_std_dev_ratio),
            match_ratio: observations.fused as f64 / observations.attempted.max(1) as f64,
        };
        let proven = evidence.proves(params, self.intrinsics.width);
        if !proven && self.frames_on_keyframe > u64::from(params.max_frames) {
            return self.start(frame, pose, sensor_depth);
        }
        if proven && let Some(keyframe) = self.keyframe_mut() {
            keyframe.map_state = MapState::Established;
        }
        self.remember(frame, pose);
        self.publish_depth();
        StepOutcome { keyframe_changed: true, observations, ..Default::default() }
    }

    /// Random depth on this frame.
    fn start_at_random(&mut self, frame: &FrameView<'_>) {
        randomise(&mut self.depth, self.params.initializer.seed ^ frame.sequence);
        self.refine();
    }

    /// Gives the two-frame start another frame. Once it is proven its first frame becomes a keyframe
    /// and this frame the next one, so that the tracker begins where the camera is.
    fn start_from_two_frames(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) -> StepOutcome {
        let is_first = self.two_frame.first_pixels().is_empty();
        let start = self.two_frame.step(frame.pixels);
        self.start_frame = Some(StartFrame::of(&start, is_first, frame.pixels));
        self.start_progress.observe(start.state);
        let stamp = (frame.sequence, frame.capture_nanos);
        let first = *self.first_stamp.get_or_insert(stamp);
        match start.state {
            InitState::Waiting(Waiting::Texture) => self.first_stamp = None,
            InitState::Waiting(_) => {}
            InitState::Failed(_) if self.two_frame.first_pixels().is_empty() => {
                self.first_stamp = None
            }
            InitState::Failed(_) => self.first_stamp = Some(stamp),
            InitState::Proven => {
                self.first_stamp = None;
                return self.begin_proven(frame, first, &start, self.origin(pose));
            }
        }
        StepOutcome::default()
    }

    fn begin_proven(
        &mut self,
        frame: &FrameView<'_>,
        first: (u64, i64),
        start: &InitOutcome,
        (origin, unit): (SE3, f64),
    ) -> StepOutcome {
        let first_pixels = self.two_frame.first_pixels().to_vec();
        self.begin_epoch(&first_pixels);
        let epoch = self.next_epoch();
        self.two_frame.fill(&mut self.depth);
        self.frame.fill(frame.pixels);
        let observer = Observer {
            image: &self.frame,
            view: TwoView::new(&self.intrinsics, &start.first_from_current.inverse()),
            brightness: start.brightness,
            pixels: ObservedPixels::All,
        };
        let observations =
            observe(&mut self.depth, &observer, &self.params.matching, &self.params.gaussian);
        self.refine();
        let scale = self.rescale_to_unit_mean();
        let first_frame = FrameView {
            sequence: first.0,
            capture_nanos: first.1,
            pixels: &first_pixels,
            ..*frame
        };
        let world_from_start = Sim3::new(origin, unit);
        let world_from_first = Sim3::new(origin, unit * scale);
        self.add_keyframe(&first_frame, world_from_first, MapState::Established, epoch);
        let pose = PoseEstimate {
            state: TrackingState::Initializing,
            epoch,
            world_from_camera: world_from_start.place(&start.first_from_current),
            brightness: start.brightness,
            keyframe_id: self.next_keyframe_id - 1,
            ..PoseEstimate::unknown(frame)
        };
        self.change_keyframe(frame, &pose, None);
        StepOutcome {
            keyframe_created: true,
            keyframe_changed: true,
            graph_changed: true,
            observations,
            ..Default::default()
        }
    }

    /// Median image motion that the translation of `pose` causes, pixels.
    fn median_parallax(&self, pose: &PoseEstimate) -> f64 {
        let Some(keyframe) = self.keyframe() else { return 0.0 };
        let relative = keyframe.world_from_keyframe.locate(&pose.world_from_camera).inverse();
        let view = TwoView::new(&self.intrinsics, &relative);
        let mut parallax: Vec<f32> = keyframe
            .points
            .iter()
            .step_by(SAMPLE_STRIDE)
            .filter_map(|p| {
                let line = view.line(f32::from(p.u), f32::from(p.v));
                let (far, at) = (line.project(0.0)?, line.project(p.inverse_depth)?);
                Some((at.u - far.u).hypot(at.v - far.v))
            })
            .collect();
        if parallax.is_empty() {
            return 0.0;
        }
        let middle = parallax.len() / 2;
        f64::from(*parallax.select_nth_unstable_by(middle, f32::total_cmp).1)
    }
}

/// Every so many points are enough for a median or a share.
const SAMPLE_STRIDE: usize = 16;

/// Gives every candidate the depth of a sensor, in units of `scale` metres.
pub(super) fn take_sensor_depth(map: &mut DepthMap, sensor: &Image<f32>, scale: f64) {
    /// Relative standard deviation of a depth camera at room distances.
    const SENSOR_STD_DEV_RATIO: f32 = 0.01;
    if (sensor.width(), sensor.height()) != (map.image.width(), map.image.height()) {
        return;
    }
    let pixels = map.hypotheses.pixels_mut().iter_mut().zip(map.candidates.pixels());
    for ((hypothesis, candidate), &depth) in pixels.zip(sensor.pixels()) {
        if !candidate || !(depth > 0.0) || !depth.is_finite() {
            continue;
        }
        let inverse_depth = scale as f32 / depth;
        *hypothesis = Hypothesis {
            inverse_depth,
            variance: (SENSOR_STD_DEV_RATIO * inverse_depth).powi(2),
            smoothed: inverse_depth,
            validity: NEW_VALIDITY,
            propagated: true,
            failures: 0,
        };
    }
}
