//! The stages between the window and the end of a cycle: evaluate, commands, prepare.

use std::panic::{AssertUnwindSafe, catch_unwind};

use super::panics::Part;
use super::{BUSES_END_NS, Engine, HURRY, Left, RUN, STOP};
use crate::axis::{Link, StopCause};
use crate::bus::Cycle;
use crate::cycle::record::{Record, Reply};
use crate::cycle::task::Axes;
use crate::drive::controller::{DriveController, take_calls, take_commands, take_rows};
use crate::drive::groups::take_group_stop;
use crate::rt::Clock;
use crate::time::Time;

impl<C: Clock> Engine<C> {
    /// Sets the next slot by the clock that leads.
    pub(super) fn steer(&mut self, cycle: &Cycle) {
        let Some(reference) = &mut self.reference else { return };
        let error_ns = self.buses[reference.bus()].work(&mut self.slots, |bus, _| bus.phase_error());
        let record = reference.take(cycle.index, error_ns);
        self.status.reference = Some(reference.status());
        self.grid.steer(record.step_ns.into());
        self.record(Record::Reference(record));
    }

    /// Evaluates all exchanges. Returns how many drives that were online have not answered.
    pub(super) fn evaluate(&mut self, cycle: &Cycle, now: Time) -> u16 {
        // What was posted before a stop ends with it.
        take_commands(&mut self.controllers, &mut self.channels.bells);
        let (mut missed, mut stopped) = (0_u16, false);
        let (mut operational, mut online) = (0, 0);
        (self.shows, self.armed) = (false, true);
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            let reply = controller.evaluate(cycle, now, slot);
            self.armed = self.armed && controller.arm(cycle, slot);
            if reply == Reply::Missed {
                self.status.missed += controller.take_misses();
                missed += u16::from(controller.was_online());
            }
            stopped |= controller.takes_along();
            self.shows |= controller.shows();
            let feedback = controller.feedback();
            operational += u32::from(feedback.is_operational());
            online += u32::from(feedback.link == Link::Online);
        }
        (self.status.operational, self.status.online) = (operational, online);
        for bus in &self.buses {
            if bus.bus.helper_ended() {
                for controller in &mut self.controllers[bus.first..bus.end] {
                    controller.stop(cycle, now, StopCause::LinkThread);
                }
                stopped = true;
            }
        }
        if self.heartbeat.is_silent(cycle) {
            for controller in &mut self.controllers {
                controller.stop_if_armed(cycle, now, StopCause::Heartbeat);
            }
            stopped = true;
        }
        self.groups.judge(&mut self.controllers);
        while let Some(lead) = self.groups.take_full() {
            for controller in &mut self.controllers {
                if controller.moves_in_group().is_some_and(|call| call.lead as usize == lead) {
                    controller.stop(cycle, now, StopCause::GroupLink);
                }
            }
            stopped = true;
        }
        if stopped {
            self.armed = false;
            self.take_groups_along(cycle, now);
        }
        missed
    }

    /// Begins what may begin at each axis, and writes at once what is desired of it with the send of `next`. Returns
    /// what is left of that: rows come to all members of a group together, and what begins or stops at one axis may
    /// begin or stop others before it.
    pub(super) fn command(&mut self, cycle: &Cycle, next: &Cycle, now: Time) -> Left {
        if take_calls(&mut self.controllers, &mut self.channels.bells) {
            // Before an axis writes what is desired: those of a group are for all of its members.
            self.groups.take_setpoints(cycle, &mut self.controllers);
        } else if self.armed && self.channels.bells.are_silent() {
            return Left::Nothing;
        }
        let (mut calls, mut stops, mut rows) = (false, false, false);
        let with_task = self.task.is_some();
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            controller.exchange(cycle, now, slot);
            slot.due = controller.is_due(next.index);
            slot.guarded = controller.is_guarded();
            calls |= controller.waiting().is_some();
            stops |= controller.takes_along();
            if controller.follows_rows() {
                rows = true;
            } else {
                rows |= with_task && controller.takes_rows();
                controller.propose(next, slot);
            }
        }
        if calls {
            self.groups.open(cycle, now, &mut self.controllers);
        }
        match (calls || stops, rows) {
            (true, _) => Left::All,
            (false, true) => Left::Rows,
            (false, false) => Left::Nothing,
        }
    }

    /// An axis that was stopped stops its stop group, and so does one without which its group would go on.
    fn take_groups_along(&mut self, cycle: &Cycle, now: Time) {
        for axis in 0..self.controllers.len() {
            if let Some(cause) = take_group_stop(cycle, now, axis, &mut self.controllers) {
                // What was posted before the stop ends with it.
                take_commands(&mut self.controllers, &mut self.channels.bells);
                self.stop_groups.stop(cycle, now, axis as u16, cause, &mut self.controllers);
            }
        }
    }

    /// Stops every axis.
    pub(super) fn stop_axes(&mut self, stop: impl Fn(&mut DriveController)) {
        self.armed = false;
        // What was posted before the stop ends with it.
        take_commands(&mut self.controllers, &mut self.channels.bells);
        for controller in &mut self.controllers {
            stop(controller);
            controller.take_along();
        }
    }

    /// The orderly end, once requested. True when it is complete.
    #[inline]
    pub(super) fn end(&mut self, cycle: &Cycle, now: Time) -> bool {
        let requested = self.channels.requested();
        (requested != RUN || self.ending.is_some()) && self.end_on(cycle, now, requested)
    }

    #[cold]
    fn end_on(&mut self, cycle: &Cycle, now: Time, requested: u8) -> bool {
        let (since, before) = *self.ending.get_or_insert((now, STOP));
        let hurry = requested == HURRY && before == STOP;
        self.ending = Some((since, requested));
        let mut down = true;
        for (axis, controller) in self.controllers.iter_mut().enumerate() {
            let shut_down = || controller.shut_down(cycle, now, hurry);
            down &= self.panics.run(Part::Axis(axis), shut_down).unwrap_or(true);
        }
        if down || now.since(since) > self.longest_end_ns {
            if self.buses_ending.is_none() {
                // From here on a silent drive may be one whose link its bus has ended.
                self.controllers.iter_mut().for_each(DriveController::note_end);
            }
            let begun = *self.buses_ending.get_or_insert(now);
            let mut done = true;
            for (bus, open) in self.buses.iter_mut().enumerate() {
                let shut_down = || open.exchange(&mut self.slots, |bus, slots| bus.shut_down(cycle, slots));
                done &= self.panics.run(Part::Bus(bus), shut_down).flatten().unwrap_or(true);
            }
            self.status.cut_off = !done && now.since(begun) > BUSES_END_NS;
            self.buses_down = done || self.status.cut_off;
            self.changed = true;
        }
        self.buses_down
    }

    pub(super) fn run_task(&mut self, cycle: &Cycle, before: Time) {
        let Some(task) = &mut self.task else { return };
        self.armed = false;
        let mut axes = Axes::new(&mut self.controllers, &mut self.task_id, cycle, before, &self.channels.log);
        let result = catch_unwind(AssertUnwindSafe(|| task(cycle, &mut axes)));
        let panicked = self.channels.log.flag(false, result.is_err());
        // Neither the panic's payload nor the task is dropped: this thread must not free memory.
        std::mem::forget(result);
        let over = match self.plan.task_budget_ns {
            Some(budget) => self.clock.now().since(before) > budget,
            None => false,
        };
        if panicked {
            std::mem::forget(self.task.take());
        }
        if panicked || over {
            self.stop_axes(|axis| axis.stop(cycle, before, StopCause::Task));
        }
        // The task may have run for long.
        take_commands(&mut self.controllers, &mut self.channels.bells);
    }

    /// Prepares the send of `next`: which drives are due, their rows, and their bytes.
    pub(super) fn arm(&mut self, next: &Cycle, now: Time) {
        self.propose(next, now);
        self.build(next);
    }

    /// Writes what is desired of each drive with the send of `next`. It may be called again for the same send.
    #[inline(never)]
    pub(super) fn propose(&mut self, next: &Cycle, now: Time) {
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            slot.due = controller.is_due(next.index);
            slot.guarded = controller.is_guarded();
        }
        self.feed(next, now, true);
    }

    /// Gives the axes that follow their rows, and writes what is desired of them, or of `all`.
    #[inline(never)]
    pub(super) fn feed(&mut self, next: &Cycle, now: Time, all: bool) {
        take_rows(&mut self.controllers, &self.slots);
        let mut all = all;
        for (controller, slot) in self.controllers.iter_mut().zip(&self.slots) {
            controller.feed(next, now, slot);
            all |= controller.takes_along();
        }
        if all {
            // What stopped since the evaluation leaves with the same send.
            self.take_groups_along(next, now);
        }
        for (controller, slot) in self.controllers.iter_mut().zip(&mut self.slots) {
            if all || controller.follows_rows() {
                controller.propose(next, slot);
            }
        }
    }

    #[inline(always)] // In each cycle, also that of a single drive.
    pub(super) fn build(&mut self, next: &Cycle) {
        for (bus, open) in self.buses.iter_mut().enumerate() {
            let prepare = || open.work(&mut self.slots, |bus, slots| bus.prepare(next, slots));
            self.panics.run(Part::Bus(bus), prepare);
        }
    }
}
