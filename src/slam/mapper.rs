//! The recipe of a map step: observe depth, regularise, choose keyframes, propagate.

use serde::{Deserialize, Serialize};

use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::buffer::Image;
use crate::slam::keyframe::Keyframe;
use crate::slam::parameter::ParameterError;
use crate::slam::pose::PoseEstimate;

/// Tuning of the mapper.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapperParams {}

impl MapperParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        Ok(())
    }
}

/// What changed in one step, and what has to be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StepOutcome {
    /// The keyframe in force was made in this step: publish its image too.
    pub keyframe_created: bool,
    /// The keyframe in force has other depth than before: publish it.
    pub keyframe_changed: bool,
    /// A keyframe's pose changed, or one was added: publish the graph.
    pub graph_changed: bool,
}

/// All keyframes of one epoch, with their final depth.
#[derive(Debug, Clone, Default)]
pub struct Map {
    /// Keyframes in order of creation; the last is the one in force.
    pub keyframes: Vec<Keyframe>,
}

/// Keeps the map.
#[derive(Debug)]
pub struct Mapper {
    map: Map,
}

impl Mapper {
    /// A mapper for images of `intrinsics`, with an empty map.
    pub fn new(_intrinsics: Intrinsics, params: MapperParams) -> Result<Self, ParameterError> {
        params.validate()?;
        Ok(Self { map: Map::default() })
    }

    /// Takes in one tracked frame. `sensor_depth` (metres, 0 where none) initialises the depth of
    /// new keyframes where a depth camera may be used.
    pub fn step(
        &mut self,
        _frame: &FrameView<'_>,
        _pose: &PoseEstimate,
        _sensor_depth: Option<&Image<f32>>,
    ) -> StepOutcome {
        StepOutcome::default()
    }

    /// The keyframe in force, once there is one.
    pub fn keyframe(&self) -> Option<&Keyframe> {
        self.map.keyframes.last()
    }

    /// Every keyframe.
    pub fn map(&self) -> &Map {
        &self.map
    }
}
