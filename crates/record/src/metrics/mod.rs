//! The numbers of a running machine for Prometheus and everything that reads its text format, over HTTP.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the endpoint: a listener, and a thread that answers one request a connection |
//! | `host` | for whom a request was meant |
//! | `page` | what it answers |
//! | `form` | in which of its two forms |
//!
//! The thread is a normal one, off the loop's core, and waits for no client: `Clients` bounds their number, bytes and
//! time. A client that is slow, or says nothing, delays nobody.

mod form;
pub mod host;
mod page;

use std::io;
use std::net::{Ipv4Addr, SocketAddr, TcpListener, ToSocketAddrs};
use std::os::fd::{AsFd, AsRawFd};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use thiserror::Error;

use self::form::Form;
use self::host::{Meant, Names};
use fieldbeat_core::errors::no_descriptor;
use fieldbeat_core::net::clients::Clients;
use fieldbeat_core::rt;
use fieldbeat_telemetry::Monitor;

/// How often the thread looks whether it is to end, at least: a client and the end wake it up at once.
const LOOK_EVERY: Duration = Duration::from_secs(60);

/// A client has so long to send its request and to take its answer.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// Bytes of a request. Those of Prometheus have 300.
const MOST_BYTES: usize = 4096;

/// Header lines of a request.
const MOST_HEADERS: usize = 64;

/// Why there is no endpoint. The message ends with the remedy.
#[derive(Error)]
pub enum MetricsError {
    /// The address is not to be had.
    #[error("metrics address {address}: {error}; {}", remedy(.error))]
    Bind {
        /// The address.
        address: SocketAddr,
        /// The error of the operating system.
        error: io::Error,
    },
    /// No thread.
    #[error(
        "cannot start a thread for the metrics: {0}; raise the limits of processes and memory (ulimit -u, \
         ulimit -v)"
    )]
    Thread(io::Error),
}
fieldbeat_core::debug_as_display!(MetricsError);

/// The remedy for an address that cannot be had.
pub fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AddrInUse => "another program listens there (ss -ltnp shows which): use another port",
        io::ErrorKind::AddrNotAvailable => "use an address of this computer (ip address shows them)",
        io::ErrorKind::PermissionDenied => "ports below 1024 need CAP_NET_BIND_SERVICE: use a higher one",
        _ => no_descriptor(error).unwrap_or("use another address"),
    }
}

/// Where the endpoint listens, and the name that clients may use for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Address {
    /// Where it listens.
    pub socket: SocketAddr,
    /// A name of this computer, if one was given instead of an address.
    pub name: Option<String>,
}

/// Why a text is no address of this computer.
#[derive(Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{}must be a port like 9464, or an address or a name of this computer and a port like 192.168.1.1:9464, \
     [::1]:9464 or press1:9464", .0.as_ref().map_or(String::new(), |why| format!("{why}; "))
)]
pub struct NotAnAddress(Option<String>);
fieldbeat_core::debug_as_display!(NotAnAddress);

/// An address as on a command line: a port alone is one of the loopback, which only this computer reaches.
pub fn address(text: &str) -> Result<Address, NotAnAddress> {
    let port = text.strip_prefix(':').unwrap_or(text);
    if let Ok(port) = port.parse::<u16>() {
        return Ok(Address { socket: (Ipv4Addr::LOCALHOST, port).into(), name: None });
    }
    if let Ok(socket) = text.parse::<SocketAddr>() {
        return Ok(Address { socket, name: None });
    }
    let name = text.rsplit_once(':').map(|(name, _)| name).filter(|name| host::is_name(name));
    let name = name.ok_or(NotAnAddress(None))?;
    let unknown = |why: String| NotAnAddress(Some(why));
    let mut found = text.to_socket_addrs().map_err(|error| unknown(format!("{name}: {error}")))?;
    let socket = found.next().ok_or_else(|| unknown(format!("{name} has no address")))?;
    Ok(Address { socket, name: Some(name.to_owned()) })
}

/// An address that is ours.
#[derive(Debug)]
pub struct Endpoint {
    listener: TcpListener,
    address: SocketAddr,
    names: Names,
}

impl Endpoint {
    /// Takes the address; whoever connects waits until it is served.
    pub fn bind(address: SocketAddr) -> Result<Endpoint, MetricsError> {
        let failed = |error| MetricsError::Bind { address, error };
        let listener = TcpListener::bind(address).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Endpoint { listener, address, names: Names::default() })
    }

    /// Clients may use this name for it, too. Without it they use the address, `localhost` or the name of this
    /// computer; whatever was meant for another host is refused.
    pub fn named(mut self, name: String) -> Endpoint {
        self.names.add(name);
        self
    }

    /// The address, with the port that the kernel chose for port 0.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers with the numbers of a machine.
    pub fn serve(self, monitor: Monitor) -> Result<Server, MetricsError> {
        let shared =
            Arc::new(Shared { listener: self.listener, names: self.names, end: AtomicBool::new(false) });
        let server = Server(Arc::clone(&shared));
        let serve = move || {
            rt::thread::helper_thread(monitor.granted().core);
            // Without filters the page is served all the same; the start and the doctor say so.
            let _ = rt::confine::serve_only(rt::confine::Server::Metrics);
            shared.serve(&|| page::page(&monitor), &|| {
                monitor.failed(
                    "internal error: the page for Prometheus panicked; the run goes on; please report it",
                    false,
                );
            });
        };
        std::thread::Builder::new().name("fb-metrics".into()).spawn(serve).map_err(MetricsError::Thread)?;
        Ok(server)
    }
}

