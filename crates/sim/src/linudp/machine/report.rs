//! The drive's reports: state, status, warnings, and the variables that can be read and monitored.

use super::super::demand::{METRE, METRE_PER_S, METRE_PER_S2};
use super::super::log::hours_and_ms;
use super::super::upids::{PARAMETERS, Variable};
use super::{LAG_WARNING, Machine, Mode, NEWTON_PER_AMPERE, Task, counts};
use crate::power::set_bits;
use fieldbeat_core::time::US;
use fieldbeat_linudp::wire::{ControlWord, ErrorCode, MainState, StateVar, StatusWord, WarnWord};

/// A position as a count of 32 bits, which wraps around.
fn position(metres: f64) -> i32 {
    (metres / METRE).round() as i64 as i32
}

impl Machine {
    fn main(&self) -> MainState {
        match self.mode {
            Mode::NotReady => MainState::NOT_READY,
            Mode::SwitchOnDisabled => MainState::SWITCH_ON_DISABLED,
            Mode::ReadyToSwitchOn => MainState::READY_TO_SWITCH_ON,
            Mode::Error => MainState::ERROR,
            Mode::HwTests { .. } => MainState::HW_TESTS,
            Mode::ReadyToOperate => MainState::READY_TO_OPERATE,
            Mode::QuickStop => MainState::QUICK_STOP,
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

    /// The state variable; 0 while the software is stopped.
    pub(in super::super) fn state(&self) -> StateVar {
        if self.stopped {
            return StateVar(0);
        }
        let sub = match self.mode {
            Mode::Error => self.error().0 as u8,
            Mode::Operating(Task::Commands) => {
                let bits = [
                    (self.setpoints.is_armed(), StateVar::EVENT_HANDLER),
                    (self.setpoints.is_moving(), StateVar::MOTION_ACTIVE),
                    (self.in_target(), StateVar::IN_TARGET),
                    (self.power.homed, StateVar::HOMED),
                ];
                self.count | set_bits(bits)
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

    /// The status word; 0 while the software is stopped.
    pub(in super::super) fn status(&self) -> StatusWord {
        if self.stopped {
            return StatusWord(0);
        }
        use StatusWord as W;
        let control = self.reported;
        let special = matches!(self.main().0, 9..=11 | 15..=17);
        let bits = [
            (self.main() >= MainState::OPERATION_ENABLED, W::OPERATION_ENABLED),
            (control.has(ControlWord::SWITCH_ON), W::SWITCH_ON_ACTIVE),
            (control.has(ControlWord::ENABLE_OPERATION), W::ENABLE_OPERATION),
            (self.power.fault().is_some(), W::ERROR),
            (control.has(ControlWord::VOLTAGE_ENABLE), W::VOLTAGE_ENABLE),
            (control.has(ControlWord::NO_QUICK_STOP), W::NO_QUICK_STOP),
            (self.mode == Mode::NotReady && control.has(ControlWord::SWITCH_ON), W::SWITCH_ON_LOCKED),
            (self.warn().0 != 0, W::WARNING),
            (self.setpoints.is_armed(), W::EVENT_HANDLER),
            (special, W::SPECIAL_MOTION),
            (self.in_target(), W::IN_TARGET),
            (self.power.homed, W::HOMED),
            (self.error().is_fatal(), W::FATAL_ERROR),
            (self.powered() && self.setpoints.is_moving(), W::MOTION_ACTIVE),
        ];
        StatusWord(set_bits(bits))
    }

    /// The warn word.
    pub(in super::super) fn warn(&self) -> WarnWord {
        let lag = if self.powered() && self.lag() > LAG_WARNING { WarnWord::POSITION_LAG } else { 0 };
        let homed = if self.power.homed { 0 } else { WarnWord::NOT_HOMED };
        WarnWord(lag | homed)
    }

    /// The error that stands.
    pub(in super::super) fn error(&self) -> ErrorCode {
        self.power.fault().unwrap_or(ErrorCode::NONE)
    }

    /// Actual position, 0.1 um.
    pub(in super::super) fn actual_position(&self) -> i32 {
        position(self.actual().position)
    }

    /// Demand position, 0.1 um.
    pub(in super::super) fn demand_position(&self) -> i32 {
        position(self.setpoints.demand().position)
    }

    /// Motor current, mA.
    pub(in super::super) fn current(&self) -> i16 {
        (self.power.torque() / NEWTON_PER_AMPERE * 1e3).round() as i16
    }

    /// The value of the parameter at this index.
    pub(super) fn number(&self, index: usize) -> i64 {
        let Some(variable) = PARAMETERS[index].variable else { return self.memory.parameters.ram(index) };
        let (low, high) = PARAMETERS[index].kind.range();
        self.value(variable).clamp(low, high)
    }

    /// The same in wire form.
    pub(in super::super) fn read(&self, index: usize) -> u32 {
        self.memory.parameters.wire(index, self.number(index))
    }

    /// The monitoring channels: the values of the UPIDs in their parameters.
    pub(in super::super) fn monitor(&self) -> [u32; 4] {
        self.settings.monitored.map(|source| source.map_or(0, |index| self.read(index)))
    }

    fn value(&self, variable: Variable) -> i64 {
        let demand = self.setpoints.demand();
        let limits = self.setpoints.limits();
        let whole = |value: f64, unit: f64| i64::from(counts(value, unit));
        match variable {
            Variable::Constant(value) => value,
            Variable::OperatingMs => hours_and_ms(self.power.age_ns()).1.into(),
            // The timer is 32 bits wide and wraps.
            Variable::TimerUs => i64::from((self.power.on_ns() / US) as u32),
            Variable::DemandCurrent => self.current().into(),
            Variable::Status => self.status().0.into(),
            Variable::Count => self.count.into(),
            Variable::Target => position(self.setpoints.target()).into(),
            Variable::LimitVelocity => limits.velocity.into(),
            Variable::LimitAcceleration => limits.acceleration.into(),
            Variable::LimitDeceleration => limits.deceleration.into(),
            Variable::DemandPosition => position(demand.position).into(),
            Variable::DemandVelocity => whole(demand.velocity, METRE_PER_S),
            Variable::DemandAcceleration => whole(demand.acceleration, METRE_PER_S2),
        }
    }
}
