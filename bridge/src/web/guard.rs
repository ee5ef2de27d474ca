//! Access control: refuses pages of other sites and, beyond this machine, clients without the token.

use std::fs::File;
use std::io::{self, Read};
use std::net::{IpAddr, SocketAddr};

use crate::web::http::Head;

/// Bytes of a token: 128 bits cannot be guessed.
const TOKEN_BYTES: usize = 16;

/// Why a request is refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    /// The host name is not one of this server's: a page of another site may be behind it.
    #[error(
        "this server does not answer to that name: use its IP address, localhost, or start it with --host NAME"
    )]
    Host,
    /// The request comes from a page of another site.
    #[error(
        "requests from pages of other sites are refused: start the server with --allow-origin to allow one"
    )]
    Origin,
    /// The token is missing or wrong.
    #[error("open the address that `semidense view` printed: it ends in ?token=…")]
    Token,
}

/// Requirements on every request.
#[derive(Debug, Clone, Default)]
pub struct Guard {
    /// Accepted host names besides IP addresses and localhost.
    pub hosts: Vec<String>,
    /// Other sites whose pages are admitted.
    pub origins: Vec<String>,
    /// The required token.
    pub token: Option<String>,
    /// The port of the server.
    pub port: u16,
}

impl Guard {
    /// Checks a request.
    pub fn check(&self, head: &Head) -> Result<(), Refusal> {
        let host = head.header("host").ok_or(Refusal::Host)?;
        if !self.answers_to(host) {
            return Err(Refusal::Host);
        }
        let is_own = |origin: &str| origin.strip_prefix("http://") == Some(host);
        let is_allowed = |origin: &str| self.origins.iter().any(|of| of == origin);
        match head.header("origin") {
            Some(origin) if !is_own(origin) && !is_allowed(origin) => return Err(Refusal::Origin),
            // A repeated header is not trusted.
            None if head.has("origin") => return Err(Refusal::Origin),
            _ => {}
        }
        let Some(token) = &self.token else { return Ok(()) };
        let bearer = head.header("authorization").and_then(|value| value.strip_prefix("Bearer "));
        let given = [head.parameter("token"), head.cookie(&self.cookie()), bearer];
        let is_known = given.into_iter().flatten().any(|given| is_same(given, token));
        if is_known { Ok(()) } else { Err(Refusal::Token) }
    }

    /// Name of the cookie that holds the token. Browsers send a cookie to all servers of a machine, which may have one
    /// for each rig: the name tells them apart.
    pub fn cookie(&self) -> String {
        format!("semidense_token_{}", self.port)
    }

    /// Whether `host` is one of this server's names. A name that resolves here only by a foreign name server
    /// would admit the pages of that server's owner; an IP address cannot be such a name.
    fn answers_to(&self, host: &str) -> bool {
        if host.parse::<SocketAddr>().is_ok() || host.parse::<IpAddr>().is_ok() {
            return true;
        }
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.parse::<u16>().is_ok() => name,
            _ => host,
        };
        let bracketed = name.strip_prefix('[').and_then(|name| name.strip_suffix(']'));
        bracketed.is_some_and(|name| name.parse::<IpAddr>().is_ok())
            || name.eq_ignore_ascii_case("localhost")
            || self.hosts.iter().any(|of| of.eq_ignore_ascii_case(name))
    }
}

/// Compares in a time that does not reveal how much is correct.
fn is_same(given: &str, token: &str) -> bool {
    let (given, token) = (given.as_bytes(), token.as_bytes());
    given.len() == token.len() && given.iter().zip(token).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
}

/// A new token, from the kernel's random numbers.
pub fn new_token() -> io::Result<String> {
    let mut bytes = [0; TOKEN_BYTES];
    File::open("/dev/urandom")?.read_exact(&mut bytes)?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::web::http::parse_head;

    fn head(lines: &str, query: &str) -> Head {
        let text = format!("GET /{query} HTTP/1.1\r\n{lines}\r\n");
        parse_head(text.as_bytes()).unwrap().unwrap()
    }

    #[test]
    fn host_names_that_others_may_have_assigned_are_refused() {
        let guard = Guard { hosts: vec!["robot.local".to_owned()], ..Guard::default() };
        for good in [
            "127.0.0.1:8765",
            "localhost:8765",
            "LOCALHOST",
            "[::1]:8765",
            "[::1]",
            "10.0.0.7",
            "robot.local:8765",
        ] {
            assert_eq!(guard.check(&head(&format!("Host: {good}\r\n"), "")), Ok(()), "{good}");
        }
        for bad in [
            "evil.example",
            "evil.example:8765",
            "localhost.evil.example",
            "127.0.0.1.evil.example:80",
            "",
        ] {
            let refused = guard.check(&head(&format!("Host: {bad}\r\n"), ""));
            assert_eq!(refused, Err(Refusal::Host), "{bad}");
        }
        assert_eq!(guard.check(&head("", "")), Err(Refusal::Host));
    }

    #[test]
    fn pages_of_other_sites_are_refused() {
        let guard =
            Guard { origins: vec!["https://studio.example".to_owned()], ..Guard::default() };
        let ask = |origin: &str| guard.check(&head(&format!("Host: localhost:1\r\n{origin}"), ""));
        assert_eq!(ask("Origin: http://localhost:1\r\n"), Ok(()));
        assert_eq!(ask("Origin: https://studio.example\r\n"), Ok(()));
        for bad in ["http://localhost:2", "http://evil.example", "null", "https://localhost:1"] {
            assert_eq!(ask(&format!("Origin: {bad}\r\n")), Err(Refusal::Origin), "{bad}");
        }
        let twice = "Origin: http://localhost:1\r\nOrigin: http://evil.example\r\n";
        assert_eq!(ask(twice), Err(Refusal::Origin));
    }

    #[test]
    fn requests_without_the_token_are_refused() {
        let token = new_token().unwrap();
        assert_eq!(token.len(), 2 * TOKEN_BYTES);
        assert_ne!(token, new_token().unwrap());
        let guard = Guard { token: Some(token.clone()), port: 8765, ..Guard::default() };
        let ask = |lines: &str, query: &str| {
            guard.check(&head(&format!("Host: 10.0.0.7\r\n{lines}"), query))
        };
        assert_eq!(ask("", &format!("?token={token}")), Ok(()));
        assert_eq!(ask(&format!("Cookie: semidense_token_8765={token}\r\n"), ""), Ok(()));
        let of_both = format!("Cookie: semidense_token_8766=0; semidense_token_8765={token}\r\n");
        assert_eq!(ask(&of_both, ""), Ok(()));
        let of_other = format!("Cookie: semidense_token_8766={token}\r\n");
        assert_eq!(ask(&of_other, ""), Err(Refusal::Token));
        assert_eq!(ask(&format!("Authorization: Bearer {token}\r\n"), ""), Ok(()));
        for bad in ["", "?token=", "?token=0123", "?x=1"] {
            assert_eq!(ask("", bad), Err(Refusal::Token), "{bad}");
        }
        assert_eq!(ask("", &format!("?token={token}0")), Err(Refusal::Token));
    }
}
