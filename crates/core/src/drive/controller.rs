//! The loop's side of one axis: its queues, the running command, its setpoints, its latch and the stop sequence.
//!
//! | file | what |
//! |---|---|
//! | `controller` | one cycle of it, what it publishes, and the ends of its commands |
//! | `judge` | what was sent and received: the end of the exchange, which reports count, the status, the link |
//! | `watch` | what the drive must not do, and stopping |
//! | `duty` | who owns the drive, whether it is stopped, and which command runs |
//! | `commands` | the application's commands in their order |
//! | `setpoints` | rows, velocities and torques for the next send |

mod commands;
mod duty;
mod judge;
mod setpoints;
mod watch;

pub use self::commands::{take_calls, take_commands};
pub use self::setpoints::{Counts, take_rows};
pub use super::health::Probes;

use std::collections::VecDeque;
use std::mem::offset_of;

use rtrb::Producer;

use self::duty::{Claim, Duty, Latch};
use self::setpoints::Follow;
use super::at_end::Requested;
use super::health::LinkHealth;
use super::journal::{Journal, Note};
use super::machine::Machine;
use super::numbers::{DriveNumbers, Extent, Largest};
use super::record::{CommandRecord, CommandStep, DriveRecord, EventRecord, Measured, MonitorRecord, Reply};
use super::watch::{Phase, Watch};
use crate::axis::cell::Writer;
use crate::axis::newest::NewestOut;
use crate::axis::{
    Abort, AxisPlan, Command, CommandId, Event, EventKind, Feedback, GroupCall, MONITOR_CHANNELS, Outcome,
    QueuedCommand, Row, Setpoint, StopCause, StreamRow,
};
use crate::bus::desired::Capabilities;
use crate::bus::{Cycle, Slot};
use crate::inputs::{Inlet, InputLog};
use crate::rt::Regions;
use crate::time::Time;

/// The ends of the queues that the loop holds for one axis.
#[derive(Debug)]
pub struct Queues {
    /// Every cycle's feedback, where the plan requests it.
    pub samples: Option<Producer<Feedback>>,
    /// Commands that the application has posted, to the axis or to the group that it leads.
    pub posted: Inlet<QueuedCommand>,
    /// Commands to the axis, taken out of its own queue and out of those of its groups.
    pub commands: VecDeque<QueuedCommand>,
    /// Rows of the application's stream, or of the stream of the group that it leads.
    pub rows: Inlet<StreamRow>,
    /// The newest velocity or torque setpoints of the application, to the axis or to the group that it leads.
    pub setpoints: NewestOut,
    /// Events to the application.
    pub events: Producer<Event>,
    /// Places among them that only the ends of commands take.
    pub room_for_ends: usize,
    /// The inputs of the loop.
    pub log: InputLog,
    /// Commands and events for the telemetry.
    pub journal: Journal,
}

