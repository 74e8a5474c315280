//! The drive behind the telegrams: state machine, homing, errors, and the motor that follows the demand.
//!
//! Knows no bytes and no sockets. Time comes in steps; a control word is followed by one transition a step, as in a
//! drive whose control loop is faster than its bus.

mod commands;
mod report;
mod sequence;
mod settings;

pub(super) use self::commands::{CURVE_SCALE, Taken};
pub(super) use self::report::Variable;

use std::collections::VecDeque;

use self::commands::Effort;
use self::sequence::Sequence;
use self::settings::{RunMode, Settings};
use super::memory::Memory;
use super::motion::{Demand, METRE, Setpoints};
use super::upids;
use crate::bus::linudp::wire::{ControlWord, ErrorCode, Refusal};
use crate::sim::Truth;
use crate::sim::linudp::LinMotSettings;
use crate::sim::physics::PlantPlan;
use crate::sim::power::{Aim, PowerDrive, PowerPlan, Reset};
use crate::time::{MS, Time};

/// Hardware tests of state 5 (SG5 manual: about 300 ms).
const HW_TESTS_NS: u64 = 300 * MS;

// Values that a real drive takes from its parameters: velocities in m/s, accelerations in m/s2, lengths in m.
const HOMING_VELOCITY: f64 = 0.1;
const JOG_VELOCITY: f64 = 0.02;
const GO_TO_VELOCITY: f64 = 0.1;
const OWN_ACCELERATION: f64 = 1.0;
const IN_POSITION: f64 = 50e-6;
const LAG_WARNING: f64 = 1e-3;

/// 000Ch: position lag at standstill.
const LAG_STANDING: ErrorCode = ErrorCode(0x000C);

/// Force constant of the motor, N/A.
const NEWTON_PER_AMPERE: f64 = 20.0;

/// The motion of a drive that is found running: slow, so that it lasts, and this far from the ends of the range.
const SHUTTLE_VELOCITY: f64 = 0.02;
const SHUTTLE_MARGIN: f64 = 0.1;
/// As far as the motor of an endless axis turns, m.
const ENDLESS: f64 = 1e9;
/// All position counts, m: those of an endless axis wrap around.
const ALL_COUNTS: f64 = 4_294_967_296.0 * METRE;
/// The command count that another master left.
const FOUND_COUNT: u8 = 5;

/// The mode of the drive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    NotReady,
    SwitchOnDisabled,
    ReadyToSwitchOn,
    Error,
    HwTests {
        until: Time,
    },
    ReadyToOperate,
    Operating(Task),
    /// To standstill, then off; to an error if one stands.
    QuickStop,
}

/// The task of an enabled drive: states 8 and above.
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

/// A drive with its motor.
#[derive(Debug)]
pub(super) struct Machine {
    plan: LinMotSettings,
    mode: Mode,
    /// As last written.
    control: ControlWord,
    /// The effective control word that the last transition saw: for edges.
    seen: ControlWord,
    /// The count of the last accepted motion command.
    count: u8,
    pub(super) setpoints: Setpoints,
    power: PowerDrive<ErrorCode>,
    effort: Effort,
    /// The position in the command table, if it runs.
    sequence: Option<Sequence>,
    /// Turning points of a drive that was found running, until a master takes over.
    shuttle: Option<(f64, f64)>,
    /// The control words that the status word is still to report, each with its time, and the one that it reports.
    lagging: VecDeque<(Time, ControlWord)>,
    reported: ControlWord,
    pub(super) memory: Memory,
    /// The settings in use.
    settings: Settings,
    /// The motion control software does not run.
    stopped: bool,
}

