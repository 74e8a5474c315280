//! Simulated drives and segments on real sockets: one thread waits for the requests of all of them.
//!
//! Each drive has sockets bound to its own addresses, so that the master reaches it as it would reach the real one:
//! datagram sockets, or a listening one and its connections. Each segment has a socket for its frames, and each serial
//! wire a port. Nothing here knows a protocol.
//!
//! | file | what |
//! |---|---|
//! | `sockets` | the sockets of a drive, and its connections |
//! | `segments` | a segment and its socket |
//! | `wires` | a serial wire and its port |
//! | `service` | the work of the thread |

mod segments;
mod service;
mod sockets;
#[cfg(test)]
mod tests;
mod wires;

use std::io;
use std::net::SocketAddrV4;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use nix::sys::eventfd::{EfdFlags, EventFd};

use self::service::{Service, Stats};
use super::Simulated;
use super::fault::Injected;
use fieldbeat_core::rt;

/// How the thread of a [`SimServer`] runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerOptions {
    /// The core that it is pinned to; not the loop's. Default: any.
    pub core: Option<usize>,
    /// Its SCHED_FIFO priority, 1 ... 99; below the loop's. Default: an ordinary thread.
    pub priority: Option<u8>,
}

/// Exact counts of one socket of a drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveStats {
    /// The address of the socket.
    pub address: SocketAddrV4,
    /// Datagrams that came to its socket, before any fault; on connections, reads.
    pub received: u64,
    /// Replies handed to the kernel, after all faults; each byte of a split reply.
    pub answered: u64,
    /// Replies that the kernel refused, or whose connection had ended.
    pub unsent: u64,
    /// Its connections; all zero for one of datagrams.
    pub connections: ConnectionStats,
    /// The faults that were injected.
    pub injected: Injected,
}

/// Exact counts of the connections of one drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ConnectionStats {
    /// Accepted connections.
    pub accepted: u64,
    /// Refused connections.
    pub refused: u64,
    /// Connections that are open now.
    pub open: u64,
}

/// Exact counts of one segment behind a real socket, or of one serial wire behind a real port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BusStats {
    /// The master's interface or port.
    pub interface: String,
    /// Frames that came to its socket, before any fault; on a serial wire, reads from the port.
    pub received: u64,
    /// Frames handed to the kernel, after all faults; on a serial wire, telegrams of its drives.
    pub answered: u64,
    /// Frames that no slave sent back: its cable is cut, or it does not forward them.
    pub lost: u64,
    /// Frames that the kernel refused; on a serial wire, bytes at a time that it did not take, or that no master was
    /// there for.
    pub unsent: u64,
    /// The faults that were injected.
    pub injected: Injected,
}

impl BusStats {
    fn new(interface: &str) -> BusStats {
        let (interface, injected) = (interface.to_owned(), Injected::default());
        BusStats { interface, received: 0, answered: 0, lost: 0, unsent: 0, injected }
    }
}

/// Simulated drives, served until this is stopped or dropped.
#[derive(Debug)]
pub struct SimServer {
    stats: Arc<[Mutex<DriveStats>]>,
    buses: Arc<[Mutex<BusStats>]>,
    stop: Arc<EventFd>,
    thread: Option<JoinHandle<()>>,
    realtime: bool,
}

impl SimServer {
    /// Binds the sockets of each drive and segment and the port of each serial wire, and serves them on one thread.
    /// Start a second server for a second thread.
    ///
    /// A core or priority that is not available is no error: see [`realtime`](Self::realtime).
    ///
    /// # Errors
    ///
    /// A socket or port that cannot be opened, with its name in the message; no descriptors or threads left.
    pub fn start(simulated: impl Into<Simulated>, options: ServerOptions) -> io::Result<SimServer> {
        let stop = Arc::new(EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?);
        let mut service = Service::open(simulated.into(), &stop)?;
        let Stats { drives: stats, buses } = service.stats();
        let (granted, answer) = crossbeam_channel::bounded(1);
        let thread = thread::Builder::new().name("fieldbeat-sim".into()).spawn(move || {
            // Nobody receives the answer only if the start itself was given up.
            let _ = granted.send(schedule(options));
            service.run();
        })?;
        let realtime = answer.recv().unwrap_or(false);
        Ok(SimServer { stats, buses, stop, thread: Some(thread), realtime })
    }

    /// Whether the thread runs under SCHED_FIFO on the core, as requested. Also false if no priority was requested.
    pub fn realtime(&self) -> bool {
        self.realtime
    }

    /// The counts of each socket so far, by rising address. Most drives have one.
    pub fn stats(&self) -> Vec<DriveStats> {
        self.stats.iter().map(|stats| *lock(stats)).collect()
    }

    /// The counts of each segment so far, then those of each serial wire.
    pub fn buses(&self) -> Vec<BusStats> {
        self.buses.iter().map(|stats| lock(stats).clone()).collect()
    }

    /// Ends the thread, waits for it and closes the sockets. Returns the final counts of the drives.
    pub fn stop(mut self) -> Vec<DriveStats> {
        self.end();
        self.stats()
    }

    /// The same by reference: the counts are final then.
    pub fn end(&mut self) {
        if let Some(thread) = self.thread.take() {
            // An eventfd refuses a 1 only when it is about to overflow, and then the thread wakes up all the same.
            let _ = self.stop.write(1);
            // A panic of a simulated drive has been printed by its thread.
            let _ = thread.join();
        }
    }
}

impl Drop for SimServer {
    fn drop(&mut self) {
        self.end();
    }
}

fn lock<T>(stats: &Mutex<T>) -> MutexGuard<'_, T> {
    // Counts are whole at any instant, also after a panic.
    stats.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Gives the calling thread its core and priority; true if it now runs in real time as requested.
fn schedule(options: ServerOptions) -> bool {
    // An ordinary thread's late sleeps would blur every answer time.
    rt::thread::prompt();
    let pinned = options.core.is_none_or(|core| rt::thread::pin(core).is_ok());
    let prompt = options.priority.is_some_and(|priority| rt::thread::fifo(priority).is_ok());
    // Its sockets and ports stay open, over restarts of the drives and over a pulled cable.
    rt::confine::give_up_rights(rt::confine::Keep::Nothing);
    prompt && pinned
}
