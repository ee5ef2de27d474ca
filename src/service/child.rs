//! A process that the supervisor started: it ends with the supervisor, whatever happens.

use std::ffi::OsString;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::fs::MemfdFlags;
use rustix::process::{Pid, Signal};

use crate::capture::source_name::SourceName;
use crate::service::clock::wait_at_most;
use crate::service::error_log::ErrorLog;
use crate::service::liveness::{Liveness, is_ending};
use crate::service::manager_notice::VARIABLES;
use crate::service::mode::Mode;
use crate::service::position::RUN_VARIABLE;
use crate::wire::folders::ROOT_VARIABLE;
use crate::wire::place::Place;

/// Environment variable that holds the process id of the supervisor.
pub const SUPERVISOR_VARIABLE: &str = "SEMIDENSE_SUPERVISOR";
/// Environment variable that tells where prepared frames outlive their process.
const FRAMES_VARIABLE: &str = "SEMIDENSE_PREPARED_FRAMES";
const FRAMES_ON_STDIN: &str = "stdin";
/// Prefix of the last line of a command that fails.
pub const ERROR_PREFIX: &str = "error: ";
/// Longest wait for a killed process to end: one that the kernel does not release, as in a hanging driver, is left.
const KILL_TIMEOUT: Duration = Duration::from_secs(2);
/// Longest wait after a process's end for its last lines: another process may hold its standard error.
const LAST_LINES_TIMEOUT: Duration = Duration::from_secs(1);

/// Why a supervised process must not start.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    /// The supervisor has died before this process could follow it.
    #[error("the supervisor has exited")]
    Gone,
    /// The kernel refuses the request.
    #[error("cannot watch whether the supervisor is alive ({0})")]
    Kernel(io::Error),
}

/// Whether a supervisor started this process.
pub fn is_supervised() -> bool {
    std::env::var_os(SUPERVISOR_VARIABLE).is_some()
}

/// Where the supervisor keeps frames that are prepared before the first one is due: in its own memory, so that a killed
/// capture leaves them to the next.
pub fn prepared_frames() -> Option<File> {
    let place = std::env::var(FRAMES_VARIABLE).ok()?;
    (place == FRAMES_ON_STDIN).then_some(())?;
    io::stdin().as_fd().try_clone_to_owned().ok().map(File::from)
}

/// Memory for frames that are prepared before a live run and may be needed by more than one capture.
pub fn memory_for_frames(source: &SourceName, mode: Mode) -> Option<File> {
    let extend_start = matches!(source, SourceName::Simulator { .. } | SourceName::Looped { .. });
    if !extend_start || mode != Mode::Live {
        return None;
    }
    let memory = rustix::fs::memfd_create("semidense-frames", MemfdFlags::CLOEXEC);
    let said = memory.inspect_err(|error| {
        tracing::warn!("after a restart, capture would have to prepare the source again ({error})")
    });
    said.ok().map(File::from)
}

/// In a process that a supervisor started: requests a signal to stop when the supervisor dies. Does nothing in a
/// process started by hand.
pub fn follow_supervisor() -> Result<(), FollowError> {
    let Some(supervisor) = std::env::var(SUPERVISOR_VARIABLE).ok().and_then(|pid| pid.parse().ok())
    else {
        return Ok(());
    };
    rustix::process::set_parent_process_death_signal(Some(Signal::TERM))
        .map_err(|e| FollowError::Kernel(e.into()))?;
    let parent = rustix::process::getppid().map(Pid::as_raw_nonzero).map(std::num::NonZeroI32::get);
    if parent == Some(supervisor) { Ok(()) } else { Err(FollowError::Gone) }
}

/// Last step of a process: removes what this instance left and no other process holds, including what its supervisor
/// left if that was killed. A killed process holds its locks for some time after its children have learnt of its death,
/// and until then it cannot be told from a living one.
pub fn tidy_up(place: &Place) {
    /// Longest time until a killed process is gone, on a busy machine with a slow disk.
    const KILL_TIMEOUT: Duration = Duration::from_secs(10);
    let supervisor = std::env::var(SUPERVISOR_VARIABLE).ok().and_then(|pid| pid.parse().ok());
    if let Some(supervisor) = supervisor {
        wait_at_most(KILL_TIMEOUT, || !is_ending(supervisor));
    }
    place.tidy();
}

