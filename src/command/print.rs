//! What a command prints. Unlike `println!` it does not panic when the reader has gone away.

use std::error::Error;
use std::io::{self, Write};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Serialize;

/// How long a line waits for a standard error that takes nothing: stopped by Ctrl-S, or a pipe that nobody reads.
const LONGEST_WAIT: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };

/// Standard output takes no more.
#[derive(Debug, thiserror::Error)]
#[error("cannot write to standard output: {0}; redirect it to a place with room")]
pub struct PrintError(#[from] io::Error);

impl PrintError {
    /// Whether the reader had enough, like `head`: no failure of the command.
    pub fn is_reader_gone(&self) -> bool {
        self.0.kind() == io::ErrorKind::BrokenPipe
    }
}

/// Prints the text on standard output at once.
pub fn print(text: &str) -> Result<(), PrintError> {
    let mut stdout = io::stdout().lock();
    stdout.write_all(text.as_bytes())?;
    Ok(stdout.flush()?)
}

/// Prints `value` as JSON where that is asked for, else in words.
pub fn print_as<T: Serialize>(
    json: bool,
    value: &T,
    in_words: impl FnOnce(&T) -> String,
) -> Result<(), Box<dyn Error>> {
    let text = match json {
        true => format!("{}\n", serde_json::to_string_pretty(value)?),
        false => in_words(value),
    };
    Ok(print(&text)?)
}

/// Prints a line on standard error; nobody is left to be told when that fails. Nothing waits forever for
/// somebody to read it.
pub fn note(line: &str) {
    let stderr = io::stderr();
    let mut ready = [PollFd::new(&stderr, PollFlags::OUT)];
    // An error, or somebody who has gone, is met by the write.
    if !matches!(poll(&mut ready, Some(&LONGEST_WAIT)), Ok(0)) {
        let _ = (&stderr).write_all(format!("{line}\n").as_bytes());
    }
}
