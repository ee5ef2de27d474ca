//! What a command prints. Unlike `println!` it does not panic when the reader has gone away.

use std::io::{self, Write};

/// Standard output takes no more.
#[derive(Debug, thiserror::Error)]
#[error("standard output: {0}; write it to a place with room")]
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

/// Prints a line on standard error; nobody is left to be told when that fails.
pub fn note(line: &str) {
    let _ = writeln!(io::stderr(), "{line}");
}
