//! The tracker process: waits for frames, adopts keyframes, publishes one pose per frame.

use std::time::Duration;

use crate::service::budget::IterationCosts;
use crate::service::clock::now_nanos;
use crate::service::config::Config;
use crate::service::early_wake::EarlyWake;
use crate::service::frame_order::{FrameOrder, FrameOrderOutcome};
use crate::service::health::{Health, ProcessState};
use crate::service::mode::Mode;
use crate::service::peers::Peer;
use crate::service::reference_feed::ReferenceFeed;
use crate::service::run_error::RunError;
use crate::service::schedule::{apply, thread_page_faults};
use crate::service::shutdown::Shutdown;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::pose::{
    DegradedReason, LostReason, PoseEstimate, TrackingState, UNKNOWN_VARIANCE,
};
use crate::slam::tracker::Tracker;
use crate::wire::conversion::{
    PoseTiming, codes_from_state, frame_from_message, pose_from_message, pose_message,
};
use crate::wire::message::{FrameHeader, PoseMessage};
use crate::wire::place::{Claim, Place};
use crate::wire::port::{Access, Hub, Publisher, ReceiveError, Received, Subscriber, wait};
use crate::wire::topic::{CAPTURE_HEALTH, FRAME, POSE, TRACKER_HEALTH};

/// Longest sleep between two checks of signals and health.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Frames until the loop has touched everything it uses: page faults count from here.
const WARM_UP_FRAMES: u64 = 100;

/// Runs the process until a signal arrives.
pub fn run(config: &Config, mode: Mode, shutdown: &Shutdown) -> Result<(), RunError> {
    let mut shell = Shell::prepare(config, mode)?;
    // After the thread that prepares keyframes was made, which keeps ordinary scheduling.
    let refusals = apply(&config.tracker.scheduling);
    refusals.iter().for_each(|refusal| tracing::warn!("tracker: {refusal}"));
    shell.health.report_scheduling(&refusals);
    shell.health.enter(ProcessState::Ready, "");
    shell.health.notify_ready();
    let outcome = shell.track_until(shutdown);
    shell.health.end(&outcome, "stopped");
    outcome
}

struct Shell<'a> {
    config: &'a Config,
    mode: Mode,
    frames: Subscriber<u8, FrameHeader>,
    poses: Publisher<PoseMessage, ()>,
    references: ReferenceFeed,
    health: Health,
    capture: Peer,
    tracker: Option<(Intrinsics, Tracker)>,
    last_intrinsics: Option<Intrinsics>,
    costs: IterationCosts,
    order: FrameOrder,
    /// CLOCK_MONOTONIC of the arrival of the last frame.
    last_arrival_nanos: Option<i64>,
    early_wake: EarlyWake,
    /// Page faults of this thread until the loop was warm.
    warm_page_faults: Option<u64>,
    hub: Hub,
    _claim: Claim,
}

impl<'a> Shell<'a> {
    fn prepare(config: &'a Config, mode: Mode) -> Result<Self, RunError> {
        let place = Place::new(&config.instance, &config.root)?;
        let claim = place.claim("tracker")?;
        let hub = Hub::join(&place, "tracker", Access::Member)?;
        let params = &config.tracking.reference;
        let references = match mode {
            Mode::Lockstep => ReferenceFeed::synchronous(&hub, params)?,
            Mode::Live => ReferenceFeed::threaded(&place, params)
                .map_err(|error| RunError::Thread("prepares keyframes", error))?,
        };
        let shell = Self {
            config,
            mode,
            frames: hub.subscriber(&FRAME)?,
            poses: hub.publisher(&POSE, 1)?,
            references,
            health: Health::open(&hub, &TRACKER_HEALTH)?,
            capture: Peer::open(&hub, &CAPTURE_HEALTH)?,
            tracker: None,
            last_intrinsics: None,
            costs: IterationCosts::default(),
            order: FrameOrder::default(),
            last_arrival_nanos: None,
            early_wake: EarlyWake::new(config.tracker.early_wake_us),
            warm_page_faults: None,
            hub,
            _claim: claim,
        };
        shell.hub.reserve()?;
        Ok(shell)
    }

    fn track_until(&mut self, shutdown: &Shutdown) -> Result<(), RunError> {
        while !shutdown.is_requested() {
            let mut next = self.await_frame(shutdown)?;
            self.poses.serve_late_joiners();
            while let Some(frame) = next {
                self.step(&frame)?;
                drop(frame);
                // Frames that take longer than their period leave no pause between them.
                self.poses.serve_late_joiners();
                self.health.report();
                if shutdown.is_requested() {
                    return Ok(());
                }
                next = self.next_frame()?;
            }
            self.check_for_silence()?;
            self.health.report();
        }
        Ok(())
    }

