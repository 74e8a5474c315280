//! The master's view of one drive: which reply answers which request, what the drive reported last, and the next
//! request.
//! It takes `now` and slices, and knows no socket. What is desired of it becomes blocks in `profile`.
//!
//! LinUDP has no sequence number. A reply counts by its sender, by the echo of both definitions, and by the open
//! exchange. By default the response definition changes from request to request ([`ReplyTag`]), so that a reply that is
//! one to three exchanges late echoes another one. A reply that could be that of a missed exchange all the same is
//! *suspect*: taken as feedback one cycle older, without a round-trip sample. The request after it requests one block
//! more or less, so that its echo is its own. With `reply_tag = "count"` a real-time-config no-operation carries a new
//! count in every request and its echo names the request.
//!
//! An answered exchange whose reply comes once more, four exchanges late, passes for the newest. So no single reply
//! proves that a command is done (`profile`, `channel`).

use super::native::{Native, NativePort, native};
use super::other::OtherMaster;
use super::plan::{LinUdpDrive, MonitorPlan, ReplyTag};
use super::profile::{Inputs, Outputs, Profile};
use super::rtc::RtcChannel;
use super::upid::commanding;
use super::wire::{
    MainState, MotionBlock, Request, RequestDef, ResponseDef, ResponseView, RtcBlock, StateVar, StatusWord,
};
use crate::axis::acyclic::{self, AcyclicEnds};
use crate::axis::units::Unwrap;
use crate::axis::{Link, State, Units};
use crate::bus::desired::Power;
use crate::bus::{Cycle, Exchange, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// Every so many probes of a silent drive, one carries a no-operation motion block and a real-time-config block: some
/// factory-fresh drives do not answer a telegram without any block (sheet, 1.3).
const FULL_PROBE_EVERY: u8 = 4;

/// The blocks that come in turn, so that consecutive response definitions differ: the ones that a cycle can do without.
const IN_TURN: [ResponseDef; 2] = [ResponseDef::WARN, ResponseDef::MONITOR];

/// The most requests whose replies may still be under way: older ones count as lost ...
const MOST_UNDER_WAY: u8 = 32;
/// ... and are written off after so many exchanges without a miss: no reply takes that long.
const FORGOTTEN_AFTER: u8 = 16;

/// One drive.
#[derive(Debug)]
pub struct Station {
    units: Units,
    response_def: ResponseDef,
    tagged: bool,
    /// The block that the request after a suspect reply has or lacks.
    odd: ResponseDef,
    identity: Identity,
    inputs: Inputs,
    /// The slot that the prepared request is for.
    grid: Time,
    /// The last fresh reply: state, and the positions for the velocity.
    last: Option<Seen>,
    actual: Unwrap,
    demand: Unwrap,
    profile: Profile,
    other: OtherMaster,
    rtc: RtcChannel,
    monitor: MonitorPlan,
    /// Probes that have gone out.
    probes: u8,
    /// The prepared request is a probe.
    probing: bool,
    native: NativePort,
}

/// What distinguishes the reply to the last request from any other.
#[derive(Clone, Copy, Debug, Default)]
struct Identity {
    /// How many response definitions take turns, and the place of the next one.
    turns: u8,
    turn: u8,
    /// The blocks by which the requests of one kind differ.
    varies: ResponseDef,
    /// What the reply to the prepared request will echo.
    prepared: Echo,
    /// What the reply to the last request sent echoes.
    requested: Echo,
    /// The kinds of the requests before it, newest first, without repetitions in a row: as far back as late
    /// replies come from while the link is still online.
    requested_before: [Echo; 3],
    /// An exchange was opened and no reply closed it.
    open: bool,
    /// Replies to earlier requests that may still come: such a one is late and no duplicate.
    under_way: u8,
    /// Those among them that were sent since the last clean reply. If there are as many as definitions, one of them
    /// looks like the reply to the next request: that reply is suspect.
    mistakable: u8,
    /// Exchanges without a miss since the last one.
    without_miss: u8,
    /// The reply that closed the last exchange was suspect.
    suspect: bool,
}

impl Identity {
    /// A reply to an earlier request has come.
    fn take_late(&mut self) {
        self.under_way = self.under_way.saturating_sub(1);
        self.mistakable = self.mistakable.saturating_sub(1);
    }

    /// The blocks that the next request requests: those of `usual`, less or more those in turn.
    fn in_turn(&self, usual: ResponseDef) -> ResponseDef {
        let turned = |(bit, _): &(usize, &ResponseDef)| self.turn >> bit & 1 == 1;
        let blocks = IN_TURN.iter().enumerate().filter(turned);
        ResponseDef(blocks.fold(usual.0, |definition, (_, block)| definition ^ block.0))
    }

    /// A datagram may wait in the socket that looks like the reply to the next request.
    #[inline]
    fn is_in_doubt(&self) -> bool {
        let distinguished = self.turns > 1 << (IN_TURN.len() - 1) || self.requested.tag.is_some();
        self.open || self.suspect || self.under_way > 0 || !distinguished
    }

    /// What the echoes of all requests of this kind have in common.
    fn kind(&self, echo: Echo) -> Echo {
        Echo { response: ResponseDef(echo.response.0 & !self.varies.0), tag: None, ..echo }
    }

    /// The echo is that of a request of the last kinds that were sent.
    fn knows(&self, echo: Echo) -> bool {
        let kind = self.kind(echo);
        kind == self.kind(self.requested) || self.requested_before.contains(&kind)
    }
}

/// What a reply echoes of its request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Echo {
    request: RequestDef,
    response: ResponseDef,
    /// The count of the real-time-config block; of a request, if it was chosen to distinguish its reply from others.
    tag: Option<u8>,
}

