//! The drive behind the module: states, control word and status word, ramp, motor, faults.
//!
//! Knows no telegram. Facts: sheet, 4; what it leaves open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | DRIVECOM commands | bits 0 to 3 as listed, each exact: 0x0F does nothing in READY TO START |
//! | SWITCHED ON, and what leaves OPERATION ENABLED without a quick stop | no power: it coasts |
//! | bit 7 set in the first control word | is no edge |
//! | bit 4 at 0 | zero by the quick stop ramp; bit 5 at 0: the speed stays; bit 6 at 0: set point 0 |
//! | PROFIdrive without bit 10 | control word and set point are ignored |
//! | OFF1 | the ramp to standstill, then READY; OFF3: the quick stop, then inhibited; OFF2: coasts, inhibited |
//! | safe outputs | as set up, whatever the last control word was |

use super::codes::{Codes, ONE, Refusal, Type, code};
use super::settings::{InputWord, LenzeSettings, OutputWord, Safe};
use crate::Truth;
use crate::physics::PlantPlan;
use crate::power::{Aim, PowerDrive, PowerPlan, RPM, Reset};
use fieldbeat_core::axis::State;
use fieldbeat_core::time::{MS, Time};
use fieldbeat_profibus::DriveProfile;
use std::f64::consts::TAU;

/// Steps in which a drive that is found running has reached its speed: 60 s.
const RUN_UP: (u32, u64) = (600, 100 * MS);
/// A speed is reached within this share of C0011.
const REACHED: f64 = 0.005;
/// The count of 100 % torque.
const FULL_TORQUE: f64 = 16_384.0;
/// The control word of a drive that runs.
const RUNNING: [(DriveProfile, u16); 2] =
    [(DriveProfile::Drivecom, 0x007F), (DriveProfile::Profidrive, 0x047F)];

/// Bits of the control word, those of both profiles.
mod control {
    pub const ON: u16 = 1;
    pub const VOLTAGE: u16 = 1 << 1;
    pub const NO_QUICK_STOP: u16 = 1 << 2;
    pub const ENABLE: u16 = 1 << 3;
    pub const RAMP: u16 = 1 << 4;
    pub const RAMP_RUNS: u16 = 1 << 5;
    pub const SET_POINT: u16 = 1 << 6;
    pub const RESET: u16 = 1 << 7;
    /// DRIVECOM.
    pub const RESERVED: u16 = 7 << 8;
    /// PROFIdrive.
    pub const BY_MASTER: u16 = 1 << 10;
}

/// Which way the outputs go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outputs {
    Safe,
    /// With this control word.
    Live(u16),
}

/// A drive with its motor.
#[derive(Debug)]
pub(super) struct Drive {
    settings: LenzeSettings,
    power: PowerDrive<u16>,
    pub codes: Codes,
    state: State,
    outputs: Outputs,
    words: Vec<u16>,
    set_point: i16,
    /// OFF1: it slows down to switch off.
    stopping: bool,
    /// The ramp is held at this speed, rad/s.
    held: Option<f64>,
    pub warning: bool,
}

impl Drive {
    pub(super) fn new(settings: &LenzeSettings) -> Drive {
        let motor = &settings.motor;
        let plant = PlantPlan {
            mass_kg: motor.inertia_kgm2,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            peak_force_n: motor.peak_nm,
            friction_n: motor.friction_nm,
            ..PlantPlan::default()
        };
        let plan = PowerPlan {
            plant,
            max_speed: f64::INFINITY,
            hardware_enable: motor.hardware_enable,
            scan_ns: None,
        };
        let mut drive = Drive {
            power: PowerDrive::new(plan),
            codes: Codes::new(motor),
            state: State::SwitchOnDisabled,
            outputs: Outputs::Safe,
            words: vec![0; settings.outputs.len()],
            set_point: 0,
            stopping: false,
            held: None,
            warning: false,
            settings: settings.clone(),
        };
        drive.start();
        if let Some(rpm) = settings.running {
            drive.run_up(rpm);
        }
        drive
    }

