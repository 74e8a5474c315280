//! What passed the wires of a recorded run, as a capture.
//!
//! | carrier | packet |
//! |---|---|
//! | Ethernet frames | as they were |
//! | datagrams | with headers that are made of the addresses of the configuration |
//! | bytes of connections | the same; each piece is a segment, numbered from 1 on in both directions |
//! | a serial wire | a telegram; what is none, too |
//!
//! The handshakes and sessions of the link thread are among the bytes of connections. What did not leave is not in it.
//! The packets of a cycle are in the order of their times: a datagram may have come before the requests of the cycle
//! that took it in. Times are UTC, by the difference to the clock of the loop that the recording has, which was taken
//! once, at its start.

use std::collections::HashMap;
use std::io::{self, Write};
use std::iter::Peekable;
use std::net::{Ipv4Addr, SocketAddrV4};

use fieldbeat_config::PROTOCOLS;
use fieldbeat_core::cycle::Plan;
use fieldbeat_core::inputs::entry::{Kind, peer_of, place_of};
use fieldbeat_core::inputs::replaying::{Broken, Entry};
use fieldbeat_core::logged::{LinkEvent, LinkPassed};
use fieldbeat_core::time::Time;
use fieldbeat_keys::telegram::{Carrier, Front, Telegrams};
use fieldbeat_record::log::layout::LINK_TOPIC;
use fieldbeat_record::recording::reading::Reading;

use super::headers::{MOST_BYTES, datagram, segment};
use super::writer::Writer;
use super::{Direction, ETHERNET, USER0};

/// The first port of ours where the kernel chose one (RFC 6335).
const FIRST_PORT: u16 = 49_152;

const SYNTHETIC: &str = "Headers of Ethernet, IPv4, UDP and TCP are synthetic, made of the addresses of the \
     configuration, with 0.0.0.0 where it has none and ports from 49152 on where the kernel chose them: the recording \
     has what they carry.";
const AS_IT_WAS: &str = "Frames as they were.";
const SERIAL: &str =
    "Telegrams of the serial wire, one in each packet, by the link type of private use 147 (USER0).";

/// The ns by which a recording is later by UTC than by the clock of the loop: that of its first message.
pub fn utc_ns(recording: Reading) -> i64 {
    let messages = recording.map_while(Result::ok);
    let both = messages.map(|message| (message.utc_ns, message.number("monotonic_ns")));
    let found = both.into_iter().find(|(_, monotonic_ns)| *monotonic_ns != 0);
    found.map_or(0, |(utc_ns, monotonic_ns)| utc_ns.wrapping_sub(monotonic_ns).cast_signed())
}

/// The bytes that the link thread had on connections in a recording, in the order of its times.
pub fn link_of(recording: Reading) -> impl Iterator<Item = LinkPassed> {
    let messages = recording.map_while(Result::ok).filter(|message| message.topic.name == LINK_TOPIC);
    messages.filter_map(|message| {
        let number = |field| message.number(field);
        let ip = Ipv4Addr::from_bits(number("address").try_into().ok()?);
        Some(LinkPassed {
            at: Time(number("monotonic_ns")),
            bus: number("bus").try_into().ok()?,
            index: number("connection").try_into().ok()?,
            peer: SocketAddrV4::new(ip, number("port").try_into().ok()?),
            event: *LinkEvent::ALL.get(usize::try_from(number("event")).ok()?)?,
            bytes: message.bytes("bytes"),
        })
    })
}

/// The result of [`link_of`].
pub type Link = Peekable<Box<dyn Iterator<Item = LinkPassed>>>;

/// Makes packets of what is logged.
pub struct Export<W> {
    out: Writer<W>,
    /// The bytes that the link thread had on connections, as far as no packets were made of them.
    link: Link,
    /// There is some: it says when a connection begins.
    has_link: bool,
    utc_ns: i64,
    buses: Vec<Bus>,
    /// Of this cycle.
    cycle: Vec<Passed>,
    /// The next port of ours.
    port: u16,
    /// The last value of a source: with the bytes behind it a connection that was ready, else one that was opened.
    value: Option<(u64, u64)>,
    /// The buses whose connections are of these sources.
    sources: HashMap<u64, usize>,
}

