//! Typed ports: send, receive, wait. Quality of service comes from the table in
//! [`crate::wire::topic`]; every data topic has a wake-up event of the same name.

mod subscribers;

use std::fmt::Debug;
use std::os::fd::{AsFd, BorrowedFd};
use std::path::Path;
use std::time::Duration;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher as RawPublisher;
use iceoryx2::port::subscriber::{Subscriber as RawSubscriber, SubscriberCreateError};
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::builder::event::EventOpenError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::event::PortFactory as EventFactory;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory as DataFactory;
use rustix::event::{PollFd, PollFlags, Timespec};

use crate::wire::folders::SHARED_MEMORY;
use crate::wire::limits::raise_open_files;
pub use crate::wire::open_error::OpenError;
use crate::wire::open_error::{explain, not_running, topic_error};
use crate::wire::place::Place;
use crate::wire::port::subscribers::too_many;
use crate::wire::shared_memory::reserve;
use crate::wire::topic::Topic;
use crate::wire::version::foreign_version;

/// Nodes that may open one service: our processes, observers, and dead nodes until they are cleaned up.
const MAX_NODES: usize = 40;
/// Listeners and notifiers of one event: enough for every subscriber of the topic.
const MAX_EVENT_PORTS: usize = 16;
/// Publishers of one topic: the owner, its successor until the dead owner is cleaned up, a network link.
const MAX_PUBLISHERS: usize = 3;
/// Maximum number of events and interrupts in one wait.
const MAX_WAITED: usize = 8;
/// Shared memory of a process and its connections to all topics: twice that of the supervisor, which listens to most.
const JOIN_BYTES: u64 = 1 << 20;
/// Number of attempts to open a service that another process is removing.
const OPEN_ATTEMPTS: usize = 50;
/// Pause between two attempts.
const OPEN_PAUSE: Duration = Duration::from_millis(10);

/// A part of a message: its header, or an element of its payload.
pub trait Part: Debug + ZeroCopySend + 'static {}

impl<T: Debug + ZeroCopySend + 'static> Part for T {}

/// Why a message was not sent.
#[derive(Debug, thiserror::Error)]
#[error("topic {topic}: sending failed ({reason})")]
pub struct SendError {
    topic: String,
    reason: String,
}

/// Why no message was received.
#[derive(Debug, thiserror::Error)]
#[error("topic {topic}: receiving failed ({reason})")]
pub struct ReceiveError {
    topic: String,
    reason: String,
}

/// Why waiting failed.
#[derive(Debug, thiserror::Error)]
#[error("waiting for messages failed ({0})")]
pub struct WaitError(String);

/// Whether a missing topic is created.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Create it: a process of the pipeline.
    Member,
    /// Only open an existing one: an observer.
    Observer,
}

/// A process's membership in an instance; every port is created from it.
#[derive(Debug)]
pub struct Hub {
    pub(in crate::wire) node: Node<ipc::Service>,
    pub(in crate::wire) place: Place,
    pub(in crate::wire) access: Access,
}

impl Hub {
    /// Joins the instance at `place` under the name `process`. iceoryx2 is kept from logging and from handling signals;
    /// what dead processes left behind is removed.
    pub fn join(place: &Place, process: &str, access: Access) -> Result<Self, OpenError> {
        raise_open_files()?;
        if access == Access::Member {
            place.create()?;
        } else if !place.root.join("services").exists() {
            return Err(not_running(place));
        }
        set_log_level(LogLevel::Fatal);
        place.check_shared_memory(JOIN_BYTES)?;
        let _joining = place.block_tidy()?;
        place.remove_unfinished();
        let root = place.root.display().to_string();
        let failed =
            |reason: String| OpenError::Node { root: root.clone(), reason: explain(&reason) };
        let name = NodeName::new(process).map_err(|e| failed(e.to_string()))?;
        let config = place.transport_config()?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .map_err(|e| failed(e.to_string()))?;
        place.keep_to_user();
        // After creating the node, which has removed what dead processes left behind.
        if let Some(found) = foreign_version(&config, &place.instance) {
            return Err(OpenError::Version { instance: place.instance.clone(), found });
        }
        Ok(Self { node, place: place.clone(), access })
    }

