//! State shared by the sender's threads: numbers, the run, and the last message of each kind for late receivers.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use semidense::service::clock::{now_nanos, realtime_of};
use zenoh::bytes::ZBytes;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::zenoh::envelope::{Origin, Packed, seal};
use crate::zenoh::kind::Kind;

/// Announces that the sender is running. Its envelope carries the sender's clock.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout)]
pub struct Presence {
    /// 1 while the instance runs, else 0.
    pub is_joined: u64,
    /// Number of the last message of each kind, by code.
    pub newest: [u64; Kind::COUNT],
}

/// Numbers outgoing messages and keeps the last ones.
#[derive(Debug)]
pub struct Outlet {
    sender: u64,
    run: AtomicU64,
    is_joined: AtomicBool,
    numbers: [AtomicU64; Kind::COUNT],
    bytes: [AtomicU64; Kind::COUNT],
    kept: Mutex<[Option<ZBytes>; Kind::COUNT]>,
}

impl Outlet {
    /// An outlet that has sent nothing yet.
    pub fn new(sender: u64) -> Self {
        Self {
            sender,
            run: AtomicU64::new(0),
            is_joined: AtomicBool::new(false),
            numbers: Default::default(),
            bytes: Default::default(),
            kept: Mutex::default(),
        }
    }

    /// Marks that an instance was joined.
    pub fn begin_run(&self) {
        self.run.fetch_add(1, Ordering::AcqRel);
        *self.kept() = Default::default();
        self.is_joined.store(true, Ordering::Release);
    }

    /// Marks that the instance has gone. Its last messages stay for late receivers.
    pub fn end_run(&self) {
        self.is_joined.store(false, Ordering::Release);
    }

    /// Assembles a message; if its kind is kept, it becomes the last one.
    pub fn seal<T: IntoBytes + Immutable>(
        &self,
        kind: Kind,
        message: &T,
        payload: &Packed,
    ) -> ZBytes {
        let number = self.numbers[kind as usize].fetch_add(1, Ordering::AcqRel) + 1;
        let sealed = seal(&self.origin(), kind, number, message, payload);
        self.bytes[kind as usize].fetch_add(sealed.len() as u64, Ordering::Relaxed);
        let sealed = ZBytes::from(sealed);
        if kind.is_kept() {
            self.kept()[kind as usize] = Some(sealed.clone());
        }
        sealed
    }

    /// Number of runs seen.
    pub fn run(&self) -> u64 {
        self.run.load(Ordering::Acquire)
    }

    /// The last message of a kind that is kept.
    pub fn last(&self, kind: Kind) -> Option<ZBytes> {
        self.kept()[kind as usize].clone()
    }

    /// The answer to a query for presence.
    pub fn presence(&self) -> ZBytes {
        let presence = Presence {
            is_joined: u64::from(self.is_joined.load(Ordering::Acquire)),
            newest: self.counts(),
        };
        ZBytes::from(seal(&self.origin(), Kind::Presence, 0, &presence, &Packed::empty()))
    }

    /// Messages sent so far, by kind.
    pub fn counts(&self) -> [u64; Kind::COUNT] {
        std::array::from_fn(|kind| self.numbers[kind].load(Ordering::Acquire))
    }

    /// Bytes sent so far, by kind.
    pub fn bytes(&self) -> [u64; Kind::COUNT] {
        std::array::from_fn(|kind| self.bytes[kind].load(Ordering::Relaxed))
    }

    fn origin(&self) -> Origin {
        Origin {
            sender: self.sender,
            run: self.run.load(Ordering::Acquire),
            sent_nanos: now_nanos(),
            realtime_offset_nanos: realtime_offset_nanos(),
        }
    }

    fn kept(&self) -> MutexGuard<'_, [Option<ZBytes>; Kind::COUNT]> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// CLOCK_REALTIME − CLOCK_MONOTONIC of this machine.
pub fn realtime_offset_nanos() -> i64 {
    realtime_of(0)
}
