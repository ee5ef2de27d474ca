//! The recipe of a map step: observe depth, regularise, choose keyframes, propagate.

use std::collections::VecDeque;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::slam::depth::epipolar::TwoView;
use crate::slam::depth::gaussian::{
    GaussianParams, NEW_VALIDITY, ObservationCounts, Observer, observe,
};
use crate::slam::depth::map::{DepthMap, Hypothesis};
use crate::slam::depth::matching::MatchingParams;
use crate::slam::depth::propagation::{PropagationParams, propagate};
use crate::slam::depth::regularisation::{RegularisationParams, regularise};
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::initializer::{InitializerParams, StartEvidence, proven_ratio, randomise};
use crate::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS, MapState};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{Brightness, PoseEstimate, TrackingState};

/// Tuning of the mapper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperParams {
    /// Smallest gradient of a pixel that may carry depth, grey levels a pixel.
    pub min_gradient: f32,
    /// Most pixels that may carry depth; the strongest gradients are kept. Bounds time and memory.
    pub max_candidates: usize,
    /// Frames from before a new keyframe that give depth to its new pixels; 0 waits for later ones.
    pub num_seed_frames: usize,
    /// Frames kept for that, newest first: bounds the memory (one byte a pixel each).
    pub max_past_frames: usize,
    /// At least so many frames lie between two keyframes.
    pub min_keyframe_interval: u64,
    /// Search along the epipolar line.
    pub matching: MatchingParams,
    /// The depth filter.
    pub gaussian: GaussianParams,
    /// The step to a new keyframe.
    pub propagation: PropagationParams,
    /// Smoothing.
    pub regularisation: RegularisationParams,
    /// The start.
    pub initializer: InitializerParams,
}

impl Default for MapperParams {
    fn default() -> Self {
        Self {
            min_gradient: 5.0,
            max_candidates: MAX_KEYFRAME_POINTS,
            num_seed_frames: 4,
            max_past_frames: 40,
            min_keyframe_interval: 2,
            matching: MatchingParams::default(),
            gaussian: GaussianParams::default(),
            propagation: PropagationParams::default(),
            regularisation: RegularisationParams::default(),
            initializer: InitializerParams::default(),
        }
    }
}

impl MapperParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        check_range("min_gradient", self.min_gradient, 0.5..=100.0)?;
        check_range("max_candidates", self.max_candidates, 100..=MAX_KEYFRAME_POINTS)?;
        check_range("num_seed_frames", self.num_seed_frames, 0..=20)?;
        check_range("max_past_frames", self.max_past_frames, 1..=200)?;
        check_range("min_keyframe_interval", self.min_keyframe_interval, 1..=1000)?;
        self.matching.validate().map_err(|e| e.within("matching"))?;
        self.gaussian.validate().map_err(|e| e.within("gaussian"))?;
        self.propagation.validate().map_err(|e| e.within("propagation"))?;
        self.regularisation.validate().map_err(|e| e.within("regularisation"))?;
        self.initializer.validate().map_err(|e| e.within("initializer"))
    }
}

/// What changed in one step, and what has to be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StepOutcome {
    /// The keyframe in force was made in this step: publish its image too.
    pub keyframe_created: bool,
    /// The keyframe in force has other depth than before: publish it.
    pub keyframe_changed: bool,
    /// A keyframe's pose changed, or one was added: publish the graph.
    pub graph_changed: bool,
    /// What the frame did to the depth map.
    pub observations: ObservationCounts,
}

/// All keyframes of one epoch, with their final depth.
#[derive(Debug, Clone, Default)]
pub struct Map {
    /// Keyframes in order of creation; the last is the one in force.
    pub keyframes: Vec<Keyframe>,
}

/// A frame kept to observe the new pixels of the next keyframe.
#[derive(Debug)]
struct PastFrame {
    pixels: Vec<u8>,
    world_from_camera: SE3,
    /// Against the keyframe in force.
    brightness: Brightness,
}

