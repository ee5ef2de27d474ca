//! The Zenoh session: fixed TCP links only. No scouting, no other ports, bounded buffers.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use zenoh::qos::CongestionControl;
use zenoh::{Config, Session, Wait};

use crate::zenoh::envelope::MAX_MESSAGE_BYTES;
use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;

/// Default port: Zenoh's own.
const USUAL_PORT: u16 = 7447;
/// Upper limit for concurrent links: four receivers, and room for reconnecting before an old link is closed.
const MAX_LINKS: usize = 16;
/// A link that is silent for longer is closed and reopened, milliseconds: longer than the gaps that TCP bridges.
const LEASE_MS: u32 = 10_000;
/// First and longest pause between two attempts to connect, milliseconds.
const RETRY_MS: [u32; 2] = [250, 1000];
/// Size of the kernel's send buffer before the kernel doubles it: data in it is old when it arrives, and
/// delays every pose. On a link of 10 Mbit/s that is 0.1 s.
const SEND_BUFFER_BYTES: u32 = 64 << 10;

/// Batches that Zenoh holds for each priority, at most 16 of 64 kB: poses while its own threads wait for a
/// busy CPU, and the depth of a keyframe in one piece.
const BATCHES: &str = "{ control: 2, real_time: 16, interactive_high: 8, interactive_low: 2, data_high: 2, data: 4, \
                       data_low: 16, background: 8 }";
/// How long a put of one batch, and of several, waits for a free batch before the message is dropped,
/// microseconds. Zenoh drops the newest message, our own queues the oldest: while a put waits, ours decide.
const PUT_WAITS_MICROS: [u32; 2] = [50_000, 200_000];

/// An address to listen on or to connect to: `tcp/HOST:PORT`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    host: String,
    port: u16,
}

/// Why a text is not an endpoint.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not an endpoint: write tcp/HOST:PORT, as in tcp/192.168.1.7:7447 or tcp/[::1]:7447"
)]
pub struct EndpointError(String);

impl FromStr for Endpoint {
    type Err = EndpointError;

    /// Parses `tcp/HOST:PORT`; the protocol and the port may be omitted.
    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let wrong = || EndpointError(text.to_owned());
        let address = match text.split_once('/') {
            Some(("tcp", address)) => address,
            Some(_) => return Err(wrong()),
            None => text,
        };
        let (host, port) = match address.rsplit_once(':') {
            // In an IPv6 address, only what follows the bracket is a port.
            Some((host, port)) if !port.ends_with(']') => {
                (host, port.parse().map_err(|_| wrong())?)
            }
            _ => (address, USUAL_PORT),
        };
        let is_bracketed = host.starts_with('[') && host.ends_with(']');
        let allowed = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        let is_plain = !host.is_empty() && host.chars().all(allowed);
        let inner = host.trim_start_matches('[').trim_end_matches(']');
        let is_v6 = is_bracketed && inner.parse::<std::net::Ipv6Addr>().is_ok();
        if !is_plain && !is_v6 {
            return Err(wrong());
        }
        Ok(Self { host: host.to_owned(), port })
    }
}

impl std::fmt::Display for Endpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "tcp/{}:{}", self.host, self.port)
    }
}

impl Endpoint {
    /// Whether it can be reached from this machine only.
    pub fn is_local(&self) -> bool {
        let is_v4 = self.host.parse::<std::net::Ipv4Addr>().is_ok_and(|a| a.is_loopback());
        is_v4 || self.host == "localhost" || self.host == "[::1]"
    }
}

/// Addresses to listen on and to connect to; the texts are those of the command line.
#[derive(Debug, Clone, Default, PartialEq, Eq, clap::Args)]
pub struct Endpoints {
    /// Open a port for the other side: tcp/HOST:PORT, reachable from other machines only if HOST says so
    /// (tcp/0.0.0.0:7447); may be repeated
    #[arg(long, value_name = "ENDPOINT")]
    pub listen: Vec<Endpoint>,
    /// Connect to a port of the other side, tcp/HOST:PORT, retrying until it answers; may be repeated
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<Endpoint>,
    /// File with one line `user:password` for both sides (mode 0600): a peer with other credentials is
    /// refused. The link is not encrypted
    #[arg(long, value_name = "FILE")]
    pub password_file: Option<PathBuf>,
}

