//! The loop's side of one axis: its queues, the command that runs, its setpoints, its latch and the ladder.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the drive as judged; stopping |
//! | `commands` | what the application wants, in its order |
//! | `setpoints` | rows, velocities and torques for the next send, and their age |
//! | `bounds` | what the drive's own demand may do, whatever commands it |

mod bounds;
mod commands;
mod setpoints;

use rtrb::{Consumer, Producer};

use self::bounds::{Bounds, Sample};
use self::setpoints::{Follow, Level};
use super::health::LinkHealth;
use super::ladder::{Ladder, Sight};
use super::record::{DriveRecord, MonitorRecord, Reply, measured, short};
use super::status::{DriveNumbers, Extent, Peaks};
use crate::axis::cell::Writer;
use crate::axis::command::NativeOwner;
use crate::axis::{
    Abort, AxisPlan, Command, CommandId, Event, EventKind, Feedback, FoundRunning, Link, MONITOR_CHANNELS,
    Outcome, Row, Setpoint, Shown, State, StopCause, StreamRow, Ticket, Verb,
};
use crate::bus::{Cycle, Exchange, Order, Report, Slot};
use crate::rt::Regions;
use crate::time::Time;

/// The ends of the queues that the loop holds for one axis.
#[derive(Debug)]
pub struct Queues {
    /// Commands of the application.
    pub commands: Consumer<Command>,
    /// Rows of the application's stream.
    pub rows: Consumer<StreamRow>,
    /// Velocity and torque setpoints of the application; the newest counts.
    pub setpoints: Consumer<Setpoint>,
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
    claim: Claim,
    latch: Latch,
    /// The command that runs.
    active: Option<Command>,
    serial: u64,
    /// A command of the in-loop task, to be taken before the queue.
    task_command: Option<Command>,
    /// A row of the in-loop task, to be taken before the stream.
    task_row: Option<Row>,
    /// The command of a group that stands at the head of the queue and could begin.
    waiting: Option<Command>,
    /// The command that stands at the gate, and since which slot.
    at_gate: Option<(CommandId, u64)>,
    /// The last command of a group that ended before it began: no other member shall wait for it.
    dropped: Option<Ticket>,
    follow: Follow,
    /// The velocity or torque of the command that runs, and the newest one for a command to come.
    level: Level,
    ahead: Level,
    bounds: Bounds,
    /// It homes, or has not stood still since.
    homing: bool,
    /// The drive was found restarted in this cycle.
    restarted: bool,
    /// How the exchange of this cycle was closed.
    closed: Option<Closed>,
    /// The slot from which the values of the feedback are.
    fresh_at: u64,
    /// The drive was online at least once.
    seen: bool,
    /// Stopped since the loop last asked: its group goes with it.
    just_stopped: bool,
    /// What the telemetry is told of this cycle.
    record: DriveRecord,
    /// What the drive showed in this cycle besides.
    shown: Shown,
    /// How long after its grid point the request before left.
    phase_ns: Option<u64>,
    /// Times that the link was lost.
    losses: u64,
    /// The orderly end has begun.
    ends: bool,
    /// The largest times.
    peaks: Peaks,
    /// What the drive showed since the start.
    monitor: [Option<Extent>; MONITOR_CHANNELS],
    /// Events that found their queue full.
    pub lost_events: u64,
    /// Samples that found their queue full.
    pub lost_samples: u64,
}

/// Whose the drive is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Claim {
    /// Only read so far: not ours to brake or to power off.
    Found,
    /// Something was asked of it.
    Ours,
    /// Enabled: it is expected to stay in operation.
    Armed,
}

/// Whether the axis is stopped, and why.
#[derive(Clone, Copy, Debug)]
enum Latch {
    Open,
    /// Nothing was asked of the drive: it was not ours.
    Kept(StopCause),
    /// On the way down, or at its end.
    Down(StopCause, Ladder),
}

impl Latch {
    fn is_open(&self) -> bool {
        matches!(self, Latch::Open)
    }

