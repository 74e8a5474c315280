//! The master's view of one drive: which reply answers which request, what the drive reported last, and the next
//! request.
//! It takes `now` and slices, and knows no socket. The steps of an order are in `orders`.
//!
//! LinUDP has no sequence number. A reply counts by its sender, by the echo of both definitions, and by the open
//! exchange; after a missed exchange the next reply may be the late one of the exchange before, so it is *suspect*:
//! taken as feedback one cycle older, without a round-trip sample. The request after it requests one block more or
//! less, so that its echo is its own. With `reply_tag` a real-time-config no-operation carries a new count in every
//! request and its echo names the request.

use super::native::{Native, NativePort, native};
use super::orders::{Inputs, Orders, Outputs};
use super::plan::{LinUdpDrive, MonitorPlan};
use super::rtc::RtcChannel;
use super::wire::{
    MainState, MotionBlock, Request, RequestDef, ResponseDef, ResponseView, RtcBlock, StateVar, StatusWord,
};
use crate::axis::acyclic::{self, AcyclicEnds};
use crate::axis::units::Unwrap;
use crate::axis::{Link, State, Units};
use crate::bus::{Cycle, Exchange, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// Every so many probes of a silent drive, one carries a no-operation motion block and a real-time-config block: some
/// factory-fresh drives do not answer a telegram without any block (sheet, 1.3).
const FULL_PROBE_EVERY: u8 = 4;

/// The most requests whose replies may be mistaken for that to the next one; older ones count as lost.
const MOST_MISTAKABLE: u8 = 3;

/// The most requests whose replies may still be under way ...
const MOST_UNDER_WAY: u8 = 16;
/// ... and are written off after so many exchanges without a miss: no reply takes that long.
const FORGOTTEN_AFTER: u8 = 16;

/// One drive.
#[derive(Debug)]
pub struct Station {
    units: Units,
    response_def: ResponseDef,
    tagged: bool,
    identity: Identity,
    inputs: Inputs,
    /// The last fresh reply: state, and the positions for the velocity.
    last: Option<Seen>,
    actual: Unwrap,
    demand: Unwrap,
    orders: Orders,
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
    /// What the reply to the prepared request will echo.
    prepared: Echo,
    /// What the reply to the last request sent echoes.
    asked: Echo,
    /// The echoes of the requests before it, newest first, without repetitions in a row: as far back as late
    /// replies come from while the link is still online.
    asked_before: [Echo; 3],
    /// An exchange was opened and no reply closed it.
    open: bool,
    /// Replies to earlier requests that may still come: such a one is late and no duplicate.
    under_way: u8,
    /// Those among them that look like the reply to the next request: that reply is suspect.
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
}

/// What a reply echoes of its request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Echo {
    request: RequestDef,
    response: ResponseDef,
    /// The count of the real-time-config block; of a request, if it was chosen to tell its reply from others.
    tag: Option<u8>,
}

impl Echo {
    /// Whether this echo of a reply can be that of the request that echoes `asked`.
    fn answers(&self, asked: &Echo) -> bool {
        self.is_like(asked) && (asked.tag.is_none() || self.tag == asked.tag)
    }

