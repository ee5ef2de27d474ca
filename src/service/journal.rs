//! The journal of a run: writes everything needed to reconstruct its results to disk while it runs.
//!
//! A folder inside the output folder: `log` holds poses, times and keyframe poses as they arrive, and each keyframe has
//! a file with its newest depth. A separate thread writes everything, which is on disk after about a second. The folder
//! is removed once the results are written; one that no process holds belongs to a run that was killed, and
//! [`recovered`] makes its record.

pub(crate) mod any_bytes;
pub(crate) mod feed;
pub mod folder;
pub mod log;
pub mod recovered;
pub(crate) mod replayed;
mod writer;

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossbeam::channel::{SendTimeoutError, Sender, TrySendError, bounded};

use crate::service::clock::wait_at_most;
use crate::service::journal::folder::{Pointer, begin_folder, lock, remove_folder};
use crate::service::journal::log::{Record, RunStart, log_header, read_log};
use crate::service::journal::recovered::read_map_of;
use crate::service::journal::writer::{Entry, Writer};
use crate::service::results::record::RunCounters;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;
use crate::wire::message::PoseMessage;
use crate::wire::place::Place;

/// Time between two hand-overs to the thread: a kill may cost that much of a run.
const PERIOD: Duration = Duration::from_secs(1);
/// Hand over earlier once this many bytes are pending: 300 poses, so that lockstep holds no more than a run at 30 Hz.
const HAND_OVER_BYTES: usize = 256 << 10;
/// Entries that may wait for the disk: at 30 Hz two seconds of poses, with a keyframe each second.
const QUEUE: usize = 4;
/// Longest wait for the disk at the end.
const END_TIMEOUT: Duration = Duration::from_secs(60);
/// Longest wait for a disk that has already timed out.
const SECOND_TIMEOUT: Duration = Duration::from_secs(5);
/// Most bytes of log that wait for a hanging disk: an hour of poses.
const MAX_PENDING_BYTES: usize = 64 << 20;

/// Where a journal is kept, and how much.
#[derive(Debug, Clone)]
pub struct JournalOptions {
    /// The output folder, which exists.
    pub output: PathBuf,
    /// How the run was started.
    pub start: RunStart,
    /// Most bytes of depth; beyond that the oldest keyframes keep only their poses, as in the mapper.
    pub max_depth_bytes: u64,
}

/// The journal of a run in progress. Stays on disk when dropped without [`Journal::finish`].
#[derive(Debug)]
pub struct Journal {
    folder: PathBuf,
    pointer: Option<Pointer>,
    /// Bytes that the thread does not have yet.
    pending: Vec<u8>,
    counted: Instant,
    handed_over: Instant,
    entries: Option<Sender<Entry>>,
    thread: Option<JoinHandle<()>>,
    /// Longest wait for the disk at the end.
    timeout: Duration,
    /// Whether records are left out because the disk hangs.
    leaves_out: bool,
    /// Poses appended before any record was left out, and how many of them are on disk.
    poses: u64,
    has_hole: bool,
    on_disk: Arc<AtomicU64>,
    /// The log, held: shows that the run is in progress.
    log: File,
}

impl Journal {
    /// Begins the journal of a run of the instance at `place`.
    pub fn begin(options: &JournalOptions, place: &Place) -> io::Result<Self> {
        let folder = begin_folder(&options.output)?;
        let mut first = log_header();
        Record::Start(Box::new(options.start.clone())).write(&mut first);
        let writer = Writer::create(&folder, &first, options.max_depth_bytes)?;
        let (held, on_disk) = (writer.lock()?, writer.poses_on_disk());
        let (entries, received) = bounded(QUEUE);
        let thread = std::thread::Builder::new()
            .name("semidense-journal".to_owned())
            .spawn(move || writer.write_all(&received))?;
        let pointer = Pointer::set(place, &folder).inspect_err(|error| {
            tracing::debug!("cannot write the pointer to the journal ({error})")
        });
        let mut journal = Self::of(folder, held, Some((entries, thread)));
        (journal.pointer, journal.on_disk) = (pointer.ok(), on_disk);
        Ok(journal)
    }

    /// Holds the journal that a killed run left in `folder`, so that no other process makes results from it; `None`
    /// where another process holds it.
    pub fn take_over(folder: &Path) -> io::Result<Option<Self>> {
        let held = lock(&folder.join(folder::LOG))?;
        // The next search for its pointer removes the pointer.
        Ok(held.map(|held| Self::of(folder.to_owned(), held, None)))
    }

