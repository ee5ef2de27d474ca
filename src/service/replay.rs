//! The whole pipeline in one process: every frame, in order.
//!
//! Frame N: track, map, and if the keyframe changed prepare it and give it to the tracker, where it is active from
//! frame N+1 on. Meanwhile keyframes are estimated jointly on a separate thread, and the estimate enters a fixed number
//! of frames later. Lockstep runs do the same over shared memory and give the same bits; times are measured here,
//! around the calls.

use std::time::Instant;

use clap::ValueEnum;

use crate::capture::mask::Mask;
use crate::capture::opening::check_size;
use crate::capture::source::{FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::service::adjustments::{Adjustments, Entry};
use crate::service::alignment_stamps::AlignmentStamps;
use crate::service::clock::elapsed_nanos;
use crate::service::config::MapConfig;
use crate::service::corrected::{Corrected, Corrections};
use crate::service::given_pose::{given_pose, truth_in_first_camera};
use crate::service::map_folder::session::{MapSession, MapSessionError};
use crate::service::read_ahead::{ReadAhead, ReadingPlan};
use crate::service::refused_images::RefusedImages;
use crate::service::rehearsal::Rehearsal;
use crate::service::results::record::{RecordedPose, Rejection, RunMode, RunRecord};
use crate::service::schedule::{Background, peak_rss_bytes};
use crate::slam::alignment::reference::Reference;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::frame::FrameView;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::mapper::situation::{Situation, StartFrame};
use crate::slam::mapper::{Mapper, MapperParams, StepOutcome};
use crate::slam::parameter::ParameterError;
use crate::slam::pose::{PoseEstimate, TrackingState};
use crate::slam::tracker::{Tracker, TrackerParams};
use crate::slam::trajectory::StampedPose;

/// Where poses come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum PoseOrigin {
    /// The tracker estimates them
    #[default]
    Tracker,
    /// The source's ground truth; only the mapper runs
    #[value(name = "groundtruth")]
    GroundTruth,
}

/// Where the first depth of a keyframe comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum DepthOrigin {
    /// The images alone
    #[default]
    Images,
    /// The source's depth camera
    Sensor,
}

/// What to replay and how.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ReplayConfig {
    /// Parameters of the tracker.
    pub tracker: TrackerParams,
    /// Parameters of the mapper.
    pub mapper: MapperParams,
    /// The map on disk that the replay begins or continues.
    pub map: MapConfig,
    /// Where poses come from.
    pub poses: PoseOrigin,
    /// Where the first depth comes from.
    pub initial_depth: DepthOrigin,
    /// Stop after this many frames; `None` for all.
    pub max_frames: Option<usize>,
    /// Whether an unusable image ends the replay; otherwise it is left out and counted.
    pub strict: bool,
    /// What is corrected in the images.
    pub corrections: Corrections,
    /// Which pixels show the scene; `None` for all.
    pub mask: Option<Mask>,
}

/// Progress after a frame, for an observer.
#[derive(Debug, Clone, Copy)]
pub struct ReplayProgress<'a> {
    /// Frames done.
    pub done: usize,
    /// Frames in all, if that is known.
    pub total: Option<usize>,
    /// State of the frame just done.
    pub state: TrackingState,
    /// The mapper's outcome for it.
    pub outcome: StepOutcome,
    /// Everything so far, except the map.
    pub record: &'a RunRecord,
    /// The map so far.
    pub map: &'a Map,
    /// The frame's outcome in a start.
    pub start_frame: Option<StartFrame>,
    /// The active keyframe.
    pub keyframe: Option<&'a Keyframe>,
}

/// Why a sequence cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The source gave no frame, or an invalid one.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The source failed later; the frames before are complete.
    #[error("{cause}; the results cover the {} frames before it", record.counters.frames_in)]
    Cut {
        /// Everything up to then.
        record: Box<RunRecord>,
        /// Why it ended.
        cause: SourceError,
    },
    /// The map on disk cannot be used.
    #[error(transparent)]
    Map(#[from] MapSessionError),
    /// The map could not be saved at the end.
    #[error("{cause}")]
    Unsaved {
        /// Everything up to then.
        record: Box<RunRecord>,
        /// The cause.
        cause: MapSessionError,
    },
    /// A thread cannot be started.
    #[error(
        "cannot start a thread of the replay ({0}): end other programs or raise the limit of processes (ulimit -u)"
    )]
    Thread(std::io::Error),
    /// A parameter is out of range.
    #[error("configuration: {0}")]
    Parameter(#[from] ParameterError),
    /// The source ended before its first frame.
    #[error("{0} has no frames: check the path and the list of images")]
    Empty(String),
    /// The source's size and intrinsics are not those of a camera.
    #[error("{0} has unusable intrinsics: check its camera file or rig")]
    Intrinsics(String),
    /// Poses were to be given, but the source has none.
    #[error(
        "{0} has no ground-truth poses: leave out '--poses groundtruth' or add groundtruth.txt"
    )]
    NoGroundTruth(String),
    /// Depth was to come from a sensor, but the source has none.
    #[error(
        "{0} has no depth images at its first frame: leave out '--initial-depth sensor' or add depth.txt"
    )]
    NoSensorDepth(String),
}

