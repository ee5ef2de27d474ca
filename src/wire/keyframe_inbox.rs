//! Assembles keyframes, whose depth and image arrive as two messages.

use crate::slam::keyframe::{DepthPoint, Keyframe};
use crate::wire::conversion::{MessageError, keyframe_from_messages};
use crate::wire::message::{KeyframeHeader, KeyframeImageHeader};
use crate::wire::port::{Events, Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::{KEYFRAME, KEYFRAME_IMAGE};

/// Why no keyframe was received.
#[derive(Debug, thiserror::Error)]
pub enum InboxError {
    /// The transport failed.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// A message is invalid; the next one may be valid.
    #[error("mapper/keyframe: {0}")]
    Message(#[from] MessageError),
}

/// Receives complete keyframes, the newest only.
#[derive(Debug)]
pub struct KeyframeInbox {
    depths: Subscriber<DepthPoint, KeyframeHeader>,
    images: Subscriber<u8, KeyframeImageHeader>,
    /// Depth whose image has not arrived yet.
    depth: Option<(KeyframeHeader, Vec<DepthPoint>)>,
    /// Newest image: it serves every revision of its keyframe's depth.
    image: Option<(KeyframeImageHeader, Vec<u8>)>,
}

impl KeyframeInbox {
    /// Opens the inbox; the active keyframe is received at once.
    pub fn open(hub: &Hub) -> Result<Self, OpenError> {
        let depths = hub.subscriber(&KEYFRAME)?;
        let images = hub.subscriber(&KEYFRAME_IMAGE)?;
        Ok(Self { depths, images, depth: None, image: None })
    }

    /// Events that wake the receiver.
    pub fn events(&self) -> &Events {
        self.depths.events()
    }

    /// Returns the newest keyframe that has not been taken yet.
    pub fn newest(&mut self) -> Result<Option<Keyframe>, InboxError> {
        // Depth first: the mapper sends the image before it, so the image of any depth received has already arrived.
        if let Some(depth) = self.depths.newest()? {
            self.depth = Some((*depth.header(), depth.payload().to_vec()));
        }
        if let Some(image) = self.images.newest()? {
            self.image = Some((*image.header(), image.payload().to_vec()));
        }
        let (Some((header, points)), Some((image_header, pixels))) = (&self.depth, &self.image)
        else {
            return Ok(None);
        };
        if header.keyframe_id != image_header.keyframe_id {
            return Ok(None);
        }
        let keyframe = keyframe_from_messages(header, points, image_header, pixels);
        self.depth = None;
        Ok(Some(keyframe?))
    }
}
