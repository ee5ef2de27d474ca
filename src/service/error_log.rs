//! Standard error for a process that must not wait for its reader: a thread writes the lines, and lines that do not fit
//! into its queue are counted and dropped.

use std::io::{self, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crossbeam::channel::{Receiver, SendTimeoutError, Sender, bounded};
use tracing_subscriber::fmt::MakeWriter;

/// Lines that wait while standard error accepts none: minutes of a usual log, at most a few megabytes.
const WAITING_LINES: usize = 4096;

enum Entry {
    Line(Vec<u8>),
    /// Answered once everything before it is written.
    Mark(Sender<()>),
}

/// Writes lines to standard error without ever waiting for it. Clones share one thread.
#[derive(Debug, Clone)]
pub struct ErrorLog {
    entries: Sender<Entry>,
    dropped: Arc<AtomicU64>,
}

impl ErrorLog {
    /// Starts the thread that writes to standard error; it ends with the last clone.
    pub fn start() -> io::Result<Self> {
        let (log, entries) = Self::with_room(WAITING_LINES);
        let thread = std::thread::Builder::new().name("semidense-log".to_owned());
        thread.spawn(move || write_all(&entries, io::stderr()))?;
        Ok(log)
    }

    fn with_room(lines: usize) -> (Self, Receiver<Entry>) {
        let (entries, receiver) = bounded(lines);
        (Self { entries, dropped: Arc::default() }, receiver)
    }

    /// Waits up to `longest` until everything so far is written; returns whether it is.
    pub fn wait_written(&self, longest: Duration) -> bool {
        let (done, is_done) = bounded(1);
        match self.entries.send_timeout(Entry::Mark(done), longest) {
            Ok(()) => is_done.recv_timeout(longest).is_ok(),
            Err(SendTimeoutError::Timeout(_) | SendTimeoutError::Disconnected(_)) => false,
        }
    }

    /// Lines dropped so far.
    pub fn dropped_lines(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// One call writes one or more whole lines, with their line ends.
impl Write for ErrorLog {
    fn write(&mut self, text: &[u8]) -> io::Result<usize> {
        if self.entries.try_send(Entry::Line(text.to_vec())).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        Ok(text.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl MakeWriter<'_> for ErrorLog {
    type Writer = Self;

    fn make_writer(&self) -> Self {
        self.clone()
    }
}

fn write_all(entries: &Receiver<Entry>, mut to: impl Write) {
    for entry in entries {
        match entry {
            // A closed terminal is no reason to stop.
            Entry::Line(line) => drop(to.write_all(&line)),
            Entry::Mark(done) => drop(done.send(())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_beyond_the_queue_are_counted_and_the_others_keep_their_order() {
        let (mut log, entries) = ErrorLog::with_room(2);
        for line in ["one\n", "two\n", "three\n"] {
            log.write_all(line.as_bytes()).unwrap();
        }
        assert_eq!(log.dropped_lines(), 1);
        assert!(!log.wait_written(Duration::from_millis(1)), "nobody writes");
        drop(log);
        let mut written = Vec::new();
        write_all(&entries, &mut written);
        assert_eq!(written, b"one\ntwo\n");
    }
}
