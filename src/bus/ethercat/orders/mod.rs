//! What an order does to a drive, step by step: the control word and the setpoint.
//!
//! | file | what |
//! |---|---|
//! | `mod` | the orders of a drive, and the outputs of the next exchange |
//! | `begin` | a new order |
//! | `going` | an order that is under way |
//! | `leading` | the setpoint |
//!
//! The master makes the setpoints: a position, a velocity on its ramp, or a torque on its slope. A plan begins at
//! the last sent setpoint, so that a motion that is replaced before it was sent has no effect. While the drive does
//! not follow setpoints, they are neutral: no velocity, no torque, the actual position. Nothing is written before
//! the first order.
//!
//! No ramp of velocities brakes a drive that follows torques. A stop removes the torque along its slope, within 100
//! ms at most, and then halts the drive until standstill; a quick stop, and an order that is refused, halt it at
//! once. Then it is free: without a torque, as after it was enabled. A drive that the halt does not brake coasts,
//! until the axis' stop reaches its time-out.
//!
//! Inputs that come with a frame are from before its outputs: an output is answered by the exchange after it.
//!
//! Assumed, because the manuals are silent: halt, bit 8, holds in every mode and keeps power on; a drive that is
//! commanded to switch on and stays off without a fault has no hardware enable.

mod begin;
mod going;
mod leading;

use super::cia402::{ControlCommand, ControlWord, Mode, StatusWord};
use super::native::{NativeOutput, NativePort};
use super::plan::{KollmorgenDrive, Setpoint};
use crate::axis::command::NativeOwner;
use crate::axis::{Failure, Limits, State, Units};
use crate::bus::{Progress, Slot};
use crate::drive::planner::{Point, Trajectory};
use crate::time::{MS, S, Time, nanos};

/// The answer to an output comes with so many exchanges.
const ANSWERS: u32 = 2;
/// A drive that is commanded to switch on does so within this time, ns, or its hardware enable is missing
/// (assumed).
const ON_WITHIN_NS: u64 = 500 * MS;
/// A missing hardware enable is reported for so long, ns, after the drive was last commanded to switch on: only the
/// next such command shows whether it is back.
const DARK_NS: u64 = S;

/// The drive's last report.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Inputs {
    /// There was a report at all.
    pub seen: bool,
    /// New since the outputs were last built.
    pub fresh: bool,
    /// It is in OP: outputs count.
    pub operational: bool,
    pub status: StatusWord,
    /// By the status word.
    pub state: State,
    /// Actual position, user units, not folded into one turn.
    pub position: f64,
    /// User units/s.
    pub velocity: f64,
    /// Its fault; 0: not known.
    pub fault: u16,
    /// Its fault is known, as far as it will ever be.
    pub named: bool,
    /// Only switching it off and on ends its fault.
    pub cold: bool,
    pub mode: ModeIs,
    /// Read since it may have changed; `None`: not yet.
    pub reference: Option<Reference>,
}

impl Inputs {
    fn operating(&self) -> bool {
        self.operational && self.state == State::OperationEnabled
    }

    fn faulted(&self) -> bool {
        matches!(self.state, State::Fault | State::FaultReactionActive)
    }
}

/// Whether the drive has its reference, as it reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reference {
    Set,
    Lost,
    /// It does not report it.
    Silent,
}

/// The mode of operation that the drive is in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum ModeIs {
    /// That of its setpoint.
    #[default]
    Own,
    /// Homing.
    Homing,
    /// Another one, or on the way between two.
    Other,
}

/// The mode of operation that it shall have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ModeWanted {
    /// The one that it is in.
    AsIs,
    Own,
    Homing,
}

/// The outputs for the drive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Outputs {
    pub control: ControlWord,
    pub setpoint: i32,
}

/// The quantity of the setpoint, and its scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Kind {
    Position,
    /// Raw setpoint of one user unit/s; negative if the axis is inverted.
    Velocity(f64),
    /// Raw setpoint of one per cent of the rated torque; negative if the axis is inverted.
    Torque(f64),
    /// An unknown quantity: it stays 0.
    Zero,
}