    /// As another master has left it.
    fn run_up(&mut self, rpm: f64) {
        let word = RUNNING.iter().find(|(of, _)| *of == self.settings.power.profile).map_or(0, |of| of.1);
        self.set_point = self.counts(rpm);
        (self.state, self.outputs) = (State::OperationEnabled, Outputs::Live(word));
        (0..RUN_UP.0).for_each(|_| self.step(RUN_UP.1));
    }

    /// Power came back: the motor goes on turning as it did.
    pub(super) fn restart(&mut self) {
        self.power.restart();
        self.codes.restart();
        self.set_safe();
        self.state = State::SwitchOnDisabled;
        self.warning = false;
        self.start();
    }

    fn start(&mut self) {
        if let Some(fault) = self.settings.power.persistent_fault {
            self.fail(fault);
        }
    }

    /// A fault; the first one stays.
    pub(super) fn fail(&mut self, fault: u16) {
        if self.power.fail(fault, Reset::Always) {
            self.codes.log(fault);
            let brakes = self.settings.power.brakes_on_fault && self.is_powered();
            self.state = if brakes { State::FaultReactionActive } else { State::Fault };
        }
    }

    /// The code of its fault.
    pub(super) fn fault(&self) -> Option<u16> {
        self.power.fault()
    }

    fn reset(&mut self) {
        if self.state == State::Fault && self.power.reset() {
            self.state = State::SwitchOnDisabled;
            self.start();
        }
    }

    pub(super) fn state(&self) -> State {
        self.state
    }

    /// The motor has power.
    fn is_powered(&self) -> bool {
        matches!(self.state, State::OperationEnabled | State::QuickStopActive | State::FaultReactionActive)
    }

    /// Opens the hardware enable until then.
    pub(super) fn open_sto(&mut self, until: Time) {
        self.power.open_sto(until);
    }

    /// What the motor really does, in revolutions.
    pub(super) fn truth(&self) -> Truth {
        self.power.truth(self.is_powered(), TAU)
    }