    /// Sleeps until something happens; returns a frame that has arrived. Live, if it is configured to and frames are
    /// punctual, it wakes shortly before the next frame and polls for it.
    fn await_frame(
        &mut self,
        shutdown: &Shutdown,
    ) -> Result<Option<Received<u8, FrameHeader>>, RunError> {
        let watch = self.early_wake.watch(now_nanos()).filter(|_| self.mode == Mode::Live);
        let sleep = watch.map_or(WAKE_PERIOD, |watch| watch.sleep(now_nanos()).min(WAKE_PERIOD));
        wait(&[self.frames.events()], Some(shutdown.descriptor()), sleep)?;
        while watch.is_some_and(|watch| watch.is_on(now_nanos())) {
            if let Some(frame) = self.next_frame()? {
                return Ok(Some(frame));
            }
            std::hint::spin_loop();
        }
        Ok(self.next_frame()?)
    }

    /// The oldest frame in lockstep, the newest live.
    fn next_frame(&self) -> Result<Option<Received<u8, FrameHeader>>, ReceiveError> {
        match self.mode {
            Mode::Lockstep => self.frames.receive(),
            Mode::Live => self.frames.newest(),
        }
    }

    /// One frame: adopt, track, publish.
    fn step(&mut self, received: &Received<u8, FrameHeader>) -> Result<(), RunError> {
        let arrival_nanos = now_nanos();
        let _span = tracing::trace_span!("frame", sequence = received.header().sequence).entered();
        let header = *received.header();
        let (frame, intrinsics) = match frame_from_message(&header, received.payload()) {
            Ok(frame) => frame,
            Err(_) => {
                // Not logged: a sender of many such frames must not make this loop do I/O.
                self.health.counters().refused += 1;
                self.health.enter(ProcessState::Running, "an invalid frame was refused");
                return Ok(());
            }
        };
        if !self.is_in_order(&header) {
            return Ok(());
        }
        self.last_arrival_nanos = Some(arrival_nanos);
        self.early_wake.arrive(arrival_nanos, self.order.period_nanos());
        let deadline_nanos = self.deadline_nanos(arrival_nanos);
        let (estimate, track_nanos) = self.track(&frame, intrinsics, deadline_nanos)?;
        let wake_nanos = arrival_nanos.saturating_sub(header.sent_nanos);
        self.publish(&estimate, &header, [wake_nanos, track_nanos], deadline_nanos)?;
        if let Some((_, tracker)) = &mut self.tracker {
            tracker.prepare_next();
        }
        self.count_page_faults();
        Ok(())
    }

    /// The pose of a frame, and the time it took to track: in lockstep the reference is prepared in this thread too,
    /// but that is a cost per keyframe and not part of it.
    fn track(
        &mut self,
        frame: &FrameView<'_>,
        intrinsics: Intrinsics,
        deadline_nanos: Option<i64>,
    ) -> Result<(PoseEstimate, i64), RunError> {
        let known = self.tracker.take().filter(|(of, _)| *of == intrinsics);
        let (_, tracker) = match known {
            Some(tracker) => self.tracker.insert(tracker),
            None => {
                // The first, or another camera in mid-stream.
                let is_first = self.last_intrinsics.replace(intrinsics).is_none();
                self.health.counters().resized += u64::from(!is_first);
                let tracker = Tracker::new(intrinsics, self.config.tracking.clone())
                    .map_err(|error| RunError::Parameter("tracking", error))?;
                self.tracker.insert((intrinsics, tracker))
            }
        };
        if let Some(reference) = self.references.newest()? {
            let (epoch, keyframe_id) = (reference.epoch(), reference.keyframe_id());
            let is_first = tracker.reference().is_none();
            if let Some(used) = tracker.adopt(reference) {
                self.references.give_back(used);
            }
            // The last pose from a previous tracker, which died.
            let last = self.references.last_pose().filter(|last| last.epoch == epoch);
            match last {
                Some(last) => tracker.resume_at(last.nanos, &last.world_from_camera),
                // The map may come from a mapper that died as well, and the camera may be anywhere in it.
                None if is_first
                    && (self.mode == Mode::Live || Tracker::is_found_on(keyframe_id)) =>
                {
                    tracker.begin_lost();
                }
                None => {}
            }
        }
        let _span = tracing::trace_span!("track").entered();
        let begin_nanos = now_nanos();
        let estimate = match deadline_nanos {
            None => tracker.track(frame, &mut |_| true),
            Some(deadline) => tracker.track(frame, &mut self.costs.until(deadline)),
        };
        Ok((estimate, now_nanos().saturating_sub(begin_nanos)))
    }

