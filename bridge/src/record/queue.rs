//! A queue of events that never delays its producer: its capacity is in bytes, and what does not fit is
//! dropped and counted.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};

use semidense::slam::keyframe::DepthPoint;

use crate::ros::encoder::Moment;
use crate::session::Event;

/// Capacity in events: those other than images are small and arrive a few hundred times a second.
const MAX_EVENTS: usize = 4096;

/// Counters of a queue.
#[derive(Debug, Default)]
pub struct QueueCounts {
    /// Bytes in the queue.
    pub bytes: AtomicU64,
    /// Dropped images.
    pub dropped_images: AtomicU64,
    /// Other dropped messages.
    pub dropped_messages: AtomicU64,
}

impl QueueCounts {
    /// All dropped messages.
    pub fn dropped(&self) -> u64 {
        self.dropped_images.load(Ordering::Relaxed) + self.dropped_messages.load(Ordering::Relaxed)
    }
}

/// An event and the time it was read.
pub type Stamped = (Moment, Event);

/// The producer's end.
#[derive(Debug)]
pub struct QueueSender {
    sender: SyncSender<Stamped>,
    /// Counters of the queue.
    pub counts: Arc<QueueCounts>,
    capacity_bytes: u64,
}

/// The consumer's end.
#[derive(Debug)]
pub struct QueueReceiver {
    receiver: Receiver<Stamped>,
    /// Counters of the queue.
    pub counts: Arc<QueueCounts>,
}

/// Creates a queue with room for `capacity_bytes`.
pub fn queue(capacity_bytes: u64) -> (QueueSender, QueueReceiver) {
    let (sender, receiver) = sync_channel(MAX_EVENTS);
    let counts = Arc::new(QueueCounts::default());
    let sender = QueueSender { sender, counts: Arc::clone(&counts), capacity_bytes };
    (sender, QueueReceiver { receiver, counts })
}

/// Memory held by an event.
fn bytes_of(event: &Event) -> u64 {
    let bytes = match event {
        Event::Frame(frame) => frame.pixels.len(),
        Event::Keyframe(keyframe) => {
            keyframe.image.len() + keyframe.points.len() * size_of::<DepthPoint>()
        }
        Event::Graph(graph) => size_of_val(&graph.poses[..]),
        // A message of one or two kilobytes.
        Event::Pose(_) | Event::Health(..) => 2048,
        Event::Joined | Event::Left | Event::Adjustment(_) => 0,
    };
    bytes as u64
}

impl QueueSender {
    /// Puts an event in, or drops and counts it. False once the receiver is gone.
    pub fn put(&self, moment: Moment, event: Event) -> bool {
        let bytes = bytes_of(&event);
        let is_image = matches!(event, Event::Frame(_));
        let drop_one = || {
            let dropped =
                if is_image { &self.counts.dropped_images } else { &self.counts.dropped_messages };
            dropped.fetch_add(1, Ordering::Relaxed);
            true
        };
        if self.counts.bytes.load(Ordering::Relaxed) + bytes > self.capacity_bytes {
            return drop_one();
        }
        // Counted first: it may be taken out before the next line.
        self.counts.bytes.fetch_add(bytes, Ordering::Relaxed);
        match self.sender.try_send((moment, event)) {
            Ok(()) => true,
            Err(error) => {
                self.counts.bytes.fetch_sub(bytes, Ordering::Relaxed);
                match error {
                    TrySendError::Full(_) => drop_one(),
                    TrySendError::Disconnected(_) => false,
                }
            }
        }
    }
}

impl QueueReceiver {
    /// The next event; `None` once the queue is empty and the sender is gone.
    pub fn take(&self) -> Option<Stamped> {
        let (moment, event) = self.receiver.recv().ok()?;
        self.counts.bytes.fetch_sub(bytes_of(&event), Ordering::Relaxed);
        Some((moment, event))
    }
}
