//! The exchange of a cycle: what was sent, how it ended, and what came with it.

use super::duty::Claim;
use super::watch::Braked;
use super::{Along, DriveController, Ending};
use crate::axis::{Command, DriveStatus, EventKind, Link, State, StopCause};
use crate::bus::contract::Ended;
use crate::bus::{Cycle, Exchange, Slot};
use crate::drive::bounds::Sample;
use crate::drive::numbers::Extent;
use crate::drive::record::{Reply, measured, short};
use crate::time::Time;

impl DriveController {
    /// The request that was due was sent in `cycle`, or attempted: in the send stage, or, if it was queued then, in the
    /// receive stage. While it is queued, or passed over because the one before it is owed, nothing has changed. Its
    /// exchange may have been closed since then.
    #[inline(always)] // Once for each axis and cycle; what is queued takes the way around it.
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

    /// The same of a request that was queued.
    #[cold]
    fn sent_meanwhile(&mut self, cycle: &Cycle, slot: &mut Slot) {
        self.sent(cycle, slot);
    }

    /// Its request left at this instant.
    #[inline(always)] // As `sent`.
    fn left(&mut self, cycle: &Cycle, sent_at: Time) {
        self.health.requested(cycle.index, true);
        self.row_waits = false;
        let phase_ns = sent_at.since(cycle.grid);
        self.measured.phase_ns = measured(phase_ns);
        if let Some(before) = self.phase_ns.replace(phase_ns) {
            let jitter_ns = phase_ns.abs_diff(before);
            self.measured.jitter_ns = measured(jitter_ns);
            self.peaks.send_jitter.see(jitter_ns, cycle.index);
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

    /// Evaluates this cycle's exchange, updates the feedback, and notices changes. Returns the result of the
    /// exchange.
    #[inline]
    pub(super) fn judge(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        if self.queued {
            self.sent_meanwhile(cycle, slot);
        }
        self.grid = cycle.grid;
        self.measured.was_online = self.feedback.link == Link::Online;
        let jumped = if slot.notices.fresh { self.weigh(slot) } else { None };
        let mut rtt = None;
        // What ended besides this exchange, and when the request was sent that is reported on, if that is an earlier
        // one.
        let (ended, reported) =
            if slot.has_earlier { self.judge_earlier(cycle, now, slot) } else { (None, None) };
        // The usual end of an exchange, in a cycle that has one.
        let reply = if let Exchange::Answered { sent_at, at, suspect: false } = slot.exchange {
            slot.exchange = Exchange::Idle;
            self.health.answered(cycle.index);
            let rtt_ns = at.since(sent_at);
            self.peaks.rtt.see(rtt_ns, cycle.index);
            self.measured.rtt_ns = measured(rtt_ns);
            rtt = Some(short(rtt_ns));
            if slot.notices.fresh && !slot.notices.restarted {
                self.take_sample(sent_at, slot);
            }
            Reply::Answered
        } else if let Exchange::OwnClock { fresh_until, .. } = slot.exchange
            && cycle.grid < fresh_until
        {
            slot.counters.answered += 1;
            slot.exchange = Exchange::Idle;
            self.health.answered(cycle.index);
            self.take_packet(slot);
            Reply::Current
        } else {
            let reply = self.judge_otherwise(cycle, now, slot, reported.is_some());
            self.health.watch_silence(cycle.index);
            reply
        };
        let reply = match &ended {
            None => reply,
            Some(ended) => self.with_earlier(reply, ended, &mut rtt),
        };
        self.measured.reply = reply;
        if slot.reachable {
            slot.reachable = false;
            self.health.reachable(cycle.index + 1);
        }
        if slot.notices.restarted {
            self.bounds.forget();
        }
        self.take_status(cycle, now, slot, rtt);
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
            let age_ns = now.since(self.feedback.status.at);
            self.measured.age_ns = measured(age_ns);
            self.peaks.age.see(age_ns, cycle.index);
        }
        reply
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
            self.peaks.rtt.see(rtt_ns, cycle.index);
            self.measured.rtt_ns = measured(rtt_ns);
        }
        // The reply to a newer request has replaced what they report.
        let reported = match slot.exchange {
            Exchange::Answered { suspect: false, .. } => None,
            _ => Some(sent_at).filter(|_| answered > 0 && slot.notices.fresh),
        };
        if reported.is_some() && !slot.notices.restarted {
            self.take_sample(sent_at, slot);
        }
        (Some(ended), reported)
    }

