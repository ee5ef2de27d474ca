//! The whole map as a binary file, little-endian: the mapper writes it, supervisor and mapper read
//! it. Everything read is checked: a broken file gives an error that names what is wrong.
//!
//! Layout: magic, then the first free epoch (u32), the number of keyframes (u64), then each keyframe: id, revision, sequence
//! (u64), stamp (i64), epoch, map state, whether its depth is refined (0 or 1), width, height (u32), pose (8 × f64), intrinsics
//! (4 × f64), covariance of common depth errors (6 × f64) and of the place (28 × f64), number of points (u64), points (u16, u16, 3 × f32), number of image bytes (u64, 0 where the
//! image was given up), image bytes. Then the number of frames that were aligned again (u64), each: sequence, keyframe
//! (u64), pose relative to that (7 × f64); and the number of points of the joint estimation (u64), each: keyframe (u64),
//! u, v (u16), confirmations (u32), inverse depth, brightness (f32). Then bytes of the loops (u64), and these
//! (`loop_bytes`).

use std::io::{self, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::capture::input_file;
use crate::service::atomic_file::write_atomically;
use crate::service::loop_bytes::{LoopBytesError, MAX_LOOP_BYTES, loop_bytes, parse_loops};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{DepthPoint, Keyframe, MAX_KEYFRAME_POINTS};
use crate::slam::loops::known::KnownLoops;
use crate::slam::map::{ConfirmedPoint, FramePlace, Map};
use crate::slam::pose::NO_KEYFRAME;
use crate::wire::conversion::{
    MessageError, check_points, code_from_map_state, map_state_from_code,
    mode_covariance_from_message, place_covariance_from_message, rigid_from_message, rigid_message,
    similarity_from_message, similarity_message,
};

/// First bytes of the file, with the version of the layout.
const MAGIC: [u8; 16] = *b"semidense map 9\n";
/// Largest id or revision: what comes after it must not overflow.
const MAX_NUMBER: u64 = u64::MAX / 2;
/// Largest number of an epoch, for the same reason.
const MAX_EPOCH: u32 = u32::MAX / 2;
/// More keyframes than an hour at one each 30 ms: a broken number, not a map.
const MAX_KEYFRAMES: u64 = 120_000;

/// More frames than ten days at 30 Hz.
const MAX_FRAMES: u64 = 26_000_000;
/// Points of the joint estimation that the largest map of the largest window has.
const MAX_CONFIRMED: u64 = MAX_KEYFRAMES * 5000;

/// Why a map cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum MapFileError {
    /// The file cannot be read, or ends too early.
    #[error("{path}: {source}; the map is not usable")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The file is something else.
    #[error("{0} is not a map of this version")]
    Magic(PathBuf),
    /// More than any map has.
    #[error("{path}: {what} = {count} is more than any map has")]
    TooMany {
        /// The file.
        path: PathBuf,
        /// Of what.
        what: &'static str,
        /// How many.
        count: u64,
    },
    /// A keyframe is broken.
    #[error("{path}: keyframe {index}: {source}")]
    Keyframe {
        /// The file.
        path: PathBuf,
        /// Its place in the file.
        index: u64,
        /// What is wrong.
        source: MessageError,
    },
    /// A frame is broken.
    #[error("{path}: frame {sequence}: {source}")]
    Frame {
        /// The file.
        path: PathBuf,
        /// Its sequence.
        sequence: u64,
        /// What is wrong.
        source: MessageError,
    },
    /// The loops are broken.
    #[error("{path}: loops: {source}")]
    Loops {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: LoopBytesError,
    },
    /// There is more than the map.
    #[error("{0} has bytes after the end of the map")]
    Trailing(PathBuf),
}

/// Writes `map` under a temporary name and renames it to `path`. `each` is called before each keyframe: a large
/// map on a slow disk takes longer than a process may be silent.
pub fn write_map(path: &Path, map: &Map, each: &mut dyn FnMut()) -> io::Result<()> {
    write_atomically(path, |file| {
        write_head(file, map)?;
        map.keyframes.iter().try_for_each(|keyframe| {
            each();
            write_keyframe(file, keyframe)
        })?;
        each();
        write_rest(file, map)
    })
}