/// A bus.
#[derive(Debug)]
struct Bus {
    local: SocketAddrV4,
    drives: Vec<SocketAddrV4>,
    /// Of a serial wire.
    front: Option<fn(&[u8]) -> Front>,
    streams: Vec<Stream>,
    inbound: Half,
    outbound: Half,
}

/// A connection.
#[derive(Clone, Copy, Debug)]
struct Stream {
    /// Our port; `None`: nothing has passed it yet.
    port: Option<u16>,
    /// The numbers of the next byte out and in.
    next: [u32; 2],
}

/// One direction of a serial wire.
#[derive(Debug, Default)]
struct Half {
    bytes: Vec<u8>,
    at: Time,
}

/// A message that passed a wire.
#[derive(Debug)]
struct Passed {
    at: Time,
    bus: usize,
    what: PassedKind,
    direction: Direction,
    bytes: Vec<u8>,
}

#[derive(Clone, Copy, Debug)]
enum PassedKind {
    Frame,
    Datagram(SocketAddrV4),
    /// Of this connection, or of the serial wire.
    Bytes(usize),
    /// Of this connection to there, while the link thread has it.
    LinkBytes(usize, SocketAddrV4),
    /// This connection has ended, or is another one from here on.
    NewConnection(usize),
}

impl From<LinkPassed> for Passed {
    fn from(LinkPassed { at, bus, index, peer, event, bytes }: LinkPassed) -> Passed {
        let (bus, index) = (bus.into(), index.into());
        let (what, direction) = match event {
            LinkEvent::Opened | LinkEvent::Closed => (PassedKind::NewConnection(index), Direction::Outbound),
            LinkEvent::Sent => (PassedKind::LinkBytes(index, peer), Direction::Outbound),
            LinkEvent::Received => (PassedKind::LinkBytes(index, peer), Direction::Inbound),
        };
        Passed { at, bus, what, direction, bytes }
    }
}

const NEW: Stream = Stream { port: None, next: [1, 1] };

/// The telegrams of a protocol's wires.
fn telegrams(protocol: &str) -> &'static [Telegrams] {
    PROTOCOLS.iter().find(|known| known.name == protocol).map_or(&[], |known| known.telegrams)
}

impl<W> std::fmt::Debug for Export<W> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Export").field("buses", &self.buses).finish_non_exhaustive()
    }
}

