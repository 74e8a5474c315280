//! Moves, jogs, searches and stops, and the buffer of what is to come behind them.
//!
//! Facts: sheet, 5.4, 5.5, 5.7; what they leave open is assumed:
//!
//! | case | what the drive does |
//! |---|---|
//! | a move while another one runs | waits in the buffer, and starts behind it |
//! | FC, FO | a relative move that goes on at VC after DC; that sets its output at the end |
//! | FE | nothing |

use std::f64::consts::TAU;

use super::drive::{Drive, alarm};
use super::parameters::{Key, Name};
use super::search::{Search, Sensor};
use crate::power::{Aim, RPM};

/// A condition at an input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Io {
    pub number: u8,
    pub condition: u8,
}

impl Io {
    /// From its code: the condition as a letter, and 0xB0 + the number.
    pub(super) fn new(code: u16) -> Option<Io> {
        let [condition, low] = code.to_be_bytes();
        let number = low.checked_sub(0xB0).filter(|number| *number <= 12)?;
        b"HLRF".contains(&condition).then_some(Io { number, condition })
    }

    /// Whether it is met, with the input open now and before.
    pub(super) fn is_met(self, open: bool, before: bool) -> bool {
        match self.condition {
            b'H' => open,
            b'L' => !open,
            b'R' => open && !before,
            _ => !open && before,
        }
    }
}

/// What the motor can be commanded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Move {
    Relative,
    Absolute,
    Change,
    Output(Io),
    Sensor(Sensor, Io),
    Double(Io, Io),
    FindHome,
    Jog,
}

/// What a move goes by, in units of the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Profile {
    pub velocity: i32,
    pub acceleration: i32,
    pub deceleration: i32,
    pub distance: i32,
}

/// What waits in the buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Entry {
    /// With the profile that came with it, or that of the parameters by then.
    Move(Move, Option<Profile>),
    Write(Key, i32),
    Enable(bool),
    Reset,
    Position(i32),
    Encoder(i32),
    Output(Io),
    Register(u8, i32),
    /// With DE, else with AM.
    Stop(bool),
    Segment(u8),
    Nothing,
}

/// What the motor does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Motion {
    #[default]
    Idle,
    /// To the target of its aim.
    Going {
        /// Another aim from this place on.
        change: Option<(f64, Aim)>,
        output: Option<Io>,
        homing: bool,
    },
    Jogging,
    Searching(Search),
    Stopping {
        jogging: bool,
        /// Then there, with this.
        back: Option<(f64, Profile)>,
        disables: bool,
    },
}

/// rad/s of a velocity on the wire.
pub(super) fn speed(value: i32) -> f64 {
    f64::from(value) * 0.25 * RPM
}

/// rad/s² of an acceleration on the wire.
pub(super) fn rate(value: i32) -> f64 {
    f64::from(value) * 10.0 * RPM
}

impl Profile {
    /// The aim of a move to this place.
    pub(super) fn to(self, place: f64) -> Aim {
        self.at(self.velocity, place)
    }

    pub(super) fn at(self, velocity: i32, place: f64) -> Aim {
        let (up, down) = (rate(self.acceleration), rate(self.deceleration));
        Aim::GoTo { place, speed: speed(velocity), up, down }
    }

    pub(super) fn direction(self) -> f64 {
        if self.distance < 0 { -1.0 } else { 1.0 }
    }

    pub(super) fn run(self, velocity: i32, direction: f64) -> Aim {
        let (up, down) = (rate(self.acceleration), rate(self.deceleration));
        Aim::Velocity { speed: speed(velocity) * direction, up, down }
    }
}

impl Drive {
    /// rad of a step.
    pub(super) fn step_rad(&self) -> f64 {
        TAU / f64::from(self.parameters.get(b"EG").max(1))
    }

    /// The profile of the parameters.
    pub(super) fn profile(&self) -> Profile {
        let get = |name: &Name| self.parameters.get(name);
        Profile {
            velocity: get(b"VE"),
            acceleration: get(b"AC"),
            deceleration: get(b"DE"),
            distance: get(b"DI"),
        }
    }

