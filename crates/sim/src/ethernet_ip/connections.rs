//! The connections that are open: who owns the drive, whose packets come, and whose time is up.
//!
//! Facts: sheet, 2.6, 2.7, 3.3, 3.4.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::assembly;
use super::check::Admitted;
use super::items::any;
use super::open::{Open, Parameters, Triad};
use super::produce::Producer;
use super::settings::{ClockSettings, NetworkSettings};
use fieldbeat_core::time::{Time, US};

/// The port of class 1 packets.
pub(super) const IO_PORT: u16 = 2222;

/// What a connection is for, with the input assembly of its packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Use {
    Owner(u8),
    InputOnly(u8),
    ListenOnly(u8),
    /// Class 3.
    Messages,
}

impl Use {
    /// The assembly of its packets.
    pub(super) fn input(self) -> Option<u8> {
        match self {
            Use::Owner(input) | Use::InputOnly(input) | Use::ListenOnly(input) => Some(input),
            Use::Messages => None,
        }
    }
}

/// One connection.
#[derive(Debug)]
pub(super) struct Connection {
    pub purpose: Use,
    pub triad: Triad,
    /// The TCP connection that it was opened on.
    pub peer: SocketAddrV4,
    /// The id of what comes.
    pub consumed: u32,
    /// The id of what goes.
    pub produced: u32,
    /// The sizes to the drive and from it.
    pub sizes: (u16, u16),
    timeout_ns: u64,
    dies: Time,
    /// Of the newest packet.
    pub sequence: Option<u32>,
    /// Of the newest data, or message.
    pub count: u16,
    /// Something has come.
    pub begun: bool,
    /// The reply to the newest message.
    pub reply: Option<Vec<u8>>,
    /// Who produces for it.
    producer: Option<u32>,
}

impl Connection {
    /// Something came that counts.
    pub(super) fn feed(&mut self, now: Time) {
        self.dies = now + self.timeout_ns;
    }
}

/// The first connections of a group, which the others have to be like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Like {
    pub class: u8,
    pub trigger: u8,
    pub from: Parameters,
}

/// Why a connection has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum End {
    Closed,
    TimedOut,
}

/// A connection that has ended by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ended {
    pub purpose: Use,
    /// Its TCP connection ends, too.
    pub hangs_up: Option<SocketAddrV4>,
}

/// A connection that was opened, as its originator has to know it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Opened {
    pub consumed: u32,
    pub produced: u32,
    pub api_us: (u32, u32),
    /// Where the packets of a class 1 connection go.
    pub to: Option<SocketAddrV4>,
}

/// All of them.
#[derive(Debug)]
pub(super) struct Connections {
    pub settings: NetworkSettings,
    clock: ClockSettings,
    pub ip: Ipv4Addr,
    pub open: Vec<Connection>,
    pub producers: Vec<Producer>,
    /// An owner that has timed out.
    pub last_owner: Option<Triad>,
    /// The upper half of all ids: another one after each start, so that nothing old is taken for new.
    incarnation: u16,
    next_id: u16,
    next_producer: u32,
}

impl Connections {
    pub(super) fn new(settings: &NetworkSettings, clock: ClockSettings, ip: Ipv4Addr) -> Connections {
        Connections {
            settings: settings.clone(),
            clock,
            ip,
            open: Vec::new(),
            producers: Vec::new(),
            last_owner: None,
            incarnation: 0x5A01,
            next_id: 0x13,
            next_producer: 0,
        }
    }

    /// Power was lost.
    pub(super) fn restart(&mut self) {
        self.open.clear();
        self.producers.clear();
        self.last_owner = None;
        self.incarnation = self.incarnation.wrapping_add(1);
        self.next_id = 0x13;
    }

    /// How many are of this use.
    pub(super) fn count(&self, of: impl Fn(Use) -> bool) -> usize {
        self.open.iter().filter(|connection| of(connection.purpose)).count()
    }

    /// The drive is owned.
    pub(super) fn is_owned(&self) -> bool {
        self.count(|purpose| matches!(purpose, Use::Owner(_))) > 0
    }

    /// Somebody who does more than listen gets this input.
    pub(super) fn is_requested(&self, input: u8) -> bool {
        self.count(|purpose| purpose == Use::Owner(input) || purpose == Use::InputOnly(input)) > 0
    }

    /// The producer of this input for a group.
    pub(super) fn group_of(&self, input: u8) -> Option<&Producer> {
        self.producers.iter().find(|producer| producer.input == input && producer.to.ip().is_multicast())
    }

    /// The group of this drive.
    fn group(&self) -> Ipv4Addr {
        let host = (self.ip.to_bits() & !self.settings.mask.to_bits()).wrapping_sub(1) & 0x3FF;
        Ipv4Addr::from_bits(Ipv4Addr::new(239, 192, 1, 0).to_bits() + host * 32)
    }

