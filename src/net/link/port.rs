//! A serial port's life on the link thread: opened, handed to the loop, taken back, opened again after a pause. An
//! adapter may be unplugged at any time, and plugged in again.

use std::io;
use std::os::fd::OwnedFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::sync::Arc;

use nix::sys::epoll::EpollFlags;
use rtrb::{Consumer, Producer};

use super::thread::{Bell, Duty, Hand, LinkThread};
use crate::net::serial::{OpenPort, SerialLine};
use crate::net::stream::LinkNotes;
use crate::net::{local, tty};
use crate::rt::{self, MonotonicClock, Regions};
use crate::time::{MS, S, Time};

/// The pause after a first failure, ns; it doubles with each one in a row ...
const LEAST_PAUSE_NS: u64 = 100 * MS;
/// ... up to this. A port that was in use for so long begins with the least pause again.
const MOST_PAUSE_NS: u64 = 2 * S;

/// One port's life: a machine of state and time, without a descriptor, so that the link thread and a virtual world run
/// the same one.
#[derive(Debug)]
pub struct PortLife {
    path: String,
    phase: Phase,
    pause_ns: u64,
    notes: LinkNotes,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    Pausing { until: Time },
    Open { since: Time },
}

impl PortLife {
    /// A port that is to be opened now. The reason why it is not open goes to `notes` at index 0.
    pub fn new(now: Time, path: &str, notes: LinkNotes) -> PortLife {
        PortLife {
            path: path.to_owned(),
            phase: Phase::Pausing { until: now },
            pause_ns: LEAST_PAUSE_NS,
            notes,
        }
    }

    /// When it is to be opened; `None`: the loop has it.
    pub fn next_due(&self) -> Option<Time> {
        match self.phase {
            Phase::Pausing { until } => Some(until),
            Phase::Open { .. } => None,
        }
    }

    /// Whether it is to be opened now. Then [`opened`](Self::opened) or [`failed`](Self::failed).
    pub fn is_due(&self, now: Time) -> bool {
        self.next_due().is_some_and(|due| due <= now)
    }

    /// It is the loop's.
    pub fn opened(&mut self, now: Time) {
        self.phase = Phase::Open { since: now };
        self.notes.set(0, None);
    }

    /// It could not be opened.
    pub fn failed(&mut self, now: Time, why: String) {
        self.notes.set(0, Some(why));
        self.phase = Phase::Pausing { until: now + self.pause_ns };
        self.pause_ns = (2 * self.pause_ns).min(MOST_PAUSE_NS);
    }

    /// The loop gave it up, for this reason.
    pub fn given_back(&mut self, now: Time, why: &str) {
        let Phase::Open { since } = self.phase else { return };
        if now.since(since) >= MOST_PAUSE_NS {
            self.pause_ns = LEAST_PAUSE_NS;
        }
        self.failed(now, format!("serial port {} given up: {why}", self.path));
    }
}

/// The loop's side of a port. Its fields are dropped in order, as those of [`Ends`](super::Ends).
#[derive(Debug)]
pub(in crate::net) struct PortEnds {
    pub opened: Consumer<OpenPort>,
    pub given_back: Producer<(OpenPort, &'static str)>,
    pub notes: LinkNotes,
    /// The memory of the rings.
    pub regions: Regions,
    pub bell: Bell,
}

impl LinkThread {
    /// Begins to open port `path`, and keeps it open until the ends are dropped.
    pub fn carry_port(self: &Arc<Self>, path: &str, line: SerialLine) -> PortEnds {
        let mut regions = Regions::new();
        // The port is in one place at a time, so that neither ring is ever full.
        let (opened, ready) = rt::memory::ring(1, &mut regions);
        let (given_back, back) = rt::memory::ring(1, &mut regions);
        regions.add(&**self);
        regions.add(&**self.shared());
        let (now, notes) = (MonotonicClock::read(), LinkNotes::new(1));
        self.add(Box::new(Charge { life: PortLife::new(now, path, notes.clone()), line, opened, back }));
        PortEnds { opened: ready, given_back, notes, regions, bell: Bell::new(self) }
    }
}

/// The thread's side of a port.
#[derive(Debug)]
struct Charge {
    life: PortLife,
    line: SerialLine,
    opened: Producer<OpenPort>,
    back: Consumer<(OpenPort, &'static str)>,
}

impl Duty for Charge {
    fn next_due(&self) -> Option<Time> {
        self.life.next_due()
    }

    /// Only the loop watches a port.
    fn happened(&mut self, _index: usize, _events: EpollFlags, _hand: &mut Hand<'_>) {}

    fn turn(&mut self, _hand: &mut Hand<'_>) -> bool {
        let now = MonotonicClock::read();
        // Read first: a port returned before it disappeared is still closed in order.
        let gone = self.back.is_abandoned();
        while let Ok((port, why)) = self.back.pop() {
            port.reset();
            self.life.given_back(now, why);
        }
        if !gone && self.life.is_due(now) {
            match open(&self.life.path, &self.line) {
                Ok(port) => {
                    self.life.opened(now);
                    // Never full: see `carry_port`.
                    let _ = self.opened.push(port);
                }
                // By now: a driver may have taken its time.
                Err(error) => self.life.failed(MonotonicClock::read(), error.to_string()),
            }
        }
        !gone
    }
}

fn open(path: &str, line: &SerialLine) -> io::Result<OpenPort> {
    match local::name(path) {
        Some(name) => local_wire(name).map(|fd| OpenPort { fd, is_tty: false }),
        None => tty::open(path, line).map(|fd| OpenPort { fd, is_tty: true }),
    }
}

/// The address of a simulated wire of this host: no rights, nothing in the file system.
pub(crate) fn local_address(name: &str) -> io::Result<SocketAddr> {
    SocketAddr::from_abstract_name(format!("fieldbeat-serial/{name}"))
}

/// A connection to a simulated wire.
fn local_wire(name: &str) -> io::Result<OwnedFd> {
    let connected = local_address(name).and_then(|address| UnixStream::connect_addr(&address));
    let stream = connected.map_err(|error| match error.raw_os_error() {
        Some(libc::ECONNREFUSED) => {
            let message = format!("nobody simulates the wire {}{name}: start `fieldbeat sim`", local::PREFIX);
            io::Error::new(error.kind(), message)
        }
        _ => error,
    })?;
    stream.set_nonblocking(true)?;
    Ok(stream.into())
}
