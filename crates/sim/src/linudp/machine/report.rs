//! The drive's reports: state, status, warnings, and the variables that can be read and monitored.

use super::super::codec::{Report, control, errors, state, status, sub_state, warn};
use super::super::demand::{METRE, METRE_PER_S, METRE_PER_S2};
use super::super::log::hours_and_ms;
use super::super::upids::{PARAMETERS, Variable};
use super::{LAG_WARNING, Machine, Mode, NEWTON_PER_AMPERE, Task, counts};
use crate::power::set_bits;
use fieldbeat_core::time::US;

/// A position as a count of 32 bits, which wraps around.
fn position(metres: f64) -> i32 {
    (metres / METRE).round() as i64 as i32
}

impl Machine {
    /// All that a response can contain but the real-time-config channel.
    pub(in super::super) fn report(&self) -> Report {
        Report {
            status: self.status(),
            state: self.state(),
            actual: position(self.actual().position),
            demand: position(self.setpoints.demand().position),
            current: self.current(),
            warn: self.warn(),
            error: self.error(),
            // The values of the UPIDs in their parameters.
            monitor: self.settings.monitored.map(|source| source.map_or(0, |index| self.read(index))),
            config: None,
        }
    }

    /// Main state, and the sub state outside of state 8.
    fn main_state(&self) -> (u8, u8) {
        let finished = |finished| if finished { sub_state::FINISHED } else { 0 };
        match self.mode {
            Mode::NotReady => (state::NOT_READY, 0),
            Mode::SwitchOnDisabled => (state::SWITCH_ON_DISABLED, 0),
            Mode::ReadyToSwitchOn => (state::READY_TO_SWITCH_ON, 0),
            Mode::Error => (state::ERROR, self.error() as u8),
            Mode::HwTests { .. } => (state::HW_TESTS, 0),
            Mode::ReadyToOperate => (state::READY_TO_OPERATE, 0),
            Mode::QuickStop => (state::QUICK_STOP, 0),
            Mode::Operating(task) => match task {
                Task::Commands => (state::OPERATION_ENABLED, self.count),
                Task::Aborting => (state::ABORTING, 0),
                Task::Freezing => (state::FREEZING, 0),
                Task::Homing { finished: end } => (state::HOMING, finished(end)),
                Task::GoingToInitial { finished: end } => (state::GOING_TO_INITIAL, finished(end)),
                Task::GoingToPosition { finished: end } => (state::GOING_TO_POSITION, finished(end)),
                Task::JoggingPlus => (state::JOGGING_PLUS, sub_state::JOGGING),
                Task::JoggingMinus => (state::JOGGING_MINUS, sub_state::JOGGING),
            },
        }
    }

    /// The state variable; 0 while the software is stopped.
    fn state(&self) -> u16 {
        if self.stopped {
            return 0;
        }
        let (main, mut sub) = self.main_state();
        if main == state::OPERATION_ENABLED {
            sub |= set_bits([
                (self.setpoints.is_armed(), sub_state::EVENT_HANDLER),
                (self.setpoints.is_moving(), sub_state::MOTION_ACTIVE),
                (self.in_target(), sub_state::IN_TARGET),
                (self.power.homed, sub_state::HOMED),
            ]);
        }
        u16::from_be_bytes([main, sub])
    }

    /// The status word; 0 while the software is stopped.
    pub(super) fn status(&self) -> u16 {
        if self.stopped {
            return 0;
        }
        let (main, _) = self.main_state();
        let has = |bit| self.reported & bit != 0;
        set_bits([
            (main >= state::OPERATION_ENABLED, status::OPERATION_ENABLED),
            (has(control::SWITCH_ON), status::SWITCH_ON_ACTIVE),
            (has(control::ENABLE_OPERATION), status::ENABLE_OPERATION),
            (self.power.fault().is_some(), status::ERROR),
            (has(control::VOLTAGE_ENABLE), status::VOLTAGE_ENABLE),
            (has(control::NO_QUICK_STOP), status::NO_QUICK_STOP),
            (self.mode == Mode::NotReady && has(control::SWITCH_ON), status::SWITCH_ON_LOCKED),
            (self.warn() != 0, status::WARNING),
            (self.setpoints.is_armed(), status::EVENT_HANDLER),
            (matches!(main, 9..=11 | 15..=17), status::SPECIAL_MOTION),
            (self.in_target(), status::IN_TARGET),
            (self.power.homed, status::HOMED),
            (errors::is_fatal(self.error()), status::FATAL_ERROR),
            (self.powered() && self.setpoints.is_moving(), status::MOTION_ACTIVE),
        ])
    }

    /// The warn word.
    pub(super) fn warn(&self) -> u16 {
        let is_behind = self.powered() && self.lag() > LAG_WARNING;
        set_bits([(is_behind, warn::POSITION_LAG), (!self.power.homed, warn::NOT_HOMED)])
    }

    /// The error that stands.
    fn error(&self) -> u16 {
        self.power.fault().unwrap_or(errors::NONE)
    }

    /// Motor current, mA.
    pub(super) fn current(&self) -> i16 {
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
            Variable::Status => self.status().into(),
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
