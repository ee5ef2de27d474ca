//! Checked conversion between messages and the types of `slam`; an invalid message is an error.
//!
//! A round trip preserves every bit: lockstep and replay must agree to the last digit.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::slam::frame::FrameView;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::geometry::se3::SE3;
use crate::slam::geometry::sim3::Sim3;
use crate::slam::keyframe::{DepthPoint, Keyframe, KeyframePose, MAX_KEYFRAME_POINTS, MapState};
use crate::slam::keyframe_pose_covariance::{KEYFRAME_POSE_ENTRIES, KeyframePoseCovariance};
use crate::slam::mapper::situation::StartFrame;
use crate::slam::modes::ModeCovariance;
use crate::slam::pose::{
    Brightness, DegradedReason, LostReason, PoseEstimate, Quality, TrackingState, Velocity,
};
use crate::wire::message::{
    FrameHeader, KeyframeHeader, KeyframeImageHeader, KeyframePoseMessage, PoseMessage,
    RigidMessage, SimilarityMessage,
};

/// Largest deviation of a received quaternion from unit length: allows for rounding, not for a different transform.
const QUATERNION_TOLERANCE: f64 = 1e-6;

/// Indices of the variances in the upper triangle of a 6 × 6 covariance.
const DIAGONAL: [usize; 6] = [0, 6, 11, 15, 18, 20];

/// Why a message is invalid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// An unknown code.
    #[error("{field} has the unknown code {code}")]
    UnknownCode {
        /// The field.
        field: &'static str,
        /// The code.
        code: u32,
    },
    /// NaN, infinity, a quaternion that is not of unit length, a scale that is not positive, an invalid covariance.
    #[error("{field} is not a valid number")]
    InvalidNumber {
        /// The field.
        field: &'static str,
    },
    /// An invalid image size or invalid intrinsics.
    #[error("invalid image size {width} × {height} or intrinsics")]
    InvalidIntrinsics {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// The length of the payload differs from the one that the header announces.
    #[error("payload has {length} elements where {expected} are announced")]
    WrongLength {
        /// Elements received.
        length: usize,
        /// Elements expected.
        expected: usize,
    },
    /// A point outside the image or with non-finite values.
    #[error("point {index} lies outside the image or is not finite")]
    InvalidPoint {
        /// Its index in the payload.
        index: usize,
    },
    /// Depth and image of different keyframes.
    #[error("depth of keyframe {keyframe_id} with the image of {image_id}")]
    OtherKeyframe {
        /// Keyframe of the depth.
        keyframe_id: u64,
        /// Keyframe of the image.
        image_id: u64,
    },
}

/// Converts a rigid transform to its message.
pub fn rigid_message(transform: &SE3) -> RigidMessage {
    let [x, y, z, w] = transform.quaternion_xyzw();
    let t = &transform.translation;
    [x, y, z, w, t.x, t.y, t.z]
}

/// Converts a message to its rigid transform, bit for bit.
pub fn rigid_from_message(
    message: &RigidMessage,
    field: &'static str,
) -> Result<SE3, MessageError> {
    let [x, y, z, w, tx, ty, tz] = *message;
    let quaternion = Quaternion::new(w, x, y, z);
    let is_unit = (quaternion.norm() - 1.0).abs() <= QUATERNION_TOLERANCE;
    if !is_unit || ![tx, ty, tz].iter().all(|t| t.is_finite()) {
        return Err(MessageError::InvalidNumber { field });
    }
    // Normalising again would change the last bits.
    let rotation = UnitQuaternion::new_unchecked(quaternion);
    Ok(SE3 { rotation, translation: Vector3::new(tx, ty, tz) })
}

/// Converts a similarity to its message.
pub fn similarity_message(similarity: &Sim3) -> SimilarityMessage {
    let [x, y, z, w, tx, ty, tz] = rigid_message(&similarity.rigid);
    [x, y, z, w, tx, ty, tz, similarity.scale]
}

