//! What follows from an answer, or from none: the exchange is closed, and the next telegram counts on, or anew.

use super::{AWAITED, FCB, FIRST, SECOND, Sending, Station};
use crate::acyclic::{self, Turn};
use crate::line::Answer;
use crate::profile::Inputs;
use crate::start_up::Step;
use crate::wire::dp::{Diagnosis, DiagnosisStatus};
use fieldbeat_core::bus::{Exchange, Slot};
use fieldbeat_core::time::Time;

impl Station {
    /// The telegram of its turn was answered at `at`.
    #[inline]
    pub fn answered(&mut self, at: Time, answer: Answer<'_>, slot: &mut Slot) {
        self.count = if self.count == FIRST { SECOND } else { self.count ^ FCB };
        self.was_answered = true;
        let Answer::Data { high, data } = answer else { return self.answered_without(at, answer, slot) };
        if self.sending != Sending::DataExchange {
            return self.answered_other(at, data, slot);
        }
        self.diagnosis_due |= high;
        self.profile.answered();
        if !self.close(at, slot) {
            return;
        }
        if !self.acyclic.is_idle()
            && self.process_at > 0
            && let Some(channel) = data.first_chunk()
        {
            self.acyclic.channel_answered(channel);
        }
        self.read(at, data, slot);
    }

    /// Its exchange is answered; false: it is over for the loop.
    #[inline]
    fn close(&mut self, at: Time, slot: &mut Slot) -> bool {
        let Exchange::Owed { sent_at, .. } = slot.exchange else {
            slot.counters.late += 1;
            return false;
        };
        self.slow = if at <= self.window_end { 0 } else { self.slow.wrapping_add(1) };
        slot.exchange = Exchange::Answered { sent_at, at, suspect: false };
        slot.counters.answered += 1;
        true
    }

    /// Data came in answer to something else.
    #[inline(never)]
    fn answered_other(&mut self, at: Time, data: &[u8], slot: &mut Slot) {
        match self.sending {
            Sending::Msac1 => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Data(data));
            }
            Sending::StartUp => match Diagnosis::parse(data) {
                Some(diagnosis) => self.start(&diagnosis),
                None => self.start_up.again(false),
            },
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
            (Sending::StartUp, Answer::Refused(function)) => self.start_up.refused(function),
            (Sending::StartUp, _) => self.start_up.acknowledged(),
            (Sending::Msac1, Answer::Refused(function)) => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Refused(function));
            }
            (Sending::Msac1, _) => {
                self.close(at, slot);
                self.acyclic.answered(at, acyclic::Answer::Acknowledged);
            }
            (Sending::Unlock, _) => self.leave(slot),
            (Sending::DataExchange | Sending::Diagnosis, _) => {
                // It does not exchange data any more.
                self.absent(slot);
                self.leave(slot);
            }
        }
    }

    pub(super) fn absent(&mut self, slot: &mut Slot) {
        if let Exchange::Owed { sent_at, .. } = slot.exchange {
            slot.exchange = Exchange::Absent { sent_at };
        }
    }

    /// The telegram of its turn has failed: nothing answers it, however often it was repeated. The next one counts
    /// anew.
    #[cold]
    pub(in super::super) fn failed(&mut self, slot: &mut Slot) {
        (self.count, self.was_answered, self.slow) = (FIRST, false, self.slow.max(AWAITED));
        match self.sending {
            Sending::StartUp => self.start_up.failed(),
            Sending::Msac1 => self.acyclic.lost(Turn::Msac1),
            Sending::DataExchange => self.acyclic.lost(Turn::DataExchange),
            Sending::Diagnosis | Sending::Unlock => {}
        }
        self.absent(slot);
    }

    /// The drive is not in Data_Exchange any more: it starts up anew.
    #[cold]
    pub(super) fn leave(&mut self, slot: &mut Slot) {
        if self.start_up.is_over() {
            self.was_lost = true;
        }
        self.start_up.again(true);
        (self.diagnosis_due, self.passed_over) = (false, false);
        self.profile.dropped();
        self.acyclic.ended();
        slot.evidence.outputs_count = false;
    }

    /// A diagnosis of the start-up.
    fn start(&mut self, diagnosis: &Diagnosis<'_>) {
        let checks = self.start_up.step() == Step::Check;
        self.start_up.diagnosed(diagnosis);
        if checks && self.start_up.is_over() {
            self.profile.dropped();
            self.profile.watchdog_is(diagnosis.status.has(DiagnosisStatus::WD_ON));
            self.acyclic.ended();
            // Data_Exchange comes first.
            (self.diagnosis_due, self.passed_over, self.unnamed) = (false, true, 0);
            self.inputs = Inputs::default();
        }
    }
}
