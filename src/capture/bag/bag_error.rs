//! Why a bag or an image of it cannot be used; the enclosing error names the file and topic.

use crate::capture::bag::message::CdrError;
use crate::capture::decode_error::DecodeError;
use crate::capture::ros_image::RosImageError;

/// Why a bag or a message of it cannot be used; the enclosing error names the file and topic.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The file cannot be read.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Read(#[from] std::io::Error),
    /// Not an MCAP file.
    #[error("is not an MCAP file; convert a bag with `ros2 bag convert` or `mcap convert`")]
    NotMcap,
    /// A record that is invalid for its kind.
    #[error("is damaged at byte {at}: {reason}; `mcap recover` saves what can be read")]
    Damaged {
        /// Where the record begins.
        at: u64,
        /// The problem.
        reason: String,
    },
    /// No topic of images.
    #[error("has no topic with images (sensor_msgs/Image or CompressedImage); it has {0}")]
    NoImages(String),
    /// Several topics of images.
    #[error("has several topics with images: name one of {0}, as mcap:FILE:TOPIC")]
    SeveralTopics(String),
    /// The named topic does not exist or has no images.
    #[error("has no images on the topic `{topic}`; topics with images are {known}")]
    NoTopic {
        /// The topic that was named.
        topic: String,
        /// Topics with images.
        known: String,
    },
    /// No message describes the camera.
    #[error("has no CameraInfo next to `{0}`; name the camera with --rig FILE")]
    NoCamera(String),
    /// A `CameraInfo` from which no rig can be made.
    #[error("CameraInfo of `{topic}`: {reason}; name the camera with --rig FILE")]
    Camera {
        /// The topic of the images.
        topic: String,
        /// The problem.
        reason: String,
    },
    /// The topic has no messages.
    #[error("has no images on `{0}`; check that this is the right recording")]
    Empty(String),
}

/// Why an image cannot be used; the next one may be valid.
#[derive(Debug, thiserror::Error)]
pub enum BagImageError {
    /// The message does not match its type.
    #[error("is not a message of its type: {0}")]
    Message(#[from] CdrError),
    /// Its pixels have an unsupported format, or their number is wrong.
    #[error("cannot be used: {0}")]
    Pixels(#[from] RosImageError),
    /// It cannot be decoded, or its size differs from the camera's.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Its stamp is not later than that of the previous image.
    #[error("has the stamp {nanos} ns, which is not later than the previous one")]
    Disordered {
        /// Its stamp.
        nanos: i64,
    },
    /// The chunk that contained it is damaged.
    #[error("is lost: the file is damaged at byte {at}: {reason}")]
    Chunk {
        /// Where the record begins.
        at: u64,
        /// The problem.
        reason: String,
    },
}
