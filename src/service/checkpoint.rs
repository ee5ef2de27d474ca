//! The mapper's checkpoint in the runtime folder: the state it needs to continue after its death. Written by a separate
//! thread, so that no frame waits for a file.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::SystemTime;

use crossbeam::queue::ArrayQueue;

use crate::service::atomic_file::write_privately;
use crate::service::clock::now_nanos;
use crate::service::map_file::{MapFileError, read_map, write_map_into};
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::slam::mapper::{Mapper, StepOutcome};

/// Keyframes kept with image and depth for a successor, besides the active one: as many as a window holds.
const KEPT_KEYFRAMES: usize = 20;
/// Keyframes that wait to be written; a slower disk loses the oldest of them.
const WAITING_KEYFRAMES: usize = 4;
/// Time between two checkpoints of a keyframe whose depth improves; a new keyframe gets one at once.
const PERIOD_NANOS: i64 = 1_000_000_000;

/// The checkpoint of a mapper, and the reservation it writes before it assigns its first number.
#[derive(Debug)]
pub struct Kept {
    checkpoint: Checkpoint,
    reservation: Option<Map>,
    /// CLOCK_MONOTONIC of the last hand-over.
    handed_nanos: i64,
}

impl Kept {
    /// Reads what a dead mapper left at `path` and opens the checkpoint of this one. The mapper works without either.
    pub fn open(path: &Path) -> (Option<Self>, Option<Map>) {
        let left = read_checkpoint(path).unwrap_or_else(|error| {
            tracing::warn!("starting a new map: {error}");
            None
        });
        let mut reservation = left.as_ref().map_or_else(Map::default, as_written);
        reservation.reserve_numbers();
        match Checkpoint::keep(path) {
            Ok(checkpoint) => {
                let reservation = Some(reservation);
                (Some(Self { checkpoint, reservation, handed_nanos: 0 }), left)
            }
            Err(error) => {
                tracing::warn!("no checkpoints will be written ({error})");
                (None, left)
            }
        }
    }

    /// Numbers are assigned from now on: a successor will assign others.
    pub fn reserve(&mut self) {
        if let Some(map) = self.reservation.take() {
            self.checkpoint.put_now(&map);
        }
    }

    /// Hands over what a step or a correction changed: the keyframe that was left, and the state where another keyframe
    /// is active, the map was corrected, or the last hand-over is some time ago.
    pub fn follow(&mut self, mapper: &mut Mapper, outcome: &StepOutcome) {
        let is_corrected = outcome.graph_changed && !outcome.needs_image();
        let is_new = outcome.needs_image() || is_corrected;
        let mut is_left = false;
        while let Some(keyframe) = mapper.take_keyframe_to_save() {
            self.checkpoint.put_keyframe(keyframe.clone());
            is_left = true;
        }
        // A correction changes the depth of the keyframe before the active one most; the others stay in their files as
        // they were when they were left or refined, and a successor estimates them again.
        let before = is_corrected.then(|| before_active(mapper)).flatten();
        if let Some(keyframe) = before.filter(|_| !is_left).and_then(|id| mapper.map().get(id)) {
            self.checkpoint.put_keyframe(keyframe.clone());
        }
        let is_due = outcome.keyframe_changed
            && now_nanos().saturating_sub(self.handed_nanos) > PERIOD_NANOS;
        if (is_new || is_due)
            && let Some(map) = mapper.checkpoint()
        {
            self.checkpoint.put(map);
            self.handed_nanos = now_nanos();
        }
    }

    /// No process needs to continue from here: the files are removed on drop.
    pub fn remove_on_drop(&mut self) {
        self.checkpoint.is_over = true;
    }
}

/// The newest keyframe with depth other than the active one.
fn before_active(mapper: &Mapper) -> Option<u64> {
    let active = mapper.keyframe()?.keyframe_id;
    let mut others = mapper.map().keyframes.iter().rev().filter(|of| of.keyframe_id != active);
    others.find(|keyframe| keyframe.has_depth()).map(|keyframe| keyframe.keyframe_id)
}