    fn of(folder: PathBuf, held: File, writing: Option<(Sender<Entry>, JoinHandle<()>)>) -> Self {
        let (entries, thread) = writing.unzip();
        Self {
            folder,
            pointer: None,
            pending: Vec::new(),
            counted: Instant::now(),
            handed_over: Instant::now(),
            entries,
            thread,
            timeout: END_TIMEOUT,
            leaves_out: false,
            poses: 0,
            has_hole: false,
            on_disk: Arc::default(),
            log: held,
        }
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Appends a record. Never waits for the disk.
    pub fn append(&mut self, record: &Record) {
        let has_room = self.pending.len() < MAX_PENDING_BYTES;
        if has_room {
            record.write(&mut self.pending);
            let is_counted = matches!(record, Record::Pose(_)) && !self.has_hole;
            self.poses += u64::from(is_counted);
        } else if !self.leaves_out {
            let folder = self.folder.display();
            tracing::warn!(
                "{folder}: the disk does not respond; further records will be missing from the journal"
            );
        }
        self.leaves_out = !has_room;
        self.has_hole |= !has_room;
        self.tick();
    }

    /// How many of the appended poses, from the first on, are on disk; [`Journal::read_poses`] reads them back.
    pub fn poses_on_disk(&self) -> usize {
        usize::try_from(self.on_disk.load(Ordering::Acquire)).unwrap_or(usize::MAX)
    }

    /// Reads the first `count` poses from disk; fewer where the disk fails.
    pub fn read_poses(&self, count: usize, take: &mut dyn FnMut(&PoseMessage)) {
        let log = BufReader::new(ReadFromStart { file: &self.log, at: 0 });
        let mut num_read = 0;
        read_log(log, &mut |record| {
            if let Record::Pose(pose) = record
                && num_read < count
            {
                take(&pose);
                num_read += 1;
            }
        });
    }

    /// Whether [`Journal::count`] is due.
    pub fn wants_counters(&self) -> bool {
        self.counted.elapsed() >= PERIOD
    }

    /// Appends the counts so far.
    pub fn count(&mut self, counters: RunCounters) {
        self.counted = Instant::now();
        self.append(&Record::Counters(Box::new(counters)));
    }

    /// Appends the newest state of a keyframe; returns it where the disk is behind. Never waits.
    pub fn put_keyframe(&mut self, keyframe: Keyframe) -> Option<Keyframe> {
        let without_depth = keyframe.without_depth();
        let entries = self.entries.as_ref()?;
        match entries.try_send(Entry::Keyframe(Box::new(keyframe))) {
            Ok(()) => self.append(&Record::Keyframe(Box::new(without_depth))),
            Err(TrySendError::Full(Entry::Keyframe(keyframe))) => return Some(*keyframe),
            Err(_) => {}
        }
        None
    }

    /// Hands over what is due.
    fn tick(&mut self) {
        let is_due = self.handed_over.elapsed() >= PERIOD || self.pending.len() >= HAND_OVER_BYTES;
        if !is_due || self.pending.is_empty() {
            return;
        }
        let Some(entries) = &self.entries else { return };
        match entries.try_send(Entry::Log(std::mem::take(&mut self.pending), self.poses)) {
            Err(TrySendError::Full(Entry::Log(pending, _))) => self.pending = pending,
            _ => self.handed_over = Instant::now(),
        }
    }

    /// Waits, for a bounded time, until everything is on disk; returns whether it is.
    pub fn flush(&mut self) -> bool {
        let Some(entries) = &self.entries else { return true };
        let end = Instant::now() + self.timeout;
        let (done, is_done) = bounded(1);
        let pending = std::mem::take(&mut self.pending);
        let is_whole = match entries.send_deadline(Entry::Log(pending, self.poses), end) {
            Ok(()) => {
                let marked = entries.send_deadline(Entry::Mark(done), end);
                marked.is_ok() && is_done.recv_deadline(end).is_ok()
            }
            Err(SendTimeoutError::Timeout(entry) | SendTimeoutError::Disconnected(entry)) => {
                if let Entry::Log(pending, _) = entry {
                    self.pending = pending;
                }
                false
            }
        };
        if !is_whole && self.timeout > SECOND_TIMEOUT {
            let (folder, seconds) = (self.folder.display(), self.timeout.as_secs());
            tracing::warn!("{folder}: the journal could not be written to disk within {seconds} s");
            self.timeout = SECOND_TIMEOUT;
        }
        is_whole
    }

    /// The map in the journal, with at most `max_bytes` of depth; empty where the disk does not respond.
    pub fn map(&mut self, max_bytes: u64) -> Map {
        match self.flush() {
            true => read_map_of(&self.folder, max_bytes),
            false => Map::default(),
        }
    }

    /// Removes the journal, once the results are written or where there are none.
    pub fn finish(mut self) -> io::Result<()> {
        if !self.close() {
            return Err(io::Error::new(io::ErrorKind::TimedOut, "its disk does not respond"));
        }
        remove_folder(&self.folder)?;
        drop(self.pointer.take().map(Pointer::clear));
        Ok(())
    }

    /// Ends the thread, or leaves it alone where its disk hangs; returns whether it has ended.
    fn close(&mut self) -> bool {
        self.flush();
        self.entries = None;
        let has_ended = || self.thread.as_ref().is_none_or(JoinHandle::is_finished);
        if !wait_at_most(self.timeout, has_ended) {
            self.thread = None;
            return false;
        }
        // A panic of the thread has been reported where it happened.
        drop(self.thread.take().map(JoinHandle::join));
        true
    }
}

/// Reads a file that another thread writes to, with a separate position.
struct ReadFromStart<'a> {
    file: &'a File,
    at: u64,
}

