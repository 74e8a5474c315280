//! Carriers that count their system calls: those of the operating system, or those that carriers in memory stand for.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::task::Waker;

use fieldbeat::time::Time;
use fieldbeat_core::net::frames::Unsent;
use fieldbeat_core::net::{
    Broken, Carriers, Datagrams, Frames, LinkNotes, Os, Outbox, Received, Sent, Serial, SerialLine,
    StreamPeer, Streams, UdpOptions,
};
use fieldbeat_core::rt::Regions;

use super::callgrind::paused;
use super::rig::Calls;

/// Carriers, counting what they call.
pub struct CountedNet<N = Os> {
    net: N,
    calls: Calls,
    on_connections: Calls,
}

impl CountedNet {
    /// Those of the operating system. Counts in `calls`.
    pub fn new(calls: &Calls) -> CountedNet {
        CountedNet::over(Os::off_core(fieldbeat_core::rt::thread::default_core()), calls)
    }
}

impl<N> CountedNet<N> {
    /// These. Counts in `calls`.
    pub fn over(net: N, calls: &Calls) -> CountedNet<N> {
        CountedNet { net, calls: Calls::clone(calls), on_connections: Calls::default() }
    }

    /// Of these calls, those that send or receive on a connection.
    pub fn on_connections(&self) -> u64 {
        self.on_connections.now().made
    }
}

struct Counted {
    net: Box<dyn Datagrams>,
    calls: Calls,
}

impl<N: Carriers> Carriers for CountedNet<N> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        Ok(Box::new(Counted { net: self.net.datagrams(bind, options)?, calls: Calls::clone(&self.calls) }))
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        let net = self.net.frames(interface, ethertype)?;
        Ok(Box::new(CountedFrames { net, calls: Calls::clone(&self.calls) }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        let look = u64::from(peers.len() > 1);
        let [calls, on_connections] = [&self.calls, &self.on_connections].map(Calls::clone);
        Ok(Box::new(CountedStreams { net: self.net.streams(peers)?, look, looked: 0, calls, on_connections }))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        let (net, calls) = (self.net.serial(port, line)?, Calls::clone(&self.calls));
        // A port is none.
        Ok(Box::new(CountedStreams { net, look: 0, looked: 0, calls, on_connections: Calls::default() }))
    }
}

impl Datagrams for Counted {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        // One call for each 64 messages. One that is refused would cost one more; on loopback none is.
        paused(|| {
            let posted = (0..outbox.len()).filter(|index| outbox.sent(*index) == Sent::Posted).count();
            self.calls.made(posted.div_ceil(64) as u64);
            self.net.send(outbox);
        });
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        paused(|| {
            let result = self.net.receive(take);
            self.calls.made(1);
            self.calls.taken(u64::from(result.as_ref().is_ok_and(|count| *count > 0)));
            result
        })
    }

    fn batch(&self) -> usize {
        self.net.batch()
    }

    fn dropped(&self) -> u64 {
        self.net.dropped()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
    }
}

struct CountedFrames {
    net: Box<dyn Frames>,
    calls: Calls,
}

/// One call each; on a segment of this host, a frame that is not taken costs none more.
impl Frames for CountedFrames {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        paused(|| {
            self.calls.made(1);
            self.net.send(frame)
        })
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        paused(|| {
            let result = self.net.receive(room);
            self.calls.made(1);
            self.calls.taken(u64::from(result.is_some()));
            result
        })
    }

    fn now(&mut self) -> Time {
        self.net.now()
    }

    fn mac(&self) -> [u8; 6] {
        self.net.mac()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
    }
}

struct CountedStreams<N: ?Sized = dyn Streams> {
    net: Box<N>,
    /// System calls of a look: an only connection has no epoll, and is not looked at.
    look: u64,
    /// Those of the last look, until it has found something.
    looked: u64,
    calls: Calls,
    on_connections: Calls,
}

impl<N: ?Sized> CountedStreams<N> {
    /// One call, unless there was no connection to make it on.
    fn count<T>(&self, result: &Result<T, Broken>) {
        let made = u64::from(!matches!(result, Err(Broken::Absent)));
        self.calls.made(made);
        self.on_connections.made(made);
    }
}

/// A port is taken over without a call; those of its opening are not the loop's.
impl Serial for CountedStreams<dyn Serial> {
    fn unsent(&mut self) -> Result<usize, Broken> {
        paused(|| {
            let result = self.net.unsent();
            self.count(&result);
            result
        })
    }

    fn discard(&mut self) -> Result<(), Broken> {
        self.net.discard()
    }

    fn is_timed(&self) -> bool {
        self.net.is_timed()
    }
}

impl<N: Streams + ?Sized> Streams for CountedStreams<N> {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn opened(&mut self) -> Option<usize> {
        paused(|| {
            let opened = self.net.opened();
            // It is added to the epoll, if there is one.
            self.calls.made(self.look * u64::from(opened.is_some()));
            opened
        })
    }

    fn look(&mut self) {
        paused(|| {
            self.calls.made(self.look);
            self.looked = self.look;
            self.net.look();
        });
    }

    fn ready(&mut self) -> Option<usize> {
        paused(|| {
            let ready = self.net.ready();
            if ready.is_some() {
                self.calls.taken(std::mem::take(&mut self.looked));
            }
            ready
        })
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        paused(|| {
            let result = self.net.receive(index, room);
            self.count(&result);
            self.calls.taken(u64::from(matches!(result, Ok(Some(_)))));
            result
        })
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        paused(|| {
            let result = self.net.send(index, bytes);
            self.count(&result);
            result
        })
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        // The link thread is woken up; and it is removed from the epoll, if there is one.
        self.calls.made(1 + self.look);
        self.net.abandon(index, why);
    }

    fn has_ended(&self) -> bool {
        self.net.has_ended()
    }

    fn notes(&self) -> LinkNotes {
        self.net.notes()
    }

    fn waker(&self) -> Option<Waker> {
        self.net.waker()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
    }
}
