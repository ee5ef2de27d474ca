//! Encodes messages as CDR, version 1, the encoding of ROS 2 on the network and in recordings.

use byteorder::LittleEndian;
use serde::Serialize;

/// The header before a message: plain CDR, little endian, no options.
const LITTLE_ENDIAN_HEADER: [u8; 4] = [0, 1, 0, 0];

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
        let (decoded, _) = cdr_encoding::from_bytes::<Image, LittleEndian>(&bytes[4..]).unwrap();
        assert_eq!(decoded, image());
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
