//! The capture process: frames from the source straight into shared memory, at their pace.

use std::path::PathBuf;
use std::time::Duration;

use crate::capture::mask::Mask;
use crate::capture::opening::{check_size, open, rig_remarks};
use crate::capture::source::{Arrival, FrameSource, FrameStamp};
use crate::capture::source_error::SourceError;
use crate::capture::source_name::SourceName;
use crate::service::child::{is_supervised, prepared_frames};
use crate::service::clock::{Pace, duration_from_nanos, now_nanos, realtime_of};
use crate::service::config::Config;
use crate::service::corrected::Corrected;
use crate::service::health::{Health, ProcessState};
use crate::service::mode::Mode;
use crate::service::peers::Peer;
use crate::service::position::{Position, PositionRecorder, Predecessor};
use crate::service::refused_images::RefusedImages;
use crate::service::run_error::RunError;
use crate::service::schedule::apply;
use crate::service::shutdown::Shutdown;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::wire::message::{FrameHeader, HealthMessage, PoseMessage, StepMessage};
use crate::wire::place::{Claim, Place};
use crate::wire::port::{Access, Hub, Publisher, Subscriber, wait};
use crate::wire::topic::{
    CAPTURE_HEALTH, FRAME, MAPPER_HEALTH, POSE, STEP, TRACKER_HEALTH, shared_memory_bytes,
};

/// Longest sleep between two checks of signals and health.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Longest wait for the last pose of a tracker that already runs: it serves late subscribers ten times a second.
const LAST_POSE_NANOS: i64 = 250_000_000;
/// Pause between two checks for it.
const LAST_POSE_PAUSE: Duration = Duration::from_millis(10);

/// What to capture and how.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureOptions {
    /// Where frames come from.
    pub source: SourceName,
    /// The camera's rig file.
    pub rig: Option<PathBuf>,
    /// The camera's mask.
    pub mask: Option<PathBuf>,
    /// Lockstep or live.
    pub mode: Mode,
}

/// Runs the process until the source ends or a signal arrives.
pub fn run(config: &Config, options: &CaptureOptions, shutdown: &Shutdown) -> Result<(), RunError> {
    let mut shell = Shell::prepare(config, options, shutdown)?;
    let outcome = shell.prepare_source().and_then(|()| {
        // After the preparation: rendering a simulated world has no deadline.
        let refusals = apply(&config.capture.scheduling);
        refusals.iter().for_each(|refusal| tracing::warn!("capture: {refusal}"));
        shell.health.report_scheduling(&refusals);
        shell.health.notify_ready();
        shell.stream()
    });
    // A supervisor that did not request the end starts another capture, which continues from here.
    let is_asked = matches!(outcome, Err(RunError::Interrupted)) && !is_supervised();
    if outcome.is_ok() || is_asked {
        shell.position.remove_on_drop();
    }
    let left_out = shell.refused.text();
    shell.health.end(&outcome, left_out.as_deref().unwrap_or("the source has ended"));
    outcome
}

/// Result of sending the next frame.
enum Sent {
    /// It was sent, with this sequence.
    Frame(u64),
    /// It is no newer than the last one of the previous capture.
    Repeated,
    /// It was damaged.
    Damaged,
    /// No frame is left.
    End,
}

struct Shell<'a> {
    config: &'a Config,
    mode: Mode,
    shutdown: &'a Shutdown,
    source: Corrected<Box<dyn FrameSource>>,
    intrinsics: Intrinsics,
    frames: Publisher<u8, FrameHeader>,
    steps: Subscriber<StepMessage, ()>,
    /// Live: the position in the source, for a successor; capture works without the file too.
    position: PositionRecorder,
    /// Where a capture of the same run died.
    left: Option<Position>,
    /// Until the first frame, where no earlier capture is on record: the poses of a tracker that already runs.
    poses: Option<Subscriber<PoseMessage, ()>>,
    peers: [Peer; 2],
    health: Health,
    pace: Option<Pace>,
    /// Why the camera is absent, while it is.
    absence: Option<String>,
    /// Since when (CLOCK_MONOTONIC) a camera has delivered only damaged frames, and what is wrong with the first.
    damaged: Option<(i64, String)>,
    /// Images of a recording that could not be used.
    refused: RefusedImages,
    /// First sequence of a camera's frames.
    first_sequence: u64,
    /// Frames no newer than the last one of the previous capture are not sent.
    predecessor: Predecessor,
    next_sequence: Option<u64>,
    /// Gaps between the last frame of the previous capture and the first of this one.
    gaps_before: u64,
    _claim: Claim,
}

