//! As much of HTTP as the page needs: one request a connection, its head bounded in bytes and time.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Most bytes of a request's head: what browsers and scrapers send is a tenth of it.
pub const MAX_HEAD_BYTES: usize = 8 << 10;
/// Most header lines: as above.
const MAX_HEADERS: usize = 64;
/// Longest time in which a head must have come: a phone on bad wireless takes a second.
const LONGEST_HEAD: Duration = Duration::from_secs(5);

/// Longest wait, once it is answered, for the other end to close.
const LONGEST_CLOSE: Duration = Duration::from_secs(1);
/// Most bytes that are read meanwhile: a request that is refused may continue.
const MOST_LEFT_BYTES: usize = 256 << 10;

/// The head of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Head {
    /// `GET`, `POST` …
    pub method: String,
    /// What is asked for, without the query.
    pub path: String,
    /// The query behind the question mark, as it came.
    pub query: String,
    /// Names in lower case, and values; bytes that are no text are replaced.
    headers: Vec<(String, String)>,
    /// Bytes that came behind the head.
    pub rest: Vec<u8>,
}

impl Head {
    /// The only value of a header; `None` where it is missing or comes twice.
    pub fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter().filter(|(of, _)| of == name);
        let value = found.next().map(|(_, value)| value.as_str());
        if found.next().is_some() { None } else { value }
    }

    /// Whether there is such a header.
    pub fn has(&self, name: &str) -> bool {
        self.headers.iter().any(|(of, _)| of == name)
    }

    /// Whether a list in a header, separated by commas, names `word`.
    pub fn lists(&self, name: &str, word: &str) -> bool {
        let values = self.headers.iter().filter(|(of, _)| of == name);
        values
            .flat_map(|(_, value)| value.split(','))
            .any(|of| of.trim().eq_ignore_ascii_case(word))
    }

    /// A parameter of the query. No value that is used needs decoding.
    pub fn parameter(&self, name: &str) -> Option<&str> {
        let mut pairs = self.query.split('&').filter_map(|pair| pair.split_once('='));
        pairs.find(|(of, _)| *of == name).map(|(_, value)| value)
    }

    /// A cookie.
    pub fn cookie(&self, name: &str) -> Option<&str> {
        let mut pairs =
            self.header("cookie")?.split(';').filter_map(|pair| pair.trim().split_once('='));
        pairs.find(|(of, _)| *of == name).map(|(_, value)| value)
    }

    /// Whether it wants to become a WebSocket.
    pub fn is_upgrade(&self) -> bool {
        self.lists("upgrade", "websocket") && self.lists("connection", "upgrade")
    }
}

/// Why a head is refused.
#[derive(Debug, thiserror::Error)]
pub enum HeadError {
    /// It is too long.
    #[error("the head of the request has more than {MAX_HEAD_BYTES} bytes or {MAX_HEADERS} lines")]
    TooLong,
    /// It is no HTTP.
    #[error("not a request of HTTP/1.1 ({0})")]
    Malformed(httparse::Error),
    /// It did not come in time.
    #[error("the head of the request did not come within {LONGEST_HEAD:?}")]
    Late,
    /// The connection fails.
    #[error(transparent)]
    Connection(#[from] io::Error),
}

/// The head at the beginning of `bytes`; `None` where it is not whole yet.
pub fn parse_head(bytes: &[u8]) -> Result<Option<Head>, HeadError> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    let length = match request.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) if bytes.len() < MAX_HEAD_BYTES => return Ok(None),
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
            return Err(HeadError::TooLong);
        }
        Err(error) => return Err(HeadError::Malformed(error)),
    };
    if length > MAX_HEAD_BYTES {
        return Err(HeadError::TooLong);
    }
    let target = request.path.unwrap_or_default();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let headers = request.headers.iter().map(|header| {
        let value = String::from_utf8_lossy(header.value).into_owned();
        (header.name.to_ascii_lowercase(), value)
    });
    Ok(Some(Head {
        method: request.method.unwrap_or_default().to_owned(),
        path: path.to_owned(),
        query: query.to_owned(),
        headers: headers.collect(),
        rest: bytes[length..].to_vec(),
    }))
}

/// Reads the head of a request; `None` where the other end closes before it says anything.
pub fn read_head(stream: &mut TcpStream) -> Result<Option<Head>, HeadError> {
    let end = Instant::now() + LONGEST_HEAD;
    let mut bytes = Vec::new();
    let mut chunk = [0; 2048];
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(HeadError::Late);
        }
        stream.set_read_timeout(Some(left))?;
        match stream.read(&mut chunk) {
            Ok(0) if bytes.is_empty() => return Ok(None),
            Ok(0) => return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
            Ok(length) => bytes.extend_from_slice(&chunk[..length]),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Err(HeadError::Late),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return Err(error.into()),
        }
        if let Some(head) = parse_head(&bytes)? {
            return Ok(Some(head));
        }
    }
}