/// Keeps the map.
#[derive(Debug)]
pub struct Mapper {
    params: MapperParams,
    intrinsics: Intrinsics,
    map: Map,
    /// The depth map of the keyframe in force, and memory for the next.
    depth: DepthMap,
    next_depth: DepthMap,
    regularised: Image<Hypothesis>,
    frame: Image<f32>,
    past: VecDeque<PastFrame>,
    spare_pixels: Vec<Vec<u8>>,
    revision: u64,
    next_keyframe_id: u64,
    epoch: u32,
    frames_on_keyframe: u64,
}

impl Mapper {
    /// A mapper for images of `intrinsics`, with an empty map.
    pub fn new(intrinsics: Intrinsics, params: MapperParams) -> Result<Self, ParameterError> {
        params.validate()?;
        let (width, height) = (intrinsics.width, intrinsics.height);
        Ok(Self {
            params,
            intrinsics,
            map: Map::default(),
            depth: DepthMap::with_size(width, height),
            next_depth: DepthMap::with_size(width, height),
            regularised: Image::filled(width, height, Hypothesis::NONE),
            frame: Image::filled(width, height, 0.0),
            past: VecDeque::new(),
            spare_pixels: Vec::new(),
            revision: 0,
            next_keyframe_id: 0,
            epoch: 0,
            frames_on_keyframe: 0,
        })
    }

    /// Takes in one tracked frame. `sensor_depth` (metres, 0 where none) initialises the depth of
    /// new keyframes where a depth camera may be used.
    pub fn step(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        if !frame.is_consistent()
            || (frame.width, frame.height) != (self.intrinsics.width, self.intrinsics.height)
        {
            return StepOutcome::default();
        }
        if self.map.keyframes.is_empty() {
            return self.start(frame, pose, sensor_depth);
        }
        if matches!(pose.state, TrackingState::Lost(_)) || !pose.world_from_camera.is_finite() {
            return StepOutcome::default();
        }
        self.frames_on_keyframe += 1;
        let initializing = self.map_state() == MapState::Initializing;
        let observations = self.observe_frame(frame, pose);
        regularise(&mut self.depth, &mut self.regularised, &self.params.regularisation);
        if initializing {
            return self.continue_start(frame, pose, observations, sensor_depth);
        }
        let due = self.frames_on_keyframe >= self.params.min_keyframe_interval;
        let mut outcome =
            StepOutcome { observations, keyframe_changed: true, ..Default::default() };
        if pose.proposes_keyframe && due {
            self.change_keyframe(frame, pose, sensor_depth);
            outcome.keyframe_created = true;
            outcome.graph_changed = true;
        } else {
            self.remember(frame, pose);
            self.publish_depth();
        }
        outcome
    }

    /// The keyframe in force, once there is one.
    pub fn keyframe(&self) -> Option<&Keyframe> {
        self.map.keyframes.last()
    }

    /// Every keyframe.
    pub fn map(&self) -> &Map {
        &self.map
    }

    fn map_state(&self) -> MapState {
        self.keyframe().map_or(MapState::Initializing, |k| k.map_state)
    }

    /// Begins a map on this frame: with the sensor's depth, with random depth, or, where the pose is
    /// claimed without a map (it is given, so the baselines will be true), without any.
    fn start(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        self.map.keyframes.clear();
        self.past.clear();
        self.depth.restart(frame.pixels, self.params.min_gradient, self.params.max_candidates);
        let is_given = pose.state.is_tracked();
        let map_state = match sensor_depth {
            Some(sensor) => {
                take_sensor_depth(&mut self.depth, sensor, 1.0);
                MapState::Established
            }
            None if is_given => MapState::Established,
            None => {
                randomise(&mut self.depth, self.params.initializer.seed ^ frame.sequence);
                regularise(&mut self.depth, &mut self.regularised, &self.params.regularisation);
                MapState::Initializing
            }
        };
        let scale = self.rescale_to_unit_mean();
        let world_from_camera = if is_given { pose.world_from_camera } else { SE3::identity() };
        self.add_keyframe(frame, Sim3::new(world_from_camera, scale), map_state);
        StepOutcome {
            keyframe_created: true,
            keyframe_changed: true,
            graph_changed: true,
            ..Default::default()
        }
    }

