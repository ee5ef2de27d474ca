//! What the receiver's threads share: the queues between them, and what is known of the sender.

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

/// Poses that wait for the main thread: what came while the machine was busy for seconds.
const WAITING_POSES: usize = 256;

/// Of health, joint estimates.
const WAITING_SMALL: usize = 16;

/// What the receiver's threads share.
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
    /// Empty; `wake` wakes the main thread.
    pub(super) fn new(wake: UnixStream) -> Self {
        // By kind; those that do not go there stay empty.
        let depths = Kind::ALL.map(|kind| match kind {
            Kind::Pose => WAITING_POSES,
            Kind::Keyframe | Kind::KeyframeImage | Kind::Graph | Kind::Frame => 1,
            _ => WAITING_SMALL,
        });
        let (urgent, large) = (Slots::new(&depths), Slots::new(&depths));
        Self { remote: Mutex::default(), urgent, large, ready: Slots::new(&depths), wake }
    }

    /// What is known of the sender.
    pub fn remote(&self) -> MutexGuard<'_, Remote> {
        self.remote.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes in a message; never waits.
    pub fn arrive(&self, kind: Kind, bytes: ZBytes) {
        if kind.is_urgent() {
            self.urgent.put(kind as usize, (kind, bytes));
            self.wake();
        } else {
            self.large.put(kind as usize, (kind, bytes));
        }
    }

    fn wake(&self) {
        // A full pipe wakes as well.
        let _ = (&self.wake).write(&[0]);
    }

    /// Checks an envelope that came as one of `kind`; `None` where it is none.
    pub(super) fn open<'a>(&self, kind: Kind, bytes: &'a [u8]) -> Option<Opened<'a>> {
        match open(bytes) {
            Ok(opened) if opened.kind == kind => return Some(opened),
            Err(EnvelopeError::Version { found }) => {
                self.remote().hear_foreign(found, Instant::now());
            }
            _ => self.remote().refused += 1,
        }
        None
    }

    /// Checks and unpacks; `None` for what is not to be used.
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

    /// Unpacks what is large until the queue is closed.
    pub(super) fn unpack_large(&self) {
        while let Some((kind, bytes)) = self.large.take() {
            if let Some(arrival) = self.unpack(kind, &bytes) {
                self.ready.put(kind as usize, arrival);
                self.wake();
            }
        }
    }
}