    /// The profile of a jog in the direction that the sign of `direction` says.
    pub(super) fn jog_profile(&self, direction: i32) -> Profile {
        let get = |name: &Name| self.parameters.get(name);
        Profile {
            velocity: get(b"JS"),
            acceleration: get(b"JA"),
            deceleration: get(b"JL"),
            distance: direction,
        }
    }

    /// Nothing moves, and nothing waits.
    pub(super) fn is_free(&self) -> bool {
        self.motion == Motion::Idle && self.buffer.is_empty() && self.program_ns.is_none()
    }

    /// A command: carried out now, or behind what is under way. False: there is no room.
    pub(super) fn push(&mut self, entry: Entry) -> bool {
        if self.is_free() {
            self.carry_out(entry);
            return true;
        }
        let has_room = self.buffer.len() < self.firmware.buffer;
        if has_room {
            self.buffer.push_back(entry);
        } else {
            self.refused.buffer_full += 1;
        }
        has_room
    }

    /// The next one of the buffer begins, once the motor is free.
    pub(super) fn next(&mut self) {
        while self.motion == Motion::Idle && self.program_ns.is_none() {
            let Some(entry) = self.buffer.pop_front() else { return };
            self.carry_out(entry);
        }
    }

    fn carry_out(&mut self, entry: Entry) {
        match entry {
            Entry::Move(kind, profile) => self.begin(kind, profile),
            Entry::Write(key, value) => {
                self.write(key, value);
            }
            Entry::Enable(on) => self.enable(on),
            Entry::Reset => self.reset(),
            Entry::Position(steps) => self.set_position(steps),
            Entry::Encoder(counts) => self.set_encoder(counts),
            Entry::Output(io) => self.set_output(io),
            Entry::Register(code, value) => {
                self.write_register(code, value);
            }
            Entry::Stop(gently) => self.stop(gently, false),
            Entry::Segment(number) => self.run_segment(number),
            Entry::Nothing => {}
        }
    }

    /// Begins a move.
    fn begin(&mut self, kind: Move, profile: Option<Profile>) {
        if !self.enabled {
            return self.raise(alarm::NO_MOVE);
        }
        let profile = match kind {
            Move::Jog => profile.unwrap_or_else(|| self.jog_profile(self.parameters.get(b"DI"))),
            Move::FindHome => self.find_profile(),
            _ => profile.unwrap_or_else(|| self.profile()),
        };
        let (here, step) = (self.power.demand(), self.step_rad());
        let length = f64::from(profile.distance) * step;
        // A count that has gone round is what a position is counted by, and the way there never goes round.
        let rounds = ((here - self.power.zero) / step).round() - f64::from(self.absolute());
        let (target, zero) = (here + length, self.power.zero + rounds * step);
        let goes = |aim, change, output| (aim, Motion::Going { change, output, homing: false });
        let (aim, motion) = match kind {
            Move::Relative => goes(profile.to(target), None, None),
            Move::Absolute => goes(profile.to(zero + length), None, None),
            Move::Output(io) => goes(profile.to(target), None, Some(io)),
            Move::Change => {
                let at = here + f64::from(self.parameters.get(b"DC")).abs() * step * profile.direction();
                let then = profile.at(self.parameters.get(b"VC"), target);
                goes(profile.to(target), Some((at, then)), None)
            }
            Move::Jog => (profile.run(profile.velocity, profile.direction()), Motion::Jogging),
            Move::Sensor(..) | Move::Double(..) | Move::FindHome => {
                let Some(search) = self.search(kind, profile) else { return };
                (profile.run(profile.velocity, profile.direction()), Motion::Searching(search))
            }
        };
        let way = match aim {
            Aim::GoTo { place, .. } => place - here,
            _ => profile.direction(),
        };
        let homing = matches!(motion, Motion::Searching(Search { homing: true, .. }));
        if let Some(limit) = self.limit(way).filter(|_| !homing) {
            return self.raise(limit);
        }
        (self.aim, self.motion) = (aim, motion);
    }

