//! Where the tracker gets its references: prepared on the spot in lockstep, so that the result is
//! the same on every run; on a second thread live, so that the frame loop only swaps a pointer.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;

use crate::slam::alignment::reference::Reference;
use crate::wire::keyframe_inbox::{InboxError, KeyframeInbox};
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, OpenError, wait};

/// Longest sleep of the second thread without a look at its end.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Used references that wait to be freed; more are freed by the tracker itself.
const MAX_USED: usize = 4;

/// Gives the newest keyframe, prepared.
#[derive(Debug)]
pub enum ReferenceFeed {
    /// Prepares when asked.
    Synchronous(Box<KeyframeInbox>),
    /// Prepares beside the frame loop.
    Threaded(Preparer),
}

impl ReferenceFeed {
    /// Prepares when asked.
    pub fn synchronous(hub: &Hub) -> Result<Self, OpenError> {
        Ok(Self::Synchronous(Box::new(KeyframeInbox::open(hub)?)))
    }

    /// Prepares on a thread of its own, which joins the instance by itself.
    pub fn threaded(place: &Place) -> io::Result<Self> {
        Ok(Self::Threaded(Preparer::start(place)?))
    }

    /// The newest reference that has not been taken.
    pub fn newest(&mut self) -> Result<Option<Box<Reference>>, InboxError> {
        match self {
            Self::Threaded(preparer) => Ok(preparer.shared.prepared.pop()),
            Self::Synchronous(inbox) => match inbox.newest() {
                Ok(keyframe) => Ok(keyframe.map(|k| Box::new(Reference::prepare(&k)))),
                Err(InboxError::Message(error)) => {
                    tracing::warn!("mapper/keyframe: {error}");
                    Ok(None)
                }
                Err(error) => Err(error),
            },
        }
    }

    /// Takes back a used reference, to be freed where it does not cost the frame loop.
    pub fn give_back(&self, used: Box<Reference>) {
        if let Self::Threaded(preparer) = self {
            // A full queue gives it back to us, and it is freed here.
            let _ = preparer.shared.used.push(used);
        }
    }
}

/// The second thread; ends when dropped.
#[derive(Debug)]
pub struct Preparer {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    prepared: ArrayQueue<Box<Reference>>,
    used: ArrayQueue<Box<Reference>>,
    stop: AtomicBool,
}

impl Preparer {
    fn start(place: &Place) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            prepared: ArrayQueue::new(1),
            used: ArrayQueue::new(MAX_USED),
            stop: AtomicBool::new(false),
        });
        let (theirs, place) = (Arc::clone(&shared), place.clone());
        let thread = std::thread::Builder::new()
            .name("semidense-reference".to_owned())
            .spawn(move || prepare_until_stopped(&place, &theirs))?;
        Ok(Self { shared, thread: Some(thread) })
    }
}

impl Drop for Preparer {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been reported where it happened.
            let _ = thread.join();
        }
    }
}

fn prepare_until_stopped(place: &Place, shared: &Shared) {
    let opened = Hub::join(place, "tracker-reference", Access::Member)
        .and_then(|hub| Ok((KeyframeInbox::open(&hub)?, hub)));
    let (mut inbox, _hub) = match opened {
        Ok(opened) => opened,
        Err(error) => {
            tracing::error!("no keyframes: {error}");
            return;
        }
    };
    while !shared.stop.load(Ordering::Acquire) {
        if let Err(error) = wait(&[inbox.events()], None, WAKE_PERIOD) {
            tracing::error!("no keyframes any more: {error}");
            return;
        }
        while shared.used.pop().is_some() {}
        match inbox.newest() {
            Ok(None) => {}
            Ok(Some(keyframe)) => {
                // What the tracker has not taken yet is older: it goes.
                shared.prepared.force_push(Box::new(Reference::prepare(&keyframe)));
            }
            Err(error) => tracing::warn!("{error}"),
        }
    }
}