/// Converts a message to its similarity, bit for bit.
pub fn similarity_from_message(
    message: &SimilarityMessage,
    field: &'static str,
) -> Result<Sim3, MessageError> {
    let [x, y, z, w, tx, ty, tz, scale] = *message;
    let rigid = rigid_from_message(&[x, y, z, w, tx, ty, tz], field)?;
    let similarity = Sim3::new(rigid, scale);
    Some(similarity).filter(Sim3::is_valid).ok_or(MessageError::InvalidNumber { field })
}

/// Returns the intrinsics of a header, checked.
fn intrinsics_from(values: &[f64; 4], width: u32, height: u32) -> Result<Intrinsics, MessageError> {
    let [fx, fy, cx, cy] = *values;
    let intrinsics = Intrinsics { fx, fy, cx, cy, width: width as usize, height: height as usize };
    let valid = Some(intrinsics).filter(Intrinsics::is_valid);
    valid.ok_or(MessageError::InvalidIntrinsics { width, height })
}

/// Returns the frame of a message and its intrinsics, checked.
pub fn frame_from_message<'a>(
    header: &FrameHeader,
    pixels: &'a [u8],
) -> Result<(FrameView<'a>, Intrinsics), MessageError> {
    let intrinsics = intrinsics_from(&header.intrinsics, header.width, header.height)?;
    let expected = intrinsics.width * intrinsics.height;
    if header.stride != header.width || pixels.len() != expected {
        return Err(MessageError::WrongLength { length: pixels.len(), expected });
    }
    let frame = FrameView {
        sequence: header.sequence,
        capture_nanos: header.capture_nanos,
        exposure_nanos: header.exposure_nanos,
        width: intrinsics.width,
        height: intrinsics.height,
        pixels,
    };
    Ok((frame, intrinsics))
}

/// Returns the codes of a state and its reason; the code of a reason is its position in its enumeration.
pub fn codes_from_state(state: TrackingState) -> (u32, u32) {
    match state {
        TrackingState::Initializing => (0, 0),
        TrackingState::Tracking => (1, 0),
        TrackingState::Degraded(reason) => (2, reason as u32),
        TrackingState::Lost(reason) => (3, reason as u32),
    }
}

/// Returns the state for a pair of codes.
pub fn state_from_codes(state: u32, reason: u32) -> Result<TrackingState, MessageError> {
    Ok(match (state, reason) {
        (0, 0) => TrackingState::Initializing,
        (1, 0) => TrackingState::Tracking,
        (2, 0) => TrackingState::Degraded(DegradedReason::Budget),
        (2, 1) => TrackingState::Degraded(DegradedReason::LowOverlap),
        (2, 2) => TrackingState::Degraded(DegradedReason::HighResidual),
        (2, 3) => TrackingState::Degraded(DegradedReason::Gap),
        (2, 4) => TrackingState::Degraded(DegradedReason::Turning),
        (3, 0) => TrackingState::Lost(LostReason::Diverged),
        (3, 1) => TrackingState::Lost(LostReason::TooFewInliers),
        (3, 2) => TrackingState::Lost(LostReason::NoPoints),
        (3, 3) => TrackingState::Lost(LostReason::UnusableFrame),
        (3, 4) => TrackingState::Lost(LostReason::MapRejected),
        (0..=3, code) => return Err(MessageError::UnknownCode { field: "reason", code }),
        (code, _) => return Err(MessageError::UnknownCode { field: "state", code }),
    })
}

/// Every [`StartFrame`] in the order of the codes, from 1.
const START_FRAMES: [StartFrame; 8] = [
    StartFrame::Begun,
    StartFrame::Dark,
    StartFrame::Overexposed,
    StartFrame::Textureless,
    StartFrame::Unmatched,
    StartFrame::Still,
    StartFrame::Turned,
    StartFrame::LittleParallax,
];

/// Returns the code of a frame's outcome in a start; 0 for `None`.
pub fn code_from_start_frame(frame: Option<StartFrame>) -> u32 {
    let place = frame.and_then(|frame| START_FRAMES.iter().position(|known| *known == frame));
    place.map_or(0, |place| place as u32 + 1)
}

