//! The thread that writes a journal to disk.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crossbeam::channel::{Receiver, Sender};
use rustix::fs::FlockOperation;

use crate::service::journal::folder::{LOG, keyframe_file};
use crate::service::map_file::write_map_into;
use crate::slam::keyframe::Keyframe;
use crate::slam::map::Map;

/// Most bytes of log that wait for room on a full disk: ten hours of poses.
const MAX_WAITING_BYTES: usize = 512 << 20;
/// Name of the log until it is held and begun.
const UNBEGUN_LOG: &str = "log.new";

/// Work for the thread.
#[derive(Debug)]
pub(super) enum Entry {
    /// Whole records of the log, and the number of poses from its beginning to their end, without a hole.
    Log(Vec<u8>, u64),
    /// A keyframe's newest state.
    Keyframe(Box<Keyframe>),
    /// Answered once everything before it is on disk.
    Mark(Sender<()>),
}

/// Whether the disk refuses writes, to warn on each change: on a full disk a write succeeds now and then, which is not
/// a change.
#[derive(Debug, Default)]
struct Refusals {
    is_said: bool,
    successes: u32,
}

impl Refusals {
    /// This many successes in a row end it: about a minute.
    const CALM: u32 = 60;

    /// Counts an outcome; returns whether it is a refusal not yet reported.
    fn is_new_refusal(&mut self, is_refused: bool) -> bool {
        self.successes = if is_refused { 0 } else { self.successes.saturating_add(1) };
        if self.successes >= Self::CALM {
            self.is_said = false;
        }
        is_refused && !std::mem::replace(&mut self.is_said, true)
    }
}

/// Writes the entries of a journal.
#[derive(Debug)]
pub(super) struct Writer {
    folder: PathBuf,
    log: File,
    /// Bytes of the log up to the end of its last whole record.
    good_bytes: u64,
    /// Whole records that the disk has not accepted yet.
    waiting: Vec<u8>,
    /// Poses from the beginning to the end of the waiting records, or to the first hole.
    poses: u64,
    /// Whether records were left out: later poses are no longer counted.
    has_hole: bool,
    /// How many of those poses are on disk and can be read back.
    on_disk: Arc<AtomicU64>,
    /// Files with depth, oldest first, and their bytes.
    files: VecDeque<(PathBuf, u64)>,
    max_depth_bytes: u64,
    log_refusals: Refusals,
    depth_refusals: Refusals,
}

impl Writer {
    /// Begins a log in `folder` with `first`, which is on disk on return. The log is held before it gets its name: one
    /// that no process holds belongs to a killed run.
    pub fn create(folder: &Path, first: &[u8], max_depth_bytes: u64) -> io::Result<Self> {
        let unbegun = folder.join(UNBEGUN_LOG);
        let log = File::create_new(&unbegun)?;
        rustix::fs::flock(&log, FlockOperation::NonBlockingLockExclusive)?;
        log.write_all_at(first, 0)?;
        log.sync_all()?;
        fs::rename(unbegun, folder.join(LOG))?;
        File::open(folder)?.sync_all()?;
        if let Some(output) = folder.parent() {
            File::open(output)?.sync_all()?;
        }
        Ok(Self {
            folder: folder.to_owned(),
            log,
            good_bytes: first.len() as u64,
            waiting: Vec::new(),
            poses: 0,
            has_hole: false,
            on_disk: Arc::default(),
            files: VecDeque::new(),
            max_depth_bytes,
            log_refusals: Refusals::default(),
            depth_refusals: Refusals::default(),
        })
    }

    /// Keeps the log held, even after the thread has ended.
    pub fn lock(&self) -> io::Result<File> {
        self.log.try_clone()
    }