impl Echo {
    /// Whether this echo of a reply can be that of the request that echoes `requested`.
    fn answers(&self, requested: &Echo) -> bool {
        (self.request, self.response) == (requested.request, requested.response)
            && (requested.tag.is_none() || self.tag == requested.tag)
    }
}

/// The last values, for differences.
#[derive(Clone, Copy, Debug)]
struct Seen {
    at: Time,
    actual: i64,
    demand: i64,
}

impl Station {
    /// The station of `drive`, and the application's ends of its native process data and of its acyclic access.
    pub fn new(drive: &LinUdpDrive) -> (Station, Native, AcyclicEnds) {
        let (application, native) = native();
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue, commanding());
        let (mut response_def, shown) = (ResponseDef::CYCLIC, drive.monitor != MonitorPlan::Off);
        if shown {
            response_def = response_def.with(ResponseDef::MONITOR);
        }
        let turning = drive.reply_tag == ReplyTag::Definition;
        // The last block in turn stays if it is shown.
        let in_turn = &IN_TURN[..if turning { IN_TURN.len() - usize::from(shown) } else { 0 }];
        let odd = if turning { ResponseDef::CURRENT } else { ResponseDef::MONITOR };
        let varies =
            if turning { in_turn.iter().fold(odd, |all, block| all.with(*block)) } else { ResponseDef::NONE };
        let station = Station {
            units: drive.axis.units,
            response_def,
            tagged: drive.reply_tag == ReplyTag::Count,
            odd,
            identity: Identity { turns: 1 << in_turn.len(), varies, ..Identity::default() },
            inputs: Inputs::default(),
            grid: Time(0),
            last: None,
            actual: Unwrap::default(),
            demand: Unwrap::default(),
            profile: Profile::new(drive),
            other: OtherMaster::default(),
            rtc: RtcChannel::new(port, drive.monitor.sources()),
            monitor: drive.monitor,
            probes: 0,
            probing: false,
            native,
        };
        (station, application, ends)
    }

    /// Adds what it touches besides itself, to be locked.
    pub(super) fn memory(&self, regions: &mut Regions) {
        self.native.memory(regions);
        self.rtc.memory(regions);
    }

    /// Builds the request of the next send in `out` and returns its length. Built again for the same send, it is
    /// the same: state that changes with every request changes in [`sent`](Self::sent).
    pub fn prepare(&mut self, cycle: &Cycle, slot: &mut Slot, out: &mut [u8]) -> usize {
        let silent = matches!(slot.link, Link::Unseen | Link::Lost);
        let outputs = self.profile.encode(&slot.desired, &self.inputs, &mut self.native);
        self.grid = cycle.grid;
        let Outputs { control, motion, config } = outputs;
        let powered = slot.status.state.is_powered();
        let called = self.rtc.advance(cycle.grid, slot.link, powered, slot.guarded);
        slot.commanded = self.rtc.commands();
        slot.expected_silence = self.rtc.expects_silence() && !powered;
        let mut request = Request {
            response_def: self.identity.in_turn(self.response_def),
            control,
            motion,
            config: config.or(called),
            ..Request::default()
        };
        if config.is_some() {
            self.rtc.give_way();
        }
        if self.identity.suspect {
            // Its definition differs from the earlier ones, so that the echo distinguishes its reply from all late
            // ones: if they were always one cycle behind, each would pass for the newest for ever.
            request.response_def.0 ^= self.odd.0;
        }
        let tag = match (config, called) {
            _ if !self.tagged => None,
            (Some(_), _) => config,
            // A call is repeated with one count, which does not identify the request.
            (None, Some(_)) => None,
            _ if self.rtc.hushes() => None,
            (None, None) => Some(self.rtc.tag()),
        };
        request.config = request.config.or(tag);
        self.probing = silent && slot.desired.power.value == Power::Untouched;
        if self.probing && self.probes == FULL_PROBE_EVERY - 1 {
            request.motion = Some(MotionBlock::default());
            request.config = request.config.or(Some(RtcBlock::default()));
        }
        if request.config.is_some() {
            request.response_def = request.response_def.with(ResponseDef::CONFIG);
        }
        self.other.prepare(request.motion.map(|block| (block.header & 0xF) as u8));
        self.identity.prepared = Echo {
            request: request.definition(),
            response: request.response_def,
            tag: tag.map(|block| block.count()),
        };
        request.emit(out)
    }

    /// What is in the socket has to be taken in before the next request leaves: in its window it might pass for the
    /// reply to it.
    #[inline]
    pub fn is_in_doubt(&self) -> bool {
        self.identity.is_in_doubt()
    }

    /// The request was handed to the wire.
    pub fn sent(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        let identity = &mut self.identity;
        if identity.open {
            identity.under_way = (identity.under_way + 1).min(MOST_UNDER_WAY);
            identity.mistakable = (identity.mistakable + 1).min(MOST_UNDER_WAY);
            identity.without_miss = 0;
        } else if identity.without_miss < FORGOTTEN_AFTER {
            identity.without_miss += 1;
        } else {
            identity.under_way = 0;
        }
        if !identity.open && identity.suspect {
            // This request differs from those before: its reply cannot be mistaken for theirs. Theirs may still
            // come.
            identity.mistakable = 0;
        }
        (identity.open, identity.suspect) = (true, false);
        identity.turn = (identity.turn + 1) % identity.turns;
        let requested = std::mem::replace(&mut identity.requested, identity.prepared);
        if identity.kind(requested) != identity.kind(identity.requested) {
            identity.requested_before.rotate_right(1);
            identity.requested_before[0] = identity.kind(requested);
        }
        if self.probing {
            self.probes = (self.probes + 1) % FULL_PROBE_EVERY;
        }
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at, reply_by, awaited: false };
        self.profile.sent();
        slot.gone.grid = Some(self.grid);
        self.other.sent();
        self.rtc.sent();
    }

    /// The operating system refused to send the request.
    pub fn unsent(&mut self, slot: &mut Slot) {
        slot.counters.unsent += 1;
        slot.exchange = Exchange::Unsent;
    }

    /// A datagram from the drive came in. `in_window` is false for datagrams that were in the socket before the
    /// send.
    pub fn take(&mut self, at: Time, bytes: &[u8], in_window: bool, slot: &mut Slot) {
        let Ok(view) = ResponseView::new(bytes) else {
            slot.counters.malformed += 1;
            return;
        };
        let echo = Echo {
            request: view.request_def(),
            response: view.response_def(),
            tag: view.config().map(|config| config.count()),
        };
        let owed = match slot.exchange {
            Exchange::Owed { sent_at, .. } if in_window => Some(sent_at),
            _ => None,
        };
        let answers = echo.answers(&self.identity.requested);
        match owed {
            Some(sent_at) if answers => {
                let identity = &mut self.identity;
                let named = identity.requested.tag.is_some();
                let suspect = !named && identity.mistakable >= identity.turns;
                (identity.open, identity.suspect) = (false, suspect);
                if !named && !suspect {
                    // Replies come in the order of their requests: after this one the earlier ones count as lost.
                    identity.mistakable = 0;
                }
                slot.exchange = Exchange::Answered { sent_at, at, suspect };
                slot.counters.answered += 1;
                slot.counters.suspect += u64::from(suspect);
                self.read(at, &view, suspect, slot);
            }
            _ => self.unrequested(at, &view, answers, echo, in_window, slot),
        }
    }

    /// A well-formed telegram that closes no exchange in its window: late, a duplicate, or never requested.
    fn unrequested(
        &mut self,
        at: Time,
        view: &ResponseView<'_>,
        answers: bool,
        echo: Echo,
        in_window: bool,
        slot: &mut Slot,
    ) {
        let identity = &mut self.identity;
        if answers && in_window && identity.suspect {
            // Two replies in one window: the first was a late one. This one is the requested reply, unless there may be
            // more of them.
            identity.take_late();
            let suspect = identity.mistakable >= identity.turns;
            identity.suspect = suspect;
            slot.counters.late += 1;
            if let Exchange::Answered { suspect, .. } = &mut slot.exchange {
                // The feedback is fresh again. The exchange stays without a round-trip sample.
                *suspect = true;
            }
            self.read(at, view, suspect, slot);
            return;
        }
        let named = identity.requested.tag.is_some() || (identity.turns > 1 && !identity.suspect);
        if !identity.knows(echo) {
            slot.counters.foreign += 1;
        } else if answers && identity.open {
            // The reply to the last request, after its window. It may arrive in the window of a cycle in which none
            // was due.
            (identity.open, identity.suspect) = (false, false);
            // The exchange was missed all the same.
            identity.without_miss = 0;
            slot.counters.late += 1;
        } else if identity.under_way > 0 && !(answers && named) {
            identity.take_late();
            slot.counters.late += 1;
        } else {
            slot.counters.duplicate += 1;
        }
    }

    /// The values of an accepted reply.
    fn read(&mut self, at: Time, view: &ResponseView<'_>, suspect: bool, slot: &mut Slot) {
        let (status, state) = (view.status().unwrap_or_default(), view.state().unwrap_or_default());
        let fault = view.error().unwrap_or_default();
        let booting = status == StatusWord::default() && state == StateVar::default();
        let Slot { status: report, notices, evidence, .. } = slot;
        if booting && self.inputs.seen && !self.inputs.booting {
            notices.restarted = true;
            self.profile.drive_restarted();
            self.rtc.drive_restarted();
        }
        if !booting && self.inputs.booting {
            self.rtc.software_runs();
        }
        if booting || self.inputs.booting {
            // Earlier positions, and those reported while booting, are no base for differences.
            self.actual.reset();
            self.demand.reset();
            (report.velocity, evidence.demand_velocity, self.last) = (0.0, 0.0, None);
        }
        // Only a modulo axis wraps around; on any other a corrupted value must not shift all later ones.
        let endless = self.units.modulo.is_some();
        let follow = |count: &mut Unwrap, raw: i32| if endless { count.next(raw) } else { i64::from(raw) };
        let actual = follow(&mut self.actual, view.actual().unwrap_or_default());
        let demand = follow(&mut self.demand, view.demand().unwrap_or_default());
        // A homing gives the positions another origin: that was no motion.
        if let Some(last) = self.last
            && at > last.at
            && !suspect
            && status.homed() == self.inputs.status.homed()
        {
            let rate = self.units.distance(1e9 / at.since(last.at) as f64);
            report.velocity = (actual - last.actual) as f64 * rate;
            evidence.demand_velocity = (demand - last.demand) as f64 * rate;
        }
        if !suspect {
            self.last = Some(Seen { at, actual, demand });
            notices.other_master |= self.other.take(state.count());
        }
        let foreign = self.other.is_in_doubt();
        self.inputs = Inputs { seen: true, foreign, booting, status, state, demand };
        self.profile.take(&self.inputs, !suspect, evidence);
        notices.fresh = true;
        report.at = at;
        report.suspect = suspect;
        report.state = drive_state(status, state, booting);
        report.homed = status.homed();
        if !suspect {
            // A reply to an earlier request may answer another control word.
            report.inhibited = self.profile.inhibited(at, &self.inputs);
        }
        report.moving = self.inputs.moving();
        report.in_target = status.in_target();
        report.position = self.units.position(actual);
        report.demand = self.units.position(demand);
        let place = |count: i64| self.units.distance(count as f64) + self.units.offset;
        (evidence.position, evidence.demand) = (place(actual), place(demand));
        // Blocks that this reply does not have are as in the last one that had them.
        report.current = view.current().map_or(report.current, |current| f64::from(current) * 1e-3);
        report.warning = view.warn().map_or(report.warning, |warning| u32::from(warning.0));
        report.fault = if status.error() { u32::from(fault.0) } else { 0 };
        if !suspect {
            self.take_config(view, slot);
        }
        self.native.publish(at, view.bytes());
    }

    /// The monitored values and the answer on the real-time-config channel.
    fn take_config(&mut self, view: &ResponseView<'_>, slot: &mut Slot) {
        // The values first: they were taken before the answer that reports the change of their sources.
        if let Some(raw) = view.monitor() {
            let rtc = &self.rtc;
            let value = |channel: usize| match self.monitor {
                MonitorPlan::Off => None,
                MonitorPlan::AsSet => Some(f64::from(raw[channel])),
                MonitorPlan::Sources(sources) => {
                    let source = sources[channel].filter(|_| rtc.monitors(channel))?;
                    Some(source.known().map_or(f64::from(raw[channel]), |known| known.value(raw[channel])))
                }
            };
            slot.status.monitor = std::array::from_fn(value);
            slot.notices.monitor_fresh = true;
        }
        match view.config() {
            Some(block) => self.rtc.take(block),
            None => self.rtc.take_none(),
        }
        if let Some(refused) = self.rtc.take_monitor_refusal() {
            slot.notices.monitor_refused = Some(refused);
        }
    }
}