/// Returns a frame's outcome in a start from its code; `None` for 0 and for an unknown code.
pub fn start_frame_from_code(code: u32) -> Option<StartFrame> {
    START_FRAMES.get((code as usize).checked_sub(1)?).copied()
}

/// Returns the code of a map's state.
pub fn code_from_map_state(state: MapState) -> u32 {
    match state {
        MapState::Established => 1,
        MapState::Rejected => 2,
    }
}

/// Returns the state of a map from its code.
pub fn map_state_from_code(code: u32) -> Result<MapState, MessageError> {
    match code {
        1 => Ok(MapState::Established),
        2 => Ok(MapState::Rejected),
        code => Err(MessageError::UnknownCode { field: "map_state", code }),
    }
}

/// When a pose was published, and how long the steps to it took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct PoseTiming {
    /// `realtime_nanos` of the frame.
    pub realtime_nanos: i64,
    /// CLOCK_MONOTONIC at publication.
    pub published_nanos: i64,
    /// From the frame's `clock_nanos` to publication.
    pub latency_nanos: u64,
    /// Tracking time.
    pub track_nanos: u64,
    /// From sending the frame to the tracker picking it up.
    pub wake_nanos: u64,
}

/// Converts a pose to its message.
pub fn pose_message(pose: &PoseEstimate, timing: &PoseTiming) -> PoseMessage {
    let (state, reason) = codes_from_state(pose.state);
    let (quality, velocity) = (&pose.quality, pose.velocity.as_ref());
    PoseMessage {
        sequence: pose.sequence,
        capture_nanos: pose.capture_nanos,
        realtime_nanos: timing.realtime_nanos,
        published_nanos: timing.published_nanos,
        latency_nanos: timing.latency_nanos,
        track_nanos: timing.track_nanos,
        wake_nanos: timing.wake_nanos,
        revision: pose.revision,
        keyframe_id: pose.keyframe_id,
        epoch: pose.epoch,
        state,
        reason,
        proposes_keyframe: u32::from(pose.proposes_keyframe),
        map_revision: pose.map_revision,
        world_from_camera: rigid_message(&pose.world_from_camera),
        map_from_camera: rigid_message(&pose.map_from_camera),
        keyframe_from_camera: rigid_message(&pose.keyframe_from_camera),
        covariance: pose.covariance,
        map_covariance: pose.map_covariance,
        alignment_covariance: pose.alignment_covariance,
        linear_velocity: velocity.map_or([0.0; 3], |v| v.linear.into()),
        angular_velocity: velocity.map_or([0.0; 3], |v| v.angular.into()),
        velocity_covariance: velocity.map_or([0.0; 21], |v| v.covariance),
        brightness: [pose.brightness.a, pose.brightness.b],
        in_view_ratio: quality.in_view_ratio,
        inlier_ratio: quality.inlier_ratio,
        whitened_rmse: quality.whitened_rmse,
        residual_rmse: quality.residual_rmse,
        mean_squared_flow: quality.mean_squared_flow,
        displacement_px: quality.displacement_px,
        iterations: quality.iterations,
        finest_level: quality.finest_level,
        points: quality.points,
        has_velocity: u32::from(velocity.is_some()),
    }
}

