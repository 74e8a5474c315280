//! The master's view of one drive: its connection, which of its packets count, what it reports, and the next packet to
//! it. It takes times and slices, and knows no socket.
//!
//! Packets answer nothing. Those to the drive leave at the rate that was agreed, whatever comes back; they end only
//! with the connection: when the drive's own have ended, or when the session says so. In most cycles nothing new is
//! desired, and the drive says the same as before but for its positions: then only those are computed anew.
//!
//! | file | what |
//! |---|---|
//! | `station` | the connection, the packets to the drive, and which of its own count |
//! | `station/report` | what an accepted packet reports |

mod report;

use std::mem::offset_of;
use std::net::{Ipv4Addr, SocketAddrV4};

use self::report::{Shown, Turns};
use super::counters::Own;
use super::exchange::{Connection, LoopEnd, News, Outputs as Sends, Wish};
use super::native::{Native, NativePort, publish};
use super::plan::{EnableInput, Layout, MOST_PER_REV, MoonsDrive, VELOCITY_PER_REV, Version};
use super::profile::{Profile, Seen};
use super::wire::assembly::Inputs;
use super::wire::io::{OUTGOING_MAX, Outgoing, Packet, PacketError};
use fieldbeat_core::axis::Units;
use fieldbeat_core::bus::native::native;
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The session is waited for so long at the orderly end, ns: it looks at its queues in turns.
const CLOSE_WITHIN_NS: u64 = fieldbeat_core::time::S;

/// The number of a packet may be so far ahead of the last one, whatever time has passed.
const LEAP: i32 = 3;

/// Bytes of a line of the cache.
const LINE: usize = 64;

/// The number of words before the profile that let its part touched by each exchange begin a line.
const BEFORE: usize = (LINE - (size_of::<Profile>() - Profile::TOUCHED) % LINE) % LINE / 8;

/// One drive. What every exchange touches lies on four lines of the cache, from the end of `profile` to the start of
/// `native`. Our packets need the first one, up to the start of `open`.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    _before: [u64; BEFORE],
    profile: Profile,
    /// The newest accepted packet counts until then. 0 = none was accepted on this connection.
    fresh_until: Time,
    /// Our packets on this connection.
    sent: u32,
    /// Calls that command the drive are refused, and none was under way since: none begins.
    is_quiet: bool,
    /// The outbox has so many bytes, those of `packet` but for its numbers; 0: it has others.
    copied: u8,
    /// There was a packet: the values of the last one are there.
    has_last: bool,
    /// The connection that is open.
    open: Option<Open>,
    /// The connection has ended if no packet is accepted by then.
    ends_at: Time,
    /// A wish that the session could not take yet.
    wish: Option<Wish>,
    /// The sequence number and the count of the last accepted packet of the drive.
    sequence: u32,
    count: u16,
    enable_input: Option<EnableInput>,
    /// The number of the packet whose values were taken last.
    last: u32,
    /// The number of outputs of the application that have begun.
    begun: u32,
    fresh_within_ns: u64,
    seen: Seen,
    units: Units,
    /// The actual position in the packet whose values were taken last, steps.
    actual: f64,
    /// 0: it has no encoder.
    steps_per_encoder_count: f64,
    /// Of the encoder, so that both positions agree where they were last set to the same place, steps.
    shift: f64,
    /// Of the velocity in a packet, in user units/s.
    velocity_per_count: f64,
    /// The additional values that were reported last.
    shown: Shown,
    native: NativePort,
    end: LoopEnd,
    /// The number of the last packet that was too far ahead.
    odd: Option<u32>,
    packet: Outgoing,
    turns: Turns,
    /// The packets of the connection that is open come at this interval, ns.
    interval_ns: u64,
    /// No drive makes more steps in a ns.
    fastest: f64,
    first_within_ns: u64,
    opened_before: bool,
    /// The id of the packets of the last connection that was open here.
    last_incoming: Option<u32>,
    closing: Option<Closing>,
}

const _: () = {
    let touched = offset_of!(Station, native) + 16 - offset_of!(Station, fresh_until) + Profile::TOUCHED;
    assert!(touched <= 4 * LINE, "from the end of the profile to the writer of the inputs");
};

