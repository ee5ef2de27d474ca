//! The log of a run: an append-only file of checked records, little-endian; messages are stored as received.
//!
//! Layout: magic, then records: byte count of kind and payload together (u32), their CRC-32 (u32), kind (u8), payload.
//! A dying process tears at most the last record: reading ends at the first incomplete record, and those before it
//! count.

use std::io::Read;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use zerocopy::{FromBytes, Immutable, IntoBytes};

use crate::service::bytes::take;
use crate::service::journal::any_bytes::AnyBytes;
use crate::service::map_file::{keyframe_bytes, parse_keyframe};
use crate::service::results::record::{LoadedMap, RunCounters, RunMode};
use crate::slam::keyframe::{Keyframe, KeyframePose};
use crate::wire::conversion::{similarity_from_message, similarity_message};
use crate::wire::message::{AdjustmentMessage, PoseMessage};

/// First bytes of the file, with the version of the layout.
const MAGIC: [u8; 16] = *b"semidense log 9\n";
/// Bytes before kind and payload.
const PREFIX_BYTES: usize = 8;
/// Largest record, bytes: the configuration is a tenth of it.
const MAX_RECORD_BYTES: usize = 1 << 20;

/// How a run was started: everything needed to open its source again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunStart {
    /// How it is driven.
    pub mode: RunMode,
    /// Source of the frames; a path in it may have any bytes.
    pub source: AnyBytes,
    /// The camera's rig file.
    pub rig: Option<AnyBytes>,
    /// The folder that relative paths refer to.
    pub folder: AnyBytes,
    /// The whole configuration, as TOML.
    pub config: String,
    /// Whether poses were given rather than estimated.
    pub poses_given: bool,
    /// Whether keyframes took their first depth from the source's depth camera.
    #[serde(default)]
    pub is_depth_from_sensor: bool,
    /// First id of a keyframe made in the run.
    #[serde(default)]
    pub first_keyframe_id: u64,
    /// Start time, nanoseconds since 1970: two runs may begin in one second.
    pub began_nanos: u64,
}

impl RunStart {
    /// When the run began.
    pub fn began(&self) -> SystemTime {
        UNIX_EPOCH.checked_add(Duration::from_nanos(self.began_nanos)).unwrap_or(UNIX_EPOCH)
    }
}

/// A step of the mapper.
#[derive(Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable)]
#[repr(C, packed)]
pub struct Step {
    /// Time it took.
    pub step_nanos: u64,
    /// The part of it spent on making and publishing a keyframe; 0 where none was made.
    pub change_nanos: u64,
    /// The outcome of the frame in a start, as its code in `mapper/step`.
    pub start_frame: u32,
}

/// One entry of the log.
#[derive(Debug, Clone)]
pub enum Record {
    /// The first record.
    Start(Box<RunStart>),
    /// A pose as received.
    Pose(Box<PoseMessage>),
    /// A step of the mapper.
    Step(Step),
    /// A finished joint estimate of keyframes.
    Adjustment(AdjustmentMessage),
    /// The counters so far.
    Counters(Box<RunCounters>),
    /// A keyframe without image and points.
    Keyframe(Box<Keyframe>),
    /// The new pose of a keyframe; its uncertainty is unchanged.
    KeyframePose(u32, KeyframePose),
    /// The map that the mapper has switched to.
    LoadedMap(Box<LoadedMap>),
}

impl Record {
    const START: u8 = 1;
    const POSE: u8 = 2;
    const STEP: u8 = 3;
    const COUNTERS: u8 = 4;
    const KEYFRAME: u8 = 5;
    const KEYFRAME_POSE: u8 = 6;
    const ADJUSTMENT: u8 = 7;
    const LOADED_MAP: u8 = 8;

    /// Appends the record's bytes to `log`.
    pub fn write(&self, log: &mut Vec<u8>) {
        let begin = log.len();
        log.extend([0; PREFIX_BYTES]);
        self.write_body(log);
        let body = &log[begin + PREFIX_BYTES..];
        let (length, checksum) = (body.len() as u32, crc32fast::hash(body));
        log[begin..begin + 4].copy_from_slice(&length.to_le_bytes());
        log[begin + 4..begin + PREFIX_BYTES].copy_from_slice(&checksum.to_le_bytes());
    }

