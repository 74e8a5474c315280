//! The application's end of one axis.
//!
//! An [`Axis`] is `Send` and not `Clone`: it is the one producer of its queues. Nothing here makes the loop wait; the
//! blocking conveniences sleep on the application's own thread.

use std::any::Any;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rtrb::{Consumer, Producer};
use thiserror::Error;

use super::acyclic::{Acyclic, Parameters};
use super::command::{
    Abort, Command, CommandId, Failure, GroupCall, Jog, Level, Move, Outcome, Profile, QueuedCommand, Row,
    Setpoint, StreamRow, Target,
};
use super::doorbell::Bell;
use super::event::{Event, EventKind};
use super::feedback::{BegunBy, Fault, FaultNames, Feedback, Link, StopCause};
use super::limits::{Lacks, check_command, check_level, check_row};
use super::newest::NewestIn;
use super::observer::{GRACE, Observer};
use super::plan::AxisPlan;
use super::pulse::Pulse;
use super::streams::Streams;

/// Places for commands that only a stop, quick stop or power off takes.
pub const URGENT_ROOM: usize = 4;

/// Places in the event queue for the ends of commands of the in-loop task: one runs, one waits.
pub(crate) const TASK_ROOM: usize = 2;

/// The most ends of commands that are kept for an application that takes none of its events.
const KEPT_ENDS: usize = 65_536;

/// Places in the event queue that only the ends of commands take: as many as commands can be under way, those that the
/// loop has taken out of its queue included.
pub fn room_for_ends(plan: &AxisPlan) -> usize {
    most_unended(plan) + TASK_ROOM
}

/// The most commands of the application that may be under way.
pub fn most_unended(plan: &AxisPlan) -> usize {
    plan.command_queue + URGENT_ROOM + 2
}

/// The feedback of every cycle, oldest first: an iterator that ends where the newest is taken, and goes on when there
/// is another one. A full queue loses the newest; the loop counts them.
#[derive(Debug)]
pub struct Samples(Consumer<Feedback>);

impl Samples {
    /// How many wait to be taken.
    pub fn waiting(&self) -> usize {
        self.0.slots()
    }
}

impl Iterator for Samples {
    type Item = Feedback;

    fn next(&mut self) -> Option<Feedback> {
        self.0.pop().ok()
    }
}

/// One axis of a running master: one owner commands it. Positions are in its units, mm or revolutions.
///
/// An axis that is dropped while it moves is stopped: [`AxisPlan::on_owner_lost`]. Observers and parameters of it are
/// no owners.
#[derive(Debug)]
pub struct Axis {
    plan: AxisPlan,
    /// The index in the machine.
    index: usize,
    /// The names of all axes of the machine.
    names: Arc<[String]>,
    pulse: Pulse,
    acyclic: Acyclic,
    pub(super) ends: AxisEnds,
    pub(super) next_id: CommandId,
    /// The last command that takes each kind of setpoint; id 0 = none.
    pub(super) follows: [CommandId; 2],
    /// Setpoints that were given so far.
    setpoints: u64,
    /// Commands whose ends were not taken out of the event queue yet: each has a place there.
    unended: usize,
    /// Events taken from the queue before the application took them, and how many of them are ends of commands.
    kept: VecDeque<Event>,
    kept_ends: usize,
    /// Kept events that the application did not take and that had to make room.
    dropped: u64,
    streams: Streams,
}

/// The application's ends of the queues of one axis.
#[derive(Debug)]
pub struct AxisEnds {
    /// Commands to the loop.
    pub commands: Producer<QueuedCommand>,
    /// To be rung after each command and each setpoint.
    pub bell: Bell,
    /// Rows to the loop.
    pub rows: Producer<StreamRow>,
    /// Velocity and torque setpoints to the loop.
    pub setpoints: NewestIn,
    /// Events from the loop.
    pub events: Consumer<Event>,
    /// The newest feedback.
    pub feedback: Observer,
    /// Every cycle's feedback, where the plan requests it.
    pub samples: Option<Consumer<Feedback>>,
    /// The protocol's own process data.
    pub native: Option<Box<dyn Any + Send>>,
    /// The protocol's names for the fault codes of its drives.
    pub faults: FaultNames,
    /// The capabilities that the drive lacks.
    pub lacks: Lacks,
}