/// The loop's state of one axis.
///
/// What each cycle touches lies on as few cache lines as possible: one that all stages look at, with the head of the
/// duty; one of the link and of the largest times, with the head of the health; the end of the watch and the feedback
/// up to its status; the beginning of the machine. The rest lies between and behind them.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct DriveController {
    /// The slot from which on the setpoint of the running command may be too old. It saves 51 instructions a drive and
    /// cycle at a velocity, and 8 at rest.
    ages_at: u64,
    /// Something is to be looked at with the next commands: its bell has rung, or a command waits. It saves 55
    /// instructions a drive and cycle.
    called: bool,
    /// The exchange waits for its turn on a half-duplex wire.
    queued: bool,
    /// Who stops with it, since the loop last checked.
    along: Along,
    /// Reports of a drive without power until an enable that did not end as done can no longer bring it on.
    rising: u8,
    /// The given row has not been sent yet (its slot was passed over): it must not be replaced.
    row_waits: bool,
    /// The monitored variables of this cycle are there.
    shows: bool,
    /// The monitored variables that the feedback has, a bit each.
    shown: u8,
    /// Each feedback goes into a queue, too: the plan requests it.
    has_samples: bool,
    /// The measurements of this cycle, for the telemetry.
    measured: Measured,
    /// How long after its grid point the previous request left; [`NEVER`](Self::NEVER): none has left.
    phase_ns: u64,
    /// The newest feedback.
    outlet: Writer<Feedback>,
    duty: Duty,
    /// The largest times.
    largest: Largest,
    /// The slot of the grid that was evaluated last.
    grid: Time,
    /// The slot in which the velocity or torque of the running command came.
    level_at: u64,
    health: LinkHealth,
    /// From one row to the next, s.
    row_seconds: f64,
    /// When the running command began.
    began: Time,
    /// The number of the newest setpoint of the application.
    numbered: u64,
    /// The id of the next command of the application.
    next_id: u64,
    watch: Watch,
    feedback: Feedback,
    machine: Machine,
    queues: Queues,
    plan: AxisPlan,
    /// A command of the in-loop task, to be taken before the queue.
    task_command: Option<QueuedCommand>,
    /// A row of the in-loop task, to be taken before the stream.
    task_row: Option<Row>,
    /// The group command at the head of the queue that could begin.
    waiting: Option<QueuedCommand>,
    follow: Follow,
    /// The newest velocity or torque for a command to come.
    ahead: Setpoint,
    /// The group call whose command ended here before it was done.
    left: Option<GroupCall>,
    /// A call of the application that commands the drive is under way.
    commanded: bool,
    /// Whether the application still has the axis.
    owner: Owner,
    /// The enable that waits for its end, and since when.
    held: Option<(CommandId, Time)>,
    /// Times that the link was lost.
    losses: u64,
    /// Events and samples for which there was no room, since the loop last took their number.
    lost: u64,
    ending: Ending,
    /// The requests to the drive since its axis was stopped.
    requested: Requested,
    /// The number of exchanges missed in this cycle, where some were of earlier ones.
    misses: u32,
    /// The slots of the largest times.
    largest_in: Largest,
    /// The monitored variables since the start.
    monitor: [Option<Extent>; MONITOR_CHANNELS],
}

// Each group begins or ends with a cache line.
const _: () = {
    assert!((offset_of!(DriveController, duty) + Duty::USUAL).is_multiple_of(64));
    assert!(offset_of!(DriveController, largest).is_multiple_of(64));
    assert!((offset_of!(DriveController, health) + LinkHealth::USUAL).is_multiple_of(64));
    assert!((offset_of!(DriveController, watch) + Watch::USUAL).is_multiple_of(64));
    assert!((offset_of!(DriveController, feedback) + offset_of!(Feedback, status)).is_multiple_of(64));
};

/// Who stops with an axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Along {
    /// Nothing has happened.
    Nobody,
    /// It has left what its group does: its stop group, it included, if another member still does that.
    WhoGoesOn,
    /// It was stopped, for this reason: its stop group.
    All(StopCause),
}

/// Whether the application still has the axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Owner {
    Here,
    /// It has dropped it; what it has posted before may still wait in its queue.
    Leaves,
    /// All that it has posted before was taken, as far as there was room for it.
    Gone,
}

/// How far the end of the run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    No,
    /// The orderly end has begun.
    Begun,
    /// The buses end their links. Its own was up when they began, or not.
    Links {
        answers: bool,
    },
    /// The wires were taken from the loop.
    Stuck,
}

impl DriveController {
    /// No time.
    const NEVER: u64 = u64::MAX;

    /// A controller for the axis of `plan`.
    pub fn new(
        plan: AxisPlan,
        can: Capabilities,
        (outlet, queues): (Writer<Feedback>, Queues),
        period_ns: u64,
        first_probe: u64,
        silence: u64,
        probes: Probes,
    ) -> DriveController {
        let interval_ns = period_ns.saturating_mul(plan.divisor.into());
        let watch = Watch::new(&plan, interval_ns, can.behind_ns, can.power_reports);
        let machine = Machine::new(&plan, can, period_ns);
        let row_seconds = period_ns as f64 * f64::from(plan.divisor) * 1e-9;
        let (divisor, phase) = (plan.divisor, plan.phase);
        let health = LinkHealth::new(plan.health, divisor, phase, period_ns, first_probe, silence, probes);
        DriveController {
            ages_at: u64::MAX,
            called: false,
            queued: false,
            along: Along::Nobody,
            rising: 0,
            row_waits: false,
            shows: false,
            shown: 0,
            has_samples: queues.samples.is_some(),
            measured: Measured::default(),
            phase_ns: DriveController::NEVER,
            outlet,
            duty: Duty::default(),
            largest: Largest::default(),
            grid: Time(0),
            level_at: 0,
            health,
            row_seconds,
            began: Time(0),
            numbered: 0,
            next_id: 1,
            watch,
            feedback: Feedback::default(),
            machine,
            queues,
            plan,
            task_command: None,
            task_row: None,
            waiting: None,
            follow: Follow::default(),
            ahead: Setpoint::default(),
            left: None,
            commanded: false,
            owner: Owner::Here,
            held: None,
            losses: 0,
            lost: 0,
            ending: Ending::No,
            requested: Requested::default(),
            misses: 0,
            largest_in: Largest::default(),
            monitor: [None; MONITOR_CHANNELS],
        }
    }

