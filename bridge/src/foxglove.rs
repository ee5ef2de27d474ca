//! The Foxglove WebSocket protocol, version 1, for one client: the topics live, as ROS 2 messages in CDR.
//! Foxglove, Lichtblick and other programs that speak the protocol show them without an adapter.
//!
//! The server accepts a connection with one of [`SUBPROTOCOLS`] and calls [`serve`] on the client's thread.

pub mod protocol;
mod subscriptions;

use std::io::ErrorKind;
use std::net::TcpStream;
use std::sync::Arc;
use std::time::Duration;

use semidense::slam::keyframe::Keyframe;
use tungstenite::{Error, Message, WebSocket};

use crate::feed::FeedEnded;
use crate::foxglove::protocol::{
    Request, Subscription, advertisement, message_frame, parse_request, server_info, warning,
};
use crate::foxglove::subscriptions::Subscriptions;
use crate::ros::encoder::{EncodeError, Encoded, EventEncoder, Moment, Sink};
use crate::ros::images::ImageFormat;
use crate::ros::topic::{
    CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTICS, FRAME_RECORDS, GRAPH_RECORDS, KEYFRAME_RECORDS,
    KEYFRAMES, ODOMETRY, POINTS, POSE, POSE_RECORDS, RosTopic, TF,
};
use crate::session::{Event, Graph};

/// Names of the protocol in the handshake, old and new; treated alike here.
pub const SUBPROTOCOLS: [&str; 2] = ["foxglove.websocket.v1", "foxglove.sdk.v1"];

/// The topics offered; the index of a topic is the number of its channel.
static OFFERED: [&RosTopic; 12] = [
    &POSE,
    &ODOMETRY,
    &TF,
    &POINTS,
    &COMPRESSED_IMAGE,
    &CAMERA_INFO,
    &KEYFRAMES,
    &DIAGNOSTICS,
    &FRAME_RECORDS,
    &POSE_RECORDS,
    &KEYFRAME_RECORDS,
    &GRAPH_RECORDS,
];

/// How often the client's messages are read while no event arrives.
const LISTEN_PERIOD: Duration = Duration::from_millis(20);
/// Upper limit for the time that sending one message may take: a slower client is dropped.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// Upper limit for a message from a client: it only names channels.
const MAX_REQUEST_BYTES: usize = 64 << 10;

/// Why serving a client ended.
#[derive(Debug, thiserror::Error)]
pub enum FoxgloveError {
    /// The connection failed.
    #[error("the connection of a Foxglove client failed: {0}")]
    Socket(#[from] Box<Error>),
    /// A system call failed.
    #[error("the connection of a Foxglove client failed: {0}")]
    System(#[from] std::io::Error),
    /// A message could not be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
}

/// Serves one client until it disconnects or the feed ends. `next` waits for an event, as
/// [`Listener::next`](crate::feed::Listener::next) does.
pub fn serve(
    mut socket: WebSocket<TcpStream>,
    instance: &str,
    next: impl Fn(Duration) -> Result<Option<Event>, FeedEnded>,
) -> Result<(), FoxgloveError> {
    socket.get_ref().set_nodelay(true)?;
    socket.get_ref().set_write_timeout(Some(WRITE_TIMEOUT))?;
    socket.set_config(|config| {
        config.max_message_size = Some(MAX_REQUEST_BYTES);
        config.max_frame_size = Some(MAX_REQUEST_BYTES);
    });
    let mut client = Client {
        socket,
        subscriptions: Subscriptions::new(OFFERED.len()),
        encoder: EventEncoder::new(instance, ImageFormat::Jpeg),
        keyframe: None,
        graph: None,
    };
    let started = Moment::now().realtime_nanos;
    client.send(Message::text(server_info(instance, started)))?;
    client.send(Message::text(advertisement(&OFFERED, instance)))?;
    let outcome = client.run(next);
    match outcome {
        Err(FoxgloveError::Socket(error)) if is_goodbye(&error) => Ok(()),
        other => other,
    }
}

/// Whether the error is only the client's disconnecting.
fn is_goodbye(error: &Error) -> bool {
    match error {
        Error::ConnectionClosed | Error::AlreadyClosed => true,
        Error::Protocol(error) => {
            matches!(error, tungstenite::error::ProtocolError::ResetWithoutClosingHandshake)
        }
        Error::Io(error) => {
            matches!(error.kind(), ErrorKind::ConnectionReset | ErrorKind::BrokenPipe)
        }
        _ => false,
    }
}

/// A connected client.
struct Client {
    socket: WebSocket<TcpStream>,
    subscriptions: Subscriptions,
    encoder: EventEncoder,
    /// The last rare events, for channels subscribed to later.
    keyframe: Option<Arc<Keyframe>>,
    graph: Option<Arc<Graph>>,
}

/// A client as a message sink.
struct ClientSink<'a> {
    socket: &'a mut WebSocket<TcpStream>,
    subscriptions: &'a Subscriptions,
    /// The only channel to send on, if just one.
    only: Option<usize>,
}

/// The channel number of a topic.
fn channel(topic: &RosTopic) -> Option<usize> {
    OFFERED.iter().position(|offered| offered.name == topic.name)
}

impl Sink for ClientSink<'_> {
    type Error = FoxgloveError;