/// An answer; the connection is closed behind it.
#[derive(Debug, Clone)]
pub struct Answer<'a> {
    /// Code and reason, `200 OK`.
    pub status: &'static str,
    /// Type of the content.
    pub content_type: &'static str,
    /// Further header lines, each with its end.
    pub headers: String,
    /// The content.
    pub body: Cow<'a, [u8]>,
}

impl<'a> Answer<'a> {
    /// Content that is there.
    pub fn ok(content_type: &'static str, body: impl Into<Cow<'a, [u8]>>) -> Self {
        Self { status: "200 OK", content_type, headers: String::new(), body: body.into() }
    }

    /// An object that is there.
    pub fn json(value: &Value) -> Self {
        Self::ok("application/json", value.to_string().into_bytes())
    }

    /// A line of text that says what is wrong.
    pub fn refusal(status: &'static str, text: impl Display) -> Self {
        Self { status, ..Self::ok("text/plain; charset=utf-8", format!("{text}\n").into_bytes()) }
    }

    /// Sends it; without the content where only the head was asked for.
    pub fn send(&self, stream: &mut TcpStream, is_head_only: bool) -> io::Result<()> {
        // Nothing from elsewhere, no frame around it, no guessing of types, no address handed on.
        let head = format!(
            "HTTP/1.1 {}\r\nContent-Type: {}\r\nContent-Length: {}\r\nConnection: close\r\n\
             Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
             Content-Security-Policy: default-src 'self'; connect-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'\r\n\
             {}\r\n",
            self.status,
            self.content_type,
            self.body.len(),
            self.headers
        );
        stream.write_all(head.as_bytes())?;
        if !is_head_only {
            stream.write_all(&self.body)?;
        }
        stream.flush()?;
        close(stream)
    }
}

/// Closes in order: bytes that nobody has read would take the answer with them.
fn close(stream: &mut TcpStream) -> io::Result<()> {
    stream.shutdown(Shutdown::Write)?;
    let end = Instant::now() + LONGEST_CLOSE;
    let mut left = MOST_LEFT_BYTES;
    let mut chunk = [0; 4096];
    while left > 0 && Instant::now() < end {
        stream.set_read_timeout(Some(LONGEST_CLOSE))?;
        match stream.read(&mut chunk)? {
            0 => break,
            length => left = left.saturating_sub(length),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn head(text: &str) -> Head {
        parse_head(text.as_bytes()).unwrap().unwrap()
    }

    #[test]
    fn a_request_is_taken_apart() {
        let text = "GET /a?token=ab&x=1 HTTP/1.1\r\nHost: robot:1\r\nCookie: a=1; b=2\r\n\
                    Connection: keep-alive, Upgrade\r\nUpgrade: websocket\r\n\r\nrest";
        let head = head(text);
        assert_eq!((head.method.as_str(), head.path.as_str()), ("GET", "/a"));
        assert_eq!((head.parameter("token"), head.parameter("y")), (Some("ab"), None));
        assert_eq!((head.cookie("b"), head.cookie("c")), (Some("2"), None));
        assert!(
            head.is_upgrade() && head.rest == b"rest" && head.header("host") == Some("robot:1")
        );
    }

    #[test]
    fn a_header_that_comes_twice_is_not_believed() {
        let head = head("GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n");
        assert_eq!(head.header("host"), None);
    }

    #[test]
    fn long_heads_are_refused() {
        let long = format!("GET / HTTP/1.1\r\nA: {}", "x".repeat(MAX_HEAD_BYTES));
        assert!(matches!(parse_head(long.as_bytes()), Err(HeadError::TooLong)));
        let many = format!("GET / HTTP/1.1\r\n{}\r\n", "A: b\r\n".repeat(MAX_HEADERS + 1));
        assert!(matches!(parse_head(many.as_bytes()), Err(HeadError::TooLong)));
        let whole = format!("GET / HTTP/1.1\r\nA: {}\r\n\r\n", "x".repeat(MAX_HEAD_BYTES));
        assert!(matches!(parse_head(whole.as_bytes()), Err(HeadError::TooLong)));
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_head_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 0..600)) {
            if let Ok(Some(head)) = parse_head(&bytes) {
                let _ = (head.header("host"), head.parameter("token"), head.cookie("a"), head.is_upgrade());
            }
        }

        #[test]
        fn a_damaged_request_is_a_head_or_an_error(at in 0_usize..90, with in any::<u8>(), cut in 0_usize..120) {
            let mut bytes = b"GET /stream?token=1 HTTP/1.1\r\nHost: localhost:8765\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n".to_vec();
            bytes[at] = with;
            bytes.truncate(cut);
            if let Ok(Some(head)) = parse_head(&bytes) {
                prop_assert!(head.rest.len() < bytes.len());
                let _ = (head.parameter("token"), head.is_upgrade());
            }
        }
    }
}
