//! The watch over an axis, and its stops: latched with their cause, braked, and begun again if it moves all the same.

use super::duty::{Claim, Latch, Lead};
use super::{Along, DriveController, Ending};
use crate::axis::{
    Abort, BegunBy, Command, EventKind, FollowingError, FoundRunning, GroupCall, Link, Outcome, State,
    StopCause, StopHow, StopPlan, StopThen,
};
use crate::bus::{Cycle, Slot};
use crate::drive::at_end::{AtEnd, LoopFacts, Requested};
use crate::drive::stop::{Sight, StopSequence};
use crate::drive::watch::{Phase, Watched};
use crate::time::{Time, nanos};

impl DriveController {
    /// A drive runs that this master has not enabled: it was found so, or began later.
    pub(super) fn find_running(&mut self, cycle: &Cycle, now: Time, braked: Braked) {
        match *self.duty.latch() {
            // What a living master runs is not taken over.
            Latch::Down(..) | Latch::Kept(StopCause::OtherMaster) => return,
            Latch::Kept(_) => {}
            Latch::Open => self.latch(cycle, now, StopCause::FoundRunning),
        }
        // A drive that this master has commanded is never only read again.
        if self.plan.on_found_running == FoundRunning::Stop || self.duty.claim() != Claim::Found {
            self.brake(now, braked, self.plan.stop);
        }
    }

    /// Watches an axis that has power, and runs one cycle of its stop sequence. An axis in operation that the loop
    /// leads, or nothing, has a way of its own: it saves 68 instructions a drive and cycle.
    #[inline(always)] // Once for each axis and usual cycle.
    pub(super) fn watch(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, fresh: bool, restarted: bool) {
        self.called |= self.machine.observe(cycle.grid, restarted, slot);
        slot.notices.fresh = false;
        // First: what follows from another master must not be named in its place.
        if std::mem::take(&mut slot.notices.other_master) {
            self.stop(cycle, now, StopCause::OtherMaster);
        }
        if fresh {
            let breaks = match self.duty.follows().lead {
                // It is where it is expected, and what leads it is checked before it is sent.
                Lead::Loop if self.feedback.status.state == State::OperationEnabled => {
                    self.watch.expect(Phase::Commanded);
                    if self.watch.strays() && self.is_to_follow() {
                        Some(StopCause::FollowingError)
                    } else {
                        let watched = Watched { homing: false, braking: false };
                        self.watch.is_broken(watched).then_some(StopCause::Limit)
                    }
                }
                Lead::Nothing if self.feedback.status.state == State::OperationEnabled => {
                    self.watch_rest(now, slot, Watched { homing: false, braking: true })
                }
                _ => self.watch_any(now, slot, restarted),
            };
            if let Some(cause) = breaks {
                self.breaks(cycle, now, cause);
            }
        }
        if self.duty.follows().stops {
            self.watch_stop(cycle, now, fresh);
        }
    }

    /// The following error has a limit in this motion: one that was configured, or that of a demand of the master. The
    /// drive watches its own demand.
    #[cold]
    fn is_to_follow(&self) -> bool {
        self.plan.limits.following_error != FollowingError::Derived || self.machine.makes_demand()
    }

    /// The forbidden behaviour of an axis in any state, if there is any.
    #[inline(never)]
    fn watch_any(&mut self, now: Time, slot: &Slot, restarted: bool) -> Option<StopCause> {
        self.left_operation(restarted).or_else(|| self.watch_motion(now, slot))
    }

    /// It is not where it is expected to be, or does what it must not.
    #[cold]
    fn breaks(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        if self.duty.claim() == Claim::Found {
            // Before it is online it is found, as it will be then; later, something else has begun to move it.
            let online = self.feedback.link == Link::Online;
            let braked = if online { Braked::ByTheDrive } else { Braked::BySetpoints };
            self.find_running(cycle, now, braked);
        } else if self.duty.latch().is_open() {
            // What no command has begun follows no setpoint, nor does what goes on under a stop, or strays from them.
            let follows = self.duty.command().is_some_and(|command| !command.is_stop());
            let own = !follows && matches!(cause, StopCause::Uncommanded | StopCause::Limit)
                || cause == StopCause::FollowingError;
            let braked = if own { Braked::ByTheDrive } else { Braked::BySetpoints };
            self.stop_by(braked, cycle, now, cause);
        } else {
            self.stop_again(cycle, now, cause);
        }
    }