    /// Judges a start that is not proven yet: proves it, goes on, or begins again.
    fn continue_start(
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
        if proven && let Some(keyframe) = self.map.keyframes.last_mut() {
            keyframe.map_state = MapState::Established;
        }
        self.remember(frame, pose);
        self.publish_depth();
        StepOutcome { keyframe_changed: true, observations, ..Default::default() }
    }

    /// Observes the depth map of the keyframe in force in `frame`.
    fn observe_frame(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) -> ObservationCounts {
        let Some(keyframe) = self.map.keyframes.last() else { return ObservationCounts::default() };
        let keyframe_from_camera = keyframe.world_from_keyframe.locate(&pose.world_from_camera);
        float_from_grey(&mut self.frame, frame.pixels);
        let observer = Observer {
            image: &self.frame,
            view: TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse()),
            brightness: self.brightness_against_keyframe(pose),
            only_new: false,
        };
        let mut matching = self.params.matching.clone();
        if self.map_state() == MapState::Initializing {
            matching.line_noise_px = self.params.initializer.line_noise_px;
        }
        observe(&mut self.depth, &observer, &matching, &self.params.gaussian)
    }

    /// Brightness of a frame against the keyframe in force; none is known for a pose that was
    /// tracked on another keyframe.
    fn brightness_against_keyframe(&self, pose: &PoseEstimate) -> Brightness {
        let current = self.keyframe().map(|k| k.keyframe_id);
        if current == Some(pose.keyframe_id) { pose.brightness } else { Brightness::default() }
    }

    /// Makes `frame` the keyframe: carries the depth over, looks back for its new pixels, rescales.
    fn change_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
    ) {
        let Some(before) = self.map.keyframes.last() else { return };
        let world_from_before = before.world_from_keyframe;
        let before_image = before.image.clone();
        let brightness = self.brightness_against_keyframe(pose);
        let before_from_frame = world_from_before.locate(&pose.world_from_camera);
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
        self.rebase_past(brightness, before_image, world_from_before.rigid);
        let mut world_from_keyframe = Sim3::new(pose.world_from_camera, world_from_before.scale);
        if let Some(sensor) = sensor_depth {
            take_sensor_depth(&mut self.depth, sensor, world_from_keyframe.scale);
        } else {
            self.seed_from_past(&world_from_keyframe);
        }
        regularise(&mut self.depth, &mut self.regularised, &self.params.regularisation);
        world_from_keyframe.scale *= self.rescale_to_unit_mean();
        self.add_keyframe(frame, world_from_keyframe, MapState::Established);
    }

    /// Expresses the brightness of past frames against the new keyframe, and files the old one.
    fn rebase_past(&mut self, new: Brightness, before_image: Vec<u8>, world_from_before: SE3) {
        self.past.push_back(PastFrame {
            pixels: before_image,
            world_from_camera: world_from_before,
            brightness: Brightness::default(),
        });
        for past in &mut self.past {
            let a = past.brightness.a - new.a;
            past.brightness = Brightness { a, b: past.brightness.b - a.exp() * new.b };
        }
        self.forget_oldest();
    }

    /// Gives new pixels of the keyframe their depth from frames before it, shortest baseline first:
    /// each narrows the search of the next.
    fn seed_from_past(&mut self, world_from_keyframe: &Sim3) {
        /// Each frame's baseline is at least this many times the one before.
        const BASELINE_STEP: f64 = 1.7;
        /// Baselines shorter than this share of the mean depth tell nothing.
        const MIN_BASELINE: f64 = 0.01;
        let mut least = MIN_BASELINE;
        let mut used = 0;
        for past in self.past.iter().rev() {
            let keyframe_from_camera = world_from_keyframe.locate(&past.world_from_camera);
            let baseline = keyframe_from_camera.translation.norm();
            if baseline < least {
                continue;
            }
            float_from_grey(&mut self.frame, &past.pixels);
            let observer = Observer {
                image: &self.frame,
                view: TwoView::new(&self.intrinsics, &keyframe_from_camera.inverse()),
                brightness: past.brightness,
                only_new: true,
            };
            observe(&mut self.depth, &observer, &self.params.matching, &self.params.gaussian);
            least = baseline * BASELINE_STEP;
            used += 1;
            if used >= self.params.num_seed_frames {
                break;
            }
        }
    }

    /// Rescales the depth map to mean inverse depth 1; the factor belongs to the keyframe's scale.
    fn rescale_to_unit_mean(&mut self) -> f64 {
        let Some(mean) = self.depth.mean_inverse_depth().filter(|m| *m > 0.0) else { return 1.0 };
        let factor = 1.0 / mean;
        self.depth.rescale(factor as f32);
        factor
    }

    fn add_keyframe(
        &mut self,
        frame: &FrameView<'_>,
        world_from_keyframe: Sim3,
        map_state: MapState,
    ) {
        self.map.keyframes.push(Keyframe {
            keyframe_id: self.next_keyframe_id,
            epoch: self.epoch,
            revision: self.revision,
            sequence: frame.sequence,
            capture_nanos: frame.capture_nanos,
            map_state,
            world_from_keyframe,
            intrinsics: self.intrinsics,
            image: frame.pixels.to_vec(),
            points: Vec::new(),
        });
        self.next_keyframe_id += 1;
        self.frames_on_keyframe = 0;
        self.publish_depth();
    }

    /// Writes the depth map into the keyframe in force.
    fn publish_depth(&mut self) {
        self.revision += 1;
        let Some(keyframe) = self.map.keyframes.last_mut() else { return };
        keyframe.revision = self.revision;
        keyframe.points.clear();
        let width = self.depth.image.width();
        let intensity = self.depth.image.intensity.pixels();
        for (i, h) in self.depth.hypotheses.pixels().iter().enumerate() {
            if h.is_some() && h.smoothed > 0.0 && keyframe.points.len() < MAX_KEYFRAME_POINTS {
                keyframe.points.push(DepthPoint {
                    u: (i % width) as u16,
                    v: (i / width) as u16,
                    inverse_depth: h.smoothed,
                    variance: h.variance,
                    intensity: intensity[i],
                });
            }
        }
    }

    fn remember(&mut self, frame: &FrameView<'_>, pose: &PoseEstimate) {
        let mut pixels = self.spare_pixels.pop().unwrap_or_default();
        pixels.clear();
        pixels.extend_from_slice(frame.pixels);
        let brightness = self.brightness_against_keyframe(pose);
        self.past.push_back(PastFrame {
            pixels,
            world_from_camera: pose.world_from_camera,
            brightness,
        });
        self.forget_oldest();
    }

    fn forget_oldest(&mut self) {
        while self.past.len() > self.params.max_past_frames {
            if let Some(oldest) = self.past.pop_front() {
                self.spare_pixels.push(oldest.pixels);
            }
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

/// Grey values as f32.
fn float_from_grey(out: &mut Image<f32>, pixels: &[u8]) {
    out.pixels_mut()
        .par_iter_mut()
        .with_min_len(1 << 16)
        .zip(pixels)
        .for_each(|(o, &p)| *o = f32::from(p));
}

/// Gives every candidate the depth of a sensor, in units of `scale` metres.
fn take_sensor_depth(map: &mut DepthMap, sensor: &Image<f32>, scale: f64) {
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
