//! How a run is shown: a bar on a terminal, plain lines otherwise.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::command::print::note;
use crate::service::supervisor::RunProgress;
use crate::slam::pose::TrackingState;

/// Time between two plain lines: readable, and a long run does not fill a log.
const LINE_PERIOD: Duration = Duration::from_secs(2);

/// Shows the progress of a run.
#[derive(Debug)]
pub struct RunDisplay {
    bar: Option<ProgressBar>,
    is_quiet: bool,
    is_running: bool,
    last_line: Option<Instant>,
}

impl RunDisplay {
    /// Quiet, or what suits the terminal.
    pub fn new(is_quiet: bool) -> Self {
        let bar = (!is_quiet && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(0);
            let style = ProgressStyle::with_template("{prefix:9} {bar:40} {pos}/{len} {msg}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar
        });
        Self { bar, is_quiet, is_running: false, last_line: None }
    }

    /// Shows how far it is.
    pub fn show(&mut self, progress: &RunProgress) {
        let (prefix, done, total, message) = match *progress {
            RunProgress::Preparing(done, total) => ("preparing", done, total, String::new()),
            RunProgress::Running { frames, total, state, keyframes } => {
                let state = state.map_or("", state_name);
                ("running", frames, total, format!("{state}, {keyframes} keyframes"))
            }
        };
        let is_running = matches!(progress, RunProgress::Running { .. });
        let has_changed = std::mem::replace(&mut self.is_running, is_running) != is_running;
        if let Some(bar) = &self.bar {
            bar.set_prefix(prefix);
            bar.set_length(total);
            bar.set_position(done);
            bar.set_message(message);
            return;
        }
        let due = self.last_line.is_none_or(|last| last.elapsed() >= LINE_PERIOD);
        if !self.is_quiet && total > 0 && (due || has_changed) {
            note(&format!("{prefix} {done}/{total} {message}"));
            self.last_line = Some(Instant::now());
        }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.iter().for_each(ProgressBar::finish_and_clear);
    }
}

/// One word for a state.
pub fn state_name(state: TrackingState) -> &'static str {
    match state {
        TrackingState::Initializing => "initializing",
        TrackingState::Tracking => "tracking",
        TrackingState::Degraded(_) => "degraded",
        TrackingState::Lost(_) => "lost",
    }
}