/// How far the orderly end is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Closing {
    /// The session was requested to close, and is waited for until then.
    Waiting(Time),
    Done,
}

/// Of the connection that is open, what the packets need.
#[derive(Clone, Copy, Debug)]
#[repr(C)] // What our packets need comes first.
struct Open {
    outputs: Sends,
    version: Version,
    layout: Layout,
    generation: u32,
    /// The id of the drive's packets, and where they come from.
    incoming: u32,
    source: Ipv4Addr,
    timeout_ns: u64,
    /// A difference between two of them in a row by this is one in a second.
    rate: f64,
    /// No drive makes more steps in an interval.
    most_steps: f64,
}

impl Station {
    /// The station of `drive`, and the application's end of its native process data.
    pub fn new(drive: &MoonsDrive, period_ns: u64, end: LoopEnd, log: &InputLog) -> (Station, Native) {
        let (application, native) = native();
        let (native, end) = (native.logged(log), end.logged(log));
        let station = Station {
            _before: [0; BEFORE],
            profile: Profile::new(drive),
            fresh_until: Time(0),
            sent: 0,
            is_quiet: false,
            copied: 0,
            has_last: false,
            open: None,
            ends_at: Time(0),
            wish: None,
            sequence: 0,
            count: 0,
            enable_input: drive.enable_input,
            last: 0,
            begun: 0,
            fresh_within_ns: drive.fresh_within_ns(period_ns),
            seen: Seen::default(),
            units: drive.axis.units,
            actual: 0.0,
            steps_per_encoder_count: if drive.encoder { 1.0 / drive.encoder_counts_per_step } else { 0.0 },
            shift: 0.0,
            velocity_per_count: 1.0 / drive.velocity_on_wire(1.0),
            shown: Shown::default(),
            native,
            end,
            odd: None,
            packet: Outgoing::heartbeat(0, 0),
            turns: Turns::default(),
            interval_ns: 0,
            fastest: MOST_PER_REV / VELOCITY_PER_REV * drive.steps_per_revolution * 1e-9,
            first_within_ns: drive.first_within_ns,
            opened_before: false,
            last_incoming: None,
            closing: None,
        };
        (station, application)
    }

    /// The native process data.
    #[inline]
    pub(super) fn native(&self) -> &NativePort {
        &self.native
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.native.memory(regions);
        self.end.memory(regions);
    }

    /// The connection of this id from this address is open here.
    #[inline]
    pub fn is(&self, source: Ipv4Addr, incoming: u32) -> bool {
        matches!(&self.open, Some(open) if open.incoming == incoming && open.source == source)
    }

    /// The connection of this id is open here, whatever address a packet of it comes from.
    pub(super) fn has(&self, incoming: u32) -> bool {
        matches!(&self.open, Some(open) if open.incoming == incoming)
    }

    /// Takes in what the session has to say. Returns where packets go from now on, if that is new.
    pub fn hear(&mut self, cycle: &Cycle, slot: &mut Slot) -> Option<SocketAddrV4> {
        let mut destination = None;
        while let Some(news) = self.end.news() {
            destination = self.learn(cycle, news, slot).or(destination);
        }
        destination
    }

    fn learn(&mut self, cycle: &Cycle, news: News, slot: &mut Slot) -> Option<SocketAddrV4> {
        match news {
            News::Opened(connection) => {
                self.open(cycle, connection, slot);
                return Some(connection.destination);
            }
            News::Closed { generation } => {
                if self.open.is_some_and(|open| open.generation == generation) {
                    self.give_up();
                }
                if self.closing.is_some() {
                    self.closing = Some(Closing::Done);
                }
            }
            News::Read(facts) => self.profile.read(facts),
        }
        None
    }