    fn write_body(&self, log: &mut Vec<u8>) {
        match self {
            Self::Start(start) => {
                log.push(Self::START);
                // Strings and plain values, which JSON can always hold.
                log.extend(serde_json::to_vec(start).unwrap_or_default());
            }
            Self::Pose(pose) => {
                log.push(Self::POSE);
                log.extend(pose.as_bytes());
            }
            Self::Step(step) => {
                log.push(Self::STEP);
                log.extend(step.as_bytes());
            }
            Self::Adjustment(adjustment) => {
                log.push(Self::ADJUSTMENT);
                log.extend(adjustment.as_bytes());
            }
            Self::Counters(counters) => {
                log.push(Self::COUNTERS);
                log.extend(serde_json::to_vec(counters).unwrap_or_default());
            }
            Self::LoadedMap(map) => {
                log.push(Self::LOADED_MAP);
                log.extend(serde_json::to_vec(map).unwrap_or_default());
            }
            Self::Keyframe(keyframe) => {
                log.push(Self::KEYFRAME);
                log.extend(keyframe_bytes(keyframe));
            }
            Self::KeyframePose(epoch, pose) => {
                log.push(Self::KEYFRAME_POSE);
                log.extend([u64::from(*epoch), pose.keyframe_id, pose.revision].as_bytes());
                log.extend(similarity_message(&pose.map_from_keyframe).as_bytes());
            }
        }
    }

    /// The record of a kind and a payload; `None` where they do not match.
    fn from_body(body: &[u8]) -> Option<Self> {
        let (&kind, payload) = body.split_first()?;
        let mut bytes = payload;
        let record = match kind {
            Self::START => return serde_json::from_slice(payload).ok().map(Self::Start),
            Self::COUNTERS => return serde_json::from_slice(payload).ok().map(Self::Counters),
            Self::LOADED_MAP => return serde_json::from_slice(payload).ok().map(Self::LoadedMap),
            Self::KEYFRAME => {
                let keyframe = parse_keyframe(payload).ok()?;
                return Some(Self::Keyframe(Box::new(keyframe)));
            }
            Self::POSE => Self::Pose(Box::new(take(&mut bytes)?)),
            Self::STEP => Self::Step(take(&mut bytes)?),
            Self::ADJUSTMENT => Self::Adjustment(take(&mut bytes)?),
            Self::KEYFRAME_POSE => {
                let [epoch, keyframe_id, revision]: [u64; 3] = take(&mut bytes)?;
                let pose = similarity_from_message(&take(&mut bytes)?, "pose").ok()?;
                let pose = KeyframePose { keyframe_id, revision, map_from_keyframe: pose };
                Self::KeyframePose(u32::try_from(epoch).ok()?, pose)
            }
            _ => return None,
        };
        bytes.is_empty().then_some(record)
    }
}

/// The first bytes of a log.
pub fn log_header() -> Vec<u8> {
    MAGIC.to_vec()
}

/// How a log ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogEnd {
    /// With a whole record.
    Whole,
    /// Bytes after the last whole record cannot be read: the process died while writing.
    Torn,
    /// The bytes are not a log of this version.
    Unknown,
}

