//! SyncManagers, FMMUs and watchdog of a slave, as the configuration has them.

use super::{MANAGERS_SET, Slave, Step};
use crate::image::AL_SIZE;
use crate::plan::{Area, MOST_AREAS, SlavePlan, Start, Watchdog};
use crate::segment::note::Note;
use crate::sii::Head;
use crate::slot::Answers;
use crate::wire::registers::{AlCode, AlState, Fmmu, SyncManager, address};
use crate::wire::sii::Use;

/// Of a watchdog, 100 us.
pub(super) const WATCHDOG_DIVIDER: u16 = 0x09C2;
const WATCHDOG_TICK_NS: u64 = 100_000;
/// The time at power-on, 100 ms (ETG.1000.4, 6.2).
const WATCHDOG_DELIVERED: u16 = 1_000;
/// From the divider of the watchdogs to that of the SyncManagers, bytes.
pub(super) const WATCHDOGS: usize = (address::WATCHDOG - address::WATCHDOG_DIVIDER) as usize + 2;
/// FMMUs of one slave: outputs, inputs, AL status.
pub(super) const FMMUS: usize = 2 * MOST_AREAS + 1;

impl Slave {
    /// The number of FMMUs that it needs for its process data.
    pub(super) fn wanted_fmmus(&self) -> usize {
        self.output_fmmus() + Area::joined(&self.plan.inputs).count()
    }

    /// The first step of setting up its process data.
    pub(super) fn process_data(&self) -> Step {
        let SlavePlan { outputs, inputs, .. } = &self.plan;
        match () {
            () if !outputs.is_empty() => Step::Watchdog,
            () if !inputs.is_empty() => Step::SyncManagers(0),
            // A coupler's head exchanges only its state.
            () if self.fmmus().1 > 0 => Step::Fmmus,
            () => Step::to(AlState::SafeOp),
        }
    }

    /// The number of those of its outputs, which come first.
    pub(super) fn output_fmmus(&self) -> usize {
        Area::joined(&self.plan.outputs).count()
    }

    /// The FMMUs one after the other, and their length in bytes.
    pub(super) fn fmmus(&self) -> ([u8; FMMUS * Fmmu::SIZE], usize) {
        let logical = self.offsets.logical;
        let (mut bytes, mut length) = ([0; FMMUS * Fmmu::SIZE], 0);
        let mut push = |fmmu: Fmmu| {
            if let Some(place) = bytes.get_mut(length..length + Fmmu::SIZE) {
                place.copy_from_slice(&fmmu.to_bytes());
                length += Fmmu::SIZE;
            }
        };
        let areas = [(logical.outputs, &self.plan.outputs, true), (logical.inputs, &self.plan.inputs, false)];
        for (mut at, areas, output) in areas {
            for Area { start, length } in Area::joined(areas) {
                push(Fmmu::bytes(at, length, start, output));
                at += u32::from(length);
            }
        }
        if self.has_al {
            push(Fmmu::bytes(logical.al, AL_SIZE as u16, address::AL_STATUS, false));
        }
        (bytes, length)
    }

    /// The SyncManager of its SII for this use and this start, and its number; `None`: it has none, or does not count.
    fn said(&self, usage: Use, start: u16) -> Option<(u16, SyncManager)> {
        let mut said = self.delivered.of(usage).filter(|_| self.plan.check_sii);
        said.find(|(_, manager)| manager.start == start)
    }

    /// Why it refuses a state: where it depends on the control byte of its outputs, and the configuration has another
    /// one than its SII, that is the likely cause.
    pub(super) fn refusal(&self, to: AlState, code: AlCode) -> Note {
        let differs = |area: &Area| {
            let (_, set) = self.manager(Use::Outputs, *area, 0);
            let own =
                self.said(Use::Outputs, area.start).map_or(SyncManager::OUTPUTS, |(_, own)| own.control);
            (set.control != own).then_some((set.control, own))
        };
        match self.plan.outputs.iter().find_map(differs) {
            Some((set, own)) if code.is_of_managers() => Note::Control { to, code, set, own },
            _ => Note::State { to, code },
        }
    }

