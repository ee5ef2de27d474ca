//! The mapper process: pairs frames with their poses, adds them to the map, publishes it.

mod commands;
mod output;
pub(crate) mod used_map;

use std::panic::resume_unwind;
use std::rc::Rc;
use std::thread;
use std::time::Duration;

use crate::service::adjustments::{Adjustments, Entry};
use crate::service::checkpoint::Kept;
use crate::service::child::is_supervised;
use crate::service::clock::now_nanos;
use crate::service::config::Config;
use crate::service::frame_order::{FrameOrder, FrameOrderOutcome};
use crate::service::health::{Health, ProcessState};
use crate::service::map_folder::session::{MapSession, MapSessionError};
use crate::service::mapper::output::Output;
use crate::service::mapper::used_map::UsedMap;
use crate::service::mode::Mode;
use crate::service::pairing::Pairing;
use crate::service::peers::Peer;
use crate::service::run_error::RunError;
use crate::service::schedule::{Background, apply};
use crate::service::shutdown::Shutdown;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::loops::{SearchOutcome, SearchReport};
use crate::slam::map::Map;
use crate::slam::mapper::{Mapper, StepOutcome};
use crate::slam::pose::{NO_KEYFRAME, PoseEstimate};
use crate::wire::command::CommandServer;
use crate::wire::conversion::{code_from_map_state, frame_from_message, pose_from_message};
use crate::wire::message::{FrameHeader, PoseMessage};
use crate::wire::place::{Claim, Place};
use crate::wire::port::{Access, Hub, ReceiveError, Received, SendError, Subscriber, wait};
use crate::wire::topic::{CAPTURE_HEALTH, FRAME, MAPPER_HEALTH, POSE};

/// Longest sleep between two checks of signals and health.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Pause between two signs of life while a map is read.
const LOADING_PAUSE: Duration = Duration::from_millis(20);
/// Cause that a mapper reports before it writes its map, which may take long.
pub const WRITES_MAP: &str = "the map is being written";

/// Runs the process until a signal arrives.
pub fn run(config: &Config, mode: Mode, shutdown: &Shutdown) -> Result<(), RunError> {
    // Before the pool is made: its threads inherit the CPUs of this one.
    let refusals = apply(&config.mapper.scheduling);
    refusals.iter().for_each(|refusal| tracing::warn!("mapper: {refusal}"));
    let mut shell = Shell::prepare(config, mode)?;
    shell.health.report_scheduling(&refusals);
    shell.load_map()?;
    shell.health.enter(ProcessState::Ready, "");
    shell.health.notify_ready();
    let outcome = shell.map_until(shutdown);
    let outcome = outcome.and_then(|()| shell.save_map_folder());
    // A supervisor that did not request the end starts another mapper, which continues from the checkpoint. So does a
    // mapper that is restarted alone: the tracker still holds this map's numbers.
    if outcome.is_ok() && !is_supervised() && !shell.place.is_running("tracker") {
        shell.kept.iter_mut().for_each(|kept| kept.remove_on_drop());
        UsedMap::forget(&shell.place.loaded_map_path());
    }
    shell.health.end(&outcome, "stopped");
    outcome
}

type Frame = Received<u8, FrameHeader>;

struct Shell<'a> {
    config: &'a Config,
    mode: Mode,
    frames: Subscriber<u8, FrameHeader>,
    poses: Subscriber<PoseMessage, ()>,
    pairing: Pairing<Frame>,
    order: FrameOrder,
    /// Frames that did not arrive.
    missing: u64,
    /// CLOCK_MONOTONIC of the arrival of the last frame.
    last_arrival_nanos: Option<i64>,
    commands: Rc<CommandServer>,
    output: Output,
    health: Health,
    capture: Peer,
    mapper: Option<(Intrinsics, Mapper)>,
    adjustments: Adjustments,
    /// Live: the checkpoint for a successor.
    kept: Option<Kept>,
    /// The checkpoint of a mapper that died, until the first frame.
    left: Option<Map>,
    /// The map on disk, as it is named to a successor.
    used: UsedMap,
    /// The map on disk.
    map: Option<MapSession>,
    /// The last claimed pose.
    last_pose: Option<PoseEstimate>,
    pool: rayon::ThreadPool,
    hub: Hub,
    place: Place,
    _claim: Claim,
}

