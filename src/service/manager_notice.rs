//! Notifications to the service manager (sd_notify(3)): readiness, a status line, and the heartbeat of the frame loop.
//! One socket for the life of the process and no allocation: the frame loop itself sends them, so that a hanging loop
//! is not taken for a live one.

use std::fmt;
use std::io::{self, Cursor, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};

/// Heartbeats within the manager's timeout: two may be lost or late.
const BEATS_IN_TIMEOUT: i64 = 4;
/// Longest message: a state, a cause and a few numbers.
const MESSAGE_BYTES: usize = 512;
/// Extension of the start timeout that a long preparation requests, microseconds.
const START_EXTENSION_US: u64 = 30_000_000;

/// The variables that describe its manager to a process (systemd.exec(5)).
pub const VARIABLES: [&str; 3] = ["NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"];

/// The manager of this process, if it has one.
#[derive(Debug, Default)]
pub struct ManagerNotice {
    socket: Option<UnixDatagram>,
    heartbeat: Option<Heartbeat>,
    said_ready: bool,
}

/// When the next heartbeat is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Heartbeat {
    period_nanos: i64,
    last_nanos: i64,
}

impl Heartbeat {
    /// `timeout_us` and `process_id` are the values of the manager's variables; `None` where it does not watch this
    /// process.
    fn of(timeout_us: Option<&str>, process_id: Option<&str>, own_id: u32) -> Option<Self> {
        let timeout_us: i64 = timeout_us?.parse().ok().filter(|&us| us > 0)?;
        let is_meant = process_id.is_none_or(|id| id.parse() == Ok(own_id));
        let period_nanos = timeout_us.saturating_mul(1000) / BEATS_IN_TIMEOUT;
        is_meant.then_some(Self { period_nanos, last_nanos: i64::MIN })
    }

    /// Whether it is due; if so, counts from now.
    fn is_due(&mut self, now_nanos: i64) -> bool {
        let is_due = now_nanos.saturating_sub(self.last_nanos) >= self.period_nanos;
        if is_due {
            self.last_nanos = now_nanos;
        }
        is_due
    }
}

impl ManagerNotice {
    /// Connects to the manager that the environment names. An invalid name is a warning: the process matters more than
    /// its notifications.
    pub fn from_environment() -> Self {
        let variable = |name: &str| std::env::var(name).ok().filter(|value| !value.is_empty());
        let [path, timeout_us, process_id] = VARIABLES.map(variable);
        let Some(path) = path else { return Self::default() };
        let socket = connect(&path)
            .inspect_err(|error| tracing::warn!("NOTIFY_SOCKET={path}: {error}"))
            .ok();
        let own_id = std::process::id();
        let heartbeat = Heartbeat::of(timeout_us.as_deref(), process_id.as_deref(), own_id);
        Self { socket, heartbeat, said_ready: false }
    }

    /// Reports that the process does its work from now on. Sent once.
    pub fn ready(&mut self) {
        if !std::mem::replace(&mut self.said_ready, true) {
            self.send(format_args!("READY=1"));
        }
    }

    /// Reports that the process is ending.
    pub fn stopping(&self) {
        self.send(format_args!("STOPPING=1"));
    }

    /// Reports that the preparation continues: until the process is ready the manager waits longer.
    pub fn extend_start(&self) {
        if !self.said_ready {
            self.send(format_args!("EXTEND_TIMEOUT_USEC={START_EXTENSION_US}"));
        }
    }

    /// Sends one line for `systemctl status`.
    pub fn status(&self, status: fmt::Arguments<'_>) {
        self.send(format_args!("STATUS={status}"));
    }

    /// Reports that the frame loop is alive. Call it from there, as often as you like.
    pub fn beat(&mut self, now_nanos: i64) {
        if self.heartbeat.as_mut().is_some_and(|heartbeat| heartbeat.is_due(now_nanos)) {
            self.send(format_args!("WATCHDOG=1"));
        }
    }

