//! The last health of the other processes.

use crate::service::health::ProcessState;
use crate::wire::message::HealthMessage;
use crate::wire::port::{Hub, OpenError, ReceiveError, Subscriber};
use crate::wire::topic::Topic;

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

    /// Whether frames can be sent to it.
    pub fn is_ready(&self) -> bool {
        matches!(
            self.state(),
            Some(ProcessState::Ready | ProcessState::Running | ProcessState::Stale)
        )
    }
}
