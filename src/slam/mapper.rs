//! The recipe of a map step: observe depth, regularise, choose keyframes, propagate.

mod change;
pub mod consistency;
mod memory;
pub mod observation;
mod past;
pub mod recovery;
mod resume;
pub mod reuse;
pub mod situation;
mod start;

use serde::{Deserialize, Serialize};

use crate::slam::depth::candidate::CandidateParams;
use crate::slam::depth::gaussian::{GaussianParams, ObservationCounts};
use crate::slam::depth::immature::IntervalParams;
use crate::slam::depth::interval::IntervalFilter;
use crate::slam::depth::map::DepthMap;
use crate::slam::depth::matching::MatchingParams;
use crate::slam::depth::propagation::PropagationParams;
use crate::slam::depth::regularisation::{RegularisationParams, RegularisationScratch};
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::image::quads::QuadImage;
use crate::slam::initializer::InitializerParams;
use crate::slam::keyframe::{Keyframe, MAX_KEYFRAME_POINTS, MapState};
use crate::slam::mapper::change::Unfinished;
use crate::slam::mapper::consistency::{Consistency, ConsistencyParams, Contradiction};
use crate::slam::mapper::observation::DepthFilter;
use crate::slam::mapper::past::PastFrames;
use crate::slam::mapper::recovery::{Recovery, RecoveryParams};
use crate::slam::mapper::reuse::ReuseParams;
use crate::slam::mapper::situation::{Situation, StartFrame, StartProgress};
use crate::slam::parameter::{ParameterError, check_range};
use crate::slam::pose::{NO_KEYFRAME, PoseEstimate, TrackingState};
use crate::slam::two_frame::TwoFrameInitializer;

/// Tuning of the mapper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperParams {
    /// Smallest gradient of a pixel that may carry depth, grey levels a pixel.
    pub min_gradient: f32,
    /// Most pixels that may carry depth; the strongest gradients are kept. Bounds time and memory.
    pub max_candidates: usize,
    /// Frames from before a new keyframe that give depth to its new pixels in the Gaussian filter; 0
    /// waits for the frames that follow. In the simulated room one lowers the median error by a
    /// quarter (0.7 instead of 1.0 %), 4 no further, and each is a search over all depths for every
    /// new pixel.
    pub num_seed_frames: usize,
    /// Frames kept for that, newest first, beside the keyframe in force: bounds the memory (one byte a pixel each).
    pub max_past_frames: usize,
    /// The depth is smoothed and published again when this share of it has changed: a map that
    /// hardly changed costs the tracker as much to prepare as a new one.
    pub publish_change_ratio: f64,
    /// Most memory for images and depth of the keyframes of the map, megabytes: about 1.7 a keyframe at
    /// 640×480. Beyond it the oldest keep only their poses.
    pub max_map_megabytes: usize,
    /// At least so many frames lie between two keyframes.
    pub min_keyframe_interval: u64,
    /// Which filter estimates depth: `gaussian`, `interval` (sparse) or `both`. The Gaussian filter is
    /// the cheaper of the two that make a semi-dense map; `docs/depth-filters.md` compares them.
    pub depth_filter: DepthFilter,
    /// Search along the epipolar line.
    pub matching: MatchingParams,
    /// The Gaussian filter.
    pub gaussian: GaussianParams,
    /// The interval filter.
    pub interval: IntervalParams,
    /// The points of the interval filter where it is alone; with the Gaussian filter it traces every
    /// pixel with gradient that has no depth yet.
    pub candidates: CandidateParams,
    /// The step to a new keyframe.
    pub propagation: PropagationParams,
    /// Smoothing.
    pub regularisation: RegularisationParams,
    /// The start.
    pub initializer: InitializerParams,
    /// When the map is rejected.
    pub consistency: ConsistencyParams,
    /// When an earlier keyframe is taken up again.
    pub reuse: ReuseParams,
    /// What is done when the camera is lost.
    pub recovery: RecoveryParams,
}

impl Default for MapperParams {
    fn default() -> Self {
        Self {
            min_gradient: 5.0,
            max_candidates: MAX_KEYFRAME_POINTS,
            num_seed_frames: 1,
            max_past_frames: 40,
            publish_change_ratio: 0.2,
            max_map_megabytes: 512,
            min_keyframe_interval: 2,
            depth_filter: DepthFilter::default(),
            matching: MatchingParams::default(),
            gaussian: GaussianParams::default(),
            interval: IntervalParams::default(),
            candidates: CandidateParams::default(),
            propagation: PropagationParams::default(),
            regularisation: RegularisationParams::default(),
            initializer: InitializerParams::default(),
            consistency: ConsistencyParams::default(),
            reuse: ReuseParams::default(),
            recovery: RecoveryParams::default(),
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
        check_range("publish_change_ratio", self.publish_change_ratio, 0.0..=10.0)?;
        check_range("max_map_megabytes", self.max_map_megabytes, 16..=1_000_000)?;
        check_range("min_keyframe_interval", self.min_keyframe_interval, 1..=1000)?;
        self.matching.validate().map_err(|e| e.within("matching"))?;
        self.gaussian.validate().map_err(|e| e.within("gaussian"))?;
        self.interval.validate().map_err(|e| e.within("interval"))?;
        self.candidates.validate().map_err(|e| e.within("candidates"))?;
        self.propagation.validate().map_err(|e| e.within("propagation"))?;
        self.regularisation.validate().map_err(|e| e.within("regularisation"))?;
        self.initializer.validate().map_err(|e| e.within("initializer"))?;
        self.consistency.validate().map_err(|e| e.within("consistency"))?;
        self.reuse.validate().map_err(|e| e.within("reuse"))?;
        self.recovery.validate().map_err(|e| e.within("recovery"))
    }
}

/// What changed in one step, and what has to be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StepOutcome {
    /// The keyframe in force was made in this step: publish its image too.
    pub keyframe_created: bool,
    /// An earlier keyframe is in force again: publish its image too.
    pub keyframe_restored: bool,
    /// The keyframe in force has other depth or another state than before: publish it.
    pub keyframe_changed: bool,
    /// A keyframe's pose changed, or one was added: publish the graph.
    pub graph_changed: bool,
    /// What the frame did to the depth map.
    pub observations: ObservationCounts,
}