    /// How many poses, from the first on and without a hole, are on disk.
    pub fn poses_on_disk(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.on_disk)
    }

    /// Writes until every sender is gone.
    pub fn write_all(mut self, entries: &Receiver<Entry>) {
        for entry in entries {
            if let Some(warning) = self.write(entry) {
                tracing::warn!("{}: {warning}", self.folder.display());
            }
        }
    }

    /// Writes one entry; returns a warning to be logged, if any.
    fn write(&mut self, entry: Entry) -> Option<String> {
        match entry {
            Entry::Log(records, poses) => {
                let error = self.append(&records, poses).err();
                let is_new_refusal = self.log_refusals.is_new_refusal(error.is_some());
                error.filter(|_| is_new_refusal).map(|error| {
                    format!(
                        "the journal has fallen behind ({error}); a kill would now lose more than a second of the run"
                    )
                })
            }
            Entry::Keyframe(keyframe) => {
                let error = self.write_keyframe(*keyframe).err();
                let is_new_refusal = self.depth_refusals.is_new_refusal(error.is_some());
                error.filter(|_| is_new_refusal).map(|error| {
                    format!(
                        "cannot write the depth of a keyframe to the journal ({error}); a kill would now lose depth of the map"
                    )
                })
            }
            Entry::Mark(done) => {
                // The requester may have given up.
                let _ = done.try_send(());
                None
            }
        }
    }

    /// Appends records. On a full disk depth makes room for them, the oldest first: a run without poses is lost, one
    /// without some depth is not. Records still refused are retried with the next.
    fn append(&mut self, records: &[u8], poses: u64) -> io::Result<()> {
        self.has_hole |= self.waiting.len() >= MAX_WAITING_BYTES;
        if self.waiting.len() < MAX_WAITING_BYTES {
            self.waiting.extend_from_slice(records);
        }
        if !self.has_hole {
            self.poses = poses;
        }
        let mut written = self.append_waiting();
        while written.as_ref().is_err_and(is_out_of_room)
            && let Some((oldest, _)) = self.files.pop_front()
        {
            fs::remove_file(oldest)?;
            written = self.append_waiting();
        }
        written
    }

    /// Appends the waiting records after the last whole one, overwriting what a refused attempt left there.
    fn append_waiting(&mut self) -> io::Result<()> {
        let written = self.log.write_all_at(&self.waiting, self.good_bytes);
        match written.and_then(|()| self.log.sync_data()) {
            Ok(()) => {
                self.good_bytes += self.waiting.len() as u64;
                self.waiting = Vec::new();
                self.on_disk.store(self.poses, Ordering::Release);
                Ok(())
            }
            Err(error) => {
                // A partial write only takes room from others.
                drop(self.log.set_len(self.good_bytes));
                Err(error)
            }
        }
    }

    /// Replaces the file of a keyframe, and removes the oldest files beyond the limit.
    fn write_keyframe(&mut self, keyframe: Keyframe) -> io::Result<()> {
        let path = self.folder.join(keyframe_file(&keyframe));
        let temporary = path.with_extension("tmp");
        let mut bytes = Vec::new();
        let map = Map { keyframes: vec![keyframe], ..Map::default() };
        write_map_into(&mut bytes, &map, &mut || ())?;
        let written = File::create(&temporary).and_then(|mut file| {
            file.write_all(&bytes)?;
            file.sync_data()
        });
        written.and_then(|()| fs::rename(&temporary, &path)).inspect_err(|_| {
            // The error that matters is the first one.
            let _ = fs::remove_file(&temporary);
        })?;
        self.files.retain(|(file, _)| *file != path);
        self.files.push_back((path, bytes.len() as u64));
        let mut sum: u64 = self.files.iter().map(|(_, bytes)| bytes).sum();
        while sum > self.max_depth_bytes && self.files.len() > 1 {
            let Some((oldest, bytes)) = self.files.pop_front() else { break };
            fs::remove_file(oldest)?;
            sum -= bytes;
        }
        Ok(())
    }
}

