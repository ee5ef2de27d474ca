//! The last health of the other processes.

use crate::service::health::ProcessState;
use crate::wire::message::HealthMessage;
use crate::wire::port::{Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::Topic;

/// Cause that a process reports when its frames have stopped.
const SILENCE: &str = "no frames arrive: check capture";
/// The same where capture has sent its last frame.
const END_OF_FRAMES: &str = "capture has finished";

/// Another process as seen through its health topic.
#[derive(Debug)]
pub struct Peer {
    topic: Topic,
    subscriber: Subscriber<HealthMessage, ()>,
    last: Option<HealthMessage>,
}

impl Peer {
    /// Subscribes to `topic`; the last message published is received too.
    pub fn open(hub: &Hub, topic: &Topic) -> Result<Self, OpenError> {
        Ok(Self { topic: *topic, subscriber: hub.subscriber(topic)?, last: None })
    }

    /// Name of the process.
    pub fn name(&self) -> &'static str {
        self.topic.owner
    }

    /// Takes in what has arrived and returns the last message.
    pub fn update(&mut self) -> Result<Option<&HealthMessage>, ReceiveError> {
        while let Some(message) = self.subscriber.receive()? {
            self.last = message.payload().first().copied().or(self.last);
        }
        Ok(self.last.as_ref())
    }

    /// The last message.
    pub fn last(&self) -> Option<&HealthMessage> {
        self.last.as_ref()
    }

    /// Forgets it, as the process was restarted.
    pub fn forget(&mut self) {
        self.last = None;
    }

    /// Its state in the last message.
    pub fn state(&self) -> Option<ProcessState> {
        ProcessState::from_code(self.last.as_ref()?.state)
    }

    /// State and cause of a process whose frames from this one have stopped: after an orderly end none is missing.
    pub fn state_in_silence(&mut self) -> Result<(ProcessState, &'static str), ReceiveError> {
        self.update()?;
        Ok(match self.state() {
            Some(ProcessState::Finished) => (ProcessState::Running, END_OF_FRAMES),
            _ => (ProcessState::Stale, SILENCE),
        })
    }

    /// Whether frames can be sent to it.
    pub fn is_ready(&self) -> bool {
        matches!(
            self.state(),
            Some(ProcessState::Ready | ProcessState::Running | ProcessState::Stale)
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::health::Health;
    use crate::wire::place::Place;
    use crate::wire::port::Access;
    use crate::wire::topic::CAPTURE_HEALTH;

    #[test]
    fn silence_after_the_end_of_capture_is_not_stale() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
        let hub = Hub::join(&place, "tracker", Access::Member).unwrap();
        let mut capture = Peer::open(&hub, &CAPTURE_HEALTH).unwrap();
        let mut state = || capture.state_in_silence().unwrap();
        assert_eq!(state(), (ProcessState::Stale, SILENCE));
        let mut health = Health::open(&hub, &CAPTURE_HEALTH).unwrap();
        health.enter(ProcessState::Running, "");
        assert_eq!(state(), (ProcessState::Stale, SILENCE));
        health.enter(ProcessState::Finished, "the source has ended");
        // It outlives the process.
        drop(health);
        assert_eq!(state(), (ProcessState::Running, END_OF_FRAMES));
        let _next = Health::open(&hub, &CAPTURE_HEALTH).unwrap();
        assert_eq!(state(), (ProcessState::Stale, SILENCE));
    }
}