    /// The same without the tag.
    fn is_like(&self, asked: &Echo) -> bool {
        (self.request, self.response) == (asked.request, asked.response)
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
        let (ends, port) = acyclic::queue(drive.axis.parameter_queue);
        let mut response_def = ResponseDef::CYCLIC;
        if drive.monitor != MonitorPlan::Off {
            response_def = response_def.with(ResponseDef::MONITOR);
        }
        let station = Station {
            units: drive.axis.units,
            response_def,
            tagged: drive.reply_tag,
            identity: Identity::default(),
            inputs: Inputs::default(),
            last: None,
            actual: Unwrap::default(),
            demand: Unwrap::default(),
            orders: Orders::new(drive),
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
        let outputs = self.orders.advance(cycle.grid, &self.inputs, slot, &mut self.native);
        self.inputs.fresh = false;
        let Outputs { control, motion, config } = outputs;
        let powered = slot.report.state.is_powered();
        let called = self.rtc.advance(cycle.grid, slot.link, powered);
        slot.excused = self.rtc.excuses_silence() && !powered;
        let mut request = Request {
            response_def: self.response_def,
            control,
            motion,
            config: config.or(called),
            ..Request::default()
        };
        if config.is_some() {
            self.rtc.give_way();
        }
        if self.identity.suspect {
            // Its definition differs from the earlier ones, so that the echo tells its reply from all late ones: if
            // they were always one cycle behind, each would pass for the newest for ever.
            request.response_def.0 ^= ResponseDef::MONITOR.0;
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
        self.probing = silent && slot.order.serial == 0;
        if self.probing && self.probes == FULL_PROBE_EVERY - 1 {
            request.motion = Some(MotionBlock::default());
            request.config = request.config.or(Some(RtcBlock::default()));
        }
        if request.config.is_some() {
            request.response_def = request.response_def.with(ResponseDef::CONFIG);
        }
        self.identity.prepared = Echo {
            request: request.definition(),
            response: request.response_def,
            tag: tag.map(|block| block.count()),
        };
        request.emit(out)
    }

    /// The request was handed to the wire.
    pub fn sent(&mut self, sent_at: Time, reply_by: Time, slot: &mut Slot) {
        let identity = &mut self.identity;
        if identity.open {
            identity.under_way = (identity.under_way + 1).min(MOST_UNDER_WAY);
            identity.mistakable = (identity.mistakable + 1).min(MOST_MISTAKABLE);
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
        if identity.prepared != identity.asked {
            identity.asked_before.rotate_right(1);
            identity.asked_before[0] = std::mem::replace(&mut identity.asked, identity.prepared);
        }
        if self.probing {
            self.probes = (self.probes + 1) % FULL_PROBE_EVERY;
        }
        slot.counters.sent += 1;
        slot.exchange = Exchange::Owed { sent_at, reply_by, awaited: false };
        self.orders.sent();
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
        let answers = echo.answers(&self.identity.asked);
        match owed {
            Some(sent_at) if answers => {
                let suspect = self.identity.asked.tag.is_none() && self.identity.mistakable > 0;
                (self.identity.open, self.identity.suspect) = (false, suspect);
                slot.exchange = Exchange::Answered { sent_at, at, suspect };
                slot.counters.answered += 1;
                slot.counters.suspect += u64::from(suspect);
                self.read(at, &view, suspect, slot);
            }
            _ => self.unasked(at, &view, answers, echo, in_window, slot),
        }
    }

    /// A well-formed telegram that closes no exchange in its window: late, a duplicate, or never requested.
    fn unasked(
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
            // Two replies in one window: the first was the late one, this one is the requested reply.
            identity.suspect = false;
            identity.take_late();
            slot.counters.late += 1;
            if let Exchange::Answered { suspect, .. } = &mut slot.exchange {
                // The feedback is fresh again. The exchange stays without a round-trip sample.
                *suspect = true;
            }
            self.read(at, view, false, slot);
            return;
        }
        let like = |asked: &Echo| echo.is_like(asked);
        if !like(&identity.asked) && !identity.asked_before.iter().any(like) {
            slot.counters.foreign += 1;
        } else if answers && identity.open {
            // The reply to the last request, after its window. It may arrive in the window of a cycle in which none
            // was due.
            (identity.open, identity.suspect) = (false, false);
            // The exchange was missed all the same.
            identity.without_miss = 0;
            slot.counters.late += 1;
        } else if identity.under_way > 0 && !(answers && identity.asked.tag.is_some()) {
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
        let report = &mut slot.report;
        if booting && self.inputs.seen && !self.inputs.booting {
            report.restarted = true;
            self.orders.drive_restarted();
            self.rtc.drive_restarted();
        }
        if !booting && self.inputs.booting {
            self.rtc.software_runs();
        }
        if booting || self.inputs.booting {
            // Earlier positions, and those reported while booting, are no base for differences.
            self.actual.reset();
            self.demand.reset();
            (report.velocity, self.inputs.velocity, self.last) = (0.0, 0.0, None);
        }
        // Only a modulo axis wraps around; on any other a corrupted value must not shift all later ones.
        let endless = self.units.modulo.is_some();
        let follow = |count: &mut Unwrap, raw: i32| if endless { count.next(raw) } else { i64::from(raw) };
        let actual = follow(&mut self.actual, view.actual().unwrap_or_default());
        let demand = follow(&mut self.demand, view.demand().unwrap_or_default());
        // A homing gives the positions another origin: that was no motion.
        let mut speed = self.inputs.velocity;
        if let Some(last) = self.last
            && at > last.at
            && !suspect
            && status.homed() == self.inputs.status.homed()
        {
            let rate = self.units.distance(1e9 / at.since(last.at) as f64);
            report.velocity = (actual - last.actual) as f64 * rate;
            speed = (demand - last.demand) as f64 * rate;
        }
        if !suspect {
            self.last = Some(Seen { at, actual, demand });
        }
        self.inputs = Inputs {
            seen: true,
            fresh: true,
            clean: !suspect,
            booting,
            at,
            status,
            state,
            demand,
            velocity: speed,
            fault,
        };
        report.fresh = true;
        report.at = at;
        report.suspect = suspect;
        report.state = drive_state(status, state, booting);
        report.homed = status.homed();
        // In state 8 the sub state is sampled together with the count echo; elsewhere the status word has to be
        // used.
        if !suspect {
            // A reply to an earlier request may answer another control word.
            report.inhibited = !booting && self.orders.is_inhibited(status);
        }
        report.moving = state.motion_active().unwrap_or(status.motion_active());
        report.in_target = status.in_target();
        report.position = self.units.position(actual);
        report.demand = self.units.position(demand);
        report.current = f64::from(view.current().unwrap_or_default()) * 1e-3;
        report.warning = u32::from(view.warn().unwrap_or_default().0);
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
            slot.report.monitor = std::array::from_fn(value);
            slot.report.monitor_fresh = true;
        }
        match view.config() {
            Some(block) => self.rtc.take(block),
            None => self.rtc.take_none(),
        }
        if let Some(refused) = self.rtc.take_monitor_refusal() {
            slot.report.monitor_refused = Some(refused);
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
