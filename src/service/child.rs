//! A process that the supervisor has started: it ends with the supervisor, whatever happens.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{ChildStderr, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use crate::service::manager_notice::VARIABLES;

/// Environment variable with the process id of the supervisor.
pub const SUPERVISOR_VARIABLE: &str = "SEMIDENSE_SUPERVISOR";
/// What the last line of a command that fails begins with.
pub const ERROR_PREFIX: &str = "error: ";

/// Why a supervised process must not start.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    /// The supervisor has died before this process could follow it.
    #[error("the supervisor has gone")]
    Gone,
    /// The kernel refuses.
    #[error("the kernel does not tell when the supervisor dies ({0})")]
    Kernel(io::Error),
}

/// In a process that a supervisor has started: be told to stop when it dies. Does nothing in one
/// that was started by hand.
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

/// A running child. Killed when dropped while it still runs.
#[derive(Debug)]
pub struct Child {
    /// Its name: the subcommand.
    pub name: &'static str,
    process: std::process::Child,
    started: Instant,
    fault: Arc<Mutex<Option<String>>>,
    reader: Option<JoinHandle<()>>,
}

impl Child {
    /// Starts the subcommand `name` of this binary, in a process group of its own, so that a Ctrl-C
    /// at the terminal reaches only the supervisor.
    pub fn start(name: &'static str, arguments: &[OsString], root: &Path) -> io::Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        // The service manager knows the supervisor, not its children.
        for variable in VARIABLES {
            command.env_remove(variable);
        }
        let mut process = command
            .arg(name)
            .args(arguments)
            .env(SUPERVISOR_VARIABLE, std::process::id().to_string())
            .env(crate::wire::place::ROOT_VARIABLE, root)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .process_group(0)
            .spawn()?;
        let fault = Arc::new(Mutex::new(None));
        let reader = match process.stderr.take() {
            None => None,
            Some(stderr) => {
                let fault = Arc::clone(&fault);
                let thread = std::thread::Builder::new().name(format!("semidense-{name}-log"));
                Some(thread.spawn(move || forward(stderr, &fault))?)
            }
        };
        Ok(Self { name, process, started: Instant::now(), fault, reader })
    }

    /// How long ago it was started.
    pub fn age(&self) -> Duration {
        self.started.elapsed()
    }

    /// How it ended; `None` while it runs.
    pub fn poll(&mut self) -> io::Result<Option<ExitStatus>> {
        self.process.try_wait()
    }

    /// Asks it to stop (SIGTERM).
    pub fn ask_to_stop(&mut self) {
        // A process that has been waited for has no id any more that could be meant.
        if let Ok(None) = self.process.try_wait() {
            let _ = rustix::process::kill_process(Pid::from_child(&self.process), Signal::TERM);
        }
    }

    /// Kills it and waits for its end.
    pub fn kill(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }

    /// What it said when it failed. Call it after its end.
    pub fn fault(&mut self) -> Option<String> {
        if let Some(reader) = self.reader.take() {
            // A panic there would have been a write to a closed terminal.
            let _ = reader.join();
        }
        self.fault.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

impl Drop for Child {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Passes a child's log on; its error is kept for the supervisor's own last line.
fn forward(stderr: ChildStderr, fault: &Mutex<Option<String>>) {
    for line in BufReader::new(stderr).split(b'\n').map_while(Result::ok) {
        let line = String::from_utf8_lossy(&line);
        match line.strip_prefix(ERROR_PREFIX) {
            Some(error) => {
                *fault.lock().unwrap_or_else(PoisonError::into_inner) = Some(error.to_owned());
            }
            // A closed terminal is no reason to stop reading.
            None => drop(writeln!(io::stderr(), "{line}")),
        }
    }
}
