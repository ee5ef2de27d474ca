//! Starts the three processes, watches them, collects what they publish, ends them in order and leaves nothing behind.

use std::ffi::OsString;
use std::fmt::Write;
use std::fs::File;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use crate::capture::mask::Mask;
use crate::capture::opening::open;
use crate::capture::source::FrameSource;
use crate::capture::source_name::SourceName;
use crate::service::checkpoint::read_checkpoint;
use crate::service::child::{Child, memory_for_frames};
use crate::service::clock::now_nanos;
use crate::service::config::Config;
use crate::service::error_log::ErrorLog;
use crate::service::final_map::{FinalMapError, final_map};
use crate::service::health::{ProcessState, cause};
use crate::service::journal::{Journal, JournalOptions};
use crate::service::map_folder::session::{MapSessionError, check_camera};
use crate::service::mapper::used_map::loaded_map;
use crate::service::mode::Mode;
use crate::service::peers::Peer;
use crate::service::position::{position_key, read_position};
use crate::service::recorder::Recorder;
use crate::service::results::record::{EndOfRun, RestartCause, RunCounters, RunMode, RunRecord};
pub use crate::service::run_error::RunError;
use crate::service::run_progress::RunProgress;
use crate::service::schedule::peak_rss_bytes;
use crate::service::shutdown::Shutdown;
use crate::service::supervised::{Death, Supervised};
use crate::service::time_counts::TimeCounts;
use crate::slam::map::Map;
use crate::wire::command::CommandClient;
use crate::wire::place::{Claim, Place};
use crate::wire::port::{Access, Hub, wait};
use crate::wire::topic::{HEALTH_TOPICS, shared_memory_bytes};

/// Longest sleep between two checks of children, signals and progress.
const WAKE_PERIOD: Duration = Duration::from_millis(50);
/// Silence after the last frame of a live run that means all of it has been processed.
const SILENCE: Duration = Duration::from_millis(500);
/// Time between two checks for shared memory that is promised and not yet reserved.
const RESERVE_PERIOD: Duration = Duration::from_secs(1);
/// How long after a kill a process may still fail because of it: opening what a process killed in its start left half
/// made is tried fifty times, half a second each.
const KILL_AFTERMATH: Duration = Duration::from_secs(30);
/// Pause between two checks for the end or the answer of a process.
const ANSWER_PAUSE: Duration = Duration::from_millis(5);

/// What to run.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Source of the frames.
    pub source: SourceName,
    /// The camera's rig file.
    pub rig: Option<PathBuf>,
    /// The camera's mask.
    pub mask: Option<PathBuf>,
    /// Lockstep or live.
    pub mode: Mode,
    /// Folder for results, which exists.
    pub output: PathBuf,
    /// Whether the map is fetched at the end.
    pub keeps_map: bool,
    /// The journal to keep; without one a kill of the supervisor loses the run.
    pub journal: Option<JournalOptions>,
    /// Options for every child: the origin of the configuration.
    pub arguments: Vec<OsString>,
    /// Receives the log of the children.
    pub log: ErrorLog,
}

/// A finished run: its record is complete up to its end.
pub struct RunOutcome {
    /// Everything for the results.
    pub record: RunRecord,
    /// Its journal, to be finished once the results are written.
    pub journal: Option<Journal>,
    /// The source once more, for its true depth.
    pub source: Box<dyn FrameSource>,
}

/// Runs the three processes to the end of the source, to a signal, or to a failure.
pub fn run(
    config: &Config,
    options: &RunOptions,
    shutdown: &Shutdown,
    observe: &mut dyn FnMut(&RunProgress),
) -> Result<RunOutcome, RunError> {
    let source = open(&options.source, options.rig.as_deref(), &config.source_params())?;
    // Capture reads it too; here before any process is started.
    options.mask.as_ref().map(|mask| Mask::read(mask, source.as_ref())).transpose()?;
    check_camera(&config.map, &source.intrinsics()).map_err(MapSessionError::from)?;
    let place = Place::new(&config.instance, &config.root)?;
    let _claim = claim_all(&place)?;
    // State left by an earlier run does not belong to this one.
    place.remove_run_files();
    place.check_shared_memory(shared_memory_bytes(&source.intrinsics(), None))?;
    let outcome = supervise(config, options, &place, source, shutdown, observe);
    // However it ended, no process continues from here.
    place.remove_run_files();
    outcome
}