impl<'a> Shell<'a> {
    fn prepare(config: &'a Config, mode: Mode) -> Result<Self, RunError> {
        let place = Place::new(&config.instance, &config.root)?;
        let claim = place.claim("mapper")?;
        let hub = Hub::join(&place, "mapper", Access::Member)?;
        let (kept, left, used) = match mode {
            // A lockstep run ends with any of its processes.
            Mode::Lockstep => (None, None, UsedMap::of(&config.map)),
            Mode::Live => used_map::open_checkpoint(&place, &config.map),
        };
        let threads = config.mapper.threads;
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("semidense-map-{index}"))
            .build()
            .map_err(|e| RunError::Pool { threads, reason: e.to_string() })?;
        let shell = Self {
            config,
            mode,
            frames: hub.subscriber(&FRAME)?,
            poses: hub.subscriber(&POSE)?,
            // One fewer than may be borrowed: the next frame is received before the oldest is released.
            pairing: Pairing::new(FRAME.borrowed - 1),
            order: FrameOrder::default(),
            missing: 0,
            last_arrival_nanos: None,
            commands: Rc::new(CommandServer::open(&hub)?),
            output: Output::open(&hub)?,
            health: Health::open(&hub, &MAPPER_HEALTH)?,
            capture: Peer::open(&hub, &CAPTURE_HEALTH)?,
            mapper: None,
            adjustments: start_adjustments(config, mode)?,
            kept,
            left,
            used,
            map: None,
            last_pose: None,
            pool,
            hub,
            place,
            _claim: claim,
        };
        shell.hub.reserve()?;
        Ok(shell)
    }

    /// Reads the map on disk, if one is named, while signs of life continue.
    fn load_map(&mut self) -> Result<(), RunError> {
        let map = self.used.switched_to.as_ref().unwrap_or(&self.config.map).clone();
        if map.folder.is_empty() {
            return Ok(());
        }
        self.health.enter(ProcessState::Preparing, &format!("loading the map {}", map.folder));
        let (max_bytes, numbering) = (self.config.mapping.max_map_bytes(), self.used.numbering);
        let waits = self.mode == Mode::Lockstep;
        let open = || MapSession::open(&map, max_bytes, numbering, waits);
        let session = report_while(&mut self.health, &self.pool, open)
            .unwrap_or_else(|panic| resume_unwind(panic));
        self.map = session.map_err(MapSessionError::from)?;
        Ok(())
    }

    /// Writes what the map on disk lacks.
    fn save_map_folder(&mut self) -> Result<(), RunError> {
        let (Some(map), Some((_, mapper))) = (&mut self.map, &self.mapper) else { return Ok(()) };
        let health = &mut self.health;
        Ok(map.save_all(mapper, &mut || health.report())?)
    }

    fn map_until(&mut self, shutdown: &Shutdown) -> Result<(), RunError> {
        while !shutdown.is_requested() {
            let events = [self.frames.events(), self.poses.events(), self.commands.events()];
            let adjusted = self.adjustments.descriptor();
            wait(&events, adjusted.into_iter().chain([shutdown.descriptor()]), WAKE_PERIOD)?;
            self.output.serve_late_joiners();
            self.pick_up_adjustment()?;
            while let Some((frame, pose)) = self.next_pair()? {
                self.step(&frame, &pose)?;
                // A map that lags behind has no pause between its steps.
                self.answer_commands()?;
                self.output.serve_late_joiners();
                if shutdown.is_requested() {
                    return Ok(());
                }
            }
            self.answer_commands()?;
            self.check_for_silence()?;
            self.health.report();
        }
        Ok(())
    }

    /// The oldest frame with its pose, among those still held.
    fn next_pair(&mut self) -> Result<Option<(Frame, PoseEstimate)>, RunError> {
        while let Some(frame) = self.frames.receive()? {
            self.hold_frame(frame);
        }
        while let Some(message) = self.poses.receive()? {
            match message.payload().first().map(pose_from_message) {
                Some(Ok(pose)) => self.pairing.push_pose(pose),
                Some(Err(error)) => {
                    self.health.counters().refused += 1;
                    tracing::warn!("tracker/pose: {error}");
                }
                None => self.health.counters().refused += 1,
            }
        }
        Ok(self.pairing.take())
    }

    /// Holds a valid frame that arrives in order until its pose arrives; counts invalid and missing frames.
    fn hold_frame(&mut self, frame: Frame) {
        let header = *frame.header();
        if let Err(error) = frame_from_message(&header, frame.payload()) {
            self.health.counters().refused += 1;
            tracing::warn!("capture/frame: {error}");
            return;
        }
        self.last_arrival_nanos = Some(now_nanos());
        let arrival = self.order.arrive(&header);
        if let FrameOrderOutcome::Next { missing } = arrival {
            self.missing = self.missing.saturating_add(missing);
        } else {
            self.health.counters().disordered += 1;
        }
        if arrival == FrameOrderOutcome::Renumbered {
            self.pairing.restart();
        }
        if arrival != FrameOrderOutcome::Repeated {
            self.pairing.push_frame(header.sequence, frame);
        }
    }

    /// Live: reports when frames have stopped. The next step ends the state.
    fn check_for_silence(&mut self) -> Result<(), ReceiveError> {
        // Its last message is received only by those that have listened before it ends.
        let (state, cause) = self.capture.state_in_silence()?;
        if self.capture.state() == Some(ProcessState::Finished) {
            self.order.end();
        }
        let periods = self.config.tracker.stale_periods;
        if self.mode == Mode::Live && self.order.is_silent(self.last_arrival_nanos, periods) {
            self.health.enter(state, cause);
        }
        Ok(())
    }

    /// Adds one frame to the map and publishes what changed.
    fn step(&mut self, received: &Frame, pose: &PoseEstimate) -> Result<(), RunError> {
        // Checked on arrival.
        let Ok((frame, intrinsics)) = frame_from_message(received.header(), received.payload())
        else {
            return Ok(());
        };
        if !self.ensure_mapper(intrinsics)? {
            return Ok(());
        }
        let Some((_, mapper)) = &mut self.mapper else { return Ok(()) };
        let _span = tracing::trace_span!("frame", sequence = frame.sequence).entered();
        let begin = now_nanos();
        let mut change = None;
        let mut change_begins = || change = Some(now_nanos());
        let outcome = tracing::trace_span!("map")
            .in_scope(|| self.pool.install(|| mapper.step(&frame, pose, None, &mut change_begins)));
        if pose.state.is_tracked() {
            self.last_pose = Some(*pose);
        }
        if let (Some(kept), Some(_)) = (&mut self.kept, mapper.keyframe()) {
            kept.reserve();
        }
        tracing::trace_span!("publish").in_scope(|| self.output.publish(mapper, &outcome))?;
        let change_nanos = change.filter(|_| outcome.keyframe_created).map_or(0, nanos_since);
        // The tracker has the keyframe; the rest reaches it as another revision.
        let finished = tracing::trace_span!("finish_keyframe")
            .in_scope(|| self.pool.install(|| mapper.finish_keyframe()));
        let step_nanos = nanos_since(begin);
        let _span = tracing::trace_span!("publish").entered();
        self.output.publish(mapper, &finished)?;
        let adjusted = self.adjustments.after_frame(mapper, frame.sequence);
        self.output.publish(mapper, &adjusted)?;
        publish_adjustments(&mut self.adjustments, &self.output, &mut self.health)?;
        let durations = [step_nanos, change_nanos];
        self.output.publish_step(mapper, frame.sequence, durations, self.last_pose.as_ref())?;
        self.follow(&[&outcome, &adjusted]);
        if let Some(failure) = self.map.as_mut().and_then(MapSession::take_failure) {
            self.health.warn(&failure);
        }
        self.report_step(step_nanos);
        Ok(())
    }

    /// Whether there is a mapper for frames of this camera; makes one where the camera has changed.
    fn ensure_mapper(&mut self, intrinsics: Intrinsics) -> Result<bool, RunError> {
        if self.mapper.as_ref().is_some_and(|(of, _)| *of == intrinsics) {
            return Ok(true);
        }
        match self.change_camera(intrinsics) {
            Err(RunError::Parameter(_, error)) => {
                // The configuration was checked at the start, so the image is too small.
                self.health.counters().refused += 1;
                self.health.enter(ProcessState::Running, &error.to_string());
                Ok(false)
            }
            changed => changed.map(|()| true),
        }
    }

    /// Writes changes of the map to the checkpoint and to the map on disk.
    fn follow(&mut self, outcomes: &[&StepOutcome]) {
        let Some((_, mapper)) = &mut self.mapper else { return };
        if let Some(kept) = &mut self.kept {
            outcomes.iter().for_each(|outcome| kept.follow(mapper, outcome));
        }
        if let Some(map) = &mut self.map {
            outcomes.iter().for_each(|outcome| map.follow(mapper, outcome));
        }
    }

    /// Reports the contents of the map after a step, and the duration of the step.
    fn report_step(&mut self, step_nanos: u64) {
        let Some((_, mapper)) = &self.mapper else { return };
        let counters = self.health.counters();
        counters.frames += 1;
        counters.dropped = self.missing.saturating_add(self.pairing.dropped());
        counters.total = mapper.map().num_with_depth() as u64;
        counters.detail = mapper.keyframe().map_or(0, |k| code_from_map_state(k.map_state));
        self.health.count_work(step_nanos);
        self.health.count_latency(step_nanos);
        // A report sent at once includes the step.
        self.health.enter(ProcessState::Running, &mapper.situation().to_string());
        self.health.report();
    }

    /// Live: lets a finished joint estimate into the map and publishes it, although no frame arrives.
    fn pick_up_adjustment(&mut self) -> Result<(), RunError> {
        let Some((_, mapper)) = &mut self.mapper else { return Ok(()) };
        let outcome = self.adjustments.apply_ready(mapper);
        self.output.publish(mapper, &outcome)?;
        self.follow(&[&outcome]);
        publish_adjustments(&mut self.adjustments, &self.output, &mut self.health)?;
        Ok(())
    }

    /// Makes a mapper for another camera: the first, which continues from what a dead one left, or one in mid-stream,
    /// which begins an epoch.
    fn change_camera(&mut self, intrinsics: Intrinsics) -> Result<(), RunError> {
        let mut mapper = Mapper::new(intrinsics, self.config.mapping.clone())
            .map_err(|error| RunError::Parameter("mapping", error))?;
        self.output.open_images(&self.hub, &intrinsics)?;
        let unsaved = self.save_map_folder().err();
        if let Some((_, before)) = self.mapper.take() {
            self.health.counters().resized += 1;
            mapper.continue_from(before);
            self.adjustments.abandon();
            if self.map.take().is_some() {
                let unsaved = unsaved
                    .map(|error| format!(", which lacks the last ones of the other: {error}"));
                self.health.warn(&format!(
                    "the camera has changed: frames of the new one are not added to the map on disk{}",
                    unsaved.unwrap_or_default()
                ));
            }
        }
        let left = self.left.take();
        if left.is_some() {
            self.kept.iter_mut().for_each(Kept::reserve);
        }
        let resumed = match (left, &mut self.map) {
            (left, Some(map)) => map.begin(&mut mapper, &intrinsics, left)?,
            (Some(left), None) => mapper.resume(left),
            (None, None) => StepOutcome::default(),
        };
        self.output.publish(&mapper, &resumed)?;
        self.mapper = Some((intrinsics, mapper));
        Ok(())
    }
}

