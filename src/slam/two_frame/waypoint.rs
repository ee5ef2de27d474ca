//! Where a start can go on when its first frame is out of view.

use nalgebra::Vector3;

/// A frame of a camera that moves by a whole baseline from one frame to the next: what follows shows the same as this
/// frame, but no longer what the first one does.
#[derive(Debug)]
pub(super) struct Waypoint {
    /// Its image.
    pub(super) pixels: Vec<u8>,
    /// Direction in which the camera went there, in its own axes.
    pub(super) heading: Vector3<f64>,
    /// Frames in a row up to this one that prove the parallax.
    pub(super) confirmed: u32,
}
