//! Numbers in files as they are in memory: little-endian.

use zerocopy::FromBytes;

const _: () = assert!(cfg!(target_endian = "little"), "files have little-endian numbers");

/// Takes a value from the front of `bytes`; `None` where too few are left.
pub fn take<T: FromBytes>(bytes: &mut &[u8]) -> Option<T> {
    let (value, rest) = T::read_from_prefix(bytes).ok()?;
    *bytes = rest;
    Some(value)
}
