//! An accepted reply: what it reports in user units, and what it proves.

use super::{Station, UNSETTLED};
use crate::plan::MonitorPlan;
use crate::profile::{Carried, Inputs};
use crate::wire::{Front, MainState, ResponseView, StateVar, StatusWord};
use fieldbeat_core::axis::units::Unwrap;
use fieldbeat_core::axis::{Link, State};
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::Time;

/// The turns of a rotary axis since the drive started.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turns {
    actual: Unwrap,
    demand: Unwrap,
}

/// Positions of one reply, unwrapped, 0.1 um.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    /// When the request left. The drive takes the positions when it has the request; the reply may be received any time
    /// later, where this computer is late.
    sent_at: Time,
    actual: i64,
    demand: i64,
}

impl Station {
    /// A reply to the request that left at `sent_at` is newer than the last one.
    #[inline]
    pub(super) fn is_newer(&self, sent_at: Time) -> bool {
        !self.has_last || sent_at > self.last.sent_at
    }

    /// The positions of the next reply.
    #[inline]
    fn next(&mut self, sent_at: Time, front: &Front) -> Counts {
        // Only a modulo axis wraps around; on any other a corrupted value must not shift all later ones.
        match self.units.modulo {
            None => Counts { sent_at, actual: front.actual.into(), demand: front.demand.into() },
            Some(_) => {
                let Turns { actual, demand } = &mut self.turns;
                Counts { sent_at, actual: actual.next(front.actual), demand: demand.next(front.demand) }
            }
        }
    }

    /// The values of an accepted reply to the request that left at `sent_at`; newer ones have left since if that is
    /// given what it `carried`.
    #[inline(always)]
    pub(super) fn read(
        &mut self,
        sent_at: Time,
        at: Time,
        view: &ResponseView<'_>,
        suspect: bool,
        carried: Option<Carried>,
        slot: &mut Slot,
    ) {
        let front = view.front();
        let rehomed = front.status.homed() != self.inputs.status.homed();
        let same = (front.status, front.state) == (self.inputs.status, self.inputs.state);
        let settled = same
            && !suspect
            && carried.is_none()
            && !slot.anew
            && !self.starts
            && self.settled == self.profile.revision();
        if !settled && !self.watch_start(&front, suspect, slot) {
            return;
        }
        let counts = self.next(sent_at, &front);
        let Slot { status: report, notices, evidence, .. } = &mut *slot;
        // A homing gives the positions another origin: that was no motion.
        let last = self.last;
        if self.has_last && sent_at > last.sent_at && !suspect && !rehomed {
            let rate = self.units.distance(1e9 / sent_at.since(last.sent_at).cast_signed() as f64);
            report.velocity = (counts.actual - last.actual) as f64 * rate;
            evidence.demand_velocity = (counts.demand - last.demand) as f64 * rate;
        }
        if !suspect {
            (self.last, self.has_last) = (counts, true);
        }
        self.inputs.demand = counts.demand;
        notices.fresh = true;
        report.at = at;
        let place = |count: i64| self.units.distance(count as f64) + self.units.offset;
        (evidence.position, evidence.demand) = (place(counts.actual), place(counts.demand));
        report.position = self.units.folded(evidence.position);
        report.demand = self.units.folded(evidence.demand);
        // Blocks that this reply does not have are as in the last one that had them.
        if let Some(current) = view.current() {
            report.current = f64::from(current) * 1e-3;
        }
        if let Some(warning) = view.warn() {
            report.warning = warning.0.into();
        }
        if !settled {
            self.prove(at, view, &front, suspect, carried, slot);
        }
        if !suspect && (!self.idle || self.shows) {
            self.take_config(view, carried.is_some(), slot);
        }
        self.native.publish(at, 0, view.bytes());
    }

