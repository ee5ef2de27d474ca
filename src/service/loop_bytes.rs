//! The loops of a map as bytes, little-endian, in its manifest and in a checkpoint.
//!
//! Layout: the word `loops v2`; number of loops (u64), each: keyframes i and j (u64), `j_from_i` (8 × f64), covariance of its left increment
//! (upper triangle, 28 × f64); number of keyframes with a record of those they were estimated against (u64), each:
//! keyframe (u64), number (u32) and ids (u64) of the others; number of first keyframes of joined epochs (u64), these
//! (u64); the last keyframe that was searched (u64, all bits set where none was); number of keyframes with the covariance
//! of their poses relative to those they were estimated against (u64), each: keyframe (u64), upper triangle (28 × f64).
//! Before version 2 both the word and these covariances were missing.

use zerocopy::{FromBytes, IntoBytes};

use crate::service::bytes;
use crate::slam::geometry::sim3::Matrix7;
use crate::slam::loops::record::{Link, LoopRecord};
use crate::slam::pose::NO_KEYFRAME;
use crate::wire::conversion::{similarity_from_message, similarity_message};

/// Most bytes of the loops of the largest map.
pub const MAX_LOOP_BYTES: u64 = 64 << 20;
/// First bytes; before version 2 the number of loops, which is never as large.
const VERSION_2: [u8; 8] = *b"loops v2";
/// Bytes of a loop.
const LINK_BYTES: usize = 8 * (2 + 8 + 28);
/// Side of the covariance of a similarity.
const SIDE: usize = 7;
/// Smallest eigenvalue of a covariance, as a share of the largest, that rounding may leave.
const ROUNDING: f64 = 1e-9;

/// Why loops cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum LoopBytesError {
    /// They are cut short, or followed by other bytes.
    #[error("the loops are truncated or followed by extra bytes")]
    Length,
    /// A number is invalid.
    #[error("loop {0} is not a measurement between two keyframes")]
    Link(usize),
    /// The same of a covariance.
    #[error("the covariance of keyframe {0} relative to those it was estimated with is invalid")]
    Covariance(u64),
}

/// The bytes of `loops`.
pub fn loop_bytes(loops: &LoopRecord) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(64 + LINK_BYTES * loops.links.len());
    bytes.extend(VERSION_2);
    bytes.extend((loops.links.len() as u64).to_le_bytes());
    for link in &loops.links {
        bytes.extend([link.i, link.j].as_bytes());
        bytes.extend(similarity_message(&link.j_from_i).as_bytes());
        bytes.extend(upper_triangle().flat_map(|at| link.covariance[at].to_le_bytes()));
    }
    bytes.extend((loops.held_by.len() as u64).to_le_bytes());
    for (keyframe_id, by) in &loops.held_by {
        bytes.extend(keyframe_id.to_le_bytes());
        bytes.extend((by.len() as u32).to_le_bytes());
        bytes.extend(by.as_bytes());
    }
    bytes.extend((loops.beginnings.len() as u64).to_le_bytes());
    loops.beginnings.iter().for_each(|id| bytes.extend(id.to_le_bytes()));
    bytes.extend(loops.searched_to.unwrap_or(NO_KEYFRAME).to_le_bytes());
    bytes.extend((loops.relative_covariances.len() as u64).to_le_bytes());
    for (keyframe_id, covariance) in &loops.relative_covariances {
        bytes.extend(keyframe_id.to_le_bytes());
        bytes.extend(upper_triangle().flat_map(|at| covariance[at].to_le_bytes()));
    }
    bytes
}

/// Parses [`loop_bytes`] and checks every number.
pub fn parse_loops(mut bytes: &[u8]) -> Result<LoopRecord, LoopBytesError> {
    let is_version_2 = bytes.starts_with(&VERSION_2);
    bytes = bytes.strip_prefix(&VERSION_2).unwrap_or(bytes);
    let bytes = &mut bytes;
    let mut loops = LoopRecord::default();
    for index in 0..count(bytes, LINK_BYTES)? {
        let [i, j]: [u64; 2] = take(bytes)?;
        let similarity = take(bytes)?;
        let covariance = take_symmetric(bytes)?;
        let j_from_i = similarity_from_message(&similarity, "j_from_i");
        let is_sure = covariance.iter().all(|x| x.is_finite()) && covariance.cholesky().is_some();
        match j_from_i {
            Ok(j_from_i) if is_sure && i != j => {
                loops.links.push(Link { i, j, j_from_i, covariance });
            }
            _ => return Err(LoopBytesError::Link(index)),
        }
    }
    for _ in 0..count(bytes, 8 + 4)? {
        let (keyframe_id, num_others): (_, u32) = (take(bytes)?, take(bytes)?);
        let others: Result<_, _> = (0..num_others).map(|_| take(bytes)).collect();
        loops.held_by.insert(keyframe_id, others?);
    }
    for _ in 0..count(bytes, 8)? {
        loops.beginnings.insert(take(bytes)?);
    }
    loops.searched_to = Some(take(bytes)?).filter(|id| *id != NO_KEYFRAME);
    let num_covariances = if is_version_2 { count(bytes, 8 * (1 + 28))? } else { 0 };
    for _ in 0..num_covariances {
        let (keyframe_id, covariance) = (take(bytes)?, take_symmetric(bytes)?);
        if !is_covariance(&covariance) {
            return Err(LoopBytesError::Covariance(keyframe_id));
        }
        loops.relative_covariances.insert(keyframe_id, covariance);
    }
    if bytes.is_empty() { Ok(loops) } else { Err(LoopBytesError::Length) }
}

