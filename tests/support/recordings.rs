//! Recordings of real and rendered cameras, if these are on the machine.

use std::io::Write;
use std::path::PathBuf;

/// The folder of a development recording; if it does not exist, `None`, and a line that reports this.
pub fn recording(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SEMIDENSE_DATA").map_or_else(
        || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let folder = root.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    let skipped = folder.display();
    say(&format!("skipped: {skipped} is not there; SEMIDENSE_DATA names its parent"));
    None
}

/// Prints a line even for a passing test, as the runner swallows `println!`.
pub fn say(line: &str) {
    // A closed standard error must not fail a test.
    let _ = writeln!(std::io::stderr(), "{line}");
}
