//! One drive machine for all protocols: what a command does to a drive, step by step. Commands go in, the desired state
//! of the drive comes out.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the machine: a command waits, its first request leaves, its end is seen |
//! | `view` | what it works with |
//! | `begin` | a new command, but for moves and velocities |
//! | `steps` | a command that is under way, with each report of the drive |
//! | `motion` | moves, velocities and rows of drives that make their own setpoints |
//! | `setpoint` | the setpoint of the next send, where the master makes it |
//!
//! [`propose`](Machine::propose) may be called again, for the same send or for a later one. What a command does becomes
//! the state with [`commit`](Machine::commit), once its first request has gone out. So a command that is replaced
//! before it left has no effect. Reports of the drive change the state in
//! [`observe`](Machine::observe): they are facts.
//!
//! Each end needs two things: the drive has accepted the request, as far as its wire can prove, and reports after that
//! that it is done.

mod begin;
mod motion;
mod setpoint;
mod steps;
#[cfg(test)]
mod tests;
mod view;

use self::begin::OTHER_MODE;
use self::motion::Rolling;
use self::setpoint::{Course, Turning};
pub use self::view::{Input, NumberedRow};
use self::view::{Rules, View};
use super::planner::Point;
use crate::axis::command::NativeOwner;
use crate::axis::limits::check_position;
use crate::axis::{AxisPlan, Command, Failure, Lacks, Move, Row, State as Cia402, Target, Units};
use crate::bus::desired::{
    Capabilities, Desired, Follows, Generator, Intent, Mode, ModeIs, Motion, Power, Setpoint, Velocities,
};
use crate::bus::{Prepared, Slot};
use crate::time::{Time, nanos};

/// How a command has ended; `None`: it is under way.
type End = Option<Result<(), Failure>>;

/// The machine of one drive. What most cycles look at is one cache line here, and one at the begin of the state.
#[derive(Debug)]
#[repr(C, align(64))]
pub struct Machine {
    /// The command of which nothing has left yet.
    waiting: Option<Waiting>,
    /// The input that the command follows.
    pub input: Input,
    /// The state after the requests that went out; proposed is the first request of the command that waits.
    state: Prepared<State>,
    /// The newest command, and how it has ended.
    command: Option<Command>,
    end: End,
    rules: Rules,
}

/// A command before its first request.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    /// `None`: to take the drive over as it is.
    command: Option<Command>,
    /// It has failed, and what it has replaced ends.
    failed: bool,
    since: Time,
    /// The command before it failed before anything of that left: what that had replaced still has to end.
    quits: bool,
}

/// The state of a drive as the master wants it, and how far it is on its way there.
#[derive(Clone, Debug, Default, PartialEq)]
#[repr(C, align(64))]
struct State {
    /// Sends since the step began.
    sent: u32,
    /// Reports in a row that show the end of the step.
    agree: u16,
    /// The intents are not in the slot yet.
    is_new: bool,
    /// The master makes the setpoints.
    has_course: bool,
    step: Step,
    course: Course,
    /// When the command began; a step that begins its time anew sets it again.
    since: Time,
    power: Intent<Power>,
    mode: Intent<Mode>,
    motion: Intent<Motion>,
    serial: u64,
    /// The number of the last row of the application that was sent.
    row: u64,
    setpoint: Setpoint,
}

