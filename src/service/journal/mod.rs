//! The journal of a run: what it takes to write its results, on the disk while it goes on.
//!
//! A folder inside the output folder: `log` has poses, times and keyframe poses as they come, and each keyframe has
//! a file with its newest depth. Everything is written by a thread of its own and is on the disk after about a
//! second. The folder goes when the results are written; who finds one that nobody holds finds a run that was
//! killed, and [`recovered`] makes its record.

pub mod feed;
pub mod folder;
pub mod log;
pub mod recovered;
pub mod replayed;
mod writer;

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::service::journal::folder::{Pointer, begin_folder, hold, hold_own, remove_folder};
use crate::service::journal::log::{Record, RunStart, log_header};
use crate::service::journal::recovered::read_map_of;
use crate::service::journal::writer::{Entry, Writer};
use crate::service::recording::RunCounters;
use crate::slam::keyframe::Keyframe;
use crate::slam::mapper::Map;
use crate::wire::place::Place;

/// Time between two hand-overs to the thread: that much of a run a kill may cost.
const PERIOD: Duration = Duration::from_secs(1);
/// Entries that may wait for the disk: two seconds of poses and a keyframe each.
const QUEUE: usize = 4;
/// Longest wait for the disk at the end.
const END_TIMEOUT: Duration = Duration::from_secs(60);

/// Where a journal is kept, and how much.
#[derive(Debug, Clone)]
pub struct JournalOptions {
    /// The output folder; it exists.
    pub output: PathBuf,
    /// How the run is started.
    pub start: RunStart,
    /// Most bytes of depth; beyond it the oldest keyframes keep only their poses, as in the mapper.
    pub max_depth_bytes: u64,
}

/// The journal of the run that goes on. Dropped without [`Journal::finish`] it stays.
#[derive(Debug)]
pub struct Journal {
    folder: PathBuf,
    pointer: Option<Pointer>,
    /// What the thread does not have yet.
    pending: Vec<u8>,
    counted: Instant,
    handed_over: Instant,
    entries: Option<SyncSender<Entry>>,
    thread: Option<JoinHandle<()>>,
    /// Says that the run goes on.
    _hold: File,
}

impl Journal {
    /// Begins the journal of a run of the instance at `place`.
    pub fn begin(options: &JournalOptions, place: &Place) -> io::Result<Self> {
        let folder = begin_folder(&options.output)?;
        let log = folder.join(folder::LOG);
        let mut first = log_header();
        Record::Start(Box::new(options.start.clone())).write(&mut first);
        let writer = Writer::create(&folder, &first, options.max_depth_bytes)?;
        let (entries, received) = sync_channel(QUEUE);
        let thread = std::thread::Builder::new()
            .name("semidense-journal".to_owned())
            .spawn(move || writer.write_all(&received))?;
        let pointer = Pointer::set(place, &folder)
            .inspect_err(|error| tracing::debug!("no pointer to the journal ({error})"));
        Ok(Self {
            _hold: hold_own(&log)?,
            pointer: pointer.ok(),
            folder,
            pending: Vec::new(),
            counted: Instant::now(),
            handed_over: Instant::now(),
            entries: Some(entries),
            thread: Some(thread),
        })
    }

    /// Holds the journal that a killed run has left in `folder`, so that nobody else makes results of it; `None`
    /// where somebody does.
    pub fn take_over(folder: &Path) -> io::Result<Option<Self>> {
        let held = hold(&folder.join(folder::LOG))?;
        Ok(held.map(|held| Self {
            folder: folder.to_owned(),
            // Who looks for it next removes it.
            pointer: None,
            pending: Vec::new(),
            counted: Instant::now(),
            handed_over: Instant::now(),
            entries: None,
            thread: None,
            _hold: held,
        }))
    }

    /// Where it is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Takes in a record. Never waits for the disk.
    pub fn append(&mut self, record: &Record) {
        record.write(&mut self.pending);
        self.tick();
    }

    /// Whether it is time for [`Journal::count`].
    pub fn wants_counters(&self) -> bool {
        self.counted.elapsed() >= PERIOD
    }

    /// Takes in what was counted until now.
    pub fn count(&mut self, counters: RunCounters) {
        self.counted = Instant::now();
        self.append(&Record::Counters(counters));
    }

    /// Takes in the newest state of a keyframe; gives it back where the disk is behind. Never waits.
    pub fn put_keyframe(&mut self, keyframe: Keyframe) -> Option<Keyframe> {
        let without_depth = Keyframe { image: Vec::new(), points: Vec::new(), ..keyframe };
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
        if self.handed_over.elapsed() < PERIOD || self.pending.is_empty() {
            return;
        }
        let Some(entries) = &self.entries else { return };
        match entries.try_send(Entry::Log(std::mem::take(&mut self.pending))) {
            Err(TrySendError::Full(Entry::Log(pending))) => self.pending = pending,
            _ => self.handed_over = Instant::now(),
        }
    }

    /// Waits until everything is on the disk, or for a bounded time.
    pub fn flush(&mut self) {
        let (done, is_done) = sync_channel(1);
        let Some(entries) = &self.entries else { return };
        let pending = std::mem::take(&mut self.pending);
        let sent = entries.send(Entry::Log(pending)).and_then(|()| entries.send(Entry::Mark(done)));
        if sent.is_ok() {
            let _ = is_done.recv_timeout(END_TIMEOUT);
        }
    }

    /// The map as the journal has it, at most `max_bytes` of depth.
    pub fn map(&mut self, max_bytes: u64) -> Map {
        self.flush();
        read_map_of(&self.folder, max_bytes)
    }

    /// The results are written, or there are none: the journal goes.
    pub fn finish(mut self) -> io::Result<()> {
        self.close();
        remove_folder(&self.folder)?;
        drop(self.pointer.take().map(Pointer::clear));
        Ok(())
    }

    fn close(&mut self) {
        self.flush();
        self.entries = None;
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            drop(thread.join());
        }
    }
}

impl Drop for Journal {
    fn drop(&mut self) {
        self.close();
    }
}
