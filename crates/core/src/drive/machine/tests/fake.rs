//! A drive of a few lines: the states of CiA 402, a motion, and reports of how far it is. It is strict: it takes no
//! intent twice, none that is older than the one before, and no number that is not finite.

use std::collections::VecDeque;

use crate::axis::{Cannot, DriveStatus, Lacks, State};
use crate::bus::cia402::{ControlCommand, ControlWord, Transition};
use crate::bus::desired::{
    Accepted, Capabilities, Desired, Evidence, FaultIs, Follows, Generator, Homing, Mode, ModeIs, Motion,
    Power, Quantity, Reference, Setpoint, Velocities,
};
use crate::drive::planner::{Point, Trajectory};
use crate::time::{MS, Time};

/// The interval between two exchanges, ns.
pub const T: u64 = MS;
/// It brakes so fast when it halts, quick-stops, or coasts, units/s².
const HALT: f64 = 5_000.0;
const COAST: f64 = 1_000.0;
/// units/s² of a per cent of the rated torque.
const PER_TORQUE: f64 = 10.0;
/// Exchanges that it is between two modes, and that it takes to boot.
const MODE_TAKES: u32 = 3;
const BOOTS: u32 = 20;

/// A report, as it comes `delay` exchanges later.
#[derive(Clone, Copy, Debug)]
pub struct Report {
    pub status: DriveStatus,
    pub evidence: Evidence,
    /// It has restarted so often.
    pub restarts: u32,
}

#[derive(Debug)]
pub struct Drive {
    pub can: Capabilities,
    pub state: State,
    pub point: Point,
    /// The motion that it makes by itself, if it does, and for how long.
    motion: Option<(Trajectory, u64)>,
    /// The evidence of its reports; its reference and its places are filled in.
    pub shows: Evidence,
    before: ControlWord,
    mode_in: u32,
    /// The motion is that of a homing.
    homes: bool,
    pub homed: bool,
    boots: u32,
    restarts: u32,
    // What a test makes of it.
    pub delay: usize,
    pub is_halted_by_halt: bool,
    pub sto_open: bool,
    pub home_fails: bool,
    /// The fault comes back after each reset.
    pub persists: bool,
    pub code: u32,
    /// The motor stays here, whatever the demand does.
    pub blocked: Option<f64>,
    /// The amount that a count unwrapped on the other side adds to its actual position.
    pub wrapped: f64,
    /// It turns at this velocity while it is not halted.
    pub own_reference: Option<f64>,
    /// The output runs so many rows behind those that it has accepted.
    pub buffer: usize,
    rows: VecDeque<Point>,
    /// The demand is reported so far from where it is, to either side in turn.
    pub restless: f64,
    /// The newest first.
    pub reports: VecDeque<Report>,
    /// Each power that it was commanded, without repetitions.
    pub powers: Vec<Power>,
}

const NO: Cannot = Some("it has none");

/// One kind of drive for each generator, like those of the protocols.
pub fn kinds() -> [Capabilities; 5] {
    let can = |generator, lacks| Capabilities {
        lacks,
        switches_on_at_once: false,
        still_reports: 3,
        ..Capabilities::of(generator)
    };
    let lacks = Lacks { torques: NO, ..Lacks::default() };
    let few = Lacks { moves: NO, rows: NO, ..Lacks::default() };
    [
        Capabilities {
            switches_on_at_once: true,
            leaves_quick_stop: false,
            power_reports: 2,
            still_reports: 2,
            arrival: 0.01,
            ..can(Generator::Drive { velocities: Some(Velocities::Leash(20.0)) }, lacks)
        },
        can(Generator::Master(Quantity::Position), lacks),
        Capabilities {
            switches_on_at_once: true,
            still_reports: 1,
            stands_ns: 10 * MS,
            ..can(Generator::Master(Quantity::Velocity), Lacks { torques: NO, homing: NO, ..few })
        },
        can(Generator::Master(Quantity::Torque), Lacks { velocities: NO, ..few }),
        Capabilities {
            arrival: 0.01,
            ..can(
                Generator::Drive { velocities: Some(Velocities::Own { reaction_ns: 3 * T }) },
                Lacks { rows: NO, ..lacks },
            )
        },
    ]
}