    /// Which way it is to go.
    fn way(&self) -> f64 {
        match self.aim {
            Aim::GoTo { place, .. } => place - self.power.place(),
            Aim::Velocity { speed, .. } => speed,
            _ => 0.0,
        }
    }

    /// The limit switch that acts against this way.
    fn limit(&self, way: f64) -> Option<u16> {
        let (low, high) = self.motor.limits?;
        let place = self.power.place() / self.step_rad();
        match place {
            place if place <= f64::from(low) && way < 0.0 => Some(alarm::CCW_LIMIT),
            place if place >= f64::from(high) && way > 0.0 => Some(alarm::CW_LIMIT),
            _ => None,
        }
    }

    /// Ends what the motor does, and everything that waits: with DE or JL, or with AM.
    pub(super) fn kill(&mut self, gently: bool, disables: bool) {
        self.buffer.clear();
        self.program_ns = None;
        self.stop(gently, disables);
    }

    /// Ends what the motor does.
    pub(super) fn stop(&mut self, gently: bool, disables: bool) {
        let jogging = match self.motion {
            Motion::Idle if disables => return self.enable(false),
            Motion::Idle => return,
            Motion::Stopping { jogging, .. } => jogging,
            Motion::Jogging => true,
            _ => false,
        };
        let name = match (gently, jogging) {
            (false, _) => b"AM",
            (true, true) => b"JL",
            (true, false) => b"DE",
        };
        self.brake(rate(self.parameters.get(name)), jogging, None, disables);
    }

    pub(super) fn brake(&mut self, down: f64, jogging: bool, back: Option<(f64, Profile)>, disables: bool) {
        self.aim = Aim::Velocity { speed: 0.0, up: down, down };
        self.motion = Motion::Stopping { jogging, back, disables };
    }

    /// Another speed for a running jog.
    pub(super) fn update_jog(&mut self, jog_speed: i32) {
        if let (Motion::Jogging, Aim::Velocity { up, down, .. }) = (self.motion, self.aim) {
            self.aim = Aim::Velocity { speed: speed(jog_speed), up, down };
        }
    }

    /// What follows from where the motor is now; `before` are the inputs before this step.
    pub(super) fn follow(&mut self, before: u16) {
        let way = self.power.speed();
        let limit = self.limit(self.way());
        match (limit, self.motion) {
            (Some(_), Motion::Searching(search)) if search.homing && !search.turned => {
                let profile =
                    Profile { distance: search.profile.distance.saturating_neg(), ..search.profile };
                self.aim = profile.run(profile.velocity, profile.direction());
                self.motion = Motion::Searching(Search { turned: true, profile, ..search });
                return;
            }
            (Some(_), Motion::Idle | Motion::Stopping { .. }) | (None, _) => {}
            (Some(limit), _) => {
                self.raise(limit);
                return self.kill(false, false);
            }
        }
        match self.motion {
            Motion::Going { change: Some((at, aim)), output, homing } => {
                let passed = (self.power.place() - at) * way.signum() >= 0.0 && way != 0.0;
                if passed {
                    self.aim = aim;
                    self.motion = Motion::Going { change: None, output, homing };
                } else if !self.power.is_moving() {
                    self.arrived(output, homing);
                }
            }
            Motion::Going { output, homing, .. } if !self.power.is_moving() => self.arrived(output, homing),
            Motion::Stopping { back, disables, .. } if !self.power.is_moving() => match back {
                Some((place, profile)) => {
                    self.aim = profile.to(place);
                    self.motion = Motion::Going { change: None, output: None, homing: true };
                }
                None => {
                    self.motion = Motion::Idle;
                    self.hold();
                    if disables {
                        self.enable(false);
                    }
                }
            },
            Motion::Searching(search) => self.look(search, before),
            _ => {}
        }
    }

    fn arrived(&mut self, output: Option<Io>, homing: bool) {
        self.motion = Motion::Idle;
        if let Some(io) = output {
            self.set_output(io);
        }
        if homing {
            self.power.homed = true;
            if self.firmware.homing_zeroes {
                self.set_position(0);
            }
        }
    }
}
