//! The recipe of a map step: observe depth, regularise, choose keyframes, propagate.

mod another_map;
pub mod appearance;
mod change;
mod closing;
pub mod consistency;
mod correction;
mod depth_buffers;
mod doubt;
mod finder;
mod frame_copies;
mod joint;
mod maturing;
pub mod modes;
pub(crate) mod observation;
mod params;
mod past;
mod phase;
pub mod prior;
pub mod recovery;
mod resume;
pub mod reuse;
pub mod situation;
mod start;
mod thinning;
pub(in crate::slam) mod turned_views;

use std::collections::{BTreeMap, VecDeque};

use crate::slam::depth::gaussian::ObservationCounts;
use crate::slam::depth::line_noise::LineNoise;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::image::buffer::Image;
use crate::slam::image::quads::QuadImage;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::slam::mapper::change::Unfinished;
use crate::slam::mapper::consistency::START_KEYFRAMES;
use crate::slam::mapper::depth_buffers::{DepthBuffers, write_depth};
use crate::slam::mapper::doubt::Doubt;
use crate::slam::mapper::finder::Finder;
use crate::slam::mapper::frame_copies::FrameCopies;
use crate::slam::mapper::modes::{KeyframeModes, in_unit};
use crate::slam::mapper::past::PastFrames;
use crate::slam::mapper::phase::{Active, Phase};
use crate::slam::mapper::prior::Prior;
use crate::slam::mapper::situation::StartFrame;
use crate::slam::mapper::start::Start;
use crate::slam::mapper::thinning::Thinning;
use crate::slam::parameter::ParameterError;
use crate::slam::pose::{DegradedReason, NO_KEYFRAME, PoseEstimate, TrackingState};
use crate::slam::window::Window;
use crate::slam::window::frames::TrackedFrame;

pub use params::MapperParams;

/// The outcome of one step: what changed and must be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StepOutcome {
    /// The active keyframe was created in this step: publish its image too.
    pub keyframe_created: bool,
    /// An earlier keyframe is active again: publish its image too.
    pub keyframe_restored: bool,
    /// The depth or the state of the active keyframe changed: publish it.
    pub keyframe_changed: bool,
    /// A keyframe's pose changed, or one was added: publish the graph.
    pub graph_changed: bool,
    /// Counts of the frame's depth observations.
    pub observations: ObservationCounts,
}

impl StepOutcome {
    /// A map was started with its first keyframes.
    fn map_started() -> Self {
        Self {
            keyframe_created: true,
            keyframe_changed: true,
            graph_changed: true,
            ..Self::default()
        }
    }

    /// An earlier keyframe is active again.
    fn keyframe_restored(graph_changed: bool) -> Self {
        Self { keyframe_restored: true, keyframe_changed: true, graph_changed, ..Self::default() }
    }

    /// Whether the active keyframe was replaced or revised.
    pub fn needs_publishing(&self) -> bool {
        self.keyframe_created || self.keyframe_restored || self.keyframe_changed
    }

    /// Whether a different keyframe became active.
    pub fn needs_image(&self) -> bool {
        self.keyframe_created || self.keyframe_restored
    }
}

/// The input of one step.
#[derive(Debug, Clone, Copy)]
struct StepInput<'a> {
    frame: &'a FrameView<'a>,
    pose: &'a PoseEstimate,
    /// Metres, 0 where invalid.
    sensor_depth: Option<&'a Image<f32>>,
}