/// A served endpoint. Dropped, it is closed.
#[derive(Debug)]
pub struct Server(Arc<Shared>);

impl Drop for Server {
    fn drop(&mut self) {
        self.0.end.store(true, Ordering::Release);
        // Ends every wait for the listener; Linux does so, and only here is it relied on. Its result is not needed.
        let _ = nix::sys::socket::shutdown(self.0.listener.as_raw_fd(), nix::sys::socket::Shutdown::Both);
    }
}

#[derive(Debug)]
struct Shared {
    listener: TcpListener,
    names: Names,
    end: AtomicBool,
}

impl Shared {
    /// Serves all clients; `failed` is called where a page panicked.
    fn serve(&self, page: &dyn Fn() -> String, failed: &dyn Fn()) {
        let mut clients = Clients::new(PATIENCE, MOST_BYTES);
        while !self.end.load(Ordering::Acquire) {
            let accept = || self.listener.accept().map(|(stream, _)| stream);
            let is_whole = |said: &[u8]| requested(said, &|_| true).is_some();
            for client in clients.turn(self.listener.as_fd(), LOOK_EVERY, accept, is_whole) {
                let Ok(local) = client.stream.local_addr() else { continue };
                let meant = |host: Meant<'_>| self.names.are_ours(host, local.ip());
                // Cut off, it is nobody's request.
                let Some(request) = requested(&client.said, &meant) else { continue };
                match catch_unwind(AssertUnwindSafe(|| answer(&request, page))) {
                    Ok(bytes) => clients.answer(client, bytes),
                    Err(_) => failed(),
                }
            }
        }
    }
}

/// The whole answer.
fn answer(request: &Requested, page: &dyn Fn() -> String) -> Vec<u8> {
    const PLAIN: &str = "text/plain; charset=utf-8";
    let (status, kind, body) = match request {
        Requested::Page(form) => ("200 OK", form.content_type(), form.of(page())),
        Requested::Head(form) => ("200 OK", form.content_type(), String::new()),
        Requested::Refused(status) => {
            (*status, PLAIN, format!("{status}; the metrics are at GET /metrics\n"))
        }
        Requested::Misdirected => (FORBIDDEN, PLAIN, format!("{FORBIDDEN}; {REMEDY}\n")),
    };
    let length = body.len();
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
    );
    (head + &body).into_bytes()
}

const FORBIDDEN: &str = "403 Forbidden";

/// The remedy.
const REMEDY: &str = "the Host of the request is no name of this endpoint: use its address, localhost or the \
     name of this computer, or start with --metrics NAME:PORT";

