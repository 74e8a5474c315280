//! A capture in words: a line for each telegram of a protocol that is known here.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::net::SocketAddrV4;
use std::time::{Duration, UNIX_EPOCH};

use fieldbeat_config::PROTOCOLS;
use fieldbeat_keys::telegram::{Carrier, Front, Telegrams, Way};

use super::headers::{Carried, Frame, Segment, frame};
use super::reader::{Interface, Packet};
use super::stream::Stream;
use super::{Direction, ETHERNET, PROFIBUS, USER0};

/// The number of unknown kinds that are named, those of the most packets.
const MOST_NAMED: usize = 8;

/// A telegram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Telegram<'a> {
    /// When, ns of UTC, if that is known.
    pub utc_ns: Option<u64>,
    /// The interface that it was captured on.
    pub interface: &'a str,
    /// The direction there, if that is known.
    pub direction: Option<Direction>,
    /// From where, and to where.
    pub ends: [String; 2],
    /// The protocol, as in configurations.
    pub protocol: &'static str,
    /// The fields.
    pub text: String,
}

impl fmt::Display for Telegram<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let at = self.utc_ns.and_then(|ns| UNIX_EPOCH.checked_add(Duration::from_nanos(ns)));
        match at {
            Some(at) => write!(f, "{}", humantime::format_rfc3339_nanos(at))?,
            None => f.write_str("-")?,
        }
        let direction = match self.direction {
            Some(Direction::Inbound) => "in",
            Some(Direction::Outbound) => "out",
            None => "-",
        };
        let Telegram { interface, ends: [from, to], protocol, text, .. } = self;
        write!(f, " {interface} {direction} {from} > {to} {protocol}: {text}")
    }
}

/// Two ends of what a packet carries.
type Ends = (SocketAddrV4, SocketAddrV4);

/// Reads packets.
#[derive(Debug, Default)]
pub struct Decoder {
    ports: Vec<(&'static str, u16)>,
    streams: HashMap<Ends, Stream>,
    counts: BTreeMap<&'static str, u64>,
    others: BTreeMap<String, u64>,
}

/// The packet that is read, and its interface.
struct PacketContext<'a> {
    interface: &'a Interface,
    packet: &'a Packet,
}

/// All that is known, each with the name of its protocol.
fn known() -> impl Iterator<Item = (&'static str, &'static Telegrams)> {
    PROTOCOLS.iter().flat_map(|protocol| protocol.telegrams.iter().map(|of| (protocol.name, of)))
}

/// The port of a carrier that has one, for datagrams or for connections.
fn port(carrier: Carrier, is_stream: bool) -> Option<u16> {
    match carrier {
        Carrier::Datagrams(port) if !is_stream => Some(port),
        Carrier::Streams(port) if is_stream => Some(port),
        _ => None,
    }
}

/// The telegrams between two ends, and which way they go.
type TelegramFlow = (&'static str, &'static Telegrams, Way);