impl Machine {
    pub(super) fn new(plan: &LinMotSettings) -> Machine {
        let metres = |count: i32| f64::from(count) * METRE;
        let range = match plan.is_endless() {
            true => (-ENDLESS, ENDLESS),
            false => (metres(plan.range.0), metres(plan.range.1)),
        };
        let mut power = PowerDrive::new(PowerPlan {
            plant: PlantPlan { mass_kg: plan.mass_kg, range, ..PlantPlan::default() },
            max_speed: f64::INFINITY,
            hardware_enable: true,
            scan_ns: None,
        });
        power.put(metres(plan.start_position));
        let memory = Memory::new(plan);
        let mut machine = Machine {
            settings: Settings::of(&memory.parameters),
            memory,
            stopped: false,
            plan: plan.clone(),
            mode: Mode::NotReady,
            control: ControlWord(0),
            seen: ControlWord(0),
            count: 0,
            setpoints: Setpoints::at(0.0, plan),
            power,
            effort: Effort::Position,
            sequence: None,
            shuttle: None,
            lagging: VecDeque::new(),
            reported: ControlWord(0),
        };
        machine.power_up();
        if plan.start_running {
            machine.control = ControlWord::ON;
            machine.seen = machine.effective();
            machine.reported = machine.seen;
            machine.mode = Mode::Operating(Task::Commands);
            machine.power.homed = true;
            machine.count = FOUND_COUNT;
            machine.power.zero = 0.0;
            machine.setpoints.stand_at(machine.power.place());
            let margin = (range.1 - range.0) * SHUTTLE_MARGIN;
            machine.shuttle = Some((range.0 + margin, range.1 - margin));
            machine.go_on();
        }
        machine
    }

    /// Power came back: everything volatile is lost, the motor stays where it is. The position sensor is
    /// incremental and begins at the start position, wherever the motor is.
    pub(super) fn power_up(&mut self) {
        self.power.restart();
        self.memory.restart();
        self.stopped = false;
        self.control = ControlWord(0);
        self.lagging.clear();
        self.reported = self.effective();
        self.power.zero = self.power.place() - f64::from(self.plan.start_position) * METRE;
        self.setpoints = Setpoints::at(self.actual().position, &self.plan);
        self.begin();
    }

    /// The motion control software begins anew: state 0, count 0, not homed. An error stays until it is acknowledged,
    /// or until the next restart if it is fatal.
    fn begin(&mut self) {
        self.mode = self.unpowered();
        self.seen = self.effective();
        self.power.homed = false;
        self.count = 0;
        self.drop_tasks();
        self.memory.parameters.start();
        self.settings = Settings::of(&self.memory.parameters);
    }

    /// Stops the motion control software (35h): power goes off at once, whatever the motor is doing.
    pub(super) fn stop_software(&mut self) {
        if !self.stopped {
            self.stopped = true;
            self.power.homed = false;
            self.power_off();
        }
    }

    /// Starts it again (36h). The sensor goes on counting from where it is.
    pub(super) fn start_software(&mut self) {
        if self.stopped {
            self.stopped = false;
            self.begin();
        }
    }

    /// The software is stopped.
    pub(super) fn is_stopped(&self) -> bool {
        self.stopped
    }

    /// Writes a parameter into RAM.
    pub(super) fn write(&mut self, upid: u16, raw: u32) -> Result<(), Refusal> {
        self.memory.parameters.write_ram(upid, raw)?;
        // A command table may compute with its variables in every step, and they are no settings.
        if !matches!(upid, upids::VARIABLE_1 | upids::VARIABLE_2) {
            self.settings = Settings::of(&self.memory.parameters);
        }
        Ok(())
    }

    /// Writes the control word.
    pub(super) fn set_control(&mut self, word: ControlWord, now: Time) {
        self.control = word;
        if !self.stopped {
            self.transition(now);
        }
        self.report_control(now);
    }

    /// Raises an error: a moving motor is stopped first. The first error stays.
    pub(super) fn fail(&mut self, code: ErrorCode) {
        if !self.power.fail(code, if code.is_fatal() { Reset::Never } else { Reset::Always }) {
            return;
        }
        self.memory.log.record(code, self.power.age_ns());
        self.drop_tasks();
        if self.powered() && self.setpoints.is_moving() {
            self.setpoints.quick_stop();
            self.mode = Mode::QuickStop;
        } else {
            self.power_off();
        }
    }