/// The step of a command.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Step {
    #[default]
    Idle,
    /// From state to state into operation, each seen; it falls back to this. `EnableOperation`: it was in operation.
    Enabling {
        rest: Power,
    },
    /// Out of operation, or off.
    Falling,
    /// Homing: until standstill ...
    HomeWaiting,
    /// ... until the drive is in the mode ...
    HomeMode,
    /// ... until it reports that it has found home ...
    Homing,
    /// ... until standstill ...
    HomeStopping(Result<(), Failure>),
    /// ... until it is back in its own mode, and its reference was read.
    HomeLeaving(Result<(), Failure>),
    /// Acknowledging a fault.
    Resetting(Reset),
    /// To a target ...
    Moving(f64),
    /// ... where the demand is, until the actual position is there, too. So many reports in a row show that the drive
    /// stands.
    Arriving {
        target: f64,
        stood: u8,
    },
    /// At a velocity that the drive makes.
    Rolling(Rolling),
    /// At a velocity or a torque of the master, towards a position limit if there is one ahead.
    Turning(Turning),
    /// A position limit is near: it stops before it.
    Limited(f64),
    FollowWaiting,
    Following,
    /// The last row has been sent, and rows at standstill follow it. So many reports have shown that another one of
    /// all these was accepted, the last of them `newest`: `taken` since the demand came to `stood_at`, `all` since the
    /// last row.
    FollowEnding {
        taken: u16,
        all: u16,
        newest: u64,
        stood_at: f64,
        last: Row,
    },
    /// It moves, and does not follow what is written yet: what is to be done then.
    TakingOver(Command),
    /// Along a ramp, to standstill.
    Stopping,
    /// Halted until standstill ...
    Halting,
    /// ... then released, and still there.
    Released,
    /// It moves without a setpoint: it stands only while it is halted.
    Halted,
    Native(NativeOwner),
}

/// How far the reset of a fault is.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Reset {
    /// The fault cannot be acknowledged yet.
    Waiting,
    /// Without the reset, so that it has an edge.
    Low,
    /// With it, until the drive has it ...
    High,
    /// ... and until the fault is gone.
    Sent,
    Done,
}

impl Machine {
    /// A machine for the drive of `axis`, in a cycle of `period_ns`.
    pub fn new(axis: &AxisPlan, can: Capabilities, period_ns: u64) -> Machine {
        let rules = Rules::new(axis, can, period_ns);
        let state = State { is_new: true, has_course: rules.quantity.is_some(), ..State::default() };
        Machine {
            waiting: None,
            input: Input::default(),
            state: Prepared::new(state),
            command: None,
            end: None,
            rules,
        }
    }

    /// A new command, in place of the one before; `None`: to take the drive over as it is.
    pub fn start(&mut self, now: Time, command: Option<Command>) {
        let quits = self.waiting.is_some_and(|before| before.quits || before.failed);
        self.waiting = Some(Waiting { command, failed: false, since: now, quits });
        self.state.withdraw();
        (self.command, self.end) = (command, None);
        // The others begin without a velocity or torque, until they are given one.
        let level = if let Some(Command::Jog(jog)) = command { jog.velocity } else { 0.0 };
        self.input = Input { level, row: None };
    }

    /// The capabilities that its drive lacks.
    pub fn lacks(&self) -> &Lacks {
        &self.rules.can.lacks
    }

    /// The newest command; `None`: the drive is left as it is.
    pub fn command(&self) -> Option<Command> {
        self.command
    }

    /// The demand of the newest command is the master's: its setpoints, rows, or a target that rolls ahead.
    pub fn makes_demand(&self) -> bool {
        match (self.rules.can.generator, self.command) {
            (Generator::Master(_), _) | (_, Some(Command::Follow)) => true,
            (Generator::Drive { velocities }, Some(Command::Jog(_) | Command::Velocity { .. })) => {
                matches!(velocities, Some(Velocities::Leash(_)))
            }
            (Generator::Drive { .. }, _) => false,
        }
    }

    /// How the newest command has ended; `None`: it is under way, or there is none.
    #[inline]
    pub fn end(&self) -> End {
        self.end
    }

    /// The newest command ends like this, whatever its drive does.
    #[cfg(test)]
    pub fn end_with(&mut self, end: Result<(), Failure>) {
        self.end = Some(end);
    }

    /// The newest command, and since when it waits for its first request.
    #[cfg(test)]
    pub fn newest(&self) -> (Option<Command>, Option<Time>) {
        (self.command, self.waiting.map(|waiting| waiting.since))
    }

    /// Writes the desired state of the next send into the slot.
    #[inline(always)] // Once for each axis and cycle.
    pub fn keeps(&self, slot: &Slot) -> bool {
        self.waiting.is_none() && self.state.left().keeps_setpoint(&self.input, slot)
    }

    /// Writes what is desired of the drive with the send in slot `grid`. Returns whether the newest command has ended.
    #[inline]
    pub fn propose(&mut self, grid: Time, slot: &mut Slot) -> bool {
        if self.keeps(slot) {
            return false;
        }
        self.plan(grid, slot);
        self.end.is_some()
    }

