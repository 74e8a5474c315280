//! The master's view of one drive: its connection, which of its packets count, what it reports, and the next packet to
//! it. It takes times and slices, and knows no socket.
//!
//! Packets answer nothing. Those to the drive leave at the rate that was agreed, whatever comes back; they end only
//! with the connection: when the drive's own have ended, or when the session says so. In most cycles nothing new is
//! desired, and the drive says the same as before but for its positions: then only those are computed anew.

use std::net::{Ipv4Addr, SocketAddrV4};

use super::counters::Own;
use super::exchange::{Connection, LoopEnd, News, Outputs as Sends, Wish};
use super::native::{Native, NativePort, publish};
use super::plan::{EnableInput, Layout, MOST_PER_REV, MoonsDrive, VELOCITY_PER_REV, Version};
use super::profile::{Profile, Seen};
use super::wire::assembly::{Inputs, status};
use super::wire::io::{OUTGOING_MAX, Outgoing, Packet, PacketError};
use fieldbeat_core::axis::units::Unwrap;
use fieldbeat_core::axis::{State, Units};
use fieldbeat_core::bus::desired::{Motion, Power};
use fieldbeat_core::bus::native::native;
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::inputs::InputLog;
use fieldbeat_core::rt::Regions;
use fieldbeat_core::time::Time;

/// The session is waited for so long at the orderly end, ns: it looks at its queues in turns.
const CLOSE_WITHIN_NS: u64 = fieldbeat_core::time::S;

/// The number of a packet may be so far ahead of the last one, whatever time has passed.
const LEAP: i32 = 3;

/// One drive. What each exchange touches comes first.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Station {
    /// The slot that the prepared packet is for.
    grid: Time,
    /// The newest accepted packet counts until then. 0 = none was accepted on this connection.
    fresh_until: Time,
    fresh_within_ns: u64,
    /// The connection has ended if no packet is accepted by then.
    ends_at: Time,
    /// Our packets on this connection.
    sent: u32,
    /// The sequence number and the count of the last accepted packet of the drive.
    sequence: u32,
    count: u16,
    any: bool,
    /// The number of the last packet that was too far ahead.
    odd: Option<u32>,
    /// A packet is in the outbox for the next send.
    is_built: bool,
    /// The outbox has `packet`, but for its numbers.
    is_copied: bool,
    connection: Option<Connection>,
    packet: Outgoing,
    seen: Seen,
    track: Track,
    units: Units,
    /// Of the velocity in a packet, in user units/s; of an encoder.
    velocity_per_count: f64,
    steps_per_encoder_count: Option<f64>,
    agreed: Agreed,
    /// What was reported last besides.
    shown: Shown,
    /// No drive makes more steps in a ns.
    fastest: f64,
    profile: Profile,
    native: NativePort,
    end: LoopEnd,
    enable_input: Option<EnableInput>,
    first_within_ns: u64,
    opened_before: bool,
    /// The id of the packets of the last connection that was open here.
    last_incoming: Option<u32>,
    /// A wish that the session could not take yet.
    wish: Option<Wish>,
    closing: Option<Closing>,
}

/// How far the orderly end is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Closing {
    /// The session was requested to close, and is waited for until then.
    Waiting(Time),
    Done,
}

/// The positions since the connection was opened.
#[derive(Clone, Copy, Debug, Default)]
struct Track {
    demand: Unwrap,
    encoder: Unwrap,
    /// Of the encoder, so that both agree where they were last set to the same place, steps.
    shift: f64,
    last: Option<Last>,
}

/// Of the connection that is open, what each packet of the drive needs.
#[derive(Clone, Copy, Debug)]
struct Agreed {
    version: Version,
    layout: Layout,
    timeout_ns: u64,
    /// A difference between two packets in a row by this is one in a second.
    rate: f64,
    /// No drive makes more steps in an interval.
    most_steps: f64,
}

impl Default for Agreed {
    fn default() -> Agreed {
        let (version, layout) = (Version::V2, Layout::Manual);
        Agreed { version, layout, timeout_ns: 0, rate: 0.0, most_steps: 0.0 }
    }
}

/// What a drive shows besides, in its own integers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Shown([u32; 4]);

impl Shown {
    #[inline]
    fn of(inputs: &Inputs) -> Shown {
        let error = inputs.position_error.unwrap_or_default();
        Shown([inputs.voltage, inputs.temperature as u32, inputs.main_inputs, error as u32])
    }
}

/// What a drive shows besides is reported when it has changed, and with every so many packets.
const SHOWN_EVERY: u32 = 16;

