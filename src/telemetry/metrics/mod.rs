//! The numbers of a running machine for Prometheus and everything that reads its text format, over HTTP.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the endpoint: a listener, and a few threads that answer one request a connection |
//! | `page` | what they answer |
//!
//! The threads are normal ones, off the loop's core. A client that is slow, or says nothing, has one of them for at
//! most [`PATIENCE`]; whoever comes meanwhile waits in the kernel's queue. So neither time nor memory can be taken from
//! anybody but other clients.

mod page;

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsRawFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use thiserror::Error;

use crate::rt;
use crate::telemetry::Monitor;

/// How many clients are served at once.
const THREADS: usize = 4;

/// A client has so long to ask and to take its answer.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// Bytes of a request. Those of Prometheus have 300.
const MOST_BYTES: usize = 4096;

/// Header lines of a request.
const MOST_HEADERS: usize = 64;

/// What the library writes is OpenMetrics, which Prometheus requests first.
const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Why there is no endpoint. The message ends with the remedy.
#[derive(Error)]
pub enum MetricsError {
    /// The address is not to be had.
    #[error("metrics address {address}: {error}; {}", remedy(.error))]
    Bind {
        /// The address.
        address: SocketAddr,
        /// What the operating system said.
        error: io::Error,
    },
    /// No thread.
    #[error(
        "cannot start a thread for the metrics: {0}; raise the limits of processes and memory (ulimit -u, ulimit -v)"
    )]
    Thread(io::Error),
}
crate::errors::debug_as_display!(MetricsError);

fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::AddrInUse => "another program listens there (ss -ltnp shows which): use another port",
        io::ErrorKind::AddrNotAvailable => "use an address of this computer (ip address shows them)",
        io::ErrorKind::PermissionDenied => "ports below 1024 need CAP_NET_BIND_SERVICE: use a higher one",
        _ => "use another address",
    }
}

/// An address as on a command line: a port alone is one of the loopback, which only this computer reaches.
pub fn address(text: &str) -> Result<SocketAddr, String> {
    let port = text.strip_prefix(':').unwrap_or(text);
    match (port.parse(), text.parse()) {
        (Ok(port), _) => Ok((Ipv4Addr::LOCALHOST, port).into()),
        (_, Ok(address)) => Ok(address),
        _ => Err(String::from(
            "must be a port like 9464, or an address and a port like 192.168.1.1:9464 or [::1]:9464",
        )),
    }
}

/// An address that is ours.
#[derive(Debug)]
pub struct Endpoint {
    listener: TcpListener,
    address: SocketAddr,
}

impl Endpoint {
    /// Takes the address; whoever connects waits until it is served.
    pub fn bind(address: SocketAddr) -> Result<Endpoint, MetricsError> {
        let failed = |error| MetricsError::Bind { address, error };
        let listener = TcpListener::bind(address).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Endpoint { listener, address })
    }

    /// The address, with the port that the kernel chose for port 0.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers with the numbers of a machine.
    pub fn serve(self, monitor: Monitor) -> Result<Server, MetricsError> {
        let shared = Arc::new(Shared { listener: self.listener, end: AtomicBool::new(false) });
        let server = Server(Arc::clone(&shared));
        for _ in 0..THREADS {
            let (shared, monitor) = (Arc::clone(&shared), monitor.clone());
            let serve = move || {
                rt::thread::helper_thread(monitor.granted().core);
                shared.serve(&|| page::page(&monitor));
            };
            let thread = std::thread::Builder::new().name("fb-metrics".into());
            thread.spawn(serve).map_err(MetricsError::Thread)?;
        }
        Ok(server)
    }
}

/// A served endpoint. Dropped, it is closed; an answer that is under way is still given.
#[derive(Debug)]
pub struct Server(Arc<Shared>);

impl Drop for Server {
    fn drop(&mut self) {
        self.0.end.store(true, Ordering::Release);
        // Ends every wait in accept(2); Linux does so, and only here is it relied on. Its result is
        // not needed.
        let _ = nix::sys::socket::shutdown(self.0.listener.as_raw_fd(), nix::sys::socket::Shutdown::Both);
    }
}

#[derive(Debug)]
struct Shared {
    listener: TcpListener,
    end: AtomicBool,
}

impl Shared {
    /// Serves one client after the other.
    fn serve(&self, page: &dyn Fn() -> String) {
        while !self.end.load(Ordering::Acquire) {
            match self.listener.accept() {
                // A client that went away is its own affair.
                Ok((stream, _)) => drop(answer(stream, page)),
                // Too many open files, say: it may pass, and until then there is nothing to do.
                Err(_) => std::thread::sleep(Duration::from_millis(100)),
            }
        }
    }
}

