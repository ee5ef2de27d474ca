//! The supervisor: starts the three processes, watches them, collects what they publish, ends them
//! in order, and leaves nothing behind.

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::capture::source::{FrameSource, SourceError, SourceName, open};
use crate::service::child::Child;
use crate::service::config::Config;
use crate::service::health::{ProcessState, cause};
use crate::service::journal::{Journal, JournalOptions};
use crate::service::map_file::{MapFileError, read_map};
use crate::service::mode::Mode;
use crate::service::peers::{HEALTH_TOPICS, Peer};
use crate::service::recorder::Recorder;
use crate::service::recording::{RecordParts, RunCounters};
use crate::service::results::{EndOfRun, RunMode, RunRecord};
use crate::service::schedule::peak_rss_bytes;
use crate::service::shutdown::Shutdown;
use crate::slam::evaluation::depth_error::DepthScale;
use crate::slam::mapper::Map;
use crate::slam::pose::TrackingState;
use crate::wire::command::{Command, CommandClient, CommandError};
use crate::wire::place::{Claim, Place, PlaceError};
use crate::wire::port::{Access, Hub, OpenError, ReceiveError, WaitError, wait};
use crate::wire::topic::shared_memory_bytes;

/// Longest sleep without a look at children, signals and progress.
const WAKE_PERIOD: Duration = Duration::from_millis(50);
/// After the last frame of a live run: silence that means all of it has been handled.
const SILENCE: Duration = Duration::from_millis(500);
/// Pause before the first restart of a process; it doubles up to the longest.
const FIRST_BACK_OFF: Duration = Duration::from_millis(50);
/// Longest pause before a restart.
const LONGEST_BACK_OFF: Duration = Duration::from_secs(5);
/// Who has lived so long did not die of its start: the pauses begin anew.
const HEALTHY_LIFE: Duration = Duration::from_secs(2);

/// What to run.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Where frames come from.
    pub source: SourceName,
    /// The camera's rig file.
    pub rig: Option<PathBuf>,
    /// Lockstep or live.
    pub mode: Mode,
    /// Folder for results; it exists.
    pub output: PathBuf,
    /// Whether the map is fetched at the end.
    pub keeps_map: bool,
    /// The journal to keep; without one a kill of the supervisor loses the run.
    pub journal: Option<JournalOptions>,
    /// Options that every child gets: where the configuration comes from.
    pub arguments: Vec<OsString>,
}

/// How far a run is, for whoever watches.
#[derive(Debug, Clone, PartialEq)]
pub enum RunProgress {
    /// There is no camera, for this reason; it is used as soon as it is there.
    Waiting(String),
    /// The processes start, and the source is prepared: (done, total) of that work.
    Preparing(u64, u64),
    /// Frames come.
    Running {
        /// Poses so far.
        frames: u64,
        /// Frames there will be, 0 where unknown.
        total: u64,
        /// State of the last frame.
        state: Option<TrackingState>,
        /// Keyframes in the map.
        keyframes: u64,
    },
}

/// How a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ended {
    /// With the end of the source.
    Finished,
    /// By a signal.
    Interrupted,
    /// Because a process failed; says which and why.
    Failed(String),
}

/// A run that is over: its record is whole up to its end.
pub struct RunOutcome {
    /// Everything for the results.
    pub record: RunRecord,
    /// Its journal, to be finished once the results are written.
    pub journal: Option<Journal>,
    /// The source once more, for its true depth.
    pub source: Box<dyn FrameSource>,
    /// How it ended.
    pub ended: Ended,
}

/// Why a run does not start, or its record cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The place is not right, or taken.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The source cannot be opened.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// Poses cannot be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// A process cannot be started or watched.
    #[error("{process}: cannot be started or watched ({source})")]
    Child {
        /// Which.
        process: &'static str,
        /// Why.
        source: io::Error,
    },
}

