//! Opens a source by its name: recordings by themselves, the simulator with its configuration.

use std::path::Path;

use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::{SceneKind, SimulatorParams};
use crate::capture::source::{FrameSource, SourceError, SourceName};
use crate::slam::parameter::ParameterError;

/// Why a source cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenSourceError {
    /// The recording or camera.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The simulator's configuration.
    #[error("simulator: {0}")]
    Simulator(#[from] ParameterError),
    /// The simulator has no such scene.
    #[error("sim:{0}: there is no such scene; scenes are room, plane and corridor")]
    Scene(String),
    /// The simulator has its camera in the configuration.
    #[error("sim: takes no rig; set its camera under [simulator] in the configuration")]
    RigWithSimulator,
}

/// Opens the source `name`. `rig` wins over the calibration that a recording brings.
pub fn open_source(
    name: &SourceName,
    rig: Option<&Path>,
    simulator: &SimulatorParams,
) -> Result<Box<dyn FrameSource>, OpenSourceError> {
    let SourceName::Simulator { scene } = name else {
        return Ok(crate::capture::source::open(name, rig)?);
    };
    if rig.is_some() {
        return Err(OpenSourceError::RigWithSimulator);
    }
    let mut params = simulator.clone();
    match scene.as_deref() {
        None => {}
        Some("room") => params.scene = SceneKind::Room,
        Some("plane") => params.scene = SceneKind::Plane,
        Some("corridor") => params.scene = SceneKind::Corridor,
        Some(other) => return Err(OpenSourceError::Scene(other.to_owned())),
    }
    Ok(Box::new(Simulator::new(params)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(name: &str, rig: Option<&Path>) -> String {
        let name: SourceName = name.parse().unwrap();
        open_source(&name, rig, &SimulatorParams::default()).err().unwrap().to_string()
    }

    #[test]
    fn what_cannot_be_opened_says_why() {
        assert!(error("sim:moon", None).contains("room, plane and corridor"));
        assert!(error("sim", Some(Path::new("rig.toml"))).contains("takes no rig"));
        assert!(error("tum:/nowhere", None).contains("/nowhere"));
    }

    #[test]
    fn the_simulator_opens_without_rendering() {
        let name: SourceName = "sim:plane".parse().unwrap();
        let source = open_source(&name, None, &SimulatorParams::default()).unwrap();
        assert_eq!(source.num_frames(), Some(600));
        assert_eq!(source.ground_truth().len(), 600);
    }
}