/// Maps LinMot's states onto those of CiA 402.
///
/// An error being logged (3) and the quick stop of an error (14 with the error bit) are the fault reaction; aborting
/// and freezing hold the axis under control after a quick stop.
fn drive_state(status: StatusWord, state: StateVar, booting: bool) -> State {
    if booting {
        return State::NotReadyToSwitchOn;
    }
    match state.main() {
        MainState::NOT_READY => State::NotReadyToSwitchOn,
        MainState::SWITCH_ON_DISABLED => State::SwitchOnDisabled,
        MainState::READY_TO_SWITCH_ON => State::ReadyToSwitchOn,
        MainState::SETUP_ERROR => State::FaultReactionActive,
        MainState::ERROR => State::Fault,
        MainState::HW_TESTS | MainState::READY_TO_OPERATE | MainState::BRAKE_DELAY | MainState(7) => {
            State::SwitchedOn
        }
        MainState::QUICK_STOP if status.error() => State::FaultReactionActive,
        MainState::QUICK_STOP | MainState::ABORTING | MainState::FREEZING => State::QuickStopActive,
        MainState(8..=20) => State::OperationEnabled,
        // A state of newer firmware: treated as powered, so that nothing is powered off because of it.
        _ => State::SwitchedOn,
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;
    use crate::axis::{Command, Row};
    use crate::bus::linudp::StreamCommand;
    use crate::bus::linudp::profile::capabilities;
    use crate::bus::linudp::wire::Response;
    use crate::drive::machine::{Machine, NumberedRow};
    use crate::time::MS;

    /// A station, and a drive of a few lines that says what it is made to say.
    struct Bench {
        station: Station,
        machine: Machine,
        slot: Slot,
        cycle: Cycle,
        request: Request,
    }

    impl Bench {
        fn new(drive: &LinUdpDrive) -> Bench {
            let (station, ..) = Station::new(drive);
            let cycle = Cycle { index: 0, grid: Time(MS), period_ns: MS, deadline: Time(MS + MS / 2) };
            let machine = Machine::new(&drive.axis, capabilities(drive), MS);
            let slot = Slot { due: true, link: Link::Online, ..Slot::default() };
            Bench { station, machine, slot, cycle, request: Request::default() }
        }

        /// The next request is built.
        fn build(&mut self) -> Request {
            let mut out = [0; 64];
            self.cycle =
                Cycle { grid: self.cycle.grid + MS, deadline: self.cycle.deadline + MS, ..self.cycle };
            self.machine.observe(self.cycle.grid, false, &self.slot);
            self.slot.notices.fresh = false;
            self.machine.propose(self.cycle.grid, &mut self.slot);
            let length = self.station.prepare(&self.cycle, &mut self.slot, &mut out);
            Request::parse(&out[..length]).unwrap()
        }

        /// The next request goes out.
        fn send(&mut self) -> Request {
            self.request = self.build();
            self.station.sent(self.cycle.grid, self.cycle.deadline, &mut self.slot);
            self.machine.commit(self.cycle.grid);
            self.request
        }

        /// A reply to `request` comes in the window, from a drive in operation with this sub state.
        fn reply(&mut self, request: &Request, sub: u8) {
            let (mut bytes, fields) = ([0; 64], StateVar::new(MainState::OPERATION_ENABLED, sub));
            let response = Response {
                request_def: request.definition(),
                response_def: request.response_def,
                status: Some(StatusWord(0x0037)),
                state: Some(fields),
                config: request.config.map(|block| RtcBlock::answer(block.count(), 0)),
                ..Response::default()
            };
            let size = response.emit(&mut bytes);
            self.station.take(self.cycle.grid + MS / 10, &bytes[..size], true, &mut self.slot);
        }

        fn start(&mut self, command: Command) {
            self.machine.start(self.cycle.grid, Some(command));
        }
    }

    #[test]
    fn a_reply_that_is_up_to_three_exchanges_late_is_never_the_newest() {
        for (monitor, turns) in [(MonitorPlan::Off, 4), (MonitorPlan::AsSet, 2)] {
            let mut b = Bench::new(&LinUdpDrive { monitor, ..LinUdpDrive::new("x", Ipv4Addr::LOCALHOST) });
            let mut before = Vec::new();
            for exchange in 0..100 {
                let request = b.send();
                for late in before.iter().rev().take(turns - 1) {
                    b.reply(late, 9);
                    assert!(matches!(b.slot.exchange, Exchange::Owed { .. }), "exchange {exchange}");
                }
                b.reply(&request, 1);
                assert!(matches!(b.slot.exchange, Exchange::Answered { suspect: false, .. }));
                before.push(request);
            }
            assert_eq!((b.slot.counters.late, b.slot.counters.foreign, b.slot.counters.suspect), (0, 0, 0));
        }
    }

    #[test]
    fn only_what_may_pass_for_the_next_reply_is_in_doubt() {
        let quiet = LinUdpDrive::new("x", Ipv4Addr::LOCALHOST);
        for (reply_tag, monitor, settles) in [
            (ReplyTag::Definition, MonitorPlan::Off, true),
            (ReplyTag::Count, MonitorPlan::Off, true),
            // Two definitions only, or one: a copy of an answered reply may look like the next one.
            (ReplyTag::Definition, MonitorPlan::AsSet, false),
            (ReplyTag::Off, MonitorPlan::Off, false),
        ] {
            let mut b = Bench::new(&LinUdpDrive { monitor, reply_tag, ..quiet.clone() });
            for _ in 0..3 {
                let request = b.send();
                assert!(b.station.is_in_doubt(), "it is owed");
                b.reply(&request, 1);
                assert_eq!(b.station.is_in_doubt(), !settles, "{reply_tag:?} {monitor:?}");
            }
            let missed = b.send();
            let request = b.send();
            b.reply(&request, 1);
            assert!(b.station.is_in_doubt(), "the missed one may still come");
            b.reply(&missed, 1);
            assert_eq!(b.station.is_in_doubt(), !settles, "{reply_tag:?} {monitor:?}");
        }
    }

    #[test]
    fn a_stop_is_done_by_two_replies_with_its_own_count_and_by_no_others() {
        let mut b = Bench::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
        // In motion, by a command whose count is 5.
        for _ in 0..4 {
            let request = b.send();
            b.reply(&request, StateVar::MOTION_ACTIVE | 5);
        }
        b.start(Command::Stop { deceleration: None });
        let mut request = b.send();
        let stop = request.motion.unwrap().header as u8 & 0xF;
        assert_eq!(stop, 6);
        let standing = |count: u8| (count, None);
        let moving = |count: u8| (StateVar::MOTION_ACTIVE | count, None);
        // What the drive says, and the count of the next request. Replies of before the motion, in all respects like
        // the newest; then its own echo; then somebody else's command has run.
        for ((sub, end), count) in [
            (standing(4), Some(6)),
            (moving(5), Some(6)),
            (standing(4), Some(6)),
            (standing(6), None),
            (moving(5), Some(7)),
            (moving(7), None),
            (moving(7), None),
            (standing(7), None),
            ((7, Some(Ok(()))), None),
        ] {
            b.reply(&request, sub);
            request = b.send();
            assert_eq!(request.motion.map(|motion| motion.header as u8 & 0xF), count, "after {sub:02X}h");
            assert_eq!(b.machine.end(), end, "after {sub:02X}h");
        }
    }

    /// Other masters truncate: 0.57 mm became 5699 (LinUDP sheet, 7.2).
    #[test]
    fn a_position_is_rounded_to_the_nearest_count() {
        let mut b = Bench::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
        for _ in 0..4 {
            let request = b.send();
            b.reply(&request, StateVar::MOTION_ACTIVE | 5);
            b.start(Command::Reset);
        }
        b.start(Command::Follow);
        b.machine.input.row = Some(NumberedRow { number: 1, row: Row { position: 0.57, ..Row::default() } });
        assert_eq!(b.send().motion.unwrap().parameters[..4], 5_700_i32.to_le_bytes());
    }

    #[test]
    fn a_stop_in_place_of_a_stream_that_never_left_is_a_stop() {
        let mut b = Bench::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
        for _ in 0..4 {
            let request = b.send();
            b.reply(&request, StateVar::MOTION_ACTIVE | 5);
            // It is in operation, and left so.
            b.start(Command::Reset);
        }
        b.start(Command::Follow);
        b.machine.input.row = Some(NumberedRow { number: 1, row: Row { position: 1.0, ..Row::default() } });
        let sent = |request: Request| request.motion.map(|motion| motion.header >> 4);
        assert_eq!(sent(b.build()), Some(StreamCommand::Pva.id()));
        b.start(Command::Stop { deceleration: None });
        for _ in 0..3 {
            let request = b.send();
            assert_eq!(sent(request), Some(0x017), "{request:?}");
            b.reply(&request, StateVar::MOTION_ACTIVE | 5);
        }
    }

    #[test]
    fn every_fourth_probe_that_goes_out_has_all_blocks() {
        let (mut station, ..) = Station::new(&LinUdpDrive::new("x", Ipv4Addr::LOCALHOST));
        let (mut slot, mut out) = (Slot::default(), [0; 64]);
        let cycle = Cycle { index: 0, grid: Time(0), period_ns: 1_000_000, deadline: Time(500_000) };
        for probe in 1..=12 {
            // Slots that are passed over do not count.
            for _ in 0..probe {
                let length = station.prepare(&cycle, &mut slot, &mut out);
                let request = Request::parse(&out[..length]).unwrap();
                assert_eq!(request.motion.is_some() && request.config.is_some(), probe % 4 == 0, "{probe}");
            }
            station.sent(Time(0), Time(1), &mut slot);
        }
    }
}
