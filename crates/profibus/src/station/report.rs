//! What a drive reports: its inputs in user units, its faults by name.

use super::Station;
use crate::notes::Note;
use crate::plan::{LenzeDrive, ShownWord};
use crate::wire::dp::{Diagnosis, DiagnosisStatus};
use crate::wire::fc::NOT_ACTIVE;
use fieldbeat_core::axis::feedback::MONITOR_CHANNELS;
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::Time;

/// The code of a fault that the diagnosis does not name: any error (DRIVECOM).
const ANY_ERROR: u16 = 0x1000;
/// The number of diagnoses that may come without the code of a fault.
const UNNAMED: u8 = 5;
/// Bit 7 of either status word: a warning; bit 10: the set point is reached.
const WARNING: u16 = 1 << 7;
const REACHED: u16 = 1 << 10;

/// A word of the inputs that is shown.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shown {
    channel: u8,
    /// The first byte.
    at: u8,
    signed: bool,
    per_count: f64,
}

impl Shown {
    /// Those of `drive`, whose words are at these bytes.
    pub(super) fn all(drive: &LenzeDrive, at: impl Fn(u8) -> Option<u8>) -> Box<[Shown]> {
        let shown = |(channel, shown): (usize, &Option<ShownWord>)| {
            let ShownWord { word, signed, per_count, .. } = *shown.as_ref()?;
            Some(Shown { channel: channel as u8, at: at(word)?, signed, per_count })
        };
        drive.show.iter().enumerate().take(MONITOR_CHANNELS).filter_map(shown).collect()
    }
}

impl Station {
    /// The diagnosis of a drive in Data_Exchange.
    pub(super) fn diagnosed(&mut self, diagnosis: &Diagnosis<'_>, slot: &mut Slot) {
        self.diagnosis_due = false;
        let status = diagnosis.status;
        let elsewhere = diagnosis.master.is_some_and(|master| master != self.own);
        if status.has_any(DiagnosisStatus::PRM_REQ | DiagnosisStatus::NOT_READY) || elsewhere {
            slot.notices.other_master |= elsewhere;
            return self.leave(Note::Left { function: NOT_ACTIVE }, slot);
        }
        self.profile.watchdog_is(status.has(DiagnosisStatus::WD_ON));
        if !self.inputs.faulted() {
            return;
        }
        let word = self.fault_at.and_then(|at| {
            let rest = diagnosis.extended.get(usize::from(at)..)?;
            rest.first_chunk().map(|word| u16::from_be_bytes(*word)).filter(|word| *word != 0)
        });
        self.unnamed = self.unnamed.saturating_add(1);
        match word {
            Some(code) => (self.inputs.fault, self.inputs.named) = (code, true),
            None if self.unnamed >= UNNAMED || self.fault_at.is_none() => {
                (self.inputs.fault, self.inputs.named) = (ANY_ERROR, true);
            }
            None => self.diagnosis_due = true,
        }
    }

    /// The drive's report, in user units.
    #[inline]
    pub(super) fn read(&mut self, at: Time, data: &[u8], slot: &mut Slot) {
        let word = |at: u8| {
            let word = data.get(usize::from(at)..usize::from(at) + 2);
            word.map_or(0, |word| u16::from_be_bytes([word[0], word[1]]))
        };
        let (status, actual) = (word(self.process_at), word(self.actual_at) as i16);
        if status != self.inputs.status || !self.profile.is_steady() || slot.status.at == Time(0) {
            self.read_anew(status, slot);
        }
        let report = &mut slot.status;
        (report.at, report.velocity) = (at, self.profile.velocity(actual));
        let turns = actual.unsigned_abs() >= self.moves_from || self.profile.is_turning();
        report.moving = report.state.is_powered() && turns;
        slot.notices.fresh = true;
        if !self.shown.is_empty() {
            slot.notices.monitor_fresh = true;
            for &Shown { channel, at, signed, per_count } in &self.shown {
                let raw = word(at);
                let count = if signed { f64::from(raw as i16) } else { f64::from(raw) };
                if let Some(place) = report.monitor.get_mut(usize::from(channel)) {
                    *place = Some(count * per_count);
                }
            }
        }
        let seen = data.get(usize::from(self.process_at)..usize::from(self.seen_to));
        self.native.publish(at, 0, seen.unwrap_or_default());
    }

    /// The status, or what is proved, may be another one than before.
    #[inline(never)]
    fn read_anew(&mut self, status: u16, slot: &mut Slot) {
        slot.notices.restarted |= self.start_up.settled();
        let was_faulted = self.inputs.faulted();
        self.inputs.status = status;
        self.inputs.state = self.profile.state(status);
        self.inputs.sto_open = self.profile.is_sto_open(status);
        match (was_faulted, self.inputs.faulted()) {
            (false, true) => {
                // Its diagnosis names the fault.
                (self.diagnosis_due, self.unnamed, self.inputs.named) = (true, 0, false);
            }
            (_, false) => (self.inputs.fault, self.inputs.named) = (0, false),
            (true, true) => {}
        }
        self.profile.prove(&self.inputs, &mut slot.evidence);
        let report = &mut slot.status;
        (report.state, report.sto_open) = (self.inputs.state, self.inputs.sto_open);
        (report.position, report.demand, report.current) = (f64::NAN, f64::NAN, f64::NAN);
        report.in_target = status & REACHED != 0;
        report.warning = u32::from(status & WARNING);
        report.fault = if self.inputs.faulted() { u32::from(self.inputs.fault) } else { 0 };
        report.suspect = false;
    }
}
