//! The state machine (SG5 manual): what the control word changes.

use super::super::codec::{control as C, errors};
use super::command::Sequence;
use super::settings::{RunMode, Settings};
use super::{Machine, Mode, OWN_ACCELERATION, Task};
use fieldbeat_core::time::{MS, Time};

/// Hardware tests of state 5 (SG5 manual: about 300 ms).
const HW_TESTS_NS: u64 = 300 * MS;

/// The first entry of run mode 3.
const FIRST: u16 = 1;

// Values that a real drive takes from its parameters, m/s.
const HOMING_VELOCITY: f64 = 0.1;
const JOG_VELOCITY: f64 = 0.02;
const GO_TO_VELOCITY: f64 = 0.1;

fn has(word: u16, bits: u16) -> bool {
    word & bits == bits
}

impl Machine {
    /// Writes the control word.
    pub(in super::super) fn set_control(&mut self, word: u16, now: Time) {
        self.control = word;
        if !self.stopped {
            self.transition(now);
        }
        self.report_control(now);
    }

    /// The control word that the status word reports: the effective one, or an older one.
    pub(super) fn report_control(&mut self, now: Time) {
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
    pub(super) fn transition(&mut self, now: Time) {
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
        let control = self.effective();
        let rising = control & !self.seen;
        self.seen = control;
        let on = has(control, C::SWITCH_ON | C::VOLTAGE_ENABLE);
        let quick_stop = !has(control, C::NO_QUICK_STOP);
        match self.mode {
            Mode::NotReady => {
                if !has(control, C::SWITCH_ON) {
                    self.mode = Mode::SwitchOnDisabled;
                }
            }
            Mode::SwitchOnDisabled => {
                if control & 0b111 == 0b110 {
                    self.mode = Mode::ReadyToSwitchOn;
                }
            }
            Mode::ReadyToSwitchOn => {
                if !has(control, C::VOLTAGE_ENABLE | C::NO_QUICK_STOP) {
                    self.mode = Mode::SwitchOnDisabled;
                } else if on {
                    self.mode = Mode::HwTests { until: now + HW_TESTS_NS };
                }
            }
            Mode::Error => {
                if has(rising, C::ERROR_ACKNOWLEDGE) && self.power.reset() {
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
                if has(control, C::ENABLE_OPERATION) {
                    self.mode = Mode::Operating(Task::Commands);
                }
            }
            Mode::Operating(_) if !has(control, C::ENABLE_OPERATION) => {
                self.setpoints.halt();
                self.mode = Mode::ReadyToOperate;
            }
            Mode::Operating(task) => self.change_task(task, control, rising),
        }
    }

    /// Starts the task that the control word requests, if it is another one.
    fn change_task(&mut self, task: Task, control: u16, rising: u16) {
        let initial = has(rising, C::GO_TO_INITIAL)
            || has(control, C::GO_TO_INITIAL) && matches!(task, Task::GoingToInitial { .. });
        let wanted = if !has(control, C::NO_ABORT) {
            Task::Aborting
        } else if !has(control, C::NO_FREEZE) {
            Task::Freezing
        } else if has(control, C::HOME) {
            Task::Homing { finished: false }
        } else if initial {
            Task::GoingToInitial { finished: false }
        } else if has(control, C::GO_TO_POSITION) {
            Task::GoingToPosition { finished: false }
        } else if has(control, C::JOG_PLUS) {
            Task::JoggingPlus
        } else if has(control, C::JOG_MINUS) {
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
                    self.fail(errors::NOT_HOMED);
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

    /// The table goes on with this entry.
    pub(super) fn start_table(&mut self, entry: u16) -> Result<(), u16> {
        self.memory.table.entry(entry)?;
        self.sequence = Some(Sequence { entry, waiting: None });
        Ok(())
    }

    /// State 8 was entered.
    fn enter_table(&mut self) {
        if self.settings.run_mode == RunMode::Table
            && self.power.homed
            && let Err(code) = self.start_table(FIRST)
        {
            self.fail(code);
        }
    }
}