    /// One cycle of the stop that runs.
    #[inline(never)]
    fn watch_stop(&mut self, cycle: &Cycle, now: Time, fresh: bool) {
        if self.is_stopping_too_long(now) {
            self.stop_harder(cycle, now);
        }
        let sight = Sight {
            fresh,
            answers: self.answers(),
            failed: matches!(self.machine.end(), Some(Err(_))),
            powered: self.feedback.status.state.is_powered(),
            moving: self.feedback.status.moving,
            velocity: self.feedback.status.velocity,
        };
        if let Some((cause, sequence)) = self.duty.sequence()
            && let Some(command) = sequence.step(now, sight)
        {
            let why = Abort::Stopped(cause);
            if let Some(active) =
                self.duty.active().filter(|active| !matches!(active.command, Command::Reset))
            {
                self.end(cycle, now, active, Outcome::Aborted(why));
            }
            self.issue(Some(command));
        }
    }

    /// The application's stop has not stopped it.
    fn stop_harder(&mut self, cycle: &Cycle, now: Time) {
        if !self.duty.latch().is_open() {
            return self.stop_again(cycle, now, StopCause::StopTimeout);
        }
        self.latch(cycle, now, StopCause::StopTimeout);
        self.brake(now, Braked::ByTheDrive, self.plan.stop);
    }

    /// Why an axis that is expected to stay in operation is not.
    fn left_operation(&self, restarted: bool) -> Option<StopCause> {
        // Where the application owns the control word, the drive's state is the application's concern.
        let free = self.duty.follows().is_free;
        if !(self.duty.claim() == Claim::Armed || free) {
            return None;
        }
        match self.feedback.status.state {
            State::OperationEnabled | State::QuickStopActive => None,
            _ if free && !restarted => None,
            State::Fault | State::FaultReactionActive => Some(StopCause::DriveFault),
            _ if self.feedback.status.sto_open => Some(StopCause::StoOpen),
            _ => Some(StopCause::DriveDropped),
        }
    }

    /// The forbidden motion of an axis with power, in whatever state it is: out of its limits, or without a command.
    fn watch_motion(&mut self, now: Time, slot: &Slot) -> Option<StopCause> {
        let state = self.feedback.status.state;
        // A drive in its fault reaction brakes by itself, and takes no request.
        if !state.is_powered() {
            self.watch.expect(Phase::Resting);
            return None;
        }
        if state == State::FaultReactionActive {
            self.watch.expect(Phase::Commanded);
            return None;
        }
        let braking = matches!(self.duty.latch(), Latch::Down(_, sequence) if !sequence.is_down());
        // What is on already is not moved by being enabled.
        let commanded = self.duty.command().is_some_and(|command| match command {
            Command::Reset | Command::ResetFault => false,
            Command::Enable => state != State::OperationEnabled,
            _ => true,
        });
        // Only the drive knows how it will brake if this loop does not command it; under torque nothing brakes it.
        let unled = matches!(self.duty.command(), None | Some(Command::Native(_)));
        let watched = Watched {
            homing: self.duty.command() == Some(&Command::Home),
            braking: unled || self.duty.is_under_torque(),
        };
        if !braking && !commanded {
            return self.watch_rest(now, slot, watched);
        }
        self.watch.expect(if braking { Phase::Stopping } else { Phase::Commanded });
        // The stop sequence has its own time-out.
        (self.watch.is_broken(watched) && !braking).then_some(StopCause::Limit)
    }

