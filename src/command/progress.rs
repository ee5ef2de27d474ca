//! Progress of long work: a bar on a terminal, plain lines otherwise; on stderr, so that stdout holds only the result.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::command::print::note;

/// Time between two plain lines: the log of a long run stays short, yet shows that it continues.
pub const LINE_PERIOD: Duration = Duration::from_secs(5);

/// Style of a progress bar.
pub fn style(template: &str) -> ProgressStyle {
    ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Progress of one task.
#[derive(Debug)]
pub struct Progress {
    what: &'static str,
    total: Option<usize>,
    bar: Option<ProgressBar>,
    /// When the last plain line was printed, or the task started.
    last_line: Cell<Instant>,
}

impl Progress {
    /// Progress of `what` (one or two words), with `total` steps if known.
    pub fn new(what: &'static str, total: Option<usize>) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let (bar, template) = match total {
                Some(total) => (
                    ProgressBar::new(total as u64),
                    "{prefix} [{bar:32}] {pos}/{len} {elapsed} (left {eta}) {msg}",
                ),
                None => (ProgressBar::no_length(), "{prefix} {spinner} {pos} {elapsed} {msg}"),
            };
            bar.with_style(style(template)).with_prefix(what)
        });
        Self { what, total, bar, last_line: Cell::new(Instant::now()) }
    }

    /// Reports that `done` steps are finished; `detail` describes the current state.
    pub fn update(&self, done: usize, detail: &str) {
        if let Some(bar) = &self.bar {
            bar.set_position(done as u64);
            if bar.message() != detail {
                bar.set_message(detail.to_owned());
            }
            return;
        }
        if self.last_line.get().elapsed() >= LINE_PERIOD {
            self.last_line.set(Instant::now());
            let of = self.total.map(|total| format!("/{total}")).unwrap_or_default();
            let separator = if detail.is_empty() { "" } else { ", " };
            note(&format!("{} {done}{of}{separator}{detail}", self.what));
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