/// Builds and maintains the map.
#[derive(Debug)]
pub struct Mapper {
    params: MapperParams,
    intrinsics: Intrinsics,
    map: Map,
    phase: Phase,
    /// The map of earlier runs that this mapper started in.
    prior: Option<Prior>,
    /// The keyframe that frames are tracked on; `None` before the first.
    active: Option<Active>,
    /// Pose of the active epoch's map in odometry's world: a similarity, since a correction may change units.
    world_from_map: Sim3,
    /// The same for epochs that were left, by epoch number.
    left_worlds: BTreeMap<u32, Sim3>,
    /// The camera's last odometry pose; a tracker that is lost, or was restarted, may not have it.
    last_world_from_camera: Option<SE3>,
    /// The keyframe that the last frame was tracked on, and the camera's pose on it, in its unit.
    last_tracked: Option<(u64, SE3)>,
    depth: DepthBuffers,
    modes: KeyframeModes,
    /// Misplacement of epipolar lines at estimated poses, from the matches.
    line_noise: LineNoise,
    start: Start,
    finder: Finder,
    past: PastFrames,
    /// Keyframes that are estimated jointly; `None` while the window is taken out.
    window: Option<Box<Window>>,
    /// Whether a joint estimate was ever requested.
    is_estimated: bool,
    /// Keyframes that lost their depth because others show their points as well.
    thinning: Thinning,
    /// Whether the map has contradicted itself.
    doubt: Doubt,
    /// Tracked frames that the window has not taken yet.
    tracked: Vec<TrackedFrame>,
    /// Frames of a start that is not proven yet.
    early: Vec<TrackedFrame>,
    /// Copies of frames, shared by these lists, `past` and the keyframes of the map.
    copies: FrameCopies,
    /// Keyframes whose depth is final for now, until they are taken.
    left: VecDeque<u64>,
    /// Buffer for the current frame.
    frame: QuadImage,
    /// Work left on the active keyframe after it is published.
    unfinished: Option<Unfinished>,
    /// Counts up with every change of a keyframe's depth, pose or state.
    revision: u64,
    next_keyframe_id: u64,
    /// Epoch numbers below this may have been assigned by a mapper that died.
    first_free_epoch: u32,
}

impl Mapper {
    /// Creates a mapper with an empty map, for images of `intrinsics`.
    pub fn new(intrinsics: Intrinsics, params: MapperParams) -> Result<Self, ParameterError> {
        params.validate()?;
        let (width, height) = (intrinsics.width, intrinsics.height);
        Ok(Self {
            intrinsics,
            map: Map::default(),
            phase: Phase::default(),
            prior: None,
            active: None,
            world_from_map: Sim3::identity(),
            left_worlds: BTreeMap::new(),
            last_world_from_camera: None,
            last_tracked: None,
            line_noise: LineNoise::new(params.matching.line_noise_px),
            depth: DepthBuffers::with_size(width, height),
            modes: KeyframeModes::default(),
            start: Start::new(intrinsics, &params.two_frame)?,
            finder: Finder::new(&intrinsics),
            // One more, for the active keyframe.
            past: PastFrames::with_capacity(params.max_past_frames + 1),
            window: (params.window.num_free > 0).then(|| {
                let window = Window::new(intrinsics, params.window.clone());
                Box::new(window.with_loops(params.loops.clone()))
            }),
            is_estimated: false,
            thinning: Thinning::default(),
            doubt: Doubt::None,
            tracked: Vec::new(),
            early: Vec::new(),
            copies: FrameCopies::default(),
            left: VecDeque::new(),
            frame: QuadImage::with_size(width, height),
            unfinished: None,
            revision: 0,
            next_keyframe_id: 0,
            first_free_epoch: 0,
            params,
        })
    }

    /// Takes in one tracked frame. `sensor_depth` (metres, 0 where invalid) initialises the depth of new keyframes
    /// where a depth camera may be used. `change_begins` is called, for timing, once the frame is observed and before
    /// another keyframe becomes active.
    pub fn step(
        &mut self,
        frame: &FrameView<'_>,
        pose: &PoseEstimate,
        sensor_depth: Option<&Image<f32>>,
        change_begins: &mut dyn FnMut(),
    ) -> StepOutcome {
        let finished = self.finish_keyframe();
        self.start.last_frame = None;
        let size = (self.intrinsics.width, self.intrinsics.height);
        let outcome = if frame.is_consistent() && (frame.width, frame.height) == size {
            self.copies.begin_frame(frame);
            self.start.has_image &= self.copies.is_repeat();
            self.step_inner(&StepInput { frame, pose, sensor_depth }, change_begins)
        } else {
            StepOutcome::default()
        };
        let is_told = self.publish_doubt();
        let keyframe_changed = outcome.keyframe_changed || finished.keyframe_changed || is_told;
        StepOutcome { keyframe_changed, ..outcome }
    }