    #[inline(never)]
    fn plan(&mut self, grid: Time, slot: &mut Slot) {
        let view = View::of(&self.rules, &self.input, grid, slot);
        // A setpoint is planned from the last one that was sent: what was not sent leaves nothing behind.
        let (begun, waits) = match &mut self.waiting {
            None => (None, false),
            Some(waiting) => waiting.begin(&mut self.state, &view),
        };
        let state = self.state.proposed_mut();
        let led = state.lead(&view);
        if begun.is_some() || led.is_some() {
            self.end = self.end.or(begun).or(led);
        }
        if state.is_new {
            slot.desired = state.desired();
        } else {
            slot.desired.setpoint = state.setpoint;
        }
        if self.waiting.is_some() {
            // No serial is used twice: what is replaced before it left is another intent.
            let serial = state.serial;
            self.state.left_mut().serial = serial;
            if waits {
                self.state.withdraw();
            }
        }
    }

    /// The proposed request has gone out in this slot of the grid.
    #[inline]
    pub fn commit(&mut self, grid: Time) {
        if self.waiting.is_some() {
            self.commit_command();
        }
        self.state.left_mut().sent(grid);
    }

    #[cold]
    fn commit_command(&mut self) {
        if self.state.is_proposed() {
            self.waiting = None;
            self.state.take_over();
        }
    }

    /// The reports of a cycle. Returns whether the newest command has ended.
    #[inline(always)] // Once for each axis and cycle.
    pub fn observe(&mut self, now: Time, restarted: bool, slot: &Slot) -> bool {
        if self.waiting.is_none() && !restarted && self.state.left().is_undisturbed(&self.input, slot) {
            return false;
        }
        self.go_on(now, restarted, slot);
        self.end.is_some()
    }

    #[inline(never)]
    fn go_on(&mut self, now: Time, restarted: bool, slot: &Slot) {
        let view = View::of(&self.rules, &self.input, now, slot);
        let state = self.state.left_mut();
        let end = match &self.waiting {
            _ if restarted => state.drive_restarted(&view),
            Some(waiting) if waiting.failed => None,
            // What it replaces has ended for the application.
            Some(waiting) => {
                let late = now.since(waiting.since) > nanos(self.rules.axis.enable_timeout);
                (late && waiting.has_a_time_limit()).then_some(Err(Failure::TimedOut(slot.status.state)))
            }
            None => state.go_on(&view),
        };
        if let Some(end) = end
            && self.end.is_none()
        {
            self.end = Some(end);
            if let Some(waiting) = &mut self.waiting {
                waiting.failed = true;
            }
        }
    }
}

/// On a rotary axis, the place of `position` that is nearest to `from`.
fn near(units: &Units, from: f64, position: f64) -> f64 {
    match units.modulo {
        Some(_) => from + units.way(from, position),
        None => position,
    }
}

impl Rules {
    /// Of a motion that would leave the position limits, or has to end at one: at this place.
    pub fn out_of_limits(&self, value: f64) -> Failure {
        let (low, high) = self.axis.limits.position.unwrap_or((value, value));
        Failure::Limit { what: "position", value, low, high }
    }

    /// The requested deceleration, or the one needed to stop within the limits `lost` units behind this point: the
    /// deceleration of a motion that replaces a fast one may be too weak for the remaining way. Never more than the
    /// limit of acceleration, or than the axis' own profile if there is no limit.
    pub fn braking(&self, requested: f64, from: Point, lost: f64) -> f64 {
        let Point { position, velocity } = from;
        let Some((low, high)) = self.axis.limits.position.filter(|_| velocity != 0.0) else {
            return requested;
        };
        let room = if velocity > 0.0 { high - position } else { position - low } - lost;
        let most = self.axis.limits.acceleration.unwrap_or(self.axis.profile.deceleration);
        let needed = if room > 0.0 { velocity * velocity / (2.0 * room) } else { most };
        requested.max(needed.min(most))
    }
}

