//! The drive behind the telegrams: state machine, homing, errors, and the motor that follows the demand.
//!
//! Knows no bytes and no sockets. Time comes in steps; a control word is followed by one transition a step, as in a
//! drive whose control loop is faster than its bus.

mod command;
mod commands;
mod report;
mod sequence;
mod settings;
mod states;
mod step;

pub(super) use self::command::Taken;

use std::collections::VecDeque;

use self::command::{Effort, Sequence};
use self::settings::Settings;
use super::codec::channel::Refusal;
use super::codec::{control, errors};
use super::demand::{Demand, METRE};
use super::memory::Memory;
use super::motion::Setpoints;
use super::settings::LinMotSettings;
use super::upids;
use crate::Truth;
use crate::physics::PlantPlan;
use crate::power::{PowerDrive, PowerPlan, Reset};
use fieldbeat_core::time::Time;

// Values that a real drive takes from its parameters: velocities in m/s, accelerations in m/s2, lengths in m.
const OWN_ACCELERATION: f64 = 1.0;
const IN_POSITION: f64 = 50e-6;
const LAG_WARNING: f64 = 1e-3;

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
    control: u16,
    /// The effective control word that the last transition saw: for edges.
    seen: u16,
    /// The count of the last accepted motion command.
    count: u8,
    pub(super) setpoints: Setpoints,
    power: PowerDrive<u16>,
    effort: Effort,
    /// The position in the command table, if it runs.
    sequence: Option<Sequence>,
    /// Turning points of a drive that was found running, until a master takes over.
    shuttle: Option<(f64, f64)>,
    /// The control words that the status word is still to report, each with its time, and the one that it reports.
    lagging: VecDeque<(Time, u16)>,
    reported: u16,
    pub(super) memory: Memory,
    /// The settings in use.
    settings: Settings,
    /// The motion control software does not run.
    stopped: bool,
}

impl Machine {
    /// The serial number, if this parameter has it.
    pub(super) fn serial(&self, upid: u16) -> Option<u32> {
        self.plan.serial.filter(|(from, _)| *from == upid).map(|(_, number)| number)
    }

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
            control: 0,
            seen: 0,
            count: 0,
            setpoints: Setpoints::at(0.0, plan),
            power,
            effort: Effort::Position,
            sequence: None,
            shuttle: None,
            lagging: VecDeque::new(),
            reported: 0,
        };
        machine.power_up();
        if plan.start_running {
            machine.control = control::ON;
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
        self.control = 0;
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

    /// Raises an error: a moving motor is stopped first. The first error stays.
    pub(super) fn fail(&mut self, code: u16) {
        if !self.power.fail(code, if errors::is_fatal(code) { Reset::Never } else { Reset::Always }) {
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

    /// Continues after the end of a motion of the drive's own.
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

    /// Opens the hardware enable until then.
    pub(super) fn open_sto(&mut self, until: Time) {
        self.power.open_sto(until);
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
    fn effective(&self) -> u16 {
        let forced = if self.plan.force_enable_bits { control::ENABLES } else { 0 };
        let taken = if self.power.is_enabled() { 0 } else { control::VOLTAGE_ENABLE };
        (self.control | forced) & !taken
    }

    fn powered(&self) -> bool {
        matches!(self.mode, Mode::ReadyToOperate | Mode::Operating(_) | Mode::QuickStop)
    }

    fn actual(&self) -> Demand {
        Demand { position: self.power.position(), velocity: self.power.speed(), acceleration: 0.0 }
    }

    /// The real state of the motor, in wire counts.
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
