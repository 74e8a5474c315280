//! The drive behind the network: its states, alarms and watchdog, and its motor.
//!
//! Knows no bytes of a message. Time comes in steps. Facts: sheet, 3.3 (ZS, ZA), 5.2, 5.6; what they leave open is
//! assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | the hardware enable closes again, a fault is reset | the motor stays off until it is enabled |
//! | ZS has passed | the buffer is emptied, too; the next message arms it again |
//! | after a power cycle | the position is 0 where the motor stands |

use std::collections::VecDeque;

use super::assembly::Outputs;
use super::motion::{Entry, Io, Motion};
use super::parameters::{Key, Parameters};
use super::settings::{FirmwareSettings, Kind, MoonsMotorSettings, MoonsSettings};
use super::wiring::Wiring;
use crate::physics::PlantPlan;
use crate::power::{Aim, PowerDrive, PowerPlan};
use fieldbeat_core::time::{MS, S, Time};

/// Bits of the alarm.
pub(super) mod alarm {
    pub const CCW_LIMIT: u16 = 0x0002;
    pub const CW_LIMIT: u16 = 0x0004;
    pub const NO_MOVE: u16 = 0x1000;
    pub const BLANK_SEGMENT: u16 = 0x4000;
    /// Those that disable the motor: position limit, over temperature, internal voltage, over voltage, over current,
    /// open winding, bad encoder.
    pub const FAULTS: u16 = 0x0001 | 0x0008 | 0x0010 | 0x0020 | 0x0080 | 0x0100 | 0x0200;
}

/// How long a save takes.
const SAVE_NS: u64 = 100 * MS;
/// A motor warms up by so much, 0.1 °C, with this time constant.
const WARM: (f64, f64) = (150.0, 300.0);
/// Steps in which a drive that is found running has reached its speed: 20 s.
const RUN_UP: (u32, u64) = (200, 100 * MS);
/// Entries of the alarm history.
const HISTORY: usize = 8;

/// What the drive was commanded and did not do, by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    /// Command words that changed without a 0 between.
    pub no_edge: u64,
    /// Command words with more than one command.
    pub several_bits: u64,
    /// Values out of their range: the one of before stays.
    pub out_of_range: u64,
    /// Host commands that the drive does not have.
    pub unknown_command: u64,
    /// Commands that this drive has, or may have, but that are not simulated or not possible.
    pub unsupported: u64,
    /// Enables while the hardware enable is open, or with a fault.
    pub not_enabled: u64,
    /// Commands for which the buffer had no room.
    pub buffer_full: u64,
    /// Messages of type 1 while a Q program ran.
    pub program_runs: u64,
}

/// A drive with its motor.
#[derive(Debug)]
pub(super) struct Drive {
    pub firmware: FirmwareSettings,
    pub motor: MoonsMotorSettings,
    pub kind: Kind,
    /// Of its firmware, and of its model.
    pub letter: u8,
    pub sub_model: u8,
    pub power: PowerDrive<()>,
    pub parameters: Parameters,
    pub registers: [i32; 10],
    pub aim: Aim,
    pub motion: Motion,
    pub buffer: VecDeque<Entry>,
    pub enabled: bool,
    pub alarms: u16,
    /// The newest at the front.
    pub history: VecDeque<u16>,
    pub wiring: Wiring,
    /// How long a Q program and a save go on.
    pub program_ns: Option<u64>,
    pub saving_ns: Option<u64>,
    /// The command word and what a host command goes by, as they came last.
    pub last: Outputs,
    pub refused: Refused,
    pub encoder_zero: f64,
    /// ZS and ZA as they were at power-up.
    watchdog: (u64, u8),
    /// The last message; `None`: the watchdog is not armed.
    fed_at: Option<Time>,
    /// Over its temperature at rest, 0.1 °C.
    pub warmth: f64,
}

