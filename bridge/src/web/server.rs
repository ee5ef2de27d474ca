//! One port for the page, its stream, `/metrics` and Foxglove: each connection has a thread, and there are few of them.

use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use tungstenite::WebSocket;
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::{Role, WebSocketConfig};

use crate::feed::{Feed, USUAL_DEPTH};
use crate::foxglove::{self, SUBPROTOCOLS};
use crate::web::guard::{COOKIE, Guard, Refusal};
use crate::web::http::{Answer, Head, HeadError, read_head};
use crate::web::metrics::{CONTENT_TYPE, metrics};
use crate::web::saving::Saver;
use crate::web::scene::Scene;
use crate::web::stream::{StreamOptions, serve as serve_stream};

/// Connections at a time, those that only ask for a file included.
const MAX_CONNECTIONS: usize = 64;
/// Pages with a live stream at a time: each may take 5 MB/s.
const MAX_PAGES: usize = 8;
/// Longest time that a file may take to be taken.
const LONGEST_ANSWER: Duration = Duration::from_secs(30);
/// Largest message that a page or Foxglove may send, bytes: what they say is some hundred.
const MAX_MESSAGE_BYTES: usize = 64 << 10;
/// Pause after a connection that could not be taken: too many files are open.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Clients of Foxglove's protocol at a time: each has its own messages encoded.
const MAX_FOXGLOVE: usize = 8;

/// The files of the page, in the program itself.
const FILES: [(&str, &str, &str); 7] = [
    ("/", "text/html; charset=utf-8", include_str!("assets/index.html")),
    ("/page.css", "text/css; charset=utf-8", include_str!("assets/page.css")),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("assets/page.js")),
    ("/overlay.js", "text/javascript; charset=utf-8", include_str!("assets/overlay.js")),
    ("/charts.js", "text/javascript; charset=utf-8", include_str!("assets/charts.js")),
    (
        "/player.js",
        "text/javascript; charset=utf-8",
        semidense::service::results::report::scene::PLAYER,
    ),
    (
        "/viewer.js",
        "text/javascript; charset=utf-8",
        semidense::service::results::report::scene::VIEWER,
    ),
];

/// What is shown.
#[derive(Debug)]
pub enum Shown {
    /// What runs.
    Live {
        /// The topics.
        feed: Feed,
        /// What pages show of them.
        scene: Arc<Scene>,
        /// How a page is served.
        stream: StreamOptions,
        /// Saves the map.
        saver: Saver,
    },
    /// A run that is over, packed for the page, its folder and its summary.
    Finished(Vec<u8>, PathBuf, serde_json::Value),
}

/// Why the server does not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The port is taken, or the address is not of this machine.
    #[error("cannot listen on {address}: {source}; choose another one with --listen ADDRESS:PORT")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// What the system says.
        source: io::Error,
    },
    /// No thread can be started.
    #[error("cannot start a thread ({0})")]
    Thread(#[from] io::Error),
}

/// The server.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    guard: Guard,
    shown: Shown,
    connections: AtomicUsize,
    foxglove_clients: AtomicUsize,
    is_over: AtomicBool,
}

impl Server {
    /// Listens on an address; port 0 takes any that is free.
    pub fn open(address: SocketAddr, guard: Guard, shown: Shown) -> Result<Arc<Self>, ServerError> {
        let failed = |source| ServerError::Listen { address, source };
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Arc::new(Self {
            listener,
            address,
            guard,
            shown,
            connections: AtomicUsize::new(0),
            foxglove_clients: AtomicUsize::new(0),
            is_over: AtomicBool::new(false),
        }))
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What is shown.
    pub fn shown(&self) -> &Shown {
        &self.shown
    }

    /// Becomes true when everything shall end.
    pub fn is_over(&self) -> &AtomicBool {
        &self.is_over
    }

    /// Takes connections on a thread of its own, for as long as the process lives.
    pub fn start(self: &Arc<Self>) -> Result<(), ServerError> {
        let server = Arc::clone(self);
        std::thread::Builder::new().name("accept".to_owned()).spawn(move || {
            loop {
                match server.listener.accept() {
                    Ok((stream, _)) => server.take(stream),
                    Err(error) => {
                        tracing::warn!("a connection cannot be taken ({error})");
                        std::thread::sleep(ACCEPT_PAUSE);
                    }
                }
            }
        })?;
        Ok(())
    }

