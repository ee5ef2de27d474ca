//! The position of capture in its source, in a small file of the runtime folder: the successor of a killed capture
//! continues after its last frame, whatever else died with it.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use zerocopy::IntoBytes;

use crate::capture::source::FrameStamp;
use crate::service::mode::Mode;

/// Environment variable in which a supervisor names its run, so that the file of an earlier run is not used.
pub const RUN_VARIABLE: &str = "SEMIDENSE_RUN";

/// Numbers of a slot: key, count of writes, process, sequence, stamp, frames, gaps, and their checksum.
const SLOT_NUMBERS: usize = 8;
const SLOT_BYTES: usize = 8 * SLOT_NUMBERS;
/// Written alternately: a write that is cut short leaves the previous one.
const SLOTS: u64 = 2;

/// The last frame of a capture and its counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Position {
    /// The capture process.
    pub process_id: u32,
    /// Sequence of the frame.
    pub sequence: u64,
    /// Its stamp, nanoseconds of the source's clock.
    pub capture_nanos: i64,
    /// Frames that this process has sent, including this one.
    pub frames: u64,
    /// Gaps in the source's sequence so far.
    pub gaps: u64,
}

/// Frames in a row that may be no newer than the last one of the previous capture: a second at 30 Hz.
const MAX_FRAMES_BEHIND: u32 = 30;

/// Key of a file's frames: their run and its source. FNV-1a, 64 bits.
pub fn position_key(run: &str, source: &str, rig: Option<&Path>) -> u64 {
    let rig = rig.map_or(&b""[..], |rig| rig.as_os_str().as_encoded_bytes());
    // A byte that none of them contains keeps "ab" + "c" from "a" + "bc".
    let parts = [run.as_bytes(), &[0], source.as_bytes(), &[0], rig];
    hash(parts.into_iter().flatten())
}

fn hash<'a>(bytes: impl IntoIterator<Item = &'a u8>) -> u64 {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0100_0000_01b3;
    bytes.into_iter().fold(OFFSET, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(PRIME))
}

impl Position {
    /// The position of this process at a frame.
    pub fn at(stamp: &FrameStamp, frames: u64, gaps: u64) -> Self {
        let (process_id, sequence) = (std::process::id(), stamp.sequence);
        Self { process_id, sequence, capture_nanos: stamp.capture_nanos, frames, gaps }
    }
}

/// Keeps the position of this process where it can: capture works without a file too.
#[derive(Debug, Default)]
pub struct PositionRecorder {
    file: Option<PositionFile>,
}

impl PositionRecorder {
    /// Keeps the position in `source` in the file at `path`, and returns where a capture of the same run died. Nothing
    /// is kept in lockstep: such a run ends with any of its processes.
    pub fn of_run(
        path: &Path,
        mode: Mode,
        source: &str,
        rig: Option<&Path>,
    ) -> (Self, Option<Position>) {
        if mode == Mode::Lockstep {
            return (Self::default(), None);
        }
        // Empty where no supervisor has named it.
        let run = std::env::var(RUN_VARIABLE).unwrap_or_default();
        match PositionFile::open(path, position_key(&run, source, rig)) {
            Ok((file, left)) => (Self { file: Some(file) }, left),
            Err(error) => {
                let path = path.display();
                tracing::warn!("{path}: cannot save the position in the source ({error})");
                (Self::default(), None)
            }
        }
    }

    /// Writes the position of a frame that is about to be sent. A failure is logged once.
    pub fn write_or_warn(&mut self, position: &Position) {
        if let Some(Err(error)) = self.file.as_mut().map(|file| file.note(position)) {
            tracing::warn!("the position in the source is no longer saved ({error})");
            self.file = None;
        }
    }

    /// No capture continues from here: the file is removed on drop.
    pub fn remove_on_drop(&mut self) {
        self.file.iter_mut().for_each(PositionFile::remove_on_drop);
    }
}

/// Stamp of a frame of a camera without a clock.
const NO_STAMP: i64 = 0;

/// Progress of the previous capture, until the first frame after it.
#[derive(Debug, Default)]
pub struct Predecessor {
    /// Stamp of its last frame.
    pub last_nanos: Option<i64>,
    frames_behind: u32,
}

impl Predecessor {
    /// Whether a frame is no newer than its last one. A source that gives only such frames has another clock by now, or
    /// none.
    pub fn is_ahead_of(&mut self, stamp: &FrameStamp) -> bool {
        if stamp.capture_nanos == NO_STAMP {
            self.last_nanos = None;
        }
        let is_ahead = self.last_nanos.is_some_and(|last| stamp.capture_nanos <= last);
        self.frames_behind += u32::from(is_ahead);
        if !is_ahead || self.frames_behind > MAX_FRAMES_BEHIND {
            self.last_nanos = None;
        }
        self.last_nanos.is_some()
    }
}

/// The position file. It stays unless the process ends in order.
#[derive(Debug)]
struct PositionFile {
    path: PathBuf,
    file: File,
    key: u64,
    writes: u64,
    is_over: bool,
}

impl PositionFile {
    fn open(path: &Path, key: u64) -> io::Result<(Self, Option<Position>)> {
        const USER_ALONE: u32 = 0o600;
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false).mode(USER_ALONE);
        let file = options.open(path)?;
        let left = newest_slot(&file, key);
        if left.is_none() {
            // Reserves room for both slots, so that writing a position cannot run out of it.
            file.write_all_at(&[0; SLOT_BYTES * SLOTS as usize], 0)?;
        }
        let writes = left.map_or(0, |(writes, _)| writes);
        let file = Self { path: path.to_owned(), file, key, writes, is_over: false };
        Ok((file, left.map(|(_, position)| position)))
    }

    /// One write, without waiting for a disk.
    fn note(&mut self, position: &Position) -> io::Result<()> {
        self.writes += 1;
        let slot = slot_bytes(self.key, self.writes, position);
        self.file.write_all_at(&slot, (self.writes % SLOTS) * SLOT_BYTES as u64)
    }

    fn remove_on_drop(&mut self) {
        self.is_over = true;
    }
}

