//! The toy on a half-duplex wire, as PROFIBUS is one: the next request leaves when the one before it was answered, or
//! its reply is overdue.

use fieldbeat::Cycle;
use fieldbeat::time::{Time, US};
use fieldbeat_core::bus::{Exchange, Slot};
use fieldbeat_core::net::Sent;

use super::{Defect, ToyBus};
use crate::conformance::line::{PERIOD, WINDOW};

/// From a request to its answer, ns.
pub(super) const ANSWER: u64 = 130 * US;
/// A reply is overdue after so long.
const REPLY: u64 = 200 * US;
/// The wire is silent for so long before each request.
const IDLE: u64 = 20 * US;
/// So many of the slowest exchanges end in a window.
const A_WINDOW: usize = 2;

/// From the slot of an exchange to its end, if all of `drives` are due in it.
pub(super) fn turn_within_ns(drives: usize) -> u64 {
    (drives.div_ceil(A_WINDOW) as u64 - 1) * PERIOD + WINDOW
}

/// Whose turn it is.
#[derive(Default)]
pub(super) struct Turns {
    /// The drive whose request is on the wire, and when its reply is overdue.
    on_wire: Option<(usize, Time)>,
    /// The wire is free from then on.
    free_at: Time,
    /// The drive whose turn is next.
    next: usize,
    /// One is queued.
    queued: bool,
}

impl Turns {
    pub(super) fn poll_at(&self) -> Option<Time> {
        let overdue = self.on_wire.map(|(_, overdue)| overdue);
        overdue.or(self.queued.then_some(self.free_at))
    }

    /// What was taken in may have ended the exchange on the wire.
    pub(super) fn look(&mut self, slots: &[Slot]) {
        if let Some((index, _)) = self.on_wire
            && let Exchange::Answered { at, .. } = slots[index].exchange
        {
            (self.on_wire, self.free_at) = (None, at + IDLE);
        }
    }
}

impl ToyBus {
    /// Queues what is due, and lets the first in the queue go if the wire is free.
    pub(super) fn send_in_turn(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        self.turns.look(slots);
        for slot in slots.iter_mut() {
            match slot.exchange {
                Exchange::Queued if self.defect == Some(Defect::GivesUpItsTurn) => {
                    slot.exchange = Exchange::Unsent;
                    slot.counters.unsent += 1;
                }
                // What has just been answered, or is still owed, is passed over.
                Exchange::Idle | Exchange::Missed if slot.due => slot.exchange = Exchange::Queued,
                _ => {}
            }
        }
        self.go_on(cycle, cycle.grid, slots);
    }

    /// At `now`, what is overdue ends, and the next in the queue goes if the wire is free.
    pub(super) fn go_on(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        let overdue = self.turns.on_wire.filter(|(_, overdue)| now >= *overdue);
        if let Some((index, overdue)) = overdue.filter(|_| self.defect != Some(Defect::WaitsForEver)) {
            if let Exchange::Owed { sent_at, .. } = slots[index].exchange {
                slots[index].exchange = Exchange::Absent { sent_at };
            }
            (self.turns.on_wire, self.turns.free_at) = (None, overdue);
        }
        let out_of_turn = self.defect == Some(Defect::SendsOutOfTurn);
        for _ in 0..slots.len() {
            if !out_of_turn && (self.turns.on_wire.is_some() || now < self.turns.free_at) {
                break;
            }
            let mut turns = (0..slots.len()).map(|n| (self.turns.next + n) % slots.len());
            let Some(index) = turns.find(|index| slots[*index].exchange == Exchange::Queued) else { break };
            self.turns.next = index + 1;
            self.send_to(index, cycle, &mut slots[index]);
        }
        self.turns.queued = slots.iter().any(|slot| slot.exchange == Exchange::Queued);
    }

    /// Sends the request of one drive.
    fn send_to(&mut self, index: usize, cycle: &Cycle, slot: &mut Slot) {
        (0..self.outbox.len()).for_each(|other| self.outbox.post(other, other == index));
        self.net.send(&mut self.outbox);
        let Sent::At(sent_at) = self.outbox.sent(index) else {
            slot.counters.unsent += 1;
            slot.exchange = Exchange::Unsent;
            return;
        };
        self.stations[index].sent(slot);
        slot.counters.sent += 1;
        let overdue = sent_at + REPLY;
        let later = u64::from(overdue > cycle.deadline) * cycle.period_ns;
        slot.exchange = Exchange::Owed { sent_at, reply_by: cycle.deadline + later, awaited: false };
        self.turns.on_wire = Some((index, overdue));
    }
}
