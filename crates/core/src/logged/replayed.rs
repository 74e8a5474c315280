//! The carriers of a repeated run: what came is in the log, and what leaves is compared with it.

use std::io;
use std::net::SocketAddrV4;
use std::os::fd::RawFd;
use std::sync::Arc;
use std::task::Waker;

use super::codes::{broken_of, unsent_of};
use crate::inputs::entry::{Kind, of_bus, peer, peer_of, place_of};
use crate::inputs::replaying::Entry;
use crate::inputs::{InputLog, Replaying};
use crate::net::frames::Unsent;
use crate::net::{
    Broken, Carriers, Datagrams, Frames, Groups, LinkNotes, Outbox, Received, Sent, Serial, SerialLine,
    StreamPeer, Streams, UdpOptions,
};
use crate::rt::Regions;
use crate::time::Time;

/// Carriers over a log that is read.
#[derive(Debug)]
pub struct ReplayCarriers {
    log: InputLog,
}

impl ReplayCarriers {
    /// Those of `log`.
    pub fn new(log: &InputLog) -> ReplayCarriers {
        ReplayCarriers { log: log.clone() }
    }

    /// A carrier of the bus that is being opened.
    fn replayed(&self) -> Replayed {
        Replayed { log: self.log.source(), bus: self.log.bus(), peers: Vec::new() }
    }
}

impl Carriers for ReplayCarriers {
    fn datagrams(&self, _bind: SocketAddrV4, options: &UdpOptions) -> io::Result<Box<dyn Datagrams>> {
        let net = self.replayed();
        let batch = net.log.value(0, 0) as usize;
        Ok(Box::new(ReplayedDatagrams { net, batch, has_groups: options.groups > 0 }))
    }

    fn streams(&self, peers: Vec<StreamPeer>) -> io::Result<Box<dyn Streams>> {
        Ok(Box::new(Replayed { peers, ..self.replayed() }))
    }

    fn serial(&self, _port: &str, _line: &SerialLine) -> io::Result<Box<dyn Serial>> {
        Ok(Box::new(self.replayed()))
    }

    fn frames(&self, _interface: &str, _ethertype: u16) -> io::Result<Box<dyn Frames>> {
        Ok(Box::new(self.replayed()))
    }

    fn log(&self) -> InputLog {
        self.log.clone()
    }
}

/// Connections, a serial port or frames of one bus.
struct Replayed {
    log: InputLog,
    bus: u8,
    /// Their handshakes and sessions never run; what they share with the loop stays in use.
    peers: Vec<StreamPeer>,
}

impl Replayed {
    fn replaying(&self) -> Option<&Replaying> {
        self.log.as_replaying()
    }

    /// A look for an entry of these kinds whose first word is `of`.
    fn find(&self, kinds: &[Kind], of: u64) -> Option<Entry> {
        self.replaying()?.look(kinds, |entry| entry.word(0) == of)
    }

    fn number(&self) -> Option<usize> {
        self.log.part(None::<u64>).and_then(|number| usize::try_from(number).ok())
    }
}

struct ReplayedDatagrams {
    net: Replayed,
    /// That of the recorded carrier: a full one is followed by another look.
    batch: usize,
    has_groups: bool,
}

impl Datagrams for ReplayedDatagrams {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, outbox: &mut Outbox) {
        let Some(replaying) = self.net.replaying() else { return };
        for index in 0..outbox.len() {
            if outbox.sent(index) != Sent::Posted {
                continue;
            }
            let to = of_bus(self.net.bus, index) | peer(outbox.peer(index));
            let kinds = [(Kind::DatagramOut, 1), (Kind::DatagramUnsent, 2)];
            let sent = match replaying.sends(&kinds, to, outbox.bytes(index)) {
                Some(entry) if entry.kind == Kind::DatagramOut => Sent::At(entry.at),
                Some(entry) if entry.word(1) != 0 => Sent::Failed((entry.word(1) as u32).cast_signed()),
                _ => Sent::Posted,
            };
            outbox.note(index, sent);
        }
    }

    fn receive(&mut self, take: &mut dyn FnMut(Received<'_>)) -> io::Result<usize> {
        let Some(replaying) = self.net.replaying() else { return Ok(0) };
        let (kinds, bus) = ([Kind::DatagramIn, Kind::Failed], usize::from(self.net.bus));
        let mut count = 0;
        while let Some(entry) = replaying.look(&kinds, |entry| place_of(entry.word(0)).0 == bus) {
            if entry.kind == Kind::Failed {
                return Err(io::Error::from_raw_os_error((entry.word(1) as u32).cast_signed()));
            }
            let (from, truncated) = (peer_of(entry.word(0)), entry.word(0) >> 48 & 1 != 0);
            take(Received { from, at: entry.at, bytes: &entry.bytes(1), truncated });
            count += 1;
        }
        Ok(count)
    }

    fn batch(&self) -> usize {
        self.batch
    }

    fn groups(&self) -> Option<Arc<dyn Groups>> {
        self.has_groups.then(|| Arc::new(NoGroups) as Arc<dyn Groups>)
    }

    fn memory(&self, _regions: &mut Regions) {}
}