/// Runs them from their start to the record of the run.
fn supervise(
    config: &Config,
    options: &RunOptions,
    place: &Place,
    source: Box<dyn FrameSource>,
    shutdown: &Shutdown,
    observe: &mut dyn FnMut(&RunProgress),
) -> Result<RunOutcome, RunError> {
    let mut supervisor = Supervisor::start(config, options, place)?;
    let mut ended = supervisor.watch(shutdown, observe)?;
    supervisor.stop(CAPTURE, shutdown);
    supervisor.drain(&ended, shutdown)?;
    // Without a pose there is no map; a mapper that is still starting would be waited for in vain.
    let has_map = options.keeps_map && supervisor.recorder.recording.num_poses() > 0;
    let mut map = match has_map.then(|| supervisor.final_map(shutdown)).transpose() {
        Ok(map) => map.unwrap_or_default(),
        Err(error) => {
            if ended == EndOfRun::Finished {
                ended = EndOfRun::Failed(error.to_string());
            }
            supervisor.map_of_checkpoint()
        }
    };
    if options.keeps_map && (supervisor.restarts() > 0 || map.keyframes.is_empty()) {
        let max_bytes = config.mapping.max_map_bytes() as u64;
        supervisor.recorder.complete_map(&mut map, max_bytes);
    }
    let refused = supervisor.refused()?;
    let is_cut = matches!(ended, EndOfRun::Failed(_));
    if let (EndOfRun::Finished, Some(cause)) = (&ended, &supervisor.bus_error) {
        ended = EndOfRun::Failed(cause.clone());
    }
    let (mut recorder, counters, restart_causes) = supervisor.finish(shutdown)?;
    if let (EndOfRun::Finished, missing @ 1..) = (&ended, recorder.read_back_poses()) {
        ended = EndOfRun::Failed(format!("{missing} poses cannot be read back from the journal"));
    }
    let num_poses = recorder.recording.num_poses();
    if let (EndOfRun::Failed(cause), true, frames @ 1..) = (&mut ended, is_cut, num_poses) {
        let of = if frames == 1 { "frame".to_owned() } else { format!("{frames} frames") };
        let _ = write!(cause, "; the results cover the {of} before it");
    }
    let lost = counters.frames_in.saturating_sub(num_poses as u64);
    if options.mode == Mode::Lockstep && ended == EndOfRun::Finished && lost > 0 {
        ended = EndOfRun::Failed(format!("{lost} of {} poses did not arrive", counters.frames_in));
    }
    let loaded_map = loaded_map(place);
    let of_start = options.journal.as_ref().map_or(0, |kept| kept.start.first_keyframe_id);
    let mode = if options.mode == Mode::Live { RunMode::Live } else { RunMode::Lockstep };
    let known = RunRecord {
        ended,
        counters,
        refused,
        restart_causes,
        map,
        first_keyframe_id: loaded_map.as_ref().map_or(of_start, |map| map.first_keyframe_id),
        loaded_map,
        ground_truth: source.ground_truth().to_vec(),
        ..RunRecord::empty(mode, &options.source.to_string())
    };
    let (record, journal) = recorder.into_record(known, config.tracker.deadline_ms);
    Ok(RunOutcome { record, journal, source })
}

/// The claim of the supervisor, after a check that none of the three runs already.
fn claim_all(place: &Place) -> Result<Claim, RunError> {
    let claim = place.claim("supervisor")?;
    for topic in HEALTH_TOPICS {
        place.claim(topic.owner)?;
    }
    Ok(claim)
}

/// Indices of the processes, in the order of [`HEALTH_TOPICS`].
const CAPTURE: usize = 0;
const TRACKER: usize = 1;
const MAPPER: usize = 2;