    fn take(self: &Arc<Self>, mut stream: TcpStream) {
        let _ = stream.set_write_timeout(Some(LONGEST_ANSWER));
        let server = Arc::clone(self);
        let Some(connection) = Connection::count(server) else {
            let _ = Answer::refusal("503 Service Unavailable", "too many connections\n")
                .send(&mut stream, false);
            return;
        };
        let thread = std::thread::Builder::new().name("client".to_owned());
        // A thread that cannot be started drops the connection.
        let _ = thread.spawn(move || connection.0.answer(stream));
    }

    fn answer(&self, mut stream: TcpStream) {
        let outcome = match read_head(&mut stream) {
            Ok(Some(head)) => self.answer_head(stream, head),
            Ok(None) | Err(HeadError::Connection(_)) => Ok(()),
            Err(error) => {
                let status = match error {
                    HeadError::TooLong => "431 Request Header Fields Too Large",
                    HeadError::Late => "408 Request Timeout",
                    HeadError::Malformed(_) | HeadError::Connection(_) => "400 Bad Request",
                };
                Answer::refusal(status, &format!("{error}\n")).send(&mut stream, false)
            }
        };
        if let Err(error) = outcome {
            tracing::debug!("a client is gone: {error}");
        }
    }

    fn answer_head(&self, mut stream: TcpStream, head: Head) -> io::Result<()> {
        if let Err(refusal) = self.guard.check(&head) {
            let status = match refusal {
                Refusal::Host => "421 Misdirected Request",
                Refusal::Origin => "403 Forbidden",
                Refusal::Token => "401 Unauthorized",
            };
            return Answer::refusal(status, &format!("{refusal}\n")).send(&mut stream, false);
        }
        match (head.method.as_str(), head.path.as_str()) {
            ("GET", _) if head.is_upgrade() => self.upgrade(stream, head),
            ("POST", "/api/save") => self.save(&mut stream),
            ("GET" | "HEAD", path) => self.file(&mut stream, &head, path),
            _ => Answer::refusal("405 Method Not Allowed", "only GET, HEAD, and POST /api/save\n")
                .send(&mut stream, false),
        }
    }

    fn file(&self, stream: &mut TcpStream, head: &Head, path: &str) -> io::Result<()> {
        let is_head_only = head.method == "HEAD";
        match (path, &self.shown) {
            ("/metrics", Shown::Live { feed, scene, stream: options, .. }) => {
                let text = metrics(&scene.lock(), &options.instance, scene.pages(), feed.lost());
                return Answer::ok(CONTENT_TYPE, text.as_bytes()).send(stream, is_head_only);
            }
            ("/api/run", Shown::Finished(block, ..)) => {
                return Answer::ok("application/octet-stream", block).send(stream, is_head_only);
            }
            ("/api/mode", shown) => {
                let mode = match shown {
                    Shown::Live { .. } => serde_json::json!({ "mode": "live" }),
                    Shown::Finished(_, folder, summary) => {
                        serde_json::json!({ "mode": "finished", "folder": folder, "summary": summary })
                    }
                };
                return Answer::ok("application/json", mode.to_string().as_bytes())
                    .send(stream, is_head_only);
            }
            _ => {}
        }
        let Some((_, content_type, text)) = FILES.iter().find(|(name, ..)| *name == path) else {
            return Answer::refusal(
                "404 Not Found",
                "there is no such page: / is the page, /metrics for Prometheus\n",
            )
            .send(stream, is_head_only);
        };
        let mut answer = Answer::ok(content_type, text.as_bytes());
        if let (Some(token), true) = (&self.guard.token, path == "/") {
            // So that the page's own requests need no token in their address.
            answer.headers =
                format!("Set-Cookie: {COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict\r\n");
        }
        answer.send(stream, is_head_only)
    }

