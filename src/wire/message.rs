//! The layout of the messages in shared memory: `#[repr(C)]`, scalars only, every bit pattern valid.
//!
//! A `type_name` carries the version of its message; [`crate::wire::conversion`] converts to the types of `slam`,
//! checked.

use iceoryx2::prelude::ZeroCopySend;
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

use crate::slam::keyframe::DepthPoint;
use crate::slam::keyframe_pose_covariance::KEYFRAME_POSE_ENTRIES;

/// Size of a text in a message, in bytes; longer texts are truncated.
pub const TEXT_BYTES: usize = 192;
/// Size of the path in a request, in bytes: the longest path on Linux.
pub const PATH_BYTES: usize = 4096;
/// Buckets of a latency histogram.
pub const HISTOGRAM_BUCKETS: usize = 48;

/// A rigid transform: quaternion x, y, z, w, then translation x, y, z.
pub type RigidMessage = [f64; 7];
/// A similarity: a rigid transform, then the scale.
pub type SimilarityMessage = [f64; 8];

/// Header of `capture/frame`; the payload is the grey image.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.FrameHeader.v3")]
pub struct FrameHeader {
    /// Number of the frame at its source; a gap means missing frames.
    pub sequence: u64,
    /// Middle of the exposure, nanoseconds: CLOCK_MONOTONIC of a camera, else the recording's clock.
    pub capture_nanos: i64,
    /// CLOCK_MONOTONIC instant that latency counts from: a camera's stamp, a recording's paced instant, or the sending.
    pub clock_nanos: i64,
    /// CLOCK_REALTIME at `clock_nanos`, by the system clock at the time of sending; 0 where unknown.
    pub realtime_nanos: i64,
    /// CLOCK_MONOTONIC when it was sent; wake-up times count from here.
    pub sent_nanos: i64,
    /// Exposure time in nanoseconds, 0 where unknown.
    pub exposure_nanos: u64,
    /// fx, fy, cx, cy in pixels.
    pub intrinsics: [f64; 4],
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bytes from row to row; equal to the width.
    pub stride: u32,
    /// Sensor gain, 0 where unknown.
    pub gain: f32,
}