    fn step_inner(
        &mut self,
        input: &StepInput<'_>,
        change_begins: &mut dyn FnMut(),
    ) -> StepOutcome {
        let StepInput { frame, pose, .. } = *input;
        let Some(keyframe) = self.keyframe() else {
            return match self.is_localising() {
                true => {
                    self.follow_odometry(pose);
                    self.recover(input)
                }
                false => self.begin(input),
            };
        };
        let is_lost = matches!(pose.state, TrackingState::Lost(_));
        let (active_id, active_epoch) = (keyframe.keyframe_id, keyframe.epoch);
        let is_established = keyframe.map_state == MapState::Established;
        // An epoch that was joined to another has changed its number.
        let epoch = self.map.get(pose.keyframe_id).map_or(pose.epoch, |keyframe| keyframe.epoch);
        if pose.keyframe_id == NO_KEYFRAME || epoch != active_epoch {
            return StepOutcome::default();
        }
        self.follow_odometry(pose);
        // Until the tracker has received this keyframe, its proposal and its brightness refer to another one.
        if !is_lost && pose.keyframe_id != active_id {
            return StepOutcome::default();
        }
        let is_usable = pose.world_from_camera.is_finite() && pose.keyframe_from_camera.is_finite();
        let is_turning = pose.state == TrackingState::Degraded(DegradedReason::Turning);
        if is_lost || !is_usable || !is_established {
            return self.recover(input);
        }
        self.last_tracked = Some((pose.keyframe_id, pose.keyframe_from_camera));
        if is_turning {
            return self.recover(input);
        }
        self.phase = Phase::Mapping;
        self.note_certainty(pose);
        match self.is_locating() {
            true => self.locate_frame(frame, pose),
            false => self.extend(input, change_begins),
        }
    }

    /// Uses a tracked frame: observes depth, judges the map, then changes the keyframe or remembers the frame.
    fn extend(&mut self, input: &StepInput<'_>, change_begins: &mut dyn FnMut()) -> StepOutcome {
        let StepInput { frame, pose, .. } = *input;
        self.queue_frame(frame, pose);
        if self.copies.repeats_copied() {
            // Its noise is the previous frame's: observed twice, depth would seem more certain than it is. The next
            // frame may repeat it again.
            self.copies.of(frame);
            return StepOutcome::default();
        }
        self.guess_unit(&pose.keyframe_from_camera);
        let (unit, modes) = (self.depth.unit, &self.params.modes);
        self.modes.begin_frame(&self.depth.active, unit, &self.intrinsics, pose, modes);
        let observations = self.observe_frame(frame, pose);
        self.modes.update_after_observation(
            &self.depth.active,
            &in_unit(&pose.keyframe_from_camera, unit),
        );
        self.depth.unpublished += observations.fused + observations.created;
        let points = self.num_points();
        let Some(active) = &mut self.active else { return StepOutcome::default() };
        active.frames += 1;
        let due = active.frames >= self.params.min_keyframe_interval;
        if let Some(rejected) = self.judge_frame(&observations, pose) {
            return rejected;
        }
        if pose.proposes_keyframe && due && !self.would_lose_depth(frame, pose) {
            change_begins();
            let is_reused = self.reuse_keyframe(frame, pose);
            if !is_reused {
                self.change_keyframe(input);
            }
            return StepOutcome {
                keyframe_created: !is_reused,
                keyframe_restored: is_reused,
                keyframe_changed: true,
                graph_changed: !is_reused,
                observations,
            };
        }
        let copy = self.copies.of(frame);
        self.past.push(copy, pose.keyframe_id, pose.keyframe_from_camera, pose.brightness);
        let keyframe_changed =
            self.depth.unpublished as f64 > self.params.publish_change_ratio * points as f64;
        if keyframe_changed {
            self.depth.refine(&self.params);
            self.depth.keep_unit_mean();
            self.publish_depth();
            self.count_points();
        }
        StepOutcome { keyframe_changed, observations, ..Default::default() }
    }

