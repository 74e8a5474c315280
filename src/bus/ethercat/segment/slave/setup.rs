//! SyncManagers, FMMUs and watchdog of a slave, as the configuration has them.

use super::Slave;
use crate::bus::ethercat::image::AL_SIZE;
use crate::bus::ethercat::plan::Area;
use crate::bus::ethercat::segment::note::Note;
use crate::bus::ethercat::sii::Head;
use crate::bus::ethercat::wire::registers::{Fmmu, SyncManager, address};
use crate::bus::ethercat::wire::sii::Use;

/// Of a watchdog, 100 us.
pub(super) const WATCHDOG_DIVIDER: u16 = 0x09C2;
const WATCHDOG_TICK_NS: u64 = 100_000;
/// FMMUs of one slave: outputs, inputs, AL status.
pub(super) const FMMUS: usize = 3;

impl Slave {
    /// The number of FMMUs that it needs for its process data.
    pub(super) fn wanted_fmmus(&self) -> usize {
        usize::from(self.plan.outputs.length > 0) + usize::from(self.plan.inputs.length > 0)
    }

    /// Its FMMUs one after the other, and their length in bytes.
    pub(super) fn fmmus(&self) -> ([u8; FMMUS * Fmmu::SIZE], usize) {
        let logical = self.offsets.logical;
        let area = |at, area: Area, output| {
            (area.length > 0).then(|| Fmmu::bytes(at, area.length, area.start, output))
        };
        let al = self.has_al.then(|| Fmmu::bytes(logical.al, AL_SIZE as u16, address::AL_STATUS, false));
        let all = [
            area(logical.outputs, self.plan.outputs, true),
            area(logical.inputs, self.plan.inputs, false),
            al,
        ];
        let (mut bytes, mut length) = ([0; FMMUS * Fmmu::SIZE], 0);
        for fmmu in all.into_iter().flatten() {
            bytes[length..length + Fmmu::SIZE].copy_from_slice(&fmmu.to_bytes());
            length += Fmmu::SIZE;
        }
        (bytes, length)
    }

    /// The SyncManager of its outputs or inputs, and its number.
    pub(super) fn manager(&self, usage: Use) -> Option<(u16, SyncManager)> {
        let (area, control, number) = match usage {
            Use::Outputs => (self.plan.outputs, SyncManager::OUTPUTS, 2),
            _ => (self.plan.inputs, SyncManager::INPUTS, 3),
        };
        if area.length == 0 {
            return None;
        }
        // Without a mailbox they come first.
        let number = match (self.plan.mailbox, usage) {
            (Some(_), _) => number,
            (None, Use::Outputs) => 0,
            (None, _) => u16::from(self.plan.outputs.length > 0),
        };
        let said = self.delivered.of(usage).filter(|_| self.plan.check_sii);
        let (number, control) = said.map_or((number, control), |(number, manager)| (number, manager.control));
        let watched = self.plan.watchdog_ns.is_some() && usage == Use::Outputs;
        let watchdog = if watched { SyncManager::WATCHDOG } else { 0 };
        let control = control & !SyncManager::WATCHDOG | watchdog;
        Some((number, SyncManager { start: area.start, length: area.length, control, activate: 1 }))
    }

    /// Those of outputs and inputs, if there are any.
    pub(super) fn managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        [Use::Outputs, Use::Inputs].into_iter().filter_map(|usage| self.manager(usage))
    }

    /// Those of its mailboxes.
    pub(super) fn mailbox_managers(&self) -> impl Iterator<Item = (u16, SyncManager)> {
        let controls = [SyncManager::MAILBOX_OUT, SyncManager::MAILBOX_IN];
        let areas = self.plan.mailbox.into_iter().flatten().zip(controls);
        (0..).zip(areas).map(|(number, (area, control))| {
            (number, SyncManager { start: area.start, length: area.length, control, activate: 1 })
        })
    }

    /// Its watchdog in ticks; 0: off.
    pub(super) fn watchdog(&self) -> u16 {
        let ticks = self.plan.watchdog_ns.map_or(0, |ns| ns / WATCHDOG_TICK_NS);
        u16::try_from(ticks).unwrap_or(u16::MAX)
    }

    /// A difference between the SII and the configuration.
    pub(super) fn contradicts(&self, head: &Head) -> Option<Note> {
        if self.plan.mailbox.is_some() && !head.protocols.coe() {
            return Some(Note::NoCoe);
        }
        let mailboxes = self.plan.mailbox.map_or([None; 2], |areas| areas.map(Some));
        for (usage, (own, named)) in (1..).zip(mailboxes.into_iter().zip(head.mailboxes)) {
            if let Some(own) = own
                && named.start != 0
                && own != named
            {
                return Some(Note::SyncManager { usage, start: named.start, length: named.length });
            }
        }
        let areas = [(3, Use::Outputs, self.plan.outputs), (4, Use::Inputs, self.plan.inputs)];
        areas.into_iter().find_map(|(usage, kind, area)| {
            let (_, SyncManager { start, length, .. }) = self.delivered.of(kind)?;
            (area.length > 0 && start != area.start).then_some(Note::SyncManager { usage, start, length })
        })
    }
}
