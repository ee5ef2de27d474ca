//! The whole map as a binary file, little-endian: the mapper writes it, supervisor and mapper read it. Everything read
//! is checked: a corrupt file gives an error that names what is wrong.
//!
//! Layout: magic, first free epoch (u32), map revision, active keyframe (all bits set for none), number of keyframes
//! (u64), then each keyframe: id, revision, map revision, sequence (u64), stamp (i64), epoch, map state, whether its
//! depth is refined (0 or 1), width, height (u32), poses in the world and in the map (8 × f64 each), intrinsics (4 ×
//! f64), covariance of common depth errors (6 × f64) and of the pose (28 × f64), number of points (u64), points (u16,
//! u16, 3 × f32), number of image bytes (u64, 0 without an image), image bytes. Then the number of realigned frames
//! (u64), each: sequence, keyframe (u64), pose relative to that (7 × f64); the number of points of the joint estimation
//! (u64), each: keyframe (u64), u, v (u16), confirmations (u32), inverse depth, brightness (f32); bytes of the loops
//! (u64), and these; bytes of their covariances (u64), and these (`loop_bytes`). Layout 9 ended before the
//! covariances.

use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use zerocopy::{FromBytes, IntoBytes};

use crate::capture::input_file;
use crate::service::atomic_file::write_atomically;
use crate::service::loop_bytes::{
    LoopBytesError, MAX_LOOP_BYTES, covariance_bytes, loop_bytes, parse_covariances, parse_loops,
};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{Keyframe, MAX_KEYFRAME_POINTS};
use crate::slam::map::{ConfirmedPoint, FramePose, Map};
use crate::slam::pose::NO_KEYFRAME;
use crate::wire::conversion::{
    MessageError, check_points, code_from_map_state, map_state_from_code,
    mode_covariance_from_message, pose_covariance_from_message, rigid_from_message, rigid_message,
    similarity_from_message, similarity_message,
};

/// First bytes of the file, with the version of the layout.
const MAGIC: [u8; 16] = *b"semidense map10\n";
/// Those of the layout before it, which is read too.
const MAGIC_9: [u8; 16] = *b"semidense map 9\n";
/// Largest id or revision: later ones must not overflow.
const MAX_NUMBER: u64 = u64::MAX / 2;
/// Largest epoch, for the same reason.
const MAX_EPOCH: u32 = u32::MAX / 2;
/// More keyframes than an hour at one each 30 ms: an invalid number, not a map.
const MAX_KEYFRAMES: u64 = 120_000;

/// More frames than ten days at 30 Hz.
const MAX_FRAMES: u64 = 26_000_000;
/// Points of the joint estimation in the largest map of the largest window.
const MAX_CONFIRMED: u64 = MAX_KEYFRAMES * 5000;

/// Why a map cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {fault}")]
pub struct MapFileError {
    /// The file.
    pub path: PathBuf,
    /// What is wrong.
    pub fault: MapFault,
}