/// Of the last accepted packet: its number, when its values were taken, and its positions in steps.
#[derive(Clone, Copy, Debug)]
struct Last {
    sequence: u32,
    demand: i64,
    actual: f64,
}

impl Station {
    /// The station of `drive`, and the application's end of its native process data.
    pub fn new(drive: &MoonsDrive, period_ns: u64, end: LoopEnd, log: &InputLog) -> (Station, Native) {
        let (application, native) = native();
        let (native, end) = (native.logged(log), end.logged(log));
        let station = Station {
            grid: Time(0),
            fresh_until: Time(0),
            fresh_within_ns: drive.fresh_within_ns(period_ns),
            ends_at: Time(0),
            sent: 0,
            sequence: 0,
            count: 0,
            any: false,
            odd: None,
            is_built: false,
            is_copied: false,
            connection: None,
            packet: Outgoing::heartbeat(0, 0),
            seen: Seen::default(),
            track: Track::default(),
            units: drive.axis.units,
            velocity_per_count: 1.0 / drive.velocity_on_wire(1.0),
            steps_per_encoder_count: drive.encoder.then(|| 1.0 / drive.encoder_counts_per_step),
            agreed: Agreed::default(),
            shown: Shown::default(),
            fastest: MOST_PER_REV / VELOCITY_PER_REV * drive.steps_per_revolution * 1e-9,
            profile: Profile::new(drive),
            native,
            end,
            enable_input: drive.enable_input,
            first_within_ns: drive.first_within_ns,
            opened_before: false,
            last_incoming: None,
            wish: None,
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
        matches!(&self.connection, Some(open) if open.incoming == incoming && open.source == source)
    }

    /// The connection of this id is open here, whatever address a packet of it comes from.
    pub(super) fn has(&self, incoming: u32) -> bool {
        matches!(&self.connection, Some(open) if open.incoming == incoming)
    }

    /// Takes in what the session has to say. Returns where packets go from now on, if that is new.
    #[inline]
    pub fn hear(&mut self, cycle: &Cycle, slot: &mut Slot) -> Option<SocketAddrV4> {
        let mut destination = None;
        while let Some(news) = self.end.news() {
            destination = self.learn(cycle, news, slot).or(destination);
        }
        destination
    }

    #[cold]
    fn learn(&mut self, cycle: &Cycle, news: News, slot: &mut Slot) -> Option<SocketAddrV4> {
        match news {
            News::Opened(connection) => {
                self.open(cycle, connection, slot);
                return Some(connection.destination);
            }
            News::Closed { generation } => {
                if self.connection.is_some_and(|open| open.generation == generation) {
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
        self.packet = match connection.outputs {
            Sends::Owned => Outgoing::owner(connection.outgoing),
            Sends::Heartbeat(size) => Outgoing::heartbeat(connection.outgoing, size),
        };
        // A drive acts on the change of its command word; idle is what it had before, and says so.
        self.packet.set_run(true);
        self.is_copied = false;
        (self.sent, self.any, self.odd, self.fresh_until) = (0, false, None, Time(0));
        self.ends_at = cycle.grid + self.first_within_ns.max(cycle.period_ns);
        let interval_ns = connection.incoming_api_ns as f64;
        let Connection { version, layout, timeout_ns, .. } = connection;
        let (rate, most_steps) = (1e9 / interval_ns, self.fastest * interval_ns);
        self.agreed = Agreed { version, layout, timeout_ns, rate, most_steps };
        (self.connection, self.last_incoming) = (Some(connection), Some(connection.incoming));
        (self.seen, self.track) = (Seen::default(), Track::default());
        self.profile.connected();
        slot.reachable = true;
        if std::mem::replace(&mut self.opened_before, true) {
            Own::Reopened.count(&mut slot.counters);
        }
    }

    /// The connection is over: nothing is sent on it any more.
    fn give_up(&mut self) {
        self.connection = None;
        self.is_built = false;
        self.profile.disconnected();
    }

    /// What the session is to do, as soon as it has room for it; and the end of a connection on which no packet comes.
    #[inline]
    pub(super) fn watch(&mut self, cycle: &Cycle, slot: &mut Slot) {
        if let Some(open) = &self.connection
            && cycle.grid > self.ends_at
        {
            let generation = open.generation;
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
        self.grid = cycle.grid;
        slot.commanded = self.end.guard(slot.guarded);
        let owned = matches!(self.connection.as_ref()?.outputs, Sends::Owned);
        if owned && !self.profile.holds(&slot.desired) {
            let Station { profile, native, seen, packet, .. } = self;
            packet.set_outputs(profile.encode(cycle.grid, &slot.desired, seen, native));
            self.is_copied = false;
        }
        let bytes = self.packet.bytes();
        if !self.is_copied {
            out.get_mut(..bytes.len())?.copy_from_slice(bytes);
            self.is_copied = true;
        }
        // Both begin with 1: some adapters swallow the first data if its count is 0.
        let next = self.sent.wrapping_add(1);
        Outgoing::number(out, next, next as u16);
        self.is_built = true;
        Some(bytes.len())
    }

    /// Whether the prepared packet may leave.
    #[inline]
    pub(super) fn is_built(&self) -> bool {
        self.is_built
    }

    /// The packet has gone out.
    #[inline]
    pub fn sent(&mut self, sent_at: Time, slot: &mut Slot) {
        self.sent = self.sent.wrapping_add(1);
        self.is_built = false;
        slot.counters.sent += 1;
        slot.exchange = Exchange::OwnClock { sent_at, fresh_until: self.fresh_until };
        slot.gone.grid = Some(self.grid);
        self.profile.sent(&mut self.native);
    }

    /// A packet on the connection of this drive.
    #[inline]
    pub fn take(&mut self, at: Time, packet: &Packet<'_>, slot: &mut Slot) {
        let Agreed { version, layout, timeout_ns, .. } = self.agreed;
        let Some(inputs) = Inputs::parse(packet.data, version, layout) else {
            return Station::has_wrong_length(slot);
        };
        let ahead = packet.sequence.wrapping_sub(self.sequence).cast_signed();
        if self.any && ahead <= 0 {
            return Station::is_old(ahead, slot);
        }
        if self.any && ahead > LEAP && self.leaps(at, packet.sequence) {
            slot.counters.foreign += 1;
            return Own::Leap.count(&mut slot.counters);
        }
        let unchanged = self.any && packet.count == self.count;
        (self.any, self.sequence, self.count) = (true, packet.sequence, packet.count);
        self.fresh_until = at + self.fresh_within_ns;
        self.ends_at = at + timeout_ns;
        if let Exchange::OwnClock { fresh_until, .. } = &mut slot.exchange {
            *fresh_until = self.fresh_until;
        }
        if unchanged {
            Own::Unchanged.count(&mut slot.counters);
            return;
        }
        self.report(at, packet, &inputs, slot);
        publish(&mut self.native, at, self.profile.begun_outputs(), (version, layout), packet.data);
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
        let Some(open) = &self.connection else { return true };
        let passed_ns = (at + self.fresh_within_ns).since(self.fresh_until);
        let most = (passed_ns / open.incoming_api_ns.max(1)).saturating_add(LEAP as u64);
        let ahead = |before: u32| sequence.wrapping_sub(before);
        if u64::from(ahead(self.sequence)) <= most {
            return false;
        }
        let odd = self.odd.replace(sequence);
        !odd.is_some_and(|odd| (1..=LEAP as u32).contains(&ahead(odd)))
    }

    /// The values of an accepted packet. Its inputs are only read here, so that none is decoded that is not needed.
    #[inline(always)]
    fn report(&mut self, at: Time, packet: &Packet<'_>, inputs: &Inputs, slot: &mut Slot) {
        let sto_open = self.has_sto_open(inputs.main_inputs);
        // Only a rotary axis wraps around; on any other one a wrong value must not shift all later ones.
        let wraps = self.units.modulo.is_some();
        let unwrap = |track: &mut Unwrap, count: i32| if wraps { track.next(count) } else { count.into() };
        let demand = unwrap(&mut self.track.demand, inputs.absolute);
        let encoder = self.steps_per_encoder_count.map(|steps| {
            let count = unwrap(&mut self.track.encoder, inputs.encoder);
            count as f64 * steps
        });
        let before = std::mem::replace(
            &mut self.seen,
            Seen { any: true, status: inputs.status, alarm: inputs.alarm, demand, sto_open },
        );
        let same = (before.status, before.alarm, before.sto_open) == (inputs.status, inputs.alarm, sto_open);
        if !same || slot.anew || !self.profile.is_settled() {
            self.prove(slot);
            if self.profile.take_rehomed() {
                // The position was set: that was no motion, and the encoder is where the steps are.
                self.track.shift = demand as f64 - encoder.unwrap_or_default();
                self.track.last = None;
            }
        }
        let demand_steps = demand as f64;
        let actual = encoder.map_or(demand_steps, |steps| steps + self.track.shift);
        let Slot { status: report, notices, evidence, .. } = slot;
        // By the drive's clock: its packets count its intervals, however they travel. What no motor makes is another
        // origin: the position was set.
        if let Some(last) = self.track.last
            && let intervals = packet.sequence.wrapping_sub(last.sequence)
            && let moved = (demand - last.demand) as f64
            && moved.abs() <= self.agreed.most_steps * (f64::from(intervals) + 1.0)
        {
            let rate = match intervals {
                0 | 1 => self.agreed.rate,
                _ => self.agreed.rate / f64::from(intervals),
            };
            evidence.demand_velocity = self.units.distance(moved * rate);
            report.velocity = match encoder {
                None => evidence.demand_velocity,
                Some(_) if inputs.velocity != 0 => f64::from(inputs.velocity) * self.velocity_per_count,
                Some(_) => self.units.distance((actual - last.actual) * rate),
            };
        } else {
            (evidence.demand_velocity, report.velocity) =
                (0.0, f64::from(inputs.velocity) * self.velocity_per_count);
        }
        self.track.last = Some(Last { sequence: packet.sequence, demand, actual });
        let place = |steps: f64| self.units.distance(steps) + self.units.offset;
        evidence.demand = place(demand_steps);
        evidence.position = if encoder.is_some() { place(actual) } else { evidence.demand };
        report.at = at;
        report.position = self.units.folded(evidence.position);
        report.demand = self.units.folded(evidence.demand);
        let current = f64::from(inputs.current);
        report.current = if self.agreed.version == Version::V1 { current * 1e-2 } else { current * 1e-3 };
        let shown = Shown::of(inputs);
        if shown != self.shown || packet.sequence.is_multiple_of(SHOWN_EVERY) {
            self.shown = shown;
            report.monitor = MoonsDrive::monitor(inputs);
            notices.monitor_fresh = true;
        }
        notices.fresh = true;
    }

    /// What the states of a packet report and prove.
    #[inline(never)]
    fn prove(&mut self, slot: &mut Slot) {
        let Slot { status: report, notices, evidence, .. } = slot;
        let Seen { status: word, alarm, .. } = self.seen;
        let starts = word & status::INITIALIZING != 0;
        if starts && report.state != State::NotReadyToSwitchOn && report.state != State::Unknown {
            notices.restarted = true;
            self.profile.drive_restarted();
        }
        let owned = self.connection.as_ref().is_some_and(|open| open.outputs == Sends::Owned);
        self.profile.take(&self.seen, evidence);
        evidence.outputs_count = owned;
        let (power, motion) = self.profile.commanded();
        report.state = drive_state(&self.seen, power, motion);
        report.homed = self.profile.is_homed();
        report.moving = self.seen.moves();
        // A drive without an encoder is where it stands.
        let open_loop = self.steps_per_encoder_count.is_none();
        report.in_target = !self.seen.moves() && (open_loop || word & status::IN_POSITION != 0);
        report.sto_open = self.seen.sto_open;
        report.suspect = false;
        let fault = word & status::FAULT != 0;
        // A fault has a code: that of a drive without an alarm in its word is the status bit.
        report.fault = if fault { alarm.max(u32::from(alarm == 0)) } else { 0 };
        report.warning = if fault { 0 } else { alarm };
    }

    /// Its hardware enable is missing, where one is wired. A closed input is 0.
    fn has_sto_open(&self, main_inputs: u32) -> bool {
        self.enable_input.is_some_and(|input| {
            let bit = input.number.saturating_sub(1).min(31);
            let open = main_inputs >> bit & 1 != 0;
            open == input.closed
        })
    }

    /// Starts or continues the orderly end: true once nothing more has to be sent to this drive.
    pub(super) fn shut_down(&mut self, cycle: &Cycle) -> bool {
        match self.closing {
            None => {
                // Outputs do not count from here on.
                self.packet.set_run(false);
                self.is_copied = false;
                let generation = self.connection.as_ref().map_or(0, |open| open.generation);
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
        match self.connection {
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

/// Maps the drive's status onto the states of CiA 402.
fn drive_state(seen: &Seen, power: Power, motion: Motion) -> State {
    let has = |bits: u16| seen.status & bits != 0;
    match () {
        () if has(status::INITIALIZING) => State::NotReadyToSwitchOn,
        () if has(status::FAULT) && seen.is_enabled() => State::FaultReactionActive,
        () if has(status::FAULT) => State::Fault,
        () if seen.is_enabled() && power == Power::QuickStop && motion != Motion::Halt => {
            State::QuickStopActive
        }
        () if seen.is_enabled() => State::OperationEnabled,
        () if seen.sto_open => State::SwitchOnDisabled,
        () => State::ReadyToSwitchOn,
    }
}
