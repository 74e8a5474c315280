//! The application's commands in their order, and what each of them waits for or replaces.

use super::watch::Braked;
use super::{Claim, DriveController, Latch, Owner};
use crate::axis::command::{Level, NativeOwner};
use crate::axis::doorbell::Bells;
use crate::axis::limits::{check_command, check_level, check_position};
use crate::axis::{
    Abort, Command, CommandId, Failure, GroupCall, Link, Load, Move, Outcome, OwnerLost, QueuedCommand, Row,
    Setpoint, State, StopCause, Target,
};
use crate::bus::{Cycle, Exchange, Slot};
use crate::drive::record::CommandStep;
use crate::drive::stop::deceleration_of;
use crate::time::{Time, nanos};

/// Takes what the application has posted into the queues of the axes, the parts of one call all at once.
///
/// The calls to groups that an axis was in stand in the queues of their first members: the ids of its commands are
/// their sequence. Bounded by the room in the queues of the axes: the application may go on posting.
#[inline]
pub fn take_commands(controllers: &mut [DriveController], bells: &mut Bells) {
    if bells.take() {
        take_posted(controllers, bells);
    }
}

/// Notes the axes that may have a newer setpoint; their commands are left where they are. Returns whether there may be
/// one.
#[inline]
pub fn take_calls(controllers: &mut [DriveController], bells: &mut Bells) -> bool {
    if bells.take() {
        bells.rung().for_each(|axis| controllers[axis].called = true);
    }
    bells.take_rung()
}

#[inline(never)]
fn take_posted(controllers: &mut [DriveController], bells: &mut Bells) {
    let mut again = true;
    while std::mem::take(&mut again) {
        for index in bells.rung() {
            controllers[index].called = true;
            while let Some(first) = controllers[index].queues.posted.entry(0) {
                let parts = first.call.map_or(1, |call| call.parts as usize);
                let next = (0..parts).all(|place| {
                    let command = controllers[index].queues.posted.entry(place);
                    command.is_some_and(|command| controllers[command.member as usize].takes(&command))
                });
                if !next {
                    break;
                }
                for _ in 0..parts {
                    if let Some(command) = controllers[index].queues.posted.pop() {
                        let axis = &mut controllers[command.member as usize];
                        (axis.called, axis.next_id) = (true, axis.next_id + 1);
                        axis.note(CommandStep::Taken, &command);
                        axis.queues.commands.push_back(command);
                    }
                }
                again = true;
            }
        }
    }
    // What cannot be taken yet is looked at again in the next cycle.
    bells.silence(|axis| !controllers[axis].queues.posted.is_empty());
}

impl DriveController {
    /// Whether `command` is the one that the application has posted to the axis after the last one that it took.
    fn takes(&self, command: &QueuedCommand) -> bool {
        command.id.0 == self.next_id && self.queues.commands.len() < self.queues.commands.capacity()
    }

    /// Drains the application's commands: ends the finished one, aborts those that an urgent one overtakes, starts
    /// the next. The command of a group is left to the group synchronisation.
    #[inline]
    pub fn exchange(&mut self, cycle: &Cycle, now: Time, slot: &Slot) {
        if self.called {
            self.exchange_all(cycle, now, slot);
        }
        if cycle.index >= self.ages_at {
            self.age_setpoint(cycle, now);
        }
    }

    /// Arms the next send at once if [`exchange`](Self::exchange) has nothing to do in this cycle, nor
    /// [`propose`](Self::propose), nor [`feed`](Self::feed). False: they are to be called.
    #[inline(always)] // Once for each axis and cycle.
    pub fn arm(&self, cycle: &Cycle, slot: &mut Slot) -> bool {
        let rests = !(self.called | self.takes_along() | self.follows_rows())
            && cycle.index < self.ages_at
            && self.feedback.link == Link::Online
            && self.machine.keeps(slot);
        if rests {
            (slot.due, slot.guarded) = (self.is_due(cycle.index + 1), self.is_guarded());
        }
        rests
    }

