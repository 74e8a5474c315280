//! Clients of a small server that have not said all yet, or have not taken all of an answer: one thread for all of
//! them, bounded in their number, bytes and time. Whoever is silent delays nobody; nothing of any protocol.

use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::time::{Duration, Instant};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::resource::{Resource, getrlimit};

/// The most clients of one server at a time.
const MOST: usize = 64;

/// The number taken in before the others are looked at again: the kernel's queue holds 128 by default.
const MOST_AT_ONCE: usize = 256;

/// The number of descriptors that stay free for the program itself: connections to drives that are opened again, files
/// of the black box, a report.
const RESERVED: u64 = 64;

/// After a refusal of the kernel to hand one over.
const PAUSE: Duration = Duration::from_millis(50);

/// A stream that can be set not to wait.
pub trait Stream: Read + Write + AsFd {
    /// See `TcpStream::set_nonblocking`.
    fn set_nonblocking(&self, nonblocking: bool) -> io::Result<()>;
}

impl Stream for std::net::TcpStream {
    fn set_nonblocking(&self, nonblocking: bool) -> io::Result<()> {
        self.set_nonblocking(nonblocking)
    }
}

impl Stream for std::os::unix::net::UnixStream {
    fn set_nonblocking(&self, nonblocking: bool) -> io::Result<()> {
        self.set_nonblocking(nonblocking)
    }
}

/// One client.
#[derive(Debug)]
pub struct Client<S> {
    /// It never waits.
    pub stream: S,
    /// The bytes that it has sent so far.
    pub said: Vec<u8>,
    /// The rest of its answer; empty while it sends.
    answer: Vec<u8>,
    until: Instant,
    is_whole: bool,
}

/// The clients of a server, the oldest first.
#[derive(Debug)]
pub struct Clients<S> {
    clients: Vec<Client<S>>,
    most: usize,
    /// Of a request, and again of an answer.
    patience: Duration,
    /// Bytes of a request.
    longest: usize,
}

impl<S: Stream> Clients<S> {
    /// None yet. A request has at most `longest` bytes and comes within `patience`; so is its answer taken.
    pub fn new(patience: Duration, longest: usize) -> Clients<S> {
        Clients { clients: Vec::new(), most: MOST, patience, longest }
    }