impl<'a> Shell<'a> {
    fn prepare(
        config: &'a Config,
        options: &CaptureOptions,
        shutdown: &'a Shutdown,
    ) -> Result<Self, RunError> {
        if options.source.is_camera() && options.mode == Mode::Lockstep {
            let reason = "a camera does not wait for the map; leave out --lockstep".to_owned();
            return Err(SourceError::Camera { name: options.source.to_string(), reason }.into());
        }
        let rig = options.rig.as_deref();
        let source = open(&options.source, rig, &config.source_params())?;
        let read_mask = |path: &PathBuf| Mask::read(path, source.as_ref());
        let mask = options.mask.as_ref().map(read_mask).transpose()?;
        let source = Corrected::new(source, &config.capture.corrections(), mask);
        for remark in rig_remarks(&options.source, rig) {
            tracing::warn!("{remark}");
        }
        let intrinsics = source.intrinsics();
        if !intrinsics.is_valid() {
            return Err(RunError::Intrinsics(options.source.clone()));
        }
        check_size(&options.source.to_string(), &intrinsics)?;
        let place = Place::new(&config.instance, &config.root)?;
        let claim = place.claim("capture")?;
        place.check_shared_memory(shared_memory_bytes(&intrinsics, Some("capture")))?;
        let hub = Hub::join(&place, "capture", Access::Member)?;
        let (source_name, path) = (options.source.to_string(), place.position_path());
        let (position, left) = PositionRecorder::of_run(&path, options.mode, &source_name, rig);
        // A supervisor keeps track of earlier captures; without one the tracker is queried too. It does not know of
        // which recording its last frame was.
        let is_camera = options.source.is_camera();
        let asks_tracker =
            is_camera && options.mode == Mode::Live && left.is_none() && !is_supervised();
        let mut health = Health::open(&hub, &CAPTURE_HEALTH)?;
        health.set_source(&options.source.to_string());
        health.counters().total = source.num_frames().unwrap_or(0) as u64;
        let shell = Self {
            config,
            mode: options.mode,
            shutdown,
            frames: hub.publisher(&FRAME, intrinsics.width * intrinsics.height)?,
            steps: hub.subscriber(&STEP)?,
            position,
            left,
            poses: asks_tracker.then(|| hub.subscriber(&POSE)).transpose()?,
            peers: [Peer::open(&hub, &TRACKER_HEALTH)?, Peer::open(&hub, &MAPPER_HEALTH)?],
            source,
            intrinsics,
            health,
            pace: None,
            absence: None,
            damaged: None,
            refused: RefusedImages::default(),
            first_sequence: 0,
            predecessor: Predecessor::default(),
            next_sequence: None,
            gaps_before: 0,
            _claim: claim,
        };
        hub.reserve()?;
        Ok(shell)
    }

    /// Whether frames come from a recording, which can wait for its subscribers.
    fn is_recorded(&self) -> bool {
        self.source.num_frames().is_some()
    }

    /// Does everything that must finish before the first frame: rendering, and waiting for tracker and mapper.
    fn prepare_source(&mut self) -> Result<(), RunError> {
        self.health.enter(ProcessState::Preparing, "");
        if let Some(file) = prepared_frames()
            && let Err(error) = self.source.keep_prepared_in(file)
        {
            tracing::warn!(
                "capture: after a restart the source would have to be prepared again ({error})"
            );
        }
        let (health, shutdown) = (&mut self.health, self.shutdown);
        self.source.prepare(&mut |done, total| {
            health.progress(done, total);
            !shutdown.is_requested()
        })?;
        self.continue_from_predecessor()?;
        self.health.enter(ProcessState::Ready, "");
        if !self.is_recorded() {
            return Ok(());
        }
        let seconds = self.config.capture.connect_timeout_s;
        let deadline = now_nanos().saturating_add((seconds * 1e9) as i64);
        loop {
            for peer in &mut self.peers {
                peer.update()?;
            }
            let Some(missing) = self.peers.iter().find(|peer| !peer.is_ready()) else {
                return Ok(());
            };
            if now_nanos() > deadline {
                return Err(RunError::NotReady { process: missing.name(), seconds });
            }
            self.pause(Duration::from_millis(10))?;
        }
    }

    /// Continues after another capture that died: a recording after its last frame, a camera's numbers after its last
    /// number. Neither sequences nor stamps go back.
    fn continue_from_predecessor(&mut self) -> Result<(), RunError> {
        if let Some(left) = self.left {
            self.predecessor.last_nanos = Some(left.capture_nanos);
            return self.continue_behind(left.sequence);
        }
        let Some(poses) = self.poses.take() else { return Ok(()) };
        let deadline = now_nanos().saturating_add(LAST_POSE_NANOS);
        while now_nanos() < deadline {
            let newest = poses.newest()?;
            if let Some(pose) = newest.as_ref().and_then(|message| message.payload().first()) {
                return self.continue_behind(pose.sequence);
            }
            self.pause(LAST_POSE_PAUSE)?;
        }
        Ok(())
    }

