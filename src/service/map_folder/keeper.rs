//! Keeps a map on disk while it is made, on a separate thread, so that no frame waits for a file.
//!
//! Each new keyframe and each correction writes what is new to disk: a keyframe when it is left, and, of those that
//! have changed since they were written, the one that has waited longest; then the manifest, with the newest pose of
//! every keyframe. A save thus costs at most two keyframes, however large the map is, and a killed process leaves a map
//! without its active keyframe. Changes that are not written yet are written at the end.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::numbering::Numbering;
use crate::service::map_folder::writer::{MapWriter, head_of};
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::keyframe::{Keyframe, MapState};
use crate::slam::map::Map;
use crate::slam::mapper::{Mapper, StepOutcome};

/// Keyframes that wait to be written; a slower disk gets the others later.
const MAX_WAITING: usize = 8;

/// Follows a mapper.
#[derive(Debug)]
pub struct MapSaver {
    camera: Intrinsics,
    numbering: Numbering,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
    /// Revisions of the keyframes that were handed over, by id.
    handed: BTreeMap<u64, u64>,
    /// Whether a save waits for the previous one.
    waits: bool,
}

#[derive(Debug)]
struct Shared {
    waiting: Mutex<Waiting>,
    wake: Condvar,
    /// Signalled when the thread has nothing to do.
    idle: Condvar,
    writer: Mutex<MapWriter>,
}

/// Work for the thread.
#[derive(Debug, Default)]
struct Waiting {
    keyframes: BTreeMap<u64, Keyframe>,
    head: Option<Map>,
    is_over: bool,
    is_busy: bool,
    /// Keyframes of failed saves, which are handed over again.
    failed: BTreeSet<u64>,
    /// Why the last save failed, until it is reported.
    failure: Option<String>,
    /// Whether the last save failed.
    is_refused: bool,
}

impl MapSaver {
    /// Keeps the map of `camera` in a folder. `loaded` is the map that the folder already holds; its keyframe numbers
    /// may differ from those of the mapper. Where frames may wait (`waits`) a save waits for the previous one, so that
    /// a kill costs at most one keyframe where frames arrive faster than the disk writes.
    pub fn start(
        writer: MapWriter,
        camera: Intrinsics,
        loaded: &Map,
        numbering: Numbering,
        waits: bool,
    ) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            waiting: Mutex::default(),
            wake: Condvar::new(),
            idle: Condvar::new(),
            writer: Mutex::new(writer),
        });
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("semidense-save".to_owned())
            .spawn(move || save_until_stopped(&theirs, &camera))?;
        let handed = loaded.keyframes.iter().map(|of| (of.keyframe_id, of.revision));
        Ok(Self {
            camera,
            numbering,
            shared,
            thread: Some(thread),
            handed: handed.collect(),
            waits,
        })
    }

    /// Hands over what a step or a correction changed.
    pub fn follow(&mut self, mapper: &Mapper, outcome: &StepOutcome) {
        if !(outcome.needs_image() || outcome.graph_changed) {
            return;
        }
        for keyframe_id in std::mem::take(&mut locked(&self.shared.waiting).failed) {
            self.handed.remove(&keyframe_id);
        }
        let (map, active) = (mapper.map(), mapper.keyframe().map(|keyframe| keyframe.keyframe_id));
        let of_map = map.keyframes.iter().filter(|of| is_kept(of, &self.camera));
        let left = of_map.filter(|of| Some(of.keyframe_id) != active);
        let (mut new, mut changed) = (Vec::new(), None);
        for keyframe in left {
            match self.handed.get(&keyframe.keyframe_id) {
                None => new.push(keyframe),
                Some(handed) if *handed < keyframe.revision => {
                    if changed.is_none_or(|(least, _)| *handed < least) {
                        changed = Some((*handed, keyframe));
                    }
                }
                Some(_) => {}
            }
        }
        let head = self.numbering.head_on_disk(head_of(mapper.map(), mapper.free_epoch()));
        let mut waiting = locked(&self.shared.waiting);
        while self.waits && (waiting.is_busy || waiting.head.is_some()) {
            waiting = self.shared.idle.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        for keyframe in new.into_iter().chain(changed.map(|(_, keyframe)| keyframe)) {
            if waiting.keyframes.len() < MAX_WAITING
                && let Some(on_disk) = self.numbering.on_disk(keyframe.clone())
            {
                self.handed.insert(keyframe.keyframe_id, keyframe.revision);
                waiting.keyframes.insert(keyframe.keyframe_id, on_disk);
            }
        }
        waiting.head = Some(head);
        drop(waiting);
        self.shared.wake.notify_one();
    }

    /// Writes everything that is not on disk yet, before it returns. Calls `each` before each keyframe, as it may take
    /// longer than a process may be silent.
    pub fn save_all(
        &mut self,
        mapper: &Mapper,
        each: &mut dyn FnMut(),
    ) -> Result<(), MapFolderError> {
        let mut writer = locked(&self.shared.writer);
        let mut waiting = locked(&self.shared.waiting);
        waiting.head = None;
        // Waiting keyframes are older than those written now, and those that failed are written again.
        let failed = std::mem::take(&mut waiting.failed);
        for keyframe_id in std::mem::take(&mut waiting.keyframes).into_keys().chain(failed) {
            self.handed.remove(&keyframe_id);
        }
        drop(waiting);
        let camera = self.camera;
        for keyframe in mapper.map().keyframes.iter().filter(|of| is_kept(of, &camera)) {
            each();
            if self.handed.get(&keyframe.keyframe_id) == Some(&keyframe.revision) {
                continue;
            }
            if let Some(on_disk) = self.numbering.on_disk(keyframe.clone()) {
                writer.put(&on_disk)?;
            }
            self.handed.insert(keyframe.keyframe_id, keyframe.revision);
        }
        let head = self.numbering.head_on_disk(head_of(mapper.map(), mapper.free_epoch()));
        writer.save(&self.camera, head)?;
        writer.settle()
    }

    /// Takes the reason why the last save failed.
    pub fn take_failure(&mut self) -> Option<String> {
        locked(&self.shared.waiting).failure.take()
    }
}