/// Runs the three processes to the end of the source, to a signal, or to a failure.
pub fn run(
    config: &Config,
    options: &RunOptions,
    shutdown: &Shutdown,
    observe: &mut dyn FnMut(&RunProgress),
) -> Result<RunOutcome, RunError> {
    let source = open(&options.source, options.rig.as_deref(), &config.source_params())?;
    let place = Place::new(&config.instance, &config.root)?;
    let _claim = claim_all(&place)?;
    place.check_shared_memory(shared_memory_bytes(&source.intrinsics(), None))?;
    let mut supervisor = Supervisor::start(config, options, &place)?;
    let mut ended = supervisor.watch(shutdown, observe)?;
    supervisor.stop("capture");
    supervisor.settle(&ended)?;
    let mut map = match options.keeps_map.then(|| supervisor.save_map()).transpose() {
        Ok(map) => map.unwrap_or_default(),
        Err(error) => {
            if ended == Ended::Finished {
                ended = Ended::Failed(error.to_string());
            }
            Map::default()
        }
    };
    if options.keeps_map && (supervisor.restarts > 0 || map.keyframes.is_empty()) {
        let max_bytes = config.mapping.max_map_bytes() as u64;
        supervisor.recorder.complete_map(&mut map, max_bytes)?;
    }
    let refused = supervisor.refused()?;
    let (recorder, counters) = supervisor.finish()?;
    let lost = counters.frames_in.saturating_sub(recorder.num_poses() as u64);
    if options.mode == Mode::Lockstep && ended == Ended::Finished && lost > 0 {
        ended = Ended::Failed(format!("{lost} of {} poses did not arrive", counters.frames_in));
    }
    let (name, truth) = (options.source.to_string(), source.ground_truth().to_vec());
    let deadline_ms = config.tracker.deadline_ms;
    let (record, journal) = recorder.into_record(RecordParts {
        mode: if options.mode == Mode::Live { RunMode::Live } else { RunMode::Lockstep },
        source: name,
        map,
        ground_truth: truth,
        depth_scale: DepthScale::MedianRatio,
        deadline_ms,
        counters,
    });
    let record = RunRecord { ended: end_of_run(&ended), refused, ..record };
    Ok(RunOutcome { record, journal, source, ended })
}

fn end_of_run(ended: &Ended) -> EndOfRun {
    match ended {
        Ended::Finished => EndOfRun::Finished,
        Ended::Interrupted => EndOfRun::Interrupted,
        Ended::Failed(cause) => EndOfRun::Failed(cause.clone()),
    }
}

/// The journal of the run. Without one it goes on.
fn begin_journal(options: &RunOptions, place: &Place) -> Option<Journal> {
    let begun = Journal::begin(options.journal.as_ref()?, place);
    begun
        .inspect_err(|error| {
            tracing::warn!(
                "no journal is kept ({error}); a kill of this process would lose the run"
            )
        })
        .ok()
}

/// The claim of the supervisor, after a look that none of the three runs already.
fn claim_all(place: &Place) -> Result<Claim, PlaceError> {
    let claim = place.claim("supervisor")?;
    for topic in HEALTH_TOPICS {
        place.claim(topic.owner)?;
    }
    Ok(claim)
}

struct Supervisor<'a> {
    config: &'a Config,
    options: &'a RunOptions,
    root: PathBuf,
    children: Vec<Child>,
    peers: [Peer; 3],
    recorder: Recorder,
    commands: CommandClient,
    hub: Hub,
    restarts: u64,
    /// What processes that died had counted by their last words.
    of_dead: RunCounters,
    /// Restarts in a row of processes that died young.
    hasty_restarts: u32,
}

impl<'a> Supervisor<'a> {
    /// Opens its own ports first, so that nothing is missed, then starts the children.
    fn start(config: &'a Config, options: &'a RunOptions, place: &Place) -> Result<Self, RunError> {
        let hub = Hub::join(place, "supervisor", Access::Member)?;
        let [capture, tracker, mapper] = &HEALTH_TOPICS;
        let peers =
            [Peer::open(&hub, capture)?, Peer::open(&hub, tracker)?, Peer::open(&hub, mapper)?];
        let mut supervisor = Self {
            config,
            options,
            root: place.root.clone(),
            children: Vec::new(),
            peers,
            recorder: Recorder::open(&hub, begin_journal(options, place))?,
            commands: CommandClient::open(&hub)?,
            hub,
            restarts: 0,
            of_dead: RunCounters::default(),
            hasty_restarts: 0,
        };
        for name in ["mapper", "tracker", "capture"] {
            let child = supervisor.spawn(name)?;
            supervisor.children.push(child);
        }
        Ok(supervisor)
    }