/// The orders of one drive.
#[derive(Debug)]
pub(super) struct Orders {
    units: Units,
    limits: Limits,
    kind: Kind,
    /// Bits that the mode of the setpoint needs while the drive is in operation.
    mode_bits: u16,
    /// It has a control word; and it reports no position, although its setpoint is one.
    controlled: bool,
    blind: bool,
    /// Something stops the drive if the master dies, or nothing has to.
    watched: bool,
    /// Without that it takes no velocity and no torque.
    needs_watch: bool,
    /// It was found with another watchdog, and is not set up again yet.
    found_otherwise: bool,
    deceleration: f64,
    standstill: f64,
    interval_ns: u64,
    /// Intervals between two exchanges.
    per_second: f64,
    enable_timeout_ns: u64,
    home_timeout_ns: u64,

    serial: u64,
    /// The order has begun: the drive was seen.
    begun: bool,
    /// Nothing of this order was sent yet.
    new: bool,
    /// Nor can it be: the drive that it takes over moves by itself, and is taken over again until outputs reach it.
    reclaims: bool,
    step: Step,
    since: Time,
    /// Requests sent since the step began, and answers to them.
    sent: u32,
    /// Answers at standstill in a row.
    still: u32,
    answers: u32,
    end: Option<Result<(), Failure>>,
    /// `Slot::progress` reports it.
    progress_told: bool,

    /// Something is written.
    writes: bool,
    /// It was found running in a mode that is not that of its setpoint: that is unchanged until standstill.
    foreign: bool,
    /// It is, or was, in another mode than that of its setpoint.
    away: bool,
    /// Without halt, and the bits of modes.
    control: ControlWord,
    start: bool,
    halt: bool,
    /// What a rising enable falls back to.
    rest: ControlWord,
    /// The control words of the last exchange that went out, and of the one before.
    control_sent: Option<ControlWord>,
    control_before: Option<ControlWord>,
    /// Both command it to be on.
    told_on: bool,

    /// The setpoint follows `motion`; otherwise it is neutral.
    leads: bool,
    motion: Trajectory,
    /// How much of the motion was sent, and the point there.
    passed_ns: u64,
    demand: Point,
    /// The same with the exchange that is built.
    next_ns: u64,
    next: Point,
    /// The state before a new order.
    before: Before,
    grid: Time,
    sent_at: Option<Time>,
    built: Outputs,
    /// The setpoints of the last exchange that went out, and of the one before.
    setpoints: (i32, i32),

    native: Option<NativeOutput>,
    native_gone: bool,
    /// It was powered while it was commanded to be; commanded since; off although it was commanded on.
    was_powered: bool,
    told_on_since: Option<Time>,
    dark: bool,
    dark_at: Option<Time>,
}

/// The state behind the outputs, from before an order of which nothing was sent yet.
#[derive(Clone, Copy, Debug)]
struct Before {
    writes: bool,
    step: Step,
    control: ControlWord,
    start: bool,
    halt: bool,
    leads: bool,
    foreign: bool,
    away: bool,
    motion: Trajectory,
    passed_ns: u64,
    demand: Point,
}

