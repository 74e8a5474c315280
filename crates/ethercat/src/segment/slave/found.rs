//! A drive that is in OP already, as another master has left it, or this one before it was restarted. Its status word
//! comes first: one without power is set up from INIT, whatever its clock and process data are, and without a report to
//! its station.
//!
//! One with power is joined as it is if its SyncManagers, PDOs and the period of its SYNC0 are those of the
//! configuration: its inputs first, its outputs with the first order; its station knows its mode before its state,
//! since a setpoint may not count in that mode. Until then the master writes only its station address and the FMMUs of
//! its inputs and AL status, none of which another master writes by; objects are only read. Without the watchdog of the
//! configuration it takes no motion until it was set up again. That happens as soon as it is without power.
//!
//! A drive that cannot be joined is stopped by the drive itself as it leaves OP, or left alone, as
//! `on_found_running` says. Anything else that is found in OP is set up from INIT.
//!
//! The first one that has power, or is left alone, gives the segment its time. Neither its clock nor its SYNC0 is
//! adjusted: the others have theirs where the grid wants it, and it has so, too, once it was set up. While one runs on
//! another time, or one that cannot be used at all runs, the segment's time goes to no slave.

use super::setup::are_set;
use super::{Context, Happened, List, Mapped, Note, Runs, Slave, Step, Tie, Way};
use crate::segment::running::Running;
use crate::slot::Answers;
use crate::wire::registers::{AlState, AlStatus, Fmmu, SyncManager};
use fieldbeat_core::time::{MS, Time};

impl Slave {
    /// A drive in OP, as it was last seen: it may move.
    pub(super) fn may_be_found(&self) -> bool {
        self.way.al == Some(AlState::Op) && !self.is_device()
    }

    /// The SyncManagers and watchdog.
    pub(super) fn found(&mut self, now: Time, answers: &Answers<'_>) {
        let [Some(managers), Some(watchdogs)] = answers else { return };
        let arms = |found: SyncManager, wanted: SyncManager| found.control == wanted.control;
        self.watched = !self.sets_watchdog()
            || are_set(managers.data, self.managers(), arms) && self.has_watchdog(watchdogs.data);
        // Whether it arms a watchdog was checked separately.
        let is_set = |found: SyncManager, wanted: SyncManager| found.unwatched() == wanted.unwatched();
        if self.has_al && are_set(managers.data, self.all_managers(), is_set) {
            self.enter(now, Step::Free { joins: true });
        } else {
            self.not_joinable(now);
        }
    }

    /// It has its station address: whether it has power. Nothing else of it counts if it has none.
    pub(super) fn power(&mut self, now: Time) {
        self.way.mailbox_open = self.plan.mailbox.is_some();
        self.enter(now, Step::list(List::Power));
    }

    /// It has power, or does not say: it is joined if its clock and its FMMUs allow that.
    pub(super) fn has_power(&mut self, now: Time) {
        let is_known = self.runs != Runs::Unknown;
        self.enter(now, if is_known { Step::FoundFmmus } else { Step::FoundClock { refused: Note::None } });
    }

    /// It is refused, and runs on: for that its time has to be known, and that it may be the segment's.
    pub(super) fn leave_running(&mut self, now: Time, refused: Note) {
        if self.runs == Runs::Unknown {
            return self.enter(now, Step::FoundClock { refused });
        }
        let runs = self.may_be_found();
        self.refuse(now, refused);
        self.way.al = runs.then_some(AlState::Op);
    }

    /// The FMMUs: those of its inputs replace none that another master writes by.
    pub(super) fn found_fmmus(&mut self, now: Time, data: &[u8]) {
        let behind = data.as_chunks::<{ Fmmu::SIZE }>().0.iter().skip(self.output_fmmus());
        let written = behind.map(|bytes| Fmmu::new(*bytes));
        if written.into_iter().any(|fmmu| fmmu.active && fmmu.output) {
            self.not_joinable(now);
        } else {
            self.enter(now, Step::Join);
        }
    }

    /// The time that it runs on. With another one than the segment's it is joined as long as that goes to nobody.
    /// `refused`: why it is not joined at all.
    pub(super) fn found_clock(
        &mut self,
        context: &Context<'_>,
        refused: Note,
        answers: &Answers<'_>,
    ) -> Happened {
        let (now, sent_at, clock) = (context.cycle.grid, context.sent_at, &context.clock);
        let Some(running) = Running::receive(answers) else { return Happened::Nothing };
        let is_same = clock.is_time_of(context.cycle, sent_at, running.time);
        let is_apart = running.sync.is_cyclic() && context.has_time && !is_same;
        self.runs = if is_apart { Runs::Apart } else { Runs::Harmless };
        let is_dragged = is_apart && context.timed;
        let is_as_planned = match self.plan.sync {
            true => running.sync.has_period(clock.period_ns),
            false => !running.sync.is_cyclic(),
        };
        match refused {
            Note::None if is_as_planned && !is_dragged => self.enter(now, Step::FoundFmmus),
            Note::None => self.not_joinable(now),
            refused => self.leave_running(now, refused),
        }
        match running.sync.is_cyclic() && !context.has_time {
            true => Happened::GivesTime(running.time),
            false => Happened::Nothing,
        }
    }

    /// It is part of the exchange: its PDOs and mode have still to be read.
    pub(super) fn join(&mut self, now: Time) {
        (self.way.joined, self.tie, self.found_mode) = (true, self.tie.max(Tie::Known), None);
        (self.way.mapped, self.way.mailbox_open) = (Mapped::Inputs, self.plan.mailbox.is_some());
        self.clock_set = self.plan.sync && self.runs != Runs::Apart;
        self.way.al = Some(AlState::Op);
        self.enter(now, Step::list(List::Found));
    }

    /// All of it is as configured.
    pub(super) fn joined_whole(&mut self, now: Time) {
        self.remark = self.unarmed();
        self.runs_on(now);
    }

    /// It is in operation as it was found.
    pub(super) fn runs_on(&mut self, now: Time) {
        (self.way.was_operational, self.note) = (true, Note::None);
        (self.refused, self.refusals) = (Note::None, 0);
        self.enter(now, Step::Up);
    }

    /// It is not as configured.
    pub(super) fn not_joinable(&mut self, now: Time) {
        if self.refuses_running {
            self.leave_running(now, Note::FoundRunning);
        } else {
            self.way = Way::default();
            self.enter(now, Step::to(AlState::Init));
        }
    }

    /// A slave that was only joined is set up completely, from INIT: found in OP again, it would be joined again,
    /// or treated as ours although its outputs were never released.
    pub(super) fn set_up(&mut self, now: Time, acknowledge: Option<AlStatus>) {
        self.start_over(now, 0, Note::Starting);
        self.enter(now, Step::acknowledged(AlState::Init, acknowledge));
    }

    /// A joined drive is without power, or its outputs are wanted: what follows.
    pub(super) fn go_on_joined(&mut self, context: &Context<'_>) -> bool {
        let now = context.cycle.grid;
        match context.powered {
            // Time to set it up completely.
            Some((false, at)) if at > self.since + 10 * MS => {
                self.set_up(now, None);
                true
            }
            _ if self.way.mapped == Mapped::Inputs && context.wants_outputs => {
                self.enter(now, Step::Release);
                true
            }
            _ => false,
        }
    }
}