    fn spawn(&self, name: &'static str) -> Result<Child, RunError> {
        let mut arguments = self.options.arguments.clone();
        arguments.push(match self.options.mode {
            Mode::Lockstep => "--lockstep".into(),
            Mode::Live => "--live".into(),
        });
        if name == "capture" {
            arguments.extend(["--source".into(), self.options.source.to_os_string()]);
            if let Some(rig) = &self.options.rig {
                arguments.extend(["--rig".into(), rig.clone().into_os_string()]);
            }
        }
        Child::start(name, &arguments, &self.root)
            .map_err(|source| RunError::Child { process: name, source })
    }

    /// Until the source ends, a signal comes or a process fails for good.
    fn watch(
        &mut self,
        shutdown: &Shutdown,
        observe: &mut dyn FnMut(&RunProgress),
    ) -> Result<Ended, RunError> {
        loop {
            wait(&[self.recorder.events()], Some(shutdown.descriptor()), WAKE_PERIOD)?;
            self.recorder.collect()?;
            for peer in &mut self.peers {
                peer.update()?;
            }
            if self.recorder.wants_counters() {
                self.recorder.count(self.counters());
            }
            observe(&self.progress());
            if shutdown.is_requested() {
                return Ok(Ended::Interrupted);
            }
            if let Some(ended) = self.check_children(shutdown)? {
                return Ok(ended);
            }
        }
    }

    fn progress(&self) -> RunProgress {
        let Some(capture) = self.peers[0].last() else { return RunProgress::Preparing(0, 0) };
        if self.peers[0].state() == Some(ProcessState::Stale) {
            return RunProgress::Waiting(cause(capture));
        }
        if self.recorder.num_poses() == 0 {
            return RunProgress::Preparing(capture.progress_done, capture.progress_total);
        }
        RunProgress::Running {
            frames: self.recorder.num_poses() as u64,
            total: capture.total,
            state: self.recorder.state(),
            keyframes: self.recorder.last_step().map_or(0, |step| step.keyframes),
        }
    }

    /// Looks who has ended: the source's end ends the run, a death restarts the process (live) or
    /// ends the run (lockstep: a frame without an answer cannot be made good).
    fn check_children(&mut self, shutdown: &Shutdown) -> Result<Option<Ended>, RunError> {
        for index in 0..self.children.len() {
            let child = &mut self.children[index];
            let process = child.name;
            let status = child.poll().map_err(|source| RunError::Child { process, source })?;
            let Some(status) = status else { continue };
            if process == "capture" && status.success() {
                return Ok(Some(Ended::Finished));
            }
            let fault = child.fault();
            let is_fault = fault.is_some();
            let cause = fault.unwrap_or_else(|| format!("{process} ended with {status}"));
            if child.age() > HEALTHY_LIFE {
                self.hasty_restarts = 0;
            }
            // Who says why will say the same again; who dies without a word may have had bad luck.
            let may_restart = self.options.mode == Mode::Live
                && !is_fault
                && self.hasty_restarts < self.config.supervisor.max_restarts;
            if !may_restart {
                return Ok(Some(Ended::Failed(cause)));
            }
            tracing::warn!("{cause}; it is started again");
            self.back_off(shutdown)?;
            self.children[index] = self.spawn(process)?;
            for peer in self.peers.iter_mut().filter(|peer| peer.name() == process) {
                count(&mut self.of_dead, peer);
                peer.forget();
            }
            self.restarts += 1;
            self.hasty_restarts += 1;
        }
        Ok(None)
    }

    /// Waits longer with every restart, and goes on collecting.
    fn back_off(&mut self, shutdown: &Shutdown) -> Result<(), RunError> {
        let doubled = FIRST_BACK_OFF * 2_u32.saturating_pow(self.hasty_restarts.min(8));
        let end = Instant::now() + doubled.min(LONGEST_BACK_OFF);
        self.hub.clean_up();
        while Instant::now() < end && !shutdown.is_requested() {
            wait(&[self.recorder.events()], Some(shutdown.descriptor()), WAKE_PERIOD)?;
            self.recorder.collect()?;
        }
        Ok(())
    }

    fn child(&mut self, name: &str) -> Option<&mut Child> {
        self.children.iter_mut().find(|child| child.name == name)
    }

