//! The part of HTTP that the page needs: one request per connection, its head bounded in bytes and time.

use std::borrow::Cow;
use std::fmt::Display;
use std::io::{self, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Upper limit for the bytes of a request's head: browsers and scrapers send a tenth of it.
pub const MAX_HEAD_BYTES: usize = 8 << 10;
/// Upper limit for the header lines, with the same margin.
const MAX_HEADERS: usize = 64;
/// Upper limit for the arrival of a head: a phone on a bad wireless link takes a second.
const LONGEST_HEAD: Duration = Duration::from_secs(5);

/// Upper limit for the wait, after the answer, until the other end closes.
const LONGEST_CLOSE: Duration = Duration::from_secs(1);
/// Upper limit for the bytes read during that wait: a refused request may still be arriving.
const MAX_LEFTOVER_BYTES: usize = 256 << 10;

/// The head of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Head {
    /// `GET`, `POST` …
    pub method: String,
    /// The requested path, without the query.
    pub path: String,
    /// The query after the question mark, undecoded.
    pub query: String,
    /// Names in lower case, and values; invalid UTF-8 is replaced.
    headers: Vec<(String, String)>,
    /// Bytes received after the head.
    pub rest: Vec<u8>,
}

impl Head {
    /// The value of a header; `None` if it is missing or repeated.
    pub fn header(&self, name: &str) -> Option<&str> {
        let mut found = self.headers.iter().filter(|(of, _)| of == name);
        let value = found.next().map(|(_, value)| value.as_str());
        if found.next().is_some() { None } else { value }
    }

    /// Whether the header is present.
    pub fn has(&self, name: &str) -> bool {
        self.headers.iter().any(|(of, _)| of == name)
    }

    /// Whether a header's comma-separated list contains `word`.
    pub fn lists(&self, name: &str, word: &str) -> bool {
        let values = self.headers.iter().filter(|(of, _)| of == name);
        values
            .flat_map(|(_, value)| value.split(','))
            .any(|of| of.trim().eq_ignore_ascii_case(word))
    }

    /// A parameter of the query. None of the values used needs decoding.
    pub fn parameter(&self, name: &str) -> Option<&str> {
        let mut pairs = self.query.split('&').filter_map(|pair| pair.split_once('='));
        pairs.find(|(of, _)| *of == name).map(|(_, value)| value)
    }

    /// The value of a cookie.
    pub fn cookie(&self, name: &str) -> Option<&str> {
        let mut pairs =
            self.header("cookie")?.split(';').filter_map(|pair| pair.trim().split_once('='));
        pairs.find(|(of, _)| *of == name).map(|(_, value)| value)
    }

    /// Whether the client requests an upgrade to a WebSocket.
    pub fn is_upgrade(&self) -> bool {
        self.lists("upgrade", "websocket") && self.lists("connection", "upgrade")
    }
}

/// Why a head is refused.
#[derive(Debug, thiserror::Error)]
pub enum HeadError {
    /// It is too long.
    #[error("the request head has more than {MAX_HEAD_BYTES} bytes or {MAX_HEADERS} lines")]
    TooLong,
    /// It is not HTTP.
    #[error("not an HTTP/1.1 request ({0})")]
    Malformed(httparse::Error),
    /// It did not arrive in time.
    #[error("the request head did not arrive within {LONGEST_HEAD:?}")]
    Late,
    /// The connection failed.
    #[error(transparent)]
    Connection(#[from] io::Error),
}

/// Parses the head at the start of `bytes`; `None` if it is incomplete.
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

/// Reads the head of a request; `None` if the other end closes before sending anything.
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

/// An answer, after which the connection is closed.
#[derive(Debug, Clone)]
pub struct Answer<'a> {
    /// Code and reason, `200 OK`.
    pub status: &'static str,
    /// Type of the content.
    pub content_type: &'static str,
    /// Further header lines, each with its line end.
    pub headers: String,
    /// The content.
    pub body: Cow<'a, [u8]>,
}

impl<'a> Answer<'a> {
    /// A successful answer.
    pub fn ok(content_type: &'static str, body: impl Into<Cow<'a, [u8]>>) -> Self {
        Self { status: "200 OK", content_type, headers: String::new(), body: body.into() }
    }

    /// A successful answer with JSON content.
    pub fn json(value: &Value) -> Self {
        Self::ok("application/json", value.to_string().into_bytes())
    }

    /// A one-line text that explains an error.
    pub fn refusal(status: &'static str, text: impl Display) -> Self {
        Self { status, ..Self::ok("text/plain; charset=utf-8", format!("{text}\n").into_bytes()) }
    }

    /// Sends the answer, without its content if only the head was requested.
    pub fn send(&self, stream: &mut TcpStream, is_head_only: bool) -> io::Result<()> {
        // Allow no content from elsewhere, no framing, no type sniffing, no referrer.
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

/// Closes gracefully: unread bytes would reset the connection and lose the answer.
fn close(stream: &mut TcpStream) -> io::Result<()> {
    stream.shutdown(Shutdown::Write)?;
    let end = Instant::now() + LONGEST_CLOSE;
    let mut left = MAX_LEFTOVER_BYTES;
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
    fn a_request_is_parsed_into_its_parts() {
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
    fn a_repeated_header_is_not_trusted() {
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
