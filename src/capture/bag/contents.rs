//! Contents of a file: its topics, and the number of images and the camera of the topic that is played.

use std::collections::HashMap;
use std::path::Path;

use crate::capture::bag::bag_error::BagError;
use crate::capture::bag::camera::rig_of;
use crate::capture::bag::message::{CameraInfo, Stamped, decode};
use crate::capture::bag::records::{Place, Records};
use crate::capture::bag::topics::{Channel, Channels, Kind, listed};
use crate::capture::rig::Rig;
use crate::capture::ros_topic::{camera_topic, frame_record_topic};

/// The part of a file that is played.
#[derive(Debug)]
pub struct Contents {
    /// The topic of the images.
    pub topic: String,
    /// Number of images on it.
    pub num_images: u64,
    /// Whether the file lacks the end of a closed file.
    pub is_unfinished: bool,
    /// Channels that are read: those of the images, their camera and their records.
    channels: HashMap<u16, Kind>,
}

impl Contents {
    /// Reads the summary of a file, or the whole file if it has none, and chooses the topic.
    pub fn read(path: &Path, topic: Option<&str>) -> Result<Self, BagError> {
        let mut records = Records::open(path)?;
        let summary = if records.go_to_summary()? { read_channels(&mut records)? } else { None };
        let (channels, is_unfinished) = match summary {
            Some(channels) if is_possible(&channels, records.length) => (channels, false),
            _ => {
                records = Records::open(path)?;
                let channels = count_all(&mut records)?;
                (channels, records.is_unfinished)
            }
        };
        let topic = choose(&channels, topic)?;
        let (camera, record) = (camera_topic(&topic), frame_record_topic(&topic));
        let is_played = |channel: &Channel| match channel.kind? {
            kind if kind.is_image() && channel.topic == topic => Some(kind),
            Kind::CameraInfo if channel.topic == camera => Some(Kind::CameraInfo),
            Kind::FrameRecord if channel.topic == record => Some(Kind::FrameRecord),
            _ => None,
        };
        let num_images = channels
            .values()
            .filter(|c| is_played(c).is_some_and(Kind::is_image))
            .map(|channel| channel.num_messages)
            .fold(0, u64::saturating_add);
        if num_images == 0 {
            return Err(BagError::Empty(topic));
        }
        let channels =
            channels.iter().filter_map(|(id, channel)| Some((*id, is_played(channel)?))).collect();
        Ok(Self { topic, num_images, is_unfinished, channels })
    }

    /// Returns the kind of image of a channel that is played.
    pub fn image_kind(&self, channel: u16) -> Option<Kind> {
        self.channels.get(&channel).copied().filter(|kind| kind.is_image())
    }

    /// Whether it is our own recording of the images.
    pub fn is_own(&self) -> bool {
        self.channels.values().any(|kind| *kind == Kind::FrameRecord)
    }

    /// Whether a channel holds our own recording's stamps of the images.
    pub fn is_frame_record(&self, channel: u16) -> bool {
        self.channels.get(&channel) == Some(&Kind::FrameRecord)
    }

    /// Returns the camera described by the first `CameraInfo` next to the images.
    pub fn rig(&self, path: &Path) -> Result<Rig, BagError> {
        let missing = || BagError::NoCamera(self.topic.clone());
        if !self.channels.values().any(|kind| *kind == Kind::CameraInfo) {
            return Err(missing());
        }
        let mut records = Records::open(path)?;
        while let Some(channel) = next_message(&mut records)? {
            if self.channels.get(&channel) != Some(&Kind::CameraInfo) {
                continue;
            }
            let wrong = |reason: String| BagError::Camera { topic: self.topic.clone(), reason };
            let camera: CameraInfo =
                decode(records.message()).map_err(|error| wrong(error.to_string()))?;
            return rig_of(&camera, &self.topic, path).map_err(wrong);
        }
        Err(missing())
    }