impl StepOutcome {
    /// Whether the keyframe in force is another one or another revision than before.
    pub fn needs_publishing(&self) -> bool {
        self.keyframe_created || self.keyframe_restored || self.keyframe_changed
    }

    /// Whether another keyframe than before is in force.
    pub fn needs_image(&self) -> bool {
        self.keyframe_created || self.keyframe_restored
    }
}

/// All keyframes of all epochs, with their final depth. Each epoch has a scale and a drift of its own.
#[derive(Debug, Clone, Default)]
pub struct Map {
    /// Keyframes in order of creation.
    pub keyframes: Vec<Keyframe>,
    /// Numbers of epochs from here on are given by nobody yet; see [`Mapper::checkpoint`].
    pub free_epoch: u32,
}

/// Keeps the map.
#[derive(Debug)]
pub struct Mapper {
    params: MapperParams,
    intrinsics: Intrinsics,
    map: Map,
    /// Place in the map of the keyframe in force; `None` before the first.
    in_force: Option<usize>,
    /// The depth map of the keyframe in force, and memory for the next.
    depth: DepthMap,
    next_depth: DepthMap,
    regularisation: RegularisationScratch,
    /// The immature points of the keyframe in force.
    points: IntervalFilter,
    frame: QuadImage,
    past: PastFrames,
    two_frame: TwoFrameInitializer,
    /// Sequence and stamp of the two-frame start's first frame.
    first_stamp: Option<(u64, i64)>,
    start_progress: StartProgress,
    /// What the last frame came to, where it was one of a two-frame start.
    start_frame: Option<StartFrame>,
    recovery: Recovery,
    consistency: Consistency,
    contradiction: Option<Contradiction>,
    /// Whether the unit of the first keyframe is still to be found.
    is_unit_open: bool,
    revision: u64,
    next_keyframe_id: u64,
    /// Numbers of epochs below may have been given by a mapper that died.
    first_free_epoch: u32,
    frames_on_keyframe: u64,
    /// Hypotheses changed since the depth was smoothed and published.
    unpublished: usize,
    /// What the keyframe in force wants when it is published.
    unfinished: Option<Unfinished>,
}

impl Mapper {
    /// A mapper for images of `intrinsics`, with an empty map.
    pub fn new(intrinsics: Intrinsics, params: MapperParams) -> Result<Self, ParameterError> {
        params.validate()?;
        let (width, height) = (intrinsics.width, intrinsics.height);
        Ok(Self {
            intrinsics,
            map: Map::default(),
            in_force: None,
            depth: DepthMap::with_size(width, height),
            next_depth: DepthMap::with_size(width, height),
            regularisation: RegularisationScratch::with_size(width, height),
            points: IntervalFilter::default(),
            frame: QuadImage::with_size(width, height),
            // The keyframe in force is one more.
            past: PastFrames::with_capacity(params.max_past_frames + 1),
            two_frame: TwoFrameInitializer::new(intrinsics, params.initializer.two_frame.clone())
                .map_err(|e| e.within("initializer.two_frame"))?,
            first_stamp: None,
            start_progress: StartProgress::default(),
            start_frame: None,
            recovery: Recovery::new(&intrinsics),
            consistency: Consistency::default(),
            contradiction: None,
            is_unit_open: false,
            revision: 0,
            next_keyframe_id: 0,
            first_free_epoch: 0,
            frames_on_keyframe: 0,
            unpublished: 0,
            unfinished: None,
            params,
        })
    }

    /// Takes in one tracked frame. `sensor_depth` (metres, 0 where none) initialises the depth of
    /// new keyframes where a depth camera may be used. `change_begins` is called when
    /// the frame is observed and another keyframe is to be put in force, for who measures that.
    pub fn step(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
        change_begins: &mut dyn FnMut(),
    ) -> StepOutcome {
        let finished = self.finish_keyframe();
        self.start_frame = None;
        let outcome = self.take_in(frame, pose, sensor_depth, change_begins);
        let keyframe_changed = outcome.keyframe_changed || finished.keyframe_changed;
        StepOutcome { keyframe_changed, ..outcome }
    }