impl Decoder {
    /// One without a packet. Drives of these protocols have these ports, too.
    pub fn new(ports: Vec<(&'static str, u16)>) -> Decoder {
        Decoder { ports, ..Decoder::default() }
    }

    /// The telegrams that are whole with this packet. `take` gets each; its error ends it.
    pub fn enter<E>(
        &mut self,
        interface: &Interface,
        packet: &Packet,
        mut take: impl FnMut(&Telegram<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let around = PacketContext { interface, packet };
        match interface.link_type {
            ETHERNET => match frame(&packet.bytes) {
                Some(frame) => self.frame(&around, &frame, &mut take),
                None => self.other("short frames"),
            },
            USER0 | PROFIBUS => self.serial(&around, &mut take),
            other => self.other(format!("link type {other}")),
        }
    }

    fn frame<E>(
        &mut self,
        around: &PacketContext<'_>,
        frame: &Frame<'_>,
        take: &mut impl FnMut(&Telegram<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let is_of = |of: &Telegrams| of.carrier == Carrier::Frames(frame.ethertype);
        if let Some((name, telegrams)) = known().find(|(_, of)| is_of(of)) {
            let bytes = &around.packet.bytes;
            let is_tagged = bytes.len() != 14 + frame.payload.len();
            let bytes: Cow<'_, [u8]> = match is_tagged {
                true => [frame.addresses, &frame.ethertype.to_be_bytes(), frame.payload].concat().into(),
                false => bytes.into(),
            };
            let [to, from] = [0, 6].map(|at| mac(&frame.addresses[at..at + 6]));
            return self.telegram(around, [from, to], (name, telegrams, Way::Unknown), &bytes, take);
        }
        match frame.ipv4() {
            Some(Carried::Datagram(from, to, bytes)) => {
                let Some(of) = self.between((from, to), false, around) else {
                    return self.other(format!("UDP port {}", from.port().min(to.port())));
                };
                self.telegram(around, [from, to].map(|end| end.to_string()), of, bytes, take)
            }
            Some(Carried::Segment(from, to, segment)) => {
                let Some(of) = self.between((from, to), true, around) else {
                    return self.other(format!("TCP port {}", from.port().min(to.port())));
                };
                self.segment(around, (from, to), of, segment, take)
            }
            Some(Carried::Fragment) => self.other("fragments of IPv4"),
            Some(Carried::Other(protocol)) => self.other(format!("IPv4 protocol {protocol}")),
            None => self.other(match frame.ethertype {
                0x0800 => "broken packets of IPv4".to_owned(),
                other => format!("Ethertype {other:#06x}"),
            }),
        }
    }

    /// The telegrams between these ends, and which way they go: by their ports, or by the bus of a capture that was
    /// made here, whose drives may have others.
    fn between(&self, (from, to): Ends, is_stream: bool, around: &PacketContext<'_>) -> Option<TelegramFlow> {
        let by_direction = match around.packet.direction {
            Some(Direction::Outbound) => Way::ToDrive,
            Some(Direction::Inbound) => Way::FromDrive,
            None => Way::Unknown,
        };
        let named =
            |name: &str| known().find(|(known, of)| *known == name && port(of.carrier, is_stream).is_some());
        let of = |end: SocketAddrV4| {
            let usual = known().find(|(_, of)| port(of.carrier, is_stream) == Some(end.port()));
            let added = || self.ports.iter().find(|(_, port)| *port == end.port());
            usual.or_else(|| named(added()?.0))
        };
        let (is_from, is_to) = (of(from), of(to));
        let way = match (is_from, is_to) {
            (None, Some(_)) => Way::ToDrive,
            (Some(_), None) => Way::FromDrive,
            _ => by_direction,
        };
        let (name, telegrams) = is_to.or(is_from).or_else(|| named(&around.interface.description))?;
        Some((name, telegrams, way))
    }

    fn segment<E>(
        &mut self,
        around: &PacketContext<'_>,
        ends: Ends,
        of: TelegramFlow,
        segment: Segment<'_>,
        take: &mut impl FnMut(&Telegram<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut stream = self.streams.remove(&ends).unwrap_or_default();
        if stream.take(segment) {
            self.count("gaps in TCP");
        }
        let names = [ends.0, ends.1].map(|end| end.to_string());
        let (mut result, mut rest) = (Ok(()), &stream.bytes[..]);
        while result.is_ok() {
            let size = match (of.1.front)(rest) {
                Front::Incomplete => break,
                Front::Telegram(size) => size.clamp(1, rest.len()),
                Front::Foreign(_) => rest.len(),
            };
            let (telegram, behind) = rest.split_at(size);
            rest = behind;
            result = self.telegram(around, names.clone(), of, telegram, take);
        }
        let taken = stream.bytes.len() - rest.len();
        stream.bytes.drain(..taken);
        self.streams.insert(ends, stream);
        result
    }

    /// One telegram in each packet, as a rule.
    fn serial<E>(
        &mut self,
        around: &PacketContext<'_>,
        take: &mut impl FnMut(&Telegram<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let Some((name, telegrams)) = known().find(|(_, of)| of.carrier == Carrier::Serial) else {
            return Ok(());
        };
        let mut rest = &around.packet.bytes[..];
        while !rest.is_empty() {
            let size = match (telegrams.front)(rest) {
                Front::Telegram(size) | Front::Foreign(size) => size.clamp(1, rest.len()),
                Front::Incomplete => rest.len(),
            };
            let (telegram, behind) = rest.split_at(size);
            rest = behind;
            let nowhere = ["-", "-"].map(str::to_owned);
            self.telegram(around, nowhere, (name, telegrams, Way::Unknown), telegram, take)?;
        }
        Ok(())
    }

    fn telegram<E>(
        &mut self,
        around: &PacketContext<'_>,
        ends: [String; 2],
        (protocol, telegrams, way): TelegramFlow,
        bytes: &[u8],
        take: &mut impl FnMut(&Telegram<'_>) -> Result<(), E>,
    ) -> Result<(), E> {
        let Some(words) = (telegrams.words)(bytes, way) else {
            return self.other(format!("no telegrams of {protocol}"));
        };
        *self.counts.entry(protocol).or_default() += 1;
        take(&Telegram {
            utc_ns: around.packet.utc_ns,
            interface: &around.interface.name,
            direction: around.packet.direction,
            ends: words.stations.map_or(ends, |stations| stations.map(|station| station.to_string())),
            protocol,
            text: words.text,
        })
    }

    /// The packet, or a part of it, is something else.
    fn other<E>(&mut self, kind: impl Into<String>) -> Result<(), E> {
        self.count(kind);
        Ok(())
    }

    fn count(&mut self, kind: impl Into<String>) {
        *self.others.entry(kind.into()).or_default() += 1;
    }

    /// How many telegrams of each protocol it had.
    pub fn counts(&self) -> &BTreeMap<&'static str, u64> {
        &self.counts
    }

    /// How many packets of each other kind, and how often bytes were no telegram.
    pub fn others(&self) -> &BTreeMap<String, u64> {
        &self.others
    }

    /// How much it was of what, in a line. What is still missing at the end of a connection is a gap.
    pub fn finish(&mut self) -> String {
        let gaps = self.streams.values_mut().filter_map(|stream| stream.skip().then_some(())).count();
        (0..gaps).for_each(|_| self.count("gaps in TCP"));
        let list = |counts: Vec<(&str, u64)>| {
            counts.iter().map(|(name, count)| format!("{count} {name}")).collect::<Vec<_>>().join(", ")
        };
        let total: u64 = self.counts.values().sum();
        let known = self.counts.iter().map(|(name, count)| (*name, *count)).collect();
        let mut others: Vec<_> = self.others.iter().map(|(kind, count)| (kind.as_str(), *count)).collect();
        others.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
        let more: u64 = others.drain(MOST_NAMED.min(others.len())..).map(|(_, count)| count).sum();
        if more > 0 {
            others.push(("of other kinds", more));
        }
        let mut line = format!("{total} telegrams");
        for (between, part) in [(": ", list(known)), ("; not known: ", list(others))] {
            if !part.is_empty() {
                line = line + between + &part;
            }
        }
        line
    }
}

/// An Ethernet address.
fn mac(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(":")
}