    /// Whether the headers of the images have stamps. They have none if those of the first two images are both 0; one
    /// alone may be the start of a simulation's clock.
    pub fn has_header_stamps(&self, path: &Path) -> Result<bool, BagError> {
        let mut records = Records::open(path)?;
        let mut num_unset = 0;
        while num_unset < 2 {
            let Some(channel) = next_message(&mut records)? else { break };
            if self.image_kind(channel).is_none() {
                continue;
            }
            match decode(records.message()).map(|header: Stamped| header.stamp_nanos()) {
                Ok(0) => num_unset += 1,
                Ok(_) => return Ok(true),
                // Reported when playing reaches it.
                Err(_) => {}
            }
        }
        Ok(false)
    }
}

/// Advances to the next message and returns its channel; `None` at the end. Damage is reported when playing reaches it.
fn next_message(records: &mut Records) -> Result<Option<u16>, BagError> {
    loop {
        match records.advance() {
            Ok(Some(Place::Message { channel, .. })) => return Ok(Some(channel)),
            Ok(None) => return Ok(None),
            Ok(Some(_)) | Err(BagError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
}

/// Returns the channels in the summary; `None` if it lacks them, their counts or their types.
fn read_channels(records: &mut Records) -> Result<Option<Channels>, BagError> {
    let (mut channels, mut counts) = (Channels::new(), None);
    loop {
        match records.advance() {
            Ok(Some(Place::Channel(id, channel))) => {
                channels.entry(id).or_insert(channel);
            }
            Ok(Some(Place::Counts(found))) => counts = Some(found),
            Ok(Some(Place::Message { .. })) | Err(BagError::Damaged { .. }) => return Ok(None),
            Ok(None) => break,
            Err(error) => return Err(error),
        }
    }
    let Some(counts) = counts else { return Ok(None) };
    for (id, count) in counts {
        if let Some(channel) = channels.get_mut(&id) {
            channel.num_messages = count;
        }
    }
    let is_complete = !channels.is_empty() && !records.lacks_types;
    Ok(is_complete.then_some(channels))
}

/// Whether a file of this length can hold the messages that its summary counts: each takes at least one byte.
fn is_possible(channels: &Channels, length: u64) -> bool {
    channels.values().all(|channel| channel.num_messages <= length)
}

/// Reads the whole file for its channels and counts their messages.
fn count_all(records: &mut Records) -> Result<Channels, BagError> {
    let mut channels = Channels::new();
    loop {
        match records.advance() {
            Ok(Some(Place::Channel(id, channel))) => {
                channels.entry(id).or_insert(channel);
            }
            Ok(Some(Place::Message { channel, .. })) => {
                if let Some(channel) = channels.get_mut(&channel) {
                    channel.num_messages += 1;
                }
            }
            Ok(None) => return Ok(channels),
            Ok(Some(Place::Counts(_))) | Err(BagError::Damaged { .. }) => {}
            Err(error) => return Err(error),
        }
    }
}

/// Chooses the topic to play.
fn choose(channels: &Channels, topic: Option<&str>) -> Result<String, BagError> {
    let is_image = |channel: &&Channel| channel.kind.is_some_and(Kind::is_image);
    let with_images = || channels.values().filter(is_image).map(|channel| channel.topic.as_str());
    if let Some(topic) = topic {
        return match with_images().any(|known| known == topic) {
            true => Ok(topic.to_owned()),
            false => {
                Err(BagError::NoTopic { topic: topic.to_owned(), known: listed(with_images()) })
            }
        };
    }
    let mut names: Vec<&str> = channels
        .values()
        .filter(|channel| is_image(channel) && channel.num_messages > 0)
        .map(|channel| channel.topic.as_str())
        .collect();
    names.sort_unstable();
    names.dedup();
    match names[..] {
        [only] => Ok(only.to_owned()),
        [] => {
            let all = channels.values().map(|channel| channel.topic.as_str());
            Err(BagError::NoImages(listed(all)))
        }
        _ => Err(BagError::SeveralTopics(listed(names.into_iter()))),
    }
}
