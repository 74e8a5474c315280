//! The exchange of a cycle: what was sent, how it ended, and which reports count that came with it.
//!
//! One that says what it may say only because it is an older one, or a damaged one, is held back: it is not shown,
//! proves nothing and leads to nothing. The next one decides.
//!
//! - **A loss** of power, reference or hardware enable takes as many reports in a row as a state of its power
//!   ([`Capabilities::power_reports`](crate::bus::desired::Capabilities::power_reports)). A report of a lost reference
//!   and one of lost power do not prove each other. What this master has requested needs no more proof than its
//!   command takes.
//! - **A place** that the axis cannot have reached ([`Watch`](crate::drive::watch::Watch)) takes a second report that
//!   agrees with it, on every wire. Then the axis is there, is no longer homed, and stops.
//!
//! A report that is suspect decides nothing.

use super::duty::Claim;
use super::watch::Braked;
use super::{Along, DriveController, Ending};
use crate::axis::{Command, DriveStatus, EventKind, Link, Outcome, Shown, State, StopCause};
use crate::bus::contract::Ended;
use crate::bus::desired::{Evidence, Homing, ModeIs, Power};
use crate::bus::{Cycle, Exchange, Slot};
use crate::drive::numbers::{Extent, see};
use crate::drive::record::{Reply, measured, short};
use crate::drive::watch::{Bound, Losses, Sample, Weight};
use crate::time::{MS, Time};

/// After a homing, or after native mode, the positions may change their origin for so long, ns.
const SETTLES_NS: u64 = 200 * MS;

impl DriveController {
    /// The request that was due was sent in `cycle`, or attempted: in the send stage, or, if it was queued then, in the
    /// receive stage. While it is queued, or passed over because the one before it is owed, nothing has changed. Its
    /// exchange may have been closed since then.
    #[inline(always)] // Once for each axis and cycle.
    pub(super) fn sent(&mut self, cycle: &Cycle, slot: &mut Slot) {
        self.queued = false;
        if let Some(grid) = slot.gone.grid.take() {
            self.machine.commit(grid);
        }
        match slot.exchange.sent_at() {
            Some(sent_at) if sent_at >= cycle.grid => self.left(cycle, sent_at),
            Some(_) => {}
            None => self.not_sent(cycle, slot),
        }
    }

    /// The request left at this instant.
    #[inline(always)] // As `sent`.
    fn left(&mut self, cycle: &Cycle, sent_at: Time) {
        self.health.requested(cycle.index, true);
        self.row_waits = false;
        let phase_ns = sent_at.since(cycle.grid);
        self.measured.phase_ns = measured(phase_ns);
        let before_ns = std::mem::replace(&mut self.phase_ns, phase_ns);
        if before_ns != DriveController::NEVER {
            let jitter_ns = phase_ns.abs_diff(before_ns);
            self.measured.jitter_ns = measured(jitter_ns);
            see(&mut self.largest.send_jitter, &mut self.largest_in.send_jitter, jitter_ns, cycle.index);
        }
    }

    #[inline(never)]
    fn not_sent(&mut self, cycle: &Cycle, slot: &Slot) {
        match slot.exchange {
            Exchange::Queued => self.queued = true,
            _ => {
                self.health.requested(cycle.index, false);
                // A row that the operating system refused is sent with the next request; in a group it is lost like any
                // telegram, or this axis would be one row behind from then on.
                self.row_waits &= slot.exchange == Exchange::Unsent && self.moves_in_group().is_none();
            }
        }
    }