/// Writes the bytes of `map`.
pub fn write_map_into(file: &mut impl Write, map: &Map) -> io::Result<()> {
    write_head(file, map)?;
    map.keyframes.iter().try_for_each(|keyframe| write_keyframe(file, keyframe))?;
    write_rest(file, map)
}

fn write_head(file: &mut impl Write, map: &Map) -> io::Result<()> {
    file.write_all(&MAGIC)?;
    file.write_all(&map.free_epoch.to_le_bytes())?;
    file.write_all(&map.revision.to_le_bytes())?;
    file.write_all(&map.active.unwrap_or(NO_KEYFRAME).to_le_bytes())?;
    file.write_all(&(map.keyframes.len() as u64).to_le_bytes())
}

fn write_keyframe(file: &mut impl Write, keyframe: &Keyframe) -> io::Result<()> {
    let k = &keyframe.intrinsics;
    let numbers =
        [keyframe.keyframe_id, keyframe.revision, keyframe.map_revision, keyframe.sequence];
    for number in numbers {
        file.write_all(&number.to_le_bytes())?;
    }
    file.write_all(&keyframe.capture_nanos.to_le_bytes())?;
    let state = code_from_map_state(keyframe.map_state);
    let is_refined = u32::from(keyframe.is_refined);
    for number in [keyframe.epoch, state, is_refined, k.width as u32, k.height as u32] {
        file.write_all(&number.to_le_bytes())?;
    }
    let in_world = similarity_message(&keyframe.world_from_keyframe);
    let in_map = similarity_message(&keyframe.map_from_keyframe);
    let intrinsics = [k.fx, k.fy, k.cx, k.cy];
    let modes = keyframe.mode_covariance.upper_triangle();
    let place = keyframe.place_covariance.upper_triangle();
    for number in in_world.into_iter().chain(in_map).chain(intrinsics).chain(modes).chain(place) {
        file.write_all(&number.to_le_bytes())?;
    }
    file.write_all(&(keyframe.points.len() as u64).to_le_bytes())?;
    for point in &keyframe.points {
        file.write_all(&point.u.to_le_bytes())?;
        file.write_all(&point.v.to_le_bytes())?;
        for number in [point.inverse_depth, point.variance, point.intensity] {
            file.write_all(&number.to_le_bytes())?;
        }
    }
    file.write_all(&(keyframe.image.len() as u64).to_le_bytes())?;
    file.write_all(&keyframe.image)
}

/// Frames that were aligned again and points of the joint estimation.
fn write_rest(file: &mut impl Write, map: &Map) -> io::Result<()> {
    file.write_all(&(map.frames.len() as u64).to_le_bytes())?;
    for frame in &map.frames {
        file.write_all(&frame.sequence.to_le_bytes())?;
        file.write_all(&frame.keyframe_id.to_le_bytes())?;
        for number in rigid_message(&frame.keyframe_from_camera) {
            file.write_all(&number.to_le_bytes())?;
        }
    }
    file.write_all(&(map.confirmed.len() as u64).to_le_bytes())?;
    map.confirmed.iter().try_for_each(|point| {
        file.write_all(&point.keyframe_id.to_le_bytes())?;
        file.write_all(&point.u.to_le_bytes())?;
        file.write_all(&point.v.to_le_bytes())?;
        file.write_all(&point.confirmations.to_le_bytes())?;
        file.write_all(&point.inverse_depth.to_le_bytes())?;
        file.write_all(&point.intensity.to_le_bytes())
    })?;
    let loops = loop_bytes(&map.loops);
    file.write_all(&(loops.len() as u64).to_le_bytes())?;
    file.write_all(&loops)
}

/// Reads the map that [`write_map`] wrote.
pub fn read_map(path: &Path) -> Result<Map, MapFileError> {
    let file = input_file::open(path)
        .map_err(|source| MapFileError::Read { path: path.to_owned(), source })?;
    parse_map(path, BufReader::new(file))
}