/// Replays `source` (named `source_name` in messages and results). `observe` is called after each frame and returns
/// false to end early; everything up to then is recorded.
pub fn replay(
    source: &mut dyn FrameSource,
    source_name: &str,
    config: &ReplayConfig,
    observe: &mut dyn FnMut(&ReplayProgress<'_>) -> bool,
) -> Result<RunRecord, ReplayError> {
    let mut replay = Replay::new(source, source_name, config)?;
    let total = total_frames(source, config);
    let plan = ReadingPlan {
        max_frames: config.max_frames.unwrap_or(usize::MAX),
        with_depth: config.initial_depth == DepthOrigin::Sensor,
        is_strict: config.strict,
    };
    let begin = Instant::now();
    let mut refused = RefusedImages::default();
    let mut source = Corrected::new(source, &config.corrections, config.mask.clone());
    let fault = std::thread::scope(|scope| {
        let frames = ReadAhead::start(scope, &mut source, plan).map_err(ReplayError::Thread)?;
        replay.run(&frames, total, &mut refused, observe)
    })?;
    if let Some(error) = refused.error() {
        return Err(error.into());
    }
    let (mut record, saved) = replay.finish(begin)?;
    (record.counters.frames_refused, record.refused) = (refused.count(), refused.text());
    record.counters.brightened_by = source.max_factor();
    match (fault, saved) {
        (None, Ok(())) => Ok(record),
        (None, Err(cause)) => Err(ReplayError::Unsaved { record: Box::new(record), cause }),
        (Some(cause), _) => Err(ReplayError::Cut { record: Box::new(record), cause }),
    }
}

/// Frames in all, if that is known.
fn total_frames(source: &dyn FrameSource, config: &ReplayConfig) -> Option<usize> {
    source.num_frames().map(|n| n.min(config.max_frames.unwrap_or(n)))
}

/// The depth camera's image of a frame, if there is one.
type SensorDepth = Result<Option<Image<f32>>, SourceError>;

/// Whether the map is on disk at the end.
type Saved = Result<(), MapSessionError>;

/// A replay in progress.
struct Replay<'a> {
    config: &'a ReplayConfig,
    width: usize,
    height: usize,
    tracker: Tracker,
    mapper: Mapper,
    map: Option<MapSession>,
    /// Given poses, with the first camera as the world; made at the first frame.
    given_poses: Vec<StampedPose>,
    rehearsal: Rehearsal,
    /// Memory of the reference that the tracker returned.
    spare: Option<Box<Reference>>,
    record: RunRecord,
    adjustments: Adjustments,
    stamps: Option<(FrameStamp, FrameStamp)>,
}

impl<'a> Replay<'a> {
    fn new(
        source: &mut dyn FrameSource,
        source_name: &str,
        config: &'a ReplayConfig,
    ) -> Result<Self, ReplayError> {
        let intrinsics = source.intrinsics();
        if !intrinsics.is_valid() {
            return Err(ReplayError::Intrinsics(source_name.to_owned()));
        }
        check_size(source_name, &intrinsics)?;
        let ground_truth = source.ground_truth().to_vec();
        let given = config.poses == PoseOrigin::GroundTruth;
        if given && ground_truth.is_empty() {
            return Err(ReplayError::NoGroundTruth(source_name.to_owned()));
        }
        let mut mapping = config.mapper.clone();
        if given {
            // Given poses are not estimated.
            mapping.window.num_free = 0;
        }
        let mut mapper = Mapper::new(intrinsics, mapping)?;
        let map =
            MapSession::open(&config.map, config.mapper.max_map_bytes(), Default::default(), true);
        let mut map = map.map_err(MapSessionError::from)?;
        if let Some(map) = &mut map {
            map.begin(&mut mapper, &intrinsics, None)?;
        }
        let first_keyframe_id = mapper.free_keyframe_id();
        Ok(Self {
            config,
            width: intrinsics.width,
            height: intrinsics.height,
            tracker: Tracker::new(intrinsics, config.tracker.clone())?,
            mapper,
            map,
            given_poses: Vec::new(),
            rehearsal: Rehearsal::new(total_frames(source, config)),
            spare: None,
            record: RunRecord {
                is_depth_from_sensor: config.initial_depth == DepthOrigin::Sensor,
                depth_scale: if given { DepthScale::Given } else { DepthScale::MedianRatio },
                ground_truth,
                first_keyframe_id,
                rejections: Some(Vec::new()),
                ..RunRecord::empty(RunMode::Replay, source_name)
            },
            adjustments: Adjustments::start(
                Entry::AfterFrames(config.mapper.window.delay_frames as u64),
                Background::Other,
            )
            .map_err(ReplayError::Thread)?,
            stamps: None,
        })
    }