    #[inline(never)]
    fn exchange_all(&mut self, cycle: &Cycle, now: Time, slot: &Slot) {
        self.waiting = None;
        self.commanded = slot.commanded;
        let held = self.held.take();
        let leaves = self.owner != Owner::Here && self.lose_owner(cycle, now);
        if self.machine.end().is_some() || self.duty.command() == Some(&Command::Reset) {
            self.end_active(cycle, now);
        }
        if self.task_command.is_some() || !self.queues.commands.is_empty() {
            self.begin_next(cycle, now, held);
        }
        // What waits is looked at again in the next cycle.
        self.called = self.task_command.is_some()
            || !self.queues.commands.is_empty()
            || leaves
            || self.duty.command() == Some(&Command::Reset);
    }

    /// Ends what an application that has dropped the axis has left behind: what moves it or switches its power on,
    /// under way or about to be, unless a stop or power off of its own comes behind that. What the in-loop task
    /// commands has its owner. True while more may come that was posted before: the next cycle takes it.
    #[cold]
    fn lose_owner(&mut self, cycle: &Cycle, now: Time) -> bool {
        let left = std::mem::replace(&mut self.owner, Owner::Gone);
        if left == Owner::Leaves && !self.queues.posted.is_empty() {
            return true;
        }
        let queued = &self.queues.commands;
        let ends = |queued: &QueuedCommand| queued.command.is_urgent() && self.admit(queued).is_ok();
        let ended = queued.iter().rposition(ends).map_or(0, |place| place + 1);
        let own = (*self.duty.active()).filter(|active| ended == 0 && !active.id.is_of_task());
        let acts = |queued: &QueuedCommand| queued.command.acts();
        if self.plan.on_owner_lost == OwnerLost::Stop
            && (own.as_ref().is_some_and(acts) || queued.range(ended..).any(acts))
        {
            self.stop(cycle, now, StopCause::OwnerLost);
            // An axis that is latched already has nothing to be stopped; and nothing of this begins after a reset.
            while let Some(queued) = self.queues.commands.remove(ended) {
                self.end(cycle, now, queued, Outcome::Aborted(Abort::Stopped(StopCause::OwnerLost)));
            }
        }
        false
    }

    /// Begins those that may begin.
    #[inline(never)]
    fn begin_next(&mut self, cycle: &Cycle, now: Time, held: Option<(CommandId, Time)>) {
        self.overtake(cycle, now);
        for _ in 0..=self.queues.commands.len() {
            let next = self.task_command.or_else(|| self.queues.commands.front().copied());
            let Some(next) = next else { break };
            if self.duty.active().is_some_and(|active| !replaces(&next, &active)) {
                break;
            }
            if self.admit(&next) == Err(Failure::BeingWritten) {
                let since = held.filter(|(id, _)| *id == next.id).map_or(now, |(_, since)| since);
                // Too long, and it is refused below.
                if now.since(since) <= nanos(self.plan.enable_timeout) {
                    self.held = Some((next.id, since));
                    break;
                }
            }
            if next.call.is_some() && !next.command.is_urgent() {
                self.waiting = Some(next);
                break;
            }
            if next.call.is_none() && self.acts_in_group().is_some() && self.admit(&next).is_ok() {
                // A command that takes a member out of what its group does stops the group: the others would go on
                // without it.
                self.stop_by(Braked::BySetpoints, cycle, now, StopCause::GroupFailed);
                break;
            }
            if self.task_command.take().is_none() {
                self.queues.commands.pop_front();
            }
            // A refused command replaces nothing: the running one goes on, and its end is still reported.
            self.start(cycle, now, next, false);
        }
    }

    /// The group command that waits until all other members are ready for it.
    #[inline]
    pub fn waiting(&self) -> Option<GroupCall> {
        // What waits is looked at in each cycle.
        if self.called { self.waiting.and_then(|command| command.call) } else { None }
    }

