//! One conversation: a line each way, within a time that the other side cannot prolong. Neither side trusts the other
//! to be quick, or to be itself.

use std::cell::Cell;
use std::io::{self, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use nix::sys::socket::{AddressFamily, SockFlag, SockType, UnixAddr, setsockopt, socket, sockopt};
use nix::sys::time::TimeVal;

/// How often a side that waits looks whether it is to go on.
pub const LOOK_EVERY: Duration = Duration::from_millis(50);

/// Handed to the kernel at once. It waits anew for each piece of a larger one, so that whoever takes them slowly would
/// prolong a single write(2).
const PIECE: usize = 16 << 10;

/// A side that has not looked for so long did not run: it was held, or its host had no time for it. The kernel lets
/// none wait longer than [`LOOK_EVERY`].
const ABSENT: Duration = Duration::from_millis(500);

/// A conversation that ends in time.
pub struct Exchange<'a> {
    stream: &'a UnixStream,
    until: Cell<Instant>,
    looked: Cell<Instant>,
    go_on: &'a dyn Fn() -> bool,
}

impl<'a> Exchange<'a> {
    /// All of it takes `patience` at most, and ends once `go_on` is false. While this side does not run itself, the
    /// other one owes nothing: what it has answered meanwhile is taken.
    pub fn new(
        stream: &'a UnixStream,
        patience: Duration,
        go_on: &'a dyn Fn() -> bool,
    ) -> io::Result<Exchange<'a>> {
        stream.set_read_timeout(Some(LOOK_EVERY))?;
        stream.set_write_timeout(Some(LOOK_EVERY))?;
        let now = Instant::now();
        Ok(Exchange { stream, until: Cell::new(now + patience), looked: Cell::new(now), go_on })
    }

    /// Everything up to the end of the line, of the stream, or of `most` bytes.
    pub fn line(&self, most: usize) -> io::Result<Vec<u8>> {
        let mut line = Vec::new();
        let mut bytes = [0; 4096];
        while line.len() < most && !line.ends_with(b"\n") {
            let room = bytes.len().min(most - line.len());
            match self.patiently(|mut stream| stream.read(&mut bytes[..room]))? {
                0 => break,
                // What follows a line is nobody's.
                count => {
                    line.extend(bytes[..count].split_inclusive(|byte| *byte == b'\n').next().unwrap_or(&[]))
                }
            }
        }
        Ok(line)
    }

    /// Says `text`.
    pub fn say(&self, text: &str) -> io::Result<()> {
        self.send(text.as_bytes())
    }

    /// Sends `bytes`.
    pub fn send(&self, bytes: &[u8]) -> io::Result<()> {
        let mut rest = bytes;
        while !rest.is_empty() {
            let piece = &rest[..rest.len().min(PIECE)];
            rest = &rest[self.patiently(|mut stream| stream.write(piece))?..];
        }
        Ok(())
    }

    fn patiently(&self, mut step: impl FnMut(&UnixStream) -> io::Result<usize>) -> io::Result<usize> {
        while (self.go_on)() && self.has_time() {
            match step(self.stream) {
                Err(error)
                    if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {}
                done => return done,
            }
        }
        Err(io::ErrorKind::TimedOut.into())
    }

    fn has_time(&self) -> bool {
        let now = Instant::now();
        let absent = now - self.looked.replace(now);
        if absent > ABSENT {
            self.until.set(self.until.get() + absent);
        }
        now < self.until.get()
    }
}

/// Connects within `patience`; that of the standard library waits for ever for a listener that takes nobody in.
pub fn connect(path: &Path, patience: Duration) -> io::Result<UnixStream> {
    let socket = socket(AddressFamily::Unix, SockType::Stream, SockFlag::SOCK_CLOEXEC, None)?;
    let patience = TimeVal::new(patience.as_secs() as i64, i64::from(patience.subsec_micros()));
    setsockopt(&socket, sockopt::SendTimeout, &patience)?;
    nix::sys::socket::connect(socket.as_raw_fd(), &UnixAddr::new(path)?)?;
    Ok(socket.into())
}

#[cfg(test)]
mod tests {
    use std::thread::sleep;

    use super::*;

    #[test]
    fn a_delayed_reader_takes_answers_of_meanwhile_and_a_trickling_sender_gains_no_time() {
        let patience = Duration::from_millis(200);
        let (ours, mut other) = UnixStream::pair().unwrap();
        other.write_all(b"an answer\n").unwrap();
        let held = Cell::new(false);
        let go_on = || {
            if !held.replace(true) {
                sleep(2 * ABSENT);
            }
            true
        };
        let exchange = Exchange::new(&ours, patience, &go_on).unwrap();
        assert_eq!(exchange.line(100).unwrap(), b"an answer\n");

        let trickles = std::thread::spawn(move || {
            while other.write_all(b"x").is_ok() {
                sleep(LOOK_EVERY / 2);
            }
        });
        let exchange = Exchange::new(&ours, patience, &|| true).unwrap();
        assert_eq!(exchange.line(1 << 20).unwrap_err().kind(), io::ErrorKind::TimedOut);
        drop(ours);
        trickles.join().unwrap();
    }
}