impl Waiting {
    /// Begins it in a state that is only proposed. Returns how the command has ended, and whether it waits on.
    fn begin(&mut self, prepared: &mut Prepared<State>, view: &View) -> (End, bool) {
        // Its revision is of no interest: it is built again for each send.
        let mut state = prepared.propose(0);
        state.is_new = true;
        // Where another mode has ended is where it begins.
        state.course.watch_mode(view);
        if self.quits {
            state.quit(view);
        }
        let end = if self.failed { None } else { state.begin(self.command, self.since, view) };
        // What is to be taken over may not be known yet.
        let waits = end.is_none() && !self.failed && view.status.state == Cia402::Unknown;
        if matches!(end, Some(Err(_))) {
            // Nothing of it is written, however often this is proposed.
            self.failed = true;
            let serial = state.serial;
            state = prepared.propose(0);
            (state.serial, state.is_new) = (serial, true);
        }
        if self.failed {
            state.quit(view);
        }
        (end, waits)
    }

    /// It fails if no request with it leaves in time. A stop waits for as long as it takes.
    fn has_a_time_limit(&self) -> bool {
        matches!(self.command, Some(Command::Enable | Command::Disable | Command::Home | Command::ResetFault))
    }
}

impl State {
    /// Begins a command that waits since `since`.
    #[inline(never)]
    fn begin(&mut self, command: Option<Command>, since: Time, view: &View) -> End {
        if let Some(command) = &command {
            if let Some(failure) = view.rules.can.lacks.refuses(command) {
                return self.refuse(failure, view);
            }
            if view.status.state == Cia402::Unknown {
                // What is to be taken over is not known yet.
                return None;
            }
        }
        if !self.writes() || matches!(self.step, Step::Native(_)) {
            // The state that the application left the drive in is the present state.
            self.claim(view);
        }
        let Some(command) = command else { return self.done() };
        match command {
            // It requests nothing of the drive.
            Command::Reset => self.done(),
            Command::Disable | Command::Stop { .. } | Command::QuickStop
                if view.status.state.is_powered()
                    && let Follows::Never(why) = view.evidence.follows =>
            {
                self.fail(Failure::Unsupported(why))
            }
            Command::Enable => self.begin_enable(since, view),
            Command::Disable => {
                self.set(Power::Off);
                self.begin_step(since, Step::Falling)
            }
            Command::Home => self.begin_home(since, view),
            Command::Stop { .. } | Command::QuickStop => self.begin_stop(command, view),
            Command::ResetFault if !view.evidence.fault.active => self.done(),
            Command::ResetFault => self.begin_reset(since, view),
            Command::Native(owner) => self.begin_native(owner, view),
            _ if !self.runs(view) => self.fail(Failure::WrongState(view.status.state)),
            _ if view.evidence.mode != ModeIs::Own => self.refuse(OTHER_MODE, view),
            Command::Move(motion) => self.begin_move(&motion, view),
            Command::Jog(jog) => self.begin_velocity(jog.acceleration, view),
            Command::Velocity { acceleration } => self.begin_velocity(acceleration, view),
            Command::Torque { slope } => self.begin_velocity(slope, view),
            Command::Follow => self.begin_follow(view),
        }
    }

    fn begin_move(&mut self, motion: &Move, view: &View) -> End {
        self.end_halt(view);
        let from = self.demand(view);
        let target = match motion.target {
            Target::Absolute(position) => near(&view.rules.axis.units, from, position),
            Target::Relative(distance) => from + distance,
        };
        if let Err(failure) = check_position(&view.rules.axis.limits, target) {
            return self.refuse(failure, view);
        }
        if view.drive_makes_setpoints() {
            return self.move_by_drive(target, &motion.profile, Step::Moving(target), view);
        }
        self.course.go_to(target, &motion.profile, view);
        self.follow_course();
        self.begin_step(view.now, Step::Moving(target))
    }

    fn begin_velocity(&mut self, acceleration: f64, view: &View) -> End {
        self.end_halt(view);
        let velocities = match view.rules.can.generator {
            Generator::Drive { velocities } => velocities,
            Generator::Master(_) => return self.begin_turning(acceleration, view),
        };
        match velocities {
            Some(Velocities::Leash(leash)) => self.begin_rolling(acceleration, Some(leash), view),
            Some(Velocities::Own { .. }) => self.begin_rolling(acceleration, None, view),
            // Refused on submission.
            None => None,
        }
    }