    /// Whether its part of `call` is still to begin.
    pub fn holds(&self, call: GroupCall) -> bool {
        self.queues.commands.iter().any(|command| command.call == Some(call))
    }

    /// Whether the waiting command may begin.
    pub fn admits_waiting(&self) -> Result<(), Failure> {
        self.waiting.map_or(Ok(()), |command| self.admit(&command))
    }

    /// Begins the waiting command, unless it is refused to all members or may not begin at this one.
    pub fn take_waiting(&mut self, cycle: &Cycle, now: Time, refused: bool) {
        let Some(command) = self.waiting.take() else { return };
        self.called = true;
        self.queues.commands.pop_front();
        self.start(cycle, now, command, refused);
    }

    /// Ends the running command as its drive machine has ended it.
    #[inline(never)]
    fn end_active(&mut self, cycle: &Cycle, now: Time) {
        let Some(active) = *self.duty.active() else { return };
        if matches!(active.command, Command::Reset) {
            self.try_reset(cycle, now, active);
            return;
        }
        match self.machine.end() {
            None => {}
            Some(Ok(())) => {
                if matches!(active.command, Command::Enable) {
                    self.duty.set_claim(Claim::Armed);
                    self.watch.forget();
                }
                if matches!(active.command, Command::Enable | Command::Disable) {
                    // From here on the drive's report says it.
                    self.rising = 0;
                }
                self.end(cycle, now, active, Outcome::Done);
            }
            Some(Err(failure)) => {
                let grouped = self.acts_in_group().is_some();
                if matches!(failure, Failure::Unsupported(_) | Failure::DriveFault(_)) {
                    // Nothing was commanded, or a fault holds the power off.
                    self.rising = 0;
                }
                self.end(cycle, now, active, Outcome::Failed(failure));
                if matches!(active.command, Command::Stop { .. }) && self.duty.latch().is_open() {
                    // A ramp that the drive refuses becomes its quick stop, as in the stop sequence.
                    self.issue(Some(Command::QuickStop));
                }
                if matches!(failure, Failure::DriveFault(_)) {
                    self.stop_if_armed(cycle, now, StopCause::DriveFault);
                }
                if grouped {
                    // The others would go on without it, or be left in operation alone.
                    self.stop(cycle, now, StopCause::GroupFailed);
                }
            }
        }
    }

    /// An urgent command aborts everything before it in the queue.
    fn overtake(&mut self, cycle: &Cycle, now: Time) {
        let urgent = self.queues.commands.iter().rposition(|queued| queued.command.is_urgent());
        let Some(urgent) = urgent.map(|place| self.queues.commands[place].id) else { return };
        let replaced = Outcome::Aborted(Abort::Replaced(urgent));
        if let Some(command) = self.task_command.take() {
            self.end(cycle, now, command, replaced);
        }
        while let Some(command) = self.queues.commands.front().copied()
            && command.id != urgent
        {
            self.queues.commands.pop_front();
            self.end(cycle, now, command, replaced);
        }
    }

    /// Begins the command if it may begin here, and at all other members of its group.
    fn start(&mut self, cycle: &Cycle, now: Time, queued: QueuedCommand, refused: bool) {
        match self.admit(&queued) {
            Ok(()) if refused => self.end(cycle, now, queued, Outcome::Failed(Failure::GroupRefused)),
            Ok(()) => self.begin(cycle, now, queued),
            Err(failure) => self.end(cycle, now, queued, Outcome::Failed(failure)),
        }
    }