    /// Whether the drive has started anew, or is about to. False if this reply is the first one that says so: it may be
    /// one from its last start, and counts for nothing. On a lost link it is enough: probes are so far apart that no
    /// second one may meet the start, and what is discarded is read again when the link is back.
    #[inline(never)]
    fn watch_start(&mut self, front: &Front, suspect: bool, slot: &mut Slot) -> bool {
        let booting = is_booting(front);
        if booting && self.inputs.seen && !self.inputs.booting {
            let answers = matches!(slot.link, Link::Online | Link::Qualifying);
            if answers && (suspect || !std::mem::replace(&mut self.starts, true)) {
                return false;
            }
        }
        slot.counters.implausible += u64::from(std::mem::take(&mut self.starts) && !booting);
        // The channel may have something to send.
        self.idle &= !(booting || self.inputs.booting);
        if booting && self.inputs.seen && !self.inputs.booting {
            slot.notices.restarted = true;
            self.profile.drive_restarted();
            self.rtc.drive_restarted();
        }
        if !booting && self.inputs.booting {
            self.rtc.software_runs();
        }
        if booting || self.inputs.booting {
            // Earlier positions, and those reported while booting, are no base for differences.
            (self.turns, self.has_last) = (Turns::default(), false);
            (slot.status.velocity, slot.evidence.demand_velocity) = (0.0, 0.0);
        }
        true
    }

    /// Takes the reported states of a reply, and their evidence.
    #[inline(never)]
    fn prove(
        &mut self,
        at: Time,
        view: &ResponseView<'_>,
        front: &Front,
        suspect: bool,
        carried: Option<Carried>,
        slot: &mut Slot,
    ) {
        let Slot { status: report, notices, evidence, counters, .. } = slot;
        let Front { status, state, .. } = *front;
        if !suspect {
            notices.other_master |= self.other.take(state.count(), counters.sent);
        }
        let (foreign, booting) = (self.other.is_in_doubt(), is_booting(front));
        self.error = if status.error() { view.error().or(self.error) } else { None };
        let named = self.error.is_some();
        self.inputs =
            Inputs { seen: true, foreign, booting, named, status, state, demand: self.inputs.demand };
        match carried {
            None => self.profile.take(&self.inputs, !suspect, evidence),
            Some(carried) => self.profile.take_earlier(&self.inputs, &carried, !suspect, evidence),
        }
        report.suspect = suspect;
        report.state = drive_state(status, state, booting);
        report.homed = status.homed();
        if !suspect {
            // A reply to an earlier request may answer another control word.
            report.sto_open = self.profile.sto_open(at, &self.inputs, carried);
        }
        report.moving = self.inputs.moving();
        report.in_target = status.in_target();
        report.fault = self.error.map_or(0, |error| u32::from(error.0));
        let settled = !suspect
            && carried.is_none()
            && !booting
            && !status.error()
            && self.other.is_settled()
            && self.profile.is_settled();
        self.settled = if settled { self.profile.revision() } else { UNSETTLED };
    }

    /// The monitored values, and the answer on the real-time-config channel.
    #[inline(never)]
    fn take_config(&mut self, view: &ResponseView<'_>, is_earlier: bool, slot: &mut Slot) {
        // The values first: they were taken before the answer that reports the change of their sources.
        if let Some(raw) = view.monitor().filter(|_| self.shows) {
            let value = |channel: usize| match self.monitor {
                MonitorPlan::Off => None,
                MonitorPlan::AsSet => Some(f64::from(raw[channel])),
                MonitorPlan::Sources(sources) => {
                    let source = sources[channel].filter(|_| self.rtc.monitors(channel))?;
                    Some(source.known().map_or(f64::from(raw[channel]), |known| known.value(raw[channel])))
                }
            };
            slot.status.monitor = std::array::from_fn(value);
            slot.notices.monitor_fresh = true;
        }
        match view.config() {
            Some(block) => self.rtc.take(block, is_earlier),
            None => self.rtc.take_none(is_earlier),
        }
        if let Some((channel, status)) = self.rtc.take_monitor_refusal() {
            slot.notices.refuse_monitor(channel, status);
        }
    }
}

/// Status word and state var are 0: booting, or the motion software is stopped.
fn is_booting(front: &Front) -> bool {
    (front.status, front.state) == (StatusWord::default(), StateVar::default())
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
        MainState::HW_TESTS
        | MainState::READY_TO_OPERATE
        | MainState::BRAKE_DELAY
        | MainState::BRAKE_RELEASE => State::SwitchedOn,
        MainState::QUICK_STOP if status.error() => State::FaultReactionActive,
        MainState::QUICK_STOP | MainState::ABORTING | MainState::FREEZING => State::QuickStopActive,
        MainState(8..=20) => State::OperationEnabled,
        // A state of newer firmware: treated as powered, so that nothing is powered off because of it.
        _ => State::SwitchedOn,
    }
}