    fn open(&mut self, cycle: &Cycle, connection: Connection, slot: &mut Slot) {
        let Connection { generation, incoming, source, outputs, version, layout, timeout_ns, .. } =
            connection;
        self.packet = match outputs {
            Sends::Owned => Outgoing::owner(connection.outgoing),
            Sends::Heartbeat(size) => Outgoing::heartbeat(connection.outgoing, size),
        };
        // A drive acts on the change of its command word; idle is what it had before, and says so.
        self.packet.set_run(true);
        self.copied = 0;
        (self.sent, self.odd, self.fresh_until) = (0, None, Time(0));
        self.ends_at = cycle.grid + self.first_within_ns.max(cycle.period_ns);
        self.interval_ns = connection.incoming_api_ns;
        let (rate, most_steps) = (1e9 / self.interval_ns as f64, self.fastest * self.interval_ns as f64);
        self.last_incoming = Some(incoming);
        self.open = Some(Open {
            outputs,
            version,
            layout,
            generation,
            incoming,
            source,
            timeout_ns,
            rate,
            most_steps,
        });
        (self.seen, self.turns) = (Seen::default(), Turns::default());
        (self.has_last, self.shift) = (false, 0.0);
        self.profile.connected();
        slot.reachable = true;
        if std::mem::replace(&mut self.opened_before, true) {
            Own::Reopened.count(&mut slot.counters);
        }
    }

    /// The connection is over: nothing is sent on it any more.
    fn give_up(&mut self) {
        self.open = None;
        self.profile.disconnected();
    }

    /// The next task of the session, as soon as it has room for it; and the end of a connection on which no packet
    /// comes.
    #[inline]
    pub(super) fn watch(&mut self, cycle: &Cycle, slot: &mut Slot) {
        if cycle.grid > self.ends_at
            && let Some(Open { generation, .. }) = self.open
        {
            Own::TimedOut.count(&mut slot.counters);
            self.give_up();
            self.wish = self.wish.or(Some(Wish::TimedOut { generation }));
        }
        if let Some(wish) = self.wish
            && self.end.wish(wish)
        {
            self.wish = None;
        }
    }