    fn begin(&mut self, cycle: &Cycle, now: Time, queued: QueuedCommand) {
        if let Some(active) = *self.duty.active() {
            self.end(cycle, now, active, Outcome::Aborted(Abort::Replaced(queued.id)));
        }
        self.duty.set_active(Some(queued));
        self.note(CommandStep::Begun, &queued);
        self.began = now;
        match queued.command {
            Command::Reset => self.try_reset(cycle, now, queued),
            Command::Disable => {
                self.disarm();
                self.issue(Some(Command::Disable));
            }
            command => {
                if let (Command::QuickStop, Some((_, sequence))) = (command, self.duty.sequence()) {
                    sequence.quicken();
                }
                if command == Command::Enable {
                    self.rising = FALLEN_REPORTS;
                }
                self.issue(Some(self.bounded(command)));
                // The first setpoint may come later: it has the whole age for that.
                (self.level_at, self.ages_at) = (cycle.index, 0);
                if self.ahead.of == queued.id {
                    self.set_level(cycle.index, self.ahead.value);
                }
            }
        }
    }

    /// A stop that ends within the stop's time-out, however weak a deceleration was requested.
    pub(super) fn bounded(&self, command: Command) -> Command {
        let Command::Stop { deceleration } = command else { return command };
        let requested = deceleration.unwrap_or(self.plan.profile.deceleration);
        Command::Stop { deceleration: Some(deceleration_of(&self.plan.stop, requested, self.speed())) }
    }

    /// Whether the command may start now. Its numbers were checked on submission; here the axis decides.
    pub(super) fn admit(&self, queued: &QueuedCommand) -> Result<(), Failure> {
        match (queued.command, self.duty.latch()) {
            (Command::Reset, _) | (_, Latch::Open) => {}
            (Command::ResetFault | Command::Disable | Command::Stop { .. } | Command::QuickStop, latch)
                if latch.is_settled() => {}
            // Sooner than the stop sequence would.
            (Command::QuickStop, Latch::Down(_, sequence)) if sequence.is_braking() => {}
            (_, Latch::Kept(cause) | Latch::Down(cause, _)) => return Err(Failure::Latched(*cause)),
        }
        let state = self.feedback.status.state;
        // In any state, given to the axis alone: in a group no member acts without the others.
        let native = |owner| queued.command == Command::Native(owner) && queued.call.is_none();
        match queued.command {
            Command::Reset if !self.duty.latch().is_settled() && !self.answers() => Err(Failure::NotOnline),
            Command::Reset => Ok(()),
            _ if self.feedback.link != Link::Online => Err(Failure::NotOnline),
            Command::Enable if self.feedback.status.sto_open => Err(Failure::StoOpen),
            Command::Enable if self.commanded => Err(Failure::BeingWritten),
            Command::Disable if self.plan.load != Load::Level && state.is_powered() && !self.stands() => {
                Err(Failure::LoadInMotion)
            }
            _ if !queued.command.moves() || native(NativeOwner::Application) => Ok(()),
            _ if state != State::OperationEnabled && !native(NativeOwner::Master) => {
                Err(Failure::WrongState(state))
            }
            _ if self.duty.claim() != Claim::Armed => Err(Failure::NotEnabled),
            Command::Home | Command::Native(_) => Ok(()),
            _ if self.plan.limits.position.is_some() && !self.feedback.status.homed => Err(Failure::NotHomed),
            Command::Move(Move { target: Target::Relative(distance), .. }) => {
                check_position(&self.plan.limits, self.feedback.status.demand + distance)
            }
            _ => Ok(()),
        }
    }

    /// The axis stands still, as far as it is known: nothing moves it, and the drive's report is current.
    fn stands(&self) -> bool {
        let moved = self.duty.command().is_some_and(Command::moves);
        let slow = self.feedback.status.velocity.abs() <= self.plan.stop.standstill;
        !moved && !self.feedback.status.moving && slow && self.feedback.age < self.plan.divisor
    }

