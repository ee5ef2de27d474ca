//! One thread that reads an instance's topics for any number of clients.
//!
//! Each [`Listener`] has a bounded channel: a slow one loses events, which are counted, and delays neither
//! the reading nor the other listeners. A late listener first receives the newest event of each kind.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use semidense::wire::place::Place;

use crate::session::{Event, Session, SessionError, Wants};

/// Upper limit for the delay until a change of listeners or the end of the feed is noticed while no message arrives.
const WAKE_PERIOD: Duration = Duration::from_millis(100);
/// Default capacity of a listener in events: two seconds of poses at 30 Hz.
pub const USUAL_DEPTH: usize = 64;

/// Why a feed cannot be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot start the thread that reads the topics ({0})")]
pub struct FeedError(#[from] std::io::Error);

/// Reads the topics until it is dropped.
#[derive(Debug)]
pub struct Feed {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Feed {
    /// Starts reading `wants` of the instance at `place`, whenever it runs, under the process name `name`.
    pub fn start(place: Place, name: &str, wants: Wants) -> Result<Self, FeedError> {
        let shared = Arc::<Shared>::default();
        let (theirs, name) = (Arc::clone(&shared), name.to_owned());
        let thread = std::thread::Builder::new()
            .name("feed".to_owned())
            .spawn(move || read(Session::new(place, &name, wants), &theirs))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Adds a listener with room for `depth` events, usually [`USUAL_DEPTH`].
    pub fn listen(&self, depth: usize) -> Listener {
        self.shared.lock().listen(depth)
    }

    /// Why reading has ended; `None` while it continues.
    pub fn failure(&self) -> Option<String> {
        self.shared.lock().failure.clone()
    }

    /// Events lost by all listeners together since the start.
    pub fn lost(&self) -> u64 {
        self.shared.lock().lost
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.shared.is_over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The receiving end of one client.
#[derive(Debug)]
pub struct Listener {
    events: Receiver<Event>,
    lost: Arc<AtomicU64>,
}

impl Listener {
    /// The next event; `None` if none arrives within `timeout`, an error once the feed is over.
    pub fn next(&self, timeout: Duration) -> Result<Option<Event>, FeedEnded> {
        match self.events.recv_timeout(timeout) {
            Ok(event) => Ok(Some(event)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(FeedEnded),
        }
    }

    /// Events lost because this listener was slow.
    pub fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

/// The feed has ended: see [`Feed::failure`].
#[derive(Debug, thiserror::Error)]
#[error("the topics are no longer read")]
pub struct FeedEnded;

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    is_over: AtomicBool,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn read(mut session: Session, shared: &Shared) {
    while !shared.is_over.load(Ordering::Relaxed) {
        let outcome = session.read(None, WAKE_PERIOD, |event| shared.lock().deliver(&event));
        if let Err(error @ (SessionError::Open(_) | SessionError::Wait(_))) = outcome {
            shared.lock().failure = Some(error.to_string());
            break;
        }
    }
    // Tells the listeners that the feed is over.
    shared.lock().outlets.clear();
}

#[derive(Debug, Default)]
struct State {
    outlets: Vec<Outlet>,
    recent: Recent,
    lost: u64,
    failure: Option<String>,
}

impl State {
    fn deliver(&mut self, event: &Event) {
        self.recent.keep(event);
        let before: u64 = self.outlets.iter().map(Outlet::lost).sum();
        self.outlets.retain_mut(|outlet| outlet.deliver(event));
        self.lost += self.outlets.iter().map(Outlet::lost).sum::<u64>().saturating_sub(before);
    }

    fn listen(&mut self, depth: usize) -> Listener {
        let recent = &self.recent.0;
        let (sender, events) = sync_channel(depth.max(recent.len()));
        let lost = Arc::<AtomicU64>::default();
        let mut outlet = Outlet { sender, lost: Arc::clone(&lost), owed: None };
        if self.failure.is_none() {
            for event in recent.values() {
                outlet.deliver(event);
            }
            self.outlets.push(outlet);
        }
        Listener { events, lost }
    }
}

/// The sending end of one listener's queue.
#[derive(Debug)]
struct Outlet {
    sender: SyncSender<Event>,
    lost: Arc<AtomicU64>,
    /// A start or end of a run for which there was no room: later events cannot be understood without it.
    owed: Option<Event>,
}

impl Outlet {
    fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }

    /// Offers the event to the listener; returns whether that still exists.
    fn deliver(&mut self, event: &Event) -> bool {
        if let Some(owed) = self.owed.take()
            && let Err(error) = self.sender.try_send(owed)
        {
            let TrySendError::Full(owed) = error else { return false };
            self.owed = Some(owed);
        }
        let outcome = match self.owed {
            Some(_) => Err(TrySendError::Full(event.clone())),
            None => self.sender.try_send(event.clone()),
        };
        match outcome {
            Ok(()) => true,
            Err(TrySendError::Disconnected(_)) => false,
            Err(TrySendError::Full(event)) => {
                self.lost.fetch_add(1, Ordering::Relaxed);
                if matches!(event, Event::Joined | Event::Left) {
                    self.owed = Some(event);
                }
                true
            }
        }
    }
}

/// The newest event of each kind for late listeners, in the order of delivery.
#[derive(Debug, Default)]
struct Recent(BTreeMap<(u8, &'static str), Event>);

impl Recent {
    fn keep(&mut self, event: &Event) {
        if matches!(event, Event::Joined | Event::Left) {
            self.0.clear();
        }
        let place = match event {
            Event::Joined => (0, ""),
            Event::Health(process, _) => (1, *process),
            Event::Keyframe(_) => (2, ""),
            Event::Graph(_) => (3, ""),
            Event::Frame(_) => (4, ""),
            Event::Pose(_) => (5, ""),
            Event::Left | Event::Adjustment(_) => return,
        };
        self.0.insert(place, event.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use semidense::wire::message::AdjustmentMessage;

    fn adjustment() -> Event {
        Event::Adjustment(AdjustmentMessage::default())
    }

    #[test]
    fn a_slow_listener_loses_events_and_delays_nobody() {
        let mut state = State::default();
        let (slow, quick) = (state.listen(2), state.listen(8));
        state.deliver(&Event::Joined);
        (0..4).for_each(|_| state.deliver(&adjustment()));
        assert_eq!((slow.lost(), quick.lost(), state.lost), (3, 0, 3));
        assert_eq!(quick.events.try_iter().count(), 5);
    }

    #[test]
    fn the_end_of_a_run_is_never_lost() {
        let mut state = State::default();
        let slow = state.listen(1);
        state.deliver(&adjustment());
        state.deliver(&Event::Left);
        state.deliver(&adjustment());
        assert!(matches!(slow.events.try_recv(), Ok(Event::Adjustment(_))));
        state.deliver(&adjustment());
        assert!(matches!(slow.events.try_recv(), Ok(Event::Left)));
        state.deliver(&adjustment());
        assert!(matches!(slow.events.try_recv(), Ok(Event::Adjustment(_))));
    }

    #[test]
    fn a_late_listener_learns_that_the_run_exists_and_a_departed_one_is_removed() {
        let mut state = State::default();
        state.deliver(&Event::Joined);
        let late = state.listen(4);
        assert!(matches!(late.events.try_recv(), Ok(Event::Joined)));
        drop(late);
        state.deliver(&Event::Left);
        assert!(state.outlets.is_empty());
        assert!(state.listen(4).events.try_recv().is_err(), "there is no run any more");
    }
}
