//! Where the tracker gets its references: prepared on the spot in lockstep, so that the result is
//! the same on every run; on a second thread live, so that the frame loop only swaps a pointer.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;

use crate::slam::alignment::reference::{Reference, ReferenceParams};
use crate::slam::keyframe::Keyframe;
use crate::wire::keyframe_inbox::{InboxError, KeyframeInbox};
use crate::wire::place::Place;
use crate::wire::port::{Access, Hub, OpenError, wait};

/// Longest sleep of the second thread without a look at its end.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Used references whose memory waits for the next: one in use, one prepared, one being made.
const MAX_USED: usize = 3;

/// Gives the newest keyframe, prepared.
#[derive(Debug)]
pub enum ReferenceFeed {
    /// Prepares when asked.
    Synchronous(Box<Synchronous>),
    /// Prepares beside the frame loop.
    Threaded(Preparer),
}

impl ReferenceFeed {
    /// Prepares when asked.
    pub fn synchronous(hub: &Hub, params: &ReferenceParams) -> Result<Self, OpenError> {
        let (inbox, params) = (KeyframeInbox::open(hub)?, params.clone());
        Ok(Self::Synchronous(Box::new(Synchronous { inbox, params, used: None })))
    }

    /// Prepares on a thread of its own, which joins the instance by itself.
    pub fn threaded(place: &Place, params: &ReferenceParams) -> io::Result<Self> {
        Ok(Self::Threaded(Preparer::start(place, params)?))
    }

    /// The newest reference that has not been taken.
    pub fn newest(&mut self) -> Result<Option<Box<Reference>>, InboxError> {
        match self {
            Self::Threaded(preparer) => Ok(preparer.shared.prepared.pop()),
            Self::Synchronous(synchronous) => match synchronous.inbox.newest() {
                Ok(keyframe) => Ok(keyframe.map(|keyframe| {
                    prepare(&keyframe, synchronous.used.take(), &synchronous.params)
                })),
                Err(InboxError::Message(error)) => {
                    tracing::warn!("mapper/keyframe: {error}");
                    Ok(None)
                }
                Err(error) => Err(error),
            },
        }
    }

    /// Takes back a used reference: its memory serves the next one.
    pub fn give_back(&mut self, used: Box<Reference>) {
        match self {
            Self::Synchronous(synchronous) => synchronous.used = Some(used),
            Self::Threaded(preparer) => {
                // A full queue gives it back to us, and it is freed here.
                let _ = preparer.shared.used.push(used);
            }
        }
    }
}

/// A reference of `keyframe`, in the memory of a used one where there is one.
fn prepare(
    keyframe: &Keyframe,
    used: Option<Box<Reference>>,
    params: &ReferenceParams,
) -> Box<Reference> {
    let mut reference = used.unwrap_or_else(|| Box::new(Reference::new(params.clone())));
    reference.prepare_into(keyframe);
    reference
}

/// Prepares on the tracker's own thread.
#[derive(Debug)]
pub struct Synchronous {
    inbox: KeyframeInbox,
    params: ReferenceParams,
    used: Option<Box<Reference>>,
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
    fn start(place: &Place, params: &ReferenceParams) -> io::Result<Self> {
        let shared = Arc::new(Shared {
            prepared: ArrayQueue::new(1),
            used: ArrayQueue::new(MAX_USED),
            stop: AtomicBool::new(false),
        });
        let (theirs, place, params) = (Arc::clone(&shared), place.clone(), params.clone());
        let thread = std::thread::Builder::new()
            .name("semidense-reference".to_owned())
            .spawn(move || prepare_until_stopped(&place, &params, &theirs))?;
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

fn prepare_until_stopped(place: &Place, params: &ReferenceParams, shared: &Shared) {
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
        match inbox.newest() {
            Ok(None) => {}
            Ok(Some(keyframe)) => {
                // What the tracker has not taken yet is older: it goes.
                let reference = prepare(&keyframe, shared.used.pop(), params);
                if let Some(older) = shared.prepared.force_push(reference) {
                    drop(shared.used.push(older));
                }
            }
            Err(error) => tracing::warn!("{error}"),
        }
    }
}
