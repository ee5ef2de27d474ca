//! The thread that brings a journal to the disk.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, SyncSender};

use crate::service::journal::folder::{LOG, keyframe_file};
use crate::service::map_file::write_map_into;
use crate::slam::keyframe::Keyframe;
use crate::slam::mapper::Map;

/// Most bytes of log that wait for room on a full disk; ten hours of poses.
const MAX_WAITING_BYTES: usize = 512 << 20;

/// What the thread is handed.
#[derive(Debug)]
pub(super) enum Entry {
    /// Whole records of the log.
    Log(Vec<u8>),
    /// A keyframe's newest state.
    Keyframe(Box<Keyframe>),
    /// Answered when everything before is on the disk.
    Mark(SyncSender<()>),
}

/// Writes what it is handed.
#[derive(Debug)]
pub(super) struct Writer {
    folder: PathBuf,
    log: File,
    /// Bytes of the log that end with a whole record.
    good_bytes: u64,
    /// Whole records that the disk has refused so far.
    waiting: Vec<u8>,
    /// Files with depth, oldest first, and their bytes.
    files: VecDeque<(PathBuf, u64)>,
    max_depth_bytes: u64,
    is_refused: bool,
}

impl Writer {
    /// Begins a log in `folder` with `first`, which is on the disk when this returns.
    pub fn create(folder: &Path, first: &[u8], max_depth_bytes: u64) -> io::Result<Self> {
        let mut log = File::create_new(folder.join(LOG))?;
        log.write_all(first)?;
        log.sync_all()?;
        File::open(folder)?.sync_all()?;
        Ok(Self {
            folder: folder.to_owned(),
            log,
            good_bytes: first.len() as u64,
            waiting: Vec::new(),
            files: VecDeque::new(),
            max_depth_bytes,
            is_refused: false,
        })
    }

    /// Writes until nobody hands anything over any more.
    pub fn write_all(mut self, entries: &Receiver<Entry>) {
        for entry in entries {
            let outcome = match entry {
                Entry::Log(records) => self.append(&records),
                Entry::Keyframe(keyframe) => self.write_keyframe(*keyframe),
                Entry::Mark(done) => {
                    let _ = done.try_send(());
                    continue;
                }
            };
            match outcome {
                Ok(()) => self.is_refused = false,
                Err(error) if !self.is_refused => {
                    self.is_refused = true;
                    let folder = self.folder.display();
                    tracing::warn!(
                        "{folder}: the journal is behind ({error}); a kill would now cost more than a second of the run"
                    );
                }
                Err(_) => {}
            }
        }
    }

    /// Appends records. On a full disk depth makes room for them, the oldest first: a run without poses is
    /// lost, one without some depth is not. What is still refused is tried with the next.
    fn append(&mut self, records: &[u8]) -> io::Result<()> {
        if self.waiting.len() < MAX_WAITING_BYTES {
            self.waiting.extend_from_slice(records);
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

    /// Appends what waits. What the disk refuses is cut off again.
    fn append_waiting(&mut self) -> io::Result<()> {
        let written = self.log.write_all(&self.waiting).and_then(|()| self.log.sync_data());
        match written {
            Ok(()) => {
                self.good_bytes += self.waiting.len() as u64;
                self.waiting = Vec::new();
                Ok(())
            }
            Err(error) => {
                self.log.set_len(self.good_bytes)?;
                io::Seek::seek(&mut self.log, io::SeekFrom::Start(self.good_bytes))?;
                Err(error)
            }
        }
    }

    /// Replaces the file of a keyframe, and removes the oldest where there is too much.
    fn write_keyframe(&mut self, keyframe: Keyframe) -> io::Result<()> {
        let path = self.folder.join(keyframe_file(keyframe.epoch, keyframe.keyframe_id));
        let temporary = path.with_extension("tmp");
        let mut bytes = Vec::new();
        write_map_into(&mut bytes, &Map { keyframes: vec![keyframe], free_epoch: 0 })?;
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
