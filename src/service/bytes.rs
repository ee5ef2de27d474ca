//! Numbers in files as they lie in memory: little-endian.

use zerocopy::FromBytes;

const _: () = assert!(cfg!(target_endian = "little"), "files have little-endian numbers");

/// Takes a value from the beginning; `None` where there are too few bytes.
pub fn take<T: FromBytes>(bytes: &mut &[u8]) -> Option<T> {
    let (value, rest) = T::read_from_prefix(bytes).ok()?;
    *bytes = rest;
    Some(value)
}