/// The kind of request.
#[derive(Debug, PartialEq)]
enum Requested {
    Page(Form),
    /// Whether there is one.
    Head(Form),
    Refused(&'static str),
    /// It was meant for another host: a page from elsewhere whose name was bound to this address (DNS rebinding).
    Misdirected,
}

/// `None` as long as its end is missing. `is_ours`: whether it was meant for this endpoint.
fn requested(bytes: &[u8], is_ours: &dyn Fn(Meant<'_>) -> bool) -> Option<Requested> {
    let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Partial) if bytes.len() < MOST_BYTES => return None,
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
            return Some(Requested::Refused("431 Request Header Fields Too Large"));
        }
        Ok(httparse::Status::Complete(_)) => {}
        Err(_) => return Some(Requested::Refused("400 Bad Request")),
    }
    let mut hosts = request.headers.iter().filter(|header| header.name.eq_ignore_ascii_case("host"));
    let accepted = request.headers.iter().filter(|header| header.name.eq_ignore_ascii_case("accept"));
    let form = Form::of_accepted(accepted.map(|header| header.value));
    let path = request.path.unwrap_or_default().split('?').next();
    Some(match (hosts.next(), hosts.next()) {
        // RFC 9112, 3.2: exactly one, but HTTP/1.0 has none.
        (None, _) if request.version == Some(1) => Requested::Refused("400 Bad Request"),
        (_, Some(_)) => Requested::Refused("400 Bad Request"),
        (Some(host), None) if !Meant::parse(host.value).is_some_and(is_ours) => Requested::Misdirected,
        _ => match request.method {
            _ if path != Some("/metrics") => Requested::Refused("404 Not Found"),
            Some("GET") => Requested::Page(form),
            Some("HEAD") => Requested::Head(form),
            _ => Requested::Refused("405 Method Not Allowed"),
        },
    })
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::{Shutdown, TcpStream};
    use std::sync::atomic::AtomicU32;

    use super::*;

    #[test]
    fn a_port_alone_is_for_this_computer_only() {
        let of = |ip: Ipv4Addr, port| Ok(Address { socket: (ip, port).into(), name: None });
        assert_eq!([address("9464"), address(":9464")], [(); 2].map(|()| of(Ipv4Addr::LOCALHOST, 9464)));
        assert_eq!(address("0.0.0.0:1"), of(Ipv4Addr::UNSPECIFIED, 1));
        assert!(
            address("[::1]:9464").is_ok_and(|address| address.socket.is_ipv6() && address.name.is_none())
        );
        let named = address("localhost:9464").unwrap();
        assert!(named.socket.ip().is_loopback() && named.name.as_deref() == Some("localhost"), "{named:?}");
        for wrong in ["", ":", "65536", "0.0.0.0", "localhost:", "::1:9464x", "a b:9464"] {
            assert!(address(wrong).is_err(), "{wrong}");
        }
    }

    fn judged(bytes: &[u8]) -> Option<Requested> {
        requested(bytes, &|host| host.name == "x")
    }

    #[test]
    fn a_request_is_judged_when_it_is_whole() {
        let get = b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n";
        for end in 0..get.len() {
            assert_eq!(judged(&get[..end]), None, "{end}");
        }
        assert_eq!(judged(get), Some(Requested::Page(Form::Text)));
        assert_eq!(judged(b"GET /metrics?x=1 HTTP/1.0\r\n\r\n"), Some(Requested::Page(Form::Text)));
        assert_eq!(judged(b"HEAD /metrics HTTP/1.1\r\nhost:x:1\r\n\r\n"), Some(Requested::Head(Form::Text)));
        let wanted = b"GET /metrics HTTP/1.1\r\nHost: x\r\naccept: application/openmetrics-text\r\n\r\n";
        assert_eq!(judged(wanted), Some(Requested::Page(Form::OpenMetrics)));
        let refused = |bytes: &[u8]| match judged(bytes) {
            Some(Requested::Refused(status)) => status[..3].to_owned(),
            other => panic!("{other:?}"),
        };
        assert_eq!(refused(b"POST /metrics HTTP/1.1\r\nHost: x\r\n\r\n"), "405");
        assert_eq!(refused(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"), "404");
        assert_eq!(refused(b"\x16\x03\x01\x02\x00\x01\x00"), "400");
        assert_eq!(refused(b"GET /metrics HTTP/1.1\r\n\r\n"), "400");
        assert_eq!(refused(b"GET /metrics HTTP/1.1\r\nHost: x\r\nHost: x\r\n\r\n"), "400");
        assert_eq!(refused(&[b'G'; MOST_BYTES]), "431");
        let many = format!("GET /metrics HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(MOST_HEADERS + 1));
        assert_eq!(refused(many.as_bytes()), "431");
    }

    /// Everything that `client` says to a server whose page is `page`; what came back, and how many pages panicked.
    fn exchange(page: fn() -> String, client: impl FnOnce(&mut TcpStream)) -> (String, u32) {
        let endpoint = Endpoint::bind(SocketAddr::from((Ipv4Addr::LOCALHOST, 0))).unwrap();
        let mut stream = TcpStream::connect(endpoint.address()).unwrap();
        let Endpoint { listener, names, .. } = endpoint;
        let shared = Arc::new(Shared { listener, names, end: AtomicBool::new(false) });
        let server = Server(Arc::clone(&shared));
        let panics = Arc::new(AtomicU32::new(0));
        let counted = Arc::clone(&panics);
        let thread = std::thread::spawn(move || {
            shared.serve(&page, &|| {
                counted.fetch_add(1, Ordering::Relaxed);
            });
        });
        client(&mut stream);
        let mut text = String::new();
        let _ = stream.read_to_string(&mut text);
        drop(server);
        thread.join().unwrap();
        (text, panics.load(Ordering::Relaxed))
    }

    #[test]
    fn a_request_in_pieces_is_answered_once() {
        let (text, _) = exchange(
            || String::from("# UNIT x seconds\nx 1\n# EOF\n"),
            |stream| {
                for piece in [&b"GET /met"[..], b"rics HTTP/1.1\r\nHost", b": localhost\r\n\r\n"] {
                    stream.write_all(piece).unwrap();
                    std::thread::sleep(Duration::from_millis(5));
                }
            },
        );
        assert!(text.starts_with("HTTP/1.1 200 OK\r\n") && text.ends_with("\r\n\r\nx 1\n"), "{text}");
        assert!(text.contains("Content-Length: 4\r\n"), "{text}");
    }

    #[test]
    fn a_client_that_goes_away_gets_nothing() {
        let gone = |stream: &mut TcpStream| stream.shutdown(Shutdown::Write).unwrap();
        assert_eq!(exchange(String::new, gone), (String::new(), 0));
    }

    #[test]
    fn a_page_that_panics_is_counted_and_the_next_client_is_served() {
        let request = |stream: &mut TcpStream| stream.write_all(b"GET /metrics HTTP/1.0\r\n\r\n").unwrap();
        let panics = || std::panic::resume_unwind(Box::new("on purpose"));
        assert_eq!(exchange(panics, request), (String::new(), 1));
    }
}