    /// Removes what dead processes left behind; takes milliseconds and more, so not for a frame loop.
    pub fn clean_up(&self) {
        self.place.remove_unfinished();
        self.node.try_cleanup_dead_nodes();
    }

    /// Reserves all shared memory that the open ports have promised; an observer's subscriber does so automatically.
    pub fn reserve(&self) -> Result<(), OpenError> {
        Ok(reserve(Path::new(SHARED_MEMORY), &self.place.prefix)?)
    }

    /// Creates a publisher of slices of `T` with a header of `H`, up to `max_length` elements long.
    pub fn publisher<T: Part, H: Part>(
        &self,
        topic: &Topic,
        max_length: usize,
    ) -> Result<Publisher<T, H>, OpenError> {
        let name = topic.service_name(&self.place.instance);
        let message_bytes = size_of::<H>() + max_length * size_of::<T>();
        self.place.check_shared_memory(topic.bytes(message_bytes))?;
        let service = self.data_service::<T, H>(topic, &name)?;
        let port = service
            .publisher_builder()
            .initial_max_slice_len(max_length)
            .max_loaned_samples(topic.loans)
            .create()
            .map_err(|e| topic_error(&name, &e))?;
        Ok(Publisher { port, wake: self.notifier(&name)?, topic: name })
    }

    /// Creates a subscriber to slices of `T` with a header of `H`.
    pub fn subscriber<T: Part, H: Part>(
        &self,
        topic: &Topic,
    ) -> Result<Subscriber<T, H>, OpenError> {
        let name = topic.service_name(&self.place.instance);
        let service = self.data_service::<T, H>(topic, &name)?;
        let port = service
            .subscriber_builder()
            .buffer_size(topic.buffer)
            .history_request(topic.history)
            .create()
            .map_err(|error| match error {
                SubscriberCreateError::ExceedsMaxSupportedSubscribers => too_many(&name, &service),
                error => topic_error(&name, &error),
            })?;
        let events = self.events(&name)?;
        let subscriber = Subscriber { port, events, topic: name };
        // Connect now, so that no message sent from here on is missed.
        subscriber.connect();
        if self.access == Access::Observer {
            self.reserve()?;
        }
        Ok(subscriber)
    }

    /// Creates the listener for the wake-ups of the service `name`.
    pub(in crate::wire) fn events(&self, name: &str) -> Result<Events, OpenError> {
        let listener = self.event_service(name)?.listener_builder().create();
        Ok(Events { listener: listener.map_err(|e| topic_error(name, &e))? })
    }

    /// Creates the notifier that wakes the listeners of the service `name`.
    pub(in crate::wire) fn notifier(&self, name: &str) -> Result<Wake, OpenError> {
        let notifier = self.event_service(name)?.notifier_builder().create();
        Ok(Wake { notifier: notifier.map_err(|e| topic_error(name, &e))? })
    }

    fn data_service<T: Part, H: Part>(
        &self,
        topic: &Topic,
        name: &str,
    ) -> Result<DataFactory<ipc::Service, [T], H>, OpenError> {
        let service_name = ServiceName::new(name).map_err(|e| topic_error(name, &e))?;
        let builder = || {
            self.node
                .service_builder(&service_name)
                .publish_subscribe::<[T]>()
                .user_header::<H>()
                .enable_safe_overflow(true)
        };
        match self.access {
            // An observer makes no demands: the mirror of a network link has other sizes.
            Access::Observer => builder().open().map_err(|error| match error {
                PublishSubscribeOpenError::ExceedsMaxNumberOfNodes
                | PublishSubscribeOpenError::InsufficientPermissions
                | PublishSubscribeOpenError::IncompatibleTypes => topic_error(name, &error),
                // The service is missing, is being created or removed by its processes, or is not visible from here.
                _ => not_running(&self.place),
            }),
            Access::Member => retry(name, || {
                builder()
                    .max_publishers(MAX_PUBLISHERS)
                    .max_subscribers(topic.subscribers)
                    .max_nodes(MAX_NODES)
                    .subscriber_max_buffer_size(topic.buffer)
                    .subscriber_max_borrowed_samples(topic.borrowed)
                    .history_size(topic.history)
                    .open_or_create()
            }),
        }
    }