/// The step of an order.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u8)]
enum Step {
    Idle,
    /// From state to state, each seen.
    Enabling,
    Disabling,
    /// At a velocity or a torque, towards a position limit if there is one ahead.
    Turning(Turning),
    /// A position limit is near: it stops before it.
    Limited {
        limit: f64,
    },
    Moving,
    FollowWaiting,
    Following {
        row: u64,
        last: bool,
        point: Point,
    },
    /// Without a setpoint that advances: until standstill.
    Stopping,
    /// Halted until standstill; then it stays there without the halt.
    Halting,
    /// Homing: until the drive is known to be in operation ...
    HomeWaiting,
    /// ... until it is in the mode ...
    HomeMode,
    /// ... until it reports that it has found home ...
    Homing,
    /// ... until standstill ...
    HomeStopping(Result<(), Failure>),
    /// ... until it is back in its own mode, and its reference was read.
    HomeLeaving(Result<(), Failure>),
    /// A fault whose reaction is under way, or whose name has not come.
    ResetWaiting,
    /// Without the reset bit, so that it has an edge.
    ResetLow,
    Resetting,
    Native(NativeOwner),
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Turning {
    /// Of the velocity; the slope of a torque.
    acceleration: f64,
    /// The planned velocity or torque.
    velocity: f64,
    /// The limit in its direction.
    limit: Option<f64>,
}

impl Orders {
    pub(super) fn new(drive: &KollmorgenDrive, interval_ns: u64) -> Orders {
        let axis = &drive.axis;
        let setpoint = drive.setpoint();
        let turns = axis.units.counts_per_unit / drive.scaling.increments();
        let kind = match setpoint {
            Some(Setpoint::Position(_)) => Kind::Position,
            Some(Setpoint::Velocity(_)) => Kind::Velocity(turns * 60.0 / drive.scaling.rpm_per_count),
            Some(Setpoint::Torque(_)) => {
                let permille = 10.0_f64.copysign(axis.units.counts_per_unit);
                Kind::Torque(permille / drive.scaling.permille_per_count)
            }
            None => Kind::Zero,
        };
        let mode = drive.mode.or(setpoint.map(|setpoint| setpoint.mode(drive.family)));
        let motion = Trajectory::on(Point::default());
        Orders {
            units: axis.units,
            limits: axis.limits,
            kind,
            mode_bits: if mode == Some(Mode::INTERPOLATED) { ControlWord::START } else { 0 },
            controlled: drive
                .outputs
                .entries
                .iter()
                .any(|entry| entry.object == super::station::CONTROL_WORD),
            blind: kind == Kind::Position && !super::station::tells_position(drive),
            // A position is held, even if the master dies.
            watched: drive.slave.watchdog_ns.is_some(),
            needs_watch: !drive.accept_no_watchdog && kind != Kind::Position,
            found_otherwise: false,
            deceleration: axis.profile.deceleration,
            standstill: axis.stop.standstill,
            interval_ns,
            per_second: 1e9 / interval_ns.max(1) as f64,
            enable_timeout_ns: nanos(axis.enable_timeout),
            home_timeout_ns: nanos(axis.home_timeout),
            serial: 0,
            begun: true,
            new: false,
            reclaims: false,
            step: Step::Idle,
            since: Time(0),
            sent: 0,
            still: 0,
            answers: 0,
            end: None,
            progress_told: true,
            writes: false,
            foreign: false,
            away: false,
            control: ControlWord(0),
            start: false,
            halt: false,
            rest: ControlWord(0),
            control_sent: None,
            control_before: None,
            told_on: false,
            leads: false,
            motion,
            passed_ns: 0,
            demand: Point::default(),
            next_ns: 0,
            next: Point::default(),
            before: Before {
                writes: false,
                step: Step::Idle,
                control: ControlWord(0),
                start: false,
                halt: false,
                leads: false,
                foreign: false,
                away: false,
                motion,
                passed_ns: 0,
                demand: Point::default(),
            },
            grid: Time(0),
            sent_at: None,
            built: Outputs::default(),
            setpoints: (0, 0),
            native: None,
            native_gone: true,
            was_powered: false,
            told_on_since: None,
            dark: false,
            dark_at: None,
        }
    }

    /// Works on the order in `slot`, and returns the outputs for the request of `grid`.
    #[inline]
    pub(super) fn advance(
        &mut self,
        grid: Time,
        inputs: &Inputs,
        slot: &mut Slot,
        native: &mut NativePort,
    ) -> Outputs {
        self.grid = grid;
        if slot.order.serial != self.serial {
            self.replace(grid, inputs, slot, native);
        } else if !self.begun {
            self.begin_late(grid, inputs, slot);
        } else if self.end.is_none() {
            self.go_on(grid, inputs, slot);
        } else if inputs.fresh && self.leads && !inputs.operating() && self.answers >= ANSWERS {
            // It fell out of operation: it does not return by itself.
            self.let_go();
        }
        if !self.progress_told {
            (slot.progress, self.progress_told) = (Progress { serial: self.serial, end: self.end }, true);
        }
        self.lead(inputs, slot);
        if self.is_native() {
            self.take_native(native);
        }
        self.built = self.outputs();
        self.built
    }

