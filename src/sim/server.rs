//! Simulated drives on real sockets: one thread that waits for the requests of all of them.
//!
//! Each drive has a socket bound to its own address, so that the master meets it where it would meet the real one.
//! Nothing here knows a protocol.

use std::io;
use std::net::{SocketAddr, SocketAddrV4, UdpSocket};
use std::os::fd::AsFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::{self, JoinHandle};

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, ppoll};
use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::time::TimeSpec;

use super::DatagramDrive;
use super::fault::{Datagram, Injected, Injector, Parcel, Queue, Way, wrong_port};
use crate::rt::{self, MonotonicClock};
use crate::time::{S, Time};

/// Datagrams under way a drive; more are lost and counted.
const UNDER_WAY: usize = 64;
/// Longer than any UDP datagram.
const ROOM: usize = 65_536;
/// The event that is no socket's.
const STOP: u64 = u64::MAX;

/// How the thread of a [`SimServer`] runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ServerOptions {
    /// The core it is pinned to; not the loop's. Default: any.
    pub core: Option<usize>,
    /// Its SCHED_FIFO priority, 1 ... 99; below the loop's. Default: an ordinary thread.
    pub priority: Option<u8>,
}

/// Exact counts of one drive on a real socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DriveStats {
    /// The drive.
    pub address: SocketAddrV4,
    /// Datagrams that came to its socket, before any fault.
    pub received: u64,
    /// Replies handed to the kernel, after all faults.
    pub answered: u64,
    /// Replies that the kernel refused.
    pub unsent: u64,
    /// The faults that were injected.
    pub injected: Injected,
}

/// Simulated drives, served until this is stopped or dropped.
#[derive(Debug)]
pub struct SimServer {
    stats: Arc<[Mutex<DriveStats>]>,
    stop: Arc<EventFd>,
    thread: Option<JoinHandle<()>>,
    realtime: bool,
}

impl SimServer {
    /// Binds a socket for each drive and serves them on one thread. Start a second server for a second thread.
    ///
    /// A core or priority that cannot be had is no error: see [`realtime`](Self::realtime).
    ///
    /// # Errors
    ///
    /// A socket that cannot be bound, with its address in the message; no descriptors or threads left.
    pub fn start(drives: Vec<Box<dyn DatagramDrive>>, options: ServerOptions) -> io::Result<SimServer> {
        let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
        let stop = Arc::new(EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?);
        epoll.add(&*stop, EpollEvent::new(EpollFlags::EPOLLIN, STOP))?;

        let mut stations = drives.into_iter().map(Station::open).collect::<io::Result<Vec<_>>>()?;
        stations.sort_by_key(|station| station.address);
        for (index, station) in stations.iter().enumerate() {
            epoll.add(&station.socket, EpollEvent::new(EpollFlags::EPOLLIN, index as u64))?;
        }
        let stats: Arc<[_]> = stations.iter().map(|station| Mutex::new(station.stats())).collect();
        let queue = Queue::new(UNDER_WAY * stations.len());
        let mut service =
            Service { epoll, stations, queue, reply: Vec::with_capacity(ROOM), stats: Arc::clone(&stats) };

        let (granted, answer) = mpsc::channel();
        let thread = thread::Builder::new().name("fieldbeat-sim".into()).spawn(move || {
            // Nobody waits for the answer any more only if the start itself was given up.
            let _ = granted.send(schedule(options));
            service.run();
        })?;
        let realtime = answer.recv().unwrap_or(false);
        Ok(SimServer { stats, stop, thread: Some(thread), realtime })
    }

    /// Whether the thread runs under SCHED_FIFO on the core, as asked. False too if no priority was asked for.
    pub fn realtime(&self) -> bool {
        self.realtime
    }

    /// The counts of each drive so far, by rising address.
    pub fn stats(&self) -> Vec<DriveStats> {
        self.stats.iter().map(|stats| *lock(stats)).collect()
    }

    /// Ends the thread, waits for it and closes the sockets. Returns the final counts.
    pub fn stop(mut self) -> Vec<DriveStats> {
        self.end();
        self.stats()
    }

