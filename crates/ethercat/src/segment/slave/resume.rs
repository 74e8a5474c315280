//! A slave that was set up here, and whose frames were lost for a while, or that fell to SAFEOP: it is resumed if its
//! settings read back as they were set up here. A tool or another master that has run over the segment meanwhile leaves
//! others, and may have put the slave into any state; what is resumed unseen would then never come into operation, or
//! exchange the process data of somebody else.

use super::found::WATCHDOGS;
use super::setup::WATCHDOG_DIVIDER;
use super::step::Resumes;
use super::{Context, Happened, Mapped, Note, Slave, Step};
use crate::slot::Ask;
use crate::wire::registers::{AlState, AlStatus, Fmmu, SyncManager, address};
use fieldbeat_core::time::Time;

/// From the cyclic unit to the cycle of SYNC0.
const SYNC: usize = (address::DC_CYCLE - address::DC_CONTROL) as usize + 4;
/// FMMUs that are read back: there are 16 at most (ETG.1000.4, 0600h ... 06FFh).
const FMMUS_MOST: u8 = 16;
/// Cyclic operation and SYNC0 are on.
const SYNC0: u8 = 3;

/// What is read back, one part in a slot.
#[derive(Clone, Copy, Debug)]
enum Part {
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
        let Some(al) = self.way.al.filter(|al| self.ours && *al >= AlState::SafeOp) else { return false };
        (self.looked_at, self.other_time) = (true, false);
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
        self.ours && (is_lowered || is_same_line && !matches!(station, 0) && station != self.station())
    }

    /// What was set up here is read back first.
    pub(super) fn check(&mut self, now: Time, resumes: Resumes) {
        self.check_from(now, resumes, 0);
    }

    /// The first part from this one on that it has; without any it is resumed.
    fn check_from(&mut self, now: Time, resumes: Resumes, from: usize) {
        let parts = (from..).zip(PARTS.get(from..).unwrap_or_default());
        match parts.into_iter().find(|(_, part)| self.bytes_of(**part, resumes) > 0) {
            Some((part, _)) => self.enter(now, Step::Check { resumes, part }),
            None => self.resume(now, resumes),
        }
    }

    /// Bytes of a part; 0: it has none, or it does not matter.
    fn bytes_of(&self, part: Part, resumes: Resumes) -> usize {
        let is_cyclic = self.plan.sync && resumes == Resumes::Op;
        match part {
            Part::Managers => {
                let end = self.all_managers().map(|(number, _)| usize::from(number) + 1).max();
                end.unwrap_or(0) * SyncManager::SIZE
            }
            Part::Fmmus => usize::from(self.fmmus.min(FMMUS_MOST)) * Fmmu::SIZE,
            Part::Watchdog if self.sets_watchdog() => WATCHDOGS,
            Part::Sync if is_cyclic => SYNC,
            Part::Watchdog | Part::Sync => 0,
        }
    }

    pub(super) fn request_check(&self, resumes: Resumes, part: usize, ask: &mut Ask) {
        let Some(part) = PARTS.get(part) else { return };
        let register = match part {
            Part::Managers => address::SYNC_MANAGER,
            Part::Fmmus => address::FMMU,
            Part::Watchdog => address::WATCHDOG_DIVIDER,
            Part::Sync => address::DC_CONTROL,
        };
        ask.read(self.reads(register), self.bytes_of(*part, resumes));
    }

    /// A part of its settings was read back.
    pub(super) fn was_checked(
        &mut self,
        context: &Context<'_>,
        resumes: Resumes,
        part: usize,
        data: &[u8],
    ) -> Happened {
        let now = context.cycle.grid;
        let is_as_set = match PARTS.get(part) {
            Some(Part::Managers) => self.has_managers(data),
            Some(Part::Fmmus) => self.has_fmmus(data),
            Some(Part::Watchdog) => {
                let word = |at: usize| data.get(at..).and_then(<[u8]>::first_chunk::<2>).copied();
                let wanted = [WATCHDOG_DIVIDER, self.watchdog()].map(|word| Some(word.to_le_bytes()));
                [word(0), word(WATCHDOGS - 2)] == wanted
            }
            Some(Part::Sync) => has_sync(data, context.clock.period_ns),
            None => true,
        };
        if is_as_set {
            self.check_from(now, resumes, part + 1);
            return Happened::Nothing;
        }
        (self.ours, self.refused) = (false, Note::Intruded);
        self.set_up(now, self.acknowledge);
        Happened::Intruded
    }

    fn all_managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        self.mailbox_managers().chain(self.managers())
    }

    fn has_managers(&self, data: &[u8]) -> bool {
        self.all_managers().all(|(number, wanted)| {
            let at = usize::from(number) * SyncManager::SIZE;
            let bytes = data.get(at..).and_then(<[u8]>::first_chunk::<{ SyncManager::SIZE }>);
            bytes.is_some_and(|bytes| {
                let found = SyncManager::new(*bytes);
                // The other bits request a mailbox again.
                SyncManager { activate: found.activate & 1, ..found } == wanted
            })
        })
    }

    /// Its FMMUs are those of the plan, and all others are off.
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
                (self.way.was_operational, self.note) = (true, Note::None);
                (self.refused, self.refusals) = (Note::None, 0);
                self.enter(now, Step::Up);
            }
            Resumes::Clock => self.enter(now, Step::Time),
            // By way of SAFEOP, where the grid has to be locked first.
            Resumes::SafeOp(acknowledge) => {
                self.enter(now, Step::acknowledged(AlState::SafeOp, acknowledge));
            }
        }
    }
}

/// SYNC0 is on with this period.
fn has_sync(data: &[u8], period_ns: u64) -> bool {
    let cycle = data.get(SYNC - 4..).and_then(<[u8]>::first_chunk::<4>);
    let active = data.get(1).is_some_and(|active| active & SYNC0 == SYNC0);
    active && cycle.is_some_and(|cycle| u64::from(u32::from_le_bytes(*cycle)) == period_ns)
}