    /// The native output of the application, if that is sent, and who owns the control word.
    #[inline]
    pub(super) fn native(&self) -> Option<(&NativeOutput, NativeOwner)> {
        match (&self.native, self.step) {
            (Some(output), Step::Native(owner)) => Some((output, owner)),
            _ => None,
        }
    }

    /// Native mode runs.
    pub(super) fn is_native(&self) -> bool {
        matches!(self.step, Step::Native(_))
    }

    /// The quantity of its setpoint.
    pub(super) fn kind(&self) -> Kind {
        self.kind
    }

    /// Its watchdog is set as configured, or was found otherwise.
    pub(super) fn watched(&mut self, as_configured: bool) {
        self.found_otherwise = !as_configured;
    }

    /// Something is written, since the first order.
    pub(super) fn writes(&self) -> bool {
        self.writes
    }

    /// The last built exchange was sent.
    #[inline]
    pub(super) fn sent(&mut self) {
        (self.passed_ns, self.demand) = (self.next_ns, self.next);
        self.sent_at = Some(self.grid);
        self.setpoints = (self.built.setpoint, self.setpoints.0);
        self.control_went_out(self.built.control);
        self.sent = self.sent.saturating_add(1);
        (self.new, self.native_gone) = (false, true);
    }

    #[inline]
    fn control_went_out(&mut self, control: ControlWord) {
        if self.control_sent == Some(control) && self.control_before == Some(control) {
            return;
        }
        self.control_before = self.control_sent.replace(control);
        let on = ControlWord::ENABLE_VOLTAGE | ControlWord::NO_QUICK_STOP;
        let told = |word: Option<ControlWord>| word.is_some_and(|word| word.has(on));
        self.told_on = told(self.control_sent) && told(self.control_before);
    }

    /// An exchange was answered, by a drive that outputs reach.
    #[inline]
    pub(super) fn answered(&mut self) {
        if self.sent > 0 {
            self.answers = self.answers.saturating_add(1);
        }
    }

    /// Outputs no longer reach the drive: the running motion has ended.
    pub(super) fn dropped(&mut self, state: State) {
        (self.was_powered, self.told_on_since, self.dark) = (false, None, false);
        if !self.writes {
            return;
        }
        let runs = !matches!(self.step, Step::Idle | Step::Disabling | Step::ResetWaiting);
        if runs && self.end.is_none() && self.begun {
            self.finish(Err(Failure::Dropped(state)));
        }
        if self.control != ControlWord(0) {
            self.let_go();
        }
    }

    /// The drive has lost its commands: no earlier value is written again.
    pub(super) fn drive_restarted(&mut self) {
        self.dropped(State::SwitchOnDisabled);
        if self.writes {
            self.set(ControlWord(0));
        }
        (self.control_sent, self.control_before, self.told_on) = (None, None, false);
    }

    /// The mode of operation that the drive shall have.
    pub(super) fn mode_wanted(&self) -> ModeWanted {
        match self.step {
            _ if !self.writes || self.foreign => ModeWanted::AsIs,
            Step::HomeMode | Step::Homing | Step::HomeStopping(_) => ModeWanted::Homing,
            // The application's, if it owns all of it.
            Step::Native(NativeOwner::Application) => ModeWanted::AsIs,
            _ => ModeWanted::Own,
        }
    }

    /// The drive refuses the mode of homing, or its homing cannot be configured.
    pub(super) fn mode_refused(&mut self) {
        if matches!(self.step, Step::HomeMode) && self.end.is_none() {
            self.finish(Err(Failure::Unsupported(
                "the drive refuses the homing mode or its method: look at 6060h and 6098h, and at home_method",
            )));
        }
    }