/// Writes the newest checkpoint, and each keyframe before it once. The files stay unless the process ends in order.
#[derive(Debug)]
struct Checkpoint {
    path: PathBuf,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    is_over: bool,
}

#[derive(Debug)]
struct Shared {
    newest: ArrayQueue<Map>,
    left: ArrayQueue<Keyframe>,
    stop: AtomicBool,
}

impl Checkpoint {
    /// Keeps the checkpoint in the file `path`; a previous mapper's checkpoint stays until the first write.
    fn keep(path: &Path) -> io::Result<Self> {
        remove_unfinished(path);
        let shared = Arc::new(Shared {
            newest: ArrayQueue::new(1),
            left: ArrayQueue::new(WAITING_KEYFRAMES),
            stop: AtomicBool::new(false),
        });
        let (theirs, file) = (Arc::clone(&shared), path.to_owned());
        let thread = std::thread::Builder::new()
            .name("semidense-checkpoint".to_owned())
            .spawn(move || write_until_stopped(&file, &theirs))?;
        Ok(Self { path: path.to_owned(), shared, thread: Some(thread), is_over: false })
    }

    /// Writes a state before it returns; a disk error is logged, as the next state may fit. Call before the first
    /// [`Checkpoint::put`].
    fn put_now(&self, map: &Map) {
        write_or_warn(&self.path, map);
    }

    /// Hands over the newest state and drops an older one that was not written yet.
    fn put(&self, map: Map) {
        drop(self.shared.newest.force_push(map));
        self.wake();
    }

    /// Hands over a keyframe that is no longer active.
    fn put_keyframe(&self, keyframe: Keyframe) {
        drop(self.shared.left.force_push(keyframe));
        self.wake();
    }

    fn wake(&self) {
        self.thread.iter().for_each(|thread| thread.thread().unpark());
    }
}

impl Drop for Checkpoint {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        self.wake();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            drop(thread.join());
        }
        if self.is_over {
            drop(fs::remove_file(&self.path));
            keyframe_files(&self.path)
                .into_iter()
                .for_each(|(_, file)| drop(fs::remove_file(file)));
        }
    }
}

/// The file holds images: readable only by the user of the process.
fn write_or_warn(path: &Path, map: &Map) {
    if let Err(error) = write_privately(path, |file| write_map_into(file, map, &mut || ())) {
        tracing::warn!(
            "{}: cannot write the checkpoint ({error}); a restarted mapper would start a new map",
            path.display()
        );
    }
}

fn write_until_stopped(path: &Path, shared: &Shared) {
    while !shared.stop.load(Ordering::Acquire) {
        // Keyframes first: the state that follows lists them.
        if let Some(keyframe) = shared.left.pop() {
            write_keyframe(path, keyframe);
        } else if let Some(map) = shared.newest.pop() {
            write_or_warn(path, &map);
        } else {
            std::thread::park();
        }
    }
}

/// A checkpoint as it was in its file: the keyframes before the active one have separate files.
fn as_written(read: &Map) -> Map {
    let is_active = |keyframe: &Keyframe| Some(keyframe.keyframe_id) == read.active;
    let written = |keyframe: &Keyframe| match is_active(keyframe) {
        true => keyframe.clone(),
        false => keyframe.without_depth(),
    };
    Map {
        keyframes: read.keyframes.iter().map(written).collect(),
        frames: Vec::new(),
        confirmed: Vec::new(),
        loops: read.loops.clone(),
        ..*read
    }
}

/// Writes a keyframe into a separate file and removes those beyond [`KEPT_KEYFRAMES`] that were written longest ago: the
/// camera may be back among the first.
fn write_keyframe(path: &Path, keyframe: Keyframe) {
    let file = keyframe_file(path, keyframe.keyframe_id);
    write_or_warn(&file, &Map { keyframes: vec![keyframe], ..Map::default() });
    // The clock may have been set back: then this one has the earliest stamp.
    let others = keyframe_files(path).into_iter().filter(|(_, other)| *other != file);
    let others: Vec<_> = others.collect();
    let surplus = (others.len() + 1).saturating_sub(KEPT_KEYFRAMES);
    others.into_iter().take(surplus).for_each(|(_, file)| drop(fs::remove_file(file)));
}

