//! A recording rendered for a test.

use std::path::PathBuf;

use crate::support::{Rig, finish};

/// A recording of `frames` small simulated frames, in TUM layout.
pub fn rendered(rig: &Rig, frames: usize) -> PathBuf {
    let folder = rig.folder().join("recording");
    let mut command = rig.command(&["simulate", "--force", "--output"]);
    command.arg(&folder).args(["--frames", &frames.to_string()]);
    command.args(["--width", "160", "--height", "120", "--focal", "131"]);
    let ended = finish(command);
    assert!(ended.status.success(), "{}", ended.stderr);
    folder
}
