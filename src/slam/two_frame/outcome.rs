//! Results of a start.

use nalgebra::Matrix6;

use crate::slam::geometry::se3::SE3;
use crate::slam::pose::Brightness;
use crate::slam::two_frame::evidence::{Evidence, Waiting};

/// Why a start is given up; the frame that caused it is the new first frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// Too many frames without proof.
    TooLong,
    /// The frames no longer show what the first one does.
    Mismatch,
    /// The size of the frame differs from the intrinsics. It does not become a first frame.
    WrongSize,
}

/// The state of a start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InitState {
    /// Not proven yet, and the missing part.
    Waiting(Waiting),
    /// Parallax is proven: pose and depths can be used.
    Proven,
    /// Given up and restarted.
    Failed(Failure),
}

/// The outcome of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InitOutcome {
    /// The state of the start.
    pub state: InitState,
    /// The figures behind it.
    pub evidence: Evidence,
    /// Number of frames since the first one; 0 where this is the new first frame.
    pub frames: u32,
    /// Pose of the frame, in the unit for which the points' mean inverse depth is 1.
    pub first_from_current: SE3,
    /// Brightness of the frame against the first.
    pub brightness: Brightness,
    /// Covariance of the left increment (translation, rotation) of its inverse, with the length of the translation
    /// held: the source of the common errors of the depths.
    pub pose_covariance: Matrix6<f64>,
    /// Displacement of the image centre by the rotation that best explains the frame, pixels.
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
