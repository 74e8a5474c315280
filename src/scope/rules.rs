//! Who is let in: whoever asks for this host by its own name or address, from a page of its own, and where others on
//! the network can reach it, with the token of the printed address.

use std::fs::File;
use std::io::{self, Read};
use std::net::SocketAddr;

use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderName, StatusCode, Uri, header};

use crate::telemetry::metrics::host::{Meant, Names};

/// Bytes of a token.
const TOKEN: usize = 16;

/// The rules of one server.
#[derive(Debug)]
pub struct Rules {
    names: Names,
    token: Option<Token>,
}

/// A secret of this server, and the name of the cookie that keeps it in a browser.
#[derive(Debug)]
struct Token {
    secret: String,
    cookie: String,
}

/// What is let in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Admitted {
    /// The request.
    Request,
    /// The token was in the address: the browser keeps it by this cookie, and shows the address without it.
    Keep(String),
}

impl Rules {
    /// For a server at `address`, which may have one more name. A token is required beyond this computer; and on it for
    /// a page with `control`, since the port is open to all its users.
    pub fn new(address: SocketAddr, name: Option<String>, control: bool) -> io::Result<Rules> {
        let mut names = Names::default();
        name.into_iter().for_each(|name| names.add(name));
        let token =
            (control || !address.ip().is_loopback()).then(|| Token::new(address.port())).transpose()?;
        Ok(Rules { names, token })
    }

    /// What the address of the page ends with.
    pub fn query(&self) -> String {
        self.token.as_ref().map_or_else(String::new, |token| format!("?token={}", token.secret))
    }

    /// Judges a request that came to `local`.
    pub fn judge(&self, head: &Parts, local: SocketAddr) -> Result<Admitted, (StatusCode, &'static str)> {
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
        match &self.token {
            Some(token) => token.judge(head),
            None => Ok(Admitted::Request),
        }
    }
}

/// The value of a header that is there once.
fn only(headers: &HeaderMap, name: HeaderName) -> Option<&str> {
    let mut all = headers.get_all(name).iter();
    all.next().filter(|_| all.next().is_none()).and_then(|value| value.to_str().ok())
}

impl Token {
    fn new(port: u16) -> io::Result<Token> {
        let mut bytes = [0; TOKEN];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        let secret = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        // Browsers keep one cookie of a name for all ports.
        Ok(Token { secret, cookie: format!("fieldbeat-{port}") })
    }

    fn judge(&self, head: &Parts) -> Result<Admitted, (StatusCode, &'static str)> {
        if in_query(&head.uri).is_some_and(|token| self.is(token)) {
            let Token { secret, cookie } = self;
            return Ok(Admitted::Keep(format!("{cookie}={secret}; Path=/; HttpOnly; SameSite=Strict")));
        }
        let cookies = head.headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut cookies =
            cookies.flat_map(|value| value.split(';')).filter_map(|one| one.trim().split_once('='));
        match cookies.any(|(name, value)| name == self.cookie && self.is(value)) {
            true => Ok(Admitted::Request),
            false => Err((
                StatusCode::UNAUTHORIZED,
                "open the address that `fieldbeat scope` printed, with its token",
            )),
        }
    }

    /// Takes as long for every token of this length.
    fn is(&self, token: &str) -> bool {
        let differ = self.secret.bytes().zip(token.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
        self.secret.len() == token.len() && differ == 0
    }
}

fn in_query(uri: &Uri) -> Option<&str> {
    uri.query()?.split('&').find_map(|pair| pair.strip_prefix("token="))
}

#[cfg(test)]
mod tests {
    use axum::http::Request;

    use super::*;

    fn status(rules: &Rules, uri: &str, headers: &[(&str, &str)]) -> Result<Admitted, u16> {
        let builder =
            headers.iter().fold(Request::builder().uri(uri), |to, (name, value)| to.header(*name, *value));
        let head = builder.body(()).unwrap().into_parts().0;
        rules.judge(&head, ([192, 168, 1, 5], 80).into()).map_err(|(status, _)| status.as_u16())
    }

    #[test]
    fn on_the_loopback_the_host_and_the_origin_have_to_be_ours() {
        let rules = Rules::new(([127, 0, 0, 1], 80).into(), None, false).unwrap();
        assert_eq!(rules.query(), "");
        let own = ("host", "localhost:80");
        assert_eq!(status(&rules, "/", &[own]), Ok(Admitted::Request));
        assert_eq!(status(&rules, "/ws", &[own, ("origin", "http://localhost:80")]), Ok(Admitted::Request));
        for origin in [
            "http://evil.example",
            "https://localhost:80",
            "null",
            "http://localhost:81",
            "http://127.0.0.1:80",
        ] {
            assert_eq!(status(&rules, "/ws", &[own, ("origin", origin)]), Err(403), "{origin}");
        }
        let both = [own, ("origin", "http://localhost:80"), ("origin", "http://evil.example")];
        assert_eq!(status(&rules, "/ws", &both), Err(403));
        assert_eq!(status(&rules, "/", &[]), Err(421));
        assert_eq!(status(&rules, "/", &[("host", "evil.example")]), Err(421));
        assert_eq!(status(&rules, "/", &[own, ("host", "evil.example")]), Err(421));
    }

    #[test]
    fn on_the_network_there_is_a_token_too() {
        let rules = Rules::new(([192, 168, 1, 5], 80).into(), Some("press1".into()), false).unwrap();
        let query = rules.query();
        assert_eq!(query.len(), "?token=".len() + 2 * TOKEN);
        let own = ("host", "press1:80");
        let Ok(Admitted::Keep(cookie)) = status(&rules, &format!("/{query}"), &[own]) else {
            panic!("refused")
        };
        assert!(cookie.ends_with("; Path=/; HttpOnly; SameSite=Strict"), "{cookie}");
        let kept = cookie.split(';').next().unwrap();
        let others = format!("a=b; {kept}; c");
        assert_eq!(status(&rules, "/ws", &[own, ("cookie", &others)]), Ok(Admitted::Request));
        let wrong = "fieldbeat-80=".to_owned() + &"0".repeat(2 * TOKEN);
        for cookie in ["", "fieldbeat-80=", "fieldbeat-80", &wrong, &kept[..kept.len() - 1]] {
            assert_eq!(status(&rules, "/", &[own, ("cookie", cookie)]), Err(401), "{cookie}");
        }
        assert_eq!(status(&rules, "/?token=", &[own]), Err(401));
        assert_eq!(status(&rules, "/?token=00", &[own]), Err(401));
        // The token alone does not do.
        assert_eq!(status(&rules, &format!("/{query}"), &[("host", "evil.example")]), Err(421));
        // Whoever may command the machine has one on the loopback as well.
        let commands = Rules::new(([127, 0, 0, 1], 80).into(), None, true).unwrap();
        assert_eq!(status(&commands, "/", &[("host", "localhost")]), Err(401));
        let other = Rules::new(([192, 168, 1, 5], 80).into(), None, false).unwrap();
        assert_ne!(other.query(), query);
    }
}
