//! Rig of a ROS 2 camera for which none is named: its CameraInfo, fetched by `semidense-bridge`.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::command::bridge::bridge;
use crate::command::print::note;
use crate::service::shutdown::Shutdown;
use crate::wire::port::wait;

/// Interval at which the bridge is checked for its end.
const POLL_PERIOD: Duration = Duration::from_millis(50);

/// Waits for the CameraInfo that accompanies `topic` and writes it as a rig file to `folder`; `None` if a signal
/// arrived first.
pub fn fetch(
    topic: &str,
    folder: &Path,
    shutdown: &Shutdown,
) -> Result<Option<PathBuf>, Box<dyn Error>> {
    let program = bridge(&format!("run ros2:{topic}"))?;
    let path = folder.join("rig.toml");
    let failed = |error: std::io::Error| format!("{}: {error}", program.display());
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
            return Ok(None);
        }
        wait(&[], Some(shutdown.descriptor()), POLL_PERIOD)?;
    };
    if !status.success() {
        let why = "the camera's calibration is unknown; name it with --rig FILE";
        return Err(format!("ros2:{topic}: {why}").into());
    }
    note(&format!(
        "no rig was named: using one made from the camera's CameraInfo, {}",
        path.display()
    ));
    Ok(Some(path))
}