/// What is wrong with the bytes of a map.
#[derive(Debug, thiserror::Error)]
pub enum MapFault {
    /// They cannot be read, or end too early.
    #[error("{0}; the map is not usable")]
    Read(#[from] io::Error),
    /// They are not a map of this version.
    #[error("it is not a map of this version")]
    Magic,
    /// A count exceeds that of any map.
    #[error("{what} = {count} exceeds the limit of a map")]
    TooMany {
        /// What is counted.
        what: &'static str,
        /// The count.
        count: u64,
    },
    /// A keyframe is invalid.
    #[error("keyframe {index}: {source}")]
    Keyframe {
        /// Its index in the file.
        index: u64,
        /// What is wrong.
        source: MessageError,
    },
    /// A frame is invalid.
    #[error("frame {sequence}: {source}")]
    Frame {
        /// Its sequence.
        sequence: u64,
        /// What is wrong.
        source: MessageError,
    },
    /// The loops are invalid.
    #[error("loops: {0}")]
    Loops(#[from] LoopBytesError),
    /// Bytes follow the end of the map.
    #[error("it has bytes after the end of the map")]
    Trailing,
}

/// Writes `map` under a temporary name and renames it to `path`. Calls `each` before each keyframe: a large map on a
/// slow disk takes longer than a process may be silent.
pub fn write_map(path: &Path, map: &Map, each: &mut dyn FnMut()) -> io::Result<()> {
    write_atomically(path, |file| write_map_into(file, map, each))
}

/// Writes the bytes of `map`. Calls `each` before each keyframe and before what follows them.
pub fn write_map_into(file: &mut impl Write, map: &Map, each: &mut dyn FnMut()) -> io::Result<()> {
    file.write_all(&MAGIC)?;
    file.write_all(map.free_epoch.as_bytes())?;
    let active = map.active.unwrap_or(NO_KEYFRAME);
    file.write_all([map.revision, active, map.keyframes.len() as u64].as_bytes())?;
    for keyframe in &map.keyframes {
        each();
        write_keyframe(file, keyframe)?;
    }
    each();
    write_rest(file, map)
}

fn write_keyframe(file: &mut impl Write, keyframe: &Keyframe) -> io::Result<()> {
    let Keyframe { keyframe_id, revision, map_revision, sequence, epoch, .. } = *keyframe;
    let k = &keyframe.intrinsics;
    file.write_all([keyframe_id, revision, map_revision, sequence].as_bytes())?;
    file.write_all(keyframe.capture_nanos.as_bytes())?;
    let state = code_from_map_state(keyframe.map_state);
    let is_refined = u32::from(keyframe.is_refined);
    file.write_all([epoch, state, is_refined, k.width as u32, k.height as u32].as_bytes())?;
    file.write_all(similarity_message(&keyframe.world_from_keyframe).as_bytes())?;
    file.write_all(similarity_message(&keyframe.map_from_keyframe).as_bytes())?;
    file.write_all([k.fx, k.fy, k.cx, k.cy].as_bytes())?;
    file.write_all(keyframe.mode_covariance.upper_triangle().as_bytes())?;
    file.write_all(keyframe.place_covariance.upper_triangle().as_bytes())?;
    file.write_all((keyframe.points.len() as u64).as_bytes())?;
    file.write_all(keyframe.points.as_bytes())?;
    file.write_all((keyframe.image.len() as u64).as_bytes())?;
    file.write_all(&keyframe.image)
}

/// Realigned frames, points of the joint estimation and loops.
fn write_rest(file: &mut impl Write, map: &Map) -> io::Result<()> {
    file.write_all((map.frames.len() as u64).as_bytes())?;
    for frame in &map.frames {
        file.write_all([frame.sequence, frame.keyframe_id].as_bytes())?;
        file.write_all(rigid_message(&frame.keyframe_from_camera).as_bytes())?;
    }
    file.write_all((map.confirmed.len() as u64).as_bytes())?;
    map.confirmed.iter().try_for_each(|point| {
        file.write_all(point.keyframe_id.as_bytes())?;
        file.write_all([point.u, point.v].as_bytes())?;
        file.write_all(point.confirmations.as_bytes())?;
        file.write_all([point.inverse_depth, point.intensity].as_bytes())
    })?;
    [loop_bytes(&map.loops), covariance_bytes(&map.loops)].iter().try_for_each(|bytes| {
        file.write_all((bytes.len() as u64).as_bytes())?;
        file.write_all(bytes)
    })
}

/// Reads the map that [`write_map`] wrote.
pub fn read_map(path: &Path) -> Result<Map, MapFileError> {
    let opened = input_file::open(path).map_err(MapFault::Read);
    let map = opened.and_then(|file| parse_map(BufReader::new(file)));
    map.map_err(|fault| MapFileError { path: path.to_owned(), fault })
}

/// Reads the map from the bytes of a file.
pub fn parse_map(bytes: impl Read) -> Result<Map, MapFault> {
    let mut reader = Reader(bytes);
    let magic = reader.take::<[u8; 16]>()?;
    if ![MAGIC, MAGIC_9].contains(&magic) {
        return Err(MapFault::Magic);
    }
    let free_epoch = reader.epoch()?;
    let revision = reader.count("map revision", MAX_NUMBER)?;
    let active = Some(reader.take()?).filter(|&id| id != NO_KEYFRAME);
    let mut map = Map { free_epoch, revision, active, ..Map::default() };
    let count = reader.count("keyframes", MAX_KEYFRAMES)?;
    for index in 0..count {
        map.keyframes.push(reader.keyframe(index)?);
    }
    for _ in 0..reader.count("frames", MAX_FRAMES)? {
        map.frames.push(reader.frame()?);
    }
    // Frames are looked up by sequence.
    map.frames.sort_by_key(|frame| frame.sequence);
    for _ in 0..reader.count("points", MAX_CONFIRMED)? {
        let point = reader.confirmed()?;
        // A point without its keyframe cannot be placed.
        map.confirmed.extend(Some(point).filter(|point| is_placed(&map, point)));
    }
    let mut loops = parse_loops(&reader.loop_bytes()?)?;
    match magic == MAGIC {
        true => loops.relative_covariances = parse_covariances(&reader.loop_bytes()?)?,
        false => loops.take_places_as_relative(map.keyframes.iter()),
    }
    map.loops = Arc::new(loops);
    match reader.0.read(&mut [0]) {
        Ok(0) => Ok(map),
        _ => Err(MapFault::Trailing),
    }
}

/// Whether a point lies in the image of its keyframe, at a valid depth.
fn is_placed(map: &Map, point: &ConfirmedPoint) -> bool {
    let is_distance = point.inverse_depth.is_finite() && point.inverse_depth > 0.0;
    is_distance
        && point.intensity.is_finite()
        && map.get(point.keyframe_id).is_some_and(|keyframe| {
            let k = &keyframe.intrinsics;
            usize::from(point.u) < k.width && usize::from(point.v) < k.height
        })
}

/// The bytes of one keyframe, as in the file.
pub fn keyframe_bytes(keyframe: &Keyframe) -> Vec<u8> {
    let mut bytes = Vec::new();
    // Writing into memory cannot fail.
    let _ = write_keyframe(&mut bytes, keyframe);
    bytes
}

/// Parses [`keyframe_bytes`], with nothing after it.
pub fn parse_keyframe(bytes: &[u8]) -> Result<Keyframe, MapFault> {
    let mut reader = Reader(bytes);
    let keyframe = reader.keyframe(0)?;
    if reader.0.is_empty() { Ok(keyframe) } else { Err(MapFault::Trailing) }
}

/// Reads and checks numbers.
struct Reader<R>(R);

impl<R: Read> Reader<R> {
    fn take<T: FromBytes + IntoBytes>(&mut self) -> Result<T, MapFault> {
        let mut value = T::new_zeroed();
        self.0.read_exact(value.as_mut_bytes())?;
        Ok(value)
    }

    fn count(&mut self, what: &'static str, most: u64) -> Result<u64, MapFault> {
        let count = self.take()?;
        if count <= most { Ok(count) } else { Err(MapFault::TooMany { what, count }) }
    }

    fn count_u32(&mut self, what: &'static str, most: u32) -> Result<u32, MapFault> {
        let count = self.take()?;
        let too_many = MapFault::TooMany { what, count: u64::from(count) };
        if count <= most { Ok(count) } else { Err(too_many) }
    }

    fn epoch(&mut self) -> Result<u32, MapFault> {
        self.count_u32("epoch", MAX_EPOCH)
    }

    fn keyframe(&mut self, index: u64) -> Result<Keyframe, MapFault> {
        let wrong = |source| MapFault::Keyframe { index, source };
        let keyframe_id = self.count("keyframe id", MAX_NUMBER)?;
        let revision = self.count("revision", MAX_NUMBER)?;
        let map_revision = self.count("map revision", MAX_NUMBER)?;
        let (sequence, capture_nanos) = (self.take()?, self.take()?);
        let (epoch, state) = (self.epoch()?, self.take()?);
        let is_refined = self.count_u32("refined", 1)? == 1;
        let [width, height] = self.take()?;
        let (in_world, in_map) = (self.take()?, self.take()?);
        let [fx, fy, cx, cy] = self.take()?;
        let intrinsics =
            Intrinsics { fx, fy, cx, cy, width: width as usize, height: height as usize };
        if !intrinsics.is_valid() {
            return Err(wrong(MessageError::InvalidIntrinsics { width, height }));
        }
        let mode_covariance = mode_covariance_from_message(&self.take()?).map_err(wrong)?;
        let place_covariance = pose_covariance_from_message(&self.take()?).map_err(wrong)?;
        let num_points = self.count("points", MAX_KEYFRAME_POINTS as u64)?;
        let points = (0..num_points).map(|_| self.take()).collect::<Result<Vec<_>, _>>()?;
        check_points(&points, &intrinsics).map_err(wrong)?;
        let size = (intrinsics.width * intrinsics.height) as u64;
        let count = self.count("image bytes", size)?;
        if count != 0 && count != size {
            return Err(MapFault::TooMany { what: "image bytes", count });
        }
        let mut image = vec![0; count as usize];
        self.0.read_exact(&mut image)?;
        let similarity = |numbers, name| similarity_from_message(numbers, name).map_err(wrong);
        Ok(Keyframe {
            keyframe_id,
            epoch,
            revision,
            sequence,
            capture_nanos,
            map_state: map_state_from_code(state).map_err(wrong)?,
            world_from_keyframe: similarity(&in_world, "world_from_keyframe")?,
            map_from_keyframe: similarity(&in_map, "map_from_keyframe")?,
            map_revision,
            mode_covariance,
            place_covariance,
            is_refined,
            intrinsics,
            image: image.into(),
            points,
            description: None,
        })
    }

    fn frame(&mut self) -> Result<FramePose, MapFault> {
        let [sequence, keyframe_id] = self.take()?;
        let keyframe_from_camera = rigid_from_message(&self.take()?, "keyframe_from_camera")
            .map_err(|source| MapFault::Frame { sequence, source })?;
        Ok(FramePose { sequence, keyframe_id, keyframe_from_camera })
    }

    fn confirmed(&mut self) -> Result<ConfirmedPoint, MapFault> {
        Ok(ConfirmedPoint {
            keyframe_id: self.take()?,
            u: self.take()?,
            v: self.take()?,
            confirmations: self.take()?,
            inverse_depth: self.take()?,
            intensity: self.take()?,
        })
    }

    fn loop_bytes(&mut self) -> Result<Vec<u8>, MapFault> {
        let count = self.count("loop bytes", MAX_LOOP_BYTES)?;
        let mut bytes = Vec::new();
        // An invalid number reads no more than there is; the parser notices what is missing.
        self.0.by_ref().take(count).read_to_end(&mut bytes)?;
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests;
