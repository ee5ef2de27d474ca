//! The manifest of a map folder: the keyframes, their poses, and the file that holds the depth of each.
//!
//! Layout, little-endian: magic, version (u32), then sections: tag (4 bytes), bytes (u64), payload; at the end the
//! CRC-32 of everything before it (u32). An unknown section is skipped if its tag begins with a lower-case letter;
//! otherwise the map is of another version.
//!
//! * `CAMR`: width, height (u32), fx, fy, cx, cy (f64).
//! * `STAT`: detail (u32), first free epoch (u32), revision of the map, number of saves, seconds since 1970 (u64).
//! * `loop`: loops, as in `loop_bytes`; absent where there are none.
//! * `cova`: covariances of keyframes relative to those that they were estimated against, as there; absent without
//!   loops, and in maps of versions that did not store them.
//! * `KEYF`: number of keyframes (u64), each: byte count (u32) of the keyframe without image and points as in
//!   [`map_file`](crate::service::map_file), these bytes; then, 0 where it has no file, revision in the file's name,
//!   bytes (u64), checksum, number of points (u32) of its file.

use std::collections::BTreeMap;
use std::sync::Arc;

use zerocopy::{FromBytes, Immutable, IntoBytes};

use crate::service::bytes;
use crate::service::loop_bytes::{
    LoopBytesError, covariance_bytes, loop_bytes, parse_covariances, parse_loops,
};
use crate::service::map_file::{keyframe_bytes, parse_keyframe};
use crate::service::map_folder::depth_file::{MapDetail, max_file_bytes};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{Keyframe, MAX_KEYFRAME_POINTS};
use crate::slam::loops::record::LoopRecord;

/// First bytes of the file.
const MAGIC: [u8; 16] = *b"semidense mapdir";
/// Version of the layout.
pub const VERSION: u32 = 1;
const CAMERA: [u8; 4] = *b"CAMR";
const STATE: [u8; 4] = *b"STAT";
const KEYFRAMES: [u8; 4] = *b"KEYF";
const LOOPS: [u8; 4] = *b"loop";
const COVARIANCES: [u8; 4] = *b"cova";
/// More keyframes than an hour at one each 30 ms: an invalid number, not a map.
const MAX_KEYFRAMES: usize = 120_000;
/// Largest epoch and largest revision: later ones must not overflow.
const MAX_EPOCH: u32 = u32::MAX / 2;
const MAX_REVISION: u64 = u64::MAX / 2;

/// The contents of a map folder, except image and depth.
#[derive(Debug, Clone, PartialEq)]
pub struct Manifest {
    /// The camera of all keyframes.
    pub camera: Intrinsics,
    /// How much of a keyframe is kept.
    pub detail: MapDetail,
    /// First epoch number that is not in use.
    pub free_epoch: u32,
    /// Loops of the map.
    pub loops: Arc<LoopRecord>,
    /// Number of corrections of the map.
    pub revision: u64,
    /// Number of saves.
    pub saves: u64,
    /// Time of the last save, seconds since 1970.
    pub saved_secs: u64,
    /// Keyframes without image and points, ordered by id, with the file that holds these.
    pub keyframes: Vec<Listed>,
}

/// A keyframe in the manifest.
#[derive(Debug, Clone, PartialEq)]
pub struct Listed {
    /// The keyframe, without image and points.
    pub keyframe: Keyframe,
    /// The file that holds these; `None` where they have not been written, or were given up.
    pub file: Option<DepthFile>,
}

/// The file of a keyframe, as the manifest lists it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, FromBytes, IntoBytes, Immutable)]
#[repr(C)]
pub struct DepthFile {
    /// Revision in its name.
    pub revision: u64,
    /// Its size.
    pub bytes: u64,
    /// The checksum at its end.
    pub checksum: u32,
    /// Points in it.
    pub num_points: u32,
}

impl DepthFile {
    /// Its name in the folder of keyframes.
    pub fn name(&self, keyframe_id: u64) -> String {
        format!("{keyframe_id}.{}", self.revision)
    }
}

/// Why a manifest cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ManifestError {
    /// It is not a manifest.
    #[error("it is not the manifest of a map")]
    Magic,
    /// Another version wrote it.
    #[error(
        "the map has version {0}, but this program reads version {VERSION}: use the version of semidense that wrote it"
    )]
    Version(u32),
    /// It has a required section that is unknown to this program.
    #[error("unknown map section `{0}`: use a newer version of semidense")]
    Section(String),
    /// A bit is wrong, or a part is missing.
    #[error("it is damaged ({0})")]
    Damaged(String),
}