/// Whether a keyframe has the contents of a file.
pub(super) fn is_kept(keyframe: &Keyframe, camera: &Intrinsics) -> bool {
    keyframe.has_depth()
        && keyframe.map_state == MapState::Established
        && keyframe.intrinsics == *camera
}

impl Drop for MapSaver {
    fn drop(&mut self) {
        locked(&self.shared.waiting).is_over = true;
        self.shared.wake.notify_one();
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            drop(thread.join());
        }
    }
}

/// The data is consistent between any two of its changes, even where a thread has panicked.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn save_until_stopped(shared: &Shared, camera: &Intrinsics) {
    loop {
        let mut waiting = locked(&shared.waiting);
        while waiting.head.is_none() && !waiting.is_over {
            waiting = shared.wake.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        let is_over = waiting.is_over;
        waiting.is_busy = true;
        drop(waiting);
        save_waiting(shared, camera);
        locked(&shared.waiting).is_busy = false;
        shared.idle.notify_all();
        if is_over {
            return;
        }
    }
}

/// Saves what waits, once.
fn save_waiting(shared: &Shared, camera: &Intrinsics) {
    let mut writer = locked(&shared.writer);
    let mut waiting = locked(&shared.waiting);
    let (keyframes, head) = (std::mem::take(&mut waiting.keyframes), waiting.head.take());
    drop(waiting);
    let Some(head) = head else { return };
    let begin = Instant::now();
    let put = keyframes.values().try_for_each(|keyframe| writer.put(keyframe));
    let failure = put.and_then(|()| writer.save(camera, head)).err().map(|error| error.to_string());
    tracing::debug!("saved {} keyframes in {:?}", keyframes.len(), begin.elapsed());
    if let Some(failure) = failure {
        let mut waiting = locked(&shared.waiting);
        waiting.failed.extend(keyframes.into_keys());
        // A disk that stays full refuses with every keyframe.
        if !std::mem::replace(&mut waiting.is_refused, true) {
            tracing::warn!("{failure}; the previous save remains on disk");
        }
        waiting.failure = Some(failure);
    } else {
        locked(&shared.waiting).is_refused = false;
    }
}

#[cfg(test)]
mod tests;