/// Does something slow in the pool while signs of life continue; an error is its panic.
fn report_while<T: Send>(
    health: &mut Health,
    pool: &rayon::ThreadPool,
    slow: impl FnOnce() -> T + Send,
) -> thread::Result<T> {
    thread::scope(|scope| {
        let running = scope.spawn(|| pool.install(slow));
        while !running.is_finished() {
            health.report();
            thread::sleep(LOADING_PAUSE);
        }
        running.join()
    })
}

/// Publishes and counts finished joint estimates; reports when there will be no more.
fn publish_adjustments(
    adjustments: &mut Adjustments,
    output: &Output,
    health: &mut Health,
) -> Result<(), SendError> {
    for record in adjustments.take_records() {
        health.count_adjustment(&record);
        output.publish_adjustment(&record)?;
    }
    for search in adjustments.take_searches() {
        health.count_search(&search.report.outcome);
        log_search(&search.report);
    }
    adjustments.take_failure().iter().for_each(|failure| health.warn(failure));
    Ok(())
}

/// Logs closed loops and joined epochs.
fn log_search(report: &SearchReport) {
    let (keyframe, other) = (report.keyframe_id, report.other.unwrap_or(NO_KEYFRAME));
    match report.outcome {
        SearchOutcome::Closed => {
            tracing::info!("loop closed: keyframe {keyframe} matches {other}; map corrected")
        }
        SearchOutcome::Joined => {
            tracing::info!("epochs joined: keyframe {keyframe} matches {other}")
        }
        _ => {}
    }
}

