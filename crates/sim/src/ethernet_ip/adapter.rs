//! The network side of the drive: what comes on each of its sockets, and what it answers.
//!
//! Knows no motor. Facts: sheet, 1.2 to 1.4, 4; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a command of a session that comes as a datagram | status 1 |
//! | a datagram that is not exactly one frame | is dropped |
//! | items that are no items | status 3 |
//! | a class 3 message on another TCP connection than that of its open | is dropped |
//! | a datagram to everybody that asks for no list | is dropped |
//! | a class 3 message longer than its connection | is dropped |

use std::net::{Ipv4Addr, SocketAddrV4};

use super::cip::{self, Failure, Reader, general};
use super::connections::{Connections, Ended, Use};
use super::drive::Drive;
use super::items::{self, Items, item, sockaddr};
use super::sessions::{HEADER, Header, Sessions, command, status};
use super::settings::MoonsSettings;
use super::{assembly, consume, router};
use fieldbeat_core::time::{MS, Time};

/// What the drive did not answer or did not act on, by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ignored {
    /// Frames whose status or options are not 0.
    pub bad_header: u64,
    /// Frames that are too long, or too short for their command.
    pub bad_length: u64,
    /// Datagrams that are not one frame.
    pub no_frame: u64,
    /// Packets and messages to connections that are not open.
    pub unknown_connection: u64,
    /// Packets and messages of somebody else than the connection's originator.
    pub wrong_source: u64,
    /// Packets of other item types.
    pub wrong_items: u64,
    /// Packets and messages of another length than was agreed.
    pub wrong_length: u64,
    /// Packets that are not newer than the newest.
    pub old_sequence: u64,
    /// Packets whose data is not new. They count for the watchdog.
    pub duplicate: u64,
    /// Packets of an idle owner. They count for the watchdog.
    pub idle: u64,
    /// Class 3 messages that came again, and were answered again.
    pub repeated: u64,
}

/// Sessions, connections and objects of one drive.
#[derive(Debug)]
pub(super) struct Adapter {
    pub settings: MoonsSettings,
    pub sessions: Sessions,
    pub connections: Connections,
    /// The newest outputs.
    pub outputs: [u8; assembly::OUTPUT_SIZE],
    pub configuration: [u8; assembly::CONFIGURATION_SIZE],
    pub ignored: Ignored,
    packet: Vec<u8>,
    /// Answers to datagrams that went to everybody: when they leave, where to.
    found: Vec<(Time, SocketAddrV4, Vec<u8>)>,
}

/// A device waits at random before it answers a datagram to everybody, up to so many ms; and up to this where the
/// request names nothing.
const LEAST_WAIT_MS: u16 = 500;
const USUAL_WAIT_MS: u16 = 2_000;
/// The most answers that wait.
const MOST_FOUND: usize = 16;

/// A message, and where it came from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Origin {
    pub now: Time,
    pub peer: SocketAddrV4,
    /// The port that the originator wants packets at.
    pub port: Option<u16>,
}

/// Items that a reply has in addition.
pub(super) type Extra = Vec<(u16, SocketAddrV4)>;

impl Adapter {
    pub(super) fn new(settings: &MoonsSettings) -> Adapter {
        let ip = *settings.address.ip();
        Adapter {
            sessions: Sessions::new(&settings.network),
            connections: Connections::new(&settings.network, settings.clock, ip),
            outputs: [0; assembly::OUTPUT_SIZE],
            configuration: [0; assembly::CONFIGURATION_SIZE],
            ignored: Ignored::default(),
            packet: Vec::new(),
            found: Vec::new(),
            settings: settings.clone(),
        }
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.found.clear();
        self.sessions.restart(&self.settings.network);
        self.connections.restart();
        self.outputs = [0; assembly::OUTPUT_SIZE];
        self.configuration = [0; assembly::CONFIGURATION_SIZE];
    }

    pub(super) fn ip(&self) -> Ipv4Addr {
        *self.settings.address.ip()
    }

    pub(super) fn serial(&self) -> u32 {
        self.settings.identity.serial.unwrap_or(self.ip().to_bits())
    }

    /// Bytes of a TCP connection.
    pub(super) fn stream(
        &mut self,
        now: Time,
        peer: SocketAddrV4,
        bytes: &[u8],
        drive: &mut Drive,
        out: &mut Vec<u8>,
    ) {
        self.sessions.take(now, peer, bytes);
        while let Some((header, data)) = self.sessions.frame(peer) {
            let dropped =
                (header.status != 0 || header.options != 0) && header.command != command::UNREGISTER;
            match data {
                Err(_) => {
                    self.ignored.bad_length += 1;
                    header.answer(out, |_| status::LENGTH);
                }
                Ok(_) if dropped => self.ignored.bad_header += 1,
                Ok(data) => self.frame(now, peer, header, &data, drive, out),
            }
        }
    }

