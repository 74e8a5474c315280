//! What follows from an answer, or from none: the exchange is closed, and the next telegram counts on, or anew.

use super::{AWAITED, FCB, FIRST, SECOND, Sending, Station};
use crate::acyclic::Turn;
use crate::counters::Own;
use crate::line::Answer;
use crate::notes::Note;
use crate::profile::Inputs;
use crate::start_up::Step;
use crate::wire::dp::{Diagnosis, DiagnosisStatus};
use crate::wire::fc::NOT_ACTIVE;
use fieldbeat_core::bus::Slot;
use fieldbeat_core::time::Time;

/// The number of refusals (UE, RR) in a row, behind which its diagnosis shows nothing, that end Data_Exchange: the
/// drive is parametrised again.
const MOST_REFUSED: u8 = 20;

impl Station {
    /// The telegram of its turn was answered at `at`. True: its start-up has come further, is over or begins.
    #[inline]
    pub fn answered(&mut self, at: Time, answer: Answer<'_>, slot: &mut Slot) -> bool {
        let usual = self.exchanges() && !self.starts();
        self.count = if self.count == FIRST { SECOND } else { self.count ^ FCB };
        let Answer::Data { high, data } = answer else {
            self.answered_without(at, answer, slot);
            return !usual || self.starts();
        };
        if self.sending != Sending::DataExchange {
            self.answered_other(at, data, slot);
            return !usual || self.starts();
        }
        self.diagnosis_due |= high;
        self.refused = 0;
        self.profile.answered();
        if self.close(at, slot) {
            if self.acyclic.is_busy()
                && self.process_at > 0
                && let Some(channel) = data.first_chunk()
            {
                self.acyclic.channel_answered(channel);
            }
            self.read(at, data, slot);
        }
        !usual
    }

    /// The exchange is answered; false: it is over for the loop.
    #[inline]
    fn close(&mut self, at: Time, slot: &mut Slot) -> bool {
        if slot.answer(at, false).is_none() {
            slot.counters.late += 1;
            return false;
        }
        self.slow = if at <= self.window_end { 0 } else { self.slow.wrapping_add(1) };
        true
    }

    /// Data came in answer to something else.
    #[inline(never)]
    fn answered_other(&mut self, at: Time, data: &[u8], slot: &mut Slot) {
        match self.sending {
            Sending::Msac1 => {
                self.close(at, slot);
                self.acyclic.answered(at, Answer::Data { high: false, data });
            }
            Sending::StartUp => self.start(at, data),
            Sending::Diagnosis => {
                self.close(at, slot);
                if let Some(diagnosis) = Diagnosis::parse(data) {
                    self.diagnosed(&diagnosis, slot);
                }
            }
            Sending::DataExchange | Sending::Unlock => {}
        }
    }

    /// The answer has no data.
    #[inline(never)]
    fn answered_without(&mut self, at: Time, answer: Answer<'_>, slot: &mut Slot) {
        match (self.sending, answer) {
            (Sending::StartUp, Answer::Refused(function)) => self.start_up.refused(at, function),
            (Sending::StartUp, _) => self.start_up.acknowledged(),
            (Sending::Msac1, answer) => {
                self.close(at, slot);
                self.acyclic.answered(at, answer);
            }
            (Sending::Unlock, _) => self.leave(Note::None, slot),
            (Sending::DataExchange | Sending::Diagnosis, Answer::Refused(function))
                if function != NOT_ACTIVE && self.refused < MOST_REFUSED =>
            {
                // It has not taken this one (RR), or cannot answer now (UE). What has become of it is in its diagnosis,
                // which takes the next turn.
                Own::Refused.count(&mut slot.counters);
                self.refused += 1;
                slot.absent();
                self.diagnosis_due = self.sending == Sending::DataExchange;
            }
            (Sending::DataExchange | Sending::Diagnosis, answer) => {
                // It does not exchange data any more.
                slot.absent();
                let why = match answer {
                    Answer::Refused(function) => {
                        Own::Refused.count(&mut slot.counters);
                        Note::Left { function }
                    }
                    _ => Note::None,
                };
                self.leave(why, slot);
            }
        }
    }

    /// The telegram of its turn has failed: nothing answers it, however often it was repeated. The next one counts
    /// anew.
    #[cold]
    pub(in super::super) fn failed(&mut self, slot: &mut Slot) {
        (self.count, self.slow) = (FIRST, self.slow.max(AWAITED));
        match self.sending {
            Sending::StartUp => self.start_up.failed(),
            Sending::Msac1 => self.acyclic.lost(Turn::Msac1),
            Sending::DataExchange => self.acyclic.lost(Turn::DataExchange),
            Sending::Diagnosis | Sending::Unlock => {}
        }
        slot.absent();
    }

    /// The drive is not in Data_Exchange any more, for this reason: it starts up again.
    #[cold]
    pub(super) fn leave(&mut self, why: Note, slot: &mut Slot) {
        self.start_up.left(self.grid, why);
        (self.diagnosis_due, self.passed_over) = (false, false);
        self.profile.dropped();
        self.acyclic.ended();
        slot.evidence.outputs_count = false;
    }

    /// The answer to a step of the start-up, with data.
    fn start(&mut self, at: Time, data: &[u8]) {
        let checks = self.start_up.step() == Step::Check;
        self.start_up.answered(at, data);
        if checks && self.start_up.is_over() {
            let watched = Diagnosis::parse(data).is_some_and(|seen| seen.status.has(DiagnosisStatus::WD_ON));
            self.profile.dropped();
            self.profile.watchdog_is(watched);
            self.acyclic.ended();
            // Data_Exchange comes first.
            (self.diagnosis_due, self.passed_over, self.unnamed, self.refused) = (false, true, 0, 0);
            self.inputs = Inputs::default();
        }
    }
}