    /// Adds the memory that it touches besides itself and its rings, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.outlet.memory(regions);
        self.queues.setpoints.memory(regions);
    }

    /// The plan of the axis.
    pub fn plan(&self) -> &AxisPlan {
        &self.plan
    }

    /// The feedback as last published.
    pub fn feedback(&self) -> &Feedback {
        &self.feedback
    }

    /// Whether the power of the drive is on, or may come on by an order of this master: the drive reports it, it was
    /// commanded on and is not known to be off again, its stop sequence has not ended, or an enable waits. The
    /// application's own control word is the application's concern.
    #[inline]
    pub fn is_guarded(&self) -> bool {
        let on = self.duty.claim() == Claim::Armed
            || self.feedback.status.state.is_powered()
            || self.rising > 0
            || self.held.is_some()
            || !self.duty.latch().is_settled();
        on && !self.duty.follows().is_free
    }

    /// The link was up before it was evaluated last.
    pub fn was_online(&self) -> bool {
        self.measured.was_online
    }

    /// Whether an exchange is due in slot `index`.
    #[inline]
    pub fn is_due(&self, index: u64) -> bool {
        self.health.is_due(index)
    }

    /// Evaluates this cycle, what was sent included, and watches the axis. Returns the result of the exchange.
    #[inline(always)] // Once for each axis and cycle.
    pub fn evaluate(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        if std::mem::take(&mut slot.due) || self.queued {
            self.sent(cycle, slot);
        }
        self.evaluate_received(cycle, now, slot)
    }

    /// The same of what was received.
    #[inline(always)] // As `evaluate`.
    fn evaluate_received(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        match self.judge_usual(cycle, now, slot) {
            Some(reply) => {
                self.watch(cycle, now, slot, true, false);
                reply
            }
            None => self.evaluate_otherwise(cycle, now, slot),
        }
    }

    /// The same of a cycle with another end than the usual one.
    #[inline(never)]
    fn evaluate_otherwise(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        let reply = self.judge(cycle, now, slot);
        let fresh = slot.notices.fresh;
        let restarted = fresh && std::mem::take(&mut slot.notices.restarted);
        self.watch(cycle, now, slot, fresh, restarted);
        reply
    }

    /// The group of its running motion.
    pub fn moves_in_group(&self) -> Option<GroupCall> {
        self.acts_in_group().filter(|_| self.duty.command() != Some(&Command::Enable))
    }

    /// The group of its running motion, or of the enable before it.
    pub fn acts_in_group(&self) -> Option<GroupCall> {
        self.duty.active().filter(|active| active.command.acts()).and_then(|active| active.call)
    }

    /// Something is to be looked at with the next commands.
    #[inline]
    pub fn is_called(&self) -> bool {
        self.called
    }

    /// How many exchanges were missed in this cycle, in which one was; once.
    pub fn take_misses(&mut self) -> u64 {
        std::mem::take(&mut self.misses).max(1).into()
    }

    /// The result of the exchange of this cycle, until its record is published.
    pub fn reply(&self) -> Reply {
        self.measured.reply
    }

    /// Publishes the feedback; returns the telemetry record of this cycle, as that of axis `axis`. `noted` becomes true
    /// if there are notes for the telemetry, or losses.
    #[inline(always)] // Its record is built in the ring.
    pub fn publish(&mut self, axis: u16, noted: &mut bool) -> DriveRecord {
        self.feedback.write_to(&mut self.outlet, self.shows, self.shown);
        if self.has_samples {
            self.publish_sample();
        }
        *noted |= self.measured.noted;
        let command = self.duty.follows().command;
        DriveRecord::new(axis, command, std::mem::take(&mut self.measured), &self.feedback)
    }

    #[inline(never)]
    fn publish_sample(&mut self) {
        if let Some(samples) = &mut self.queues.samples
            && samples.push(self.feedback).is_err()
        {
            self.lost += 1;
            self.measured.noted = true;
        }
    }

    /// The drive has reported monitored variables in this cycle.
    #[inline]
    pub fn shows(&self) -> bool {
        self.shows
    }

    /// The monitored variables of this cycle for the telemetry, if the drive reported some; once.
    #[inline]
    pub fn take_shown(&mut self, axis: u16) -> Option<MonitorRecord> {
        let Feedback { cycle, status, .. } = &self.feedback;
        let shown = std::mem::take(&mut self.shows).then(|| status.monitor.into())?;
        Some(MonitorRecord { index: *cycle, axis, shown })
    }

    /// The oldest of its notes, as one of axis `axis`.
    pub fn take_note(&mut self, axis: u16) -> Option<Note> {
        self.queues.journal.take(axis, self.feedback.cycle)
    }

    /// How many notes found no room since the last call.
    pub fn take_lost_notes(&mut self) -> u64 {
        self.queues.journal.take_lost()
    }

    /// How many events and samples found no room in the queues since the last call.
    pub fn take_lost(&mut self) -> u64 {
        std::mem::take(&mut self.lost)
    }

    /// The loop's counts of it so far, with those of its bus.
    pub fn numbers(&self, slot: &Slot) -> DriveNumbers {
        let DriveController { losses, largest, largest_in, monitor, .. } = *self;
        DriveNumbers { counters: slot.counters, losses, peaks: largest.peaks(&largest_in), monitor }
    }

    /// Ends everything that the application has requested.
    fn flush(&mut self, cycle: &Cycle, now: Time, why: Abort) {
        if let Some(active) = *self.duty.active() {
            self.end(cycle, now, active, Outcome::Aborted(why));
        }
        if let Some(command) = self.task_command.take() {
            self.end(cycle, now, command, Outcome::Aborted(why));
        }
        self.waiting = None;
        while let Some(command) = self.queues.commands.pop_front() {
            self.end(cycle, now, command, Outcome::Aborted(why));
        }
        // Of every stream: the application counts on from the stop.
        self.drop_rows(u32::MAX - 1);
    }

    fn end(&mut self, cycle: &Cycle, now: Time, queued: QueuedCommand, outcome: Outcome) {
        if matches!(queued.command, Command::Follow) {
            self.drop_rows(queued.stream);
        }
        if self.duty.active().is_some_and(|active| active.id == queued.id) {
            self.duty.set_active(None);
            self.settle(now, &queued.command, outcome);
            if outcome != Outcome::Done {
                // The drive may still be braking.
                self.watch.expect(Phase::Failed);
                self.leave(&queued);
            }
        }
        let kind = EventKind::Ended { id: queued.id, command: queued.command.name(), outcome };
        let record = EventRecord::ended(cycle.index, queued.id, queued.command.code(), outcome);
        self.emit_as(cycle, now, kind, record);
    }

    /// The running command ends before it is done: the other members of its group must not go on without it.
    fn leave(&mut self, queued: &QueuedCommand) {
        if queued.call.is_some() && queued.command.acts() && self.along == Along::Nobody {
            (self.left, self.along) = (queued.call, Along::WhoGoesOn);
        }
    }

    /// Notes for the telemetry that a command was taken, or begins.
    fn note(&mut self, step: CommandStep, queued: &QueuedCommand) {
        self.queues.journal.note(Note::Command(CommandRecord::new(step, queued)));
        self.measured.noted = true;
    }

    fn emit(&mut self, cycle: &Cycle, now: Time, kind: EventKind) {
        self.emit_as(cycle, now, kind, EventRecord::new(cycle.index, 0, kind, None));
    }

    /// The same, with its record but for who has begun it.
    #[inline(never)]
    fn emit_as(&mut self, cycle: &Cycle, now: Time, kind: EventKind, record: EventRecord) {
        let begun_by = self.feedback.begun_by.filter(|_| kind.is_of_stop_group());
        self.queues.journal.note(Note::Event(record.begun(begun_by)));
        self.measured.noted = true;
        // Every accepted command ends exactly once: the place for that is kept from all else.
        let kept = if matches!(kind, EventKind::Ended { .. }) { 0 } else { self.queues.room_for_ends };
        let room = self.queues.events.slots() > kept;
        if !room || self.queues.events.push(Event { cycle: cycle.index, at: now, kind, begun_by }).is_err() {
            self.lost += 1;
        }
    }
}

#[cfg(test)]
pub(super) mod tests;
