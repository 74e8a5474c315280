//! The drive behind the telegrams: state machine, homing, errors, and the motor that follows the demand.
//!
//! Knows no bytes and no sockets. Time comes in steps; a control word is followed by one transition a step, as in a
//! drive whose control loop is faster than its bus.

use super::motion::{Demand, METRE, METRE_PER_S, METRE_PER_S2, Setpoints};
use crate::bus::linudp::motion::Decoded;
use crate::bus::linudp::plan::SimPlan;
use crate::bus::linudp::wire::{
    ControlWord, ErrorCode, MainState, MotionBlock, StateVar, StatusWord, WarnWord,
};
use crate::sim::physics::{Plant, PlantPlan};
use crate::time::{MS, Time};

/// Hardware tests of state 5 (SG5 manual: about 300 ms).
const HW_TESTS_NS: u64 = 300 * MS;

// What a real drive takes from its parameters: velocities in m/s, accelerations in m/s2, lengths in m.
const HOMING_VELOCITY: f64 = 0.1;
const JOG_VELOCITY: f64 = 0.02;
const GO_TO_VELOCITY: f64 = 0.1;
const OWN_ACCELERATION: f64 = 1.0;
const IN_POSITION: f64 = 50e-6;
const LAG_WARNING: f64 = 1e-3;
const LAG_ERROR: f64 = 5e-3;

/// Force constant of the motor, N/A.
const NEWTON_PER_AMPERE: f64 = 20.0;

/// The motion of a drive that is found running: slow, so that it lasts, and this far from the ends of the range.
const SHUTTLE_VELOCITY: f64 = 0.02;
const SHUTTLE_MARGIN: f64 = 0.1;
/// The command count that another master has left behind.
const FOUND_COUNT: u8 = 5;

/// What the drive is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    NotReady,
    SwitchOnDisabled,
    ReadyToSwitchOn,
    Error,
    HwTests { until: Time },
    ReadyToOperate,
    Operating(Task),
    QuickStop { error: bool },
}

/// What an enabled drive is doing: states 8 and above.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Task {
    Commands,
    Aborting,
    Freezing,
    Homing { finished: bool },
    GoingToInitial { finished: bool },
    GoingToPosition { finished: bool },
    JoggingPlus,
    JoggingMinus,
}

/// What came of a motion command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Taken {
    /// Run, refused or ignored.
    Done,
    /// The firmware restarts.
    Restart,
}

/// A drive with its motor.
#[derive(Debug)]
pub(super) struct Machine {
    plan: SimPlan,
    mode: Mode,
    /// As last written.
    control: ControlWord,
    /// The effective control word that the last transition saw: for edges.
    seen: ControlWord,
    error: ErrorCode,
    homed: bool,
    /// Of the last motion command that was taken in.
    count: u8,
    pub(super) setpoints: Setpoints,
    plant: Plant,
    /// Drive coordinates = mechanical position + offset, m. 0 once the home switch was found.
    offset: f64,
    /// Where a drive that was found running turns round, until somebody takes over.
    shuttle: Option<(f64, f64)>,
    /// The hardware enable (STO) is open until then, whatever happens to the drive.
    inhibited_until: Time,
    inhibited: bool,
}

impl Machine {
    pub(super) fn new(plan: &SimPlan) -> Machine {
        let metres = |count: i32| f64::from(count) * METRE;
        let range = (metres(plan.range.0), metres(plan.range.1));
        let mut plant = Plant::new(PlantPlan { mass_kg: plan.mass_kg, range, ..PlantPlan::default() });
        plant.set_position(metres(plan.start_position));
        let mut machine = Machine {
            plan: plan.clone(),
            mode: Mode::NotReady,
            control: ControlWord(0),
            seen: ControlWord(0),
            error: ErrorCode::NONE,
            homed: false,
            count: 0,
            setpoints: Setpoints::at(0.0, plan.stream_period_ns, tolerance(plan)),
            plant,
            offset: 0.0,
            shuttle: None,
            inhibited_until: Time(0),
            inhibited: false,
        };
        machine.power_up();
        if plan.start_running {
            machine.control = ControlWord::ON;
            machine.seen = machine.effective();
            machine.mode = Mode::Operating(Task::Commands);
            machine.homed = true;
            machine.count = FOUND_COUNT;
            machine.offset = 0.0;
            machine.setpoints.stand_at(machine.plant.position());
            let margin = (range.1 - range.0) * SHUTTLE_MARGIN;
            machine.shuttle = Some((range.0 + margin, range.1 - margin));
            machine.go_on();
        }
        machine
    }