/// Reads the map from the bytes of a file that came from `path`.
pub fn parse_map(path: &Path, bytes: impl Read) -> Result<Map, MapFileError> {
    let mut reader = Reader { file: bytes, path };
    if reader.bytes::<16>()? != MAGIC {
        return Err(MapFileError::Magic(path.to_owned()));
    }
    let free_epoch = reader.epoch()?;
    let revision = reader.count("map revision", MAX_NUMBER)?;
    let active = Some(reader.u64()?).filter(|&id| id != NO_KEYFRAME);
    let mut map = Map { free_epoch, revision, active, ..Map::default() };
    let count = reader.count("keyframes", MAX_KEYFRAMES)?;
    for index in 0..count {
        map.keyframes.push(reader.keyframe(index)?);
    }
    for _ in 0..reader.count("frames", MAX_FRAMES)? {
        map.frames.push(reader.frame()?);
    }
    // By their sequence a frame is looked up.
    map.frames.sort_by_key(|frame| frame.sequence);
    for _ in 0..reader.count("points", MAX_CONFIRMED)? {
        let point = reader.confirmed()?;
        // One without its keyframe has no place.
        map.confirmed.extend(Some(point).filter(|point| is_placed(&map, point)));
    }
    map.loops = Arc::new(reader.loops()?);
    match reader.file.read(&mut [0]) {
        Ok(0) => Ok(map),
        _ => Err(MapFileError::Trailing(path.to_owned())),
    }
}

/// Whether a point lies in the image of its keyframe, at a distance.
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

/// The keyframe of [`keyframe_bytes`], and nothing after it.
pub fn parse_keyframe(bytes: &[u8]) -> Result<Keyframe, MapFileError> {
    let path = Path::new("keyframe");
    let mut reader = Reader { file: bytes, path };
    let keyframe = reader.keyframe(0)?;
    if reader.file.is_empty() { Ok(keyframe) } else { Err(MapFileError::Trailing(path.to_owned())) }
}

/// Reads numbers and says where it failed.
struct Reader<'a, R> {
    file: R,
    path: &'a Path,
}

