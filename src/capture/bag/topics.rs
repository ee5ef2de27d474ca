//! Kinds of topics, and which topics belong together.

use std::collections::BTreeMap;

/// Kind of a topic's messages, among those that are read here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `sensor_msgs/Image`.
    Image,
    /// `sensor_msgs/CompressedImage`.
    CompressedImage,
    /// `sensor_msgs/CameraInfo`.
    CameraInfo,
    /// `semidense_msgs/Frame`.
    FrameRecord,
}

impl Kind {
    /// Returns the kind for the name of a type, with or without `msg` in it.
    pub fn of_type(name: &str) -> Option<Self> {
        match name.replacen("/msg/", "/", 1).as_str() {
            "sensor_msgs/Image" => Some(Self::Image),
            "sensor_msgs/CompressedImage" => Some(Self::CompressedImage),
            "sensor_msgs/CameraInfo" => Some(Self::CameraInfo),
            "semidense_msgs/Frame" => Some(Self::FrameRecord),
            _ => None,
        }
    }

    /// Whether it is a kind of image.
    pub fn is_image(self) -> bool {
        matches!(self, Self::Image | Self::CompressedImage)
    }
}

/// A channel of the file; several may have the same topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Its topic.
    pub topic: String,
    /// Kind of its messages; `None` if they are not read.
    pub kind: Option<Kind>,
    /// Messages in it.
    pub num_messages: u64,
}

/// The channels by their numbers.
pub type Channels = BTreeMap<u16, Channel>;

/// Topics as a list for an error.
pub fn listed<'a>(topics: impl Iterator<Item = &'a str>) -> String {
    /// A longer list would not be read.
    const MAX_LISTED: usize = 20;
    let mut names: Vec<&str> = topics.collect();
    names.sort_unstable();
    names.dedup();
    let more = names.len().saturating_sub(MAX_LISTED);
    names.truncate(MAX_LISTED);
    match (names.is_empty(), more) {
        (true, _) => "none".to_owned(),
        (_, 0) => names.join(", "),
        (_, more) => format!("{} and {more} more", names.join(", ")),
    }
}