    /// The same of one that nothing commands.
    #[inline]
    fn watch_rest(&mut self, now: Time, slot: &Slot, watched: Watched) -> Option<StopCause> {
        let broken = self.watch.is_broken(watched);
        if !slot.status.suspect && self.watch.moves(now, &self.feedback.status) {
            return Some(if broken { StopCause::Limit } else { StopCause::Uncommanded });
        }
        broken.then_some(StopCause::Limit)
    }

    /// The application's stop has not ended in its time, although the drive answers. A stop sequence that runs has its
    /// own time-out; and what was only read is not ours to stop.
    fn is_stopping_too_long(&self, now: Time) -> bool {
        self.duty.command().is_some_and(Command::is_stop)
            && self.duty.latch().is_settled()
            && !matches!(self.duty.latch(), Latch::Kept(_))
            && self.answers()
            && now.since(self.began) > nanos(self.plan.stop.timeout)
    }

    /// The fastest speed at which it may be, user units/s.
    pub(super) fn speed(&self) -> f64 {
        self.feedback.status.velocity.abs().max(self.watch.speed())
    }

    /// The drive answers, so that requests reach it.
    pub(super) fn answers(&self) -> bool {
        matches!(self.feedback.link, Link::Qualifying | Link::Online)
    }

    /// Stops the axis: latches the cause, flushes queue and stream, starts the stop sequence. The first cause
    /// stays. A drive that was only read until now is not ours to brake: its axis is latched, and nothing is
    /// written.
    pub fn stop(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.stop_by(Braked::BySetpoints, cycle, now, cause);
    }

    /// Stops it because another axis of its stop group was stopped.
    #[inline(never)]
    pub fn stop_along(&mut self, cycle: &Cycle, now: Time, begun_by: BegunBy) {
        if self.duty.latch().is_open() {
            self.feedback.begun_by = Some(begun_by);
        }
        self.stop(cycle, now, StopCause::Group);
    }

    /// The same, by the drive or by setpoints. What was requested of the axis for its end is made no softer by it.
    pub(super) fn stop_by(&mut self, braked: Braked, cycle: &Cycle, now: Time, cause: StopCause) {
        if !self.duty.latch().is_open() {
            return;
        }
        let stop = self.requested_stop();
        self.latch(cycle, now, cause);
        if self.duty.claim() != Claim::Found {
            self.brake(now, braked, stop);
        }
    }

    /// Stops the axis if it is enabled, or about to be; any other axis can do no harm.
    pub fn stop_if_armed(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        if self.is_armed() {
            self.stop(cycle, now, cause);
        }
    }

    /// It is enabled, or about to be, or the application commands its drive.
    pub(super) fn is_armed(&self) -> bool {
        let rising = self.duty.command() == Some(&Command::Enable);
        self.duty.claim() == Claim::Armed || rising || self.duty.follows().is_free
    }

    /// The stop of the axis, no softer than what was requested for the end of its motion, by the drive machine's
    /// command or by one that was accepted and is about to begin.
    fn requested_stop(&self) -> StopPlan {
        let accepted = self.queues.commands.iter().chain(&self.task_command);
        let accepted = accepted.filter(|queued| self.admit(queued).is_ok()).map(|queued| queued.command);
        let mut stop = self.plan.stop;
        for command in accepted.map(|command| self.bounded(command)).chain(self.machine.command()) {
            match command {
                Command::QuickStop if stop.how == StopHow::Ramp => stop.how = StopHow::Quick,
                Command::Disable => stop.then = StopThen::Disable,
                Command::Stop { deceleration: Some(own) } => stop.deceleration = stop.deceleration.max(own),
                _ => {}
            }
        }
        stop
    }

    /// Starts this stop of an axis that is latched.
    fn brake(&mut self, now: Time, braked: Braked, mut stop: StopPlan) {
        let Some(cause) = self.duty.latch().cause() else { return };
        // No ramp of velocities brakes a drive that follows torques: it would only lose its torque along the slope.
        let by_the_drive = braked == Braked::ByTheDrive || self.duty.is_under_torque();
        if by_the_drive && stop.how == StopHow::Ramp {
            stop.how = StopHow::Quick;
        }
        let (sequence, command) = StopSequence::start(stop, self.plan.load, now, self.speed());
        self.duty.set_latch(Latch::Down(cause, sequence));
        self.issue(Some(command));
    }

