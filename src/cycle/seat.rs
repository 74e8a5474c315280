//! The loop's side of one axis: its queues, the command that runs, its stream, its latch and the ladder.

use rtrb::{Consumer, Producer};

use super::health::LinkHealth;
use super::ladder::{Ladder, Sight};
use crate::axis::cell::Writer;
use crate::axis::command::NativeOwner;
use crate::axis::limits::{check_braking, check_row, check_speed, check_verb};
use crate::axis::{
    Abort, AxisPlan, Command, CommandId, Event, EventKind, Failure, Feedback, FoundRunning, Link, Outcome,
    Row, State, StopCause, StreamRow, Underrun, Verb,
};
use crate::bus::{Cycle, Exchange, NumberedRow, Order, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// The ends of the queues that the loop holds for one axis.
#[derive(Debug)]
pub struct Queues {
    /// Commands of the application.
    pub commands: Consumer<Command>,
    /// Rows of the application's stream.
    pub rows: Consumer<StreamRow>,
    /// Events to the application.
    pub events: Producer<Event>,
    /// The newest feedback.
    pub feedback: Writer<Feedback>,
    /// Every cycle's feedback, where asked for.
    pub samples: Option<Producer<Feedback>>,
}

/// What the loop keeps of one axis.
#[derive(Debug)]
pub struct Seat {
    plan: AxisPlan,
    queues: Queues,
    health: LinkHealth,
    feedback: Feedback,
    /// The command that runs.
    active: Option<Command>,
    serial: u64,
    /// A command of the in-loop task, to be taken before the queue.
    task_command: Option<Command>,
    /// A row of the in-loop task, to be taken before the stream.
    task_row: Option<Row>,
    follow: Follow,
    /// Enable was done: the drive is expected to stay in operation.
    armed: bool,
    latch: Option<(StopCause, Option<Ladder>)>,
    /// The slot from which the values of the feedback are.
    fresh_at: u64,
    /// The drive was online at least once.
    seen: bool,
    /// Stopped since the loop last asked: its group goes with it.
    just_stopped: bool,
    /// Times that the link was lost.
    pub losses: u64,
    /// Events that found their queue full.
    pub lost_events: u64,
    /// Samples that found their queue full.
    pub lost_samples: u64,
}

/// The first row may be so many rows' ways ahead of the demand: the reply is one old, and a drive's output runs behind its
/// setpoints.
const FIRST_ROW_AHEAD: f64 = 4.0;

/// Where an axis is in its stream.
#[derive(Clone, Copy, Debug, Default)]
struct Follow {
    /// Number of the last row given to the station.
    number: u64,
    /// The last row; `None` before the first.
    last: Option<Row>,
    /// Exchanges in a row for which the stream had nothing.
    empty: u32,
    /// The row given has not been sent yet (its slot was passed over): it must not be replaced.
    held: bool,
}

impl Seat {
    /// A seat for the axis of `plan`.
    pub fn new(plan: AxisPlan, queues: Queues, period_ns: u64, first_probe: u64) -> Seat {
        let health = LinkHealth::new(plan.health, plan.divisor, plan.phase, period_ns, first_probe);
        Seat {
            plan,
            queues,
            health,
            feedback: Feedback::default(),
            active: None,
            serial: 0,
            task_command: None,
            task_row: None,
            follow: Follow::default(),
            armed: false,
            latch: None,
            fresh_at: 0,
            seen: false,
            just_stopped: false,
            losses: 0,
            lost_events: 0,
            lost_samples: 0,
        }
    }

    /// Adds what it touches besides itself and its rings, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.queues.feedback.memory(regions);
    }

    /// The plan of the axis.
    pub fn plan(&self) -> &AxisPlan {
        &self.plan
    }

    /// The feedback as last published.
    pub fn feedback(&self) -> &Feedback {
        &self.feedback
    }

    /// Whether an exchange is due in slot `index`.
    pub fn is_due(&self, index: u64) -> bool {
        self.health.is_due(index)
    }

    /// After the send stage: the request of slot `index` went out, or was tried.
    pub fn sent(&mut self, index: u64, slot: &Slot) {
        self.health.asked(index);
        // A row that the operating system refused is sent with the next request.
        self.follow.held &= slot.exchange == Exchange::Unsent;
    }

    /// Judges this cycle's exchange, updates the feedback, and notices what changed. Returns a round-trip time to record.
    pub fn judge(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Option<u32> {
        let mut rtt = None;
        match slot.exchange {
            Exchange::Idle => {}
            Exchange::Owed { reply_by, .. } if reply_by > cycle.deadline => {}
            Exchange::Owed { .. } => {
                slot.counters.missed += 1;
                slot.exchange = Exchange::Missed;
                self.health.missed(cycle.index, self.seen);
            }
            Exchange::Missed => {}
            Exchange::Unsent => {
                slot.exchange = Exchange::Idle;
                self.health.missed(cycle.index, self.seen);
            }
            Exchange::Answered { sent_at, at, suspect } => {
                slot.exchange = Exchange::Idle;
                self.health.answered();
                if !suspect {
                    rtt = Some(u32::try_from(at.since(sent_at)).unwrap_or(u32::MAX));
                }
            }
        }
        self.take_report(cycle, now, slot, rtt);
        self.take_link(cycle, now, slot);
        rtt
    }

    /// The drive's report into the feedback, with an event for each change.
    fn take_report(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, rtt: Option<u32>) {
        let report = &mut slot.report;
        let before = self.feedback;
        self.feedback.cycle = cycle.index;
        if !report.fresh {
            let age = cycle.index.saturating_sub(self.fresh_at);
            self.feedback.age = u32::try_from(age).unwrap_or(u32::MAX);
            return;
        }
        self.fresh_at = cycle.index - u64::from(report.suspect).min(cycle.index);
        self.feedback = Feedback {
            cycle: cycle.index,
            age: u32::from(report.suspect),
            at: report.at,
            link: before.link,
            state: report.state,
            stopped: before.stopped,
            homed: report.homed,
            moving: report.moving,
            in_target: report.in_target,
            suspect: report.suspect,
            position: report.position,
            demand: report.demand,
            velocity: report.velocity,
            current: report.current,
            warning: report.warning,
            fault: report.fault,
            rtt_ns: rtt.or(before.rtt_ns),
        };
        if std::mem::take(&mut report.restarted) {
            self.tell(cycle, now, EventKind::Restarted);
        }
        if before.state != self.feedback.state {
            self.tell(cycle, now, EventKind::State(self.feedback.state));
        }
        if before.fault != self.feedback.fault {
            self.tell(cycle, now, EventKind::Fault(self.feedback.fault));
        }
        if before.warning != self.feedback.warning {
            self.tell(cycle, now, EventKind::Warning(self.feedback.warning));
        }
    }

    /// The link as judged: events, loss, and a drive found running.
    fn take_link(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let (before, link) = (self.feedback.link, self.health.link());
        if before == link {
            return;
        }
        self.feedback.link = link;
        slot.link = link;
        self.tell(cycle, now, EventKind::Link(link));
        self.losses += u64::from(link == Link::Lost && before == Link::Online);
        match link {
            Link::Lost if self.latch.is_none() && before == Link::Online => {
                self.stop(cycle, now, StopCause::LinkLost, slot);
            }
            Link::Online => {
                self.seen = true;
                let running = self.feedback.state.is_powered() || self.feedback.moving;
                let braking = matches!(self.latch, Some((_, Some(_))));
                if running && !self.armed && !braking {
                    if self.latch.is_none() {
                        self.latch(cycle, now, StopCause::FoundRunning);
                    }
                    // What this master has had under way is never only read again.
                    if self.plan.on_found_running == FoundRunning::Stop || self.serial > 0 {
                        self.brake(now, slot);
                    }
                }
            }
            _ => {}
        }
    }

    /// The watch over an axis in operation, and one cycle of its ladder.
    pub fn watch(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if self.armed && self.latch.is_none() && slot.report.fresh {
            match self.feedback.state {
                State::Fault | State::FaultReactionActive => {
                    self.stop(cycle, now, StopCause::DriveFault, slot);
                }
                State::OperationEnabled | State::QuickStopActive => {}
                _ => self.stop(cycle, now, StopCause::DriveDropped, slot),
            }
        }
        let sight = Sight {
            fresh: slot.report.fresh,
            heard: self.is_heard(),
            failed: slot.progress.serial == self.serial && matches!(slot.progress.end, Some(Err(_))),
            powered: self.feedback.state.is_powered(),
            moving: self.feedback.moving,
            velocity: self.feedback.velocity,
        };
        slot.report.fresh = false;
        if let Some((cause, Some(ladder))) = &mut self.latch
            && let Some(verb) = ladder.step(now, sight)
        {
            let why = Abort::Stopped(*cause);
            if let Some(active) = self.active.filter(|active| active.verb != Verb::Reset) {
                self.end(cycle, now, active, Outcome::Aborted(why));
            }
            self.order(slot, Some(verb));
        }
    }

    /// The drive answers, so that what is asked of it reaches it.
    fn is_heard(&self) -> bool {
        matches!(self.feedback.link, Link::Qualifying | Link::Online)
    }

    /// Stops the axis: latches the cause, flushes queue and stream, steps onto the ladder. The first cause stays. A drive
    /// that was only read until now is not ours to brake: its axis is latched, and nothing is written.
    pub fn stop(&mut self, cycle: &Cycle, now: Time, cause: StopCause, slot: &mut Slot) {
        if self.latch.is_some() {
            return;
        }
        self.latch(cycle, now, cause);
        if self.serial > 0 {
            self.brake(now, slot);
        }
    }

    /// Steps onto the ladder.
    fn brake(&mut self, now: Time, slot: &mut Slot) {
        let (ladder, verb) = Ladder::start(self.plan.stop, now);
        if let Some((_, rungs)) = &mut self.latch {
            *rungs = Some(ladder);
        }
        self.order(slot, Some(verb));
    }

    /// Latches without touching the drive.
    fn latch(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.latch = Some((cause, None));
        self.armed = false;
        self.just_stopped = true;
        self.feedback.stopped = Some(cause);
        self.tell(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
    }

    /// Whether it was stopped since its group was asked for.
    pub fn just_stopped(&self) -> bool {
        self.just_stopped
    }

    /// The stop group to take along, once after each stop.
    pub fn take_group_stop(&mut self) -> Option<u16> {
        if std::mem::take(&mut self.just_stopped) { self.plan.stop.group } else { None }
    }

    /// The orderly end of the master: every axis goes down and off, and nothing new begins. True once nothing more is to be
    /// done.
    pub fn shut_down(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, hurry: bool) -> bool {
        self.stop(cycle, now, StopCause::Shutdown, slot);
        self.flush(cycle, now, Abort::Stopped(StopCause::Shutdown));
        if matches!(self.latch, Some((_, None))) && self.serial > 0 && self.feedback.state.is_powered() {
            self.brake(now, slot);
        }
        // Only ever read: not ours to power off.
        let Some((_, Some(ladder))) = &mut self.latch else { return true };
        ladder.shut_down(now, self.feedback.state.is_powered());
        let verb = if hurry { ladder.hurry(now) } else { None };
        let down = ladder.is_down();
        if verb.is_some() {
            self.order(slot, verb);
        }
        down
    }

    /// Drains what the application wants: ends the command that is done, aborts what an urgent one overtakes, starts the
    /// next.
    pub fn exchange(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        self.end_active(cycle, now, slot);
        self.overtake(cycle, now);
        // Bounded by what stands there now: the application may go on filling the queue.
        for _ in 0..=self.queues.commands.slots() {
            let next = self.task_command.or_else(|| self.queues.commands.peek().ok().copied());
            let Some(next) = next else { break };
            if let Some(active) = self.active {
                // Streams run one after the other.
                let streams = active.verb == Verb::Follow && next.verb == Verb::Follow;
                let motions = active.verb.is_motion() && next.verb.is_motion() && !streams;
                let replaces = next.verb.is_urgent() || motions;
                if !replaces {
                    break;
                }
                self.end(cycle, now, active, Outcome::Aborted(Abort::Replaced(next.id)));
            }
            if self.task_command.take().is_none() {
                let _ = self.queues.commands.pop();
            }
            self.begin(cycle, now, next, slot);
        }
    }

    /// The running command, as the station sees it.
    fn end_active(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let Some(active) = self.active else { return };
        if active.verb == Verb::Reset {
            self.try_reset(cycle, now, active, slot);
            return;
        }
        if slot.progress.serial != self.serial {
            return;
        }
        match slot.progress.end {
            None => {}
            Some(Ok(())) => {
                if active.verb == Verb::Enable {
                    self.armed = true;
                }
                self.end(cycle, now, active, Outcome::Done);
            }
            Some(Err(failure)) => {
                self.end(cycle, now, active, Outcome::Failed(failure));
                if matches!(failure, Failure::DriveFault(_)) && self.armed {
                    self.stop(cycle, now, StopCause::DriveFault, slot);
                }
            }
        }
    }

    /// An urgent command aborts everything that stands before it in the queue.
    fn overtake(&mut self, cycle: &Cycle, now: Time) {
        let waiting = self.queues.commands.slots();
        let Ok(chunk) = self.queues.commands.read_chunk(waiting) else { return };
        let (first, second) = chunk.as_slices();
        let last = last_urgent(first.iter().chain(second));
        let Some((ahead, urgent)) = last else { return };
        for _ in 0..ahead {
            if let Ok(command) = self.queues.commands.pop() {
                self.end(cycle, now, command, Outcome::Aborted(Abort::Replaced(urgent)));
            }
        }
    }

    fn begin(&mut self, cycle: &Cycle, now: Time, command: Command, slot: &mut Slot) {
        if let Err(failure) = self.admit(&command) {
            self.end(cycle, now, command, Outcome::Failed(failure));
            return;
        }
        self.active = Some(command);
        match command.verb {
            Verb::Reset => self.try_reset(cycle, now, command, slot),
            Verb::Disable => {
                self.armed = false;
                self.order(slot, Some(Verb::Disable));
            }
            verb => {
                if let (Verb::QuickStop, Some((_, Some(ladder)))) = (verb, &mut self.latch) {
                    ladder.quicken();
                }
                self.order(slot, Some(verb));
            }
        }
    }

    /// Whether the command may start now. The door has looked at its numbers; here it is the axis that decides.
    fn admit(&self, command: &Command) -> Result<(), Failure> {
        check_verb(&self.plan, &command.verb)?;
        match (command.verb, &self.latch) {
            (Verb::Reset, _) | (_, None) => {}
            (Verb::ResetFault | Verb::Disable | Verb::Stop { .. } | Verb::QuickStop, Some((_, ladder)))
                if ladder.is_none_or(|ladder| ladder.is_down()) => {}
            // Sooner than the ladder would.
            (Verb::QuickStop, Some((_, Some(ladder)))) if ladder.is_braking() => {}
            (_, Some((cause, _))) => return Err(Failure::Latched(*cause)),
        }
        match command.verb {
            Verb::Reset => match &self.latch {
                // The ladder waits for the drive; so would the reset.
                Some((_, Some(ladder))) if !ladder.is_down() && !self.is_heard() => Err(Failure::NotOnline),
                _ => Ok(()),
            },
            _ if self.feedback.link != Link::Online => Err(Failure::NotOnline),
            Verb::Move(_) | Verb::Jog(_) | Verb::Follow | Verb::Home
                if self.feedback.state != State::OperationEnabled =>
            {
                Err(Failure::WrongState(self.feedback.state))
            }
            Verb::Move(_) | Verb::Jog(_) | Verb::Follow | Verb::Home | Verb::Native(NativeOwner::Master)
                if !self.armed =>
            {
                Err(Failure::NotEnabled)
            }
            Verb::Move(_) | Verb::Jog(_) | Verb::Follow
                if self.plan.limits.position.is_some() && !self.feedback.homed =>
            {
                Err(Failure::NotHomed)
            }
            _ => Ok(()),
        }
    }

    /// The latch opens once the ladder is down.
    fn try_reset(&mut self, cycle: &Cycle, now: Time, command: Command, slot: &mut Slot) {
        match &self.latch {
            Some((_, Some(ladder))) if !ladder.is_down() => return,
            Some((_, None)) if self.feedback.link == Link::Online && self.feedback.state.is_powered() => {
                // A drive that was only read until now: from here on it is ours, in the state that it is in. It moves only
                // after an Enable, which changes nothing of a drive in operation.
                self.order(slot, None);
            }
            _ => {}
        }
        self.latch = None;
        self.feedback.stopped = None;
        self.end(cycle, now, command, Outcome::Done);
    }

    /// Chooses the row of the next send, if the axis follows and an exchange is due.
    pub fn feed(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let following = slot.due && matches!(slot.order.verb, Some(Verb::Follow)) && self.active.is_some();
        if !following || self.follow.held || self.follow.last.is_some_and(|row| row.last) {
            return;
        }
        let stream = self.active.map_or(0, |active| active.stream);
        let row = self.task_row.take().or_else(|| {
            let row = self.next_row(stream);
            row.and_then(|row| self.queues.rows.pop().ok().map(|_| row))
        });
        let chosen = match (row, self.follow.last) {
            (None, None) => return,
            (Some(row), last) => {
                self.follow.empty = 0;
                if let Err(failure) = self.check_row(cycle, &row, last) {
                    self.fail_follow(cycle, now, failure, StopCause::Limit, slot);
                    return;
                }
                row
            }
            (None, Some(last)) => {
                self.follow.empty = self.follow.empty.saturating_add(1);
                if self.follow.empty == 1 {
                    self.tell(cycle, now, EventKind::Underrun);
                }
                let position = last.position + last.velocity * self.row_seconds(cycle);
                let ahead = Row { position, acceleration: 0.0, ..last };
                match self.plan.underrun {
                    Underrun::Hold => Row { velocity: 0.0, acceleration: 0.0, ..last },
                    Underrun::Extrapolate(most)
                        if self.follow.empty <= most && self.check_row(cycle, &ahead, Some(last)).is_ok() =>
                    {
                        ahead
                    }
                    Underrun::Extrapolate(_) | Underrun::Stop => {
                        self.fail_follow(cycle, now, Failure::Underrun, StopCause::Underrun, slot);
                        return;
                    }
                }
            }
        };
        self.follow.number += 1;
        self.follow.last = Some(chosen);
        self.follow.held = true;
        slot.row = Some(NumberedRow { number: self.follow.number, row: chosen });
    }

    /// The time from one row to the next.
    fn row_seconds(&self, cycle: &Cycle) -> f64 {
        cycle.period_ns as f64 * f64::from(self.plan.divisor) * 1e-9
    }

    /// The first row starts near where the drive stands; later ones near the row before, and so that the axis can still stop
    /// inside its range.
    fn check_row(&self, cycle: &Cycle, row: &Row, last: Option<Row>) -> Result<(), Failure> {
        let from = last.map_or(self.feedback.demand, |last| last.position);
        let seconds = self.row_seconds(cycle);
        check_row(&self.plan, row, Some(from))?;
        match last {
            None => check_speed(&self.plan, from, row.position, FIRST_ROW_AHEAD * seconds),
            Some(_) => {
                check_speed(&self.plan, from, row.position, seconds)?;
                check_braking(&self.plan, from, row.position, seconds)
            }
        }
    }

    fn fail_follow(&mut self, cycle: &Cycle, now: Time, failure: Failure, cause: StopCause, slot: &mut Slot) {
        if let Some(active) = self.active {
            self.end(cycle, now, active, Outcome::Failed(failure));
        }
        self.stop(cycle, now, cause, slot);
    }

    /// Publishes the feedback.
    pub fn publish(&mut self) {
        self.queues.feedback.write(&self.feedback);
        if let Some(samples) = &mut self.queues.samples
            && samples.push(self.feedback).is_err()
        {
            self.lost_samples += 1;
        }
    }

    /// For the in-loop task: a command to be taken in this cycle, before the queue.
    pub fn command_from_task(&mut self, command: Command) -> Result<(), Failure> {
        if self.task_command.is_some() {
            return Err(Failure::Unsupported("one command an axis and cycle from the in-loop task"));
        }
        check_verb(&self.plan, &command.verb)?;
        self.task_command = Some(command);
        Ok(())
    }

    /// For the in-loop task: the row of the next send.
    pub fn row_from_task(&mut self, row: Row) {
        self.task_row = Some(row);
    }

    fn flush(&mut self, cycle: &Cycle, now: Time, why: Abort) {
        if let Some(active) = self.active {
            self.end(cycle, now, active, Outcome::Aborted(why));
        }
        if let Some(command) = self.task_command.take() {
            self.end(cycle, now, command, Outcome::Aborted(why));
        }
        for _ in 0..self.queues.commands.slots() {
            match self.queues.commands.pop() {
                Ok(command) => self.end(cycle, now, command, Outcome::Aborted(why)),
                Err(_) => break,
            }
        }
        // Of every stream there is: the application counts on from the stop.
        self.drop_rows(u32::MAX - 1);
    }

    /// Drops what is left of the streams up to `stream`.
    fn drop_rows(&mut self, stream: u32) {
        self.task_row = None;
        self.follow = Follow { number: self.follow.number, ..Follow::default() };
        self.next_row(stream + 1);
    }

    /// The first row of `stream`, left in the queue; rows of earlier streams before it are dropped.
    fn next_row(&mut self, stream: u32) -> Option<Row> {
        for _ in 0..self.queues.rows.slots() {
            match self.queues.rows.peek() {
                Ok(row) if row.stream < stream => drop(self.queues.rows.pop()),
                Ok(row) if row.stream == stream => return Some(row.row),
                _ => break,
            }
        }
        None
    }

    fn order(&mut self, slot: &mut Slot, verb: Option<Verb>) {
        self.serial += 1;
        slot.order = Order { serial: self.serial, verb };
        slot.row = None;
        self.follow.held = false;
    }

    fn end(&mut self, cycle: &Cycle, now: Time, command: Command, outcome: Outcome) {
        if command.verb == Verb::Follow {
            self.drop_rows(command.stream);
        }
        if self.active.is_some_and(|active| active.id == command.id) {
            self.active = None;
        }
        self.tell(cycle, now, EventKind::Ended { id: command.id, verb: command.verb.name(), outcome });
    }

    fn tell(&mut self, cycle: &Cycle, now: Time, kind: EventKind) {
        if self.queues.events.push(Event { cycle: cycle.index, at: now, kind }).is_err() {
            self.lost_events += 1;
        }
    }
}

/// The last urgent command of a queue: how many stand before it, and its id.
fn last_urgent<'a>(queue: impl Iterator<Item = &'a Command>) -> Option<(usize, CommandId)> {
    queue
        .enumerate()
        .filter(|(_, command)| command.verb.is_urgent())
        .last()
        .map(|(at, command)| (at, command.id))
}