    fn frame(
        &mut self,
        now: Time,
        peer: SocketAddrV4,
        header: Header,
        data: &[u8],
        drive: &mut Drive,
        out: &mut Vec<u8>,
    ) {
        let own = self.sessions.handle(peer);
        let known = own.is_some_and(|own| own == header.session);
        match header.command {
            command::NOP => {}
            command::REGISTER => {
                let (session, status) = self.sessions.register(peer, data);
                Header { session, ..header }.answer(out, |out| {
                    if status != status::LENGTH {
                        out.extend([1, 0, 0, 0]);
                    }
                    status
                });
            }
            command::UNREGISTER if known => self.sessions.end(peer),
            command::UNREGISTER | command::SEND_RR_DATA | command::SEND_UNIT_DATA if !known => {
                header.answer(out, |_| status::SESSION);
            }
            command::SEND_RR_DATA | command::SEND_UNIT_DATA => {
                // Interface handle and timeout.
                let Some((_, body)) = data.split_at_checked(6) else {
                    self.ignored.bad_length += 1;
                    return;
                };
                match header.command {
                    command::SEND_RR_DATA => self.unconnected(now, peer, header, body, drive, out),
                    _ => self.connected(now, peer, header, body, drive, out),
                }
            }
            _ => self.listed(header, out),
        }
    }

    /// A datagram to the port of sessions.
    pub(super) fn datagram(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        match Header::parse(bytes) {
            Some(header) if bytes.len() != HEADER + usize::from(header.length) => self.ignored.no_frame += 1,
            None => self.ignored.no_frame += 1,
            Some(header) if header.status != 0 || header.options != 0 => self.ignored.bad_header += 1,
            Some(header) if header.command == command::NOP => {}
            Some(header) => self.listed(header, out),
        }
    }

    /// A datagram to everybody in its network: its answer leaves after a while, so that not all devices answer at once.
    pub(super) fn searched(&mut self, now: Time, from: SocketAddrV4, bytes: &[u8]) {
        let mask = self.settings.network.mask.to_bits();
        if (from.ip().to_bits() ^ self.ip().to_bits()) & mask != 0 {
            return;
        }
        let mut answer = Vec::new();
        self.datagram(bytes, &mut answer);
        let Some(header) = Header::parse(&answer).filter(|header| header.status == status::OK) else {
            return;
        };
        let most_ms = match u16::from_le_bytes([header.context[0], header.context[1]]) {
            0 => USUAL_WAIT_MS,
            most_ms => most_ms.max(LEAST_WAIT_MS),
        };
        // As good as random, and the same for the same seed.
        let mixed = (now.0 ^ u64::from(self.serial()) << 32 ^ self.settings.clock.seed)
            .wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let wait_ns = (mixed >> 32) % (u64::from(most_ms) * MS);
        if self.found.len() < MOST_FOUND {
            self.found.push((now + wait_ns, from, answer));
        }
    }

    /// The next answer that leaves.
    pub(super) fn found(&mut self, now: Time) -> Option<(SocketAddrV4, Vec<u8>)> {
        let place = self.found.iter().position(|(at, ..)| *at <= now)?;
        let (_, to, answer) = self.found.swap_remove(place);
        Some((to, answer))
    }

    /// What needs no session.
    fn listed(&self, header: Header, out: &mut Vec<u8>) {
        header.answer(out, |out| {
            match header.command {
                command::LIST_SERVICES => {
                    let mut data = vec![1, 0, 0x20, 1];
                    data.extend(b"Communications\0\0");
                    out.extend([1, 0]);
                    items::append(item::SERVICES, &data, out);
                }
                command::LIST_IDENTITY => {
                    out.extend([1, 0]);
                    items::append(item::IDENTITY, &self.identity(), out);
                }
                command::LIST_INTERFACES => out.extend([0, 0]),
                _ => return status::COMMAND,
            }
            status::OK
        });
    }

    fn identity(&self) -> Vec<u8> {
        let mut data = vec![1, 0];
        data.extend(sockaddr(self.settings.address));
        router::identity(self, &mut data);
        // Operational.
        data.push(3);
        data
    }