    /// The usual end of a cycle: the drive is online and has missed nothing, its exchange was answered, and its report
    /// says what the one before said, but for its values. `None`: it is another end, and nothing has changed yet.
    #[inline(always)] // As `sent`.
    pub(super) fn judge_usual(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Option<Reply> {
        let (sent_at, reply) = match slot.exchange {
            Exchange::Answered { sent_at, suspect: false, .. } => (sent_at, Reply::Answered),
            Exchange::OwnClock { fresh_until, .. } if cycle.grid < fresh_until => {
                (slot.status.at, Reply::Current)
            }
            _ => return None,
        };
        if slot.has_earlier | slot.reachable
            || !slot.notices.is_report_only()
            || !self.health.is_clean()
            || self.feedback.link != Link::Online
            || self.rising > 0
            || !self.feedback.status.says(&slot.status)
            || self.watch.doubts()
            || !self.watch.takes(Sample::of(sent_at, !self.duty.is_under_torque(), slot))
        {
            return None;
        }
        self.grid = cycle.grid;
        self.measured.was_online = true;
        self.answered(cycle, slot);
        self.measured.reply = reply;
        self.feedback.cycle = cycle.index;
        self.keep_status(slot);
        self.grow_old(cycle, now);
        Some(reply)
    }

    /// Evaluates any other end of a cycle, updates the feedback, and notices changes. Returns the result of the
    /// exchange.
    pub(super) fn judge(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        self.grid = cycle.grid;
        self.measured.was_online = self.feedback.link == Link::Online;
        let jumped = if slot.notices.fresh { self.weigh(slot) } else { None };
        // What ended besides this exchange, and when the request was sent that is reported on, if that is an earlier
        // one.
        let (ended, reported) =
            if slot.has_earlier { self.judge_earlier(cycle, now, slot) } else { (None, None) };
        let reply = match slot.exchange {
            Exchange::Answered { suspect: false, .. } => {
                self.answered(cycle, slot);
                Reply::Answered
            }
            Exchange::OwnClock { fresh_until, .. } if cycle.grid < fresh_until => {
                self.answered(cycle, slot);
                Reply::Current
            }
            _ => {
                let reply = self.judge_otherwise(cycle, now, slot);
                self.health.watch_silence(cycle.index);
                reply
            }
        };
        let reply = match &ended {
            None => reply,
            Some(ended) => self.with_earlier(reply, ended, slot),
        };
        self.measured.reply = reply;
        if slot.reachable {
            slot.reachable = false;
            self.health.reachable(cycle.index + 1);
        }
        if slot.notices.restarted {
            self.watch.forget();
        }
        self.take_status(cycle, now, slot);
        if let Some(sent_at) = reported {
            let age = cycle.grid.since(sent_at).div_ceil(cycle.period_ns.max(1));
            self.feedback.grow_older(age.min(cycle.index));
        }
        if self.feedback.link != self.health.link() {
            self.change_link(cycle, now, slot);
        }
        if let Some(by) = jumped {
            self.jump(cycle, now, by);
        }
        // The first answer need not report the drive's state.
        if matches!(self.feedback.link, Link::Online | Link::Qualifying) && self.feedback.status.at != Time(0)
        {
            self.grow_old(cycle, now);
        }
        reply
    }

    /// The exchange was answered, for certain: that of a drive with its own clock without a round trip.
    #[inline(always)] // As `sent`.
    fn answered(&mut self, cycle: &Cycle, slot: &mut Slot) {
        match slot.exchange {
            Exchange::Answered { sent_at, at, .. } => {
                let rtt_ns = at.since(sent_at);
                see(&mut self.largest.rtt, &mut self.largest_in.rtt, rtt_ns, cycle.index);
                self.measured.rtt_ns = measured(rtt_ns);
                if slot.notices.fresh {
                    self.feedback.rtt_ns = Some(short(rtt_ns));
                }
            }
            _ => slot.counters.answered += 1,
        }
        slot.exchange = Exchange::Idle;
        self.health.answered(cycle.index);
    }

    /// How old its values are by now.
    #[inline(always)] // As `sent`.
    fn grow_old(&mut self, cycle: &Cycle, now: Time) {
        let age_ns = now.since(self.feedback.status.at);
        self.measured.age_ns = measured(age_ns);
        see(&mut self.largest.age, &mut self.largest_in.age, age_ns, cycle.index);
    }

    /// The exchanges of earlier cycles, oldest first: those whose time is up, and those that were answered.
    #[cold]
    fn judge_earlier(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> (Option<Ended>, Option<Time>) {
        let ended = slot.earlier.end(cycle);
        let Ended { missed, answered, rtt_ns, sent_at } = ended;
        slot.has_earlier = !slot.earlier.open().is_empty();
        slot.counters.missed += u64::from(missed);
        (0..missed).for_each(|_| self.missed(cycle, now));
        if answered > 0 {
            (0..answered).for_each(|_| self.health.answered(cycle.index));
            see(&mut self.largest.rtt, &mut self.largest_in.rtt, rtt_ns, cycle.index);
            self.measured.rtt_ns = measured(rtt_ns);
        }
        // The reply to a newer request has replaced what they report.
        let reported = match slot.exchange {
            Exchange::Answered { suspect: false, .. } => None,
            _ => Some(sent_at).filter(|_| answered > 0 && slot.notices.fresh),
        };
        (Some(ended), reported)
    }

    /// How a cycle ended in which exchanges of earlier ones ended, too.
    #[cold]
    fn with_earlier(&mut self, reply: Reply, ended: &Ended, slot: &Slot) -> Reply {
        let Ended { missed, answered, rtt_ns, .. } = *ended;
        self.misses = missed + u32::from(reply == Reply::Missed);
        if answered > 0 {
            self.measured.rtt_ns = self.measured.rtt_ns.max(measured(rtt_ns));
            if slot.notices.fresh && reply != Reply::Answered {
                self.feedback.rtt_ns = Some(short(rtt_ns));
            }
        }
        match reply {
            _ if missed > 0 => Reply::Missed,
            Reply::None | Reply::Owed if answered > 0 => Reply::Answered,
            _ => reply,
        }
    }

    /// No exchange was answered for certain.
    #[inline(never)]
    fn judge_otherwise(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        match slot.exchange {
            Exchange::Idle | Exchange::Missed => Reply::None,
            Exchange::Queued => Reply::Queued,
            Exchange::Owed { reply_by, .. } if !cycle.closes(reply_by) => Reply::Owed,
            Exchange::Owed { .. } | Exchange::OwnClock { .. } | Exchange::Absent { .. } => {
                slot.counters.missed += 1;
                slot.exchange = Exchange::Missed;
                self.missed(cycle, now);
                Reply::Missed
            }
            Exchange::Unsent => {
                slot.exchange = Exchange::Idle;
                // A link that its bus shuts down at the orderly end is not lost.
                if !(self.ending != Ending::No && slot.expected_silence) {
                    self.missed(cycle, now);
                }
                Reply::Unsent
            }
            Exchange::Answered { .. } => {
                slot.exchange = Exchange::Idle;
                self.health.answered_in_doubt(cycle.index);
                Reply::Suspect
            }
        }
    }

    fn missed(&mut self, cycle: &Cycle, now: Time) {
        self.health.missed(cycle.index);
        if self.moves_in_group().is_some() {
            self.emit(cycle, now, EventKind::MissedInGroup);
        }
    }

    /// Takes the drive's status into the feedback, with an event for each change.
    fn take_status(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let Slot { status, notices, .. } = slot;
        let passed = cycle.index.saturating_sub(self.feedback.cycle);
        self.feedback.cycle = cycle.index;
        if !notices.fresh {
            self.feedback.grow_older(passed);
            return self.take_emergency(cycle, now, slot);
        }
        if self.rising > 0 {
            self.fall(status);
        }
        if notices.restarted || notices.has_more() || !self.feedback.status.shows(status) {
            return self.take_news(cycle, now, slot);
        }
        self.keep_status(slot);
    }

    /// A fresh status becomes the feedback.
    #[inline(always)] // As `sent`.
    fn keep_status(&mut self, slot: &mut Slot) {
        let Slot { status, notices, .. } = slot;
        self.feedback.status.take(status);
        self.feedback.age = u32::from(status.suspect);
        if notices.monitor_fresh {
            notices.monitor_fresh = false;
            self.take_monitored(status);
        }
    }

    /// A report of a drive whose enable has not ended as done.
    #[cold]
    fn fall(&mut self, status: &DriveStatus) {
        if self.duty.active().is_none() && !status.state.is_powered() && !status.suspect {
            self.rising -= 1;
        }
    }

    #[inline(never)]
    fn take_monitored(&mut self, status: &DriveStatus) {
        let monitor = status.monitor;
        self.feedback.status.monitor = monitor;
        self.shown = Shown::mask(&monitor);
        self.shows = self.shown != 0;
        for (extent, value) in self.monitor.iter_mut().zip(monitor) {
            if let Some(value) = value.filter(|value| !value.is_nan()) {
                Extent::see(extent, value);
            }
        }
    }

    /// The same where something is to be reported: what is new, or differs from what was shown before.
    #[cold]
    fn take_news(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let before = self.feedback.status;
        self.keep_status(slot);
        if let Some((channel, status)) = slot.notices.take_refused() {
            self.emit(cycle, now, EventKind::MonitorRefused { channel, status });
        }
        if slot.notices.restarted {
            self.emit(cycle, now, EventKind::Restarted);
        }
        self.take_emergency(cycle, now, slot);
        let reported = self.feedback.status;
        if before.sto_open != reported.sto_open {
            self.emit(cycle, now, EventKind::StoClosed(!reported.sto_open));
        }
        if before.state != reported.state {
            self.emit(cycle, now, EventKind::State(reported.state));
        }
        if before.fault != reported.fault {
            self.emit(cycle, now, EventKind::Fault(reported.fault));
        }
        if before.warning != reported.warning {
            self.emit(cycle, now, EventKind::Warning(reported.warning));
        }
    }

    /// Takes the emergency that the drive reported; it may come without an exchange.
    #[inline]
    fn take_emergency(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if slot.notices.has_more()
            && let Some(emergency) = slot.notices.take_emergency()
        {
            self.emit(cycle, now, EventKind::Emergency(emergency));
        }
    }

    /// The link has changed: events, loss, and a drive found running.
    #[cold]
    fn change_link(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let (before, link) = (self.feedback.link, self.health.link());
        self.feedback.link = link;
        slot.link = link;
        self.emit(cycle, now, EventKind::Link(link));
        self.losses += u64::from(link == Link::Lost && before == Link::Online && !slot.expected_silence);
        match link {
            Link::Lost if before == Link::Online => {
                let rests =
                    self.duty.claim() != Claim::Armed && !self.duty.command().is_some_and(Command::acts);
                self.stop(cycle, now, StopCause::LinkLost);
                if rests && slot.expected_silence {
                    // Its stop group goes on: this silence was requested, and the drive holds or moves nothing, nor is
                    // it to.
                    self.along = Along::Nobody;
                }
            }
            Link::Online => {
                let running = self.feedback.status.state.is_powered() || self.feedback.status.moving;
                if running && self.duty.claim() != Claim::Armed && !slot.notices.other_master {
                    self.find_running(cycle, now, Braked::BySetpoints);
                }
            }
            _ => {}
        }
    }

    /// A fresh report: takes it back out of the slot if it does not count. Returns by how much the axis has jumped.
    /// What is as before does not take the way of the others.
    pub(super) fn weigh(&mut self, slot: &mut Slot) -> Option<f64> {
        let (status, before) = (&slot.status, &self.feedback.status);
        let sent_at = match slot.exchange {
            Exchange::Answered { sent_at, suspect: false, .. } => sent_at,
            Exchange::Answered { sent_at, .. } => slot.earlier_answered().unwrap_or(sent_at),
            // It has a stamp of its own, or is that of an earlier cycle.
            _ => slot.earlier_answered().unwrap_or(status.at),
        };
        let sample = Sample::of(sent_at, !self.duty.is_under_torque(), slot);
        let same = (status.state, status.sto_open, status.homed, status.suspect)
            == (before.state, before.sto_open, before.homed, false);
        if same && !self.watch.doubts() && self.watch.takes(sample) {
            return None;
        }
        let weight = self.weight(sample, slot);
        if weight == Weight::Held {
            // Nothing of it is seen by the machine, nor by the application.
            slot.status = self.feedback.status;
            self.watch.last().write_places(&mut slot.evidence);
            (slot.notices.fresh, slot.notices.monitor_fresh) = (false, false);
        }
        let masked = self.is_masked();
        slot.status.homed &= !masked;
        slot.anew = weight == Weight::Held || masked;
        if let Weight::Jumped(by) = weight { Some(by) } else { None }
    }

    fn weight(&mut self, mut sample: Sample, slot: &mut Slot) -> Weight {
        let before = self.feedback.status;
        let Slot { status, evidence, notices, counters, desired, .. } = slot;
        if notices.restarted {
            // Its bus has proved it.
            (self.watch.losses, self.watch.unreferenced) = (0, false);
            self.watch.take(sample, Weight::Counts);
            return Weight::Counts;
        }
        let rehomed = status.homed != before.homed && !self.is_masked();
        let falls = is_up(desired.power.value)
            && !self.duty.follows().is_free
            && rank(status.state) < rank(before.state);
        let says = (falls || status.sto_open && !before.sto_open, rehomed);
        let watch = &mut self.watch;
        if says != Losses::default() && before.state != State::Unknown && watch.proof > 1 {
            if !status.suspect {
                let (power, reference) = says;
                if power && !watch.said.0 || !power && reference && !watch.said.1 {
                    // The ones before, if there are any, have not said that.
                    counters.implausible += u64::from(std::mem::take(&mut watch.losses));
                }
                (watch.losses, watch.said) = (watch.losses.saturating_add(1), says);
            }
            if status.suspect || watch.losses < watch.proof {
                return Weight::Held;
            }
        } else if !status.suspect {
            counters.implausible += u64::from(std::mem::take(&mut watch.losses));
        }
        // The drive itself says that it has no reference any more: it will say when it has one again.
        watch.unreferenced &= status.homed;
        sample.homed &= !self.is_masked();
        let bound = if rehomed { Bound::None } else { self.bound(status, evidence) };
        let weight = self.watch.weigh(&mut sample, bound);
        (status.velocity, evidence.demand_velocity) = (sample.velocity, sample.demand_velocity);
        if status.suspect {
            // It may be an older one: it is shown, if the axis can have been there, and is no measure for the next one.
            return if weight == Weight::Counts { weight } else { Weight::Held };
        }
        // Its reference is void: the way there was no motion.
        sample.homed &= !matches!(weight, Weight::Jumped(_));
        self.watch.take(sample, weight);
        match weight {
            Weight::Held => counters.implausible += 1,
            Weight::Counts => self.watch.losses = 0,
            Weight::Jumped(_) => (self.watch.losses, self.watch.unreferenced) = (0, status.homed),
        }
        weight
    }

    /// How far from its last place the axis may be.
    fn bound(&self, status: &DriveStatus, evidence: &Evidence) -> Bound {
        let before = &self.feedback.status;
        let starts = |state: State| matches!(state, State::Unknown | State::NotReadyToSwitchOn);
        if self.feedback.link != Link::Online
            || starts(before.state)
            || starts(status.state)
            || matches!(self.duty.command(), Some(Command::Home | Command::Native(_)))
            || (evidence.homing, evidence.mode == ModeIs::Homing) != (Homing::Open, false)
            || status.at < self.watch.settles_until
        {
            return Bound::None;
        }
        // Without power it may be moved by anything; and what another master commands keeps to no limit of this one.
        let led = self.duty.claim() == Claim::Armed && before.state.is_powered() && status.state.is_powered();
        if led { Bound::Plan } else { Bound::Fastest }
    }

    /// A command has ended. Of what that may have changed the reports are believed.
    pub(super) fn settle(&mut self, now: Time, command: &Command, outcome: Outcome) {
        if matches!(command, Command::Home | Command::Native(_)) {
            self.watch.settles_until = now + SETTLES_NS;
            self.watch.unreferenced &= !(*command == Command::Home && outcome == Outcome::Done);
        }
    }

    /// True if the drive's report of its reference does not count.
    fn is_masked(&self) -> bool {
        self.watch.unreferenced && self.duty.command() != Some(&Command::Home)
    }

    /// The axis is where two reports agree, and cannot have moved there: its encoder or its drive has lost its place.
    /// No setpoint of this master leads it from there, nor holds it there, so its drive stops it, if it has power and
    /// was not only read.
    #[cold]
    pub(super) fn jump(&mut self, cycle: &Cycle, now: Time, by: f64) {
        self.watch.forget();
        self.emit(cycle, now, EventKind::PositionJump(by));
        let ours = self.duty.claim() != Claim::Found && self.feedback.status.state.is_powered();
        let Some((_, sequence)) = self.duty.sequence() else {
            if ours || self.is_armed() {
                self.stop_by(Braked::ByTheDrive, cycle, now, StopCause::PositionJump);
            }
            return;
        };
        if sequence.is_ramp() {
            sequence.quicken();
            self.issue(Some(Command::QuickStop));
        } else if ours && sequence.is_down() {
            self.stop_again(cycle, now, StopCause::PositionJump);
        }
    }
}

/// The drive is to have power.
fn is_up(power: Power) -> bool {
    matches!(power, Power::Untouched | Power::EnableOperation | Power::QuickStop)
}

/// How much of its power a drive has: less is a loss.
fn rank(state: State) -> u8 {
    match state {
        State::OperationEnabled | State::QuickStopActive => 3,
        State::SwitchedOn | State::FaultReactionActive => 2,
        State::NotReadyToSwitchOn | State::SwitchOnDisabled | State::ReadyToSwitchOn => 1,
        State::Fault | State::Unknown => 0,
    }
}