/// Reads a request and answers it, all within [`PATIENCE`].
fn answer(mut stream: TcpStream, page: &dyn Fn() -> String) -> io::Result<()> {
    let until = Instant::now() + PATIENCE;
    let left = || {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() { Err(io::Error::from(io::ErrorKind::TimedOut)) } else { Ok(Some(left)) }
    };
    let mut bytes = [0; MOST_BYTES];
    let mut length = 0;
    let (status, body) = loop {
        stream.set_read_timeout(left()?)?;
        match stream.read(&mut bytes[length..])? {
            0 => return Ok(()),
            more => length += more,
        }
        match asked(&bytes[..length]) {
            None => {}
            Some(Asked::Page) => break ("200 OK", page()),
            Some(Asked::Head) => break ("200 OK", String::new()),
            Some(Asked::Refused(status)) => {
                break (status, format!("{status}; the metrics are at GET /metrics\n"));
            }
        }
    };
    let kind = if status.starts_with("200") { CONTENT_TYPE } else { "text/plain; charset=utf-8" };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    for part in [head, body] {
        let mut rest = part.as_bytes();
        while !rest.is_empty() {
            stream.set_write_timeout(left()?)?;
            rest = &rest[stream.write(rest)?..];
        }
    }
    stream.shutdown(Shutdown::Write)
}

/// What is requested.
#[derive(Debug, PartialEq)]
enum Asked {
    Page,
    /// Whether there is one.
    Head,
    Refused(&'static str),
}

/// `None` as long as its end is missing.
fn asked(bytes: &[u8]) -> Option<Asked> {
    let mut headers = [httparse::EMPTY_HEADER; MOST_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    match request.parse(bytes) {
        Ok(httparse::Status::Partial) if bytes.len() < MOST_BYTES => return None,
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
            return Some(Asked::Refused("431 Request Header Fields Too Large"));
        }
        Ok(httparse::Status::Complete(_)) => {}
        Err(_) => return Some(Asked::Refused("400 Bad Request")),
    }
    let path = request.path.unwrap_or_default().split('?').next();
    Some(match (request.method, path) {
        (_, path) if path != Some("/metrics") => Asked::Refused("404 Not Found"),
        (Some("GET"), _) => Asked::Page,
        (Some("HEAD"), _) => Asked::Head,
        _ => Asked::Refused("405 Method Not Allowed"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_alone_is_for_this_computer_only() {
        let loopback = SocketAddr::from((Ipv4Addr::LOCALHOST, 9464));
        assert_eq!([address("9464"), address(":9464")], [Ok(loopback), Ok(loopback)]);
        assert_eq!(address("0.0.0.0:1"), Ok(SocketAddr::from((Ipv4Addr::UNSPECIFIED, 1))));
        assert!(address("[::1]:9464").is_ok_and(|address| address.is_ipv6()));
        for wrong in ["", ":", "65536", "0.0.0.0", "localhost:9464", "::1:9464x"] {
            assert!(address(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_request_is_judged_when_it_is_whole() {
        let get = b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n";
        for end in 0..get.len() {
            assert_eq!(asked(&get[..end]), None, "{end}");
        }
        assert_eq!(asked(get), Some(Asked::Page));
        assert_eq!(asked(b"GET /metrics?x=1 HTTP/1.0\r\n\r\n"), Some(Asked::Page));
        assert_eq!(asked(b"HEAD /metrics HTTP/1.1\r\n\r\n"), Some(Asked::Head));
        let refused = |bytes: &[u8]| match asked(bytes) {
            Some(Asked::Refused(status)) => status[..3].to_owned(),
            other => panic!("{other:?}"),
        };
        assert_eq!(refused(b"POST /metrics HTTP/1.1\r\n\r\n"), "405");
        assert_eq!(refused(b"GET / HTTP/1.1\r\n\r\n"), "404");
        assert_eq!(refused(b"\x16\x03\x01\x02\x00\x01\x00"), "400");
        assert_eq!(refused(&[b'G'; MOST_BYTES]), "431");
        let many = format!("GET /metrics HTTP/1.1\r\n{}\r\n", "a: b\r\n".repeat(MOST_HEADERS + 1));
        assert_eq!(refused(many.as_bytes()), "431");
    }

    /// Everything that `client` says, answered by a thread; what came back.
    fn talk(client: impl FnOnce(&mut TcpStream)) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let thread = std::thread::spawn(move || {
            let _ = answer(listener.accept().unwrap().0, &|| String::from("# EOF\n"));
        });
        client(&mut stream);
        let mut text = String::new();
        let _ = stream.read_to_string(&mut text);
        thread.join().unwrap();
        text
    }

    #[test]
    fn a_request_in_pieces_is_answered_once() {
        let text = talk(|stream| {
            for piece in [&b"GET /met"[..], b"rics HTTP/1.1\r\nHost", b": x\r\n\r\n"] {
                stream.write_all(piece).unwrap();
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        assert!(text.starts_with("HTTP/1.1 200 OK\r\n") && text.ends_with("\r\n\r\n# EOF\n"), "{text}");
        assert!(text.contains("Content-Length: 6\r\n"), "{text}");
    }

    #[test]
    fn a_client_that_goes_away_gets_nothing() {
        assert_eq!(talk(|stream| stream.shutdown(Shutdown::Write).unwrap()), "");
    }
}