/// Message of `tracker/pose`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.Pose.v7")]
pub struct PoseMessage {
    /// Sequence of the frame.
    pub sequence: u64,
    /// Stamp of the frame, nanoseconds.
    pub capture_nanos: i64,
    /// `realtime_nanos` of the frame, bit for bit: CLOCK_REALTIME at its `clock_nanos`; 0 where unknown.
    pub realtime_nanos: i64,
    /// CLOCK_MONOTONIC when the pose was published.
    pub published_nanos: i64,
    /// From the frame's `clock_nanos` to `published_nanos`.
    pub latency_nanos: u64,
    /// Tracking time.
    pub track_nanos: u64,
    /// From sending the frame to the tracker picking it up.
    pub wake_nanos: u64,
    /// Revision of the keyframe it was tracked on.
    pub revision: u64,
    /// Keyframe it was tracked on, all ones before the first.
    pub keyframe_id: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// 0 initializing, 1 tracking, 2 degraded, 3 lost.
    pub state: u32,
    /// Reason: degraded 0 budget, 1 low overlap, 2 high residual, 3 gap, 4 turning; lost 0 diverged, 1 too few inliers,
    /// 2 no points, 3 unusable frame, 4 map rejected; otherwise 0.
    pub reason: u32,
    /// 1 if the tracker proposes a new keyframe here.
    pub proposes_keyframe: u32,
    /// Number of corrections of the map when the keyframe was published: `map_from_camera` jumps where this increases.
    pub map_revision: u64,
    /// Odometry pose: drifts, and never jumps within an epoch, except from a turning pose to the next that is not.
    pub world_from_camera: RigidMessage,
    /// Pose in the map, the best estimate: jumps where the map is corrected.
    pub map_from_camera: RigidMessage,
    /// Pose relative to the keyframe, keyframe units.
    pub keyframe_from_camera: RigidMessage,
    /// Upper triangle, row-major, of the covariance of the left increment (translation, rotation) of
    /// `current_from_keyframe`, keyframe units and radians. Includes the noise of single points, the errors shared by
    /// all depth of the keyframe (its `mode_covariance`) and displacements of the whole image (`displacement_px`).
    /// Calibrated on simulated and recorded sequences: check the `nees_…` figures of your own recording before fusing
    /// it. Excludes the drift of the keyframe itself and of the scale.
    pub covariance: [f64; 21],
    /// Upper triangle, row-major, of the covariance of the left increment ξ (translation, rotation) of
    /// `map_from_camera`, `exp(ξ) map_from_camera`, map units and radians: `covariance` and the keyframe's
    /// `place_covariance`. The increment rotates about the map's origin: a position p errs by ξ_t + ξ_ω × p. Relative
    /// to the first keyframe of the epoch, so that it includes the estimated drift of the map since its start.
    pub map_covariance: [f64; 21],
    /// As `covariance`, but of the alignment alone, for the mapper. Overconfident by a factor of up to a hundred in
    /// standard deviation: never fuse it.
    pub alignment_covariance: [f64; 21],
    /// Camera velocity at the frame's stamp, along its axes (x right, y down, z forward), world units per second.
    pub linear_velocity: [f64; 3],
    /// Angular velocity about the same axes, radians per second.
    pub angular_velocity: [f64; 3],
    /// Upper triangle, row-major, of the covariance of both, linear first; excludes the error of the map's scale.
    pub velocity_covariance: [f64; 21],
    /// Affine brightness relative to the keyframe: a, b.
    pub brightness: [f64; 2],
    /// Share of the keyframe's points in view.
    pub in_view_ratio: f64,
    /// Share of inliers among the compared points.
    pub inlier_ratio: f64,
    /// Huber-weighted root mean square of the residuals over their standard deviations.
    pub whitened_rmse: f64,
    /// Root mean square of the residuals, grey levels.
    pub residual_rmse: f64,
    /// Mean squared optical flow, pixels².
    pub mean_squared_flow: f64,
    /// Standard deviation of an undetected displacement of the whole image, pixels; included in `covariance`.
    pub displacement_px: f64,
    /// Iterations over all levels.
    pub iterations: u32,
    /// Finest level that was solved; the number of levels if none was.
    pub finest_level: u32,
    /// Points compared: in view and not clipped by the sensor.
    pub points: u32,
    /// 1 if the velocity is known (this frame and the previous one were tracked in one epoch); else 0, and it is zero.
    pub has_velocity: u32,
}

/// Header of `mapper/keyframe`; the payload is its [`DepthPoint`]s.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.KeyframeHeader.v4")]
pub struct KeyframeHeader {
    /// Id of the keyframe.
    pub keyframe_id: u64,
    /// Increases with every change of the map.
    pub revision: u64,
    /// Sequence of its frame.
    pub sequence: u64,
    /// Stamp of its frame, nanoseconds.
    pub capture_nanos: i64,
    /// Pose and unit of the keyframe in odometry, from which poses follow.
    pub world_from_keyframe: SimilarityMessage,
    /// Pose and unit of the keyframe in the map.
    pub map_from_keyframe: SimilarityMessage,
    /// Number of corrections of the map by then.
    pub map_revision: u64,
    /// fx, fy, cx, cy in pixels.
    pub intrinsics: [f64; 4],
    /// Upper triangle, row-major, of the covariance of the errors shared by all its depth: relative errors of inverse
    /// depth per unit of X, of Y (the ray's coordinates) and of ln d.
    pub mode_covariance: [f64; 6],
    /// Upper triangle, row-major, of the covariance of the keyframe's pose and unit: the left increment (translation,
    /// rotation) of the rigid part of `map_from_keyframe`, map units and radians, and the logarithm of its unit.
    pub place_covariance: [f64; KEYFRAME_POSE_ENTRIES],
    /// Epoch of the map.
    pub epoch: u32,
    /// State of the map: 1 established, 2 rejected.
    pub map_state: u32,
    /// Width of its image, pixels.
    pub width: u32,
    /// Height of its image, pixels.
    pub height: u32,
}

// SAFETY: `#[repr(C)]` with two u16 and three f32: self-contained, no padding, every bit pattern valid.
unsafe impl ZeroCopySend for DepthPoint {
    unsafe fn type_name() -> &'static str {
        "semidense.DepthPoint.v1"
    }
}

/// Header of `mapper/keyframe_image`; the payload is the grey image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.KeyframeImageHeader.v1")]
pub struct KeyframeImageHeader {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bytes from row to row; equal to the width.
    pub stride: u32,
}

