//! Encodes messages as CDR, version 1, the encoding of ROS 2 on the network and in recordings.

use byteorder::{BigEndian, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// The header before a message: plain CDR, little endian, no options.
const LITTLE_ENDIAN_HEADER: [u8; 4] = [0, 1, 0, 0];

/// The header before a message in big endian.
const BIG_ENDIAN: [u8; 2] = [0, 0];

/// Why bytes cannot be decoded.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// Fewer bytes than the header of a message.
    #[error("has {0} bytes, fewer than the header of a message")]
    Short(usize),
    /// An encoding other than plain CDR.
    #[error("has the encoding {0:02x?}, which is not plain CDR")]
    Encoding([u8; 2]),
    /// The bytes end early, or a value is invalid.
    #[error("is not a message of this type: {0}")]
    Content(#[from] cdr_encoding::Error),
}

/// Encodes `message` into `bytes`, replacing their content. Fails only for a message longer than 4 GB, or one
/// with a type that CDR does not have.
pub fn encode_into<T: Serialize>(
    message: &T,
    bytes: &mut Vec<u8>,
) -> Result<(), cdr_encoding::Error> {
    bytes.clear();
    bytes.extend_from_slice(&LITTLE_ENDIAN_HEADER);
    // Numbers are aligned relative to the end of the header, so the writer must not see it.
    cdr_encoding::to_writer::<T, LittleEndian, _>(bytes, message)
}

/// Decodes a message in either byte order. Sizes in it are never trusted: nothing is allocated beyond the
/// available bytes.
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, DecodeError> {
    let Some((header, content)) = bytes.split_at_checked(LITTLE_ENDIAN_HEADER.len()) else {
        return Err(DecodeError::Short(bytes.len()));
    };
    let encoding = [header[0], header[1]];
    let little = [LITTLE_ENDIAN_HEADER[0], LITTLE_ENDIAN_HEADER[1]];
    let (message, _) = match encoding {
        _ if encoding == little => cdr_encoding::from_bytes::<T, LittleEndian>(content)?,
        BIG_ENDIAN => cdr_encoding::from_bytes::<T, BigEndian>(content)?,
        other => return Err(DecodeError::Encoding(other)),
    };
    Ok(message)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::message::{Header, Image, Time};

    fn encode(image: &Image) -> Vec<u8> {
        let mut bytes = Vec::new();
        encode_into(image, &mut bytes).unwrap();
        bytes
    }

    fn image() -> Image {
        let header = Header { stamp: Time { sec: 5, nanosec: 6 }, frame_id: "a".to_owned() };
        Image {
            header,
            height: 2,
            width: 3,
            encoding: "mono8".to_owned(),
            is_bigendian: 0,
            step: 3,
            data: vec![1, 2, 3, 4, 5, 6],
        }
    }

    #[test]
    fn numbers_are_aligned_relative_to_the_end_of_the_header() {
        let bytes = encode(&image());
        #[rustfmt::skip]
        let expected = [
            0, 1, 0, 0, 5, 0, 0, 0, 6, 0, 0, 0, 2, 0, 0, 0, b'a', 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0,
            6, 0, 0, 0, b'm', b'o', b'n', b'o', b'8', 0, 0, 0, 3, 0, 0, 0, 6, 0, 0, 0, 1, 2, 3, 4, 5, 6,
        ];
        assert_eq!(bytes, expected);
        assert_eq!(decode::<Image>(&bytes).unwrap(), image());
    }

    #[test]
    fn both_byte_orders_are_read_and_malformed_bytes_are_errors() {
        let mut big = vec![0, 0, 0, 0];
        cdr_encoding::to_writer::<_, BigEndian, _>(&mut big, &image()).unwrap();
        assert_eq!(decode::<Image>(&big).unwrap(), image());

        let whole = encode(&image());
        for length in 0..whole.len() {
            assert!(decode::<Image>(&whole[..length]).is_err(), "{length} bytes");
        }
        // A length of 4 GB followed by six bytes.
        let mut hostile = whole.clone();
        let at = whole.len() - 10;
        hostile[at..at + 4].fill(0xff);
        assert!(decode::<Image>(&hostile).is_err());
        assert!(matches!(decode::<Image>(&[0, 7, 0, 0]), Err(DecodeError::Encoding(_))));
    }

    #[test]
    fn stamps_before_1970_and_after_2038_keep_their_order() {
        assert_eq!(Time::from_nanos(-1), Time { sec: -1, nanosec: 999_999_999 });
        for nanos in [-1_500_000_000, 0, 1_500_000_000, i64::from(i32::MAX) * 1_000_000_000] {
            assert_eq!(Time::from_nanos(nanos).nanos(), nanos);
        }
        assert_eq!(Time::from_nanos(i64::MAX), Time { sec: i32::MAX, nanosec: 999_999_999 });
    }
}
