//! The requests of a session.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::{ANSWER_NS, Connected, Io, Open, Pending, Session, Way, What};
use crate::exchange::Outputs;
use crate::plan::{Access, Delivery, Expected, IO_PORT, Originator, Version};
use crate::wire::cip::{self, Configuration, Key, Segment, class, service};
use crate::wire::connection::{Direction, ForwardOpen, Route, Target, Triad, incoming_size};
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

impl Session {
    /// Sends a request of the session's own, whose message `fill` appends.
    pub(super) fn request(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        what: What,
        fill: impl FnOnce(&mut Vec<u8>),
    ) {
        let mut message = Vec::new();
        fill(&mut message);
        self.send(now, out, what, now + ANSWER_NS, &message, None);
    }

    /// Sends an unconnected message.
    pub(super) fn send(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        what: What,
        until: Time,
        message: &[u8],
        incoming: Option<SocketAddrV4>,
    ) {
        let context = self.next_context();
        encapsulation::send_rr_data(out, self.handle, context, message, incoming);
        self.last_sent = now;
        self.pending = Some(Pending { what, way: Way::Unconnected { context }, sent: now, until });
    }

    /// Sends a message on the class 3 connection; false if there is none.
    pub(super) fn send_connected(
        &mut self,
        now: Time,
        out: &mut Vec<u8>,
        what: What,
        until: Time,
        message: Vec<u8>,
    ) -> bool {
        let Connected::Open { outgoing, sequence, used, .. } = &mut self.connected else { return false };
        // Some adapters do not answer number 0.
        *sequence = sequence.checked_add(1).unwrap_or(1);
        *used = now;
        encapsulation::send_unit_data(out, self.handle, *outgoing, *sequence, &message);
        let way = Way::Connected { sequence: *sequence, repeat: Some(message) };
        self.last_sent = now;
        self.pending = Some(Pending { what, way, sent: now, until });
        true
    }

    /// Never used twice: an answer that comes late, after its request was given up, answers nothing.
    pub(super) fn next_context(&mut self) -> u64 {
        self.context = self.context.wrapping_add(1);
        self.context
    }

    /// Requests something that every device answers.
    pub(super) fn probe(&mut self, now: Time, out: &mut Vec<u8>) {
        self.request(now, out, What::Probe, |message| {
            cip::request(message, service::GET_ATTRIBUTE_SINGLE, &VENDOR_ID, &[]);
        });
    }

    /// The same on the class 3 connection.
    pub(super) fn probe_connected(&mut self, now: Time, out: &mut Vec<u8>) -> bool {
        let mut message = Vec::new();
        cip::request(&mut message, service::GET_ATTRIBUTE_SINGLE, &VENDOR_ID, &[]);
        self.send_connected(now, out, What::Probe, now + 2 * ANSWER_NS, message)
    }

    pub(super) fn identify(&mut self, now: Time, out: &mut Vec<u8>) {
        self.request(now, out, What::Identity, |message| {
            cip::request(message, service::GET_ATTRIBUTES_ALL, &IDENTITY, &[]);
        });
    }

    pub(super) fn request_profile(&mut self, now: Time, out: &mut Vec<u8>) {
        self.request(now, out, What::Profile, |message| {
            cip::request(message, service::GET_ATTRIBUTE_SINGLE, &message::PROFILE_PATH, &[]);
        });
    }

    /// Reads the status of the drive.
    pub(super) fn request_power(&mut self, now: Time, out: &mut Vec<u8>) {
        self.request(now, out, What::Power, |out| {
            cip::request(out, service::VENDOR, &message::PATH, &STATUS);
        });
    }

    /// Reads what the loop has to know of the drive.
    pub(super) fn read_facts(&mut self, now: Time, out: &mut Vec<u8>) {
        match self.drive.homed_register {
            Some(register) => self.request(now, out, What::Homed(register), |out| {
                cip::request(out, service::VENDOR, &message::PATH, &read_register(register));
            }),
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

    /// What a device compares itself before it opens a connection. It is none if it may be any.
    fn key(&self) -> Option<Key> {
        let Expected { vendor, product, .. } = self.drive.expected;
        let key = Key { vendor: vendor.unwrap_or(0), product_code: product.unwrap_or(0), ..Key::default() };
        (key != Key::default()).then_some(key)
    }

    /// Opens the class 1 connection.
    pub(super) fn open(&mut self, now: Time, out: &mut Vec<u8>, version: Version) {
        let access = self.access(version);
        let triad = self.triad(now);
        let us = |ns: u64| u32::try_from(ns / 1_000).unwrap_or(u32::MAX);
        let (route, incoming_id) = match self.drive.delivery {
            Delivery::PointToPoint => (Route::PointToPoint, self.incoming_id(triad)),
            // The drive chooses.
            Delivery::Multicast => (Route::Multicast, 0),
        };
        let (outputs, size) = match access {
            Access::Owner => (Outputs::Owned, io::OWNER_SIZE),
            Access::InputOnly | Access::ListenOnly => {
                let size = self.form.heartbeat();
                (Outputs::Heartbeat(size), size.into())
            }
        };
        let request = ForwardOpen {
            outgoing_id: 0,
            incoming_id,
            triad,
            multiplier: self.drive.multiplier(self.period_ns),
            outgoing: Direction::cyclic(us(self.drive.rpi_ns(self.period_ns)), size, Route::PointToPoint),
            incoming: Direction::cyclic(
                us(self.drive.input_rpi_ns(self.period_ns)),
                incoming_size(version),
                route,
            ),
            key: self.key(),
            target: Target::assemblies(access, version, self.form.configuration()),
            large: self.form.is_large(),
        };
        let mut message = Vec::new();
        request.emit(&mut message);
        let target = Target::assemblies(access, version, Configuration::NONE);
        let elsewhere = route == Route::PointToPoint && self.bind.port() != IO_PORT;
        // The drive takes the port only.
        let incoming = elsewhere.then(|| SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, self.bind.port()));
        self.io = Io::Opening;
        let what = What::Open(Open { triad, target }, outputs, version);
        self.send(now, out, what, now + ANSWER_NS, &message, incoming);
    }

    /// Opens the class 3 connection.
    pub(super) fn connect(&mut self, now: Time, out: &mut Vec<u8>) {
        let triad = self.triad(now);
        let direction = Direction::explicit(CONNECTED_RPI_US, CONNECTED_SIZE);
        let request = ForwardOpen {
            outgoing_id: 0,
            incoming_id: self.incoming_id(triad),
            triad,
            multiplier: CONNECTED_MULTIPLIER,
            outgoing: direction,
            incoming: direction,
            key: self.key(),
            target: Target::Messages,
            large: false,
        };
        let what = What::OpenConnected(Open { triad, target: Target::Messages });
        self.request(now, out, what, |message| request.emit(message));
    }
}