    /// The latch opens once the stop sequence is complete.
    fn try_reset(&mut self, cycle: &Cycle, now: Time, queued: QueuedCommand) {
        if !self.duty.latch().is_settled() {
            if !self.answers() {
                // The sequence waits for the drive; so would the reset.
                self.end(cycle, now, queued, Outcome::Failed(Failure::NotOnline));
            }
            return;
        }
        let found = matches!(self.duty.latch(), Latch::Kept(_));
        if found && self.feedback.link == Link::Online && self.feedback.status.state.is_powered() {
            // A drive that was only read until now: from here on it is ours, in its present state. It moves only
            // after an Enable, which changes nothing of a drive in operation.
            self.issue(None);
        }
        self.duty.set_latch(Latch::Open);
        (self.feedback.stopped, self.feedback.begun_by) = (None, None);
        self.end(cycle, now, queued, Outcome::Done);
    }

    /// Gives the drive machine a command, in place of the one before; `None`: to take the drive over as it is.
    pub(super) fn issue(&mut self, command: Option<Command>) {
        if self.duty.claim() == Claim::Found {
            self.duty.set_claim(Claim::Ours);
        }
        self.machine.start(self.grid, command);
        self.duty.set_ordered(command);
        self.requested.note(command);
        self.row_waits = false;
    }

    /// Writes what is desired of the drive with the send of `next`, if one is due then.
    #[inline]
    pub fn propose(&mut self, next: &Cycle, slot: &mut Slot) {
        if slot.due || slot.exchange == Exchange::Queued {
            self.called |= self.machine.propose(next.grid, slot);
        }
    }

    /// For the in-loop task: a command to be taken in this cycle, before the queue. Whether the application has left
    /// room for its end passes `room`.
    pub fn command_from_task(
        &mut self,
        cycle: &Cycle,
        now: Time,
        queued: QueuedCommand,
        room: impl FnOnce(bool) -> bool,
    ) -> Result<(), Failure> {
        if self.task_command.is_some_and(|waiting| !queued.command.is_urgent() || waiting.command.is_urgent())
        {
            return Err(Failure::Unsupported("the in-loop task may give one command per axis and cycle"));
        }
        check_command(&self.plan, self.machine.lacks(), &queued.command)?;
        if self.moves_in_group().is_some() && !queued.command.is_urgent() {
            return Err(Failure::Unsupported(
                "the axis moves in a group: only a stop can be given to it alone",
            ));
        }
        if !queued.command.is_urgent() && !room(self.queues.events.slots() > self.queues.room_for_ends) {
            return Err(Failure::Unsupported(
                "the application takes no events: there is no room for its end",
            ));
        }
        self.called = true;
        self.note(CommandStep::Taken, &queued);
        // A stop does not wait for the commands before it.
        if let Some(waiting) = self.task_command.replace(queued) {
            self.end(cycle, now, waiting, Outcome::Aborted(Abort::Replaced(queued.id)));
        }
        Ok(())
    }

    /// For the in-loop task: the row of the next send.
    pub fn row_from_task(&mut self, row: Row) {
        self.task_row = Some(row);
    }

    /// For the in-loop task: the velocity or torque of the next send. It is for the command that begins now, or else
    /// for the running one; a command that takes no such setpoints ignores it.
    pub fn level_from_task(&mut self, cycle: u64, level: Level, value: f64) -> Result<(), Failure> {
        check_level(&self.plan, level, value)?;
        let queued = self.task_command.or(*self.duty.active());
        if let Some(queued) = queued.filter(|queued| level.is_of(&queued.command)) {
            self.take_setpoint(cycle, Setpoint { of: queued.id, value, ..Setpoint::default() });
        }
        Ok(())
    }
}

/// After an enable that did not come to its end, so many reports without power show that its last control word had no
/// effect: reports may be two exchanges older than the word.
const FALLEN_REPORTS: u8 = 4;

/// Whether `next` replaces the running `active` at once. Streams run one after the other.
fn replaces(next: &QueuedCommand, active: &QueuedCommand) -> bool {
    let streams = matches!(active.command, Command::Follow) && matches!(next.command, Command::Follow);
    next.command.is_urgent() || active.command.is_motion() && next.command.is_motion() && !streams
}