    /// Power came back: everything volatile is lost, the motor stays where it is. The position sensor is incremental
    /// and begins at the start position, wherever that is.
    pub(super) fn power_up(&mut self) {
        self.mode = Mode::NotReady;
        self.control = ControlWord(0);
        self.seen = self.effective();
        self.error = ErrorCode::NONE;
        self.homed = false;
        self.count = 0;
        self.shuttle = None;
        self.offset = f64::from(self.plan.start_position) * METRE - self.plant.position();
        self.setpoints =
            Setpoints::at(self.actual().position, self.plan.stream_period_ns, tolerance(&self.plan));
    }

    /// Writes the control word.
    pub(super) fn set_control(&mut self, word: ControlWord, now: Time) {
        self.control = word;
        self.transition(now);
    }

    /// Takes in a motion command block.
    pub(super) fn command(&mut self, block: &MotionBlock, now: Time) -> Taken {
        let count = (block.header & 0xF) as u8;
        if count == self.count {
            return Taken::Done;
        }
        // Stored even if the command is refused below.
        self.count = count;
        let command = Decoded::of(block);
        match command {
            Decoded::NoOperation => return Taken::Done,
            Decoded::ResetFirmware => return Taken::Restart,
            Decoded::ControlWord(word) => {
                self.set_control(ControlWord(word), now);
                return Taken::Done;
            }
            _ => {}
        }
        match self.mode {
            Mode::NotReady | Mode::SwitchOnDisabled | Mode::ReadyToSwitchOn | Mode::Error => {}
            Mode::Operating(Task::Commands) => {
                self.shuttle = None;
                if let Err(code) = self.execute(&command, now) {
                    self.fail(code);
                }
            }
            _ => self.fail(ErrorCode::WRONG_STATE),
        }
        Taken::Done
    }

    fn execute(&mut self, command: &Decoded, now: Time) -> Result<(), ErrorCode> {
        match *command {
            Decoded::MasterHoming(position) => {
                let position = f64::from(position) * METRE;
                self.reference(position, position - self.plant.position());
                Ok(())
            }
            // Positions mean nothing before homing.
            Decoded::Move(_) | Decoded::Run { .. } | Decoded::Stream { .. } if !self.homed => {
                Err(ErrorCode::NOT_HOMED)
            }
            _ => {
                let actual = self.actual();
                self.setpoints.execute(command, now, actual)
            }
        }
    }

    /// Raises an error: a moving motor is stopped first. The first error stays.
    pub(super) fn fail(&mut self, code: ErrorCode) {
        if matches!(self.mode, Mode::Error | Mode::QuickStop { error: true }) {
            return;
        }
        self.error = code;
        self.shuttle = None;
        if self.powered() && self.setpoints.is_moving() {
            self.setpoints.quick_stop();
            self.mode = Mode::QuickStop { error: true };
        } else {
            self.power_off(Mode::Error);
        }
    }

    /// Lets `dt_ns` pass, which end at `now`; then one transition.
    pub(super) fn step(&mut self, now: Time, dt_ns: u64) {
        self.inhibited = now < self.inhibited_until;
        let actual = self.actual();
        if self.powered()
            && let Err(code) = self.setpoints.advance(now, dt_ns, actual)
        {
            self.fail(code);
        }
        let demand = self.setpoints.demand();
        self.plant.advance(
            demand.position - self.offset,
            demand.velocity,
            demand.acceleration,
            dt_ns,
            self.powered(),
        );
        if self.powered() {
            self.watch();
        } else {
            // A powerless controller has no demand of its own.
            self.setpoints.stand_at(self.actual().position);
        }
        self.transition(now);
        self.go_on();
    }

    /// Range and following error.
    fn watch(&mut self) {
        let demand = counts(self.setpoints.demand().position, METRE);
        if self.homed && demand < self.plan.range.0 {
            self.fail(ErrorCode::MIN_POSITION);
        } else if self.homed && demand > self.plan.range.1 {
            self.fail(ErrorCode::MAX_POSITION);
        } else if self.lag() > LAG_ERROR {
            self.fail(ErrorCode::POSITION_LAG);
        }
    }