impl Drop for PositionFile {
    fn drop(&mut self) {
        if self.is_over {
            drop(fs::remove_file(&self.path));
        }
    }
}

/// Reads the position in the file at `path`; `None` where it has none with this key.
pub fn read_position(path: &Path, key: u64) -> Option<Position> {
    newest_slot(&File::open(path).ok()?, key).map(|(_, position)| position)
}

fn slot_bytes(key: u64, writes: u64, position: &Position) -> [u8; SLOT_BYTES] {
    let Position { process_id, sequence, capture_nanos, frames, gaps } = *position;
    let stamp = capture_nanos.cast_unsigned();
    let mut slot = [key, writes, u64::from(process_id), sequence, stamp, frames, gaps, 0];
    slot[SLOT_NUMBERS - 1] = hash(slot[..SLOT_NUMBERS - 1].as_bytes());
    zerocopy::transmute!(slot)
}

/// The slot written last among those that are intact and have this key.
fn newest_slot(file: &File, key: u64) -> Option<(u64, Position)> {
    let read = |slot: u64| {
        let mut numbers = [0; SLOT_NUMBERS];
        file.read_exact_at(numbers.as_mut_bytes(), slot * SLOT_BYTES as u64).ok()?;
        position_from_slot(numbers, key)
    };
    (0..SLOTS).filter_map(read).max_by_key(|(writes, _)| *writes)
}

fn position_from_slot(numbers: [u64; SLOT_NUMBERS], key: u64) -> Option<(u64, Position)> {
    let [of, writes, process_id, sequence, stamp, frames, gaps, sum] = numbers;
    if of != key || sum != hash(numbers[..SLOT_NUMBERS - 1].as_bytes()) {
        return None;
    }
    let process_id = u32::try_from(process_id).ok()?;
    let capture_nanos = stamp.cast_signed();
    Some((writes, Position { process_id, sequence, capture_nanos, frames, gaps }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn position(sequence: u64) -> Position {
        let capture_nanos = -7 + sequence as i64;
        Position { process_id: 17, sequence, capture_nanos, frames: sequence + 1, gaps: 2 }
    }

    #[test]
    fn the_last_position_is_found_only_by_its_own_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.position");
        let key = position_key("run 1", "sim", None);
        let (mut keeper, left) = PositionFile::open(&path, key).unwrap();
        assert_eq!((left, read_position(&path, key)), (None, None));
        for sequence in 0..5 {
            keeper.note(&position(sequence)).unwrap();
            assert_eq!(read_position(&path, key), Some(position(sequence)));
        }
        // A kill runs no destructor; a drop without `remove_on_drop` is equivalent.
        drop(keeper);
        let (mut next, left) = PositionFile::open(&path, key).unwrap();
        assert_eq!(left, Some(position(4)));
        next.note(&position(5)).unwrap();
        assert_eq!(read_position(&path, key), Some(position(5)));
        next.remove_on_drop();
        drop(next);
        assert!(!path.exists());
        let (mut keeper, _) = PositionFile::open(&path, key).unwrap();
        keeper.note(&position(8)).unwrap();
        for other in [
            position_key("run 2", "sim", None),
            position_key("run 1", "sim:plane", None),
            position_key("run 1", "sim", Some(Path::new("x"))),
        ] {
            assert_eq!(read_position(&path, other), None);
        }
        let other = position_key("run 2", "sim", None);
        assert_eq!(PositionFile::open(&path, other).unwrap().1, None);
    }

    #[test]
    fn frames_before_the_last_one_are_left_out_if_the_source_has_a_clock() {
        let at = |capture_nanos| FrameStamp {
            sequence: 0,
            capture_nanos,
            exposure_nanos: 0,
            gain: 0.0,
            clocks: None,
        };
        let behind = |last, stamps: &[i64]| {
            let mut predecessor = Predecessor { last_nanos: Some(last), ..Predecessor::default() };
            stamps.iter().filter(|&&nanos| predecessor.is_ahead_of(&at(nanos))).count()
        };
        assert_eq!(behind(70, &[50, 60, 70, 80, 75]), 3);
        let other_clock: Vec<i64> = (1..100).collect();
        assert_eq!(behind(1000, &other_clock), MAX_FRAMES_BEHIND as usize);
        assert_eq!(behind(0, &[0; 100]), 0, "no clock");
        assert_eq!(behind(1000, &[0; 100]), 0, "no clock any more");
    }

    #[test]
    fn a_torn_write_leaves_the_previous_position() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.position");
        let (mut keeper, _) = PositionFile::open(&path, 3).unwrap();
        keeper.note(&position(10)).unwrap();
        keeper.note(&position(11)).unwrap();
        let whole = fs::read(&path).unwrap();
        let newest = slot_bytes(3, 2, &position(11));
        let at = whole.windows(SLOT_BYTES).position(|slot| slot == newest).unwrap();
        for byte in at..at + SLOT_BYTES {
            let mut torn = whole.clone();
            torn[byte] ^= 0x40;
            fs::write(&path, &torn).unwrap();
            assert_eq!(read_position(&path, 3), Some(position(10)), "byte {byte}");
        }
        for length in 0..SLOT_BYTES {
            fs::write(&path, &whole[..length]).unwrap();
            assert_eq!(read_position(&path, 3), None, "{length} bytes");
        }
    }
}