    /// The setpoint of the last sent exchange, if it is one.
    #[inline]
    pub(super) fn setpoint_sent(&self) -> i32 {
        self.setpoints.0
    }

    /// Something moves the drive: the setpoint of the last sent exchange.
    #[inline]
    pub(super) fn is_moving(&self) -> bool {
        match self.kind {
            Kind::Position => self.leads && self.setpoints.0 != self.setpoints.1 || self.step == Step::Homing,
            Kind::Velocity(_) | Kind::Torque(_) => self.setpoints.0 != 0 || self.step == Step::Homing,
            Kind::Zero => self.step == Step::Homing,
        }
    }

    /// The drive homes: its positions are about to change their origin.
    #[inline]
    pub(super) fn is_homing(&self) -> bool {
        matches!(self.step, Step::Homing | Step::HomeStopping(_) | Step::HomeLeaving(_))
    }

    /// Its reference may change any time.
    #[inline]
    pub(super) fn is_finding_home(&self) -> bool {
        matches!(self.step, Step::Homing | Step::HomeStopping(_))
    }

    /// Its hardware enable was missing when it was last commanded to switch on, not long ago.
    #[inline]
    pub(super) fn is_inhibited(&self, now: Time) -> bool {
        self.dark_at.is_some_and(|dark_at| now.since(dark_at) < DARK_NS)
    }

    /// Checks its report: whether it stays off although it is commanded to switch on.
    #[inline]
    pub(super) fn look(&mut self, inputs: &Inputs) {
        if !(inputs.operational && self.told_on) {
            (self.was_powered, self.told_on_since, self.dark) = (false, None, false);
            return;
        }
        if inputs.state.is_powered() {
            (self.was_powered, self.told_on_since, self.dark) = (true, None, false);
        } else if !inputs.faulted() {
            let since = *self.told_on_since.get_or_insert(self.grid);
            self.dark = self.was_powered || self.grid.since(since) > ON_WITHIN_NS;
            if self.dark {
                self.dark_at = Some(self.grid);
            }
        }
    }

    #[inline(never)]
    fn take_native(&mut self, native: &mut NativePort) {
        // Each one is sent, even if a request fails.
        if self.native_gone
            && let Some(output) = native.next()
        {
            (self.native, self.native_gone) = (Some(output), false);
        }
    }

    fn enter(&mut self, now: Time, step: Step) {
        (self.step, self.since) = (step, now);
        (self.sent, self.still, self.answers) = (0, 0, 0);
    }

    fn finish(&mut self, end: Result<(), Failure>) {
        (self.end, self.progress_told) = (Some(end), false);
        self.step = Step::Idle;
        self.start = false;
    }

    /// Ends an order that cannot be carried out, and stops a running drive: it has no commander any more.
    fn refuse(&mut self, failure: Failure) {
        self.halt |= self.is_free() && !self.stands();
        self.wind_down();
        self.finish(Err(failure));
    }

    /// Brings a running motion to its end.
    fn wind_down(&mut self) {
        if self.leads && !self.stands() {
            self.brake(self.deceleration);
        }
    }

    /// It follows torques: without one nothing brakes it.
    fn is_free(&self) -> bool {
        matches!(self.kind, Kind::Torque(_)) && self.leads
    }

    /// Ends the order as failed, and releases the drive.
    fn give_up(&mut self, failure: Failure) {
        self.finish(Err(failure));
        self.let_go();
    }

    /// The drive has left operation, or is to: it stops, if it still turns, and does not come back by itself.
    fn let_go(&mut self) {
        self.set(ControlCommand::QuickStop.word());
    }

    /// Setpoints do not count with this word.
    fn set(&mut self, control: ControlWord) {
        self.writes = true;
        (self.control, self.leads, self.halt, self.start) = (control, false, false, false);
        (self.foreign, self.away, self.native) = (false, false, None);
    }
}
