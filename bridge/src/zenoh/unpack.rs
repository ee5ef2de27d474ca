//! Converts network messages to those of shared memory, with every number checked: the network is not trusted.

use semidense::service::health::ProcessState;
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::keyframe::DepthPoint;
use semidense::wire::conversion::{
    MessageError, check_points, frame_from_message, keyframe_pose_from_message,
    map_state_from_code, mode_covariance_from_message, pose_covariance_from_message,
    pose_from_message, similarity_from_message,
};
use semidense::wire::message::{
    AdjustmentMessage, FrameHeader, GraphHeader, HealthMessage, KeyframeHeader,
    KeyframeImageHeader, KeyframePoseMessage, PoseMessage, TEXT_BYTES,
};
use semidense::wire::topic::MAX_GRAPH_KEYFRAMES;
use zerocopy::FromBytes;

use crate::jpeg;
use crate::zenoh::envelope::{EnvelopeError, Opened, Packing};
use crate::zenoh::kind::Kind;
use crate::zenoh::outlet::Presence;
use crate::zenoh::packing::{UnpackError, unpack_image, unpack_points};

/// Upper limit for the pixels of an image: 4096 × 3072. Shared memory is allocated for 46 of them.
const MAX_PIXELS: usize = 4096 * 3072;

/// A message as in shared memory.
#[derive(Debug, Clone)]
pub enum Arrival {
    /// From `tracker/pose`.
    Pose(Box<PoseMessage>),
    /// From the health of a process.
    Health(Kind, Box<HealthMessage>),
    /// From `mapper/adjustment`.
    Adjustment(AdjustmentMessage),
    /// From `mapper/graph`.
    Graph(GraphHeader, Vec<KeyframePoseMessage>),
    /// From `mapper/keyframe_image`.
    KeyframeImage(KeyframeImageHeader, Vec<u8>),
    /// From `mapper/keyframe`.
    Keyframe(Box<KeyframeHeader>, Vec<DepthPoint>),
    /// From `capture/frame`.
    Frame(FrameHeader, Vec<u8>),
    /// The sender's presence.
    Presence(Presence),
}

/// Why a message is refused.
#[derive(Debug, thiserror::Error)]
pub enum ArrivalError {
    /// Its envelope is invalid.
    #[error(transparent)]
    Envelope(#[from] EnvelopeError),
    /// Its payload is invalid.
    #[error(transparent)]
    Unpack(#[from] UnpackError),
    /// Its content is invalid.
    #[error(transparent)]
    Message(#[from] MessageError),
    /// Its JPEG is invalid.
    #[error(transparent)]
    Jpeg(#[from] jpeg::JpegError),
}

/// Unpacks and checks a message.
pub fn unpack(opened: &Opened<'_>) -> Result<Arrival, ArrivalError> {
    Ok(match opened.kind {
        Kind::Pose => {
            let message: PoseMessage = opened.message()?;
            pose_from_message(&message)?;
            Arrival::Pose(Box::new(message))
        }
        Kind::CaptureHealth | Kind::TrackerHealth | Kind::MapperHealth => {
            Arrival::Health(opened.kind, Box::new(health(opened.message()?)?))
        }
        Kind::Adjustment => Arrival::Adjustment(adjustment(opened.message()?)?),
        Kind::Graph => Arrival::Graph(opened.message()?, graph(opened)?),
        Kind::KeyframeImage => {
            let header: KeyframeImageHeader = opened.message()?;
            check_image(header.width, header.height, header.stride)?;
            Arrival::KeyframeImage(header, unpack_image(opened, header.width, header.height)?)
        }
        Kind::Keyframe => {
            let header: KeyframeHeader = opened.message()?;
            let intrinsics = check_keyframe(&header)?;
            let points = unpack_points(opened)?;
            check_points(&points, &intrinsics)?;
            Arrival::Keyframe(Box::new(header), points)
        }
        Kind::Frame => {
            let header: FrameHeader = opened.message()?;
            check_image(header.width, header.height, header.stride)?;
            if opened.packing != Packing::Jpeg {
                return Err(UnpackError.into());
            }
            let size = [header.width as usize, header.height as usize];
            let pixels = jpeg::decode_gray(opened.packed, size)?;
            frame_from_message(&header, &pixels)?;
            Arrival::Frame(header, pixels)
        }
        Kind::Presence => Arrival::Presence(opened.message()?),
    })
}

/// Checks that an image is not too large.
fn check_image(width: u32, height: u32, stride: u32) -> Result<(), MessageError> {
    let length = (width as usize).saturating_mul(height as usize);
    if length == 0 || length > MAX_PIXELS || stride != width {
        return Err(MessageError::InvalidIntrinsics { width, height });
    }
    Ok(())
}

fn check_keyframe(header: &KeyframeHeader) -> Result<Intrinsics, MessageError> {
    let [fx, fy, cx, cy] = header.intrinsics;
    let (width, height) = (header.width as usize, header.height as usize);
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    if !intrinsics.is_valid() {
        let KeyframeHeader { width, height, .. } = *header;
        return Err(MessageError::InvalidIntrinsics { width, height });
    }
    map_state_from_code(header.map_state)?;
    similarity_from_message(&header.world_from_keyframe, "world_from_keyframe")?;
    similarity_from_message(&header.map_from_keyframe, "map_from_keyframe")?;
    mode_covariance_from_message(&header.mode_covariance)?;
    pose_covariance_from_message(&header.place_covariance)?;
    Ok(intrinsics)
}

fn graph(opened: &Opened<'_>) -> Result<Vec<KeyframePoseMessage>, ArrivalError> {
    let bytes = opened.packed;
    let (size, length) = (size_of::<KeyframePoseMessage>(), bytes.len());
    let is_whole = opened.packing == Packing::Plain
        && length == opened.envelope.payload_bytes as usize
        && length % size == 0
        && length / size <= MAX_GRAPH_KEYFRAMES;
    if !is_whole {
        return Err(UnpackError.into());
    }
    let read = |chunk| KeyframePoseMessage::read_from_bytes(chunk).map_err(|_| UnpackError);
    let poses: Vec<KeyframePoseMessage> =
        bytes.chunks_exact(size).map(read).collect::<Result<_, _>>()?;
    poses.iter().try_for_each(|pose| keyframe_pose_from_message(pose).map(drop))?;
    Ok(poses)
}

/// Checks codes and lengths; counters cannot be invalid.
fn health(message: HealthMessage) -> Result<HealthMessage, MessageError> {
    if ProcessState::from_code(message.state).is_none() {
        return Err(MessageError::UnknownCode { field: "state", code: message.state });
    }
    let lengths = [message.cause_bytes, message.warning_bytes, message.source_bytes];
    match lengths.into_iter().find(|length| *length as usize > TEXT_BYTES) {
        Some(length) => {
            Err(MessageError::WrongLength { length: length as usize, expected: TEXT_BYTES })
        }
        None => Ok(message),
    }
}

fn adjustment(message: AdjustmentMessage) -> Result<AdjustmentMessage, MessageError> {
    /// Number of codes for the fate of an adjustment.
    const FATES: u32 = 3;
    if message.fate >= FATES {
        return Err(MessageError::UnknownCode { field: "fate", code: message.fate });
    }
    if !message.inlier_ratio.is_finite() || !message.rms_grey.is_finite() {
        return Err(MessageError::InvalidNumber { field: "adjustment" });
    }
    Ok(message)
}