    fn cause(&self) -> Option<StopCause> {
        match self {
            Latch::Open => None,
            Latch::Kept(cause) | Latch::Down(cause, _) => Some(*cause),
        }
    }

    /// Nothing is under way.
    fn is_settled(&self) -> bool {
        match self {
            Latch::Open | Latch::Kept(_) => true,
            Latch::Down(_, ladder) => ladder.is_down(),
        }
    }
}

/// How an exchange ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closed {
    /// Answered.
    Answered,
    /// Missed, or not even sent.
    Missed,
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
            claim: Claim::Found,
            latch: Latch::Open,
            active: None,
            serial: 0,
            task_command: None,
            task_row: None,
            waiting: None,
            at_gate: None,
            dropped: None,
            follow: Follow::default(),
            level: Level::default(),
            ahead: Level::default(),
            bounds: Bounds::default(),
            homing: false,
            restarted: false,
            closed: None,
            fresh_at: 0,
            seen: false,
            just_stopped: false,
            record: DriveRecord::default(),
            shown: Shown::default(),
            phase_ns: None,
            losses: 0,
            ends: false,
            peaks: Peaks::default(),
            monitor: [None; MONITOR_CHANNELS],
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

    /// After the send stage: the request of `cycle` went out, or was tried.
    pub fn sent(&mut self, cycle: &Cycle, slot: &Slot) {
        self.health.asked(cycle.index);
        if let Exchange::Owed { sent_at, .. } = slot.exchange
            && sent_at >= cycle.grid
        {
            let phase_ns = sent_at.since(cycle.grid);
            self.record.phase_ns = measured(phase_ns);
            if let Some(before) = self.phase_ns.replace(phase_ns) {
                let jitter_ns = phase_ns.abs_diff(before);
                self.record.jitter_ns = measured(jitter_ns);
                self.peaks.send_jitter.see(jitter_ns, cycle.index);
            }
        }
        // A row that the operating system refused is sent with the next request; in a group it is lost like any
        // telegram, or this axis would be a row behind from then on.
        self.follow.held &= slot.exchange == Exchange::Unsent && self.moves_in_group().is_none();
    }

    /// Judges this cycle's exchange, updates the feedback, and notices what changed. Says what became of it.
    pub fn judge(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        let mut rtt = None;
        let mut sent = None;
        self.closed = None;
        self.record.was_online = self.feedback.link == Link::Online;
        let reply = match slot.exchange {
            Exchange::Idle | Exchange::Missed => Reply::None,
            Exchange::Owed { reply_by, .. } if !cycle.closes(reply_by) => Reply::Owed,
            Exchange::Owed { .. } | Exchange::Absent => {
                slot.counters.missed += 1;
                slot.exchange = Exchange::Missed;
                self.missed(cycle, now);
                Reply::Missed
            }
            Exchange::Unsent => {
                slot.exchange = Exchange::Idle;
                // One that its bus takes down at the orderly end is not lost by that.
                if !(self.ends && slot.excused) {
                    self.missed(cycle, now);
                }
                Reply::Unsent
            }
            Exchange::Answered { sent_at, at, suspect } => {
                slot.exchange = Exchange::Idle;
                self.closed = Some(Closed::Answered);
                self.health.answered();
                if suspect {
                    Reply::Suspect
                } else {
                    let rtt_ns = at.since(sent_at);
                    self.peaks.rtt.see(rtt_ns, cycle.index);
                    self.record.rtt_ns = measured(rtt_ns);
                    rtt = Some(short(rtt_ns));
                    sent = Some(sent_at);
                    Reply::Answered
                }
            }
        };
        self.record.reply = reply;
        if std::mem::take(&mut slot.reachable) {
            self.health.reachable(cycle.index + 1);
        }
        if slot.report.restarted {
            self.bounds = Bounds::default();
        } else if let Some(sent_at) = sent.filter(|_| slot.report.fresh) {
            let report = &slot.report;
            let Report { at, homed, position, demand, velocity, .. } = *report;
            let led = !under_torque(slot);
            let position = if led { demand } else { position };
            self.bounds.take(Sample { sent_at, at, homed, led, position, velocity }, &self.plan);
        }
        self.take_report(cycle, now, slot, rtt);
        self.take_link(cycle, now, slot);
        // A first answer need not be one that tells the drive's state.
        if matches!(self.feedback.link, Link::Online | Link::Qualifying) && self.feedback.at != Time(0) {
            let age_ns = now.since(self.feedback.at);
            self.record.age_ns = measured(age_ns);
            self.peaks.age.see(age_ns, cycle.index);
        }
        reply
    }

    fn missed(&mut self, cycle: &Cycle, now: Time) {
        self.closed = Some(Closed::Missed);
        self.health.missed(cycle.index, self.seen);
        if self.moves_in_group().is_some() {
            self.tell(cycle, now, EventKind::MissedInGroup);
        }
    }

    /// The group that it moves in.
    pub fn moves_in_group(&self) -> Option<Ticket> {
        let moves = |active: &Command| active.verb.is_motion() || active.verb == Verb::Home;
        self.active.filter(moves).and_then(|active| active.ticket)
    }

    /// How the exchange of this cycle was closed, once.
    pub fn take_closed(&mut self) -> Option<Closed> {
        self.closed.take()
    }

    /// The drive's report into the feedback, with an event for each change.
    fn take_report(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, rtt: Option<u32>) {
        let report = &mut slot.report;
        let before = self.feedback;
        self.feedback.cycle = cycle.index;
        if !report.fresh {
            let age = cycle.index.saturating_sub(self.fresh_at);
            self.feedback.age = u32::try_from(age).unwrap_or(u32::MAX);
            return self.take_emergency(cycle, now, slot);
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
            inhibited: report.inhibited,
            suspect: report.suspect,
            position: report.position,
            demand: report.demand,
            velocity: report.velocity,
            current: report.current,
            warning: report.warning,
            fault: report.fault,
            rtt_ns: rtt.or(before.rtt_ns),
            monitor: report.monitor,
        };
        if std::mem::take(&mut report.monitor_fresh) {
            self.shown = report.monitor.into();
            for (extent, value) in self.monitor.iter_mut().zip(report.monitor) {
                if let Some(value) = value.filter(|value| !value.is_nan()) {
                    Extent::see(extent, value);
                }
            }
        }
        // Almost never any of them.
        if report.restarted | report.monitor_refused.is_some() | report.emergency.is_some() {
            if let Some((channel, status)) = report.monitor_refused.take() {
                self.tell(cycle, now, EventKind::MonitorRefused { channel, status });
            }
            if std::mem::take(&mut report.restarted) {
                self.restarted = true;
                self.tell(cycle, now, EventKind::Restarted);
            }
            self.take_emergency(cycle, now, slot);
        }
        if before.inhibited != self.feedback.inhibited {
            self.tell(cycle, now, EventKind::HardwareEnable(!self.feedback.inhibited));
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

    /// What the drive told by itself; it may, without an exchange.
    fn take_emergency(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if let Some(emergency) = slot.report.emergency.take() {
            self.record.emergency = Some(emergency.into());
            self.tell(cycle, now, EventKind::Emergency(emergency));
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
        self.losses += u64::from(link == Link::Lost && before == Link::Online && !slot.excused);
        match link {
            Link::Lost if before == Link::Online => {
                self.stop(cycle, now, StopCause::LinkLost, slot);
                // Those who stop with it go on: it was asked for this silence, and holds or moves nothing.
                self.just_stopped &= !slot.excused;
            }
            Link::Online => {
                self.seen = true;
                let running = self.feedback.state.is_powered() || self.feedback.moving;
                if running && self.claim != Claim::Armed && !matches!(self.latch, Latch::Down(..)) {
                    if self.latch.is_open() {
                        self.latch(cycle, now, StopCause::FoundRunning);
                    }
                    // What this master has had under way is never only read again.
                    if self.plan.on_found_running == FoundRunning::Stop || self.claim != Claim::Found {
                        self.brake(now, slot);
                    }
                }
            }
            _ => {}
        }
    }

    /// The watch over an axis in operation, and one cycle of its ladder.
    pub fn watch(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let restarted = std::mem::take(&mut self.restarted);
        // Where the application owns the control word, what state the drive is in is its own affair.
        let free = self.is_native(NativeOwner::Application);
        if (self.claim == Claim::Armed || free) && slot.report.fresh {
            let cause = match self.feedback.state {
                State::OperationEnabled | State::QuickStopActive => {
                    // Homing gives the positions another origin and has speeds of its own.
                    let home = self.active.is_some_and(|active| active.verb == Verb::Home);
                    self.homing = home || self.homing && self.feedback.moving;
                    // Nobody but the drive knows how it will brake, if it was not told by this loop; under torque
                    // nothing brakes it at all.
                    let native = free || self.is_native(NativeOwner::Master);
                    let braking = native || self.active.is_none() || under_torque(slot);
                    let broken = self.bounds.are_broken(&self.plan, braking, self.row_seconds(cycle));
                    (broken && !self.homing).then_some(StopCause::Limit)
                }
                _ if free && !restarted => None,
                State::Fault | State::FaultReactionActive => Some(StopCause::DriveFault),
                _ if self.feedback.inhibited => Some(StopCause::HardwareEnable),
                _ => Some(StopCause::DriveDropped),
            };
            if let Some(cause) = cause {
                self.stop(cycle, now, cause, slot);
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
        if let Latch::Down(cause, ladder) = &mut self.latch
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

    /// Stops the axis: latches the cause, flushes queue and stream, steps onto the ladder. The first cause stays. A
    /// drive that was only read until now is not ours to brake: its axis is latched, and nothing is written.
    pub fn stop(&mut self, cycle: &Cycle, now: Time, cause: StopCause, slot: &mut Slot) {
        if !self.latch.is_open() {
            return;
        }
        self.latch(cycle, now, cause);
        if self.claim != Claim::Found {
            self.brake(now, slot);
        }
    }

    /// Stops the axis if it is enabled, or about to be; what is not can do no harm.
    pub fn stop_if_armed(&mut self, cycle: &Cycle, now: Time, cause: StopCause, slot: &mut Slot) {
        let rising = self.active.is_some_and(|active| active.verb == Verb::Enable);
        if self.claim == Claim::Armed || rising || self.is_native(NativeOwner::Application) {
            self.stop(cycle, now, cause, slot);
        }
    }

    fn is_native(&self, owner: NativeOwner) -> bool {
        self.active.is_some_and(|active| active.verb == Verb::Native(owner))
    }

    /// Steps onto the ladder of an axis that is latched.
    fn brake(&mut self, now: Time, slot: &mut Slot) {
        let Some(cause) = self.latch.cause() else { return };
        let (ladder, verb) = Ladder::start(self.plan.stop, self.plan.load, now);
        self.latch = Latch::Down(cause, ladder);
        self.order(slot, Some(verb));
    }

    /// Latches without touching the drive.
    fn latch(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.latch = Latch::Kept(cause);
        self.disarm();
        self.just_stopped = true;
        self.feedback.stopped = Some(cause);
        self.tell(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
    }

    /// It is no longer expected to stay in operation.
    fn disarm(&mut self) {
        if self.claim == Claim::Armed {
            self.claim = Claim::Ours;
        }
    }

    /// Whether it was stopped since its group was asked for.
    pub fn just_stopped(&self) -> bool {
        self.just_stopped
    }

    /// The stop group to take along, once after each stop.
    pub fn take_group_stop(&mut self) -> Option<u16> {
        if std::mem::take(&mut self.just_stopped) { self.plan.stop.group } else { None }
    }

    /// The orderly end of the master: every axis goes down and off, and nothing new begins. True once nothing more is
    /// to be done.
    pub fn shut_down(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, hurry: bool) -> bool {
        self.ends = true;
        self.stop(cycle, now, StopCause::Shutdown, slot);
        self.flush(cycle, now, Abort::Stopped(StopCause::Shutdown));
        if matches!(self.latch, Latch::Kept(_)) && self.claim != Claim::Found {
            self.brake(now, slot);
        }
        // Only ever read: not ours to power off.
        let Latch::Down(_, ladder) = &mut self.latch else { return true };
        ladder.shut_down(now, self.feedback.state.is_powered());
        let verb = if hurry { ladder.hurry(now) } else { None };
        let down = ladder.is_down();
        if verb.is_some() {
            self.order(slot, verb);
        }
        down
    }

    /// Publishes the feedback; returns what the telemetry is told of this cycle, as that of axis `axis`.
    pub fn publish(&mut self, axis: u16) -> DriveRecord {
        self.queues.feedback.write(&self.feedback);
        if let Some(samples) = &mut self.queues.samples
            && samples.push(self.feedback).is_err()
        {
            self.lost_samples += 1;
        }
        let feedback = &self.feedback;
        DriveRecord {
            index: feedback.cycle,
            axis,
            link: feedback.link,
            state: feedback.state,
            stopped: feedback.stopped,
            verb: self.active.map_or(0, |active| active.verb.code()),
            moving: feedback.moving,
            inhibited: feedback.inhibited,
            fault: feedback.fault,
            warning: feedback.warning,
            current: feedback.current as f32,
            velocity: feedback.velocity as f32,
            position: feedback.position,
            demand: feedback.demand,
            // What sending and judging found out.
            ..std::mem::take(&mut self.record)
        }
    }

    /// What the telemetry is told besides of a drive that showed something in this cycle, once.
    pub fn take_shown(&mut self, axis: u16) -> Option<MonitorRecord> {
        if self.shown.is_empty() {
            return None;
        }
        let shown = std::mem::take(&mut self.shown);
        Some(MonitorRecord { index: self.feedback.cycle, axis, shown })
    }

    /// What the loop counted of it so far, with what its bus did.
    pub fn numbers(&self, slot: &Slot) -> DriveNumbers {
        let Seat { losses, peaks, monitor, .. } = *self;
        DriveNumbers { counters: slot.counters, losses, peaks, monitor }
    }

    /// Ends everything that the application has asked for.
    fn flush(&mut self, cycle: &Cycle, now: Time, why: Abort) {
        if let Some(active) = self.active {
            self.end(cycle, now, active, Outcome::Aborted(why));
        }
        if let Some(command) = self.task_command.take() {
            self.end(cycle, now, command, Outcome::Aborted(why));
        }
        self.waiting = None;
        for _ in 0..self.queues.commands.slots() {
            match self.queues.commands.pop() {
                Ok(command) => self.end(cycle, now, command, Outcome::Aborted(why)),
                Err(_) => break,
            }
        }
        // Of every stream there is: the application counts on from the stop.
        self.drop_rows(u32::MAX - 1);
    }

    fn order(&mut self, slot: &mut Slot, verb: Option<Verb>) {
        self.serial += 1;
        if self.claim == Claim::Found {
            self.claim = Claim::Ours;
        }
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
        } else {
            self.dropped = command.ticket.or(self.dropped);
        }
        self.tell(cycle, now, EventKind::Ended { id: command.id, verb: command.verb.name(), outcome });
    }

    fn tell(&mut self, cycle: &Cycle, now: Time, kind: EventKind) {
        if self.queues.events.push(Event { cycle: cycle.index, at: now, kind }).is_err() {
            self.lost_events += 1;
        }
    }
}

/// Whether no position leads the drive, and what it shows as its demand means nothing.
fn under_torque(slot: &Slot) -> bool {
    slot.order.verb.is_some_and(|verb| verb.takes_torques())
}