impl<R: Read> Reader<'_, R> {
    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], MapFileError> {
        let mut bytes = [0; N];
        self.file
            .read_exact(&mut bytes)
            .map_err(|source| MapFileError::Read { path: self.path.to_owned(), source })?;
        Ok(bytes)
    }

    fn u64(&mut self) -> Result<u64, MapFileError> {
        Ok(u64::from_le_bytes(self.bytes()?))
    }

    fn u32(&mut self) -> Result<u32, MapFileError> {
        Ok(u32::from_le_bytes(self.bytes()?))
    }

    fn f64(&mut self) -> Result<f64, MapFileError> {
        Ok(f64::from_le_bytes(self.bytes()?))
    }

    fn f32(&mut self) -> Result<f32, MapFileError> {
        Ok(f32::from_le_bytes(self.bytes()?))
    }

    fn count(&mut self, what: &'static str, most: u64) -> Result<u64, MapFileError> {
        let count = self.u64()?;
        self.at_most(what, count, most)
    }

    fn epoch(&mut self) -> Result<u32, MapFileError> {
        self.count_u32("epoch", MAX_EPOCH)
    }

    fn count_u32(&mut self, what: &'static str, most: u32) -> Result<u32, MapFileError> {
        let count = self.u32()?;
        self.at_most(what, u64::from(count), u64::from(most)).map(|_| count)
    }

    fn at_most(&self, what: &'static str, count: u64, most: u64) -> Result<u64, MapFileError> {
        if count <= most {
            return Ok(count);
        }
        Err(MapFileError::TooMany { path: self.path.to_owned(), what, count })
    }

    fn keyframe(&mut self, index: u64) -> Result<Keyframe, MapFileError> {
        let path = self.path.to_owned();
        let wrong = move |source| MapFileError::Keyframe { path: path.clone(), index, source };
        let keyframe_id = self.count("keyframe id", MAX_NUMBER)?;
        let revision = self.count("revision", MAX_NUMBER)?;
        let map_revision = self.count("map revision", MAX_NUMBER)?;
        let sequence = self.u64()?;
        let capture_nanos = i64::from_le_bytes(self.bytes()?);
        let (epoch, state) = (self.epoch()?, self.u32()?);
        let is_refined = self.count_u32("refined", 1)? == 1;
        let (width, height) = (self.u32()?, self.u32()?);
        let (in_world, in_map) = (self.numbers()?, self.numbers()?);
        let [fx, fy, cx, cy] = self.numbers()?;
        let intrinsics =
            Intrinsics { fx, fy, cx, cy, width: width as usize, height: height as usize };
        if !intrinsics.is_valid() {
            return Err(wrong(MessageError::InvalidIntrinsics { width, height }));
        }
        let mode_covariance = mode_covariance_from_message(&self.numbers()?).map_err(&wrong)?;
        let place_covariance = place_covariance_from_message(&self.numbers()?).map_err(&wrong)?;
        let num_points = self.count("points", MAX_KEYFRAME_POINTS as u64)?;
        let points = (0..num_points).map(|_| self.point()).collect::<Result<Vec<_>, _>>()?;
        check_points(&points, &intrinsics).map_err(&wrong)?;
        let size = intrinsics.width * intrinsics.height;
        let bytes = self.count("image bytes", size as u64)? as usize;
        if bytes != 0 && bytes != size {
            let (path, what) = (self.path.to_owned(), "image bytes");
            return Err(MapFileError::TooMany { path, what, count: bytes as u64 });
        }
        let mut image = vec![0; bytes];
        self.file
            .read_exact(&mut image)
            .map_err(|source| MapFileError::Read { path: self.path.to_owned(), source })?;
        Ok(Keyframe {
            keyframe_id,
            epoch,
            revision,
            sequence,
            capture_nanos,
            map_state: map_state_from_code(state).map_err(&wrong)?,
            world_from_keyframe: similarity_from_message(&in_world, "world_from_keyframe")
                .map_err(&wrong)?,
            map_from_keyframe: similarity_from_message(&in_map, "map_from_keyframe")
                .map_err(&wrong)?,
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

    fn frame(&mut self) -> Result<FramePlace, MapFileError> {
        let (sequence, keyframe_id) = (self.u64()?, self.u64()?);
        let keyframe_from_camera =
            rigid_from_message(&self.numbers()?, "keyframe_from_camera").map_err(|source| {
                MapFileError::Frame { path: self.path.to_owned(), sequence, source }
            })?;
        Ok(FramePlace { sequence, keyframe_id, keyframe_from_camera })
    }

    fn confirmed(&mut self) -> Result<ConfirmedPoint, MapFileError> {
        Ok(ConfirmedPoint {
            keyframe_id: self.u64()?,
            u: u16::from_le_bytes(self.bytes()?),
            v: u16::from_le_bytes(self.bytes()?),
            confirmations: self.u32()?,
            inverse_depth: self.f32()?,
            intensity: self.f32()?,
        })
    }

    fn loops(&mut self) -> Result<KnownLoops, MapFileError> {
        let count = self.count("loop bytes", MAX_LOOP_BYTES)?;
        let mut bytes = Vec::new();
        let wrong = |source| MapFileError::Read { path: self.path.to_owned(), source };
        // A broken number asks for no more than there is; what is missing is missed by the parser.
        self.file.by_ref().take(count).read_to_end(&mut bytes).map_err(wrong)?;
        parse_loops(&bytes)
            .map_err(|source| MapFileError::Loops { path: self.path.to_owned(), source })
    }

    fn numbers<const N: usize>(&mut self) -> Result<[f64; N], MapFileError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Ok(numbers)
    }

    fn point(&mut self) -> Result<DepthPoint, MapFileError> {
        let u = u16::from_le_bytes(self.bytes()?);
        let v = u16::from_le_bytes(self.bytes()?);
        let (inverse_depth, variance, intensity) = (self.f32()?, self.f32()?, self.f32()?);
        Ok(DepthPoint { u, v, inverse_depth, variance, intensity })
    }
}

#[cfg(test)]
mod tests;
