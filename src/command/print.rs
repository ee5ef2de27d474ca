//! Output of commands. Unlike `println!`, it does not panic when the reader has closed the pipe.

use std::error::Error;
use std::io::{self, Write};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Serialize;

/// How long a line waits for a blocked standard error: stopped by Ctrl-S, or a pipe that is not read.
const LONGEST_WAIT: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };

/// Standard output cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to standard output: {0}; redirect it to a disk with free space")]
pub struct PrintError(#[from] io::Error);

impl PrintError {
    /// Whether the reader closed the pipe early, as `head` does: not a failure of the command.
    pub fn is_reader_gone(&self) -> bool {
        self.0.kind() == io::ErrorKind::BrokenPipe
    }
}

/// Prints the text to standard output and flushes it.
pub fn print(text: &str) -> Result<(), PrintError> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    Ok(stdout.flush()?)
}

/// Prints the outcome of a command: its exit code is the same where the reader has closed the pipe.
pub fn print_outcome(text: &str) -> Result<(), PrintError> {
    match print(text) {
        Err(error) if error.is_reader_gone() => Ok(()),
        printed => printed,
    }
}

/// Prints `value`, the outcome of a command, as JSON if `json`, else as text.
pub fn print_as<T: Serialize>(
    json: bool,
    value: &T,
    in_words: impl FnOnce(&T) -> String,
) -> Result<(), Box<dyn Error>> {
    let text = match json {
        true => format!("{}\n", serde_json::to_string_pretty(value)?),
        false => in_words(value),
    };
    Ok(print_outcome(&text)?)
}

/// Prints a line to standard error and ignores failure, which could not be reported. Never waits indefinitely
/// for a reader.
pub fn note(line: &str) {
    let stderr = io::stderr();
    let mut ready = [PollFd::new(&stderr, PollFlags::OUT)];
    // On an error or a closed pipe, the write itself fails.
    if !matches!(poll(&mut ready, Some(&LONGEST_WAIT)), Ok(0)) {
        let _ = (&stderr).write_all(format!("{line}\n").as_bytes());
    }
}
