//! The loop's side of one axis: its queues, the running command, its setpoints, its latch and the stop sequence.
//!
//! Here: the drive as evaluated, and stopping.

mod commands;
mod duty;
mod setpoints;

pub use self::commands::{take_calls, take_commands};
pub use self::setpoints::take_rows;
pub use super::health::Probes;

use std::collections::VecDeque;

use rtrb::{Consumer, Producer};

use self::duty::{Claim, Duty, Latch};
use self::setpoints::Follow;
use super::bounds::{Bounds, Sample, Watched};
use super::health::LinkHealth;
use super::machine::Machine;
use super::numbers::{DriveNumbers, Extent, Peaks};
use super::record::{DriveRecord, Measured, MonitorRecord, Published, Reply, measured, short};
use super::rest::{Motion, Rest};
use super::stop::{Sight, StopSequence};
use crate::axis::cell::Writer;
use crate::axis::command::NativeOwner;
use crate::axis::newest::NewestOut;
use crate::axis::{
    Abort, AxisPlan, Command, CommandId, DriveStatus, Event, EventKind, Feedback, FoundRunning, GroupCall,
    Link, MONITOR_CHANNELS, Outcome, QueuedCommand, Row, Setpoint, Shown, State, StopCause, StreamRow,
};
use crate::bus::desired::Capabilities;
use crate::bus::{Cycle, Exchange, Slot};
use crate::rt::Regions;
use crate::time::{Time, nanos};

/// The ends of the queues that the loop holds for one axis. The first ones are used in each cycle.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Queues {
    /// The newest feedback.
    pub feedback: Writer<Feedback>,
    /// Every cycle's feedback, where the plan requests it.
    pub samples: Option<Producer<Feedback>>,
    /// Events and samples for which there was no room.
    pub lost: u64,
    /// Commands that the application has posted, to the axis or to the group that it leads.
    pub posted: Consumer<QueuedCommand>,
    /// Commands to the axis, taken out of its own queue and out of those of its groups.
    pub commands: VecDeque<QueuedCommand>,
    /// Rows of the application's stream, or of the stream of the group that it leads.
    pub rows: Consumer<StreamRow>,
    /// The newest velocity or torque setpoint of the application.
    pub setpoints: NewestOut,
    /// Events to the application.
    pub events: Producer<Event>,
    /// Places among them that only the ends of commands take.
    pub room_for_ends: usize,
}

/// What the loop keeps of one axis.
///
/// What each cycle touches stands first, in as few cache lines as possible: the plan with its names, most queues and
/// what a command needs lie behind it. The first line, with the head of the duty, is that of all stages.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct DriveController {
    /// The slot from which on the setpoint of the running command may be too old.
    ages_at: u64,
    /// Something is to be looked at with the next commands: its bell has rung, or a command waits.
    called: bool,
    /// Its exchange waits for its turn on a half-duplex wire.
    queued: bool,
    /// The drive was found restarted in this cycle.
    restarted: bool,
    /// Stopped since the loop last checked: its group stops with it.
    just_stopped: bool,
    /// Reports of a drive without power until an enable that did not end as done can no longer bring it on.
    rising: u8,
    /// How the exchange of this cycle was closed.
    closed: Option<Closed>,
    /// The given row has not been sent yet (its slot was passed over): it must not be replaced.
    row_waits: bool,
    /// The monitored variables of this cycle are there.
    shows: bool,
    /// What this cycle has measured, for the telemetry.
    measured: Measured,
    /// How long after its grid point the previous request left.
    phase_ns: Option<u64>,
    duty: Duty,
    health: LinkHealth,
    /// The slot of the grid that was evaluated last.
    grid: Time,
    /// The slot of the values in the feedback.
    fresh_at: u64,
    /// The largest times.
    peaks: Peaks,
    feedback: Feedback,
    bounds: Bounds,
    rest: Rest,
    /// From one row to the next, s.
    row_seconds: f64,
    machine: Machine,
    queues: Queues,
    /// The monitored variables of this cycle.
    shown: Shown,
    plan: AxisPlan,
    /// When the running command began.
    began: Time,
    /// A command of the in-loop task, to be taken before the queue.
    task_command: Option<QueuedCommand>,
    /// A row of the in-loop task, to be taken before the stream.
    task_row: Option<Row>,
    /// The group command at the head of the queue that could begin.
    waiting: Option<QueuedCommand>,
    /// The id of the next command of the application.
    next_id: u64,
    follow: Follow,
    /// The slot in which the velocity or torque of the running command came, and the newest one for a command to come.
    level_at: u64,
    ahead: Setpoint,
    /// A call of the application that commands the drive is under way.
    commanded: bool,
    /// The enable that waits for its end, and since when.
    held: Option<(CommandId, Time)>,
    /// The drive was online at least once.
    seen: bool,
    /// Times that the link was lost.
    losses: u64,
    /// The orderly end has begun.
    ends: bool,
    /// The monitored variables since the start.
    monitor: [Option<Extent>; MONITOR_CHANNELS],
}

