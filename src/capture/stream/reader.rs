//! Reads frames from a stream of bytes that may stop anywhere.

use std::io::{ErrorKind, Read};

use super::format::{HEADER_BYTES, HeaderError, StreamHeader};

/// Maximum number of bytes read at a time.
const CHUNK_BYTES: usize = 1 << 20;

/// Outcome of reading the stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Progress {
    /// A frame is complete.
    Frame(StreamHeader),
    /// Nothing more for now.
    Nothing,
    /// The sender has closed the stream.
    Closed,
}

/// Why the stream cannot be read further: after such a fault the start of the next frame is unknown.
#[derive(Debug, thiserror::Error)]
pub enum StreamFault {
    /// An invalid header.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// Frames of a size other than the rig's.
    #[error("the stream has frames of {}x{} pixels, the rig {}x{}", .found.0, .found.1, .expected.0, .expected.1)]
    Size {
        /// Size of the frames.
        found: (u32, u32),
        /// Size of the rig.
        expected: (u32, u32),
    },
    /// The system's error.
    #[error("the stream cannot be read ({0})")]
    Read(#[from] std::io::Error),
}

/// Assembles the incoming frame.
#[derive(Debug)]
pub struct FrameReader {
    size: (u32, u32),
    header: [u8; HEADER_BYTES],
    header_filled: usize,
    current: Option<StreamHeader>,
    picture: Vec<u8>,
    picture_filled: usize,
}

impl FrameReader {
    /// Creates a reader for frames of this size.
    pub fn new(size: (u32, u32)) -> Self {
        let header = [0; HEADER_BYTES];
        let picture = Vec::new();
        Self { size, header, header_filled: 0, current: None, picture, picture_filled: 0 }
    }

    /// Prepares for a new stream.
    pub fn restart(&mut self) {
        (self.header_filled, self.picture_filled, self.current) = (0, 0, None);
    }

    /// Continues reading, up to the end of a frame. `stream` does not block.
    pub fn read(&mut self, stream: &mut impl Read) -> Result<Progress, StreamFault> {
        loop {
            let (into, filled) = match self.current {
                None => (&mut self.header[self.header_filled..], &mut self.header_filled),
                Some(header) => {
                    let end = header.bytes as usize;
                    let chunk_end = end.min(self.picture_filled + CHUNK_BYTES);
                    (&mut self.picture[self.picture_filled..chunk_end], &mut self.picture_filled)
                }
            };
            match stream.read(into) {
                Ok(0) => return Ok(Progress::Closed),
                Ok(count) => *filled += count,
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    return Ok(Progress::Nothing);
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
            if let Some(header) = self.advance()? {
                return Ok(Progress::Frame(header));
            }
        }
    }

    /// Advances from a complete header to its picture, and from a complete picture to the next header.
    fn advance(&mut self) -> Result<Option<StreamHeader>, StreamFault> {
        match self.current {
            None if self.header_filled == HEADER_BYTES => {
                let header = StreamHeader::from_bytes(&self.header)?;
                let found = (header.width, header.height);
                if found != self.size {
                    return Err(StreamFault::Size { found, expected: self.size });
                }
                // Grows once: the size that a header may request is bounded by the size of the rig.
                self.picture.resize(header.bytes as usize, 0);
                self.picture_filled = 0;
                self.current = Some(header);
                Ok(None)
            }
            Some(header) if self.picture_filled == header.bytes as usize => {
                self.header_filled = 0;
                self.current = None;
                Ok(Some(header))
            }
            _ => Ok(None),
        }
    }

    /// Exchanges the complete picture for a buffer that may be written.
    pub fn swap_picture(&mut self, other: &mut Vec<u8>) {
        std::mem::swap(&mut self.picture, other);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::stream::format::StreamClock;

    /// Returns at most `step` bytes at a time, with pauses in between.
    struct Trickle<'a> {
        bytes: &'a [u8],
        step: usize,
        is_pause: bool,
    }

    impl Read for Trickle<'_> {
        fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
            self.is_pause = !self.is_pause;
            if self.is_pause {
                return Err(ErrorKind::WouldBlock.into());
            }
            let count = self.step.min(into.len()).min(self.bytes.len());
            into[..count].copy_from_slice(&self.bytes[..count]);
            self.bytes = &self.bytes[count..];
            Ok(count)
        }
    }

    fn frame(sequence: u64, level: u8) -> Vec<u8> {
        let header = StreamHeader::gray((8, 4), StreamClock::Monotonic, 7, sequence);
        [&header.to_bytes()[..], &[level; 32]].concat()
    }

    #[test]
    fn frames_are_complete_wherever_the_bytes_are_split() {
        let bytes = [frame(1, 10), frame(2, 20), frame(5, 50)].concat();
        for step in [1, 7, 63, 64, 65, 96, 1000] {
            let mut reader = FrameReader::new((8, 4));
            let mut stream = Trickle { bytes: &bytes, step, is_pause: false };
            let mut found = Vec::new();
            loop {
                match reader.read(&mut stream).unwrap() {
                    Progress::Frame(header) => {
                        let mut picture = Vec::new();
                        reader.swap_picture(&mut picture);
                        assert_eq!(picture.len(), 32);
                        found.push((header.sequence, picture[31]));
                    }
                    Progress::Nothing => {}
                    Progress::Closed => break,
                }
            }
            assert_eq!(found, [(1, 10), (2, 20), (5, 50)], "{step}");
        }
    }

    #[test]
    fn an_invalid_header_and_another_size_are_faults() {
        let mut reader = FrameReader::new((9, 4));
        let size = reader.read(&mut &frame(1, 1)[..]).unwrap_err();
        assert_eq!(size.to_string(), "the stream has frames of 8x4 pixels, the rig 9x4");
        reader.restart();
        let other = [b'x'; HEADER_BYTES];
        assert!(reader.read(&mut &other[..]).unwrap_err().to_string().contains("SDFRAME1"));
    }
}