/// Reads a log to its end, or to the first incomplete record.
pub fn read_log(mut log: impl Read, take: &mut dyn FnMut(Record)) -> LogEnd {
    let mut magic = [0; MAGIC.len()];
    if log.read_exact(&mut magic).is_err() || magic != MAGIC {
        return LogEnd::Unknown;
    }
    let mut body = Vec::new();
    loop {
        let mut prefix = Vec::with_capacity(PREFIX_BYTES);
        match log.by_ref().take(PREFIX_BYTES as u64).read_to_end(&mut prefix) {
            Ok(0) => return LogEnd::Whole,
            Ok(PREFIX_BYTES) => {}
            _ => return LogEnd::Torn,
        }
        let Ok([length, checksum]) = <[u32; 2]>::read_from_bytes(&prefix) else {
            return LogEnd::Torn;
        };
        if length as usize > MAX_RECORD_BYTES {
            return LogEnd::Torn;
        }
        body.clear();
        let read = log.by_ref().take(u64::from(length)).read_to_end(&mut body);
        let is_whole = read.is_ok_and(|bytes| bytes == length as usize);
        if !is_whole || crc32fast::hash(&body) != checksum {
            return LogEnd::Torn;
        }
        match Record::from_body(&body) {
            Some(record) => take(record),
            None => return LogEnd::Torn,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::os::unix::ffi::OsStringExt;

    use super::*;
    use crate::slam::frame::FrameView;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::pose::PoseEstimate;
    use crate::wire::conversion::{PoseTiming, pose_message};

    fn records() -> Vec<Record> {
        let start = RunStart {
            mode: RunMode::Live,
            source: OsString::from_vec(b"tum:a \"b\"\n\xff".to_vec()).into(),
            rig: None,
            folder: "/x".into(),
            config: "instance = \"x\"\n".into(),
            poses_given: false,
            is_depth_from_sensor: true,
            first_keyframe_id: 3,
            began_nanos: 5,
        };
        let frame = FrameView {
            sequence: 7,
            capture_nanos: -5,
            exposure_nanos: 0,
            width: 0,
            height: 0,
            pixels: &[],
        };
        let timing = PoseTiming { published_nanos: 11, latency_nanos: 12, ..Default::default() };
        let mut pose = pose_message(&PoseEstimate::unknown(&frame), &timing);
        (pose.covariance[20], pose.map_covariance[20]) = (0.125, 0.25);
        let map_from_keyframe = Sim3::new(SE3::identity(), 1.5);
        let keyframe = Keyframe {
            keyframe_id: 3,
            epoch: 1,
            revision: 9,
            sequence: 7,
            capture_nanos: -5,
            ..Keyframe::at(
                map_from_keyframe,
                Intrinsics { fx: 20.0, fy: 21.0, cx: 8.0, cy: 7.5, width: 17, height: 16 },
                Vec::new(),
                Vec::new(),
            )
        };
        vec![
            Record::Start(Box::new(start)),
            Record::Pose(Box::new(pose)),
            Record::Step(Step { step_nanos: 5, change_nanos: 6, start_frame: 2 }),
            Record::Adjustment(AdjustmentMessage {
                sequence: 1,
                frames: 2,
                cpu_nanos: 3,
                keyframe_id: 4,
                inlier_ratio: 0.5,
                rms_grey: 6.0,
                fate: 1,
                free: 8,
                fixed: 9,
                points: 10,
                comparisons: 11,
                iterations: 12,
            }),
            Record::Counters(Box::new(RunCounters {
                frames_in: 8,
                gaps: 9,
                ..RunCounters::default()
            })),
            Record::Keyframe(Box::new(keyframe)),
            Record::KeyframePose(
                1,
                KeyframePose { keyframe_id: 3, revision: 5, map_from_keyframe },
            ),
            Record::LoadedMap(Box::new(LoadedMap {
                folder: "/maps/hall".to_owned(),
                read_only: true,
                first_epoch: 2,
                first_keyframe_id: 40,
            })),
        ]
    }

    fn read(bytes: &[u8]) -> (Vec<Record>, LogEnd) {
        let mut found = Vec::new();
        let end = read_log(bytes, &mut |record| found.push(record));
        (found, end)
    }

    #[test]
    fn every_record_is_read_back_and_a_torn_end_costs_one() {
        let mut log = log_header();
        let mut ends = vec![log.len()];
        for record in records() {
            record.write(&mut log);
            ends.push(log.len());
        }
        let (found, end) = read(&log);
        assert_eq!(end, LogEnd::Whole);
        assert_eq!(format!("{found:?}"), format!("{:?}", records()));
        for length in 0..log.len() {
            let (found, end) = read(&log[..length]);
            assert_eq!(found.len(), ends.iter().filter(|&&e| e <= length).count().max(1) - 1);
            let is_whole = ends.contains(&length);
            let expected = match (length < MAGIC.len(), is_whole) {
                (true, _) => LogEnd::Unknown,
                (_, true) => LogEnd::Whole,
                _ => LogEnd::Torn,
            };
            assert_eq!(end, expected, "{length} bytes");
        }
        for place in MAGIC.len()..log.len() {
            let mut broken = log.clone();
            broken[place] ^= 0x10;
            let (found, end) = read(&broken);
            let whole = ends.iter().filter(|&&e| e <= place).count() - 1;
            assert_eq!((found.len(), end), (whole, LogEnd::Torn), "byte {place}");
        }
    }
}
