//! The tracking result of one frame: pose, covariance, status and quality.

use nalgebra::{Matrix6, Vector3};

use crate::slam::frame::FrameView;
use crate::slam::geometry::se3::SE3;

/// The keyframe id before the mapper has created the first keyframe.
pub const NO_KEYFRAME: u64 = u64::MAX;

/// Variance of an unknown quantity, in its units² or radians²: large and finite.
pub const UNKNOWN_VARIANCE: f64 = 1.0e6;

/// Tracking status of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrackingState {
    /// No map that can be trusted yet; the pose is a working value.
    Initializing,
    /// The pose is good to its covariance.
    Tracking,
    /// The pose is usable, but worse than it should be.
    Degraded(DegradedReason),
    /// The pose is not claimed.
    Lost(LostReason),
}

impl TrackingState {
    /// The names of the states, in the order of their codes.
    pub const NAMES: [&'static str; 4] = ["initializing", "tracking", "degraded", "lost"];

    /// Its index in [`Self::NAMES`].
    pub fn index(self) -> usize {
        match self {
            Self::Initializing => 0,
            Self::Tracking => 1,
            Self::Degraded(_) => 2,
            Self::Lost(_) => 3,
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        Self::NAMES[self.index()]
    }

    /// Whether the pose is claimed: Tracking or Degraded.
    pub fn is_tracked(self) -> bool {
        matches!(self, Self::Tracking | Self::Degraded(_))
    }
}

/// Why a pose is worse than it should be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DegradedReason {
    /// The deadline came before the finest level was solved.
    Budget,
    /// Few of the keyframe's points are in view.
    LowOverlap,
    /// The residuals are larger than noise and depth variance explain.
    HighResidual,
    /// Frames are missing between this one and the previous one.
    Gap,
    /// The known depth is out of view: the last view with a pose holds the rotation, and the translation if small.
    Turning,
}

/// Why a pose is not claimed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LostReason {
    /// The iteration left the image or became non-finite.
    Diverged,
    /// Too few of the points match.
    TooFewInliers,
    /// The keyframe has no usable points.
    NoPoints,
    /// The frame has another size than the keyframe, or no contrast at all.
    UnusableFrame,
    /// The mapper found the map inconsistent.
    MapRejected,
}

/// Affine brightness between two images: `I_current ≈ eᵃ I_keyframe + b`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Brightness {
    /// Logarithm of the gain.
    pub a: f64,
    /// Offset, grey levels.
    pub b: f64,
}

/// Figures for the quality of an alignment.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Quality {
    /// Share of the keyframe's points that fall inside the frame, 0 to 1.
    pub in_view_ratio: f64,
    /// Share of the points compared (in view and not clipped by the sensor) whose residual is explained by noise and
    /// depth variance, 0 to 1.
    pub inlier_ratio: f64,
    /// Root mean square of residual over its standard deviation, Huber-weighted; 1 if the model is right.
    pub whitened_rmse: f64,
    /// Root mean square residual of the points compared, grey levels.
    pub residual_rmse: f64,
    /// Iterations, all levels.
    pub iterations: u32,
    /// Finest pyramid level that was solved: a coarser one than usual where the frame was cut short
    /// by its deadline, the number of all levels where none was.
    pub finest_level: u32,
    /// Points compared.
    pub points: u32,
    /// Mean squared optical flow from the keyframe to this frame, pixels² at level 0.
    pub mean_squared_flow: f64,
    /// Standard deviation of an unobserved displacement of the whole image, pixels at level 0: from the displacement of
    /// its tiles against each other. The covariance includes it.
    pub displacement_px: f64,
}

/// The camera's velocity at the stamp of a frame: its mean since the previous frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Velocity {
    /// Along the camera's own axes (x right, y down, z forward), world units per second.
    pub linear: Vector3<f64>,
    /// About the camera's own axes, radians per second.
    pub angular: Vector3<f64>,
    /// Upper triangle, row-major, of the covariance of (linear, angular), (world units/s)² and (rad/s)²: errors of both
    /// poses, and the possible change of the velocity within the interval, without the error of the map's scale.
    pub covariance: [f64; 21],
}