/// Converts a message to its pose, checked.
pub fn pose_from_message(message: &PoseMessage) -> Result<PoseEstimate, MessageError> {
    let finite = |field, values: &[f64]| {
        let all = values.iter().all(|x| x.is_finite());
        if all { Ok(()) } else { Err(MessageError::InvalidNumber { field }) }
    };
    finite("covariance", &message.covariance)?;
    finite("map_covariance", &message.map_covariance)?;
    if DIAGONAL.iter().any(|&entry| message.map_covariance[entry] < 0.0) {
        return Err(MessageError::InvalidNumber { field: "map_covariance" });
    }
    finite("alignment_covariance", &message.alignment_covariance)?;
    finite("brightness", &message.brightness)?;
    let quality = Quality {
        in_view_ratio: message.in_view_ratio,
        inlier_ratio: message.inlier_ratio,
        whitened_rmse: message.whitened_rmse,
        residual_rmse: message.residual_rmse,
        iterations: message.iterations,
        finest_level: message.finest_level,
        points: message.points,
        mean_squared_flow: message.mean_squared_flow,
        displacement_px: message.displacement_px,
    };
    finite("quality", &[quality.in_view_ratio, quality.inlier_ratio, quality.mean_squared_flow])?;
    finite("quality", &[quality.whitened_rmse, quality.residual_rmse, quality.displacement_px])?;
    let proposes_keyframe = match message.proposes_keyframe {
        0 => false,
        1 => true,
        code => return Err(MessageError::UnknownCode { field: "proposes_keyframe", code }),
    };
    Ok(PoseEstimate {
        sequence: message.sequence,
        capture_nanos: message.capture_nanos,
        epoch: message.epoch,
        revision: message.revision,
        keyframe_id: message.keyframe_id,
        state: state_from_codes(message.state, message.reason)?,
        map_revision: message.map_revision,
        world_from_camera: rigid_from_message(&message.world_from_camera, "world_from_camera")?,
        map_from_camera: rigid_from_message(&message.map_from_camera, "map_from_camera")?,
        keyframe_from_camera: rigid_from_message(
            &message.keyframe_from_camera,
            "keyframe_from_camera",
        )?,
        covariance: message.covariance,
        map_covariance: message.map_covariance,
        alignment_covariance: message.alignment_covariance,
        velocity: velocity_from_message(message)?,
        brightness: Brightness { a: message.brightness[0], b: message.brightness[1] },
        quality,
        proposes_keyframe,
    })
}

/// Returns the velocity in a pose's message, checked; `None` if the message has none.
fn velocity_from_message(message: &PoseMessage) -> Result<Option<Velocity>, MessageError> {
    let covariance = message.velocity_covariance;
    let [linear, angular] = [message.linear_velocity, message.angular_velocity];
    let is_finite = linear.iter().chain(&angular).chain(&covariance).all(|x| x.is_finite());
    if !is_finite || DIAGONAL.iter().any(|&entry| covariance[entry] < 0.0) {
        return Err(MessageError::InvalidNumber { field: "velocity" });
    }
    match message.has_velocity {
        0 => Ok(None),
        1 => Ok(Some(Velocity { linear: linear.into(), angular: angular.into(), covariance })),
        code => Err(MessageError::UnknownCode { field: "has_velocity", code }),
    }
}

/// Returns the header of a keyframe's depth.
pub fn keyframe_header(keyframe: &Keyframe) -> KeyframeHeader {
    let k = &keyframe.intrinsics;
    KeyframeHeader {
        keyframe_id: keyframe.keyframe_id,
        revision: keyframe.revision,
        sequence: keyframe.sequence,
        capture_nanos: keyframe.capture_nanos,
        world_from_keyframe: similarity_message(&keyframe.world_from_keyframe),
        map_from_keyframe: similarity_message(&keyframe.map_from_keyframe),
        map_revision: keyframe.map_revision,
        intrinsics: [k.fx, k.fy, k.cx, k.cy],
        mode_covariance: keyframe.mode_covariance.upper_triangle(),
        place_covariance: keyframe.place_covariance.upper_triangle(),
        epoch: keyframe.epoch,
        map_state: code_from_map_state(keyframe.map_state),
        width: k.width as u32,
        height: k.height as u32,
    }
}

/// Returns the header of a keyframe's image.
pub fn keyframe_image_header(keyframe: &Keyframe) -> KeyframeImageHeader {
    KeyframeImageHeader {
        keyframe_id: keyframe.keyframe_id,
        epoch: keyframe.epoch,
        width: keyframe.intrinsics.width as u32,
        height: keyframe.intrinsics.height as u32,
        stride: keyframe.intrinsics.width as u32,
    }
}

