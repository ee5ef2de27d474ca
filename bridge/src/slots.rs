//! A bounded queue between two threads with one slot per kind of item, in order of importance; a full slot
//! drops its oldest item. Putting never waits.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// A queue of prioritised, bounded slots.
#[derive(Debug)]
pub struct Slots<T> {
    inner: Mutex<Inner<T>>,
    filled: Condvar,
}

#[derive(Debug)]
struct Inner<T> {
    slots: Vec<Slot<T>>,
    is_closed: bool,
}

#[derive(Debug)]
struct Slot<T> {
    items: VecDeque<T>,
    depth: usize,
    dropped: u64,
}

/// The queue is closed: no more items will arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Closed;

impl<T> Slots<T> {
    /// A slot for each of `depths`, its capacity.
    pub fn new(depths: &[usize]) -> Self {
        let slot =
            |&depth: &usize| Slot { items: VecDeque::with_capacity(depth), depth, dropped: 0 };
        let inner = Inner { slots: depths.iter().map(slot).collect(), is_closed: false };
        Self { inner: Mutex::new(inner), filled: Condvar::new() }
    }

    /// Puts an item into `slot`; if that is full, its oldest item is dropped and counted.
    pub fn put(&self, slot: usize, item: T) {
        let mut inner = self.lock();
        if let Some(slot) = inner.slots.get_mut(slot) {
            if slot.items.len() >= slot.depth {
                slot.items.pop_front();
                slot.dropped += 1;
            }
            slot.items.push_back(item);
        }
        drop(inner);
        self.filled.notify_one();
    }

    /// Takes the oldest item of the first non-empty slot.
    pub fn try_take(&self) -> Option<T> {
        self.lock().take()
    }

    /// Like [`Self::try_take`], but waits for an item; `None` once the queue is closed.
    pub fn take(&self) -> Option<T> {
        let mut inner = self.lock();
        loop {
            if inner.is_closed {
                return None;
            }
            if let Some(item) = inner.take() {
                return Some(item);
            }
            inner = self.filled.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Waits for an item for at most `longest`; an error once the queue is closed and empty.
    pub fn take_within(&self, longest: Duration) -> Result<Option<T>, Closed> {
        let is_idle = |inner: &mut Inner<T>| {
            !inner.is_closed && inner.slots.iter().all(|slot| slot.items.is_empty())
        };
        let waited = self.filled.wait_timeout_while(self.lock(), longest, is_idle);
        let (mut inner, _) = waited.unwrap_or_else(PoisonError::into_inner);
        match inner.take() {
            None if inner.is_closed => Err(Closed),
            item => Ok(item),
        }
    }

    /// Closes the queue and ends every wait.
    pub fn close(&self) {
        self.lock().is_closed = true;
        self.filled.notify_all();
    }

    /// Number of items dropped from `slot`.
    pub fn dropped(&self, slot: usize) -> u64 {
        self.lock().slots.get(slot).map_or(0, |slot| slot.dropped)
    }

    fn lock(&self) -> MutexGuard<'_, Inner<T>> {
        // Every change is complete when the lock is released.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Inner<T> {
    fn take(&mut self) -> Option<T> {
        self.slots.iter_mut().find_map(|slot| slot.items.pop_front())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_slot_drops_its_oldest_item_and_the_first_slot_has_priority() {
        let slots = Slots::new(&[2, 1]);
        (0..5).for_each(|item| slots.put(0, item));
        slots.put(1, 10);
        slots.put(1, 11);
        let taken: Vec<i32> = std::iter::from_fn(|| slots.try_take()).collect();
        assert_eq!(taken, [3, 4, 11]);
        assert_eq!([slots.dropped(0), slots.dropped(1)], [3, 1]);
    }

    #[test]
    fn closing_ends_the_wait() {
        let slots = Slots::<()>::new(&[1]);
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| slots.take());
            slots.close();
            assert_eq!(waiting.join().unwrap(), None);
        });
    }
}