impl<W: Write> Export<W> {
    /// Begins the capture of a machine, by this program, with so many ns from the clock of its loop to UTC, and with
    /// what the link thread had on connections.
    pub fn new(
        out: W,
        program: &str,
        plan: &Plan,
        utc_ns: i64,
        link: impl Iterator<Item = LinkPassed> + 'static,
    ) -> io::Result<Export<W>> {
        let mut link: Link = (Box::new(link) as Box<dyn Iterator<Item = LinkPassed>>).peekable();
        let mut out = Writer::new(out, program, SYNTHETIC)?;
        let mut buses = Vec::new();
        for (bus, facts) in plan.buses.iter().zip(plan.facts()) {
            let telegrams = telegrams(facts.protocol);
            let serial = telegrams.iter().find(|of| of.carrier == Carrier::Serial);
            let are_frames = telegrams.iter().any(|of| matches!(of.carrier, Carrier::Frames(_)));
            let (link_type, comment) = match (serial, are_frames) {
                (Some(_), _) => (USER0, SERIAL),
                (None, true) => (ETHERNET, AS_IT_WAS),
                (None, false) => (ETHERNET, SYNTHETIC),
            };
            out.interface(link_type, bus.name(), facts.protocol, comment)?;
            let drives = facts.addresses();
            buses.push(Bus {
                local: facts.local.unwrap_or(SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, 0)),
                streams: vec![NEW; drives.len()],
                drives,
                front: serial.map(|of| of.front),
                inbound: Half::default(),
                outbound: Half::default(),
            });
        }
        Ok(Export {
            out,
            has_link: link.peek().is_some(),
            link,
            utc_ns,
            buses,
            cycle: Vec::new(),
            port: FIRST_PORT,
            value: None,
            sources: HashMap::new(),
        })
    }

    /// Takes the next entry of the log, before which so many looks found nothing.
    pub fn enter(&mut self, looks: u64, entry: &Entry) -> io::Result<()> {
        let (bus, index) = place_of(entry.word(0));
        self.learn(looks, entry);
        let passed =
            |what, direction, words| Passed { at: entry.at, bus, what, direction, bytes: entry.bytes(words) };
        let peer = PassedKind::Datagram(peer_of(entry.word(0)));
        self.cycle.push(match entry.kind {
            Kind::Cycle => return self.flush(),
            Kind::Value => {
                self.value = Some((entry.word(0), entry.word(1)));
                return Ok(());
            }
            Kind::DatagramIn => passed(peer, Direction::Inbound, 1),
            Kind::DatagramOut => passed(peer, Direction::Outbound, 1),
            Kind::FrameIn => passed(PassedKind::Frame, Direction::Inbound, 1),
            Kind::FrameOut => passed(PassedKind::Frame, Direction::Outbound, 1),
            Kind::BytesIn => passed(PassedKind::Bytes(index), Direction::Inbound, 1),
            Kind::BytesOut => {
                let mut out = passed(PassedKind::Bytes(index), Direction::Outbound, 2);
                // The rest is handed over again.
                out.bytes.truncate(entry.word(1) as usize);
                out
            }
            Kind::Broken | Kind::BytesUnsent => Passed {
                bytes: Vec::new(),
                ..passed(PassedKind::NewConnection(index), Direction::Outbound, 2)
            },
            _ => return Ok(()),
        });
        Ok(())
    }

    /// Distinguishes the two meanings of a value that names a connection: it was ready, and the next look of all takes
    /// its bytes; or it was opened. Each bus has one source for both.
    fn learn(&mut self, looks: u64, entry: &Entry) {
        let Some((source, value)) = self.value.take().filter(|_| !self.has_link) else { return };
        let (bus, index) = place_of(entry.word(0));
        let is_taken = looks == 0 && matches!(entry.kind, Kind::BytesIn | Kind::Broken);
        if is_taken && index as u64 == value && self.buses.get(bus).is_some_and(|bus| !bus.drives.is_empty())
        {
            self.sources.insert(source, bus);
        } else if let Some(&bus) = self.sources.get(&source) {
            let (what, direction) = (PassedKind::NewConnection(value as usize), Direction::Outbound);
            self.cycle.push(Passed { at: entry.at, bus, what, direction, bytes: Vec::new() });
        }
    }

    /// Writes the packets of a cycle, and those of the link thread up to its last one.
    fn flush(&mut self) -> io::Result<()> {
        let mut cycle = std::mem::take(&mut self.cycle);
        let last = cycle.iter().map(|passed| passed.at).max();
        while let Some(passed) = self.link.next_if(|passed| Some(passed.at) <= last) {
            cycle.push(passed.into());
        }
        cycle.sort_by_key(|passed| passed.at);
        cycle.iter().try_for_each(|passed| self.write(passed))?;
        cycle.clear();
        self.cycle = cycle;
        Ok(())
    }

    fn write(&mut self, passed: &Passed) -> io::Result<()> {
        let &Passed { at, bus: place, what, direction, ref bytes } = passed;
        let Some(bus) = self.buses.get_mut(place) else { return Ok(()) };
        let utc_ns = at.0.wrapping_add_signed(self.utc_ns);
        let mut put =
            |bytes: &[u8], utc_ns, direction| self.out.packet(place as u32, utc_ns, direction, bytes);
        match what {
            PassedKind::Frame => put(bytes, utc_ns, direction),
            PassedKind::Datagram(peer) => {
                let packet = match direction {
                    Direction::Inbound => datagram(peer, bus.local, bytes),
                    Direction::Outbound => datagram(bus.local, peer, bytes),
                };
                put(&packet, utc_ns, direction)
            }
            PassedKind::Bytes(index) | PassedKind::LinkBytes(index, _) => {
                match (bus.front, bus.streams.get_mut(index)) {
                    (Some(front), _) => bus.serial(front, passed, |bytes, at: Time, direction| {
                        put(bytes, at.0.wrapping_add_signed(self.utc_ns), direction)
                    }),
                    (None, Some(stream)) => {
                        let drive = match what {
                            PassedKind::LinkBytes(_, peer) => peer,
                            _ => bus.drives[index],
                        };
                        let port = stream.port.unwrap_or(self.port);
                        if stream.port.replace(port).is_none() {
                            self.port = port.checked_add(1).unwrap_or(FIRST_PORT);
                        }
                        let local = SocketAddrV4::new(*bus.local.ip(), port);
                        for piece in bytes.chunks(MOST_BYTES) {
                            let [out, inward] = &mut stream.next;
                            let packet = match direction {
                                Direction::Outbound => segment(local, drive, [*out, *inward], piece),
                                Direction::Inbound => segment(drive, local, [*inward, *out], piece),
                            };
                            let next = if direction == Direction::Outbound { out } else { inward };
                            *next = next.wrapping_add(piece.len() as u32);
                            put(&packet, utc_ns, direction)?;
                        }
                        Ok(())
                    }
                    _ => Ok(()),
                }
            }
            PassedKind::NewConnection(index) => {
                if let Some(stream) = bus.streams.get_mut(index) {
                    *stream = NEW;
                }
                Ok(())
            }
        }
    }

    /// Writes what is left, and what says how much it is: the number of packets.
    pub fn finish(mut self) -> io::Result<(u64, W)> {
        self.flush()?;
        while let Some(passed) = self.link.next() {
            self.write(&passed.into())?;
        }
        for (place, bus) in self.buses.iter_mut().enumerate() {
            for (half, direction) in
                [(&mut bus.outbound, Direction::Outbound), (&mut bus.inbound, Direction::Inbound)]
            {
                if let Some((bytes, at)) = half.rest() {
                    let utc_ns = at.0.wrapping_add_signed(self.utc_ns);
                    self.out.packet(place as u32, utc_ns, direction, &bytes)?;
                }
            }
        }
        self.out.finish()
    }

    /// Writes all that a log has. Returns the number of packets, and whether an entry was broken, before which all is
    /// written.
    pub fn all(
        mut self,
        entries: impl Iterator<Item = Result<(u64, Entry), Broken>>,
    ) -> io::Result<(u64, bool)> {
        let mut is_broken = false;
        for (looks, entry) in entries.map_while(|entry| entry.map_err(|Broken| is_broken = true).ok()) {
            self.enter(looks, &entry)?;
        }
        let (packets, _) = self.finish()?;
        Ok((packets, is_broken))
    }
}

