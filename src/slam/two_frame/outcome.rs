//! What a start comes to.

use nalgebra::Matrix6;

use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;
use crate::slam::two_frame::evidence::{Evidence, Waiting};

/// Why a start is given up; the frame that showed it is the new first frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// Too many frames without proof.
    TooLong,
    /// The frames no longer show what the first one does.
    Mismatch,
    /// The frame has another size than the intrinsics say. Nothing is begun on it.
    WrongSize,
}

/// Where a start stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InitState {
    /// Not proven yet, and by what.
    Waiting(Waiting),
    /// Parallax is proven: pose and depths can be used.
    Proven,
    /// Given up and begun again.
    Failed(Failure),
}

/// What one frame came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitOutcome {
    /// Where the start stands.
    pub state: InitState,
    /// The figures behind it.
    pub evidence: Evidence,
    /// How many frames after the first one this frame is; 0 where it is the new first one itself.
    pub frames: u32,
    /// Pose of the frame, in units in which the points' mean inverse depth is 1.
    pub first_from_current: SE3,
    /// Brightness of the frame against the first.
    pub brightness: Brightness,
    /// Covariance of the left increment (translation, rotation) of its inverse, with the length of the translation
    /// held: the common errors of the depths come from it.
    pub pose_covariance: Matrix6<f64>,
    /// How far the rotation that explains the frame best moves the middle of the image, pixels.
    pub rotation_px: f64,
}

/// The depth of a pixel of the first frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitialDepth {
    /// Column.
    pub u: u16,
    /// Row.
    pub v: u16,
    /// Inverse depth; the mean over the points is 1.
    pub inverse_depth: f32,
    /// Its variance.
    pub variance: f32,
}
