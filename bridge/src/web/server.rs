//! One port for the page, its stream, `/metrics` and Foxglove: a thread per connection, with few connections.

use std::fmt::Display;
use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use semidense::service::results::report::scene::{PLAYER, VIEWER};
use serde_json::json;
use tungstenite::WebSocket;
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::{Role, WebSocketConfig};

use crate::feed::{Feed, USUAL_DEPTH};
use crate::foxglove::{self, SUBPROTOCOLS};
use crate::web::guard::{Guard, Refusal};
use crate::web::http::{Answer, Head, HeadError, read_head};
use crate::web::metrics::{CONTENT_TYPE, metrics};
use crate::web::saving::Saver;
use crate::web::scene::Scene;
use crate::web::seats::Seats;
use crate::web::stream::{StreamOptions, serve as serve_stream};

/// Upper limit for concurrent connections, including those that only request a file.
const MAX_CONNECTIONS: usize = 64;
/// Upper limit for pages with a live stream: each may take 5 MB/s.
const MAX_PAGES: usize = 8;
/// Upper limit for the time that sending a file may take.
const LONGEST_ANSWER: Duration = Duration::from_secs(30);
/// Upper limit for a message from a page or Foxglove, bytes: they send a few hundred.
const MAX_MESSAGE_BYTES: usize = 64 << 10;
/// Pause after a failure to accept a connection: too many files are open.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Upper limit for clients of Foxglove's protocol: messages are encoded for each.
const MAX_FOXGLOVE: usize = 8;

const NOT_FOUND: &str = "404 Not Found";
const CONFLICT: &str = "409 Conflict";
const UNAVAILABLE: &str = "503 Service Unavailable";

const SCRIPT: &str = "text/javascript; charset=utf-8";
/// The files of the page, embedded in the program.
const FILES: [(&str, &str, &str); 7] = [
    ("/", "text/html; charset=utf-8", include_str!("assets/index.html")),
    ("/page.css", "text/css; charset=utf-8", include_str!("assets/page.css")),
    ("/page.js", SCRIPT, include_str!("assets/page.js")),
    ("/overlay.js", SCRIPT, include_str!("assets/overlay.js")),
    ("/charts.js", SCRIPT, include_str!("assets/charts.js")),
    ("/player.js", SCRIPT, PLAYER),
    ("/viewer.js", SCRIPT, VIEWER),
];

/// What the server shows.
#[derive(Debug)]
pub enum Shown {
    /// A running instance.
    Live {
        /// The topics of the instance.
        feed: Feed,
        /// The scene that pages show.
        scene: Arc<Scene>,
        /// Settings of the page streams.
        stream: StreamOptions,
        /// Saves the map.
        saver: Saver,
    },
    /// A finished run, packed for the page, with its folder and summary.
    Finished(Vec<u8>, PathBuf, serde_json::Value),
}

/// Why the server cannot start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The port is in use, or the address is not one of this machine.
    #[error("cannot listen on {address}: {source}; choose another one with --listen ADDRESS:PORT")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// The system's error.
        source: io::Error,
    },
    /// A thread cannot be started.
    #[error("cannot start a thread ({0})")]
    Thread(#[from] io::Error),
}

/// The web server.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    /// The address it listens on.
    pub address: SocketAddr,
    guard: Guard,
    /// What is shown.
    pub shown: Shown,
    connections: Seats,
    foxglove_clients: Seats,
    /// Set to true to end all streams and the requests for missing keyframes.
    pub is_over: AtomicBool,
}