    /// How a cycle ended in which exchanges of earlier ones ended, too.
    #[cold]
    fn with_earlier(&mut self, reply: Reply, ended: &Ended, rtt: &mut Option<u32>) -> Reply {
        let Ended { missed, answered, rtt_ns, .. } = *ended;
        self.misses = missed + u32::from(reply == Reply::Missed);
        if answered > 0 {
            self.measured.rtt_ns = self.measured.rtt_ns.max(measured(rtt_ns));
            *rtt = rtt.or(Some(short(rtt_ns)));
        }
        match reply {
            _ if missed > 0 => Reply::Missed,
            Reply::None | Reply::Owed if answered > 0 => Reply::Answered,
            _ => reply,
        }
    }

    /// No exchange was answered for certain. The report was `taken` with an earlier one.
    #[inline(never)]
    fn judge_otherwise(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, taken: bool) -> Reply {
        match slot.exchange {
            Exchange::Idle | Exchange::Missed => {
                if !taken {
                    self.take_packet(slot);
                }
                Reply::None
            }
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

    /// A packet of a drive with its own clock, with an exchange or without: it has a stamp of its own.
    #[inline]
    fn take_packet(&mut self, slot: &Slot) {
        if slot.notices.fresh {
            self.take_sample(slot.status.at, slot);
        }
    }

    /// The report to a request that left at `sent_at` counts for the limits.
    #[inline]
    fn take_sample(&mut self, sent_at: Time, slot: &Slot) {
        let DriveStatus { at, homed, position, demand, velocity, .. } = slot.status;
        let led = !self.duty.is_under_torque();
        let position = if led { demand } else { position };
        let behind = slot.evidence.demand - slot.evidence.position;
        self.bounds.take(Sample { sent_at, at, homed, led, position, velocity, behind });
    }

    fn missed(&mut self, cycle: &Cycle, now: Time) {
        self.health.missed(cycle.index);
        if self.moves_in_group().is_some() {
            self.emit(cycle, now, EventKind::MissedInGroup);
        }
    }

    /// Takes the drive's status into the feedback, with an event for each change.
    #[inline]
    fn take_status(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, rtt: Option<u32>) {
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
        let noticed = notices.restarted | notices.monitor_refused.is_some() | notices.emergency.is_some();
        if noticed || shows(&self.feedback.status) != shows(status) {
            return self.take_news(cycle, now, slot, rtt);
        }
        self.keep_status(slot, rtt);
    }

    /// A fresh status becomes the feedback.
    #[inline]
    fn keep_status(&mut self, slot: &mut Slot, rtt: Option<u32>) {
        let Slot { status, notices, .. } = slot;
        self.feedback.status = *status;
        self.feedback.age = u32::from(status.suspect);
        self.feedback.rtt_ns = rtt.or(self.feedback.rtt_ns);
        if notices.monitor_fresh {
            notices.monitor_fresh = false;
            self.take_monitored();
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
    fn take_monitored(&mut self) {
        let monitor = self.feedback.status.monitor;
        self.shows = monitor.iter().any(Option::is_some);
        for (extent, value) in self.monitor.iter_mut().zip(monitor) {
            if let Some(value) = value.filter(|value| !value.is_nan()) {
                Extent::see(extent, value);
            }
        }
    }

    /// The same where something is to be reported: what is new, or differs from what was shown before.
    #[cold]
    fn take_news(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, rtt: Option<u32>) {
        let before = self.feedback.status;
        self.keep_status(slot, rtt);
        if let Some((channel, status)) = slot.notices.monitor_refused.take() {
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
    fn take_emergency(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if let Some(emergency) = slot.notices.emergency.take() {
            self.measured.emergency = Some(emergency.into());
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
}

/// What of a status is reported when it changes.
#[inline]
fn shows(status: &DriveStatus) -> (State, bool, u32, u32) {
    (status.state, status.sto_open, status.warning, status.fault)
}