    fn new_id(&mut self) -> u32 {
        let id = u32::from(self.incarnation) << 16 | u32::from(self.next_id);
        self.next_id = self.next_id.wrapping_add(1);
        id
    }

    /// Opens a connection that was admitted. Its packets go to `port`, if they are for this originator only.
    pub(super) fn add(
        &mut self,
        now: Time,
        peer: SocketAddrV4,
        open: &Open<'_>,
        admitted: Admitted,
        port: Option<u16>,
    ) -> Opened {
        let Admitted { purpose, api_us, multicast } = admitted;
        let consumed = self.new_id();
        let (mut produced, mut to, mut producer) = (open.produced, None, None);
        if let Some(input) = purpose.input() {
            let destination = match multicast {
                true => SocketAddrV4::new(self.group(), IO_PORT),
                false => SocketAddrV4::new(*peer.ip(), port.unwrap_or(IO_PORT)),
            };
            let shared = self.group_of(input).filter(|_| multicast).map(|group| (group.key, group.id));
            let (key, id) = shared.unwrap_or_else(|| {
                let id = if multicast { self.new_id() } else { open.produced };
                let like = Like { class: open.class, trigger: open.trigger, from: open.from };
                let key = self.next_producer;
                self.next_producer = key.wrapping_add(1);
                let producer = Producer::new(key, id, input, destination, api_us.1, like, self.clock, now);
                self.producers.push(producer);
                (key, id)
            });
            (produced, to, producer) = (id, Some(destination), Some(key));
        }
        if let Use::Owner(_) = purpose {
            self.last_owner = None;
        }
        let timeout_ns = u64::from(api_us.0) * US * (4_u64 << open.multiplier);
        self.open.push(Connection {
            purpose,
            triad: open.triad,
            peer,
            consumed,
            produced,
            sizes: (open.to.size, open.from.size),
            timeout_ns,
            dies: now + timeout_ns.max(self.settings.first_packet_ns),
            sequence: None,
            count: 0,
            begun: false,
            reply: None,
            producer,
        });
        Opened { consumed, produced, api_us, to }
    }

    /// The connection of this triad.
    pub(super) fn find(&self, triad: Triad) -> Option<usize> {
        self.open.iter().position(|connection| connection.triad == triad)
    }

    /// Closes one; what has ended with it, the listeners it had included.
    pub(super) fn close(&mut self, place: usize) -> Vec<Ended> {
        self.remove(place, End::Closed)
    }

    fn remove(&mut self, place: usize, why: End) -> Vec<Ended> {
        let gone = self.open.remove(place);
        let lives = self.open.iter().any(|other| other.triad.same_originator(gone.triad));
        let hangs_up = (why == End::TimedOut && !lives).then_some(gone.peer);
        let mut ended = vec![Ended { purpose: gone.purpose, hangs_up }];
        if why == End::TimedOut && matches!(gone.purpose, Use::Owner(_)) {
            self.last_owner = Some(gone.triad);
        }
        // Nobody listens to what nobody has requested.
        if let Some(input) = gone.purpose.input().filter(|input| !self.is_requested(*input)) {
            self.open.retain(|connection| {
                let ends = connection.purpose == Use::ListenOnly(input);
                if ends {
                    ended.push(Ended { purpose: connection.purpose, hangs_up: None });
                }
                !ends
            });
        }
        let open = &self.open;
        self.producers.retain(|producer| open.iter().any(|user| user.producer == Some(producer.key)));
        ended
    }

    /// The class 3 connections of a TCP connection end with it.
    pub(super) fn disconnected(&mut self, peer: SocketAddrV4) {
        self.open.retain(|connection| connection.purpose != Use::Messages || connection.peer != peer);
    }

    /// When the next of them times out, or sends.
    pub(super) fn next_due(&self) -> Option<Time> {
        let dies = self.open.iter().filter(|connection| self.times_out(connection)).map(|open| open.dies);
        dies.chain(self.producers.iter().map(Producer::due)).min()
    }

    fn times_out(&self, connection: &Connection) -> bool {
        connection.purpose != Use::Messages || self.settings.messages_time_out
    }

    /// Ends one whose time is up.
    pub(super) fn time_out(&mut self, now: Time) -> Option<Vec<Ended>> {
        let over = |connection: &Connection| self.times_out(connection) && connection.dies <= now;
        let place = self.open.iter().position(over)?;
        Some(self.remove(place, End::TimedOut))
    }

    /// Where the drive takes packets.
    pub(super) fn own_port(&self) -> Option<SocketAddrV4> {
        self.settings.announces_port.then_some(any(IO_PORT))
    }
}

/// The size of the packets of an input, with their sequence count.
pub(super) fn packet_size(input: u8) -> usize {
    assembly::input_size(input) + 2
}
