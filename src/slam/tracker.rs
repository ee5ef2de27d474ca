//! The recipe of a frame: predict, align to the keyframe coarse to fine, judge, report.

use serde::{Deserialize, Serialize};

use crate::slam::alignment::reference::Reference;
use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::parameter::ParameterError;
use crate::slam::pose::{Brightness, NO_KEYFRAME, PoseEstimate, Quality, TrackingState};

/// Tuning of the tracker.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackerParams {}

impl TrackerParams {
    /// Checks every value.
    pub fn validate(&self) -> Result<(), ParameterError> {
        Ok(())
    }
}

/// Tracks frames against the reference in force.
#[derive(Debug)]
pub struct Tracker {
    reference: Option<Box<Reference>>,
}

impl Tracker {
    /// A tracker for images of `intrinsics`, without a keyframe yet.
    pub fn new(_intrinsics: Intrinsics, params: TrackerParams) -> Result<Self, ParameterError> {
        params.validate()?;
        Ok(Self { reference: None })
    }

    /// Puts a prepared reference in force and gives back the one before, for its memory.
    pub fn adopt(&mut self, reference: Box<Reference>) -> Option<Box<Reference>> {
        self.reference.replace(reference)
    }

    /// Tracks one frame. `budget` is asked before each iteration with the pyramid level it would
    /// run on and says whether there is time for it (always yes in lockstep and replay).
    pub fn track(
        &mut self,
        frame: &FrameView<'_>,
        _budget: &mut dyn FnMut(usize) -> bool,
    ) -> PoseEstimate {
        PoseEstimate {
            sequence: frame.sequence,
            capture_nanos: frame.capture_nanos,
            epoch: 0,
            revision: 0,
            keyframe_id: self.reference.as_ref().map_or(NO_KEYFRAME, |r| r.keyframe_id()),
            state: TrackingState::Initializing,
            world_from_camera: SE3::identity(),
            keyframe_from_camera: SE3::identity(),
            covariance: [0.0; 21],
            brightness: Brightness::default(),
            quality: Quality::default(),
            proposes_keyframe: false,
        }
    }
}