impl std::fmt::Display for Endpoints {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<String> =
            self.listen.iter().chain(&self.connect).map(Endpoint::to_string).collect();
        f.write_str(&names.join(", "))
    }
}

/// Opens the session. Endpoints that do not answer are retried in the background.
pub fn open(endpoints: &Endpoints) -> Result<Session, ZenohError> {
    let config = config(endpoints)?;
    zenoh::open(config).wait().map_err(|error| {
        let reason = first_line(&error);
        ZenohError::Link(format!("cannot open {endpoints}: {reason}; is the port taken (ss -ltnp), is the address one of this machine?"))
    })
}

/// Bits of the session's random id.
pub fn sender_id(session: &Session) -> u64 {
    let bytes = session.zid().to_le_bytes();
    bytes.iter().take(size_of::<u64>()).rev().fold(0, |id, byte| id << 8 | u64::from(*byte))
}

/// Declares the publisher of `kind` for `instance`. Messages that the network does not accept are dropped.
pub fn publisher(
    session: &Session,
    instance: &str,
    kind: Kind,
) -> Result<zenoh::pubsub::Publisher<'static>, ZenohError> {
    let key = kind.key(instance);
    session
        .declare_publisher(key.clone())
        .congestion_control(CongestionControl::Drop)
        .priority(kind.priority())
        .express(kind.is_urgent())
        .wait()
        .map_err(|error| declare_error(&key, &error))
}

/// The error of a failed declaration.
pub fn declare_error(key: &str, error: &dyn std::fmt::Display) -> ZenohError {
    ZenohError::Link(format!("Zenoh cannot declare {key}: {}", first_line(error)))
}

fn config(endpoints: &Endpoints) -> Result<Config, ZenohError> {
    let list = |of: &[Endpoint]| {
        let quoted: Vec<String> = of.iter().map(|e| format!("{:?}", e.to_string())).collect();
        format!("[{}]", quoted.join(","))
    };
    let retry = format!(
        "{{ period_init_ms: {}, period_max_ms: {}, period_increase_factor: 2 }}",
        RETRY_MS[0], RETRY_MS[1]
    );
    let mut keys: Vec<(&'static str, String)> = vec![
        ("mode", "\"peer\"".into()),
        // Set even if empty: the default opens a port on all addresses.
        ("listen/endpoints", list(&endpoints.listen)),
        ("connect/endpoints", list(&endpoints.connect)),
        ("connect/timeout_ms", "-1".into()),
        ("connect/exit_on_failure", "false".into()),
        ("connect/retry", retry),
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
        ("adminspace/enabled", "false".into()),
        ("transport/unicast/max_sessions", MAX_LINKS.to_string()),
        ("transport/shared_memory/enabled", "false".into()),
        ("transport/link/rx/max_message_size", (MAX_MESSAGE_BYTES + (1 << 10)).to_string()),
        ("transport/link/tx/lease", LEASE_MS.to_string()),
        ("transport/link/tx/queue/size", BATCHES.into()),
        (
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop",
            PUT_WAITS_MICROS[0].to_string(),
        ),
        (
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments",
            PUT_WAITS_MICROS[1].to_string(),
        ),
        ("transport/link/tcp/so_sndbuf", SEND_BUFFER_BYTES.to_string()),
    ];
    if let Some(path) = &endpoints.password_file {
        let (user, password) = read_password(path)?;
        keys.push(("transport/auth/usrpwd/user", format!("{user:?}")));
        keys.push(("transport/auth/usrpwd/password", format!("{password:?}")));
        let file = format!("{:?}", path.display().to_string());
        keys.push(("transport/auth/usrpwd/dictionary_file", file));
    }
    let mut config = Config::default();
    for (key, value) in keys {
        config.insert_json5(key, &value).map_err(|error| {
            let shown = if key.ends_with("password") { "…" } else { &value };
            let reason = first_line(&error);
            ZenohError::Link(format!("Zenoh rejects {key} = {shown}: {reason}"))
        })?;
    }
    Ok(config)
}