    /// When the pose of a frame that has just arrived is due; `None` in lockstep.
    fn deadline_nanos(&self, arrival_nanos: i64) -> Option<i64> {
        let allowed_nanos = match self.config.tracker.deadline_ms {
            0.0 => self.order.period_nanos() / 2,
            deadline_ms => (deadline_ms * 1e6) as i64,
        };
        (self.mode == Mode::Live).then(|| arrival_nanos.saturating_add(allowed_nanos))
    }

    /// Counts missing and out-of-order frames; returns whether the frame is to be used.
    fn is_in_order(&mut self, header: &FrameHeader) -> bool {
        let arrival = self.order.arrive(header);
        let counters = self.health.counters();
        if let FrameOrderOutcome::Next { missing } = arrival {
            counters.dropped += missing;
        } else {
            counters.disordered += 1;
        }
        arrival != FrameOrderOutcome::Repeated
    }

    /// Live: reports when frames have stopped. The next frame ends the state.
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

    fn count_page_faults(&mut self) {
        if self.health.counters().frames < WARM_UP_FRAMES {
            return;
        }
        let faults = thread_page_faults();
        let warm = *self.warm_page_faults.get_or_insert(faults);
        self.health.counters().page_faults = faults.saturating_sub(warm);
    }

    fn publish(
        &mut self,
        estimate: &PoseEstimate,
        header: &FrameHeader,
        [wake_nanos, track_nanos]: [i64; 2],
        deadline_nanos: Option<i64>,
    ) -> Result<(), RunError> {
        let _span = tracing::trace_span!("publish").entered();
        let published_nanos = now_nanos();
        // A camera's stamp may lie in the future of our clock.
        let positive = |nanos: i64| u64::try_from(nanos).unwrap_or(0);
        let timing = PoseTiming {
            realtime_nanos: header.realtime_nanos,
            published_nanos,
            latency_nanos: positive(published_nanos.saturating_sub(header.clock_nanos)),
            track_nanos: positive(track_nanos),
            wake_nanos: positive(wake_nanos),
        };
        let mut message = pose_message(estimate, &timing);
        if pose_from_message(&message).is_err() {
            // No non-finite value leaves this process.
            self.health.counters().refused += 1;
            message = pose_message(&unclaimed(estimate), &timing);
        }
        self.poses.send((), &[message])?;
        self.health.count_latency(timing.latency_nanos);
        self.health.count_work(timing.track_nanos);
        self.health.count_wake(timing.wake_nanos);
        let counters = self.health.counters();
        counters.frames += 1;
        counters.detail = codes_from_state(estimate.state).0;
        let late = deadline_nanos.is_some_and(|deadline| published_nanos > deadline);
        counters.deadline_misses += u64::from(late);
        // A report sent at once includes the frame.
        self.health.enter(ProcessState::Running, state_text(estimate.state));
        Ok(())
    }
}

/// A state and its reason, for display.
fn state_text(state: TrackingState) -> &'static str {
    match state {
        TrackingState::Initializing => "initializing: there is no trusted map yet",
        TrackingState::Tracking => "tracking",
        TrackingState::Degraded(DegradedReason::Budget) => "degraded: out of time",
        TrackingState::Degraded(DegradedReason::LowOverlap) => {
            "degraded: little of the keyframe is in view"
        }
        TrackingState::Degraded(DegradedReason::HighResidual) => {
            "degraded: the images fit the map badly"
        }
        TrackingState::Degraded(DegradedReason::Gap) => "degraded: frames are missing",
        TrackingState::Degraded(DegradedReason::Turning) => {
            "degraded: known depth is out of view; rotation is tracked on the last view"
        }
        TrackingState::Lost(LostReason::Diverged) => "lost: the keyframe is out of view",
        TrackingState::Lost(LostReason::TooFewInliers) => "lost: too few points match",
        TrackingState::Lost(LostReason::NoPoints) => "lost: the keyframe has no usable points",
        TrackingState::Lost(LostReason::UnusableFrame) => "lost: the frame has no contrast",
        TrackingState::Lost(LostReason::MapRejected) => "lost: the map contradicts itself",
    }
}

/// The same frame, lost, without any number that could be invalid.
fn unclaimed(estimate: &PoseEstimate) -> PoseEstimate {
    let identity = crate::slam::geometry::se3::SE3::identity();
    let mut covariance = [0.0; 21];
    let mut diagonal = 0;
    for row in 0..6 {
        covariance[diagonal] = UNKNOWN_VARIANCE;
        diagonal += 6 - row;
    }
    PoseEstimate {
        state: TrackingState::Lost(LostReason::Diverged),
        world_from_camera: identity,
        map_from_camera: identity,
        keyframe_from_camera: identity,
        covariance,
        map_covariance: covariance,
        alignment_covariance: covariance,
        velocity: None,
        brightness: Default::default(),
        quality: Default::default(),
        proposes_keyframe: false,
        ..*estimate
    }
}
