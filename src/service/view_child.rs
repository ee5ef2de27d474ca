//! The live page beside a run: one more process, whose death the run does not notice.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use crate::service::child::SUPERVISOR_VARIABLE;
use crate::service::clock::wait_at_most;
use crate::service::error_log::ErrorLog;
use crate::service::manager_notice::VARIABLES;
use crate::wire::folders::ROOT_VARIABLE;

/// Pause before it is started again.
const RESTART_PAUSE: Duration = Duration::from_secs(10);
/// How often it is started again: what fails more often will not come right.
const MOST_RESTARTS: u32 = 3;
/// How long it may take to end when it is asked to: one that is stopped never does.
const LONGEST_END: Duration = Duration::from_millis(500);
/// Addresses that wait to be printed.
const WAITING_LINES: usize = 4;

/// What starts it.
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// `semidense-bridge`.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<OsString>,
    /// Folder of the instance.
    pub root: PathBuf,
    /// Where its log goes.
    pub log: ErrorLog,
}

/// The process, ended when this is dropped.
#[derive(Debug)]
pub struct ViewChild {
    options: ViewOptions,
    running: Option<(Child, Receiver<String>)>,
    ended: Option<Instant>,
    restarts: u32,
}

impl ViewChild {
    /// Starts it.
    pub fn start(options: ViewOptions) -> io::Result<Self> {
        let running = Some(spawn(&options)?);
        Ok(Self { options, running, ended: None, restarts: 0 })
    }

    /// Looks after it, and gives the address that it has printed, once.
    pub fn look(&mut self) -> Option<String> {
        let Some((child, lines)) = &mut self.running else {
            let is_due = self.ended.is_some_and(|ended| ended.elapsed() >= RESTART_PAUSE);
            if is_due && self.restarts < MOST_RESTARTS {
                self.restarts += 1;
                self.running = spawn(&self.options)
                    .inspect_err(|error| {
                        tracing::warn!("the live page cannot be started again ({error})")
                    })
                    .ok();
                self.ended = Some(Instant::now());
            }
            return None;
        };
        let line = lines.try_recv().ok();
        if let Ok(Some(status)) = child.try_wait() {
            let next =
                if self.restarts < MOST_RESTARTS { "it is started again" } else { "it stays away" };
            tracing::warn!("the live page has ended ({status}); the run continues, {next}");
            (self.running, self.ended) = (None, Some(Instant::now()));
        }
        line
    }
}

impl Drop for ViewChild {
    fn drop(&mut self) {
        let Some((child, _)) = &mut self.running else { return };
        let _ = rustix::process::kill_process(Pid::from_child(child), Signal::TERM);
        wait_at_most(LONGEST_END, || !matches!(child.try_wait(), Ok(None)));
        let _ = child.kill();
        let _ = child.wait();
    }
}

/// In a process group of its own, so that a Ctrl-C at the terminal reaches only the run.
fn spawn(options: &ViewOptions) -> io::Result<(Child, Receiver<String>)> {
    let mut command = Command::new(&options.program);
    // The service manager knows the run, not its children.
    for variable in VARIABLES {
        command.env_remove(variable);
    }
    let mut child = command
        .args(&options.arguments)
        .env(SUPERVISOR_VARIABLE, std::process::id().to_string())
        .env(ROOT_VARIABLE, Path::new(&options.root))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .process_group(0)
        .spawn()?;
    let (sender, lines) = sync_channel(WAITING_LINES);
    if let Some(stdout) = child.stdout.take() {
        forward("semidense-view", stdout, move |line| drop(sender.try_send(line)))?;
    }
    if let Some(stderr) = child.stderr.take() {
        let mut log = options.log.clone();
        forward("semidense-view-log", stderr, move |line| {
            drop(log.write_all(format!("live page: {line}\n").as_bytes()));
        })?;
    }
    Ok((child, lines))
}

/// Hands on every line that comes.
fn forward(
    name: &str,
    from: impl io::Read + Send + 'static,
    mut take: impl FnMut(String) + Send + 'static,
) -> io::Result<()> {
    std::thread::Builder::new().name(name.to_owned()).spawn(move || {
        for line in BufReader::new(from).split(b'\n').map_while(Result::ok) {
            take(String::from_utf8_lossy(&line).into_owned());
        }
    })?;
    Ok(())
}
