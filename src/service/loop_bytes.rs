//! The loops of a map as bytes, little-endian, in its manifest and in a checkpoint, in two parts.
//!
//! Loops: number of loops (u64), each: keyframes i and j (u64), `j_from_i` (8 × f64), covariance of its left increment
//! (upper triangle, 28 × f64); number of keyframes with a record of those they were estimated against (u64), each:
//! keyframe (u64), number (u32) and ids (u64) of the others; number of first keyframes of joined epochs (u64), these
//! (u64); the last keyframe that was searched (u64, all bits set where none was).
//!
//! Covariances of keyframes relative to those that they were estimated against, in maps since these are stored: their
//! number (u64), each: keyframe (u64), upper triangle (28 × f64).

use std::collections::BTreeMap;

use zerocopy::{FromBytes, IntoBytes};

use crate::service::bytes;
use crate::slam::geometry::sim3::Matrix7;
use crate::slam::loops::record::{Link, LoopRecord};
use crate::slam::pose::NO_KEYFRAME;
use crate::wire::conversion::{similarity_from_message, similarity_message};

/// Most bytes of the loops of the largest map.
pub const MAX_LOOP_BYTES: u64 = 64 << 20;
/// Bytes of a loop.
const LINK_BYTES: usize = 8 * (2 + 8 + 28);
/// Side of the covariance of a similarity.
const SIDE: usize = 7;
/// Bytes of a keyframe's covariance.
const COVARIANCE_BYTES: usize = 8 * (1 + 28);
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
    /// A covariance is invalid.
    #[error("the covariance of keyframe {0} relative to those it was estimated with is invalid")]
    Covariance(u64),
}

/// The bytes of `loops`, without the covariances of keyframes.
pub fn loop_bytes(loops: &LoopRecord) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(64 + LINK_BYTES * loops.links.len());
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
    bytes
}

/// Parses [`loop_bytes`] and checks every number.
pub fn parse_loops(mut bytes: &[u8]) -> Result<LoopRecord, LoopBytesError> {
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
    if bytes.is_empty() { Ok(loops) } else { Err(LoopBytesError::Length) }
}

/// The bytes of the covariances of keyframes.
pub fn covariance_bytes(loops: &LoopRecord) -> Vec<u8> {
    let covariances = &loops.relative_covariances;
    let mut bytes = Vec::with_capacity(8 + COVARIANCE_BYTES * covariances.len());
    bytes.extend((covariances.len() as u64).to_le_bytes());
    for (keyframe_id, covariance) in covariances {
        bytes.extend(keyframe_id.to_le_bytes());
        bytes.extend(upper_triangle().flat_map(|at| covariance[at].to_le_bytes()));
    }
    bytes
}

/// Parses [`covariance_bytes`] and checks every number.
pub fn parse_covariances(mut bytes: &[u8]) -> Result<BTreeMap<u64, Matrix7>, LoopBytesError> {
    let bytes = &mut bytes;
    let mut covariances = BTreeMap::new();
    for _ in 0..count(bytes, COVARIANCE_BYTES)? {
        let (keyframe_id, covariance) = (take(bytes)?, take_symmetric(bytes)?);
        if !is_covariance(&covariance) {
            return Err(LoopBytesError::Covariance(keyframe_id));
        }
        covariances.insert(keyframe_id, covariance);
    }
    if bytes.is_empty() { Ok(covariances) } else { Err(LoopBytesError::Length) }
}

/// Whether a symmetric matrix is finite and has no negative eigenvalue but by rounding.
fn is_covariance(matrix: &Matrix7) -> bool {
    if !matrix.iter().all(|x| x.is_finite()) {
        return false;
    }
    let eigenvalues = matrix.symmetric_eigenvalues();
    eigenvalues.min() >= -ROUNDING * eigenvalues.max()
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
            let parsed = parse_loops(&loop_bytes(&loops)).unwrap();
            let relative_covariances = parse_covariances(&covariance_bytes(&loops)).unwrap();
            assert_eq!(LoopRecord { relative_covariances, ..parsed }, loops);
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
        let held_at = 8 + 2 * LINK_BYTES;
        for (at, value) in [(0, u64::MAX), (0, 3), (held_at, u64::MAX), (held_at + 16, u64::MAX)] {
            assert_eq!(with(at, value), Err(LoopBytesError::Length), "at {at}");
        }
        let nan = f64::NAN.to_bits();
        let variance_at = 8 + 8 * (2 + 8);
        for (at, value) in
            [(8, 3), (24, nan), (variance_at, nan), (variance_at, (-1.0f64).to_bits())]
        {
            assert_eq!(with(at, value), Err(LoopBytesError::Link(0)), "at {at}");
        }
    }

    #[test]
    fn every_cut_and_invalid_numbers_of_covariances_are_refused() {
        let whole = covariance_bytes(&loops());
        for length in 0..whole.len() {
            assert!(parse_covariances(&whole[..length]).is_err(), "{length}");
        }
        assert!(parse_covariances(&[&whole[..], &[0]].concat()).is_err());
        let with = |at: usize, value: u64| {
            let mut bytes = whole.clone();
            bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            parse_covariances(&bytes)
        };
        for number in [3, u64::MAX] {
            assert_eq!(with(0, number), Err(LoopBytesError::Length));
        }
        let second = 8 + COVARIANCE_BYTES;
        for value in [f64::NAN, f64::INFINITY, -1.0] {
            assert_eq!(with(second + 8, value.to_bits()), Err(LoopBytesError::Covariance(9)));
        }
    }
}
