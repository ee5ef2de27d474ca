//! The records of an MCAP file in the order of the file, including those inside chunks.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;

use mcap::records::{Footer, Record, op};
use mcap::{MAGIC, parse_record};

use crate::capture::bag::bag_error::BagError;
use crate::capture::bag::chunk::{MAX_CHUNK_BYTES, decompress_into};
use crate::capture::bag::topics::{Channel, Kind};
use crate::capture::input_file;

/// Bytes before a record: its kind and its length.
const PREFIX_BYTES: usize = 9;
/// Bytes of a footer with its prefix, and of the magic after it.
const END_BYTES: u64 = (PREFIX_BYTES + 20 + MAGIC.len()) as u64;
/// Bytes of a message before its content.
const MESSAGE_HEADER_BYTES: usize = 22;

/// The record that reading has reached.
#[derive(Debug, Clone, PartialEq)]
pub enum Place {
    /// A channel with its number; its messages are not counted.
    Channel(u16, Channel),
    /// A message, whose content is [`Records::message`].
    Message {
        /// Its channel.
        channel: u16,
        /// When it was recorded, nanoseconds.
        log_nanos: i64,
    },
    /// Number of messages of each channel.
    Counts(Vec<(u16, u64)>),
}

/// A file that is read record by record.
#[derive(Debug)]
pub struct Records {
    file: BufReader<File>,
    position: u64,
    /// Bytes of the file.
    pub length: u64,
    /// The current record, unless it lies in the chunk; also a chunk that is not decoded yet.
    raw: Vec<u8>,
    /// The current chunk, and how much of it has been read.
    chunk: Vec<u8>,
    chunk_position: usize,
    /// The current record in the chunk; `None` if it is `raw`.
    in_chunk: Option<Range<usize>>,
    /// Kind of the messages of a type, by the type's number.
    kinds: HashMap<u16, Option<Kind>>,
    /// Whether a channel named a type that did not come before it.
    pub lacks_types: bool,
    /// Channel of the current message.
    pub channel: u16,
    /// Whether the end was reached, early or not.
    has_ended: bool,
    /// Whether the file ended before the end that a closed file has.
    pub is_unfinished: bool,
}