impl Drive {
    pub(super) fn new(settings: &MoonsSettings) -> Drive {
        let motor = &settings.motor;
        let plant = PlantPlan {
            mass_kg: motor.inertia_kgm2,
            range: (f64::NEG_INFINITY, f64::INFINITY),
            bandwidth_hz: 100.0,
            damping: 1.0,
            feed_forward: 1.0,
            peak_force_n: f64::INFINITY,
            friction_n: motor.friction_nm,
        };
        let power = PowerDrive::new(PowerPlan {
            plant,
            max_speed: f64::INFINITY,
            hardware_enable: true,
            scan_ns: None,
        });
        let mut drive = Drive {
            power,
            parameters: Parameters::new(settings),
            registers: [0; 10],
            aim: Aim::Off,
            motion: Motion::Idle,
            buffer: VecDeque::new(),
            enabled: false,
            alarms: 0,
            history: VecDeque::new(),
            wiring: Wiring::new(motor),
            program_ns: None,
            saving_ns: None,
            last: Outputs::default(),
            refused: Refused::default(),
            encoder_zero: 0.0,
            watchdog: (0, 0),
            fed_at: None,
            warmth: 0.0,
            kind: settings.identity.kind,
            letter: settings.identity.letter,
            sub_model: settings.identity.model.1,
            firmware: settings.firmware.clone(),
            motor: settings.motor.clone(),
        };
        drive.power.put(f64::from(motor.start) * drive.step_rad());
        drive.power_up();
        if let Some(velocity) = settings.running {
            drive.run_up(velocity);
        }
        drive
    }

    /// As another master has left it.
    fn run_up(&mut self, velocity: f64) {
        self.enable(true);
        let speed = velocity * self.step_rad();
        (self.aim, self.motion) =
            (Aim::Velocity { speed, up: speed.abs() + 1.0, down: speed.abs() + 1.0 }, Motion::Jogging);
        (0..RUN_UP.0).for_each(|_| self.step(RUN_UP.1));
    }

    fn power_up(&mut self) {
        let get = |name| self.parameters.get(name);
        self.watchdog = (get(b"ZS").max(0) as u64 * MS, get(b"ZA") as u8);
        self.alarms = 0;
        let persistent = self.firmware.persistent_alarm;
        if persistent != 0 {
            self.raise(persistent);
        }
    }

    /// Power came back: everything volatile is lost, the motor goes on turning as it did.
    pub(super) fn restart(&mut self) {
        self.parameters.restart();
        self.power.restart();
        self.power.zero = self.power.place();
        self.encoder_zero = self.power.place();
        self.registers = [0; 10];
        self.wiring.restart();
        (self.aim, self.motion, self.enabled) = (Aim::Off, Motion::Idle, false);
        self.buffer.clear();
        self.history.clear();
        (self.program_ns, self.saving_ns, self.fed_at) = (None, None, None);
        self.last = Outputs::default();
        self.power_up();
    }

    /// Advances to `now`.
    pub(super) fn advance(&mut self, now: Time) {
        while let Some(dt_ns) = self.power.advance(now) {
            self.step(dt_ns);
        }
    }

    fn step(&mut self, dt_ns: u64) {
        let now = self.power.now();
        if self.enabled && !self.power.is_enabled() {
            self.enable(false);
        }
        if self.watchdog.0 > 0 && self.fed_at.is_some_and(|fed| now.since(fed) >= self.watchdog.0) {
            self.fed_at = None;
            self.bark();
        }
        runs_out(&mut self.program_ns, dt_ns);
        runs_out(&mut self.saving_ns, dt_ns);
        self.next();
        let before = self.inputs();
        let aim = if self.enabled { self.aim } else { Aim::Off };
        self.power.step(aim, dt_ns);
        self.follow(before);
        // Between two moves of the buffer the motor is not idle.
        self.next();
        let (most, constant) = WARM;
        let target = if self.enabled { most } else { 0.0 };
        let share = (dt_ns as f64 / S as f64 / constant).min(1.0);
        self.warmth += (target - self.warmth) * share;
    }