/// A running child. Killed when dropped while it still runs.
#[derive(Debug)]
pub struct Child {
    process: std::process::Child,
    started: Instant,
    fault: Arc<Mutex<Option<String>>>,
    reader: Option<JoinHandle<()>>,
}

impl Child {
    /// Starts the subcommand `name` of this binary. `run` names the run it belongs to; `frames` holds the frames that
    /// it prepares; its log goes to `log`.
    pub fn start(
        name: &str,
        arguments: &[OsString],
        root: &Path,
        run: &str,
        frames: Option<&File>,
        log: &ErrorLog,
    ) -> io::Result<Self> {
        let frames = frames.map(File::try_clone).transpose()?;
        let mut process = command(&own_program()?, root)
            .arg(name)
            .args(arguments)
            .env(RUN_VARIABLE, run)
            .env(FRAMES_VARIABLE, if frames.is_some() { FRAMES_ON_STDIN } else { "" })
            .stdin(frames.map_or_else(Stdio::null, Stdio::from))
            .spawn()?;
        let fault = Arc::new(Mutex::new(None));
        let (last_error, mut log) = (Arc::clone(&fault), log.clone());
        // Its error is kept for the supervisor's own last line.
        let take = move |line: &str| match line.strip_prefix(ERROR_PREFIX) {
            Some(error) => *locked(&last_error) = Some(error.to_owned()),
            None => drop(log.write_all(format!("{line}\n").as_bytes())),
        };
        let log_name = format!("semidense-{name}-log");
        let reader = process.stderr.take().map(|stderr| forward_lines(&log_name, stderr, take));
        let reader = reader.transpose()?;
        Ok(Self { process, started: Instant::now(), fault, reader })
    }

    /// Its process id.
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    /// Time since its start.
    pub fn age(&self) -> Duration {
        self.started.elapsed()
    }

    /// How it ended; `None` while it runs.
    pub fn poll(&mut self) -> io::Result<Option<ExitStatus>> {
        self.process.try_wait()
    }

    /// Whether a signal or a debugger has stopped it.
    pub fn is_stopped(&self) -> bool {
        Liveness::of(self.id()) == Liveness::Stopped
    }

    /// Asks it to stop (SIGTERM).
    pub fn ask_to_stop(&mut self) {
        // The id of a process that has been waited for may belong to another process.
        if let Ok(None) = self.process.try_wait() {
            let _ = rustix::process::kill_process(Pid::from_child(&self.process), Signal::TERM);
        }
    }

    /// Kills it and waits a bounded time for its end.
    pub fn kill(&mut self) {
        let _ = self.process.kill();
        wait_at_most(KILL_TIMEOUT, || !matches!(self.process.try_wait(), Ok(None)));
    }

    /// Its error message, where it failed. Call after its end.
    pub fn fault(&mut self) -> Option<String> {
        if let Some(reader) = self.reader.take() {
            wait_at_most(LAST_LINES_TIMEOUT, || reader.is_finished());
        }
        locked(&self.fault).take()
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.kill();
    }
}

fn locked(fault: &Mutex<Option<String>>) -> MutexGuard<'_, Option<String>> {
    fault.lock().unwrap_or_else(PoisonError::into_inner)
}

/// This program, also where its file was replaced or removed since it started.
fn own_program() -> io::Result<PathBuf> {
    let file = std::env::current_exe()?;
    Ok(if file.exists() { file } else { PathBuf::from("/proc/self/exe") })
}

/// The command that starts a process for the instance in the folder `root`, in a separate process group, so that a
/// Ctrl-C at the terminal reaches only this process.
pub fn command(program: &Path, root: &Path) -> Command {
    let mut command = Command::new(program);
    // The service manager watches this process, not its children.
    for variable in VARIABLES {
        command.env_remove(variable);
    }
    command
        .env(SUPERVISOR_VARIABLE, std::process::id().to_string())
        .env(ROOT_VARIABLE, root)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .process_group(0);
    command
}

/// Passes on every line from a separate thread.
pub fn forward_lines(
    name: &str,
    from: impl Read + Send + 'static,
    mut take: impl FnMut(&str) + Send + 'static,
) -> io::Result<JoinHandle<()>> {
    std::thread::Builder::new().name(name.to_owned()).spawn(move || {
        for line in BufReader::new(from).split(b'\n').map_while(Result::ok) {
            take(&String::from_utf8_lossy(&line));
        }
    })
}
