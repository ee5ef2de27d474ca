//! One MCAP file: written chunk by chunk, so that whatever ends the process leaves all but the last second.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use mcap::records::{MessageHeader, Metadata};
use mcap::{McapError, WriteOptions, Writer};

use crate::record::qos::offered_qos_profiles;
use crate::ros::encoder::{EncodeError, Encoded, Sink};
use crate::ros::schema::{full_name, schema, type_hash};
use crate::ros::topic::RosTopic;

/// A chunk is written when its first message is so old: what a kill may cost.
const CHUNK_PERIOD: Duration = Duration::from_secs(1);
/// Or when it has so many bytes: memory, and what a reader must load for one message.
const CHUNK_BYTES: u64 = 4 << 20;

/// Why recording ended early.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file exists, or cannot be made.
    #[error("{}: cannot be made: {source}; name another file with --output", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Writing failed.
    #[error("{}: cannot be written: {source}; what was recorded before can be read", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: McapError,
    },
    /// A topic without a definition.
    #[error("the type {0} has no definition")]
    Type(&'static str),
    /// A message.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// An MCAP file that is being written.
pub struct RecordingFile {
    /// Where it is.
    pub path: PathBuf,
    instance: String,
    writer: Writer<BufWriter<File>>,
    /// Channel of each topic, and messages in it.
    channels: HashMap<&'static str, (u16, u32)>,
    /// When the open chunk got its first message.
    chunk_began: Option<Instant>,
    /// Bytes of messages so far.
    pub bytes: u64,
}

impl RecordingFile {
    /// Makes a new file; one that exists is not touched.
    pub fn create(path: &Path, instance: &str) -> Result<Self, RecordError> {
        let create = |source| RecordError::Create { path: path.to_owned(), source };
        let file = File::options().write(true).create_new(true).open(path).map_err(create)?;
        // Chunks are gathered in memory: a length that is filled in later would be missing after a kill.
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("semidense ", env!("CARGO_PKG_VERSION")))
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES))
            .disable_seeking(true);
        let failed = |source| RecordError::Write { path: path.to_owned(), source };
        let mut writer = options.create(BufWriter::new(file)).map_err(failed)?;
        // By it `rosbag2` knows that the quality of service is noted in numbers; first, so that a recording without end
        // has it too.
        let metadata = BTreeMap::from([
            ("serialized_metadata".to_owned(), String::new()),
            ("ROS_DISTRO".to_owned(), "humble".to_owned()),
        ]);
        let metadata = Metadata { name: "rosbag2".to_owned(), metadata };
        writer.write_metadata(&metadata).map_err(failed)?;
        Ok(Self {
            path: path.to_owned(),
            instance: instance.to_owned(),
            writer,
            channels: HashMap::new(),
            chunk_began: None,
            bytes: 0,
        })
    }

    /// Messages so far, by the topic's name.
    pub fn counts(&self) -> impl Iterator<Item = (&'static str, u32)> {
        self.channels.iter().map(|(name, (_, count))| (*name, *count))
    }

    fn failed(&self, source: McapError) -> RecordError {
        RecordError::Write { path: self.path.clone(), source }
    }

    /// Makes the channel of a topic.
    fn add_channel(&mut self, topic: &RosTopic) -> Result<u16, RecordError> {
        let text = schema(topic.message_type).ok_or(RecordError::Type(topic.message_type))?;
        let type_name = full_name(topic.message_type);
        let schema_id = self.writer.add_schema(&type_name, "ros2msg", text.as_bytes());
        let schema_id = schema_id.map_err(|source| self.failed(source))?;
        let mut notes =
            BTreeMap::from([("offered_qos_profiles".to_owned(), offered_qos_profiles(topic))]);
        notes.extend(type_hash(topic.message_type).map(|h| ("topic_type_hash".to_owned(), h)));
        let name = topic.full_name(&self.instance);
        let channel = self.writer.add_channel(schema_id, &name, "cdr", &notes);
        channel.map_err(|source| self.failed(source))
    }

    /// Writes the open chunk where it is old enough.
    fn write_old_chunk(&mut self) -> Result<(), RecordError> {
        let began = *self.chunk_began.get_or_insert_with(Instant::now);
        if began.elapsed() < CHUNK_PERIOD {
            return Ok(());
        }
        self.chunk_began = None;
        self.writer.flush().map_err(|source| self.failed(source))
    }

    /// Writes what is left, and the index.
    pub fn finish(mut self) -> Result<(), RecordError> {
        let end = || -> Result<(), McapError> {
            self.writer.finish()?;
            let file = self.writer.into_inner().into_inner().map_err(|e| e.into_error())?;
            Ok(file.sync_all()?)
        };
        end().map_err(|source| RecordError::Write { path: self.path, source })
    }
}

impl Sink for RecordingFile {
    type Error = RecordError;

    fn wants(&self, _topic: &'static RosTopic) -> bool {
        true
    }

    fn put(&mut self, message: Encoded<'_>) -> Result<(), RecordError> {
        let topic = message.topic;
        let (channel_id, before) = match self.channels.get(topic.name) {
            Some(known) => *known,
            None => (self.add_channel(topic)?, 0),
        };
        let sequence = before + 1;
        self.channels.insert(topic.name, (channel_id, sequence));
        let nanos = |nanos: i64| u64::try_from(nanos).unwrap_or_default();
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: nanos(message.read_nanos),
            publish_time: nanos(message.stamp.nanos()),
        };
        let written = self.writer.write_to_known_channel(&header, message.bytes);
        written.map_err(|source| self.failed(source))?;
        self.bytes += message.bytes.len() as u64;
        self.write_old_chunk()
    }
}
