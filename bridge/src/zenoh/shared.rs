//! State shared by the receiver's threads: the queues between them, and the state of the sender.

use std::io::Write;
use std::os::unix::net::UnixStream;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use semidense::service::clock::now_nanos;
use zenoh::bytes::ZBytes;

use crate::slots::Slots;
use crate::zenoh::envelope::{EnvelopeError, Opened, open};
use crate::zenoh::kind::Kind;
use crate::zenoh::remote::Remote;
use crate::zenoh::stamps::translate;
use crate::zenoh::unpack::{Arrival, unpack};

/// Poses queued for the main thread: those that arrive while the machine is busy for seconds.
const WAITING_POSES: usize = 256;

/// Queued health reports and joint estimates.
const WAITING_SMALL: usize = 16;

/// The queues and the sender's state.
#[derive(Debug)]
pub struct Shared {
    remote: Mutex<Remote>,
    pub(super) urgent: Slots<(Kind, ZBytes)>,
    pub(super) large: Slots<(Kind, ZBytes)>,
    pub(super) ready: Slots<Arrival>,
    /// Wakes the main thread.
    wake: UnixStream,
}

impl Shared {
    /// Empty queues; `wake` wakes the main thread.
    pub(super) fn new(wake: UnixStream) -> Self {
        // By kind; slots of kinds that a queue never holds stay empty.
        let depths = Kind::ALL.map(|kind| match kind {
            Kind::Pose => WAITING_POSES,
            Kind::Keyframe | Kind::KeyframeImage | Kind::Graph | Kind::Frame => 1,
            _ => WAITING_SMALL,
        });
        let (urgent, large) = (Slots::new(&depths), Slots::new(&depths));
        Self { remote: Mutex::default(), urgent, large, ready: Slots::new(&depths), wake }
    }

    /// Locks the state of the sender.
    pub fn remote(&self) -> MutexGuard<'_, Remote> {
        self.remote.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Queues a message; never waits.
    pub fn arrive(&self, kind: Kind, bytes: ZBytes) {
        if kind.is_urgent() {
            self.urgent.put(kind as usize, (kind, bytes));
            self.wake();
        } else {
            self.large.put(kind as usize, (kind, bytes));
        }
    }

    fn wake(&self) {
        // A full socket buffer wakes the thread as well.
        let _ = (&self.wake).write(&[0]);
    }

    /// Checks an envelope received for `kind`; `None` if it is invalid.
    pub(super) fn open<'a>(&self, kind: Kind, bytes: &'a [u8]) -> Option<Opened<'a>> {
        match open(bytes) {
            Ok(opened) if opened.kind == kind => return Some(opened),
            Err(EnvelopeError::Version { found }) => {
                self.remote().note_foreign_version(found, Instant::now());
            }
            _ => self.remote().refused += 1,
        }
        None
    }

    /// Checks and unpacks a message; `None` if it is not to be used.
    pub(super) fn unpack(&self, kind: Kind, bytes: &ZBytes) -> Option<Arrival> {
        let bytes = bytes.to_bytes();
        let opened = self.open(kind, &bytes)?;
        if !self.remote().admit(&opened.envelope, kind, Instant::now()) {
            return None;
        }
        match unpack(&opened) {
            Ok(mut arrival) => {
                translate(&mut arrival, &self.remote().clock, now_nanos());
                Some(arrival)
            }
            Err(error) => {
                tracing::debug!("{kind:?} {}: {error}", opened.envelope.number);
                self.remote().refused += 1;
                None
            }
        }
    }

    /// Unpacks large messages until the queue is closed.
    pub(super) fn unpack_large(&self) {
        while let Some((kind, bytes)) = self.large.take() {
            if let Some(arrival) = self.unpack(kind, &bytes) {
                self.ready.put(kind as usize, arrival);
                self.wake();
            }
        }
    }
}