    /// The SyncManager of an area of its outputs or inputs, and its number: `usual`, or as its SII has it.
    fn manager(&self, usage: Use, area: Area, usual: usize) -> (u16, SyncManager) {
        let control = if usage == Use::Outputs { SyncManager::OUTPUTS } else { SyncManager::INPUTS };
        let said = self.said(usage, area.start);
        let (number, control) =
            said.map_or((usual as u16, control), |(number, manager)| (number, manager.control));
        let control = match self.plan.watchdog {
            Watchdog::After(_) if usage == Use::Outputs => control | SyncManager::WATCHDOG,
            Watchdog::Off if usage == Use::Outputs => control & !SyncManager::WATCHDOG,
            _ => control,
        };
        (number, SyncManager { start: area.start, length: area.length, control, activate: 1 })
    }

    /// Those of outputs and inputs, if there are any. Behind a mailbox inputs are never in the place of outputs.
    pub(super) fn managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        let SlavePlan { outputs, inputs, mailbox, .. } = &self.plan;
        let (first, behind) = match mailbox {
            Some(_) => (2, 2 + outputs.len().max(1)),
            None => (0, outputs.len()),
        };
        let of_outputs = (first..).zip(outputs).map(|(usual, area)| self.manager(Use::Outputs, *area, usual));
        let of_inputs = (behind..).zip(inputs).map(|(usual, area)| self.manager(Use::Inputs, *area, usual));
        of_outputs.chain(of_inputs)
    }

    /// Those of a slot.
    pub(super) fn managers_from(&self, from: u8) -> impl Iterator<Item = (u16, SyncManager)> {
        self.managers().skip(from.into()).take(MANAGERS_SET.into())
    }

    /// They were read: the step behind that; or the first that is not as it was written.
    pub(super) fn managers_read(&self, from: u8, answers: &Answers<'_>) -> Result<Step, Note> {
        let mut all = answers.iter().flatten().zip(self.managers_from(from));
        let other = all.find(|(answer, (_, wanted))| {
            let bytes = answer.data.first_chunk::<{ SyncManager::SIZE }>();
            bytes.is_none_or(|bytes| SyncManager::new(*bytes) != *wanted)
        });
        if let Some((_, (number, _))) = other {
            return Err(Note::Manager(number));
        }
        let next = from.saturating_add(MANAGERS_SET);
        let is_last = usize::from(next) >= self.managers().count();
        Ok(if is_last { Step::Fmmus } else { Step::SyncManagers(next) })
    }

    /// Those of its mailboxes, and of its process data.
    pub(super) fn all_managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        self.mailbox_managers().chain(self.managers())
    }

    /// Those of its mailboxes.
    pub(super) fn mailbox_managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        let uses = [(Use::MailboxOut, SyncManager::MAILBOX_OUT), (Use::MailboxIn, SyncManager::MAILBOX_IN)];
        let areas = self.plan.mailbox.into_iter().flatten().zip(uses);
        (0..).zip(areas).map(|(number, (area, (usage, usual)))| {
            let control = self.said(usage, area.start).map_or(usual, |(_, manager)| manager.control);
            (number, SyncManager { start: area.start, length: area.length, control, activate: 1 })
        })
    }

    /// It has a watchdog: the configured one, or that of its SII with the time of power-on. Without one that time is
    /// written, too, since another master may have left any, and some slaves check it even so (the Slave Stack Code
    /// refuses SAFEOP with 001Fh by it); but then nothing depends on its being accepted.
    pub(super) fn sets_watchdog(&self) -> bool {
        !self.plan.outputs.is_empty() && (self.plan.watchdog != Watchdog::AsDelivered || self.is_armed())
    }

    /// The control byte of its outputs arms a watchdog.
    fn is_armed(&self) -> bool {
        let mut managers = self.managers();
        managers.any(|(_, manager)| manager.is_output() && manager.control & SyncManager::WATCHDOG != 0)
    }

    /// Why its outputs have no watchdog although the configuration leaves that to its SII; `None`: they have one, or
    /// the configuration says that they have none.
    pub(super) fn unarmed(&self) -> Note {
        let SlavePlan { outputs, watchdog, check_sii, .. } = &self.plan;
        match () {
            () if outputs.is_empty() || *watchdog != Watchdog::AsDelivered || !check_sii => Note::None,
            () if self.delivered.is_empty() => Note::NoManagers,
            () if !self.is_armed() => Note::Unarmed,
            () => Note::None,
        }
    }

    /// The watchdog in ticks; 0: off.
    pub(super) fn watchdog(&self) -> u16 {
        match self.plan.watchdog {
            Watchdog::AsDelivered => WATCHDOG_DELIVERED,
            Watchdog::After(ns) => u16::try_from(ns / WATCHDOG_TICK_NS).unwrap_or(u16::MAX),
            Watchdog::Off => 0,
        }
    }

    /// The registers from the divider of the watchdogs on are as that is.
    pub(super) fn has_watchdog(&self, data: &[u8]) -> bool {
        let word = |at: usize| data.get(at..).and_then(<[u8]>::first_chunk::<2>).copied();
        let wanted = [WATCHDOG_DIVIDER, self.watchdog()].map(|word| Some(word.to_le_bytes()));
        [word(0), word(WATCHDOGS - 2)] == wanted
    }

    /// A difference between the SII and the configuration.
    pub(super) fn contradicts(&self, head: &Head) -> Option<Note> {
        if self.plan.mailbox.is_some() && !head.protocols.coe() {
            return Some(Note::NoCoe);
        }
        let mailboxes = self.plan.mailbox.into_iter().flatten().zip(head.mailboxes);
        let mut others = (1..).zip(mailboxes).filter(|(_, (own, named))| named.start != 0 && own != named);
        if let Some((usage, (own, named))) = others.next() {
            return Some(differing(usage, own, named));
        }
        let kinds = [(3, Use::Outputs, &self.plan.outputs), (4, Use::Inputs, &self.plan.inputs)];
        kinds.into_iter().find_map(|(usage, kind, areas)| self.differs_in(usage, kind, areas))
    }

    /// The same of its areas of one direction: each has a SyncManager, and each SyncManager an area.
    fn differs_in(&self, usage: u8, kind: Use, areas: &[Area]) -> Option<Note> {
        let delivered = || {
            self.delivered.of(kind).map(|(_, manager)| Area { start: manager.start, length: manager.length })
        };
        // The process data of a drive are selected, and a start-up may do that, too. Without a length there is none in
        // the SII.
        let is_free = !self.is_device() || self.plan.start_up.iter().any(Start::selects);
        let is_named = |area: &Area| areas.iter().any(|own| own.start == area.start);
        let unlisted = delivered().find(|area| area.length > 0 && !is_named(area));
        for area in areas {
            match delivered().find(|named| named.start == area.start) {
                Some(named) if is_free || matches!(named.length, 0) || named.length == area.length => {}
                Some(named) => return Some(differing(usage, *area, named)),
                None if self.delivered.is_empty() => {}
                None => {
                    let other = unlisted.or_else(|| delivered().find(|area| !is_named(area)));
                    return Some(differing(usage, *area, other.unwrap_or_default()));
                }
            }
        }
        unlisted.filter(|_| !is_free).map(|area| differing(usage, Area::default(), area))
    }
}

/// The SyncManagers that were read, from the first one on, are as `wanted`, by this comparison of one with its wanted
/// one.
pub(super) fn are_set(
    data: &[u8],
    mut wanted: impl Iterator<Item = (u16, SyncManager)>,
    is_so: impl Fn(SyncManager, SyncManager) -> bool,
) -> bool {
    let (read, _) = data.as_chunks::<{ SyncManager::SIZE }>();
    let found = |number: u16| read.get(usize::from(number)).map(|bytes| SyncManager::new(*bytes));
    wanted.all(|(number, wanted)| found(number).is_some_and(|found| is_so(found, wanted)))
}

/// The difference of the configuration and the SII there; at 0 the one has none, or the other.
fn differing(usage: u8, own: Area, named: Area) -> Note {
    if own.start == named.start {
        Note::Length { usage, start: own.start, own: own.length, named: named.length }
    } else {
        Note::Start { usage, own: own.start, named: named.start, length: named.length }
    }
}
