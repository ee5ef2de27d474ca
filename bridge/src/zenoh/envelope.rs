//! The format on the network: an envelope of 64 bytes, the message as in shared memory, and its packed payload.
//!
//! Input is not trusted: sizes, versions and codes are checked here, the content of messages where they are
//! unpacked. Numbers are little-endian; a machine of the other byte order is refused by the first four bytes.

use semidense::wire::topic::WIRE_VERSION;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::zenoh::kind::Kind;

/// First four bytes, "SDZ1": format 1 of this envelope.
const MAGIC: u32 = u32::from_le_bytes(*b"SDZ1");
/// Upper limit for the bytes of a message: the largest is the depth of a keyframe, 1.6 MB unpacked, or an image.
pub const MAX_MESSAGE_BYTES: usize = 16 << 20;

/// How a payload is packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Packing {
    /// Unchanged.
    Plain,
    /// Columns compressed with LZ4.
    Lz4,
    /// PNG.
    Png,
    /// JPEG.
    Jpeg,
}

impl Packing {
    const ALL: [Self; 4] = [Self::Plain, Self::Lz4, Self::Png, Self::Jpeg];
}

/// The envelope of a message.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout)]
pub struct Envelope {
    /// Format of the envelope.
    pub magic: u32,
    /// Wire version of the message: messages of another version are not decoded.
    pub wire_version: u32,
    /// Code of the [`Kind`].
    pub kind: u32,
    /// Index of the [`Packing`] in its declaration.
    pub packing: u32,
    /// Id of the sending program, drawn at random at its start.
    pub sender: u64,
    /// Number of runs of the instance seen by the sender: earlier messages belong to another run.
    pub run: u64,
    /// Number of the message among those of its kind, from 1.
    pub number: u64,
    /// CLOCK_MONOTONIC of the sender when it was packed.
    pub sent_nanos: i64,
    /// CLOCK_REALTIME − CLOCK_MONOTONIC of the sender.
    pub realtime_offset_nanos: i64,
    /// Bytes of the message's fixed part.
    pub header_bytes: u32,
    /// Bytes of its payload before packing.
    pub payload_bytes: u32,
}

/// Why received bytes are refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum EnvelopeError {
    /// They are not from this program.
    #[error("{bytes} bytes that are not a message of semidense")]
    Foreign {
        /// Number of bytes received.
        bytes: usize,
    },
    /// They are of another version.
    #[error("the robot uses wire version {found}, this program {WIRE_VERSION}")]
    Version {
        /// Its version.
        found: u32,
    },
    /// An unknown code, or an inconsistent size.
    #[error("an envelope with invalid codes or sizes")]
    Broken,
}

/// A received message.
#[derive(Debug, Clone, Copy)]
pub struct Opened<'a> {
    /// Its envelope.
    pub envelope: Envelope,
    /// Its kind.
    pub kind: Kind,
    /// The packing of its payload.
    pub packing: Packing,
    /// Its fixed part.
    pub header: &'a [u8],
    /// Its payload, packed.
    pub packed: &'a [u8],
}

/// The fields common to all messages of a sender.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Origin {
    /// Id of the sending program.
    pub sender: u64,
    /// Number of runs it has seen.
    pub run: u64,
    /// CLOCK_MONOTONIC now.
    pub sent_nanos: i64,
    /// CLOCK_REALTIME − CLOCK_MONOTONIC.
    pub realtime_offset_nanos: i64,
}

/// A payload ready to be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packed {
    /// Its packing.
    pub packing: Packing,
    /// Size before packing, bytes.
    pub unpacked_bytes: usize,
    /// The packed bytes.
    pub bytes: Vec<u8>,
}

impl Packed {
    /// An empty payload.
    pub fn empty() -> Self {
        Self { packing: Packing::Plain, unpacked_bytes: 0, bytes: Vec::new() }
    }
}

/// Assembles a message for the network.
pub fn seal<T: IntoBytes + Immutable>(
    origin: &Origin,
    kind: Kind,
    number: u64,
    message: &T,
    payload: &Packed,
) -> Vec<u8> {
    let header = message.as_bytes();
    let envelope = Envelope {
        magic: MAGIC,
        wire_version: WIRE_VERSION,
        kind: kind.code(),
        packing: payload.packing as u32,
        sender: origin.sender,
        run: origin.run,
        number,
        sent_nanos: origin.sent_nanos,
        realtime_offset_nanos: origin.realtime_offset_nanos,
        header_bytes: header.len() as u32,
        payload_bytes: payload.unpacked_bytes as u32,
    };
    [envelope.as_bytes(), header, &payload.bytes].concat()
}