    /// Replays all frames; returns the error that ended them early, if any.
    fn run(
        &mut self,
        frames: &ReadAhead,
        total: Option<usize>,
        refused: &mut RefusedImages,
        observe: &mut dyn FnMut(&ReplayProgress<'_>) -> bool,
    ) -> Result<Option<SourceError>, ReplayError> {
        while let Some(read) = frames.next() {
            let stamp = match read.stamp {
                Ok(Some(stamp)) => stamp,
                Ok(None) => break,
                Err(error) if error.is_transient() && !self.config.strict => {
                    refused.refuse(&error);
                    self.skip_frame();
                    frames.give_back(read.pixels);
                    continue;
                }
                Err(cause) if self.record.counters.frames_in > 0 => return Ok(Some(cause)),
                Err(cause) => return Err(cause.into()),
            };
            refused.accept();
            let (state, outcome) = self.step(&stamp, &read.pixels, read.sensor_depth)?;
            frames.give_back(read.pixels);
            let done = self.record.counters.frames_in as usize;
            let (record, map, keyframe) = (&self.record, self.mapper.map(), self.mapper.keyframe());
            let start_frame = self.mapper.start_frame();
            let progress =
                ReplayProgress { done, total, state, outcome, record, map, start_frame, keyframe };
            if !observe(&progress) {
                break;
            }
        }
        Ok(None)
    }

    /// One frame: track, map, pass the keyframe on.
    fn step(
        &mut self,
        stamp: &FrameStamp,
        pixels: &[u8],
        sensor_depth: SensorDepth,
    ) -> Result<(TrackingState, StepOutcome), ReplayError> {
        self.count(stamp);
        let frame = FrameView {
            sequence: stamp.sequence,
            capture_nanos: stamp.capture_nanos,
            exposure_nanos: stamp.exposure_nanos,
            width: self.width,
            height: self.height,
            pixels,
        };
        let Some(pose) = self.pose(&frame) else {
            return Ok((TrackingState::Initializing, StepOutcome::default()));
        };
        let sensor_depth = self.sensor_depth(sensor_depth)?;
        let was_rejected = matches!(self.mapper.situation(), Situation::Rejected(_));
        let begin = Instant::now();
        let mut change = None;
        let mut change_begins = || change = Some(Instant::now());
        let mut outcome =
            self.mapper.step(&frame, &pose, sensor_depth.as_ref(), &mut change_begins);
        let change_nanos = change.map(elapsed_nanos);
        outcome.keyframe_changed |= self.mapper.finish_keyframe().keyframe_changed;
        let step_nanos = elapsed_nanos(begin);
        if let Situation::Rejected(contradiction) = self.mapper.situation()
            && !was_rejected
        {
            let (sequence, reason) = (frame.sequence, contradiction.to_string());
            let rejection = Rejection { sequence, reason };
            self.record.rejections.get_or_insert_default().push(rejection);
        }
        self.adjust(frame.sequence, &mut outcome);
        self.map.iter_mut().for_each(|map| map.follow(&self.mapper, &outcome));
        self.record.map_nanos.push(step_nanos);
        self.record.start.count(self.mapper.start_frame());
        if let Some(change_nanos) = change_nanos.filter(|_| outcome.keyframe_created) {
            self.record.keyframe_step_nanos.push(step_nanos);
            self.record.keyframe_nanos.push(change_nanos);
        }
        if outcome.needs_publishing() && self.config.poses == PoseOrigin::Tracker {
            self.pass_keyframe_to_tracker();
        }
        Ok((pose.state, outcome))
    }

    /// Lets in the joint estimate of keyframes that is due with this frame, and hands over what is new.
    fn adjust(&mut self, sequence: u64, outcome: &mut StepOutcome) {
        let entered = self.adjustments.after_frame(&mut self.mapper, sequence);
        outcome.keyframe_changed |= entered.keyframe_changed;
        outcome.graph_changed |= entered.graph_changed;
        self.record.adjustments.extend(self.adjustments.take_records());
        self.record.searches.get_or_insert_default().extend(self.adjustments.take_searches());
    }

    /// The depth camera's image of a frame, where the first depth comes from it.
    fn sensor_depth(&self, read: SensorDepth) -> Result<Option<Image<f32>>, ReplayError> {
        if self.config.initial_depth == DepthOrigin::Images {
            return Ok(None);
        }
        let sensor_depth = match read {
            Err(error) if error.is_transient() && !self.config.strict => {
                tracing::warn!("left out: {error}");
                None
            }
            depth => depth?,
        };
        if sensor_depth.is_none() && self.record.counters.frames_in == 1 {
            return Err(ReplayError::NoSensorDepth(self.record.source.clone()));
        }
        Ok(sensor_depth)
    }

    /// Gives the tracker the mapper's keyframe, in the memory of the previous one.
    fn pass_keyframe_to_tracker(&mut self) {
        let Some(keyframe) = self.mapper.keyframe() else { return };
        let new = || Box::new(Reference::new(self.config.tracker.reference.clone()));
        let mut reference = self.spare.take().unwrap_or_else(new);
        reference.prepare_into(keyframe, self.tracker.scratch());
        let is_found = Tracker::is_found_on(reference.keyframe_id());
        let is_first = self.tracker.reference().is_none();
        self.spare = self.tracker.adopt(reference);
        if is_first && is_found {
            self.tracker.begin_lost();
        }
    }

    /// The frame's pose, estimated or given; `None` where ground truth has none for it.
    fn pose(&mut self, frame: &FrameView<'_>) -> Option<PoseEstimate> {
        let mut stamps = AlignmentStamps::begin();
        let (estimate, track_nanos) = match self.config.poses {
            PoseOrigin::Tracker => {
                let memory = self.tracker.memory().clone();
                let begin = Instant::now();
                let mut budget = |level| {
                    stamps.ask(level);
                    true
                };
                let estimate = self.tracker.track(frame, &mut budget);
                let track_nanos = elapsed_nanos(begin);
                self.rehearsal.observe(&mut self.tracker, &memory, frame);
                (estimate, Some(track_nanos))
            }
            PoseOrigin::GroundTruth => {
                let estimate = given_pose(
                    frame,
                    self.mapper.keyframe(),
                    &self.given_poses,
                    &self.config.tracker,
                );
                (estimate?, None)
            }
        };
        let trace = self.tracker.reference().and_then(|reference| stamps.trace(reference));
        self.record.poses.push(RecordedPose {
            estimate,
            latency_nanos: None,
            track_nanos,
            wake_nanos: None,
            trace,
        });
        Some(estimate)
    }

    fn count(&mut self, stamp: &FrameStamp) {
        self.record.counters.frames_in += 1;
        if self.stamps.is_none() && self.config.poses == PoseOrigin::GroundTruth {
            let truth = &self.record.ground_truth;
            self.given_poses = truth_in_first_camera(truth, stamp.capture_nanos);
        }
        let (first, last) = self.stamps.unwrap_or((*stamp, *stamp));
        let expected = last.sequence.saturating_add(1);
        self.record.counters.gaps += u64::from(self.stamps.is_some() && stamp.sequence > expected);
        self.stamps = Some((first, *stamp));
    }

    /// Leaves an image out: its place in the sequence stays empty, which is not a gap.
    fn skip_frame(&mut self) {
        if let Some((_, last)) = &mut self.stamps {
            last.sequence = last.sequence.saturating_add(1);
        }
    }

    /// The record, and whether the map was saved.
    fn finish(mut self, begin: Instant) -> Result<(RunRecord, Saved), ReplayError> {
        self.mapper.free_frames();
        self.adjustments.finish(&mut self.mapper);
        let saved = self.map.map_or(Ok(()), |mut map| map.save_all(&self.mapper, &mut || ()));
        let mut record = self.record;
        record.adjustments.extend(self.adjustments.take_records());
        record.searches.get_or_insert_default().extend(self.adjustments.take_searches());
        let Some((first, last)) = self.stamps else {
            return Err(ReplayError::Empty(record.source));
        };
        record.recorded_nanos =
            last.capture_nanos.saturating_sub(first.capture_nanos).max(0) as u64;
        let (samples, rehearsal_nanos) = self.rehearsal.into_samples();
        record.budget_samples = samples;
        record.wall_nanos = elapsed_nanos(begin).saturating_sub(rehearsal_nanos);
        record.map = self.mapper.into_map();
        record.counters.peak_rss_bytes = peak_rss_bytes().unwrap_or(0);
        Ok((record, saved))
    }
}