struct Supervisor<'a> {
    config: &'a Config,
    options: &'a RunOptions,
    place: Place,
    /// Names the run to its processes.
    run: String,
    /// Frames that capture has prepared: rendering takes longer than a robot may be without poses.
    frames: Option<File>,
    processes: [Supervised; 3],
    recorder: Recorder,
    commands: CommandClient,
    hub: Hub,
    /// Counts of processes that have ended.
    of_ended: RunCounters,
    /// Why a process last died of missing memory: a run with such a death is not a success.
    bus_error: Option<String>,
    /// When a process was last killed, or hung.
    killed: Option<Instant>,
    /// When shared memory was last reserved, and whether some of it was unavailable.
    reserved: Instant,
    is_short: bool,
}

impl<'a> Supervisor<'a> {
    /// Opens its own ports first, so that nothing is missed, then starts the children.
    fn start(config: &'a Config, options: &'a RunOptions, place: &Place) -> Result<Self, RunError> {
        let hub = Hub::join(place, "supervisor", Access::Member)?;
        let open = |topic| Peer::open(&hub, topic).map(Supervised::new);
        let [capture, tracker, mapper] = &HEALTH_TOPICS;
        let processes = [open(capture)?, open(tracker)?, open(mapper)?];
        let mut supervisor = Self {
            config,
            options,
            place: place.clone(),
            run: format!("{}-{}", std::process::id(), now_nanos()),
            frames: memory_for_frames(&options.source, options.mode),
            processes,
            recorder: Recorder::open(&hub, options.journal.as_ref(), place)?,
            commands: CommandClient::open(&hub)?,
            hub,
            of_ended: RunCounters::default(),
            bus_error: None,
            killed: None,
            reserved: Instant::now(),
            is_short: false,
        };
        supervisor.hub.reserve()?;
        supervisor.start_due()?;
        Ok(supervisor)
    }

    /// Starts every process that is due; those that died together start together.
    fn start_due(&mut self) -> Result<(), RunError> {
        // Readers before writers.
        for index in [MAPPER, TRACKER, CAPTURE] {
            if self.processes[index].is_due() {
                let child = self.spawn(self.processes[index].name())?;
                self.processes[index].run(child);
            }
        }
        Ok(())
    }

    fn spawn(&self, name: &'static str) -> Result<Child, RunError> {
        let mut arguments = self.options.arguments.clone();
        arguments.push(match self.options.mode {
            Mode::Lockstep => "--lockstep".into(),
            Mode::Live => "--live".into(),
        });
        if name == HEALTH_TOPICS[CAPTURE].owner {
            arguments.extend(["--source".into(), self.options.source.to_os_string()]);
            let files = [("--rig", &self.options.rig), ("--mask", &self.options.mask)];
            for (option, file) in files.into_iter().filter_map(|(o, f)| Some((o, f.as_ref()?))) {
                arguments.extend([option.into(), file.clone().into_os_string()]);
            }
        }
        let is_capture = name == HEALTH_TOPICS[CAPTURE].owner;
        let frames = self.frames.as_ref().filter(|_| is_capture);
        Child::start(name, &arguments, &self.place.root, &self.run, frames, &self.options.log)
            .map_err(|source| RunError::Child { process: name, source })
    }

    /// Watches until the source ends, a signal arrives or a process fails for good.
    fn watch(
        &mut self,
        shutdown: &Shutdown,
        observe: &mut dyn FnMut(&RunProgress),
    ) -> Result<EndOfRun, RunError> {
        loop {
            wait(&[self.recorder.events()], Some(shutdown.descriptor()), WAKE_PERIOD)?;
            self.recorder.collect()?;
            for process in &mut self.processes {
                process.listen()?;
            }
            if self.recorder.wants_counters() {
                self.recorder.note_loaded_map(loaded_map(&self.place));
                self.recorder.count(self.counters());
            }
            observe(&self.progress());
            if shutdown.is_requested() {
                return Ok(EndOfRun::Interrupted);
            }
            if let Some(ended) = self.check_processes()? {
                return Ok(ended);
            }
            if let Err(error) = self.start_due() {
                // What was recorded becomes the results.
                return Ok(EndOfRun::Failed(error.to_string()));
            }
            self.keep_reserved();
        }
    }

