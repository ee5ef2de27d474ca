//! Opens a source by its name, the simulator with its parameters.

use std::path::Path;

use serde::Deserialize;
use serde::de::IntoDeserializer;
use serde::de::value::Error as NameError;

use crate::capture::simulator::Simulator;
use crate::capture::simulator::params::{SceneKind, SimulatorParams};
use crate::capture::source::{FrameSource, SourceError, SourceName, open};
use crate::slam::parameter::ParameterError;

/// Why a source cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum OpenSourceError {
    /// A recording or camera.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A scene that the simulator does not have; the message lists those it has.
    #[error("source `sim:{scene}`: {problem}")]
    Scene {
        /// The name as it was given.
        scene: String,
        /// What is wrong with it.
        problem: NameError,
    },
    /// A parameter of the simulator out of its range.
    #[error("configuration: {0}")]
    Parameter(#[from] ParameterError),
}

/// Opens `name`. A scene in the name wins over the one of `simulator`; `rig` wins over the
/// calibration that a recording brings.
pub fn open_source(
    name: &SourceName,
    rig: Option<&Path>,
    mut simulator: SimulatorParams,
) -> Result<Box<dyn FrameSource>, OpenSourceError> {
    let SourceName::Simulator { scene } = name else {
        return Ok(open(name, rig)?);
    };
    if let Some(scene) = scene {
        simulator.scene = SceneKind::deserialize(scene.as_str().into_deserializer())
            .map_err(|problem| OpenSourceError::Scene { scene: scene.clone(), problem })?;
    }
    Ok(Box::new(Simulator::new(simulator).map_err(|error| error.within("simulator"))?))
}