    /// Advances to `now`.
    pub(super) fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.power.advance(now) {
            self.step(dt_ns);
        }
    }

    /// Lets `dt_ns` pass; then one transition.
    fn step(&mut self, dt_ns: u64) {
        let now = self.power.now();
        self.memory.advance(now);
        self.report_control(now);
        let actual = self.actual();
        if self.powered()
            && let Err(code) = self.setpoints.advance(now, dt_ns, actual)
        {
            self.fail(code);
        }
        self.move_plant(dt_ns);
        if self.powered() {
            self.watch();
        } else {
            // A powerless controller has no demand of its own.
            self.setpoints.stand_at(self.actual().position);
        }
        if !self.stopped {
            self.transition(now);
            self.run_table(now);
            self.go_on();
        }
    }

    /// The motor follows the demand or the current.
    fn move_plant(&mut self, dt_ns: u64) {
        if let (Effort::Current(force), true) = (self.effort, self.powered()) {
            self.power.step(Aim::Torque(force), dt_ns);
            let actual = self.actual();
            self.setpoints.follow(actual);
            return;
        }
        self.power.limit_torque(match self.effort {
            Effort::Pressing(force) => Some(force),
            Effort::Position | Effort::Current(_) => None,
        });
        let demand = self.setpoints.demand();
        let aim = match self.powered() {
            true => Aim::Follow {
                place: demand.position + self.power.zero,
                speed: demand.velocity,
                acceleration: demand.acceleration,
            },
            false => Aim::Off,
        };
        self.power.step(aim, dt_ns);
    }

    /// Range and following error.
    fn watch(&mut self) {
        let demand = counts(self.setpoints.demand().position, METRE);
        let settings = &self.settings;
        let bounded = self.power.homed && !self.plan.is_endless();
        // A motor that presses against something is meant to lag behind.
        let lag = if self.effort == Effort::Position { self.lag() } else { 0.0 };
        if bounded && demand < settings.range.0 {
            self.fail(ErrorCode::MIN_POSITION);
        } else if bounded && demand > settings.range.1 {
            self.fail(ErrorCode::MAX_POSITION);
        } else if lag > settings.lag_moving {
            self.fail(ErrorCode::POSITION_LAG);
        } else if lag > settings.lag_standing && !self.setpoints.is_moving() {
            self.fail(LAG_STANDING);
        }
    }

    /// What follows the end of a motion of the drive's own.
    fn go_on(&mut self) {
        let Mode::Operating(task) = self.mode else { return };
        if self.setpoints.is_moving() {
            return;
        }
        let arrived = self.lag() < IN_POSITION;
        let next = match task {
            Task::Homing { finished: false } if arrived => {
                let Settings { home, slider_home, .. } = self.settings;
                self.reference(home, slider_home - home);
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

    /// Homed: from now on the coordinates begin at `zero` of the motor's, and the demand is `position` in them.
    fn reference(&mut self, position: f64, zero: f64) {
        self.power.zero = zero;
        self.power.homed = true;
        self.setpoints.stand_at(position);
    }

    /// The control word that the status word reports: the effective one, or an older one.
    fn report_control(&mut self, now: Time) {
        let effective = self.effective();
        if self.lagging.back().map_or(self.reported, |(_, word)| *word) != effective {
            self.lagging.push_back((now + self.plan.status_lag_ns, effective));
        }
        while let Some((due, word)) = self.lagging.front().copied()
            && due <= now
        {
            self.lagging.pop_front();
            self.reported = word;
        }
    }

    /// At most one transition of the state machine, and its consequences: internal motions end with state 8.
    fn transition(&mut self, now: Time) {
        let before = self.mode;
        self.change_mode(now);
        if self.mode != Mode::Operating(Task::Commands) {
            self.drop_tasks();
        } else if matches!(before, Mode::ReadyToOperate | Mode::Operating(Task::Homing { .. })) {
            self.enter_table();
        }
    }

    /// The state machine (SG5 manual). Precedence: bits 0-2, bit 3, then the tasks.
    fn change_mode(&mut self, now: Time) {
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
                if rising.has(C::ERROR_ACKNOWLEDGE) && self.power.reset() {
                    self.mode = Mode::NotReady;
                }
            }
            Mode::QuickStop => {
                if !on || !self.setpoints.is_moving() {
                    self.power_off();
                }
            }
            _ if !on => self.power_off(),
            _ if quick_stop => {
                self.setpoints.quick_stop();
                self.mode = Mode::QuickStop;
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
                self.setpoints.halt();
                self.mode = Mode::ReadyToOperate;
            }
            Mode::Operating(task) => self.change_task(task, control, rising),
        }
    }

    /// Starts the task that the control word requests, if it is another one.
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
        self.mode = Mode::Operating(wanted);
        self.setpoints.clear_events();
        let Settings { home, slider_home, .. } = self.settings;
        match wanted {
            Task::Aborting => self.setpoints.quick_stop(),
            Task::Freezing => self.setpoints.freeze(),
            Task::Homing { .. } => {
                self.power.homed = false;
                self.setpoints.go_to(slider_home - self.power.zero, HOMING_VELOCITY, OWN_ACCELERATION);
            }
            Task::GoingToInitial { .. } | Task::GoingToPosition { .. } => {
                if self.power.homed {
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
        self.power.inhibit(until);
    }

    /// Ends a running command table, the motion of a drive that was found running, and pressing; only the position
    /// is held.
    fn drop_tasks(&mut self) {
        (self.shuttle, self.sequence, self.effort) = (None, None, Effort::Position);
    }

    fn power_off(&mut self) {
        self.drop_tasks();
        self.setpoints.stand_at(self.actual().position);
        self.mode = self.unpowered();
    }

    /// The mode in which it begins, or ends without power.
    fn unpowered(&self) -> Mode {
        if self.power.fault().is_none() { Mode::NotReady } else { Mode::Error }
    }

    /// The control word after the forced bits and the hardware enable.
    fn effective(&self) -> ControlWord {
        let forced = if self.plan.force_enable_bits { ControlWord::ENABLES } else { 0 };
        let taken = if self.power.is_enabled() { 0 } else { ControlWord::VOLTAGE_ENABLE };
        ControlWord((self.control.0 | forced) & !taken)
    }

    fn powered(&self) -> bool {
        matches!(self.mode, Mode::ReadyToOperate | Mode::Operating(_) | Mode::QuickStop)
    }

    fn actual(&self) -> Demand {
        Demand { position: self.power.position(), velocity: self.power.speed(), acceleration: 0.0 }
    }

    /// What the motor really does, in wire counts.
    pub(super) fn truth(&self) -> Truth {
        self.power.truth(self.powered(), METRE)
    }

    /// Following error, m, without sign.
    fn lag(&self) -> f64 {
        (self.setpoints.demand().position - self.actual().position).abs()
    }

    /// A position from the wire, in m. On an endless axis it is that of all its places which is nearest to the demand.
    fn place(&self, position: f64) -> f64 {
        if !self.plan.is_endless() {
            return position;
        }
        let way = self.setpoints.demand().position - position;
        position + (way / ALL_COUNTS).round() * ALL_COUNTS
    }

    fn in_target(&self) -> bool {
        self.powered() && !self.setpoints.is_moving() && self.lag() < IN_POSITION
    }
}

/// Rounded to wire counts, held at the ends of their range.
fn counts(value: f64, unit: f64) -> i32 {
    (value / unit).round() as i32
}