    /// Nothing has come for ZS.
    fn bark(&mut self) {
        match self.watchdog.1 {
            segment @ 1..=12 => {
                self.kill(false, false);
                self.run_segment(segment);
            }
            action => self.kill(matches!(action, 14 | 16), action >= 15),
        }
    }

    /// A message or data of the owner came: it arms the watchdog, and feeds it.
    pub(super) fn fed(&mut self, now: Time) {
        self.fed_at = Some(now);
    }

    /// A packet without data came.
    pub(super) fn heartbeat(&mut self, now: Time) {
        if self.firmware.heartbeats_feed {
            self.fed_at = Some(now);
        }
    }

    /// Raises an alarm; one of a fault disables the motor.
    pub(super) fn raise(&mut self, bits: u16) {
        if bits & !self.alarms != 0 {
            self.history.truncate(HISTORY - 1);
            self.history.push_front(bits);
        }
        self.alarms |= bits;
        if bits & alarm::FAULTS != 0 {
            self.enable(false);
        }
    }

    /// Resets all alarms. The motor stays as it is: off, after a fault.
    pub(super) fn reset(&mut self) {
        self.alarms = 0;
        let persistent = self.firmware.persistent_alarm;
        if persistent != 0 {
            self.raise(persistent);
        }
    }

    /// Opens the hardware enable until then.
    pub(super) fn open_sto(&mut self, until: Time) {
        self.power.open_sto(until);
    }

    /// Switches the motor on or off.
    pub(super) fn enable(&mut self, on: bool) {
        if on && (!self.power.is_enabled() || self.alarms & alarm::FAULTS != 0) {
            self.refused.not_enabled += 1;
        } else if on != self.enabled {
            self.enabled = on;
            self.motion = Motion::Idle;
            if on {
                self.hold();
            } else {
                self.aim = Aim::Off;
                self.buffer.clear();
            }
        }
    }

    /// Holds the motor where it is to be now.
    pub(super) fn hold(&mut self) {
        let most = super::motion::rate(self.parameters.get(b"AM"));
        self.aim = Aim::GoTo { place: self.power.demand(), speed: 1.0, up: most, down: most };
    }

    /// Writes a parameter; false: the value is out of its range.
    pub(super) fn write(&mut self, key: Key, value: i32) -> bool {
        // Positions are kept where they are, in steps of the new length.
        let zero = self.power.zero / self.step_rad();
        let fits = self.parameters.set(key, value);
        if !fits {
            self.refused.out_of_range += 1;
        } else if key.0 == *b"EG" {
            self.power.zero = zero * self.step_rad();
        }
        fits
    }

    /// Begins a Q program.
    pub(super) fn run_segment(&mut self, number: u8) {
        match self.firmware.segments.iter().find(|(segment, _)| *segment == number) {
            Some((_, ns)) => self.program_ns = Some(*ns),
            None => self.raise(alarm::BLANK_SEGMENT),
        }
    }

    /// Keeps all parameters over a power cycle.
    pub(super) fn save(&mut self) {
        self.parameters.save();
        self.saving_ns = Some(SAVE_NS);
    }

    /// The position there is this.
    pub(super) fn set_position(&mut self, steps: i32) {
        self.power.zero = self.power.demand() - f64::from(steps) * self.step_rad();
    }

    /// The encoder there counts this.
    pub(super) fn set_encoder(&mut self, counts: i32) {
        let ratio = self.motor.encoder.unwrap_or(1.0);
        self.encoder_zero = self.power.place() - f64::from(counts) / ratio * self.step_rad();
    }

    /// Sets an output: low is closed.
    pub(super) fn set_output(&mut self, io: Io) {
        let levels = matches!(io.condition, b'L' | b'H');
        if !levels || !self.wiring.set_output(io.number, io.condition == b'L') {
            self.refused.unsupported += 1;
        }
    }
}

/// Takes `dt_ns` from the rest, which ends with nothing left.
fn runs_out(left: &mut Option<u64>, dt_ns: u64) {
    *left = left.and_then(|left| left.checked_sub(dt_ns)).filter(|left| *left > 0);
}
