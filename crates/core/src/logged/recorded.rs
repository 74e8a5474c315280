//! The carriers of a recorded run: those of another [`Carriers`], with all that passes them in the log.

use std::io;
use std::net::{SocketAddrV4, UdpSocket};
use std::os::fd::RawFd;
use std::sync::Arc;
use std::task::Waker;

use super::codes::{broken, unsent};
use super::link::LinkTap;
use crate::inputs::InputLog;
use crate::inputs::entry::{Kind, of_bus, peer};
use crate::net::frames::{Dropped, Unsent};
use crate::net::{
    Broken, Carriers, Datagrams, Frames, Groups, LinkNotes, Lock, Outbox, Place, Received, Sent, Serial,
    SerialLine, StreamPeer, Streams, UdpOptions, lock,
};
use crate::rt::Regions;
use crate::time::Time;

/// Carriers whose traffic is in a log.
pub struct LoggedCarriers<'a> {
    carriers: &'a dyn Carriers,
    log: InputLog,
    link: LinkTap,
}

impl std::fmt::Debug for LoggedCarriers<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LoggedCarriers").finish_non_exhaustive()
    }
}

impl<'a> LoggedCarriers<'a> {
    /// Those of `carriers`, with this log; `link` gets what the loop does not see.
    pub fn new(carriers: &'a dyn Carriers, log: &InputLog, link: LinkTap) -> LoggedCarriers<'a> {
        LoggedCarriers { carriers, log: log.clone(), link }
    }

    fn logged<T>(&self, net: T) -> Box<Logged<T>> {
        Box::new(Logged { net, log: self.log.source(), bus: self.log.bus() })
    }
}

impl Carriers for LoggedCarriers<'_> {
    fn datagrams(&self, bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let net = self.carriers.datagrams(bind, options)?;
        let (log, bus) = (self.log.source(), self.log.bus());
        log.value(0, net.batch() as u64);
        Ok(Box::new(LoggedDatagrams { net, log, bus, posted: vec![false; options.peers].into() }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        let peers = self.link.around(self.log.bus(), peers);
        Ok(self.logged(self.carriers.streams(peers)?))
    }

    fn serial(&self, port: &str, line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        Ok(self.logged(self.carriers.serial(port, line)?))
    }

    fn frames(&self, interface: &str, ethertype: u16) -> io::Result<Box<dyn Frames>> {
        Ok(self.logged(self.carriers.frames(interface, ethertype)?))
    }

    fn log(&self) -> InputLog {
        self.log.clone()
    }

    fn lock(&self, place: Place<'_>) -> Result<Lock, lock::Refused> {
        self.carriers.lock(place)
    }
}

/// Datagrams with their log.
struct LoggedDatagrams {
    net: Box<dyn Datagrams>,
    log: InputLog,
    bus: u8,
    /// The messages that are posted at present.
    posted: Box<[bool]>,
}

impl Datagrams for LoggedDatagrams {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, outbox: &mut Outbox) {
        for (index, posted) in self.posted.iter_mut().enumerate() {
            *posted = index < outbox.len() && outbox.sent(index) == Sent::Posted;
        }
        self.net.send(outbox);
        let Some(recording) = self.log.as_recording() else { return };
        for index in self.posted.iter().enumerate().filter_map(|(index, posted)| posted.then_some(index)) {
            let to = of_bus(self.bus, index) | peer(outbox.peer(index));
            let bytes = outbox.bytes(index);
            match outbox.sent(index) {
                Sent::At(at) => recording.entry_at(Kind::DatagramOut, at, &[to], bytes),
                Sent::Failed(error) => {
                    let error = u64::from(error.cast_unsigned());
                    recording.entry(Kind::DatagramUnsent, &[to, error], bytes);
                }
                Sent::Posted | Sent::Idle => recording.entry(Kind::DatagramUnsent, &[to, 0], bytes),
            }
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let LoggedDatagrams { net, log, bus, .. } = self;
        let Some(recording) = log.as_recording() else { return net.receive(take) };
        let result = net.receive(&mut |datagram| {
            let from = of_bus(*bus, datagram.truncated.into()) | peer(datagram.from);
            recording.entry_at(Kind::DatagramIn, datagram.at, &[from], datagram.bytes);
            take(datagram);
        });
        // The look behind the last one.
        match &result {
            Ok(_) => recording.nothing(),
            Err(error) => {
                let error = error.raw_os_error().unwrap_or(libc::EIO);
                recording.entry(Kind::Failed, &[of_bus(*bus, 0), error.cast_unsigned().into()], &[]);
            }
        }
        result
    }

    fn batch(&self) -> usize {
        self.net.batch()
    }

    fn groups(&self) -> Option<Arc<dyn Groups>> {
        self.net.groups()
    }

    fn twin(&self) -> io::Result<Option<UdpSocket>> {
        self.net.twin()
    }

    fn dropped(&self) -> u64 {
        self.net.dropped()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
        regions.add(self);
        regions.add(&*self.posted);
    }
}

/// Connections, a serial port or frames, with their log.
struct Logged<T> {
    net: T,
    log: InputLog,
    bus: u8,
}

impl<S: Streams + ?Sized> Streams for Logged<Box<S>> {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn opened(&mut self) -> Option<usize> {
        let opened = self.net.opened();
        self.log.part(opened.map(|index| index as u64));
        opened
    }

    fn look(&mut self) {
        self.net.look();
    }

    fn ready(&mut self) -> Option<usize> {
        let ready = self.net.ready();
        self.log.part(ready.map(|index| index as u64));
        ready
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let received = self.net.receive(index, room);
        if let Some(recording) = self.log.as_recording() {
            match received {
                Ok(None) => recording.nothing(),
                Ok(Some((at, count))) => {
                    let bytes = room.get(..count).unwrap_or(room);
                    recording.entry_at(Kind::BytesIn, at, &[of_bus(self.bus, index)], bytes);
                }
                Err(why) => recording.entry(Kind::Broken, &[of_bus(self.bus, index), broken(why)], &[]),
            }
        }
        received
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let sent = self.net.send(index, bytes);
        if let Some(recording) = self.log.as_recording() {
            match sent {
                Ok((at, count)) => {
                    recording.entry_at(Kind::BytesOut, at, &[of_bus(self.bus, index), count as u64], bytes);
                }
                Err(why) => {
                    recording.entry(Kind::BytesUnsent, &[of_bus(self.bus, index), broken(why)], bytes);
                }
            }
        }
        sent
    }

    fn abandon(&mut self, index: usize, why: &'static str) {
        self.net.abandon(index, why);
    }

    fn has_ended(&self) -> bool {
        self.log.flag(false, self.net.has_ended())
    }

    fn notes(&self) -> LinkNotes {
        self.net.notes()
    }

    fn waker(&self) -> Option<Waker> {
        self.net.waker()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
        regions.add(self);
    }
}

impl<T> Logged<T> {
    /// Nothing can pass its only connection.
    #[cold]
    fn is_broken(&self, why: Broken) {
        if let Some(recording) = self.log.as_recording() {
            recording.entry(Kind::Broken, &[of_bus(self.bus, 0), broken(why)], &[]);
        }
    }
}

impl Serial for Logged<Box<dyn Serial>> {
    fn unsent(&mut self) -> Result<usize, Broken> {
        let unsent = self.net.unsent();
        match unsent {
            Ok(count) => drop(self.log.part(Some(count as u64).filter(|count| *count > 0))),
            Err(why) => self.is_broken(why),
        }
        unsent
    }

    fn discard(&mut self) -> Result<(), Broken> {
        let discarded = self.net.discard();
        match discarded {
            Ok(()) => drop(self.log.part(None::<u64>)),
            Err(why) => self.is_broken(why),
        }
        discarded
    }

    fn is_timed(&self) -> bool {
        self.log.flag(true, self.net.is_timed())
    }
}

impl Frames for Logged<Box<dyn Frames>> {
    fn fd(&self) -> Option<RawFd> {
        self.net.fd()
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let sent = self.net.send(frame);
        if let Some(recording) = self.log.as_recording() {
            match sent {
                Ok(at) => recording.entry_at(Kind::FrameOut, at, &[of_bus(self.bus, 0)], frame),
                Err(why) => recording.entry(Kind::FrameUnsent, &[of_bus(self.bus, 0), unsent(why)], frame),
            }
        }
        sent
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let received = self.net.receive(room);
        if let Some(recording) = self.log.as_recording() {
            match received {
                None => recording.nothing(),
                Some((at, length)) => {
                    let bytes = room.get(..length).unwrap_or(room);
                    recording.entry_at(Kind::FrameIn, at, &[of_bus(self.bus, 0) | length as u64], bytes);
                }
            }
        }
        received
    }

    fn now(&mut self) -> Time {
        let now = self.net.now();
        if let Some(recording) = self.log.as_recording() {
            recording.entry_at(Kind::Clock, now, &[], &[]);
        }
        now
    }

    fn today_ns(&self) -> Option<u64> {
        self.log.part(self.net.today_ns())
    }

    fn mac(&self) -> [u8; 6] {
        let [a, b, c, d, e, f] = self.net.mac();
        let [a, b, c, d, e, f, ..] =
            self.log.value(0, u64::from_le_bytes([a, b, c, d, e, f, 0, 0])).to_le_bytes();
        [a, b, c, d, e, f]
    }

    fn errors(&self) -> u64 {
        self.net.errors()
    }

    fn dropped(&self) -> Option<Arc<dyn Dropped>> {
        self.net.dropped()
    }

    fn memory(&self, regions: &mut Regions) {
        self.net.memory(regions);
        regions.add(self);
    }

    fn wait(&self, most_ms: u8) {
        self.net.wait(most_ms);
    }
}