/// Assembles a keyframe from its two messages, checked to the last point.
pub fn keyframe_from_messages(
    header: &KeyframeHeader,
    points: &[DepthPoint],
    image_header: &KeyframeImageHeader,
    image: &[u8],
) -> Result<Keyframe, MessageError> {
    let same = (header.keyframe_id, header.epoch) == (image_header.keyframe_id, image_header.epoch);
    if !same {
        let (keyframe_id, image_id) = (header.keyframe_id, image_header.keyframe_id);
        return Err(MessageError::OtherKeyframe { keyframe_id, image_id });
    }
    let intrinsics = intrinsics_from(&header.intrinsics, header.width, header.height)?;
    let expected = intrinsics.width * intrinsics.height;
    let sized = (image_header.width, image_header.height) == (header.width, header.height)
        && image_header.stride == header.width;
    if !sized || image.len() != expected {
        return Err(MessageError::WrongLength { length: image.len(), expected });
    }
    check_points(points, &intrinsics)?;
    Ok(Keyframe {
        keyframe_id: header.keyframe_id,
        epoch: header.epoch,
        revision: header.revision,
        sequence: header.sequence,
        capture_nanos: header.capture_nanos,
        map_state: map_state_from_code(header.map_state)?,
        world_from_keyframe: similarity_from_message(
            &header.world_from_keyframe,
            "world_from_keyframe",
        )?,
        map_from_keyframe: similarity_from_message(&header.map_from_keyframe, "map_from_keyframe")?,
        map_revision: header.map_revision,
        mode_covariance: mode_covariance_from_message(&header.mode_covariance)?,
        place_covariance: pose_covariance_from_message(&header.place_covariance)?,
        is_refined: false,
        intrinsics,
        image: image.into(),
        points: points.to_vec(),
        description: None,
    })
}

/// Returns the covariance of the errors that all depth of a keyframe shares, from its upper triangle, checked.
pub fn mode_covariance_from_message(
    upper_triangle: &[f64; 6],
) -> Result<ModeCovariance, MessageError> {
    ModeCovariance::from_upper_triangle(*upper_triangle)
        .ok_or(MessageError::InvalidNumber { field: "mode_covariance" })
}

/// Returns the covariance of a keyframe's pose and unit from its upper triangle, checked.
pub fn pose_covariance_from_message(
    upper_triangle: &[f64; KEYFRAME_POSE_ENTRIES],
) -> Result<KeyframePoseCovariance, MessageError> {
    KeyframePoseCovariance::from_upper_triangle(*upper_triangle)
        .ok_or(MessageError::InvalidNumber { field: "place_covariance" })
}

/// Checks that every point lies in the image and is finite, and that there are not too many.
pub fn check_points(points: &[DepthPoint], intrinsics: &Intrinsics) -> Result<(), MessageError> {
    if points.len() > MAX_KEYFRAME_POINTS {
        let expected = MAX_KEYFRAME_POINTS;
        return Err(MessageError::WrongLength { length: points.len(), expected });
    }
    let is_valid = |p: &DepthPoint| {
        usize::from(p.u) < intrinsics.width
            && usize::from(p.v) < intrinsics.height
            && p.inverse_depth.is_finite()
            && p.variance.is_finite()
            && p.intensity.is_finite()
    };
    match points.iter().position(|p| !is_valid(p)) {
        Some(index) => Err(MessageError::InvalidPoint { index }),
        None => Ok(()),
    }
}

/// Converts a keyframe's pose to its message.
pub fn keyframe_pose_message(pose: &KeyframePose) -> KeyframePoseMessage {
    KeyframePoseMessage {
        keyframe_id: pose.keyframe_id,
        revision: pose.revision,
        map_from_keyframe: similarity_message(&pose.map_from_keyframe),
    }
}

/// Converts a message to a keyframe's pose, checked.
pub fn keyframe_pose_from_message(
    message: &KeyframePoseMessage,
) -> Result<KeyframePose, MessageError> {
    let map_from_keyframe =
        similarity_from_message(&message.map_from_keyframe, "map_from_keyframe")?;
    let KeyframePoseMessage { keyframe_id, revision, .. } = *message;
    Ok(KeyframePose { keyframe_id, revision, map_from_keyframe })
}

#[cfg(test)]
mod tests;
