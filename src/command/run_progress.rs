//! Progress of a run: a bar on a terminal, plain lines otherwise. A separate thread prints it, so that the
//! supervisor never waits for a stopped terminal or a pipe that is not read.

use std::io::{self, IsTerminal};
use std::time::Instant;

use indicatif::ProgressBar;

use crate::command::print::note;
use crate::command::progress::{LINE_PERIOD, style};
use crate::service::progress_thread::ProgressThread;
use crate::service::run_progress::RunProgress;
use crate::slam::counted::counted;
use crate::slam::pose::TrackingState;

/// Starts the thread that shows the progress of a run: nothing if `is_quiet`, else what suits the terminal.
pub fn start_display(is_quiet: bool) -> io::Result<ProgressThread> {
    let mut shown = Display::new(is_quiet);
    ProgressThread::start(move |progress| match progress {
        Some(progress) => shown.show(progress),
        None => shown.finish(),
    })
}

/// What the user is shown.
#[derive(Debug)]
struct Display {
    bar: Option<ProgressBar>,
    is_quiet: bool,
    /// When the last plain line was printed, or the run started.
    last_line: Instant,
    /// What the run waits for, once it has been printed.
    waits_for: Option<String>,
}

/// Template for a source with a known number of frames.
const WITH_END: &str = "{prefix:9} {bar:40} {pos}/{len} {msg}";
/// Template for a camera.
const WITHOUT_END: &str = "{prefix:9} {pos} frames, {msg}";

impl Display {
    fn new(is_quiet: bool) -> Self {
        let is_shown = !is_quiet && std::io::stderr().is_terminal();
        let bar = is_shown.then(|| ProgressBar::new(0).with_style(style(WITH_END)));
        Self { bar, is_quiet, last_line: Instant::now(), waits_for: None }
    }

    fn show(&mut self, progress: &RunProgress) {
        let (prefix, done, total, message) = match progress {
            RunProgress::Waiting(reason) => return self.show_waiting(reason),
            RunProgress::Preparing(done, total) => ("preparing", *done, *total, String::new()),
            RunProgress::Running { frames, total, state, keyframes } => {
                let state = state.map_or("", TrackingState::name);
                (
                    "running",
                    *frames,
                    *total,
                    format!("{state}, {}", counted(*keyframes, "keyframe")),
                )
            }
        };
        self.waits_for = None;
        if let Some(bar) = &self.bar {
            bar.set_style(style(if total == 0 { WITHOUT_END } else { WITH_END }));
            bar.set_prefix(prefix);
            bar.set_length(total);
            bar.set_position(done);
            bar.set_message(message);
            return;
        }
        let has_work = total > 0 || matches!(progress, RunProgress::Running { .. });
        if !self.is_quiet && has_work && self.last_line.elapsed() >= LINE_PERIOD {
            // The number of frames that a camera will deliver is unknown.
            let of = if total > 0 { format!("/{total}") } else { String::new() };
            note(format!("{prefix} {done}{of} {message}").trim_end());
            self.last_line = Instant::now();
        }
    }

    /// Prints once that the run waits for a camera, and why.
    fn show_waiting(&mut self, reason: &str) {
        if self.waits_for.as_deref() == Some(reason) {
            return;
        }
        self.waits_for = Some(reason.to_owned());
        let line = format!("waiting: {reason}; Ctrl-C stops the run");
        match &self.bar {
            Some(bar) => bar.println(line),
            // Not progress: without it a quiet run would seem to hang.
            None => note(&line),
        }
    }

    /// Removes the bar.
    fn finish(&self) {
        self.bar.iter().for_each(ProgressBar::finish_and_clear);
    }
}