    /// Builds the packet of the next send in `out`, which is the same place each time and has the last packet still,
    /// and returns its length; `None`: there is no connection.
    #[inline]
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot, out: &mut [u8]) -> Option<usize> {
        if !(slot.guarded && self.is_quiet) {
            slot.commanded = self.end.guard(slot.guarded);
            self.is_quiet = slot.guarded && !slot.commanded;
        }
        let is_owned = self.open.as_ref()?.outputs == Sends::Owned;
        if is_owned && !self.profile.holds(&slot.desired) {
            let Station { profile, native, seen, packet, .. } = self;
            packet.set_outputs(profile.encode(cycle.grid, &slot.desired, seen, native));
            self.copied = 0;
        }
        if self.copied == 0 {
            let bytes = self.packet.bytes();
            out.get_mut(..bytes.len())?.copy_from_slice(bytes);
            self.copied = bytes.len() as u8;
        }
        // Both begin with 1: some adapters swallow the first data if its count is 0.
        let next = self.sent.wrapping_add(1);
        Outgoing::number(out, next, next as u16);
        Some(self.copied.into())
    }

    /// The packet has gone out.
    #[inline]
    pub fn sent(&mut self, sent_at: Time, cycle: &Cycle, slot: &mut Slot) {
        self.sent = self.sent.wrapping_add(1);
        slot.counters.sent += 1;
        slot.exchange = Exchange::OwnClock { sent_at, fresh_until: self.fresh_until };
        slot.gone.grid = Some(cycle.grid);
        if let Some(begun) = self.profile.sent(&mut self.native) {
            self.begun = begun;
        }
    }

    /// A packet on the connection of this drive.
    #[inline(always)] // Of each drive and cycle.
    pub fn take(&mut self, at: Time, packet: &Packet<'_>, slot: &mut Slot) {
        let Some(Open { version, layout, .. }) = self.open else { return };
        // Of those of the second version only what is needed is decoded.
        let inputs = if version == Version::V2 { Inputs::second_version(packet.data, layout) } else { None };
        match inputs {
            Some(inputs) => self.accept(at, packet, &inputs, slot),
            None => self.take_any(at, *packet, slot),
        }
    }

    /// The same of any version.
    #[inline(never)]
    pub(super) fn take_any(&mut self, at: Time, packet: Packet<'_>, slot: &mut Slot) {
        let Some(Open { version, layout, .. }) = self.open else { return };
        match Inputs::parse(packet.data, version, layout) {
            Some(inputs) => self.accept(at, &packet, &inputs, slot),
            None => Station::has_wrong_length(slot),
        }
    }

    /// A packet of the size that was agreed.
    #[inline(always)]
    fn accept(&mut self, at: Time, packet: &Packet<'_>, inputs: &Inputs, slot: &mut Slot) {
        let Some(Open { version, layout, timeout_ns, .. }) = self.open else { return };
        let ahead = packet.sequence.wrapping_sub(self.sequence).cast_signed();
        let is_first = self.fresh_until == Time(0);
        if !is_first && ahead <= 0 {
            return Station::is_old(ahead, slot);
        }
        if !is_first && ahead > LEAP && self.leaps(at, packet.sequence) {
            slot.counters.foreign += 1;
            return Own::Leap.count(&mut slot.counters);
        }
        let unchanged = !is_first && packet.count == self.count;
        (self.sequence, self.count) = (packet.sequence, packet.count);
        self.fresh_until = at + self.fresh_within_ns;
        self.ends_at = at + timeout_ns;
        if let Exchange::OwnClock { fresh_until, .. } = &mut slot.exchange {
            *fresh_until = self.fresh_until;
        }
        if unchanged {
            Own::Unchanged.count(&mut slot.counters);
            return;
        }
        self.report(at, packet, inputs, slot);
        publish(&mut self.native, at, self.begun, (version, layout), packet.data);
    }

    /// A packet with more or less data than was agreed.
    #[cold]
    fn has_wrong_length(slot: &mut Slot) {
        slot.counters.malformed += 1;
        Own::WrongLength.count(&mut slot.counters);
    }

    /// A packet that is not newer than the last accepted one.
    #[cold]
    fn is_old(ahead: i32, slot: &mut Slot) {
        let counter = if ahead == 0 { &mut slot.counters.duplicate } else { &mut slot.counters.late };
        *counter += 1;
    }

    /// The number of a packet is farther ahead of the last accepted one than time has passed: a broken one would make
    /// all true ones old. It counts only if the next one goes on from there.
    #[cold]
    fn leaps(&mut self, at: Time, sequence: u32) -> bool {
        let passed_ns = (at + self.fresh_within_ns).since(self.fresh_until);
        let most = (passed_ns / self.interval_ns.max(1)).saturating_add(LEAP as u64);
        let ahead = |before: u32| sequence.wrapping_sub(before);
        if u64::from(ahead(self.sequence)) <= most {
            return false;
        }
        let odd = self.odd.replace(sequence);
        !odd.is_some_and(|odd| (1..=LEAP as u32).contains(&ahead(odd)))
    }

    /// Starts or continues the orderly end: true once nothing more has to be sent to this drive.
    pub(super) fn shut_down(&mut self, cycle: &Cycle) -> bool {
        match self.closing {
            None => {
                // Outputs do not count from here on.
                self.packet.set_run(false);
                self.copied = 0;
                let generation = self.open.map_or(0, |open| open.generation);
                self.wish = Some(Wish::Close { generation });
                self.closing = Some(Closing::Waiting(cycle.grid + CLOSE_WITHIN_NS));
                false
            }
            Some(Closing::Waiting(until)) => cycle.grid > until,
            Some(Closing::Done) => true,
        }
    }

    /// For a packet of the drive on another connection than the one that is open here. The first packets of a
    /// connection may come before the session could say that it is open.
    #[cold]
    pub(super) fn foreign(&self, incoming: u32, slot: &mut Slot) {
        match self.open {
            None if self.last_incoming != Some(incoming) => Own::Early.count(&mut slot.counters),
            _ => Station::refuse(None, slot),
        }
    }

    /// For a datagram from the drive that is no packet of its connection.
    #[cold]
    pub(super) fn refuse(why: Option<PacketError>, slot: &mut Slot) {
        match why {
            None => {
                slot.counters.foreign += 1;
                Own::WrongConnection.count(&mut slot.counters);
            }
            Some(PacketError::Length) => Station::has_wrong_length(slot),
            Some(PacketError::NoPacket) => {
                slot.counters.malformed += 1;
                Own::NoPacket.count(&mut slot.counters);
            }
        }
    }
}

/// The longest packet to a drive, bytes.
pub(super) const ROOM: usize = OUTGOING_MAX;
