//! What is sent, one telegram after the other.

use super::ProfibusBus;
use super::queue::ALL;
use super::receive::WATCHFUL;
use super::upkeep::Behind;
use crate::counters::Own;
use crate::line::{Instead, Job, Ready};
use crate::wire::dp::GlobalControl;
use crate::wire::sap::global_control;
use fieldbeat_core::bus::{Cycle, Exchange, Slot};
use fieldbeat_core::time::Time;

/// Steps of the wire in one call: a telegram and what follows from it each.
const MOST_STEPS: usize = 16;

impl ProfibusBus {
    /// Continues with what is due at `now`.
    #[inline(always)] // Once for the first turn of a window, and for each further one.
    pub(super) fn go_on(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        for _ in 0..MOST_STEPS {
            let goes_on = match self.line.is_free_at(now) {
                true => self.start_next(cycle, now, slots),
                false => self.step(now, slots),
            };
            if !goes_on {
                return;
            }
        }
    }

    /// Continues with what is under way; false: nothing more can be done now.
    #[inline(never)]
    fn step(&mut self, now: Time, slots: &mut [Slot]) -> bool {
        match self.line.ready(now) {
            Ready::Wait => return false,
            Ready::Free => return true,
            Ready::Overdue { job, instead, failed } => return self.overdue(now, job, instead, failed, slots),
            // It was silent.
            Ready::Claim => self.notes.set_other(None),
            Ready::Resend => {}
        }
        self.hand_over(slots);
        false
    }

    /// Hands the telegram to the driver.
    pub(super) fn hand_over(&mut self, slots: &mut [Slot]) {
        match self.net.send(0, self.line.to_send()) {
            Ok((at, count)) => _ = self.line.sent(at, count),
            Err(broken) => self.broken(broken, slots),
        }
    }

    /// The request of `job` has no answer. False: it has not left the driver yet.
    #[cold]
    pub(super) fn overdue(
        &mut self,
        now: Time,
        job: Job,
        instead: Instead,
        failed: bool,
        slots: &mut [Slot],
    ) -> bool {
        if instead == Instead::Silence
            && let Ok(bytes @ 1..) = self.net.unsent()
        {
            self.line.still_sends(now, bytes, failed);
            return false;
        }
        let Job::Drive(index) = job else { return true };
        self.watchful = WATCHFUL;
        let place = usize::from(index);
        let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place)) else {
            return true;
        };
        match instead {
            Instead::Silence => Own::SlotTimes.count(&mut slot.counters),
            Instead::Part => Own::WrongEnd.count(&mut slot.counters),
            Instead::Garbage => {}
        }
        if failed {
            slot.counters.own[Own::WireUs as usize] += now.since(self.began_at) / 1_000;
            station.failed(slot);
            self.changed(index);
        } else {
            Own::Retries.count(&mut slot.counters);
        }
        true
    }

    /// Sends the next telegram; false: nothing more can be sent now.
    #[inline]
    fn start_next(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) -> bool {
        if self.upkeep.control_is_due(now, !self.queue.is_empty()) {
            self.control(now, GlobalControl::OPERATE, slots);
            return false;
        }
        let may = if self.intervals.is_empty() { ALL } else { self.may_begin(now) };
        let Some(index) = self.queue.pop(may) else {
            if self.upkeep.is_round_over() {
                self.end_round(cycle, now, slots);
            }
            return false;
        };
        self.last = index;
        if self.queue.is_empty() {
            self.upkeep.end_round();
        }
        let place = usize::from(index);
        let (Some(station), Some(slot)) = (self.stations.get_mut(place), slots.get_mut(place)) else {
            return true;
        };
        if slot.exchange != Exchange::Queued {
            return true;
        }
        let may_be_acyclic = self.acyclic_after == 0;
        let Some(request) = self.line.request(index, |out| station.request(slot, may_be_acyclic, out)) else {
            slot.unsent();
            return true;
        };
        match self.net.send(0, request) {
            Ok((at, count)) if self.line.sent(at, count) => {
                self.began_at = at;
                if let Some((least_ns, not_before)) = self.intervals.get_mut(place) {
                    *not_before = at + *least_ns;
                }
                self.acyclic_after = match station.is_acyclic() {
                    true => self.own_slots.len() - 1,
                    false => self.acyclic_after.saturating_sub(1),
                };
                // By its window, or by a later one.
                let within = at + self.line.closed_within_ns();
                let more = match within > cycle.deadline {
                    true => within.since(cycle.deadline).div_ceil(cycle.period_ns.max(1)) * cycle.period_ns,
                    false => 0,
                };
                station.sent(at, cycle.deadline + more, slot);
                false
            }
            Ok(_) => {
                slot.unsent();
                true
            }
            Err(broken) => {
                slot.unsent();
                self.broken(broken, slots);
                false
            }
        }
    }

    /// The drives whose interval has passed, a bit each.
    #[cold]
    fn may_begin(&self, now: Time) -> u128 {
        let bit = |(index, (_, not_before)): (usize, &(u64, Time))| u128::from(*not_before <= now) << index;
        self.intervals.iter().enumerate().fold(0, |may, drive| may | bit(drive))
    }

    /// When the first of the drives that wait may have its turn on the free wire, if nothing else is to be sent.
    #[cold]
    pub(super) fn next_turn_at(&self) -> Time {
        let waiting = self.queue.waiting();
        if waiting == 0 || self.upkeep.is_round_over() {
            return Time(0);
        }
        let waits = |(index, _): &(usize, &(u64, Time))| waiting >> index & 1 != 0;
        let waits = self.intervals.iter().enumerate().filter(waits);
        waits.map(|(_, (_, not_before))| *not_before).min().unwrap_or(Time(0))
    }

    /// Informs all drives whether their outputs count.
    #[cold]
    pub(super) fn control(&mut self, now: Time, command: u8, slots: &mut [Slot]) {
        self.upkeep.controlled(now);
        let data = GlobalControl { command, groups: 0 }.data();
        if self.line.broadcast(&global_control(self.line.address()), &data) {
            self.hand_over(slots);
        }
    }

    /// Behind the turns of a round, in what is left of the window: a token, or a search for another master.
    fn end_round(&mut self, cycle: &Cycle, now: Time, slots: &mut [Slot]) {
        let is_station = |address| self.stations.iter().any(|station| station.address() == address);
        match self.upkeep.behind_round(now < cycle.deadline, is_station) {
            None => return,
            Some(Behind::Token) => self.line.token(),
            Some(Behind::Gap(address)) => self.line.gap(address),
        }
        self.hand_over(slots);
    }

    /// Those that start up have their turns in their own slots, whatever their link.
    #[cold]
    pub(super) fn let_start(&mut self, cycle: &Cycle, slots: &mut [Slot]) {
        let next = cycle.index + 1;
        for (index, (slot, (divisor, phase))) in slots.iter_mut().zip(&self.own_slots).enumerate() {
            if self.starting >> index & 1 != 0 && next % divisor.max(&1) == *phase {
                slot.reachable = true;
            }
        }
    }
}