    /// Reserves the shared memory promised to subscribers that have joined meanwhile.
    fn keep_reserved(&mut self) {
        if self.reserved.elapsed() < RESERVE_PERIOD {
            return;
        }
        self.reserved = Instant::now();
        match (self.hub.reserve(), self.is_short) {
            (Err(error), false) => {
                tracing::warn!("{error}");
                self.is_short = true;
            }
            (outcome, _) => self.is_short = outcome.is_err(),
        }
    }

    fn progress(&self) -> RunProgress {
        let Some(capture) = self.processes[CAPTURE].peer.last() else {
            return RunProgress::Preparing(0, 0);
        };
        if self.processes[CAPTURE].peer.state() == Some(ProcessState::Stale) {
            return RunProgress::Waiting(cause(capture));
        }
        if self.recorder.recording.num_poses() == 0 {
            return RunProgress::Preparing(capture.progress_done, capture.progress_total);
        }
        RunProgress::Running {
            frames: self.recorder.recording.num_poses() as u64,
            total: capture.total,
            state: self.recorder.recording.state,
            keyframes: self.recorder.last_step.map_or(0, |step| step.keyframes),
        }
    }

    /// Checks which processes have ended or hang: the source's end ends the run, a death restarts the process (live) or
    /// ends the run (lockstep: a frame without an answer cannot be recovered).
    fn check_processes(&mut self) -> Result<Option<EndOfRun>, RunError> {
        let watchdog = Duration::from_secs_f64(self.config.supervisor.watchdog_s);
        let mut deaths = Vec::new();
        for index in [CAPTURE, TRACKER, MAPPER] {
            let process = &mut self.processes[index];
            let name = process.name();
            let ended = process
                .poll(watchdog)
                .map_err(|source| RunError::Child { process: name, source })?;
            match ended {
                None => {}
                Some(None) => return Ok(Some(EndOfRun::Finished)),
                Some(Some(death)) => deaths.push((index, death)),
            }
        }
        if deaths.is_empty() {
            return Ok(None);
        }
        // All of them first: the fault that one reports may be the end of another.
        if deaths.iter().any(|(_, death)| !death.is_fault) {
            self.killed = Some(Instant::now());
        }
        for (index, death) in deaths {
            let counted = self.counters_of(index);
            self.of_ended.add(&counted);
            self.processes[index].peer.forget();
            if let Some(failed) = self.on_death(index, death) {
                return Ok(Some(failed));
            }
        }
        self.hub.clean_up();
        Ok(None)
    }

    /// Plans a restart after a death, or returns the failure of the run.
    fn on_death(&mut self, index: usize, death: Death) -> Option<EndOfRun> {
        if death.is_bus_error {
            self.bus_error = Some(death.cause.clone());
        }
        let process = &mut self.processes[index];
        let is_live = self.options.mode == Mode::Live;
        let is_after_kill = self.killed.is_some_and(|killed| killed.elapsed() < KILL_AFTERMATH);
        let max_restarts = self.config.supervisor.max_restarts;
        if !is_live || !process.may_restart(&death, is_after_kill, max_restarts) {
            return Some(EndOfRun::Failed(death.cause));
        }
        tracing::warn!("{}; restarting it", death.cause);
        process.plan_restart(death);
        None
    }

    /// Counts of a process: from its last health, which may be a second old where it was killed, and for capture from
    /// the position that it writes with every frame.
    fn counters_of(&self, index: usize) -> RunCounters {
        let mut counted = RunCounters::default();
        let Some(health) = self.processes[index].peer.last() else { return counted };
        match index {
            CAPTURE => {
                let source = self.options.source.to_string();
                let key = position_key(&self.run, &source, self.options.rig.as_deref());
                let place = read_position(&self.place.position_path(), key)
                    .filter(|place| place.process_id == health.process_id)
                    .unwrap_or_default();
                counted.frames_in = health.frames.max(place.frames);
                counted.gaps = health.gaps.max(place.gaps);
                counted.frames_refused = health.refused;
                counted.brightened_by = u8::try_from(health.detail).ok().filter(|by| *by > 0);
                counted.send_counts = TimeCounts(health.latency_counts);
            }
            TRACKER => {
                counted.deadline_misses = health.deadline_misses;
                counted.page_faults = health.page_faults;
            }
            _ => {}
        }
        counted
    }

