//! A frame from which a start can continue when its first frame is out of view.

use nalgebra::Vector3;

use crate::slam::two_frame::evidence::{EvidenceParams, Waiting};
use crate::slam::two_frame::outcome::{InitOutcome, InitState};

/// A frame of a camera that moves by a whole baseline from one frame to the next: later frames show the same as this
/// one, but soon no longer what the first one does.
#[derive(Debug)]
pub(super) struct Waypoint {
    /// Its image.
    pub(super) pixels: Vec<u8>,
    /// Direction in which the camera arrived there, in its own axes.
    pub(super) heading: Vector3<f64>,
    /// Consecutive frames up to this one that prove the parallax.
    pub(super) confirmed: u32,
    /// Least median residual up to this frame, grey levels: the camera's noise.
    pub(super) least_residual: f64,
}

impl Waypoint {
    /// Whether a start can only continue from here after a frame that proves nothing: what was proven here is no longer
    /// seen, or the first frame is out of view.
    pub(super) fn is_needed(&self, outcome: &InitOutcome, params: &EvidenceParams) -> bool {
        // A camera that has returned, or never moved.
        let is_still = matches!(
            outcome.state,
            InitState::Waiting(Waiting::Significance | Waiting::Translation)
        );
        let is_out_of_view = outcome.evidence.visible_ratio < params.min_visible_ratio
            || outcome.evidence.translation > params.max_translation;
        !is_still && (self.confirmed > 0 || is_out_of_view)
    }
}