impl Drive {
    pub fn new(can: Capabilities) -> Drive {
        Drive {
            can,
            state: State::SwitchOnDisabled,
            point: Point { position: 10.0, velocity: 0.0 },
            motion: None,
            shows: Evidence { fault: FaultIs { named: true, ..FaultIs::default() }, ..Evidence::default() },
            before: ControlWord(0),
            mode_in: 0,
            homes: false,
            homed: false,
            boots: 0,
            restarts: 0,
            delay: 1,
            is_halted_by_halt: true,
            sto_open: false,
            home_fails: false,
            persists: false,
            code: 0,
            blocked: None,
            wrapped: 0.0,
            own_reference: None,
            buffer: 0,
            rows: VecDeque::new(),
            restless: 0.0,
            reports: VecDeque::new(),
            powers: Vec::new(),
        }
    }

    pub fn is_moving(&self) -> bool {
        self.point.velocity != 0.0 || self.motion.is_some_and(|(motion, ns)| !motion.is_over(ns))
    }

    /// Ends here the motion that it makes by itself.
    pub fn stay(&mut self) {
        (self.motion, self.point.velocity) = (None, 0.0);
    }

    pub fn trip(&mut self, code: u32) {
        (self.code, self.shows.fault.active) = (code, true);
        self.leave_operation(State::Fault, COAST);
    }

    /// Everything that it was commanded is lost.
    pub fn restart(&mut self) {
        self.leave_operation(State::NotReadyToSwitchOn, COAST);
        (self.boots, self.before, self.shows.mode, self.homed) = (BOOTS, ControlWord(0), ModeIs::Own, false);
        (self.code, self.shows.fault.active, self.shows.homing) = (0, false, Homing::Open);
        (self.shows.accepted, self.homes) = (Accepted::default(), false);
        self.restarts += 1;
    }

    /// An exchange, with what is desired if that has arrived.
    pub fn exchange(&mut self, now: Time, desired: Option<&Desired>) {
        if self.boots > 0 {
            self.boots -= 1;
            if self.boots == 0 {
                self.state = State::SwitchOnDisabled;
            }
        } else if let Some(desired) =
            desired.filter(|_| self.shows.outputs_count && self.shows.follows == Follows::Yes)
        {
            self.take(desired);
        }
        self.advance();
        self.report(now);
    }

    fn take(&mut self, desired: &Desired) {
        let Desired { power, mode, motion, setpoint } = desired;
        if power.value == Power::Untouched {
            return;
        }
        self.take_power(power.value);
        self.take_mode(mode.value);
        let is_new = motion.serial != self.shows.accepted.motion;
        let Setpoint { position, velocity, torque, row, .. } = *setpoint;
        assert!(position.is_finite() && velocity.is_finite() && torque.is_finite(), "{desired:?}");
        let Accepted { power: before, motion: moved, row: last } = self.shows.accepted;
        assert!(power.serial >= before && motion.serial >= moved && row >= last, "it goes back: {desired:?}");
        self.shows.accepted = Accepted { power: power.serial, motion: motion.serial, row: setpoint.row };
        if self.state != State::OperationEnabled {
            return;
        }
        let from = self.point;
        let own = |motion| Some((motion, 0));
        // A homing ends with its request.
        if std::mem::replace(&mut self.homes, motion.value == Motion::Home) && !self.homes {
            self.motion = own(Trajectory::run(from, 0.0, HALT));
        }
        match (motion.value, self.can.generator) {
            (Motion::Halt, _) if is_new && self.is_halted_by_halt => {
                self.motion = own(Trajectory::run(from, 0.0, HALT));
            }
            (Motion::Halt, Generator::Drive { .. }) => {}
            (Motion::Halt, _) if self.is_halted_by_halt => {}
            (Motion::Home, _) if is_new => {
                self.shows.homing = Homing::Open;
                self.motion = own(Trajectory::go_to(from, 0.0, 100.0, 1_000.0, 1_000.0));
            }
            (Motion::Home, _) => {}
            (Motion::Move { position, profile: p }, _) if is_new => {
                let motion = Trajectory::go_to(from, position, p.velocity, p.acceleration, p.deceleration);
                self.motion = own(motion);
            }
            (Motion::Velocity { velocity, acceleration }, _) if is_new => {
                self.motion = own(Trajectory::run(from, velocity, acceleration));
            }
            (Motion::Ramp { deceleration }, _) if is_new => {
                self.motion = own(Trajectory::run(from, 0.0, deceleration));
            }
            (Motion::Follow, Generator::Drive { .. }) if row > last => {
                self.rows.push_back(Point { position, velocity });
                if self.rows.len() > self.buffer {
                    self.point = self.rows.pop_front().unwrap();
                }
                self.motion = None;
            }
            // What it has not reached by then, it never reaches.
            (Motion::EndStream, _) => self.rows.clear(),
            (_, Generator::Master(quantity)) if self.shows.mode == ModeIs::Own => {
                self.motion = None;
                let dt = T as f64 * 1e-9;
                self.point = match quantity {
                    Quantity::Position => Point { position: position - velocity * dt, velocity },
                    Quantity::Velocity => Point { velocity: self.own_reference.unwrap_or(velocity), ..from },
                    Quantity::Torque => Point { velocity: from.velocity + torque * PER_TORQUE * dt, ..from },
                    Quantity::Unknown => from,
                };
            }
            (_, Generator::Master(_)) if self.shows.mode == ModeIs::Other && self.motion.is_none() => {
                self.motion = own(Trajectory::run(from, 0.0, HALT));
            }
            _ => {}
        }
    }

