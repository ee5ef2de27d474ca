//! One MCAP file, written in chunks so that at most the last second is lost however the process ends.

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

/// A chunk is written once its first message is this old: the most that a kill may cost.
const CHUNK_PERIOD: Duration = Duration::from_secs(1);
/// Or once it has this many bytes, which bounds memory and what a reader must load for one message.
const CHUNK_BYTES: u64 = 4 << 20;

/// Why recording ended early.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The file exists, or cannot be created.
    #[error("{}: cannot be created: {source}; name another file with --output", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Writing failed.
    #[error("{}: cannot be written: {source}; what was recorded before remains readable", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The writer's error.
        source: McapError,
    },
    /// A message type without a definition.
    #[error("the type {0} has no definition")]
    Type(&'static str),
    /// A message could not be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// An MCAP file being written.
pub struct RecordingFile {
    /// Path of the file.
    pub path: PathBuf,
    instance: String,
    writer: Writer<BufWriter<File>>,
    /// Channel of each topic, and the number of messages in it.
    channels: HashMap<&'static str, (u16, u32)>,
    /// When the open chunk got its first message.
    chunk_began: Option<Instant>,
    /// Bytes of messages so far.
    pub bytes: u64,
}

impl RecordingFile {
    /// Creates a new file; an existing one is left untouched.
    pub fn create(path: &Path, instance: &str) -> Result<Self, RecordError> {
        let create = |source| RecordError::Create { path: path.to_owned(), source };
        let file = File::options().write(true).create_new(true).open(path).map_err(create)?;
        // Chunks are assembled in memory: a length filled in later would be missing after a kill.
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("semidense ", env!("CARGO_PKG_VERSION")))
            .compression(None)
            .chunk_size(Some(CHUNK_BYTES))
            .disable_seeking(true);
        let failed = |source| RecordError::Write { path: path.to_owned(), source };
        let mut writer = options.create(BufWriter::new(file)).map_err(failed)?;
        // Tells `rosbag2` that quality of service is stored as numbers; written first, so that a truncated
        // recording has it too.
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

    /// Number of messages so far, by topic name.
    pub fn counts(&self) -> impl Iterator<Item = (&'static str, u32)> {
        self.channels.iter().map(|(name, (_, count))| (*name, *count))
    }

    fn failed(&self, source: McapError) -> RecordError {
        RecordError::Write { path: self.path.clone(), source }
    }

    /// Adds the channel of a topic.
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

    /// Writes the open chunk if it is old enough.
    fn write_old_chunk(&mut self) -> Result<(), RecordError> {
        let began = *self.chunk_began.get_or_insert_with(Instant::now);
        if began.elapsed() < CHUNK_PERIOD {
            return Ok(());
        }
        self.chunk_began = None;
        self.writer.flush().map_err(|source| self.failed(source))
    }

    /// Writes the remaining messages and the index.
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