    fn take_in(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
        change_begins: &mut dyn FnMut(),
    ) -> StepOutcome {
        if !frame.is_consistent()
            || (frame.width, frame.height) != (self.intrinsics.width, self.intrinsics.height)
        {
            return StepOutcome::default();
        }
        let Some(keyframe) = self.keyframe() else { return self.start(frame, pose, sensor_depth) };
        if pose.keyframe_id == NO_KEYFRAME || pose.epoch != keyframe.epoch {
            // The tracker has not seen this epoch yet.
            return StepOutcome::default();
        }
        let is_lost = matches!(pose.state, TrackingState::Lost(_));
        if !is_lost && pose.keyframe_id != keyframe.keyframe_id {
            // The tracker has not seen this keyframe yet: its proposal and its brightness are about
            // another one.
            return StepOutcome::default();
        }
        if is_lost || !pose.world_from_camera.is_finite() || self.is_rejected() {
            return self.recover(frame, pose, sensor_depth);
        }
        self.recovery.end();
        self.observe(frame, pose, sensor_depth, change_begins)
    }

    /// Takes a tracked frame into the keyframe, and changes to another where that is due.
    fn observe(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
        change_begins: &mut dyn FnMut(),
    ) -> StepOutcome {
        self.frames_on_keyframe += 1;
        let initializing = self.map_state() == MapState::Initializing;
        self.guess_unit(pose);
        let observations = self.observe_frame(frame, pose);
        self.unpublished += observations.fused + observations.created;
        let points = self.keyframe().map_or(0, |keyframe| keyframe.points.len());
        let contradiction =
            self.consistency.observe(&observations, points, &self.params.consistency);
        if let Some(contradiction) = contradiction.filter(|_| !initializing) {
            self.reject(contradiction);
            return StepOutcome { keyframe_changed: true, observations, ..Default::default() };
        }
        if initializing {
            self.refine();
            return self.continue_start(frame, pose, observations, sensor_depth);
        }
        let due = self.frames_on_keyframe >= self.params.min_keyframe_interval;
        if pose.proposes_keyframe && due {
            change_begins();
            let is_reused = self.reuse_keyframe(frame, pose);
            if !is_reused {
                self.change_keyframe(frame, pose, sensor_depth);
            }
            return StepOutcome {
                keyframe_created: !is_reused,
                keyframe_restored: is_reused,
                keyframe_changed: true,
                graph_changed: !is_reused,
                observations,
            };
        }
        self.remember(frame, pose);
        let keyframe_changed =
            self.unpublished as f64 > self.params.publish_change_ratio * points as f64;
        if keyframe_changed {
            self.publish_change();
        }
        StepOutcome { keyframe_changed, observations, ..Default::default() }
    }

    /// Smooths and publishes the keyframe's depth; a map that has lost too much of it contradicts itself.
    fn publish_change(&mut self) {
        self.refine();
        self.keep_unit_mean();
        self.publish_depth();
        let points = self.keyframe().map_or(0, |keyframe| keyframe.points.len());
        let lost_depth = self.consistency.count_points(points, &self.params.consistency);
        if let Some(contradiction) = lost_depth {
            self.reject(contradiction);
        }
    }

    /// The keyframe in force, once there is one.
    pub fn keyframe(&self) -> Option<&Keyframe> {
        self.map.keyframes.get(self.in_force?)
    }

    /// What the mapper is doing, and why.
    pub fn situation(&self) -> Situation {
        let state = self.keyframe().map(|keyframe| keyframe.map_state);
        match (state, self.contradiction) {
            (None, _) => Situation::Starting(self.start_progress),
            _ if self.recovery.is_restarting => Situation::Restarting(self.start_progress),
            (Some(MapState::Rejected), Some(why)) => Situation::Rejected(why),
            _ if self.recovery.is_under_way() => Situation::Lost,
            (Some(MapState::Initializing), _) => Situation::Unproven,
            _ => Situation::Mapping,
        }
    }

    /// What the last frame came to, where it was one of a two-frame start.
    pub fn start_frame(&self) -> Option<StartFrame> {
        self.start_frame
    }

    /// Every keyframe.
    pub fn map(&self) -> &Map {
        &self.map
    }

    fn map_state(&self) -> MapState {
        self.keyframe().map_or(MapState::Initializing, |k| k.map_state)
    }

    fn is_rejected(&self) -> bool {
        self.map_state() == MapState::Rejected
    }

    fn keyframe_mut(&mut self) -> Option<&mut Keyframe> {
        self.map.keyframes.get_mut(self.in_force?)
    }

    /// Leaves the depth that was reached with the keyframe in force.
    fn leave_keyframe(&mut self) {
        if self.unpublished > 0 && !self.is_rejected() {
            self.publish_depth();
        }
    }

    /// Puts a keyframe of the map in force.
    fn enter_keyframe(&mut self, index: usize) {
        self.in_force = Some(index);
        self.consistency = Consistency::default();
        (self.frames_on_keyframe, self.unpublished) = (0, 0);
    }
}