    /// What follows when a motion of the drive's own has ended.
    fn go_on(&mut self) {
        let Mode::Operating(task) = self.mode else { return };
        if self.setpoints.is_moving() {
            return;
        }
        let arrived = self.lag() < IN_POSITION;
        let next = match task {
            Task::Homing { finished: false } if arrived => {
                self.reference(f64::from(self.plan.home_position) * METRE, 0.0);
                Task::Homing { finished: true }
            }
            Task::GoingToInitial { finished: false } if arrived => Task::GoingToInitial { finished: true },
            Task::GoingToPosition { finished: false } if arrived => Task::GoingToPosition { finished: true },
            Task::Commands => {
                if let Some((low, high)) = self.shuttle {
                    let position = self.actual().position;
                    let target = if position - low > high - position { low } else { high };
                    self.setpoints.go_to(target, SHUTTLE_VELOCITY, OWN_ACCELERATION);
                }
                task
            }
            _ => task,
        };
        self.mode = Mode::Operating(next);
    }

    /// Homed: from now on the coordinates have this offset, and the demand is `position` in them.
    fn reference(&mut self, position: f64, offset: f64) {
        self.offset = offset;
        self.homed = true;
        self.setpoints.stand_at(position);
    }

    /// At most one transition of the state machine (SG5 manual). Precedence: bits 0-2, bit 3, then the tasks.
    fn transition(&mut self, now: Time) {
        use ControlWord as C;
        let control = self.effective();
        let rising = ControlWord(control.0 & !self.seen.0);
        self.seen = control;
        let on = control.has(C::SWITCH_ON | C::VOLTAGE_ENABLE);
        let quick_stop = !control.has(C::NO_QUICK_STOP);
        match self.mode {
            Mode::NotReady => {
                if !control.has(C::SWITCH_ON) {
                    self.mode = Mode::SwitchOnDisabled;
                }
            }
            Mode::SwitchOnDisabled => {
                if control.0 & 0b111 == 0b110 {
                    self.mode = Mode::ReadyToSwitchOn;
                }
            }
            Mode::ReadyToSwitchOn => {
                if !control.has(C::VOLTAGE_ENABLE | C::NO_QUICK_STOP) {
                    self.mode = Mode::SwitchOnDisabled;
                } else if on {
                    self.mode = Mode::HwTests { until: now + HW_TESTS_NS };
                }
            }
            Mode::Error => {
                if rising.has(C::ERROR_ACKNOWLEDGE) && !self.error.is_fatal() {
                    self.error = ErrorCode::NONE;
                    self.mode = Mode::NotReady;
                }
            }
            Mode::QuickStop { error } => {
                if !on || !self.setpoints.is_moving() {
                    self.power_off(if error { Mode::Error } else { Mode::NotReady });
                }
            }
            _ if !on => self.power_off(Mode::NotReady),
            _ if quick_stop => {
                self.shuttle = None;
                self.setpoints.quick_stop();
                self.mode = Mode::QuickStop { error: false };
            }
            Mode::HwTests { until } => {
                if now >= until {
                    self.setpoints.stand_at(self.actual().position);
                    self.mode = Mode::ReadyToOperate;
                }
            }
            Mode::ReadyToOperate => {
                if control.has(C::ENABLE_OPERATION) {
                    self.mode = Mode::Operating(Task::Commands);
                }
            }
            Mode::Operating(_) if !control.has(C::ENABLE_OPERATION) => {
                self.shuttle = None;
                self.setpoints.halt();
                self.mode = Mode::ReadyToOperate;
            }
            Mode::Operating(task) => self.change_task(task, control, rising),
        }
    }