    /// Waits at most `timeout` for something to happen, then takes in whom `accept` returns and what they say. Returns
    /// those whose request is whole as `is_whole` sees it, has no room, or has ended.
    pub fn turn(
        &mut self,
        listener: BorrowedFd<'_>,
        timeout: Duration,
        accept: impl Fn() -> io::Result<S>,
        is_whole: impl Fn(&[u8]) -> bool,
    ) -> Vec<Client<S>> {
        let now = Instant::now();
        let next = self.clients.iter().map(|client| client.until).min();
        let timeout = next.map_or(timeout, |next| timeout.min(next.saturating_duration_since(now)));
        let mut fds = vec![PollFd::new(listener, PollFlags::POLLIN)];
        fds.extend(self.clients.iter().map(|client| {
            let events = if client.answer.is_empty() { PollFlags::POLLIN } else { PollFlags::POLLOUT };
            PollFd::new(client.stream.as_fd(), events)
        }));
        // Rounded up, so that it does not spin through the last millisecond.
        let ms = u16::try_from(timeout.as_millis() + 1).unwrap_or(u16::MAX);
        let _ = poll(&mut fds, PollTimeout::from(ms));
        let has_new = fds[0].revents().is_some_and(|events| !events.is_empty());
        drop(fds);

        let longest = self.longest;
        let mut whole = Vec::new();
        for mut client in std::mem::take(&mut self.clients) {
            match client.go_on(longest, &is_whole) {
                Ok(()) if client.is_whole => whole.push(client),
                Ok(()) if client.until > Instant::now() => self.clients.push(client),
                // Its time is over, or it is gone, or it has taken all.
                _ => {}
            }
        }
        for _ in 0..if has_new { MOST_AT_ONCE } else { 0 } {
            match accept() {
                Ok(stream) => {
                    if is_beyond_reserve(&stream) {
                        self.drop_oldest();
                        continue;
                    }
                    let until = Instant::now() + self.patience;
                    let (said, answer) = (Vec::new(), Vec::new());
                    let mut client = Client { stream, said, answer, until, is_whole: false };
                    if client.stream.set_nonblocking(true).is_err() {
                        continue;
                    }
                    // Most have said all by now.
                    match client.go_on(longest, &is_whole) {
                        Ok(()) if client.is_whole => whole.push(client),
                        Ok(()) => self.admit(client),
                        Err(_) => {}
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                // The client went away before it was taken in.
                Err(error)
                    if matches!(error.kind(), ErrorKind::ConnectionAborted | ErrorKind::Interrupted) => {}
                // The listener was shut down: its server ends.
                Err(error) if error.kind() == ErrorKind::InvalidInput => break,
                // No descriptor or no memory, perhaps: room is made, and the kernel is called again later.
                Err(_) => {
                    if !self.drop_oldest() {
                        std::thread::sleep(PAUSE);
                    }
                    break;
                }
            }
        }
        whole
    }

    /// Gives `client` its answer, as far as it takes it now; the rest follows.
    pub fn answer(&mut self, mut client: Client<S>, answer: Vec<u8>) {
        (client.answer, client.is_whole) = (answer, false);
        client.until = Instant::now() + self.patience;
        if client.go_on(0, &|_| false).is_ok() {
            self.admit(client);
        }
    }

    /// The oldest of those that are silent makes room; only then one that takes its answer.
    fn admit(&mut self, client: Client<S>) {
        if self.clients.len() >= self.most {
            self.drop_oldest();
        }
        self.clients.push(client);
    }

    fn drop_oldest(&mut self) -> bool {
        let silent = self.clients.iter().position(|client| client.answer.is_empty());
        let oldest = silent.or(if self.clients.is_empty() { None } else { Some(0) });
        oldest.map(|oldest| self.clients.remove(oldest)).is_some()
    }
}

impl<S: Stream> Client<S> {
    /// Reads or writes what can be without waiting. An error: it is done with.
    fn go_on(&mut self, longest: usize, is_whole: &impl Fn(&[u8]) -> bool) -> io::Result<()> {
        loop {
            let done = if self.answer.is_empty() {
                let mut bytes = [0; 4096];
                let room = bytes.len().min(longest - self.said.len());
                self.stream.read(&mut bytes[..room]).map(|count| {
                    self.said.extend_from_slice(&bytes[..count]);
                    self.is_whole = count == 0 || self.said.len() == longest || is_whole(&self.said);
                    self.is_whole
                })
            } else {
                self.stream.write(&self.answer).map(|count| {
                    self.answer.drain(..count);
                    self.answer.is_empty()
                })
            };
            match done {
                Ok(true) if self.is_whole => return Ok(()),
                Ok(true) => return Err(ErrorKind::NotConnected.into()),
                Ok(false) => {}
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(error) => return Err(error),
            }
        }
    }
}

/// Whether it has one of the last descriptors that this process may open: the kernel hands out the lowest free number.
fn is_beyond_reserve(stream: &impl AsFd) -> bool {
    let number = u64::try_from(stream.as_fd().as_raw_fd()).unwrap_or(0);
    let limit = getrlimit(Resource::RLIMIT_NOFILE).map_or(u64::MAX, |(soft, _)| soft);
    // Where the limit is that low, half of it is.
    number >= limit - RESERVED.min(limit / 2)
}

#[cfg(test)]
mod tests {
    use std::os::unix::net::{UnixListener, UnixStream};

    use fieldbeat_testing::until;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    /// A server of lines in a directory of its own.
    struct Rig {
        _directory: tempfile::TempDir,
        path: std::path::PathBuf,
        listener: UnixListener,
        clients: Clients<UnixStream>,
    }

    impl Rig {
        fn new(patience: Duration) -> Rig {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("a.sock");
            let listener = UnixListener::bind(&path).unwrap();
            listener.set_nonblocking(true).unwrap();
            Rig { _directory: directory, path, listener, clients: Clients::new(patience, 16) }
        }

        fn connect(&self) -> UnixStream {
            UnixStream::connect(&self.path).unwrap()
        }

        fn whole(&mut self, wait: Duration) -> Vec<Client<UnixStream>> {
            let accept = || self.listener.accept().map(|(stream, _)| stream);
            self.clients.turn(self.listener.as_fd(), wait, accept, |said| said.ends_with(b"\n"))
        }

        fn turn(&mut self) -> Vec<String> {
            let whole = self.whole(Duration::ZERO).into_iter();
            whole.map(|client| String::from_utf8(client.said).unwrap()).collect()
        }
    }

    #[test]
    fn the_oldest_silent_client_makes_room_and_one_that_speaks_is_served() {
        let mut rig = Rig::new(LONG);
        let mut silent: Vec<UnixStream> = Vec::new();
        for _ in 0..3 * MOST {
            silent.push(rig.connect());
            assert!(rig.turn().is_empty());
        }
        assert_eq!(rig.clients.clients.len(), MOST);
        let mut client = rig.connect();
        client.write_all(b"status\n").unwrap();
        assert_eq!(rig.turn(), ["status\n"]);
        // The newest are still there, the oldest were hung up on.
        let mut bytes = [0; 1];
        assert_eq!(silent[0].read(&mut bytes).unwrap(), 0);
        silent.last_mut().unwrap().write_all(b"late\n").unwrap();
        assert_eq!(rig.turn(), ["late\n"]);
    }

    #[test]
    fn a_request_in_pieces_without_end_or_cut_off_comes_back_once_and_patience_ends() {
        let mut rig = Rig::new(LONG);
        let mut pieces = rig.connect();
        for (piece, whole) in [(&b"sta"[..], &[][..]), (b"tus", &[]), (b"\n", &["status\n"])] {
            pieces.write_all(piece).unwrap();
            assert_eq!(rig.turn(), whole);
        }
        rig.connect().write_all(&[b'x'; 100]).unwrap();
        assert_eq!(rig.turn(), ["x".repeat(16)]);
        rig.connect().write_all(b"half").unwrap();
        assert_eq!(rig.turn(), ["half"]);
        assert!(rig.clients.clients.is_empty());
        let mut rig = Rig::new(Duration::ZERO);
        let mut slow = rig.connect();
        assert!(rig.turn().is_empty() && rig.turn().is_empty());
        assert!(rig.clients.clients.is_empty());
        assert_eq!(slow.read(&mut [0; 1]).unwrap(), 0);
    }

    #[test]
    fn an_answer_that_does_not_fit_into_the_socket_follows_piece_by_piece() {
        let mut rig = Rig::new(LONG);
        let mut client = rig.connect();
        client.write_all(b"\n").unwrap();
        let request = rig.whole(LONG).remove(0);
        let answer: Vec<u8> = (0..4_000_000_u32).map(|index| (index % 251) as u8).collect();
        rig.clients.answer(request, answer.clone());
        assert_eq!(rig.clients.clients.len(), 1, "all of it at once");
        let reader = std::thread::spawn(move || {
            let mut taken = Vec::new();
            client.read_to_end(&mut taken).unwrap();
            taken
        });
        until("all of it is there", || rig.turn().is_empty() && rig.clients.clients.is_empty());
        assert!(reader.join().unwrap() == answer);
    }
}