/// Message of `mapper/step`: this frame has entered the map.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.Step.v4")]
pub struct StepMessage {
    /// Sequence of the frame.
    pub sequence: u64,
    /// Keyframe that is active from the next frame on, all ones before the first.
    pub keyframe_id: u64,
    /// Its revision.
    pub revision: u64,
    /// Duration of the step.
    pub step_nanos: u64,
    /// Part of it spent on making and publishing a new keyframe, after the frame was observed; 0 if there was none.
    pub change_nanos: u64,
    /// Keyframes in the map.
    pub keyframes: u64,
    /// Points with depth of the active keyframe.
    pub points: u64,
    /// Stamp of the last frame whose pose was claimed, nanoseconds.
    pub pose_nanos: i64,
    /// That pose: a restarted tracker begins here.
    pub world_from_camera: RigidMessage,
    /// 1 if there was such a frame in the epoch.
    pub has_pose: u32,
    /// Epoch of the map.
    pub epoch: u32,
    /// While there is no map, the outcome of the frame: 1 begun, 2 dark, 3 overexposed, 4 textureless, 5 unmatched, 6
    /// still, 7 turned, 8 little parallax; otherwise 0.
    pub start_frame: u32,
    /// Zero.
    pub reserved: u32,
}

/// Header of `mapper/graph`; the payload is one [`KeyframePoseMessage`] per keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.GraphHeader.v2")]
pub struct GraphHeader {
    /// Newest revision among its keyframes.
    pub revision: u64,
    /// Number of corrections of the map by then.
    pub map_revision: u64,
    /// Epoch of the map.
    pub epoch: u32,
    /// Zero.
    pub reserved: u32,
}

/// The pose of one keyframe in `mapper/graph`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.KeyframePose.v2")]
pub struct KeyframePoseMessage {
    /// The keyframe.
    pub keyframe_id: u64,
    /// Revision of its depth; a reader that holds a different one sends a request for the keyframe.
    pub revision: u64,
    /// Pose and unit of the keyframe in the map.
    pub map_from_keyframe: SimilarityMessage,
}

/// Message of `mapper/adjustment`: a joint estimate of keyframes has ended.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.Adjustment.v1")]
pub struct AdjustmentMessage {
    /// Sequence of the last frame before it entered the map.
    pub sequence: u64,
    /// Frames from its start until then.
    pub frames: u64,
    /// CPU time of the estimate, nanoseconds.
    pub cpu_nanos: u64,
    /// Newest keyframe that took part.
    pub keyframe_id: u64,
    /// Share of inliers among the comparisons of a point with a keyframe.
    pub inlier_ratio: f64,
    /// Root mean square of the inliers' residuals, grey levels.
    pub rms_grey: f64,
    /// Outcome: 0 it entered the map, 1 it entered a map with newer keyframes, which moved with it, 2 it was dropped
    /// because the map had changed.
    pub fate: u32,
    /// Keyframes whose poses were free.
    pub free: u32,
    /// Keyframes that were fixed and held them in place.
    pub fixed: u32,
    /// Points.
    pub points: u32,
    /// Comparisons of a point with a keyframe.
    pub comparisons: u32,
    /// Steps tried.
    pub iterations: u32,
}