/// Why a request to an axis failed.
#[derive(Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum AxisError {
    /// Refused on submission.
    #[error("axis {axis}: {command} refused: {failure}")]
    Refused {
        /// The axis.
        axis: String,
        /// The command.
        command: &'static str,
        /// Why.
        failure: Failure,
    },
    /// The queue has no room: the loop does not take commands, or they come faster than they can be executed.
    #[error(
        "axis {axis}: {command} refused: its queue of {capacity} is full; wait for earlier commands to end"
    )]
    Full {
        /// The axis.
        axis: String,
        /// The command.
        command: &'static str,
        /// Room of the queue.
        capacity: usize,
    },
    /// It ended in another way than Done.
    #[error("axis {axis}: {command} {}", text_of(*outcome, *fault, begun_by.as_deref()))]
    Ended {
        /// The axis.
        axis: String,
        /// The command.
        command: &'static str,
        /// The end.
        outcome: Outcome,
        /// The protocol's name for the fault of the drive, if that is the reason.
        fault: Option<&'static str>,
        /// The axis that began the stop which aborted it, by name, and why that was stopped, if it was stopped with its
        /// stop group.
        begun_by: Option<Box<(String, StopCause)>>,
    },
    /// It did not end in the given time. It continues: stop it, or wait longer.
    #[error("axis {axis}: {command} has not ended after {waited:?} (state {state}): stop it, or wait longer")]
    TimedOut {
        /// The axis.
        axis: String,
        /// The command.
        command: &'static str,
        /// How long the call waited.
        waited: Duration,
        /// The drive's state.
        state: super::State,
    },
    /// The master has ended.
    #[error("axis {axis}: the master has ended: start it again")]
    Gone {
        /// The axis.
        axis: String,
    },
    /// The loop's cycle does not end. Its watch has stopped what it can stop, and the run has failed.
    #[error("axis {axis}: {}; {}", STUCK, STUCK_REMEDY)]
    Stuck {
        /// The axis.
        axis: String,
    },
}
crate::debug_as_display!(AxisError);

fn text_of(outcome: Outcome, fault: Option<&str>, begun_by: Option<&(String, StopCause)>) -> String {
    let text = outcome.described(fault);
    match begun_by {
        Some((axis, cause)) => format!("{text}, begun by {axis}: {cause}"),
        None => text,
    }
}

/// The message of a loop that is stuck.
pub const STUCK: &str = "the loop is stuck: its cycle has not ended within watch_after (or \
     guardian_after), and the wires were taken from it";
/// The remedy for it.
pub const STUCK_REMEDY: &str = "look at the drives and at what holds the loop's thread up (the in-loop task, \
     a driver of the host, a debugger), and start the program again";

impl AxisError {
    /// It ended so only because another axis of its group did.
    pub(super) fn is_of_group(&self) -> bool {
        let AxisError::Ended { outcome, .. } = self else { return false };
        matches!(
            outcome,
            Outcome::Failed(Failure::GroupRefused) | Outcome::Aborted(Abort::Stopped(StopCause::Group))
        )
    }
}

impl Axis {
    /// Axis `index` of the machine with these names of its axes and this pulse, over its ends of the queues.
    #[doc(hidden)]
    pub fn new(
        plan: AxisPlan,
        (index, names): (usize, Arc<[String]>),
        pulse: Pulse,
        acyclic: Acyclic,
        ends: AxisEnds,
    ) -> Axis {
        Axis {
            plan,
            index,
            names,
            acyclic: acyclic.of_application(&pulse),
            pulse,
            ends,
            next_id: CommandId(1),
            follows: [CommandId(0); 2],
            setpoints: 0,
            unended: 0,
            kept: VecDeque::new(),
            kept_ends: 0,
            dropped: 0,
            streams: Streams::default(),
        }
    }

    /// The index in the machine, in the order of the plan.
    pub fn index(&self) -> usize {
        self.index
    }

    /// Whether both belong to one machine.
    pub(super) fn shares_machine(&self, other: &Axis) -> bool {
        self.pulse.is_same(&other.pulse)
    }

    /// The name.
    pub fn name(&self) -> &str {
        &self.plan.name
    }

    /// The plan.
    pub fn plan(&self) -> &AxisPlan {
        &self.plan
    }

    /// The capabilities that its drive lacks.
    #[doc(hidden)]
    pub fn lacks(&self) -> &Lacks {
        &self.ends.lacks
    }

