//! The requests of a session.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::{ANSWER_NS, Connected, Io, Open, Pending, RequestKind, Session, Way};
use crate::exchange::Outputs;
use crate::plan::{Access, Delivery, Expected, IO_PORT, Originator, Version};
use crate::wire::cip::{self, Key, Segment, class, service};
use crate::wire::connection::{Direction, ForwardOpen, Target, Triad, incoming_size};
use crate::wire::message::{self, Payload, immediate};
use crate::wire::{encapsulation, io};
use fieldbeat_core::time::{MS, Time};

const CONNECTED_RPI_US: u32 = 1_000_000;
/// 32 intervals.
const CONNECTED_MULTIPLIER: u8 = 3;
/// The largest message on a class 3 connection, with its sequence number: every device has it.
const CONNECTED_SIZE: u16 = 500;
/// SC: the status word.
pub(super) const STATUS: Payload = message::immediate(immediate::READ_PARAMETER, 0x80, 0);
/// Where the identity is.
const IDENTITY: [Segment<'static>; 2] = [Segment::Class(class::IDENTITY), Segment::Instance(1)];
/// The vendor: a request that every device answers.
const VENDOR_ID: [Segment<'static>; 3] =
    [Segment::Class(class::IDENTITY), Segment::Instance(1), Segment::Attribute(1)];

/// Reads this register.
pub(super) const fn read_register(register: u8) -> Payload {
    message::immediate(immediate::READ_REGISTER, register, 0)
}

impl RequestKind {
    /// The request of something that is only read.
    pub(super) fn message(self) -> Vec<u8> {
        match self {
            RequestKind::Identity => cip::request(service::GET_ATTRIBUTES_ALL, &IDENTITY, &[]),
            RequestKind::Profile => cip::request(service::GET_ATTRIBUTE_SINGLE, &message::PROFILE_PATH, &[]),
            RequestKind::Homed(register) => {
                cip::request(service::VENDOR, &message::PATH, &read_register(register))
            }
            RequestKind::Power => cip::request(service::VENDOR, &message::PATH, &STATUS),
            _ => cip::request(service::GET_ATTRIBUTE_SINGLE, &VENDOR_ID, &[]),
        }
    }
}

impl Session {
    /// Requests something that is only read.
    pub(super) fn ask(&mut self, now: Time, out: &mut Vec<u8>, what: RequestKind) {
        self.request(now, out, what, &what.message());
    }

    /// Sends a request of the session's own.
    pub(super) fn request(&mut self, now: Time, out: &mut Vec<u8>, what: RequestKind, message: &[u8]) {
        self.send(now, out, what, now + ANSWER_NS, message, None);
    }

    /// Sends an unconnected message.
    pub(super) fn send(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        what: RequestKind,
        until: Time,
        message: &[u8],
        incoming: Option<SocketAddrV4>,
    ) {
        let context = self.next_context();
        encapsulation::send_rr_data(out, self.handle, context, message, incoming);
        self.wait(now, what, Way::Unconnected { context }, until);
    }

    /// Makes the sent request the one under way.
    pub(super) fn wait(&mut self, now: Time, what: RequestKind, way: Way, until: Time) {
        self.last_sent = now;
        self.pending = Some(Pending { what, way, sent: now, until });
    }

    /// Sends a message on the class 3 connection; false if there is none.
    pub(super) fn send_connected(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        what: RequestKind,
        until: Time,
        message: Vec<u8>,
    ) -> bool {
        let Connected::Open { outgoing, sequence, used, .. } = &mut self.connected else { return false };
        // Some adapters do not answer number 0.
        *sequence = sequence.checked_add(1).unwrap_or(1);
        *used = now;
        encapsulation::send_unit_data(out, self.handle, *outgoing, *sequence, &message);
        let way = Way::Connected { sequence: *sequence, repeat: Some(message) };
        self.wait(now, what, way, until);
        true
    }

    /// Never used twice: an answer that comes late, after its request was given up, answers nothing.
    pub(super) fn next_context(&mut self) -> u64 {
        self.context = self.context.wrapping_add(1);
        self.context
    }

    /// Reads what the loop has to know of the drive.
    pub(super) fn read_facts(&mut self, now: Time, out: &mut Vec<u8>) {
        match self.drive.homed_register {
            Some(register) => self.ask(now, out, RequestKind::Homed(register)),
            None => self.facts(None),
        }
    }

    /// Another connection serial number. The first one is taken from the clock: a drive that still has the connections
    /// of a master that has crashed sees that they are others.
    fn next_serial(&mut self, now: Time) -> u16 {
        let serial = self.serial.map_or((now.0 / MS) as u16, |serial| serial.wrapping_add(1));
        self.serial = Some(serial);
        serial
    }

    fn triad(&mut self, now: Time) -> Triad {
        let Originator { vendor, serial: originator } = self.originator;
        Triad { serial: self.next_serial(now), vendor, originator }
    }

    /// The id of a connection's packets from the drive: unique among all drives of the bus.
    fn incoming_id(&self, triad: Triad) -> u32 {
        u32::from(self.index) << 16 | u32::from(triad.serial)
    }

    /// The key that a device compares itself before it opens a connection.
    fn key(&self) -> Key {
        let Expected { vendor, product, .. } = self.drive.expected;
        Key { vendor: vendor.unwrap_or(0), product_code: product.unwrap_or(0) }
    }

    /// Opens the class 1 connection.
    pub(super) fn open(&mut self, now: Time, out: &mut Vec<u8>, version: Version) {
        let (access, delivery) = (self.access(version), self.drive.delivery);
        let (triad, target) = (self.triad(now), Target::Assemblies { access, version });
        let direction = |rpi_ns: u64, size, delivery| {
            let rpi_us = u32::try_from(rpi_ns / 1_000).unwrap_or(u32::MAX);
            Direction { rpi_us, size, delivery }
        };
        let incoming_id = match delivery {
            Delivery::PointToPoint => self.incoming_id(triad),
            // The drive chooses.
            Delivery::Multicast => 0,
        };
        let (outputs, size) = match access {
            Access::Owner => (Outputs::Owned, io::OWNER_SIZE),
            Access::InputOnly | Access::ListenOnly => {
                let size = self.form.heartbeat();
                (Outputs::Heartbeat(size), size.into())
            }
        };
        let (rpi_ns, input_rpi_ns) =
            (self.drive.rpi_ns(self.period_ns), self.drive.input_rpi_ns(self.period_ns));
        let request = ForwardOpen {
            incoming_id,
            triad,
            multiplier: self.drive.multiplier(self.period_ns),
            outgoing: direction(rpi_ns, size, Delivery::PointToPoint),
            incoming: direction(input_rpi_ns, incoming_size(version), delivery),
            key: self.key(),
            target,
            configuration: self.form.configuration(),
            large: self.form.is_large(),
        };
        let message = request.message();
        let elsewhere = delivery == Delivery::PointToPoint && self.bind.port() != IO_PORT;
        // The drive takes the port only.
        let incoming = elsewhere.then(|| SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, self.bind.port()));
        self.io = Io::Opening;
        let what = RequestKind::Open(Open { triad, target }, outputs, version);
        self.send(now, out, what, now + ANSWER_NS, &message, incoming);
    }

    /// Opens the class 3 connection.
    pub(super) fn connect(&mut self, now: Time, out: &mut Vec<u8>) {
        let triad = self.triad(now);
        let direction =
            Direction { rpi_us: CONNECTED_RPI_US, size: CONNECTED_SIZE, delivery: Delivery::PointToPoint };
        let request = ForwardOpen {
            incoming_id: self.incoming_id(triad),
            triad,
            multiplier: CONNECTED_MULTIPLIER,
            outgoing: direction,
            incoming: direction,
            key: self.key(),
            target: Target::Messages,
            configuration: &[],
            large: false,
        };
        let what = RequestKind::OpenConnected(Open { triad, target: Target::Messages });
        self.request(now, out, what, &request.message());
    }
}
