//! Admission: requests that name this host by its own name or address, from a page of its own, and where others on
//! the network can reach it, with the token of the printed address.
//!
//! The files of the page hold nothing of the machine, and are for everybody on that host. The machine is behind the
//! websocket, which needs the token. It stands behind the `#` of the address, which no browser sends to anybody; the
//! page keeps it in memory and names it in a header. It is no cookie: a browser sends those to all ports of a host.

use std::fs::File;
use std::io::{self, Read};
use std::net::SocketAddr;

use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, StatusCode, header};

use fieldbeat_record::metrics::host::{Meant, Names};

/// Bytes of a token.
const TOKEN: usize = 16;

/// The subprotocol of the websocket. A page can set no other header of it: the token is named as a further one.
pub const PROTOCOL: &str = "fieldbeat";

/// Why a request is refused, for who reads it.
pub type Refusal = (StatusCode, &'static str);

/// The rules of one server.
#[derive(Debug)]
pub struct Rules {
    names: Names,
    token: Option<Token>,
}

/// A secret of this server.
#[derive(Debug)]
struct Token(String);

impl Rules {
    /// For a server at `address`, which may have one more name. A token is required beyond this computer; and on it for
    /// a page with `control`, since the port is open to all its users.
    pub fn new(address: SocketAddr, name: Option<String>, control: bool) -> io::Result<Rules> {
        let mut names = Names::default();
        name.into_iter().for_each(|name| names.add(name));
        let token = (control || !address.ip().is_loopback()).then(Token::new).transpose()?;
        Ok(Rules { names, token })
    }

    /// The end of the page's address.
    pub fn fragment(&self) -> String {
        self.token.as_ref().map_or_else(String::new, |token| format!("#token={}", token.0))
    }

    /// Judges any request that came to `local`.
    pub fn judge(&self, head: &Parts, local: SocketAddr) -> Result<(), Refusal> {
        let host = only(&head.headers, header::HOST);
        let meant = host.and_then(|host| Meant::parse(host.as_bytes()));
        // A whole address in the request counts more than the header (RFC 9112, 3.2.2), and no browser sends one.
        let elsewhere = head.uri.authority().is_some_and(|authority| Some(authority.as_str()) != host);
        if elsewhere || !meant.is_some_and(|meant| self.names.are_ours(meant, local.ip())) {
            let why = "that name is not one of this computer: use its address, or --listen NAME:PORT";
            return Err((StatusCode::MISDIRECTED_REQUEST, why));
        }
        if head.headers.contains_key(header::ORIGIN) {
            let origin =
                only(&head.headers, header::ORIGIN).and_then(|origin| origin.strip_prefix("http://"));
            if origin.is_none() || origin != host {
                return Err((StatusCode::FORBIDDEN, "only the page of this server may ask"));
            }
        }
        Ok(())
    }

    /// Judges a request for the machine itself, beyond [`judge`](Rules::judge).
    pub fn judge_token(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        match &self.token {
            Some(token) if !named(headers).is_some_and(|named| token.is(named)) => Err((
                StatusCode::UNAUTHORIZED,
                "open the address that `fieldbeat scope` printed, with its token",
            )),
            _ => Ok(()),
        }
    }

    /// Judges a request for the websocket. Each browser names the page that opens it; what does not is none.
    pub fn judge_socket(&self, headers: &HeaderMap) -> Result<(), Refusal> {
        if !headers.contains_key(header::ORIGIN) {
            return Err((StatusCode::FORBIDDEN, "only a page opens it: its Origin is missing"));
        }
        self.judge_token(headers)
    }
}

/// The token that a request names: that of a websocket as a subprotocol, any other as a bearer.
fn named(headers: &HeaderMap) -> Option<&str> {
    match only(headers, header::SEC_WEBSOCKET_PROTOCOL) {
        Some(protocols) => protocols.split(',').map(str::trim).find(|one| *one != PROTOCOL),
        None => only(headers, header::AUTHORIZATION)?.strip_prefix("Bearer "),
    }
}

/// The value of a header that is there once.
fn only(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    let mut all = headers.get_all(name).iter();
    all.next().filter(|_| all.next().is_none()).and_then(|value| value.to_str().ok())
}

impl Token {
    fn new() -> io::Result<Token> {
        let mut bytes = [0; TOKEN];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Token(bytes.iter().map(|byte| format!("{byte:02x}")).collect()))
    }

    /// Takes as long for every token of this length.
    fn is(&self, token: &str) -> bool {
        let differ = self.0.bytes().zip(token.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
        self.0.len() == token.len() && differ == 0
    }
}

#[cfg(test)]
mod tests {
    use axum::http::Request;

    use super::*;

    fn head(uri: &str, headers: &[(&str, &str)]) -> Parts {
        let builder =
            headers.iter().fold(Request::builder().uri(uri), |to, (name, value)| to.header(*name, *value));
        builder.body(()).unwrap().into_parts().0
    }

    /// The status of a refusal; 0: it is let in.
    fn status(rules: &Rules, uri: &str, headers: &[(&str, &str)]) -> u16 {
        let judged = rules.judge(&head(uri, headers), ([192, 168, 1, 5], 80).into());
        judged.map_or_else(|(status, _)| status.as_u16(), |()| 0)
    }

    fn status_of_socket(rules: &Rules, headers: &[(&str, &str)]) -> u16 {
        let judged = rules.judge_socket(&head("/ws", headers).headers);
        judged.map_or_else(|(status, _)| status.as_u16(), |()| 0)
    }

    #[test]
    fn on_the_loopback_the_host_and_the_origin_have_to_be_ours() {
        let rules = Rules::new(([127, 0, 0, 1], 80).into(), None, false).unwrap();
        assert_eq!(rules.fragment(), "");
        let own = ("host", "localhost:80");
        assert_eq!(status(&rules, "/", &[own]), 0);
        assert_eq!(status(&rules, "/ws", &[own, ("origin", "http://localhost:80")]), 0);
        for origin in [
            "http://evil.example",
            "https://localhost:80",
            "null",
            "http://localhost:81",
            "http://127.0.0.1:80",
        ] {
            assert_eq!(status(&rules, "/ws", &[own, ("origin", origin)]), 403, "{origin}");
        }
        let both = [own, ("origin", "http://localhost:80"), ("origin", "http://evil.example")];
        assert_eq!(status(&rules, "/ws", &both), 403);
        assert_eq!(status(&rules, "/", &[]), 421);
        assert_eq!(status(&rules, "/", &[("host", "evil.example")]), 421);
        assert_eq!(status(&rules, "/", &[own, ("host", "evil.example")]), 421);
        // No token, but an origin.
        assert_eq!(status_of_socket(&rules, &[]), 403);
        assert_eq!(status_of_socket(&rules, &[("origin", "http://localhost:80")]), 0);
    }

    #[test]
    fn on_the_network_there_is_a_token_too() {
        let rules = Rules::new(([192, 168, 1, 5], 80).into(), Some("press1".into()), false).unwrap();
        let fragment = rules.fragment();
        let token = fragment.strip_prefix("#token=").unwrap();
        assert_eq!(token.len(), 2 * TOKEN);
        let own = ("host", "press1:80");
        let origin = ("origin", "http://press1:80");
        let protocols = format!("{PROTOCOL}, {token}");
        assert_eq!(status_of_socket(&rules, &[origin, ("sec-websocket-protocol", &protocols)]), 0);
        // The token does not do without the page.
        assert_eq!(status_of_socket(&rules, &[("sec-websocket-protocol", &protocols)]), 403);
        let bearer = format!("Bearer {token}");
        assert!(rules.judge_token(&head("/access", &[("authorization", &bearer)]).headers).is_ok());
        let wrong = format!("{PROTOCOL}, {}", "0".repeat(2 * TOKEN));
        for protocols in ["", PROTOCOL, "fieldbeat,", &wrong, &protocols[..protocols.len() - 1]] {
            let headers = [origin, ("sec-websocket-protocol", protocols)];
            assert_eq!(status_of_socket(&rules, &headers), 401, "{protocols}");
        }
        // What a browser sends to other ports, or shows to others, is worth nothing.
        let cookie = format!("fieldbeat-80={token}");
        assert_eq!(status_of_socket(&rules, &[origin, ("cookie", &cookie)]), 401);
        assert!(rules.judge_token(&head(&format!("/ws?token={token}"), &[own]).headers).is_err());
        // Nor does the token make a host ours.
        assert_eq!(status(&rules, "/", &[("host", "evil.example"), ("authorization", &bearer)]), 421);
        // Whoever may command the machine has one on the loopback as well.
        let commands = Rules::new(([127, 0, 0, 1], 80).into(), None, true).unwrap();
        assert_eq!(status_of_socket(&commands, &[("origin", "http://localhost")]), 401);
        let other = Rules::new(([192, 168, 1, 5], 80).into(), None, false).unwrap();
        assert_ne!(other.fragment(), fragment);
    }
}