    /// Asks a process to stop, and kills it if it does not, or at a second Ctrl-C.
    fn stop(&mut self, index: usize, shutdown: &Shutdown) {
        let end = Instant::now() + Duration::from_secs_f64(self.config.supervisor.stop_timeout_s);
        let name = self.processes[index].name();
        let Some(child) = self.processes[index].child() else { return };
        child.ask_to_stop();
        while Instant::now() < end && !shutdown.is_urgent() && !child.is_stopped() {
            match child.poll() {
                Ok(None) => drop(wait(&[], None, ANSWER_PAUSE)),
                Ok(Some(_)) | Err(_) => return,
            }
        }
        tracing::warn!("{name} does not stop; killing it");
        child.kill();
    }

    /// Collects what is still in flight after the last frame.
    fn drain(&mut self, ended: &EndOfRun, shutdown: &Shutdown) -> Result<(), RunError> {
        self.recorder.collect()?;
        if self.options.mode == Mode::Lockstep || matches!(ended, EndOfRun::Failed(_)) {
            return Ok(());
        }
        let mut last = Instant::now();
        while last.elapsed() < SILENCE && !shutdown.is_urgent() {
            wait(&[self.recorder.events()], None, WAKE_PERIOD)?;
            if self.recorder.collect()? {
                last = Instant::now();
            }
        }
        Ok(())
    }

    fn final_map(&mut self, shutdown: &Shutdown) -> Result<Map, FinalMapError> {
        let (folder, config) = (&self.options.output, &self.config.supervisor);
        final_map(&mut self.processes[MAPPER], &self.commands, folder, config, shutdown)
    }

    /// The last checkpoint of a mapper that cannot be queried.
    fn map_of_checkpoint(&self) -> Map {
        let left = read_checkpoint(&self.place.checkpoint_path());
        left.inspect_err(|error| tracing::warn!("{error}")).ok().flatten().unwrap_or_default()
    }

    /// The report of capture on images that it left out.
    fn refused(&mut self) -> Result<Option<String>, RunError> {
        let is_camera = self.options.source.is_camera();
        let last = self.processes[CAPTURE].peer.update()?.filter(|last| last.refused > 0);
        Ok(last.map(|last| match is_camera {
            true => format!("{} left out as damaged", last.refused),
            false => cause(last),
        }))
    }

    /// Ends the others and returns what was collected.
    fn finish(
        mut self,
        shutdown: &Shutdown,
    ) -> Result<(Recorder, RunCounters, Vec<RestartCause>), RunError> {
        self.stop(TRACKER, shutdown);
        self.stop(MAPPER, shutdown);
        self.recorder.collect()?;
        for process in &mut self.processes {
            process.listen()?;
        }
        self.hub.clean_up();
        let causes = self.processes.iter().flat_map(Supervised::restart_causes);
        let (causes, counters) = (causes.collect(), self.counters());
        Ok((self.recorder, counters, causes))
    }

    fn restarts(&self) -> u64 {
        self.processes.iter().map(Supervised::restarts).sum()
    }

    /// The counts so far.
    fn counters(&self) -> RunCounters {
        let peaks = self.processes.iter().filter_map(|p| Some(p.peer.last()?.peak_rss_bytes));
        let mut sums = self.of_ended;
        [CAPTURE, TRACKER].into_iter().for_each(|index| sums.add(&self.counters_of(index)));
        RunCounters {
            // A killed process leaves slightly older counts.
            frames_in: sums.frames_in.max(self.recorder.recording.num_poses() as u64),
            restarts: self.restarts(),
            peak_rss_bytes: peaks.sum::<u64>() + peak_rss_bytes().unwrap_or(0),
            ..sums
        }
    }
}