/// Checks received bytes, except for the content of the message.
pub fn open(bytes: &[u8]) -> Result<Opened<'_>, EnvelopeError> {
    let foreign = EnvelopeError::Foreign { bytes: bytes.len() };
    // The first words contain the version, whatever follows.
    let ([magic, found], _) = <[u32; 2]>::read_from_prefix(bytes).map_err(|_| foreign)?;
    if magic != MAGIC {
        return Err(foreign);
    }
    if found != WIRE_VERSION {
        return Err(EnvelopeError::Version { found });
    }
    let (envelope, rest) = Envelope::read_from_prefix(bytes).map_err(|_| foreign)?;
    let header_bytes = envelope.header_bytes as usize;
    let is_too_large = bytes.len() > MAX_MESSAGE_BYTES || header_bytes > rest.len();
    let kind = Kind::from_code(envelope.kind).filter(|_| !is_too_large);
    let packing = Packing::ALL.get(envelope.packing as usize).copied();
    let (Some(kind), Some(packing)) = (kind, packing) else {
        return Err(EnvelopeError::Broken);
    };
    let (header, packed) = rest.split_at(header_bytes);
    Ok(Opened { envelope, kind, packing, header, packed })
}

impl Opened<'_> {
    /// The fixed part, if it has the size of a `T`.
    pub fn message<T: FromBytes>(&self) -> Result<T, EnvelopeError> {
        T::read_from_bytes(self.header).map_err(|_| EnvelopeError::Broken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ORIGIN: Origin =
        Origin { sender: 7, run: 1, sent_nanos: 5, realtime_offset_nanos: 1_700_000_000 };

    fn sealed() -> Vec<u8> {
        let payload = Packed { packing: Packing::Plain, unpacked_bytes: 3, bytes: vec![1, 2, 3] };
        seal(&ORIGIN, Kind::Graph, 9, &[4_u64, 5], &payload)
    }

    #[test]
    fn a_sealed_message_can_be_opened() {
        let bytes = sealed();
        let opened = open(&bytes).unwrap();
        assert_eq!(
            (opened.kind, opened.packing, opened.packed),
            (Kind::Graph, Packing::Plain, &[1, 2, 3][..])
        );
        assert_eq!((opened.envelope.sender, opened.envelope.number), (7, 9));
        assert_eq!(opened.message::<[u64; 2]>(), Ok([4, 5]));
        assert_eq!(opened.message::<[u64; 3]>(), Err(EnvelopeError::Broken));
    }

    #[test]
    fn another_version_is_refused_with_both_numbers() {
        let mut bytes = sealed();
        bytes[4..8].copy_from_slice(&(WIRE_VERSION + 1).to_le_bytes());
        // Whatever that version has after its number.
        bytes.truncate(12);
        let error = open(&bytes).unwrap_err().to_string();
        let both = [format!("version {},", WIRE_VERSION + 1), format!("program {WIRE_VERSION}")];
        assert!(both.iter().all(|version| error.contains(version)), "{error}");
    }

    #[test]
    fn malformed_messages_are_refused() {
        let whole = sealed();
        for length in 0..size_of::<Envelope>() + 16 {
            assert!(open(&whole[..length]).is_err(), "{length} bytes");
        }
        for (place, wrong) in [(8, 99), (12, 99), (56, u32::MAX)] {
            let mut bytes = whole.clone();
            bytes[place..place + 4].copy_from_slice(&wrong.to_le_bytes());
            assert_eq!(open(&bytes).unwrap_err(), EnvelopeError::Broken, "byte {place}");
        }
        assert_eq!(open(b"GET / HTTP/1.1").unwrap_err(), EnvelopeError::Foreign { bytes: 14 });
        let huge = [&whole[..], &vec![0; MAX_MESSAGE_BYTES]].concat();
        assert_eq!(open(&huge).unwrap_err(), EnvelopeError::Broken);
    }
}