/// Message of `<process>/health`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.Health.v6")]
pub struct HealthMessage {
    /// CLOCK_MONOTONIC when it was published.
    pub published_nanos: i64,
    /// CLOCK_MONOTONIC when the process started.
    pub started_nanos: i64,
    /// Its process id.
    pub process_id: u32,
    /// 0 starting, 1 preparing, 2 ready, 3 running, 4 finished, 5 failed, 6 stale.
    pub state: u32,
    /// Preparing: work done so far.
    pub progress_done: u64,
    /// Preparing: total work, 0 where unknown.
    pub progress_total: u64,
    /// Frames sent, tracked or mapped.
    pub frames: u64,
    /// Frames per second over about the last second; NaN before the first has passed.
    pub rate_hz: f64,
    /// Late frames that were skipped.
    pub dropped: u64,
    /// Frames lost by the source.
    pub gaps: u64,
    /// Messages refused as invalid.
    pub refused: u64,
    /// Frames whose sequence or stamp does not increase: repeated, out of order, or after a jump of the source's clock.
    pub disordered: u64,
    /// Changes of the image size or the intrinsics.
    pub resized: u64,
    /// Frames that took longer than the deadline.
    pub deadline_misses: u64,
    /// Page faults of the frame loop since its first hundred frames.
    pub page_faults: u64,
    /// Capture: total number of frames, 0 where unknown. Mapper: keyframes of the map.
    pub total: u64,
    /// Tracker: state of the last frame, as in [`PoseMessage`]. Mapper: that of the map, as in [`KeyframeHeader`].
    /// Capture: largest factor on the grey levels of dim images, 1 where none was dim, 0 where brightening is off.
    pub detail: u32,
    /// Bytes of `cause` that are used.
    pub cause_bytes: u32,
    /// Largest resident memory so far.
    pub peak_rss_bytes: u64,
    /// Histogram of latencies, see [`crate::service::health`].
    pub latency_counts: [u64; HISTOGRAM_BUCKETS],
    /// Histogram of the time spent on a frame.
    pub work_counts: [u64; HISTOGRAM_BUCKETS],
    /// Histogram of the time from sending a frame to picking it up.
    pub wake_counts: [u64; HISTOGRAM_BUCKETS],
    /// Mapper: joint estimates of keyframes that entered the map.
    pub adjustments: u64,
    /// Mapper: of these, the ones that entered a map with newer keyframes, which moved with them.
    pub adjustments_merged: u64,
    /// Mapper: joint estimates that were dropped because the map had changed.
    pub adjustments_dropped: u64,
    /// Mapper: histogram of the CPU time of joint estimates.
    pub adjustment_counts: [u64; HISTOGRAM_BUCKETS],
    /// Mapper: keyframes that were searched for among older ones.
    pub loop_searches: u64,
    /// Mapper: loops that moved the map.
    pub loops_closed: u64,
    /// Mapper: loops that the map already agreed with.
    pub loops_held: u64,
    /// Mapper: epochs that were joined to others.
    pub epochs_joined: u64,
    /// Mapper: keyframes whose candidates were different places.
    pub loops_refused: u64,
    /// Mapper: places that were farther off than the map can have drifted.
    pub loops_against_drift: u64,
    /// Mapper: places that no second pair confirmed.
    pub loops_unconfirmed: u64,
    /// Mapper: places that contradicted other loops.
    pub loops_inconsistent: u64,
    /// Active scheduling: 0 other, 1 FIFO, 2 deadline, 3 unknown.
    pub scheduling: u32,
    /// Priority of FIFO scheduling, else 0.
    pub priority: u32,
    /// 1 if the memory is locked.
    pub memory_locked: u32,
    /// Bytes of `warning` that are used.
    pub warning_bytes: u32,
    /// What the system refused and which limit to raise, UTF-8.
    pub warning: [u8; TEXT_BYTES],
    /// Cause of the state, UTF-8.
    pub cause: [u8; TEXT_BYTES],
    /// Capture: source of its frames as the user named it, UTF-8; long names are truncated.
    pub source: [u8; TEXT_BYTES],
    /// Bytes of `source` that are used.
    pub source_bytes: u32,
    /// Zero.
    pub reserved: u32,
}

impl HealthMessage {
    /// Returns a message with nothing counted and no rate known.
    pub fn empty() -> Self {
        Self { rate_hz: f64::NAN, ..Self::new_zeroed() }
    }
}

/// Request of `mapper/command`.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.CommandRequest.v2")]
pub struct CommandRequest {
    /// The requested keyframe; otherwise 0.
    pub keyframe_id: u64,
    /// 0 save the map to the file `path`, 1 send keyframe `keyframe_id` on `mapper/earlier_keyframe`, 2 save the map to
    /// the folder `path`, 3 switch to the map in the folder `path`, 4 the same, but only localise the camera in it.
    pub kind: u32,
    /// Bytes of `path` that are used.
    pub path_bytes: u32,
    /// Absolute path of the file or folder.
    pub path: [u8; PATH_BYTES],
}

/// Response of `mapper/command`.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
#[derive(ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[type_name("semidense.CommandResponse.v1")]
pub struct CommandResponse {
    /// 0 done, 1 failed.
    pub status: u32,
    /// Bytes of `text` that are used.
    pub text_bytes: u32,
    /// The error, UTF-8.
    pub text: [u8; TEXT_BYTES],
}

#[cfg(test)]
mod tests;