/// Rows and columns of the upper triangle, row by row.
fn upper_triangle() -> impl Iterator<Item = (usize, usize)> {
    (0..SIDE).flat_map(|row| (row..SIDE).map(move |column| (row, column)))
}

fn take_symmetric(bytes: &mut &[u8]) -> Result<Matrix7, LoopBytesError> {
    let triangle: [f64; 28] = take(bytes)?;
    let mut matrix = Matrix7::zeros();
    for ((row, column), number) in upper_triangle().zip(triangle) {
        (matrix[(row, column)], matrix[(column, row)]) = (number, number);
    }
    Ok(matrix)
}

/// Whether a symmetric matrix is finite and has no negative eigenvalue but by rounding.
fn is_covariance(matrix: &Matrix7) -> bool {
    if !matrix.iter().all(|x| x.is_finite()) {
        return false;
    }
    let eigenvalues = matrix.symmetric_eigenvalues();
    eigenvalues.min() >= -ROUNDING * eigenvalues.max()
}

fn take<T: FromBytes>(bytes: &mut &[u8]) -> Result<T, LoopBytesError> {
    bytes::take(bytes).ok_or(LoopBytesError::Length)
}

/// Reads a number of items of at least `least` bytes each: no more than the remaining bytes can hold.
fn count(bytes: &mut &[u8], least: usize) -> Result<usize, LoopBytesError> {
    let count = usize::try_from(take::<u64>(bytes)?).unwrap_or(usize::MAX);
    if count <= bytes.len() / least { Ok(count) } else { Err(LoopBytesError::Length) }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;

    /// Two loops, and all other parts.
    pub(in crate::service) fn loops() -> LoopRecord {
        let rigid = SE3::exp(&[0.3, -0.2, 0.1, 0.4, 0.5, -0.6].into());
        let mut covariance = Matrix7::identity() * 1e-4;
        (covariance[(1, 4)], covariance[(4, 1)]) = (2e-5, 2e-5);
        let link = Link { i: 7, j: 3, j_from_i: Sim3::new(rigid, 1.3), covariance };
        LoopRecord {
            links: vec![link, Link { i: 8, ..link }],
            held_by: [(7, vec![5, 6]), (8, vec![]), (9, vec![7])].into(),
            relative_covariances: [(7, covariance), (9, covariance * 0.5)].into(),
            beginnings: [4].into(),
            searched_to: Some(8),
        }
    }

    #[test]
    fn loops_survive_their_bytes() {
        for loops in [loops(), LoopRecord::default()] {
            assert_eq!(parse_loops(&loop_bytes(&loops)), Ok(loops));
        }
    }

    #[test]
    fn every_cut_and_invalid_numbers_are_refused() {
        let whole = loop_bytes(&loops());
        for length in 0..whole.len() {
            assert!(parse_loops(&whole[..length]).is_err(), "{length}");
        }
        assert!(parse_loops(&[&whole[..], &[0]].concat()).is_err());
        let with = |at: usize, value: u64| {
            let mut bytes = whole.clone();
            bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            parse_loops(&bytes)
        };
        let held_at = 8 + 8 + 2 * LINK_BYTES;
        for (at, value) in [(8, u64::MAX), (8, 4), (held_at, u64::MAX), (held_at + 16, u64::MAX)] {
            assert_eq!(with(at, value), Err(LoopBytesError::Length), "at {at}");
        }
        let nan = f64::NAN.to_bits();
        let variance_at = 8 + 8 + 8 * (2 + 8);
        for (at, value) in
            [(16, 3), (32, nan), (variance_at, nan), (variance_at, (-1.0f64).to_bits())]
        {
            assert_eq!(with(at, value), Err(LoopBytesError::Link(0)), "at {at}");
        }
        let last_triangle = whole.len() - 8 * 28;
        for value in [nan, (-1.0f64).to_bits()] {
            assert_eq!(with(last_triangle, value), Err(LoopBytesError::Covariance(9)));
        }
        assert_eq!(with(last_triangle - 8 * 31, 3), Err(LoopBytesError::Length));
    }

    #[test]
    fn loops_of_the_first_version_have_no_covariances() {
        let first = LoopRecord { relative_covariances: [].into(), ..loops() };
        let bytes = loop_bytes(&first);
        let of_first = &bytes[VERSION_2.len()..bytes.len() - 8];
        assert_eq!(parse_loops(of_first), Ok(first));
        for length in 0..of_first.len() {
            assert!(parse_loops(&of_first[..length]).is_err(), "{length}");
        }
    }
}