impl Bus {
    /// The telegrams that are whole with the bytes that passed. What the other side began is over then.
    fn serial(
        &mut self,
        front: fn(&[u8]) -> Front,
        passed: &Passed,
        mut put: impl FnMut(&[u8], Time, Direction) -> io::Result<()>,
    ) -> io::Result<()> {
        let (half, other, against) = match passed.direction {
            Direction::Inbound => (&mut self.inbound, &mut self.outbound, Direction::Outbound),
            Direction::Outbound => (&mut self.outbound, &mut self.inbound, Direction::Inbound),
        };
        if let Some((bytes, at)) = other.rest() {
            put(&bytes, at, against)?;
        }
        half.bytes.extend(&passed.bytes);
        half.at = passed.at;
        while let Front::Telegram(size) | Front::Foreign(size) = front(&half.bytes) {
            let size = size.clamp(1, half.bytes.len().max(1));
            let Some(telegram) = half.bytes.get(..size) else { break };
            put(telegram, half.at, passed.direction)?;
            half.bytes.drain(..size);
        }
        Ok(())
    }
}

impl Half {
    /// Bytes that no telegram was made of.
    fn rest(&mut self) -> Option<(Vec<u8>, Time)> {
        let bytes = std::mem::take(&mut self.bytes);
        (!bytes.is_empty()).then_some((bytes, self.at))
    }
}

#[cfg(test)]
mod tests;