/// How an exchange ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closed {
    /// Answered.
    Answered,
    /// Missed, or not even sent.
    Missed,
}

impl DriveController {
    /// A controller for the axis of `plan`.
    pub fn new(
        plan: AxisPlan,
        can: Capabilities,
        queues: Queues,
        period_ns: u64,
        first_probe: u64,
        silence: u64,
        probes: Probes,
    ) -> DriveController {
        let machine = Machine::new(&plan, can, period_ns);
        let row_seconds = period_ns as f64 * f64::from(plan.divisor) * 1e-9;
        let (divisor, phase) = (plan.divisor, plan.phase);
        let health = LinkHealth::new(plan.health, divisor, phase, period_ns, first_probe, silence, probes);
        DriveController {
            ages_at: u64::MAX,
            called: false,
            queued: false,
            restarted: false,
            just_stopped: false,
            rising: 0,
            closed: None,
            row_waits: false,
            shows: false,
            measured: Measured::default(),
            phase_ns: None,
            duty: Duty::new(),
            health,
            grid: Time(0),
            fresh_at: 0,
            peaks: Peaks::default(),
            feedback: Feedback::default(),
            bounds: Bounds::new(&plan),
            rest: Rest::default(),
            row_seconds,
            machine,
            queues,
            shown: Shown::default(),
            plan,
            began: Time(0),
            task_command: None,
            task_row: None,
            waiting: None,
            next_id: 1,
            follow: Follow::default(),
            level_at: 0,
            ahead: Setpoint::default(),
            commanded: false,
            held: None,
            seen: false,
            losses: 0,
            ends: false,
            monitor: [None; MONITOR_CHANNELS],
        }
    }