    fn continue_behind(&mut self, sequence: u64) -> Result<(), RunError> {
        if self.is_recorded() {
            self.source.skip_to(sequence)?;
        } else {
            self.first_sequence = sequence.saturating_add(1);
            // What the camera saw in between is a gap of unknown length.
            self.gaps_before = 1;
        }
        Ok(())
    }

    /// Sends frame after frame.
    fn stream(&mut self) -> Result<(), RunError> {
        loop {
            if self.await_frame()? {
                match self.send_next()? {
                    Sent::Frame(sequence) => {
                        self.accept();
                        if self.mode == Mode::Lockstep {
                            self.await_step(sequence)?;
                        }
                    }
                    Sent::Repeated => self.accept(),
                    Sent::Damaged => {}
                    Sent::End => return Ok(()),
                }
            }
            self.count_losses();
            self.health.report();
        }
    }

    /// Waits briefly for the next frame; returns whether it has arrived. An absent camera is a state.
    fn await_frame(&mut self) -> Result<bool, RunError> {
        let millis = WAKE_PERIOD.as_millis() as u32;
        let arrival = self.source.await_frame(self.shutdown.descriptor(), millis)?;
        while let Some(notice) = self.source.take_notice() {
            match notice.is_warning {
                true => tracing::warn!("capture: {}", notice.text),
                false => tracing::info!("capture: {}", notice.text),
            }
        }
        if self.shutdown.is_requested() {
            return Err(RunError::Interrupted);
        }
        if let Arrival::Absent(reason) = arrival {
            self.damaged = None;
            self.report_absence(reason);
            return Ok(false);
        }
        Ok(arrival == Arrival::Frame)
    }

    fn report_absence(&mut self, reason: String) {
        self.health.enter(ProcessState::Stale, &reason);
        if self.absence.as_ref() != Some(&reason) {
            // A supervisor prints it itself.
            if !is_supervised() {
                tracing::warn!("capture: {reason}");
            }
            self.absence = Some(reason);
        }
    }

    /// Notes a usable frame.
    fn accept(&mut self) {
        let is_first = self.refused.accept();
        self.damaged = None;
        match self.absence.take().map(|_| is_first) {
            Some(true) => tracing::info!("capture: frames are arriving"),
            Some(false) => tracing::warn!("capture: frames are arriving again"),
            None => {}
        }
        self.health.enter(ProcessState::Running, &self.refused.text().unwrap_or_default());
    }

    /// Copies a camera's losses into the health.
    fn count_losses(&mut self) {
        if let Some(losses) = self.source.losses() {
            let counters = self.health.counters();
            counters.gaps = losses.missing.saturating_add(self.gaps_before);
            counters.dropped = losses.late;
            counters.refused = losses.broken;
        }
    }

    /// Reads the next frame into shared memory and sends it when due.
    fn send_next(&mut self) -> Result<Sent, RunError> {
        let _span = tracing::trace_span!("frame").entered();
        let mut loan = self.frames.loan(self.intrinsics.width * self.intrinsics.height)?;
        let mut stamp = match self.source.next_into(loan.bytes_mut()) {
            Ok(Some(stamp)) => stamp,
            Ok(None) => {
                return self.refused.error().map_or(Ok(Sent::End), |error| Err(error.into()));
            }
            Err(error) if error.is_transient() && !self.ends_at(&error) => {
                self.refuse(&error);
                return Ok(Sent::Damaged);
            }
            Err(error) => return Err(error.into()),
        };
        stamp.sequence = stamp.sequence.saturating_add(self.first_sequence);
        if self.predecessor.is_ahead_of(&stamp) {
            self.health.counters().disordered += 1;
            return Ok(Sent::Repeated);
        }
        if self.shutdown.is_requested() {
            return Err(RunError::Interrupted);
        }
        let clock_nanos = match self.mode {
            Mode::Live if stamp.clocks.is_some() => {
                stamp.clocks.map_or(0, |clocks| clocks.clock_nanos)
            }
            // A driver's stamp may lie in the future; no latency is negative.
            Mode::Live if !self.is_recorded() => stamp.capture_nanos.min(now_nanos()),
            Mode::Live => {
                let (stamp, now) = (stamp.capture_nanos, now_nanos());
                let due = self.pace.get_or_insert(Pace::start(stamp, now)).due_nanos(stamp, now);
                wait_until(due, self.shutdown, &mut self.health)?;
                due
            }
            Mode::Lockstep => now_nanos(),
        };
        let _span = tracing::trace_span!("publish", sequence = stamp.sequence).entered();
        count(self.health.counters(), &mut self.next_sequence, &stamp);
        self.health.counters().detail = self.source.max_factor().map_or(0, u32::from);
        // Before sending: a frame lost between the two is better than one sent twice.
        let counters = self.health.counters();
        self.position.write_or_warn(&Position::at(&stamp, counters.frames, counters.gaps));
        let header = self.header(&stamp, clock_nanos);
        if self.mode == Mode::Live {
            // A deadline counts from the arrival: lateness before that is recorded here.
            self.health.count_latency(header.sent_nanos.saturating_sub(clock_nanos).max(0) as u64);
        }
        loan.send(header)?;
        Ok(Sent::Frame(stamp.sequence))
    }