    /// Starts the task that the control word asks for, if it is another one.
    fn change_task(&mut self, task: Task, control: ControlWord, rising: ControlWord) {
        use ControlWord as C;
        let initial = rising.has(C::GO_TO_INITIAL)
            || control.has(C::GO_TO_INITIAL) && matches!(task, Task::GoingToInitial { .. });
        let wanted = if !control.has(C::NO_ABORT) {
            Task::Aborting
        } else if !control.has(C::NO_FREEZE) {
            Task::Freezing
        } else if control.has(C::HOMING) {
            Task::Homing { finished: false }
        } else if initial {
            Task::GoingToInitial { finished: false }
        } else if control.has(C::GO_TO_POSITION) {
            Task::GoingToPosition { finished: false }
        } else if control.has(C::JOG_PLUS) {
            Task::JoggingPlus
        } else if control.has(C::JOG_MINUS) {
            Task::JoggingMinus
        } else {
            Task::Commands
        };
        if std::mem::discriminant(&wanted) == std::mem::discriminant(&task) {
            return;
        }
        self.shuttle = None;
        self.mode = Mode::Operating(wanted);
        let home = f64::from(self.plan.home_position) * METRE;
        match wanted {
            Task::Aborting => self.setpoints.quick_stop(),
            Task::Freezing => self.setpoints.freeze(),
            Task::Homing { .. } => {
                self.homed = false;
                self.setpoints.go_to(home + self.offset, HOMING_VELOCITY, OWN_ACCELERATION);
            }
            Task::GoingToInitial { .. } | Task::GoingToPosition { .. } => {
                if self.homed {
                    self.setpoints.go_to(home, GO_TO_VELOCITY, OWN_ACCELERATION);
                } else {
                    self.fail(ErrorCode::NOT_HOMED);
                }
            }
            Task::JoggingPlus => self.setpoints.run(JOG_VELOCITY, OWN_ACCELERATION),
            Task::JoggingMinus => self.setpoints.run(-JOG_VELOCITY, OWN_ACCELERATION),
            Task::Commands => match task {
                Task::Freezing => self.setpoints.resume(),
                _ => self.setpoints.quick_stop(),
            },
        }
    }

    /// Opens the hardware enable until then.
    pub(super) fn inhibit(&mut self, until: Time) {
        self.inhibited_until = until;
    }

    fn power_off(&mut self, mode: Mode) {
        self.shuttle = None;
        self.setpoints.stand_at(self.actual().position);
        self.mode = mode;
    }

    /// The control word after the forced bits and the hardware enable.
    fn effective(&self) -> ControlWord {
        let forced = if self.plan.force_enable_bits { ControlWord::ENABLES } else { 0 };
        let taken = if self.inhibited { ControlWord::VOLTAGE_ENABLE } else { 0 };
        ControlWord((self.control.0 | forced) & !taken)
    }

    fn powered(&self) -> bool {
        matches!(self.mode, Mode::ReadyToOperate | Mode::Operating(_) | Mode::QuickStop { .. })
    }

    fn actual(&self) -> Demand {
        Demand {
            position: self.plant.position() + self.offset,
            velocity: self.plant.velocity(),
            acceleration: 0.0,
        }
    }

    /// Following error, m, without sign.
    fn lag(&self) -> f64 {
        (self.setpoints.demand().position - self.actual().position).abs()
    }

    fn in_target(&self) -> bool {
        self.powered() && !self.setpoints.is_moving() && self.lag() < IN_POSITION
    }

    fn main(&self) -> MainState {
        match self.mode {
            Mode::NotReady => MainState::NOT_READY,
            Mode::SwitchOnDisabled => MainState::SWITCH_ON_DISABLED,
            Mode::ReadyToSwitchOn => MainState::READY_TO_SWITCH_ON,
            Mode::Error => MainState::ERROR,
            Mode::HwTests { .. } => MainState::HW_TESTS,
            Mode::ReadyToOperate => MainState::READY_TO_OPERATE,
            Mode::QuickStop { .. } => MainState::QUICK_STOP,
            Mode::Operating(task) => match task {
                Task::Commands => MainState::OPERATION_ENABLED,
                Task::Aborting => MainState::ABORTING,
                Task::Freezing => MainState::FREEZING,
                Task::Homing { .. } => MainState::HOMING,
                Task::GoingToInitial { .. } => MainState::GOING_TO_INITIAL,
                Task::GoingToPosition { .. } => MainState::GOING_TO_POSITION,
                Task::JoggingPlus => MainState::JOGGING_PLUS,
                Task::JoggingMinus => MainState::JOGGING_MINUS,
            },
        }
    }