fn damaged(what: &str) -> ManifestError {
    ManifestError::Damaged(what.to_owned())
}

impl Manifest {
    /// An empty map of a camera.
    pub fn new(camera: Intrinsics, detail: MapDetail) -> Self {
        Self {
            camera,
            detail,
            free_epoch: 0,
            loops: Arc::default(),
            revision: 0,
            saves: 0,
            saved_secs: 0,
            keyframes: Vec::new(),
        }
    }

    /// Encodes the manifest.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = MAGIC.to_vec();
        bytes.extend(VERSION.to_le_bytes());
        let k = &self.camera;
        let (size, numbers) = ([k.width as u32, k.height as u32], [k.fx, k.fy, k.cx, k.cy]);
        push_section(&mut bytes, CAMERA, &[size.as_bytes(), numbers.as_bytes()].concat());
        let state = [u32::from(self.detail == MapDetail::Small), self.free_epoch];
        let counts = [self.revision, self.saves, self.saved_secs];
        push_section(&mut bytes, STATE, &[state.as_bytes(), counts.as_bytes()].concat());
        let mut keyframes = Vec::new();
        keyframes.extend((self.keyframes.len() as u64).to_le_bytes());
        for listed in &self.keyframes {
            let head = keyframe_bytes(&listed.keyframe);
            keyframes.extend((head.len() as u32).to_le_bytes());
            keyframes.extend(head);
            keyframes.extend(listed.file.unwrap_or_default().as_bytes());
        }
        push_section(&mut bytes, KEYFRAMES, &keyframes);
        if !self.loops.is_empty() {
            push_section(&mut bytes, LOOPS, &loop_bytes(&self.loops));
            push_section(&mut bytes, COVARIANCES, &covariance_bytes(&self.loops));
        }
        bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
        bytes
    }

    /// Decodes a manifest.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, ManifestError> {
        let mut rest = bytes;
        if take::<[u8; 16]>(&mut rest)? != MAGIC {
            return Err(ManifestError::Magic);
        }
        let version = take(&mut rest)?;
        if version != VERSION {
            return Err(ManifestError::Version(version));
        }
        let (body, checksum) =
            bytes.split_last_chunk::<4>().ok_or_else(|| damaged("it is truncated"))?;
        if crc32fast::hash(body) != u32::from_le_bytes(*checksum) {
            return Err(damaged("its checksum is wrong"));
        }
        rest = rest.get(..rest.len().saturating_sub(4)).unwrap_or_default();
        let mut sections = BTreeMap::new();
        while !rest.is_empty() {
            let tag: [u8; 4] = take(&mut rest)?;
            let length = usize::try_from(take::<u64>(&mut rest)?).ok();
            let payload = length.and_then(|length| rest.split_off(..length));
            let payload = payload.ok_or_else(|| damaged("a section is truncated"))?;
            let is_known = [CAMERA, STATE, KEYFRAMES, LOOPS, COVARIANCES].contains(&tag);
            if !is_known && !tag[0].is_ascii_lowercase() {
                return Err(ManifestError::Section(tag.escape_ascii().to_string()));
            }
            sections.insert(tag, payload);
        }
        let part = |tag: [u8; 4]| {
            sections.get(&tag).copied().ok_or_else(|| damaged("a section is missing"))
        };
        let mut manifest = Self::new(camera_of(part(CAMERA)?)?, MapDetail::Full);
        manifest.read_state(part(STATE)?)?;
        manifest.read_keyframes(part(KEYFRAMES)?)?;
        if let Some(loops) = sections.get(&LOOPS) {
            let refused = |error: LoopBytesError| damaged(&error.to_string());
            let mut parsed = parse_loops(loops).map_err(refused)?;
            match sections.get(&COVARIANCES) {
                Some(bytes) => {
                    parsed.relative_covariances = parse_covariances(bytes).map_err(refused)?;
                }
                None => {
                    let keyframes = manifest.keyframes.iter().map(|listed| &listed.keyframe);
                    parsed.take_places_as_relative(keyframes);
                }
            }
            manifest.loops = Arc::new(parsed);
        }
        Ok(manifest)
    }

    fn read_state(&mut self, mut payload: &[u8]) -> Result<(), ManifestError> {
        let payload = &mut payload;
        self.detail = match take(payload)? {
            0_u32 => MapDetail::Full,
            1 => MapDetail::Small,
            _ => return Err(damaged("detail")),
        };
        self.free_epoch = take(payload)?;
        [self.revision, self.saves, self.saved_secs] = take(payload)?;
        let is_possible = self.free_epoch <= MAX_EPOCH
            && [self.revision, self.saves].iter().all(|number| *number <= MAX_REVISION);
        match is_possible && payload.is_empty() {
            true => Ok(()),
            false => Err(damaged("invalid numbers")),
        }
    }

    fn read_keyframes(&mut self, mut payload: &[u8]) -> Result<(), ManifestError> {
        let payload = &mut payload;
        let count = usize::try_from(take::<u64>(payload)?).unwrap_or(usize::MAX);
        if count > MAX_KEYFRAMES {
            return Err(damaged("too many keyframes"));
        }
        for index in 0..count {
            let at = |what: &str| damaged(&format!("keyframe {index}: {what}"));
            let length = take::<u32>(payload)? as usize;
            let head = payload.split_off(..length).ok_or_else(|| at("it is truncated"))?;
            let keyframe = parse_keyframe(head).map_err(|error| at(&error.to_string()))?;
            let file: DepthFile = take(payload)?;
            let last = self.keyframes.last().map(|last| last.keyframe.keyframe_id);
            let num_pixels = keyframe.intrinsics.width * keyframe.intrinsics.height;
            let is_possible = last.is_none_or(|last| last < keyframe.keyframe_id)
                && keyframe.intrinsics == self.camera
                && keyframe.image.is_empty()
                && keyframe.points.is_empty()
                && file.bytes <= max_file_bytes(num_pixels) as u64
                && file.num_points as usize <= MAX_KEYFRAME_POINTS
                && file.revision <= MAX_REVISION;
            if !is_possible {
                return Err(at("invalid numbers"));
            }
            let file = Some(file).filter(|file| file.bytes > 0);
            self.keyframes.push(Listed { keyframe, file });
        }
        if payload.is_empty() { Ok(()) } else { Err(damaged("bytes after the keyframes")) }
    }

    /// Bytes of all keyframe files.
    pub fn depth_bytes(&self) -> u64 {
        self.keyframes.iter().filter_map(|listed| listed.file).map(|file| file.bytes).sum()
    }

    /// Names of all keyframe files.
    pub fn file_names(&self) -> impl Iterator<Item = String> {
        let named = |listed: &Listed| Some(listed.file?.name(listed.keyframe.keyframe_id));
        self.keyframes.iter().filter_map(named)
    }
}

