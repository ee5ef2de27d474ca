//! Why a bag or an image of it cannot be used; the file and topic are named beside it.

use crate::capture::bag::message::CdrError;
use crate::capture::decode_error::DecodeError;
use crate::capture::ros_image::RosImageError;

/// Why a bag cannot be used, or a message of it; the file and topic are named beside it.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The file cannot be read.
    #[error("cannot be read: {0}; check the path and its permissions")]
    Read(#[from] std::io::Error),
    /// Another kind of file.
    #[error("is not an MCAP file; write a bag as one with `ros2 bag convert` or `mcap convert`")]
    NotMcap,
    /// A record that is not what its kind needs.
    #[error("is damaged at byte {at}: {reason}; `mcap recover` saves what can be read")]
    Damaged {
        /// Where the record begins.
        at: u64,
        /// What is wrong with it.
        reason: String,
    },
    /// No topic of images.
    #[error("has no topic with images (sensor_msgs/Image or CompressedImage); it has {0}")]
    NoImages(String),
    /// Several topics of images.
    #[error("has several topics with images: name one as mcap:FILE:TOPIC, of {0}")]
    SeveralTopics(String),
    /// The named topic is not there, or has no images.
    #[error("has no images on the topic `{topic}`; topics with images are {known}")]
    NoTopic {
        /// The topic that was named.
        topic: String,
        /// Topics with images.
        known: String,
    },
    /// Nothing says what the camera is.
    #[error("has no CameraInfo beside `{0}`; name the camera with --rig FILE")]
    NoCamera(String),
    /// A `CameraInfo` that no rig can be made of.
    #[error("CameraInfo of `{topic}`: {reason}; name the camera with --rig FILE")]
    Camera {
        /// The topic of the images.
        topic: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The topic has no messages.
    #[error("has no images on `{0}`; check that this is the right recording")]
    Empty(String),
}

/// An image that cannot be used; the next may be good.
#[derive(Debug, thiserror::Error)]
pub enum BagImageError {
    /// The message is not what its type says.
    #[error("is not a message of its type: {0}")]
    Message(#[from] CdrError),
    /// Its pixels are of a kind that is not read, or not as many as it says.
    #[error("cannot be used: {0}")]
    Pixels(#[from] RosImageError),
    /// It does not decode, or has another size than the camera's.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Its stamp does not come after that of the image before.
    #[error("has the stamp {nanos} ns, which does not come after the one before")]
    Disordered {
        /// Its stamp.
        nanos: i64,
    },
    /// The chunk that it was in is damaged.
    #[error("is lost with a part of the file that is damaged at byte {at}: {reason}")]
    Chunk {
        /// Where the record begins.
        at: u64,
        /// What is wrong with it.
        reason: String,
    },
}