    /// Stops an axis that is latched and moves all the same. The first cause stays; the new one is reported.
    pub(super) fn stop_again(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        let speed = self.speed();
        if matches!(self.duty.latch(), Latch::Kept(_)) {
            return self.brake(now, Braked::ByTheDrive, self.plan.stop);
        }
        let command = match self.duty.sequence() {
            Some((_, sequence)) if sequence.is_down() => sequence.again(now, speed),
            _ => return,
        };
        self.watch.expect(Phase::Commanded);
        self.along = Along::All(cause);
        self.emit(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
        self.issue(Some(command));
    }

    /// Latches without touching the drive.
    fn latch(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.duty.set_latch(Latch::Kept(cause));
        self.requested = Requested::default();
        self.disarm();
        self.along = Along::All(cause);
        self.feedback.stopped = Some(cause);
        self.emit(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
    }

    /// It is no longer expected to stay in operation.
    pub(in crate::drive) fn disarm(&mut self) {
        if self.duty.claim() == Claim::Armed {
            self.duty.set_claim(Claim::Ours);
        }
    }

    /// Whether others may have to stop because of it.
    pub fn takes_along(&self) -> bool {
        !matches!(self.along, Along::Nobody)
    }

    /// Who has to stop because of it, once.
    pub fn take_along(&mut self) -> Along {
        std::mem::replace(&mut self.along, Along::Nobody)
    }

    /// The group call whose command has ended here before it was done.
    pub fn left_call(&self) -> Option<GroupCall> {
        self.left
    }

    /// The orderly end of the master: every axis is stopped and powered off, and nothing new begins. True once it
    /// is complete.
    pub fn shut_down(&mut self, cycle: &Cycle, now: Time, hurry: bool) -> bool {
        if self.ending == Ending::No {
            self.ending = Ending::Begun;
        }
        self.stop(cycle, now, StopCause::Shutdown);
        self.flush(cycle, now, Abort::Stopped(StopCause::Shutdown));
        if matches!(self.duty.latch(), Latch::Kept(_)) && self.duty.claim() != Claim::Found {
            self.brake(now, Braked::BySetpoints, self.plan.stop);
        }
        // Only ever read: not ours to power off.
        let Some((_, sequence)) = self.duty.sequence() else { return true };
        sequence.shut_down(now, self.feedback.status.state.is_powered());
        let command = if hurry { sequence.hurry(now) } else { None };
        let down = sequence.is_down();
        if command.is_some() {
            self.issue(command);
        }
        down
    }

    /// The buses begin to end their links.
    pub fn note_end(&mut self) {
        self.ending = Ending::Links { answers: self.answers() };
    }

    /// Nothing was requested of the drive since the wires were taken from the loop, and no report is from then.
    pub fn note_stuck(&mut self) {
        (self.ending, self.requested) = (Ending::Stuck, Requested::default());
    }

    /// How the drive is left, once the loop has ended.
    pub fn at_end(&self) -> Option<AtEnd> {
        let (seen_off, holds) = match self.duty.latch() {
            Latch::Down(_, sequence) => (sequence.is_seen_off(), sequence.holds_load()),
            _ => (false, false),
        };
        let known = LoopFacts {
            standstill: self.plan.stop.standstill,
            answers: match self.ending {
                Ending::No | Ending::Begun => self.answers(),
                Ending::Links { answers } => answers,
                Ending::Stuck => false,
            },
            ours: self.duty.claim() != Claim::Found,
            may_rise: self.rising > 0 && !seen_off,
            holds,
            requested: self.requested,
            stuck: self.ending == Ending::Stuck,
        };
        AtEnd::of(known, &self.feedback)
    }
}

/// The means that bring an axis to standstill.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Braked {
    /// The stop that its plan names: a ramp of setpoints, if it is one.
    BySetpoints,
    /// The quick stop of its drive, whatever its plan names.
    ByTheDrive,
}