impl Server {
    /// Listens on an address; port 0 selects a free one.
    pub fn open(address: SocketAddr, guard: Guard, shown: Shown) -> Result<Arc<Self>, ServerError> {
        let failed = |source| ServerError::Listen { address, source };
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Arc::new(Self {
            listener,
            address,
            guard: Guard { port: address.port(), ..guard },
            shown,
            connections: Seats::default(),
            foxglove_clients: Seats::default(),
            is_over: AtomicBool::new(false),
        }))
    }

    /// Accepts connections on a separate thread for the life of the process.
    pub fn start(self: &Arc<Self>) -> Result<(), ServerError> {
        let server = Arc::clone(self);
        std::thread::Builder::new().name("accept".to_owned()).spawn(move || {
            loop {
                match server.listener.accept() {
                    Ok((stream, _)) => server.take(stream),
                    Err(error) => {
                        tracing::warn!("cannot accept a connection ({error})");
                        std::thread::sleep(ACCEPT_PAUSE);
                    }
                }
            }
        })?;
        Ok(())
    }

    fn take(self: &Arc<Self>, mut stream: TcpStream) {
        let _ = stream.set_write_timeout(Some(LONGEST_ANSWER));
        let Some(seat) = self.connections.take(MAX_CONNECTIONS) else {
            let _ = refuse(&mut stream, UNAVAILABLE, "too many connections");
            return;
        };
        let server = Arc::clone(self);
        let thread = std::thread::Builder::new().name("client".to_owned());
        // If the thread cannot be started, the connection is dropped.
        let _ = thread.spawn(move || {
            let _seat = seat;
            server.answer(stream);
        });
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
                refuse(&mut stream, status, error)
            }
        };
        if let Err(error) = outcome {
            tracing::debug!("a client disconnected: {error}");
        }
    }

    fn answer_head(&self, mut stream: TcpStream, head: Head) -> io::Result<()> {
        if let Err(refusal) = self.guard.check(&head) {
            let status = match refusal {
                Refusal::Host => "421 Misdirected Request",
                Refusal::Origin => "403 Forbidden",
                Refusal::Token => "401 Unauthorized",
            };
            return refuse(&mut stream, status, refusal);
        }
        let answer = match (head.method.as_str(), head.path.as_str()) {
            ("GET", _) if head.is_upgrade() => return self.upgrade(stream, head),
            ("POST", "/api/save") => self.save(),
            ("GET" | "HEAD", path) => self.file(path),
            _ => Answer::refusal("405 Method Not Allowed", "only GET, HEAD, and POST /api/save"),
        };
        answer.send(&mut stream, head.method == "HEAD")
    }

    fn file(&self, path: &str) -> Answer<'_> {
        match (path, &self.shown) {
            ("/metrics", Shown::Live { feed, scene, stream: options, .. }) => {
                let text = metrics(&scene.lock(), &options.instance, scene.pages(), feed.lost());
                return Answer::ok(CONTENT_TYPE, text.into_bytes());
            }
            ("/api/run", Shown::Finished(block, ..)) => {
                return Answer::ok("application/octet-stream", &block[..]);
            }
            ("/api/mode", Shown::Live { .. }) => return Answer::json(&json!({ "mode": "live" })),
            ("/api/mode", Shown::Finished(_, folder, summary)) => {
                let mode = json!({ "mode": "finished", "folder": folder, "summary": summary });
                return Answer::json(&mode);
            }
            _ => {}
        }
        let Some((_, content_type, text)) = FILES.iter().find(|(name, ..)| *name == path) else {
            let text = "no such page: / is the live page, /metrics is for Prometheus";
            return Answer::refusal(NOT_FOUND, text);
        };
        let mut answer = Answer::ok(content_type, text.as_bytes());
        if let (Some(token), true) = (&self.guard.token, path == "/") {
            // So that the page's own requests need no token in their URL.
            let name = self.guard.cookie();
            answer.headers =
                format!("Set-Cookie: {name}={token}; Path=/; HttpOnly; SameSite=Strict\r\n");
        }
        answer
    }

    fn save(&self) -> Answer<'_> {
        let Shown::Live { saver, .. } = &self.shown else {
            return Answer::refusal(CONFLICT, "this run is over: its map is in its folder");
        };
        match saver.save() {
            Ok(folder) => Answer::json(&json!({ "folder": folder })),
            Err(error) => Answer::refusal(CONFLICT, error),
        }
    }

    /// Serves a WebSocket: Foxglove's, which names a subprotocol, or the page's.
    fn upgrade(&self, mut stream: TcpStream, head: Head) -> io::Result<()> {
        let wanted = |name: &&str| head.lists("sec-websocket-protocol", name);
        if let Some(protocol) = SUBPROTOCOLS.into_iter().find(wanted) {
            return self.foxglove(stream, head, protocol);
        }
        let Shown::Live { scene, stream: options, .. } = &self.shown else {
            return refuse(&mut stream, NOT_FOUND, "this run is over: there is no stream");
        };
        if head.path != "/stream" {
            return refuse(&mut stream, NOT_FOUND, "the stream is at /stream");
        }
        let Some(_page) = scene.open_page(MAX_PAGES) else {
            let text = format!("{MAX_PAGES} pages are already open: close one");
            return refuse(&mut stream, UNAVAILABLE, text);
        };
        let socket = accept(stream, head, None)?;
        serve_stream(socket, scene, options, &self.is_over).map_err(io::Error::other)
    }

    fn foxglove(&self, mut stream: TcpStream, head: Head, protocol: &str) -> io::Result<()> {
        let Shown::Live { feed, stream: options, .. } = &self.shown else {
            return refuse(&mut stream, NOT_FOUND, "this run is over: nothing is sent");
        };
        let Some(_seat) = self.foxglove_clients.take(MAX_FOXGLOVE) else {
            let text = format!("{MAX_FOXGLOVE} clients are already connected: close one");
            return refuse(&mut stream, UNAVAILABLE, text);
        };
        let socket = accept(stream, head, Some(protocol))?;
        let listener = feed.listen(USUAL_DEPTH);
        foxglove::serve(socket, &options.instance, |timeout| listener.next(timeout))
            .map_err(io::Error::other)
    }
}

fn refuse(stream: &mut TcpStream, status: &'static str, text: impl Display) -> io::Result<()> {
    Answer::refusal(status, text).send(stream, false)
}

/// Answers a WebSocket request and upgrades the connection.
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
        refuse(&mut stream, "400 Bad Request", "WebSocket version 13 is required")?;
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