    fn take_power(&mut self, power: Power) {
        if self.powers.last() != Some(&power) {
            self.powers.push(power);
        }
        let word = match power {
            Power::Untouched | Power::Off => ControlCommand::DisableVoltage.word(),
            Power::Shutdown => ControlCommand::Shutdown.word(),
            Power::SwitchOn => ControlCommand::SwitchOn.word(),
            Power::EnableOperation => ControlCommand::EnableOperation.word(),
            Power::QuickStop => ControlCommand::QuickStop.word(),
            Power::FaultReset => ControlWord(ControlWord::FAULT_RESET),
        };
        let before = std::mem::replace(&mut self.before, word);
        let next = match Transition::caused(self.state, word, before).map(|transition| transition.to) {
            _ if self.sto_open && self.state == State::ReadyToSwitchOn && power != Power::Off => return,
            Some(State::OperationEnabled)
                if self.state == State::QuickStopActive && !self.can.leaves_quick_stop =>
            {
                return;
            }
            None if self.can.switches_on_at_once
                && (self.state, power) == (State::ReadyToSwitchOn, Power::EnableOperation) =>
            {
                State::SwitchedOn
            }
            Some(next) => next,
            None => return,
        };
        match (self.state, next) {
            (State::Fault, _) => {
                self.state = next;
                (self.code, self.shows.fault.active) = (0, false);
                if self.persists {
                    self.trip(7);
                }
            }
            (State::OperationEnabled, State::QuickStopActive) => self.leave_operation(next, HALT),
            (State::OperationEnabled | State::QuickStopActive, _) => self.leave_operation(next, COAST),
            _ => self.state = next,
        }
    }

    fn leave_operation(&mut self, next: State, braking: f64) {
        if next != State::OperationEnabled {
            self.motion = Some((Trajectory::run(self.point, 0.0, braking), 0));
        }
        self.state = next;
    }

    fn take_mode(&mut self, mode: Mode) {
        let wanted = match mode {
            Mode::AsIs => return,
            Mode::Own => ModeIs::Own,
            Mode::Homing => ModeIs::Homing,
        };
        self.mode_in = match self.shows.mode {
            mode if mode == wanted => return,
            ModeIs::Other => self.mode_in + 1,
            _ => 0,
        };
        self.shows.mode = if self.mode_in < MODE_TAKES { ModeIs::Other } else { wanted };
    }

    fn advance(&mut self) {
        let Some((motion, ns)) = &mut self.motion else {
            self.point.position += self.point.velocity * T as f64 * 1e-9;
            return;
        };
        *ns += T;
        self.point = motion.at(*ns);
        let over = self.shows.homing == Homing::Open && motion.is_over(*ns);
        if self.homes && over && self.state == State::OperationEnabled {
            self.homed = !self.home_fails;
            self.shows.homing = if self.home_fails { Homing::Failed } else { Homing::Attained };
        }
    }

    fn report(&mut self, now: Time) {
        let Point { position: demand, velocity } = self.point;
        let position = self.blocked.unwrap_or(demand) + self.wrapped;
        self.restless = -self.restless;
        let demand = demand + self.restless;
        let status = DriveStatus {
            at: now,
            state: self.state,
            homed: self.homed,
            moving: self.is_moving(),
            sto_open: self.sto_open && !self.state.is_powered(),
            position,
            demand,
            velocity,
            fault: self.code,
            ..DriveStatus::default()
        };
        let reference = Some(if self.homed { Reference::Set } else { Reference::Lost });
        let evidence = Evidence { reference, position, demand, demand_velocity: velocity, ..self.shows };
        self.reports.push_front(Report { status, evidence, restarts: self.restarts });
        self.reports.truncate(16);
    }
}