    pub(super) fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.power.advance(now) {
            self.step(dt_ns);
        }
    }

    fn step(&mut self, dt_ns: u64) {
        if !self.power.is_enabled() {
            self.state = match self.state {
                State::FaultReactionActive => State::Fault,
                state if state.is_powered() => State::SwitchOnDisabled,
                state => state,
            };
        }
        if let Outputs::Live(word) = self.outputs {
            self.obey(word, word);
        }
        self.power.step(self.aim(), dt_ns);
        if self.power.is_standing() {
            self.state = match self.state {
                State::QuickStopActive => State::SwitchOnDisabled,
                State::FaultReactionActive => State::Fault,
                State::OperationEnabled if self.stopping => State::ReadyToSwitchOn,
                state => state,
            };
        }
    }

    /// The outputs are safe from now on.
    pub(super) fn set_safe(&mut self) {
        let runs = self.state == State::OperationEnabled;
        let safe = self.settings.dp.safe;
        (self.outputs, self.set_point) = (Outputs::Safe, 0);
        self.words.fill(0);
        self.state = match self.state {
            State::OperationEnabled | State::QuickStopActive if safe == Safe::QuickStop => {
                State::QuickStopActive
            }
            state @ (State::Fault | State::FaultReactionActive) => state,
            _ => State::SwitchOnDisabled,
        };
        if runs && safe == Safe::Fault {
            self.fail(self.settings.power.lost_fault);
        }
    }

    /// New outputs, big-endian. False: the control word has reserved bits.
    pub(super) fn set_outputs(&mut self, bytes: &[u8]) -> bool {
        let (words, _) = bytes.as_chunks();
        for (own, word) in self.words.iter_mut().zip(words) {
            *own = u16::from_be_bytes(*word);
        }
        let of = |wanted| self.settings.outputs.iter().position(|word| *word == wanted);
        let word = |place: Option<usize>| place.map_or(0, |place| self.words[place]);
        let (word, set_point) = (word(of(OutputWord::Control)), word(of(OutputWord::SetPoint)));
        let profidrive = self.settings.power.profile == DriveProfile::Profidrive;
        if profidrive && word & control::BY_MASTER == 0 {
            return true;
        }
        let before = match self.outputs {
            Outputs::Safe => word,
            Outputs::Live(before) => before,
        };
        (self.outputs, self.set_point) = (Outputs::Live(word), set_point.cast_signed());
        self.obey(word, before);
        profidrive || word & control::RESERVED == 0
    }

    /// Follows the control word, one state at a time.
    fn obey(&mut self, word: u16, before: u16) {
        let has = |bit| word & bit != 0;
        if has(control::RESET) && before & control::RESET == 0 {
            self.reset();
        }
        let ramped_off = self.settings.power.profile == DriveProfile::Profidrive;
        let (on, enable, closed) = (has(control::ON), has(control::ENABLE), self.power.is_enabled());
        let next = match self.state {
            state @ (State::Fault | State::FaultReactionActive) => state,
            _ if !has(control::VOLTAGE) => State::SwitchOnDisabled,
            State::OperationEnabled | State::QuickStopActive if !has(control::NO_QUICK_STOP) => {
                State::QuickStopActive
            }
            _ if !has(control::NO_QUICK_STOP) => State::SwitchOnDisabled,
            State::SwitchOnDisabled if !on => State::ReadyToSwitchOn,
            State::ReadyToSwitchOn if on && closed && (!enable || ramped_off) => State::SwitchedOn,
            State::SwitchedOn if !on => State::ReadyToSwitchOn,
            State::SwitchedOn if enable => State::OperationEnabled,
            State::OperationEnabled if !on && !ramped_off => State::ReadyToSwitchOn,
            State::OperationEnabled if on && !enable => State::SwitchedOn,
            state => state,
        };
        let stays = self.settings.power.ignores_stops && self.state == State::OperationEnabled;
        let next = if stays { self.state } else { next };
        self.stopping = ramped_off && !on && next == State::OperationEnabled;
        self.state = next;
        self.held = match has(control::RAMP_RUNS) || !self.ramp_bits() {
            true => None,
            false => Some(self.held.unwrap_or(self.power.speed())),
        };
    }

    fn ramp_bits(&self) -> bool {
        self.settings.power.ramp_bits || self.settings.power.profile == DriveProfile::Profidrive
    }

    /// The speed of 100 %, rpm.
    fn full_rpm(&self) -> f64 {
        f64::from(self.codes.get(code::MAX_SPEED, 0)) / f64::from(ONE)
    }

    /// Counts of a speed.
    fn counts(&self, rpm: f64) -> i16 {
        let counts = rpm / self.full_rpm() * f64::from(self.settings.motor.full_count);
        counts.round().clamp(i16::MIN.into(), i16::MAX.into()) as i16
    }

    /// The set point, rpm, and whether it is limited to 100 %.
    fn wanted(&self) -> (f64, bool) {
        let full = self.full_rpm();
        let rpm = f64::from(self.set_point) / f64::from(self.settings.motor.full_count) * full;
        (rpm.clamp(-full, full), rpm.abs() > full)
    }

    fn aim(&self) -> Aim {
        let ramp = |code| {
            let seconds = f64::from(self.codes.get(code, 0)) / f64::from(ONE);
            self.full_rpm() * RPM / seconds
        };
        let quick = ramp(code::QUICK_STOP);
        let stop = Aim::Velocity { speed: 0.0, up: quick, down: quick };
        let (up, down) = (ramp(code::ACCELERATION), ramp(code::DECELERATION));
        let word = match self.outputs {
            Outputs::Live(word) => word,
            Outputs::Safe => 0,
        };
        match self.state {
            State::QuickStopActive | State::FaultReactionActive => stop,
            State::OperationEnabled if self.ramp_bits() && word & control::RAMP == 0 => stop,
            State::OperationEnabled => {
                let zero = self.stopping || self.ramp_bits() && word & control::SET_POINT == 0;
                let target = if zero { 0.0 } else { self.wanted().0 * RPM };
                let speed = if self.stopping { 0.0 } else { self.held.unwrap_or(target) };
                Aim::Velocity { speed, up, down }
            }
            _ => Aim::Off,
        }
    }

    /// Appends the words of its inputs.
    pub(super) fn append_inputs(&self, out: &mut Vec<u8>) {
        for word in &self.settings.inputs {
            let value = match *word {
                InputWord::Status => self.status(),
                InputWord::Speed => self.counts(self.power.speed() / RPM).cast_unsigned(),
                InputWord::Torque => {
                    let share = self.power.torque() / self.settings.motor.rated_nm * FULL_TORQUE;
                    (share.round().clamp(i16::MIN.into(), i16::MAX.into()) as i16).cast_unsigned()
                }
                InputWord::Fault => self.fault().unwrap_or(0),
                InputWord::Echo(place) => self.words.get(usize::from(place)).copied().unwrap_or(0),
            };
            out.extend(value.to_be_bytes());
        }
    }

    /// The status word of its profile.
    fn status(&self) -> u16 {
        let (wanted, limited) = self.wanted();
        let off = (self.power.speed() / RPM - wanted).abs() > REACHED * self.full_rpm();
        let reached = self.state == State::OperationEnabled && !off;
        let live = self.outputs != Outputs::Safe;
        match self.settings.power.profile {
            DriveProfile::Drivecom => {
                let state = match self.state {
                    State::ReadyToSwitchOn => 0x21,
                    State::SwitchedOn => 0x23,
                    State::OperationEnabled => 0x27,
                    State::QuickStopActive => 0x07,
                    State::FaultReactionActive => 0x0F,
                    State::Fault => 0x08,
                    State::SwitchOnDisabled => 0x40,
                    State::Unknown | State::NotReadyToSwitchOn => 0,
                };
                let bits = [(self.warning, 7), (live, 9), (reached, 10), (limited, 11)];
                let shown = self.settings.power.enable_bit;
                let enable = shown.map(|(bit, set)| (self.power.is_enabled() == set, bit));
                bits.into_iter().chain(enable).fold(state, |word, (set, bit)| word | u16::from(set) << bit)
            }
            DriveProfile::Profidrive => {
                let word = match self.outputs {
                    Outputs::Live(word) => word,
                    Outputs::Safe => 0,
                };
                let on = matches!(self.state, State::SwitchedOn | State::OperationEnabled);
                let bits = [
                    (on || self.state == State::ReadyToSwitchOn, 0),
                    (on, 1),
                    (self.state == State::OperationEnabled, 2),
                    (self.fault().is_some(), 3),
                    (word & control::VOLTAGE != 0, 4),
                    (word & control::NO_QUICK_STOP != 0, 5),
                    (self.state == State::SwitchOnDisabled, 6),
                    (self.warning, 7),
                    (reached, 8),
                    (true, 9),
                    (reached, 10),
                ];
                bits.iter().fold(0, |word, (set, bit)| word | u16::from(*set) << bit)
            }
        }
    }

    /// Reads a parameter: its type and its value.
    pub(super) fn read(&self, code: u16, subcode: u16) -> Result<(Type, i32), Refusal> {
        let (of, _) = Codes::describe(code, subcode)?;
        let fixed = |value: f64| (value * f64::from(ONE)).round() as i32;
        let value = match code {
            code::SPEED => fixed(self.power.speed() / RPM),
            code::TORQUE => fixed(self.power.torque()),
            code::STATUS_WORD => self.status().into(),
            _ => self.codes.get(code, subcode),
        };
        Ok((of, value))
    }

    /// Writes a parameter.
    pub(super) fn write(&mut self, code: u16, subcode: u16, value: i32) -> Result<(), Refusal> {
        self.codes.write(code, subcode, value, self.is_powered())?;
        if code == code::TRIP_RESET {
            self.codes.set(code, 0, 0);
            if value == 0 {
                self.reset();
            }
        }
        Ok(())
    }
}