    fn end(&mut self) {
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

fn lock(stats: &Mutex<DriveStats>) -> MutexGuard<'_, DriveStats> {
    // Counts are whole at any instant, also after a panic.
    stats.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Gives the calling thread its core and priority; true if it now runs in real time as asked.
fn schedule(options: ServerOptions) -> bool {
    // An ordinary thread's late sleeps would blur every answer time.
    rt::thread::exact_sleeps();
    let pinned = options.core.is_none_or(|core| rt::thread::pin(core).is_ok());
    options.priority.is_some_and(|priority| rt::thread::fifo(priority).is_ok()) && pinned
}

/// One drive and its sockets.
struct Station {
    address: SocketAddrV4,
    drive: Box<dyn DatagramDrive>,
    injector: Injector,
    socket: UdpSocket,
    /// Where replies with a wrong identity come from, if there are any.
    wrong: Option<UdpSocket>,
}

impl Station {
    fn open(drive: Box<dyn DatagramDrive>) -> io::Result<Station> {
        let (address, faults) = (drive.address(), drive.faults());
        let wrong = if faults.wrong_id > 0.0 { Some(bind(wrong_port(address))?) } else { None };
        Ok(Station { address, injector: Injector::new(faults), socket: bind(address)?, wrong, drive })
    }

    fn stats(&self) -> DriveStats {
        DriveStats {
            address: self.address,
            received: 0,
            answered: 0,
            unsent: 0,
            injected: self.injector.injected(),
        }
    }
}

fn bind(address: SocketAddrV4) -> io::Result<UdpSocket> {
    UdpSocket::bind(address).and_then(|socket| socket.set_nonblocking(true).map(|()| socket)).map_err(|error| {
        let remedy = match error.kind() {
            io::ErrorKind::AddrInUse => {
                "another simulation serves this drive: end it (ss -ulpn shows which), or give the drive another address"
            }
            io::ErrorKind::AddrNotAvailable => {
                "a simulated drive lives on this computer: give it an address like 127.0.0.11, and its bus one to bind to"
            }
            _ => "look at its address",
        };
        io::Error::new(error.kind(), format!("cannot bind {address}: {error}; {remedy}"))
    })
}

/// What the thread owns.
struct Service {
    epoll: Epoll,
    /// By address.
    stations: Vec<Station>,
    queue: Queue,
    reply: Vec<u8>,
    stats: Arc<[Mutex<DriveStats>]>,
}

impl Service {
    fn run(&mut self) {
        // Room for every descriptor at once, so that none, the stop's included, waits behind busier ones.
        let mut events = vec![EpollEvent::empty(); self.stations.len() + 1];
        let mut bytes = vec![0; ROOM];
        loop {
            let count = match self.wait(&mut events) {
                Ok(count) => count,
                Err(Errno::EINTR) => 0,
                // The descriptor and the buffer are our own, so that no other error can be.
                Err(_) => return,
            };
            for event in &events[..count] {
                if event.data() == STOP {
                    return;
                }
                self.receive(event.data() as usize, &mut bytes);
                // At once and not after the last socket: the first drive's answer does not wait for the others.
                self.run_due();
            }
            self.run_due();
        }
    }

    /// Waits for sockets, but not beyond the next due instant.
    fn wait(&self, events: &mut [EpollEvent]) -> nix::Result<usize> {
        let Some(due) = self.queue.next_due() else {
            return self.epoll.wait(events, EpollTimeout::NONE);
        };
        // epoll_wait counts in milliseconds; ppoll waits for the same set in nanoseconds.
        let left = due.since(MonotonicClock::read());
        if left > 0 {
            let timeout = TimeSpec::new((left / S) as libc::time_t, (left % S) as libc::c_long);
            ppoll(&mut [PollFd::new(self.epoll.0.as_fd(), PollFlags::POLLIN)], Some(timeout), None)?;
        }
        self.epoll.wait(events, EpollTimeout::ZERO)
    }

    /// Takes one datagram from a ready socket. The epoll is level-triggered: what is left is reported again, which
    /// costs less than asking each socket for the EAGAIN behind its usually only datagram.
    fn receive(&mut self, index: usize, bytes: &mut [u8]) {
        let station = &mut self.stations[index];
        let Ok((length, SocketAddr::V4(from))) = station.socket.recv_from(bytes) else { return };
        let now = MonotonicClock::read();
        let request = Datagram { from, to: station.address, bytes: &bytes[..length] };
        if let Some(blow) = station.injector.pass(Way::Request, now, now, request, &mut self.queue) {
            blow.strike(now, &mut *station.drive);
        }
        let mut stats = lock(&self.stats[index]);
        stats.received += 1;
        stats.injected = station.injector.injected();
    }

    /// Everything that is due by now: requests to their drives, replies to the kernel.
    fn run_due(&mut self) {
        if self.queue.next_due().is_none() {
            return;
        }
        let now = MonotonicClock::read();
        while let Some((_, parcel)) = self.queue.pop(now) {
            match self.station(parcel.to) {
                Some(index) => self.serve(index, now, &parcel),
                None => self.answer(&parcel),
            }
            self.queue.recycle(parcel);
        }
    }

    fn serve(&mut self, index: usize, now: Time, parcel: &Parcel) {
        let station = &mut self.stations[index];
        self.reply.clear();
        let to = station.drive.receive(now, parcel.from, &parcel.bytes, &mut self.reply);
        // No drive answers a drive: with a forged source two of them would go on for ever.
        if let Some(to) = to.filter(|to| self.station(*to).is_none()) {
            let station = &mut self.stations[index];
            let reply = Datagram { from: station.address, to, bytes: &self.reply };
            station.injector.pass(Way::Reply, now, now, reply, &mut self.queue);
            lock(&self.stats[index]).injected = station.injector.injected();
        }
    }

    fn answer(&mut self, parcel: &Parcel) {
        let (index, wrong) = match self.station(parcel.from) {
            Some(index) => (Some(index), false),
            None => (self.station(wrong_port(parcel.from)), true),
        };
        let Some(index) = index else { return };
        let station = &self.stations[index];
        let socket = if wrong { station.wrong.as_ref().unwrap_or(&station.socket) } else { &station.socket };
        let sent = socket.send_to(&parcel.bytes, parcel.to);
        let mut stats = lock(&self.stats[index]);
        match sent {
            Ok(_) => stats.answered += 1,
            Err(_) => stats.unsent += 1,
        }
    }

    fn station(&self, address: SocketAddrV4) -> Option<usize> {
        self.stations.binary_search_by_key(&address, |station| station.address).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::FaultPlan;
    use crate::time::MS;
    use std::net::Ipv4Addr;
    use std::time::{Duration, Instant};

    /// The tests of this file own 127.72.x.0/24, one x each.
    fn address(x: u8, host: u8) -> SocketAddrV4 {
        SocketAddrV4::new(Ipv4Addr::new(127, 72, x, host), 49360)
    }

    /// Answers with what it got and how often it was asked since its start.
    struct Echo(SocketAddrV4, FaultPlan, u8);

    impl DatagramDrive for Echo {
        fn address(&self) -> SocketAddrV4 {
            self.0
        }

        fn faults(&self) -> FaultPlan {
            self.1.clone()
        }

        fn receive(
            &mut self,
            _now: Time,
            from: SocketAddrV4,
            bytes: &[u8],
            reply: &mut Vec<u8>,
        ) -> Option<SocketAddrV4> {
            self.2 = self.2.wrapping_add(1);
            reply.extend_from_slice(bytes);
            reply.push(self.2);
            Some(from)
        }

        fn inhibit(&mut self, _until: Time) {}

        fn restart(&mut self, _now: Time) {
            self.2 = 0;
        }
    }

    fn start(x: u8, hosts: std::ops::Range<u8>, faults: &FaultPlan) -> io::Result<SimServer> {
        let drives =
            hosts.map(|h| Box::new(Echo(address(x, h), faults.clone(), 0)) as Box<dyn DatagramDrive>);
        SimServer::start(drives.collect(), ServerOptions::default())
    }

    fn client(x: u8, timeout: Duration) -> UdpSocket {
        let socket = UdpSocket::bind((Ipv4Addr::new(127, 72, x, 1), 41136)).unwrap();
        socket.set_read_timeout(Some(timeout)).unwrap();
        socket
    }

    #[test]
    fn every_drive_answers_from_its_own_address() {
        let server = start(1, 10..40, &FaultPlan::default()).unwrap();
        let client = client(1, Duration::from_secs(5));
        for round in 1..=20 {
            for host in 10..40 {
                client.send_to(&[host], address(1, host)).unwrap();
            }
            let mut hosts: Vec<u8> = (10..40)
                .map(|_| {
                    let mut bytes = [0; 8];
                    let (length, from) = client.recv_from(&mut bytes).unwrap();
                    assert_eq!((length, bytes[1]), (2, round));
                    assert_eq!(from, address(1, bytes[0]).into());
                    bytes[0]
                })
                .collect();
            hosts.sort();
            assert!(hosts.into_iter().eq(10..40));
        }
        assert!(!server.realtime());
        let stats = server.stop();
        assert_eq!(stats.len(), 30);
        for (stats, host) in stats.iter().zip(10..) {
            assert_eq!((stats.address, stats.received), (address(1, host), 20));
            assert_eq!((stats.answered, stats.unsent, stats.injected), (20, 0, Injected::default()));
        }
    }

    #[test]
    fn faults_are_injected_counted_and_accounted_for() {
        let faults = FaultPlan {
            seed: 5,
            drop: 0.2,
            duplicate: 0.2,
            wrong_id: 0.2,
            restart: 0.05,
            ..FaultPlan::default()
        };
        let server = start(2, 10..11, &faults).unwrap();
        let client = client(2, Duration::from_millis(5));
        let (mut right, mut wrong) = (0, 0);
        for n in 1..=500u64 {
            client.send_to(&n.to_le_bytes(), address(2, 10)).unwrap();
            if n % 50 != 0 {
                continue;
            }
            // Now and then until all is answered, so that no socket buffer overflows.
            let begin = Instant::now();
            loop {
                if let Ok((_, from)) = client.recv_from(&mut [0; 16]) {
                    *(if from == address(2, 10).into() { &mut right } else { &mut wrong }) += 1;
                }
                let (stats, i) = (server.stats()[0], server.stats()[0].injected);
                let owed = n + i.duplicated - i.dropped - i.restarts;
                if stats.received == n && stats.answered == owed && right + wrong == owed {
                    break;
                }
                assert!(begin.elapsed() < Duration::from_secs(5), "{stats:?}: {right} right, {wrong} wrong");
            }
        }
        let i = server.stop()[0].injected;
        assert!(wrong > 0 && wrong >= i.wrong_id && i.restarts > 0 && i.dropped > 0, "{i:?}");
    }

    #[test]
    fn an_answer_takes_its_time() {
        let server = start(3, 10..12, &FaultPlan { answer_ns: 30 * MS, ..FaultPlan::default() }).unwrap();
        let client = client(3, Duration::from_secs(5));
        let begin = Instant::now();
        client.send_to(&[1], address(3, 10)).unwrap();
        client.send_to(&[2], address(3, 11)).unwrap();
        for expected in [1, 2] {
            let mut bytes = [0; 8];
            client.recv_from(&mut bytes).unwrap();
            assert_eq!(bytes[0], expected);
            assert!(begin.elapsed() >= Duration::from_millis(30));
        }
        drop(server);
    }

    #[test]
    fn an_address_in_use_is_named_and_given_back() {
        let first = start(4, 10..12, &FaultPlan::default()).unwrap();
        let error = start(4, 11..13, &FaultPlan::default()).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        assert!(error.to_string().contains("127.72.4.11:49360"), "{error}");
        drop(first);
        drop(start(4, 10..13, &FaultPlan::default()).unwrap());
    }

    #[test]
    fn a_right_that_is_missing_is_reported_and_serves_all_the_same() {
        let options = ServerOptions { core: Some(usize::MAX), priority: Some(1) };
        let drive = Box::new(Echo(address(5, 10), FaultPlan::default(), 0));
        let server = SimServer::start(vec![drive], options).unwrap();
        assert!(!server.realtime());
        let client = client(5, Duration::from_secs(5));
        client.send_to(&[1], address(5, 10)).unwrap();
        assert_eq!(client.recv(&mut [0; 8]).unwrap(), 2);
    }
}