impl Records {
    /// Opens a file at its first record.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let file = input_file::open(path)?;
        let length = file.metadata()?.len();
        let mut file = BufReader::with_capacity(1 << 16, file);
        let mut magic = [0; MAGIC.len()];
        match file.read_exact(&mut magic) {
            Ok(()) if magic == *MAGIC => {}
            Err(error) if error.kind() != ErrorKind::UnexpectedEof => return Err(error.into()),
            _ => return Err(BagError::NotMcap),
        }
        Ok(Self {
            file,
            position: MAGIC.len() as u64,
            length,
            raw: Vec::new(),
            chunk: Vec::new(),
            chunk_position: 0,
            in_chunk: None,
            kinds: HashMap::new(),
            lacks_types: false,
            channel: 0,
            has_ended: false,
            is_unfinished: false,
        })
    }

    /// Seeks the summary at the end of the file; returns false if it has none.
    pub fn go_to_summary(&mut self) -> Result<bool, BagError> {
        let Some(at) = self.length.checked_sub(END_BYTES).filter(|at| *at > MAGIC.len() as u64)
        else {
            return Ok(false);
        };
        self.go_to(at)?;
        let mut end = [0; END_BYTES as usize];
        self.file.read_exact(&mut end)?;
        let footer = end.get(PREFIX_BYTES..PREFIX_BYTES + 20).unwrap_or_default();
        let is_end = end[0] == op::FOOTER && end.ends_with(MAGIC);
        let summary = match parse_record(op::FOOTER, footer) {
            Ok(Record::Footer(Footer { summary_start, .. })) if is_end => summary_start,
            _ => 0,
        };
        if summary <= MAGIC.len() as u64 || summary >= at {
            return Ok(false);
        }
        self.go_to(summary)?;
        Ok(true)
    }

    fn go_to(&mut self, position: u64) -> Result<(), BagError> {
        self.file.seek(SeekFrom::Start(position))?;
        self.position = position;
        Ok(())
    }

    /// Returns the content of the current message.
    pub fn message(&self) -> &[u8] {
        self.record().get(MESSAGE_HEADER_BYTES..).unwrap_or_default()
    }

    fn record(&self) -> &[u8] {
        match &self.in_chunk {
            Some(range) => self.chunk.get(range.clone()).unwrap_or_default(),
            None => &self.raw,
        }
    }

    fn damaged(at: u64, reason: impl ToString) -> BagError {
        BagError::Damaged { at, reason: reason.to_string() }
    }

    /// Advances to the next record of interest; `None` at the end. After [`BagError::Damaged`] the next call continues
    /// after the damaged part.
    pub fn advance(&mut self) -> Result<Option<Place>, BagError> {
        loop {
            let found = if self.chunk_position < self.chunk.len() {
                self.next_in_chunk()?
            } else {
                self.next_in_file()?
            };
            let Some((opcode, at)) = found else { return Ok(None) };
            if let Some(place) = self.place(opcode, at)? {
                return Ok(Some(place));
            }
        }
    }

    /// The next record of the chunk.
    fn next_in_chunk(&mut self) -> Result<Option<(u8, u64)>, BagError> {
        let rest = self.chunk.get(self.chunk_position..).unwrap_or_default();
        let record = rest.split_first_chunk().and_then(|(prefix, rest)| {
            let (opcode, length) = parse_prefix(*prefix);
            let length = usize::try_from(length).ok().filter(|length| *length <= rest.len())?;
            Some((opcode, length))
        });
        let Some((opcode, length)) = record else {
            self.chunk.clear();
            return Err(Self::damaged(
                self.position,
                "a record in a chunk is longer than the chunk",
            ));
        };
        let begin = self.chunk_position + PREFIX_BYTES;
        self.chunk_position = begin + length;
        self.in_chunk = Some(begin..self.chunk_position);
        Ok(Some((opcode, self.position)))
    }

    /// The next record of the file that is of interest; `None` at its end.
    fn next_in_file(&mut self) -> Result<Option<(u8, u64)>, BagError> {
        loop {
            let left = self.length.saturating_sub(self.position);
            if self.has_ended {
                return Ok(None);
            }
            if left < PREFIX_BYTES as u64 {
                self.end_early();
                return Ok(None);
            }
            let at = self.position;
            let mut prefix = [0; PREFIX_BYTES];
            self.file.read_exact(&mut prefix)?;
            let (opcode, length) = parse_prefix(prefix);
            if length > left - PREFIX_BYTES as u64 {
                // Cut off: everything before it is complete.
                self.end_early();
                return Ok(None);
            }
            self.position += PREFIX_BYTES as u64 + length;
            match opcode {
                // The records after the data only repeat it.
                op::FOOTER | op::DATA_END => {
                    self.has_ended = true;
                    return Ok(None);
                }
                op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK | op::STATISTICS
                    if length <= MAX_CHUNK_BYTES =>
                {
                    self.load(length)?;
                    return Ok(Some((opcode, at)));
                }
                op::SCHEMA | op::CHANNEL | op::MESSAGE | op::CHUNK => {
                    self.go_to(self.position)?;
                    return Err(Self::damaged(at, format!("a record of {length} bytes")));
                }
                _ => self.go_to(self.position)?,
            }
        }
    }

    fn end_early(&mut self) {
        self.has_ended = true;
        self.is_unfinished = true;
    }

    /// Reads a record whose length was checked against the file's.
    fn load(&mut self, length: u64) -> Result<(), BagError> {
        self.raw.clear();
        let read = (&mut self.file).take(length).read_to_end(&mut self.raw)?;
        if (read as u64) < length {
            // The file was truncated while it was read.
            self.end_early();
        }
        self.in_chunk = None;
        Ok(())
    }

    /// Interprets a record; `None` for a chunk, whose records come next, and for a record of no interest.
    fn place(&mut self, opcode: u8, at: u64) -> Result<Option<Place>, BagError> {
        // A chunk within a chunk is ignored.
        if opcode == op::CHUNK {
            return if self.in_chunk.is_none() { self.open_chunk(at) } else { Ok(None) };
        }
        if ![op::SCHEMA, op::CHANNEL, op::MESSAGE, op::STATISTICS].contains(&opcode) {
            return Ok(None);
        }
        let record = parse_record(opcode, self.record()).map_err(|e| Self::damaged(at, e))?;
        let place = match record {
            Record::Schema { header, .. } => {
                self.kinds.insert(header.id, Kind::of_type(&header.name));
                return Ok(None);
            }
            Record::Channel(found) => {
                let kind = self.kinds.get(&found.schema_id).copied();
                // 0 stands for no type.
                self.lacks_types |= kind.is_none() && found.schema_id != 0;
                let kind = kind.flatten().filter(|_| found.message_encoding == "cdr");
                Place::Channel(found.id, Channel { topic: found.topic, kind, num_messages: 0 })
            }
            Record::Message { header, .. } => Place::Message {
                channel: header.channel_id,
                log_nanos: i64::try_from(header.log_time).unwrap_or(i64::MAX),
            },
            Record::Statistics(statistics) => {
                Place::Counts(statistics.channel_message_counts.into_iter().collect())
            }
            _ => return Ok(None),
        };
        if let Place::Message { channel, .. } = place {
            self.channel = channel;
        }
        Ok(Some(place))
    }

    /// Decodes the current chunk.
    fn open_chunk(&mut self, at: u64) -> Result<Option<Place>, BagError> {
        self.chunk_position = 0;
        let decoded = match parse_record(op::CHUNK, &self.raw) {
            Ok(Record::Chunk { header, data }) => {
                decompress_into(&header, &data, &mut self.chunk).map_err(|e| e.to_string())
            }
            Ok(_) => Err("its record is not a chunk".to_owned()),
            Err(error) => Err(error.to_string()),
        };
        decoded.map_err(|reason| {
            self.chunk.clear();
            Self::damaged(at, reason)
        })?;
        Ok(None)
    }
}

/// Kind and length of a record.
fn parse_prefix([opcode, length @ ..]: [u8; PREFIX_BYTES]) -> (u8, u64) {
    (opcode, u64::from_le_bytes(length))
}
