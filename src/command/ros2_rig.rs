//! Rig of a ROS 2 camera for which none is named: its CameraInfo, fetched by `semidense-bridge`.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::command::bridge::{BridgeError, bridge};
use crate::command::print::note;
use crate::service::shutdown::Shutdown;
use crate::wire::port::{WaitError, wait};

/// Interval at which the bridge is checked for its end.
const POLL_PERIOD: Duration = Duration::from_millis(50);

/// Why no rig could be obtained.
#[derive(Debug, thiserror::Error)]
pub enum Ros2RigError {
    /// The bridge is not installed.
    #[error(transparent)]
    NoBridge(#[from] BridgeError),
    /// The bridge cannot be started or waited for.
    #[error("{}: {source}", program.display())]
    Program {
        /// The program.
        program: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The bridge failed and printed the reason.
    #[error("ros2:{0}: the camera's calibration is unknown; name it with --rig FILE")]
    Failed(String),
    /// Waiting failed.
    #[error(transparent)]
    Wait(#[from] WaitError),
    /// A signal arrived first.
    #[error("interrupted")]
    Interrupted,
}

/// Waits for the CameraInfo that accompanies `topic` and writes it as a rig file to `folder`.
pub fn fetch(topic: &str, folder: &Path, shutdown: &Shutdown) -> Result<PathBuf, Ros2RigError> {
    let program = bridge(&format!("run ros2:{topic}"))?;
    let path = folder.join("rig.toml");
    let failed = |source| Ros2RigError::Program { program: program.clone(), source };
    let mut child = Command::new(&program)
        .args(["ros2-camera", topic, "--write-rig"])
        .arg(&path)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .spawn()
        .map_err(failed)?;
    let status = loop {
        if let Some(status) = child.try_wait().map_err(failed)? {
            break status;
        }
        if shutdown.is_requested() {
            child.kill().and_then(|()| child.wait()).map_err(failed)?;
            return Err(Ros2RigError::Interrupted);
        }
        wait(&[], Some(shutdown.descriptor()), POLL_PERIOD)?;
    };
    if !status.success() {
        return Err(Ros2RigError::Failed(topic.to_owned()));
    }
    note(&format!(
        "no rig was named: using one made from the camera's CameraInfo, {}",
        path.display()
    ));
    Ok(path)
}