    fn save(&self, stream: &mut TcpStream) -> io::Result<()> {
        let Shown::Live { saver, .. } = &self.shown else {
            return Answer::refusal("409 Conflict", "this run is over: its map is in its folder\n")
                .send(stream, false);
        };
        match saver.save() {
            Ok(folder) => {
                let text = serde_json::json!({ "folder": folder }).to_string();
                Answer::ok("application/json", text.as_bytes()).send(stream, false)
            }
            Err(error) => {
                Answer::refusal("409 Conflict", &format!("{error}\n")).send(stream, false)
            }
        }
    }

    /// A WebSocket: Foxglove's, which names a subprotocol, or the page's.
    fn upgrade(&self, mut stream: TcpStream, head: Head) -> io::Result<()> {
        let wanted = |name: &&str| head.lists("sec-websocket-protocol", name);
        if let Some(protocol) = SUBPROTOCOLS.into_iter().find(wanted) {
            return self.foxglove(stream, head, protocol);
        }
        let Shown::Live { scene, stream: options, .. } = &self.shown else {
            return Answer::refusal("404 Not Found", "this run is over: there is no stream\n")
                .send(&mut stream, false);
        };
        if head.path != "/stream" {
            return Answer::refusal("404 Not Found", "the stream is /stream\n")
                .send(&mut stream, false);
        }
        let Some(_page) = scene.open_page(MAX_PAGES) else {
            let text = format!("{MAX_PAGES} pages are open already: close one\n");
            return Answer::refusal("503 Service Unavailable", &text).send(&mut stream, false);
        };
        let socket = accept(stream, head, None)?;
        serve_stream(socket, scene, options, &self.is_over).map_err(io::Error::other)
    }

    fn foxglove(&self, mut stream: TcpStream, head: Head, protocol: &str) -> io::Result<()> {
        let Shown::Live { feed, stream: options, .. } = &self.shown else {
            return Answer::refusal("404 Not Found", "this run is over: nothing is sent\n")
                .send(&mut stream, false);
        };
        let more = |n: usize| (n < MAX_FOXGLOVE).then_some(n + 1);
        let clients = &self.foxglove_clients;
        if clients.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).is_err() {
            let text = format!("{MAX_FOXGLOVE} clients are served already: close one\n");
            return Answer::refusal("503 Service Unavailable", &text).send(&mut stream, false);
        }
        let outcome = accept(stream, head, Some(protocol)).and_then(|socket| {
            let listener = feed.listen(USUAL_DEPTH);
            foxglove::serve(socket, &options.instance, |timeout| listener.next(timeout))
                .map_err(io::Error::other)
        });
        clients.fetch_sub(1, Ordering::Relaxed);
        outcome
    }
}

/// Answers the request for a WebSocket, and makes one of the connection.
pub fn accept(
    mut stream: TcpStream,
    head: Head,
    protocol: Option<&str>,
) -> io::Result<WebSocket<TcpStream>> {
    use io::Write;
    let key = head
        .header("sec-websocket-key")
        .filter(|_| head.header("sec-websocket-version") == Some("13"));
    let Some(key) = key else {
        Answer::refusal("400 Bad Request", "a WebSocket of version 13 is wanted\n")
            .send(&mut stream, false)?;
        return Err(io::Error::from(io::ErrorKind::InvalidData));
    };
    let protocol =
        protocol.map(|name| format!("Sec-WebSocket-Protocol: {name}\r\n")).unwrap_or_default();
    write!(
        stream,
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {}\r\n{protocol}\r\n",
        derive_accept_key(key.as_bytes())
    )?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE_BYTES))
        .max_frame_size(Some(MAX_MESSAGE_BYTES));
    Ok(WebSocket::from_partially_read(stream, head.rest, Role::Server, Some(config)))
}

/// A connection that counts while its thread lives.
struct Connection(Arc<Server>);

impl Connection {
    fn count(server: Arc<Server>) -> Option<Self> {
        let more = |n: usize| (n < MAX_CONNECTIONS).then_some(n + 1);
        server.connections.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok()?;
        Some(Self(server))
    }
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.0.connections.fetch_sub(1, Ordering::Relaxed);
    }
}