    /// Asks a process to stop, and kills it when it does not.
    fn stop(&mut self, name: &str) {
        let end = Instant::now() + Duration::from_secs_f64(self.config.supervisor.stop_timeout_s);
        let Some(child) = self.child(name) else { return };
        child.ask_to_stop();
        while Instant::now() < end {
            match child.poll() {
                Ok(None) => drop(wait(&[], None, Duration::from_millis(5))),
                Ok(Some(_)) | Err(_) => return,
            }
        }
        tracing::warn!("{name} does not stop; it is killed");
        child.kill();
    }

    /// Collects what is still under way after the last frame.
    fn settle(&mut self, ended: &Ended) -> Result<(), RunError> {
        self.recorder.collect()?;
        if self.options.mode == Mode::Lockstep || matches!(ended, Ended::Failed(_)) {
            return Ok(());
        }
        let mut last = Instant::now();
        while last.elapsed() < SILENCE {
            wait(&[self.recorder.events()], None, WAKE_PERIOD)?;
            if self.recorder.collect()? {
                last = Instant::now();
            }
        }
        Ok(())
    }

    /// Has the mapper write its map, and reads it.
    fn save_map(&mut self) -> Result<Map, SaveMapError> {
        let file = format!(".semidense-map-{}.bin", std::process::id());
        let path = std::path::absolute(self.options.output.join(file))?;
        let timeout = Duration::from_secs_f64(self.config.supervisor.save_timeout_s);
        let mapper = self.children.iter_mut().find(|child| child.name == "mapper");
        let Some(mapper) = mapper else { return Ok(Map::default()) };
        let command = Command::SaveMap(path.clone());
        self.commands.ask(&command, timeout, || matches!(mapper.poll(), Ok(None)))?;
        let map = read_map(&path);
        remove(&path);
        Ok(map?)
    }

    /// What capture says of images that it has left out.
    fn refused(&mut self) -> Result<Option<String>, RunError> {
        let is_camera = self.options.source.is_camera();
        let last = self.peers[0].update()?.filter(|last| last.refused > 0);
        Ok(last.map(|last| match is_camera {
            true => format!("{} left out: they came damaged", last.refused),
            false => cause(last),
        }))
    }

    /// Ends the others, and gives what was collected.
    fn finish(mut self) -> Result<(Recorder, RunCounters), RunError> {
        self.stop("tracker");
        self.stop("mapper");
        self.recorder.collect()?;
        for peer in &mut self.peers {
            peer.update()?;
        }
        self.hub.clean_up();
        let counters = self.counters();
        if self.peers[0].state() == Some(ProcessState::Failed) {
            tracing::debug!("capture has failed after {} frames", counters.frames_in);
        }
        Ok((self.recorder, counters))
    }

    /// What was counted until now.
    fn counters(&self) -> RunCounters {
        let [capture, tracker, _] = &self.peers;
        let peaks = self.peers.iter().filter_map(|peer| Some(peer.last()?.peak_rss_bytes));
        let mut sums = self.of_dead;
        [capture, tracker].into_iter().for_each(|peer| count(&mut sums, peer));
        RunCounters {
            // Who is killed leaves the count of a moment before.
            frames_in: sums.frames_in.max(self.recorder.num_poses() as u64),
            restarts: self.restarts,
            peak_rss_bytes: peaks.sum::<u64>() + peak_rss_bytes().unwrap_or(0),
            ..sums
        }
    }
}

/// Adds what a process has counted by its last word.
fn count(sums: &mut RunCounters, peer: &Peer) {
    let Some(last) = peer.last() else { return };
    match peer.name() {
        "capture" => {
            sums.frames_in += last.frames;
            sums.gaps += last.gaps;
            sums.frames_refused += last.refused;
        }
        "tracker" => {
            sums.deadline_misses += last.deadline_misses;
            sums.page_faults += last.page_faults;
        }
        _ => {}
    }
}

/// Why there is no map.
#[derive(Debug, thiserror::Error)]
enum SaveMapError {
    #[error(transparent)]
    Command(#[from] CommandError),
    #[error(transparent)]
    File(#[from] MapFileError),
    #[error("the output folder's path is not usable ({0})")]
    Path(#[from] io::Error),
}

fn remove(path: &Path) {
    if let Err(error) = std::fs::remove_file(path) {
        tracing::warn!("{}: cannot be removed ({error})", path.display());
    }
}