    fn event_service(&self, name: &str) -> Result<EventFactory<ipc::Service>, OpenError> {
        let service_name = ServiceName::new(name).map_err(|e| topic_error(name, &e))?;
        let builder = || self.node.service_builder(&service_name).event();
        match self.access {
            Access::Observer => builder().open().map_err(|error| match error {
                EventOpenError::ExceedsMaxNumberOfNodes
                | EventOpenError::InsufficientPermissions => topic_error(name, &error),
                _ => not_running(&self.place),
            }),
            // No deadline on the service: a network link could not mirror it.
            Access::Member => retry(name, || {
                builder()
                    .max_listeners(MAX_EVENT_PORTS)
                    .max_notifiers(MAX_EVENT_PORTS)
                    .max_nodes(MAX_NODES)
                    .disable_deadline()
                    .open_or_create()
            }),
        }
    }
}

/// Opens a service that another process may be removing at this moment.
pub(in crate::wire) fn retry<S, E: std::fmt::Display>(
    name: &str,
    mut open: impl FnMut() -> Result<S, E>,
) -> Result<S, OpenError> {
    let mut attempt = 1;
    loop {
        match open() {
            Ok(service) => return Ok(service),
            Err(error) if attempt == OPEN_ATTEMPTS => return Err(topic_error(name, &error)),
            Err(_) => {
                // A pause; if the wait fails, the attempts only end sooner.
                let _ = wait(&[], None, OPEN_PAUSE);
            }
        }
        attempt += 1;
    }
}

/// Sends slices of `T` with a header of `H`, and wakes the listeners.
#[derive(Debug)]
pub struct Publisher<T: Part, H: Part> {
    port: RawPublisher<ipc::Service, [T], H>,
    wake: Wake,
    topic: String,
}

impl<T: Part + Copy, H: Part + Default> Publisher<T, H> {
    /// Copies `payload` into shared memory and sends it.
    pub fn send(&self, header: H, payload: &[T]) -> Result<(), SendError> {
        let failed = |e: &dyn std::fmt::Display| self.error(e);
        let sample = self.port.loan_slice_uninit(payload.len()).map_err(|e| failed(&e))?;
        let mut sample = sample.write_from_slice(payload);
        *sample.user_header_mut() = header;
        sample.send().map_err(|e| failed(&e))?;
        self.wake.notify();
        Ok(())
    }

    /// Delivers the history to subscribers that joined late.
    pub fn serve_late_joiners(&self) {
        // A failure here recurs, and is reported, at the next send.
        let _ = self.port.update_connections();
    }

    fn error(&self, reason: &dyn std::fmt::Display) -> SendError {
        SendError { topic: self.topic.clone(), reason: reason.to_string() }
    }
}

impl<H: Part + Default> Publisher<u8, H> {
    /// Lends `length` bytes of shared memory, to be written in place.
    pub fn loan(&self, length: usize) -> Result<Loan<'_, H>, SendError> {
        let sample = self.port.loan_slice_uninit(length).map_err(|e| self.error(&e))?;
        // SAFETY: every bit pattern is a u8; the kernel or an earlier message has initialised it.
        let sample = unsafe { sample.assume_init() };
        Ok(Loan { sample, publisher: self })
    }
}

/// Bytes in shared memory that have not been sent yet; returned if dropped unsent.
#[derive(Debug)]
pub struct Loan<'a, H: Part + Default> {
    sample: SampleMut<ipc::Service, [u8], H>,
    publisher: &'a Publisher<u8, H>,
}

impl<H: Part + Default> Loan<'_, H> {
    /// The bytes.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        self.sample.payload_mut()
    }

    /// Sends the bytes.
    pub fn send(mut self, header: H) -> Result<(), SendError> {
        *self.sample.user_header_mut() = header;
        self.sample.send().map_err(|e| self.publisher.error(&e))?;
        self.publisher.wake.notify();
        Ok(())
    }
}

/// Receives slices of `T` with a header of `H`.
#[derive(Debug)]
pub struct Subscriber<T: Part, H: Part> {
    port: RawSubscriber<ipc::Service, [T], H>,
    events: Events,
    topic: String,
}

impl<T: Part, H: Part> Subscriber<T, H> {
    /// Returns the oldest unread message.
    pub fn receive(&self) -> Result<Option<Received<T, H>>, ReceiveError> {
        let sample = self.port.receive().map_err(|e| self.error(&e))?;
        Ok(sample.map(|sample| Received { sample }))
    }