    /// Whether an unusable frame ends the run; a camera's never does.
    fn ends_at(&self, error: &SourceError) -> bool {
        self.config.capture.strict && matches!(error, SourceError::Image(_))
    }

    /// Leaves a frame out: a camera counts its own, those of a recording are also named. A camera that delivers nothing
    /// else is as good as absent.
    fn refuse(&mut self, error: &SourceError) {
        if !self.is_recorded() {
            tracing::debug!("{error}");
            let (since, first) =
                self.damaged.get_or_insert_with(|| (now_nanos(), error.to_string()));
            let damaged_s = now_nanos().saturating_sub(*since) as f64 * 1e-9;
            if damaged_s >= self.config.capture.camera.stall_s {
                let reason = format!("every frame is damaged: {first}");
                self.report_absence(reason);
            }
            return;
        }
        self.refused.refuse(error);
        self.health.enter(ProcessState::Running, &self.refused.text().unwrap_or_default());
        self.health.counters().refused = self.refused.count();
        // Its place in the sequence stays empty, which is not a gap: the next expected number skips it.
        self.next_sequence = self.next_sequence.map(|next| next.saturating_add(1));
    }

    fn header(&self, stamp: &FrameStamp, clock_nanos: i64) -> FrameHeader {
        let k = &self.intrinsics;
        FrameHeader {
            sequence: stamp.sequence,
            capture_nanos: stamp.capture_nanos,
            clock_nanos,
            realtime_nanos: stamp
                .clocks
                .map_or_else(|| realtime_of(clock_nanos), |clocks| clocks.realtime_nanos),
            sent_nanos: now_nanos(),
            exposure_nanos: stamp.exposure_nanos,
            intrinsics: [k.fx, k.fy, k.cx, k.cy],
            width: k.width as u32,
            height: k.height as u32,
            stride: k.width as u32,
            gain: stamp.gain,
        }
    }

    /// Lockstep: waits until the frame is in the map.
    fn await_step(&mut self, sequence: u64) -> Result<(), RunError> {
        let seconds = self.config.capture.step_timeout_s;
        let deadline = now_nanos().saturating_add((seconds * 1e9) as i64);
        loop {
            while let Some(step) = self.steps.receive()? {
                if step.payload().first().is_some_and(|step| step.sequence == sequence) {
                    return Ok(());
                }
            }
            if now_nanos() > deadline {
                return Err(RunError::NoStep { sequence, seconds });
            }
            self.pause(WAKE_PERIOD)?;
        }
    }

    /// Sleeps until a step, a signal or the end of `period`.
    fn pause(&mut self, period: Duration) -> Result<(), RunError> {
        wait(&[self.steps.events()], Some(self.shutdown.descriptor()), period)?;
        self.frames.serve_late_joiners();
        self.health.report();
        if self.shutdown.is_requested() { Err(RunError::Interrupted) } else { Ok(()) }
    }
}

fn count(counters: &mut HealthMessage, next_sequence: &mut Option<u64>, stamp: &FrameStamp) {
    counters.frames += 1;
    counters.gaps += u64::from(next_sequence.is_some_and(|next| next != stamp.sequence));
    *next_sequence = Some(stamp.sequence.saturating_add(1));
}

/// Sleeps until `due_nanos`.
fn wait_until(due_nanos: i64, shutdown: &Shutdown, health: &mut Health) -> Result<(), RunError> {
    loop {
        let left = duration_from_nanos(due_nanos - now_nanos());
        if shutdown.is_requested() {
            return Err(RunError::Interrupted);
        }
        if left.is_zero() {
            return Ok(());
        }
        wait(&[], Some(shutdown.descriptor()), left.min(WAKE_PERIOD))?;
        health.report();
    }
}