    /// The state variable.
    pub(super) fn state(&self) -> StateVar {
        let sub = match self.mode {
            Mode::Error => self.error.0 as u8,
            Mode::Operating(Task::Commands) => {
                let bits = [
                    (self.setpoints.is_armed(), StateVar::EVENT_HANDLER),
                    (self.setpoints.is_moving(), StateVar::MOTION_ACTIVE),
                    (self.in_target(), StateVar::IN_TARGET),
                    (self.homed, StateVar::HOMED),
                ];
                self.count | bits.iter().filter(|(set, _)| *set).fold(0, |sub, (_, bit)| sub | bit)
            }
            Mode::Operating(
                Task::Homing { finished: true }
                | Task::GoingToInitial { finished: true }
                | Task::GoingToPosition { finished: true },
            ) => StateVar::FINISHED,
            Mode::Operating(Task::JoggingPlus | Task::JoggingMinus) => 0x01,
            _ => 0,
        };
        StateVar::new(self.main(), sub)
    }

    /// The status word.
    pub(super) fn status(&self) -> StatusWord {
        use StatusWord as W;
        let control = self.effective();
        let special = matches!(self.main().0, 9..=11 | 15..=17);
        let bits = [
            (self.main() >= MainState::OPERATION_ENABLED, W::OPERATION_ENABLED),
            (control.has(ControlWord::SWITCH_ON), W::SWITCH_ON_ACTIVE),
            (control.has(ControlWord::ENABLE_OPERATION), W::ENABLE_OPERATION),
            (matches!(self.mode, Mode::Error | Mode::QuickStop { error: true }), W::ERROR),
            (control.has(ControlWord::VOLTAGE_ENABLE), W::VOLTAGE_ENABLE),
            (control.has(ControlWord::NO_QUICK_STOP), W::NO_QUICK_STOP),
            (self.mode == Mode::NotReady && control.has(ControlWord::SWITCH_ON), W::SWITCH_ON_LOCKED),
            (self.warn().0 != 0, W::WARNING),
            (self.setpoints.is_armed(), W::EVENT_HANDLER),
            (special, W::SPECIAL_MOTION),
            (self.in_target(), W::IN_TARGET),
            (self.homed, W::HOMED),
            (self.error.is_fatal(), W::FATAL_ERROR),
            (self.powered() && self.setpoints.is_moving(), W::MOTION_ACTIVE),
        ];
        StatusWord(bits.iter().filter(|(set, _)| *set).fold(0, |word, (_, bit)| word | bit))
    }

    /// The warn word.
    pub(super) fn warn(&self) -> WarnWord {
        let lag = if self.powered() && self.lag() > LAG_WARNING { WarnWord::POSITION_LAG } else { 0 };
        let homed = if self.homed { 0 } else { WarnWord::NOT_HOMED };
        WarnWord(lag | homed)
    }

    /// The error that stands.
    pub(super) fn error(&self) -> ErrorCode {
        self.error
    }

    /// Actual position, 0.1 um.
    pub(super) fn actual_position(&self) -> i32 {
        counts(self.actual().position, METRE)
    }

    /// Demand position, 0.1 um.
    pub(super) fn demand_position(&self) -> i32 {
        counts(self.setpoints.demand().position, METRE)
    }

    /// Motor current, mA.
    pub(super) fn current(&self) -> i16 {
        (self.plant.force() / NEWTON_PER_AMPERE * 1e3).round() as i16
    }

    /// The monitoring channels: demand velocity (um/s), demand acceleration (1e-5 m/s2), drive temperature (0.1 C)
    /// and the status word.
    pub(super) fn monitor(&self) -> [u32; 4] {
        let demand = self.setpoints.demand();
        let velocity = counts(demand.velocity, METRE_PER_S);
        let acceleration = counts(demand.acceleration, METRE_PER_S2);
        [velocity as u32, acceleration as u32, 400, u32::from(self.status().0)]
    }
}

/// Rounded to wire counts, held at the ends of their range.
fn counts(value: f64, unit: f64) -> i32 {
    (value / unit).round() as i32
}

/// What a stream puts up with: periods of silence, and setpoints ahead.
fn tolerance(plan: &SimPlan) -> (f64, usize) {
    (plan.stream_patience, plan.stream_depth)
}