impl Read for ReadFromStart<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read_at(bytes, self.at)?;
        self.at += count as u64;
        Ok(count)
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        self.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::journal::log::Step;
    use crate::service::recording::Recording;
    use crate::slam::frame::FrameView;
    use crate::slam::pose::PoseEstimate;
    use crate::wire::conversion::{PoseTiming, pose_message};

    fn pose(sequence: u64) -> PoseMessage {
        let frame = FrameView {
            sequence,
            capture_nanos: sequence as i64,
            exposure_nanos: 0,
            width: 0,
            height: 0,
            pixels: &[],
        };
        pose_message(&PoseEstimate::unknown(&frame), &PoseTiming::default())
    }

    /// A journal in `folder` without a pointer.
    fn journal(folder: &Path) -> Journal {
        let writer = Writer::create(folder, &log_header(), 1 << 20).unwrap();
        let (held, on_disk) = (writer.lock().unwrap(), writer.poses_on_disk());
        let (entries, received) = bounded(QUEUE);
        let thread = std::thread::spawn(move || writer.write_all(&received));
        let mut journal = Journal::of(folder.to_owned(), held, Some((entries, thread)));
        journal.on_disk = on_disk;
        journal
    }

    #[test]
    fn poses_on_disk_need_no_memory_and_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut journal = journal(folder.path());
        let mut recording = Recording::default();
        for sequence in 0..3000 {
            recording.add_pose(&pose(sequence)).unwrap();
            journal.append(&Record::Pose(Box::new(pose(sequence))));
            journal.append(&Record::Step(Step { step_nanos: 1, change_nanos: 0, start_frame: 0 }));
            if sequence == 2000 {
                assert!(journal.flush());
                recording.release(journal.poses_on_disk());
                assert_eq!(recording.num_released(), 2001, "what is on the disk is not held");
            }
        }
        // The user has removed the folder's log: it is still open.
        std::fs::remove_file(folder.path().join(folder::LOG)).unwrap();
        let mut found = Vec::new();
        journal.read_poses(recording.num_released(), &mut |pose| found.push(*pose));
        assert_eq!(found, (0..2001).map(pose).collect::<Vec<_>>());
        assert_eq!(recording.restore_released(|take| journal.read_poses(2001, take)), 0);
        assert_eq!((recording.num_poses(), recording.num_released()), (3000, 0));
    }

    #[test]
    fn poses_after_an_omitted_one_are_not_counted() {
        let folder = tempfile::tempdir().unwrap();
        let mut journal = journal(folder.path());
        let append = |journal: &mut Journal, sequence| {
            journal.append(&Record::Pose(Box::new(pose(sequence))));
        };
        append(&mut journal, 0);
        assert!(journal.flush());
        // The disk has hung for an hour and responds again.
        journal.pending = vec![0; MAX_PENDING_BYTES];
        append(&mut journal, 1);
        journal.pending = Vec::new();
        append(&mut journal, 2);
        assert!(journal.flush());
        assert_eq!(journal.poses_on_disk(), 1);
    }

    #[test]
    fn a_hanging_disk_delays_neither_the_run_nor_its_end() {
        let folder = tempfile::tempdir().unwrap();
        let held = tempfile::tempfile().unwrap();
        let (entries, received) = bounded(QUEUE);
        let (release, hangs) = bounded::<()>(0);
        let thread = std::thread::spawn(move || {
            // As in a write that never returns.
            let _ = hangs.recv();
            drop(received);
        });
        let mut journal = Journal::of(folder.path().to_owned(), held, Some((entries, thread)));
        journal.timeout = Duration::from_millis(20);
        let record = Record::Step(Step { step_nanos: 1, change_nanos: 2, start_frame: 3 });
        let mut bytes = Vec::new();
        record.write(&mut bytes);
        for _ in 0..MAX_PENDING_BYTES / bytes.len() + 1000 {
            journal.append(&record);
            // Makes each one due.
            journal.handed_over -= PERIOD;
        }
        assert!(
            journal.leaves_out
                && journal.has_hole
                && journal.pending.len() < MAX_PENDING_BYTES + bytes.len()
        );
        assert!(!journal.flush());
        assert!(journal.map(u64::MAX).keyframes.is_empty());
        assert!(journal.finish().is_err());
        drop(release);
    }
}
