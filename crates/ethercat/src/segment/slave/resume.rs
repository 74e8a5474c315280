//! A slave that was set up here, and whose frames were lost for a while, or that fell to SAFEOP: it is resumed if its
//! settings read back as they were set up here. A tool or another master that has run over the segment meanwhile leaves
//! others, and may have put the slave into any state; what is resumed unseen would then never come into operation, or
//! exchange the process data of somebody else.

use super::setup::{WATCHDOGS, are_set};
use super::step::Resumes;
use super::{Context, Happened, Mapped, Note, Runs, Slave, Step, Tie};
use crate::segment::running::{SYNC, Sync0};
use crate::wire::registers::{AlState, AlStatus, Fmmu, SyncManager, address};
use fieldbeat_core::time::Time;

/// FMMUs that are read back: there are 16 at most (ETG.1000.4, 0600h ... 06FFh).
const FMMUS_MOST: u8 = 16;

/// The parts that are read back, one in a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd)]
pub(super) enum Part {
    Managers,
    Fmmus,
    Watchdog,
    Sync,
}

const PARTS: [Part; 4] = [Part::Managers, Part::Fmmus, Part::Watchdog, Part::Sync];

impl Slave {
    /// It was set up here, and its frames were lost for a while only: it continues once that was read back. False: it
    /// has to be brought up.
    pub(super) fn goes_on(&mut self, now: Time) -> bool {
        let Some(al) = self.way.al.filter(|al| self.tie == Tie::Ours && *al >= AlState::SafeOp) else {
            return false;
        };
        self.runs = Runs::Harmless;
        (self.way.addressed, self.way.mailbox_open) = (true, self.plan.mailbox.is_some());
        let resumes = match al {
            AlState::Op => Resumes::Op,
            _ if self.plan.sync => Resumes::Clock,
            _ => Resumes::SafeOp(self.acknowledge),
        };
        self.check(now, resumes);
        true
    }

    /// Another master has been there, by its state or station address. A slave that falls by itself shows an error
    /// (ETG.1000.6). One whose processor restarts is in INIT without an error, and the state requested of it, which
    /// only a master writes, is still the one that was requested here. One that was switched off has no address.
    /// Another address is that of another slave, where the segment has not as many slaves as when it was set up: one
    /// that nobody configures has whatever address an earlier master left.
    pub(super) fn is_intruded(
        &self,
        (status, requested): (AlStatus, AlStatus),
        station: u16,
        counted: u16,
    ) -> bool {
        let is_below = |status: AlStatus| status.state().is_some_and(|al| al < AlState::SafeOp);
        let is_lowered =
            station == self.station() && !status.error() && is_below(status) && is_below(requested);
        let is_same_line = counted == self.counted_as_ours;
        self.tie == Tie::Ours
            && (is_lowered || is_same_line && !matches!(station, 0) && station != self.station())
    }

    /// Reads back first what was set up here.
    pub(super) fn check(&mut self, now: Time, resumes: Resumes) {
        self.check_after(now, resumes, None);
    }

    /// The first part behind this one that it has; without any it is resumed.
    fn check_after(&mut self, now: Time, resumes: Resumes, done: Option<Part>) {
        let mut left = PARTS.into_iter().filter(|part| Some(*part) > done);
        match left.find(|part| self.registers_of(*part, resumes).1 > 0) {
            Some(part) => self.enter(now, Step::Check { resumes, part }),
            None => self.resume(now, resumes),
        }
    }

    /// Where a part begins, and its bytes; 0: it has none, or it does not matter.
    pub(super) fn registers_of(&self, part: Part, resumes: Resumes) -> (u16, usize) {
        let is_cyclic = self.plan.sync && resumes == Resumes::Op;
        match part {
            Part::Managers => {
                let end = self.all_managers().map(|(number, _)| usize::from(number) + 1).max();
                (address::SYNC_MANAGER, end.unwrap_or(0) * SyncManager::SIZE)
            }
            Part::Fmmus => (address::FMMU, usize::from(self.fmmus.min(FMMUS_MOST)) * Fmmu::SIZE),
            Part::Watchdog => (address::WATCHDOG_DIVIDER, if self.sets_watchdog() { WATCHDOGS } else { 0 }),
            Part::Sync => (address::DC_CONTROL, if is_cyclic { SYNC } else { 0 }),
        }
    }

    /// A part of its settings was read back.
    pub(super) fn was_checked(
        &mut self,
        context: &Context<'_>,
        resumes: Resumes,
        part: Part,
        data: &[u8],
    ) -> Happened {
        let now = context.cycle.grid;
        let is_as_set = match part {
            // The other bits of `activate` request a mailbox again.
            Part::Managers => are_set(data, self.all_managers(), |found, wanted| {
                SyncManager { activate: found.activate & 1, ..found } == wanted
            }),
            Part::Fmmus => self.has_fmmus(data),
            Part::Watchdog => self.has_watchdog(data),
            Part::Sync => Sync0::new(data).is_some_and(|sync| sync.has_period(context.clock.period_ns)),
        };
        if is_as_set {
            self.check_after(now, resumes, Some(part));
            return Happened::Nothing;
        }
        self.doubt();
        self.refused = Note::Intruded;
        self.set_up(now, self.acknowledge);
        Happened::Intruded
    }

    /// The FMMUs are those of the plan, and all others are off.
    fn has_fmmus(&self, data: &[u8]) -> bool {
        let (wanted, length) = self.fmmus();
        let is_off = |fmmu: &[u8; Fmmu::SIZE]| !Fmmu::new(*fmmu).active;
        data.split_at_checked(length).is_some_and(|(own, others)| {
            own == &wanted[..length] && others.as_chunks::<{ Fmmu::SIZE }>().0.iter().all(is_off)
        })
    }

    fn resume(&mut self, now: Time, resumes: Resumes) {
        self.way.mapped = Mapped::All;
        match resumes {
            Resumes::Op => {
                self.clock_set = self.plan.sync;
                self.runs_on(now);
            }
            Resumes::Clock => self.enter(now, Step::Time),
            // By way of SAFEOP, where the grid has to be locked first.
            Resumes::SafeOp(acknowledge) => {
                self.enter(now, Step::acknowledged(AlState::SafeOp, acknowledge));
            }
        }
    }
}