    fn unconnected(
        &mut self,
        now: Time,
        peer: SocketAddrV4,
        header: Header,
        body: &[u8],
        drive: &mut Drive,
        out: &mut Vec<u8>,
    ) {
        let items = Items::parse(body).filter(|items| items.data.0 == item::UNCONNECTED_DATA);
        let items = items.filter(|items| items.address == (item::NULL, &[]) && !items.data.1.is_empty());
        header.answer(out, |out| {
            let Some(items) = items else { return status::DATA };
            let (mut reply, mut extra) = (Vec::new(), Extra::new());
            let origin = Origin { now, peer, port: items.port };
            router::message(self, origin, items.data.1, drive, &mut reply, &mut extra);
            out.extend([0; 6]);
            out.extend((2 + extra.len() as u16).to_le_bytes());
            items::append(item::NULL, &[], out);
            items::append(item::UNCONNECTED_DATA, &reply, out);
            extra.iter().for_each(|(kind, address)| items::append(*kind, &sockaddr(*address), out));
            status::OK
        });
    }

    fn connected(
        &mut self,
        now: Time,
        peer: SocketAddrV4,
        header: Header,
        body: &[u8],
        drive: &mut Drive,
        out: &mut Vec<u8>,
    ) {
        let Some(Items {
            address: (item::CONNECTED_ADDRESS, id), data: (item::CONNECTED_DATA, data), ..
        }) = Items::parse(body)
        else {
            return header.answer(out, |_| status::DATA);
        };
        let id = Reader(id).u32();
        let messages = |connection: &&mut super::connections::Connection| {
            connection.purpose == Use::Messages && Some(connection.consumed) == id
        };
        let Some(connection) = self.connections.open.iter_mut().find(messages) else {
            self.ignored.unknown_connection += 1;
            return;
        };
        if connection.peer != peer {
            self.ignored.wrong_source += 1;
            return;
        }
        let Some(count) = Reader(data).u16().filter(|_| data.len() <= connection.sizes.0.into()) else {
            self.ignored.wrong_length += 1;
            return;
        };
        connection.feed(now);
        let (produced, consumed, room) = (connection.produced, connection.consumed, connection.sizes.1);
        if connection.count == count {
            self.ignored.repeated += 1;
            drive.fed(now);
        } else {
            let mut reply = Vec::new();
            let origin = Origin { now, peer, port: None };
            router::message(self, origin, &data[2..], drive, &mut reply, &mut Extra::new());
            if reply.len() + 2 > room.into() {
                reply.clear();
                let service = data.get(2).copied().unwrap_or_default();
                cip::refused(service, Failure::general(general::TOO_LARGE), &mut reply);
            }
            // The message may have closed its own connection.
            let Some(connection) = self.connections.open.iter_mut().find(|open| open.consumed == consumed)
            else {
                return;
            };
            (connection.count, connection.reply) = (count, Some(reply));
        }
        let open = self.connections.open.iter().find(|open| open.consumed == consumed);
        let Some(reply) = open.and_then(|open| open.reply.as_deref()) else { return };
        header.answer(out, |out| {
            out.extend([0; 6]);
            out.extend([2, 0]);
            items::append(item::CONNECTED_ADDRESS, &produced.to_le_bytes(), out);
            let mut message = count.to_le_bytes().to_vec();
            message.extend(reply);
            items::append(item::CONNECTED_DATA, &message, out);
            status::OK
        });
    }

    /// A class 1 packet.
    pub(super) fn packet(&mut self, now: Time, from: SocketAddrV4, bytes: &[u8], drive: &mut Drive) {
        consume::packet(self, now, *from.ip(), bytes, drive);
    }

    /// When it wants to run.
    pub(super) fn next_due(&self) -> Option<Time> {
        let found = self.found.iter().map(|(at, ..)| *at).min();
        [self.sessions.next_due(), self.connections.next_due(), found].into_iter().flatten().min()
    }

    /// Time-outs, then packets.
    pub(super) fn run(&mut self, now: Time, drive: &mut Drive, send: &mut dyn FnMut(SocketAddrV4, &[u8])) {
        self.sessions.run(now);
        while let Some(ended) = self.connections.time_out(now) {
            ended.iter().for_each(|ended| self.ended(*ended, true, drive));
        }
        let report = drive.report();
        let ip = self.ip();
        for producer in &mut self.connections.producers {
            self.packet.clear();
            if producer.packet(now, &mut self.packet) {
                report.append(producer.input, ip, &self.settings.firmware, &mut self.packet);
                send(producer.to, &self.packet);
            }
        }
    }

    /// A connection has ended.
    pub(super) fn ended(&mut self, ended: Ended, timed_out: bool, drive: &mut Drive) {
        if let Some(peer) = ended.hangs_up {
            self.sessions.end(peer);
            self.connections.disconnected(peer);
        }
        if matches!(ended.purpose, Use::Owner(_)) {
            self.outputs = [0; assembly::OUTPUT_SIZE];
            drive.released(timed_out);
        }
    }

    /// A TCP connection has ended.
    pub(super) fn disconnected(&mut self, peer: SocketAddrV4) {
        self.sessions.disconnect(peer);
        self.connections.disconnected(peer);
    }
}