    /// The active keyframe; `None` before the first.
    pub fn keyframe(&self) -> Option<&Keyframe> {
        self.map.keyframes.get(self.active.as_ref()?.index)
    }

    /// The result of the last frame, if it belonged to a two-frame start.
    pub fn start_frame(&self) -> Option<StartFrame> {
        self.start.last_frame
    }

    /// The map, with all its keyframes.
    pub fn map(&self) -> &Map {
        &self.map
    }

    /// Frees the frames that only later frames need: call it before the last estimate, when no frame will follow.
    pub fn free_frames(&mut self) {
        self.past.clear();
        self.copies.free_unused();
    }

    /// Consumes the mapper and returns its map.
    pub fn into_map(self) -> Map {
        self.map
    }

    /// Whether an epoch has no more keyframes than those that judge its start.
    fn is_young(&self, epoch: u32) -> bool {
        let of_epoch = self.map.keyframes.iter().rev().filter(|k| k.epoch == epoch);
        of_epoch.take(START_KEYFRAMES + 1).count() <= START_KEYFRAMES
    }

    fn num_points(&self) -> usize {
        self.keyframe().map_or(0, |keyframe| keyframe.points.len())
    }

    /// Rejects a map that has lost almost all of its depth.
    fn count_points(&mut self) {
        let (points, params) = (self.num_points(), &self.params.consistency);
        let Some(active) = &mut self.active else { return };
        if let Some(contradiction) = active.consistency.count_points(points, params) {
            self.contradict(contradiction);
        }
    }

    fn keyframe_mut(&mut self) -> Option<&mut Keyframe> {
        self.map.keyframes.get_mut(self.active.as_ref()?.index)
    }

    /// Writes the final depth of the active keyframe, unless its map is rejected, before it is left.
    fn deactivate_keyframe(&mut self) {
        let is_rejected = self.keyframe().is_some_and(|k| k.map_state == MapState::Rejected);
        if self.depth.unpublished > 0 && !is_rejected {
            self.publish_depth();
        }
    }

    /// Makes a keyframe of the map the active one, placed in the world by `world_from_map`.
    fn activate_keyframe(&mut self, index: usize) {
        if let Some(left) = self.keyframe().map(|keyframe| keyframe.keyframe_id) {
            self.queue_keyframe_to_save(left);
        }
        self.active = Some(Active::new(index));
        if let Some(keyframe) = self.map.keyframes.get(index) {
            self.modes.enter(&keyframe.mode_covariance, &self.params.modes);
        }
        self.depth.unpublished = 0;
        self.depth.choose_traced_points(&self.params);
        self.publish_depth();
    }

    /// Writes the active depth, the pose in the world and the revisions into the active keyframe.
    fn publish_depth(&mut self) {
        self.revision += 1;
        self.publish_pose();
        let Some(active) = &self.active else { return };
        let Some(keyframe) = self.map.keyframes.get_mut(active.index) else { return };
        write_depth(&self.depth.active, self.depth.unit, keyframe);
        keyframe.mode_covariance = self.modes.published(&self.params.modes);
    }

    /// Writes the pose in the world and the revisions into the active keyframe.
    fn publish_pose(&mut self) {
        let (revision, map_revision) = (self.revision, self.map.revision);
        let world_from_map = self.world_from_map;
        let Some(keyframe) = self.keyframe_mut() else { return };
        (keyframe.revision, keyframe.map_revision) = (revision, map_revision);
        keyframe.world_from_keyframe = world_from_map * keyframe.map_from_keyframe;
    }
}