    fn wants(&self, topic: &'static RosTopic) -> bool {
        channel(topic).is_some_and(|channel| {
            self.only.is_none_or(|only| only == channel) && self.subscriptions.has(channel)
        })
    }

    fn put(&mut self, message: Encoded<'_>) -> Result<(), FoxgloveError> {
        let Some(channel) = channel(message.topic) else { return Ok(()) };
        for subscription in self.subscriptions.of(channel) {
            let frame = message_frame(subscription, message.read_nanos, message.bytes);
            self.socket.send(Message::binary(frame)).map_err(Box::new)?;
        }
        Ok(())
    }
}

impl Client {
    fn send(&mut self, message: Message) -> Result<(), FoxgloveError> {
        Ok(self.socket.send(message).map_err(Box::new)?)
    }

    fn run(
        &mut self,
        next: impl Fn(Duration) -> Result<Option<Event>, FeedEnded>,
    ) -> Result<(), FoxgloveError> {
        loop {
            match next(LISTEN_PERIOD) {
                Ok(Some(event)) => self.put(&event)?,
                Ok(None) => {}
                Err(FeedEnded) => {
                    self.socket.close(None).map_err(Box::new)?;
                    return Ok(self.socket.flush().map_err(Box::new)?);
                }
            }
            while let Some(message) = self.listen()? {
                if let Message::Text(text) = message {
                    self.answer(&text)?;
                }
            }
        }
    }

    /// The next message of the client; `None` if there is none now.
    fn listen(&mut self) -> Result<Option<Message>, FoxgloveError> {
        self.socket.get_ref().set_nonblocking(true)?;
        let read = self.socket.read();
        self.socket.get_ref().set_nonblocking(false)?;
        match read {
            Ok(message) => Ok(Some(message)),
            Err(Error::Io(error)) if error.kind() == ErrorKind::WouldBlock => Ok(None),
            Err(error) => Err(Box::new(error).into()),
        }
    }

    fn put(&mut self, event: &Event) -> Result<(), FoxgloveError> {
        match event {
            Event::Keyframe(keyframe) => self.keyframe = Some(Arc::clone(keyframe)),
            Event::Graph(graph) => self.graph = Some(Arc::clone(graph)),
            Event::Joined => (self.keyframe, self.graph) = (None, None),
            _ => {}
        }
        let (socket, subscriptions) = (&mut self.socket, &self.subscriptions);
        let mut sink = ClientSink { socket, subscriptions, only: None };
        self.encoder.put(event, Moment::now(), &mut sink)
    }

    /// Executes a request of the client; failures are reported to it.
    fn answer(&mut self, text: &str) -> Result<(), FoxgloveError> {
        match parse_request(text) {
            Ok(Request::Subscribe { subscriptions }) => {
                for Subscription { id, channel_id } in subscriptions {
                    match self.subscriptions.add(id, channel_id) {
                        Ok(channel) => self.send_last(channel)?,
                        Err(problem) => self.send(Message::text(warning(&problem)))?,
                    }
                }
                Ok(())
            }
            Ok(Request::Unsubscribe { subscription_ids }) => {
                subscription_ids.iter().for_each(|id| self.subscriptions.remove(*id));
                Ok(())
            }
            Ok(Request::Other) => Ok(()),
            Err(problem) => self.send(Message::text(warning(&problem))),
        }
    }

    /// Sends the last keyframe and graph on a newly subscribed channel.
    fn send_last(&mut self, channel: usize) -> Result<(), FoxgloveError> {
        let (socket, subscriptions) = (&mut self.socket, &self.subscriptions);
        let mut sink = ClientSink { socket, subscriptions, only: Some(channel) };
        let (keyframe, graph) = (self.keyframe.as_deref(), self.graph.as_deref());
        self.encoder.put_last(keyframe, graph, &mut sink)
    }
}