fn push_section(bytes: &mut Vec<u8>, tag: [u8; 4], payload: &[u8]) {
    bytes.extend(tag);
    bytes.extend((payload.len() as u64).to_le_bytes());
    bytes.extend(payload);
}

fn take<T: FromBytes>(bytes: &mut &[u8]) -> Result<T, ManifestError> {
    bytes::take(bytes).ok_or_else(|| damaged("it is truncated"))
}

fn camera_of(mut payload: &[u8]) -> Result<Intrinsics, ManifestError> {
    let payload = &mut payload;
    let [width, height] = take::<[u32; 2]>(payload)?.map(|pixels| pixels as usize);
    let [fx, fy, cx, cy] = take(payload)?;
    let camera = Intrinsics { fx, fy, cx, cy, width, height };
    if camera.is_valid() { Ok(camera) } else { Err(damaged("invalid camera")) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::sim3::Sim3;

    fn manifest() -> Manifest {
        let camera = Intrinsics::pinhole(64, 48, 60.0);
        let listed = |keyframe_id: u64| Listed {
            keyframe: Keyframe {
                keyframe_id,
                revision: 3,
                ..Keyframe::at(Sim3::identity(), camera, Vec::new(), Vec::new())
            },
            file: (keyframe_id != 4).then_some(DepthFile {
                revision: 3,
                bytes: 100 + keyframe_id,
                checksum: 7,
                num_points: 5,
            }),
        };
        Manifest {
            free_epoch: 3,
            revision: 8,
            saves: 2,
            saved_secs: 1_700_000_000,
            keyframes: vec![listed(2), listed(4), listed(9)],
            ..Manifest::new(camera, MapDetail::Small)
        }
    }

    /// A body with its valid checksum.
    fn sealed(mut body: Vec<u8>) -> Vec<u8> {
        body.extend(crc32fast::hash(&body).to_le_bytes());
        body
    }

    fn body() -> Vec<u8> {
        let mut bytes = manifest().to_bytes();
        bytes.truncate(bytes.len() - 4);
        bytes
    }

    #[test]
    fn a_manifest_survives_its_bytes() {
        assert_eq!(Manifest::from_bytes(&manifest().to_bytes()), Ok(manifest()));
        assert_eq!(manifest().depth_bytes(), 211);
        assert_eq!(manifest().file_names().collect::<Vec<_>>(), ["2.3", "9.3"]);
    }

    #[test]
    fn loops_are_read_back_and_invalid_ones_are_refused() {
        let loops = Arc::new(crate::service::loop_bytes::tests::loops());
        let with = Manifest { loops, ..manifest() };
        assert_eq!(Manifest::from_bytes(&with.to_bytes()), Ok(with.clone()));
        let refusal = |sections: &[([u8; 4], &[u8])]| {
            let mut bytes = body();
            sections.iter().for_each(|(tag, payload)| push_section(&mut bytes, *tag, payload));
            Manifest::from_bytes(&sealed(bytes)).unwrap_err().to_string()
        };
        let error = refusal(&[(LOOPS, b"something")]);
        assert!(error.contains("loops"), "{error}");
        let error = refusal(&[(LOOPS, &loop_bytes(&with.loops)), (COVARIANCES, b"something")]);
        assert!(error.contains("loops"), "{error}");
    }

    #[test]
    fn before_covariances_were_stored_places_were_relative() {
        let loops = crate::service::loop_bytes::tests::loops();
        let mut bytes = body();
        push_section(&mut bytes, LOOPS, &loop_bytes(&loops));
        let found = Manifest::from_bytes(&sealed(bytes)).unwrap().loops;
        // Of 7, 8 and 9, which were held, the map has 9.
        assert!(found.relative_covariances.keys().eq(&[9]), "{found:?}");
        assert_eq!(found.held_by, loops.held_by);
    }

    #[test]
    fn every_cut_and_every_wrong_bit_is_an_error() {
        let whole = manifest().to_bytes();
        for length in 0..whole.len() {
            assert!(Manifest::from_bytes(&whole[..length]).is_err(), "{length}");
        }
        for byte in 0..whole.len() {
            let mut broken = whole.clone();
            broken[byte] ^= 1 << (byte % 8);
            assert!(Manifest::from_bytes(&broken).is_err(), "byte {byte}");
        }
    }

    #[test]
    fn invalid_numbers_with_a_valid_checksum_are_refused() {
        let last = body().len();
        for (at, value) in [
            (20 + 4, u64::MAX),    // length of the first section
            (last - 24, u64::MAX), // revision of the last file
            (last - 16, u64::MAX), // bytes of the last file
            (last - 8, u64::MAX),  // checksum and points of the last file
        ] {
            let mut bytes = body();
            bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            assert!(Manifest::from_bytes(&sealed(bytes)).is_err(), "at {at}");
        }
        let mut twice = manifest();
        twice.keyframes[1] = twice.keyframes[0].clone();
        assert!(Manifest::from_bytes(&twice.to_bytes()).is_err());
        let mut foreign = manifest();
        foreign.keyframes[1].keyframe.intrinsics.fx = 61.0;
        assert!(Manifest::from_bytes(&foreign.to_bytes()).is_err());
    }

    #[test]
    fn an_unknown_section_is_skipped_or_requires_a_newer_program() {
        let with = |tag: &[u8; 4]| {
            let mut bytes = body();
            push_section(&mut bytes, *tag, b"something");
            Manifest::from_bytes(&sealed(bytes))
        };
        assert_eq!(with(b"some"), Ok(manifest()));
        assert_eq!(with(b"SOME"), Err(ManifestError::Section("SOME".to_owned())));
        let mut newer = manifest().to_bytes();
        newer[16] = 2;
        assert_eq!(Manifest::from_bytes(&newer), Err(ManifestError::Version(2)));
    }
}