/// File of a keyframe before the active one.
fn keyframe_file(path: &Path, keyframe_id: u64) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{keyframe_id}"));
    PathBuf::from(name)
}

/// Existing keyframe files, those written longest ago first.
fn keyframe_files(path: &Path) -> Vec<(u64, PathBuf)> {
    let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return Vec::new() };
    let beginning = format!("{}.", name.to_string_lossy());
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<(SystemTime, u64, PathBuf)> = entries
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let keyframe_id = name.strip_prefix(&beginning)?.parse().ok()?;
            let written = entry.metadata().and_then(|file| file.modified()).ok()?;
            Some((written, keyframe_id, entry.path()))
        })
        .collect();
    files.sort_unstable();
    files.into_iter().map(|(_, keyframe_id, path)| (keyframe_id, path)).collect()
}

/// Removes files of mappers that were killed while writing.
fn remove_unfinished(path: &Path) {
    let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return };
    let beginning = format!(".{}.", name.to_string_lossy());
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with(&beginning) && name.ends_with(".tmp") {
            // What cannot be removed is left to the next mapper.
            drop(fs::remove_file(entry.path()));
        }
    }
}

/// Reads the checkpoint that a killed mapper left at `path`, with image and depth of the keyframes before the active
/// one as far as they are readable; `None` where no checkpoint exists.
pub fn read_checkpoint(path: &Path) -> Result<Option<Map>, MapFileError> {
    if !path.exists() {
        return Ok(None);
    }
    let mut map = read_map(path)?;
    for (keyframe_id, file) in keyframe_files(path) {
        // A keyframe whose file was never written or is torn stays without depth.
        let (Some(index), Ok(kept)) = (map.index_of(keyframe_id), read_map(&file)) else {
            continue;
        };
        let keyframe = &mut map.keyframes[index];
        if keyframe.has_depth() {
            continue;
        }
        if let Some(kept) = kept.keyframes.into_iter().next().filter(|kept| kept.is_same(keyframe))
        {
            (keyframe.image, keyframe.points) = (kept.image, kept.points);
            // The flag belongs to the points taken: the state may be older or newer than they are.
            keyframe.is_refined = kept.is_refined;
        }
    }
    Ok(Some(map))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;
    use crate::slam::keyframe::DepthPoint;
    use std::os::unix::fs::PermissionsExt;
    use std::time::{Duration, Instant};

    fn until(mut holds: impl FnMut() -> bool) {
        let start = Instant::now();
        while !holds() {
            assert!(start.elapsed() < Duration::from_secs(60), "waited in vain");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_checkpoint_exists_until_its_keeper_ends_in_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        assert!(read_checkpoint(&path).unwrap().is_none());
        let unfinished = folder.path().join(".rig.checkpoint.17.tmp");
        fs::write(&unfinished, "half").unwrap();
        let mut kept = Checkpoint::keep(&path).unwrap();
        assert!(!unfinished.exists() && !path.exists());
        kept.put_now(&Map { free_epoch: 3, ..Map::default() });
        assert_eq!(read_checkpoint(&path).unwrap().unwrap().free_epoch, 3);
        kept.put(Map { free_epoch: 7, ..Map::default() });
        until(|| read_checkpoint(&path).unwrap().unwrap().free_epoch == 7);
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        drop(kept);
        assert!(path.exists(), "a panic or an error is no end in order");
        kept = Checkpoint::keep(&path).unwrap();
        kept.is_over = true;
        drop(kept);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    fn keyframe(keyframe_id: u64) -> Keyframe {
        let place = Sim3::new(SE3::identity(), 1.0 + keyframe_id as f64);
        let point = DepthPoint { u: 9, v: 9, inverse_depth: 1.0, variance: 0.1, intensity: 9.0 };
        Keyframe {
            keyframe_id,
            revision: 1,
            sequence: keyframe_id,
            capture_nanos: 1,
            ..Keyframe::at(
                place,
                Intrinsics::pinhole(17, 16, 20.0),
                vec![point; 3],
                vec![keyframe_id as u8; 17 * 16],
            )
        }
    }

    #[test]
    fn a_successor_has_image_and_depth_of_the_last_keyframes() {
        const LAST: u64 = 25;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        let kept = Checkpoint::keep(&path).unwrap();
        let written = |id: u64| keyframe_file(&path, id);
        for id in 0..LAST {
            kept.put_keyframe(keyframe(id));
            until(|| written(id).exists());
        }
        until(|| keyframe_files(&path).len() == KEPT_KEYFRAMES);
        let poses = (0..LAST).map(|id| keyframe(id).without_depth());
        let moved = Sim3::new(SE3::identity(), 9.0);
        let mut keyframes: Vec<_> = poses.chain([keyframe(LAST)]).collect();
        keyframes[10].map_from_keyframe = moved;
        kept.put_now(&Map { keyframes, active: Some(LAST), ..Map::default() });
        // One is torn, one is of another run.
        fs::write(written(7), "semidense").unwrap();
        fs::copy(written(9), written(8)).unwrap();
        let read = read_checkpoint(&path).unwrap().unwrap();
        let with_depth: Vec<u64> =
            read.keyframes.iter().filter(|k| k.has_depth()).map(|k| k.keyframe_id).collect();
        let expected: Vec<u64> = (5..=LAST).filter(|id| ![7, 8].contains(id)).collect();
        assert_eq!(with_depth, expected);
        let written = as_written(&read);
        assert_eq!(written.keyframes.iter().filter(|k| k.has_depth()).count(), 1);
        assert_eq!((read.active, read.keyframes[20].image[0]), (Some(LAST), 20));
        assert_eq!(
            read.keyframes[10].map_from_keyframe, moved,
            "places are those of the last state"
        );
        let mut kept = kept;
        kept.is_over = true;
        drop(kept);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn keyframes_of_an_epoch_that_was_joined_keep_their_depth() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        let kept = Checkpoint::keep(&path).unwrap();
        kept.put_keyframe(Keyframe { epoch: 1, ..keyframe(3) });
        until(|| keyframe_file(&path, 3).exists());
        let keyframes = vec![keyframe(3).without_depth(), keyframe(4)];
        kept.put_now(&Map { keyframes, active: Some(4), ..Map::default() });
        let read = read_checkpoint(&path).unwrap().unwrap();
        assert!(read.keyframes.iter().all(Keyframe::has_depth));
        assert_eq!(read.keyframes[0].epoch, 0, "the epoch is that of the last state");
    }

    #[test]
    fn the_keyframes_left_last_are_kept_whatever_their_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        let written = |id: u64| write_keyframe(&path, keyframe(id));
        (100..100 + KEPT_KEYFRAMES as u64).for_each(written);
        let long_ago = SystemTime::now() - Duration::from_secs(60);
        for (_, file) in keyframe_files(&path) {
            fs::File::options().write(true).open(file).unwrap().set_modified(long_ago).unwrap();
        }
        // The camera is back where it began.
        [5, 6].into_iter().for_each(written);
        let ids: Vec<u64> = keyframe_files(&path).into_iter().map(|(id, _)| id).collect();
        let kept = 100 + KEPT_KEYFRAMES as u64;
        assert_eq!(ids, (102..kept).chain([5, 6]).collect::<Vec<u64>>());
        // The clock is set back by an hour.
        for (_, file) in keyframe_files(&path) {
            let ahead = SystemTime::now() + Duration::from_secs(3600);
            fs::File::options().write(true).open(file).unwrap().set_modified(ahead).unwrap();
        }
        written(7);
        let files = keyframe_files(&path);
        assert_eq!((files.len(), files[0].0), (KEPT_KEYFRAMES, 7));
    }

    #[test]
    fn a_corrupt_checkpoint_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.checkpoint");
        fs::write(&path, "semidense").unwrap();
        assert!(read_checkpoint(&path).is_err());
    }
}