/// Reads user and password from a file that only its owner can read.
fn read_password(path: &Path) -> Result<(String, String), ZenohError> {
    use std::os::unix::fs::PermissionsExt;
    /// Permissions of the group and of all others.
    const GROUP_AND_OTHERS: u32 = 0o077;
    let wrong = |reason: &str| {
        let path = path.display();
        ZenohError::Link(format!(
            "{path}: {reason}; the file must have one line `user:password` and be readable by its owner only (chmod 600)"
        ))
    };
    let found = std::fs::metadata(path).map_err(|error| wrong(&error.to_string()))?;
    if found.permissions().mode() & GROUP_AND_OTHERS != 0 {
        return Err(wrong("others can read it"));
    }
    let text = std::fs::read_to_string(path).map_err(|error| wrong(&error.to_string()))?;
    let mut lines = text.lines().filter(|line| !line.trim().is_empty());
    let entry = lines.next().and_then(|line| line.trim().split_once(':'));
    match (entry, lines.next()) {
        (Some((user, password)), None) if !user.is_empty() && !password.is_empty() => {
            Ok((user.to_owned(), password.to_owned()))
        }
        _ => Err(wrong("no such line")),
    }
}

/// Removes the source location that Zenoh appends to the reason of an error.
fn first_line(error: &dyn std::fmt::Display) -> String {
    let text = error.to_string();
    let line = text.lines().next().unwrap_or_default();
    line.split(" at /").next().unwrap_or(line).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_parsed() {
        let name = |text: &str| text.parse::<Endpoint>().map(|e| e.to_string());
        for (text, endpoint) in [
            ("robot", "tcp/robot:7447"),
            ("tcp/robot.local", "tcp/robot.local:7447"),
            ("10.0.0.1:5000", "tcp/10.0.0.1:5000"),
            ("tcp/[fe80::1]", "tcp/[fe80::1]:7447"),
            ("tcp/[::1]:9", "tcp/[::1]:9"),
        ] {
            assert_eq!(name(text), Ok(endpoint.to_owned()));
        }
        for wrong in [
            "",
            "tcp/",
            "udp/robot:1",
            "robot:x",
            "robot:70000",
            "a b",
            "tcp/x#iface=y",
            "[::1",
            "tcp/x/y",
            "::1",
        ] {
            assert_eq!(name(wrong), Err(EndpointError(wrong.to_owned())), "{wrong}");
        }
    }

    #[test]
    fn local_endpoints_are_recognised() {
        let is_local = |text: &str| text.parse::<Endpoint>().unwrap().is_local();
        assert!(is_local("127.0.0.1") && is_local("localhost:1") && is_local("[::1]:7"));
        assert!(!is_local("0.0.0.0") && !is_local("[::]:7") && !is_local("robot"));
    }

    #[test]
    fn zenoh_accepts_the_configuration() {
        let endpoints = Endpoints {
            listen: vec!["127.0.0.1:1".parse().unwrap()],
            connect: vec!["robot".parse().unwrap()],
            password_file: None,
        };
        let config = config(&endpoints).unwrap();
        assert_eq!(config.get_json("scouting/multicast/enabled").unwrap(), "false");
        let none = super::config(&Endpoints::default()).unwrap();
        let listen = none.get_json("listen/endpoints").unwrap();
        assert!(!listen.contains("tcp/"), "{listen}");
    }

    #[test]
    fn a_password_that_others_can_read_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let file = tempfile::NamedTempFile::new().unwrap();
        let mode = |mode| {
            std::fs::set_permissions(file.path(), std::fs::Permissions::from_mode(mode)).unwrap();
        };
        std::fs::write(file.path(), "robot:secret\n").unwrap();
        mode(0o644);
        assert!(read_password(file.path()).unwrap_err().to_string().contains("others can read"));
        mode(0o600);
        assert_eq!(read_password(file.path()).unwrap(), ("robot".into(), "secret".into()));
        std::fs::write(file.path(), "robot").unwrap();
        assert!(read_password(file.path()).is_err());
    }
}