    fn desired(&self) -> Desired {
        Desired { power: self.power, mode: self.mode, motion: self.motion, setpoint: self.setpoint }
    }

    /// Something is written.
    fn writes(&self) -> bool {
        self.power.serial > 0
    }

    fn sent(&mut self, grid: Time) {
        self.sent = self.sent.saturating_add(1);
        self.is_new = false;
        if self.has_course {
            self.course.sent(grid);
        }
    }

    fn next_serial(&mut self) -> u64 {
        self.is_new = true;
        self.serial += 1;
        self.serial
    }

    fn want_power(&mut self, value: Power) {
        if self.power.value != value || self.power.serial == 0 {
            self.power = Intent { serial: self.next_serial(), value };
        }
    }

    fn want_mode(&mut self, value: Mode) {
        if self.mode.value != value {
            self.mode = Intent { serial: self.next_serial(), value };
        }
    }

    /// A motion is a new one, even if it looks like the one before.
    fn want_motion(&mut self, value: Motion) {
        if value != Motion::Hold || self.motion.value != Motion::Hold {
            self.motion = Intent { serial: self.next_serial(), value };
        }
    }

    /// Another course of the setpoint, which the master makes.
    fn follow_course(&mut self) {
        self.motion = Intent { serial: self.next_serial(), value: Motion::Hold };
    }

    /// The next step of the command, which is under way. Its time goes on.
    fn enter(&mut self, step: Step) -> End {
        (self.step, self.agree, self.sent) = (step, 0, 0);
        None
    }

    /// The same, and its time begins.
    fn begin_step(&mut self, now: Time, step: Step) -> End {
        self.since = now;
        self.enter(step)
    }

    /// The command is over, and so is its motion: what the drive does from now on is no part of it.
    fn done(&mut self) -> End {
        self.rest();
        Some(Ok(()))
    }

    /// The command is over. A motion that has failed for the application must not run once the drive can accept it.
    fn fail(&mut self, failure: Failure) -> End {
        self.rest();
        Some(Err(failure))
    }

    /// No motion is wanted. A ramp to standstill stays until it was accepted: the drive may not have it yet.
    fn rest(&mut self) {
        if !matches!(self.motion.value, Motion::Ramp { .. }) {
            self.want_motion(Motion::Hold);
        }
        self.enter(Step::Idle);
    }

    /// The drive has the newest power and motion.
    fn is_accepted(&self, view: &View) -> bool {
        self.has_power(view) && view.evidence.accepted.motion >= self.motion.serial
    }

    fn has_power(&self, view: &View) -> bool {
        view.fresh && !view.status.suspect && view.evidence.accepted.power >= self.power.serial
    }

    /// True once `reports` reports in a row show it, this one included.
    fn agrees(&mut self, shown: bool, reports: impl Into<u16>, view: &View) -> bool {
        if !view.fresh || view.status.suspect {
            return false;
        }
        self.agree = if shown { self.agree.saturating_add(1) } else { 0 };
        self.agree >= reports.into()
    }

    /// Off, and neutral.
    fn set(&mut self, power: Power) {
        self.want_power(power);
        self.want_mode(Mode::Own);
        self.want_motion(Motion::Hold);
        self.course.end();
    }

    /// The drive has left operation, or is to: it stops, if it still moves, and does not come back by itself.
    fn let_go(&mut self, view: &View) {
        let off = !view.status.state.is_powered() && view.evidence.outputs_count;
        self.set(if off { Power::Off } else { Power::QuickStop });
    }

    /// In operation, at this place.
    fn hold(&mut self, position: f64) {
        self.run_from(Point { position, velocity: 0.0 });
    }

    fn run_from(&mut self, point: Point) {
        self.want_power(Power::EnableOperation);
        self.want_motion(Motion::Hold);
        self.lead_from(point);
    }

    /// The drive has lost its commands: no earlier value is written again.
    fn drive_restarted(&mut self, view: &View) -> End {
        if self.writes() {
            self.set(Power::Off);
        }
        match self.step {
            // What they wait for comes all the same.
            Step::Idle | Step::Falling | Step::Resetting(_) => None,
            _ => self.fail(Failure::Dropped(view.status.state)),
        }
    }
}