/// Tracking result of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseEstimate {
    /// Sequence of the frame.
    pub sequence: u64,
    /// Stamp of the frame, nanoseconds.
    pub capture_nanos: i64,
    /// Epoch of the map that the pose belongs to.
    pub epoch: u32,
    /// Revision of the keyframe that it was tracked on.
    pub revision: u64,
    /// Keyframe that it was tracked on, [`NO_KEYFRAME`] before the first.
    pub keyframe_id: u64,
    /// Tracking status.
    pub state: TrackingState,
    /// Number of corrections of the map when that keyframe was published.
    pub map_revision: u64,
    /// Odometry pose; never jumps within an epoch, except where a hold ([`DegradedReason::Turning`]) ends.
    pub world_from_camera: SE3,
    /// Pose in the map, the best estimate; jumps where the map is corrected.
    pub map_from_camera: SE3,
    /// Pose relative to the keyframe, translation in keyframe units.
    pub keyframe_from_camera: SE3,
    /// Upper triangle, row-major, of the covariance of the left increment (translation, rotation) of
    /// `current_from_keyframe`, keyframe units and radians: noise of single points, errors common to the keyframe's
    /// whole depth, and displacements of the whole image
    /// ([`covariance_floor`](crate::slam::tracker::covariance_floor)). This is the published one. It does not include
    /// the uncertainty of the keyframe's own pose.
    pub covariance: [f64; 21],
    /// Upper triangle, row-major, of the covariance of the left increment (translation, rotation) of `map_from_camera`,
    /// map units and radians ([`place_covariance`](crate::slam::keyframe_pose_covariance)): the uncertainty of the
    /// keyframe's pose plus `covariance`. Relative to the first keyframe of the epoch.
    pub map_covariance: [f64; 21],
    /// Like `covariance`, but of the alignment alone, as if the errors of distant points were independent: too small
    /// for fusion. The mapper weights matches with it.
    pub alignment_covariance: [f64; 21],
    /// The camera's velocity; `None` where this frame or the previous one has no pose, or they belong to different
    /// epochs, while a view is held ([`DegradedReason::Turning`]), and where the frame repeats the previous image.
    pub velocity: Option<Velocity>,
    /// Brightness against the keyframe.
    pub brightness: Brightness,
    /// Figures of the alignment.
    pub quality: Quality,
    /// Whether the tracker requests a new keyframe at this frame.
    pub proposes_keyframe: bool,
}

impl PoseEstimate {
    /// The estimate before anything is known about `frame`: at the world's origin, not claimed.
    pub fn unknown(frame: &FrameView<'_>) -> Self {
        Self::unknown_at(frame.sequence, frame.capture_nanos)
    }

    /// The same for a frame with this sequence and stamp.
    pub fn unknown_at(sequence: u64, capture_nanos: i64) -> Self {
        Self {
            sequence,
            capture_nanos,
            epoch: 0,
            revision: 0,
            keyframe_id: NO_KEYFRAME,
            state: TrackingState::Initializing,
            map_revision: 0,
            world_from_camera: SE3::identity(),
            map_from_camera: SE3::identity(),
            keyframe_from_camera: SE3::identity(),
            covariance: [0.0; 21],
            map_covariance: [0.0; 21],
            alignment_covariance: [0.0; 21],
            velocity: None,
            brightness: Brightness::default(),
            quality: Quality::default(),
            proposes_keyframe: false,
        }
    }
}

/// The upper triangle of a symmetric matrix, row by row.
pub(in crate::slam) fn upper_triangle(entry: impl Fn(usize, usize) -> f64) -> [f64; 21] {
    let mut entries = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    std::array::from_fn(|_| entries.next().map_or(0.0, |(row, column)| entry(row, column)))
}

/// The symmetric matrix of an upper triangle, row by row.
pub(in crate::slam) fn full_covariance(upper_triangle: &[f64; 21]) -> Matrix6<f64> {
    let mut entries = upper_triangle.iter();
    let mut matrix = Matrix6::zeros();
    for row in 0..6 {
        for column in row..6 {
            let entry = entries.next().copied().unwrap_or_default();
            (matrix[(row, column)], matrix[(column, row)]) = (entry, entry);
        }
    }
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_upper_triangle_is_a_full_matrix() {
        let triangle = std::array::from_fn(|i| i as f64);
        let full = full_covariance(&triangle);
        assert_eq!((full[(0, 5)], full[(5, 0)], full[(1, 1)], full[(5, 5)]), (5.0, 5.0, 6.0, 20.0));
        assert_eq!(upper_triangle(|row, column| full[(row, column)]), triangle);
    }
}