    fn error(&self, reason: &dyn std::fmt::Display) -> ReceiveError {
        ReceiveError { topic: self.topic.clone(), reason: reason.to_string() }
    }

    /// Returns the newest unread message; older ones are skipped. It holds one message at a time: a subscriber may hold
    /// no more than the topic's `borrowed`, including those that it has kept.
    pub fn newest(&self) -> Result<Option<Received<T, H>>, ReceiveError> {
        let mut newest = self.receive()?;
        while newest.is_some() && self.has_unread()? {
            drop(newest);
            newest = self.receive()?;
        }
        Ok(newest)
    }

    /// Whether there is an unread message.
    pub fn has_unread(&self) -> Result<bool, ReceiveError> {
        self.port.has_samples().map_err(|e| self.error(&e))
    }

    /// Events that wake the subscriber, for [`wait`].
    pub fn events(&self) -> &Events {
        &self.events
    }

    fn connect(&self) {
        // A failure here recurs, and is reported, at the first receive.
        let _ = self.port.update_connections();
    }
}

/// A message in shared memory; its slot is free again when this is dropped.
#[derive(Debug)]
pub struct Received<T: Part, H: Part> {
    sample: Sample<ipc::Service, [T], H>,
}

impl<T: Part, H: Part> Received<T, H> {
    /// Its header.
    pub fn header(&self) -> &H {
        self.sample.user_header()
    }

    /// Its payload.
    pub fn payload(&self) -> &[T] {
        self.sample.payload()
    }
}

/// The wake-ups of one topic.
#[derive(Debug)]
pub struct Events {
    listener: Listener<ipc::Service>,
}

impl Events {
    /// Consumes the wake-ups; returns whether there were any.
    pub fn take(&self) -> bool {
        let mut has_woken = false;
        // What cannot be read is read with the next wake-up.
        let _ = self.listener.try_wait(|_| has_woken = true);
        has_woken
    }
}

/// Readable while a wake-up is unread, for the caller's own poll; [`wait`] consumes the wake-ups.
impl AsFd for Events {
    fn as_fd(&self) -> BorrowedFd<'_> {
        // SAFETY: the descriptor is the listener's and lives as long as it.
        unsafe { BorrowedFd::borrow_raw(self.listener.file_descriptor().native_handle()) }
    }
}

/// Wakes the listeners of a topic.
#[derive(Debug)]
pub(in crate::wire) struct Wake {
    notifier: Notifier<ipc::Service>,
}

impl Wake {
    pub(in crate::wire) fn notify(&self) {
        // A listener that died is no reason to stop sending.
        let _ = self.notifier.notify();
    }
}

/// Waits until one of `events` wakes, one of `interrupts` is readable, or `timeout` has passed. It may also return
/// early: the caller checks its ports and its clock.
pub fn wait<'a>(
    events: &[&'a Events],
    interrupts: impl IntoIterator<Item = BorrowedFd<'a>>,
    timeout: Duration,
) -> Result<(), WaitError> {
    let timeout =
        Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
    let mut descriptors = events.iter().map(|&e| e.as_fd()).chain(interrupts);
    let polled = match descriptors.next() {
        None => rustix::event::poll(&mut [], Some(&timeout)),
        // An array: a frame loop that waits must not allocate.
        Some(first) => {
            let entry = |descriptor| PollFd::from_borrowed_fd(descriptor, PollFlags::IN);
            let mut polled: [_; MAX_WAITED] = std::array::from_fn(|_| entry(first));
            let mut count = 1;
            for descriptor in descriptors {
                let place = polled
                    .get_mut(count)
                    .ok_or_else(|| WaitError(format!("more than {MAX_WAITED} at a time")))?;
                *place = entry(descriptor);
                count += 1;
            }
            rustix::event::poll(&mut polled[..count], Some(&timeout))
        }
    };
    match polled {
        Ok(_) | Err(rustix::io::Errno::INTR) => {}
        Err(e) => return Err(WaitError(e.to_string())),
    }
    // The number of wake-ups does not matter: messages are counted separately.
    for event in events {
        event.take();
    }
    Ok(())
}

#[cfg(test)]
mod tests;