fn is_out_of_room(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::journal::folder::lock;
    use crate::service::journal::log::{LogEnd, Record, Step, log_header, read_log};
    use crate::slam::geometry::intrinsics::Intrinsics;
    use crate::slam::geometry::se3::SE3;
    use crate::slam::geometry::sim3::Sim3;

    fn step(nanos: u64) -> Vec<u8> {
        let mut bytes = Vec::new();
        Record::Step(Step { step_nanos: nanos, change_nanos: 0, start_frame: 0 }).write(&mut bytes);
        bytes
    }

    fn keyframe() -> Entry {
        Entry::Keyframe(Box::new(Keyframe {
            keyframe_id: 1,
            revision: 1,
            sequence: 1,
            capture_nanos: 1,
            ..Keyframe::at(
                Sim3::new(SE3::identity(), 1.0),
                Intrinsics::pinhole(9, 9, 9.0),
                Vec::new(),
                vec![0; 81],
            )
        }))
    }

    fn writer(folder: &Path) -> Writer {
        Writer::create(folder, &log_header(), 1 << 20).unwrap()
    }

    #[test]
    fn a_log_is_held_as_long_as_it_exists() {
        let folder = tempfile::tempdir().unwrap();
        let seen = folder.path().join(LOG);
        let writer = writer(folder.path());
        assert!(lock(&seen).unwrap().is_none());
        let held = writer.lock().unwrap();
        drop(writer);
        assert!(lock(&seen).unwrap().is_none());
        drop(held);
        assert!(lock(&seen).unwrap().is_some());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_full_disk_is_reported_once_even_if_some_writes_succeed() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path());
        let log = std::mem::replace(
            &mut writer.log,
            File::options().write(true).open("/dev/full").unwrap(),
        );
        let said: Vec<String> = (0..2 * Refusals::CALM)
            .flat_map(|n| [writer.write(Entry::Log(step(n.into()), 0)), writer.write(keyframe())])
            .flatten()
            .collect();
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].contains("the journal has fallen behind"), "{said:?}");
        // Once the disk has room, the waiting records are written; after a while a full disk is reported again.
        writer.log = log;
        for n in 0..Refusals::CALM {
            assert_eq!(writer.write(Entry::Log(step(n.into()), 0)), None);
        }
        let mut steps = 0;
        let log = File::open(folder.path().join(LOG)).unwrap();
        assert_eq!(read_log(log, &mut |_| steps += 1), LogEnd::Whole);
        assert_eq!(steps, 3 * Refusals::CALM);
        writer.log = File::options().write(true).open("/dev/full").unwrap();
        assert!(writer.write(Entry::Log(step(0), 0)).is_some());
    }

    #[test]
    fn only_poses_on_disk_are_counted() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path());
        let on_disk = writer.poses_on_disk();
        let counted = || on_disk.load(Ordering::Acquire);
        let full = File::options().write(true).open("/dev/full").unwrap();
        writer.write(Entry::Log(step(0), 3));
        assert_eq!(counted(), 3);
        let log = std::mem::replace(&mut writer.log, full);
        writer.write(Entry::Log(step(1), 5));
        assert_eq!(counted(), 3);
        writer.log = log;
        writer.write(Entry::Log(step(2), 6));
        assert_eq!(counted(), 6);
        // A run of months: its log is written and read to the end.
        writer.good_bytes = 1 << 40;
        writer.write(Entry::Log(step(3), 7));
        assert_eq!(counted(), 7);
        // Beyond the limit records are left out, and poses after them are not counted.
        writer.waiting = vec![0; MAX_WAITING_BYTES];
        writer.log = File::options().write(true).open("/dev/full").unwrap();
        writer.write(Entry::Log(step(4), 9));
        (writer.log, writer.waiting) =
            (File::create(folder.path().join("other")).unwrap(), Vec::new());
        writer.write(Entry::Log(step(5), 12));
        assert_eq!(counted(), 7);
    }

    #[test]
    fn leftovers_of_a_refused_attempt_are_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = writer(folder.path());
        assert_eq!(writer.write(Entry::Log(step(1), 0)), None);
        // Torn, and the disk refused to truncate it.
        let path = folder.path().join(LOG);
        let end = fs::metadata(&path).unwrap().len();
        io::Seek::seek(&mut writer.log, io::SeekFrom::Start(end)).unwrap();
        writer.log.write_all(&step(2)[..9]).unwrap();
        assert_eq!(writer.write(Entry::Log(step(2), 0)), None);
        let mut found = Vec::new();
        read_log(File::open(path).unwrap(), &mut |record| found.push(format!("{record:?}")));
        assert_eq!(found.len(), 2, "{found:?}");
    }
}
