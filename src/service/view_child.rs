//! The live page alongside a run: one more process, whose death does not affect the run.

use std::ffi::OsString;
use std::io::{self, Write};
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal};

use crate::service::child::{command, forward_lines};
use crate::service::clock::wait_at_most;
use crate::service::error_log::ErrorLog;

/// Pause before a restart.
const RESTART_PAUSE: Duration = Duration::from_secs(10);
/// Most restarts: a process that fails more often will not recover.
const MAX_RESTARTS: u32 = 3;
/// Longest wait for its end on request: a stopped process never ends.
const LONGEST_END: Duration = Duration::from_millis(500);
/// Addresses that wait to be printed.
const WAITING_LINES: usize = 4;

/// How to start it.
#[derive(Debug, Clone)]
pub struct ViewOptions {
    /// `semidense-bridge`.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<OsString>,
    /// Folder of the instance.
    pub root: PathBuf,
    /// Receives its log.
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

    /// Restarts it when due, and returns the address that it has printed, once.
    pub fn poll(&mut self) -> Option<String> {
        let Some((child, lines)) = &mut self.running else {
            let is_due = self.ended.is_some_and(|ended| ended.elapsed() >= RESTART_PAUSE);
            if is_due && self.restarts < MAX_RESTARTS {
                self.restarts += 1;
                self.running = spawn(&self.options)
                    .inspect_err(|error| {
                        tracing::warn!("the live page cannot be restarted ({error})")
                    })
                    .ok();
                self.ended = Some(Instant::now());
            }
            return None;
        };
        let line = lines.try_recv().ok();
        if let Ok(Some(status)) = child.try_wait() {
            let next = if self.restarts < MAX_RESTARTS {
                "and the page is restarted"
            } else {
                "without the page"
            };
            tracing::warn!("the live page exited ({status}); the run continues {next}");
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

fn spawn(options: &ViewOptions) -> io::Result<(Child, Receiver<String>)> {
    let mut child = command(&options.program, &options.root)
        .args(&options.arguments)
        .stdout(Stdio::piped())
        .spawn()?;
    let (sender, lines) = sync_channel(WAITING_LINES);
    if let Some(stdout) = child.stdout.take() {
        let take = move |line: &str| drop(sender.try_send(line.to_owned()));
        forward_lines("semidense-view", stdout, take)?;
    }
    if let Some(stderr) = child.stderr.take() {
        let mut log = options.log.clone();
        forward_lines("semidense-view-log", stderr, move |line| {
            drop(log.write_all(format!("live page: {line}\n").as_bytes()));
        })?;
    }
    Ok((child, lines))
}