    fn send(&self, message: fmt::Arguments<'_>) {
        let Some(socket) = &self.socket else { return };
        let mut line = OneLine(Cursor::new([0; MESSAGE_BYTES]));
        // What does not fit is cut; a manager that is full or gone is not waited for.
        let _ = fmt::write(&mut line, message);
        let written = &line.0.get_ref()[..line.0.position() as usize];
        // Not within a character: the manager accepts UTF-8 only.
        let whole = std::str::from_utf8(written).map_or_else(|e| e.valid_up_to(), str::len);
        let _ = socket.send(&written[..whole]);
    }
}

/// A message with its control characters as blanks: a second line would be another assignment.
struct OneLine(Cursor<[u8; MESSAGE_BYTES]>);

impl fmt::Write for OneLine {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        text.chars().try_for_each(|of| {
            let printed = if of.is_control() { ' ' } else { of };
            write!(self.0, "{printed}").map_err(|_| fmt::Error)
        })
    }
}

/// Connects to the socket at `path`, or in the abstract namespace where it begins with `@`.
fn connect(path: &str) -> io::Result<UnixDatagram> {
    let address = match path.strip_prefix('@') {
        Some(name) => SocketAddr::from_abstract_name(name)?,
        None => SocketAddr::from_pathname(path)?,
    };
    let socket = UnixDatagram::unbound()?;
    socket.connect_addr(&address)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beats_are_due_more_often_than_every_half_timeout() {
        let mut heartbeat = Heartbeat::of(Some("2000000"), Some("17"), 17).unwrap();
        let millis = |ms: i64| ms * 1_000_000;
        assert!(heartbeat.is_due(millis(5)), "the first at once");
        assert!(!heartbeat.is_due(millis(504)));
        assert!(heartbeat.is_due(millis(505)));
        assert!(heartbeat.is_due(millis(1400)));
        assert!(!heartbeat.is_due(millis(1500)));
    }

    #[test]
    fn only_a_watched_process_sends_heartbeats() {
        assert_eq!(Heartbeat::of(None, None, 17), None);
        assert_eq!(Heartbeat::of(Some("0"), None, 17), None);
        assert_eq!(Heartbeat::of(Some("x"), None, 17), None);
        assert_eq!(Heartbeat::of(Some("1000"), Some("18"), 17), None);
        assert!(Heartbeat::of(Some("1000"), None, 17).is_some());
        assert!(Heartbeat::of(Some("9223372036854775807"), None, 17).is_some());
    }

    fn heard(by: &UnixDatagram) -> String {
        let mut bytes = [0; 2 * MESSAGE_BYTES];
        let length = by.recv(&mut bytes).unwrap();
        String::from_utf8(bytes[..length].to_vec()).unwrap()
    }

    #[test]
    fn the_manager_receives_every_notice() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let manager = UnixDatagram::bind(&path).unwrap();
        let socket = connect(path.to_str().unwrap()).ok();
        let heartbeat = Heartbeat::of(Some("1000"), None, 1);
        let mut notice = ManagerNotice { socket, heartbeat, said_ready: false };
        notice.extend_start();
        assert_eq!(heard(&manager), "EXTEND_TIMEOUT_USEC=30000000");
        notice.ready();
        notice.ready();
        notice.extend_start();
        notice.status(format_args!("a\nWATCHDOG=trigger{}", "\r"));
        assert_eq!(heard(&manager), "READY=1");
        assert_eq!(heard(&manager), "STATUS=a WATCHDOG=trigger ");
        notice.beat(7);
        notice.beat(8);
        notice.stopping();
        assert_eq!(heard(&manager), "WATCHDOG=1");
        assert_eq!(heard(&manager), "STOPPING=1");
        notice.status(format_args!("{}", "x".repeat(3 * MESSAGE_BYTES)));
        assert!(heard(&manager).len() <= MESSAGE_BYTES, "a long text is cut");
        drop(manager);
        notice.status(format_args!("nobody listens, and nobody waits"));
    }

    #[test]
    fn a_manager_may_have_an_abstract_name() {
        let name = format!("semidense-test-{}", std::process::id());
        let address = SocketAddr::from_abstract_name(&name).unwrap();
        let manager = UnixDatagram::bind_addr(&address).unwrap();
        let socket = connect(&format!("@{name}")).ok();
        ManagerNotice { socket, ..Default::default() }.ready();
        assert_eq!(heard(&manager), "READY=1");
        assert!(connect("/nowhere/notify").is_err());
    }
}