/// Starts the joint estimation of keyframes as the mode requires.
fn start_adjustments(config: &Config, mode: Mode) -> Result<Adjustments, RunError> {
    let delay = Entry::AfterFrames(config.mapping.window.delay_frames as u64);
    let started = match mode {
        // Frames wait for it.
        Mode::Lockstep => Adjustments::start(delay, Background::Other),
        Mode::Live => Adjustments::start(Entry::WhenReady, config.mapper.background),
    };
    started.map_err(|error| RunError::Thread("estimates keyframes jointly", error))
}

/// Nanoseconds since an instant of CLOCK_MONOTONIC.
fn nanos_since(begin: i64) -> u64 {
    u64::try_from(now_nanos() - begin).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_that_takes_long_to_read_leaves_the_mapper_alive() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "mapper", Access::Member).unwrap();
        let mut health = Health::open(&hub, &MAPPER_HEALTH).unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        // Reads until its reader has heard of it, which is to be long before this ends.
        let read = || {
            let hub = Hub::join(&place, "reader", Access::Observer).unwrap();
            let mut mapper = Peer::open(&hub, &MAPPER_HEALTH).unwrap();
            (0..1000).any(|_| {
                thread::sleep(Duration::from_millis(10));
                mapper.update().unwrap().is_some()
            })
        };
        assert!(report_while(&mut health, &pool, read).unwrap(), "no sign of life");
    }
}