    /// The profile of moves that name none.
    pub fn profile(&self) -> Profile {
        self.plan.profile
    }

    /// The newest feedback, with its cycle and age.
    pub fn feedback(&self) -> Feedback {
        self.ends.feedback.feedback()
    }

    /// A reader of the newest feedback, for any number of threads.
    pub fn observer(&self) -> Observer {
        self.ends.feedback.clone()
    }

    /// The feedback of every cycle, if the plan gave the axis a sample queue; can be taken once.
    pub fn samples(&mut self) -> Option<Samples> {
        self.ends.samples.take().map(Samples)
    }

    /// A fault code of its drive, as in [`DriveStatus::fault`](super::DriveStatus::fault) and [`EventKind::Fault`],
    /// with its name.
    pub fn fault(&self, code: u32) -> Fault<'static> {
        Fault::new(code, self.ends.faults)
    }

    /// The name of an axis of its machine, by its index there: [`BegunBy::axis`].
    pub fn name_of(&self, index: u16) -> Option<&str> {
        self.names.get(usize::from(index)).map(String::as_str)
    }

    /// The protocol's own process data, unscaled and complete, by the protocol's own type; can be taken once.
    ///
    /// `None` if it was taken before or is of another protocol.
    pub fn native<T: 'static>(&mut self) -> Option<Box<T>> {
        if !self.ends.native.as_ref()?.is::<T>() {
            return None;
        }
        self.ends.native.take()?.downcast().ok()
    }

    /// The drive's parameters, at addresses in its own notation. Clone the handle for as many threads as needed.
    pub fn parameter(&self) -> Parameters {
        self.acyclic.parameters()
    }

    /// Acyclic access below the parameters, for the services that only its protocol has.
    pub fn acyclic(&self) -> &Acyclic {
        &self.acyclic
    }

    /// The next event, if there is one.
    pub fn event(&mut self) -> Option<Event> {
        let kept = self.kept.pop_front();
        self.kept_ends -= usize::from(kept.as_ref().and_then(ended).is_some());
        kept.or_else(|| self.take_event())
    }

    /// Events that were kept, not taken, and dropped to make room for newer ones. The ends of commands are not among
    /// them, but for those that stop commands had to replace after 65 536 others.
    pub fn events_dropped(&self) -> u64 {
        self.dropped
    }

    /// Submits a command and returns at once. Its end is an [`EventKind::Ended`] with this id.
    pub fn post(&mut self, command: Command) -> Result<CommandId, AxisError> {
        self.accepts(&command)?;
        let command = self.command(command, None);
        self.send(&[command])?;
        Ok(self.sent(&command))
    }

    /// Whether `command` would be accepted now: its numbers, and room for its end. The last places are reserved for
    /// commands that stop the axis.
    pub(super) fn accepts(&mut self, command: &Command) -> Result<(), AxisError> {
        check_command(&self.plan, &self.ends.lacks, command)
            .map_err(|failure| self.refused(command.name(), failure))?;
        let most = most_unended(&self.plan) - if command.is_urgent() { 0 } else { URGENT_ROOM };
        if self.unended >= most {
            // The application takes no events: their places are needed.
            while let Some(event) = self.take_event() {
                self.keep(event);
            }
        }
        let unread = self.kept_ends >= KEPT_ENDS && !command.is_urgent();
        if unread || self.unended >= most {
            Err(self.full(command.name(), self.plan.command_queue))
        } else {
            Ok(())
        }
    }

    /// A command of this axis for a queue.
    pub(super) fn command(&self, command: Command, call: Option<GroupCall>) -> QueuedCommand {
        let stream = self.streams.to_follow;
        QueuedCommand { id: self.next_id, member: self.index as u32, command, stream, call }
    }

    /// Queues the parts of one call, all or none. The last places are reserved for calls that only stop.
    pub(super) fn send(&mut self, parts: &[QueuedCommand]) -> Result<(), AxisError> {
        self.is_served()?;
        let urgent = parts.iter().all(|part| part.command.is_urgent());
        let kept = if urgent { 0 } else { URGENT_ROOM * parts.len() };
        let room = self.ends.commands.slots() >= parts.len() + kept;
        if !room || self.ends.commands.push_entire_slice(parts).is_err() {
            let command = parts.first().map_or("", |part| part.command.name());
            return Err(self.full(command, self.plan.command_queue));
        }
        self.ends.bell.ring();
        Ok(())
    }

    /// Accounts for a command of this axis that was queued.
    pub(super) fn sent(&mut self, command: &QueuedCommand) -> CommandId {
        let QueuedCommand { id, command, .. } = *command;
        self.pulse.beat();
        self.unended += 1;
        self.next_id.0 += 1;
        for level in Level::ALL {
            if level.is_of(&command) {
                self.follows[level as usize] = id;
            }
        }
        if command == Command::Follow {
            self.streams.followed(id);
        }
        id
    }

    /// The velocity setpoint of a running [`Command::Velocity`] or [`Command::Jog`], user units/s. The newest counts.
    /// It has to be renewed before it is older than `setpoint_age` or the dead-man time of the axis.
    pub fn set_velocity(&mut self, velocity: f64) -> Result<(), AxisError> {
        self.set(Level::Velocity, velocity)
    }

    /// The torque setpoint of a running [`Command::Torque`], per cent of the rated torque. The newest counts. It has
    /// to be renewed before it is older than `setpoint_age`.
    pub fn set_torque(&mut self, torque: f64) -> Result<(), AxisError> {
        self.set(Level::Torque, torque)
    }

    fn set(&mut self, level: Level, value: f64) -> Result<(), AxisError> {
        self.accepts_level(level, value)?;
        let setpoint = self.setpoint(self.follows[level as usize], value, 1);
        self.give(&[setpoint]);
        Ok(())
    }

    /// The axis's part of a set of `parts` setpoints, for command `of`.
    pub(super) fn setpoint(&mut self, of: CommandId, value: f64, parts: usize) -> Setpoint {
        self.setpoints += 1;
        let (member, parts, number) = (self.index as u32, parts as u32, self.setpoints);
        Setpoint { member, parts, number, of, value }
    }

    /// Hands the parts of one set over, through this axis.
    pub(super) fn give(&mut self, parts: &[Setpoint]) {
        self.ends.setpoints.write(parts);
        self.ends.bell.ring();
        self.pulse.beat();
    }

    /// Whether this setpoint would be accepted now.
    pub(super) fn accepts_level(&self, level: Level, value: f64) -> Result<(), AxisError> {
        check_level(&self.plan, level, value).map_err(|failure| self.refused(level.name(), failure))?;
        self.is_served()
    }

    /// How many rows the stream has room for.
    pub fn stream_room(&self) -> usize {
        // What its queue has beyond that is for a group.
        let rows = &self.ends.rows;
        self.plan.stream_queue.saturating_sub(rows.buffer().capacity() - rows.slots())
    }

    /// Queues a row for [`Command::Follow`], one per exchange. Each row is checked against the limits.
    ///
    /// After a row marked `last`, and after the application has seen (by [`event`](Self::event) or during a wait)
    /// that the stream ended or the axis was stopped, rows belong to the next stream.
    pub fn push_row(&mut self, row: Row) -> Result<(), AxisError> {
        let row = self.row(row, 1)?;
        self.send_row(&[row])?;
        self.sent_row(&row);
        Ok(())
    }

    /// The axis's part of a row of `parts` members for a queue, if its numbers are within the limits.
    pub(super) fn row(&self, row: Row, parts: usize) -> Result<StreamRow, AxisError> {
        check_row(&self.plan, &row, self.streams.before).map_err(|failure| self.refused("row", failure))?;
        let (member, parts) = (self.index as u32, parts as u32);
        Ok(StreamRow { stream: self.streams.pushing, member, parts, row })
    }

    /// Queues the parts of one row, all or none.
    pub(super) fn send_row(&mut self, parts: &[StreamRow]) -> Result<(), AxisError> {
        self.is_served()?;
        self.ends.rows.push_entire_slice(parts).map_err(|_| self.full("row", self.plan.stream_queue))
    }

    /// Accounts for a row of this axis that was queued.
    pub(super) fn sent_row(&mut self, row: &StreamRow) {
        self.pulse.beat();
        self.streams.pushed(row.row);
    }

    /// Starts to follow the stream, whose first rows should be queued already. Ends with the row marked `last`.
    pub fn follow(&mut self) -> Result<CommandId, AxisError> {
        self.post(Command::Follow)
    }

    /// Enables the drive and waits until it is in operation.
    pub fn enable(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::Enable)
    }

    /// Powers the drive off and waits until it is off.
    pub fn disable(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::Disable)
    }

    /// Homes the axis and waits until homing is complete.
    pub fn home(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::Home)
    }

    /// Moves to `position` (user units) and waits until the motion has ended.
    pub fn move_to(&mut self, position: f64, profile: Profile) -> Result<(), AxisError> {
        self.carry_out(Command::Move(Move { target: Target::Absolute(position), profile }))
    }

    /// Moves by `distance` (user units) and waits until the motion has ended.
    pub fn move_by(&mut self, distance: f64, profile: Profile) -> Result<(), AxisError> {
        self.carry_out(Command::Move(Move { target: Target::Relative(distance), profile }))
    }

    /// Starts a constant velocity (user units/s); `stop` ends it. It has to be renewed by
    /// [`set_velocity`](Self::set_velocity) within the dead-man time of the axis, as long as the operator holds the
    /// button.
    pub fn jog(&mut self, velocity: f64) -> Result<CommandId, AxisError> {
        self.post(Command::Jog(Jog { velocity, acceleration: self.plan.profile.acceleration }))
    }

    /// Ramps down and waits for standstill; the drive stays enabled.
    pub fn stop(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::Stop { deceleration: None })
    }

    /// The drive's fastest controlled stop; waits for standstill. The drive stays enabled if it can.
    pub fn quick_stop(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::QuickStop)
    }

    /// Acknowledges a fault of the drive and waits until it is gone. The drive is off then.
    pub fn reset_fault(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::ResetFault)
    }

    /// Clears the latch of a stopped axis; waits for a stop sequence that is still running.
    pub fn reset(&mut self) -> Result<(), AxisError> {
        self.carry_out(Command::Reset)
    }

    /// Waits until the link is up.
    pub fn wait_online(&mut self, limit: Duration) -> Result<(), AxisError> {
        let begun = Instant::now();
        while self.feedback().link != Link::Online {
            if begun.elapsed() > limit {
                return Err(self.timed_out("wait_online", limit));
            }
            if self.ends.feedback.is_stuck() {
                return Err(self.stuck());
            }
            self.acyclic.rest();
        }
        Ok(())
    }

    /// The longest time that `command` should take, for the wait only.
    pub(super) fn time_limit(&self, command: &Command) -> Duration {
        let plan = &self.plan;
        match *command {
            Command::Move(Move { target, profile: Profile { velocity, acceleration, deceleration } }) => {
                let distance = match target {
                    Target::Absolute(position) => position - self.feedback().status.demand,
                    Target::Relative(distance) => distance,
                };
                let seconds = distance.abs() / velocity + velocity / acceleration + velocity / deceleration;
                // Twice as long as it should take.
                Duration::try_from_secs_f64(2.0 * seconds).unwrap_or(Duration::MAX / 4).saturating_add(GRACE)
            }
            Command::Home => plan.home_timeout,
            Command::Stop { .. } | Command::QuickStop => plan.stop.timeout + GRACE,
            Command::Reset => plan.stop.timeout * 2,
            _ => plan.enable_timeout,
        }
    }

    fn carry_out(&mut self, command: Command) -> Result<(), AxisError> {
        let limit = self.time_limit(&command);
        self.run(command, limit)
    }

    /// Posts `command` and waits for its end.
    pub fn run(&mut self, command: Command, limit: Duration) -> Result<(), AxisError> {
        let id = self.post(command)?;
        self.wait(id, command.name(), limit + GRACE)
    }

    /// Waits for the end of a posted command, and for the feedback of the cycle in which it ended: what it has reached,
    /// or the fault that ended it, is there afterwards. Other events are kept for [`event`](Self::event).
    pub fn wait(&mut self, id: CommandId, command: &'static str, limit: Duration) -> Result<(), AxisError> {
        let begun = Instant::now();
        loop {
            let gone = self.ends.events.is_abandoned();
            if let Some(event) = self.take_end(id) {
                self.await_feedback(event.cycle, begun, limit);
                return self.verdict(command, &event);
            }
            if gone {
                return Err(self.gone());
            }
            if self.ends.feedback.is_stuck() {
                return Err(self.stuck());
            }
            if begun.elapsed() > limit {
                return Err(self.timed_out(command, limit));
            }
            self.acyclic.rest();
        }
    }

    /// The end of a posted command, if it has come; that may have been during the wait for another one.
    fn take_end(&mut self, id: CommandId) -> Option<Event> {
        if let Some(place) = self.kept.iter().position(|event| ended(event) == Some(id)) {
            self.kept_ends -= 1;
            return self.kept.remove(place);
        }
        while let Some(event) = self.take_event() {
            if ended(&event) == Some(id) {
                return Some(event);
            }
            self.keep(event);
        }
        None
    }

    /// Events come before the feedback of their cycle: the rest of the cycle lies between the two.
    fn await_feedback(&self, cycle: u64, begun: Instant, limit: Duration) {
        let comes = || !self.ends.events.is_abandoned() && !self.ends.feedback.is_stuck();
        while self.feedback().cycle < cycle && comes() && begun.elapsed() <= limit {
            self.acyclic.rest();
        }
    }

    /// The text of `event`, the end of `command`.
    #[doc(hidden)]
    pub fn verdict(&self, command: &'static str, event: &Event) -> Result<(), AxisError> {
        let EventKind::Ended { outcome, .. } = event.kind else { return Ok(()) };
        if outcome == Outcome::Done {
            return Ok(());
        }
        let name = |by: BegunBy| self.name_of(by.axis).map_or_else(|| by.axis.to_string(), str::to_owned);
        Err(AxisError::Ended {
            axis: self.plan.name.clone(),
            command,
            outcome,
            fault: outcome.fault().and_then(self.ends.faults),
            begun_by: event.begun_by.map(|by| Box::new((name(by), by.cause))),
        })
    }

    fn take_event(&mut self) -> Option<Event> {
        let event = self.ends.events.pop().ok()?;
        // Those of the in-loop task have their own places.
        self.unended -= usize::from(ended(&event).is_some_and(|id| !id.is_of_task())).min(self.unended);
        self.streams.saw(&event);
        Some(event)
    }

    /// Bounded like the queue itself: an application that never takes events loses the oldest, and those that end no
    /// command before those that do.
    fn keep(&mut self, event: Event) {
        let others = self.kept.len() - self.kept_ends;
        let oldest = match others >= self.plan.event_queue {
            true => self.kept.iter().position(|event| ended(event).is_none()),
            false => (self.kept_ends > KEPT_ENDS + URGENT_ROOM).then_some(0),
        };
        if let Some(event) = oldest.and_then(|place| self.kept.remove(place)) {
            self.kept_ends -= usize::from(ended(&event).is_some());
            self.dropped += 1;
        }
        self.kept_ends += usize::from(ended(&event).is_some());
        self.kept.push_back(event);
    }

    fn refused(&self, command: &'static str, failure: Failure) -> AxisError {
        AxisError::Refused { axis: self.plan.name.clone(), command, failure }
    }

    fn full(&self, command: &'static str, capacity: usize) -> AxisError {
        AxisError::Full { axis: self.plan.name.clone(), command, capacity }
    }

    fn gone(&self) -> AxisError {
        AxisError::Gone { axis: self.plan.name.clone() }
    }

    fn stuck(&self) -> AxisError {
        AxisError::Stuck { axis: self.plan.name.clone() }
    }

    /// Whether there is a loop that takes what is queued.
    fn is_served(&self) -> Result<(), AxisError> {
        match () {
            () if self.ends.commands.is_abandoned() => Err(self.gone()),
            () if self.ends.feedback.is_stuck() => Err(self.stuck()),
            () => Ok(()),
        }
    }

    fn timed_out(&self, command: &'static str, waited: Duration) -> AxisError {
        AxisError::TimedOut {
            axis: self.plan.name.clone(),
            command,
            waited,
            state: self.feedback().status.state,
        }
    }
}

/// The last setpoint says that the axis has no owner any more. The bell orders it behind all that was posted before.
impl Drop for Axis {
    fn drop(&mut self) {
        let last = self.setpoint(CommandId::NO_OWNER, 0.0, 1);
        self.ends.setpoints.write(&[last]);
        self.ends.bell.ring();
    }
}

/// The command that has ended by this event.
fn ended(event: &Event) -> Option<CommandId> {
    if let EventKind::Ended { id, .. } = event.kind { Some(id) } else { None }
}