    /// Adds the memory that it touches besides itself and its rings, to be locked.
    pub fn memory(&self, regions: &mut Regions) {
        self.queues.feedback.memory(regions);
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

    /// Whether an exchange is due in slot `index`.
    #[inline]
    pub fn is_due(&self, index: u64) -> bool {
        self.health.is_due(index)
    }

    /// The request that was due was sent in `cycle`, or attempted: in the send stage, or, if it was queued then, in the
    /// receive stage. While it is queued, or passed over because the one before it is owed, nothing has changed. Its
    /// exchange may have been closed since then.
    #[inline(always)] // Once for each axis and cycle; what is queued takes the way around it.
    fn sent(&mut self, cycle: &Cycle, slot: &mut Slot) {
        self.queued = false;
        if let Some(grid) = slot.gone.grid.take() {
            self.machine.commit(grid);
        }
        match slot.exchange {
            // The usual ones.
            Exchange::Answered { sent_at, .. } | Exchange::Owed { sent_at, .. } if sent_at >= cycle.grid => {
                self.left(cycle, sent_at)
            }
            _ => self.sent_otherwise(cycle, slot),
        }
    }

    /// The same of a request that was queued.
    #[cold]
    fn sent_meanwhile(&mut self, cycle: &Cycle, slot: &mut Slot) {
        self.sent(cycle, slot);
    }

    /// Its request left at this instant.
    #[inline(always)] // As `sent`.
    fn left(&mut self, cycle: &Cycle, sent_at: Time) {
        self.health.requested(cycle.index, true);
        self.row_waits = false;
        let phase_ns = sent_at.since(cycle.grid);
        self.measured.phase_ns = measured(phase_ns);
        if let Some(before) = self.phase_ns.replace(phase_ns) {
            let jitter_ns = phase_ns.abs_diff(before);
            self.measured.jitter_ns = measured(jitter_ns);
            self.peaks.send_jitter.see(jitter_ns, cycle.index);
        }
    }

    #[inline(never)]
    fn sent_otherwise(&mut self, cycle: &Cycle, slot: &Slot) {
        match slot.exchange.sent_at() {
            Some(sent_at) if sent_at >= cycle.grid => self.left(cycle, sent_at),
            Some(_) => {}
            None if slot.exchange == Exchange::Queued => self.queued = true,
            None => {
                self.health.requested(cycle.index, false);
                // A row that the operating system refused is sent with the next request; in a group it is lost like any
                // telegram, or this axis would be one row behind from then on.
                self.row_waits &= slot.exchange == Exchange::Unsent && self.moves_in_group().is_none();
            }
        }
    }

    /// Evaluates this cycle, what was sent included, and watches the axis. Returns the result of the exchange.
    pub fn evaluate(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        if std::mem::take(&mut slot.due) {
            self.sent(cycle, slot);
        }
        let reply = self.judge(cycle, now, slot);
        self.watch(cycle, now, slot);
        reply
    }

    /// Evaluates this cycle's exchange, updates the feedback, and notices changes. Returns the result of the
    /// exchange.
    #[inline]
    fn judge(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        if self.queued {
            self.sent_meanwhile(cycle, slot);
        }
        (self.closed, self.grid) = (None, cycle.grid);
        self.measured.was_online = self.feedback.link == Link::Online;
        let mut rtt = None;
        // The usual end of an exchange, in a cycle that has one.
        let reply = if let Exchange::Answered { sent_at, at, suspect: false } = slot.exchange {
            slot.exchange = Exchange::Idle;
            self.closed = Some(Closed::Answered);
            self.health.answered(cycle.index);
            let rtt_ns = at.since(sent_at);
            self.peaks.rtt.see(rtt_ns, cycle.index);
            self.measured.rtt_ns = measured(rtt_ns);
            rtt = Some(short(rtt_ns));
            if slot.notices.fresh && !slot.notices.restarted {
                self.take_sample(sent_at, slot);
            }
            Reply::Answered
        } else {
            let reply = self.judge_otherwise(cycle, now, slot);
            self.health.watch_silence(cycle.index);
            reply
        };
        self.measured.reply = reply;
        if slot.reachable {
            slot.reachable = false;
            self.health.reachable(cycle.index + 1);
        }
        if slot.notices.restarted {
            self.bounds.forget();
        }
        self.take_status(cycle, now, slot, rtt);
        self.take_link(cycle, now, slot);
        // The first answer need not report the drive's state.
        if matches!(self.feedback.link, Link::Online | Link::Qualifying) && self.feedback.status.at != Time(0)
        {
            let age_ns = now.since(self.feedback.status.at);
            self.measured.age_ns = measured(age_ns);
            self.peaks.age.see(age_ns, cycle.index);
        }
        reply
    }

    /// No exchange was answered for certain.
    #[inline(never)]
    fn judge_otherwise(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) -> Reply {
        match slot.exchange {
            Exchange::Idle | Exchange::Missed => {
                self.take_packet(slot);
                Reply::None
            }
            Exchange::Queued => Reply::Queued,
            Exchange::Owed { reply_by, .. } if !cycle.closes(reply_by) => Reply::Owed,
            Exchange::OwnClock { fresh_until, .. } if cycle.grid < fresh_until => {
                slot.counters.answered += 1;
                slot.exchange = Exchange::Idle;
                self.closed = Some(Closed::Answered);
                self.health.answered(cycle.index);
                self.take_packet(slot);
                Reply::Current
            }
            Exchange::Owed { .. } | Exchange::OwnClock { .. } | Exchange::Absent { .. } => {
                slot.counters.missed += 1;
                slot.exchange = Exchange::Missed;
                self.missed(cycle, now);
                Reply::Missed
            }
            Exchange::Unsent => {
                slot.exchange = Exchange::Idle;
                // A link that its bus shuts down at the orderly end is not lost.
                if !(self.ends && slot.expected_silence) {
                    self.missed(cycle, now);
                }
                Reply::Unsent
            }
            Exchange::Answered { .. } => {
                slot.exchange = Exchange::Idle;
                self.closed = Some(Closed::Answered);
                self.health.answered(cycle.index);
                Reply::Suspect
            }
        }
    }

    /// A packet of a drive with its own clock, with an exchange or without: it has a stamp of its own.
    fn take_packet(&mut self, slot: &Slot) {
        if slot.notices.fresh {
            self.take_sample(slot.status.at, slot);
        }
    }

    /// The report to a request that left at `sent_at` counts for the limits.
    #[inline]
    fn take_sample(&mut self, sent_at: Time, slot: &Slot) {
        let DriveStatus { at, homed, position, demand, velocity, .. } = slot.status;
        let led = !self.duty.is_under_torque();
        let position = if led { demand } else { position };
        self.bounds.take(Sample { sent_at, at, homed, led, position, velocity });
    }

    fn missed(&mut self, cycle: &Cycle, now: Time) {
        self.closed = Some(Closed::Missed);
        self.health.missed(cycle.index, self.seen);
        if self.moves_in_group().is_some() {
            self.emit(cycle, now, EventKind::MissedInGroup);
        }
    }

    /// The group of its running motion.
    pub fn moves_in_group(&self) -> Option<GroupCall> {
        let moves =
            |active: &QueuedCommand| active.command.is_motion() || matches!(active.command, Command::Home);
        self.duty.active().filter(moves).and_then(|active| active.call)
    }

    /// How the exchange of this cycle was closed, once.
    pub fn take_closed(&mut self) -> Option<Closed> {
        self.closed.take()
    }

    /// Takes the drive's status into the feedback, with an event for each change.
    #[inline]
    fn take_status(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, rtt: Option<u32>) {
        let Slot { status, notices, .. } = slot;
        self.feedback.cycle = cycle.index;
        if !notices.fresh {
            let age = cycle.index.saturating_sub(self.fresh_at);
            self.feedback.age = u32::try_from(age).unwrap_or(u32::MAX);
            return self.take_emergency(cycle, now, slot);
        }
        self.fresh_at = cycle.index - u64::from(status.suspect).min(cycle.index);
        if self.rising > 0 {
            self.fall(status);
        }
        let before = Shows::of(&self.feedback.status);
        self.feedback.status = *status;
        self.feedback.age = u32::from(status.suspect);
        self.feedback.rtt_ns = rtt.or(self.feedback.rtt_ns);
        if notices.monitor_fresh {
            notices.monitor_fresh = false;
            self.take_monitored();
        }
        let noticed = notices.restarted | notices.monitor_refused.is_some() | notices.emergency.is_some();
        if noticed || before != Shows::of(&self.feedback.status) {
            self.report(cycle, now, slot, before);
        }
    }

    /// A report of a drive whose enable has not ended as done.
    #[cold]
    fn fall(&mut self, status: &DriveStatus) {
        if self.duty.active().is_none() && !status.state.is_powered() && !status.suspect {
            self.rising -= 1;
        }
    }

    #[inline(never)]
    fn take_monitored(&mut self) {
        let monitor = self.feedback.status.monitor;
        self.shown = monitor.into();
        self.shows = !self.shown.is_empty();
        for (extent, value) in self.monitor.iter_mut().zip(monitor) {
            if let Some(value) = value.filter(|value| !value.is_nan()) {
                Extent::see(extent, value);
            }
        }
    }

    /// Reports what is new, or differs from what was shown `before`.
    #[cold]
    fn report(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot, before: Shows) {
        if let Some((channel, status)) = slot.notices.monitor_refused.take() {
            self.emit(cycle, now, EventKind::MonitorRefused { channel, status });
        }
        if std::mem::take(&mut slot.notices.restarted) {
            self.restarted = true;
            self.emit(cycle, now, EventKind::Restarted);
        }
        self.take_emergency(cycle, now, slot);
        let reported = Shows::of(&self.feedback.status);
        if before.inhibited != reported.inhibited {
            self.emit(cycle, now, EventKind::HardwareEnable(!reported.inhibited));
        }
        if before.state != reported.state {
            self.emit(cycle, now, EventKind::State(reported.state));
        }
        if before.fault != reported.fault {
            self.emit(cycle, now, EventKind::Fault(reported.fault));
        }
        if before.warning != reported.warning {
            self.emit(cycle, now, EventKind::Warning(reported.warning));
        }
    }

    /// Takes the emergency that the drive reported; it may come without an exchange.
    fn take_emergency(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if let Some(emergency) = slot.notices.emergency.take() {
            self.measured.emergency = Some(emergency.into());
            self.emit(cycle, now, EventKind::Emergency(emergency));
        }
    }

    /// The link as evaluated: events, loss, and a drive found running.
    #[inline]
    fn take_link(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        if self.feedback.link != self.health.link() {
            self.change_link(cycle, now, slot);
        }
    }

    #[cold]
    fn change_link(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let (before, link) = (self.feedback.link, self.health.link());
        self.feedback.link = link;
        slot.link = link;
        self.emit(cycle, now, EventKind::Link(link));
        self.losses += u64::from(link == Link::Lost && before == Link::Online && !slot.expected_silence);
        match link {
            Link::Lost if before == Link::Online => {
                self.stop(cycle, now, StopCause::LinkLost);
                // Its stop group goes on: this silence was requested, and the drive holds or moves nothing.
                self.just_stopped &= !slot.expected_silence;
            }
            Link::Online => {
                self.seen = true;
                let running = self.feedback.status.state.is_powered() || self.feedback.status.moving;
                if running && self.duty.claim() != Claim::Armed && !slot.notices.other_master {
                    self.find_running(cycle, now, Braked::BySetpoints);
                }
            }
            _ => {}
        }
    }

    /// A drive runs that this master has not enabled: it was found so, or began later.
    fn find_running(&mut self, cycle: &Cycle, now: Time, braked: Braked) {
        match *self.duty.latch() {
            // What a living master runs is not taken over.
            Latch::Down(..) | Latch::Kept(StopCause::OtherMaster) => return,
            Latch::Kept(_) => {}
            Latch::Open => self.latch(cycle, now, StopCause::FoundRunning),
        }
        // A drive that this master has commanded is never only read again.
        if self.plan.on_found_running == FoundRunning::Stop || self.duty.claim() != Claim::Found {
            self.brake(now, braked);
        }
    }

    /// Watches an axis that has power, and runs one cycle of its stop sequence.
    #[inline]
    fn watch(&mut self, cycle: &Cycle, now: Time, slot: &mut Slot) {
        let restarted = std::mem::take(&mut self.restarted);
        self.called |= self.machine.observe(cycle.grid, restarted, slot);
        // First: what follows from another master must not be named in its place.
        if std::mem::take(&mut slot.notices.other_master) {
            self.stop(cycle, now, StopCause::OtherMaster);
        }
        if std::mem::take(&mut slot.notices.fresh) {
            let follows = self.duty.follows();
            if follows.is_led && self.feedback.status.state == State::OperationEnabled {
                // It is where it is expected, and what leads it is checked before it is sent.
                self.rest.interrupt();
                if self.bounds.are_broken(Watched { homing: false, braking: false }, self.row_seconds) {
                    self.breaks(cycle, now, StopCause::Limit);
                }
            } else {
                self.watch_any(cycle, now, slot, restarted);
            }
            if self.duty.follows().stops {
                self.watch_stop(cycle, now, true);
            }
        } else if self.duty.follows().stops {
            self.watch_stop(cycle, now, false);
        }
    }

    /// The same of an axis in any state.
    #[inline(never)]
    fn watch_any(&mut self, cycle: &Cycle, now: Time, slot: &Slot, restarted: bool) {
        if let Some(cause) = self.left_operation(restarted).or_else(|| self.watch_motion(now, slot)) {
            self.breaks(cycle, now, cause);
        }
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
            // What no command has begun follows no setpoint, nor does what goes on under a stop.
            let follows = self.duty.active().is_some_and(|active| !stops(active));
            let own = !follows && matches!(cause, StopCause::Uncommanded | StopCause::Limit);
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
            self.latch(cycle, now, StopCause::StopTimeout);
            let (stop, load) = (self.plan.stop, self.plan.load);
            let (sequence, command) = StopSequence::start_escalated(stop, load, now, self.speed());
            self.duty.set_latch(Latch::Down(StopCause::StopTimeout, sequence));
            self.issue(Some(command));
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

    /// Why an axis that is expected to stay in operation is not.
    fn left_operation(&self, restarted: bool) -> Option<StopCause> {
        // Where the application owns the control word, the drive's state is the application's concern.
        let free = self.is_native(NativeOwner::Application);
        if !(self.duty.claim() == Claim::Armed || free) {
            return None;
        }
        match self.feedback.status.state {
            State::OperationEnabled | State::QuickStopActive => None,
            _ if free && !restarted => None,
            State::Fault | State::FaultReactionActive => Some(StopCause::DriveFault),
            _ if self.feedback.status.inhibited => Some(StopCause::HardwareEnable),
            _ => Some(StopCause::DriveDropped),
        }
    }

    /// What an axis with power must not do, in whatever state it is: leave its limits, or move without a command.
    fn watch_motion(&mut self, now: Time, slot: &Slot) -> Option<StopCause> {
        let state = self.feedback.status.state;
        // A drive in its fault reaction brakes by itself, and takes no request.
        if !state.is_powered() {
            self.rest.power_off();
            return None;
        }
        if state == State::FaultReactionActive {
            self.rest.interrupt();
            return None;
        }
        let seconds = self.row_seconds;
        let braking = matches!(self.duty.latch(), Latch::Down(_, sequence) if !sequence.is_down());
        // What is on already is not moved by being enabled.
        let commanded = self.duty.active().as_ref().is_some_and(|active| match active.command {
            Command::Reset | Command::ResetFault => false,
            Command::Enable => state != State::OperationEnabled,
            _ => true,
        });
        // Only the drive knows how it will brake if this loop does not command it; under torque nothing brakes it.
        let native = self.duty.active().is_some_and(|active| matches!(active.command, Command::Native(_)));
        let watched = Watched {
            homing: self.duty.active().is_some_and(|active| matches!(active.command, Command::Home)),
            braking: native || self.duty.active().is_none() || self.is_under_torque(),
        };
        let broken = self.bounds.are_broken(watched, seconds);
        if braking {
            self.rest.stop();
        } else if commanded {
            self.rest.interrupt();
        } else if !slot.status.suspect {
            let motion =
                Motion { moving: self.feedback.status.moving, velocity: self.feedback.status.velocity };
            if self.rest.moves(now, motion, &self.plan.stop, seconds) {
                return Some(if broken { StopCause::Limit } else { StopCause::Uncommanded });
            }
        }
        // The stop sequence has its own time-out.
        (broken && !braking).then_some(StopCause::Limit)
    }

    /// The application's stop has not ended in its time, although the drive answers.
    fn is_stopping_too_long(&self, now: Time) -> bool {
        self.duty.active().is_some_and(stops)
            && self.duty.latch().is_open()
            && self.answers()
            && now.since(self.began) > nanos(self.plan.stop.timeout)
    }

    /// The fastest speed at which it may be, user units/s.
    fn speed(&self) -> f64 {
        self.feedback.status.velocity.abs().max(self.bounds.speed())
    }

    /// The drive answers, so that requests reach it.
    fn answers(&self) -> bool {
        matches!(self.feedback.link, Link::Qualifying | Link::Online)
    }

    /// Stops the axis: latches the cause, flushes queue and stream, starts the stop sequence. The first cause
    /// stays. A drive that was only read until now is not ours to brake: its axis is latched, and nothing is
    /// written.
    pub fn stop(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.stop_by(Braked::BySetpoints, cycle, now, cause);
    }

    fn stop_by(&mut self, braked: Braked, cycle: &Cycle, now: Time, cause: StopCause) {
        if !self.duty.latch().is_open() {
            return;
        }
        self.latch(cycle, now, cause);
        if self.duty.claim() != Claim::Found {
            self.brake(now, braked);
        }
    }

    /// Stops the axis if it is enabled, or about to be; any other axis can do no harm.
    pub fn stop_if_armed(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        let rising = self.duty.active().is_some_and(|active| matches!(active.command, Command::Enable));
        if self.duty.claim() == Claim::Armed || rising || self.is_native(NativeOwner::Application) {
            self.stop(cycle, now, cause);
        }
    }

    /// Whether no position leads the drive, and its reported demand is meaningless.
    fn is_under_torque(&self) -> bool {
        self.duty.is_under_torque()
    }

    fn is_native(&self, owner: NativeOwner) -> bool {
        matches!(self.duty.active(), Some(QueuedCommand { command: Command::Native(own), .. }) if *own == owner)
    }

    /// Starts the stop sequence of an axis that is latched.
    fn brake(&mut self, now: Time, braked: Braked) {
        let Some(cause) = self.duty.latch().cause() else { return };
        // No ramp of velocities brakes a drive that follows torques: it would only lose its torque along the slope.
        let by_the_drive = braked == Braked::ByTheDrive || self.is_under_torque();
        let start = if by_the_drive { StopSequence::start_escalated } else { StopSequence::start };
        let (sequence, command) = start(self.plan.stop, self.plan.load, now, self.speed());
        self.duty.set_latch(Latch::Down(cause, sequence));
        self.issue(Some(command));
    }

    /// Stops an axis that is latched and moves all the same. The first cause stays; the new one is reported.
    fn stop_again(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        let speed = self.speed();
        if matches!(self.duty.latch(), Latch::Kept(_)) {
            return self.brake(now, Braked::ByTheDrive);
        }
        let command = match self.duty.sequence() {
            Some((_, sequence)) if sequence.is_down() => sequence.again(now, speed),
            _ => return,
        };
        self.rest.interrupt();
        self.just_stopped = true;
        self.emit(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
        self.issue(Some(command));
    }

    /// Latches without touching the drive.
    fn latch(&mut self, cycle: &Cycle, now: Time, cause: StopCause) {
        self.duty.set_latch(Latch::Kept(cause));
        self.disarm();
        self.just_stopped = true;
        self.feedback.stopped = Some(cause);
        self.emit(cycle, now, EventKind::Stopped(cause));
        self.flush(cycle, now, Abort::Stopped(cause));
    }

    /// It is no longer expected to stay in operation.
    fn disarm(&mut self) {
        if self.duty.claim() == Claim::Armed {
            self.duty.set_claim(Claim::Ours);
        }
    }

    /// Whether it was stopped since its group was last checked.
    pub fn just_stopped(&self) -> bool {
        self.just_stopped
    }

    /// The stop group to stop with it, once after each stop.
    pub fn take_group_stop(&mut self) -> Option<u16> {
        if std::mem::take(&mut self.just_stopped) { self.plan.stop.group } else { None }
    }

    /// The orderly end of the master: every axis is stopped and powered off, and nothing new begins. True once it
    /// is complete.
    pub fn shut_down(&mut self, cycle: &Cycle, now: Time, hurry: bool) -> bool {
        self.ends = true;
        self.stop(cycle, now, StopCause::Shutdown);
        self.flush(cycle, now, Abort::Stopped(StopCause::Shutdown));
        if matches!(self.duty.latch(), Latch::Kept(_)) && self.duty.claim() != Claim::Found {
            self.brake(now, Braked::BySetpoints);
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

    /// Publishes the feedback; returns the telemetry record of this cycle, as that of axis `axis`.
    #[inline(always)] // Its record is built in the ring.
    pub fn publish(&mut self, axis: u16) -> DriveRecord {
        self.feedback.write_to(&mut self.queues.feedback);
        if let Some(samples) = &mut self.queues.samples
            && samples.push(self.feedback).is_err()
        {
            self.queues.lost += 1;
        }
        let Feedback { cycle, link, stopped, ref status, .. } = self.feedback;
        let command = self.duty.follows().command;
        let of = Published { index: cycle, axis, link, stopped, command };
        DriveRecord::new(of, std::mem::take(&mut self.measured), status)
    }

    /// The drive has reported monitored variables in this cycle.
    #[inline]
    pub fn shows(&self) -> bool {
        self.shows
    }

    /// The monitored variables of this cycle for the telemetry, if the drive reported some; once.
    #[inline]
    pub fn take_shown(&mut self, axis: u16) -> Option<MonitorRecord> {
        let shown = std::mem::take(&mut self.shows).then_some(self.shown)?;
        Some(MonitorRecord { index: self.feedback.cycle, axis, shown })
    }

    /// Events and samples for which the queues had no room.
    #[inline]
    pub fn lost(&self) -> u64 {
        self.queues.lost
    }

    /// The loop's counts of it so far, with those of its bus.
    pub fn numbers(&self, slot: &Slot) -> DriveNumbers {
        let DriveController { losses, peaks, monitor, .. } = *self;
        DriveNumbers { counters: slot.counters, losses, peaks, monitor }
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
            if outcome != Outcome::Done {
                // The drive may still be braking.
                self.rest.fail();
            }
        }
        self.emit(cycle, now, EventKind::Ended { id: queued.id, command: queued.command.name(), outcome });
    }

    #[inline(never)]
    fn emit(&mut self, cycle: &Cycle, now: Time, kind: EventKind) {
        // Every accepted command ends exactly once: the place for that is kept from all else.
        let kept = if matches!(kind, EventKind::Ended { .. }) { 0 } else { self.queues.room_for_ends };
        let room = self.queues.events.slots() > kept;
        if !room || self.queues.events.push(Event { cycle: cycle.index, at: now, kind }).is_err() {
            self.queues.lost += 1;
        }
    }
}

/// What of a status is reported when it changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Shows {
    state: State,
    inhibited: bool,
    warning: u32,
    fault: u32,
}

impl Shows {
    #[inline]
    fn of(status: &DriveStatus) -> Shows {
        let DriveStatus { state, inhibited, warning, fault, .. } = *status;
        Shows { state, inhibited, warning, fault }
    }
}

/// What brings an axis to standstill.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Braked {
    /// The stop that its plan names: a ramp of setpoints, if it is one.
    BySetpoints,
    /// The quick stop of its drive, whatever its plan names.
    ByTheDrive,
}

/// Whether the application's command is a stop.
fn stops(active: QueuedCommand) -> bool {
    matches!(active.command, Command::Stop { .. } | Command::QuickStop)
}

#[cfg(test)]
pub(super) mod tests;