/// The sessions that would join them do not run.
#[derive(Debug)]
struct NoGroups;

impl Groups for NoGroups {
    fn join(&self, _group: SocketAddrV4) -> io::Result<()> {
        Ok(())
    }

    fn leave(&self, _group: SocketAddrV4) {}
}

impl Streams for Replayed {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn opened(&mut self) -> Option<usize> {
        self.number()
    }

    fn look(&mut self) {}

    fn ready(&mut self) -> Option<usize> {
        self.number()
    }

    fn receive(&mut self, index: usize, room: &mut [u8]) -> Result<Option<(Time, usize)>, Broken> {
        let entry = self.find(&[Kind::BytesIn, Kind::Broken], of_bus(self.bus, index));
        let Some(entry) = entry else { return Ok(None) };
        if entry.kind == Kind::Broken {
            return Err(broken_of(entry.word(1)));
        }
        let bytes = entry.bytes(1);
        let count = bytes.len().min(room.len());
        room[..count].copy_from_slice(&bytes[..count]);
        Ok(Some((entry.at, count)))
    }

    fn send(&mut self, index: usize, bytes: &[u8]) -> Result<(Time, usize), Broken> {
        let kinds = [(Kind::BytesOut, 2), (Kind::BytesUnsent, 2)];
        let to = of_bus(self.bus, index);
        match self.replaying().and_then(|replaying| replaying.sends(&kinds, to, bytes)) {
            Some(entry) if entry.kind == Kind::BytesUnsent => Err(broken_of(entry.word(1))),
            Some(entry) => Ok((entry.at, entry.word(1) as usize)),
            None => Err(Broken::Absent),
        }
    }

    fn abandon(&mut self, _index: usize, _why: &'static str) {}

    fn has_ended(&self) -> bool {
        self.log.flag(false, false)
    }

    fn notes(&self) -> LinkNotes {
        LinkNotes::new(self.peers.len().max(1))
    }

    fn waker(&self) -> Option<Waker> {
        None
    }

    fn memory(&self, _regions: &mut Regions) {}
}

impl Serial for Replayed {
    fn unsent(&mut self) -> Result<usize, Broken> {
        let (source, broken) = (self.log.id(), of_bus(self.bus, 0));
        let is_own = |entry: &Entry| match entry.kind {
            Kind::Broken => entry.word(0) == broken,
            _ => entry.word(0) == source,
        };
        match self.replaying().and_then(|replaying| replaying.look(&[Kind::Value, Kind::Broken], is_own)) {
            None => Ok(0),
            Some(entry) if entry.kind == Kind::Broken => Err(broken_of(entry.word(1))),
            Some(entry) => Ok(entry.word(1) as usize),
        }
    }

    fn discard(&mut self) -> Result<(), Broken> {
        match self.find(&[Kind::Broken], of_bus(self.bus, 0)) {
            None => Ok(()),
            Some(entry) => Err(broken_of(entry.word(1))),
        }
    }

    fn is_timed(&self) -> bool {
        self.log.flag(true, true)
    }
}

impl Frames for Replayed {
    fn fd(&self) -> Option<RawFd> {
        None
    }

    fn send(&mut self, frame: &[u8]) -> Result<Time, Unsent> {
        let kinds = [(Kind::FrameOut, 1), (Kind::FrameUnsent, 2)];
        let to = of_bus(self.bus, 0);
        match self.replaying().and_then(|replaying| replaying.sends(&kinds, to, frame)) {
            None => Err(Unsent::Down),
            Some(entry) if entry.kind == Kind::FrameUnsent => Err(unsent_of(entry.word(1))),
            Some(entry) => Ok(entry.at),
        }
    }

    fn receive(&mut self, room: &mut [u8]) -> Option<(Time, usize)> {
        let bus = usize::from(self.bus);
        let entry = self.replaying()?.look(&[Kind::FrameIn], |entry| place_of(entry.word(0)).0 == bus)?;
        let bytes = entry.bytes(1);
        let count = bytes.len().min(room.len());
        room[..count].copy_from_slice(&bytes[..count]);
        Some((entry.at, entry.word(0) as u32 as usize))
    }

    fn now(&mut self) -> Time {
        self.replaying().map_or(Time(0), Replaying::clock)
    }

    fn today_ns(&self) -> Option<u64> {
        self.log.part(None)
    }

    fn mac(&self) -> [u8; 6] {
        let [mac @ .., _, _] = self.log.value(0, 0).to_le_bytes();
        mac
    }

    fn memory(&self, _regions: &mut Regions) {}
}
